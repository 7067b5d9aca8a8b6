"""The faces of a diagram in 3D as each cell has them by itself (`half_faces.cl`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ...errors import MemoryLimitError
from ...geometry.domain import ClipBox
from ...opencl.engine import Engine
from ...opencl.kernels import Kernels
from ...opencl.primitives import Scan
from ..cut_cells import FACE_CAPACITY, GROWTH, capacity_defines, clip_each
from ..device_diagram import Tessellation

MOST_LOOP_ENTRIES = 2**31 - 1


@dataclass
class HalfFaces:
    """Corners of all cells, and loops of corners around their faces, on the device."""

    corners: cla.Array
    """(c, 3) real. Relative to the generator `owners` (c,) int32."""
    owners: cla.Array
    sharpness: cla.Array
    """(c,) float32. How well its faces determine a corner."""
    corner_faces: cla.Array
    """(c, 3) int32. Labels of the faces that meet there: a generator, or ``-1 - wall``."""
    same: cla.Array
    twin_corners: cla.Array
    """`same`, `twin_corners`: (c,) int32. A corner of the same cell, and one of another cell, at the same vertex."""
    starts: cla.Array
    """(n + 1,) int32. Rows of half-faces: those of the graph in its order, then walls that the graph leaves out."""
    labels: cla.Array
    """(h,) int32. Of half-faces."""
    loop_starts: cla.Array
    """(h + 1,) int32."""
    loops: cla.Array
    """(3 c,) int32. Corners, counter-clockwise from outside."""


def _kernels(engine: Engine, capacity: int) -> Kernels:
    return engine.kernels("tessellation/topology3d/half_faces", capacity_defines(engine, capacity))


def list_half_faces(engine: Engine, box: ClipBox, t: Tessellation) -> HalfFaces:
    """Clip each cell of `t` by its neighbors, and return its faces.

    Raises `MemoryLimitError` if the corners are too many for 32-bit indices.
    """
    n, scan = t.n, Scan(engine)
    corner_starts, starts = engine.empty(n + 1, np.int32), engine.empty(n + 1, np.int32)
    cell = (t.sites, *box.clip_args(engine), *t.graph)
    capacities, full = engine.zeros(n, np.int32), engine.zeros(1, np.int32)
    counts, used = (capacities, corner_starts, starts, full), [FACE_CAPACITY]
    while True:
        k = _kernels(engine, used[-1])
        clip_each(engine, k.count_corners, used[-1], n, (*cell, *counts))
        if not int(full[0].get()):
            break
        used.append(GROWTH * used[-1])
        full.fill(0)
    scan.exclusive(corner_starts, corner_starts, n)
    scan.exclusive(starts, starts, n)
    c, h = int(corner_starts[n].get()), int(starts[n].get())
    if not 0 < c <= MOST_LOOP_ENTRIES // 3:
        raise MemoryLimitError(f"{n} cells have more vertices than 32-bit indices can tell apart; use fewer cells")
    owners, same, twin_corners = (engine.empty(c, np.int32) for _ in range(3))
    corners, sharpness = engine.empty((c, 3)), engine.empty(c, np.float32)
    corner_faces, loops = engine.empty((c, 3), np.int32), engine.empty(3 * c, np.int32)
    labels, loop_starts = engine.empty(h, np.int32), engine.empty(h + 1, np.int32)
    of_corners = corners, sharpness, corner_faces, owners, same
    lists = capacities, corner_starts, starts, *of_corners, labels, loop_starts, loops
    for capacity in used:
        kernel = _kernels(engine, capacity).list_corners
        clip_each(engine, kernel, capacity, n, (*cell, *lists))
    engine.run_each(k.match_corners, c, np.int32(n), owners, corner_starts, corner_faces, twin_corners)
    return HalfFaces(corners, owners, sharpness, corner_faces, same, twin_corners, starts, labels, loop_starts, loops)
