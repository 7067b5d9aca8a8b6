"""Half-edges of a diagram in 2D.

A half-edge is a side of one cell. It runs counter-clockwise around the cell, which lies on its left. An edge between
two cells is a pair of half-edges in opposite directions; an edge on the boundary is a single one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import ClvoroError
from ..mesh.connectivity import face_ends, face_keys, face_owners, next_faces
from ..mesh.diagram import Diagram


@dataclass(frozen=True)
class HalfEdges:
    """All half-edges: cell by cell, loop by loop. Faces without length are left out.

    Attributes
    ----------
    rows : (h,) int
        Place of each half-edge in the diagram's graph.
    cell : (h,) int
    starts : (n + 1,) int
        Cell i has the half-edges `starts[i]` to `starts[i + 1]`.
    begin, end : (h,) int
        Vertices of the diagram.
    next, previous : (h,) int
        Next and previous half-edge in the loop.
    twin : (h,) int
        The opposite half-edge; -1 on the boundary.
    edge : (h,) int
        Number of the edge.
    first : (e,) int
        The lower-numbered half-edge of each edge, ascending: edges are sorted by their lower cell.
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
    """Return the half-edges of `diagram`. With `glued`, those at the seams of a periodic box have twins across.

    Raises
    ------
    ClvoroError
        If a face exists on one side only.
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
    """Return for each of `rows` the place in `rows` of the opposite half-face; -1 on the boundary."""
    joined = diagram.neighbors[rows] >= 0
    if not glued:
        joined &= ~diagram.shifts[rows].any(axis=1)
    inner = np.flatnonzero(joined)
    here, there = face_keys(diagram, rows[inner])
    by_here, by_there = np.argsort(here), np.argsort(there)
    if not np.array_equal(here[by_here], there[by_there]):
        raise ClvoroError(
            "the arrays of the diagram contradict each other: two cells have different common faces; call "
            "diagram.check(), or make the diagram again"
        )
    twin = np.full(len(rows), -1)
    twin[inner[by_here]] = inner[by_there]
    return twin
