"""A polyhedral mesh as lists, to merge two of its vertices and check all of it, in plain Python.

Formulas: OpenFOAM v1912, the methods of `primitiveMesh` for faces and cells, `primitiveMeshTools.C`,
`primitiveMeshCheck.C`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np


@dataclass
class Mesh:
    """Points, and faces as (owner, neighbor, loop); the loop is counter-clockwise as seen from outside of the owner."""

    points: dict
    faces: list

    @classmethod
    def of(cls, mesh):
        """The mesh of a `Faces` without seams."""
        loops = np.split(mesh.corners, mesh.starts[1:-1])
        faces = [(int(i), int(j), loop.tolist()) for i, j, loop in zip(mesh.owner, mesh.neighbor, loops, strict=True)]
        return cls(dict(enumerate(mesh.points)), faces)

    def cells(self):
        """Each cell with its faces as outward loops: {cell: [(face, loop)]}."""
        found = {}
        for k, (i, j, loop) in enumerate(self.faces):
            found.setdefault(i, []).append((k, loop))
            if j >= 0:
                found.setdefault(j, []).append((k, loop[::-1]))
        return found

    def merged(self, a, b, target):
        """Return the mesh with b merged into a at `target`, or None if a face then has a twice."""
        points = {k: x for k, x in self.points.items() if k != b}
        points[a] = np.asarray(target)
        faces = []
        for i, j, loop in self.faces:
            new = [a if v == b else v for v in loop]
            new = [v for v, before in zip(new, [new[-1], *new], strict=False) if v != before]
            if new.count(a) > 1:
                return None
            if len(new) >= 3:
                faces.append((i, j, new))
        return Mesh(points, faces)

    def is_manifold(self):
        """Whether all cells are balls that meet in faces, edges and vertices, and the whole is a ball."""
        everything = set()
        for faces in self.cells().values():
            sides = [s for _, loop in faces for s in sides_of(loop)]
            if len(faces) < 4 or len(set(sides)) < len(sides):
                return False
            if any((b, a) not in sides for a, b in sides):
                return False
            everything |= {frozenset(s) for s in sides}
            if len({a for a, _ in sides}) - len(sides) // 2 + len(faces) != 2:
                return False
        whole = len(self.points) - len(everything) + len(self.faces) - len(self.cells())
        return whole == 1 and all(meet_on_a_path(f[2], g[2]) for f, g in combinations(self.faces, 2))


def sides_of(loop):
    """Pairs of corners, one after the other."""
    return list(zip(loop, [*loop[1:], loop[0]], strict=True))


def meet_on_a_path(one, other):
    """Whether the common corners of two faces are consecutive in both, and not all of a face's."""
    common = set(one) & set(other)
    if len(common) < 2:
        return True
    sides = {frozenset(s) for s in sides_of(one)} & {frozenset(s) for s in sides_of(other)}
    return len(common) < min(len(one), len(other)) and len(sides) == len(common) - 1


def face_shape(x):
    """Center, area vector and flatness of a face with the corners `x` (k, 3)."""
    middle, after = x.mean(axis=0), np.roll(x, -1, axis=0)
    normals = np.cross(after - x, middle - x)
    weights = np.linalg.norm(normals, axis=1)
    center = (weights[:, None] * (x + after + middle)).sum(axis=0) / (3 * weights.sum())
    area = normals.sum(axis=0) / 2
    spread = np.linalg.norm(np.cross(after - x, center - x), axis=1).sum() / 2
    return center, area, np.linalg.norm(area) / spread


def cell_shape(faces):
    """Centroid and volume of a cell with faces (center, outward area)."""
    middle = np.mean([c for c, _ in faces], axis=0)
    pyramids = [(s @ (c - middle), 0.75 * c + 0.25 * middle) for c, s in faces]
    thrice = sum(v for v, _ in pyramids)
    return sum(v * c for v, c in pyramids) / thrice, thrice / 3


@dataclass
class Quality:
    """The worst of some cells, and of the faces `at` them."""

    flatness: float
    cosine: float
    positive: bool
    angle: float
    skewness: float


def quality(mesh, at):
    """Measure the faces with the vertex `at`, and the cells that have such faces."""
    x = {k: np.array([mesh.points[v] for v in loop]) for k, (_, _, loop) in enumerate(mesh.faces)}
    shapes = {k: face_shape(y) for k, y in x.items()}
    changed = {k for k, (_, _, loop) in enumerate(mesh.faces) if at & set(loop)}
    centers, cosine, positive = {}, -1.0, True
    for cell, faces in mesh.cells().items():
        if not changed & {k for k, _ in faces}:
            continue
        signs = {k: 1 if mesh.faces[k][0] == cell else -1 for k, _ in faces}
        seen = {k: (shapes[k][0], signs[k] * shapes[k][1]) for k in signs}
        centers[cell], volume = cell_shape(list(seen.values()))
        positive &= volume > 0
        for i in seen:
            for j in seen:
                if i != j and (i in changed or j in changed):
                    d, n = seen[j][0] - seen[i][0], seen[i][1]
                    cosine = max(cosine, d @ n / np.linalg.norm(d) / np.linalg.norm(n))
    angle = skewness = 0.0
    for k in changed:
        i, j, _ = mesh.faces[k]
        center, area, _ = shapes[k]
        normal = area / np.linalg.norm(area)
        arm = center - centers[i]
        line = centers[j] - centers[i] if j >= 0 else (arm @ normal) * normal
        angle = max(angle, np.degrees(np.arccos(min(line @ normal / np.linalg.norm(line), 1))))
        off = arm - (arm @ normal) / (line @ normal) * line
        size = np.linalg.norm(off)
        reach = max(np.abs((x[k] - center) @ off) / max(size, 1e-300))
        least = (0.2 if j >= 0 else 0.4) * np.linalg.norm(line)
        skewness = max(skewness, size / max(reach, least))
        fans = np.ones(len(x[k]), bool)
        for cell, sign in ((i, 1), (j, -1)):
            if cell < 0:
                continue
            y, tip = x[k] - centers[cell], center - centers[cell]
            about = [sign * np.linalg.det([a, b, tip]) for a, b in zip(y, np.roll(y, -1, 0), strict=True)]
            positive &= min(about) > 0 and sign * (area @ tip) > 0
            for b in range(len(y)):
                fan = [
                    sign * np.linalg.det([y[b], y[(b + s) % len(y)], y[(b + s + 1) % len(y)]])
                    for s in range(1, len(y) - 1)
                ]
                fans[b] &= min(fan) > 1e-6 * sum(about)
        positive &= fans.any()
    return Quality(min(shapes[k][2] for k in changed), cosine, bool(positive), angle, skewness)
