"""Work-groups as a GPU has them, on any device: of many work-items, with local memory and barriers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from clvoro.opencl import engine


def use_groups(size: int, count: int = 16) -> None:
    """Make all later engines use `count` groups of `size`, also on a CPU. By default its groups have one work-item."""
    engine.group_sizes = lambda _: engine.GroupSizes(count, size)


@contextmanager
def groups(size: int, count: int = 16) -> Iterator[None]:
    """Let engines made inside the ``with`` block work in groups; see `use_groups`."""
    before = engine.group_sizes
    use_groups(size, count)
    try:
        yield
    finally:
        engine.group_sizes = before
