"""Axis-aligned boxes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError, InputTypeError
from .boundary_names import Walls
from .domain import LARGEST_EDGE, Domain


@dataclass(frozen=True, eq=False)
class Box(Domain):
    """Axis-aligned box in 2D or 3D.

    Parameters
    ----------
    lower, upper : sequences of 2 or 3 floats
        Opposite corners. Side ``2 a`` is the lower one of axis a, side ``2 a + 1`` the upper one.
    periodic : bool, or a sequence of 2 or 3
        Directions without walls: opposite sides are joined. One bool applies to all directions.
    names : mapping, optional
        Names of boundaries, each with its sides: numbers, default names, or a sequence of them. The default names are
        ``xMin``, ``xMax``, ``yMin``, ... Sides that are not mentioned keep them.

    Raises
    ------
    InputError
        If the corners are not 2 or 3 finite numbers each with lower < upper, or an edge is too short or long for
        float64; or if a name is not a word, clashes with another one, or stands for a side that does not exist or is
        periodic.
    InputTypeError
        If `periodic` is not a bool or a sequence of them, or `names` is not a mapping.

    Examples
    --------
    >>> channel = clvoro.Box((0, 0), (4, 1), periodic=(True, False))
    >>> channel.measure, channel.contains(np.array([(0.5, 0.5), (0.5, 1.5)])).tolist()
    (4.0, [True, False])
    >>> tunnel = clvoro.Box((0, 0), (4, 1), names={"inlet": "xMin", "walls": ["yMin", "yMax"]})
    >>> tunnel.boundary_names, tunnel.boundary_index.tolist()
    (('inlet', 'walls', 'xMax'), [0, 2, 1, 1])

    Notes
    -----
    On the device periods, and coordinates along them, are multiples of 2^-52 (2^-23 in float32) of the frame's unit,
    which is at most twice the longest edge. Then the sum of a position and a period is exact, and so are differences of
    positions. Both cells at a seam compute their common face from the same numbers.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    periodic: tuple[bool, ...] = False  # type: ignore[assignment]
    names: Mapping[str, Walls] | None = None

    def __post_init__(self) -> None:
        try:
            lower = np.asarray(self.lower, dtype=float)
            upper = np.asarray(self.upper, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputTypeError(
                f"Box got lower {self.lower!r} and upper {self.upper!r}, expected 2 or 3 numbers each; "
                "write Box((0, 0), (2.5, 1.5))"
            ) from error
        if lower.ndim != 1 or lower.shape != upper.shape or lower.size not in (2, 3):
            raise InputError(
                f"Box got corners of shape {lower.shape} and {upper.shape}, expected 2 or 3 "
                "coordinates each; write Box((0, 0), (2.5, 1.5))"
            )
        if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower < upper).all()):
            raise InputError(
                f"Box got lower {self.lower} and upper {self.upper}, expected finite numbers with "
                "lower < upper in every direction; swap or correct the corners, as in Box((0, 0), (2.5, 1.5))"
            )
        with np.errstate(over="ignore"):
            extent = upper - lower
        if not (extent.min() >= 1 / LARGEST_EDGE and extent.max() <= LARGEST_EDGE):
            raise InputError(
                f"Box got edges of {extent.tolist()}, expected {1 / LARGEST_EDGE:g} to {LARGEST_EDGE:g}, so that "
                "volumes and moments of cells do not overflow; choose another unit of length"
            )
        object.__setattr__(self, "lower", tuple(lower.tolist()))
        object.__setattr__(self, "upper", tuple(upper.tolist()))
        object.__setattr__(self, "periodic", _directions(self.periodic, lower.size))
        object.__setattr__(self, "names", self._checked_names())

    def __repr__(self) -> str:
        periodic = f", periodic={self.periodic}" if any(self.periodic) else ""
        return f"Box(lower={self.lower}, upper={self.upper}{periodic})"

    def describe(self) -> dict[str, Any]:
        """Return the arguments of this box as numbers, strings and lists."""
        corners = {"lower": self.lower, "upper": self.upper, "periodic": self.periodic}
        return corners | ({"names": dict(self.names)} if self.names else {})


def _directions(periodic: object, count: int) -> tuple[bool, ...]:
    """Return one bool for each of `count` directions."""
    values = [periodic] * count if isinstance(periodic, bool | np.bool_) else periodic
    if not isinstance(values, list | tuple | np.ndarray) or any(not isinstance(v, bool | np.bool_) for v in values):
        raise InputTypeError(f"Box got periodic {periodic!r}, expected True, False or one of them for each direction")
    if len(values) != count:
        raise InputError(f"Box got periodic {periodic!r} for {len(values)} directions, expected {count}")
    return tuple(bool(v) for v in values)
