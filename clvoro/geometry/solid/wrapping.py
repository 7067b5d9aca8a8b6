"""A closed surface around triangles that bound no region, or have details finer than cells.

The distance from the triangles is sampled on a grid. Places farther than `reach` from them that are connected with the
border of the grid, or with a point inside, are the space around them, and a surface bounds it. A second surface lies
`reach` - `off` outside of that space, so that it is `off` away from the triangles where no ball of the radius `reach`
is kept from touching them. It closes holes and gaps up to 2 `reach` wide, and makes plates of sheets. Source of the two
steps: closing of sets, Serra (1982), Image Analysis and Mathematical Morphology.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from functools import cached_property
from numbers import Real

import numpy as np
import scipy

from ...arguments import format_point
from ...errors import InputError
from ..nearest_triangles import NearestTriangles
from ..surface import Skin, Surface
from ..triangles import NamedTriangles, areas_of, packed_weights
from .checks import repeated_triangles
from .combining import boolean, library
from .creases import connect, pair_sides

_OFF = 0.5
"""Distance of the closed surface from the triangles, over `reach`."""
_STEP, _EDGE = 3, 1.5
"""Grid points per reach; length of edges of the wrap in steps of the grid."""
_SHEAR = np.array([(1, 0, 0), (0.17, 1, 0), (0.11, 0, 1)])
_UNSHEARED = np.linalg.inv(_SHEAR)
"""The library sees positions times this matrix: its level sets crash, at times, at large planes x = constant."""
_SIMPLER = (0.1, 0.05, 0)
"""How far triangles may move so that fewer are left, in steps of the grid. The first distance is taken after which the
surface does not cross itself."""
_SPACING, _APART = 1.0, 0.25
"""Distances are those to the triangle of the nearest sample. Longest edge of the parts of triangles that have a sample,
and edge of the cubes that keep one of their samples, in steps of the grid."""
_LEAF = 24
"""Samples in a leaf of the k-d tree that finds the nearest one."""
_MOST = 50_000_000
"""Most points of a grid."""
_SNAP = 0.25
"""A vertex moves onto the border of a group if that is nearer to it along an edge than this share of the edge."""
_FACING = 0.5
"""A point above a triangle counts as nearer to its group than a point as far away beside it, by this share of the
height: a side that faces a place of the wrap gives it its group."""
_SMOOTHINGS = 3
"""How often vertices at borders of groups move halfway to the middle between those beside them."""
_ISLAND = 1.0
"""Parts of groups with less area than that of a square with edges this times `reach` go to what is around them."""
_BISECTIONS = 10
"""How often the width of a leak is halved."""


def kept_groups(name: str, names: object, groups: tuple[str, ...]) -> list[str]:
    """Return the groups of triangles that `names` mentions; the wrap keeps their boundaries."""
    parts = names.values() if isinstance(names, Mapping) else ()
    walls = [wall for part in parts for wall in (part if isinstance(part, list | tuple) else [part])]
    kept = list(dict.fromkeys(wall for wall in walls if isinstance(wall, str)))
    unknown = [wall for wall in kept if wall not in (*groups, "wall")]
    if unknown:
        raise InputError(
            f"{name} names has {unknown[0]!r}, expected a group, {', '.join(groups)}, or wall, which a wrap has "
            "for all groups that names does not mention"
        )
    return [wall for wall in kept if wall in groups and len(groups) > 1]


def wrapped(skin: Skin, reach: float, inside: Sequence[float] | None, kept: list[str], rest: str) -> Skin:
    """Return a closed surface around all triangles. Each place of it has the group of the nearest triangle.

    - `inside`: a point: the surface is that of the space around it
    - `kept`: the groups that stay; others become one with the name `rest`.

    Raises `InputError` if `reach` is no length, longer than the surface, or so small that the grid would have too many
    points; if `inside` is no point in a space that triangles close off up to gaps 2 `reach` wide; or if a group has no
    place. Raises `MissingLibraryError` if manifold3d is not installed.
    """
    surface, groups, names, done = skin
    name = surface.name
    middle = (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
    near = Surface(surface.vertices - middle, surface.triangles, name)  # round-off as at the origin
    grid = _grid_around(near, reach)
    reach, step, samples = float(reach), grid.step, _Samples(near, grid.step)
    away = grid.distance(samples, 2 * reach)
    space = grid.space(away, reach, inside, middle, near)
    sign = -1 if inside is None else 1
    first = grid.level(name, sign * np.where(space, away - reach, -np.abs(away - reach)), _SIMPLER[0])
    depth = np.where(space, 0, grid.distance(_Samples(first, step), 1.5 * reach, ~space))
    place = np.zeros(len(names), np.int64)
    place[[names.index(k) for k in kept]] = 1 + np.arange(len(kept))
    made, group = _with_groups(grid.level(name, sign * ((1 - _OFF) * reach - depth)), near, place[groups], reach)
    names = ("rest" if rest in kept else rest, *kept)
    for share in _SIMPLER:
        result = boolean("+", NamedTriangles(made.vertices, made.triangles, group, names), simpler=share * step)
        closed = Surface(result.vertices + middle, result.triangles, name)
        if not (len(repeated_triangles(closed.welded[1])) or len(closed.crossings())):
            break
    group = result.numbers(names)
    lost = [names[g] for g in range(1, len(names)) if not (group == g).any()]
    if lost:
        raise InputError(
            f"{name} has no place for {lost[0]!r} on its wrap, which is nearer to other groups, or larger; "
            "leave out that group or its file, or use a smaller wrap"
        )
    off = samples.distance(result.vertices).max()
    return Skin(closed, group, names, (*done, f"wrapped, at most {off:.3g} away from what was given"))


def _grid_around(surface: Surface, reach: float) -> _Sampled:
    """Return a grid that reaches beyond the wrap of a surface, or raise `InputError` if `reach` does not fit to it."""
    if isinstance(reach, bool) or not (isinstance(reach, Real) and 0 < reach < math.inf):
        raise InputError(f"{surface.name} wrap is {reach!r}, expected a length")
    if reach > (longest := float(np.ptp(surface.vertices, axis=0).max())):
        raise InputError(
            f"{surface.name} wrap is {reach:g}, longer than the surface, {longest:g}; give it in the unit of the "
            "solid, which is meters with `units`"
        )
    step = float(reach) / _STEP
    low = surface.vertices.min(axis=0) - reach - 3 * step
    shape = np.ceil((surface.vertices.max(axis=0) + reach + 3 * step - low) / step) + 1
    if (count := math.prod(shape.tolist())) > _MOST:
        least = reach * (count / _MOST) ** (1 / 3)
        raise InputError(
            f"{surface.name} wrap is {reach:g}, which is too small for its extent; use {least:.2g} or more"
        )
    return _Sampled(low, step, shape.astype(int))


class _Sampled:
    """Points `step` apart."""

    def __init__(self, low: np.ndarray, step: float, shape: np.ndarray) -> None:
        self.low, self.step, self.shape = low, step, shape

    def distance(self, to: _Samples, reach: float, where: np.ndarray | None = None) -> np.ndarray:
        """Return the distance of each grid point from a surface; farther ones, and those not `where`, have `reach`."""
        free = np.ones(self.shape, bool)
        free[tuple(np.rint((to.points - self.low) / self.step).astype(int).T)] = False
        near = scipy.ndimage.distance_transform_edt(free, self.step) < reach
        if where is not None:
            near &= where
        found = np.full(self.shape, reach)
        found[near] = np.minimum(to.distance(self.low + self.step * np.argwhere(near)), reach)
        return found

    def space(
        self, away: np.ndarray, reach: float, inside: Sequence[float] | None, middle: np.ndarray, surface: Surface
    ) -> np.ndarray:
        """Return which grid points are outside of a surface, or in the closed space around a point, (i, j, k) bool.

        - `away`: distances of all points from the surface
        - `inside`: a point; the origin of the surface lies at `middle`
        """
        part = scipy.ndimage.label(away > reach)[0]
        if inside is None:
            return part == part[0, 0, 0]
        at = self.place(f"{surface.name} inside", inside, middle)
        if not part[at]:
            raise InputError(
                f"{surface.name} inside is {format_point(inside)}, {away[at]:.3g} from the surface, expected a point "
                f"farther from it than wrap, {reach:g}"
            )
        if part[at] == part[0, 0, 0]:
            where, width = self.leak(away > reach, at)
            where = np.clip(where, surface.vertices.min(axis=0), surface.vertices.max(axis=0))
            raise InputError(
                f"{surface.name} inside is {format_point(inside)}, from where a gap {width:.3g} wide leads out at "
                f"{format_point(middle + where)}, expected a space that is closed but for gaps up to 2 wrap, "
                f"{2 * reach:g}; close it, or pass repair=True, which closes flat holes"
            )
        return part == part[at]

    def place(self, what: str, point: Sequence[float], origin: np.ndarray) -> tuple[int, ...]:
        """Return the indices of the grid point nearest to a point that is given with another origin."""
        x = np.array(point, float) if np.shape(point) == (3,) else np.full(3, math.nan)
        at = np.rint((x - origin - self.low) / self.step)
        if not ((at >= 0) & (at < self.shape)).all():
            low, high = (format_point(origin + self.low + k * self.step * self.shape) for k in (0, 1))
            raise InputError(f"{what} is {point!r}, expected a point, three numbers, from {low} to {high}")
        return tuple(at.astype(int).tolist())

    def leak(self, free: np.ndarray, at: tuple[int, ...]) -> tuple[np.ndarray, float]:
        """Return the place (3,) and the width of the widest way from a grid point to the border of the grid.

        Balls of growing radii are kept from passing it, until the point has no way any more.
        """
        room = scipy.ndimage.distance_transform_edt(free)
        while True:  # to the middle of the space around the point
            block = tuple(slice(max(k - 1, 0), k + 2) for k in at)
            best = np.unravel_index(room[block].argmax(), room[block].shape)
            ahead = tuple(part.start + int(k) for part, k in zip(block, best, strict=True))
            if not room[ahead] > room[at]:
                break
            at = ahead
        edge = np.ones(room.shape, bool)
        edge[1:-1, 1:-1, 1:-1] = False
        low, high = 0.0, float(room[at])
        for _ in range(_BISECTIONS):
            radius = (low + high) / 2
            label = scipy.ndimage.label(room > radius)[0]
            if (label[edge] == label[at]).any():
                low = radius
            else:
                high = radius
        label = scipy.ndimage.label(room > low)[0]
        passage = label == label[at]
        label = scipy.ndimage.label(room > high)[0]
        beyond = np.isin(label, np.unique(label[edge & passage])[1:]) & passage | edge & passage
        here = (label == label[at]) & (label > 0)
        here[at] = True
        narrow = scipy.ndimage.label(passage & ~beyond & ~here)[0]
        near = scipy.ndimage.binary_dilation(here)
        gate = np.isin(narrow, np.unique(narrow[near & (narrow > 0)])) & (narrow > 0)
        gate &= scipy.ndimage.binary_dilation(beyond)
        found = np.argwhere(gate)
        place = found[0] if len(found) else np.array(at)
        return self.low + self.step * place, 2 * self.step * (low + _STEP)

    @cached_property
    def _bounds(self) -> list[float]:
        """Corners of the box in which the library finds surfaces, sheared."""
        corners = self.low + self.step * np.array([np.full(3, 0.5), self.shape - 1.5])
        return (corners @ _SHEAR).ravel().tolist()

    @cached_property
    def _places(self) -> np.ndarray:
        """The points (3, n) at which the library asks for values, in its order, in steps of the grid."""
        asked = array("d")

        def note(*x: float) -> float:
            asked.extend(x)
            return -1.0

        library().Manifold.level_set(note, self._bounds, _EDGE * self.step)
        return (np.frombuffer(asked).reshape(-1, 3) @ _UNSHEARED - self.low).T / self.step

    def level(self, name: str, values: np.ndarray, simpler: float = 0.0) -> Surface:
        """Return the surface where `values` on the grid are 0, around those above, which are not at its border."""
        found = iter(scipy.ndimage.map_coordinates(values, self._places, order=1, mode="nearest").tolist())
        made = library().Manifold.level_set(lambda *_: next(found), self._bounds, _EDGE * self.step)
        mesh = (made.simplify(simpler * self.step) if simpler else made).to_mesh64()
        vertices = np.array(mesh.vert_properties)[:, :3] @ _UNSHEARED
        return Surface(vertices, np.array(mesh.tri_verts, np.int64), name)


def _with_groups(made: Surface, given: Surface, groups: np.ndarray, reach: float) -> tuple[Surface, np.ndarray]:
    """Return a surface with edges where it is as near to one group of a given surface as to the others, and its groups.

    Parameters
    ----------
    groups : (t,) int
        Groups of the triangles of `given`.
    """
    vertices, triangles = made.vertices.copy(), made.triangles
    group = np.zeros(len(triangles), np.int64)
    for number in range(1, int(groups.max()) + 1):
        mine = groups == number
        of, rest = (Surface(given.vertices, given.triangles[part]) for part in (mine, ~mine))
        nearer = _away(rest, vertices, 2 * reach) - _away(of, vertices, 2 * reach)
        ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        a, b = np.unique(ends, axis=0).T
        cut = nearer[a] * nearer[b] < 0
        a, b = np.where((np.abs(nearer[a]) < np.abs(nearer[b]))[cut], (a[cut], b[cut]), (b[cut], a[cut]))
        share = nearer[a] / (nearer[a] - nearer[b])
        for k in np.argsort(share, kind="stable").tolist():
            if share[k] < _SNAP and nearer[a[k]] * nearer[b[k]] < 0:
                vertices[a[k]] += share[k] * (vertices[b[k]] - vertices[a[k]])
                nearer[a[k]] = 0
        vertices, triangles, nearer, parent = _split(vertices, triangles, nearer)
        group = group[parent]
        group[(group == 0) & (nearer[triangles].sum(axis=1) > 0)] = number
    group = _without_islands(Surface(vertices, triangles), group, (_ISLAND * reach) ** 2)
    side, twin = np.arange(3 * len(triangles)), pair_sides(vertices, triangles)[0]
    side = side[group[side // 3] != group[twin // 3]]
    a, b = triangles[side // 3, side % 3], triangles[side // 3, (side + 1) % 3]  # each edge in both directions
    inner = np.bincount(a, minlength=len(vertices)) == 2
    for _ in range(_SMOOTHINGS):
        around = np.column_stack([np.bincount(a, vertices[b, k], len(vertices)) for k in range(3)])
        vertices[inner] = (vertices[inner] + around[inner] / 2) / 2
    return Surface(vertices, triangles), group


def _split(
    vertices: np.ndarray, triangles: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Divide triangles where linear values at vertices change their sign.

    Returns
    -------
    vertices, triangles, values : arrays
    parent : (t,) int
        The triangle that each one is a part of.
    """
    ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges, edge = np.unique(ends, axis=0, return_inverse=True)
    edge = edge.reshape(-1, 3)
    a, b = edges.T
    cut = values[a] * values[b] < 0
    middle = np.where(cut, len(vertices) + np.cumsum(cut) - 1, -1)
    a, b = a[cut], b[cut]
    share = (values[a] / (values[a] - values[b]))[:, None]
    vertices = np.concatenate([vertices, vertices[a] + share * (vertices[b] - vertices[a])])
    values = np.concatenate([values, np.zeros(len(a))])
    count = cut[edge].sum(axis=1)
    made, parent = [triangles[count == 0]], [np.flatnonzero(count == 0)]
    # The first side is the one that is cut, or the one that is not.
    for number, wanted in ((1, True), (2, False)):
        rows = np.flatnonzero(count == number)
        turn = (np.arange(3) + (cut[edge[rows]] == wanted).argmax(axis=1)[:, None]) % 3
        i, j, k = np.take_along_axis(triangles[rows], turn, axis=1).T
        ij, jk, ki = middle[np.take_along_axis(edge[rows], turn, axis=1)].T
        parts = [(i, ij, k), (ij, j, k)] if wanted else [(i, j, jk), (i, jk, ki), (jk, k, ki)]
        made += [np.column_stack(part) for part in parts]
        parent += len(parts) * [rows]
    return vertices, np.concatenate(made), values, np.concatenate(parent)


def _without_islands(surface: Surface, group: np.ndarray, least: float) -> np.ndarray:
    """Return groups (t,) of which connected parts with less area than `least` have that of the longest border."""
    group, corners = group.copy(), surface.corners
    areas = areas_of(corners)
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).reshape(-1)
    side = np.arange(len(length))
    here, there = side // 3, pair_sides(surface.vertices, surface.triangles)[0] // 3
    while True:
        same = group[here] == group[there]
        count, part = connect(len(group), np.column_stack([here, there])[same])
        area = np.bincount(part, areas, count)
        beside = scipy.sparse.coo_array(
            (length[~same], (part[here[~same]], part[there[~same]])), (count, count)
        ).tocsr()
        smallest = next((p for p in np.argsort(area) if area[p] < least and beside[[p]].nnz), None)
        if smallest is None:
            return group
        other = beside[[smallest]].toarray().argmax()
        group[part == smallest] = group[np.flatnonzero(part == other)[0]]


def _away(surface: Surface, points: np.ndarray, reach: float) -> np.ndarray:
    """Return how far `points` (n, 3) are from a surface, up to `reach`, (n,): less where it faces them.

    So the surface that faces them is the nearer one where two have the same nearest point, on their common edge.
    """
    feet = NearestTriangles(surface, np.arange(len(surface))).feet(points, reach)
    a, b, c = np.moveaxis(surface.corners[feet.triangle], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    return np.minimum(feet.distance, reach) - _FACING * np.abs(
        np.einsum("nd,nd->n", points - feet.point, normal) * (feet.triangle >= 0)
    )


class _Samples:
    """Points all over a surface and their triangles, dense enough for a grid whose points are `step` apart."""

    def __init__(self, surface: Surface, step: float) -> None:
        corners, item, done = surface.corners, np.arange(len(surface)), []
        while len(corners):  # halve triangles across their longest sides
            length2 = ((np.roll(corners, -1, axis=1) - corners) ** 2).sum(axis=2)
            long = length2.max(axis=1) > (_SPACING * step) ** 2
            done.append((corners[~long].mean(axis=1), item[~long]))
            turn = (length2[long].argmax(axis=1)[:, None] + np.arange(3)) % 3
            a, b, c = np.moveaxis(np.take_along_axis(corners[long], turn[:, :, None], axis=1), 1, 0)
            middle = (a + b) / 2
            corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
            item = np.tile(item[long], 2)
        points, item = (np.concatenate(part) for part in zip(*done, strict=True))
        cube = np.floor((points - points.min(axis=0)) / (_APART * step)).astype(np.int64)
        first = np.unique(np.ravel_multi_index(tuple(cube.T), cube.max(axis=0) + 1), return_index=True)[1]
        self.points, self._item, self._rows = points[first], item[first], surface.rows
        self._tree = scipy.spatial.KDTree(self.points, _LEAF, compact_nodes=False, balanced_tree=False)

    def distance(self, x: np.ndarray) -> np.ndarray:
        """Return the distance of points `x` (n, 3) from the surface, (n,)."""
        return np.sqrt(packed_weights(x, self._rows[self._item[self._tree.query(x)[1]]])[2])
