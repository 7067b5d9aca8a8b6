"""Rows of faces of a 2D diagram under construction (`tessellation/face_rows.h`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

SLOT = 20
"""Faces per slot. A longer row takes several slots."""
SPARE_SHARE, SPARE_LEAST = 32, 64
"""Number of cells per spare slot, and the least number of spare slots, at first."""
CROWDED = 1 << 16
"""A flag that only the host sets: there were too few spare slots."""


@dataclass
class FaceRows:
    """Rows of faces of a diagram under construction, in scratch memory; see `tessellation/face_rows.h`."""

    slots: cla.Array
    """(s * SLOT,) int32."""
    counts: cla.Array
    """(s,) int32. Number of faces of the row that begins in each slot; negative if the cell is doubtful due to
    round-off."""
    keep: cla.Array
    """(s,) uint32. Bits of the faces that both cells have."""
    places: cla.Array
    """(n,) int32. First slot of each row; -1 for a row of the previous graph."""
    starts: cla.Array
    """(n + 1,) int32. Beginning of each row in the new graph."""
    report: cla.Array
    """int32. See `tessellation/report.h`."""
    old: tuple[cla.Array, cla.Array]
    """tuple of (n + 1,) int32 and int32. Starts and neighbors of the previous graph; `places` twice if all rows are
    new."""
    points: cla.Array
    """Generators, with weights in a power diagram."""
    corners: tuple[object, ...]
    """Lower and upper corner of the box, as arguments of kernels."""
    share: np.floating
    """Share of a cell that round-off may make uncertain."""

    @property
    def output(self) -> tuple[object, ...]:
        """What kernels write that make rows, as their arguments."""
        return self.slots, self.counts, self.places

    @property
    def input(self) -> tuple[object, ...]:
        """What kernels read of rows, as their arguments."""
        return self.places, self.slots, self.counts, *self.old

    @property
    def sites(self) -> tuple[object, ...]:
        """Generators and box, as arguments of kernels."""
        return self.points, *self.corners

    @property
    def n(self) -> int:
        """Number of rows."""
        return len(self.places)

    @property
    def all_new(self) -> bool:
        """Whether no row is one of the previous graph."""
        return self.old[0] is self.places


def spare_slots(n: int) -> int:
    """Return the initial number of spare slots, for the long rows of `n` cells."""
    return n // SPARE_SHARE + SPARE_LEAST
