"""The state of a mesh on the device: its arrays, and what changes them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..finite_volumes.solid_walls.settling import CellTargets
from ..geometry.domain import Domain
from ..geometry.fixed_generators import FixedGenerators
from ..mesh.diagram import Diagram
from ..mesh.results import Displacements
from ..opencl.device_array import buffer_of
from ..opencl.engine import Engine
from ..opencl.primitives import Summaries
from ..sizing import Sizing
from ..sizing.field import Field
from ..solvers.components import Components
from ..solvers.linear_system import Solution
from ..tessellation.bins import BinnedPoints
from ..tessellation.decomposition import distribute, is_balanced
from ..tessellation.device_diagram import Tessellation
from ..tessellation.readback.diagram import fetch_diagram, order_of
from ..tessellation.readback.parts import fetch_part
from ..tessellation.tessellator import Tessellator
from .density import CellWeights
from .fixed_points import clear_balls, find_places, near_places, put_fixed, take_places
from .insertion_deletion import CellSizes, Change, Generators, Outcome, Present
from .metric import Neighborhoods
from .motion import Balls, Displacement, Moving
from .stages import Stages
from .thin_walls import has_thin_walls
from .tuning import CLIMB_STRAIN, MOST_OBTUSE, SQUEEZED

SUMMARIES = ("error", "quality", "energy", "lloyd", "correction", "changed", "ever_changed", "log_ratio", "weight")


@dataclass
class CellArrays:
    """Arrays (n,) real that follow from the generators; see `MeshState`."""

    h: cla.Array
    error: cla.Array
    quality: cla.Array
    local_length: cla.Array

    @classmethod
    def empty(cls, engine: Engine, n: int) -> CellArrays:
        """Return new arrays for `n` cells."""
        return cls(*(engine.empty(n) for _ in range(4)))


@dataclass
class Arrays:
    """All arrays of one set of generators. An interruption leaves the old or the new set, never a mixture.

    Everything else follows from `generators`, `potential`, `multipliers` and `weights`: checkpoints have these.
    """

    generators: Generators
    potential: cla.Array | None = None
    multipliers: cla.Array | None = None
    weights: cla.Array | None = None
    cells: CellArrays | None = None
    tessellation: Tessellation | None = None

    def kept(self) -> Arrays:
        """Return those that checkpoints have, without copies."""
        return Arrays(self.generators, self.potential, self.multipliers, self.weights)

    def copy(self) -> Arrays:
        """Return copies of those that checkpoints have."""
        generators = Generators(**{name: array.copy() for name, array in vars(self.generators).items()})

        def copied(array: cla.Array | None) -> cla.Array | None:
            return None if array is None else array.copy()

        return Arrays(generators, copied(self.potential), copied(self.multipliers), copied(self.weights))


def _property(part: str, name: str) -> Any:
    """Return a property for attribute `name` of `part` of `MeshState._data`."""
    return property(attrgetter(f"_data.{part}.{name}"))


@dataclass(frozen=True)
class Setup:
    """What all levels of a run have in common."""

    stages: Stages
    domain: Domain
    sizing: Sizing
    free: Domain
    """Part of the domain, in its frame, in which generators may move."""
    fixed: int
    """Generators with labels below `fixed` do not move."""
    points: np.ndarray
    """(k, d) ndarray. Positions of the generators with the labels 0 to k - 1, on the finest level: first those of the
    caller, then those around corners and creases, then those beside lines. The other fixed generators are those of
    layers. Cells beside lines, in layers, and around crowded creases keep their size, which is their target size."""
    factor: float = 1.0
    """Initial factor on the size field on the finest level."""
    own_factor: float = 1.0
    """Size of the cells over that of the size field, if a method keeps another number of cells than the field has."""
    around: FixedGenerators | None = None
    """Generators beside lines, or around corners or creases: the last of `points`."""
    after_layers: Field | None = None
    """If layers of prisms compress cells, the sizes of cells afterwards; `sizing` has those before."""

    @property
    def first_sized(self) -> int:
        """Label of the first generator whose target size is the size of its cell, whatever the size field is."""
        return len(self.points) - (0 if self.around is None else self.around.n_sized)

    @property
    def first_row(self) -> int:
        """Label of the first generator of layers."""
        return len(self.points)

    def place_fixed(self, points: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return generators and labels with the fixed ones, and whose places these have taken; see `take_places`."""
        points, labels, taken = take_places(points, labels, self.points, self.domain, self.fixed)
        if self.around is not None:
            points, labels = clear_balls(points, labels, self.around, self.domain, self.fixed)
        return points, labels, taken

    def on(self, engine: Engine) -> Setup:
        """Return the same with stages of their own, on another `engine` of the same kind."""
        return replace(self, stages=Stages(engine), sizing=self.sizing.on(engine))


class MeshState:
    """Generators of one level with their diagram, sizes, error and quality, all on the device.

    - `size_factor`: factor on the size field: 2^k on level k above the finest.
    - `start`: points and labels of the generators, removed from the dict; or those arrays of another mesh from which
      all others follow (`Arrays.kept`).
    - `coarser`: tessellator of the coarser level.
    - `next_label`: label of the next generator; by default the number of generators.
    - `taken` (k,) int32: as the attribute; by default -1.

    Its attributes:
    - `n`, `total`: number of generators of this part, and of all parts of the domain.
    - `points` (n, d) real: normalized coordinates, in the order of the bins.
    - `labels` (n,) int32: permanent names of the generators.
    - `velocity` (n, d) real: displacement in the last step.
    - `signatures` (n,) uint64: hashes of the sets of neighbors; see `Neighborhoods`.
    - `ever_changed` (n,) real: 1 where the set of neighbors has changed in a step on this level, else 0.
    - `h`, `error`, `quality`: (n,) real
    - `local_length` (n,) real: min(L, h), the unit of bounds of the motion.
    - `follows_log_ratio`: summarize log(L / h) with error and quality, so that `mean_log_ratio_error` needs no transfer
      of its own.
    - `taken` (k,) int32: labels of those whose places fixed generators have taken; -1 for none.
    - `power`: what made the present diagram, if it is a power diagram.
    """

    points = _property("generators", "points")
    labels = _property("generators", "labels")
    velocity = _property("generators", "velocity")
    signatures = _property("generators", "signatures")
    ever_changed = _property("generators", "ever_changed")
    h = _property("cells", "h")
    error = _property("cells", "error")
    quality = _property("cells", "quality")
    local_length = _property("cells", "local_length")

    def __init__(
        self,
        setup: Setup,
        size_factor: float,
        start: dict[str, cla.Array] | Arrays,
        coarser: Tessellator | None = None,
        next_label: int | None = None,
        taken: np.ndarray | None = None,
    ) -> None:
        self.setup, self.size_factor = setup, size_factor
        self.stages, self.domain, self.sizing = setup.stages, setup.domain, setup.sizing
        self.free, self.fixed = setup.free, setup.fixed
        self.engine = self.stages.engine
        self.summaries = Summaries(self.engine, SUMMARIES)
        self._ordered: cla.Array | None = None
        self.tessellator = Tessellator(self.stages, self.domain, self._target_sizes, coarser, straight=True)
        self.power: Tessellator | None = None
        self.follows_log_ratio = self._knows_log_ratio = False
        self.taken = np.full(setup.first_row, -1, np.int32) if taken is None else taken
        if isinstance(start, Arrays):
            self._data = start
        n = len(start.generators) if isinstance(start, Arrays) else len(start["points"])
        self.total = int(self.engine.peers.total(n))
        self.next_label = self.total if next_label is None else next_label
        if isinstance(start, Arrays):
            self.tessellate_anew()
            return
        start["velocity"] = self.engine.zeros(start["points"].shape)
        start["signatures"] = self.engine.zeros(n, np.uint64)
        start["ever_changed"] = self.engine.zeros(n)
        self.set_generators(start, first=True)

    def renewed(self) -> MeshState:
        """Return this mesh with everything computed anew from its `Arrays.kept`, as a resumed run does.

        This mesh and the diagram of all stages cannot be used afterwards.
        """
        self._data = self._data.kept()
        self.stages.release()
        return MeshState(self.setup, self.size_factor, self._data, next_label=self.next_label, taken=self.taken)

    def copy(self) -> MeshState:
        """Return a copy with stages of its own, whose diagram is computed anew."""
        engine = self.engine
        own = Engine(engine.ctx, engine.queue, engine.dim, engine.real, engine.traits, peers=engine.peers)
        setup = self.setup.on(own)
        return MeshState(setup, self.size_factor, self._data.copy(), next_label=self.next_label, taken=self.taken)

    @property
    def n(self) -> int:
        """Number of generators."""
        return self._data.generators.points.shape[0]

    @property
    def arrays(self) -> Arrays:
        """All arrays."""
        return self._data

    @property
    def tessellation(self) -> Tessellation | None:
        """The present diagram; None before the first `update`."""
        return self._data.tessellation

    @tessellation.setter
    def tessellation(self, t: Tessellation | None) -> None:
        self._data.tessellation = t

    @property
    def t(self) -> Tessellation:
        """The present diagram."""
        assert self._data.tessellation is not None
        return self._data.tessellation

    @property
    def potential(self) -> cla.Array:
        """Solution of the last Poisson solve, the start of the next one, (n,) real; at first 0."""
        if self._data.potential is None:
            self._data.potential = self.engine.zeros(self.n)
        return self._data.potential

    @property
    def multipliers(self) -> cla.Array | None:
        """Solution of the last volume projection, the start of the next one, (n,) float32, if there is one."""
        return self._data.multipliers

    @multipliers.setter
    def multipliers(self, array: cla.Array) -> None:
        self._data.multipliers = array

    @property
    def moving(self) -> Moving:
        """The generators, to be moved."""
        return Moving(self.points, self.velocity, self.labels, self.fixed)

    @property
    def present(self) -> Present:
        """What insertions and deletions change: the generators and their cells, labels and fixed ones."""
        return Present(self.free, self.t, self._data.generators, self.next_label, self.fixed)

    def ordered(self, array: cla.Array) -> np.ndarray:
        """Return `array` (n, ...) on the host in the order of labels."""
        # The labels are a new array whenever the order changes.
        if self._ordered is not self.labels:
            self._order, self._ordered = order_of(self.labels.get()), self.labels
        return np.take(array.get(), self._order, axis=0)

    def to_host(self, array: cla.Array, factor: float = 1.0) -> np.ndarray:
        """Return `array` (n, ...) on the host in the order of labels, times `factor`."""
        return np.multiply(self.ordered(array), factor, dtype=np.float64)

    def displacements(self, d: Displacement) -> Displacements:
        """Return the two parts of a displacement on the host."""
        origin, scale = self.domain.frame
        x = self.to_host(self.points, scale) + origin
        return Displacements(x, self.to_host(d.lloyd, scale), self.to_host(d.correction, scale))

    @cached_property
    def has_thin_walls(self) -> bool:
        """Whether walls of the domain are thinner than the cells of this level."""
        setup, domain = self.setup, self.domain.outline
        if domain is None:
            return False
        # `normalize_sizes` changes the factor by little: all of a level, also resumed, has the same walls.
        level = round(math.log2(self.size_factor / setup.factor))
        factor = 2.0**level * setup.factor * setup.own_factor
        return has_thin_walls(domain, factor * np.asarray(self.sizing(domain.oriented.vertices), float))

    def pair_generators(self) -> None:
        """Move generators beside thin walls to be mirror images of each other. The diagram is then out of date."""
        if self.has_thin_walls:
            self.stages.thin_walls.pair(self.free, self.t, self.h, self.moving)

    @cached_property
    def balls(self) -> Balls | None:
        """Balls beside lines and around creases, which have generators on the finest level only."""
        around = self.setup.around
        if around is None or not len(around.balls) or round(math.log2(self.size_factor / self.setup.factor)):
            return None
        origin, scale = self.domain.frame
        spheres = np.column_stack([(around.centers - origin) / scale, around.radii / scale])[around.balls]
        engine, count = self.engine, len(around)
        starts = engine.upload(around.ball_starts, np.int32)
        return Balls(self.setup.first_row - count, count, starts, engine.upload(spheres))

    def _target_sizes(self, points: np.ndarray) -> np.ndarray:
        """Return the target size at `points` (k, d) on this level, (k,)."""
        return self.size_factor * np.asarray(self.sizing(points))

    def set_generators(self, rows: dict[str, cla.Array], first: bool = False, inserted: int = 0) -> None:
        """Replace the generators, sort them by bin for locality in memory, and update the mesh.

        - `rows`: the fields of `Generators`, removed from the dict. Memory is freed only if there is no other
          reference.
        - `first`: there are no earlier ones.
        - `inserted`: how many of them are new.
        """
        stages, peers = self.stages, self.engine.peers
        if peers.count > 1 and (first or not is_balanced(len(rows["points"]), peers)):
            rows = distribute(self.engine, self.domain, rows)
        n = len(rows["points"])
        total = int(peers.total(n))
        binned = stages.bins.build(self.domain, rows["points"], n)
        stages.bins.clear_work()
        items = binned.items[:n].copy()
        # One array after the other, so that each is freed when it has been sorted.
        new = {name: stages.gather.rows(items, rows.pop(name)) for name in list(rows)}
        # One assignment, because an interruption between two would leave numbers that are not those of the generators.
        self._data, self.total, self.next_label = Arrays(Generators(**new)), total, self.next_label + inserted
        del new, items
        stages.bins.renumber(binned, n)
        self.update(first, binned)
        stages.bins.clear()
        self.engine.workspace.shrink()

    def update(self, first: bool = False, binned: BinnedPoints | None = None) -> None:
        """Tessellate the present points without weights, evaluate size, error and quality, and read the summaries.

        An update of the last diagram is evaluated before the host knows whether it is right. All that the host needs is
        read in one transfer: the report of the update, the summaries, and whether all sizes are valid.

        - `first`: there is no earlier diagram to compare neighbors with.
        - `binned`: the points in their bins, if the caller has them.
        """
        stages, data = self.stages, self._data
        data.weights = None
        if data.cells is None:
            data.cells = CellArrays.empty(self.engine, self.n)
        previous = data.tessellation
        if previous is not None and previous.is_power:
            previous = None

        def evaluate(t: Tessellation, report: cla.Array | None) -> list[int]:
            data.tessellation = t
            if report is None and self.engine.cell_dim == 2:
                # The next diagrams are usually updated from this one.
                stages.bins.clear()
            self.sizing.evaluate(self.points, self.n, self.h, self.size_factor)
            self.compare_and_evaluate(first)
            return self._read(report)

        data.tessellation = self.tessellator.tessellate(
            self.points, self.n, previous, binned=binned, follow=evaluate, labels=self.labels
        )

    def tessellate_anew(self) -> None:
        """Tessellate the present points without an earlier diagram, and evaluate size, error and quality."""
        if self._data.weights is None:
            self.update()
            return
        self._data.cells = CellArrays.empty(self.engine, self.n)
        self.power = Tessellator(self.stages, self.domain, weighted=True)
        self.sizing.evaluate(self.points, self.n, self.h, self.size_factor)
        self.tessellation = self.power.tessellate_weighted(self.points, self._data.weights, self.n)
        self.compare_and_evaluate()

    def prescribe_volumes(self) -> Solution:
        """Give the cells of a power diagram the volumes h^d, times the factor with which they fill the domain.

        Damped Newton steps find the weights. Returns the last linear solve.
        """
        data, stages = self._data, self.stages
        if self.power is None:
            self.power = Tessellator(stages, self.domain, weighted=True)
        self.sizing.evaluate(self.points, self.n, self.h, self.size_factor)
        self.sizing.check(self.points, self.h, self.size_factor)
        prescribed = stages.transport.prescribe_sizes(self.h)
        data.tessellation, data.weights, newton = stages.transport.solve(
            self.power, self.points, prescribed, data.weights
        )
        factor = newton.factor ** (1 / self.engine.cell_dim)
        self.size_factor *= factor
        stages.metric.scale_sizes(factor, self.h)
        self.compare_and_evaluate()
        return newton.solution

    def compare_and_evaluate(self, first: bool = False) -> None:
        """Compare the neighbors with those of the last diagram, and evaluate error and quality."""
        with self.engine.workspace.frame():
            changed = self.engine.scratch(self.n)
            self.evaluate_metric(Neighborhoods(self.labels, self.signatures, changed, self.ever_changed, first))

    def evaluate_metric(self, compared: Neighborhoods | None = None) -> None:
        """Evaluate and summarize error and quality, and compare neighbors."""
        first = self.setup.first_sized
        if self.fixed > first:
            self.stages.metric.set_fixed_sizes(self.labels, first, self.fixed, self.t.volumes, self.h)
        with self.engine.workspace.frame():
            energy = self.engine.scratch(self.n)
            self.stages.metric.evaluate(self.t, self.h, self.error, self.quality, energy, self.local_length, compared)
            own = {"error": self.error, "quality": self.quality, "energy": energy}
            if compared is not None:
                own |= {"changed": compared.changed, "ever_changed": compared.ever_changed}
            if self.follows_log_ratio:
                own["log_ratio"] = self.stages.density.cell_weights(self.t, self.h).log_ratio
            self._knows_log_ratio = self.follows_log_ratio
            self.summaries.collect_all(own, self.n)

    def move(self, d: Displacement) -> None:
        """Move the generators. The diagram is then out of date."""
        self.stages.motion.move_generators(self.free, self.points, d, self.velocity)
        if self.balls is not None:
            self.stages.motion.leave_balls(self.free, self.t, self.balls, self.moving)

    def summarize_displacements(self, lloyd: cla.Array, correction: cla.Array) -> None:
        """Summarize the lengths of both displacements (n, d) over h."""
        self.summaries.collect_all({"lloyd": lloyd, "correction": correction}, self.n, self.h)

    def zero_fixed(self, displacement: cla.Array) -> None:
        """Set `displacement` (n, d) to zero for fixed generators."""
        if self.fixed:
            self.stages.motion.zero_fixed_displacements(self.labels, self.fixed, displacement)

    def mean_log_ratio_error(self, w: CellWeights) -> float:
        """Return the mean of |log(L / h)|."""
        if not self._knows_log_ratio:
            self.summaries.collect("log_ratio", w.log_ratio, self.n)
        self._knows_log_ratio = True
        return self.summaries.read_one("log_ratio").magnitude / self.total / self.engine.cell_dim

    def missing_cells(self, w: CellWeights | None = None) -> float:
        """Return how many more cells the size field requires; negative if there are too many.

        This is the sum of V rho minus n. The sum of log(V rho) would be biased by the scatter of the cell sizes.
        """
        with self.engine.workspace.frame():
            w = self.stages.density.cell_weights(self.t, self.h) if w is None else w
            self.summaries.collect("weight", w.weight, self.n)
        return self.summaries.read_one("weight").sum - self.total

    def normalize_sizes(self) -> None:
        """Scale the size field by the factor that makes the mean of log(L / h) zero; cells of layers have h = L."""
        with self.engine.workspace.frame():
            w = self.stages.density.cell_weights(self.t, self.h)
            self.summaries.collect("log_ratio", w.log_ratio, self.n)
        free = self.total - max(self.fixed - self.setup.first_row, 0)
        self.multiply_sizes(math.exp(self.summaries.read_one("log_ratio").sum / free / self.engine.cell_dim))

    def multiply_sizes(self, factor: float) -> None:
        """Multiply the size field by `factor`."""
        self.size_factor *= factor
        self.stages.metric.scale_sizes(factor, self.h)
        self.evaluate_metric()

    def sizes_over_mesh(self) -> np.ndarray | None:
        """Return the factors by which cells are larger on the device than in the mesh, which differs at curved walls.

        (n,), in the order of rows; infinite where the mesh lacks the cell. None if all walls are straight.
        """
        volumes = self.tessellator.steps.volumes_of_mesh(self.t, self.labels)
        if volumes is None:
            return None
        here = self.to_host(self.t.volumes, self.domain.frame[1] ** 3)
        factors = np.empty(self.n)
        factors[self._order] = np.where(volumes > 0, np.cbrt(here / np.where(volumes > 0, volumes, 1)), np.inf)
        return factors.astype(self.engine.real)

    def insert_delete(
        self,
        nuclei: int = 0,
        n_cells: int | None = None,
        climb: bool = True,
        climb_strain: float = CLIMB_STRAIN,
        most: float = math.inf,
    ) -> tuple[int, int]:
        """Insert and delete generators (see `InsertionDeletion.insert_delete`); return the numbers of both.

        The number of generators changes towards `n_cells`, by default that of the size field, but not above `most`.
        """

        def changed() -> Outcome | None:
            w = self.stages.density.cell_weights(self.t, self.h)
            missing = self.missing_cells(w) if n_cells is None else float(n_cells - self.total)
            change = Change(min(missing, most - self.total), nuclei, climb, climb_strain)
            sizes = CellSizes(self.h, self.local_length, w.log_ratio)
            return self.stages.insertion_deletion.insert_delete(self.present, sizes, change)

        return self._replace_by(changed)

    def delete_lost(self, lost: np.ndarray) -> int:
        """Delete the generators where `lost` (n,) is true, but no fixed ones; return how many are deleted."""
        sites = np.zeros((2, self.t.rows), np.uint64)
        sites[1, : self.n] = lost & (self.labels.get()[: self.n] >= self.fixed)
        none, chosen = (self.engine.upload(which, np.uint64) for which in sites)
        split_delete = self.stages.insertion_deletion.split_delete
        return self._replace_by(lambda: split_delete(self.present, (none, chosen)))[1]

    def repair_cells(self, deficit: float, split: bool) -> tuple[int, int]:
        """Delete or split the worst cells (see `InsertionDeletion.repair_cells`); return the numbers of both."""
        insertion_deletion = self.stages.insertion_deletion
        return self._replace_by(lambda: insertion_deletion.repair_cells(self.present, self.quality, deficit, split))

    def balance_counts(self) -> tuple[int, int]:
        """Insert and delete generators where parts of the domain have too few or too many; return the numbers of both.

        See `LocalCounts`.
        """
        stages, engine = self.stages, self.engine

        def changed() -> Outcome | None:
            w = stages.density.cell_weights(self.t, self.h)
            changes, new = engine.scratch(self.n, np.int32), None
            if stages.local_counts.choose(self, w, changes):
                sites = (stages.local_counts.sites(changes, 1), stages.local_counts.sites(changes, -1))
                new = stages.insertion_deletion.split_delete(self.present, sites)
            stages.clear_poisson()
            return new

        stages.clear_poisson()
        return self._replace_by(changed)

    def balance_regions(self, missing: float, begun: bool) -> tuple[int, int]:
        """Insert and delete where fixed generators cut regions off; return the numbers of both.

        Faces between fixed generators stay. So no displacement evens out the numbers of cells on both sides of them.
        Cells next to each other do not change in one call. Calls after the first one go on with what is `begun`.

        - `missing`: how many cells are missing in all. The largest region gets what the others leave.
        """
        stages, engine, t = self.stages, self.engine, self.t

        def changed() -> Outcome | None:
            w = stages.density.cell_weights(t, self.h)
            held = t.names(engine, self.labels).get() < self.fixed
            regions = Components(engine, t, held)
            cells, required, free = regions.sums(None, w.weight, ~held[: self.n])
            lacks = np.where(free > 0, np.rint(required - cells), 0).astype(int)
            largest = free.argmax()
            lacks[largest] = 0
            if not begun and not lacks.any():
                return None
            lacks[largest] = round(missing) - lacks.sum()
            return stages.insertion_deletion.change_regions(self.present, w.log_ratio, regions.of_cell, lacks)

        stages.clear_poisson()
        return self._replace_by(changed)

    def delete_squeezed(self) -> None:
        """Delete small cells between balls: generators that are squeezed between balls cannot move away."""
        if self.balls is None:
            return
        stages, engine = self.stages, self.engine

        def changed() -> Outcome | None:
            ratio = stages.density.cell_weights(self.t, self.h).log_ratio.get()
            small = (ratio < engine.cell_dim * math.log(SQUEEZED)) & (self.labels.get() >= self.fixed)
            if not small.any():
                return None
            sites = engine.zeros(self.n, np.uint64), engine.upload(small, np.uint64)
            return stages.insertion_deletion.split_delete(self.present, sites)

        stages.clear_poisson()
        engine.workspace.clear()
        self._replace_by(changed)

    def _replace_by(self, changed: Callable[[], Outcome | None]) -> tuple[int, int]:
        """Replace the generators by those that `changed` returns, if any; return the numbers of new and deleted ones.

        That takes more memory than a step.
        """
        rows, counts, workspace = {}, (0, 0), self.engine.workspace
        workspace.shrink()
        with workspace.frame():
            new = changed()
            if new is not None:
                # By name, so that each array can be freed on its own.
                rows, counts = dict(vars(new.generators)), (new.inserted, new.deleted)
            del new
        workspace.shrink()
        self.stages.insertion_deletion.clear()
        if rows:
            self.set_generators(rows, inserted=counts[0])
        return counts

    def open_triangles(self) -> tuple[int, bool]:
        """Move generators away from the opposite sides of obtuse triangles, and update the mesh.

        Returns their number, and whether the mesh has changed: not if there are none, or too many to be opened.
        """
        with self.engine.workspace.frame():
            displacement = self.engine.scratch(self.points.shape)
            count = int(self.engine.peers.total(self.stages.quality_descent.open_triangles(self.t, displacement)))
            if not count or count > MOST_OBTUSE * self.total:
                return count, False
            self.zero_fixed(displacement)
            self.move(Displacement(displacement, displacement, self.local_length, correction_share=0.0, bound=0.5))
        self.update()
        return count, True

    def _read(self, report: cla.Array | None) -> list[int]:
        """Read the summaries and the report of a diagram in one transfer, check the sizes, and return the report."""
        given = [] if report is None else [report]
        invalid = self.sizing.invalid_index
        if invalid is None:
            return self.summaries.read_with(*given)
        first, *numbers = self.summaries.read_with(invalid, *given)
        self.sizing.check(self.points, self.h, self.size_factor, first)
        return numbers

    def refined_count(self) -> int:
        """Return the number of generators after `refine`."""
        return int(self.engine.peers.total(self.stages.refinement.count(self.t)))

    def refine(self, finest: bool = False, begin: Callable[[dict[str, Any]], object] = lambda _: None) -> MeshState:
        """Return the mesh of the next finer level. The present generators keep their labels.

        On the finest one fixed generators take the places of others. `begin` is called before the mesh is made, with
        those arguments of `MeshState` that are the same in all parts.
        """
        self.stages.metric.scale_sizes(0.5, self.h)
        rows = self.fixed if self.fixed > self.setup.first_row else 0
        finer = self.stages.refinement.refine(self.free, self.t, self.h, self.labels, rows)
        start, n, peers = {"points": finer}, len(finer), self.engine.peers
        del finer
        first = self.next_label - self.n + int(peers.before(n - self.n))
        start["labels"] = self.engine.upload(np.arange(first, first + n, dtype=np.int32), np.int32)
        cl.enqueue_copy(
            self.engine.queue, buffer_of(start["labels"]), buffer_of(self.labels), byte_count=self.labels.nbytes
        )
        taken = self.taken
        if finest and len(taken):
            host = start["points"].get(), start["labels"].get()
            if peers.count > 1:
                setup, near = self.setup, near_places(host[0], self.setup.points, self.domain)
                told = [np.concatenate(peers.exchange([array[near]] * peers.count)) for array in host]
                taken = find_places(*told, setup.points, self.domain, self.fixed)
                new = put_fixed(*host, setup.points, taken, self.domain, last=peers.number == peers.count - 1)
            else:
                *new, taken = self.setup.place_fixed(*host)
            start["points"], start["labels"] = map(self.engine.upload, new, (None, np.int32))
        # Free the other arrays. After an interruption `update` computes them again.
        self._data = Arrays(self._data.generators)
        next_label = self.next_label + int(peers.total(n - self.n))
        given = {"size_factor": self.size_factor / 2, "next_label": next_label, "taken": taken}
        begin(given)
        return MeshState(self.setup, start=start, coarser=self.tessellator, **given)

    def finalize(self) -> bool:
        """Free what only steps need, and evaluate the diagram in full precision, for `fetch_diagram`.

        Return whether the diagram has been computed again for that.
        """
        self.stages.clear_poisson()
        self.engine.workspace.shrink()
        tessellator, sites = self._latest_tessellator, self.t.sites if self.t.is_power else self.points
        again = not tessellator.is_complete(self.t)
        if again:
            # Free the present diagram before the new one is computed.
            self.tessellation = None
            self.tessellation = tessellator.complete(self.points, sites, self.n, self.labels)
        self.tessellation = tessellator.final(self.t)
        tessellator.steps.warn_of_leaks(self.t)
        self.evaluate_metric()
        return again

    @property
    def _latest_tessellator(self) -> Tessellator:
        """The tessellator that made the present diagram."""
        return self.tessellator if self.power is None or not self.t.is_power else self.power

    def cell_targets(self, exact: bool) -> CellTargets:
        """Return what generators at curved walls settle to; if it is `exact`, sizes matter more than shapes."""
        return CellTargets(self.to_host(self.h, self.domain.frame[1]) ** self.engine.cell_dim, self.fixed, exact)

    def fetch_diagram(self, held: int = 0, targets: CellTargets | None = None) -> Diagram:
        """Return the diagram and free the buffers of all stages. The mesh cannot be used afterwards.

        The first `held` generators stay where others are moved because OpenFOAM would reject cells. At curved walls
        generators settle to `targets`, if given.
        """
        tessellator = self._latest_tessellator
        latest = [tessellator.steps.measure_exactly(self.t)]
        self.tessellation = None
        self.stages.release()
        engine = tessellator.stages.engine.alone()
        if latest[0].part is not None:
            return fetch_part(engine, self.domain, latest.pop(), self.labels)
        # No list or frame here holds the cells any longer: a solid frees them before it makes others.
        return fetch_diagram(engine, self.domain, latest.pop(), self.labels, copy=False, held=held, targets=targets)
