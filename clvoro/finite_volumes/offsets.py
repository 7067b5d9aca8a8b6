"""Offsets of periodic images, in periods, as single integers."""

from __future__ import annotations

import numpy as np

_BASE = 64
"""Offsets of images, three numbers between -32 and 31, are digits of one integer: offsets add as integers."""


def pack(offsets: np.ndarray) -> np.ndarray:
    """Return offsets (k, 3) as integers (k,) int64."""
    return offsets.astype(np.int64) @ _BASE ** np.arange(3)


def unpack(codes: np.ndarray) -> np.ndarray:
    """Return integers of `pack` (k,) as offsets (k, 3)."""
    half = _BASE // 2
    digits = codes + half * (1 + _BASE + _BASE**2)
    return np.stack([digits // _BASE**a % _BASE - half for a in range(3)], axis=1)
