"""Stations: generators around concave creases and corners, placed so that faces between their cells meet there.

At a station k generators stand around a crease at one distance from it, in the middle of k equal sectors. With the
mean interior angle alpha of the chain, k = round(alpha / 90 degrees). So their bisectors contain the crease, and each
of the outermost two is nearest to one wall only. Along a chain stations are equidistributed by 1 / h. At an open end
the first one is half a step away. Where chains meet, the mirror images of their last generators in the walls there
complete the corner.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy

if TYPE_CHECKING:
    from .solid import Solid

_SAME = 0.02  # of h: generators this close are the same one
_ROOM = 0.5  # of h: least distance of generators that are not the same
_WALL = 0.3  # of h: least distance of generators from walls
_SAMPLES = 8  # of 1 / h per step, at least
_FEWEST = 64  # samples per chain, at least
_MOST = 1 << 16
_ROUNDS = 3  # of reflections at a corner


@dataclass(frozen=True)
class Stations:
    """Generators around concave creases.

    Attributes
    ----------
    points : (m, 3) float
        Generators.
    size : (m,) float
        The size h of their cells.
    chain : (m,) int
        The chain that each one belongs to; -1 for those that complete a corner.
    left_out : (k, 3) float
        Places on creases where there is no room for a station.
    """

    points: np.ndarray
    size: np.ndarray
    chain: np.ndarray
    left_out: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


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
    points, sizes, chains, spots = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for chain in np.unique(solid.creases.chain[solid.creases.concave]).tolist():
        line = chain_line(solid, chain)
        at, h = _divide(line, size)
        k = _sectors(line)
        for s, step in zip(at, h, strict=True):
            around = _around(line, float(s), float(step), k)
            points.append(around)
            sizes.append(np.full(len(around), step))
            chains.append(np.full(len(around), chain))
            spots.append(np.broadcast_to(line.along(line.points, np.array([s])), around.shape))
    found = Stations(*(np.concatenate(part) for part in (points, sizes, chains, spots)))
    return _complete(solid, _with_room(solid, found))


def _divide(line: Line, size: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the lengths along a line at which stations are, and the sizes there."""
    total = float(line.at[-1])
    n = _FEWEST
    while True:
        s = np.union1d(np.linspace(0, total, n + 1), line.at)
        h = np.asarray(size(line.along(line.points, s)), float)
        reached = np.append(0, np.cumsum(np.diff(s) * 0.5 * (1 / h[1:] + 1 / h[:-1])))
        if n >= min(_SAMPLES * reached[-1], _MOST):
            break
        n = int(min(2 * _SAMPLES * reached[-1], _MOST))
    count = round(float(reached[-1]))
    if line.closed:
        count = max(count, 3)
    marks = (np.arange(count) + 0.5) / max(count, 1) * reached[-1]
    at = np.interp(marks, reached, s)
    # Cells are as long along the line as across it.
    return at, np.interp(at, s, h) * (reached[-1] / max(count, 1))


def _sectors(line: Line) -> int:
    """Return the number of generators around a line: one for each right angle of the mean interior angle."""
    turn = np.arctan2(
        np.einsum("ij,ij->i", np.cross(line.left, line.right), line.tangents),
        np.einsum("ij,ij->i", line.left, line.right),
    )
    mean = float(np.interp((np.arange(_FEWEST) + 0.5) / _FEWEST * line.at[-1], line.at, math.pi - turn).mean())
    return max(2, round(mean / (math.pi / 2)))


def _around(line: Line, s: float, h: float, k: int) -> np.ndarray:
    """Return the `k` generators of the station at the length `s`, (k, 3)."""
    at = np.array([s])
    spot, left, right = (line.along(values, at)[0] for values in (line.points, line.left, line.right))
    along = _unit(line.along(line.tangents, at)[0])
    left, right = (_unit(n - (n @ along) * along) for n in (left, right))
    angle = math.pi - math.atan2(float(np.cross(left, right) @ along), float(left @ right))
    half = 0.5 * angle / k
    # The cell is a kite with the area h^2 whose tip is on the crease; its generator is at the centroid.
    r = h / math.sqrt(math.tan(half)) * (math.cos(half) + 1 / math.cos(half)) / 3
    turn = (2 * np.arange(k) + 1) * half
    return spot + r * (np.cos(turn)[:, None] * np.cross(left, along) - np.sin(turn)[:, None] * left)


def _with_room(solid: Solid, found: Stations) -> Stations:
    """Merge generators at the same place; leave out those near others, near walls, or outside of the solid.

    The attribute `left_out` has the place on the crease of each generator before, and those of the rejected ones after.
    """
    if not len(found):
        return found
    points, h, spot = found.points, found.size, found.left_out
    keep = -solid.signed_distance(points) > _WALL * h
    near = scipy.spatial.KDTree(points).query_pairs(_ROOM * h.max(), output_type="ndarray")
    distance = np.linalg.norm(points[near[:, 0]] - points[near[:, 1]], axis=1)
    lost = ~keep
    for (i, j), d in sorted(zip(map(tuple, near.tolist()), distance.tolist(), strict=True)):
        if keep[i] and keep[j] and d < _ROOM * min(h[i], h[j]):
            keep[j] = False
            lost[j] = d > _SAME * h[j]
    return Stations(points[keep], h[keep], found.chain[keep], np.unique(spot[lost], axis=0))


def _complete(solid: Solid, found: Stations) -> Stations:
    """Add the mirror images of generators at corners in the walls there."""
    creases = solid.creases
    ends, count = np.unique(creases.edges[creases.concave].ravel(), return_counts=True)
    corners = np.intersect1d(ends[count > 1], solid.corners)
    if not len(found) or not corners.size:
        return found
    points, sizes, chains = found.points, found.size, found.chain
    for corner in corners.tolist():
        x = solid.surface.vertices[corner]
        touching = (solid.surface.triangles == corner).any(axis=1)
        walls = _distinct(solid.normals[touching])
        away = np.linalg.norm(points - x, axis=1)
        mine = points[away < 1.1 * sizes]
        if len(mine) < 2:
            continue
        h = float(np.median(sizes[away < 1.1 * sizes]))
        distance = np.linalg.norm(mine - x, axis=1)
        for _ in range(_ROUNDS):
            images = (mine[:, None] - 2 * ((mine - x) @ walls.T)[:, :, None] * walls).reshape(-1, 3)
            images = images[solid.signed_distance(images) < -_WALL * h]
            new = 0
            for image in images:
                others = np.vstack([points, mine])
                if np.linalg.norm(others - image, axis=1).min() > _ROOM * h:
                    mine = np.vstack([mine, image])
                    new += 1
            if not new or len(mine) > 16:
                break
        added = mine[len(distance) :]
        points = np.vstack([points, added])
        sizes = np.append(sizes, np.full(len(added), h))
        chains = np.append(chains, np.full(len(added), -1))
    return Stations(points, sizes, chains, found.left_out)


def _distinct(normals: np.ndarray) -> np.ndarray:
    """Return those of the unit `normals` (n, 3) that are not parallel to earlier ones, to about 10 degrees."""
    kept: list[np.ndarray] = []
    for n in normals:
        if all(abs(float(n @ other)) < 0.985 for other in kept):
            kept.append(n)
    return np.array(kept)
