"""Outlines of cells in 2D, on the host: ends of faces, loops, sides. Cells of polygons may have several loops."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .polygon import Polygon

if TYPE_CHECKING:
    from .results import Diagram

SIDE_TURN = np.pi / 6
"""A side of a cell on the boundary turns by no more than this."""


def face_ends(diagram: Diagram) -> np.ndarray:
    """Return the vertices that each face of the graph runs from and to, (m, 2); its cell is on the left."""
    if isinstance(diagram.domain, Polygon):
        return diagram.face_vertices.reshape(-1, 2)
    starts, corners = diagram.cell_vertex_starts, diagram.cell_vertices
    places = np.arange(1, len(corners) + 1)
    filled = starts[1:] > starts[:-1]
    places[starts[1:][filled] - 1] = starts[:-1][filled]
    return np.stack([corners, corners[places]], axis=1)


def next_faces(diagram: Diagram) -> np.ndarray:
    """Return the face that comes after each face in its loop around the cell, (m,).

    In a row the loops stand one after the other, and each goes on until its vertices do not.
    """
    ends, starts = face_ends(diagram), diagram.neighbour_starts
    m = len(ends)
    last = np.zeros(m, bool)
    last[starts[1:][starts[1:] > starts[:-1]] - 1] = True
    breaks = last.copy()
    breaks[:-1] |= ends[:-1, 1] != ends[1:, 0]
    places = np.arange(1, m + 1)
    stops = np.flatnonzero(breaks)
    places[stops] = np.concatenate([[0], stops[:-1] + 1])[: len(stops)]
    return places


def count_sides(diagram: Diagram, turn: float = SIDE_TURN) -> np.ndarray:
    """Return the number of sides of each cell in 2D, (n,).

    Each face between cells is one. So is each stretch of the boundary along which the cell's outline turns by no more
    than `turn` (radians) in sum; where it turns farther a new side begins. Holes within a cell are no sides of it. In
    a box the sides are the faces.
    """
    counts = np.diff(diagram.neighbour_starts)
    if not isinstance(diagram.domain, Polygon):
        return counts
    n, inner = len(diagram), diagram.neighbours >= 0
    owner = np.repeat(np.arange(n), counts)
    sides = np.bincount(owner[inner], minlength=n)
    following = next_faces(diagram)
    preceding = np.empty_like(following)
    preceding[following] = np.arange(len(following))
    # By the edges: the direction of a short part of one rounds.
    domain = diagram.domain
    along = domain.vertices[domain.next_vertex] - domain.vertices
    angle = np.where(
        inner, 0.0, np.arctan2(*along.T[::-1])[np.where(inner, 0, -1 - diagram.neighbours)]
    )
    turns = np.remainder(angle[following] - angle + np.pi, 2 * np.pi) - np.pi
    firsts = np.flatnonzero(~inner & inner[preceding]).tolist()
    firsts += _whole_rings(diagram, inner, following)
    onward, by, boundary = following.tolist(), turns.tolist(), (~inner).tolist()
    for first in firsts:
        face, turned, count = first, 0.0, 1
        while boundary[onward[face]] and onward[face] != first:
            turned += by[face]
            if abs(turned) > turn:
                turned, count = 0.0, count + 1
            face = onward[face]
        if onward[face] == first and abs(turned + by[face]) <= turn:
            count -= 1  # all around, and back on the side where it began
        sides[owner[first]] += max(count, 1)
    return sides


def _whole_rings(diagram: Diagram, inner: np.ndarray, following: np.ndarray) -> list[int]:
    """Return a face of each loop that is on the boundary all around and has its cell inside."""
    x, ends = diagram.vertices, face_ends(diagram)
    owner = np.repeat(np.arange(len(diagram)), np.diff(diagram.neighbour_starts))
    # A loop's first face is one that no earlier one leads to.
    begins = np.flatnonzero(following <= np.arange(len(following)))
    loop = np.searchsorted(begins, np.arange(len(following)))
    open_ = np.bincount(loop, inner, len(begins)) > 0
    a, b = x[ends[:, 0]] - diagram.points[owner], x[ends[:, 1]] - diagram.points[owner]
    area = np.bincount(loop, a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], len(begins))
    return following[begins[~open_ & (area > 0)]].tolist()
