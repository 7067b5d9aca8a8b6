"""Margins beyond the seams of periodic boxes, within which images of generators are taken."""

from __future__ import annotations

import numpy as np

from ...opencl.engine import Engine

BLOCKS = {2: 128, 3: 32}
"""Blocks per axis along a seam by dimension, at most."""
FEWEST_BLOCKS = 4
"""The same, at least."""
FINENESS = 2.0
"""Blocks in 3D to a cell, each way: every ball is held against all blocks that it meets."""


def seam_defines(engine: Engine) -> dict[str, object]:
    """Return the defines of kernels that take SEAM_ARGS (see halo.h): none where there are no seams."""
    if not engine.domain_kind.periodic:
        return {}
    return {"SEAMS": 1, "BLOCKS": BLOCKS[engine.dim]}


def block_count(dim: int) -> int:
    """Return the number of blocks that all seams have room for, those across axes with walls included."""
    return 2 * dim * BLOCKS[dim] ** (dim - 1)


def block_counts(edges: np.ndarray, n: float) -> np.ndarray:
    """Return the number of blocks along each axis of a box of `n` cells, (4,) int32."""
    dim = len(edges)
    counts = np.full(4, BLOCKS[dim], np.int32)
    if dim == 3:
        edges = np.maximum(edges, 1e-30, dtype=np.float64)
        across = FINENESS * edges * (n / np.prod(edges)) ** (1 / 3)
        steps = np.log2(np.clip(across, FEWEST_BLOCKS, BLOCKS[3])).astype(int)
        counts[:3] = 2**steps
    return counts


class Margins:
    """How far beyond the seams of a periodic box images are taken, block by block; see `seam.cl`.

    Blocks are in the order of axes, ends (lower, upper) and places along the seam.

    Attributes
    ----------
    needed : (blocks,) float32, device
        How deep balls around the vertices of the latest diagram go that are a little wider than they need be.
    cells : int
        Generators of that diagram; 0 before the first one.
    guessed : bool
        Whether that diagram is still to be made.
    widths : (blocks,) float32, device
        Within which its images were taken, if it had any.
    wishes : (blocks,) int32, device
        What cells of a diagram need, while it is made: bits of floats.
    extremes : (10,) int32, device
        The largest and the least of `widths`; see tessellation/periodic/halo.h.
    """

    def __init__(self, engine: Engine) -> None:
        count = block_count(engine.dim)
        self.needed = engine.zeros(count, np.float32)
        self.cells, self.guessed = 0, False
        self.widths = engine.zeros(count, np.float32)
        self.wishes = engine.zeros(count, np.int32)
        self.extremes = engine.empty(10, np.int32)

    def fill(self, margin: float, cells: int) -> None:
        """Have `margin` needed everywhere by the diagram of `cells` generators."""
        self.needed.fill(margin)
        self.cells, self.guessed = cells, True
