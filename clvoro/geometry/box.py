"""Axis-aligned boxes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..arguments import check_rows
from ..errors import InputError, InputTypeError
from .boundary_names import BoundaryNames, Walls
from .domain import LARGEST_EDGE, Domain
from .shapes import Edges
from .surface import Surface, box_surface


@dataclass(frozen=True)
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
    names: Mapping[str, Walls] | None = field(default=None, compare=False)

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

    def _default_names(self) -> BoundaryNames:
        sides = [f"{axis}{end}" for axis in "xyz"[: self.dim] for end in ("Min", "Max")]
        walls = np.flatnonzero(~np.repeat(self.periodic, 2))
        index = np.full(len(sides), -1, np.int32)
        index[walls] = np.arange(len(walls))
        return BoundaryNames(tuple(sides[w] for w in walls), index, "side")

    def boundary(self, walls: Walls | None = None) -> Edges | Surface:
        """Return sides as a shape for `clvoro.sizing.Distance`: segments in 2D, triangles in 3D.

        Parameters
        ----------
        walls : int, str, or a sequence of them, optional
            Numbers or names of sides; by default all that are not periodic.

        Raises
        ------
        InputError, InputTypeError
            If a side or name does not exist, or the box has no walls.
        """
        chosen = self.boundaries.select("boundary", walls)
        if not chosen.size:
            raise InputError(f"{self} is periodic in every direction, expected a box with a boundary")
        lower, upper = np.array(self.lower), np.array(self.upper)
        if self.dim == 3:
            whole = box_surface(lower, upper)
            sides = whole.triangles.reshape(6, 2, 3)[[4, 5, 2, 3, 0, 1]]
            return Surface(whole.vertices, sides[chosen].reshape(-1, 3), "boundary")
        corners = np.array([(0, 1), (0, 0), (1, 0), (1, 1)])  # counter-clockwise, side 0 first
        order = np.array([0, 2, 1, 3])[chosen]  # place of each side in this order
        x = np.where(corners, upper, lower)
        return Edges(x[order], x[(order + 1) % 4])

    @property
    def boundary_measure(self) -> float:
        """Length or area of all sides, periodic ones included."""
        return float(2 * sum(np.prod(np.delete(self.extent, a)) for a in range(self.dim)))

    def wall_planes(self, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return outward unit normals of sides (k,) int, and a point on each, (k, d) each."""
        axis, upper = walls // 2, walls % 2
        normals = np.zeros((len(walls), self.dim))
        normals[np.arange(len(walls)), axis] = 2.0 * upper - 1
        return normals, np.array([self.lower, self.upper])[upper]

    def _gaps(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (n, 2 d) of `points` to the planes of all sides, inf for periodic ones."""
        gaps = np.stack([np.subtract(points, self.lower), np.subtract(self.upper, points)], axis=2)
        gaps[:, np.array(self.periodic)] = np.inf
        return gaps.reshape(len(points), 2 * self.dim)

    def closest_walls(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) the side whose plane is the closest one, (n,) int."""
        return self._gaps(points).argmin(axis=1)

    def boundary_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each of `points` (n, d) to the walls, inside and outside; (n,), inf without walls."""
        gaps = self._gaps(points)
        outside = np.linalg.norm(np.minimum(gaps, 0), axis=1)
        return np.where(outside > 0, outside, gaps.min(axis=1))

    def inner_points(self) -> np.ndarray:
        """Return the center, (1, d)."""
        return (np.array([self.lower]) + self.upper) / 2

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return the nearest point of the box to each of `points` (n, d)."""
        return np.where(self.periodic, points, np.clip(points, self.lower, self.upper))

    @property
    def measure(self) -> float:
        """Area or volume."""
        return float(np.prod(self.extent))

    def describe(self) -> dict[str, Any]:
        """Return the arguments of this box as numbers, strings and lists."""
        corners = {"lower": self.lower, "upper": self.upper, "periodic": self.periodic}
        return corners | ({"names": dict(self.names)} if self.names else {})

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) whether it lies in the box, walls included; (n,) bool.

        In a periodic direction every finite coordinate is inside.
        """
        points = check_rows("points", points, self.dim)
        inside = (points >= self.lower) & (points <= self.upper)
        return np.all(inside | (np.array(self.periodic) & np.isfinite(points)), axis=1)


def _directions(periodic: object, dim: int) -> tuple[bool, ...]:
    """Return one bool for each of `dim` directions."""
    values = [periodic] * dim if isinstance(periodic, bool | np.bool_) else periodic
    if not isinstance(values, list | tuple | np.ndarray) or any(not isinstance(v, bool | np.bool_) for v in values):
        raise InputTypeError(f"Box got periodic {periodic!r}, expected True, False or one of them for each direction")
    if len(values) != dim:
        raise InputError(f"Box got periodic {periodic!r} for {len(values)} directions, expected {dim}")
    return tuple(bool(v) for v in values)
