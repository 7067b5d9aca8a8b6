"""From generators to the diagram of a domain: which stages, in which order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pyopencl.array as cla

from ..geometry.box import Box, Domain
from ..geometry.polygon import Polygon
from .bins import BinnedPoints
from .clipped.polygonal import PolygonTessellator
from .device_diagram import CloseError, Tessellation
from .periodic.torus import Torus, Unfolded
from .polyhedra import Polyhedra
from .stages import TessellationStages, tessellate_box


class Tessellator:
    """Tessellate one domain again and again.

    Buffers are the stages': the next call overwrites a `Tessellation`, its graph once the new one is made.

    Parameters
    ----------
    spacing : callable, optional
        Of a polygonal domain: distance of generators near points (k, 2) of its boundary, (k,); see `place_sentinels`.
    coarser : Tessellator, optional
        Of the same domain, for fewer generators: what it knows of their distances is a good guess to begin with.
    """

    def __init__(
        self,
        stages: TessellationStages,
        domain: Domain,
        spacing: Callable[[np.ndarray], np.ndarray] | None = None,
        coarser: Tessellator | None = None,
    ) -> None:
        self.stages, self.domain = stages, domain
        self.torus: Torus | None = None
        if isinstance(domain, Box) and any(domain.periodic):
            known = None if coarser is None or coarser.torus is None else coarser.torus.margins
            self.torus = Torus(stages, domain, known)
        self._polygon = (
            PolygonTessellator(stages, domain, spacing) if isinstance(domain, Polygon) else None
        )

    @property
    def unfolded(self) -> Unfolded | None:
        """What the latest diagram was folded from, in a periodic box."""
        return None if self.torus is None else self.torus.latest

    def is_whole(self, t: Tessellation) -> bool:
        """Tell whether all is known that `t`, the latest diagram, was folded from, if it was."""
        latest = self.unfolded
        return self.torus is None or (latest is not None and latest.folded.tessellation is t)

    def make_whole(self, points: cla.Array, n: int) -> Tessellation:
        """Tessellate a periodic box anew, so that it is."""
        assert self.torus is not None
        with self._in_units():
            return self.torus.tessellate(points, n, whole=True)

    def final(self, t: Tessellation) -> tuple[Tessellation, Unfolded | None]:
        """Return `t`, the latest diagram, which `is_whole`, with what is known of faces in full precision.

        Return also, in a periodic box, what it was folded from.
        """
        if self.torus is not None:
            return self.torus.measure_faces(), self.unfolded
        if self._polygon is None and not isinstance(self.stages.cells, Polyhedra):
            t = self.stages.cells.measure_faces(self.domain, t)
        return t, None

    def restore(
        self, points: cla.Array, saved: Mapping[str, np.ndarray], spare: int
    ) -> Tessellation:
        """Return the diagram of `points` (n, d) that was `saved`, with room for so many more faces.

        It lies in the arrays of the stage that makes the next one: those of a run take much of the device's memory.
        """
        stages = self.stages
        if self._polygon is not None:
            # Trimmed from another diagram, which is not kept: made anew, it has the same bits.
            t = self.tessellate(points, len(points))
            stages.bins.clear()
            return t
        if self.torus is not None and stages.engine.dim == 2:
            return stages.folded.restore(points, saved, spare)
        t = stages.cells.restore(points, saved, spare)
        if self.torus is not None:
            # The next one may take several attempts, each of which begins with this graph, and has its own there.
            t = replace(t, starts=t.starts.copy(), neighbors=t.neighbors.copy())
        return t

    def tessellate(
        self,
        points: cla.Array,
        n: int,
        previous: Tessellation | None = None,
        exact: bool = False,
        binned: BinnedPoints | None = None,
    ) -> Tessellation:
        """Tessellate by the first `n` of `points` (n, d), in the coordinates of the domain's frame.

        Parameters
        ----------
        previous : Tessellation, optional
            The latest diagram, of the same generators at earlier positions: what has stayed of it is kept.
        exact : bool
            Refuse generators so close together that rounding makes a share of a cell uncertain; see `Cells.tessellate`.
        binned : BinnedPoints, optional
            The generators in bins of the domain, where the caller has them.

        Raises
        ------
        InputError
            If generators are too close to each other to be told apart.
        """
        with self._in_units():
            if self.torus is not None:
                return self.torus.tessellate(points, n, previous, exact, not exact, whole=exact)
            if self._polygon is not None:
                return self._polygon.tessellate(points, n, previous, exact, binned)
            return tessellate_box(self.stages, self.domain, points, n, previous, exact, binned)

    @contextmanager
    def _in_units(self) -> Iterator[None]:
        """Tell of generators that are too close where they are in the domain."""
        try:
            yield
        except CloseError as error:
            raise error.within(self.domain) from None
