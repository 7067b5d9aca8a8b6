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

from ..mesh.faces import Faces


@dataclass(frozen=True)
class FoamPatch:
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


def cyclic_patches(mesh: Faces) -> list[FoamPatch]:
    """Return the pairs of patches of the faces at seams, in the order of the faces: upper, lower, upper, ..."""
    made: list[FoamPatch] = []
    shifts = mesh.shift[mesh.n_outer :].astype(np.int64)
    axes = np.argmax(shifts != 0, axis=1)
    for axis in np.unique(axes).tolist():
        both = shifts[axes == axis]
        steps = both[: len(both) // 2]
        upper, lower = (f"{'xyz'[axis]}{end}" for end in ("Max", "Min"))
        there = back = ()
        if (steps == steps[0]).all():
            period = np.pad(steps[0] * np.array(mesh.domain.extent), (0, 3 - mesh.dim))
            there, back = tuple((0 - period).tolist()), tuple(period.tolist())
        made.append(FoamPatch(upper, "cyclic", len(steps), lower, there))
        made.append(FoamPatch(lower, "cyclic", len(steps), upper, back))
    return made
