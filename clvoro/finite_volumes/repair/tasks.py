"""Repair several patches in step, so that all moves that they wait for are found in one go.

A task is a generator. It yields the moves that it needs next, receives the patches after these moves, and returns its
result.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from ...geometry.ring_coordinate import RingCoordinate
from .moves import minimize
from .pricing import PricedPatch

_T = TypeVar("_T")


class Move(NamedTuple):
    """The points of some cells of a patch are to move.

    Attributes
    ----------
    patch : PricedPatch
    near : (n,) bool
        The cells.
    slide : bool
        Whether points on walls slide along the boundary or stay.
    steps : int
        Most steps towards the minimum.
    """

    patch: PricedPatch
    near: np.ndarray
    slide: bool
    steps: int


Task = Generator[list[Move], list[PricedPatch], _T]


def moved(moves: Sequence[Move], ring: RingCoordinate | None) -> list[PricedPatch]:
    """Return the patch after each of the `moves`; points on walls slide along `ring`."""
    problems = [move.patch.problem(move.near, move.slide) for move in moves]
    posed = [(p, move.steps) for p, move in zip(problems, moves, strict=True) if p is not None]
    found = iter(minimize(*zip(*posed, strict=True), ring) if posed else ())
    return [
        move.patch if p is None else move.patch.moved(p, next(found), ring)
        for p, move in zip(problems, moves, strict=True)
    ]


def in_step(tasks: Sequence[Task[_T]]) -> Task[list[_T]]:
    """Run all `tasks`, and return their results."""
    results: dict[int, _T] = {}
    waiting: dict[int, list[Move]] = {}

    def go_on(i: int, found: list[PricedPatch] | None) -> None:
        try:
            waiting[i] = tasks[i].send(found) if found is not None else next(tasks[i])
        except StopIteration as end:
            results[i] = end.value
            waiting.pop(i, None)

    for i in range(len(tasks)):
        go_on(i, None)
    while waiting:
        found = iter((yield [move for moves in waiting.values() for move in moves]))
        for i, moves in list(waiting.items()):
            go_on(i, [next(found) for _ in moves])
    return [results[i] for i in range(len(tasks))]


def run_task(task: Task[_T], ring: RingCoordinate | None) -> _T:
    """Run a task, and return its result; points on walls slide along `ring`."""
    try:
        moves = next(task)
        while True:
            moves = task.send(moved(moves, ring))
    except StopIteration as end:
        result: _T = end.value
        return result
