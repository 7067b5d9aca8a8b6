"""The edges of a diagram in the plane, as each of the cells beside them sees them.

A half-edge is a side of one cell: it runs counter-clockwise around that, which lies on its left. An edge between two
cells is a pair of half-edges in opposite directions, one on the boundary has one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import ClvoroError
from ..mesh.connectivity import face_ends, face_keys, face_owners, next_faces
from ..mesh.diagram import Diagram


@dataclass(frozen=True)
class HalfEdges:
    """All half-edges, those of a cell one after the other, loop by loop; faces without length are none.

    Attributes
    ----------
    rows : (h,) int
        Where in the diagram's graph each is described.
    cell : (h,) int
    starts : (n + 1,) int
        Those of cell i are `starts[i]` to `starts[i + 1]`.
    begin, end : (h,) int
        The diagram's vertices.
    next, previous : (h,) int
        Neighbors in the loop.
    twin : (h,) int
        The other half, -1 where there is none.
    edge : (h,) int
        Number of the edge that each is half of.
    first : (e,) int
        Of each edge the half of the lower number; in the same order, so that edges are sorted by the lower cell.
    """

    rows: np.ndarray
    cell: np.ndarray
    starts: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    next: np.ndarray
    previous: np.ndarray
    twin: np.ndarray
    edge: np.ndarray
    first: np.ndarray

    @property
    def counts(self) -> np.ndarray:
        """Number of edges of each cell, (n,)."""
        return np.diff(self.starts)


def half_edges(diagram: Diagram, glued: bool) -> HalfEdges:
    """Return the half-edges of `diagram`; across the seams of a periodic box they have twins if they are `glued`.

    Raises
    ------
    ClvoroError
        If a face is not there from both sides.
    """
    ends = face_ends(diagram)
    rows = np.flatnonzero(ends[:, 0] != ends[:, 1])
    place = np.full(len(ends), -1)
    place[rows] = np.arange(len(rows))
    onward = next_faces(diagram)
    following = onward[rows]
    while (place[following] < 0).any():
        following = np.where(place[following] < 0, onward[following], following)
    following = place[following]
    previous = np.empty_like(following)
    previous[following] = np.arange(len(rows))
    twin = _twins(diagram, rows, glued)
    lower = (twin < 0) | (np.arange(len(rows)) < twin)
    first = np.flatnonzero(lower)
    edge = np.empty(len(rows), np.int64)
    edge[first] = np.arange(len(first))
    edge[~lower] = edge[twin[~lower]]
    cell = face_owners(diagram)[rows]
    starts = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=len(diagram)))])
    begin, end = ends[rows].T
    return HalfEdges(rows, cell, starts, begin, end, following, previous, twin, edge, first)


def _twins(diagram: Diagram, rows: np.ndarray, glued: bool) -> np.ndarray:
    """Return for each of `rows` the place in them of the same face from the other side; -1 where there is none."""
    joined = diagram.neighbors[rows] >= 0
    if not glued:
        joined &= ~diagram.shifts[rows].any(axis=1)
    inner = np.flatnonzero(joined)
    here, there = face_keys(diagram, rows[inner])
    by_here, by_there = np.argsort(here), np.argsort(there)
    if not np.array_equal(here[by_here], there[by_there]):
        raise ClvoroError(
            "two cells have different faces in common, as rounding makes them of faces that are hardly there; use "
            "dtype='float64'"
        )
    twin = np.full(len(rows), -1)
    twin[inner[by_here]] = inner[by_there]
    return twin
