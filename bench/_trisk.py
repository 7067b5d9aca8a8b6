"""The TRiSK scheme on an MPAS file of a sphere: operators as sparse matrices, shallow-water equations.

Sources: Thuburn, Ringler, Skamarock and Klemp 2009, J. Comput. Phys. 228, 8321 (T09), for the tangential velocity;
Ringler, Thuburn, Klemp and Skamarock 2010, J. Comput. Phys. 229, 3065 (R10), for the nonlinear equations.

Mass is in cells, the velocity normal to the faces on edges, and vorticity on vertices. The normal of an edge leads from
its first cell to its second; its tangent, 90 degrees counter-clockwise from the normal, from its first vertex to its
second.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.io import netcdf_file

import clvoro


def unit(x: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) divided by their lengths."""
    return x / np.linalg.norm(x, axis=1, keepdims=True)


@dataclass(frozen=True)
class Mesh:
    """The C grid of a file; n cells, m edges, v vertices. Lengths in the unit of the radius.

    - `points` (n, 3), `corners` (v, 3), `crossings` (m, 3): unit vectors of generators, vertices, and middles of arcs
      between two generators, where these cross the great circles of the faces.
    - `dc`, `dv` (m,): arc between the generators, and length of the face.
    - `kites` (v, n): the area that a vertex and a cell share.
    - `tangential` (m, m): from normal to tangential components of a field on edges (T09).
    """

    points: np.ndarray
    corners: np.ndarray
    crossings: np.ndarray
    edge_cells: np.ndarray
    edge_vertices: np.ndarray
    dc: np.ndarray
    dv: np.ndarray
    kites: sparse.csr_array
    tangential: sparse.csr_array

    @property
    def cell_areas(self) -> np.ndarray:
        """Sums of kites, (n,)."""
        return self.kites.sum(axis=0)

    @property
    def vertex_areas(self) -> np.ndarray:
        """Sums of kites, (v,)."""
        return self.kites.sum(axis=1)

    @property
    def edge_areas(self) -> np.ndarray:
        """Area dc dv of each edge (m,), twice that of its diamond: they weight energies (R10)."""
        return self.dc * self.dv


def mesh_of(diagram: clvoro.Diagram) -> Mesh:
    """Return the C grid of a diagram on a sphere, as a model reads it from the file."""
    with tempfile.TemporaryDirectory() as folder:
        diagram.to_netcdf(path := Path(folder) / "mesh.nc", convention="mpas")
        with netcdf_file(path, mmap=False) as file:
            found = {
                name: np.array(each[:], each.data.dtype.newbyteorder("=")) for name, each in file.variables.items()
            }

    def places(what: str) -> np.ndarray:
        return unit(np.column_stack([found[f"{axis}{what}"] for axis in "xyz"]))

    def table(values: str, columns: str, width: int) -> sparse.csr_array:
        column, value = found[columns] - 1, found[values]
        row, place = np.nonzero(column >= 0)
        return sparse_matrix(value[row, place], row, column[row, place], len(value), width)

    n, m = len(found["areaCell"]), len(found["dcEdge"])
    return Mesh(
        *map(places, ("Cell", "Vertex", "Edge")),
        found["cellsOnEdge"] - 1,
        found["verticesOnEdge"] - 1,
        found["dcEdge"],
        found["dvEdge"],
        table("kiteAreasOnVertex", "cellsOnVertex", n),
        table("weightsOnEdge", "edgesOnEdge", m),
    )


def sparse_matrix(values: np.ndarray, rows: np.ndarray, columns: np.ndarray, *shape: int) -> sparse.csr_array:
    """Return a sparse matrix. With indices of 32 bits a product reads a quarter less."""
    indices = rows.astype(np.int32), columns.astype(np.int32)
    return sparse.csr_array((values, indices), shape=shape)


class Operators:
    """The discrete operators on a mesh of n cells, m edges and v vertices, as sparse matrices.

    - `div` (n, m): divergence in cells of a field normal to faces; `grad` (m, n): gradient along the normal.
    - `curl` (v, m): vorticity on vertices; `along` (m, v): gradient along the tangent.
    - `tangential` (m, m): tangential component.
    - `kinetic` (n, m): kinetic energy per mass in cells, of squared normal velocities.
    - `cell_to_edge`, `vertex_to_edge`: means of two; `cell_to_vertex`, `vertex_to_cell`: means weighted with kites.
    """

    def __init__(self, mesh: Mesh) -> None:
        n, m, v = len(mesh.points), len(mesh.dc), len(mesh.corners)
        both, signs, half = np.repeat(np.arange(m), 2), np.tile([-1.0, 1.0], m), np.full(2 * m, 0.5)
        cells, ends, area = mesh.edge_cells.ravel(), mesh.edge_vertices.ravel(), mesh.cell_areas
        self.div = sparse_matrix(-signs * mesh.dv[both] / area[cells], cells, both, n, m)
        self.grad = sparse_matrix(signs / mesh.dc[both], both, cells, m, n)
        self.curl = sparse_matrix(signs * mesh.dc[both] / mesh.vertex_areas[ends], ends, both, v, m)
        self.along = sparse_matrix(signs / mesh.dv[both], both, ends, m, v)
        self.tangential = mesh.tangential
        self.kinetic = sparse_matrix(mesh.edge_areas[both] / (4 * area[cells]), cells, both, n, m)
        self.cell_to_edge = sparse_matrix(half, both, cells, m, n)
        self.vertex_to_edge = sparse_matrix(half, both, ends, m, v)
        self.cell_to_vertex = mesh.kites.multiply(1 / mesh.vertex_areas[:, None]).tocsr()
        self.vertex_to_cell = mesh.kites.multiply(1 / area).T.tocsr()


class ShallowWater:
    """The shallow-water equations in vector-invariant form: R10, in the form that conserves energy.

    - `coriolis` (v,): Coriolis parameter f on vertices; `bottom` (n,): height of the bottom in cells.
    - `upwinding`: time in units of the step by which potential vorticity is taken from upstream (the anticipated
      potential vorticity method of R10 has 1/2); 0: none, energy is conserved.
    """

    def __init__(
        self, mesh: Mesh, gravity: float, coriolis: np.ndarray, bottom: np.ndarray, upwinding: float = 0.0
    ) -> None:
        self.mesh, self.operators = mesh, Operators(mesh)
        self.gravity, self.coriolis, self.bottom = gravity, coriolis, bottom
        self.upwinding = upwinding

    def potential_vorticity(self, h: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return (f + curl u) / h on vertices, (v,)."""
        o = self.operators
        return (self.coriolis + o.curl @ u) / (o.cell_to_vertex @ h)

    def coriolis_force(self, q: np.ndarray, flux: np.ndarray) -> np.ndarray:
        """Return the tangential flux times potential vorticity q (m,), both on edges: it does no work (R10)."""
        turn = self.operators.tangential
        return 0.5 * (q * (turn @ flux) + turn @ (q * flux))

    def tendency(self, h: np.ndarray, u: np.ndarray, dt: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return dh/dt (n,) and du/dt (m,); `dt` matters with upwinding only."""
        o = self.operators
        flux = (o.cell_to_edge @ h) * u
        vertex_q = self.potential_vorticity(h, u)
        q = o.vertex_to_edge @ vertex_q
        if self.upwinding:
            q = q - self.upwinding * dt * (
                u * (o.grad @ (o.vertex_to_cell @ vertex_q)) + (o.tangential @ u) * (o.along @ vertex_q)
            )
        bernoulli = self.gravity * (h + self.bottom) + o.kinetic @ (u * u)
        return -(o.div @ flux), self.coriolis_force(q, flux) - o.grad @ bernoulli

    def step(self, h: np.ndarray, u: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Return h and u after one step of the classical Runge-Kutta method of fourth order."""
        new_h, new_u = h.copy(), u.copy()
        dh, du = self.tendency(h, u, dt)
        for weight, reach in ((1 / 6, 0.5), (1 / 3, 0.5), (1 / 3, 1.0), (1 / 6, None)):
            new_h += weight * dt * dh
            new_u += weight * dt * du
            if reach is not None:
                dh, du = self.tendency(h + reach * dt * dh, u + reach * dt * du, dt)
        return new_h, new_u

    def stable_step(self, speed: float) -> float:
        """Return the longest step for waves of this speed: RK4's limit 2 sqrt(2) over their largest frequency.

        The frequency is speed sqrt(k), with k Gershgorin's bound of the eigenvalues of -div grad.
        """
        o = self.operators
        bound = 2 * np.abs((o.div @ o.grad).diagonal()).max()
        return 2 * np.sqrt(2) / (speed * np.sqrt(bound))

    def invariants(self, h: np.ndarray, u: np.ndarray) -> dict[str, float]:
        """Return mass, energy and potential enstrophy over the density."""
        mesh, o, g = self.mesh, self.operators, self.gravity
        kinetic = mesh.edge_areas @ ((o.cell_to_edge @ h) * u * u) / 2
        q = self.potential_vorticity(h, u)
        return {
            "mass": float(mesh.cell_areas @ h),
            "energy": float(kinetic + mesh.cell_areas @ (g * h * (h / 2 + self.bottom))),
            "enstrophy": float(mesh.vertex_areas @ ((o.cell_to_vertex @ h) * q * q) / 2),
        }


def balances(model: ShallowWater, h: np.ndarray, u: np.ndarray, seed: int = 0) -> dict[str, float]:
    """Return how well the discrete identities hold, each relative to the sum of magnitudes of its terms.

    mass_rate : sum of A dh/dt.
    coriolis_work : work of the Coriolis force.
    energy_rate : dE/dt in space: the work of the forces, and what mass carries.
    dual_divergence : curl of the tangential field of a random field, plus the mean over kites of its divergence.
    geostrophic : curl of the tangential field of a random field without divergence: where f is constant, the vorticity
    of geostrophic balance is steady (T09).
    """
    mesh, o, random = model.mesh, model.operators, np.random.default_rng(seed)
    dh, du = model.tendency(h, u)
    flux = (o.cell_to_edge @ h) * u
    q = o.vertex_to_edge @ model.potential_vorticity(h, u)
    force = model.coriolis_force(q, flux)
    bernoulli = model.gravity * (h + model.bottom) + o.kinetic @ (u * u)
    carried = mesh.cell_areas * bernoulli * dh
    through = mesh.dv * np.abs(flux)
    by_forces = mesh.edge_areas * np.abs(flux) * (np.abs(force) + np.abs(o.grad @ bernoulli))
    energy_rate = (mesh.edge_areas * flux * du).sum() + carried.sum()
    flow = random.standard_normal(len(u))
    rotating = o.along @ random.standard_normal(len(mesh.corners))

    def relative(found: np.ndarray, of: np.ndarray) -> float:
        magnitude = np.abs(o.curl) @ (np.abs(o.tangential) @ np.abs(of))
        return float((np.abs(found) / magnitude).max())

    turned = o.curl @ (o.tangential @ flow)
    return {
        "mass_rate": float(abs(mesh.cell_areas @ dh) / (2 * through.sum())),
        "coriolis_work": float(abs(mesh.edge_areas @ (flux * force)) / (mesh.edge_areas @ np.abs(flux * force))),
        "energy_rate": float(abs(energy_rate) / (by_forces.sum() + np.abs(carried).sum())),
        "dual_divergence": relative(turned + o.cell_to_vertex @ (o.div @ flow), flow),
        "geostrophic": relative(o.curl @ (o.tangential @ rotating), rotating),
    }
