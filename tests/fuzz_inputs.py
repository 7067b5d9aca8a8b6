"""What `fuzz.py` throws: generators, boxes, polygons, layers and size fields of all kinds, absurd ones among them."""

from __future__ import annotations

import numpy as np
import shapely

import clvoro
from clvoro import sizing
from tests import shores


def some_box(rng: np.random.Generator, dim: int = 2) -> clvoro.Box:
    extent = np.ones(dim) if rng.random() < 0.3 else 10 ** rng.uniform(-1, 1, dim)
    if rng.random() < 0.1:
        extent *= 10.0 ** rng.uniform(-4, 4, dim)
    if rng.random() < 0.2:
        extent *= 10.0 ** rng.choice([rng.uniform(-50, 50), rng.uniform(-300, 300)])
    far = rng.choice([0, 0, 0, 1, 100, 1e6])
    lower = far * rng.uniform(-1, 1, dim) * extent.max()
    with np.errstate(all="ignore"):
        return clvoro.Box(tuple(lower), tuple(lower + extent))


def some_periodic_box(rng: np.random.Generator, dim: int) -> clvoro.Box:
    box, periodic = some_box(rng, dim), rng.random(dim) < 0.6
    periodic[rng.integers(dim)] = True
    return clvoro.Box(box.lower, box.upper, periodic=tuple(periodic.tolist()))


def some_points(rng: np.random.Generator, dim: int = 2) -> np.ndarray:
    """Generators in the unit box."""
    n = int(
        rng.choice([1, 2, 3, rng.integers(4, 13), rng.integers(13, 300), rng.integers(300, 2500)])
    )
    if dim == 3:
        n = min(n, 200)
    return KINDS[rng.choice(list(KINDS))](rng, n, dim)


def uniform(rng, n, dim):
    return rng.random((n, dim))


def graded(rng, n, dim):
    return rng.random((n, dim)) ** rng.uniform(1, 12)


def clusters(rng, n, dim):
    """Around one to three places, as wide as anything from the box to a few ulps."""
    centres = rng.random((3, dim))
    width = 10.0 ** rng.uniform(-17, 0, 3)
    which = rng.integers(0, rng.integers(1, 4), n)
    return np.clip(centres[which] + width[which, None] * rng.standard_normal((n, dim)), 0, 1)


def ulps(rng, n, dim):
    """Steps of one ulp from a few places."""
    x = np.repeat(rng.random((max(1, n // 4), dim)), 4, axis=0)
    steps = rng.integers(-2, 3, x.shape)
    return np.clip(x + steps * np.spacing(x), 0, 1)


def lattice(rng, n, dim):
    """A lattice, also up to the walls, sheared, or disturbed by some roundings."""
    side = max(1, round(n ** (1 / dim)))
    line = (
        np.arange(side) / max(side - 1, 1) if rng.random() < 0.4 else (np.arange(side) + 0.5) / side
    )
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
    """On walls, in corners, and a rounding off them."""
    x = rng.random((n, dim))
    put = rng.random((n, dim)) < 0.6
    x[put] = rng.choice(
        [0.0, 1.0, np.finfo(float).eps, 1 - np.finfo(float).eps / 2, 1e-300], put.sum()
    )
    return x


def repeated(rng, n, dim):
    x = rng.random((n, dim))
    x[rng.integers(0, n)] = x[rng.integers(0, n)]
    return x


KINDS = {
    f.__name__: f for f in (uniform, graded, clusters, ulps, lattice, circle, line, walls, repeated)
}


def placed(rng: np.random.Generator, box: clvoro.Box) -> np.ndarray:
    """Some points in `box`; now and then what are no points."""
    if rng.random() < 0.03:
        return NONSENSE[rng.integers(len(NONSENSE))]
    x = some_points(rng, box.dim) * box.extent + np.array(box.lower)
    if rng.random() < 0.7:
        _, first = np.unique(x, axis=0, return_index=True)
        x = x[np.sort(first)]
    if any(box.periodic) and rng.random() < 0.2:
        x = x + rng.integers(-3, 4, x.shape) * np.where(box.periodic, box.extent, 0.0)
    elif rng.random() < 0.98:
        x = np.clip(x, box.lower, box.upper)
    return x.astype(np.float32) if rng.random() < 0.03 else x


NONSENSE = [
    None, "points", np.zeros((0, 2)), np.zeros((3, 4)), [[1, 2], [3]], np.array([["a", "b"]]), 3.0,
    np.full((2, 2), np.nan), np.array([[np.inf, 0.0]]), np.zeros((2, 2), complex), np.zeros((4, 2), object),
    np.zeros((2, 2, 2)), {"x": 1},
]  # fmt: skip


def some_size(rng: np.random.Generator, box: clvoro.Box):
    """A size field of up to a few thousand cells; sometimes an absurd one."""
    with np.errstate(all="ignore"):
        h = float((box.measure / 10 ** rng.uniform(0, 3)) ** (1 / box.dim))
    length = float(box.extent.max())
    kind = rng.integers(0, 11)
    low, high = np.array(box.lower), np.array(box.upper)
    if kind == 0:
        return h
    if kind == 1:
        where = rng.uniform(low, high)
        return sizing.Distance(
            [sizing.Circle(where, 0.2 * length)], h / 2, slope=rng.uniform(0.05, 2)
        )
    if kind == 2:
        values = h * 10 ** rng.uniform(-0.5, 0.5, (rng.integers(1, 9), rng.integers(1, 9)))
        return sizing.Raster(values, low, high, at=rng.choice(["nodes", "centres"]))
    if kind == 3:
        return sizing.Expression(
            f"{h!r} * (1 + {rng.uniform(0, 0.95)!r}*sin({9 / length!r}*(x+y)))"
        )
    if kind == 4:
        return lambda x: h * (1 + rng.uniform(0, 1) * (x[:, 0] > x[:, 0].mean()))
    if kind == 5:
        steps, middle = float(rng.choice([0.3, 3.0, 10.0])), (box.lower[0] + box.upper[0]) / 2
        return sizing.Expression(f"x < {middle!r} ? {h!r} : {h * steps!r}")
    if kind == 6:
        return ABSURD[rng.integers(len(ABSURD))]
    if kind == 7:
        # Too many cells for any device, or one; what lies between is a benchmark, not a test.
        return h * 10.0 ** (rng.uniform(-12, -6) if rng.random() < 0.5 else rng.uniform(0, 12))
    if kind >= 9:
        return some_graded(rng, box, some_size(rng, box))
    return sizing.minimum(h, sizing.Expression(f"{h / 3!r} + 0.3*fabs(x-{box.lower[0]!r})"))


class OwnError(Exception):
    """Raised by a caller's size field: it is the caller's to see."""


def fail():
    raise OwnError


ABSURD = [
    0, -1.0, np.nan, np.inf, 1e-300, 1e300, "0.1", None, [1, 2], lambda x: x, lambda x: None,
    lambda x: np.full(len(x), np.nan), lambda x: -np.ones(len(x)), lambda x: "abc", lambda x: fail(),
    lambda x: np.ones(len(x) + 1), lambda x: np.where(x[:, 0] > x[:, 0].mean(), 1.0, 0.0),
    sizing.Expression("x"), sizing.Expression("log(x - y)"), sizing.Expression("1e300*exp(x)*exp(y)"),
]  # fmt: skip


def some_size_3d(rng: np.random.Generator, box: clvoro.Box):
    """A size field of up to a hundred cells or so; sometimes an absurd one."""
    with np.errstate(all="ignore"):
        h = float((box.measure / 10 ** rng.uniform(0, 2)) ** (1 / 3))
    length, low = float(box.extent.max()), np.array(box.lower)
    kind = rng.integers(0, 7)
    if kind == 0:
        where = rng.uniform(box.lower, box.upper)
        sphere = sizing.Circle(where, 0.2 * length)
        return sizing.Distance([sphere], h / 1.5, slope=rng.uniform(0.05, 2))
    if kind == 1:
        values = h * 10 ** rng.uniform(-0.2, 0.3, rng.integers(1, 6, 3))
        return sizing.Raster(values, low, np.array(box.upper), at=rng.choice(["nodes", "centres"]))
    if kind == 2:
        return sizing.Expression(f"{h!r} * (1 + {rng.uniform(0, 0.5)!r}*sin({9 / length!r}*(x+z)))")
    if kind == 3:
        return lambda x: h * (1 + rng.uniform(0, 1) * (x[:, 2] > x[:, 2].mean()))
    if kind == 6:
        return some_graded(rng, box, some_size_3d(rng, box))
    if kind == 4 and rng.random() < 0.5:
        return ABSURD[rng.integers(len(ABSURD))]
    return h


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
        centre, radius = low + rng.uniform(0.1, 0.9, 2) * extent, 10 ** rng.uniform(-6, -0.5)
        shape = shape.difference(
            shapely.Polygon(shores.star(int(rng.integers(3, 9)), seed, centre, radius))
        )
    if rng.random() < 0.3:
        a = rng.choice([np.pi / 4, np.pi / 6, rng.uniform(0, 6)])
        turn = np.array([(np.cos(a), np.sin(a)), (-np.sin(a), np.cos(a))])
        shape = shapely.transform(shape, lambda x: x @ turn)
    if rng.random() < 0.3:
        scale = (
            10.0 ** rng.uniform(-2, 2, 2) if rng.random() < 0.5 else 10.0 ** rng.uniform(-30, 30)
        )
        shift = rng.choice([0, 1, 1e4]) * rng.uniform(-1, 1, 2)
        shape = shapely.transform(shape, lambda x: (x + shift) * scale)
    return clvoro.Polygon.from_shapely(shape)


def placed_in_polygon(rng: np.random.Generator, domain: clvoro.Polygon) -> np.ndarray:
    """Points of the unit square's kinds, on the boundary and off it."""
    low, extent = np.array(domain.lower), domain.extent
    kind = rng.random()
    if kind < 0.3:
        x = shores.lattice(int(rng.integers(1, 20)), rng.choice(["centres", "corners", "hexagons"]))
    elif kind < 0.5:
        v = domain.vertices
        t = rng.choice([0, 0.25, 0.5, rng.random()], (len(v), 1))
        x = (v + t * (v[domain.next_vertex] - v) - low) / extent
        x = np.concatenate([x, rng.random((rng.integers(0, 30), 2))])
    else:
        x = some_points(rng)
    if rng.random() < 0.2:
        x = x + 10.0 ** rng.uniform(-17, -5) * rng.standard_normal(x.shape)
    x = low + x * extent
    inside = x[domain.contains(x)] if rng.random() < 0.98 else x
    return np.unique(inside, axis=0) if len(inside) else domain.inner_point(0)[None]


def some_graded(
    rng: np.random.Generator, domain: clvoro.Box | clvoro.Polygon, field
) -> sizing.Field:
    """`field` with its growth limited, strictly, loosely, or not at all; on grids of all kinds."""
    options = {}
    if rng.random() < 0.5:
        options["growth"] = rng.choice([1.0, 1 + 1e-12, 1.05, 1.3, 5.0, 1e9, 0.9, np.inf, np.nan])
    if not options or rng.random() < 0.05:
        options["slope"] = rng.choice([0.0, 1e-9, 0.1, 0.5, 3.0, 1e9, 1e300, -1.0, np.nan])
    if rng.random() < 0.5:
        # More nodes than any grid may have, or a few; what lies between is a benchmark, not a test.
        each = rng.choice([1, 2, 3, 10**7], domain.dim, p=[0.05, 0.4, 0.5, 0.05])
        options["resolution"] = [2, 3, 17, 90, 10**7, tuple(each.tolist()), 2.5][rng.integers(7)]
    if rng.random() < 0.3:
        with np.errstate(all="ignore"):
            low = np.array(domain.lower) + rng.choice([-1, 0, 0.4, 3]) * domain.extent
            options["box"] = clvoro.Box(low, low + rng.choice([1e-3, 0.5, 1, 4]) * domain.extent)
    return sizing.Graded(field, **options)


def some_layers(
    rng: np.random.Generator, domain: clvoro.Box | clvoro.Polygon
) -> list[clvoro.Layers]:
    """One to three layers, as a rule of up to some thousand generators; also too thick, far too thin, or nowhere."""
    number = len(domain.vertices) if isinstance(domain, clvoro.Polygon) else 4
    edges = shapely.boundary(domain.geometry).length if number != 4 else 2 * domain.extent.sum()
    room, made = domain.measure / edges, []
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        width = edges / 10 ** rng.uniform(1, 3)
        options = {
            "height": min(width, 0.5 * room) * 10 ** rng.uniform(-2, 0), "count": int(rng.integers(1, 6)),
            "growth": rng.choice([1.0, 1.1, 1.2, 1.5, 3.0]), "spacing": width if rng.random() < 0.7 else None,
        }  # fmt: skip
        if rng.random() < 0.8:
            first = int(rng.integers(number))
            some = range(first, min(number, first + int(rng.integers(1, 30))))
            options["edges"] = (
                some if rng.random() < 0.5 else np.flatnonzero(rng.random(number) < 0.5)
            )
        if rng.random() < 0.15:
            strange = {
                "height": lambda: edges * 10.0 ** rng.uniform(-300, 300),
                "count": lambda: int(rng.choice([0, 50, 10**6, 10**18])),
                "growth": lambda: rng.choice([1 + 1e-15, 1e3, 1e300, 0.5, np.nan]),
                "spacing": lambda: edges * 10.0 ** rng.uniform(-300, 300),
                "edges": lambda: [[], [number], [-1], [0, 0], 3][rng.integers(5)],
            }
            name = str(rng.choice(list(strange)))
            options[name] = strange[name]()
        made.append(clvoro.Layers(**options))
    return made
