"""Repeated launches of block-wise kernels."""

from __future__ import annotations

from typing import NamedTuple

import pyopencl as cl

from .engine import Engine
from .kernels import bind


class CostFactors(NamedTuple):
    """Costs on a device, relative to PoCL on two cores."""

    launches: float
    """Of a launch, or of a read of some numbers by the host."""
    cells: float
    """Of a pass over the cells and their faces, which moves memory."""


COSTS_ON_CPU = CostFactors(1.0, 1.0)
COSTS_ON_GPU = CostFactors(0.4, 0.02)
"""Estimates: launches of 5 us, and memory at 1000 GB/s."""
COSTS_ON_SHARED_MEMORY = CostFactors(0.4, 0.4)
"""Those of a GPU that uses the memory of the host."""


def cost_factors(device: cl.Device) -> CostFactors:
    """Return the costs on `device` by its kind. They are not measured: a choice must not change from run to run."""
    if device.type & cl.device_type.CPU:
        return COSTS_ON_CPU
    return COSTS_ON_SHARED_MEMORY if device.host_unified_memory else COSTS_ON_GPU


def one_group_limit(engine: Engine) -> int:
    """Return the number of unknowns up to which one work-group iterates faster than many.

    On a CPU the launches of an iteration take some 20 us. In this time a core does 500 unknowns.
    """
    return 2000 if engine.group_size == 1 else 4 * engine.group_size


class Launch:
    """A block-wise kernel with its arguments set. A call only enqueues it.

    - `*args`: arguments of the kernel.
    - `groups`: number of work-groups, by default the engine's.
    """

    def __init__(self, engine: Engine, kernel: cl.Kernel, *args: object, groups: int | None = None) -> None:
        self._args, self._kernel = args, kernel
        self._bind()
        self._queue = engine.queue
        group = engine.block_of(kernel)
        self._size = ((engine.groups if groups is None else groups) * group,)
        self._group = (group,)

    def _bind(self) -> None:
        bind(self._kernel, self._args)
        self._key = self._kernel.bound  # type: ignore[attr-defined]

    def __call__(self) -> None:
        """Enqueue the kernel. Its arguments are set again if it has been used elsewhere meanwhile."""
        if self._kernel.bound is not self._key:  # type: ignore[attr-defined]
            self._bind()
        cl.enqueue_nd_range_kernel(self._queue, self._kernel, self._size, self._group)
