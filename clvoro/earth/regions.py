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
from ..errors import InputError, InputTypeError, MismatchWarning
from ..geometry.sphere import Sphere
from ..mesh.connectivity import face_owners
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from ..mesh.subset import check_mask
from .crossing import cells_across, rings_around
from .shapes import area_of, lines_of
from .straits import widen_straits

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
        Keep all parts of at least so many cells. By default only the part with the largest area.
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
    globe = diagram.domain.globe
    if globe is None:
        raise InputError(f"mesh is in {diagram.domain}, expected a mesh on a clvoro.Sphere")
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
    owner, n = face_owners(diagram), len(diagram)
    joined = np.flatnonzero(diagram.neighbors >= 0)
    joined = joined[water[owner[joined]] & water[diagram.neighbors[joined]]]
    pairs = owner[joined], diagram.neighbors[joined]
    graph = scipy.sparse.coo_array((np.ones(len(joined), np.int8), pairs), shape=(n, n))
    part = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
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
