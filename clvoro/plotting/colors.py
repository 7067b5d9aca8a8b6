"""The quantities that color cells: error, quality, size, number of sides, skewness, volume."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, LinearSegmentedColormap, ListedColormap, LogNorm, Normalize

from ..errors import InputError, InputTypeError
from ..geometry.domain import Domain
from ..geometry.sphere import EARTH_RADIUS
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from ..mesh.straightening import count_sides
from .style import ends_of, nice

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..mesh.quality import Measures

# Up to four, five, six, seven, eight and more sides: neutral for six, warm below, cool above.
_SIDES = ("#7F2704", "#E6762B", "#EDEDED", "#5AA6D1", "#08306B")
_SIDES_LABELS = ("4 or fewer", "5", "6", "7", "8 or more")
# In 3D, where relaxed cells have some 14 faces.
_FACES_LABELS = ("≤ 12", "13", "14", "15", "≥ 16")

_FAR = 3.0
"""Values of the caller are cut from the color scale if the scale would be that many times as long with them."""

_BEYOND_BEST = 3.0
"""Largest end of the error scale that several meshes share, over the end of the best mesh's own scale."""

# Without their darkest parts, in which faces cannot be seen.
_DARKLESS = ListedColormap(colormaps["viridis"](np.linspace(0.14, 1, 256)), "viridis without its darkest part")
_DIVERGING = LinearSegmentedColormap.from_list("error", colormaps["RdBu_r"](np.linspace(0.09, 0.91, 65)))


@dataclass(frozen=True)
class Coloring:
    """A quantity that colors cells."""

    label: str
    """Text beside the color bar, with the unit."""
    values: Callable[[Result], np.ndarray]
    """Function that returns one number per cell."""
    color_map: Any
    """Color map or its name: perceptually uniform, and diverging around zero for a signed quantity."""
    limits: Callable[[np.ndarray], tuple[float, float]]
    """Function of the values that returns the lower and the upper end of the scale."""
    logarithmic: bool = False
    classes: tuple[str, ...] = ()
    """Names of integer values, from the lower limit on; empty for a continuous quantity."""
    unit: float = 1.0  # of the numbers beside the color bar


def _symmetric(values: np.ndarray) -> tuple[float, float]:
    """Limits that hold 99 % of the values, symmetric about zero."""
    bound = nice(float(np.quantile(np.abs(values), 0.99))) if values.size else 1.0
    return -bound, bound


def _up_to_one(values: np.ndarray) -> tuple[float, float]:
    """Limits for a quality: from a round number below 99 % of the values up to 1."""
    low = float(np.quantile(values, 0.01)) if values.size else 0.0
    return min(np.floor(low * 20) / 20, 0.95), 1.0


def _around_most(values: np.ndarray) -> tuple[float, float]:
    """Limits for a quality that cannot reach 1: round numbers around 99 % of the values and the largest."""
    low = float(np.quantile(values, 0.01)) if values.size else 0.0
    high = float(values.max()) if values.size else 1.0
    return np.floor(low * 20) / 20, max(np.ceil(high * 20), np.floor(low * 20) + 1) / 20


def _from_zero(values: np.ndarray) -> tuple[float, float]:
    """Limits from 0 to a round number that hold 99 % of the finite values."""
    values = values[np.isfinite(values)]
    return 0.0, nice(float(np.quantile(values, 0.99))) if values.size else 1.0


def _span(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    return (low, high) if high > low * (1 + 1e-6) else (low * 0.99, low * 1.01)


def _most(values: np.ndarray) -> tuple[float, float]:
    """Limits that hold all finite values, never equal. Where few are far from the others, they hold 98 %."""
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 1.0
    low, high = np.quantile(values, (0.01, 0.99)).tolist()
    if np.ptp(values) <= _FAR * (high - low):
        low, high = float(values.min()), float(values.max())
    least = 1e-6 * max(abs(low), abs(high)) or 1.0
    return (low, high) if high - low >= least else (low - least, high + least)


COLORINGS = {
    "error": Coloring(
        "metric error $e$ [–]   (< 0 too small, > 0 too large)", lambda r: r.size_error, _DIVERGING, _symmetric
    ),
    "quality": Coloring("cell quality $Q$ [–]", lambda r: r.quality, _DARKLESS, _up_to_one),
    "size": Coloring("target size $h$", lambda r: r.target_size, _DARKLESS, _span, logarithmic=True),
    "sides": Coloring(
        "number of sides",
        lambda r: np.clip(count_sides(r.diagram), 4, 8),
        ListedColormap(_SIDES),
        lambda v: (3.5, 8.5),
        classes=tuple(f"{label} sides" for label in _SIDES_LABELS),
    ),
    "skewness": Coloring(
        "skewness of the worst face [–]",
        lambda r: r.measures.worst_of_cell("skewness"),
        _DARKLESS.reversed(),
        _from_zero,
    ),
    "volume": Coloring("area of the cell", lambda r: r.diagram.volumes, _DARKLESS, _span, logarithmic=True),
}
"""The quantities that `plot_cells` knows."""

_SOLID_COLORINGS = {
    **COLORINGS,
    "quality": replace(COLORINGS["quality"], label=r"cell quality $Q = 36\pi V^2 / S^3$ [–]", limits=_around_most),
    "sides": Coloring(
        "number of faces",
        lambda r: np.clip(np.diff(r.diagram.neighbor_starts), 12, 16),
        ListedColormap(_SIDES),
        lambda v: (11.5, 16.5),
        classes=tuple(f"{label} faces" for label in _FACES_LABELS),
    ),
    "volume": replace(COLORINGS["volume"], label="volume of the cell"),
}


Color = Literal["error", "quality", "size", "sides", "skewness", "volume"]
"""Names of the quantities."""
_OF_RUNS = ("error", "size")
_ON_EARTH = {"size": ("target size $h$ [km]", 1), "volume": ("area of the cell [km²]", 2)}
"""Labels, and powers of the unit of length."""


class DiagramPicture:
    """A diagram with the attributes of a result that pictures use: quality, and cell widths as sizes."""

    def __init__(self, diagram: Diagram) -> None:
        self.diagram, self.points = diagram, diagram.points
        self.target_size = diagram.volumes ** (1 / diagram.domain.cell_dim)

    @property
    def measures(self) -> Measures:
        """See `Diagram.measures`."""
        return self.diagram.measures

    @property
    def quality(self) -> np.ndarray:
        """Quality of the cells, (n,)."""
        return self.diagram.measures.quality


def picture_of(mesh: Result | Diagram) -> Result:
    """Return a result as it is, and a diagram as a `Result`-like object.

    Raises `InputTypeError`.
    """
    if isinstance(mesh, Diagram):
        return cast("Result", DiagramPicture(mesh))
    if not isinstance(mesh, Result | DiagramPicture):
        raise InputTypeError(f"mesh is a {type(mesh).__name__}, expected a clvoro.Result or a clvoro.Diagram")
    return mesh


def coloring(name: str, domain: Domain | None = None) -> Coloring:
    """Return the coloring of that name for cells of `domain`, by default in the plane, or raise InputError.

    On the Earth the numbers are in kilometers.
    """
    known = {2: COLORINGS, 3: _SOLID_COLORINGS}[2 if domain is None else domain.cell_dim]
    if not isinstance(name, str) or name not in known:
        raise InputError(f"color is {name!r:.60}, expected one of {', '.join(known)}")
    kilometer = domain and domain.globe and kilometer_of(domain.globe.radius)
    if not kilometer or name not in _ON_EARTH:
        return known[name]
    label, power = _ON_EARTH[name]
    return replace(known[name], label=label, unit=kilometer**power)


def kilometer_of(radius: float) -> float | None:
    """Return the length of a kilometer if `radius` is about that of the Earth in meters or kilometers, else None."""
    units = (1000.0, 1.0)
    return next((k for k in units if abs(radius / k / (EARTH_RADIUS / 1000) - 1) < 0.005), None)


@dataclass(frozen=True)
class Paint:
    """The colors of values, usually one for each cell."""

    scheme: Coloring
    values: np.ndarray
    """(n,) float."""
    limits: tuple[float, float]
    """(low, high). Ends of the color scale."""

    @property
    def norm(self) -> Normalize:
        """The map from values to [0, 1]."""
        low, high = self.limits
        if self.scheme.classes:
            return BoundaryNorm(np.linspace(low, high, len(self.scheme.classes) + 1), len(self.scheme.classes))
        return LogNorm(low, high) if self.scheme.logarithmic and high > 3 * low > 0 else Normalize(low, high)

    @property
    def finite(self) -> np.ndarray:
        """The values with infinite numbers replaced by large ones, as Matplotlib has no color for them."""
        return np.clip(self.values, -1e30, 1e30)

    def mappable(self) -> ScalarMappable:
        """Return what Matplotlib's color bars need."""
        return ScalarMappable(self.norm, self.scheme.color_map)

    def rgba(self, rows: np.ndarray) -> np.ndarray:
        """Return the colors (k, 4) of the values in `rows` (k,)."""
        return np.asarray(self.mappable().to_rgba(np.ma.masked_invalid(self.finite[rows])))


def paint_of(
    result: Result,
    color: Color | ArrayLike,
    label: str | None = None,
    limits: tuple[float, float] | None = None,
    seen: np.ndarray | slice = slice(None),
) -> Paint:
    """Return the colors of the cells of `result`: by their name, or for an array with one number per cell.

    Without `limits` the cells `seen` set the scale.

    Raises `InputError` or `InputTypeError` if there is no such color, or the array has another shape or no real
    numbers.
    """
    if isinstance(color, str):
        if isinstance(result, DiagramPicture) and color in _OF_RUNS:
            others = [name for name in COLORINGS if name not in _OF_RUNS]
            raise InputError(
                f"color is {color!r}, which a diagram without sizes does not have, expected one of {', '.join(others)} "
                "or an array"
            )
        scheme = coloring(color, result.diagram.domain)
        scheme = scheme if label is None else replace(scheme, label=label)
    else:
        own = np.asarray(color)
        if own.dtype.kind not in "fiub":
            raise InputTypeError(
                f"color is {color!r:.60}, expected one of {', '.join(COLORINGS)}, or an array of real numbers"
            )
        if own.shape != (len(result.points),):
            raise InputError(f"color has shape {own.shape}, expected ({len(result.points)},): one number per cell")
        own = own.astype(float)
        scheme = Coloring(label or "", lambda _: own, _DARKLESS, _most)
    values = scheme.values(result)
    return Paint(scheme, values, scheme.limits(values[seen]) if limits is None else ends_of(limits))


def shared_paint(results: Sequence[Result], color: str) -> Paint:
    """Return one color scale for the cells of all `results`, with their values.

    A scale of errors ends at most at `_BEYOND_BEST` times the end of the best mesh's own scale. Otherwise one bad mesh
    would hide the differences between the others.
    """
    scheme = coloring(color, results[0].diagram.domain)
    values = [scheme.values(r) for r in results]
    low, high = scheme.limits(np.concatenate(values))
    if color == "error":
        high = min(high, 1.0, _BEYOND_BEST * min(scheme.limits(v)[1] for v in values))
        low = -high
    return Paint(scheme, np.concatenate(values), (low, high))
