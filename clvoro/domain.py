"""Domains: what is meshed, as the host describes it and as the device sees it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .errors import InputError

if TYPE_CHECKING:
    from ._program import Engine

LARGEST_EDGE = 1e50
"""Longest edge, and one over the shortest: fifth powers of lengths must not leave the range of float64."""


class Domain(ABC):
    """What is meshed.

    Attributes
    ----------
    lower, upper : tuples of d floats
        Opposite corners of the bounding box.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.lower)

    @property
    def extent(self) -> np.ndarray:
        """Edge lengths of the bounding box, (d,)."""
        return np.subtract(self.upper, self.lower)

    @property
    @abstractmethod
    def measure(self) -> float:
        """Area or volume."""

    @abstractmethod
    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell for each of `points` (n, d) whether it lies in the domain, boundary included; (n,) bool."""

    # The device's view.

    @property
    def frame(self) -> tuple[np.ndarray, float]:
        """Origin and scale of the device's coordinates, x' = (x - origin) / scale in [0, 1].

        The scale is a power of two, so that scaling itself rounds nothing.
        """
        return np.array(self.lower), 2.0 ** math.ceil(math.log2(self.extent.max()))

    @property
    def clip_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the box that cells are clipped by, whatever its walls mean."""
        return np.array(self.lower), np.array(self.upper)

    def device_corners(self, real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Corners of `clip_box` in the device's coordinates, padded to four numbers as kernels take them."""
        origin, scale = self.frame
        corners = np.zeros((2, 4), real)
        corners[:, : self.dim] = (np.array(self.clip_box) - origin) / scale
        return corners[0], corners[1]

    def defines(self, real: np.dtype) -> tuple[tuple[str, object], ...]:
        """Names and values that kernels are built with for this kind of domain; see common/domain.h."""
        del real
        return ()

    def device_args(self, engine: Engine) -> tuple[object, ...]:
        """Return what kernels take as DOMAIN_ARGS; see common/domain.h."""
        return self.device_corners(engine.real)


@dataclass(frozen=True)
class Box(Domain):
    """Axis-aligned box in 2D or 3D.

    Parameters
    ----------
    lower, upper : sequences of 2 or 3 floats
        Opposite corners. Wall ``2 a`` is the lower one of axis a, wall ``2 a + 1`` the upper one.

    Raises
    ------
    InputError
        If the corners are not 2 or 3 finite numbers each with lower < upper, or too near or far for float64.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def __post_init__(self) -> None:
        lower = np.asarray(self.lower, dtype=float)
        upper = np.asarray(self.upper, dtype=float)
        if lower.ndim != 1 or lower.shape != upper.shape or lower.size not in (2, 3):
            raise InputError(
                f"Box got corners of shape {lower.shape} and {upper.shape}, expected 2 or 3 "
                "coordinates each; write Box((0, 0), (2.5, 1.5))"
            )
        if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (lower < upper).all()):
            raise InputError(
                f"Box got lower {self.lower} and upper {self.upper}, expected finite numbers with "
                "lower < upper in every direction; exchange or correct the corners"
            )
        with np.errstate(over="ignore"):
            extent = upper - lower
        if not (extent.min() >= 1 / LARGEST_EDGE and extent.max() <= LARGEST_EDGE):
            raise InputError(
                f"Box got edges of {extent.tolist()}, expected {1 / LARGEST_EDGE:g} to {LARGEST_EDGE:g}: "
                "volumes and moments of cells must be numbers, too; choose another unit of length"
            )
        object.__setattr__(self, "lower", tuple(lower.tolist()))
        object.__setattr__(self, "upper", tuple(upper.tolist()))

    @property
    def measure(self) -> float:
        """Area or volume."""
        return float(np.prod(self.extent))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell for each of `points` (n, d) whether it lies in the box, walls included; (n,) bool."""
        return np.all((points >= self.lower) & (points <= self.upper), axis=1)
