"""Throw everything at clvoro: `python -m tests.fuzz --minutes 10`.

Each input is made from one seed: generators in the plane and in space (clusters down to one ulp, lattices, circles,
lines, walls, corners, one to three points, scales 1e-300 to 1e300), periodic boxes, polygons, layers, size fields,
options, and files with bits changed. It must end in a mesh that passes `check`, or in a ClvoroError (a ValueError,
TypeError or MemoryError that says what is wrong). Whatever else happens is printed with its seed and saved;
`python -m tests.fuzz --repeat SEED` does it again. In the end it says how many inputs of each kind there were.
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
from clvoro.cases import load_case
from clvoro.cases.fields import load_array
from clvoro.checkpoint import Saved
from clvoro.io.vtu_read import load_vtu
from clvoro.layers import count_rows, free_domain, place_layers
from tests.fuzz_inputs import (
    OwnError,
    placed,
    placed_in_polygon,
    some_box,
    some_graded,
    some_layers,
    some_periodic_box,
    some_polygon,
    some_size,
    some_size_3d,
)
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


def try_solid_run(rng: np.random.Generator) -> str:
    return try_run(rng, 3)


def try_periodic(rng: np.random.Generator) -> str:
    box = some_periodic_box(rng, int(rng.choice([2, 2, 3])))
    diagram = adapter(rng.choice(["float64", "float64", "float32"])).diagram(box, placed(rng, box))
    demand(diagram.check())
    return "mesh"


def try_periodic_run(rng: np.random.Generator) -> str:
    dim = int(rng.choice([2, 2, 3]))
    return try_run(rng, dim, some_periodic_box(rng, dim))


def try_layers(rng: np.random.Generator) -> str:
    domain = some_polygon(rng) if rng.random() < 0.6 else some_box(rng)
    layers = some_layers(rng, domain)
    if 5000 < count_rows(domain, layers) < 1e9:  # a benchmark, not a test
        return "left out"
    if isinstance(domain, clvoro.Box):
        size = some_size(rng, domain)
    else:
        size = float(np.sqrt(domain.measure / 10 ** rng.uniform(0, 2.6)))
        size = some_graded(rng, domain, size) if rng.random() < 0.2 else size
    real = str(rng.choice(["float64", "float64", "float32"]))
    method = str(rng.choice(["adaptive", "exact", "coupled", "lloyd", "poisson", "weighted"]))
    optional = {
        "n_cells": lambda: int(rng.choice([1, 17, 400, 10**9])),
        "levels": lambda: int(rng.choice([0, 1, 2])),
        "points": lambda: (
            placed(rng, domain)
            if isinstance(domain, clvoro.Box)
            else placed_in_polygon(rng, domain)
        ),
    }
    options = {name: make() for name, make in optional.items() if rng.random() < 0.15}
    result = adapter(real).run(
        domain, size, layers=layers, method=method, max_steps=int(rng.integers(0, 15)), effort="fast",
        seed=int(rng.integers(99)), **options,
    )  # fmt: skip
    rows, free = place_layers(domain, layers), free_domain(domain, layers)
    # Coordinates of the device are relative to the frame, those of the host to 0.
    slack = 8 * np.finfo(real).eps * domain.extent.max() + 4 * np.spacing(
        np.abs(domain.upper).max()
    )
    slack += 4 * np.spacing(np.abs(domain.lower).max())
    if not np.abs(result.points[: len(rows)] - rows).max() <= slack:
        raise Wrong("a layer's generator has moved")
    others = result.points[len(rows) :]
    if isinstance(domain, clvoro.Box):
        away = np.abs(others - np.clip(others, free.lower, free.upper)).max(initial=0)
        demand(result.check())
    else:
        away = shapely.distance(free.geometry, shapely.points(others)).max(initial=0)
        found = faults(result.diagram, real)
        if found or not domain.contains(result.points).all():
            raise Wrong("; ".join([*found, f"{np.sum(~domain.contains(result.points))} outside"]))
    if not away <= slack:
        raise Wrong(f"generators are {away:.3g} beyond what layers leave to them")
    return "mesh"


def try_run(rng: np.random.Generator, dim: int = 2, box: clvoro.Box | None = None) -> str:
    box = some_box(rng, dim) if box is None else box
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
    "periodic": (try_periodic, 0.15),
    "periodic-run": (try_periodic_run, 0.06),
    "layers": (try_layers, 0.08),
}


def kind_of(seed: int) -> str:
    """Return what kind of input `seed` makes."""
    shares = np.array([share for _, share in WORK.values()])
    return str(np.random.default_rng(seed).choice(list(WORK), p=shares / shares.sum()))


def attempt(kind: str, seed: int) -> str:
    """Try one input; return how it ended."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return WORK[kind][0](np.random.default_rng((seed, 1)))
    except (clvoro.ClvoroError, OwnError):
        return "refused"


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
        kind = arguments.only or kind_of(arguments.repeat)
        print(kind, attempt(kind, arguments.repeat))
        return 0
    first = time.time_ns() % 10**9 if arguments.seed is None else arguments.seed
    print(f"first seed {first}", flush=True)
    ends = {kind: collections.Counter() for kind in WORK}
    until, seed, failures = time.monotonic() + 60 * arguments.minutes, first, 0
    only = f" --only {arguments.only}" if arguments.only else ""
    arguments.out.mkdir(exist_ok=True, parents=True)
    now = arguments.out / "now.txt"
    while time.monotonic() < until:
        faulthandler.dump_traceback_later(SLOWEST, exit=True)
        now.write_text(f"python -m tests.fuzz --repeat {seed}{only}\n")  # should it crash or hang
        kind = arguments.only or kind_of(seed)
        try:
            ends[kind][attempt(kind, seed)] += 1
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                break
            failures += 1
            ends[kind]["failed"] += 1
            text = f"python -m tests.fuzz --repeat {seed}{only}\n\n{traceback.format_exc()}"
            (arguments.out / f"{seed}.txt").write_text(text)
            print(f"seed {seed} ({kind}): {type(error).__name__}: {error!s:.600}", flush=True)
        seed += 1
    faulthandler.cancel_dump_traceback_later()
    now.unlink(missing_ok=True)
    for kind, counts in ends.items():
        if not counts:
            continue
        each = ", ".join(f"{count} {end}" for end, count in sorted(counts.items()))
        print(f"{kind:12} {counts.total():6} inputs: {each}")
    print(
        f"{seed - first} inputs, {failures} failures"
        + (f", in {arguments.out}" if failures else "")
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
