"""Check the values of a result: compute sizes, error, quality and history again, and compare."""

from __future__ import annotations

import numpy as np

from ..diagram import Diagram
from ..results import Result, figures
from ..straightening import cell_quality, cell_sizes
from .findings import ROUNDINGS, Check
from .rebuilt import Rebuilt

LOOSE = 256 * float(np.finfo(np.float32).eps)
"""Tolerance of means in the history, in any precision: the device sums the quality in float32."""


def check_history(check: Check, result: Result, rounding: float) -> None:
    """Check numbers and order of the history, and its last row against the mesh: errors up to `rounding`."""
    rows = result.history
    if not len(rows):  # read from a .vtu file
        return
    for name in rows.dtype.names or ():
        values = rows[name]
        least = int(name == "cells")  # all others are at least 0
        check.note(
            "history",
            ~(np.isfinite(values) & (values >= least)),
            lambda r, name=name, values=values: f"{name} in row {r} of the history is {values[r]}",
        )
    # A second row may follow the last step.
    steps = rows["step"].astype(np.int64)
    rises = np.diff(steps)
    wrong = rises != 1
    wrong[-1:] &= rises[-1:] != 0
    check.note("history", wrong, lambda r: f"row {r + 1} of the history is step {steps[r + 1]}, after {steps[r]}")
    for name, sign in (("level", -1), ("progress", 1), ("seconds", 1)):
        values = rows[name].astype(float)
        check.note(
            "history",
            np.diff(values) * sign < 0,
            lambda r, name=name, values=values: (
                f"{name} in row {r + 1} of the history is {values[r + 1]}, after {values[r]}"
            ),
        )
    cells, inserted, deleted = (rows[name].astype(np.int64) for name in ("cells", "inserted", "deleted"))
    check.note(
        "history",
        np.diff(cells) != (inserted - deleted)[1:],
        lambda r: (
            f"row {r + 1} of the history has {cells[r + 1]} cells, after {cells[r]}, of {inserted[r + 1]} "
            f"inserted and {deleted[r + 1]} deleted"
        ),
    )
    check.note(
        "history",
        [rows["cells"][-1] != len(result.points)],
        lambda _: f"the history ends with {rows['cells'][-1]} cells, the mesh has {len(result.points)}",
    )
    check.note(
        "history", [rows["level"][-1] != 0], lambda _: f"the history ends on level {rows['level'][-1]}, expected 0"
    )
    for name, value in figures(result.size_error, result.quality).items():
        last = rows[name][-1]
        check.note(
            "history",
            [not abs(last - value) <= LOOSE * abs(value) + rounding],
            lambda _, name=name, last=last, value=value: f"{name} ends with {last:.6g}, the mesh has {value:.6g}",
        )


def check_values(check: Check, result: Result, g: Rebuilt) -> None:
    """Check sizes, errors, quality and history of a result, given its checked diagram."""
    d = result.diagram
    n, dim = len(d), d.domain.cell_dim
    for name in ("target_size", "size_error", "quality"):
        check.shape(name, getattr(result, name), (n,))
    check.shape("points", result.points, (n, d.domain.dim))
    h, e, q = result.target_size, result.size_error, result.quality
    check.note(
        "points",
        (result.points != d.points).any(axis=1),
        lambda i: f"points[{i}] is {result.points[i]}, the diagram's {d.points[i]}",
    )
    check.note("target_size", ~(h > 0), lambda i: f"target_size[{i}] is {h[i]}, expected > 0", stop=True)
    eps = float(np.finfo(g.real).eps)
    length = cell_sizes(d)
    with np.errstate(all="ignore"):
        error = (length - h) / np.minimum(length, h)
        counts = np.diff(d.neighbor_starts)
        perimeter = np.bincount(np.repeat(np.arange(n), counts), d.face_measures, minlength=n)
        quality = cell_quality(d, perimeter)
    # Cells with straight walls are measured by positions of corners, which change the volume by their shift times the
    # perimeter: that of a slender cell is long.
    at_walls = d.domain.cuts_cells * ROUNDINGS * g.unit / length
    slender = np.maximum(perimeter / (2 * dim * length ** (dim - 1)), 1)
    check.compare(
        "size_error", e, error, (64 * eps + at_walls * slender) * (1 + np.abs(error)), "volume and target size"
    )
    # Measures from the corners in a file, and straightened boundaries, have the round-off of positions.
    rounding = ROUNDINGS * g.unit * counts * g.reach ** (dim - 2) / perimeter
    width = (64 * eps + at_walls) * (1 + quality)
    if not g.remade:
        # A face as short as round-off may have the direction of the round-off.
        slivers = d.face_measures < ROUNDINGS * g.unit * g.reach[g.owner] ** (dim - 2)
        loose = np.bincount(g.owner, slivers, minlength=n) > 0
        if d.domain.cuts_cells:
            loose |= np.bincount(g.owner, d.neighbors < 0, minlength=n) > 0
        elif g.edges is not None:
            # The device includes faces that the diagram leaves out as narrow as round-off; slivers lie among these.
            doubtful = np.flatnonzero(np.abs(q - quality) > width)
            loose[doubtful[borders_on_lost_faces(d, g, doubtful)]] = True
        rounding *= loose
    check.compare("quality", q, quality, width + 3 * rounding, "faces")
    # A run computes its last errors before faces are measured in full precision, which moves corners by a few units.
    check_history(check, result, 64 * eps + 8 * g.unit / float(length.min(initial=np.inf)))
    _check_factor(check, result)


def borders_on_lost_faces(d: Diagram, g: Rebuilt, cells: np.ndarray) -> np.ndarray:
    """Return which of `cells` (k,), in 3D, may lack faces that were as narrow as the round-off of vertices, (k,) bool.

    Such a face lay along an edge or a part of it. Two other faces meet there whose cells are not neighbors of each
    other, or whose edge has more than one part.
    """
    n, walls = len(d), len(d.domain.boundary_index)
    half = np.flatnonzero(np.isin(g.cells, cells))  # half-edges: each edge in one of its two faces
    assert g.edges is not None
    face, one, other = (ends[half] for ends in g.edges)
    order = np.lexsort((np.maximum(one, other), np.minimum(one, other), g.owner[face]))
    key = np.stack([g.owner[face], np.minimum(one, other), np.maximum(one, other)])[:, order]
    first = np.flatnonzero((key[:, 1:] == key[:, :-1]).all(axis=0))
    pair = np.sort(face[order[np.stack([first, first + 1])]], axis=0)
    pair, parts = np.unique(pair, axis=1, return_counts=True)
    split = g.owner[pair[0, parts > 1]]
    pair = np.where(d.neighbors[pair[0]] >= 0, pair, pair[::-1])  # a wall has no second half-face
    pair = pair[:, d.neighbors[pair[0]] >= 0]
    across, along = d.neighbors[pair]
    shifts = d.shifts.astype(np.int64)
    step = np.where((along >= 0)[:, None], shifts[pair[1]] - shifts[pair[0]], 0)

    def names(cell: np.ndarray, label: np.ndarray, shift: np.ndarray) -> np.ndarray:
        return (cell.astype(np.int64) * (n + walls) + label + walls) * 125 + (shift + 2) @ (1, 5, 25)

    beside = np.flatnonzero(np.isin(g.owner, across))
    known = names(g.owner[beside], d.neighbors[beside], shifts[beside])
    apart = ~np.isin(names(across, along, step), known)
    return np.isin(cells, np.concatenate([split, g.owner[pair[0, apart]]]))


def _check_factor(check: Check, result: Result) -> None:
    """Check the factor of the sizes, which is 1 without `n_cells`."""
    factor, n_cells = result.size_factor, result.settings.get("n_cells")
    # With the method transport the volumes are scaled to their sum.
    scaled = n_cells is not None or result.settings.get("method") == "transport"
    known = "n_cells" in result.settings and not scaled
    number = isinstance(factor, int | float) and np.isfinite(factor) and factor > 0
    check.note(
        "size factor",
        [not number or (known and factor != 1)],
        lambda _: f"size_factor is {factor!r:.40}, expected " + ("1, as there is no n_cells" if known else "> 0"),
    )
    recorded = result.settings.get("size_factor", factor)
    check.note(
        "size factor",
        [recorded != factor],
        lambda _: f"size_factor is {factor!r:.40}, {recorded!r:.40} in the settings",
    )
