"""Stations: generators around concave creases and corners, placed so that faces between their cells meet there.

Nodes divide a chain of creases into chords, equidistributed by 1 / h. Around each node is a ball without other
generators. Beside a chord k generators stand where the spheres around its two ends intersect, in the middle of k equal
sectors. With the interior angle alpha there, k = round(alpha / 90 degrees). So all their bisectors contain the chord,
and each of the outermost two is nearest to one wall only. Where chains meet, the node in the corner is one of all of
them. Generators of two chains that are near each other become one, on the spheres of both. Mirror images of the
generators in the walls there complete the corner.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

from ..fixed_generators import FixedGenerators

if TYPE_CHECKING:
    from .solid import Solid

_CLEAR = 1.06  # radius in which no other generators are, over that of the sphere
_ROOM = 0.5  # of h: least distance of generators that are not the same
_WALL = 0.3  # of h: least distance of generators from walls
_SAMPLES = 8  # of 1 / h per step, at least
_FEWEST = 64  # samples per chain, at least
_MOST = 1 << 16
_ROUNDS = 3  # of reflections at a corner
_EXACT = 0.02  # of a radius: generators this near to a sphere are on it
_CROWD = 16  # generators at a corner, about
_ITERATIONS = 8  # of Newton's method
_MOST_INNER = 500  # of the linear least squares in it


@dataclass(frozen=True)
class Stations(FixedGenerators):
    """Generators around concave creases.

    Attributes
    ----------
    size : (n,) float
        The size h of their cells.
    chain : (n,) int
        The chain that each one belongs to; -1 for those that complete a corner.
    """

    size: np.ndarray
    chain: np.ndarray


@dataclass(frozen=True)
class Line:
    """A chain of creases as a line: vertices and, at each of them, tangents and the normals of both patches.

    Attributes
    ----------
    points, tangents, left, right : (m, 3) float
    at : (m,) float
        Length along the line.
    closed : bool
    """

    points: np.ndarray
    tangents: np.ndarray
    left: np.ndarray
    right: np.ndarray
    at: np.ndarray
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
    share_corners(chains)
    placing = AroundCreases(lambda x: -solid.signed_distance(x))
    for chain in chains:
        placing.add(chain)
    placing.join()
    placing.leave_out()
    placing.complete(solid)
    return placing.stations()


class ChainOfChords:
    """A chain that is divided into chords, with generators around each.

    Attributes
    ----------
    number : int
    vertices : (2,) int
        Those at its ends.
    h, middle : (n,) float
        Of each chord: size, and length along the chain.
    lengths, ways : (n,) and (n, 3) float
        Of each chord: length, and unit vector.
    nodes, radii : (n + 1, 3) and (n + 1,) float
        The ends of the chords, and the distances of the generators from them.
    turns : list of (k,) float
        The angles of the generators around each chord.
    axes : (n, 2, 3) float
        Unit vectors across each chord, in the directions of the angles 0 and 90 degrees.
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
    ) -> None:
        self.number, self.line, self.vertices = number, line, vertices
        at, self.middle, self.h = _divide(self.line, size, ends)
        self.nodes = self.line.along(self.line.points, at)
        chords = np.diff(self.nodes, axis=0)
        self.lengths = np.linalg.norm(chords, axis=1)
        self.ways = chords / self.lengths[:, None]

    def set_radii(self, reach: np.ndarray) -> None:
        """Set the radii at the nodes for generators at the distances `reach` (n,) from the chords."""
        radii = np.hypot(reach, 0.5 * self.lengths)
        before, after = (radii[-1:], radii[:1]) if self.line.closed else (radii[:1], radii[-1:])
        self.radii = 0.5 * (np.append(before, radii) + np.append(radii, after))

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


class _Crease(ChainOfChords):
    """A concave crease: generators in the middle of equal sectors of its interior angle."""

    def __init__(self, solid: Solid, number: int, size: Callable[[np.ndarray], np.ndarray]) -> None:
        super().__init__(number, chain_line(solid, number), solid.creases.vertices(number)[[0, -1]], size)
        left, right = (self.line.along(n, self.middle) for n in (self.line.left, self.line.right))
        left, right = (_unit(n - (n * self.ways).sum(axis=1)[:, None] * self.ways) for n in (left, right))
        sine, cosine = (np.cross(left, right) * self.ways).sum(axis=1), (left * right).sum(axis=1)
        angle = math.pi - np.arctan2(sine, cosine)
        count = np.maximum(2, np.rint(angle / (math.pi / 2))).astype(int)
        self.axes = np.stack([np.cross(left, self.ways), -left], axis=1)
        self.turns = [(np.arange(n) + 0.5) * (a / n) for n, a in zip(count.tolist(), angle, strict=True)]
        half = 0.5 * angle / count
        # A cell is a kite with the area h^2 whose tip is on the crease; its generator is at the centroid.
        self.set_radii(self.h / np.sqrt(np.tan(half)) * (np.cos(half) + 1 / np.cos(half)) / 3)


def _divide(
    line: Line, size: Callable[[np.ndarray], np.ndarray], ends: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lengths along a line at the ends of chords, (n + 1,), in their middle, and the sizes there, (n,).

    The first and the last chord are longer than the others by the factors `ends`.
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
    count = round(float(reached[-1]) - sum(ends) + 2)
    if line.closed:
        count = max(count, 3)
    if ends == (1.0, 1.0):
        marks = np.arange(2 * count + 1) / max(2 * count, 1) * reached[-1]
        scale = reached[-1] / max(count, 1)
    else:
        count = max(count, 2)
        lengths = np.ones(count)
        lengths[0], lengths[-1] = ends
        scale = reached[-1] / lengths.sum()
        marks = np.append(0, np.cumsum(np.repeat(0.5 * scale * lengths, 2)))
    at = np.interp(marks, reached, s)
    # Cells are as long along the line as across it.
    return at[::2], at[1::2], np.interp(at[1::2], s, h) * scale


def share_corners(chains: Sequence[ChainOfChords]) -> None:
    """Give the chains that meet in a corner one radius there."""
    ends: dict[int, list[tuple[ChainOfChords, int]]] = {}
    for chain in chains:
        for end in (0, -1):
            ends.setdefault(int(chain.vertices[end]), []).append((chain, end))
    for meeting in ends.values():
        radius = float(np.mean([chain.radii[end] for chain, end in meeting]))
        for chain, end in meeting:
            chain.radii[end] = radius


class AroundCreases:
    """Collects generators and balls; `depth` returns the distances of points (n, 3) from walls, negative outside."""

    def __init__(self, depth: Callable[[np.ndarray], np.ndarray]) -> None:
        self.depth = depth
        self.points, self.sizes, self.chains = np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64)
        self.spots = np.zeros((0, 3))  # the middle of the chord of each generator
        self.balls: list[list[int]] = []  # of each generator
        self.centers: list[np.ndarray] = []
        self.radii: list[float] = []
        self.lost = np.zeros((0, 3))

    def add(self, chain: ChainOfChords) -> None:
        """Add the generators and balls of a chain."""
        first, chord = len(self.centers), np.repeat(np.arange(len(chain.h)), chain.count)
        self.centers += list(chain.nodes)
        self.radii += chain.radii.tolist()
        self.points = np.vstack([self.points, *(chain.around(i) for i in range(len(chain.h)))])
        self.sizes = np.append(self.sizes, chain.h[chord])
        self.chains = np.append(self.chains, np.full(len(chord), chain.number))
        self.spots = np.vstack([self.spots, chain.line.along(chain.line.points, chain.middle)[chord]])
        self.balls += [[first + i, first + i + 1] for i in chord.tolist()]

    def keep(self, kept: np.ndarray) -> None:
        """Keep some of the generators."""
        self.points, self.sizes, self.chains = self.points[kept], self.sizes[kept], self.chains[kept]
        self.spots = self.spots[kept]
        self.balls = [balls for balls, k in zip(self.balls, kept.tolist(), strict=True) if k]

    def join(self, within: float = _EXACT) -> None:
        """Make one of two near generators of different chains, if there is a place on the spheres of both.

        `within` is how far it may be from the spheres, over their radii.
        """
        if not len(self.points):
            return
        kept = np.ones(len(self.points), bool)
        for i, j in self.near_pairs():
            if not kept[i] or not kept[j] or self.chains[i] == self.chains[j]:
                continue
            balls = self.balls[i] + self.balls[j]
            point = self.common_point(0.5 * (self.points[i] + self.points[j]), balls)
            near = np.linalg.norm(point - self.points[[i, j]], axis=1).max() < _ROOM * self.sizes[i]
            off = np.linalg.norm(point - np.array(self.centers)[balls], axis=1) / np.array(self.radii)[balls] - 1
            if near and np.abs(off).max() < within:
                self.points[i], self.balls[i] = point, balls
                kept[j] = False
        self.keep(kept)

    def near_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of generators without room for both, the closest first."""
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

    def leave_out(self) -> None:
        """Leave out generators near others, near walls, or outside; note their places on creases."""
        if not len(self.points):
            return
        keep = self.depth(self.points) > _WALL * self.sizes
        for i, j in self.near_pairs():
            if keep[i] and keep[j]:
                keep[j] = False
        # Without one of them, faces between the others may lie in a wall beyond the crease: all leave together.
        self.lost, spot = np.unique(self.spots[~keep], axis=0), np.unique(self.spots, axis=0, return_inverse=True)[1]
        keep &= ~np.isin(spot, spot[~keep])
        self.keep(keep)

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
                images = images[self.depth(images) > _WALL * h]
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
            self.chains = np.append(self.chains, np.full(len(added), -1))
            self.balls += [[] for _ in added]

    def stations(self) -> Stations:
        """Return what has been placed."""
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
        )


def _distinct(normals: np.ndarray) -> np.ndarray:
    """Return those of the unit `normals` (n, 3) that are not parallel to earlier ones, to about 10 degrees."""
    kept: list[np.ndarray] = []
    for n in normals:
        if all(abs(float(n @ other)) < 0.985 for other in kept):
            kept.append(n)
    return np.array(kept)
