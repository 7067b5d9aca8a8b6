"""Write the graph of the cells for METIS, which divides meshes among the ranks of a parallel model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from .atomic import atomic_file
from .contents import Contents

_CHUNK = 1 << 16


def write_metis(contents: Contents, path: Path) -> None:
    """Write the neighbors of each cell: METIS' graph format, MPAS' `graph.info`.

    The first line has the numbers of cells and of pairs of neighbors. Line i + 1 has the neighbors of the i-th cell,
    counted from 1, ascending. Neighbors share a face that has a measure; each is listed once, and no cell is its own
    neighbor, as METIS requires.

    Raises
    ------
    InputError
        If there are data of the caller, which the format does not hold.
    """
    if contents.extra:
        raise InputError(f"cannot write cell_data to {path}: a graph for METIS holds none; save as .nc or leave it out")
    faces, n = contents.diagram.faces, len(contents.diagram)
    i, j = (ends[: faces.n_inner].astype(np.int64) for ends in (faces.owner, faces.neighbor))
    pairs = np.unique(np.concatenate([i * n + j, j * n + i]))
    pairs = pairs[pairs // n != pairs % n]
    starts = np.concatenate([[0], np.cumsum(np.bincount(pairs // n, minlength=n))])
    neighbors = pairs % n + 1
    with atomic_file(path) as file:
        file.write(f"{n} {len(pairs) // 2}\n".encode())
        for first in range(0, n, _CHUNK):
            rows = starts[first : first + _CHUNK + 1]
            form = "".join(" ".join(["%d"] * k) + "\n" for k in np.diff(rows).tolist())
            file.write((form % tuple(neighbors[rows[0] : rows[-1]].tolist())).encode())
