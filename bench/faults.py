"""Input that other people reported for meshing programs, and whether clvoro does what is right.

    python bench/faults.py [--only lloyd,mpas,...] [--device NAME] [--dtype float32] [--json]

Each row is one input: what is right, what happens, and a verdict. The exit code is the number of wrong ones.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.io
import shapely
from _common import Report, make_adapter, names, parser

import clvoro
from clvoro import earth, sizing
from clvoro.errors import InputError

Found = tuple[bool, str]
"""Whether what happens is right, and what it is."""
HOOK = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
SPIKED = [(0, 0), (4, 0), (4, 2), (6, 2), (4, 2), (4, 4), (0, 4)]
DEGREES = [(-70.5, 60.5), (-70.5, 61.5), (-69.0, 61.5), (-69.0, 60.5)]


def caught(call: Callable[[], object]) -> tuple[object, list[str]]:
    """Return the result of a call, or its InputError, and the warnings."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        try:
            result = call()
        except InputError as error:
            result = error
    return result, [str(w.message) for w in found]


def lloyd(adapter: clvoro.Adapter, _: Path) -> Found:
    domain, rng = clvoro.Polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)]), np.random.default_rng(0)
    points = rng.random((8000, 2))
    points = points[domain.contains(points)][:400]
    options = clvoro.PaperOptions(tol=0)
    off, said = [], []
    for h in (1.0, 0.0433):
        mesh, words = caught(
            lambda h=h: adapter.run(domain, h, points=points, method="lloyd", max_steps=300, options=options)
        )
        away = np.linalg.norm(mesh.points - 0.5, axis=1) > 0.17
        off.append(float(np.linalg.norm(mesh.points - mesh.centroids, axis=1)[away].max() / 0.0433))
        said.append(any("of the size field" in w for w in words))
    right = off[0] == off[1] < 0.1 and said == [True, False]
    return right, f"largest motion {off[0]:.1e} and {off[1]:.1e} of a cell, warnings {said}"


def mpas(adapter: clvoro.Adapter, folder: Path) -> Found:
    mesh = adapter.run(clvoro.Polygon(HOOK), 0.1, "fast")
    refused, _ = caught(lambda: mesh.to_netcdf(folder / "hook.nc", convention="mpas"))
    part = adapter.run(clvoro.Box((-0.3, -0.3), (2.3, 2.3)), 0.1, "fast").subset(clvoro.Polygon(HOOK))
    part.to_netcdf(folder / "part.nc", convention="mpas")
    report = part.check(solver="mpas")
    right = isinstance(refused, InputError) and "subset" in str(refused) and bool(report)
    return right, f"{type(refused).__name__}, then {len(part)} cells, {str(report).splitlines()[0]}"


def transfer(adapter: clvoro.Adapter, _: Path) -> Found:
    globe, land = clvoro.Sphere(1.0), shapely.union(shapely.box(-80, -50, -40, 60), shapely.box(0, -30, 50, 70))
    coarse, fine = (adapter.run(globe, 1.0, "fast", n_cells=n) for n in (1000, 3000))
    oceans = [g.subset(earth.ocean(g, land)) for g in (coarse, fine)]
    lake = adapter.run(clvoro.Polygon([(0.2, 0.1), (1.8, 0.15), (1.9, 0.8), (0.9, 0.95)]), 0.1, "fast")
    grid = adapter.run(clvoro.Box((0, 0), (2, 1)), 0.1, "fast")
    right, shares = True, []
    for old, new in ((coarse, oceans[0]), (oceans[0], oceans[1]), (grid, lake)):
        values, share = old.transfer(np.ones(len(old.points)), onto=new, covered=True)
        right &= bool(np.allclose(values[share > 1e-9], 1))
        shares.append(float(share.mean()))
    return right and shares[0] > 1 - 1e-9 and shares[2] > 1 - 1e-9, f"mean covered shares {np.round(shares, 4)}"


def pieces(adapter: clvoro.Adapter, _: Path) -> Found:
    parts = shapely.MultiPolygon([shapely.box(0, 0, 2, 2), shapely.box(3, 0, 3.5, 0.5)])
    domain, points = clvoro.Polygon.from_shapely(parts), np.random.default_rng(0).random((8, 2)) * 2
    said = [caught(lambda v=v: adapter.transport(domain, points, np.full(8, v / 8)))[0] for v in (domain.measure, 4)]
    found = adapter.transport(domain.split()[0], points, np.full(8, 0.5))
    right = all("piece 1 of the domain" in str(error) for error in said) and found.converged
    return right, str(said[0])[:80]


def dangle(adapter: clvoro.Adapter, _: Path) -> Found:
    del adapter
    refused, _ = caught(lambda: clvoro.Polygon.from_shapely(shapely.Polygon(SPIKED)))
    found = clvoro.Polygon.from_shapely(shapely.make_valid(shapely.Polygon(SPIKED)))
    return isinstance(refused, InputError) and found.measure == 16, str(found)


def degrees(adapter: clvoro.Adapter, folder: Path) -> Found:
    ring = shapely.Polygon(DEGREES)
    (folder / "d.geojson").write_text(shapely.to_geojson(ring))
    makers = (
        lambda: clvoro.Polygon.from_geojson(folder / "d.geojson"),
        lambda: clvoro.Polygon.from_shapely(ring),
        lambda: clvoro.Polygon.from_wkt(ring.wkt),
        lambda: clvoro.Polygon(DEGREES),
    )
    said = [any("like degrees" in w for w in caught(lambda m=m: adapter.run(m(), 0.1, "fast"))[1]) for m in makers]
    return all(said), f"warnings {said}"


def seam(adapter: clvoro.Adapter, _: Path) -> Found:
    values = np.full((181, 361), 1e6)
    other = values.copy()
    other[:, -1] = 5e5
    rasters = (sizing.Raster(x, (-180, -90), (180, 90)) for x in (values, other))
    said = [caught(lambda r=r: adapter.run(clvoro.Sphere(), r, "fast"))[1] for r in rasters]
    differs = ["different values at longitude" in " ".join(words) for words in said]
    return differs == [False, True], f"warnings {differs}"


def tile(adapter: clvoro.Adapter, _: Path) -> Found:
    coarse = sizing.Raster(np.full((61, 101), 400.0), (0, 0), (10e3, 6e3))
    fine = sizing.Raster(np.full((11, 11), 60.0), (4e3, 2e3), (5e3, 3e3), outside="ignore")
    both = sizing.minimum(coarse, fine)
    h = both(np.array([(9e3, 5e3), (4.5e3, 2.5e3)]))
    mesh, _ = caught(lambda: adapter.run(clvoro.Box((0, 0), (10e3, 6e3)), sizing.Graded(both, growth=1.3), "fast"))
    return h.tolist() == [400, 60] and len(mesh.points) < 2000, f"h {h}, {len(mesh.points)} cells"


def units(adapter: clvoro.Adapter, folder: Path) -> Found:
    mesh = adapter.run(clvoro.Sphere(1.0), 0.4, "fast")
    mesh.to_netcdf(folder / "full.nc", convention="ugrid")

    def named(word: str | bytes) -> str:
        word = word.decode() if isinstance(word, bytes) else word
        return word.replace("mesh_face_x", "face_lon").replace("mesh_face_y", "face_lat")

    with (
        scipy.io.netcdf_file(folder / "full.nc", mmap=False) as old,
        scipy.io.netcdf_file(folder / "bare.nc", "w") as new,
    ):
        for name, length in old.dimensions.items():
            new.createDimension(name, length)
        for name, variable in old.variables.items():
            copy = new.createVariable(named(name), variable.data.dtype, variable.dimensions)
            copy.data[...] = variable.data
            for key, value in variable._attributes.items():
                if "mesh_face_" not in name or key not in ("units", "standard_name", "axis"):
                    setattr(copy, key, named(value) if isinstance(value, bytes) else value)
    found, _ = caught(lambda: clvoro.load(folder / "bare.nc"))
    same = not isinstance(found, InputError) and np.allclose(found.points, mesh.points, atol=1e-9)
    return bool(same), str(found)[:80]


CASES = {
    lloyd: "Lloyd's method does not depend on the size at a corner, and says that it is far from that of the cells",
    mpas: "No MPAS file with four edges at a vertex; the remedy, `subset`, gives one that passes the check",
    transfer: "Globe to its ocean, ocean to a finer ocean, box to the lake in it: 1 stays 1, with covered shares",
    pieces: "A piece without a generator is named, for any volumes; `split` is a remedy",
    dangle: "`Polygon.from_shapely` takes what shapely.make_valid makes of a ring with a spike",
    degrees: "A run warns of degrees in the plane, however the polygon was made",
    seam: "A raster whose first and last columns differ gives a warning, and another one does not",
    tile: 'A fine tile in a coarse raster refines only where it is, with outside="ignore"',
    units: "UGRID whose coordinates of faces have names and no units is read, as longitudes and latitudes",
}
"""Each input, and what is right."""
COLUMNS = {
    "input": lambda r: r["case"],
    "right is": lambda r: r["right_is"],
    "what happens": lambda r: r["found"],
    "verdict": lambda r: "right" if r["right"] else "WRONG",
}


def main() -> int:
    options_of = parser(__doc__)
    options_of.add_argument("--only", type=names)
    options = options_of.parse_args()
    adapter, report, wrong = make_adapter(options), Report(options.json, COLUMNS), 0
    for case, right_is in CASES.items():
        if options.only and case.__name__ not in options.only:
            continue
        with tempfile.TemporaryDirectory() as folder:
            right, found = case(adapter, Path(folder))
        wrong += not right
        report.add({"case": case.__name__, "right_is": right_is, "found": found, "right": right})
    report.finish("Input that people reported")
    return wrong


if __name__ == "__main__":
    sys.exit(main())
