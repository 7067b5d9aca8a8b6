"""OpenFOAM's polyMesh of periodic boxes: cyclic patches connect the cells at the seams."""

import os
import re
import shutil
import subprocess

import numpy as np
import pytest

import clvoro
from clvoro import io
from tests.io.test_foam import check_mesh, needs_openfoam, read, volumes_of_closed_cells

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
    result.to_openfoam(tmp_path / "polyMesh", walls="exact")
    return read(tmp_path / "polyMesh")


def cyclic(patches):
    return {name: patch for name, patch in patches.items() if patch[0] == "cyclic"}


@pytest.mark.sparse(2)
def test_cells_are_whole_and_closed(result, mesh):
    points, faces, owner, neighbor, _ = mesh
    box, volumes = result.diagram.domain, volumes_of_closed_cells(points, faces, owner, neighbor)
    depth = np.ptp(points[:, 2]) if box.dim == 2 else 1.0
    np.testing.assert_allclose(volumes, result.diagram.volumes * depth, rtol=0, atol=1e-11)
    assert volumes.sum() == pytest.approx(box.measure * depth, rel=1e-12)


@pytest.mark.sparse(2)
def test_there_is_one_pair_of_patches_for_each_periodic_direction(result, mesh):
    box = result.diagram.domain
    axes = [axis for axis, is_periodic in zip("xyz", box.periodic, strict=False) if is_periodic]
    assert list(cyclic(mesh[-1])) == [f"{axis}{end}" for axis in axes for end in ("Max", "Min")]


@pytest.mark.sparse(2)
def test_both_sides_of_a_seam_are_images_in_the_same_order(result, mesh):
    points, faces, owner, _, patches = mesh
    box, d = result.diagram.domain, result.diagram
    joined = 0
    for name, (_, size, start, about) in cyclic(patches).items():
        _, twins, there, back = cyclic(patches)[about["neighbourPatch"]]
        assert twins == size
        assert back["neighbourPatch"] == name
        steps = set()
        for k in range(size):
            face, twin = faces[start + k], faces[there + k]
            # In reverse order, with the same first corner.
            images = points[[twin[0], *twin[:0:-1]]]
            away = np.rint((images - points[face]).mean(axis=0)[: box.dim] / box.extent)
            steps.add(tuple(away.astype(int).tolist()))
            moved = points[face] + np.pad(away * box.extent, (0, 3 - box.dim))
            assert moved == pytest.approx(images, abs=1e-14)
            i, j = owner[start + k], owner[there + k]
            row = slice(*d.neighbor_starts[i : i + 2])
            same = (d.neighbors[row] == j) & (d.shifts[row] == -away).all(axis=1)
            assert same.sum() == 1
            joined += 1
        # The first direction in which a face is shifted is that of its patch.
        axis = "xyz".index(name[0])
        assert all(step[:axis] == (0,) * axis for step in steps)
        assert all(step[axis] == (-1 if name.endswith("Max") else 1) for step in steps)
        if len(steps) == 1:
            assert about["transform"] == "translational"
            vector = np.array(about["separationVector"].strip("()").split(), float)
            assert vector[: box.dim] == pytest.approx(np.array(*steps) * box.extent, abs=1e-15)
        else:
            assert about["transform"] == "noOrdering"
    assert joined == np.count_nonzero(d.shifts.any(axis=1))


def test_only_walls_are_patches(result, mesh):
    points, faces, _, _, patches = mesh
    box = result.diagram.domain
    walls = {name: patch for name, patch in patches.items() if patch[0] == "wall"}
    wanted = [f"{'xyz'[a]}{end}" for a in range(box.dim) if not box.periodic[a] for end in ("Min", "Max")]
    assert list(walls) == wanted
    for name, (_, size, start) in walls.items():
        axis = "xyz".index(name[0])
        plane = (box.upper if name.endswith("Max") else box.lower)[axis]
        corners = sorted({v for f in faces[start : start + size] for v in f})
        assert size > 0
        assert points[corners, axis] == pytest.approx(plane, abs=1e-14)


@pytest.mark.sparse(2)
@needs_openfoam
def test_as_openfoam_checks_it(result, tmp_path):
    said = check_mesh(result, tmp_path)
    assert "***" not in said.split("Checking topology...")[1].split("Checking geometry...")[0]
    for line in ("Boundary openness", "Cell volumes", "Face pyramids", "Coupled point location match"):
        assert re.search(f"{line}.*OK", said), line


def test_one_cell_is_its_own_neighbor(ctx, tmp_path):
    box = clvoro.Box((0, 0), (1, 2), periodic=True)
    diagram = clvoro.Adapter(ctx).diagram(box, np.array([[0.3, 0.4]]))
    mesh, patches, _ = io.foam.poly_mesh(diagram)
    assert mesh.n_inner == 0
    assert {p.name for p in patches} == {"xMin", "xMax", "yMin", "yMax", "back", "front"}


@pytest.mark.sparse(2)
@needs_openfoam
@pytest.mark.skipif(shutil.which("laplacianFoam") is None, reason="laplacianFoam is not installed")
def test_openfoam_conducts_heat_across_the_seams(result, tmp_path):
    """One implicit step of diffusion agrees with one computed from the diagram."""
    check_mesh(result, tmp_path, walls="exact")
    d, box = result.diagram, result.diagram.domain
    n, conductivity = len(d), 0.01
    before = np.random.default_rng(7).random(n)
    patches = read(tmp_path / "constant" / "polyMesh")[-1]
    kinds = {"cyclic": "cyclic", "empty": "empty", "wall": "zeroGradient"}
    sides = " ".join(f"{name} {{ type {kinds[p[0]]}; }}" for name, p in patches.items())
    values = "\n".join(map(repr, before.tolist()))
    files = {
        "0/T": (
            "volScalarField",
            f"dimensions [0 0 0 1 0 0 0]; internalField nonuniform List<scalar> {n} ({values}); "
            f"boundaryField {{ {sides} }}",
        ),
        "constant/transportProperties": ("dictionary", f"DT [0 2 -1 0 0 0 0] {conductivity};"),
        "system/controlDict": (
            "dictionary",
            "startTime 0; endTime 1; deltaT 1; writeControl timeStep; writeInterval 1; writePrecision 16;",
        ),
        "system/fvSchemes": (
            "dictionary",
            "ddtSchemes { default Euler; } gradSchemes { default Gauss linear; } "
            "divSchemes { default none; } laplacianSchemes { default Gauss linear uncorrected; } "
            "interpolationSchemes { default linear; } snGradSchemes { default uncorrected; }",
        ),
        "system/fvSolution": (
            "dictionary",
            "solvers { T { solver PCG; preconditioner DIC; tolerance 1e-14; relTol 0; "
            "} } SIMPLE { nNonOrthogonalCorrectors 0; }",
        ),
    }
    for name, (kind, text) in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        about = f"version 2.0; format ascii; class {kind}; object {name.split('/')[1]};"
        (tmp_path / name).write_text(f"FoamFile {{ {about} }}\n{text}\n")
    env = {"WM_PROJECT_DIR": "/usr/share/openfoam", **os.environ}
    command = ["laplacianFoam", "-case", str(tmp_path)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    after = re.search(r"List<scalar>\s*\d+\s*\(([^)]*)\)", (tmp_path / "1" / "T").read_text())
    owner = np.repeat(np.arange(n), np.diff(d.neighbor_starts))
    inner = d.neighbors >= 0
    i, j, shift = owner[inner], d.neighbors[inner], d.shifts[inner] * box.extent
    normal = d.points[j] + shift - d.points[i]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    along = ((d.centroids[j] + shift - d.centroids[i]) * normal).sum(axis=1)
    flux = conductivity * d.face_measures[inner] / along
    matrix = np.diag(d.volumes + np.bincount(i, flux, n))
    np.add.at(matrix, (i, j), -flux)
    expected = np.linalg.solve(matrix, d.volumes * before)
    assert np.array(after[1].split(), float) == pytest.approx(expected, abs=1e-11)
    assert np.abs(expected - before).max() > 0.1
