"""Read OpenFOAM's polyMesh to check it: text and binary, compressed or not, also of other programs."""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from ..connectivity import following, starts_of, take_rows
from ..errors import InputError
from ..files import open_plain
from ..finite_volumes.criteria import SolverReport
from ..finite_volumes.gate import openfoam_report
from ..finite_volumes.measures import SolverMeasures
from ..geometry.box import Box
from ..geometry.domain import Domain
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from .arrays import FileError, explained
from .contents import DOMAIN, described
from .foam import GENERATORS, polymesh_folder

_HEAD = re.compile(rb"FoamFile\s*\{(.*?)\}", re.DOTALL)
_COMMENTS = re.compile(rb"/\*.*?\*/|//[^\n]*", re.DOTALL)
_LIST = re.compile(rb"\s*(\d+)\s*\(?")
_ZONE = re.compile(rb'"?([^\s"{}()]+)"?\s*\{[^{}()]*?Labels\s+List<label>\s*(\d+)\s*')
_PATCH = re.compile(r'"?([^\s"{}()]+)"?\s*\{([^{}]*)\}')


def check_polymesh(folder: Path) -> SolverReport:
    """Check the mesh in a folder ``polyMesh`` by the criteria of OpenFOAM's `checkMesh`."""
    with explained(folder, "the files points, faces, owner, neighbour and boundary"):
        return openfoam_report(_read_faces(folder))


def _read_faces(folder: Path) -> Faces:
    """Return the mesh in `folder`; one layer of prisms between empty patches as a mesh in 2D."""
    points = FoamFile.read(folder, "points").vectors()
    starts, corners = FoamFile.read(folder, "faces").rows()
    owner = FoamFile.read(folder, "owner").labels()
    inside = FoamFile.read(folder, "neighbour").labels()
    patches = FoamFile.read(folder, "boundary").patches()
    f, inner = len(starts) - 1, len(inside)
    n = count_cells(points, starts, corners, owner, inside)
    mesh = Faces(
        domain=_box(points.min(axis=0), points.max(axis=0)),
        generators=np.zeros((n, 3)),
        points=points,
        starts=starts,
        corners=corners,
        owner=owner.astype(np.int32),
        neighbor=np.concatenate([inside, np.full(f - inner, -1)]).astype(np.int32),
        twin=np.full(f, -1),
        shift=np.zeros((f, 3), np.int8),
        half_face=np.full(f, -1),
    )
    flat = [patch.faces for patch in patches if patch.kind == "empty"]
    mesh, seams = _coupled(mesh, patches)
    empty = np.isin(seams, np.concatenate(flat)) if flat else np.zeros(f, bool)
    return _in_plane(mesh, empty) if empty.sum() == 2 * n else mesh


def count_cells(
    points: np.ndarray, starts: np.ndarray, corners: np.ndarray, owner: np.ndarray, neighbor: np.ndarray
) -> int:
    """Return the number of cells of a mesh.

    Raises `FileError` if its lists do not fit each other.
    """
    f, inner = len(starts) - 1, len(neighbor)
    n = int(max(owner.max(initial=-1), neighbor.max(initial=-1))) + 1
    fits = len(owner) == f and inner <= f and n > 0 and min(owner.min(), neighbor.min(initial=0)) >= 0
    if not fits or not ((corners >= 0) & (corners < len(points))).all() or (np.diff(starts) < 3).any():
        raise FileError("its lists do not fit each other, expected those of one mesh")
    return n


def _coupled(mesh: Faces, patches: list[FoamPatchFaces]) -> tuple[Faces, np.ndarray]:
    """Join the faces of cyclic patches as seams; return the mesh, and the row that each face had before, (f,)."""
    by_name = {patch.name: patch for patch in patches}
    pairs = [
        (patch.faces, by_name[patch.across].faces)
        for patch in patches
        if patch.kind == "cyclic" and patch.across in by_name and patch.name < patch.across
    ]
    if not pairs:
        return mesh, np.arange(len(mesh))
    if any(len(a) != len(b) for a, b in pairs):
        raise FileError("two cyclic patches have different numbers of faces")
    one, other = (np.concatenate(side) for side in zip(*pairs, strict=True))
    f, c = len(mesh), len(one)
    order = np.concatenate([np.setdiff1d(np.arange(f), np.concatenate([one, other])), one, other])
    centers = mesh.vectors[0]
    across = centers[one] - centers[other]
    periods = np.abs(across).max(axis=0)
    low, size = np.array(mesh.domain.lower), np.array(mesh.domain.extent)
    used = periods > 1e-6 * size.max()
    periods = np.where(used, periods, size)
    twin, shift = mesh.twin.copy(), np.zeros((f, 3), np.int8)
    twin[f - 2 * c : f - c], twin[f - c :] = np.arange(f - c, f), np.arange(f - 2 * c, f - c)
    steps = np.rint(across / periods).astype(np.int8)
    shift[f - 2 * c : f - c], shift[f - c :] = steps, -steps
    neighbor = mesh.neighbor.copy()
    neighbor[one], neighbor[other] = mesh.owner[other], mesh.owner[one]
    domain = _box(low, low + periods, used)
    return mesh.take_faces(order, domain=domain, neighbor=neighbor[order], twin=twin, shift=shift), order


def _in_plane(mesh: Faces, empty: np.ndarray) -> Faces:
    """Return a layer of prisms without its `empty` bottoms and tops, (f,) bool, as a mesh in the plane."""
    sides = np.flatnonzero(~empty)
    starts, corners = take_rows(mesh.starts, mesh.corners, sides)
    low = mesh.points[corners, 2] <= mesh.points[:, 2].mean()
    begins = low & low[following(starts)]  # the corner with which the edge at the bottom begins
    if (np.diff(starts) != 4).any() or (begins.reshape(-1, 4).sum(axis=1) != 1).any():
        return mesh
    ends = np.stack([corners[begins], corners[following(starts)[begins]]], axis=1)
    place = np.full(len(mesh), -1)
    place[sides] = np.arange(len(sides))
    box = mesh.domain
    made = mesh.take_faces(
        sides,
        domain=_box(np.array(box.lower[:2]), np.array(box.upper[:2]), np.array(box.periodic[:2])),
        generators=mesh.generators[:, :2],
        points=mesh.points[:, :2],
        corners=ends.ravel(),
        starts=2 * np.arange(len(sides) + 1),
        twin=np.where(mesh.twin[sides] >= 0, place[mesh.twin[sides]], -1),
        shift=mesh.shift[sides, :2],
    )
    made = made.compact()
    vars(made)["measures"] = SolverMeasures(made, float(np.ptp(mesh.points[:, 2])))
    return made


def _box(lower: np.ndarray, upper: np.ndarray, periodic: np.ndarray | None = None) -> Box:
    sides = np.zeros(len(lower), bool) if periodic is None else periodic
    return Box(tuple(lower.tolist()), tuple(upper.tolist()), tuple(sides.tolist()))


def read_with_head(path: Path) -> tuple[dict[str, str], bytes, int]:
    """Read a file of OpenFOAM, compressed if it ends in ``.gz``.

    Results:
    - `head`: the entries of its head FoamFile.
    - `text`: the whole file.
    - `begin`: where the head ends in it; 0 if it has none.
    """
    with open_plain(path) as file:
        text = gzip.decompress(file.read()) if path.suffix == ".gz" else file.read()
    found = _HEAD.search(text)
    if found is None:
        return {}, text, 0
    entries = re.findall(rb'(\w+)\s+"?([^;"]*?)"?\s*;', found[1])
    return {key.decode(): value.decode("utf-8", "replace") for key, value in entries}, text, found.end()


@dataclass(frozen=True)
class FoamPatchFaces:
    """A part of the boundary: name, type, the patch across a seam, its faces, (k,), and the groups that it is in."""

    name: str
    kind: str
    across: str
    faces: np.ndarray
    groups: tuple[str, ...] = ()


@dataclass(frozen=True)
class FoamFile:
    """One file of a polyMesh: the entries of its head, and what follows."""

    head: dict[str, str]
    body: bytes

    @classmethod
    def read(cls, folder: Path, name: str) -> FoamFile:
        """Read the file `name`, or its compressed form, of a folder."""
        path = folder / name
        packed = not path.exists() and path.with_name(f"{name}.gz").exists()
        try:
            head, text, begin = read_with_head(path.with_name(f"{name}.gz") if packed else path)
        except OSError as error:
            raise FileError(f"its file {name} cannot be read ({error.strerror or error})") from error
        if not begin:
            raise FileError(f"its file {name} has no head FoamFile, expected a file of OpenFOAM")
        body = text[begin:]
        binary = head.get("format") == "binary" and name != "boundary"
        return cls(head, body if binary else _COMMENTS.sub(b" ", body))

    @property
    def _label(self) -> str:
        return "<i8" if "label=64" in self.head.get("arch", "") else "<i4"

    @property
    def _scalar(self) -> str:
        return "<f4" if "scalar=32" in self.head.get("arch", "") else "<f8"

    def _binary(self, dtype: str, width: int, at: int = 0) -> tuple[np.ndarray, int]:
        """Return the list in bytes that begins at `at`, and where it ends."""
        found = re.compile(rb"[\s/*-]*(?://[^\n]*\s*|/\*.*?\*/\s*)*(\d+)\s*", re.DOTALL).match(self.body, at)
        if found is None:
            raise FileError("a list in bytes does not begin with its length")
        count, begin = width * int(found[1]), found.end()
        if count == 0:
            return np.zeros(0, dtype), begin
        end = begin + 1 + count * np.dtype(dtype).itemsize
        if len(self.body) <= end:
            raise FileError("a list in bytes ends too early")
        return np.frombuffer(self.body, dtype, count, begin + 1), end + 1

    def _numbers(self, dtype: type, width: int) -> np.ndarray:
        """Return the numbers of a list in text, whose items have `width` numbers."""
        found = _LIST.match(self.body)
        if found is None:
            raise FileError("a list does not begin with its length")
        text = self.body[found.end() : self.body.rfind(b")")].replace(b"(", b" ").replace(b")", b" ")
        values = np.array(text.split(), dtype)
        if len(values) != width * int(found[1]):
            raise FileError(f"a list has {len(values)} numbers, expected {width * int(found[1])}")
        return values

    def _is_binary(self) -> bool:
        return self.head.get("format") == "binary"

    def vectors(self) -> np.ndarray:
        """Return points, (v, 3)."""
        values = self._binary(self._scalar, 3)[0] if self._is_binary() else self._numbers(float, 3)
        return values.reshape(-1, 3).astype(float)

    def labels(self) -> np.ndarray:
        """Return labels, (k,)."""
        return (self._binary(self._label, 1)[0] if self._is_binary() else self._numbers(int, 1)).astype(np.int64)

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of faces as ragged rows."""
        if self._is_binary():
            starts, end = self._binary(self._label, 1)
            corners = self._binary(self._label, 1, end)[0].astype(np.int64)
            return starts.astype(np.int64), corners
        begin = _LIST.match(self.body)
        body = self.body[0 if begin is None else begin.end() :]
        counts = np.array(re.findall(rb"(\d+)\s*\(", body), int)
        starts = starts_of(counts)
        text = body.replace(b"(", b" ").replace(b")", b" ").split()
        numbers = np.array(text, np.int64)
        if begin is None or len(counts) != int(begin[1]) or len(numbers) != starts[-1] + len(counts):
            raise FileError(f"faces has {len(counts)} faces, expected as many as it says")
        return starts, np.delete(numbers, starts[:-1] + np.arange(len(counts)))

    def patches(self) -> list[FoamPatchFaces]:
        """Return the parts of the boundary."""
        made = []
        for name, body in _PATCH.findall(self.body.decode("utf-8", "replace")):
            entries = dict(re.findall(r"(\w+)\s+([^;]+);", body))
            first, count = int(entries["startFace"]), int(entries["nFaces"])
            across = entries.get("neighbourPatch", "").strip()
            groups = tuple(re.findall(r"[^\s()\"]+", entries.get("inGroups", "").partition("(")[2]))
            faces = np.arange(first, first + count)
            made.append(FoamPatchFaces(name, entries["type"].strip(), across, faces, groups))
        return made

    def zones(self) -> dict[str, np.ndarray]:
        """Return the labels of the cells, faces or points of each zone, (k,), by name."""
        made, at = {}, 0
        while found := _ZONE.search(self.body, at):
            count, at = int(found[2]), found.end()
            begins = self.body[at : at + 1]
            if begins == b"(" and self._is_binary():
                rows, at = self._binary(self._label, 1, found.start(2))
            elif begins == b"(":
                end = self.body.find(b")", at)
                rows, at = np.array(self.body[at + 1 : end].split(), np.int64), end
            else:  # one label for all, or none
                rows = np.repeat(np.array(self.body[at + 1 : self.body.find(b"}", at)].split()[:1], np.int64), count)
            if len(rows) != count:
                raise FileError(f"a zone has {len(rows)} labels, expected {count}")
            made[found[1].decode("utf-8", "replace")] = rows.astype(np.int64)
        return made


def load_foam(path: str | PathLike[str], tessellate: Callable[[Domain, np.ndarray], Diagram]) -> Diagram:
    """Read a decomposed case of OpenFOAM: the file `generators` of each processor.

    `tessellate` makes the cells again. Their order is that of the mesh before it was decomposed.

    Raises `InputError` if a processor has no generators.
    """
    refuse_polymesh(path)
    folders = _with_generators(path)
    with explained(path, "a decomposed case that save or to_openfoam wrote"):
        said = re.search(f"//{DOMAIN}(.*)\n".encode(), read_with_head(folders[0] / GENERATORS)[1])
        rows = np.concatenate([FoamFile.read(folder, "cellProcAddressing").labels() for folder in folders])
        found = np.concatenate([FoamFile.read(folder, GENERATORS).vectors() for folder in folders])
        if said is None or not np.array_equal(np.sort(rows), np.arange(len(found))):
            raise FileError("its processors are not those of one mesh; write it again")
        domain = described(json.loads(said[1]))
        return tessellate(domain, found[np.argsort(rows), : domain.dim])


def _with_generators(path: str | PathLike[str]) -> list[Path]:
    """Return the folders of all processors of the case with this file ``.foam``; none if one lacks generators."""
    case = Path(path).parent
    folders = [case / f"processor{k}" / "constant" / "polyMesh" for k in range(len([*case.glob("processor*")]))]
    there = Path(path).suffix.lower() == ".foam" and all((folder / GENERATORS).exists() for folder in folders)
    return folders if there else []


def refuse_polymesh(path: str | PathLike[str]) -> None:
    """Raise an error if `path` is OpenFOAM's mesh, which can be checked and not loaded, and has no generators.

    Raises `InputError`.
    """
    if polymesh_folder(path) is not None and not _with_generators(path):
        raise InputError(
            f"cannot load {path}: OpenFOAM's meshes have no generators; load the mesh.npz or mesh.vtu of the same run, "
            "or a case that clvoro has decomposed, or check this one with `clvoro check`"
        )
