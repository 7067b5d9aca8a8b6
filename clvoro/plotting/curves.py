"""Error and quality against steps (the paper's Figures 4, 5), displacements (its Figure 6), and histograms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.spatial import KDTree

from ..mesh.results import Result
from .boundary import frame_part
from .cells import require_plane
from .colors import paint_of
from .style import METHOD_COLORS, WIDTH, interactive_figure, nice, styled, window_around_smallest

_PANELS = {
    "error": ("metric error $|e|$ [–]", ("mean_error", "mean"), ("max_error", "largest")),
    "quality": ("cell quality $Q$ [–]", ("mean_quality", "mean"), ("min_quality", "worst cell")),
}
_LONG = 0.97  # share of the arrows that are at most one spacing long
MOST_ARROWS = 2500
"""Of a mesh with more generators, the displacements are shown where the cells are smallest."""


def plot_history(results: Mapping[str, Result], figure: Any = None) -> Any:
    """Draw error (log scale) and quality against the step, one color per method.

    Dotted lines mark the starts of finer levels.

    Parameters
    ----------
    results : mapping
        Results by the method's name.
    figure : matplotlib figure, optional
        An empty one to draw into.

    Returns
    -------
    matplotlib.figure.Figure
    """
    with styled():
        figure = interactive_figure(WIDTH, 3.1) if figure is None else figure
        for ax, quantity in zip(figure.subplots(1, 2), _PANELS, strict=True):
            _history_panel(ax, results, quantity)
        colors = dict(zip(results, METHOD_COLORS * len(results), strict=False))
        handles = [Line2D([], [], color=color, label=name) for name, color in colors.items()]
        handles += [
            Line2D([], [], color="#444444", label="mean"),
            Line2D([], [], color="#444444", lw=0.9, ls=(0, (4, 2)), label="worst cell"),
        ]
        if any(np.diff(result.history["level"]).any() for result in results.values()):
            handles.append(Line2D([], [], color="#444444", lw=0.7, ls=":", label="finer level"))
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    return figure


def _history_panel(ax: Any, results: Mapping[str, Result], quantity: str) -> None:
    label, (mean, _), (worst, _) = _PANELS[quantity]
    longest = 1
    for (_, result), color in zip(results.items(), METHOD_COLORS * len(results), strict=False):
        history = result.history
        steps = np.arange(len(history))  # step numbers start again on each level
        longest = max(longest, len(steps) - 1)
        for change in np.flatnonzero(np.diff(history["level"])):
            ax.axvline(change + 0.5, color=color, lw=0.7, ls=":")
        dots = "o" if len(steps) == 1 else None
        ax.plot(steps, _drawable(history[mean], quantity), color=color, lw=1.5, marker=dots)
        ax.plot(steps, _drawable(history[worst], quantity), color=color, lw=0.9, ls=(0, (4, 2)))
    ax.set_xlim(0, longest)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("step")
    ax.set_ylabel(label)
    ax.grid(True, which="major", color="#DDDDDD", lw=0.5)
    ax.set_axisbelow(True)
    if quantity == "error":
        if any((result.history[worst] > 0).any() for result in results.values()):
            ax.set_yscale("log")
            ax.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    else:
        ax.set_ylim(min(0.0, ax.get_ylim()[0]), 1.0)


def _drawable(values: np.ndarray, quantity: str) -> np.ndarray:
    """Replace values that a logarithmic axis cannot show by gaps."""
    return np.where(values > 0, values, np.nan) if quantity == "error" else values


def plot_displacements(result: Result, figure: Any = None) -> Any:
    """Draw the Lloyd and the Poisson displacements of the first and of the last step, in the plane.

    Arrows have the length of the displacement times the factor in the panel's title. Of a mesh with more than 2500
    generators a window around the smallest cells is shown, because arrows over the whole mesh would be too small.

    Returns
    -------
    matplotlib.figure.Figure or None
        None if the run recorded no displacements.

    Raises
    ------
    InputError
        For a mesh in 3D or on a sphere.
    """
    domain = result.diagram.domain
    require_plane(domain, "displacements are drawn in the plane", "plot its history")
    rows = [(n, d) for n, d in (("first", result.initial), ("last", result.final)) if d is not None]
    if not rows:
        return None
    few = len(result.points) <= MOST_ARROWS
    lower, upper = np.array([domain.lower, domain.upper]) if few else window_around_smallest(result, 50)
    with styled():
        if figure is None:
            figure = interactive_figure(WIDTH, len(rows) * (WIDTH / 2 * float(np.divide(*(upper - lower)[::-1])) + 0.3))
        axes = figure.subplots(len(rows), 2, squeeze=False)
        for axes_row, (when, field) in zip(axes, rows, strict=True):
            here = ((field.points >= lower) & (field.points <= upper)).all(axis=1)
            points, both = field.points[here], (field.lloyd[here], field.poisson[here])
            factors = _magnifications(points, both)
            names = (("Lloyd", METHOD_COLORS[0]), ("Poisson", "#B34700"))
            for ax, factor, arrows, (name, color) in zip(axes_row, factors, both, names, strict=True):
                step = "coarse step" if result.history["level"][0] > 0 and when == "first" else "step"
                ax.set_title(f"{name}, {when} {step} (× {factor:g})")
                scale: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.0026}
                ax.quiver(*points.T, *(factor * arrows.T), color=color, minlength=0.3, **scale)
                frame_part(ax, domain, lower, upper, ticks=not few)
    return figure


def _magnifications(points: np.ndarray, fields: tuple[np.ndarray, np.ndarray]) -> list[float]:
    """Return round factors that bring the long arrows of each field to about one spacing of the generators.

    If they are close, both are the smaller one, so that the fields can be compared.
    """
    spacing = KDTree(points).query(points, k=min(7, len(points)))[0].reshape(len(points), -1)[:, 1:]
    if not spacing.size:
        return [1.0, 1.0]
    reaches = [np.hypot(*arrows.T) / spacing.mean(axis=1) for arrows in fields]
    # Without fixed generators, and displacements that are only round-off.
    moving = [reach[reach > 1e-6] for reach in reaches]
    factors = [nice(1.0 / np.quantile(m, _LONG), up=False) if m.size else 1.0 for m in moving]
    return [min(factors)] * 2 if max(factors) <= 2.5 * min(factors) else factors


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
            paint = paint_of(result, name)
            scheme, limits = paint.scheme, paint.limits
            if name == "sides":
                values = np.diff(result.diagram.neighbor_starts)
                edges = np.arange(values.min(), values.max() + 2) - 0.5
                ax.xaxis.set_major_locator(MaxNLocator(integer=True))
            else:
                values = result.measures.skewness if name == "skewness" else paint.values
                values = values[np.isfinite(values)]
                edges = np.linspace(*_range(values, name), 41)
            counts, _ = np.histogram(values, edges)
            middles = 0.5 * (edges[1:] + edges[:-1])
            shown = np.clip(middles, limits[0] + 0.5, limits[1] - 0.5) if scheme.classes else middles
            ax.bar(
                middles,
                100 * counts / max(len(values), 1),
                np.diff(edges),
                color=replace(paint, values=shown).rgba(np.arange(len(shown))),
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
