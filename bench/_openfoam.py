"""Cases of OpenFOAM: write them, run them, and read their results."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import clvoro
from clvoro.foam.case import FoamCase
from clvoro.foam.fields import read_field
from clvoro.foam.mesh import FoamMesh


def require(*programs: str) -> None:
    """End the script with a message if one of `programs` is not installed."""
    for program in programs:
        if shutil.which(program) is None:
            raise SystemExit(f"{program} is not installed; Debian has it in the package openfoam")


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


def forces_on(patch: str, speed: float, length: float, area: float) -> dict[str, Any]:
    """Return the function object that writes drag along x and lift along y of a patch, as coefficients."""
    return {
        "type": "forceCoeffs",
        "libs": '("libforces.so")',
        "patches": f"({patch})",
        "rho": "rhoInf",
        "rhoInf": 1,
        "liftDir": "(0 1 0)",
        "dragDir": "(1 0 0)",
        "pitchAxis": "(0 0 1)",
        "CofR": "(0 0 0)",
        "magUInf": speed,
        "lRef": length,
        "Aref": area,
    }


class Mesh(FoamMesh):
    """The polyMesh of a case, as OpenFOAM measures it."""

    @classmethod
    def of(cls, case: Path, folder: Path | None = None) -> Mesh:
        """Return the mesh of a case, or in another folder."""
        return cls.read(folder or case / "constant" / "polyMesh")

    def __len__(self) -> int:
        return self.n_cells

    def patch(self, name: str) -> np.ndarray:
        """Return the faces of a patch, (k,)."""
        return next(patch.faces for patch in self.patches if patch.name == name)

    def edges(self, patch: str) -> np.ndarray:
        """Return the ends of each face of `patch` of a layer of prisms in the plane, (n, 2, 2)."""
        faces = (self.points[self.corners[self.starts[f] : self.starts[f + 1]]] for f in self.patch(patch))
        return np.array([face[face[:, 2] < face[:, 2].mean(), :2] for face in faces])

    def velocity(self, flux: np.ndarray) -> np.ndarray:
        """Return the velocity (n, 3) that fits the `flux` (f,) through the faces of each cell best.

        That is the sum of S S / |S|, inverted, times the sum of S / |S| times the flux.
        """
        areas = self.faces[1]
        unit = areas / np.linalg.norm(areas, axis=1)[:, None]
        cell, face = np.concatenate([self.owner, self.neighbor]), np.r_[: len(self.owner), : len(self.neighbor)]
        matrix, right = np.zeros((len(self), 3, 3)), np.zeros((len(self), 3, 1))
        np.add.at(matrix, cell, (areas[:, :, None] * unit[:, None])[face])
        np.add.at(right, cell, (unit * flux[:, None])[face][:, :, None])
        return np.linalg.solve(matrix, right)[:, :, 0]


def write_prisms(
    case: Path,
    points: np.ndarray,
    cells: Sequence[np.ndarray],
    patch_of: Callable[[np.ndarray], np.ndarray],
    patches: Mapping[str, str],
    thickness: float,
    wedge: bool = False,
) -> None:
    """Write a plane mesh as a polyMesh of one layer of prisms, or of a wedge about the axis y = 0.

    - `points` (v, 2) float, and `cells`: the corners of each, counter-clockwise.
    - `patch_of` takes the middles of boundary edges (n, 2), returns the number of the patch of each.
    - `patches`: their names and types.
    - `thickness`: that of a wedge is at y = 1.
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
    kinds = {**patches, **dict.fromkeys(("back", "front"), "wedge" if wedge else "empty")}
    height = thickness * (points[:, 1] if wedge else np.ones(v))
    levels = [np.column_stack([points, height * share]) for share in ((-0.5, 0.5) if wedge else (0.0, 1.0))]
    for (name, kind), count in zip(kinds.items(), counts, strict=True):
        described += text_of({name: {"type": kind, "nFaces": count, "startFace": start}})
        start += count
    folder = case / "constant" / "polyMesh"
    folder.mkdir(parents=True, exist_ok=True)
    for name, kind, lines in (
        ("points", "vectorField", [f"({x!r} {y!r} {z!r})" for x, y, z in np.concatenate(levels).tolist()]),
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

    def write(self, name: str, entries: Mapping[str, Any], kind: str = "dictionary") -> None:
        """Write the dictionary `name`, such as "system/controlDict", or a field, such as "0/U", of the class `kind`."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(header(kind, path.name) + text_of(entries))

    def write_mesh(self, mesh: Any, openings: Sequence[str], thickness: float | None) -> None:
        """Write a mesh of clvoro, with patches that are no walls, and as `clvoro.load` reads it."""
        folder = self.folder / "constant" / "polyMesh"
        mesh.to_openfoam(folder, types=dict.fromkeys(openings, "patch"), thickness=thickness)
        mesh.save(folder / "clvoro.npz")

    def plot_speed(self, **options: Any) -> Any:
        """Draw the latest mesh of clvoro colored by the speed; `options` are those of `Diagram.plot`."""
        known = FoamCase(self.folder)
        mesh = clvoro.load(known.mesh_folder(known.latest()) / "clvoro.npz")
        return mesh.plot(np.linalg.norm(self.field("U", len(mesh)), axis=1), label="speed", **options)

    def write_start(
        self,
        velocity: Mapping[str, Any],
        pressure: Mapping[str, Any],
        values: tuple[str, str] = ("uniform (0 0 0)", "uniform 0"),
        names: tuple[str, str] = ("U", "p"),
    ) -> None:
        """Write a velocity and a pressure: the entries of their patches, and their values in cells."""
        for name, kind, dimensions, inside, patches in (
            (names[0], "volVectorField", "[0 1 -1 0 0 0 0]", values[0], velocity),
            (names[1], "volScalarField", "[0 2 -2 0 0 0 0]", values[1], pressure),
        ):
            self.write(f"0/{name}", {"dimensions": dimensions, "internalField": inside, "boundaryField": patches}, kind)

    def write_system(
        self,
        viscosity: float,
        convection: str = "bounded Gauss linearUpwind grad(U)",
        schemes: Mapping[str, Any] | None = None,
        *,
        solution: Mapping[str, Any],
        control: Mapping[str, Any],
    ) -> None:
        """Write the dictionaries of a laminar flow, which is steady unless `schemes` say else."""
        self.write("constant/transportProperties", {"transportModel": "Newtonian", "nu": viscosity, "DT": 1})
        self.write("constant/turbulenceProperties", {"simulationType": "laminar"})
        common = {
            "ddtSchemes": {"default": "steadyState"},
            # Forces on a body are exact only if the pressure's gradient conserves momentum.
            "gradSchemes": {"default": "leastSquares", "grad(p)": "Gauss linear"},
            "divSchemes": {
                "default": "Gauss linear",
                "div(phi,U)": convection,
                "div((nuEff*dev2(T(grad(U)))))": "Gauss linear",
            },
            "laplacianSchemes": {"default": "Gauss linear corrected"},
            "interpolationSchemes": {"default": "linear"},
            "snGradSchemes": {"default": "corrected"},
        }
        self.write("system/fvSchemes", {**common, **(schemes or {})})
        self.write("system/fvSolution", {"relaxationFactors": {"equations": {"U": 0.9}}, **solution})
        times = {"startFrom": "startTime", "startTime": 0, "stopAt": "endTime", "deltaT": 1, "writeControl": "runTime"}
        self.write("system/controlDict", {**times, "writeInterval": control["endTime"], **control})

    def run(self, *program: str) -> None:
        """Run a program of OpenFOAM."""
        FoamCase(self.folder).run(" ".join(program), self.folder / f"log.{program[0]}")

    def table(self, function: str, file: str) -> dict[str, np.ndarray]:
        """Return the columns of the tables that a function object wrote in all runs, by name."""
        paths = (self.folder / "postProcessing" / function).glob(f"*/{file}")
        texts = [path.read_text().splitlines() for path in sorted(paths, key=lambda path: float(path.parent.name))]
        heads = [line.split()[1:] for line in texts[0] if line.startswith("#")]
        rows = np.array([line.split() for lines in texts for line in lines if not line.startswith("#")], float)
        return dict(zip(heads[-1], rows.T, strict=True))

    def latest_mesh(self) -> Mesh:
        """Return the mesh of the latest time."""
        known = FoamCase(self.folder)
        return Mesh.read(known.mesh_folder(known.latest()))

    def field(self, name: str, n: int) -> np.ndarray:
        """Return the `n` values of a field at the last time, (n, k)."""
        folder = self.folder / FoamCase(self.folder).latest().name
        return read_field(next(path for path in (folder / name, folder / f"{name}.gz") if path.exists())).internal.rows(
            n
        )
