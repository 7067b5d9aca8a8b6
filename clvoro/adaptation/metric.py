"""Metric error (the paper's 3.1), quality (4.1) and changes of neighbors (`metric.cl`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation


class Neighborhoods(NamedTuple):
    """Sets of neighbors that are compared with those of the last evaluation, on the device.

    - `labels`: (n,) int32
    - `signatures` (n,) uint64: hashes of the sets of the last evaluation; become those of this one.
    - `changed`, `ever_changed` (n,) real: become 1 where the sets differ; `ever_changed` stays 1.
    - `first`: there was no evaluation: the hashes are only set.
    """

    labels: cla.Array
    signatures: cla.Array
    changed: cla.Array
    ever_changed: cla.Array
    first: bool = False


class Metric:
    """The kernels of `metric.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/metric")

    def evaluate(
        self,
        t: Tessellation,
        h: cla.Array,
        error: cla.Array,
        quality: cla.Array,
        energy: cla.Array,
        local_length: cla.Array,
        compared: Neighborhoods | None = None,
    ) -> None:
        """Write the signed error (3.1), the quality (4.1), the energy (2.3) of each cell, and min(L, h); all (n,)."""
        sets = (0, *[t.starts] * 5)
        if compared is not None:
            labels, *arrays, first = compared
            sets = (2 if first else 1, t.neighbors, t.names(self.engine, labels), *arrays)
        faces = t.volumes, t.starts, t.face_measures, int(t.face_measures.dtype == self.engine.real)
        found = h, error, quality, energy, local_length
        self.engine.run_each(
            self._kernels.evaluate_metric, t.n, *faces, t.offsets, t.covariances, *found, *sets, *t.outlines
        )

    def set_fixed_sizes(self, labels: cla.Array, first: int, fixed: int, volumes: cla.Array, h: cla.Array) -> None:
        """Set `h` (n,) to the present size of cells whose label is at least `first` and below `fixed`."""
        self.engine.run_each(
            self._kernels.set_fixed_sizes, len(h), labels, np.int32(first), np.int32(fixed), volumes, h
        )

    def scale_sizes(self, factor: float, h: cla.Array) -> None:
        """Multiply `h` (n,) by `factor`."""
        self.engine.run_each(self._kernels.scale_sizes, len(h), self.engine.real.type(factor), h)
