"""The number of generators in each part of a domain (`local_counts.cl`).

A slot or an arm of a polygon may have too many generators, and the next one too few, although their sum is right. To
even this out by displacements, whole cells would have to pass through the narrow parts between them. So generators are
inserted and deleted instead, where this saves the most displacement.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import count
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cla

from ..opencl.device_array import read_numbers
from ..opencl.engine import Engine
from ..opencl.workspace import framed
from ..solvers.components import Components, balance_components
from . import tuning
from .density import CellWeights

if TYPE_CHECKING:
    from ..geometry.domain import Domain
    from ..tessellation.device_diagram import Tessellation
    from .insertion_deletion import Present
    from .stages import Stages
    from .state import MeshState


def offset_of(missing: np.ndarray | float, cells: np.ndarray | float) -> np.ndarray:
    """Return the offset of the potential in a piece that has `cells` cells and lacks `missing` more."""
    each = np.clip(tuning.PIECE / cells, tuning.LEAST_OFFSET, tuning.LEAST_GAIN)
    return np.clip(each * missing, -tuning.LARGEST_OFFSET, tuning.LARGEST_OFFSET)


class PieceCounts:
    """The pieces of a domain, and how many cells each of them requires.

    The potential of each piece has a free constant, which is set here. The work is done on the host.
    """

    def __init__(self, engine: Engine, t: Tessellation, w: CellWeights) -> None:
        self._components = Components(engine, t)
        self._cells, self._required = self._components.sums(None, w.weight)

    def offset(self, potential: cla.Array, changes: cla.Array) -> None:
        """Shift `potential` (n,) in each piece so that its mean is the offset, after `changes` (n,) int32."""
        values = potential.get()
        changed, sums = self._components.sums(changes, values)
        missing, means = self._required - self._cells - changed, sums / self._cells
        shifted = values + (offset_of(missing, self._cells) - means)[self._components.of_cell]
        potential.set(shifted.astype(values.dtype))


class LocalCounts:
    """The kernels of `local_counts.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/local_counts")
        self._accepted = engine.empty(2, np.int32)

    def choose(self, mesh: MeshState, w: CellWeights, changes: cla.Array) -> bool:
        """Write to `changes` (n,) int32 where to insert (1) and where to delete (-1); return whether it is anywhere.

        Each round takes the sites where the potential is largest, solves for the potential after changes there, and
        accepts those that gain enough. Of few cells part 0 does this for all parts.
        """
        present, peers, missing = mesh.present, self.engine.peers, mesh.missing_cells(w)
        ghosts = None if present.t.part is None else present.t.part.ghosts
        if peers.count == 1 or ghosts is None or mesh.total > tuning.BALANCED_ALONE:
            return self._choose(mesh.stages, mesh.domain, present, w, missing, changes)
        t, sizes, found = present.t, np.array(peers.gather(np.array(mesh.n))), np.empty(0, np.int32)
        starts, rows = t.starts.get(), ghosts.rows_of_all(sizes)
        columns, measures = (array.get()[: starts[-1]] for array in (t.neighbors, t.face_measures))
        columns = np.where(columns < 0, columns, rows[np.maximum(columns, 0)]).astype(np.int32)
        own = (array.get()[: mesh.n] for array in (t.points, present.generators.labels, w.weight, w.log_ratio))
        of_all = [peers.collect(array) for array in (np.diff(starts), columns, measures, *own)]
        if peers.number == 0:
            counts, *given = (np.concatenate(arrays) for arrays in of_all)
            found = _choose_alone(mesh, missing, np.append(0, np.cumsum(counts)).astype(np.int32), *given)
        slices = np.split(found, np.cumsum(sizes)[:-1]) if len(found) else [found] * peers.count
        changes.set(peers.exchange(slices)[0])
        return peers.any(bool(found.any()))

    @framed
    def _choose(
        self, stages: Stages, domain: Domain, present: Present, w: CellWeights, missing: float, changes: cla.Array
    ) -> bool:
        """Do this with `stages` of this engine, where `missing` cells are missing over all parts."""
        engine, k, t, poisson = self.engine, self._kernels, present.t, stages.poisson
        selection, real, n, most = stages.insertion_deletion, engine.real.type, t.n, int(engine.peers.total(t.n))
        potential, before, source = (engine.scratch(n) for _ in range(3))
        chosen, blocked, keys = (engine.scratch(t.rows, np.uint64) for _ in range(3))
        for array in (potential, changes, chosen, blocked):
            array.fill(0)
        total = 0
        pieces = PieceCounts(engine, t, w) if domain.n_pieces > 1 else None
        graph = *t.graph, t.face_measures, t.points
        laplacian = poisson.assemble(*graph, tolerance=tuning.BALANCE_TOLERANCE, part=t.part)
        for turn in count():
            offset = real(offset_of(missing, math.inf) if pieces is None else 0)
            if turn:
                if pieces is not None:
                    pieces.offset(potential, changes)
                gains = w.log_ratio, potential, offset, real(tuning.LEAST_GAIN)
                away = selection.spread(t, blocked, tuning.BLOCKED_RINGS)
                engine.run_each(k.score_potential, n, *t.graph, *gains, away, *t.name_args, keys)
                chosen = selection.choose_once(present, keys, tuning.SITE_RINGS)
            engine.run_each(k.try_changes, n, w.weight, changes, chosen, potential, offset, before, source)
            balance_components(engine, domain, t, source, w.weight)
            poisson.solve(
                laplacian,
                source,
                potential,
                tolerance=tuning.BALANCE_TOLERANCE,
                preconditioner="multigrid",
                from_zero=turn == 0,
            )
            if turn == 0:
                continue
            if pieces is not None:
                pieces.offset(potential, changes)
            self._accepted.fill(0)
            gains = chosen, before, potential, offset, real(tuning.LEAST_GAIN)
            found = changes, blocked, self._accepted
            engine.run_each(k.accept_changes, n, *gains, *found)
            inserted, deleted = map(int, engine.peers.total(read_numbers(self._accepted, 0, 2)))
            missing, total = missing - inserted + deleted, total + inserted + deleted
            if inserted + deleted <= tuning.LEAST_CHANGES * most:
                break
        return total > 0

    def sites(self, changes: cla.Array, sign: int) -> cla.Array:
        """Return 1 where `changes` (n,) have this sign, and 0 elsewhere: (n,) uint64 in the workspace."""
        found = self.engine.scratch(len(changes), np.uint64)
        self.engine.run_each(self._kernels.select_changes, len(changes), changes, np.int32(sign), found)
        return found


def _choose_alone(mesh: MeshState, missing: float, *of_all: np.ndarray) -> np.ndarray:
    """Return what `LocalCounts.choose` writes, for the cells of all parts.

    `of_all` are, for these cells: starts, neighbors and face measures, as of a diagram, positions and labels of the
    generators, `CellWeights.weight` and `log_ratio`.
    """
    engine = mesh.engine.alone()
    starts, neighbors, measures, points, labels, weight, log_ratio = (engine.upload(a, a.dtype) for a in of_all)
    stages, changes = mesh.setup.on(engine).stages, engine.empty(len(labels), np.int32)
    n, faces = len(labels), {"starts": starts, "neighbors": neighbors, "face_measures": measures}
    assert mesh.t.part is not None
    # What is not replaced is not used.
    part = replace(mesh.t.part, n_own=n, count=n, points=points, ghosts=None, labels=labels)
    t = replace(mesh.t, n=n, points=points, part=part, whole=None, **faces)
    present = replace(mesh.present, t=t, generators=replace(mesh.present.generators, labels=labels))
    w = CellWeights(weight, weight, log_ratio)
    stages.local_counts._choose(stages, mesh.domain, present, w, missing, changes)
    return changes.get()
