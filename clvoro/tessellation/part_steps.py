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
from ..opencl.primitives import NamedArrays
from .bins import BinnedPoints
from .clipped.cut import Cut
from .cut_cells import CutCells
from .decomposition import coarse_keys
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
RUN, AHEAD, CACHED = 32, 4, 1 << 13
"""Spacings are estimated along the curve: each generator is compared with the `AHEAD` next ones, and `RUN` successive
generators give one spacing. `CACHED` generators are compared at a time."""
JUMP = 12
"""Number of spacings between successive generators beyond which a new chunk begins."""
GROWTH, SKIN, SHARE = 1.4, 0.25, 0.4
"""`GROWTH`: radius of the balls of a part, divided by the radius that its cells need. `SKIN`: width of the skin around
each ball, as a share of the ball's radius. A part also asks for generators in the skin: they may move into the ball.
`SHARE`: of the room between the ball that a cell needs and the nearest generator that is not known, what the ball gets;
the rest is skin."""
NEAR, FREE = 1.25, 0.8
"""Largest distance between a ball and a box of another part that are compared, over the largest radius of the balls of
both. Radius around a generator within which all others are known, over its distance from other parts."""
FARTHEST = 1e6
"""A distance beyond all others, in units of the domain's frame."""
NOISE = {"float64": 1e-6, "float32": 1e-4}
"""Bound of the round-off of a reach, as a share of it."""
FILLED, MATCHED = {"float64": 1e-8, "float32": 1e-3}, {"float64": 1e-5, "float32": 1e-3}
"""`FILLED`: largest relative difference between the volume of all cells and that of the domain. `MATCHED`: largest
relative difference between the measures of faces between parts, seen from both sides."""
GROUP, BLOCK = 64, 16
"""Number of balls in each group of the balls that another part has sent. Number of successive chunks in a block: chunks
are compared in blocks that are near each other."""
MENDED, WIDER = (256, 0.02), 1.2
"""Largest number of generators that get other limits without asking for all anew, and as a share of all if that is
more. Radius of their balls over the needed one."""
FAILED = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
"""Summands of a part whose update has failed: zeros for those of `Part.sums`, 1 for the number of failed parts, the
attempt to trace the boundary of a polygon, and the number of generators."""


def _nearest_ahead(axes: np.ndarray) -> np.ndarray:
    """Return the square of the distance of each point, a column of `axes` (d, n), from the nearest of the next `AHEAD`.

    The result is (n,) float.
    """
    n = axes.shape[1]
    nearest = np.full(n, np.inf)
    # Blocks stay in a core's cache.
    for x, found in ((axes[:, k : k + CACHED + AHEAD], nearest[k : k + CACHED]) for k in range(0, n, CACHED)):
        for ahead in range(1, min(AHEAD, x.shape[1] - 1) + 1):
            ways = _squares(x[:, ahead : ahead + len(found)] - x[:, : min(len(found), x.shape[1] - ahead)])
            np.minimum(found[: len(ways)], ways, out=found[: len(ways)])
    return nearest


def _squares(ways: np.ndarray) -> np.ndarray:
    """Return the squares of the lengths of `ways` (d, n), (n,)."""
    return np.sum(np.square(ways, out=ways), axis=0)


class Chunks:
    """The generators of a part in chunks: each holds those that follow one another on a Hilbert curve.

    - `points` (n, d) float: in the order of bins.
    - `least`: lower bound of `spacings`.

    Its attributes:
    - `order` (n,) int: generators chunk by chunk.
    - `firsts`, `sizes` (k,) int: where the chunks begin, and their numbers of generators.
    - `groups` (n,) int: the chunk of each generator.
    - `spacings` (n,) float: an estimate of the spacing around each generator. A run of `RUN` generators has the median
      of their distances from the nearest of the next `AHEAD`, in the order of chunks or of bins; the estimate is the
      largest of three runs, that of the generator and the two beside it.
    """

    def __init__(self, points: np.ndarray, least: float) -> None:
        # Sums and extrema over the axes of many points take a tenth of the time if each axis is contiguous.
        n, axes = len(points), np.ascontiguousarray(points.T)
        lower = axes.min(axis=1)
        self.order = np.argsort(coarse_keys(axes, lower, np.maximum(axes.max(axis=1), lower + least)), kind="stable")
        x = np.ascontiguousarray(np.take(points, self.order, axis=0).T)
        nearest = np.minimum(_nearest_ahead(x), _nearest_ahead(axes)[self.order])
        runs = np.arange(max(n // RUN, 1)) * RUN
        usual = np.full(len(runs), least)
        if n >= 2 * RUN:
            middle = np.partition(nearest[: len(runs) * RUN].reshape(-1, RUN), RUN // 2, axis=1)[:, RUN // 2]
            usual = np.maximum(usual, np.sqrt(middle))
        usual = np.maximum(usual, np.maximum(np.append(usual[1:], usual[-1]), np.append(usual[0], usual[:-1])))
        usual = np.repeat(usual, np.diff(np.append(runs, n)))
        self.spacings = np.empty(n)
        self.spacings[self.order] = usual
        # Generators may have moved far from the others of their part.
        jumps = 1 + np.flatnonzero(_squares(np.diff(x)) > np.square(JUMP * usual[:-1]))
        count = math.isqrt(n)
        self.firsts = np.unique(np.concatenate([np.arange(count) * n // count, jumps]))
        self.sizes = np.diff(np.append(self.firsts, n))
        self.groups = np.empty(n, np.int32)
        self.groups[self.order] = np.repeat(np.arange(len(self.firsts)), self.sizes)

    def places(self, chosen: np.ndarray) -> np.ndarray:
        """Return where in `order` the generators of the `chosen` chunks are, chunk by chunk."""
        ends = np.cumsum(self.sizes[chosen])
        first = np.repeat(self.firsts[chosen] - ends + self.sizes[chosen], self.sizes[chosen])
        return np.arange(len(first)) + first

    def rows(self, chosen: np.ndarray) -> np.ndarray:
        """Return the generators of the `chosen` chunks, chunk by chunk."""
        return self.order[self.places(chosen)]


class BallGroups:
    """Balls around the generators of a part, in which it has to know all generators. Those of a chunk are a group.

    - `centers`: (n, d) float
    - `radii`: (n,) float

    Its attributes:
    - `boxes` (k, 2 d) float: lower and upper corners of boxes around the centers of each group.
    - `facts` (k, 2 d + 2) float: what other parts have to know: the boxes, the largest radius and the smallest skin.
    """

    def __init__(self, centers: np.ndarray, radii: np.ndarray, chunks: Chunks) -> None:
        self.centers, self.radii, self.chunks = centers, radii.copy(), chunks
        radii, firsts = radii[chunks.order], chunks.firsts
        self.axes = np.ascontiguousarray(np.take(centers, chunks.order, axis=0).T)
        self.largest = np.maximum.reduceat(radii, firsts)
        self.boxes = np.column_stack([f.reduceat(x, firsts) for f in (np.minimum, np.maximum) for x in self.axes])
        self.facts = np.column_stack([self.boxes, self.largest, SKIN * np.minimum.reduceat(radii, firsts)])

    def facing(self, facts: np.ndarray) -> Facing:
        """Return how far these balls are from the boxes of another part, which has sent its `facts` (k, 2 d + 2)."""
        boxes, largest, dim = facts[:, :-2], facts[:, -2], self.centers.shape[1]
        blocks, large = around(self.boxes), np.maximum.reduceat(self.largest, _blocks(self.largest))
        blocks_there, large_there = around(boxes), np.maximum.reduceat(largest, _blocks(largest))
        ways, limits = gaps(blocks[:, None], blocks_there), NEAR * np.maximum.outer(large, large_there)
        away = np.repeat(np.min(ways, axis=1, where=ways > limits, initial=FARTHEST), BLOCK)[: len(self.boxes)]
        # Pairs of groups in blocks that are near each other.
        near, within = np.nonzero(ways <= limits), np.divmod(np.arange(BLOCK**2), BLOCK)
        chosen = np.add.outer(BLOCK * near[0], within[0]).ravel()
        beside = np.add.outer(BLOCK * near[1], within[1]).ravel()
        order = np.flatnonzero((chosen < len(away)) & (beside < len(boxes)))
        order = order[np.argsort(chosen[order], kind="stable")]
        chosen, beside = chosen[order], beside[order]
        ways, limits = gaps(self.boxes[chosen], boxes[beside]), NEAR * np.maximum(self.largest[chosen], largest[beside])
        np.minimum.at(away, chosen, np.where(ways > limits, ways, FARTHEST))
        close = ways <= limits
        chosen, beside, limits = chosen[close], beside[close], limits[close]
        # Pairs of each ball in these groups with all boxes beside its group, the first box of each group at first.
        counts = np.bincount(chosen, minlength=len(away))
        begins, meet = np.cumsum(counts) - counts, np.flatnonzero(counts)
        sizes, rows = self.chunks.sizes[meet], self.chunks.places(meet)
        axes, apart, found = self.axes[:, rows], np.repeat(away[meet], sizes), []
        for turn in range(counts.max(initial=0)):
            more = counts[meet] > turn
            pairs, count = begins[meet[more]] + turn, sizes[more]
            there = np.arange(len(rows)) if more.all() else np.flatnonzero(np.repeat(more, sizes))
            ways2 = np.zeros(len(there))
            for axis, x in enumerate(axes if more.all() else axes[:, there]):
                gap = np.maximum(np.repeat(boxes[beside[pairs], axis], count) - x, 0)
                np.maximum(gap, x - np.repeat(boxes[beside[pairs], dim + axis], count), out=gap)
                ways2 += np.square(gap, out=gap)
            ways = np.sqrt(ways2, out=ways2)
            close = ways <= np.repeat(limits[pairs], count)
            far = there[~close]
            apart[far] = np.minimum(apart[far], ways[~close])
            found.append((there[close], np.repeat(beside[pairs], count)[close], ways[close]))
        of_pairs = [np.concatenate(arrays) for arrays in zip(*found, strict=True)] if found else [rows] * 3
        return Facing(facts, away, self.chunks.order[rows], apart, *of_pairs)

    def meeting(self, facing: Facing) -> np.ndarray:
        """Return which balls, with their skins, meet a box in which the other part has generators, (m,) int."""
        meets = np.zeros(len(facing.balls), bool)
        meets[facing.places[facing.ways <= (1 + SKIN) * self.radii[facing.balls[facing.places]]]] = True
        return facing.balls[meets]


@dataclass(frozen=True)
class Facing:
    """The balls of a part that are near boxes of another part.

    - `facts` (m, 2 d + 2) float: facts about the groups of the other part; see `BallGroups`.
    - `away` (k,) float: lower bound of the distance of the centers of a group from the boxes with which it has no
      pairs. This distance is also at least `NEAR` times the largest radius in such a box.
    - `balls`, `apart` (b,) int, float: the balls of groups with pairs, and the same bound for each of them.
    - `places`, `others`, `ways` (p,) int, int, float: pairs of a ball, by its place in `balls`, and a box; and the
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
class Answers:
    """The answers of one round of requests, in which each part asks the others for generators.

    - `balls`: those of this part.
    - `asked` (m,) int: numbers of those that may contain generators that this part does not know.
    - `facing`: by the numbers of the other parts, or in a periodic box of the images of all parts.
    - `given` list of (k,) int32: the own generators in the balls of each of these that it did not know before.
    - `new` list of (k, d + 3) float: the generators that each part has given: their rows in that part, whether cells of
      this part need them, their positions (of the image, in a periodic box), and the number of the image.
    """

    balls: BallGroups
    asked: np.ndarray
    facing: dict[int, Facing]
    given: list[np.ndarray]
    new: list[np.ndarray]

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
    """Return the distances between `boxes` (..., 2 d) and `others` (..., 2 d), of shapes that broadcast."""
    dim, ways2 = boxes.shape[-1] // 2, np.zeros(np.broadcast_shapes(boxes.shape[:-1], others.shape[:-1]))
    for axis in range(dim):
        gap = np.maximum(boxes[..., axis] - others[..., dim + axis], 0)
        np.maximum(gap, others[..., axis] - boxes[..., dim + axis], out=gap)
        ways2 += np.square(gap, out=gap)
    return np.sqrt(ways2, out=ways2)


def _blocks(values: np.ndarray) -> np.ndarray:
    """Return where blocks of `BLOCK` of `values` (k, ...) begin."""
    return np.arange(0, len(values), BLOCK)


def around(boxes: np.ndarray) -> np.ndarray:
    """Return boxes around blocks of `BLOCK` of the `boxes` (k, 2 d)."""
    dim, firsts = boxes.shape[1] // 2, _blocks(boxes)
    lower = np.minimum.reduceat(boxes[:, :dim], firsts, axis=0)
    return np.hstack([lower, np.maximum.reduceat(boxes[:, dim:], firsts, axis=0)])


def _tree(points: np.ndarray) -> scipy.spatial.cKDTree:
    """Return a tree of `points` (n, d), of few of which the nearest are sought: half the time of a balanced one."""
    return scipy.spatial.cKDTree(points, leafsize=24, compact_nodes=False, balanced_tree=False)


def inside(points: np.ndarray, balls: np.ndarray) -> np.ndarray:
    """Return which of `points` (n, d) are in one of the `balls` (m, d + 1), (n,) bool.

    The center of a ball with radius r gets one more coordinate, sqrt(R^2 - r^2), where R is the largest radius; that of
    a point is 0. A point is then in the ball if it is nearer than R to the center. Searches are slow if most radii are
    much smaller than R. So each search has balls whose r are within a factor of four.
    """
    found = np.zeros(len(points), bool)
    classes = np.frexp(balls[:, -1])[1] // 2
    classes -= classes.min(initial=0)
    for same in np.flatnonzero(np.bincount(classes)):
        centers, rest = balls[classes == same], np.flatnonzero(~found)
        radii, places = centers[:, -1].copy(), np.column_stack([points[rest], np.zeros(len(rest))])
        largest = radii.max()
        centers[:, -1] = np.sqrt((largest - radii) * (largest + radii))
        near, _ = _tree(centers).query(places, distance_upper_bound=largest * (1 + 1e-9))
        found[rest] = np.isfinite(near)
    return found


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
        self._labels: cla.Array | None = None
        self._answers: Answers | None = None
        self._updated = False

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
            self._begin_anew(sites[:n].get().astype(float), labels)
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

    def _begin_anew(self, x: np.ndarray, labels: cla.Array) -> None:
        """Ask for the ghosts of new generators."""
        least = (self._measure / max(len(x), 1)) ** (1 / self.domain.cell_dim) / 16
        self._labels, self._chunks = labels, Chunks(x, least)
        self._sent = [np.empty(0, np.int32) for _ in range(self.peers.count * len(self._shifts))]
        self._sides, self._rows = np.empty(0, int), np.empty(0, np.int32)
        self._share_landmarks(x)
        self._caps = FIRST_REACH[self.domain.cell_dim] * self._chunks.spacings
        self._take(self._ask(x, self._caps, np.zeros(len(x))))

    def _share_landmarks(self, x: np.ndarray) -> None:
        """Let all parts know the generators nearest to the landmarks of the domain; `x` (n, d) are own ones."""
        if self._cut is None:
            places = self.domain.place(self.domain.landmarks, self.stages.engine.real)
        else:
            places = self._cut.landmarks
        if not len(places):
            return
        nearest = np.full((len(places), 2), np.inf)
        if len(x):
            nearest = np.column_stack(_tree(x).query(places))
        found = np.array(self.peers.gather(nearest))
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
        engine, n, ways = self.stages.engine, len(self._caps), len(self._shifts)
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

    def _send_limits(self, at: np.ndarray | None) -> None:
        """Upload the limits of own generators, and the positions `at` (n, d) at which they hold, if these are new."""
        engine = self.stages.engine
        if at is not None:
            self._at = self._room("at", size=at.size).reshape(at.shape)
            engine.send(at.astype(engine.real), self._at)
        # Single precision must not round limits up.
        self._limits_there = engine.upload(self._limits * (1 - 1e-6), np.float32)

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
        self._updated = made is not None
        if made is not None:
            follow(made, None)
        return made

    def is_complete(self, t: Tessellation) -> bool:
        """Return whether two parts agree about the faces between them: not after an update in 3D and float32."""
        in_single = self.stages.engine.real == np.float32 and not self._reads_rows
        return not (in_single and self._updated and self.peers.count > 1)

    def finish(self, part: Part, t: Tessellation, points: cla.Array, exact: bool, nearest: bool) -> Tessellation | None:
        """Return `t` if its cells, and in 2D those of neighbors, are final; None if ghosts were missing."""
        self._updated = False
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
                # The next update finds the cells that it has checked before by this diagram.
                return None if t is None else replace(t, part=part, whole=t)
            needed = engine.scratch((n, 2), np.float32)
            if t is not None:
                given = self._at, self._limits_there, 2 * (1 + NOISE[engine.real.name]), self._reads_rows, needed
                attempt = 0 if self._cut is None else self._cut.attempt
                sums = np.append(part.sums(engine, t, *given, self._periods), [0, attempt, n])
            sums = self.peers.total(sums)
            if sums[6] or t is None:
                # Ghost generators outside may be too near to cells that this part does not know.
                self._labels = self._labels if self._cut is None else None
                return None
            if self._answers is not None or sums[3] + sums[4]:
                radii, moves = needed.get().T.astype(float, order="C")
                if self._answers is not None:
                    self._settle(self._answers, part, radii)
                few = max(*sums[3:5]) <= max(MENDED[0], MENDED[1] * sums[8])
                mended = not sums[3] + sums[4] or (few and self._mend_limits(part, radii, moves, *sums[3:5]))
                if not mended and not self._ask_again(part, radii):
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

    def _mend_limits(self, part: Part, needed: np.ndarray, moves: np.ndarray, short: float, beyond: float) -> bool:
        """Give other limits to the generators of all parts that are beyond theirs. Return whether all can have them.

        The balls of `short` generators are too small for their `needed` (n,) radii; `beyond` generators have moved too
        far. `moves` (n,) say how far each has moved.
        """
        limits, share = self._limits, 1 - 1e-5

        def places(rows: np.ndarray) -> np.ndarray:
            if not len(rows):
                return np.empty((0, self.domain.dim))
            return self.stages.gather.rows(self.stages.engine.upload(rows, np.int32), part.points).get().astype(float)

        far = np.flatnonzero(moves > share * limits[:, 1])
        # The radii of balls depend on how far generators may move: ways come first.
        wanted, used = SKIN * self._caps[far], needed + moves
        if beyond and not self._limit_anew(1, far, wanted, places(far), moves, used, SKIN / 4):
            return False
        moves[far] = 0
        near = np.flatnonzero(needed + moves > share * limits[:, 0])
        wanted = WIDER * needed[near]
        if short and not self._limit_anew(0, near, wanted, places(near), moves, moves, 1 / WIDER / share):
            return False
        self._send_limits(self._balls.centers if len(far) + len(near) else None)
        return True

    def _limit_anew(
        self,
        kind: int,
        rows: np.ndarray,
        wanted: np.ndarray,
        x: np.ndarray,
        moves: np.ndarray,
        used: np.ndarray,
        enough: float,
    ) -> bool:
        """Limit radii, or ways if `kind` is 1, of own `rows` (k,), now at `x` (k, d), to `wanted` (k,) or less.

        Limits of other parts' generators that do not know these, or are not known, become smaller, by at most half of
        what is more than `used` (n,). Return whether all limits are the share `enough` of the wanted ones.
        """
        peers, balls, ways, own = self.peers, self._balls, len(self._shifts), self.peers.number
        limits, most, found = self._limits[:, 1 - kind], self._most[:, 1 - kind], []
        requests = np.column_stack([x, rows, wanted])
        for number, asked in enumerate(peers.exchange([requests] * peers.count)):
            ends = asked[:, -1].copy()
            for way in range(ways):
                if number == own and not self._images[way].any():
                    continue
                side, centers = ways * (number + 1) - 1 - way, asked[:, :-2] - self._shifts[way]
                near = gaps(np.tile(centers, 2)[:, None], balls.boxes) - most < asked[:, -1:]
                if kind:
                    near[np.isin(asked[:, -2], self._rows[self._sides == side])] = False
                which, chunks = np.nonzero(near)
                others, which = balls.chunks.rows(chunks), np.repeat(which, balls.chunks.sizes[chunks])
                if not kind:
                    known = np.zeros(len(limits), bool)
                    known[self._sent[side]] = True
                    others, which = others[~known[others]], which[~known[others]]
                away = np.sqrt(_squares((balls.centers[others] - centers[which]).T))
                least = np.minimum(limits[others], np.maximum(used[others], (limits[others] + used[others]) / 2))
                np.minimum.at(limits, others, np.maximum(away - asked[which, -1], least))
                np.minimum.at(ends, which, away - limits[others])
            found.append(ends)
        ends = np.min(peers.exchange(found, np.full(peers.count, len(rows))), axis=0)
        if peers.any(bool((ends < enough * wanted).any())):
            return False
        dim, groups = x.shape[1], balls.chunks.groups[rows]
        self._limits[rows, 1 - kind] -= moves[rows]
        self._limits[rows, kind], balls.centers[rows] = ends, x
        np.maximum.at(self._most[:, kind], groups, ends)
        np.minimum.at(balls.boxes[:, :dim], groups, x)
        np.maximum.at(balls.boxes[:, dim:], groups, x)
        return True

    def _ask_again(self, part: Part, needed: np.ndarray) -> bool:
        """Ask for the ghosts in balls of radii `needed` (n,). Return False if there are new ones."""
        x = part.points[: part.n_own].get().astype(float)
        while True:
            # A cell without the ghosts around it may reach through the whole domain.
            radii = np.maximum(self._caps, np.minimum(GROWTH * needed, 2 * self._caps))
            answers = self._ask(x, radii, np.minimum(needed, radii))
            self._caps = radii
            new, short = self.peers.total(np.array([answers.needed, (needed > radii).any()]))
            if new:
                self._take(answers)
                return False
            if not short:
                self._settle(answers, part, needed)
                return True

    def _settle(self, answers: Answers, part: Part, needed: np.ndarray) -> None:
        """Divide the room around the balls that cells of `part` need, and set the limits of own generators."""
        settled = answers.settle(np.minimum(needed, answers.balls.radii))
        told, self._answers = self.peers.exchange([settled] * self.peers.count), None
        grown = {}
        for side, facing in answers.facing.items():
            settled = told[side // len(self._shifts)]
            grown[side], facing.facts[:, -2:] = np.max(settled[:, 0] / facing.facts[:, -2]), settled
        limits = self._limits_of(answers.balls, answers.facing, grown)
        self._balls, self._limits = answers.balls, np.column_stack(limits)
        # A room without limit is that of a generator that all parts know.
        finite = [np.where(np.isinf(limits), 0, limits)[self._chunks.order] for limits in self._limits.T]
        self._most = np.column_stack([np.maximum.reduceat(limits, self._chunks.firsts) for limits in finite])
        self._send_limits(answers.balls.centers)

    def _ask(self, x: np.ndarray, radii: np.ndarray, needed: np.ndarray) -> Answers:
        """Ask for the generators in balls around own generators.

        - `x` (n, d) float: positions of the generators.
        - `radii`, `needed` (n,) float: radii of the balls to ask for, and of the balls that the present cells need.
        """
        self.asked += 1
        peers, balls, ways = self.peers, BallGroups(x, radii, self._chunks), len(self._shifts)
        told, facing = peers.exchange([balls.facts] * peers.count), {}
        for side in range(len(self._sent)):
            number, way = divmod(side, ways)
            if number != peers.number or self._images[way].any():
                facts = told[number].copy()
                facts[:, :-2] += np.tile(self._shifts[way], 2)
                facing[side] = balls.facing(facts)
        none = np.empty(0, int)
        asked = [balls.meeting(facing[side]) if side in facing else none for side in range(len(self._sent))]
        requests = [
            np.column_stack([x[rows] - self._shifts[side % ways], needed[rows], (1 + SKIN) * radii[rows]])
            for side, rows in enumerate(asked)
        ]
        given, sent = [none] * len(asked), []
        for number, requested in enumerate(peers.exchange(self._joined(requests))):
            answers = []
            for way, shift in enumerate(self._shifts):
                balls_there, opposite = requested[requested[:, -1] == way, :-1], ways * (number + 1) - 1 - way
                rows, places = self._unknown(balls, balls_there, self._sent[opposite])
                given[opposite] = rows
                answers.append(np.column_stack([rows, inside(places, balls_there[:, :-1]), places + shift]))
            sent += self._joined(answers)
        return Answers(balls, np.unique(np.concatenate(asked)), facing, given, peers.exchange(sent))

    def _joined(self, tables: list[np.ndarray]) -> list[np.ndarray]:
        """Join the tables of all sides of each part to one array, whose last column is the number of the image."""
        ways = len(self._shifts)
        numbered = [np.column_stack([rows, np.full(len(rows), k % ways)]) for k, rows in enumerate(tables)]
        return [np.concatenate(numbered[k : k + ways]) for k in range(0, len(numbered), ways)]

    def _take(self, answers: Answers) -> None:
        """Add the generators that parts have given each other to the lists of ghosts."""
        self._sent = [np.concatenate(pair) for pair in zip(self._sent, answers.given, strict=True)]
        sides = [len(self._shifts) * number + rows[:, -1].astype(int) for number, rows in enumerate(answers.new)]
        rows = np.concatenate([rows[:, 0] for rows in answers.new]).astype(np.int32)
        self._sides, self._rows = np.concatenate([self._sides, *sides]), np.concatenate([self._rows, rows])
        # All in the balls and their skins are known, while no generator moves.
        self._answers = replace(answers, new=[rows[:0] for rows in answers.new])
        self._limits = np.column_stack([(1 + SKIN) * answers.balls.radii, np.zeros(len(self._caps))])
        self._send_limits(answers.balls.centers)
        self._store()

    def _unknown(self, own: BallGroups, balls: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the own generators in `balls` (m, d + 2) that are not among the `known` ones, and their positions.

        A row of `balls` has a center and two radii. The first, which cells of the other part need, is not used.
        """
        dim = own.centers.shape[1]
        if not len(balls):
            return np.empty(0, np.int32), np.empty((0, dim))
        balls = np.delete(balls, dim, axis=1)
        firsts = np.arange(0, len(balls), GROUP)
        lower = np.minimum.reduceat(balls[:, :dim] - balls[:, dim:], firsts, axis=0)
        groups = np.hstack([lower, np.maximum.reduceat(balls[:, :dim] + balls[:, dim:], firsts, axis=0)])
        rows = own.chunks.rows(np.flatnonzero((gaps(own.boxes[:, None], groups) <= 0).any(axis=1)))
        rows = np.sort(rows[np.isin(rows, known, invert=True)])
        places = own.centers[rows]
        found = inside(places, balls)
        return rows[found].astype(np.int32), places[found]

    def _limits_of(
        self, balls: BallGroups, facing: dict[int, Facing], grown: dict[int, float]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the limits of own generators, (n,) each; see `sum_cells` in part.cl.

        A generator that another part does not know is at least a skin away from each ball of that part. Far from all
        other parts, the radius of a ball is a share of the distance to them. The balls of each side are at most `grown`
        times as large as when it asked.
        """
        groups, k = balls.chunks.groups, len(balls.chunks.firsts)
        # A row for each chunk, and one for each generator that is beside another part or known there.
        places = np.zeros(len(groups), np.int32)
        for side, f in facing.items():
            places[f.balls] = places[self._sent[side]] = 1
        alone = np.flatnonzero(places)
        places[alone] = np.arange(k, k + len(alone))
        free, room = np.full((2, k + len(alone)), np.inf)
        for side, f in facing.items():
            largest, skins = f.facts[:, -2], f.facts[:, -1]
            ways = np.append(f.away, f.away[groups[alone]])
            ways[places[f.balls]] = f.apart
            share = 1 - max(grown[side] / NEAR, FREE)
            rooms = np.maximum(ways - np.maximum(largest.max(), FREE * ways), share * ways)
            rooms = np.maximum(skins.min(), rooms)
            rows, skin, largest = places[f.balls[f.places]], skins[f.others], largest[f.others]
            np.minimum.at(ways, rows, f.ways)
            np.minimum.at(rooms, rows, np.maximum(skin, f.ways - np.maximum(largest, FREE * f.ways)))
            rooms[places[self._sent[side]]] = np.inf
            free, room = np.minimum(free, FREE * ways), np.minimum(room, rooms)
        rows = np.where(places, places, groups)
        return np.maximum(balls.radii, free[rows]), room[rows]
