"""Kill a run at any moment, fifty times: `python -m tests.robustness.killing [--times 50]`.

A child process runs with a checkpoint after every step, and is killed (SIGKILL, which nobody can catch) after a random
time; the next child goes on from what it finds. After every kill the checkpoint must load, or not exist yet, and beside
it no half-written file may go by its name. In the end a run must have come to the same mesh, bit for bit, as one that
was left alone. The meshes that it saves (`.npz`, written over and over) must load and pass the check, too. At least a
quarter of the kills must have met a child that had written a checkpoint of its own; else nothing much has been tried.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import clvoro
import clvoro.io.vtu_read
from clvoro.adaptation.checkpoint import Saved

OPTIONS = {"method": "adaptive", "effort": "fast", "seed": 3}
SIZE = "0.03 + 0.3*fabs(hypot(x-0.9, y-0.75)-0.3)"
BOX = clvoro.Box((0, 0), (2.5, 1.5))


def work(folder: Path) -> None:
    """Script of the child: continue from the checkpoint, if there is one, then save a mesh repeatedly."""
    state = folder / "state"
    adapter = clvoro.Adapter()
    mesh = adapter.run(BOX, 0.1, method="coupled", max_steps=1)

    (folder / "begun").touch()

    def callback(row: np.void) -> None:
        mesh.save(folder / "mesh.npz")
        mesh.save(folder / "mesh.vtu")

    result = adapter.run(
        BOX,
        clvoro.sizing.Expression(SIZE),
        callback=callback,
        checkpoint=clvoro.Checkpoint(state, every=0, resume=True),
        **OPTIONS,
    )
    result.save(folder / "result.npz")


def place_of(state: Path) -> int | None:
    """Return the position of the checkpoint in the plan, or None if there is no file. A file must load."""
    return Saved(state).state["position"] if state.exists() else None


def main(times: int, seed: int, patience: float) -> int:
    with tempfile.TemporaryDirectory() as name:
        every = clvoro.Checkpoint(Path(name) / "state", every=0)
        reference = clvoro.Adapter().run(BOX, clvoro.sizing.Expression(SIZE), checkpoint=every, **OPTIONS)
    rng, kills, reached, finished, places = random.Random(seed), 0, 0, 0, set()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        while kills < times or not finished:
            before, killed = place_of(folder / "state"), False
            command = [sys.executable, "-m", "tests.robustness.killing", "--work", name]
            child = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            # After all kills the last run may end.
            given = rng.uniform(0, patience) if kills < times else 600.0
            try:
                while child.poll() is None and not (folder / "begun").exists():
                    time.sleep(0.02)
                (folder / "begun").unlink(missing_ok=True)
                if child.wait(given):
                    print("the child failed by itself")
                    return 1
            except subprocess.TimeoutExpired:
                child.send_signal(signal.SIGKILL)
                child.wait()
                kills, killed = kills + 1, True
            after = place_of(folder / "state")
            if killed and after not in (None, before):
                reached += 1
                places.add(after)
            for mesh in ("mesh.npz", "result.npz"):
                if (folder / mesh).exists():
                    clvoro.load(folder / mesh).check().demand()
            if (folder / "mesh.vtu").exists():
                clvoro.io.vtu_read.load_vtu(folder / "mesh.vtu").check().demand()
            if (folder / "result.npz").exists():
                finished += 1
                result = clvoro.load(folder / "result.npz")
                for what in ("points", "target_size", "size_error", "quality"):
                    if not np.array_equal(getattr(result, what), getattr(reference, what)):
                        print(f"{what} of the resumed run is not that of the one left alone")
                        return 1
                (folder / "state").unlink()
                (folder / "result.npz").unlink()
    print(
        f"{kills} kills, {finished} runs came to the end, bit for bit as one left alone; {reached} kills met a child "
        f"that had written a checkpoint, at {len(places)} different places of the plan"
    )
    if 4 * reached < kills:
        print(f"that is too few: kill later or earlier, by another --patience than {patience:g}")
        return 1
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.robustness.killing")
    parser.add_argument("--times", type=int, default=50)
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6)
    parser.add_argument("--patience", type=float, default=2.0, help="seconds up to which a child is let run")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    sys.exit(work(arguments.work) if arguments.work else main(arguments.times, arguments.seed, arguments.patience))
