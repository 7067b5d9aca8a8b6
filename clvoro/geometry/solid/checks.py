"""What is wrong with a surface that should bound a solid, where, and how it is mended."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import scipy
import shapely

from ...arguments import check_number, counted, format_point
from ...errors import InputError
from ..columns import Columns
from ..surface import Skin, Surface
from ..triangles import NamedTriangles
from .combining import boolean, library
from .creases import connect, pair_sides, triangle_normals

_FLAT = 1e-3  # of the extent of a hole: how far it may deviate from a plane; of a voxel: from a lattice
_UNEVEN, _SMALL = 0.05, 0.5  # the same of holes up to half as large as their part: the ends of scanned vessels
_APART = 1e-6  # of the diagonal: how far from a triangle its two sides are examined
_LARGEST_GAP = 1e-3  # of the diagonal: gaps that `join` may close
_SHARPEST = 10.0  # degrees
_VOXELS = 50, 10  # patches of a surface of voxels at least, and sides of voxels in half of its patches at most
_PLANES = 5  # of a surface of voxels along each axis at least
_NAMED = 3  # pairs of parts with open edges that a message names
_OR_WRAP = "Or pass wrap=, two thirds of the size of cells, for a closed surface around all triangles"


def closing_distance(surface: Surface) -> float | None:
    """Return a distance of joined vertices that closes an open surface up to duplicate triangles, or None."""
    edges = surface.open_edges
    places = np.unique(edges)
    if len(places) < 2:
        return None
    points = surface.vertices[places]
    gaps = np.unique(scipy.spatial.KDTree(points).query(points, k=2)[0][:, 1])
    diagonal = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    gaps = gaps[(gaps > 0) & (gaps <= _LARGEST_GAP * diagonal)]
    for gap in (gaps[-1:], gaps[len(gaps) // 2 : len(gaps) // 2 + 1]):
        if gap.size:
            join = float(f"{1.1 * gap[0]:.2g}")
            vertices, triangles = Surface(surface.vertices, surface.triangles, surface.name, join).welded
            triangles = triangles[(triangles != np.roll(triangles, -1, axis=1)).all(axis=1)]
            triangles = np.delete(triangles, repeated_triangles(triangles), axis=0)
            if len(triangles) and Surface(vertices, triangles).closed:
                return join
    return None


def repeated_triangles(triangles: np.ndarray) -> np.ndarray:
    """Return the triangles (t, 3) that have the same corners as an earlier one, (k,) int."""
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    return np.setdiff1d(np.arange(len(triangles)), first)


def _closed_by(surface: Surface, parts: Sequence[str]) -> str:
    """Return how an open surface can be closed, as a sentence: by `join`, by a repair, or by other options.

    - `parts` (t,) str: the part of each triangle.
    """
    join = closing_distance(surface)
    if join is not None:
        return f"Here join={join:g} closes it"
    mended = repaired(Skin(surface, np.zeros(len(surface), np.int64), ("wall",)))
    if mended.surface.closed:
        return f"Here repair=True closes it ({'; '.join(mended.done)})"
    others = "" if len(set(parts)) > 1 else "If other files close it, read them together: Solid.read([...]). "
    return (
        f"{others}The ground below a terrain is a solid with bottom=, a height. Sheets inside of a domain are for "
        f"with_surfaces. {_OR_WRAP}"
    )


def _gaps(surface: Surface, parts: Sequence[str]) -> str:
    """Return which parts have open edges, and how far those of the nearest other part are from them at most.

    - `parts` (t,) str: the part of each triangle.
    """
    names, part = np.unique(np.array(parts)[surface.open_sides // 3], return_inverse=True)
    if len(names) < 2:
        return f" All are of {names[0]}." if len(names) and len(set(parts)) > 1 else ""
    middles = surface.vertices[surface.open_edges].mean(axis=1)
    away = np.full((len(names), len(part)), math.inf)
    for k in range(len(names)):
        away[k, part != k] = scipy.spatial.KDTree(middles[part == k]).query(middles[part != k])[0]
    pair = np.sort(np.column_stack([part, away.argmin(axis=0)]), axis=1)
    pairs, count = np.unique(pair, axis=0, return_counts=True)
    found = []
    for k in np.argsort(-count, kind="stable")[:_NAMED]:
        mine = np.flatnonzero((pair == pairs[k]).all(axis=1))
        at = mine[away.min(axis=0)[mine].argmax()]
        apart, where = away[:, at].min(), format_point(middles[at])
        found.append(f"{count[k]} are between {' and '.join(names[pairs[k]])}, up to {apart:.3g} apart, at {where}")
    return f" Of these {'; '.join(found)}."


def require_bounding(skin: Skin, vertices: np.ndarray, triangles: np.ndarray, repair: bool = False) -> np.ndarray:
    """Raise unless the triangles (t, 3) bound a region with normals outwards; return the partners of their sides.

    - `skin`: as given, for messages.
    - `vertices`, `triangles`: the welded surface.
    - `repair`: whether the surface is repaired already, which is no remedy then.

    Raises `InputError` if the surface is open, has duplicate or flipped triangles, is inside out, or intersects itself.
    """
    surface = skin.surface
    name, mend = surface.name, _OR_WRAP if repair else "Or pass repair=True"
    repeated = repeated_triangles(triangles)
    if repeated.size:
        where = format_point(vertices[triangles[repeated[0]]].mean(axis=0))
        raise InputError(
            f"{name} has {len(repeated)} duplicate triangles, the first at {where}, expected each once; remove "
            f"them. {mend}"
        )
    if not surface.closed:
        parts = [skin.names[g] for g in skin.groups.tolist()]
        surface.require_closed(f".{_gaps(surface, parts)} {_closed_by(surface, parts)}")
    twin, bad = pair_sides(vertices, triangles)
    if bad.size:
        k, s = divmod(int(bad[0]), 3)
        raise InputError(
            f"{name} has {len(bad)} sides of triangles whose neighbors are oriented differently, the first at "
            f"{format_point(vertices[triangles[k, s]])}; expected all triangles counter-clockwise seen from outside; "
            f"flip the others. {mend}"
        )
    try:
        Surface(vertices, triangles, name).check()
    except InputError as error:
        united = "" if repair else "Parts that cross or touch each other are united by repair=True. "
        raise InputError(f"{error}. {united}{_OR_WRAP}") from None
    inner, outer = _sides_wound(vertices, triangles, twin)
    wrong = np.flatnonzero((inner != 1) | (outer != 0))
    if not wrong.size:
        return twin
    if (inner == 0).all() and (outer == -1).all():
        raise InputError(
            f"{name} is inside out: all its triangles are clockwise seen from outside; flip them with "
            "triangles[:, ::-1], or pass repair=True. For the region around it use Solid.outside"
        )
    raise InputError(
        f"{name} has parts that lie in each other: {len(wrong)} triangles do not have the inside on one side and the "
        f"outside on the other, the first at {format_point(vertices[triangles[wrong[0]]].mean(axis=0))}; expected "
        "normals outwards, of cavities too; pass repair=True, which makes parts cavities, or leave parts out"
    )


def _sides_wound(vertices: np.ndarray, triangles: np.ndarray, twin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the winding numbers just inside and just outside of each triangle, (t,) int each.

    They are the same on all of a part that crosses no other one: that of its largest triangle.
    """
    corners = vertices[triangles]
    normals, areas = triangle_normals(vertices, triangles, twin)
    apart = _APART * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    shells = _shells(twin)
    largest = np.array([shell[areas[shell].argmax()] for shell in shells])
    middle = corners[largest].mean(axis=1)
    columns = Columns(corners)
    sides = np.empty((2, len(triangles)), np.int64)
    for side, away in zip(sides, (-apart, apart), strict=True):
        wound = columns.winding(middle + away * normals[largest])
        for shell, winding in zip(shells, wound, strict=True):
            side[shell] = winding
    return sides[0], sides[1]


def volume_inside(corners: np.ndarray) -> float:
    """Return the volume inside of triangles (t, 3, 3), negative if their normals point inwards."""
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1)), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def voxel_width(vertices: np.ndarray, normals: np.ndarray, areas: np.ndarray, patch: np.ndarray) -> float | None:
    """Return the width of the voxels whose surface this is, with a crease at nearly each, or None.

    All triangles are at right angles to an axis, all vertices on a lattice, and most patches are a few of its squares.

    - `normals` (t, 3), `areas` (t,) float; `patch` (t,) int: of the triangles.
    """
    most, few = _VOXELS
    if patch.max() < most or (np.abs(normals).max(axis=1) < 1 - 1e-9).any():
        return None
    widths = np.empty(3)
    for axis, x in enumerate(vertices.T):
        gaps = np.diff(np.unique(x))
        gaps = gaps[gaps > _APART * np.ptp(x)]
        if len(gaps) < _PLANES - 1:  # a profile of steps, such as a heat sink
            return None
        widths[axis] = gaps.min()
        if np.abs(gaps / widths[axis] - np.rint(gaps / widths[axis])).max() > _FLAT:
            return None
    sides = areas * widths[np.abs(normals).argmax(axis=1)] / widths.prod()
    return float(widths.max()) if np.median(np.bincount(patch, sides)) <= few else None


def sharp_edges(angle: np.ndarray) -> np.ndarray:
    """Return the edges whose interior or exterior dihedral angle (e,) is below 10 degrees, (k,) int."""
    return np.flatnonzero(np.minimum(angle, 2 * math.pi - angle) < math.radians(_SHARPEST))


def repaired(skin: Skin) -> Skin:
    """Return a surface that is mended where that is certain.

    Vertices across small gaps are joined, triangles without three corners and duplicates are removed, flat holes are
    closed, each by a group of its own, hole-1, ..., neighbors are oriented alike, parts that cross or touch each other
    are united, and normals point out of the region, of cavities too.
    """
    surface, groups, names, _ = skin
    done: list[str] = []
    if not surface.closed:
        join = closing_distance(surface)
        if join is not None:
            done.append(f"joined vertices up to {join:g} apart")
            surface = Surface(surface.vertices, surface.triangles, surface.name, join)
    vertices, triangles = surface.welded
    whole = (triangles != np.roll(triangles, -1, axis=1)).all(axis=1)
    repeated = repeated_triangles(triangles[whole])
    rows = np.delete(np.flatnonzero(whole), repeated)
    folds = _folds(triangles[rows], triangles[whole][repeated])
    rows = np.delete(rows, folds)
    if repeated.size:
        done.append(f"removed {len(repeated) + len(folds)} duplicate triangles")
    triangles, groups = triangles[rows].copy(), groups[rows]
    caps = _caps(Surface(vertices, triangles))
    if caps:
        done.append("closed " + counted(len(caps), "flat hole"))
        groups = np.concatenate([groups, np.repeat(len(names) + np.arange(len(caps)), list(map(len, caps)))])
        names += tuple(f"hole-{k + 1}" for k in range(len(caps)))
        triangles = np.concatenate([triangles, *caps])
    turned = _flips(triangles)
    triangles[turned] = triangles[turned, ::-1]
    shells = _shells(pair_sides(vertices, triangles)[0])
    turned ^= _turn_outwards(vertices, triangles, shells, nested=False)
    met = _that_meet(Surface(vertices, triangles), shells)
    if not met:
        turned ^= _turn_outwards(vertices, triangles, shells, nested=True)
    if turned[: len(rows)].any():
        done.append("flipped " + counted(np.count_nonzero(turned[: len(rows)]), "triangle"))
    if met:
        done.append(f"united {len(met)} parts that cross or touch")
        vertices, triangles, groups = _united(vertices, triangles, groups, met)
        _turn_outwards(vertices, triangles, _shells(pair_sides(vertices, triangles)[0]), nested=True)
    return Skin(Surface(vertices, triangles, surface.name), groups, names, (*skin.done, *done))


def grounded(skin: Skin, bottom: float) -> Skin:
    """Return the surface of the ground below a sheet, down to the height z = `bottom`.

    Walls lead down from the open edges of the sheet. They and the bottom are the groups side and bottom.

    Raises `InputError` if the sheet has no open edges, is not above the bottom, or its border crosses itself seen from
    above.
    """
    surface, groups, names, done = skin
    check_number(f"{surface.name} bottom", bottom)
    vertices, triangles = surface.welded
    low = vertices[np.unique(triangles)][:, 2].min()
    if not bottom < low:
        raise InputError(f"{surface.name} bottom is {bottom:g}, expected a height below its lowest vertex, {low:g}")
    edges = Surface(vertices, triangles).open_edges
    rings = [ring for ring in _rings(edges) if len(ring) > 2]
    if not rings:
        raise InputError(f"{surface.name} has a bottom and no open edges, expected a sheet; leave out bottom")
    shapes = [shapely.Polygon(vertices[ring, :2]) for ring in rings]
    crossed = [k for k, shape in enumerate(shapes) if not shape.is_valid]
    if crossed:
        why = shapely.is_valid_reason(shapes[crossed[0]])
        raise InputError(f"{surface.name} has a border that crosses itself seen from above: {why}; expected a terrain")
    depth = [sum(other.contains(shape) for other in shapes if other is not shape) for shape in shapes]
    loops = [
        _counterclockwise(ring, shape)[:: 1 if inside % 2 == 0 else -1]
        for ring, shape, inside in zip(rings, shapes, depth, strict=True)
    ]
    flat = np.concatenate(loops)[library().triangulate([vertices[loop, :2] for loop in loops])].astype(np.int64)
    (a, b), under = edges.T, len(vertices)
    walls = np.concatenate([np.column_stack([b, a, a + under]), np.column_stack([b, a + under, b + under])])
    names = tuple(dict.fromkeys((*names, "side", "bottom")))
    added = np.repeat([names.index("side"), names.index("bottom")], [len(walls), len(flat)])
    vertices = np.concatenate([vertices, np.column_stack([vertices[:, :2], np.full(under, float(bottom))])])
    triangles = np.concatenate([triangles, walls, flat[:, ::-1] + under])
    return Skin(Surface(vertices, triangles, surface.name), np.concatenate([groups, added]), names, done)


def _united(
    vertices: np.ndarray, triangles: np.ndarray, groups: np.ndarray, shells: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, triangles and groups of a surface of which `shells` are replaced by their union."""
    names = [str(k) for k in range(int(groups.max()) + 1)]
    united = boolean("+", *(NamedTriangles(vertices, triangles[shell], groups[shell], names) for shell in shells))
    alone = np.setdiff1d(np.arange(len(triangles)), np.concatenate(shells))
    one = NamedTriangles.merged([united, NamedTriangles(vertices, triangles[alone], groups[alone], names)])
    return *Surface(one.vertices, one.triangles).welded, one.numbers(names)


def _folds(triangles: np.ndarray, repeated: np.ndarray) -> np.ndarray:
    """Return which triangles bound nothing, (k,) int: they were there twice, and have an edge with an odd number left.

    They are sheets of zero thickness, and walls between parts that touch.
    """
    known = np.sort(np.vstack([repeated, triangles]), axis=1)
    place = np.unique(known, axis=0, return_inverse=True)[1].reshape(-1)
    twice = np.isin(place[len(repeated) :], place[: len(repeated)])
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)
    _, edge, count = np.unique(np.sort(ends.reshape(-1, 2), axis=1), axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1, 3)
    folds = np.zeros(len(triangles), bool)
    while (found := twice & ~folds & (count[edge] % 2 == 1).any(axis=1)).any():
        count -= np.bincount(edge[found].reshape(-1), minlength=len(count))
        folds |= found
    return np.flatnonzero(folds)


def _caps(surface: Surface) -> list[np.ndarray]:
    """Return triangles that close the flat holes of a surface, (k, 3) int for each hole.

    A ring of open edges inside of another one in its plane bounds the same hole: the end of a hollow pipe.
    """
    caps = []
    rings = [ring for ring in _rings(surface.open_edges) if len(ring) > 2]
    ends = np.stack([surface.triangles, np.roll(surface.triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    part = connect(len(surface.vertices), ends)[1]
    planes = {}
    for k, ring in enumerate(rings):
        points, whole = surface.vertices[ring], np.ptp(surface.vertices[part == part[ring[0]]], axis=0).max()
        plane = _plane(points, _UNEVEN if np.ptp(points, axis=0).max() <= _SMALL * whole else _FLAT)
        if plane is not None:
            planes[k] = plane
    for k, (center, axes, tolerance) in list(planes.items()):
        away = (surface.vertices[part == part[rings[k][0]]] - center) @ axes[2]
        if np.abs(away).max() <= tolerance:
            del planes[k]  # the border of a flat sheet
    left = list(planes)
    while left:
        center, axes, tolerance = planes[left[0]]
        flat = {k: (surface.vertices[rings[k]] - center) @ axes.T for k in left}
        shapes = {k: shapely.Polygon(x[:, :2]) for k, x in flat.items() if np.abs(x[:, 2]).max() <= tolerance}
        shapes = {k: shape for k, shape in shapes.items() if shape.is_valid}
        left = [k for k in left[1:] if k not in shapes]
        around = {k: [o for o in shapes if o != k and shapes[o].contains(shapes[k])] for k in shapes}
        for k in (k for k in shapes if len(around[k]) % 2 == 0):
            inner = [o for o in shapes if k in around[o] and len(around[o]) == len(around[k]) + 1]
            loops = [
                _counterclockwise(rings[k], shapes[k]),
                *(_counterclockwise(rings[o], shapes[o])[::-1] for o in inner),
            ]
            places = [(surface.vertices[loop] - center) @ axes[:2].T for loop in loops]
            caps.append(np.concatenate(loops)[library().triangulate(places)].astype(np.int64))
    return caps


def _plane(points: np.ndarray, flat: float) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Return the plane nearest to points (n, 3): its center, axes (3, 3) and tolerance; None if points are farther.

    - `flat`: the tolerance over the extent of the points.
    """
    center = points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(points - center, full_matrices=False)
    tolerance = flat * float(np.ptp(points, axis=0).max())
    away = np.abs((points - center) @ axes[2]).max()
    return (center, axes, tolerance) if away <= tolerance < sizes[1] else None


def _counterclockwise(ring: np.ndarray, shape: shapely.Polygon) -> np.ndarray:
    return ring if shape.exterior.is_ccw else ring[::-1]


def _rings(edges: np.ndarray) -> list[np.ndarray]:
    """Return the rings of edges (k, 2) int that share ends, as vertices in turn, without edges in no ring."""
    at: dict[int, list[int]] = {}
    for a, b in edges.tolist():
        at.setdefault(a, []).append(b)
        at.setdefault(b, []).append(a)
    rings = []
    for first in list(at):
        while at[first]:
            ring = [first]
            while at[ring[-1]]:
                end = at[ring[-1]].pop()
                at[end].remove(ring[-1])
                if end == first:
                    rings.append(np.array(ring))
                    break
                ring.append(end)
            else:
                break
    return rings


def _shells(twin: np.ndarray) -> list[np.ndarray]:
    """Return the triangles of each closed part, (k,) int each, from the partners of sides; nothing if one has none."""
    if (twin < 0).any():
        return []
    count, shell = connect(len(twin) // 3, np.column_stack([np.arange(len(twin)), twin]) // 3)
    return np.split(np.argsort(shell, kind="stable"), np.cumsum(np.bincount(shell, minlength=count))[:-1])


def _turn_outwards(vertices: np.ndarray, triangles: np.ndarray, shells: list[np.ndarray], nested: bool) -> np.ndarray:
    """Turn normals out of each shell, or into those that are cavities if shells are `nested`; return which."""
    corners = vertices[triangles]
    turned = np.zeros(len(triangles), bool)
    spots = corners[[shell[0] for shell in shells]].mean(axis=1)
    depth = np.zeros(len(shells), np.int64)
    for s, shell in enumerate(shells if nested else ()):
        wound = np.abs(Columns(corners[shell]).winding(spots))
        wound[s] = 0
        depth += wound
    for shell, cavity in zip(shells, depth % 2 == 1, strict=True):
        if (volume_inside(corners[shell]) > 0) == cavity:
            triangles[shell] = triangles[shell, ::-1]
            turned[shell] = True
    return turned


def _that_meet(surface: Surface, shells: list[np.ndarray]) -> list[np.ndarray]:
    """Return the shells that cross or touch another one."""
    if len(shells) < 2:
        return []
    shell = np.empty(len(surface), np.int64)
    for s, triangles in enumerate(shells):
        shell[triangles] = s
    pairs = shell[surface.crossings()]
    return [shells[s] for s in np.unique(pairs[pairs[:, 0] != pairs[:, 1]])]


def _flips(triangles: np.ndarray) -> np.ndarray:
    """Return which triangles (t, 3) to flip so that neighbors are oriented like the first of their part, (t,) bool."""
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    forward = ends[:, 0] < ends[:, 1]
    _, place, count = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(place.reshape(-1), kind="stable")
    order = order[count[place.reshape(-1)[order]] == 2].reshape(-1, 2)
    pairs, alike = order // 3, forward[order[:, 0]] != forward[order[:, 1]]
    n = len(triangles)
    # Node k is triangle k as it is, node n + k is that triangle flipped.
    same, other = pairs[alike], pairs[~alike]
    links = np.concatenate([same, same + n, other + np.array([0, n]), other + np.array([n, 0])])
    label = connect(2 * n, links)[1]
    first = np.unique(label, return_index=True)[1]
    return first[label[:n]] > first[label[n:]]
