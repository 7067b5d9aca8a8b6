"""Times of kernels and steps, as a `Profile` counts them, and their tables."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .profile import Profile

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
