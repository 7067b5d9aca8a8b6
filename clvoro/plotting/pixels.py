"""Meshes of too many cells for polygons: images in which each pixel has the color of the cell at its center."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast
from weakref import WeakKeyDictionary

import numpy as np
from scipy.ndimage import distance_transform_edt

from ..mesh.diagram import Diagram
from .colors import Coloring, cell_norm, without_ends

MOST_POLYGONS = 30_000
"""With more cells in a picture, it is an image."""
PER_INCH = 200
"""Pixels of an image per inch of its axes."""
_RIM = 3
"""Pixels outside of the domain, that far from it, have the color of the nearest pixel inside."""

Locate = Callable[[np.ndarray], np.ndarray]

_last: WeakKeyDictionary[Diagram, tuple[np.ndarray, np.ndarray]] = WeakKeyDictionary()
"""Pixels of the last image of a diagram, and their cells: a report shows the same part in several colors."""


def add_image(
    ax: Any, diagram: Diagram, lower: np.ndarray, upper: np.ndarray, values: np.ndarray,
    scheme: Coloring, limits: tuple[float, float], locate: Locate | None = None,
) -> Any:  # fmt: skip
    """Add an image of the rectangle from `lower` to `upper`, and return it.

    `values` (n,) are those of the cells. `locate` returns the cells at positions (k, 2) in the picture, -1 where there
    is none; by default ``diagram.locate``.
    """
    extent = np.subtract(upper, lower)
    box = ax.get_position()
    inches = ax.figure.get_size_inches() * (box.width, box.height)
    counts = np.maximum(np.ceil(PER_INCH * min(inches / extent) * extent), 2).astype(int)
    x, y = (lower[a] + extent[a] * (np.arange(counts[a]) + 0.5) / counts[a] for a in (0, 1))
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    known = _last.get(diagram)
    if known is None or not np.array_equal(known[0], places):
        cells = (locate or diagram.locate)(places).reshape(len(y), len(x))
        known = _last[diagram] = places, _with_rim(cells)
    # -1 leads to the last place.
    shown = np.append(without_ends(values), np.nan)[known[1]]
    return ax.imshow(
        np.ma.masked_invalid(shown),
        extent=(lower[0], upper[0], lower[1], upper[1]),
        origin="lower",
        # Colors are interpolated: between classes there are no further ones.
        interpolation_stage="rgba",
        cmap=scheme.color_map,
        norm=cell_norm(scheme, limits),
    )


def _with_rim(cells: np.ndarray) -> np.ndarray:
    """Return an array of cells in which pixels of -1 that are near others have the nearest cell."""
    outside = cells < 0
    if not outside.any() or outside.all():
        return cells
    distances, nearest = cast(
        "tuple[np.ndarray, np.ndarray]", distance_transform_edt(outside, return_indices=True)
    )
    return np.where(distances <= _RIM, cells[tuple(nearest)], -1)
