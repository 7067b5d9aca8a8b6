"""Find, specialize, build and cache the OpenCL programs; run their kernels.

A stage's source is `cl_kernels/<stage>.cl`. Its `#include "common/x.h"` lines are pasted here, once each,
with `#line` directives, so that the complete text is what the driver (and its cache) sees.
"""

from __future__ import annotations

import contextlib
import re
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..errors import BuildError
from .device_array import DeviceArray, make_array
from .runtimes import cache_remedy
from .workspace import Workspace

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
_lock = threading.Lock()
_programs: dict[tuple, cl.Program] = {}
_building = 0.0
POCL = "Portable Computing Language"
"""Name of PoCL's platform."""
_UNTYPED_CALLS = 3
"""Calls of a kernel before PyOpenCL is told the types of its arguments."""


def kernel_folder() -> Path:
    """Folder of the `.cl` files: inside the installed package, else beside it in a checkout."""
    package = Path(__file__).parent.parent
    inside = package / "cl_kernels"
    return inside if inside.is_dir() else package.parent / "cl_kernels"


@cache
def source_text(name: str) -> str:
    """Return the text of `cl_kernels/<name>` with every include pasted in once; files are read once."""
    return _paste(name, set())


def _paste(name: str, seen: set[str]) -> str:
    lines = [f'#line 1 "{name}"']
    for number, line in enumerate((kernel_folder() / name).read_text().splitlines(), start=1):
        match = _INCLUDE.match(line)
        if match is None:
            lines.append(line)
        elif match[1] not in seen:
            seen.add(match[1])
            lines += [_paste(match[1], seen), f'#line {number + 1} "{name}"']
        else:
            lines.append("")
    return "\n".join(lines)


CPU_GROUPS = 32
"""Parts that sums are cut into on CPUs: as many whatever the number of cores, so that the bits do not depend on it."""


class KernelPool:
    """Kernels of any program, each in one hand at a time.

    To make one, and to tell PyOpenCL of its arguments, costs as much as a hundred launches, and stages come and go with
    every run.
    """

    def __init__(self) -> None:
        self._free: dict[tuple[int, str], list[cl.Kernel]] = {}
        self._taken: list[tuple[tuple[int, str], cl.Kernel]] = []
        self.on_kernel: Callable[[int], object] | None = None
        """Called with the number of kernels that have been taken, when there is a new one."""

    def take(self, program: cl.Program, name: str) -> cl.Kernel:
        """Return a kernel that nobody else has, until all are taken back."""
        key = program.int_ptr, name
        if key not in self._free:
            self._free[key] = []
            if self.on_kernel is not None:
                self.on_kernel(len(self._free))
        free = self._free[key]
        kernel = free.pop() if free else cl.Kernel(program, name)
        self._taken.append((key, kernel))
        return kernel

    def take_back(self) -> None:
        """Free all kernels: whoever has had one no longer relies on its arguments."""
        for key, kernel in self._taken:
            self._free[key].append(kernel)
        self._taken.clear()


class Kernels(SimpleNamespace):
    """Kernels of a program as attributes, taken when first used; the program is built for the first of them.

    Each has arguments of its own, and knows its `stage`, for a profile.
    """

    def __init__(self, build: Callable[[], cl.Program], stage: str, pool: KernelPool) -> None:
        super().__init__(_build=build, _stage=stage, _pool=pool)

    def __getattr__(self, name: str) -> cl.Kernel:
        if name.startswith("_"):
            raise AttributeError(name)
        program = self._build()
        try:
            kernel = self._pool.take(program, name)
        except cl.LogicError as error:
            if f"void {name}(" in source_text(f"{self._stage}.cl"):
                raise BuildError(
                    f"cl_kernels/{self._stage}.cl was built without its kernel {name}. {cache_remedy()}"
                ) from error
            raise AttributeError(f"cl_kernels/{self._stage}.cl has no kernel {name}") from error
        kernel.stage = self._stage.rpartition("/")[2]  # type: ignore[attr-defined]
        setattr(self, name, kernel)
        return kernel


def bind(kernel: cl.Kernel, args: Sequence[object]) -> None:
    """Set the arguments of `kernel`, unless they are what it has; arrays pass as their buffers.

    A step's arrays are those of the step before, mostly: to see that costs a quarter of setting them.
    """
    key = key_of(args)
    if key == getattr(kernel, "bound", None):
        return
    set_args(kernel, plain(args))
    kernel.bound = key  # type: ignore[attr-defined]


def key_of(args: Sequence[object]) -> list[object]:
    """Return what arguments can be compared by without keeping them: equal only if all is the same."""
    return [
        a.mark if type(a) is DeviceArray else a if type(a) is np.int32 else _key_of(a) for a in args
    ]


def plain(args: Sequence[object]) -> list[Any]:
    """Return arguments with the buffers of arrays in their place."""
    return [a.data if isinstance(a, cla.Array) else a for a in args]


def _key_of(argument: object) -> object:
    """Return what an argument is compared by that is neither an array on the device nor an int."""
    # Bytes tell 0 from -0, and an object on its own is equal to nothing else.
    return argument.tobytes() if isinstance(argument, (np.generic, np.ndarray)) else object()


def set_args(kernel: cl.Kernel, given: list[Any]) -> None:
    """Set the arguments of `kernel`: buffers, numbers and vectors.

    PyOpenCL finds out what an argument is by trying one kind after the other, which for a number takes five times as
    long as the launch. Once it has been told their types it need not; that costs as much as twenty numbers, and is done
    for kernels that are called again and again. An argument is of the same type in every call.
    """
    kernel.bound = None  # type: ignore[attr-defined]
    calls = getattr(kernel, "calls", 0)
    if calls == _UNTYPED_CALLS:
        kernel.set_arg_types([_type_of(a) for a in given])
    if calls <= _UNTYPED_CALLS:
        kernel.calls = calls + 1  # type: ignore[attr-defined]
    kernel.set_args(*given)


def _type_of(argument: object) -> np.dtype | None:
    """Return the type of a number, raw bytes for a vector, None for a buffer."""
    if isinstance(argument, np.number):
        return argument.dtype
    if isinstance(argument, np.ndarray):
        return np.dtype((np.void, argument.nbytes))
    return None


def build_program(
    ctx: cl.Context, name: str, defines: Mapping[str, object], prelude: str
) -> cl.Program:
    """Build `cl_kernels/<name>` after `prelude`; the same text on the same context is built once.

    Raises
    ------
    BuildError
        With the compiler's log, if the source does not compile.
    """
    global _building
    text, options = program_text(name, defines, prelude)
    key = (ctx.int_ptr, text, options)
    with _lock:
        if key not in _programs:
            began = time.perf_counter()
            try:
                _programs[key] = compile_text(ctx, text, options, short=not prelude)
            except cl.Error as error:
                raise BuildError(f"cl_kernels/{name} does not compile: {error}") from error
            _building += time.perf_counter() - began
        return _programs[key]


def program_text(
    name: str, defines: Mapping[str, object], prelude: str
) -> tuple[str, tuple[str, ...]]:
    """Return the text of the program in `cl_kernels/<name>` after `prelude`, and its options."""
    options = tuple(f"-D{key}={value}" for key, value in sorted(defines.items()))
    return prelude + "\n" + source_text(name), options


def compile_text(
    ctx: cl.Context, text: str, options: tuple[str, ...], short: bool = True
) -> cl.Program:
    """Build `text`; if `short`, PoCL reads our declarations of built-in functions instead of its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", cl.CompilerWarning)
        if short and ctx.devices[0].platform.name.strip() == POCL:
            with contextlib.suppress(cl.Error):  # another PoCL may need its own declarations
                text_of_pocl, more = shortened(text)
                return cl.Program(ctx, text_of_pocl).build(options=[*options, *more])
        return cl.Program(ctx, text).build(options=list(options))


def shortened(text: str) -> tuple[str, tuple[str, ...]]:
    """Return `text` with our declarations of built-in functions, and the options for PoCL to leave out its own."""
    return f"{source_text('opencl/pocl_builtins.h')}\n{text}", ("-D_OPENCL_H_",)


def build_seconds() -> float:
    """Return the time that this process has spent on building programs."""
    return _building


def _period_args(defines: Mapping[str, object], real: np.dtype) -> tuple[np.ndarray, ...]:
    """Return the periods that the defines of a domain tell, as one vector."""
    if "PERIODIC" not in defines:
        return ()
    periods = [float.fromhex(str(defines[f"PERIOD_{a}"])) for a in range(3)]
    vector = np.array([*periods, 0], real)
    vector.setflags(write=False)
    return (vector,)


@dataclass(frozen=True)
class Engine:
    """One device, ready to work: context, in-order queue, dimension and precision.

    Attributes
    ----------
    ctx, queue : pyopencl.Context, pyopencl.CommandQueue
    dim : 2 or 3
    real : numpy.dtype, float64 or float32
    domain_defines : tuple of (name, value)
        What kernels are built with for the kind of domain; see `Domain.defines` and geometry/domain.h.
    """

    ctx: cl.Context
    queue: cl.CommandQueue
    dim: int
    real: np.dtype
    domain_defines: tuple[tuple[str, object], ...] = ()
    groups: int = field(init=False)
    """Number of work-groups that a block-wise kernel (scan, reduction) is cut into."""
    group_size: int = field(init=False)
    """Work-items per group of such a kernel: 1 on a CPU (a plain loop per core), 128 on a GPU."""

    item_group: int = field(init=False)
    """Work-items per group of a kernel that does one item each."""
    period_args: tuple[np.ndarray, ...] = field(init=False, repr=False, compare=False)
    """What kernels take as PERIOD_ARGS: the periods in the device's coordinates, padded to four, or nothing."""
    workspace: Workspace = field(init=False, repr=False, compare=False)
    """Memory that stages use in turn; see `scratch`."""
    pool: KernelPool = field(init=False, repr=False, compare=False, default_factory=KernelPool)
    """Where stages have their kernels from."""

    def __post_init__(self) -> None:
        device = self.queue.device
        cpu = bool(device.type & cl.device_type.CPU)
        units = device.max_compute_units
        object.__setattr__(self, "groups", CPU_GROUPS if cpu else min(512, units * 8))
        object.__setattr__(self, "group_size", 1 if cpu else 128)
        object.__setattr__(self, "item_group", 64)
        object.__setattr__(self, "period_args", _period_args(dict(self.domain_defines), self.real))
        object.__setattr__(self, "workspace", Workspace(self.queue))

    def single(self) -> Engine:
        """Return the same engine in float32, with the same workspace and kernels."""
        engine = replace(self, real=np.dtype(np.float32))
        for name in ("groups", "group_size", "item_group", "workspace", "pool"):
            object.__setattr__(engine, name, getattr(self, name))
        return engine

    @property
    def face(self) -> np.dtype:
        """Precision of what a diagram at work knows of its faces.

        Relative to the generator, and so to the size of the cell, single precision is enough for all that moves
        generators: it halves what is most of a diagram in the plane. Trimmed cells and polyhedra are measured where
        they are cut, and only there, so that theirs is full.
        """
        whole = self.dim == 3 or self.trims
        return self.real if whole else np.dtype(np.float32)

    @property
    def trims(self) -> bool:
        """Whether cells are trimmed by the edges of a polygon."""
        return any(name == "POLYGON" for name, _ in self.domain_defines)

    @staticmethod
    def name_of(real: np.dtype) -> str:
        """Return the name of a precision in OpenCL C."""
        return "double" if real == np.float64 else "float"

    def kernels(
        self, stage: str, defines: Mapping[str, object] | None = None, prelude: str = ""
    ) -> Kernels:
        """Return the kernels of `cl_kernels/<stage>.cl`, which is built for the first that is used."""
        name, full = f"{stage}.cl", self.all_defines(stage, defines or {})
        return Kernels(lambda: build_program(self.ctx, name, full, prelude), stage, self.pool)

    def all_defines(self, stage: str, defines: Mapping[str, object]) -> dict[str, object]:
        """Return what `cl_kernels/<stage>.cl` is built with: `defines`, and those of the engine that it names."""
        # What a source does not name would only have it built anew for every domain.
        text = source_text(f"{stage}.cl")
        of_domain = (("FACE", self.name_of(self.face)), *self.domain_defines)
        named = {name: value for name, value in of_domain if name in text}
        return {
            "DIM": self.dim, "REAL": self.name_of(self.real), "GROUP_SIZE": self.group_size, **named, **defines,
        }  # fmt: skip

    def run(
        self, kernel: cl.Kernel, size: int, *args: object, group: int | None = None
    ) -> cl.Event:
        """Enqueue `kernel` over at least `size` work-items; arrays pass as their buffers.

        The number is rounded up to whole groups of `group` (by default the device's own choice of one fixed size), so
        the kernel must leave out what lies beyond.
        """
        group = self.item_group if group is None else group
        bind(kernel, args)
        whole = -(-max(int(size), 1) // group) * group
        return cl.enqueue_nd_range_kernel(self.queue, kernel, (whole,), (group,))

    def run_each(
        self, kernel: cl.Kernel, size: int, *args: object, group: int | None = None
    ) -> cl.Event:
        """Enqueue `kernel` over `size` work-items; `size` is its first argument (see WORK_ITEM in opencl/real.h)."""
        return self.run(kernel, size, np.int32(size), *args, group=group)

    def run_blocks(self, kernel: cl.Kernel, *args: object) -> cl.Event:
        """Enqueue a block-wise `kernel`: `groups` work-groups of `group_size` (see opencl/blocks.h)."""
        bind(kernel, args)
        size = (self.groups * self.group_size,)
        return cl.enqueue_nd_range_kernel(self.queue, kernel, size, (self.group_size,))

    def empty(self, shape: int | tuple[int, ...], dtype: DTypeLike | None = None) -> cla.Array:
        """Return an uninitialized device array; `dtype` defaults to the engine's precision."""
        return make_array(self.queue, shape, np.dtype(self.real if dtype is None else dtype))

    def scratch(self, shape: int | tuple[int, ...], dtype: DTypeLike | None = None) -> cla.Array:
        """Return the same, but of the workspace, valid to the end of its frame; outside of one, an array of its own."""
        real = np.dtype(self.real if dtype is None else dtype)
        taken = self.workspace.take(shape, real)
        return self.empty(shape, real) if taken is None else taken

    def zeros(self, shape: int | tuple[int, ...], dtype: DTypeLike | None = None) -> cla.Array:
        """Return a device array of zeros."""
        return self.empty(shape, dtype).fill(0)

    def upload(self, host: ArrayLike, dtype: DTypeLike | None = None) -> cla.Array:
        """Copy a host array to the device in the engine's precision (or `dtype`)."""
        given = np.ascontiguousarray(host, self.real if dtype is None else dtype)
        array = self.empty(given.shape, given.dtype)
        array.set(given)
        return array
