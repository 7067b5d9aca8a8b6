"""Errors say what to do: each is raised here, and what it says is done. A new error with a remedy needs a row, too."""

import ast
import copy
import errno
import importlib
import inspect
import json
import math
import os
import re
import shutil
import sys
import traceback
from contextlib import suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import numpy.lib.recfunctions
import pyopencl as cl
import pytest
import scipy.io
import shapely

import clvoro
from clvoro import curves, earth, foam, plotting, sizing
from clvoro.adaptation.sampling.quadrature import DensityTree
from clvoro.cli import command
from clvoro.cli.cases import Case
from clvoro.cli.jobs import Job
from clvoro.errors import ClvoroError
from clvoro.foam.case import FoamCase
from clvoro.foam.mesh import polygon_of_edges
from clvoro.opencl import profile

PACKAGE = Path(clvoro.__file__).parent
BOX, CUBE = clvoro.Box((0, 0), (1, 1)), clvoro.Box((0, 0, 0), (1, 1, 1))
TORUS = clvoro.Box((0, 0), (1, 1), periodic=True)
CHANNEL = clvoro.Box((0, 0), (1, 1), periodic=(True, False))
SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
KITE = [(-0.031, 0.301), (-0.484, -0.165), (-0.419, -0.184), (0.542, -0.548), (0.489, -0.466), (0.425, -0.098)]
HOLE = [(0.4, 0.4), (0.6, 0.4), (0.6, 0.6), (0.4, 0.6)]
HOLES = [[list(corner) for corner in HOLE]]
GLOBE = clvoro.Sphere(1)
LINED = BOX.with_lines([[(0.1, 0.5), (0.9, 0.5)]])
WELLS = np.column_stack([np.linspace(0.1, 0.9, 9), np.full(9, 0.1)])
TRIANGLES = [(0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2)]
BLOCK, FIRST = clvoro.Solid.box((0, 0, 0), (1, 1, 1)), clvoro.Layers(0.01, 2, edges=["xMin"])
TURNED = np.array(TRIANGLES)[:, ::-1]
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
CROSSED = np.array([(0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1, 0)])
POINTS = np.random.default_rng(5).random((30, 2))
RECORDS = np.array([(0.5, 0.2), (0.1, 0.3)], dtype=[("x", float), ("y", float)])
WKT = "POLYGON ((0 0, 1 0, 1 1, 0 0))"
LAKE = {"type": "Polygon", "coordinates": [[*SQUARE, SQUARE[0]]]}
GRID = np.random.default_rng(0).random((9, 9))
SOLUTION = sizing.Raster(GRID, (0, 0), (1, 1))
TWICE = np.concatenate([POINTS, POINTS[:1]])
DISTANCE = sizing.Distance(sizing.Circle((0.5, 0.5), 0.2), h_min=0.1, growth=1.2)
CASE = "size = 0.3\n[domain]\nlower = [0, 0]\nupper = [1, 1]\n[run]\neffort = 'fast'\n"
RASTER = "{{ kind = 'raster', file = '{}', lower = [0, 0], upper = [1, 1] }}\n"
FIELDS = "{{ kind = 'hessian', file = '{}', n_cells = 30, {} }}\n"
CAPS = "{ kind = 'caps', h_max = 0.7, growth = 1.2, regions = [{ center = [0, 0], radius = 0.1, size = 0.5 }] }\n"
LONLAT = "{{ kind = 'raster', file = '{}' }}\n"
SPHERE_CASE = "size = 0.7\n[domain]\nkind = 'sphere'\nradius = 1\n[run]\neffort = 'fast'\n"


def first_rows(name, array):
    return eval(clvoro.arguments.FIRST_ROWS.format(name), {"numpy": np, name: array})


def raster(lower, upper, shape=(5, 9), **options):
    return sizing.Raster(np.full(shape, 0.5), lower, upper, **options)


def lonlat(lon, lat, names=("lat", "lon"), /, **units):
    """Return what `earth.from_xarray` takes: an array with longitudes and latitudes, some in other units."""
    along = {}
    for name, values in zip(names, (lat, lon), strict=True):
        attrs = {"units": units[name]} if name in units else {}
        values = np.asarray(values, float)
        dims = (name,) if values.ndim == 1 else ("j", "i")
        along[name] = SimpleNamespace(values=values, dims=dims, attrs=attrs)
    values = np.full((len(lat), len(lon)), 0.5)
    return SimpleNamespace(values=values, dims=names, coords=along, attrs={})


class Formless(sizing.Field):
    """A size field that has only its formula in NumPy."""

    def _evaluate(self, points):
        return np.full(len(points), 0.3)


class OnHost(Formless):
    on_device = False


class Endless(Formless):
    """A size field with more numbers than the device counts."""

    def _emit(self, writer):
        writer._stored = 2**31
        return "0.3"


def spoil(name, old, new):
    """Return a function that changes a file of a case, and makes a mesh of clvoro unknown in it."""

    def change(case):
        text = (case / name).read_text()
        (case / name).write_text(re.sub(old, new, text, count="faces" not in name))
        if "polyMesh" in name:
            (case / "constant/polyMesh/clvoro.npz").unlink()
        assert (case / name).read_text() != text

    return change


def solve(case):
    """Write a time as a solver does."""
    latest = FoamCase(case).latest()
    shutil.copytree(case / latest.name, case / f"{latest.value + 5:g}")


def north(points):
    return points[:, -1] > 0


def nested():
    """A tetrahedron in a larger one."""
    return np.concatenate([CORNERS, 0.1 * CORNERS + 0.2]), [*TRIANGLES, *(np.array(TRIANGLES) + 4)]


def two(scale, away=0.1, turned=False):
    """Return vertices and triangles of a tetrahedron, and of another one in it or across it."""
    more = np.array(TRIANGLES) + 4
    return np.concatenate([CORNERS, away + scale * CORNERS]), [*TRIANGLES, *(more[:, ::-1] if turned else more)]


RING = np.column_stack([np.cos(a := np.arange(60) * np.pi / 30), np.sin(a)])
BALL = GLOBE.icosahedral_points(2)
WIDE = {dim: clvoro.Box((-2,) * dim, (2,) * dim) for dim in (2, 3)}
UNKNOWN = spoil("constant/polyMesh/boundary", "$", "\n")
NO_END = spoil("system/controlDict", "endTime 5", "endTime 0")
WEDGE = spoil("constant/polyMesh/boundary", "wall;", "wedge;")
POINT = sizing.Distance(sizing.Circle((0.5, 0.5), 0), h_min=1e-9, growth=3, h_max=0.3)
LON, LAT = np.linspace(-180, 180, 9), np.linspace(-90, 90, 5)

# What was wrong, and what the error says to write instead. `t` has files and small meshes. The error names an argument
# that differs between them, or what the third entry says.
ROWS = [
    # Runs.
    (lambda t: t.run(0.3, BOX), lambda t: t.run(BOX, 0.3)),
    (lambda t: t.run(BOX, 0.3, method="fast"), lambda t: t.run(BOX, 0.3, effort="fast")),
    (lambda t: t.run(BOX, 0.3, effort="exact"), lambda t: t.run(BOX, 0.3, method="exact")),
    (lambda t: t.run(BOX, 0.3, 200), lambda t: t.run(BOX, 0.3, "default")),
    (lambda t: clvoro.Adapter("cpu"), lambda t: clvoro.Adapter(clvoro.create_context("cpu"))),
    (lambda t: copy.copy(t.adapter), lambda t: clvoro.Adapter(t.adapter.ctx, t.adapter.dtype)),
    (lambda t: t.reentrant(t.adapter), lambda t: t.reentrant(clvoro.Adapter(t.adapter.ctx))),
    (lambda t: t.run(BOX, 0.2, callback=lambda a, b: None), lambda t: t.run(BOX, 0.2, callback=lambda row: None)),
    (lambda t: t.run(BOX, lambda p: 0 * p[:, 0]), lambda t: t.run(BOX, sizing.maximum(lambda p: 0 * p[:, 0], 0.2))),
    (lambda t: t.run(BOX, lambda p: 1e-200 + 0 * p[:, 0]), lambda t: t.run(BOX, sizing.maximum(0.2, 0.1))),
    (
        lambda t: t.run(BOX, 0.3, layers=clvoro.Layers(0.05), method="transport"),
        lambda t: t.run(BOX, 0.3, layers=clvoro.Layers(0.05), method="exact"),
    ),
    (
        lambda t: t.run(BOX, 0.1, layers=clvoro.Layers(0.02), n_cells=20),
        lambda t: t.run(BOX, 0.1, layers=clvoro.Layers(0.02)),
    ),
    (
        lambda t: t.run(BOX, 0.1, layers=clvoro.Layers(0.1, count=6)),
        lambda t: t.run(BOX, 0.1, layers=clvoro.Layers(0.02, count=6)),
    ),
    (
        lambda t: t.run(BOX, 0.2, fixed=[(0.5, 0.5)], method="transport"),
        lambda t: t.run(BOX, 0.2, fixed=[(0.5, 0.5)], method="exact"),
    ),
    (
        lambda t: t.run(BOX, 0.2, points=POINTS, n_cells=40, method="lloyd"),
        lambda t: t.run(BOX, 0.2, points=POINTS, method="lloyd"),
    ),
    (
        lambda t: t.run(BOX, 0.2, n_cells=1, fixed=[(0.2, 0.5), (0.7, 0.5)]),
        lambda t: t.run(BOX, 0.2, fixed=[(0.2, 0.5), (0.7, 0.5)]),
    ),
    (lambda t: t.run(TORUS, 0.2, method="mmpde"), lambda t: t.run(TORUS, 0.2, method="adaptive")),
    (lambda t: t.run(BOX, 0.2, points=POINTS, method="mmpde"), lambda t: t.run(BOX, 0.2, method="mmpde")),
    (lambda t: t.run(BOX, 0.6, method="mmpde"), lambda t: t.run(BOX, 0.1, method="mmpde")),
    (lambda t: t.run(GLOBE, 3.0), lambda t: t.run(GLOBE, 0.8)),
    (lambda t: t.run(GLOBE, 1.0, n_cells=2), lambda t: t.run(GLOBE, 0.8)),
    (lambda t: t.run(LINED, 0.3, n_cells=10, fixed=WELLS), lambda t: t.run(LINED, 0.1, fixed=WELLS)),
    (
        lambda t: t.run(BOX, 0.2, fixed=[(0.5, 0.5)] * 2),
        lambda t: t.run(BOX, 0.2, fixed=np.array([(0.5, 0.5)] * 2)[first_rows("fixed", np.array([(0.5, 0.5)] * 2))]),
    ),
    (
        lambda t: t.run(BOX, 0.2, fixed=[(0.5, 0.02)], layers=clvoro.Layers(0.05)),
        lambda t: t.run(BOX, 0.2, fixed=[(0.5, 0.5)], layers=clvoro.Layers(0.05)),
    ),
    (lambda t: t.run(BOX, 0.2, fixed=[(0.5, 0)]), lambda t: t.run(BOX, 0.2, fixed=[(0.5, 0.2)])),
    (lambda t: t.run(LINED, 0.2, fixed=[(0.5, 0.52)]), lambda t: t.run(LINED, 0.2, fixed=[(0.5, 0.8)])),
    (
        lambda t: t.run(TORUS.without([[(0.3, 0.5), (0.7, 0.49), (0.7, 0.51)]]), 0.1),
        lambda t: t.run(TORUS.without([[(0.3, 0.45), (0.7, 0.4), (0.7, 0.6), (0.3, 0.55)]]), 0.05),
    ),
    (lambda t: t.run(TORUS.without([HOLE]), 0.1, n_cells=90), lambda t: t.run(TORUS.without([HOLE]), 0.1)),
    (lambda t: t.run(t.part.domain, 0.2), lambda t: t.run(BOX, 0.2).subset(clvoro.Box((0.3, 0), (1, 1)))),
    # Checkpoints.
    (
        lambda t: t.run(BOX, 0.3, checkpoint=t.write("notes.txt", "x")),
        lambda t: t.run(BOX, 0.3, checkpoint=t.path("other")),
    ),
    (lambda t: t.run(BOX, 0.3, seed=2, checkpoint=t.resume()), lambda t: t.run(BOX, 0.3, checkpoint=t.resume())),
    (lambda t: t.run(BOX, 0.25, checkpoint=t.resume()), lambda t: t.run(BOX, 0.3, checkpoint=t.resume())),
    # Points, weights and volumes.
    (lambda t: t.voronoi(BOX, [*POINTS, (np.nan, 0)]), lambda t: t.voronoi(BOX, POINTS)),
    (lambda t: t.voronoi(BOX, [*POINTS, (2, 0)]), lambda t: t.voronoi(clvoro.Box((0, 0), (2, 1)), [*POINTS, (2, 0)])),
    (
        lambda t: t.voronoi(BOX, np.ma.masked_greater(POINTS, 0.9)),
        lambda t: t.voronoi(BOX, np.ma.compress_rows(np.ma.masked_greater(POINTS, 0.9))),
    ),
    (
        lambda t: t.voronoi(BOX, POINTS @ (1, 1j)),
        lambda t: t.voronoi(BOX, np.column_stack([(POINTS @ (1, 1j)).real, (POINTS @ (1, 1j)).imag])),
    ),
    (lambda t: t.voronoi(BOX, POINTS.T), lambda t: t.voronoi(BOX, POINTS)),
    (lambda t: t.voronoi(BOX, TWICE), lambda t: t.voronoi(BOX, TWICE[first_rows("points", TWICE)])),
    (
        lambda t: t.adapter.power_diagram(BOX, POINTS, np.where(np.arange(30) < 1, 1.7e308, -1.7e308)),
        lambda t: t.adapter.power_diagram(BOX, POINTS, 0.001 * np.arange(30)),
    ),
    (
        lambda t: clvoro.transport(BOX, POINTS, np.ma.masked_less(np.full(30, 1 / 30), 1)),
        lambda t: clvoro.transport(BOX, POINTS, np.full(30, 1 / 30)),
    ),
    (
        lambda t: clvoro.transport(BOX, POINTS, np.arange(30) / 435),
        lambda t: clvoro.transport(BOX, POINTS[1:], np.arange(1, 30) / 435),
    ),
    (
        lambda t: clvoro.transport(BOX, POINTS, np.ones(30)),
        lambda t: clvoro.transport(BOX, POINTS, np.ones(30) * (BOX.measure / 30)),
    ),
    (
        lambda t: clvoro.transport(t.pieces, POINTS, np.full(30, 1.25 / 30)),
        lambda t: clvoro.transport(t.pieces.split()[0], POINTS, np.full(30, 1 / 30)),
    ),
    (
        lambda t: clvoro.transport(t.pieces, [*POINTS, (2.25, 0.25)], np.full(31, 1.25 / 31)),
        lambda t: clvoro.transport(t.pieces, [*POINTS, (2.25, 0.25)], [*np.full(30, 1 / 30), 0.25]),
    ),
    (lambda t: t.power.subset(t.power.volumes > 0.02), lambda t: t.mesh.subset(t.mesh.volumes > 0.02)),
    (
        lambda t: t.empty.solver_mesh(),
        lambda t: t.adapter.power_diagram(
            BOX, POINTS[t.empty.volumes > 0], t.empty.weights[t.empty.volumes > 0]
        ).solver_mesh(),
    ),
    # Parts of meshes and their figures.
    (
        lambda t: sizing.gap_size(CUBE, h_max=0.4, h_min=0.1),
        lambda t: sizing.gap_size(clvoro.Solid.box((0, 0, 0), (1, 1, 1)), h_max=0.4, h_min=0.1),
    ),
    (lambda t: t.cube.subset(BOX), lambda t: t.cube.subset(BOX.contains(t.cube.points[:, :2])), "keep"),
    (lambda t: t.mesh.subset(np.zeros(30, bool)), lambda t: t.mesh.subset(~np.zeros(30, bool))),
    (lambda t: t.mesh.subset(np.arange(30) % 2), lambda t: t.mesh.subset(np.arange(30) % 2 == 1)),
    (lambda t: t.torus.triangles(), lambda t: (t.torus.neighbors, t.torus.shifts)),
    (lambda t: t.mesh.check(walls="exact"), lambda t: t.mesh.check(solver="openfoam", walls="exact")),
    (lambda t: t.mesh.check(solver="mpas", walls="exact"), lambda t: t.mesh.check(solver="mpas")),
    (lambda t: t.globe.check(solver="openfoam"), lambda t: t.globe.check(solver="mpas")),
    (lambda t: t.globe.solver_mesh(), lambda t: t.globe.faces),
    (lambda t: t.cube.measures.c_grid, lambda t: t.cube.measures.exact, "measures"),
    (lambda t: t.cube.to_shapely(), lambda t: t.cube.to_pyvista()),
    (lambda t: t.torus.to_disv(), lambda t: t.mesh.to_disv(), "periodic"),
    # Transfer.
    (lambda t: t.mesh.transfer(np.ones(30), onto=t.cube), lambda t: t.mesh.transfer(np.ones(30), onto=t.torus)),
    (
        lambda t: t.globe.transfer(np.ones(len(t.globe)), onto=t.large_globe),
        lambda t: t.globe.transfer(np.ones(len(t.globe)), onto=t.globe),
    ),
    (lambda t: t.torus.transfer(np.ones(30), onto=t.wide_torus), lambda t: t.torus.transfer(np.ones(30), onto=t.mesh)),
    (
        lambda t: t.mesh.transfer(np.ones(30) * 1j, onto=t.torus),
        lambda t: t.mesh.transfer(np.column_stack([np.zeros(30), np.ones(30)]), onto=t.torus),
    ),
    (
        lambda t: t.mesh.transfer(np.ones((2, 30)), onto=t.torus),
        lambda t: t.mesh.transfer(np.ones((2, 30)).T, onto=t.torus),
    ),
    (
        lambda t: t.limited("remapping.cell_data.available_memory", lambda _: 3e5).carry(t.mesh, columns=10_000),
        lambda t: t.limited("remapping.cell_data.available_memory", lambda _: 3e5).carry(t.mesh, columns=1),
    ),
    (lambda t: t.carry(t.changed(volumes=2 * t.mesh.volumes)), lambda t: t.carry(t.mesh), "diagram"),
    (
        lambda t: t.limited("remapping.device_transfer.MOST_FACES", {2: 16, 3: 16}).carry(t.wheel),
        lambda t: t.limited("remapping.device_transfer.MOST_FACES", {2: 16, 3: 16}).carry(t.mesh),
        "generators",
    ),
    # Files.
    (
        lambda t: t.mesh.save(t.path("a.vtu"), walls="straight"),
        lambda t: t.mesh.to_vtu(t.path("a.vtu"), walls="straight"),
    ),
    (lambda t: t.mesh.to_vtu(t.path("a.foam")), lambda t: t.mesh.save(t.path("a.foam"))),
    (
        lambda t: t.mesh.save(t.path("none/a.vtu")),
        lambda t: (t.path("made").mkdir(), t.mesh.save(t.path("made/a.vtu"))),
    ),
    (
        lambda t: (t.path("folder.vtu").mkdir(), t.mesh.save(t.path("folder.vtu"))),
        lambda t: t.mesh.save(t.path("file.vtu")),
    ),
    (lambda t: t.mesh.save(t.write("file") / "polyMesh"), lambda t: t.mesh.save(t.path("polyMesh"))),
    (
        lambda t: t.mesh.save(t.path("a.vtu"), cell_data={"volume": np.ones(30)}),
        lambda t: t.mesh.save(t.path("a.vtu"), cell_data={"own": np.ones(30)}),
    ),
    (
        lambda t: t.mesh.save(t.path("a.vtu"), cell_data={"own": np.ma.masked_less(np.arange(30.0), 3)}),
        lambda t: t.mesh.save(t.path("a.vtu"), cell_data={"own": np.arange(30.0)}),
    ),
    (
        lambda t: t.mesh.save(t.path("a.obj"), cell_data={"own": np.ones(30)}),
        lambda t: t.mesh.save(t.path("a.vtk"), cell_data={"own": np.ones(30)}),
    ),
    (
        lambda t: t.mesh.save(t.path("graph.info"), cell_data={"own": np.ones(30)}),
        lambda t: t.mesh.save(t.path("a.nc"), cell_data={"own": np.ones(30)}),
    ),
    (
        lambda t: t.mesh.save(t.path("a.foam"), cell_data={"own": np.ones(30)}),
        lambda t: t.mesh.to_openfoam(t.path("a.foam"), zones={"own": np.arange(30) < 9}),
    ),
    (
        lambda t: t.mesh.save(t.path("a.nc"), cell_data={"mesh": np.ones(30)}),
        lambda t: t.mesh.save(t.path("a.nc"), cell_data={"own": np.ones(30)}),
    ),
    (lambda t: t.cube.save(t.path("a.obj")), lambda t: t.cube.save(t.path("a.vtu"))),
    (lambda t: t.cube.to_openfoam(t.path("a.foam"), thickness=1), lambda t: t.cube.to_openfoam(t.path("a.foam"))),
    (
        lambda t: t.voronoi(clvoro.Box((0, 0), (1, 1), names={"front": "xMin"}), POINTS).save(t.path("a.foam")),
        lambda t: t.voronoi(clvoro.Box((0, 0), (1, 1), names={"forward": "xMin"}), POINTS).save(t.path("a.foam")),
    ),
    (
        lambda t: t.mesh.to_openfoam(t.path("a.foam"), zones={"a b": np.ones(30, bool)}),
        lambda t: t.mesh.to_openfoam(t.path("a.foam"), zones={"ab": np.ones(30, bool)}),
    ),
    (
        lambda t: t.mesh.to_openfoam(t.path("a.foam"), zones={"own": t.mesh.points[:, 0]}),
        lambda t: t.mesh.to_openfoam(t.path("a.foam"), zones={"own": t.mesh.points[:, 0] > 0}),
    ),
    (
        lambda t: (t.mesh.save(t.path("a.foam")), clvoro.load(t.path("a.foam"))),
        lambda t: (t.mesh.save(t.path("a.npz")), clvoro.load(t.path("a.npz"))),
    ),
    (
        lambda t: t.globe.to_netcdf(t.path("a.nc"), units="degrees"),
        lambda t: t.globe.to_netcdf(t.path("a.nc"), units="km"),
    ),
    (lambda t: t.mesh.to_netcdf(t.path("a.nc"), convention="scrip"), lambda t: t.mesh.to_netcdf(t.path("a.nc"))),
    (
        lambda t: t.holed.to_netcdf(t.path("a.nc"), convention="mpas"),
        lambda t: t.mesh.subset(np.abs(POINTS - 0.5).max(axis=1) < 0.4).to_netcdf(t.path("a.nc"), convention="mpas"),
    ),
    (lambda t: t.around.to_netcdf(t.path("a.nc"), convention="mpas"), lambda t: t.around.to_netcdf(t.path("a.nc"))),
    (lambda t: t.around.check(solver="openfoam", walls="exact").demand(), lambda t: t.around.save(t.path("a.vtu"))),
    (
        lambda t: t.single.to_netcdf(t.path("a.nc"), convention="mpas"),
        lambda t: t.torus.to_netcdf(t.path("a.nc"), convention="mpas"),
        "cells",
    ),
    # Pictures.
    (lambda t: plotting.plot_globe(t.mesh), lambda t: t.result.plot()),
    (lambda t: plotting.plot_slices(t.result), lambda t: t.result.plot()),
    (
        lambda t: plotting.plot_slice(t.cube_result, through=(0, 0, 9)),
        lambda t: plotting.plot_slice(t.cube_result, through=(0, 0, 0.5)),
    ),
    (lambda t: t.result.plot(cut="x"), lambda t: t.result.plot()),
    # Size fields.
    (lambda t: sizing.Distance(BOX, 0.1, growth=50), lambda t: sizing.Distance(BOX, 0.1, slope=0.5)),
    (lambda t: sizing.Expression("x" + "+x" * 60_000), lambda t: raster((0, 0), (1, 1))),
    (lambda t: DISTANCE - 0.1, lambda t: t.run(BOX, lambda p: DISTANCE(p) - 0.01 * p[:, 0])),
    (lambda t: DISTANCE**0.5, lambda t: t.run(BOX, lambda p: DISTANCE(p) ** 0.9)),
    (lambda t: min(DISTANCE, 0.1), lambda t: t.run(BOX, sizing.minimum(DISTANCE, 0.15))),
    (lambda t: np.sqrt(DISTANCE), lambda t: t.run(BOX, lambda p: np.sqrt(DISTANCE(p)))),
    (
        lambda t: t.run(BOX, sizing.minimum(*[sizing.Expression(f"0.3 + {k}") for k in range(300)])),
        lambda t: t.run(BOX, sizing.Distance([sizing.Circle((0, 1 + k), 0) for k in range(300)], 0.3, 1.2)),
    ),
    (
        lambda t: t.run(CUBE, DISTANCE),
        lambda t: t.run(CUBE, sizing.Distance(sizing.Ball((0.5, 0.5, 0.5), 0.2), h_min=0.3, growth=1.2)),
    ),
    (
        lambda t: t.run(BOX, lambda p: np.ma.masked_less(p[:, 0], 0.5)),
        lambda t: t.run(BOX, lambda p: np.ma.filled(np.ma.masked_less(p[:, 0], 0.5), 0.3)),
    ),
    (lambda t: t.run(BOX, lambda p: 0.3), lambda t: t.run(BOX, 0.3)),
    (
        lambda t: sizing.Graded(lambda p: 0.3 + 0 * p[:, 0], 1.2)(POINTS),
        lambda t: sizing.Graded(lambda p: 0.3 + 0 * p[:, 0], 1.2, box=BOX)(POINTS),
    ),
    (
        lambda t: t.run(BOX, sizing.Graded(lambda p: 0.3 + 0 * p[:, 0], 1.2, resolution=2**20)),
        lambda t: t.run(BOX, sizing.Graded(lambda p: 0.3 + 0 * p[:, 0], 1.2)),
    ),
    (
        lambda t: t.run(BOX, sizing.Graded(lambda p: 0.3 + 0 * p[:, 0], 1.2, resolution=46000)),
        lambda t: t.run(BOX, sizing.Graded(lambda p: 0.3 + 0 * p[:, 0], 1.2, resolution=50)),
    ),
    (
        lambda t: sizing.Raster([[1, np.nan]], (0, 0), (1, 1)),
        lambda t: sizing.Raster([[1, np.nan]], (0, 0), (1, 1), missing="nearest"),
    ),
    (lambda t: raster((0, 1), (1, 0)), lambda t: sizing.Raster(np.full((5, 9), 0.5)[::-1], (0, 0), (1, 1))),
    (
        lambda t: t.run(BOX, raster((0, 0), (0.5, 1), outside="error")),
        lambda t: t.run(BOX, raster((0, 0), (0.5, 1), outside="nearest")),
    ),
    (lambda t: t.run(BOX, raster((5, 5), (6, 6))), lambda t: t.run(BOX, raster((0, 0), (1, 1)))),
    (
        lambda t: sizing.Scattered(POINTS, np.full(30, np.nan), (0, 0), (1, 1)),
        lambda t: sizing.Scattered(POINTS, np.full(30, 0.5), (0, 0), (1, 1)),
    ),
    (
        lambda t: sizing.Scattered(POINTS * (1, 0), np.ones(30)),
        lambda t: sizing.Scattered(POINTS, np.ones(30), (0, 0), (1, 1)),
    ),
    (
        lambda t: sizing.Scattered(POINTS, np.ones(30), (5, 5), (6, 6)),
        lambda t: sizing.Scattered(POINTS, np.ones(30), (0, 0), (1, 1)),
    ),
    (
        lambda t: sizing.Scattered(TWICE, np.arange(31.0) + 1, (0, 0), (1, 1)),
        lambda t: sizing.Scattered(TWICE, np.arange(31.0) + 1, (0, 0), (1, 1), method="nearest"),
    ),
    (
        lambda t: sizing.Scattered(POINTS[:2], np.ones(2), (0, 0), (1, 1)),
        lambda t: sizing.Scattered(POINTS[:2], np.ones(2), (0, 0), (1, 1), method="nearest"),
    ),
    (
        lambda t: sizing.Region(shapely.Polygon([SQUARE[k] for k in (0, 2, 1, 3)]), 0.1, 1.2),
        lambda t: sizing.Region(shapely.Polygon(SQUARE), 0.1, 1.2),
    ),
    (
        lambda t: sizing.hessian_size(sizing.Raster(np.ones((2, 2)), (0, 0), (1, 1)), n_cells=9),
        lambda t: sizing.hessian_size(SOLUTION, n_cells=9),
    ),
    (
        lambda t: sizing.hessian_size(SOLUTION, n_cells=9, p=0),
        lambda t: sizing.hessian_size(SOLUTION, n_cells=9, p=np.inf),
    ),
    (lambda t: sizing.hessian_size(SOLUTION.with_values(np.ones((9, 9))), n_cells=9), lambda t: t.run(BOX, 0.3)),
    (
        lambda t: sizing.hessian_size(SOLUTION, n_cells=9, h_max=1e-3),
        lambda t: sizing.hessian_size(SOLUTION, n_cells=9),
    ),
    # Boxes, polygons and curves.
    (lambda t: clvoro.Box(0, 2.5), lambda t: clvoro.Box((0, 0), (2.5, 1.5))),
    (lambda t: clvoro.Box((0, 2.5), (0, 1.5)), lambda t: clvoro.Box((0, 0), (2.5, 1.5))),
    (lambda t: clvoro.Box((0, 0), (1e200, 1)), lambda t: clvoro.Box((0, 0), (1, 1))),
    (lambda t: BOX.without([HOLE]), lambda t: clvoro.Polygon(SQUARE, [HOLE])),
    (
        lambda t: t.case(f"size = 0.1\n[domain]\nlower = [0, 0]\nupper = [1, 1]\nholes = {HOLES}"),
        lambda t: t.case(
            f"size = 0.1\n[domain]\nouter = {{kind = 'box', lower = [0, 0], upper = [1, 1]}}\nholes = {HOLES}"
        ),
    ),
    (
        lambda t: TORUS.without([HOLE]).without([HOLE]),
        lambda t: TORUS.without([HOLE, [(0.1, 0.1), (0.2, 0.1), (0.2, 0.2)]]),
    ),
    (
        lambda t: TORUS.without([HOLE, [(x + 0.1, y) for x, y in HOLE]]),
        lambda t: TORUS.without([HOLE, [(x + 0.35, y) for x, y in HOLE]]),
    ),
    (
        lambda t: CHANNEL.without([[(x, y - 0.5) for x, y in HOLE]]),
        lambda t: TORUS.without([[(x, y - 0.5) for x, y in HOLE]]),
        "periodic",
    ),
    (lambda t: CHANNEL.without([HOLE], names={"yMin": [0]}), lambda t: CHANNEL.without([HOLE], names={"pore": [0]})),
    (lambda t: CUBE.with_lines([[(0, 0), (1, 1)]]), lambda t: BOX.with_lines([[(0, 0), (1, 1)]])),
    (lambda t: BOX.with_lines([[(7, 7), (8, 8)]]), lambda t: BOX.with_lines([[(0.7, 0.7), (0.8, 0.8)]])),
    (
        lambda t: t.adapter.diagram(
            clvoro.Box((0, 0, 0), (1, 1, 1e-16), periodic=(False, False, True)), [(0.5, 0.5, 0)]
        ),
        lambda t: t.adapter.diagram(
            clvoro.Box((0, 0, 0), (1, 1, 1e-2), periodic=(False, False, True)), [(0.5, 0.5, 0)]
        ),
    ),
    (
        lambda t: clvoro.Polygon([SQUARE[k] for k in (0, 2, 1, 3)]),
        lambda t: clvoro.Polygon([SQUARE[k] for k in (0, 2, 1, 3)], repair=True),
    ),
    (lambda t: clvoro.Polygon("lake.geojson"), lambda t: clvoro.Polygon.from_geojson(t.lake)),
    (lambda t: clvoro.Polygon(np.multiply(SQUARE, 1e200)), lambda t: clvoro.Polygon(SQUARE)),
    (lambda t: clvoro.Polygon(np.add(SQUARE, 1e16)), lambda t: clvoro.Polygon(SQUARE)),
    (lambda t: clvoro.Polygon([*SQUARE, (1e-15, 1)]), lambda t: clvoro.Polygon([*SQUARE, (1e-15, 1)], repair=True)),
    (lambda t: clvoro.Polygon(SQUARE, [HOLE, HOLE]), lambda t: clvoro.Polygon(SQUARE, [HOLE])),
    (
        lambda t: clvoro.Polygon(SQUARE, [HOLE], names={"hole-1": [0]}),
        lambda t: clvoro.Polygon(SQUARE, [HOLE], names={"pore": [0]}),
    ),
    (
        lambda t: clvoro.Polygon(curves.arc((0, 0), 1, 0, 180)),
        lambda t: clvoro.Polygon([curves.arc((0, 0), 1, 0, 180)]),
    ),
    (
        lambda t: clvoro.Polygon([curves.arc((0, 0), 1, 0, 180), (-1, -1e-7), (0, -1)]),
        lambda t: clvoro.Polygon([curves.arc((0, 0), 1, 0, 180), (-1, 0), (0, -1)]),
    ),
    (
        lambda t: clvoro.Polygon([*SQUARE, curves.circle((0.5, 0.5), 0.1)]),
        lambda t: clvoro.Polygon(SQUARE, [curves.circle((0.5, 0.5), 0.1)]),
    ),
    (
        lambda t: clvoro.Polygon(SQUARE, [curves.circle((0.5, 0.5), 0.1, name="outer")]),
        lambda t: clvoro.Polygon(SQUARE, [curves.circle((0.5, 0.5), 0.1, name="pipe")]),
    ),
    (
        lambda t: clvoro.Polygon([curves.circle((0, 0), 1, tolerance=1e-14)]),
        lambda t: clvoro.Polygon([curves.circle((0, 0), 1, tolerance=1e-6)]),
    ),
    (lambda t: curves.circle((1e9, 0), 1e-9), lambda t: curves.circle((0, 0), 1e-9)),
    (lambda t: curves.arc((0, 0), 1, 0, 360), lambda t: curves.circle((0, 0), 1)),
    (lambda t: curves.naca("24"), lambda t: curves.naca("2412")),
    (lambda t: curves.spline([(0, 0), (1, 1), (1, 1), (2, 0)]), lambda t: curves.spline([(0, 0), (1, 1), (2, 0)])),
    (lambda t: clvoro.Polygon(SQUARE).simplified(5), lambda t: clvoro.Polygon(SQUARE).simplified(0.1)),
    (
        lambda t: clvoro.Polygon.from_geojson(
            {"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": None}]}
        ),
        lambda t: clvoro.Polygon.from_geojson(t.lake),
    ),
    (
        lambda t: clvoro.Polygon.from_geojson({"type": "Point", "coordinates": [0, 0]}),
        lambda t: clvoro.Polygon.from_geojson(t.lake),
    ),
    # Spheres.
    (lambda t: clvoro.Sphere(1e300), lambda t: clvoro.Sphere(6371)),
    (lambda t: GLOBE.boundary(), lambda t: BOX.boundary()),
    (lambda t: t.part.domain.boundary(), lambda t: BOX.boundary()),
    (lambda t: t.run(GLOBE, raster((-90, -180), (90, 180))), lambda t: t.run(GLOBE, raster((-180, -90), (180, 90)))),
    (
        lambda t: t.run(GLOBE, raster(*np.radians([(-180, -90), (180, 90)]))),
        lambda t: t.run(GLOBE, raster((-180, -90), (180, 90))),
    ),
    (
        lambda t: earth.ocean(t.globe, np.ones(len(t.globe), bool)),
        lambda t: earth.ocean(t.globe, ~np.ones(len(t.globe), bool)),
    ),
    (lambda t: earth.ocean(t.globe, north, least_cells=10**6), lambda t: earth.ocean(t.globe, north, least_cells=3)),
    (
        lambda t: earth.ocean(t.globe, shapely.Polygon([(-180, -60), (0, 10), (180, -60)])),
        lambda t: earth.ocean(t.globe, shapely.Polygon([(-180, -60), (0, 10), (180, -60), (180, -90), (-180, -90)])),
    ),
    (lambda t: earth.from_xarray(np.ones((2, 2))), lambda t: sizing.Raster(np.ones((2, 2)), (0, 0), (1, 1))),
    (
        lambda t: earth.from_xarray(lonlat(LON, LAT, ("y", "x"))),
        lambda t: earth.from_xarray(lonlat(LON, LAT, ("lat", "lon"))),
    ),
    (
        lambda t: earth.from_xarray(lonlat(np.radians(LON), np.radians(LAT), lon="radians")),
        lambda t: earth.from_xarray(lonlat(LON, LAT)),
    ),
    (
        lambda t: earth.from_xarray(lonlat(np.radians(LON), np.radians(LAT))),
        lambda t: earth.from_xarray(lonlat(LON, LAT)),
    ),
    (lambda t: earth.from_xarray(lonlat(LON[[1, 0, 2, 3]], LAT)), lambda t: earth.from_xarray(lonlat(LON[:4], LAT))),
    (lambda t: earth.from_xarray(lonlat(LON, LAT * 2)), lambda t: earth.from_xarray(lonlat(LON, LAT))),
    (lambda t: earth.from_xarray(lonlat(LON * 9, LAT)), lambda t: earth.from_xarray(lonlat(LON, LAT))),
    (
        lambda t: earth.from_xarray(lonlat([0, 1e-5, 90], [0, 1e-5, 80])),
        lambda t: earth.from_xarray(lonlat([0, 45, 90], [0, 40, 80])),
    ),
    (lambda t: earth.from_xarray(lonlat(LON + np.zeros((5, 1)), LAT)), lambda t: earth.from_xarray(lonlat(LON, LAT))),
    # Surfaces and solids.
    (
        lambda t: sizing.Surface([(0, 0), (1, 0), (1, 1)], [(0, 1, 2)]),
        lambda t: sizing.ClosedPolyline([(0, 0), (1, 0), (1, 1)]),
    ),
    (lambda t: sizing.Surface(CORNERS, [(0, 1, 2, 3)]), lambda t: sizing.Surface(CORNERS, TRIANGLES)),
    (lambda t: sizing.Surface(CORNERS * (1, 0, 0), TRIANGLES), lambda t: sizing.Surface(CORNERS, TRIANGLES)),
    (
        lambda t: sizing.Surface(CORNERS, TRIANGLES[:3]).contains(CORNERS),
        lambda t: sizing.Surface(CORNERS, TRIANGLES).contains(CORNERS),
    ),
    (
        lambda t: sizing.Surface(CORNERS, [*TRIANGLES, TRIANGLES[0]]).contains(CORNERS),
        lambda t: sizing.Surface(CORNERS, TRIANGLES).contains(CORNERS),
    ),
    (
        lambda t: clvoro.Solid(CORNERS, [*TRIANGLES, TRIANGLES[0]]),
        lambda t: clvoro.Solid(CORNERS, [*TRIANGLES, TRIANGLES[0]], repair=True),
    ),
    (lambda t: clvoro.Solid(CORNERS, TRIANGLES[:3]), lambda t: clvoro.Solid(CORNERS, TRIANGLES[:3], repair=True)),
    (lambda t: clvoro.Solid(CORNERS, TRIANGLES[2:3]), lambda t: clvoro.Solid(CORNERS, TRIANGLES[2:3], bottom=-1)),
    (
        lambda t: clvoro.Solid(CORNERS, TRIANGLES[2:3], bottom=0),
        lambda t: clvoro.Solid(CORNERS, TRIANGLES[2:3], bottom=-0.1),
    ),
    (lambda t: clvoro.Solid(CORNERS, TRIANGLES, bottom=-1), lambda t: clvoro.Solid(CORNERS, TRIANGLES)),
    (
        lambda t: clvoro.Solid(CROSSED, [(0, 1, 2), (0, 2, 3)], bottom=-1),
        lambda t: clvoro.Solid(CROSSED[[0, 2, 1, 3]], [(0, 1, 2), (0, 2, 3)], bottom=-1),
    ),
    (
        lambda t: clvoro.Solid(CORNERS, [*TRIANGLES[:3], TRIANGLES[3][::-1]]),
        lambda t: clvoro.Solid(CORNERS, [*TRIANGLES[:3], TRIANGLES[3][::-1]], repair=True),
    ),
    (
        lambda t: clvoro.Solid(CORNERS, np.array(TRIANGLES)[:, ::-1]),
        lambda t: clvoro.Solid(CORNERS, np.array(TRIANGLES)),
    ),
    (lambda t: clvoro.Solid(*two(0.2)), lambda t: clvoro.Solid(*two(0.2, turned=True))),
    (
        lambda t: clvoro.Solid(*two(1, away=0.3)),
        lambda t: clvoro.Solid(CORNERS, TRIANGLES) + clvoro.Solid(CORNERS + 0.3, TRIANGLES),
    ),
    (
        lambda t: clvoro.Solid.outside(clvoro.Solid(CORNERS, TRIANGLES), clvoro.Box((5, 5, 5), (6, 6, 6))),
        lambda t: clvoro.Solid.outside(clvoro.Solid(CORNERS, TRIANGLES), clvoro.Box((-1, -1, -1), (2, 2, 2))),
    ),
    (
        lambda t: clvoro.Solid.outside(
            clvoro.Solid(CORNERS, TRIANGLES), clvoro.Box((-1, -1, -1), (2, 2, 2), periodic=True)
        ),
        lambda t: clvoro.Solid.outside(clvoro.Solid(CORNERS, TRIANGLES), clvoro.Box((-1, -1, -1), (2, 2, 2))),
    ),
    (
        lambda t: clvoro.Solid(CORNERS, TRIANGLES) & clvoro.Solid(CORNERS + 5, TRIANGLES),
        lambda t: clvoro.Solid(CORNERS, TRIANGLES) & clvoro.Solid(CORNERS + 0.1, TRIANGLES),
    ),
    (
        lambda t: clvoro.Solid.polyhedron([(1, 0, 0)], [1]),
        lambda t: clvoro.Solid.polyhedron(np.concatenate([np.eye(3), -np.eye(3)]), np.ones(6)),
    ),
    (
        lambda t: sizing.Surface.read(t.write("a.stl", "solid x\nfacet")),
        lambda t: clvoro.Solid.ball((0, 0, 0), 1).surface,
    ),
    (
        lambda t: t.run(clvoro.Solid.box((0, 0, 0), (1, 1, 1e-3)), 0.5),
        lambda t: t.run(clvoro.Solid.box((0, 0, 0), (1, 1, 1)), 0.5),
    ),
    # Case files and the command.
    (lambda t: t.job(CASE, walls="exact"), lambda t: t.job(CASE, walls="exact", mesh_formats=("openfoam",))),
    (
        lambda t: t.job(CASE, types={"xMin": "patch"}),
        lambda t: t.job(CASE, types={"xMin": "patch"}, mesh_formats=("openfoam",)),
    ),
    (lambda t: t.job(SPHERE_CASE, mesh_formats=("openfoam",)), lambda t: t.job(SPHERE_CASE, mesh_formats=("nc",))),
    (lambda t: t.job(CASE, mesh_formats=("scrip",)), lambda t: t.job(CASE, mesh_formats=("nc",))),
    (
        lambda t: t.job(CASE.replace("[0, 0]", "[0, 0, 0]").replace("[1, 1]", "[1, 1, 1]"), mesh_formats=("nc",)),
        lambda t: t.job(CASE.replace("[0, 0]", "[0, 0, 0]").replace("[1, 1]", "[1, 1, 1]"), mesh_formats=("openfoam",)),
    ),
    (lambda t: t.job(CASE, checkpoint_every=5), lambda t: t.job(CASE, checkpoint_every=5, checkpoint=t.path("c"))),
    (
        lambda t: t.job(CASE + "method = ['lloyd', 'coupled']", checkpoint=t.path("c")),
        lambda t: t.job(CASE + "method = 'adaptive'", checkpoint=t.path("c")),
    ),
    (lambda t: t.job(CASE, checkpoint=t.path("out/mesh.npz")), lambda t: t.job(CASE, checkpoint=t.path("c"))),
    (lambda t: (t.path("out/mesh.vtu").mkdir(parents=True), t.job(CASE)), lambda t: t.job(CASE, out=t.path("out2"))),
    (lambda t: t.case(CASE.replace("lower", "outer = [[0, 0], [1, 0], [1, 1]]\nlower")), lambda t: t.case(CASE)),
    (
        lambda t: t.case(CASE.replace("size = 0.3", "name = 'a/b'\nsize = 0.3")),
        lambda t: t.case(CASE.replace("size = 0.3", "name = 'ab'\nsize = 0.3")),
    ),
    (
        lambda t: t.case(f"size = 1\n[domain]\npolygon = '{t.write('a.shp', 'x')}'\n"),
        lambda t: t.case(f"size = 1\n[domain]\npolygon = '{t.lake}'\n"),
    ),
    (
        lambda t: t.case(CASE.replace("0.3\n", RASTER.format(t.write("a.npy", "x")))),
        lambda t: t.case(CASE.replace("0.3\n", RASTER.format(t.grid))),
    ),
    (
        lambda t: t.case(CASE.replace("0.3\n", RASTER.replace("raster", "raster', variable = 'h").format(t.grid))),
        lambda t: t.case(CASE.replace("0.3\n", RASTER.format(t.grid))),
    ),
    (lambda t: clvoro.create_context(3), lambda t: clvoro.create_context("cpu")),
    (lambda t: clvoro.Box("ab", "cd"), lambda t: clvoro.Box((0, 0), (2.5, 1.5))),
    (lambda t: t.run(BOX, POINT, dtype="float32"), lambda t: t.run(BOX, POINT)),
    (
        lambda t: t.run(BOX, 1e-9, points=POINTS, method="lloyd", dtype="float32"),
        lambda t: t.run(BOX, 0.2, points=POINTS, method="lloyd"),
    ),
    (
        lambda t: DensityTree(sizing.as_field(lambda p: np.nan * p[:, 0]), BOX),
        lambda t: DensityTree(sizing.as_field(lambda p: np.nan_to_num(np.nan * p[:, 0], nan=0.3)), BOX),
    ),
    (lambda t: t.case(CASE.replace("0.3\n", CAPS)), lambda t: t.case(SPHERE_CASE.replace("0.7\n", CAPS)), "domain"),
    (
        lambda t: t.case(SPHERE_CASE.replace("0.7\n", RASTER.format(t.lonlat))),
        lambda t: t.case(
            SPHERE_CASE.replace("0.7\n", RASTER.format(t.lonlat).replace(", lower = [0, 0], upper = [1, 1]", ""))
        ),
    ),
    (
        lambda t: t.job(CASE.replace("effort = 'fast'", "methods = ['lloyd', 'coupled']"), checkpoint=t.path("c")),
        lambda t: t.job(CASE.replace("effort = 'fast'", "method = 'coupled'"), checkpoint=t.path("c")),
    ),
    (
        lambda t: t.run(GLOBE, sizing.Graded(sizing.Expression("0.7 + 0 * lat"), 1.2, box=BOX)),
        lambda t: t.run(GLOBE, sizing.Graded(sizing.Expression("0.7 + 0 * lat"), 1.2)),
    ),
    (
        lambda t: earth.from_xarray(
            SimpleNamespace(**vars(lonlat(LON, LAT)) | {"values": np.ones((2, 5, 9)), "dims": ("time", "lat", "lon")})
        ),
        lambda t: earth.from_xarray(lonlat(LON, LAT)),
    ),
    (lambda t: t.around.to_openfoam(t.path("a.foam"), walls="exact"), lambda t: t.around.save(t.path("a.vtu"))),
    (lambda t: clvoro.Polygon(np.multiply(SQUARE, 1e-3) + 1e12), lambda t: clvoro.Polygon(np.multiply(SQUARE, 1e-3))),
    (lambda t: sizing.Raster([[np.nan] * 2] * 2, (0, 0), (1, 1), missing="nearest"), lambda t: raster((0, 0), (1, 1))),
    (
        lambda t: (t.mesh.save(t.path("a.foam")), clvoro.load(t.path("polyMesh"))),
        lambda t: (t.mesh.save(t.path("a.npz")), clvoro.load(t.path("a.npz"))),
    ),
    # Devices and their memory.
    (
        lambda t: t.device(has_fp64=False) and clvoro.Adapter(t.device()),
        lambda t: t.device(has_fp64=False) and clvoro.Adapter(t.device(), dtype="float32"),
    ),
    (
        lambda t: clvoro.create_context(t.device(_try_device=(None, "it cannot build")).devices[0]),
        lambda t: clvoro.create_context("cpu"),
    ),
    (
        lambda t: (t.patch.setenv("PYOPENCL_CTX", "987:6"), clvoro.create_context()),
        lambda t: (t.patch.delenv("PYOPENCL_CTX", raising=False), clvoro.create_context()),
        "PYOPENCL_CTX",
    ),
    (lambda t: profile.Profile(t.adapter).table(), lambda t: t.profiled().table()),
    (
        lambda t: profile.Profile(cl.CommandQueue(t.adapter.ctx)),
        lambda t: profile.Profile(profile.profiled_queue(t.adapter.ctx)),
    ),
    (
        lambda t: t.limited("adaptation.estimates.available_memory", lambda _: 1e8).run(BOX, 1e-3),
        lambda t: t.limited("adaptation.estimates.available_memory", lambda _: 1e8).run(BOX, 0.3),
    ),
    (
        lambda t: t.limited("opencl.memory_limits.largest_allocation", lambda _: 1e6).run(BOX, 1e-2),
        lambda t: t.limited("opencl.memory_limits.largest_allocation", lambda _: 1e6).run(BOX, 0.3),
    ),
    (lambda t: t.small_arrays(1e5).corners(2000), lambda t: t.small_arrays(1e5).corners(20), "n_cells"),
    (lambda t: t.full_device(30_000).run(BOX, 0.02), lambda t: t.full_device(30_000).run(BOX, 0.3)),
    (
        lambda t: t.limited("adaptation.estimates.MAX_CELLS", 200).run(BOX, 0.05),
        lambda t: t.limited("adaptation.estimates.MAX_CELLS", 200).run(BOX, 0.3),
    ),
    (lambda t: t.run(BOX, Endless()), lambda t: t.run(BOX, raster((0, 0), (1, 1)))),
    (
        lambda t: t.limited("tessellation.cells.MOST_ENTRIES", 1600).voronoi(BOX, POINTS),
        lambda t: t.limited("tessellation.cells.MOST_ENTRIES", 1600).voronoi(BOX, POINTS[:3]),
        "cells",
    ),
    (
        lambda t: t.limited("tessellation.polyhedra.MOST_HALF_FACES", 300).voronoi(CUBE, POINTS[:, [0, 1, 0]]),
        lambda t: t.limited("tessellation.polyhedra.MOST_HALF_FACES", 300).voronoi(CUBE, POINTS[:3, [0, 1, 0]]),
        "cells",
    ),
    (
        lambda t: t.limited("tessellation.topology3d.half_faces.MOST_LOOP_ENTRIES", 800).corners(50),
        lambda t: t.limited("tessellation.topology3d.half_faces.MOST_LOOP_ENTRIES", 800).corners(2),
        "cells",
    ),
    (
        lambda t: t.few_faces().voronoi(WIDE[2], [(0, 0), *RING]),
        lambda t: t.few_faces().voronoi(WIDE[2], RING),
        "generators",
    ),
    (
        lambda t: t.limited("tessellation.polyhedra.MOST_FACES", 64).voronoi(WIDE[3], [(0, 0, 0), *BALL]),
        lambda t: t.limited("tessellation.polyhedra.MOST_FACES", 64).voronoi(WIDE[3], BALL),
        "generators",
    ),
    (lambda t: t.jittered("float32").solver_mesh(), lambda t: t.jittered("float64").solver_mesh()),
    # Libraries that are missing, places that cannot be written, and damaged files.
    (
        lambda t: t.without("matplotlib").job(CASE, report=True),
        lambda t: t.without("matplotlib").job(CASE, report=False),
    ),
    (
        lambda t: t.broken("matplotlib.use").job(CASE, report=True),
        lambda t: t.broken("matplotlib.use").job(CASE, report=False),
    ),
    (lambda t: t.without("matplotlib", "clvoro.plotting").result.plot(), lambda t: t.result.plot()),
    (
        lambda t: t.without("manifold3d").ball - clvoro.Solid(CORNERS, TRIANGLES),
        lambda t: t.ball - clvoro.Solid(CORNERS, TRIANGLES),
    ),
    (
        lambda t: sizing.Surface.read(t.without("trimesh").stl),
        lambda t: t.without("trimesh") and sizing.Surface(CORNERS, TRIANGLES),
    ),
    (
        lambda t: clvoro.Solid.read(t.without("networkx", "trimesh").write("a.3mf", "PK")),
        lambda t: clvoro.Solid.read(t.stl),
    ),
    (
        lambda t: clvoro.Solid.read(t.without("gmsh").write("a.step")),
        lambda t: clvoro.Solid.read(t.without("gmsh").stl),
    ),
    (lambda t: clvoro.Solid.read(t.needs("gmsh").write("a.step", "ISO-10303-21;")), lambda t: clvoro.Solid.read(t.stl)),
    (
        lambda t: clvoro.Solid.read(t.needs("gmsh").cad("addRectangle", 0, 0, 0, 1, 1)),
        lambda t: clvoro.Solid.read(t.cad("addBox", 0, 0, 0, 1, 1, 1)),
    ),
    (lambda t: sizing.Surface.read(t.write("a.ply", "ply\nformat")), lambda t: sizing.Surface.read(t.stl)),
    (
        lambda t: t.without("meshio").mesh.save(t.path("a.vtk")),
        lambda t: t.without("meshio").mesh.save(t.path("a.vtu")),
    ),
    (
        lambda t: t.without("netCDF4").case(SPHERE_CASE.replace("0.7\n", LONLAT.format(t.hdf))),
        lambda t: t.without("netCDF4").case(SPHERE_CASE.replace("0.7\n", LONLAT.format(t.classic))),
    ),
    (
        lambda t: t.full_disk("full").mesh.save(t.path("full/a.npz")),
        lambda t: t.full_disk("full").mesh.save(t.path("a.npz")),
    ),
    (
        lambda t: t.limited("io.netcdf._MOST", 400).mesh.save(t.path("a.nc")),
        lambda t: t.limited("io.netcdf._MOST", 400).mesh.save(t.path("a.vtu")),
    ),
    (
        lambda t: clvoro.io.write(t.mesh, t.path("a.vtu"), types={"xMin": "patch"}),
        lambda t: clvoro.io.write(t.mesh, t.path("a.foam"), types={"xMin": "patch"}),
    ),
    (lambda t: t.needs("fipy").single.to_fipy(), lambda t: t.torus.to_fipy(), "cells"),
    (lambda t: t.check("a.foam", solver="modflow"), lambda t: t.check("a.npz", solver="modflow")),
    (lambda t: t.resume_with("VERSION", 99), lambda t: t.run(BOX, 0.3)),
    (lambda t: t.resume_with("schedule_digest", str), lambda t: t.run(BOX, 0.3)),
    # A case of OpenFOAM that follows its solution.
    (lambda t: t.follow(lambda case: (case / "processor0").mkdir()), lambda t: t.follow()),
    (lambda t: t.follow(lambda case: shutil.rmtree(case / "5")), lambda t: t.follow(solve)),
    (
        lambda t: t.follow(lambda case: shutil.rmtree(case / "constant/polyMesh")),
        lambda t: t.follow(lambda case: t.mesh.to_openfoam(case / "constant/polyMesh")),
    ),
    (lambda t: t.held(), lambda t: t.follow(), "call"),
    (lambda t: t.follow(solver="noSuchFoam"), lambda t: t.follow(solver=solve)),
    (lambda t: t.follow(cycles=2), lambda t: t.follow(cycles=2, solver=solve)),
    (lambda t: t.follow(solver="true"), lambda t: t.follow(solver=solve)),
    (lambda t: t.follow(NO_END, solver=solve), lambda t: t.follow(NO_END, solver=solve, interval=5)),
    (lambda t: t.follow(mesh=t.part), lambda t: t.follow(mesh=t.mesh)),
    (lambda t: t.follow(mesh=t.voronoi(BOX, POINTS[1:])), lambda t: t.follow(mesh=t.mesh)),
    (lambda t: t.follow(spoil("5/U", r"30\n\(\n.*", "29\n(")), lambda t: t.follow()),
    (lambda t: t.follow(spoil("5/U", r"\(\S+ ", "(nan ")), lambda t: t.follow()),
    (lambda t: t.follow(spoil("5/U", r"uniform \(0", "uniform (nan")), lambda t: t.follow()),
    (lambda t: t.follow(WEDGE), lambda t: t.follow(mesh=t.mesh)),
    (
        lambda t: t.follow(spoil("constant/polyMesh/faces", r"4\((\d+)", r"5(\1 \1")),
        lambda t: t.follow(spoil("constant/polyMesh/faces", r"4\((\d+)", r"5(\1 \1"), mesh=t.mesh),
    ),
    (lambda t: t.opened().follow(UNKNOWN), lambda t: t.opened().follow(UNKNOWN, mesh=t.mesh)),
    # Fields on the cells of a mesh.
    (lambda t: sizing.OnCells(t.mesh, np.full((30, 2), 0.3)), lambda t: sizing.OnCells(t.mesh, np.full(30, 0.3))),
    (lambda t: sizing.OnCells(t.mesh, np.full(29, 0.3)), lambda t: sizing.OnCells(t.mesh, np.full(30, 0.3))),
    (
        lambda t: sizing.sensor_size(POINTS[:, 0] - 0.5, on=t.mesh, n_cells=30),
        lambda t: sizing.sensor_size(np.abs(POINTS[:, 0] - 0.5), on=t.mesh, n_cells=30),
    ),
    (
        lambda t: sizing.combine(sizing.Constant(0.1), sizing.Constant(0.2)),
        lambda t: sizing.minimum(sizing.Constant(0.1), sizing.Constant(0.2)),
    ),
    (
        lambda t: sizing.normalize(sizing.Estimate(t.mesh, np.ones(30), np.zeros(30)), eps=0.1),
        lambda t: sizing.normalize(sizing.Estimate(t.mesh, np.ones(30), np.zeros(30)), n_cells=30),
    ),
    (
        lambda t: sizing.interface_distance(1 + POINTS[:, 0], on=t.mesh),
        lambda t: sizing.interface_distance(POINTS[:, 0] - 0.5, on=t.mesh),
    ),
    (
        lambda t: sizing.hessian_size(POINTS[:, 0] ** 2, n_cells=9),
        lambda t: sizing.hessian_size(POINTS[:, 0] ** 2, n_cells=9, on=t.mesh),
    ),
    (
        lambda t: sizing.hessian_size(SOLUTION, n_cells=9, growth=1.1),
        lambda t: sizing.Graded(sizing.hessian_size(SOLUTION, n_cells=9), 1.1),
    ),
    (
        lambda t: sizing.gradient_size(np.ones(30), on=t.mesh, eps=0.1),
        lambda t: sizing.gradient_size(np.ones(30), on=t.mesh, eps=0.1, h_max=0.3),
    ),
    # Fields in files.
    (lambda t: clvoro.read_fields(t.fields(POINTS)), lambda t: clvoro.read_fields(t.fields(POINTS), domain=BOX)),
    (
        lambda t: clvoro.read_fields(t.fields(100 + POINTS), domain=BOX),
        lambda t: clvoro.read_fields(t.fields(POINTS), domain=BOX),
    ),
    (
        lambda t: clvoro.read_fields(t.fields(POINTS), domain=CUBE),
        lambda t: clvoro.read_fields(t.fields(np.column_stack([POINTS, POINTS[:, 0]])), domain=CUBE),
    ),
    (
        lambda t: clvoro.read_fields(t.fields(np.full((30, 2), np.nan), u=POINTS[:, 0]), domain=BOX),
        lambda t: clvoro.read_fields(t.fields(POINTS, u=POINTS[:, 0]), domain=BOX),
    ),
    (
        lambda t: clvoro.read_fields(t.fields(POINTS, u=np.full(30, np.nan)), domain=BOX),
        lambda t: clvoro.read_fields(t.fields(POINTS, u=POINTS[:, 0]), domain=BOX),
    ),
    (
        lambda t: clvoro.read_fields(t.fields(CORNERS), domain=GLOBE),
        lambda t: clvoro.read_fields(t.fields(CORNERS), domain=CUBE),
    ),
    (
        lambda t: t.case(CASE.replace("0.3\n", FIELDS.format(t.fields(POINTS), "growth = 1.3"))),
        lambda t: t.case(CASE.replace("0.3\n", FIELDS.format(t.fields(POINTS), "fields = ['u'], growth = 1.3"))),
    ),
    # Others.
    (lambda t: t.run(BOX, Formless()), lambda t: t.run(BOX, OnHost())),
    (lambda t: clvoro.load(t.renumbered()), lambda t: clvoro.load(t.saved())),
    (lambda t: t.contradicting().save(t.path("a.nc")), lambda t: t.mesh.save(t.path("a.nc")), "diagram"),
    (
        lambda t: plotting.plot_globe(t.globe, "volume", projection="plate", across=20),
        lambda t: plotting.plot_globe(t.globe, "volume", projection="plate"),
    ),
    (
        lambda t: clvoro.Solid(np.concatenate([CORNERS, CORNERS + 5]), [*TRIANGLES, *(TURNED + 4)]),
        lambda t: clvoro.Solid(np.concatenate([CORNERS, CORNERS + 5]), [*TRIANGLES, *(TURNED + 4)], repair=True),
    ),
    (
        lambda t: clvoro.Solid(CORNERS, TRIANGLES[1:], wrap=0.1, inside=(0.2, 0.2, 0.2)),
        lambda t: clvoro.Solid(CORNERS, TRIANGLES[1:], wrap=0.1, inside=(0.2, 0.2, 0.2), repair=True),
    ),
    (
        lambda t: clvoro.Solid(*nested(), [0] * 4 + [1] * 4, ["a", "b"], wrap=0.1, names={"x": "b"}),
        lambda t: clvoro.Solid(*nested(), [0] * 4 + [1] * 4, ["a", "b"], wrap=0.1),
    ),
    (
        lambda t: sizing.Surface(*two(1, away=0.3)).check(),
        lambda t: (clvoro.Solid(CORNERS, TRIANGLES) + clvoro.Solid(CORNERS + 0.3, TRIANGLES)).surface.check(),
    ),
    (
        lambda t: t.run(clvoro.Polygon(KITE), 0.1, layers=clvoro.Layers(0.7, 1, edges=[1])),
        lambda t: t.run(clvoro.Polygon(KITE), 0.1, layers=clvoro.Layers(0.02, 1, edges=[1])),
    ),
    (
        lambda t: t.run(BLOCK, 0.4, layers=clvoro.Layers(0.01, 2, spacing=0.1)),
        lambda t: t.run(BLOCK, 0.4, layers=clvoro.Layers(0.01, 2)),
    ),
    (
        lambda t: t.run(BLOCK, 0.4, layers=[clvoro.Layers(0.01, 2), clvoro.Layers(0.02, 2, edges=["zMax"])]),
        lambda t: t.run(BLOCK, 0.4, layers=[FIRST, clvoro.Layers(0.02, 2, edges="zMax")]),
    ),
    (
        lambda t: t.run(BLOCK, 0.4, layers=[FIRST, clvoro.Layers(0.02, 3, edges="zMax")]),
        lambda t: t.run(BLOCK, 0.4, layers=[FIRST, clvoro.Layers(0.02, 2, edges="zMax")]),
    ),
    # Plausible mistakes: size functions, points, polygons, arithmetic of size fields.
    (lambda t: t.run(BOX, lambda x, y: 0.3 + 0 * x), lambda t: t.run(BOX, lambda points: 0.3 + 0 * points[:, 0])),
    (
        lambda t: t.run(BOX, sizing.Distance),
        lambda t: t.run(BOX, sizing.Distance(sizing.Circle((0.5, 0.5), 0.2), 0.1, 1.2)),
    ),
    (
        lambda t: t.run(BOX, lambda p: 0.3 if p[:, 0] < 0.5 else 0.2),
        lambda t: t.run(BOX, lambda p: np.where(p[:, 0] < 0.5, 0.3, 0.2)),
    ),
    (
        lambda t: t.run(BOX, lambda p: 0.2 + math.sqrt(p[:, 0])),
        lambda t: t.run(BOX, lambda p: 0.2 + np.sqrt(p[:, 0])),
        "numpy",
    ),
    (lambda t: t.run(BOX, lambda p: 0.3 + p[:, :1]), lambda t: t.run(BOX, lambda p: (0.3 + p[:, :1])[:, 0]), "sizes"),
    (lambda t: t.run(BOX, lambda p: 0.3 + p[0]), lambda t: t.run(BOX, lambda points: 0.3 + points[:, 0])),
    (lambda t: t.run(BOX, lambda p: None), lambda t: t.run(BOX, lambda p: 0.3 + 0 * p[:, 0]), "numbers"),
    (lambda t: t.run(BOX, POINTS), lambda t: t.run(BOX, 0.3, points=POINTS, method="lloyd")),
    (
        lambda t: t.run(BOX, sizing.Circle((0.5, 0.5), 0.2)),
        lambda t: t.run(BOX, sizing.Distance(sizing.Circle((0.5, 0.5), 0.2), 0.1, 1.2)),
    ),
    (
        lambda t: sizing.Distance(0.1, sizing.Circle((0, 0), 1), growth=1.2),
        lambda t: sizing.Distance(sizing.Circle((0, 0), 1), 0.1, growth=1.2),
        "distance",
    ),
    (
        lambda t: t.run(BOX, sizing.Expression("sqrt(x - 1)")),
        lambda t: t.run(BOX, sizing.Expression("0.3 + sqrt(fmax(x - 1, 0))")),
    ),
    (lambda t: t.run(BOX, 0.3, layers=0.01), lambda t: t.run(BOX, 0.3, layers=clvoro.Layers(0.01))),
    (lambda t: t.run(BOX, 0.3, points=t.mesh), lambda t: t.run(BOX, 0.3, points=t.mesh.points, method="lloyd")),
    (
        lambda t: t.voronoi(BOX, np.hstack([POINTS] * 2)),
        lambda t: t.voronoi(BOX, np.hstack([POINTS] * 2)[:, :2]),
        "array",
    ),
    (lambda t: t.voronoi(BOX, POINTS[:, 0]), lambda t: t.voronoi(BOX, np.column_stack([POINTS[:, 0], POINTS[:, 1]]))),
    (
        lambda t: t.voronoi(BOX, RECORDS),
        lambda t: t.voronoi(BOX, np.lib.recfunctions.structured_to_unstructured(RECORDS)),
    ),
    (lambda t: t.voronoi(BOX, iter(POINTS)), lambda t: t.voronoi(BOX, list(iter(POINTS)))),
    (lambda t: BOX.contains((0.5, 0.5)), lambda t: BOX.contains([(0.5, 0.5)]), "points"),
    (lambda t: clvoro.Polygon(WKT), lambda t: clvoro.Polygon.from_wkt(WKT)),
    (lambda t: clvoro.Polygon(shapely.box(0, 0, 1, 1)), lambda t: clvoro.Polygon.from_shapely(shapely.box(0, 0, 1, 1))),
    (lambda t: clvoro.Polygon(LAKE), lambda t: clvoro.Polygon.from_geojson(LAKE)),
    (lambda t: clvoro.Polygon([SQUARE, HOLE]), lambda t: clvoro.Polygon(SQUARE, [HOLE]), "rings"),
    (lambda t: clvoro.Polygon(SQUARE, HOLE), lambda t: clvoro.Polygon(SQUARE, [HOLE])),
    (
        lambda t: clvoro.Polygon.from_shapely([shapely.box(0, 0, 1, 1)]),
        lambda t: clvoro.Polygon.from_shapely(shapely.union_all([shapely.box(0, 0, 1, 1)])),
    ),
]


TESTED_IN = {
    "file, expected GeoJSON": "adaptation/test_messages.py::test_shapefiles",
    "is a geometry, expected a case": "cli/test_cli.py::test_errors_are_one_message",
    "which is too small for its extent": "geometry/solid/test_files_and_booleans.py::test_wrong_options_are_refused",
    "Gmsh would need hours": "geometry/solid/test_files_and_booleans.py::test_parts_of_step_files_are_united",
    "longer than the surface": "geometry/solid/test_files_and_booleans.py::test_wrong_options_are_refused",
    "is drawn in a figure of its own": "geometry/test_boundary_names.py::test_plots_show_walls_in_space",
    "that of a mesh is mesh.domain": "geometry/test_boundary_names.py::test_plots_show_the_names",
    "has one value in all cells of the latest time": "foam/test_foam_cases.py::test_bad_input_changes_nothing",
    "a mesh that the solver moves or refines": "foam/test_foam_cases.py::test_bad_input_changes_nothing",
    "which writes one for each patch": "foam/test_foam_cases.py::test_bad_input_changes_nothing",
    "has no number nu": "foam/test_foam_cases.py::test_bad_input_changes_nothing",
    "expected both; name adjoints=": "foam/test_foam_cases.py::test_wrong_fields_are_refused",
    "has none of the new cells": "foam/test_foam_cases.py::test_zones_and_groups_follow",
    "U enters the domain with": "foam/test_foam_cases.py::test_bad_input_changes_nothing",
    "do not bound one layer of cells normal to z": "foam/test_foam_cases.py::test_bad_input_changes_nothing",
    "this process was forked": "robustness/test_unattended.py::test_forked_processes_are_told_that_they_cannot_work",
    "prisms, which need": "finite_volumes/test_prism_layers.py::test_prisms_that_memory_does_not_hold_are_refused",
    "points in the layers, expected": "finite_volumes/test_prism_layers.py::test_points_in_layers_only_are_refused",
    "; use fewer layers": "finite_volumes/test_prism_layers.py::test_wrong_layers_are_refused",
    "expected a communicator of mpi4py": "adaptation/test_ranks.py::test_what_ranks_cannot_share_is_refused",
    "since ranks or devices share the run": "adaptation/test_ranks.py::test_what_ranks_cannot_share_is_refused",
    "says; allow more, or use a larger size": "adaptation/test_ranks.py::test_parts_hold_what_one_device_does_not",
    "unset it for no limit": "adaptation/test_ranks.py::test_parts_hold_what_one_device_does_not",
    "expected a list of names, indices": "adaptation/test_ranks.py::test_devices_share_a_run",
    "expected one of them; leave one out": "adaptation/test_ranks.py::test_devices_share_a_run",
    "let parts of the mesh share it": "adaptation/test_ranks.py::test_devices_share_a_run",
    "as rank 0 has; give all ranks": "adaptation/test_ranks.py::test_parts_with_other_input_are_refused",
    "one process has the whole mesh": "adaptation/test_ranks.py::test_what_the_command_refuses_over_ranks",
    "needs the whole mesh, and pieces": "adaptation/test_ranks.py::test_what_the_command_refuses_over_ranks",
    "expected one, since ranks share it": "adaptation/test_ranks.py::test_what_the_command_refuses_over_ranks",
    "call clvoro without mpiexec": "adaptation/test_ranks.py::test_what_the_command_refuses_over_ranks",
    "mpi4py belongs to another MPI": "adaptation/test_ranks.py::test_what_the_command_refuses_over_ranks",
    "processors are given, and nothing": "adaptation/test_ranks.py::test_what_the_command_refuses_over_ranks",
    "which has the processor of each cell": "io/test_sphere_files.py::test_graph_for_metis_has_the_neighbors",
    "processors is ": "io/test_foam_parts.py::test_what_is_refused",
    "processors has shape": "io/test_foam_parts.py::test_what_is_refused",
    "of another decomposition; remove": "io/test_foam_parts.py::test_what_is_refused",
    "are beside the folder constant": "io/test_foam_parts.py::test_what_is_refused",
    "have one GPU, ": "opencl/test_devices.py::test_ranks_of_a_node_take_its_gpus_in_turn",
    "surfaces are in space": "adaptation/test_surfaces.py::test_what_is_refused_at_the_door",
    "cross or cover each other": "adaptation/test_surfaces.py::test_what_is_refused_at_the_door",
    "surfaces are smaller": "adaptation/test_surfaces.py::test_surfaces_without_room_are_refused_with_the_place",
    "got a shape with the length": "sizing/test_sizing.py::test_distance_to_geometries_of_shapely_and_geojson",
    "has an extent of , expected  to ": "geometry/test_curves.py::test_what_is_no_curve",
    "has no place for ": "geometry/solid/test_files_and_booleans.py::test_wrong_options_are_refused",
    "a space that is closed but for gaps": "geometry/solid/test_files_and_booleans.py::test_wrong_options_are_refused",
    "surfaces are outside of ": "adaptation/test_surfaces.py::test_what_is_refused_at_the_door",
    "surfaces are curved, but": "adaptation/test_surfaces.py::test_what_is_refused_at_the_door",
    "surfaces reach a periodic side": "adaptation/test_surfaces.py::test_what_is_refused_at_the_door",
    "has one side only": "adaptation/test_surfaces.py::test_what_is_refused_at_the_door",
    "surfaces are on the walls": "adaptation/test_surfaces.py::test_surfaces_without_room_are_refused_with_the_place",
    "an edge of a surface inside": "adaptation/test_surfaces.py::test_surfaces_without_room_are_refused_with_the_place",
    "has surfaces inside": "adaptation/test_surfaces.py::test_surfaces_without_room_are_refused_with_the_place",
    "cells meet at a vertex": "tessellation/test_vertices.py::test_walks_around_a_vertex_end",
}
"""Parts of texts of errors without a row, and the tests that raise them."""


LIBRARIES = {"cannot be read as STEP": "gmsh", "holds no solid": "gmsh", "borders on its own periodic image": "fipy"}
"""Parts of texts of errors, and the library that their rows need."""


class Workplace(SimpleNamespace):
    """Files and small meshes for `ROWS`; each call has a folder of its own."""

    def path(self, name):
        return self.folder / name

    def needs(self, *libraries):
        """Return self where the libraries are installed."""
        for name in libraries:
            pytest.importorskip(name)
        return self

    def write(self, name, text=""):
        self.path(name).write_text(text)
        return self.path(name)

    def run(self, *args, **options):
        options = (
            {"max_steps": None if "checkpoint" in options else 0}
            | ({} if len(args) > 2 or "effort" in options else {"effort": "fast"})
            | options
        )
        if options.get("method") not in (None, "adaptive", "exact", "transport"):
            options.pop("effort", None)
        adapter = clvoro.Adapter(self.adapter.ctx, options.pop("dtype", "float64"))
        return adapter.run(*args, **options)

    def voronoi(self, domain, points):
        return self.adapter.diagram(domain, points)

    def reentrant(self, other):
        self.adapter.run(BOX, 0.3, "fast", callback=lambda row: other.diagram(BOX, POINTS) is None)

    def resume(self):
        saved = self.path("saved")
        self.adapter.run(BOX, 0.3, "fast", checkpoint=saved, callback=lambda row: row["step"] == 2)
        return clvoro.Checkpoint(resume=saved)

    def fields(self, points, **values):
        path = self.path("fields.npz")
        np.savez(path, points=points, **(values or {"u": points[:, 0] ** 2}))
        return path

    def case(self, text):
        return Case.from_toml(text, "a.toml").size_field()

    def job(self, text, out=None, **options):
        options = {"report": False, "quiet": True} | options
        Job(Case.from_toml(text, "a"), out or self.path("out"), **options).run()

    def check(self, name, solver=None, walls=None):
        for path in ("a.npz", "a.foam"):
            self.mesh.save(self.path(path))
        command._verdict(str(self.path(name)), SimpleNamespace(solver=solver, walls=walls))

    # What a row cannot have: small devices, full disks, missing libraries.

    def limited(self, name, value):
        """Replace a limit of the package; what a device or a library returns is a limit, too."""
        self.patch.setattr(f"clvoro.{name}", value)
        return self

    def device(self, **verdicts):
        for name, verdict in verdicts.items():
            self.limited(f"opencl.devices.{name}", lambda *_, verdict=verdict: verdict)
        return self.adapter.ctx

    def small_arrays(self, most):
        """Let a device refuse an array that the estimate allows."""
        self.limited("adaptation.estimates.LARGEST", 0)
        return self.limited("opencl.memory_limits.largest_allocation", lambda device: most)

    def full_device(self, most):
        """Let a device have no memory for an array of more than `most` numbers."""
        make = clvoro.opencl.engine.make_array

        def make_array(queue, shape, dtype):
            if np.prod(shape) > most:
                raise cl.MemoryError("allocation failed", cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE, "create_buffer")
            return make(queue, shape, dtype)

        return self.limited("opencl.engine.make_array", make_array)

    def few_faces(self):
        return self.limited("tessellation.cells.LARGEST_ROW", 16).limited("tessellation.cells.LARGEST_ELSEWHERE", 16)

    def broken(self, function):
        def fails(*args):
            raise ValueError("broken")

        self.patch.setattr(function, fails)
        return self

    def opened(self):
        """Let the boundary of a case lack an edge."""
        make = polygon_of_edges
        return self.limited("foam.mesh.polygon_of_edges", lambda p, ends, names: make(p, ends[1:], names[1:]))

    def full_disk(self, name):
        make, full = clvoro.io.atomic._create, self.path(name)
        full.mkdir(exist_ok=True)

        def create(path):
            if path.parent == full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return make(path)

        return self.limited("io.atomic._create", create)

    def without(self, *names):
        """Let `import` not find a library, and import again a package that needs it."""
        for name in names[1:]:  # the whole one is back afterwards
            importlib.import_module(name)
        for name in list(sys.modules):
            if any(name == given or name.startswith(f"{given}.") for given in names):
                self.patch.delitem(sys.modules, name)
        self.patch.setitem(sys.modules, names[0], None)
        return self

    # Other inputs.

    def profiled(self):
        with profile.Profile(self.adapter) as taken:
            self.voronoi(BOX, POINTS)
        return taken

    def saved(self):
        self.holed.save(self.path("a.npz"))
        return self.path("a.npz")

    def renumbered(self):
        """Write a mesh in a polygon as an earlier version did."""
        with np.load(self.saved()) as held:
            arrays = dict(held)
        about = json.loads(str(arrays["about"]))
        about["domain"]["edge_numbers"] = [0]
        np.savez(self.path("a.npz"), **arrays | {"about": np.array(json.dumps(about))})
        return self.path("a.npz")

    def changed(self, **arrays):
        """Return the mesh with other arrays, of which one contradicts the others."""
        names = ("points", "volumes", "neighbor_starts", "neighbors", "face_measures", "face_centroids", "vertices")
        more = ("centroids", "cell_vertex_starts", "cell_vertices", "face_vertex_starts", "face_vertices")
        return clvoro.Diagram(BOX, {name: getattr(self.mesh, name) for name in names + more} | arrays)

    def contradicting(self):
        neighbors = self.mesh.neighbors.copy()
        neighbors[0] = (neighbors[0] + 1) % 30
        return self.changed(neighbors=neighbors)

    def cad(self, what, *numbers):
        """Write a STEP file of one shape."""
        import gmsh

        gmsh.initialize(interruptible=False)
        gmsh.option.setNumber("General.Terminal", 0)
        getattr(gmsh.model.occ, what)(*numbers)
        gmsh.model.occ.synchronize()
        gmsh.write(str(self.path("a.step")))
        gmsh.finalize()
        return self.path("a.step")

    def carry(self, mesh, columns=1):
        mesh.transfer(np.ones((len(mesh), columns)), onto=self.torus)

    def corners(self, n):
        return self.voronoi(CUBE, np.random.default_rng(1).random((n, 3))).face_vertices

    def jittered(self, dtype):
        lattice = (np.stack(np.meshgrid(*[np.arange(3)] * 3), axis=-1).reshape(-1, 3) + 0.5) / 3
        points = lattice + 5.7e-6 * np.random.default_rng(2).standard_normal(lattice.shape)
        return clvoro.Adapter(self.adapter.ctx, dtype).diagram(clvoro.Box((0,) * 3, (1,) * 3, periodic=True), points)

    def resume_with(self, name, value):
        checkpoint = self.resume()
        self.limited(f"adaptation.checkpoint.{name}", value).run(BOX, 0.3, checkpoint=checkpoint)

    def foam_case(self):
        """Return a case of OpenFOAM with U at the time 5 on the mesh of 30 cells."""
        case, rows = self.path("case"), "\n".join(f"({x * y:.6f} {x:.6f} 0)" for x, y in POINTS)
        for name in ("constant", "system", "5"):
            (case / name).mkdir(parents=True)
        (case / "system/controlDict").write_text("startTime 0;\nendTime 5;\n")
        self.mesh.to_openfoam(case / "constant/polyMesh")
        self.mesh.save(case / "constant/polyMesh/clvoro.npz")
        (case / "5/U").write_text(
            "FoamFile { version 2.0; format ascii; class volVectorField; object U; }\ndimensions [0 1 -1 0 0 0 0];\n"
            f"internalField nonuniform List<vector> 30\n(\n{rows}\n);\n"
            'boundaryField { ".*" { type fixedValue; value uniform (0 0 0); } }\n'
        )
        return case

    def follow(self, change=lambda case: None, **options):
        """Adapt the case to its solution, after `change(case)`."""
        case = self.foam_case()
        change(case)
        foam.adapt_case(case, **{"n_cells": 30, "effort": "fast", "pictures": False} | options)

    def held(self):
        with FoamCase(self.path("case") if self.path("case").exists() else self.foam_case()).held():
            foam.adapt_case(self.path("case"), n_cells=30)


Workplace.run.__signature__ = inspect.signature(clvoro.Adapter.run)


@pytest.fixture(scope="module")
def meshes(ctx, tmp_path_factory):
    adapter, folder = clvoro.Adapter(ctx), tmp_path_factory.mktemp("files")
    lake, grid = folder / "lake.geojson", folder / "grid.npy"
    lake.write_text(json.dumps(LAKE))
    np.save(grid, np.full((3, 3), 0.3))
    np.savez(folder / "lonlat.npz", lon=LON, lat=LAT, h=np.full((5, 9), 0.7))
    solid = np.random.default_rng(1).random((20, 3))
    mesh, globe = adapter.diagram(BOX, POINTS), adapter.diagram(GLOBE, GLOBE.icosahedral_points(1))
    small = clvoro.Polygon(SQUARE, [[(0.45, 0.45), (0.55, 0.45), (0.55, 0.55)]])
    apart = np.where(np.arange(30) < 1, -5.0, 0)
    stl = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners)
        + "endloop\nendfacet\n"
        for corners in CORNERS[TRIANGLES]
    )
    (folder / "a.stl").write_text(f"solid a\n{stl}endsolid a\n")
    (folder / "damaged.nc").write_bytes(b"\x89HDF\r\n\x1a\n, and then nothing")
    with scipy.io.netcdf_file(folder / "classic.nc", "w") as file:
        for name, values in (("lat", LAT), ("lon", LON)):
            file.createDimension(name, len(values))
            file.createVariable(name, "d", (name,))[:] = values
        file.createVariable("h", "d", ("lat", "lon"))[:] = 0.7
    return {
        "stl": folder / "a.stl",
        "hdf": folder / "damaged.nc",
        "classic": folder / "classic.nc",
        "ball": clvoro.Solid.ball((0, 0, 0), 1),
        "adapter": adapter,
        "lake": lake,
        "grid": grid,
        "lonlat": folder / "lonlat.npz",
        "mesh": mesh,
        "part": mesh.subset(POINTS[:, 0] > 0.3),
        "torus": adapter.diagram(TORUS, POINTS),
        "wide_torus": adapter.diagram(clvoro.Box((0, 0), (2, 1), periodic=True), POINTS),
        "wheel": adapter.diagram(WIDE[2], [(0, 0), *RING]),
        "single": adapter.diagram(TORUS, POINTS[:1]),
        "cube": adapter.diagram(CUBE, solid),
        "globe": globe,
        "large_globe": adapter.diagram(clvoro.Sphere(2), 2 * globe.points),
        "holed": adapter.diagram(clvoro.Polygon(SQUARE, [HOLE]), POINTS[~clvoro.Polygon(HOLE).covers(POINTS)]),
        "around": adapter.diagram(small, [(0.3, 0.5), (0.05, 0.5), (0.95, 0.5)]),
        "power": adapter.power_diagram(BOX, POINTS, 0.001 * np.arange(30)),
        "empty": adapter.power_diagram(BOX, POINTS, apart),
        "result": adapter.run(BOX, 0.2, points=POINTS, method="lloyd", max_steps=0),
        "cube_result": adapter.run(CUBE, 0.4, points=solid, method="lloyd", max_steps=0),
        "pieces": clvoro.Polygon.from_pieces([[SQUARE], [[(2, 0), (2.5, 0), (2.5, 0.5), (2, 0.5)]]]),
    }


def raised_at(error):
    """Return where in the package `error` and the errors that it follows were raised: file and line."""
    places = set()
    while error is not None:
        frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename.startswith(str(PACKAGE))]
        places |= {(str(Path(f.filename).relative_to(PACKAGE)), f.lineno) for f in frames}
        error = error.__cause__ or error.__context__
    return places


SEEN = {}
"""Where the wrong call of a row raises."""


def refused(row, meshes, folder):
    """Return the error that the wrong call of a row gives."""
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch, pytest.raises(ClvoroError) as caught:
        ROWS[row][0](Workplace(folder=folder, patch=patch, **meshes))
    SEEN[row] = raised_at(caught.value)
    return caught.value


@pytest.mark.parametrize("row", range(len(ROWS)))
def test_what_an_error_says_to_do_works(meshes, tmp_path, row):
    error = refused(row, meshes, tmp_path / "wrong")
    print(error)
    (tmp_path / "right").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        ROWS[row][1](Workplace(folder=tmp_path / "right", patch=patch, **meshes))
    words = {word.rstrip("s") for word in re.findall(r"[a-z_]\w*", str(error).lower())}
    names = changed_names(row, meshes, tmp_path)
    assert words & {name.rstrip("s") for name in names}, f"the error names none of {names}, which the remedy changes"


@cache
def source_of_rows():
    tree = ast.parse(Path(__file__).read_text())
    return next(n.value.elts for n in tree.body if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "ROWS")


def arguments_of(call, place):
    """Yield the names and values of the arguments of a call."""
    yield from ((word.arg, word.value) for word in call.keywords if word.arg)
    yield ast.unparse(call.func), call
    try:
        names = list(inspect.signature(eval(ast.unparse(call.func), globals(), {"t": place})).parameters)
    except (AttributeError, NameError, TypeError, ValueError):
        return
    yield from zip(names, call.args, strict=False)


def changed_names(row, meshes, folder):
    """Return the names that differ between the calls of a row, and those of the arguments that do."""
    wrong, right, *named = source_of_rows()[row].elts
    if named:
        return {named[0].value.lower()}
    place, found = Workplace(folder=folder, patch=MagicMock(), **meshes), []
    for nodes in (list(ast.walk(wrong.body)), list(ast.walk(right.body))):
        texts = {n.id for n in nodes if isinstance(n, ast.Name)} | {
            n.attr for n in nodes if isinstance(n, ast.Attribute)
        }
        texts |= {str(n.value) for n in nodes if isinstance(n, ast.Constant)}
        values = [pair for n in nodes if isinstance(n, ast.Call) for pair in arguments_of(n, place)]
        found.append({(text, "") for text in texts} | {(name, ast.dump(value)) for name, value in values})
    return {word for text, _ in found[0] ^ found[1] for word in re.findall(r"[a-z_]\w*", text.lower())}


REMEDY = re.compile("; |[.:?] (if so, )?(call|make|pass|perturb|repair|use|write) ", re.IGNORECASE)


def text_of(node):
    """Return the text of a message that is written in the source, without what is filled in."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(v) for v in node.values)
    if isinstance(node, ast.BinOp):
        return text_of(node.left) + text_of(node.right)
    return "; " if isinstance(node, ast.FormattedValue) and ast.unparse(node.value) == "remedy" else ""


@cache
def errors_with_remedies():
    """Return file, first and last line, and text of each error that says what to do."""
    names = {n for n, kind in vars(clvoro.errors).items() if isinstance(kind, type) and issubclass(kind, ClvoroError)}
    return [
        (str(path.relative_to(PACKAGE)), node.lineno, node.end_lineno, text)
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args
        if ast.unparse(node.exc.func) in names and REMEDY.search(text := text_of(node.exc.args[0]))
    ]


def test_every_error_that_says_what_to_do_has_a_row(meshes, tmp_path):
    for row in set(range(len(ROWS))) - SEEN.keys():  # those that another process tests
        with suppress(pytest.skip.Exception):
            refused(row, meshes, tmp_path / str(row))
    seen = set().union(*SEEN.values())
    missing = [
        f"{path}:{first} {text}"
        for path, first, last, text in errors_with_remedies()
        if not any(part in text for part in TESTED_IN)
        and not any(part in text and not find_spec(library) for part, library in LIBRARIES.items())
        and not any((path, line) in seen for line in range(first, last + 1))
    ]
    assert not missing, "\n".join(["add rows for these errors to ROWS, or name their tests in TESTED_IN", *missing])


def test_errors_without_a_row_have_a_test():
    texts = [text for *_, text in errors_with_remedies()]
    for part, test in TESTED_IN.items():
        path, name = test.split("::")
        assert f"def {name}(" in (Path(__file__).parent / path).read_text()
        assert any(part in text for text in texts)
