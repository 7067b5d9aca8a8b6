"""Pictures of cells in the plane: colored by error, quality, size, number of sides, or skewness."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from numpy.typing import ArrayLike

from ..arguments import format_point
from ..errors import InputError
from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from ..mesh.connectivity import face_ends, face_owners
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from . import pixels
from .boundary import clip_to_domain, frame_part
from .colors import COLORINGS, Color, Coloring, cell_norm, coloring_of, picture_of, without_ends
from .legends import add_color_bar, add_key, round_numbers
from .style import WIDTH, corners_of, ends_of, interactive_figure, single_height, styled


def require_plane(diagram: Diagram) -> None:
    """Raise InputError unless the diagram is two-dimensional."""
    if diagram.domain.dim != 2:
        raise InputError(
            "plot_cells draws in two dimensions, and this mesh has three; call result.plot(), plot_slice or "
            "plot_cutaway, or save it with result.save('mesh.vtu') and open it in ParaView"
        )


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
        For an unknown color, an array of another shape, or a 3D mesh.
    """
    result = picture_of(mesh)
    diagram = result.diagram
    require_plane(diagram)
    scheme = coloring_of(result, color, label)
    whole = (diagram.domain.lower, diagram.domain.upper)
    lower, upper = np.array(whole) if window is None else corners_of(window)
    with styled():
        if ax is None:
            height = single_height(lower, upper, bool(scheme.classes), title is not None)
            ax = interactive_figure(WIDTH, height).add_subplot()
        shown, offsets = _cells_in(diagram, lower, upper)
        if not len(shown):
            raise InputError(
                f"no cell is in the window {format_point(lower)}, {format_point(upper)}, expected a part of "
                f"{diagram.domain}"
            )
        values = scheme.values(result)
        seen = values if window is None else values[np.unique(shown)]
        low, high = scheme.limits(seen) if limits is None else ends_of(limits)
        if len(shown) > pixels.MOST_POLYGONS:
            cells = pixels.add_image(ax, diagram, lower, upper, values, scheme, (low, high))
            clip_to_domain(ax, diagram.domain, cells)
        else:
            cells = draw_cells(ax, diagram, shown, offsets, values, scheme, (low, high))
        frame_part(ax, diagram.domain, lower, upper)
        if edges:
            draw_edges(ax, diagram, shown, offsets, np.subtract(upper, lower))
        if title is not None:
            ax.set_title(title)
        if key:
            add_key(cells, ax, scheme, seen, (low, high))
    return ax.figure


def draw_cells(
    ax: Any,
    diagram: Diagram,
    shown: np.ndarray,
    offsets: np.ndarray,
    values: np.ndarray,
    scheme: Coloring,
    limits: tuple[float, float],
) -> PolyCollection:
    """Add the filled polygons of the cells `shown` (indices), moved by `offsets`, to `ax`."""
    starts, corners = diagram.cell_vertex_starts, diagram.vertices[diagram.cell_vertices]
    bridged = np.diff(starts) > np.diff(diagram.neighbor_starts)
    polygons = [corners[starts[i] : starts[i + 1]] + by for i, by in zip(shown, offsets, strict=True)]
    cells = PolyCollection(
        polygons,
        array=without_ends(values[shown]),
        cmap=scheme.color_map,
        norm=cell_norm(scheme, limits),
        # An outline in the color of the cell hides gaps between cells from antialiasing. Not a bridge between the loops
        # of a cell: between its parts it may cross an island.
        edgecolors="face",
        linewidths=np.where(bridged, 0, 0.25)[shown] if bridged.any() else 0.25,
        rasterized=len(shown) > 3000,
    )
    ax.add_collection(cells, autolim=False)
    return cells


def draw_edges(ax: Any, diagram: Diagram, shown: np.ndarray, offsets: np.ndarray, extent: np.ndarray) -> None:
    """Add each face once, as a line; its width follows the size of its cells."""
    neighbors, owner = diagram.neighbors, face_owners(diagram)
    if not len(shown):
        return
    # At a wall there is only one cell.
    beyond = np.where(neighbors >= 0, neighbors, owner)
    lengths = np.sqrt(diagram.volumes)
    thin, colors = edge_style(ax, np.minimum(lengths[owner], lengths[beyond]), extent)
    # A seam has faces on both sides.
    wanted = ((neighbors < owner) | diagram.shifts.any(axis=1)) & (thin > 0.06)
    order = np.argsort(shown, kind="stable")
    first, last = (np.searchsorted(shown[order], owner, side) for side in ("left", "right"))
    counts = np.where(wanted, last - first, 0)  # images of the face's cell that are shown
    once = np.repeat(np.arange(len(owner)), counts)
    image = order[np.repeat(first, counts) + np.arange(len(once)) - np.repeat(np.cumsum(counts) - counts, counts)]
    ends = diagram.vertices[face_ends(diagram)[once]] + offsets[image][:, None, :]
    lines = LineCollection(
        list(ends), colors=colors[once], linewidths=thin[once], capstyle="round", rasterized=len(once) > 9000
    )
    ax.add_collection(lines, autolim=False)


def edge_style(ax: Any, lengths: np.ndarray, extent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return line widths in points and colors (n, 4) for edges of cells as long as `lengths`.

    `extent` is the width and height of the shown part. Edges of very small cells get no width.
    """
    widths = np.clip(0.045 * points_per_unit(ax, extent) * lengths, 0.0, 0.7)
    # The thinnest lines fade out: a sudden end of all lines would look like a feature of the mesh.
    colors = np.full((len(widths), 4), 0.1)
    colors[:, 3] = np.clip((widths - 0.06) / 0.14, 0, 1)
    return widths, colors


def points_per_unit(ax: Any, extent: np.ndarray) -> float:
    """Return the scale of a picture that shows a part of this width and height, points per unit of length."""
    box = ax.get_position()
    width, height = ax.figure.get_size_inches() * (box.width, box.height) * 72
    return float(min(width / extent[0], height / extent[1]))


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
        For a 3D domain.
    """
    if domain.dim != 2:
        raise InputError(f"the size field is drawn on 2D domains, and {domain} is in 3D; draw a slice of a mesh")
    scheme = COLORINGS["size"]
    extent = domain.extent
    counts = np.maximum((extent * np.sqrt(60_000 / max(domain.measure, extent.prod() / 8))).astype(int), 2)
    x, y = (np.linspace(domain.lower[a], domain.upper[a], counts[a]) for a in (0, 1))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    shown, places = _inside(domain, points, 2 * float(np.hypot(*(extent / counts))))
    values = np.full(len(points), np.nan)
    values[shown] = np.asarray(size(places), float)
    low, high = scheme.limits(values[shown])
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
            norm=cell_norm(scheme, (low, high)),
        )
        levels = [t for t in round_numbers(low, high) if low * 1.02 < t < high * 0.98]
        if levels:
            lines = ax.contour(x, y, values, levels=levels, colors="white", linewidths=0.6)
            ax.clabel(lines, fmt="%g", fontsize=7)
            clip_to_domain(ax, domain, lines)
        frame_part(ax, domain, domain.lower, domain.upper)
        clip_to_domain(ax, domain, image)
        add_color_bar(image, ax, scheme, values, (low, high))
    return ax.figure


def _inside(domain: Domain, points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return which `points` are in the domain or within `reach` of it, (n,) bool, and the nearest points inside.

    Drawing up to the boundary interpolates between points inside and points just outside.
    """
    shown = domain.contains(points)
    if isinstance(domain, Polygon):
        rest = np.flatnonzero(~shown)
        shown[rest] = domain.boundary_distance(points[rest]) <= reach
        return shown, domain.nearest(points[shown])
    return shown, points[shown]


def _cells_in(diagram: Diagram, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (k,) of the cells, or of their images, that reach into the window, and offsets (k, 2)."""
    starts = diagram.cell_vertex_starts[:-1]
    corners = diagram.vertices[diagram.cell_vertices]
    low = np.minimum.reduceat(corners, starts, axis=0)
    high = np.maximum.reduceat(corners, starts, axis=0)
    cells, offsets = [], []
    for step in product(*((-1, 0, 1) if p else (0,) for p in diagram.domain.periodic)):
        by = step * diagram.domain.extent
        # An image must reach in by more than round-off.
        slack = 1e-9 * diagram.domain.extent * any(step)
        seen = np.flatnonzero(((high + by >= lower + slack) & (low + by <= upper - slack)).all(axis=1))
        cells.append(seen)
        offsets.append(np.broadcast_to(by, (len(seen), 2)))
    return np.concatenate(cells), np.concatenate(offsets)
