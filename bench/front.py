"""The front of size against quality of all methods on one field, and a picture of the defects.

    python bench/front.py [--field F3 | --goals] [--no-best] [--seeds 1] [--out DIR] [--records FILE]
                          [--device NAME] [--dtype float32] [--json]

Runs every method and, of the adaptive one, several error targets on a field, prints a table, and on F3 draws
`front.png` (mean |e| against 1 - mean Q of the cells off the walls) and `defects.png` (cells by number of
sides) into `bench/pictures` or `--out`. Fields: F3; `circles` and `ridge`, which have kinks and are steep
(see `test_field` in `_common.py`). The runs of effort
"best" take most of the time; `--no-best` leaves them out.

Gmsh is measured if it is installed (`pip install gmsh`). The points of JIGSAW and MMG are not measured here. They are
constants of this script, for the same field, with e after one global factor on h. The picture says so.

`--goals` compares with goals instead, on several fields: runs without any argument; and runs with at most half the
mean |e| of JIGSAW, whose quality they are to exceed. See `CHOSEN` and `JIGSAW`. The script returns 1 if a goal is
missed.

`--records FILE` writes the points, one JSON object per line. If the file exists, the front is drawn
from it without any runs, and `defects.png` is not changed.
"""

from __future__ import annotations

import argparse
import io
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from _common import (
    BOX,
    FIRST_SEED,
    PICTURES,
    Report,
    cell_quality,
    figures,
    heading,
    make_adapter,
    off_walls,
    parser,
    shown,
    test_field,
    work,
)
from _remeshers import EDGE, MissingPeerError, vertices_gmsh

import clvoro

FIELDS = ("F3", "circles", "ridge")
REPEATED = 100
"""Steps of the methods that repeat one kind of step."""

NOTES = (("JIGSAW", 0.0185, 0.9944), ("JIGSAW, 64 passes", 0.0270, 0.9961), ("MMG2D", 0.056, 0.965))
"""Published meshers on this field: name, mean |e|, mean Q. Given, not measured by this script."""

ERROR_TARGETS = {
    "fast": (None, 0.0015, 0.007, 0.014, 0.04),
    "default": (None, 0.0001, 0.0005, 0.001, 0.0035, 0.007, 0.014, 0.04, 0.08),
    "best": (None, 0.0005, 0.0012, 0.002, 0.008, 0.016, 0.04, 0.08),
}
"""Error targets per effort; None is the effort's own."""

JIGSAW = {
    ("F3", "default"): (0.0095, 0.0185, 0.9944, 0.959),
    ("F3", "best"): (0.0138, 0.0270, 0.9961, 0.967),
    ("circles", "default"): (0.0155, 0.032, 0.9887, 0.949),
    ("steep circles", "default"): (0.0155, 0.032, 0.9887, 0.949),
    ("circles", "best"): (0.025, 0.051, 0.9921, 0.932),
    ("steep circles", "best"): (0.025, 0.051, 0.9921, 0.932),
    ("ridge", "default"): (0.025, 0.051, 0.9862, 0.927),
    ("steep ridge", "default"): (0.025, 0.051, 0.9862, 0.927),
    ("ridge", "best"): (0.036, 0.072, 0.9896, 0.938),
    ("steep ridge", "best"): (0.036, 0.072, 0.9896, 0.938),
}
"""Field and effort -> our error target; mean |e|, mean and least Q of JIGSAW 1.0.

Its default settings stand against "default", 64 optimization passes against "best". Figures of JIGSAW are given, not
measured by this script: on F3 itself, else on two circles and a ridge with other constants (7,270 and 5,776 cells,
slopes from 0.15 to 0.25), so that we compare on a field that is less steep and on one that is steeper."""

SMOOTH = {"mean_error": 0.004, "mean_quality": 0.99, "min_quality": 0.92}
STEEP = {"mean_error": 0.015, "mean_quality": 0.985, "min_quality": 0.92}
CHOSEN = {"F2": SMOOTH, "F3": SMOOTH, "circles": STEEP, "ridge": STEEP, "steep circles": STEEP, "steep ridge": STEEP}
"""Goals of runs without any argument."""
LARGEST_ERROR = 0.25

DEFECTS = (
    ("weighted", f"weighted, {REPEATED} steps"),
    ("adaptive fast", 'effort="fast"'),
    ("adaptive default", "default"),
    ("adaptive best", 'effort="best"'),
)
"""Points whose cells are drawn, and how they are called."""


def plan(best: bool) -> list[tuple[str, str, dict[str, Any]]]:
    """Return (group, name, arguments of `Adapter.run`) of every point."""
    points: list[tuple[str, str, dict[str, Any]]] = []
    for method in ("lloyd", "weighted-lloyd", "poisson", "coupled", "weighted"):
        points.append(
            (method, method, {"method": method, "max_steps": REPEATED, "options": clvoro.PaperOptions(tol=0)})
        )
    efforts = [e for e in ERROR_TARGETS if best or e != "best"]
    for effort in efforts:
        for target in ERROR_TARGETS[effort]:
            name = f"adaptive {effort}" + ("" if target is None else f", target {target:g}")
            aimed = clvoro.MultilevelOptions(error_target=target)
            points.append((f"adaptive {effort}", name, {"effort": effort, "options": aimed}))
    for effort in efforts:
        points.append(("exact", f"exact {effort}", {"method": "exact", "effort": effort}))
    return points


def measure(
    adapter: clvoro.Adapter, field: str, group: str, name: str, arguments: dict[str, Any], seeds: int
) -> tuple[dict[str, Any], clvoro.Result]:
    """Return the record of one point, medians over the seeds, and the first seed's result."""
    runs, first = [], None
    for k in range(seeds):
        start = time.perf_counter()
        result = adapter.run(BOX, test_field(field), seed=FIRST_SEED + 17 * k, **arguments)
        seconds = time.perf_counter() - start
        first = first or result
        runs.append(
            {**figures(result.diagram, result.target_size, result.quality), **work(result.history), "seconds": seconds}
        )
    medians = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
    assert first is not None
    return {"group": group, "name": name, **medians}, first


def measure_gmsh(adapter: clvoro.Adapter) -> dict[str, Any] | None:
    size = test_field("F3")
    try:
        points, seconds = vertices_gmsh(BOX, size, EDGE[2])
    except MissingPeerError:
        return None
    diagram, h = adapter.diagram(BOX, points), np.asarray(size(points))
    common = float(np.exp(np.log(np.sqrt(diagram.volumes) / h)[off_walls(diagram)].mean()))
    found = figures(diagram, h * common, cell_quality(diagram))
    # Its vertices on the walls have cut cells: those are no part of the comparison.
    found["mean_error"], found["max_error"] = found["mean_error_inner"], found["max_error_inner"]
    return {"group": "Gmsh", "name": "Gmsh", **found, "seconds": seconds}


PAPER = ("lloyd", "poisson", "coupled")
STYLES = {
    "lloyd": ("lloyd (paper)", "v", "#555555"),
    "poisson": ("poisson (paper)", "^", "#555555"),
    "coupled": ("coupled (paper)", "s", "#555555"),
    "weighted-lloyd": ("weighted-lloyd", "v", "#56B4E9"),
    "weighted": ("weighted", "s", "#56B4E9"),
    "adaptive fast": ('adaptive, "fast"', "o", "#E69F00"),
    "adaptive default": ("adaptive, default", "o", "#0072B2"),
    "adaptive best": ('adaptive, "best"', "o", "#009E73"),
    "exact": ("exact", "D", "#CC79A7"),
    "Gmsh": ("Gmsh, measured here", "X", "#D55E00"),
}
"""Group -> label, marker, color."""


def draw_front(records: list[dict[str, Any]], path: Path, caption: str) -> None:
    from clvoro.plotting.style import new_figure, styled

    with styled():
        figure = new_figure(7.0, 4.5)
        ax = figure.add_subplot()
        for group, (label, marker, color) in STYLES.items():
            mine = [r for r in records if r["group"] == group]
            if not mine:
                continue
            if group.startswith("adaptive"):
                line = sorted(mine, key=lambda r: r["mean_error"])
                ax.plot(
                    [r["mean_error"] for r in line],
                    [1 - r["mean_quality"] for r in line],
                    color=color,
                    linewidth=1,
                    alpha=0.6,
                    zorder=2,
                )
            for k, r in enumerate(mine):
                own = not group.startswith("adaptive") or "target" not in r["name"]
                # The paper's methods are drawn larger: theirs may lie under another marker.
                ax.scatter(
                    r["mean_error"],
                    1 - r["mean_quality"],
                    marker=marker,
                    s=18 if not own else 90 if group in PAPER else 46,
                    color=color,
                    edgecolor="white",
                    linewidth=0.6,
                    zorder=4 if own else 3,
                    label=label if k == 0 else None,
                )
        for k, (name, error, quality) in enumerate(NOTES):
            ax.scatter(
                error,
                1 - quality,
                marker="*",
                s=90,
                facecolor="none",
                edgecolor="#1A1A1A",
                linewidth=0.9,
                zorder=3,
                label="notes: given figures,\nnot measured here*" if k == 0 else None,
            )
            ax.annotate(
                name.replace(", ", ",\n"),
                (error, 1 - quality),
                xytext=(8, 0),
                textcoords="offset points",
                fontsize=7.5,
                va="center",
            )
        for r in records:
            if r["group"] == "exact":
                ax.annotate(
                    r["name"].split()[-1],
                    (r["mean_error"], 1 - r["mean_quality"]),
                    xytext=(6, 2),
                    textcoords="offset points",
                    fontsize=7,
                    color="#8A4A73",
                )
        ax.set_xscale("log")
        ax.set_xlim(right=0.3)
        ax.set_yscale("log")
        ax.set_xlabel("mean metric error |e| [–]")
        ax.set_ylabel("1 − mean cell quality Q [–], cells off the walls")
        ax.grid(which="major", linewidth=0.4, alpha=0.5)
        ax.grid(which="minor", linewidth=0.25, alpha=0.25)
        ax.set_axisbelow(True)
        ax.annotate(
            "better",
            xy=(0.015, 0.02),
            xytext=(0.085, 0.095),
            xycoords="axes fraction",
            textcoords="axes fraction",
            fontsize=8,
            color="#777777",
            arrowprops={"arrowstyle": "->", "color": "#777777", "linewidth": 0.8},
        )
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, labelspacing=0.7)
        ax.set_title(caption, loc="left", fontsize=8)
        figure.supxlabel(
            "* e after one global factor on h. Every other point is measured by this script: "
            "absolute size field, but one factor for Gmsh.",
            fontsize=7,
            x=0.01,
            ha="left",
        )
        figure.savefig(path, dpi=220)


def draw_defects(results: dict[str, clvoro.Result], path: Path) -> None:
    from matplotlib.patches import Patch
    from PIL import Image

    from clvoro.plotting import plot_cells
    from clvoro.plotting.cells import COLORINGS
    from clvoro.plotting.style import new_figure, styled

    panels = [(results[key], title) for key, title in DEFECTS if key in results]
    window = ((0.72, 0.42), (1.52, 0.98))
    columns = 2
    rows = -(-len(panels) // columns)
    shape = (window[1][1] - window[0][1]) / (window[1][0] - window[0][0])
    with styled():
        figure = new_figure(7.0, rows * (3.4 * shape + 0.42) + 0.35)
        axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
        for k, (ax, (result, title)) in enumerate(zip(axes, panels, strict=False)):
            f = figures(result.diagram, result.target_size, result.quality)
            error = np.abs(result.size_error).mean()
            plot_cells(result, "sides", ax, window=window, key=False)
            ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
            ax.set_title(
                f"({'abcd'[k]}) {title}: {f['six_sided']:.1%} six-sided\n"
                f"mean |e| {error:.4f}, mean Q {f['mean_quality']:.4f}, "
                f"min Q {f['min_quality']:.2f}",
                fontsize=8,
                loc="left",
            )
        for ax in axes[len(panels) :]:
            ax.set_axis_off()
        colors = COLORINGS["sides"].color_map.colors
        labels = ("4 or fewer sides", "5", "6", "7", "8 or more")
        figure.legend(
            handles=[
                Patch(facecolor=c, edgecolor="#1A1A1A", linewidth=0.4, label=label)
                for c, label in zip(colors, labels, strict=True)
            ],
            loc="outside lower center",
            ncols=5,
            frameon=False,
            handlelength=1.2,
        )
        drawn = io.BytesIO()
        figure.savefig(drawn, dpi=300)
    # Few colors: a palette makes the file several times smaller.
    with Image.open(drawn) as image:
        image.convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE).save(path, optimize=True, dpi=(300, 300))


COLUMNS = {
    "method": lambda r: r["name"],
    "cells": shown("cells", ".0f"),
    "mean |e|": shown("mean_error", ".5f"),
    "max |e|": shown("max_error", ".4f"),
    "mean Q": shown("mean_quality", ".4f"),
    "min Q": shown("min_quality", ".3f"),
    "six-sided": shown("six_sided", ".1%"),
    "work": shown("work", ".0f"),
    "seconds": shown("seconds", ".1f"),
}


def run_all(adapter: clvoro.Adapter, options: argparse.Namespace, report: Report) -> dict[str, clvoro.Result]:
    kept: dict[str, clvoro.Result] = {}
    drawn = {key for key, _ in DEFECTS}
    for group, name, arguments in plan(options.best):
        record, result = measure(adapter, options.field, group, name, arguments, options.seeds)
        report.add(record, f"{name}: mean |e| {record['mean_error']:.4f}")
        if name in drawn:
            kept[name] = result
        if options.records:
            with options.records.open("a") as file:
                file.write(json.dumps(record) + "\n")
    return kept


def goal_runs(best: bool) -> list[tuple[str, str, dict[str, Any], dict[str, float]]]:
    """Return (field, what, arguments of `Adapter.run`, goals) of each comparison."""
    runs: list[tuple[str, str, dict[str, Any], dict[str, float]]] = [
        (field, "chosen by itself", {}, goals) for field, goals in CHOSEN.items()
    ]
    for (field, effort), (target, error, mean, least) in JIGSAW.items():
        if best or effort != "best":
            aimed = {"effort": effort, "options": clvoro.MultilevelOptions(error_target=target)}
            passes = "64 passes" if effort == "best" else "default"
            goals = {"mean_error": error / 2, "mean_quality": mean, "min_quality": least}
            runs.append((field, f"{effort}, target {target:g}, against JIGSAW, {passes}", aimed, goals))
    return runs


GOAL_COLUMNS = {
    "field": lambda r: r["field"],
    "run": lambda r: r["name"],
    "cells": COLUMNS["cells"],
    "mean |e|": lambda r: f"{r['mean_error']:.4f} [≤ {r['goals']['mean_error']:.4g}]",
    "max |e|": lambda r: f"{r['max_error']:.3f} [≤ {LARGEST_ERROR}]",
    "mean Q": lambda r: f"{r['mean_quality']:.4f} [≥ {r['goals']['mean_quality']:.4g}]",
    "min Q": lambda r: f"{r['min_quality']:.3f} [≥ {r['goals']['min_quality']:.3g}]",
    "work": COLUMNS["work"],
    "seconds": COLUMNS["seconds"],
    "holds": lambda r: "yes" if r["holds"] else "**no**",
}


def compare(adapter: clvoro.Adapter, options: argparse.Namespace) -> int:
    """Print the table of the goals; return 1 if one is missed."""
    report = Report(options.json, GOAL_COLUMNS)
    for field, name, arguments, goals in goal_runs(options.best):
        record, result = measure(adapter, field, field, name, arguments, options.seeds)
        if not arguments:
            record["name"] = result.settings["trade"]
        holds = record["max_error"] <= LARGEST_ERROR and record["mean_error"] <= goals["mean_error"]
        holds &= all(record[q] >= goals[q] for q in ("mean_quality", "min_quality"))
        report.add({**record, "field": field, "goals": goals, "holds": holds}, f"{field}, {name}")
    report.finish(heading(adapter, f"Size against quality, {options.seeds} start(s)"))
    return 0 if all(r["holds"] for r in report.records) else 1


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--field", choices=FIELDS, default="F3")
    options_of.add_argument("--seeds", type=int, default=1, metavar="N", help="medians over N (1)")
    options_of.add_argument("--best", action=argparse.BooleanOptionalAction, default=True, help='effort "best" too')
    options_of.add_argument("--goals", action="store_true", help="compare with the goals on several fields")
    options_of.add_argument("--out", type=Path, default=PICTURES, metavar="DIR")
    options_of.add_argument("--records", type=Path, metavar="FILE")
    options = options_of.parse_args()

    adapter = make_adapter(options)
    if options.goals:
        return compare(adapter, options)
    report = Report(options.json, COLUMNS)
    results: dict[str, clvoro.Result] = {}
    if options.records and options.records.exists():
        for line in options.records.read_text().splitlines():
            report.add(json.loads(line))
    else:
        results = run_all(adapter, options, report)
    if options.field == "F3":
        gmsh = measure_gmsh(adapter)
        if gmsh is not None:
            report.add(gmsh, "Gmsh")
        options.out.mkdir(parents=True, exist_ok=True)
        cells = statistics.median(r["cells"] for r in report.records)
        draw_front(
            report.records,
            options.out / "front.png",
            f"F3: sizes 1 : 7.5, {cells:,.0f} cells. Small markers: runs with an error_target",
        )
        if results:
            draw_defects(results, options.out / "defects.png")
    report.finish(heading(adapter, f"Size against quality on {options.field}"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
