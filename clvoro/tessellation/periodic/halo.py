"""The halo of a periodic box: how deep beyond each periodic boundary ghost images of generators are taken."""

from __future__ import annotations

import numpy as np

from ...opencl.engine import Engine

BLOCKS = {2: 128, 3: 32}
"""Most blocks per axis along a periodic boundary, by dimension."""
FEWEST_BLOCKS = 4
"""Fewest blocks per axis in 3D."""
FINENESS = 2.0
"""Blocks per cell and axis in 3D. More blocks fit the halo better, but each ball is tested against more of them."""


def halo_defines(engine: Engine) -> dict[str, object]:
    """Return the defines of kernels that take HALO_ARGS (see halo.h); empty for domains that are not periodic."""
    if not engine.traits.periods:
        return {}
    return {"HALO": 1, "BLOCKS": BLOCKS[engine.dim]}


def block_count(dim: int) -> int:
    """Return the length of arrays over all blocks of all boundaries, walls included."""
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


class Halo:
    """Depth of the halo, block by block; see `ghost_images.cl`.

    Arrays over blocks run over axes, ends (lower, upper) and positions along the boundary, in this order.

    - `required` (blocks,) float32, device: depth that the balls around the vertices of the latest diagram reach, with
      some room.
    - `cells`: generators of that diagram; 0 before the first one.
    - `estimated`: whether `required` is an estimate, as before the first diagram.
    - `is_bound`: whether `required` may be far too much, so that the next diagram keeps none of it.
    - `depths` (blocks,) float32, device: depth within which the images of that diagram were taken.
    - `requests` (blocks,) int32, device: depths that the cells of a diagram require, while it is made: bits of floats.
    - `extremes` (10,) int32, device: largest and least of `depths`; see tessellation/periodic/halo.h.
    - `kept`: least share of its depth that the halo keeps.
    - `most` (1,) int32, device: key of the largest weight, in a power diagram; see geometry/weights.h.
    """

    def __init__(self, engine: Engine) -> None:
        count = block_count(engine.dim)
        self.required = engine.zeros(count, np.float32)
        self.cells, self.estimated, self.is_bound, self.kept = 0, False, False, np.float32(0)
        self.depths = engine.zeros(count, np.float32)
        self.requests = engine.zeros(count, np.int32)
        self.extremes = engine.empty(10, np.int32)
        self.most = engine.zeros(1, np.int32)

    def fill(self, depth: float, cells: int) -> None:
        """Estimate that the diagram of `cells` generators requires `depth` everywhere."""
        self.required.fill(depth)
        self.cells, self.estimated = cells, True
