"""Kernels of built programs, and the setting of their arguments."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..errors import BuildError
from .device_array import DeviceArray
from .program import source_text
from .ranges import Range
from .runtimes import cache_remedy


def group_limit(kernel: cl.Kernel) -> int:
    """Return the largest work-group that `kernel` can be launched in, which depends on the registers that it needs."""
    device = kernel.context.devices[0]
    return kernel.get_work_group_info(cl.kernel_work_group_info.WORK_GROUP_SIZE, device)


def power_of_two(limit: int) -> int:
    """Return the largest power of two that is not larger than `limit`."""
    return 1 << (max(limit, 1).bit_length() - 1)


def fit_group(kernel: cl.Kernel, group: int) -> int:
    """Return `group`, or the largest power of two that `kernel` can be launched in if that is smaller."""
    try:
        limit = kernel.limit  # type: ignore[attr-defined]
    except AttributeError:
        limit = kernel.limit = group_limit(kernel)  # type: ignore[attr-defined]
    return group if group <= limit else power_of_two(limit)


def range_of(kernel: cl.Kernel) -> Range:
    """Return the size of ranges in which `kernel` is launched; see `ranges`."""
    if not hasattr(kernel, "range"):
        kernel.range = Range()  # type: ignore[attr-defined]
    return kernel.range  # type: ignore[attr-defined]


class KernelPool:
    """Kernel objects that are used again.

    Creating a kernel object and setting its arguments takes as long as ten launches. Stages are made for each run, and
    take their kernels from here. Two stages never share one, because a kernel holds its arguments.
    """

    def __init__(self) -> None:
        self._free: dict[tuple[int, str], list[cl.Kernel]] = {}
        self._taken: list[tuple[tuple[int, str], cl.Kernel]] = []
        self._ranges: dict[tuple[int, str], Range] = {}
        self.users: weakref.WeakValueDictionary[int, Kernels] = weakref.WeakValueDictionary()
        self.optimized = 0
        """How many of the optimizations that have ended its kernels are from; see `prebuild.renew`."""
        self.on_kernel: Callable[[int], object] | None = None
        """Called with the number of kernels that have been taken, when there is a new one."""
        self.on_work: Callable[[str], object] | None = None
        """Called with the name of each part of long work on the host."""

    def take(self, program: cl.Program, name: str) -> cl.Kernel:
        """Return a kernel that is not in use."""
        key = program.int_ptr, name
        if key not in self._free:
            self._free[key] = []
            if self.on_kernel is not None:
                self.on_kernel(len(self._free))
        free = self._free[key]
        kernel = free.pop() if free else cl.Kernel(program, name)
        if not hasattr(kernel, "range"):
            kernel.range = self._ranges.setdefault(key, Range())  # type: ignore[attr-defined]
        self._taken.append((key, kernel))
        return kernel

    def release(self) -> None:
        """Return all kernels to the pool. Callers that hold one must set its arguments again."""
        for key, kernel in self._taken:
            self._free[key].append(kernel)
        self._taken.clear()

    def renew(self) -> None:
        """Drop the kernels in use: each is taken from a program that is built again when it is next used."""
        for kernels in list(self.users.values()):
            kernels.forget()


class Kernels(SimpleNamespace):
    """The kernels of a program as attributes. The program is built when the first of them is used.

    Each kernel keeps its own arguments. Its attribute `stage` is the name of the program, for profiles, and `block` the
    number of work-items per group for which it has been built (GROUP_SIZE, see opencl/blocks.h).

    - `build`: builds the program for a number of work-items per group.
    - `stage`: name of the program.
    - `group_size`: work-items per group of block-wise kernels. For a kernel that cannot be launched in such groups, the
      program is built again for smaller ones.
    """

    def __init__(self, build: Callable[[int], cl.Program], stage: str, pool: KernelPool, group_size: int = 1) -> None:
        super().__init__(_build=build, _stage=stage, _pool=pool, _group_size=group_size)
        pool.users[id(self)] = self

    def __getattr__(self, name: str) -> cl.Kernel:
        if name.startswith("_"):
            raise AttributeError(name)
        size = self._group_size
        kernel = self._take(name, size)
        while fit_group(kernel, size) < size and "GROUP_SIZE" in source_text(f"{self._stage}.cl"):
            size = fit_group(kernel, size)
            kernel = self._take(name, size)
        kernel.block = size  # type: ignore[attr-defined]
        kernel.stage = self._stage.rpartition("/")[2]  # type: ignore[attr-defined]
        setattr(self, name, kernel)
        return kernel

    def forget(self) -> None:
        """Drop all kernels: the next use of each calls `build` again."""
        for name in [name for name in vars(self) if not name.startswith("_")]:
            delattr(self, name)

    def _take(self, name: str, size: int) -> cl.Kernel:
        """Return a kernel of the program for groups of `size`."""
        program = self._build(size)
        try:
            return self._pool.take(program, name)
        except cl.LogicError as error:
            if f"void {name}(" in source_text(f"{self._stage}.cl"):
                raise BuildError(
                    f"cl_kernels/{self._stage}.cl was built without its kernel {name}. {cache_remedy()}"
                ) from error
            raise AttributeError(f"cl_kernels/{self._stage}.cl has no kernel {name}") from error


def bind(kernel: cl.Kernel, args: Sequence[object]) -> None:
    """Set those arguments of `kernel` that have changed. Arrays are passed as their buffers, a Python int as an int.

    From step to step most arguments are the same. To compare them takes less time than to set them. In all calls an
    argument must have the same type.
    """
    before = getattr(kernel, "bound", None)
    # The same as `comparison_key`, without a call.
    key = [a.mark if type(a) is DeviceArray else a if type(a) is int else _key_of(a) for a in args]
    if key == before:
        return
    changed: Sequence[int] = range(len(args))
    if before is not None and len(before) == len(key):
        pairs = enumerate(zip(key, before, strict=True))
        changed = [k for k, (new, old) in pairs if new is not old and new != old]
    elif len(args) != kernel.num_args:
        raise TypeError(f"{kernel.function_name} got {len(args)} arguments, expected {kernel.num_args}")
    kernel.bound = None  # type: ignore[attr-defined]
    set_changed(kernel, args, changed)
    kernel.bound = key  # type: ignore[attr-defined]


def comparison_key(args: Sequence[object]) -> list[object]:
    """Return a key that is equal for equal arguments only. It does not keep the arrays in memory."""
    return [a.mark if type(a) is DeviceArray else a if type(a) is int else _key_of(a) for a in args]


def _key_of(argument: object) -> object:
    """Return the key of an argument that is neither a device array nor a Python int."""
    kind = type(argument)
    if kind is np.ndarray:
        return argument.tobytes()  # type: ignore[attr-defined]
    if kind is np.int32 or (kind is np.float64 and argument):
        return argument
    # The bytes of 0 and -0 differ. A new object is equal to nothing else.
    return argument.tobytes() if isinstance(argument, np.generic) else object()


def set_changed(kernel: cl.Kernel, args: Sequence[Any], changed: Iterable[int]) -> None:
    """Set the arguments number `changed` among `args` of `kernel`. What watches arguments replaces this function."""
    for k in changed:
        a = args[k]
        if type(a) is DeviceArray or isinstance(a, cla.Array):
            # `data` raises an error for an array that does not begin at the start of its buffer.
            buffer: Any = a.data if a.offset else a.base_data
            kernel.set_arg(k, buffer)
        elif isinstance(a, (int, np.generic, np.ndarray)):
            _set_number(kernel, k, np.int32(a) if isinstance(a, int) else a)
        else:
            kernel.set_arg(k, a)


_set_number: Callable[[cl.Kernel, int, Any], None] = getattr(cl.Kernel, "_set_arg_buf", cl.Kernel.set_arg)
"""Sets a number or vector. `set_arg` first tries all other types, which takes ten times as long as a launch."""
