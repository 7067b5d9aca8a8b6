"""The pictures of a report, each a figure made from finished runs."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from ..geometry.sphere import Sphere
from ..mesh.results import Result
from . import cells as draw
from .colors import coloring, shared_limits
from .curves import displacements_height, plot_displacements, plot_history
from .globe import default_center, plot_globe
from .legends import add_color_bar
from .slices import focus, new_slices, plot_slice
from .solids import cutaway_height, plot_cutaway, plot_distributions
from .style import WIDTH, grid_height, new_figure, single_height, styled, window_around_smallest

Picture = tuple[str, str, Callable[[], Any]]
"""A picture: file name, caption, and the function that draws it."""

FINE_MESH = 10_000
"""From this many cells on, the cells show the size field, not a raster."""
MANY_SOLID_CELLS = 20_000
"""From this many cells on, there is also a closer view of a 3D mesh."""


def pictures_of(
    results: Mapping[str, Result], initial: Result | None = None, size: Callable[[np.ndarray], np.ndarray] | None = None
) -> list[Picture]:
    """List the pictures of `results`; nothing is drawn yet.

    Parameters
    ----------
    results : mapping
        Results by the method's name, all from one start; the last is the main one.
    initial : Result, optional
        The mesh before the first step.
    size : callable, optional
        The size field h(points (n, 2)); without it, and in 3D, the sizes at the generators are shown.
    """
    name, main = list(results.items())[-1]
    history: Picture = (
        "history",
        "Metric error and cell quality against the step: mean (full) and worst cell (dashed).",
        lambda: plot_history(results, new_figure(WIDTH, 3.1)),
    )
    panels = {**({"initial": initial} if initial is not None else {}), **results}
    if isinstance(main.diagram.domain, Sphere):
        return _globe_pictures(panels, history)
    if main.diagram.domain.dim != 2:
        return _solid_pictures(panels, history)
    pictures: list[Picture] = [
        ("size", "Target size h.", lambda: _size(main, size)),
        ("cells", f"The mesh ({name}), colored by metric error.", lambda: _one(main, "error")),
    ]
    if len(panels) == 1:
        caption = f"The mesh ({name}), colored by cell quality; 1 is a regular polygon."
        pictures.append(("quality", caption, lambda: _one(main, "quality")))
    else:
        pictures += _comparisons(panels)
    pictures.append(history)
    if main.initial is not None or main.final is not None:
        height = displacements_height(main)
        pictures.append(
            (
                "displacements",
                f"The two halves of a step's displacements ({name}): Lloyd's and the Poisson correction's.",
                lambda: plot_displacements(main, new_figure(WIDTH, height)),
            )
        )
    pictures.append(("sides", f"Cells by number of sides ({name}).", lambda: _one(main, "sides")))
    if len(main.points) > 3000:
        pictures.append(("closer", f"Where the cells are smallest ({name}).", lambda: _closer(main)))
    return pictures


def _solid_pictures(panels: Mapping[str, Result], history: Picture) -> list[Picture]:
    """Return the pictures of 3D meshes: planes through them, and a view into the last one."""
    name, main = list(panels.items())[-1]

    def slices(color: str) -> Callable[[], Any]:
        return lambda: new_slices(main, color)

    pictures: list[Picture] = [
        ("size", "Target size h at the generators, on planes through the smallest cells.", slices("size")),
        ("cells", f"The mesh ({name}), colored by metric error.", slices("error")),
        ("cutaway", f"A view into the mesh ({name}).", lambda: _cutaway(main)),
        (
            "quality",
            f"The mesh ({name}), colored by cell quality; 1 is a ball, .75 a truncated octahedron.",
            slices("quality"),
        ),
    ]
    if len(panels) > 1:
        pictures += _comparisons(panels)
    pictures += [
        history,
        (
            "distributions",
            f"Cells ({name}) by metric error, quality and number of faces; faces by skewness. Dashed: the mean.",
            lambda: plot_distributions(main, new_figure(WIDTH, 4.2)),
        ),
        ("sides", f"Cells by number of faces ({name}).", slices("sides")),
    ]
    if len(main.points) > MANY_SOLID_CELLS:
        pictures.append(("closer", f"Where the cells are smallest ({name}).", lambda: _closer_slice(main)))
    return pictures


def _globe_pictures(panels: Mapping[str, Result], history: Picture) -> list[Picture]:
    """Return the pictures of meshes on a sphere: the globe, longitudes and latitudes, and a closer view."""
    name, main = list(panels.items())[-1]

    def globe(color: str, **options: Any) -> Callable[[], Any]:
        return lambda: _globe(main, color, **options)

    pictures: list[Picture] = [
        ("size", "Target size h, where cells are smallest.", globe("size", edges=False)),
        ("plate", "Target size h against longitude and latitude.", globe("size", projection="plate", edges=False)),
        ("cells", f"The mesh ({name}), colored by metric error.", globe("error")),
    ]
    if len(panels) == 1:
        caption = f"The mesh ({name}), colored by cell quality; 1 is a regular polygon."
        pictures.append(("quality", caption, globe("quality")))
    else:
        pictures += _comparisons(panels)
    pictures += [history, ("sides", f"Cells by number of sides ({name}).", globe("sides"))]
    if len(main.points) > 3000:
        pictures.append(("closer", f"Where the cells are smallest ({name}).", lambda: _closer_globe(main)))
    return pictures


def _globe(result: Result, color: str, **options: Any) -> Any:
    """Draw one large picture of the whole sphere."""
    flat = options.get("projection") == "plate"
    legend = bool(coloring(color).classes)
    extent = (360, 180) if flat else (2, 2)
    with styled():
        figure = new_figure(WIDTH, single_height((0, 0), extent, legend))
        return plot_globe(result, color, figure.add_subplot(), **options)


def _closer_globe(result: Result) -> Any:
    """Draw two parts around the region with the smallest cells, the second four times closer."""
    smallest = float(np.quantile(result.target_size, 0.01))
    radius = float(np.linalg.norm(result.points[0]))

    def draw_part(ax: Any, across: int, limits: tuple[float, float]) -> None:
        angle = min(float(np.degrees(across * smallest / radius)), 90.0)
        plot_globe(result, "quality", ax, across=angle, limits=limits, key=False)

    return _two_closer(result, draw_part)


def _cutaway(result: Result) -> Any:
    figure = new_figure(WIDTH, cutaway_height(result))
    return plot_cutaway(result, "error", figure.add_subplot())


def _closer_slice(result: Result) -> Any:
    """Draw a square window around the smallest cell, on the plane of the largest section."""
    normal = _largest_section(result)
    axes = [a for a in range(3) if a != normal]
    center = result.points[np.argmin(result.target_size)]
    box = result.diagram.domain
    lower, upper = np.array(box.lower)[axes], np.array(box.upper)[axes]
    across = 60
    span = np.minimum(across * float(result.target_size.min()), upper - lower)
    corner = np.clip(center[axes] - span / 2, lower, upper - span)
    with styled():
        figure = new_figure(WIDTH, (WIDTH - 1.3) * float(span[1] / span[0]) + 0.6)
    name = "xyz"[normal]
    return plot_slice(
        result,
        "quality",
        figure.add_subplot(),
        normal=name,
        through=center,
        window=(corner, corner + span),
        title=f"{across} $h_\\mathrm{{min}}$ across, ${name} = {center[normal]:.3g}$",
    )


def _largest_section(result: Result) -> int:
    """Return the axis at right angles to the largest section of the domain; of several the last."""
    extent = result.diagram.domain.extent
    return int(np.flatnonzero(extent <= extent.min() * 1.001)[-1])


def _comparisons(panels: Mapping[str, Result]) -> list[Picture]:
    """Return the pictures of several meshes side by side."""
    return [
        (
            "diagrams_error",
            "Metric error e, one scale for all: red cells are too large, blue ones too small.",
            lambda: _grid(panels, "error"),
        ),
        (
            "diagrams_quality",
            "Cell quality Q, one scale for all: 1 is a regular polygon (in 3D a ball).",
            lambda: _grid(panels, "quality"),
        ),
    ]


def render(figure: Any, kind: str = "png", dpi: int = 170) -> bytes:
    """Return a figure as the bytes of a PNG, PDF or SVG file."""
    with styled(), io.BytesIO() as buffer:
        # Without date and version: the same run gives the same file.
        metadata = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
        figure.savefig(buffer, format=kind, dpi=dpi, bbox_inches="tight", pad_inches=0.04, metadata=metadata[kind])
        return buffer.getvalue()


def _one(result: Result, color: str, **options: Any) -> Any:
    """Draw one large picture of the whole domain."""
    with styled():
        box, legend = result.diagram.domain, bool(coloring(color).classes)
        figure = new_figure(WIDTH, single_height(box.lower, box.upper, legend))
        return draw.plot_cells(result, color, figure.add_subplot(), **options)


def _size(result: Result, size: Callable[[np.ndarray], np.ndarray] | None) -> Any:
    """Draw the target size: the field, or that of the cells if they resolve it better than a raster."""
    if size is None or len(result.points) > FINE_MESH:
        return _one(result, "size", edges=False)
    with styled():
        box = result.diagram.domain
        figure = new_figure(WIDTH, single_height(box.lower, box.upper))
        return draw.plot_size(size, box, figure.add_subplot())


def _grid(panels: Mapping[str, Result], color: str) -> Any:
    """Draw the meshes side by side with one scale."""
    results = list(panels.values())
    box = results[0].diagram.domain
    scheme, limits = coloring(color, box), shared_limits(results, color)
    if color == "error":  # a larger limit would hide small errors
        limits = (max(limits[0], -1.0), min(limits[1], 1.0))
    plot: Callable[..., Any] = draw.plot_cells
    lower, upper = np.array(box.lower), np.array(box.upper)
    if isinstance(box, Sphere):
        plot = partial(plot_globe, center=default_center(results[-1]))
        lower, upper = lower[:2], upper[:2]
    elif box.dim == 3:
        normal = _largest_section(results[-1])
        plot = partial(plot_slice, normal="xyz"[normal], through=focus(results[-1]))
        lower, upper = (np.delete(corner, normal) for corner in (lower, upper))
    columns = 1 if len(results) == 1 else 2
    rows = -(-len(results) // columns)
    with styled():
        figure = new_figure(WIDTH, grid_height(lower, upper, rows, columns, 0.6, 0.28))
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for letter, ax, (name, result) in zip("abcdefghij", axes, panels.items(), strict=False):
            e, q = np.abs(result.size_error).mean(), result.quality.mean()
            title = f"({letter}) {name}: mean $|e|$ {e:.3g}, mean $Q$ {q:.3f}"
            plot(result, color, ax, limits=limits, key=False, title=title)
            ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
        for ax in axes[len(results) :]:
            ax.set_axis_off()
        values = np.concatenate([scheme.values(r) for r in results])
        drawn = (*axes[0].collections, *axes[0].images)
        cells = next(c for c in drawn if c.get_array() is not None)
        add_color_bar(cells, axes, scheme, values, limits, location="bottom", shrink=0.6, aspect=45)
    return figure


def _closer(result: Result) -> Any:
    """Draw two windows around the smallest cells, the second four times closer."""

    def draw_part(ax: Any, across: int, limits: tuple[float, float]) -> None:
        window = window_around_smallest(result, across)
        draw.plot_cells(result, "quality", ax, limits=limits, window=window, key=False)
        ax.locator_params(nbins=4)

    return _two_closer(result, draw_part, 0.8)


def _two_closer(result: Result, draw_part: Callable[[Any, int, tuple[float, float]], None], ratio: float = 1.0) -> Any:
    """Draw two closer views, colored by quality; `ratio` is that of height and width."""
    with styled():
        figure = new_figure(WIDTH, WIDTH / 2 * ratio + 0.75)
        axes = figure.subplots(1, 2)
        limits = shared_limits([result], "quality")
        for ax, across in zip(axes, (160, 40), strict=True):
            draw_part(ax, across, limits)
            ax.set_title(f"{across} $h_\\mathrm{{min}}$ across, where $h$ is smallest")
        scheme = coloring("quality")
        cells = next(c for c in (*axes[1].collections, *axes[1].images) if c.get_array() is not None)
        add_color_bar(cells, axes, scheme, result.quality, limits, location="bottom", shrink=0.6, aspect=45)
    return figure
