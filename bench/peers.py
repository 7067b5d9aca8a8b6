"""Comparison with SciPy and Voro++ (diagrams), Gmsh and MMG (graded meshes) in the same run.

    python bench/peers.py [--sizes 1e5,1e6] [--sets uniform,cubed] [--factors 1,0.5]
                          [--dim 3] [--skip diagrams|meshes] [--device NAME] [--dtype float32]
                          [--json]

Diagrams: random points in the unit square (the sets of `diagram.py`), in random order; clvoro's
time is from NumPy points to a diagram on the device with areas, centroids, faces and graph, and
the second one with all arrays fetched. SciPy gives vertices and regions, no areas. Voro++
(Debian: voro++-dev; its packaged version is three-dimensional and serial, so it runs on a slab
one cell thick) computes cell, volume and neighbors; a small C++ program is compiled for it with
g++ -O3. Best of two runs each, of one for SciPy. With `--dim 3` the sets are those of the unit
cube ("core" has sizes 1 : 1000), Voro++ does the same there with blocks of five generators, and
there are no meshes.

Meshes: the size field F3 of `convergence.py` times a factor; cells are the Voronoi cells of the
vertices, and their error and quality are measured by clvoro in the same way for all, with one
global factor on h taken out of the error (column "factor"), since other meshers do not promise a
count. Gmsh ("Frontal-Delaunay") and MMG (pip install gmsh mmgpy) take edge length 1.0746 h, that of
regular hexagons of area h^2. Peers that are not installed are left out with a note.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

# BLAS must not start threads in peers that are serial.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from _common import (
    BOX,
    FIRST_SEED,
    Report,
    best,
    cell_quality,
    counts,
    figures,
    heading,
    make_adapter,
    names,
    off_walls,
    parser,
    shown,
    test_field,
)
from _remeshers import EDGE, Mesher, MissingPeerError, vertices_gmsh, vertices_mmg
from diagram import BOX as SQUARE
from diagram import CUBE, SEED, SETS, SETS_3D

import clvoro

UNIT = {2: SQUARE, 3: CUBE}
VOROPP = r"""
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>
#include "voro++.hh"
int main(int, char **arguments)
{
    const long n = atol(arguments[2]);
    std::vector<double> points(DIM * n);
    FILE *file = fopen(arguments[1], "rb");
    if (!file || fread(points.data(), sizeof(double), DIM * n, file) != size_t(DIM * n)) return 1;
    fclose(file);
    const auto start = std::chrono::steady_clock::now();
    const double thick = DIM == 3 ? 1 : 1 / sqrt(double(n));
    const int side = int(pow(n / 5.0, 1.0 / DIM)) + 1;
    voro::container box(0, 1, 0, 1, 0, thick, side, side, DIM == 3 ? side : 1, false, false, false, 8);
    for (long i = 0; i < n; ++i) {
        const double *x = points.data() + DIM * i;
        box.put(int(i), x[0], x[1], DIM == 3 ? x[DIM - 1] : thick / 2);
    }
    voro::voronoicell_neighbor cell;
    std::vector<int> neighbors;
    double volume = 0;
    long faces = 0;
    voro::c_loop_all loop(box);
    if (loop.start()) do if (box.compute_cell(cell, loop)) {
        volume += cell.volume();
        cell.neighbors(neighbors);
        faces += neighbors.size();
    } while (loop.inc());
    const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - start;
    printf("%.6f %.12f %ld\n", seconds.count(), volume / thick, faces);
}
"""


# Diagrams.


def diagram_clvoro(adapter: clvoro.Adapter, points: np.ndarray) -> float:
    def run() -> None:
        adapter.diagram(UNIT[points.shape[1]], points)
        adapter.queue.finish()

    run()
    return best(2, run)[0]


def diagram_fetched(adapter: clvoro.Adapter, points: np.ndarray) -> float:
    def run() -> None:
        diagram = adapter.diagram(UNIT[points.shape[1]], points)
        corners = "cell_vertices" if points.shape[1] == 2 else "face_vertices"
        for name in ("volumes", "centroids", "neighbors", "face_measures", "vertices", corners):
            getattr(diagram, name)

    run()
    return best(2, run)[0]


def diagram_scipy(_: clvoro.Adapter, points: np.ndarray) -> float:
    from scipy.spatial import Voronoi

    return best(1, lambda: Voronoi(points))[0]


def diagram_voropp(_: clvoro.Adapter, points: np.ndarray) -> float:
    if shutil.which("g++") is None:
        raise MissingPeerError("g++")
    with tempfile.TemporaryDirectory() as folder:
        source, program, data = (Path(folder, name) for name in ("peer.cc", "peer", "points"))
        source.write_text(VOROPP)
        built = subprocess.run(
            [
                "g++",
                "-O3",
                "-march=native",
                f"-DDIM={points.shape[1]}",
                "-I/usr/include/voro++",
                source,
                "-o",
                program,
                "-lvoro++",
            ],
            capture_output=True,
            check=False,
        )
        if built.returncode:
            raise MissingPeerError("voro++-dev (Debian, Ubuntu)")
        points.astype(np.float64).tofile(data)
        seconds = []
        for _ in range(2):
            run = subprocess.run([program, data, str(len(points))], capture_output=True, text=True, check=True)
            taken, area, _ = map(float, run.stdout.split())
            if abs(area - 1) > 1e-6:
                raise RuntimeError(f"Voro++'s cells measure {area}, expected 1")
            seconds.append(taken)
    return min(seconds)


DIAGRAMS = {
    "clvoro": diagram_clvoro,
    "clvoro, arrays fetched": diagram_fetched,
    "SciPy": diagram_scipy,
    "Voro++ (serial)": diagram_voropp,
}


# Meshes.


def mesh_clvoro(effort: str) -> Callable[[clvoro.Adapter, float], tuple[np.ndarray, float]]:
    def mesh(adapter: clvoro.Adapter, factor: float) -> tuple[np.ndarray, float]:
        start = time.perf_counter()
        points = adapter.run(BOX, test_field("F3") * factor, effort=effort, seed=FIRST_SEED).points
        return points, time.perf_counter() - start

    return mesh


def mesh_peer(mesher: Mesher) -> Callable[[clvoro.Adapter, float], tuple[np.ndarray, float]]:
    """Return the function that meshes the box with a mesher and returns its vertices."""
    return lambda _, factor: mesher(BOX, test_field("F3") * factor, EDGE[2])


MESHES: dict[str, Callable[[clvoro.Adapter, float], tuple[np.ndarray, float]]] = {
    "clvoro, fast": mesh_clvoro("fast"),
    "clvoro, default": mesh_clvoro("default"),
    "Gmsh, Frontal-Delaunay": mesh_peer(vertices_gmsh),
    "MMG": mesh_peer(vertices_mmg),
}


def judge(adapter: clvoro.Adapter, points: np.ndarray, factor: float) -> dict[str, float]:
    """Return the figures of the Voronoi cells of `points` on F3 times `factor`.

    One global factor on h is taken out of the error.
    Only cells off the walls count: a mesh with vertices on the walls has cut cells there.
    """
    diagram = adapter.diagram(BOX, points)
    h = test_field("F3")(points) * factor
    length = np.sqrt(diagram.volumes)
    common = float(np.exp(np.log(length / h)[off_walls(diagram)].mean()))
    return {**figures(diagram, h * common, cell_quality(diagram)), "factor": common}


DIAGRAM_COLUMNS = {
    "diagram": lambda r: r["peer"],
    "points": lambda r: r["set"],
    "cells": shown("cells", ",.0f"),
    "seconds": shown("seconds", ".3f"),
    "M cells/s": shown("rate", ".3f", 1e-6),
    "times clvoro's": shown("ratio", ".1f"),
}
MESH_COLUMNS = {
    "mesh": lambda r: r["peer"],
    "F3 x": shown("scale", "g"),
    "cells": shown("cells", ",.0f"),
    "seconds": shown("seconds", ".2f"),
    "us per cell": shown("per_cell", ".0f", 1e6),
    "mean |e|": shown("mean_error_inner", ".4f"),
    "max |e|": shown("max_error_inner", ".3f"),
    "mean Q": shown("mean_quality", ".4f"),
    "min Q": shown("min_quality", ".3f"),
    "six-sided": shown("six_sided", ".1%"),
    "factor": shown("factor", ".3f"),
}


def compare_diagrams(adapter: clvoro.Adapter, options: argparse.Namespace) -> None:
    report = Report(options.json, DIAGRAM_COLUMNS)
    for name in options.sets:
        for n in options.sizes:
            sets = SETS if options.dim == 2 else SETS_3D
            points = sets[name](n, np.random.default_rng(SEED + n))
            ours = 0.0
            for peer, run in DIAGRAMS.items():
                if peer.startswith("Voro++") and name != "uniform" and n > options.slow_up_to:
                    continue
                if peer == "SciPy" and options.dim == 3 and n > options.slow_up_to:
                    continue
                try:
                    seconds = run(adapter, points)
                except MissingPeerError as error:
                    print(f"{peer} left out: needs {error}", file=sys.stderr)
                    continue
                ours = ours or seconds
                report.add(
                    {
                        "peer": peer,
                        "set": name,
                        "cells": len(points),
                        "seconds": seconds,
                        "rate": len(points) / seconds,
                        "ratio": seconds / ours,
                    },
                    f"{peer}, {name}, {n:,}",
                )
    report.finish(heading(adapter, "Diagrams against peers"))


def compare_meshes(adapter: clvoro.Adapter, options: argparse.Namespace) -> None:
    report = Report(options.json, MESH_COLUMNS)
    mesh_clvoro("fast")(adapter, 2.0)  # builds the kernels
    for factor in options.factors:
        for peer, mesh in MESHES.items():
            try:
                points, seconds = mesh(adapter, factor)
            except MissingPeerError as error:
                print(f"{peer} left out: needs {error}", file=sys.stderr)
                continue
            report.add(
                {
                    "peer": peer,
                    "scale": factor,
                    **judge(adapter, points, factor),
                    "seconds": seconds,
                    "per_cell": seconds / len(points),
                },
                f"{peer}, F3 x {factor:g}",
            )
    report.finish(heading(adapter, "Meshes against peers; cells off the walls"))


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[10**5, 10**6])
    options_of.add_argument("--dim", type=int, choices=(2, 3), default=2)
    options_of.add_argument("--sets", type=names, help="default uniform,cubed; in 3D uniform,core")
    options_of.add_argument("--factors", type=lambda text: [float(f) for f in names(text)], default=[1.0, 0.5, 0.25])
    options_of.add_argument("--skip", choices=("diagrams", "meshes"))
    options_of.add_argument(
        "--slow-up-to",
        type=float,
        default=1e5,
        metavar="N",
        help="largest graded set for Voro++, whose uniform bins collapse on it, and largest set in 3D for SciPy (1e5)",
    )
    options = options_of.parse_args()
    options.sets = options.sets or (["uniform", "cubed"] if options.dim == 2 else ["uniform", "core"])
    adapter = make_adapter(options)
    if options.skip != "diagrams":
        compare_diagrams(adapter, options)
    if options.skip != "meshes" and options.dim == 2:
        compare_meshes(adapter, options)


if __name__ == "__main__":
    main()
