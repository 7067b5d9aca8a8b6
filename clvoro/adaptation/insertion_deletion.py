"""Insertion and deletion of generators, the paper's 2.3.1 (`insertion_deletion.cl`).

In 2D dislocations climb and relieve strain; in 2D and 3D the number of generators follows the size field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import Domain
from ..opencl.engine import Engine
from ..opencl.launch import one_group_limit
from ..opencl.primitives import NamedArrays, Scan
from ..tessellation.device_diagram import Tessellation
from . import tuning

NEVER = 2**31 - 1  # faces from which cells are split, where all are deleted
HISTOGRAM = 128  # a power of two, so that bins are divided evenly down to single keys


@dataclass(frozen=True)
class Generators:
    """Generators on the device: points and velocity (n, d), labels, signatures and ever_changed (n,)."""

    points: cla.Array
    labels: cla.Array
    velocity: cla.Array
    signatures: cla.Array
    ever_changed: cla.Array

    def __len__(self) -> int:
        return len(self.labels)


@dataclass(frozen=True)
class Present:
    """What is changed: the generators of a part, and their diagram `t`, which has labels if there are other parts."""

    domain: Domain
    t: Tessellation
    generators: Generators
    next_label: int
    """First label of new generators."""
    fixed: int = 0
    """Generators with labels below it do not change."""


@dataclass(frozen=True)
class Outcome:
    """The generators of a part after insertions and deletions, and how many all parts have inserted and deleted."""

    generators: Generators
    inserted: int
    deleted: int


@dataclass(frozen=True)
class CellSizes:
    """Sizes of the cells, (n,) real on the device: h, min(L, h) and log(V / h^d)."""

    h: cla.Array
    local_length: cla.Array
    log_ratio: cla.Array


@dataclass(frozen=True)
class Change:
    """The change of a set of generators."""

    missing: float
    """Generators to insert, by the size field or a fixed number; negative: to delete."""
    nuclei: int = 0
    """Pairs of dislocations to nucleate."""
    climb: bool = True
    """In 2D, let dislocations climb. Otherwise only the number is corrected, exactly."""
    climb_strain: float = tuning.CLIMB_STRAIN
    """Strain above which a dislocation climbs. Above `CLIMB_STRAIN`, dislocations at walls do not change."""


class InsertionDeletion:
    """Choose where generators are inserted and deleted, and do it."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._room = NamedArrays(engine)
        self._one_group_limit = one_group_limit(engine)
        self._kernels = engine.kernels(
            "adaptation/insertion_deletion",
            {
                "WALL_STRAIN": tuning.WALL_STRAIN,
                "SHIFTS": tuning.SHIFTS,
                "SHIFT_STEP": tuning.SHIFT_STEP,
                "SPLIT_DISTANCE": tuning.SPLIT_DISTANCE,
                "HISTOGRAM": HISTOGRAM,
            },
        )

    def clear(self) -> None:
        """Free all buffers."""
        self._room.clear()

    def insert_delete(self, present: Present, sizes: CellSizes, change: Change) -> Outcome | None:
        """Nucleate dislocations, let them climb, and correct the number of generators. None if nothing changes.

        All parts of a domain call this together. Next to fixed generators only the number is corrected.
        """
        t = present.t
        n = self._count(t)
        # A remainder of less than 0.7 generators only changes the sizes of cells. A large change takes several calls.
        need = math.trunc(change.missing + math.copysign(0.3, change.missing))
        most = max(4, int(tuning.MAX_CHANGE * n))
        need = max(-most, min(most, need))
        is_far = abs(change.missing) > tuning.FAR_COUNT * n
        rings = tuning.FAR_RINGS[self.engine.cell_dim] if is_far else tuning.LOG_RATIO_RINGS
        marks = _Marks.clean(self._room, t, self.engine.dim)
        if change.climb:
            kinds, strain_1, strain_2 = self._measure(t, sizes.h)
            if change.nuclei:
                self._nucleate(present, kinds, strain_1, marks, change.nuclei)
            gained = self._climb(present, sizes.local_length, kinds, strain_2, marks, need, change)
            # Free memory, because the generators will exist twice.
            del kinds, strain_1, strain_2
            self._room.clear("kinds", "strain", "partners", "pull", "merged")
            rest = need - gained
            if abs(rest) > max(2, abs(need) // 10) or (need and not gained):
                self._split_or_delete(present, sizes.log_ratio, marks, rest, rings)
        elif need:
            self._split_or_delete(present, sizes.log_ratio, marks, need, rings)
        self._room.clear("keys", "spread", "chosen", "latest", "ranks")
        return self._apply(present, marks)

    def repair_cells(
        self,
        present: Present,
        quality: cla.Array,
        deficit: float,
        split: bool = False,
        share: float = tuning.REPAIRED_SHARE,
    ) -> Outcome | None:
        """Delete or split the worst inner cells of a mesh in 2D. None if nothing changes.

        A very bad cell is where lattice defects are stuck in a poor arrangement. One generator less, or more, leads to
        another arrangement, which is usually better.

        - `quality`: (n,) real
        - `deficit`: 1 - Q above which a cell is repaired.
        - `split`: split six-sided cells; otherwise delete them. Cells of more sides are split, cells of fewer deleted.
        - `share`: largest share of the cells to repair. A mesh for which that is less than one cell does not change.
        """
        t = present.t
        engine, k, n = self.engine, self._kernels, t.n
        most = int(share * self._count(t))
        if most == 0:
            return None
        marks = _Marks.clean(self._room, t, engine.dim)
        keys = self._keys(t)
        deficit = engine.real.type(deficit)
        engine.run_each(k.score_bad_cells, n, *t.graph, quality, deficit, *t.name_args, keys)
        self._drop_fixed(present, keys, neighbors=True)
        chosen = self._choose(t, keys, tuning.PAIR_RINGS)
        self._limit(t, chosen, most)
        self._mark_split_delete(t, chosen, 6 if split else 7, marks)
        self._room.clear("keys", "spread", "chosen", "latest")
        return self._apply(present, marks)

    def change_regions(
        self, present: Present, log_ratio: cla.Array, region: np.ndarray, lacks: np.ndarray
    ) -> Outcome | None:
        """Insert and delete in regions of the domain, not next to each other in one call. None if nothing changes.

        - `log_ratio` (n,) real: see `CellSizes`.
        - `region` (n,) int: that of each cell.
        - `lacks` (k,) int: how many generators each region lacks; negative: how many are to be deleted.
        """
        t, marks = present.t, _Marks.clean(self._room, present.t, self.engine.dim)
        for k in np.flatnonzero(lacks).tolist():
            marks.busy[: t.n].set((region != k).astype(np.uint64))
            self._split_or_delete(present, log_ratio, marks, int(lacks[k]), 1)
        return self._apply(present, marks)

    def split_delete(self, present: Present, sites: tuple[cla.Array, cla.Array]) -> Outcome | None:
        """Split and delete cells at `sites`, each (n,) uint64 and not 0 at sites; otherwise as `insert_delete`."""
        t, marks = present.t, _Marks.clean(self._room, present.t, self.engine.dim)
        for split_from, chosen in zip((0, NEVER), sites, strict=True):
            self._mark_split_delete(t, chosen, split_from, marks)
        return self._apply(present, marks)

    def _mark_split_delete(self, t: Tessellation, chosen: cla.Array, split_from: int, marks: _Marks) -> None:
        """Mark to split the `chosen` cells of at least `split_from` faces, and to delete the others."""
        cells = t.starts, np.int32(split_from), t.points, t.offsets, t.covariances, t.volumes
        self.engine.run_each(self._kernels.mark_split_delete, t.n, chosen, *cells, *marks.arrays)

    def _measure(self, t: Tessellation, h: cla.Array) -> tuple[cla.Array, cla.Array, cla.Array]:
        """Return charge and number of walls (n, 2), and the strain averaged over one and over two rings (n, 4)."""
        engine, k, n, graph = self.engine, self._kernels, t.n, (*t.graph, t.points)
        kinds = self._room("kinds", size=2 * t.rows, dtype=np.int32).reshape(-1, 2)
        raw, once = (self._room("strain", turn, size=4 * t.rows, dtype=np.float32).reshape(-1, 4) for turn in range(2))
        with engine.workspace.frame():
            (h,) = t.with_ghosts(engine, h)
            engine.run_each(k.measure_strain, n, *graph, h, kinds, raw, *t.outlines, *engine.period_args)
        t.forward(engine, kinds, raw)
        for values, mean in ((raw, once), (once, raw)):
            engine.run_each(k.average_strain, n, *graph, values, mean)
            t.forward(engine, mean)
        return kinds, once, raw

    def _keys(self, t: Tessellation) -> cla.Array:
        """Return the array for keys of all rows."""
        return self._room("keys", size=t.rows, dtype=np.uint64)

    def _count(self, t: Tessellation) -> int:
        """Return the number of generators of all parts."""
        return int(self.engine.peers.total(t.n))

    def _nucleate(self, present: Present, kinds: cla.Array, strain: cla.Array, marks: _Marks, nuclei: int) -> None:
        """Mark at most `nuclei` insertions and as many mergers where the perfect lattice is strained most."""
        engine, k, t, n = self.engine, self._kernels, present.t, present.t.n
        keys, names, limit = self._keys(t), t.name_args, engine.real.type(tuning.NUCLEATION_STRAIN)
        engine.run_each(k.score_strain, n, *t.graph, kinds, strain, limit, *names, keys)
        self._drop_fixed(present, keys, neighbors=True)
        chosen = self._choose(t, keys, tuning.NUCLEUS_RINGS)
        self._limit(t, chosen, 2 * nuclei)
        ranks = self._room("ranks", size=n + 1, dtype=np.int32)
        engine.run_each(k.flag_sites, n, chosen, ranks)
        self._scan.exclusive(ranks, ranks, n)
        peers = engine.peers
        first = int(peers.before(ranks[n:].get())[0]) if peers.count > 1 else 0
        merged = self._room("merged", size=t.rows, dtype=np.int32)
        made = marks.shifts, marks.born, marks.births, marks.busy, merged
        engine.run_each(
            k.mark_nuclei, n, chosen, ranks, np.int32(first), *t.graph, t.points, *names, *made, *engine.period_args
        )
        t.forward(engine, merged)
        engine.run_each(k.delete_merged, n, *t.graph, merged, *names, marks.kept)

    def _climb(
        self,
        present: Present,
        local_length: cla.Array,
        kinds: cla.Array,
        strain: cla.Array,
        marks: _Marks,
        need: int,
        change: Change,
    ) -> int:
        """Mark the dislocations that climb and return the change of the number of generators.

        The threshold is shifted so that the change is closest to `need`. Nucleated pairs and their neighborhood do not
        climb.
        """
        engine, k, t, n = self.engine, self._kernels, present.t, present.t.n
        real, strain_limit = engine.real.type, engine.real.type(change.climb_strain)
        partners = self._room("partners", size=4 * t.rows, dtype=np.int32).reshape(-1, 4)
        pull, keys, names = self._room("pull", size=t.rows), self._keys(t), t.name_args
        lattice = *t.graph, t.points, kinds, strain, np.int32(change.climb_strain <= tuning.CLIMB_STRAIN)
        pairs = partners, pull, keys
        engine.run_each(k.score_pairs, n, *lattice, *names, *pairs, *engine.period_args)
        self._drop_fixed(present, keys, neighbors=True)
        if change.nuclei:
            engine.run_each(k.drop_sites, n, self.spread(t, marks.busy, tuning.PAIR_RINGS), keys)
        chosen = self._choose(t, keys, tuning.PAIR_RINGS)
        tally = self._room.zeros("tally", size=tuning.SHIFTS, dtype=np.int32)
        engine.run_each(k.count_pair_changes, n, chosen, pull, kinds, partners, strain_limit, tally)
        changes = engine.peers.total(tally.get())
        # The shift whose change is closest to the need; the smallest of equal ones.
        shifts = (np.arange(tuning.SHIFTS) - tuning.SHIFTS // 2) * tuning.SHIFT_STEP
        order = np.argsort(np.abs(shifts), kind="stable")
        best = order[np.argmin(np.abs(changes[order] - need))]
        t.forward(engine, chosen, pull, partners)
        pairs = chosen, pull, kinds, partners, strain_limit, real(shifts[best])
        moved = t.points, local_length, *marks.arrays, marks.busy
        engine.run_each(k.mark_pairs, n, *t.graph, *pairs, *names, *moved, *engine.period_args)
        return int(changes[best])

    def _split_or_delete(self, present: Present, log_ratio: cla.Array, marks: _Marks, rest: int, rings: int) -> None:
        """Mark about `rest` of the largest cells to split, or -rest of the smallest to delete, relative to h.

        They are `rings` rings of cells apart.
        """
        engine, k, t, n = self.engine, self._kernels, present.t, present.t.n
        sign, keys = engine.real.type(math.copysign(1, rest)), self._keys(t)
        engine.run_each(k.score_log_ratio, n, *t.graph, log_ratio, sign, *t.name_args, keys)
        self._drop_fixed(present, keys, neighbors=False)
        engine.run_each(k.drop_sites, n, self.spread(t, marks.busy, rings), keys)
        chosen = self._choose(t, keys, rings)
        self._limit(t, chosen, rest if rest > 0 else min(-rest, self._count(t) - 1))
        self._mark_split_delete(t, chosen, 0 if rest > 0 else NEVER, marks)

    def _drop_fixed(self, present: Present, keys: cla.Array, neighbors: bool) -> None:
        """Remove sites at fixed generators and, with `neighbors`, next to them."""
        if present.fixed:
            t = present.t
            with self.engine.workspace.frame():
                labels = t.fixed_args(self.engine, present.generators.labels, present.fixed)
                drop = self._kernels.drop_fixed_sites
                self.engine.run_each(drop, t.n, *t.graph, *labels, np.int32(neighbors), keys)

    def spread(self, t: Tessellation, source: cla.Array, rings: int) -> cla.Array:
        """Return the largest key within `rings` rings of each generator. The rows of ghosts in `source` are filled."""
        engine, n = self.engine, t.n
        into, other = (self._room("spread", turn, size=t.rows, dtype=np.uint64) for turn in range(2))
        groups, at_once = (1, rings) if n <= self._one_group_limit and t.part is None else (engine.groups, 1)
        for _ in range(rings // at_once):
            t.forward(engine, source)
            graph = t.graph
            engine.run_groups(self._kernels.spread_keys, groups, n, at_once, *graph, source, into, other)
            source, into, other = into, other, into
        return source if at_once % 2 else into

    def choose_once(self, present: Present, keys: cla.Array, rings: int) -> cla.Array:
        """Return the keys of the sites that are the strongest within `rings` rings, away from fixed generators."""
        self._drop_fixed(present, keys, neighbors=True)
        return self._choose(present.t, keys, rings, rounds=1)

    def _choose(self, t: Tessellation, keys: cla.Array, rings: int, rounds: int = tuning.ROUNDS) -> cla.Array:
        """Return the keys of the strongest sites that are `rings` rings apart. `keys` is overwritten."""
        engine, k, n = self.engine, self._kernels, t.n
        chosen = self._room.zeros("chosen", size=t.rows, dtype=np.uint64)
        latest = self._room("latest", size=t.rows, dtype=np.uint64)
        for turn in range(rounds):
            if turn > 0:
                engine.run_each(k.drop_sites, n, self.spread(t, latest, rings), keys)
            spread = self.spread(t, keys, rings)
            engine.run_each(k.choose_sites, n, keys, spread, chosen, latest)
        return chosen

    def _limit(self, t: Tessellation, chosen: cla.Array, most: int) -> None:
        """Keep the `most` sites of the largest keys, of those that all parts have `chosen`. No two keys are equal."""
        engine, k = self.engine, self._kernels
        low, span = 0, 2**64
        while True:
            bins = min(HISTOGRAM, span)
            width = span // bins
            histogram = self._room.zeros("histogram", size=HISTOGRAM, dtype=np.int32)
            engine.run_each(k.count_sites, t.n, chosen, np.uint64(low), np.uint64(width), histogram)
            from_top = np.cumsum(engine.peers.total(histogram.get())[:bins][::-1])
            whole = int(np.searchsorted(from_top, most, side="right"))
            least = low + (bins - whole) * width
            most -= int(from_top[whole - 1]) if whole else 0
            if whole == bins or most == 0:
                break
            # Divide the bin in which the number is exceeded.
            low, span = least - width, width
        engine.run_each(k.limit_sites, t.n, np.uint64(min(least, 2**64 - 1)), chosen)

    def _apply(self, present: Present, marks: _Marks) -> Outcome | None:
        """Carry out the marked changes."""
        engine, t = self.engine, present.t
        totals = self._room("totals", size=2, dtype=np.int32)
        for place, counts in enumerate((marks.kept, marks.born)):
            self._scan.exclusive(counts, counts, t.n, total=(totals, place))
        kept, born = found = totals.get()
        first = present.next_label + int(engine.peers.before(found)[1])
        (left, inserted), deleted = engine.peers.total(found).tolist(), self._count(t)
        deleted -= left
        m = int(kept + born)
        if left + inserted == 0 or (deleted == 0 and inserted == 0):
            return None
        new = Generators(
            engine.empty((m, engine.dim)),
            engine.empty(m, np.int32),
            engine.empty((m, engine.dim)),
            engine.empty(m, np.uint64),
            engine.empty(m),
        )
        changes = marks.kept, marks.born, np.int32(first), np.int32(present.fixed), *present.domain.device_args(engine)
        before = *vars(present.generators).values(), marks.shifts, marks.births
        mesh = *t.graph, t.face_centroids, *t.outlines
        engine.run_each(self._kernels.apply_changes, t.n, *changes, *before, *vars(new).values(), *mesh)
        return Outcome(new, inserted, deleted)


@dataclass(frozen=True)
class _Marks:
    """Changes of each generator: see insertion_deletion.cl."""

    kept: cla.Array
    shifts: cla.Array
    born: cla.Array
    births: cla.Array
    busy: cla.Array

    @classmethod
    def clean(cls, room: NamedArrays, t: Tessellation, dim: int) -> _Marks:
        n = t.n
        return cls(
            room("kept", size=n + 1, dtype=np.int32).fill(1),
            room.zeros("shifts", size=dim * n),
            room.zeros("born", size=n + 1, dtype=np.int32),
            room.zeros("births", size=dim * n),
            room.zeros("busy", size=t.rows, dtype=np.uint64),
        )

    @property
    def arrays(self) -> tuple[cla.Array, ...]:
        return self.kept, self.shifts, self.born, self.births
