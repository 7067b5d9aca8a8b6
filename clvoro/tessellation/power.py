"""Power diagrams (Laguerre diagrams): Voronoi diagrams of generators with weights, the paper's (2.5).

V_i = { y : |y - x_i|^2 - w_i <= |y - x_j|^2 - w_j for all j } (Aurenhammer 1987, SIAM J. Comput. 16, 78). The kernels
are those of Voronoi diagrams, built with WEIGHTED (see geometry/weights.h).
"""

from __future__ import annotations

from dataclasses import replace

import pyopencl.array as cla

from ..errors import InputError
from ..geometry.box import Box, Domain
from .device_diagram import CloseError, Tessellation
from .polyhedra import Polyhedra
from .stages import TessellationStages


def require_power_domain(domain: Domain) -> None:
    """Raise InputError if there are no power diagrams in such a domain."""
    if not isinstance(domain, Box) or any(domain.periodic):
        raise InputError(
            f"the domain is {domain}, expected a box with walls: there are no power diagrams in other domains"
        )


class PowerTessellator:
    """Tessellate one domain by generators with weights, repeatedly.

    Each call overwrites the `Tessellation` of the call before.

    Raises
    ------
    InputError
        If there are no power diagrams in such a domain.
    """

    def __init__(self, stages: TessellationStages, domain: Domain) -> None:
        require_power_domain(domain)
        self.stages, self.domain = stages.weighted, domain
        self._kernels = self.stages.engine.kernels("tessellation/power")

    def tessellate(
        self, points: cla.Array, weights: cla.Array, n: int, exact: bool = False
    ) -> Tessellation:
        """Return the power diagram of `points` (n, d) with `weights` (n,), in normalized coordinates.

        Raises
        ------
        InputError
            If generators are too close to each other to be distinguished.
        """
        stages, engine = self.stages, self.stages.engine
        weighted = engine.empty((n, engine.site_size))
        engine.run_each(self._kernels.attach_weights, n, points, weights, weighted)
        try:
            binned = stages.bins.build(self.domain, weighted, n)
            t = stages.cells.tessellate(self.domain, weighted, n, binned, exact=exact)
        except CloseError:
            raise CloseError(points, n).within(self.domain) from None
        return replace(t, points=points, weighted=weighted)

    def final(self, t: Tessellation) -> Tessellation:
        """Return `t`, the latest diagram, with faces in full precision."""
        cells = self.stages.cells
        return t if isinstance(cells, Polyhedra) else cells.measure_faces(self.domain, t)
