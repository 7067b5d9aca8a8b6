"""A diagram as OpenFOAM describes meshes: points, faces between cells, and the boundary as patches.

In 2D the cells become prisms, one layer of them, between two patches of type `empty`. The seams of a periodic box
become pairs of patches of type `cyclic`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..errors import ClvoroError, InputError
from ..geometry.boundary_names import BoundaryNames, Walls
from ..geometry.box import Domain
from ..mesh.connectivity import (
    Faces,
    cell_corners,
    face_corners,
    face_keys,
    face_owners,
    faces_once,
    take_rows,
)
from ..mesh.results import Diagram


@dataclass(frozen=True)
class Patch:
    """A part of the boundary.

    Attributes
    ----------
    name, kind : str
    size : int
        Faces.
    across : str
        Of a cyclic patch: name of the one on the other side of the seam, whose faces are the images of its own, in the
        same order and each from the same corner on.
    separation : tuple of float
        From its faces to those.
    """

    name: str
    kind: str
    size: int
    across: str = ""
    separation: tuple[float, ...] = ()


@dataclass(frozen=True)
class PolyMesh:
    """A mesh as OpenFOAM describes it.

    Attributes
    ----------
    points : (v, 3) float
    starts : (f + 1,) int, corners : int
        Corners of each face, counter-clockwise as seen from its neighbor or from outside.
    owner : (f,) int
        Cell behind each face.
    neighbor : (inner,) int
        Cell in front of each inner face; owner < neighbor. Inner faces come first, in upper-triangular
        order: by owner, then by neighbor.
    patches : list of Patch
        One after the other behind the inner faces.
    """

    points: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    owner: np.ndarray
    neighbor: np.ndarray
    patches: list[Patch]


def poly_mesh(diagram: Diagram, patches: Mapping[str, Walls] | None = None) -> PolyMesh:
    """Describe `diagram` for OpenFOAM; faces without measure and points without a face are left out.

    The patches are the boundaries that the domain names; in 2D also `back` and `front`, at z = 0 and at z = the mean
    size of a cell. Cells of a periodic box are not cut at its
    seams: the faces there are in cyclic patches, `xMin` and `xMax`, and those towards images across two or three seams
    in `xMin-yMin` and `xMax-yMax`, and so on.

    Parameters
    ----------
    patches : mapping, optional
        Names of patches, each with its walls: numbers, names of the domain, or a sequence of them. Walls that are not
        mentioned keep the name that the domain gives them.

    Raises
    ------
    InputError, InputTypeError
        If `patches` names walls that do not exist, or a wall twice; or for a cell with an island in it, as a face of
        OpenFOAM has no hole.
    """
    domain, parts = diagram.domain, _parts(diagram.domain, patches)
    faces = _by_group(faces_once(diagram), parts.index)
    walls = -1 - faces.neighbor[faces.inner :]
    counts = np.bincount(parts.index[walls], minlength=len(parts.names))
    made = [Patch(name, "patch", int(k)) for name, k in zip(parts.names, counts, strict=True)]
    seams = []
    if any(domain.periodic):
        faces, seams = _with_seams(diagram, faces)
    owner, neighbor = faces.owner, faces.neighbor[: faces.inner]
    if domain.dim == 2:
        points, starts, corners = _extruded(diagram, faces.corners, domain)
    else:
        points, starts, corners = diagram.vertices, faces.starts, faces.corners
    first = len(owner) - 2 * sum(seam.size for seam in seams)
    for seam in seams:
        corners = _begin_alike(points, starts, corners, first, seam)
        made += seam.patches()
        first += 2 * seam.size
    if domain.dim == 2:
        owner = np.concatenate([owner, *2 * [np.arange(len(diagram))]])
        made += [Patch("back", "empty", len(diagram)), Patch("front", "empty", len(diagram))]
    used, corners = np.unique(corners, return_inverse=True)
    return PolyMesh(points[used], starts, corners.ravel(), owner, neighbor, made)


@dataclass(frozen=True)
class _Seam:
    """The faces between cells of the box and images `step` periods away, from both sides.

    Attributes
    ----------
    step : (d,) int
    size : int
        Faces on each side.
    period : (3,) float
        From the faces of the second side to those of the first, which are towards the images.
    """

    step: np.ndarray
    size: int
    period: np.ndarray

    def patches(self) -> list[Patch]:
        """Return both sides."""
        names = [self._name(self.step), self._name(-self.step)]
        there = tuple((0 - self.period).tolist())
        return [
            Patch(names[0], "cyclic", self.size, names[1], there),
            Patch(names[1], "cyclic", self.size, names[0], tuple(self.period.tolist())),
        ]

    @staticmethod
    def _name(step: np.ndarray) -> str:
        ends = ("Min", "", "Max")
        return "-".join(
            f"{axis}{ends[s + 1]}" for axis, s in zip("xyz", step.tolist(), strict=False) if s
        )


def _with_seams(diagram: Diagram, faces: Faces) -> tuple[Faces, list[_Seam]]:
    """Return the faces with those across seams at the end, as each of the two cells sees them."""
    dim, extent = diagram.domain.dim, np.array(diagram.domain.extent)
    shifts = diagram.shifts.astype(np.int64)
    plain = ~shifts[faces.rows].any(axis=1)
    starts, corners = face_corners(diagram)
    rows = np.flatnonzero(shifts.any(axis=1) & (np.diff(starts) > 0))
    here, there = face_keys(diagram, rows)
    codes = (shifts[rows] + 1) @ 3 ** np.arange(dim)
    away = 2 * codes > 3**dim - 1
    first = np.flatnonzero(away)[np.lexsort((here[away], codes[away]))]
    second = np.flatnonzero(~away)[np.lexsort((there[~away], -codes[~away]))]
    sides = np.diff(starts)[rows]
    if not (
        np.array_equal(here[first], there[second]) and np.array_equal(sides[first], sides[second])
    ):
        raise ClvoroError(
            "the two sides of a seam have different faces, as rounding makes them of faces that are hardly there; use "
            "dtype='float64'"
        )
    seams, order = [], []
    for code in np.unique(codes[first]):
        these = codes[first] == code
        step = shifts[rows[first[these][0]]]
        period = np.pad(step * extent, (0, 3 - dim))
        seams.append(_Seam(step, int(these.sum()), period))
        order += [first[these], second[these]]
    rows = rows[np.concatenate(order)] if order else rows[:0]
    kept = np.flatnonzero(plain)
    kept_starts, kept_corners = take_rows(faces.starts, faces.corners, kept)
    seam_starts, seam_corners = take_rows(starts, corners, rows)
    return Faces(
        np.concatenate([faces.owner[kept], face_owners(diagram)[rows]]),
        np.concatenate([faces.neighbor[kept], np.full(len(rows), -1, np.int32)]),
        np.concatenate([faces.rows[kept], rows]),
        np.concatenate([kept_starts, kept_starts[-1] + seam_starts[1:]]),
        np.concatenate([kept_corners, seam_corners]),
    ), seams


def _begin_alike(
    points: np.ndarray, starts: np.ndarray, corners: np.ndarray, first: int, seam: _Seam
) -> np.ndarray:
    """Return the corners, such that faces on the second side of a seam begin with the image of the first one's corner.

    `first` is the number of the seam's first face.
    """
    k = first + np.arange(seam.size)
    begin, end = starts[k[0] + seam.size], starts[k[-1] + seam.size + 1]
    part = corners[begin:end]
    sizes = np.diff(starts)[k]
    face = np.repeat(np.arange(seam.size), sizes)
    wanted = _space(points)[corners[starts[k]]] - seam.period
    off = ((_space(points)[part] - wanted[face]) ** 2).sum(axis=1)
    nearest = np.lexsort((off, face))[np.concatenate([[0], np.cumsum(sizes)[:-1]])]
    within = np.arange(len(part)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    turned = corners.copy()
    base = np.repeat(np.cumsum(sizes) - sizes, sizes)
    turn = np.repeat(nearest, sizes) - base
    turned[begin:end] = part[base + (within + turn) % np.repeat(sizes, sizes)]
    return turned


def _space(points: np.ndarray) -> np.ndarray:
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def _parts(domain: Domain, patches: Mapping[str, Walls] | None) -> BoundaryNames:
    """Return the parts of the boundary that become patches."""
    parts = domain.boundaries
    return parts if patches is None else parts.renamed("patches", patches)


def _by_group(faces: Faces, groups: np.ndarray) -> Faces:
    """Return `faces` with those on the boundary in the order of their groups."""
    outer = np.argsort(groups[-1 - faces.neighbor[faces.inner :]], kind="stable") + faces.inner
    if (np.diff(outer) > 0).all():
        return faces
    order = np.concatenate([np.arange(faces.inner), outer])
    starts, corners = take_rows(faces.starts, faces.corners, order)
    return Faces(faces.owner[order], faces.neighbor[order], faces.rows[order], starts, corners)


def _extruded(
    diagram: Diagram, sides: np.ndarray, box: Domain
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, starts and corners of the prisms' sides, then their bottoms, then their tops."""
    flat, v = diagram.vertices, len(diagram.vertices)
    thickness = float(np.sqrt(box.measure / len(diagram)))
    points = np.concatenate([np.pad(flat, ((0, 0), (0, 1))), np.pad(flat, ((0, 0), (0, 1)))])
    points[v:, 2] = thickness
    a, b = sides.reshape(-1, 2).T
    walls = np.stack([a, b, b + v, a + v], axis=1)
    starts, corners = cell_corners(diagram)
    everyone = np.arange(len(diagram))
    key = np.sort(np.repeat(everyone, np.diff(starts)) * v + corners)
    twice = key[1:][np.diff(key) == 0] // max(v, 1)
    if twice.size:
        raise InputError(
            f"cell {twice[0]} ({len(np.unique(twice))} in all) goes around a part of the boundary or touches itself, "
            "and faces of OpenFOAM's have no holes; use smaller cells there, leave out the hole, or save as .vtu"
        )
    _, bottoms = take_rows(starts, corners, everyone, np.ones(len(diagram), bool))
    lengths = np.concatenate([np.full(len(walls), 4), np.diff(starts), np.diff(starts)])
    return (
        points,
        np.concatenate([[0], np.cumsum(lengths)]),
        np.concatenate([walls.ravel(), bottoms, corners + v]),
    )
