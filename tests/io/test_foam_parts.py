"""Decomposed cases of OpenFOAM, put together again, and checked by OpenFOAM's own program in parallel."""

import shutil
import subprocess

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError, InputTypeError
from clvoro.io.check_mesh import _DEBIAN, check_case
from clvoro.io.foam_parts import bisect
from tests.io.test_foam import entries, read

DOMAINS = {
    "plane": clvoro.Box((0, 0), (2, 1)),
    "periodic plane": clvoro.Box((0, 0), (1, 1), periodic=True),
    "space": clvoro.Box((0, 0, 0), (1, 1, 1)),
    "periodic space": clvoro.Box((0, 0, 0), (1, 1, 1), periodic=(True, False, True)),
}


@pytest.fixture(scope="module")
def meshes():
    adapter = clvoro.Adapter()
    return {
        name: adapter.run(domain, 0.17 if domain.dim == 2 else 0.21, method="lloyd", max_steps=30)
        for name, domain in DOMAINS.items()
    }


def numbers(path):
    return np.array(entries(path)[1].split(), int)


def parts_of(mesh):
    """Return three parts, equal ones or, in a periodic domain, two that meet at both seams of an axis."""
    x, y = mesh.points[:, 0], mesh.points[:, -1]
    return np.where(np.abs(x - 0.5) < 0.2, 0, 1 + ((x > 0.5) == (y > 0.6))) if any(mesh.domain.periodic) else 3


def loops_of(faces, points):
    return [np.array([points[v] for v in face]) for face in faces]


@pytest.mark.parametrize("name", DOMAINS)
def test_processors_have_the_whole_mesh_and_match_each_other(meshes, tmp_path, name):
    mesh, count = meshes[name], 3
    zones = {"left": mesh.points[:, 0] < 0.5}
    mesh.to_openfoam(tmp_path / "case.foam", processors=parts_of(mesh), zones=zones, check=False)
    points, faces, owner, neighbor, patches = read(tmp_path / "constant/polyMesh")
    seen, cells, between = np.zeros(len(faces), int), [], {}
    for p in range(count):
        folder = tmp_path / f"processor{p}/constant/polyMesh"
        x, f, own, nb, parts = read(folder)
        c, face, v = (numbers(folder / f"{kind}ProcAddressing") for kind in ("cell", "face", "point"))
        whole = np.abs(face) - 1
        cells.append(c)
        assert np.array_equal(x, points[v])
        for k, (loop, i) in enumerate(zip(f, face, strict=True)):
            there = faces[abs(i) - 1]
            assert v[loop].tolist() == (there if i > 0 else [there[0], *there[:0:-1]])
            assert c[own[k]] == (owner[i - 1] if i > 0 else neighbor[-i - 1])
        assert np.array_equal(c[nb], neighbor[whole[: len(nb)]])
        seen[whole] += 1
        assert list(parts)[: len(patches)] == list(patches)
        for patch, (kind, size, start, *_) in parts.items():
            rows = np.arange(start, start + size)
            if kind.startswith("processor"):
                between[patch] = kind, loops_of([f[k] for k in rows], x)
            else:
                assert kind == patches[patch][0]
                assert np.isin(whole[rows] - patches[patch][2], np.arange(patches[patch][1])).all()
    assert np.array_equal(np.sort(np.concatenate(cells)), np.arange(len(mesh)))
    assert any(mesh.domain.periodic) or max(map(len, cells)) - min(map(len, cells)) <= 1
    assert (seen[len(neighbor) :] == 1).all()
    loaded = clvoro.load(tmp_path / "case.foam")
    assert loaded.domain == mesh.domain
    assert np.array_equal(loaded.points, mesh.points)
    assert np.allclose(loaded.volumes, mesh.volumes, rtol=1e-12)
    orders = {}
    for patch, (kind, loops) in between.items():
        ends, _, seam = patch.removeprefix("procBoundary").partition("through")
        p, q = ends.split("to")
        across = seam.replace("Max", "*").replace("Min", "Max").replace("*", "Min")
        twin = f"procBoundary{q}to{p}" + f"through{across}" * bool(seam)
        assert between[twin][0] == kind
        orders.setdefault((p, q), []).append(patch if p < q else twin)
        for one, other in zip(loops, between[twin][1], strict=True):
            turned = np.concatenate([other[:1], other[:0:-1]])
            shift = (one - turned).round(9)
            assert (shift == shift[0]).all()
            assert bool(seam) == bool(np.abs(shift).max() > 0)
    assert all(orders[p, q] == orders[q, p] for p, q in orders), "OpenFOAM sends patch by patch"
    assert "procBoundary0to1" in between or "procBoundary0to2" in between


@pytest.mark.skipif(not shutil.which("checkMesh") or not shutil.which("mpirun.openmpi"), reason="needs OpenFOAM, MPI")
@pytest.mark.parametrize("name", ["periodic plane", "periodic space"])
def test_openfoam_accepts_them_in_parallel(meshes, tmp_path, name):
    meshes[name].to_openfoam(tmp_path / "case.foam", processors=parts_of(meshes[name]), check=False)
    assert check_case(tmp_path).ok
    command = ["mpirun.openmpi", "--allow-run-as-root", "--oversubscribe", "-n", "3", "checkMesh", "-parallel"]
    command += ["-allGeometry", "-allTopology", "-case", str(tmp_path)]
    settings = {"WM_PROJECT_DIR": str(_DEBIAN), "FOAM_ETC": str(_DEBIAN / "etc"), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(command, env=settings, capture_output=True, text=True, check=False)
    assert "Mesh OK." in done.stdout, done.stdout[-3000:] + done.stderr[-1000:]


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("laplacianFoam") or not shutil.which("mpirun.openmpi"), reason="needs OpenFOAM")
@pytest.mark.parametrize("name", ["periodic plane", "space", "periodic space"])
def test_a_solver_has_the_same_solution_in_parallel(meshes, tmp_path, name):
    """One implicit step of diffusion from random values, on one processor and on three."""
    mesh = meshes[name]
    mesh.to_openfoam(tmp_path / "case.foam", processors=3, check=False)
    cells = [numbers(tmp_path / f"processor{k}/constant/polyMesh/cellProcAddressing") for k in range(3)]
    before = np.random.default_rng(7).random(len(mesh))
    files = {
        "constant/transportProperties": "DT [0 2 -1 0 0 0 0] 0.01;",
        "system/controlDict": "startTime 0; endTime 1; deltaT 1; writeControl timeStep; writeInterval 1;"
        " writePrecision 16;",
        "system/fvSchemes": "ddtSchemes { default Euler; } gradSchemes { default Gauss linear; }"
        " divSchemes { default none; } laplacianSchemes { default Gauss linear uncorrected; }"
        " interpolationSchemes { default linear; } snGradSchemes { default uncorrected; }",
        "system/fvSolution": "solvers { T { solver PCG; preconditioner DIC; tolerance 1e-14; relTol 0; } }"
        " SIMPLE { nNonOrthogonalCorrectors 0; }",
    }
    kinds = ("cyclic", "empty", "processor", "processorCyclic")
    sides = " ".join(f"{kind} {{ type {kind}; value uniform 0; }}" for kind in kinds) + " wall { type zeroGradient; }"
    for folder, own in zip(("", "processor0/", "processor1/", "processor2/"), (slice(None), *cells), strict=True):
        values = " ".join(map(repr, before[own].tolist()))
        files[f"{folder}0/T"] = (
            f"dimensions [0 0 0 1 0 0 0]; internalField nonuniform List<scalar> {len(before[own])} ({values});"
            f" boundaryField {{ {sides} }}"
        )
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        kind = "volScalarField" if path.endswith("T") else "dictionary"
        about = f"FoamFile {{ version 2.0; format ascii; class {kind}; object {path.split('/')[-1]}; }}"
        (tmp_path / path).write_text(f"{about}\n{text}\n")
    settings = {"WM_PROJECT_DIR": str(_DEBIAN), "FOAM_ETC": str(_DEBIAN / "etc"), "PATH": "/usr/bin:/bin"}
    parallel = ["mpirun.openmpi", "--allow-run-as-root", "--oversubscribe", "-n", "3", "laplacianFoam", "-parallel"]
    for command in (["laplacianFoam"], parallel):
        done = subprocess.run(
            [*command, "-case", str(tmp_path)], env=settings, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]

    def solution(folder):
        return np.array((folder / "1/T").read_text().partition("(")[2].partition(")")[0].split(), float)

    whole = solution(tmp_path)
    assert np.abs(whole - before).max() > 0.01
    for k, own in enumerate(cells):
        assert np.abs(solution(tmp_path / f"processor{k}") - whole[own]).max() < 1e-11


def test_what_is_refused(meshes, tmp_path):
    """Each call works with what the error says."""
    mesh = meshes["plane"]
    n = len(mesh)
    mesh.to_openfoam(tmp_path / "case.foam", processors=np.arange(n) % 2)
    for processors in (2.5, "four"):
        with pytest.raises(InputTypeError, match="write processors=4"):
            mesh.to_openfoam(tmp_path / "case.foam", processors=processors)
    with pytest.raises(InputError, match=f"expected 1 to {n}, the number of cells; use fewer"):
        mesh.to_openfoam(tmp_path / "case.foam", processors=n + 1)
    for processors in (np.zeros(3, int), np.full(n, 2), np.full(n, -1)):
        with pytest.raises(InputError, match="expected one number from 0 on for each"):
            mesh.to_openfoam(tmp_path / "case.foam", processors=processors)
    with pytest.raises(InputError, match="processor1 of another decomposition; remove"):
        mesh.to_openfoam(tmp_path / "case.foam", processors=1)
    with pytest.raises(InputError, match="are beside the folder constant"):
        mesh.to_openfoam(tmp_path / "polyMesh", processors=2)
    shutil.rmtree(tmp_path / "processor0")
    shutil.rmtree(tmp_path / "processor1")
    mesh.to_openfoam(tmp_path / "case.foam", processors=1)


def test_bisection():
    x = np.random.default_rng(5).random((103, 3)) * (3, 1, 1)
    part = bisect(x, 5)
    assert np.ptp(np.bincount(part)) <= 1
    lengths = [np.ptp(x[part == k], axis=0)[0] for k in range(5)]
    assert max(lengths) < 1.3
