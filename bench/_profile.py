"""Where the time goes: every kernel's own time, from the device's events."""

from __future__ import annotations

import re
from collections import Counter

import pyopencl as cl

import clvoro

SOLVERS = ("poisson", "multigrid", "coarsening", "krylov", "projection")
"""Programs that solve linear systems."""
TESSELLATION = ("bins", "cells", "primitives")
"""Programs of the diagram; the scans and the reductions of the figures are in "primitives"."""
PENDING = 4000


class Profile:
    """While open, time every kernel that is enqueued on a queue with profiling.

    Attributes
    ----------
    seconds : Counter
        Device time per (program, kernel); complete once closed.
    launches : int
    """

    def __init__(self) -> None:
        self.seconds: Counter[tuple[str, str]] = Counter()
        self.launches = 0
        self._events: list[tuple[tuple[str, str], cl.Event]] = []
        self._kernels: dict[int, tuple[cl.Kernel, tuple[str, str]]] = {}

    def __enter__(self) -> Profile:
        self._enqueue = cl.enqueue_nd_range_kernel
        cl.enqueue_nd_range_kernel = self._enqueue_timed
        return self

    def __exit__(self, *_: object) -> None:
        cl.enqueue_nd_range_kernel = self._enqueue
        self._collect()

    def _enqueue_timed(self, queue: cl.CommandQueue, kernel: cl.Kernel, *args, **options):
        event = self._enqueue(queue, kernel, *args, **options)
        self._events.append((self._key(kernel), event))
        if len(self._events) > PENDING:
            self._collect()
        return event

    def _key(self, kernel: cl.Kernel) -> tuple[str, str]:
        """Name of the file that `kernel` is from (the first its text refers to), and its own."""
        known = self._kernels.get(kernel.int_ptr)
        if known is None:
            source = kernel.get_info(cl.kernel_info.PROGRAM).get_info(cl.program_info.SOURCE)
            found = re.search(r'#line 1 "(\w+)\.cl"', source)
            # The kernel is kept, so that no other one takes its place in memory.
            known = (kernel, (found[1] if found else "other", kernel.function_name))
            self._kernels[kernel.int_ptr] = known
        return known[1]

    def _collect(self) -> None:
        if self._events:
            self._events[-1][1].wait()
        for key, event in self._events:
            event.wait()
            self.seconds[key] += 1e-9 * (event.profile.end - event.profile.start)
        self.launches += len(self._events)
        self._events.clear()

    def of(self, *programs: str) -> float:
        """Return the device time of these programs' kernels."""
        return sum(t for (program, _), t in self.seconds.items() if program in programs)

    def total(self) -> float:
        """Return the device time of all kernels."""
        return sum(self.seconds.values())


def profiled_queue(ctx: cl.Context) -> cl.CommandQueue:
    """Return a queue whose events know their times."""
    return cl.CommandQueue(ctx, properties=cl.command_queue_properties.PROFILING_ENABLE)


def profiled_adapter(adapter: clvoro.Adapter) -> clvoro.Adapter:
    """Return another adapter on the same context, whose queue has profiling enabled."""
    made = clvoro.Adapter(adapter.ctx, dtype=adapter.dtype)
    made.queue = profiled_queue(adapter.ctx)
    return made
