"""Input of `fuzz.py`: boxes, polygons, generators and layers of all kinds, also absurd ones."""

from __future__ import annotations

import numpy as np
import shapely

import clvoro
from tests.reference import shores


def some_box(rng: np.random.Generator, dim: int = 2, wild: bool = True) -> clvoro.Box:
    """A box of any place and unit; `wild`: also long, thin, huge or far away."""
    if not wild:
        extent = 10 ** rng.uniform(-0.4, 0.4, dim) * 2.0 ** rng.integers(-30, 30)
        lower = rng.choice([0, -0.5, 3]) * extent
        return clvoro.Box(tuple(lower), tuple(lower + extent))
    extent = np.ones(dim) if rng.random() < 0.3 else 10 ** rng.uniform(-1, 1, dim)
    if rng.random() < 0.1:
        extent *= 10.0 ** rng.uniform(-4, 4, dim)
    if rng.random() < 0.2:
        extent *= 10.0 ** rng.choice([rng.uniform(-50, 50), rng.uniform(-300, 300)])
    far = rng.choice([0, 0, 0, 1, 100, 1e6])
    lower = far * rng.uniform(-1, 1, dim) * extent.max()
    with np.errstate(all="ignore"):
        return clvoro.Box(tuple(lower), tuple(lower + extent))


SHAPES = {2: [(1, 1), (1, 0.75), (0.625, 1), (1, 0.3125)], 3: [(1, 1, 1), (1, 0.75, 0.75), (0.6875, 1, 0.5625)]}
"""Extents of most periodic boxes: kernels are built for each shape, and exact in binary whatever the unit."""


def some_periodic_box(rng: np.random.Generator, dim: int, wild: bool = True) -> clvoro.Box:
    periodic = rng.random(dim) < 0.6
    periodic[rng.integers(dim)] = True
    if wild or rng.random() < 0.1:
        box = some_box(rng, dim, wild)
        lower, upper = box.lower, box.upper
    else:
        extent = np.array(SHAPES[dim][rng.integers(len(SHAPES[dim]))]) * 2.0 ** rng.integers(-30, 30)
        lower = float(rng.choice([0, -0.5, 3])) * extent
        upper = lower + extent
    return clvoro.Box(tuple(lower), tuple(upper), periodic=tuple(periodic.tolist()))


def some_points(rng: np.random.Generator, dim: int = 2) -> np.ndarray:
    """Generators in the unit box."""
    n = int(rng.choice([1, 2, 3, rng.integers(4, 13), rng.integers(13, 300), rng.integers(300, 2500)]))
    if dim == 3:
        n = min(n, 200)
    return KINDS[rng.choice(list(KINDS))](rng, n, dim)


def uniform(rng, n, dim):
    return rng.random((n, dim))


def graded(rng, n, dim):
    return rng.random((n, dim)) ** rng.uniform(1, 12)


def clusters(rng, n, dim):
    """Around one to three places, as wide as anything from the box to a few ulps."""
    centers = rng.random((3, dim))
    width = 10.0 ** rng.uniform(-17, 0, 3)
    which = rng.integers(0, rng.integers(1, 4), n)
    return np.clip(centers[which] + width[which, None] * rng.standard_normal((n, dim)), 0, 1)


def ulps(rng, n, dim):
    """Groups of four points that are a few ulps apart."""
    x = np.repeat(rng.random((max(1, n // 4), dim)), 4, axis=0)
    steps = rng.integers(-2, 3, x.shape)
    return np.clip(x + steps * np.spacing(x), 0, 1)


def lattice(rng, n, dim):
    """A lattice, also up to the walls, sheared, or disturbed by round-off."""
    side = max(1, round(n ** (1 / dim)))
    line = np.arange(side) / max(side - 1, 1) if rng.random() < 0.4 else (np.arange(side) + 0.5) / side
    x = np.stack(np.meshgrid(*[line] * dim), axis=-1).reshape(-1, dim)
    if rng.random() < 0.3:
        x[:, 0] = (x[:, 0] + rng.choice([0.25, 0.5]) * x[:, 1]) % 1
    if rng.random() < 0.5:
        x = x + 10.0 ** rng.uniform(-17, -6) * rng.standard_normal(x.shape)
    return np.clip(x, 0, 1)


def circle(rng, n, dim):
    n = min(n, 400)
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False) + rng.random()
    x = np.full((n, dim), 0.5)
    radius = 10.0 ** rng.uniform(-9, np.log10(0.5))
    x[:, 0] += radius * np.cos(angle)
    x[:, 1] += radius * np.sin(angle)
    return np.clip(x if rng.random() < 0.5 else np.vstack([x, np.full(dim, 0.5)]), 0, 1)


def line(rng, n, dim):
    """On a line, along an axis or not, with and without others beside it."""
    a, b = rng.random((2, dim))
    if rng.random() < 0.5:
        b[1:] = a[1:]
    x = a + np.linspace(0, 1, n)[:, None] * (b - a)
    return x if rng.random() < 0.5 else np.vstack([x, rng.random((5, dim))])


def walls(rng, n, dim):
    """Generators on walls, in corners, and one ulp beside them."""
    x = rng.random((n, dim))
    put = rng.random((n, dim)) < 0.6
    x[put] = rng.choice([0.0, 1.0, np.finfo(float).eps, 1 - np.finfo(float).eps / 2, 1e-300], put.sum())
    return x


def repeated(rng, n, dim):
    x = rng.random((n, dim))
    x[rng.integers(0, n)] = x[rng.integers(0, n)]
    return x


KINDS = {f.__name__: f for f in (uniform, graded, clusters, ulps, lattice, circle, line, walls, repeated)}


def around(rng: np.random.Generator, dim: int) -> np.ndarray:
    """Generators in the unit box around a point or an axis: rings, stacks of them, shells; alone or among others."""
    count = int(2 ** rng.uniform(1, 11 if dim == 2 else 8.5))
    copies = int(rng.choice([1, 1, 2, 5]))
    radii = 10.0 ** rng.uniform(-3, np.log10(0.5), copies)
    shells = []
    for radius in radii:
        turn = 2 * np.pi * np.arange(count) / count + rng.random() * (rng.random() < 0.5)
        unit = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        if dim == 3 and rng.random() < 0.5:
            unit = np.pad(unit, ((0, 0), (0, 1)))
        elif dim == 3:
            unit = rng.standard_normal((count, 3))
            unit /= np.linalg.norm(unit, axis=1)[:, None]
        shells.append(0.5 + radius * unit)
    x = np.concatenate(shells)
    if dim == 3 and rng.random() < 0.5:
        layers = int(rng.integers(1, 4))
        x = np.concatenate([x * [1, 1, 0.5 / layers] + [0, 0, k / layers] for k in range(layers)])
    if rng.random() < 0.3:
        x = np.vstack([x, np.full(dim, 0.5)])
    if rng.random() < 0.3:
        x = np.vstack([x, rng.random((30, dim))])
    return x


def placed(rng: np.random.Generator, box: clvoro.Box, real: str = "float64", wild: bool = True) -> np.ndarray:
    """Return points in `box` that are distinct in the precision `real`; `wild`: also coincident ones."""
    if wild and rng.random() < 0.1:
        return NONSENSE[rng.integers(len(NONSENSE))]
    x = some_points(rng, box.dim) * box.extent + np.array(box.lower)
    if any(box.periodic) and rng.random() < 0.2:
        x = x + rng.integers(-3, 4, x.shape) * np.where(box.periodic, box.extent, 0.0)
    elif not wild or rng.random() < 0.95:
        x = np.clip(x, *(np.where(box.periodic, (-np.inf, np.inf)[k], c) for k, c in enumerate((box.lower, box.upper))))
    x = x.astype(np.float32) if wild and rng.random() < 0.1 else x
    if wild and rng.random() < 0.6:
        return x
    _, first = np.unique(box.place(x, np.dtype(real)), axis=0, return_index=True)
    return x[np.sort(first)]


NONSENSE = [
    None,
    "points",
    np.zeros((0, 2)),
    np.zeros((3, 4)),
    [[1, 2], [3]],
    np.array([["a", "b"]]),
    3.0,
    np.full((2, 2), np.nan),
    np.array([[np.inf, 0.0]]),
    np.zeros((2, 2), complex),
    np.zeros((4, 2), object),
    np.zeros((2, 2, 2)),
    {"x": 1},
]


def some_polygon(rng: np.random.Generator) -> clvoro.Polygon:
    """Stars, combs, slits, blocks of a lattice, with holes and in pieces, coasts; turned, stretched, far away."""
    kind = rng.integers(0, 7)
    seed = int(rng.integers(2**31))
    if kind == 0:
        shape = shapely.Polygon(shores.star(int(rng.integers(3, 60)), seed, (0.5, 0.5), 0.5))
    elif kind == 1:
        depth, gap = rng.uniform(0.05, 0.97, 2)
        shape = shapely.Polygon(shores.comb(int(rng.integers(1, 40)), depth, gap))
    elif kind == 2:
        make = shores.slit if rng.random() < 0.5 else shores.spit
        shape = shapely.Polygon(make(10 ** rng.uniform(-12, -1)))
    elif kind == 3:
        shape = shores.blocks(rng, int(rng.integers(2, 9)))
    elif kind == 4:
        shape = shapely.Polygon(shores.coast(2 ** int(rng.integers(4, 10)), seed))
    else:
        made = shores.POLYGONS if kind == 5 else shores.TOUCHING
        shape = made[str(rng.choice(list(made)))]().geometry
    low = np.array(shape.bounds[:2])
    extent = np.array(shape.bounds[2:]) - low
    for _ in range(rng.integers(0, 4) if rng.random() < 0.4 else 0):
        center, radius = low + rng.uniform(0.1, 0.9, 2) * extent, 10 ** rng.uniform(-6, -0.5)
        shape = shape.difference(shapely.Polygon(shores.star(int(rng.integers(3, 9)), seed, center, radius)))
    if rng.random() < 0.3:
        a = rng.choice([np.pi / 4, np.pi / 6, rng.uniform(0, 6)])
        turn = np.array([(np.cos(a), np.sin(a)), (-np.sin(a), np.cos(a))])
        shape = shapely.transform(shape, lambda x: x @ turn)
    if rng.random() < 0.3:
        scale = 10.0 ** rng.uniform(-2, 2, 2) if rng.random() < 0.5 else 10.0 ** rng.uniform(-30, 30)
        shift = rng.choice([0, 1, 1e4]) * rng.uniform(-1, 1, 2)
        shape = shapely.transform(shape, lambda x: (x + shift) * scale)
    return clvoro.Polygon.from_shapely(shape)


def placed_in_polygon(rng: np.random.Generator, domain: clvoro.Polygon) -> np.ndarray:
    """Points of the same kinds as in the unit square, on the boundary and beside it."""
    low, extent = np.array(domain.lower), domain.extent
    kind = rng.random()
    if kind < 0.3:
        x = shores.lattice(int(rng.integers(1, 20)), rng.choice(["centers", "corners", "hexagons"]))
    elif kind < 0.5:
        v = domain.oriented.vertices
        t = rng.choice([0, 0.25, 0.5, rng.random()], (len(v), 1))
        x = (v + t * (v[domain.oriented.next_vertex] - v) - low) / extent
        x = np.concatenate([x, rng.random((rng.integers(0, 30), 2))])
    else:
        x = some_points(rng)
    if rng.random() < 0.2:
        x = x + 10.0 ** rng.uniform(-17, -5) * rng.standard_normal(x.shape)
    x = low + x * extent
    inside = x[domain.contains(x)] if rng.random() < 0.98 else x
    return np.unique(inside, axis=0) if len(inside) else domain.inner_points()[:1]


def some_layers(
    rng: np.random.Generator, domain: clvoro.Box | clvoro.Polygon, wild: bool = True
) -> list[clvoro.Layers]:
    """One to three layers, mostly of up to some thousand generators; `wild`: also too thick, thin, or without walls."""
    if isinstance(domain, clvoro.Polygon):
        walls = np.arange(len(domain.vertices))
        edges = shapely.boundary(domain.geometry).length
    else:
        walls = np.flatnonzero(np.repeat(~np.array(domain.periodic), 2) | wild)
        edges = 2 * domain.extent.sum()
    number = len(walls)
    room, made = domain.measure / edges, []
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        width = min(edges / 10 ** rng.uniform(1, 3), np.inf if wild else 0.3 * room)
        count, growth = int(rng.integers(1, 6)), float(rng.choice([1.0, 1.1, 1.2, 1.5, 3.0]))
        options = {
            "height": min(width, 0.5 * room) * 10 ** rng.uniform(-2, 0),
            "count": count,
            "growth": growth,
            "spacing": width if rng.random() < 0.7 else None,
        }
        if not wild:
            thickness = min(width, 0.2 * room) * 10 ** rng.uniform(-1, 0)
            options["height"] = thickness / (growth ** np.arange(count)).sum()
        if rng.random() < 0.8:
            first = int(rng.integers(number))
            some = range(first, min(number, first + int(rng.integers(1, 30))))
            chosen = np.flatnonzero(rng.random(number) < 0.5)
            some = some if rng.random() < 0.5 or not (wild or len(chosen)) else chosen
            options["edges"] = walls[np.array(some, int)]
        if wild and rng.random() < 0.4:
            strange = {
                "height": lambda: edges * 10.0 ** rng.uniform(-300, 300),
                "count": lambda: int(rng.choice([0, 50, 10**6, 10**18])),
                "growth": lambda: rng.choice([1 + 1e-15, 1e3, 1e300, 0.5, np.nan]),
                "spacing": lambda: edges * 10.0 ** rng.uniform(-300, 300),
                "edges": lambda: [[], [len(walls)], [-1], [0, 0], 3][rng.integers(5)],
            }
            name = str(rng.choice(list(strange)))
            options[name] = strange[name]()
        made.append(clvoro.Layers(**options))
    return made
