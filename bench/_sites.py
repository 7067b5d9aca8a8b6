"""Domains with walls as users have them: a harbor, a river, tubes, streets, a motor, a mask."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import shapely
import shapely.affinity
from _walled import Setup
from shapely import LineString, Point, box

import clvoro
from clvoro import sizing


def _largest(shape: shapely.Geometry) -> clvoro.Polygon:
    """Return the largest part of a shape as a domain."""
    return clvoro.Polygon.from_shapely(max(shapely.get_parts(shape), key=lambda part: part.area))


def _rough(k: int, seed: int, center: tuple[float, float], radii: tuple[float, float], rough: float) -> np.ndarray:
    """Return a closed curve of `k` corners, a rough ellipse: a random Fourier series of falling amplitude."""
    rng = np.random.Generator(np.random.PCG64(seed))
    t = 2 * np.pi * np.arange(k) / k
    waves = np.arange(2, min(400, k // 4))
    phases = rng.uniform(0, 2 * np.pi, len(waves))
    bulge = np.cos(np.outer(t, waves) + phases) @ waves**-1.4
    r = np.exp(rough * bulge)[:, None]
    return np.array(center) + np.array(radii) * r * np.column_stack([np.cos(t), np.sin(t)])


def rough_lake(edges: int, rough: float = 0.08) -> clvoro.Polygon:
    """Return a lake with an island, within the box of the test fields, and around the circles of F2 and F3."""
    outer = _rough(7 * edges // 10, 1, (1.2, 0.75), (1.0, 0.6), rough)
    return clvoro.Polygon(outer, [_rough(edges - len(outer), 2, (1.5, 0.75), (0.12, 0.12), rough)])


def harbor() -> Setup:
    """Return a basin with three piers, a breakwater with a rounded head, a ramp, and twelve piles."""
    shore = [(0, 0), (900, 0), (900, 250), (1050, 330), (1050, 600), (700, 640), (0, 560)]
    piers = [box(x, 300, x + 24, 600) for x in (150, 300, 450)]
    breakwater = LineString([(900, 120), (760, 210), (640, 220)]).buffer(8, quad_segs=3)
    ramp = shapely.Polygon([(620, 0), (700, 60), (720, 0)])
    at = [(560 + 30 * i, 420 + 30 * j) for i in range(4) for j in range(3)]
    piles = [Point(place).buffer(3, quad_segs=4) for place in at]
    water = shapely.Polygon(shore).difference(shapely.union_all([*piers, breakwater, ramp, *piles]))
    size = sizing.Distance([sizing.Circle(place, 3) for place in at], h_min=2.5, slope=0.12, h_max=14)
    return Setup(_largest(water), size, {})


def river() -> Setup:
    """Return a reach of a river between surveyed banks, with two islands and the piers of a bridge."""
    rng = np.random.default_rng(11)
    s = np.linspace(0, 2000, 81)
    line = np.column_stack([s, 180 * np.sin(s / 300) + 60 * np.sin(s / 110 + 1)])
    along = np.gradient(line, axis=0)
    along /= np.hypot(*along.T)[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    half = (60 + 15 * np.sin(s / 170)) / 2
    left, right = (line + (k * (half + rng.normal(0, 2, 81)))[:, None] * across for k in (1, -1))

    def placed(k: int, ring: np.ndarray, off: float = 0.0) -> shapely.Geometry:
        x, y = ring.T[:, :, None]
        return shapely.Polygon(line[k] + off * across[k] + x * along[k] + y * across[k]).buffer(0)

    turn = np.arange(24) * (2 * np.pi / 24)
    oval = np.column_stack([np.cos(turn), np.sin(turn)])
    islands = [
        placed(k, oval * (a, b) * (1 + 0.15 * rng.normal(size=24))[:, None]) for k, a, b in ((20, 40, 9), (60, 30, 7))
    ]
    pier = np.array([(-9, 0), (-6, -1.5), (6, -1.5), (9, 0), (6, 1.5), (-6, 1.5)], float)
    piers = [placed(40, pier, off) for off in (-16, 0, 16)]
    reach = shapely.Polygon([*right, *left[::-1]]).buffer(0)
    domain = _largest(reach.difference(shapely.union_all([*islands, *piers])))
    return Setup(domain, sizing.FeatureSize(domain, 8, growth=1.2, h_min=1.0, h_max=7), {})


def tubes() -> Setup:
    """Return the staggered tubes of a heat exchanger, with layers."""
    pitch, radius, found = 0.03, 0.01, []
    for i in range(6):
        for j in range(4 - i % 2):
            center = (0.05 + i * pitch * 3**0.5 / 2, (j + 0.5 + 0.5 * (i % 2)) * pitch)
            found.append(clvoro.curves.circle(center, radius, name=f"tube-{i}-{j}"))
    domain = clvoro.Polygon([(0, 0), (0.28, 0), (0.28, 4 * pitch), (0, 4 * pitch)], found)
    size = sizing.Distance(found, h_min=0.0012, slope=0.15, h_max=0.004)
    edges = [tube.name for tube in found]
    return Setup(domain, size, {"layers": clvoro.Layers(1e-4, 6, 1.3, spacing=0.0012, edges=edges)})


def streets() -> Setup:
    """Return the air between blocks that two avenues cut at acute angles."""
    blocks = [box(40 + 115 * x, 30 + 88 * y, 130 + 115 * x, 96 + 88 * y) for x in range(3) for y in range(3)]
    avenues = [
        LineString([(-10, 20), (410, 290)]).buffer(11, cap_style="flat"),
        LineString([(60, 320), (330, -20)]).buffer(7, cap_style="flat"),
    ]
    houses = shapely.union_all(blocks).difference(shapely.union_all(avenues))
    houses = [house for house in shapely.get_parts(houses) if house.area > 120]
    domain = _largest(box(0, 0, 400, 300).difference(shapely.union_all(houses)))
    return Setup(domain, sizing.Distance(domain.boundary(), h_min=3, slope=0.12, h_max=8), {})


def motor() -> Setup:
    """Return the air gap of a motor with 24 slots that open by narrow necks."""
    neck = [(0.99, 0.02), (1.05, 0.02), (1.07, 0.06), (1.3, 0.09)]
    slot = shapely.Polygon([*neck, *((x, -y) for x, y in neck[::-1])])
    slots = [shapely.affinity.rotate(slot, 15 * k, origin=(0, 0)) for k in range(24)]
    bore = Point(0, 0).buffer(1, quad_segs=48).union(shapely.union_all(slots))
    domain = _largest(bore.difference(Point(0, 0).buffer(0.97, quad_segs=48)))
    return Setup(domain, sizing.FeatureSize(domain, 4, growth=1.2, h_min=0.006, h_max=0.03), {})


def mask(seed: int = 3) -> Setup:
    """Return the water of a raster, along the edges of its pixels, with cells of one and a half pixels."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(60) + 0.5, np.arange(60) + 0.5)
    height = np.zeros_like(x)
    for _ in range(40):
        a, b = rng.normal(0, 0.25, 2)
        height += np.cos(a * x + b * y + rng.uniform(0, 2 * np.pi)) / (1 + 8 * np.hypot(a, b))
    rows, columns = np.nonzero(height > np.quantile(height, 0.25))
    water = shapely.union_all(shapely.box(columns, rows, columns + 1, rows + 1))
    return Setup(_largest(water.simplify(0)), 1.5, {})


SITES: dict[str, Callable[[], Setup]] = {
    "harbor": harbor,
    "river": river,
    "tubes, layers": tubes,
    "streets": streets,
    "motor": motor,
    "mask": mask,
}
