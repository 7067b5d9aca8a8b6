"""Read the diagram of a part, with walls towards the other parts, and gather the diagram of the whole domain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import pyopencl.array as cla

from ...connectivity import starts_of
from ...errors import InputError
from ...geometry.box import Box
from ...geometry.domain import Domain
from ...mesh.diagram import Diagram
from ...mesh.read_only import read_only
from ...mesh.subset import take_subset
from ...opencl.engine import Engine
from ...opencl.peers import ALONE, Peers
from ...opencl.probe import check_process
from ..device_diagram import Tessellation
from ..stages import TessellationStages
from ..tessellator import Tessellator
from .diagram import fetch_diagram, order_of


def fetch_part(engine: Engine, domain: Domain, t: Tessellation, labels: cla.Array) -> LaterDiagram:
    """Return the cells of a part in the order of `labels` (n,). Faces towards cells of part k are walls ``"rankK"``."""
    assert t.part is not None
    (n, part, whole), own = (t.n, t.part, t.whole), labels.get()[: t.n]
    points = fetch_diagram(engine, unfolded(domain), replace(t, part=None), labels, copy=False).points
    names = np.array([f"rank{number}" for number in part.ghosts.parts] if part.ghosts else [], object)
    ghosts = np.arange(n, part.count)
    beside = np.isin(ghosts, t.neighbors.get()[: int(t.starts[n].get())]) if whole is None else ghosts >= n

    rows = cache(lambda: CellRows.of(t, labels))

    def read_all() -> Diagram:
        gathered = rows().gather(ALONE)
        assert gathered is not None
        return gathered.diagram(engine, domain)

    def read_with(beside: np.ndarray) -> Diagram:
        """Cells share vertices with those of the ghosts `beside` them, (g,) bool."""
        order = np.concatenate([np.arange(n), ghosts[beside], ghosts[~beside]])
        made, count = whole, n + np.count_nonzero(beside)
        there = part if whole is not None else part.in_order(engine, order)
        if made is None:
            stages = TessellationStages(engine)
            binned = stages.bins.build(there.box, there.points, there.count)
            made = replace(stages.cells.tessellate(there, binned, exact=False, rows=count), vertices=())
            del binned
            stages.release()
        places, boundary = np.arange(count, dtype=np.int32), np.full(count, "", object)
        places[order_of(own)], boundary[n:] = np.arange(n), names[beside]
        made, numbers = replace(made, part=there), engine.upload(places, np.int32)
        diagram = fetch_diagram(engine, unfolded(domain), made, numbers, copy=False)
        del made
        return take_subset(diagram, np.arange(count) < n, boundary)

    def read() -> Diagram:
        try:
            return read_with(beside)
        except InputError:
            # Where round-off may have spoiled cells, those of all ghosts fill the domain.
            return read_with(ghosts >= n)

    if (part.peers or ALONE).count > 1:
        return LaterDiagram(points, rows, read)
    found = LaterDiagram(points, rows, read_all)
    found.domain = domain
    return found


class LaterDiagram(Diagram):
    """The diagram of a part. All arrays but its points are read from the device when one of them is first used.

    `rows` returns its cells as `CellRows`. They are read at the latest with these arrays.
    """

    def __init__(self, points: np.ndarray, rows: Callable[[], CellRows], read: Callable[[], Diagram]) -> None:
        self.points, self.rows, self._read = points, rows, read
        self._derived, self.home = {}, None
        self.layer = self._derive("layer")  # parts have no layers

    @cached_property
    def _made(self) -> Diagram:
        check_process()
        self.rows()  # so that the device's arrays are free then
        made = self._read()
        made.put_points(self.points)
        del self._read
        return made

    def put_points(self, points: np.ndarray) -> None:
        """Replace the points, without reading the others."""
        self.points = read_only(points)

    @cached_property
    def domain(self) -> Domain:
        """The domain of these cells."""
        return self._made.domain

    @cached_property
    def _arrays(self) -> dict[str, Any]:
        return self._made._arrays


def unfolded(domain: Domain) -> Domain:
    """Return a domain with the generators of a part of `domain` and their ghosts: without periods, but larger."""
    if not any(domain.periodic):
        return domain
    room = np.where(domain.periodic, domain.extent, 0)
    names = {name: np.flatnonzero(domain.boundary_index == k) for k, name in enumerate(domain.boundary_names)}
    found = Box(tuple(domain.lower - room), tuple(domain.upper + room), names=names)
    object.__setattr__(found, "framed_by", domain)
    return found


SINGLE = Peers()
"""The only part of a mesh. Its kernels order generators by position, as those of several parts do."""
SINGLE.shared = True


@dataclass(frozen=True)
class CellRows:
    """The cells of a part on the host, as the device has them; neighbors are labels.

    - `labels`: (n,) int32
    - `counts` (n,) int32: number of faces.
    - `cells` tuple of (n, ...) arrays: points, volumes, offsets and covariances.
    - `faces` tuple of (m, ...) arrays: labels of neighbors, walls being negative; measures and centroids.
    - `round_off`: int
    """

    labels: np.ndarray
    counts: np.ndarray
    cells: tuple[np.ndarray, ...]
    faces: tuple[np.ndarray, ...]
    round_off: int

    @classmethod
    def of(cls, t: Tessellation, labels: cla.Array) -> CellRows:
        """Return the cells of `t`, the diagram of a part whose generators have `labels` (n,)."""
        own, starts, n = labels.get()[: t.n], t.starts.get(), t.n
        assert t.part is not None
        assert t.part.labels is not None
        names = t.part.labels.get()
        rows = t.neighbors.get()[: starts[n]]
        faces = (
            np.where(rows < 0, rows, names[np.maximum(rows, 0)]),
            *(array.get()[: starts[n]] for array in (t.face_measures, t.face_centroids)),
        )
        cells = tuple(array.get()[:n] for array in (t.points, t.volumes, t.offsets, t.covariances))
        return cls(own, np.diff(starts).astype(np.int32), cells, faces, t.round_off)

    def gather(self, peers: Peers) -> CellRows | None:
        """Return the cells of all parts on part 0, in the order of labels; None on the others."""
        given = self.labels, self.counts, *self.cells, *self.faces
        found = [peers.collect(array) for array in given]
        round_off = np.bitwise_or.reduce(peers.gather(np.array(self.round_off)))
        if peers.number:
            return None
        labels, counts, *rest = (np.concatenate(arrays) for arrays in found)
        order, starts = np.argsort(labels, kind="stable"), starts_of(counts)
        counts = counts[order]
        places = np.repeat(starts[:-1][order] - starts_of(counts)[:-1], counts) + np.arange(counts.sum())
        cells = tuple(array[order] for array in rest[: len(self.cells)])
        faces = tuple(array[places] for array in rest[len(self.cells) :])
        return CellRows(labels[order], counts, cells, faces, int(round_off))

    def diagram(self, engine: Engine, domain: Domain) -> Diagram:
        """Return the diagram of these cells, if they are all of the domain, in the order of labels.

        In a periodic box it is made anew, since vertices are those of cells on both sides of a seam, and in a polygon,
        since they are numbered by convex cells.
        """
        if any(domain.periodic) or domain.cuts_cells:
            engine = engine.replaced(traits=domain.traits(engine.real))
            if domain.cuts_cells:
                engine.peers = SINGLE  # the same bits as in parts
            points, tessellator = engine.upload(self.cells[0]), Tessellator(TessellationStages(engine), domain)
            labels = engine.upload(np.arange(len(points)), np.int32)
            t = tessellator.tessellate(points, len(points), exact=True, complete=True, labels=labels)
            return fetch_diagram(engine, domain, tessellator.final(t), labels)
        neighbors, measures, centroids = self.faces
        rows = np.where(neighbors < 0, neighbors, np.searchsorted(self.labels, neighbors))
        points, volumes, offsets, covariances = (engine.upload(array, array.dtype) for array in self.cells)
        t = Tessellation(
            len(self.labels),
            points,
            engine.upload(starts_of(self.counts), np.int32),
            engine.upload(rows, np.int32),
            engine.upload(measures, measures.dtype),
            engine.upload(centroids, centroids.dtype),
            volumes,
            offsets,
            covariances,
            round_off=self.round_off,
        )
        return fetch_diagram(engine, domain, t, engine.upload(np.arange(t.n), np.int32), copy=False)
