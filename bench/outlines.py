"""Outlines that are finer than cells: masks of rasters and digitized shores, and what OpenFOAM says of the meshes.

    python bench/outlines.py [--kinds NAMES] [--sizes 0.5,1,2,3] [--seeds N or NUMBERS] [--domains given,simplified]
                             [--effort default] [--device NAME] [--json]

Masks are water along the edges of pixels of length 1, which touch at corners. Their land is "blobs", the high part of
a smooth random field; "checkers", patches of a checkerboard; "shores", blobs that touch the shore, too, with single
pixels along it; or "noise", each pixel with a probability of 1 : 4. Digitized outlines are rough shores of about 60
pixels: "coasts" with needles, slits and spikes of a width from 1e-10 to 1e-2 and islands that touch in a point,
"charts" with vertices twice or nearly so, rings that nearly touch, and edges that run there and back; those that cross
themselves are repaired. "rivers" are masks, too. "buildings" and "archipelagos" are the space between bodies, some
of which touch. "contours" are the largest part of a smooth field between two levels. All cells have the same size, in
pixels.

Rows have means over the outlines, of the domain as given or `simplified` by 1.5 sizes, and what becomes of the meshes:
accepted by `checkMesh -allGeometry -allTopology` (without OpenFOAM by its criteria), refused by a message before the
run or when the mesh is saved, or saved and rejected. Those that are not accepted are named on stderr. "Left out" is the
area of `left_out` over that of the domain.
"""

from __future__ import annotations

import itertools
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import contourpy
import numpy as np
import scipy.ndimage
import shapely
import shapely.affinity
from _common import Report, heading, make_adapter, names, parser, seeds_of

import clvoro
from clvoro.io.check_mesh import check_case

SIMPLIFIED = 1.5  # tolerance over the size
PIXELS = 24


def _water(land: np.ndarray) -> clvoro.Polygon:
    """Return the largest part of a raster without its land, (n, n) bool."""
    y, x = np.nonzero(land)
    islands = shapely.union_all(shapely.box(x, y, x + 1, y + 1))
    water = shapely.get_parts(shapely.difference(shapely.box(0, 0, *land.shape), islands))
    return clvoro.Polygon.from_shapely(max(water, key=lambda part: part.area))


def _field(rng: np.random.Generator, width: float) -> np.ndarray:
    values = scipy.ndimage.gaussian_filter(rng.standard_normal((PIXELS, PIXELS)), width)
    return values / values.std()


def _blobs(rng: np.random.Generator) -> np.ndarray:
    return np.pad(_field(rng, rng.uniform(0.8, 1.5)) > 0.6, 1)


def _checkers(rng: np.random.Generator) -> np.ndarray:
    board = np.indices((PIXELS, PIXELS)).sum(axis=0) % 2 == 0
    return np.pad(board & (_field(rng, 2) > 0.5), 1)


def _shores(rng: np.random.Generator) -> np.ndarray:
    land = np.pad(_field(rng, 1.2) > 0.6, 1)
    for side in (land, land.T, land[::-1], land.T[::-1]):
        side[0] = rng.random(PIXELS + 2) < 0.3
        side[1] |= rng.random(PIXELS + 2) < 0.15
    return land


def _noise(rng: np.random.Generator) -> np.ndarray:
    return np.pad(rng.random((PIXELS, PIXELS)) < 0.25, 1)


def _shore(rng: np.random.Generator, count: int) -> shapely.Polygon:
    turn = np.arange(count) * (2 * np.pi / count)
    r = 30 * (1 + 0.15 * np.sin(3 * turn + rng.uniform(0, 6)) + 0.01 * rng.standard_normal(count))
    return shapely.Polygon(np.column_stack([r * np.cos(turn), r * np.sin(turn)])).buffer(0)


def coast(rng: np.random.Generator) -> clvoro.Polygon:
    """Return a rough shore with needles, slits and spikes, and islands that touch each other in a point."""
    sea = _shore(rng, 300)
    for k in range(12):
        angle, width, long = rng.uniform(0, 2 * np.pi), 10 ** rng.uniform(-10, -2), rng.uniform(0.5, 8)
        out = np.array([np.cos(angle), np.sin(angle)])
        side = width / 2 * np.array([-out[1], out[0]])
        foot = shapely.get_coordinates(shapely.intersection(sea.exterior, shapely.LineString([0 * out, 60 * out])))[0]
        way = out if k % 2 else -out
        tip = [foot + long * way] if k % 3 else [foot + side + long * way, foot - side + long * way]
        thorn = shapely.Polygon([foot - side - 0.1 * way, foot + side - 0.1 * way, *tip])
        sea = sea.union(thorn) if k % 2 else sea.difference(thorn)
    for _ in range(4):
        place, a = rng.uniform(-12, 12, 2), rng.uniform(1, 3)
        pair = [shapely.box(*place, *(place + a)), shapely.box(*(place - a), *place)]
        sea = sea.difference(shapely.union_all(pair))
    return clvoro.Polygon.from_shapely(max(shapely.get_parts(sea), key=lambda part: part.area))


def chart(rng: np.random.Generator) -> clvoro.Polygon:
    """Return a rough shore with islands that nearly touch, vertices twice or nearly so, and edges there and back."""
    ring = shapely.get_coordinates(_shore(rng, 240).exterior)[:-1]
    islands = []
    for k in range(5):
        c, s = np.cos(2 * np.pi * k / 5), np.sin(2 * np.pi * k / 5)
        count = rng.integers(6, 20)
        turn = np.arange(count) * (2 * np.pi / count)
        r = rng.uniform(2, 4) * (1 + 0.2 * rng.standard_normal(count)).clip(0.6, 1.4)
        first = np.column_stack([r * np.cos(turn), r * np.sin(turn)])
        right = first[:, 0].argmax()
        place = np.array([12 * c - 4 * s, 12 * s + 4 * c]) + rng.uniform(-1, 1, 2)
        # The second island is the first one, turned about its rightmost vertex, and a gap away from it.
        gap = 10 ** rng.uniform(-8, -1)
        islands += [place + first, place + 2 * first[right] + [gap, 0] - first]
    rings = []
    for x in [ring, *islands]:
        twice = np.flatnonzero(rng.random(len(x)) < 0.1)
        share = np.where(rng.random((len(twice), 1)) < 0.5, 0, 10 ** rng.uniform(-9, -5, (len(twice), 1)))
        x = np.insert(x, twice + 1, x[twice] + share * (np.roll(x, -1, axis=0) - x)[twice], axis=0)
        if rng.random() < 0.02:
            k = rng.integers(len(x))
            out = x[k] - x.mean(axis=0)
            x = np.insert(x, k + 1, [x[k] + 0.1 * out, x[k]], axis=0)
        rings.append(x)
    try:
        return clvoro.Polygon(rings[0], rings[1:])
    except clvoro.ClvoroError:
        return clvoro.Polygon(rings[0], rings[1:], repair=True)


def _rivers(rng: np.random.Generator) -> np.ndarray:
    """Return land around a river that winds from side to side, and two that flow into it."""
    main = np.column_stack([np.linspace(0, PIXELS, 9), rng.uniform(3, PIXELS - 3, 9)])
    courses = [main, *([rng.uniform(0, PIXELS, 2), rng.uniform(0, PIXELS, 2), main[k]] for k in (3, 6))]
    lines = shapely.MultiLineString([shapely.LineString(course) for course in courses])
    y, x = np.indices((PIXELS, PIXELS)).reshape(2, -1)
    land = shapely.distance(lines, shapely.points(x, y)) > rng.uniform(0.5, 1.2)
    return np.pad(land.reshape(PIXELS, PIXELS), 1, constant_values=True)


def buildings(rng: np.random.Generator) -> clvoro.Polygon:
    """Return the space between buildings, turned rectangles and angles of which some touch or nearly do."""
    houses = []
    for x, y in np.argwhere(np.ones((5, 5))) * 5.0:
        long, wide = rng.uniform(2, 5.2, 2)
        house = shapely.box(0, 0, long, wide)
        if rng.random() < 0.4:
            house = house.difference(shapely.box(long * rng.uniform(0.3, 0.7), wide * rng.uniform(0.3, 0.7), 6, 6))
        turned = shapely.affinity.rotate(house, rng.choice([0, rng.uniform(0, 90)]))
        houses.append(shapely.affinity.translate(turned, x, y))
    air = shapely.box(-3, -3, 29, 29).difference(shapely.union_all(houses))
    return clvoro.Polygon.from_shapely(max(shapely.get_parts(air), key=lambda part: part.area))


def contours(rng: np.random.Generator) -> clvoro.Polygon:
    """Return the largest part between two levels of a smooth random field, by marching squares."""
    field = np.pad(_field(rng, 2), 1, constant_values=-9)
    lines, codes = contourpy.contour_generator(z=field, fill_type="OuterOffset").filled(rng.uniform(-0.6, -0.2), 2.0)
    parts = []
    for points, starts in zip(lines, codes, strict=True):
        rings = [points[a:b] for a, b in itertools.pairwise(starts)]
        parts.append(shapely.Polygon(rings[0], rings[1:]))
    return clvoro.Polygon.from_shapely(max(parts, key=lambda part: part.area))


def archipelago(rng: np.random.Generator) -> clvoro.Polygon:
    """Return a sea with 60 islands, triangles to octagons, of which some overlap, touch or nearly do."""
    islands = []
    for _ in range(60):
        turn = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(4, 9)))
        r = 10 ** rng.uniform(-0.7, 0.5, 2)
        ring = rng.uniform(2, 30, 2) + r * np.column_stack([np.cos(turn), np.sin(turn)])
        islands.append(shapely.Polygon(np.round(ring, int(rng.integers(0, 3)))).buffer(0))
    sea = shapely.box(0, 0, 32, 32).difference(shapely.union_all(islands))
    return clvoro.Polygon.from_shapely(max(shapely.get_parts(sea), key=lambda part: part.area), repair=True)


MASKS = {"blobs": _blobs, "checkers": _checkers, "shores": _shores, "noise": _noise, "rivers": _rivers}
KINDS: dict[str, Callable[[np.random.Generator], clvoro.Polygon]] = {
    **{name: lambda rng, make=make: _water(make(rng)) for name, make in MASKS.items()},
    "coasts": coast,
    "charts": chart,
    "buildings": buildings,
    "contours": contours,
    "archipelagos": archipelago,
}
MEANS = ["boundary_mean_error", "inner_mean_error", "boundary_mean_quality", "inner_mean_quality", "min_quality"]


def verdict_of(result: clvoro.Result) -> tuple[str, str]:
    """Return what becomes of a mesh, a column of the table, and why."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            result.save(Path(folder) / "constant" / "polyMesh")
        except clvoro.ClvoroError as error:
            return "refused when saved", str(error)
        if shutil.which("checkMesh") is None:
            report = result.check(solver="openfoam")
            return ("accepted", "") if report else ("saved and rejected", str(report))
        verdict = check_case(Path(folder))
        return ("accepted", "") if verdict.ok else ("saved and rejected", "; ".join(verdict.complaints))


def measure(adapter: clvoro.Adapter, make: Callable[[], clvoro.Polygon], size: float, effort: str) -> dict[str, Any]:
    """Make a mesh and save it; return its figures, what became of it, and why."""
    begin = time.process_time()
    try:
        result = adapter.run(make(), size, effort=effort)
    except clvoro.ClvoroError as error:
        return {"what": "refused before the run", "why": f"{type(error).__name__}: {error}"}
    middle = time.process_time()
    mesh = result.solver_mesh()
    end = time.process_time()
    what, why = verdict_of(result)
    summary = result.summary()
    figures = {name: np.nan if summary[name] is None else summary[name] for name in MEANS}
    figures["left_out"] = mesh.left_out.total / mesh.domain.measure
    return {"what": what, "why": why, "seconds": middle - begin, "solver_mesh_seconds": end - middle, **figures}


WHAT = ["accepted", "refused before the run", "refused when saved", "saved and rejected"]
COLUMNS = {
    "outlines": lambda r: r["kind"],
    "size, pixels": lambda r: r["size"],
    "domain": lambda r: r["domain"],
    "mean e at walls, inside": lambda r: f"{r['boundary_mean_error']:.4f}, {r['inner_mean_error']:.4f}",
    "mean Q at walls, inside": lambda r: f"{r['boundary_mean_quality']:.3f}, {r['inner_mean_quality']:.3f}",
    "left out": lambda r: f"{r['left_out']:.1%}",
    "min Q": lambda r: f"{r['min_quality']:.2f}",
    **{name: lambda r, name=name: r[name] for name in WHAT},
    "run s": lambda r: f"{r['seconds']:.1f}",
    "solver mesh s": lambda r: f"{r['solver_mesh_seconds']:.2f}",
}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--kinds", default=",".join(KINDS), metavar="NAMES")
    options_of.add_argument("--sizes", default="0.5,1,2,3", metavar="PIXELS")
    options_of.add_argument("--seeds", default="10", metavar="NUMBERS", help="N for 1 to N")
    options_of.add_argument("--domains", default="given", metavar="NAMES", help="given,simplified")
    options_of.add_argument("--effort", default="default")
    options = options_of.parse_args()
    adapter = make_adapter(options)
    warnings.simplefilter("ignore")  # bays and straits that are narrower than a cell
    seeds = seeds_of(options.seeds)
    report = Report(options.json, COLUMNS)
    for kind in names(options.kinds):
        for size in map(float, names(options.sizes)):
            for shown in names(options.domains):
                rows = []
                for seed in seeds:

                    def make(kind=kind, seed=seed, size=size, shown=shown) -> clvoro.Polygon:
                        domain = KINDS[kind](np.random.default_rng(seed))
                        if shown == "given":
                            return domain
                        return domain.simplified(SIMPLIFIED * size).split()[0]

                    row = measure(adapter, make, size, options.effort)
                    rows.append(row)
                    if row["what"] != "accepted":
                        print(f"{kind} {size} {shown} {seed}: {row['what']}: {row['why']}", file=sys.stderr, flush=True)
                made = [row for row in rows if "seconds" in row]
                found: dict[str, Any] = {"kind": kind, "size": size, "domain": shown}
                for name in (*MEANS, "left_out", "seconds", "solver_mesh_seconds"):
                    found[name] = float(np.nanmean([row[name] for row in made])) if made else float("nan")
                found |= {what: sum(row["what"] == what for row in rows) for what in WHAT}
                report.add(found, f"{kind}, {size} pixels, {shown}: {found['accepted']} of {len(rows)}")
    total = sum(row[what] for row in report.records for what in WHAT)
    said = ", ".join(f"{sum(row[what] for row in report.records)} {what}" for what in WHAT)
    report.finish(heading(adapter, f"Of {total} meshes {said}"))


if __name__ == "__main__":
    main()
