"""Cases of OpenFOAM: write them, run them, and read their results."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clvoro.foam.case import FoamCase
from clvoro.io.foam_read import FoamFile
from clvoro.mesh.geometry import cell_geometry, face_geometry

HOME = "/usr/share/openfoam"  # of Debian's package
NUMBER = r"[-+.e\d]+"


def missing(*programs: str) -> list[str]:
    """Return those of `programs` that are not installed."""
    return [program for program in programs if shutil.which(program) is None]


def text_of(entries: Mapping[str, Any], indent: int = 0) -> str:
    """Write a dictionary of OpenFOAM; values are numbers, text, or dictionaries."""
    tab, text = " " * indent, ""
    for name, value in entries.items():
        if isinstance(value, Mapping):
            text += f"{tab}{name}\n{tab}{{\n{text_of(value, indent + 4)}{tab}}}\n"
        else:
            text += f"{tab}{name} {value};\n"
    return text


def header(kind: str, name: str) -> str:
    """Write the first lines of a file."""
    return text_of({"FoamFile": {"version": "2.0", "format": "ascii", "class": kind, "object": name}})


def nonuniform(values: np.ndarray) -> str:
    """Write a field of scalars (n,), or of vectors (n, 3), or from their components x and y, (n, 2)."""
    if values.ndim == 1:
        return f"nonuniform List<scalar> {len(values)}({' '.join(map(repr, values.tolist()))})"
    values = np.pad(values, ((0, 0), (0, 3 - values.shape[1])))
    rows = " ".join(f"({x!r} {y!r} {z!r})" for x, y, z in values.tolist())
    return f"nonuniform List<vector> {len(values)}({rows})"


class PlaneMesh:
    """A polyMesh of one layer of prisms between the patches `back` and `front`, as OpenFOAM reads it.

    Attributes
    ----------
    owner : (f,) int
        Owner of each face.
    patches : dict of str to slice
        The faces of each patch.
    centroids : (n, 2) float
        Centroids of the cells in the plane.
    polygons : list of (k, 2) float
        Corners of the cells.
    """

    def __init__(self, case: Path, folder: Path | None = None) -> None:
        folder = folder or case / "constant" / "polyMesh"
        triple = rf"\(({NUMBER}) ({NUMBER}) ({NUMBER})\)"
        self._points = np.array(re.findall(triple, _body(folder / "points")), float)
        rows = re.findall(r"\d+\s*\(([\d\s]+)\)", _body(folder / "faces"))
        self._faces = [np.array(row.split(), int) for row in rows]
        self.owner = np.array(_body(folder / "owner").split(), int)
        patch = r"(\w+)\s*\{[^}]*?nFaces\s+(\d+);\s*startFace\s+(\d+);"
        self.patches = {
            name: slice(int(start), int(start) + int(count))
            for name, count, start in re.findall(patch, _body(folder / "boundary"))
        }
        back = self.patches["back"]
        order = np.argsort(self.owner[back]) + back.start
        self.polygons = [self._points[self._faces[k]][:, :2] for k in order]
        self.centroids = np.array([_centroid(polygon) for polygon in self.polygons])

    def __len__(self) -> int:
        return len(self.polygons)

    def edges(self, patch: str) -> np.ndarray:
        """Return the ends of each face of `patch` in the plane, (n, 2, 2)."""
        faces = (self._points[face] for face in self._faces[self.patches[patch]])
        return np.array([face[face[:, 2] < face[:, 2].mean(), :2] for face in faces])


class SpaceMesh:
    """A polyMesh in space, as OpenFOAM measures it.

    Attributes
    ----------
    centroids, volumes : (n, 3), (n,) float
    centers, areas : (f, 3) float
    owner, inside : (f,), (k,) int
        Cells of each face, and behind the first faces.
    patches : dict of str to (k,) int
        The faces of each patch.
    """

    def __init__(self, case: Path) -> None:
        folder = case / "constant" / "polyMesh"
        points, (starts, corners) = FoamFile.read(folder, "points").vectors(), FoamFile.read(folder, "faces").rows()
        self.owner, inside = FoamFile.read(folder, "owner").labels(), FoamFile.read(folder, "neighbour").labels()
        self.patches = {patch.name: patch.faces for patch in FoamFile.read(folder, "boundary").patches()}
        self.centers, self.areas = face_geometry(points, starts, corners)
        self.inside, n = inside, int(self.owner.max()) + 1
        self.centroids, self.volumes = cell_geometry(self.centers, self.areas, self.owner, inside, n)

    def velocity(self, flux: np.ndarray) -> np.ndarray:
        """Return the velocity (n, 3) that fits the `flux` (f,) through the faces of each cell best.

        That is the sum of S S / |S|, inverted, times the sum of S / |S| times the flux.
        """
        unit = self.areas / np.linalg.norm(self.areas, axis=1)[:, None]
        cell, face = np.concatenate([self.owner, self.inside]), np.r_[: len(self.owner), : len(self.inside)]
        matrix, right = np.zeros((len(self.volumes), 3, 3)), np.zeros((len(self.volumes), 3, 1))
        np.add.at(matrix, cell, (self.areas[:, :, None] * unit[:, None])[face])
        np.add.at(right, cell, (unit * flux[:, None])[face][:, :, None])
        return np.linalg.solve(matrix, right)[:, :, 0]


def _centroid(polygon: np.ndarray) -> np.ndarray:
    first = polygon - polygon[0]
    after = np.roll(first, -1, axis=0)
    weight = first[:, 0] * after[:, 1] - after[:, 0] * first[:, 1]
    return polygon[0] + weight @ (first + after) / (3 * weight.sum())


def _body(path: Path) -> str:
    """Return the text between the outer parentheses of a list."""
    text = path.read_text()
    text = text[text.index("}") + 1 :]
    return text[text.index("(") + 1 : text.rindex(")")]


def write_prisms(
    case: Path,
    points: np.ndarray,
    cells: Sequence[np.ndarray],
    patch_of: Callable[[np.ndarray], np.ndarray],
    patches: Mapping[str, str],
    thickness: float,
) -> None:
    """Write a plane mesh as a polyMesh of one layer of prisms.

    Parameters
    ----------
    case : Path
    points : (v, 2) float
    cells : sequence of (k,) int
        Corners of each cell, counter-clockwise.
    patch_of : callable
        Takes the middles of boundary edges (n, 2), returns the number of the patch of each.
    patches : mapping
        Names and types of the patches.
    thickness : float
    """
    sides: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
    for number, cell in enumerate(cells):
        for a, b in zip(cell.tolist(), np.roll(cell, -1).tolist(), strict=True):
            sides.setdefault((min(a, b), max(a, b)), []).append((number, a, b))
    inner = sorted((s[0][0], s[1][0], s[0][1], s[0][2]) for s in sides.values() if len(s) == 2)
    outer = [s[0] for s in sides.values() if len(s) == 1]
    patch = patch_of(np.array([(points[a] + points[b]) / 2 for _, a, b in outer]))
    outer = [outer[k] for k in np.argsort(patch, kind="stable")]
    owner = [row[0] for row in inner] + [row[0] for row in outer] + 2 * list(range(len(cells)))
    v = len(points)
    faces = [(a, b, b + v, a + v) for *_, a, b in [*inner, *outer]]
    rows = [f"4({a} {b} {c} {d})" for a, b, c, d in faces]
    rows += [f"{len(c)}({' '.join(map(str, c[::-1].tolist()))})" for c in cells]
    rows += [f"{len(c)}({' '.join(map(str, (c + v).tolist()))})" for c in cells]
    counts = [*np.bincount(patch, minlength=len(patches)).tolist(), len(cells), len(cells)]
    described, start = "", len(inner)
    kinds = {**patches, "back": "empty", "front": "empty"}
    for (name, kind), count in zip(kinds.items(), counts, strict=True):
        described += text_of({name: {"type": kind, "nFaces": count, "startFace": start}})
        start += count
    folder = case / "constant" / "polyMesh"
    folder.mkdir(parents=True, exist_ok=True)
    for name, kind, lines in (
        ("points", "vectorField", [f"({x!r} {y!r} {z!r})" for z in (0.0, thickness) for x, y in points.tolist()]),
        ("faces", "faceList", rows),
        ("owner", "labelList", list(map(str, owner))),
        ("neighbour", "labelList", [str(row[1]) for row in inner]),
    ):
        text = "\n".join([str(len(lines)), "(", *lines, ")", ""])
        (folder / name).write_text(header(kind, name) + text)
    text = f"{len(kinds)}\n(\n{described})\n"
    (folder / "boundary").write_text(header("polyBoundaryMesh", "boundary") + text)


class Case:
    """A folder with `system`, `constant` and `0`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def write(self, name: str, entries: Mapping[str, Any]) -> None:
        """Write the dictionary or field `name`, such as "system/controlDict" or "0/U"."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        kinds = {"0/U": "volVectorField", "0/p": "volScalarField", "0/Phi": "volScalarField"}
        path.write_text(header(kinds.get(name, "dictionary"), path.name) + text_of(entries))

    def run(self, program: str, *options: str) -> str:
        """Run a program of OpenFOAM; return what it prints.

        Raises
        ------
        RuntimeError
            If the program fails.
        """
        environment = {"WM_PROJECT_DIR": HOME, **os.environ}
        done = subprocess.run(
            [program, *options], cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise RuntimeError(f"{program} failed: {(done.stdout + done.stderr)[-2000:]}")
        return done.stdout

    def table(self, function: str, file: str) -> dict[str, np.ndarray]:
        """Return the columns of the table that a function object wrote, by name."""
        (path,) = (self.folder / "postProcessing" / function).glob(f"*/{file}")
        lines = path.read_text().splitlines()
        heads = [line.split()[1:] for line in lines if line.startswith("#")]
        rows = np.array([line.split() for line in lines if not line.startswith("#")], float)
        return dict(zip(heads[-1], rows.T, strict=True))

    def latest_mesh(self) -> PlaneMesh:
        """Return the mesh of the latest time."""
        known = FoamCase(self.folder)
        return PlaneMesh(self.folder, known.mesh_folder(known.latest()))

    def field(self, name: str, dim: int = 2) -> np.ndarray:
        """Return the values of a field in cells at the last time, (n,), or the first `dim` components of a vector."""
        times = [p for p in self.folder.iterdir() if re.fullmatch(r"[\d.]+", p.name)]
        text = (max(times, key=lambda p: float(p.name)) / name).read_text()
        text = text[text.index("internalField") : text.index("boundaryField")]
        values = np.array(re.sub(r"[()]", " ", text[text.index("(") : text.rindex(")")]).split())
        return values.astype(float) if "<scalar>" in text else values.astype(float).reshape(-1, 3)[:, :dim]
