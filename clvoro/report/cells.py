"""Pictures of cells: coloured by error, quality, size or number of sides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import (
    BoundaryNorm,
    LinearSegmentedColormap,
    ListedColormap,
    LogNorm,
    Normalize,
)
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, NullLocator
from numpy.typing import ArrayLike

from ..errors import InputError
from ..results import Diagram, Result
from .style import WIDTH, frame_domain, grid_height, interactive_figure, nice, styled

# Up to four, five, six, seven, eight and more sides: neutral for six, warm below, cool above.
_SIDES = ("#7F2704", "#E6762B", "#EDEDED", "#5AA6D1", "#08306B")
_SIDES_LABELS = ("4 or fewer", "5", "6", "7", "8 or more")

# Blue and red around white, without the darkest tenth at either end: faces must stay visible.
_DIVERGING = LinearSegmentedColormap.from_list(
    "error", colormaps["RdBu_r"](np.linspace(0.09, 0.91, 65))
)


@dataclass(frozen=True)
class Colouring:
    """What a colour stands for.

    Attributes
    ----------
    label : str
        With its unit, for the colour bar.
    values : function of a Result
        One number per cell.
    colour_map : str or colour map
        Perceptually uniform; diverging around zero for a signed quantity.
    limits : function of the values
        The scale's two ends.
    logarithmic : bool
    """

    label: str
    values: Callable[[Result], np.ndarray]
    colour_map: Any
    limits: Callable[[np.ndarray], tuple[float, float]]
    logarithmic: bool = False


def _symmetric(values: np.ndarray) -> tuple[float, float]:
    """Limits that 99 % of the values keep, the same on both sides of zero."""
    bound = nice(float(np.quantile(np.abs(values), 0.99))) if values.size else 1.0
    return -bound, bound


def _up_to_one(values: np.ndarray) -> tuple[float, float]:
    """Limits for a quality: from a round number below 99 % of the values up to 1."""
    low = float(np.quantile(values, 0.01)) if values.size else 0.0
    return min(np.floor(low * 20) / 20, 0.95), 1.0


def _span(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    return (low, high) if high > low * (1 + 1e-6) else (low * 0.99, low * 1.01)


COLOURINGS = {
    "error": Colouring(
        "metric error $e$ [–]   (< 0 too small, > 0 too large)",
        lambda r: r.error,
        _DIVERGING,
        _symmetric,
    ),
    "quality": Colouring("cell quality $Q$ [–]", lambda r: r.quality, "viridis", _up_to_one),
    "size": Colouring(
        "target size $h$ [units of length]", lambda r: r.size, "viridis", _span, logarithmic=True
    ),
    "sides": Colouring(
        "number of sides",
        lambda r: np.clip(np.diff(r.diagram.neighbour_starts), 4, 8),
        ListedColormap(_SIDES),
        lambda v: (3.5, 8.5),
    ),
}
"""What `plot_cells` can colour by."""


def colouring(name: str) -> Colouring:
    """Return the colouring of that name, or raise InputError."""
    if name not in COLOURINGS:
        raise InputError(f"colour is {name!r}, expected one of {', '.join(COLOURINGS)}")
    return COLOURINGS[name]


def shared_limits(results: Sequence[Result], colour: str) -> tuple[float, float]:
    """Return the scale that suits the cells of all `results` together."""
    scheme = colouring(colour)
    return scheme.limits(np.concatenate([scheme.values(r) for r in results]))


def require_plane(diagram: Diagram) -> None:
    """Raise InputError unless the diagram is two-dimensional."""
    if diagram.domain.dim != 2:
        raise InputError(
            "cells are drawn in two dimensions only, and this mesh has three; "
            "save it with result.save('mesh.vtu') and open it in ParaView"
        )


def plot_cells(
    result: Result,
    colour: str = "error",
    ax: Any = None,
    *,
    limits: tuple[float, float] | None = None,
    window: tuple[ArrayLike, ArrayLike] | None = None,
    edges: bool = True,
    key: bool = True,
    title: str | None = None,
) -> Any:
    """Draw the cells of a 2D mesh as coloured polygons.

    Parameters
    ----------
    result : Result
    colour : {"error", "quality", "size", "sides"}
        The paper's (3.1), its (4.1), the target size h, or the number of faces.
    ax : matplotlib axes, optional
        Drawn into; a new figure by default.
    limits : (low, high), optional
        Ends of the colour scale; by default those that 99 % of the cells keep.
    window : (lower, upper), optional
        Corners of the part to show; the whole domain by default.
    edges : bool
        Draw the faces, as thin as their cells are small.
    key : bool
        Add the colour bar (for "sides" the legend with the shares).
    title : str, optional

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        For an unknown colour, or a 3D mesh.
    """
    scheme, diagram = colouring(colour), result.diagram
    require_plane(diagram)
    corners = (diagram.domain.lower, diagram.domain.upper) if window is None else window
    lower, upper = (np.asarray(corner, float) for corner in corners)
    with styled():
        if ax is None:
            height = grid_height(lower, upper, 1, 1, 0.55, 0.25 * (title is not None))
            ax = interactive_figure(WIDTH, height).add_subplot()
        shown = _cells_in(diagram, lower, upper)
        values = scheme.values(result)
        low, high = scheme.limits(values) if limits is None else limits
        cells = draw_cells(ax, diagram, shown, values, scheme, (low, high))
        frame_domain(ax, lower, upper)
        if edges:
            draw_edges(ax, diagram, shown, np.subtract(upper, lower))
        if title is not None:
            ax.set_title(title)
        if key and colour == "sides":
            _add_side_key(ax, values)
        elif key:
            add_colour_bar(cells, ax, scheme, values, (low, high))
    return ax.figure


def draw_cells(
    ax: Any,
    diagram: Diagram,
    shown: np.ndarray,
    values: np.ndarray,
    scheme: Colouring,
    limits: tuple[float, float],
) -> PolyCollection:
    """Add the filled polygons of the cells `shown` (indices) to `ax`."""
    starts, corners = diagram.cell_vertex_starts, diagram.vertices[diagram.cell_vertices]
    polygons = [corners[starts[i] : starts[i + 1]] for i in shown]
    cells = PolyCollection(
        polygons,
        array=values[shown],
        cmap=scheme.colour_map,
        norm=_norm(scheme, limits),
        # An outline in the cell's own colour hides the seams that smoothing leaves between cells.
        edgecolors="face",
        linewidths=0.25,
        rasterized=len(shown) > 3000,
    )
    ax.add_collection(cells, autolim=False)
    return cells


def draw_edges(ax: Any, diagram: Diagram, shown: np.ndarray, extent: np.ndarray) -> None:
    """Add each face once, as a line whose width follows the size of the cells beside it."""
    box = ax.get_position()
    width, height = ax.figure.get_size_inches() * (box.width, box.height) * 72
    points_per_unit = min(width / extent[0], height / extent[1])
    thickness = np.clip(0.045 * points_per_unit * np.sqrt(diagram.volumes), 0.0, 0.7)
    starts, neighbours = diagram.cell_vertex_starts, diagram.neighbours
    owner = np.repeat(np.arange(len(diagram)), np.diff(starts))
    inside = np.zeros(len(diagram), bool)
    inside[shown] = True
    # A wall has no thickness of its own: there the cell counts twice.
    beyond = np.where(neighbours >= 0, neighbours, owner)
    thin = np.minimum(thickness[owner], thickness[beyond])
    once = np.flatnonzero((neighbours < owner) & inside[owner] & (thin > 0.06))
    # The thinnest fade out: a sudden end of all lines would look like a feature of the mesh.
    colours = np.full((len(once), 4), 0.1)
    colours[:, 3] = np.clip((thin[once] - 0.06) / 0.14, 0, 1)
    following = np.arange(len(owner)) + 1
    following[starts[1:] - 1] = starts[:-1]
    corners = diagram.vertices[diagram.cell_vertices]
    lines = LineCollection(
        list(np.stack([corners[once], corners[following[once]]], axis=1)),
        colors=colours,
        linewidths=thin[once],
        capstyle="round",
        rasterized=len(once) > 9000,
    )
    ax.add_collection(lines, autolim=False)


def add_colour_bar(
    cells: Any,
    axes: Any,
    scheme: Colouring,
    values: np.ndarray,
    limits: tuple[float, float],
    **options: Any,
) -> None:
    """Add the scale beside `axes` (one or several), with arrows where values lie beyond it."""
    low, high = limits
    below, above = (
        bool((values < low * (1 - 1e-9 * np.sign(low))).any()),
        bool((values > high).any()),
    )
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
    figure = (axes[0] if isinstance(axes, (list, np.ndarray)) else axes).figure
    bar = figure.colorbar(
        cells, ax=axes, **{"extend": extend, "shrink": 0.9, "aspect": 28, "pad": 0.02, **options}
    )
    bar.set_label(scheme.label)
    bar.outline.set_linewidth(0.4)  # type: ignore[operator]
    if scheme.logarithmic and isinstance(cells.norm, LogNorm):
        # Ticks at the ends themselves make them readable; a round number too near would collide.
        inner = [t for t in _round_numbers(low, high) if low * 1.12 < t < high / 1.12]
        bar.set_ticks([low, *inner, high])
        bar.minorlocator = NullLocator()
        bar.formatter = FuncFormatter(lambda t, _: f"{t:.2g}")
        bar.update_ticks()


def plot_size(size: Callable[[np.ndarray], np.ndarray], domain: Any, ax: Any = None) -> Any:
    """Draw a size field h(x) on a 2D domain, with contour lines: the paper's Figure 2.

    Parameters
    ----------
    size : callable h(points (n, 2)) -> (n,)
        Any field of `clvoro.sizing`, or a function of one's own.
    domain : Box
    ax : matplotlib axes, optional
        Drawn into; a new figure by default.

    Returns
    -------
    matplotlib.figure.Figure
    """
    scheme = COLOURINGS["size"]
    extent = domain.extent
    counts = np.maximum((extent * np.sqrt(60_000 / domain.measure)).astype(int), 2)
    x, y = (np.linspace(domain.lower[a], domain.upper[a], counts[a]) for a in (0, 1))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    values = np.asarray(size(points), float).reshape(len(y), len(x))
    low, high = scheme.limits(values)
    with styled():
        if ax is None:
            height = grid_height(domain.lower, domain.upper, 1, 1, 0.55, 0)
            ax = interactive_figure(WIDTH, height).add_subplot()
        image = ax.imshow(
            values,
            extent=(domain.lower[0], domain.upper[0], domain.lower[1], domain.upper[1]),
            origin="lower",
            interpolation="bilinear",
            cmap=scheme.colour_map,
            norm=_norm(scheme, (low, high)),
        )
        levels = [t for t in _round_numbers(low, high) if low * 1.02 < t < high * 0.98]
        if levels:
            lines = ax.contour(x, y, values, levels=levels, colors="white", linewidths=0.6)
            ax.clabel(lines, fmt="%g", fontsize=7)
        frame_domain(ax, domain.lower, domain.upper)
        add_colour_bar(image, ax, scheme, values, (low, high))
    return ax.figure


def _norm(scheme: Colouring, limits: tuple[float, float]) -> Normalize:
    """Return the map from values to [0, 1] that `scheme` asks for."""
    low, high = limits
    if isinstance(scheme.colour_map, ListedColormap):
        classes = scheme.colour_map.N
        return BoundaryNorm(np.linspace(low, high, classes + 1), classes)
    return LogNorm(low, high) if scheme.logarithmic and high > 3 * low > 0 else Normalize(low, high)


def _round_numbers(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten from `low` to `high`, both ends a little widened."""
    numbers = [float(f"{m}e{p}") for p in range(-12, 13) for m in (1, 2, 5)]
    return [t for t in numbers if low * 0.999 <= t <= high * 1.001]


def _add_side_key(ax: Any, values: np.ndarray) -> None:
    """Put the classes with their shares of all cells under the picture."""
    handles = [
        Patch(
            facecolor=colour,
            edgecolor="#1A1A1A",
            linewidth=0.4,
            label=f"{label} sides: {np.mean(values == number):.1%}",
        )
        for number, (colour, label) in enumerate(zip(_SIDES, _SIDES_LABELS, strict=True), start=4)
        if (values == number).any()
    ]
    ax.legend(
        handles=handles,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.09),
        ncols=len(handles),
        frameon=False,
        handlelength=1.2,
        columnspacing=1.4,
    )


def _cells_in(diagram: Diagram, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the indices of the cells that reach into the window."""
    starts = diagram.cell_vertex_starts[:-1]
    corners = diagram.vertices[diagram.cell_vertices]
    low = np.minimum.reduceat(corners, starts, axis=0)
    high = np.maximum.reduceat(corners, starts, axis=0)
    return np.flatnonzero(((high >= lower) & (low <= upper)).all(axis=1))
