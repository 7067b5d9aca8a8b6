"""How much memory this process may have on the host."""

from __future__ import annotations

import contextlib
import math
import os
from pathlib import Path

_CONTAINER = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def host_memory() -> float:
    """Return the bytes that the machine has, or fewer if a container or the shell (ulimit -v) allows fewer.

    Infinite where the system does not say.
    """
    limits = [math.inf]
    with contextlib.suppress(AttributeError, ValueError, OSError):  # systems other than POSIX
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for path in _CONTAINER:
        with contextlib.suppress(ValueError, OSError):  # "max", or no such file
            limits.append(int(Path(path).read_text()))
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            limits.append(limit)
    return min(limit for limit in limits if limit > 0)
