"""Is what a result says of its cells so? Sizes, error, quality and history, computed anew (beside `check.py`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from .check_history import check_history
from .check_polygon import near_shared_corners
from .findings import ROUNDINGS
from .outlines import SIDE_TURN, Straightened, face_ends, straighten
from .polygon import Polygon

if TYPE_CHECKING:
    from .findings import Check
    from .rebuilt import Rebuilt
    from .results import Diagram, Result


def check_values(check: Check, result: Result, g: Rebuilt) -> None:
    """Check the values of a result, whose diagram is right."""
    d = result.diagram
    n, dim = len(d), d.domain.dim
    for name in ("size", "error", "quality"):
        check.shape(name, getattr(result, name), (n,))
    check.shape("points", result.points, (n, dim))
    h, e, q = result.size, result.error, result.quality
    check.note(
        "points", (result.points != d.points).any(axis=1),
        lambda i: f"points[{i}] is {result.points[i]}, the diagram's {d.points[i]}",
    )  # fmt: skip
    check.note("size", ~(h > 0), lambda i: f"size[{i}] is {h[i]}, expected > 0", stop=True)
    eps = float(np.finfo(g.real).eps)
    length = np.maximum(d.volumes, 0) ** (1 / dim)
    with np.errstate(all="ignore"):
        error = (length - h) / np.minimum(length, h)
        counts = np.diff(d.neighbour_starts)
        perimeter = np.bincount(np.repeat(np.arange(n), counts), d.face_measures, minlength=n)
        if dim == 2:
            quality = _quality_2d(d, q, eps, g.unit)
        else:
            quality = 36 * np.pi * d.volumes**2 / perimeter**3
    check.note(
        "error", np.maximum(np.abs(e - error) - 64 * eps * (1 + np.abs(error)), 0),
        lambda i: f"error[{i}] is {e[i]:.10g}, volume and size give {error[i]:.10g} (the paper's 3.1)",
    )  # fmt: skip
    # Where measures were made anew from a file's corners they round as positions do, as straightened boundaries do.
    rounding = ROUNDINGS * g.unit * counts * (1 if dim == 2 else g.reach) / perimeter
    if not g.remade:
        walls = np.bincount(g.owner, d.neighbours < 0, minlength=n) > 0
        rounding *= walls & isinstance(d.domain, Polygon)
    check.note(
        "quality", np.maximum(np.abs(q - quality) - 64 * eps * (1 + quality) - 3 * rounding, 0),
        lambda i: f"quality[{i}] is {q[i]:.10g}, the cell gives {quality[i]:.10g}",
    )  # fmt: skip
    check_history(check, result, eps)
    _check_factor(check, result)


def _check_factor(check: Check, result: Result) -> None:
    """Check the factor on the sizes: there is one only where a count of cells was asked for."""
    factor, asked = result.size_factor, result.settings.get("n_cells")
    known = "n_cells" in result.settings and asked is None
    number = isinstance(factor, int | float) and np.isfinite(factor) and factor > 0
    check.note(
        "size factor", [not number or (known and factor != 1)],
        lambda _: f"size_factor is {factor!r:.40}, expected " + ("1: no count was asked for" if known else "> 0"),
    )  # fmt: skip
    told = result.settings.get("size_factor", factor)
    check.note(
        "size factor", [told != factor],
        lambda _: f"size_factor is {factor!r:.40}, {told!r:.40} in the settings",
    )  # fmt: skip


def _quality_2d(d: Diagram, q: np.ndarray, eps: float, unit: float) -> np.ndarray:
    """Return the quality (4.1) of each cell (n,).

    Where rounding decides which sides the boundary has, those are taken that suit the quality `q` best.
    """
    quality = np.full(len(q), np.inf)
    for polygons in _straightened(d, eps, unit):
        # A face no longer than a rounding is a side or none, as where pieces touch.
        owner = np.repeat(np.arange(len(d)), np.diff(d.neighbour_starts))
        points = np.bincount(owner, d.face_measures <= ROUNDINGS * unit, len(d)).astype(int)
        for more in range(-int(points.max(initial=0)), 1):
            sides = polygons.sides + np.maximum(more, -points)
            found = dataclasses.replace(polygons, sides=sides).quality()
            quality = np.where(np.abs(found - q) < np.abs(quality - q), found, quality)
    return quality


def _straightened(d: Diagram, eps: float, unit: float) -> Iterator[Straightened]:
    """Go through the polygons that the cells may be, as rounding will have it."""
    if not isinstance(d.domain, Polygon):
        yield straighten(d)
        return
    # In a corner of several rings parts of a cell may come together, with which a side ends.
    on_wall = d.neighbours < 0
    corners = on_wall & near_shared_corners(
        d.domain, d.vertices[face_ends(d)[:, 1]], ROUNDINGS * unit
    )
    # And a cell that is a whole piece of the domain has no corner in which to begin.
    owner = np.repeat(np.arange(len(d)), np.diff(d.neighbour_starts))
    alone = np.bincount(owner, ~on_wall, len(d)) == 0
    begins = int(np.diff(d.neighbour_starts)[alone].max(initial=1))
    for turn in (SIDE_TURN * (1 + k * eps) for k in (64, -64)):
        for ends_at in (None, corners) if corners.any() else (None,):
            for begins_at in range(begins):
                yield straighten(d, turn, ends_at, begins_at)
