"""Frames of a case with a moving size field: each mesh starts from the previous one."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..adaptation.options import Options, arguments_of_run, uses
from ..errors import MissingLibraryError, MissingPicturesWarning
from ..io import save
from ..io.atomic import atomic_file, writing
from ..mesh.results import Result, figures

if TYPE_CHECKING:
    from .cases import Case

_KEPT = ("n_cells", "max_steps", "tol", "alpha", "k", "seed", "effort", "error_target", "fixed")
"""Settings of the run that later frames keep."""
COLUMNS = ("frame", "time", "cells", "steps", "mean_error", "max_error", "mean_quality", "min_quality", "seconds")
PICTURED = 6


def run_frames(
    case: Case,
    adapter: Any,
    first: Result,
    out: Path,
    stop: Callable[[], bool],
    pictures: bool,
    tell: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Adapt `first`, the mesh of frame 0, to the later ones in turn, and write them into `out`.

    Frame k of n has the time k / n. The files are ``frames/mesh-KKK.vtu``, ``frames.csv`` with `COLUMNS`, and with
    `pictures` ``pictures/frames.png``. The sequence ends early if `stop` returns True; `tell` gets progress texts.
    """
    folder = out / "frames"
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    method = case.methods[-1] or Options.method
    kept = {k: v for k, v in case.run_arguments().items() if k in _KEPT and uses(method, k)}
    arguments = arguments_of_run(kept) | {"method": method}
    result, rows, shown = first, [], {}
    wanted = np.unique(np.linspace(0, case.frames - 1, min(PICTURED, case.frames)).round())
    try:
        for frame in range(case.frames):
            time = frame / case.frames
            if frame:
                if stop():
                    break
                tell(f"frame {frame + 1} of {case.frames}")
                result = adapter.run(
                    case.domain,
                    case.size_field(time),
                    points=result.points,
                    callback=lambda _: stop(),
                    on_interrupt="return",
                    **arguments,
                )
            save(result, folder / f"mesh-{frame:03d}.vtu")
            rows.append(_row(frame, time, result))
            if pictures and frame in wanted:
                shown[time] = result
    finally:  # write the rows of earlier frames also if a frame fails
        _write_rows(rows, out / "frames.csv")
    if shown and case.domain.cell_dim == 2:
        _draw(shown, out / "pictures" / "frames.png")
    return rows


def _write_rows(rows: list[dict[str, Any]], path: Path) -> None:
    with atomic_file(path) as file:
        lines = [",".join(COLUMNS), *(",".join(f"{row[c]:.6g}" for c in COLUMNS) for row in rows)]
        file.write(("\n".join(lines) + "\n").encode())


def _row(frame: int, time: float, result: Result) -> dict[str, Any]:
    history = result.history
    return {
        "frame": frame,
        "time": time,
        "cells": len(result.points),
        "steps": int(history["step"][-1]),
        **figures(result.size_error, result.quality),
        "seconds": float(history["seconds"][-1]),
    }


def _draw(shown: Mapping[float, Result], path: Path) -> None:
    """Draw frames side by side, colored by target size."""
    from ..plotting.colors import shared_paint
    from ..plotting.pictures import plot_side_by_side, render

    panels = {f"t = {time:.2f}, {len(result.points)} cells": result for time, result in shown.items()}
    try:
        picture = render(plot_side_by_side(panels, shared_paint(list(shown.values()), "size"), "size", 3))
    except MissingLibraryError as error:
        warnings.warn(f"no picture of the frames: {error}", MissingPicturesWarning, stacklevel=2)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as file:
        file.write(picture)


def frames_line(rows: list[dict[str, Any]]) -> str:
    """Return a one-line summary of the frames after the first."""
    later = rows[1:] or rows
    worst = max(row["mean_error"] for row in later)
    return (
        f"{len(rows)} frames: {min(r['steps'] for r in later)} to {max(r['steps'] for r in later)} steps each, "
        f"mean |e| up to {worst:.4f}, mean Q down to {min(r['mean_quality'] for r in later):.4f}, "
        f"{sum(r['seconds'] for r in later):.1f} seconds in all"
    )
