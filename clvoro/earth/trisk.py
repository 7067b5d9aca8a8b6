"""Weights for tangential velocities on C grids: Thuburn et al., J. Comput. Phys. 228 (2009) 8321.

The tangential velocity at edge e is the sum of w(e, e') u(e') over all other edges e' of its two cells i, with the
normal velocities u and

    w(e, e') = n(e, i) n(e', i) (1/2 - sum R) l(e') / d(e)

Here l is the length of an edge, d the distance of its generators, and n is 1 if the normal of the edge points out of
the cell, -1 if it points inwards. R is the share of a vertex' kite in the area of the cell. The sum of R is over the
vertices between e and e', counter-clockwise around the cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..mesh.half_faces import HalfEdges


@dataclass(frozen=True)
class Weights:
    """Weights as ragged rows, one per edge."""

    counts: np.ndarray
    """(e,) int. Number of other edges in each row."""
    edges: np.ndarray
    """(w,) int. The other edges, counter-clockwise from the edge on: those of the lower cell, then those of the other
    cell."""
    values: np.ndarray
    """(w,) float. The weight of each of these edges."""


def find_weights(halves: HalfEdges, shares: np.ndarray, lengths: np.ndarray, distances: np.ndarray) -> Weights:
    """Return the weights. The normal of an edge points out of its lower cell.

    - `shares` (h,) float: share of the kite at the begin of each half-edge in the area of its cell.
    - `lengths`, `distances` (e,) float: lengths of edges, and distances between their generators.
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
        # Files of others may have distances of 0. They are refused later.
        with np.errstate(divide="ignore"):
            ratio = lengths[edge] / distances[halves.edge[here]]
        values[at] = normal[here] * normal[there] * (0.5 - passed) * ratio
    return Weights(counts, edges, values)
