"""Device memory of a whole run at its peak, by stage.

    python bench/memory.py [--sizes 1e5] [--fields F2,S1] [--methods exact] [--efforts default]
                           [--device NAME] [--dtype float32] [--json]
    python bench/memory.py --sizes 1e4 --fields jump,stripes,disc,kink,chequers,wall
    python bench/memory.py --sizes 300,6000 --kinds all

Each buffer is counted from its allocation until it is freed, by the module of clvoro that allocated it. Each field is
scaled to the number of cells. The figures are bytes per cell of the finished mesh. "output" is the peak while all
arrays of the diagram are read, after the run; "estimate" is that of `Adapter.memory_needed`, and "held" the
larger of the two over it. In the fields of the second line sizes change several-fold from one cell to the next.
The third line has all kinds of runs (`_kinds.py`, or some of them by their first word), one that is
resumed and a transfer: shares of the estimate that are in use while the run is prepared, in the run,
and while its diagram is read.
`clvoro.adaptation.estimates.SIZES` holds the estimates, in reals and 32-bit integers.
"""

from __future__ import annotations

import sys
import tempfile
import traceback
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
from _common import FIRST_SEED, Report, counts, domain_of, heading, make_adapter, names, parser, test_field
from _kinds import CUBE, KINDS, SQUARE, Kind

import clvoro
from clvoro import sizing
from clvoro.adaptation.sampling.start import count_cells
from clvoro.opencl.engine import Engine
from clvoro.remapping.cell_data import transfer_values
from clvoro.remapping.device_transfer import transfer_bytes

STEEP = {
    "jump": (SQUARE, "x < 0.5 ? 1.0 : 19.0"),
    "stripes": (SQUARE, "sin(25 * x) < 0 ? 1.0 : 10.0"),
    "disc": (SQUARE, "hypot(x - 0.5, y - 0.5) < 0.25 ? 1.0 : 12.0"),
    "kink": (SQUARE, "0.001 + fabs(x - 0.5)"),
    "chequers": (SQUARE, "sin(20 * x) * sin(20 * y) < 0 ? 1.0 : 8.0"),
    "wall": (CUBE, "x < 0.5 ? 1.0 : 8.0"),
}
"""Fields that are hard to estimate from sizes at generators, by name: domain and formula."""
PACKAGE = Path(clvoro.__file__).parent
PLUMBING = {"_program", "_arrays", "_device_array", "_primitives"}
"""Modules that allocate buffers for others."""


class Ledger:
    """Bytes of live buffers by stage, now and at the peak of their sum."""

    def __init__(self) -> None:
        self.live: Counter[str] = Counter()
        self.begin()

    def begin(self) -> None:
        """Begin a new search for the peak."""
        self.peak, self.at_peak = sum(self.live.values()), self.live.copy()

    def add(self, stage: str, size: int) -> None:
        """Count a new buffer."""
        self.live[stage] += size
        total = sum(self.live.values())
        if total > self.peak:
            self.peak, self.at_peak = total, self.live.copy()

    def free(self, stage: str, size: int) -> None:
        """Remove a freed buffer."""
        self.live[stage] -= size


def asking_module() -> str:
    """Return the name of the module of clvoro that allocates a buffer."""
    for frame, _ in traceback.walk_stack(sys._getframe(2)):
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(PACKAGE) and path.stem not in PLUMBING:
            return path.stem
    return "others"


@contextmanager
def counted_buffers(ledger: Ledger) -> Iterator[None]:
    """Count the buffers that PyOpenCL makes while the context is open."""
    plain = cl.Buffer

    class CountedBuffer(plain):  # type: ignore[misc, valid-type]
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            entry = asking_module(), self.size
            ledger.add(*entry)
            weakref.finalize(self, ledger.free, *entry)

    cl.Buffer = CountedBuffer  # type: ignore[misc]
    try:
        yield
    finally:
        cl.Buffer = plain  # type: ignore[misc]


def peaks(options: Any, work: Callable[[clvoro.Adapter], clvoro.Diagram]) -> tuple[clvoro.Diagram, dict[str, int], int]:
    """Do `work` with a new adapter; return its diagram and two peaks in bytes.

    The first is that of `work`, by stage, the second that of reading all arrays.
    """
    ledger = Ledger()
    with counted_buffers(ledger):
        diagram = work(make_adapter(options))
        run = {stage: size for stage, size in ledger.at_peak.items() if size}
        ledger.begin()
        for array in diagram._NAMES:
            getattr(diagram, array, None)
    return diagram, run, ledger.peak


def case_of(name: str, n: int) -> tuple[clvoro.Box, sizing.Field]:
    """Return domain and size field for `n` cells."""
    if name in STEEP:
        domain, field = STEEP[name][0], sizing.Expression(STEEP[name][1])
    else:
        domain, field = domain_of(name), test_field(name)
    return domain, field * (count_cells(field, domain) / n) ** (1 / domain.dim)


def measure(options: Any, name: str, n: int, method: str, effort: str) -> dict[str, Any]:
    """Run once by a new adapter and return the peaks, bytes per cell."""
    domain, field = case_of(name, n)
    given = {"method": method, "effort": effort, "seed": FIRST_SEED}
    diagram, run, output = peaks(options, lambda a: a.run(domain, field, **given).diagram)
    cells, run_peak = len(diagram), sum(run.values())
    told = make_adapter(options).memory_needed(domain, field, method=method)
    return {
        "field": name,
        "dim": domain.dim,
        "cells": cells,
        "method": method,
        "effort": effort,
        "run": run_peak / cells,
        "output": output / cells,
        "estimate": told / cells,
        "held": max(run_peak, output) / told,
        "stages": {stage: size / cells for stage, size in Counter(run).most_common()},
    }


def measure_kind(options: Any, kind: Kind) -> dict[str, Any]:
    """Run once; return the estimate in bytes per cell, and the shares of it that were in use."""
    domain, size, given = kind
    ledger, told, before = Ledger(), [], []
    with counted_buffers(ledger):
        adapter = make_adapter(options)

        def begin(amount: float) -> None:
            told.append(amount)
            before.append(ledger.peak)
            ledger.begin()

        adapter.on_memory = begin
        diagram = adapter.run(domain, size, seed=FIRST_SEED, **given).diagram
        run = ledger.peak
        ledger.begin()
        for array in diagram._NAMES:
            getattr(diagram, array, None)
    parts = {"preparation": before[0], "run": run, "output": ledger.peak}
    shares = {name: part / told[0] for name, part in parts.items()}
    cells = len(diagram)
    return {"cells": cells, "estimate": told[0] / cells, **shares, "held": max(shares.values())}


def resumed(options: Any, n: int) -> dict[str, Any]:
    """Measure a run that is resumed in the middle of its finest level."""
    with tempfile.TemporaryDirectory() as folder:
        file, size = Path(folder) / "state", n**-0.5
        make_adapter(options).run(
            SQUARE,
            size,
            seed=FIRST_SEED,
            checkpoint=clvoro.Checkpoint(file, every=1e9),
            callback=lambda row: row["level"] == 0 and row["progress"] > 0.5,
        )
        return measure_kind(options, (SQUARE, size, {"checkpoint": clvoro.Checkpoint(resume=file)}))


def transferred(options: Any, n: int) -> dict[str, Any]:
    """Measure a transfer of one column between meshes of random generators."""
    adapter, rng = make_adapter(options), np.random.default_rng(1)
    old, new = (adapter.diagram(SQUARE, rng.random((n, 2))) for _ in range(2))
    sizes = [(n, len(mesh.neighbors)) for mesh in (old, new)]
    values, ledger = old.volumes, Ledger()
    with counted_buffers(ledger):
        transfer_values(old, values, new, 2, adapter=adapter)
    double = adapter.queue.device.double_fp_config
    engine = Engine(adapter.ctx, adapter.queue, 2, np.dtype("float64" if double else "float32"))
    told = transfer_bytes(engine, *sizes, 1, 2)
    held = ledger.peak / told
    return {"cells": n, "estimate": told / n, "preparation": 0.0, "run": held, "output": 0.0, "held": held}


OTHERS = {"resumed": resumed, "transfer": transferred}


def show_kinds(options: Any) -> None:
    """Show every kind of run."""
    words = tuple(options.kinds)
    columns = {
        "kind": lambda r: r["kind"],
        "cells": lambda r: r["cells"],
        "estimate": lambda r: f"{r['estimate']:.0f}",
        **{name: lambda r, name=name: f"{r[name]:.2f}" for name in ("preparation", "run", "output", "held")},
    }
    report = Report(options.json, columns)
    for name in (*KINDS, *OTHERS):
        if "all" not in words and not name.startswith(words):
            continue
        for n in options.sizes:
            try:
                other = OTHERS.get(name)
                found = other(options, n) if other else measure_kind(options, KINDS[name](n))
            except clvoro.ClvoroError as error:  # too few cells, say, across a period
                print(f"{name}, {n} cells: {error}", file=sys.stderr)
                continue
            report.add({"kind": name, **found}, name)
    report.finish(heading(make_adapter(options), "Estimate of the device memory, bytes per cell, and its share in use"))


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[100_000], help="cells (1e5)")
    options_of.add_argument("--fields", type=names, default=["F2", "S1"])
    options_of.add_argument("--methods", type=names, default=["exact"])
    options_of.add_argument("--efforts", type=names, default=["default"])
    options_of.add_argument("--kinds", type=names, help="kinds of runs, or 'all'")
    options = options_of.parse_args()
    if options.kinds:
        show_kinds(options)
        return 0
    records = [
        measure(options, name, n, method, effort)
        for name in options.fields
        for n in options.sizes
        for method in options.methods
        for effort in options.efforts
    ]
    stages = list(dict.fromkeys(stage for r in records for stage in r["stages"]))
    columns = {
        "field": lambda r: r["field"],
        "cells": lambda r: r["cells"],
        "method": lambda r: f"{r['method']}, {r['effort']}",
        "run": lambda r: f"{r['run']:.0f}",
        "output": lambda r: f"{r['output']:.0f}",
        "estimate": lambda r: f"{r['estimate']:.0f}",
        "held": lambda r: f"{r['held']:.2f}",
        **{f"`{s}`": lambda r, s=s: f"{r['stages'].get(s, 0):.0f}" for s in stages},
    }
    report = Report(options.json, columns)
    for record in records:
        report.add(record)
    report.finish(heading(make_adapter(options), "Device memory at the peak, bytes per cell"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
