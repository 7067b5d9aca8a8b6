"""Insertion and deletion of generators: dislocations climb, the count meets the field (`population.cl`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ..geometry.box import Domain
from ..opencl.device_array import read_number
from ..opencl.engine import Engine
from ..opencl.primitives import Room, Scan
from ..tessellation.device_diagram import Tessellation

THETA = 0.06
"""Strain across a pair of a 5-sided and a 7-sided cell at which it climbs."""
WALL_THETA = 0.3
"""Strain that keeps a pair from ending at the wall beside it."""
NUCLEATION_STRAIN = 0.22
"""Anisotropy of the lattice above which a pair may be made."""
PAIR_RINGS, NUCLEUS_RINGS, EXCESS_RINGS = 4, 6, 3
"""Rings of cells between sites that act in the same sweep: their displacements should not meet."""
ROUNDS = 3
"""Rounds of choosing sites; each takes the strongest that are left."""
SHIFTS, SHIFT_STEP = 51, 0.01
HISTOGRAM = 128  # a power of two: its bins are divided evenly down to single keys
SPLIT_DISTANCE = 0.3
"""Half the distance over h at which the two halves of a split cell start."""
LARGEST_CHANGE = 0.05
"""Share of the generators that one call may insert or delete to correct the count."""
MENDED_SHARE = 1e-3
"""Share of the cells that are mended at a time."""


@dataclass(frozen=True)
class Population:
    """Generators, on the device: points and velocity (n, d), labels, signatures and ever (n,)."""

    points: cla.Array
    labels: cla.Array
    velocity: cla.Array
    signatures: cla.Array
    ever: cla.Array
    inserted: int = 0
    deleted: int = 0


class PopulationControl:
    """Decide where generators are inserted and deleted, and do it: for the lattice (in 2D) and for the count."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._scan = Scan(engine)
        self._room = Room(engine)
        self._kernels = engine.kernels(
            "adaptation/insertion_deletion",
            {
                "WALL_THETA": WALL_THETA,
                "SHIFTS": SHIFTS,
                "SHIFT_STEP": SHIFT_STEP,
                "SPLIT_DISTANCE": SPLIT_DISTANCE,
                "HISTOGRAM": HISTOGRAM,
            },
        )

    def clear(self) -> None:
        """Let go of all buffers."""
        self._room.clear()

    def reorganize(
        self,
        domain: Domain,
        t: Tessellation,
        h: cla.Array,
        reach: cla.Array,
        excess: cla.Array,
        rows: Population,
        missing: float,
        next_label: int,
        nuclei: int = 0,
        climb: bool = True,
        theta: float = THETA,
        fixed: int = 0,
    ) -> Population | None:
        """Make pairs (`nuclei` of each kind), let pairs climb, and bring the count to what the field asks for.

        Parameters
        ----------
        h, excess : (n,) real
        reach : (n,) real
            Length by which a generator may be moved: the lesser of h and L.
        rows : Population
            The present generators.
        missing : float
            How many generators the size field, or the count that is held, asks for beside those that there are;
            negative: too many.
        next_label : int
            First label for the new ones.
        nuclei : int
        climb : bool
            2D only. Without it only the count is corrected, to the last generator.
        theta : float
            Strain from which on a pair climbs; above `THETA`, pairs at walls are left alone.
        fixed : int
            Generators of smaller labels stay where they are, and what is done beside them is for the count alone.

        Returns
        -------
        Population or None
            None if nothing is to change.
        """
        n = t.n
        # Less than 0.7 of a generator is left to strain; a large change is made in several calls.
        need = math.trunc(missing + math.copysign(0.3, missing))
        most = max(4, int(LARGEST_CHANGE * n))
        need = max(-most, min(most, need))
        marks = _Marks.clean(self._room, n, self.engine.dim)
        self._labels, self._fixed = rows.labels, fixed
        if climb:
            kinds, strain_1, strain_2 = self._measure(t, h)
            if nuclei:
                self._nucleate(t, kinds, strain_1, marks, nuclei)
            gained = self._climb(t, reach, kinds, strain_2, marks, need, theta, nuclei > 0)
            # Memory is scarce here, where generators are there twice in the end.
            del kinds, strain_1, strain_2
            self._room.clear("kinds", "strain", "partners", "pull")
            rest = need - gained
            if abs(rest) > max(2, abs(need) // 10) or (need and not gained):
                self._split_or_delete(t, excess, marks, rest)
        elif need:
            self._split_or_delete(t, excess, marks, need)
        self._room.clear("keys", "spread", "chosen", "latest", "ranks")
        return self._apply(domain, t, rows, marks, next_label)

    def mend(
        self,
        domain: Domain,
        t: Tessellation,
        quality: cla.Array,
        rows: Population,
        next_label: int,
        flaw: float,
        split: bool = False,
        fixed: int = 0,
        share: float = MENDED_SHARE,
    ) -> Population | None:
        """Delete or split the worst inner cells of a mesh in 2D.

        A cell that is far worse than the others sits where the lattice's defects have come to lie badly. One generator
        less, or more, shakes them into another arrangement there, which most often is a better one.

        Parameters
        ----------
        quality : (n,) real
        rows, next_label, fixed
            As for `reorganize`.
        flaw : float
            1 - Q above which a cell is mended.
        split : bool
            Split cells of six sides; else they are deleted. Those of more are split, those of fewer deleted.
        share : float
            Of the cells, at most so many are mended: a mesh so small that it is less than one stays as it is.

        Returns
        -------
        Population or None
            None if nothing is to change.
        """
        engine, k, n = self.engine, self._kernels, t.n
        most = int(share * n)
        if most == 0:
            return None
        marks = _Marks.clean(self._room, n, engine.dim)
        self._labels, self._fixed = rows.labels, fixed
        keys = self._room("keys", size=n, dtype=np.uint64)
        engine.run_each(
            k.score_flaws, n, t.starts, t.neighbors, quality, engine.real.type(flaw), keys
        )
        self._exempt(t, keys, around=True)
        chosen = self._choose(t, keys, PAIR_RINGS)
        self._limit(chosen, n, most)
        engine.run_each(
            k.mark_flaws, n, chosen, t.starts, np.int32(6 if split else 7), t.offsets,
            t.covariances, t.volumes, *marks.arrays,
        )  # fmt: skip
        self._room.clear("keys", "spread", "chosen", "latest")
        return self._apply(domain, t, rows, marks, next_label)

    def _measure(self, t: Tessellation, h: cla.Array) -> tuple[cla.Array, cla.Array, cla.Array]:
        """Return charge and walls (n, 2), and the strain averaged over one ring and over two (n, 4)."""
        engine, k, n = self.engine, self._kernels, t.n
        kinds = self._room("kinds", size=2 * n, dtype=np.int32)
        raw, once = (self._room("strain", turn, size=4 * n, dtype=np.float32) for turn in range(2))
        engine.run_each(
            k.measure_strain, n, t.starts, t.neighbors, t.points, h, kinds, raw, *t.outlines,
            *engine.period_args,
        )  # fmt: skip
        engine.run_each(k.average_strain, n, t.starts, t.neighbors, raw, once)
        engine.run_each(k.average_strain, n, t.starts, t.neighbors, once, raw)
        return kinds, once, raw

    def _nucleate(
        self, t: Tessellation, kinds: cla.Array, strain: cla.Array, marks: _Marks, nuclei: int
    ) -> None:
        """Mark at most `nuclei` insertions and as many mergers where the clean lattice is strained most."""
        engine, k, n = self.engine, self._kernels, t.n
        keys = self._room("keys", size=n, dtype=np.uint64)
        engine.run_each(
            k.score_strain, n, t.starts, t.neighbors, kinds, strain,
            engine.real.type(NUCLEATION_STRAIN), keys,
        )  # fmt: skip
        self._exempt(t, keys, around=True)
        chosen = self._choose(t, keys, NUCLEUS_RINGS)
        self._limit(chosen, n, 2 * nuclei)
        ranks = self._room("ranks", size=n + 1, dtype=np.int32)
        engine.run_each(k.flag_sites, n, chosen, ranks)
        self._scan.exclusive(ranks, ranks, n)
        engine.run_each(
            k.mark_nuclei, n, chosen, ranks, t.starts, t.neighbors, t.points, *marks.arrays,
            marks.busy, *engine.period_args,
        )  # fmt: skip

    def _climb(
        self,
        t: Tessellation,
        reach: cla.Array,
        kinds: cla.Array,
        strain: cla.Array,
        marks: _Marks,
        need: int,
        theta: float,
        nucleated: bool,
    ) -> int:
        """Mark the pairs that climb, with thresholds shifted to bring the count nearest to `need`; return the gain.

        Not near those that have been `nucleated`.
        """
        engine, k, n = self.engine, self._kernels, t.n
        real = engine.real.type
        partners = self._room("partners", size=n, dtype=np.int32)
        pull = self._room("pull", size=n)
        keys = self._room("keys", size=n, dtype=np.uint64)
        engine.run_each(
            k.score_pairs, n, t.starts, t.neighbors, t.points, kinds, strain,
            np.int32(theta <= THETA), partners, pull, keys, *engine.period_args,
        )  # fmt: skip
        self._exempt(t, keys, around=True)
        if nucleated:
            engine.run_each(k.drop_sites, n, self._spread(t, marks.busy, PAIR_RINGS), keys)
        chosen = self._choose(t, keys, PAIR_RINGS)
        tally = self._room.zeros("tally", size=SHIFTS, dtype=np.int32)
        engine.run_each(k.tally_pairs, n, chosen, pull, kinds, partners, real(theta), tally)
        changes = tally.get()
        # The shift of the threshold whose change is nearest to the need, the least among equals.
        shifts = (np.arange(SHIFTS) - SHIFTS // 2) * SHIFT_STEP
        order = np.argsort(np.abs(shifts), kind="stable")
        best = order[np.argmin(np.abs(changes[order] - need))]
        engine.run_each(
            k.mark_pairs, n, chosen, pull, kinds, partners, real(theta), real(shifts[best]),
            t.points, reach, *marks.arrays, marks.busy, *engine.period_args,
        )  # fmt: skip
        return int(changes[best])

    def _split_or_delete(
        self, t: Tessellation, excess: cla.Array, marks: _Marks, rest: int
    ) -> None:
        """Mark about `rest` cells to be split, or -rest to be deleted: those that are most too large or too small."""
        engine, k, n = self.engine, self._kernels, t.n
        sign = engine.real.type(math.copysign(1, rest))
        keys = self._room("keys", size=n, dtype=np.uint64)
        engine.run_each(k.score_excess, n, t.starts, t.neighbors, excess, sign, keys)
        self._exempt(t, keys, around=False)
        engine.run_each(k.drop_sites, n, self._spread(t, marks.busy, EXCESS_RINGS), keys)
        chosen = self._choose(t, keys, EXCESS_RINGS)
        self._limit(chosen, n, rest if rest > 0 else min(-rest, n - 1))
        engine.run_each(
            k.mark_excess, n, chosen, sign, t.offsets, t.covariances, t.volumes, *marks.arrays
        )

    def _exempt(self, t: Tessellation, keys: cla.Array, around: bool) -> None:
        """Strike out sites at generators that stay where they are, or beside them."""
        if self._fixed:
            self.engine.run_each(
                self._kernels.exempt_fixed, t.n, t.starts, t.neighbors, self._labels,
                np.int32(self._fixed), np.int32(around), keys,
            )  # fmt: skip

    def _spread(self, t: Tessellation, source: cla.Array, rings: int) -> cla.Array:
        """Return the largest key within `rings` rings of each generator."""
        engine, n = self.engine, t.n
        into, other = (self._room("spread", turn, size=n, dtype=np.uint64) for turn in range(2))
        for _ in range(rings):
            engine.run_each(self._kernels.spread_keys, n, t.starts, t.neighbors, source, into)
            source, into, other = into, other, into
        return source

    def _choose(self, t: Tessellation, keys: cla.Array, rings: int) -> cla.Array:
        """Return the keys of sites that are `rings` rings apart, the strongest first; `keys` is used up."""
        engine, k, n = self.engine, self._kernels, t.n
        chosen = self._room.zeros("chosen", size=n, dtype=np.uint64)
        latest = self._room("latest", size=n, dtype=np.uint64)
        for turn in range(ROUNDS):
            if turn > 0:
                engine.run_each(k.drop_sites, n, self._spread(t, latest, rings), keys)
            spread = self._spread(t, keys, rings)
            engine.run_each(k.choose_sites, n, keys, spread, chosen, latest)
        return chosen

    def _limit(self, chosen: cla.Array, n: int, most: int) -> None:
        """Keep the `most` strongest of the sites; keys are distinct, so that no two tie."""
        engine, k = self.engine, self._kernels
        low, span = 0, 2**64
        while True:
            bins = min(HISTOGRAM, span)
            width = span // bins
            histogram = self._room.zeros("histogram", size=HISTOGRAM, dtype=np.int32)
            engine.run_each(k.count_sites, n, chosen, np.uint64(low), np.uint64(width), histogram)
            from_top = np.cumsum(histogram.get()[:bins][::-1])
            whole = int(np.searchsorted(from_top, most, side="right"))
            least = low + (bins - whole) * width
            most -= int(from_top[whole - 1]) if whole else 0
            if whole == bins or most == 0:
                break
            # Look closer at the bin in which the count is passed.
            low, span = least - width, width
        engine.run_each(k.limit_sites, n, np.uint64(min(least, 2**64 - 1)), chosen)

    def _apply(
        self, domain: Domain, t: Tessellation, rows: Population, marks: _Marks, next_label: int
    ) -> Population | None:
        """Carry out what is marked."""
        engine, n = self.engine, t.n
        self._scan.exclusive(marks.kept, marks.kept, n)
        self._scan.exclusive(marks.born, marks.born, n)
        deleted, inserted = n - read_number(marks.kept, n), read_number(marks.born, n)
        m = n - deleted + inserted
        if m == 0 or (deleted == 0 and inserted == 0):
            return None
        new = Population(
            engine.empty((m, engine.dim)), engine.empty(m, np.int32), engine.empty((m, engine.dim)),
            engine.empty(m, np.uint64), engine.empty(m), inserted, deleted,
        )  # fmt: skip
        engine.run_each(
            self._kernels.apply_changes, n, marks.kept, marks.born, np.int32(next_label), np.int32(self._fixed),
            *domain.device_args(engine), t.points, rows.labels, rows.velocity,
            rows.signatures, rows.ever, marks.shifts, marks.births, new.points, new.labels,
            new.velocity, new.signatures, new.ever, t.starts, t.neighbors, t.face_centroids,
            *t.outlines,
        )  # fmt: skip
        return new


@dataclass(frozen=True)
class _Marks:
    """What is to change: see population.cl."""

    kept: cla.Array
    shifts: cla.Array
    born: cla.Array
    births: cla.Array
    busy: cla.Array

    @classmethod
    def clean(cls, room: Room, n: int, dim: int) -> _Marks:
        return cls(
            room("kept", size=n + 1, dtype=np.int32).fill(1),
            room.zeros("shifts", size=dim * n),
            room.zeros("born", size=n + 1, dtype=np.int32),
            room.zeros("births", size=dim * n),
            room.zeros("busy", size=n, dtype=np.uint64),
        )

    @property
    def arrays(self) -> tuple[cla.Array, ...]:
        return self.kept, self.shifts, self.born, self.births
