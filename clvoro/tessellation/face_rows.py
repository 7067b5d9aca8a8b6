"""Rows of faces while a diagram in the plane is made (`tessellation/face_rows.h`)."""

from __future__ import annotations

from dataclasses import dataclass

import pyopencl.array as cla

SLOT = 20
"""Faces that there is room for in a slot; rows of more take several."""
SPARE_SHARE, SPARE_LEAST = 32, 64
"""Of how many cells one such slot is to spare at first, and how many are in any case."""
CROWDED = 1 << 16
"""Among the flags, but on the host alone: there were too few slots to spare."""


@dataclass
class FaceRows:
    """Lists of faces while a diagram is made, on the device and of the workspace; see `tessellation/face_rows.h`.

    Attributes
    ----------
    slots : (s * SLOT,) int32
    counts : (s,) int32
        Faces from each slot on; negative where rounding leaves a doubt.
    keep : (s,) uint32
        Bits of the faces that both cells see.
    places : (n,) int32
        First slot of each row, or -1 if it is as before.
    starts : (n + 1,) int32
        Starts of the rows in the new graph.
    flags : (6,) int32
        What went wrong, whether any cell is doubtful, the faces of all rows, the next spare slot, the number of slots,
        and whether faces of zero length stay.
    """

    slots: cla.Array
    counts: cla.Array
    keep: cla.Array
    places: cla.Array
    starts: cla.Array
    flags: cla.Array


def spare_slots(n: int) -> int:
    """Return how many slots there are at first for the rows of `n` cells that are longer than one."""
    return n // SPARE_SHARE + SPARE_LEAST
