"""Whether OpenFOAM accepts the meshes: `checkMesh -allGeometry -allTopology` for domains with hard walls.

    python bench/solver_ready.py [--only NAMES] [--effort NAMES] [--exact] [--keep FOLDER]
                                 [--pictures FOLDER] [--device NAME] [--dtype float32] [--json]

Each mesh is adapted, written as polyMesh with default settings, and given to OpenFOAM's `checkMesh`. A row has the
largest non-orthogonality and skewness that `checkMesh` prints, the number of concave cells, the largest angle by which
a cell of a 2D mesh is concave, the error and quality of cells on walls and of the others, and the verdict. Without
OpenFOAM the script ends with a message. Debian's package `openfoam` is enough.

The domains are in `bench/_walled.py`; S3 has 1e5 cells, and S2 and S3 run with their default effort only unless they
are named in --only.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _common import Report, heading, make_adapter, names, off_walls, parser
from _walled import WALLED

import clvoro
from clvoro.io.polymesh import PolyMesh, poly_mesh

CONTROL = """application checkMesh; startFrom startTime; startTime 0; stopAt endTime; endTime 1; deltaT 1;
writeControl timeStep; writeInterval 1;
"""
HEAD = "FoamFile {{ version 2.0; format ascii; class dictionary; object {name}; }}\n"
SCHEMES = [
    f"{kind}Schemes" for kind in ("ddt", "grad", "div", "laplacian", "interpolation", "snGrad")
]
SYSTEM = {
    "controlDict": CONTROL,
    "fvSchemes": " {}\n".join(SCHEMES) + " {}\n",
    "fvSolution": "",
}
NUMBER = r"([-+.\deE]*\d)"
FIGURES = {
    "non_orthogonality": rf"non-orthogonality Max: {NUMBER}",
    "skewness": rf"Max skewness = {NUMBER}",
    "concave": r"Concave cells .*number of cells: (\d+)",
}
LARGE = ("S2", "S3")


def check_mesh(case: Path) -> str:
    """Return what checkMesh prints for the polyMesh of a case."""
    (case / "system").mkdir(parents=True, exist_ok=True)
    for name, text in SYSTEM.items():
        (case / "system" / name).write_text(HEAD.format(name=name) + text)
    environment = {"WM_PROJECT_DIR": "/usr/share/openfoam", **os.environ}
    command = ["checkMesh", "-allGeometry", "-allTopology", "-case", str(case)]
    run = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    return run.stdout + run.stderr


def read_verdict(text: str) -> dict[str, Any]:
    """Return the figures in the output of checkMesh."""
    matches = {name: re.search(pattern, text) for name, pattern in FIGURES.items()}
    found: dict[str, Any] = {k: float(m.group(1)) if m else 0.0 for k, m in matches.items()}
    found["ok"] = "Mesh OK." in text
    stars = re.findall(r"^ \*+(.*)$", text, re.MULTILINE)
    found["complaints"] = "; ".join(line.strip()[:70] for line in stars)
    return found


def concave_angle(mesh: PolyMesh, n_cells: int) -> float:
    """Return the largest interior angle of the bottoms of prisms, minus 180 degrees."""
    first = len(mesh.owner) - 2 * n_cells
    starts = mesh.starts[first : first + n_cells + 1]
    corners = mesh.corners[starts[0] : starts[-1]]
    cell = np.repeat(np.arange(n_cells), np.diff(starts))
    place = np.arange(len(corners))
    begin, end = (starts - starts[0])[cell], (starts - starts[0])[cell + 1]
    after = np.where(place + 1 < end, place + 1, begin)
    before = np.where(place > begin, place - 1, end - 1)
    x = mesh.points[corners, :2]
    a, b = x - x[before], x[after] - x
    turn = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    sign = np.where(np.bincount(cell, turn)[cell] < 0, -1.0, 1.0)  # bottoms are seen from below
    return float(np.degrees(-(turn * sign).min()))


def measure(result: clvoro.Result, case: Path) -> dict[str, Any]:
    """Write the mesh, check it, and return its figures."""
    result.save(case / "constant" / "polyMesh")
    text = check_mesh(case)
    (case / "checkMesh.log").write_text(text)
    d = result.diagram
    inner = off_walls(d)
    wall, e = ~inner, np.abs(result.size_error)

    def of(values: np.ndarray, part: np.ndarray, how: str) -> float:
        return float(getattr(values[part], how)()) if part.any() else float("nan")

    flat = d.domain.dim == 2
    return {
        "cells": len(d), **read_verdict(text),
        "concave_degrees": concave_angle(poly_mesh(d), len(d)) if flat else float("nan"),
        "shortest": float(result.measures.solver.shortest_edge.min()),
        "wall_error": of(e, wall, "mean"), "wall_quality": of(result.quality, wall, "min"),
        "inner_error": of(e, inner, "mean"), "inner_quality": of(result.quality, inner, "mean"),
    }  # fmt: skip


COLUMNS = {
    "domain": lambda r: r["domain"],
    "run": lambda r: r["run"],
    "cells": lambda r: r["cells"],
    "s": lambda r: f"{r['seconds']:.1f}",
    "non-orth.": lambda r: f"{r['non_orthogonality']:.1f}",
    "skewness": lambda r: f"{r['skewness']:.2f}",
    "concave cells": lambda r: f"{r['concave']:.0f}",
    "by degrees": lambda r: f"{max(r['concave_degrees'], 0):.2g}",
    "shortest edge": lambda r: f"{r['shortest']:.1e}",
    "mean e, min Q at walls": lambda r: f"{r['wall_error']:.4f}, {r['wall_quality']:.3f}",
    "mean e, mean Q inside": lambda r: f"{r['inner_error']:.4f}, {r['inner_quality']:.4f}",
    "checkMesh": lambda r: "Mesh OK" if r["ok"] else f"fails: {r['complaints'][:120]}",
}


def main() -> None:
    """Run the bench."""
    options_of = parser(__doc__)
    options_of.add_argument("--only", default="", metavar="NAMES", help=", ".join(WALLED))
    options_of.add_argument("--effort", default="default,best", metavar="NAMES")
    options_of.add_argument("--exact", action="store_true", help="also runs with method='exact'")
    options_of.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="keep the cases, with checkMesh.log"
    )
    options_of.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw each 2D mesh")
    options = options_of.parse_args()
    if shutil.which("checkMesh") is None:
        raise SystemExit("checkMesh is not installed; Debian has it in the package openfoam")
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    chosen = options.only.split(";") if ";" in options.only else names(options.only)
    if options.only in WALLED:
        chosen = [options.only]  # names have commas
    runs = [(effort, {"effort": effort}) for effort in names(options.effort)]
    runs += [("exact", {"method": "exact"})] * options.exact
    for name in chosen or WALLED:
        domain, size, more = WALLED[name]()
        for run, settings in runs:
            if name in LARGE and run != "default" and not chosen:
                continue
            begin = time.perf_counter()
            result = adapter.run(domain, size, **{**more, **settings})
            seconds = time.perf_counter() - begin
            with tempfile.TemporaryDirectory() as folder:
                label = f"{name}-{run}".replace(", ", "-").replace(" ", "-")
                case = Path(folder) if options.keep is None else options.keep / label
                row = measure(result, case)
            if options.pictures is not None and domain.dim == 2:
                options.pictures.mkdir(parents=True, exist_ok=True)
                result.plot(title=f"{name}, {run}").savefig(
                    options.pictures / f"{label}.png", dpi=200
                )
            row = {"domain": name, "run": run, "seconds": seconds, **row}
            report.add(row, f"{name}, {run}: {'OK' if row['ok'] else row['complaints']}")
    good = sum(row["ok"] for row in report.records)
    report.finish(heading(adapter, f"{good} of {len(report.records)} meshes pass checkMesh"))


if __name__ == "__main__":
    main()
