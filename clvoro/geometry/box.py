"""Axis-aligned boxes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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

    def without(self, holes: Sequence[object], names: Mapping[str, Walls] | None = None) -> Box:
        """Return this box in 2D with holes, for runs; one direction or both are periodic.

        Such holes are tubes of a bank, wings of a cascade, pores of a representative volume. Generators stand on both
        sides of their outlines in pairs that are mirror images, so that faces lie on them; the cells inside are removed
        when a run ends. Holes may cross periodic sides. The domain of the mesh is a
        `clvoro.geometry.subdomain.Subdomain`.

        Parameters
        ----------
        holes : sequence of rings
            Each like the outer ring of a `Polygon`: vertices (k, 2), a closed curve, or a list of points and curves.
        names : mapping, optional
            Names of boundaries, each with its holes: numbers, default names, or a sequence of them. The default names
            are ``hole-1``, ``hole-2``, ..., or that of the curve that a hole is.

        Raises
        ------
        InputError, InputTypeError
            If no direction is periodic, a hole is no ring, holes touch each other, their images or a wall, or names
            are wrong.

        Examples
        --------
        >>> tube = clvoro.curves.circle((0, 0.5), 0.2)
        >>> bank = clvoro.Box((0, 0), (1, 1), periodic=True).without([tube], names={"tube": 0})
        >>> mesh = clvoro.adapt(bank, clvoro.sizing.Distance(bank.holes, 0.03, growth=1.2, h_max=0.1), "fast")
        >>> mesh.diagram.domain.boundary_names, round(mesh.diagram.domain.measure, 2)
        (('tube',), 0.87)
        """
        from .lines.obstacles import Obstacles

        self.require_plane("holes are in the plane", "use a clvoro.Solid")
        if not any(self.periodic):
            raise InputError(f"{self} has no periodic direction; write clvoro.Polygon(outline, holes)")
        if self.borders is not None:
            raise InputError("the box has lines or holes already, expected one of them; give all holes at once")
        made = Box(**self.describe())
        found = Obstacles(made, holes, names)
        vars(made).update(borders=found, holes=found)
        return made

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
