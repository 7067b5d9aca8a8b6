"""What the benches share: options, the test fields, the figures of a mesh, tables.

Importing it makes `clvoro` that of the checkout that holds `bench/`, even where another one is installed.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import clvoro
from clvoro import sizing

PICTURES = Path(__file__).resolve().parent / "pictures"
BOX = clvoro.Box((0, 0), (2.5, 1.5))
SQUARE, CUBE = clvoro.Box((0, 0), (1, 1)), clvoro.Box((0, 0, 0), (1, 1, 1))
PERIODIC, PERIODIC_CUBE = (clvoro.Box(box.lower, box.upper, periodic=True) for box in (SQUARE, CUBE))
FIRST_SEED = 20251


def test_field(name: str) -> sizing.Field:
    """Return the size field F1, F2, F3, F4, circles, ridge or corner on `BOX`, or S1, S2 or S3 on `CUBE`, all absolute.

    "steep circles" and "steep ridge" are harder variants.

    F1 = 0.02 + 0.3 d, F2 = 0.002 + 0.08 d, F4 = F2 / 6.6, with d the distance to the circle of
    radius 0.3 about (0.9, 0.75); F3 = 0.9306 min(0.15, 0.02 + ln(1.3) d) / 4, radius 0.25 about
    (0.8, 0.75). S1 = 0.04 + 0.3 d, with d the distance to the sphere of radius 0.25 about
    (0.5, 0.5, 0.4); S2 = S1 / 2 and S3 = S1 / 4. circles = min(0.012 + 0.12 d1, 0.006 + 0.12 d2), with d1 and d2 the
    distances to the circles of radius 0.35 about (0.7, 0.75) and of radius 0.2 about (1.8, 0.75), has kinks between
    them and at their centers. ridge = 0.007 + 0.12 |y - 0.75 - 0.3 sin(1.6 pi x)| is steeper than 0.2 in places.
    corner = 0.025 (r + 0.001)^(2/3), with r the distance from the corner (0, 0), has sizes 1 : 180.
    steep circles have the slope 0.2, and steep ridge = 0.0046 + 0.165 |...| has slopes up to 0.3.
    """
    if name == "circles":
        large, small = sizing.Circle((0.7, 0.75), 0.35), sizing.Circle((1.8, 0.75), 0.2)
        return sizing.minimum(
            sizing.Distance(large, h_min=0.012, slope=0.12), sizing.Distance(small, h_min=0.006, slope=0.12)
        )
    if name == "steep circles":
        return sizing.minimum(
            sizing.Distance(sizing.Circle((0.7, 0.75), 0.35), h_min=0.0075, slope=0.2),
            sizing.Distance(sizing.Circle((1.8, 0.75), 0.2), h_min=0.00375, slope=0.2),
        )
    if name == "ridge":
        return sizing.Expression("0.007 + 0.12 * fabs(y - 0.75 - 0.3 * sin(1.6 * pi * x))")
    if name == "corner":
        return sizing.Expression("0.025 * pow(hypot(x, y) + 0.001, 2.0 / 3.0)")
    if name == "steep ridge":
        return sizing.Expression("0.0046 + 0.165 * fabs(y - 0.75 - 0.3 * sin(1.6 * pi * x))")
    if name in ("S1", "S2", "S3"):
        sphere = sizing.Ball((0.5, 0.5, 0.4), 0.25)
        return sizing.Distance(sphere, h_min=0.04, slope=0.3) * 0.5 ** (int(name[1]) - 1)
    circle = sizing.Circle((0.9, 0.75), 0.3)
    if name == "F1":
        return sizing.Distance(circle, h_min=0.02, slope=0.3)
    if name in ("F2", "F4"):
        field = sizing.Distance(circle, h_min=0.002, slope=0.08)
        return field if name == "F2" else field * (1 / 6.6)
    if name == "F3":
        circle = sizing.Circle((0.8, 0.75), 0.25)
        return sizing.Distance(circle, h_min=0.02, growth=1.3, h_max=0.15) * (0.9306 / 4)
    raise ValueError(f"no field {name}")


def domain_of(name: str) -> clvoro.Box:
    """Return the domain of the test field `name`."""
    return CUBE if name.startswith("S") else BOX


def parser(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser that knows --device, --dtype and --json; `doc` is the script's docstring."""
    title, _, rest = (doc or "").partition("\n")
    made = argparse.ArgumentParser(description=title, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("--device", metavar="NAME", help="as for clvoro run: gpu, part of a name, 0:0")
    made.add_argument("--dtype", choices=("float64", "float32"), default="float64")
    made.add_argument("--json", action="store_true", help="print one JSON object per line instead")
    return made


def names(text: str) -> list[str]:
    """Split a comma-separated option."""
    return [part.strip() for part in text.split(",") if part.strip()]


def counts(text: str) -> list[int]:
    """Split a comma-separated option of whole numbers, 1e6 allowed."""
    return [round(float(part)) for part in names(text)]


def seeds_of(text: str) -> list[int]:
    """Return the seeds in an option: one number stands for 1 to that number."""
    given = counts(text)
    return list(range(1, given[0] + 1)) if len(given) == 1 else given


def make_adapter(options: argparse.Namespace) -> clvoro.Adapter:
    """Return an adapter as the options say, or end the script with a message."""
    try:
        return clvoro.Adapter(clvoro.create_context(options.device), dtype=options.dtype)
    except clvoro.ClvoroError as error:
        raise SystemExit(f"{type(error).__name__}: {error}") from error


def random_points(domain: Any, n: int) -> np.ndarray:
    """Return n uniform random points in `domain`."""
    rng, points = np.random.default_rng(7411), np.empty((0, domain.dim))
    while len(points) < n:
        more = rng.uniform(domain.lower, domain.upper, (n, domain.dim))
        points = np.concatenate([points, more[domain.contains(more)]])
    return domain.nearest(points[:n])


def run_ranks(ranks: int, script: Sequence[str], **settings: Any) -> subprocess.CompletedProcess[str]:
    """Run a `script` (file, arguments) under `mpiexec`, a core for each rank, with `settings` of `subprocess.run`."""
    mpiexec = shutil.which("mpiexec", path=Path(sys.executable).parent) or "mpiexec"
    command = [mpiexec, "-n", str(ranks), sys.executable, "-W", "ignore", *script]
    environment = {**os.environ, "POCL_MAX_PTHREAD_COUNT": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, **settings)


def clock_of(options: argparse.Namespace, adapter: clvoro.Adapter | None = None) -> Callable[[], float]:
    """Return the clock: the wall clock, or with `--processor-time` the processor time of this process.

    Processor time is divided by the compute units of the adapter's device. On an idle machine both are equal if all
    units work all the time.
    """
    if not options.processor_time:
        return time.perf_counter
    units = 1 if adapter is None else adapter.ctx.devices[0].max_compute_units
    return lambda: time.process_time() / units


def best(repeat: int, function: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> tuple[float, Any]:
    """Return the least of `repeat` times of `function` by `clock`, and its last result."""
    times = []
    for _ in range(repeat):
        start = clock()
        result = function()
        times.append(clock() - start)
    return min(times), result


def device_name(adapter: clvoro.Adapter) -> str:
    """Name of the device, its platform and its number of compute units."""
    device = adapter.ctx.devices[0]
    platform = device.platform
    units = f"{device.max_compute_units} compute units"
    return f"{device.name.strip()} ({platform.name.strip()}, {units})"


def heading(adapter: clvoro.Adapter, what: str) -> str:
    """Line above a table: what, when, where, in which precision."""
    return f"{what}. {date.today()}, {device_name(adapter)}, {adapter.dtype.name}."


def off_walls(diagram: clvoro.Diagram) -> np.ndarray:
    """Return for each cell whether it has no face on a wall, (n,) bool."""
    on_wall = np.logical_or.reduceat(diagram.neighbors < 0, diagram.neighbor_starts[:-1])
    return ~on_wall


def figures(diagram: clvoro.Diagram, h: np.ndarray, quality: np.ndarray) -> dict[str, float]:
    """Return the figures that describe a mesh of target sizes `h` (n,).

    Error e is the paper's (3.1), Q its (4.1); "deviation" is |L / h - 1|. Quality and the share of
    six-sided cells count the cells off the walls, those named "..._all" every cell; error and
    deviation count every cell.
    """
    length = diagram.volumes ** (1 / diagram.points.shape[1])
    error = np.abs(length - h) / np.minimum(length, h)
    deviation = np.abs(length / h - 1)
    inner = off_walls(diagram)
    if not inner.any():
        inner[:] = True
    sides = np.diff(diagram.neighbor_starts)
    parts = {"error": error, "error_inner": error[inner], "deviation": deviation}
    found = {f"{how}_{name}": float(getattr(x, how)()) for name, x in parts.items() for how in ("mean", "max")}
    parts = {"quality": quality[inner], "quality_all": quality}
    found |= {f"{how}_{name}": float(getattr(x, how)()) for name, x in parts.items() for how in ("mean", "min")}
    logs, faces, six = np.log(length / h).mean(), sides[inner].mean(), (sides[inner] == 6).mean()
    return {"cells": len(diagram), **found, "signed_log": float(logs), "faces": float(faces), "six_sided": float(six)}


def cell_quality(diagram: clvoro.Diagram) -> np.ndarray:
    """Return for each cell the paper's (4.1) in 2D, 36 pi V^2 / S^3 in 3D, on the host."""
    sides = np.diff(diagram.neighbor_starts)
    perimeter = np.add.reduceat(diagram.face_measures, diagram.neighbor_starts[:-1])
    if diagram.points.shape[1] == 3:
        return 36 * math.pi * diagram.volumes**2 / perimeter**3
    return 4 * diagram.volumes * sides * np.tan(math.pi / sides) / perimeter**2


def work(history: np.ndarray) -> dict[str, float]:
    """Return the cost of a run in steps of its finest level. The cost of a step is proportional to its cells.

    "work" counts steps; "tessellations" adds those of the start and after insertions and deletions.
    """
    cells = history["cells"] / history["cells"][-1]
    anew = history["inserted"] + history["deleted"] > 0
    # The first row is the start; a closing row that follows no step tells of generators only.
    stepped = np.diff(history["step"], prepend=history["step"][0]) > 0
    steps = float(cells[stepped].sum())
    return {
        "steps": int(history["step"][-1]),
        "work": steps,
        "tessellations": steps + float(cells[0]) + float(cells[anew].sum()),
    }


def spread(values: Sequence[float], form: str) -> str:
    """Write one value, or the median and the range of several."""
    if len(values) == 1:
        return format(values[0], form)
    low, middle, high = min(values), statistics.median(values), max(values)
    shown = [format(v, form) for v in (low, middle, high)]
    return shown[1] if shown[0] == shown[2] else f"{shown[1]} ({shown[0]} .. {shown[2]})"


def shown(figure: str, form: str, scale: float = 1) -> Callable[[dict[str, Any]], str]:
    """Return the text of a column: a figure of the record times `scale`, or nothing if it has none."""
    return lambda r: format(r[figure] * scale, form) if r.get(figure) is not None else ""


def markdown(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table; bars in the text are escaped."""

    def line(cells: Iterable[object]) -> str:
        return "| " + " | ".join(str(c).replace("|", "\\|") for c in cells) + " |"

    return "\n".join([line(header), "|" + "---|" * len(header), *(line(row) for row in rows)])


def draw_sizes(meshes: list[tuple[Any, dict[str, Any]]], path: Path, extent: tuple[float, float], ratios: Any) -> None:
    """Draw meshes side by side, colored by their sizes, each with settings of its axes; `extent` is in inches."""
    from clvoro.plotting import plot_cells
    from clvoro.plotting.style import new_figure, styled

    path.parent.mkdir(parents=True, exist_ok=True)
    with styled():
        figure = new_figure(*extent)
        axes = np.atleast_1d(figure.subplots(1, len(meshes), width_ratios=ratios))
        for ax, (mesh, settings) in zip(axes, meshes, strict=True):
            plot_cells(mesh, "size", ax=ax, key=False)
            ax.set(**{"xticks": [], "yticks": [], "xlabel": "", "ylabel": "", **settings})
        figure.savefig(path, dpi=115)


SHAPE_COLUMNS: dict[str, Callable[[dict[str, Any]], object]] = {
    "mean |e|": lambda r: f"{r['mean_error']:.4f}",
    "max |e|": lambda r: f"{r['max_error']:.3f}",
    "mean Q": lambda r: f"{r['mean_quality']:.4f}",
    "min Q": lambda r: f"{r['min_quality']:.3f}",
}
"""Columns for the errors of the sizes and the quality of the shapes of a mesh."""


class Report:
    """Print rows as they come with --json, else gather them into one Markdown table.

    `columns` have the header of each column, and what it shows of a record.
    """

    def __init__(self, as_json: bool, columns: Mapping[str, Callable[[dict[str, Any]], object]]) -> None:
        self.as_json, self.columns = as_json, columns
        self.records: list[dict[str, Any]] = []

    def add(self, record: dict[str, Any], note: str = "") -> None:
        """Add one record. Without --json, `note` on stderr shows the progress."""
        self.records.append(record)
        if self.as_json:
            print(json.dumps(record), flush=True)
        elif note:
            print(note, file=sys.stderr, flush=True)

    def finish(self, title: str) -> None:
        """Print the table."""
        if not self.as_json:
            rows = [[show(r) for show in self.columns.values()] for r in self.records]
            print(f"{title}\n\n{markdown(list(self.columns), rows)}\n")
