"""Size fields and the meshes that they make, in one picture.

    python bench/fields.py [--effort default] [--out DIR] [--device NAME] [--dtype float32] [--json]

Writes `fields.png` into `bench/pictures` or `--out`, and prints the error and quality of each mesh. Six fields on one
box with one color scale: the distance to a polygon, a raster with gaps, a jump that `Graded` makes a ramp, sizes
from the second derivatives and from the gradient of a solution, and a combination of fields. Lines show the sources
of a field; dashed lines are the gaps, the jump, the layer, the wake.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from _common import FIRST_SEED, PICTURES, SHAPE_COLUMNS, Report, figures, heading, make_adapter, parser

import clvoro
from clvoro import sizing

BOX = clvoro.Box((0, 0), (1.5, 1))
LIMITS = (0.008, 0.12)
"""Ends of the color scale. The lower one is below the smallest cells, so that their faces can be seen."""
LINE = "#D55E00"


@dataclass
class Example:
    """A size field, and what is drawn over its mesh."""

    title: str
    size: sizing.Field
    lines: list[np.ndarray] = field(default_factory=list)
    """What the field was made from: polylines (k, 2)."""
    dashed: list[np.ndarray] = field(default_factory=list)


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
        size = sizing.hessian_size(values, BOX.lower, BOX.upper, n_cells=1100, h_max=0.12)
        return Example("Graded(hessian_size(u, ...), growth=1.3)", sizing.Graded(size, growth=1.3), dashed=[layer])
    size = sizing.gradient_size(values, BOX.lower, BOX.upper, eps=0.45, h_max=0.12)
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


def examples() -> list[Example]:
    return [
        distance_to_polygon(),
        raster_with_gaps(),
        graded_jump(),
        from_solution("hessian"),
        from_solution("gradient"),
        composition(),
    ]


def draw(results: list[tuple[Example, clvoro.Result]], path: Path) -> None:
    from matplotlib import patheffects

    from clvoro.plotting.cells import plot_cells
    from clvoro.plotting.colors import Paint, coloring
    from clvoro.plotting.legends import add_color_bar
    from clvoro.plotting.style import new_figure, styled

    halo = [patheffects.Stroke(linewidth=2.2, foreground="white"), patheffects.Normal()]
    with styled():
        figure = new_figure(10.5, 5.7)
        axes = figure.subplots(2, 3).ravel()
        for ax, (example, result) in zip(axes, results, strict=True):
            plot_cells(result, "size", ax=ax, limits=LIMITS, key=False)
            for lines, style in ((example.lines, "-"), (example.dashed, (0, (4, 3)))):
                for line in lines:
                    ax.plot(*line.T, color=LINE, linewidth=1.1, linestyle=style, path_effects=halo)
            ax.set(xticks=[], yticks=[], xlabel="", ylabel="")
            ax.set_title(example.title, family="monospace", fontsize=8.5, loc="left")
            ax.text(
                0.985,
                0.03,
                f"{len(result.points):,} cells",
                transform=ax.transAxes,
                ha="right",
                fontsize=8,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 2},
            )
        everything = np.concatenate([result.target_size for _, result in results])
        paint = Paint(coloring("size"), everything, LIMITS)
        add_color_bar(axes, paint, location="bottom", shrink=0.5, aspect=50)
        figure.savefig(path, dpi=150, pil_kwargs={"optimize": True})


COLUMNS = {
    "field": lambda r: r["field"],
    "cells": lambda r: f"{r['cells']:,}",
    "least h": lambda r: f"{r['least']:.4f}",
    "largest h": lambda r: f"{r['most']:.4f}",
    **SHAPE_COLUMNS,
}


def main(arguments: list[str] | None = None) -> int:
    made = parser(__doc__)
    made.add_argument("--effort", default="default", choices=("fast", "default", "best"))
    made.add_argument("--out", type=Path, default=PICTURES, metavar="DIR")
    options = made.parse_args(arguments)
    adapter = make_adapter(options)
    report = Report(options.json, COLUMNS)
    results: list[tuple[Example, Any]] = []
    for example in examples():
        result = adapter.run(BOX, example.size, effort=options.effort, seed=FIRST_SEED)
        results.append((example, result))
        report.add(
            {
                "field": example.title,
                "least": float(result.target_size.min()),
                "most": float(result.target_size.max()),
                **figures(result.diagram, result.target_size, result.quality),
            },
            example.title,
        )
    options.out.mkdir(parents=True, exist_ok=True)
    draw(results, options.out / "fields.png")
    report.finish(heading(adapter, "Meshes of the size fields"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
