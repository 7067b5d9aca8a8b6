"""Chords: the edges of the boundary, cut by the cells of the convex diagram (`boundary_crossings.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ...errors import InputError
from ...geometry.polygon import Polygon
from ...geometry.rings import OrientedRings
from ...opencl.device_array import read_number
from ...opencl.engine import Engine
from ...opencl.primitives import NamedArrays, Scan
from ..device_diagram import Tessellation

LOST, OUTSIDE = 1, 2  # bits of the flags in boundary_crossings.cl
UNTOUCHED = 0x7FFFFFFF
_ROUNDINGS = 4  # distance, in units of round-off, at which a vertex is surely off a face; ON_FACE in the kernels


class BoundaryError(InputError):
    """With round-off the boundary cannot be traced through the cells, or leaves cells along it open."""

    def __init__(self) -> None:
        super().__init__(
            "the boundary of the polygon cannot be traced through the cells: some of its edges, or some generators, "
            "are too close to each other for the precision; use dtype='float64', or a polygon without such slits"
        )


@dataclass(frozen=True)
class Chords:
    """Chords, edge by edge, and their cells, on the device; see tessellation/clipped/boundary.h."""

    count: int
    touched_count: int
    arrays: tuple[cla.Array, ...]
    """The CHORD_ARGS of kernels."""
    slots: cla.Array
    """(n,) int32. Number of each cell among those that the boundary crosses, `UNTOUCHED` for the others."""
    touched: cla.Array
    """(t,) int32. The cells that the boundary crosses."""
    list_starts: cla.Array
    """(t + 1,) int32."""
    listed: cla.Array
    """(count,) int32. The chords of each of these cells, in order."""
    tangents: cla.Array
    """(edges, 2) real. Unit vectors along the edges."""
    turns: tuple[cla.Array, ...]
    """The edge before each edge, and the turning angle between them; see tessellation/clipped/wall_sides.h."""
    shift: np.ndarray
    """(2,) float. Shift of the boundary in normalized coordinates."""
    rings: OrientedRings
    """The boundary, in the domain's unit of length."""


def order_defines(engine: Engine) -> dict[str, object]:
    """Return the macros for building kernels that must not depend on the numbers of generators, if parts share them."""
    return {"BY_PLACE": 1} if engine.peers.shared else {}


def inward_vectors(domain: Polygon, real: np.dtype) -> np.ndarray:
    """Return vectors (k, 2) from the vertices of `domain` inwards, between the edges, a few units of round-off long."""
    vertices, following = domain.oriented.vertices, domain.oriented.next_vertex
    ahead = vertices[following] - vertices
    ahead /= np.hypot(*ahead.T)[:, None]
    before = np.empty_like(ahead)
    before[following] = ahead
    across = before + ahead
    # The mean of the left normals, or, at corners so sharp that these cancel, the direction along the corner.
    along = ahead - before
    turn = before[:, 0] * ahead[:, 1] - before[:, 1] * ahead[:, 0]
    sharp = np.hypot(*across.T) < np.hypot(*along.T)
    way = np.where(
        sharp[:, None], np.where(turn > 0, 1, -1)[:, None] * along, np.column_stack([-across[:, 1], across[:, 0]])
    )
    return _ROUNDINGS * float(np.finfo(real).eps) * way / np.hypot(*way.T)[:, None]


def outer_ring_edges(domain: Polygon) -> np.ndarray:
    """Return for each edge of `domain` an edge of the outer ring of its piece, (k,); -1 on that ring itself."""
    first = np.searchsorted(domain.piece_of_ring, domain.piece_of_ring)  # outer rings come first
    found = np.where(first == np.arange(len(first)), -1, domain.oriented.ring_starts[first])
    return np.repeat(found, np.diff(domain.oriented.ring_starts))


class Boundary:
    """Cut the boundary of one domain into chords."""

    def __init__(self, engine: Engine, domain: Polygon) -> None:
        self.engine = engine
        # Counts change little between steps.
        self._scan, self._room = Scan(engine), NamedArrays(engine, spare=1 / 16)
        self._kernels = engine.kernels("tessellation/clipped/boundary_crossings", order_defines(engine))
        origin, scale = domain.frame
        self._rings = oriented = domain.oriented
        self.edges = len(oriented.vertices)
        vertices = (oriented.vertices - origin) / scale
        inner = vertices + inward_vectors(domain, engine.real)
        # Rings that share a vertex start in the same cell.
        same = np.unique(oriented.vertices, axis=0, return_index=True, return_inverse=True)
        self._places = vertices, inner[same[1]][same[2].ravel()]
        self.vertices, self.inner = (engine.upload(places) for places in self._places)
        self.next_vertex = engine.upload(oriented.next_vertex, np.int32)
        self.shells = engine.upload(outer_ring_edges(domain), np.int32)
        self.tangents = engine.upload(oriented.along / oriented.lengths[:, None])
        before = oriented.before.copy()
        before[oriented.sharpest] = -1 - before[oriented.sharpest]
        self.turns = engine.upload(before, np.int32), engine.upload(oriented.turns)
        self.owners = engine.zeros(self.edges, np.int32)
        self.owner_sites = engine.empty((self.edges, 2))
        self._known = 0  # number of cells when `owners` was computed
        # Flags of kernels, and the number of chords: the host reads both at once.
        self._flags = engine.empty(2, np.int32)

    def cut(self, t: Tessellation, generators: int, shift: tuple[float, float] = (0, 0)) -> Chords | np.ndarray:
        """Trace all edges, shifted by `shift` (normalized coordinates), through the cells of `t`.

        The first `generators` generators of `t` lie in the domain, the others are ghost generators. If the boundary
        crosses cells of ghost generators, the indices of these are returned, (i,) int, counted from `generators` on.

        Raises `BoundaryError` if round-off stops the tracing of an edge.
        """
        engine, k, room, edges = self.engine, self._kernels, self._room, self.edges
        vertices, inner = self.vertices, self.inner
        if any(shift):
            vertices, inner = (engine.upload(places + shift) for places in self._places)
        graph = (*t.graph, t.sites)
        if t.n < self._known:
            self.owners.fill(0)
        self._known = t.n
        found = self.owners, self.owner_sites
        engine.run_each(k.find_boundary_owners, edges, inner, *graph, t.offsets, *found)
        firsts = room("firsts", size=edges + 1, dtype=np.int32)
        intruders = room.zeros("intruders", size=max(1, t.n - generators), dtype=np.int32)
        self._flags.fill(0)
        none = np.int32(0), firsts, firsts, firsts, vertices
        walk = (np.int32(generators), vertices, self.next_vertex, *found, *graph)
        engine.run_each(k.walk_edges, edges, *walk, *none, intruders, self._flags)
        self._scan.exclusive(firsts, firsts, edges, total=(self._flags, 1))
        flags, count = self._flags.get().tolist()
        if flags & OUTSIDE:
            return np.flatnonzero(intruders.get())
        if flags & LOST:
            raise BoundaryError
        cells, of_edges = (room(name, size=count, dtype=np.int32) for name in ("cells", "of_edges"))
        ends = room("ends", size=count)
        engine.run_each(k.walk_edges, edges, *walk, np.int32(1), firsts, cells, of_edges, ends, intruders, self._flags)
        arrays = (vertices, self.next_vertex, self.owners, firsts, cells, of_edges, ends, self.shells, self.owner_sites)
        return self._sort(count, arrays, cells, t.n, np.array(shift, float))

    def _sort(self, count: int, arrays: tuple[cla.Array, ...], cells: cla.Array, n: int, shift: np.ndarray) -> Chords:
        """List the crossed cells, and the chords of each."""
        engine, k, room = self.engine, self._kernels, self._room
        slots = room("slots", size=n, dtype=np.int32).fill(UNTOUCHED)
        ranks = room("ranks", size=count + 1, dtype=np.int32)
        engine.run_each(k.find_firsts, count, cells, slots)
        engine.run_each(k.flag_firsts, count, cells, slots, ranks)
        self._scan.exclusive(ranks, ranks, count)
        touched_count = int(read_number(ranks, count))
        touched = room("touched", size=touched_count, dtype=np.int32)
        starts = room("starts", size=touched_count + 1, dtype=np.int32)
        listed = room("listed", size=count, dtype=np.int32)
        engine.run_each(k.list_touched, count, cells, ranks, touched)
        engine.run_each(k.number_touched, touched_count, touched, slots, starts)
        engine.run_each(k.count_chords, count, cells, slots, ranks, starts)
        self._scan.exclusive(starts, starts, touched_count)
        engine.run_each(k.place_chords, count, cells, slots, ranks, starts, listed)
        engine.run_each(k.sort_chords, touched_count, starts, listed)
        return Chords(
            count, touched_count, arrays, slots, touched, starts, listed, self.tangents, self.turns, shift, self._rings
        )
