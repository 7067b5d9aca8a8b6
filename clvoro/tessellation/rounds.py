"""Rounds of incremental updates, in 2D and 3D: launches whose sizes the host must guess."""

from __future__ import annotations

from collections.abc import Iterable


def with_room(clipped: Iterable[int], most: int) -> list[int]:
    """Return the sizes of the launches of the next update, if this one has `clipped` so many cells in each round.

    No round is larger than the one before.
    """
    sizes: list[int] = []
    for count in clipped:
        most = min(count + count // 2 + 256, most)
        sizes.append(most)
    return sizes
