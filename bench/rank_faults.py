"""Faults on one of the ranks of MPI at random moments: whether all ranks end, with one message and a whole checkpoint.

    python bench/rank_faults.py [--times 100] [--ranks 3] [--seed 1] [--json]

Each time `mpiexec` starts ``clvoro run`` over ranks, with a checkpoint after each step. The last rank fails: it is
killed, its callback raises an error, its disk is full (RLIMIT_FSIZE), its device builds no kernels, or it has
another version or another case.
`longest s` is the longest time from the fault to the end of `mpiexec`. It is not measured on a full disk, since the run
then goes on without checkpoints and fails at its end. `most messages` is the largest number of lines "clvoro: ..." on
the standard error of one run; `without` counts the runs that print none, as where a process is killed. `checkpoints`
counts the runs that leave a checkpoint, `damaged` the checkpoints that cannot be read. Standard error has a line for
each fault when its run ends. Needs `pip install -e '.[mpi]'`.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from _common import Report, parser, run_ranks, shown

from clvoro.adaptation.checkpoint import Saved
from clvoro.adaptation.run import Run
from clvoro.cli import main as command
from clvoro.errors import BuildError, ClvoroError
from clvoro.opencl import peers as parts
from clvoro.opencl import program

KINDS = ("kill", "error", "full disk", "device", "version", "input")
COLUMNS = {
    "fault": shown("fault", "s"),
    "times": shown("times", "d"),
    "longest s": shown("longest", ".2f"),
    "most messages": shown("most", "d"),
    "without": shown("without", "d"),
    "checkpoints": shown("checkpoints", "d"),
    "damaged": shown("damaged", "d"),
    "hung": shown("hung", "d"),
}
CASE = """
domain = {{lower = [0.0, 0.0], upper = [1.0, 1.0]}}
size = {{kind = "constant", value = 0.1}}
run = {{effort = "fast", seed = {seed}}}
"""
LATEST = 600
"""Seconds from its start after which a run counts as hung: on a loaded machine runs themselves take minutes."""


def run_rank(folder: Path, kind: str, step: int) -> None:
    """Run the case on this rank. The last rank fails: before the run, or after about `step` steps."""
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    fault = kind if comm.rank == comm.size - 1 else ""
    record = Run.record

    def note() -> None:
        (folder / "fault").write_text(repr(time.time()))

    if fault in ("version", "input"):
        note()
    if fault == "device":

        def build(*_: Any) -> None:
            note()
            raise BuildError("the compiler is gone")

        program.build_program = build
    if fault == "version":
        parts.__version__ = "0"

    def noted(run: Run, progress: float | None = None) -> None:
        record(run, progress)
        if len(run.rows) == step and fault in ("kill", "error", "full disk"):
            note()
            if fault == "kill":
                os.kill(os.getpid(), 9)
            if fault == "error":
                raise OSError("the network is gone")
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))

    Run.record = noted  # type: ignore[method-assign]
    case = folder / f"case{int(fault == 'input')}.toml"
    out, state = folder / "out", folder / "state"
    options = ["--pieces", "--quiet", "--out", str(out), "--checkpoint", str(state), "--checkpoint-every", "0"]
    sys.exit(command(["run", str(case), *options]))


def fail_once(kind: str, step: int, ranks: int) -> dict[str, float]:
    """Run once with a fault; return the time to its end, and its messages and checkpoints."""
    with tempfile.TemporaryDirectory(prefix="clvoro-") as name:
        folder = Path(name)
        for seed in (0, 1):
            (folder / f"case{seed}.toml").write_text(CASE.format(seed=seed))
        try:
            done = run_ranks(
                ranks, [__file__, "--rank", f"{folder}:{kind}:{step}"], stderr=subprocess.PIPE, timeout=LATEST
            )
        except subprocess.TimeoutExpired:
            return {"hung": 1, "seconds": LATEST, "messages": 0, "there": 0, "damaged": 0}
        ended, state = time.time(), folder / "state"
        damaged = 0
        if state.exists():
            try:
                Saved(state)
            except ClvoroError:
                damaged = 1
        messages = [line for line in done.stderr.splitlines() if line.startswith("clvoro: ") and "warning" not in line]
        began = float((folder / "fault").read_text()) if (folder / "fault").exists() else ended
        seconds = 0.0 if kind == "full disk" else ended - began
        return {"hung": 0, "seconds": seconds, "messages": len(messages), "there": state.exists(), "damaged": damaged}


def main() -> None:
    """Let runs fail, and print a table of the kinds of faults."""
    p = parser(__doc__)
    p.add_argument("--times", type=int, default=100, help="number of faults")
    p.add_argument("--ranks", type=int, default=3, help="number of ranks")
    p.add_argument("--seed", type=int, default=1, help="seed of the moments")
    p.add_argument("--rank", help="FOLDER:KIND:STEP of a rank; used by the script itself")
    options: argparse.Namespace = p.parse_args()
    if options.rank:
        folder, kind, step = options.rank.split(":")
        run_rank(Path(folder), kind, int(step))
    rng, found = random.Random(options.seed), {kind: [] for kind in KINDS}
    for k in range(options.times):
        kind = KINDS[k % len(KINDS)]
        found[kind].append(fail_once(kind, rng.randint(1, 55), options.ranks))
        print(k + 1, kind, found[kind][-1], file=sys.stderr, flush=True)
    table = Report(options.json, COLUMNS)
    for kind, runs in found.items():
        if runs:
            record = {"fault": kind, "times": len(runs), "longest": max(run["seconds"] for run in runs)}
            record |= {"most": max(run["messages"] for run in runs)}
            record |= {"without": sum(run["messages"] == 0 for run in runs)}
            sums = {"checkpoints": "there", "damaged": "damaged", "hung": "hung"}
            table.add(record | {name: int(sum(run[key] for run in runs)) for name, key in sums.items()})
    table.finish(f"Faults of one of {options.ranks} ranks")


if __name__ == "__main__":
    main()
