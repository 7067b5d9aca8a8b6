"""Files of three-dimensional meshes: polyhedra for VTK, and everything for `clvoro.load`."""

import dataclasses
import itertools
import json
import struct
import xml.etree.ElementTree as ElementTree
import zlib

import numpy as np
import pytest

from clvoro import io
from clvoro.connectivity import take_rows
from clvoro.errors import InputError
from clvoro.io.contents import describe
from clvoro.io.vtu import largest_boundary, polyhedra
from clvoro.mesh.diagram import Diagram
from tests.io.test_io import assert_equal_results, assert_same_array, rewrite
from tests.reference import solids

LOWER, UPPER = (-1.0, 0.0, 2.0), (1.0, 1.0, 3.5)


@pytest.fixture(scope="module")
def diagram():
    points = np.random.default_rng(40503).uniform(LOWER, UPPER, (90, 3))
    return solids.solid_diagram(LOWER, UPPER, points)


@pytest.fixture(scope="module")
def lattice():
    return solids.cubes()


@pytest.fixture(scope="module")
def result(diagram):
    return solids.solid_result(diagram)


def changed(diagram, **arrays):
    return Diagram(diagram.domain, {**diagram._arrays, **arrays})


def loops_of(diagram):
    starts, corners = diagram.half_faces.corners
    return [corners[a:b].tolist() for a, b in itertools.pairwise(starts)]


def with_faces(diagram, counts, neighbors, loops):
    """Return `diagram` with other faces: how many each cell has, their neighbors and their corners."""
    return changed(
        diagram,
        neighbor_starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        neighbors=neighbors,
        face_vertex_starts=np.cumsum([0] + [len(loop) for loop in loops]).astype(np.int32),
        face_vertices=np.concatenate(loops).astype(np.int32),
    )


def decode(stream, ends):
    """The faces of every cell from VTK's stream of numbers."""
    cells, place = [], 0
    for end in ends:
        faces = []
        count = stream[place]
        place += 1
        for _ in range(count):
            k = stream[place]
            faces.append(stream[place + 1 : place + 1 + k].tolist())
            place += 1 + k
        assert place == end
        cells.append(faces)
    return cells


def enclosed_volume(vertices, faces):
    """Volume inside a closed surface of plane polygons, counter-clockwise as seen from outside."""
    return sum(vertices[f[0]] @ solids.loop_area(vertices[f]) for f in faces) / 3


def test_polyhedra_are_the_cells(diagram, lattice):
    for d in (diagram, lattice):
        arrays = polyhedra(d)
        cells = decode(arrays["faces"], arrays["faceoffsets"])
        loops, starts = loops_of(d), d.neighbor_starts
        assert cells == [loops[a:b] for a, b in itertools.pairwise(starts)]
        corners = np.split(arrays["connectivity"], arrays["offsets"][:-1])
        for faces, listed, volume in zip(cells, corners, d.volumes, strict=True):
            assert listed.tolist() == sorted({v for face in faces for v in face})
            # Round-off of sums of 15 products of coordinates up to 4.
            assert enclosed_volume(d.vertices, faces) == pytest.approx(volume, abs=1e-12)


def test_faces_without_measure_are_left_out(lattice):
    # Cell 0 gets, to the cell diagonally across, a face of two corners, and one that repeats a corner.
    loops, first = loops_of(lattice), 6
    inserted = [[0, 1], [4, 4, 5]]
    loops[first:first] = inserted
    counts = np.diff(lattice.neighbor_starts) + np.r_[2, [0] * 23]
    d = with_faces(lattice, counts, np.insert(lattice.neighbors, first, [5, 7]), loops)
    for name, array in polyhedra(lattice).items():
        assert_same_array(polyhedra(d)[name], array)
    assert [len(loop) for loop in loops_of(d)[5:9]] == [4, 0, 0, 4]
    assert len(d.faces.owner) == len(lattice.faces.owner)


def test_take_rows_forwards_and_backwards():
    starts, items = np.array([0, 3, 3, 7]), np.arange(10, 17)
    taken, found = take_rows(starts, items, np.array([2, 0, 1]), np.array([True, False, True]))
    assert taken.tolist() == [0, 4, 7, 7]
    assert found.tolist() == [13, 16, 15, 14, 10, 11, 12]


def test_faces_once_has_each_face_once(diagram):
    faces, owner = diagram.faces, diagram.half_faces.owner
    pairs = {
        (min(i, j), max(i, j)) if j >= 0 else (i, j)
        for i, j in zip(owner.tolist(), diagram.neighbors.tolist(), strict=True)
    }
    found = list(zip(faces.owner.tolist(), faces.neighbor.tolist(), strict=True))
    assert len(found) == len(pairs)
    assert set(found) == pairs
    assert found[: faces.n_inner] == sorted(p for p in pairs if p[1] >= 0)
    assert found[faces.n_inner :] == sorted((p for p in pairs if p[1] < 0), key=lambda p: (-p[1], p[0]))


def test_a_face_of_one_cell_only_is_reversed(diagram):
    owner, neighbor = diagram.half_faces.owner, diagram.neighbors
    lost = np.flatnonzero((owner < neighbor) & (owner == 20))[0]
    kept = np.arange(len(owner)) != lost
    loops = [loop for loop, keep in zip(loops_of(diagram), kept, strict=True) if keep]
    counts = np.bincount(owner[kept], minlength=len(diagram))
    d = with_faces(diagram, counts, neighbor[kept], loops)
    whole, partial = diagram.faces, d.faces
    assert_same_array(whole.owner, partial.owner)
    assert_same_array(whole.neighbor, partial.neighbor)
    (k,) = np.flatnonzero((whole.owner == 20) & (whole.neighbor == neighbor[lost]))
    one, two = (f.corners[f.starts[k] : f.starts[k + 1]].tolist() for f in (whole, partial))
    turn = two.index(one[0])
    assert two[turn:] + two[:turn] == one


def appended_arrays(path):
    """The arrays of a .vtu file by name, read by the documentation of the format."""
    head, data = path.read_bytes().split(b'<AppendedData encoding="raw">\n_', 1)
    root = ElementTree.fromstring(head.decode() + "</VTKFile>")
    kinds = {"Float64": "f8", "Int32": "i4", "Int64": "i8", "UInt8": "u1"}
    arrays = {}
    for element in root.iter("DataArray"):
        place = int(element.get("offset"))
        count, size, last = struct.unpack_from("=3Q", data, place)
        packed = struct.unpack_from(f"={count}Q", data, place + 24)
        place += 24 + 8 * count
        blocks = []
        for length in packed:
            blocks.append(zlib.decompress(data[place : place + length]))
            place += length
        assert [len(b) for b in blocks[:-1]] == [size] * (count - 1)
        assert len(blocks[-1]) == last or last == 0
        raw = b"".join(blocks)
        array = np.frombuffer(raw, kinds[element.get("type")])
        width = int(element.get("NumberOfComponents", 1))
        arrays[element.get("Name", "points")] = array.reshape(-1, width) if width > 1 else array
    piece = root.find("UnstructuredGrid/Piece")
    assert int(piece.get("NumberOfPoints")) == len(arrays["points"])
    assert int(piece.get("NumberOfCells")) == len(arrays["types"])
    return arrays


def test_vtu_holds_cells_and_data(result, tmp_path):
    io.save(result, tmp_path / "mesh.vtu")
    arrays = appended_arrays(tmp_path / "mesh.vtu")
    d = result.diagram
    expected = {
        **polyhedra(d),
        "points": d.vertices,
        "types": np.full(len(d), 42, np.uint8),
        "size": result.target_size,
        "error": result.size_error,
        "quality": result.quality,
        "volume": d.volumes,
        "faces_of_cell": np.diff(d.neighbor_starts),
        "label": np.arange(len(d), dtype=np.int32),
        "boundary": largest_boundary(d),
        "generator": d.points,
        "domain": np.frombuffer(json.dumps(describe(d.domain)).encode(), np.uint8),
        "neighbors": d.neighbors,
    }
    assert set(arrays) == set(expected)
    for name, values in expected.items():
        assert_same_array(arrays[name], values)


def test_vtu_as_vtk_reads_it(result, tmp_path):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    io.save(result, tmp_path / "mesh.vtu")
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(tmp_path / "mesh.vtu"))
    reader.Update()
    grid = reader.GetOutput()
    errors = vtk_to_numpy(grid.GetCellData().GetArray("error"))
    np.testing.assert_array_equal(errors, result.size_error)
    check = vtk.vtkCellValidator()
    check.SetInputData(grid)
    check.Update()
    assert not vtk_to_numpy(check.GetOutput().GetCellData().GetArray("ValidityState")).any()
    for i, volume in enumerate(result.diagram.volumes):
        cell, polygons = grid.GetCell(i), vtk.vtkCellArray()
        for k in range(cell.GetNumberOfFaces()):
            polygons.InsertNextCell(cell.GetFace(k).GetPointIds())
        surface, triangles, mass = (vtk.vtkPolyData(), vtk.vtkTriangleFilter(), vtk.vtkMassProperties())
        surface.SetPoints(grid.GetPoints())
        surface.SetPolys(polygons)
        triangles.SetInputData(surface)
        mass.SetInputConnection(triangles.GetOutputPort())
        # Tolerance as for the volume above. VTK's filter for cell sizes is wrong for some polyhedra.
        assert mass.GetVolume() == pytest.approx(volume, abs=1e-12)


def test_npz_returns_what_was_saved(result, tmp_path):
    io.save(result, tmp_path / "mesh.npz")
    back = io.load(tmp_path / "mesh.npz")
    assert_equal_results(result, back)
    assert_same_array(back.diagram.face_vertices, result.diagram.face_vertices)
    with pytest.raises(AttributeError, match="a diagram in 3D has no cell_vertices"):
        _ = back.diagram.cell_vertices


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"diagram.face_vertices": None}, "lacks diagram.face_vertices"),
        ({"diagram.face_vertex_starts": np.arange(91)}, "one row per face"),
        ({"diagram.face_vertex_starts": np.zeros(91)}, "has dtype float64"),
        ({"diagram.vertices": np.zeros((5, 3))}, "face_vertices has an index out of range"),
        ({"diagram.vertices": np.zeros((500, 2))}, "differs from the other arrays"),
    ],
)
def test_bad_npz_is_refused(result, tmp_path, changes, message):
    path = tmp_path / "bad.npz"
    io.save(result, path)
    rewrite(path, changes)
    with pytest.raises(InputError, match=message):
        io.load(path)


@pytest.mark.parametrize("name", ["mesh.vtk", "mesh.ply", "mesh.stl", "mesh"])
def test_formats_of_polygons_are_refused(result, tmp_path, name):
    with pytest.raises(InputError, match=r"mesh.*\.vtu"):
        io.save(result, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_one_cell(tmp_path):
    d = solids.solid_diagram((0, 0, 0), (1, 2, 3), np.array([[0.3, 0.7, 0.9]]))
    one = dataclasses.replace(solids.solid_result(d), stop_reason="one")
    for name in ("mesh.vtu", "mesh.npz"):
        io.save(one, tmp_path / name)
    one.to_openfoam(tmp_path / "mesh.foam", check=False)
    assert_equal_results(one, io.load(tmp_path / "mesh.npz"))
    assert enclosed_volume(d.vertices, loops_of(d)) == pytest.approx(6)
