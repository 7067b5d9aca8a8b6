"""Limits of a device's memory: of all arrays, and of one."""

from __future__ import annotations

import pyopencl as cl

from ..errors import MemoryLimitError
from .host_memory import host_memory


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
