"""Case files: what they may hold, how they are refused, and that writing and reading agree."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import clvoro
from clvoro import Box, sizing
from clvoro.cli.cases import Case, builtin_cases, files, load_case
from clvoro.errors import InputError

HEAD = "[domain]\nlower = [0, 0]\nupper = [2, 1]\n"


def case(text, folder=None):
    return Case.from_toml(HEAD + text, "my.toml", *([folder] if folder else []))


def field(size_text, folder=None):
    return case(size_text, folder).size_field()


def points(n=200):
    return np.random.default_rng(71).random((n, 2)) * (2, 1)


# --- reading -------------------------------------------------------------------------------------


def test_paper_case_is_the_documented_field():
    paper = load_case("paper")
    assert paper.domain == Box((0, 0), (2.5, 1.5))
    assert paper.methods == ("lloyd", "poisson", "coupled")
    x = np.random.default_rng(19).random((100, 2)) * (2.5, 1.5)
    wanted = 0.02 + 0.3 * np.abs(np.hypot(x[:, 0] - 0.9, x[:, 1] - 0.75) - 0.3)
    assert paper.size_field()(x) == pytest.approx(wanted, rel=1e-12)


def test_airfoil_case_leaves_the_section_out_and_resolves_its_wake():
    airfoil = load_case("airfoil")
    section = clvoro.Polygon(clvoro.curves.naca("2412", angle_of_attack=4.0))
    assert airfoil.domain.measure == pytest.approx(6 * 3 - section.measure, rel=1e-12)
    size = airfoil.size_field()
    assert size(np.array([(2.0, -0.085), (-2.0, 1.5)])) == pytest.approx([0.02, 0.12], rel=0.1)
    (layer,) = airfoil.run_arguments()["layers"]
    assert layer.edges == ("airfoil",)


def test_every_built_in_case_survives_being_written():
    for name in builtin_cases():
        read = load_case(name)
        again = Case.from_toml(files.write_toml(read.table), "case.toml")
        assert again.table == read.table


def test_kinds_of_size_fields(tmp_path):
    x = points()
    assert field("[size]\nkind = 'constant'\nvalue = 0.3")(x) == pytest.approx(0.3)
    assert Case.from_toml("size = 0.3\n" + HEAD, "my.toml").size_field()(x) == pytest.approx(0.3)
    assert field("[size]\nkind = 'expression'\nexpression = '0.1 + 0.05 * x * y'")(x) == pytest.approx(
        0.1 + 0.05 * x[:, 0] * x[:, 1]
    )
    values = np.random.default_rng(5).random((4, 7)) + 0.5
    np.save(tmp_path / "h.npy", values)
    raster = field("[size]\nkind = 'raster'\nfile = 'h.npy'", tmp_path)
    assert raster(x) == pytest.approx(sizing.Raster(values, (0, 0), (2, 1))(x))
    tree = """
[size]
kind = "min"
[[size.fields]]
kind = "scale"
factor = 2.0
field = 0.2
[[size.fields]]
kind = "distance"
h_min = 0.01
slope = 0.5
shapes = [
  { kind = "segment", a = [0, 0], b = [1, 0] },
  { kind = "circle", center = [1.5, 0.5], radius = 0.1 },
  { kind = "polyline", points = [[0, 1], [1, 1], [1, 0.8]] },
  { kind = "closed_polyline", points = [[0.2, 0.2], [0.4, 0.2], [0.3, 0.4]] },
]
"""
    shapes = [
        sizing.Segment((0, 0), (1, 0)),
        sizing.Circle((1.5, 0.5), 0.1),
        sizing.Polyline([(0, 1), (1, 1), (1, 0.8)]),
        sizing.ClosedPolyline([(0.2, 0.2), (0.4, 0.2), (0.3, 0.4)]),
    ]
    wanted = np.minimum(0.4, sizing.Distance(shapes, 0.01, slope=0.5)(x))
    assert field(tree)(x) == pytest.approx(wanted)
    assert field(tree.replace('"min"', '"sum"'))(x) == pytest.approx(0.4 + sizing.Distance(shapes, 0.01, slope=0.5)(x))


def test_kinds_in_space(tmp_path):
    pytest.importorskip("trimesh")
    (tmp_path / "roof.off").write_text("OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 1\n0 1 1\n3 0 1 2\n3 0 2 3\n")
    read = Case.from_toml(
        "[domain]\nlower = [0, 0, 0]\nupper = [1, 1, 1]\n[size]\nkind = 'distance'\nh_min = 0.1\n"
        "slope = 0.5\nshapes = [{ kind = 'surface', file = 'roof.off' }, { kind = 'box' },\n"
        "{ kind = 'sphere', center = [0.5, 0.2, 0.7], radius = 0.1 }]",
        "my.toml",
        tmp_path,
    )
    x = np.random.default_rng(404).random((300, 3))
    roof = np.abs(x[:, 1] - x[:, 2]) / math.sqrt(2)
    walls = np.minimum(x, 1 - x).min(axis=1)
    ball = np.abs(np.linalg.norm(x - (0.5, 0.2, 0.7), axis=1) - 0.1)
    wanted = 0.1 + 0.5 * np.minimum(np.minimum(roof, walls), ball)
    assert read.size_field()(x) == pytest.approx(wanted)
    out = tmp_path / "out"
    out.mkdir()
    again = load_case(read.write(out))
    assert (out / "roof.off").is_file()
    assert again.size_field()(x) == pytest.approx(wanted)


def test_graded_and_products():
    x = points()
    text = (
        "[size]\nkind = 'graded'\nslope = 0.2\nresolution = 201\n[size.field]\n"
        "kind = 'expression'\nexpression = 'x < 1 ? 0.05 : 1'"
    )
    ramp = 0.05 + 0.2 * np.maximum(x[:, 0] - 1, 0)
    assert field(text)(x) == pytest.approx(ramp, abs=0.2 * 0.0101)  # one spacing
    pair = "[size]\nkind = 'product'\nfields = [0.2, {kind = 'expression', expression = '1 + x'}]"
    assert field(pair)(x) == pytest.approx(0.2 * (1 + x[:, 0]))
    assert field(pair.replace("product", "quotient"))(x) == pytest.approx(0.2 / (1 + x[:, 0]))


def test_sizes_from_a_solution(tmp_path):
    u = np.tanh(5 * np.linspace(-1, 1, 81)) + np.zeros((41, 1))
    np.save(tmp_path / "u.npy", u)
    text = "[size]\nkind = 'hessian'\nfile = 'u.npy'\nn_cells = 500\nh_max = 0.2"
    wanted = sizing.hessian_size(sizing.Raster(u, (0, 0), (2, 1)), n_cells=500, h_max=0.2)
    assert field(text, tmp_path)(points()) == pytest.approx(wanted(points()))
    text = "[size]\nkind = 'gradient'\nfile = 'u.npy'\neps = 0.1\nh_max = 0.2"
    wanted = sizing.gradient_size(sizing.Raster(u, (0, 0), (2, 1)), eps=0.1, h_max=0.2)
    assert field(text, tmp_path)(points()) == pytest.approx(wanted(points()))


def test_sizes_from_fields_of_other_programs(tmp_path):
    x = np.random.default_rng(3).random((600, 2)) * (2, 1)
    np.savez(tmp_path / "flow.npz", points=x, u=np.tanh(5 * (x[:, 0] - 1)), h=0.05 + 0.1 * x[:, 0])
    text = "[size]\nkind = 'hessian'\nfile = 'flow.npz'\nfields = ['u']\nn_cells = 500\ngrowth = 1.3"
    mesh, values = clvoro.read_fields(tmp_path / "flow.npz", domain=clvoro.Box((0, 0), (2, 1)))
    wanted = sizing.hessian_size(values["u"], on=mesh, n_cells=500, growth=1.3)
    assert field(text, tmp_path)(points()) == pytest.approx(wanted(points()))
    sizes = "[size]\nkind = 'cells'\nfile = 'flow.npz'\nfield = 'h'"
    assert field(sizes, tmp_path)(points()) == pytest.approx(0.05 + 0.1 * points()[:, 0], abs=5e-3)
    for wrong, said in (
        (text.replace("'u'", "'p'"), "it has no field p; it has u, h"),
        (text + "\nat = 'nodes'", "size has at with fields; leave it out"),
        (text.replace("fields = ['u']", ""), "size has growth without fields; name fields"),
        (text.replace("fields = ['u']\n", "").replace("growth = 1.3", ""), "cannot be read as an array|shape"),
    ):
        with pytest.raises(InputError, match=said):
            field(wrong, tmp_path)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("size = 0.1\n[run]\nmax_step = 3", ["run", "'max_step'", "did you mean 'max_steps'"]),
        ("size = 0.1\n[run]\nk = -1", ["run.k", "-1"]),
        ("size = 0.1\n[run]\nseed = 1.5", ["run.seed", "1.5", "whole"]),
        ("size = 0.1\n[run]\nstart = 'densty'", ["run.start", "did you mean 'density'"]),
        ("size = 0.1\n[run]\nmethod = 'lloyd'\nmethods = ['lloyd']", ["method and methods"]),
        ("size = 0.1\n[run]\nmethods = ['lloyd', 'lloyd']", ["run", "'lloyd'", "each name once"]),
        ("size = -0.1", ["size", "-0.1", "a number > 0"]),
        ("size = nan", ["size", "finite"]),
        ("sise = 0.1", ["'sise'", "did you mean 'size'"]),
        ("seed = 3\nsize = 0.1", ["'seed'", "it belongs to [run]"]),
        ("size = 0.1\n[run]\nperiodic = true", ["run", "'periodic'", "it belongs to [domain]"]),
        ("size = 0.1\n[run]\nspacing = 0.1", ["run", "'spacing'", "it belongs to [[layers]]"]),
        (
            "[size]\nkind = 'constant'\nvalue = 0.1\nslope = 0.2",
            ["size", "'slope'", "it is for kind = 'caps' or 'distance' or 'region' or 'graded'"],
        ),
        ("", ["lacks size"]),
        ("[size]\nkind = 'distnce'", ["size.kind", "did you mean 'distance'"]),
        ("[size]\nkind = 'raster'", ["size", "lacks file"]),
        ("[size]\nh_min = 1", ["size lacks kind; expected kind = one of constant, "]),
        ("[size]\nkind = 'distance'\nhmin = 0.1\nshapes = []", ["size", "'hmin'", "did you mean 'h_min'"]),
        (
            "[size]\nkind='distance'\nh_min=1\nslope=1\ngrowth=2\nshapes=[{kind='circle',center=[0,0],radius=1}]",
            ["growth, slope", "exactly one"],
        ),
        (
            "[size]\nkind='distance'\nh_min=1\nslope=1\nshapes=[{kind='circle',centre=[0,0],radius=1}]",
            ["size.shapes[0]", "'centre'", "did you mean 'center'"],
        ),
        (
            "[size]\nkind='distance'\nh_min=1\nslope=1\nshapes=[{kind='segment',a=[0],b=[1,1]}]",
            ["size.shapes[0].a", "a list of length >= 2"],
        ),
        ("[size]\nkind='graded'\nfield=1", ["size", "none of growth, slope"]),
        ("[size]\nkind='graded'\nslope=1\nfield=-1", ["size.field", "a number > 0"]),
        ("[size]\nkind='hessian'\nfile='u.npy'\neps=1\nn_cells=5", ["n_cells, eps"]),
        ("[size]\nkind='quotient'\nfields=[1]", ["size.fields", "length >= 2"]),
        (
            "[size]\nkind='distance'\nh_min=1\nslope=1\nshapes=[{kind='sphere',center=[0,0],radius=1}]",
            ["size.shapes[0].center", "a list of length 3"],
        ),
        ("[size]\nkind='distance'\nh_min=1\nslope=1\nshapes=[{kind='surface'}]", ["lacks file"]),
        ("a b", ["not a TOML file", "line"]),
        ("size = .1", ["not a TOML file", "write 0.1 for .1"]),
    ],
)
def test_refusals_name_the_key(text, named):
    # Bare keys have to stand before the first table.
    whole = text + "\n" + HEAD if text[:1] == "s" else HEAD + text
    with pytest.raises(InputError) as refused:
        Case.from_toml(whole, "my.toml")
    for part in ["my.toml", *named]:
        assert part in str(refused.value)


def test_unknown_case_names_the_nearest():
    with pytest.raises(InputError, match="did you mean 'paper'"):
        load_case("papre")


# --- writing -------------------------------------------------------------------------------------


def test_written_case_carries_its_files(tmp_path):
    source, target = tmp_path / "source", tmp_path / "elsewhere"
    source.mkdir(), target.mkdir()
    values, start = np.full((3, 3), 0.25), points(12)
    np.save(source / "h.npy", values)
    np.save(source / "start.npy", start)
    read = case(
        "[size]\nkind = 'scale'\nfactor = 0.5\n[size.field]\nkind = 'raster'\nfile = 'h.npy'\n"
        "[run]\npoints = 'start.npy'",
        source,
    )
    path = read.write(target, ("a comment",))
    for file in source.iterdir():
        file.unlink()
    again = load_case(path)
    assert path.read_text().startswith("# a comment\n")
    assert again.size_field()(start) == pytest.approx(0.125)
    assert np.array_equal(again.run_arguments()["points"], start)
    again.write(target)  # over itself
    assert load_case(path).table == again.table


def test_files_of_one_name_are_kept_apart(tmp_path):
    for folder, value in (("a", 0.1), ("b", 0.2)):
        (tmp_path / folder).mkdir()
        np.save(tmp_path / folder / "h.npy", np.full((2, 2), value))
    read = case(
        "[size]\nkind = 'sum'\n[[size.fields]]\nkind = 'raster'\nfile = 'a/h.npy'\n"
        "[[size.fields]]\nkind = 'raster'\nfile = 'b/h.npy'",
        tmp_path,
    )
    out = tmp_path / "out"
    out.mkdir()
    assert load_case(read.write(out)).size_field()(points()) == pytest.approx(0.3)


def test_run_settings_are_checked_when_changed():
    read = load_case("paper")
    changed = read.with_run(method="coupled", max_steps=7, seed=None)
    assert changed.methods == ("coupled",)
    assert "methods" not in changed.run
    assert (changed.run["max_steps"], changed.run["seed"]) == (7, read.run["seed"])
    with pytest.raises(InputError, match=r"run\.max_steps"):
        read.with_run(max_steps=-2)


leaves = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(blacklist_categories=["Cs"]), max_size=8)
)
keys = st.text(st.characters(blacklist_categories=["Cs"]), max_size=6)
tables = st.recursive(
    st.dictionaries(keys, leaves, max_size=3),
    lambda t: st.dictionaries(keys, leaves | t | st.lists(t, max_size=3) | st.lists(leaves, max_size=3), max_size=4),
    max_leaves=10,
)


@given(tables)
def test_toml_is_read_as_it_was_written(table):
    assert files.read_toml(files.write_toml(table)) == table


def test_toml_is_written_with_lists_of_numbers_on_one_line():
    text = files.write_toml({"a": [0.5, 1], "b": [[1, 2], [3, 4]], "c": [{"d": "x, y"}]}, ["note", "", "more"])
    lists = "a = [0.5, 1]\nb = [\n    [1, 2],\n    [3, 4],\n]\n"
    assert text == f'# note\n#\n# more\n\n{lists}c = [\n    {{ d = "x, y" }},\n]\n'


def test_fixed_generators_are_positions_or_a_file(tmp_path):
    at = [[0.5, 0.25], [1.5, 0.75]]
    np.save(tmp_path / "wells.npy", at)
    (tmp_path / "wells.csv").write_text("name, X, Y, rate\na, 0.5, 0.25, 3\nb, 1.5, 0.75, 4\n")
    points = [{"type": "Feature", "geometry": {"type": "Point", "coordinates": x}} for x in at]
    (tmp_path / "wells.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": points}))
    size = "[size]\nkind = 'distance'\nshapes = ['wells.geojson', 'river.geojson']\nh_min = 0.1\nslope = 0.2\n[run]\n"
    river = {"type": "LineString", "coordinates": [[0, 0.5], [2, 0.5]]}
    (tmp_path / "river.geojson").write_text(json.dumps(river))
    values = at, "'wells.npy'", "'wells.csv'", "'wells.geojson'"
    cases = [case(f"{size}fixed = {value}", tmp_path) for value in values]
    out = tmp_path / "out"
    out.mkdir()
    for read in (*cases, load_case(cases[2].write(out))):
        assert np.array_equal(read.run_arguments()["fixed"], at)
        assert read.size_field()([(0.5, 0.25), (1, 0.5), (1, 0.9)]) == pytest.approx([0.1, 0.1, 0.18])
    with pytest.raises(InputError, match=r"run\.fixed names .*river\.geojson' with LineString, expected points"):
        case(f"{size}fixed = 'river.geojson'", tmp_path).run_arguments()
    for table, why in {"x, y\n1, deep\n": "deep", "easting, y\n1, 2\n": "easting", "": "none"}.items():
        (tmp_path / "wells.csv").write_text(table)
        with pytest.raises(InputError, match=rf"run\.fixed names .*{why}.*expected columns x and y, or lon and lat"):
            cases[2].run_arguments()
    with pytest.raises(InputError, match=r"run\.fixed.*a text in quotes or a list"):
        case(f"{size}fixed = 0.5")
