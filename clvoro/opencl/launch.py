"""Launches of block-wise kernels that are repeated, and who makes do with one work-group."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from .engine import Engine
from .kernels import bind, set_args, with_buffers


def most_alone(engine: Engine) -> int:
    """Return up to how many unknowns one work-group is through an iteration before others could be of help.

    On a CPU the launches of an iteration cost some 20 us, as much as a core takes for 500 unknowns; with two cores at
    work, half of the unknowns would be its own in any case.
    """
    return 2000 if engine.group_size == 1 else 4 * engine.group_size


class Launch:
    """A block-wise kernel with its arguments set: calling it costs no more than the enqueueing.

    It is enqueued over as many `groups`, by default the engine's. The kernel must not be used elsewhere meanwhile, as
    it has but one set of arguments.
    """

    def __init__(
        self, engine: Engine, kernel: cl.Kernel, *args: object, groups: int | None = None
    ) -> None:
        bind(kernel, args)
        self._args = args
        self._given: list[object] = []
        self._kernel = kernel
        self._queue = engine.queue
        self._size = ((engine.groups if groups is None else groups) * engine.group_size,)
        self._group = (engine.group_size,)

    def set_first(self, value: int) -> None:
        """Set the kernel's first argument, an int."""
        if not self._given:
            self._given = with_buffers(self._args)
        self._given[0] = np.int32(value)
        set_args(self._kernel, self._given)

    def __call__(self) -> None:
        """Enqueue the kernel."""
        cl.enqueue_nd_range_kernel(self._queue, self._kernel, self._size, self._group)
