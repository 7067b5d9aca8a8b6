"""Throw everything at clvoro: `python -m tests.fuzz --minutes 10`.

Each input is made from one seed: generators in the plane and in space (clusters down to one ulp, lattices, circles,
lines, walls, corners, one to three points, scales 1e-300 to 1e300), polygons, size fields, options, and files with
bits changed. It must end in a mesh that passes `check`, or in a ClvoroError (a ValueError, TypeError or MemoryError
that says what is wrong). Whatever else happens is printed with its seed and saved; `python -m tests.fuzz --repeat
SEED` does it again.
"""

from __future__ import annotations

import argparse
import collections
import faulthandler
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

import numpy as np
import shapely

import clvoro
from clvoro import sizing
from clvoro.cases import load_case
from clvoro.cases.fields import load_array
from clvoro.checkpoint import Saved
from clvoro.io.vtu_read import load_vtu
from tests import shores
from tests.reference_polygon import faults

SLOWEST = 180
"""Seconds after which an input counts as one that hangs."""
_adapters: dict[str, clvoro.Adapter] = {}


class Wrong(Exception):  # noqa: N818
    """An input led to something other than a right mesh or a clear error."""


def adapter(dtype: str) -> clvoro.Adapter:
    if dtype not in _adapters:
        _adapters[dtype] = clvoro.Adapter(dtype=dtype)
    return _adapters[dtype]


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
    if rng.random() < 0.98:
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
        h = (box.measure / 10 ** rng.uniform(0, 3)) ** (1 / box.dim)
    length = box.extent.max()
    kind = rng.integers(0, 9)
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
        steps = rng.choice([0.3, 3.0, 10.0])
        return sizing.Expression(f"x < {(low[0] + high[0]) / 2!r} ? {h!r} : {h * steps!r}")
    if kind == 6:
        return ABSURD[rng.integers(len(ABSURD))]
    if kind == 7:
        # Too many cells for any device, or one; what lies between is a benchmark, not a test.
        return h * 10.0 ** (rng.uniform(-12, -6) if rng.random() < 0.5 else rng.uniform(0, 12))
    return sizing.minimum(h, sizing.Expression(f"{h / 3!r} + 0.3*fabs(x-{low[0]!r})"))


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


def try_diagram(rng: np.random.Generator) -> str:
    box = some_box(rng)
    points = placed(rng, box)
    diagram = adapter(rng.choice(["float64", "float64", "float32"])).diagram(box, points)
    demand(diagram.check())
    if rng.random() < 0.1:
        again = adapter(_precision(diagram)).diagram(box, diagram.points)
        if len(again) != len(diagram):
            raise Wrong("another number of cells")
    return "mesh"


def _precision(diagram) -> str:
    real = diagram.check().precision
    return real if real in _adapters else next(iter(_adapters))


def try_solid(rng: np.random.Generator) -> str:
    box = some_box(rng, 3)
    diagram = adapter(rng.choice(["float64", "float64", "float32"])).diagram(box, placed(rng, box))
    demand(diagram.check())
    return "mesh"


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


def try_polygon(rng: np.random.Generator) -> str:
    domain = some_polygon(rng)
    real = str(rng.choice(["float64", "float64", "float32"]))
    points = placed_in_polygon(rng, domain)
    # Boxes show what becomes of generators that coincide.
    first = np.unique(domain.place(points, np.dtype(real)), axis=0, return_index=True)[1]
    diagram = adapter(real).diagram(domain, points[np.sort(first)])
    found = faults(diagram, real)
    if found:
        raise Wrong("; ".join(found))
    return "mesh"


def try_polygon_run(rng: np.random.Generator) -> str:
    domain = some_polygon(rng)
    size = float(np.sqrt(domain.measure / 10 ** rng.uniform(0, 2.6)))
    real = str(rng.choice(["float64", "float64", "float32"]))
    method = str(rng.choice(["adaptive", "exact", "coupled", "lloyd", "poisson", "weighted"]))
    steps = int(rng.integers(0, 15))
    result = adapter(real).run(
        domain, size, method=method, max_steps=steps, effort="fast", seed=int(rng.integers(99))
    )
    found = faults(result.diagram, real)
    if found or not domain.contains(result.points).all():
        raise Wrong("; ".join([*found, f"{np.sum(~domain.contains(result.points))} outside"]))
    return "mesh"


def some_size_3d(rng: np.random.Generator, box: clvoro.Box):
    """A size field of up to a hundred cells or so; sometimes an absurd one."""
    with np.errstate(all="ignore"):
        h = (box.measure / 10 ** rng.uniform(0, 2)) ** (1 / 3)
    length, low = box.extent.max(), np.array(box.lower)
    kind = rng.integers(0, 6)
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
    if kind == 4 and rng.random() < 0.5:
        return ABSURD[rng.integers(len(ABSURD))]
    return h


def try_solid_run(rng: np.random.Generator) -> str:
    return try_run(rng, 3)


def try_run(rng: np.random.Generator, dim: int = 2) -> str:
    box = some_box(rng, dim)
    options = {
        "method": rng.choice(["adaptive", "exact", "coupled", "lloyd", "poisson", "weighted", "nonsense"],
                             p=[0.3, 0.15, 0.15, 0.1, 0.1, 0.18, 0.02]),
        "max_steps": int(rng.integers(0, 15 if dim == 2 else 6)), "effort": rng.choice(["fast", "default"]),
        "seed": int(rng.integers(0, 2**31)), "start": rng.choice(["density", "uniform"]),
    }  # fmt: skip
    optional = {
        "n_cells": lambda: int(rng.choice([1, 2, 3, 17, 400 if dim == 2 else 40, 10**9, -1])),
        "k": lambda: rng.choice([1e-9, 0.1, 1.0, 100.0, -1.0, np.nan]),
        "alpha": lambda: rng.choice([1e-9, 1.0, 100.0]),
        "tol": lambda: rng.choice([0.0, 0.5, 1e9]),
        "levels": lambda: int(rng.choice([0, 1, 2, 50])),
        "error_target": lambda: rng.choice([1e-9, 0.01, 10.0]),
        "points": lambda: placed(rng, box),
    }
    options |= {name: make() for name, make in optional.items() if rng.random() < 0.2}
    size = some_size(rng, box) if dim == 2 else some_size_3d(rng, box)
    result = adapter(rng.choice(["float64", "float64", "float32"])).run(box, size, **options)
    demand(result.check())
    if rng.random() < 0.1:
        with tempfile.TemporaryDirectory() as folder:
            for suffix, reader in ((".npz", clvoro.load), (".vtu", load_vtu)):
                result.save(Path(folder) / f"m{suffix}")
                demand(reader(Path(folder) / f"m{suffix}").check())
    return "mesh"


def demand(report) -> None:
    if not report:
        raise Wrong(str(report))


CASE = b"""name = "fuzz"
[domain]
lower = [0, 0]
upper = [2, 1]
[size]
kind = "min"
fields = [{kind = "constant", value = 0.2}, {kind = "expression", expression = "0.1 + x*y + pow(x, 2)"},
  {kind = "distance", shapes = [{kind = "circle", centre = [1, 0.5], radius = 0.2}], h_min = 0.1, growth = 1.2}]
[run]
method = "coupled"
seed = 3
"""


_valid: dict[str, bytes] = {}


def valid_files() -> dict[str, bytes]:
    """A right file of each kind."""
    if not _valid:
        box = clvoro.Box((0, 0), (1, 1))
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            made = {"checkpoint": folder / "state", "checkpoint_every": 0}
            result = adapter("float64").run(box, 0.2, method="coupled", max_steps=2, seed=5, **made)
            result.save(folder / "m.npz")
            result.save(folder / "m.vtu")
            np.save(folder / "a.npy", result.points)
            (folder / "c.toml").write_bytes(CASE)
            _valid.update({path.name: path.read_bytes() for path in sorted(folder.iterdir())})
    return _valid


def try_file(rng: np.random.Generator) -> str:
    """Load a file with some bits changed, bytes lost, doubled or exchanged."""
    name, data = list(valid_files().items())[rng.integers(len(valid_files()))]
    bytes_ = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at = (
            int(rng.integers(0, max(len(bytes_), 1)))
            if rng.random() < 0.6
            else int(rng.integers(0, 600))
        )
        at = min(at, max(len(bytes_) - 1, 0))
        change = rng.integers(0, 5)
        if change == 0 and bytes_:
            bytes_[at] ^= 1 << int(rng.integers(0, 8))
        elif change == 1:
            del bytes_[at:]
        elif change == 2:
            bytes_[at:at] = bytes_[at : at + int(rng.integers(1, 300))]
        elif change == 3:
            del bytes_[at : at + int(rng.integers(1, 50))]
        else:
            bytes_[at:at] = rng.bytes(8) if rng.random() < 0.5 else b"99999999999"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(bytes_)
        if name == "m.npz":
            str(clvoro.load(path).check())
        elif name == "m.vtu":
            str(load_vtu(path).check())
        elif name == "a.npy":
            load_array(path, "points")
        elif name == "c.toml":
            case = load_case(path)
            case.size_field(), case.run_arguments()
        else:
            Saved(path)
    return "loaded"


WORK = {
    "diagram": (try_diagram, 0.5),
    "run": (try_run, 0.16),
    "file": (try_file, 0.16),
    "solid": (try_solid, 0.13),
    "solid-run": (try_solid_run, 0.05),
    "polygon": (try_polygon, 0.2),
    "polygon-run": (try_polygon_run, 0.05),
}


def attempt(seed: int, only: str | None = None) -> tuple[str, str]:
    """Try one input; return what kind it was, and how it ended."""
    rng = np.random.default_rng(seed)
    shares = np.array([share for _, share in WORK.values()])
    kind = str(rng.choice(list(WORK), p=shares / shares.sum()))
    if only is not None:
        kind = only
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return kind, WORK[kind][0](rng)
    except clvoro.ClvoroError:
        return kind, "refused"
    except OwnError:
        return kind, "refused"


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, help="of the first input (default: from the clock)")
    parser.add_argument(
        "--repeat", type=int, metavar="SEED", help="try this one input, and show how it ends"
    )
    parser.add_argument("--only", choices=list(WORK), help="inputs of one kind")
    parser.add_argument(
        "--out", type=Path, default=Path("fuzz-failures"), help="folder for what fails"
    )
    arguments = parser.parse_args()
    if arguments.repeat is not None:
        print(*attempt(arguments.repeat, arguments.only))
        return 0
    first = time.time_ns() % 10**9 if arguments.seed is None else arguments.seed
    print(f"first seed {first}", flush=True)
    ends: collections.Counter[tuple[str, str]] = collections.Counter()
    until, seed, failures = time.monotonic() + 60 * arguments.minutes, first, 0
    only = f" --only {arguments.only}" if arguments.only else ""
    arguments.out.mkdir(exist_ok=True, parents=True)
    now = arguments.out / "now.txt"
    while time.monotonic() < until:
        faulthandler.dump_traceback_later(SLOWEST, exit=True)
        now.write_text(f"python -m tests.fuzz --repeat {seed}{only}\n")  # should it crash or hang
        try:
            ends[attempt(seed, arguments.only)] += 1
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                break
            failures += 1
            text = f"python -m tests.fuzz --repeat {seed}{only}\n\n{traceback.format_exc()}"
            (arguments.out / f"{seed}.txt").write_text(text)
            print(f"seed {seed}: {type(error).__name__}: {error!s:.600}", flush=True)
        seed += 1
    faulthandler.cancel_dump_traceback_later()
    now.unlink(missing_ok=True)
    for (kind, end), count in sorted(ends.items()):
        print(f"{kind:8} {end:8} {count}")
    print(
        f"{seed - first} inputs, {failures} failures"
        + (f", in {arguments.out}" if failures else "")
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
