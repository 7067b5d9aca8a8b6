"""Error and quality against steps (the paper's Figures 4, 5), and histograms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from ..mesh.results import Result
from .colors import paint_of
from .style import METHOD_COLORS, WIDTH, interactive_figure, styled

_PANELS = {
    "error": ("metric error $|e|$ [–]", ("mean_error", "mean"), ("max_error", "largest")),
    "quality": ("cell quality $Q$ [–]", ("mean_quality", "mean"), ("min_quality", "worst cell")),
}


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
