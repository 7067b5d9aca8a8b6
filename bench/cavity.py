"""A lid-driven cavity at Re 1000 with OpenFOAM: uniform meshes, and one of blockMesh that follows its solution.

    python bench/cavity.py [--cells 1000,2000,4000] [--uniform 1000,2000,4000,8000,16000] [--cycles 3] [--device NAME]
                           [--json]

"Followed" begins with 24 x 24 squares of blockMesh, in bytes and compressed, of which nothing else is known:
`clvoro.foam.adapt_case` takes their boundary over and makes a new mesh of U in each cycle. The error is the mean
difference of the horizontal velocity on the vertical line through the middle from the values of a spectral method
(Botella and Peyret 1998, Computers & Fluids 27, 421), in percent of the lid's velocity. Those of Ghia, Ghia and Shin
(1982), on 129 x 129 squares, differ from them by 0.27 %. "as uniform" is the number of cells with which a uniform mesh
has that error: with log-linear interpolation between the meshes of --uniform, blank beyond them.
"""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path

import numpy as np
from _common import FIRST_SEED, Report, counts, heading, make_adapter, parser, shown
from _openfoam import Case, header, require

import clvoro
from clvoro import foam, sizing
from clvoro.foam.case import FoamCase

HEIGHT = (0.0547, 0.0625, 0.0703, 0.1016, 0.1719, 0.2813, 0.4531, 0.5, 0.6172, 0.7344, 0.8516, 0.9531, 0.9609, 0.9688)
HEIGHT = np.array([*HEIGHT, 0.9766])
EXACT = (-0.1812881, -0.20233, -0.2228955, -0.3004561, -0.3885691, -0.2803696, -0.1081999, -0.0620561, 0.0570178)
EXACT = np.array([*EXACT, 0.1886747, 0.3372212, 0.4723329, 0.5169277, 0.5808359, 0.6644227])
BLOCKS = """convertToMeters 1;
vertices ((0 0 0) (1 0 0) (1 1 0) (0 1 0) (0 0 0.1) (1 0 0.1) (1 1 0.1) (0 1 0.1));
blocks (hex (0 1 2 3 4 5 6 7) (24 24 1) simpleGrading (1 1 1));
edges ();
boundary
(
    lid { type wall; faces ((3 7 6 2)); }
    fixed { type wall; faces ((0 4 7 3) (2 6 5 1) (1 5 4 0)); }
    frontAndBack { type empty; faces ((0 3 2 1) (4 5 6 7)); }
);
"""


def write_case(case: Case, flat: tuple[str, ...]) -> None:
    """Write fields and dictionaries; `flat` are the empty patches."""
    empty = {name: {"type": "empty"} for name in flat}
    closed = {"type": "zeroGradient"}
    u = {"lid": {"type": "fixedValue", "value": "uniform (1 0 0)"}, "fixed": {"type": "noSlip"}, **empty}
    p = {"lid": closed, "fixed": closed, **empty}
    solvers = {
        "p": {"solver": "GAMG", "smoother": "GaussSeidel", "tolerance": 1e-9, "relTol": 0.05},
        "U": {"solver": "PBiCGStab", "preconditioner": "DILU", "tolerance": 1e-10, "relTol": 0.05},
    }
    simple = {"consistent": "yes", "pRefCell": 0, "pRefValue": 0, "residualControl": {"p": 1e-5, "U": 1e-6}}
    control = {"endTime": 2000, "writeFormat": "binary", "writeCompression": "on"}
    case.write_start(u, p)
    case.write_system(0.001, solution={"solvers": solvers, "SIMPLE": simple}, control=control)


def error(case: Case, mesh: clvoro.Diagram) -> float:
    """Return the error of the velocity in percent."""
    u = case.field("U", len(mesh))
    found = sizing.OnCells(mesh, u[:, 0])(np.column_stack([np.full(len(HEIGHT), 0.5), HEIGHT]))
    return 100 * float(np.abs(found - EXACT).mean())


COLUMNS = {
    "mesh": lambda r: r["mesh"],
    "cells": shown("cells", ",d"),
    "error %": shown("error", ".2f"),
    "as uniform": shown("as_uniform", ",d"),
    "seconds": shown("seconds", ".0f"),
}


def main(arguments: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("--cells", type=counts, default=counts("1000,2000,4000"))
    made.add_argument("--uniform", type=counts, default=counts("1000,2000,4000,8000,16000"))
    made.add_argument("--cycles", type=int, default=3)
    options = made.parse_args(arguments)
    require("simpleFoam", "blockMesh")
    adapter, report = make_adapter(options), Report(options.json, COLUMNS)
    domain = clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1)], names={"lid": 2, "fixed": [0, 1, 3]})
    known_errors: list[float] = []
    for n in options.uniform:
        with tempfile.TemporaryDirectory() as folder:
            case, start = Case(Path(folder)), time.perf_counter()
            write_case(case, ("back", "front"))
            mesh = adapter.run(domain, 1 / math.sqrt(n), n_cells=n, seed=FIRST_SEED)
            mesh.to_openfoam(case.folder / "constant" / "polyMesh", thickness=0.1)
            case.run("simpleFoam")
            seconds = time.perf_counter() - start
            record = {"mesh": "uniform", "cells": n, "error": error(case, mesh.diagram), "seconds": seconds}
            known_errors.append(record["error"])
            report.add(record, f"uniform, {n}")
    for n in options.cells:
        with tempfile.TemporaryDirectory() as folder:
            case = Case(Path(folder))
            write_case(case, ("frontAndBack",))
            (case.folder / "system" / "blockMeshDict").write_text(header("dictionary", "blockMeshDict") + BLOCKS)
            case.run("blockMesh")
            start = time.perf_counter()
            foam.adapt_case(
                case.folder, n_cells=n, cycles=options.cycles, solver="simpleFoam", pictures=False, adapter=adapter
            )
            seconds, known = time.perf_counter() - start, FoamCase(case.folder)
            mesh = clvoro.load(known.mesh_folder(known.latest()) / "clvoro.npz")
            record = {"mesh": "followed", "cells": n, "error": error(case, mesh.diagram), "seconds": seconds}
            if known_errors and min(known_errors) <= record["error"] <= max(known_errors):
                order = np.argsort(known_errors)
                logs = np.log(np.array(known_errors))[order], np.log(np.array(options.uniform, float))[order]
                record["as_uniform"] = round(math.exp(np.interp(math.log(record["error"]), *logs)))
            report.add(record, f"followed, {n}")
    report.finish(heading(adapter, "Lid-driven cavity at Re 1000"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
