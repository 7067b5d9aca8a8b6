"""The report of the kernels that make or update a diagram, in 2D and in 3D (`tessellation/report.h`)."""

from __future__ import annotations

from collections.abc import Iterable

SIZE = 18
"""Numbers of the report."""
FACES, UNFINISHED, KEPT, LISTED, SPARE, SLOTS, WHOLE, WRONG = 1, 2, 4, 5, 14, 15, 16, 17
"""Places of some of them. Bits of the first one follow."""
FULL, COINCIDE, DOUBT, NARROW, LOOPED, UNEVEN, UNKNOWN, OPEN = 1, 2, 8, 16, 32, 64, 128, 256
HARMLESS = DOUBT | NARROW | UNEVEN
"""Flags of a diagram that is not rejected."""


def with_room(clipped: Iterable[int], most: int) -> list[int]:
    """Return the sizes of the launches of the next update from the cells `clipped` in each round of this one.

    The host must guess them. No round is larger than the one before.
    """
    sizes: list[int] = []
    for count in clipped:
        most = min(count + count // 2 + 256, most)
        sizes.append(most)
    return sizes
