"""Domains with walls that solvers find hard: corners, slits, fine boundaries, layers; and boxes in 3D."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import shapely
from _common import CUBE, test_field

import clvoro
from clvoro import sizing
from clvoro.curves import Curve


class Setup(NamedTuple):
    """What to adapt: domain, size field, and further options of `Adapter.run`."""

    domain: Any
    size: Any
    options: dict[str, Any]


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])


def _turned(k: int) -> tuple[np.ndarray, np.ndarray]:
    angle = np.arange(k) * (2 * np.pi / k)
    return np.cos(angle), np.sin(angle)


def lake() -> Setup:
    """Return a lake of five lobes, 400 edges, with a triangular island."""
    c, s = _turned(400)
    r = 0.4 + 0.08 * np.sin(5 * np.arange(400) * (2 * np.pi / 400))
    shore = 0.5 + np.column_stack([r * c, r * s])
    island = [(0.42, 0.45), (0.6, 0.42), (0.52, 0.6)]
    domain = clvoro.Polygon(shore, [island], names={"island": [400, 401, 402]})
    size = sizing.Distance(domain.boundary("island"), h_min=0.01, slope=0.1, h_max=0.025)
    return Setup(domain, size, {})


def _shore(k: int, seed: int, roughness: float) -> np.ndarray:
    """Return a fractal ring about the origin of `k` edges, a power of two, of mean radius 1, by displaced midpoints."""
    rng = np.random.default_rng(seed)
    r = np.zeros(2)
    while len(r) <= k:
        middle = (r[1:] + r[:-1]) / 2
        middle += 0.3 * roughness ** np.log2(len(r)) * rng.standard_normal(len(middle))
        r = np.append(np.column_stack([r[:-1], middle]).ravel(), r[-1])
    c, s = _turned(k)
    return np.exp(0.5 * r[:-1, None]) * np.column_stack([c, s])


def small_coast() -> Setup:
    """Return a bay of 300 edges with six islands of 21 edges each."""
    rng = np.random.default_rng(4)
    c, s = _turned(300)
    bay = (1 + 0.15 * s + 0.02 * rng.standard_normal(300))[:, None] * np.column_stack([c, s])
    bay = shapely.Polygon(bay).buffer(0)
    c, s = _turned(21)
    islands = []
    for k in range(6):
        r = 0.1 * (1 + 0.25 * rng.standard_normal(21)).clip(0.5, 1.5)
        center = 0.55 * np.array([np.cos(k * np.pi / 3), np.sin(k * np.pi / 3)])
        islands.append(center + r[:, None] * np.column_stack([c, s]))
    domain = clvoro.Polygon(np.array(bay.exterior.coords), islands)
    return Setup(domain, 0.035, {})


def large_coast() -> Setup:
    """Return a coastline of 4,096 edges, with eight islands of 256 and bays that are narrower than a cell."""
    shore = _shore(4096, 7, 0.62)
    sea = shapely.Polygon(shore)
    for k in range(8):
        island = 0.09 * _shore(256, 20 + k, 0.6)
        place = 0.5 * np.array([np.cos(k * np.pi / 4), np.sin(k * np.pi / 4)])
        sea = sea.difference(shapely.Polygon(island + place).buffer(0))
    sea = max(shapely.get_parts(sea), key=lambda part: part.area)
    return Setup(clvoro.Polygon.from_shapely(sea), 0.03, {})


def simplified(coast: Callable[[], Setup]) -> Setup:
    """Return a coast without what is finer than 1.5 cells."""
    domain, size, options = coast()
    return Setup(domain.simplified(1.5 * size), size, options)


def channel(layers: bool = False) -> Setup:
    """Return the channel of Schäfer and Turek with its circle, here of 180 edges."""
    c, s = _turned(180)
    circle = 0.05 * np.column_stack([c, s]) + (0.2, 0.2)
    names = {"inlet": 3, "outlet": 1, "walls": [0, 2], "cylinder": range(4, 184)}
    domain = clvoro.Polygon(_rectangle(0, 0, 2.2, 0.41), [circle], names=names)
    size = sizing.Distance(sizing.Circle((0.2, 0.2), 0.05), h_min=0.006, slope=0.12, h_max=0.03)
    rows = clvoro.Layers(0.001, count=5, growth=1.25, spacing=0.005, edges="cylinder")
    return Setup(domain, size, {"layers": rows} if layers else {})


def _far_field(sections: list[Curve], first_layer: float, count: int) -> Setup:
    """Return wing sections in a disc, with layers if the first one has a height."""
    far = clvoro.curves.circle((0.5, 0), 6, name="far")
    domain = clvoro.Polygon(far, sections)
    size = sizing.Distance(sections, h_min=0.01, slope=0.15, h_max=0.6)
    if not first_layer:
        return Setup(domain, size, {})
    edges = [wing.name for wing in sections]
    rows = clvoro.Layers(first_layer, count=count, growth=1.35, spacing=0.004, edges=edges)
    return Setup(domain, size, {"layers": rows})


def wing(first_layer: float = 0.0) -> Setup:
    """Return a NACA 0012 section in a far field."""
    return _far_field([clvoro.curves.naca("0012", name="wing")], first_layer, 8)


def three_wings(first_layer: float = 0.0) -> Setup:
    """Return a slat, a main wing and a flap in a far field."""
    sections = [
        clvoro.curves.naca("0010", 0.18, (-0.2, -0.1), 25, name="slat"),
        clvoro.curves.naca("0012", 0.8, name="main"),
        clvoro.curves.naca("0010", 0.3, (0.83, -0.05), -30, name="flap"),
    ]
    return _far_field(sections, first_layer, 8)


def l_shape() -> Setup:
    """Return a square without its upper right quarter."""
    ring = [(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)]
    return Setup(clvoro.Polygon(ring), 0.025, {})


def t_shape() -> Setup:
    """Return a T."""
    ring = [(0.35, 0), (0.65, 0), (0.65, 0.6), (1, 0.6), (1, 1), (0, 1), (0, 0.6), (0.35, 0.6)]
    return Setup(clvoro.Polygon(ring), 0.025, {})


def comb() -> Setup:
    """Return a square with eight cuts from above, as wide as the teeth between them."""
    cuts = [
        ((k + 0.5 + side * 0.25) / 8, height)
        for k in reversed(range(8))
        for side, height in ((1, 1), (1, 0.3), (-1, 0.3), (-1, 1))
    ]
    return Setup(clvoro.Polygon([(0, 0), (1, 0), (1, 1), *cuts, (0, 1)]), 0.02, {})


def gear() -> Setup:
    """Return the oil around a gear of 36 teeth, which are three cells wide."""
    k = np.arange(36 * 4)
    angle = (k // 4 + np.array([0.0, 0.12, 0.5, 0.62])[k % 4]) * (2 * np.pi / 36)
    r = np.array([0.3, 0.34, 0.34, 0.3])[k % 4]
    teeth = np.column_stack([r * np.cos(angle), r * np.sin(angle)])
    c, s = _turned(240)
    return Setup(clvoro.Polygon(0.5 * np.column_stack([c, s]), [teeth]), 0.01, {})


def slit() -> Setup:
    """Return a square with a wedge cut into it, 0.001 wide."""
    ring = [(0, 0), (1, 0), (1, 1), (0.5005, 1), (0.5, 0.3), (0.4995, 1), (0, 1)]
    return Setup(clvoro.Polygon(ring), 0.03, {})


def needle() -> Setup:
    """Return a square with a hole as thin as a needle, 0.5 long and 0.002 wide."""
    hole = [(0.25, 0.45), (0.5, 0.499), (0.75, 0.55), (0.5, 0.501)]
    return Setup(clvoro.Polygon(_rectangle(0, 0, 1, 1), [hole]), 0.03, {})


def step() -> Setup:
    """Return a backward-facing step."""
    ring = [(-2, 0), (0, 0), (0, -1), (10, -1), (10, 1), (-2, 1)]
    domain = clvoro.Polygon(ring, names={"inlet": 5, "outlet": 3, "step": [1]})
    size = sizing.Distance(sizing.Segment((0, 0), (0.5, 0)), h_min=0.04, slope=0.05, h_max=0.2)
    return Setup(domain, size, {})


def city() -> Setup:
    """Return the streets around nine houses, some of them L-shaped, at odd angles."""
    rng = np.random.default_rng(3)
    houses = []
    for i in range(3):
        for j in range(3):
            a, b = rng.uniform(0.2, 0.3, 2)
            house = np.array([(-a, -b), (a, -b), (a, b), (-a, b)]) / 2
            if (i + j) % 2:
                house = np.array([(-a, -b), (a, -b), (a, 0), (0, 0), (0, b), (-a, b)]) / 2
            t = rng.uniform(0, np.pi / 2)
            turn = np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
            houses.append(house @ turn + (0.25 + 0.45 * i, 0.25 + 0.45 * j))
    return Setup(clvoro.Polygon(_rectangle(0, 0, 1.4, 1.4), houses), 0.025, {})


def ponds() -> Setup:
    """Return a lake and four ponds beside it, of 1111 and 44 cells each."""
    corners = [(0.0, 0.0, 1.0), *((1.2, 0.25 * k, 0.2) for k in range(4))]
    pieces = [[_rectangle(x, y, x + a, y + a)] for x, y, a in corners]
    return Setup(clvoro.Polygon.from_pieces(pieces), 0.03, {})


def box() -> Setup:
    """Return a plain box in 2D."""
    return Setup(clvoro.Box((0, 0), (2.5, 1.5)), test_field("F1"), {})


def periodic_channel() -> Setup:
    """Return a channel in 2D that is periodic along x."""
    domain = clvoro.Box((0, 0), (2, 1), periodic=(True, False))
    return Setup(domain, sizing.Expression("0.015 + 0.06 * (y < 0.5 ? y : 1 - y)"), {})


def periodic_channel_3d() -> Setup:
    """Return a channel in 3D that is periodic along x and y."""
    domain = clvoro.Box((0, 0, 0), (2, 1, 1), periodic=(True, True, False))
    return Setup(domain, sizing.Expression("0.06 + 0.1 * (z < 0.5 ? z : 1 - z)"), {})


def periodic_tubes() -> Setup:
    """Return a bank of four tubes in a box that is periodic along both axes: on its corner, two seams, and inside."""
    tubes = [clvoro.curves.circle(center, 0.2) for center in ((0, 0), (1, 0), (0, 0.5), (1, 0.5))]
    domain = clvoro.Box((0, 0), (2, 1), periodic=True).without(tubes, names={"tubes": range(4)})
    return Setup(domain, sizing.Distance(domain.holes, h_min=0.02, growth=1.2, h_max=0.06), {})


def periodic_cascade() -> Setup:
    """Return two blunt NACA 4424 sections in a channel that is periodic along y; one is on the seam."""
    sections = [clvoro.curves.naca("4424", 1, (0.5, y), 20, "blunt") for y in (0.1, 0.7)]
    names = {"inlet": "xMin", "outlet": "xMax"}
    domain = clvoro.Box((0, -0.6), (2.5, 0.6), (False, True), names).without(sections, names={"wings": range(2)})
    return Setup(domain, sizing.Distance(domain.holes, h_min=0.005, growth=1.2, h_max=0.06), {})


def periodic_pores() -> Setup:
    """Return the space between five grains in a square that is periodic along both axes."""
    grains = [((0.1, 0.1), 0.16), ((0.55, 0.05), 0.18), ((0.3, 0.5), 0.2), ((0.8, 0.45), 0.15), ((0.75, 0.78), 0.13)]
    domain = clvoro.Box((0, 0), (1, 1), periodic=True).without([clvoro.curves.circle(*grain) for grain in grains])
    return Setup(domain, sizing.Distance(domain.holes, h_min=0.012, growth=1.2, h_max=0.03), {})


def sphere(name: str) -> Callable[[], Setup]:
    """Return a cube with the field S1, S2 or S3."""
    return lambda: Setup(CUBE, test_field(name), {})


def spheres() -> Setup:
    """Return a cube with sizes by the distance to the nearer of two spheres, with a kink."""
    both = [sizing.Distance(sizing.Ball(c, 0.2), h_min=0.04, slope=0.3) for c in ((0.3, 0.3, 0.5), (0.7, 0.6, 0.5))]
    return Setup(CUBE, sizing.minimum(*both), {})


WALLED: dict[str, Callable[[], Setup]] = {
    "box": box,
    "lake": lake,
    "bay": small_coast,
    "coast": large_coast,
    "bay, simplified": lambda: simplified(small_coast),
    "coast, simplified": lambda: simplified(large_coast),
    "channel": channel,
    "channel, layers": lambda: channel(layers=True),
    "wing": wing,
    "wing, layers": lambda: wing(1e-4),
    "three wings": three_wings,
    "three wings, layers": lambda: three_wings(1e-4),
    "L": l_shape,
    "T": t_shape,
    "comb": comb,
    "gear": gear,
    "slit": slit,
    "needle": needle,
    "step": step,
    "city": city,
    "ponds": ponds,
    "periodic channel": periodic_channel,
    "periodic tubes": periodic_tubes,
    "periodic cascade": periodic_cascade,
    "periodic pores": periodic_pores,
    "periodic channel 3D": periodic_channel_3d,
    "S1": sphere("S1"),
    "S2": sphere("S2"),
    "S3": sphere("S3"),
    "spheres": spheres,
}
