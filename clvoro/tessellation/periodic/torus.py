"""The diagram of a periodic box: that of the generators and their images near the seams, folded back (`seam.py`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cla

from ...errors import InputError
from ...geometry.box import Box
from ...opencl.primitives import Summaries
from ..device_diagram import EXACT_SHARE, ROUGH_SHARE, CloseError, Tessellation, domain_position
from ..polyhedra import Polyhedra
from .ghost_images import COLLAPSED, FAR, ExtendedBox, Folded, Images
from .halo import Margins

if TYPE_CHECKING:
    from ..stages import TessellationStages

FIRST_MARGIN = 2.7
"""What cells are thought to need before the first diagram, in mean spacings."""


class FewCellsError(InputError):
    """A cell of a run in a periodic box reaches a neighbor that is not the nearest image of its generator."""


@dataclass(frozen=True)
class Unfolded:
    """The diagram that a folded one was made of, on the device: its rows are plain cells in the plane, or in space.

    Attributes
    ----------
    images : Images
    tessellation : Tessellation
        Of the generators, which come first, and their images.
    folded : Folded
    """

    images: Images
    tessellation: Tessellation
    folded: Folded


class Torus:
    """Tessellate one periodic box again and again.

    Attributes
    ----------
    margins : Margins
        From the seams, within which images are taken.
    latest : Unfolded or None
        Of the latest diagram, if that was a whole one.
    """

    def __init__(
        self, stages: TessellationStages, domain: Box, margins: Margins | None = None
    ) -> None:
        self.stages, self.domain = stages, domain
        self.periods = domain.periods(stages.engine.real)
        lower, upper = (
            corner[: domain.dim].astype(np.float64)
            for corner in domain.device_corners(stages.engine.real)
        )
        self._edges = upper - lower
        # Wide enough for every cell, from wherever its generator is.
        self._wide = ExtendedBox(lower - self.periods, upper + self.periods)
        self._sums = Summaries(stages.engine, ("volumes",))
        self.margins = Margins(stages.engine) if margins is None else margins
        self.latest: Unfolded | None = None

    def tessellate(
        self,
        points: cla.Array,
        n: int,
        previous: Tessellation | None = None,
        exact: bool = False,
        nearest: bool = True,
        whole: bool = False,
    ) -> Tessellation:
        """Tessellate by the first `n` of `points`; see `Tessellator.tessellate`.

        Parameters
        ----------
        nearest : bool
            Refuse cells whose neighbors are not the nearest images of their generators: whoever reads positions of
            neighbors off the graph takes these.
        whole : bool
            Make the cells of images, too, which vertices take, and keep it all as `latest`.

        Raises
        ------
        InputError
            If generators coincide up to round-off.
        FewCellsError
        """
        stages, margins, dim = self.stages, self.margins, self.domain.dim
        seam, cells = stages.seam, stages.cells
        if previous is not None and not exact and not isinstance(cells, Polyhedra):
            t = self._repaired(points, n, previous)
            if t is not None:
                self.latest = None
                return t
            # What steps have worked on is of no use here, where images and their bins need room.
            stages.engine.workspace.clear()
        if margins.cells == 0:
            volume = self.domain.measure / self.domain.frame[1] ** dim
            margins.fill(FIRST_MARGIN * (volume / n) ** (1 / dim), n)
        factor, grow = (margins.cells / n) ** (1 / dim), False
        while True:
            images = seam.extend(self.domain, points, n, margins, factor, grow)
            binned = stages.bins.build(images.box, images.points, images.count)
            if dim == 2:
                stages.bins.clear_work()
            args = images.box, images.points, images.count, binned
            if isinstance(cells, Polyhedra):
                rows = None if previous is None else seam.unfold(images, previous)
                t = cells.tessellate(*args, rows, exact, None if whole else n, images.seams)  # type: ignore[arg-type]
            else:
                t = cells.tessellate(*args, exact, None if whole else n)
            share = EXACT_SHARE if exact else ROUGH_SHARE
            folded, enough, flags, generator = seam.fold(images, binned, t, points, share, nearest)
            if enough:
                break
            factor, grow = 1.0, True
            # Memory for the new diagram.
            del images, binned, args, t, folded
        if flags & COLLAPSED:
            raise CloseError(points, n)
        if flags & FAR:
            place = domain_position(self.domain, points[generator].get())
            raise FewCellsError(
                f"the generator at {place}, one of {n}, has a neighbor half a period away or farther, expected at "
                f"least four or five cells across each period of {self.domain}; use a smaller size, more cells "
                "(n_cells) or fewer levels"
            )
        self.latest = Unfolded(images, t, folded) if whole else None
        return folded.tessellation

    def measure_faces(self) -> Tessellation:
        """Return the `latest` diagram with what is known of faces in full precision."""
        latest, stages = self.latest, self.stages
        assert latest is not None
        t, places = latest.folded.tessellation, latest.folded.places
        if isinstance(stages.cells, Polyhedra) or t.face_measures.dtype == stages.engine.real:
            return t
        whole = stages.cells.measure_faces(latest.images.box, latest.tessellation)
        faces = whole.face_measures, whole.face_centroids
        if places is not None:
            faces = tuple(stages.gather.rows(places, array) for array in faces)
        return replace(t, face_measures=faces[0], face_centroids=faces[1])

    def _repaired(self, points: cla.Array, n: int, previous: Tessellation) -> Tessellation | None:
        """Return `previous` carried over to `points`, in 2D; None where too much has changed."""
        stages = self.stages
        stages.folded.reserve(n)
        t = stages.incremental.update(stages.folded, self._wide, points, previous)
        if t is None:
            return None
        # Cells without gap could still lie twice around the torus.
        self._sums.collect("volumes", t.volumes, n)
        total, measure = self._sums.read_one("volumes").sum, float(np.prod(self._edges))
        return t if abs(total - measure) < measure / 2 else None
