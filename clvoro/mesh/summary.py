"""Figures that describe a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from .results import Result
from .straightening import have_corners


def summary(result: Result) -> dict[str, Any]:
    """Return the figures of a run; see `Result.summary`."""
    error, history = np.abs(result.size_error), result.history
    parts = beside_boundary(result) if result.diagram.domain.outline is not None else {}
    apart = {f"{part}_{name}": value for part, some in parts.items() for name, value in some.items()}
    return {
        "cells": len(result.points),
        "steps": int(history["step"][-1]) if len(history) else 0,
        "mean_error": float(error.mean()),
        "max_error": float(error.max()),
        "mean_quality": float(result.quality.mean()),
        "min_quality": float(result.quality.min()),
        "size_factor": float(result.size_factor),
        "error_target": result.settings.get("error_target"),
        "trade": result.settings.get("trade"),
        "ever_changed": float(history["ever_changed"][-1]) if len(history) else 0.0,
        "converged": bool(result.converged),
        "stop_reason": result.stop_reason,
        "seconds": float(history["seconds"][-1]) if len(history) else 0.0,
        **apart,
    }


def beside_boundary(result: Result) -> dict[str, dict[str, Any]]:
    """Return number, mean |e|, mean and least Q of `boundary` cells, those of them at a `corner`, and `inner` cells.

    A corner is a turn of the boundary by more than 30 degrees; see `have_corners`. The values are None if there is no
    such cell.
    """
    d = result.diagram
    owner = np.repeat(np.arange(len(d)), np.diff(d.neighbor_starts))
    on_boundary = np.bincount(owner, d.neighbors < 0, len(d)) > 0
    found = {}
    at_corner = have_corners(d)
    for name, which in (("boundary", on_boundary), ("corner", at_corner), ("inner", ~on_boundary)):
        error, quality = np.abs(result.size_error[which]), result.quality[which]
        some = bool(which.any())
        found[name] = {
            "cells": int(which.sum()),
            "mean_error": float(error.mean()) if some else None,
            "mean_quality": float(quality.mean()) if some else None,
            "min_quality": float(quality.min()) if some else None,
        }
    return found


def boundary_line(result: Result) -> str:
    """Return the figures of cells on the boundary, of those at its corners, and of the others as one line of text."""
    names = {"boundary": "boundary cells", "corner": "of them at corners", "inner": "inner cells"}
    return "; ".join(
        f"{s['cells']} {names[name]}: mean |e| {s['mean_error']:.4f}, mean Q {s['mean_quality']:.4f}, "
        f"min Q {s['min_quality']:.3f}"
        for name, s in beside_boundary(result).items()
        if s["cells"]
    )
