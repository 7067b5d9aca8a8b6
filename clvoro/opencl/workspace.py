"""Device memory that stages use in turn.

Much of what a stage works on is of no use to anybody once it is done: lists of candidate faces, the vectors of a linear
solve, the marks of insertions. Such arrays are taken from one stretch of memory for the time of a frame,

    with engine.workspace.frame():
        marks = engine.scratch(n, np.int32)

or by a method that is `framed`, as local variables are from the stack of a program: frames nest, and at the end of one
all that was taken within it is given back, to be taken by the next. The queue is in order, so that commands which still
use it are done by then.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from .device_array import make_array

Method = TypeVar("Method", bound=Callable[..., Any])
MOST_VIEWS = 1000
"""Arrays that are kept to be taken again; numbers of faces, say, change from step to step."""


def framed(method: Method) -> Method:
    """Have a stage's method run within a frame of its engine's workspace."""

    @wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self.engine.workspace.frame():
            return method(self, *args, **kwargs)

    return run  # type: ignore[return-value]


class Workspace:
    """A stack of device arrays.

    The memory grows while a frame needs more than any before and is then kept, in one piece: what is repeated step by
    step allocates nothing.

    Parameters
    ----------
    queue : pyopencl.CommandQueue
    """

    def __init__(self, queue: cl.CommandQueue) -> None:
        self._queue = queue
        # Sub-buffers have to begin at multiples of this; a cache line at least keeps arrays apart.
        self._unit = max(64, queue.device.mem_base_addr_align // 8)
        # Per frame that is open, what was taken of each piece when it began.
        self._before: list[list[int]] = []
        self.clear()

    def clear(self) -> None:
        """Let go of all memory, outside of any frame; within one, nothing is done."""
        if self._before:
            return
        # Each piece is taken from its beginning on; so many bytes of it are.
        self._pieces: list[cl.Buffer] = []
        self._taken: list[int] = []
        self._views: dict[tuple[object, ...], tuple[cla.Array, int]] = {}
        self._most = 0

    def frame(self) -> Workspace:
        """Return what, at the end of a ``with``, gives back all that is taken meanwhile."""
        return self

    def __enter__(self) -> None:
        if not self._before and len(self._pieces) > 1:
            # One piece in the place of those that it took to find out how much is needed.
            self._pieces, self._taken, self._views = [], [], {}
            self._add(self._most)
        if not self._before and len(self._views) > MOST_VIEWS:
            self._views = {}
        self._before.append(self._taken.copy())

    def __exit__(self, *_: object) -> None:
        before = self._before.pop()
        self._taken[:] = before + [0] * (len(self._pieces) - len(before))

    def take(self, shape: int | tuple[int, ...], dtype: np.dtype) -> cla.Array | None:
        """Return an array whose content is arbitrary, valid to the end of the frame; None outside of any."""
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
            # Kept with its end, as to make one costs as much as a launch.
            view = self._pieces[number].get_sub_region(start, size)
            self._views[key] = make_array(self._queue, shape, dtype, view), start + size
        array, self._taken[number] = self._views[key]
        self._most = max(self._most, sum(self._taken))
        return array

    def _add(self, size: int) -> None:
        self._pieces.append(cl.Buffer(self._queue.context, cl.mem_flags.READ_WRITE, size))
        self._taken.append(0)
