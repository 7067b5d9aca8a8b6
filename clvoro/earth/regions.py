"""Choose the cells of oceans and of limited areas, for `Diagram.subset`.

>>> import clvoro
>>> import shapely
>>> globe = clvoro.voronoi(clvoro.Sphere(), clvoro.Sphere().icosahedral_points(3))
>>> continent = shapely.box(-60, -40, 20, 50)
>>> ocean = globe.subset(clvoro.earth.ocean(globe, continent))
>>> len(globe), len(ocean), ocean.domain.boundary_names
(642, 543, ('coast',))
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import scipy

from ..arguments import check_choice, check_integer, warn
from ..connectivity import components, following
from ..errors import InputError, InputTypeError, MismatchWarning
from ..geometry.sphere import Sphere
from ..geometry.subdomain import SphereRegion
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from ..mesh.subset import check_mask
from .shapes import area_of, lines_of

if TYPE_CHECKING:
    import shapely
    from numpy.typing import ArrayLike

    from ..geometry.polygon import Polygon

    Area = (
        Polygon
        | shapely.Geometry
        | str
        | PathLike[str]
        | Mapping[str, Any]
        | np.ndarray
        | Callable[[np.ndarray], ArrayLike]
    )
    Lines = ArrayLike | Sequence[ArrayLike] | shapely.Geometry | str | PathLike[str] | Mapping[str, Any]

__all__ = ["crossed", "inside", "ocean", "rings"]


def inside(mesh: Result | Diagram, area: Area) -> np.ndarray:
    """Return which cells of a mesh on a sphere have their generators in an area.

    Parameters
    ----------
    mesh : Result or Diagram
        On a `Sphere`, or a part of such a mesh.
    area : Polygon, shapely geometry, path, dict, array or callable
        Polygons in longitudes and latitudes in degrees: a `Polygon`, a Polygon or MultiPolygon of shapely, or a path, a
        text or a dict of GeoJSON. Or an array of n bool. Or a function that takes longitudes, from -180 to 180, and
        latitudes (n, 2) and returns n bool.

    Returns
    -------
    (n,) bool
        A generator on an edge is inside.

    Raises
    ------
    InputError, InputTypeError
        If the mesh is not on a sphere; if the area is something else, a mask has another length, or positions are not
        longitudes and latitudes; if a ring goes around the globe and crosses the equator.

    Notes
    -----
    Edges are straight in longitude and latitude, as in GeoJSON; along a parallel they are not great circles. Rings may
    have any orientation. An edge that spans more than 180 degrees of longitude goes the short way, across the date
    line: divide the edges of wider polygons. Only an edge from -180 to 180 goes along its whole parallel. A ring around
    the globe has the pole of its hemisphere inside. To put the other pole inside, or to cross the equator, close the
    ring along the pole: from (180, 90) to (-180, 90).

    Examples
    --------
    >>> import shapely
    >>> globe = clvoro.voronoi(clvoro.Sphere(), clvoro.Sphere().icosahedral_points(2))
    >>> pacific = [(160, -50), (-110, -50), (-120, 40), (160, 40)]
    >>> int(clvoro.earth.inside(globe, shapely.Polygon(pacific)).sum())
    27
    >>> int(clvoro.earth.inside(globe, lambda lonlat: lonlat[:, 1] > 66.5).sum())
    7
    """
    diagram, sphere = _diagram_of(mesh)
    return _inside(diagram, sphere, "area", area)


def crossed(mesh: Result | Diagram, lines: Lines) -> np.ndarray:
    """Return which cells of a mesh on a sphere are crossed by lines.

    Cells along a line are neighbors of each other: as water they are a strait, and as land they close one.

    Parameters
    ----------
    mesh : Result or Diagram
    lines : array, list of arrays, shapely geometry, path or dict
        Lines of longitudes and latitudes in degrees: an array (k, 2) or several of them, a LineString or
        MultiLineString of shapely, or a path or dict of GeoJSON. Edges are straight in longitude and latitude, and go
        the short way around the globe.

    Returns
    -------
    (n,) bool

    Raises
    ------
    InputError, InputTypeError
        If the mesh is not on a sphere, the lines are something else, or a line crosses no cell of the mesh.

    Examples
    --------
    >>> globe = clvoro.voronoi(clvoro.Sphere(), clvoro.Sphere().icosahedral_points(3))
    >>> int(clvoro.earth.crossed(globe, [(-10, 36), (10, 36)]).sum())
    3
    """
    diagram, sphere = _diagram_of(mesh)
    found = np.zeros(len(diagram), bool)
    for cells in _crossed(diagram, sphere, "lines", lines):
        found[cells] = True
    return found


def ocean(
    mesh: Result | Diagram,
    land: Area,
    *,
    passages: Lines | None = None,
    blockages: Lines | None = None,
    least_cells: int | None = None,
    straits: Literal["keep", "widen"] = "keep",
) -> np.ndarray:
    """Return which cells of a mesh on a sphere are left when land and lakes are removed.

    A cell is land if its generator is. Then cells along blockages become land, and cells along passages water. Of the
    connected parts that are left only the largest is kept.

    Parameters
    ----------
    mesh : Result or Diagram
    land : Polygon, shapely geometry, path, dict, array or callable
        Where the land is; see `inside`.
    passages : array, list of arrays, shapely geometry, path or dict, optional
        Lines along which cells stay water, so that a strait narrower than a cell remains open; see `crossed`.
    blockages : array, list of arrays, shapely geometry, path or dict, optional
        Lines along which cells become land, unless a passage crosses them.
    least_cells : int, optional
        Least number of cells of a part that is kept. By default only the part with the largest area.
    straits : {"keep", "widen"}
        With "widen" land beside water that is a single cell wide becomes water: straits, passages and inlets are then
        two cells wide or more. No land bridge opens, no island disappears, and blockages stay.

    Returns
    -------
    (n,) bool
        For `Diagram.subset`.

    Raises
    ------
    InputError, InputTypeError
        If no cell is left, or an argument is wrong; see `inside` and `crossed`.

    Warns
    -----
    MismatchWarning
        If a passage leads into a lake that is removed, or a strait cannot be widened, as between a passage and a
        blockage.

    Examples
    --------
    >>> import shapely
    >>> globe = clvoro.voronoi(clvoro.Sphere(), clvoro.Sphere().icosahedral_points(4))
    >>> land = shapely.box(-60, -40, 20, 50).difference(shapely.box(-40, -20, 0, 20))
    >>> int(clvoro.earth.ocean(globe, land).sum())
    2161
    >>> int(clvoro.earth.ocean(globe, land, passages=[(-20, 0), (40, 0)]).sum())
    2260
    >>> int(clvoro.earth.ocean(globe, land, passages=[(-20, 0), (40, 0)], straits="widen").sum())
    2266
    """
    diagram, sphere = _diagram_of(mesh)
    check_choice("straits", straits, ("keep", "widen"))
    water = ~_inside(diagram, sphere, "land", land)
    blocked = np.zeros(len(diagram), bool)
    for cells in _crossed(diagram, sphere, "blockages", blockages):
        blocked[cells] = True
    water &= ~blocked
    opened = _crossed(diagram, sphere, "passages", passages)
    for cells in opened:
        water[cells] = True
    if not water.any():
        raise InputError(
            f"land covers all {len(water)} cells, expected water somewhere; is it the opposite mask, or are rings of "
            "land and water mixed up?"
        )
    kept = _large_parts(diagram, water, least_cells)
    for k, cells in enumerate(opened):
        if not kept[cells].all():
            warn(
                f"passages[{k}] leads to water that is not connected with the rest: {(~kept[cells]).sum()} of "
                f"its {len(cells)} cells are removed; prolong the line into the ocean, or use a smaller least_cells",
                MismatchWarning,
            )
    return kept if straits == "keep" else _widened(diagram, sphere, kept, blocked)


def rings(mesh: Result | Diagram, keep: ArrayLike, count: int = 7) -> np.ndarray:
    """Return the rings of neighbors around the cells of a limited area.

    The limited areas of MPAS-Atmosphere have seven: five in which values relax towards those at the boundary, and two
    in which they are given. Written as cell data `bdyMaskCell` to a file with ``convention="mpas"``, they are written
    for edges and vertices, too.

    Parameters
    ----------
    mesh : Result or Diagram
    keep : (n,) array of bool
        The cells of the area, as `inside` returns them.
    count : int
        Number of rings.

    Returns
    -------
    (n,) int32
        0 in the area, k in the k-th ring around it, and -1 beyond the last one.

    Raises
    ------
    InputError, InputTypeError
        If the mesh is not on a sphere, `keep` is not one bool per cell or has no True, or `count` is no integer from 0.

    Examples
    --------
    >>> globe = clvoro.voronoi(clvoro.Sphere(), clvoro.Sphere().icosahedral_points(4))
    >>> ring = clvoro.earth.rings(globe, clvoro.earth.inside(globe, clvoro.Polygon([(0, 0), (40, 0), (20, 30)])))
    >>> area = globe.subset(ring >= 0, "open")
    >>> area.to_netcdf("area.nc", convention="mpas", cell_data={"bdyMaskCell": ring[ring >= 0]})
    """
    diagram, _ = _diagram_of(mesh)
    kept = check_mask("keep", keep, len(diagram))
    if not kept.any():
        raise InputError("keep selects no cell, expected at least one that is True")
    return rings_around(diagram, kept, check_integer("count", count, 0))


def _diagram_of(mesh: object) -> tuple[Diagram, Sphere]:
    diagram = mesh.diagram if isinstance(mesh, Result) else mesh
    if not isinstance(diagram, Diagram):
        raise InputTypeError(f"mesh is a {type(mesh).__name__}, expected a clvoro.Result or a clvoro.Diagram")
    globe = diagram.domain.require_globe("regions are for meshes on a clvoro.Sphere", "in the plane, use subset")
    return diagram, globe


def _inside(diagram: Diagram, sphere: Sphere, name: str, area: Any) -> np.ndarray:
    """Return which generators are in the area, (n,) bool."""
    n = len(diagram)
    if isinstance(area, np.ndarray | list | tuple):
        return check_mask(name, area, n)
    lonlat = sphere.lonlat(diagram.points)
    if not callable(area):
        return area_of(name, area).contains(lonlat)
    found = np.asarray(area(lonlat))
    if found.dtype != bool or found.shape != (n,):
        raise InputTypeError(
            f"{name} returned an array of shape {found.shape} and dtype {found.dtype} for {n} positions, expected "
            f"({n},) and bool"
        )
    return found


def _crossed(diagram: Diagram, sphere: Sphere, name: str, lines: Any) -> list[np.ndarray]:
    """Return the cells along each line."""
    if lines is None:
        return []
    found = [cells_across(diagram, sphere, line) for line in lines_of(name, lines)]
    for k, cells in enumerate(found):
        if not len(cells):
            raise InputError(f"{name}[{k}] crosses no cell of the mesh: it is outside of {sphere}")
    return found


def _widened(diagram: Diagram, sphere: Sphere, water: np.ndarray, blocked: np.ndarray) -> np.ndarray:
    found, left = widen_straits(diagram, water, blocked)
    if len(left):
        lon, lat = sphere.lonlat(diagram.points[left[:1]])[0]
        warn(
            f"{len(left)} cells of water remain one cell wide, because more water would open a land bridge, cover an "
            f"island or a blockage, or leave the mesh; the first one is at longitude {lon:.1f}, latitude "
            f"{lat:.1f}; use smaller cells there",
            MismatchWarning,
        )
    return found


def _large_parts(diagram: Diagram, water: np.ndarray, least_cells: int | None) -> np.ndarray:
    """Return the cells of the connected part with the largest area, or of all parts with enough cells."""
    owner, n = diagram.half_faces.owner, len(diagram)
    joined = np.flatnonzero(diagram.neighbors >= 0)
    joined = joined[water[owner[joined]] & water[diagram.neighbors[joined]]]
    part = components(n, owner[joined], diagram.neighbors[joined])[1]
    if least_cells is None:
        areas = np.bincount(part, np.where(water, diagram.volumes, 0))
        return water & (part == areas.argmax())
    least = check_integer("least_cells", least_cells, 1)
    sizes = np.bincount(part, water)
    if sizes.max() < least:
        raise InputError(
            f"least_cells is {least}, and the largest part that is left has {sizes.max():.0f} cells; use a smaller one"
        )
    return water & (sizes[part] >= least)


_STEP = 0.1
"""Length in degrees of the arcs by which lines in longitude and latitude are approximated."""
_TIE = 1e-12
"""Difference of distances, in units of the radius, below which two generators are equally near."""


def cells_across(diagram: Diagram, sphere: Sphere, line: np.ndarray) -> np.ndarray:
    """Return the cells that a line (k, 2) of continuous longitudes and latitudes crosses, ascending.

    Cells that follow each other along the line have a common face. Where the line goes through a vertex of more than
    three cells, those beside it are added. Parts of the line outside of the mesh are skipped.
    """
    n, unit = len(diagram), diagram.points
    if isinstance(sphere, SphereRegion):
        unit = np.concatenate([unit, np.unique(sphere.beyond, axis=0)])
    unit = unit / np.linalg.norm(unit, axis=1)[:, None]
    tree = scipy.spatial.KDTree(unit)
    path = sphere.positions(_divided(line)) / sphere.radius
    cells = np.asarray(tree.query(path)[1])
    begin, end, first, last = path[:-1], path[1:], cells[:-1], cells[1:]
    found, pairs = [cells], [np.empty((0, 2), np.int64)]
    while True:
        some = first != last
        begin, end, first, last = begin[some], end[some], first[some], last[some]
        if not len(first):
            break
        # Where the arc crosses the bisector of the cells of its ends: between them, unless a third one is nearer.
        normal = unit[last] - unit[first]
        a, b = _heights(normal, begin, end)
        middle = begin + np.clip(a / np.maximum(a + b, 1e-300), 0, 1)[:, None] * (end - begin)
        middle /= np.linalg.norm(middle, axis=1)[:, None]
        distance, nearest = (np.asarray(x) for x in tree.query(middle))
        own = np.linalg.norm(middle - unit[first], axis=1)
        third = (distance < own - _TIE) & (nearest != first) & (nearest != last)
        pairs.append(np.column_stack([first, last])[~third])
        found.append(nearest[third])
        begin, middle, end = begin[third], middle[third], end[third]
        first, nearest, last = first[third], nearest[third], last[third]
        begin, end = np.concatenate([begin, middle]), np.concatenate([middle, end])
        first, last = np.concatenate([first, nearest]), np.concatenate([nearest, last])
    crossed = np.unique(np.concatenate(found))
    beside = _common_neighbors(diagram, np.concatenate(pairs))
    return np.union1d(crossed[crossed < n], beside)


def rings_around(diagram: Diagram, inside: np.ndarray, count: int) -> np.ndarray:
    """Return 0 for cells inside, k for those in the k-th ring of neighbors around them, else -1; (n,) int32."""
    inner = diagram.neighbors >= 0
    i, j = diagram.half_faces.owner[inner], diagram.neighbors[inner]
    ring = np.where(inside, 0, -1).astype(np.int32)
    for k in range(1, count + 1):
        front = j[ring[i] == k - 1]
        ring[front[ring[front] < 0]] = k
    return ring


def _heights(normal: np.ndarray, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of both ends from the planes with these normals, not negative."""
    a, b = -(normal * begin).sum(axis=1), (normal * end).sum(axis=1)
    return np.maximum(a, 0), np.maximum(b, 0)


def _divided(line: np.ndarray) -> np.ndarray:
    """Return the line with more positions, at most `_STEP` apart."""
    steps = np.abs(np.diff(line, axis=0)).max(axis=1)
    counts = np.maximum(np.ceil(steps / _STEP), 1).astype(int)
    segment = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(segment)) - (np.cumsum(counts) - counts)[segment]) / counts[segment]
    made = line[segment] + share[:, None] * (line[segment + 1] - line[segment])
    made = np.concatenate([made, line[-1:]])
    made[:, 0] = np.mod(made[:, 0], 360)
    return made


def _common_neighbors(diagram: Diagram, pairs: np.ndarray) -> np.ndarray:
    """Return the cells that are neighbors of both cells of a pair that are not neighbors of each other."""
    n = len(diagram)
    pairs = np.unique(pairs[(pairs < n).all(axis=1)], axis=0)
    starts, neighbors = diagram.neighbor_starts, diagram.neighbors
    found = [np.empty(0, np.int64)]
    for i, j in pairs.tolist():
        around, others = (neighbors[starts[k] : starts[k + 1]] for k in (i, j))
        if j not in around:
            both = np.intersect1d(around, others)
            found.append(both[both >= 0])
    return np.unique(np.concatenate(found))


def narrow_cells(diagram: Diagram, water: np.ndarray) -> np.ndarray:
    """Return which water cells have land on two sides, so that water is one cell wide there: (n,) bool.

    The neighbors around such a cell form two or more runs of water with land between them.
    """
    wet = (diagram.neighbors >= 0) & water[diagram.neighbors]
    ends = wet & ~wet[following(diagram.neighbor_starts)]
    return water & (np.bincount(diagram.half_faces.owner, ends, len(diagram)) >= 2)


def widen_straits(diagram: Diagram, water: np.ndarray, fixed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `water` with more cells, so that no strait is a single cell wide, and the cells where that is impossible.

    Beside a narrow cell one run of land between two runs of water becomes water, the shortest one that can. A land cell
    can become water if its neighbors in the water form a single run. Then land and water keep their connected parts: no
    land bridge opens, and no island disappears.

    - `water`, `fixed` (n,) bool: water cells, and land cells that stay land.

    Results:
    - `water`: (n,) bool
    - `left` (k,) int: cells that are still narrow.
    """
    wet = water.copy()
    starts, neighbors = diagram.neighbor_starts.tolist(), diagram.neighbors
    while True:
        changed = False
        for cell in np.flatnonzero(narrow_cells(diagram, wet)).tolist():
            ring = neighbors[starts[cell] : starts[cell + 1]].tolist()
            runs = _land_runs(ring, wet)
            if len(runs) < 2:
                continue  # widened from another cell
            for run in sorted(runs, key=len):
                if _flood(run, wet, fixed, starts, neighbors):
                    changed = True
                    break
        if not changed:
            return wet, np.flatnonzero(narrow_cells(diagram, wet))


def _land_runs(ring: list[int], wet: np.ndarray) -> list[list[int]]:
    """Return the runs of land among the neighbors around a cell; -1 and below are land, too."""
    is_wet = [j >= 0 and bool(wet[j]) for j in ring]
    first = next((k for k, here in enumerate(is_wet) if here), 0)
    runs: list[list[int]] = []
    before = True
    for k in range(first, first + len(ring)):
        here = is_wet[k % len(ring)]
        if not here:
            runs = [*runs, []] if before else runs
            runs[-1].append(ring[k % len(ring)])
        before = here
    return runs


def _flood(run: list[int], wet: np.ndarray, fixed: np.ndarray, starts: list[int], neighbors: np.ndarray) -> bool:
    """Make a run of land cells water, from its begin on; if one of them must stay land, change nothing."""
    done: list[int] = []
    for cell in run:
        if cell >= 0 and not fixed[cell]:
            ring = neighbors[starts[cell] : starts[cell + 1]].tolist()
            if len(_land_runs(ring, wet)) == 1:
                wet[cell] = True
                done.append(cell)
                continue
        wet[done] = False
        return False
    return True
