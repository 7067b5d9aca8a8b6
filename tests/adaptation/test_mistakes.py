"""Plausible input mistakes: each works, or gives an error with a remedy."""

import copy
import dataclasses
import json
import pickle
import re
from functools import partial

import numpy as np
import pytest
import shapely
from scipy.spatial import KDTree

import clvoro
from clvoro import sizing
from clvoro.adaptation.sampling.quadrature import DensityTree
from clvoro.adaptation.sampling.start import count_cells
from clvoro.cli import command as cli
from clvoro.errors import ClvoroError, InputError, InputTypeError, SizeFieldError

BOX = clvoro.Box((0, 0), (1, 1))
SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
POINTS = np.random.default_rng(5).random((30, 2))


class Foreign:
    """An array of another library that can or cannot be converted."""

    def __init__(self, values, refuses=False):
        self.values, self.refuses = np.asarray(values), refuses

    def __array__(self, dtype=None, copy=None):
        if self.refuses:
            raise RuntimeError("call detach() first")
        return np.asarray(self.values, dtype)


class Geographic:
    """An object with `__geo_interface__`, as in geopandas."""

    @property
    def __geo_interface__(self):
        return {"type": "Polygon", "coordinates": [[*SQUARE, SQUARE[0]]]}


@pytest.fixture(scope="module")
def result(adapter):
    return adapter.run(BOX, 0.2, points=POINTS, method="lloyd", max_steps=0)


def refused(call, *parts, kind=ClvoroError):
    with pytest.raises(kind) as caught:
        call()
    for part in parts:
        assert part in str(caught.value)


# Size fields.


def test_sizes_that_cannot_be_converted(adapter):
    sizes = partial(adapter.run, BOX, lambda p: Foreign(p[:, 0], refuses=True))
    refused(sizes, "Foreign", "call detach()", kind=InputTypeError)


BAD_SIZES = {
    "negative": lambda p: p[:, 0] - 0.5,
    "zero": lambda p: 0 * p[:, 0],
    "tiny": lambda p: 1e-200 + 0 * p[:, 0],
    "inf": lambda p: np.full(len(p), np.inf),
    "huge": lambda p: np.full(len(p), 1e30),
}


@pytest.mark.sparse(1)
@pytest.mark.parametrize("edges", [(1e6, 1), (1e6, 1e6, 1e6), (2e-3, 3e-3)])
@pytest.mark.parametrize("what", list(BAD_SIZES))
def test_bounds_in_errors_suit_the_domain(adapter, what, edges):
    box, field = clvoro.Box((0,) * len(edges), edges), sizing.Function(BAD_SIZES[what])
    by_run = partial(adapter.run, box, field)
    for call in (by_run,) if what == "huge" else (by_run, partial(DensityTree, field, box)):
        with pytest.raises(SizeFieldError) as caught:
            call()
        bound = re.search(r"clvoro\.sizing\.(m\w+)\(field, ([^)]+)\)", str(caught.value))
        assert bound, caught.value
        bounded = getattr(sizing, bound[1])(field, float(bound[2]))
        assert 0 < count_cells(bounded, box) <= 1e6 * (1 + 1e-9)  # so says the message; sums round


def test_errors_of_size_functions_have_their_cause(adapter):
    with pytest.raises(InputTypeError) as caught:
        adapter.run(BOX, lambda p: float(p[:, 0]))
    assert isinstance(caught.value.__cause__, TypeError)
    # An error that is not about shapes or types passes through.
    with pytest.raises(KeyError):
        adapter.run(BOX, lambda p: {}["h"])


def test_a_size_function_may_change_its_argument(adapter):
    def spoils(points):
        points *= 2
        return 0.1 + 0.05 * points[:, 0]

    options = {"points": POINTS, "method": "weighted", "max_steps": 3, "options": clvoro.PaperOptions(tol=0)}
    spoilt = adapter.run(BOX, spoils, **options)
    clean = adapter.run(BOX, lambda p: 0.1 + 0.05 * (2 * p)[:, 0], **options)
    assert np.array_equal(spoilt.points, clean.points)


def test_accepted_size_functions(adapter):
    def given(points, scale=0.2):
        return scale + 0 * points[:, 0]

    for size in (
        given,
        lambda *points: given(*points),
        lambda p: Foreign(given(p)),
        np.vectorize(lambda p: 0.2, signature="(d)->()"),
    ):
        made = adapter.run(BOX, size, points=POINTS, method="lloyd", max_steps=0)
        assert (made.target_size == 0.2).all()


# Generators and other arguments of a run.


@pytest.mark.parametrize(
    ("points", "kind", "parts"),
    [
        (POINTS[:, :1], InputError, ("2 coordinates",)),
        ([], InputError, ("at least one generator",)),
        ({"x": 1, "y": 2}, InputTypeError, ("points is of type dict",)),
        (None, InputTypeError, ("points is of type NoneType",)),
        (Foreign(POINTS, refuses=True), InputTypeError, ("call detach() first",)),
    ],
)
def test_points(adapter, points, kind, parts):
    refused(lambda: adapter.diagram(BOX, points), *parts, kind=kind)


@pytest.mark.parametrize("make", [np.ndarray.tolist, Foreign, np.asfortranarray, np.ma.array])
def test_accepted_points(adapter, make):
    assert np.array_equal(adapter.diagram(BOX, make(POINTS)).points, POINTS)


# Domains.


@pytest.mark.parametrize(
    ("make", "parts"),
    [
        (lambda: clvoro.Polygon(np.ma.masked_equal(np.array(SQUARE), 1)), ("masked",)),
        (lambda: clvoro.Polygon(SQUARE).boundary([]), ("at least one",)),
    ],
)
def test_polygons(make, parts):
    refused(make, *parts)


@pytest.mark.parametrize("domain", [BOX, clvoro.Polygon(SQUARE)])
def test_places_in_domains(domain):
    for points in ([(0.5, 0.5), (2, 0)], Foreign([(0.5, 0.5), (2, 0)]), np.array([(0.5, 0.5), (2, 0)], np.float32)):
        assert domain.contains(points).tolist() == [True, False]
    assert domain.contains([(np.nan, 0)]).tolist() == [False]
    assert domain.contains([]).shape == (0,)
    refused(lambda: domain.contains((0.5, 0.5)), "points has shape (2,)", "[point]", kind=InputError)
    refused(lambda: domain.contains(np.zeros((3, 4, 2))), "shape (3, 4, 2)", kind=InputError)
    refused(lambda: domain.contains("in"), "points is of type str", kind=InputTypeError)


def test_accepted_polygons(tmp_path):
    square = clvoro.Polygon(SQUARE)
    assert clvoro.Polygon.from_geojson(Geographic()) == square
    assert clvoro.Polygon.from_geojson(shapely.Polygon(SQUARE)) == square
    assert clvoro.Polygon(Foreign(SQUARE)) == square
    marked = tmp_path / "marked.geojson"  # by a byte order mark
    marked.write_text(json.dumps(Geographic().__geo_interface__), "utf-8-sig")
    assert clvoro.Polygon.from_geojson(marked) == square


# Files and pictures.


@pytest.mark.parametrize("path", [3, None, object(), "a\0.vtu"])
def test_paths(adapter, result, path):
    refused(lambda: result.save(path), "name of a file")
    refused(lambda: clvoro.load(path), "name of a file")
    if path is not None:
        refused(lambda: adapter.run(BOX, 0.2, checkpoint=path), "name of a file")
        refused(lambda: adapter.run(BOX, 0.2, checkpoint=clvoro.Checkpoint(resume=path)), "name of a file")


def test_versions_of_files(result, tmp_path):
    result.save(tmp_path / "a.npz")
    members = dict(np.load(tmp_path / "a.npz"))
    for version, remedy in ((99, "newer clvoro"), (0, "expected 1 to 2")):
        np.savez(tmp_path / "b.npz", **{**members, "version": np.array(version)})
        refused(lambda: clvoro.load(tmp_path / "b.npz"), remedy, kind=InputError)


def test_names_of_arrays(adapter, result):
    with pytest.raises(AttributeError, match="a Diagram has no 'areas'; it has points, volumes, "):
        _ = result.diagram.areas
    solid = adapter.diagram(clvoro.Box((0, 0, 0), (1, 1, 1)), [(0.5, 0.5, 0.5)])
    with pytest.raises(AttributeError, match=r"in 3D has no cell_vertices; it has .*face_vertices, weights, layer$"):
        _ = solid.cell_vertices
    assert not hasattr(copy.copy(result.diagram), "_cells")


def test_arrays_are_read_only(result, tmp_path):
    """An assignment to points would make all other arrays wrong."""
    result.save(tmp_path / "a.npz")
    result.save(tmp_path / "a.vtu")
    assert result.points is result.diagram.points
    again = pickle.loads(pickle.dumps(result))
    assert again.points is again.diagram.points
    loaded = clvoro.load(tmp_path / "a.npz"), clvoro.load(tmp_path / "a.vtu")
    replaced = dataclasses.replace(result, size_error=np.zeros(len(POINTS)))
    for mesh in (result, again, copy.deepcopy(result), copy.copy(result), replaced, *loaded):
        diagram = mesh.diagram
        arrays = {name: getattr(diagram, name) for name in dir(diagram) if name in diagram._NAMES}
        arrays |= {k: a for k, a in vars(mesh).items() if isinstance(a, np.ndarray)}
        arrays |= {} if mesh.final is None else vars(mesh.final)
        assert {"points", "volumes", "shifts", "size_error", "history"} <= set(arrays)
        for name, array in arrays.items():
            assert not array.flags.writeable, name
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 0
    given = POINTS.copy()
    diagram = clvoro.Diagram(BOX, {"points": given})
    given[0] = 0.5  # the caller's own is left alone
    assert not diagram.points.flags.writeable
    assert result.size_error.copy().flags.writeable


def test_colors(result):
    refused(lambda: result.plot(object()), "expected one of error", kind=InputTypeError)
    refused(lambda: result.plot(result.size_error[1:]), "one number per cell", kind=InputError)


# Cases.

CASE = """
[domain]
lower = [0, 0]
upper = [1, 1]
[size]
kind = "constant"
value = 0.3
[run]
effort = "fast"
max_steps = 1
"""


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (CASE + "[layers]\nheight = 0.01\n", ("layers", "double brackets")),
        (CASE.replace("constant", "expression").replace("value = 0.3", 'expression = "0.1 + x^2"'), ("pow(a, b)",)),
    ],
)
def test_cases(tmp_path, monkeypatch, capsys, text, parts):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(text)
    assert cli.main(["run", "mine.toml"]) == cli.BAD_INPUT
    error = capsys.readouterr().err
    for part in parts:
        assert part in error


def test_cases_from_other_editors(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(CASE, "utf-8-sig")
    assert cli.main(["run", "mine.toml", "--no-report", "--quiet"]) == cli.OK


def test_no_method(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(CASE)
    assert cli.main(["run", "mine.toml", "--method", ""]) == cli.BAD_INPUT
    assert "method is ''" in capsys.readouterr().err


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("periodic", [False, True], ids=["walls", "seams"])
def test_coincident_generators_are_reported_with_their_place(ctx, periodic, real):
    """The place is in the domain's units. In 3D generators two ulps apart count as coincident, because their bisectors
    with far generators are the same. In 2D they are distinct."""
    box = clvoro.Box((0,) * 3, (4,) * 3, periodic=periodic)
    points = np.random.default_rng(4).random((300, 3)) * 4
    step = 2 * float(np.spacing(np.asarray(2.75, real)))
    points[100:125] = 2.75
    points[100:125, :2] += step * np.stack(np.meshgrid(range(5), range(5)), axis=-1).reshape(-1, 2)
    with pytest.raises(InputError) as refused:
        clvoro.Adapter(ctx, real).diagram(box, points)
    said = str(refused.value)
    place = re.search(r"generators at \[(.*)\], (\S+) apart, are too close", said)
    assert place, said
    # Printed with eight digits after the point.
    assert np.array(place[1].split(), float) == pytest.approx(np.full(3, 2.75), abs=4 * step + 1e-8)
    assert place[2] == f"{step:.3g}"
    assert ("or use dtype='float64'" in said) == (real == "float32")


def test_closest_generators_are_reported(ctx):
    """The error names the two closest generators. In 3D clipping may fail first in a cell far from them."""
    lattice = np.stack(np.meshgrid(*[range(5)] * 3), axis=-1).reshape(-1, 3)
    cluster = 0.6875 + 2.0**-52 * lattice
    points = np.concatenate([cluster, np.random.default_rng(4).random((40, 3))])
    least = KDTree(points).query(points, k=2)[0][:, 1].min()
    with pytest.raises(InputError, match="too close") as refused:
        clvoro.Adapter(ctx).diagram(clvoro.Box((0, 0, 0), (1, 1, 1)), points)
    assert f", {least:.3g} apart" in str(refused.value)


def test_slab_too_thin_for_the_precision(ctx):
    """Its generators are far apart in the physical domain, so the message must not call them too close."""
    slab = clvoro.Box((0, 0, 0), (1e-6, 1, 1))
    points = np.random.default_rng(1).random((200, 3)) * slab.extent
    with pytest.raises(InputError, match=r"1e-06 thin.*use dtype='float64', or give it a thickness"):
        clvoro.Adapter(ctx, "float32").diagram(slab, points)
    assert clvoro.Adapter(ctx).diagram(slab, points).check()
