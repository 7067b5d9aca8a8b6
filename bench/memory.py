"""Device memory of a whole run at its peak, by stage.

    python bench/memory.py [--sizes 1e5] [--kinds F2,S1] [--stages] [--device NAME] [--dtype float32] [--json]
    python bench/memory.py --sizes 1e4 --kinds steep
    python bench/memory.py --sizes 300,6000 --kinds all

Each buffer is counted from its allocation until it is freed. With `--stages` also by the module of clvoro that
allocated it. Kinds of runs are those of `_kinds.py`, by their first word, one that is resumed, and a transfer; each is
scaled to the number of cells. In those that are "steep" sizes change several-fold from one cell to the next. The
figures are bytes per cell of the finished mesh: the estimate that a run tells, and the peaks while it is prepared, in
the run, and while all arrays of its diagram are read ("output"). "held" is the largest of the three over the estimate.
`clvoro.adaptation.estimates.SIZES` holds the estimates, in reals and 32-bit integers.
"""

from __future__ import annotations

import sys
import tempfile
import traceback
import weakref
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
from _common import FIRST_SEED, Report, counts, heading, make_adapter, names, parser
from _kinds import KINDS, SQUARE, Kind

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.remapping.cell_data import transfer_values
from clvoro.remapping.device_transfer import Pieces, transfer_bytes

PACKAGE = Path(clvoro.__file__).parent
PLUMBING = {"device_array", "engine", "memory_limits", "primitives", "program"}
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


def read_all(diagram: clvoro.Diagram) -> None:
    """Read all arrays."""
    for array in diagram._NAMES:
        getattr(diagram, array, None)


def measure(options: Any, kind: Kind) -> dict[str, Any]:
    """Run once by a new adapter; return peaks and the estimate in bytes per cell, and the shares of it in use."""
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
        run, stages = ledger.peak, ledger.at_peak
        ledger.begin()
        read_all(diagram)
    parts, cells = {"preparation": before[0], "run": run, "output": ledger.peak}, len(diagram)
    return {
        "cells": cells,
        "estimate": told[0] / cells,
        **{name: part / cells for name, part in parts.items()},
        "held": max(parts.values()) / told[0],
        "stages": {stage: size / cells for stage, size in stages.most_common() if size},
    }


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
        return measure(options, (SQUARE, size, {"checkpoint": clvoro.Checkpoint(resume=file)}))


def transferred(options: Any, n: int) -> dict[str, Any]:
    """Measure a transfer of one column between meshes of random generators."""
    adapter, rng = make_adapter(options), np.random.default_rng(1)
    old, new = (adapter.diagram(SQUARE, rng.random((n, 2))) for _ in range(2))
    values, ledger = old.volumes, Ledger()
    with counted_buffers(ledger):
        transfer_values(old, values, new, 2, adapter=adapter)
    double = adapter.queue.device.double_fp_config
    engine = Engine(adapter.ctx, adapter.queue, 2, np.dtype("float64" if double else "float32"))
    told = transfer_bytes(engine, Pieces.of(old), Pieces.of(new), len(old.neighbors), 1, 2)
    none = {"preparation": 0.0, "output": 0.0, "stages": {}}
    return {"cells": n, "estimate": told / n, "run": ledger.peak / n, "held": ledger.peak / told, **none}


OTHERS = {"resumed": resumed, "transfer": transferred}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[100_000], help="cells (1e5)")
    options_of.add_argument("--kinds", type=names, default=["F2", "S1"], help="first words of kinds of runs, or 'all'")
    options_of.add_argument("--stages", action="store_true", help="the peak of the run by stage, too")
    options = options_of.parse_args()
    words = tuple(options.kinds)
    columns = {
        "kind": lambda r: r["kind"],
        "cells": lambda r: r["cells"],
        **{name: lambda r, name=name: f"{r[name]:.0f}" for name in ("estimate", "preparation", "run", "output")},
        "held": lambda r: f"{r['held']:.2f}",
    }
    if options.stages:
        columns["stages"] = lambda r: ", ".join(f"{stage} {size:.0f}" for stage, size in r["stages"].items())
    report = Report(options.json, columns)
    for name in (*KINDS, *OTHERS):
        if "all" not in words and not name.startswith(words):
            continue
        for n in options.sizes:
            try:
                other = OTHERS.get(name)
                found = other(options, n) if other else measure(options, KINDS[name](n))
            except clvoro.ClvoroError as error:  # too few cells, say, across a period
                print(f"{name}, {n} cells: {error}", file=sys.stderr)
                continue
            report.add({"kind": name, **found}, name)
    title = "Device memory at the peak and its estimate, bytes per cell, and the share of the estimate in use"
    report.finish(heading(make_adapter(options), title))


if __name__ == "__main__":
    main()
