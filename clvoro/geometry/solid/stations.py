"""Stations: generators around concave creases and corners, placed so that faces between their cells meet there.

Nodes divide a chain of creases into chords, equidistributed by 1 / h; a chain shorter than h is one chord. Around each
node is a ball without other generators. Beside a chord k generators stand where the spheres around its two ends
intersect, in the middle of k equal sectors. With the mean interior angle alpha of the chain, k = round(alpha / 90
degrees); a chord where sectors would be wider than 120 degrees has more. So all their bisectors contain the chord, and
each of the outermost two is nearest to one wall only. Two chords on both sides of a facet that is narrower than a cell,
as at the rim of a plate, share the angle around both. If they stand face to face, one generator beyond the middle of
the facet belongs to both. Else this middle is the border between their sectors.
Chains that meet in a corner share the node there. Generators of two chains that are near each other become one, on the
spheres of both. Mirror images of the generators in the walls there complete the corner.

A generator has no room if a wall or another generator is near, or if a ball around its crease holds a generator of
another one. Then the generators around that chord come nearer to it, step by step. If the least distance does not
suffice, those of the shortest chain are left out. Generators that are nearer have smaller cells than the size field
asks for. Errors of sizes do not count there: the target size of such a cell is the size that it has. The same holds
around creases that are curved as narrowly as a circle with a radius of two cells.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from ..fixed_generators import FixedGenerators
from .creases import connect

if TYPE_CHECKING:
    from .solid import Solid

_CLEAR = 1.06  # radius in which no other generators are, over that of the sphere
_OTHERS = 0.97  # of a radius: a ball is taken if a generator that is not on it is nearer to its center
_ROOM = 0.5  # of h: least distance of generators that are not the same
_WALL = 0.3  # of h: least distance of generators from walls
_SHORTEST = 0.3  # over h: shorter creases have no generators of their own
_SHRINKAGE, _LEAST = 0.8, 0.2  # of the scale of chords whose generators have no room: factor of a step, and end
_WIDEST, _WIDEST_CROWDED = math.radians(120), math.radians(150)  # sectors, and those where there is little room
_SHORT = 0.8  # over the radius at its first end: a shorter chord has the same radius at both ends
_NARROW = 0.75  # of h: two chords this near to each other on one patch share the sectors around both
_NARROW_FACING, _SHIFT = 1.2, 0.05  # of h: the same for chords face to face, and how far these may be shifted
_AROUND_FACET = math.radians(80)  # sectors, about, where two such chords have one in common
_FLATTEST = 0.95  # cosine of the angle at a chord between the facet and the generator in the common sector, at most
_ON_FACET, _PARALLEL = 0.2, 0.8  # of their distance: how far its middle is from the patch; product of their directions
_TILT = math.radians(8)  # of faces between sectors against a narrow facet, at least
_CURVED = math.radians(25)  # mean angle between neighboring chords above which a crease is a narrow curve
_SAMPLES = 8  # of 1 / h per step, at least
_FEWEST = 64  # samples per chain, at least
_MOST = 1 << 16
_ROUNDS = 3  # of reflections at a corner
_NEARBY = 4.0  # over h: chains whose crowded chords are further apart do not take room from each other
_EXACT = 0.02  # of a radius: generators this near to a sphere are on it
_CROWD = 16  # generators at a corner, about
_ITERATIONS = 8  # of Newton's method
_MOST_INNER = 500  # of the linear least squares in it


@dataclass(frozen=True)
class Stations(FixedGenerators):
    """Generators around concave creases."""

    size: np.ndarray
    """(n,) float. The size h of their cells."""
    chain: np.ndarray
    """(n,) int. The chain that each one belongs to; -1 for those that complete a corner."""


@dataclass(frozen=True)
class Line:
    """A chain of creases as a line: vertices and, at each of them, tangents and the normals of both patches."""

    points: np.ndarray
    tangents: np.ndarray
    left: np.ndarray
    right: np.ndarray
    """`points`, `tangents`, `left`, `right`: (m, 3) float."""
    at: np.ndarray
    """(m,) float. Length along the line."""
    closed: bool

    def along(self, values: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return `values` (m, 3) at the lengths `s` (n,)."""
        return np.column_stack([np.interp(s, self.at, column) for column in values.T])


def chain_line(solid: Solid, chain: int) -> Line:
    """Return a chain of creases as a line."""
    creases = solid.creases
    edges = np.arange(creases.starts[chain], creases.starts[chain + 1])
    vertices, closed = creases.vertices(chain), creases.closed(chain)
    points = solid.surface.vertices[vertices]
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    unit = steps / lengths[:, None]
    ahead, behind = (
        np.vstack([unit, unit[:1] if closed else unit[-1:]]),
        np.vstack([unit[-1:] if closed else unit[:1], unit]),
    )
    normals = []
    for column in range(2):
        item = creases.triangles[edges, column]
        corner = solid.surface.triangles[item]
        first = solid.corner_normals[item, (corner == vertices[:-1, None]).argmax(axis=1)]
        last = solid.corner_normals[item[-1], (corner[-1] == vertices[-1]).argmax()]
        normals.append(np.vstack([first, last]))
    return Line(points, _unit(ahead + behind), normals[0], normals[1], np.append(0, np.cumsum(lengths)), closed)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def place_stations(solid: Solid, size: Callable[[np.ndarray], np.ndarray]) -> Stations:
    """Return the stations of a solid for the sizes h = size(points (n, 3))."""
    chains = [_Crease(solid, c, size) for c in np.unique(solid.creases.chain[solid.creases.concave]).tolist()]
    chains = [chain for chain in chains if len(chain.h)]
    chains = _share_sectors(solid, chains)
    while True:
        placing = _placed(solid, chains)
        ends = np.cumsum([len(chain.h) for chain in chains])
        crowded, spots = (np.split(values, ends)[:-1] for values in (placing.without_room(), placing.spots))
        if any([chain.shrink(where) for chain, where in zip(chains, crowded, strict=True)]):
            continue
        left = [k for k, where in enumerate(crowded) if where.any()]
        if not left:
            break
        for k in _shortest_nearby(chains, left, [spots[k][crowded[k]] for k in left]):
            chains[k].leave_out(crowded[k])
    placing.complete(solid)
    return placing.stations()


def _shortest_nearby(chains: Sequence[_Crease], crowded: list[int], spots: list[np.ndarray]) -> list[int]:
    """Return those of the chains `crowded` that have fewer chords than all others around their crowded `spots`.

    What is left out there makes room for others, but not further away.
    """
    chain = np.repeat(crowded, [len(x) for x in spots])
    reach = _NEARBY * np.concatenate([np.full(len(x), chains[k].h.max()) for k, x in zip(crowded, spots, strict=True)])
    points = np.concatenate(spots)
    i, j = scipy.spatial.KDTree(points).query_pairs(reach.max(), output_type="ndarray").T
    near = np.linalg.norm(points[i] - points[j], axis=1) < np.maximum(reach[i], reach[j])
    i, j = chain[i[near]], chain[j[near]]
    rank = np.array([len(chain.h) for chain in chains]) * len(chains) + np.arange(len(chains))
    later = np.where(rank[i] > rank[j], i, j)
    return np.setdiff1d(crowded, later[i != j]).tolist()


def _share_sectors(solid: Solid, chains: list[_Crease]) -> list[_Crease]:
    """Let chords on both sides of a narrow facet share the sectors around both.

    The other chains are returned with them, without those along the ends of such facets, around which the generators of
    both sides are.
    """
    if not chains:
        return chains
    item = [(chain, i) for chain in chains for i in range(len(chain.h))]
    middle = np.concatenate([chain.spots for chain in chains])
    ways, h, angle = (np.concatenate([getattr(c, name) for c in chains]) for name in ("ways", "full", "angle"))
    near = scipy.spatial.KDTree(middle).query_pairs(_NARROW_FACING * h.max(), output_type="ndarray")
    i, j = np.concatenate([near, near[:, ::-1]]).T
    # Chords on both sides may be shifted along the facet.
    gap = middle[j] - middle[i]
    across = gap - (gap * ways[i]).sum(axis=1)[:, None] * ways[i]
    width = np.linalg.norm(across, axis=1)
    toward = across / np.maximum(width, 1e-300)[:, None]
    facing = np.zeros((2, 2, len(i)))  # of both chords, how far their walls to the left and right face the other one
    for side in range(2):
        walls = np.array([chain.wall(row, side) for chain, row in item])
        facing[:, side] = (walls[i] * toward).sum(axis=1), -(walls[j] * toward).sum(axis=1)
    facet = facing.argmax(axis=1)
    same = (ways[i] * ways[j]).sum(axis=1) * np.where(facet[0] == facet[1], -1, 1)
    mean = ways[i] + np.sign((ways[i] * ways[j]).sum(axis=1))[:, None] * ways[j]
    opposite = np.abs((gap * mean).sum(axis=1)) < _SHIFT * h[i] * np.linalg.norm(mean, axis=1)
    good = width < np.where(opposite, _NARROW_FACING, _NARROW) * h[i]
    good &= np.linalg.norm(gap - across, axis=1) < _NARROW * h[i]
    good &= (facing.max(axis=1) > _PARALLEL).all(axis=0) & (same > _PARALLEL)
    good &= np.minimum(angle[i], angle[j]) > math.pi
    good[good] = np.abs(solid.signed_distance(middle[i[good]] + 0.5 * across[good])) < _ON_FACET * width[good]
    rows = np.flatnonzero(good)[np.lexsort((-width[good], opposite[good]))]  # the best last
    best = dict(zip(i[rows].tolist(), rows.tolist(), strict=True))
    partner = {k: int(j[row]) for k, row in best.items()}
    # Both sides of a facet have common generators only if all their chords are opposite to each other.
    shifted = {item[k][0].number for k, row in best.items() if not opposite[row] or partner.get(partner[k]) != k}
    for k, row in best.items():
        chain, chord = item[k]
        if not {chain.number, item[partner[k]][0].number} & shifted:
            chain.share_common(chord, float((gap[row] ** 2).sum() / width[row]), bool(facet[0, row] == 1))
        else:
            chain.share(chord, 0.5 * (angle[k] + angle[partner[k]] - math.pi), bool(facet[0, row] == 1))
    shared = {v for c in chains for v, end in zip(c.vertices.tolist(), (0, -1), strict=True) if c.shared[end]}
    return [c for c in chains if c.line.at[-1] > _NARROW * c.full[0] or not shared.issuperset(c.vertices.tolist())]


def _placed(solid: Solid, chains: Sequence[_Crease]) -> AroundCreases:
    """Return the generators around `chains`, with one where those of two chains meet."""
    share_corners(chains)
    placing = AroundCreases(lambda x: -solid.signed_distance(x))
    placing.add(chains)
    placing.join()
    return placing


class ChainOfChords:
    """A chain that is divided into chords, with generators around each.

    - `number`: int
    - `vertices` (2,) int: those at its ends.
    - `h`, `middle` (n,) float: of each chord: size of the cells, and length along the chain up to its middle.
    - `lengths`, `ways` (n,) and (n, 3) float: of each chord: length, and unit vector.
    - `spots` (n, 3) float: the places on the chain at `middle`.
    - `nodes`, `radii` (n + 1, 3) and (n + 1,) float: the ends of the chords, and the distances of the generators from
      them.
    - `turns` list of (k,) float: the angles of the generators around each chord.
    - `axes` (n, 2, 3) float: unit vectors across each chord, in the directions of the angles 0 and 90 degrees.
    """

    turns: list[np.ndarray]
    axes: np.ndarray

    def __init__(
        self,
        number: int,
        line: Line,
        vertices: np.ndarray,
        size: Callable[[np.ndarray], np.ndarray],
        ends: tuple[float, float] = (1.0, 1.0),
        shortest: float = 0.5,
    ) -> None:
        self.number, self.line, self.vertices = number, line, vertices
        at, self.middle, self.h = _divide(self.line, size, ends, shortest)
        self.nodes, self.spots = (self.line.along(self.line.points, s) for s in (at, self.middle))
        chords = np.diff(self.nodes, axis=0)
        self.lengths = np.linalg.norm(chords, axis=1)
        self.ways = chords / self.lengths[:, None]

    def set_radii(self, reach: np.ndarray) -> None:
        """Set the radii at the nodes for generators at the distances `reach` (n,) from the chords."""
        radii = np.hypot(reach, 0.5 * self.lengths)
        before, after = (radii[-1:], radii[:1]) if self.line.closed else (radii[:1], radii[-1:])
        self.radii = 0.5 * (np.append(before, radii) + np.append(radii, after))

    @property
    def sized(self) -> np.ndarray:
        """Whether the cells around each chord have the size that they have as target size, (n,) bool."""
        return np.zeros(len(self.h), bool)

    @property
    def count(self) -> np.ndarray:
        """Number of generators around each chord, (n,) int."""
        return np.array([len(turns) for turns in self.turns], int)

    def around(self, i: int) -> np.ndarray:
        """Return the generators beside chord `i`, (k, 3)."""
        (r, q), length, way = self.radii[i : i + 2], self.lengths[i], self.ways[i]
        foot = 0.5 * (length + (r * r - q * q) / length)
        height = math.sqrt(max(r * r - foot * foot, 0.0))
        turn, (one, other) = self.turns[i], self.axes[i]
        return self.nodes[i] + foot * way + height * (np.cos(turn)[:, None] * one + np.sin(turn)[:, None] * other)


def _reach(half: Any) -> Any:
    """Return the distance of generators from a crease over h, in sectors twice as wide as `half`.

    A cell is a kite with the area h^2 whose tip is on the crease; its generator is at the centroid.
    """
    return (np.cos(half) + 1 / np.cos(half)) / (3 * np.sqrt(np.tan(half)))


class _Crease(ChainOfChords):
    """A concave crease: generators in the middle of equal sectors of its interior angle.

    - `angle` (n,) float: the interior angle at each chord, in radians.
    - `full` (n,) float: the size of the cells around each chord where there is room.
    - `scale` (n,) float: their size over the full one. Below `_LEAST` it stays.
    - `sectors` (n,) int: the number of generators around each chord.
    - `span` (n,) float: the angle that they divide.
    - `facet` (n,) float: the width of a facet beyond whose middle the last sector is; NaN elsewhere.
    - `shared`, `turned` (n,) bool: whether it is less than `angle`, since there is another crease on a narrow facet;
      and whether it ends, not begins, at the left wall.
    """

    def __init__(self, solid: Solid, number: int, size: Callable[[np.ndarray], np.ndarray]) -> None:
        ends = solid.creases.vertices(number)[[0, -1]]
        super().__init__(number, chain_line(solid, number), ends, size, shortest=_SHORTEST)
        self.full, self.scale = self.h, np.ones(len(self.h))
        if len(self.h) == 1:  # cells go on beyond the ends of a crease shorter than h
            self.full = np.maximum(self.h, size(self.line.along(self.line.points, self.middle)))
        left, right = (self.line.along(n, self.middle) for n in (self.line.left, self.line.right))
        left, right = (_unit(n - (n * self.ways).sum(axis=1)[:, None] * self.ways) for n in (left, right))
        sine, cosine = (np.cross(left, right) * self.ways).sum(axis=1), (left * right).sum(axis=1)
        self.angle = math.pi - np.arctan2(sine, cosine)
        self.span, (self.shared, self.turned) = self.angle.copy(), np.zeros((2, len(self.h)), bool)
        self.facet = np.full(len(self.h), np.nan)
        # Where the number changes along the chain, faces between cells are oblique.
        usual = np.rint(self.angle.mean() / (math.pi / 2)) if len(self.angle) else 2
        self.sectors = np.maximum(usual, np.ceil(self.angle / _WIDEST)).astype(int)
        self.axes = np.stack([np.cross(left, self.ways), -left], axis=1)
        self._arrange()

    def _arrange(self) -> None:
        """Set the sizes, angles and radii that follow from scale and sectors."""
        self.h = self.full * self.scale
        for i in np.flatnonzero(self.facet >= 0).tolist():
            radius = self.h[i]
            for _ in range(_ITERATIONS):
                turn = self.angle[i] - math.acos(min(0.5 * self.facet[i] / radius, _FLATTEST))
                n = max(round(turn / _AROUND_FACET - 0.5), 1)
                half = 0.5 * turn / (n + 0.5)
                radius = self.h[i] * _reach(half)
            self.sectors[i], self.span[i] = n + 1, 2 * half * (n + 1)
        self.turns = [
            (np.arange(n) + 0.5) * (a / max(n, 1)) for n, a in zip(self.sectors.tolist(), self.span, strict=True)
        ]
        self.turns = [a - t if back else t for t, a, back in zip(self.turns, self.angle, self.turned, strict=True)]
        half = 0.5 * self.span / np.where(self.sectors, self.sectors, 2)
        self.set_radii(self.h * _reach(half))

    @property
    def sized(self) -> np.ndarray:
        """See `ChainOfChords`. On the inner side of a narrow curve there is less room along the crease than outside."""
        turn = np.einsum("ij,ij->i", self.ways[1:], self.ways[:-1])
        return (self.scale < 1) | bool(len(turn) and np.arccos(np.clip(turn, -1, 1)).mean() > _CURVED)

    def wall(self, chord: int, side: int) -> np.ndarray:
        """Return the direction (3,) from a chord into the wall to its left, `side` 0, or to its right, 1."""
        turn, (one, other) = side * self.angle[chord], self.axes[chord]
        return math.cos(turn) * one + math.sin(turn) * other

    def share_common(self, chord: int, width: float, facet_right: bool) -> None:
        """Let the last sector be common to the chords on both sides of a facet of this `width`: beyond its middle."""
        self.facet[chord], self.shared[chord], self.turned[chord] = width, True, not facet_right
        self._arrange()

    def share(self, chord: int, span: float, facet_right: bool) -> None:
        """Divide only the angle `span` around a chord, from the wall that is not the facet."""
        self.sectors[chord] = n = max(round(span / (math.pi / 2)), 1)
        # No face between two of the sectors goes on along the facet beyond the crease.
        along = self.angle[chord] - math.pi
        m = min(range(1, n), key=lambda k: abs(k * span / n - along), default=0)
        if m and abs(m * span / n - along) < _TILT:
            span = (along + _TILT) * n / m
        self.span[chord], self.shared[chord], self.turned[chord] = span, True, not facet_right
        self._arrange()

    def shrink(self, crowded: np.ndarray) -> bool:
        """Move the generators at `crowded` chords (n,) bool nearer to these; return whether that has been possible.

        Where they are very near already, their number is reduced once, and they start again at the full distance.
        """
        crowded = crowded & (self.scale >= _LEAST)
        self.scale[crowded] *= _SHRINKAGE
        fewest = np.ceil(self.span / _WIDEST_CROWDED).astype(int)
        again = crowded & (self.scale < _LEAST) & (fewest < self.sectors)
        self.sectors[again], self.scale[again], self.facet[again] = fewest[again], 1, np.nan
        self._arrange()
        return bool(crowded.any())

    def leave_out(self, chords: np.ndarray) -> None:
        """Leave out the generators at `chords` (n,) bool."""
        self.sectors[chords], self.facet[chords] = 0, np.nan
        self._arrange()


def _divide(
    line: Line, size: Callable[[np.ndarray], np.ndarray], ends: tuple[float, float], shortest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Divide a line into chords about as long as the cells there; a line shorter than `shortest`, over h, has none.

    Return the lengths along the line at the ends of the chords, (n + 1,), those in the middle of each, (n,), and the
    sizes of the cells around them, (n,). The first and the last chord are longer by the factors `ends`.
    """
    total = float(line.at[-1])
    n = _FEWEST
    while True:
        s = np.union1d(np.linspace(0, total, n + 1), line.at)
        h = np.asarray(size(line.along(line.points, s)), float)
        reached = np.append(0, np.cumsum(np.diff(s) * 0.5 * (1 / h[1:] + 1 / h[:-1])))
        if n >= min(_SAMPLES * reached[-1], _MOST):
            break
        n = int(min(2 * _SAMPLES * reached[-1], _MOST))
    count = max(round(float(reached[-1]) - (sum(ends) - 2)), int(reached[-1] > shortest))
    if line.closed:
        count = max(count, 3)
    if ends != (1.0, 1.0):
        count = max(count, 2)
    lengths = np.ones(count)
    lengths[:1], lengths[-1:] = ends
    marks, whole = np.append(0, np.cumsum(np.repeat(lengths / 2, 2))), lengths.sum() or 1
    at = np.interp(marks / whole * reached[-1], reached, s)
    # Cells are as long along the line as across it.
    return at[::2], at[1::2], np.interp(at[1::2], s, h) * (reached[-1] / whole)


def share_corners(chains: Sequence[ChainOfChords]) -> None:
    """Average the radii of the chains that meet in a corner. A chain of one short chord joins its two corners."""
    if not chains:
        return
    ends, at = np.unique([chain.vertices for chain in chains], return_inverse=True)
    at = at.reshape(-1, 2)
    short = [len(chain.h) == 1 and chain.lengths[0] < _SHORT * chain.radii[0] for chain in chains]
    corner = connect(len(ends), at[short])[1][at].ravel()
    radii = np.array([chain.radii[[0, -1]] for chain in chains])
    shared = (np.bincount(corner, radii.ravel()) / np.bincount(corner))[corner].reshape(-1, 2)
    for chain, (first, last) in zip(chains, shared, strict=True):
        chain.radii[0], chain.radii[-1] = first, last


class AroundCreases:
    """Collects generators and balls; `depth` returns the distances of points (n, 3) from walls, negative outside."""

    def __init__(self, depth: Callable[[np.ndarray], np.ndarray]) -> None:
        self.depth = depth
        self.points, self.sizes, self.chains = np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64)
        self.sized = np.zeros(0, bool)  # of each generator: whether the target size of its cell is the size it has
        self.spots = np.zeros((0, 3))  # the middle of each chord
        self.chords: list[list[int]] = []  # of each generator
        self.balls: list[list[int]] = []  # of each generator
        self.centers: list[np.ndarray] = []
        self.radii: list[float] = []

    @property
    def lost(self) -> np.ndarray:
        """The middle of each chord without generators, (k, 3)."""
        return self.spots[~self._chords_of(np.ones(len(self.points), bool))]

    def add(self, chains: Sequence[ChainOfChords]) -> None:
        """Add the generators and balls of chains."""
        points, sizes, sized, numbers, spots = [self.points], [self.sizes], [self.sized], [self.chains], [self.spots]
        spot = len(self.spots)
        for chain in chains:
            first, chord = len(self.centers), np.repeat(np.arange(len(chain.h)), chain.count)
            self.centers += list(chain.nodes)
            self.radii += chain.radii.tolist()
            points += [chain.around(i) for i in range(len(chain.h))]
            sizes.append(chain.h[chord])
            sized.append(chain.sized[chord])
            numbers.append(np.full(len(chord), chain.number))
            spots.append(chain.spots)
            self.chords += [[spot + i] for i in chord.tolist()]
            self.balls += [[first + i, first + i + 1] for i in chord.tolist()]
            spot += len(chain.h)
        self.points, self.spots = np.vstack(points), np.vstack(spots)
        self.sizes, self.sized, self.chains = map(np.concatenate, (sizes, sized, numbers))

    def keep(self, kept: np.ndarray) -> None:
        """Keep the generators `kept`, (k,) int or (n,) bool."""
        rows = np.arange(len(self.points))[kept].tolist()
        self.points, self.sizes, self.chains = self.points[kept], self.sizes[kept], self.chains[kept]
        self.sized = self.sized[kept]
        self.balls, self.chords = ([x[k] for k in rows] for x in (self.balls, self.chords))

    def join(self, within: float = _EXACT) -> None:
        """Make one of two near generators of different chains, if there is a place on the spheres of both.

        `within` is how far it may be from the spheres, over their radii.
        """
        if not len(self.points):
            return
        kept = np.ones(len(self.points), bool)
        for i, j in self.near_pairs():
            if not kept[i] or not kept[j]:
                continue
            balls = self.balls[i] + self.balls[j]
            point = self.common_point(0.5 * (self.points[i] + self.points[j]), balls)
            near = np.linalg.norm(point - self.points[[i, j]], axis=1).max() < _ROOM * self.sizes[i]
            off = np.linalg.norm(point - np.array(self.centers)[balls], axis=1) / np.array(self.radii)[balls] - 1
            if near and np.abs(off).max() < within:
                self.points[i], self.balls[i] = point, balls
                self.chords[i] = self.chords[i] + self.chords[j]
                kept[j] = False
        self.keep(kept)

    def near_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of generators without room for both, the closest first."""
        if not len(self.points):
            return []
        near = scipy.spatial.KDTree(self.points).query_pairs(_ROOM * self.sizes.max(), output_type="ndarray")
        distance = np.linalg.norm(self.points[near[:, 0]] - self.points[near[:, 1]], axis=1)
        near, distance = (a[distance < _ROOM * self.sizes[near].min(axis=1)] for a in (near, distance))
        order = np.lexsort((near[:, 1], near[:, 0], np.round(distance, 9)))
        return [(i, j) for i, j in near[order].tolist()]

    def common_point(self, point: np.ndarray, balls: list[int]) -> np.ndarray:
        """Return the point near `point` on the spheres of all `balls`, or the best one: least squares."""
        centers, radii = np.array(self.centers)[balls], np.array(self.radii)[balls]
        for _ in range(_ITERATIONS):
            way = point - centers
            distance = np.linalg.norm(way, axis=1)
            point = point - np.linalg.lstsq(way / distance[:, None], distance - radii, rcond=1e-6)[0]
        return point

    def fit(self) -> None:
        """Move generators as little as may be, until those of each ball are equally far from its center."""
        if not len(self.points):
            return
        ball, item = np.array([(b, k) for k, balls in enumerate(self.balls) for b in balls]).T
        n, centers, start = len(self.points), np.array(self.centers), np.array(self.radii)
        scale, radii = start[ball], start
        for _ in range(_ITERATIONS):
            # |x - c|^2 = r^2, linearized in the generators x and in r^2.
            way = (self.points[item] - centers[ball]) / scale[:, None]
            columns = [*(3 * item + a for a in range(3)), 3 * n + ball]
            values = np.concatenate([*(2 * way.T / scale), -np.ones(len(ball)) / scale])
            where = np.tile(np.arange(len(ball)), 4), np.concatenate(columns)
            matrix = scipy.sparse.csr_array((values, where), (len(ball), 3 * n + len(radii)))
            off = (radii[ball] / scale) ** 2 - (way**2).sum(axis=1)
            step = scipy.sparse.linalg.lsmr(matrix, off, atol=1e-14, btol=1e-14, maxiter=_MOST_INNER)[0]
            self.points = self.points + step[: 3 * n].reshape(n, 3)
            radii = np.sqrt(np.maximum(radii**2 + step[3 * n :] * start, 0.25 * start**2))
        self.radii = radii.tolist()

    def without_room(self) -> np.ndarray:
        """Return which chords have a generator without room, (c,) bool.

        Another generator or a wall is near it, it is outside, or it is on a ball that is taken.
        """
        crowded = ~self._deep() | self._around_taken_balls()
        crowded[np.array(self.near_pairs(), int).ravel()] = True
        return self._chords_of(crowded)

    def _around_taken_balls(self) -> np.ndarray:
        """Return which generators are on a ball that is taken: it has one inside that is not on it, (n,) bool."""
        if not len(self.points):
            return np.zeros(0, bool)
        inside = scipy.spatial.KDTree(self.points).query_ball_point(self.centers, _OTHERS * np.array(self.radii))
        inside = [set(items) for items in inside]
        mine: list[list[int]] = [[] for _ in self.centers]
        for k, balls in enumerate(self.balls):
            for b in balls:
                mine[b].append(k)
        found = np.zeros(len(self.points), bool)
        for items, others in zip(mine, inside, strict=True):
            found[items] |= not others.issubset(items)
        return found

    def _deep(self) -> np.ndarray:
        """Return whether generators are far enough from walls, (n,) bool."""
        return self.depth(self.points) > _WALL * self.sizes if len(self.points) else np.zeros(0, bool)

    def _chords_of(self, chosen: np.ndarray) -> np.ndarray:
        """Return which chords have one of the generators `chosen` (n,) bool, (c,) bool."""
        found = np.zeros(len(self.spots), bool)
        found[[c for chords in itertools.compress(self.chords, chosen) for c in chords]] = True
        return found

    def leave_out(self) -> None:
        """Leave out generators near others, near walls, or outside, with all others around the same chord."""
        keep = self._deep()
        for i, j in self.near_pairs():
            if keep[i] and keep[j]:
                keep[j] = False
        # Without one of them, faces between the others may lie in a wall beyond the crease.
        lost = self._chords_of(~keep)
        self.keep(np.array([not lost[chords].any() for chords in self.chords], bool))

    def complete(self, solid: Solid) -> None:
        """Add the mirror images of generators at corners in the walls of `solid` there."""
        creases = solid.creases
        ends, count = np.unique(creases.edges[creases.concave].ravel(), return_counts=True)
        corners = np.intersect1d(ends[count > 1], solid.corners)
        if not len(self.points):
            return
        for corner in corners.tolist():
            x = solid.surface.vertices[corner]
            walls = _distinct(solid.normals[(solid.surface.triangles == corner).any(axis=1)])
            near = np.linalg.norm(self.points - x, axis=1) < 1.1 * self.sizes
            mine = self.points[near]
            if len(mine) < 2:
                continue
            h = float(np.median(self.sizes[near]))
            added: list[np.ndarray] = []
            for _ in range(_ROUNDS):
                images = (mine[:, None] - 2 * ((mine - x) @ walls.T)[:, :, None] * walls).reshape(-1, 3)
                images = images[(self.depth(images) > _WALL * h) & ~self._in_balls(images)]
                new = 0
                for image in images:
                    others = np.vstack([self.points, *added])
                    if np.linalg.norm(others - image, axis=1).min() > _ROOM * h:
                        added.append(image)
                        new += 1
                mine = np.vstack([mine, *added[len(added) - new :]])
                if not new or len(mine) > _CROWD:
                    break
            self.points = np.vstack([self.points, *added])
            self.sizes = np.append(self.sizes, np.full(len(added), h))
            self.sized = np.append(self.sized, np.full(len(added), self.sized[near].any()))
            self.chains = np.append(self.chains, np.full(len(added), -1))
            self.balls += [[] for _ in added]
            self.chords += [[] for _ in added]

    def _in_balls(self, points: np.ndarray) -> np.ndarray:
        """Return which points (m, 3) are in a ball, (m,) bool."""
        away = np.linalg.norm(points[:, None] - np.array(self.centers), axis=2)
        return (away < _OTHERS * np.array(self.radii)).any(axis=1)

    def stations(self) -> Stations:
        """Return what has been placed; generators with sizes of their own come last."""
        self.keep(np.argsort(self.sized, kind="stable"))
        used, balls = np.unique([ball for balls in self.balls for ball in balls], return_inverse=True)
        return Stations(
            self.points,
            np.reshape(self.centers, (-1, 3))[used.astype(int)],
            _CLEAR * np.array(self.radii)[used.astype(int)],
            np.cumsum([0, *map(len, self.balls)]).astype(np.int32),
            balls.astype(np.int32),
            self.lost,
            self.sizes,
            self.chains,
            n_sized=int(self.sized.sum()),
        )


def _distinct(normals: np.ndarray) -> np.ndarray:
    """Return those of the unit `normals` (n, 3) that are not parallel to earlier ones, to about 10 degrees."""
    kept: list[np.ndarray] = []
    for n in normals:
        if all(abs(float(n @ other)) < 0.985 for other in kept):
            kept.append(n)
    return np.array(kept)
