"""Meshes of solids, and what OpenFOAM says: `checkMesh -allGeometry -allTopology` for CAD-like parts.

    python bench/solids.py [OPTIONS]

The solids are in `bench/_solid_shapes.py`; they need trimesh, manifold3d, shapely, networkx and, for the gyroid,
scikit-image. Each is meshed at two uniform sizes with default settings, and written as polyMesh. A row has the number
of cells, mean |e| of the sizes and mean isoperimetric quotient, the largest and mean non-orthogonality, the largest
skewness, the number of concave cells, the volume of all cells over that of the solid, and the verdict.

--runs is a list of efforts and "exact". With `--worst` a row has the worst figures of all runs and seeds, and how many
are accepted with at most 20 degrees of non-orthogonality (mean 3), skewness 2 and no concave cell: `--runs
default,best,exact --seeds 3 --worst`. `--order SIZES` compares volume and wall area of a ball, a torus and a cylinder
with those of their surface, and its distance from the vertices of walls with h^2 times the curvature.

With `--booleans N` the solids are N random booleans of boxes, balls and cylinders, from number `--first` on, or those
whose numbers `--only` lists, with about `--cells` cells each, in a process that may crash or hang. Each is accepted,
rejected, refused (by a message, before there is a mesh), or it fails: an exception, a crash, no end within the limit, a
cell that is not closed, or walls that are off by more than 0.1 h in the mean. Seconds and the limit are processor time.
`--files FOLDER` does the same for all files of surfaces below a folder, as `*.stl.gz` too: for the inside of each
surface, and for the air around it with sizes of h / 2 to 2 h. Surfaces are read with the remedies that messages name;
wraps have no inside, so that both are the air around them. Debian's package openfoam-examples
has many in /usr/share/doc/openfoam-examples.
With `--layers` all patches of the solids have layers of prisms, such as `0.5:5:1.3`: 0.5 h thick, five layers, growth
1.3. A row has the inner cells and the prisms, the mean thickness over the one given at the vertices of walls, the
share of these with at least 0.9 of it, the mean first height where it is at least 0.9 of the one given, and the
verdicts of `checkMesh` without and with its options.
With `--surfaces` the domains are those of `bench/_surface_scenes.py`, with surfaces inside. A row has the number of
regions, and the largest relative error of a volume of those whose volume is known.
Pictures show each mesh cut open, with the patches or the regions in colors.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import re
import resource
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from _common import Report, cell_quality, counts, heading, make_adapter, names, parser
from _openfoam import require
from _solid_shapes import LAYERED, SHAPES, random_part, solid_of
from _surface_scenes import SCENES
from solver_ready import COLUMNS as PLANE_COLUMNS
from solver_ready import figures_of

import clvoro
from clvoro.adaptation.options import EFFORTS
from clvoro.errors import ClvoroError
from clvoro.geometry.surface_files import SOLIDS, joined, read_parts
from clvoro.io.check_mesh import check_case

COLUMNS = {
    "solid": lambda r: r["solid"],
    "run": lambda r: r["run"],
    "h": lambda r: f"{r['h']:g}",
    "cells": lambda r: r["cells"],
    "s": PLANE_COLUMNS["s"],
    "mean e": lambda r: f"{r['error']:.4f}",
    "quotient": lambda r: f"{r['quotient']:.3f}",
    "non-orth. max, mean": lambda r: f"{r['non_orthogonality']:.1f}, {r['mean_non_orthogonality']:.2f}",
    "skewness": PLANE_COLUMNS["skewness"],
    "concave": lambda r: f"{r['concave']:.0f}",
    "volume": lambda r: f"{r['volume']:.5f}",
    "checkMesh": PLANE_COLUMNS["checkMesh"],
}

Made = tuple[Any, Any, dict[str, Any], Callable[[clvoro.Result, Path], dict[str, Any]]]
"""A domain, its sizes, settings of the run, and a function for more figures."""
Job = tuple[dict[str, Any], Callable[[], Made]]
"""What a row begins with, and how the rest is made."""
GOALS = {"non_orthogonality": 20, "mean_non_orthogonality": 3, "skewness": 2, "concave": 0}
"""Largest figures of a mesh that is as wanted."""
WORST_COLUMNS = {
    **{name: show for name, show in COLUMNS.items() if name not in ("run", "quotient", "volume", "checkMesh")},
    "accepted": lambda r: f"{r['accepted']} of {r['runs']}",
    "within goals": lambda r: r["good"],
}


def worst_of(records: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one record for each solid and h: the largest figures, how many runs are accepted, and meet the goals."""
    groups: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for row in records:
        groups.setdefault((row["solid"], row["h"]), []).append(row)
    return [
        {key: np.nanmax([r[key] for r in rows]).item() for key in ("cells", "seconds", "error", *GOALS)}
        | {"solid": solid, "h": h, "runs": len(rows), "accepted": sum(r["ok"] for r in rows)}
        | {"good": sum(r["ok"] and all(round(r[key], 2) <= most for key, most in GOALS.items()) for r in rows)}
        for (solid, h), rows in groups.items()
    ]


def measure(adapter: clvoro.Adapter, make: Callable[[], Made], case: Path) -> dict[str, Any]:
    """Adapt, write and check a mesh; return its figures."""
    begin = time.process_time()
    solid, size, settings, more = make()
    result = adapter.run(solid, size, **settings)
    seconds = time.process_time() - begin
    result.to_openfoam(case / "constant" / "polyMesh", check=False)
    verdict = check_case(case)
    (case / "checkMesh.log").write_text(verdict.text)
    d = result.diagram
    return {
        "result": result,
        "verdict": "accepted" if verdict.ok else "rejected",
        "cells": len(d),
        "seconds": seconds,
        "error": float(np.abs(result.size_error).mean()),
        "quotient": float(cell_quality(d).mean()),
        "volume": float(d.volumes.sum() / solid.measure),
        **figures_of(verdict),
        **more(result, case),
    }


def draw(result: clvoro.Result, path: Path, title: str) -> None:
    """Draw the mesh, cut open, with the patches or the regions in colors."""
    from clvoro.plotting.solids import plot_cutaway

    path.parent.mkdir(parents=True, exist_ok=True)
    regions = result.diagram.cell_region if len(result.diagram.region_names) > 1 else None
    figure = plot_cutaway(result, "quality" if regions is None else regions, walls=regions is None, title=title)
    figure.savefig(path, dpi=150, bbox_inches="tight")


BOOLEAN_COLUMNS = {
    "solid": lambda r: r["solid"],
    "read": lambda r: r.get("read", ""),
    "cells": lambda r: r["cells"],
    "s": PLANE_COLUMNS["s"],
    "non-orth. max, mean": COLUMNS["non-orth. max, mean"],
    "skewness": PLANE_COLUMNS["skewness"],
    "volume": COLUMNS["volume"],
    "verdict": lambda r: r["verdict"],
    "what and where": lambda r: r["complaints"],
}
KINDS = tuple(f".{kind}" for kind in SOLIDS)
_WRAPS = 20
"""Extent of a file's surface over its wrap; cells there are half as large again."""
_OFF = 0.1
"""Largest mean distance of the walls from the surface, over h; a chord of a curved wall is nearer."""


def part_of(job: int | tuple[Path, bool], cells: int) -> tuple[clvoro.Solid, float, Any, str]:
    """Return a random solid by its number, or the inside or outside of a file's surface, with h, sizes and remedies."""
    if isinstance(job, int):
        solid = solid_of(random_part(job))
        h = (solid.measure / cells) ** (1 / 3)
        return solid, h, h, ""
    path, outside = job
    solid, told = read_as_told(path)
    h = (solid.measure / cells) ** (1 / 3)
    if not outside and "wrap" not in told:
        return solid, h, h, told
    lower, upper = np.array(solid.lower), np.array(solid.upper)
    room = 0.6 * (upper - lower).max()
    air = clvoro.Solid.outside(solid, (lower - room, upper + room))
    h = 3 * (upper - lower).max() / _WRAPS if "wrap" in told else (air.measure / cells) ** (1 / 3)
    return air, h, growing(air, set(air.boundary_names) & set(solid.boundary_names), h), told


def read_as_told(path: Path) -> tuple[clvoro.Solid, str]:
    """Return the solid in a file, read with the remedies that messages name until there is one, and those remedies."""
    options: dict[str, Any] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        while True:
            try:
                return clvoro.Solid.read(path, **options, name=path.name), ", ".join(options) or "as it is"
            except ClvoroError as error:
                said = str(error)
                join = re.search(r"(?<=Here join=)[\d.e+-]+", said)
                if join and "join" not in options:
                    options["join"] = float(join[0])
                elif "repair=True" in said and "repair" not in options:
                    options["repair"] = True
                elif "wrap=" in said and "wrap" not in options:
                    options = {"wrap": float(np.ptp(joined(read_parts(path, SOLIDS))[0], axis=0).max()) / _WRAPS}
                else:
                    raise


def growing(solid: clvoro.Solid, walls: Iterable[str], h: float) -> clvoro.sizing.Distance:
    """Return sizes from h / 2 at the walls to 2 h away from them."""
    return clvoro.sizing.Distance([solid.boundary(w) for w in walls], h_min=0.5 * h, growth=1.2, h_max=2 * h)


def parts(options: argparse.Namespace) -> Iterable[Job]:
    """Return random solids, or the inside and the outside of the surface in each file."""

    def made(job: int | tuple[Path, bool]) -> Made:
        solid, h, size, told = part_of(job, options.cells)
        return solid, size, {}, partial(defects, h=h, told=told)

    for number in counts(options.only) or range(options.first, options.first + options.booleans):
        yield {"solid": number}, partial(made, number)
    if options.files:
        found = [p for p in options.files.rglob("*") if p.name.lower().removesuffix(".gz").endswith(KINDS)]
        found.sort(key=lambda p: (p.stat().st_size, p))
        once = {p.read_bytes(): p for p in found}  # tutorials share files
        for outside, path in product((False, True), once.values()):
            yield {"solid": f"{path.name}, {'outside' if outside else 'inside'}"}, partial(made, (path, outside))


def defects(result: clvoro.Result, case: Path, h: float, told: str) -> dict[str, Any]:
    """Return how a file is read, and a verdict on cells that are open, and on walls that are off the surface."""
    d, f, solid = result.diagram, result.diagram.faces, result.diagram.domain
    openness = np.zeros((len(d), 3))
    inner = f.neighbor >= 0
    np.add.at(openness, f.owner, f.normal * f.area[:, None])
    np.subtract.at(openness, f.neighbor[inner], (f.normal * f.area[:, None])[inner])
    off, open_ = abs(d.volumes.sum() - solid.measure) / solid.boundary_measure / h, np.abs(openness).max()
    if open_ < 1e-9 * h * h and off < _OFF:
        return {"read": told}
    what = f"walls are off by {off:.2f} h, cells are open by {open_:.1e}"
    return {"read": told, "ok": False, "verdict": "failed", "complaints": what}


LAYER_COLUMNS = {
    **{name: COLUMNS[name] for name in ("solid", "h")},
    "layers": lambda r: r["layers"],
    "cells": lambda r: f"{r['cells'] - r['prisms']} + {r['prisms']}",
    "s": PLANE_COLUMNS["s"],
    "mean e": COLUMNS["mean e"],
    "of inner cells": lambda r: f"{r['inner']:.4f}",
    "thickness": lambda r: f"{r['thickness']:.3f}",
    "full": lambda r: f"{100 * r['full']:.1f} %",
    "first height": lambda r: f"{r['first']:.3f}",
    **{name: COLUMNS[name] for name in ("non-orth. max, mean", "skewness", "volume")},
    "aspect": lambda r: f"{r['aspect']:.0f}",
    "checkMesh": lambda r: "Mesh OK" if r.get("plain") else r.get("why", ""),
    "with -allGeometry": PLANE_COLUMNS["checkMesh"],
}


def layered(options: argparse.Namespace) -> Iterable[Job]:
    """Return the solids with layers on all patches."""

    def made(name: str, h: float, given: str) -> Made:
        thickness, count, growth = (float(x) for x in given.split(":"))
        layers = clvoro.Layers(thickness * h / (growth ** np.arange(int(count))).sum(), int(count), growth)
        solid = solid_of(LAYERED[name][0](), repair=name == "dirty")
        return solid, h, {"layers": layers}, partial(reached, layers=layers)

    for name, level, given in product(
        names(options.only) or LAYERED, names(options.resolutions), names(options.layers)
    ):
        h = LAYERED[name][1][int(level)]
        yield {"solid": name, "h": h, "layers": given}, partial(made, name, h, given)


def reached(result: clvoro.Result, case: Path, layers: clvoro.Layers) -> dict[str, Any]:
    """Return how thick layers are, the heights of first prisms, and what `checkMesh` says without its options."""
    d, f, verdict = result.diagram, result.diagram.faces, check_case(case, thorough=False)
    walls = f.n_inner + np.flatnonzero(d.layer[f.owner[f.n_inner :]] == 1)
    first = d.volumes[f.owner[walls]] / f.area[walls] / layers.height
    (told,) = result.settings["thickness"]
    return {
        "plain": verdict.ok,
        "verdict": "accepted" if verdict.ok else "rejected",
        "why": "; ".join(verdict.complaints),
        "prisms": int((d.layer > 0).sum()),
        "inner": float(np.abs(result.size_error[d.layer == 0]).mean()),
        "thickness": told["mean"] / told["asked"],
        "full": told["full_share"],
        "first": float(np.median(first)) if len(first) else float("nan"),
        "aspect": float(f.measures.aspect_ratio.max()),
    }


SURFACE_COLUMNS = {
    **{name: COLUMNS[name] for name in ("solid", "run", "cells", "s", "mean e", "non-orth. max, mean", "skewness")},
    "regions": lambda r: r["regions"],
    "their volumes": lambda r: f"{r['off']:.1e}",
    "checkMesh": COLUMNS["checkMesh"],
}


def divided(options: argparse.Namespace) -> Iterable[Job]:
    """Return the domains with surfaces inside."""

    def volumes_of(result: clvoro.Result, case: Path, known: dict[str, float]) -> dict[str, Any]:
        d = result.diagram
        found = dict(zip(d.region_names, np.bincount(d.cell_region, d.volumes), strict=True))
        off = [abs(found[region] / volume - 1) for region, volume in known.items()]
        return {"regions": len(found), "off": max(off, default=float("nan"))}

    def made(name: str, run: str) -> Made:
        domain, size, known = SCENES[name]()
        return domain, size, settings_of(run), partial(volumes_of, known=known)

    for name, run in product(names(options.only) or SCENES, names(options.runs)):
        yield {"solid": name, "run": run}, partial(made, name, run)


def uniform(options: argparse.Namespace) -> Iterable[Job]:
    """Return the solids at uniform sizes, or at sizes that grow from their walls."""

    def made(name: str, run: str, h: float, seed: int) -> Made:
        solid = solid_of(SHAPES[name][0](), repair=name == "dirty")
        size = growing(solid, solid.boundary_names, h) if options.graded else h
        return solid, size, {**settings_of(run), "seed": seed}, lambda result, case: {}

    for name, level, run, seed in product(
        names(options.only) or SHAPES, names(options.resolutions), names(options.runs), range(options.seeds)
    ):
        h = SHAPES[name][1][int(level)]
        yield {"solid": name, "run": run, "h": h, "seed": seed}, partial(made, name, run, h, seed)


def measured(adapter: clvoro.Adapter, options: argparse.Namespace, job: Job) -> dict[str, Any]:
    """Return the row of a job: its figures, or why there are none."""
    begin, make = job
    label = "-".join(map(str, begin.values())).replace(" ", "-")
    row: dict[str, Any] = {**dict.fromkeys(_EMPTY, float("nan")), "prisms": 0, "regions": 0, "cells": 0, **begin}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            row |= measure(adapter, make, Path(folder) if options.keep is None else options.keep / label)
            if options.pictures is not None:
                draw(row["result"], options.pictures / f"{label}.png", label)
        except ClvoroError as error:
            row |= {"ok": False, "verdict": "refused", "complaints": f"{type(error).__name__}: {error}"}
        except Exception:  # what must never happen is a row, too
            row |= {"ok": False, "verdict": "failed", "complaints": traceback.format_exc(limit=-1)[-200:]}
    row.pop("result", None)
    if row["verdict"] == "rejected":
        said = (str(w.message) for w in caught if "checkMesh" in str(w.message))
        row["complaints"] = "; ".join([row["complaints"], *said])
    return row


def jobs_of(options: argparse.Namespace) -> tuple[dict[str, Callable[[dict[str, Any]], object]], list[Job]]:
    """Return the columns of a table and its jobs."""
    columns, jobs = next(
        (columns, jobs)
        for chosen, columns, jobs in (
            (options.booleans or options.files, BOOLEAN_COLUMNS, parts),
            (options.order, ORDER_COLUMNS, smooth),
            (options.surfaces, SURFACE_COLUMNS, divided),
            (options.layers, LAYER_COLUMNS, layered),
            (options.worst, WORST_COLUMNS, uniform),
            (True, COLUMNS, uniform),
        )
        if chosen
    )
    return columns, list(jobs(options))


def _serve(jobs: Any, options: argparse.Namespace) -> None:
    """Measure the jobs whose numbers come through a pipe, in a process of its own."""
    adapter, (_, known) = make_adapter(options), jobs_of(options)
    while True:
        number, used = jobs.recv(), resource.getrusage(resource.RUSAGE_SELF)
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(used.ru_utime + used.ru_stime + options.limit), -1))
        jobs.send(measured(adapter, options, known[number]))


def measure_all(options: argparse.Namespace) -> Report:
    """Return a report with a row for each job, made in a process that may crash or hang."""
    context, worker, pipe = multiprocessing.get_context("spawn"), None, None
    columns, jobs = jobs_of(options)
    report = Report(options.json, columns)
    for number, (begin, _) in enumerate(jobs):
        if worker is None or pipe is None:
            pipe, end = context.Pipe()
            worker = context.Process(target=_serve, args=(end, options), daemon=True)
            worker.start()
            end.close()
        pipe.send(number)
        try:
            row = pipe.recv()
        except EOFError:
            worker.join()
            late = worker.exitcode == -signal.SIGXCPU
            what = f"no end within {options.limit:g} s of processor time" if late else "the process crashed"
            row = {**dict.fromkeys(_EMPTY, float("nan")), "cells": 0, "prisms": 0, "regions": 0, **begin}
            row |= {"ok": False, "verdict": "failed", "complaints": what}
            worker = None
        figures = f"{COLUMNS['non-orth. max, mean'](row)}, {row['skewness']:.2f}, {row['seconds']:.0f} s"
        report.add(row, f"{', '.join(map(str, begin.values()))}: {row['verdict']} {figures} {row['complaints'][:160]}")
    if worker is not None:
        worker.terminate()
    return report


RUNS = (*EFFORTS, "exact")
ORDER_COLUMNS = {
    **{name: COLUMNS[name] for name in ("solid", "run", "h", "cells", "mean e", "quotient")},
    "volume error": lambda r: f"{r['volume'] - 1:.1e}",
    "area error": lambda r: f"{r['area']:.1e}",
    "distance / h^2 kappa": lambda r: f"{r['distance']:.2e}",
}
SMOOTH = {
    "ball": (lambda edge: clvoro.Solid.ball((0, 0, 0), 1, edge=edge), 1.0),
    "torus": (lambda edge: clvoro.Solid.torus((0, 0, 0), 1.4, 0.6, edge=edge), 1 / 0.6),
    "cylinder": (lambda edge: clvoro.Solid.cylinder((0, 0, 0), (0, 0, 1), 1, edge=edge), 1.0),
}
"""Solids, by the length of triangles, and their curvatures."""


def smooth(options: argparse.Namespace) -> Iterable[Job]:
    """Return smooth solids, for errors of volume and wall area, and distances of vertices of walls from the surface."""
    sizes = [float(h) for h in names(options.order)]

    def errors_of(result: clvoro.Result, case: Path, solid: clvoro.Solid, unit: float) -> dict[str, Any]:
        f = result.diagram.faces
        walls = np.unique(f.corners[f.starts[f.n_inner] :])
        area = float(f.area[f.n_inner :].sum() / solid.boundary_measure - 1)
        return {"area": area, "distance": float(solid.boundary_distance(f.points[walls]).max() / unit)}

    def made(name: str, run: str, h: float) -> Made:
        make, curvature = SMOOTH[name]
        solid = make(min(sizes) / 3)
        return solid, h, settings_of(run), partial(errors_of, solid=solid, unit=h**2 * curvature)

    for name, run, h in product(SMOOTH, names(options.runs), sizes):
        yield {"solid": name, "run": run, "h": h}, partial(made, name, run, h)


def settings_of(run: str) -> dict[str, Any]:
    """Return the settings of a run: an effort or "exact"."""
    return {"method": "exact"} if run == "exact" else {"effort": run}


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--only", default="", metavar="NAMES", help=", ".join(SHAPES))
    options_of.add_argument("--runs", default="default", metavar="NAMES", help="efforts, and exact")
    options_of.add_argument("--seeds", type=int, default=1, metavar="N", help="one run with each of 0 to N - 1")
    options_of.add_argument("--worst", action="store_true", help="one row with the worst figures of all runs")
    options_of.add_argument("--resolutions", default="0,1", metavar="NUMBERS", help="0: coarse, 1: fine, 2: finest")
    options_of.add_argument("--graded", action="store_true", help="sizes from h / 2 at walls to 2 h")
    options_of.add_argument("--booleans", type=int, default=0, metavar="N", help="random solids in place of those")
    options_of.add_argument(
        "--files", type=Path, metavar="FOLDER", help="solids of all files below it in place of those"
    )
    options_of.add_argument("--first", type=int, default=0, metavar="N", help="number of the first random solid")
    options_of.add_argument("--cells", type=int, default=1500, metavar="N", help="of each random solid, about")
    options_of.add_argument("--limit", type=float, default=600, metavar="SECONDS", help="processor time for each mesh")
    options_of.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the cases, with checkMesh.log")
    options_of.add_argument("--pictures", type=Path, metavar="FOLDER")
    options_of.add_argument("--order", default="", metavar="SIZES", help="errors of volume and area at these sizes")
    options_of.add_argument("--layers", default="", metavar="LAYERS", help="thickness / h:count:growth, as 0.5:5:1.3")
    options_of.add_argument("--surfaces", action="store_true", help="domains with surfaces inside")
    options = options_of.parse_args()
    shapes: Any = SCENES if options.surfaces else LAYERED if options.layers else SHAPES
    for what, given, known in (
        ("solid", () if options.booleans or options.files else names(options.only), shapes),
        ("resolution", names(options.resolutions), ("0", "1", "2")),
        ("run", names(options.runs), RUNS),
    ):
        if unknown := [name for name in given if name not in known]:
            options_of.error(f"no {what} {', '.join(unknown)}; there are {', '.join(known)}")
    require("checkMesh")
    adapter = make_adapter(options)
    report = measure_all(options)
    verdicts = [row["verdict"] for row in report.records]
    title = ", ".join(f"{verdicts.count(v)} {v}" for v in ("accepted", "rejected", "refused", "failed"))
    if options.worst:
        report.records = worst_of(report.records)
        title += f", {sum(row['good'] for row in report.records)} meet the goals"
    report.finish(heading(adapter, title))


_EMPTY = (
    *("seconds", "error", "quotient", "non_orthogonality", "mean_non_orthogonality", "skewness", "concave", "volume"),
    *("thickness", "full", "first", "aspect", "inner", "off", "area", "distance"),
)


if __name__ == "__main__":
    main()
