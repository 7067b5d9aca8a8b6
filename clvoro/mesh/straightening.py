"""Cells in 2D as polygons with straight sides: along the boundary several faces make one side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..connectivity import ranges, rows_of, starts_of
from ..geometry.polygon import Polygon
from ..geometry.rings import WALL_CORNER
from .diagram import Diagram

LEAST_BULGE = 0.1
"""Distance from a straight side over the size of the cell at which a vertex of the domain becomes a corner of it."""
FILLED = 0.5
"""Share of the triangle of a corner and the ends of the side that must lie in the domain, or it is cut off."""
LEAST_AREA = 1e-3
"""What straight sides must enclose of the area of a cell, or it keeps its own sides."""


def count_sides(diagram: Diagram) -> np.ndarray:
    """Return the number of sides of each cell in 2D, (n,); see `straighten`."""
    return straighten(diagram).sides


@dataclass(frozen=True)
class Straightened:
    """The cells of a diagram in 2D as polygons with straight sides."""

    sides: np.ndarray
    """(n,) int."""
    areas: np.ndarray
    perimeters: np.ndarray
    """`areas`, `perimeters`: (n,) float."""

    def quality(self) -> np.ndarray:
        """Return the paper's (4.1), 4 A n tan(pi / n) / P^2, of each, (n,)."""
        n = np.maximum(self.sides, 3)
        return 4 * np.maximum(self.areas, 0) * n * np.tan(np.pi / n) / self.perimeters**2


def straighten(diagram: Diagram) -> Straightened:
    """Return sides, areas and perimeters of cells in 2D as the mesh for solvers has them.

    Each face between cells is a side. Along the boundary a cell has one straight side from its first to its last point
    on a ring, with the convex corners of the domain between that `choose_corners` finds; re-entrant corners are cut
    off. A ring that is a whole cell stays as it is, and holes within a cell are not sides. Cells with fewer than three
    sides, and those whose sides enclose next to nothing, remain as they are. In a box the sides are the faces.
    """
    counts, n = np.diff(diagram.neighbor_starts), len(diagram)
    owner, measures = diagram.half_faces.owner, diagram.face_measures
    perimeters = np.bincount(owner, measures, minlength=n)
    domain = diagram.domain.outline
    if domain is None:
        return Straightened(counts, diagram.volumes, perimeters)
    sides = _straight_sides(diagram, domain, owner)
    inner = np.flatnonzero(diagram.neighbors >= 0)
    # Positions are relative to the generator.
    ends = (diagram.vertices[v] - diagram.points[owner[inner]] for v in diagram.half_faces.ends[inner].T)
    p, q = (np.concatenate(pair) for pair in zip(ends, (sides.begin, sides.end), strict=True))
    cell = np.concatenate([owner[inner], sides.cell])
    number = np.bincount(cell, minlength=n)
    areas = np.bincount(cell, cross(p, q) / 2, n)
    made = (number >= 3) & (areas > LEAST_AREA * diagram.volumes)
    length = np.bincount(cell, np.hypot(*(q - p).T), n)
    areas, perimeters = np.where(made, areas, diagram.volumes), np.where(made, length, perimeters)
    return Straightened(np.where(made, number, np.minimum(number, 3)), areas, perimeters)


def cell_quality(diagram: Diagram, surfaces: np.ndarray) -> np.ndarray:
    """Return the quality of each cell, (n,): the paper's (4.1) in 2D and on a sphere, the isoperimetric quotient in 3D.

    `surfaces` (n,) are the sums of the measures of the cells' faces.
    """
    if diagram.domain.cell_dim == 2:
        return straighten(diagram).quality()
    return 36 * np.pi * diagram.volumes**2 / surfaces**3


def cell_sizes(diagram: Diagram) -> np.ndarray:
    """Return the size of each cell as runs count it, (n,): its volume to the power 1 / d.

    In polygons areas are those of `straighten`. Cells of power diagrams have prescribed volumes and count as they are.
    """
    cut = diagram.domain.outline is not None and not diagram.is_power
    volumes = straighten(diagram).areas if cut else diagram.volumes
    return np.maximum(volumes, 0) ** (1 / diagram.domain.cell_dim)


def have_corners(diagram: Diagram) -> np.ndarray:
    """Return which cells in a polygonal domain have a corner of the boundary, (n,) bool.

    The boundary turns there by more than 30 degrees: at the end of a wall face of the cell, or between two such faces
    or the straight sides of the cell.
    """
    domain = diagram.domain.outline
    assert domain is not None
    owner = diagram.half_faces.owner
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
    cornered = np.abs(turned) > WALL_CORNER
    found = np.zeros(len(diagram), bool)
    found[owner[here[cornered]]] = found[owner[there[cornered]]] = True
    sides = _straight_sides(diagram, domain, owner)
    found[sides.cell[1:][np.diff(sides.run) == 0]] = True
    return found


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of vectors in 2D, (k, 2) each: (k,)."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def chain_areas(points: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return the area within the `points` (k, 2) from each `first` to each `last` (g,), negative if clockwise."""
    row, place = ranges(first, last - 1)
    base = points[first][row]
    return np.bincount(row, cross(points[place] - base, points[place + 1] - base), len(first)) / 2


def choose_corners(chain: np.ndarray, chosen: np.ndarray, size: np.ndarray) -> None:
    """Choose among the points of chains those that become corners of convex cells, between the `chosen` ones.

    As in the algorithm of Douglas and Peucker the point farthest from a straight side divides it, if it is far enough
    outside, and the domain fills the triangle; then both halves are treated alike.

    - `chain` (k, 2) float64: points along the boundary, the domain on the left, one chain after the other.
    - `chosen` (k,) bool: changed in place. The first and the last point of each chain are chosen.
    - `size` (k,) float64: size of the cell of each point.
    """
    ends = np.flatnonzero(chosen)
    low, high = ends[:-1], ends[1:]
    low, high = low[high - low > 1], high[high - low > 1]
    while low.size:
        starts = starts_of(high - low - 1)
        row, place = ranges(low + 1, high - 1)
        side = chain[high] - chain[low]
        length = np.hypot(*side.T)
        off = cross(chain[place] - chain[low][row], side[row]) / np.maximum(length, 1e-300)[row]
        farthest = np.maximum.reduceat(off, starts[:-1])
        hit = np.flatnonzero(off == farthest[row])
        middle = place[hit[np.searchsorted(row[hit], np.arange(len(low)))]]
        filled = chain_areas(chain, low, high) >= FILLED * farthest * length / 2
        divided = (length > 0) & (farthest >= LEAST_BULGE * size[low]) & filled
        low, middle, high = low[divided], middle[divided], high[divided]
        chosen[middle] = True
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
        low, high = low[high - low > 1], high[high - low > 1]


@dataclass(frozen=True)
class _Sides:
    """Straight sides along the boundary."""

    cell: np.ndarray
    run: np.ndarray
    """`cell`, `run`: (s,) int. Cell, and number of its part of a ring."""
    begin: np.ndarray
    end: np.ndarray
    """`begin`, `end`: (s, 2) float64. Relative to the generator."""


def _straight_sides(diagram: Diagram, domain: Polygon, owner: np.ndarray) -> _Sides:
    """Return the straight sides of all cells along the boundary."""
    following = along_rings(diagram, domain)
    begins, rings = _beginnings(domain, following, _places(diagram, domain), owner)
    onward, cells = following.tolist(), owner.tolist()
    faces: list[int] = []
    firsts: list[int] = []
    for begin in begins.tolist():
        firsts.append(len(faces))
        face = begin
        while True:
            faces.append(face)
            face = onward[face]
            if face < 0 or face == begin or cells[face] != cells[begin]:
                break
    # Each run has one point more than faces.
    face, starts = np.array(faces, int), np.array([*firsts, len(faces)], int)
    run = rows_of(starts)
    run_of_point = np.repeat(np.arange(len(begins)), np.diff(starts) + 1)
    first = np.flatnonzero(np.diff(run_of_point, prepend=-1))
    last = np.append(first[1:], len(run_of_point)) - 1
    chain = np.empty((len(run_of_point), 2))
    ends = diagram.half_faces.ends[face]
    chain[np.arange(len(face)) + run] = diagram.vertices[ends[:, 0]]
    chain[last] = diagram.vertices[ends[starts[1:] - 1, 1]]
    cell = owner[begins][run_of_point]
    chain -= diagram.points[cell]
    chosen = np.isin(run_of_point, np.flatnonzero(rings))
    chosen[first] = chosen[last] = True
    choose_corners(chain, chosen, np.sqrt(np.maximum(diagram.volumes, 0))[cell])
    kept = np.flatnonzero(chosen)
    kept, after = kept[:-1], kept[1:]
    within = run_of_point[kept] == run_of_point[after]
    kept, after = kept[within], after[within]
    return _Sides(cell[kept], run_of_point[kept], chain[kept], chain[after])


def _places(diagram: Diagram, domain: Polygon) -> np.ndarray:
    """Return the place in `domain.oriented` of the edge behind each face, (m,); -1 for a face between cells."""
    walls = np.maximum(-1 - diagram.neighbors, 0)
    return np.where(diagram.neighbors < 0, domain.oriented.places[walls], -1)


def along_rings(diagram: Diagram, domain: Polygon) -> np.ndarray:
    """Return for each half-face on the boundary the next one on its ring, (m,); -1 if there is none."""
    rows = np.flatnonzero(diagram.neighbors < 0)
    edge = _places(diagram, domain)[rows].astype(np.int64)
    begin, end = diagram.half_faces.ends[rows].T.astype(np.int64)
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


def _beginnings(
    domain: Polygon, following: np.ndarray, edges: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the half-faces on the boundary with which a cell's part of a ring begins, (r,), and if it is all of it.

    There is none for a whole hole.
    """
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
    firsts = rows[(is_outer & ~divided)[ring[rows]]]
    firsts = firsts[np.unique(ring[firsts], return_index=True)[1]]
    return np.append(begins, firsts), np.repeat([False, True], [len(begins), len(firsts)])
