"""Positions along the boundary of a polygon: a length along its rings, so that points can slide on them."""

from __future__ import annotations

import numpy as np

from .polygon import Polygon


class RingCoordinate:
    """The length along the rings of a polygon, one ring after the other, with the domain on the left."""

    def __init__(self, domain: Polygon) -> None:
        self.domain, o = domain, domain.oriented
        self.vertices = o.vertices
        self.along = o.vertices[o.next_vertex] - o.vertices
        self.lengths = np.hypot(*self.along.T)
        self.begins = np.concatenate([[0.0], np.cumsum(self.lengths)])
        self.ring_starts = o.ring_starts.astype(np.int64)

    def _rings(self, s: np.ndarray) -> np.ndarray:
        """Return the ring of each position, (k,) int."""
        firsts = self.begins[self.ring_starts[1:-1]]
        return np.searchsorted(firsts, s, side="right")

    def moved(self, s: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Return where positions `s` (k,) get when they move by lengths `by` (..., k) along their rings."""
        ring = self._rings(s)
        begin, end = self.begins[self.ring_starts[ring]], self.begins[self.ring_starts[ring + 1]]
        return begin + (s - begin + by) % (end - begin)

    def way(self, s: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the length from `s` to `t`, both (k,) and on the same ring, in the sense of the ring."""
        ring = self._rings(s)
        begin, end = self.begins[self.ring_starts[ring]], self.begins[self.ring_starts[ring + 1]]
        return (t - s) % (end - begin)

    def edges(self, s: np.ndarray) -> np.ndarray:
        """Return the place of the edge at each position."""
        found = np.searchsorted(self.begins, s, side="right") - 1
        return np.clip(found, 0, len(self.lengths) - 1)

    def points(self, s: np.ndarray) -> np.ndarray:
        """Return the points at positions (...,): (..., 2), on curves if the boundary has some."""
        edge = self.edges(s)
        share = (s - self.begins[edge]) / self.lengths[edge]
        found = self.vertices[edge] + share[..., None] * self.along[edge]
        if not self.domain.curves:
            return found
        numbers = self.domain.oriented.edge_numbers[edge]
        flat = self.domain.on_curve(found.reshape(-1, 2), numbers.reshape(-1))
        return flat.reshape(found.shape)

    def find(self, points: np.ndarray, walls: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return the positions of points on the boundary, (k,).

        Parameters
        ----------
        points : (k, 2) float
        walls : (k,) int
            Number of an edge nearby on the same ring.
        reach : (k,) float
            How far from that edge the point can be, along the ring.
        """
        found = np.empty(len(points))
        for i, (p, place, far) in enumerate(
            zip(points, self.domain.oriented.places[walls].tolist(), reach.tolist(), strict=True)
        ):
            ring = int(np.searchsorted(self.ring_starts, place, side="right")) - 1
            rows = np.arange(self.ring_starts[ring], self.ring_starts[ring + 1])
            total = self.begins[rows[-1] + 1] - self.begins[rows[0]]
            ahead = (self.begins[rows] - self.begins[place]) % total
            near = (ahead <= far + self.lengths[place]) | (
                ahead + self.lengths[rows] >= total - far
            )
            rows = rows[near]
            share = ((p - self.vertices[rows]) * self.along[rows]).sum(axis=1)
            share = np.clip(share / self.lengths[rows] ** 2, 0, 1)
            off = np.hypot(*(self.vertices[rows] + share[:, None] * self.along[rows] - p).T)
            best = int(np.argmin(off))
            found[i] = self.begins[rows[best]] + share[best] * self.lengths[rows[best]]
        return found
