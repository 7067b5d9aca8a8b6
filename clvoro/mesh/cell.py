"""One cell of a diagram."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..arguments import check_integer
from ..errors import InputError
from .read_only import Sealed

if TYPE_CHECKING:
    from .diagram import Diagram


@dataclass(frozen=True, eq=False)
class Cell(Sealed):
    """One cell; see `Diagram.cell`. Lengths are in the domain's unit.

    Attributes
    ----------
    index : int
    generator, centroid : (d,) float64
    volume : float
        Area in 2D.
    neighbors : (k,) int32
        Cell behind each face, or -1 - w on wall w of the domain.
    areas : (k,) float64
        Measure of each face; length in 2D.
    vertices : (v, d) float64
        Corners of the cell, each once; in 2D counter-clockwise, clockwise around holes.
    faces : tuple of k int arrays
        Corners of each face, as indices in `vertices`: two in 2D; in 3D counter-clockwise as seen from outside. An
        array is empty where a face is as narrow as round-off.
    """

    index: int
    generator: np.ndarray
    centroid: np.ndarray
    volume: float
    neighbors: np.ndarray
    areas: np.ndarray
    vertices: np.ndarray
    faces: tuple[np.ndarray, ...]


def make_cell(diagram: Diagram, i: int) -> Cell:
    """Return cell `i` of `diagram`.

    Raises
    ------
    InputError, InputTypeError
        If `i` is not an integer, or there is no such cell.
    """
    n = len(diagram)
    i = check_integer("i", i, -n)
    if i >= n:
        raise InputError(f"i is {i}, expected at most {n - 1}: the diagram has {n} cells")
    i %= n
    first, last = (int(k) for k in diagram.neighbor_starts[i : i + 2])
    starts = diagram.face_vertex_starts[first : last + 1]
    corners = diagram.face_vertices[starts[0] : starts[-1]]
    _, place, inverse = np.unique(corners, return_index=True, return_inverse=True)
    order = np.argsort(place)  # corners in the order in which faces have them
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return Cell(
        index=i,
        generator=diagram.points[i],
        centroid=diagram.centroids[i],
        volume=float(diagram.volumes[i]),
        neighbors=diagram.neighbors[first:last],
        areas=diagram.face_measures[first:last],
        vertices=diagram.vertices[corners[place[order]]],
        faces=tuple(np.split(rank[inverse.ravel()], (starts - starts[0])[1:-1])),
    )
