"""Smooth pieces of curves, and curves that consist of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

from ...arguments import check_number, format_point
from ...errors import InputError, InputTypeError
from ..boundary_names import WORD
from ..domain import LARGEST_EDGE

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles from vectors `a` to `b`, (n, 2) each, -pi to pi."""
    return np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))


LARGEST_TURN = math.radians(2)
"""Largest turn of a smooth curve from one edge of its polyline to the next."""
SAMPLES = 64
"""Least number of intervals that show the shape of a span."""
_MOST_SAMPLES = 1 << 16
_SAMPLE_TURN = 0.1  # radians between samples, at most, up to `_MOST_SAMPLES`
_MOST_EDGES = 1 << 20  # of one span
_SLACK = 1.04  # an edge is divided if its sagitta exceeds the tolerance by this factor
_ROUNDS = 50


@dataclass(frozen=True)
class Span:
    """A smooth part of a curve, for parameters from `begin` to `end`."""

    begin: float
    end: float
    at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    """Takes parameters (n,) and returns points (n, 2) and derivatives (n, 2) by the parameter."""
    samples: int = SAMPLES
    """Number of intervals that show the shape of the span."""

    def nearest(self, points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return the parameters (n,) from `lower` to `upper`, (n,) each, of the nearest points to `points` (n, 2).

        Gauss-Newton iteration. It converges for points whose distance is less than the radius of curvature, and
        reaches round-off in a few steps beside the curve.
        """
        begin, end = self.at(lower)[0], self.at(upper)[0]
        along = end - begin
        share = ((points - begin) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
        t = lower + np.clip(share, 0, 1) * (upper - lower)
        for _ in range(_ROUNDS):
            at, ahead = self.at(t)
            step = ((points - at) * ahead).sum(axis=1) / (ahead**2).sum(axis=1)
            new = np.clip(t + step, lower, upper)
            done = np.abs(new - t) <= 4 * np.finfo(float).eps * np.maximum(np.abs(t), upper - lower)
            t = new
            if done.all():
                break
        return t

    def resolve(self, tolerance: float) -> np.ndarray:
        """Return parameters (k + 1,), from `begin` to `end`, of a polyline with equal sagittas below `tolerance`."""
        m = self.samples
        while True:
            t = np.linspace(self.begin, self.end, m + 1)
            points, ahead = self.at(t)
            turns = np.abs(angles(ahead[:-1], ahead[1:]))
            if turns.max() <= _SAMPLE_TURN or m >= _MOST_SAMPLES:
                break
            m *= 2
        lengths = np.hypot(*np.diff(points, axis=0).T)
        # An arc of n edges that turns by a over the length s has the sagitta a s / (8 n^2).
        counts = np.maximum(np.sqrt(turns * lengths / (8 * tolerance)), turns / LARGEST_TURN)
        total = counts.sum()
        if total > _MOST_EDGES:
            raise InputError(
                f"the curve needs {total:.3g} edges for a tolerance of {tolerance:g}, expected at most {_MOST_EDGES}; "
                "give a larger tolerance"
            )
        n = max(1, math.ceil(total - 1e-9))
        reached = np.concatenate([[0.0], np.cumsum(counts)])
        found = np.interp(np.linspace(0, reached[-1], n + 1), reached, t) if total > 0 else t[:1]
        found = np.append(found[:n], self.end)
        found[0] = self.begin
        # Beside inflections curvature changes within an edge.
        wide = np.flatnonzero(self._sagittas(found) > _SLACK * tolerance)
        return np.sort(np.concatenate([found, (found[wide] + found[wide + 1]) / 2]))

    def _sagittas(self, t: np.ndarray) -> np.ndarray:
        """Return the largest distance of the curve from each edge between the parameters `t` (k + 1,), (k,)."""
        ends = self.at(t)[0]
        along = np.diff(ends, axis=0)
        along /= np.maximum(np.hypot(*along.T), 1e-300)[:, None]
        away = []
        for share in (0.25, 0.5, 0.75):
            off = self.at(t[:-1] + share * np.diff(t))[0] - ends[:-1]
            away.append(np.abs(off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]))
        return np.max(away, axis=0)


def check_point(what: str, value: ArrayLike) -> list[float]:
    """Return two finite numbers."""
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputTypeError(f"{what} is {value!r:.60}, expected two numbers") from error
    if array.shape != (2,) or not np.isfinite(array).all():
        raise InputError(f"{what} is {value!r:.60}, expected two finite numbers")
    return [float(c) for c in array]


def cos_sin(degrees: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cosine and sine, exact at multiples of 90 degrees."""
    quarter = np.rint(degrees / 90)
    rest = np.radians(degrees - 90 * quarter)
    c, s, q = np.cos(rest), np.sin(rest), quarter.astype(np.int64) % 4
    return np.choose(q, [c, -s, -c, s]), np.choose(q, [s, c, -s, -c])


_P = ParamSpec("_P")

TOLERANCE = 1e-6
"""Default distance between curve and polyline, as a share of the curve's extent: 1572 edges on a circle."""
CLOSE = 1e-9
"""Ends of curves and points that are this close, as a share of the ring's extent, are one vertex."""
MAKERS: dict[str, Callable[..., Curve]] = {}
"""The functions that make curves, by their names: the kinds of curves."""
_DIGITS = 2.0**-40  # smallest extent, as a share of the largest coordinate
_ROUNDINGS = 16  # least tolerance, in units of round-off of the largest coordinate


class Curve:
    """A curve in the plane, for the boundary of a `clvoro.Polygon`; also a shape for `clvoro.sizing.Distance`.

    `circle`, `arc`, `ellipse`, `naca` and `spline` make curves. Curves with equal arguments are equal.

    Attributes
    ----------
    kind : str
        The function that made the curve: "circle", "arc", ...
    arguments : dict
        Its arguments, as numbers, strings and lists.
    closed : bool
        Whether the curve is a whole ring.
    name : str or None
        Name of the boundary.
    tolerance : float
        Largest distance between the curve and its polyline.
    spans : tuple
        The smooth parts of the curve, one after the other.

    Examples
    --------
    >>> walls = [(0, 0), (2.2, 0), (2.2, 0.41), (0, 0.41)]
    >>> cylinder = clvoro.curves.circle((0.2, 0.2), 0.05, name="cylinder")
    >>> channel = clvoro.Polygon(walls, [cylinder])
    >>> channel.boundary_names, round(channel.measure - 2.2 * 0.41 + np.pi * 0.05**2, 7)
    (('outer', 'cylinder'), 0.0)
    """

    def __init__(self, kind: str, arguments: Mapping[str, Any], spans: Iterable[Span], closed: bool):
        self.kind, self.spans, self.closed = kind, tuple(spans), closed
        self.arguments = {key: value for key, value in arguments.items() if value is not None}
        name = self.name = arguments.get("name")
        if name is not None and (not isinstance(name, str) or not WORD.fullmatch(name)):
            raise InputError(
                f"{kind} name is {name!r:.60}, expected a word of ASCII letters, digits, _, . and - that begins with a "
                "letter or _"
            )
        points = np.concatenate([s.at(np.linspace(s.begin, s.end, s.samples + 1))[0] for s in self.spans])
        self.extent = float(np.ptp(points, axis=0).max())
        far = float(np.abs(points).max())
        if not np.isfinite(points).all() or self.extent < _DIGITS * far:
            raise InputError(
                f"{kind} has an extent of {self.extent:g} at {format_point(points[0])}, expected more "
                "than round-off; make it larger, or move it to the origin"
            )
        if not 1 / LARGEST_EDGE <= self.extent <= LARGEST_EDGE:
            raise InputError(
                f"{kind} has an extent of {self.extent:g}, expected {1 / LARGEST_EDGE:g} to {LARGEST_EDGE:g}; choose "
                "another unit of length"
            )
        given = arguments.get("tolerance")
        least = _ROUNDINGS * float(np.finfo(float).eps) * far
        if given is not None and check_number(f"{kind} tolerance", given, above=0) < least:
            raise InputError(
                f"{kind} tolerance is {given:g}, expected at least {least:.2g}: round-off of its coordinates"
            )
        self.tolerance = max(TOLERANCE * self.extent, least) if given is None else float(given)
        if given is not None:
            self.arguments["tolerance"] = self.tolerance

    @cached_property
    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Parameters at both ends of each edge of the polyline, (k, 2), and the span of each edge, (k,)."""
        found = [span.resolve(self.tolerance) for span in self.spans]
        ends = [np.column_stack([t[:-1], t[1:]]) for t in found]
        return np.concatenate(ends), np.repeat(np.arange(len(found)), [len(e) for e in ends])

    @cached_property
    def vertices(self) -> np.ndarray:
        """Vertices of the polyline, (k, 2); those of a closed curve without a closing vertex."""
        ends, span = self.nodes
        points = np.concatenate(
            [s.at(ends[span == i, 0])[0] for i, s in enumerate(self.spans)] + [self.spans[-1].at(ends[-1:, 1])[0]]
        )
        if self.closed and np.hypot(*(points[-1] - points[0])) <= CLOSE * self.extent:
            points = points[:-1]
        points.setflags(write=False)
        return points

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends (m, 2), (m, 2) and radii (m,) of the segments of the polyline, for `sizing.Distance`."""
        begin, end = self.vertices, np.roll(self.vertices, -1, axis=0)
        if not self.closed:
            begin, end = begin[:-1], end[:-1]
        return begin, end, np.zeros(len(begin))

    def describe(self) -> dict[str, Any]:
        """Return plain values from which `described` makes an equal curve."""
        return {"kind": self.kind, **self.arguments}

    @staticmethod
    def described(values: Mapping[str, Any]) -> Curve:
        """Return the curve from the values that `describe` returns.

        Raises
        ------
        InputError, InputTypeError
            If the values do not describe a curve.
        """
        rest = {key: value for key, value in values.items() if key != "kind"}
        kind = values.get("kind")
        if not isinstance(kind, str) or kind not in MAKERS:
            raise InputError(f"curve has the kind {kind!r:.60}, expected one of {', '.join(MAKERS)}")
        try:
            made = MAKERS[kind](**rest)
        except TypeError as error:
            raise InputTypeError(f"the description of a {kind} is damaged ({error})") from error
        return made

    def __eq__(self, other: object) -> bool:
        return self.describe() == other.describe() if isinstance(other, Curve) else NotImplemented

    def __hash__(self) -> int:
        return hash(repr(self.describe()))

    def __repr__(self) -> str:
        shown = {
            key: f"<{len(value)} points>" if key == "points" else repr(value) for key, value in self.arguments.items()
        }
        return f"{self.kind}({', '.join(f'{key}={value}' for key, value in shown.items())})"

    def __reduce__(self) -> tuple[Any, ...]:
        return Curve.described, (self.describe(),)


def makes_curves(function: Callable[_P, Curve]) -> Callable[_P, Curve]:
    """Decorate a function that makes curves, so that `Curve.described` finds it by its name."""
    MAKERS[function.__name__] = function
    return function
