"""Whether meshes are the same bits as before: hashes of about a hundred small meshes.

    python bench/same_meshes.py [--save FILE.json [--arrays]] [--compare FILE.json]
                                [--only SUBSTRING] [--device NAME] [--dtype float32] [--json]

Boxes, polygons, periodic boxes, layers, each method, effort and precision, several kinds of size
fields, given generators, transfers and resumed runs, with fixed seeds. A hash is the first 16 hex
digits of SHA-256 over type, shape and bytes of an array. `--save` writes the hashes, and `--arrays`
the arrays themselves to FILE.npz beside FILE.json. `--compare` prints only which arrays differ from those
of the file, by how much if FILE.npz is there, and returns 1 if any does. Hashes hold for one device
and its driver: `--compare` says if the file comes from another one. `--only` takes the runs whose
names contain the text, `--dtype` those of one precision.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _common import BOX, CUBE, PERIODIC, PERIODIC_CUBE, SQUARE, Report, device_name, heading, parser

import clvoro
from clvoro import sizing

SEED = 20251
DIAGRAM = (
    *("points", "volumes", "centroids", "neighbor_starts", "neighbors", "shifts", "face_measures", "face_centroids"),
    *("vertices", "cell_vertex_starts", "cell_vertices", "face_vertex_starts", "face_vertices"),
)
"""Arrays of a diagram. Diagrams in 2D and 3D lack some."""
RESULT = {"size": "target_size", "error": "size_error", "quality": "quality", "origin": "origin"}
"""Arrays that a result has besides."""

Arrays = dict[str, np.ndarray]
Run = Callable[[clvoro.Adapter], "clvoro.Diagram | clvoro.Result | Arrays"]


@dataclass(frozen=True)
class Case:
    """A run, or a diagram, in one precision."""

    label: str
    run: Run
    dtype: str = "float64"


def arrays_of(mesh: clvoro.Diagram | clvoro.Result | Arrays) -> Arrays:
    """Return the arrays of a result, a diagram, or what is a mapping of arrays already."""
    if isinstance(mesh, dict):
        return mesh
    result = isinstance(mesh, clvoro.Result)
    diagram = mesh.diagram if result else mesh
    derived = () if "face_vertices" in diagram._arrays else ("face_vertex_starts", "face_vertices")
    found = {name: getattr(diagram, name, None) for name in DIAGRAM if name not in derived}
    if result:
        found |= {name: getattr(mesh, attribute) for name, attribute in RESULT.items()}
        found["points"] = mesh.points
    return {name: np.asarray(array) for name, array in found.items() if array is not None}


# Runs.


def adapted(domain: Any, size: Any, **options: Any) -> Run:
    return lambda adapter: adapter.run(domain, size, seed=SEED, **options)


def tessellated(domain: Any, points: np.ndarray) -> Run:
    return lambda adapter: adapter.diagram(domain, points)


def adapted_again(domain: Any, first: Any, second: Any, **options: Any) -> Run:
    """Run for the size `first`, then for `second` from there."""

    def run(adapter: clvoro.Adapter) -> clvoro.Result:
        before = adapted(domain, first, **options)(adapter)
        return adapted(domain, second, points=before.points, **options)(adapter)

    return run


def transferred(domain: Any, first: Any, second: Any, **options: Any) -> Run:
    """Transfer two columns of values from the mesh of one size to that of another."""

    def run(adapter: clvoro.Adapter) -> Arrays:
        one, other = (adapted(domain, size, effort="fast")(adapter) for size in (first, second))
        x = one.diagram.centroids
        values = np.column_stack([x[:, 0] ** 2 + x[:, -1], x[:, 0] > x[:, 1]])
        return {"values": one.transfer(values, other, adapter=adapter, **options)}

    return run


def resumed(domain: Any, size: Any, rows: int, **options: Any) -> Run:
    """Stop a run after some steps, at a checkpoint, and resume it."""

    def run(adapter: clvoro.Adapter) -> clvoro.Result:
        seen: list[object] = []

        def stop(row: object) -> bool:
            seen.append(row)
            return len(seen) > rows

        with tempfile.TemporaryDirectory() as folder:
            state = Path(folder) / "state"
            once = adapted(domain, size, callback=stop, checkpoint=clvoro.Checkpoint(state, every=1e9), **options)
            once(adapter)
            return adapted(domain, size, checkpoint=clvoro.Checkpoint(resume=state), **options)(adapter)

    return run


# Domains and sizes.

CHANNEL = clvoro.Box((0, 0), (2, 1), periodic=(True, False))
CHANNEL_3D = clvoro.Box((0, 0, 0), (1, 1, 1), periodic=(True, False, True))


def circle(h_min: float, x: float = 0.9, **options: Any) -> sizing.Field:
    """Return sizes that grow from a circle in `BOX`."""
    return sizing.Distance(sizing.Circle((x, 0.75), 0.3), h_min=h_min, slope=0.3, **options)


def sphere(h_min: float, x: float = 0.5) -> sizing.Field:
    """Return sizes that grow from a sphere in `CUBE`."""
    return sizing.Distance(sizing.Ball((x, 0.5, 0.4), 0.25), h_min=h_min, slope=0.3)


def ring(edges: int, radius: float = 0.4, lobes: float = 0.08) -> np.ndarray:
    """Return a closed curve of five lobes about (0.5, 0.5), counterclockwise."""
    t = np.linspace(0, 2 * np.pi, edges, endpoint=False)
    r = radius + lobes * np.sin(5 * t)
    return 0.5 + r[:, None] * np.column_stack([np.cos(t), np.sin(t)])


TRIANGLE = np.array([(0.5, 0.45), (0.6, 0.45), (0.55, 0.55)])
LAKE = clvoro.Polygon(ring(120), [TRIANGLE, TRIANGLE * 0.5 + (0.1, 0.3)])
LAKE_REVERSED = clvoro.Polygon(ring(120)[::-1], [TRIANGLE])
COAST = clvoro.Polygon(ring(1500), [TRIANGLE])
PIECES = clvoro.Polygon.from_pieces(
    [[[(0, 0), (1, 0), (1, 1), (0, 1)], TRIANGLE], [np.add(ring(60), (1.2, 0))], [[(0.2, 1.1), (1, 1.1), (0.6, 1.6)]]]
)
SLIT = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (0, 1)], [[(0.4, 0.5), (1.6, 0.5), (1.6, 0.5001), (0.4, 0.5001)]])
L_SHAPE = clvoro.Polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)])
PUBLISHED = ("lloyd", "poisson", "coupled", "weighted-lloyd", "weighted")


def box_cases() -> Iterator[Case]:
    for effort, h in (("fast", 0.015), ("default", 0.02), ("best", 0.035)):
        yield Case(f"2D box, {effort}", adapted(BOX, circle(h), effort=effort))
    for method in PUBLISHED:
        yield Case(f"2D box, {method}", adapted(BOX, circle(0.02), method=method, max_steps=12))
    yield Case("2D box, two levels", adapted(BOX, circle(0.015), options=clvoro.MultilevelOptions(levels=1)))
    yield Case("2D box, exact", adapted(BOX, circle(0.03), method="exact"))
    yield Case("2D box, number of cells", adapted(BOX, circle(0.03), n_cells=900, method="exact", effort="fast"))
    yield Case("2D box, uniform start", adapted(BOX, circle(0.03), points="uniform", effort="fast"))
    yield Case("2D box", adapted(BOX, circle(0.03)), "float32")
    yield Case("2D box, coupled", adapted(BOX, circle(0.02), method="coupled", max_steps=12), "float32")
    for effort, h in (("fast", 0.05), ("default", 0.07), ("best", 0.11)):
        yield Case(f"3D box, {effort}", adapted(CUBE, sphere(h), effort=effort))
    for method in PUBLISHED:
        yield Case(f"3D box, {method}", adapted(CUBE, sphere(0.09), method=method, max_steps=4))
    yield Case("3D box, two levels", adapted(CUBE, sphere(0.06), options=clvoro.MultilevelOptions(levels=1)))
    yield Case("3D box, exact", adapted(CUBE, sphere(0.09), method="exact", effort="fast"))
    yield Case("3D box, fast", adapted(CUBE, sphere(0.08), effort="fast"), "float32")


def periodic_cases() -> Iterator[Case]:
    spot = sizing.Distance(sizing.Circle((0.05, 0.9), 0.1), h_min=0.02, slope=0.3, h_max=0.05)
    ball = sizing.Distance(sizing.Ball((0.1, 0.9, 0.5), 0.2), h_min=0.08, slope=0.3, h_max=0.12)
    for dtype in ("float64", "float32"):
        yield Case("2D periodic", adapted(PERIODIC, spot, effort="fast"), dtype)
        yield Case("3D periodic", adapted(PERIODIC_CUBE, ball, effort="fast"), dtype)
    yield Case("2D periodic, exact", adapted(PERIODIC, spot, method="exact"))
    yield Case(
        "2D periodic, three levels", adapted(PERIODIC, 0.02, options=clvoro.MultilevelOptions(levels=2), effort="fast")
    )
    yield Case(
        "3D periodic, two levels",
        adapted(PERIODIC_CUBE, 0.08, options=clvoro.MultilevelOptions(levels=1), effort="fast"),
    )
    yield Case("2D periodic, coupled", adapted(PERIODIC, spot, method="coupled", max_steps=12))
    yield Case("2D periodic channel", adapted(CHANNEL, spot))
    yield Case("3D periodic channel", adapted(CHANNEL_3D, ball, effort="fast"))


def polygon_cases() -> Iterator[Case]:
    for dtype in ("float64", "float32"):
        yield Case("polygon with holes", adapted(LAKE, 0.025, effort="fast"), dtype)
    shore = sizing.Distance(COAST.boundary(), h_min=0.012, slope=0.3)
    yield Case("polygon, outer ring clockwise", adapted(LAKE_REVERSED, 0.03))
    yield Case("polygon, exact", adapted(LAKE, 0.03, method="exact", effort="fast"))
    yield Case("polygon, two levels", adapted(LAKE, 0.015, options=clvoro.MultilevelOptions(levels=1), effort="fast"))
    yield Case("polygon, coupled", adapted(LAKE, 0.03, method="coupled", max_steps=12))
    yield Case("polygon, edges finer than cells", adapted(COAST, shore, effort="fast"))
    yield Case("polygon, several pieces", adapted(PIECES, 0.04, effort="fast"))
    yield Case("polygon, slit", adapted(SLIT, 0.04, effort="fast"))
    yield Case("polygon, re-entrant corner", adapted(L_SHAPE, 0.03))


def layer_cases() -> Iterator[Case]:
    rows = clvoro.Layers(0.01, count=3, growth=1.2)
    below = clvoro.Layers(0.01, count=4, growth=1.2, spacing=0.03, edges=[2])
    yield Case("layers, 2D box", adapted(SQUARE, 0.05, layers=rows, effort="fast"))
    yield Case("layers, one wall", adapted(SQUARE, 0.05, layers=below))
    yield Case("layers, 2D periodic channel", adapted(CHANNEL, 0.06, layers=rows, effort="fast"))
    yield Case("layers, polygon", adapted(LAKE, 0.04, layers=rows, effort="fast"))
    yield Case("layers, re-entrant corner", adapted(L_SHAPE, 0.05, layers=rows, effort="fast"), "float32")


def size_cases() -> Iterator[Case]:
    rng = np.random.default_rng(SEED)
    x = np.linspace(0, 1, 61)
    front = np.tanh((np.hypot(*np.meshgrid(x, x)) - 0.6) / 0.05)
    curve = np.column_stack([np.linspace(0.1, 0.9, 80), 0.5 + 0.2 * np.sin(np.linspace(0, 9, 80))])
    jump = sizing.Expression("x < 0.5 ? 0.02 : 0.1")
    raster = sizing.Raster(0.03 + 0.02 * rng.random((40, 50)), (0, 0), (1, 1))
    corners = [(0.3, 0.3, 0.3), (0.7, 0.3, 0.3), (0.3, 0.7, 0.3), (0.3, 0.3, 0.7)]
    solid = sizing.Surface(corners, [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    fields = {
        "number": 0.03,
        "growth and h_max": sizing.Distance(sizing.Segment((0.2, 0.2), (0.7, 0.9)), 0.015, growth=1.2, h_max=0.05),
        "polyline": sizing.Distance(sizing.Polyline(curve), h_min=0.015, slope=0.2),
        "expression": sizing.Expression("0.02 + 0.3 * fabs(hypot(x - 0.4, y - 0.6) - 0.3)"),
        "graded": sizing.Graded(jump, 1.2),
        "raster": raster,
        "scattered": sizing.Scattered(rng.random((300, 2)), 0.03 + 0.02 * rng.random(300), (0, 0), (1, 1)),
        "callable": lambda p: 0.02 + 0.05 * p[:, 0],
        "minimum": sizing.minimum(raster, lambda p: 0.02 + 0.05 * p[:, 1]),
        "hessian": sizing.hessian_size(sizing.Raster(front, (0, 0), (1, 1)), n_cells=1000),
        "gradient": sizing.gradient_size(sizing.Raster(front, (0, 0), (1, 1)), n_cells=1000, h_max=0.1),
    }
    for kind, field in fields.items():
        yield Case(f"size, {kind}", adapted(SQUARE, field, effort="fast"))
    features = sizing.FeatureSize(LAKE, cells_across=4, h_min=0.015, h_max=0.06)
    yield Case("size, features of a polygon", adapted(LAKE, features, effort="fast"))
    fields_3d = {
        "expression": sizing.Expression("0.06 + 0.1 * x * y"),
        "surface": sizing.Distance(solid, h_min=0.06, slope=0.3),
        "graded": sizing.Graded(sizing.Expression("z < 0.3 ? 0.06 : 0.3"), 1.2),
        "raster": sizing.Raster(0.07 + 0.03 * rng.random((5, 6, 7)), (0, 0, 0), (1, 1, 1)),
    }
    for kind, field in fields_3d.items():
        yield Case(f"size in 3D, {kind}", adapted(CUBE, field, effort="fast"))


def sequel_cases() -> Iterator[Case]:
    rng = np.random.default_rng(SEED)
    some, few, some_3d = rng.random((1000, 2)), rng.random((100, 2)), rng.random((600, 3))
    yield Case("given points, any", adapted(SQUARE, 0.03, points=some, effort="fast"))
    yield Case("given points, few", adapted(SQUARE, 0.03, points=few, effort="fast"))
    yield Case("given points, lloyd", adapted(SQUARE, 0.03, points=some, method="lloyd", max_steps=5))
    yield Case("given points, no step", adapted(SQUARE, 0.03, points=some, method="coupled", max_steps=0))
    yield Case("given points in 3D, any", adapted(CUBE, 0.12, points=some_3d, effort="fast"))
    yield Case("warm start, 2D", adapted_again(BOX, circle(0.03), circle(0.03, x=0.96)))
    yield Case("warm start, 3D", adapted_again(CUBE, sphere(0.09), sphere(0.09, x=0.55), effort="fast"))
    fine, coarse = circle(0.03), circle(0.05, x=1.2)
    for order in (1, 2):
        yield Case(f"transfer, 2D, order {order}", transferred(BOX, fine, coarse, order=order))
    yield Case("transfer, 2D periodic", transferred(PERIODIC, 0.05, 0.04, order=2))
    yield Case("transfer, polygon", transferred(LAKE, 0.05, 0.04, order=2))
    yield Case("transfer, 3D", transferred(CUBE, sphere(0.12), sphere(0.1, x=0.6), order=2))
    yield Case("resumed, 2D", resumed(BOX, circle(0.05), rows=30, effort="fast"))
    yield Case("resumed, 2D, coupled", resumed(BOX, circle(0.05), rows=4, method="coupled", max_steps=9))
    yield Case("resumed, 3D", resumed(CUBE, sphere(0.12), rows=20, effort="fast"))
    pipe = clvoro.Solid.cylinder((0, 0, 0), (0, 0, 1), 0.5, edge=0.1)
    yield Case("solid, cylinder", adapted(pipe, 0.2, effort="fast"))
    angle = clvoro.Solid.extruded(clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]), 0, 1)
    yield Case("solid, resumed in a re-entrant corner", resumed(angle, 0.35, rows=20, effort="fast"))


# Diagrams alone.


def grid(m: int, dim: int) -> np.ndarray:
    """Return the centers of `m` cubes along each side of a unit box, (m^dim, dim)."""
    line = (np.arange(m) + 0.5) / m
    return np.stack(np.meshgrid(*[line] * dim, indexing="ij"), -1).reshape(-1, dim)


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    v = rng.standard_normal((count, 3))
    return v / np.linalg.norm(v, axis=1)[:, None]


def diagram_cases() -> Iterator[Case]:
    rng = np.random.default_rng(SEED)
    turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    wheel = np.column_stack([np.cos(turn), np.sin(turn)])
    plane = np.linalg.qr(rng.standard_normal((3, 3)))[0][:2]
    cloud, cloud_3d, beside = rng.random((5000, 2)), rng.random((4000, 3)), rng.random((60, 3))
    cluster = np.vstack([0.3 + 1e-9 * rng.standard_normal((30, 2)), rng.random((9, 2))])
    step = np.unique(rng.integers(0, 9, (60, 2)), axis=0)
    sets = {
        "random": cloud,
        "lattice": grid(30, 2),
        "sheared lattice": (grid(30, 2) + grid(30, 2)[:, ::-1] * [0.5, 0]) * [2 / 3, 1],
        "ring": 0.5 + 0.3 * wheel,
        "cluster": cluster,
    }
    for name, points in sets.items():
        yield Case(f"diagram, 2D {name}", tessellated(SQUARE, points))
    for name in ("random", "lattice", "cluster"):
        yield Case(f"diagram, 2D periodic {name}", tessellated(PERIODIC, sets[name]))
    for dtype in ("float64", "float32"):
        spacing = 2 * float(np.spacing(np.dtype(dtype).type(0.6875)))
        near = np.vstack([0.6875 + spacing * step, rng.random((300, 2))])
        yield Case("diagram, 2D a few roundings apart", tessellated(SQUARE, near), dtype)
    inside = cloud[LAKE.contains(cloud)]
    yield Case("diagram, polygon", tessellated(LAKE, inside[:1500]))
    yield Case("diagram, polygon of few cells", tessellated(LAKE, inside[:5]))
    yield Case("diagram, 2D random", tessellated(SQUARE, cloud), "float32")
    yield Case("diagram, 2D one generator", tessellated(PERIODIC, cloud[:1]))
    solids = {
        "random": cloud_3d,
        "lattice": grid(10, 3),
        "body-centered lattice": np.concatenate([grid(8, 3) - 1 / 32, grid(8, 3) + 1 / 32]),
        "ring": np.vstack([0.5 + 0.3 * wheel[::3] @ plane, beside]),
        "sphere": np.vstack([0.5 + 0.3 * directions(rng, 300), beside]),
        "sphere and center": np.vstack([0.5 + 0.3 * directions(rng, 100), [(0.5, 0.5, 0.5)]]),
    }
    for name, points in solids.items():
        yield Case(f"diagram, 3D {name}", tessellated(CUBE, points))
    for name in ("random", "lattice", "body-centered lattice"):
        yield Case(f"diagram, 3D periodic {name}", tessellated(PERIODIC_CUBE, solids[name]))
    for name in ("random", "lattice", "sphere"):
        yield Case(f"diagram, 3D {name}", tessellated(CUBE, solids[name]), "float32")


def cases() -> Iterator[Case]:
    for group in (diagram_cases, box_cases, periodic_cases, polygon_cases, layer_cases, size_cases, sequel_cases):
        for case in group():
            yield Case(f"{case.label}, {case.dtype}", case.run, case.dtype)


# Hashes.


def hash_of(array: np.ndarray) -> str:
    """Return 16 hex digits that stand for type, shape and bytes of an array."""
    head = f"{array.dtype.str} {array.shape} ".encode()
    return hashlib.sha256(head + np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


def record_of(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the number of cells, one hash of all arrays but the points, and one of each."""
    hashes = {name: hash_of(array) for name, array in arrays.items()}
    others = "".join(f"{name}{digits}" for name, digits in hashes.items() if name != "points")
    return {
        "cells": len(next(iter(arrays.values()))),
        "points": hashes.get("points", "-"),
        "diagram": hashlib.sha256(others.encode()).hexdigest()[:16],
        "arrays": hashes,
    }


def difference(new: np.ndarray, old: np.ndarray) -> str:
    """Return how an array differs from that of the file."""
    if new.shape != old.shape:
        return f"shape {new.shape}, was {old.shape}"
    number = np.count_nonzero(new != old)
    kind = "" if new.dtype == old.dtype else f"{new.dtype}, was {old.dtype}; "
    if not number:
        return f"{kind}equal values"
    most = np.abs(new.astype(float) - old.astype(float)).max()
    return f"{kind}{number} of {new.size} values, by {most:.3g} at most"


def differences(
    label: str, new: Mapping[str, Any], old: Mapping[str, Any], arrays: Arrays, stored: Mapping[str, np.ndarray]
) -> Iterator[str]:
    """Yield one line for each array whose hash differs."""
    if "error" in new or "error" in old:
        if new.get("error") != old.get("error"):
            yield f"{new.get('error', 'a mesh')}, was {old.get('error', 'a mesh')}"
        return
    if new["cells"] != old["cells"]:
        yield f"{new['cells']} cells, was {old['cells']}"
    for name in dict.fromkeys([*old["arrays"], *new["arrays"]]):
        one, other = new["arrays"].get(name), old["arrays"].get(name)
        if one is None or other is None:
            yield f"{name}: only in the {'file' if one is None else 'new mesh'}"
        elif one != other:
            key = f"{label}/{name}"
            yield f"{name}: {difference(arrays[name], stored[key]) if key in stored else 'differs'}"


class Comparison:
    """The runs of a file, and what differs from them."""

    def __init__(self, path: Path):
        file = json.loads(path.read_text(encoding="utf-8"))
        self.device, self.runs = file["device"], file["runs"]
        beside = path.with_suffix(".npz")
        self.stored = np.load(beside) if beside.exists() else {}
        self.lines: list[str] = []

    def add(self, label: str, record: Mapping[str, Any], arrays: Arrays) -> None:
        """Compare one run with that of the file."""
        if label not in self.runs:
            found = ["is not in the file"]
        else:
            found = list(differences(label, record, self.runs[label], arrays, self.stored))
        self.lines += [f"{label} ({record.get('cells', 0)} cells): {line}" for line in found]

    def finish(self, device: str, count: int) -> int:
        """Print what differs; return the exit code."""
        if device != self.device:
            print(f"The file's device is {self.device}, this one is {device}: hashes may differ.")
        for line in self.lines:
            print(line)
        runs = len({line.partition(" (")[0] for line in self.lines})
        print(f"{runs} of {count} runs differ." if runs else f"All {count} runs are the same bits.")
        return 1 if self.lines or not count else 0


COLUMNS = {
    "run": lambda r: r["run"],
    "cells": lambda r: r.get("cells", r.get("error")),
    "points": lambda r: r.get("points", ""),
    "diagram": lambda r: r.get("diagram", ""),
}


def main() -> int:
    made = parser(__doc__)
    made.set_defaults(dtype=None)
    made.add_argument("--save", type=Path, metavar="FILE.json", help="write the hashes")
    made.add_argument("--arrays", action="store_true", help="with --save: write the arrays, too")
    made.add_argument("--compare", type=Path, metavar="FILE.json", help="print what differs from that file")
    made.add_argument("--only", default="", metavar="SUBSTRING", help="of the names of runs")
    options = made.parse_args()
    comparison = Comparison(options.compare) if options.compare else None
    context = clvoro.create_context(options.device)
    adapters = {dtype: clvoro.Adapter(context, dtype=dtype) for dtype in ("float64", "float32")}
    device = device_name(adapters["float64"])
    report = Report(options.json, COLUMNS)
    runs, kept = {}, {}
    warnings.simplefilter("ignore")
    for case in cases():
        if options.only not in case.label or options.dtype not in (None, case.dtype):
            continue
        arrays: Arrays = {}
        try:
            arrays = arrays_of(case.run(adapters[case.dtype]))
            record = record_of(arrays)
        except clvoro.ClvoroError as error:
            record = {"error": type(error).__name__}
            print(f"{case.label}: {error}", file=sys.stderr)
        runs[case.label] = record
        if comparison is None:
            report.add({"run": case.label, **record}, case.label)
        else:
            comparison.add(case.label, record, arrays)
        if options.arrays:
            kept |= {f"{case.label}/{name}": array for name, array in arrays.items()}
    if comparison is None:
        report.finish(heading(adapters["float64"], "Hashes of meshes"))
    if options.save:
        text = json.dumps({"device": device, "runs": runs}, indent=1)
        options.save.write_text(text + "\n", encoding="utf-8")
        if options.arrays:
            np.savez_compressed(options.save.with_suffix(".npz"), **kept)
    failed = any("error" in record for record in runs.values())
    code = comparison.finish(device, len(runs)) if comparison is not None else 0
    return 1 if failed else code


if __name__ == "__main__":
    raise SystemExit(main())
