"""The arrays of a mesh on the device: generators, their diagram, sizes, error and quality."""

from __future__ import annotations

from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import Domain
from ..opencl.engine import Engine
from ..opencl.primitives import Summaries
from ..sizing import Sizing
from ..tessellation.device_diagram import Tessellation
from ..tessellation.readback.diagram import order_of
from .insertion_deletion import Generators
from .motion import Moving
from .stages import Stages

SUMMARIES = ("error", "quality", "energy", "lloyd", "correction", "changed", "ever_changed", "log_ratio", "weight")


@dataclass
class CellArrays:
    """Arrays (n,) real that follow from the generators; see `MeshArrays`."""

    h: cla.Array
    error: cla.Array
    quality: cla.Array
    local_length: cla.Array
    potential: cla.Array

    @classmethod
    def empty(
        cls, engine: Engine, n: int, h: cla.Array | None = None, potential: cla.Array | None = None
    ) -> CellArrays:
        """Return new arrays for `n` cells. Only the potential is read before it is written, and starts from 0."""
        return cls(
            h=engine.empty(n) if h is None else h,
            error=engine.empty(n),
            quality=engine.empty(n),
            local_length=engine.empty(n),
            potential=engine.zeros(n) if potential is None else potential,
        )


@dataclass
class Arrays:
    """All arrays of one set of generators. An interruption leaves the old or the new set, never a mixture."""

    generators: Generators
    cells: CellArrays | None = None
    tessellation: Tessellation | None = None
    multipliers: cla.Array | None = None


def _property(part: str, name: str) -> Any:
    """Return a property for attribute `name` of `part` of `MeshArrays._data`."""
    return property(attrgetter(f"_data.{part}.{name}"))


@dataclass(frozen=True)
class Setup:
    """What all levels of a run have in common.

    Attributes
    ----------
    free : Domain
        Part of the domain, in its frame, in which generators may move.
    fixed : int
        Generators with labels below `fixed` do not move.
    points : (k, d) ndarray
        Positions of those with the labels 0 to k - 1, on the finest level. Their cells have target sizes like all
        others. The other fixed generators are those of layers: the size of their cells is their target size.
    factor : float
        Initial factor on the size field on the finest level.
    """

    stages: Stages
    domain: Domain
    sizing: Sizing
    free: Domain
    fixed: int
    points: np.ndarray
    factor: float = 1.0

    @property
    def first_row(self) -> int:
        """Label of the first generator of layers."""
        return len(self.points)


class MeshArrays:
    """What a `MeshState` holds: its arrays under their names.

    Parameters
    ----------
    setup : Setup
    size_factor : float
        Factor on the size field: 2^k on level k above the finest.

    Attributes
    ----------
    n : int
    points : (n, d) real
        Normalized coordinates, in the order of the bins.
    labels : (n,) int32
        Permanent names of the generators.
    velocity : (n, d) real
        Displacement in the last step.
    signatures : (n,) uint64
        Hashes of the sets of neighbors; see `Metric.compare_neighbors`.
    ever_changed : (n,) real
        1 where the set of neighbors has changed in a step on this level, else 0.
    tessellation : Tessellation or None
    h, error, quality : (n,) real
    local_length : (n,) real
        min(L, h), the unit of bounds of the motion.
    potential : (n,) real
        Solution of the last Poisson solve, the start of the next one.
    multipliers : (n,) float32 or None
        Solution of the last volume projection, the start of the next one.
    source : (n,) real
        Right side of the Poisson equation. It and the following arrays are in the workspace, valid for one step.
    lloyd, correction : (n, d) real
        The two parts of the displacement.
    """

    _data: Arrays
    source: cla.Array
    lloyd: cla.Array
    correction: cla.Array

    points = _property("generators", "points")
    labels = _property("generators", "labels")
    velocity = _property("generators", "velocity")
    signatures = _property("generators", "signatures")
    ever_changed = _property("generators", "ever_changed")
    h = _property("cells", "h")
    error = _property("cells", "error")
    quality = _property("cells", "quality")
    local_length = _property("cells", "local_length")
    potential = _property("cells", "potential")

    def __init__(self, setup: Setup, size_factor: float) -> None:
        self.setup, self.size_factor = setup, size_factor
        self.stages, self.domain, self.sizing = setup.stages, setup.domain, setup.sizing
        self.free, self.fixed = setup.free, setup.fixed
        self.engine = self.stages.engine
        self.summaries = Summaries(self.engine, SUMMARIES)
        self._ordered: cla.Array | None = None

    @property
    def n(self) -> int:
        """Number of generators."""
        return self._data.generators.points.shape[0]

    @property
    def tessellation(self) -> Tessellation | None:
        """The present diagram; None before the first `update`."""
        return self._data.tessellation

    @tessellation.setter
    def tessellation(self, t: Tessellation | None) -> None:
        self._data.tessellation = t

    @property
    def t(self) -> Tessellation:
        """The present diagram."""
        assert self._data.tessellation is not None
        return self._data.tessellation

    @property
    def multipliers(self) -> cla.Array | None:
        """Solution of the last volume projection, if there is one."""
        return self._data.multipliers

    @multipliers.setter
    def multipliers(self, array: cla.Array) -> None:
        self._data.multipliers = array

    @property
    def moving(self) -> Moving:
        """The generators, to be moved."""
        return Moving(self.points, self.velocity, self.labels, self.fixed)

    def allocate_step(self) -> None:
        """Allocate the displacements, to the end of the workspace's frame."""
        self.lloyd, self.correction = (self.engine.scratch(self.points.shape) for _ in range(2))

    def allocate_source(self) -> None:
        """Allocate the right side of a Poisson equation."""
        self.source = self.engine.scratch(self.n)

    def summarize_displacements(self) -> None:
        """Summarize the lengths of both displacements over h."""
        self.summaries.collect_lengths(("lloyd", "correction"), self.lloyd, self.correction, self.h)

    def ordered(self, array: cla.Array) -> np.ndarray:
        """Return `array` (n, ...) on the host in the order of labels."""
        # The labels are a new array whenever the order changes.
        if self._ordered is not self.labels:
            self._order, self._ordered = order_of(self.labels.get()), self.labels
        return np.take(array.get(), self._order, axis=0)

    def to_host(self, array: cla.Array, factor: float = 1.0) -> np.ndarray:
        """Return `array` (n, ...) on the host in the order of labels, times `factor`."""
        return np.multiply(self.ordered(array), factor, dtype=np.float64)
