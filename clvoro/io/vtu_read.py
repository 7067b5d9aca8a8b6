"""Read the `.vtu` files that `vtu` writes, without trusting them.

The XML parser refuses document types and entities, so that nothing is expanded or fetched. The size of each array is
known from the numbers of points and cells, or bounded by the size of the file, before memory is allocated.
"""

from __future__ import annotations

import json
import os
import struct
import sys
import zlib
from array import array
from collections.abc import Iterator
from itertools import pairwise
from os import PathLike, fspath
from typing import NoReturn
from xml.parsers import expat

import numpy as np
from scipy.spatial import KDTree

from ..errors import InputError
from ..files import open_plain
from ..geometry.box import Box, Domain
from ..geometry.polygon import Polygon
from ..geometry.sphere import Sphere
from ..geometry.sphere_region import SphereRegion
from ..mesh.check.rebuilt import rebuild
from ..mesh.connectivity import following
from ..mesh.diagram import Diagram
from ..mesh.results import HISTORY_DTYPE, Result
from ..mesh.spherical import rebuild_on_sphere
from .arrays import EXPANSION, LEAST
from .vtu import CURVES, NAMES, SOLVER_MESH
from .vtu_checks import check_repeated

_LONGEST_HEAD = 1 << 22
_MARK = b'<AppendedData encoding="raw">\n_'
_END = b"\n</AppendedData>\n</VTKFile>\n"
_TYPES = {"Float64": "f8", "Float32": "f4", "Int32": "i4", "Int64": "i8", "UInt8": "u1"}
_BLOCK = 1 << 20
_OFF_SPHERE = 1e-5
"""Largest distance of a vertex from its sphere in units of the radius: round-off of float32, and more."""
_USED = {
    "Points.", "Cells.types", "Cells.connectivity", "Cells.offsets", "Cells.faces", "Cells.faceoffsets",
    "CellData.size", "CellData.error", "CellData.quality", "CellData.volume", "CellData.generator",
    "CellData.weight",
    "CellData.label", "CellData.sides", "CellData.faces_of_cell",
    "FieldData.box_corners", "FieldData.box_periodic",
    "FieldData.seam_faces", "FieldData.seam_neighbors", "FieldData.seam_shifts",
    "FieldData.domain_vertices", "FieldData.domain_ring_starts", "FieldData.domain_piece_of_ring",
    "FieldData.domain_edge_numbers", "FieldData.bridges", "FieldData.wall_faces", "FieldData.wall_edges",
    "FieldData.sphere_radius", "FieldData.region_within", "FieldData.region_beyond", "FieldData.region_area",
}  # fmt: skip


class _FileError(Exception):
    """The fault of a file. `load_vtu` adds the file's name."""


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
            head = file.read(_LONGEST_HEAD)
            end = head.find(_MARK)
            if end < 0:
                raise _FileError("it has no appended raw data, which files of clvoro have")
            start = end + len(_MARK)
            size = os.fstat(file.fileno()).st_size
            file.seek(max(0, size - len(_END)))
            if file.read() != _END:
                raise _FileError("it is truncated, or has bytes behind its end")
            reader = _Reader(head[:end], start, size)
            arrays = reader.read_all(file)
        return _assemble(arrays, reader)
    except _FileError as problem:
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
        raise InputError(
            f"cannot read {name}: it is damaged or not from clvoro ({error})"
        ) from error
    except OSError as error:
        raise InputError(f"cannot read {name}: {error.strerror or error}") from error


class _Reader:
    """The head of a file: its arrays and their places."""

    def __init__(self, head: bytes, start: int, size: int) -> None:
        self.start, self.size = start, size
        self.left = max(LEAST, EXPANSION * size)  # bytes that arrays may still expand to
        self.there = size  # bytes of the file that no array has used
        self.points = self.cells = -1
        self.compressed = False
        self.entries: dict[str, tuple[str, int, int]] = {}
        self.names: dict[str, list[int]] | None = None
        self.curves: list[object] | None = None
        self._within: list[str] = []
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = self._refuse
        parser.EntityDeclHandler = self._refuse
        parser.StartElementHandler = self._element
        parser.EndElementHandler = lambda _: self._within.pop()
        parser.CommentHandler = self._comment
        parser.Parse(head, False)
        if min(self.points, self.cells) < 0:
            raise _FileError("it has no piece with points and cells")

    def _refuse(self, *_: object) -> NoReturn:
        raise _FileError("it declares a document type or entities, which files of clvoro do not")

    def _comment(self, text: str) -> None:
        text = text.strip()
        if text == SOLVER_MESH:
            raise _FileError(
                "it holds the mesh for solvers, which is no diagram; load a .npz file, or a .vtu file with exact walls"
            )
        if text.startswith(NAMES):
            self.names = json.loads(text.removeprefix(NAMES))
        if text.startswith(CURVES):
            self.curves = json.loads(text.removeprefix(CURVES))

    def _element(self, tag: str, given: dict[str, str]) -> None:
        if tag == "VTKFile":
            native = f"{sys.byteorder.title()}Endian"
            if given.get("type") != "UnstructuredGrid" or given.get("byte_order") != native:
                raise _FileError(f"it is not an UnstructuredGrid in {native}")
            if given.get("header_type") != "UInt64":
                raise _FileError("its header_type is not UInt64")
            compressor = given.get("compressor")
            if compressor not in (None, "vtkZLibDataCompressor"):
                raise _FileError(f"its compressor is {compressor!r:.60}")
            self.compressed = compressor is not None
        elif tag == "Piece":
            self.points, self.cells = int(given["NumberOfPoints"]), int(given["NumberOfCells"])
        elif tag == "DataArray":
            group = self._within[-1] if self._within else ""
            name = given.get("Name", "") if group != "Points" else ""
            if given.get("format") != "appended" or given["type"] not in _TYPES:
                raise _FileError(f"its array {name!r:.60} is not appended, or of an unknown type")
            width = int(given.get("NumberOfComponents", "1"))
            key = f"{group}.{name}"
            if width not in (1, 3) and key in _USED:
                raise _FileError(f"its array {name!r:.60} has {width} components")
            if key in self.entries:
                raise _FileError(f"it has two arrays {key!r:.60}")
            self.entries[key] = (_TYPES[given["type"]], width, int(given["offset"]))
        self._within.append(tag)

    def read_all(self, file) -> dict[str, np.ndarray]:
        """Return the arrays that a mesh needs, by group and name."""
        used = {name: entry for name, entry in self.entries.items() if name in _USED}
        return {name: self._read(file, name, *entry) for name, entry in used.items()}

    def _read(self, file, name: str, kind: str, width: int, offset: int) -> np.ndarray:
        if not 0 <= offset <= self.size - self.start - 8:
            raise _FileError(f"{name} is beyond the end of the file")
        file.seek(self.start + offset)
        if self.compressed:
            raw = bytearray()
            for block in self._blocks(file, name):
                raw += block
        else:
            (length,) = struct.unpack("=Q", file.read(8))
            raw = self._take(file, name, length)
        array = np.frombuffer(raw, kind)  # raises unless the length is a multiple of the item size
        if width > 1:
            array = array.reshape(-1, width)
        rows = {"Points": self.points, "CellData": self.cells}.get(name.split(".")[0])
        if name in ("Cells.offsets", "Cells.types", "Cells.faceoffsets"):
            rows = self.cells
        if rows is not None and len(array) != rows:
            raise _FileError(f"{name} has {len(array)} entries, expected {rows}")
        return array

    def _take(self, file, name: str, length: int) -> bytes:
        """Read `length` bytes; refuse more than the file has, and bytes of other arrays."""
        if length > self.size - file.tell():
            raise _FileError(f"{name} is truncated")
        self.there -= length
        if self.there < 0:
            raise _FileError("its arrays overlap")
        return file.read(length)

    def _blocks(self, file, name: str) -> Iterator[bytes]:
        count, block, partial = struct.unpack("=3Q", self._take(file, name, 24))
        if not 0 < block <= _BLOCK or partial >= block:
            raise _FileError(f"{name} has blocks of {block} bytes")
        sizes = struct.unpack(f"={count}Q", self._take(file, name, 8 * min(count, self.size)))
        # Checked before any block is expanded.
        self.left -= (count - 1) * block + (partial or block) if count else 0
        if self.left < 0:
            raise _FileError(f"it expands to more than {EXPANSION} times its size")
        for k, size in enumerate(sizes):
            expected = partial if k == count - 1 and partial else block
            part = zlib.decompressobj()
            data = part.decompress(self._take(file, name, size), expected)
            if len(data) != expected or part.decompress(part.unconsumed_tail, 1):
                raise _FileError(f"block {k} of {name} does not have the length in its table")
            yield data


def _assemble(arrays: dict[str, np.ndarray], reader: _Reader) -> Result | Diagram:
    vertices = arrays["Points."].astype(float)
    kinds = arrays["Cells.types"]
    if not len(kinds) or not len(vertices) or not np.isfinite(vertices).all():
        raise _FileError("it has no cells, or vertices that are not finite")
    flat = bool((kinds == 7).all())
    if not flat and not (kinds == 42).all():
        raise _FileError("its cells are neither all polygons nor all polyhedra")
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
        points=points, diagram=diagram, target_size=size, size_error=error, quality=quality,
        history=np.zeros(0, HISTORY_DTYPE), converged=False, stop_reason="read from a .vtu file",
    )  # fmt: skip


def _domain(arrays: dict[str, np.ndarray], x: np.ndarray, reader: _Reader) -> Domain:
    """Return the domain in the file, or else the bounding box of the vertices."""
    if "FieldData.sphere_radius" in arrays:
        return _sphere(arrays, x, reader)
    lower, upper, dim = x.min(axis=0), x.max(axis=0), x.shape[1]
    if not (lower < upper).all():
        raise _FileError("its vertices lie on a line")
    if "FieldData.box_periodic" in arrays:
        return _periodic_box(arrays, dim, reader.names)
    polygon = _polygon(arrays, reader) if dim == 2 else None
    return polygon or Box(tuple(lower), tuple(upper), names=reader.names)


def _sphere(arrays: dict[str, np.ndarray], x: np.ndarray, reader: _Reader) -> Sphere:
    """Return the sphere in the file, or the part of it, on which all vertices and generators must be."""
    radius = arrays["FieldData.sphere_radius"]
    if radius.shape != (1,) or radius.dtype.kind != "f":
        raise _FileError(f"sphere_radius has shape {radius.shape} and dtype {radius.dtype}")
    sphere = Sphere(float(radius[0]))
    for name, places in (("vertices", x), ("generators", arrays["CellData.generator"])):
        if not (np.abs(np.linalg.norm(places, axis=1) / sphere.radius - 1) < _OFF_SPHERE).all():
            raise _FileError(f"its {name} are not on the {sphere}")
    if "FieldData.region_beyond" not in arrays:
        return sphere
    within, beyond, area = (arrays[f"FieldData.region_{k}"] for k in ("within", "beyond", "area"))
    if area.shape != (1,):
        raise _FileError(f"region_area has shape {area.shape}")
    return SphereRegion(
        sphere.radius, within=within, beyond=beyond, area=float(area[0]), names=reader.names
    )


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
        "neighbor_starts": cell_starts, "face_vertex_starts": starts, "face_vertices": corners, "starts": starts,
        "corners": corners,
    }  # fmt: skip


def _periodic_box(
    arrays: dict[str, np.ndarray], dim: int, names: dict[str, list[int]] | None
) -> Box:
    """Return the periodic box in the file."""
    corners = arrays["FieldData.box_corners"].reshape(2, 3)[:, :dim].astype(float)
    axes = arrays["FieldData.box_periodic"]
    if axes.shape != (dim,):
        raise _FileError(f"box_periodic has shape {axes.shape}, expected ({dim},)")
    return Box(*corners.tolist(), periodic=tuple(bool(a) for a in axes), names=names)


def _seam(
    arrays: dict[str, np.ndarray], neighbors: np.ndarray, dim: int, n: int
) -> dict[str, np.ndarray]:
    """Set the neighbors across the seams, where faces share no corners, and return the shifts."""
    faces = _indices(arrays["FieldData.seam_faces"], len(neighbors), "seam_faces")
    others = _indices(arrays["FieldData.seam_neighbors"], n, "seam_neighbors")
    steps = arrays["FieldData.seam_shifts"].reshape(-1, 3)[:, :dim]
    if not len(faces) == len(others) == len(steps) or (np.abs(steps.astype(float)) > 1).any():
        raise _FileError("its seams differ from its cells")
    neighbors[faces] = others
    shifts = np.zeros((len(neighbors), dim), np.int8)
    shifts[faces] = steps
    return {"shifts": shifts}


def _polygon(arrays: dict[str, np.ndarray], reader: _Reader) -> Polygon | None:
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
        raise _FileError("wall_faces and wall_edges differ in length")
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
        raise _FileError(f"{name} are not indices")
    if len(array) and not (array.min() >= 0 and array.max() < bound):
        raise _FileError(f"{name} have an index out of range")
    return array.astype(np.int64)


def _starts(ends: np.ndarray, total: int, name: str) -> np.ndarray:
    starts = np.concatenate([[0], _indices(ends, total + 1, name)])
    if starts[-1] != total or (np.diff(starts) < 3).any():
        raise _FileError(f"{name} do not divide the list into cells")
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
            raise _FileError("faces differ from the counts of their cells")
        cells.append(len(counts))
    headers = np.array(counts, np.int64)
    faces = np.concatenate([[0], np.cumsum(stream[headers])])
    corners = np.delete(stream, np.concatenate([ends[:-1], headers]))
    return np.array(cells, np.int64), faces, _indices(corners, v, "corners of faces")


def _neighbors(
    owner: np.ndarray, starts: np.ndarray, corners: np.ndarray, x: np.ndarray, domain: Domain
) -> np.ndarray:
    """Return the neighbor across each face: the cell with a face of the same corners, or else the nearest wall."""
    sides = np.diff(starts)
    face = np.repeat(np.arange(len(sides)), sides)
    ragged = corners[np.lexsort((corners, face))]
    result = np.full(len(sides), np.iinfo(np.int64).min)
    for k in np.unique(sides):
        rows = np.flatnonzero(sides == k)
        if k < 2:
            raise _FileError("a face has fewer than 2 corners")
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
            raise _FileError(f"cell {owner[alone[0]]} has a face that is no other cell's")
        return result
    if isinstance(domain, Polygon):
        result[alone] = -1 - domain.nearest_edge(middle)[0]
        return result
    gaps = np.stack([middle - domain.lower, domain.upper - middle], axis=2)
    gaps[:, np.array(domain.periodic)] = np.inf  # seams are not walls
    gaps = gaps.reshape(len(alone), -1)
    result[alone] = -1 - gaps.argmin(axis=1)
    return result
