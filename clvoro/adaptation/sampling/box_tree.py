"""A quadtree (octree) of boxes over the domain, in the order of a Hilbert curve."""

from __future__ import annotations

from functools import lru_cache, reduce
from itertools import product

import numpy as np

from ...geometry.domain import Domain

_HALVED = 0.5 ** np.arange(64)
_ALL = slice(None)
_BITS = {2: 31, 3: 21}  # per axis in a Morton key of 64 bits


@lru_cache
def hilbert_tables(dim: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tables of the Hilbert curve in `dim` dimensions.

    A state is an entry corner e and a direction a. The curve visits the children of a box in
    Gray-code order, turned by a and reflected by e.

    Results:
    - `place` (states, 2^d, d) int: half of the box, 0 or 1 per axis, of the k-th child on the curve.
    - `after` (states, 2^d) int: state of that child.
    - `rank` (states, 2^d) int: the inverse of `place`: k of the child whose halves are the bits of the index (axis 0 is
      the lowest bit).
    """
    full, states = 1 << dim, dim << dim

    def rotate(bits: int, by: int) -> int:
        by %= dim
        return ((bits << by) | (bits >> (dim - by))) & (full - 1)

    def gray(i: int) -> int:
        return i ^ (i >> 1)

    def trailing_ones(i: int) -> int:
        return (~i & (i + 1)).bit_length() - 1

    place = np.zeros((states, full, dim), np.int64)
    after, rank = np.zeros((2, states, full), np.int8)
    for entry, axis, k in product(range(full), range(dim), range(full)):
        state = entry * dim + axis
        bits = rotate(gray(k), axis + 1) ^ entry
        place[state, k] = [(bits >> a) & 1 for a in range(dim)]
        rank[state, bits] = k
        corner = gray(2 * ((k - 1) // 2)) if k else 0
        turn = 0 if k == 0 else trailing_ones(k - 1 if k % 2 == 0 else k)
        next_entry, next_axis = entry ^ rotate(corner, axis + 1), (axis + turn + 1) % dim
        after[state, k] = next_entry * dim + next_axis
    return place, after, rank


class BoxTree:
    """Boxes that tile the domain's bounding box, in the order of a Hilbert curve.

    - `corner` (m, d) float: lower corners in units of the edges of the root boxes: multiples of powers of two, hence
      exact.
    - `level` (m,) int8: the edges are 2^-level root edges.
    - `state` (m,) int8: state of the curve in each box.
    - `root` (d,) float: physical edges of the root boxes.
    - `end` (d,) float: number of root boxes per axis: the upper corner in root units.
    """

    def __init__(self, domain: Domain):
        self.origin = np.array(domain.lower)
        # As many root boxes per axis as make them nearly cubes, with a limit for very long domains.
        shape = np.clip(np.rint(domain.extent / domain.extent.min()), 1, 64).astype(int)
        self.root = domain.extent / shape
        self.upper = np.array(domain.upper)
        self.end = shape.astype(float)
        self.corner = _snake(shape).astype(float)
        self.level = np.zeros(len(self.corner), np.int8)
        self.state = np.zeros(len(self.corner), np.int8)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.corner.shape[1]

    def __len__(self) -> int:
        return len(self.level)

    def edges(self, chosen: slice | np.ndarray = _ALL) -> np.ndarray:
        """Return the physical edge lengths (m, d)."""
        return self.root * _HALVED[self.level[chosen]][:, None]

    def longest(self) -> np.ndarray:
        """Return each box's longest edge (m,)."""
        return reduce(np.maximum, self.edges().T)

    def volumes(self) -> np.ndarray:
        """Return the boxes' areas or volumes (m,)."""
        return reduce(np.multiply, self.edges().T)

    def points(self, at: np.ndarray, chosen: slice | np.ndarray = _ALL) -> np.ndarray:
        """Return the points (m, p, d) at relative positions `at` (p, d) or (m, p, d) in [0, 1]."""
        step, corner = _HALVED[self.level[chosen]][:, None], self.corner[chosen]
        found = np.empty((len(corner), *at.shape[-2:]))
        for a in range(self.dim):  # faster than NumPy along a short axis
            x = self.origin[a] + self.root[a] * (corner[:, a, None] + step * at[..., a])
            np.clip(x, self.origin[a], self.upper[a], out=found[..., a])
        return found

    @property
    def deepest(self) -> int:
        """The finest level at which `find` works."""
        return _BITS[self.dim] - int(self.end.max()).bit_length()

    def find(self, places: np.ndarray) -> np.ndarray:
        """Return the index (n,) of the box that contains each of `places` (n, d), in root units."""
        starts = self._keys(self.corner)
        order = np.argsort(starts)
        at = np.searchsorted(starts[order], self._keys(places), side="right") - 1
        return order[at]

    def find_points(self, points: np.ndarray) -> np.ndarray:
        """Return the index (n,) of the box that contains, or is next to, each of the physical `points` (n, d)."""
        places = (points - self.origin) / self.root
        return self.find(np.clip(places, 0, self.end - 2.0 ** -(self.deepest + 1)))

    def _keys(self, places: np.ndarray) -> np.ndarray:
        """Return Morton keys of `places` (n, d)."""
        whole = np.floor(places * 2.0**self.deepest).astype(np.uint64)
        key = np.zeros(len(places), np.uint64)
        for a in range(self.dim):
            key |= _spread(whole[:, a], self.dim) << np.uint64(a)
        return key

    def neighbors(self) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs (i, j): box j is across the center of a face of box i.

        Of several smaller neighbors one is found per face; each of them finds this box.
        """
        step = _HALVED[self.level][:, None]
        out = np.concatenate([s * e for s in (-1, 1) for e in np.eye(self.dim)[:, None, :]])
        places = (self.corner + 0.5 * step + 0.5001 * step * out[:, None, :]).reshape(-1, self.dim)
        inside = np.ones(len(places), bool)
        for x, end in zip(places.T, self.end, strict=True):  # faster than along the short axis
            inside &= (x > 0) & (x < end)
        i = np.tile(np.arange(len(self)), 2 * self.dim)[inside]
        return i, self.find(places[inside])

    def split(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Replace the boxes where `chosen` (m,) is true by their children, in the order of the curve.

        Results:
        - `parent` (m',) int: for each new box, the old index of itself or of its parent.
        - `child` (m',) int8: rank among the siblings; -1 for boxes that were not split.
        """
        place, after, _ = hilbert_tables(self.dim)
        counts = np.where(chosen, 1 << self.dim, 1)
        parent = np.repeat(np.arange(len(self)), counts)
        child = np.full(len(parent), -1, np.int8)
        new = np.flatnonzero(chosen[parent])
        child[new] = np.tile(np.arange(1 << self.dim, dtype=np.int8), len(new) >> self.dim)
        # The children of the split boxes, each family together: (families, 2^d, ...).
        corner, level, state = self.corner[parent], self.level[parent], self.state[parent]
        level[new] += 1
        half = _HALVED[self.level[chosen] + 1][:, None, None] * place[self.state[chosen]]
        corner[new] += half.reshape(-1, self.dim)
        state[new] = after[self.state[chosen]].ravel()
        self.corner, self.level, self.state = corner, level, state
        return parent, child


def _snake(shape: np.ndarray) -> np.ndarray:
    """Return the boxes of a grid in an order in which each touches the previous one, (m, d) int."""
    rows = np.zeros((1, 0), np.int64)
    for count in shape[::-1]:
        line = np.arange(count)
        lines = [line if i % 2 == 0 else line[::-1] for i in range(len(rows))]
        rows = np.column_stack([np.concatenate(lines), np.repeat(rows, count, axis=0)])
    return rows


def _spread(bits: np.ndarray, dim: int) -> np.ndarray:
    """Put dim - 1 zeros between the bits of `bits` (uint64, up to 31 bits in 2D, 21 in 3D)."""
    steps = {
        2: (
            (16, 0x0000FFFF0000FFFF),
            (8, 0x00FF00FF00FF00FF),
            (4, 0x0F0F0F0F0F0F0F0F),
            (2, 0x3333333333333333),
            (1, 0x5555555555555555),
        ),
        3: (
            (32, 0x001F00000000FFFF),
            (16, 0x001F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ),
    }
    for shift, mask in steps[dim]:
        bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
    return bits
