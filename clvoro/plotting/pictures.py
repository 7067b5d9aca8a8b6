"""The pictures of a mesh by its kind: what `Diagram.plot` and `Result.plot` draw."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from inspect import signature
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..geometry.domain import Domain
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .cells import plot_cells, plot_size
from .colors import Color, Paint, picture_of, shared_paint
from .curves import plot_distributions, plot_history
from .globe import default_center, map_projection, plot_globe
from .legends import add_key
from .solids import around_body, focus, plane_axes, plot_cutaway, plot_slice, plot_slices
from .style import WIDTH, detached, grid_height, new_figure, styled

View = Literal["cells", "globe", "slices", "slice", "cutaway"]
VIEWS: dict[str, Callable[..., Any]] = {
    "cells": plot_cells,
    "globe": plot_globe,
    "slices": plot_slices,
    "slice": plot_slice,
    "cutaway": plot_cutaway,
}


def views_of(domain: Domain) -> tuple[str, ...]:
    """Return the views of meshes in `domain`, the default first."""
    if domain.curved:
        return ("globe",)
    return {2: ("cells",), 3: ("slices", "slice", "cutaway")}[domain.cell_dim]


def plot_mesh(
    mesh: Result | Diagram, color: Color | ArrayLike = "error", view: View | None = None, **options: Any
) -> Any:
    """Draw a mesh; see `Diagram.plot`.

    Raises
    ------
    InputError, InputTypeError
        If the mesh does not have the view, the view does not have an option, or a color does not exist.
    MissingLibraryError
        If a library for this view is not installed.
    """
    fitting = views_of(picture_of(mesh).diagram.domain)
    chosen = fitting[0] if view is None else view
    if chosen not in fitting:
        raise InputError(f"view is {view!r}, expected one of {', '.join(fitting)} for this mesh")
    known = [name for name in signature(VIEWS[chosen]).parameters if name not in ("mesh", "color")]
    for name in options:
        if name not in known:
            others = [k for k, draw in VIEWS.items() if name in signature(draw).parameters]
            where = f"is an option of the view {' and '.join(others)}" if others else "is no option"
            raise InputError(f"{name} {where}; the view {chosen} has {', '.join(known)}")
    return VIEWS[chosen](mesh, color, **options)


Picture = tuple[str, str, Callable[[], Any]]
"""A picture: file name, caption, and the function that draws it."""

FINE_MESH = 10_000
"""From this many cells on, the cells show the size field, not a raster."""
MANY_CELLS = {"cells": 3000, "globe": 3000, "slices": 20_000}
"""From this many cells on, by the view of a mesh, there is also a closer view."""
_QUALITY = {
    "cells": "1 is a regular polygon",
    "globe": "1 is a regular polygon",
    "slices": "1 is a ball, .75 a truncated octahedron",
}


def pictures_of(
    results: Mapping[str, Result], initial: Result | None = None, size: Callable[[np.ndarray], np.ndarray] | None = None
) -> list[Picture]:
    """List the pictures of `results`; nothing is drawn yet.

    - `results`: results by the method's name, all from one start; the last is the main one.
    - `initial`: the mesh before the first step.
    - `size`: the size field h(points (n, 2)); without it, and in 3D, the sizes at the generators are shown.
    """
    name, main = list(results.items())[-1]
    panels = {**({"initial": initial} if initial is not None else {}), **results}
    domain = main.diagram.domain
    view = views_of(domain)[0]
    solid = view == "slices"
    plain = {} if solid else {"edges": False}

    def whole(color: str, **options: Any) -> Callable[[], Any]:
        return lambda: plot_mesh(main, color, **options)

    if view == "cells" and size is not None and len(main.points) <= FINE_MESH:
        pictures: list[Picture] = [("size", "Target size h.", lambda: plot_size(size, domain))]
    else:
        pictures = [("size", "Target size h at the generators.", whole("size", **plain))]
    if view == "globe":
        caption = "Target size h against longitude and latitude."
        pictures.append(("plate", caption, whole("size", projection="plate", **plain)))
    pictures.append(("cells", f"The mesh ({name}), colored by metric error.", whole("error")))
    if solid:
        cut = {"cut": "y"} if around_body(main.diagram) else {}
        pictures.append(("cutaway", f"A view into the mesh ({name}).", whole("error", view="cutaway", **cut)))
    if solid or len(panels) == 1:
        caption = f"The mesh ({name}), colored by cell quality; {_QUALITY[view]}."
        pictures.append(("quality", caption, whole("quality")))
    if len(panels) > 1:
        error = "Metric error e, one scale for all, up to three times the errors of the best: red is too large."
        quality = "Cell quality Q, one scale for all: 1 is a regular polygon (in 3D a ball)."
        pictures += [
            ("diagrams_error", error, lambda: _compare(panels, "error")),
            ("diagrams_quality", quality, lambda: _compare(panels, "quality")),
        ]
    caption = "Metric error and cell quality against the step: mean (full) and worst cell (dashed)."
    pictures.append(("history", caption, lambda: plot_history(results)))
    if solid:
        caption = f"Cells ({name}) by metric error, quality and number of faces; faces by skewness. Dashed: the mean."
        pictures.append(("distributions", caption, lambda: plot_distributions(main)))
    pictures.append(("sides", f"Cells by number of {'faces' if solid else 'sides'} ({name}).", whole("sides")))
    if len(main.points) > MANY_CELLS[view]:
        pictures.append(("closer", f"Where the cells are smallest ({name}).", lambda: _closer(main)))
    return pictures


def draw(picture: Picture) -> Any:
    """Return the figure of a picture; `matplotlib.pyplot` does not know it."""
    with detached():
        return picture[2]()


def render(figure: Any, kind: str = "png", dpi: int = 170) -> bytes:
    """Return a figure as the bytes of a PNG, PDF or SVG file."""
    with styled(), io.BytesIO() as buffer:
        # Without date and version: the same run gives the same file.
        metadata = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
        figure.savefig(buffer, format=kind, dpi=dpi, bbox_inches="tight", pad_inches=0.04, metadata=metadata[kind])
        return buffer.getvalue()


def plot_side_by_side(panels: Mapping[str, Result], paint: Paint, color: str, columns: int) -> Any:
    """Draw meshes side by side with one scale, on a new figure; the last one says which part is in the middle.

    - `panels`: results by their titles, in one domain.
    - `paint`: the scale, and the values of all.
    """
    *_, main = panels.values()
    domain = main.diagram.domain
    view = views_of(domain)[0]
    lower, upper = np.array(domain.lower), np.array(domain.upper)
    options: dict[str, Any] = {"limits": paint.limits, "key": False}
    axes_options: dict[str, Any] = {}
    if view == "globe":
        axes_options = {"projection": map_projection(center=default_center(main))}
    elif view == "slices":
        normal = _largest_section(main)
        options |= {"view": "slice", "normal": "xyz"[normal], "through": focus(main)}
        lower, upper = (np.delete(corner, normal) for corner in (lower, upper))
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    with styled():
        figure = new_figure(WIDTH, grid_height(lower, upper, rows, columns, 0.65, 0.3))
        axes = figure.subplots(rows, columns, squeeze=False, subplot_kw=axes_options).ravel()
        for ax, (title, result) in zip(axes, panels.items(), strict=False):
            if view == "globe":
                ax.set_global()
            plot_mesh(result, color, ax=ax, title=title, **options)
            ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
        for ax in axes[len(panels) :]:
            ax.set_visible(False)
        add_key(axes, paint, below=True)
    return figure


def _compare(panels: Mapping[str, Result], color: str) -> Any:
    titled = {
        f"({letter}) {name}: mean $|e|$ {np.abs(r.size_error).mean():.3g}, mean $Q$ {r.quality.mean():.3f}": r
        for letter, (name, r) in zip("abcdefghij", panels.items(), strict=False)
    }
    return plot_side_by_side(titled, shared_paint(list(panels.values()), color), color, 2)


def _largest_section(result: Result) -> int:
    """Return the axis at right angles to the largest section of the domain; of several the last."""
    extent = result.diagram.domain.extent
    return int(np.flatnonzero(extent <= extent.min() * 1.001)[-1])


def _closer(result: Result) -> Any:
    """Draw two parts around the smallest cells, the second four times closer, colored by quality."""
    domain = result.diagram.domain
    view = views_of(domain)[0]
    paint = shared_paint([result], "quality")
    options: dict[str, Any] = {"limits": paint.limits, "key": False}
    axes_options: dict[str, Any] = {}
    smallest, center = float(result.target_size.min()), result.points[np.argmin(result.target_size)]
    plane = np.eye(domain.dim, 2)
    if view == "globe":
        axes_options = {"projection": map_projection(center=default_center(result))}
    elif view == "slices":
        normal = _largest_section(result)
        plane = np.stack(plane_axes(np.eye(3)[normal]), axis=1)
        options |= {"view": "slice", "normal": "xyz"[normal], "through": center}
    lower, upper, middle = (np.asarray(x) @ plane for x in (domain.lower, domain.upper, center))
    with styled():
        figure = new_figure(WIDTH, WIDTH / 2 + 0.75)
        axes = figure.subplots(1, 2, subplot_kw=axes_options)
        for ax, across in zip(axes, (160, 40), strict=True):
            if domain.globe is not None:
                reach = np.sin(min(across * smallest / domain.globe.radius, np.pi / 2) / 2) * ax.projection.x_limits[1]
                ax.set(xlim=(-reach, reach), ylim=(-reach, reach))
            else:
                span = np.minimum(across * smallest, upper - lower)
                corner = np.clip(middle - span / 2, lower, upper - span)
                options["window"] = corner, corner + span
            title = f"{across} $h_\\mathrm{{min}}$ across, where $h$ is smallest"
            plot_mesh(result, "quality", ax=ax, title=title, **options)
            ax.locator_params(nbins=4)
        add_key(axes, paint, below=True)
    return figure
