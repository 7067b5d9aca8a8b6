"""Fixed generators: positions of the caller, such as those of wells, at which generators stay.

They have the first labels, 0, 1, ... Each of them takes the place of the nearest other generator when the finest level
begins. Coarser levels do not have them, as they may be close together for the cells there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from typing import Any

import numpy as np
import scipy
import shapely

from ..arguments import FIRST_ROWS, check_points, coincident_pair, counted, format_point, warn
from ..errors import InputError, InputTypeError, MismatchWarning
from ..geometry.domain import Domain
from ..geometry.fixed_generators import FixedGenerators
from ..geometry.geojson import geometries_of_geojson
from ..mesh.diagram import Diagram
from .tuning import AT_WALL, BEHIND_WALL, CANDIDATES, CLEARINGS, CLOSE, ON_WALL

_ROUND_OFF = 1e-5
"""Largest distance by which round-off in single precision moves a fixed generator, divided by the domain's extent."""


def check_fixed(fixed: object, domain: Domain, real: np.dtype) -> np.ndarray:
    """Return positions of fixed generators as a float64 array (k, d); k is 0 for None and for empty arrays.

    Raises `InputError` or `InputTypeError` if they are not an array of distinct positions inside `domain`.
    """
    if fixed is None:
        return np.empty((0, domain.dim))
    if isinstance(fixed, bool):
        raise InputTypeError(f"fixed is {fixed!r}, expected positions of generators, an array of shape (k, d)")
    if isinstance(fixed, str | PathLike | Mapping) or hasattr(fixed, "__geo_interface__"):
        fixed = list(geometries_of_geojson(fixed))
    if isinstance(next(iter(np.ravel(np.asarray(fixed, object))), None), shapely.Geometry):
        fixed = _coordinates(fixed)
    if not len(domain.check_rows("fixed", fixed)):
        return np.empty((0, domain.dim))
    array = check_points(fixed, domain, "fixed")
    if any(domain.periodic):
        array = domain.wrap(array)
    pair = coincident_pair(domain.place(array, real))
    if pair is not None:
        i, j = pair
        raise InputError(
            f"fixed[{i}] and fixed[{j}] coincide in {real} at {format_point(array[i])}, expected distinct generators; "
            f"keep the first of each: fixed[{FIRST_ROWS.format('fixed')}]"
        )
    return array


def _coordinates(points: object) -> np.ndarray:
    """Return the coordinates of shapely points: a Point, a MultiPoint, or a sequence of Points.

    Raises `InputTypeError` for other geometries.
    """
    parts = shapely.get_parts(np.atleast_1d(np.asarray(points, object)))
    other = [part for part in parts if not isinstance(part, shapely.Point) or part.is_empty]
    if other:
        raise InputTypeError(
            f"fixed has {other[0]!r:.60}, expected points: an array (k, d), Points of shapely, or GeoJSON"
        )
    return shapely.get_coordinates(parts, include_z=bool(len(parts) and shapely.has_z(parts).all()))


def check_room(points: np.ndarray, domain: Domain, free: Domain, rows: np.ndarray, h: np.ndarray) -> None:
    """Check that cells of the sizes `h` (k,) around `points` (k, d) have room.

    - `free`: the domain without layers.
    - `rows` (m, d) array: generators of layers.

    Raises `InputError` if a generator is in a layer, or on a wall.
    Warns with `MismatchWarning` if one is near a wall, or two are near each other, for the sizes there.
    """
    hidden = np.flatnonzero(~free.contains(points))
    if hidden.size:
        i = hidden[0]
        raise InputError(
            f"fixed[{i}] is at {format_point(points[i])}, in the layers or next to them, expected generators beyond "
            "them; move it, or leave out the layers of this wall"
        )
    depth = domain.boundary_distance(points) / h
    i = int(depth.argmin())
    if depth[i] < ON_WALL:
        raise InputError(
            f"fixed[{i}] is at {format_point(points[i])}, on a wall: {depth[i]:.2g} of the size there, {h[i]:.3g}, "
            f"away from it, expected at least {ON_WALL:g}: boundary faces would go through it; move it into the domain"
        )
    if depth[i] < AT_WALL:
        warn(
            f"fixed[{i}] is at {format_point(points[i])}, {depth[i] * h[i]:.3g} from a wall, where the size field is "
            f"{h[i]:.3g}: it is near the edge of its cell. Move it away from the wall, or use sizes of at most "
            f"{depth[i] * h[i] / AT_WALL:.2g} there",
            MismatchWarning,
        )
    everything = np.concatenate([points, rows])
    if len(everything) == 1:
        return
    x, periods = in_frame(everything, domain)
    distance, other = scipy.spatial.KDTree(x, boxsize=periods).query(x[: len(points)], k=2)
    near = distance[:, 1] * domain.frame[1] / h
    i = int(near.argmin())
    j = int(np.asarray(other)[i, 1])
    if near[i] < CLOSE:
        neighbor = f"fixed[{j}]" if j < len(points) else "a generator of the layers"
        warn(
            f"fixed[{i}] is at {format_point(points[i])}, {near[i] * h[i]:.3g} from {neighbor}, where the size field "
            f"is {h[i]:.3g}: they are near the edges of their cells. Use sizes of at most "
            f"{near[i] * h[i] / CLOSE:.2g} there",
            MismatchWarning,
        )


def check_beside_borders(pairs: FixedGenerators, domain: Domain, wells: np.ndarray) -> None:
    """Check that generators `wells` (k, d) of the caller are outside of the balls around the borders of `domain`.

    Raises `InputError` if one is too near to a border for the size there.
    """
    if domain.borders is None or not len(wells) or not len(pairs.centers):
        return
    gaps = np.linalg.norm(domain.wrap(wells)[:, None] - domain.wrap(pairs.centers), axis=2) / pairs.radii
    i, b = np.unravel_index(gaps.argmin(), gaps.shape)
    if gaps[i, b] < 1:
        raise InputError(
            f"fixed[{i}] is at {format_point(wells[i])}, {gaps[i, b] * pairs.radii[b]:.3g} from "
            f"{domain.borders.word} at {format_point(pairs.centers[b])}, expected at least {pairs.radii[b]:.3g} for "
            "the size there; move it or use smaller sizes"
        )


def place_in_corners(
    domain: Domain, free: Domain, wells: np.ndarray, rows: np.ndarray, size: Callable[[np.ndarray], np.ndarray], n: int
) -> FixedGenerators | None:
    """Return the generators around re-entrant corners and concave creases of `domain`, if there are any.

    - `free`: the domain without layers.
    - `wells`, `rows` (k, d) and (m, d) array: fixed generators of the caller, and those of layers.
    - `size`: sizes (n,) at points (n, d).
    - `n`: number of cells: where they are too few, there are none.

    Warns with `MismatchWarning` if there is no room for them, or a generator of the caller is among them; says where.
    """
    others = np.concatenate([wells, rows])
    around = domain.stations(size, free, others)
    if around is None or (around.least_cells and len(others) + around.least_cells * len(around) > n):
        return None
    if len(around.left_out):
        x = around.left_out[0]
        warn(
            f"cells have no room at {counted(len(around.left_out), 'place')} on concave creases, the first at "
            f"{format_point(x)}: another crease or wall is near or meets it at a small angle, for the size there, "
            f"{float(np.asarray(size(x[None]))[0]):.3g}. Cells may be concave; use smaller sizes around it",
            MismatchWarning,
        )
    if len(wells) and len(around.centers):
        gaps = np.linalg.norm(wells[:, None] - around.centers, axis=2) / around.radii
        i, b = np.unravel_index(gaps.argmin(), gaps.shape)
        if gaps[i, b] < 1:
            warn(
                f"fixed[{i}] is at {format_point(wells[i])}, {gaps[i, b] * around.radii[b]:.3g} from a concave crease, "
                f"expected at least {around.radii[b]:.3g}: cells there may be concave. Move it, or use smaller sizes",
                MismatchWarning,
            )
    return around


def in_frame(points: np.ndarray, domain: Domain) -> tuple[np.ndarray, np.ndarray | None]:
    """Return `points` in the device's coordinates and float64, and the periods (d,) for `KDTree`, if there are any."""
    x, real = domain.place(points, np.dtype(np.float64)), np.dtype(np.float64)
    return x, domain.periods(real) if any(domain.periodic) else None


def take_places(
    points: np.ndarray, labels: np.ndarray, fixed: np.ndarray, domain: Domain, n_fixed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return generators and labels in which those at `fixed` (k, d) have taken the places of the nearest others.

    - `points` (n, d) real: in the device's coordinates.
    - `labels`: (n,) int32
    - `n_fixed`: generators with smaller labels, those of layers, stay.

    Results:
    - points, labels: more than `n` rows if there are too few others.
    - `taken` (k,) int32: labels of those whose places they have taken; -1 for none.
    """
    taken = find_places(points, labels, fixed, domain, n_fixed)
    return *put_fixed(points, labels, fixed, taken, domain), taken


def find_places(points: np.ndarray, labels: np.ndarray, fixed: np.ndarray, domain: Domain, n_fixed: int) -> np.ndarray:
    """Return the labels of the nearest others, as `take_places`."""
    x, periods = in_frame(fixed, domain)
    others = np.flatnonzero(labels >= n_fixed)
    places = np.full(len(fixed), -1)
    while (places < 0).any() and len(others):
        waiting = np.flatnonzero(places < 0)
        count = min(CANDIDATES, len(others))
        tree = scipy.spatial.KDTree(points[others].astype(np.float64), boxsize=periods, balanced_tree=False)
        near = tree.query(x[waiting], k=count)
        distance, index = (np.reshape(found, (-1, count)) for found in near)
        origin, scale = domain.frame
        seen = domain.sees(fixed[waiting, None], points[others[index]] * scale + origin)
        distance = np.where(seen, distance, BEHIND_WALL * distance)
        used = np.zeros(len(others), bool)
        for k in np.argsort(distance, axis=None, kind="stable").tolist():
            row, candidate = waiting[k // count], index.flat[k]
            if places[row] < 0 and not used[candidate]:
                places[row], used[candidate] = others[candidate], True
        others = others[~used]
    return np.where(places >= 0, labels[places], -1).astype(np.int32)


def put_fixed(
    points: np.ndarray, labels: np.ndarray, fixed: np.ndarray, taken: np.ndarray, domain: Domain, last: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Return generators and labels, of a part of all, with fixed ones in place of those with the labels `taken` (k,).

    The `last` part has those, too, that take no place.
    """
    points, labels = points.copy(), labels.copy()
    positions, names = domain.place(fixed, points.dtype), np.arange(len(fixed), dtype=labels.dtype)
    _, rows, mine = np.intersect1d(labels, taken, assume_unique=False, return_indices=True)
    points[rows], labels[rows] = positions[mine], names[mine]
    new = np.flatnonzero((taken < 0) & last)
    return np.concatenate([points, positions[new]]), np.concatenate([labels, names[new]])


def near_places(points: np.ndarray, fixed: np.ndarray, domain: Domain) -> np.ndarray:
    """Return the rows of those of `points` (n, d), of a part of all, that may have to give their places, (k,) int."""
    x, periods = in_frame(fixed, domain)
    count = min(CANDIDATES + len(fixed), len(points))
    tree = scipy.spatial.KDTree(points.astype(np.float64), boxsize=periods)
    return np.unique(tree.query(x, k=max(count, 1))[1]) if count else np.empty(0, int)


def clear_balls(
    points: np.ndarray, labels: np.ndarray, around: FixedGenerators, domain: Domain, n_fixed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return generators and labels without those in the balls of `around`: they move out, or are left out.

    Parameters and returned arrays are as those of `take_places`.
    """
    if not len(around.centers):
        return points, labels
    origin, scale = domain.frame
    centers, radii = (around.centers - origin) / scale, around.radii / scale
    period = domain.periods(np.dtype(np.float64)) if any(domain.periodic) else np.zeros(domain.dim)

    def folded(x: np.ndarray) -> np.ndarray:
        return np.where(period > 0, np.mod(x, np.where(period > 0, period, 1.0)), x)

    tree = scipy.spatial.KDTree(folded(centers), boxsize=period)
    moving = np.flatnonzero(labels >= n_fixed)
    x = points[moving].astype(np.float64)
    here: Any = np.arange(len(x))
    for _ in range(CLEARINGS):
        near = tree.query_ball_point(folded(x[here]), radii.max())
        row = np.repeat(here, [len(balls) for balls in near])
        ball = np.concatenate([np.empty(0, int), *(np.array(balls, int) for balls in near)]).astype(int)
        way = x[row] - centers[ball]
        way -= period * np.rint(way / np.where(period > 0, period, np.inf))
        depth = np.linalg.norm(way, axis=1) / radii[ball]
        inner = depth < 1 - 1e-9
        row, way, depth = row[inner], way[inner], depth[inner]
        # Out of the ball of which the generator is deepest inside.
        order = np.argsort(depth, kind="stable")
        here, first = np.unique(row[order], return_index=True)
        chosen = order[first]
        if not len(here):
            break
        x[here] += way[chosen] * (1 / np.maximum(depth[chosen], 1e-3) - 1)[:, None]
    inside = domain.contains(x * scale + origin)
    inside[here] = False
    points = points.copy()
    points[moving[inside]] = domain.place(x[inside] * scale + origin, points.dtype)
    kept = np.ones(len(points), bool)
    kept[moving[~inside]] = False
    return points[kept], labels[kept]


def put_back(diagram: Diagram, domain: Domain, fixed: np.ndarray) -> None:
    """Give the first generators of a `diagram` of `domain` their positions `fixed` (k, d), unless they have moved."""
    if len(fixed):
        points = diagram.points.copy()
        near = np.abs(points[: len(fixed)] - fixed).max(axis=1) < _ROUND_OFF * domain.extent.max()
        points[: len(fixed)][near] = fixed[near]
        diagram.put_points(points)


def origins(labels: np.ndarray, started: int, taken: np.ndarray) -> np.ndarray:
    """Return the index in the points at the start for generators with `labels` (n,) in ascending order, or -1, (n,).

    - `started`: number of labels at the start: first those of the k fixed generators.
    - `taken` (k,) int32: labels of those whose places fixed generators have taken, or -1.
    """
    k = len(taken)
    before = np.where(labels < k, np.append(taken, -1)[np.minimum(labels, k)], labels)
    return np.where((before >= k) & (before < started), before - k, -1).astype(np.int32)
