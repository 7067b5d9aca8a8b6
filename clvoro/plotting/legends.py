"""Keys of pictures: a color bar, or a legend of classes with their shares."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, Locator, MaxNLocator, NullLocator
from matplotlib.transforms import ScaledTranslation, blended_transform_factory

from .colors import Paint
from .style import is_flat

_BELOW: dict[str, Any] = {"location": "bottom", "shrink": 0.6, "aspect": 45}
_GAP, _THICKNESS = 0.12, 0.14  # between picture and color bar, and of the bar; inches
_PER_LETTER = 0.066  # mean width of a letter in labels, inches
_PER_TICK = (0.24, 0.65)  # room for a number beside, and below a bar, inches
_APART = (0.15, 0.45)  # least distance of two numbers there, inches
_BELOW_TICKS = 26  # from the axes to a legend below their numbers, points


def add_key(axes: Any, paint: Paint, below: bool = False) -> None:
    """Add a color bar, or the legend of classes, beside or below `axes` (one or several)."""
    if paint.scheme.classes:
        _add_classes(axes, paint)
    else:
        add_color_bar(axes, paint, **(_BELOW if below else {}))


def finished(ax: Any, paint: Paint, key: bool, title: str | None) -> Any:
    """Add the title and the key to the picture in `ax`, and return its figure."""
    if title is not None:
        ax.set_title(title)
    if key:
        add_key(ax, paint)
    return ax.figure


def add_color_bar(axes: Any, paint: Paint, **options: Any) -> None:
    """Add the scale beside `axes` (one or several), with arrows where values lie beyond it."""
    scheme, values, (low, high) = paint.scheme, paint.values, paint.limits
    cells = paint.mappable()
    below, above = (bool((values < low * (1 - 1e-9 * np.sign(low))).any()), bool((values > high).any()))
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
    several = isinstance(axes, (list, np.ndarray))
    figure = (axes[0] if several else axes).figure
    label = scheme.label
    if not (several or options) and _is_flat(axes):
        options = dict(_BELOW)
    if not (several or options) and isinstance(figure.get_layout_engine(), ConstrainedLayoutEngine):
        # As high as the picture, not as the space of the layout.
        bar = figure.colorbar(cells, cax=_beside(axes), extend=extend)
        if _PER_LETTER * len(label.replace("$", "")) > _height(axes):
            label = label.replace("   ", "\n")
    else:
        given = {"extend": extend, "shrink": 0.9, "aspect": 28, "pad": 0.02, **options}
        bar = figure.colorbar(cells, ax=axes, **given)
    bar.set_label(label)
    bar.outline.set_linewidth(0.4)  # type: ignore[operator]
    if scheme.logarithmic and isinstance(cells.norm, LogNorm):
        bar.locator = _EndsAndRound(low, high)
        bar.minorlocator = NullLocator()
    else:
        bar.locator = _RoundSteps(integers=bool((values == np.rint(values)).all()))
    if scheme.logarithmic:
        # Where the ends are close, two digits would be the same at all ticks.
        digits = 2 if high > 2 * low else 2 + int(np.ceil(np.log10(high / max(high - low, 1e-9 * high))))
        bar.formatter = FuncFormatter(lambda t, _: short(t / scheme.unit, digits))
    bar.update_ticks()


def _beside(ax: Any) -> Any:
    """Return axes for a color bar, to the right of `ax`."""
    inches = ax.figure.dpi_scale_trans
    right = inches + ScaledTranslation(1, 0, ax.transAxes)
    place = blended_transform_factory(right, ax.transAxes)
    return ax.inset_axes((_GAP, 0, _THICKNESS, 1), transform=place)


def _is_flat(ax: Any) -> bool:
    return is_flat(*np.transpose([ax.get_xlim(), ax.get_ylim()]))


def _height(ax: Any) -> float:
    """Return the approximate height of `ax` in inches."""
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    width, height = ax.figure.get_size_inches()
    return float(min(0.8 * width * (top - bottom) / (right - left), 0.9 * height))


def short(value: float, digits: int = 2) -> str:
    """Format a number with few significant digits, with an exponent only for very small or large numbers."""
    text = f"{value:.{digits}g}"
    if 1e-4 <= abs(value) < 1e6:
        text = np.format_float_positional(float(text), trim="-")
    return text.replace("-", "−")


def _length(axis: Any) -> tuple[float, bool]:
    """Return the length of a color bar in inches, and whether it is horizontal."""
    lies = axis.axis_name == "x"
    box, dpi = axis.axes.bbox, axis.axes.figure.dpi
    return float((box.width if lies else box.height) / dpi), lies


class _RoundSteps(MaxNLocator):
    """Round numbers, as many as the bar has room for. With `integers` all are whole, as regions and counts are."""

    def __init__(self, integers: bool) -> None:
        super().__init__(steps=[1, 2, 5, 10], integer=integers)

    def tick_values(self, vmin: float, vmax: float) -> list[float]:
        length, lies = _length(self.axis)
        self.set_params(nbins=int(np.clip(length / _PER_TICK[lies], 2, 9)))
        return list(super().tick_values(vmin, vmax))


class _EndsAndRound(Locator):
    """Both ends of a logarithmic scale, and round numbers at a distance from them."""

    def __init__(self, low: float, high: float) -> None:
        self._ends = low, high

    def __call__(self) -> list[float]:
        return self.tick_values(*self._ends)

    def tick_values(self, vmin: float, vmax: float) -> list[float]:
        length, lies = _length(self.axis)
        apart = (vmax / vmin) ** (_APART[lies] / max(length, 1e-3))  # a ratio
        ticks = [vmin]
        for number in round_numbers(vmin, vmax):
            if number > ticks[-1] * apart and number < vmax / apart:
                ticks.append(number)
        return [*ticks, vmax]


def round_numbers(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten from `low` to `high`, both ends a little widened."""
    numbers = [float(f"{m}e{p}") for p in range(-12, 13) for m in (1, 2, 5)]
    return [t for t in numbers if low * 0.999 <= t <= high * 1.001]


def _add_classes(axes: Any, paint: Paint) -> None:
    """Write the classes and their shares of all cells below the picture."""
    scheme, values, first = paint.scheme, paint.values, round(paint.limits[0] + 0.5)
    handles = [
        Patch(facecolor=color, edgecolor="#1A1A1A", linewidth=0.4, label=f"{label}: {_share(values == number)}")
        for number, (color, label) in enumerate(zip(scheme.color_map.colors, scheme.classes, strict=True), start=first)
        if (values == number).any()
    ]
    options: dict[str, Any] = {
        "handles": handles,
        "ncols": len(handles),
        "frameon": False,
        "handlelength": 1.2,
        "columnspacing": 1.4,
    }
    if isinstance(axes, (list, np.ndarray)):
        axes[0].figure.legend(loc="outside lower center", **options)
        return
    down = ScaledTranslation(0, -_BELOW_TICKS / 72, axes.figure.dpi_scale_trans)
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, 0), bbox_transform=axes.transAxes + down, borderaxespad=0, **options
    )


def _share(marks: np.ndarray) -> str:
    share = float(np.mean(marks))
    return f"{share:.1%}" if share >= 0.0005 else "< 0.1%"
