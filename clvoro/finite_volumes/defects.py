"""What is wrong with 3D cells whose vertices merge, as OpenFOAM sees it: warped faces, concave cells, skewness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..connectivity import distinct, following, rows_of, slices, take_rows
from ..mesh.geometry import cross_columns, dots, lengths, loop_geometry, pyramid_sums, smaller_size

if TYPE_CHECKING:
    from .merging import MergingCells
    from .neighborhood import Neighborhood

SMALL_FACE = 1e-3
"""Faces smaller than this share of h^2 are collapsed."""
_WORSE = 0.02
"""Change of non-orthogonality, in degrees, and relative change of skewness that is accepted anywhere."""
_THIN = 1e-6
"""Least volume of a tetrahedron over that of the pyramid of its face."""
_PAIRS = 1 << 16
"""Pairs of faces that are compared at a time: their arrays fit the caches."""


@dataclass(frozen=True)
class DefectLimits:
    """What cells must satisfy after a merge.

    - `flatness`: least area of a face over the sum of the areas of its triangles about its center.
    - `concavity`: in a cell the direction from the center of a face to that of another one has at most this cosine with
      the outward normal of the first.
    - `non_orthogonality`, `skewness`: largest values of the faces that change; a face that exceeds one of them must not
      get worse.
    """

    flatness: float = 0.95
    concavity: float = -1e-5
    non_orthogonality: float = 10.0
    skewness: float = 2.0


@dataclass(frozen=True)
class Defects:
    """What is wrong with the cells at each set of vertices, (k,) each.

    - `count`, `serious`: warped faces, inverted tetrahedra, concave pairs of faces: all, and those without small faces.
    - `angle`, `skewness`: largest non-orthogonality in degrees, and skewness of the faces.
    """

    count: np.ndarray
    serious: np.ndarray
    angle: np.ndarray
    skewness: np.ndarray

    @classmethod
    def allowed(cls, k: int, limits: DefectLimits) -> Defects:
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
    """Faces and cells of a neighborhood: `seen` and `outward` are centers and areas of faces as each cell sees them.

    Vectors are columns, (3, k).
    """

    centers: np.ndarray
    areas: np.ndarray
    flatness: np.ndarray
    seen: np.ndarray
    outward: np.ndarray
    middles: np.ndarray
    volumes: np.ndarray


def find_defects(around: Neighborhood, limits: DefectLimits, targets: np.ndarray | None = None) -> Defects:
    """Return what is wrong with the cells if the vertices of each group meet in `targets` (g, 3)."""
    w = around.whole
    x = w.positions(around.corners, around.codes)
    if targets is not None:
        moved = np.flatnonzero(around.new >= 0)
        x[:, moved] = targets.T.take(around.new[moved], axis=1) + w.offsets(around.codes[moved])
    with np.errstate(invalid="ignore", divide="ignore"):
        shapes = _shapes(around, x)
        wrong = around.alive & ~(shapes.flatness >= limits.flatness)
        wrong |= _bad_tetrahedra(around, x, shapes)
        star = around.star
        arms = shapes.seen[:, star] - shapes.middles.take(around.side_cell[star], axis=1)
        low = ~(dots(shapes.outward[:, star], arms) > 0)
        wrong[around.side_star[star[low]]] = True
        large = _large(w, around.faces, shapes.areas)
        sets, part = around.set_of_face, around.set_of_cell
        count = np.bincount(sets[wrong], minlength=around.k)
        serious = np.bincount(sets[wrong & large], minlength=around.k)
        count += np.bincount(part[~(shapes.volumes > 0)], minlength=around.k)
        pairs = concave_pairs(shapes.seen, shapes.outward, around.side_starts, limits.concavity, around.side_star >= 0)
        sets = part[around.side_cell[pairs[0]]]
        large = _large(w, around.side_face[pairs], shapes.outward[:, pairs]).all(axis=0)
        count += np.bincount(sets, minlength=around.k)
        serious += np.bincount(sets[large], minlength=around.k)
        angle, skewness = _quality(around, x, shapes)
    return Defects(count, serious, angle, skewness)


def _large(whole: MergingCells, faces: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Return which of `faces` are at least as large as the limit. `areas` (3, ...) are their area vectors."""
    h = smaller_size(whole.owner[faces], whole.neighbor[faces], whole.sizes)
    return np.sqrt((areas**2).sum(axis=0)) >= SMALL_FACE * h**2


def _shapes(around: Neighborhood, x: np.ndarray) -> _Shapes:
    """Return centers and areas of the faces with corners at `x` (3, k), and of the cells."""
    f, rows = len(around.faces), np.flatnonzero(around.alive)
    centers, areas = np.full((2, 3, f), np.nan)
    centers[:, rows], areas[:, rows] = loop_geometry(x, np.append(around.starts[rows], x.shape[1]))
    about = cross_columns(x.take(around.after, axis=1) - x, centers.take(around.face, axis=1) - x)
    spread = 0.5 * np.bincount(around.face, lengths(about), f)
    seen, outward = (kept.copy() for kept in around.kept_geometry)
    side = around.side_star[around.star]
    codes, sign = around.side_code[around.star], around.side_sign[around.star]
    seen[:, around.star] = centers.take(side, axis=1) - around.whole.offsets(codes)
    outward[:, around.star] = areas.take(side, axis=1) * sign
    middles, volumes = pyramid_sums(lambda a: (seen[a], outward[a]), around.side_cell, len(around.cells))
    return _Shapes(centers, areas, lengths(areas) / spread, seen, outward, middles, volumes)


def _bad_tetrahedra(around: Neighborhood, x: np.ndarray, shapes: _Shapes) -> np.ndarray:
    """Return whether the tetrahedra of a face with the centers of its cells are not all positive, (f,) bool.

    Its triangles are those about its center, and the fan about one of its corners, whichever will do.
    """
    face, sign = around.side_star[around.star], around.side_sign[around.star]
    origins = shapes.middles.take(around.side_cell[around.star], axis=1)
    origins = origins + around.whole.offsets(around.side_code[around.star])
    starts, place = take_rows(around.starts, np.arange(x.shape[1]), face)
    side, after = rows_of(starts), following(starts)
    y = x.take(place, axis=1) - origins.take(side, axis=1)
    normal = cross_columns(y, y.take(after, axis=1)) * sign[side]
    height = shapes.centers.take(face, axis=1) - origins
    about = dots(normal, height.take(side, axis=1))
    bad = around.alive.copy()
    least = (_THIN * np.bincount(side, about, len(face)))[side]
    begin, end, corner = starts[:-1][side], starts[1:][side], np.arange(len(place))
    rows, tip = corner, 0
    # Fans about the first corner; where this will not do, about the second one, and so on.
    while len(rows):
        top = begin[rows] + tip
        flat = ~(dots(normal.take(rows, axis=1), y.take(top, axis=1)) > least[rows])
        flat &= (rows != top) & (after[rows] != top)
        bad[face[side[rows]]] = False
        bad[face[side[rows[flat]]]] = True
        tip += 1
        rows = rows[bad[face[side[rows]]] & (begin[rows] + tip < end[rows])]
    bad[face[side[~(about > 0)]]] = True
    return bad


def _quality(around: Neighborhood, x: np.ndarray, shapes: _Shapes) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest non-orthogonality, in degrees, and skewness of the faces of each set, (k,) float each."""
    w, middles = around.whole, shapes.middles
    rows = np.flatnonzero(around.alive)
    faces = around.faces[rows]
    center, area = shapes.centers.take(rows, axis=1), shapes.areas.take(rows, axis=1)
    area = area / lengths(area)
    own, other = (middles.take(cells, axis=1) for cells in around.cells_of_face[rows].T)
    inner = w.neighbor[faces] >= 0
    other = other + w.offsets(w.face_codes[faces])
    to_face = center - own
    height = dots(area, to_face)
    d = np.where(inner, other - own, height * area)
    across = dots(area, d)
    length = lengths(d)
    angle = np.degrees(np.arccos(np.clip(across / length, -1, 1)))
    off = to_face - (height / across) * d
    size = lengths(off)
    along = off / np.maximum(size, 1e-300)
    starts, place = take_rows(around.starts, np.arange(len(around.corners)), rows)
    row = rows_of(starts)
    reach = np.where(inner, 0.2, 0.4) * length
    arms = x.take(place, axis=1) - center.take(row, axis=1)
    extent = np.abs(dots(along.take(row, axis=1), arms))
    reach = np.maximum(reach, np.maximum.reduceat(extent, starts[:-1]))
    worst = np.zeros((2, around.k))
    np.maximum.at(worst[0], around.set_of_face[rows], angle)
    np.maximum.at(worst[1], around.set_of_face[rows], size / reach)
    return worst[0], worst[1]


def concave_pairs(
    centers: np.ndarray, areas: np.ndarray, starts: np.ndarray, limit: float, changed: np.ndarray
) -> np.ndarray:
    """Return the pairs of faces of a cell that checkMesh takes for concave, (2, p) int.

    Checked is the cosine of the outward normal of a face and the direction from its center to that of another face.

    - `centers`, `areas` (3, k) float: of each face as seen from a cell; areas point outward.
    - `starts` (n + 1,) int: rows of the faces of each cell.
    - `limit`: the largest cosine.
    - `changed` (k,) bool: one face of a pair is changed.
    """
    found = [np.zeros((2, 0), np.int64)]
    normals = areas / np.maximum(lengths(areas), 1e-300)
    counts = np.diff(starts)
    wide = -(counts // -4) * 4  # cells are compared together that have about as many faces
    for k in distinct(wide[wide > 0]).tolist():
        of_size = np.flatnonzero(wide == k)
        for part in slices(len(of_size), max(_PAIRS // (k * k), 1)):
            rows = of_size[part]
            within = np.arange(k) < counts[rows, None]
            places = starts[rows, None] + np.where(within, np.arange(k), 0)
            c, s = centers.take(places, axis=1), normals.take(places, axis=1)
            c -= c.mean(axis=2, keepdims=True)
            s[:, ~within] = np.nan
            own = (s * c).sum(axis=0)
            # Few pairs are this near to a plane: only these are computed.
            reach = 2 * np.sqrt((c * c).sum(axis=0).max(axis=1))
            own += min(limit, -1e-12) * reach[:, None]
            c[:, ~within] = np.nan
            products = np.matmul(s.transpose(1, 2, 0), c.transpose(1, 0, 2))
            pairs = np.flatnonzero(products > own[:, :, None])
            first = pairs // k
            found.append(np.stack([places.ravel()[first], places[first // k, pairs % k]]))
    i, j = np.concatenate(found, axis=1)
    near = (i != j) & (changed[i] | changed[j])
    i, j = i[near], j[near]
    line = centers[:, j] - centers[:, i]
    steep = dots(normals[:, i], line) > limit * lengths(line)
    return np.stack([i[steep], j[steep]])
