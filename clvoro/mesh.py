"""A mesh at work: generators on the device, and what is known about their diagram."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ._primitives import Summaries, Summary
from ._program import Engine
from .bins import Bins
from .cells import Cells, Tessellation
from .domain import Box
from .errors import MemoryLimitError
from .fetch import fetch_diagram
from .metric import Metric
from .results import Diagram
from .sizing import Sizing

SUMMARIES = ("error", "quality", "moments", "lloyd", "correction", "changed", "ever")


@dataclass(frozen=True)
class Stages:
    """The stages that every mesh of one engine shares: compiled once, their buffers reused."""

    bins: Bins
    cells: Cells
    metric: Metric

    @classmethod
    def of(cls, engine: Engine) -> Stages:
        """Compile them."""
        return cls(Bins(engine), Cells(engine), Metric(engine))


def check_memory(engine: Engine, n: float) -> None:
    """Refuse a mesh of `n` cells that would not fit, before anything is allocated.

    Raises
    ------
    MemoryLimitError
        Saying how many cells were asked for, how much memory they need and how much there is.
    """
    # Reals and 32-bit integers per cell at the peak of a run, counted over all stages' buffers.
    reals, integers = (110, 60) if engine.dim == 2 else (300, 150)
    needed = n * (reals * engine.real.itemsize + integers * 4)
    available = engine.queue.device.global_mem_size
    if needed > available:
        raise MemoryLimitError(
            f"the size field asks for {n:.3g} cells, which need {needed / 2**30:.3g} GiB on the device; "
            f"{engine.queue.device.name.strip()} has {available / 2**30:.3g} GiB. Use a larger size, "
            "n_cells, dtype='float32' or another device"
        )


class Mesh:
    """Generators of one level, their diagram, sizes, error and quality, all on the device.

    Attributes
    ----------
    n : int
    points : (n, d) real
        Normalised coordinates, in an order of the device's own.
    labels : (n,) int32
        The caller's index of each generator.
    tessellation : Tessellation
    h, error, quality : (n,) real
    source, potential : (n,) real
        Right side of the latest Poisson solve, and its solution: the next one's start.
    lloyd, correction : (n, d) real
        The two halves of the latest step, and their lengths over h: `lloyd_speed`, `correction_speed` (n,).
    """

    def __init__(
        self, engine: Engine, stages: Stages, domain: Box, sizing: Sizing, points: np.ndarray
    ) -> None:
        self.engine, self.stages, self.domain, self.sizing = engine, stages, domain, sizing
        origin, scale = domain.frame
        n, d = points.shape
        self.n = n
        # Sort the generators by bin once, so that neighbours are near in memory.
        unsorted = engine.upload((points - origin) / scale)
        binned = stages.bins.build(unsorted, n)
        self.labels = binned.items[:n].copy()
        self.points = binned.points[:n].copy()
        self.h, self.error, self.quality = (engine.empty(n) for _ in range(3))
        self.lloyd_speed, self.correction_speed = engine.zeros(n), engine.zeros(n)
        self.correction = engine.zeros((n, d))
        self.source, self.potential = engine.empty(n), engine.zeros(n)
        self.changed, self.ever = engine.empty(n), engine.empty(n)
        self.signatures = engine.empty(n, np.uint64)
        self.summaries = Summaries(engine, SUMMARIES)
        self.tessellation: Tessellation | None = None
        self.update()

    @property
    def t(self) -> Tessellation:
        """The present diagram."""
        assert self.tessellation is not None
        return self.tessellation

    @property
    def lloyd(self) -> cla.Array:
        """Centroid minus generator (n, d)."""
        return self.t.offsets

    def update(self) -> None:
        """Tessellate the generators where they are now, and evaluate size, error and quality."""
        stages, first = self.stages, self.tessellation is None
        binned = stages.bins.build(self.points, self.n)
        self.tessellation = stages.cells.tessellate(
            self.domain, self.points, self.n, binned, self.tessellation
        )
        self.sizing.evaluate(self.points, self.n, self.h)
        stages.metric.evaluate(self.t, self.h, self.error, self.quality)
        stages.metric.compare_neighbours(
            self.t, self.labels, first, self.signatures, self.changed, self.ever
        )

    def assess(self) -> dict[str, Summary]:
        """Summarise the mesh: the scalars that the host sees of a step."""
        s, n = self.summaries, self.n
        s.collect("error", self.error, n)
        s.collect("quality", self.quality, n)
        s.collect("moments", self.t.moments, n)
        s.collect("lloyd", self.lloyd_speed, n)
        s.collect("correction", self.correction_speed, n)
        s.collect("changed", self.changed, n)
        s.collect("ever", self.ever, n)
        return s.read()

    # Results: physical units, the caller's order.

    def order(self) -> np.ndarray:
        """Device index of each generator in the order of labels, (n,)."""
        return np.argsort(self.labels.get(), kind="stable")

    def values(self, array: cla.Array, factor: float = 1.0) -> np.ndarray:
        """Fetch per-generator `array` (n, ...) in the order of labels, times `factor`."""
        host = array.get()[: self.n][self.order()]
        return host.astype(np.float64) * factor if factor != 1.0 else host.astype(np.float64)

    def diagram(self) -> Diagram:
        """Return the present diagram; its arrays are kept on the device and fetched when asked for."""
        return fetch_diagram(self.engine, self.domain, self.t, self.labels)
