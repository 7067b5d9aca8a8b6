"""Valid files of every kind that clvoro reads; how they are damaged and read."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

import numpy as np

import clvoro
from clvoro.adaptation.checkpoint import Saved
from clvoro.cli.cases import load_case
from clvoro.cli.cases.schema import PolygonTable, load_array
from clvoro.io.vtu_read import load_vtu
from clvoro.sizing import Surface

CASE = b"""name = "fuzz"
[domain]
lower = [0, 0]
upper = [2, 1]
[size]
kind = "min"
fields = [{kind = "constant", value = 0.2}, {kind = "expression", expression = "0.1 + x*y + pow(x, 2)"},
  {kind = "distance", shapes = [{kind = "circle", center = [1, 0.5], radius = 0.2}], h_min = 0.1, growth = 1.2}]
[run]
method = "coupled"
seed = 3
[[layers]]
height = 0.02
edges = [0, 2]
"""
GEOJSON = b"""{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"name": "lake"},
  "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [3, -0.3], [4, 1.0], [2.5, 2.2], [1, 2], [0, 0]],
    [[1, 0.8], [1.5, 1.2], [1.6, 0.7], [1, 0.8]]]}},
  {"type": "Feature", "geometry": {"type": "MultiPolygon", "coordinates": [[[[5, 0, 7], [6, 0, 7], [6, 1, 7]]]]}}]}
"""
WKT = b"MULTIPOLYGON (((0 0, 3 -0.3, 4 1, 1 2, 0 0), (1 0.8, 1.5 1.2, 1.6 0.7, 1 0.8)), ((5 0, 6 0, 6 1, 5 0)))\n"
BOX = clvoro.Box((0, 0), (1, 1))
RUN = {"method": "coupled", "max_steps": 2, "seed": 5}
"""Options of the run that wrote the checkpoint."""


def surfaces() -> dict[str, bytes]:
    """A tetrahedron in every format."""
    import trimesh

    corners = np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])
    sides = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    mesh = trimesh.Trimesh(corners, sides, process=False)
    kinds = {"s.stl": "stl", "ascii.stl": "stl_ascii", "s.obj": "obj", "s.off": "off", "s.ply": "ply"}
    made = {name: mesh.export(file_type=kind) for name, kind in kinds.items()}
    return {k: v.encode() if isinstance(v, str) else bytes(v) for k, v in made.items()}


def valid_files(adapter: clvoro.Adapter) -> dict[str, bytes]:
    """A valid file of each kind by name."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        checkpoint = clvoro.Checkpoint(folder / "state", every=0)
        result = adapter.run(BOX, 0.2, checkpoint=checkpoint, **RUN)
        result.save(folder / "m.npz")
        result.save(folder / "m.vtu")
        np.save(folder / "a.npy", result.points)
        for file, text in {"c.toml": CASE, "g.geojson": GEOJSON, "w.wkt": WKT, **surfaces()}.items():
            (folder / file).write_bytes(text)
        return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def damaged(rng: np.random.Generator, data: bytes) -> bytes:
    """Return `data` with some bits changed, bytes lost, doubled or exchanged, or numbers put in."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        # A third of the damage each: anywhere, at the beginning, and at the end, where formats have headers.
        size = max(len(changed), 1)
        at = int([rng.integers(size), rng.integers(600), size - rng.integers(600)][rng.integers(3)])
        at = min(max(at, 0), size - 1)
        change = rng.integers(0, 6)
        if change == 0 and changed:
            changed[at] ^= 1 << int(rng.integers(0, 8))
        elif change == 1 and rng.random() < 0.3:
            del changed[at:]
        elif change == 2:
            changed[at:at] = changed[at : at + int(rng.integers(1, 300))]
        elif change == 3:
            del changed[at : at + int(rng.integers(1, 50))]
        elif change == 4:
            changed[at:at] = rng.bytes(8) if rng.random() < 0.5 else b"99999999999"
        else:
            digits = [i for i in range(at, min(at + 200, len(changed))) if 48 <= changed[i] < 58]
            if digits:
                changed[digits[0]] = 48 + int(rng.integers(10))
    return bytes(changed)


def read(path: Path) -> object:
    """Read a file as its name says, and use its contents as far as possible without a device."""
    if path.suffix in (".npz", ".vtu"):
        result = (clvoro.load if path.suffix == ".npz" else load_vtu)(path)
        str(result.check())
        return result
    if path.suffix == ".npy":
        return load_array(path, "points")
    if path.suffix == ".toml":
        case = load_case(path)
        return case.size_field(), case.run_arguments()
    if path.suffix == ".geojson":
        return clvoro.Polygon.from_geojson(path)
    if path.suffix == ".wkt":
        return PolygonTable(file=path.name).build(path.parent)
    if path.suffix in (".stl", ".obj", ".off", ".ply"):
        surface = Surface.read(path)
        with np.errstate(all="ignore"):
            surface.closed, surface.distance2(np.zeros((1, 3)))
        return surface
    return Saved(path)


def same(a: Saved, b: Saved) -> bool:
    """Return whether two checkpoints have the same content."""
    return set(a.arrays) == set(b.arrays) and all(_bytes(a.arrays[name]) == _bytes(b.arrays[name]) for name in a.arrays)


def _bytes(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array)
    return stream.getvalue()
