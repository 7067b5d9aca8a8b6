"""Where the cells of some generators meet: vertices that more bisectors pass through than three."""

from __future__ import annotations

import numpy as np

SLOPE = 1e-3
"""A direction that bisectors lie within this angle of is not one in which they tell where a vertex is."""
CORRECTIONS = 2
"""The first places a vertex, the second what rounding has left of it."""


class Meetings:
    """Vertices, and which cells meet in each.

    Parameters
    ----------
    points : (n, 3) float
        Generators.
    fixed : (v, 3) bool
        Coordinates in which a vertex stays where it is: of those on walls.
    vertices, cells : (k,) int
        Which vertex is one of which cell, in any order, as often as may be.
    """

    def __init__(
        self, points: np.ndarray, fixed: np.ndarray, vertices: np.ndarray, cells: np.ndarray
    ) -> None:
        pairs = np.unique(np.column_stack([vertices, cells]), axis=0)
        self.points, self.fixed = points, fixed
        self.vertices, self.cells = pairs.T
        self.starts = np.searchsorted(self.vertices, np.arange(len(fixed) + 1))

    def excess(self, vertices: np.ndarray, places: np.ndarray) -> np.ndarray:
        """By how much `vertices` (k,), if they were at `places` (k, 3), are farther from one generator than another."""
        counts = np.diff(self.starts)[vertices]
        begins = np.cumsum(counts) - counts
        rows = np.repeat(self.starts[vertices] - begins, counts) + np.arange(counts.sum())
        far = np.linalg.norm(
            np.repeat(places, counts, axis=0) - self.points[self.cells[rows]], axis=1
        )
        if not len(far):
            return np.zeros(0)
        return np.maximum.reduceat(far, begins) - np.minimum.reduceat(far, begins)

    def place(self, places: np.ndarray) -> np.ndarray:
        """Return where vertices now at `places` (v, 3) are as far from all their generators, by least squares.

        In directions in which hardly any of its bisectors tells where a vertex lies it stays where it is.
        """
        v = self.vertices
        origins = self.points[self.cells[self.starts[v]]]
        ways = self.points[self.cells] - origins
        lengths = np.linalg.norm(ways, axis=1)
        ways /= np.where(lengths > 0, lengths, 1)[:, None]
        free = np.where(self.fixed[v], 0, ways)
        squares = np.zeros((len(places), 3, 3))
        np.add.at(squares, v, free[:, :, None] * free[:, None, :])
        inverses = np.linalg.pinv(squares, SLOPE**2, hermitian=True)
        for _ in range(CORRECTIONS):
            off = lengths / 2 - (ways * (places[v] - origins)).sum(axis=1)
            sums = np.zeros_like(places)
            np.add.at(sums, v, free * off[:, None])
            places = places + np.einsum("vab,vb->va", inverses, sums)
        return places
