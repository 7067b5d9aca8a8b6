"""From generators to the diagram of a domain: ``extend -> bins -> build or update -> finish``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import Domain
from .bins import BinnedPoints
from .clipped.cut import Cut
from .device_diagram import CloseError, Follow, NeighborRows, Tessellation, read_report
from .part import Part
from .part_steps import PartSteps
from .periodic.images import Images
from .power import Rings
from .stages import TessellationStages
from .steps import DomainSteps, SolidWalls, Sort


class Tessellator:
    """Tessellate one domain repeatedly, by generators without or with weights.

    Each call overwrites the `Tessellation` of the call before. Its graph stays valid until the new one is complete.

    - `spacing`: where a boundary cuts cells: distance of generators near points (k, 2) of it, (k,); places ghost
      generators.
    - `coarser`: the tessellator of a coarser level of the same domain. Its halo is the first guess in a periodic box.
    - `weighted`: make power diagrams.
    - `straight`: where a boundary cuts cells: measure cells as the mesh for solvers has them; see `Cut`.

    Its attributes:
    - `steps`: what the domain adds to the steps.
    - `rings`: for power diagrams.

    Raises `InputError` if there are no power diagrams in such a domain.
    """

    def __init__(
        self,
        stages: TessellationStages,
        domain: Domain,
        spacing: Callable[[np.ndarray], np.ndarray] | None = None,
        coarser: Tessellator | None = None,
        weighted: bool = False,
        straight: bool = False,
    ) -> None:
        if weighted:
            domain.require_power_diagrams()
        self.domain, self.weighted = domain, weighted
        self.stages = stages.weighted if weighted else stages
        if stages.engine.peers.shared:
            self.stages = self.stages.unfolded
            self.steps: DomainSteps = PartSteps(self.stages, domain, spacing, straight)
        elif any(domain.periodic):
            halo = None if coarser is None else coarser.steps.halo
            self.steps = Images(self.stages, domain, halo)
        elif domain.outline is not None:
            self.steps = Cut(self.stages, domain.outline, spacing, straight)
        elif domain.wall_triangles is not None:
            self.steps = SolidWalls(self.stages, domain, domain.wall_triangles, spacing)
        else:
            self.steps = DomainSteps(self.stages, domain)
        self.rings = Rings(self.stages, domain) if weighted else None

    def tessellate(
        self,
        points: cla.Array,
        n: int,
        previous: Tessellation | None = None,
        exact: bool = False,
        binned: BinnedPoints | None = None,
        follow: Follow = read_report,
        complete: bool = False,
        labels: cla.Array | None = None,
    ) -> Tessellation:
        """Tessellate by the first `n` of `points` (n, d), in normalized coordinates.

        - `previous`: the latest diagram, of the same generators at earlier positions, for an incremental update.
        - `exact`: reject generators so close that round-off makes a share of a cell uncertain; see
          `CellBuilder.tessellate`.
        - `binned`: the generators in bins, if they are known.
        - `follow`: see `Follow`.
        - `complete`: make all that `final` needs: in a periodic box the cells of images as well.
        - `labels` (n,) int32: permanent names of the generators, which parts of a domain need; a new array for other
          generators.
        """

        @cache
        def sort() -> BinnedPoints:
            return self._sorted(Part.alone(points, self.domain, n)) if binned is None else binned

        with self._in_units(points, n):
            if previous is not None and not exact:
                t = self.steps.update(points, n, previous, sort, follow)
                if t is not None:
                    return t
            t = self._build(points, points, n, sort, previous, exact, complete, labels)
        follow(t, None)
        return t

    def tessellate_weighted(
        self,
        points: cla.Array,
        weights: cla.Array,
        n: int,
        exact: bool = False,
        previous: NeighborRows | None = None,
        least: float = 0.0,
        complete: bool = False,
    ) -> Tessellation | None:
        """Return the power diagram of `points` (n, d) with `weights` (n,), in normalized coordinates.

        - `previous`: the graph of a diagram of similar weights, without empty cells: in 2D and float64 cells start from
          its neighbors. Far from its generator a cell is found much sooner than by a search around the generator.
        - `least`: with `previous`: None is returned as soon as a cell is known to be smaller.
        - `exact`, `complete`: as for `tessellate`.
        """
        assert self.rings is not None
        with self._in_units(points, n):
            sites = self.rings.attach(points, weights, n, self.steps.most)
            if previous is not None:
                t, too_small = self.rings.search(self.steps.box, sites, previous, exact, least)
                if too_small:
                    return None
                t = None if t is None else self.steps.finish_updated(t, points, n)
                if t is not None:
                    return replace(t, points=points, sites=sites)
            return self.build(points, sites, n, exact, complete)

    def build(
        self,
        points: cla.Array,
        sites: cla.Array,
        n: int,
        exact: bool = False,
        complete: bool = False,
        labels: cla.Array | None = None,
    ) -> Tessellation:
        """Tessellate from nothing by the first `n` of `sites`: `points`, with their weights in a power diagram."""
        with self._in_units(points, n):
            whole = Part.alone(sites, self.domain, n)
            return self._build(points, sites, n, cache(lambda: self._sorted(whole)), None, exact, complete, labels)

    def tessellate_part(self, part: Part, exact: bool = False, whole: bool = False) -> Tessellation:
        """Return the diagram of a part whose ghosts are given, such as the halo of generators of other parts.

        Cells are right as far as the ghosts surround them. Neighbors are rows of the part. With `whole` ghosts get
        cells as well, for stages that read rows of neighbors.
        """
        with self._in_units(part.points, part.count):
            t = self._cells(part, self._sorted(part), exact, part.count if whole else part.n_own)
        own = t.first(part.n_own) if t.n > part.n_own else t
        return replace(own, part=part, whole=t if t.n == part.count else None)

    def _build(
        self,
        points: cla.Array,
        sites: cla.Array,
        n: int,
        sort: Sort,
        previous: Tessellation | None,
        exact: bool,
        complete: bool,
        labels: cla.Array | None = None,
    ) -> Tessellation:
        steps = self.steps
        rows = None if previous is None or not self.stages.cells.from_previous else steps.rows(previous)
        nearest = not (exact or self.weighted)
        steps.begin(n, complete, labels)
        if sample := steps.sample_size(n):
            self._find_ghosts(points, sites, n, sample, complete)
        enough = False
        while True:
            part = steps.extend(sites, n)
            binned = sort() if part.points is sites else self._sorted(part)
            steps.find_walls(part, binned, previous)
            try:
                whole = steps.builds_all(part, complete, enough)
                start = None if rows is None else steps.unfold(part, rows)
                t = self._cells(part, binned, exact, part.count if whole else n, start)
            except CloseError:
                if not steps.drop_ghosts():
                    raise
                continue
            found = steps.finish(part, t, points, exact, nearest)
            enough = found is not None
            if found is not None and (whole or not complete or found.part is not None):
                return found if found.part is not None else replace(found, points=points, sites=sites)
            # Memory for the new diagram.
            del part, binned, t

    def _find_ghosts(self, points: cla.Array, sites: cla.Array, n: int, sample: int, last: bool) -> None:
        """Find how many ghosts are enough, unless those that are estimated are enough for a sample of the cells.

        The diagram of an eighth of the generators is made first. Where it needs no more ghosts, that of all does not,
        since no ball without generators grows.
        """
        steps, gather = self.steps, self.stages.gather
        order = np.argsort(np.arange(n) % (n // sample), kind="stable")
        items = self.stages.engine.upload(order, np.int32)
        mixed = gather.rows(items, sites)
        part = steps.extend(mixed, n)
        if steps.reaches(part, self._cells(part, self._sorted(part), True, sample)):
            return
        few = n // 8
        places = mixed if points is sites else gather.rows(items, points)
        self._build(places, mixed, few, lambda: self._sorted(Part.alone(mixed, self.domain, few)), None, True, False)
        steps.keep_ghosts(last)

    def _cells(
        self, part: Part, binned: BinnedPoints, exact: bool, rows: int, start: Tessellation | NeighborRows | None = None
    ) -> Tessellation:
        """Build the cells of the first `rows` generators, which may start from the neighbors in `start`."""
        return self.stages.cells.tessellate(part, binned, start, exact, rows)

    def _sorted(self, part: Part) -> BinnedPoints:
        bins = self.stages.bins
        binned = bins.build(part.box, part.points, part.count)
        if not self.stages.cells.from_previous:
            bins.clear_work()
        return binned

    def is_complete(self, t: Tessellation) -> bool:
        """Return whether `final` can take `t`, the latest diagram, as it is."""
        return self.steps.is_complete(t)

    def complete(self, points: cla.Array, sites: cla.Array, n: int, labels: cla.Array | None = None) -> Tessellation:
        """Return the diagram of the first `n` of `points`, with weights in `sites`, made anew for `final`."""
        self.stages.clear_folded_cells()
        return self.build(points, sites, n, exact=self.weighted, complete=True, labels=labels)

    def final(self, t: Tessellation) -> Tessellation:
        """Return `t`, the latest diagram, with faces in full precision and all that its vertices need."""
        if not self.is_complete(t):
            t = self.complete(t.points, t.sites, t.n)
        stages, folded = self.stages, t.folded
        if t.face_measures.dtype == stages.engine.real:
            return t
        if t.part is not None:
            measured = t.part.measure_faces(stages.engine, t.whole or t, stages.cells.defines)
            return replace(
                t, face_measures=measured.face_measures, face_centroids=measured.face_centroids, whole=measured
            )
        if folded is None or folded.whole is None:
            return stages.cells.measure_faces(self.domain, t)
        whole = stages.cells.measure_faces(folded.part.box, folded.whole)
        faces = whole.face_measures, whole.face_centroids
        if folded.places is not None:
            faces = tuple(stages.gather.rows(folded.places, array) for array in faces)
        return replace(t, face_measures=faces[0], face_centroids=faces[1])

    def laplacian_measures(self, t: Tessellation) -> cla.Array:
        """Return the face measures of the power diagram `t` for the matrix of Newton's method.

        See `GhostImages.scale_far_measures` and `Rings.slopes`.
        """
        assert self.rings is not None
        if t.folded is not None:
            return self.stages.ghost_images.scale_far_measures(t, t.folded.codes)
        return self.rings.slopes(t)

    @contextmanager
    def _in_units(self, points: cla.Array, n: int) -> Iterator[None]:
        """Give errors about close generators the positions in the domain."""
        try:
            yield
        except CloseError as error:
            given = CloseError(points, n) if self.weighted else error
            raise given.within(self.domain) from None
