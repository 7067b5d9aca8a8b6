"""Runs over the ranks of MPI: bits, sizes and shapes, processor time, and what ranks exchange.

    python bench/parallel.py [--ranks 1,2,4,8] [--cells 10000] [--dims 2,3] [--effort fast] [--periodic]
                             [--sphere] [--polygon] [--random] [--balls 100,80] [--device NAME] [--json]
    python bench/parallel.py --model [--cells 1e7] [--json]

The script starts itself under `mpiexec`; with PoCL each rank has one core. `bits` says whether the diagram of random
points has the same bits as with the first number of ranks. The other columns are of a run in a box, on a sphere, or in
a lake, with sizes from h to 3 h, after the same run once, which loads kernels. `CPU s` is the processor time of its
work, summed over ranks, `host` the part of it that is not kernels and copies on the device, and `over one` the ratio of
`CPU s` to that of the first number of ranks. `waiting` is that of waits for other ranks. `floor` is the ratio for as
many processes at the same time that each make a mesh of n / p cells without messages. `exchanges` and `reductions` are
the rounds of messages between pairs, and of sums over all, per step in which all ranks work; `waits` counts how often a
rank waits for others, as some of both take place at the same time. `ghosts` is the number of ghosts of rank 0 at last
over 2 d (n / p)^((d - 1) / d), an estimate of one layer of cells, and `over least` that of all ranks over the least
possible one: the neighbors of own cells, and in 2D the neighbors of these. `proof` is the same ratio for those ghosts
that prove that all cells are final; the others are room to move. `one round` is the share of diagrams whose cells were
made once, and `asked` how often ranks asked each other for all ghosts anew, over the number of diagrams. `memory` is
the largest device memory of a rank, in the run and while its cells are read, over that of the first number of ranks.
`balls` is the radius in which ranks ask for ghosts, in percent of the usual one. Needs `pip install -e '.[mpi]'`.

`--model` measures nothing: it prints the time of a step on up to 1,000 GPUs with so many cells each, by `MODEL`. Runs
themselves end at 2e9 cells, the limit of 32-bit labels.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from _common import Report, counts, parser, run_ranks, shown
from _kinds import COAST

import clvoro
from clvoro.adaptation.run import Run
from clvoro.opencl import memory_limits
from clvoro.opencl.peers import Ranks
from clvoro.tessellation import part_steps
from clvoro.tessellation.device_diagram import Tessellation
from clvoro.tessellation.part import Part
from clvoro.tessellation.part_steps import NOISE, PartSteps, inside

COLUMNS = {
    "ranks": shown("ranks", "d"),
    "balls": shown("balls", "d"),
    "cells": shown("cells", ",d"),
    "bits": shown("bits", "s"),
    "mean e": shown("error", ".4f"),
    "CPU s": shown("cpu", ".1f"),
    "host": shown("host", ".1f"),
    "waiting": shown("waiting", ".1f"),
    "over one": shown("over_one", ".2f"),
    "floor": shown("floor", ".2f"),
    "iterations": shown("iterations", ".1f"),
    "exchanges": shown("exchanges", ".0f"),
    "reductions": shown("reductions", ".0f"),
    "waits": shown("waits", ".0f"),
    "ghosts": shown("ghosts", ".2f"),
    "over least": shown("over_least", ".2f"),
    "proof": shown("proof", ".2f"),
    "one round": shown("one_round", ".0%"),
    "asked": shown("asked", ".0%"),
    "memory": shown("memory", ".3f"),
}

MODEL = {2: (4.0e8, 22, 16, 8, 3.8), 3: (1.14e7, 22, 19, 26, 2.9)}
"""Of a step, by the dimension: cells that an H200 does in a second ("On a GPU" in RESULTS.md; in 3D those of an update,
most of a step); exchanges, and sums, as in the table "Ranks"; assumed neighbors of a part; measured ghosts over one
layer around a part."""
BANDWIDTH, LATENCY, COPY, SEARCH = 2.5e10, 2e-6, 5.7e-5, {2: 4e-8, 3: 2e-7}
"""Assumed: bytes in a second, over the network and to the host; seconds of a message. Measured: seconds of a copy
between an H200 and its host; of the search for ghosts per cell and step (4e-7 and 1e-6 every 10 and 5 steps)."""
MODEL_COLUMNS = {
    "GPUs": shown("parts", ",d"),
    "cells": shown("cells", ".1e"),
    "ghosts": shown("ghosts", ".1%"),
    **{f"{name} ms": shown(name, ".0f", 1e3) for name in ("compute", "bytes", "latency", "search")},
    "efficiency": shown("efficiency", ".2f"),
}


def model(dim: int, own: float, parts: int) -> dict[str, float]:
    """Return the seconds of a step on so many `parts`, each with `own` cells and a GPU."""
    rate, exchanges, sums, neighbors, layers = MODEL[dim]
    ghosts = 2 * dim * own ** ((dim - 1) / dim) * layers if parts > 1 else 0.0
    # Values of 8 bytes go to the host, over the network and to the device; positions once, of 8 bytes for each axis.
    moved = 3 * 8 * ghosts * (exchanges + dim - 1) / BANDWIDTH
    waits = exchanges * (neighbors * LATENCY + 2 * COPY) + sums * (2 * np.log2(parts) * LATENCY + 2 * COPY)
    of_step = {"compute": (own + ghosts) / rate, "bytes": moved, "latency": waits, "search": own * SEARCH[dim]}
    of_step = of_step if parts > 1 else dict.fromkeys(of_step, 0.0) | {"compute": own / rate}
    shares = {"ghosts": ghosts / own, "efficiency": own / rate / sum(of_step.values())}
    return {"parts": parts, "cells": own * parts, **of_step, **shares}


def least_ghosts(whole: clvoro.Result, labels: list[np.ndarray], layers: int) -> int:
    """Return how many cells of the `whole` mesh are within `layers` of the parts with these `labels`, part by part."""
    starts, found = whole.diagram.neighbor_starts, 0
    owner, other = np.repeat(np.arange(len(whole)), np.diff(starts)), whole.diagram.neighbors
    owner, other, every = owner[other >= 0], other[other >= 0], np.sort(np.concatenate(labels))
    for own in labels:
        known = np.zeros(len(whole), bool)
        known[np.searchsorted(every, own)] = True
        for _ in range(layers):
            known[other[known[owner]]] = True
        found += np.count_nonzero(known) - len(own)
    return found


def proving(steps: PartSteps, part: Part, t: Tessellation) -> int:
    """Return how many ghosts prove that the cells of `t`, the diagram of `part`, are final."""
    engine, n, count = steps.stages.engine, part.n_own, part.n_own + len(steps._rows)
    part, needed = replace(part, count=count, points=part.points[:count]), engine.empty((n, 2), np.float32)
    given = steps._at, steps._limits_there, 2 * (1 + NOISE[engine.real.name]), steps._reads_rows
    part.sums(engine, t, *given, needed, steps._periods)
    x = part.points.get().astype(float)
    return np.count_nonzero(inside(x[n:], np.column_stack([x[:n], needed.get()[:, 0]])))


def measure_rank(options: argparse.Namespace) -> None:
    """Print the figures of all ranks as JSON, on rank 0."""
    from mpi4py import MPI

    os.environ.setdefault(memory_limits.VARIABLE, "1024GiB")  # the memory is counted
    dim, cells, effort, comm = options.rank, options.cells, options.effort, MPI.COMM_WORLD
    rounds, last_made, asked, waited = [], [], [0], [0.0]
    box = clvoro.Box((0,) * dim, (1,) * dim, periodic=options.periodic)
    domain = clvoro.Sphere(0.5) if options.sphere else COAST if options.polygon else box
    x, dim = np.random.default_rng(1).random((cells, dim)) - 0.5 * options.sphere, domain.cell_dim
    x = x[domain.contains(x)] if options.polygon else x
    adapter = clvoro.Adapter(clvoro.create_context(options.device), options.dtype, comm=comm)
    peers, finish = adapter._peers, PartSteps._finished
    part_steps.FIRST_REACH[dim] *= options.balls[0] / 100
    part_steps.GROWTH *= options.balls[0] / 100

    def noted(steps, part, *given):
        before = steps.asked
        found = finish(steps, part, *given)
        asked[0] += steps.asked > before
        if found is not None:
            rounds.append(steps.rounds)
            last_made[:] = steps, part, *given
        return found

    def timed(wait: Callable[..., object]) -> Callable[..., object]:
        def waiting(*given: object) -> object:
            began = time.thread_time()
            answer = wait(*given)
            waited[0] += time.thread_time() - began
            return answer

        return waiting

    Ranks._complete, Ranks._await_call = timed(Ranks._complete), timed(Ranks._await_call)
    PartSteps._finished = noted
    add_row, calls = Run._add_row, []

    def counted(of, progress):
        add_row(of, progress)
        calls.append((peers.count == comm.size, of.steps, peers.exchanges, peers.reductions, peers.waits))

    Run._add_row = counted
    found = adapter.run(domain, cells ** (-1 / dim), points=x, method="lloyd", max_steps=0).gather()
    digest = hashlib.sha256()
    for name in ("neighbors", "volumes", "centroids", "face_measures") if found is not None else ():
        digest.update(np.ascontiguousarray(getattr(found, name)))
    factor = {2: 2 / 3, 3: (13 / 27) ** 0.5}[dim]
    finest = h = factor * (domain.measure / cells) ** (1 / dim)

    def run(by: clvoro.Adapter, h: float) -> tuple[clvoro.Result, np.ndarray]:
        """Return the mesh, and processor time over all ranks: of work, of its part on the host, of waits."""

        def clocks() -> np.ndarray:
            return np.array([time.process_time() - waited[0], time.thread_time() - waited[0], waited[0]])

        comm.Barrier()
        began = clocks()
        points = x[:: round((h / finest) ** dim)] if options.random else None
        mesh = by.run(domain, lambda p: h * (1 + 2 * (p[:, 0] - domain.lower[0])), effort, points=points)
        return mesh, comm.allreduce(clocks() - began)

    run(adapter, h)
    single = clvoro.Adapter(adapter.ctx, options.dtype, comm=MPI.COMM_SELF)
    run(single, 4 * h)
    alone = run(single, h * comm.size ** (1 / dim))[1][0]
    rounds.clear()
    calls.clear()
    asked[0] = 0
    del found, single
    gc.collect()
    memory_limits.MOST_TAKEN.clear()
    mesh, (spent, host, waits) = run(adapter, h)
    _ = [getattr(mesh.diagram, name) for name in clvoro.Diagram._NAMES if name in dir(mesh.diagram)]
    taken = comm.allreduce(max(memory_limits.MOST_TAKEN.values()), MPI.MAX)
    ghosts = len(last_made[0]._rows) if comm.size > 1 else 0
    of_all, proof = comm.allreduce(np.array([ghosts, proving(*last_made) if comm.size > 1 else 0]))
    whole, labels = mesh.gather(), comm.gather(mesh.parts.labels if mesh.parts else np.arange(len(mesh)))
    layer = 2 * dim * (mesh.history["cells"][-1] / comm.size) ** ((dim - 1) / dim)
    if comm.rank == 0:
        last, together = mesh.history[-1], np.array([row[1:] for row in calls if row[0]])
        done, exchanges, reductions, halts = together[-1] - together[0]
        least = max(least_ghosts(whole, labels, 4 - dim), 1)
        figures = {
            "ranks": comm.size,
            "balls": options.balls[0],
            "cells": int(last["cells"]),
            "digest": digest.hexdigest(),
            "error": float(last["mean_error"]),
            "cpu": spent,
            "host": host,
            "waiting": waits,
            "least": alone,
            "iterations": float(mesh.history["iterations"].sum() / last["step"]),
            "exchanges": exchanges / done,
            "reductions": reductions / done,
            "waits": halts / done,
            "ghosts": ghosts / layer,
            "over_least": float(of_all / least),
            "proof": float(proof / least),
            "one_round": float(np.mean(np.array(rounds) == 1)) if comm.size > 1 else 1.0,
            "taken": float(taken),
            "asked": asked[0] / len(rounds) if comm.size > 1 else 0.0,
        }
        print(json.dumps(figures))


def main() -> None:
    """Measure each number of ranks, and print a table for each dimension."""
    p = parser(__doc__)
    p.add_argument("--ranks", type=counts, default=[1, 2, 4, 8], help="numbers of ranks")
    p.add_argument("--cells", type=float, help="number of cells: by default 10,000, and 1e7 for each GPU of the model")
    p.add_argument("--dims", type=counts, default=[2, 3], help="dimensions")
    p.add_argument("--effort", default="fast", help="effort of the run")
    p.add_argument("--periodic", action="store_true", help="a box without walls")
    p.add_argument("--sphere", action="store_true", help="a sphere in place of boxes")
    p.add_argument("--polygon", action="store_true", help="a lake in place of boxes")
    p.add_argument("--balls", type=counts, default=[100], help="percent of the usual radius of balls")
    p.add_argument("--random", action="store_true", help="begin with random generators")
    p.add_argument("--rank", type=int, help="dimension for which each rank measures; used by the script itself")
    p.add_argument("--model", action="store_true", help="print the model of a step on many GPUs")
    options = p.parse_args()
    options.cells = int(options.cells or (1e7 if options.model else 1e4))
    if options.model:
        for dim in options.dims:
            table = Report(options.json, MODEL_COLUMNS)
            for parts in (1, 8, 64, 1000):
                table.add(model(dim, options.cells, parts))
            table.finish(f"Model of a step in {dim}D")
        return
    if options.rank:
        measure_rank(options)
        return
    for dim in [3] if options.sphere else [2] if options.polygon else options.dims:
        table, first = Report(options.json, COLUMNS), {}
        for ranks, balls in [(ranks, balls) for ranks in options.ranks for balls in options.balls]:
            found = run_ranks(ranks, [__file__, *sys.argv[1:], f"--rank={dim}", f"--balls={balls}"], check=True)
            record = json.loads(found.stdout.splitlines()[-1])
            first = first or record
            bits = {"bits": "same" if record["digest"] == first["digest"] else "differ"}
            ratios = {"over_one": "cpu", "floor": "least", "memory": "taken"}
            table.add(record | bits | {ratio: record[name] / first[name] for ratio, name in ratios.items()})
        table.finish(f"Ranks {'on a sphere' if options.sphere else f'in {dim}D'}, effort {options.effort}")


if __name__ == "__main__":
    main()
