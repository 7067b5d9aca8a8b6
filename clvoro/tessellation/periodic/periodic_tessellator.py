"""The diagram of a periodic box: extend the generators by ghost images, tessellate, fold the diagram back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cla

from ...errors import InputError
from ...geometry.box import Box
from ...opencl.primitives import Summaries
from ..bins import BinnedPoints
from ..cut_cells import CutCells
from ..device_diagram import EXACT_SHARE, ROUGH_SHARE, CloseError, NeighborRows, Tessellation, domain_position
from ..polyhedra import Polyhedra
from .ghost_images import COLLAPSED, FAR, ExtendedBox, ExtendedPoints, FoldedDiagram
from .halo import Halo

if TYPE_CHECKING:
    from ..stages import TessellationStages

FIRST_DEPTH = 2.7
"""Estimated depth of the halo for the first diagram, in mean spacings."""


class FewCellsError(InputError):
    """A periodic box has too few cells: a neighbor is not the nearest image of its generator."""


@dataclass(frozen=True)
class ExtendedDiagram:
    """The diagram of generators and images that a folded diagram was made from, on the device.

    Attributes
    ----------
    images : ExtendedPoints
    tessellation : Tessellation
        Generators first, then images.
    folded : FoldedDiagram
    """

    images: ExtendedPoints
    tessellation: Tessellation
    folded: FoldedDiagram


class PeriodicTessellator:
    """Tessellate one periodic box repeatedly.

    Attributes
    ----------
    halo : Halo
    wide : ExtendedBox
        Contains every cell, wherever its generator is.
    latest : ExtendedDiagram or None
        Of the latest diagram, if it was kept.
    codes : (>= m,) int32
        Codes of the images across the faces of the latest diagram from scratch (see `FoldedDiagram`).
    """

    def __init__(self, stages: TessellationStages, domain: Box, halo: Halo | None = None) -> None:
        self.stages, self.domain = stages, domain
        self.periods = domain.periods(stages.engine.real)
        lower, upper = (corner[: domain.dim].astype(np.float64) for corner in domain.device_corners(stages.engine.real))
        self._edges = upper - lower
        self.wide = ExtendedBox(lower - self.periods, upper + self.periods)
        self._sums = Summaries(stages.engine, ("volumes",))
        self.halo = Halo(stages.engine) if halo is None else halo
        self.latest: ExtendedDiagram | None = None

    def tessellate(
        self,
        points: cla.Array,
        n: int,
        previous: Tessellation | None = None,
        exact: bool = False,
        nearest: bool = True,
        keep_extended: bool = False,
    ) -> Tessellation:
        """Tessellate by the first `n` of `points`; see `Tessellator.tessellate`.

        In a power diagram rows of `points` end with weights, and `previous` is None.

        Parameters
        ----------
        nearest : bool
            Reject cells with a neighbor that is not the nearest image of its generator. Code that computes the position
            of a neighbor from the graph takes the nearest image.
        keep_extended : bool
            Make the cells of images as well, which vertices need, and keep the extended diagram as `latest`.

        Raises
        ------
        InputError
            If generators coincide up to round-off.
        FewCellsError
            If a neighbor is not the nearest image of its generator.
        """
        stages, halo, dim = self.stages, self.halo, self.domain.dim
        ghost_images, cells = stages.ghost_images, stages.cells
        rows: Tessellation | NeighborRows | None = previous
        if previous is not None and not exact:
            t = self._updated(points, n, previous)
            if t is not None:
                self.latest = None
                return t
            # Free scratch memory: images and their bins need room.
            stages.engine.workspace.clear()
            if isinstance(cells, Polyhedra):
                # The first of several attempts overwrites an updated diagram.
                rows = NeighborRows(n, previous.starts.copy(), previous.neighbors.copy())
        if halo.cells == 0:
            volume = self.domain.measure / self.domain.frame[1] ** dim
            halo.fill(FIRST_DEPTH * (volume / n) ** (1 / dim), n)
        factor, grow = (halo.cells / n) ** (1 / dim), False
        while True:
            images = ghost_images.extend(self.domain, points, n, halo, factor, grow)
            binned = stages.bins.build(images.box, images.points, images.count)
            if dim == 2:
                stages.bins.clear_work()
            args = images.box, images.points, images.count, binned
            if isinstance(cells, Polyhedra):
                first = None if rows is None else ghost_images.unfold(images, rows)
                t = cells.tessellate(*args, first, exact, None if keep_extended else n, images.halo_args)
            else:
                t = cells.tessellate(*args, exact, None if keep_extended else n)
            share = EXACT_SHARE if exact else ROUGH_SHARE
            folded, enough, flags, generator = ghost_images.fold(images, binned, t, points, share, nearest)
            if enough:
                break
            factor, grow = 1.0, True
            # Memory for the new diagram.
            del images, binned, args, t, folded
        if flags & COLLAPSED:
            raise CloseError(points, n)
        if flags & FAR:
            place = domain_position(self.domain, points[generator].get()[:dim])
            raise FewCellsError(
                f"the generator at {place}, one of {n}, has a neighbor half a period away or farther, expected at "
                f"least four or five cells across each period of {self.domain}; use a smaller size, more cells "
                "(n_cells) or fewer levels"
            )
        self.codes = folded.codes
        self.latest = ExtendedDiagram(images, t, folded) if keep_extended else None
        return folded.tessellation

    def measure_faces(self) -> Tessellation:
        """Return the `latest` diagram with measures of faces in full precision."""
        latest, stages = self.latest, self.stages
        assert latest is not None
        t, places = latest.folded.tessellation, latest.folded.places
        if isinstance(stages.cells, Polyhedra) or t.face_measures.dtype == stages.engine.real:
            return t
        extended = stages.cells.measure_faces(latest.images.box, latest.tessellation)
        faces = extended.face_measures, extended.face_centroids
        if places is not None:
            faces = tuple(stages.gather.rows(places, array) for array in faces)
        return replace(t, face_measures=faces[0], face_centroids=faces[1])

    def _updated(self, points: cla.Array, n: int, previous: Tessellation) -> Tessellation | None:
        """Update `previous` incrementally to `points`; None if too much has changed."""
        stages = self.stages
        if isinstance(stages.cells, Polyhedra):
            t = stages.polyhedra_update.update(
                stages.cells, self.wide, points, previous, self._clip_of(points, n, previous)
            )
        else:
            stages.folded_cells.reserve(n)
            t = stages.incremental.update(stages.folded_cells, self.wide, points, previous)
        if t is None:
            return None
        # Cells without gaps may cover the box more than once.
        self._sums.collect("volumes", t.volumes, n)
        total, measure = self._sums.read_one("volumes").sum, float(np.prod(self._edges))
        return t if abs(total - measure) < measure / 2 else None

    def _clip_of(self, points: cla.Array, n: int, previous: Tessellation) -> Callable[[CutCells, cla.Array, int], None]:
        """Return a function that clips the unfinished cells of an update of `previous` to `points`, in 3D."""
        stages, halo, cells = self.stages, self.halo, self.stages.cells
        assert isinstance(cells, Polyhedra)

        @cache
        def images_in_bins() -> tuple[ExtendedPoints, BinnedPoints, NeighborRows]:
            images = stages.ghost_images.extend(self.domain, points, n, halo, (halo.cells / n) ** (1 / 3), False)
            binned = stages.bins.build(images.box, images.points, images.count)
            return images, binned, stages.ghost_images.unfold(images, previous)

        def clip(cut: CutCells, report: cla.Array, used: int) -> None:
            images, binned, rows = images_in_bins()
            cells.clip_rest(cut, report, images.box, images.points, binned, rows, images.count, images.halo_args)
            stages.ghost_images.fold_clipped(images, cut, report, used)

        return clip
