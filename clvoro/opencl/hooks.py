"""Watch all commands of a queue.

While a queue is watched, PyOpenCL's functions that enqueue commands (`enqueue_nd_range_kernel`,
`Kernel.__call__`, `enqueue_copy`, `enqueue_fill`) are replaced by functions that also pass the event
to the watchers, and `kernels.set_changed` records the sizes of buffers. So stages need no code for
profiles, and runs without one are not slower.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import pyopencl as cl

from . import kernels

MEMORY = "memory"
"""Stage of copies, fills, reads and writes by the host."""
ARRAYS = "arrays"
"""Stage of PyOpenCL's own kernels."""


class Watcher(Protocol):
    """Called with each event, its stage and kernel, its bytes if known, and whether it has ended."""

    def __call__(self, event: cl.Event, stage: str, name: str, moved: int | None, done: bool = False) -> None:
        """Take one event."""
        ...


_watched: list[tuple[cl.CommandQueue, Watcher]] = []
_lock = threading.Lock()
_original: dict[str, Callable[..., Any]] = {}


@contextmanager
def watching(queue: cl.CommandQueue, watcher: Watcher) -> Iterator[None]:
    """Pass every command on `queue` to `watcher` inside the ``with`` block."""
    entry = (queue, watcher)
    with _lock:
        if not _watched:
            for place, name, hook in _HOOKS:
                _original[name] = getattr(place, name)
                setattr(place, name, hook)
        _watched.append(entry)
    try:
        yield
    finally:
        with _lock:
            _watched.remove(entry)
            if not _watched:
                for place, name, _ in _HOOKS:
                    setattr(place, name, _original[name])


def _of(queue: cl.CommandQueue) -> list[Watcher]:
    return [watcher for watched, watcher in _watched if watched == queue]


def _enqueue_kernel(queue: cl.CommandQueue, kernel: cl.Kernel, *args: Any, **options: Any) -> Any:
    event = _original["enqueue_nd_range_kernel"](queue, kernel, *args, **options)
    for watch in _of(queue):
        stage = getattr(kernel, "stage", ARRAYS)
        watch(event, stage, kernel.function_name, getattr(kernel, "bytes_bound", None))
    return event


def _call_kernel(kernel: cl.Kernel, queue: cl.CommandQueue, size: Any, group: Any, *args: Any, **options: Any) -> Any:
    event = _original["__call__"](kernel, queue, size, group, *args, **options)
    for watch in _of(queue):
        stage = getattr(kernel, "stage", ARRAYS)
        watch(event, stage, kernel.function_name, _bytes_of(args))
    return event


def _set_changed(kernel: cl.Kernel, args: Sequence[Any], changed: Iterable[int]) -> None:
    _original["set_changed"](kernel, args, changed)
    kernel.bytes_bound = _bytes_of(args)  # type: ignore[attr-defined]


def _bytes_of(arguments: Sequence[Any]) -> int:
    """Return the sum of the sizes of buffers, each counted once."""
    given = (getattr(a, "base_data", a) for a in arguments)
    buffers = {a.int_ptr: a.size for a in given if isinstance(a, cl.MemoryObject)}
    return sum(buffers.values())


def _enqueue_copy(queue: cl.CommandQueue, dest: Any, src: Any, **options: Any) -> Any:
    event = _original["enqueue_copy"](queue, dest, src, **options)
    to_device, from_device = (isinstance(a, cl.MemoryObject) for a in (dest, src))
    name = "copy" if to_device and from_device else "read" if from_device else "write"
    if name == "copy":
        moved = 2 * (options.get("byte_count") or src.size)
    else:
        host = dest if name == "read" else src
        moved = getattr(host, "nbytes", None)
    # A blocking transfer has ended. Its event would keep the host's array in memory.
    done = name != "copy" and options.get("is_blocking", True)
    for watch in _of(queue):
        watch(event, MEMORY, name, moved, done)
    return event


def _enqueue_fill(queue: cl.CommandQueue, dest: Any, pattern: Any, size: int, *args: Any, **options: Any) -> Any:
    event = _original["enqueue_fill"](queue, dest, pattern, size, *args, **options)
    for watch in _of(queue):
        watch(event, MEMORY, "fill", size)
    return event


_HOOKS: tuple[tuple[Any, str, Callable[..., Any]], ...] = (
    (cl, "enqueue_nd_range_kernel", _enqueue_kernel),
    (cl, "enqueue_copy", _enqueue_copy),
    (cl, "enqueue_fill", _enqueue_fill),
    (cl.Kernel, "__call__", _call_kernel),
    (kernels, "set_changed", _set_changed),
)
