"""Flow around a cylinder with OpenFOAM on meshes of clvoro, Gmsh and blockMesh, against reference values.

    python bench/cylinder.py [--reynolds 20|100] [--cells 3000,6000,13000] [--meshers NAMES] [--samples 3]
                             [--convection linear|linearUpwind] [--cycles 3] [--pictures FOLDER] [--device NAME]
                             [--json]

The benchmark of Schaefer and Turek (1996): a channel of 2.2 x 0.41, a cylinder of diameter 0.1 at (0.2, 0.2), a
parabolic inlet. At Re 20 the flow is steady (`simpleFoam`), at Re 100 it sheds vortices (`pimpleFoam`). All meshes
have the same size field, scaled to nearly the same number of cells; blocks follow it as far as they can. All solvers
have the same schemes. At Re 20 columns are errors in percent: of drag and lift by the function object `forceCoeffs`,
and of the pressure difference between the front and the rear of the cylinder, for which a quadratic polynomial is
fitted to the 48 nearest cells. At Re 100 they are the largest drag and lift of the last three periods, and the
Strouhal number. Fluxes are projected onto each new mesh: "divergence" is the largest sum over the faces of a cell
afterwards, over the largest flux.

Lift is small, and random errors of the cells above and below the cylinder do not cancel. "Mirrored" is a mesh of the
channel below the axis of the cylinder, with the mirror images of its generators above it.

"Uniform" is a mesh of one size. "Newcomer" is a polygon of 360 edges with sizes that grow from it, and no layers.
"Followed" begins as that mesh, with as many cells as the row says, and follows the solution: `clvoro.foam.adapt_case`
makes a new mesh --cycles times from U. No place is named. With "forces" the goal are the forces on the cylinder, by the
distance from it (`FieldSizes(forces="cylinder")`); with "adjoints" drag and lift, by their adjoint velocities, which
`adjointOptimisationFoam` solves for. At Re 100 the flow is solved on 2,000 cells first, and followed in ten periods of
shedding.

With --samples several meshes are made for each row, with counts that differ by one percent and with other seeds:
shown are the median, the range, and of five or more the standard error of the median. Without OpenFOAM the script
ends with a message. Without Gmsh (pip install gmsh) its rows are left out.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from _common import Report, counts, heading, make_adapter, parser, spread
from _openfoam import Case, Mesh, forces_on, header, nonuniform, require, text_of, write_prisms
from _remeshers import MissingPeerError, gmsh_with

import clvoro
from clvoro.foam.case import FoamCase

LENGTH, HEIGHT = 2.2, 0.41
CENTER, RADIUS = (0.2, 0.2), 0.05
THICKNESS = 0.01
VISCOSITY = 0.001
PATCHES = {"walls": "wall", "outlet": "patch", "inlet": "patch", "cylinder": "wall"}
REFERENCE = {"drag": 5.57953523384, "lift": 0.010618948146, "pressure": 0.11752016697}
"""Coefficients and pressure difference at Re 20, of the site of FeatFlow (DFG benchmark 2D-1)."""
RANGES = {"drag": (3.22, 3.24), "lift": (0.99, 1.01), "strouhal": (0.295, 0.305)}
"""Largest coefficients and Strouhal number at Re 100, of Schaefer and Turek."""
COARSE = 2000
"""Cells of the first mesh at Re 100, if it is followed."""
Size = Callable[[np.ndarray], np.ndarray]


# Sizes.


def target_size(points: np.ndarray) -> np.ndarray:
    """Return the target size at `points` (n, 2), before it is scaled to a number of cells.

    Drag depends on the first cells at the cylinder, on the flow that arrives there, and on the walls of the channel up
    to the cylinder. Sizes grow from there. The wake needs few cells at Re 20.
    """
    x, y = points.T
    d = np.maximum(np.hypot(x - CENTER[0], y - CENTER[1]) - RADIUS, 0)
    wall = np.minimum(y, HEIGHT - y)
    behind = 0.15 * np.maximum(x - 0.35, 0)
    sizes = [0.0012 + 0.1 * d, 0.003 + 0.05 * d, 0.009 + behind, 0.004 + 0.1 * wall + behind]
    return np.minimum(np.minimum.reduce(sizes), 0.05)


def wake_size(points: np.ndarray) -> np.ndarray:
    """Return the target size for Re 100: vortices need fine cells behind the cylinder."""
    x, y = points.T
    d = np.maximum(np.hypot(x - CENTER[0], y - CENTER[1]) - RADIUS, 0)
    behind = np.maximum(x - CENTER[0], 0)
    wake = 0.006 + 0.006 * behind + 0.05 * np.maximum(np.abs(y - CENTER[1]) - 0.05, 0)
    wake = np.where(x < CENTER[0], np.inf, wake + 0.1 * np.maximum(x - 0.6, 0))
    wall = 0.006 + 0.15 * np.minimum(y, HEIGHT - y) + 0.1 * np.maximum(x - 0.35, 0)
    return np.minimum(np.minimum.reduce([0.002 + 0.06 * d, wake, wall]), 0.03)


def scaled(size: Size, n_cells: float) -> Size:
    """Return `size` times the factor for which the integral of 1 / h^2 over the domain is `n_cells`."""
    radius = np.sqrt(np.linspace(RADIUS**2, 0.15**2, 2001)[1:] - (0.15**2 - RADIUS**2) / 4000)
    angle = 2 * np.pi * (np.arange(64) + 0.5) / 64
    ring = np.add.outer(radius * 0, angle)
    near = np.stack([0.2 + radius[:, None] * np.cos(ring), 0.2 + radius[:, None] * np.sin(ring)])
    step = HEIGHT / 205
    x, y = np.meshgrid(step * (np.arange(1100) + 0.5), step * (np.arange(205) + 0.5))
    far = np.stack([x.ravel(), y.ravel()], axis=1)
    far = far[np.hypot(far[:, 0] - 0.2, far[:, 1] - 0.2) > 0.15]
    total = (size(near.reshape(2, -1).T) ** -2.0).mean() * np.pi * (0.15**2 - RADIUS**2)
    factor = math.sqrt((total + (size(far) ** -2.0).sum() * step**2) / n_cells)
    return lambda points: factor * size(points)


# Meshers: each writes the polyMesh of a case.


def mesh_clvoro(kind: str, effort: str = "default") -> Callable[..., None]:
    """Return a mesher of cells of one kind: plain, with layers, mirrored, uniform, or of a newcomer."""

    def mesh(case: Case, adapter: clvoro.Adapter, size: Size, n_cells: int, seed: int) -> None:
        names: dict[str, Any] = {"walls": [0, 2], "outlet": 1, "inlet": 3}
        cylinder: Any = clvoro.curves.circle(CENTER, RADIUS, name="cylinder")
        if kind in ("uniform", "newcomer"):  # 360 straight edges
            angle, names["cylinder"] = np.linspace(0, 2 * np.pi, 360, endpoint=False), range(4, 364)
            cylinder = np.column_stack([np.cos(angle), np.sin(angle)]) * RADIUS + CENTER
        whole = clvoro.Polygon([(0, 0), (LENGTH, 0), (LENGTH, HEIGHT), (0, HEIGHT)], [cylinder], names=names)
        field: Any = scaled(size, n_cells)
        if kind == "uniform":
            field = math.sqrt(whole.measure / n_cells)
        elif kind == "newcomer":
            field = clvoro.sizing.Distance(whole.boundary("cylinder"), h_min=0.002, slope=0.06, h_max=0.02)
        options: dict[str, Any] = {"effort": effort, "seed": seed}
        if kind in ("layers", "mirrored"):
            h = float(field(np.array([[CENTER[0] - RADIUS, CENTER[1]]]))[0])
            options["layers"] = [clvoro.Layers(0.7 * h, 4, 1.15, spacing=1.4 * h, edges="cylinder")]
        made: clvoro.Result | clvoro.Diagram
        if kind == "mirrored":
            lower = adapter.run(_lower_part(), field, **options)
            made = adapter.diagram(whole, _with_mirror_images(lower.points))
        else:
            made = adapter.run(whole, field, n_cells=n_cells, **options)
        case.write_mesh(made, ("inlet", "outlet"), THICKNESS)

    return mesh


FOLLOWED: dict[str, tuple[clvoro.foam.FieldSizes, str]] = {
    "followed": (clvoro.foam.FieldSizes(), "simpleFoam"),
    "followed, forces": (clvoro.foam.FieldSizes(forces="cylinder"), "simpleFoam"),
    "followed, adjoints": (clvoro.foam.FieldSizes(adjoints=("Uadrag", "Ualift")), "adjointOptimisationFoam"),
}
"""Sizes and solvers of meshes that follow the solution at Re 20; at Re 100 all have those for forces."""


def follow(case: Case, adapter: clvoro.Adapter, n_cells: int, cycles: int, mesher: str) -> dict[str, float]:
    """Adapt the case to its solution; return drag and lift on the last mesh, the cells, and seconds by kind."""
    sizes, solver = FOLLOWED[mesher]
    if sizes.adjoints:
        write_adjoints(case)
    rows = clvoro.foam.adapt_case(
        case.folder, n_cells=n_cells, cycles=cycles, solver=solver, interval=3000, sizes=sizes, adapter=adapter
    )
    last = rows[-1]
    return {
        "drag": last.monitors["forces.Cd"],
        "lift": last.monitors["forces.Cl"],
        "steps": last.time,
        "divergence": divergence_of(case.folder, [row.time for row in rows[:-1]]),
        **seconds_of(rows),
    }


def divergence_of(folder: Path, times: list[float]) -> float:
    """Return the largest sum of the fluxes of a cell at some times, divided by the largest flux."""
    case, worst = FoamCase(folder), 0.0
    for at in (one for one in case.times() if one.value in times):
        mesh = Mesh.of(folder, case.mesh_folder(at))
        phi = next(field for field in case.fields(at) if field.name == "phi")
        flux, inner = np.zeros(len(mesh.owner)), len(mesh.neighbor)
        flux[:inner] = phi.internal.rows(inner)[:, 0]
        for patch in mesh.patches:
            if patch.kind != "empty":
                flux[patch.faces] = phi.patches[patch.name]["value"].rows(len(patch.faces))[:, 0]
        sums = np.bincount(mesh.owner, flux, len(mesh)) - np.bincount(mesh.neighbor, flux[:inner], len(mesh))
        worst = max(worst, float(np.abs(sums).max() / np.abs(flux).max()))
    return worst


def seconds_of(rows: list[clvoro.foam.FoamCycle]) -> dict[str, float]:
    """Return the seconds of all cycles of a loop, by kind."""
    kinds = ("solver_seconds", "mesh_seconds", "transfer_seconds")
    return {kind: sum(getattr(row, kind) or 0 for row in rows) for kind in kinds}


def _lower_part() -> clvoro.Polygon:
    """Return the channel below the axis of the cylinder."""
    angle = np.linspace(0, np.pi, 721)
    half = np.column_stack([np.cos(angle), -np.sin(angle)]) * RADIUS + CENTER
    y = CENTER[1]
    ring = [(0, 0), (LENGTH, 0), (LENGTH, y), *half.tolist(), (0, y)]
    return clvoro.Polygon(ring, names={"cylinder": range(3, 723)})


def _with_mirror_images(points: np.ndarray) -> np.ndarray:
    """Return generators of the lower part with their images above the axis, stretched towards the upper wall.

    Beside the cylinder they are exact images: the first cells there decide lift.
    """
    x, down = points[:, 0], CENTER[1] - points[:, 1]
    beyond = np.maximum(down - 0.07, 0) / (CENTER[1] - 0.07)
    up = down + (HEIGHT - 2 * CENTER[1]) * beyond**2
    return np.concatenate([points, np.column_stack([x, CENTER[1] + up])])


def mesh_gmsh(quadrangles: bool) -> Callable[..., None]:
    def mesh(case: Case, _: clvoro.Adapter, size: Size, n_cells: int, seed: int) -> None:
        # An equilateral triangle of area h^2 has edges of 1.52 h.
        factor, field = (1.0 if quadrangles else 1.52), scaled(size, n_cells)
        for _ in range(4):
            points, cells = _gmsh(field, factor, quadrangles)
            if abs(len(cells) / n_cells - 1) < 0.01:
                break
            factor *= math.sqrt(len(cells) / n_cells)
        write_prisms(case.folder, points, cells, _patch_of, PATCHES, THICKNESS)

    return mesh


def _gmsh(field: Size, factor: float, quadrangles: bool) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the points and cells of a mesh of the channel, with edges `factor` times `field`."""
    with gmsh_with(Algorithm=8 if quadrangles else 6, RecombineAll=int(quadrangles)) as gmsh:
        channel = gmsh.model.occ.addRectangle(0, 0, 0, LENGTH, HEIGHT)
        disk = gmsh.model.occ.addDisk(*CENTER, 0, RADIUS, RADIUS)
        gmsh.model.occ.cut([(2, channel)], [(2, disk)])
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.setSizeCallback(lambda dim, tag, x, y, z, h: factor * float(field(np.array([[x, y]]))[0]))
        gmsh.model.mesh.generate(2)
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        kinds, _, nodes = gmsh.model.mesh.getElements(2)
    number = np.zeros(int(tags.max()) + 1, int)
    number[tags.astype(int)] = np.arange(len(tags))
    points = coordinates.reshape(-1, 3)[:, :2]
    cells = []
    for kind, rows in zip(kinds, nodes, strict=True):
        for cell in number[rows.astype(int)].reshape(-1, {2: 3, 3: 4}[int(kind)]):
            x, y = points[cell].T
            area = x @ np.roll(y, -1) - y @ np.roll(x, -1)
            cells.append(cell if area > 0 else cell[::-1])
    used = np.unique(np.concatenate(cells))
    return points[used], [np.searchsorted(used, cell) for cell in cells]


def _patch_of(middles: np.ndarray) -> np.ndarray:
    x, y = middles.T
    sides = [np.minimum(y, HEIGHT - y) < 1e-9, x > LENGTH - 1e-9, x < 1e-9]
    return np.select(sides, [0, 1, 2], 3)


def mesh_blocks(case: Case, _: clvoro.Adapter, size: Size, n_cells: int, seed: int) -> None:
    """Four blocks around the cylinder up to a square, and one behind them, by blockMesh."""
    # Cells around a quarter, outward and along the channel, with the grading of the last two.
    round_, out, along = (1, 0.9, 1.1) if size is target_size else (1, 0.9, 2.2)
    k = math.sqrt(n_cells / (round_ * (4 * out + along)))
    n, m, q = round(round_ * k), round(out * k), round(along * k)
    h = [scaled(size, n_cells)(np.array([p]))[0] for p in ((0.15, 0.2), (0.0, 0.2))]
    outward, onward = float(h[1] / h[0]), 4.0 if size is target_size else 2.0
    s = float(RADIUS * math.sqrt(0.5))
    square = [(0, 0), (HEIGHT, 0), (HEIGHT, HEIGHT), (0, HEIGHT)]
    inner = [(0.2 - s, 0.2 - s), (0.2 + s, 0.2 - s), (0.2 + s, 0.2 + s), (0.2 - s, 0.2 + s)]
    flat = [*square, *inner, (LENGTH, 0), (LENGTH, HEIGHT)]
    bottoms = [(4 + (a + 1) % 4, 4 + a, a, (a + 1) % 4) for a in range(4)]
    cells = [f"({n} {m} 1) simpleGrading (1 {outward} 1)"] * 4
    bottoms.append((1, 8, 9, 2))
    cells.append(f"({q} {n} 1) simpleGrading ({onward} 1 1)")
    v = len(flat)

    def joined(corners: tuple[int, ...], shift: int = 0) -> str:
        return " ".join(str(c + shift) for c in corners)

    def sides(*edges: tuple[int, int]) -> str:
        return " ".join(f"({a} {b} {b + v} {a + v})" for a, b in edges)

    arcs = []
    for a, (x, y) in enumerate([(0.2, 0.15), (0.25, 0.2), (0.2, 0.25), (0.15, 0.2)]):
        for z, shift in ((0.0, 0), (THICKNESS, v)):
            arcs.append(f"arc {4 + a + shift} {4 + (a + 1) % 4 + shift} ({x} {y} {z})")
    faces = {
        "walls": sides((0, 1), (2, 3), (1, 8), (9, 2)),
        "outlet": sides((8, 9)),
        "inlet": sides((3, 0)),
        "cylinder": sides((4, 5), (5, 6), (6, 7), (7, 4)),
        "back": " ".join(f"({joined(b)})" for b in bottoms),
        "front": " ".join(f"({joined(b, v)})" for b in bottoms),
    }
    kinds = {**PATCHES, "back": "empty", "front": "empty"}
    patches = "".join(text_of({k: {"type": kinds[k], "faces": f"({f})"}}) for k, f in faces.items())
    blocks = " ".join(f"hex ({joined(b)} {joined(b, v)}) {c}" for b, c in zip(bottoms, cells, strict=True))
    corners = " ".join(f"({x!r} {y!r} {z})" for z in (0.0, THICKNESS) for x, y in flat)
    text = f"vertices ({corners});\nblocks ({blocks});\nedges ({' '.join(arcs)});\nboundary ({patches});\n"
    case.write("system/controlDict", {"deltaT": 1, "endTime": 1, "writeInterval": 1})
    path = case.folder / "system" / "blockMeshDict"
    path.write_text(header("dictionary", "blockMeshDict") + "convertToMeters 1;\n" + text)
    case.run("blockMesh")


MESHERS: dict[str, Callable[..., None]] = {
    "clvoro": mesh_clvoro("plain"),
    "clvoro, best": mesh_clvoro("plain", "best"),
    "clvoro, layers": mesh_clvoro("layers", "best"),
    "clvoro, layers, mirrored": mesh_clvoro("mirrored", "best"),
    "Gmsh triangles": mesh_gmsh(False),
    "Gmsh quadrangles": mesh_gmsh(True),
    "blockMesh": mesh_blocks,
    "uniform": mesh_clvoro("uniform"),
    "newcomer": mesh_clvoro("newcomer"),
    **dict.fromkeys(FOLLOWED, mesh_clvoro("newcomer")),
}


# Flow.


def write_case(
    case: Case,
    mesh: Mesh,
    reynolds: int,
    convection: str,
    start: tuple[np.ndarray, np.ndarray] | None = None,
    times: tuple[float, float] = (3000, 1),
    write_interval: float | None = None,
) -> None:
    """Write fields and dictionaries for a Reynolds number; `times` are the end and the step."""
    mean = reynolds * VISCOSITY / (2 * RADIUS)
    steady = reynolds == 20
    y = mesh.edges("inlet")[:, :, 1].T
    # The mean of the parabola over each face, so that the flux is exact.
    primitive = y**2 * HEIGHT / 2 - y**3 / 3
    inlet = np.zeros((y.shape[1], 2))
    inlet[:, 0] = 6 * mean / HEIGHT**2 * (primitive[1] - primitive[0]) / (y[1] - y[0])
    closed, flat = {"type": "zeroGradient"}, {name: {"type": "empty"} for name in ("back", "front")}
    still = {name: {"type": "noSlip"} for name in ("walls", "cylinder")}
    velocity = {"inlet": {"type": "fixedValue", "value": nonuniform(inlet)}, "outlet": closed, **still, **flat}
    pressure = dict.fromkeys(("inlet", "walls", "cylinder"), closed)
    pressure |= {"outlet": {"type": "fixedValue", "value": "uniform 0"}, **flat}
    scheme = {"linear": "Gauss linear", "linearUpwind": "Gauss linearUpwind grad(U)"}[convection]
    tolerance = 1e-12 if steady else 1e-7
    multigrid = {"solver": "GAMG", "smoother": "GaussSeidel"}
    gradients = {"solver": "PCG", "preconditioner": "DIC"}
    p = {**(multigrid if steady else gradients), "tolerance": tolerance, "relTol": 0.05}
    u = {"solver": "PBiCGStab", "preconditioner": "DILU", "tolerance": tolerance, "relTol": 0.05}
    solution = {
        "solvers": {"p": p, "pFinal": {**p, "relTol": 0}, "U": u, "UFinal": {**u, "relTol": 0}},
        "SIMPLE": {"consistent": "yes", "residualControl": {"p": 1e-7, "U": 1e-7}},
        "PIMPLE": {"nOuterCorrectors": 2, "nCorrectors": 2, "nNonOrthogonalCorrectors": 0},
    }
    if not steady:
        solution["relaxationFactors"] = {"equations": {'".*"': 1}}
    values = (f"uniform ({mean} 0 0)", "uniform 0") if start is None else (nonuniform(start[0]), nonuniform(start[1]))
    case.write_start(velocity, pressure, values)
    case.write_system(
        VISCOSITY,
        f"bounded {scheme}" if steady else scheme,
        {} if steady else {"ddtSchemes": {"default": "backward"}},
        solution=solution,
        control={
            "endTime": times[0],
            "deltaT": times[1],
            "writeInterval": write_interval or times[0],
            "writePrecision": 12,
            "functions": {"forces": forces_on("cylinder", mean, 2 * RADIUS, 2 * RADIUS * THICKNESS)},
        },
    )


def write_adjoints(case: Case) -> None:
    """Add to a steady case what `adjointOptimisationFoam` needs for the adjoint flows of drag and lift."""
    goals = {"drag": "(1 0 0)", "lift": "(0 1 0)"}
    flat, closed = {name: {"type": "empty"} for name in ("back", "front")}, {"type": "zeroGradient"}
    walls = ("walls", "cylinder")

    def limits(residual: float, names: tuple[str, str]) -> dict[str, Any]:
        return {f'"{name}.*"': residual for name in names}

    solvers: dict[str, Any] = {}
    for name, direction in goals.items():
        at = {"inlet": "adjointInletVelocity", "outlet": "adjointOutletVelocity"}
        at |= dict.fromkeys(walls, "adjointWallVelocity")
        velocity = {key: {"type": kind, "value": "uniform (0 0 0)"} for key, kind in at.items()}
        pressure = dict.fromkeys(("inlet", *walls), closed)
        pressure |= {"outlet": {"type": "adjointOutletPressure", "value": "uniform 0"}}
        case.write_start({**velocity, **flat}, {**pressure, **flat}, names=(f"Ua{name}", f"pa{name}"))
        force = {"type": "force", "weight": 1, "patches": "(cylinder)", "direction": direction}
        force |= {"Aref": 2 * RADIUS * THICKNESS, "rhoInf": 1, "UInf": 0.2}
        solvers[name] = {
            "active": "true",
            "type": "incompressible",
            "solver": "adjointSimple",
            "computeSensitivities": "false",
            "useSolverNameForFields": "true",
            "objectives": {"type": "incompressible", "objectiveNames": {name: force}},
            "ATCModel": {"ATCModel": "standard"},
            "solutionControls": {"nIters": 1000, "residualControl": limits(1e-5, ("pa", "Ua"))},
        }
    primal = {"active": "true", "type": "incompressible", "solver": "simple"}
    primal["solutionControls"] = {"consistent": "yes", "nIters": 1000, "residualControl": limits(1e-7, ("p", "U"))}
    case.write(
        "system/optimisationDict",
        {
            "optimisationManager": "singleRun",
            "primalSolvers": {"flow": primal},
            "adjointManagers": {"forces": {"primalSolver": "flow", "adjointSolvers": solvers}},
            "optimisation": {"sensitivities": {"type": "surfacePoints", "patches": "(cylinder)"}},
        },
    )
    case.write("constant/adjointRASProperties", {"adjointRASModel": "adjointLaminar", "adjointTurbulence": "off"})
    schemes, solution = (case.folder / "system" / name for name in ("fvSchemes", "fvSolution"))
    text = schemes.read_text()
    for name in goals:
        text = text.replace(
            "div(phi,U)", f"div(-phi,Ua{name}) bounded Gauss linearUpwind grad(Ua{name});\n    div(phi,U)"
        )
    schemes.write_text(text)
    # The last entry of a name counts; dictionaries are merged.
    more = {
        "solvers": {
            '"pa.*"': {"solver": "GAMG", "smoother": "GaussSeidel", "tolerance": 1e-12, "relTol": 0.05},
            '"Ua.*"': {"solver": "PBiCGStab", "preconditioner": "DILU", "tolerance": 1e-12, "relTol": 0.05},
        },
        "relaxationFactors": {"fields": {'"pa.*"': 0.3}, "equations": {'"Ua.*"': 0.7}},
    }
    solution.write_text(solution.read_text() + text_of(more))


def value_at(point: tuple[float, float], centroids: np.ndarray, values: np.ndarray) -> float:
    """Return the value at `point` of the quadratic polynomial that fits the nearest 48 cells."""
    apart = centroids - np.array(point)
    distance = np.hypot(*apart.T)
    near = np.argsort(distance)[:48]
    x, y = (apart[near] / distance[near].max()).T
    terms = np.stack([np.ones(len(near)), x, y, x * x, x * y, y * y], axis=1)
    weight = np.exp(-3 * (x * x + y * y))
    return float(np.linalg.lstsq(terms * weight[:, None], values[near] * weight, rcond=None)[0][0])


def steady_flow(case: Case, mesh: Mesh, convection: str) -> dict[str, float]:
    """Solve at Re 20; return drag, lift, pressure difference and the number of iterations."""
    write_case(case, mesh, 20, convection)
    case.run("simpleFoam")
    forces = case.table("forces", "coefficient.dat")
    return {
        "drag": float(forces["Cd"][-1]),
        "lift": float(forces["Cl"][-1]),
        "steps": float(forces["Time"][-1]),
        **pressure_difference(case, mesh),
    }


def pressure_difference(case: Case, mesh: Mesh) -> dict[str, float]:
    """Return the difference of the pressures before and behind the cylinder."""
    pressure = case.field("p", len(mesh))[:, 0]
    front, rear = (value_at((x, 0.2), mesh.centroids[:, :2], pressure) for x in (0.2 - RADIUS, 0.2 + RADIUS))
    return {"pressure": front - rear}


def shedding_flow(case: Case, mesh: Mesh, convection: str, before: list[np.ndarray]) -> dict[str, float]:
    """Solve from the flow `before` until it is periodic; return largest drag and lift, and the Strouhal number."""
    start, end = None, 6.0
    if before:
        points, u, p = before
        near = np.array([np.argmin(((points - c) ** 2).sum(axis=1)) for c in mesh.centroids[:, :2]])
        start, end = (u[near], p[near]), 2.5
    write_case(case, mesh, 100, convection, start, (end, 0.0015 * math.sqrt(3000 / len(mesh))))
    case.run("pimpleFoam")
    before[:] = mesh.centroids[:, :2], case.field("U", len(mesh))[:, :2], case.field("p", len(mesh))[:, 0]
    return shedding_of(case, end)


def shedding_of(case: Case, end: float) -> dict[str, float]:
    """Return the largest drag and lift in the last three periods before a time, and the Strouhal number."""
    forces = case.table("forces", "coefficient.dat")
    time_, lift = forces["Time"], forces["Cl"]
    late = time_ > end - 1.05
    rises = np.flatnonzero((lift[:-1] < 0) & (lift[1:] >= 0) & late[:-1])
    share = -lift[rises] / (lift[rises + 1] - lift[rises])
    crossings = time_[rises] + share * (time_[rises + 1] - time_[rises])
    return {
        "drag": float(forces["Cd"][late].max()),
        "lift": float(lift[late].max()),
        "strouhal": 2 * RADIUS / float(np.diff(crossings).mean()),
        "steps": float(len(time_)),
    }


def follow_vortices(case: Case, adapter: clvoro.Adapter, mesh: Mesh, n_cells: int, convection: str) -> dict[str, float]:
    """Adapt the case at Re 100 once in each of ten periods of shedding, and go on for three; return as `shedding_of`.

    Before that the flow is solved on the coarse mesh until it sheds. The sizes are those for the forces on the
    cylinder, of six times in each period.
    """
    period, begin = 0.33, 4.0
    write_case(case, mesh, 100, convection, None, (begin, 0.002), period / 6)
    case.run("pimpleFoam")
    known = FoamCase(case.folder)
    known.set_control(deltaT=0.001 * math.sqrt(7500 / n_cells))
    sizes = clvoro.foam.FieldSizes(forces="cylinder", h_min=0.001)
    rows = clvoro.foam.adapt_case(
        case.folder,
        n_cells=n_cells,
        cycles=10,
        solver="pimpleFoam",
        interval=period,
        sizes=sizes,
        window=period,
        pictures=False,
        adapter=adapter,
    )
    end = rows[-1].time + 1.05
    known.set_control(endTime=end)
    case.run("pimpleFoam")
    divergence = divergence_of(case.folder, [row.time for row in rows[:-1]])
    return {**shedding_of(case, end), "divergence": divergence, **seconds_of(rows)}


# Tables.


def errors(values: dict[str, float]) -> dict[str, float]:
    """Return the errors at Re 20 in percent of the reference."""
    return {name: 100 * (values[name] / value - 1) for name, value in REFERENCE.items()}


def middle(values: list[float], form: str) -> str:
    """Write the median and the range, and of five or more values the standard error of the median.

    It is that of a normal distribution, sqrt(pi / 2) times the standard error of the mean.
    """
    text, n = spread(values, form), len(values)
    if n < 5:
        return text
    error = math.sqrt(math.pi / 2 / n) * float(np.std(values, ddof=1))
    return f"{text}, +- {format(error, form.lstrip('+'))} of {n}"


STEADY = {
    "c_D %": lambda r: middle(r["drag"], "+.3f"),
    "c_L %": lambda r: middle(r["lift"], "+.2f"),
    "pressure difference %": lambda r: spread(r["pressure"], "+.2f"),
    "iterations": lambda r: f"{np.median(r['steps']):.0f}",
    "divergence": lambda r: f"{max(r['divergence']):.0e}" if "divergence" in r else "",
}
UNSTEADY = {
    "max c_D": lambda r: spread(r["drag"], ".4f"),
    "max c_L": lambda r: spread(r["lift"], ".4f"),
    "St": lambda r: spread(r["strouhal"], ".4f"),
    "steps": lambda r: f"{np.median(r['steps']):.0f}",
    "divergence": STEADY["divergence"],
    "meshes, transfers %": lambda r: spread(100 * meshing_share(r), ".1f") if "mesh_seconds" in r else "",
}


def meshing_share(row: dict[str, Any]) -> np.ndarray:
    """Return the share of meshes and transfers in the time of a loop, for each sample."""
    solver, mesh, transfer = (np.array(row[key]) for key in ("solver_seconds", "mesh_seconds", "transfer_seconds"))
    return (mesh + transfer) / (solver + mesh + transfer)


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--reynolds", type=int, choices=(20, 100), default=20)
    options_of.add_argument("--cells", type=counts, default=None, metavar="LIST")
    options_of.add_argument("--meshers", default=";".join(MESHERS), metavar="NAMES", help="separated by semicolons")
    options_of.add_argument("--samples", type=int, default=1)
    options_of.add_argument("--convection", choices=("linear", "linearUpwind"), default="linearUpwind")
    options_of.add_argument("--cycles", type=int, default=3)
    options_of.add_argument("--pictures", type=Path, metavar="FOLDER")
    options = options_of.parse_args()
    re_ = options.reynolds
    require("simpleFoam" if re_ == 20 else "pimpleFoam", "blockMesh")
    adapter = make_adapter(options)
    convection = options.convection
    size = target_size if re_ == 20 else wake_size
    shown = {
        "mesh": lambda r: r["mesher"],
        "cells": lambda r: f"{np.median(r['cells']):,.0f}",
        **(STEADY if re_ == 20 else UNSTEADY),
        "s": lambda r: f"{np.median(r['seconds']):.1f}",
    }
    report = Report(options.json, shown)
    before: list[np.ndarray] = []
    for n in options.cells or ([3000, 6000, 13000] if re_ == 20 else [3000, 6000]):
        for mesher in (part.strip() for part in options.meshers.split(";")):
            record: dict[str, Any] = {"mesher": mesher, "reynolds": re_, "convection": convection}
            kept: dict[str, list[float]] = {}
            for sample in range(1 if mesher == "blockMesh" else options.samples):
                with tempfile.TemporaryDirectory() as folder:
                    case = Case(Path(folder))
                    try:
                        first = COARSE if re_ == 100 and mesher in FOLLOWED else round(n * (1 + 0.01 * sample))
                        MESHERS[mesher](case, adapter, size, first, sample)
                    except MissingPeerError as error:
                        print(f"left out: {mesher}, needs {error}", file=sys.stderr)
                        break
                    mesh = Mesh.of(case.folder)
                    start = time.perf_counter()
                    if re_ != 20 and mesher in FOLLOWED:
                        flow = follow_vortices(case, adapter, mesh, n, convection)
                        mesh = case.latest_mesh()
                    elif re_ != 20:
                        flow = shedding_flow(case, mesh, convection, before)
                    elif mesher in FOLLOWED:
                        write_case(case, mesh, 20, convection)
                        flow = follow(case, adapter, n, options.cycles, mesher)
                        mesh = case.latest_mesh()
                        flow |= pressure_difference(case, mesh)
                    else:
                        flow = steady_flow(case, mesh, convection)
                    found = {**flow, **(errors(flow) if re_ == 20 else {}), "cells": len(mesh)}
                    found["seconds"] = time.perf_counter() - start
                    for key, value in found.items():
                        kept.setdefault(key, []).append(value)
                    if options.pictures and not sample and "clvoro" in mesher:
                        options.pictures.mkdir(parents=True, exist_ok=True)
                        name = f"{mesher.replace(', ', '_')}_{re_}_{n}.png"
                        figure = case.plot_speed(
                            window=((0.06, 0.08), (0.5, 0.32)), title=f"{mesher}, {len(mesh):,} cells"
                        )
                        figure.savefig(options.pictures / name, dpi=110)
            if kept:
                report.add({**record, **kept}, f"{mesher}, {n}")
    ranges = ", ".join(f"{name} {low} to {high}" for name, (low, high) in RANGES.items())
    title = f"Flow around a cylinder at Re {re_}, {convection}"
    report.finish(heading(adapter, title if re_ == 20 else f"{title}; reference: {ranges}"))


if __name__ == "__main__":
    main()
