"""Size fields of all kinds for `fuzz.py`: valid ones of up to a thousand cells or so, and absurd ones."""

from __future__ import annotations

import numpy as np

import clvoro
from clvoro import sizing

Domain = clvoro.Box | clvoro.Polygon


class OwnError(Exception):
    """Raised by a caller's size field. The caller must get it."""


def fail():
    raise OwnError


ABSURD = [
    0,
    -1.0,
    np.nan,
    np.inf,
    1e-300,
    1e300,
    "0.1",
    None,
    [1, 2],
    lambda x: x,
    lambda x: None,
    lambda x: np.full(len(x), np.nan),
    lambda x: -np.ones(len(x)),
    lambda x: "abc",
    lambda x: fail(),
    lambda x: np.ones(len(x) + 1),
    lambda x: np.where(x[:, 0] > x[:, 0].mean(), 1.0, 0.0),
    sizing.Expression("x"),
    sizing.Expression("log(x - y)"),
    sizing.Expression("1e300*exp(x)*exp(y)"),
]


def some_size(rng: np.random.Generator, domain: Domain, wild: bool):
    """A size field that a run in `domain` can meet, or (`wild`) any size field."""
    h = fine_size(rng, domain)
    if wild:
        h *= 10 ** rng.uniform(0, 0.5)  # may be too coarse for a period
        if rng.random() < 0.3:
            return ABSURD[rng.integers(len(ABSURD))]
        if rng.random() < 0.3:
            # Too many cells for any device, or one cell. Numbers between take too long for a test.
            return h * 10.0 ** (rng.uniform(-12, -6) if rng.random() < 0.5 else rng.uniform(0, 12))
        if rng.random() < 0.5:
            return some_graded(rng, domain, field_of(rng, domain, h), wild=True)
    return field_of(rng, domain, h)


def fine_size(rng: np.random.Generator, domain: Domain) -> float:
    """A size of up to some hundred cells, most of them with levels below; of six across a period at least.

    Boundaries of polygons bring cells of their own.
    """
    d = domain.dim
    most = 2.5 if isinstance(domain, clvoro.Polygon) else 3.1 if d == 2 else 2.7
    h = (domain.measure / 10 ** rng.uniform(most - 2, most)) ** (1 / d)
    periods = domain.extent[list(domain.periodic)]
    return float(min(h, periods.min(initial=np.inf) / rng.uniform(6.5, 9)))


def field_of(rng: np.random.Generator, domain: Domain, h: float, depth: int = 0):
    """A field with sizes up to `h`, and not much smaller ones."""
    names = [n for n in FIELDS if n != "feature" or isinstance(domain, clvoro.Polygon)]
    if depth > 1:
        names = [name for name in names if name not in ("graded", "combined")]
    make = FIELDS[str(rng.choice(names))]
    return make(rng, domain, h, depth)


def ratio(rng: np.random.Generator, domain: Domain) -> float:
    """Largest over least size."""
    return float(rng.uniform(1.1, 3 if domain.dim == 2 else 1.6))


def constant(rng, domain, h, depth):
    return h if rng.random() < 0.5 else sizing.Constant(h)


def distance(rng, domain, h, depth):
    shapes = [some_shape(rng, domain) for _ in range(rng.integers(1, 4))]
    growth = {"growth": rng.uniform(1.05, 2)} if rng.random() < 0.5 else {"slope": rng.uniform(0.02, 1)}
    return sizing.Distance(shapes, h / ratio(rng, domain), h_max=h, **growth)


def some_shape(rng: np.random.Generator, domain: Domain):
    """A shape in the domain, sometimes beside it."""
    d, low, high = domain.dim, np.array(domain.lower), np.array(domain.upper)
    middle, reach = (low + high) / 2, rng.choice([0.4, 0.5, 0.6])
    corners = middle + rng.uniform(-reach, reach, (int(rng.integers(3, 9)), d)) * (high - low)
    kind = rng.integers(0, 7)
    if kind == 0:
        return sizing.Circle(corners[0], float(rng.choice([0, 0.1, 0.3])) * float((high - low).min()))
    if kind == 1:
        return sizing.Segment(corners[0], corners[1])
    if kind == 2:
        return sizing.Polyline(corners)
    if kind == 3:
        return sizing.ClosedPolyline(corners)
    if kind == 4 and d == 3:
        return sizing.Surface(corners[:3], [[0, 1, 2]]) if len(corners) < 5 else tetrahedron(corners)
    if kind == 5:
        return clvoro.Box(tuple(middle - 0.2 * (high - low)), tuple(middle + 0.3 * (high - low)))
    return domain


def tetrahedron(corners: np.ndarray) -> sizing.Surface:
    return sizing.Surface(corners[:4], [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])


def raster(rng, domain, h, depth):
    values = h / ratio(rng, domain) ** rng.random(rng.integers(1, 9, domain.dim))
    low, high = np.array(domain.lower), np.array(domain.upper)
    away = rng.choice([0, 0, 0.3, -0.2]) * domain.extent  # more than the domain, or less
    options = {"at": str(rng.choice(["nodes", "centers"]))}
    if rng.random() < 0.2 and values.size > 1:
        values.flat[rng.integers(values.size)] = np.nan
        options["missing"] = "nearest"
    return sizing.Raster(values, low - away, high + away, outside="nearest", **options)


def scattered(rng, domain, h, depth):
    x = rng.uniform(domain.lower, domain.upper, (int(rng.integers(5, 80)), domain.dim))
    values = h / ratio(rng, domain) ** rng.random(len(x))
    options = {"resolution": int(rng.integers(2, 30))} if rng.random() < 0.5 else {}
    method = str(rng.choice(["linear", "nearest"]))
    return sizing.Scattered(x, values, domain.lower, domain.upper, method=method, **options)


def expression(rng, domain, h, depth):
    """A wave, continuous across seams or not."""
    low, extent, share = domain.lower, domain.extent, 1 - 1 / ratio(rng, domain)
    waves = [2 * np.pi * (int(rng.integers(0, 3)) if rng.random() < 0.7 else rng.uniform(0, 3)) / e for e in extent]
    phase = " + ".join(f"{w!r}*({a} - {c!r})" for w, a, c in zip(map(float, waves), "xyz", low, strict=False))
    return sizing.Expression(f"{h!r} * (1 - {share / 2!r}*(1 + sin({phase})))")


def jump(rng, domain, h, depth):
    """Two sizes on the sides of a line, or a strip of much finer cells, without growth beside it."""
    middle = float(rng.uniform(domain.lower[0], domain.upper[0]))
    if rng.random() < 0.5:
        return sizing.Expression(f"x < {middle!r} ? {h!r} : {h / ratio(rng, domain)!r}")
    fine = h / 10 ** rng.uniform(0.5, 2 if domain.dim == 2 else 0.8)
    if depth:  # combined with others it may be as fine everywhere, with a million cells: too long for a test
        fine = max(fine, h / 5)
    place = float(rng.choice([middle, domain.lower[0], domain.upper[0]]))
    return sizing.Expression(f"fabs(x - {place!r}) < {fine * rng.uniform(0.2, 4)!r} ? {float(fine)!r} : {h!r}")


def function(rng, domain, h, depth):
    middle, share = domain.lower[-1] + domain.extent[-1] / 2, ratio(rng, domain)
    return lambda x: np.where(x[:, -1] > middle, h, h / share)


def graded(rng, domain, h, depth):
    return some_graded(rng, domain, field_of(rng, domain, h, depth + 1), wild=False)


def combined(rng, domain, h, depth):
    one, other = (sizing.as_field(field_of(rng, domain, h, depth + 1)) for _ in range(2))
    kind = rng.integers(0, 6)
    if kind == 0:
        return sizing.maximum(one, other)
    if kind == 1:
        return 0.5 * (one + other)
    if kind == 2:
        return sizing.minimum(one, other) * 0.8
    if kind == 3:
        # Of fields without a unit, whose product is between 1 / 1.5 and 1.
        weight = sizing.Raster(rng.uniform(0.7, 1, [3] * domain.dim), domain.lower, domain.upper)
        return sizing.Constant(h) * weight
    if kind == 4:
        return sizing.Constant(h / 1.5) / sizing.Raster(
            rng.uniform(0.7, 1, [2] * domain.dim), domain.lower, domain.upper
        )
    return sizing.minimum(one, other)


def solution(rng, domain, h, depth):
    """Sizes from a solution on a raster."""
    at = [np.linspace(-1, 1, int(n)) for n in rng.integers(5, 20, domain.dim)]
    x = np.stack(np.meshgrid(*at, indexing="ij"))
    u = np.tanh(rng.uniform(1, 9) * np.tensordot(rng.standard_normal(domain.dim), x, 1))
    make = sizing.hessian_size if rng.random() < 0.5 else sizing.gradient_size
    bounds = {"h_min": h / ratio(rng, domain), "h_max": h}
    return make(u, domain.lower, domain.upper, eps=10 ** rng.uniform(-3, 0), **bounds)


def feature(rng, domain, h, depth):
    return sizing.FeatureSize(
        domain,
        rng.uniform(0.5, 4),
        rng.uniform(1.1, 2),
        h_min=h / ratio(rng, domain),
        h_max=h,
        curvature=float(rng.choice([0, 1, 3])),
    )


FIELDS = {
    f.__name__: f
    for f in (constant, distance, raster, scattered, expression, jump, function, graded, combined, solution, feature)
}


def some_graded(rng: np.random.Generator, domain: Domain, field, wild: bool) -> sizing.Field:
    """`field` with its growth limited, strictly, loosely, or not at all; on grids of all kinds (`wild`: none, too)."""
    options = {}
    if rng.random() < 0.5:
        strange = [1 + 1e-12, 1e9, 0.9, np.inf, np.nan] if wild else []
        options["growth"] = rng.choice([1.0, 1.05, 1.3, 5.0, *strange])
    if not options or (wild and rng.random() < 0.05):
        strange = [1e9, 1e300, -1.0, np.nan] if wild else []
        options["slope"] = rng.choice([0.0, 1e-9, 0.1, 0.5, 3.0, *strange])
    if rng.random() < 0.5:
        options["resolution"] = [2, 3, 17, 90, tuple(rng.integers(2, 9, domain.dim).tolist())][rng.integers(5)]
    if wild and rng.random() < 0.4:
        # More nodes than any grid may have. Numbers between take too long for a test.
        options["resolution"] = [10**7, 2.5, 1, (10**7,) * domain.dim][rng.integers(4)]
    if rng.random() < 0.3:
        # Around the domain, or around a part of it; `wild`: anywhere.
        begin, across = (rng.choice([-1, 0, 0.4, 3]), rng.choice([1e-3, 0.5, 1, 4]))
        if not wild:
            begin, across = [(-1, 4), (0, 1), (0, 0.5), (0.4, 0.5)][rng.integers(4)]
        with np.errstate(all="ignore"):
            low = np.array(domain.lower) + begin * domain.extent
            options["box"] = clvoro.Box(low, low + across * domain.extent)
    return sizing.Graded(field, **options)
