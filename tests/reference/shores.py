"""Polygonal domains that are hard to cut cells by, and generators in them."""

import numpy as np
import shapely

import clvoro

UNIT = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])


def star(k: int, seed: int = 11, center=(0.0, 0.0), radius=1.0) -> np.ndarray:
    """A star-shaped ring of `k` vertices."""
    rng = np.random.default_rng(seed)
    angle = (np.arange(k) + rng.uniform(0, 0.9, k)) * (2 * np.pi / k)
    r = radius * rng.uniform(0.5, 1.0, k)
    return np.column_stack([r * np.cos(angle), r * np.sin(angle)]) + center


def comb(teeth: int, depth: float = 0.8, gap: float = 0.5) -> np.ndarray:
    """The unit square with `teeth` cuts from above."""
    cuts = [
        ((k + 0.5 + side * gap / 2) / teeth, height)
        for k in reversed(range(teeth))
        for side, height in ((1, 1), (1, 1 - depth), (-1, 1 - depth), (-1, 1))
    ]
    return np.array([(0, 0), (1, 0), (1, 1), *cuts, (0, 1)], float)


def slit(width: float, depth: float = 0.7) -> np.ndarray:
    """The unit square with a wedge cut into it from above."""
    return np.array([(0, 0), (1, 0), (1, 1), (0.5 + width / 2, 1), (0.5, 1 - depth), (0.5 - width / 2, 1), (0, 1)])


def spit(width: float) -> np.ndarray:
    """The unit square with a needle on its right."""
    return np.array([(0, 0), (1, 0), (1, 0.5), (2, 0.5 + width), (1, 0.5 + 2 * width), (1, 1), (0, 1)])


def koch(level: int) -> np.ndarray:
    """Koch's snowflake, 3 * 4^level edges."""
    z = np.exp(2j * np.pi / 3 * np.arange(3))
    for _ in range(level):
        d = np.roll(z, -1) - z
        tip = d / 3 * np.exp(-1j * np.pi / 3)
        z = np.stack([z, z + d / 3, z + d / 3 + tip, z + 2 * d / 3], 1).ravel()
    return np.column_stack([z.real, z.imag])


def coast(k: int, seed: int = 0, rough: float = 0.8) -> np.ndarray:
    """A fractal island of `k` edges, a power of two, by displaced midpoints."""
    rng = np.random.default_rng(seed)
    r = np.zeros(2)
    while len(r) <= k:
        new = np.empty(2 * len(r) - 1)
        new[::2] = r
        new[1::2] = (r[1:] + r[:-1]) / 2
        new[1::2] += 0.25 * rough ** np.log2(len(r)) * rng.standard_normal(len(r) - 1)
        r = new
    angle = np.arange(k) * (2 * np.pi / k)
    return np.exp(0.5 * r[:-1, None]) * np.column_stack([np.cos(angle), np.sin(angle)])


def blocks(rng: np.random.Generator, side: int) -> object:
    """Some squares of a lattice, united: a shapely geometry."""
    taken = rng.random((side, side)) < 0.6
    taken[0, 0] = True
    boxes = [shapely.box(i / side, j / side, (i + 1) / side, (j + 1) / side) for i, j in np.argwhere(taken).tolist()]
    return shapely.union_all(boxes)


DIAMOND = np.array([(0.5, 0.0), (1, 0.5), (0.5, 1), (0, 0.5)])
POLYGONS = {
    "square": lambda: clvoro.Polygon(UNIT),
    "triangle": lambda: clvoro.Polygon([(0, 0), (1, 0), (0, 1)]),
    "far": lambda: clvoro.Polygon(star(9, 5, (3e4, -2e4), 2.0)),
    "star": lambda: clvoro.Polygon(star(12)),
    "burr": lambda: clvoro.Polygon(star(300)),
    "hole": lambda: clvoro.Polygon(UNIT, [star(7, 3, (0.5, 0.5), 0.3)]),
    "holes": lambda: clvoro.Polygon(
        UNIT, [star(7, 3, (0.3, 0.5), 0.2), star(9, 4, (0.75, 0.6), 0.15), star(9, 4, (0.6, 0.2), 1e-3)]
    ),
    "islands": lambda: clvoro.Polygon.from_pieces(
        [[UNIT, UNIT * 0.8 + 0.1], [UNIT * 0.6 + 0.2, UNIT * 0.4 + 0.3], [UNIT * 0.2 + 0.4]]
    ),
    "pieces": lambda: clvoro.Polygon.from_pieces([[star(9, 1)], [star(30, 2, (2.2, 0))], [star(5, 3, (0, 2.5), 0.01)]]),
    "comb": lambda: clvoro.Polygon(comb(5)),
    "fine comb": lambda: clvoro.Polygon(comb(60, 0.9, 0.7)),
    "slit": lambda: clvoro.Polygon(slit(1e-3)),
    "thin slit": lambda: clvoro.Polygon(slit(1e-9)),
    "spit": lambda: clvoro.Polygon(spit(1e-3)),
    "thin spit": lambda: clvoro.Polygon(spit(1e-9)),
    "koch": lambda: clvoro.Polygon(koch(4)),
    "frame": lambda: clvoro.Polygon(UNIT, [UNIT * 0.5 + 0.25]),
    "diamond": lambda: clvoro.Polygon(DIAMOND),
    "diamond hole": lambda: clvoro.Polygon(UNIT, [DIAMOND * 0.5 + 0.25]),
    "corner": lambda: clvoro.Polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)]),
    "stairs": lambda: clvoro.Polygon([(0, 0), (1, 0), *((1 - k / 8, (k + s) / 8) for k in range(8) for s in (0, 1))]),
    "straight": lambda: clvoro.Polygon(
        [(0, 0), (0.25, 0), (0.5, 0), (0.75, 0), (1, 0), (1, 0.5), (1, 1), (0.5, 1), (0, 1), (0, 0.125)]
    ),
}
"""What makes each of them."""
TOUCHING = {
    "holes": lambda: clvoro.Polygon(
        UNIT, [[(0.25, 0.25), (0.5, 0.5), (0.25, 0.75)], [(0.5, 0.5), (0.75, 0.25), (0.75, 0.75)]]
    ),
    "pieces": lambda: clvoro.Polygon.from_pieces([[UNIT * 0.5], [UNIT * 0.5 + 0.5]]),
    "blocks": lambda: clvoro.Polygon.from_shapely(blocks(np.random.default_rng(5), 6)),
}
"""Rings that touch in vertices, where cells may count as connected or not."""


def scattered(domain: clvoro.Polygon, n: int, seed: int = 0) -> np.ndarray:
    """`n` uniform points in `domain`."""
    rng = np.random.default_rng(seed)
    found = np.empty((0, 2))
    while len(found) < n:
        p = rng.uniform(domain.lower, domain.upper, (4 * n + 10, 2))
        found = np.vstack([found, p[domain.contains(p)]])
    return found[:n]


def lattice(side: int, kind: str = "centers") -> np.ndarray:
    """Points in the unit square: "centers" of squares, their "corners", or "hexagons"."""
    if kind == "hexagons":
        j, i = np.divmod(np.arange(4 * (side + 1) ** 2), 2 * (side + 1))
        p = np.column_stack([i + j % 2 / 2, j * np.sqrt(0.75)]) / side
        return p[(p <= 1).all(axis=1)]
    line = (np.arange(side) + 0.5) / side if kind == "centers" else np.arange(side + 1) / side
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
