"""A mesh at work: generators on the device, and what is known about their diagram."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyopencl.array as cla

from ..geometry.box import Domain
from ..mesh.diagram import Diagram
from ..opencl.primitives import Summaries, Summary
from ..sizing import Sizing
from ..tessellation.bins import BinnedPoints
from ..tessellation.device_diagram import Tessellation
from ..tessellation.readback.fetch import fetch_diagram
from ..tessellation.tessellator import Tessellator
from .density import Excess, Weighting
from .insertion_deletion import THETA, Population
from .stages import Stages

_DERIVED = ("h", "error", "quality", "reach", "potential")
"""Arrays of a mesh that follow from its generators."""
_UNKNOWN = {"tessellation": None, "multipliers": None}
"""What there is not after generators have come or gone."""
SUMMARIES = (
    "error", "quality", "energy", "lloyd", "correction", "changed", "ever", "excess", "weight",
)  # fmt: skip


class Mesh:
    """Generators of one level, their diagram, sizes, error and quality, all on the device.

    Parameters
    ----------
    points : (n, d) real, device
        Generators in any order, normalized coordinates.
    labels : (n,) int32, device, optional
        Names that stay with them; by default 0, 1, ...
    coarsening : float
        Factor on the size field: 2^k on level k above the finest.
    free : Domain, optional
        The part of the domain, in its frame, in which generators may move; by default all of it.
    fixed : int
        Generators of smaller labels stay where they are, and the size that their cells have is right.

    Attributes
    ----------
    n : int
    points : (n, d) real
        In an order of the device's own: along its bins.
    labels : (n,) int32
    tessellation : Tessellation
    h, error, quality, reach : (n,) real
        `reach` is the lesser of h and L, by which motion is limited.
    potential : (n,) real
        Solution of the latest Poisson solve: the next one's start.
    multipliers : (n,) float32 or None
        Solution of the latest projection, likewise; None: there has been none.
    source : (n,) real
        The Poisson equation's right side; this and what follows is of the workspace, and of a step alone.
    lloyd, correction : (n, d) real
        The two halves of the latest step. Their lengths over h: `lloyd_speed`, `correction_speed` (n,).
    velocity : (n, d) real
        The latest step as it was made.
    signatures : (n,) uint64
        Of the sets of neighbors; see `Metric.compare_neighbors`.
    ever : (n,) real
        1 where the set of neighbors has changed in a step on this level; else 0.
    """

    n: int
    points: cla.Array
    labels: cla.Array
    velocity: cla.Array
    signatures: cla.Array
    ever: cla.Array
    h: cla.Array
    error: cla.Array
    quality: cla.Array
    reach: cla.Array
    source: cla.Array
    potential: cla.Array
    multipliers: cla.Array | None
    lloyd: cla.Array
    correction: cla.Array
    lloyd_speed: cla.Array
    correction_speed: cla.Array
    tessellation: Tessellation | None

    def __init__(
        self,
        stages: Stages,
        domain: Domain,
        sizing: Sizing,
        points: cla.Array,
        labels: cla.Array | None = None,
        coarsening: float = 1.0,
        free: Domain | None = None,
        fixed: int = 0,
    ) -> None:
        if labels is None:
            labels = stages.engine.upload(np.arange(len(points)), np.int32)
        self._set_up(stages, domain, sizing, coarsening, free, fixed)
        self._begin({"points": points, "labels": labels})

    @classmethod
    def saved(
        cls,
        stages: Stages,
        domain: Domain,
        sizing: Sizing,
        arrays: dict[str, cla.Array],
        coarsening: float,
        free: Domain | None,
        fixed: int,
    ) -> Mesh:
        """Return a mesh of `arrays` by name as another one had them, but for its diagram, which is yet to be set."""
        mesh = cls.__new__(cls)
        mesh._set_up(stages, domain, sizing, coarsening, free, fixed)
        n = len(arrays["points"])
        mesh.__dict__.update({**dict.fromkeys(_DERIVED), **_UNKNOWN, **arrays, "n": n})
        mesh._make_room()
        return mesh

    def _set_up(
        self,
        stages: Stages,
        domain: Domain,
        sizing: Sizing,
        coarsening: float,
        free: Domain | None,
        fixed: int,
        coarser: Tessellator | None = None,
    ) -> None:
        """Make what is not of any generators."""
        self.engine, self.fixed = stages.engine, fixed
        self.free = domain if free is None else free
        self.stages, self.domain, self.sizing, self.coarsening = stages, domain, sizing, coarsening
        self.tessellator = Tessellator(stages, domain, self._spacing, coarser)
        self.summaries = Summaries(self.engine, SUMMARIES)
        self._ordered: cla.Array | None = None

    def _begin(self, rows: dict[str, cla.Array]) -> None:
        """Take the first generators, in `rows`, which is used up: their points and labels."""
        n = self.next_label = len(rows["points"])
        rows["velocity"] = self.engine.zeros(rows["points"].shape)
        rows["signatures"] = self.engine.zeros(n, np.uint64)
        rows["ever"] = self.engine.zeros(n)
        self.adopt(rows)

    def _spacing(self, points: np.ndarray) -> np.ndarray:
        """Return the size that cells are to have at `points` (k, d) on this level, (k,)."""
        return self.coarsening * np.asarray(self.sizing(points))

    def adopt(self, rows: dict[str, cla.Array]) -> None:
        """Take other generators for the present ones, sort them by bin so that neighbors are near in memory.

        `rows` has their points, velocity (n, d), labels, signatures and ever (n,), and is used up: by then nobody else
        should hold on to these arrays.

        Raises
        ------
        SizeFieldError
            If the size of one is not positive and finite.
        """
        stages, first = self.stages, not hasattr(self, "tessellation")
        n = len(rows["points"])
        binned = stages.bins.build(self.domain, rows["points"], n)
        stages.bins.clear_work()
        items = binned.items[:n].copy()
        # One after the other, so that each is let go of when it has been sorted.
        new = {name: stages.gather.rows(items, rows.pop(name)) for name in list(rows)}
        # At one stroke: whoever interrupts the run finds arrays that fit each other, or none, which `update` makes.
        self.__dict__.update({**dict.fromkeys(_DERIVED), **new, "n": n, **_UNKNOWN})
        del new, items
        stages.bins.renumber(binned, n)
        self.update(first, binned)
        stages.bins.clear()
        self.engine.workspace.clear()

    def _make_room(self) -> None:
        """Make the arrays that there are not, of what follows from the generators."""
        for name in _DERIVED:
            if getattr(self, name) is None:
                # Only the potential is looked at before it is written.
                make = self.engine.zeros if name == "potential" else self.engine.empty
                setattr(self, name, make(self.n))

    def begin_step(self) -> None:
        """Take room for what generators are displaced by, to the end of the workspace's frame."""
        self.lloyd, self.correction = (self.engine.scratch(self.points.shape) for _ in range(2))

    def take_source(self) -> None:
        """Take room for the right side of a Poisson equation."""
        self.source = self.engine.scratch(self.n)

    def measure_speeds(self) -> None:
        """Measure how far generators are displaced, in room for a step alone."""
        self.lloyd_speed, self.correction_speed = (self.engine.scratch(self.n) for _ in range(2))
        self.stages.motion.measure_displacements(
            self.lloyd, self.correction, self.h, self.lloyd_speed, self.correction_speed
        )

    def note_speeds(self) -> None:
        """Summarize how far generators are displaced."""
        speeds = {"lloyd": self.lloyd_speed, "correction": self.correction_speed}
        self.summaries.collect_all(speeds, self.n)

    @property
    def t(self) -> Tessellation:
        """The present diagram."""
        assert self.tessellation is not None
        return self.tessellation

    def update(
        self, first: bool = False, binned: BinnedPoints | None = None, *, check: bool = True
    ) -> None:
        """Tessellate the generators where they are now, and evaluate size, error and quality.

        `binned` has them in their bins, where the caller does. Without `check` the next `assess` looks at the sizes.

        Raises
        ------
        InputError
            If generators have come too close to each other to be told apart.
        SizeFieldError
            If the size of one is not positive and finite.
        """
        stages = self.stages
        self._make_room()
        self.tessellation = self.tessellator.tessellate(
            self.points, self.n, self.tessellation, binned=binned
        )
        if self.engine.dim == 2:
            # The next diagrams are repaired from this one, most likely.
            stages.bins.clear()
        self.sizing.evaluate(self.points, self.n, self.h, self.coarsening)
        with self.engine.workspace.frame():
            changed = self.engine.scratch(self.n)
            stages.metric.compare_neighbors(
                self.t, self.labels, first, self.signatures, changed, self.ever
            )
            self._evaluate_metric({"changed": changed, "ever": self.ever})
        # Before anything is done with a bad size: the solver, say, would complain of something else.
        if check:
            self.sizing.check(self.points, self.h, self.coarsening)

    def _evaluate_metric(self, others: Mapping[str, cla.Array] | None = None) -> None:
        """Evaluate error and quality, and summarize them, and `others` by name."""
        if self.fixed:
            self.stages.metric.hold_sizes(self.labels, self.fixed, self.t.volumes, self.h)
        with self.engine.workspace.frame():
            energy = self.engine.scratch(self.n)
            self.stages.metric.evaluate(
                self.t, self.h, self.error, self.quality, energy, self.reach
            )
            own = {"error": self.error, "quality": self.quality, "energy": energy}
            self.summaries.collect_all({**own, **(others or {})}, self.n)

    def hold(self, displacement: cla.Array) -> None:
        """Set `displacement` (n, d) to zero for the generators that stay where they are."""
        if self.fixed:
            self.stages.motion.hold_generators(self.labels, self.fixed, displacement)

    def weigh(
        self, gradient: cla.Array | None = None, excess: cla.Array | None = None
    ) -> Weighting:
        """Evaluate density, excess and, as `lloyd`, weighted centroids of the present cells: see `Density.evaluate`."""
        return self.stages.density.evaluate(self.t, self.h, self.lloyd, gradient, excess)

    def _excess(self, w: Excess) -> Summary:
        """Summarize the excess, log(V / h^d)."""
        self.summaries.collect("excess", w.excess, self.n)
        return self.summaries.read_one("excess")

    def mean_log_error(self, w: Excess) -> float:
        """Mean of |log(L / h)|, by a weighting that has just been made."""
        return self._excess(w).magnitude / self.n / self.engine.dim

    def missing(self, w: Excess | None = None) -> float:
        """Return how many generators the size field asks for beside those that there are (negative: too many).

        The sum of V rho, not that of log(V rho), which would be biased by how much the cells' sizes scatter.
        """
        with self.engine.workspace.frame():
            w = self.stages.density.weigh(self.t, self.h) if w is None else w
            self.summaries.collect("weight", w.weight, self.n)
        return self.summaries.read_one("weight").sum - self.n

    def match_size(self) -> None:
        """Scale the size field by the one factor that makes the mean of log(L / h) vanish."""
        with self.engine.workspace.frame():
            w = self.stages.density.weigh(self.t, self.h)
            factor = math.exp(self._excess(w).sum / self.n / self.engine.dim)
        self.coarsening *= factor
        metric = self.stages.metric
        metric.scale_sizes(factor, self.h)
        self._evaluate_metric()

    def reorganize(
        self,
        nuclei: int = 0,
        n_cells: int | None = None,
        climb: bool = True,
        theta: float = THETA,
        most: float = math.inf,
    ) -> tuple[int, int]:
        """Insert and delete generators (see `PopulationControl.reorganize`); return how many of each.

        The count goes to `n_cells` or, with None, to what the size field asks for, but not above `most`.
        """
        # This takes more than a step does.
        self.engine.workspace.clear()
        with self.engine.workspace.frame():
            w = self.stages.density.weigh(self.t, self.h)
            total = self.missing(w) if n_cells is None else float(n_cells - self.n)
            total = min(total, most - self.n)
            new = self.stages.population.reorganize(
                self.free, self.t, self.h, self.reach, w.excess, self._rows(), total, self.next_label,
                nuclei, climb, theta, self.fixed,
            )  # fmt: skip
        rows = _take_apart(new)
        del new, w
        return self._repopulate(rows)

    def mend(self, flaw: float, split: bool) -> tuple[int, int]:
        """Delete or split the worst cells (see `PopulationControl.mend`); return how many came and went."""
        self.engine.workspace.clear()
        new = self.stages.population.mend(
            self.free, self.t, self.quality, self._rows(), self.next_label, flaw, split, self.fixed
        )
        rows = _take_apart(new)
        del new
        return self._repopulate(rows)

    def _rows(self) -> Population:
        """Return the present generators."""
        return Population(self.points, self.labels, self.velocity, self.signatures, self.ever)

    def _repopulate(self, rows: dict[str, Any]) -> tuple[int, int]:
        """Take other generators, which are used up, if there are any; return how many came and went."""
        self.engine.workspace.clear()
        self.stages.population.clear()
        if not rows:
            return 0, 0
        inserted, deleted = rows.pop("inserted"), rows.pop("deleted")
        self.next_label += inserted
        self.adopt(rows)
        return inserted, deleted

    def assess(self) -> dict[str, Summary]:
        """Fetch the summaries of the mesh and of the latest step: the scalars that the host sees of it.

        Raises
        ------
        SizeFieldError
            If the size of a generator is not positive and finite, and `update` has not looked.
        """
        summaries, first = self.summaries.read_with(self.sizing.invalid_index)
        self.sizing.check(self.points, self.h, self.coarsening, first)
        return summaries

    def refined_count(self) -> int:
        """Return how many generators `refine` would make."""
        return self.stages.refinement.count(self.t)

    def refine(self) -> Mesh:
        """Return the mesh of the next finer level; the present generators keep their labels."""
        self.stages.metric.scale_sizes(0.5, self.h)
        rows = {
            "points": self.stages.refinement.refine(
                self.free, self.t, self.h, self.labels, self.fixed
            )
        }
        n = len(rows["points"])
        rows["labels"] = self.engine.upload(self.next_label + np.arange(n) - self.n, np.int32)
        rows["labels"][: self.n] = self.labels
        # Should the run be interrupted, `update` makes again what follows from the generators.
        self.__dict__.update({**dict.fromkeys(_DERIVED), **_UNKNOWN})
        # Not by its constructor, whose caller would hold on to the arrays.
        mesh = Mesh.__new__(Mesh)
        mesh._set_up(
            self.stages, self.domain, self.sizing, self.coarsening / 2, self.free, self.fixed,
            self.tessellator,
        )  # fmt: skip
        mesh._begin(rows)
        mesh.next_label = self.next_label + n - self.n
        return mesh

    # Results: physical units, the caller's order.

    def values(self, array: cla.Array, factor: float = 1.0) -> np.ndarray:
        """Fetch per-generator `array` (n, ...) in the order of labels, times `factor`."""
        # Generators get new labels, in an array of their own, whenever their order changes.
        if self._ordered is not self.labels:
            self._order, self._ordered = np.argsort(self.labels.get(), kind="stable"), self.labels
        return array.get()[self._order].astype(np.float64) * factor

    def complete(self) -> bool:
        """Let go of what only steps take, and evaluate what there is in full precision: for `finish`.

        Return whether the diagram has been made anew for that.
        """
        self.stages.clear("poisson")
        self.engine.workspace.clear()
        whole = self.tessellator.is_whole(self.t)
        if not whole:
            # Nothing follows from the present diagram any more, and the new one needs room.
            self.tessellation = None
            self.stages.clear("folded")
            self.tessellation = self.tessellator.make_whole(self.points, self.n)
        self.tessellation, self._unfolded = self.tessellator.final(self.t)
        self._evaluate_metric()
        return not whole

    def finish(self) -> Diagram:
        """Return the diagram and let go of all stages' buffers: the mesh is not to be used any more."""
        self.stages.release()
        return fetch_diagram(
            self.engine, self.domain, self.t, self.labels, copy=False, unfolded=self._unfolded
        )


def _take_apart(new: Population | None) -> dict[str, Any]:
    """Return what `new` has, if there is one, by name, so that each can be let go of on its own."""
    return {} if new is None else dict(vars(new))
