"""The steps of a part of a domain: generators of other parts as ghosts, and the proof that there are enough of them.

A ball around a corner of a cell, with the generator of the cell on its surface, contains no generator. The reach of a
cell is the distance of its farthest corner from its generator, and all these balls lie in the ball around the generator
with twice this radius. So a cell is final if this part knows all generators in that ball. Each part tells the others
the boxes that contain its generators, and asks those whose boxes meet its balls for the generators inside. If there are
new ones, all parts make their cells again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import scipy

from ..errors import ClvoroError
from ..geometry.domain import Domain
from ..opencl.device_array import buffer_of
from ..opencl.primitives import NamedArrays
from .decomposition import hilbert_keys
from .device_diagram import Follow, Tessellation
from .part import Ghosts, Part
from .stages import TessellationStages
from .steps import DomainSteps, Sort

FIRST_REACH = 1.9, 2.4
"""Radius of the first balls over the spacing of the generators around: if only own cells have to be final, and if those
of their neighbors have to be final, too."""
JUMP = 3
"""A new box begins where two successive generators on the curve are so many spacings apart."""
CHUNK, CHUNKS = 16, 512
"""Least number of generators in a box, and largest number of boxes, that say where the generators of a part are."""
SLACK = 1.05
"""Factor on the radii of balls: with a few more ghosts the next diagrams need no further ones."""
NOISE = {"float64": 1e-6, "float32": 1e-4}
"""Bound of the round-off of a reach, as a share of it."""
FILLED, MATCHED = {"float64": 1e-8, "float32": 1e-3}, {"float64": 1e-5, "float32": 1e-3}
"""Largest differences of the volume of all cells from that of the domain, and of both sides of faces between parts."""
GROUP = 64
"""Number of balls in a group. The box around a group is compared with the boxes of generators first."""


class Chunks:
    """Boxes around generators that follow one another on a Hilbert curve.

    Parameters
    ----------
    points : (n, d) float
    lower, upper : (d,) float
        Corners of a box with all of them.

    Attributes
    ----------
    order : (n,) int
        Generators along the curve.
    firsts : (k,) int
        Where the chunks begin in `order`.
    spacings : (n,) float
        For each generator the median distance of two successive ones in its chunk.
    """

    def __init__(self, points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        self.order = np.argsort(hilbert_keys(points, lower, upper), kind="stable")
        count = max(1, min(CHUNKS, len(points) // CHUNK))
        firsts = np.arange(count) * len(points) // count
        ways = np.linalg.norm(np.diff(points[self.order], axis=0), axis=1)
        least = float(np.prod(upper - lower) / len(points)) ** (1 / len(lower)) / CHUNK
        usual = [max(float(np.median(some)), least) if len(some) else least for some in np.split(ways, firsts[1:])]
        spacings = np.repeat(usual, np.diff(np.append(firsts, len(points))))
        self.spacings = np.empty(len(points))
        self.spacings[self.order] = spacings
        # Generators may have moved far from the others of their part.
        jumps = 1 + np.flatnonzero(ways > JUMP * spacings[:-1])
        self.firsts = np.unique(np.concatenate([firsts, jumps]))
        self.move(points)

    def move(self, points: np.ndarray) -> None:
        """Set `boxes` (k, 2 d) to those of the present `points`: lower, then upper corners."""
        sorted_points = points[self.order]
        lower = np.minimum.reduceat(sorted_points, self.firsts, axis=0)
        self.boxes = np.hstack([lower, np.maximum.reduceat(sorted_points, self.firsts, axis=0)])

    def members(self, chunks: np.ndarray) -> np.ndarray:
        """Return the generators of those `chunks` where it is True."""
        return self.order[np.repeat(chunks, np.diff(np.append(self.firsts, len(self.order))))]


def gaps2(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Return the squared distances of `points` (n, d) from `boxes` (k, 2 d), (n, k)."""
    dim = points.shape[1]
    below, above = boxes[None, :, :dim] - points[:, None], points[:, None] - boxes[None, :, dim:]
    return (np.maximum(np.maximum(below, above), 0) ** 2).sum(axis=2)


def overlaps(boxes: np.ndarray, others: np.ndarray) -> Any:
    """Return which of `boxes` (k, 2 d) meets each of `others` (m, 2 d), (k, m) bool."""
    dim = boxes.shape[1] // 2
    low = boxes[:, None, :dim] <= others[None, :, dim:]
    return (low & (others[None, :, :dim] <= boxes[:, None, dim:])).all(axis=2)


class PartSteps(DomainSteps):
    """The steps of one part of a domain whose other parts are the peers of the engine.

    Ghosts are kept from one diagram of the same generators to the next.

    Attributes
    ----------
    rounds : int
        How often the cells of the latest diagram have been made.
    """

    def __init__(self, stages: TessellationStages, domain: Domain) -> None:
        super().__init__(stages, domain)
        self.peers, self.rounds = stages.engine.peers, 0
        self._room = NamedArrays(stages.engine, spare=1 / 16)
        self._labels: cla.Array | None = None

    @property
    def _reads_rows(self) -> bool:
        """Whether ghosts need cells: in 2D, where updates and the descent of shapes read the rows of neighbors."""
        return not self.stages.cells.from_previous

    def begin(self, n: int, last: bool = False, labels: cla.Array | None = None) -> None:
        """Note the labels of the generators, and count the rounds of a new diagram."""
        assert labels is not None, "generators of parts have labels"
        self._given, self.rounds = labels, 0

    def extend(self, sites: cla.Array, n: int) -> Part:
        """Return the generators, the first `n` of `sites`, with the ghosts that are known."""
        labels = self._given
        self.rounds += 1
        if self.peers.count == 1:
            return Part(n, n, sites, self.box, None, labels=labels)
        x = sites[:n].get().astype(float)
        if self._labels is not labels:
            self._begin_anew(x, labels)
        elif self.rounds == 1:
            self._chunks.move(x)
            self._meet()
        self._x = x
        count = n + len(self._rows)
        points = self._room("points", size=count * self.stages.engine.dim).reshape(count, -1)
        cl.enqueue_copy(self.stages.engine.queue, buffer_of(points), buffer_of(sites), byte_count=sites[:n].nbytes)
        self._ghosts.fill(self.stages.engine, n, points)
        return Part(n, count, points, self.box, self._ghosts, labels=self._all_labels)

    def _begin_anew(self, x: np.ndarray, labels: cla.Array) -> None:
        """Ask for the ghosts of new generators."""
        engine, count = self.stages.engine, self.peers.count
        lower, upper = (corner[: engine.dim].astype(float) for corner in self.box.device_corners(engine.real))
        self._labels, self._chunks = labels, Chunks(x, lower, upper)
        self._sent = [np.empty(0, np.int32) for _ in range(count)]
        self._parts, self._rows = np.empty(0, int), np.empty(0, np.int32)
        self._caps = FIRST_REACH[self._reads_rows] * self._chunks.spacings
        self._x = x
        self._meet()
        self._ask(x, self._caps, np.empty((0, engine.dim)), np.empty(0))
        self._store()

    def _meet(self) -> None:
        """Tell the others where the generators are."""
        self._boxes = self.peers.exchange([self._chunks.boxes] * self.peers.count)

    def _store(self) -> None:
        """Upload the lists of ghosts, and get from their owners their labels and the largest radii of their balls."""
        engine, n = self.stages.engine, len(self._x)
        order = np.argsort(self._parts, kind="stable")
        self._parts, self._rows = self._parts[order], self._rows[order]
        self._ghosts = Ghosts.of_lists(engine, self.peers, self._parts, self._rows, self._sent)
        assert self._labels is not None
        labels = np.empty(n + len(self._rows), np.int32)
        labels[:n] = self._labels.get()[:n]
        labels[n:] = np.concatenate(self.peers.exchange([labels[rows] for rows in self._sent]))
        self._all_labels = engine.upload(labels, np.int32)
        caps = self._caps[:n]
        self._caps = np.concatenate([caps, *self.peers.exchange([caps[rows] for rows in self._sent])])

    def builds_all(self, part: Part, complete: bool, enough: bool) -> bool:
        """Return whether ghosts get cells: in 2D, where the descent of shapes reads the rows of neighbors."""
        return part.ghosts is None or complete or self._reads_rows

    def rows(self, previous: Tessellation) -> None:
        """Cells start anew, since ghosts change."""

    def is_complete(self, t: Tessellation) -> bool:
        """Return whether ghosts have cells."""
        return t.part is None or t.part.ghosts is None or t.whole is not None

    def update(
        self, sites: cla.Array, n: int, previous: Tessellation, sort: Sort, follow: Follow
    ) -> Tessellation | None:
        """Update `previous` in 2D, with the cells of ghosts; all parts do it, or none."""
        stages = self.stages
        if not self._reads_rows:
            return None
        self.rounds = 0
        part = self.extend(sites, n)
        before = previous.whole or previous
        t = stages.update.update(stages.cells, self.box, part.points, before, clip=None)
        if self.peers.any(t is None) or t is None:
            return None
        part.order_rows(stages.engine, t, stages.cells.defines)
        made = self.finish(part, t, sites, False, True)
        if made is not None:
            follow(made, None)
        return made

    def finish(self, part: Part, t: Tessellation, points: cla.Array, exact: bool, nearest: bool) -> Tessellation | None:
        """Return `t` if its cells, and in 2D those of neighbors, are final; None if ghosts were missing."""
        if part.ghosts is None:
            return replace(t, part=part)
        engine, n = self.stages.engine, part.n_own
        assert t.reach is not None
        reach = t.reach.get().astype(float) * (2 * (1 + NOISE[engine.real.name]))
        ghosts, away = np.empty(0, int), np.empty((0, engine.dim))
        if self._reads_rows:
            ghosts = part.neighboring_ghosts(engine, t)
            away = part.points.get()[ghosts].astype(float)
        while True:
            caps = self._caps[: part.count]
            radii = np.minimum(reach[:n], caps[:n]), np.minimum(reach[ghosts], caps[ghosts])
            found = self._ask(self._x, radii[0], away, radii[1])
            state = self.peers.total(
                np.array([found, (reach[:n] > caps[:n]).any() or (reach[ghosts] > caps[ghosts]).any()])
            )
            if state[0]:
                self._caps = 2 * caps
                self._store()
                return None
            if not state[1]:
                break
            self._caps = 2 * caps
        own = t.first(n) if t.n > n else t
        self._check(part.sums(engine, own))
        whole = t if t.n == part.count else None
        return replace(own, part=part, whole=whole, points=part.points, sites=part.points)

    def _check(self, sums: np.ndarray) -> None:
        """Raise if the cells of all parts do not fill the domain, or faces between parts have one side."""
        real = self.stages.engine.real
        corners = self.box.device_corners(real)
        volume, gap, faces = self.peers.total(sums)
        measure = float(np.prod((corners[1] - corners[0])[: self.domain.dim].astype(float)))
        off = abs(volume / measure - 1)
        if off > FILLED[real.name] or abs(gap) > MATCHED[real.name] * faces:
            raise ClvoroError(
                f"the cells of all ranks differ from the domain by {off:.2g} of its volume, and faces between them by "
                f"{abs(gap) / max(faces, 1e-300):.2g} of their area, expected none: ghosts are missing"
            )

    def _ask(self, x: np.ndarray, radii: np.ndarray, more: np.ndarray, more_radii: np.ndarray) -> int:
        """Ask for the generators in balls around `x` (n, d) and `more` (k, d); return how many ghosts are new."""
        balls = [np.empty((0, x.shape[1] + 1)) for _ in self._boxes]
        for part, boxes in enumerate(self._boxes):
            if part != self.peers.number:
                balls[part] = self._near(boxes, x, radii, more, more_radii)
        wanted = self.peers.exchange(balls)
        found = [self._inside(given, sent) for given, sent in zip(wanted, self._sent, strict=True)]
        self._sent = [np.concatenate(pair) for pair in zip(self._sent, found, strict=True)]
        new = self.peers.exchange(found)
        self._parts = np.concatenate([self._parts, np.repeat(np.arange(len(new)), [len(rows) for rows in new])])
        self._rows = np.concatenate([self._rows, *new])
        return sum(map(len, new))

    def _near(
        self, boxes: np.ndarray, x: np.ndarray, radii: np.ndarray, more: np.ndarray, more_radii: np.ndarray
    ) -> np.ndarray:
        """Return the balls (m, d + 1) that meet one of the `boxes` (k, 2 d) of another part."""
        chunks, dim = self._chunks, x.shape[1]
        largest = np.maximum.reduceat(radii[chunks.order], chunks.firsts)[:, None]
        grown = chunks.boxes + np.hstack([-largest] * dim + [largest] * dim)
        meet = overlaps(grown, boxes)
        ends, found = np.append(chunks.firsts, len(chunks.order)), []
        for c in np.flatnonzero(meet.any(axis=1)):
            rows = chunks.order[ends[c] : ends[c + 1]]
            near = (gaps2(x[rows], boxes[meet[c]]) <= radii[rows, None] ** 2).any(axis=1)
            found.append(rows[near])
        rows = np.concatenate([np.empty(0, int), *found])
        given = [np.column_stack([x[rows], SLACK * radii[rows]])]
        for first in range(0, len(more), 4096):
            places, reach = more[first : first + 4096], more_radii[first : first + 4096]
            near = (gaps2(places, boxes) <= reach[:, None] ** 2).any(axis=1)
            given.append(np.column_stack([places[near], SLACK * reach[near]]))
        return np.concatenate(given)

    def _inside(self, balls: np.ndarray, known: np.ndarray) -> np.ndarray:
        """Return the generators in `balls` (m, d + 1) that are not among the `known` ones, (k,) int32."""
        if not len(balls):
            return np.empty(0, np.int32)
        centers, radii = balls[:, :-1], balls[:, -1:]
        firsts = np.arange(0, len(balls), GROUP)
        lower = np.minimum.reduceat(centers - radii, firsts, axis=0)
        groups = np.hstack([lower, np.maximum.reduceat(centers + radii, firsts, axis=0)])
        rows = self._chunks.members(overlaps(self._chunks.boxes, groups).any(axis=1))
        rows = np.setdiff1d(rows, known)
        if not len(rows):
            return np.empty(0, np.int32)
        lists: Sequence = scipy.spatial.cKDTree(self._x[rows]).query_ball_point(
            centers, radii[:, 0], return_sorted=False
        )
        places = np.unique(np.concatenate([np.asarray(some, int) for some in lists]))
        return rows[places].astype(np.int32)
