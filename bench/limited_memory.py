"""A run on devices with too little memory for the whole mesh: refused on one device, done over ranks.

    python bench/limited_memory.py [--cells 60000] [--share 0.2] [--ranks 16] [--dim 2] [--effort fast]
                                   [--device NAME] [--dtype float32] [--json]

`CLVORO_MEMORY_LIMIT` lets a process take a share of the memory that one device needs for the run. In one part the run
is refused before it begins. Over ranks, each a process with the same limit, it is done, and its pieces are written.
`needed` is the estimate for one part, and `taken` the most that a rank has allocated; both and the limit are in MiB.
Parts have ghosts besides their own cells, and up to a tenth more cells than the mean, so that a share of 0.2 needs more
than 5 parts. Needs `pip install -e '.[mpi]'`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path

from _common import Report, parser, run_ranks, shown

import clvoro
from clvoro.opencl.memory_limits import MOST_TAKEN, VARIABLE

COLUMNS = {
    "parts": shown("parts", "d"),
    "cells": shown("cells", ",d"),
    "limit": shown("limit", ".1f"),
    "needed": shown("needed", ".1f"),
    "taken": shown("taken", ".1f"),
    "result": shown("result", "s"),
}
MIB = 2**20


def case_of(options: argparse.Namespace) -> tuple[clvoro.Box, float]:
    """Return the domain and the size."""
    return clvoro.Box((0,) * options.dim, (1,) * options.dim), options.cells ** (-1 / options.dim)


def run_rank(options: argparse.Namespace) -> None:
    """Run on this rank, and write its piece; rank 0 prints the figures of all as JSON."""
    from mpi4py import MPI

    comm, needed = MPI.COMM_WORLD, []
    adapter = clvoro.Adapter(clvoro.create_context(options.device), options.dtype, comm=comm)
    adapter.on_memory = needed.append
    mesh = adapter.run(*case_of(options), options.effort)
    mesh.save(Path(options.folder) / "mesh.pvtu")
    taken = comm.reduce(MOST_TAKEN[adapter.devices[0]], MPI.MAX)
    if comm.rank == 0:
        print(json.dumps({"cells": int(mesh.history["cells"][-1]), "needed": needed[0] / MIB, "taken": taken / MIB}))


def main() -> None:
    """Run in one process and over ranks, and print a table."""
    p = parser(__doc__)
    p.add_argument("--cells", type=lambda text: round(float(text)), default=60_000)
    p.add_argument("--share", type=float, default=0.2, help="limit, as a share of the memory that one device needs")
    p.add_argument("--ranks", type=int, default=16, help="number of parts")
    p.add_argument("--dim", type=int, choices=(2, 3), default=2)
    p.add_argument("--effort", choices=("fast", "default", "best"), default="fast")
    p.add_argument("--folder", help="of the pieces; used by the script itself")
    options = p.parse_args()
    if options.folder:
        run_rank(options)
        return
    adapter = clvoro.Adapter(clvoro.create_context(options.device), options.dtype)
    domain, size = case_of(options)
    needed = adapter.memory_needed(domain, size)
    limit = options.share * needed
    os.environ[VARIABLE] = str(limit)
    report, row = Report(options.json, COLUMNS), {"limit": limit / MIB}
    try:
        adapter.run(domain, size, options.effort)
        result = "done"
    except clvoro.errors.MemoryLimitError as error:
        result = "refused"
        print(error, file=sys.stderr)
    cells = {"cells": options.cells, "needed": needed / MIB, "taken": MOST_TAKEN[adapter.devices[0]] / MIB}
    report.add({**row, **cells, "parts": 1, "result": result})
    with tempfile.TemporaryDirectory(prefix="clvoro-") as folder:
        done = run_ranks(options.ranks, [__file__, *sys.argv[1:], "--folder", folder])
        pieces = len(list(Path(folder).glob("mesh_*.vtu")))
    if done.returncode == 0:
        row |= json.loads(done.stdout.splitlines()[-1])
    report.add({**row, "parts": options.ranks, "result": f"{pieces} pieces" if done.returncode == 0 else "failed"})
    report.finish(f"A device that may hold {options.share:g} of what the mesh needs")


if __name__ == "__main__":
    main()
