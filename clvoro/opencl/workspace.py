"""A stack of device memory for temporary arrays.

Stages need temporary arrays: lists of candidate faces, the vectors of a linear solve. They take them from the workspace
for the time of a frame,

    with engine.workspace.frame():
        marks = engine.scratch(n, np.int32)

or in a method with the decorator `framed`. Frames nest. At the end of a frame its memory is free for other arrays.
Commands that still use it are done before, because the queue is in order.
"""

from __future__ import annotations

import math
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


def framed(method: Method) -> Method:
    """Decorate a method of a stage: it runs in a frame of its engine's workspace."""

    @wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self.engine.workspace.frame():
            return method(self, *args, **kwargs)

    return run  # type: ignore[return-value]


class Workspace:
    """A stack of device arrays.

    The memory grows when a frame needs more than all before, and is kept in one piece, unless this is larger than the
    device's largest buffer. So repeated steps allocate nothing.

    Parameters
    ----------
    queue : pyopencl.CommandQueue
    """

    def __init__(self, queue: cl.CommandQueue) -> None:
        self._queue = queue
        # Sub-buffers must begin at multiples of this. No two arrays share a cache line.
        self._unit = max(64, queue.device.mem_base_addr_align // 8)
        self._limit = memory_limits.largest_allocation(queue.device)
        # For each open frame, the bytes in use of each piece when it began.
        self._before: list[list[int]] = []
        self.clear()

    def clear(self) -> None:
        """Free all memory, if no frame is open."""
        if self._before:
            return
        # The pieces, and the bytes in use from the start of each.
        self._pieces: list[cl.Buffer] = []
        self._taken: list[int] = []
        self._views: dict[tuple[object, ...], tuple[cla.Array, int]] = {}
        self._most = 0

    def frame(self) -> Workspace:
        """Return a context manager; at its end all arrays taken inside are given back."""
        return self

    def __enter__(self) -> None:
        if not self._before and len(self._pieces) > 1 and self._most <= self._limit:
            # The size is known now: one piece replaces the others.
            self._pieces, self._taken, self._views = [], [], {}
            self._add(self._most)
        if not self._before and len(self._views) > MOST_VIEWS:
            self._views = {}
        self._before.append(self._taken.copy())

    def __exit__(self, *_: object) -> None:
        before = self._before.pop()
        self._taken[:] = before + [0] * (len(self._pieces) - len(before))

    def take(self, shape: int | tuple[int, ...], dtype: np.dtype) -> cla.Array | None:
        """Return an array with arbitrary content, valid to the end of the frame; None if no frame is open."""
        if not self._before:
            return None
        if len(self._taken) == 1:
            known = self._views.get((0, self._taken[0], shape, dtype))
            if known is not None:
                view, self._taken[0] = known
                return view
        items = math.prod(shape) if isinstance(shape, tuple) else int(shape)
        size = max(items * dtype.itemsize, 1)
        size = -(-size // self._unit) * self._unit
        number = 0
        while number < len(self._pieces) and self._taken[number] + size > self._pieces[number].size:
            number += 1
        if number == len(self._pieces):
            self._add(size)
        start = self._taken[number]
        key = number, start, shape, dtype
        if key not in self._views:
            # The view is kept, because creating one takes as long as a launch.
            view = self._pieces[number].get_sub_region(start, size)
            self._views[key] = make_array(self._queue, shape, dtype, view), start + size
        array, self._taken[number] = self._views[key]
        self._most = max(self._most, sum(self._taken))
        return array

    def _add(self, size: int) -> None:
        memory_limits.check_allocation(self._queue.device, size)
        self._pieces.append(cl.Buffer(self._queue.context, cl.mem_flags.READ_WRITE, size))
        self._taken.append(0)
