"""Colors, fonts and small helpers that all pictures share."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from ..errors import InputError

WIDTH = 7.0
"""Width of a full-width picture, inches."""

METHOD_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#555555")
"""Okabe and Ito's palette, readable for color-blind people."""

SETTINGS: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "savefig.facecolor": "white",
    "figure.facecolor": "white",
}


def styled() -> Any:
    """Return the context in which every picture is drawn and saved."""
    return rc_context(SETTINGS)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size in inches, outside of pyplot."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


_detached: ContextVar[bool] = ContextVar("_detached", default=False)


@contextmanager
def detached() -> Iterator[None]:
    """Make figures that `matplotlib.pyplot` does not know, so that they need not be closed."""
    token = _detached.set(True)
    try:
        yield
    finally:
        _detached.reset(token)


def interactive_figure(width: float, height: float) -> Figure:
    """Return an empty figure that `matplotlib.pyplot.show` shows, except within `detached`."""
    if _detached.get():
        return new_figure(width, height)
    from matplotlib import pyplot

    return pyplot.figure(figsize=(width, height), layout="constrained")


def nice(value: float, up: bool = True) -> float:
    """Round to 1, 2 or 5 times a power of ten."""
    if not (value > 0 and math.isfinite(value)):
        return 1.0
    steps = [m * 10.0**p for p in range(-12, 13) for m in (1, 2, 5)]
    if up:
        return next((s for s in steps if s >= value * (1 - 1e-9)), value)
    return next((s for s in reversed(steps) if s <= value * (1 + 1e-9)), value)


def frame_domain(ax: Any, lower: Any, upper: Any, ticks: bool = True) -> None:
    """Show the rectangle from `lower` to `upper` to scale, framed; with `ticks` also name the axes x and y."""
    ax.set_aspect("equal")
    ax.set_xlim(lower[0], upper[0])
    ax.set_ylim(lower[1], upper[1])
    for spine in ax.spines.values():
        spine.set_visible(True)
    if ticks:
        ax.set_xlabel("x")
        ax.set_ylabel("y")
        if 1e5 <= np.abs([lower, upper]).max() < 1e9:
            _write_all_digits(ax)
    else:
        ax.set_xticks([])
        ax.set_yticks([])


def _write_all_digits(ax: Any) -> None:
    """Write coordinates of a map, such as 5400000, as they are, and fewer of them along x."""
    for axis in (ax.xaxis, ax.yaxis):
        text = axis.get_major_formatter()
        if isinstance(text, ScalarFormatter):
            text.set_scientific(False)
            text.set_useOffset(False)
    if isinstance(ax.xaxis.get_major_locator(), MaxNLocator):
        ax.locator_params(axis="x", nbins=6)


def corners_of(window: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a part of a plane, or raise InputError."""
    try:
        corners = np.asarray(window, float)
    except (TypeError, ValueError):
        corners = np.empty(0)
    if corners.shape != (2, 2) or not (corners[0] < corners[1]).all():
        raise InputError(f"window is {window!r:.80}, expected two corners ((x, y), (x, y)), the lower left one first")
    return corners[0], corners[1]


def ends_of(limits: Any) -> tuple[float, float]:
    """Return the ends of a color scale, or raise InputError."""
    try:
        low, high = (float(end) for end in limits)
    except (TypeError, ValueError):
        low, high = 0.0, 0.0
    if not low < high:
        raise InputError(f"limits is {limits!r:.80}, expected two numbers (low, high)")
    return low, high


def grid_height(lower: Any, upper: Any, rows: int, columns: int, extra: float, each: float) -> float:
    """Height of a picture of `rows` x `columns` domains: `each` inches more per row."""
    extent = np.subtract(upper, lower)
    return float(rows * (WIDTH / columns * extent[1] / extent[0] * 0.96 + each) + extra)


def is_flat(lower: Any, upper: Any) -> bool:
    """Return whether a picture is too flat for a color bar beside it."""
    extent = np.subtract(upper, lower)
    return bool(extent[1] < 0.3 * extent[0])


def single_height(lower: Any, upper: Any, legend: bool = False, title: bool = False) -> float:
    """Height of a picture of one domain, with a color bar (below if flat) or a legend below, inches."""
    extent = np.subtract(upper, lower)
    flat = is_flat(lower, upper) and not legend
    width = WIDTH - (0.55 if legend or flat else 1.5)
    below = 0.35 * legend + 0.65 * flat
    return float(width * extent[1] / extent[0] + 0.4 + below + 0.25 * title)
