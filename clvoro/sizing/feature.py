"""Sizes from the boundary of a polygon or a solid: by its curvature, and by the width of gaps and thin parts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, InputTypeError
from ..geometry.gaps import find_gaps
from ..geometry.polygon import Polygon
from ..geometry.shapes import Edges
from ..geometry.solid.solid import Solid
from ..geometry.surface import Surface
from .arguments import check_positive, check_slope, covered_share
from .distance import Distance
from .field import Constant, Field, minimum

if TYPE_CHECKING:
    from ..geometry.domain import Domain
    from .codegen import CodeWriter


_STEP = math.sqrt(2)  # ratio of the sizes of neighboring classes of triangles


def curvature_size(solid: Solid, *, h_max: float, h_min: float, per_turn: float = 16.0, growth: float = 1.2) -> Field:
    """Return sizes with a number of cells around curved walls: h = 2 pi / (per_turn * curvature) on the surface.

    Away from it sizes grow. On the surface they are rounded down to steps of a factor of sqrt(2).

    Parameters
    ----------
    solid : Solid
    h_max, h_min : float
        Bounds of h. Flat walls have h_max.
    per_turn : float
        Cells on a full circle.
    growth : float
        Ratio of the sizes of neighboring cells, at least 1; see `Distance`.

    Raises
    ------
    InputError, InputTypeError
        If a number is out of range.

    Examples
    --------
    >>> part = clvoro.Solid.cylinder((0, 0, 0), (0, 0, 2), 0.5)
    >>> size = clvoro.sizing.curvature_size(part, h_min=0.02, h_max=0.3, per_turn=12)
    >>> bool(0.15 < size(np.array([(0.49, 0.0, 1.0)]))[0] < 0.3)
    True
    """
    _require_surface("curvature_size", solid)
    per_turn = check_positive("curvature_size per_turn", per_turn)
    with np.errstate(divide="ignore"):
        wanted = 2 * math.pi / (per_turn * solid.curvature)
    return _from_walls("curvature_size", solid, wanted, h_min, h_max, growth)


def gap_size(solid: Solid, *, h_max: float, h_min: float, cells: float = 3.0, growth: float = 1.2) -> Field:
    """Return sizes with a number of cells across gaps and thin parts: h = width / cells on the surface.

    Away from it sizes grow. On the surface they are rounded down to steps of a factor of sqrt(2).

    Parameters
    ----------
    solid : Solid
    h_max, h_min : float
        Bounds of h. Where the solid is wider than cells * h_max it is h_max.
    cells : float
        Cells across.
    growth : float
        Ratio of the sizes of neighboring cells, at least 1; see `Distance`.

    Raises
    ------
    InputError, InputTypeError
        If a number is out of range.

    Examples
    --------
    >>> plate = clvoro.Solid.box((0, 0, 0), (1, 1, 0.1))
    >>> size = clvoro.sizing.gap_size(plate, h_min=0.01, h_max=0.2, cells=4)
    >>> bool(0.015 < size(np.array([(0.5, 0.5, 0.0)]))[0] <= 0.025)
    True
    """
    _require_surface("gap_size", solid)
    cells, h_max = check_positive("gap_size cells", cells), check_positive("gap_size h_max", h_max)
    width = solid.widths(np.arange(len(solid.patch)), np.full(len(solid.patch), cells * h_max))
    return _from_walls("gap_size", solid, width / cells, h_min, h_max, growth)


def _require_surface(name: str, domain: object) -> None:
    if not hasattr(domain, "surface"):
        raise InputTypeError(
            f"{name} got a {type(domain).__name__}, expected a clvoro.Solid; FeatureSize is for polygons, and a box is "
            "clvoro.Solid.box(lower, upper)"
        )


def _from_walls(name: str, solid: Solid, wanted: np.ndarray, h_min: float, h_max: float, growth: float) -> Field:
    """Return sizes that grow from `wanted` (t,) on the triangles of a solid."""
    h_min, h_max = check_positive(f"{name} h_min", h_min), check_positive(f"{name} h_max", h_max)
    if h_min > h_max:
        raise InputError(f"{name} got h_min {h_min:g} and h_max {h_max:g}, expected h_min <= h_max")
    step = np.ceil(np.log(h_max / np.clip(wanted, h_min, h_max)) / math.log(_STEP) - 1e-9).astype(int)
    fields: list[Field] = [Constant(h_max)]
    for k in np.unique(step[step > 0]).tolist():
        part = Surface(solid.surface.vertices, solid.surface.triangles[step == k], name)
        fields.append(Distance(part, h_min=max(h_max / _STEP**k, h_min), growth=growth, h_max=h_max))
    return minimum(*fields) if len(fields) > 1 else fields[0]


CORNER = math.radians(30)
"""Turns of more than this are corners, not curves."""
_MOST = 1e9
"""Most cells across a gap."""


def radii_of_curvature(domain: Polygon) -> np.ndarray:
    """Return the radius of curvature at each oriented edge, (k,); infinite beside corners and for straight lines.

    Between edges of lengths p and q that turn by the angle a, the radius is ``min(p, q) / (2 tan(a / 2))``: that of the
    circle that touches both edges at half the length of the shorter one.
    """
    following = domain.oriented.next_vertex
    edge = domain.oriented.vertices[following] - domain.oriented.vertices
    length = np.hypot(*edge.T)
    before = np.empty(len(edge), np.int64)
    before[following] = np.arange(len(edge))
    last = edge[before]
    turn = np.abs(np.arctan2(last[:, 0] * edge[:, 1] - last[:, 1] * edge[:, 0], (last * edge).sum(axis=1)))
    smooth = (turn > 1e-9) & (turn <= CORNER)
    radius = np.full(len(edge), math.inf)
    shorter = np.minimum(length, length[before])
    radius[smooth] = shorter[smooth] / (2 * np.tan(turn[smooth] / 2))
    return np.minimum(radius, radius[following])


_FINEST, _COARSEST = 1e-3, 0.1  # of the domain's longest side, by default
_MAX_LANDMARKS = 1 << 14  # sources with landmarks
_THINNING = 16  # of sources closer than about 1/16 of their size only one is kept


@dataclass(frozen=True, eq=False)
class _SizedSegments(Edges):
    """Segments with individual sizes. A radius of -r replaces a distance d by d + r."""

    extra: np.ndarray

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.begin, self.end, -self.extra


class FeatureSize(Field):
    r"""Size by the local features of a polygonal domain.

    ``h(x) = min over k of size_k + slope * (distance of x to segment k)``, at most `h_max`. The segments are

    - chords across gaps, with their length / `cells_across` as size. A gap lies between walls that face each other, as
      in channels, straits or beside an island. The walls of a corner of more than 45 degrees do not face each other. In
      a sharper corner the gap goes to zero towards the tip, and the size to `h_min`.
    - edges of curved parts of the boundary, with the radius of curvature / `curvature` as size. Turns of more than
      30 degrees are corners, not curves.

    Parameters
    ----------
    domain : clvoro.Polygon
    cells_across : float
        Number of cells across a gap, at least.
    growth : float, optional
        Geometric growth rate of cells away from the features; the slope is ln(growth), as for `Distance`. By
        default 1.2.
    h_min : float, optional
        Lower bound of h; by default 1/1000 of the domain's longest side.
    h_max : float, optional
        Upper bound of h; by default a tenth of the domain's longest side.
    curvature : float
        Number of cells per radius of curvature, which is the number per radian; 0 leaves out curvature.
    slope : float, optional
        dh/dx, in place of `growth`.

    Attributes
    ----------
    sources : (begin (m, 2), end (m, 2), size (m,))
        The segments.

    Raises
    ------
    InputError, InputTypeError
        If a number is out of range or the domain is not a Polygon.

    Examples
    --------
    At least six cells across every strait of a lake::

        lake = clvoro.Polygon.from_geojson("lake.geojson")
        size = clvoro.sizing.FeatureSize(lake, cells_across=6, h_min=0.01, h_max=0.3)
    """

    dim = 2

    def __init__(
        self,
        domain: Polygon,
        cells_across: float = 4,
        growth: float | None = None,
        h_min: float | None = None,
        h_max: float | None = None,
        curvature: float = 3,
        slope: float | None = None,
    ):
        if getattr(domain, "outline", None) is None:
            raise InputTypeError(f"FeatureSize domain is a {type(domain).__name__}, expected a clvoro.Polygon")
        self.domain, longest = domain, float(domain.extent.max())
        self.cells_across = check_positive("FeatureSize cells_across", cells_across)
        if self.cells_across > _MOST:
            raise InputError(f"FeatureSize cells_across is {cells_across!r}, expected at most {_MOST:g}")
        self.slope = check_slope("FeatureSize", 1.2 if growth is None and slope is None else growth, slope)
        if self.slope == 0:
            raise InputError("FeatureSize got no growth, expected growth above 1 or slope above 0")
        self.h_min = check_positive("FeatureSize h_min", _FINEST * longest if h_min is None else h_min)
        usual = max(_COARSEST * longest, self.h_min)
        self.h_max = check_positive("FeatureSize h_max", usual if h_max is None else h_max)
        if self.h_max < self.h_min:
            raise InputError(f"FeatureSize h_max is {self.h_max:g}, expected at least h_min = {self.h_min:g}")
        self.curvature = 0.0 if curvature == 0 else check_positive("FeatureSize curvature", curvature)
        self.sources = self._find()
        begin, end, size = self.sources
        if len(size):
            shape = _SizedSegments(begin, end, (size - self.h_min) / self.slope)
            self._field: Field = Distance(shape, self.h_min, slope=self.slope, h_max=self.h_max)
        else:
            self._field = Constant(self.h_max)

    def _find(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        domain, across = self.domain, self.cells_across
        begin, end = find_gaps(domain, across * self.h_min, across * self.h_max)
        size = np.hypot(*(end - begin).T) / across
        if self.curvature:
            radius = radii_of_curvature(domain)
            curved = np.flatnonzero(radius < self.curvature * self.h_max)
            oriented = domain.oriented
            begin = np.concatenate([begin, oriented.vertices[curved]])
            end = np.concatenate([end, oriented.ends[curved]])
            size = np.concatenate([size, radius[curved] / self.curvature])
        size = np.maximum(size, self.h_min)
        kept = size < self.h_max
        begin, end, size = begin[kept], end[kept], size[kept]
        kept = _thin_sources(domain, 0.5 * (begin + end), size)
        return begin[kept], end[kept], size[kept]

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the ends and midpoints of the sources, of those with the smallest sizes if there are many."""
        begin, end, size = self.sources
        least = np.argsort(size, kind="stable")[:_MAX_LANDMARKS]
        points = np.concatenate([begin[least], 0.5 * (begin[least] + end[least]), end[least]])
        return points if len(points) else np.zeros((0, domain.dim))

    def warnings(self, domain: Domain) -> list[str]:
        """Return a warning if the polygon does not overlap `domain`."""
        if covered_share(domain, self.domain.lower, self.domain.upper) > 0:
            return []
        return [f"{self!r} does not overlap the domain {domain!r}; expected a FeatureSize of the domain that is meshed"]

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self._field._evaluate(points)

    def _emit(self, writer: CodeWriter) -> str:
        return self._field._emit(writer)

    def __repr__(self) -> str:
        return (
            f"FeatureSize({self.domain!r}, {len(self.sources[2])} sources, h_min={self.h_min:g}, "
            f"slope={self.slope:g}, h_max={self.h_max:g})"
        )


def _thin_sources(domain: Polygon, middle: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the sources to keep: the smallest one of those with midpoints in the same small square.

    The edge of a square is the power of two below 1/16 of the size, so sizes change by at most slope / 11 of
    themselves.
    """
    level = np.floor(np.log2(size / _THINNING))
    place = np.floor((middle - domain.lower) / 2.0 ** level[:, None])
    order = np.lexsort((size, place[:, 1], place[:, 0], level))
    key = np.column_stack([level, place])[order]
    first = np.ones(len(order), bool)
    first[1:] = (key[1:] != key[:-1]).any(axis=1)
    return np.sort(order[first])
