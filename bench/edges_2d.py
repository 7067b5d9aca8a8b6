"""The shortest edge of each cell in 2D, beside sizes and shapes.

    python bench/edges_2d.py [--only NAME,...] [--efforts default,best,exact] [--seeds 3]
                                [--device NAME] [--dtype float32] [--json]

Sizes on a box, a periodic box, a lake with an island and a channel with a circle. An edge is a face between two cells,
or a stretch of the boundary of one cell between corners that turn by more than 30 degrees. Stretches that begin or end
at a re-entrant corner are left out: faces that end in the corner make them short. Lengths are relative to h of the
cell, for a face to the mean h of its two cells.

The columns show medians over the seeds; "shortest" is the smallest of all seeds.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from _common import BOX, FIRST_SEED, Report, figures, heading, make_adapter, names, parser, test_field
from domains import spots
from polygon import lake

import clvoro
from clvoro import sizing
from clvoro.mesh.connectivity import face_ends, face_owners

SHORT, SHORTEST = 0.05, 0.01
"""Lengths over h that few cells, and none, may be below."""
CORNER = np.pi / 6
"""Turn of the boundary beyond which an edge ends."""


def two_circles() -> sizing.Field:
    one = sizing.Distance(sizing.Circle((0.75, 0.75), 0.3), h_min=0.008, slope=0.15)
    other = sizing.Distance(sizing.Circle((1.75, 0.75), 0.2), h_min=0.008, slope=0.15)
    return sizing.minimum(one, other)


def ridge() -> sizing.Field:
    return sizing.Expression("0.009 + 0.25 * fabs(y - 0.75 - 0.3 * sin(2.5 * x))")


def channel() -> tuple[clvoro.Polygon, sizing.Field]:
    turn = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    circle = 0.2 + 0.05 * np.column_stack([np.cos(turn), np.sin(turn)])
    domain = clvoro.Polygon([(0, 0), (2.2, 0), (2.2, 0.41), (0, 0.41)], [circle])
    size = sizing.Distance(sizing.Circle((0.2, 0.2), 0.05), h_min=0.006, growth=1.08, h_max=0.025)
    return domain, size


Case = tuple[clvoro.Box | clvoro.Polygon, sizing.Field | float | Callable[[np.ndarray], np.ndarray]]
CASES: dict[str, Callable[[], Case]] = {
    "F1": lambda: (BOX, test_field("F1")),
    "F3": lambda: (BOX, test_field("F3")),
    "F2": lambda: (BOX, test_field("F2")),
    "two circles": lambda: (BOX, two_circles()),
    "ridge": lambda: (BOX, ridge()),
    "uniform": lambda: (BOX, 0.03),
    "fine": lambda: (BOX, test_field("F2") * 0.48),
    "periodic": lambda: (spots().domain, spots().size),
    "lake": lambda: (lake(900), test_field("F1") * 0.5),
    "coast": lambda: (lake(900, rough=0.2), 0.03),
    "channel": channel,
}


def edge_lengths(diagram: clvoro.Diagram, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the length over h of the shortest face and of the shortest stretch of the boundary of each cell.

    Both are (n,); a cell without any has infinity.
    """
    owner, wall = face_owners(diagram), diagram.neighbors < 0
    inner = np.flatnonzero(~wall)
    unit = (h[owner[inner]] + h[diagram.neighbors[inner]]) / 2
    shortest = np.full((2, len(diagram)), np.inf)
    np.minimum.at(shortest[0], owner[inner], diagram.face_measures[inner] / unit)
    rows = np.flatnonzero(wall)
    ends = face_ends(diagram)
    turn = np.full(len(diagram.vertices), np.pi / 2)  # the corners of a box
    if isinstance(domain := diagram.domain, clvoro.Polygon):
        rings = domain.oriented
        turns = dict(zip(map(tuple, rings.vertices), rings.turns, strict=True))
        turn = np.array([turns.get(tuple(v), 0.0) for v in diagram.vertices])
    starts_at = {(owner[k], ends[k, 0]): k for k in rows}
    ends_at = {(owner[k], ends[k, 1]) for k in rows}
    for k in rows:
        cell, vertex = owner[k], ends[k, 0]
        if (cell, vertex) in ends_at and abs(turn[vertex]) <= CORNER:
            continue  # not the first face of a stretch
        length, corners = 0.0, [vertex if (cell, vertex) in ends_at else -1]
        face: int | None = k
        while face is not None:
            length += diagram.face_measures[face]
            corners[1:] = [ends[face, 1]]
            face = starts_at.get((cell, ends[face, 1]))
            face = None if abs(turn[corners[1]]) > CORNER else face
        if (turn[[v for v in corners if v >= 0]] >= -CORNER).all():
            shortest[1, cell] = min(shortest[1, cell], length / h[cell])
    return shortest[0], shortest[1]


def measure(adapter: clvoro.Adapter, name: str, effort: str, seed: int) -> dict[str, Any]:
    domain, size = CASES[name]()
    began = time.perf_counter()
    chosen = {"method": "exact"} if effort == "exact" else {"effort": effort}
    result = adapter.run(domain, size, seed=seed, **chosen)
    faces, stretches = edge_lengths(result.diagram, result.target_size)
    seconds = time.perf_counter() - began
    both = np.minimum(faces, stretches)
    return {
        **figures(result.diagram, result.target_size, result.quality),
        "seconds": float(result.history["seconds"][-1]),
        "wall_seconds": seconds,
        "below_percent": 100 * float((both < SHORT).mean()),
        "far_below": int((both < SHORTEST).sum()),
        "percentile_0.1": float(np.percentile(both, 0.1)),
        "percentile_1": float(np.percentile(both, 1)),
        "percentile_10": float(np.percentile(both, 10)),
        "shortest_face": float(faces.min()),
        "shortest_wall": float(stretches.min()),
    }


SMALLEST = ("shortest_face", "shortest_wall")
FORMS = {
    "cells": ".0f",
    "mean_error": ".4f",
    "max_error": ".3f",
    "mean_quality": ".4f",
    "min_quality": ".3f",
    "min_quality_all": ".3f",
    "seconds": ".1f",
    "below_percent": ".3f",
    "far_below": ".0f",
    "percentile_0.1": ".4f",
    "percentile_1": ".3f",
    "percentile_10": ".3f",
    "shortest_face": ".1e",
    "shortest_wall": ".1e",
}


def main() -> None:
    made = parser(__doc__)
    made.add_argument("--only", type=names, default=list(CASES), metavar="NAME,...")
    made.add_argument("--efforts", type=names, default=["default", "best", "exact"])
    made.add_argument("--seeds", type=int, default=3)
    options = made.parse_args()
    adapter = make_adapter(options)
    columns: dict[str, Callable[[dict[str, Any]], object]] = {
        "case": lambda r: r["case"],
        "effort": lambda r: r["effort"],
    }
    for key, form in FORMS.items():
        columns[key.replace("_", " ")] = lambda r, key=key, form=form: format(r[key], form)
    report = Report(options.json, columns)
    for name in options.only:
        for effort in options.efforts:
            runs = [measure(adapter, name, effort, FIRST_SEED + s) for s in range(options.seeds)]
            record = {key: (min if key in SMALLEST else statistics.median)([r[key] for r in runs]) for key in runs[0]}
            report.add({"case": name, "effort": effort, **record}, f"{name}, {effort}")
    report.finish(heading(adapter, "Short edges"))


if __name__ == "__main__":
    main()
