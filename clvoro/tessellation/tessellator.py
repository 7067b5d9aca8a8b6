"""From generators to the diagram of a domain: the stages and their order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pyopencl.array as cla

from ..geometry.box import Box
from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from .bins import BinnedPoints
from .clipped.polygonal import PolygonTessellator
from .device_diagram import CloseError, Follow, Tessellation, read_report
from .periodic.periodic_tessellator import ExtendedDiagram, PeriodicTessellator
from .polyhedra import Polyhedra
from .stages import TessellationStages, tessellate_box


class Tessellator:
    """Tessellate one domain repeatedly.

    Each call overwrites the `Tessellation` of the call before. Its graph stays valid until the new one is complete.

    Parameters
    ----------
    spacing : callable, optional
        For a polygon: distance of generators near points (k, 2) of its boundary, (k,); places the ghost generators.
    coarser : Tessellator, optional
        The tessellator of a coarser level of the same domain. Its halo is the first guess in a periodic box.
    """

    def __init__(
        self,
        stages: TessellationStages,
        domain: Domain,
        spacing: Callable[[np.ndarray], np.ndarray] | None = None,
        coarser: Tessellator | None = None,
    ) -> None:
        self.stages, self.domain = stages, domain
        self.periodic: PeriodicTessellator | None = None
        if isinstance(domain, Box) and any(domain.periodic):
            known = None if coarser is None or coarser.periodic is None else coarser.periodic.halo
            self.periodic = PeriodicTessellator(stages, domain, known)
        self._polygon = PolygonTessellator(stages, domain, spacing) if isinstance(domain, Polygon) else None

    @property
    def extended(self) -> ExtendedDiagram | None:
        """The extended diagram that the latest one was folded from, in a periodic box."""
        return None if self.periodic is None else self.periodic.latest

    def has_extended(self, t: Tessellation) -> bool:
        """Return whether the complete extended diagram of `t`, the latest diagram, is known."""
        latest = self.extended
        return self.periodic is None or (latest is not None and latest.folded.tessellation is t)

    def extend(self, points: cla.Array, n: int) -> Tessellation:
        """Tessellate a periodic box from scratch, with a complete extended diagram."""
        assert self.periodic is not None
        with self._in_units():
            return self.periodic.tessellate(points, n, keep_extended=True)

    def final(self, t: Tessellation) -> tuple[Tessellation, ExtendedDiagram | None]:
        """Return `t`, the latest diagram, with faces in full precision, and its extended diagram in a periodic box.

        The extended diagram of `t` must be known (`has_extended`).
        """
        if self.periodic is not None:
            return self.periodic.measure_faces(), self.extended
        if self._polygon is None and not isinstance(self.stages.cells, Polyhedra):
            t = self.stages.cells.measure_faces(self.domain, t)
        return t, None

    def restore(
        self, points: cla.Array, saved: Mapping[str, np.ndarray], spare: int, vertices: Sequence[np.ndarray] = ()
    ) -> Tessellation:
        """Return the `saved` diagram of `points` (n, d), with room for `spare` more half-faces.

        It uses the arrays of the stage that makes the next diagram, to save memory. `vertices` are those of
        the diagram, if it had any.
        """
        stages = self.stages
        if self._polygon is not None:
            # The convex diagram is not saved. A new diagram has the same bits.
            t = self.tessellate(points, len(points))
            stages.bins.clear()
            return t
        if self.periodic is not None and stages.engine.dim == 2:
            return stages.folded_cells.restore(points, saved, spare)
        t = (
            stages.cells.restore(points, saved, spare, vertices)
            if isinstance(stages.cells, Polyhedra)
            else stages.cells.restore(points, saved, spare)
        )
        if self.periodic is not None:
            # The next diagram may take several attempts that all start from this graph.
            t = replace(t, starts=t.starts.copy(), neighbors=t.neighbors.copy())
        return t

    def tessellate(
        self,
        points: cla.Array,
        n: int,
        previous: Tessellation | None = None,
        exact: bool = False,
        binned: BinnedPoints | None = None,
        follow: Follow = read_report,
    ) -> Tessellation:
        """Tessellate by the first `n` of `points` (n, d), in normalized coordinates.

        Parameters
        ----------
        previous : Tessellation, optional
            The latest diagram, of the same generators at earlier positions, for an incremental update.
        exact : bool
            Reject generators so close that round-off makes a share of a cell uncertain; see `Cells.tessellate`.
        binned : BinnedPoints, optional
            The generators in bins, if they are known.
        follow : callable, optional
            See `Follow`.

        Raises
        ------
        InputError
            If generators are too close to each other to be distinguished.
        """
        with self._in_units():
            if self.periodic is not None:
                t = self.periodic.tessellate(points, n, previous, exact, not exact, keep_extended=exact)
            elif self._polygon is not None:
                t = self._polygon.tessellate(points, n, previous, exact, binned)
            else:
                return tessellate_box(self.stages, self.domain, points, n, previous, exact, binned, follow)
        follow(t, None)
        return t

    @contextmanager
    def _in_units(self) -> Iterator[None]:
        """Give errors about close generators the positions in the domain."""
        try:
            yield
        except CloseError as error:
            raise error.within(self.domain) from None
