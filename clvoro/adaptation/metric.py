"""Metric error (the paper's 3.1), quality (4.1) and changes of neighbors (`metric.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation


class Metric:
    """The kernels of `metric.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/metric")
        self._exact = engine.kernels("adaptation/metric", {"FACE": engine.name_of(engine.real)})

    def evaluate(
        self,
        t: Tessellation,
        h: cla.Array,
        error: cla.Array,
        quality: cla.Array,
        energy: cla.Array,
        local_length: cla.Array,
    ) -> None:
        """Write the signed error (3.1), the quality (4.1), the energy (2.3) of each cell, and min(L, h); all (n,)."""
        exact = t.face_measures.dtype == self.engine.real
        kernels = self._exact if exact else self._kernels
        self.engine.run_each(
            kernels.evaluate_metric,
            t.n,
            t.volumes,
            t.starts,
            t.face_measures,
            t.offsets,
            t.covariances,
            h,
            error,
            quality,
            energy,
            local_length,
            *t.outlines,
        )

    def compare_neighbors(
        self,
        t: Tessellation,
        labels: cla.Array,
        first: bool,
        signatures: cla.Array,
        changed: cla.Array,
        ever_changed: cla.Array,
    ) -> None:
        """Write 1 to `changed` (n,) and `ever_changed` (n,) where the set of neighbors differs from the last call.

        `signatures` (n,) uint64 are the hashes to compare; with `first` they are only set.
        """
        self.engine.run_each(
            self._kernels.compare_neighbors,
            t.n,
            t.starts,
            t.neighbors,
            labels,
            np.int32(first),
            signatures,
            changed,
            ever_changed,
        )

    def set_fixed_sizes(self, labels: cla.Array, first: int, fixed: int, volumes: cla.Array, h: cla.Array) -> None:
        """Set `h` (n,) to the present size of cells whose label is at least `first` and below `fixed`."""
        self.engine.run_each(
            self._kernels.set_fixed_sizes, len(h), labels, np.int32(first), np.int32(fixed), volumes, h
        )

    def scale_sizes(self, factor: float, h: cla.Array) -> None:
        """Multiply `h` (n,) by `factor`."""
        self.engine.run_each(self._kernels.scale_sizes, len(h), self.engine.real.type(factor), h)
