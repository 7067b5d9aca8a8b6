"""Contiguous PyOpenCL arrays on one in-order queue.

A run makes thousands of arrays and views. PyOpenCL's may have any strides and queue: it checks them and keeps events.
Here neither is needed. Making an array takes a tenth of the time.
"""

from __future__ import annotations

import inspect
import math
from functools import cached_property
from itertools import count
from typing import Any, cast

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from .memory_limits import new_buffer

_ATTRIBUTES = {
    "queue",
    "context",
    "shape",
    "dtype",
    "strides",
    "events",
    "nbytes",
    "size",
    "allocator",
    "base_data",
    "offset",
    "_flags",
}
"""What PyOpenCL's constructor sets."""


def _is_known() -> bool:
    """Return whether an array of this PyOpenCL has the attributes that `make_array` sets, and no others."""
    if "_fast" not in inspect.signature(cla.Array.__init__).parameters:
        return False
    kind = np.dtype(np.int8)
    plain = cla.Array(None, (1,), kind, data=0, strides=(1,), _fast=True, _size=1)
    return set(vars(plain)) == _ATTRIBUTES


_QUICK = _is_known()
"""Whether arrays are made without PyOpenCL's constructor, which takes most of the time."""
_PATTERN = 64
"""Largest pattern in bytes to fill memory with; long patterns are faster."""
_ZEROS = np.zeros(_PATTERN, np.uint8)
_LARGEST_FILL = 2**31
"""Bytes from which NVIDIA's fill fails; PyOpenCL's kernel is used instead."""
_marks = count()


class DeviceArray(cla.Array):
    """A contiguous array on an in-order queue; see `make_array`."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.mark = next(_marks)

    mark: int
    """Unique number of this array. Views of its first rows have the same number, and no other array ever has it.

    An address does not identify an array, because freed memory is used again.
    """

    @cached_property
    def context(self) -> cl.Context:  # type: ignore[override]
        """The context of the queue."""
        assert self.queue is not None
        return self.queue.context

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.shape[0] if self.shape else super().__len__()

    def _place(self) -> tuple[cl.CommandQueue, cl.Buffer]:
        """Return queue and buffer of an array that is not empty."""
        return cast("tuple[cl.CommandQueue, cl.Buffer]", (self.queue, self.base_data))

    def __getitem__(self, index: Any) -> cla.Array:
        """Return a view; ``[:n]`` and ``[i]`` are fast."""
        if not self.size:
            return super().__getitem__(index)
        if type(index) is slice and index.start is None and index.step is None:
            if type(index.stop) is int and 0 <= index.stop <= self.shape[0]:
                shape, (queue, buffer) = (index.stop, *self.shape[1:]), self._place()
                view = make_array(queue, shape, self.dtype, buffer, self.offset)
                view.mark = self.mark
                return view
        elif isinstance(index, int) and len(self.shape) == 1 and 0 <= index < self.shape[0]:
            offset, (queue, buffer) = self.offset + index * self.dtype.itemsize, self._place()
            return make_array(queue, (), self.dtype, buffer, offset)
        return super().__getitem__(index)

    def reshape(self, *shape: int, **kwargs: Any) -> cla.Array:
        """Return a view of another shape; fast for lengths that are given one by one."""
        if kwargs or not self.size or not all(type(n) is int for n in shape) or math.prod(shape) != self.size:
            return super().reshape(*shape, **kwargs)
        queue, buffer = self._place()
        view = make_array(queue, shape, self.dtype, buffer, self.offset)
        view.mark = self.mark
        return view

    def get(self, queue: cl.CommandQueue | None = None, ary: np.ndarray | None = None) -> np.ndarray:
        """Fetch the content."""
        if queue is not None or ary is not None or not self.size:
            return super().get(queue, ary)
        host = np.empty(self.shape, self.dtype)
        queue, buffer = self._place()
        cl.enqueue_copy(queue, host, buffer, src_offset=self.offset)
        return host

    def set(self, ary: np.ndarray, *args: Any, **kwargs: Any) -> None:
        """Write `ary`, of the same shape and type."""
        fits = ary.dtype == self.dtype and ary.shape == self.shape and ary.flags.c_contiguous
        if args or kwargs or not fits:
            super().set(ary, *args, **kwargs)
        elif self.size:
            queue, buffer = self._place()
            cl.enqueue_copy(queue, buffer, ary, dst_offset=self.offset)

    def fill(self, value: object, *args: Any, **kwargs: Any) -> DeviceArray:
        """Set all to `value`; return the array."""
        if not self.size:
            return self
        if args or kwargs or self.nbytes >= _LARGEST_FILL:
            super().fill(value, *args, **kwargs)
            return self
        whole = self.offset | self.nbytes | _PATTERN
        most = whole & -whole
        count = most // self.dtype.itemsize
        pattern = np.full(count, value, self.dtype) if value else _ZEROS[:most]
        queue, buffer = self._place()
        cl.enqueue_fill(queue, buffer, pattern, self.nbytes, offset=self.offset)
        return self


def buffer_of(array: cla.Array) -> cl.Buffer:
    """Return the buffer of `array`, which must begin at the start of it."""
    return cast("cl.Buffer", array.data)


def read_number(array: cla.Array, index: int) -> Any:
    """Fetch one number of a 1D array, without the view that ``array[index].get()`` makes."""
    return read_numbers(array, index, 1).item()


def read_numbers(array: cla.Array, first: int, count: int) -> np.ndarray:
    """Fetch ``array[first : first + count]`` of a 1D array without a view, which takes as long as a launch."""
    if not 0 <= first <= first + count <= len(array):
        raise IndexError(f"items {first} to {first + count - 1} of an array of {len(array)}")
    host = np.empty(count, array.dtype)
    start = array.offset + first * array.dtype.itemsize
    queue, buffer = cast("cl.CommandQueue", array.queue), cast("cl.Buffer", array.base_data)
    cl.enqueue_copy(queue, host, buffer, src_offset=start)
    return host


def make_array(
    queue: cl.CommandQueue,
    shape: int | tuple[int, ...],
    dtype: np.dtype,
    data: cl.Buffer | None = None,
    offset: int = 0,
) -> DeviceArray:
    """Return an array of `shape` at byte `offset` of `data`, or in a new buffer with arbitrary content."""
    if type(shape) is not tuple:
        shape = (int(shape),)  # type: ignore[arg-type]
    size = math.prod(shape)
    bytes_ = size * dtype.itemsize
    if data is None and bytes_:
        data = new_buffer(queue, bytes_)
    if not _QUICK:
        return DeviceArray(queue, shape, dtype, data=data, offset=offset)
    strides, step = (), dtype.itemsize
    for length in reversed(shape):
        strides, step = (step, *strides), step * max(1, length)
    array = DeviceArray.__new__(DeviceArray)
    array.queue, array.base_data, array.offset = queue, data, offset
    array.shape, array.dtype, array.strides = shape, dtype, strides
    array.size, array.nbytes = size, bytes_
    array.events, array.allocator, array._flags, array.mark = [], None, None, next(_marks)
    return array
