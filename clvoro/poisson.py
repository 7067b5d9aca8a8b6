"""The metric correction's Poisson equation on the neighbour graph, the paper's (2.7) to (2.9)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ._program import Engine
from .coarsening import Room
from .errors import InputError
from .krylov import CURVATURE, ConjugateGradient, Launch, Solution
from .multigrid import Multigrid

_PRECONDITIONERS = ("auto", "jacobi", "multigrid")
_MULTIGRID_FROM = 2000
"""Cells from which on the multigrid's set-up pays (measured with PoCL on two cores)."""


@dataclass(frozen=True)
class Laplacian:
    """The assembled operator A = -Laplacian, symmetric to the last bit: device arrays.

    Attributes
    ----------
    starts : (n + 1,) int32
    neighbours : (m,) int32
        As the diagram's, but an entry that contributes nothing (a wall) names the cell itself.
    weights : (m,) real
        w_ij = rho_ij l_ij / d_ij; 0 at walls.
    diagonal, inverse_diagonal : (n,) real
        Row sums of the weights; the inverse of 0 is 0.
    points : (n, d) real
        The generators, for preconditioners.
    """

    starts: cla.Array
    neighbours: cla.Array
    weights: cla.Array
    diagonal: cla.Array
    inverse_diagonal: cla.Array
    points: cla.Array

    def __len__(self) -> int:
        return len(self.diagonal)


class Poisson:
    """Assembles and solves A phi = b with zero flux through the walls.

    Parameters
    ----------
    engine : Engine
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("poisson")
        self._krylov = ConjugateGradient(engine)
        self._multigrid: Multigrid | None = None
        self._prepared: Laplacian | None = None
        self._room = Room(engine)

    def assemble(
        self,
        starts: cla.Array,
        neighbours: cla.Array,
        face_measures: cla.Array,
        points: cla.Array,
        density: cla.Array | None = None,
    ) -> Laplacian:
        """Build (A phi)_i = sum_j w_ij (phi_i - phi_j), w_ij = rho_ij l_ij / |x_i - x_j|.

        Parameters
        ----------
        starts : (n + 1,) int32
        neighbours : (m,) int32
            Negative entries are walls.
        face_measures : (m,) real
        points : (n, d) real
            Generators.
        density : (n,) real, optional
            rho > 0; rho_ij is the geometric mean. Without it rho = 1.

        Returns
        -------
        Laplacian
            Its arrays are used again by the next call.
        """
        engine = self.engine
        n = len(starts) - 1
        _check("points", points, (n, engine.dim))
        _check("face_measures", face_measures, neighbours.shape)
        if density is not None:
            _check("density", density, (n,))
        m, room = len(neighbours), self._room
        columns, weights = room("columns", size=m, dtype=np.int32), room("weights", size=m)
        diagonal, inverse = room("diagonal", size=n), room("inverse", size=n)
        engine.run(
            self._kernels.assemble, n, np.int32(n), np.int32(density is not None), starts,
            neighbours, face_measures, points, points if density is None else density, columns,
            weights, diagonal, inverse,
        )  # fmt: skip
        return Laplacian(starts, columns, weights, diagonal, inverse, points)

    def compatible(self, source: cla.Array, volumes: cla.Array, rhs: cla.Array) -> cla.Array:
        """Set rhs_i = V_i (s_i - mean s), the mean weighted by volume, so that its sum is 0.

        Parameters
        ----------
        source, volumes, rhs : (n,) real
            s, V, and where the result goes (also returned).
        """
        size = np.int32(len(rhs))
        partial = self._krylov.partial
        self.engine.run_blocks(self._kernels.source_sums, size, source, volumes, partial)
        self.engine.run_blocks(self._kernels.compatible, size, source, volumes, rhs, partial)
        return rhs

    def apply(self, laplacian: Laplacian, x: cla.Array, y: cla.Array) -> None:
        """Enqueue y = A x."""
        self.engine.run_blocks(self._kernels.apply, *self._arguments(laplacian, x, y))

    def set_up_multigrid(self, laplacian: Laplacian) -> Multigrid:
        """Make the preconditioner for `laplacian` unless it was made last; `solve` does so."""
        if self._multigrid is None:
            self._multigrid = Multigrid(self.engine)
        if self._prepared is not laplacian:
            self._multigrid.set_up(laplacian.starts, laplacian.neighbours, laplacian.weights)
            self._prepared = laplacian
        return self._multigrid

    def solve(
        self,
        laplacian: Laplacian,
        rhs: cla.Array,
        potential: cla.Array,
        *,
        tolerance: float = 1e-8,
        max_iterations: int | None = None,
        preconditioner: str = "auto",
    ) -> Solution:
        """Solve A phi = b, the paper's (2.9); phi has mean zero.

        Parameters
        ----------
        laplacian : Laplacian
        rhs : (n,) real
            Its mean is taken away, as the operator's null space is the constants; see `compatible`.
        potential : (n,) real
            Start on entry (zeros, or the last step's), phi on return.
        tolerance : float
            Of the relative residual. In float32 about 1e-5 can be had, less on large meshes with a
            smooth right side: the solve then ends as ``"stagnated"``, with the residual reached.
        max_iterations : int, optional
        preconditioner : ``"auto"``, ``"jacobi"`` or ``"multigrid"``
            Multigrid leaves 15 to 20 iterations whatever the size; its set-up costs about as much
            as five of them. ``"auto"`` takes it from 2000 cells on.

        Returns
        -------
        Solution

        Raises
        ------
        InputError
            If an argument has the wrong size or value.
        SolverError
            If the iteration breaks down.
        """
        n = len(laplacian)
        _check("rhs", rhs, (n,))
        _check("potential", potential, (n,))
        if preconditioner not in _PRECONDITIONERS:
            raise InputError(
                f"preconditioner got {preconditioner!r}, expected one of {_PRECONDITIONERS}"
            )
        if not tolerance > 0:
            raise InputError(f"tolerance got {tolerance!r}, expected a number > 0, such as 1e-8")
        if preconditioner == "multigrid" or (preconditioner == "auto" and n >= _MULTIGRID_FROM):
            multigrid = self.set_up_multigrid(laplacian)
            precondition, lookahead, most = multigrid.apply, 4, 200
        else:
            precondition, lookahead, most = laplacian.inverse_diagonal, 64, 500 + 30 * math.isqrt(n)
        return self._krylov.solve(
            self._operator(laplacian),
            rhs,
            potential,
            precondition=precondition,
            tolerance=tolerance,
            max_iterations=most if max_iterations is None else max_iterations,
            fused=True,
            centre=True,
            lookahead=lookahead,
        )

    def _operator(self, laplacian: Laplacian) -> Callable[[cla.Array, cla.Array], None]:
        """Return `apply` for one operator; it sets the kernel's arguments when they change only."""
        last: list = [None, None, None]

        def apply(x: cla.Array, y: cla.Array) -> None:
            if last[0] is not x or last[1] is not y:
                last[:] = (
                    x,
                    y,
                    Launch(self.engine, self._kernels.apply, *self._arguments(laplacian, x, y)),
                )
            last[2]()

        return apply

    def _arguments(self, laplacian: Laplacian, x: cla.Array, y: cla.Array) -> tuple:
        return (
            np.int32(len(laplacian)), np.int32(CURVATURE), laplacian.starts, laplacian.neighbours,
            laplacian.weights, x, y, self._krylov.partial,
        )  # fmt: skip


def _check(name: str, array: cla.Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise InputError(f"{name} got shape {array.shape}, expected {shape}")
