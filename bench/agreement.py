"""Two devices, the same input: by how much the results differ.

    python bench/agreement.py [--devices pocl,intel] [--cells 2e4] [--dtype float32] [--json]

A diagram of random generators must have the same graph and volumes to rounding ("off": largest difference over
the mean volume, in units of eps). So must some steps of a run, "off" then being how far generators are apart over
h. Rounding decides, in the end, which of two equal things is done (a defect climbs this way or that), so whole runs
drift apart: of them the figures are compared. Exits with 1 where the first two differ by more than 1e-6 (float32:
1e-2), or a whole run's mean error by more than 1e-3 or mean Q by more than 5e-3.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from typing import Any

import numpy as np
from _common import (
    FIRST_SEED,
    Report,
    counts,
    device_name,
    domain_of,
    figures,
    make_adapter,
    names,
    parser,
    test_field,
)

import clvoro
from clvoro.start import count_cells

STEPS = 3


def compare(options: Namespace, name: str, n: int) -> list[dict[str, Any]]:
    """Compare diagrams, steps and whole runs in the domain of the field `name`."""
    box, field = domain_of(name), test_field(name)
    field = field * (count_cells(field, box) / n) ** (1 / box.dim)
    points = np.random.default_rng(FIRST_SEED).random((n, box.dim)) * box.extent
    one, other = (
        make_adapter(Namespace(device=device, dtype=options.dtype)) for device in options.devices
    )
    eps = float(np.finfo(options.dtype).eps)
    same = {"dim": box.dim, "dtype": options.dtype}

    a, b = (adapter.diagram(box, points) for adapter in (one, other))
    graph = bool(np.array_equal(a.neighbours, b.neighbours))
    off = float(np.abs(a.volumes - b.volumes).max() / a.volumes.mean())
    records = [
        {**same, "what": "diagram", "cells": n, "graph": graph, "off": off, "in_eps": off / eps}
    ]

    a, b = (
        adapter.run(box, field, method="weighted", max_steps=STEPS, tol=0.0, seed=FIRST_SEED)
        for adapter in (one, other)
    )
    off = float((np.linalg.norm(a.points - b.points, axis=1) / a.size).max())
    graph = bool(np.array_equal(a.diagram.neighbours, b.diagram.neighbours))
    records.append({**same, "what": f"{STEPS} steps", "cells": len(a.points), "graph": graph, "off": off,
                    "in_eps": off / eps})  # fmt: skip

    for effort in ("fast", "default"):
        found = []
        for adapter in (one, other):
            result = adapter.run(box, field, effort=effort, seed=FIRST_SEED)
            found.append(figures(result.diagram, result.size, result.quality))
        a, b = found
        records.append({
            **same, "what": effort, "cells": int(a["cells"]), "cells_off": int(abs(a["cells"] - b["cells"])),
            "mean_error": [a["mean_error"], b["mean_error"]],
            "mean_quality": [a["mean_quality_all"], b["mean_quality_all"]],
        })  # fmt: skip
    return records


def good(record: dict[str, Any]) -> bool:
    """Tell whether the devices agree."""
    if "off" in record:
        return record["off"] <= (1e-2 if record["dtype"] == "float32" else 1e-6)
    error, quality = record["mean_error"], record["mean_quality"]
    return bool(abs(error[0] - error[1]) <= 1e-3 and abs(quality[0] - quality[1]) <= 5e-3)


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--devices", type=names, default=["pocl", "intel"])
    options_of.add_argument("--cells", type=counts, default=[20_000])
    options_of.add_argument("--fields", type=names, default=["F2", "S1"])
    options = options_of.parse_args()

    def either(key: str, text: Any) -> Any:
        return lambda r: text(r[key]) if key in r else "-"

    pair = "{0[0]:.5f} / {0[1]:.5f}".format
    columns = {
        "dim": lambda r: r["dim"],
        "what": lambda r: r["what"],
        "cells": lambda r: (
            f"{r['cells']:,}" + (f" +- {r['cells_off']}" if r.get("cells_off") else "")
        ),
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
    devices = (make_adapter(Namespace(device=d, dtype=options.dtype)) for d in options.devices)
    report.finish(
        f"{' and '.join(map(device_name, devices))}, clvoro {clvoro.__version__}, {options.dtype}."
    )
    return 0 if agree else 1


if __name__ == "__main__":
    sys.exit(main())
