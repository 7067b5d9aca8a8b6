"""Every method side by side: those of the paper's section 2, the paper's own, clvoro's, and other meshers.

    python bench/methods.py [--fields paper,F3] [--methods "mmpde; coupled"] [--fast] [--out DIR] [--records FILE]
                            [--device NAME] [--dtype float32] [--json]

Prints one table per field, a compact one of all fields, and the growth of time and error with the number of cells. With
all fields, `methods.png` is drawn into `bench/pictures` or `--out`. `--fast` leaves out the fields with more than
10,000 cells, the effort "best" and the growth. `--records FILE` writes one JSON object per line; if the file exists,
tables are made from it, without any runs and without the picture.

Fields: "paper" is the paper's case (F1; the paper's methods from a uniform start, with k = 1); F2, F3, circles, ridge,
corner and S2 are those of `_common.py`, from a random start with the density h^-d. All methods are judged in the same
way: e after one common factor on h, because other meshers do not promise a count, and the cells off the walls, because
vertices on walls have cut cells. "changes" is the sum over all steps of the cells whose neighbors have changed, per
cell. "CPU s" is the processor time of all threads; kernels are built before. Gmsh and MMG (pip install gmsh mmgpy) are
left out with a note if they are not there. JIGSAW's figures are given, not measured by this script: JIGSAW 1.0, one
global factor on h, cells off the walls, default settings and 64 optimization passes, wall time of another machine.
"""

from __future__ import annotations

import io
import json
import math
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# BLAS must not start threads in peers that are serial.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from _common import (
    FIRST_SEED,
    PICTURES,
    Report,
    cell_quality,
    domain_of,
    figures,
    heading,
    make_adapter,
    markdown,
    names,
    off_walls,
    parser,
    shown,
    test_field,
)
from _insertion import insert_delete_smooth
from _remeshers import MESHERS, MissingPeerError, remesh

import clvoro
from clvoro.adaptation.sampling.start import count_cells

FIELDS = ("paper", "F2", "F3", "circles", "ridge", "corner", "S2")
SMALL = ("paper", "circles", "ridge", "corner")
REPEATED, MOVED = 100, 1000
"""Steps of the methods that repeat one kind of step, and most steps of moving meshes, which may end before."""
GROWTH_FIELD, GROWTH_FACTOR = "circles", 0.5


@dataclass(frozen=True)
class Way:
    """A method: its name, where it comes from, its marker and color in pictures, and arguments of `Adapter.run`."""

    name: str
    source: str
    marker: str
    color: str
    arguments: dict[str, Any] | None = None

    @property
    def style(self) -> dict[str, Any]:
        """How it is drawn; hollow if its figures are given."""
        face = "none" if self.source == "given" else self.color
        return {"linestyle": "", "marker": self.marker, "color": self.color, "markerfacecolor": face}


def repeated(method: str, **more: Any) -> dict[str, Any]:
    return {"method": method, "max_steps": REPEATED, "options": clvoro.PaperOptions(tol=0), **more}


GRAY, BLUE, SKY, ORANGE = "#555555", "#0072B2", "#56B4E9", "#E69F00"
GREEN, PINK, RED = "#009E73", "#CC79A7", "#D55E00"
WAYS = (
    Way("insertion and deletion", "2.3.1", "P", ORANGE),
    Way("weighted-lloyd", "2.3.2", "v", SKY, repeated("weighted-lloyd")),
    Way("transport", "2.3.3", "h", GREEN, {"method": "transport"}),
    Way("mmpde", "2.3.4", "d", PINK, {"method": "mmpde", "max_steps": MOVED}),
    Way("monge-ampere", "2.3.4", "D", PINK, {"method": "monge-ampere", "max_steps": MOVED}),
    Way("lloyd", "the paper", "v", GRAY, repeated("lloyd")),
    Way("poisson", "the paper", "^", GRAY, repeated("poisson")),
    Way("coupled", "the paper", "s", GRAY, repeated("coupled")),
    Way("weighted", "clvoro", "s", SKY, repeated("weighted")),
    Way("adaptive, fast", "clvoro", "o", ORANGE, {"effort": "fast"}),
    Way("adaptive, default", "clvoro", "o", BLUE, {}),
    Way("adaptive, best", "clvoro", "o", GREEN, {"effort": "best"}),
    Way("exact", "clvoro", "p", BLUE, {"method": "exact"}),
    Way("Gmsh", "peer", "X", RED),
    Way("MMG", "peer", "x", RED),
    Way("JIGSAW", "given", "*", "#1A1A1A"),
    Way("JIGSAW, 64 passes", "given", "*", "#1A1A1A"),
)
GIVEN = {
    ("F3", "JIGSAW"): (11454, 0.0185, 0.164, 0.9944, 0.959, None),
    ("F3", "JIGSAW, 64 passes"): (11454, 0.0270, 0.255, 0.9961, 0.967, None),
    ("circles", "JIGSAW"): (7270, 0.032, None, 0.9887, 0.949, 0.9),
    ("circles", "JIGSAW, 64 passes"): (7270, 0.051, None, 0.9921, 0.932, 1.7),
    ("ridge", "JIGSAW"): (5776, 0.051, None, 0.9862, 0.927, None),
    ("ridge", "JIGSAW, 64 passes"): (5776, 0.072, None, 0.9896, 0.938, None),
}
"""JIGSAW's cells, mean and max |e|, mean and min Q, seconds, on another machine. Its two circles have another scale."""
DRAWN = ("coupled", "mmpde", "monge-ampere", "adaptive, default", "Gmsh", "insertion and deletion")
WINDOW = ((1.3, 0.62), (1.66, 0.88))
LEFT = 3e-4
"""Smallest mean |e| in the picture: smaller ones are drawn there."""


def field_of(name: str) -> clvoro.sizing.Field:
    return test_field("F1" if name == "paper" else name)


def judge(diagram: clvoro.Diagram, h: np.ndarray) -> dict[str, float]:
    """Return the figures of the cells off the walls, after one common factor on the sizes h (n,)."""
    d = diagram.points.shape[1]
    common = float(np.exp(np.log(diagram.volumes ** (1 / d) / h)[off_walls(diagram)].mean()))
    found = figures(diagram, h * common, cell_quality(diagram))
    return {
        "cells": len(diagram),
        "mean_error": found["mean_error_inner"],
        "max_error": found["max_error_inner"],
        "mean_quality": found["mean_quality"],
        "min_quality": found["min_quality"],
        "factor": common,
    }


def measure(
    adapter: clvoro.Adapter, way: Way, name: str, factor: float = 1.0
) -> tuple[dict[str, Any], clvoro.Diagram | clvoro.Result]:
    """Return the record of one method on one field, and its mesh."""
    domain, size = domain_of("F1" if name == "paper" else name), field_of(name) * factor
    record: dict[str, Any] = {"field": name, "method": way.name, "source": way.source, "scale": factor}
    if way.arguments is not None:
        arguments, start = dict(way.arguments), "density"
        if name == "paper" and way.source == "the paper":
            arguments["options"], start = clvoro.PaperOptions(tol=0, k=1.0), "uniform"
        begun = time.process_time()
        mesh = adapter.run(domain, size, points=start, seed=FIRST_SEED, **arguments)
        record |= {"seconds": time.process_time() - begun, "steps": int(mesh.history["step"][-1])}
        record["changes"] = float((mesh.history["changed"] / mesh.history["cells"]).sum())
        return {**record, **judge(mesh.diagram, mesh.target_size)}, mesh
    if way.name == "insertion and deletion":
        begun = time.process_time()
        points, steps, changes = insert_delete_smooth(adapter, domain, size, FIRST_SEED)
        record |= {"seconds": time.process_time() - begun, "steps": steps, "changes": changes}
    else:
        points, record["seconds"] = remesh(MESHERS[way.name], domain, size, round(count_cells(size, domain)))
    diagram = adapter.diagram(domain, points)
    return {**record, **judge(diagram, np.asarray(size(points)))}, diagram


def given(name: str, way: Way) -> dict[str, Any] | None:
    """Return the given record of a peer, if there is one."""
    if (name, way.name) not in GIVEN:
        return None
    keys = ("cells", "mean_error", "max_error", "mean_quality", "min_quality", "seconds")
    figures_of = dict(zip(keys, GIVEN[name, way.name], strict=True))
    return {"field": name, "method": way.name, "source": way.source, "scale": 1.0, **figures_of}


COLUMNS: dict[str, Callable[[dict[str, Any]], object]] = {
    "method": lambda r: r["method"],
    "source": lambda r: r["source"],
    "cells": shown("cells", ",.0f"),
    "mean |e|": shown("mean_error", ".4f"),
    "max |e|": shown("max_error", ".3f"),
    "mean Q": shown("mean_quality", ".4f"),
    "min Q": shown("min_quality", ".3f"),
    "changes": shown("changes", ".1f"),
    "steps": shown("steps", ".0f"),
    "CPU s": shown("seconds", ".2f"),
}


def compact(records: list[dict[str, Any]]) -> str:
    """Return the table of all methods and fields: mean |e|, and below it mean Q / min Q."""
    found = {(r["method"], r["field"]): r for r in records if r["scale"] == 1}
    fields = [name for name in FIELDS if any(name == field for _, field in found)]

    def cell(r: dict[str, Any] | None) -> str:
        if r is None:
            return ""
        mean, least = (f"{r[key]:.{digits}f}".lstrip("0") for key, digits in (("mean_quality", 3), ("min_quality", 2)))
        text = f"{100 * r['mean_error']:.1f} %<br>{mean} / {least}"
        return text.replace(" ", "\N{NO-BREAK SPACE}")

    rows = [
        [f"{way.name} ({way.source})", *(cell(found.get((way.name, name))) for name in fields)]
        for way in WAYS
        if any(way.name == method for method, _ in found)
    ]
    return markdown(["method", *fields], rows)


def growth(records: list[dict[str, Any]]) -> str:
    """Return the table of time, steps and error on a field and with half its sizes.

    "exponent" is that of time in the number of cells.
    """
    rows = []
    for way in WAYS:
        pair = [
            r
            for scale in (1, GROWTH_FACTOR)
            for r in records
            if (r["method"], r["field"], r["scale"], r["source"] == "given") == (way.name, GROWTH_FIELD, scale, False)
        ]
        if len(pair) == 2:
            small, large = pair
            times, cells = large["seconds"] / small["seconds"], large["cells"] / small["cells"]
            texts = [
                f"{small[key]:{form}} → {large[key]:{form}}" if small.get(key) is not None else ""
                for key, form in (
                    ("cells", ",.0f"),
                    ("seconds", ".2f"),
                    ("steps", ".0f"),
                    ("mean_error", ".4f"),
                    ("min_quality", ".3f"),
                )
            ]
            rows.append([way.name, *texts[:2], f"{math.log(times) / math.log(cells):.2f}", *texts[2:]])
    return markdown(["method", "cells", "CPU s", "exponent", "steps", "mean |e|", "min Q"], rows)


TITLES = {
    "paper": "the paper's case",
    "F2": "F2, sizes 1 : 60",
    "F3": "F3, with a cap",
    "circles": "two circles, a kink",
    "ridge": "a sine ridge",
    "corner": "a corner singularity",
    "S2": "S2, in 3D",
}


def draw(records: list[dict[str, Any]], meshes: dict[str, Any], path: Path) -> None:
    """Draw the errors and qualities of all fields, and a part of the meshes of one."""
    from matplotlib.lines import Line2D
    from matplotlib.ticker import NullFormatter
    from PIL import Image

    from clvoro.plotting import plot_cells
    from clvoro.plotting.style import new_figure, styled

    with styled():
        figure = new_figure(7.4, 7.4)
        grid = figure.add_gridspec(4, 12, height_ratios=[1.0, 1.0, 0.8, 0.8])
        axes = [figure.add_subplot(grid[k // 4, 3 * (k % 4) : 3 * (k % 4) + 3]) for k in range(8)]
        for ax, name in zip(axes, FIELDS, strict=False):
            for way in WAYS:
                for r in records:
                    if (r["method"], r["field"], r["scale"]) != (way.name, name, 1):
                        continue
                    at = max(r["mean_error"], LEFT), 1 - r["mean_quality"]
                    ax.plot(*at, zorder=3, markersize=5.8, markeredgewidth=0.8, **way.style)
            solid = name.startswith("S")
            ax.set(xscale="log", yscale="linear" if solid else "log", title=TITLES[name], xlim=(0.7 * LEFT, 2))
            ax.set_ylim(*((0.2, 0.5) if solid else (0.002, 0.4)))
            if not solid:
                ax.yaxis.set_minor_formatter(NullFormatter())
            ax.title.set_fontsize(8)
            ax.grid(which="major", linewidth=0.3, alpha=0.5)
            ax.tick_params(which="both", labelsize=6.5)
            ax.set_axisbelow(True)
        axes[7].set_axis_off()
        present = {r["method"] for r in records}
        shown = [w for w in WAYS if w.name in present and w.name != "JIGSAW, 64 passes"]
        handles = [Line2D([], [], markersize=5, label=w.name, **w.style) for w in shown]
        axes[7].legend(handles=handles, loc="center", frameon=False, fontsize=6.8, labelspacing=0.35)
        for k in (0, 4):
            axes[k].set_ylabel("1 − mean quality Q [–]", fontsize=8)
        for k in range(3, 7):
            axes[k].set_xlabel("mean size error |e| [–]", fontsize=8)
        for k, name in enumerate(DRAWN):
            ax = figure.add_subplot(grid[2 + k // 3, 4 * (k % 3) : 4 * (k % 3) + 4])
            ax.set_axis_off()
            quality = cell_quality(getattr(meshes[name], "diagram", meshes[name]))
            plot_cells(meshes[name], quality, ax, limits=(0.6, 1), window=WINDOW, key=False)
            ax.set_title(name, fontsize=8)
        drawn = io.BytesIO()
        figure.savefig(drawn, dpi=220)
    with Image.open(drawn) as image:
        image.convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE).save(path, optimize=True, dpi=(220, 220))


def run_all(adapter: clvoro.Adapter, options: Any) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the records of all methods and fields, and the meshes that are drawn."""
    records, meshes = [], {}
    ways = [w for w in WAYS if w.name in options.methods]
    for d in {domain_of("F1" if name == "paper" else name).dim for name in options.fields}:
        for way in ways:  # builds the kernels
            if way.arguments is not None:
                adapter.run(
                    domain_of("S1" if d == 3 else "F1"),
                    test_field("S1" if d == 3 else "F1"),
                    **{**way.arguments, "max_steps": 12, "options": None},
                )
    plan = [(name, 1.0) for name in options.fields]
    if not options.fast and GROWTH_FIELD in options.fields:
        plan.append((GROWTH_FIELD, GROWTH_FACTOR))
    for name, factor in plan:
        for way in ways:
            if way.source == "given":
                if factor == 1 and (quoted := given(name, way)) is not None:
                    records.append(quoted)
                continue
            try:
                record, mesh = measure(adapter, way, name, factor)
            except MissingPeerError as error:
                print(f"{way.name} left out: needs {error}", file=sys.stderr)
                continue
            records.append(record)
            if (name, factor) == (GROWTH_FIELD, 1) and way.name in DRAWN:
                meshes[way.name] = mesh
            print(f"{name} x {factor:g}, {way.name}: {record['seconds']:.1f} s", file=sys.stderr, flush=True)
    return records, meshes


def main() -> None:
    options_of = parser(__doc__)
    known = [way.name for way in WAYS]
    options_of.add_argument("--fields", type=names, help=", ".join(FIELDS))
    options_of.add_argument(
        "--methods", type=lambda text: [m.strip() for m in text.split(";")], default=known, help="; ".join(known)
    )
    options_of.add_argument("--fast", action="store_true", help="a few minutes less; see above")
    options_of.add_argument("--out", type=Path, default=PICTURES, metavar="DIR")
    options_of.add_argument("--records", type=Path, metavar="FILE")
    options = options_of.parse_args()
    options.fields = options.fields or list(SMALL if options.fast else FIELDS)
    if options.fast:
        options.methods = [name for name in options.methods if name != "adaptive, best"]
    for what, asked, allowed in (("field", options.fields, FIELDS), ("method", options.methods, known)):
        if unknown := sorted(set(asked) - set(allowed)):
            options_of.error(f"no {what} {', '.join(unknown)}; there are {'; '.join(allowed)}")
    adapter = make_adapter(options)
    meshes: dict[str, Any] = {}
    if options.records and options.records.exists():
        records = [json.loads(line) for line in options.records.read_text().splitlines()]
    else:
        records, meshes = run_all(adapter, options)
        if options.records:
            options.records.write_text("".join(json.dumps(r) + "\n" for r in records))
    for name in FIELDS:
        report = Report(options.json, COLUMNS)
        for record in records:
            if (record["field"], record["scale"]) == (name, 1):
                report.add(record)
        if report.records:
            report.finish(heading(adapter, f"All methods on {name}: {TITLES[name]}"))
    if not options.json:
        print(f"All methods and fields: mean |e|, mean Q / min Q.\n\n{compact(records)}\n")
        print(f"Growth on {GROWTH_FIELD}, and with half its sizes.\n\n{growth(records)}\n")
    if meshes and set(FIELDS) <= {r["field"] for r in records}:
        options.out.mkdir(parents=True, exist_ok=True)
        draw(records, meshes, options.out / "methods.png")


if __name__ == "__main__":
    main()
