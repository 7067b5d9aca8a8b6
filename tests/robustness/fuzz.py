"""Throw everything at clvoro: `python -m tests.robustness.fuzz --minutes 10`.

Each input is made from one seed: generators in the plane and in space (clusters down to one ulp, lattices, circles and
spheres, lines, walls, corners, one to three points, scales 1e-300 to 1e300), periodic boxes, polygons, rings of which
some make one, layers, size fields of all kinds, options, runs that are interrupted and go on, meshes that follow a
field, cases, and files with bits changed.
It must end in a mesh that passes `check`, or in a ClvoroError (a ValueError, TypeError or MemoryError that says what
is wrong), and without a warning of NumPy's or Python's. Whatever else happens is printed with its seed and saved;
`python -m tests.robustness.fuzz --repeat SEED` repeats it. A table at the end counts the meshes and the errors of each
kind of input, and names the most frequent errors.
"""

from __future__ import annotations

import argparse
import collections
import faulthandler
import re
import sys
import time
import traceback
import warnings
from functools import partial
from pathlib import Path

import numpy as np

import clvoro
from tests.robustness import fuzz_boundaries as boundaries
from tests.robustness import fuzz_commands as commands
from tests.robustness import fuzz_work as work
from tests.robustness.fuzz_judge import TooLarge, Wrong
from tests.robustness.fuzz_sizes import OwnError

WORK = {
    "diagram": (partial(work.try_diagram, work.in_plane), 0.3),
    "around": (work.try_around, 0.08),
    "solid": (partial(work.try_diagram, work.in_space), 0.12),
    "polygon": (boundaries.try_polygon, 0.15),
    "periodic": (partial(work.try_diagram, work.with_seams), 0.12),
    "run": (partial(work.try_run, work.in_plane), 0.15),
    "solid-run": (partial(work.try_run, work.in_space), 0.08),
    "polygon-run": (boundaries.try_polygon_run, 0.1),
    "hard-polygon": (boundaries.try_hard, 0.08),
    "rings": (boundaries.try_rings, 0.08),
    "periodic-run": (partial(work.try_run, work.with_seams), 0.12),
    "layers": (work.try_layers, 0.1),
    "resumed": (work.try_resumed, 0.06),
    "moved": (work.try_moved, 0.05),
    "case": (commands.try_case, 0.06),
    "turns": (work.try_turns, 0.08),
    "command": (commands.try_command, 0.06),
    "file": (commands.try_file, 0.1),
}
"""The work on each kind of input, and its frequency."""

SLOWEST = 180
"""Seconds after which an input counts as one that hangs."""
ENDS = ("mesh", "error", "failed")


def kind_of(seed: int) -> str:
    """Return what kind of input `seed` makes."""
    shares = np.array([share for _, share in WORK.values()])
    return str(np.random.default_rng(seed).choice(list(WORK), p=shares / shares.sum()))


def attempt(kind: str, seed: int) -> tuple[str, str]:
    """Try one input; return how it ended, and with what error."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        try:
            end, error = WORK[kind][0](np.random.default_rng((seed, 1))), ""
        except TooLarge:
            end, error = "too large", ""
        except (clvoro.ClvoroError, OwnError) as refused:
            end, error = "error", f"{type(refused).__name__}: {refused}"
    # Those of clvoro are UserWarnings.
    stray = [w for w in given if issubclass(w.category, (RuntimeWarning, DeprecationWarning))]
    stray = [w for w in stray if "clvoro" in w.filename]
    if stray:
        raise Wrong(f"{stray[0].filename}:{stray[0].lineno} warns: {stray[0].message}")
    return end, error


def table(ends: dict[str, collections.Counter], errors: dict[str, collections.Counter]) -> str:
    """Return how many inputs of each kind ended how."""
    lines = [f"{'kind':14}{'inputs':>8}{'mesh':>8}{'error':>8}{'failed':>8}{'meshes':>8}  other"]
    for kind, counts in ends.items():
        if not counts:
            continue
        total = counts.total()
        other = ", ".join(f"{n} {end}" for end, n in counts.most_common() if end not in ENDS)
        each = "".join(f"{counts[end]:8d}" for end in ENDS)
        lines.append(f"{kind:14}{total:8d}{each}{counts['mesh'] / total:8.0%}  {other}")
    for kind, counts in errors.items():
        lines += [f"{kind}: {n} x {text}" for text, n in counts.most_common(5)]
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.robustness.fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, help="of the first input (default: from the clock)")
    parser.add_argument("--repeat", type=int, metavar="SEED", help="try this one input, and show how it ends")
    parser.add_argument("--only", choices=list(WORK), help="inputs of one kind")
    parser.add_argument("--without", choices=list(WORK), nargs="+", default=[], help="no inputs of these kinds")
    parser.add_argument("--out", type=Path, default=Path("fuzz-failures"), help="folder for what fails")
    arguments = parser.parse_args()
    if arguments.repeat is not None:
        kind = arguments.only or kind_of(arguments.repeat)
        print(kind, *attempt(kind, arguments.repeat))
        return 0
    first = time.time_ns() % 10**9 if arguments.seed is None else arguments.seed
    print(f"first seed {first}", flush=True)
    ends, errors = ({kind: collections.Counter() for kind in WORK} for _ in range(2))
    until, seed, tried, failures = time.monotonic() + 60 * arguments.minutes, first - 1, 0, 0
    arguments.out.mkdir(exist_ok=True, parents=True)
    now = arguments.out / "now.txt"
    while time.monotonic() < until:
        seed += 1
        kind = arguments.only or kind_of(seed)
        if kind in arguments.without:
            continue
        tried += 1
        faulthandler.dump_traceback_later(SLOWEST, exit=True)
        now.write_text(f"python -m tests.robustness.fuzz --repeat {seed} --only {kind}\n")  # should it crash or hang
        try:
            end, error = attempt(kind, seed)
            ends[kind][end] += 1
            if error:
                # Numbers and places apart, alike errors are one.
                errors[kind][re.sub(r"\S*\d\S*", "#", error)[:110]] += 1
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                break
            failures += 1
            ends[kind]["failed"] += 1
            text = f"python -m tests.robustness.fuzz --repeat {seed} --only {kind}\n\n{traceback.format_exc()}"
            (arguments.out / f"{seed}.txt").write_text(text)
            print(f"--repeat {seed} --only {kind}: {type(error).__name__}: {error!s:.600}", flush=True)
    faulthandler.cancel_dump_traceback_later()
    now.unlink(missing_ok=True)
    print(table(ends, errors))
    print(f"{tried} inputs, {failures} failures" + (f", in {arguments.out}" if failures else ""))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
