"""A polygonal domain on the device: its frame, the box that clips cells, and its edges in bins."""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from ..opencl.engine import Traits
from .edge_grid import bin_edges
from .region import Region

if TYPE_CHECKING:
    from ..opencl.engine import Engine
    from ..opencl.workspace import Workspace

_MARGIN = 1 / 64
"""Distance from the domain to the box that clips cells, as a share of the bounding box's longest edge."""
_BEHIND = 16
"""Tolerance for generators on an edge, in units of round-off on the device."""


class DevicePolygon(Region):
    """What kernels get of a `Polygon`. It does not touch the box that clips cells."""

    framed_by: DevicePolygon | None = None
    """The polygon that this one is a part of; its frame is used on the device."""

    @property
    def clip_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the bounding box enlarged by 1/64 of its longest edge on every side."""
        if self.framed_by is not None:
            return self.framed_by.clip_box
        margin = _MARGIN * self.extent.max()
        return self.lower - np.full(2, margin), self.upper + np.full(2, margin)

    @property
    def frame(self) -> tuple[np.ndarray, float]:
        """Origin and scale of the device's coordinates, x' = (x - origin) / scale in [0, 1]."""
        lower, upper = self.clip_box
        return lower, 2.0 ** math.ceil(math.log2((upper - lower).max()))

    def traits(self, real: np.dtype) -> Traits:
        """Return for what kernels are built."""
        del real
        return Traits(("POLYGON",), cut=True)

    def device_args(self, engine: Engine) -> tuple[object, ...]:
        """Return the corners of the clip box and the edges in bins; see geometry/edges.h."""
        there = self._on_device.setdefault(engine.workspace, {})
        if engine.real not in there:
            origin, scale = self.frame
            begins = (self.oriented.vertices - origin) / scale
            ends = begins[self.oriented.next_vertex]
            frame, shape, starts, listed = bin_edges(begins, ends)
            # The round-off of a generator on an edge: that of the device and that of the domain.
            frame[3] = _BEHIND * float(np.finfo(engine.real).eps) + self._rounding / scale
            there[engine.real] = (
                frame.astype(engine.real),
                shape,
                engine.upload(starts, np.int32),
                engine.upload(np.concatenate([begins, ends], axis=1)[listed].ravel()),
            )
        return *self.device_corners(engine.real), *there[engine.real]

    @cached_property
    def _on_device(self) -> WeakKeyDictionary[Workspace, dict[np.dtype, tuple[object, ...]]]:
        """Results of `device_args` by workspace and precision; they are freed with the workspace."""
        return WeakKeyDictionary()
