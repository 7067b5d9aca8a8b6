"""`adapt`, `voronoi` and more: what most callers need, as methods of one adapter for all of them."""

from __future__ import annotations

import functools
import inspect
import threading
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from .adapter import Adapter
from .errors import DeviceError
from .io import READERS
from .io.foam_read import load_foam
from .io.vtu_read import load_pvtu

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")

_shared: Adapter | None = None
_sharing = threading.Lock()


def shared_adapter() -> Adapter:
    """Return the adapter of `adapt` and `voronoi`, on the best device; it is created by the first call.

    It computes in float64, or in float32 if no device computes in float64.
    """
    global _shared
    with _sharing:
        if _shared is None:
            try:
                _shared = Adapter()
            except DeviceError:
                _shared = Adapter(dtype="float32")
        return _shared


def _by_all(name: str, method: Callable[Concatenate[Adapter, Arguments], Answer]) -> Callable[Arguments, Answer]:
    """Return `method` of the shared adapter as a function `name`, with its signature and docstring."""

    @functools.wraps(method)
    def call(*args: Arguments.args, **options: Arguments.kwargs) -> Answer:
        return method(shared_adapter(), *args, **options)

    signature = inspect.signature(method)
    call.__signature__ = signature.replace(parameters=list(signature.parameters.values())[1:])  # type: ignore[attr-defined]
    call.__name__ = call.__qualname__ = name
    call.__module__ = __name__
    del call.__wrapped__  # type: ignore[attr-defined]
    return call


adapt = _by_all("adapt", Adapter.run)
voronoi = _by_all("voronoi", Adapter.diagram)
power_diagram = _by_all("power_diagram", Adapter.power_diagram)
transport = _by_all("transport", Adapter.transport)

READERS[".pvtu"] = functools.partial(load_pvtu, tessellate=voronoi)
READERS[".foam"] = functools.partial(load_foam, tessellate=voronoi)
