"""Cases of OpenFOAM that follow a solution: their fields, one cycle, and loops that are interrupted."""

import gzip
import json
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest

import clvoro
from clvoro import foam, sizing
from clvoro.cli.command import main
from clvoro.errors import ClvoroError, InputError, InputTypeError, LostFieldsWarning
from clvoro.foam import case as cases
from clvoro.foam import transfer
from clvoro.foam.case import FoamCase
from clvoro.foam.mesh import FoamMesh, polygon_of_edges
from clvoro.foam.transfer import MOST_DIVERGENCE, _along_line, divergence
from clvoro.io import foam_read

HOLE = [(0.9, 0.4), (1.1, 0.4), (1.1, 0.6), (0.9, 0.6)]
DOMAIN = clvoro.Polygon(
    [(0, 0), (3, 0), (3, 1), (0, 1)], [HOLE], names={"walls": [0, 2], "outlet": 1, "inlet": 3, "body": range(4, 8)}
)
TEXT = b"""FoamFile { version 2.0; format ascii; class volVectorField; object U; }
// a comment; with { signs
dimensions [0 1 -1 0 0 0 0];
internalField nonuniform List<vector> 2((1 2 3) (4 -5e-3 6));
boundaryField
{
    inlet { type fixedValue; value uniform (1 0 0); table { file "a b"; coeffs (1 2); } }
    "wall.*" { type noSlip; }
    back { type empty; value nonuniform 0(); }
    out { type calculated; value nonuniform List<vector> 3{(1 1 1)}; }
}
"""


def test_fields_are_read_and_written(tmp_path):
    path = tmp_path / "U"
    path.write_bytes(TEXT)
    field = foam.read_field(path)
    assert (field.name, field.type, field.in_cells, field.dimensions[:3]) == ("U", "vector", True, (0, 1, -1))
    assert field.internal.numbers.tolist() == [[1, 2, 3], [4, -5e-3, 6]]
    assert field.patches["inlet"]["value"].rows(3).tolist() == [[1, 0, 0]] * 3
    assert field.patches["inlet"]["table"] == {"file": b'"a b"', "coeffs": b"(1 2)"}
    assert field.patches["out"]["value"].numbers.tolist() == [[1, 1, 1]] * 3
    for binary in (False, True):
        made = foam.FoamField(field.name, field.kind, binary, field.entries)
        made.write(tmp_path / "again", "5")
        (tmp_path / "packed.gz").write_bytes(gzip.compress((tmp_path / "again").read_bytes()))
        for name in ("again", "packed.gz"):
            again = foam.read_field(tmp_path / name)
            assert again.binary is binary
            assert again.internal.numbers.tolist() == field.internal.numbers.tolist()
            assert list(again.patches) == list(field.patches)
            assert again.patches["back"]["value"].numbers.shape == (0, 3)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        (b"FoamFile", b"File", "no head"),
        (b"(4 -5e-3 6));", b"(4 -5e-3));", "has 5 numbers, expected 6"),
        (b"3{(1 1 1)};", b"3{(1 1 1)}", "no"),
        (b"dimensions [", b'#include "other"\ndimensions [', "only OpenFOAM reads"),
        (b"List<vector> 2(", b"List<label> 2(", "type label"),
        (b"uniform (1 0 0)", b"uniform $inflow", "begins with [$], which only OpenFOAM reads"),
    ],
)
def test_damaged_fields_are_refused(tmp_path, old, new, text):
    path = tmp_path / "U"
    path.write_bytes(TEXT.replace(old, new))
    with pytest.raises(InputError, match=text):
        foam.read_field(path)


def test_fields_of_a_time_have_the_names_of_their_files(case):
    """Also names with dots; files that OpenFOAM ignores are left out."""
    time = case / "5"
    text = (time / "p").read_bytes()
    for name in ("alpha.water", "U~", "U.orig", ".U", "k.bak"):
        (time / name).write_bytes(text)
    for name in ("U.gz", "T.air.gz"):
        (time / name).write_bytes(gzip.compress(text))
    fields = FoamCase(case).fields(FoamCase(case).latest())
    assert [field.name for field in fields] == ["T.air", "U", "alpha.water", "k", "p", "phi"]
    assert fields[1].type == "vector"


def test_settings_of_a_run(case):
    """Entries on one line, after a dictionary that has the same names, and with comments."""
    control = FoamCase(case)
    text = (
        "functions { a { b { endTime 7; } } } // endTime 6;\nstopAt endTime; endTime 5;deltaT $step; /* startTime 9; */"
    )
    control.control.write_text(text)
    assert control.control_number("endTime") == 5
    assert control.control_number("startTime") is None
    assert control.control_number("deltaT") is None
    control.own.mkdir()
    control.set_control(endTime="12", startFrom="latestTime")
    assert control.control.read_text() == text.replace("endTime 5", "endTime 12") + "\nstartFrom latestTime;\n"


def velocity(x):
    """Return a flow from left to right that is not free of divergence, with a layer."""
    u = 4 * x[:, 1] * (1 - x[:, 1])
    return np.column_stack([u, 0.3 * np.tanh(20 * (x[:, 0] - 1.5)) * u, 0 * u])


def put_fields(folder, name, binary=False):
    """Write U, p and phi at a time on the present mesh of a case."""
    mesh = FoamMesh.read(FoamCase(folder).mesh_folder(cases.Time(name, float(name))))
    time = folder / name
    (time / "uniform").mkdir(parents=True, exist_ok=True)
    (time / "uniform" / "time").write_text("deltaT 1;")
    (time / "notes").write_text("FoamFile { version 2.0; class dictionary; object notes; }\nno field;\n")
    centers = {patch.name: mesh.faces[0][patch.faces] for patch in mesh.patches}
    at_inlet = foam.Values("vector", velocity(centers["inlet"]), False)
    boundary = {
        "inlet": {"type": b"fixedValue", "value": at_inlet},
        "outlet": {"type": b"zeroGradient"},
        '"(walls|body)"': {"type": b"noSlip"},
        **{patch.name: {"type": b"empty"} for patch in mesh.patches if patch.kind == "empty"},
    }
    pressure = {key: {"type": b"zeroGradient" if v["type"] != b"empty" else b"empty"} for key, v in boundary.items()}
    u = velocity(mesh.centroids)
    for kind, field_name, dimensions, values, patches in (
        ("volVectorField", "U", b"[0 1 -1 0 0 0 0]", foam.Values("vector", u, False), boundary),
        ("volScalarField", "p", b"[0 2 -2 0 0 0 0]", foam.Values("scalar", u[:, :1] ** 2, False), pressure),
        ("volScalarField", "k", b"[0 2 -2 0 0 0 0]", foam.Values("scalar", np.full((1, 1), 2.5), True), pressure),
        (
            "surfaceScalarField",
            "phi",
            b"[0 3 -1 0 0 0 0]",
            foam.Values("scalar", np.zeros((len(mesh.neighbor), 1)), False),
            {},
        ),
    ):
        entries = {"dimensions": dimensions, "internalField": values, "boundaryField": patches}
        foam.FoamField(field_name, kind, binary, entries).write(time / field_name, name)
    return mesh


@pytest.fixture(scope="module")
def template(tmp_path_factory):
    folder = tmp_path_factory.mktemp("foam") / "case"
    (folder / "system").mkdir(parents=True)
    (folder / "system" / "controlDict").write_text(
        "startFrom startTime;\nstartTime 0;\nendTime 10;\nwriteInterval 1;\n"
    )
    mesh = clvoro.adapt(DOMAIN, 0.1, "fast")
    mesh.to_openfoam(folder / "constant" / "polyMesh", types={"body": "symmetry"}, thickness=0.25)
    mesh.save(folder / "constant" / "polyMesh" / "clvoro.npz")
    put_fields(folder, "5", binary=True)
    return folder


@pytest.fixture
def case(template, tmp_path):
    return shutil.copytree(template, tmp_path / "case")


def content(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_fields_of_a_case_are_read(case):
    change_field(case, "U", lambda u: np.add(u, [0, 0, 1e-20]))  # round-off of a solver in the plane
    mesh, values = clvoro.read_fields(case, ["U", "p"])
    assert mesh.domain.measure == pytest.approx(DOMAIN.measure)
    assert set(mesh.domain.boundary_names) == set(DOMAIN.boundary_names)
    assert values["U"].shape == (len(mesh), 2)
    assert np.abs(values["U"] - velocity(mesh.points)[:, :2]).max() < 0.01
    (case / "flow.foam").touch()
    assert clvoro.read_fields(case / "flow.foam", "p", time=5)[1]["p"] == pytest.approx(values["p"])
    with pytest.raises(InputError, match=r"it has no time 7; it has .*5"):
        clvoro.read_fields(case, time=7)
    with pytest.raises(InputError, match=r"it has no field T; it has .*U"):
        clvoro.read_fields(case, "T")
    shutil.rmtree(case / "5")
    if (case / "0").exists():
        shutil.rmtree(case / "0")
    with pytest.raises(InputError, match="no time with fields"):
        clvoro.read_fields(case)


@pytest.mark.parametrize("known", [True, False])
def test_one_cycle(case, known):
    """Of a mesh of clvoro, and of one of which nothing but OpenFOAM's files is known."""
    if not known:
        (case / "constant" / "polyMesh" / "clvoro.npz").unlink()
    before = FoamMesh.read(case / "constant" / "polyMesh")
    u = foam.read_field(case / "5" / "U").internal.rows(before.n_cells)
    (row,) = foam.adapt_case(case, n_cells=500, effort="fast")
    assert (row.cycle, row.time, row.cells, row.next_cells) == (0, 5, before.n_cells, 500)
    folder = case / "5" / "polyMesh"
    assert FoamCase(case).mesh_folder(FoamCase(case).latest()) == folder
    mesh = FoamMesh.read(folder)
    assert mesh.types == before.types == {"walls": "wall", "outlet": "patch", "inlet": "patch", "body": "symmetry"}
    assert mesh.thickness == pytest.approx(0.25)
    assert mesh.volumes.sum() == pytest.approx(0.25 * DOMAIN.measure)
    after = foam.read_field(case / "5" / "U")
    assert after.binary
    w = after.internal.rows(500)
    assert np.abs(mesh.volumes @ w - before.volumes @ u).max() < 1e-13 * (before.volumes @ np.abs(u)).max()
    assert (w.min(axis=0) >= u.min(axis=0)).all()
    assert (w.max(axis=0) <= u.max(axis=0)).all()
    assert np.abs(w - velocity(mesh.centroids)).mean() < 0.01
    assert foam.read_field(case / "5" / "k").internal.uniform
    assert sorted(path.name for path in (case / "5").iterdir()) == ["U", "k", "p", "phi", "polyMesh", "uniform"]
    assert (case / "5" / "uniform" / "time").exists()
    # The parabola at the inlet, and the flux that it brings.
    (inlet,) = (patch.faces for patch in mesh.patches if patch.name == "inlet")
    given = after.patches["inlet"]["value"].rows(len(inlet))
    assert given[:, 0] == pytest.approx(velocity(mesh.faces[0][inlet])[:, 0], abs=0.01)
    flux = foam.read_field(case / "5" / "phi")
    every = [flux.internal.numbers[:, 0]]
    every += [flux.patches[patch.name]["value"].numbers[:, 0] for patch in mesh.patches if patch.kind != "empty"]
    phi = np.concatenate([*every, np.zeros(2 * mesh.n_cells)])
    assert divergence(mesh, phi) < MOST_DIVERGENCE
    assert flux.patches["body"]["type"] == b"symmetry"  # as OpenFOAM wants it
    assert phi[inlet].sum() == pytest.approx((given * mesh.faces[1][inlet]).sum(), rel=1e-12)
    sizes = np.sqrt(clvoro.load(folder / "clvoro.npz").volumes)
    x = mesh.centroids
    assert sizes[np.abs(x[:, 0] - 1.5) < 0.1].mean() < 0.95 * sizes[x[:, 0] > 2.5].mean()
    assert (case / "clvoro" / "cycle-0.png").exists()
    assert (case / "clvoro" / "cycles.png").exists()
    assert not list((case / "clvoro").glob("next-*"))


def test_loops_go_on_where_they_were_killed(case, monkeypatch):
    """At the solver, before and after the folders are exchanged."""
    calls = []

    def solver(folder):
        now = FoamCase(folder)
        assert "startFrom latestTime;" in now.control.read_text()
        calls.append(now.control_number("endTime"))
        if len(calls) == 1:
            put_fields(folder, "6")
        if len(calls) in (1, 3, 6):
            raise RuntimeError("killed")
        put_fields(folder, f"{calls[-1]:g}")
        table = folder / "postProcessing" / "forces" / "0" / "coefficient.dat"
        table.parent.mkdir(parents=True, exist_ok=True)
        table.write_text(f"# Time Cd Cl\n{calls[-1]} {len(calls)} 0.5\n")

    def go_on():
        return foam.adapt_case(
            case, n_cells=300, cycles=2, solver=solver, interval=2, effort="fast", layers=LAYERS, pictures=False
        )

    for latest in ("6", "7"):
        with pytest.raises(RuntimeError, match="killed"):
            go_on()
        assert FoamCase(case).latest().name == latest
    real = FoamCase.put_time

    def dies(self, name, made):
        monkeypatch.setattr(FoamCase, "put_time", real)
        if name == "9":
            (made / ".complete").touch()
            shutil.move(self.folder / name, self.own / "old")
        raise KeyboardInterrupt

    monkeypatch.setattr(FoamCase, "put_time", dies)
    with pytest.raises(KeyboardInterrupt):
        go_on()
    # Not even then is there a time without its mesh.
    assert FoamMesh.read(FoamCase(case).mesh_folder(FoamCase(case).latest())).n_cells == 300
    rows = go_on()
    assert [row.cycle for row in rows] == [0, 1, 2]
    assert calls == [7, 7, 9, 9, 11]
    assert [row.next_cells for row in rows] == [300, 300, None]
    assert [row.monitors["forces.Cd"] for row in rows] == [2, 4, 5]
    assert go_on() == rows
    note = json.loads((case / "9" / "polyMesh" / "clvoro.json").read_text())
    assert note["layers"][0]["height"] == LAYERS.height
    y = clvoro.load(case / "9" / "polyMesh" / "clvoro.npz").points[:, 1]
    assert (np.abs(y - LAYERS.rows[0]) < 1e-9).sum() > 20
    for name in ("7", "9", "11"):
        shutil.rmtree(case / name)
    with pytest.raises(RuntimeError, match="killed"):  # begun anew: solutions of old reports do not count
        go_on()


def test_a_case_is_held_until_its_solver_ends(case, tmp_path):
    """Even if the call that started it was killed: here the solver leaves a process behind."""
    solver = tmp_path / "solver"
    solver.write_text("#!/bin/sh\nsleep 60 &\necho $!\n")
    solver.chmod(0o755)
    with pytest.raises(InputError, match="no time after 5"):
        foam.adapt_case(case, n_cells=300, solver=str(solver))
    with pytest.raises(InputError, match="in use by another call"):
        foam.adapt_case(case, n_cells=300, effort="fast", pictures=False)
    os.kill(int((case / "clvoro" / "log.cycle-0").read_text()), signal.SIGKILL)


def test_a_window_in_time_counts(case):
    """A layer that has moved keeps its fine cells as long as the time is in the window."""
    shutil.copytree(case / "5", case / "6")
    change_field(case, "U", lambda u: 0 * u + [1, 0, 0], time="6")

    def by_x(fields, mesh, n_cells):
        x = mesh.centroids[:, 0]
        at = 0.5 if np.ptp(fields["U"][:, 0]) > 0.1 else 2.5
        return sizing.sensor_size(np.exp(-20 * (x - at) ** 2) + 0.01, on=mesh, n_cells=n_cells)

    foam.adapt_case(case, n_cells=400, sizes=by_x, window=1.0, effort="fast", pictures=False)
    x = clvoro.load(case / "6" / "polyMesh" / "clvoro.npz").points[:, 0]
    counts = [(np.abs(x - at) < 0.3).sum() for at in (0.5, 1.5, 2.5)]
    assert min(counts[0], counts[2]) > 2 * counts[1]
    assert len(x) == 400


LAYERS = clvoro.Layers(0.02, 2, 1.2, spacing=0.08, edges="walls")


def test_exchanges_without_the_system_call(case, monkeypatch):
    monkeypatch.setattr(cases, "_exchange", lambda a, b: False)
    foam.adapt_case(case, n_cells=300, effort="fast", pictures=False, sizes=by_hand)
    assert FoamMesh.read(case / "5" / "polyMesh").n_cells == 300
    assert not (case / "clvoro" / "old").exists()
    assert not (case / "5" / ".complete").exists()


def note(folder, text):
    (folder / "constant" / "polyMesh" / "clvoro.json").write_text(text)


def by_hand(fields, mesh, n_cells):
    assert sorted(fields) == ["U", "k", "p"]
    assert fields["U"].shape == (len(mesh), 2)
    return sizing.sensor_size(sizing.vorticity(fields["U"], mesh), on=mesh, n_cells=n_cells)


def spoil(case, name, old, new):
    path = case / name
    path.write_bytes(path.read_bytes().replace(old, new, 1))


def change_field(case, name, change, key="internalField", patch=None, time="5"):
    """Write a field of a time with other numbers in cells, or at a patch."""
    field = foam.read_field(case / time / name)
    entries = {**field.entries}
    place = entries if patch is None else entries["boundaryField"][patch]
    place[key] = foam.Values(field.type, change(place[key].numbers), False)
    replace(field, entries=entries).write(case / time / name, time)


def put_zones(case, **zones):
    """Write a zone of each kind: cells, faces or points, in text."""
    for kind, rows in zones.items():
        labels = f"{kind}Labels List<label> {len(rows)}({' '.join(map(str, rows))})"
        text = f"1\n(\nporous\n{{\n    type {kind}Zone;\n    {labels};\n}}\n)\n"
        head = "FoamFile { format ascii; class regIOobject; }\n"
        (case / "constant" / "polyMesh" / f"{kind}Zones").write_text(head + text)


def close(case, patch):
    """Give the velocity at a patch, 0."""
    field = foam.read_field(case / "5" / "U")
    field.entries["boundaryField"][patch] = {
        "type": b"fixedValue",
        "value": foam.Values("vector", np.zeros((1, 3)), True),
    }
    field.write(case / "5" / "U", "5")


def change_owner(case, n_less):
    path = case / "constant" / "polyMesh" / "owner"
    file = foam_read.FoamFile.read(path.parent, "owner")
    rows = file.labels()[:-n_less].astype(np.int64)
    path.write_text(f"FoamFile {{ format ascii; class labelList; }}\n{len(rows)}\n(\n{' '.join(map(str, rows))}\n)\n")


def empty_body(case):
    (case / "constant" / "polyMesh" / "clvoro.npz").unlink()
    spoil(case, "constant/polyMesh/boundary", b"symmetry", b"empty")


def add_viscosity(case):
    (case / "constant" / "transportProperties").write_text("nu nu [0 2 -1 0 0 0 0] 1e-05;")


def nan_in_row_3(values):
    return np.where(np.arange(len(values))[:, None] == 3, np.nan, values)


@pytest.mark.parametrize(
    ("change", "options", "kind", "text"),
    [
        (lambda c: shutil.rmtree(c / "system"), {}, InputError, "no system/controlDict"),
        (lambda c: shutil.rmtree(c / "5"), {}, InputError, "run the solver first"),
        (lambda c: (c / "processor0").mkdir(), {}, InputError, "reconstructPar"),
        (lambda c: (c / "constant/regionProperties").touch(), {}, InputError, "expected a case with one mesh"),
        (
            lambda c: (c / "constant/dynamicMeshDict").write_text("dynamicFvMesh dynamicRefineFvMesh;\n"),
            {},
            InputError,
            "dynamicRefineFvMesh, expected staticFvMesh",
        ),
        (lambda c: spoil(c, "5/p", b"outlet", b"exit"), {}, InputError, "p has no entry for the patch outlet .*run"),
        (lambda c: put_zones(c, cell=[400]), {}, InputError, "zones have cells beyond"),
        (lambda c: shutil.rmtree(c / "constant"), {}, InputError, "no mesh"),
        (lambda c: None, {"sizes": foam.FieldSizes(["T"])}, InputError, "no field T"),
        (lambda c: None, {"sizes": foam.FieldSizes(["k"])}, InputError, "k has one value .*run the solver"),
        (lambda c: None, {"sizes": foam.FieldSizes(forces="wing")}, InputError, "some of walls, outlet, inlet, body"),
        (lambda c: None, {"sizes": foam.FieldSizes(adjoints=["Ua"])}, InputError, "no number nu, .*write it"),
        (add_viscosity, {"sizes": foam.FieldSizes(adjoints=["Ua"])}, InputError, "no field Ua"),
        (lambda c: None, {"cycles": 3}, InputError, "without a solver"),
        (lambda c: None, {"n_cells": 0}, InputError, "n_cells"),
        (lambda c: None, {"n_cells": 3}, InputError, "at least 16: 4 for each of the 4 patches"),
        (lambda c: None, {"n_cells": 3, "solver": "true"}, InputError, "at least 16"),
        (empty_body, {"solver": "true"}, InputError, "body.* do not bound one layer of cells normal to z"),
        (lambda c: None, {"solver": "noSuchFoam"}, InputError, "not on the PATH"),
        (lambda c: note(c, "{}"), {}, InputError, "the note of a cycle"),
        (lambda c: None, {"solver": "false"}, ClvoroError, "failed with code 1"),
        (lambda c: None, {"solver": lambda folder: None}, InputError, "no time after 5"),
        (lambda c: None, {"solver": "true", "interval": -1}, InputError, "interval"),
        (lambda c: None, {"mesh": clvoro.voronoi(DOMAIN, [(1, 0.1), (2, 0.5)])}, InputError, "the mesh of the case"),
        (lambda c: None, {"mesh": clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), [(0.5, 0.5)])}, InputError, "same names"),
        (lambda c: None, {"sizes": lambda fields, mesh, n_cells: 0.1}, InputTypeError, "Estimate"),
        (lambda c: None, {"layers": LAYERS, "n_cells": 20}, ClvoroError, "."),
        (lambda c: change_field(c, "p", nan_in_row_3), {}, InputError, "p is not finite in 1 cells, the first is 3"),
        (
            lambda c: change_field(c, "U", lambda v: v * [1, 1, np.nan]),
            {"sizes": foam.FieldSizes(["p"])},
            InputError,
            "U is not finite",
        ),
        (
            lambda c: change_field(c, "U", nan_in_row_3, "value", "inlet"),
            {},
            InputError,
            "a value at inlet that is not",
        ),
        (lambda c: change_field(c, "p", lambda v: v[:-1]), {}, InputError, "values, the mesh"),
        (lambda c: close(c, "outlet"), {}, InputError, "U enters the domain with .* and leaves it with 0"),
        (lambda c: spoil(c, "5/p", b"internalField", b"otherField"), {}, InputError, "p has no internalField"),
        (lambda c: (c / "5" / "log").write_text("no field"), {}, InputError, "move other files"),
        (lambda c: spoil(c, "constant/polyMesh/boundary", b"outlet", b"walls"), {}, InputError, "two patches walls"),
        (
            lambda c: spoil(c, "constant/polyMesh/boundary", b"nFaces          8", b"nFaces          7"),
            {},
            InputError,
            "expected each of them in one patch",
        ),
        (lambda c: change_owner(c, 5), {}, InputError, "its lists do not fit each other"),
    ],
)
def test_bad_input_changes_nothing(case, change, options, kind, text):
    change(case)
    before = content(case)
    with pytest.raises(kind, match=text):
        foam.adapt_case(case, **{"n_cells": 300, "effort": "fast"} | options)
    after = content(case)
    if options.get("solver") in (None, "noSuchFoam"):
        assert after == before
    assert all(after[path] == data for path, data in before.items() if path.name != "controlDict")


@pytest.mark.parametrize("n", [7, 30, 90])
def test_profiles_at_straight_patches(n):
    """Means of a parabola are exact but where they are largest, and a jump stays within its values."""
    random = np.random.default_rng(4)

    def faces(count):
        ends = np.concatenate([[0], np.cumsum(random.uniform(0.7, 1.3, count))])
        ends /= ends[-1]
        places = np.column_stack([np.full(count, 3.0), (ends[1:] + ends[:-1]) / 2, np.full(count, 0.1)])
        order = random.permutation(count)
        y = np.array([ends[:-1], ends[1:]])
        profile = np.diff(2 * y**2 - 4 / 3 * y**3, axis=0)[0] / np.diff(ends)
        values = np.column_stack([profile, places[:, 1] > 0.5])
        return places[order], 0.2 * np.diff(ends)[order], values[order]

    (centers, areas, old), (at, sizes, exact) = faces(30), faces(n)
    made = _along_line(old, centers, areas, at, sizes, 0.2)
    error = np.abs(made[:, 0] - exact[:, 0])
    assert np.median(error) < 1e-12
    assert error.max() < 2e-3
    assert (made[:, 1].min(), made[:, 1].max()) == (0, 1)
    centers[0, 0] = 3.1
    assert _along_line(old, centers, areas, at, sizes, 0.2) is None


def test_wrong_fields_are_refused():
    for options, kind in (({"fields": "U"}, InputTypeError), ({"fields": ()}, InputError)):
        with pytest.raises(kind, match="expected names"):
            foam.FieldSizes(**options)
    with pytest.raises(InputError, match="one of them"):
        foam.FieldSizes(forces="body", adjoints=["Ua"])
    with pytest.raises(InputError, match="name adjoints="):
        foam.FieldSizes(viscosity=0.1)


def test_adjoints_count_by_the_flux_of_momentum():
    """The weight of a cell is the gradient of the adjoint velocity times speed + viscosity / h."""
    mesh = clvoro.adapt(clvoro.Box((0, 0), (1, 1)), 0.08, "fast").diagram
    x, y = mesh.centroids.T
    found = {"U": np.column_stack([y**3, 0.5 * x**2]), "Ua": np.column_stack([np.sin(3 * y), x * y])}
    made = foam.FieldSizes(adjoints=["Ua"], viscosity=0.02)(found, mesh, 200)
    flux = np.hypot(*found["U"].T) + 0.02 / np.sqrt(mesh.volumes)
    weight = sizing.steepness(found["Ua"], mesh) * flux
    expected = sizing.hessian_size(found["U"], on=mesh, n_cells=200, p=1, weight=weight)
    assert made.values == pytest.approx(expected.values, rel=1e-12)


def test_fields_that_are_lost_are_named(case):
    """Of points, of faces, and of particles; before anything is written."""
    for name, kind in (("pointU", "pointVectorField"), ("Uf", "surfaceVectorField"), ("S", "volScalarField::Internal")):
        (case / "5" / name).write_text(f"FoamFile {{ version 2.0; class {kind}; object {name}; }}\n")
    (case / "5" / "lagrangian").mkdir()
    before = content(case)
    with pytest.warns(LostFieldsWarning, match=r"S \(vol.*Internal\), Uf \(.*pointU \(point.*lagrangian/: not"):
        with pytest.raises(InputError, match="no field T"):
            foam.adapt_case(case, n_cells=300, sizes=foam.FieldSizes(["T"]))
    assert content(case) == before


def test_zones_and_groups_follow(case):
    """The cells of a zone, and the groups of patches, which conditions may name; other zones are lost."""
    before = FoamMesh.read(case / "constant" / "polyMesh")
    inside = np.flatnonzero(before.centroids[:, 0] > 2)
    put_zones(case, cell=inside, face=[0, 1])
    spoil(case, "constant/polyMesh/boundary", b"type            patch", b"inGroups 2(ends way); type            patch")
    name = next(patch.name for patch in FoamMesh.read(case / "constant" / "polyMesh").patches if patch.groups)
    spoil(case, "5/p", name.encode(), b"ends")
    with pytest.warns(LostFieldsWarning, match="porous .a zone of faces"):
        foam.adapt_case(case, n_cells=300, effort="fast", pictures=False)
    after = FoamMesh.read(case / "5" / "polyMesh")
    assert {patch.name: patch.groups for patch in after.patches if patch.groups} == {name: ("ends", "way")}
    assert after.lost_zones == ()
    zone = np.isin(np.arange(after.n_cells), after.zones["porous"])
    x = after.centroids[:, 0]
    assert zone[x > 2.2].all()
    assert not zone[x < 1.8].any()
    put_zones(case, cell=[after.volumes.argmin()])
    shutil.copy(case / "constant" / "polyMesh" / "cellZones", case / "5" / "polyMesh")
    with pytest.raises(InputError, match="the zone porous has none of the new cells"):
        foam.adapt_case(case, n_cells=20, effort="fast", pictures=False)


@pytest.mark.parametrize("binary", [False, True])
def test_zones_are_read(tmp_path, binary):
    """With many labels, one label for all, and none."""
    form, rows = ("binary", np.arange(5, dtype=np.int32).tobytes()) if binary else ("ascii", b"0 1 2 3 4")
    text = b"FoamFile { format %b; class regIOobject; }\n3\n(\na { type cellZone; cellLabels List<label> \n5\n(%b); }\n"
    text += b"b { type cellZone; cellLabels List<label> 3{7}; }\nc { type cellZone; cellLabels List<label> 0(); }\n)\n"
    (tmp_path / "cellZones").write_bytes(text % (form.encode(), rows))
    found = foam_read.FoamFile.read(tmp_path, "cellZones").zones()
    assert {name: labels.tolist() for name, labels in found.items()} == {"a": [0, 1, 2, 3, 4], "b": [7, 7, 7], "c": []}


def test_the_command(case, capsys):
    """One cycle for the forces on a patch, with layers; and what it refuses."""
    command = ["foam", "adapt", str(case), "--cells", "300", "--effort", "fast", "--no-pictures"]
    assert main([*command, "--forces", "body", "--layers", "walls:0.02:2:1.2:0.08", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["next_cells"] == 300
    note = json.loads((case / "5" / "polyMesh" / "clvoro.json").read_text())
    assert note["layers"] == [{"height": 0.02, "count": 2, "growth": 1.2, "spacing": 0.08, "edges": ["walls"]}]
    mesh = clvoro.load(case / "5" / "polyMesh" / "clvoro.npz")
    near = np.linalg.norm(mesh.centroids - (1, 0.5), axis=1) < 0.3
    far = (np.abs(mesh.centroids[:, 1] - 0.5) < 0.3) & (mesh.centroids[:, 0] > 2)
    assert np.median(mesh.volumes[near]) < 0.5 * np.median(mesh.volumes[far])
    for text in ("walls:0.02", "walls:0:2", "walls:a:2"):
        with pytest.raises(SystemExit):
            main([*command, "--layers", text])
        assert "expected such as cylinder:0.0008:4:1.15" in capsys.readouterr().err


@pytest.mark.parametrize("is_open", [False, True])
def test_iterations_project_fluxes_as_a_factorization_does(template, monkeypatch, is_open):
    """Those of a large mesh."""
    mesh = FoamMesh.read(template / "constant" / "polyMesh")
    at_boundary = np.zeros(len(mesh.owner) - len(mesh.neighbor))
    free = np.isin(np.arange(len(mesh.neighbor), len(mesh.owner)), mesh.patches[1].faces) & is_open
    made = []
    for most in (transfer._DIRECT, 0):
        monkeypatch.setattr(transfer, "_DIRECT", most)
        made.append(transfer.project_fluxes(mesh, velocity(mesh.centroids), at_boundary, free))
        assert divergence(mesh, made[-1]) < MOST_DIVERGENCE
    assert made[1] == pytest.approx(made[0], abs=1e-9 * np.abs(made[0]).max())


def test_polygons_of_edges():
    """Straight runs of a name become one edge, holes stay; open boundaries and baffles are refused."""
    points = np.array([(0, 0), (1, 0), (2, 0), (2, 2), (0, 2), (0.5, 0.5), (1, 1), (0.5, 1)])
    ends = np.array([(0, 1), (2, 1), (2, 3), (3, 4), (4, 0), (5, 6), (6, 7), (7, 5)])
    polygon = polygon_of_edges(points, ends, ["low", "low", "right", "top", "top", *["hole"] * 3])
    assert polygon.measure == pytest.approx(4 - 0.125)
    assert len(polygon.vertices) == 7
    assert set(polygon.boundary_names) == {"low", "right", "top", "hole"}
    with pytest.raises(InputError, match="not closed"):
        polygon_of_edges(points, ends[1:], ["a"] * 7)
    points = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0.5, 0.5), (0, 0)])  # a baffle, whose sides have their own foot
    with pytest.raises(InputError, match=r"touches itself, at \(0, 0\)"):
        polygon_of_edges(points, np.array([(0, 1), (1, 2), (2, 3), (3, 5), (5, 4), (4, 0)]), ["a"] * 6)


PERIODIC = clvoro.Box((0, 0), (1, 1), (True, False))
SPACE = clvoro.Box((0, 0, 0), (1, 1, 1))


@pytest.mark.parametrize(("box", "known"), [(PERIODIC, True), pytest.param(SPACE, False, marks=pytest.mark.slow)])
def test_boxes_follow(tmp_path, box, known):
    """One with a seam, and one in space of which only OpenFOAM's files are known."""
    folder = tmp_path / "case"
    (folder / "system").mkdir(parents=True)
    (folder / "system" / "controlDict").write_text("endTime 1;\n")
    mesh = clvoro.adapt(box, 0.2, "fast")
    mesh.to_openfoam(folder / "constant" / "polyMesh", thickness=1.0 if box is PERIODIC else None)
    if known:
        mesh.save(folder / "constant" / "polyMesh" / "clvoro.npz")
    values = np.tanh(10 * (mesh.centroids[:, 1] - 0.5))
    internal = foam.Values("scalar", values[:, None], False)
    patches = {'".*"': {"type": b"zeroGradient"}}
    entries = {"dimensions": b"[0 0 0 1 0 0 0]", "internalField": internal, "boundaryField": patches}
    (folder / "1").mkdir()
    foam.FoamField("T", "volScalarField", False, entries).write(folder / "1" / "T", "1")
    before = FoamMesh.read(folder / "constant" / "polyMesh")
    foam.adapt_case(folder, n_cells=300, sizes=foam.FieldSizes(["T"]), effort="fast")
    made = FoamMesh.read(folder / "1" / "polyMesh")
    assert set(made.types) == set(box.boundary_names)
    assert made.volumes.sum() == pytest.approx(1)
    after = foam.read_field(folder / "1" / "T").internal.rows(made.n_cells)[:, 0]
    assert made.volumes @ after == pytest.approx(before.volumes @ values, abs=1e-12)
    # Each old cell's value without a gradient would give 0.09 in space. Single cells are off by half a jump.
    assert made.volumes @ np.abs(after - np.tanh(10 * (made.centroids[:, 1] - 0.5))) < 0.05
    assert [patch.kind for patch in made.patches] == [patch.kind for patch in before.patches]
