"""Cells in 2D as polygons with straight sides: along the boundary several faces make one side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..geometry.rings import WALL_CORNER
from .connectivity import face_ends

if TYPE_CHECKING:
    from numpy.typing import DTypeLike

    from ..geometry.polygon import Polygon
    from .diagram import Diagram

SIDE_TURN = WALL_CORNER * (1 + 2.0**-10)
"""Largest turn of a side on the boundary: `WALL_CORNER` and a little more.

Sums of turns have round-off, but an arc of 2 x 15 degrees is one side in any precision. The margin is smaller than the
difference to the next possible sum in regular rings, whose turns are 360 degrees over their number of edges.
"""


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


def straighten(diagram: Diagram, real: DTypeLike = np.float64) -> Straightened:
    """Return sides, areas and perimeters of cells in 2D with a straightened boundary.

    Each face between cells is a side. A stretch of the boundary that turns by at most 30 degrees (`SIDE_TURN`) in sum
    is one side, a straight line from its first to its last end; where it turns farther a new side begins. Stretches
    follow the rings of the domain, from the beginning to the end of the cell's part of a ring. If a cell has a whole
    ring, the first stretch begins in its sharpest corner. Holes within a cell are not sides. Cells with fewer than
    three sides remain as they are. In a box the sides are the faces.

    Parameters
    ----------
    diagram : Diagram
    real : dtype
        Precision of the sums of turns, as on the device.
    """
    starts = diagram.neighbor_starts
    counts, n = np.diff(starts), len(diagram)
    owner, measures = np.repeat(np.arange(n), counts), diagram.face_measures
    perimeters = np.bincount(owner, measures, minlength=n)
    domain = diagram.domain.outline
    if domain is None:
        return Straightened(counts, diagram.volumes, perimeters)
    of, first, final = _stretches(diagram, domain, owner, np.dtype(real))
    rows, cells, last = np.flatnonzero(of >= 0), owner[first], len(first)
    # Positions are relative to the generator. A side of a single face changes nothing.
    ends = face_ends(diagram)
    p, q = (diagram.vertices[v] - diagram.points[owner] for v in ends.T)
    length, area = (np.bincount(of[rows], x[rows], last) for x in (measures, cross(p, q) / 2))
    begin, end = p[first], q[final]
    several = np.bincount(of[rows], minlength=last) > 1
    longer = np.where(several, length - np.hypot(*(end - begin).T), 0.0)
    beyond = np.where(several, area - cross(begin, end) / 2, 0.0)
    sides = np.bincount(owner[diagram.neighbors >= 0], minlength=n)
    sides += np.bincount(cells, minlength=n)
    polygons = sides >= 3
    return Straightened(
        sides,
        diagram.volumes - polygons * np.bincount(cells, beyond, n),
        perimeters - polygons * np.bincount(cells, longer, n),
    )


def cell_quality(diagram: Diagram, surfaces: np.ndarray, real: DTypeLike = np.float64) -> np.ndarray:
    """Return the quality of each cell, (n,): the paper's (4.1) in 2D and on a sphere, the isoperimetric quotient in 3D.

    `surfaces` (n,) are the sums of the measures of the cells' faces; `real` as for `straighten`.
    """
    if diagram.domain.cell_dim == 2:
        return straighten(diagram, real).quality()
    return 36 * np.pi * diagram.volumes**2 / surfaces**3


def have_corners(diagram: Diagram) -> np.ndarray:
    """Return which cells in a polygonal domain have a corner of the boundary, (n,) bool.

    That is a turn by more than 30 degrees (`SIDE_TURN`): at the end of a wall face of the cell, or in sum within it, so
    that the cell has several sides on one stretch of the boundary.
    """
    domain = diagram.domain.outline
    assert domain is not None
    owner = np.repeat(np.arange(len(diagram)), np.diff(diagram.neighbor_starts))
    of, _, _ = _stretches(diagram, domain, owner, np.dtype(np.float64))
    following, edges = along_rings(diagram, domain), _places(diagram, domain)
    here = np.flatnonzero(following >= 0)
    there = following[here]
    # The sum of turns from one edge to another one behind it on the same ring.
    oriented = domain.oriented
    rings = np.searchsorted(oriented.ring_starts, edges[here], side="right")
    sums = np.cumsum(oriented.turns)
    whole = np.add.reduceat(oriented.turns, oriented.ring_starts[:-1])
    turned = sums[edges[there]] - sums[edges[here]]
    turned += np.where(edges[there] < edges[here], whole[rings - 1], 0)
    within = owner[here] == owner[there]
    cornered = (np.abs(turned) > SIDE_TURN) | (within & (of[here] != of[there]))
    found = np.zeros(len(diagram), bool)
    found[owner[here[cornered]]] = found[owner[there[cornered]]] = True
    return found


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors in 2D, (k, 2) each: (k,)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _stretches(
    diagram: Diagram, domain: Polygon, owner: np.ndarray, real: np.dtype
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the stretch of each half-face, (m,), or -1; and the first and the last half-face of each stretch, (s,)."""
    following = along_rings(diagram, domain)
    edges = _places(diagram, domain)
    begins = _beginnings(domain, following, edges, owner)
    onward, of_face, cells = following.tolist(), edges.tolist(), owner.tolist()
    next_edge, turns = (domain.oriented.next_vertex.tolist(), list(domain.oriented.turns.astype(real)))
    stretch = np.full(len(edges), -1)
    first: list[int] = []
    final: list[int] = []
    for begin in begins:
        face, turned = begin, real.type(0)
        first.append(face)
        while True:
            stretch[face] = len(first) - 1
            next_, edge = onward[face], of_face[face]
            if next_ < 0 or next_ == begin or cells[next_] != cells[begin] or stretch[next_] >= 0:
                break
            while edge != of_face[next_]:
                edge = next_edge[edge]
                turned += turns[edge]
            if abs(turned) > real.type(SIDE_TURN):
                final.append(face)
                first.append(next_)
                turned = real.type(0)
            face = next_
        final.append(face)
    return stretch, np.array(first, int), np.array(final, int)


def _places(diagram: Diagram, domain: Polygon) -> np.ndarray:
    """Return the place in `domain.oriented` of the edge behind each face, (m,); -1 for a face between cells."""
    walls = np.maximum(-1 - diagram.neighbors, 0)
    return np.where(diagram.neighbors < 0, domain.oriented.places[walls], -1)


def along_rings(diagram: Diagram, domain: Polygon) -> np.ndarray:
    """Return for each half-face on the boundary the next one on its ring, (m,); -1 if there is none."""
    rows = np.flatnonzero(diagram.neighbors < 0)
    edge = _places(diagram, domain)[rows].astype(np.int64)
    begin, end = face_ends(diagram)[rows].T.astype(np.int64)
    # Very short edges have no face.
    used = np.unique(edge)
    ring = np.searchsorted(domain.oriented.ring_starts, used, side="right")
    starts = np.flatnonzero(np.diff(ring, prepend=-1))
    after = np.roll(used, -1)
    after[np.append(starts[1:], len(used)) - 1] = used[starts]
    onward = np.zeros(len(domain.oriented.vertices), np.int64)
    onward[used] = after
    keys = edge * len(diagram.vertices) + begin
    order = np.argsort(keys, kind="stable")
    following = np.full(len(diagram.neighbors), -1)
    for on in (onward[edge], edge):
        wanted = on * len(diagram.vertices) + end
        places = order[np.minimum(np.searchsorted(keys[order], wanted), len(rows) - 1)]
        found = keys[places] == wanted
        following[rows[found]] = rows[places[found]]
    return following


def _beginnings(domain: Polygon, following: np.ndarray, edges: np.ndarray, owner: np.ndarray) -> list[int]:
    """Return the half-faces on the boundary with which a cell's part of a ring begins; none for a whole hole."""
    rows = np.flatnonzero(edges >= 0)
    goes_on = rows[following[rows] >= 0]
    before = np.full(len(edges), -1)
    before[following[goes_on]] = goes_on
    begins = rows[(before[rows] < 0) | (owner[before[rows]] != owner[rows])]
    oriented = domain.oriented
    ring = np.searchsorted(oriented.ring_starts, edges, side="right") - 1
    divided = np.zeros(len(oriented.sharpest), bool)
    divided[ring[begins]] = True
    is_outer = np.diff(domain.piece_of_ring, prepend=-1) > 0
    # A ring that belongs to one cell begins with the first face after its sharpest corner.
    firsts = rows[(edges[before[rows]] != edges[rows]) & (is_outer & ~divided)[ring[rows]]]
    size = np.diff(oriented.ring_starts)[ring[firsts]]
    away = (edges[firsts] - oriented.sharpest[ring[firsts]]) % size
    order = np.lexsort((away, ring[firsts]))
    nearest = np.diff(ring[firsts[order]], prepend=-1) > 0
    return [*begins.tolist(), *firsts[order][nearest].tolist()]
