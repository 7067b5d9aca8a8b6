"""Rounds of incremental updates, in 2D and 3D: launches whose sizes the host must guess."""

from __future__ import annotations

import numpy as np


def with_room(clipped: np.ndarray, most: int) -> list[int]:
    """Return the sizes of the launches of the next update, if this one has `clipped` so many cells in each round."""
    sizes = np.minimum(clipped + clipped // 2 + 256, most)
    return np.minimum.accumulate(sizes).tolist()
