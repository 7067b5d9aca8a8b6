"""Pairs of generators on both sides of walls that are thinner than a cell (`thin_walls.cl`)."""

from __future__ import annotations

import numpy as np
import pyopencl.array as cla

from ..connectivity import rows_and_places
from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from ..opencl.engine import Engine
from ..tessellation.device_diagram import Tessellation
from .motion import Moving
from .tuning import DEPTHS, MOST_SAMPLES


def has_thin_walls(domain: Polygon, h: np.ndarray) -> bool:
    """Return whether walls of `domain` are thin for cells of size `h` (k,) at its vertices.

    Samples along the edges are half a cell apart, at most `MOST_SAMPLES` on an edge.
    """
    oriented = domain.oriented
    begin, edge, length = oriented.vertices, oriented.along, oriented.lengths
    least = np.minimum(h, h[oriented.next_vertex])
    counts = np.ceil(length / (0.5 * least)).clip(1, MOST_SAMPLES).astype(int)
    rows, place = rows_and_places(counts)
    share = ((place + 0.5) / counts[rows])[:, None]
    at = begin[rows] + share * edge[rows]
    outward = np.column_stack([edge[:, 1], -edge[:, 0]])[rows] * (least / length)[rows, None]
    return any(domain.contains(at + depth * outward).any() for depth in DEPTHS)


class ThinWalls:
    """The kernels of `thin_walls.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/thin_walls", {"THIN": DEPTHS[-1]})

    def pair(self, free: Domain, t: Tessellation, h: cla.Array, moving: Moving) -> None:
        """Move generators on both sides of thin walls to be mirror images of each other.

        - `free`: the part of the polygon without layers, in its frame. Generators do not leave it.
        - `t`: diagram of the same generators before their last displacement.
        - `h`: (n,) real
        """
        engine, k = self.engine, self._kernels
        assert t.trimmed is not None
        chords, convex = t.trimmed.chords, t.trimmed.convex
        u, n, whole = chords.touched_count, np.int32(t.rows), t.whole or t
        with engine.workspace.frame():
            partners, targets = engine.scratch(u, np.int32), engine.scratch((2 * u, 2))
            points, h = t.with_ghosts(engine, moving.points, h)
            labels = t.fixed_args(engine, moving.labels, moving.fixed)
            graph = convex.graph
            args = points, h, *labels, *free.device_args(engine)
            engine.run_each(k.find_partners, u, chords.touched, n, *graph, *whole.graph, *args, partners)
            engine.run_each(k.place_pairs, u, chords.touched, n, chords.slots, partners, *graph, *args, targets)
            given = chords.slots, partners, targets, moving.points, moving.velocity
            engine.run_each(k.move_pairs, u, chords.touched, np.int32(t.n), *given)
