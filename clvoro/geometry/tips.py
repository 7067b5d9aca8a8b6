"""Sharp convex corners and the ends of narrow bays, where the domain is narrower than two cells.

A cell that fills such a tip alone has a single neighbor: the gradient across the tip is unknown there, and OpenFOAM
refuses the cell. Two generators at the same distance from the tip, behind the first one, give it two neighbors.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import scipy

from .polygon import Polygon

REACHES = 0.8, 1.2
"""Distances over h along the boundary from a tip to the points between which its angle is measured. The least angle
counts."""
WIDEST, WIDEST_BAY = np.radians(48), np.radians(75)
"""Largest angles of a tip, and of one that ends in re-entrant corners on both sides. In wider ones two cells lie beside
each other without help."""
_MOUTH = 2.5
"""Distance over h along the boundary from a tip up to which re-entrant corners are the ends of a bay."""
_NARROWEST = np.radians(12)
_SPACING = 0.6
"""Least distance over h between two tips."""
_CELLS = 0.9
"""A tip is seen from ``2.2 * _CELLS`` times the length of a cell in it, that of its second row."""


def find_tips(
    domain: Polygon, h: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the tips of `domain` for cells of size `h` (k,) at its vertices; `corners` (c,) are re-entrant vertices.

    Returns
    -------
    vertices : (t,) int
        Vertices in `Polygon.oriented`.
    directions : (t,) float
        Angle from the x axis to the wall that begins in the tip.
    angles : (t,) float
        Interior angle, in radians.
    reach : (t,) float
        Length that stands for h at the tip: cells in a sharp tip are long.
    """
    x, starts = domain.oriented.vertices, domain.oriented.ring_starts
    direction, angle = np.zeros(len(x)), np.full(len(x), np.inf)
    in_bay = np.zeros(len(x), bool)
    for a, b in pairwise(starts.tolist()):
        ring = RingPositions(x[a:b])
        own = corners[(corners >= a) & (corners < b)] - a
        in_bay[a:b] = ring.is_between(own, _MOUTH * h[a:b])
        for reach in REACHES:
            ahead, behind = ring.directions(reach * h[a:b])
            found = (behind - ahead) % (2 * np.pi)
            less = found < angle[a:b]
            direction[a:b][less], angle[a:b][less] = ahead[less], found[less]
    own = (domain.oriented.turns > 0) & (angle > 0)
    own &= angle < np.where(in_bay, WIDEST_BAY, WIDEST)
    order = np.flatnonzero(own)
    order = order[np.lexsort((order, angle[order].round(9)))]
    kept = np.zeros(len(order), bool)
    if len(order):
        near = scipy.spatial.KDTree(x[order]).query_ball_point(x[order], _SPACING * h[order])
        for k, others in enumerate(near):
            kept[k] = not kept[others].any()
    tips = np.sort(order[kept])
    length = h[tips] / np.sqrt(np.tan(np.maximum(angle[tips], _NARROWEST) / 2))
    return tips, direction[tips], angle[tips], np.maximum(_CELLS * length, h[tips])


class RingPositions:
    """Positions along one ring (k, 2)."""

    def __init__(self, x: np.ndarray) -> None:
        self.closed = np.concatenate([x, x[:1]])
        self.at = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(self.closed, axis=0).T))])

    def directions(self, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the angles from the x axis to the points at `reach` (k,) from each vertex, ahead and behind."""
        reach = np.minimum(reach, 0.3 * self.at[-1])
        found = []
        for way in (1, -1):
            place = (self.at[:-1] + way * reach) % self.at[-1]
            ends = [np.interp(place, self.at, self.closed[:, axis]) for axis in (0, 1)]
            found.append(np.arctan2(*(np.column_stack(ends) - self.closed[:-1]).T[::-1]))
        return found[0], found[1]

    def is_between(self, others: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return whether vertices `others` are within `reach` (k,) of each vertex both ahead and behind, (k,) bool."""
        if len(others) < 2:
            return np.zeros(len(reach), bool)
        here, there = np.arange(len(reach)), np.sort(others)
        ahead = there[np.searchsorted(there, here, side="right") % len(there)]
        behind = there[np.searchsorted(there, here, side="left") - 1]
        gaps = [(self.at[ahead] - self.at[:-1]) % self.at[-1], (self.at[:-1] - self.at[behind]) % self.at[-1]]
        return np.maximum(*gaps) < reach
