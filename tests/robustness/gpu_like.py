"""Work-groups as a GPU has them, on any device: of many work-items, with local memory and barriers."""

from clvoro.opencl import engine


def use_groups(size: int, count: int = 16) -> None:
    """Let every engine made from now on work in `count` groups of `size`, where a CPU takes groups of one."""
    engine.group_sizes = lambda _: engine.GroupSizes(count, size)
