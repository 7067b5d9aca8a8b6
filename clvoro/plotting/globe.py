"""Pictures of meshes on a sphere: maps in the projections of Cartopy (extra `maps`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np
from matplotlib.path import Path
from numpy.typing import ArrayLike

from ..arguments import check_number
from ..connectivity import following
from ..errors import InputError
from ..geometry.sphere import directions
from ..io.convert import missing
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .cells import draw_cells
from .colors import Color, kilometer_of, paint_of, picture_of
from .legends import finished
from .solids import view_axes
from .style import WIDTH, corners_of, interactive_figure, single_height, styled

if TYPE_CHECKING:
    from cartopy.crs import Projection as CartopyProjection

Projection = Literal["orthographic", "plate"]

_RADIUS = 6371229.0
"""Of the globe in projections, whatever that of the mesh is: Cartopy's tolerances are lengths on the Earth."""
_STEP = 2.0  # longest straight part of an outline, degrees of a great circle
_WIDE_LABELS = 0.35
"""Additional width of the labels of degrees and of large sizes beside a map, inches."""
_CENTER = (0.0, 25.0)  # of the picture of a uniform mesh
_AREA = 0.5  # cosine of the angle from its middle within which a mesh is that of a limited area
_STEPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60)  # of meridians and parallels, degrees
_SCALES = {"110m": 40.0, "50m": 8.0, "10m": 0.0}
"""Scales of coastlines, and the smallest angle in degrees across a picture that has them."""


def plot_globe(
    mesh: Result | Diagram,
    color: Color | ArrayLike = "error",
    ax: Any = None,
    *,
    projection: Projection | CartopyProjection = "orthographic",
    center: ArrayLike | None = None,
    across: float | None = None,
    window: tuple[ArrayLike, ArrayLike] | None = None,
    coasts: bool | None = None,
    label: str | None = None,
    limits: tuple[float, float] | None = None,
    edges: bool = True,
    key: bool = True,
    title: str | None = None,
) -> Any:
    """Draw the cells of a mesh on a sphere as a map.

    Parameters
    ----------
    mesh : Result or Diagram
    color : {"error", "quality", "size", "sides", "skewness", "volume"} or (n,) array of real numbers
        As for `plot_cells`.
    ax : cartopy.mpl.geoaxes.GeoAxes, optional
        A map to draw into, with its projection and its part of the sphere; a new figure by default.
    projection : {"orthographic", "plate"} or cartopy.crs.Projection
        The globe from far away, longitudes and latitudes as coordinates (plate carrée), or any other map.
    center : (lon, lat), degrees, optional
        The point in the middle; with "plate" only the longitude counts. By default where the cells are smallest.
    across : float, optional
        For "orthographic": angle in degrees that the picture spans, at most 180; by default the whole globe, or the
        area of a mesh that covers less than a third of it, if there is no `center` either.
    window : ((lon, lat), (lon, lat)), optional
        For "plate": lower left and upper right corner in degrees; by default the whole sphere, or such an area.
    coasts : bool, optional
        Draw the coastlines of the Earth, if Natural Earth's data are on this computer: nothing is downloaded here.
        Cartopy's program ``cartopy_feature_download physical`` does that. By default on spheres as large as the Earth.
    label, limits, edges, key, title
        As for `plot_cells`.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError, InputTypeError
        If the mesh is not on a sphere, a color does not exist, or an option is wrong or for the other projection.
    MissingLibraryError
        If Cartopy is not installed (``pip install "clvoro[maps]"``).
    """
    result = picture_of(mesh)
    diagram = result.diagram
    sphere = diagram.domain.require_globe("plot_globe draws meshes on a sphere", "call result.plot()")
    paint = paint_of(result, color, label, limits)
    with styled():
        if ax is None:
            if center is None and across is None and window is None:
                center, across, window = _view_of_area(result, projection)
            if center is None and not (projection == "plate" and window is None):
                center = default_center(result)
            ax = _new_map(projection, center, across, window, bool(paint.scheme.classes), title is not None)
        elif not hasattr(ax, "projection"):
            raise InputError(
                "ax has no projection, expected a map of Cartopy: figure.add_subplot(projection=map_projection())"
            )
        source = ax.projection.as_geodetic()
        if ax.projection.proj4_params["proj"] == "ortho":
            angle = np.linspace(0, 2 * np.pi, 721)
            ax.set_boundary(Path(ax.projection.x_limits[1] * np.column_stack([np.cos(angle), np.sin(angle)])))
        cells, polygons = project_cells(diagram, ax.projection, source)
        polygons, cells = _shown(ax, polygons, cells)

        def positions(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            lonlat = source.transform_points(ax.projection, *places.T)[:, :2]
            inside = np.isfinite(lonlat).all(axis=1)
            return inside, sphere.positions(lonlat[inside])

        image = draw_cells(ax, diagram, cells, polygons, paint, edges, positions=positions)
        image.set_clip_path(ax.patch)
        _draw_graticule(ax, source)
        if kilometer_of(sphere.radius) is not None if coasts is None else coasts:
            _draw_coasts(ax)
        return finished(ax, paint, key, title)


def map_projection(
    projection: Projection | CartopyProjection = "orthographic", center: ArrayLike | None = None
) -> CartopyProjection:
    """Return a projection of Cartopy for axes: ``figure.add_subplot(projection=map_projection())``.

    Parameters
    ----------
    projection, center
        As for `plot_globe`; the center is by default (0, 25).

    Raises
    ------
    InputError
        If the projection is unknown, or the center no longitude and latitude.
    MissingLibraryError
        If Cartopy is not installed (``pip install "clvoro[maps]"``).
    """
    try:
        from cartopy import crs
    except ModuleNotFoundError as error:
        raise missing("Cartopy", "maps", "a picture of a mesh on a sphere") from error
    if isinstance(projection, crs.Projection):
        return projection
    if not isinstance(projection, str) or projection not in get_args(Projection):
        names = ", ".join(get_args(Projection))
        raise InputError(f"projection is {projection!r:.60}, expected one of {names}, or one of Cartopy's")
    lon, lat = _CENTER if center is None else _pair("center", center)
    globe = crs.Globe(ellipse=cast("str", None), semimajor_axis=_RADIUS, semiminor_axis=_RADIUS)
    if projection == "plate":
        return crs.PlateCarree(lon, globe=globe)
    return crs.Orthographic(lon, lat, globe=globe)


def default_center(result: Result) -> tuple[float, float]:
    """Return longitude and latitude, in steps of 5 degrees, of the region with the smallest cells.

    Where small cells are everywhere, it is a fixed point.
    """
    sizes = result.target_size
    smallest = np.flatnonzero(sizes <= 1.1 * np.quantile(sizes, 0.01))
    points = result.points[smallest] / np.linalg.norm(result.points[smallest], axis=1)[:, None]
    # Of some candidates, the one with the most small cells within 30 degrees; of evenly spread cells 7 % are there.
    candidates = points[:: -(-len(points) // 200)]
    near = candidates @ points.T > np.cos(np.pi / 6)
    best = near[int(np.argmax(near.sum(axis=1)))]
    areas = result.diagram.volumes
    if areas[smallest].sum() > 0.5 * areas.sum() or best.mean() < 0.25:
        return _CENTER
    lonlat = directions(points[best].mean(axis=0, keepdims=True))[0]
    lon, lat = (5 * np.round(lonlat / 5) + 0.0).tolist()
    return lon, lat


def _view_of_area(result: Result, projection: Any) -> tuple[Any, float | None, Any]:
    """Return center, angle across and window that show a mesh of a limited area, else None for all."""
    points = result.points / np.linalg.norm(result.points, axis=1)[:, None]
    middle = points.mean(axis=0, keepdims=True)
    least = float((points @ middle[0]).min() / np.linalg.norm(middle))
    if least < _AREA or not isinstance(projection, str):
        return None, None, None
    (lon, lat), around = directions(middle)[0], directions(points)
    east = (around[:, 0] - lon + 180) % 360 - 180
    margin = 0.08 * np.degrees(np.arccos(least)) + 0.01
    if projection == "orthographic":
        return (lon, lat), 2 * (np.degrees(np.arccos(least)) + margin), None
    south, north = np.clip([around[:, 1].min() - margin, around[:, 1].max() + margin], -90, 90)
    return None, None, ((lon + east.min() - margin, south), (lon + east.max() + margin, north))


def _new_map(projection: Any, center: Any, across: Any, window: Any, legend: bool, title: bool) -> Any:
    """Return axes of a new figure that show a part of the sphere, or raise InputError."""
    made = map_projection(projection, center)
    for name, value, only in (("across", across, "orthographic"), ("window", window, "plate")):
        if value is not None and not (isinstance(projection, str) and projection == only):
            raise InputError(f"{name} is for projection={only!r}; leave it out")
    (left, right), (bottom, top) = made.x_limits, made.y_limits
    if across is not None:
        if check_number("across", across, above=0) > 180:
            raise InputError(f"across is {across:g}, expected an angle of at most 180 degrees")
        half = _RADIUS * np.sin(np.radians(across) / 2)
        left, right, bottom, top = -half, half, -half, half
    elif window is not None:
        (left, bottom), (right, top) = corners_of(window)
        if right - left > 360 or max(-bottom, top) > 90:
            raise InputError(f"window is {window!r:.80}, expected longitudes and latitudes in degrees")
        made = map_projection("plate", ((left + right) / 2, 0))
        left, right = (left - right) / 2, (right - left) / 2
    height = single_height((left, bottom), (right, top), legend, title)
    height -= _WIDE_LABELS * (top - bottom) / (right - left) * (across is not None or projection != "orthographic")
    ax: Any = interactive_figure(WIDTH, height).add_subplot(projection=made)
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)
    return ax


def _pair(name: str, value: Any) -> tuple[float, float]:
    try:
        pair = np.asarray(value, float)
    except (TypeError, ValueError):
        pair = np.empty(0)
    if pair.shape != (2,) or not np.isfinite(pair).all() or abs(pair[1]) > 90:
        raise InputError(
            f"{name} is {value!r:.80}, expected a longitude, and then a latitude from -90 to 90, in degrees"
        )
    return float(pair[0]), float(pair[1])


def outlines(diagram: Diagram) -> tuple[np.ndarray, np.ndarray]:
    """Return the outlines of the cells with short steps along their arcs.

    Results:
    - `starts`: (n + 1,) int
    - `points` (p, 3) float: unit vectors, ``points[starts[i]:starts[i + 1]]`` counter-clockwise around cell i.
    """
    corners = diagram.vertices[diagram.cell_vertices]
    starts = diagram.cell_vertex_starts
    begin, end, middle = corners, corners[following(starts)], diagram.face_centroids
    begin, middle, end = (x / np.linalg.norm(x, axis=1)[:, None] for x in (begin, middle, end))
    # An even number of parts: both cells of a face have the same points, and one of them is the middle.
    angle = np.degrees(np.arccos(np.clip((begin * middle).sum(axis=1), -1, 1)))
    counts = np.where(angle > _STEP / 2, 2 * np.ceil(angle / _STEP).astype(int), 1)
    ends = np.cumsum(counts)
    arc = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(arc)) - (ends - counts)[arc]) / counts[arc]
    early = share < 0.5
    weight = np.where(early, 2 * share, 2 * share - 1)[:, None]
    points = np.where(early[:, None], begin[arc], middle[arc]) * (1 - weight)
    points += np.where(early[:, None], middle[arc], end[arc]) * weight
    return np.concatenate([[0], ends])[starts], points / np.linalg.norm(points, axis=1, keepdims=True)


def project_cells(diagram: Diagram, projection: CartopyProjection, source: Any) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return rows of cells (k,) and their polygons on the map, (c, 2) each; cells out of sight are left out.

    Points are projected all at once. Only cells that the edge of a map cuts go through Cartopy one by one.
    """
    import shapely

    starts, points = outlines(diagram)
    lonlat = directions(points)
    flat = projection.transform_points(source, *lonlat.T)[:, :2]
    known: dict[str, Any] = projection.proj4_params
    seen = np.isfinite(flat).all(axis=1)
    in_sight = np.logical_or.reduceat(seen, starts[:-1])
    if known["proj"] == "ortho" and not seen.all():
        # Points behind the limb are moved outwards, the farther behind the farther, so that no side crosses the limb.
        right, up, towards = view_axes((known["lon_0"], known["lat_0"]))
        behind = points[~seen]
        xy = np.column_stack([behind @ right, behind @ up])
        length = np.maximum(np.linalg.norm(xy, axis=1), 1e-9)
        flat[~seen] = _RADIUS * xy * ((1 - (behind @ towards) ** 3) / length)[:, None]
        seen = np.ones(len(points), bool)
    first, counts = starts[:-1], np.diff(starts)
    whole = np.logical_and.reduceat(seen, first)
    width = np.ptp(projection.x_limits)
    jumps = np.abs(flat[following(starts), 0] - flat[:, 0]) > 0.4 * width
    whole &= ~np.logical_or.reduceat(jumps | (np.abs(lonlat[:, 1]) > 90 - 1e-9), first)
    cells = np.flatnonzero(whole & in_sight)
    polygons = [flat[a : a + n] for a, n in zip(first[cells], counts[cells], strict=True)]
    rest = np.flatnonzero(~whole & in_sight)
    pieces = [
        (row, np.asarray(part.exterior.coords)[:-1])
        for row in rest.tolist()
        for part in projection.project_geometry(shapely.Polygon(lonlat[starts[row] : starts[row + 1]]), source).geoms
    ]
    return np.concatenate([cells, [row for row, _ in pieces]]).astype(int), [*polygons, *(p for _, p in pieces)]


def _shown(ax: Any, polygons: list[np.ndarray], cells: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the polygons that reach into the limits of `ax`, and their cells."""
    low, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
    kept = [k for k, p in enumerate(polygons) if (p.max(axis=0) >= low).all() and (p.min(axis=0) <= high).all()]
    return [polygons[k] for k in kept], cells[kept]


def _draw_graticule(ax: Any, source: Any) -> None:
    """Add thin meridians and parallels, on a rectangular map with their degrees where they cross the frame."""
    x, y = np.meshgrid(*(np.linspace(low, high, 41) for low, high in (ax.get_xlim(), ax.get_ylim())))
    lon, lat = source.transform_points(ax.projection, x, y)[:, :, :2].transpose(2, 0, 1)
    rectangular = np.isfinite(lon[[0, 0, -1, -1], [0, -1, 0, -1]]).all()
    middle = np.degrees(np.angle(np.nanmean(np.exp(1j * np.radians(np.where(np.isfinite(lon), lon, np.nan))))))
    places = []
    for degrees, about in ((lon, middle), (lat, 0.0)):
        turned = (degrees[np.isfinite(degrees)] - about + 180) % 360 - 180 + about
        low, high = turned.min(), turned.max()
        step = next(s for s in _STEPS if s >= (high - low) / 7)
        places.append(step * np.arange(np.ceil(low / step), np.floor(high / step) + 1))
    lines = ax.gridlines(
        xlocs=np.unique((places[0] + 180) % 360 - 180),
        ylocs=places[1],
        draw_labels={"bottom": "x", "left": "y"} if rectangular else False,
        color="#1A1A1A",
        linewidth=0.35,
        alpha=0.35,
        zorder=2.2,
    )
    lines.rotate_labels = False
    lines.xlabel_style = lines.ylabel_style = {"size": 8}
    ax.spines["geo"].set(linewidth=0.8, edgecolor="#1A1A1A")


def _draw_coasts(ax: Any) -> None:
    """Add coastlines, if their data are there."""
    span = 180 * np.ptp(ax.get_ylim()) / np.ptp(ax.projection.y_limits)
    fitting = [scale for scale, least in _SCALES.items() if span >= least][:1]
    for scale in [*fitting, *(s for s in _SCALES if s not in fitting)]:
        if _has_coasts(scale):
            ax.coastlines(scale, linewidth=0.9, zorder=2.3)
            return


def _has_coasts(scale: str) -> bool:
    """Return whether Natural Earth's coastlines of a scale are on this computer."""
    from cartopy import config
    from cartopy.io import Downloader

    words = {"resolution": scale, "category": "physical", "name": "coastline"}
    source = Downloader.from_config(("shapefiles", "natural_earth", *words.values()))
    given = {"config": config, **words}
    paths = (source.pre_downloaded_path(given), source.target_path(given))
    return any(path is not None and path.exists() for path in paths)
