"""The tessellation alone: time of each stage, cold and warm-started, uniform and graded.

    python bench/diagram.py [--dim 3] [--sizes 1e4,1e5,1e6,4e6] [--sets uniform,cubed,radial,hexagonal]
                            [--move 0.1] [--scipy] [--repeat 5] [--processor-time] [--device NAME]
                            [--dtype float32] [--json]

With `--dim 3` the unit cube: "uniform", "radial" with sizes 1 : 1000 around an empty
ball, "core", the same with the ball filled, and "bcc", the body-centered cubic lattice, jittered
likewise. Cells at the empty ball are cones to its center, each near hundreds of others; "core" has the
cost of grading alone. Areas and moments are then part of "clip".

Point sets in the unit square, random with a fixed seed: "uniform"; "cubed", uniform with x -> x^3
in both coordinates; "radial", spacing in proportion to the distance from the center, sizes
1 : 10 000; "hexagonal", a lattice jittered by a tenth of its spacing, as a finished mesh is.

Times are medians of `--repeat` after a first call, from an idle queue to an idle queue, in
milliseconds:
  order    binning generators in any order, and bringing them into the order of the bins
  bins     the binning of ordered generators, where they have moved
  diagram  clipping, matching, scan, areas, centroids, faces, graph
"clip", "match" and "measure" are the device's own times of the kernels in "diagram", by its
events. Warm rows: the generators move by up to `--move` times the distance to the nearest other, and
the diagram is updated ("clip": check which cells keep their neighbors, clip the others), without
binning. Rates are millions of cells per second: of clipping alone; from binning to graph; and from
"order" to graph, which is a diagram of points in any order: these need no further binning. With
`--scipy` SciPy's Voronoi of the same points runs too (vertices and regions, no areas), up to
`--scipy-up-to` cells; "x SciPy" compares it with the last of the rates.

With `--processor-time`, seconds are the processor time of this process over the device's compute units (SciPy: over
one): the time of an idle CPU.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from _common import CUBE, SQUARE, Report, best, clock_of, counts, heading, make_adapter, names, parser, shown

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.opencl.hooks import watching
from clvoro.opencl.profile import Profile, profiled_queue
from clvoro.tessellation.stages import TessellationStages
from clvoro.tessellation.tessellator import Tessellator

SEED = 7919
RATIO = 1e4
RATIO_3D = 1e3
JITTER = 0.1


def radial(n: int, rng: np.random.Generator) -> np.ndarray:
    """Points of density 1 / r^2 between r = R / 10 000 and the corners, R = sqrt(1/2)."""
    kept: list[np.ndarray] = []
    while sum(map(len, kept)) < n:
        r = math.sqrt(0.5) * RATIO ** -rng.random(n)
        turn = 2 * np.pi * rng.random(n)
        p = 0.5 + r[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
        kept.append(p[((p >= 0) & (p <= 1)).all(axis=1)])
    return np.concatenate(kept)[:n]


def hexagonal(n: int, rng: np.random.Generator) -> np.ndarray:
    """Jittered triangular lattice in random order, of about n points."""
    a = math.sqrt(2 / (math.sqrt(3) * n))
    rows, columns = round(1 / (a * math.sqrt(0.75))), round(1 / a)
    y, x = np.mgrid[0:rows, 0:columns].astype(float)
    p = np.column_stack([((x + 0.5 * (y % 2) + 0.25) / columns).ravel(), ((y + 0.5) / rows).ravel()])
    p += JITTER * a * (rng.random(p.shape) - 0.5) * 2
    return rng.permutation(np.clip(p, 0, 1))


def radial_3d(n: int, rng: np.random.Generator) -> np.ndarray:
    """Points of density 1 / r^3 between r = R / 1000 and the corners, R = sqrt(3/4)."""
    kept: list[np.ndarray] = []
    while sum(map(len, kept)) < n:
        r = math.sqrt(0.75) * RATIO_3D ** -rng.random(n)
        v = rng.standard_normal((n, 3))
        p = 0.5 + (r / np.linalg.norm(v, axis=1))[:, None] * v
        kept.append(p[((p >= 0) & (p <= 1)).all(axis=1)])
    return np.concatenate(kept)[:n]


def core_3d(n: int, rng: np.random.Generator) -> np.ndarray:
    """Points as of `radial_3d`, and of their density at r = R / 1000 within."""
    p, least = radial_3d(n, rng), math.sqrt(0.75) / RATIO_3D
    # Of the density c / r^3 there are 4 pi c log(3/2) up to 3/2 R / 1000, and 4 pi c / 3 in the ball.
    near = int((np.linalg.norm(p - 0.5, axis=1) < 1.5 * least).sum() / (3 * math.log(1.5)))
    v = rng.standard_normal((near, 3))
    r = least * rng.random(near) ** (1 / 3)
    inner = 0.5 + (r / np.linalg.norm(v, axis=1))[:, None] * v
    return rng.permutation(np.concatenate([inner, p]))[:n]


def bcc_3d(n: int, rng: np.random.Generator) -> np.ndarray:
    """Jittered body-centered cubic lattice in random order, of about n points."""
    k = max(1, round((n / 2) ** (1 / 3)))
    p = np.stack(np.meshgrid(*[np.arange(k, dtype=float)] * 3), axis=-1).reshape(-1, 3)
    p = np.concatenate([p + 0.25, p + 0.75]) / k
    p += JITTER * math.sqrt(0.75) / k * (rng.random(p.shape) - 0.5) * 2
    return rng.permutation(np.clip(p, 0, 1))


PointSet = Callable[[int, np.random.Generator], np.ndarray]
SETS: dict[str, PointSet] = {
    "uniform": lambda n, rng: rng.random((n, 2)),
    "cubed": lambda n, rng: rng.random((n, 2)) ** 3,
    "radial": radial,
    "hexagonal": hexagonal,
}
SETS_3D: dict[str, PointSet] = {"uniform": lambda n, rng: rng.random((n, 3))}
SETS_3D |= {f.__name__[:-3]: f for f in (radial_3d, core_3d, bcc_3d)}


KERNELS = {
    "clip": ("walk", "wrap", "clip", "check", "list", "place", "update"),
    "match": ("match",),
    "measure": ("measure",),
}
"""Columns, each with the beginnings of the names of its kernels."""


Clock = Callable[[], float]


def median_time(queue: Any, repeat: int, function: Callable[[], object], clock: Clock) -> float:
    """Median seconds of `function`, from an idle queue to an idle queue, after a first call."""
    times = []
    for k in range(repeat + 1):
        queue.finish()
        start = clock()
        function()
        queue.finish()
        if k:
            times.append(clock() - start)
    return statistics.median(times)


class Diagrams:
    """Diagrams on one queue, over generators in the order of their bins."""

    def __init__(self, engine: Engine, points: np.ndarray) -> None:
        self.n, self.box = len(points), SQUARE if engine.dim == 2 else CUBE
        self.stages = TessellationStages(engine)
        self.tessellator = Tessellator(self.stages, self.box)
        self.given = engine.upload(points)
        self.points = self.order()
        self.turn = 0

    def order(self) -> Any:
        """Bin the generators as given; return them in the order of the bins, as `Adapter.diagram` does."""
        bins = self.stages.bins
        self.binned = bins.build(self.box, self.given, self.n)
        self.labels = self.binned.items[: self.n].copy()
        points = self.binned.points[: self.n].copy()
        bins.renumber(self.binned, self.n)
        self.reach = None
        return points

    def bin(self) -> None:
        """Bin the ordered generators."""
        self.binned = self.stages.bins.build(self.box, self.points, self.n)
        self.reach = None

    def diagram(self) -> Any:
        """Tessellate without a previous diagram, with the initial radii of the binning."""
        if self.reach is None:
            self.reach = self.binned.reach.copy()
        else:
            self.binned.reach[:] = self.reach
        self.t = self.tessellator.tessellate(self.points, self.n, binned=self.binned)
        return self.t

    def prepare_warm(self, rng: np.random.Generator, move: float) -> None:
        """Move the generators to and fro by `move` times the distance to the nearest other."""
        self.bin()
        t, host = self.diagram(), self.points.get()
        starts = t.starts.get()
        neighbors = t.neighbors.get()[: starts[-1]]
        d = host[neighbors] - np.repeat(host, np.diff(starts), axis=0)
        d = np.where(neighbors >= 0, np.linalg.norm(d, axis=1), np.inf)
        nearest = np.minimum.reduceat(d, starts[:-1])
        moved = host + move * nearest[:, None] * (rng.random(host.shape) - 0.5) * math.sqrt(2)
        self.places = [self.points, self.stages.engine.upload(np.clip(moved, 0, 1))]
        # Capacities grow in a new diagram, not in an update.
        self.tessellator.tessellate(self.places[1], self.n)
        self.t = self.tessellator.tessellate(self.points, self.n)

    def diagram_warm(self) -> None:
        """Update the diagram to the moved generators, back, and so on."""
        self.turn = 1 - self.turn
        self.t = self.tessellator.tessellate(self.places[self.turn], self.n, self.t)


def kernel_times(queue: Any, repeat: int, function: Callable[[], object], clock: Clock | None) -> dict[str, float]:
    """Median times of the kernels of "diagram": the device's own, or by `clock`, one by one."""
    function()
    times: dict[str, list[float]] = {name: [] for name in KERNELS}
    for _ in range(repeat):
        costs = device_times(queue, function) if clock is None else own_times(queue, function, clock)
        for name, seen in times.items():
            seen.append(sum(s for kernel, s in costs if kernel.startswith(KERNELS[name])))
    return {name: statistics.median(seen) for name, seen in times.items()}


def device_times(queue: Any, function: Callable[[], object]) -> list[tuple[str, float]]:
    with Profile(queue) as profile:
        function()
    return [(kernel, cost.seconds) for (_, kernel), cost in profile.costs.items()]


def own_times(queue: Any, function: Callable[[], object], clock: Clock) -> list[tuple[str, float]]:
    costs = []
    queue.finish()
    before = clock()

    def watch(event: Any, _stage: str, name: str, *_: object, **__: object) -> None:
        nonlocal before
        event.wait()
        costs.append((name, clock() - before))
        before = clock()

    with watching(queue, watch):
        function()
    return costs


def sets_of(options: argparse.Namespace) -> dict[str, Callable[..., np.ndarray]]:
    return SETS if options.dim == 2 else SETS_3D


def measure(adapter: clvoro.Adapter, name: str, n: int, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the records of one set: cold and warm."""
    rng = np.random.default_rng(SEED + n)
    points = sets_of(options)[name](n, rng).astype(adapter.dtype)
    repeat, clock = options.repeat, clock_of(options, adapter)
    kernel_clock = clock if options.processor_time else None
    plain = Diagrams(Engine(adapter.ctx, adapter.queue, options.dim, adapter.dtype), points)
    queue = adapter.queue
    order = median_time(queue, repeat, plain.order, clock)
    bins = median_time(queue, repeat, plain.bin, clock)
    cold = median_time(queue, repeat, plain.diagram, clock)
    plain.prepare_warm(rng, options.move)
    warm = median_time(queue, repeat, plain.diagram_warm, clock)
    del plain

    queue = profiled_queue(adapter.ctx)
    timed = Diagrams(Engine(adapter.ctx, queue, options.dim, adapter.dtype), points)
    timed.bin()
    cold_kernels = kernel_times(queue, repeat, timed.diagram, kernel_clock)
    timed.prepare_warm(rng, options.move)
    warm_kernels = kernel_times(queue, repeat, timed.diagram_warm, kernel_clock)
    del timed

    n = len(points)
    records = []
    for start, seconds, binning, kernels in (("cold", cold, bins, cold_kernels), ("warm", warm, 0.0, warm_kernels)):
        record: dict[str, Any] = {
            "set": name,
            "cells": n,
            "start": start,
            "bins": binning,
            "diagram": seconds,
            **kernels,
            "clip_rate": n / kernels["clip"],
            "graph_rate": n / (binning + seconds),
        }
        if start == "cold":
            record |= {"order": order, "whole_rate": n / (order + seconds)}
        records.append(record)
    if options.scipy and n <= options.scipy_up_to:
        records[0]["scipy"] = scipy_time(points, clock_of(options))
        records[0]["over_scipy"] = records[0]["scipy"] * records[0]["whole_rate"] / n
    return records


def scipy_time(points: np.ndarray, clock: Callable[[], float]) -> float:
    from scipy.spatial import Voronoi

    return best(1, lambda: Voronoi(points), clock)[0]


COLUMNS = {
    "points": lambda r: r["set"],
    "cells": lambda r: f"{r['cells']:,}",
    "start": lambda r: r["start"],
    "order ms": shown("order", ".1f", 1e3),
    "bins ms": shown("bins", ".1f", 1e3),
    "diagram ms": shown("diagram", ".1f", 1e3),
    "clip ms": shown("clip", ".1f", 1e3),
    "match ms": shown("match", ".1f", 1e3),
    "measure ms": shown("measure", ".1f", 1e3),
    "clip M/s": shown("clip_rate", ".2f", 1e-6),
    "bins to graph M/s": shown("graph_rate", ".2f", 1e-6),
    "order to graph M/s": shown("whole_rate", ".2f", 1e-6),
    "SciPy s": shown("scipy", ".2f"),
    "x SciPy": shown("over_scipy", ".0f"),
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[10**4, 10**5, 10**6, 4 * 10**6])
    options_of.add_argument("--dim", type=int, choices=(2, 3), default=2)
    options_of.add_argument("--sets", type=names, help=f"{', '.join(SETS)}; in 3D {', '.join(SETS_3D)}")
    options_of.add_argument("--move", type=float, default=0.1)
    options_of.add_argument("--repeat", type=int, default=5)
    options_of.add_argument("--scipy", action="store_true")
    options_of.add_argument("--processor-time", action="store_true")
    options_of.add_argument("--scipy-up-to", type=float, default=1e6, metavar="N")
    options = options_of.parse_args()
    known = sets_of(options)
    options.sets = list(known) if options.sets is None else options.sets
    if unknown := set(options.sets) - set(known):
        options_of.error(f"no set {', '.join(unknown)}; there are {', '.join(known)}")

    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    for name in options.sets:
        for n in options.sizes:
            try:
                for record in measure(adapter, name, n, options):
                    report.add(record, f"{name} {n:,} {record['start']}")
            except clvoro.ClvoroError as error:
                print(f"{name} {n:,}: {error}", file=sys.stderr)
    report.finish(heading(adapter, f"Diagram alone, medians of {options.repeat}"))


if __name__ == "__main__":
    main()
