"""Meshes of too many cells for polygons: images in which each pixel has the color of the cell at its center."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast
from weakref import WeakKeyDictionary

import numpy as np
import scipy
from matplotlib.axes import Axes

from ..mesh.diagram import Diagram
from .colors import Paint

MOST_POLYGONS = 30_000
"""With more cells in a picture, it is an image."""
PER_INCH = 200
"""Pixels of an image per inch of its axes."""
_RIM = 3
"""Pixels outside of the domain, that far from it, have the color of the nearest pixel inside."""

Positions = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

_last: WeakKeyDictionary[Diagram, tuple[np.ndarray, ...]] = WeakKeyDictionary()
"""For the last image of each diagram: which pixels show the mesh, their positions, and their cells. A report shows the
same part in several colors, so the cells are found once."""


def add_image(ax: Any, diagram: Diagram, paint: Paint, positions: Positions | None = None) -> Any:
    """Add an image of the mesh that fills `ax`, whose limits are set, and return it.

    `positions` returns for places (k, 2) in the picture which of them show the mesh, (k,) bool, and where those are in
    the domain, (j, d). By default a place is its own position.
    """
    lower, upper = np.transpose([ax.get_xlim(), ax.get_ylim()])
    extent = upper - lower
    box = ax.get_position()
    inches = ax.figure.get_size_inches() * (box.width, box.height)
    counts = np.maximum(np.ceil(PER_INCH * min(inches / extent) * extent), 2).astype(int)
    x, y = (lower[a] + extent[a] * (np.arange(counts[a]) + 0.5) / counts[a] for a in (0, 1))
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside, at = (np.ones(len(places), bool), places) if positions is None else positions(places)
    known = _last.get(diagram)
    if known is None or not all(map(np.array_equal, known, (inside, at))):
        cells = np.full(len(places), -1)
        cells[inside] = diagram.locate(at)
        known = _last[diagram] = inside, at, _with_rim(cells.reshape(len(y), len(x)))
    # -1 leads to the last place.
    shown = np.append(paint.finite, np.nan)[known[2]]
    # The method of plain axes: those of a map would look for its projection.
    return Axes.imshow(
        ax,
        np.ma.masked_invalid(shown),
        extent=(lower[0], upper[0], lower[1], upper[1]),
        origin="lower",
        # Colors are interpolated: between classes there are no further ones.
        interpolation_stage="rgba",
        cmap=paint.scheme.color_map,
        norm=paint.norm,
    )


def _with_rim(cells: np.ndarray) -> np.ndarray:
    """Return the cells of pixels, -1 where there is none, with the nearest cell at pixels just outside of the mesh."""
    outside = cells < 0
    if not outside.any() or outside.all():
        return cells
    distances, nearest = cast(
        "tuple[np.ndarray, np.ndarray]", scipy.ndimage.distance_transform_edt(outside, return_indices=True)
    )
    return np.where(distances <= _RIM, cells[tuple(nearest)], -1)
