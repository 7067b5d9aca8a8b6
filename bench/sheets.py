"""Two sheets of pictures: size fields, and domains with boundary layers.

    python bench/sheets.py [--only fields,domains] [--effort default] [--out DIR] [--device NAME] [--dtype float32]
                           [--json]

Draws `fields.png` and `domains.png` into `bench/pictures` or `--out`, with one color scale, and prints the error and
quality of each mesh. "fields" are six on one box: the distance to a polygon, a raster with gaps, a jump that `Graded`
makes a ramp, sizes from the second derivatives and from the gradient of a solution, and a combination. Lines show the
sources of a field; dashed lines are the gaps, the jump, the layer, the wake. "domains" are a lake with an island, eight
cells across its straits; a wing section in a channel, with boundary layers; and a box that is periodic in both
directions, with refined spots across its seams.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from _common import FIRST_SEED, PICTURES, SHAPE_COLUMNS, Report, figures, heading, make_adapter, names, parser
from _sites import rough_lake

import clvoro
from clvoro import sizing

BOX = clvoro.Box((0, 0), (1.5, 1))
LIMITS = (0.008, 0.12)
"""Ends of the color scale. The lower one is below the smallest cells, so that their faces can be seen."""
LINE = "#D55E00"


@dataclass
class Example:
    """A size field, where it is used, further options of a run, and what is drawn over the mesh."""

    title: str
    size: sizing.Field | float | Callable[[np.ndarray], np.ndarray]
    lines: list[np.ndarray] = field(default_factory=list)
    """What the field was made from: polylines (k, 2)."""
    dashed: list[np.ndarray] = field(default_factory=list)
    domain: clvoro.Polygon | clvoro.Box = BOX
    arguments: dict[str, Any] = field(default_factory=dict)
    view: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Corners of what is drawn, by default all."""


def circle_line(center: tuple[float, float], radius: float) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 181)
    return np.array(center) + radius * np.column_stack([np.cos(turn), np.sin(turn)])


def distance_to_polygon() -> Example:
    corners = [(0.35, 0.25), (1.1, 0.2), (1.2, 0.45), (0.8, 0.5), (1.05, 0.8), (0.5, 0.8), (0.6, 0.5)]
    size = sizing.Distance(sizing.ClosedPolyline(corners), h_min=0.013, growth=1.2, h_max=0.11)
    return Example("Distance(ClosedPolyline(...), growth=1.2)", size, [np.array([*corners, corners[0]])])


def raster_with_gaps() -> Example:
    """Return sizes from measurements with two holes in them."""
    x, y = np.meshgrid(np.linspace(0, 1.5, 121), np.linspace(0, 1, 81))
    values = 0.036 + 0.022 * np.sin(4.2 * x + 0.6) * np.cos(5 * y - 0.4)
    holes = [((0.45, 0.62), 0.15), ((1.1, 0.36), 0.19)]
    for center, radius in holes:
        values[np.hypot(x - center[0], y - center[1]) < radius] = np.nan
    size = sizing.Graded(sizing.Raster(values, BOX.lower, BOX.upper, missing="nearest"), growth=1.2)
    return Example(
        'Graded(Raster(h, ..., missing="nearest"))',
        size,
        dashed=[circle_line(center, radius) for center, radius in holes],
    )


def graded_jump() -> Example:
    jump = sizing.Expression("x + 0.3 * y < 0.55 ? 0.016 : 0.15")
    edge = np.array([(0.55, 0), (0.25, 1)])
    return Example("Graded(jump, growth=1.15)", sizing.Graded(jump, growth=1.15), dashed=[edge])


def wave(x: np.ndarray) -> np.ndarray:
    """Return where the layer of the solution is."""
    return 0.5 + 0.22 * np.sin(2 * np.pi * x / 1.5)


def from_solution(kind: str) -> Example:
    x, y = np.meshgrid(np.linspace(0, 1.5, 901), np.linspace(0, 1, 601))
    values = np.tanh(30 * (y - wave(x)))
    along = np.linspace(0, 1.5, 200)
    layer = np.column_stack([along, wave(along)])
    if kind == "hessian":
        size = sizing.hessian_size(sizing.Raster(values, BOX.lower, BOX.upper), n_cells=1100, h_max=0.12)
        return Example("Graded(hessian_size(u, ...), growth=1.3)", sizing.Graded(size, growth=1.3), dashed=[layer])
    size = sizing.gradient_size(sizing.Raster(values, BOX.lower, BOX.upper), eps=0.45, h_max=0.12)
    return Example("Graded(gradient_size(u, ...), growth=1.2)", sizing.Graded(size, growth=1.2), dashed=[layer])


def composition() -> Example:
    """Return a wing section and its wake over a background that is coarser to the right."""
    wing = clvoro.curves.naca("4415", chord=0.55, leading_edge=(0.3, 0.58), angle_of_attack=8)
    near = sizing.Distance(wing, h_min=0.012, growth=1.2, h_max=0.1)
    wake = [tuple(wing.vertices[0]), (1.5, 0.42)]
    behind = sizing.Distance(sizing.Segment(*wake), h_min=0.022, growth=1.15, h_max=0.1)
    size = sizing.minimum(near, behind, sizing.Expression("0.05 + 0.03 * x"))
    return Example(
        "minimum(wing, wake, background)", size, [np.vstack([wing.vertices, wing.vertices[:1]])], [np.array(wake)]
    )


def shore() -> Example:
    domain = rough_lake(900, rough=0.2)
    size = sizing.FeatureSize(domain, cells_across=8, growth=1.25, h_min=0.016, h_max=0.11)
    return Example("FeatureSize(Polygon(shore, [island]), 8)", size, domain=domain)


def channel() -> Example:
    wing = clvoro.curves.naca("2412", chord=0.7, leading_edge=(0.4, 0.62), angle_of_attack=10)
    walls = [(0, 0), (2, 0), (2, 1.2), (0, 1.2)]
    domain = clvoro.Polygon(walls, [wing])
    layers = clvoro.Layers(0.008, count=4, growth=1.3, spacing=0.022, edges="hole-1")
    view = ((0.2, 0.3), (1.3, 0.96))
    return Example("layers=Layers(0.008, count=4, ...)", 0.07, domain=domain, arguments={"layers": layers}, view=view)


def spots() -> Example:
    domain = clvoro.Box((0, 0), (1, 1), periodic=True)

    def size(points: np.ndarray) -> np.ndarray:
        h = np.full(len(points), 0.05)
        for center in ((0.02, 0.4), (0.55, 0.97)):
            away = (points - center + 0.5) % 1 - 0.5  # to the nearest image
            h = np.minimum(h, 0.01 + 0.18 * np.hypot(*away.T))
        return h

    return Example("Box(..., periodic=True)", size, domain=domain)


SHEETS: dict[str, tuple[Callable[[], list[Example]], tuple[float, float], int]] = {
    "fields": (
        lambda: [
            distance_to_polygon(),
            raster_with_gaps(),
            graded_jump(),
            from_solution("hessian"),
            from_solution("gradient"),
            composition(),
        ],
        (10.5, 5.7),
        2,
    ),
    "domains": (lambda: [shore(), channel(), spots()], (11.5, 3.35), 1),
}
"""Examples of a sheet, its size in inches, and its number of rows."""


def draw(name: str, results: list[tuple[Example, clvoro.Result]], path: Path) -> None:
    from matplotlib import patheffects

    from clvoro.plotting.cells import plot_cells
    from clvoro.plotting.colors import Paint, coloring
    from clvoro.plotting.legends import add_color_bar
    from clvoro.plotting.style import new_figure, styled

    halo = [patheffects.Stroke(linewidth=2.2, foreground="white"), patheffects.Normal()]
    _, extent, rows = SHEETS[name]
    columns = len(results) // rows
    views = [e.view or (e.domain.lower, e.domain.upper) for e, _ in results]
    widths = [(b[0] - a[0]) / (b[1] - a[1]) for a, b in views[:columns]]
    with styled():
        figure = new_figure(*extent)
        axes = np.ravel(figure.subplots(rows, columns, width_ratios=widths))
        for ax, (low, high), (example, result) in zip(axes, views, results, strict=True):
            plot_cells(result, "size", ax=ax, limits=LIMITS, key=False)
            for lines, style in ((example.lines, "-"), (example.dashed, (0, (4, 3)))):
                for line in lines:
                    ax.plot(*line.T, color=LINE, linewidth=1.1, linestyle=style, path_effects=halo)
            ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[], ylabel="")
            ax.set_title(example.title, family="monospace", fontsize=8.5, loc="left")
            ax.set_xlabel(f"{len(result.points):,} cells", fontsize=8)
        if name == "fields":
            everything = np.concatenate([result.target_size for _, result in results])
            paint = Paint(coloring("size"), everything, LIMITS)
            add_color_bar(axes, paint, location="bottom", shrink=0.5, aspect=50)
        figure.savefig(path, dpi=150, pil_kwargs={"optimize": True})


COLUMNS = {
    "mesh": lambda r: r["mesh"],
    "cells": lambda r: f"{r['cells']:,}",
    "least h": lambda r: f"{r['least']:.4f}",
    "largest h": lambda r: f"{r['most']:.4f}",
    **SHAPE_COLUMNS,
}


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--only", type=names, default=list(SHEETS), help=", ".join(SHEETS))
    made.add_argument("--effort", default="default", choices=("fast", "default", "best"))
    made.add_argument("--out", type=Path, default=PICTURES, metavar="DIR")
    options = made.parse_args()
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.only:
        results = []
        for e in SHEETS[name][0]():
            result = adapter.run(e.domain, e.size, effort=options.effort, seed=FIRST_SEED, **e.arguments)
            results.append((e, result))
            h = result.target_size
            found = figures(result.diagram, h, result.quality)
            report.add({"mesh": e.title, "least": float(h.min()), "most": float(h.max()), **found}, e.title)
        draw(name, results, options.out / f"{name}.png")
    report.finish(heading(adapter, "Meshes of size fields and domains"))


if __name__ == "__main__":
    main()
