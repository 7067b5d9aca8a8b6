"""The steps of a periodic box: extend the generators by ghost images, and fold the diagram back."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pyopencl.array as cla

from ...errors import InputError
from ...geometry.domain import Domain
from ...opencl.primitives import Summaries
from ..bins import BinnedPoints
from ..cut_cells import CutCells
from ..device_diagram import EXACT_SHARE, ROUGH_SHARE, CloseError, Follow, NeighborRows, Tessellation, domain_position
from ..part import Part
from ..polyhedra import Polyhedra
from ..stages import TessellationStages
from ..steps import DomainSteps, Sort
from .ghost_images import COLLAPSED, FAR, ExtendedBox
from .halo import Halo

FIRST_DEPTH = 2.7
"""Estimated depth of the halo for the first diagram, in mean spacings."""

SAMPLE, SAMPLED_FROM = 1 / 32, {2: math.inf, 3: 8_000}
"""Share of the cells that show whether an estimated depth is enough; from how many cells on, by dimension."""

LAST_FACTOR = 1.05
"""Factor to a required depth in the last diagram of a run. It saves attempts that add a few images."""


class FewCellsError(InputError):
    """A periodic box has too few cells: a neighbor is not the nearest image of its generator."""


class Images(DomainSteps):
    """The steps of one periodic box.

    - `halo`: that of a coarser level of the same domain, as the first guess.

    Its attributes:
    - `box`: contains every cell, wherever its generator is.
    """

    def __init__(self, stages: TessellationStages, domain: Domain, halo: Halo | None = None) -> None:
        super().__init__(stages, domain)
        periods = domain.periods(stages.engine.real)
        lower, upper = (corner[: domain.dim].astype(np.float64) for corner in domain.device_corners(stages.engine.real))
        self._edges = upper - lower
        self.box = ExtendedBox(lower - periods, upper + periods)
        self._sums = Summaries(stages.engine, ("volumes",))
        self.halo = self._halo = Halo(stages.engine) if halo is None else halo
        self.most = self._halo.most
        self._factor, self._grow, self._room = 1.0, False, 1.0

    def begin(self, n: int, last: bool = False, labels: cla.Array | None = None) -> None:
        """Take the depth of the halo from the latest diagram, or estimate it, for `n` generators."""
        halo, dim = self._halo, self.domain.dim
        if halo.cells == 0:
            volume = self.domain.measure / self.domain.frame[1] ** dim
            halo.fill(FIRST_DEPTH * (volume / n) ** (1 / dim), n)
        # Nothing moves after the last diagram. Room for motion costs many images where sizes of cells differ much.
        self._factor, self._grow, self._room = (halo.cells / n) ** (1 / dim), False, 0.0 if last else 1.0

    def sample_size(self, n: int) -> int:
        """Return how many cells of `n` to build first; see `DomainSteps`."""
        return int(SAMPLE * n) if self._halo.estimated and n >= SAMPLED_FROM[self.domain.dim] else 0

    def reaches(self, part: Part, t: Tessellation) -> bool:
        """Return whether the estimated halo is deep enough for the cells of `t`."""
        halo = self._halo
        estimate, cells = float(halo.required[:1].get()[0]), halo.cells
        enough = self.stages.ghost_images.reaches(part, halo)
        if enough:
            halo.fill(estimate, cells)
        return enough

    def keep_ghosts(self, last: bool) -> None:
        """Keep the depth that the latest diagram requires."""
        self._factor, self._grow, self._room = 1.0, False, 0.0 if last else 1.0
        self._halo.is_bound = True

    def extend(self, sites: cla.Array, n: int) -> Part:
        """Return the first `n` of `sites` with their images in the halo."""
        images = self.stages.ghost_images
        return images.extend(self.domain, sites, n, self._halo, self._factor, self._grow, self._room)

    def rows(self, previous: Tessellation) -> NeighborRows:
        """Return a copy of the graph of `previous`: the first of several attempts overwrites an updated diagram."""
        return NeighborRows.copy_of(previous)

    def unfold(self, part: Part, rows: Tessellation | NeighborRows) -> NeighborRows:
        """Return `rows` with the images in `part` as neighbors."""
        return self.stages.ghost_images.unfold(part, rows)

    def finish(self, part: Part, t: Tessellation, points: cla.Array, exact: bool, nearest: bool) -> Tessellation | None:
        """Fold `t`; None if the halo was not deep enough. It will be deeper.

        Raises `InputError` if generators coincide up to round-off. Raises `FewCellsError` if a neighbor is not the
        nearest image of its generator.
        """
        share = EXACT_SHARE if exact else ROUGH_SHARE
        fold = self.stages.ghost_images.fold
        folded, enough, flags, generator = fold(part, self._halo, t, points, share, nearest)
        if not enough:
            self._factor, self._grow = 1.0 if self._room > 0 else LAST_FACTOR, True
            return None
        if flags & COLLAPSED:
            raise CloseError(points, part.n_own)
        if flags & FAR:
            place = domain_position(self.domain, points[generator].get())
            raise FewCellsError(
                f"the generator at {place}, one of {part.n_own}, has a neighbor half a period away or farther, "
                f"expected at least four or five cells across each period of {self.domain}; use a smaller size, more "
                "cells (n_cells) or fewer levels"
            )
        return folded

    def is_complete(self, t: Tessellation) -> bool:
        """Return whether `t` was folded from a diagram with the cells of all images."""
        return t.folded is not None and t.folded.whole is not None

    def update(
        self, sites: cla.Array, n: int, previous: Tessellation, sort: Sort, follow: Follow
    ) -> Tessellation | None:
        """Update the folded diagram `previous` to the first `n` of `sites`; None if too much has changed."""
        stages = self.stages

        @cache
        def images_in_bins() -> tuple[Part, BinnedPoints, NeighborRows]:
            self.begin(n)
            part = self.extend(sites, n)
            return part, stages.bins.build(part.box, part.points, part.count), self.unfold(part, previous)

        def clip(cells: Polyhedra, cut: CutCells, report: cla.Array, used: int) -> None:
            part, binned, rows = images_in_bins()
            cells.clip_rest(cut, report, part, binned, rows)
            stages.ghost_images.fold_clipped(part, cut, report, used)

        t = stages.update.update(stages.folded_cells, self.box, sites, previous, clip=clip)
        if t is not None:
            # Cells without gaps may cover the box more than once.
            self._sums.collect("volumes", t.volumes, n)
            total, measure = self._sums.read_one("volumes").sum, float(np.prod(self._edges))
            if abs(total - measure) < measure / 2:
                follow(t, None)
                return t
        # Images and their bins need memory.
        stages.engine.workspace.shrink()
        return None
