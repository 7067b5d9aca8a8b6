"""The time that each kernel of a run takes, from the device's events.

All commands of a queue are timed (see `hooks`). A run without a profile keeps no events.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl

from ..errors import InputError
from . import hooks as _hooks
from .program import build_program, build_seconds

if TYPE_CHECKING:
    from ..adapter import Adapter


SMALL = 0.005
"""Share of the device's time below which a table sums kernels up in one row."""


@dataclass
class Cost:
    """Time and memory traffic of one kernel, or of several."""

    calls: int = 0
    seconds: float = 0.0
    """Device time, from start to end of each call."""
    bytes: int = 0
    """Sizes of the buffers that were bound to the calls, each buffer once a call: an estimate of the memory traffic. It
    is too high where a call uses a part of a buffer only, and too low where memory is read and written, or read
    twice."""
    seconds_known: float = 0.0
    """Time of those calls whose buffers are known."""

    def __add__(self, other: Cost) -> Cost:
        return Cost(
            self.calls + other.calls,
            self.seconds + other.seconds,
            self.bytes + other.bytes,
            self.seconds_known + other.seconds_known,
        )

    @property
    def rate(self) -> float | None:
        """Bytes per second; None where no call's buffers are known."""
        return self.bytes / self.seconds_known if self.seconds_known else None


@dataclass
class TimeSpan:
    """The time between two rows of a run's history."""

    began: float
    step: int | None = None
    level: int | None = None
    cells: int | None = None
    """`step`, `level`, `cells`: int or None. Of the row at its end. Step 0 is the time before the first step. None: the
    time after the last row."""
    wall: float = 0.0
    """Seconds by the clock."""
    stages: dict[str, float] = field(default_factory=dict)
    """Device time per stage."""
    read: int = 0
    """Bytes that the host has read from the device."""

    @property
    def host(self) -> float:
        """Seconds that the device did not work."""
        return self.wall - sum(self.stages.values())


def tabulate(profile: Profile) -> str:
    """Return stages and kernels as tables in plain text."""
    levels = sorted({s.level for s in profile.steps if s.level is not None}, reverse=True)
    groups = {f"level {level}": [s for s in profile.steps if s.level == level] for level in levels}
    columns = {"ms/step": profile.steps} if profile.steps else {}
    if len(levels) > 1:
        columns |= groups

    def per_step(seconds: Callable[[TimeSpan], float]) -> list[str]:
        return [f"{1e3 * sum(map(seconds, s)) / len(s):.2f}" for s in columns.values()]

    def time_of(seconds: float) -> list[str]:
        return [f"{1e3 * seconds:.1f}", f"{seconds / profile.wall:.1%}"]

    def moving(cost: Cost) -> list[str]:
        rate = cost.rate
        if rate is None:
            return ["-", "-"]
        return [f"{1e-9 * rate:.1f}", f"{rate / profile.bandwidth:.0%}"]

    stages = [["stage", "calls", "ms", "share", "GB/s", "of copy", *columns]]
    for name, cost in profile.stages().items():
        row = [name, str(cost.calls), *time_of(cost.seconds), *moving(cost)]
        stages.append([*row, *per_step(lambda s, name=name: s.stages.get(name, 0.0))])
    stages.append(["host", "", *time_of(profile.host), "", "", *per_step(lambda s: s.host)])
    whole = ["wall", str(profile.launches), *time_of(profile.wall), "", ""]
    stages.append([*whole, *per_step(lambda s: s.wall)])

    kernels = [["kernel", "calls", "ms", "share", "GB/s", "of copy", "us/call", "MB/call"]]
    small = Cost()
    for (stage, name), cost in profile.ranked():
        if cost.seconds < SMALL * profile.device:
            small += cost
            continue
        kernels.append([f"{stage}.{name}", *_kernel_row(cost, time_of, moving)])
    if small.calls:
        name = f"{len(profile.costs) + 1 - len(kernels)} smaller ones"
        kernels.append([name, *_kernel_row(small, time_of, moving)])
    notes = [
        f"host: wall less the device's time; includes {1e3 * profile.building:.0f} ms of building "
        "programs, and the profile itself",
        f"copy: a large buffer is read and written at {1e-9 * profile.bandwidth:.1f} GB/s",
        "GB/s, MB: each buffer bound to a call counts once; mostly too high",
    ]
    for name, spans in groups.items():
        cells = max(s.cells or 0 for s in spans)
        read = statistics.median(s.read for s in spans)
        notes.append(f"{name}: {len(spans)} steps, up to {cells} cells; the host read {read:.0f} bytes a step")
    return "\n".join([_aligned(stages), "", _aligned(kernels), "", *notes])


def _kernel_row(cost: Cost, time_of: Callable[[float], list[str]], moving: Callable[[Cost], list[str]]) -> list[str]:
    calls = max(cost.calls, 1)
    moved = "-" if cost.rate is None else f"{1e-6 * cost.bytes / calls:.3f}"
    per_call = [f"{1e6 * cost.seconds / calls:.1f}", moved]
    return [str(cost.calls), *time_of(cost.seconds), *moving(cost), *per_call]


def _aligned(rows: list[list[str]]) -> str:
    """Return `rows` as text: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        )
        for row in rows
    )


PENDING = 2048
"""Largest number of events that are kept. Then the older half is read and released."""
LARGE = 256 << 20
"""Bytes of the buffer that is copied to measure the bandwidth; larger than caches."""

_bandwidths: dict[int, float] = {}


class Profile:
    """Times all commands of an adapter on the device while the profile is open.

    Meanwhile the adapter uses another queue, with profiling enabled, and other buffers. A first run
    also builds kernels: profile a second one.

    Parameters
    ----------
    target : Adapter or pyopencl.CommandQueue
        A queue must have been made with profiling enabled (`profiled_queue`).

    Attributes
    ----------
    costs : dict of (str, str) to Cost
        Per stage and kernel; a stage is a file of kernels. Complete after the profile is closed.
    spans : list of TimeSpan
        The time before each row of the history, and that after the last row.
    wall, building : float
        Wall time in seconds between opening and closing, and the part of it that built programs.

    Raises
    ------
    InputError
        If the queue has no profiling.

    Examples
    --------
    >>> with Profile(adapter) as profile:  # doctest: +SKIP
    ...     adapter.run(domain, size)
    >>> print(profile.table())  # doctest: +SKIP
    """

    def __init__(self, target: Adapter | cl.CommandQueue) -> None:
        enabled = cl.command_queue_properties.PROFILING_ENABLE
        if isinstance(target, cl.CommandQueue):
            if not target.properties & enabled:
                raise InputError(
                    "target is a queue without profiling, expected one made with PROFILING_ENABLE; "
                    "use clvoro.profile.profiled_queue(ctx)"
                )
            self._adapter, self.queue = None, target
        else:
            own = target.queue
            self._adapter = target
            self.queue = own if own.properties & enabled else profiled_queue(target.ctx)
        self.costs: dict[tuple[str, str], Cost] = {}
        self.spans: list[TimeSpan] = []
        self.wall = self.building = 0.0
        self._pending: list[tuple[cl.Event, tuple[str, str], int | None, TimeSpan]] = []
        self._closing = ExitStack()

    def __enter__(self) -> Profile:
        if self._adapter is not None:
            self._closing.enter_context(self._adapter.watched(self.queue, self._end_span))
        self._closing.enter_context(_hooks.watching(self.queue, self._add))
        self.building -= build_seconds()
        self._began = time.perf_counter()
        self._span = TimeSpan(self._began)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            self._collect(len(self._pending))
        except cl.Error:
            if kind is None:  # otherwise the run has raised its own error
                raise
        finally:
            self._pending.clear()
            now = time.perf_counter()
            self.wall += now - self._began
            self.building += build_seconds()
            self._span.wall = now - self._span.began
            self.spans.append(self._span)
            self._closing.close()

    # Called by the hooks and by the run.

    def _add(self, event: cl.Event, stage: str, name: str, moved: int | None, done: bool = False) -> None:
        """Record a command; `moved` are its bytes, if known, and `done` is True if it has ended."""
        entry = (event, (stage, name), moved, self._span)
        if done:
            self._count(*entry)
            return
        self._pending.append(entry)
        if len(self._pending) >= PENDING:
            self._collect(PENDING // 2)

    def _end_span(self, row: np.void) -> None:
        span, now = self._span, time.perf_counter()
        span.step, span.level, span.cells = (int(row[name]) for name in ("step", "level", "cells"))
        span.wall = now - span.began
        self.spans.append(span)
        self._span = TimeSpan(now)

    def _collect(self, count: int) -> None:
        """Wait for the oldest `count` events, read their times and release them."""
        if count:
            self._pending[count - 1][0].wait()
        for entry in self._pending[:count]:
            self._count(*entry)
        del self._pending[:count]

    def _count(self, event: cl.Event, key: tuple[str, str], moved: int | None, span: TimeSpan) -> None:
        event.wait()
        times = event.profile
        seconds = 1e-9 * (times.end - times.start)
        cost = self.costs.setdefault(key, Cost())
        cost.calls += 1
        cost.seconds += seconds
        if moved is not None:
            cost.bytes += moved
            # Transfers between host and device have another bandwidth.
            if key[1] not in ("read", "write") or key[0] != _hooks.MEMORY:
                cost.seconds_known += seconds
            elif key[1] == "read":
                span.read += moved
        span.stages[key[0]] = span.stages.get(key[0], 0.0) + seconds

    # Results.

    @property
    def launches(self) -> int:
        """Number of kernels and other commands."""
        return sum(cost.calls for cost in self.costs.values())

    @property
    def device(self) -> float:
        """Seconds that the device worked."""
        return sum(cost.seconds for cost in self.costs.values())

    @property
    def host(self) -> float:
        """Seconds that the device did not work: work of the host, building of programs, launches, waiting."""
        return self.wall - self.device

    @property
    def steps(self) -> list[TimeSpan]:
        """The spans of steps."""
        return [span for span in self.spans if span.step]

    @property
    def bandwidth(self) -> float:
        """Bytes per second that a copy of a large buffer reads and writes; measured once per device."""
        device = self.queue.device.int_ptr
        if device not in _bandwidths:
            _bandwidths[device] = copy_bandwidth(self.queue.context)
        return _bandwidths[device]

    def of(self, *stages: str) -> float:
        """Return the device time of these stages' kernels, in seconds."""
        return sum(cost.seconds for (stage, _), cost in self.costs.items() if stage in stages)

    def stages(self) -> dict[str, Cost]:
        """Return the sum over each stage's kernels, the longest first."""
        sums: dict[str, Cost] = {}
        for (stage, _), cost in self.costs.items():
            sums[stage] = sums.get(stage, Cost()) + cost
        return dict(sorted(sums.items(), key=lambda item: -item[1].seconds))

    def as_dict(self) -> dict[str, Any]:
        """Return all figures in a form for JSON; times in seconds, shares of `wall`."""
        self._require_closed()

        def figures(cost: Cost) -> dict[str, Any]:
            rate = cost.rate
            return {
                "calls": cost.calls,
                "seconds": cost.seconds,
                "share": cost.seconds / self.wall,
                "bytes_bound": cost.bytes if rate is not None else None,
                "share_of_bandwidth": None if rate is None else rate / self.bandwidth,
            }

        return {
            "wall": self.wall,
            "device": self.device,
            "host": self.host,
            "building": self.building,
            "bandwidth": self.bandwidth,
            "stages": [{"stage": name, **figures(cost)} for name, cost in self.stages().items()],
            "kernels": [{"stage": stage, "kernel": name, **figures(cost)} for (stage, name), cost in self.ranked()],
            "spans": [
                {"step": s.step, "level": s.level, "cells": s.cells, "wall": s.wall, "stages": dict(s.stages)}
                for s in self.spans
            ],
        }

    def table(self) -> str:
        """Return stages and kernels as tables in plain text."""
        self._require_closed()
        return tabulate(self)

    def _require_closed(self) -> None:
        if not self.spans or self.spans[-1].step is not None:
            raise InputError(
                "the profile is open or has never been opened, expected a closed one; use it after the `with` block"
            )

    def ranked(self) -> list[tuple[tuple[str, str], Cost]]:
        """Return stages and kernels with their costs, the longest first."""
        return sorted(self.costs.items(), key=lambda item: -item[1].seconds)


def profiled_queue(ctx: cl.Context) -> cl.CommandQueue:
    """Return a queue with profiling enabled."""
    return cl.CommandQueue(ctx, properties=cl.command_queue_properties.PROFILING_ENABLE)


def copy_bandwidth(ctx: cl.Context, repeat: int = 5) -> float:
    """Return the bytes per second that a copy of a large buffer on the device reads and writes.

    The best of `repeat` copies by the driver, which may use one core of a CPU only, and by a kernel.
    """
    queue = profiled_queue(ctx)
    device = queue.device
    size = min(LARGE, device.max_mem_alloc_size // 4, device.global_mem_size // 8) // 4096 * 4096
    source, target = (cl.Buffer(ctx, cl.mem_flags.READ_WRITE, size) for _ in range(2))
    # The first write allocates the pages.
    cl.enqueue_fill(queue, source, np.ones(1, np.int8), size)
    kernel = build_program(ctx, "opencl/copy.cl", {}, "").all_kernels()[0]
    kernel.set_args(source, target)
    best = float("inf")
    for _ in range(repeat):
        for event in (
            cl.enqueue_copy(queue, target, source, byte_count=size),
            cl.enqueue_nd_range_kernel(queue, kernel, (size // 16,), (64,)),
        ):
            event.wait()
            best = min(best, 1e-9 * (event.profile.end - event.profile.start))
    source.release()
    target.release()
    return 2 * size / best
