"""Cells in 3D that are clipped independently of each other: capacities, memory, and their arrays."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from ..opencl.engine import Engine
from .device_diagram import Tessellation
from .report import NARROW, UNEVEN

FACE_CAPACITY = 32
"""Most faces of a cell while it is clipped in private memory."""
KNOWN_CORNERS, UNSURE_CORNERS = 2, 3
"""States of the triples of a cell (tessellation/row_counts.h)."""
GROWTH, MOST_FACES = 4, 512
"""Factor to the next capacity for cells with more, and the largest one."""
MOST_NUMBERED = 256
"""Most faces of a cell whose vertices are triples of faces (tessellation/row_counts.h)."""
LEAST_SPACE, SPACE_PER_CELL, MOST_SPACE = 2**20, 64, 2**26
"""Bytes of global memory for cells with more than `FACE_CAPACITY` faces while they are clipped, a few at a time."""


def clipping_space(n: float) -> float:
    """Return the most bytes that cells with many faces take in global memory while `n` cells are clipped."""
    return min(max(LEAST_SPACE, SPACE_PER_CELL * n), MOST_SPACE)


def cell_bytes(capacity: int, real: np.dtype) -> int:
    """Return an upper bound of the size of `cell_t` (polyhedron.h), which the kernels check."""
    index = 1 if 3 * capacity <= 256 else 2
    return capacity * (16 * real.itemsize + 29 * index + 5) + 320


def capacity_defines(engine: Engine, capacity: int) -> dict[str, object]:
    """Return the defines of kernels that clip cells of up to `capacity` faces."""
    defines: dict[str, object] = {"FACE_CAPACITY": capacity}
    if capacity > FACE_CAPACITY:
        defines["CELL_BYTES"] = cell_bytes(capacity, engine.real)
    return defines


def clip_each(
    engine: Engine,
    kernel: cl.Kernel,
    capacity: int,
    size: int,
    args: tuple[object, ...],
    more_args: tuple[object, ...] = (),
) -> None:
    """Enqueue `kernel`, which clips `size` cells of up to `capacity` faces.

    Its arguments are `size`, `args` and `more_args`. Cells with more than `FACE_CAPACITY` faces are clipped in global
    memory, which it takes after `args`, by one work-item for each cell that fits there.
    """
    if capacity <= FACE_CAPACITY:
        engine.run_each(kernel, size, *args, *more_args)
        return
    bytes_ = cell_bytes(capacity, engine.real)
    count = min(size, int(clipping_space(size)) // bytes_)
    with engine.workspace.frame():
        memory = engine.scratch(count * bytes_, np.uint8)
        more_args = (memory, np.int32(count), *more_args)
        engine.run(kernel, count, np.int32(size), *args, *more_args, group=1)


@dataclass(frozen=True)
class CutCells:
    """Cells clipped independently of each other, on the device; see `clip_polyhedra` in `polyhedra.cl`."""

    places: cla.Array
    counts: cla.Array
    """`places`, `counts`: (n,) int32. First entry of each cell in the arrays of faces, and number of its faces."""
    labels: cla.Array
    measures: cla.Array
    centroids: cla.Array
    """`labels`, `measures`, `centroids`: arrays of `m` half-faces."""
    cells: dict[str, cla.Array]
    """Volumes, offsets and covariances."""
    m: int
    corners: cla.Array | None = None
    keys: cla.Array | None = None
    """`corners`, `keys`: triples of faces and keys; see `Tessellation.vertices`."""
    state: int = KNOWN_CORNERS
    """The state of triples that is written besides those of clear cells (tessellation/row_counts.h)."""

    def output(self, report: cla.Array) -> tuple[object, ...]:
        """Return the CELL_OUTPUT_ARGS of kernels (tessellation/row_counts.h)."""
        cells = self.cells["volumes"], self.cells["offsets"], self.cells["covariances"]
        keep, corners = self.corners is not None, report if self.corners is None else self.corners
        faces = self.places, self.counts, self.labels, self.measures, self.centroids
        return *faces, *cells, report, np.int32(self.state if keep else 0), corners


@dataclass
class Matching:
    """Faces that are matched and sorted by rows on the device, unless `report` says that cells are missing or wrong."""

    cut: CutCells
    points: cla.Array
    """(n, 3) real."""
    kept: cla.Array
    """(cut.m,) uint8. Whether both cells have the face."""
    starts: cla.Array
    """(n + 1,) int32. Beginning of each row."""
    report: cla.Array
    """int32."""
    arrays: dict[str, Any] = field(default_factory=dict)
    """Arrays of the diagram."""

    def tessellation(self, flags: int = 0) -> Tessellation:
        """Return the diagram. `flags` are those of the report."""
        cells = self.cut.cells
        return Tessellation(
            n=len(self.cut.counts),
            points=self.points,
            **self.arrays,
            volumes=cells["volumes"],
            offsets=cells["offsets"],
            covariances=cells["covariances"],
            reach=cells.get("reach"),
            round_off=flags & (NARROW | UNEVEN),
        )
