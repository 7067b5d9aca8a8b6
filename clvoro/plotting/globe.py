"""Pictures of meshes on a sphere: the globe, or longitudes and latitudes."""

from __future__ import annotations

from typing import Any, Literal, cast, get_args

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import Circle
from numpy.typing import ArrayLike

from ..arguments import check_number
from ..errors import InputError
from ..geometry.sphere import Sphere, directions
from ..mesh.connectivity import face_owners
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from . import pixels
from .cells import edge_style, points_per_unit
from .coasts import coastlines, is_earth
from .colors import Color, Coloring, cell_norm, coloring_of, picture_of, without_ends
from .legends import add_key
from .projections import Orthographic, Plate, Polygons, unit_vectors
from .style import WIDTH, ends_of, interactive_figure, single_height, styled

Projection = Literal["orthographic", "plate"]

_SMALLEST = 3.0
"""Where cells are smaller, in points, the picture is an image: gaps between polygons would make stripes."""
_FADE = 0.8
"""Edges are as wide as those of cells that much smaller in a plane: rows of thin lines on a globe look like waves."""
_WIDE_LABELS = 0.35
"""Additional width of the labels of degrees and of large sizes beside a map, inches."""
_CENTER = (0.0, 25.0)  # of the picture of a uniform mesh
_STEPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30)  # of meridians and parallels, degrees
_OUTLINE = {"edgecolor": "#1A1A1A", "linewidth": 0.8}


def plot_globe(
    mesh: Result | Diagram,
    color: Color | ArrayLike = "error",
    ax: Any = None,
    *,
    projection: Projection = "orthographic",
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
    """Draw the cells of a mesh on a sphere.

    Parameters
    ----------
    mesh : Result or Diagram
    color : {"error", "quality", "size", "sides", "skewness", "volume"} or (n,) array of real numbers
        As for `plot_cells`.
    ax : matplotlib axes, optional
        Ordinary ones to draw into; a new figure by default.
    projection : {"orthographic", "plate"}
        The globe from far away, or longitudes and latitudes as coordinates (plate carrée).
    center : (lon, lat), degrees, optional
        The point in the middle; with "plate" only the longitude counts. By default where the cells are smallest.
    across : float, optional
        For "orthographic": angle in degrees that the picture spans, at most 180; by default the whole globe.
    window : ((lon, lat), (lon, lat)), optional
        For "plate": lower left and upper right corner in degrees; by default the whole sphere.
    coasts : bool, optional
        Draw the coastlines of the Earth, if Cartopy is installed and Natural Earth's data are on this computer. By
        default on spheres as large as the Earth.
    label, limits, edges, key, title
        As for `plot_cells`.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError, InputTypeError
        If the mesh is not on a sphere, a color does not exist, or an option is wrong or for the other projection.
    """
    result = picture_of(mesh)
    diagram = result.diagram
    sphere = require_sphere(diagram)
    scheme = coloring_of(result, color, label)
    view = _view(result, projection, center, across, window)
    values = scheme.values(result)
    ends = scheme.limits(values) if limits is None else ends_of(limits)
    with styled():
        if ax is None:
            height = single_height(view.lower, view.upper, bool(scheme.classes), title is not None)
            if isinstance(view, Plate) and not scheme.classes:
                height -= _WIDE_LABELS * np.divide(*np.subtract(view.upper, view.lower)[::-1])
            ax = interactive_figure(WIDTH, height).add_subplot()
        _frame(ax, view)
        cells = _draw(ax, diagram, view, values, scheme, ends, edges)
        _draw_graticule(ax, view)
        if is_earth(sphere.radius) if coasts is None else coasts:
            _draw_coasts(ax, view)
        if title is not None:
            ax.set_title(title)
        if key:
            add_key(cells, ax, scheme, values, ends)
    return ax.figure


def require_sphere(diagram: Diagram) -> Sphere:
    """Return the domain of a diagram on a sphere, or raise InputError."""
    if not isinstance(diagram.domain, Sphere):
        raise InputError(
            f"plot_globe draws meshes on a sphere, and this one is in {diagram.domain}; call result.plot()"
        )
    return diagram.domain


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


def _view(result: Result, projection: Any, center: Any, across: Any, window: Any) -> Orthographic | Plate:
    """Return the projection with the shown part, or raise InputError."""
    if not isinstance(projection, str) or projection not in get_args(Projection):
        raise InputError(f"projection is {projection!r:.60}, expected one of {', '.join(get_args(Projection))}")
    point = default_center(result) if center is None else _pair("center", center)
    if projection == "plate":
        if across is not None:
            raise InputError("across is for projection='orthographic'; give a window")
        if window is None:
            return Plate(point if center is not None else (0.0, 0.0))
        return Plate(point, _corners(window))
    if window is not None:
        raise InputError("window is for projection='plate'; give center and across")
    if across is not None:
        across = check_number("across", across, above=0)
        if across > 180:
            raise InputError(f"across is {across:g}, expected an angle of at most 180 degrees")
    return Orthographic(point, across)


def _corners(window: Any) -> np.ndarray:
    """Return a window in degrees as an array (2, 2), or raise InputError."""
    try:
        corners = np.asarray(window, float)
    except (TypeError, ValueError):
        corners = np.empty(0)
    if (
        corners.shape != (2, 2)
        or not np.isfinite(corners).all()
        or (corners[1] <= corners[0]).any()
        or corners[1, 0] - corners[0, 0] > 360
        or np.abs(corners[:, 1]).max() > 90
    ):
        raise InputError(
            f"window is {window!r:.80}, expected two corners ((lon, lat), (lon, lat)) in degrees, the first one at the "
            "lower left"
        )
    return corners


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


def _draw(
    ax: Any,
    diagram: Diagram,
    view: Orthographic | Plate,
    values: np.ndarray,
    scheme: Coloring,
    ends: tuple[float, float],
    edges: bool,
) -> Any:
    """Add the cells, and edges where they are wide enough; return the mappable for a color bar."""
    radius = cast("Sphere", diagram.domain).radius
    points = diagram.points / radius
    corners = diagram.vertices[diagram.cell_vertices] / radius
    owner = face_owners(diagram)
    reach = np.linalg.norm(corners - points[owner], axis=1)
    reach = np.maximum.reduceat(reach, diagram.cell_vertex_starts[:-1])
    cells = np.flatnonzero(view.reaches(points, reach))
    widths, colors = _face_style(ax, diagram, view)
    if len(cells) <= pixels.MOST_POLYGONS and not _has_tiny(ax, diagram, view, cells):
        polygons = view.polygons(diagram, cells)
        drawn: Any = _filled(polygons, values, scheme, ends)
        ax.add_collection(drawn, autolim=False)
    else:
        drawn = pixels.add_image(ax, diagram, view.lower, view.upper, values, scheme, ends, view.directions)
        wide = np.maximum.reduceat(widths > 0, diagram.neighbor_starts[:-1])
        polygons = view.polygons(diagram, cells[wide[cells]] if edges else cells[:0])
    if edges:
        _draw_edges(ax, polygons, widths, colors)
    if isinstance(view, Orthographic):
        for artist in (*ax.collections, *ax.images):
            artist.set_clip_path(Circle((0, 0), 1, transform=ax.transData))
    return drawn


def _has_tiny(ax: Any, diagram: Diagram, view: Orthographic | Plate, cells: np.ndarray) -> bool:
    """Return whether a hundredth of the cells are too small for polygons."""
    if not len(cells):
        return False
    lengths = _lengths(diagram, view)[cells] * points_per_unit(ax, view.upper - view.lower)
    return bool(np.quantile(lengths, 0.01) < _SMALLEST)


def _lengths(diagram: Diagram, view: Orthographic | Plate) -> np.ndarray:
    """Return the widths of cells in the middle of the picture, (n,)."""
    return np.sqrt(diagram.volumes) / cast("Sphere", diagram.domain).radius * view.unit


def _filled(polygons: Polygons, values: np.ndarray, scheme: Coloring, ends: tuple[float, float]) -> PolyCollection:
    return PolyCollection(
        np.split(polygons.corners, polygons.starts[1:-1]) if len(polygons.cells) else [],
        array=without_ends(values[polygons.cells]),
        cmap=scheme.color_map,
        norm=cell_norm(scheme, ends),
        edgecolors="face",
        linewidths=0.25,
        rasterized=len(polygons.cells) > 3000,
    )


def _face_style(ax: Any, diagram: Diagram, view: Orthographic | Plate) -> tuple[np.ndarray, np.ndarray]:
    """Return line widths (m,) and colors (m, 4) of half-faces; 0 where a line would be too thin.

    Of two half-faces one has a width.
    """
    owner, neighbor = face_owners(diagram), diagram.neighbors
    lengths = _lengths(diagram, view)
    smaller = _FADE * np.minimum(lengths[owner], lengths[np.where(neighbor < 0, owner, neighbor)])
    smaller *= view.foreshortening(diagram.face_centroids / cast("Sphere", diagram.domain).radius)
    widths, colors = edge_style(ax, smaller, view.upper - view.lower)
    return np.where((neighbor < owner) & (widths > 0.06), widths, 0), colors


def _draw_edges(ax: Any, polygons: Polygons, widths: np.ndarray, colors: np.ndarray) -> None:
    faces = polygons.faces
    drawn = np.flatnonzero((faces >= 0) & (widths[faces] > 0))
    lines = LineCollection(
        list(polygons.sides()[drawn]),
        colors=colors[faces[drawn]],
        linewidths=widths[faces[drawn]],
        capstyle="round",
        rasterized=len(drawn) > 9000,
    )
    ax.add_collection(lines, autolim=False)


def _frame(ax: Any, view: Orthographic | Plate) -> None:
    """Set the limits, and draw the limb of the globe or the frame of its part."""
    ax.set_aspect("equal")
    ax.set_xlim(view.lower[0], view.upper[0])
    ax.set_ylim(view.lower[1], view.upper[1])
    if isinstance(view, Orthographic):
        ax.add_patch(Circle((0, 0), 1, facecolor="none", zorder=2.5, **_OUTLINE))
        if view.whole:
            ax.set_axis_off()
    for spine in ax.spines.values():
        spine.set_visible(True)


def _draw_graticule(ax: Any, view: Orthographic | Plate) -> None:
    """Add thin meridians and parallels, and their degrees where they cross the frame."""
    steps = _steps(view)
    fine = np.linspace(0, 1, 721)[:, None]
    lines: list[np.ndarray] = []
    ticks: dict[str, list[tuple[float, str]]] = {"x": [], "y": []}
    lons, lats = _shown_degrees(view, steps)
    for lon in lons:
        # Of the meridians on a globe only four meet at a pole.
        top = 90 if isinstance(view, Plate) or lon % 90 == 0 else 90 - min(steps)
        parts = view.lines(unit_vectors((lon, -top) + fine * (0, 2 * top)))
        lines += parts
        ticks["x"] += [(x, _degrees(lon, "EW")) for p in parts for x in _crossings(p, 1, view)]
    for lat in lats:
        parts = view.lines(unit_vectors((-180, lat) + fine * (360, 0)))
        lines += parts
        ticks["y"] += [(y, _degrees(lat, "NS")) for p in parts for y in _crossings(p, 0, view)]
    ax.add_collection(LineCollection(lines, colors="#1A1A1A", linewidths=0.35, alpha=0.35, zorder=2.2), autolim=False)
    if isinstance(view, Plate):
        inside = [lon for lon in lons if view.lower[0] <= lon <= view.upper[0]]
        ticks = {"x": [(lon, _degrees(lon, "EW")) for lon in inside], "y": [(lat, _degrees(lat, "NS")) for lat in lats]}
    sizes = view.upper - view.lower
    for axis, room, size in ((ax.xaxis, 0.1, sizes[0]), (ax.yaxis, 0.05, sizes[1])):
        shown = _apart(ticks[axis.axis_name], room * size)
        axis.set_ticks([place for place, _ in shown], labels=[name for _, name in shown])


def _steps(view: Orthographic | Plate) -> tuple[float, float]:
    """Return the differences of longitude and latitude between lines of the graticule."""
    middle = 0.0 if isinstance(view, Plate) else min(abs(float(view.towards[2])), 0.99)
    spans = (view.span if view.whole else view.span / np.sqrt(1 - middle**2), view.span)
    lon, lat = (next(s for s in reversed(_STEPS) if s <= max(x / 3.5, _STEPS[0])) for x in spans)
    return lon, lat


def _apart(ticks: list[tuple[float, str]], least: float) -> list[tuple[float, str]]:
    """Return the ticks that have room for their labels, and none twice."""
    kept: list[tuple[float, str]] = []
    for place, name in sorted(ticks):
        if not kept or place - kept[-1][0] >= least:
            kept.append((place, name))
    return kept


def _shown_degrees(view: Orthographic | Plate, steps: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return longitudes and latitudes, multiples of `steps`, of lines that may be in the picture."""
    if isinstance(view, Plate):
        ranges = np.transpose([view.lower, view.upper])
    else:
        x, y = (np.linspace(view.lower[a], view.upper[a], 41) for a in (0, 1))
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        lonlat = Plate((0, 0)).flat(view.directions(places)[1])
        middle = float(np.degrees(np.arctan2(view.towards[1], view.towards[0])))
        lon = middle + (lonlat[:, 0] - middle + 180) % 360 - 180
        ranges = np.array([(lon.min(), lon.max()), (lonlat[:, 1].min(), lonlat[:, 1].max())])
        if view.whole:
            ranges = np.array([(-180, 180 - steps[0]), (-90 + steps[1], 90 - steps[1])])
    lons, lats = (
        step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1)
        for step, (low, high) in zip(steps, ranges, strict=True)
    )
    return lons, lats


def _crossings(line: np.ndarray, axis: int, view: Orthographic | Plate) -> list[float]:
    """Return where a line crosses the lower side (`axis` 1) or the left side (0) of the frame."""
    if view.whole:
        return []
    side, other = view.lower[axis], 1 - axis
    beyond = line[:, axis] - side
    k = np.flatnonzero(beyond[:-1] * beyond[1:] < 0)
    share = beyond[k] / (beyond[k] - beyond[k + 1])
    places = line[k, other] + share * (line[k + 1, other] - line[k, other])
    return places[(places > view.lower[other]) & (places < view.upper[other])].tolist()


def _degrees(value: float, signs: str) -> str:
    """Format a longitude or latitude as "30°W"."""
    value = (value + 180) % 360 - 180 if signs == "EW" else value
    letter = "" if value == 0 or value == -180 else signs[0 if value > 0 else 1]
    return f"{abs(round(value, 6)):g}°{letter}"


def _draw_coasts(ax: Any, view: Orthographic | Plate) -> None:
    parts = [
        part
        for line in coastlines(view.span)
        for part in view.lines(unit_vectors(line))
        if (part.max(axis=0) >= view.lower).all() and (part.min(axis=0) <= view.upper).all()
    ]
    lines = LineCollection(parts, colors="#000000", linewidths=0.9, zorder=2.3)
    ax.add_collection(lines, autolim=False)
