"""Positions along the boundary of a polygon: a length along its rings, so that points can slide on them."""

from __future__ import annotations

import numpy as np

from .polygon import Polygon


class RingCoordinate:
    """The length along the rings of a polygon, one ring after the other, with the domain on the left."""

    def __init__(self, domain: Polygon) -> None:
        self.domain, o = domain, domain.oriented
        self.vertices = o.vertices
        self.along, self.lengths = o.along, o.lengths
        self.begins = np.concatenate([[0.0], np.cumsum(self.lengths)])
        self.ring_starts = o.ring_starts.astype(np.int64)
        self.first_positions = self.begins[self.ring_starts[1:-1]]

    def _rings(self, s: np.ndarray) -> np.ndarray:
        """Return the ring of each position, (k,) int."""
        return self.first_positions.searchsorted(s, side="right")

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
        found = self.begins.searchsorted(s, side="right") - 1
        return np.minimum(np.maximum(found, 0), len(self.lengths) - 1)

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
        if not len(points):
            return np.empty(0)
        place = self.domain.oriented.places[walls].astype(np.int64)
        ring = np.searchsorted(self.ring_starts, place, side="right") - 1
        first, count = self.ring_starts[ring], np.diff(self.ring_starts)[ring]
        start = self.begins[first]
        total = self.begins[first + count] - start
        # Edges from one end of the reach to the other, counted on beyond the ends of the ring.
        middle = self.begins[place] - start
        ends = [middle - reach, middle + self.lengths[place] + reach]
        laps = [np.floor(s / total) for s in ends]
        low, high = (
            self.edges(start + s - lap * total) - first + (lap * count).astype(np.int64)
            for s, lap in zip(ends, laps, strict=True)
        )
        counts = np.minimum(high - low + 1, count)
        begins = np.cumsum(counts) - counts
        row = np.repeat(np.arange(len(points)), counts)
        edge = first[row] + (low[row] + np.arange(len(row)) - begins[row]) % count[row]
        along, aside = self.along[edge], points[row] - self.vertices[edge]
        share = np.clip((aside * along).sum(axis=1) / self.lengths[edge] ** 2, 0, 1)
        off = np.hypot(*(aside - share[:, None] * along).T)
        nearest = np.flatnonzero(off == np.repeat(np.minimum.reduceat(off, begins), counts))
        nearest = nearest[np.diff(row[nearest], prepend=-1) > 0]
        found = self.begins[edge[nearest]] + share[nearest] * self.lengths[edge[nearest]]
        return start + (found - start) % total
