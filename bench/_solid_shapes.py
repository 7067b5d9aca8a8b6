"""Solids for benches, of trimesh and manifold3d: the shape, and two sizes of cells."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
from trimesh import creation, transformations

import clvoro


def block(lower: Any, upper: Any) -> trimesh.Trimesh:
    """Return a box between two corners."""
    made = creation.box(np.subtract(upper, lower))
    made.apply_translation(np.add(lower, upper) / 2)
    return made


def tube(begin: Any, end: Any, radius: float, sections: int = 64) -> trimesh.Trimesh:
    """Return a cylinder between two points."""
    return creation.cylinder(radius, segment=[begin, end], sections=sections)


def minus(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the first part without the others."""
    return trimesh.boolean.difference(parts, engine="manifold")


def plus(*parts: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the union."""
    return trimesh.boolean.union(parts, engine="manifold")


def extruded(outline: Any, height: float) -> trimesh.Trimesh:
    """Return a prism over a polygon of shapely."""
    return creation.extrude_polygon(outline, height)


def gear(teeth: int = 12) -> trimesh.Trimesh:
    """Return a gear with a bore."""
    import shapely

    turn = 2 * math.pi / teeth
    corners = [
        (r * math.cos(turn * (k + s)), r * math.sin(turn * (k + s)))
        for k in range(teeth)
        for r, s in ((0.75, 0.02), (1.0, 0.14), (1.0, 0.36), (0.75, 0.48))
    ]
    bore = shapely.Point(0, 0).buffer(0.3, quad_segs=16)
    return extruded(shapely.Polygon(corners).difference(bore), 0.4)


def bracket() -> trimesh.Trimesh:
    """Return an angle with a rounded inner edge and two holes."""
    import shapely

    arms = shapely.union_all([shapely.box(0, 0, 2, 0.4), shapely.box(0, 0, 0.4, 2)])
    shape = extruded(arms.buffer(0.3, quad_segs=12).buffer(-0.3, quad_segs=12), 1.2)
    return minus(shape, tube((1.4, -1, 0.6), (1.4, 2, 0.6), 0.25), tube((-1, 1.4, 0.6), (2, 1.4, 0.6), 0.25))


def wing() -> trimesh.Trimesh:
    """Return the outside, in a box, of a wing with the profile NACA 0012 and a blunt trailing edge."""
    import shapely

    x = (1 - np.cos(np.linspace(0, math.pi, 60))) / 2
    y = 0.6 * (0.2969 * np.sqrt(x) - 0.126 * x - 0.3516 * x**2 + 0.2843 * x**3 - 0.1015 * x**4)
    profile = shapely.Polygon([*zip(x, y, strict=True), *zip(x[::-1], -y[::-1], strict=True)])
    part = extruded(profile, 1.0)
    return minus(block((-1, -1, -0.5), (2, 1, 1.5)), part)


def gyroid(cells: int = 70) -> trimesh.Trimesh:
    """Return one side of a gyroid in a box."""
    from skimage.measure import marching_cubes

    k = np.linspace(-2.2, 2.2, cells)
    x, y, z = np.meshgrid(k, k, k, indexing="ij")
    wave = np.sin(2 * x) * np.cos(2 * y) + np.sin(2 * y) * np.cos(2 * z) + np.sin(2 * z) * np.cos(2 * x)
    inside = np.minimum(wave, 2.0 - np.maximum(np.maximum(abs(x), abs(y)), abs(z)))
    vertices, triangles, _, _ = marching_cubes(inside, 0.0, spacing=3 * (k[1] - k[0],))
    made = trimesh.Trimesh(vertices, triangles)
    return made if made.volume > 0 else trimesh.Trimesh(vertices, triangles[:, ::-1])


def dirty() -> trimesh.Trimesh:
    """Return separate triangles of a part, with gaps of 1e-4 and some triangles twice or inside out."""
    part = minus(block((0, 0, 0), (2, 1, 1)), tube((1, -1, 0.5), (1, 2, 0.5), 0.3))
    rng = np.random.default_rng(1)
    corners = part.triangles + rng.uniform(-5e-5, 5e-5, part.triangles.shape)
    flipped = rng.random(len(corners)) < 0.05
    corners[flipped] = corners[flipped, ::-1]
    corners = np.concatenate([corners, corners[:4]])
    return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)


SHAPES: dict[str, tuple[Callable[[], trimesh.Trimesh], tuple[float, float, float]]] = {
    "cube": (lambda: block((0, 0, 0), (1, 1, 1)), (0.15, 0.075, 0.04)),
    "L": (lambda: minus(block((0, 0, 0), (2, 2, 1)), block((1, 1, -1), (3, 3, 2))), (0.25, 0.125, 0.065)),
    "Fichera corner": (lambda: minus(block((-1, -1, -1), (1, 1, 1)), block((0, 0, 0), (2, 2, 2))), (0.25, 0.15, 0.08)),
    "hole": (lambda: minus(block((-1, -1, 0), (1, 1, 1)), tube((0, 0, -1), (0, 0, 2), 0.5)), (0.2, 0.12, 0.06)),
    "cylinder": (lambda: tube((0, 0, 0), (0, 0, 2), 1, 96), (0.25, 0.15, 0.08)),
    "cone": (lambda: creation.cone(1, 2, sections=96), (0.25, 0.15, 0.06)),
    "torus": (lambda: creation.torus(0.7, 0.3, 128, 64), (0.12, 0.08, 0.04)),
    "pipes": (
        lambda: plus(tube((0, 0, -1.2), (0, 0, 1.2), 0.4), tube((-1, 0, 0), (1, 0, 0), 0.3)),
        (0.15, 0.09, 0.045),
    ),
    "stacked": (
        lambda: plus(tube((0, 0, -0.6), (0, 0, 0), 1, 96), tube((0, 0, -0.1), (0, 0, 0.6), 0.5)),
        (0.2, 0.12, 0.06),
    ),
    "gear": (gear, (0.1, 0.06, 0.035)),
    "plate": (lambda: block((0, 0, 0), (2, 2, 0.3)), (0.15, 0.1, 0.05)),
    "outside of a ball": (lambda: minus(block((-2, -2, -2), (2, 2, 2)), creation.icosphere(4)), (0.4, 0.25, 0.14)),
    "outside of a cube": (
        lambda: minus(block((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2)), creation.box((1, 1, 1))),
        (0.25, 0.15, 0.1),
    ),
    "outside of a wing": (wing, (0.2, 0.1, 0.08)),
    "bracket": (bracket, (0.15, 0.1, 0.05)),
    "stair": (
        lambda: plus(block((0, 0, 0), (3, 1, 1)), block((1, 0, 0), (3, 2, 1)), block((1, 0, 0), (3, 1, 2))),
        (0.25, 0.15, 0.08),
    ),
    "gyroid": (gyroid, (0.35, 0.12, 0.09)),
    "dirty": (dirty, (0.15, 0.1, 0.05)),
}


def bent_pipe() -> trimesh.Trimesh:
    """Return a pipe with a bend of 90 degrees between straight parts."""
    import shapely

    turn = np.linspace(0, math.pi / 2, 33)
    path = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    path = np.vstack([(1, -1, 0), path, (-1, 1, 0)])
    return creation.sweep_polygon(shapely.Point(0, 0).buffer(0.25, quad_segs=12), path)


LAYERED = {
    **SHAPES,
    "ball": (lambda: creation.icosphere(4), (0.2, 0.12, 0.07)),
    "bent pipe": (bent_pipe, (0.08, 0.05, 0.03)),
}
"""The same and others, for layers along their walls."""


def random_part(seed: int) -> trimesh.Trimesh:
    """Return booleans of two to five random boxes, balls and cylinders that is one piece."""
    rng = np.random.default_rng(seed)

    def primitive() -> trimesh.Trimesh:
        center, size = rng.uniform(-0.5, 0.5, 3), rng.uniform(0.5, 1.2, 3)
        kind = rng.integers(3)
        if kind == 0:
            made = creation.box(size)
        elif kind == 1:
            made = creation.icosphere(4, radius=size[0] / 2)
        else:
            made = creation.cylinder(size[0] / 2, 1.5 * size[1], sections=64)
        if rng.random() < 0.5:
            made.apply_transform(transformations.random_rotation_matrix(rng.random(3)))
        made.apply_translation(center)
        return made

    part = primitive()
    for _ in range(rng.integers(1, 5)):
        other = primitive()
        new = plus(part, other) if rng.random() < 0.6 else minus(part, other)
        if len(new.faces) and new.volume > 0.3 * part.volume:
            part = max(new.split(), key=lambda piece: piece.volume) if new.body_count > 1 else new
    return part


def solid_of(part: trimesh.Trimesh, **options: Any) -> clvoro.Solid:
    """Return the solid of a surface."""
    return clvoro.Solid(part.vertices, part.faces, **options)
