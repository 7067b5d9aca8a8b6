"""The device that stages work on: its queue, the precision, memory, and launches of kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, cast

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
from numpy.typing import ArrayLike, DTypeLike

from . import program, ranges
from .device_array import make_array
from .kernels import KernelPool, Kernels, bind, fit_group, range_of
from .peers import ALONE, Peers
from .ranges import enqueue_ranges
from .workspace import Workspace

ITEM_GROUP = 64
"""Work-items per group of a kernel in which each work-item does one item."""


class Traits(NamedTuple):
    """What kernels are built for, and take as arguments, besides dimension and precision."""

    macros: tuple[str, ...] = ()
    """Macros that are set."""
    periods: tuple[float, ...] = ()
    """tuple of 3 floats, or empty. PERIOD_ARGS of kernels, in the device's coordinates; 0 where there are walls."""
    curved: bool = False
    """Whether cells have one dimension less than positions."""
    cut: bool = False
    """Whether cells in 2D are cut after they were clipped: then faces are measured in full precision."""
    site_values: int = 0
    """Numbers per generator besides its coordinates."""


PLAIN = Traits()
"""Those of boxes with walls on all sides."""


class GroupSizes(NamedTuple):
    """Work-groups of block-wise kernels (scans, reductions)."""

    groups: int
    """Number of groups."""
    group_size: int
    """Work-items per group."""


def group_sizes(device: cl.Device) -> GroupSizes:
    """Return the work-groups for `device`.

    On a CPU a group is one work-item, which loops over its part of the items. The number of parts does not depend on
    the number of cores, so that sums have the same bits on all CPUs.
    """
    if device.type & cl.device_type.CPU:
        return GroupSizes(32, 1)
    return GroupSizes(min(512, 8 * device.max_compute_units), 128)


class PartialSums(NamedTuple):
    """Sums over the cells of a part, which the other parts have, too."""

    partial: cla.Array
    """(q * groups,) real, device. A row of `groups` sums for each of q quantities."""
    rows: tuple[int, ...]
    """tuple of k int. The rows to be summed over all parts."""
    largest: int | None = None
    """int, optional. A row of `rows` of which all parts need the maximum in place of the sum."""


class Engine:
    """A device with a queue, a dimension and a precision.

    - `queue`: in order.
    - `real`: float64 or float32.
    - `traits`: for what kernels are built.
    - `workspace`: memory that stages use in turn; see `scratch`.
    - `pool`: kernels that stages take.
    - `peers`: the parts of the domain. The stages work on one of them.

    Its attributes:
    - `groups`, `group_size`: see `GroupSizes`.
    - `period_args`: PERIOD_ARGS of kernels: the periods, padded to four numbers, or nothing.
    """

    def __init__(
        self,
        ctx: cl.Context,
        queue: cl.CommandQueue,
        dim: int,
        real: np.dtype,
        traits: Traits = PLAIN,
        *,
        workspace: Workspace | None = None,
        pool: KernelPool | None = None,
        peers: Peers = ALONE,
    ) -> None:
        self.ctx, self.queue = ctx, queue
        self.dim, self.real, self.traits = dim, real, traits
        self.groups, self.group_size = group_sizes(queue.device)
        self._divides = ranges.may_be_interrupted(queue.device)
        self.period_args: tuple[np.ndarray, ...] = ()
        if traits.periods:
            vector = np.array([*traits.periods, 0], real)
            vector.setflags(write=False)
            self.period_args = (vector,)
        self.workspace = Workspace(queue) if workspace is None else workspace
        self.pool = KernelPool() if pool is None else pool
        self.peers = peers
        self._shared_kernels: dict[object, Kernels] = {}
        self._copies: list[cl.Event] = []

    def replaced(self, *, real: np.dtype | None = None, traits: Traits | None = None) -> Engine:
        """Return an engine of another precision or other traits that shares workspace and kernels with this one."""
        return Engine(
            self.ctx,
            self.queue,
            self.dim,
            self.real if real is None else real,
            self.traits if traits is None else traits,
            workspace=self.workspace,
            pool=self.pool,
            peers=self.peers,
        )

    def alone(self) -> Engine:
        """Return an engine for the whole domain that shares kernels with this one."""
        return Engine(self.ctx, self.queue, self.dim, self.real, self.traits, pool=self.pool)

    def sum_over_parts(self, sums: PartialSums, swap: Callable[..., list[np.ndarray]] | None = None) -> np.ndarray:
        """Replace partial sums by their sums over all parts; return their totals, (k,), in the order of rows.

        The parts send each other the rows by `Peers.gather`, or by `swap`, which may do more at the same time.
        """
        if self.peers.count == 1 and swap is None:
            return np.empty(0)
        partial, chosen, largest = sums
        host = partial.get().reshape(-1, self.groups)
        own = host[list(chosen)]
        found = np.stack((swap or self.peers.gather)(own))
        host[list(chosen)] = found.sum(axis=0)
        if largest is not None:
            host[largest] = found[:, chosen.index(largest)].max(axis=0)
        self.send(host, partial)
        return host[list(chosen)].sum(axis=1)

    def send(self, host: np.ndarray, array: cla.Array, offset: int = 0) -> None:
        """Enqueue a copy of `host` to `array`, from byte `offset` on. `host` must not change any more."""
        # The event of a copy keeps `host`. When it is deleted, it waits for the copy.
        buffer = cast("cl.Buffer", array.base_data)
        copy = cl.enqueue_copy(self.queue, buffer, host, dst_offset=array.offset + offset, is_blocking=False)
        self._copies = [*self._copies[-1:], copy]

    @property
    def site_size(self) -> int:
        """Numbers per generator: its coordinates, and those of the traits."""
        return self.dim + self.traits.site_values

    @property
    def cell_dim(self) -> int:
        """Dimension of the cells."""
        return self.dim - self.traits.curved

    @property
    def face(self) -> np.dtype:
        """Precision of the measures and centroids of faces during a run.

        They are relative to the generator. So single precision is enough to move generators, and halves most of the
        memory of a diagram in 2D. Cells in 3D are measured only while they are clipped, and others only while they are
        cut: there the precision is `real`.
        """
        full = self.cell_dim == 3 or self.traits.cut
        return self.real if full else np.dtype(np.float32)

    @staticmethod
    def name_of(real: np.dtype) -> str:
        """Return the type of `real` in OpenCL C."""
        return "double" if real == np.float64 else "float"

    def kernels(
        self,
        stage: str,
        defines: Mapping[str, object] | None = None,
        prelude: str = "",
        group_size: int | None = None,
        shared: bool = False,
    ) -> Kernels:
        """Return the kernels of `cl_kernels/<stage>.cl`; see `Kernels`.

        - `defines`: macros besides those of the engine.
        - `prelude`: OpenCL C before the file.
        - `group_size`: work-items per group of block-wise kernels, by default the engine's.
        - `shared`: return the same kernels in each call with this `stage` and these `defines`. Launches must set all
          arguments.
        """
        if shared:
            key = stage, frozenset((defines or {}).items())
            if key not in self._shared_kernels:
                self._shared_kernels[key] = self.kernels(stage, defines, prelude, group_size)
            return self._shared_kernels[key]
        name, full = f"{stage}.cl", self.all_defines(stage, defines or {})
        # Called through the module, because tests replace the function.
        return Kernels(
            lambda size: program.build_program(self.ctx, name, {**full, "GROUP_SIZE": size}, prelude),
            stage,
            self.pool,
            group_size or self.group_size,
        )

    def all_defines(self, stage: str, defines: Mapping[str, object]) -> dict[str, object]:
        """Return `defines` and those macros of the engine that `cl_kernels/<stage>.cl` names."""
        # A macro that the text does not use changes nothing but the cache key: the same program would be built again.
        text = program.source_text(f"{stage}.cl")
        optional = {"FACE": self.name_of(self.face), **dict.fromkeys(self.traits.macros, 1)}
        named = {name: value for name, value in optional.items() if name in text}
        return {"DIM": self.dim, "REAL": self.name_of(self.real), "GROUP_SIZE": self.group_size, **named, **defines}

    def run(self, kernel: cl.Kernel, size: int, *args: object, group: int | None = None) -> cl.Event:
        """Enqueue `kernel` over at least `size` work-items; arrays are passed as their buffers.

        `size` is rounded up to whole work-groups of `group` items, or fewer if the device requires it. The kernel must
        skip the items beyond `size`.
        """
        group = fit_group(kernel, group or ITEM_GROUP)
        bind(kernel, args)
        return self.enqueue(kernel, (size + group - 1) // group * group if size > 0 else group, group)

    def enqueue(self, kernel: cl.Kernel, items: int, group: int) -> cl.Event:
        """Enqueue `kernel`, with its arguments set, over `items` work-items: whole work-groups of `group` items.

        On GPUs a launch of many items is divided into ranges. So `kernel` must not depend on the number of a group.
        """
        if self._divides:
            return enqueue_ranges(self.queue, kernel, items, group, range_of(kernel))
        return cl.enqueue_nd_range_kernel(self.queue, kernel, (items,), (group,))

    def run_each(self, kernel: cl.Kernel, size: int, *args: object, group: int | None = None) -> cl.Event:
        """Enqueue `kernel` over `size` work-items; `size` is its first argument (see WORK_ITEM in opencl/real.h)."""
        size = int(size)
        return self.run(kernel, size, size, *args, group=group)

    def run_blocks(self, kernel: cl.Kernel, *args: object) -> cl.Event:
        """Enqueue a block-wise `kernel` over `groups` work-groups of `group_size` items (see opencl/blocks.h)."""
        return self.run_groups(kernel, self.groups, *args)

    def run_groups(self, kernel: cl.Kernel, groups: int, *args: object) -> cl.Event:
        """Enqueue a block-wise `kernel` over `groups` work-groups."""
        bind(kernel, args)
        group = getattr(kernel, "block", self.group_size)
        return cl.enqueue_nd_range_kernel(self.queue, kernel, (groups * group,), (group,))

    def block_of(self, kernel: cl.Kernel) -> int:
        """Return the number of work-items per group for which a block-wise `kernel` has been built."""
        return getattr(kernel, "block", self.group_size)

    def empty(self, shape: int | tuple[int, ...], dtype: DTypeLike | None = None) -> cla.Array:
        """Return an uninitialized device array; `dtype` defaults to the engine's precision."""
        return make_array(self.queue, shape, np.dtype(self.real if dtype is None else dtype))

    def scratch(self, shape: int | tuple[int, ...], dtype: DTypeLike | None = None) -> cla.Array:
        """Return an uninitialized array of the workspace, valid to its frame's end; outside of one, a new array."""
        taken = self.workspace.take(shape, self.real if dtype is None else dtype)
        return self.empty(shape, dtype) if taken is None else taken

    def zeros(self, shape: int | tuple[int, ...], dtype: DTypeLike | None = None) -> cla.Array:
        """Return a device array of zeros."""
        return self.empty(shape, dtype).fill(0)

    def upload(self, host: ArrayLike, dtype: DTypeLike | None = None) -> cla.Array:
        """Copy a host array to the device in the engine's precision (or `dtype`)."""
        given = np.ascontiguousarray(host, self.real if dtype is None else dtype)
        array = self.empty(given.shape, given.dtype)
        array.set(given)
        return array
