"""Files: loading returns what was saved, other programs read them, and they are complete or unchanged."""

import csv
import dataclasses
import io as streams
import json
import os
import pickle
import stat
import time
import xml.etree.ElementTree as ElementTree
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import clvoro
from clvoro import io
from clvoro.errors import InputError, InputTypeError
from clvoro.geometry.box import Box
from clvoro.io import convert, npz
from clvoro.mesh.diagram import Diagram
from clvoro.mesh.results import HISTORY_DTYPE, Displacements, Result
from tests.reference import diagrams as reference

BOX = Box((-1.0, 0.5), (1.5, 2.0))


def make_diagram(points):
    """A Diagram of the reference cells; corners closer than 1e-9 are one vertex."""
    cells = reference.box_voronoi(BOX.lower, BOX.upper, points)
    corners = np.concatenate([cell.polygon for cell in cells])
    nexts = np.concatenate([np.roll(cell.polygon, -1, axis=0) for cell in cells])
    _, first, ids = np.unique(corners.round(9), axis=0, return_index=True, return_inverse=True)
    starts = np.cumsum([0] + [len(cell.polygon) for cell in cells]).astype(np.int32)
    return Diagram(
        BOX,
        {
            "points": points,
            "volumes": np.array([cell.area for cell in cells]),
            "centroids": np.array([cell.centroid for cell in cells]),
            "neighbor_starts": starts,
            "neighbors": np.concatenate([cell.neighbors for cell in cells]).astype(np.int32),
            "face_measures": np.linalg.norm(nexts - corners, axis=1),
            "face_centroids": (nexts + corners) / 2,
            "vertices": lambda: corners[first],  # fetched on first access, as from a device
            "cell_vertex_starts": starts,
            "cell_vertices": ids.ravel().astype(np.int32),
        },
    )


def make_result(n=40, seed=60211):
    rng = np.random.default_rng(seed)
    points = BOX.lower + rng.random((n, 2)) * BOX.extent
    history = np.zeros(3, HISTORY_DTYPE)
    for name in HISTORY_DTYPE.names:
        history[name] = rng.integers(0, 900, 3) / (7 if HISTORY_DTYPE[name].kind == "f" else 1)
    return Result(
        points=points,
        diagram=make_diagram(points),
        target_size=rng.random(n),
        size_error=rng.standard_normal(n),
        quality=rng.random(n),
        history=history,
        converged=True,
        stop_reason="tol — reached",
        size_factor=1.25,
        initial=Displacements(points, rng.random((n, 2)), rng.random((n, 2))),
        settings={"method": "coupled", "alpha": None, "k": 0.5, "seed": 7, "name": "a--b é <&>"},
    )


@pytest.fixture(scope="module")
def result():
    return make_result()


def assert_equal_results(a, b):
    for field in dataclasses.fields(Result):
        x, y = getattr(a, field.name), getattr(b, field.name)
        if field.name == "diagram":
            assert x.domain == y.domain
            for name in Diagram._NAMES:
                if name in x._arrays or name in y._arrays:
                    assert_same_array(getattr(x, name), getattr(y, name))
        elif isinstance(x, Displacements):
            for part in ("points", "lloyd", "poisson"):
                assert_same_array(getattr(x, part), getattr(y, part))
        elif isinstance(x, np.ndarray):
            assert_same_array(x, y)
        else:
            assert x == y


def assert_same_array(x, y):
    assert x.dtype == y.dtype
    np.testing.assert_array_equal(x, y)


# --- npz ---


@settings(max_examples=30)
@given(n=st.integers(1, 30), seed=st.integers(0, 10**6))
def test_npz_returns_what_was_saved(tmp_path_factory, n, seed):
    path = tmp_path_factory.mktemp("npz") / "mesh.npz"
    saved = make_result(n, seed)
    io.save(saved, path)
    assert_equal_results(saved, io.load(path))


def test_load_reads_vtu_too(result, tmp_path):
    io.save(result, tmp_path / "mesh.VTU")
    again = clvoro.load(tmp_path / "mesh.VTU")
    assert np.array_equal(again.diagram.volumes, result.diagram.volumes)
    assert np.array_equal(again.size_error, result.size_error)
    assert len(again.history) == 0


def test_diagrams_of_a_device_can_be_pickled_and_listed():
    points = np.random.default_rng(41).random((30, 2))
    diagram = clvoro.Adapter().diagram(clvoro.Box((0, 0), (1, 1)), points)
    again = pickle.loads(pickle.dumps(diagram))
    assert again.domain == diagram.domain
    for name in ("volumes", "neighbors", "vertices", "cell_vertices", "shifts"):
        assert name in dir(again)
        assert np.array_equal(getattr(again, name), getattr(diagram, name))
    assert "face_vertices" in dir(again)


def test_npz_knows_every_array_of_a_diagram():
    # A new array of Diagram needs an entry with its shape here.
    assert {f"diagram.{name}" for name in Diagram._NAMES} <= set(npz._SHAPES)


def test_npz_of_a_device_run(tmp_path):
    clvoro = pytest.importorskip("clvoro")
    ran = clvoro.Adapter().run(BOX, 0.3, n_cells=30, max_steps=2, options=clvoro.PaperOptions(tol=0), seed=331)
    ran.save(tmp_path / "mesh.npz")
    assert_equal_results(ran, io.load(tmp_path / "mesh.npz"))


def test_npz_is_repeatable_and_readable_by_numpy(result, tmp_path):
    io.save(result, tmp_path / "a.npz")
    io.save(result, tmp_path / "b.NPZ")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.NPZ").read_bytes()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert_same_array(arrays["diagram.volumes"], result.diagram.volumes)


def test_settings_of_types_without_json(result, tmp_path):
    odd = {"a": np.float64(0.1), "b": np.arange(3), "c": (1, 2), "d": len, "e": np.bool_(True)}
    io.save(dataclasses.replace(result, settings=odd), tmp_path / "a.npz")
    back = io.load(tmp_path / "a.npz").settings
    assert back == {"a": 0.1, "b": [0, 1, 2], "c": [1, 2], "d": repr(len), "e": True}


def members(path):
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def rewrite(path, changes):
    """Replace arrays of an .npz file; None removes one."""
    old = members(path)
    with zipfile.ZipFile(path, "w") as archive:
        for name in {**old, **{f"{key}.npy": b"" for key in changes}}:
            key = name.removesuffix(".npy")
            if key not in changes:
                archive.writestr(name, old[name])
            elif isinstance(changes[key], bytes):
                archive.writestr(name, changes[key])
            elif changes[key] is not None:
                stream = streams.BytesIO()
                np.save(stream, changes[key], allow_pickle=True)
                archive.writestr(name, stream.getvalue())


class Bomb:
    def __reduce__(self):
        return os.abort, ()


def huge_array():
    """A header of 2**62 floats without data."""
    stream = streams.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (2**62,)}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": np.array("somebody-elses")}, "its format is"),
        ({"format": None}, "is not a clvoro-result"),
        ({"version": np.array(99)}, "newer clvoro"),
        ({"version": np.array("one")}, "expected an integer"),
        ({"size_error": None}, "lacks size_error"),
        ({"size_error": np.zeros(41)}, "size_error has shape"),
        ({"size_error": np.array([Bomb()] * 40, dtype=object)}, "pickled"),
        ({"format": np.array(Bomb(), dtype=object)}, "pickled"),
        ({"size_error": huge_array()}, "does not have the length"),
        ({"size_error": b"no array at all"}, "is not an array"),
        ({"size_error": np.zeros(40, int)}, "size_error has dtype"),
        ({"history": np.zeros(3)}, "history has shape"),
        ({"about": np.array("{not json")}, "description is damaged"),
        ({"about": np.array('{"domain": {"kind": "PeriodicTessellator"}}')}, "'PeriodicTessellator'"),
        ({"about": np.array("7")}, "description is damaged"),
        ({"about": np.array("[" * 100000)}, "description is damaged"),
        ({"diagram.neighbors": None}, "lacks diagram.neighbors"),
        ({"diagram.neighbor_starts": np.arange(41)}, "does not divide"),
        ({"diagram.vertices": np.zeros((2, 2))}, "has an index out of range"),
        ({"diagram.points": np.zeros((40, 3))}, r"diagram.points has shape \(40, 3\)"),
    ],
)
def test_bad_npz_is_refused_with_its_name(result, tmp_path, changes, message):
    path = tmp_path / "bad.npz"
    io.save(result, path)
    rewrite(path, changes)
    with pytest.raises(InputError, match=message) as caught:
        io.load(path)
    assert str(path) in str(caught.value)


def test_foreign_and_missing_files_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "text.npz").write_text("step,error\n")
    (tmp_path / "empty.npz").write_bytes(b"")
    for name in ("other.npz", "text.npz", "empty.npz", "absent.npz"):
        with pytest.raises(InputError, match=f"cannot load .*{name}"):
            io.load(tmp_path / name)
    with pytest.raises(InputError, match="cannot load"):
        io.load(tmp_path)


def test_every_truncation_and_changed_byte_is_detected(result, tmp_path):
    path = tmp_path / "mesh.npz"
    io.save(result, path)
    whole = path.read_bytes()
    rng = np.random.default_rng(905)
    for length in rng.integers(0, len(whole), 60):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"mesh\.npz"):
            io.load(path)
    for place in rng.integers(0, len(whole), 200):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            back = io.load(path)
        except InputError:
            continue
        # Some bytes of a zip file have no effect: dates, attributes, extra fields.
        assert_same_array(back.size_error, result.size_error)
        assert_same_array(back.diagram.cell_vertices, result.diagram.cell_vertices)


def test_threads_read_headers_in_turn(tmp_path, monkeypatch):
    """Devices share a run in threads. In Python 3.11 two of them may fail if both parse a header at the same time."""
    parse, inside = np.lib.format.read_array_header_1_0, []

    def noted(stream):
        inside.append(stream)
        time.sleep(1e-3)
        assert inside == [stream]
        inside.clear()
        return parse(stream)

    monkeypatch.setattr(np.lib.format, "read_array_header_1_0", noted)
    np.save(tmp_path / "rows.npy", np.arange(3))
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(io.arrays.read_array, [tmp_path / "rows.npy"] * 4))
    assert np.array_equal(found, [np.arange(3)] * 4)


# --- other programs ---


def test_vtu_as_meshio_reads_it(result, tmp_path, meshio_for_vtu):
    path = tmp_path / "mesh.vtu"
    io.save(result, path)
    mesh = meshio_for_vtu.read(path)
    d = result.diagram
    np.testing.assert_array_equal(mesh.points[:, :2], d.vertices)
    # meshio makes a block of each run of cells with equally many sides, in their order.
    found = [list(cell) for block in mesh.cells for cell in block.data]
    s = d.cell_vertex_starts
    assert found == [list(d.cell_vertices[s[i] : s[i + 1]]) for i in range(len(d))]
    expected = {
        "size": result.target_size,
        "error": result.size_error,
        "quality": result.quality,
        "volume": d.volumes,
        "sides": np.diff(s),
    }
    for name, values in expected.items():
        np.testing.assert_array_equal(np.concatenate(mesh.cell_data[name]), values)
    generators = np.concatenate(mesh.cell_data["generator"])
    np.testing.assert_array_equal(generators[:, :2], result.points)
    assert not generators[:, 2].any()


def test_vtu_of_many_blocks(tmp_path, result, monkeypatch, meshio_for_vtu):
    # 40 sizes are 320 bytes: full blocks only, a partial last block, a single block.
    for block in (32, 96, 320, 1000):
        monkeypatch.setattr("clvoro.io.vtu._BLOCK", block)
        io.save(result, tmp_path / "mesh.vtu")
        mesh = meshio_for_vtu.read(tmp_path / "mesh.vtu")
        np.testing.assert_array_equal(np.concatenate(mesh.cell_data["size"]), result.target_size)


def test_vtu_settings_are_in_a_well_formed_head(result, tmp_path):
    io.save(result, tmp_path / "mesh.vtu")
    head, _ = (tmp_path / "mesh.vtu").read_bytes().split(b"<AppendedData")
    text = head.decode()
    ElementTree.fromstring(text + "</VTKFile>")
    settings = text.split("clvoro settings: ")[1].split(" -->")[0]
    assert json.loads(settings)["seed"] == 7


@pytest.mark.parametrize("suffix", convert._POLYGONS)
def test_formats_through_meshio_keep_every_polygon(result, tmp_path, suffix, capsys):
    meshio = pytest.importorskip("meshio")
    path = tmp_path / f"mesh{suffix}"
    io.save(result, path)
    assert capsys.readouterr().out == ""
    mesh = meshio.read(path)
    d = result.diagram
    s = d.cell_vertex_starts
    found = sorted(tuple(cell) for block in mesh.cells for cell in block.data)
    assert found == sorted(tuple(d.cell_vertices[s[i] : s[i + 1]]) for i in range(len(d)))
    # .obj and .ply are text with some 16 digits.
    np.testing.assert_allclose(mesh.points[:, :2], d.vertices, rtol=0, atol=1e-14)
    if convert._POLYGONS[suffix]:
        errors = np.sort(np.concatenate(mesh.cell_data["error"]))
        np.testing.assert_array_equal(errors, np.sort(result.size_error))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("name", ["mesh.stl", "mesh.xyz", "mesh"])
def test_formats_that_cannot_hold_polygons_are_refused(result, tmp_path, name):
    with pytest.raises(InputError, match=r"mesh.*\.vtu"):
        io.save(result, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_history_reads_back_exactly(result, tmp_path):
    path = tmp_path / "history.csv"
    io.write_history(result, path)
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(HISTORY_DTYPE.names)
    for name in HISTORY_DTYPE.names:
        assert [float(row[name]) for row in rows] == result.history[name].tolist()


# --- complete or unchanged ---

WRITERS = {"mesh.npz": io.save, "mesh.vtu": io.save, "mesh.vtk": io.save, "history.csv": io.write_history}


@pytest.mark.parametrize("name", WRITERS)
def test_failure_leaves_the_old_file_and_no_other(result, tmp_path, name, monkeypatch):
    path = tmp_path / name
    path.write_text("the old one")

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=f"{name}: No space left"):
        WRITERS[name](result, path)
    assert path.read_text() == "the old one"
    assert [p.name for p in tmp_path.iterdir()] == [name]

    def interrupted(handle):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        WRITERS[name](result, path)
    assert path.read_text() == "the old one"
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", WRITERS)
def test_success_replaces_the_old_file(result, tmp_path, name):
    path = tmp_path / "a folder" / name
    path.parent.mkdir()
    path.write_text("the old one")
    link = tmp_path / name
    link.symlink_to(path)
    WRITERS[name](result, link)
    assert link.is_symlink()
    assert path.stat().st_size > len("the old one")
    assert [p.name for p in path.parent.iterdir()] == [name]
    (tmp_path / "plain").write_text("")  # has the permissions of the umask
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def unwritable(tmp_path):
    """Paths where no file can be created, not even by root."""
    (tmp_path / "file").write_text("")
    return {
        tmp_path / "absent" / "mesh.npz": "create it first",
        tmp_path / "file" / "mesh.npz": "create it first",
        tmp_path / ("n" * 300 + ".npz"): "too long",
        "/dev/null": "not a regular file",
    }


@pytest.mark.skipif(os.name == "nt", reason="names of Unix")
def test_unwritable_places_are_named(result, tmp_path):
    for path, message in unwritable(tmp_path).items():
        for write in (io.check_writable, lambda p: io.write_history(result, p)):
            with pytest.raises(InputError, match=message) as caught:
                write(path)
            assert str(path) in str(caught.value)
    with pytest.raises(InputError, match="it is a folder"):
        io.write_history(result, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write")
def test_folder_without_the_right_to_write(tmp_path):
    tmp_path.chmod(0o500)
    for path in (tmp_path, tmp_path / "mesh.npz"):
        with pytest.raises(InputError, match="Permission denied"):
            io.check_writable(path)


def test_check_writable_leaves_nothing(tmp_path):
    io.check_writable(tmp_path)
    io.check_writable(tmp_path / "mesh.npz")
    assert not list(tmp_path.iterdir())
    (tmp_path / "old.npz").write_text("old")
    io.check_writable(tmp_path / "old.npz")
    assert (tmp_path / "old.npz").read_text() == "old"


def test_save_refuses_other_objects(result, tmp_path):
    with pytest.raises(InputTypeError, match=r"mesh is a ndarray, expected a clvoro.Result"):
        io.save(result.points, tmp_path / "mesh.npz")
