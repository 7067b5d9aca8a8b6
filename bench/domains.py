"""Polygonal and periodic domains and layers of cells along walls, in one picture.

    python bench/domains.py [--effort default] [--out DIR] [--device NAME] [--dtype float32] [--json]

Writes `domains.png` into `bench/pictures` or `--out`, and prints the error and quality of each mesh: a lake with an
island, eight cells across its straits; a wing section in a channel, with boundary layers; a box that is periodic in
both directions, with refined spots across its seams.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from _common import FIRST_SEED, PICTURES, Report, figures, heading, make_adapter, parser
from polygon import lake

import clvoro
from clvoro import sizing

LIMITS = (0.008, 0.12)
"""Ends of the color scale. The lower one is below the smallest cells, so that their faces can be seen."""


@dataclass
class Example:
    """A domain, a size field, and further options of a run."""

    title: str
    domain: clvoro.Polygon | clvoro.Box
    size: sizing.Field | Callable[[np.ndarray], np.ndarray]
    arguments: dict[str, Any] = field(default_factory=dict)
    view: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Corners of what is drawn, by default all."""


def shore() -> Example:
    domain = lake(900, rough=0.2)
    size = sizing.FeatureSize(domain, cells_across=8, growth=1.25, h_min=0.016, h_max=0.11)
    return Example("FeatureSize(Polygon(shore, [island]), 8)", domain, size)


def channel() -> Example:
    wing = clvoro.curves.naca("2412", chord=0.7, leading_edge=(0.4, 0.62), angle_of_attack=10)
    walls = [(0, 0), (2, 0), (2, 1.2), (0, 1.2)]
    domain = clvoro.Polygon(walls, [wing])
    layers = clvoro.Layers(0.008, count=4, growth=1.3, spacing=0.022, edges="hole-1")
    return Example("layers=Layers(0.008, count=4, ...)", domain, 0.07, {"layers": layers}, ((0.2, 0.3), (1.3, 0.96)))


def spots() -> Example:
    domain = clvoro.Box((0, 0), (1, 1), periodic=True)

    def size(points: np.ndarray) -> np.ndarray:
        h = np.full(len(points), 0.05)
        for center in ((0.02, 0.4), (0.55, 0.97)):
            away = (points - center + 0.5) % 1 - 0.5  # to the nearest image
            h = np.minimum(h, 0.01 + 0.18 * np.hypot(*away.T))
        return h

    return Example("Box(..., periodic=True)", domain, size)


def draw(results: list[tuple[Example, clvoro.Result]], path: Path) -> None:
    from clvoro.plotting.cells import plot_cells
    from clvoro.plotting.style import new_figure, styled

    with styled():
        figure = new_figure(11.5, 3.35)
        views = [e.view or (e.domain.lower, e.domain.upper) for e, _ in results]
        widths = [(b[0] - a[0]) / (b[1] - a[1]) for a, b in views]
        axes = figure.subplots(1, len(results), width_ratios=widths)
        for ax, (low, high), (example, result) in zip(axes, views, results, strict=True):
            plot_cells(result, "size", ax=ax, limits=LIMITS, key=False)
            ax.set_xlim(low[0], high[0])
            ax.set_ylim(low[1], high[1])
            ax.set(xticks=[], yticks=[], ylabel="")
            ax.set_title(example.title, family="monospace", fontsize=8.5, loc="left")
            ax.set_xlabel(f"{len(result.points):,} cells", fontsize=8)
        figure.savefig(path, dpi=150)


def main() -> None:
    """Run the bench."""
    made = parser(__doc__)
    made.add_argument("--effort", choices=("fast", "default", "best"), default="default")
    made.add_argument("--out", type=Path, default=PICTURES)
    options = made.parse_args()
    adapter = make_adapter(options)
    report = Report(
        options.json,
        {
            "domain": lambda r: r["domain"],
            "cells": lambda r: r["cells"],
            "mean e": lambda r: f"{r['mean_error']:.4f}",
            "max e": lambda r: f"{r['max_error']:.3f}",
            "Q": lambda r: f"{r['mean_quality']:.4f}",
            "min Q": lambda r: f"{r['min_quality']:.3f}",
            "all Q": lambda r: f"{r['mean_quality_all']:.4f}",
        },
    )
    results = []
    for example in (shore(), channel(), spots()):
        result = adapter.run(example.domain, example.size, effort=options.effort, seed=FIRST_SEED, **example.arguments)
        found = figures(result.diagram, result.target_size, result.quality)
        report.add({"domain": example.title, **found}, example.title)
        results.append((example, result))
    options.out.mkdir(parents=True, exist_ok=True)
    draw(results, options.out / "domains.png")
    report.finish(heading(adapter, "Domains"))


if __name__ == "__main__":
    main()
