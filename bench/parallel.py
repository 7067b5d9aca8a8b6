"""Runs over the ranks of MPI: bits, sizes and shapes, processor time, and what ranks exchange.

    python bench/parallel.py [--ranks 1,2,4,8] [--cells 10000] [--dims 2,3] [--effort fast]

For each number of ranks the script starts itself under `mpiexec`; with PoCL each rank has one core. Diagrams are of
random points; `bits` says whether they are those of the first number of ranks. Runs are in a box with sizes from h to
3 h. `CPU s` is the processor time of the runs, without that of their start, summed over ranks. `exchanges` and
`reductions` are per step: all calls of point-to-point messages, and of collective ones. `ghosts` are those of the last
diagram over the estimate of one layer of cells around each part, 2 d (n / p)^((d - 1) / d) cells at most. `rounds`: how
often the cells of a diagram were made, in the mean. Needs `pip install -e '.[mpi]'`.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from _common import Report, counts, parser

import clvoro
from clvoro.tessellation.part_steps import PartSteps

COLUMNS = {
    "ranks": lambda r: r["ranks"],
    "cells": lambda r: f"{r['cells']:,}",
    "bits": lambda r: r["bits"],
    "mean e": lambda r: f"{r['error']:.4f}",
    "mean Q": lambda r: f"{r['quality']:.4f}",
    "CPU s": lambda r: f"{r['cpu']:.1f}",
    "iterations": lambda r: f"{r['iterations']:.1f}",
    "exchanges": lambda r: f"{r['exchanges']:.0f}",
    "reductions": lambda r: f"{r['reductions']:.0f}",
    "ghosts": lambda r: f"{r['ghosts']:.2f}",
    "rounds": lambda r: f"{r['rounds']:.2f}",
}


def measure_rank(dim: int, cells: int, effort: str) -> None:
    """Print the figures of all ranks as JSON, on rank 0."""
    from mpi4py import MPI

    comm, box = MPI.COMM_WORLD, clvoro.Box((0,) * dim, (1,) * dim)
    adapter, rounds, ghosts = clvoro.Adapter(comm=comm), [], [0]
    finish = PartSteps.finish

    def noted(steps, part, *given):
        found = finish(steps, part, *given)
        if found is not None:
            rounds.append(steps.rounds)
            ghosts[0] = part.count - part.n_own
        return found

    PartSteps.finish = noted
    x = np.random.default_rng(1).random((cells, dim))
    options = {"points": x, "method": "lloyd", "max_steps": 0}
    whole = adapter.run(box, cells ** (-1 / dim), **options).gather()
    digest = hashlib.sha256()
    for name in ("neighbors", "volumes", "centroids", "face_measures") if whole is not None else ():
        digest.update(np.ascontiguousarray(getattr(whole, name)))
    factor = {2: 2 / 3, 3: (13 / 27) ** 0.5}[dim]
    h = factor * cells ** (-1 / dim)
    adapter.run(box, lambda p: 4 * h * (1 + 2 * p[:, 0]), effort)  # builds kernels
    rounds.clear()
    began, calls = time.process_time(), (adapter._peers.exchanges, adapter._peers.reductions)
    mesh = adapter.run(box, lambda p: h * (1 + 2 * p[:, 0]), effort)
    spent = comm.allreduce(time.process_time() - began)
    steps = int(mesh.history["step"][-1])
    per_part = mesh.history["cells"][-1] / comm.size
    layer = 2 * dim * per_part ** ((dim - 1) / dim)
    if comm.rank == 0:
        last = mesh.history[-1]
        figures = {
            "ranks": comm.size,
            "cells": int(last["cells"]),
            "digest": digest.hexdigest(),
            "error": float(last["mean_error"]),
            "quality": float(last["mean_quality"]),
            "cpu": spent,
            "iterations": float(mesh.history["iterations"].sum() / steps),
            "exchanges": (adapter._peers.exchanges - calls[0]) / steps,
            "reductions": (adapter._peers.reductions - calls[1]) / steps,
            "ghosts": ghosts[0] / layer,
            "rounds": float(np.mean(rounds)) if rounds else 1.0,
        }
        print(json.dumps(figures))


def main() -> None:
    """Measure each number of ranks, and print a table for each dimension."""
    p = parser(__doc__)
    p.add_argument("--ranks", type=counts, default=[1, 2, 4, 8], help="numbers of ranks")
    p.add_argument("--cells", type=int, default=10_000, help="number of cells")
    p.add_argument("--dims", type=counts, default=[2, 3], help="dimensions")
    p.add_argument("--effort", default="fast", help="effort of the run")
    p.add_argument("--rank", type=int, help="used by the script itself")
    options = p.parse_args()
    if options.rank:
        measure_rank(options.rank, options.cells, options.effort)
        return
    mpiexec = Path(sys.executable).parent / "mpiexec"
    environment = {**os.environ, "POCL_MAX_PTHREAD_COUNT": "1"}
    for dim in options.dims:
        table, first = Report(options.json, COLUMNS), ""
        for ranks in options.ranks:
            command = [
                str(mpiexec if mpiexec.exists() else "mpiexec"),
                "-n",
                str(ranks),
                sys.executable,
                "-W",
                "ignore",
            ]
            given = ["--rank", str(dim), "--cells", str(options.cells), "--effort", options.effort]
            found = subprocess.run([*command, __file__, *given], env=environment, stdout=subprocess.PIPE, check=True)
            record = json.loads(found.stdout.splitlines()[-1])
            first = first or record["digest"]
            table.add(record | {"bits": "same" if record["digest"] == first else "differ"})
        table.finish(f"Ranks in {dim}D, effort {options.effort}")


if __name__ == "__main__":
    main()
