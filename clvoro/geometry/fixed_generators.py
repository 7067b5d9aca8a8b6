"""Generators that do not move, so that faces lie on lines or end in creases, and balls that keep the others away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FixedGenerators:
    """Fixed generators around places to which they are nearest, wherever all others are.

    Each place is the center of a ball; the generators that are to meet there are on its sphere or within. Others stay
    outside. So two neighboring places belong to the cells of the generators of both, with all that is between them.

    Attributes
    ----------
    points : (n, d) float64
    centers, radii : (b, d) and (b,) float64
        Balls without other generators.
    ball_starts, balls : (n + 1,) and (k,) int32
        The balls of generator i are ``balls[ball_starts[i]:ball_starts[i + 1]]``.
    left_out : (k, d) float64
        Places on lines or creases without room for generators.
    """

    points: np.ndarray
    centers: np.ndarray
    radii: np.ndarray
    ball_starts: np.ndarray
    balls: np.ndarray
    left_out: np.ndarray

    own_sizes = False
    """Whether the target size of these cells is the size that they have."""
    corners = np.empty(0, int)
    """Vertices of `Polygon.oriented` around which they stand, (c,)."""

    def __len__(self) -> int:
        return len(self.points)
