"""Processor time of the thread that calls clvoro, by part of a run.

On PoCL, kernels run in other threads, so this is the time of the host. On a GPU a driver may also spend time of this
thread while it waits. Timers take some 2 us per call, so the sum exceeds the time of an untimed run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import pyopencl as cl

from clvoro.adaptation import run
from clvoro.adaptation.plan import actions
from clvoro.mesh import diagram
from clvoro.opencl import device_array, engine, kernels, launch, workspace

REST = "other"
PLACES: dict[str, list[tuple[Any, str]]] = {
    "commands: kernels": [(cl, "enqueue_nd_range_kernel")],
    "commands: copies, reads, fills": [(cl, "enqueue_copy"), (cl, "enqueue_fill")],
    "arguments of kernels": [(engine, "bind"), (launch, "bind")],
    "making arrays": [
        (device_array, "make_array"),
        (engine, "make_array"),
        (workspace, "make_array"),
        (workspace.Workspace, "take"),
        (device_array.DeviceArray, "__getitem__"),
    ],
    "preparation, start": [(run, "prepare"), (run, "start")],
    "steps": [(actions.Step, "apply")],
    "history": [(run.Run, "_add_row")],
    "insertion, deletion, refinement": [
        (action, "apply") for action in (actions.InsertDelete, actions.CorrectCount, actions.Refine)
    ],
    "result": [(run.Run, "_read_result")],
    "reading the diagram": [(diagram.Diagram, "__getattr__")],
}
"""Functions by part. A function's time does not include that of other parts that it calls."""


@dataclass
class Parts:
    """Calls and seconds by part."""

    calls: dict[str, int] = field(default_factory=lambda: dict.fromkeys([*PLACES, REST], 0))
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys([*PLACES, REST], 0.0))
    _inner: list[float] = field(default_factory=list)

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return `function` with its time added to `part`."""

        def run(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            start = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                spent = time.thread_time() - start
                self.calls[part] += 1
                self.seconds[part] += spent - self._inner.pop()
                if self._inner:
                    self._inner[-1] += spent

        return run


@contextmanager
def host_parts() -> Iterator[Parts]:
    """Time the parts of all runs inside the ``with`` block."""
    parts = Parts()
    original = kernels.bind, device_array.make_array
    with ExitStack() as stack:
        for part, places in PLACES.items():
            for place, name in places:
                stack.enter_context(patch.object(place, name, parts.timed(part, getattr(place, name))))
        yield parts
    assert original == (kernels.bind, device_array.make_array)
