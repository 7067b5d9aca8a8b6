"""The figures that describe a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from .results import Result


def summary(result: Result) -> dict[str, Any]:
    """Return cells, steps, error, quality, share of changed cells, why it stopped, seconds."""
    error, history = np.abs(result.error), result.history
    return {
        "cells": len(result.points),
        "steps": int(history["step"][-1]) if len(history) else 0,
        "mean_error": float(error.mean()),
        "max_error": float(error.max()),
        "mean_quality": float(result.quality.mean()),
        "min_quality": float(result.quality.min()),
        "size_factor": float(result.size_factor),
        "ever_changed": float(history["ever_changed"][-1]) if len(history) else 0.0,
        "converged": bool(result.converged),
        "stop_reason": result.stop_reason,
        "seconds": float(history["seconds"][-1]) if len(history) else 0.0,
    }


def measures_line(result: Result) -> str:
    """Return in a line what finite-volume methods ask of a mesh."""
    s = result.measures.summary()
    return (
        f"{s['mean_faces']:.2f} faces per cell; skewness mean {s['mean_skewness']:.3f}, "
        f"max {s['max_skewness']:.3f}; angle of centroids mean {s['mean_centroid_angle']:.2f}°, "
        f"max {s['max_centroid_angle']:.1f}°"
    )
