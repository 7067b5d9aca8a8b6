"""Fill narrow water, drop small land, and thin what is left."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import shapely

from ...arguments import check_number, format_point
from ...errors import InputError, InputTypeError
from .narrow import SCALES, narrow_water, small_islands, small_land
from .thinning import large_pieces, thinned
from .triangles import Triangles, divided_boundary

if TYPE_CHECKING:
    from ..polygon import Polygon

Sizes = Callable[[np.ndarray], np.ndarray]


def simplify(domain: Polygon, size: object, tolerance: float) -> tuple[list[list[np.ndarray]], dict[str, list[int]]]:
    """Return the rings of the simplified domain, piece by piece, and the names of edges; see `Polygon.simplified`."""
    tolerance = check_number("tolerance", tolerance, least=0)
    if tolerance > 0.5:
        raise InputError(f"tolerance is {tolerance:g}, expected a share of the size from 0 to 0.5")
    boundary = divided_boundary(domain, as_sizes(domain, size))
    triangles = Triangles(*boundary, lambda x: shapely.contains_xy(domain.geometry, *x.T))
    turned = np.zeros(0, bool)
    for find, scales in (
        (narrow_water, SCALES[:1]),
        (small_land, SCALES[:1]),
        (narrow_water, SCALES[1:]),
        (small_land, SCALES[1:]),
    ):
        triangles = triangles.rebuilt() if turned.any() else triangles
        turned = np.any([find(triangles, scale) for scale in scales], axis=0)
        triangles.water ^= turned
    triangles.water |= small_islands(triangles)
    pieces = large_pieces(triangles)
    if not pieces:
        raise InputError(
            "the domain is narrower than the size everywhere, and nothing is left of it; choose a smaller size"
        )
    return thinned(domain, pieces, tolerance)


def as_sizes(domain: Polygon, size: object) -> Sizes:
    """Return a function of points (n, 2), of which the nearest ones in the domain count."""
    if not callable(size):
        value = check_number("size", size, above=0)
        return lambda points: np.full(len(points), value)

    def sizes(points: np.ndarray) -> np.ndarray:
        found = np.asarray(size(domain.nearest(points)), float)
        if found.shape != (len(points),):
            raise InputTypeError(
                f"size returned an array of shape {found.shape} for {len(points)} points, expected ({len(points)},)"
            )
        if not ((found > 0) & (found < math.inf)).all():
            row = int(np.argmin((found > 0) & (found < math.inf)))
            raise InputError(f"size is {found[row]:g} at {format_point(points[row])}, expected a positive length")
        return found

    return sizes
