"""Positions along the boundary of a polygon: a length along its rings."""

from __future__ import annotations

import numpy as np

from .polygon import Polygon


class RingCoordinate:
    """The length along the rings of a polygon, one ring after the other, with the domain on the left.

    The positions of a ring reach from that of its first vertex to that of the next ring's first vertex, without it.

    Attributes
    ----------
    begins : (k + 1,) float64
        Position of each vertex of `rings`, and the length of all rings.
    ring_starts : (r + 1,) int64
        First vertex of each ring.
    """

    def __init__(self, domain: Polygon) -> None:
        self.domain, self.rings = domain, domain.oriented
        self.begins = np.concatenate([[0.0], np.cumsum(self.rings.lengths)])
        self.ring_starts = self.rings.ring_starts.astype(np.int64)

    def ring_of(self, s: np.ndarray) -> np.ndarray:
        """Return the ring of each position, (k,) int."""
        return self.begins[self.ring_starts[1:-1]].searchsorted(s, side="right")

    def span(self, ring: int) -> tuple[float, float]:
        """Return the first position of a ring, and its length."""
        begin, end = self.begins[self.ring_starts[ring : ring + 2]].tolist()
        return begin, end - begin

    def position(self, edge: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Return the positions at `share` (k,), from 0 to 1, of edges (k,), given by their first vertices."""
        s, end = self.begins[edge] + share * self.rings.lengths[edge], self.begins[edge + 1]
        return np.where(s < end, s, self.begins[self.rings.next_vertex[edge]])

    def edges(self, s: np.ndarray) -> np.ndarray:
        """Return the edge at each position, by its first vertex."""
        found = self.begins.searchsorted(s, side="right") - 1
        return np.minimum(np.maximum(found, 0), len(self.begins) - 2)

    def points(self, s: np.ndarray) -> np.ndarray:
        """Return the points at positions (k,): (k, 2), on curves if the boundary has some."""
        edge = self.edges(s)
        share = (s - self.begins[edge]) / self.rings.lengths[edge]
        found = self.rings.vertices[edge] + share[:, None] * self.rings.along[edge]
        return self.domain.on_curve(found, self.rings.edge_numbers[edge]) if self.domain.curves else found
