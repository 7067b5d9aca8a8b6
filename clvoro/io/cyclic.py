"""Cyclic patches of OpenFOAM: the faces at the seams of a periodic box, once for each of the two cells.

There is one pair of patches for each periodic direction. Cells are not cut at the seams, so some faces lie between a
cell and an image that is shifted in two or three directions. They are in the pair of the first of these directions.
The vector from a face to the one across then differs within a patch. OpenFOAM of openfoam.com (tested: v1912) accepts
that from a patch with the transform `noOrdering`, whose faces it takes in the order of the file; `translational`
demands one vector for all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import ClvoroError
from ..mesh.connectivity import FaceTopology, face_corners, face_keys, face_owners, take_rows
from ..mesh.diagram import Diagram


@dataclass(frozen=True)
class Patch:
    """A part of the boundary.

    Attributes
    ----------
    name, kind : str
    size : int
        Number of faces.
    across : str
        Of a cyclic patch: name of the patch across the seam. Its faces are the images of those of this one, in the same
        order, and each begins with the image of the same corner.
    separation : tuple of float
        Of a cyclic patch: vector from its faces to those across; empty if it differs from face to face.
    """

    name: str
    kind: str
    size: int
    across: str = ""
    separation: tuple[float, ...] = ()


@dataclass(frozen=True)
class CyclicPair:
    """The faces across one periodic direction: those on the upper side, then those on the lower side.

    Attributes
    ----------
    axis : int
    shifts : (k, 3) float
        Vector from each face on the lower side to its image on the upper side.
    """

    axis: int
    shifts: np.ndarray

    @property
    def size(self) -> int:
        """Number of faces on each side."""
        return len(self.shifts)

    def patches(self) -> list[Patch]:
        """Return both patches."""
        upper, lower = (f"{'xyz'[self.axis]}{end}" for end in ("Max", "Min"))
        shift = self.shifts[0]
        there = back = ()
        if (self.shifts == shift).all():
            there, back = tuple((0 - shift).tolist()), tuple(shift.tolist())
        return [
            Patch(upper, "cyclic", self.size, lower, there),
            Patch(lower, "cyclic", self.size, upper, back),
        ]

    def align(
        self, points: np.ndarray, starts: np.ndarray, corners: np.ndarray, first: int
    ) -> np.ndarray:
        """Return the corners of all faces; the first corner of each lower face is the image of that of the upper one.

        Parameters
        ----------
        points : (v, d) float
        starts, corners : int
            Corners of each face as ragged rows.
        first : int
            Number of the first face of the pair.
        """
        upper = first + np.arange(self.size)
        begin, end = starts[upper[0] + self.size], starts[upper[-1] + self.size + 1]
        part = corners[begin:end]
        counts = np.diff(starts)[upper]
        face, base = np.repeat(np.arange(self.size), counts), np.cumsum(counts) - counts
        wanted = points[corners[starts[upper]]] - self.shifts[:, : points.shape[1]]
        off = ((points[part] - wanted[face]) ** 2).sum(axis=1)
        nearest = np.lexsort((off, face))[base]
        within = np.arange(len(part)) - base[face]
        turned = corners.copy()
        turned[begin:end] = part[base[face] + (within + (nearest - base)[face]) % counts[face]]
        return turned


def add_cyclic_faces(
    diagram: Diagram, faces: FaceTopology
) -> tuple[FaceTopology, list[CyclicPair]]:
    """Return `faces` with those across seams at the end: pair by pair, the upper side first.

    Raises
    ------
    ClvoroError
        If a face exists on one side of a seam only.
    """
    dim, shifts = diagram.domain.dim, diagram.shifts.astype(np.int64)
    starts, corners = face_corners(diagram)
    rows = np.flatnonzero(shifts.any(axis=1) & (np.diff(starts) > 0))
    here, there = face_keys(diagram, rows)
    axis = np.argmax(shifts[rows] != 0, axis=1)
    is_upper = shifts[rows, axis] > 0
    upper = np.flatnonzero(is_upper)[np.lexsort((here[is_upper], axis[is_upper]))]
    lower = np.flatnonzero(~is_upper)[np.lexsort((there[~is_upper], axis[~is_upper]))]
    sides = np.diff(starts)[rows]
    if not (
        np.array_equal(here[upper], there[lower]) and np.array_equal(sides[upper], sides[lower])
    ):
        raise ClvoroError(
            "the two sides of a seam have different faces, because some are as short as round-off; use dtype='float64'"
        )
    pairs, order = [], []
    for a in np.unique(axis[upper]).tolist():
        these = axis[upper] == a
        period = shifts[rows[upper[these]]] * np.array(diagram.domain.extent)
        pairs.append(CyclicPair(a, np.pad(period, ((0, 0), (0, 3 - dim)))))
        order += [upper[these], lower[these]]
    rows = rows[np.concatenate(order)] if order else rows[:0]
    kept = np.flatnonzero(~shifts[faces.rows].any(axis=1))
    kept_starts, kept_corners = take_rows(faces.starts, faces.corners, kept)
    seam_starts, seam_corners = take_rows(starts, corners, rows)
    return FaceTopology(
        np.concatenate([faces.owner[kept], face_owners(diagram)[rows]]),
        np.concatenate([faces.neighbor[kept], np.full(len(rows), -1, np.int32)]),
        np.concatenate([faces.rows[kept], rows]),
        np.concatenate([kept_starts, kept_starts[-1] + seam_starts[1:]]),
        np.concatenate([kept_corners, seam_corners]),
        np.concatenate([faces.flipped[kept], np.zeros(len(rows), bool)]),
    ), pairs
