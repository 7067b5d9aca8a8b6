"""Nearly coincident or cocircular generators: how many sets give meshes that pass `check`.

    python bench/clusters.py [--dim 3] [--sets 60] [--kinds circles,arcs] [--dtype float32]
        [--device NAME] [--json]

In the unit square, in both precisions unless one is given. `clusters`: 3 to 40 generators within 1e-13
to 1e-3 of each other (1e-5 in float32), at random, on lines or circles, beside a few others.
`circles` and `arcs`: 400 at random on one. `lines`: 20 to 150 on a line 1e-4 to 5e-4 apart, beside 40.
`one rounding`: 3 to 81 points one unit of round-off apart, beside 300; `across seams`: the same in a
periodic box. `alone`: 50 to 300 points within 15 to 60 units of round-off, without others, in a periodic
box. Points are rounded to the precision first, and duplicates are removed.

In the unit cube: `clusters` and `lines` likewise; `spheres`: 100 at random on one; `rings`: 60 on a
circle. There sets nearer than a least separation may be refused.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from datetime import date

import numpy as np
from _common import Report, device_name, make_adapter, names, parser

import clvoro

PLACE = 0.6875
SHOWN = 3
"""Number of errors that are printed for each kind of set."""


def on_circle(rng: np.random.Generator, angle: float) -> np.ndarray:
    """Return 400 places on an arc of `angle` of a circle in the unit square."""
    radius, middle = 10 ** rng.uniform(-3, -0.5), 0.5 + 0.3 * rng.uniform(-1, 1, 2)
    t = rng.uniform(0, angle, 400)
    return middle + radius * np.column_stack([np.cos(t), np.sin(t)])


def clusters(rng: np.random.Generator, real: np.dtype) -> np.ndarray:
    """Return a few generators near each other, and fewer anywhere."""
    count, size = int(rng.integers(3, 40)), 10 ** rng.uniform(-13 if real == np.float64 else -5, -3)
    angle = rng.uniform(0, 2 * np.pi, count)
    near = [
        rng.standard_normal((count, 2)),
        10 * rng.uniform(-1, 1, (count, 1)) * [np.cos(angle[0]), np.sin(angle[0])],
        np.column_stack([np.cos(angle), np.sin(angle)]),
    ][rng.integers(3)]
    return np.vstack([rng.random(2) + size * near, rng.random((int(rng.integers(1, 10)), 2))])


def circles(rng: np.random.Generator, _real: np.dtype) -> np.ndarray:
    """Return a circle of generators."""
    return on_circle(rng, 2 * np.pi)


def arcs(rng: np.random.Generator, _real: np.dtype) -> np.ndarray:
    """Return an arc of generators."""
    return on_circle(rng, rng.uniform(0.1, 3))


def lines(rng: np.random.Generator, _real: np.dtype) -> np.ndarray:
    """Return a line of generators, and 40 random ones."""
    count, way = int(rng.integers(20, 150)), rng.uniform(0, 2 * np.pi)
    along = (np.arange(count) - count / 2) * rng.choice([1e-4, 2.5e-4, 5e-4])
    middle = 0.5 + 0.2 * rng.uniform(-1, 1, 2)
    line = middle + np.outer(along, [np.cos(way), np.sin(way)])
    return np.vstack([line, rng.random((40, 2))])


def one_rounding(rng: np.random.Generator, real: np.dtype) -> np.ndarray:
    """Return generators one unit of round-off apart, and 300 random ones."""
    step = 2 * float(np.spacing(np.asarray(PLACE, real)))
    square = np.stack(np.meshgrid(range(9), range(9)), axis=-1).reshape(-1, 2)
    chosen = square[rng.permutation(81)[: int(rng.integers(3, 82))]]
    return np.vstack([PLACE + step * chosen, rng.random((300, 2))])


def alone(rng: np.random.Generator, real: np.dtype) -> np.ndarray:
    """Return generators within a few roundings of each other."""
    step, count, across = float(np.finfo(real).eps), rng.integers(50, 300), rng.integers(15, 60)
    first = np.floor(rng.uniform(0, 0.99, 2) / step) * step
    return first + step * rng.integers(0, across, (count, 2))


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return unit vectors in space."""
    v = rng.standard_normal((count, 3))
    return v / np.linalg.norm(v, axis=1)[:, None]


def clusters_in_space(rng: np.random.Generator, real: np.dtype) -> np.ndarray:
    """Return a few generators near each other, and fewer anywhere."""
    count, size = int(rng.integers(3, 40)), 10 ** rng.uniform(-13 if real == np.float64 else -5, -3)
    ways = directions(rng, count)
    line = 10 * rng.uniform(-1, 1, (count, 1)) * ways[0]
    near = [rng.standard_normal((count, 3)), line, ways][rng.integers(3)]
    return np.vstack([rng.random(3) + size * near, rng.random((int(rng.integers(1, 10)), 3))])


def spheres(rng: np.random.Generator, _real: np.dtype) -> np.ndarray:
    """Return a sphere of generators."""
    return 0.5 + 0.3 * rng.uniform(-1, 1, 3) + 10 ** rng.uniform(-3, -0.5) * directions(rng, 100)


def rings(rng: np.random.Generator, _real: np.dtype) -> np.ndarray:
    """Return a circle of generators in space, in a random plane."""
    radius, t = 10 ** rng.uniform(-3, -0.5), rng.uniform(0, 2 * np.pi, 60)
    plane = np.linalg.qr(rng.standard_normal((3, 3)))[0][:2]
    circle = np.column_stack([np.cos(t), np.sin(t)]) @ plane
    return 0.5 + 0.3 * rng.uniform(-1, 1, 3) + radius * circle


def lines_in_space(rng: np.random.Generator, _real: np.dtype) -> np.ndarray:
    """Return a line of generators, and 40 random ones."""
    count = int(rng.integers(20, 150))
    along = (np.arange(count) - count / 2) * rng.choice([1e-4, 2.5e-4, 5e-4])
    line = 0.5 + 0.2 * rng.uniform(-1, 1, 3) + np.outer(along, directions(rng, 1)[0])
    return np.vstack([line, rng.random((40, 3))])


KINDS = {
    2: {
        "clusters": clusters,
        "circles": circles,
        "arcs": arcs,
        "lines": lines,
        "one-rounding": one_rounding,
        "across-seams": one_rounding,
        "alone": alone,
    },
    3: {"clusters": clusters_in_space, "spheres": spheres, "rings": rings, "lines": lines_in_space},
}


PERIODIC = ("across-seams", "alone")
"""Kinds that lie in a periodic box."""


def sets_of(dim: int, kind: str, count: int, real: np.dtype) -> Iterator[np.ndarray]:
    """Yield the sets of generators of a kind."""
    for seed in range(count):
        points = KINDS[dim][kind](np.random.default_rng(seed), real)
        yield np.unique(np.clip(points, 0, 1).astype(real), axis=0).astype(float)


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--sets", type=int, default=60)
    options_of.add_argument("--dim", type=int, choices=list(KINDS), default=2)
    options_of.add_argument("--kinds", type=names)
    options_of.set_defaults(dtype=None)
    options = options_of.parse_args()
    columns = {
        name: lambda r, name=name: r[name] for name in ("generators", "dtype", "sets", "meshes", "refused", "wrong")
    }
    report, refusals = Report(options.json, columns), {}
    precisions = [options.dtype] if options.dtype else ["float64", "float32"]
    for options.dtype in precisions:
        adapter = make_adapter(options)
        for kind in options.kinds or KINDS[options.dim]:
            ends = (0,) * options.dim, (1,) * options.dim
            box = clvoro.Box(*ends, periodic=kind in PERIODIC)
            found = {"meshes": 0, "refused": 0, "wrong": 0}
            for points in sets_of(options.dim, kind, options.sets, np.dtype(options.dtype)):
                try:
                    right = bool(adapter.diagram(box, points).check())
                    found["meshes" if right else "wrong"] += 1
                except clvoro.ClvoroError as error:
                    found["refused"] += 1
                    refusals.setdefault(f"{kind}, {options.dtype}", []).append(error)
            report.add({"generators": kind, "dtype": options.dtype, "sets": options.sets, **found}, kind)
    title = f"{options.sets} sets each. {date.today()}, {device_name(adapter)}."
    report.finish(title)
    for which, errors in refusals.items():
        for error in errors[:SHOWN]:
            print(f"{which}: {error}", file=sys.stderr)
        if len(errors) > SHOWN:
            print(f"{which}: and {len(errors) - SHOWN} more", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
