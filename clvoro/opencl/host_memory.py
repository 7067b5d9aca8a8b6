"""The memory that this process may use on the host."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path

GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
"""Linux's files with the limits of control groups, and with those of this process."""


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
