"""Is what a result says of its cells so? Sizes, error, quality and history, computed anew (beside `check.py`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .check_history import check_history
from .findings import ROUNDINGS
from .outlines import straighten
from .polygon import Polygon

if TYPE_CHECKING:
    from .findings import Check
    from .rebuilt import Rebuilt
    from .results import Result


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
            quality = straighten(d, g.real).quality()
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
