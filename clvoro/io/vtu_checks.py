"""Check redundant arrays of `.vtu` files, which are written for other programs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..geometry.polygon import Polygon
from ..mesh.connectivity import face_owners
from ..mesh.diagram import Diagram
from ..mesh.straightening import count_sides


def check_repeated(arrays: Mapping[str, np.ndarray], diagram: Diagram) -> None:
    """Check the `arrays` of a file that are not needed to make its `diagram` against that diagram.

    Raises
    ------
    ValueError
        Names the first array that differs.
    """
    n, v = len(diagram), len(diagram.vertices)
    given = {"CellData.label": arrays["CellData.label"]}
    expected: dict[str, np.ndarray] = {"CellData.label": np.arange(n)}
    if diagram.domain.cell_dim == 2:
        for name in ("Points.", "CellData.generator") if diagram.domain.dim == 2 else ():
            given[f"z of {name}"] = z = arrays[name][:, 2]
            expected[f"z of {name}"] = np.zeros(len(z))
        if not isinstance(diagram.domain, Polygon) or "FieldData.wall_faces" in arrays:
            # Without wall_faces the edge of each face is only a guess.
            given["CellData.sides"] = arrays["CellData.sides"]
            expected["CellData.sides"] = count_sides(diagram)
    else:
        expected["CellData.faces_of_cell"] = np.diff(diagram.neighbor_starts)
        # The corners of a cell, each once, in ascending order.
        cell = np.repeat(face_owners(diagram).astype(np.int64), np.diff(diagram.face_vertex_starts))
        keys = np.unique(cell * v + diagram.face_vertices)
        expected["Cells.offsets"] = np.cumsum(np.bincount(keys // v, minlength=n))
        expected["Cells.connectivity"] = keys % v
        given = {name: arrays[name] for name in expected}
    for name, values in expected.items():
        if given[name].shape != values.shape:
            raise ValueError(f"{name} has shape {given[name].shape}, expected {values.shape}")
        wrong = np.flatnonzero(given[name] != values)
        if len(wrong):
            k = wrong[0]
            raise ValueError(f"{name} is {given[name][k]} at {k}, expected {values[k]}")
