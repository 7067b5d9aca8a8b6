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
from numpy.typing import DTypeLike

from . import memory_limits
from .device_array import make_array

Method = TypeVar("Method", bound=Callable[..., Any])
MOST_VIEWS = 1000
"""Largest number of arrays that are kept. Sizes, such as the number of faces, change from step to step."""
SLACK = 1.05
"""The pool may be larger by this factor than the most that all arrays have needed together. Each time a buffer is freed
for that, the factor grows by itself: otherwise two needs that alternate would free and allocate in every step."""
LOOSEST, SMALL = 4, 4096
"""Largest size of a buffer over that of its array; bytes that a buffer may have in any case."""
KEPT = 1 << 19
"""Bytes up to which memory is kept that is not needed for a while. To allocate it again takes as long as a step of a
small mesh."""
SPARE = 32
"""A new buffer has a 32nd more bytes than needed, because the next step may need a little more."""


def framed(method: Method) -> Method:
    """Decorate a method of a stage: it runs in a frame of its engine's workspace."""

    @wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self.engine.workspace.frame():
            return method(self, *args, **kwargs)

    return run  # type: ignore[return-value]


class _Taken:
    """A node of the tree of arrays. It is one array; its children are the arrays that have been taken right after it.

    - `view`: None at the root, before the first array.
    - `buffer`: number of its buffer.
    - `needed`: bytes of this array and of all that were taken before it and are in use.
    - `after`: the children, by shape and type.
    """

    __slots__ = ("after", "buffer", "needed", "view")

    def __init__(self, view: cla.Array | None, buffer: int, needed: int) -> None:
        self.view, self.buffer, self.needed = view, buffer, needed
        self.after: dict[tuple[object, object], _Taken] = {}


class Workspace:
    """Device arrays that are valid in a frame.

    An array lies in the smallest free buffer that is large enough, and not much too large. If there is none, one is
    allocated, and free ones are given up while there is more memory than arrays have needed at a time. So repeated
    steps soon allocate nothing. Each array begins at the start of its buffer: with several arrays in one buffer, as
    sub-buffers, NVIDIA's driver 580 crashes when they are released.

    Steps take arrays of the same sizes in the same order. So the choice of buffers is kept as a tree: if the same
    arrays are in use, the next one of the same shape is the same array.
    """

    def __init__(self, queue: cl.CommandQueue) -> None:
        self._queue = queue
        self._made = 0
        # For each open frame, how many nodes `_path` had when it began.
        self._frames: list[int] = []
        self.clear()

    def clear(self) -> None:
        """Free all memory, if no frame is open."""
        if self._frames:
            return
        # Size and number of each buffer, the smallest first, and the buffers by number.
        self._sizes: list[tuple[int, int]] = []
        self._buffers: dict[int, cl.Buffer] = {}
        # Arrays by number of the buffer, shape and type.
        self._views: dict[tuple[object, ...], cla.Array] = {}
        # The arrays in use, in the order in which they were taken, after the root.
        self._path = [_Taken(None, 0, 0)]
        self._nodes = 0
        self._most, self._slack = 0, SLACK

    def shrink(self) -> None:
        """Free all memory, if it is more than `KEPT` bytes and no frame is open."""
        if sum(size for size, _ in self._sizes) > KEPT:
            self.clear()

    def frame(self) -> Workspace:
        """Return a context manager; at its end all arrays taken inside are given back."""
        return self

    def __enter__(self) -> None:
        if not self._frames and max(self._nodes, len(self._views)) > MOST_VIEWS:
            self._forget()
            self._views = {}
        self._frames.append(len(self._path))

    def __exit__(self, *_: object) -> None:
        self._most = max(self._most, self._path[-1].needed)
        del self._path[self._frames.pop() :]

    def take(self, shape: int | tuple[int, ...], dtype: DTypeLike) -> cla.Array | None:
        """Return an array with arbitrary content, valid to the end of the frame; None if no frame is open."""
        if not self._frames:
            return None
        node = self._path[-1].after.get((shape, dtype)) or self._choose(shape, dtype)
        self._path.append(node)
        return node.view

    def _choose(self, shape: int | tuple[int, ...], dtype: DTypeLike) -> _Taken:
        """Return a new child of the last node, for an array that was never taken next to the present ones."""
        real, last = np.dtype(dtype), self._path[-1]
        items = math.prod(shape) if isinstance(shape, tuple) else int(shape)
        size = max(items * real.itemsize, 1)
        used = {node.buffer for node in self._path}
        place = bisect_left(self._sizes, (size, 0))
        fitting = (number for _, number in self._sizes[place:] if number not in used)
        number = next(fitting, None)
        if number is None or self._buffers[number].size > max(LOOSEST * size, SMALL):
            number = self._allocate(size, used)
        key = number, shape, real
        if key not in self._views:
            # The array is kept, because creating one takes as long as a launch.
            self._views[key] = make_array(self._queue, shape, real, self._buffers[number])
        node = last.after[shape, dtype] = _Taken(self._views[key], number, last.needed + size)
        self._nodes += 1
        return node

    def _forget(self) -> None:
        """Forget the choice of buffers, except for arrays in use."""
        self._nodes = 0
        for node in self._path:
            node.after = {}

    def _allocate(self, size: int, used: set[int]) -> int:
        """Make a buffer of at least `size` bytes, with those called `used` in use; return its number."""
        device = self._queue.device
        most = max(self._most, self._path[-1].needed + size)
        held = sum(size for size, _ in self._sizes)
        free = [entry for entry in self._sizes if entry[1] not in used]
        while free and held + size > self._slack * most:
            freed, old = free.pop()
            held -= freed
            self._sizes.remove((freed, old))
            del self._buffers[old]
            self._views = {key: view for key, view in self._views.items() if key[0] != old}
            self._forget()
            self._slack *= SLACK
        size = max(size, min(size + size // SPARE, memory_limits.largest_allocation(device)))
        self._made += 1
        self._buffers[self._made] = memory_limits.new_buffer(self._queue, size)
        insort(self._sizes, (size, self._made))
        return self._made
