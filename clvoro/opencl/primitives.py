"""Deterministic scans and reductions on the device.

Each is done by work-groups (see opencl/blocks.h): on CPUs groups of one work-item, on GPUs larger ones. PyOpenCL's scan
takes 3.4 ms for 10^6 integers on PoCL with two cores, and 1.7 s to compile. The kernels of `primitives.cl` take 0.5 ms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pyopencl.array as cla
from numpy.typing import DTypeLike

from .device_array import buffer_of, make_array
from .engine import Engine
from .workspace import KEPT

AT_ONCE = 8
"""Largest number of arrays that one launch summarizes."""
MOST_NOTES = 20
"""Largest number of integers that are read together with summaries."""
FEW = 8192
"""Up to this many numbers one work-group scans in the time of two launches."""


class Scan:
    """Exclusive prefix sums of int32 arrays."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("opencl/primitives")
        self._sums = engine.empty(engine.groups, np.int32)

    def exclusive(
        self, values: cla.Array, out: cla.Array, n: int, first: int = 0, total: tuple[cla.Array, int] | None = None
    ) -> None:
        """Write the n + 1 exclusive prefix sums of ``values[first : first + n]`` to ``out[: n + 1]``.

        `out` may be `values` if it has room and `first` is 0. The last sum is also written to ``array[place]`` if
        `total`, (array, place), is given.
        """
        k, engine, given = self._kernels, self.engine, (values, first, n)
        array, place = (out, n) if total is None else total
        to = self._sums, out, array, place
        if n <= FEW:
            engine.run_groups(k.scan_blocks, 1, *given, *to)
            return
        engine.run_blocks(k.sum_scan_blocks, *given, self._sums)
        engine.run_blocks(k.scan_blocks, *given, *to)


class Summary(NamedTuple):
    """Sum, sum of magnitudes, minimum and maximum of an array."""

    sum: float
    magnitude: float
    least: float
    largest: float

    @property
    def peak(self) -> float:
        """Largest magnitude."""
        return max(abs(self.least), abs(self.largest))


class Summaries:
    """Summaries of named arrays, kept on the device until `read` fetches all of them in one transfer.

    - `names`: one slot each; at most 31.
    """

    def __init__(self, engine: Engine, names: Sequence[str]) -> None:
        self.engine = engine
        self.slots = {name: slot for slot, name in enumerate(names)}
        self._kernels = engine.kernels("opencl/primitives")
        self._partials = engine.empty(6 * engine.groups * len(names))
        self._slots_of: dict[tuple[str, ...], tuple[np.ndarray, int]] = {}
        self._pending = 0
        self._known: dict[str, Summary] | None = None
        # Integers follow the summaries; the host reads them in the same transfer.
        size = 4 * len(names) * engine.real.itemsize
        self._record = engine.zeros(size + MOST_NOTES * np.dtype(np.int32).itemsize, np.uint8)
        shape = (len(names), 4)
        self._values = make_array(engine.queue, shape, engine.real, buffer_of(self._record))

    def collect(self, name: str, array: cla.Array, n: int) -> None:
        """Summarize the first `n` of `array` into the slot `name`."""
        self.collect_all({name: array}, n)

    def collect_all(self, arrays: Mapping[str, cla.Array], n: int, unit: cla.Array | None = None) -> None:
        """Summarize the first `n` of each array into the slot of its name; at most `AT_ONCE` arrays.

        With `unit` (n,) the arrays are vectors (n, d), of which the lengths over `unit` are summarized.
        """
        given, names = list(arrays.values()), tuple(arrays)
        spare = given[:1] * (AT_ONCE - len(given))
        if names not in self._slots_of:
            slots = [self.slots[name] for name in names]
            vector = np.array(slots + [0] * len(spare), np.int32)
            self._slots_of[names] = vector, sum(1 << slot for slot in slots)
        slots, which = self._slots_of[names]
        lengths = (0, given[0]) if unit is None else (1, unit)
        summarize = self._kernels.summarize_blocks
        self.engine.run_blocks(summarize, *given, *spare, len(given), n, slots, self._partials, *lengths)
        self._pending, self._known = self._pending | which, None

    @property
    def values(self) -> cla.Array:
        """The device array of summaries: for each name the sum, the sum of magnitudes, minimum and maximum."""
        if self._pending:
            self._combine()
        self._known = None
        return self._values

    def _combine(self, *notes: cla.Array) -> None:
        """Combine the partial summaries. The record also gets at most two int32 arrays, so that one read has all."""
        counts, arrays = [*map(len, notes), 0, 0], [*notes, self._record, self._record]
        sums = counts[0], arrays[0], counts[1], arrays[1]
        self.engine.run_groups(
            self._kernels.combine_blocks,
            len(self.slots),
            self._partials,
            self.engine.groups,
            self._pending,
            *sums,
            self._values,
            self._record,
        )
        if self.engine.peers.count > 1:
            self._combine_parts([slot for slot in range(len(self.slots)) if self._pending >> slot & 1])
        self._pending = 0

    def _combine_parts(self, slots: list[int]) -> None:
        """Replace these summaries by those of all parts."""
        values = self._values.get()
        found = np.stack(self.engine.peers.gather(values[slots]))
        values[slots, :2] = found[..., :2].sum(axis=0)
        values[slots, 2], values[slots, 3] = found[..., 2].min(axis=0), found[..., 3].max(axis=0)
        self._values.set(values)

    def read_one(self, name: str) -> Summary:
        """Return the summary with this name."""
        if self._known is not None:
            return self._known[name]
        slot = self.slots[name]
        return Summary(*map(float, self.values[slot : slot + 1].get()[0]))

    def read(self) -> dict[str, Summary]:
        """Return all summaries. They are read in one transfer, and kept until something is collected."""
        if self._known is None:
            self.read_with()
        return self._known or {}

    def read_with(self, *notes: cla.Array) -> list[int]:
        """Read all summaries, for `read`, and at most two int32 arrays in one transfer; return these numbers."""
        if self._pending or notes:
            self._combine(*notes)
        size, count = self._values.nbytes, sum(map(len, notes))
        host = self._record.get()
        rows = host[:size].view(self.engine.real).reshape(-1, 4).tolist()
        self._known = {name: Summary._make(rows[slot]) for name, slot in self.slots.items()}
        return host[size:].view(np.int32)[:count].tolist()


class Gather:
    """Reorder the rows of arrays of any type."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("opencl/primitives")

    def rows(self, items: cla.Array, array: cla.Array, out: cla.Array | None = None) -> cla.Array:
        """Return an array, `out` or a new one, whose row p is ``array[items[p]]``."""
        size = len(items)
        out = self.engine.empty((size, *array.shape[1:]), array.dtype) if out is None else out
        self.engine.run_each(self._kernels.gather_rows, size, items, array, _words_of(array), out)
        return out

    def lists(self, lists: Lists, array: cla.Array, names: cla.Array | None = None) -> cla.Array:
        """Return a new array of the same shape with the lists of rows of `array` in another order.

        With `names` the array is int32, and a number i that is not negative becomes ``names[i]``.
        """
        out = self.engine.empty(array.shape, array.dtype)
        if not len(array):
            return out
        size, given = len(lists.order), (lists.order, lists.starts, lists.to, array)
        if names is None:
            self.engine.run_each(self._kernels.gather_lists, size, *given, _words_of(array), out)
        else:
            self.engine.run_each(self._kernels.gather_renamed_lists, size, *given, names, out)
        return out


class Lists(NamedTuple):
    """Device arrays that say how lists of rows, which follow one another in an array, change places."""

    order: cla.Array
    """(n,) int32. Present place of each list in the new order."""
    starts: cla.Array
    """(n + 1,) int32. Where the present lists begin."""
    to: cla.Array
    """(n or more,) int32. Where the lists begin in the new order."""


def _words_of(array: cla.Array) -> np.int32:
    """Return the number of 32-bit words of a row."""
    return np.int32(math.prod(array.shape[1:]) * array.dtype.itemsize // 4)


class NamedArrays:
    """Device arrays by name, which are kept and grow when needed.

    - `spare`: additional room of a new array, as a share of its size.
    """

    def __init__(self, engine: Engine, spare: float = 0.0) -> None:
        self._engine, self._spare = engine, spare
        self._arrays: dict[tuple, cla.Array] = {}
        # The last view of each, because creating a view takes as long as a launch.
        self._parts: dict[tuple, cla.Array] = {}

    def __call__(self, *name: object, size: int, dtype: DTypeLike | None = None) -> cla.Array:
        """Return the first `size` items of the array called `name`; their content is arbitrary."""
        array = self._arrays.get(name)
        if array is None or array.shape[0] < size:
            room = max(size + int(self._spare * size), 1)
            # The old array is freed first.
            array = None
            self._arrays.pop(name, None)
            self._parts.pop(name, None)
            array = self._arrays[name] = self._engine.empty(room, dtype)
        part = self._parts.get(name)
        if part is None or part.shape[0] != size:
            part = self._parts[name] = array[:size]
        return part

    def clear(self, *names: object) -> None:
        """Free all arrays, or those whose names begin with one of `names`, if there are more than `KEPT` bytes."""
        if sum(array.nbytes for array in self._arrays.values()) <= KEPT:
            return
        gone = [n for n in self._arrays if not names or n[0] in names]
        for name in gone:
            del self._arrays[name]
            self._parts.pop(name, None)

    def zeros(self, *name: object, size: int, dtype: DTypeLike | None = None) -> cla.Array:
        """Return the same array filled with zeros."""
        return self(*name, size=size, dtype=dtype).fill(0)
