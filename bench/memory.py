"""Device memory of a whole run: what each stage holds at the moment when most is held.

    python bench/memory.py [--sizes 1e5] [--fields F2,S1] [--methods exact] [--efforts default]
                           [--device NAME] [--dtype float32] [--json]

Every buffer that is made meanwhile is counted until it is freed, by the module of clvoro that
asked for it (`mesh`: what a generator carries; `_workspace`: what stages use in turn; `fetch` and
`loops`: the finished diagram). Each field is scaled to the count. The figures are bytes per cell of
the finished mesh; "output" is the peak while all arrays of the diagram are fetched, which comes
after the run's own.
`clvoro.memory.PEAK` holds the sums that a run is refused by, in reals and 32-bit integers.
"""

from __future__ import annotations

import sys
import traceback
import weakref
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyopencl as cl
from _common import (
    FIRST_SEED,
    Report,
    counts,
    domain_of,
    heading,
    make_adapter,
    names,
    parser,
    test_field,
)

import clvoro
from clvoro.start import count_cells

PACKAGE = Path(clvoro.__file__).parent
PLUMBING = {"_program", "_arrays", "_device_array", "_primitives"}
"""Modules that make buffers for others."""


class Ledger:
    """Bytes of live buffers by stage, and what they were when their sum was largest."""

    def __init__(self) -> None:
        self.live: Counter[str] = Counter()
        self.begin()

    def begin(self) -> None:
        """Look for a new peak from here on."""
        self.peak, self.at_peak = sum(self.live.values()), self.live.copy()

    def add(self, stage: str, size: int) -> None:
        """Count a new buffer."""
        self.live[stage] += size
        total = sum(self.live.values())
        if total > self.peak:
            self.peak, self.at_peak = total, self.live.copy()

    def free(self, stage: str, size: int) -> None:
        """Count a buffer no more."""
        self.live[stage] -= size


def asking_module() -> str:
    """Name the module of clvoro that asks for a buffer."""
    for frame, _ in traceback.walk_stack(sys._getframe(2)):
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(PACKAGE) and path.stem not in PLUMBING:
            return path.stem
    return "others"


@contextmanager
def counted_buffers(ledger: Ledger) -> Iterator[None]:
    """Count every buffer that PyOpenCL makes meanwhile."""
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


def measure(options: Any, name: str, n: int, method: str, effort: str) -> dict[str, Any]:
    """Run once by a new adapter and return the peaks, bytes per cell."""
    domain, field = domain_of(name), test_field(name)
    field = field * (count_cells(field, domain) / n) ** (1 / domain.dim)
    ledger = Ledger()
    with counted_buffers(ledger):
        adapter = make_adapter(options)
        result = adapter.run(domain, field, method=method, effort=effort, seed=FIRST_SEED)
        run = {stage: size for stage, size in ledger.at_peak.items() if size}
        ledger.begin()
        for array in result.diagram._NAMES:
            getattr(result.diagram, array, None)
    cells = len(result.points)
    return {
        "field": name, "dim": domain.dim, "cells": cells, "method": method, "effort": effort,
        "run": sum(run.values()) / cells, "output": ledger.peak / cells,
        "stages": {stage: size / cells for stage, size in Counter(run).most_common()},
    }  # fmt: skip


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[100_000], help="cells (1e5)")
    options_of.add_argument("--fields", type=names, default=["F2", "S1"])
    options_of.add_argument("--methods", type=names, default=["exact"])
    options_of.add_argument("--efforts", type=names, default=["default"])
    options = options_of.parse_args()
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
        **{f"`{s}`": lambda r, s=s: f"{r['stages'].get(s, 0):.0f}" for s in stages},
    }
    report = Report(options.json, columns)
    for record in records:
        report.add(record)
    report.finish(heading(make_adapter(options), "Device memory at the peak, bytes per cell"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
