"""The number of generators in each part of a domain (`local_counts.cl`).

A slot or an arm of a polygon may have too many generators, and the next one too few, although their sum is right. To
even this out by displacements, whole cells would have to pass through the narrow parts between them. So generators are
inserted and deleted instead, where this saves the most displacement.
"""

from __future__ import annotations

import math
from itertools import count
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cla

from ..opencl.device_array import read_numbers
from ..opencl.engine import Engine
from ..opencl.workspace import framed
from ..solvers.components import balance_components, connected_components

if TYPE_CHECKING:
    from .density import CellWeights
    from .state import MeshState

LEAST_GAIN = 2.0
"""Half the sum of |u|^2 / h^2 over the cells that an insertion or deletion must save. With 1 to 4 the motor and the
river of `bench/solver_ready.py`, exact, have no squeezed cells at walls (by a prototype in NumPy, two starts each). In
most open domains there is no site where 2 is to be gained."""
SITE_RINGS, BLOCKED_RINGS = 12, 3
"""Least number of rings of cells between two sites of the same round, and of different rounds. With 6 or 8 rings there
are up to 1.2 times as many changes, some of which undo others. Where a part lacks more cells than there is room for,
the next balance adds them, when cells have moved."""
LEAST_CHANGES = 1e-4
"""Share of the cells that a round has to insert or delete, if there is to be another one. With at most 30 rounds, 239,
533 and 529 cells at walls of Lake Huron, Chesapeake Bay and Stockholm in `bench/coasts.py`, exact, have Q below 0.75,
now 7, 64 and 165. Rounds until no site gains enough take 1.5 times as long in Chesapeake Bay, for as many cells."""
LEAST_OFFSET, PIECE, LARGEST_OFFSET = 0.25, 900.0, 3.0
"""The offset of the potential for each cell that a piece of the domain lacks is `PIECE` over the number of its cells,
at least `LEAST_OFFSET` and at most `LEAST_GAIN`. In domains of one piece it is `LEAST_OFFSET`. The whole offset is at
most `LARGEST_OFFSET`. It favors insertions: in a piece of few cells each missing cell is inserted; elsewhere eight may
be missing."""
TOLERANCE = 3e-2
"""Relative residual of the potential. Solves take 0.7 times the time of 1e-2, for as many squeezed cells."""


def offset_of(missing: np.ndarray | float, cells: np.ndarray | float) -> np.ndarray:
    """Return the offset of the potential in a piece that has `cells` cells and lacks `missing` more."""
    each = np.clip(PIECE / cells, LEAST_OFFSET, LEAST_GAIN)
    return np.clip(each * missing, -LARGEST_OFFSET, LARGEST_OFFSET)


class PieceCounts:
    """The pieces of a domain, and how many cells each of them requires.

    The potential of each piece has a free constant, which is set here. The work is done on the host.
    """

    def __init__(self, mesh: MeshState, w: CellWeights) -> None:
        self._piece = connected_components(mesh.t)
        self._cells = np.bincount(self._piece)
        self._required = np.bincount(self._piece, w.weight.get())

    def offset(self, potential: cla.Array, changes: cla.Array) -> None:
        """Shift `potential` (n,) in each piece so that its mean is the offset, after `changes` (n,) int32."""
        values, piece = potential.get(), self._piece
        missing = self._required - self._cells - np.bincount(piece, changes.get())
        means = np.bincount(piece, values) / self._cells
        shifted = values + (offset_of(missing, self._cells) - means)[piece]
        potential.set(shifted.astype(values.dtype))


class LocalCounts:
    """The kernels of `local_counts.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/local_counts")
        self._accepted = engine.empty(2, np.int32)

    @framed
    def choose(self, mesh: MeshState, w: CellWeights, changes: cla.Array) -> bool:
        """Write to `changes` (n,) int32 where to insert (1) and where to delete (-1); return whether it is anywhere.

        Each round takes the sites where the potential is largest, solves for the potential after changes there, and
        accepts those that gain enough.
        """
        engine, k, n, t, poisson = self.engine, self._kernels, mesh.n, mesh.t, mesh.stages.poisson
        selection, real = mesh.stages.insertion_deletion, engine.real.type
        potential, before, source = (engine.scratch(n) for _ in range(3))
        chosen, blocked, keys = (engine.scratch(n, np.uint64) for _ in range(3))
        for array in (potential, changes, chosen, blocked):
            array.fill(0)
        missing, total = mesh.missing_cells(w), 0
        pieces = PieceCounts(mesh, w) if mesh.domain.n_pieces > 1 else None
        laplacian = poisson.assemble(t.starts, t.neighbors, t.face_measures, mesh.points, tolerance=TOLERANCE)
        for turn in count():
            offset = real(offset_of(missing, math.inf) if pieces is None else 0)
            if turn:
                if pieces is not None:
                    pieces.offset(potential, changes)
                engine.run_each(
                    k.score_potential,
                    n,
                    t.starts,
                    t.neighbors,
                    w.log_ratio,
                    potential,
                    offset,
                    real(LEAST_GAIN),
                    selection.spread(t, blocked, BLOCKED_RINGS),
                    keys,
                )
                chosen = selection.choose_once(t, keys, SITE_RINGS, mesh.labels, mesh.fixed)
            engine.run_each(k.try_changes, n, w.weight, changes, chosen, potential, offset, before, source)
            balance_components(mesh.domain, t, source, w.weight)
            poisson.solve(
                laplacian, source, potential, tolerance=TOLERANCE, preconditioner="multigrid", from_zero=turn == 0
            )
            if turn == 0:
                continue
            if pieces is not None:
                pieces.offset(potential, changes)
            self._accepted.fill(0)
            engine.run_each(
                k.accept_changes,
                n,
                chosen,
                before,
                potential,
                offset,
                real(LEAST_GAIN),
                changes,
                blocked,
                self._accepted,
            )
            inserted, deleted = map(int, read_numbers(self._accepted, 0, 2))
            missing, total = missing - inserted + deleted, total + inserted + deleted
            if inserted + deleted <= LEAST_CHANGES * n:
                break
        return total > 0

    def sites(self, changes: cla.Array, sign: int) -> cla.Array:
        """Return 1 where `changes` (n,) have this sign, and 0 elsewhere: (n,) uint64 in the workspace."""
        found = self.engine.scratch(len(changes), np.uint64)
        self.engine.run_each(self._kernels.select_changes, len(changes), changes, np.int32(sign), found)
        return found
