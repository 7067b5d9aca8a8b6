"""Parts of a solid that a mesh does not cover, and parts of its outside that it covers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from ...connectivity import components
from ..columns import Columns
from ..nearest_triangles import NearestTriangles
from ..surface import Surface

if TYPE_CHECKING:
    from .solid import Solid

FAR = 0.25
"""Distance of the surface from the walls of the mesh, or of these from it, over h: beyond it a part is measured."""
SPACING = 0.2
"""Distance of the points over h by which a part is measured."""
_MOST = 1 << 20
"""Such points around one place; if there were more, they are farther from each other."""


def uncovered(solid: Solid, walls: np.ndarray, sizes: np.ndarray, smallest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return parts between the surface of `solid` and the walls of a mesh of it; see `Domain.uncovered`.

    - `walls` (t, 3, 3) float: corners of the triangles of the mesh's walls, counter-clockwise from outside. They bound
      the cells without gaps.
    - `sizes` (t,) float: sizes h of the cells there.
    - `smallest`: volume over h^3 of the smallest parts, but for whole bodies and cavities.

    Results:
    - `measures` (k,) float: volumes: positive for parts of the solid, negative for parts of its outside. Whole bodies
      and cavities are exact, others are counted to about 0.01 h^3.
    - `places` (k, 3) float: a point in each.
    """
    mesh = NearestTriangles(
        Surface(walls.reshape(-1, 3), np.arange(3 * len(walls)).reshape(-1, 3)), np.arange(len(walls))
    )
    tree = scipy.spatial.KDTree(walls.mean(axis=1))
    # The surface far from walls.
    x, shell = _samples(solid, float(np.median(sizes)))
    away, row = tree.query(x)
    far = away > FAR * sizes[row]
    far[far] = mesh.feet(x[far], float(away.max()) * 1.01).distance > FAR * sizes[row[far]]
    count = solid.shells[0]
    lost = np.bincount(shell, ~far, count) == 0
    measures, places = [solid.shell_volumes[lost]], [_inside(solid, s) for s in np.flatnonzero(lost).tolist()]
    far &= ~lost[shell]
    # Walls far from the surface.
    middle = walls.mean(axis=1)
    off = solid.feet(middle, FAR * float(sizes.max()) * 1.01).distance > FAR * sizes
    seeds = np.concatenate([x[far], middle[off]])
    h = np.concatenate([sizes[row[far]], sizes[off]])
    if len(seeds):
        covered = Columns(walls)
        for mine in _clusters(seeds, h):
            volumes, spots = _measured(solid, covered, seeds[mine], float(h[mine].max()))
            large = np.abs(volumes) >= smallest * h[mine].max() ** 3
            measures.append(volumes[large])
            places.extend(spots[large])
    return np.concatenate(measures), np.array(places).reshape(-1, 3)


def _samples(solid: Solid, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the surface, no more than about h/2 from each other, (k, 3), and their shells (k,)."""
    corners, shell = solid.surface.corners, solid.shells[1]
    longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    steps = np.clip(np.ceil(2 * longest / h), 1, 256).astype(int)
    points, item = [], []
    for k in np.unique(steps).tolist():
        rows = np.flatnonzero(steps == k)
        i, j = np.nonzero(np.add.outer(np.arange(k), np.arange(k)) < k)
        weights = np.column_stack([i + 1 / 3, j + 1 / 3, k - i - j - 2 / 3]) / k
        points.append(np.einsum("sk,tkd->tsd", weights, corners[rows]).reshape(-1, 3))
        item.append(np.repeat(rows, len(weights)))
    x, shell = np.concatenate(points), shell[np.concatenate(item)]
    # One in each box of h / 4 is enough.
    key = np.column_stack([shell, np.floor((x - solid.lower) / (0.25 * h)).astype(np.int64)])
    kept = np.unique(key, axis=0, return_index=True)[1]
    return x[kept], shell[kept]


def _inside(solid: Solid, shell: int) -> np.ndarray:
    """Return a point (3,) inside a shell, which may be a cavity: behind the middle of its largest triangle."""
    mine = np.flatnonzero(solid.shells[1] == shell)
    corners = solid.surface.corners[mine]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    k = int(areas.argmax())
    inwards = -np.sign(solid.shell_volumes[shell]) * normals[k] / areas[k]
    begin = corners[k].mean(axis=0)
    others = Columns(corners)
    for step in np.sqrt(areas[k]) * 0.5 ** np.arange(1, 30):
        place = begin + step * inwards
        if others.winding(place[None])[0]:
            return place
    return begin


def _clusters(x: np.ndarray, h: np.ndarray) -> list[np.ndarray]:
    """Return the rows of points x (n, 3) that are near each other, in units of h (n,): one array for each place."""
    pairs = scipy.spatial.KDTree(x).query_pairs(float(h.max()), output_type="ndarray")
    pairs = pairs[np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1) < h[pairs].min(axis=1)]
    count, part = components(len(x), *pairs.T)
    order = np.argsort(part, kind="stable")
    return np.split(order, np.searchsorted(part[order], np.arange(1, count)))


def _measured(solid: Solid, covered: Columns, seeds: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Return volumes (k,), with signs, and places (k, 3) of the parts around `seeds` (n, 3)."""
    lower, upper = seeds.min(axis=0) - 1.5 * h, seeds.max(axis=0) + 1.5 * h
    step = max(SPACING * h, float(np.cbrt(np.prod(upper - lower) / _MOST)))
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(lower, upper, strict=True)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    shape, x = x.shape[:3], x.reshape(-1, 3)
    wanted, there = solid.covers(x), covered.winding(x) > 0
    measures, places = [], []
    for sign, missing in ((1, wanted & ~there), (-1, there & ~wanted)):
        part = scipy.ndimage.label(missing.reshape(shape))[0]
        depth = scipy.ndimage.distance_transform_edt(np.pad(missing.reshape(shape), 1))[1:-1, 1:-1, 1:-1]
        # Other parts near here belong to other seeds, or are thin.
        rows = np.flatnonzero(missing)
        if not len(rows):
            continue
        away, nearest = scipy.spatial.KDTree(x[rows]).query(seeds)
        labels = np.unique(part.ravel()[rows[nearest[away < 2 * step]]])
        measures += (sign * step**3 * np.bincount(part.ravel())[labels]).tolist()
        places += [x[np.ravel_multi_index(at, shape)] for at in scipy.ndimage.maximum_position(depth, part, labels)]
    return np.array(measures), np.array(places).reshape(-1, 3)
