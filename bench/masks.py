"""Outlines of raster masks and digitized ones: sizes, shapes, and OpenFOAM's verdict where cells are coarse for them.

    python bench/masks.py [--sizes 1,1.5,2,3] [--masks 4] [--digitized 4] [--effort default] [--device NAME] [--json]

A mask is the water of a smooth random field on 60 x 60 pixels, with walls along the edges of pixels, which touch at
corners. A digitized outline is a rough shore of about 60 pixels with islands that touch in a point, spikes and slits of
1e-9 to 0.1 pixels. All cells have the same size, in pixels. Rows have means over the outlines, of the domain as given
and `simplified` by 1.5 sizes, and how many solver meshes `checkMesh -allGeometry -allTopology` accepts, or without
OpenFOAM (Debian's package `openfoam`) its criteria.
"""

from __future__ import annotations

import time
import warnings

import numpy as np
import shapely
from _common import Report, heading, make_adapter, parser
from _sites import mask

import clvoro
from clvoro.io.check_mesh import run_check_mesh

SIMPLIFIED = 1.5  # tolerance over the size


def digitized(seed: int) -> clvoro.Polygon:
    """Return a rough shore with what digitizing leaves: spikes, slits, islands that touch in a point."""
    rng = np.random.default_rng(seed)
    turn = np.arange(300) * (2 * np.pi / 300)
    r = 30 * (1 + 0.15 * np.sin(3 * turn + rng.uniform(0, 6)) + 0.01 * rng.standard_normal(300))
    sea = shapely.Polygon(np.column_stack([r * np.cos(turn), r * np.sin(turn)])).buffer(0)
    for k in range(8):
        angle, width, long = rng.uniform(0, 2 * np.pi), 10 ** rng.uniform(-9, -1), rng.uniform(2, 8)
        out = np.array([np.cos(angle), np.sin(angle)])
        side = width * np.array([-out[1], out[0]])
        foot = shapely.get_coordinates(shapely.intersection(sea.exterior, shapely.LineString([0 * out, 60 * out])))[0]
        way = out if k % 2 else -out
        thorn = shapely.Polygon([foot - side - 0.1 * way, foot + side - 0.1 * way, foot + long * way])
        sea = sea.union(thorn) if k % 2 else sea.difference(thorn)
    for _ in range(4):
        place, a = rng.uniform(-12, 12, 2), rng.uniform(1, 3)
        pair = [shapely.box(*place, *(place + a)), shapely.box(*(place - a), *place)]
        sea = sea.difference(shapely.union_all(pair))
    return clvoro.Polygon.from_shapely(max(shapely.get_parts(sea), key=lambda part: part.area))


KINDS = {"masks": lambda seed: mask(seed).domain, "digitized": digitized}


def is_accepted(result: clvoro.Result) -> bool:
    """Return whether OpenFOAM accepts the mesh, or without it whether its criteria are met."""
    verdict = run_check_mesh(result)
    return bool(result.check(solver="openfoam")) if verdict is None else verdict.ok


COLUMNS = {
    "outlines": lambda r: r["kind"],
    "size, pixels": lambda r: r["size"],
    "domain": lambda r: "simplified" if r["simplified"] else "given",
    "mean e at walls": lambda r: f"{r['boundary_mean_error']:.4f}",
    "inside": lambda r: f"{r['inner_mean_error']:.4f}",
    "mean Q at walls": lambda r: f"{r['boundary_mean_quality']:.3f}",
    "Q inside": lambda r: f"{r['inner_mean_quality']:.3f}",
    "min Q": lambda r: f"{r['min_quality']:.2f}",
    "accepted": lambda r: f"{r['accepted']:.0f} of {r['count']}",
    "processor s": lambda r: f"{r['seconds']:.1f}",
}
MEANS = ["boundary_mean_error", "inner_mean_error", "boundary_mean_quality", "inner_mean_quality", "min_quality"]


def main() -> None:
    """Run the bench."""
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", default="1,1.5,2,3", metavar="PIXELS")
    options_of.add_argument("--masks", type=int, default=4, metavar="N")
    options_of.add_argument("--digitized", type=int, default=4, metavar="N")
    options_of.add_argument("--effort", default="default")
    options = options_of.parse_args()
    adapter = make_adapter(options)
    warnings.simplefilter("ignore")  # bays and straits that are narrower than a cell
    report = Report(options.json, COLUMNS)
    for kind, make in KINDS.items():
        for size in map(float, options.sizes.split(",")):
            for simplified in (False, True):
                rows = []
                for seed in range(1, getattr(options, kind) + 1):
                    domain = make(seed)
                    domain = domain.simplified(SIMPLIFIED * size) if simplified else domain
                    begin = time.process_time()
                    result = adapter.run(domain, size, effort=options.effort)
                    accepted = is_accepted(result)
                    seconds = time.process_time() - begin
                    rows.append({**result.summary(), "accepted": accepted, "seconds": seconds})
                if rows:
                    found = {name: float(np.mean([row[name] for row in rows])) for name in (*MEANS, "seconds")}
                    found |= {"kind": kind, "size": size, "simplified": simplified, "count": len(rows)}
                    found["accepted"] = sum(row["accepted"] for row in rows)
                    report.add(found, f"{kind}, {size} pixels, {'simplified' if simplified else 'given'}")
    report.finish(heading(adapter, f"Outlines, {options.effort}"))


if __name__ == "__main__":
    main()
