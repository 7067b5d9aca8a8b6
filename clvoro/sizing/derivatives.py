"""Gradients and Hessians of cell data on the neighbor graph of a mesh, on the device (`derivatives.cl`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..arguments import check_cell_values
from ..connectivity import rows_of, starts_of
from ..errors import InputTypeError
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from ..opencl.engine import Engine
from .graded import default_engine

_SMALLEST_PIVOT = {np.dtype(np.float64): 1e-10, np.dtype(np.float32): 1e-4}


@dataclass(frozen=True)
class CellStencils:
    """The centroids of a mesh and their graph, without walls."""

    mesh: Diagram
    starts: np.ndarray
    neighbors: np.ndarray
    """`starts`, `neighbors`: (n + 1,), (m,) int32."""
    across: np.ndarray
    """(m, d) float64. Vectors between the centroids of neighbors, across seams, too."""
    at_wall: np.ndarray
    """(n,) bool."""

    @classmethod
    def of(cls, mesh: object) -> CellStencils:
        """Return those of a `Result` or a `Diagram`.

        Raises
        ------
        InputTypeError
            If it is neither.
        """
        diagram = mesh.diagram if isinstance(mesh, Result) else mesh
        if not isinstance(diagram, Diagram):
            raise InputTypeError(f"on is a {type(mesh).__name__}, expected a clvoro.Result or a clvoro.Diagram")
        known = vars(diagram).get("_stencils")
        return known or vars(diagram).setdefault("_stencils", cls._make(diagram))

    @classmethod
    def _make(cls, mesh: Diagram) -> CellStencils:
        n, row = len(mesh), mesh.half_faces.owner
        inner = mesh.neighbors >= 0
        own, other = row[inner], mesh.neighbors[inner]
        # The image of a neighbor's generator is beside this cell, and so is the image of its centroid.
        across = mesh.centroids[other] + mesh.shifts[inner] * mesh.domain.extent - mesh.centroids[own]
        starts = starts_of(np.bincount(own, minlength=n))
        walls = np.bincount(row[~inner], minlength=n) > 0
        return cls(mesh, starts.astype(np.int32), other.astype(np.int32), across, walls)

    def __len__(self) -> int:
        return len(self.at_wall)

    @cached_property
    def owners(self) -> np.ndarray:
        """The cell of each entry of `neighbors`, (m,)."""
        return rows_of(self.starts)

    @cached_property
    def lengths(self) -> np.ndarray:
        """Distances of neighbors, (m,)."""
        return np.linalg.norm(self.across, axis=1)

    def bounds(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the largest of `values` (n,) in each cell and its neighbors."""
        low, high = values.copy(), values.copy()
        there = values[self.neighbors]
        np.minimum.at(low, self.owners, there)
        np.maximum.at(high, self.owners, there)
        return low, high

    def smooth(self, values: np.ndarray, passes: int) -> np.ndarray:
        """Return the mean of each of `values` (n, ...) and the mean of its neighbors, `passes` times."""
        n, count = len(self), np.diff(self.starts)
        mean = scipy.sparse.csr_array(
            (np.repeat(0.5 / np.maximum(count, 1), count), self.neighbors, self.starts), (n, n)
        )
        mean += scipy.sparse.diags_array(np.where(count > 0, 0.5, 1.0))
        flat = values.reshape(n, -1)
        for _ in range(passes):
            flat = mean @ flat
        return flat.reshape(values.shape)

    @cached_property
    def _graph(self) -> scipy.sparse.csr_array:
        """The graph with distances, and one more row and column for a source of all cells."""
        n = len(self)
        starts = np.concatenate([self.starts, [len(self.neighbors) + n]])
        columns = np.concatenate([self.neighbors, np.arange(n)])
        return scipy.sparse.csr_array(
            (np.concatenate([self.lengths, np.ones(n)]), columns, starts), shape=(n + 1, n + 1)
        )

    def limit_growth(self, sizes: np.ndarray, slope: float) -> np.ndarray:
        """Return the largest values below `sizes` (n,) > 0 that differ by `slope` times the way between two cells.

        The way leads from neighbor to neighbor, around walls.
        """
        graph, n = self._graph, len(self)
        ways = slope * self.lengths
        graph.data = np.concatenate([np.maximum(ways, 1e-300), sizes])
        return scipy.sparse.csgraph.dijkstra(graph, indices=n)[:n]


def derivatives(values: ArrayLike, on: Result | Diagram) -> tuple[np.ndarray, np.ndarray]:
    """Return the gradients and the Hessians of cell data.

    A quadratic function is fitted to each cell, its neighbors and, with little weight, their neighbors, by weighted
    least squares on the device. It is exact for quadratic functions, in cells at walls, too. On smooth data gradients
    are of second order, and Hessians of first order, or better where the mesh is regular. Across a jump both are at
    most about that of the jump over one cell.

    Parameters
    ----------
    values : (n,) or (n, k) array of float
        Means over the cells.
    on : Result or Diagram
        The mesh, in any domain.

    Returns
    -------
    gradients : (n, d) or (n, k, d) float64
        In the unit of the values over that of the domain. On a sphere they are tangent to it.
    hessians : (n, d, d) or (n, k, d, d) float64
        Symmetric.

    Raises
    ------
    InputError, InputTypeError
        If there is not a row of finite numbers for each cell.

    Examples
    --------
    >>> mesh = clvoro.adapt(clvoro.Box((0, 0), (1, 1)), 0.1, "fast")
    >>> x, y = mesh.centroids.T
    >>> g, h = clvoro.sizing.derivatives(3 * x**2 - x * y, on=mesh)
    >>> h[0].round(6).tolist()
    [[6.0, -1.0], [-1.0, 0.0]]
    """
    stencils = CellStencils.of(on)
    given = check_cell_values("values", values, len(stencils))
    columns = given.reshape(len(given), -1)
    domain = stencils.mesh.domain
    engine = default_engine(domain.dim)
    # Numbers around 1 neither overflow nor underflow in any precision.
    unit = domain.frame[1]
    scale = np.maximum(np.ptp(columns, axis=0), 1e-300)
    gradients, hessians = Derivatives(engine, domain.cell_dim < domain.dim).fit_quadratics(
        stencils, (columns - columns.mean(axis=0)) / scale, unit
    )
    d, shape = domain.dim, given.shape
    gradients *= scale[:, None] / unit
    hessians *= scale[:, None, None] / unit**2
    return gradients.reshape(*shape, d), hessians.reshape(*shape, d, d)


class Derivatives:
    """Fits polynomials to cell data, for cells in flat space or on a sphere."""

    def __init__(self, engine: Engine, on_sphere: bool) -> None:
        self.engine = engine
        defines: dict[str, object] = {"SMALLEST_PIVOT": repr(_SMALLEST_PIVOT[engine.real])}
        self._kernels = engine.kernels("sizing/derivatives", defines | ({"SPHERE": 1} if on_sphere else {}))

    def fit_quadratics(self, stencils: CellStencils, values: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray]:
        """Return gradients (n, k, d) and Hessians (n, k, d, d) of `values` (n, k), with lengths in `unit`."""
        engine, d, (n, width) = self.engine, self.engine.dim, values.shape
        gradients, hessians = engine.empty((n, width, d)), engine.empty((n, width, d, d))
        lists = engine.upload(stencils.starts, np.int32), engine.upload(stencils.neighbors, np.int32)
        places = engine.upload(stencils.across / unit), engine.upload(stencils.mesh.centroids / unit)
        found = np.int32(width), engine.upload(values), gradients, hessians
        engine.run_each(self._kernels.fit_quadratics, n, *lists, *places, *found)
        return gradients.get().astype(float), hessians.get().astype(float)
