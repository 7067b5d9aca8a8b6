"""Decomposed cases of OpenFOAM: the mesh of each processor, as `decomposePar` makes it.

A processor has its cells, and the faces between them, in the order of the whole mesh, which is OpenFOAM's order. A face
between two processors is on a patch of each of them. Both patches have their faces in the order of the whole mesh; on
the processor that has the neighbor cell the faces are turned. Faces at a seam whose other side is on another processor
are on a patch of type `processorCyclic`. The files `...ProcAddressing` have the numbers that cells, faces, points and
patches have in the whole mesh. `reconstructPar` reads them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..connectivity import distinct, take_rows, used_indices
from ..errors import InputError, InputTypeError
from ..mesh.faces import Faces

ADDRESSING = ("cellProcAddressing", "faceProcAddressing", "pointProcAddressing", "boundaryProcAddressing")
"""Files for `reconstructPar` in the folder of a processor: the cells, faces, points and patches of the whole mesh."""


@dataclass(frozen=True)
class FoamPatch:
    """A part of the boundary."""

    name: str
    kind: str
    size: int
    """Number of faces."""
    entries: tuple[str, ...] = ()
    """Further entries of its dictionary."""


@dataclass(frozen=True)
class FoamPiece:
    """The mesh of one processor, or the whole mesh."""

    points: np.ndarray
    """(v, 3) float."""
    starts: np.ndarray
    corners: np.ndarray
    """`starts`, `corners`: loops of the faces; see `Faces`."""
    owner: np.ndarray
    neighbor: np.ndarray
    """`owner`, `neighbor`: (f,), (i,) int. Cells of the faces, and of the first i of them the cells on the other
    side."""
    patches: list[FoamPatch]
    """Of the other faces."""
    cells: np.ndarray
    faces: np.ndarray
    used: np.ndarray
    """`cells`, `faces`, `used`: (n,), (f,), (v,) int. Numbers of cells, faces and points in the whole mesh."""
    turned: np.ndarray
    """(f,) bool. Which faces have the opposite orientation in the whole mesh."""
    patch_numbers: list[int]
    """list of int. Number of each patch in the whole mesh; -1 for patches between processors."""

    @classmethod
    def whole(cls, mesh: Faces, patches: list[FoamPatch]) -> FoamPiece:
        """Return all of `mesh`."""
        return cls(
            mesh.points,
            mesh.starts,
            mesh.corners,
            mesh.owner,
            mesh.neighbor[: mesh.n_inner],
            patches,
            np.arange(mesh.n_cells),
            np.arange(len(mesh)),
            np.arange(len(mesh.points)),
            np.zeros(len(mesh), bool),
            list(range(len(patches))),
        )

    @property
    def addressing(self) -> dict[str, np.ndarray]:
        """The numbers in the files `ADDRESSING`. Those of faces begin with 1, and are negative for turned faces."""
        faces = np.where(self.turned, -1 - self.faces, 1 + self.faces)
        return dict(zip(ADDRESSING, (self.cells, faces, self.used, np.array(self.patch_numbers)), strict=True))

    def local_cells(self, cells: np.ndarray) -> np.ndarray:
        """Return which cells of this piece are among the `cells` of the whole mesh, as numbers in this piece."""
        return np.flatnonzero(np.isin(self.cells, cells))

    def local_faces(self, faces: np.ndarray, against: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return which faces of this piece are among `faces`, and whether their normals point against those of a zone.

        `against` says that of `faces` in the whole mesh.
        """
        rows = np.flatnonzero(np.isin(self.faces, faces))
        order = np.argsort(faces)
        there = order[np.searchsorted(faces, self.faces[rows], sorter=order)]
        return rows, against[there] != self.turned[rows]


def processors_of(processors: object, centers: np.ndarray) -> np.ndarray:
    """Return the processor of each cell with these `centers` (n, d), (n,) int.

    Raises `InputError` or `InputTypeError` if `processors` is not a number from 1 to n, or one number from 0 on for
    each cell, all of them used.
    """
    n = len(centers)
    given = np.asarray(processors)
    if given.dtype.kind not in "iu":
        raise InputTypeError(
            f"processors is {processors!r:.60} of type {type(processors).__name__}, expected their number, or the "
            "number of the processor of each cell; write processors=4"
        )
    if given.ndim == 0:
        if not 1 <= given <= n:
            raise InputError(f"processors is {given}, expected 1 to {n}, the number of cells; use fewer")
        return bisect(centers, int(given))
    used = distinct(given.ravel())
    if given.shape != (n,) or not np.array_equal(used, np.arange(len(used))):
        raise InputError(
            f"processors has shape {given.shape} and {len(used)} numbers, the first ones {used[:3].tolist()}, expected "
            f"one number from 0 on for each of {n} cells, without gaps; write processors=4"
        )
    return given.astype(int)


def bisect(points: np.ndarray, count: int) -> np.ndarray:
    """Return the part of each of the `points` (n, d), (n,) int: `count` parts with nearly equal numbers of points.

    Planes across the longest extent halve the points again and again.
    """
    part = np.zeros(len(points), int)
    left = [(np.arange(len(points)), 0, count)]
    while left:
        rows, first, parts = left.pop()
        if parts == 1:
            part[rows] = first
            continue
        x = points[rows]
        order = rows[np.argsort(x[:, np.ptp(x, axis=0).argmax()], kind="stable")]
        half = parts // 2
        at = len(rows) * half // parts
        left += [(np.sort(order[:at]), first, half), (np.sort(order[at:]), first + half, parts - half)]
    return part


def decompose(mesh: Faces, patches: list[FoamPatch], part: np.ndarray) -> Iterator[FoamPiece]:
    """Yield the mesh of each processor. `part` (n,) int is that of each cell, `patches` are those of the whole mesh."""
    inner, n = mesh.n_inner, len(mesh)
    ends = inner + np.cumsum([patch.size for patch in patches])
    begins = ends - [patch.size for patch in patches]
    here = part[mesh.owner]
    there = here.copy()
    there[:inner] = part[mesh.neighbor[:inner]]
    seam = np.flatnonzero(mesh.twin >= 0)
    there[seam] = here[mesh.twin[seam]]
    of_patch = np.full(n, -1)
    for k, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        of_patch[begin:end] = k
    partner = {k: of_patch[mesh.twin[row]] for k, row in zip(of_patch[seam], seam, strict=True)} | {-1: -1}
    for p in range(int(part.max()) + 1):
        own, same = here == p, here == there
        lists, made = [np.flatnonzero(own & same & (of_patch < 0))], []
        numbers = list(range(len(patches)))
        for k, patch in enumerate(patches):
            lists.append(begins[k] + np.flatnonzero((own & same)[begins[k] : ends[k]]))
            made.append(replace(patch, size=len(lists[-1])))
        # At seams each processor has a face of its own. Elsewhere two processors share one face.
        shared = np.flatnonzero(~same & (own | ((there == p) & (of_patch < 0))))
        other = np.where(own[shared], there[shared], here[shared])
        for q in distinct(other):
            rows = shared[other == q]
            kinds = distinct(of_patch[rows]).tolist()
            if p > q:  # OpenFOAM sends patch by patch: both processors must have them in the same order
                kinds.sort(key=lambda k: partner[k])
            for k in kinds:
                lists.append(rows[of_patch[rows] == k])
                made.append(_between(p, int(q), len(lists[-1]), patches[k] if k >= 0 else None))
                numbers.append(-1)
        faces = np.concatenate(lists)
        turned = ~own[faces]
        cells = np.flatnonzero(part == p)
        number = np.full(mesh.n_cells, -1)
        number[cells] = np.arange(len(cells))
        starts, corners = take_rows(mesh.starts, mesh.corners, faces, turned)
        used, corners = used_indices(corners, len(mesh.points))
        behind = mesh.neighbor[faces[turned]]
        owner = number[mesh.owner[faces]]
        owner[turned] = number[behind]
        neighbor = number[mesh.neighbor[lists[0]]]
        yield FoamPiece(mesh.points[used], starts, corners, owner, neighbor, made, cells, faces, used, turned, numbers)


def _between(p: int, q: int, size: int, seam: FoamPatch | None) -> FoamPatch:
    """Return the patch of processor `p` towards processor `q`; of faces on the cyclic patch `seam`, if it is given."""
    transform = "unknown" if seam is None else "translational"
    entries = (f"transform {transform}", f"myProcNo {p}", f"neighbProcNo {q}", "matchTolerance 0.0001")
    if seam is None:
        return FoamPatch(f"procBoundary{p}to{q}", "processor", size, entries)
    name = f"procBoundary{p}to{q}through{seam.name}"
    return FoamPatch(name, "processorCyclic", size, (*entries, f"referPatch {seam.name}"))
