"""The mesh in a `.vtu` file that `vtu` wrote, from its arrays."""

from __future__ import annotations

import os
import struct
import zlib
from array import array
from itertools import pairwise
from os import PathLike, fspath
from xml.parsers import expat

import numpy as np
from scipy.spatial import KDTree

from ...errors import InputError
from ...files import open_plain
from ...geometry.box import Box
from ...geometry.domain import Domain
from ...geometry.polygon import Polygon
from ...geometry.sphere import Sphere
from ...geometry.sphere_region import SphereRegion
from ...mesh.check.rebuilt import rebuild
from ...mesh.connectivity import following
from ...mesh.diagram import Diagram
from ...mesh.results import HISTORY_DTYPE, Result
from ...mesh.spherical import rebuild_on_sphere
from ..arrays import FileError
from ..vtu_checks import check_repeated
from .arrays import END, LONGEST_HEAD, MARK, FileReader

_OFF_SPHERE = 1e-5
"""Largest distance of a vertex from its sphere in units of the radius: round-off of float32, and more."""


def load_vtu(path: str | PathLike[str]) -> Result | Diagram:
    """Read the cells and cell data of a `.vtu` file of `Result.save` or `Diagram.save`.

    The domain is the polygon or periodic box in the file, or else the bounding box of the vertices. The graph is
    computed again from the corners that cells share. Volumes, sizes, errors and quality are those of the file. The
    history is empty.

    Raises
    ------
    InputError
        If the file is missing, damaged, truncated or not from clvoro; names the file and the fault.
    """
    name = fspath(path)
    try:
        with open_plain(path) as file:
            head = file.read(LONGEST_HEAD)
            end = head.find(MARK)
            if end < 0:
                raise FileError("it has no appended raw data, which files of clvoro have")
            start = end + len(MARK)
            size = os.fstat(file.fileno()).st_size
            file.seek(max(0, size - len(END)))
            if file.read() != END:
                raise FileError("it is truncated, or has bytes behind its end")
            reader = FileReader(head[:end], start, size)
            arrays = reader.read_all(file)
        return _assemble(arrays, reader)
    except FileError as problem:
        raise InputError(f"cannot read {name}: {problem}") from problem
    except (
        zlib.error,
        struct.error,
        ValueError,
        OverflowError,
        KeyError,
        TypeError,
        RecursionError,
        expat.ExpatError,
    ) as error:
        raise InputError(f"cannot read {name}: it is damaged or not from clvoro ({error})") from error
    except OSError as error:
        raise InputError(f"cannot read {name}: {error.strerror or error}") from error


def _assemble(arrays: dict[str, np.ndarray], reader: FileReader) -> Result | Diagram:
    vertices = arrays["Points."].astype(float)
    kinds = arrays["Cells.types"]
    if not len(kinds) or not len(vertices) or not np.isfinite(vertices).all():
        raise FileError("it has no cells, or vertices that are not finite")
    flat = bool((kinds == 7).all())
    if not flat and not (kinds == 42).all():
        raise FileError("its cells are neither all polygons nor all polyhedra")
    dim = 2 if flat and "FieldData.sphere_radius" not in arrays else 3
    x = np.ascontiguousarray(vertices[:, :dim])
    domain = _domain(arrays, x, reader)
    faces = _cell_polygons(arrays, len(x), domain) if flat else _cell_polyhedra(arrays, len(x))
    owner = np.repeat(np.arange(len(kinds)), np.diff(faces["neighbor_starts"]))
    neighbors = _neighbors(owner, faces.pop("starts"), faces.pop("corners"), x, domain)
    if "FieldData.wall_faces" in arrays:
        _set_walls(arrays, neighbors, domain)
    across = _seam(arrays, neighbors, dim, len(kinds)) if any(domain.periodic) else {}
    points = arrays["CellData.generator"][:, :dim].astype(float)
    volumes = arrays["CellData.volume"].astype(float)
    known = {"points": points, "volumes": volumes, "neighbors": neighbors, "vertices": x}
    known |= {**faces, **across}
    if "CellData.weight" in arrays:
        known["weights"] = arrays["CellData.weight"].astype(float)
    # The other arrays follow from the corners.
    rest = rebuild_on_sphere if isinstance(domain, Sphere) else rebuild
    diagram = Diagram(domain, {**known, **rest(Diagram(domain, known))})
    check_repeated(arrays, diagram)
    of_run = [f"CellData.{name}" for name in ("size", "error", "quality")]
    if not set(of_run) & set(arrays):
        return diagram
    size, error, quality = (arrays[name].astype(float) for name in of_run)
    return Result(
        points=points,
        diagram=diagram,
        target_size=size,
        size_error=error,
        quality=quality,
        history=np.zeros(0, HISTORY_DTYPE),
        converged=False,
        stop_reason="read from a .vtu file",
    )


def _domain(arrays: dict[str, np.ndarray], x: np.ndarray, reader: FileReader) -> Domain:
    """Return the domain in the file, or else the bounding box of the vertices."""
    if "FieldData.sphere_radius" in arrays:
        return _sphere(arrays, x, reader)
    lower, upper, dim = x.min(axis=0), x.max(axis=0), x.shape[1]
    if not (lower < upper).all():
        raise FileError("its vertices lie on a line")
    if "FieldData.box_periodic" in arrays:
        return _periodic_box(arrays, dim, reader.names)
    polygon = _polygon(arrays, reader) if dim == 2 else None
    return polygon or Box(tuple(lower), tuple(upper), names=reader.names)


def _sphere(arrays: dict[str, np.ndarray], x: np.ndarray, reader: FileReader) -> Sphere:
    """Return the sphere in the file, or the part of it, on which all vertices and generators must be."""
    radius = arrays["FieldData.sphere_radius"]
    if radius.shape != (1,) or radius.dtype.kind != "f":
        raise FileError(f"sphere_radius has shape {radius.shape} and dtype {radius.dtype}")
    sphere = Sphere(float(radius[0]))
    for name, places in (("vertices", x), ("generators", arrays["CellData.generator"])):
        if not (np.abs(np.linalg.norm(places, axis=1) / sphere.radius - 1) < _OFF_SPHERE).all():
            raise FileError(f"its {name} are not on the {sphere}")
    if "FieldData.region_beyond" not in arrays:
        return sphere
    within, beyond, area = (arrays[f"FieldData.region_{k}"] for k in ("within", "beyond", "area"))
    if area.shape != (1,):
        raise FileError(f"region_area has shape {area.shape}")
    return SphereRegion(sphere.radius, within=within, beyond=beyond, area=float(area[0]), names=reader.names)


def _cell_polygons(arrays: dict[str, np.ndarray], v: int, domain: Domain) -> dict[str, np.ndarray]:
    """Return the diagram's arrays of cells and faces in 2D, and `starts` and `corners` of the faces."""
    cell_starts, corners = _polygons(arrays, v)
    owner = np.repeat(np.arange(len(cell_starts) - 1), np.diff(cell_starts))
    ends = np.stack([corners, corners[following(cell_starts)]], axis=1)
    found = {"cell_vertex_starts": cell_starts, "cell_vertices": corners}
    if not isinstance(domain, Polygon):
        rows = cell_starts
    else:
        kept = ~_bridges(arrays, owner, ends)
        ends = ends[kept]
        counts = np.bincount(owner[kept], minlength=len(cell_starts) - 1)
        rows = np.concatenate([[0], np.cumsum(counts)])
    starts = 2 * np.arange(len(ends) + 1)
    if isinstance(domain, Polygon):
        found |= {"face_vertex_starts": starts, "face_vertices": ends.ravel()}
    return {**found, "neighbor_starts": rows, "starts": starts, "corners": ends.ravel()}


def _cell_polyhedra(arrays: dict[str, np.ndarray], v: int) -> dict[str, np.ndarray]:
    """Return the diagram's arrays of faces in 3D, and again `starts` and `corners` of the faces."""
    cell_starts, starts, corners = _polyhedra(arrays, v)
    return {
        "neighbor_starts": cell_starts,
        "face_vertex_starts": starts,
        "face_vertices": corners,
        "starts": starts,
        "corners": corners,
    }


def _periodic_box(arrays: dict[str, np.ndarray], dim: int, names: dict[str, list[int]] | None) -> Box:
    """Return the periodic box in the file."""
    corners = arrays["FieldData.box_corners"].reshape(2, 3)[:, :dim].astype(float)
    axes = arrays["FieldData.box_periodic"]
    if axes.shape != (dim,):
        raise FileError(f"box_periodic has shape {axes.shape}, expected ({dim},)")
    return Box(*corners.tolist(), periodic=tuple(bool(a) for a in axes), names=names)


def _seam(arrays: dict[str, np.ndarray], neighbors: np.ndarray, dim: int, n: int) -> dict[str, np.ndarray]:
    """Set the neighbors across the seams, where faces share no corners, and return the shifts."""
    faces = _indices(arrays["FieldData.seam_faces"], len(neighbors), "seam_faces")
    others = _indices(arrays["FieldData.seam_neighbors"], n, "seam_neighbors")
    steps = arrays["FieldData.seam_shifts"].reshape(-1, 3)[:, :dim]
    if not len(faces) == len(others) == len(steps) or (np.abs(steps.astype(float)) > 1).any():
        raise FileError("its seams differ from its cells")
    neighbors[faces] = others
    shifts = np.zeros((len(neighbors), dim), np.int8)
    shifts[faces] = steps
    return {"shifts": shifts}


def _polygon(arrays: dict[str, np.ndarray], reader: FileReader) -> Polygon | None:
    """Return the polygonal domain in the file; None without one."""
    prefix = "FieldData.domain_"
    values = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    if not values:
        return None
    if "vertices" in values:
        values["vertices"] = values["vertices"].reshape(-1, 3)[:, :2]
    return Polygon.described(**values, names=reader.names, curves=reader.curves)


def _set_walls(arrays: dict[str, np.ndarray], neighbors: np.ndarray, domain: Domain) -> None:
    """Set the edges at boundary faces that the file lists."""
    faces = _indices(arrays["FieldData.wall_faces"], len(neighbors), "wall_faces")
    edges = _indices(arrays["FieldData.wall_edges"], len(domain.boundary_index), "wall_edges")
    if len(faces) != len(edges):
        raise FileError("wall_faces and wall_edges differ in length")
    neighbors[faces] = -1 - edges


def _bridges(arrays: dict[str, np.ndarray], owner: np.ndarray, loops: np.ndarray) -> np.ndarray:
    """Return which pairs of consecutive corners (m, 2) are bridges between loops of a cell, and not faces.

    Without a list in the file, these are the pairs that the cell passes in both directions.
    """
    if "FieldData.bridges" in arrays:
        found = np.zeros(len(loops), bool)
        found[_indices(arrays["FieldData.bridges"], len(loops), "bridges")] = True
        return found
    low, high = loops.min(axis=1), loops.max(axis=1)
    order = np.lexsort((high, low, owner))
    same = np.all([np.diff(key[order]) == 0 for key in (owner, low, high)], axis=0)
    found = np.zeros(len(loops), bool)
    found[order[1:][same]] = found[order[:-1][same]] = True
    return found & (low < high)


def _indices(array: np.ndarray, bound: int, name: str) -> np.ndarray:
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise FileError(f"{name} are not indices")
    if len(array) and not (array.min() >= 0 and array.max() < bound):
        raise FileError(f"{name} have an index out of range")
    return array.astype(np.int64)


def _starts(ends: np.ndarray, total: int, name: str) -> np.ndarray:
    starts = np.concatenate([[0], _indices(ends, total + 1, name)])
    if starts[-1] != total or (np.diff(starts) < 3).any():
        raise FileError(f"{name} do not divide the list into cells")
    return starts


def _polygons(arrays: dict[str, np.ndarray], v: int) -> tuple[np.ndarray, np.ndarray]:
    corners = _indices(arrays["Cells.connectivity"], v, "corners")
    return _starts(arrays["Cells.offsets"], len(corners), "offsets"), corners


def _polyhedra(arrays: dict[str, np.ndarray], v: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the starts of cells in the faces, the starts of faces in the corners, and the corners."""
    stream = _indices(arrays["Cells.faces"], max(v, len(arrays["Cells.faces"])), "faces")
    ends = _starts(arrays["Cells.faceoffsets"], len(stream), "faceoffsets")
    counts, cells = array("q"), array("q", [0])  # places of the corner counts of faces
    for begin, end in pairwise(ends.tolist()):
        part = stream[begin:end].tolist()  # faster to index than an array
        at = 1
        for _ in range(part[0]):
            if at >= len(part):
                break
            counts.append(begin + at)
            at += 1 + part[at]
        if at != len(part) or len(counts) - cells[-1] != part[0]:
            raise FileError("faces differ from the counts of their cells")
        cells.append(len(counts))
    headers = np.array(counts, np.int64)
    faces = np.concatenate([[0], np.cumsum(stream[headers])])
    corners = np.delete(stream, np.concatenate([ends[:-1], headers]))
    return np.array(cells, np.int64), faces, _indices(corners, v, "corners of faces")


def _neighbors(owner: np.ndarray, starts: np.ndarray, corners: np.ndarray, x: np.ndarray, domain: Domain) -> np.ndarray:
    """Return the neighbor across each face: the cell with a face of the same corners, or else the nearest wall."""
    sides = np.diff(starts)
    face = np.repeat(np.arange(len(sides)), sides)
    ragged = corners[np.lexsort((corners, face))]
    result = np.full(len(sides), np.iinfo(np.int64).min)
    for k in np.unique(sides):
        rows = np.flatnonzero(sides == k)
        if k < 2:
            raise FileError("a face has fewer than 2 corners")
        keys = ragged[starts[rows][:, None] + np.arange(k)]
        by = np.lexsort(keys.T[::-1])
        same = (keys[by][1:] == keys[by][:-1]).all(axis=1)
        a, b = rows[by[:-1][same]], rows[by[1:][same]]
        result[a], result[b] = owner[b], owner[a]
    alone = np.flatnonzero(result < 0)
    sums = np.stack([np.bincount(face, column, len(sides)) for column in x[corners].T], axis=1)
    middle = sums[alone] / sides[alone][:, None]
    if isinstance(domain, SphereRegion):  # the wall is that of the removed cell across the face
        result[alone] = -1 - KDTree(domain.beyond).query(middle)[1]
        return result
    if isinstance(domain, Sphere):
        if len(alone):
            raise FileError(f"cell {owner[alone[0]]} has a face that is no other cell's")
        return result
    if isinstance(domain, Polygon):
        result[alone] = -1 - domain.nearest_edge(middle)[0]
        return result
    gaps = np.stack([middle - domain.lower, domain.upper - middle], axis=2)
    gaps[:, np.array(domain.periodic)] = np.inf  # seams are not walls
    gaps = gaps.reshape(len(alone), -1)
    result[alone] = -1 - gaps.argmin(axis=1)
    return result
