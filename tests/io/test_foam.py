"""OpenFOAM's polyMesh: read back by its documentation, with the checks of checkMesh."""

import collections
import os
import re
import shutil
import warnings
from dataclasses import replace

import numpy as np
import pytest

import clvoro
from clvoro import Polygon, io
from clvoro.arguments import format_point
from clvoro.errors import InputError, InputTypeError
from clvoro.finite_volumes.gate import rejection
from clvoro.io import foam
from clvoro.io.check_mesh import check_case
from clvoro.io.foam_read import check_polymesh
from tests.io.test_io import make_result
from tests.reference import solids

LOWER, UPPER = (-1.0, 0.0, 2.0), (1.0, 1.0, 3.5)


@pytest.fixture(scope="module")
def solid():
    points = np.random.default_rng(61403).uniform(LOWER, UPPER, (80, 3))
    return solids.solid_result(solids.solid_diagram(LOWER, UPPER, points))


@pytest.fixture(scope="module")
def plane():
    return make_result(60, 31733)


@pytest.fixture(params=["solid", "plane"])
def result(request):
    return request.getfixturevalue(request.param)


def entries(path):
    """Length and text of the list in a file of OpenFOAM."""
    text = path.read_text()
    head, body = text.split("}", 1)
    assert f"object      {path.name};" in head
    count, _, rest = body.strip().partition("\n(\n")
    return int(count), rest.rsplit("\n)", 1)[0]


def read(folder):
    """The mesh in `folder`: points, loops, owner, neighbor, patches (name: type, faces, start)."""
    count, text = entries(folder / "points")
    points = np.array([row.strip("()").split() for row in text.splitlines()], float)
    assert points.shape == (count, 3)
    count, text = entries(folder / "faces")
    faces = []
    for row in text.splitlines():
        number, corners = re.fullmatch(r"(\d+)\(([\d ]+)\)", row).groups()
        faces.append([int(v) for v in corners.split()])
        assert len(faces[-1]) == int(number)
    assert len(faces) == count
    lists = []
    for name in ("owner", "neighbour"):
        count, text = entries(folder / name)
        lists.append(np.array(text.split(), int))
        assert len(lists[-1]) == count
    count, text = entries(folder / "boundary")
    found = re.findall(r"([\w-]+)\s*\{(.*?)\}", text, re.DOTALL)
    assert len(found) == count
    patches = {}
    for name, body in found:
        about = dict(re.findall(r"(\w+) +([^;]+);", body))
        patches[name] = about.pop("type"), int(about.pop("nFaces")), int(about.pop("startFace"))
        patches[name] += (about,) if about else ()
    return points, faces, *lists, patches


@pytest.fixture
def mesh(result, tmp_path):
    folder = tmp_path / "constant" / "polyMesh"
    result.to_openfoam(folder, walls="exact", check=False)
    assert {p.name for p in folder.iterdir()} == {"points", "faces", "owner", "neighbour", "boundary"}
    return read(folder)


def prism_volumes(result, points):
    d = result.diagram
    return d.volumes if d.domain.dim == 3 else d.volumes * points[:, 2].max()


@pytest.mark.sparse(1)
def test_order_is_upper_triangular(mesh):
    _, _, owner, neighbor, _ = mesh
    inner = list(zip(owner[: len(neighbor)].tolist(), neighbor.tolist(), strict=True))
    assert inner == sorted(set(inner))
    assert all(i < j for i, j in inner)


def volumes_of_closed_cells(points, faces, owner, neighbor):
    """Check that areas of each cell add up to 0, and that each of its edges is in two faces; return its volume."""
    areas = np.array([solids.loop_area(points[f]) for f in faces])
    # The mean of the corners of a concave face is not its centroid, but in its plane.
    cones = (areas * np.array([points[f].mean(axis=0) for f in faces])).sum(axis=1) / 3
    openness, volumes, edges = np.zeros((max(owner) + 1, 3)), np.zeros(max(owner) + 1), collections.Counter()
    for cells, sign in ((owner, 1), (neighbor, -1)):
        np.add.at(openness, cells, sign * areas[: len(cells)])
        np.add.at(volumes, cells, sign * cones[: len(cells)])
        for cell, face in zip(cells, faces, strict=False):
            edges.update((cell, min(a, b), max(a, b)) for a, b in zip(face, face[1:] + face[:1], strict=True))
    # Round-off of sums of 20 products of coordinates below 4.
    assert np.abs(openness).max() < 1e-12
    assert set(edges.values()) == {2}
    return volumes


def test_cells_are_closed_and_faces_point_away_from_their_owners(result, mesh):
    points, faces, owner, neighbor, _ = mesh
    volumes = volumes_of_closed_cells(points, faces, owner, neighbor)
    np.testing.assert_allclose(volumes, prism_volumes(result, points), rtol=0, atol=1e-11)
    generators = np.pad(result.points, ((0, 0), (0, 3 - result.points.shape[1])))
    areas = np.array([solids.loop_area(points[f]) for f in faces[: len(neighbor)]])
    away = generators[neighbor] - generators[owner[: len(neighbor)]]
    assert (np.einsum("ij,ij->i", areas, away) > 0).all()


def test_patches_are_the_walls(result, mesh):
    points, faces, owner, neighbor, patches = mesh
    box = result.diagram.domain
    depth = points[:, 2].max() if box.dim == 2 else 1.0
    after = len(neighbor)
    for number, (name, (kind, count, start)) in enumerate(patches.items()):
        assert start == after
        after += count
        part = faces[start : start + count]
        assert sorted(owner[start : start + count]) == list(owner[start : start + count])
        area = sum(solids.loop_area(points[f]) for f in part)
        if name in ("front", "back"):
            assert kind == "empty"
            assert owner[start : start + count].tolist() == list(range(len(result.points)))
            assert area == pytest.approx([0, 0, (1 if name == "front" else -1) * box.measure])
        else:
            axis, upper = divmod(number, 2)
            assert name == "xyz"[axis] + ("Max" if upper else "Min")
            assert kind == "wall"
            plane = (box.upper if upper else box.lower)[axis]
            on_wall = points[sorted({v for f in part for v in f}), axis]
            assert on_wall == pytest.approx(plane, abs=1e-14)  # round-off of Qhull
            wanted = box.measure / box.extent[axis] * depth * (1 if upper else -1)
            assert area == pytest.approx(wanted * np.eye(3)[axis], abs=1e-12)
    assert after == len(faces)
    assert len(patches) == 6
    assert sorted({v for f in faces for v in f}) == list(range(len(points)))


def test_text_does_not_depend_on_the_size_of_parts(solid, tmp_path, monkeypatch):
    io.save(solid, tmp_path / "one" / "polyMesh")
    monkeypatch.setattr(foam, "_CHUNK", 37)
    io.save(solid, tmp_path / "two" / "polyMesh")
    for path in (tmp_path / "one" / "polyMesh").iterdir():
        assert (tmp_path / "two" / "polyMesh" / path.name).read_bytes() == path.read_bytes()


def read_binary(folder, name):
    """The arrays in a binary file of OpenFOAM, one after another: int32, or points in float64."""
    head, body = (folder / name).read_bytes().split(b"}\n\n", 1)
    fields = dict(re.findall(r"(\w+) +(.+);", head.decode()))
    assert fields["format"] == "binary"
    assert fields["arch"] == '"LSB;label=32;scalar=64"'
    item = np.dtype((np.float64, 3) if name == "points" else np.int32)
    arrays = []
    while body:
        count, body = body.split(b"\n", 1)
        end = int(count) * item.itemsize
        if int(count):
            assert (body[:1], body[end + 1 : end + 3]) == (b"(", b")\n")
            body, rest = body[1 : end + 1], body[end + 3 :]
        arrays.append(np.frombuffer(body if int(count) else b"", item.base).reshape(-1, *item.shape))
        body = rest if int(count) else body
    return fields["class"], arrays


def test_binary_files_hold_the_same(result, tmp_path):
    io.save(result, tmp_path / "text" / "polyMesh")
    result.to_openfoam(tmp_path / "bytes" / "polyMesh", binary=True)
    points, faces, owner, neighbor, _ = read(tmp_path / "text" / "polyMesh")
    folder = tmp_path / "bytes" / "polyMesh"
    for name, values in (("points", points), ("owner", owner), ("neighbour", neighbor)):
        (found,) = read_binary(folder, name)[1]
        np.testing.assert_array_equal(found, values)
    kind, (starts, corners) = read_binary(folder, "faces")
    assert kind == "faceCompactList"
    assert np.diff(starts).tolist() == [len(face) for face in faces]
    assert corners.tolist() == [v for face in faces for v in face]
    twin = tmp_path / "text" / "polyMesh" / "boundary"
    assert (folder / "boundary").read_bytes() == twin.read_bytes()


def test_a_marker_file_puts_the_mesh_into_its_case(solid, tmp_path):
    tmp_path = tmp_path / "made" / "as needed"
    io.save(solid, tmp_path / "case.foam")
    assert (tmp_path / "case.foam").read_bytes() == b""
    io.save(solid, tmp_path / "polyMesh")
    for path in (tmp_path / "polyMesh").iterdir():
        twin = tmp_path / "constant" / "polyMesh" / path.name
        assert twin.read_bytes() == path.read_bytes()


@pytest.mark.parametrize("binary", [False, True])
def test_as_vtk_reads_it(result, binary, tmp_path):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    result.to_openfoam(tmp_path / "case.foam", walls="exact", binary=binary, check=False)
    (tmp_path / "system").mkdir()
    (tmp_path / "system" / "controlDict").write_text(
        "FoamFile { version 2.0; format ascii; class dictionary; object controlDict; }\n"
        "startTime 0; endTime 1; deltaT 1; writeInterval 1;\n"
    )
    reader = vtk.vtkOpenFOAMReader()
    reader.SetFileName(str(tmp_path / "case.foam"))
    sizes = vtk.vtkCellSizeFilter()
    sizes.SetInputConnection(reader.GetOutputPort())
    sizes.Update()
    found = vtk_to_numpy(sizes.GetOutput().GetBlock(0).GetCellData().GetArray("Volume"))
    result.to_openfoam(tmp_path / "polyMesh", walls="exact", check=False)
    volumes = prism_volumes(result, read(tmp_path / "polyMesh")[0])
    # VTK stores these points in single precision, and orients wedges in two ways.
    np.testing.assert_allclose(np.abs(found), volumes, rtol=0, atol=1e-4 * volumes.mean())


def check_mesh(result, folder, **settings):
    """What checkMesh prints for a result saved in `folder` with some settings, good or not."""
    result.to_openfoam(folder / "case.foam", check=False, **settings)
    return check_case(folder).text


needs_openfoam = pytest.mark.skipif(shutil.which("checkMesh") is None, reason="OpenFOAM is not installed")


@pytest.mark.slow
@needs_openfoam
@pytest.mark.parametrize("binary", [False, True])
def test_as_openfoam_checks_it(result, binary, tmp_path):
    said = check_mesh(result, tmp_path, binary=binary)
    topology = said.split("Checking topology...")[1].split("Checking geometry...")
    assert "***" not in topology[0]
    for line in ("Boundary openness", "Max cell openness", "Cell volumes", "Face pyramids"):
        assert re.search(f"{line}.*OK", topology[1]), line


def test_types_of_patches_are_the_callers(plane, tmp_path):
    types = {"xMin": "patch", "zone": "symmetryPlane"}
    plane.to_openfoam(tmp_path / "polyMesh", patches={"zone": ["yMin"]}, types=types)
    patches = read(tmp_path / "polyMesh")[-1]
    kinds = {name: patch[0] for name, patch in patches.items()}
    assert kinds == {
        "zone": "symmetryPlane",
        "xMin": "patch",
        "xMax": "wall",
        "yMax": "wall",
        "back": "empty",
        "front": "empty",
    }


def test_thickness_is_the_callers(plane, tmp_path):
    plane.to_openfoam(tmp_path / "polyMesh", thickness=0.25)
    assert set(read(tmp_path / "polyMesh")[0][:, 2].tolist()) == {0, 0.25}
    io.save(plane, tmp_path / "polyMesh")
    width = np.sqrt(plane.diagram.domain.measure / len(plane.points))
    assert read(tmp_path / "polyMesh")[0][:, 2].max() == width


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"types": {"yMin": "inlet"}}, "types has 'inlet' for yMin, expected one of wall, patch, symmetry"),
        ({"types": {"floor": "wall"}}, "types has 'floor', expected names of patches: xMin, xMax, yMin, yMax"),
        ({"types": ["wall"]}, "types is .* of type list, expected a mapping"),
        ({"thickness": 0}, "thickness is 0, expected a finite number > 0"),
        ({"thickness": "thin"}, "thickness is 'thin'"),
    ],
)
def test_wrong_options_are_refused(plane, tmp_path, options, says):
    with pytest.raises((InputError, InputTypeError), match=says):
        plane.to_openfoam(tmp_path / "polyMesh", **options)
    assert not list(tmp_path.iterdir())


def test_failure_leaves_the_old_mesh(solid, tmp_path, monkeypatch):
    folder = tmp_path / "polyMesh"
    folder.mkdir()
    for name in ("points", "faces", "cellZones"):
        (folder / name).write_text("old")

    def full(handle):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(InputError, match="No space left"):
            io.save(solid, folder)
    assert {p.name: p.read_text() for p in folder.iterdir()} == {"points": "old", "faces": "old", "cellZones": "old"}
    io.save(solid, folder)
    assert len(read(folder)[2]) > 0
    assert not (folder / "cellZones").exists()  # of another mesh


@pytest.mark.parametrize("rows", [1, 2])
def test_meshes_that_openfoam_rejects_are_refused(ctx, tmp_path, rows):
    """All faces between the cells of one row are parallel; two cells are too few to tilt them."""
    x, y = np.meshgrid([0.5, 1.5], np.arange(rows) + 0.5)
    domain = Polygon([(0, 0), (2, 0), (2, rows), (0, rows)])
    diagram = clvoro.Adapter(ctx).diagram(domain, np.column_stack([x.ravel(), y.ravel()]))
    assert bool(diagram.check(solver="openfoam")) == (rows == 2)
    if rows == 1:
        said = (
            r"rejects this mesh: determinant is 0, expected at least 0\.001 at \(0\.5, 0\.5\); .*\(path, check=False\)"
        )
        with pytest.raises(InputError, match=said):
            diagram.save(tmp_path / "polyMesh")
        assert not list(tmp_path.iterdir())
    diagram.to_openfoam(tmp_path / "polyMesh", check=rows == 2)
    assert (tmp_path / "polyMesh" / "faces").is_file()


def judged_domains():
    """Cells at walls with a needle between them, or none; cells far larger than their neighbors."""
    x, y = np.meshgrid(np.arange(9) + 0.5, np.arange(9) + 0.5)
    rng = np.random.default_rng(2)
    points = np.column_stack([x.ravel(), y.ravel()]) + rng.uniform(-0.1, 0.1, (81, 2))
    for name, needle in (("smooth", []), ("needle", [(5, 9), (4.9, 5.3), (4.8, 9)])):
        domain = Polygon([(0, 0), (9, 0), (9, 9), *needle, (0, 9)])
        yield name, domain, points[domain.covers(points)]
    for dim in (2, 3):
        for periodic in (False, True):
            yield "uneven", clvoro.Box((0,) * dim, (1,) * dim, periodic=periodic), rng.random((90, dim)) ** 4
    yield (
        "smooth",
        clvoro.Box((0, 0, 0), (1, 1, 1)),
        np.stack(np.meshgrid(*[np.arange(4) / 4 + 0.125] * 3), -1).reshape(-1, 3),
    )


@pytest.mark.parametrize(("name", "domain", "points"), list(judged_domains()))
def test_meshes_are_judged_as_by_all_criteria(ctx, name, domain, points):
    diagram = clvoro.Adapter(ctx).diagram(domain, points)
    mesh, report = diagram.solver_mesh(), diagram.check(solver="openfoam")
    why = rejection(mesh)
    failed = [c for c in report.criteria if c.demanded and not c.ok]
    print(name, domain, [(c.name, c.value) for c in failed])
    assert bool(why) == bool(failed)
    for c in failed[:1]:
        assert f"{c.name} is {c.value:.3g}, " in why
        assert format_point(c.place) in why
        if domain.dim == 3 and not any(domain.periodic):  # as solids, which have layers
            assert "layers on fewer boundaries" in rejection(replace(mesh, layer=np.zeros(mesh.n_cells, np.int16)))


@pytest.mark.parametrize("binary", ["no", 2, None])
def test_binary_is_a_truth_value(plane, tmp_path, binary):
    """A text such as "no" would be true."""
    with pytest.raises(InputTypeError, match=r"binary is .*, expected True or False"):
        foam.write_foam(io.contents.Contents.of(plane), tmp_path / "polyMesh", binary=binary)
    assert not list(tmp_path.iterdir())


PERIODIC = [(True, False), True]


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize(
    "domain",
    [
        clvoro.Box((0, 0, 0), (1, 1, 1), periodic=(True, False, False)),
        *(clvoro.Box((0, 0), (2, 1), periodic=sides) for sides in PERIODIC),
        Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]),
    ],
    ids=["solid", "channel", "torus", "L"],
)
def test_a_written_mesh_is_checked_as_the_mesh_itself(domain, binary, tmp_path):
    points = domain.lower + np.random.default_rng(5).random((40 if domain.dim == 2 else 60, domain.dim)) * domain.extent
    mesh = clvoro.voronoi(domain, points[domain.contains(points)])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh.to_openfoam(tmp_path / "polyMesh", binary=binary)
    made, own = check_polymesh(tmp_path / "polyMesh"), mesh.check(solver="openfoam")
    assert [c.name for c in made.criteria] == [c.name for c in own.criteria]
    for one, other in zip(made.criteria, own.criteria, strict=True):
        assert one.count == other.count
        assert one.value == pytest.approx(other.value, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("points", lambda text: text[: len(text) // 2], "damaged|numbers"),
        ("owner", lambda text: text.replace("\n0\n", "\n-1\n"), "do not fit"),
        ("faces", lambda text: text.replace("4(", "3(", 1), "expected as many|damaged"),
        ("boundary", lambda text: text.replace("nFaces", "faces"), "nFaces"),
        ("neighbour", lambda text: "solid", "no head FoamFile"),
        ("points", None, "cannot be read"),
    ],
)
def test_damaged_meshes_are_refused(plane, tmp_path, name, change, says):
    plane.to_openfoam(tmp_path / "polyMesh")
    file = tmp_path / "polyMesh" / name
    if change is None:
        file.unlink()
    else:
        file.write_text(change(file.read_text()))
    with pytest.raises(InputError, match=says):
        check_polymesh(tmp_path / "polyMesh")
