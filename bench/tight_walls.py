"""Why cells at walls have a low quality: in sharp corners, narrow passages, at kinks of the boundary, and elsewhere.

    python bench/tight_walls.py [--only NAMES] [--effort NAMES] [--exact] [--places]
                                [--device NAME] [--dtype float32] [--json]

A row has the number of cells at walls, how many of them have Q < 0.75, and where these are:

- narrow: no disc of diameter h in the domain contains the generator;
- sharp: somewhere on the walls of the cell the domain has an angle of less than 35 degrees. The angle at a point is
  2 A / h^2, where A is the area of the domain's part at this point within the distance h;
- rough: Q is at least 0.75 if each wall of the cell is replaced by its chord, as in the mesh for solvers. The
  boundary itself is longer, because it has kinks within the cell;
- elsewhere: none of these. `--places` lists them.

A cell counts where it fits first. h is the wanted size of the cell. In corners sharper than 35 degrees Q >= 0.75 is
impossible; see `bench/sharp_corners.py`. Then follow the mean |e| and the least Q of cells at walls: of those with a
corner of the domain of more than 30 degrees (`have_corners`, as `corner_cells` of `Result.summary`), and of the others.
Boxes have no row. The domains are those of `bench/solver_ready.py`; put semicolons between names with commas.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import shapely
from _common import FIRST_SEED, Report, heading, make_adapter, names, off_walls, parser
from sharp_corners import quality
from solver_ready import DOMAINS

import clvoro
from clvoro.finite_volumes.prisms import simple_loops
from clvoro.mesh.straightening import have_corners

LEAST_QUALITY = 0.75
SHARP = 35.0


def is_narrow(domain: shapely.Geometry, at: np.ndarray, h: float) -> bool:
    """Return whether no disc of diameter `h` in the domain contains the point `at`."""
    x, y = at
    near = domain.intersection(shapely.box(x - 2 * h, y - 2 * h, x + 2 * h, y + 2 * h))
    return near.buffer(-h / 2).distance(shapely.Point(at)) > h / 2


def least_angle(domain: shapely.Geometry, cell: shapely.Geometry, h: float) -> float:
    """Return the least angle of the domain, in degrees, at points of its boundary in a cell."""
    on_wall = shapely.get_coordinates(domain.boundary.intersection(cell.buffer(1e-6 * h)))
    found = 180.0
    for at in shapely.points(np.unique(on_wall, axis=0)):
        parts = shapely.get_parts(domain.intersection(at.buffer(h, quad_segs=32)))
        area = shapely.area(parts[np.argmin(shapely.distance(parts, at))])
        found = min(found, float(np.degrees(2 * area / h**2)))
    return found


def straight_quality(diagram: clvoro.Diagram) -> np.ndarray:
    """Return Q of the cells of the mesh for solvers, (n,); nan where a cell is no simple polygon."""
    mesh = diagram.solver_mesh()
    starts, loops, broken = simple_loops(mesh)
    found = np.array([quality(x) for x in np.split(mesh.points[loops], starts[1:-1])])
    found[broken] = np.nan
    return found


def measure(result: clvoro.Result) -> dict[str, Any]:
    """Return the figures of a mesh, and the cells elsewhere."""
    d, e = result.diagram, np.abs(result.size_error)
    domain, cells = d.domain.geometry, d.to_shapely()
    wall = np.flatnonzero(~off_walls(d))
    h, q = result.target_size, result.quality
    narrow = np.array([is_narrow(domain, d.points[i], h[i]) for i in wall])
    rest = wall[~narrow & (q[wall] < LEAST_QUALITY)]
    angles = np.array([least_angle(domain, cells[i], h[i]) for i in rest])
    straight = straight_quality(d)[rest]
    sharp = angles < SHARP
    rough = ~sharp & (straight >= LEAST_QUALITY)
    left = ~sharp & ~rough
    at_corner = have_corners(d)[wall]
    parts = wall[at_corner], wall[~at_corner]

    def mean(rows: np.ndarray) -> float:
        return float(e[rows].mean()) if rows.size else float("nan")

    return {
        "wall": len(wall),
        "low": int((q[wall] < LEAST_QUALITY).sum()),
        "narrow": int((q[wall[narrow]] < LEAST_QUALITY).sum()),
        "sharp": int(sharp.sum()),
        "rough": int(rough.sum()),
        "elsewhere": int(left.sum()),
        "error": [mean(wall), *map(mean, parts)],
        "quality": [float(q[rows].min()) if rows.size else float("nan") for rows in parts],
        "corners": len(parts[0]),
        "places": [
            {"at": d.points[i].tolist(), "h": h[i], "quality": q[i], "straight": s, "angle": angle}
            for i, s, angle in zip(rest[left], straight[left], angles[left], strict=True)
        ],
    }


COLUMNS = {
    "domain": lambda r: r["domain"],
    "run": lambda r: r["run"],
    "at walls": lambda r: r["wall"],
    "Q < 0.75": lambda r: f"{r['low']} ({r['low'] / r['wall']:.1%})",
    "narrow": lambda r: r["narrow"],
    "sharp": lambda r: r["sharp"],
    "rough": lambda r: r["rough"],
    "elsewhere": lambda r: r["elsewhere"],
    "mean e at walls": lambda r: f"{r['error'][0]:.4f}",
    "at corners": lambda r: f"{r['corners']} ({r['corners'] / r['wall']:.0%})",
    "mean e, min Q there": lambda r: f"{r['error'][1]:.4f}, {r['quality'][0]:.3f}",
    "mean e, min Q at other walls": lambda r: f"{r['error'][2]:.4f}, {r['quality'][1]:.3f}",
}


def main() -> None:
    """Run the bench."""
    options_of = parser(__doc__)
    options_of.add_argument("--only", default="bay,coast,river", metavar="NAMES")
    options_of.add_argument("--effort", default="default,best", metavar="NAMES")
    options_of.add_argument("--exact", action="store_true", help="also runs with method='exact'")
    options_of.add_argument("--places", action="store_true", help="list the cells elsewhere")
    options = options_of.parse_args()
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    chosen = options.only.split(";") if ";" in options.only else names(options.only)
    runs = [(effort, {"effort": effort}) for effort in names(options.effort)]
    runs += [("exact", {"method": "exact"})] * options.exact
    for name in filter(None, chosen):
        domain, size, more = DOMAINS[name]()
        for run, settings in runs:
            row = measure(adapter.run(domain, size, **{"seed": FIRST_SEED, **more, **settings}))
            report.add({"domain": name, "run": run, **row}, f"{name}, {run}")
            for place in row["places"] if options.places else ():
                print({key: np.round(value, 4).tolist() for key, value in place.items()})
    report.finish(heading(adapter, "Cells at walls with a low quality"))


if __name__ == "__main__":
    main()
