"""What is wrong with 3D cells whose vertices merge, as OpenFOAM sees it: warped faces, concave cells, skewness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..mesh.connectivity import take_rows
from .geometry import cell_geometry, face_geometry, lengths, smaller_size
from .seams import unpack

if TYPE_CHECKING:
    from .neighborhood import Neighborhood

_WORSE = 0.02
"""Change of non-orthogonality, in degrees, and relative change of skewness that is accepted anywhere."""
_THIN = 1e-6
"""Least volume of a tetrahedron over that of the pyramid of its face."""


@dataclass(frozen=True)
class Limits:
    """What cells must satisfy after a merge.

    Attributes
    ----------
    flatness : float
        Least area of a face over the sum of the areas of its triangles about its center.
    concavity : float
        In a cell the direction from the center of a face to that of another one has at most this cosine with the
        outward normal of the first.
    non_orthogonality, skewness : float
        Largest values of the faces that change; a face that exceeds one of them must not get worse.
    """

    flatness: float = 0.95
    concavity: float = -1e-5
    non_orthogonality: float = 10.0
    skewness: float = 2.0


@dataclass(frozen=True)
class Defects:
    """What is wrong with the cells at each set of vertices, (k,) each.

    Attributes
    ----------
    count, serious : int
        Warped faces, inverted tetrahedra, concave pairs of faces: all, and those without small faces.
    angle, skewness : float
        Largest non-orthogonality in degrees, and skewness of the faces.
    """

    count: np.ndarray
    serious: np.ndarray
    angle: np.ndarray
    skewness: np.ndarray

    @classmethod
    def allowed(cls, k: int, limits: Limits) -> Defects:
        """Return what is allowed anywhere."""
        none = np.zeros(k, np.int64)
        return cls(none, none, np.full(k, limits.non_orthogonality), np.full(k, limits.skewness))

    def worsened(self, allowed: Defects) -> Defects:
        """Return the defects that are there already, a little increased, or those that are allowed anywhere."""
        angle = np.maximum(self.angle + _WORSE, allowed.angle)
        skewness = np.maximum(self.skewness * (1 + _WORSE), allowed.skewness)
        return Defects(self.count, self.serious, angle, skewness)

    def __le__(self, other: Defects) -> np.ndarray:
        return (
            (self.count <= other.count)
            & (self.serious <= other.serious)
            & (self.angle <= other.angle)
            & (self.skewness <= other.skewness)
        )


@dataclass(frozen=True)
class _Shapes:
    """Faces and cells of a neighborhood: `seen` and `outward` are centers and areas of faces as each cell sees them."""

    centers: np.ndarray
    areas: np.ndarray
    flatness: np.ndarray
    seen: np.ndarray
    outward: np.ndarray
    middles: np.ndarray
    volumes: np.ndarray


def find_defects(
    around: Neighborhood, limits: Limits, targets: np.ndarray | None = None
) -> Defects:
    """Return what is wrong with the cells if the vertices of each group meet in `targets` (g, 3)."""
    w = around.whole
    x = w.positions(around.corners, around.codes)
    if targets is not None:
        moved = np.flatnonzero(around.new >= 0)
        x[moved] = targets[around.new[moved]] + unpack(around.codes[moved]) * w.extent
    with np.errstate(invalid="ignore", divide="ignore"):
        shapes = _shapes(around, x)
        h = smaller_size(w.owner[around.faces], w.neighbor[around.faces], w.sizes)
        large = lengths(shapes.areas) >= w.small * h**2
        changed = around.alive & (around.set_of_face >= 0)
        wrong = changed & ~(shapes.flatness >= limits.flatness)
        wrong |= changed & _bad_tetrahedra(around, x, shapes)
        arms = shapes.seen - shapes.middles.take(around.side_cell, axis=0)
        low = ~(np.einsum("ij,ij->i", shapes.outward, arms) > 0)
        wrong[around.side_face[low]] |= changed[around.side_face[low]]
        sets = around.set_of_face
        count = np.bincount(sets[wrong], minlength=around.k)
        serious = np.bincount(sets[wrong & large], minlength=around.k)
        part = around.set_of_cell
        count += np.bincount(part[~(shapes.volumes > 0)], minlength=around.k)
        pairs = concave_pairs(
            shapes.seen, shapes.outward, around.side_cell, len(around.cells), limits.concavity,
            changed[around.side_face], large[around.side_face],
        )  # fmt: skip
        count += np.bincount(part, pairs[0], around.k).astype(np.int64)
        serious += np.bincount(part, pairs[1], around.k).astype(np.int64)
        angle, skewness = _quality(around, x, shapes)
    return Defects(count, serious, angle, skewness)


def _shapes(around: Neighborhood, x: np.ndarray) -> _Shapes:
    """Return centers and areas of the faces with corners at `x` (k, 3), and of the cells."""
    f, rows = len(around.faces), np.flatnonzero(around.alive)
    starts = np.append(around.starts[rows], len(x))
    centers, areas = np.full((f, 3), np.nan), np.full((f, 3), np.nan)
    centers[rows], areas[rows] = face_geometry(x, starts, np.arange(len(x)))
    about = np.cross(x.take(around.after, axis=0) - x, centers.take(around.face, axis=0) - x)
    spread = 0.5 * np.bincount(around.face, lengths(about), f)
    side = around.side_face
    seen = centers.take(side, axis=0) - unpack(around.side_code) * around.whole.extent
    outward = areas.take(side, axis=0) * around.side_sign[:, None]
    none = np.zeros(0, np.int64)
    middles, volumes = cell_geometry(seen, outward, around.side_cell, none, len(around.cells))
    flatness = lengths(areas) / spread
    return _Shapes(centers, areas, flatness, seen, outward, middles, volumes)


def _bad_tetrahedra(around: Neighborhood, x: np.ndarray, shapes: _Shapes) -> np.ndarray:
    """Return whether the tetrahedra of a face with the centers of its cells are not all positive, (f,) bool.

    Its triangles are those about its center, and the fan about one of its corners, whichever will do.
    """
    rows = np.flatnonzero(around.set_of_face[around.side_face] >= 0)
    face = around.side_face[rows]
    origins = shapes.middles[around.side_cell[rows]]
    origins = origins + unpack(around.side_code[rows]) * around.whole.extent
    counts = np.diff(around.starts)
    fans = np.zeros(len(around.corners))
    bad = np.zeros(len(around.faces), bool)
    for n in np.unique(counts[face]).tolist():
        these = counts[face] == n
        f, sign = face[these], around.side_sign[rows[these], None]
        places = around.starts[f][:, None] + np.arange(n)
        y = x[places] - origins[these][:, None]
        normal = np.cross(y, np.roll(y, -1, axis=1))
        about = np.einsum("mnk,mk->mn", normal, shapes.centers[f] - origins[these]) * sign
        bad[f[~(about > 0).all(axis=1)]] = True
        volume = np.einsum("mbk,mik->mbi", y, normal) * sign[:, :, None]
        volume[:, np.arange(n), np.arange(n)] = np.inf
        volume[:, np.arange(n), np.arange(n) - 1] = np.inf
        least = volume.min(axis=2) > _THIN * about.sum(axis=1)[:, None]
        np.add.at(fans, places[~least], 1)
    some = np.bincount(around.face[fans == 0], minlength=len(around.faces)) > 0
    return bad | ~(some | ~around.alive)


def _quality(around: Neighborhood, x: np.ndarray, shapes: _Shapes) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest non-orthogonality, in degrees, and skewness of the faces of each set, (k,) float each."""
    w, middles = around.whole, shapes.middles
    rows = np.flatnonzero(around.alive & (around.set_of_face >= 0))
    faces = around.faces[rows]
    center, area = shapes.centers[rows], shapes.areas[rows]
    area = area / np.linalg.norm(area, axis=1, keepdims=True)
    own = middles[around.local(w.owner[faces])]
    inner = w.neighbor[faces] >= 0
    other = middles[around.local(np.maximum(w.neighbor[faces], 0))]
    other += unpack(w.face_codes[faces]) * w.extent
    to_face = center - own
    height = np.einsum("ij,ij->i", area, to_face)
    d = np.where(inner[:, None], other - own, height[:, None] * area)
    across = np.einsum("ij,ij->i", area, d)
    length = lengths(d)
    angle = np.degrees(np.arccos(np.clip(across / length, -1, 1)))
    off = to_face - (height / across)[:, None] * d
    size = lengths(off)
    along = off / np.maximum(size, 1e-300)[:, None]
    starts, place = take_rows(around.starts, np.arange(len(around.corners)), rows)
    row = np.repeat(np.arange(len(rows)), np.diff(starts))
    reach = np.where(inner, 0.2, 0.4) * length
    np.maximum.at(reach, row, np.abs(np.einsum("ij,ij->i", along[row], x[place] - center[row])))
    worst = np.zeros((2, around.k))
    np.maximum.at(worst[0], around.set_of_face[rows], angle)
    np.maximum.at(worst[1], around.set_of_face[rows], size / reach)
    return worst[0], worst[1]


def concave_pairs(
    centers: np.ndarray,
    areas: np.ndarray,
    cell: np.ndarray,
    cells: int,
    limit: float,
    changed: np.ndarray,
    large: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each cell the number of pairs of faces that checkMesh takes for concave, and of large ones, (n,) int.

    Checked is the cosine of the outward normal of a face and the direction from its center to that of another face.

    Parameters
    ----------
    centers, areas : (k, 3) float
        Of each face as seen from a cell; areas point outward.
    cell : (k,) int
    limit : float
        The largest cosine.
    changed, large : (k,) bool
        One face of a pair is changed; both are large.
    """
    pairs, large_pairs = np.zeros(cells, np.int64), np.zeros(cells, np.int64)
    order = np.argsort(cell, kind="stable")
    counts = np.bincount(cell, minlength=cells)
    starts = np.concatenate([[0], np.cumsum(counts)])
    for k in np.unique(counts).tolist():
        rows = np.flatnonzero(counts == k)
        places = order[starts[rows][:, None] + np.arange(k)]
        c, s, new = centers[places], areas[places], changed[places]
        c = c - c.mean(axis=1, keepdims=True)
        s = s / np.linalg.norm(s, axis=2, keepdims=True)
        height = s @ c.transpose(0, 2, 1) - np.einsum("mij,mij->mi", s, c)[:, :, None]
        squares = np.einsum("mij,mij->mi", c, c)
        far = squares[:, :, None] + squares[:, None, :] - 2 * c @ c.transpose(0, 2, 1)
        steep = height > limit * np.sqrt(np.maximum(far, 0))
        steep &= new[:, :, None] | new[:, None, :]
        steep[:, np.arange(k), np.arange(k)] = False
        m, i, j = np.nonzero(steep)
        pairs += np.bincount(rows[m], minlength=cells)
        both = large[places[m, i]] & large[places[m, j]]
        large_pairs += np.bincount(rows[m[both]], minlength=cells)
    return pairs, large_pairs
