"""Diagrams of the same points by clvoro and by other packages: time, memory, right or wrong volumes.

    python bench/peers.py [--sizes 1e4,1e5] [--dims 2,3] [--sets uniform,cubed,clusters]
                          [--peers clvoro,pysdot] [--limit 120] [--device NAME] [--json]

Sets in the unit square and cube, random with a fixed seed: "uniform"; "cubed", r = u^3 around the center with u
uniform, so that cells near the center are millions of times smaller; "clusters", normal around a hundred centers with
a deviation of 0.01.

Each row is a process of its own, which is ended after `--limit` seconds: a crash, an error or no end is what the row
says. "s" is the least of two calls (of one above 10 s), from the points to the cells, with volumes where the package
has them; kernels are built before, and imports do not count. "MB" is what the peak of the process's memory is above
that before the first call, "none" the share of cells without a finite, positive volume.

Volumes are compared with those of `--samples` cells, which SciPy intersects from the planes to all near points: "off"
is the share of these that differ by above 1e-6, "worst" their largest relative difference. "sum" is the sum of all
volumes less that of the domain. peclet-voro has periodic boxes alone, and is compared with such cells. VTK cuts at
a box of its own around the points, so that cells off the walls are compared, and no sum.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _common import Report, counts, make_adapter, names, parser, shown
from scipy.spatial import ConvexHull, HalfspaceIntersection, KDTree

import clvoro

SEED = 6007
SAME = 1e-6
ONCE = 10.0

Array = np.ndarray
Made = tuple[Callable[[], Any], Callable[[Any], Array]]
"""A call that makes the diagram, and what finds the volumes (n,) in that."""


def cubed(n: int, dim: int, rng: np.random.Generator) -> Array:
    """Points at r = u^3 / 2 around the center, in all directions."""
    v = rng.standard_normal((n, dim))
    return 0.5 + v * (0.5 * rng.random(n) ** 3 / np.linalg.norm(v, axis=1))[:, None]


def clusters(n: int, dim: int, rng: np.random.Generator) -> Array:
    centers = rng.random((100, dim))
    return (centers[rng.integers(100, size=n)] + 0.01 * rng.standard_normal((n, dim))) % 1.0


SETS = {"uniform": lambda n, dim, rng: rng.random((n, dim)), "cubed": cubed, "clusters": clusters}


def points_of(name: str, n: int, dim: int) -> Array:
    return np.ascontiguousarray(SETS[name](n, dim, np.random.default_rng(SEED)))


def with_clvoro(points: Array, options: argparse.Namespace) -> Made:
    adapter, dim = make_adapter(options), points.shape[1]
    box = clvoro.Box((0,) * dim, (1,) * dim, periodic=options.periodic)
    adapter.diagram(box, points)  # builds its kernels
    return lambda: adapter.diagram(box, points).volumes, np.asarray


def with_multivoro(points: Array, _: argparse.Namespace) -> Made:
    compute, limits = importlib.import_module("multivoro").compute_voronoi, np.array([[0.0] * 3, [1.0] * 3])
    radii, threads = np.zeros(len(points)), os.cpu_count() or 1

    def volumes_of(cells: list[Any]) -> Array:
        corners = [np.reshape(cell.get_vertices(), (-1, 3)) for cell in cells]
        before = np.cumsum([0, *map(len, corners)])
        faces, sides = [], []
        for k, cell in enumerate(cells):  # the number of corners of a face, then these, face by face
            stream, at = np.asarray(cell.get_face_vertices(), np.int64), 0
            while at < len(stream):
                faces.append(stream[at + 1 : at + 1 + stream[at]] + before[k])
                sides.append(k)
                at += 1 + stream[at]
        starts = np.cumsum([0, *map(len, faces)])
        return pyramids(np.concatenate(corners)[np.concatenate(faces)], starts, np.array(sides)[:, None], points)

    return lambda: compute(points, radii=radii, limits=limits, n_threads=threads), volumes_of


def areas_of(corners: Array, starts: Array) -> Array:
    """Return the vector areas (f, 3) of polygons whose `corners` (c, 3) follow one another from `starts` (f + 1,)."""
    arms = corners - np.repeat(corners[starts[:-1]], np.diff(starts), axis=0)
    turned = np.roll(arms, -1, axis=0)
    turned[starts[1:] - 1] = 0
    return np.add.reduceat(0.5 * np.cross(arms, turned), starts[:-1], axis=0)


def pyramids(corners: Array, starts: Array, sides: Array, points: Array) -> Array:
    """Return volumes (n,) of cells from faces as of `areas_of`, with the cells at their `sides` (f, s)."""
    areas, volumes = areas_of(corners, starts), np.zeros(len(points))
    for side in sides.T:
        inside = (side >= 0) & (side < len(points))
        arms = points[side[inside]] - corners[starts[:-1]][inside]
        np.add.at(volumes, side[inside], np.abs((areas[inside] * arms).sum(axis=1)) / 3)
    return volumes


def with_peclet(points: Array, _: argparse.Namespace) -> Made:
    tessellation = importlib.import_module("peclet.voro").Tessellation()
    tessellation.set_domain((1.0, 1.0, 1.0))

    def made() -> Array:
        tessellation.build(points)
        return tessellation.get_volumes()

    return made, np.array


def with_vtk(points: Array, _: argparse.Namespace) -> Made:
    vtk, support = importlib.import_module("vtk"), importlib.import_module("vtk.util.numpy_support")
    n, dim = points.shape
    data, placed = vtk.vtkPolyData(), vtk.vtkPoints()
    placed.SetData(support.numpy_to_vtk(np.pad(points, ((0, 0), (0, 3 - dim))), deep=True))
    data.SetPoints(placed)
    regions = support.numpy_to_vtk(np.arange(n, dtype=np.int32), deep=True)
    regions.SetName("regions")
    data.GetPointData().SetScalars(regions)
    maker = vtk.vtkVoronoi2D() if dim == 2 else vtk.vtkGeneralizedSurfaceNets3D()
    maker.SetInputData(data)
    if dim == 3:  # one region per point: faces between all cells
        maker.GenerateLabels(n, 0, n - 1)
        maker.SmoothingOff()
        maker.MergePointsOff()

    def made() -> Any:
        maker.Modified()
        maker.Update()
        return maker.GetOutput()

    def volumes_of(found: Any) -> Array:
        polygons = found.GetPolys()
        starts = support.vtk_to_numpy(polygons.GetOffsetsArray()).astype(np.int64)
        corners = support.vtk_to_numpy(found.GetPoints().GetData()).astype(float)
        corners = corners[support.vtk_to_numpy(polygons.GetConnectivityArray())]
        if dim == 2:
            return np.abs(areas_of(corners, starts)[:, 2])
        sides = support.vtk_to_numpy(found.GetCellData().GetArray("BoundaryLabels")).astype(np.int64)
        return pyramids(corners, starts, sides, points)

    return made, volumes_of


def with_geogram(points: Array, _: argparse.Namespace) -> Made:
    module, dim = importlib.import_module("geogram"), points.shape[1]
    corners, simplices = np.array(list(itertools.product((0.0, 1.0), repeat=dim))), []
    for order in itertools.permutations(range(dim)):
        rows = np.cumsum([0, *(2 ** (dim - 1 - axis) for axis in order)])
        edges = corners[rows[1:]] - corners[rows[0]]
        simplices.append(rows if np.linalg.det(edges) > 0 else rows[[1, 0, *range(2, dim + 1)]])
    tiles = np.array(simplices, np.uint32)

    def volumes_of(found: Any) -> Array:
        places = np.asarray(found.q)[np.asarray(found.t)]
        parts = np.linalg.det(places[:, 1:] - places[:, :1]) / math.factorial(dim)
        return np.bincount(np.asarray(found.tseed), parts, minlength=len(points))

    return lambda: module.Voronoi(points, domain_vertices=corners, domain_simplices=tiles), volumes_of


def with_pysdot(points: Array, _: argparse.Namespace) -> Made:
    module, dim = importlib.import_module("pysdot"), points.shape[1]
    domain = importlib.import_module("pysdot.domain_types").ConvexPolyhedraAssembly()
    domain.add_box([0.0] * dim, [1.0] * dim, cut_id=2**64 - 1)  # its default, -1, is an error with NumPy 2
    weights = np.zeros(len(points))
    return lambda: module.PowerDiagram(points, weights, domain).integrals(), np.array


class Peer(NamedTuple):
    """Another package: what makes its call, the dimensions that it has, its boundaries."""

    make: Callable[[Array, argparse.Namespace], Made]
    dims: tuple[int, ...] = (2, 3)
    periodic: bool = False
    whole: bool = True


PEERS = {
    "clvoro": Peer(with_clvoro),
    "clvoro, periodic": Peer(with_clvoro, periodic=True),
    "voro++ (multivoro)": Peer(with_multivoro, (3,)),
    "peclet-voro": Peer(with_peclet, (3,), periodic=True),
    "VTK": Peer(with_vtk, whole=False),
    "geogram": Peer(with_geogram),
    "pysdot": Peer(with_pysdot),
}


def peak() -> float:
    """Return the largest memory of this process and of those that it waited for, in MB."""
    return max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)) / 1024


def child(options: argparse.Namespace) -> None:
    """Time one peer on one set, write its volumes and figures into `options.folder`."""
    peer, points = PEERS[options.peer], points_of(options.set, options.n, options.dim)
    options.periodic = peer.periodic
    try:
        made, volumes_of = peer.make(points, options)
    except ImportError as error:
        figures: dict[str, Any] = {"note": f"skipped: {error}"}
    else:
        before, times = peak(), []
        while len(times) < 2 and sum(times) < ONCE:
            start = time.perf_counter()
            found = made()
            times.append(time.perf_counter() - start)
        figures = {"seconds": min(times), "megabytes": max(peak() - before, 0.0)}
        np.save(options.folder / "volumes.npy", volumes_of(found))
    (options.folder / "figures.json").write_text(json.dumps(figures))


def launched(name: str, which: str, n: int, dim: int, options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run `child` in a process of its own; return its figures, or what became of it."""
    command = [sys.executable, __file__, "--peer", name, "--set", which, "--n", str(n), "--dim", str(dim)]
    command += ["--folder", str(folder), "--dtype", options.dtype]
    command += ["--device", options.device] if options.device else []
    with (folder / "messages").open("w+") as messages:
        try:
            code = subprocess.run(command, stdout=messages, stderr=messages, timeout=options.limit).returncode
        except subprocess.TimeoutExpired:
            return {"note": f"no end in {options.limit:g} s"}
        messages.seek(0)
        said = [line.strip() for line in messages if line.strip()]
    if code < 0:
        return {"note": f"crash, signal {-code}"}
    if code:
        return {"note": f"error: {said[-1][:100] if said else f'exit code {code}'}"}
    return json.loads((folder / "figures.json").read_text())


class Truth:
    """Volumes of sampled cells of `points`, each intersected from the planes to all points that may bound it."""

    def __init__(self, points: Array, periodic: bool, samples: int) -> None:
        n, dim = points.shape
        self.rows = np.sort(np.random.default_rng(SEED).choice(n, min(samples, n), replace=False))
        shifts = np.array(list(itertools.product((0, -1, 1), repeat=dim)), float)
        images = np.concatenate([points + by for by in shifts]) if periodic else points
        low, high = (-1.0, 2.0) if periodic else (0.0, 1.0)
        images = images[((images > -0.6) & (images < 1.6)).all(axis=1)] if periodic else images
        tree = KDTree(images)
        found = [self._cell(points[row], images, tree, low, high) for row in self.rows]
        self.volumes, self.inner = np.array([v for v, _ in found]), np.array([off for _, off in found])

    @staticmethod
    def _cell(x: Array, images: Array, tree: KDTree, low: float, high: float) -> tuple[float, bool]:
        """Return the volume of the cell of `x`, and whether it is off the walls."""
        dim, near = len(x), 32
        walls = np.vstack([np.column_stack([s * np.eye(dim), np.full(dim, e)]) for s, e in ((1, -high), (-1, low))])
        walls[:, -1] += walls[:, :-1] @ x
        while True:
            far, rows = tree.query(x, min(near, len(images)))
            arms = images[rows[far > 0]] - x
            size = far[1]  # planes and corners in units of the least distance, relative to x
            planes = np.column_stack([arms / size, -0.5 * (arms**2).sum(axis=1) / size**2])
            scaled = np.column_stack([walls[:, :-1], walls[:, -1] / size])
            planes = np.vstack([planes / np.linalg.norm(planes[:, :-1], axis=1)[:, None], scaled])
            corners = HalfspaceIntersection(planes, np.zeros(dim)).intersections
            reach = np.linalg.norm(corners, axis=1).max() * size
            if 2 * reach <= far[-1] or near >= len(images):
                off = (corners @ scaled[:, :-1].T + scaled[:, -1]).max() < -1e-9
                return float(ConvexHull(corners, qhull_options="QJ" if dim == 3 else None).volume) * size**dim, bool(
                    off
                )
            near = max(2 * near, min(8 * near, int(tree.query_ball_point(x, 2 * reach, return_length=True)) + 1))

    def compare(self, volumes: Array, peer: Peer) -> dict[str, Any]:
        """Return the figures of a peer's volumes (n,)."""
        taken = np.ones(len(self.rows), bool) if peer.whole else self.inner
        with np.errstate(invalid="ignore"):
            error = np.abs(volumes[self.rows] / self.volumes - 1)[taken]
        error = np.where(np.isfinite(error), error, np.inf)
        figures = {
            "without": float(1 - (np.isfinite(volumes) & (volumes > 0)).mean()),
            "off": float((error > SAME).mean()),
            "worst": float(error.max()),
        }
        if peer.whole:
            figures["sum"] = float(np.nansum(volumes) - 1)
        wrong = figures["off"] or figures["without"] or abs(figures.get("sum", 0.0)) > SAME
        return figures | {"note": "wrong" if wrong else "right"}


def measure(options: argparse.Namespace, report: Report) -> None:
    for dim, n, which in itertools.product(options.dims, options.sizes, options.sets):
        truths: dict[bool, Truth] = {}
        for name in options.peers:
            peer = PEERS[name]
            if dim not in peer.dims or (peer.periodic and dim == 2):
                continue
            record: dict[str, Any] = {"peer": name, "dim": dim, "cells": n, "set": which}
            with tempfile.TemporaryDirectory() as made:
                folder = Path(made)
                record |= launched(name, which, n, dim, options, folder)
                if (folder / "volumes.npy").exists():
                    volumes = np.load(folder / "volumes.npy")
                    if len(volumes) != n:
                        record["note"] = f"wrong: {len(volumes)} volumes"
                    else:
                        if peer.periodic not in truths:
                            points = points_of(which, n, dim)
                            truths[peer.periodic] = Truth(points, peer.periodic, options.samples)
                        record |= truths[peer.periodic].compare(volumes, peer)
            report.add(record, f"{name}, {dim}D, {n:,}, {which}: {record['note']}")


COLUMNS = {
    "points": lambda r: f"{r['dim']}D {r['set']}",
    "cells": lambda r: f"{r['cells']:,}",
    "package": lambda r: r["peer"],
    "s": shown("seconds", ".2f"),
    "MB": shown("megabytes", ".0f"),
    "volumes": lambda r: r["note"],
    "off": shown("off", ".1%"),
    "worst": shown("worst", ".0e"),
    "none": shown("without", ".1%"),
    "sum": shown("sum", "+.0e"),
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", type=counts, default=[10**5])
    options_of.add_argument("--dims", type=counts, default=[2, 3])
    options_of.add_argument("--sets", type=names, default=list(SETS), help=", ".join(SETS))
    options_of.add_argument("--peers", type=names, help=f"beginnings of {', '.join(PEERS)}; all")
    options_of.add_argument("--limit", type=float, default=120, metavar="S", help="seconds of one row")
    options_of.add_argument("--samples", type=int, default=300)
    for name, kind in (("peer", str), ("set", str), ("n", int), ("dim", int), ("folder", Path)):
        options_of.add_argument(f"--{name}", type=kind, help=argparse.SUPPRESS)
    options = options_of.parse_args()
    if options.peer:
        return child(options)
    if unknown := set(options.sets) - set(SETS):
        options_of.error(f"no set {', '.join(unknown)}; there are {', '.join(SETS)}")
    chosen = [name for name in PEERS if not options.peers or name.startswith(tuple(options.peers))]
    if not chosen:
        options_of.error(f"no peer {', '.join(options.peers)}; there are {', '.join(PEERS)}")
    options.peers = chosen
    report = Report(options.json, COLUMNS)
    measure(options, report)
    report.finish("Diagrams of the same points")


if __name__ == "__main__":
    main()
