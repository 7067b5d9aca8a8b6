"""A correct mesh passes the check. Each kind of damage is found and named."""

import dataclasses
import json

import numpy as np
import pytest

import clvoro
from clvoro.cli import command as cli
from clvoro.io.vtu_read import load_vtu
from clvoro.mesh.check.findings import CheckError
from clvoro.mesh.check.rebuilt import Rebuilt
from clvoro.mesh.check.values import borders_on_lost_faces
from clvoro.mesh.diagram import Diagram
from tests.reference.solids import solid_diagram, solid_result

BOX = clvoro.Box((-3.0, 7.0), (-0.5, 8.5))


@pytest.fixture(scope="module")
def flat(ctx):
    points = np.random.default_rng(5417).uniform(BOX.lower, BOX.upper, (90, 2))
    return clvoro.Adapter(ctx).run(BOX, 0.2, points=points, method="lloyd", max_steps=1)


@pytest.fixture(scope="module")
def solid():
    points = np.random.default_rng(5419).random((60, 3))
    return solid_result(solid_diagram((0, 0, 0), (1, 1, 1), points))


def arrays_of(diagram):
    names = (name for name in Diagram._NAMES if name in diagram._arrays)
    return {name: getattr(diagram, name).copy() for name in names}


def spoilt(result, **changes):
    """Return the diagram, or the result with it, after functions are applied to its arrays."""
    diagram = result if isinstance(result, Diagram) else result.diagram
    arrays = arrays_of(diagram)
    for name, change in changes.items():
        array = arrays.get(name, getattr(diagram, name).copy())  # those that are not stored follow from others
        changed = change(array)
        arrays[name] = array if changed is None else changed
    return Diagram(diagram.domain, arrays)


def put(index, value):
    def change(array):
        array[index] = value

    return change


def add(index, value):
    def change(array):
        array[index] += value

    return change


def swap(a, b):
    def change(array):
        array[[a, b]] = array[[b, a]]

    return change


@pytest.mark.sparse(3)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("n", [1, 2, 3, 700])
def test_right_diagrams_pass(ctx, dtype, n):
    points = np.random.default_rng(n).uniform(BOX.lower, BOX.upper, (n, 2))
    report = clvoro.Adapter(ctx, dtype).diagram(BOX, points).check()
    assert report, report
    assert report.cells == n
    assert n == 1 or report.precision == dtype


@pytest.fixture(scope="module")
def single(ctx):
    """A mesh whose cells are small beside the domain, in float32."""
    points = np.random.default_rng(5421).uniform(BOX.lower, BOX.upper, (3000, 2))
    return clvoro.Adapter(ctx, "float32").run(BOX, 0.17, points=points, method="lloyd", max_steps=2)


def names_of(report):
    return {finding.name for finding in report.findings}


def of_diagram(result, **changes):
    return dataclasses.replace(result, diagram=spoilt(result, **changes))


def test_float32_rounds_by_the_cells_not_the_domain(single):
    assert single.check(), single.check()
    widest = int(np.argmax(single.diagram.face_measures))
    for factor in (1.003, 0.997):
        changed = of_diagram(single, face_measures=lambda m, f=factor: m * np.where(np.arange(len(m)) == widest, f, 1))
        assert "measures close" in names_of(changed.check())
    quality = single.quality.copy()
    quality[17] *= 1.0001
    assert "quality" in names_of(dataclasses.replace(single, quality=quality).check())
    bigger = of_diagram(single, volumes=lambda v: v * np.where(np.arange(len(v)) == 5, 1.001, 1))
    assert "volumes" in names_of(bigger.check())


@pytest.mark.parametrize("known", [True, False])
def test_volumes_in_float32_do_not_make_a_float32_mesh(flat, known):
    moved = flat.diagram.points + 1e-8 * np.random.default_rng(77).standard_normal((90, 2))

    def rounded(volumes):
        scale = BOX.frame[1] ** 2
        return (volumes / scale).astype(np.float32) * scale

    changed = of_diagram(flat, volumes=rounded, points=lambda _: moved)
    settings = flat.settings if known else {}
    report = dataclasses.replace(changed, points=moved, settings=settings).check()
    assert report.precision == "float64"
    assert {"volumes", "nearest generators"} <= names_of(report)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("kind", ["flat", "solid"])
def test_vertex_that_is_stored_twice_is_found(kind, request):
    result = request.getfixturevalue(kind)
    d, corners = result.diagram, "cell_vertices" if kind == "flat" else "face_vertices"
    times = np.bincount(getattr(d, corners), minlength=len(d.vertices))
    vertex = int(np.argmax(times))
    if kind == "flat":
        cells = np.repeat(np.arange(len(d)), np.diff(d.neighbor_starts))
    else:
        faces = np.repeat(np.arange(len(d.neighbors)), np.diff(d.face_vertex_starts))
        cells = np.repeat(np.arange(len(d)), np.diff(d.neighbor_starts))[faces]
    one = cells == cells[getattr(d, corners) == vertex][0]
    report = spoilt(
        result,
        vertices=lambda x: np.concatenate([x, x[[vertex]]]),
        **{corners: lambda c: np.where(one & (c == vertex), len(d.vertices), c)},
    ).check()
    assert names_of(report) == {"vertices once"} | ({"Euler's formula"} if kind == "flat" else set())


def test_face_whose_two_ends_have_one_number_is_found(ctx):
    """If the face is shorter than round-off, no other check fails."""
    points = np.array([[1.0, 0.3], [0.0, 1.3], [-1.0, 0.3], [0.0, -0.7]])
    points[0, 0] += 4e-14
    adapter = clvoro.Adapter(ctx)
    result = adapter.run(clvoro.Box((-2, -2), (2, 2)), 1.0, points=points, method="lloyd", max_steps=0)
    d = result.diagram
    assert result.check()
    short = int(np.argmin(d.face_measures))
    assert 0 < d.face_measures[short] < 1e-13
    cell = np.searchsorted(d.neighbor_starts, short, "right") - 1
    begin, end = d.neighbor_starts[cell : cell + 2]
    one, two = sorted(int(d.cell_vertices[k]) for k in (short, short + 1 if short + 1 < end else begin))
    report = spoilt(
        result,
        vertices=lambda x: np.delete(x, two, axis=0),
        cell_vertices=lambda c: np.where(c == two, one, c - (c > two)),
    ).check()
    assert names_of(report) == {"Euler's formula"}


HISTORIES = {
    "nan": ("energy", 0, np.nan, "energy"),
    "error": ("mean_error", -1, lambda x: 0.1 * x, "mean_error ends"),
    "largest": ("max_error", -1, lambda x: 1.0001 * x, "max_error ends"),
    "quality": ("mean_quality", -1, lambda x: 1.0001 * x, "mean_quality ends"),
    "worst": ("min_quality", -1, lambda x: 0.9 * x, "min_quality ends"),
    "cells": ("cells", -1, lambda x: x + 7, "cells"),
    "none": ("cells", 0, 0, "cells in row 0"),
    "step": ("step", 0, 1, "step 1, after 1"),
    "time": ("seconds", 0, 1e9, "seconds in row 1"),
    "level": ("level", -1, 2, "level in row 2"),
    "coarse": ("level", slice(None), 2, "level 2"),
    "progress": ("progress", 0, 1.5, "progress in row 1"),
}


@pytest.mark.parametrize("case", list(HISTORIES))
def test_history_fits_the_mesh(flat, case):
    name, row, value, message = HISTORIES[case]
    history = flat.history.copy()
    history = np.concatenate([history, history[-1:]])  # as after a change of the count
    assert dataclasses.replace(flat, history=history).check()
    history[name][row] = value(history[name][row]) if callable(value) else value
    report = dataclasses.replace(flat, history=history).check()
    assert names_of(report) == {"history"}
    assert message in str(report)


def test_factor_of_the_sizes_needs_a_count(flat):
    for changes in (
        {"size_factor": 3.0},
        {"size_factor": -1.0},
        {"size_factor": "much"},
        {"settings": {**flat.settings, "size_factor": 3}},
    ):
        assert names_of(dataclasses.replace(flat, **changes).check()) == {"size factor"}
    counted = dataclasses.replace(flat, size_factor=3.0, settings={**flat.settings, "n_cells": 90})
    assert counted.check()


@pytest.mark.parametrize("suffix", ["npz", "vtu"])
@pytest.mark.parametrize(
    ("change", "name"), [({"volumes": put(4, -0.1)}, "volumes"), ({"points": put((4, 0), np.nan)}, "finite")]
)
def test_what_is_no_number_is_told_without_warnings(flat, suffix, change, name, tmp_path, capfd):
    changed, path = of_diagram(flat, **change), str(tmp_path / f"m.{suffix}")
    dataclasses.replace(changed, points=changed.diagram.points).save(path)
    assert cli.main(["check", path]) == 1
    told = capfd.readouterr()
    assert name in told.out
    assert not told.err


def test_right_results_pass(flat, solid):
    for result in (flat, solid):
        report = result.check()
        assert report.ok, report
        assert {"volumes sum", "nearest generators", "size_error", "quality"} <= set(report.checked)
        report.demand()


COMMON = {
    "volumes": ({"volumes": add(7, 1e-9)}, "volumes"),
    "sum": ({"volumes": lambda v: v * (1 + 1e-9)}, "volumes sum"),
    "centroid": ({"centroids": add((4, 1), 1e-7)}, "centroids"),
    "measure": ({"face_measures": add(11, 1e-7)}, "face measures"),
    "middle": ({"face_centroids": add((11, 0), 1e-6)}, "face centroids"),
    "neighbor": ({"neighbors": lambda j: np.where(j == 3, 4, j)}, "graph symmetric"),
    "far neighbor": ({"neighbors": put(5, 10_000)}, "neighbors exist"),
    "no such wall": ({"neighbors": put(5, -9)}, "neighbors exist"),
    "generators": ({"points": swap(8, 30)}, "nearest generators"),
    "outside": ({"points": add(8, 100.0)}, "generators inside"),
    "vertex": ({"vertices": add((20, 0), 1e-5)}, "nearest generators"),
    "nan": ({"vertices": put((20, 0), np.nan)}, "finite"),
    "starts": ({"neighbor_starts": put(3, 500)}, "shapes"),
    "short": ({"volumes": lambda v: v[:-1]}, "shapes"),
}


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("periodic", [False, True])
def test_faces_that_were_left_out_had_next_to_no_area(ctx, dtype, periodic):
    """At each edge of a perturbed lattice two of four cells share a face no wider than round-off.

    The diagram may drop it although the device has measured it, and the quality of its cells may then differ."""
    adapter, eps = clvoro.Adapter(ctx, dtype), float(np.finfo(dtype).eps)
    box = clvoro.Box((0, 0, 0), (1, 1.1, 1), periodic=periodic)
    # Single precision may refuse this lattice when it is perturbed by 100 units of round-off or more.
    for m, spread in ((5, 30), (7, 30), (10, 200 if dtype == "float64" else 60)):
        middles = np.stack(np.meshgrid(*[np.arange(m)] * 3), -1).reshape(-1, 3) + 0.5
        noise = spread * eps * np.random.default_rng(3).standard_normal(middles.shape)
        result = adapter.run(box, 1 / m, points=(middles / m + noise) * box.extent, method="lloyd", max_steps=0)
        result.check().demand()
        quality = result.quality.copy()
        quality[17] *= 1 + 2e4 * eps * m
        assert "quality" in names_of(dataclasses.replace(result, quality=quality).check())


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_periods_round_on_the_device(ctx, dtype):
    """By half an ulp, much in a thin box: its cells close across seams only up to that round-off."""
    adapter, step = clvoro.Adapter(ctx, dtype), float(np.finfo(dtype).eps)
    for seed in (9, 14, 17):
        box = clvoro.Box((0, 0), (0.7, (2000.5 + 100 * seed) * step), periodic=True)
        points = np.random.default_rng(seed).random((2000, 2)) * box.extent
        adapter.diagram(box, points).check().demand()


def test_only_where_faces_may_have_been_left_out_quality_may_be_off(ctx):
    box = clvoro.Box((0, 0, 0), (1, 1, 1), periodic=(True, False, False))
    points = np.random.default_rng(5).random((300, 3))
    result = clvoro.Adapter(ctx).run(box, 0.15, points=points, method="lloyd", max_steps=1)
    g = Rebuilt(result.diagram)
    assert not borders_on_lost_faces(result.diagram, g, np.arange(300)).any()
    cubes = (np.stack(np.meshgrid(*[np.arange(6)] * 3), -1).reshape(-1, 3) + 0.5) / 6
    d = clvoro.Adapter(ctx).diagram(box, cubes)
    assert borders_on_lost_faces(d, Rebuilt(d), np.arange(6**3)).all()


@pytest.mark.parametrize("case", list(COMMON))
@pytest.mark.parametrize("kind", ["flat", "solid"])
def test_what_is_wrong_is_named(case, kind, request):
    changes, name = COMMON[case]
    result = request.getfixturevalue(kind)
    report = spoilt(result, **changes).check()
    assert not report
    assert name in {finding.name for finding in report.findings}, report
    with pytest.raises(CheckError, match=name):
        report.demand()


def test_clockwise_cell_is_found(flat):
    starts = flat.diagram.cell_vertex_starts

    def turn(corners):
        corners[starts[5] : starts[6]] = corners[starts[5] : starts[6]][::-1].copy()

    names = {f.name for f in spoilt(flat, cell_vertices=turn).check().findings}
    assert {"orientation", "faces outward"} <= names


def test_cells_of_a_polygon_that_look_back_are_found(ctx):
    """Of several faces between two cells some may point inward, but their sum may not."""
    square = clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1)])
    points = np.random.default_rng(7).uniform(0.02, 0.98, (60, 2))
    diagram = clvoro.Adapter(ctx).diagram(square, points)
    assert diagram.check()
    beside = next(int(j) for j in diagram.neighbors[diagram.neighbor_starts[5] :] if j >= 0)
    names = {f.name for f in spoilt(diagram, points=swap(5, beside)).check().findings}
    assert "faces outward" in names


def test_inward_and_open_faces_are_found(solid):
    starts = solid.diagram.face_vertex_starts

    def turn(corners):
        corners[starts[5] : starts[6]] = corners[starts[5] : starts[6]][::-1].copy()

    names = {f.name for f in spoilt(solid, face_vertices=turn).check().findings}
    assert {"faces closed", "faces outward", "volumes"} <= names


def test_diagram_of_other_generators_is_found(ctx, flat):
    # Closed, symmetric, of the right volumes: only not the Voronoi diagram of these generators.
    moved = flat.diagram.points + 1e-4 * np.random.default_rng(77).standard_normal((90, 2))
    names = {f.name for f in spoilt(flat, points=lambda _: moved).check().findings}
    assert "nearest generators" in names


@pytest.mark.parametrize("name", ["size_error", "quality", "target_size"])
def test_numbers_of_a_result_are_recomputed(flat, solid, name):
    for result in (flat, solid):
        values = getattr(result, name).copy()
        values[17] *= 1.001
        report = dataclasses.replace(result, **{name: values}).check()
        assert ("quality" if name == "quality" else "size_error") in {f.name for f in report.findings}


@pytest.mark.sparse(2)
@pytest.mark.parametrize("kind", ["flat", "solid"])
@pytest.mark.parametrize("suffix", ["npz", "vtu"])
def test_files_pass_and_spoilt_ones_do_not(kind, suffix, request, tmp_path, capsys):
    result = request.getfixturevalue(kind)
    good, bad = str(tmp_path / f"good.{suffix}"), str(tmp_path / f"bad.{suffix}")
    result.save(good)
    diagram = spoilt(result, volumes=add(7, 1e-6), vertices=add((20, 0), 1e-5))
    dataclasses.replace(result, diagram=diagram).save(bad)
    assert cli.main(["check", good]) == 0
    assert "hold" in capsys.readouterr().out
    assert cli.main(["check", good, bad, "--json"]) == 1
    first, second = map(json.loads, capsys.readouterr().out.splitlines())
    assert first["ok"]
    assert not second["ok"]
    names = {finding["name"] for finding in second["findings"]}
    assert {"volumes", "nearest generators"} <= names


def test_vtu_gives_the_graph_back(flat, solid, tmp_path):
    for result in (flat, solid):
        result.save(tmp_path / "m.vtu")
        again = load_vtu(tmp_path / "m.vtu").diagram
        assert (again.neighbors == result.diagram.neighbors).all()
        assert np.abs(again.face_measures - result.diagram.face_measures).max() < 1e-13


def test_what_cannot_be_read_has_its_own_code(flat, tmp_path, capsys):
    path = tmp_path / "m.npz"
    flat.save(path)
    path.write_bytes(path.read_bytes()[:-500])
    assert cli.main(["check", str(path)]) == 2
    assert cli.main(["check", str(tmp_path / "none.vtu")]) == 2
    assert cli.main(["check", str(tmp_path / "mesh.stl")]) == 2
    assert "cannot" in capsys.readouterr().err
