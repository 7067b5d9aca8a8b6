"""A diagram on the device: what the stages that make one hand on to all others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pyopencl.array as cla

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np

    from .trim import Trimmed

EXACT_SHARE, ROUGH_SHARE = 0.01, 0.5
"""Share of a cell that rounding may make uncertain: in a diagram, and on a run's way, where all will move again."""
# FULL and COINCIDE are bits of common/face_rows.h, whose other one means cells that collapsed.
FULL, COINCIDE, DOUBT, NARROW = 1, 2, 8, 16


@dataclass(frozen=True)
class Tessellation:
    """A Voronoi diagram on the device: normalised coordinates, vectors relative to the generator of the row.

    Attributes
    ----------
    n : int
    points : (n, d) real
    starts : (n + 1,) int32
    neighbours : (m,) int32
        A generator, or ``-1 - wall``; counter-clockwise in 2D.
    face_measures : (m,) real, or single
    face_centroids : (m, d) real, or single
        Relative to the generator; see `Engine.face` for the precision.
    volumes : (n,) real
    offsets : (n, d) real
        Centroid minus generator: the Lloyd displacement.
    covariances : (n, d (d + 1) / 2) real
        Second moments about the centroid per unit volume: xx, xy, yy in 2D.
    outlines : tuple of arrays
        Of a diagram trimmed by a boundary what kernels take as OUTLINE_ARGS (common/outline.h); else empty.
    trimmed : Trimmed, optional
        How such a diagram came to be.
    narrow : bool
        Whether faces (in 3D) may be as narrow as their vertices round: of those, what has no loop in `Loops` is none.
    """

    n: int
    points: cla.Array
    starts: cla.Array
    neighbours: cla.Array
    face_measures: cla.Array
    face_centroids: cla.Array
    volumes: cla.Array
    offsets: cla.Array
    covariances: cla.Array
    outlines: tuple[cla.Array, ...] = ()
    trimmed: Trimmed | None = None
    narrow: bool = False


def restored(
    points: cla.Array, arrays: Mapping[str, cla.Array], saved: Mapping[str, np.ndarray]
) -> Tessellation:
    """Return the diagram of `points` of which `arrays` are to hold what was `saved`, by the names of its fields.

    Arrays may have more rows, which are filled with zeros.
    """
    for name, array in arrays.items():
        known = len(saved[name])
        array[:known].set(saved[name])
        if len(array) > known:
            array[known:].fill(0)
    return Tessellation(n=len(points), points=points, **arrays)
