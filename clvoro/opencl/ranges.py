"""Long launches in ranges of work-items.

A desktop system ends kernels that run for seconds on a GPU, because its display waits for them. So a kernel of many
work-items is launched for one range of them after the other. The time of a range tells how many items the next may
have.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import pyopencl as cl

FIRST = 1 << 16
"""Work-items of a kernel's first range. Launches of no more are not divided."""
LONGEST = 0.2
"""Seconds that a range may take by the rate of the last one. Systems allow two or more; items may differ."""
GROWTH = 8
"""Largest ratio of the sizes of a range and the last one. A kernel's first launch may include its compilation."""


def may_be_interrupted(device: cl.Device) -> bool:
    """Return whether a system may end long kernels on `device`: on GPUs, as far as one can know."""
    return device.type & (cl.device_type.GPU | cl.device_type.CPU) == cl.device_type.GPU


@dataclass
class Range:
    """The size of a kernel's next range, shared by all objects of the kernel."""

    items: float = FIRST
    known: bool = False
    """Whether a range has been timed."""

    def learn(self, size: int, seconds: float) -> None:
        """Set the size by the time of a range of `size` items."""
        self.items = min(size * LONGEST / max(seconds, 1e-9), GROWTH * size)
        self.known = True


def enqueue_ranges(queue: cl.CommandQueue, kernel: cl.Kernel, items: int, group: int, limit: Range) -> cl.Event:
    """Enqueue `kernel` over `items` work-items, whole work-groups of `group`, in ranges within `limit`."""
    begin = 0
    while True:
        size = min(items - begin, max(int(limit.items) // group, 1) * group)
        if size == items and (limit.known or items <= FIRST):
            return cl.enqueue_nd_range_kernel(queue, kernel, (items,), (group,))
        queue.finish()
        start = time.perf_counter()
        event = cl.enqueue_nd_range_kernel(queue, kernel, (size,), (group,), (begin,))
        queue.finish()
        limit.learn(size, time.perf_counter() - start)
        begin += size
        if begin == items:
            return event
