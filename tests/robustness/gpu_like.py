"""Work-groups as a GPU has them, on any device: of many work-items, with local memory and barriers."""

from clvoro.opencl.program import Engine


def use_groups(size: int, count: int = 16) -> None:
    """Let every engine made from now on work in `count` groups of `size`, where a CPU takes groups of one."""
    made = Engine.__post_init__

    def like_a_gpu(self: Engine) -> None:
        made(self)
        object.__setattr__(self, "groups", count)
        object.__setattr__(self, "group_size", size)

    Engine.__post_init__ = like_a_gpu
