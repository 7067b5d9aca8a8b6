"""A pool of device memory for temporary arrays.

Stages need temporary arrays: lists of candidate faces, the vectors of a linear solve. They take them from the workspace
for the time of a frame,

    with engine.workspace.frame():
        marks = engine.scratch(n, np.int32)

or in a method with the decorator `framed`. Frames nest. At the end of a frame its memory is free for other arrays.
Commands that still use it are done before, because the queue is in order.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from . import memory_limits
from .device_array import make_array

Method = TypeVar("Method", bound=Callable[..., Any])
MOST_VIEWS = 1000
"""Largest number of arrays that are kept. Sizes, such as the number of faces, change from step to step."""
SLACK = 1.05
"""The pool may be larger by this factor than the most that all arrays have needed together. Each time a buffer is freed
for that, the factor grows by itself: otherwise two needs that alternate would free and allocate in every step."""
LOOSEST, SMALL = 4, 4096
"""A buffer may have so many times the bytes of its array, or so many bytes in any case."""
SPARE = 32
"""A new buffer has a 32nd more bytes than needed, because the next step may need a little more."""


def framed(method: Method) -> Method:
    """Decorate a method of a stage: it runs in a frame of its engine's workspace."""

    @wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self.engine.workspace.frame():
            return method(self, *args, **kwargs)

    return run  # type: ignore[return-value]


class Workspace:
    """Device arrays that are valid in a frame.

    An array lies in the smallest free buffer that is large enough, and not much too large. If there is none, one is
    allocated, and free ones are given up while there is more memory than arrays have needed at a time. So repeated
    steps soon allocate nothing. Each array begins at the start of its buffer: with several arrays in one buffer, as
    sub-buffers, NVIDIA's driver 580 crashes when they are released.

    Parameters
    ----------
    queue : pyopencl.CommandQueue
    """

    def __init__(self, queue: cl.CommandQueue) -> None:
        self._queue = queue
        self._made = 0
        # For each open frame: size and number of each buffer that it has taken, and the bytes of all its arrays.
        self._frames: list[list[tuple[int, int]]] = []
        self._needed: list[int] = []
        self.clear()

    def clear(self) -> None:
        """Free all memory, if no frame is open."""
        if self._frames:
            return
        self._buffers: dict[int, cl.Buffer] = {}
        # The free ones by size and number, the smallest first.
        self._free: list[tuple[int, int]] = []
        # Arrays by number of the buffer, shape and type.
        self._views: dict[tuple[object, ...], cla.Array] = {}
        self._most, self._slack = 0, SLACK
        # Bytes of all buffers.
        self._held = 0

    def frame(self) -> Workspace:
        """Return a context manager; at its end all arrays taken inside are given back."""
        return self

    def __enter__(self) -> None:
        if not self._frames and len(self._views) > MOST_VIEWS:
            self._views = {}
        self._frames.append([])
        self._needed.append(0)

    def __exit__(self, *_: object) -> None:
        self._most = max(self._most, sum(self._needed))
        self._needed.pop()
        for taken in self._frames.pop():
            insort(self._free, taken)

    def take(self, shape: int | tuple[int, ...], dtype: np.dtype) -> cla.Array | None:
        """Return an array with arbitrary content, valid to the end of the frame; None if no frame is open."""
        if not self._frames:
            return None
        items = math.prod(shape) if isinstance(shape, tuple) else int(shape)
        size = items * dtype.itemsize or 1
        self._needed[-1] += size
        free = self._free
        place = bisect_left(free, (size, 0))
        fits = place < len(free) and free[place][0] <= max(LOOSEST * size, SMALL)
        taken = free.pop(place) if fits else self._allocate(size)
        self._frames[-1].append(taken)
        key = taken[1], shape, dtype
        view = self._views.get(key)
        if view is None:
            # The array is kept, because creating one takes as long as a launch.
            view = self._views[key] = make_array(self._queue, shape, dtype, self._buffers[taken[1]])
        return view

    def _allocate(self, size: int) -> tuple[int, int]:
        """Make a buffer of at least `size` bytes: return its size and number."""
        device = self._queue.device
        memory_limits.check_allocation(device, size)
        most = max(self._most, sum(self._needed))
        while self._free and self._held + size > self._slack * most:
            freed, old = self._free.pop()
            self._held -= freed
            del self._buffers[old]
            self._views = {key: view for key, view in self._views.items() if key[0] != old}
            self._slack *= SLACK
        size = max(size, min(size + size // SPARE, memory_limits.largest_allocation(device)))
        self._made += 1
        self._buffers[self._made] = cl.Buffer(self._queue.context, cl.mem_flags.READ_WRITE, size)
        self._held += size
        return size, self._made
