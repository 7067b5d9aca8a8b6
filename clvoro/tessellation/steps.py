"""What a domain adds to the steps of a tessellator, ``extend -> bins -> build or update -> finish``.

`DomainSteps` is what boxes with walls and spheres need: nothing. `SolidWalls` finds the walls of solids, `Images` in
`periodic/images.py` makes ghost images and folds diagrams, `Cut` in `clipped/cut.py` lets a boundary cut them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import pyopencl.array as cla

from ..arguments import format_point, warn
from ..errors import MismatchWarning
from ..geometry.domain import ClipBox, Domain
from ..geometry.wall_triangles import WallTriangles
from .bins import BinnedPoints
from .cut_cells import CutCells
from .device_diagram import Follow, NeighborRows, Tessellation, domain_position
from .own_planes import SIDES_OF_BOX, SolidBox
from .part import Part
from .periodic.halo import Halo
from .polyhedra import Polyhedra
from .stages import TessellationStages

LATER_FROM = 10_000
"""Least number of cells from which the cells of images wait until the halo is known, if most cells are images."""
Sort: TypeAlias = Callable[[], BinnedPoints]
"""Returns the generators in bins, and sorts them when it is first called."""


class DomainSteps:
    """The steps before and after cells are built, for one domain.

    - `box`: clips the cells of a finished diagram.
    - `most` (1,) int32, device: key of the largest weight, in a power diagram; see geometry/weights.h.
    - `halo`: in a periodic box.
    """

    box: ClipBox
    halo: Halo | None = None

    def __init__(self, stages: TessellationStages, domain: Domain) -> None:
        self.stages, self.domain, self.box = stages, domain, domain
        self.most = stages.engine.empty(1, np.int32)

    def begin(self, n: int, last: bool = False, labels: cla.Array | None = None) -> None:
        """Prepare for a new diagram of `n` generators, the `last` one of a run.

        In a part of a domain they have `labels` (n,). Other generators have another array.
        """

    def extend(self, sites: cla.Array, n: int) -> Part:
        """Return the part of the first `n` of `sites` and the ghosts that their cells need, as far as known."""
        return Part.alone(sites, self.box, n)

    def sample_size(self, n: int) -> int:
        """Return how many cells of `n` to build first, to see which ghosts are needed; 0 if they are known."""
        return 0

    def reaches(self, part: Part, t: Tessellation) -> bool:
        """Return whether `part` has the ghosts that the cells of `t` need, a sample."""
        return True

    def keep_ghosts(self, last: bool) -> None:
        """Take ghosts as the latest diagram, of fewer generators, needs them, in place of what `begin` estimates."""

    def drop_ghosts(self) -> bool:
        """Make ghosts fewer, because generators appear too close; return whether that is possible."""
        return False

    def find_walls(self, part: Part, binned: BinnedPoints, previous: Tessellation | None) -> None:
        """Find what bounds the new cells of `part` besides its box. `previous` has the same generators."""

    def builds_all(self, part: Part, complete: bool, enough: bool) -> bool:
        """Return whether ghosts of `part` get cells, too. Ghosts without values always do: something cuts their cells.

        - `complete`: whether the diagram must be complete, with the cells of images.
        - `enough`: whether no ghosts are missing. As long as some may be, cells of many images are not built.
        """
        return part.ghosts is None or (complete and (enough or part.count < max(2 * part.n_own, LATER_FROM)))

    def rows(self, previous: Tessellation) -> Tessellation | NeighborRows | None:
        """Return the graph from which new cells may start, as long as they are built, if there is one."""
        return previous

    def unfold(self, part: Part, rows: Tessellation | NeighborRows) -> Tessellation | NeighborRows:
        """Return `rows` with neighbors that are rows of `part`."""
        return rows

    def finish(self, part: Part, t: Tessellation, points: cla.Array, exact: bool, nearest: bool) -> Tessellation | None:
        """Return the diagram of the domain from `t`, that of `part`; None if other ghosts are needed.

        - `points` (n, d) real: positions of the generators.
        - `exact`: as for `CellBuilder.tessellate`.
        - `nearest`: in a periodic box, reject neighbors that are not the nearest image of their generator.
        """
        return self.finish_updated(t, points, part.n_own)

    def finish_updated(self, t: Tessellation, points: cla.Array, n: int) -> Tessellation | None:
        """Do the same for a diagram whose neighbors are generators already."""
        return t

    def is_complete(self, t: Tessellation) -> bool:
        """Return whether the latest diagram `t` has all that its vertices need."""
        return True

    def measure_exactly(self, t: Tessellation) -> Tessellation:
        """Return the latest diagram `t` with the measures of its cells in the domain, if a run measures others."""
        return t

    def volumes_of_mesh(self, t: Tessellation, labels: cla.Array) -> np.ndarray | None:
        """Return the volumes of cells in the final mesh, (n,) by `labels`; None if they are those of `t`."""

    def warn_of_leaks(self, t: Tessellation) -> None:
        """Warn of cells of the final diagram `t` that the walls do not bound."""

    def update(
        self, sites: cla.Array, n: int, previous: Tessellation, sort: Sort, follow: Follow
    ) -> Tessellation | None:
        """Update `previous` incrementally to the first `n` of `sites`; None if too much has changed."""

        def clip(cells: Polyhedra, cut: CutCells, report: cla.Array, _: int) -> None:
            cells.clip_rest(cut, report, Part.alone(sites, self.box, n), sort(), previous)

        return self.stages.update.update(self.stages.cells, self.box, sites, previous, follow=follow, clip=clip)


class SolidWalls(DomainSteps):
    """The steps in a solid: cells are cut by planes of their own.

    - `size`: see `SolidBox`.
    """

    def __init__(
        self,
        stages: TessellationStages,
        domain: Domain,
        walls: WallTriangles,
        size: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        super().__init__(stages, domain)
        self.box = self.walls = SolidBox(stages.engine, domain, walls, size)

    def find_walls(self, part: Part, binned: BinnedPoints, previous: Tessellation | None) -> None:
        """Find the planes that cut the cells of `part`."""
        if previous is None:
            self.walls.guess(binned, part.n_own)
        self.walls.find(part.points)

    def volumes_of_mesh(self, t: Tessellation, labels: cla.Array) -> np.ndarray:
        """Return the volumes of cells in the mesh that ends at the surface, 0 for generators without a cell there."""
        from .readback.solid import mesh_volumes

        return mesh_volumes(self.stages.engine.alone(), self.domain, t, labels)

    def warn_of_leaks(self, t: Tessellation) -> None:
        """Warn of cells that reach the box around the solid, and of generators outside of their nearest patch."""
        starts = t.starts.get()
        faces = np.flatnonzero(t.neighbors[: int(starts[t.n])].get() < SIDES_OF_BOX)
        outside = self.walls.outside
        if not len(faces) and not outside:
            return
        open_cells = np.unique(np.searchsorted(starts, faces, side="right") - 1)
        where = ""
        if len(open_cells):
            where = f", the first at {format_point(domain_position(self.domain, t.points[int(open_cells[0])].get()))}"
        warn(
            f"cells that the walls do not bound: {len(open_cells)}{where}; generators behind the nearest wall: "
            f"{outside}. The solid is narrow or sharp for the size of cells there; use smaller sizes",
            MismatchWarning,
        )

    def update(
        self, sites: cla.Array, n: int, previous: Tessellation, sort: Sort, follow: Follow
    ) -> Tessellation | None:
        """Update `previous` incrementally."""
        self.walls.follow(sites)
        return super().update(sites, n, previous, sort, follow)
