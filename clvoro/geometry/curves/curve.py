"""What all curves have in common: arguments, name, tolerance, polyline and description."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import Any, ParamSpec

import numpy as np

from ...arguments import check_number, format_point
from ...errors import InputError, InputTypeError
from ..boundary_names import WORD
from .span import Span

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
