"""Walls of polygonal domains: faces end in re-entrant corners, and generators are paired across thin walls."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..opencl.device_array import buffer_of
from .corners import PlacedCorners, find_corners
from .motion import Moving
from .thin_walls import has_thin_walls
from .tuning import SETTLING

if TYPE_CHECKING:
    from .state import MeshState, Setup


class Walls:
    """Re-entrant corners and thin walls of a domain, for the cells of one level.

    Parameters
    ----------
    setup : Setup
    size_factor : float
        Factor on the size field.

    Attributes
    ----------
    corners : PlacedCorners or None
        Re-entrant corners in which faces have to end; None if there are none. Then walls change nothing.
    thin : bool
        Whether walls between corners are thinner than a cell.
    free : Domain
        The part of the domain without layers; generators do not leave it.
    """

    def __init__(self, setup: Setup, size_factor: float) -> None:
        self.corners: PlacedCorners | None = None
        self.thin = False
        self.free = setup.free
        domain = setup.domain.outline
        if domain is None:
            return
        # `normalize_sizes` changes the factor by little: all of a level, also resumed, has the same corners.
        level = round(math.log2(size_factor / setup.factor))
        h = 2.0**level * setup.factor * setup.own_factor * np.asarray(setup.sizing(domain.oriented.vertices), float)
        around = None if level or setup.around is None else setup.around.corners
        groups = find_corners(domain, h, setup.free.outline, around)
        if len(groups):
            self.corners = PlacedCorners(setup.stages.engine, domain, groups)
        self.thin = self.corners is not None and has_thin_walls(domain, h)

    def adjust(self, mesh: MeshState) -> None:
        """Pair generators across thin walls, and let faces end in corners. The diagram is then out of date."""
        if self.corners is None:
            return
        if self.thin:
            mesh.stages.thin_walls.pair(self.free, mesh.t, mesh.h, mesh.moving)
        mesh.stages.corners.share(self.corners, self.free, mesh.t, mesh.moving)

    def settle(self, mesh: MeshState) -> None:
        """Let faces end in corners without another step, and update the mesh."""
        for _ in range(SETTLING if self.corners is not None else 0):
            self.adjust(mesh)
            mesh.update()

    def constrain(self, mesh: MeshState, displacement: cla.Array) -> None:
        """Change `displacement` (n, d) so that faces end in corners after it."""
        if self.corners is None:
            return
        engine = mesh.engine
        with engine.workspace.frame():
            ahead = engine.scratch(mesh.points.shape)
            cl.enqueue_copy(engine.queue, buffer_of(ahead), buffer_of(mesh.points), byte_count=ahead.nbytes)
            mesh.stages.motion.add_momentum(1.0, ahead, displacement, 1.0)
            moving = Moving(ahead, displacement, mesh.labels, mesh.fixed)
            mesh.stages.corners.share(self.corners, self.free, mesh.t, moving)
