"""The TRiSK scheme on a diagram on a sphere: metric terms, operators as sparse matrices, shallow-water equations.

Sources: Thuburn, Ringler, Skamarock and Klemp 2009, J. Comput. Phys. 228, 8321 (T09), for the tangential velocity;
Ringler, Thuburn, Klemp and Skamarock 2010, J. Comput. Phys. 229, 3065 (R10), for the nonlinear equations.

Mass is in cells, the velocity normal to the faces on edges, and vorticity on vertices. The normal of an edge leads from
its first cell to its second; its tangent, 90 degrees counter-clockwise from the normal, from its first vertex to its
second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

import clvoro

SHORTEST_EDGE = 1e-9
"""Least ratio of the length of a face to the distance of its generators: below, gradients along faces are round-off."""


def signed_areas(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the areas (n,) of triangles on the unit sphere, positive if counter-clockwise from outside.

    The formula of Van Oosterom and Strackee 1983, with differences in the numerator, so that small triangles keep
    their digits.
    """
    volume = np.einsum("ij,ij->i", a, np.cross(b - a, c - a))
    dots = (np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (b, c), (c, a)))
    return 2 * np.arctan2(volume, 1 + sum(dots))


def arcs(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles (n,) between unit vectors (n, 3)."""
    return 2 * np.arcsin(np.linalg.norm(a - b, axis=1) / 2)


def unit(x: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) divided by their lengths."""
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def pair_half_faces(cells: np.ndarray, neighbors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for each edge its half-face of the lower cell (m,), and for each half-face its edge and its sign (2 m,).

    The sign is 1 on the half-face whose cell is the edge's first.

    Raises
    ------
    ValueError
        If a half-face has no twin, or two cells share more than one face.
    """
    low, high = np.minimum(cells, neighbors), np.maximum(cells, neighbors)
    order = np.lexsort((cells, high, low))
    first, second = order[::2], order[1::2]
    twins = (low[first] == low[second]) & (high[first] == high[second])
    twins &= cells[first] != cells[second]
    repeated = (low[first][1:] == low[first][:-1]) & (high[first][1:] == high[first][:-1])
    if not twins.all() or repeated.any():
        raise ValueError(
            "a face has no twin, or two cells share several faces; expected one face for each pair of neighbors: "
            "use a mesh of more cells"
        )
    edge_of, sign = np.empty(len(cells), int), np.empty(len(cells))
    edge_of[first] = edge_of[second] = np.arange(len(first))
    sign[first], sign[second] = 1, -1
    return first, edge_of, sign


@dataclass(frozen=True)
class Mesh:
    """Metric terms of the C grid; n cells, m edges, v vertices. Lengths in the unit of `radius`.

    Attributes
    ----------
    radius : float
    points, corners, crossings : (n, 3), (v, 3) and (m, 3) float arrays
        Unit vectors: generators, vertices, and middles of the arcs between two generators, where these cross the great
        circles of the faces.
    starts, edge_of, sign : (n + 1,), (2 m,) and (2 m,) arrays
        The half-faces of cell i are starts[i] to starts[i + 1], counter-clockwise: their edges, and 1 where the normal
        points out of the cell, else -1.
    edge_cells, edge_vertices : (m, 2) int arrays
    dc, dv : (m,) float arrays
        Arc between the generators, and length of the face.
    corner_vertex, kites : (2 m,) arrays
        Corner k is the begin of half-face k: its vertex, and the area that its cell and the vertex share.
    cell_areas, vertex_areas : (n,) and (v,) float arrays
        Sums of kites.
    """

    radius: float
    points: np.ndarray
    corners: np.ndarray
    crossings: np.ndarray
    starts: np.ndarray
    edge_of: np.ndarray
    sign: np.ndarray
    edge_cells: np.ndarray
    edge_vertices: np.ndarray
    dc: np.ndarray
    dv: np.ndarray
    corner_vertex: np.ndarray
    kites: np.ndarray
    cell_areas: np.ndarray
    vertex_areas: np.ndarray

    @property
    def half_cell(self) -> np.ndarray:
        """Cell of each half-face and corner, (2 m,)."""
        return np.repeat(np.arange(len(self.points)), np.diff(self.starts))

    @property
    def edge_areas(self) -> np.ndarray:
        """Area dc dv of each edge (m,), twice that of its diamond: they weight energies (R10)."""
        return self.dc * self.dv


def next_in_cell(starts: np.ndarray, step: int = 1) -> np.ndarray:
    """Return for each half-face the one `step` further counter-clockwise in the same cell, (2 m,)."""
    sides = np.diff(starts)
    begin, count = np.repeat(starts[:-1], sides), np.repeat(sides, sides)
    return begin + (np.arange(starts[-1]) - begin + step) % count


def mesh_of(diagram: clvoro.Diagram) -> Mesh:
    """Return the metric terms of a diagram on a sphere.

    Raises
    ------
    ValueError
        If the domain is no sphere, a vertex has other than three cells, two cells share several faces, or a face is
        shorter than `SHORTEST_EDGE` times the distance of its generators.
    """
    if not isinstance(diagram.domain, clvoro.Sphere):
        raise ValueError(f"got a diagram on a {type(diagram.domain).__name__}, expected a Sphere")
    radius = diagram.domain.radius
    points, corners = unit(diagram.points), unit(diagram.vertices)
    starts = np.asarray(diagram.neighbor_starts, int)
    vertex = np.asarray(diagram.cell_vertices, int)
    if not (np.bincount(vertex, minlength=len(corners)) == 3).all():
        raise ValueError("a vertex has other than three cells; expected generators in general position")
    cells, neighbors = np.repeat(np.arange(len(points)), np.diff(starts)), diagram.neighbors
    first, edge_of, sign = pair_half_faces(cells, np.asarray(neighbors, int))
    after = next_in_cell(starts)
    edge_cells = np.column_stack([cells[first], neighbors[first]])
    edge_vertices = np.column_stack([vertex[first], vertex[after][first]])
    crossings = unit(points[edge_cells].sum(axis=1))
    dc = radius * arcs(*points[edge_cells.T])
    dv = radius * arcs(*corners[edge_vertices.T])
    if (dv < SHORTEST_EDGE * dc).any():
        raise ValueError(f"a face is shorter than {SHORTEST_EDGE:g} of the distance of its generators")

    # A kite is two triangles: from the crossing of the face that ends at the corner, and of the one that begins there.
    x, middle = points[cells], crossings[edge_of]
    kites = signed_areas(x, corners[vertex], middle)
    np.add.at(kites, after, signed_areas(x, middle, corners[vertex[after]]))
    kites *= radius**2
    return Mesh(
        radius,
        points,
        corners,
        crossings,
        starts,
        edge_of,
        sign,
        edge_cells,
        edge_vertices,
        dc,
        dv,
        vertex,
        kites,
        np.add.reduceat(kites, starts[:-1]),
        np.bincount(vertex, kites),
    )


def sparse_matrix(values: np.ndarray, rows: np.ndarray, columns: np.ndarray, *shape: int) -> sparse.csr_array:
    """Return a sparse matrix. With indices of 32 bits a product reads a quarter less."""
    indices = rows.astype(np.int32), columns.astype(np.int32)
    return sparse.csr_array((values, indices), shape=shape)


def tangential(mesh: Mesh) -> sparse.csr_array:
    """Return the matrix (m, m) from normal to tangential components of a field on edges (T09).

    From edge e go counter-clockwise around one of its two cells to edge e', over kites of the shares R of the cell:
    the weight is +-(1/2 - sum R) dv(e') / dc(e), positive if both normals point out of the cell or both into it.
    """
    sides = np.diff(mesh.starts)
    count = np.repeat(sides, sides)
    share = mesh.kites / mesh.cell_areas[mesh.half_cell]
    half, passed = np.arange(len(count)), np.zeros(len(count))
    rows, columns, weights = [], [], []
    for step in range(1, int(sides.max())):
        other = next_in_cell(mesh.starts, step)
        passed = passed + share[other]
        used = half[count > step]
        rows.append(mesh.edge_of[used])
        columns.append(mesh.edge_of[other[used]])
        weights.append(mesh.sign[used] * mesh.sign[other[used]] * (0.5 - passed[used]))
    row, column = np.concatenate(rows), np.concatenate(columns)
    value = np.concatenate(weights) * mesh.dv[column] / mesh.dc[row]
    return sparse_matrix(value, row, column, len(mesh.dc), len(mesh.dc))


class Operators:
    """The discrete operators on a mesh of n cells, m edges and v vertices, as sparse matrices.

    Attributes
    ----------
    div : (n, m)
        Divergence in cells of a field normal to faces.
    grad : (m, n)
        Gradient along the normal.
    curl : (v, m)
        Vorticity on vertices.
    tangential : (m, m)
        Tangential component, see `tangential`.
    kinetic : (n, m)
        Kinetic energy per mass in cells, of squared normal velocities.
    cell_to_edge, vertex_to_edge : (m, n), (m, v)
        Means of two.
    cell_to_vertex, vertex_to_cell : (v, n), (n, v)
        Means weighted with kites.
    along : (m, v)
        Gradient along the tangent.
    """

    def __init__(self, mesh: Mesh) -> None:
        n, m, v = len(mesh.points), len(mesh.dc), len(mesh.corners)
        cell, edge, edges = mesh.half_cell, mesh.edge_of, np.arange(m)
        both = np.repeat(edges, 2)
        signs = np.tile([-1.0, 1.0], m)

        pairs, ends = mesh.edge_cells.ravel(), mesh.edge_vertices.ravel()
        area = mesh.cell_areas[cell]
        self.div = sparse_matrix(mesh.sign * mesh.dv[edge] / area, cell, edge, n, m)
        self.grad = sparse_matrix(signs / mesh.dc[both], both, pairs, m, n)
        self.curl = sparse_matrix(signs * mesh.dc[both] / mesh.vertex_areas[ends], ends, both, v, m)
        self.along = sparse_matrix(signs / mesh.dv[both], both, ends, m, v)
        self.tangential = tangential(mesh)
        self.kinetic = sparse_matrix(mesh.edge_areas[edge] / (4 * area), cell, edge, n, m)
        half = np.full(2 * m, 0.5)
        self.cell_to_edge = sparse_matrix(half, both, pairs, m, n)
        self.vertex_to_edge = sparse_matrix(half, both, ends, m, v)
        vertex = mesh.corner_vertex
        self.cell_to_vertex = sparse_matrix(mesh.kites / mesh.vertex_areas[vertex], vertex, cell, v, n)
        self.vertex_to_cell = sparse_matrix(mesh.kites / area, cell, vertex, n, v)


class ShallowWater:
    """The shallow-water equations in vector-invariant form: R10, in the form that conserves energy.

    Parameters
    ----------
    mesh : Mesh
    gravity : float
    coriolis : (v,) float array
        Coriolis parameter f on vertices.
    bottom : (n,) float array
        Height of the bottom in cells.
    upwinding : float
        Time in units of the step by which potential vorticity is taken from upstream (the anticipated potential
        vorticity method of R10 has 1/2); 0: none, energy is conserved.
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
