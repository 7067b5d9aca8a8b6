"""How good a diagram is: metric error, quality, and whose neighbors changed (`metric.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation


class Metric:
    """Evaluate cells against their target size."""

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
        reach: cla.Array,
    ) -> None:
        """Write the paper's (3.1), signed, its (4.1), each cell's part of its (2.3), and min(L, h); all (n,)."""
        exact = t.face_measures.dtype == self.engine.real
        kernels = self._exact if exact else self._kernels
        self.engine.run_each(
            kernels.evaluate_metric, t.n, t.volumes, t.starts, t.face_measures, t.offsets,
            t.covariances, h, error, quality, energy, reach, *t.outlines,
        )  # fmt: skip

    def compare_neighbors(
        self,
        t: Tessellation,
        labels: cla.Array,
        first: bool,
        signatures: cla.Array,
        changed: cla.Array,
        ever: cla.Array,
    ) -> None:
        """Write 1 to `changed` (n,) and `ever` (n,) where the set of neighbors differs from the last call's.

        `signatures` (n,) uint64 carries what is compared; `first` only records it.
        """
        self.engine.run_each(
            self._kernels.compare_neighbors, t.n, t.starts, t.neighbors, labels, np.int32(first),
            signatures, changed, ever,
        )  # fmt: skip

    def hold_sizes(self, labels: cla.Array, fixed: int, volumes: cla.Array, h: cla.Array) -> None:
        """Write the size that they have to `h` (n,) of cells whose label is less than `fixed`."""
        self.engine.run_each(self._kernels.hold_sizes, len(h), labels, np.int32(fixed), volumes, h)

    def scale_sizes(self, factor: float, h: cla.Array) -> None:
        """Multiply `h` (n,) by `factor`."""
        self.engine.run_each(self._kernels.scale_sizes, len(h), self.engine.real.type(factor), h)
