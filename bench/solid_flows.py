"""Solutions of OpenFOAM on meshes of solids by clvoro, snappyHexMesh, polyDualMesh (duals of tetrahedra) and Gmsh.

    python bench/solid_flows.py [--flows sphere,bend] [--cells 1000,4000,16000] [--meshers NAMES] [--keep FOLDER]
                                [--device NAME] [--json]

All meshers get the same triangulated surface and a uniform size, scaled to nearly the same number of cells. Rows have
the processor time of the last mesh, what `checkMesh` says of it, the largest distance of vertices of walls from the
surface over the mean size of a cell, the iterations of the solver, and the errors of the solution.

sphere: potential flow around a sphere (`potentialFoam`), with the velocity of the formula on the sides of a box. Errors
are root mean squares of the velocity in cells over that of the stream: of all cells, of those at the sphere, and of
these by the fluxes of the formula, which is the error of the velocity's reconstruction alone.

bend: laminar flow through a bent pipe at Re 40 (`simpleFoam`), a parabola at the inlet. Errors are those of the
velocity at 5,000 points and of the loss of pressure, by `linear` and by `skewCorrected linear` interpolation, against
--reference hexahedra that Gmsh sweeps along the pipe.

bracket, flange: conduction of heat (`laplacianFoam`) with the temperatures of a formula on the walls, in a part of
`_solid_shapes.py`, and in one of OpenFOAM's tutorials. Errors are root mean squares of the temperature over its
standard deviation, and of its gradient over its root mean square.

motorBike: laminar flow around a wrap of the tutorials' motorcycle at Re 40 (`simpleFoam`); cells at it are a quarter as
wide as those far away. The figure is a coefficient of drag.

Gmsh, trimesh and shapely (pip install gmsh trimesh shapely) and Debian's package openfoam are needed.
"""

from __future__ import annotations

import math
import re
import resource
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import shapely
from _common import Report, counts, heading, make_adapter, names, parser, random_points, shown
from _openfoam import Case, Mesh, nonuniform, require, text_of
from _remeshers import gmsh_with
from _solid_shapes import SHAPES, solid_of
from bodies import FLOWS as BODIES
from bodies import write_case
from solids import growing
from solver_ready import figures_of
from trimesh import creation

import clvoro
from clvoro.errors import ClvoroError
from clvoro.io.check_mesh import check_case

RADIUS, SIDE = 0.5, 1.0
BEND, STRAIGHT, REYNOLDS = 1.5, 1.0, 40
"""Radius of the pipe's axis in the bend, and length of the straight parts, for a pipe of `RADIUS`."""
ROUNDS = 4
"""Most meshes that are made to meet a number of cells."""
TUTORIALS = Path("/usr/share/doc/openfoam-examples/examples/resources/geometry")


# Solids.


def around_sphere() -> clvoro.Solid:
    """Return a box around a sphere; patches are far and body."""
    ball = clvoro.Solid.ball((0, 0, 0), RADIUS, edge=0.05 * RADIUS, name="body")
    box = clvoro.Box((-SIDE,) * 3, (SIDE,) * 3, names={"far": range(6)})
    return clvoro.Solid.outside(ball, box)


def bent_pipe() -> clvoro.Solid:
    """Return a pipe that turns by 90 degrees; patches are wall, inlet and outlet."""
    angle = np.linspace(0, math.pi / 2, 40)
    path = BEND * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle])
    steps = np.arange(17)[:, None] / 17
    path = np.concatenate([(steps - 1) * (STRAIGHT, 0, 0), path, path[-1] + (1 - steps[::-1]) * (0, STRAIGHT, 0)])
    part = creation.sweep_polygon(shapely.Point(0, 0).buffer(RADIUS, quad_segs=18), path)
    x, y, _ = part.triangles_center.T
    groups = np.select([x < -STRAIGHT + 1e-9, y > BEND + STRAIGHT - 1e-9], [1, 2], 0)
    return clvoro.Solid(part.vertices, part.faces, groups=groups, group_names=["wall", "inlet", "outlet"])


def flange() -> clvoro.Solid:
    """Return a flange of OpenFOAM's tutorials."""
    return clvoro.Solid.read(TUTORIALS / "flange.stl.gz", repair=True)


def around_bike() -> clvoro.Solid:
    """Return the air around a wrap of a motorcycle of OpenFOAM's tutorials."""
    bike = clvoro.Solid.read(TUTORIALS / "motorBike.obj.gz", wrap=0.08, names={"body": "wall"})
    sides = {"inlet": 0, "outlet": 1, "sides": [2, 3, 4, 5]}
    return clvoro.Solid.outside(bike, clvoro.Box((-3, -2, 0), (6, 2, 4), names=sides))


# Meshers.


Mesher = Callable[[Case, clvoro.Adapter, clvoro.Solid, float, bool], int]
"""Writes the polyMesh of a case with cells of a size, at a body half as wide or not; returns how many there are."""


def mesh_clvoro(layer: float) -> Mesher:
    """Return a mesher of cells of clvoro, with a layer of prisms on the body or wall that is so thick in units of h."""

    def mesh(case: Case, adapter: clvoro.Adapter, solid: clvoro.Solid, h: float, graded: bool) -> int:
        walls = [name for name in solid.boundary_names if name in ("body", "wall")]
        layers = clvoro.Layers(layer * h, edges=walls) if layer else ()
        made = adapter.run(solid, growing(solid, walls, h) if graded else h, layers=layers)
        made.to_openfoam(case.folder / "constant" / "polyMesh")
        return len(made.points)

    return mesh


def mesh_gmsh(dual: bool) -> Mesher:
    """Return a mesher of tetrahedra, or of their duals."""

    def mesh(case: Case, _: clvoro.Adapter, solid: clvoro.Solid, h: float, __: bool) -> int:
        nodes, cells = _tetrahedra(case.folder / "mesh.msh", solid, (1.12 if dual else 2.04) * h)
        case.run("gmshToFoam", "mesh.msh")
        if dual:
            case.run("polyDualMesh", "30", "-overwrite", "-concaveMultiCells")
        return nodes if dual else cells

    return mesh


def mesh_snappy(case: Case, _: clvoro.Adapter, solid: clvoro.Solid, h: float, graded: bool) -> int:
    """Make cells by snappyHexMesh, with the tutorial's settings for a flange; a box around a body is that of blocks."""
    corners, known = solid.surface.corners, np.array(solid.boundary_names)[solid.boundary_index[solid.patch]]
    lower, upper = (np.array(side) for side in (solid.lower, solid.upper))
    width, level = (2 * h, 2) if graded else (h, 0)
    if not (around := "body" in known):  # cubes
        lower -= 1.3 * h
        upper = lower + h * np.ceil((upper + 1.3 * h - lower) / h)
    sides: dict[str, str] = {}
    for k, face in enumerate(("0 4 7 3", "1 2 6 5", "0 1 5 4", "3 7 6 2", "0 3 2 1", "4 5 6 7")):
        off = np.abs(corners[:, :, k // 2] - (lower, upper)[k % 2][k // 2]).max(axis=1)
        name = str(known[off.argmin()]) if around else "blocks"
        sides[name] = sides.get(name, "") + f"({face}) "
    divided = " ".join(f"{max(1, round(x / width))}" for x in upper - lower)
    (a, b, c), (d, e, f) = lower.tolist(), upper.tolist()
    ring = ((a, b), (d, b), (d, e), (a, e))
    blocks = {
        "vertices": f"({' '.join(f'({x!r} {y!r} {z!r})' for z in (c, f) for x, y in ring)})",
        "blocks": f"(hex (0 1 2 3 4 5 6 7) ({divided}) simpleGrading (1 1 1))",
        "boundary": f"({''.join(text_of({n: {'type': 'patch', 'faces': f'({s})'}}) for n, s in sides.items())})",
    }
    walls = sorted(set(known.tolist()) - set(sides))
    (folder := case.folder / "constant" / "triSurface").mkdir(parents=True, exist_ok=True)
    for name, part in (*((name, known == name) for name in walls), ("all", np.isin(known, walls))):
        _write_stl(folder / f"{name}.stl", corners[part])
    some = random_points(solid, 500)
    inside = some[solid.boundary_distance(some).argmax()]
    controls = {
        **{"maxLocalCells": 10**7, "maxGlobalCells": 10**7, "minRefinementCells": 0, "resolveFeatureAngle": 30},
        **{"nCellsBetweenLevels": 3, "allowFreeStandingZoneFaces": "true", "refinementRegions": {}},
        "features": f'({{ file "all.eMesh"; level {level}; }})',
        "refinementSurfaces": {name: {"level": f"({level} {level})"} for name in walls},
        "locationInMesh": f"({' '.join(map(repr, inside.tolist()))})",
    }
    edges = {"extractionMethod": "extractFromSurface", "includedAngle": 150}
    files = {
        f'#include "{TUTORIALS.parents[1]}/mesh/snappyHexMesh/flange/system/snappyHexMeshDict"\n'
        "#remove (geometry castellatedMeshControls)\n//": "",
        "geometry": {f"{name}.stl": {"type": "triSurfaceMesh", "name": name} for name in walls},
        "castellatedMeshControls": controls,
    }
    case.write("system/blockMeshDict", blocks)
    case.write("system/surfaceFeatureExtractDict", {"all.stl": edges})
    case.write("system/snappyHexMeshDict", files)
    for program in ("blockMesh", "surfaceFeatureExtract", "snappyHexMesh -overwrite"):
        case.run(*program.split())
    return len(Mesh.of(case.folder))


def _write_stl(path: Path, corners: np.ndarray) -> None:
    """Write triangles (t, 3, 3)."""
    vertices = ("".join(f"vertex {x!r} {y!r} {z!r}\n" for x, y, z in three) for three in corners.tolist())
    facets = (f"facet normal 0 0 0\nouter loop\n{three}endloop\nendfacet\n" for three in vertices)
    path.write_text(f"solid a\n{''.join(facets)}endsolid a\n")


def _tetrahedra(path: Path, solid: clvoro.Solid, edge: float) -> tuple[int, int]:
    """Write tetrahedra with edges of this length; return how many nodes and cells they have."""
    surface, names_of = solid.surface, np.array(solid.boundary_names)[solid.boundary_index][solid.patch]
    stl = path.with_suffix(".stl")
    _write_stl(stl, surface.corners)
    with gmsh_with(MeshSizeMin=edge, MeshSizeMax=edge, MshFileVersion=2.2) as gmsh:
        gmsh.merge(str(stl))
        gmsh.model.mesh.classifySurfaces(math.radians(30), True, True, math.pi)
        gmsh.model.mesh.createGeometry()
        tags: dict[str, list[int]] = {}
        tree = scipy.spatial.KDTree(surface.corners.mean(axis=1))
        for _, tag in gmsh.model.getEntities(2):
            _, _, nodes = gmsh.model.mesh.getElements(2, tag)
            first = np.mean([gmsh.model.mesh.getNode(int(node))[0] for node in nodes[0][:3]], axis=0)
            tags.setdefault(str(names_of[tree.query(first)[1]]), []).append(tag)
        shells = [tags["far"], tags["body"]] if "far" in tags else [[tag for found in tags.values() for tag in found]]
        loops = [gmsh.model.geo.addSurfaceLoop(shell) for shell in shells]
        volume = gmsh.model.geo.addVolume(loops)
        gmsh.model.geo.synchronize()
        for name, found in tags.items():
            gmsh.model.addPhysicalGroup(2, found, name=name)
        gmsh.model.addPhysicalGroup(3, [volume], name="cells")
        gmsh.model.mesh.generate(3)
        gmsh.write(str(path))
        return len(gmsh.model.mesh.getNodes()[0]), len(gmsh.model.mesh.getElements(3)[1][0])


def mesh_swept(case: Case, _: clvoro.Adapter, solid: clvoro.Solid, edge: float, __: bool) -> int:
    """Sweep quadrangles along the axis of the bent pipe."""
    turn = math.pi / 2
    sides = round(2 * math.pi * RADIUS / edge)
    # Polygons of all meshes have the area of the pipe's section.
    radius = math.sqrt(2 * solid.measure / (2 * STRAIGHT + turn * BEND) / sides / math.sin(2 * math.pi / sides))
    with gmsh_with(MeshSizeMin=edge, MeshSizeMax=edge, MshFileVersion=2.2) as gmsh:
        occ = gmsh.model.occ
        inlet = end = (2, occ.addDisk(-STRAIGHT, 0, 0, radius, radius, zAxis=[1, 0, 0]))
        walls, volumes = [], []
        for length, way in (STRAIGHT, (STRAIGHT, 0, 0)), (turn * BEND, None), (STRAIGHT, (0, STRAIGHT, 0)):
            steps = {"numElements": [round(length / edge)], "recombine": True}
            if way:
                made = occ.extrude([end], *way, **steps)
            else:
                made = occ.revolve([end], 0, BEND, 0, 0, 0, 1, turn, **steps)
            end = made[0]
            volumes.append(made[1][1])
            walls += [tag for _, tag in made[2:]]
        occ.synchronize()
        for _, curve in gmsh.model.getBoundary([inlet], oriented=False):
            gmsh.model.mesh.setTransfiniteCurve(curve, sides + 1)
        gmsh.model.mesh.setRecombine(*inlet)
        for name, found in {"wall": walls, "inlet": [inlet[1]], "outlet": [end[1]]}.items():
            gmsh.model.addPhysicalGroup(2, found, name=name)
        gmsh.model.addPhysicalGroup(3, volumes, name="cells")
        gmsh.model.mesh.generate(3)
        gmsh.write(str(case.folder / "mesh.msh"))
    case.run("gmshToFoam", "mesh.msh")
    return len(Mesh.of(case.folder))


MESHERS: dict[str, Mesher] = {
    "clvoro": mesh_clvoro(0),
    "clvoro-layer": mesh_clvoro(0.5),
    "snappyHexMesh": mesh_snappy,
    "polyDualMesh": mesh_gmsh(True),
    "tetrahedra": mesh_gmsh(False),
    "swept": mesh_swept,
}


# Flows: each returns errors.


def around(points: np.ndarray) -> np.ndarray:
    """Return the velocity of the potential flow around the sphere at `points` (n, 3)."""
    r = np.linalg.norm(points, axis=1)[:, None]
    stream, cube = np.array([1.0, 0, 0]), RADIUS**3 / (2 * np.maximum(r, RADIUS / 2) ** 3)
    return (1 + cube) * stream - 3 * cube * points[:, :1] * points / r**2


def flow_around_sphere(case: Case, mesh: Mesh, _: Any) -> dict[str, float]:
    """Solve for the potential; return errors of the velocity."""
    far, closed, (centers, areas) = mesh.patch("far"), {"type": "zeroGradient"}, mesh.faces
    u, area = around(centers[far]), areas[far]
    # As much flows out as in.
    u -= (u * area).sum() / np.linalg.norm(area, axis=1).sum() * area / np.linalg.norm(area, axis=1)[:, None]
    still = {"type": "fixedValue", "value": "uniform (0 0 0)"}
    given = {"type": "fixedValue", "value": nonuniform(u)}
    # The pressure is not used: it keeps potentialFoam from changing fluxes that are given.
    free = {"type": "fixedValue", "value": "uniform 0"}
    case.write_start({"far": given, "body": still}, {"far": free, "body": closed})
    sides = {"far": closed, "body": closed}
    entries = {"dimensions": "[0 2 -1 0 0 0 0]", "internalField": "uniform 0", "boundaryField": sides}
    case.write("0/Phi", entries, "volScalarField")
    case.run("potentialFoam", "-writephi")
    flux, inner = np.zeros(len(areas)), len(mesh.neighbor)
    flux[:inner], flux[far] = case.field("phi", inner)[:, 0], (u * area).sum(axis=1)
    exact = (around(centers) * areas).sum(axis=1)
    exact[mesh.patch("body")] = 0
    at_wall = np.unique(mesh.owner[mesh.patch("body")])

    def mean(flux: np.ndarray, part: Any) -> float:
        off = np.linalg.norm(mesh.velocity(flux) - around(mesh.centroids), axis=1)[part] ** 2
        return float(np.sqrt((mesh.volumes[part] * off).sum() / mesh.volumes[part].sum()))

    return {"error": mean(flux, slice(None)), "at wall": mean(flux, at_wall), "by exact fluxes": mean(exact, at_wall)}


def flow_through_bend(case: Case, mesh: Mesh, reference: dict[str, Any]) -> dict[str, float]:
    """Solve; return errors of the velocity and of the loss of pressure, or fill `reference` if it is empty."""
    inlet, (centers, areas) = mesh.patch("inlet"), mesh.faces
    y, z = centers[inlet, 1], centers[inlet, 2]
    u = np.zeros((len(inlet), 3))
    u[:, 0] = 2 * (1 - (y**2 + z**2) / RADIUS**2)
    area = np.linalg.norm(areas, axis=1)
    u *= math.pi * RADIUS**2 / (u[:, 0] * area[inlet]).sum()  # the same flux on all meshes
    closed = {"type": "zeroGradient"}
    case.write_start(
        {"inlet": {"type": "fixedValue", "value": nonuniform(u)}, "outlet": closed, "wall": {"type": "noSlip"}},
        {"inlet": closed, "outlet": {"type": "fixedValue", "value": "uniform 0"}, "wall": closed},
    )
    errors = {}
    for name, interpolation in {"": "linear", "corrected ": "skewCorrected linear"}.items():
        if name and not reference:
            break
        write_system(case, interpolation)
        try:
            case.run("simpleFoam")
        except ClvoroError:
            continue
        p, u = case.field("p", len(mesh))[:, 0], case.field("U", len(mesh))
        for time in case.folder.glob("[1-9]*"):
            shutil.rmtree(time)
        # The pressure at the inlet by a fit: cells of all meshers have their centers at other distances from it.
        near = mesh.centroids[:, 0] < RADIUS - STRAIGHT
        x = mesh.centroids[near] + [STRAIGHT, 0, 0]
        terms = np.column_stack([np.ones(len(x)), x, x[:, 0] ** 2])
        loss = float(np.linalg.lstsq(terms, p[near])[0][0])
        if not reference:
            field = scipy.interpolate.RBFInterpolator(mesh.centroids, u, 60, kernel="cubic", degree=1)
            reference.update(loss=loss, velocity=field)
            break
        some = np.random.default_rng(1).permutation(len(u))[:5000]
        off = np.linalg.norm(reference["velocity"](mesh.centroids[some]) - u[some], axis=1) ** 2
        volumes = mesh.volumes[some]
        errors[f"{name}error"] = float(np.sqrt((volumes * off).sum() / volumes.sum()))
        errors[f"{name}at wall"] = abs(loss / reference["loss"] - 1)
    return errors


def conduct(case: Case, mesh: Mesh, _: Any) -> dict[str, float]:
    """Solve for a temperature that is known; return errors."""
    centers, scale = mesh.faces[0], 4 / np.ptp(mesh.centroids, axis=0).max()

    def exact(points: np.ndarray) -> np.ndarray:
        """Return the temperature and its gradient, (n, 4)."""
        x, y, z = scale * points.T
        wave, other = np.exp(x) * np.cos(y), np.exp(x) * np.sin(y)
        return np.column_stack([wave + z * y, scale * wave, scale * (z - other), scale * y])

    walls = {p.name: {"type": "fixedValue", "value": nonuniform(exact(centers[p.faces])[:, 0])} for p in mesh.patches}
    start = {"dimensions": "[0 0 0 1 0 0 0]", "internalField": "uniform 0", "boundaryField": walls}
    case.write("0/T", start, "volScalarField")
    case.run("laplacianFoam")
    case.run("postProcess", "-func", "grad(T)", "-latestTime")
    found = np.column_stack([case.field(name, len(mesh)) for name in ("T", "grad(T)")])
    right = exact(mesh.centroids)
    off, volumes = found - right, mesh.volumes / mesh.volumes.sum()
    slope = [math.sqrt(volumes @ (v[:, 1:] ** 2).sum(axis=1)) for v in (off, right)]
    return {"error": math.sqrt(volumes @ off[:, 0] ** 2) / float(right[:, 0].std()), "at wall": slope[0] / slope[1]}


def flow_around_bike(case: Case, mesh: Mesh, _: Any) -> dict[str, float]:
    """Solve; return the coefficient of drag."""
    write_case(case, replace(BODIES["sphere"], viscosity=2 / REYNOLDS))
    case.run("simpleFoam")
    return {"error": float(case.table("forces", "coefficient.dat")["Cd"][-1])}


def write_system(case: Case, interpolation: str = "linear") -> None:
    """Write the dictionaries that all programs read."""
    exact = {"solver": "GAMG", "smoother": "GaussSeidel", "tolerance": 1e-11, "relTol": 1e-3}
    solvers = {
        "Phi": {**exact, "relTol": 0},
        **{name: {**exact, "relTol": 0.05} for name in "pT"},
        "U": {"solver": "PBiCGStab", "preconditioner": "DILU", "tolerance": 1e-11, "relTol": 0.05},
    }
    solution = {
        "solvers": solvers,
        "potentialFlow": {"nNonOrthogonalCorrectors": 20, "PhiRefCell": 0, "PhiRefValue": 0},
        "SIMPLE": {
            "consistent": "yes",
            "nNonOrthogonalCorrectors": 1,
            "residualControl": {"p": 1e-5, "U": 1e-6, "T": 1e-8},
        },
    }
    case.write_system(
        2 * RADIUS / REYNOLDS,
        f"bounded Gauss {interpolation}",
        {
            "gradSchemes": {"default": "leastSquares", "grad(p)": f"Gauss {interpolation}"},
            "interpolationSchemes": {"default": interpolation},
        },
        solution=solution,
        control={"endTime": 400, "writePrecision": 10},
    )


@dataclass(frozen=True)
class Flow:
    """A solid, and its flow or conduction, perhaps measured against a reference, or on graded cells."""

    solid: Callable[[], clvoro.Solid]
    solve: Callable[..., dict[str, float]]
    has_reference: bool = False
    graded: bool = False


FLOWS = {
    "sphere": Flow(around_sphere, flow_around_sphere),
    "bend": Flow(bent_pipe, flow_through_bend, has_reference=True),
    "bracket": Flow(lambda: solid_of(SHAPES["bracket"][0](), group_names=["wall"]), conduct),
    "flange": Flow(flange, conduct),
    "motorBike": Flow(around_bike, flow_around_bike, graded=True),
}
COLUMNS = {
    "flow": lambda r: r["flow"],
    "mesher": lambda r: r["mesher"],
    "cells": lambda r: r["cells"],
    "mesh, s": lambda r: f"{r['seconds']:.1f}",
    "non-orth. max, mean": lambda r: f"{r['non_orthogonality']:.1f}, {r['mean_non_orthogonality']:.2f}",
    "skewness": lambda r: f"{r['skewness']:.2f}",
    "concave": lambda r: f"{r['concave']:.0f}",
    "off / h": lambda r: f"{r['off']:.3f}",
    "checkMesh": lambda r: "OK" if r["ok"] else r["complaints"],
    "iterations": lambda r: r["iterations"] or "",
    "error": lambda r: figures(r, "error", "at wall"),
    "by exact fluxes": shown("by exact fluxes", ".4f"),
    "corrected": lambda r: figures(r, "corrected error", "corrected at wall"),
}


def figures(row: dict[str, Any], *keys: str) -> str:
    """Return the errors that a row has as text; a dash stands for those of runs that diverge."""
    return ", ".join(f"{row[key]:.4f}" if row[key] < 1 else "-" for key in keys if key in row)


def processor_time() -> float:
    """Return the processor time of this process and of its children."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def measure(case: Case, adapter: clvoro.Adapter, flow: Flow, mesher: str, n: int, reference: Any) -> dict[str, Any]:
    """Make meshes until one has about `n` cells, check it, solve the flow; return a row."""
    write_system(case)
    solid = flow.solid()
    h = (solid.measure / n) ** (1 / 3)
    for _ in range(ROUNDS):
        begin = processor_time()
        made = MESHERS[mesher](case, adapter, solid, h, flow.graded)
        seconds = processor_time() - begin
        if abs(made / n - 1) < 0.03:
            break
        h *= (made / n) ** (1 / 3)
    mesh = Mesh.of(case.folder)
    row = {"cells": len(mesh), "seconds": seconds, **flow.solve(case, mesh, reference)}
    text = "".join(path.read_text() for path in case.folder.glob("log.*Foam"))
    ended = re.search(r"converged in (\d+) iterations", text)
    wall = np.concatenate([p.faces for p in mesh.patches if p.name not in ("far", "inlet", "outlet", "sides")])
    at = np.unique(np.concatenate([mesh.corners[mesh.starts[f] : mesh.starts[f + 1]] for f in wall]))
    off = float(solid.boundary_distance(mesh.points[at]).max()) / (solid.measure / len(mesh)) ** (1 / 3)
    return {**row, "off": off, "iterations": ended and ended[1], **figures_of(check_case(case.folder))}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--flows", default="sphere,bend", metavar="NAMES")
    options_of.add_argument("--cells", default="1000,4000,16000", metavar="NUMBERS")
    options_of.add_argument("--meshers", default=",".join([*MESHERS][:-1]), metavar="NAMES")
    options_of.add_argument("--reference", type=int, default=100_000, metavar="N", help="cells of the reference")
    options_of.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the cases")
    options = options_of.parse_args()
    require("potentialFoam", "simpleFoam", "polyDualMesh", "gmshToFoam", "checkMesh")
    adapter, report = make_adapter(options), Report(options.json, COLUMNS)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        for name in names(options.flows):
            flow, reference = FLOWS[name], {}
            able = ("clvoro", "snappyHexMesh") if flow.graded else MESHERS
            rows = [(m, n) for n in counts(options.cells) for m in names(options.meshers) if m in able]
            if flow.has_reference:
                rows.insert(0, ("swept", options.reference))
            for mesher, n in rows:
                case = Case(folder / f"{name}-{mesher}-{n}")
                case.folder.mkdir(parents=True, exist_ok=True)
                row = {"flow": name, "mesher": mesher, **measure(case, adapter, flow, mesher, n, reference)}
                report.add(row, f"{name}, {mesher}, {n}: {COLUMNS['error'](row)}")
    report.finish(heading(adapter, "flows on meshes of solids"))


if __name__ == "__main__":
    main()
