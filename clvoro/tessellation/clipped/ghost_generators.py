"""Ghost generators: auxiliary generators outside a polygonal domain.

The convex cells of generators at the boundary reach far outside, up to the middle of a hole, and so does the search
for their neighbors. Ghost generators bound these cells at little cost. They do not change the diagram inside the
domain as long as none of their cells reaches into it; `boundary_crossings.py` checks this in each step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...geometry.polygon import Polygon

CLEARANCE = 3.0
"""Least distance to the boundary, in spacings of the generators there."""
GRADING = 1.5
"""Distance to the boundary over the spacing of ghost generators."""
MOST_BOXES = 1 << 20
_JITTER = 0.2  # of a spacing, so that no four lie on a circle


def place_ghost_generators(domain: Polygon, spacing: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return ghost generators (s, 2) outside `domain`, inside the box that clips its cells.

    Parameters
    ----------
    spacing : callable
        Distance of generators from their neighbors near points (k, 2) of the boundary, (k,).
    """
    lower, upper = domain.clip_box
    edge = float((upper - lower).max()) / 8
    counts = np.ceil((upper - lower) / edge).astype(int)
    centers = lower + edge * (np.indices(counts.tolist()).reshape(2, -1).T + 0.5)
    found: list[np.ndarray] = []
    children = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) / 4
    rng = np.random.Generator(np.random.PCG64(0))
    total = 0
    while len(centers) and total < MOST_BOXES:
        total += len(centers)
        nearest = domain.nearest_edge(centers)[1]
        distance = np.hypot(*(nearest - centers).T)
        outside = ~domain.contains(centers)
        whole = distance > edge * np.sqrt(0.5)  # the boundary does not pass through the box
        clearance = CLEARANCE * np.asarray(spacing(nearest), float)
        small = edge <= distance / GRADING
        good = outside & whole & small
        taken = good & (distance >= clearance)
        shift = rng.uniform(-_JITTER, _JITTER, (np.count_nonzero(taken), 2)) * edge
        found.append(centers[taken] + shift)
        # Divide the others while a point at the least distance fits into them.
        reach = distance + edge * np.sqrt(0.5)
        divided = ~good & ~(~outside & whole) & (np.where(outside, reach, reach - distance) > clearance)
        edge /= 2
        centers = (centers[divided][:, None] + 2 * edge * children).reshape(-1, 2)
    points = np.concatenate(found)
    return points[np.all((points > lower) & (points < upper), axis=1)]
