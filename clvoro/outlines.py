"""Outlines of cells in 2D, on the host: ends of faces, loops, sides. Cells of polygons may have several loops."""

from __future__ import annotations

from dataclasses import dataclass
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


def count_sides(diagram: Diagram) -> np.ndarray:
    """Return the number of sides of each cell in 2D, (n,); see `straighten`."""
    return straighten(diagram).sides


@dataclass(frozen=True)
class Straightened:
    """The cells of a diagram in 2D as polygons with straight sides.

    Attributes
    ----------
    sides : (n,) int
    areas, perimeters : (n,) float
    """

    sides: np.ndarray
    areas: np.ndarray
    perimeters: np.ndarray

    def quality(self) -> np.ndarray:
        """Return the paper's (4.1), 4 A n tan(pi / n) / P^2, of each, (n,)."""
        n = np.maximum(self.sides, 3)
        return 4 * np.maximum(self.areas, 0) * n * np.tan(np.pi / n) / self.perimeters**2


def straighten(
    diagram: Diagram,
    turn: float = SIDE_TURN,
    ends_at: np.ndarray | None = None,
    begins_at: int = 0,
) -> Straightened:
    """Return sides, areas and perimeters of cells in 2D, the boundary between two of their corners made straight.

    Each face between cells is a side. So is each stretch of the boundary along which the cell's outline turns by no
    more than `turn` (radians) in sum, as a straight line from its first end to its last; where it turns farther a new
    side begins, and where parts of the cell come together amid an edge. Holes within a cell are no sides of it. Cells
    with less than three sides are left as they are. In a box the sides are the faces.

    Parameters
    ----------
    diagram : Diagram
    turn : float
    ends_at : (m,) bool, optional
        Faces with which a side ends in any case.
    begins_at : int
        With which face a loop that is boundary all around begins.
    """
    starts = diagram.neighbour_starts
    counts, n = np.diff(starts), len(diagram)
    owner, measures = np.repeat(np.arange(n), counts), diagram.face_measures
    perimeters = np.bincount(owner, measures, minlength=n)
    if not isinstance(diagram.domain, Polygon):
        return Straightened(counts, diagram.volumes, perimeters)
    of = _sides_of(diagram, turn, ends_at, begins_at)
    rows = np.flatnonzero(of >= 0)
    last = int(of.max(initial=-1)) + 1
    cells = np.zeros(last, int)
    cells[of[rows]] = owner[rows]
    # From the generator, with what is known of it: of sides of one face nothing is left.
    ends = face_ends(diagram)
    p, q = (diagram.vertices[v] - diagram.points[owner] for v in ends.T)
    length, area = (np.bincount(of[rows], x[rows], last) for x in (measures, _cross(p, q) / 2))
    begin, end = np.zeros((last, 2)), np.zeros((last, 2))
    following = next_faces(diagram)
    preceding = np.argsort(following)
    first, final = (rows[of[rows] != of[other[rows]]] for other in (preceding, following))
    begin[of[first]], end[of[final]] = p[first], q[final]
    several = np.bincount(of[rows], minlength=last) > 1
    longer = np.where(several, length - np.hypot(*(end - begin).T), 0.0)
    beyond = np.where(several, area - _cross(begin, end) / 2, 0.0)
    sides = np.bincount(owner[diagram.neighbours >= 0], minlength=n)
    sides += np.bincount(cells, minlength=n)
    polygons = sides >= 3
    return Straightened(
        sides,
        diagram.volumes - polygons * np.bincount(cells, beyond, n),
        perimeters - polygons * np.bincount(cells, longer, n),
    )


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _sides_of(
    diagram: Diagram, turn: float, ends_at: np.ndarray | None, begins_at: int
) -> np.ndarray:
    """Return which side each face on the boundary is a part of, (m,); -1 for others."""
    inner, following = diagram.neighbours >= 0, next_faces(diagram)
    preceding = np.empty_like(following)
    preceding[following] = np.arange(len(following))
    # By the edges: the direction of a short part of one rounds.
    domain = diagram.domain
    along = domain.vertices[domain.next_vertex] - domain.vertices
    angle = np.where(
        inner, 0.0, np.arctan2(*along.T[::-1])[np.where(inner, 0, -1 - diagram.neighbours)]
    )
    turns = np.remainder(angle[following] - angle + np.pi, 2 * np.pi) - np.pi
    ends = diagram.neighbours[following] == diagram.neighbours
    if ends_at is not None:
        ends |= ends_at
    onward, by, boundary = following.tolist(), turns.tolist(), (~inner).tolist()
    breaks = ends.tolist()
    firsts = np.flatnonzero(~inner & inner[preceding]).tolist()
    for face in _whole_rings(diagram, inner, following):
        first = face
        for _ in range(begins_at):
            first = onward[first]
        firsts.append(first)
    side = [-1] * len(inner)
    count = 0
    for first in firsts:
        face, turned, begun = first, 0.0, count
        side[face] = count
        while boundary[onward[face]] and onward[face] != first:
            turned += by[face]
            if breaks[face] or abs(turned) > turn:
                turned, count = 0.0, count + 1
            face = onward[face]
            side[face] = count
        if onward[face] == first and count > begun and abs(turned + by[face]) <= turn:
            # All around, and back on the side where it began.
            while side[face] == count:
                side[face] = begun
                face = int(preceding[face])
            count -= 1
        count += 1
    return np.array(side, dtype=int)


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
