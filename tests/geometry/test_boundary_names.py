"""Names and numbers of boundaries: one numbering, the caller's, for every consumer and every orientation of rings."""

import itertools
import json
import pickle

import numpy as np
import pytest
import shapely

import clvoro
from clvoro import sizing
from clvoro.cli.cases import Case
from clvoro.errors import InputError, InputTypeError
from clvoro.geometry.boundary_layers import LayerRows
from clvoro.io.contents import Contents
from clvoro.io.vtu import cell_data
from tests.io import test_foam
from tests.io.test_netcdf import read as read_netcdf

OUTER = np.array([(0.0, 0), (4, 0), (4, 3), (2, 3.5), (0, 3)])
HOLES = [np.array([(1.0, 1), (1.5, 1), (1.25, 1.5)]), np.array([(2.5, 1), (3, 1), (3, 1.5), (2.5, 1.5)])]
NAMES = {"in--let": [4], "island": range(5, 8), "part": [9, 2]}
ORIENTATIONS = list(itertools.product((False, True), repeat=3))


def turned(orientation) -> list[np.ndarray]:
    rings = [OUTER, *HOLES]
    return [r[::-1] if back else r for r, back in zip(rings, orientation, strict=True)]


def segments(rings) -> list[shapely.LineString]:
    """The edges in the caller's order."""
    return [shapely.LineString([ring[k], ring[(k + 1) % len(ring)]]) for ring in rings for k in range(len(ring))]


@pytest.fixture(scope="module", params=ORIENTATIONS, ids=lambda o: "".join("-+"[not b] for b in o))
def meshed(request, adapter_of_module):
    """Rings, their edges, and a mesh of the domain."""
    rings = turned(request.param)
    domain = clvoro.Polygon(rings[0], rings[1:], names=NAMES)
    points = np.random.default_rng(5).uniform(0, 3.5, (600, 2))
    diagram = adapter_of_module.diagram(domain, points[domain.contains(points)])
    diagram = adapter_of_module.diagram(domain, diagram.centroids)
    n = len(diagram)
    from clvoro.mesh.results import HISTORY_DTYPE

    result = clvoro.Result(
        points=diagram.points,
        diagram=diagram,
        target_size=np.ones(n),
        size_error=np.zeros(n),
        quality=np.ones(n),
        history=np.zeros(0, HISTORY_DTYPE),
        converged=True,
        stop_reason="none",
    )
    return rings, segments(rings), result


@pytest.fixture(scope="module")
def adapter_of_module(ctx):
    return clvoro.Adapter(ctx)


def middles_of_faces(diagram):
    """Middle and wall of each face on the boundary."""
    walls = np.flatnonzero(diagram.neighbors < 0)
    ends = diagram.vertices[diagram.face_vertices.reshape(-1, 2)[walls]]
    return ends.mean(axis=1), -1 - diagram.neighbors[walls]


@pytest.mark.sparse(3)
def test_neighbors_are_the_callers_edges(meshed) -> None:
    rings, edges, result = meshed
    middles, walls = middles_of_faces(result.diagram)
    assert set(walls.tolist()) == set(range(12))
    for middle, k in zip(middles, walls, strict=True):
        assert edges[k].distance(shapely.Point(middle)) < 1e-14
    result.diagram.check().demand()
    domain = result.diagram.domain
    assert np.array_equal(domain.vertices, np.concatenate(rings))
    assert domain.boundary_names == ("in--let", "island", "part", "outer", "hole-2")
    assert domain.boundary_index.tolist() == [3, 3, 2, 3, 0, 1, 1, 1, 4, 2, 4, 4]
    nearest, feet = domain.nearest_edge(middles)
    assert nearest.tolist() == walls.tolist()
    assert np.abs(feet - middles).max() < 1e-14


def test_boundary_layers_and_distances_take_names_and_numbers(meshed) -> None:
    _, edges, result = meshed
    domain = result.diagram.domain
    x = np.random.default_rng(1).uniform(0, 3, (50, 2))
    x = x[domain.contains(x)]
    for selection in (4, [0, 10], "island", ["part", 0], "outer"):
        chosen = domain.boundaries.select("test", selection)
        shape = shapely.union_all([edges[k] for k in chosen])
        curve = domain.boundary(selection)
        ends = np.stack([curve.begin, curve.end], axis=1)
        assert shapely.union_all(shapely.linestrings(ends)).equals(shape)
        h = sizing.Distance(curve, 0.1, slope=0.5)(x)
        assert h == pytest.approx(0.1 + 0.5 * shapely.distance(shape, shapely.points(x)), rel=1e-14)
        layer = clvoro.Layers(0.01, edges=selection)
        lines = shapely.linestrings(LayerRows(domain, [layer]).segments(0))
        assert shapely.union_all(lines).equals(shape)


def test_layers_stand_on_the_named_walls(meshed) -> None:
    domain, layers = meshed[2].diagram.domain, clvoro.Layers(0.02, count=2, edges="island")
    away = shapely.distance(shapely.Polygon(HOLES[0]), shapely.points(LayerRows(domain, [layers]).points))
    assert len(away) > 100
    assert away.max() < layers.rows[-1] * (1 + 1e-12)


@pytest.mark.sparse(3)
def test_feature_size_does_not_depend_on_orientation(meshed) -> None:
    _, _, result = meshed
    x = result.diagram.points
    h = sizing.FeatureSize(result.diagram.domain, 4, h_max=1)(x)
    plain = sizing.FeatureSize(clvoro.Polygon(OUTER, HOLES), 4, h_max=1)(x)
    assert h == pytest.approx(plain, rel=1e-9)


@pytest.mark.sparse(4)
@pytest.mark.parametrize("walls", ["exact", "straight"])
def test_openfoam_has_the_names(meshed, tmp_path, walls) -> None:
    _, edges, result = meshed
    domain = result.diagram.domain
    for patches, parts in (
        (None, {name: domain.boundaries.select("", name) for name in domain.boundary_names}),
        (
            {"top": [2, 3]},
            {"top": [2, 3], "in--let": [4], "island": [5, 6, 7], "part": [9], "outer": [0, 1], "hole-2": [8, 10, 11]},
        ),
    ):
        result.to_openfoam(tmp_path / "polyMesh", patches=patches, walls=walls, check=False)
        points, faces, *_, written = test_foam.read(tmp_path / "polyMesh")
        assert list(written)[:-2] == list(parts)
        for name, numbers in parts.items():
            shape = shapely.union_all([edges[k] for k in numbers])
            _, count, start = written[name]
            middles = [points[face].mean(axis=0)[:2] for face in faces[start : start + count]]
            off = shapely.distance(shape, shapely.points(middles))
            if walls == "exact":
                assert count >= len(numbers)
                assert off.max() < 1e-14
            else:  # chords cut corners that turn by little
                assert count > 0
                assert off.max() < 0.3 * np.sqrt(result.diagram.volumes.max())
                assert np.median(off) < 1e-14


def test_netcdf_has_walls_and_names(meshed, tmp_path) -> None:
    _, edges, result = meshed
    domain = result.diagram.domain
    result.save(tmp_path / "mesh.nc")
    mesh = read_netcdf(tmp_path / "mesh.nc")
    on = np.flatnonzero(mesh["wall"] >= 0)
    x = np.column_stack([mesh["mesh_edge_x"], mesh["mesh_edge_y"]])[on]
    for middle, k in zip(x, mesh["wall"][on], strict=True):
        assert edges[k].distance(shapely.Point(middle)) < 1e-14
    assert np.array_equal(mesh["boundary"][on], domain.boundary_index[mesh["wall"][on]])
    assert (np.delete(mesh["boundary"], on) == -1).all()
    about = mesh.about["boundary"]
    assert about["flag_meanings"].decode().split() == list(domain.boundary_names)
    assert about["flag_values"].tolist() == list(range(5))


@pytest.mark.sparse(2)
def test_cell_data_have_the_boundary_of_the_largest_face(meshed) -> None:
    _, edges, result = meshed
    d = result.diagram
    found = cell_data(Contents.of(result))["boundary"]
    ends = d.vertices[d.face_vertices.reshape(-1, 2)]
    touching = 0
    for i, (a, b) in enumerate(itertools.pairwise(d.neighbor_starts.tolist())):
        faces = [shapely.LineString(e) for e in ends[a:b]]
        lengths = {}
        for name in d.domain.boundary_names:
            shape = shapely.union_all([edges[k] for k in d.domain.boundaries.select("", name)])
            lengths |= {f.length: name for f in faces if f.centroid.distance(shape) < 1e-12}
        expected = d.domain.boundary_names.index(lengths[max(lengths)]) if lengths else -1
        assert found[i] == expected
        touching += bool(lengths)
    assert 50 < touching < len(d)


def test_names_of_boxes(adapter_of_module, tmp_path) -> None:
    names = {"inlet": "xMin", "walls": ["yMin", 3]}
    box = clvoro.Box((0, 0), (2, 1), names=names)
    assert box.boundary_names == ("inlet", "walls", "xMax")
    assert box.boundary_index.tolist() == [0, 2, 1, 1]
    assert box.names == {"inlet": [0], "walls": [2, 3]}
    assert box == clvoro.Box((0, 0), (2, 1))
    for copy in (pickle.loads(pickle.dumps(box)), clvoro.Box(**json.loads(json.dumps(box.describe())))):
        assert copy.boundary_names == box.boundary_names
    curve = box.boundary(["inlet", "yMin"] if "yMin" in box.boundary_names else ["inlet", 2])
    assert curve.begin.tolist() == [[0, 1], [0, 0]]
    assert curve.end.tolist() == [[0, 0], [2, 0]]
    assert len(box.boundary().begin) == 4
    x = np.array([(0.5, 0.25), (1.9, 0.9)])
    assert sizing.Distance(box.boundary("xMax"), 0.1, slope=1)(x) == pytest.approx([1.6, 0.2])
    cube = clvoro.Box((0, 0, 0), (1, 2, 3), periodic=(True, False, False), names={"lid": "zMax"})
    assert cube.boundary_names == ("lid", "yMin", "yMax", "zMin")
    assert cube.boundary_index.tolist() == [-1, -1, 1, 2, 3, 0]
    for k, (axis, end) in enumerate(itertools.product(range(3), range(2))):
        side = clvoro.Box((0, 0, 0), (1, 2, 3)).boundary(k)
        assert len(side.triangles) == 2
        assert (side.vertices[side.triangles][..., axis] == end * (axis + 1)).all()
    assert clvoro.Layers(0.1, edges="walls").edges == ("walls",)
    ends = LayerRows(box, [clvoro.Layers(0.1, edges="walls")]).segments(0)
    assert sorted(ends[:, :, 1].mean(axis=1).tolist()) == [0, 1]
    result = adapter_of_module.run(box, 0.2, method="lloyd", max_steps=1)
    result.to_openfoam(tmp_path / "polyMesh", patches={"outlet": "xMax"})
    assert list(test_foam.read(tmp_path / "polyMesh")[-1]) == ["outlet", "inlet", "walls", "back", "front"]


@pytest.mark.sparse(2)
def test_plots_show_the_names(meshed) -> None:
    pytest.importorskip("matplotlib")
    from clvoro.plotting import plot_boundaries

    _, edges, result = meshed
    domain = result.diagram.domain
    figure = plot_boundaries(domain, numbers=True)
    lines = {c.get_label(): c for c in figure.axes[0].collections}
    assert list(lines) == list(domain.boundary_names)
    for name, drawn in lines.items():
        shape = shapely.union_all([edges[k] for k in domain.boundaries.select("test", name)])
        assert shapely.union_all(shapely.linestrings(drawn.get_segments())).equals(shape)
    texts = figure.axes[0].texts
    assert {t.get_text() for t in texts} == set(map(str, range(12)))
    for text in texts:
        assert edges[int(text.get_text())].distance(shapely.Point(text.xy)) < 1e-14
    assert len({tuple(c.get_color()[0]) for c in lines.values()}) == len(lines)
    over = result.plot("volume")
    assert plot_boundaries(clvoro.Box((0, 0), (1, 1)), over.axes[0]) is over
    with pytest.raises(InputError, match="in the plane and in space"):
        plot_boundaries(clvoro.Sphere(1))
    with pytest.raises(InputError, match="no boundary"):
        plot_boundaries(clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True))
    with pytest.raises(InputTypeError, match=r"mesh\.domain"):
        plot_boundaries(figure)


@pytest.mark.parametrize(
    ("domain", "seen", "hidden"),
    [
        (
            lambda: clvoro.Solid.ball((0, 0, 0), 1, 0.2) - clvoro.Solid.ball((0, 0, 0), 0.5, 0.2),
            [0],
            "without a number: 1",
        ),
        (
            lambda: clvoro.Solid.outside(clvoro.Solid.box((1, 1, 1), (2, 2, 2)), clvoro.Box((0,) * 3, (3,) * 3)),
            range(12),
            "",
        ),
    ],
    ids=["a ball with a cavity", "around a box"],
)
def test_plots_show_walls_in_space(domain, seen, hidden) -> None:
    pytest.importorskip("trimesh")
    from clvoro.plotting import plot_boundaries
    from clvoro.plotting.solids import VIEW, view_axes

    shape = domain()
    figure = plot_boundaries(shape, numbers=True)
    for ax, angles in zip(figure.axes, (VIEW, (VIEW[0] + 180, -VIEW[1])), strict=True):
        right, up, _ = view_axes(angles)
        for text in ax.texts:
            corners = shape.boundary(int(text.get_text())).corners @ np.stack([right, up], axis=1)
            drawn = shapely.union_all(shapely.convex_hull(shapely.multipoints(corners)))
            assert drawn.distance(shapely.Point(text.xy)) < 1e-9
    assert {int(text.get_text()) for ax in figure.axes for text in ax.texts} == set(seen)
    assert figure.get_supxlabel() == hidden
    named = plot_boundaries(shape)
    assert [text.get_text() for text in named.legends[0].get_texts()] == list(shape.boundary_names)
    with pytest.raises(InputError, match="leave ax out"):
        plot_boundaries(shape, figure.axes[0])


SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]


@pytest.mark.parametrize(
    ("names", "error", "says"),
    [
        ({"a": [0, 4]}, InputError, r"names\['a'\] has edge 4, expected numbers from 0 to 3"),
        ({"a": [-1]}, InputError, "edge -1, expected"),
        ({"a": [0, 1], "b": [1]}, InputError, "edge 1 both in 'a' and in 'b'"),
        ({"a": []}, InputError, "empty"),
        ({"a": "b"}, InputError, "name of a boundary: outer"),
        ({"a b": 0}, InputError, "name 'a b'"),
        ({"": 0}, InputError, "name ''"),
        ({"ä": 0}, InputError, "name 'ä'"),
        ({1: 0}, InputError, "name 1"),
        ({"a": 0.5}, InputTypeError, r"names\['a'\] is 0.5"),
        ({"a": [True]}, InputTypeError, "True"),
        ({"a": {0: 1}}, InputTypeError, "expected a number or name"),
        ({"a": np.array([True])}, InputError, "mask of shape"),
        (["a"], InputTypeError, "expected a mapping"),
    ],
)
def test_wrong_names_are_refused(names, error, says) -> None:
    with pytest.raises(error, match=says):
        clvoro.Polygon(SQUARE, names=names)


def test_periodic_sides_have_no_names() -> None:
    with pytest.raises(InputError, match="side 0, which is periodic, expected one of 2, 3"):
        clvoro.Box((0, 0), (1, 1), periodic=(True, False), names={"a": 0})
    with pytest.raises(InputError, match="name of a boundary: yMin, yMax"):
        clvoro.Box((0, 0), (1, 1), periodic=(True, False), names={"a": "xMin"})
    torus = clvoro.Box((0, 0), (1, 1), periodic=True)
    assert torus.boundary_names == ()
    with pytest.raises(InputError, match="periodic in every direction"):
        torus.boundary()


def test_default_names_and_edges_without_length() -> None:
    pieces = [[OUTER, *HOLES], [OUTER + 10]]
    domain = clvoro.Polygon.from_pieces(pieces, names={"a--b": "outer-2"})
    assert domain.boundary_names == ("a--b", "outer-1", "hole-1", "hole-2")
    twice = clvoro.Polygon(np.repeat(OUTER, 2, axis=0), names={"a": [0, 1], "none": 2})
    assert len(twice.boundary("a").begin) == 1
    with pytest.raises(InputError, match="without length"):
        twice.boundary("none")


def test_curves_with_one_name_are_one_part_unless_a_ring_has_the_name() -> None:
    def tubes(*names: str | None) -> clvoro.Polygon:
        return clvoro.Polygon(
            [(0, 0), (3, 0), (3, 1), (0, 1)],
            [clvoro.curves.circle((k + 0.5, 0.5), 0.2, name=name) for k, name in enumerate(names)],
        )

    domain = tubes("tubes", None, "tubes")
    assert domain.boundary_names == ("outer", "tubes", "hole-2")
    ring = np.repeat(np.arange(4), np.diff(domain.ring_starts))
    assert (domain.boundaries.select("", "tubes") == np.flatnonzero(ring % 2)).all()
    assert tubes("hole-2", "hole-1").boundary_names == ("outer", "hole-2", "hole-1")
    for name, edge in (("hole-2", r"\d+"), ("outer", 0)):
        with pytest.raises(InputError, match=f"edge {edge} of another ring has the name '{name}'"):
            tubes(name, None)


def test_features_name_their_boundaries() -> None:
    def feature(ring, boundaries):
        closed = [*ring, ring[0]]
        return {
            "type": "Feature",
            "properties": {"boundaries": boundaries},
            "geometry": {"type": "Polygon", "coordinates": [closed]},
        }

    square = [[0, 0], [1, 0], [1, 1], [0, 1]]
    far = [[x + 5, y] for x, y in square]
    features = [feature(square, {"shore": [0, 1]}), feature(far, {"shore": [3], "mouth": 2})]
    source = {"type": "FeatureCollection", "features": features}
    domain = clvoro.Polygon.from_geojson(source)
    assert domain.boundary_names == ("shore", "mouth", "outer-1", "outer-2")
    assert domain.boundary_index.tolist() == [0, 0, 2, 2, 3, 3, 1, 0]
    assert clvoro.Polygon.from_geojson(source, names={"a": 0}).boundary_names[0] == "a"
    features[1]["properties"] = {"boundaries": {"mouth": [4]}}
    with pytest.raises(InputError, match="'mouth' with 4, expected numbers of edges of its Feature, 0 to 3"):
        clvoro.Polygon.from_geojson(source)
    features[1]["properties"] = {"boundaries": "something else"}
    assert clvoro.Polygon.from_geojson(source).boundary_names[0] == "shore"


CASE = """
[domain]
{domain}
names = {{ shore = {shore}, inlet = 3 }}

[size]
kind = "distance"
h_min = 0.1
slope = 0.5
shapes = [{{ kind = "boundary", edges = "shore" }}]

[[layers]]
height = 0.02
edges = ["inlet", 1]
"""


@pytest.mark.parametrize("back", [False, True])
def test_cases_name_boundaries(tmp_path, back) -> None:
    ring = [[0, 0], [2, 0], [2, 1], [0, 1]]
    text = CASE.format(domain=f"outer = {ring[::-1] if back else ring}", shore="[0]")
    for case in (Case.from_toml(text, "a"), Case.from_toml(Case.from_toml(text, "a").text(), "b")):
        assert case.domain.boundary_names == ("shore", "inlet", "outer")
        x = np.array([(0.5, 0.25)])
        assert case.size_field()(x) == pytest.approx(0.1 + 0.5 * (0.75 if back else 0.25))
        (layer,) = case.run_arguments()["layers"]
        ends = LayerRows(case.domain, [layer]).segments(0)
        assert sorted(ends[..., 0].mean(axis=1).tolist()) == [0, 2]
    case = Case.from_toml(CASE.format(domain="lower = [0, 0]\nupper = [2, 1]", shore="'yMin'"), "c")
    assert case.domain.boundary_names == ("shore", "inlet", "xMin", "xMax")
    assert case.size_field()(np.array([(0.5, 0.25)])) == pytest.approx(0.225)
    with pytest.raises(
        InputError, match=r"domain\.names has a value that is a number, expected a whole number or a text"
    ):
        Case.from_toml(CASE.format(domain="outer = [[0, 0], [1, 0], [1, 1]]", shore="0.5"), "d")
