"""Limits of memory: of a device, for all arrays and for one, and of this process on the host."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path

import pyopencl as cl

from ..errors import MemoryLimitError

GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
"""Linux's files with the limits of control groups, and with those of this process."""


def in_bytes(amount: float) -> str:
    """Return a number of bytes as text: 258 KiB, 1.47 GiB."""
    power = 0 if amount < 2**10 else 1 if amount < 2**20 else 2 if amount < 2**30 else 3
    return f"{amount / 2 ** (10 * power):.3g} {('bytes', 'KiB', 'MiB', 'GiB')[power]}"


def available_memory(device: cl.Device) -> float:
    """Return the memory of `device` in bytes; for a CPU at most the limit of this process."""
    own = device.global_mem_size
    return min(own, host_memory()) if device.type & cl.device_type.CPU else own


def largest_allocation(device: cl.Device) -> int:
    """Return the largest size of one buffer on `device` in bytes. GPUs have as little as a quarter of their memory."""
    return device.max_mem_alloc_size


def check_allocation(device: cl.Device, size: int) -> None:
    """Check that one buffer may have `size` bytes on `device`.

    Raises
    ------
    MemoryLimitError
        With the bytes needed and allowed.
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
