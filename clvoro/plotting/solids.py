"""Pictures of a whole mesh by its dimension, the cut-away view of a 3D mesh, and histograms of measures."""

from __future__ import annotations

from inspect import signature
from typing import Any, Literal, get_args

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from ..errors import InputError
from ..geometry.sphere import Sphere
from ..mesh.diagram import Diagram
from ..mesh.output import MeshOutput
from ..mesh.results import Result
from .cells import plot_cells
from .colors import Color, cell_norm, coloring, coloring_of, picture_of
from .cutaway import VIEW, draw_cutaway, view_axes
from .globe import plot_globe
from .legends import add_key
from .slices import as_normal, focus, plot_slice, plot_slices, require_space
from .style import WIDTH, ends_of, interactive_figure, styled

__all__ = ["plot_cutaway", "plot_distributions", "plot_mesh", "plot_slice", "plot_slices"]

View = Literal["slices", "slice", "cutaway"]


def plot_mesh(mesh: Result | Diagram, color: Color | ArrayLike = "error", **options: Any) -> Any:
    """Draw a mesh. The options are those of `Diagram.plot`."""
    return MeshOutput.plot(mesh, color, **options)


def draw_mesh(mesh: Result | Diagram, color: Color | ArrayLike, view: Any, **options: Any) -> Any:
    """Draw a mesh as a picture of the kind `view`; refuse options that only other kinds of pictures have.

    The options are all those of `Diagram.plot`. Those with their default value are not refused.
    """
    domain = picture_of(mesh).diagram.domain
    flat = domain.cell_dim == 2
    if flat and view is not None:
        raise InputError(f"view is {view!r}, which is for meshes in 3D; leave it out")
    if view is not None and view not in get_args(View):
        raise InputError(f"view is {view!r}, expected one of {', '.join(get_args(View))}")
    kind = "sphere" if isinstance(domain, Sphere) else "2D" if flat else view or "slices"
    pictures = {
        "2D": plot_cells,
        "slices": plot_slices,
        "slice": plot_slice,
        "cutaway": plot_cutaway,
        "sphere": plot_globe,
    }
    known = {name: signature(draw).parameters for name, draw in pictures.items()}
    given = {}
    for name, value in options.items():
        default = signature(MeshOutput.plot).parameters[name].default
        if value is default or (isinstance(value, str) and value == default):
            continue
        if name not in known[kind]:
            fitting = ", ".join(k for k, names in known.items() if name in names)
            raise InputError(f"{name} is for {fitting}, and this picture is {kind}; leave it out")
        given[name] = value
    return pictures[kind](mesh, color, **given)


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
    ends = scheme.limits(values) if limits is None else ends_of(limits)
    with styled():
        if ax is None:
            ax = interactive_figure(WIDTH, cutaway_height(result, angles)).add_subplot()
        shown = draw_cutaway(ax, result, values, scheme, ends, through=point, cut=what, view=angles, edges=edges)
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
        for ax, name in zip(panels, ("error", "quality", "sides", "skewness"), strict=True):
            scheme = coloring(name, result.diagram.domain)
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
            shown = np.clip(middles, limits[0] + 0.5, limits[1] - 0.5) if scheme.classes else middles
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
