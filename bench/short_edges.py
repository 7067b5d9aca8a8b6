"""Short edges and small faces of 3D meshes: how many there are, and what their collapse costs.

    python bench/short_edges.py [--fields S1,S2] [--rows default,best] [--device NAME] [--dtype float32] [--json]

A row is a mesh of one field with one effort, or exact. It has the shares of edges shorter than 0.02 h and of faces
smaller than 0.001 h^2 in the diagram, how many are left in the mesh for solvers, and processor seconds: of the run, of
the collapse, and of the whole way to OpenFOAM's files, as text and as bytes (the diagram has been read before). Of
the mesh for solvers it has the least flatness of a face, the largest relative change of a cell's volume, and the
error of the sum of all volumes; then the largest non-orthogonality and skewness as OpenFOAM defines them, of the
diagram and of the mesh for solvers. The last column is the verdict on the latter by the criteria of OpenFOAM's
checkMesh.

Fields: S1, S2 and S3 of the other benches; `spheres`, sizes by the distance to the nearer of two spheres, with a kink;
`ridge`, the distance to a plane; `periodic`, waves in a periodic box. S3 has 1e5 cells.
"""

from __future__ import annotations

import copy
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _common import CUBE, FIRST_SEED, Report, heading, make_adapter, names, parser, test_field

import clvoro
from clvoro import sizing
from clvoro.finite_volumes.collapse import SHORT_EDGE, SMALL_FACE, collapse_short
from clvoro.mesh.faces import Faces
from clvoro.mesh.geometry import smaller_size

ROWS: dict[str, dict[str, Any]] = {
    "fast": {"effort": "fast"},
    "default": {},
    "best": {"effort": "best"},
    "exact": {"method": "exact"},
}


def setup(name: str) -> tuple[clvoro.Box, Any]:
    """Return domain and size field."""
    if name == "spheres":
        centers = (0.3, 0.3, 0.5), (0.7, 0.6, 0.5)
        both = [sizing.Distance(sizing.Ball(c, 0.2), h_min=0.04, slope=0.3) for c in centers]
        return CUBE, sizing.minimum(*both)
    if name == "ridge":
        return CUBE, sizing.Expression("0.035 + 0.2 * fabs(x + 0.3 * y - 0.6)")
    if name == "periodic":
        waves = "0.06 + 0.03 * sin(2 * pi * x) * sin(2 * pi * y) * cos(2 * pi * z)"
        return clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True), sizing.Expression(waves)
    return CUBE, test_field(name)


FIELDS = ("S1", "S2", "S3", "spheres", "ridge", "periodic")


def count_short(mesh: Faces, sizes: np.ndarray) -> tuple[int, int]:
    """Return the numbers of short edges and of small faces; at seams each image counts."""
    h = smaller_size(mesh.owner, mesh.neighbor, sizes)
    m = mesh.measures
    limit = np.zeros(len(m.edges))  # of an edge: that of its largest face
    np.maximum.at(limit, m.edge_of_corner, np.repeat(SHORT_EDGE * h, np.diff(m.cells.starts)))
    areas = np.linalg.norm(m.geometry.areas, axis=1)
    return int((m.edge_spans < limit).sum()), int((areas < SMALL_FACE * h**2).sum())


def _seconds_to_file(diagram: clvoro.Diagram, binary: bool) -> float:
    """Return the processor time of the mesh for solvers and its files."""
    diagram = copy.copy(diagram)  # which has not made the mesh yet
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        diagram.to_openfoam(Path(folder) / "polyMesh", binary=binary)
        return time.process_time() - begin


def measure(diagram: clvoro.Diagram) -> dict[str, Any]:
    """Collapse the short edges of a diagram; return the figures."""
    before, h = diagram.solver_mesh(collapse=False), np.cbrt(diagram.volumes)
    begin = time.process_time()
    after = collapse_short(before, diagram)
    seconds = time.process_time() - begin
    files = [_seconds_to_file(diagram, binary) for binary in (False, True)]
    (edges, faces), left = count_short(before, h), count_short(after, h)
    volumes = after.measures.geometry.volumes
    all_edges = len(before.corners) / 3  # nearly all have three faces
    return {
        "cells": len(diagram),
        "seconds": seconds,
        "files": files,
        "edges": edges / all_edges,
        "faces": faces / len(before.owner),
        "edges_left": left[0],
        "faces_left": left[1],
        "flatness": float(after.measures.flatness.min()),
        "change": float(np.abs(volumes / diagram.volumes - 1).max()),
        "total": float(abs(volumes.sum() / diagram.domain.measure - 1)),
        "angles": [float(m.measures.non_orthogonality.max()) for m in (before, after)],
        "skewness": [float(m.measures.skewness.max()) for m in (before, after)],
        "ok": bool(diagram.check(solver="openfoam")),
    }


COLUMNS = {
    "field": lambda r: r["field"],
    "row": lambda r: r["row"],
    "cells": lambda r: r["cells"],
    "short edges": lambda r: f"{r['edges']:.2%}",
    "small faces": lambda r: f"{r['faces']:.2%}",
    "left": lambda r: f"{r['edges_left']}, {r['faces_left']}",
    "run s": lambda r: f"{r['run']:.2f}",
    "collapse s": lambda r: f"{r['seconds']:.2f}",
    "text, bytes s": lambda r: ", ".join(f"{s:.2f}" for s in r["files"]),
    "flatness": lambda r: f"{r['flatness']:.4f}",
    "change of volume": lambda r: f"{r['change']:.3f}",
    "of all": lambda r: f"{r['total']:.0e}",
    "non-orth.": lambda r: " to ".join(f"{x:.1f}" for x in r["angles"]),
    "skewness": lambda r: " to ".join(f"{x:.2f}" for x in r["skewness"]),
    "OpenFOAM": lambda r: "accepts" if r["ok"] else "rejects",
}


def main() -> None:
    """Run the bench."""
    options_of = parser(__doc__)
    options_of.add_argument("--fields", default="S1,S2,spheres,ridge,periodic", metavar="NAMES")
    options_of.add_argument("--rows", default=",".join(ROWS), metavar="NAMES")
    options = options_of.parse_args()
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    for name in names(options.fields):
        box, size = setup(name)
        for row in names(options.rows):
            begin = time.process_time()
            diagram = adapter.run(box, size, seed=FIRST_SEED, **ROWS[row]).diagram
            run = time.process_time() - begin
            report.add({"field": name, "row": row, "run": run, **measure(diagram)}, f"{name}, {row}")
    report.finish(heading(adapter, "Short edges and small faces of 3D meshes"))


if __name__ == "__main__":
    main()
