"""The steps of a part of a domain: generators of other parts as ghosts, and the proof that there are enough of them.

The ball around a corner of a cell, with the generator of the cell on its surface, contains no other generator. The
reach of a cell is the distance of its farthest corner from its generator. The ball around the generator with twice this
radius contains the balls of all corners. So a cell is final if this part knows all generators in that ball.

Each part tells the others the boxes around its generators, and asks those whose boxes meet its balls for the generators
inside. It asks for balls that are larger than necessary. So the ghosts are enough for some steps. When the cells are
known, the room beyond the balls that they need is divided: balls become larger by a share of it, and the rest is a skin
in which there is no unknown generator. If few cells need larger balls, parts ask only for those. They ask for all anew
when that is not enough, or when a generator has moved so far that it may be in a ball of a part that does not know it
(`sum_cells` in part.cl). If there are new ghosts, all parts make their cells again.

The host works on generators near other parts only. A kernel finds the boxes around runs of successive generators; those
of runs far from the boxes of all other parts stay on the device (`Border`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import scipy

from ..errors import ClvoroError
from ..geometry.domain import Domain
from ..opencl.device_array import buffer_of
from ..opencl.engine import Engine
from ..opencl.kernels import Kernels
from ..opencl.primitives import NamedArrays
from .bins import BinnedPoints
from .clipped.cut import Cut
from .cut_cells import CutCells
from .decomposition import hilbert_keys
from .device_diagram import Follow, Tessellation
from .part import Ghosts, Part, follow_images
from .periodic.ghost_images import ExtendedBox
from .periodic.images import FewCellsError
from .polyhedra import Polyhedra
from .stages import TessellationStages
from .steps import DomainSteps, Sort

FIRST_REACH = {2: 3.3, 3: 2.5}
"""Radius of the first balls over the spacing of the generators around, by the dimension of cells. Where cells have two,
those of neighboring ghosts must be final, too."""
LAST_LABEL = 2**31 - 1
"""Label of the first ghost generator outside of a polygon; the others have those before it."""
RUN, AHEAD, LOOSE = 32, 4, 1.5
"""Number of generators in a run, and of the next ones from which the distances of each are compared. Bound of the
spacing of a run over its estimate."""
JUMP = 12
"""Number of spacings between successive generators, or runs, beyond which a new chunk begins."""
GROWTH, SKIN, SHARE = 1.4, 0.25, 0.4
"""`GROWTH`: radius of the balls of a part, divided by the radius that its cells need. `SKIN`: width of the skin around
each ball, as a share of the ball's radius. A part also asks for generators in the skin: they may move into the ball.
`SHARE`: of the room between the ball that a cell needs and the nearest generator that is not known, what the ball gets;
the rest is skin."""
NEAR, FAR, FREE, FEW = 1.25, 2.5, 0.8, 32
"""`NEAR`: largest distance between a ball and a box of another part that are compared, over the largest radius of the
balls of both; `FAR`: that between a run and such a box, twice as much, so that the balls of other runs do not meet.
`FREE`: radius around a generator within which all others are known, over its distance from other parts. `FEW`: number
of generators up to which all runs count as near, over that of a part as wide as the borders along its faces."""
FARTHEST = 1e6
"""A distance beyond all others, in units of the domain's frame."""
NOISE = {"float64": 1e-6, "float32": 1e-4}
"""Bound of the round-off of a reach, as a share of it."""
FILLED, MATCHED = {"float64": 1e-8, "float32": 1e-3}, {"float64": 1e-5, "float32": 1e-3}
"""`FILLED`: largest relative difference between the volume of all cells and that of the domain. `MATCHED`: largest
relative difference between the measures of faces between parts, seen from both sides."""
GROUP = 64
"""Number of balls in each group of the balls that another part has sent."""
MENDED, WIDER = 256, 1.2
"""Largest number of generators that get other limits without asking for all anew. Radius of their balls over the needed
one."""
FAILED = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
"""Summands of a part whose update has failed: zeros for those of `Part.sums`, 1 for the number of failed parts, and the
attempt to trace the boundary of a polygon."""


@cache
def _curve(dim: int) -> np.ndarray:
    """Return the places along a Hilbert curve of the cells of a grid, row by row; the grid has at most 2^16 cells."""
    side = 2 ** (16 // dim)
    cells = np.indices((side,) * dim).reshape(dim, -1).T
    return hilbert_keys(cells, np.zeros(dim), np.full(dim, side), 16 // dim).astype(np.uint16)


def _nearest_ahead(axes: np.ndarray) -> np.ndarray:
    """Return the square of the distance of each point, a column of `axes` (d, n), from the nearest of the next `AHEAD`.

    The result is (n,) float.
    """
    nearest = np.full(axes.shape[1], np.inf)
    for ahead in range(1, min(AHEAD, axes.shape[1] - 1) + 1):
        np.minimum(nearest[:-ahead], _squares(axes[:, ahead:] - axes[:, :-ahead]), out=nearest[:-ahead])
    return nearest


def _squares(ways: np.ndarray) -> np.ndarray:
    """Return the squares of the lengths of `ways` (d, n), (n,)."""
    return np.sum(np.square(ways, out=ways), axis=0)


def _largest_of_three(usual: np.ndarray) -> np.ndarray:
    """Return the largest of each of `usual` (r,) and the two beside it, (r,)."""
    return np.maximum(usual, np.maximum(np.append(usual[1:], usual[-1]), np.append(usual[0], usual[:-1])))


class Chunks:
    """Points, or boxes around runs, divided into chunks: parts of a Hilbert curve through the cells of a grid.

    - `lower`, `upper` (n, d) float: corners of the boxes; the same array for points.
    - `spacings` (n,) float: an estimate of the spacing of generators there.
    - `count`: least number of chunks.
    - `estimate`: whether there is a better estimate to be found, not above `spacings`. `RUN` points have the median of
      their distances from the nearest of the next `AHEAD`, in the order of chunks or of points; each has the largest of
      three runs, its own and the two beside it.

    Its attributes:
    - `order` (n,) int: the items chunk by chunk.
    - `firsts`, `sizes` (k,) int: where the chunks begin, and their numbers of items.
    - `groups` (n,) int: the chunk of each item.
    - `spacings` (n,) float
    """

    def __init__(
        self, lower: np.ndarray, upper: np.ndarray, spacings: np.ndarray, count: int, estimate: bool = False
    ) -> None:
        # Extrema over the axes of many points take a tenth of the time if each axis is contiguous.
        (n, dim), middle = lower.shape, lower if upper is lower else (lower + upper) / 2
        side, cells, least = 2 ** (16 // dim), np.zeros(n, np.int32), spacings.min() / 16
        axes = np.ascontiguousarray(middle.T)
        for x in axes:
            along = ((x - x.min()) * (side / max(np.ptp(x), least))).astype(np.int32)
            cells = cells * side + np.minimum(along, side - 1, out=along)
        self.order = np.argsort(_curve(dim)[cells], kind="stable")
        x = np.ascontiguousarray(np.take(middle, self.order, axis=0).T)
        if estimate and n >= 2 * RUN:
            ahead = np.minimum(_nearest_ahead(x), _nearest_ahead(axes)[self.order])
            runs = np.arange(n // RUN) * RUN
            usual = np.sqrt(np.partition(ahead[: len(runs) * RUN].reshape(-1, RUN), RUN // 2, axis=1)[:, RUN // 2])
            usual = np.repeat(_largest_of_three(usual), np.diff(np.append(runs, n)))
            spacings = spacings.copy()
            spacings[self.order] = np.minimum(spacings[self.order], np.maximum(usual, least))
        self.spacings = spacings
        # Generators may have moved far from the others of their part.
        if upper is lower:
            ways = np.sqrt(_squares(np.diff(x)))
        else:
            ways = pair_gaps(lower, upper, self.order[1:], np.hstack([lower, upper]), self.order[:-1])
        jumps = 1 + np.flatnonzero(ways > JUMP * spacings[self.order[:-1]])
        self.firsts = np.unique(np.concatenate([np.arange(count) * n // count, jumps]))
        self.sizes = np.diff(np.append(self.firsts, n))
        self.groups = np.empty(n, np.int32)
        self.groups[self.order] = np.repeat(np.arange(len(self.firsts)), self.sizes)

    def rows(self, chosen: np.ndarray) -> np.ndarray:
        """Return the items of the `chosen` chunks, chunk by chunk."""
        ends = np.cumsum(self.sizes[chosen])
        if not len(ends):
            return np.empty(0, int)
        first = np.repeat(self.firsts[chosen] - ends + self.sizes[chosen], self.sizes[chosen])
        return self.order[np.arange(ends[-1]) + first]


class BallGroups:
    """The balls in which a part has to know all generators. The balls around the items of a chunk are a group.

    - `lower`, `upper` (n, d) float: where their centers are: for generators both are `centers`, for runs the corners
      of their boxes.
    - `radii`: (n,) float

    Its attributes:
    - `asked` (n,) float: the radii as given; `radii` become smaller.
    - `boxes` (k, 2 d) float: lower and upper corners of boxes around the centers of each group.
    - `facts` (k, 2 d + 2) float: what other parts have to know: the boxes, the largest radius and the smallest skin.
    """

    def __init__(self, lower: np.ndarray, upper: np.ndarray, radii: np.ndarray, chunks: Chunks) -> None:
        self.centers, self.upper, self.asked, self.radii, self.chunks = lower, upper, radii, radii.copy(), chunks
        radii, order, firsts = radii[chunks.order], chunks.order, chunks.firsts
        self.largest = np.maximum.reduceat(radii, firsts)
        corners = (np.minimum, lower), (np.maximum, upper)
        self.boxes = np.hstack([f.reduceat(np.take(x, order, axis=0), firsts, axis=0) for f, x in corners])
        self.facts = np.column_stack([self.boxes, self.largest, SKIN * np.minimum.reduceat(radii, firsts)])

    def facing(self, facts: np.ndarray, limit: float = NEAR) -> Facing:
        """Return how far these balls are from the boxes of another part, which has sent its `facts` (k, 2 d + 2).

        Those within `limit` times the largest radius of both are pairs.
        """
        boxes, largest = facts[:, :-2], facts[:, -2]
        away = gaps(self.boxes, around(boxes))[:, 0]
        near = np.flatnonzero(away <= limit * np.maximum(self.largest, largest.max()))
        ways, limits = gaps(self.boxes[near], boxes), limit * np.maximum.outer(self.largest[near], largest)
        chosen, beside = np.nonzero(ways <= limits)
        away[near] = np.min(ways, axis=1, where=ways > limits, initial=FARTHEST)
        # Pairs of each ball in these groups with all boxes beside its group.
        counts = np.bincount(chosen, minlength=len(near))
        begins, meet = np.cumsum(counts) - counts, np.flatnonzero(counts)
        balls, sizes = self.chunks.rows(near[meet]), self.chunks.sizes[near[meet]]
        if not len(balls):
            return Facing(facts, away, balls, np.empty(0), balls, balls, np.empty(0))
        first, count = np.repeat(begins[meet], sizes), np.repeat(counts[meet], sizes)
        ends = np.cumsum(count)
        pairs = np.arange(ends[-1]) + np.repeat(first - ends + count, count)
        places, others, limits = np.repeat(balls, count), beside[pairs], limits[chosen, beside][pairs]
        ways = pair_gaps(self.centers, self.upper, places, boxes, others)
        close = ways <= limits
        apart = np.minimum.reduceat(np.where(close, FARTHEST, ways), ends - count)
        apart = np.minimum(apart, np.repeat(away[near[meet]], sizes))
        return Facing(facts, away, balls, apart, places[close], others[close], ways[close])

    def meeting(self, facing: Facing) -> np.ndarray:
        """Return which balls, with their skins, meet a box in which the other part has generators, (m,) int."""
        found = facing.places[facing.ways <= (1 + SKIN) * self.radii[facing.places]]
        return found[np.diff(found, prepend=-1) != 0]


@dataclass(frozen=True)
class Facing:
    """The balls of a part that are near boxes of another part.

    - `facts` (m, 2 d + 2) float: facts about the groups of the other part; see `BallGroups`.
    - `away` (k,) float: lower bound of the distance of the centers of a group from the boxes with which it has no
      pairs. This distance is also larger than the limit of pairs.
    - `balls`, `apart` (b,) int, float: the balls of groups with pairs, and the same bound for each of them.
    - `places`, `others`, `ways` (p,) int, int, float: pairs of a ball and a box in the order of `balls`, and the
      distances of the ball's center from this box.
    """

    facts: np.ndarray
    away: np.ndarray
    balls: np.ndarray
    apart: np.ndarray
    places: np.ndarray
    others: np.ndarray
    ways: np.ndarray


@dataclass(frozen=True)
class Border:
    """The runs of generators of a part that are near other parts. The host does not read where others are.

    - `rows` (m,) int: the generators of these runs, in ascending order.
    - `begins` (r,) int32: where each run begins in `rows`; -1 for the others.
    - `spacings` (r,) float: an estimate of the spacing of the generators of each run.
    - `inner` (r, 2) float: limits of the generators of the others; see `sum_cells` in part.cl.
    - `boxes`: where the generators of each run are; a run that crosses a gap has two boxes.
    - `runs` (b,) int: the run of each box.
    """

    rows: np.ndarray
    begins: np.ndarray
    spacings: np.ndarray
    inner: np.ndarray
    boxes: BallGroups
    runs: np.ndarray

    def places(self, rows: np.ndarray) -> np.ndarray:
        """Return where in `rows` those of the given `rows` are that it contains."""
        begins = self.begins[rows // RUN]
        return (begins + rows % RUN)[begins >= 0]


@dataclass(frozen=True)
class Answers:
    """The answers of one round of requests, in which each part asks the others for generators.

    - `balls`: those of this part.
    - `asked` (m,) int: numbers of those that may contain generators that this part does not know.
    - `facing`: by the numbers of the other parts, or in a periodic box of the images of all parts.
    - `given` list of (k,) int32: the own generators in the balls of each of these that it did not know before.
    - `new` list of (k, d + 3) float: the generators that each part has given: their rows in that part, whether cells of
      this part need them, their positions (of the image, in a periodic box), and the number of the image.
    - `is_short`: whether cells need larger balls than those for which this part has asked.
    """

    balls: BallGroups
    asked: np.ndarray
    facing: dict[int, Facing]
    given: list[np.ndarray]
    new: list[np.ndarray]
    is_short: bool

    @property
    def needed(self) -> int:
        """Number of generators that this part needs."""
        return int(sum(rows[:, 1].sum() for rows in self.new))

    def settle(self, needed: np.ndarray) -> np.ndarray:
        """Make the balls smaller, so that no given generator is in a skin: these generators do not become ghosts.

        Each ball becomes larger than `needed` (n,) by a share of the way to the nearest generator that this part does
        not know. Return the largest radius and the smallest skin of each group, (k, 2).
        """
        places, balls = np.concatenate([rows[:, 2:-1] for rows in self.new]), self.balls
        known = (1 + SKIN) * balls.radii
        if len(places) and len(self.asked):
            near, _ = _tree(places).query(balls.centers[self.asked], distance_upper_bound=known[self.asked].max())
            known[self.asked] = np.minimum(known[self.asked], near)
        balls.radii = needed + SHARE * (known - needed)
        rows, firsts = balls.chunks.order, balls.chunks.firsts
        skins = np.minimum.reduceat((known - balls.radii)[rows], firsts)
        return np.column_stack([np.maximum.reduceat(balls.radii[rows], firsts), skins])


def gaps(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the distances between `boxes` (k, 2 d) and `others` (m, 2 d), (k, m)."""
    dim, ways2 = boxes.shape[1] // 2, np.zeros((len(boxes), len(others)))
    for axis in range(dim):
        below = np.subtract.outer(boxes[:, axis], others[:, dim + axis])
        above = np.subtract.outer(boxes[:, dim + axis], others[:, axis])
        ways2 += np.square(np.maximum(np.maximum(below, np.negative(above, out=above), out=below), 0, out=below))
    return np.sqrt(ways2, out=ways2)


def pair_gaps(
    lower: np.ndarray, upper: np.ndarray, rows: np.ndarray, boxes: np.ndarray, others: np.ndarray
) -> np.ndarray:
    """Return the distances between `rows` of boxes with the corners `lower` and `upper`, and `others` of `boxes`."""
    dim, ways2 = lower.shape[1], np.zeros(len(rows))
    for axis in range(dim):
        low = lower[rows, axis]
        high = low if upper is lower else upper[rows, axis]
        gap = np.maximum(boxes[others, axis] - high, low - boxes[others, dim + axis])
        ways2 += np.square(np.maximum(gap, 0, out=gap), out=gap)
    return np.sqrt(ways2, out=ways2)


def around(boxes: np.ndarray) -> np.ndarray:
    """Return the box around all `boxes` (k, 2 d), (1, 2 d)."""
    dim = boxes.shape[1] // 2
    return np.concatenate([boxes[:, :dim].min(axis=0), boxes[:, dim:].max(axis=0)])[None]


def _tree(points: np.ndarray) -> scipy.spatial.cKDTree:
    """Return a tree of `points` (n, d), of few of which the nearest are sought: half the time of a balanced one."""
    return scipy.spatial.cKDTree(points, compact_nodes=False, balanced_tree=False)


def inside(points: np.ndarray, balls: np.ndarray) -> np.ndarray:
    """Return which of `points` (n, d) are in one of the `balls` (m, d + 1), (n,) bool.

    The center of a ball with radius r gets one more coordinate, sqrt(R^2 - r^2), where R is the largest radius; that of
    a point is 0. A point is then in the ball if it is nearer than R to the center. Searches are slow if most radii are
    much smaller than R. So each search has balls whose r^2 are within a factor of two.
    """
    found = np.zeros(len(points), bool)
    classes = np.frexp(np.square(balls[:, -1]))[1]
    for same in np.unique(classes):
        centers, rest = balls[classes == same], np.flatnonzero(~found)
        radii, places = centers[:, -1].copy(), np.column_stack([points[rest], np.zeros(len(rest))])
        largest = radii.max()
        centers[:, -1] = np.sqrt((largest - radii) * (largest + radii))
        near, _ = _tree(centers).query(places, distance_upper_bound=largest * (1 + 1e-9))
        found[rest] = np.isfinite(near)
    return found


def _kernels_of(engine: Engine) -> Kernels:
    """Return the kernels that tell which generators are near other parts."""
    return engine.kernels("tessellation/part_border", {"RUN": RUN, "AHEAD": AHEAD}, shared=True)


class PartSteps(DomainSteps):
    """The steps of one part of a domain whose other parts are the peers of the engine.

    Ghosts are kept from one diagram of the same generators to the next.

    - `rounds`: how often the cells of the latest diagram have been made.
    - `asked`: how often parts have asked each other for ghosts.
    """

    def __init__(
        self,
        stages: TessellationStages,
        domain: Domain,
        spacing: Callable[[np.ndarray], np.ndarray] | None = None,
        straight: bool = False,
    ) -> None:
        super().__init__(stages, domain)
        self._cut = None if domain.outline is None else Cut(stages, domain.outline, spacing, straight)
        self._straight = straight
        self.peers, self.rounds, self.asked = stages.engine.peers, 0, 0
        real = stages.engine.real
        periods, self._periods = domain.periods(real), np.zeros(4, real)
        self._periods[: domain.dim] = periods
        self._images = np.array(list(product(*((-1, 0, 1) if along else (0,) for along in domain.periodic))))
        self._shifts = self._images * periods
        self._corners = [corner[: domain.dim].astype(float) for corner in domain.device_corners(real)]
        if self.is_periodic:
            self.box = ExtendedBox(self._corners[0] - periods, self._corners[1] + periods)
        self._measure = domain.measure / domain.frame[1] ** domain.cell_dim
        self._room = NamedArrays(stages.engine, spare=1 / 16)
        self._kernels = _kernels_of(stages.engine)
        self._labels: cla.Array | None = None
        self._answers: Answers | None = None

    @property
    def is_periodic(self) -> bool:
        """Whether parts have images of generators, among them those of their own ones."""
        return len(self._images) > 1

    @property
    def _reads_rows(self) -> bool:
        """Whether ghosts need cells: in 2D, where updates and the descent of shapes read the rows of neighbors."""
        return not self.stages.cells.from_previous

    def begin(self, n: int, last: bool = False, labels: cla.Array | None = None) -> None:
        """Note the labels of the generators, and begin to count the rounds of a new diagram."""
        assert labels is not None, "generators of parts have labels"
        self._given, self.rounds = labels, 0

    def extend(self, sites: cla.Array, n: int) -> Part:
        """Return the generators, the first `n` of `sites`, with the ghosts that are known."""
        labels, engine = self._given, self.stages.engine
        self.rounds += 1
        if self.peers.count == 1 and not self.is_periodic:
            return self._with_outside(Part(n, n, sites, self.box, None, labels=labels))
        begins = self._labels is not labels
        if begins:
            self._begin_anew(sites[:n], labels)
        count = n + len(self._rows)
        points = self._room("points", size=(count + self._n_outside) * engine.dim).reshape(-1, engine.dim)
        if self.is_periodic:
            # Generators stay beside their neighbors when they cross a seam.
            own = self._room("own", size=n * engine.dim)
            if begins:
                cl.enqueue_copy(engine.queue, buffer_of(own), buffer_of(sites), byte_count=own.nbytes)
            follow_images(engine, n, sites, self._periods, own, points)
        else:
            cl.enqueue_copy(engine.queue, buffer_of(points), buffer_of(sites), byte_count=sites[:n].nbytes)
        self._ghosts.fill(engine, n, points)
        if self.is_periodic:
            self._ghosts.shift(engine, n, self._periods, points)
        return self._with_outside(Part(n, count, points, self.box, self._ghosts, labels=self._all_labels))

    @property
    def _n_outside(self) -> int:
        """Number of ghost generators outside of a polygon, the last rows of a part while its cells are made."""
        return 0 if self._cut is None else len(self._cut.outside)

    def _with_outside(self, part: Part) -> Part:
        """Return `part` with the ghost generators outside of a polygon."""
        if self._cut is None or not self._n_outside:
            return part
        engine, n, count = self.stages.engine, part.count, part.count + self._n_outside
        points, labels = part.points, self._room("labels", size=count, dtype=np.int32)
        if part.ghosts is None:
            points = self._room("points", size=count * engine.dim).reshape(count, -1)
            cl.enqueue_copy(engine.queue, buffer_of(points), buffer_of(part.points), byte_count=part.points[:n].nbytes)
        engine.send(self._cut.outside, points, n * engine.dim * engine.real.itemsize)
        cl.enqueue_copy(engine.queue, buffer_of(labels), buffer_of(part.labels), byte_count=4 * n)
        engine.send(LAST_LABEL - np.arange(self._n_outside, dtype=np.int32), labels, 4 * n)
        return replace(part, count=count, points=points, labels=labels)

    def _begin_anew(self, sites: cla.Array, labels: cla.Array) -> None:
        """Ask for the ghosts of new generators."""
        self._labels = labels
        self._sent = [np.empty(0, np.int32) for _ in range(self.peers.count * len(self._shifts))]
        self._sides, self._rows = np.empty(0, int), np.empty(0, np.int32)
        self._share_landmarks(sites)
        self._most_caps = FIRST_REACH[self.domain.cell_dim] * self._bound_runs(sites)[2]
        self._take(self._ask(sites, self._most_caps), sites)

    def _bound_runs(self, sites: cla.Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return boxes (b, 2 d) around the generators of each run, the run of each box, and spacings of runs (r,).

        The spacing of a run is `LOOSE` times the median of the distances of its generators from the nearest of the next
        `AHEAD`, and that of three runs the largest. A run that crosses a gap has two boxes.
        """
        engine, n, dim = self.stages.engine, len(sites), self.stages.engine.dim
        with engine.workspace.frame():
            found = engine.scratch((-(-n // RUN), 4 * dim + 1))
            engine.run_each(self._kernels.bound_runs, len(found), np.int32(n), sites, found)
            rows = found.get().astype(float)
        least = (self._measure / n) ** (1 / self.domain.cell_dim) / 16
        usual = LOOSE * _largest_of_three(np.maximum(np.sqrt(rows[:, -1]), least))
        first, second, every = rows[:, : 2 * dim], rows[:, 2 * dim : -1], np.arange(len(rows))
        cross = pair_gaps(first[:, :dim], first[:, dim:], every, second, every) > JUMP * usual
        joined = np.hstack([np.minimum(first, second)[:, :dim], np.maximum(first, second)[:, dim:]])
        boxes = np.concatenate([np.where(cross[:, None], first, joined), second[cross]])
        return boxes, np.concatenate([every, np.flatnonzero(cross)]), usual

    def _find_border(self, sites: cla.Array, radii: np.ndarray) -> Border:
        """Find the runs near other parts; `radii` (r,) are those of the balls around the generators of each run."""
        boxes, runs, usual = self._bound_runs(sites)
        lower, upper = np.split(boxes, 2, axis=1)
        count = min(math.isqrt(len(sites)), len(boxes))
        balls = BallGroups(lower, upper, radii[runs], Chunks(lower, upper, usual[runs], count))
        near, away = np.zeros(len(usual), bool), np.full(len(boxes), FARTHEST)
        # If most runs are near others, it takes longer to find which.
        dim = self.domain.cell_dim
        few = len(sites) < FEW * (2 * dim * (FAR * FIRST_REACH[dim] + RUN / 4)) ** dim
        for facing in self._facing(balls, 0 if few else FAR).values():
            ways = facing.away[balls.chunks.groups]
            ways[facing.balls] = facing.apart
            away, near[runs[facing.places]] = np.minimum(away, ways), True
        near |= not near.any()
        starts = RUN * np.flatnonzero(near)
        rows = (starts[:, None] + np.arange(RUN)).ravel()
        begins, least = np.full(len(near), -1, np.int32), np.full(len(near), FARTHEST)
        begins[near] = RUN * np.arange(len(starts))
        np.minimum.at(least, runs, away)
        inner = np.column_stack([FREE * least, (1 - FREE) * least])
        return Border(rows[rows < len(sites)], begins, usual, inner, balls, runs)

    def _facing(self, balls: BallGroups, limit: float) -> dict[int, Facing]:
        """Tell all parts where `balls` are, and return how far they are from those of the other sides.

        Those within `limit` times the largest radius of both are pairs; without a limit nothing is compared.
        """
        peers, ways, found = self.peers, len(self._shifts), {}
        told = peers.exchange([balls.facts] * peers.count)
        for side in range(len(self._sent) if limit else 0):
            number, way = divmod(side, ways)
            if number != peers.number or self._images[way].any():
                facts = told[number].copy()
                facts[:, :-2] += np.tile(self._shifts[way], 2)
                found[side] = balls.facing(facts, limit)
        return found

    def _read(self, rows: np.ndarray, values: cla.Array) -> np.ndarray:
        """Return these `rows` of `values` on the device as float."""
        if not len(rows):
            return np.empty((0, values.shape[1]))
        engine = self.stages.engine
        with engine.workspace.frame():
            items, out = engine.upload(rows, np.int32), engine.scratch((len(rows), values.shape[1]), values.dtype)
            return self.stages.gather.rows(items, values, out).get().astype(float)

    def _share_landmarks(self, sites: cla.Array) -> None:
        """Give the generators nearest to the landmarks of the domain to all parts; own ones are at `sites` (n, d)."""
        if self._cut is None:
            places = self.domain.place(self.domain.landmarks, self.stages.engine.real)
        else:
            places = self._cut.landmarks
        if not len(places):
            return
        found = np.array(self.peers.gather(np.column_stack(_tree(sites.get().astype(float)).query(places))))
        owners = found[:, :, 0].argmin(axis=0)
        for number in np.unique(owners):
            rows = np.unique(found[number, owners == number, 1]).astype(np.int32)
            if number == self.peers.number:
                self._sent = [known if k == number else rows for k, known in enumerate(self._sent)]
            else:
                self._sides = np.concatenate([self._sides, np.full(len(rows), number)])
                self._rows = np.concatenate([self._rows, rows])

    def _store(self) -> None:
        """Upload the lists of ghosts, and get their labels from their owners."""
        engine, n, ways = self.stages.engine, len(self._at), len(self._shifts)
        order = np.argsort(self._sides, kind="stable")
        self._sides, self._rows = self._sides[order], self._rows[order]
        parts, way = np.divmod(self._sides, ways)
        # This part is on the opposite side of the other part.
        sent = [np.concatenate(self._sent[k : k + ways][::-1]) for k in range(0, len(self._sent), ways)]
        codes = engine.upload((self._images[way] + 1) @ 3 ** np.arange(engine.dim), np.int32)
        self._ghosts = replace(Ghosts.of_lists(engine, self.peers, parts, self._rows, sent), codes=codes)
        assert self._labels is not None
        labels = self._labels.get()[:n]
        found = self.peers.exchange([labels[rows] for rows in sent])
        self._all_labels = engine.upload(np.concatenate([labels, *found]), np.int32)

    def _send_limits(self, at: cla.Array | None = None) -> None:
        """Upload the limits of own generators. They hold for the present positions `at` (n, d), if given."""
        engine, border = self.stages.engine, self._border
        if at is not None:
            self._at = self._room("at", size=at.size).reshape(at.shape)
            cl.enqueue_copy(engine.queue, buffer_of(self._at), buffer_of(at), byte_count=at.nbytes)
        self._limits_there = self._room("limits", size=2 * len(self._at), dtype=np.float32).reshape(-1, 2)
        # Single precision must not round limits up.
        given = [engine.upload(limits * (1 - 1e-6), np.float32) for limits in (border.inner, self._limits)]
        begins = engine.upload(border.begins, np.int32)
        n = np.int32(len(self._at))
        engine.run_each(self._kernels.place_limits, len(begins), n, begins, *given, self._limits_there)

    def builds_all(self, part: Part, complete: bool, enough: bool) -> bool:
        """Return whether ghosts get cells: in 2D, where the descent of shapes reads the rows of neighbors."""
        return part.ghosts is None or self._reads_rows

    def rows(self, previous: Tessellation) -> None:
        """Cells start anew, since ghosts change."""

    def update(
        self, sites: cla.Array, n: int, previous: Tessellation, sort: Sort, follow: Follow
    ) -> Tessellation | None:
        """Update `previous`, in 2D with the cells of ghosts; a part whose cells change too much makes them anew."""
        stages, self.rounds = self.stages, 0
        part = self.extend(sites, n)
        before = previous.whole or previous
        if before.part is not None and before.part.ghosts is not part.ghosts:
            return None
        if before.trimmed is not None:
            before = before.trimmed.convex
            if before.n != part.count:
                return None

        @cache
        def binned() -> BinnedPoints:
            return stages.bins.build(self.box, part.points, part.count)

        def clip(cells: Polyhedra, cut: CutCells, report: cla.Array, _: int) -> None:
            cells.clip_rest(cut, report, part, binned(), before)

        t = stages.update.update(stages.cells, self.box, part.points, before, clip=clip)
        if t is not None:
            part.order_rows(stages.engine, t, stages.cells.defines)
        else:
            rows = part.count if self._reads_rows else n
            t = stages.cells.tessellate(part, binned(), exact=False, rows=rows)
        made = self._finished(part, t)
        if made is not None:
            follow(made, None)
        return made

    def finish(self, part: Part, t: Tessellation, points: cla.Array, exact: bool, nearest: bool) -> Tessellation | None:
        """Return `t` if its cells, and in 2D those of neighbors, are final; None if ghosts were missing."""
        return self._finished(part, t)

    def _finished(self, part: Part, t: Tessellation | None) -> Tessellation | None:
        """Return the diagram of own cells; None if ghosts were missing, or if a part has no diagram `t`."""
        engine, n, convex = self.stages.engine, part.n_own, t
        attempt, sums = 0, FAILED
        if outside := self._n_outside:
            count = part.count - outside
            part = replace(part, count=count, points=part.points[:count], labels=part.labels[:count])
        while True:
            if convex is not None and self._cut is not None:
                t = self._cut.finish_updated(convex, part.points, part.count, attempt)
            if part.ghosts is None:
                return None if t is None else replace(t, part=part)
            needed = engine.scratch((n, 2), np.float32)
            if t is not None:
                given = self._at, self._limits_there, 2 * (1 + NOISE[engine.real.name]), self._reads_rows, needed
                attempt = 0 if self._cut is None else self._cut.attempt
                sums = np.append(part.sums(engine, t, *given, self._periods), [0, attempt])
            sums = self.peers.total(sums)
            if sums[6] or t is None:
                # Ghost generators outside may be too near to cells that this part does not know.
                self._labels = self._labels if self._cut is None else None
                return None
            if self._answers is not None and not sums[3] + sums[4]:
                self._settle(self._answers, part, needed)
            elif sums[3] + sums[4] and not self._mend_limits(part, needed, *sums[3:5]):
                if not self._ask_again(part, needed):
                    return None
            if not sums[7]:
                break
            # All parts trace the boundary at the same place.
            attempts = np.array(self.peers.gather(np.array(attempt)))
            attempt = int(attempts.max())
            if (attempts == attempt).all():
                break
        if sums[5]:
            raise FewCellsError(
                f"{int(sums[5])} neighbors of generators are half a period away or farther, expected at least four or "
                f"five cells across each period of {self.domain}; use a smaller size, more cells (n_cells) or fewer "
                "levels"
            )
        if self._straight and self._cut is not None:
            sums[0] = self._measure
        self._check(*sums[:3])
        whole = t if t.n == part.count else None
        own, points = t.first(n) if t.n > n else t, part.points
        if self.is_periodic:
            points = self._room("placed", size=points.size).reshape(points.shape)
            part.place_unfolded(engine, self._periods, points)
        return replace(own, part=part, whole=whole, points=points, sites=part.points)

    def measure_exactly(self, t: Tessellation) -> Tessellation:
        """Return `t` with the measures of cells up to the boundary, and check that they fill the domain."""
        if self._cut is None or not self._straight:
            return t
        made = self._cut.measure_exactly(t.whole or t)
        self._check(float(self.peers.total(made.volumes[: t.n].get().sum(dtype=float))), 0, 1)
        if t.whole is None:
            return replace(made, part=t.part)
        return replace(made.first(t.n), part=t.part, whole=made, points=t.points, sites=t.sites)

    def _check(self, volume: float, gap: float, faces: float) -> None:
        """Raise if the cells of all parts do not fill the domain, or a face between two parts has only one side."""
        real, off = self.stages.engine.real, abs(volume / self._measure - 1)
        if off > FILLED[real.name] or abs(gap) > MATCHED[real.name] * faces:
            raise ClvoroError(
                f"the cells of all ranks differ from the domain by {off:.2g} of its volume, and faces between them by "
                f"{abs(gap) / max(faces, 1e-300):.2g} of their area, expected none: ghosts are missing"
            )

    def _largest_needs(self, needed: cla.Array) -> np.ndarray:
        """Return the largest of each run, of `needed` (n, 2): radii, moves, and sums of both, (3, r) float."""
        engine, n = self.stages.engine, len(needed)
        with engine.workspace.frame():
            largest = engine.scratch((-(-n // RUN), 3), np.float32)
            engine.run_each(self._kernels.largest_needs, len(largest), np.int32(n), needed, largest)
            return largest.get().T.astype(float)

    def _mend_limits(self, part: Part, needs: cla.Array, short: float, beyond: float) -> bool:
        """Give other limits to the generators of all parts that are beyond theirs. Return whether all can have them.

        The balls of `short` generators are too small; `beyond` generators have moved too far. `needs` (n, 2) are the
        radii that they need, and how far each has moved.
        """
        if max(short, beyond) > MENDED or self._answers is not None:
            return False
        limits, share, border = self._limits, 1 - 1e-5, self._border
        (_, moves, both), inner = self._largest_needs(needs), border.begins < 0
        over = (both > share * border.inner[:, 0]) | (moves > share * border.inner[:, 1])
        if self.peers.any(bool((over & inner).any())):
            return False
        needed, moves = self._read(border.rows, needs).T.copy()
        far = np.flatnonzero(moves > share * limits[:, 1])
        # The radii of balls depend on how far generators may move: ways come first.
        wanted, used = SKIN * self._caps[far], needed + moves
        if beyond and not self._limit_anew(1, far, wanted, part.points, moves, used, SKIN / 4):
            return False
        moves[far] = 0
        near = np.flatnonzero(needed + moves > share * limits[:, 0])
        wanted = WIDER * needed[near]
        if short and not self._limit_anew(0, near, wanted, part.points, moves, moves, 1 / WIDER / share):
            return False
        self._send_limits()
        return True

    def _limit_anew(
        self,
        kind: int,
        places: np.ndarray,
        wanted: np.ndarray,
        points: cla.Array,
        moves: np.ndarray,
        used: np.ndarray,
        enough: float,
    ) -> bool:
        """Limit radii, or ways if `kind` is 1, of generators near others to `wanted` (k,) or less.

        They are those at these `places` (k,) of the border, now at `points`. Limits of other parts' generators that do
        not know these, or are not known, become smaller, by at most half of what is more than `used` (m,). Return
        whether all limits are the share `enough` of the wanted ones.
        """
        peers, balls, ways, own, border = self.peers, self._balls, len(self._shifts), self.peers.number, self._border
        limits, most, found, rows = self._limits[:, 1 - kind], self._most[:, 1 - kind], [], border.rows[places]
        # Where generators are not near others, limits stay.
        inner = np.where(border.begins < 0, border.inner[:, 1 - kind], -FARTHEST)[border.runs]
        most_inner = np.maximum.reduceat(inner[border.boxes.chunks.order], border.boxes.chunks.firsts)
        x = self._read(rows, points)
        requests = np.column_stack([x, rows, wanted])
        for number, asked in enumerate(peers.exchange([requests] * peers.count)):
            ends = asked[:, -1].copy()
            for way in range(ways):
                if number == own and not self._images[way].any():
                    continue
                side, centers = ways * (number + 1) - 1 - way, asked[:, :-2] - self._shifts[way]
                corners = np.tile(centers, 2)
                far = gaps(corners, border.boxes.boxes) - most_inner < asked[:, -1:]
                for k in np.flatnonzero(far.any(axis=1)):
                    others = border.boxes.chunks.rows(np.flatnonzero(far[k]))
                    given = border.boxes.centers, border.boxes.upper, others, corners[k : k + 1], 0 * others
                    ends[k] = np.min(pair_gaps(*given) - inner[others], initial=ends[k])
                near = gaps(corners, balls.boxes) - most < asked[:, -1:]
                if kind:
                    near[np.isin(asked[:, -2], self._rows[self._sides == side])] = False
                for k in np.flatnonzero(near.any(axis=1)):
                    others = balls.chunks.rows(np.flatnonzero(near[k]))
                    others = others if kind else np.setdiff1d(others, border.places(self._sent[side]))
                    away = np.linalg.norm(balls.centers[others] - centers[k], axis=1)
                    least = np.minimum(limits[others], np.maximum(used[others], (limits[others] + used[others]) / 2))
                    limits[others] = np.clip(away - asked[k, -1], least, limits[others])
                    ends[k] = np.min(away - limits[others], initial=ends[k])
            found.append(ends)
        ends = np.min(peers.exchange(found, np.full(peers.count, len(rows))), axis=0)
        if peers.any(bool((ends < enough * wanted).any())):
            return False
        dim, groups = x.shape[1], balls.chunks.groups[places]
        self._limits[places, 1 - kind] -= moves[places]
        self._limits[places, kind], balls.centers[places] = ends, x
        np.maximum.at(self._most[:, kind], groups, ends)
        np.minimum.at(balls.boxes[:, :dim], groups, x)
        np.maximum.at(balls.boxes[:, dim:], groups, x)
        if len(rows):
            engine, words = self.stages.engine, np.int32(dim * points.dtype.itemsize // 4)
            items = engine.upload(rows, np.int32)
            engine.run_each(self._kernels.copy_rows, len(rows), items, words, points, self._at)
        return True

    def _ask_again(self, part: Part, needed: cla.Array) -> bool:
        """Ask for the ghosts in the balls that cells need. Return False if there are new ones.

        `needed` (n, 2) are the radii of the balls, and how far generators have moved.
        """
        sites, largest = part.points[: part.n_own], self._largest_needs(needed)[0]
        while True:
            # A cell without the ghosts around it may reach through the whole domain.
            radii = np.maximum(self._most_caps, np.minimum(GROWTH * largest, 2 * self._most_caps))
            answers = self._ask(sites, radii, needed)
            self._most_caps = radii
            short = (largest > radii).any() or answers.is_short
            new, short = self.peers.total(np.array([answers.needed, short]))
            if new:
                self._take(answers, sites)
                return False
            if not short:
                self._settle(answers, part, needed)
                return True

    def _settle(self, answers: Answers, part: Part, needed: cla.Array) -> None:
        """Divide the room around the balls that cells of `part` need, and set the limits of own generators."""
        settled = answers.settle(self._read(self._border.rows, needed)[:, 0])
        told, self._answers = self.peers.exchange([settled] * self.peers.count), None
        grown = {}
        for side, facing in answers.facing.items():
            settled = told[side // len(self._shifts)]
            grown[side], facing.facts[:, -2:] = np.max(settled[:, 0] / facing.facts[:, -2]), settled
        self._balls, limits = answers.balls, self._limits_of(answers.balls, answers.facing, grown)
        self._limits = np.column_stack(limits)
        # A room without limit is that of a generator that all parts know.
        order, firsts = self._balls.chunks.order, self._balls.chunks.firsts
        finite = [np.where(np.isinf(limits), 0, limits)[order] for limits in self._limits.T]
        self._most = np.column_stack([np.maximum.reduceat(limits, firsts) for limits in finite])
        self._send_limits(part.points[: part.n_own])

    def _ask(self, sites: cla.Array, radii: np.ndarray, needed: cla.Array | None = None) -> Answers:
        """Ask for the generators in balls around own generators.

        - `sites` (n, d) real: positions of the generators.
        - `radii` (r,) float: the largest radius of balls in each run.
        - `needed` (n, 2) float32: radii of the balls that the present cells need, if there are cells.
        """
        self.asked += 1
        border = self._find_border(sites, radii)
        x, runs, ways = self._read(border.rows, sites), border.rows // RUN, len(self._shifts)
        count = max(len(x) // math.isqrt(len(sites)), 1)
        chunks = Chunks(x, x, border.spacings[runs], count, estimate=needed is None)
        if needed is None:
            self._caps = least = FIRST_REACH[self.domain.cell_dim] * chunks.spacings
        else:
            least, caps, before = self._read(border.rows, needed)[:, 0], self._most_caps[runs], self._border
            caps[border.places(before.rows)] = self._caps[before.places(border.rows)]
            self._caps = np.maximum(caps, np.minimum(GROWTH * least, 2 * caps))
        self._border, radii = border, np.minimum(self._caps, radii[runs])
        balls = BallGroups(x, x, radii, chunks)
        facing, none = self._facing(balls, NEAR), np.empty(0, int)
        asked = [balls.meeting(facing[side]) if side in facing else none for side in range(len(self._sent))]
        sizes = np.column_stack([np.minimum(least, radii), (1 + SKIN) * radii])
        requests = [np.hstack([x[rows] - self._shifts[side % ways], sizes[rows]]) for side, rows in enumerate(asked)]
        given, sent = [none] * len(asked), []
        for number, requested in enumerate(self.peers.exchange(self._joined(requests))):
            answers = []
            for way, shift in enumerate(self._shifts):
                balls_there, opposite = requested[requested[:, -1] == way, :-1], ways * (number + 1) - 1 - way
                found = self._unknown(balls, balls_there, border.places(self._sent[opposite]))
                given[opposite] = border.rows[found].astype(np.int32)
                needs = inside(x[found], balls_there[:, :-1])
                answers.append(np.column_stack([border.rows[found], needs, x[found] + shift]))
            sent += self._joined(answers)
        numbers, short = np.unique(np.concatenate(asked)), bool((least > radii).any())
        return Answers(balls, numbers, facing, given, self.peers.exchange(sent), short)

    def _joined(self, tables: list[np.ndarray]) -> list[np.ndarray]:
        """Join the tables of all sides of each part to one array, whose last column is the number of the image."""
        ways = len(self._shifts)
        numbered = [np.column_stack([rows, np.full(len(rows), k % ways)]) for k, rows in enumerate(tables)]
        return [np.concatenate(numbered[k : k + ways]) for k in range(0, len(numbered), ways)]

    def _take(self, answers: Answers, sites: cla.Array) -> None:
        """Add the generators that parts have given each other to the lists of ghosts; own ones are at `sites`."""
        self._sent = [np.concatenate(pair) for pair in zip(self._sent, answers.given, strict=True)]
        sides = [len(self._shifts) * number + rows[:, -1].astype(int) for number, rows in enumerate(answers.new)]
        rows = np.concatenate([rows[:, 0] for rows in answers.new]).astype(np.int32)
        self._sides, self._rows = np.concatenate([self._sides, *sides]), np.concatenate([self._rows, rows])
        # All in the balls and their skins are known, while no generator moves.
        self._answers = replace(answers, new=[rows[:0] for rows in answers.new])
        self._limits = np.column_stack([(1 + SKIN) * answers.balls.radii, np.zeros(len(answers.balls.radii))])
        self._send_limits(sites)
        self._store()

    def _unknown(self, own: BallGroups, balls: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Return where in `own` the generators in `balls` (m, d + 2) are that are not at the `known` places.

        A row of `balls` has a center and two radii. The first, which cells of the other part need, is not used.
        """
        dim = own.centers.shape[1]
        if not len(balls):
            return np.empty(0, int)
        balls = np.delete(balls, dim, axis=1)
        firsts = np.arange(0, len(balls), GROUP)
        lower = np.minimum.reduceat(balls[:, :dim] - balls[:, dim:], firsts, axis=0)
        groups = np.hstack([lower, np.maximum.reduceat(balls[:, :dim] + balls[:, dim:], firsts, axis=0)])
        near = (gaps(own.boxes, groups) <= 0).any(axis=1)[own.chunks.groups]
        near[known] = False
        places = np.flatnonzero(near)
        return places[inside(own.centers[places], balls)]

    def _limits_of(
        self, balls: BallGroups, facing: dict[int, Facing], grown: dict[int, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the limits of the generators near other parts, (m,) each; see `sum_cells` in part.cl.

        A generator that another part does not know is at least a skin away from each ball of that part. Far from all
        other parts, the radius of a ball is a share of the distance to them: that to generators which are not near this
        part is more than `FAR` radii. The balls of each side are at most `grown` times as large as when it asked.
        """
        groups, k = balls.chunks.groups, len(balls.chunks.firsts)
        known = {side: self._border.places(self._sent[side]) for side in facing}
        # A row for each chunk, and one for each generator that is beside another part or known there.
        places = np.zeros(len(groups), np.int32)
        for side, f in facing.items():
            places[f.balls] = places[known[side]] = 1
        alone = np.flatnonzero(places)
        places[alone] = np.arange(k, k + len(alone))
        least = np.minimum.reduceat(balls.asked[balls.chunks.order], balls.chunks.firsts)
        farthest = FAR * np.append(least, balls.asked[alone])
        free, room = np.full((2, k + len(alone)), np.inf)
        for side, f in facing.items():
            largest, skins = f.facts[:, -2], f.facts[:, -1]
            ways = np.append(f.away, f.away[groups[alone]])
            ways[places[f.balls]] = f.apart
            share = 1 - max(grown[side] / NEAR, FREE)
            rooms = np.maximum(ways - np.maximum(largest.max(), FREE * ways), share * ways)
            rooms = np.maximum(skins.min(), rooms)
            if len(f.places):
                firsts = np.flatnonzero(np.diff(f.places, prepend=-1))
                rows, skin, largest = places[f.places[firsts]], skins[f.others], largest[f.others]
                rooms_there = np.maximum(skin, f.ways - np.maximum(largest, FREE * f.ways))
                ways[rows] = np.minimum(ways[rows], np.minimum.reduceat(f.ways, firsts))
                rooms[rows] = np.minimum(rooms[rows], np.minimum.reduceat(rooms_there, firsts))
            rooms = np.minimum(rooms, (1 - FREE) * farthest)
            rooms[places[known[side]]] = np.inf
            free, room = np.minimum(free, FREE * np.minimum(ways, farthest)), np.minimum(room, rooms)
        rows = np.where(places, places, groups)
        return np.maximum(balls.radii, free[rows]), room[rows]
