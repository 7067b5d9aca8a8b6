"""Cells in 2D as geometries of shapely."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from .connectivity import face_ends, next_faces

if TYPE_CHECKING:
    from .diagram import Diagram


def cell_shapes(diagram: Diagram) -> np.ndarray:
    """Return each cell of a diagram in 2D as a shapely geometry, (n,); see `Diagram.to_shapely`."""
    ends, following = face_ends(diagram), next_faces(diagram)
    owner = np.repeat(np.arange(len(diagram)), np.diff(diagram.neighbor_starts))
    # One loop follows the other; each ends where the next face is its first one.
    begins = np.concatenate([[True], following[:-1] != np.arange(1, len(following))])
    loop = np.cumsum(begins) - 1
    sizes = np.bincount(loop)
    ring = np.repeat(np.arange(len(sizes)), sizes + 1)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    # The first corner comes again at the end.
    place = np.arange(len(ring)) - ring
    place = np.where(place == starts[ring + 1], starts[ring], place)
    of = owner[starts[:-1]]
    cells = np.empty(len(diagram), object)
    usable = sizes >= 3
    rings = np.full(len(sizes), None, object)
    kept = usable[ring]
    numbers = np.cumsum(usable) - 1
    rings[usable] = shapely.linearrings(diagram.vertices[ends[place[kept], 0]], indices=numbers[ring[kept]])
    lone = np.bincount(of[usable], minlength=len(diagram))[of] == 1
    cells[of[usable & lone]] = shapely.polygons(rings[usable & lone])
    several = np.flatnonzero(usable & ~lone)
    for i in np.unique(of[several]):
        cells[i] = _joined(rings[several[of[several] == i]])
    cells[[cell is None for cell in cells]] = shapely.Polygon()
    bad = ~shapely.is_valid(cells)  # outlines that touch or cross themselves within round-off
    cells[bad] = [_areas(shapely.make_valid(cell)) for cell in cells[bad]]
    return cells


def _joined(rings: np.ndarray) -> Any:
    """Return the region on the left of all `rings`."""
    outer = shapely.is_ccw(rings)
    parts = [_areas(shapely.make_valid(part)) for part in np.asarray(shapely.polygons(rings))]
    whole = shapely.union_all([p for p, o in zip(parts, outer, strict=True) if o])
    return shapely.difference(whole, shapely.union_all([p for p, o in zip(parts, outer, strict=True) if not o]))


def _areas(shape: Any) -> Any:
    """Return the parts of a shape that have an area."""
    flat = [p for p in shapely.get_parts(shape) if p.geom_type in ("Polygon", "MultiPolygon")]
    return shapely.union_all(flat) if flat else shapely.Polygon()
