"""Meshes that follow a function: interpolation error against the isotropic optimum, beside Gmsh and MMG.

    python bench/adaptive.py [--spaces plane,space,sphere] [--functions smooth,layer,kink,shock] [--cells 4000]
                             [--cycles 6] [--growth 2] [--effort fast] [--norms 1,2] [--peers ""]
                             [--pictures FOLDER] [--device NAME] [--json]

Each mesh begins uniform. A cycle evaluates the function at the centroids of the cells, takes sizes from
`hessian_size(u, on=mesh, n_cells=N, p)`, and adapts the generators to them. The first half of the cycles has a quarter
of the cells. Gmsh and MMG (pip install gmsh mmgpy) get the sizes of the last cycle, scaled to as many unknowns.
Unknowns are the generators, and in a box the points on the walls that close their triangulation; of the others they are
the vertices.

The error is that of linear interpolation in the Delaunay triangulation of the unknowns. "optimum" is the least error of
isotropic meshes: with e(x) the L^p mean of the error on a simplex of volume 1, and V the volume of a simplex,

    |e V^(2/d)|_p is least for V = c e^(-d p / (2 p + d)),

over all orientations of equilateral triangles, or of the tetrahedra of a body-centered lattice, whose number is that
of the mesh. The columns "L1" and "L2" are the error over this optimum, each for a mesh of its own p; "uniform" is the
error of the uniform mesh over it, and "predicted" the error that the last sizes predict over the true one. Targets:
1.15 in the plane and on the sphere, 1.25 in space.

Three more columns say how much of this is due to sizes and how much to shapes. "sizes" is the error over the optimum if
all simplices were regular, with the volumes of the mesh's cells, at random places in them. L1 and L2, divided by
"sizes", are the factors due to shapes. "bound" is the least value of "sizes" for this number of cells and this
growth, with sizes that depend on the distance from the layer alone. It is above 1 where cells are larger than the
layer, since the optimum holds for many cells. A mesh whose cells are not at random places can be better.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from _common import FIRST_SEED, Report, draw_sizes, heading, make_adapter, names, parser, shown
from _remeshers import MESHERS, MissingPeerError, remesh
from scipy.interpolate import CubicSpline
from scipy.spatial import ConvexHull, Delaunay
from scipy.stats import qmc

import clvoro
from clvoro import sizing
from clvoro.sizing.graded import default_engine

Function = Callable[[np.ndarray], np.ndarray]
TARGET = {2: 1.15, 3: 1.25}
BATCH = 4_000_000
SAMPLES = 1 << 16
ROUNDS = 24
SHELLS, PLACES, MOST_SAMPLES = 128, 512, 1 << 20
"""Shells with one best size each, simplices in each of them, and samples that fill them."""
PER_CELL = {2: 2, 3: 6}
"""Simplices for each point of a hexagonal or a body-centered lattice."""
BALL = {2: math.pi**-0.5, 3: (0.75 / math.pi) ** (1 / 3)}
"""Radius of the ball of measure 1."""


FUNCTIONS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "smooth": lambda x, r: np.sin(4 * x[..., 0]) * np.exp(1.5 * x[..., 1]),
    "layer": lambda x, r: np.tanh(20 * r),
    "kink": lambda x, r: np.sqrt(r**2 + 0.02**2),
    "shock": lambda x, r: np.tanh(60 * r) + 0.3 * np.sin(3 * x[..., 0]),
}
"""Functions of positions (..., d) and of the distance r from a circle or ball of radius 0.6 around `Space.center`."""


@dataclass(frozen=True)
class Space:
    """A domain to mesh, and how its points are triangulated."""

    domain: clvoro.Box | clvoro.Sphere
    dim: int
    center: tuple[float, ...]

    @property
    def is_sphere(self) -> bool:
        """Whether cells lie on a surface."""
        return self.dim < len(self.domain.lower)

    @cache  # noqa: B019 - the same function for the same name, since `optimum` keeps its results
    def function(self, name: str) -> Function:
        """Return a function of positions (..., d)."""
        return lambda x: FUNCTIONS[name](x, self.distance(x) - 0.6)

    def unknowns(self, mesh: clvoro.Diagram) -> np.ndarray:
        """Return the generators, with the points on walls that close their triangulation."""
        if self.is_sphere:
            return mesh.points
        walls = mesh.neighbors < 0
        lower, upper = np.array(self.domain.lower), np.array(self.domain.upper)
        corners = lower + (upper - lower) * np.stack(np.meshgrid(*[[0, 1]] * self.dim), axis=-1).reshape(-1, self.dim)
        on = [mesh.points, mesh.face_centroids[walls], corners]
        if self.dim == 3:
            # Cells at two walls: the middle of their edge.
            owner = np.repeat(np.arange(len(mesh)), np.diff(mesh.neighbor_starts))[walls]
            wall = -1 - mesh.neighbors[walls]
            for a in range(6):
                for b in range(a + 1, 6):
                    if a // 2 != b // 2:
                        x = mesh.points[np.intersect1d(owner[wall == a], owner[wall == b])].copy()
                        for side in (a, b):
                            x[:, side // 2] = (lower, upper)[side % 2][side // 2]
                        on.append(x)
        return np.concatenate(on)

    def simplices(self, points: np.ndarray) -> np.ndarray:
        """Return the Delaunay triangulation of points, (m, d + 1)."""
        return ConvexHull(points).simplices if self.is_sphere else Delaunay(points).simplices

    def onto(self, x: np.ndarray) -> np.ndarray:
        """Return points on the domain: on the sphere those of its flat triangles are moved outwards."""
        return x / np.linalg.norm(x, axis=-1, keepdims=True) if self.is_sphere else x

    def directions(self, x: np.ndarray) -> np.ndarray:
        """Return unit vectors along the domain at points (n, D), (n, d, D)."""
        if not self.is_sphere:
            return np.broadcast_to(np.eye(self.dim), (len(x), self.dim, self.dim))
        angle = np.arctan2(x[:, 1], x[:, 0])
        east = np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle])
        return np.stack([east, np.cross(x, east)], axis=1)

    def distance(self, x: np.ndarray) -> np.ndarray:
        """Return the distances (n,) of points (n, D) from the center."""
        return np.linalg.norm(x - np.array(self.center), axis=-1)

    def along(self, r: np.ndarray) -> np.ndarray:
        """Return lengths of the ways along the domain that lead to distances `r` (n,)."""
        return 2 * np.arcsin(np.minimum(r / 2, 1)) if self.is_sphere else r

    def samples(self, count: int = SAMPLES) -> np.ndarray:
        """Return points that fill the domain evenly, (n, D)."""
        t = qmc.Sobol(self.dim, seed=1).random(count)
        if not self.is_sphere:
            return t
        z, angle = 2 * t[:, 0] - 1, 2 * np.pi * t[:, 1]
        s = np.sqrt(1 - z**2)
        return np.column_stack([s * np.cos(angle), s * np.sin(angle), z])

    def bends(self, u: Function, x: np.ndarray) -> np.ndarray:
        """Return the eigenvalues of the Hessian of a function at points, (n, d)."""
        d, step, along = self.dim, 1e-4, self.directions(x)
        hessian = np.empty((len(x), d, d))
        for a in range(d):
            for b in range(a + 1):
                total = np.zeros(len(x))
                for i, j in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
                    v = step * (i * along[:, a] + j * along[:, b])
                    if a == b:
                        v = 2 * step * i * along[:, a] if i == j else 0 * v
                    length = np.linalg.norm(v, axis=1, keepdims=True)
                    there = x * np.cos(length) + v * np.sinc(length / np.pi) if self.is_sphere else x + v
                    total += i * j * u(there)
                hessian[:, a, b] = hessian[:, b, a] = total / (4 * step**2)
        return np.linalg.eigvalsh(hessian)

    def around(self, mesh: clvoro.Diagram, rng: np.random.Generator) -> np.ndarray:
        """Return a random vector (n, d) for each cell, in a ball of its volume."""
        away = rng.normal(size=(len(mesh), self.dim))
        away *= (rng.random(len(mesh)) ** (1 / self.dim) / np.linalg.norm(away, axis=1))[:, None]
        return BALL[self.dim] * mesh.volumes[:, None] ** (1 / self.dim) * away


SPACES = {
    "plane": Space(clvoro.Box((0, 0), (1, 1)), 2, (0.2, 0.1)),
    "space": Space(clvoro.Box((0, 0, 0), (1, 1, 1)), 3, (0.2, 0.1, 0.15)),
    "sphere": Space(clvoro.Sphere(1.0), 2, (0.6, 0.48, 0.64)),
}


def volumes_of(corners: np.ndarray) -> np.ndarray:
    """Return the volumes of simplices (n, d + 1, D)."""
    sides = corners[:, 1:] - corners[:, :1]
    gram = np.einsum("nad,nbd->nab", sides, sides)
    return np.sqrt(np.maximum(np.linalg.det(gram), 0)) / math.factorial(sides.shape[1])


def inner_points(dim: int, count: int) -> np.ndarray:
    """Return barycentric coordinates (count, d + 1) that fill a simplex evenly."""
    t = np.sort(qmc.Sobol(dim, seed=2).random(count), axis=1)
    return np.diff(t, axis=1, prepend=0, append=1)


def interpolation_errors(space: Space, points: np.ndarray, u: Function) -> tuple[dict[int, float], int]:
    """Return the L1 and the L2 error of linear interpolation between `points`, and the number of simplices."""
    x = points[space.simplices(points)]
    volume = volumes_of(x)
    x, volume = x[volume > 1e-14], volume[volume > 1e-14]
    weights = inner_points(space.dim, 64)
    sums = np.zeros(2)
    for some in np.array_split(np.arange(len(x)), len(x) * len(weights) // BATCH + 1):
        at = np.einsum("qb,nbd->nqd", weights, x[some])
        error = np.abs(u(x[some]) @ weights.T - u(space.onto(at)))
        sums += volume[some] @ error.mean(axis=1), volume[some] @ (error**2).mean(axis=1)
    return {1: float(sums[0]), 2: math.sqrt(sums[1])}, len(x)


def reference_simplices(dim: int) -> np.ndarray:
    """Return simplices of volume 1 in all orientations, (n, d + 1, d)."""
    if dim == 2:
        base = np.array([(0, 0), (1, 0), (0.5, math.sqrt(0.75))])
        turned = []
        for angle in np.linspace(0, 2 * np.pi / 3, 12, endpoint=False):
            c, s = math.cos(angle), math.sin(angle)
            turned.append(base @ np.array([(c, s), (-s, c)]))
        corners = np.array(turned)
    else:
        from scipy.spatial.transform import Rotation

        base = np.array([(0.0, 0, 0), (1, 0, 0), (0.5, 0.5, 0.5), (0.5, 0.5, -0.5)])
        corners = np.array([base @ r.as_matrix() for r in Rotation.random(24, random_state=3)])
    return corners / volumes_of(corners)[:, None, None] ** (1 / dim)


@cache
def local_errors(space: Space, u: Function, p: int) -> np.ndarray:
    """Return the L^p mean of the error on a simplex of volume 1 at each of the samples, (n,)."""
    d, x = space.dim, space.samples()
    eigen = space.bends(u, x)
    corners, weights = reference_simplices(d), inner_points(d, 32)
    inside = np.einsum("qb,nbd->nqd", weights, corners)
    # The error of x^2 / 2 along each axis; that of a quadratic function is their sum, with the eigenvalues.
    squares = 0.5 * (np.einsum("qb,nbd->nqd", weights, corners**2) - inside**2).reshape(-1, d)
    local = np.empty(len(x))
    for some in np.array_split(np.arange(len(x)), len(x) * len(squares) // BATCH + 1):
        local[some] = (np.abs(eigen[some] @ squares.T) ** p).mean(axis=1) ** (1 / p)
    return local


def optimum(space: Space, u: Function, p: int) -> float:
    """Return the least L^p error of isotropic meshes, times the number of their simplices to the power 2 / d."""
    power = space.dim * p / (2 * p + space.dim)
    mean = float((local_errors(space, u, p) ** power).mean()) * space.domain.measure
    # V = c local^-power with the integral of 1 / V the number of simplices.
    return mean ** (1 / power)


def simplex_errors(
    space: Space, u: Function, p: int, centers: np.ndarray, length: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return the mean of |error|^p on regular simplices, one at each of `centers` (n, D), of cells of `length` (n,)."""
    d = space.dim
    corners, weights = reference_simplices(d), inner_points(d, 32)
    corners = (corners - corners.mean(axis=1, keepdims=True)) * PER_CELL[d] ** (-1 / d)
    at = length[:, None, None] * corners[rng.integers(len(corners), size=len(centers))]
    at = space.onto(centers[:, None] + np.einsum("nkd,ndD->nkD", at, space.directions(centers)))
    inside = space.onto(np.einsum("qk,nkD->nqD", weights, at))
    return (np.abs(u(at) @ weights.T - u(inside)) ** p).mean(axis=1)


@cache
def error_profile(space: Space, u: Function, p: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return shells around the center: distances (k,), volumes (k,), sizes (m,), and errors (2, k, m).

    Errors are means of |error|^p on regular simplices at random places in the shell. Those of two independent halves of
    the places are apart. Half of the shells have equal volumes, half equal numbers of cells of the optimum.
    """
    d, rng = space.dim, np.random.default_rng(6)
    x = space.samples()
    cells = local_errors(space, u, p) ** (d * p / (2 * p + d))
    order = (away := space.distance(x)).argsort()
    reached = np.cumsum((0.5 / len(x) + 0.5 * cells / cells.sum())[order])
    edges = np.interp(np.linspace(0, 1, SHELLS + 1), reached, away[order])
    edges[0], edges[-1] = 0, np.inf
    x = space.samples(MOST_SAMPLES)
    shell = np.searchsorted(edges, away := space.distance(x), side="right") - 1
    counts = np.bincount(shell, minlength=SHELLS)
    r, volume = np.bincount(shell, away, SHELLS) / counts, space.domain.measure * counts / len(x)
    starts = np.cumsum(counts) - counts
    place = starts[:, None] + (rng.random((SHELLS, PLACES)) * counts[:, None]).astype(int)
    x = x[shell.argsort(kind="stable")][place.ravel()]
    sizes = (space.domain.measure / n) ** (1 / d) * np.geomspace(0.15, 4, 64)
    found = np.empty((2, SHELLS, len(sizes)))
    for k, h in enumerate(sizes):
        # The same simplices for all sizes: then their number does not bias the least error.
        error = simplex_errors(space, u, p, x, np.full(len(x), h), np.random.default_rng(7))
        found[:, :, k] = error.reshape(SHELLS, 2, -1).mean(axis=2).T
    return r, volume, sizes, found


def best_profile(space: Space, u: Function, p: int, n: int, growth: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the sizes h(r) of `n` cells for which regular simplices at random places have the least L^p error.

    Returned are r (k,), h (k,), and the error over the optimum. Neighboring sizes have a ratio of at most `growth`. h
    minimizes the sum of volume (|error|^p + c h^-d), by dynamic programming; c follows from the number of cells. The
    error is that of the half of the places that is not used to find h.
    """
    d, (r, volume, sizes, found) = space.dim, error_profile(space, u, p, n)
    h = np.geomspace(sizes[0], sizes[-1], 400)
    errors = np.exp(CubicSpline(np.log(sizes), np.log(np.maximum(found, 1e-60)), axis=2)(np.log(h)))
    apart = math.log(growth) * np.diff(space.along(r))
    least = optimum(space, u, p) * (PER_CELL[d] * n) ** (-2 / d)

    def sizes_for(half: np.ndarray, c: float) -> np.ndarray:
        local = volume[:, None] * (half + c * h**-d)
        total = [local[0]]
        for k in range(1, len(r)):
            inner = np.where(np.abs(h[:, None] - h) <= apart[k - 1], total[-1], np.inf).min(axis=1)
            ends = [np.interp(h + side * apart[k - 1], h, total[-1]) for side in (-1, 1)]
            total.append(local[k] + np.minimum.reduce([inner, *ends]))
        chosen = [h[total[-1].argmin()]]
        for k in range(len(r) - 2, -1, -1):
            near = np.append(h, np.clip([chosen[-1] - apart[k], chosen[-1] + apart[k]], h[0], h[-1]))
            near = near[np.abs(near - chosen[-1]) <= apart[k] * (1 + 1e-9)]
            chosen.append(near[np.interp(near, h, total[k]).argmin()])
        return np.array(chosen[::-1])

    over = []
    for half, other in (errors, errors[::-1]):
        low, high = -60.0, 20.0
        while high - low > 1e-4:
            middle = (low + high) / 2
            best = sizes_for(half, math.exp(middle))
            low, high = (middle, high) if volume @ best**-d > n else (low, middle)
        error = volume @ [np.interp(b, h, row) for b, row in zip(best, other, strict=True)]
        over.append(error ** (1 / p) * (volume @ best**-d / n) ** (2 / d) / least)
    return r, best, float(np.mean(over))


def ideal_error(space: Space, mesh: clvoro.Diagram, u: Function, p: int) -> float:
    """Return the L^p error of regular simplices with the volumes of the cells, at random places in them."""
    rng, length = np.random.default_rng(4), mesh.volumes ** (1 / space.dim)
    along, total = space.directions(mesh.centroids), np.zeros(len(mesh))
    for _ in range(ROUNDS):
        away = np.einsum("nd,ndD->nD", space.around(mesh, rng), along)
        total += simplex_errors(space, u, p, space.onto(mesh.centroids + away), length, rng)
    return float(mesh.volumes @ total / ROUNDS) ** (1 / p)


def adapt(
    space: Space, adapter: clvoro.Adapter, u: Function, n: int, options: Any, p: int
) -> tuple[clvoro.Result, sizing.Estimate, clvoro.Result]:
    """Return the mesh that follows a function, its sizes, and the uniform mesh."""
    even = (space.domain.measure / n) ** (1 / space.dim)
    uniform = adapter.run(space.domain, even, options.effort, n_cells=n, seed=FIRST_SEED)
    coarse = (space.domain.measure / (n // 4)) ** (1 / space.dim)
    mesh = adapter.run(space.domain, coarse, options.effort, n_cells=n // 4, seed=FIRST_SEED)
    for cycle in range(options.cycles):
        count = n // 4 if 2 * (cycle + 1) <= options.cycles else n
        bounds = {"growth": options.growth, "h_max": 0.5 if space.is_sphere else math.inf}
        size = sizing.hessian_size(u(mesh.centroids), on=mesh, n_cells=count, p=p, **bounds)
        mesh = adapter.run(space.domain, size, options.effort, n_cells=count, points=mesh.points, seed=FIRST_SEED)
    return mesh, size, uniform


COLUMNS = {
    "space": lambda r: r["space"],
    "function": lambda r: r["function"],
    "mesh": lambda r: r["mesh"],
    "unknowns": shown("unknowns", ",d"),
    "L1": shown("L1", ".3f"),
    "uniform": shown("uniform1", ".2f"),
    "L2": shown("L2", ".3f"),
    "uniform ": shown("uniform2", ".2f"),
    "sizes": shown("sizes1", ".3f"),
    "sizes ": shown("sizes2", ".3f"),
    "bound": shown("bound1", ".3f"),
    "bound ": shown("bound2", ".3f"),
    "predicted": shown("predicted1", ".2f"),
    "predicted ": shown("predicted2", ".2f"),
    "seconds": shown("seconds", ".1f"),
}


def main(arguments: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("--spaces", default=",".join(SPACES))
    made.add_argument("--functions", default=",".join(FUNCTIONS))
    made.add_argument("--cells", type=int, default=4000)
    made.add_argument("--cycles", type=int, default=6)
    made.add_argument("--growth", type=float, default=2.0)
    made.add_argument("--effort", default="fast", choices=("fast", "default", "best"))
    made.add_argument("--norms", default="1,2")
    made.add_argument("--peers", default=",".join(MESHERS))
    made.add_argument("--pictures", type=Path, metavar="FOLDER")
    options = made.parse_args(arguments)
    adapter, report, missed = make_adapter(options), Report(options.json, COLUMNS), False
    drawn: list[tuple[str, clvoro.Result]] = []
    for name in names(options.spaces):
        space = SPACES[name]
        for function in names(options.functions):
            u = space.function(function)
            rows: dict[str, dict[str, Any]] = {}
            for p in map(int, names(options.norms)):
                start = time.perf_counter()
                mesh, followed, uniform = adapt(space, adapter, u, options.cells, options, p)
                seconds = time.perf_counter() - start
                points = {"clvoro": space.unknowns(mesh.diagram)}
                if not space.is_sphere:
                    # On the device, because Gmsh takes millions of values.
                    sizes = sizing.Sizing(default_engine(space.dim), space.domain, followed)
                    for peer in names(options.peers):
                        try:
                            points[peer] = remesh(MESHERS[peer], space.domain, sizes, len(points["clvoro"]))[0]
                        except MissingPeerError as error:
                            print(f"left out: {error}")
                for mesher, x in points.items():
                    errors, count = interpolation_errors(space, x, u)
                    least = optimum(space, u, p) * count ** (-2 / space.dim)
                    row = rows.setdefault(mesher, {"space": name, "function": function, "mesh": mesher})
                    row |= {"unknowns": len(x), f"L{p}": errors[p] / least}
                    if mesher == "clvoro":
                        plain, count = interpolation_errors(space, space.unknowns(uniform.diagram), u)
                        over = plain[p] / (optimum(space, u, p) * count ** (-2 / space.dim))
                        row |= {f"uniform{p}": over, f"predicted{p}": followed.norm / errors[p], "seconds": seconds}
                        even = optimum(space, u, p) * (PER_CELL[space.dim] * len(mesh)) ** (-2 / space.dim)
                        row[f"sizes{p}"] = ideal_error(space, mesh.diagram, u, p) / even
                        if function != "smooth":  # which is no function of r
                            row[f"bound{p}"] = best_profile(space, u, p, len(mesh), options.growth)[2]
                        missed |= errors[p] / least > TARGET[space.dim]
            if name == "plane":
                drawn.append((function, mesh))
            for row in rows.values():
                report.add(row, f"{name}, {function}, {row['mesh']}")
    if options.pictures and drawn:
        panels = [(mesh, {"title": f"{name}: {len(mesh):,} cells"}) for name, mesh in drawn]
        draw_sizes(panels, options.pictures / "adaptive.png", (3.2 * len(drawn), 3.5), None)
    report.finish(heading(adapter, f"Interpolation error over the isotropic optimum, {options.cells:,} cells"))
    return int(missed)


if __name__ == "__main__":
    raise SystemExit(main())
