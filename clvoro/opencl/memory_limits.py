"""Limits of memory: of a device, for all arrays and for one, and of this process on the host."""

from __future__ import annotations

import contextlib
import math
import os
import re
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pyopencl as cl

from ..errors import InputError, MemoryLimitError

GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
"""Linux's files with the limits of control groups, and with those of this process."""
VARIABLE = "CLVORO_MEMORY_LIMIT"
"""Environment variable with the number of bytes that this process may allocate on each device."""
TAKEN: Counter[cl.Device] = Counter()
MOST_TAKEN: Counter[cl.Device] = Counter()
"""Bytes of all arrays on each device: at present, and the maximum since the start. Counted only under a limit."""
_counting = threading.RLock()


def in_bytes(amount: float) -> str:
    """Return a number of bytes as text: 258 KiB, 1.47 GiB."""
    power = 0 if amount < 2**10 else 1 if amount < 2**20 else 2 if amount < 2**30 else 3
    return f"{amount / 2 ** (10 * power):.3g} {('bytes', 'KiB', 'MiB', 'GiB')[power]}"


def memory_limit() -> float:
    """Return the bytes that `VARIABLE` lets this process take of each device; infinite if it is not set.

    Raises `InputError` if it is no number of bytes.
    """
    text = os.environ.get(VARIABLE, "").strip()
    found = re.fullmatch(r"(\d+\.?\d*) *([KMGT]?)(i?B)?", text, re.IGNORECASE)
    if text and not found:
        raise InputError(f"{VARIABLE} is {text!r}, expected a number of bytes, such as 8GiB; unset it for no limit")
    return float(found[1]) * 2 ** (10 * " KMGT".index(found[2].upper() or " ")) if found else math.inf


def available_memory(device: cl.Device) -> float:
    """Return the memory of `device` in bytes, at most `memory_limit`; for a CPU at most the limit of this process."""
    own = min(device.global_mem_size, memory_limit())
    return min(own, host_memory()) if device.type & cl.device_type.CPU else own


class _CountedBuffer(cl.Buffer):
    """A buffer whose bytes count in `TAKEN` as long as it exists."""

    def __init__(self, context: cl.Context, size: int) -> None:
        self._device, self._bytes = context.devices[0], size
        with _counting:
            TAKEN[self._device] += size
            MOST_TAKEN[self._device] = max(MOST_TAKEN[self._device], TAKEN[self._device])
        super().__init__(context, cl.mem_flags.READ_WRITE, size)

    def __del__(self) -> None:
        with _counting:
            TAKEN[self._device] -= self._bytes


def new_buffer(queue: cl.CommandQueue, size: int) -> cl.Buffer:
    """Return a buffer of `size` bytes with arbitrary content.

    Raises `MemoryLimitError` if the device does not allocate so large a buffer, or this process would take more than
    `memory_limit`.
    """
    check_allocation(queue.device, size)
    limit = memory_limit()
    if limit == math.inf:
        return cl.Buffer(queue.context, cl.mem_flags.READ_WRITE, size)
    if TAKEN[queue.device] + size > limit:
        raise MemoryLimitError(
            f"an array needs {in_bytes(size)}, and all arrays have {in_bytes(TAKEN[queue.device])}, expected at most "
            f"{in_bytes(limit)}, as {VARIABLE} says; allow more, or use a larger size, n_cells or dtype='float32'"
        )
    return _CountedBuffer(queue.context, size)


def largest_allocation(device: cl.Device) -> int:
    """Return the largest size of one buffer on `device` in bytes. GPUs have as little as a quarter of their memory."""
    return device.max_mem_alloc_size


def check_allocation(device: cl.Device, size: int) -> None:
    """Check that one buffer may have `size` bytes on `device`.

    Raises `MemoryLimitError` with the bytes needed and allowed.
    """
    most = largest_allocation(device)
    if size > most:
        raise MemoryLimitError(
            f"an array needs {in_bytes(size)}, and {device.name.strip()} allocates at most {in_bytes(most)} for one; "
            "use a larger size, n_cells, dtype='float32' or another device"
        )


def _group_limits() -> Iterator[float]:
    """Yield the limits of this process's control groups, as containers and batch systems set them."""
    paths = {(GROUPS, "memory.max", "."), (GROUPS / "memory", "memory.limit_in_bytes", ".")}
    with contextlib.suppress(ValueError, OSError):  # another format, or no such file
        for line in OWN_GROUPS.read_text().splitlines():
            _, kinds, path = line.split(":", 2)
            if not kinds:
                paths.add((GROUPS, "memory.max", path.strip("/")))
            elif "memory" in kinds.split(","):
                paths.add((GROUPS / "memory", "memory.limit_in_bytes", path.strip("/")))
    for root, name, path in paths:
        for group in (Path(path), *Path(path).parents):
            with contextlib.suppress(ValueError, OSError):  # "max", or no such file
                yield int((root / group / name).read_text())


def host_memory() -> float:
    """Return the memory of the machine, or the limit of a container, a batch system or the shell (ulimit -v), in bytes.

    Infinite if the system gives none.
    """
    limits = [math.inf]
    with contextlib.suppress(AttributeError, ValueError, OSError):  # systems other than POSIX
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    limits += _group_limits()
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            limits.append(limit)
    return min(limit for limit in limits if limit > 0)
