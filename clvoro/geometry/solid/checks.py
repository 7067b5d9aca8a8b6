"""What is wrong with a surface that should bound a solid, where, and how it is mended."""

from __future__ import annotations

import math

import numpy as np
import scipy

from ...arguments import format_point
from ...errors import InputError
from ..columns import Columns
from ..surface import Surface
from .creases import connect, pair_sides, triangle_normals

_APART = 1e-6  # of the diagonal: how far from a triangle its two sides are examined
_LARGEST_GAP = 1e-3  # of the diagonal: gaps that `join` may close
_SHARPEST = 10.0  # degrees
_CROSSINGS = 400_000  # triangles up to which self-intersections are sought


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


def require_bounding(surface: Surface, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Raise unless the triangles (t, 3) bound a region with normals outwards; return the partners of their sides.

    Parameters
    ----------
    surface : Surface
        As given, for messages.
    vertices, triangles : arrays
        The welded surface.

    Raises
    ------
    InputError
        If the surface is open, has duplicate or flipped triangles, is inside out, or intersects itself.
    """
    name = surface.name
    repeated = repeated_triangles(triangles)
    if repeated.size:
        where = format_point(vertices[triangles[repeated[0]]].mean(axis=0))
        raise InputError(
            f"{name} has {len(repeated)} duplicate triangles, the first at {where}, expected each once; remove them, "
            "or pass repair=True"
        )
    if not surface.closed:
        join = closing_distance(surface)
        try:
            surface.require_closed()
        except InputError as error:
            if join is None:
                raise
            raise InputError(f"{error}. Here join={join:g} closes it") from None
    twin, bad = pair_sides(vertices, triangles)
    if bad.size:
        k, s = divmod(int(bad[0]), 3)
        raise InputError(
            f"{name} has {len(bad)} sides of triangles whose neighbors are oriented differently, the first at "
            f"{format_point(vertices[triangles[k, s]])}; expected all triangles counter-clockwise seen from outside; "
            "flip the others, or pass repair=True"
        )
    corners = vertices[triangles]
    inner, outer = sides_wound(vertices, triangles, twin)
    wrong = np.flatnonzero((inner != 1) | (outer != 0))
    if not wrong.size:
        return twin
    if (inner == 0).all() and (outer == -1).all():
        raise InputError(
            f"{name} is inside out: all its triangles are clockwise seen from outside; flip them with "
            "triangles[:, ::-1], or pass repair=True. For the region around it use Solid.outside"
        )
    where = format_point(corners[wrong[0]].mean(axis=0))
    if ((inner == 2) | (outer == 1) | (inner == 1) & (outer == 0)).all():
        raise InputError(
            f"{name} has parts that overlap or lie in each other: {len(wrong)} triangles are inside of another part, "
            f"the first at {where}; expected parts that do not overlap; unite them (a + b of two solids), or turn the "
            "normals of cavities inwards (repair=True does that)"
        )
    raise InputError(
        f"{name} has {len(wrong)} triangles without the inside on one side and the outside on the other, the first at "
        f"{where}; expected normals outwards, of cavities too, and no intersections; pass repair=True for the normals"
    )


def sides_wound(vertices: np.ndarray, triangles: np.ndarray, twin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the winding numbers just inside and just outside of each triangle, (t,) int each.

    Triangles thinner than the distance at which that is examined are left out: they count as 1 and 0.
    """
    corners = vertices[triangles]
    normals, areas = triangle_normals(vertices, triangles, twin)
    apart = _APART * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    longest = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    sound = areas > 4 * apart * longest
    columns = Columns(corners)
    inner, outer = np.ones(len(triangles), np.int64), np.zeros(len(triangles), np.int64)
    middle = corners[sound].mean(axis=1)
    inner[sound] = columns.winding(middle - apart * normals[sound])
    outer[sound] = columns.winding(middle + apart * normals[sound])
    return inner, outer


def require_no_crossings(surface: Surface) -> None:
    """Raise if triangles intersect; see `Surface.check`. Very large surfaces are not examined."""
    if len(surface) <= _CROSSINGS:
        surface.check()


def sharp_edges(angle: np.ndarray) -> np.ndarray:
    """Return the edges whose interior or exterior dihedral angle (e,) is below 10 degrees, (k,) int."""
    return np.flatnonzero(np.minimum(angle, 2 * math.pi - angle) < math.radians(_SHARPEST))


def repaired(surface: Surface, groups: np.ndarray) -> tuple[Surface, np.ndarray, list[str]]:
    """Return a surface that is mended where that is certain, the groups, and what was done.

    Vertices across small gaps are joined, triangles without three corners and duplicates are removed, neighbors are
    oriented alike, and normals point out of the region, of cavities too.
    """
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
    if repeated.size:
        done.append(f"removed {len(repeated)} duplicate triangles")
    triangles, groups = triangles[rows].copy(), groups[rows]
    flipped = _flips(triangles)
    triangles[flipped] = triangles[flipped, ::-1]
    turned = flipped.copy()
    twin, bad = pair_sides(vertices, triangles)
    if not bad.size:
        side = np.arange(len(twin))
        count, shell = connect(len(triangles), np.column_stack([side, twin]) // 3)
        for s in range(count):
            mine = np.flatnonzero(shell == s)
            others = np.flatnonzero(shell != s)
            corners = vertices[triangles]
            a, b, c = np.moveaxis(corners[mine] - corners[mine].mean(axis=(0, 1)), 1, 0)
            volume = np.einsum("ij,ij->", a, np.cross(b, c))
            spot = corners[mine[:1]].mean(axis=1)
            # Odd depth: a cavity.
            depth = sum(
                abs(int(Columns(corners[others[shell[others] == o]]).winding(spot)[0]))
                for o in np.unique(shell[others])
            )
            if (volume < 0) == (depth % 2 == 0):
                triangles[mine] = triangles[mine, ::-1]
                turned[mine] = ~turned[mine]
    if turned.any():
        done.append(f"flipped {np.count_nonzero(turned)} triangles")
    return Surface(vertices, triangles, surface.name), groups, done


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
