"""Size error, quality and work of each method on several size fields, against goals.

    python bench/convergence.py [--fields F1,F3] [--rows default,exact] [--seeds 3] [--large]
                                [--processor-time] [--device NAME] [--dtype float32] [--json]

The output is a Markdown table. A row is one method on one field, with the median (smallest .. largest) over
`--seeds` random starts and the target. A row holds if all starts meet the target. `--large` adds the rows with
a million cells. The script returns 1 if a row does not hold.

Quality and the share of six-sided cells are those of cells away from the walls; "all Q" is mean and minimum of
all cells. Work is in steps of the finest level: a step on a quarter of the cells counts a quarter. Errors are
absolute: no common factor is removed. With `--processor-time`, seconds are processor time over the compute units.

The 3D fields S1, S2 and S3 have a separate table. Quality is the isoperimetric quotient 36 pi V^2 / S^3
(.753 for the truncated octahedron), and "finest steps" counts the steps of the finest level alone.

Three groups of rows run if they are named. "coast" are runs in a lake with an island, of 10,000 edges. "walls" are the
figures of its cells on the boundary. "targets" are error targets of the default. "JIGSAW" are runs with at most
half the mean |e| of JIGSAW 1.0, whose quality they are to exceed: its default settings stand against "default", 64
optimization passes against "best". Figures of JIGSAW are given, not measured here: on F3 itself, else on two circles
and a ridge with other constants (7,270 and 5,776 cells, slopes from 0.15 to 0.25), so that one of our fields is less
steep, and one is steeper.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from _common import (
    FIRST_SEED,
    Report,
    clock_of,
    domain_of,
    figures,
    heading,
    make_adapter,
    names,
    off_walls,
    parser,
    spread,
    test_field,
    work,
)
from _sites import rough_lake

import clvoro
from clvoro.adaptation.tuning import EXACT_STEPS, EXACT_STEPS_3D

LARGE = ("F4",)
AT_LEAST = ("mean_quality", "min_quality", "mean_quality_all")
"""Figures that should be large. All others should be small."""


@dataclass(frozen=True)
class Row:
    """A run, and its targets.

    Its name for `--rows`, arguments of `Adapter.run`, and bounds of figures; perhaps in a lake in place of a box.
    """

    name: str
    fields: tuple[str, ...]
    arguments: dict[str, Any]
    targets: dict[str, float] = field(default_factory=dict)
    on_coast: bool = False

    @property
    def label(self) -> str:
        """The name, and the effort and the error target of a row that has one."""
        options = self.arguments.get("options")
        target = getattr(options, "error_target", None)
        effort = self.arguments.get("effort", self.arguments.get("method", "default"))
        if self.on_coast:
            return f"{self.name}: {effort}"
        return self.name if target is None else f"{self.name}: {effort}, error target {target:g}"


def aimed(name: str, fields: tuple[str, ...], effort: str, target: float, **goals: float) -> Row:
    """Return a row with an error target."""
    options = clvoro.MultilevelOptions(error_target=target)
    return Row(name, fields, {"effort": effort, "options": options}, goals)


def beside_jigsaw(fields: tuple[str, ...], effort: str, target: float, error: float, mean: float, least: float) -> Row:
    """Return a row with the goals that JIGSAW's mean |e|, mean and least Q set."""
    goals = {"mean_error": error / 2, "max_error": 0.25, "mean_quality": mean, "min_quality": least}
    return aimed("JIGSAW", fields, effort, target, **goals)


ASKED = ("targets", "JIGSAW", "coast")
"""Rows that run if they are named."""
CIRCLES, RIDGES = ("circles", "steep circles"), ("ridge", "steep ridge")

DEFAULT = {"mean_error": 0.004, "max_error": 0.04, "mean_quality": 0.990, "min_quality": 0.92, "work": 100}
EXACT = {
    "mean_deviation": 1e-4,
    "max_deviation": 2e-3,
    "mean_quality": 0.986,
    "min_quality": 0.85,
    "exact_steps": 8,
    "exact_iterations": 50,
}
KINKED = {"mean_error": 0.015, "max_error": 0.25, "mean_quality": 0.985, "min_quality": 0.92}
COAST = {"mean_error": 0.006, "max_error": 0.06, "mean_quality": 0.980}
COAST_KINKED = {"mean_error": 0.015, "max_error": 0.25, "mean_quality": 0.985}
COAST_EXACT = {"mean_deviation": 1.5e-4, "max_deviation": 3e-3, "mean_quality": 0.976}
AT_WALLS = {"wall_error": 0.006}
SOLID_DEFAULT = {"mean_error": 0.012, "max_error": 0.08, "mean_quality_all": 0.69, "finest_steps": 12}
SOLID_EXACT = {"mean_deviation": 3e-4, "max_deviation": 5e-3, "mean_quality_all": 0.67, "finest_steps": 15}
WEIGHTED = {"method": "weighted", "options": clvoro.PaperOptions(tol=0)}

ROWS = (
    Row("weighted", ("F1",), {**WEIGHTED, "max_steps": 8}, {"mean_error": 0.030}),
    Row(
        "weighted-uniform",
        ("F1",),
        {**WEIGHTED, "points": "uniform", "options": clvoro.PaperOptions(tol=0, k=1.0), "max_steps": 20},
        {"mean_error": 0.035},
    ),
    Row("default", ("F1",), {}, {"mean_error": 0.002, "max_error": 0.02, "mean_quality": 0.967, "min_quality": 0.85}),
    Row("default", ("F2", "F3", "F4"), {}, DEFAULT),
    Row("default", (*CIRCLES, *RIDGES), {}, KINKED),
    *(
        aimed("targets", ("F3", "ridge"), "default", target)
        for target in (0.0001, 0.0005, 0.001, 0.0035, 0.007, 0.014, 0.04, 0.08)
    ),
    beside_jigsaw(("F3",), "default", 0.0095, 0.0185, 0.9944, 0.959),
    beside_jigsaw(("F3",), "best", 0.0138, 0.0270, 0.9961, 0.967),
    beside_jigsaw(CIRCLES, "default", 0.0155, 0.032, 0.9887, 0.949),
    beside_jigsaw(CIRCLES, "best", 0.025, 0.051, 0.9921, 0.932),
    beside_jigsaw(RIDGES, "default", 0.025, 0.051, 0.9862, 0.927),
    beside_jigsaw(RIDGES, "best", 0.036, 0.072, 0.9896, 0.938),
    Row("best", ("F3",), {"effort": "best"}, {"mean_error": 0.004, "mean_quality": 0.994, "min_quality": 0.96}),
    Row("fast", ("F2", "F3", "F4"), {"effort": "fast"}, {"mean_error": 0.006, "mean_quality": 0.975, "work": 15}),
    Row("exact", ("F1",), {"method": "exact"}, {"max_deviation": 1e-3, "mean_quality": 0.965}),
    Row("exact", ("F2", "F3", "F4"), {"method": "exact"}, EXACT),
    Row("coast", ("F2",), {"effort": "fast"}, {"mean_error": 0.009, "mean_quality": 0.965}, True),
    Row("coast", ("F2", "F3"), {}, COAST | AT_WALLS, True),
    Row("coast", ("F2",), {"method": "exact"}, COAST_EXACT, True),
    Row("coast", (*CIRCLES, *RIDGES), {}, COAST_KINKED | AT_WALLS, True),
    Row("fast", ("S1", "S2", "S3"), {"effort": "fast"}),
    Row("default", ("S1",), {}),
    Row("default", ("S2", "S3"), {}, SOLID_DEFAULT),
    Row("best", ("S2", "S3"), {"effort": "best"}),
    Row("exact", ("S1",), {"method": "exact"}),
    Row("exact", ("S2", "S3"), {"method": "exact"}, SOLID_EXACT),
)


def is_solid(name: str) -> bool:
    """Return whether the field of that name is in three dimensions."""
    return domain_of(name).dim == 3


def measure(adapter: clvoro.Adapter, row: Row, name: str, seed: int, clock: Callable[[], float]) -> dict[str, float]:
    """Run `row` on the field of that name and return its figures."""
    start = clock()
    domain = rough_lake(10_000) if row.on_coast else domain_of(name)
    result = adapter.run(domain, test_field(name), seed=seed, **row.arguments)
    seconds = clock() - start
    history = result.history
    measured = {
        **figures(result.diagram, result.target_size, result.quality),
        **work(history),
        "seconds": seconds,
        "iterations": int(history["iterations"].sum()),
        "finest_steps": int((np.diff(history["step"]) * (history["level"][1:] == 0)).sum()),
    }
    if row.on_coast:  # sizes are those of cells with straight walls
        error, walls = np.abs(result.size_error), ~off_walls(result.diagram)
        measured |= {
            **dict.fromkeys(("mean_error", "mean_deviation"), float(error.mean())),
            **dict.fromkeys(("max_error", "max_deviation"), float(error.max())),
            "wall_cells": int(walls.sum()),
            "wall_error": float(error[walls].mean()),
            "wall_quality": float(result.quality[walls].mean()),
            "wall_least": float(result.quality[walls].min()),
        }
    if row.arguments.get("method") == "exact":
        steps = EXACT_STEPS_3D if is_solid(name) else EXACT_STEPS
        measured["exact_steps"] = steps
        extra = history["step"] > history["step"][-1] - steps
        measured["exact_iterations"] = int(history["iterations"][extra].max())
    return measured


def meets(name: str, value: float, bound: float) -> bool:
    return value >= bound if name in AT_LEAST else value <= bound


def show(figure: str, form: str) -> Any:
    """Return the function that writes `figure` of a record and its target, in bold if it is missed."""

    def text(record: dict[str, Any]) -> str:
        values = [run[figure] for run in record["runs"] if figure in run]
        if not values:
            return ""
        written = spread(values, form)
        if figure not in record["targets"]:
            return written
        bound = record["targets"][figure]
        sign = "≥" if figure in AT_LEAST else "≤"
        if not all(meets(figure, v, bound) for v in values):
            written = f"**{written}**"
        return f"{written} [{sign} {bound:g}]"

    return text


WALLS = {"cells": ".0f", "error": ".4f", "quality": ".4f", "least": ".3f"}
COLUMNS = {
    "row": lambda r: r["row"],
    "field": lambda r: r["field"],
    "cells": show("cells", ".0f"),
    "mean |e|": show("mean_error", ".5f"),
    "max |e|": show("max_error", ".5f"),
    "mean Q": show("mean_quality", ".4f"),
    "min Q": show("min_quality", ".3f"),
    "all Q": lambda r: f"{show('mean_quality_all', '.4f')(r)} / {show('min_quality_all', '.3f')(r)}",
    "walls: cells, mean |e|, Q, min Q": lambda r: ", ".join(
        filter(None, (show(f"wall_{name}", form)(r) for name, form in WALLS.items()))
    ),
    "six-sided": show("six_sided", ".1%"),
    "mean |L/h-1|": show("mean_deviation", ".1e"),
    "max |L/h-1|": show("max_deviation", ".1e"),
    "steps": show("steps", ".0f"),
    "work": show("work", ".1f"),
    "seconds": show("seconds", ".1f"),
    "exact steps": show("exact_steps", ".0f"),
    "CG its each": show("exact_iterations", ".0f"),
    "holds": lambda r: "yes" if r["holds"] else f"**no**: {', '.join(r['missed'])}",
}

SOLID_COLUMNS = {
    **{name: COLUMNS[name] for name in ("row", "field", "cells", "mean |e|", "max |e|")},
    "mean Q": show("mean_quality_all", ".4f"),
    "min Q": show("min_quality_all", ".3f"),
    "mean Q off walls": show("mean_quality", ".4f"),
    "faces": show("faces", ".2f"),
    "mean |L/h-1|": COLUMNS["mean |L/h-1|"],
    "max |L/h-1|": COLUMNS["max |L/h-1|"],
    "finest steps": show("finest_steps", ".0f"),
    **{name: COLUMNS[name] for name in ("work", "seconds", "CG its each", "holds")},
}


def no_more_steps(records: list[dict[str, Any]]) -> None:
    """Mark a row on S3 as failed if it took more steps of the finest level than on S2."""
    most = {r["row"]: max(run["finest_steps"] for run in r["runs"]) for r in records if r["field"] == "S2"}
    for record in records:
        steps = max(run["finest_steps"] for run in record["runs"])
        if record["field"] == "S3" and steps > most.get(record["row"], steps):
            record["holds"] = False
            record["missed"].append("more finest steps than on S2")


def judge(row: Row, name: str, runs: list[dict[str, float]]) -> dict[str, Any]:
    """Return the record of one row: its runs, its targets, and how often each was missed."""
    missed = []
    for figure, bound in row.targets.items():
        bad = sum(not meets(figure, run[figure], bound) for run in runs)
        if bad:
            missed.append(f"{figure} ({bad} of {len(runs)})" if len(runs) > 1 else figure)
    return {
        "row": row.label,
        "field": name,
        "targets": row.targets,
        "runs": runs,
        "holds": not missed,
        "missed": missed,
    }


def main() -> int:
    options_of = parser(__doc__)
    known = list(dict.fromkeys(row.name for row in ROWS))
    fields = list(dict.fromkeys(name for row in ROWS for name in row.fields))
    options_of.add_argument("--fields", type=names, default=fields, help=", ".join(sorted(fields)))
    options_of.add_argument("--rows", type=names, default=[r for r in known if r not in ASKED], help=", ".join(known))
    options_of.add_argument("--seeds", type=int, default=1, metavar="N", help="random starts (1)")
    options_of.add_argument("--large", action="store_true", help="also F4, a million cells")
    options_of.add_argument("--processor-time", action="store_true")
    options = options_of.parse_args()
    for what, given, allowed in (("row", options.rows, known), ("field", options.fields, fields)):
        if unknown := sorted(set(given) - set(allowed)):
            options_of.error(f"no {what} {', '.join(unknown)}; there are {', '.join(allowed)}")

    adapter = make_adapter(options)
    clock = clock_of(options, adapter)
    flat, solid = Report(options.json, COLUMNS), Report(options.json, SOLID_COLUMNS)
    # Build the kernels, so that the times of rows do not include it.
    for name in {"S1" if is_solid(name) else "F1" for name in options.fields}:
        adapter.run(domain_of(name), test_field(name), method="exact", effort="fast")
    for row in ROWS:
        for name in row.fields:
            asked = row.name in options.rows and name in options.fields
            if not asked or (name in LARGE and not options.large):
                continue
            runs = [measure(adapter, row, name, FIRST_SEED + 17 * k, clock) for k in range(options.seeds)]
            record = judge(row, name, runs)
            report = solid if is_solid(name) else flat
            report.add(record, f"{row.name} on {name}: {'yes' if record['holds'] else 'no'}")
    no_more_steps(solid.records)
    for report, where in ((flat, ""), (solid, " in 3D")):
        if report.records:
            report.finish(heading(adapter, f"Convergence{where}, {options.seeds} start(s)"))
    return 0 if all(r["holds"] for r in flat.records + solid.records) else 1


if __name__ == "__main__":
    sys.exit(main())
