"""Cases with polygonal domains: files, rings, shapes as rings, the boundary as a shape, and the built-in ones."""

import json
import math

import numpy as np
import pytest
import shapely

import clvoro
from clvoro import sizing
from clvoro.cli.cases import Case, builtin_cases, load_case
from clvoro.cli.cases.files import FOLDER
from clvoro.errors import InputError
from tests.reference.polygons import HOLE, SQUARE

SIZE = "\n[size]\nkind = 'constant'\nvalue = 0.3\n"
RINGS = f"[domain]\nouter = {SQUARE.tolist()}\nholes = [{HOLE.tolist()}]\n"


def points(domain: clvoro.Polygon, n: int = 200) -> np.ndarray:
    return clvoro.adaptation.sampling.start.sample_uniform(domain, n, 3)


def test_domains_from_files_and_from_rings(tmp_path) -> None:
    wanted = clvoro.Polygon(SQUARE, [HOLE])
    geometry = {"type": "Polygon", "coordinates": [SQUARE.tolist(), HOLE.tolist()]}
    (tmp_path / "a.geojson").write_text(json.dumps(geometry))
    (tmp_path / "a.wkt").write_text(shapely.Polygon(SQUARE, [HOLE]).wkt)
    for text in (
        RINGS,
        "[domain]\npolygon = 'a.geojson'\n",
        "[domain]\npolygon = 'a.wkt'\n",
        "[domain]\nkind = 'polygon'\nfile = 'a.geojson'\n",
        RINGS.replace("outer", "kind = 'polygon'\nouter"),
    ):
        case = Case.from_toml(text + SIZE, "my.toml", tmp_path)
        assert case.domain == wanted
        # Written somewhere else, it is the same case with the same file.
        moved = tmp_path / "moved"
        moved.mkdir(exist_ok=True)
        again = load_case(case.write(moved))
        assert again.domain == wanted
        assert again.table == case.table


def test_simplified_domains(tmp_path) -> None:
    creek = "[domain]\nouter = [[0, 0], [1, 0], [1, 0.5], [2, 0.52], [1, 0.54], [1, 1], [0, 1]]\nsimplified = 0.1\n"
    case = Case.from_toml(creek + SIZE, "my.toml", tmp_path)
    assert case.domain.upper[0] < 1.1
    assert load_case(case.write(tmp_path)).domain == case.domain
    with pytest.raises(InputError, match=r"simplified"):
        Case.from_toml(creek.replace("0.1\n", "0\n") + SIZE, "my.toml")


def test_rings_that_cross_are_repaired_on_request(tmp_path) -> None:
    (tmp_path / "bow.wkt").write_text("POLYGON ((0 0, 2 2, 2 0, 0 2, 0 0))")
    for domain in ("polygon = 'bow.wkt'\n", "outer = [[0, 0], [2, 2], [2, 0], [0, 2]]\n"):
        with pytest.raises(InputError, match="repair = true"):
            Case.from_toml(f"[domain]\n{domain}" + SIZE, "my.toml", tmp_path)
        with pytest.warns(clvoro.errors.MismatchWarning, match="were repaired"):
            case = Case.from_toml(f"[domain]\n{domain}repair = true\n" + SIZE, "my.toml", tmp_path)
        assert case.domain.measure == pytest.approx(2)


def test_curves_as_rings() -> None:
    text = (
        "[domain]\nouter = { kind = 'circle', center = [1, 2], radius = 3, name = 'far' }\n"
        "holes = [{ kind = 'naca', code = '2412', leading_edge = [0.5, 2], trailing_edge = 'blunt' },\n"
        "  [[1, 0], [2, 0], { kind = 'arc', center = [1, 0], radius = 1, start = 0, end = 90 }],\n"
        "  { kind = 'spline', points = [[0, 0], [0.5, 0.5], [0, 1]], closed = true, corners = [1] }]\n"
    )
    case = Case.from_toml(text + SIZE, "my.toml")
    c = clvoro.curves
    holes = [
        c.naca("2412", leading_edge=(0.5, 2), trailing_edge="blunt"),
        [(1, 0), (2, 0), c.arc((1, 0), 1, 0, 90)],
        c.spline([(0, 0), (0.5, 0.5), (0, 1)], True, [1]),
    ]
    wanted = clvoro.Polygon(c.circle((1, 2), 3, name="far"), holes)
    assert case.domain == wanted
    assert case.domain.boundary_names == ("far", "hole-1", "hole-2", "hole-3")
    again = Case.from_toml(clvoro.cli.cases.files.write_toml(case.table), "case.toml")
    assert again.domain == wanted


def test_curves_as_shapes() -> None:
    text = (
        "[domain]\nlower = [0, 0]\nupper = [1, 1]\n[size]\nkind = 'distance'\nh_min = 0.1\nslope = 1\n"
        "shapes = [{ kind = 'arc', center = [0, 0], radius = 1, start = 0, end = 45 }]\n"
    )
    size = Case.from_toml(text, "my.toml").size_field()
    assert size(np.array([(0.5, 0.2), (0.0, 1.0)])) == pytest.approx(
        [0.1 + 1 - np.hypot(0.5, 0.2), 0.1 + 2 * np.sin(np.pi / 8)], abs=1e-6
    )


def test_sizes_from_the_boundary() -> None:
    distance = "\n[size]\nkind = 'distance'\nh_min = 0.01\nslope = 0.5\nshapes = [{ kind = 'boundary' %s }]\n"
    domain = clvoro.Polygon(SQUARE, [HOLE])
    x = points(domain)
    clockwise = RINGS.replace(str(HOLE.tolist()), str(HOLE[::-1].tolist()))
    for rings in (RINGS, clockwise):
        size = Case.from_toml(rings + distance % "", "my.toml").size_field()
        assert size(x) == pytest.approx(0.01 + 0.5 * domain.boundary_distance(x))
    # Numbers are those of the rings as the case gives them: 4 to 7 are the hole's.
    for rings, hole in ((RINGS, HOLE), (clockwise, HOLE[::-1])):
        size = Case.from_toml(rings + distance % ", edges = [6]", "my.toml").size_field()
        wanted = sizing.Distance(sizing.Segment(hole[2], hole[3]), 0.01, slope=0.5)
        assert size(x) == pytest.approx(wanted(x))
    feature = "\n[size]\nkind = 'feature'\ncells_across = 3\nh_max = 0.5\ngrowth = 1.3\ncurvature = 0\n"
    size = Case.from_toml(RINGS + feature, "my.toml").size_field()
    wanted = sizing.FeatureSize(domain, 3, growth=1.3, h_max=0.5, curvature=0)
    assert size(x) == pytest.approx(wanted(x), rel=1e-15)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[domain]\npolygon = 3\n", "domain.file is 3"),
        ("[domain]\nsolid = 'a.stl'\nunit = 'mm'\n", "did you mean 'units'.*; it takes solid, units"),
        ("[domain]\npolygon = 'none.geojson'\n", "cannot read none.geojson"),
        ("[domain]\npolygon = 'none.wkt'\n", "cannot read none.wkt"),
        ("[domain]\npolygon = 'a.geojson'\nholes = [[[0, 0], [1, 0], [1, 1]]]\n", "both a file and holes"),
        ("[domain]\nouter = [[0, 0], [1, 0], [1]]\n", r"domain.outer\[2\] is \[1\]"),
        ("[domain]\nouter = { kind = 'sphere' }\n", "domain.outer.kind is 'sphere'"),
        ("[domain]\nkind = 'polygon'\n", "none of file, outer"),
        ("[domain]\nkind = 'polygon'\nlower = [0, 0]\n", "unknown key 'lower'"),
    ],
)
def test_what_is_refused(text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        Case.from_toml(text + SIZE, "my.toml")


def test_edges_of_a_boundary_must_be_there() -> None:
    shape = "\n[size]\nkind = 'distance'\nh_min = 0.1\nslope = 0.5\nshapes = [{ kind = 'boundary', edges = [8] }]\n"
    with pytest.raises(InputError, match=r"edges has edge 8, .* from 0 to 7"):
        Case.from_toml(RINGS + shape, "my.toml").size_field()
    box = "[domain]\nlower = [0, 0]\nupper = [1, 1]\n"
    with pytest.raises(InputError, match=r"edges has side 8, .* from 0 to 3"):
        Case.from_toml(box + shape, "my.toml").size_field()
    with pytest.raises(InputError, match="a polygon in"):
        Case.from_toml(box + "\n[size]\nkind = 'feature'\n", "my.toml").size_field()
    sides = Case.from_toml(box + shape.replace(", edges = [8]", ""), "my.toml").size_field()
    assert sides(np.array([(0.5, 0.3)])) == pytest.approx(0.25)


@pytest.mark.slow
def test_the_lake_is_simplified() -> None:
    whole, domain = clvoro.Polygon.from_geojson(FOLDER / "lake.geojson"), load_case("lake").domain
    assert domain == whole.simplified(0.012)
    assert len(domain.piece_of_ring) == 7
    assert 1500 < len(domain.vertices) < 2500
    assert {"lake", "channel"} <= set(builtin_cases())


@pytest.mark.slow
def test_the_lake_has_cells_across_its_straits() -> None:
    case = load_case("lake")
    size, domain = case.size_field(), case.domain
    # The strait between the two islands in the north: nearest points of their rings.
    one, two = (clvoro.Polygon(domain.rings[i][::-1]).geometry for i in (2, 3))
    a, b = shapely.get_coordinates(shapely.shortest_line(one, two))
    across = a + np.linspace(0, 1, 101)[:, None] * (b - a)
    cells = np.mean(1 / size(across)) * np.hypot(*(b - a))
    assert cells >= 4 * 0.98
    assert size(points(domain, 2000)).min() >= 0.012 * (1 - 1e-12)


def test_the_channel_is_that_of_the_benchmark() -> None:
    case = load_case("channel")
    assert case.domain.measure == pytest.approx(2.2 * 0.41 - math.pi * 0.05**2, rel=1e-7)
    assert set(case.domain.boundary_names) == {"walls", "inlet", "outlet", "cylinder"}
    size = case.size_field()
    assert size(np.array([(0.5, 0.2), (2.2, 0.41)])) == pytest.approx([0.005, 0.025])
    (layer,) = case.run_arguments()["layers"]
    assert layer.edges == ("cylinder",)


def test_cases_run(ctx) -> None:
    adapter = clvoro.Adapter(ctx)
    case = load_case("channel")
    result = adapter.run(case.domain, 8 * case.size_field(), effort="fast", seed=1)
    assert result.check().ok
    assert result.diagram.volumes.sum() == pytest.approx(case.domain.measure, rel=1e-12)


LAYERED = """
[domain]
outer = [[0, 0], [2, 0], [2, 1], [0, 1]]
holes = [{ kind = "circle", center = [1, 0.5], radius = 0.2 }]

[size]
kind = "constant"
value = 0.1

[[layers]]
height = 0.02
count = 2
edges = "hole-1"

[[layers]]
height = 0.03
edges = [0]
"""


def test_layers_of_a_case(tmp_path):
    case = Case.from_toml(LAYERED, "layered")
    around, below = case.run_arguments()["layers"]
    assert around == clvoro.Layers(0.02, count=2, edges="hole-1")
    assert below == clvoro.Layers(0.03, edges=[0])
    again = load_case(case.write(tmp_path))
    assert again.run_arguments()["layers"] == [around, below]
    with pytest.raises(InputError, match=r"edges\[0\] is 0\.5, expected a whole number or a text"):
        Case.from_toml(LAYERED.replace("edges = [0]", "edges = [0.5]"), "layered")


def test_regions_and_boxes(tmp_path):
    (tmp_path / "island.wkt").write_text("POLYGON ((3 0.2, 3.5 0.2, 3.5 0.5, 3 0.2))")
    (tmp_path / "case.toml").write_text("""
[domain]
outer = {kind = "box", lower = [0, 0], upper = [4, 1]}
holes = [{kind = "box", lower = [1, 0.4], upper = [1.3, 0.6]}]
[size]
kind = "region"
h = 0.02
growth = 1.2
h_max = 0.2
shapes = [
    {kind = "box", lower = [1.3, 0.3], upper = [2.5, 0.7]},
    {kind = "polygon", outer = [[0.5, 0.5], [0.9, 0.3], [0.9, 0.7]]},
    {kind = "polygon", file = "island.wkt"},
]
""")
    case = load_case(tmp_path / "case.toml")
    assert case.domain.measure == pytest.approx(4 - 0.06)
    h = case.size_field()(np.array([(2, 0.5), (0.8, 0.5), (3.4, 0.4), (0.1, 0.1)]))
    assert h[:3].tolist() == [0.02] * 3
    assert h[3] > 0.05
    for old, new, says in (
        ("upper = [1.3, 0.6]", "upper = [0.9, 0.6]", "expected lower < upper"),
        ("h = 0.02", "h_min = 0.02", "size"),
    ):
        text = (tmp_path / "case.toml").read_text().replace(old, new)
        with pytest.raises(InputError, match=says):
            Case.from_toml(text, "bad", tmp_path)
