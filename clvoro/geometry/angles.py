"""Angles between vectors in the plane."""

from __future__ import annotations

import numpy as np


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles from vectors `a` to `b`, (n, 2) each, -pi to pi."""
    return np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
