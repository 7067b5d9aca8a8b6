"""The weights that give C grids their velocities along edges: Thuburn et al., J. Comput. Phys. 228 (2009) 8321.

Of velocities u across edges, the one along edge e is the sum over the other edges e' of the cells i beside it of

    w(e, e') u(e'),    w(e, e') = n(e, i) n(e', i) (1/2 - sum R) l(e') / d(e)

with the edges' lengths l, the distance d of the generators, n = 1 where the normal of the edge points out of the cell
and -1 where it points in, and the sum over the vertices on the way from e to e', counter-clockwise around the cell, of
the shares R that their kites have of the cell's area.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .half_edges import HalfEdges


@dataclass(frozen=True)
class Weights:
    """Weights as ragged rows, one for each edge.

    Attributes
    ----------
    counts : (e,) int
        Numbers of others.
    edges : (w,) int
        The others: counter-clockwise from the edge on, of the lower cell and then of the other one.
    values : (w,) float
    """

    counts: np.ndarray
    edges: np.ndarray
    values: np.ndarray


def find_weights(
    halves: HalfEdges, shares: np.ndarray, lengths: np.ndarray, distances: np.ndarray
) -> Weights:
    """Return the weights; `shares` (h,) are those of the kites at the beginnings of half-edges, others are by edge.

    The normal of an edge points out of its lower cell.
    """
    sides = halves.counts[halves.cell]
    first, twin = halves.first, halves.twin[halves.first]
    counts = sides[first] - 1
    pairs = twin >= 0
    place = np.empty(len(sides), np.int64)
    place[twin[pairs]] = counts[pairs]
    counts[pairs] += sides[twin[pairs]] - 1
    place[first] = 0
    place += (np.cumsum(counts) - counts)[halves.edge]
    normal = np.full(len(sides), -1.0)
    normal[first] = 1
    edges, values = np.empty(counts.sum(), np.int64), np.empty(counts.sum())
    here = there = np.arange(len(sides))
    passed = np.zeros(len(sides))
    for step in range(1, int(sides.max())):
        going = sides[here] > step
        here, there = here[going], halves.next[there[going]]
        passed = passed[going] + shares[there]
        at, edge = place[here] + step - 1, halves.edge[there]
        edges[at] = edge
        ratio = lengths[edge] / distances[halves.edge[here]]
        values[at] = normal[here] * normal[there] * (0.5 - passed) * ratio
    return Weights(counts, edges, values)
