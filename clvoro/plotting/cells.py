"""Meshes of too many cells for polygons: images in which each pixel has the color of the cell at its center."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast
from weakref import WeakKeyDictionary

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.typing import ArrayLike

from ..arguments import format_point
from ..connectivity import following, starts_of
from ..errors import InputError
from ..geometry.domain import Domain, images_in
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .colors import COLORINGS, Color, Paint, paint_of, picture_of
from .legends import add_color_bar, finished, round_numbers
from .style import WIDTH, corners_of, frame_domain, interactive_figure, single_height, styled

MOST_POLYGONS = 30_000
"""With more cells in a picture, it is an image."""
PER_INCH = 200
"""Pixels of an image per inch of its axes."""
_RIM = 3
"""Pixels outside of the domain, that far from it, have the color of the nearest pixel inside."""

Positions = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

_last: WeakKeyDictionary[Diagram, tuple[np.ndarray, ...]] = WeakKeyDictionary()
"""For the last image of each diagram: which pixels show the mesh, their positions, and their cells. A report shows the
same part in several colors, so the cells are found once."""


def add_image(ax: Any, diagram: Diagram, paint: Paint, positions: Positions | None = None) -> Any:
    """Add an image of the mesh that fills `ax`, whose limits are set, and return it.

    `positions` returns for places (k, 2) in the picture which of them show the mesh, (k,) bool, and where those are in
    the domain, (j, d). By default a place is its own position.
    """
    lower, upper = np.transpose([ax.get_xlim(), ax.get_ylim()])
    extent = upper - lower
    box = ax.get_position()
    inches = ax.figure.get_size_inches() * (box.width, box.height)
    counts = np.maximum(np.ceil(PER_INCH * min(inches / extent) * extent), 2).astype(int)
    x, y = (lower[a] + extent[a] * (np.arange(counts[a]) + 0.5) / counts[a] for a in (0, 1))
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside, at = (np.ones(len(places), bool), places) if positions is None else positions(places)
    known = _last.get(diagram)
    if known is None or not all(map(np.array_equal, known, (inside, at))):
        cells = np.full(len(places), -1)
        cells[inside] = diagram.locate(at)
        known = _last[diagram] = inside, at, _with_rim(cells.reshape(len(y), len(x)))
    # -1 leads to the last place.
    shown = np.append(paint.finite, np.nan)[known[2]]
    # The method of plain axes: those of a map would look for its projection.
    return Axes.imshow(
        ax,
        np.ma.masked_invalid(shown),
        extent=(lower[0], upper[0], lower[1], upper[1]),
        origin="lower",
        # Colors are interpolated: between classes there are no further ones.
        interpolation_stage="rgba",
        cmap=paint.scheme.color_map,
        norm=paint.norm,
    )


def _with_rim(cells: np.ndarray) -> np.ndarray:
    """Return the cells of pixels, -1 where there is none, with the nearest cell at pixels just outside of the mesh."""
    outside = cells < 0
    if not outside.any() or outside.all():
        return cells
    distances, nearest = cast(
        "tuple[np.ndarray, np.ndarray]", scipy.ndimage.distance_transform_edt(outside, return_indices=True)
    )
    return np.where(distances <= _RIM, cells[tuple(nearest)], -1)


_LINE = {"edgecolor": "#1A1A1A", "linewidth": 0.8, "facecolor": "none", "joinstyle": "round"}
_MARGIN = 0.01  # of the longer side, around a whole domain


def frame_part(ax: Any, domain: Domain, lower: Any, upper: Any, ticks: bool = True) -> None:
    """Show the part of the domain from `lower` to `upper` to scale: a frame, and its outline if it has one.

    An outline shown as a whole has no other frame.
    """
    whole = np.array_equal(lower, domain.lower) and np.array_equal(upper, domain.upper)
    outline = _outline_path(domain)
    room = _MARGIN * domain.extent.max() if whole and outline else 0.0
    frame_domain(ax, np.subtract(lower, room), np.add(upper, room), ticks)
    if outline:
        if whole:
            for spine in ax.spines.values():
                spine.set_visible(False)
        ax.add_patch(PathPatch(outline, zorder=2.5, **_LINE))


def clip_to_domain(ax: Any, domain: Domain, artist: Any) -> None:
    """Clip `artist` to the outline of the domain."""
    outline = _outline_path(domain)
    if outline:
        artist.set_clip_path(outline, ax.transData)


def _outline_path(domain: Domain) -> Path | None:
    """Return the outline as a path, or None: outer rings run counter-clockwise, holes clockwise."""
    if domain.outline is None:
        return None
    closed = [np.vstack([ring, ring[:1]]) for ring in domain.outline.oriented.rings]
    return Path.make_compound_path(*(Path(ring, closed=True) for ring in closed))


_INK, _LIGHT_INK = np.full(3, 0.1), np.full(3, 0.75)
_LUMINANCE, _DARK = np.array([0.2126, 0.7152, 0.0722]), 0.3
"""Weights of red, green and blue in the luminance of a color, and the luminance below which a cell has light edges."""
_LEAST = 0.06
"""Width in points of the thinnest edges."""
_SEAM = 0.25
"""Width in points of an outline in the color of the cell. It hides gaps between cells from antialiasing."""


def plot_cells(
    mesh: Result | Diagram,
    color: Color | ArrayLike = "error",
    ax: Any = None,
    *,
    label: str | None = None,
    limits: tuple[float, float] | None = None,
    window: tuple[ArrayLike, ArrayLike] | None = None,
    edges: bool = True,
    key: bool = True,
    title: str | None = None,
) -> Any:
    """Draw the cells of a 2D mesh as colored polygons.

    With more than 30,000 cells in the picture each pixel has the color of the cell at its center.

    Parameters
    ----------
    mesh : Result or Diagram
        In a box, periodic or not, or in a polygon.
    color : {"error", "quality", "size", "sides", "skewness", "volume"} or (n,) array of real numbers
        The paper's (3.1), its (4.1), the target size h, the number of faces, the skewness of the worst face, the area,
        or data of your own. A diagram has neither "error" nor "size".
    ax : matplotlib axes, optional
        Drawn into; a new figure by default.
    label : str, optional
        Text at the color bar; by default that of `color`.
    limits : (low, high), optional
        Ends of the color scale; by default limits that hold 99 % of the cells shown.
    window : (lower, upper), optional
        Corners of the part to show; the whole domain by default.
    edges : bool
        Draw the faces; the line width follows the size of the cells.
    key : bool
        Add the color bar (for "sides" the legend with the shares).
    title : str, optional

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError, InputTypeError
        For an unknown color, an array of another shape, or a mesh in 3D or on a sphere.
    """
    result = picture_of(mesh)
    diagram = result.diagram
    domain = diagram.domain
    domain.require_plane("plot_cells draws in the plane", "call result.plot(), or open mesh.vtu in ParaView")
    lower, upper = np.array((domain.lower, domain.upper)) if window is None else corners_of(window)
    cells, offsets = _cells_in(diagram, lower, upper)
    if not len(cells):
        raise InputError(
            f"no cell is in the window {format_point(lower)}, {format_point(upper)}, expected a part of {domain}"
        )
    paint = paint_of(result, color, label, limits, np.unique(cells))
    with styled():
        if ax is None:
            height = single_height(lower, upper, bool(paint.scheme.classes), title is not None)
            ax = interactive_figure(WIDTH, height).add_subplot()
        frame_part(ax, domain, lower, upper)
        starts, corners = diagram.cell_vertex_starts, diagram.vertices[diagram.cell_vertices]
        polygons = [corners[starts[i] : starts[i + 1]] + by for i, by in zip(cells, offsets, strict=True)]
        bridged = (np.diff(starts) > np.diff(diagram.neighbor_starts))[cells]
        image = draw_cells(ax, diagram, cells, polygons, paint, edges, bridged)
        clip_to_domain(ax, domain, image)
        seen = paint if window is None else replace(paint, values=paint.values[np.unique(cells)])
        return finished(ax, seen, key, title)


def draw_cells(
    ax: Any,
    diagram: Diagram,
    cells: np.ndarray,
    polygons: Sequence[np.ndarray],
    paint: Paint,
    edges: bool = True,
    bridged: np.ndarray | None = None,
    positions: Positions | None = None,
) -> Any:
    """Add `polygons` (k, 2) of the rows `cells`, to `ax`, whose limits are set; return what covers the picture.

    Many polygons become an image, for which `positions` is as in `add_image`. Cells with large faces are
    drawn over it. `bridged` (n,) marks outlines that connect several loops.
    """
    widths = edge_widths(ax, polygons) if edges else np.zeros(len(polygons))
    bridged = np.zeros(len(cells), bool) if bridged is None else bridged
    image: Any = None
    if len(cells) > MOST_POLYGONS:
        image = add_image(ax, diagram, paint, positions)
        shown = np.flatnonzero(widths > _LEAST).tolist()
        cells, polygons, widths, bridged = cells[shown], [polygons[k] for k in shown], widths[shown], bridged[shown]
    drawn = draw_polygons(ax, cells, polygons, paint, widths, bridged)
    if edges and bridged.any():
        # A bridge between two loops is no face.
        lines = diagram.half_faces.ends[np.isin(diagram.half_faces.owner, cells[bridged])]
        ax.add_collection(LineCollection(list(diagram.vertices[lines]), colors=[_INK], linewidths=0.4), autolim=False)
    return drawn if image is None else image


def draw_polygons(
    ax: Any,
    cells: np.ndarray,
    polygons: Sequence[np.ndarray],
    paint: Paint,
    widths: np.ndarray,
    bare: np.ndarray | None = None,
    light: np.ndarray | None = None,
    colors: np.ndarray | None = None,
) -> PolyCollection:
    """Add filled polygons (k, 2) with outlines; those marked by `bare` have none.

    `light` (n,) dims their `colors` (n, 4), by default those of the cells.
    """
    colors = paint.rgba(cells) if colors is None else colors.copy()
    if light is not None:
        colors[:, :3] *= light[:, None]
    # The thinnest lines fade out: a sudden end of all lines would look like a feature of the mesh.
    alpha = 0.9 * np.clip((widths - _LEAST) / 0.14, 0, 1)[:, None]
    lines = colors.copy()
    dark = (colors[:, :3] @ _LUMINANCE < _DARK)[:, None]
    lines[:, :3] += alpha * (np.where(dark, _LIGHT_INK, _INK) - colors[:, :3])
    widths = np.maximum(widths, _SEAM)
    drawn = PolyCollection(
        list(polygons),
        edgecolors=lines,
        linewidths=widths if bare is None else np.where(bare, 0, widths),
        joinstyle="round",
        rasterized=len(polygons) > 3000,
    )
    if light is None:
        drawn.set(array=paint.finite[cells], cmap=paint.scheme.color_map, norm=paint.norm)
    else:
        drawn.set_facecolor(colors)  # type: ignore[arg-type]
    ax.add_collection(drawn, autolim=False)
    return drawn


def edge_widths(ax: Any, polygons: Sequence[np.ndarray]) -> np.ndarray:
    """Return widths (n,) in points of the outlines of polygons: a part of their own width, 4 area / circumference."""
    if not len(polygons):
        return np.zeros(0)
    starts = starts_of([len(p) for p in polygons])
    corners = np.concatenate(polygons)
    corners = corners - np.repeat(corners[starts[:-1]], np.diff(starts), axis=0)
    (x, y), (u, v) = corners.T, corners[following(starts)].T
    area = 0.5 * np.abs(np.add.reduceat(x * v - y * u, starts[:-1]))
    around = np.add.reduceat(np.hypot(u - x, v - y), starts[:-1])
    width = 4 * area / np.where(around > 0, around, 1)
    return np.clip(0.042 * points_per_unit(ax) * width, 0, 0.7)


def points_per_unit(ax: Any) -> float:
    """Return the scale of a picture whose limits are set, points per unit of length."""
    box = ax.get_position()
    width, height = ax.figure.get_size_inches() * (box.width, box.height) * 72
    return float(min(width / np.ptp(ax.get_xlim()), height / np.ptp(ax.get_ylim())))


def plot_size(size: Callable[[np.ndarray], np.ndarray], domain: Any, ax: Any = None) -> Any:
    """Draw a size field h(x) on a 2D domain, with contour lines: the paper's Figure 2.

    Parameters
    ----------
    size : callable h(points (n, 2)) -> (n,)
        A field of `clvoro.sizing`, or any function.
    domain : Box or Polygon
        The field is evaluated inside only.
    ax : matplotlib axes, optional
        Drawn into; a new figure by default.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        For a domain in 3D or on a sphere.
    """
    domain.require_plane("the size field is drawn in the plane", "draw the sizes of a mesh")
    scheme = COLORINGS["size"]
    extent = domain.extent
    counts = np.maximum((extent * np.sqrt(60_000 / max(domain.measure, extent.prod() / 8))).astype(int), 2)
    x, y = (np.linspace(domain.lower[a], domain.upper[a], counts[a]) for a in (0, 1))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    # Up to the boundary, drawing interpolates between points inside and points just outside.
    shown = domain.contains(points)
    shown[~shown] = domain.boundary_distance(points[~shown]) <= 2 * float(np.hypot(*(extent / counts)))
    values = np.full(len(points), np.nan)
    values[shown] = np.asarray(size(domain.nearest(points[shown])), float)
    paint = Paint(scheme, values[shown], scheme.limits(values[shown]))
    low, high = paint.limits
    values = np.ma.masked_invalid(values).reshape(len(y), len(x))
    with styled():
        if ax is None:
            height = single_height(domain.lower, domain.upper)
            ax = interactive_figure(WIDTH, height).add_subplot()
        image = ax.imshow(
            values,
            extent=(domain.lower[0], domain.upper[0], domain.lower[1], domain.upper[1]),
            origin="lower",
            interpolation="bilinear",
            cmap=scheme.color_map,
            norm=paint.norm,
        )
        levels = [t for t in round_numbers(low, high) if low * 1.02 < t < high * 0.98]
        if levels:
            lines = ax.contour(x, y, values, levels=levels, colors="white", linewidths=0.6)
            ax.clabel(lines, fmt="%g", fontsize=7)
            clip_to_domain(ax, domain, lines)
        frame_part(ax, domain, domain.lower, domain.upper)
        clip_to_domain(ax, domain, image)
        add_color_bar(ax, paint)
    return ax.figure


def _cells_in(diagram: Diagram, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (k,) of the cells, or of their images, that reach into the window, and offsets (k, 2)."""
    starts = diagram.cell_vertex_starts[:-1]
    corners = diagram.vertices[diagram.cell_vertices]
    low, high = (bound.reduceat(corners, starts, axis=0) for bound in (np.minimum, np.maximum))
    images = images_in(diagram.domain, low, high, (lower, upper))
    cells = np.concatenate([rows for rows, _ in images])
    return cells, np.repeat([by for _, by in images], [len(rows) for rows, _ in images], axis=0)
