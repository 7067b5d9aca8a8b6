"""The surface of a solid as walls of cells on the device: triangles in uniform bins; see geometry/walls.h."""

from __future__ import annotations

import math
from collections.abc import Callable
from weakref import WeakKeyDictionary

import numpy as np
import scipy

from ..connectivity import ranges
from ..opencl.engine import Engine
from ..opencl.workspace import Workspace
from .bvh import Tree, curve_order

SMOOTH, CONVEX, CONCAVE = 0, 1, 2
"""Kinds of edges and corners of triangles: within a patch, on a convex crease, on a concave one."""
SAGITTA, SAGITTA_SLOPE = 0.1, 0.7
"""Depth of wall polygons below the foot of the generator on a surface of mean curvature H, over H h^2, where they cut
off as much as they add: half the mean square distance from the foot, which is 0.08 of the area of hexagons. Wall faces
are larger than h^2, and the more so the more convex the wall is: the factor is 1 + SAGITTA_SLOPE H h. Measured in and
around balls."""
TIP_COSINE, TIP_STEPS, TIP_BEND = math.cos(math.radians(30)), 6, 0.4
"""A patch has a tip, as that of a cone, where the cosine between its mean normal and that of a triangle is less. The
long triangles there are halved so often towards the tip, and mean curvature times h counts as at most TIP_BEND."""
SIDE_PER_ROOT, LEAST_SIDE, LARGEST_SIDE = 0.4, 48, 128
"""Bins along the longest side, per square root of the number of triangles, and limits: bins are as wide as triangles,
so that few triangles are in several of them."""
_SLACK = 1e-3
"""Of a bin, more than round-off in single precision."""
_FLAT = 1e-14
"""Height of a triangle over the largest coordinate: the normals of flatter ones are round-off."""
_BLOCK = 1 << 20
"""Pairs of a triangle and a bin that are tested at once."""


class WallTriangles:
    """Triangles of smooth patches as arguments of kernels; the workspace of the engine frees them.

    - `corners` (t, 3, 3) float: positions, counter-clockwise from outside of the region.
    - `patch` (t,) int: number of the patch: faces there have the label ``-1 - patch``.
    - `normals` (t, 3, 3) float: unit normals of the patch at the corners, out of the region.
    - `edges` (t, 3) int: `SMOOTH`, `CONVEX` or `CONCAVE` for the edge from corner s to corner s + 1.
    - `ends` (t, 3) int: the same for corner s: `CONCAVE` where a concave crease of the patch passes or ends.

    Its attributes:
    - `items` (k,) int: the triangles that are not flat; only these are kept, by patch, and near ones after each other.
    """

    def __init__(
        self, corners: np.ndarray, patch: np.ndarray, normals: np.ndarray, edges: np.ndarray, ends: np.ndarray
    ) -> None:
        corners = np.asarray(corners, float)
        sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        flat = _FLAT * np.abs(corners).max() * longest
        items = np.flatnonzero(np.linalg.norm(sides, axis=1) > flat)
        source, corners, normals, edges, ends, *tips = _divided_at_tips(
            *(np.asarray(array)[items] for array in (corners, normals, edges, ends))
        )
        items = items[source]
        kept = curve_order(corners.mean(axis=1))
        kept = kept[np.argsort(np.asarray(patch)[items[kept]], kind="stable")]
        self.items = items[kept]
        self.corners, self.normals = corners[kept], normals[kept]
        self.patch: np.ndarray = np.asarray(patch)[self.items]
        self.edges, self.ends = edges[kept], ends[kept]
        self._tips = tuple(values[kept] for values in tips)
        self._known: WeakKeyDictionary[Workspace, dict[object, tuple[object, ...]]] = WeakKeyDictionary()

    def __len__(self) -> int:
        return len(self.patch)

    def device_bytes(self, real: np.dtype) -> int:
        """Return about how many bytes the triangles, their normals and bins take on a device."""
        return len(self) * (36 * real.itemsize + 32) + 5 * LARGEST_SIDE**3 // 8

    def planes(self, frame: tuple[np.ndarray, float]) -> np.ndarray:
        """Return unit normals and levels of the triangles' planes in the coordinates of `frame`, (t, 4)."""
        corners = (self.corners - frame[0]) / frame[1]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return np.column_stack([normals, (normals * corners[:, 0]).sum(axis=1)])

    def corner_normals(self, scale: float, size: Callable[[np.ndarray], np.ndarray] | None) -> np.ndarray:
        """Return the normals at the corners, and by how much planes are moved inwards there, (t, 3, 4).

        - `scale`: unit of the shift.
        - `size`: size h of cells at points (k, 3), (k,); without it nothing is moved.
        """
        shift = np.zeros(self.edges.shape)
        tip, share, away = self._tips
        if size is not None:
            h = np.asarray(size(self.corners.reshape(-1, 3)), float).reshape(shift.shape)
            bend = mean_curvature(self.corners, self.normals)[:, None] * h
            bend = np.where((share < 1).any(axis=1, keepdims=True), np.clip(bend, -TIP_BEND, TIP_BEND), bend)
            shift = SAGITTA * bend * np.clip(1 + SAGITTA_SLOPE * bend, 0.5, 1.5) * h / scale
            share = np.clip(away / h, share, 1)
        normals = np.where(share[..., None] < 1, tip + share[..., None] * (self.normals - tip), self.normals)
        return np.concatenate([normals, shift[..., None]], axis=2)

    def arguments(self, engine: Engine, frame: tuple[np.ndarray, float]) -> tuple[object, ...]:
        """Return WALL_ARGS in the coordinates ``(x - origin) / scale`` of `frame`; see geometry/walls.h."""
        there = self._known.setdefault(engine.workspace, {})
        if engine.real not in there:
            origin, scale = frame
            corners = (self.corners - origin) / scale
            bins, shape, starts, listed, clear = bin_triangles(corners)
            kinds = np.concatenate([self.edges, self.ends], axis=1) @ (4 ** np.arange(6))
            there[engine.real] = (
                bins.astype(engine.real),
                shape,
                engine.upload(starts, np.int32),
                engine.upload(listed, np.int32),
                engine.upload(clear, np.uint8),
                engine.upload(np.concatenate([corners, np.zeros((len(self), 3, 1))], axis=2)),
                engine.upload(np.column_stack([self.patch, kinds]), np.int32),
            )
        return there[engine.real]

    def tree_arguments(self, engine: Engine, frame: tuple[np.ndarray, float]) -> tuple[object, ...]:
        """Return WALL_TREE_ARGS in the coordinates of `frame`; see geometry/wall_tree.h."""
        there, name = self._known.setdefault(engine.workspace, {}), ("tree", engine.real)
        if name not in there:
            corners = np.asarray((self.corners - frame[0]) / frame[1], engine.real)
            n = len(self)
            tree = Tree(corners.min(axis=1), corners.max(axis=1), order=np.arange(n))
            levels = [tree.starts(level) for level in range(tree.levels + 1)]
            first, last = (np.concatenate([ends[part] for ends in levels]) for part in (slice(-1), slice(1, None)))
            first, last = self.patch[first], self.patch[last - 1]
            boxes = np.zeros((len(first), 8))
            boxes[:, :3], boxes[:, 4:7] = tree.boxes[:, :3], tree.boxes[:, 3:]
            there[name] = (
                np.array([n, tree.levels], np.int32),
                engine.upload(boxes),
                engine.upload(np.where(first == last, first, -1), np.int32),
                engine.upload(self.planes(frame)),
            )
        return there[name]


def _divided_at_tips(
    corners: np.ndarray, normals: np.ndarray, edges: np.ndarray, ends: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Divide triangles at tips, so that normals can turn to that of the tip within h of it, not over whole triangles.

    Each is halved `TIP_STEPS` times towards the tip. Both triangles at a side are divided at the same points.

    Results:
    - `source` (m,) int: the triangle that each one is a part of.
    - `corners`, `normals`, `edges`, `ends` (m, 3, 3), (m, 3, 3), (m, 3), (m, 3): as for `WallTriangles`. Normals at new
      points are those at the end of their side.
    - `tip` (m, 3, 3) float: at new points the normal of the tip, elsewhere 0.
    - `share` (m, 3) float: how far new points are along their side from the tip, over its length; elsewhere 1.
    - `away` (m, 3) float: distance of new points from the tip; elsewhere 0.
    """
    own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    own /= np.linalg.norm(own, axis=1)[:, None]
    steep = np.einsum("tkd,td->tk", normals, own) < TIP_COSINE
    chosen = np.flatnonzero(steep.sum(axis=1) == 1)
    whole = np.setdiff1d(np.arange(len(corners)), chosen)
    # The tip comes first.
    turn = (steep[chosen].argmax(axis=1)[:, None] + np.arange(3)) % 3
    x, n = corners[chosen[:, None], turn], normals[chosen[:, None], turn]
    side, end = edges[chosen[:, None], turn], ends[chosen[:, None], turn]
    m, zero, steps = len(chosen), np.zeros(len(chosen), edges.dtype), 0.5 ** np.arange(TIP_STEPS + 1)
    point = x[:, :1, None] + steps[:, None] * (x[:, 1:, None] - x[:, :1, None])  # (m, 2, steps + 1, 3)
    length = np.linalg.norm(x[:, 1:] - x[:, :1], axis=2)
    last, one = TIP_STEPS, np.ones(m)
    # Corners of the parts: the tip as (-1, 0), others as a side and a step; kinds of sides.
    parts = [(((-1, 0), (0, last), (1, last)), (side[:, 0], zero, side[:, 2]))]
    for k in range(last):
        parts.append((((0, k + 1), (0, k), (1, k)), (side[:, 0], zero if k else side[:, 1], zero)))
        parts.append((((0, k + 1), (1, k), (1, k + 1)), (zero, side[:, 2], zero)))
    made: list[list[np.ndarray]] = [[corners[whole]], [normals[whole]], [edges[whole]], [ends[whole]]]
    made += [[np.zeros((len(whole), 3, 3))], [np.ones((len(whole), 3))], [np.zeros((len(whole), 3))]]
    for places, kinds in parts:
        is_new = [s >= 0 and k > 0 for s, k in places]
        of_part = (
            [x[:, 0] if s < 0 else point[:, s, k] for s, k in places],
            [n[:, s + 1] for s, _ in places],
            kinds,
            [side[:, 2 * s] if new else end[:, s + 1] for (s, _), new in zip(places, is_new, strict=True)],
            [n[:, 0] * new for new in is_new],
            [one * (steps[k] if new else 1) for (_, k), new in zip(places, is_new, strict=True)],
            [length[:, s] * steps[k] * new for (s, k), new in zip(places, is_new, strict=True)],
        )
        for values, of_corners in zip(made, of_part, strict=True):
            values.append(np.stack(of_corners, axis=1))
    source = np.concatenate([whole, np.tile(chosen, len(parts))])
    return source, *(np.concatenate(values) for values in made)


def mean_curvature(corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return half the divergence of `normals` (t, 3, 3) interpolated in triangles with `corners` (t, 3, 3), (t,).

    It is 1 / R on a ball of radius R, and 0 on planes.
    """
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice = np.linalg.norm(across, axis=1)
    opposite = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)
    slopes = np.cross((across / twice[:, None])[:, None], opposite) / twice[:, None, None]
    return (slopes * normals).sum(axis=(1, 2)) / 2


def bin_triangles(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sort triangles with `corners` (t, 3, 3) into bins.

    Results:
    - `frame` (4,) float: origin (3) and 1 / width of a bin.
    - `shape` (4,) int32: number of bins along x, y and z, and 0.
    - `starts` (bins + 1,) int32: place in `listed` of the first triangle of each bin; x runs fastest.
    - `listed`: the triangles that pass through each bin, or so near to it that round-off matters, in ascending order.
    - `clear` (bins,) uint8: number of steps from each bin to the next one with a triangle, at most 255.
    """
    lower, upper = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    extent = upper - lower
    side = np.clip(SIDE_PER_ROOT * np.sqrt(len(corners)), LEAST_SIDE, LARGEST_SIDE)
    width = extent.max() * (1 + 1e-6) / side
    counts = np.maximum(np.ceil(extent / width).astype(int), 1)
    x = (corners - lower) / width
    first = np.clip(np.floor(x.min(axis=1) - _SLACK), 0, counts - 1).astype(int)
    last = np.clip(np.floor(x.max(axis=1) + _SLACK), 0, counts - 1).astype(int)
    normals = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    found: list[np.ndarray] = []
    sizes = np.cumsum((last - first + 1).prod(axis=1))
    begin = 0
    while begin < len(x):
        before = sizes[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(sizes, before + _BLOCK)))
        number, z = ranges(first[begin:end, 2], last[begin:end, 2])
        row, y = ranges(first[begin:end, 1][number], last[begin:end, 1][number])
        number, z = number[row], z[row]
        row, along = ranges(first[begin:end, 0][number], last[begin:end, 0][number])
        number, y, z = number[row] + begin, y[row], z[row]
        middle = np.column_stack([along, y, z]) + 0.5
        off = np.abs(((middle - x[number, 0]) * normals[number]).sum(axis=1))
        near = off <= (0.5 + _SLACK) * np.abs(normals[number]).sum(axis=1)
        bins = (z[near] * counts[1] + y[near]) * counts[0] + along[near]
        found.append(np.column_stack([bins, number[near]]))
        begin = end
    pairs = np.concatenate(found)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    bins, listed = pairs[order].T
    starts = np.searchsorted(bins, np.arange(counts.prod() + 1))
    empty = (np.diff(starts) == 0).reshape(counts[::-1])
    steps = scipy.ndimage.distance_transform_cdt(empty, "chessboard")
    clear = np.minimum(np.asarray(steps, int), 255).astype(np.uint8)
    frame = np.array([*lower, 1 / width])
    return frame, np.array([*counts, 0], np.int32), starts.astype(np.int32), listed, clear.ravel()
