"""Pictures of a whole mesh by its dimension, the cut-away view of a 3D mesh, and histograms of measures."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from ..errors import InputError
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .cells import plot_cells
from .colors import Color, cell_norm, coloring, coloring_of, picture_of
from .cutaway import VIEW, draw_cutaway, view_axes
from .legends import add_key
from .slices import as_normal, focus, plot_slice, plot_slices, require_space
from .style import WIDTH, interactive_figure, styled

__all__ = ["plot_cutaway", "plot_distributions", "plot_mesh", "plot_slice", "plot_slices"]

View = Literal["slices", "slice", "cutaway"]
_USED = {
    "2D": ("ax", "window", "edges", "key"),
    "slices": ("through",),
    "slice": ("ax", "window", "normal", "through", "edges", "key"),
    "cutaway": ("ax", "through", "cut", "angles", "edges", "key"),
}
"""Options of `plot_mesh` that a kind of picture uses."""


def plot_mesh(
    mesh: Result | Diagram,
    color: Color | ArrayLike = "error",
    *,
    label: str | None = None,
    view: View | None = None,
    ax: Any = None,
    limits: tuple[float, float] | None = None,
    window: tuple[ArrayLike, ArrayLike] | None = None,
    normal: str | ArrayLike = "z",
    through: ArrayLike | None = None,
    cut: str | ArrayLike | None = "octant",
    angles: tuple[float, float] | None = None,
    edges: bool = True,
    key: bool = True,
    title: str | None = None,
) -> Any:
    """Draw a mesh: 2D by `plot_cells`, 3D by `plot_slices`, `plot_slice` or `plot_cutaway`.

    Parameters
    ----------
    mesh : Result or Diagram
    color, label, limits, title
        As for `plot_cells`.
    view : {"slices", "slice", "cutaway"}, optional
        For meshes in 3D: planes along the axes and a cut-away view (the default), one plane, or a cut-away view.
    ax : matplotlib axes, optional
        Axes to draw into; not for "slices", which has several.
    window, edges, key
        As for `plot_cells`; window for 2D and "slice", edges and key not for "slices".
    normal : {"x", "y", "z"} or 3 floats
        For "slice": direction at right angles to the plane.
    through : 3 floats, optional
        For 3D: a point of the planes or of the cut.
    cut, angles
        For "cutaway": the removed part, and azimuth and elevation of the viewer in degrees; see `plot_cutaway`.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError, InputTypeError
        If a color does not exist, an array has another shape, or an option is for other pictures.
    """
    flat = picture_of(mesh).diagram.domain.dim == 2
    if flat and view is not None:
        raise InputError(f"view is {view!r}, which is for meshes in 3D; leave it out")
    if view is not None and view not in get_args(View):
        raise InputError(f"view is {view!r}, expected one of {', '.join(get_args(View))}")
    kind = "2D" if flat else view or "slices"
    draw = {"2D": plot_cells, "slices": plot_slices, "slice": plot_slice, "cutaway": plot_cutaway}[
        kind
    ]
    given = {
        "ax": (ax, None), "window": (window, None), "normal": (normal, "z"), "through": (through, None),
        "cut": (cut, "octant"), "angles": (angles, None), "edges": (edges, True), "key": (key, True),
    }  # fmt: skip
    options: dict[str, Any] = {}
    for name, (value, default) in given.items():
        if value is default or (isinstance(value, str) and value == default):
            continue
        if name not in _USED[kind]:
            known = [k for k, names in _USED.items() if name in names]
            raise InputError(
                f"{name} is for {', '.join(known)}, and this picture is {kind}; leave it out"
            )
        options[name] = value
    return draw(mesh, color, label=label, limits=limits, title=title, **options)


def plot_cutaway(
    mesh: Result | Diagram,
    color: Color | ArrayLike = "error",
    ax: Any = None,
    *,
    cut: str | ArrayLike | None = "octant",
    through: ArrayLike | None = None,
    angles: tuple[float, float] = VIEW,
    label: str | None = None,
    limits: tuple[float, float] | None = None,
    edges: bool = True,
    key: bool = True,
    title: str | None = None,
) -> Any:
    """Draw a 3D mesh with part of its cells removed, in parallel projection.

    Parameters
    ----------
    mesh : Result or Diagram
    color : {"error", "quality", "size", "sides", "skewness", "volume"} or (n,) array of real numbers
    ax : matplotlib axes, optional
        Two-dimensional ones to draw into; a new figure by default.
    cut : "octant", "x", "y", "z", 3 floats, (n,) bool or None
        The removed part: the cells with generators between the point and the viewer, in all three directions;
        those in front of a plane with this normal, on the viewer's side for "x", "y" and "z"; those that are not
        marked as kept; or nothing.
    through : 3 floats, optional
        The point; by default among the smallest cells.
    angles : (azimuth, elevation), degrees
        Direction of the viewer.
    label, limits, edges, key, title
        As for `plot_cells`.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        For a 2D mesh, an unknown color or cut.
    """
    result = picture_of(mesh)
    require_space(result.diagram)
    scheme = coloring_of(result, color, label)
    point = focus(result) if through is None else np.asarray(through, float)
    what = _cut(cut, len(result.points), angles)
    values = scheme.values(result)
    ends = scheme.limits(values) if limits is None else limits
    with styled():
        if ax is None:
            ax = interactive_figure(WIDTH, cutaway_height(result, angles)).add_subplot()
        shown = draw_cutaway(
            ax, result, values, scheme, ends, through=point, cut=what, view=angles, edges=edges
        )  # fmt: skip
        if title is not None:
            ax.set_title(title)
        if key:
            add_key(shown, ax, scheme, values, ends)
    return ax.figure


def cutaway_height(result: Result, angles: tuple[float, float] = VIEW) -> float:
    """Height in inches that suits `plot_cutaway`."""
    right, up, _ = view_axes(angles)
    width, height = (np.abs(axis) @ result.diagram.domain.extent for axis in (right, up))
    return min(float((WIDTH - 0.9) * height / width), 1.1 * WIDTH) + 0.4


def _cut(cut: Any, n: int, angles: tuple[float, float]) -> Any:
    """Return `cut` as `draw_cutaway` takes it, or raise InputError."""
    if cut is None or (isinstance(cut, str) and cut == "octant"):
        return cut
    if not isinstance(cut, str):
        marks = np.asarray(cut)
        if marks.dtype == bool:
            if marks.shape != (n,):
                raise InputError(f"cut has shape {marks.shape}, expected one mark per cell ({n},)")
            return marks
    elif cut in "xyz" and len(cut) == 1:
        normal = as_normal(cut)
        return normal if view_axes(angles)[2] @ normal >= 0 else -normal
    try:
        return as_normal(cut)
    except InputError as error:
        raise InputError(
            f"cut is {cut!r}, expected 'octant', 'x', 'y', 'z', three numbers, a mark per cell or None"
        ) from error


def plot_distributions(result: Result, figure: Any = None) -> Any:
    """Draw histograms of error, quality and number of faces of the cells, and of the skewness of faces.

    Bars have the colors of the cells in the other pictures.

    Returns
    -------
    matplotlib.figure.Figure
    """
    with styled():
        figure = interactive_figure(WIDTH, 4.2) if figure is None else figure
        panels = figure.subplots(2, 2).ravel()
        if figure.get_layout_engine() is not None:  # space between titles and the numbers above
            figure.get_layout_engine().set(hspace=0.08)
        dim = result.diagram.domain.dim
        for ax, name in zip(panels, ("error", "quality", "sides", "skewness"), strict=True):
            scheme = coloring(name, dim)
            if name == "sides":
                values = np.diff(result.diagram.neighbor_starts)
                edges = np.arange(values.min(), values.max() + 2) - 0.5
                ax.xaxis.set_major_locator(MaxNLocator(integer=True))
            else:
                values = result.measures.skewness if name == "skewness" else scheme.values(result)
                values = values[np.isfinite(values)]
                edges = np.linspace(*_range(values, name), 41)
            counts, _ = np.histogram(values, edges)
            middles = 0.5 * (edges[1:] + edges[:-1])
            limits = scheme.limits(scheme.values(result))
            color_map = scheme.color_map
            if not isinstance(color_map, Colormap):
                color_map = colormaps[color_map]
            norm = cell_norm(scheme, limits)
            shown = (
                np.clip(middles, limits[0] + 0.5, limits[1] - 0.5) if scheme.classes else middles
            )
            ax.bar(
                middles,
                100 * counts / max(len(values), 1),
                np.diff(edges),
                color=color_map(np.clip(norm(shown), 0, 1) if not scheme.classes else norm(shown)),
                edgecolor="#444444",
                linewidth=0.3,
            )
            label = "skewness of the faces [–]" if name == "skewness" else scheme.label
            ax.set_xlabel(label.split("   ")[0])
            ax.set_ylabel("faces [%]" if name == "skewness" else "cells [%]")
            ax.set_xlim(edges[0], edges[-1])
            mean = float(values.mean())
            ax.axvline(mean, color="#1A1A1A", lw=0.9, ls=(0, (4, 2)))
            title = f"mean {mean:.3g}, from {values.min():.3g} to {values.max():.3g}"
            ax.set_title(title.replace("-", "−"))
    return figure


def _range(values: np.ndarray, name: str) -> tuple[float, float]:
    """Return the range of a histogram: 99.8 % of the values, with zero where it is meaningful."""
    low, high = (float(q) for q in np.quantile(values, (0.001, 0.999)))
    if name == "skewness":
        low = 0.0
    if name == "error":
        low, high = -max(-low, high), max(-low, high)
    if not high > low:
        low, high = low - 0.5, high + 0.5
    return low, high
