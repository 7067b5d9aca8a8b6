"""Polygons that are harder than those of `fuzz_inputs.py`, and valid and invalid rings."""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely

import clvoro
from tests.reference import shores


def hard_polygon(rng: np.random.Generator) -> clvoro.Polygon:
    """One of `HARD`, turned or not."""
    shape = HARD[rng.integers(len(HARD))](rng)
    areas = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"]
    shape = shapely.union_all(areas) if areas else shapely.box(0, 0, 1, 1)
    if rng.random() < 0.3:
        a = rng.uniform(0, 6)
        turn = np.array([(np.cos(a), np.sin(a)), (-np.sin(a), np.cos(a))])
        shape = shapely.transform(shape, lambda x: x @ turn)
    return clvoro.Polygon.from_shapely(shape)


def fjords(rng: np.random.Generator) -> Any:
    """An island with long, narrow cuts that bend."""
    coast = shores.coast(2 ** int(rng.integers(5, 11)), some_seed(rng), rng.uniform(0.5, 1.1))
    shape = shapely.make_valid(shapely.Polygon(coast))
    for _ in range(rng.integers(0, 12)):
        a, n = rng.uniform(0, 6.3), int(rng.integers(3, 12))
        t = np.linspace(0, 1, n)[:, None]
        way = 2 * np.array([np.cos(a), np.sin(a)]) * (1 - t) + rng.normal(0, 0.2, 2) * t
        way += rng.normal(0, 0.1, (n, 2))
        width = 10 ** rng.uniform(-6, -1.5)
        cut = shapely.LineString(way).buffer(width, cap_style="flat", join_style="mitre", quad_segs=1)
        shape = shape.difference(cut)
    return shape


def needles(rng: np.random.Generator) -> Any:
    """A star with needles outward and inward, as narrow as the shortest valid edge."""
    shape = shapely.Polygon(shores.star(int(rng.integers(3, 30)), some_seed(rng)))
    for _ in range(rng.integers(1, 8)):
        a, width = rng.uniform(0, 6.3), 10 ** rng.uniform(-12, -3)
        tip = np.array([np.cos(a), np.sin(a)]) * rng.uniform(0.1, 2)
        base, across = rng.normal(0, 0.3, 2), np.array([-np.sin(a), np.cos(a)]) * width
        needle = shapely.Polygon([base - across, base + across, tip])
        shape = shape.union(needle) if rng.random() < 0.5 else shape.difference(needle)
    return shape


def touching(rng: np.random.Generator) -> Any:
    """Holes in a lattice that touch each other in corners: the rest may have many pieces."""
    n, flat = int(rng.integers(2, 8)), np.array([(0, 0.5), (0.5, 0.3), (1, 0.5), (0.5, 0.7)])
    holes = [
        shapely.Polygon(((shores.DIAMOND if rng.random() < 0.7 else flat) + (i, j)) / n)
        for i in range(n)
        for j in range(n)
        if rng.random() < 0.5
    ]
    return shapely.box(0, 0, 1, 1).difference(shapely.union_all(holes))


def fans(rng: np.random.Generator) -> Any:
    """Triangular holes that share one corner."""
    center, shape = rng.uniform(0.25, 0.75, 2), shapely.box(0, 0, 1, 1)
    angles = np.sort(rng.uniform(0, 6.28, (int(rng.integers(2, 12)), 2)).ravel()).reshape(-1, 2)
    for pair in angles:
        ends = center + rng.uniform(0.05, 0.45) * np.column_stack([np.cos(pair), np.sin(pair)])
        shape = shape.difference(shapely.Polygon([center, *ends]))
    return shape


def many_pieces(rng: np.random.Generator) -> Any:
    """Up to some hundred islands."""
    n = int(rng.integers(5, 20))
    return shapely.union_all(
        [
            shapely.Polygon(shores.star(int(rng.integers(3, 8)), some_seed(rng), (i, j), rng.uniform(0.05, 0.48)))
            for i in range(n)
            for j in range(n)
            if rng.random() < 0.6
        ]
    )


def nested(rng: np.random.Generator) -> Any:
    """An island in a lake on an island, and so on."""
    shape, radius = shapely.Polygon(), 1.0
    for _ in range(rng.integers(2, 9)):
        ring = shores.star(int(rng.integers(3, 15)), some_seed(rng), radius=radius)
        shape = shape.symmetric_difference(shapely.Polygon(ring))
        radius *= rng.uniform(0.2, 0.49)
    return shape


def combs(rng: np.random.Generator) -> Any:
    """Up to 120 teeth, fine or coarse, on one side or on both."""
    gap = 10 ** rng.uniform(-3, -0.05)
    shape = shapely.Polygon(shores.comb(int(rng.integers(1, 120)), rng.uniform(0.3, 0.98), gap))
    if rng.random() < 0.5:
        return shape
    shift = (rng.uniform(-0.4, 0.4), 0)
    return shape.union(shapely.transform(shape, lambda x: x * (1, -1) + shift))


HARD = [fjords, needles, touching, fans, many_pieces, nested, combs]


def some_seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31))


# Valid and damaged rings of all sources.


def some_rings(rng: np.random.Generator) -> list[list[Any]]:
    """Rings of one to three pieces, valid or damaged, of any kind and in any order."""
    pieces = []
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        outer, holes = some_ring(rng), []
        for _ in range(rng.choice([0, 0, 1, 2, 3])):
            hole = some_ring(rng)
            if len(outer) and len(hole):
                if rng.random() < 0.8:  # inside, as a rule
                    there = outer.mean(axis=0) + rng.normal(0, 0.1, 2)
                    hole = (hole - hole.mean(axis=0)) * rng.uniform(0.01, 0.4) + there
                if rng.random() < 0.1:
                    hole = outer * rng.choice([1, 0.5, -1])
                if rng.random() < 0.15:  # touching
                    hole = hole - hole[0] + outer[rng.integers(len(outer))]
            holes.append(spoilt(rng, hole) if rng.random() < 0.4 else hole)
        if len(outer):
            outer = outer + rng.choice([0, 0, 1, 2.5]) * rng.random(2)
        pieces.append([spoilt(rng, outer), *holes])
    return pieces


def some_ring(rng: np.random.Generator) -> np.ndarray:
    kind = rng.integers(6)
    if kind == 0:
        return shores.star(int(rng.integers(3, 20)), some_seed(rng))
    if kind == 1:
        return rng.random((int(rng.integers(0, 9)), 2))
    if kind == 2:
        return rng.integers(0, 5, (int(rng.integers(3, 12)), 2)).astype(float)
    if kind == 3:
        return shores.comb(int(rng.integers(1, 6)), rng.uniform(0.1, 0.99), rng.uniform(0.01, 0.99))
    if kind == 4:
        return shores.slit(10.0 ** rng.uniform(-17, -1))
    return shores.coast(2 ** int(rng.integers(2, 7)), some_seed(rng), rng.uniform(0.5, 1.5))


def spoilt(rng: np.random.Generator, ring: np.ndarray) -> Any:
    """Return `ring` with up to three changes, harmless or not, or an object that is no ring."""
    r = ring
    for _ in range(rng.integers(0, 4)):
        if len(r) < 2:
            break
        i, j = (int(k) for k in rng.integers(len(r), size=2))
        with np.errstate(all="ignore"):
            r = CHANGES[rng.integers(len(CHANGES))](rng, r, i, j)
    if rng.random() >= 0.06:
        return r
    strange = [
        None,
        "x",
        3.0,
        {},
        [],
        [[1, 2], [3]],
        r.astype(object),
        r.astype(complex),
        r.tolist(),
        r[:, :1],
        r[None],
        np.ma.array(r),
        r > 0,
    ]
    return strange[rng.integers(len(strange))]


def put(r: np.ndarray, i: int, value: Any) -> np.ndarray:
    """A copy of `r` with another vertex i."""
    made = r.copy()
    made[i] = value
    return made


CHANGES = [
    lambda rng, r, i, j: put(r, i, rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 0])),
    lambda rng, r, i, j: np.insert(r, i, r[i], axis=0),
    lambda rng, r, i, j: np.insert(r, i, r[j], axis=0),
    lambda rng, r, i, j: np.insert(r, i, [r[j], r[i]], axis=0),  # there and back
    lambda rng, r, i, j: r[::-1],
    lambda rng, r, i, j: r * 10.0 ** rng.uniform(-300, 300),
    lambda rng, r, i, j: r + 10.0 ** rng.uniform(-3, 17) * rng.uniform(-1, 1, 2),
    lambda rng, r, i, j: np.vstack([r, r[:1]]),
    lambda rng, r, i, j: r * (1, 10.0 ** rng.uniform(-14, 0)),
    lambda rng, r, i, j: put(r, i, r[i] + 10.0 ** rng.uniform(-18, -8) * rng.standard_normal(2)),
    lambda rng, r, i, j: np.insert(r, i, (r[i] + r[i - 1]) / 2, axis=0),
    lambda rng, r, i, j: put(r, i, np.nextafter(r[j], r[i])),
]
"""Return possible changes of a ring (k, 2), at the places i and j."""


def polygon_of(rng: np.random.Generator, pieces: list[list[Any]]) -> clvoro.Polygon:
    """Make the domain by one of the constructors."""
    way = rng.integers(3)
    if way == 0 and len(pieces) == 1:
        return clvoro.Polygon(pieces[0][0], pieces[0][1:])
    if way == 1:
        lists = [[r.tolist() if isinstance(r, np.ndarray) else r for r in p] for p in pieces]
        return clvoro.Polygon.from_geojson({"type": "MultiPolygon", "coordinates": lists})
    return clvoro.Polygon.from_pieces(pieces)
