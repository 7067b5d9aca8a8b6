"""CGNS files: the tree of nodes, read by h5py, has the cells, boundaries and data of the mesh."""

import numpy as np
import pytest

import clvoro
from clvoro.mesh.geometry import cell_geometry, face_geometry
from tests.reference.solids import solid_diagram

h5py = pytest.importorskip("h5py")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    diagram = solid_diagram((0, 0, 0), (2, 1, 1), np.random.default_rng(3).random((60, 3)) * (2, 1, 1))
    path = tmp_path_factory.mktemp("cgns") / "mesh.cgns"
    diagram.save(path, cell_data={"depth": diagram.points[:, 2]})
    with h5py.File(path) as file:
        yield diagram, file["Base/Zone"]


def value(group, path):
    return group[f"{path}/ data"][()]


def test_cells_are_those_of_the_mesh(made):
    diagram, zone = made
    points = np.stack([value(zone, f"GridCoordinates/Coordinate{axis}") for axis in "XYZ"], axis=1)
    starts, corners = value(zone, "Faces/ElementStartOffset"), value(zone, "Faces/ElementConnectivity") - 1
    owner, neighbor = value(zone, "Faces/ParentElements") - 1 - (len(starts) - 1)
    n = len(diagram)
    assert zone[" data"][:, 0].tolist() == [len(points), n, 0]
    centers, areas = face_geometry(points, starts, corners)
    inner = np.flatnonzero(neighbor >= 0)
    _, volumes = cell_geometry(centers, areas, owner, neighbor[inner], n)
    assert volumes == pytest.approx(diagram.solver_mesh().volumes, rel=1e-12)
    # Each cell lists its faces, those of which it is the neighbor with a minus.
    begin, faces = value(zone, "Cells/ElementStartOffset"), value(zone, "Cells/ElementConnectivity")
    cell = np.repeat(np.arange(n), np.diff(begin))
    face = np.abs(faces) - 1
    assert np.array_equal(np.where(faces > 0, owner[face], neighbor[face]), cell)
    assert value(zone, "Cells/ElementRange").tolist() == [len(owner) + 1, len(owner) + n]


def test_boundaries_have_names_and_ranges(made):
    diagram, zone = made
    mesh = diagram.solver_mesh()
    first = mesh.n_inner
    for name in diagram.domain.boundary_names:
        (low,), (high,) = value(zone, f"ZoneBC/{name}/PointRange")  # one index, then two points
        assert low == first + 1
        assert (mesh.neighbor[low - 1 : high] == mesh.neighbor[low - 1]).all()
        assert zone[f"ZoneBC/{name}"].attrs["label"] == b"BC_t"
        first = high
    assert first == len(mesh)


def test_data_are_those_of_the_cells(made):
    diagram, zone = made
    assert value(zone, "CellData/depth") == pytest.approx(diagram.points[:, 2], abs=0)
    assert value(zone, "CellData/volume").shape == (len(diagram),)
    assert zone["CellData"].attrs["label"] == b"FlowSolution_t"


def test_planar_cells_become_prisms(tmp_path, ctx):
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Box((0, 0), (1, 1)), np.random.default_rng(1).random((9, 2)))
    diagram.save(tmp_path / "flat.cgns")
    with h5py.File(tmp_path / "flat.cgns") as file:
        assert {"front", "back"} <= set(file["Base/Zone/ZoneBC"])
