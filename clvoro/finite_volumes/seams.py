"""Faces at the seams of a periodic box, once for each of the two cells, and offsets of periodic images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..connectivity import rows_and_places, take_rows
from ..errors import ClvoroError
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces

_BASE = 64
"""Offsets of images, three numbers between -32 and 31, are digits of one integer: offsets add as integers."""


def faces_with_seams(diagram: Diagram) -> Faces:
    """Return the faces of `diagram`, those at the seams of a periodic box twice and at the end.

    For each periodic direction the faces on the upper side come first. A face that is shifted in several directions
    belongs to the first of them.

    Raises `ClvoroError` if a face exists on one side of a seam only.
    """
    faces, domain = diagram.faces, diagram.domain
    if not any(domain.periodic):
        return faces
    half, shifts = diagram.half_faces, diagram.shifts
    starts, corners = half.corners
    rows = np.flatnonzero(shifts.any(axis=1) & (np.diff(starts) > 0))
    axis = np.argmax(shifts[rows] != 0, axis=1)
    is_upper = shifts[rows, axis] > 0
    upper, axis = rows[is_upper], axis[is_upper]
    order = np.lexsort((half.keys(upper)[0], axis))
    upper, axis = upper[order], axis[order]
    lower = half.opposite[upper]
    sides = np.diff(starts)
    if 2 * len(upper) != len(rows) or (lower < 0).any() or not np.array_equal(sides[upper], sides[lower]):
        raise ClvoroError(
            "the two sides of a seam have different faces, because some are as short as round-off; use "
            "dtype='float64', or perturb generators that lie on a common circle or sphere"
        )
    kept = np.flatnonzero(~faces.shift.any(axis=1))
    first = len(kept)
    order, twin = [], [np.full(first, -1)]
    for a in range(domain.dim):
        these = axis == a
        k = int(np.count_nonzero(these))
        order += [upper[these], lower[these]]
        twin += [first + k + np.arange(k), first + np.arange(k)]
        first += 2 * k
    rows = np.concatenate(order)
    kept_starts, kept_corners = take_rows(faces.starts, faces.corners, kept)
    seam_starts, seam_corners = take_rows(starts, corners, rows)
    made = replace(
        faces,
        starts=np.concatenate([kept_starts, kept_starts[-1] + seam_starts[1:]]),
        corners=np.concatenate([kept_corners, seam_corners]),
        owner=np.concatenate([faces.owner[kept], half.owner[rows]]),
        neighbor=np.concatenate([faces.neighbor[kept], diagram.neighbors[rows]]),
        twin=np.concatenate(twin),
        shift=np.concatenate([faces.shift[kept], diagram.shifts[rows]]),
        half_face=np.concatenate([faces.half_face[kept], rows]),
    )
    return replace(made, corners=_aligned(made)) if domain.dim == 3 else made


def _aligned(faces: Faces) -> np.ndarray:
    """Return the corners of all faces; at seams the first corner of a lower face is the image of that of its twin."""
    points, starts, corners, twin = faces.points, faces.starts, faces.corners, faces.twin
    period = faces.shift * np.array(faces.domain.extent)
    lower = np.flatnonzero((twin >= 0) & (twin < np.arange(len(twin))))
    if not len(lower):
        return corners
    counts = np.diff(starts)[lower]
    face, within = rows_and_places(counts)
    places = starts[lower][face] + within
    # The twin's period leads from the lower to the upper side.
    wanted = points[corners[starts[twin[lower]]]] - period[twin[lower]]
    off = ((points[corners[places]] - wanted[face]) ** 2).sum(axis=1)
    base = np.cumsum(counts) - counts
    nearest = np.lexsort((off, face))[base] - base
    turned = np.array(corners)
    turned[places] = corners[starts[lower][face] + (within + nearest[face]) % counts[face]]
    return turned


def pack(offsets: np.ndarray) -> np.ndarray:
    """Return offsets (k, 3) as integers (k,) int64."""
    return offsets.astype(np.int64) @ _BASE ** np.arange(3)


def unpack(codes: np.ndarray) -> np.ndarray:
    """Return integers of `pack` (k,) as offsets (k, 3)."""
    half = _BASE // 2
    digits = codes + half * (1 + _BASE + _BASE**2)
    return np.stack([digits // _BASE**a % _BASE - half for a in range(3)], axis=1)
