"""How long the first run takes: separate processes with empty kernel caches.

    python bench/first_run.py [--repeat N] [--warm] [--json]
    python bench/first_run.py --record

A box in 2D (625 cells) and one in 3D (1000 cells) are adapted with default options, and 1000 generators get cells of
prescribed volumes (`transport`). A row has the programs and kernels that are built, and the medians of the seconds that
a process takes to import the package, to make an adapter, and to run. The processor time includes that of workers, and
is disturbed less by others on the machine. `--warm` repeats the runs with full caches.
`--record` writes `clvoro/opencl/first_kernels.json`: which kernels a first run needs, in which order.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from _common import Report, heading, shown

import clvoro

RUNS = {
    "2D box": ("clvoro.Box((0, 0), (1, 1))", 0.04),
    "3D box": ("clvoro.Box((0, 0, 0), (1, 1, 1))", 0.1),
    "2D polygon": ("clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0.4, 1), (0.4, 0.5), (0, 0.5)])", 0.04),
    "2D periodic": ("clvoro.Box((0, 0), (1, 1), periodic=True)", 0.04),
    "3D periodic": ("clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True)", 0.1),
    "sphere": ("clvoro.Sphere(1.0)", 0.08),
}
TRANSPORT = "transport({domain}, *given({domain}, {n}))"
GIVEN = """
import numpy as np
def given(domain, n):
    points = np.random.default_rng(1).uniform(domain.lower, domain.upper, (n, domain.dim))
    points = domain.nearest(points)
    return points, np.full(len(points), domain.measure / len(points))
"""
RECORDED = {
    **{name: (domain, "", f"run({domain}, {size})") for name, (domain, size) in RUNS.items()},
    **{
        f"{name}, transport": (RUNS[name][0], "transport", TRANSPORT.format(domain=RUNS[name][0], n=1000))
        for name in ("2D box", "3D box", "sphere")
    },
}
"""Domain, job if it is not a run, and what an adapter does."""
KINDS = {name: RECORDED[name] for name in ("2D box", "3D box", "2D box, transport", "3D box, transport")}
RUN = """
import json, resource, time
{given}
def clocks():
    own, ended = (resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return time.perf_counter(), own.ru_utime + own.ru_stime + ended.ru_utime + ended.ru_stime
marks = [clocks()]
import clvoro
marks.append(clocks())
adapter = clvoro.Adapter()
marks.append(clocks())
adapter.{call}
marks.append(clocks())
from clvoro.opencl import prebuild
prebuild._stop_workers()
marks[-1] = marks[-1][0], clocks()[1]
names = "import", "adapter", "run"
spent = {{n: [b[i] - a[i] for i in (0, 1)] for n, a, b in zip(names, marks, marks[1:])}}
print(json.dumps(spent))
"""
RECORDER = """
import json, sys
import numpy as np, pyopencl as cl
import clvoro
from clvoro.opencl import engine as engines, kernels as kernel_objects, prebuild
made, launches, programs = {{}}, {{}}, []
{given}
plain = engines.Engine.kernels, kernel_objects.set_changed, cl.enqueue_nd_range_kernel
def kernels(engine, stage, defines=None, prelude="", **options):
    taken = plain[0](engine, stage, defines, prelude, **options)
    more = {{"REAL": "float"}} if engine.real == np.float32 else {{}}
    if "WEIGHTED" in engine.all_defines(stage, {{}}):
        more["WEIGHTED"] = "1"
    made[id(taken)] = taken, (stage, more | {{k: str(v) for k, v in (defines or {{}}).items()}}), prelude
    return taken
def getattribute(taken, name):
    kernel = old(taken, name)
    if isinstance(kernel, cl.Kernel):
        kernel.made = made[id(taken)][1:]
    return kernel
old = kernel_objects.Kernels.__getattr__
def size_of(a):
    return 4 if type(a) is int else a.nbytes if isinstance(a, (np.generic, np.ndarray)) else 0
def set_changed(kernel, args, changed):
    kernel.sizes = [size_of(a) for a in args]
    plain[1](kernel, args, changed)
def enqueue(queue, kernel, size, group, *args, **options):
    program_of, prelude = getattr(kernel, "made", (None, "x"))
    if not prelude:
        if list(program_of) not in programs:
            programs.append(list(program_of))
        key = programs.index(list(program_of)), kernel.function_name, group[0]
        launches.setdefault(key, kernel.sizes)
    return plain[2](queue, kernel, size, group, *args, **options)
engines.Engine.kernels, kernel_objects.Kernels.__getattr__ = kernels, getattribute
kernel_objects.set_changed, cl.enqueue_nd_range_kernel = set_changed, enqueue
prebuild._marker = lambda *_: None
adapter = clvoro.Adapter()
adapter.{call}
kind = prebuild.kind_of(adapter._engine_for({domain}), "{job}")
rows = [[*key, sizes] for key, sizes in launches.items()]
print(json.dumps([kind, {{"programs": programs, "launches": rows}}]))
"""
ROOT = Path(__file__).parent.parent
PLACE = ROOT / "clvoro" / "opencl" / "first_kernels.json"


def in_process(code: str, cache: str | None) -> object:
    """Run `code` in a separate process, with kernel caches in `cache`; return what it prints."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    if cache is not None:
        env |= {"POCL_CACHE_DIR": f"{cache}/pocl", "XDG_CACHE_HOME": cache, "CUDA_CACHE_PATH": f"{cache}/cuda"}
        Path(cache, "pocl").mkdir(exist_ok=True)
    ended = subprocess.run([sys.executable, "-c", code], env=env, check=True, capture_output=True, text=True)
    found = json.loads(ended.stdout.splitlines()[-1])
    if cache is not None and isinstance(found, dict):
        found["built"] = [len(list(Path(cache).rglob(name))) for name in ("program.bc", "*.so")]
    return found


def record_kind(kind: str) -> tuple[str, dict[str, list]]:
    """Return the name of a kind of run, and its programs and launches in the order of their first use."""
    domain, job, call = RECORDED[kind]
    name, found = in_process(RECORDER.format(domain=domain, job=job, call=call, given=GIVEN), None)  # type: ignore[misc]
    return name, found


def write_record() -> None:
    """Write the record, one program or launch in a line."""
    kinds = []
    for kind, entry in map(record_kind, RECORDED):
        parts = [
            f'  "{name}": [\n' + ",\n".join(f"   {json.dumps(row)}" for row in rows) + "\n  ]"
            for name, rows in entry.items()
        ]
        kinds.append(f' "{kind}": {{\n' + ",\n".join(parts) + "\n }")
    PLACE.write_text("{\n" + ",\n".join(kinds) + "\n}\n")


COLUMNS = {
    "kind": shown("kind", "s"),
    "cache": shown("cache", "s"),
    "programs": shown("programs", "d"),
    "kernels": shown("kernels", "d"),
    **{name: shown(name, ".2f") for name in ("import", "adapter", "run")},
    "processor s, adapter and run": shown("processor", ".2f"),
}


def main() -> None:
    """Print the medians, or write the record."""
    options_of = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options_of.add_argument("--repeat", type=int, default=3, help="processes for each kind (3)")
    options_of.add_argument("--warm", action="store_true", help="with full caches as well")
    options_of.add_argument("--record", action="store_true", help="write the record of kernels")
    options_of.add_argument("--json", action="store_true", help="print one JSON object per line instead")
    options = options_of.parse_args()
    if options.record:
        write_record()
        return
    report = Report(options.json, COLUMNS)
    for kind, (_, _, call) in KINDS.items():
        found: dict[str, list] = {"empty": [], "full": []}
        for _ in range(options.repeat):
            with tempfile.TemporaryDirectory() as cache:
                for state in found if options.warm else ["empty"]:
                    found[state].append(in_process(RUN.format(call=call, given=GIVEN), cache))
        for state, runs in found.items():
            if runs:
                programs, kernels = runs[0].pop("built")
                wall, busy = ({name: statistics.median(r[name][i] for r in runs) for name in runs[0]} for i in (0, 1))
                row = {"kind": kind, "cache": state, "programs": programs, "kernels": kernels, **wall}
                report.add({**row, "processor": busy["adapter"] + busy["run"]}, f"{kind}, {state}")
    report.finish(heading(clvoro.Adapter(), "First runs, seconds"))


if __name__ == "__main__":
    main()
