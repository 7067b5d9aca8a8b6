"""Slow, obvious reference for the sides of cells at the boundary of polygonal domains: one ring after the other."""

from __future__ import annotations

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


def outlines(diagram) -> list[Outline]:
    """Each cell with the boundary between its ends made straight, as long as it turns by no more than 30 degrees.

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
        sharpest = int(np.argmax(np.abs(turns) > np.abs(turns).max() - 1e-6))
        faces = []
        for e in np.roll(np.arange(len(ring)), -sharpest).tolist():
            middles = ends[on_edge[first + e]].mean(axis=1)
            order = np.argsort(((middles - ring[e]) @ (1, 1j) / ways[e]).real)
            faces += [(on_edge[first + e][k], e) for k in order]
        starts = [k for k in range(len(faces)) if owner[faces[k][0]] != owner[faces[k - 1][0]]]
        whole = not starts
        faces = faces[starts[0] :] + faces[: starts[0]] if starts else faces
        hole = r > 0 and domain.piece_of_ring[r] == domain.piece_of_ring[r - 1]
        last, begin, end, turned = None, None, None, 0.0
        for f, e in faces:
            i = owner[f]
            if whole and hole:
                found[i].add(d.points[i], *ends[f])
                continue
            goes_on = last is not None and owner[last[0]] == i
            passed = []
            if goes_on:
                passed = [(last[1] + k) % len(ring) for k in range(1, (e - last[1]) % len(ring) + 1)]
                turned += sum(turns[passed])
            found[i].missing += sum(turns[passed]) / (math.pi / 3) + (0 if goes_on else 2)
            if not goes_on or abs(turned) > math.radians(30.01):
                if last is not None:
                    found[owner[last[0]]].add(d.points[owner[last[0]]], begin, end)
                found[i].sides += 1
                begin, turned = ends[f][0], 0.0
            last, end = (f, e), ends[f][1]
        if last is not None:
            found[owner[last[0]]].add(d.points[owner[last[0]]], begin, end)
    return found
