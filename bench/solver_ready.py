"""Whether OpenFOAM accepts the meshes: `checkMesh -allGeometry -allTopology` for domains with hard walls.

    python bench/solver_ready.py [--only NAMES] [--effort NAMES] [--exact] [--seeds N or NUMBERS] [--keep FOLDER]
                                 [--pictures FOLDER] [--device NAME] [--dtype float32] [--json]

Each mesh is adapted, written as polyMesh with default settings, and given to OpenFOAM's `checkMesh`. A row has the
largest non-orthogonality and skewness that `checkMesh` prints, the number of concave cells, the largest angle by which
a cell is concave, the error and quality of cells on walls and of the others, and the verdict. Without OpenFOAM the
script ends with a message. Debian's package `openfoam` is enough.

The domains are in `bench/_walled.py` and `bench/_sites.py`. S3 has 1e5 cells; S2 and S3 run with their default effort
only, unless they are named in --only.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from _common import Report, heading, make_adapter, names, off_walls, parser, seeds_of
from _openfoam import require
from _sites import SITES
from _walled import WALLED

import clvoro
from clvoro.errors import InputError
from clvoro.io.check_mesh import CheckMeshResult, check_case

NUMBER = r"([-+.\deE]*\d)"
FIGURES = {
    "non_orthogonality": rf"non-orthogonality Max: {NUMBER}",
    "mean_non_orthogonality": rf"non-orthogonality Max: {NUMBER} average: {NUMBER}",
    "skewness": rf"Max skewness = {NUMBER}",
    "concave": r"Concave cells .*number of cells: (\d+)",
}
LARGE = ("S2", "S3")
DOMAINS: dict[str, Callable[[], tuple[Any, Any, dict[str, Any]]]] = {**WALLED, **SITES}


def figures_of(verdict: CheckMeshResult) -> dict[str, Any]:
    """Return the figures in the output of checkMesh, and what it says of the mesh."""
    matches = {name: re.search(pattern, verdict.text) for name, pattern in FIGURES.items()}
    found: dict[str, Any] = {k: float(m.group(m.lastindex or 1)) if m else 0.0 for k, m in matches.items()}
    complaints = "; ".join(line[:70] for line in verdict.complaints)
    return {**found, "ok": verdict.ok, "complaints": complaints}


def measure(result: clvoro.Result, case: Path) -> dict[str, Any]:
    """Write the mesh, check it, and return its figures."""
    begin = time.process_time()
    solver = result.solver_mesh().measures
    seconds = time.process_time() - begin
    try:
        result.to_openfoam(case / "constant" / "polyMesh", check=False)
        verdict = check_case(case)
        (case / "checkMesh.log").write_text(verdict.text)
    except InputError as error:  # a cell that goes around an island is no polygon
        verdict = CheckMeshResult(False, (str(error),), "")
    d = result.diagram
    inner = off_walls(d)
    wall, e = ~inner, np.abs(result.size_error)

    def of(values: np.ndarray, part: np.ndarray, how: str) -> float:
        return float(getattr(values[part], how)()) if part.any() else float("nan")

    return {
        "cells": len(d),
        "solver_mesh_seconds": seconds,
        **figures_of(verdict),
        "concave_degrees": float(solver.concavity.max()),
        "shortest": float(solver.shortest_edge.min()),
        "wall_error": of(e, wall, "mean"),
        "wall_quality": of(result.quality, wall, "min"),
        "inner_error": of(e, inner, "mean"),
        "inner_quality": of(result.quality, inner, "mean"),
    }


COLUMNS = {
    "domain": lambda r: r["domain"],
    "run": lambda r: r["run"],
    "cells": lambda r: r["cells"],
    "s": lambda r: f"{r['seconds']:.1f}",
    "non-orth.": lambda r: f"{r['non_orthogonality']:.1f}",
    "skewness": lambda r: f"{r['skewness']:.2f}",
    "concave cells": lambda r: f"{r['concave']:.0f}",
    "by degrees": lambda r: f"{r['concave_degrees']:.2g}",
    "shortest edge": lambda r: f"{r['shortest']:.1e}",
    "mean e, min Q at walls": lambda r: f"{r['wall_error']:.4f}, {r['wall_quality']:.3f}",
    "mean e, mean Q inside": lambda r: f"{r['inner_error']:.4f}, {r['inner_quality']:.4f}",
    "checkMesh": lambda r: "Mesh OK" if r["ok"] else f"fails: {r['complaints'][:120]}",
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--only", default="", metavar="NAMES", help=", ".join(DOMAINS))
    options_of.add_argument("--effort", default="default,best", metavar="NAMES")
    options_of.add_argument("--exact", action="store_true", help="also runs with method='exact'")
    options_of.add_argument("--seeds", default="", metavar="NUMBERS", help="one run with each; N for 1 to N")
    options_of.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the cases, with checkMesh.log")
    options_of.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw each 2D mesh")
    options = options_of.parse_args()
    require("checkMesh")
    adapter = make_adapter(options)
    seeds = seeds_of(options.seeds)
    report = Report(options.json, COLUMNS)
    chosen = options.only.split(";") if ";" in options.only else names(options.only)
    if options.only in DOMAINS:
        chosen = [options.only]  # names have commas
    runs = [(effort, {"effort": effort}) for effort in names(options.effort)]
    runs += [("exact", {"method": "exact"})] * options.exact
    for name in chosen or DOMAINS:
        domain, size, more = DOMAINS[name]()
        for run, settings in runs:
            if name in LARGE and run != "default" and not chosen:
                continue
            for seed in seeds or [None]:
                chosen_seed, part = ({}, "") if seed is None else ({"seed": seed}, f", {seed}")
                label = f"{name}-{run}{part}".replace(", ", "-").replace(" ", "-")
                begin = time.perf_counter()
                result = adapter.run(domain, size, **{**more, **settings, **chosen_seed})
                seconds = time.perf_counter() - begin
                with tempfile.TemporaryDirectory() as folder:
                    row = measure(result, Path(folder) if options.keep is None else options.keep / label)
                if options.pictures is not None and domain.dim == 2:
                    options.pictures.mkdir(parents=True, exist_ok=True)
                    figure = result.plot(title=f"{name}, {run}")
                    figure.savefig(options.pictures / f"{label}.png", dpi=200)
                report.add(
                    {"domain": name, "run": f"{run}{part}", "seconds": seconds, **row},
                    f"{label}: {'OK' if row['ok'] else row['complaints']}",
                )
    good = sum(row["ok"] for row in report.records)
    report.finish(heading(adapter, f"{good} of {len(report.records)} meshes pass checkMesh"))


if __name__ == "__main__":
    main()
