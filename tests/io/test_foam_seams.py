"""OpenFOAM's polyMesh of periodic boxes: what is cut at the seams is joined by cyclic patches."""

import re

import numpy as np
import pytest

import clvoro
from clvoro import io
from tests.io.test_foam import check_mesh, needs_openfoam, read
from tests.reference import solids

DOMAINS = {
    "2D, both": clvoro.Box((0, 0), (2, 1), periodic=True),
    "2D, x": clvoro.Box((-1, 3), (1, 4), periodic=(True, False)),
    "3D, all": clvoro.Box((0, 0, 0), (1, 1, 1.2), periodic=True),
    "3D, x and z": clvoro.Box((0, 0, 0), (1, 1, 1.2), periodic=(True, False, True)),
}


@pytest.fixture(scope="module", params=DOMAINS)
def result(request, ctx):
    domain = DOMAINS[request.param]
    adapter = clvoro.Adapter(ctx)
    return adapter.run(domain, 0.15 if domain.dim == 2 else 0.2, method="coupled", max_steps=8)


@pytest.fixture
def mesh(result, tmp_path):
    io.save(result, tmp_path / "polyMesh")
    return read(tmp_path / "polyMesh")


def cyclic(patches):
    return {name: patch for name, patch in patches.items() if patch[0] == "cyclic"}


def test_cells_are_whole_and_closed(result, mesh):
    points, faces, owner, neighbor, _ = mesh
    box, n = result.diagram.domain, len(result.points)
    areas = np.array([solids.loop_area(points[f]) for f in faces])
    middles = np.array([points[f].mean(axis=0) for f in faces])
    openness, volumes = np.zeros((n, 3)), np.zeros(n)
    np.add.at(openness, owner, areas)
    np.add.at(openness, neighbor, -areas[: len(neighbor)])
    flux = np.einsum("ij,ij->i", areas, middles) / 3
    np.add.at(volumes, owner, flux)
    np.add.at(volumes, neighbor, -flux[: len(neighbor)])
    # Sums of some 20 products of coordinates below 4, each rounded.
    assert np.abs(openness).max() < 1e-12
    depth = np.ptp(points[:, 2]) if box.dim == 2 else 1.0
    np.testing.assert_allclose(volumes, result.diagram.volumes * depth, rtol=0, atol=1e-11)
    assert volumes.sum() == pytest.approx(box.measure * depth, rel=1e-12)


def test_both_sides_of_a_seam_are_images_in_the_same_order(result, mesh):
    points, faces, owner, _, patches = mesh
    box = result.diagram.domain
    joined = 0
    for name, (_, size, start, about) in cyclic(patches).items():
        assert about["transform"] == "translational"
        _, twins, there, back = cyclic(patches)[about["neighbourPatch"]]
        assert twins == size
        assert back["neighbourPatch"] == name
        away = np.array(about["separationVector"].strip("()").split(), float)
        assert (away == -np.array(back["separationVector"].strip("()").split(), float)).all()
        periods = away[: box.dim] / box.extent
        assert set(periods) <= {-1.0, 0.0, 1.0}
        assert not periods[~np.array(box.periodic)].any()
        for axis, step in zip("xyz", periods, strict=False):
            assert (f"{axis}Max" in name, f"{axis}Min" in name) == (step < 0, step > 0)
        for k in range(size):
            face, twin = faces[start + k], faces[there + k]
            # The other way around, from the same corner on.
            images = points[[twin[0], *twin[:0:-1]]]
            assert points[face] + away == pytest.approx(images, abs=1e-14)
            i, j = owner[start + k], owner[there + k]
            row = slice(*result.diagram.neighbor_starts[i : i + 2])
            same = (result.diagram.neighbors[row] == j) & (
                result.diagram.shifts[row] == -periods
            ).all(axis=1)
            assert same.sum() == 1
            joined += 1
    assert joined == np.count_nonzero(result.diagram.shifts.any(axis=1))


def test_only_walls_are_patches(result, mesh):
    points, faces, _, _, patches = mesh
    box = result.diagram.domain
    walls = {name: patch for name, patch in patches.items() if patch[0] == "patch"}
    wanted = [
        f"{'xyz'[a]}{end}" for a in range(box.dim) if not box.periodic[a] for end in ("Min", "Max")
    ]
    assert list(walls) == wanted
    for name, (_, size, start) in walls.items():
        axis = "xyz".index(name[0])
        plane = (box.upper if name.endswith("Max") else box.lower)[axis]
        corners = sorted({v for f in faces[start : start + size] for v in f})
        assert size > 0
        assert points[corners, axis] == pytest.approx(plane, abs=1e-14)


@needs_openfoam
def test_as_openfoam_checks_it(result, tmp_path):
    said = check_mesh(result, tmp_path)
    assert "***" not in said.split("Checking topology...")[1].split("Checking geometry...")[0]
    for line in (
        "Boundary openness",
        "Cell volumes",
        "Face pyramids",
        "Coupled point location match",
    ):
        assert re.search(f"{line}.*OK", said), line


def test_one_cell_is_its_own_neighbor(ctx, tmp_path):
    box = clvoro.Box((0, 0), (1, 2), periodic=True)
    diagram = clvoro.Adapter(ctx).diagram(box, np.array([[0.3, 0.4]]))
    mesh = io.polymesh.poly_mesh(diagram)
    assert len(mesh.neighbor) == 0
    assert {p.name for p in mesh.patches} == {"xMin", "xMax", "yMin", "yMax", "back", "front"}
