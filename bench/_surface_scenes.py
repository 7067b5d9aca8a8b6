"""Domains with surfaces inside: sizes of cells, and the volumes of the regions that are known."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy

from clvoro import Box, Solid, sizing

Arrays = tuple[np.ndarray, np.ndarray]
"""Vertices (v, 3) and triangles (t, 3)."""
Scene = tuple[Any, Any, dict[str, float]]
"""The domain, its sizes, and volumes of regions by name."""
CUBE = Box((0, 0, 0), (1, 1, 1))


def joined(*parts: Arrays) -> Arrays:
    """Return several surfaces as one."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    triangles = [triangles + k for (_, triangles), k in zip(parts, first, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(triangles)


def sheet(*corners: Any) -> Arrays:
    """Return a plane quadrilateral."""
    return np.array(corners, float), np.array([(0, 1, 2), (0, 2, 3)])


def fault(through: Any, along: Any, down: Any) -> Arrays:
    """Return two rectangles that meet in the line through -+ along and reach to both sides by the vector `down`."""
    a, b = np.subtract(through, along), np.add(through, along)
    return joined(*(sheet(a, b, b + way, a + way) for way in (np.asarray(down), -np.asarray(down))))


def bed(height: Callable[[np.ndarray, np.ndarray], np.ndarray], width: float, n: int = 40) -> Arrays:
    """Return a surface z = height(x, y) over a square with sides `width`, and a little beyond it."""
    x, y = np.meshgrid(*2 * [np.linspace(-0.05 * width, 1.05 * width, n)], indexing="ij")
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return np.column_stack([x.ravel(), y.ravel(), height(x, y).ravel()]), triangles


def lens_at(center: Any, radius: float, depth: float, rings: int = 24) -> tuple[Arrays, float]:
    """Return two caps of balls that meet in a sharp rim, and the volume between them."""
    k = np.repeat(np.arange(1, rings + 1), 6 * np.arange(1, rings + 1))
    turn = 2 * math.pi * np.concatenate([np.arange(6 * i) / (6 * i) for i in range(1, rings + 1)])
    x = np.vstack([(0, 0), radius / rings * np.column_stack([k * np.cos(turn), k * np.sin(turn)])])
    triangles = scipy.spatial.Delaunay(x).simplices
    ball = (radius**2 + depth**2) / (2 * depth)
    z = np.sqrt(ball**2 - (x**2).sum(axis=1)) - (ball - depth)
    z[-6 * rings :] = 0
    caps = [(np.column_stack([x, side * z]) + center, triangles) for side in (1, -1)]
    return joined(*caps), math.pi * depth * (3 * radius**2 + depth**2) / 3


def boxes(*corners: Any) -> dict[str, Solid]:
    """Return boxes between pairs of corners, by name."""
    return {f"part-{k + 1}": Solid.box(lower, upper) for k, (lower, upper) in enumerate(corners)}


def within(domain: Any, parts: dict[str, Solid], size: Any) -> Scene:
    """Return a scene of solids within a domain."""
    return domain.with_surfaces(parts), size, {name: part.measure for name, part in parts.items()}


def graded(domain: Any, h: float, most: float) -> Any:
    """Return sizes that grow from the surfaces inside."""
    return sizing.Distance(domain.borders.surface, h, growth=1.15, h_max=most)


def exchanger() -> Scene:
    """Return seven tubes in a shell, with ends beyond it."""
    turn = np.arange(6) * math.pi / 3
    places = [(0, 0), *zip(0.58 * np.cos(turn), 0.58 * np.sin(turn), strict=True)]
    tubes = {
        f"tube-{k + 1}": Solid.cylinder((-0.2, y, z), (1.2, y, z), 0.17, edge=0.03) for k, (y, z) in enumerate(places)
    }
    domain = Solid.cylinder((0, 0, 0), (1, 0, 0), 1, edge=0.05).with_surfaces(tubes)
    return domain, graded(domain, 0.05, 0.1), dict.fromkeys(tubes, math.pi * 0.17**2)


def pipes() -> Scene:
    """Return a pipe with a wall of steel in a duct."""
    pipe, wall = (Solid.cylinder((-0.2, 0.5, 0.5), (1.2, 0.5, 0.5), r, edge=0.03) for r in (0.2, 0.36))
    volumes = {"water": math.pi * 0.2**2, "steel": math.pi * (0.36**2 - 0.2**2)}
    return CUBE.with_surfaces({"water": pipe, "steel": wall}), 0.06, volumes


def porous() -> Scene:
    """Return a porous block across a part of a duct."""
    block = {"porous": Solid.box((1, 0, 0.25), (1.6, 1, 0.75))}
    return within(Box((0, 0, 0), (3, 1, 1)), block, 0.1)


def filter_in_pipe() -> Scene:
    """Return a porous zone between two planes across a pipe."""
    pipe, zone = Solid.cylinder((0, 0, 0), (3, 0, 0), 0.5, edge=0.03), Solid.box((1, -1, -1), (1.6, 1, 1))
    return pipe.with_surfaces({"porous": zone}), 0.1, {"porous": 0.6 * math.pi / 4}


def faults() -> Scene:
    """Return a reservoir with two faults that cross along a slanted line."""
    line = (0.5, 0.5, 0.5), (0.2, 0.8, -0.1)
    return CUBE.with_surfaces({"a": fault(*line, (0.45, 0.15, 1.5)), "b": fault(*line, (1.5, -0.3, -1.2))}), 0.08, {}


def narrow_faults() -> Scene:
    """Return two planes that cross at 33 degrees; the volumes between them are known."""
    parts = [fault((0.5, 0.5, 0.5), (0, 0.6, 0), (0.3 * side, 0, 1)) for side in (1, -1)]
    return CUBE.with_surfaces(parts), 0.08, {"region-0": 0.425, "region-3": 0.075}


def fault_network() -> Scene:
    """Return three steep planes that cross in pairs."""
    top = np.array([0.5, 0.5, 2.2])
    lines = 3 * (np.array([(0.2, 0.2, 0), (0.8, 0.3, 0), (0.4, 0.8, 0)]) - top)
    faults = {}
    for k, name in enumerate("abc"):
        one, other = lines[k], lines[k - 1]
        quarters = [(one, other), (other, -one), (-one, -other), (-other, one)]
        faults[name] = joined(*(sheet(top, top + u, top + u + v, top + v) for u, v in quarters))
    return CUBE.with_surfaces(faults), 0.07, {}


def slanted_porous() -> Scene:
    """Return a porous zone across a duct, at 60 degrees to its axis."""
    turn, x = math.radians(30), np.array([(x, y, z) for x in (-0.2, 0.2) for y in (-1, 1) for z in (-1, 1)])
    x = x @ np.array([(math.cos(turn), 0, -math.sin(turn)), (0, 1, 0), (math.sin(turn), 0, math.cos(turn))])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    zone = joined(*(sheet(*(x[list(side)] + (1.5, 0.5, 0.5))) for side in sides))
    return Box((0, 0, 0), (3, 1, 1)).with_surfaces({"porous": zone}), 0.08, {"porous": 0.4 / math.cos(turn)}


def battery() -> Scene:
    """Return six cells of a battery in a coolant above a cold plate."""
    parts = {
        f"cell-{3 * j + i + 1}": Solid.cylinder((x, y, 0.4), (x, y, 1.1), 0.17, edge=0.03)
        for j, y in enumerate((0.27, 0.73))
        for i, x in enumerate((0.3, 0.75, 1.2))
    }
    volumes = dict.fromkeys(parts, math.pi * 0.17**2 * 0.7)
    plate = {"plate": Solid.box((-0.1, -0.1, -0.1), (1.6, 1.1, 0.2))}
    domain = Box((0, 0, 0), (1.5, 1, 1.3)).with_surfaces(parts | plate)
    return domain, graded(domain, 0.05, 0.1), volumes | {"plate": 0.3}


def aquifer() -> Scene:
    """Return three beds with a lens of clay in the middle one."""
    lens, volume = lens_at((2, 2, 0.5), 0.8, 0.22)
    top = bed(lambda x, y: 0.8 + 0.04 * np.sin(1.5 * x) * np.cos(1.2 * y), 4)
    bottom = bed(lambda x, y: 0.18 + 0.03 * np.sin(1.1 * x + 1) * np.cos(1.7 * y), 4)
    domain = Box((0, 0, 0), (4, 4, 1)).with_surfaces({"top": top, "bottom": bottom, "clay": lens})
    near = sizing.Distance(sizing.Surface(*lens), 0.06, growth=1.2, h_max=0.15)
    return domain, near, {"clay": volume}


def heaters() -> Scene:
    """Return three heaters at odd places in a room."""
    corners = [((0.43, 0.31, 0.17), (0.82, 0.74, 0.62)), ((1.24, 0.41, 0.26), (1.77, 0.69, 0.53))]
    domain, _, volumes = within(
        Box((0, 0, 0), (3, 1.1, 1)), boxes(*corners, ((2.17, 0.27, 0.11), (2.63, 0.84, 0.68))), 0.1
    )
    return domain, graded(domain, 0.05, 0.12), volumes


def ring() -> Scene:
    """Return a torus whose tube has a radius of two cells."""
    ring = {"ring": Solid.torus((0.5, 0.5, 0.5), 0.28, 0.14, edge=0.02)}
    return within(CUBE, ring, 0.07)


SCENES: dict[str, Callable[[], Scene]] = {
    "heat exchanger": exchanger,
    "pipe with a wall": pipes,
    "porous block": porous,
    "filter in a pipe": filter_in_pipe,
    "two faults": faults,
    "narrow faults": narrow_faults,
    "fault network": fault_network,
    "slanted porous zone": slanted_porous,
    "battery": battery,
    "aquifer with a lens": aquifer,
    "heaters": heaters,
    "cube": lambda: within(CUBE, boxes(((0.3, 0.3, 0.3), (0.7, 0.7, 0.7))), 0.1),
    "touching": lambda: within(
        CUBE, boxes(((0.25, 0.3, 0.3), (0.5, 0.7, 0.7)), ((0.5, 0.3, 0.3), (0.75, 0.7, 0.7))), 0.1
    ),
    "baffle": lambda: (
        CUBE.with_surfaces(sheet((0.3, 0.3, 0.5), (0.7, 0.3, 0.5), (0.7, 0.7, 0.5), (0.3, 0.7, 0.5))),
        0.1,
        {},
    ),
    "ball": lambda: within(CUBE, {"ball": Solid.ball((0.5, 0.5, 0.5), 0.3)}, 0.1),
    "ring": ring,
}
