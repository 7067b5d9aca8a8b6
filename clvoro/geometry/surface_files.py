"""Triangulated surfaces in files: STL, OBJ, PLY, OFF and 3MF by trimesh, STEP by Gmsh."""

from __future__ import annotations

import gzip
import math
import os
import re
from collections.abc import Iterable, Sequence
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import InputError, MissingLibraryError
from ..files import open_plain, unlogged
from .triangles import NamedTriangles

FilePath = str | PathLike[str]
SURFACES = ("stl", "obj", "ply", "off")
SOLIDS = (*SURFACES, "3mf", "step", "stp")
_OPTIONS: dict[str, dict[str, Any]] = {
    # Files of textures and materials are not needed; groups are.
    "obj": {"skip_materials": True, "split_groups": True, "split_objects": True, "group_material": False}
}
_TURNS = 32  # triangles around a circle of a STEP file
_FINEST = 1 / 2000  # least size of triangles, over the diagonal of the part: smaller fillets become chamfers
_MOST_POINTS = 200_000  # on the edges of a STEP file: with more, faces would take Gmsh many minutes
_UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
_UNNAMED = "Open CASCADE STEP translator"  # so begin the names that Open CASCADE gives shapes without one


class FilePart(NamedTuple):
    """A part of a file: its name, vertices (v, 3) float and triangles (t, 3) int."""

    name: str
    vertices: np.ndarray
    triangles: np.ndarray


def read_parts(path: FilePath | Sequence[FilePath], kinds: Iterable[str] = SURFACES) -> list[FilePart]:
    """Return the parts of a surface file: solids of an STL file, groups of an OBJ file, objects of a 3MF file.

    Parts of several files have the name of their file, before that of the part if a file has more than one. Raises
    `InputError` if trimesh is not installed, a file cannot be read, or it holds no triangles.
    """
    if isinstance(path, Sequence) and not isinstance(path, str):
        files = [(Path(file), read_parts(file, kinds)) for file in path]
        if not files:
            raise InputError("surface files are [], expected at least one")
        stems = [(file.with_suffix("") if file.suffix.lower() == ".gz" else file).stem for file, _ in files]
        return [
            part._replace(name=f"{stem}_{part.name}" if len(parts) > 1 else stem)
            for stem, (_, parts) in zip(stems, files, strict=True)
            for part in parts
        ]
    path = Path(path)
    packed = path.suffix.lower() == ".gz"
    kind = (path.with_suffix("") if packed else path).suffix.lower().lstrip(".")
    if kind not in kinds:
        raise InputError(
            f"{str(path)!r} ends in {path.suffix!r}, expected a surface file: " + ", ".join(f".{f}" for f in kinds)
        )
    if not path.exists():
        raise InputError(f"there is no surface file {str(path)!r}")
    if kind in ("step", "stp"):
        return _read_step(path)
    try:
        import trimesh
    except ImportError as error:
        raise InputError(
            "reading a surface file needs trimesh; pip install 'clvoro[surfaces]' "
            "(or pip install trimesh), or pass the arrays: Surface(vertices, triangles)"
        ) from error
    try:
        # Coordinates that are not finite are refused by `Surface`.
        with open_plain(path) as file, np.errstate(all="ignore"), unlogged("trimesh"):
            plain = gzip.GzipFile(fileobj=file) if packed else file
            loaded: Any = trimesh.load(plain, file_type=kind, process=False, **_OPTIONS.get(kind, {}))
            parts = parts_of(loaded)
    except MemoryError:
        raise
    except OSError as error:
        raise InputError(f"surface file {str(path)!r} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # trimesh raises many kinds of errors for damaged files
        if kind == "3mf" and isinstance(error, ImportError):
            raise MissingLibraryError(
                f"reading {str(path)!r} needs networkx and lxml; pip install networkx lxml, or export it as STL"
            ) from error
        raise InputError(
            f"{str(path)!r} cannot be read as {kind.upper()} ({type(error).__name__}: {error}); export it again"
        ) from error
    if not any(len(part.triangles) for part in parts):
        raise InputError(f"{str(path)!r} holds no triangles, or is cut short, expected a surface")
    return parts


def parts_of(loaded: Any) -> list[FilePart]:
    """Return the parts of a mesh or scene of trimesh, in its order."""
    if not hasattr(loaded, "graph"):
        triangles = getattr(loaded, "faces", np.zeros((0, 3), np.int64))
        return [FilePart("", np.asarray(loaded.vertices, float), np.asarray(triangles))]
    parts = []
    for node in sorted(loaded.graph.nodes_geometry, key=lambda n: list(loaded.geometry).index(loaded.graph[n][1])):
        matrix, name = loaded.graph[node]
        mesh = loaded.geometry[name]
        if not hasattr(mesh, "faces"):
            continue
        vertices, triangles = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
        if not np.array_equal(matrix, np.eye(4)):
            vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
            if np.linalg.det(matrix[:3, :3]) < 0:
                triangles = triangles[:, ::-1]
        parts.append(FilePart(str(name), vertices, triangles))
    return parts


def joined(parts: list[FilePart]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the vertices (v, 3) and triangles (t, 3) of all parts, and the part of each triangle, (t,) int."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return (
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.triangles + start for part, start in zip(parts, starts[:-1], strict=True)]),
        np.repeat(np.arange(len(parts)), [len(part.triangles) for part in parts]),
    )


def unit_length(units: str | float | None) -> float:
    """Return the length of a unit in meters."""
    if units is None:
        return 1.0
    if isinstance(units, str):
        length = _UNITS.get(units, 0.0)
    else:
        length = float(units) if isinstance(units, Real) and not isinstance(units, bool) else 0.0
    if 0 < length < math.inf:
        return length
    raise InputError(f"units is {units!r}, expected one of {', '.join(_UNITS)}, or the length of the unit in meters")


def named_parts(parts: list[FilePart], unit: float = 1.0) -> NamedTriangles:
    """Return the parts of a file as one surface; parts of one name are one group."""
    vertices, triangles, part = joined(parts)
    if len(parts) == 1:
        known = parts[0].name.strip()
        return NamedTriangles(unit * vertices, triangles, names=(word(known, 0) if known else "wall",))
    words = [word(p.name, k) for k, p in enumerate(parts)]
    names = list(dict.fromkeys(words))
    return NamedTriangles(unit * vertices, triangles, np.array([names.index(w) for w in words])[part], names)


def word(name: str, number: int) -> str:
    """Return `name` as the name of a boundary: a word of letters, digits, _, . and -; else ``part-number``."""
    made = re.sub(r"[^A-Za-z0-9_.-]+", "_", name.strip()).strip("_")
    if not re.search(r"[A-Za-z]", made):
        return f"part-{number}"
    return made if re.match(r"[A-Za-z_]", made) else f"part-{made}"


def _read_step(path: Path) -> list[FilePart]:
    """Return the surface of the union of the solids in a STEP file, in meters. Faces of one name are a part of it."""
    try:
        import gmsh
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"reading {str(path)!r} needs Gmsh, which triangulates CAD surfaces; pip install 'clvoro[step]' (or pip "
            "install gmsh), or export the part as STL"
        ) from error
    started = not gmsh.isInitialized()
    if started:
        gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        # That of Open CASCADE: another one would stay in this process, for files that the caller writes.
        gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
        gmsh.option.setNumber("Mesh.MeshSizeFromCurvature", _TURNS)
        gmsh.option.setNumber("Mesh.MeshSizeExtendFromBoundary", 0)  # flat faces need no fine triangles beside fillets
        gmsh.model.add("part")
        gmsh.model.occ.importShapes(os.fspath(path))
        first, *others = gmsh.model.occ.getEntities(3) or [None]
        if others:  # parts that touch or overlap get common faces
            gmsh.model.occ.fragment([first], others)
        gmsh.model.occ.synchronize()
        box = np.reshape(gmsh.model.getBoundingBox(-1, -1), (2, 3))
        gmsh.option.setNumber("Mesh.MeshSizeMin", _FINEST * float(np.linalg.norm(box[1] - box[0])))
        gmsh.model.mesh.generate(1)
        _refuse_too_fine(path, len(gmsh.model.mesh.getNodes()[0]))
        gmsh.model.mesh.generate(2)
        tags, points = (np.asarray(part) for part in gmsh.model.mesh.getNodes()[:2])
        place = np.zeros(int(tags.max()) + 1 if len(tags) else 1, np.int64)
        place[tags] = np.arange(len(tags))
        found: dict[str, list[np.ndarray]] = {}
        for _, face in gmsh.model.getEntities(2):
            if len(gmsh.model.getAdjacencies(2, face)[0]) == 1:
                name = gmsh.model.getEntityName(2, face).rpartition("/")[2]
                nodes = np.asarray(gmsh.model.mesh.getElementsByType(2, face)[1])
                triangles = place[nodes.astype(np.int64)].reshape(-1, 3)
                found.setdefault("" if name.startswith(_UNNAMED) else name, []).append(triangles)
    except InputError:
        raise
    except Exception as error:  # Gmsh raises plain exceptions
        raise InputError(f"{str(path)!r} cannot be read as STEP ({error}); export it again, or as STL") from error
    finally:
        if started:
            gmsh.finalize()
        else:
            gmsh.model.remove()
    if not found:
        raise InputError(f"{str(path)!r} holds no solid, expected one; surfaces alone bound no region")
    vertices = _UNITS["mm"] * np.asarray(points, float).reshape(-1, 3)
    return [FilePart(name, vertices, np.concatenate(triangles)) for name, triangles in found.items()]


def _refuse_too_fine(path: Path, points: int) -> None:
    """Raise `InputError` if there are too many `points` on the edges of a STEP file."""
    if points > _MOST_POINTS:
        raise InputError(
            f"{str(path)!r} has long edges on surfaces of tiny radii: by {_TURNS} triangles around each they have "
            f"{points} points, expected at most {_MOST_POINTS}, as Gmsh would need hours; export it as STL with a "
            "tolerance of a tenth of the cells, and read that"
        )
