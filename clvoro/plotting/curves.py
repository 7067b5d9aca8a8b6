"""Error and quality against steps (the paper's Figures 4, 5), and displacements (its Figure 6)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.spatial import KDTree

from ..errors import InputError
from ..mesh.results import Displacements, Result
from .boundary import frame_part
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
    """Draw the Lloyd and the Poisson displacements of the first and of the last step.

    Arrows have the length of the displacement times the factor in the panel's title. For a mesh with more than 2500
    generators only a window around the smallest cells is shown, because arrows over the whole mesh would be too small.

    Returns
    -------
    matplotlib.figure.Figure or None
        None if the run recorded no displacements.

    Raises
    ------
    InputError
        For a mesh in 3D or on a sphere.
    """
    if result.diagram.domain.dim != 2:
        raise InputError(
            "displacements are drawn in the plane, and this mesh is in 3D or on a sphere; plot its history"
        )
    rows = [(n, d) for n, d in (("first", result.initial), ("last", result.final)) if d is not None]
    if not rows:
        return None
    lower, upper = _shown_part(result)
    with styled():
        if figure is None:
            figure = interactive_figure(WIDTH, displacements_height(result))
        axes = figure.subplots(len(rows), 2, squeeze=False)
        coarse = result.history["level"][0] > 0
        for axes_row, (when, field) in zip(axes, rows, strict=True):
            field = _inside(field, lower, upper)
            factors = _magnifications(field)
            halves = (("Lloyd", field.lloyd, METHOD_COLORS[0]), ("Poisson", field.poisson, "#B34700"))
            for ax, factor, (name, arrows, color) in zip(axes_row, factors, halves, strict=True):
                word = "magnified" if factor > 1 else "reduced"
                note = "to scale" if factor == 1 else f"{word} × {factor:g}"
                step = "coarse step" if coarse and when == "first" else "step"
                ax.set_title(f"{name}, {when} {step} ({note})")
                _draw_arrows(ax, field.points, arrows * factor, color)
                domain = result.diagram.domain
                frame_part(ax, domain, lower, upper, ticks=len(result.points) > MOST_ARROWS)
                ax.locator_params(nbins=4)
    return figure


def displacements_height(result: Result) -> float:
    """Return a height in inches for `plot_displacements`."""
    extent = np.subtract(*_shown_part(result)[::-1])
    rows = (result.initial is not None) + (result.final is not None)
    ticks = 0.5 if len(result.points) > MOST_ARROWS else 0.0
    return rows * ((WIDTH / 2 - ticks) * float(extent[1] / extent[0]) + 0.25 + 0.4 * ticks)


def _shown_part(result: Result) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the domain, or of a window around the smallest cells."""
    if len(result.points) <= MOST_ARROWS:
        box = result.diagram.domain
        return np.array(box.lower), np.array(box.upper)
    return window_around_smallest(result, 50)


def _inside(field: Displacements, lower: np.ndarray, upper: np.ndarray) -> Displacements:
    """Return the part of `field` whose generators lie between two corners."""
    here = ((field.points >= lower) & (field.points <= upper)).all(axis=1)
    return Displacements(field.points[here], field.lloyd[here], field.poisson[here])


def _magnifications(field: Displacements) -> tuple[float, float]:
    """Round factors that bring the long arrows of each half to about one spacing of the generators.

    If their factors are close, both use the smaller one, so that they can be compared.
    """
    if len(field.points) < 2:
        return 1.0, 1.0
    nearest = min(7, len(field.points))
    spacing = KDTree(field.points).query(field.points, k=nearest)[0][:, 1:].mean(axis=1)
    factors = []
    for arrows in (field.lloyd, field.poisson):
        reaches = np.hypot(*arrows.T) / spacing
        # Skip fixed generators, and a displacement that is only round-off.
        moving = reaches[reaches > 1e-6]
        factors.append(nice(1.0 / np.quantile(moving, _LONG), up=False) if moving.size else 1.0)
    if max(factors) <= 2.5 * min(factors):
        factors = [min(factors)] * 2
    return factors[0], factors[1]


def _draw_arrows(ax: Any, points: np.ndarray, arrows: np.ndarray, color: str) -> None:
    ax.quiver(
        *points.T,
        *arrows.T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.0026,
        headwidth=3.5,
        headlength=4.5,
        headaxislength=4,
        minshaft=1.2,
        minlength=0.3,
        color=color,
    )
