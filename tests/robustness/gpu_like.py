"""The path that GPUs take, on any device: scalar kernels, groups of many work-items, launches in ranges."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

from clvoro.opencl import engine, launch, ranges
from clvoro.solvers import poisson
from clvoro.tessellation import back_ends

LONGEST = 2e-3
"""Seconds after which a launch is divided in tests, so that those of small meshes are, too."""


def use_groups(size: int, count: int = 16) -> None:
    """Make all later engines use `count` groups of `size`, also on a CPU. By default its groups have one work-item.

    Solvers choose their preconditioners as on a GPU.
    """
    engine.group_sizes = lambda _: engine.GroupSizes(count, size)
    poisson.cost_factors = lambda _: launch.COSTS_ON_GPU


def use_ranges() -> None:
    """Divide launches of every engine made from now on as on a device that may interrupt long ones."""
    engine.ranges = SimpleNamespace(may_be_interrupted=lambda _: True)
    ranges.FIRST, ranges.LONGEST = 256, LONGEST


@contextmanager
def groups(size: int, count: int = 16) -> Iterator[None]:
    """Let engines made inside the ``with`` block work in groups; see `use_groups`."""
    before = engine.group_sizes, poisson.cost_factors
    use_groups(size, count)
    try:
        yield
    finally:
        engine.group_sizes, poisson.cost_factors = before


@contextmanager
def by_teams(wanted: bool) -> Iterator[None]:
    """Let teams build the cells in 3D of engines made inside the ``with`` block, or not, on any device."""
    before, back_ends.teams_are_faster = back_ends.teams_are_faster, lambda _: wanted
    try:
        yield
    finally:
        back_ends.teams_are_faster = before
