"""Slow, obvious reference for the sides of cells at the boundary of polygonal domains: one ring after the other."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np


@dataclass
class Outline:
    """The boundary of a cell as sides: how many, how long in sum, what they enclose; `missing` neighbors there."""

    sides: int = 0
    perimeter: float = 0.0
    area: float = 0.0
    missing: float = 0.0

    def add(self, x, p, q) -> None:
        (a, b), (c, d) = p - x, q - x
        self.area += (a * d - b * c) / 2
        self.perimeter += math.dist(p, q)

    @property
    def quality(self) -> float:
        n = self.sides
        return 4 * max(self.area, 0) * n * math.tan(math.pi / n) / self.perimeter**2


def corners_between(points, size) -> list[int]:
    """Return which of `points` (k, 2), along the boundary, become corners of a cell of size `size`, with both ends.

    The farthest point to the right of the line from the first to the last one is a corner if it is far enough, and half
    of its triangle is in the domain.
    """
    p, side = points[0], points[-1] - points[0]
    length = math.hypot(*side)
    far = [0.0] + [((x - p)[0] * side[1] - (x - p)[1] * side[0]) / length for x in points[1:-1]] if length else [0.0]
    k = int(np.argmax(far))
    ways = points - p
    area = sum(a * d - b * c for (a, b), (c, d) in itertools.pairwise(ways)) / 2
    if far[k] < 0.1 * size or area < 0.5 * far[k] * length / 2 or k == 0:
        return [0, len(points) - 1]
    return corners_between(points[: k + 1], size) + [k + j for j in corners_between(points[k:], size)[1:]]


def outlines(diagram) -> list[Outline]:
    """Each cell with straight sides along the boundary between its ends there, and convex corners of the domain.

    Ring by ring, in the order in which faces lie on the edges. For cells of three sides and more.
    """
    d, domain = diagram, diagram.domain
    rings = domain.oriented
    found = [Outline() for _ in range(len(d))]
    ends = d.vertices[d.face_vertices.reshape(-1, 2)]
    owner = np.repeat(np.arange(len(d)), np.diff(d.neighbor_starts)).tolist()
    on_edge = defaultdict(list)
    for f, j in enumerate(d.neighbors.tolist()):
        if j < 0:
            on_edge[rings.places[-1 - j]].append(f)
        else:
            found[owner[f]].sides += 1
            found[owner[f]].add(d.points[owner[f]], *ends[f])
    for r, (ring, first) in enumerate(zip(rings.rings, rings.ring_starts.tolist(), strict=False)):
        ways = (np.roll(ring, -1, axis=0) - ring) @ (1, 1j)
        turns = np.angle(ways / np.roll(ways, 1))
        faces = []
        for e in range(len(ring)):
            middles = ends[on_edge[first + e]].mean(axis=1)
            order = np.argsort(((middles - ring[e]) @ (1, 1j) / ways[e]).real)
            faces += [(on_edge[first + e][k], e) for k in order]
        starts = [k for k in range(len(faces)) if owner[faces[k][0]] != owner[faces[k - 1][0]]]
        whole = not starts
        if whole and r > 0 and domain.piece_of_ring[r] == domain.piece_of_ring[r - 1]:
            continue  # a hole within a cell
        faces = faces[starts[0] :] + faces[: starts[0]] if starts else faces
        for i, run in itertools.groupby(faces, key=lambda pair: owner[pair[0]]):
            run = list(run)
            points = np.array([ends[f][0] for f, _ in run] + [ends[run[-1][0]][1]])
            kept = range(len(points)) if whole else corners_between(points, math.sqrt(d.volumes[i]))
            for a, b in itertools.pairwise(kept):
                found[i].sides += 1
                found[i].add(d.points[i], points[a], points[b])
            passed = range(run[0][1] + 1, run[0][1] + 1 + (run[-1][1] - run[0][1]) % len(ring))
            found[i].missing += 2 + sum(turns[k % len(ring)] for k in passed) / (math.pi / 3)
    return found
