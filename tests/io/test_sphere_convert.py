"""Meshes on a sphere as meshes of meshio and PyVista: polygons with corners in 3D."""

import numpy as np
import pytest

import clvoro

SPHERE = clvoro.Sphere(2.0)


@pytest.fixture(scope="module")
def mesh(ctx):
    return clvoro.Adapter(ctx).run(SPHERE, 0.3)


def area(corners):
    """Area of a nearly flat polygon."""
    rest = corners[1:] - corners[0]
    return np.linalg.norm(np.cross(rest[:-1], rest[1:]).sum(axis=0)) / 2


def test_to_meshio(mesh):
    pytest.importorskip("meshio")
    n = len(mesh.points)
    found = mesh.to_meshio({"row": np.arange(n)})
    np.testing.assert_array_equal(found.points, mesh.diagram.vertices)
    rows = []
    for block, numbers, sizes in zip(found.cells, found.cell_data["row"], found.cell_data["size"], strict=True):
        rows += numbers.tolist()
        np.testing.assert_array_equal(sizes, mesh.target_size[numbers])
        for corners, row in zip(block.data, numbers, strict=True):
            # A flat cell of width 0.3 is smaller by about (0.3 / 2)^2 / 8 than on a sphere of radius 2.
            assert area(found.points[corners]) == pytest.approx(mesh.diagram.volumes[row], rel=0.02)
    assert sorted(rows) == list(range(n))


def test_to_pyvista(mesh):
    pytest.importorskip("pyvista")
    n = len(mesh.points)
    grid = mesh.to_pyvista({"row": np.arange(n)})
    assert grid.n_cells == n
    assert set(grid.celltypes) == {7}  # polygons
    np.testing.assert_array_equal(grid.points, mesh.diagram.vertices)
    np.testing.assert_array_equal(grid.cell_data["row"], np.arange(n))
    np.testing.assert_array_equal(grid.cell_data["generator"], mesh.points)
    for i in range(0, n, 7):
        np.testing.assert_array_equal(grid.get_cell(i).points, mesh.diagram.cell(i).vertices)
