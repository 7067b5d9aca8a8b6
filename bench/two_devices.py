"""Differences between the results of two devices for the same input.

    python bench/two_devices.py [--devices pocl,Intel(R) OpenCL] [--cells 2e4] [--dtype float32] [--no-runs] [--json]

A diagram of random generators must have the same graph, and the same volumes up to round-off. "off" is the largest
difference over the mean volume, in units of eps. After a few steps of a run "off" is the largest distance of the
generators over h. Over a whole run, round-off decides between equally good moves of a defect, and the meshes differ;
their errors, qualities and counts are compared. The script returns 1 if a difference exceeds `ROUNDINGS`, `STEPPED`,
`COUNTS` or `FIGURES`.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from typing import Any

import numpy as np
from _common import FIRST_SEED, Report, counts, device_name, domain_of, figures, make_adapter, names, parser, test_field

import clvoro
from clvoro.adaptation.sampling.start import count_cells

STEPS = 3
ROUNDINGS = 1e4
"""Largest difference of a volume over the mean volume, in eps: corners are quotients of differences of squares, and
random generators may be 1e-2 of a cell apart."""
STEPPED = {"float64": 1e-6, "float32": 1e-2}
"""Largest distance of a generator over h after some steps. In float64 the devices differ by rough solves, whose vectors
are in float32: by 16 roundings for a displacement of up to h. In float32 one device may take one more iteration, if a
residual is within round-off of the tolerance, 1e-2."""
COUNTS = 3e-3
"""Relative difference of the numbers of cells after a whole run: a few cells of thousands."""
FIGURES = {"mean_error": 1e-3, "mean_quality": 5e-3}
"""Largest differences of figures of whole runs. The default aims at a mean error of 2.5e-3. A defect lowers Q of a cell
by 0.05 to 0.1, and one cell in twenty may have a defect on one device only."""


def compare(options: Namespace, name: str, n: int) -> list[dict[str, Any]]:
    """Compare diagrams, steps and whole runs in the domain of the field `name`."""
    box, field = domain_of(name), test_field(name)
    field = field * (count_cells(field, box) / n) ** (1 / box.dim)
    points = np.random.default_rng(FIRST_SEED).random((n, box.dim)) * box.extent
    one, other = (make_adapter(Namespace(device=device, dtype=options.dtype)) for device in options.devices)
    eps = float(np.finfo(options.dtype).eps)
    same = {"dim": box.dim, "dtype": options.dtype}

    a, b = (adapter.diagram(box, points) for adapter in (one, other))
    graph = bool(np.array_equal(a.neighbors, b.neighbors))
    off = float(np.abs(a.volumes - b.volumes).max() / a.volumes.mean())
    records = [{**same, "what": "diagram", "cells": n, "graph": graph, "off": off, "in_eps": off / eps}]

    a, b = (
        adapter.run(
            box, field, method="weighted", max_steps=STEPS, options=clvoro.PaperOptions(tol=0.0), seed=FIRST_SEED
        )
        for adapter in (one, other)
    )
    off = float((np.linalg.norm(a.points - b.points, axis=1) / a.target_size).max())
    graph = bool(np.array_equal(a.diagram.neighbors, b.diagram.neighbors))
    records.append(
        {**same, "what": f"{STEPS} steps", "cells": len(a.points), "graph": graph, "off": off, "in_eps": off / eps}
    )

    for effort in () if options.no_runs else ("fast", "default"):
        found = []
        for adapter in (one, other):
            result = adapter.run(box, field, effort=effort, seed=FIRST_SEED)
            found.append(figures(result.diagram, result.target_size, result.quality))
        a, b = found
        records.append(
            {
                **same,
                "what": effort,
                "cells": int(a["cells"]),
                "cells_off": int(abs(a["cells"] - b["cells"])),
                "mean_error": [a["mean_error"], b["mean_error"]],
                "mean_quality": [a["mean_quality_all"], b["mean_quality_all"]],
            }
        )
    return records


def good(record: dict[str, Any]) -> bool:
    """Return whether the devices agree."""
    real = record["dtype"]
    if record["what"] == "diagram":
        return record["graph"] and record["off"] <= ROUNDINGS * np.finfo(real).eps
    if "off" in record:
        return record["off"] <= STEPPED[real]
    apart = all(abs(np.subtract(*record[name])) <= most for name, most in FIGURES.items())
    return bool(apart and record["cells_off"] <= max(2, COUNTS * record["cells"]))


def main() -> int | str:
    options_of = parser(__doc__)
    options_of.add_argument("--devices", type=names, default=["pocl", "Intel(R) OpenCL"])
    options_of.add_argument("--cells", type=counts, default=[20_000])
    options_of.add_argument("--fields", type=names, default=["F2", "S1"])
    options_of.add_argument("--no-runs", action="store_true", help="diagrams and steps only")
    options = options_of.parse_args()
    devices = [make_adapter(Namespace(device=d, dtype=options.dtype)) for d in options.devices]
    if len({adapter.ctx.devices[0] for adapter in devices}) < len(devices):
        return f"{options.devices} name the same device: {device_name(devices[0])}"

    def either(key: str, text: Any) -> Any:
        return lambda r: text(r[key]) if key in r else "-"

    pair = "{0[0]:.5f} / {0[1]:.5f}".format
    columns = {
        "dim": lambda r: r["dim"],
        "what": lambda r: r["what"],
        "cells": lambda r: f"{r['cells']:,}" + (f" +- {r['cells_off']}" if r.get("cells_off") else ""),
        "same graph": either("graph", lambda same: "yes" if same else "no"),
        "off": either("off", "{:.1e}".format),
        "in eps": either("in_eps", "{:.0f}".format),
        "mean abs e": either("mean_error", pair),
        "mean Q": either("mean_quality", pair),
    }
    report = Report(options.json, columns)
    agree = True
    for name in options.fields:
        for n in options.cells:
            for record in compare(options, name, n):
                report.add(record)
                agree &= good(record)
    report.finish(f"{' and '.join(map(device_name, devices))}, clvoro {clvoro.__version__}, {options.dtype}.")
    return 0 if agree else 1


if __name__ == "__main__":
    sys.exit(main())
