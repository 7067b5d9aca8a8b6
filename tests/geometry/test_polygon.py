"""Polygonal domains: vertices of the caller, oriented rings, and invalid input."""

import json
import pickle
from fractions import Fraction

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.errors import InputError, InputTypeError, MismatchWarning
from clvoro.opencl.threads import Team
from tests.reference.polygons import HOLE, OTHER, SQUARE, crossings, distances
from tests.reference.shores import star


def test_rings_are_oriented() -> None:
    for outer in (SQUARE, SQUARE[::-1]):
        for hole in (HOLE, HOLE[::-1]):
            domain = clvoro.Polygon(outer, [hole])
            assert domain.ring_starts.tolist() == [0, 4, 8]
            assert domain.vertices.tolist() == [*outer.tolist(), *hole.tolist()]
            rings = domain.oriented
            assert rings.ring_starts.tolist() == [0, 4, 8]
            assert rings.next_vertex.tolist() == [1, 2, 3, 0, 5, 6, 7, 4]
            start, end = rings.vertices, rings.vertices[rings.next_vertex]
            along = end - start
            left = (start + end) / 2 + 1e-3 * np.column_stack([-along[:, 1], along[:, 0]])
            assert domain.contains(left).all()
            right = (start + end) / 2 - 1e-3 * np.column_stack([-along[:, 1], along[:, 0]])
            assert not domain.contains(right).any()
            assert domain.measure == 11
            assert (domain.lower, domain.upper) == ((0, 0), (4, 3))
    assert domain.vertices.dtype == np.float64
    arrays = (domain.ring_starts, domain.piece_of_ring, domain.boundary_index)
    for array in (*arrays, rings.ring_starts, rings.next_vertex, rings.edge_numbers, rings.places):
        assert array.dtype == np.int32
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("turned", [False, True])
def test_edges_are_numbered_as_given(closed: bool, turned: bool) -> None:
    # Vertices 2 and 3 are equal, vertex 5 is on a straight line.
    outer = np.array([(0.0, 0), (4, 0), (4, 3), (4, 3), (2, 3), (1, 3), (0, 3)])
    rings = [outer, HOLE, OTHER]
    if turned:
        rings = [ring[::-1] for ring in rings]
    given = [np.vstack([ring, ring[:1]]) if closed else ring for ring in rings]
    domain = clvoro.Polygon(given[0], given[1:])
    starts = np.concatenate(rings)
    ends = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    assert np.array_equal(domain.vertices, starts)
    numbers, empty = domain.oriented.edge_numbers, 3 if turned else 2
    assert sorted(numbers.tolist()) == sorted({*range(15)} - {empty})
    assert np.flatnonzero(domain.oriented.places < 0).tolist() == [empty]
    for a, b, number in zip(*domain.edge_ends(numbers), numbers, strict=True):
        assert {tuple(a), tuple(b)} == {tuple(starts[number]), tuple(ends[number])}
    again = clvoro.Polygon.described(**domain.describe())
    assert np.array_equal(again.oriented.edge_numbers, numbers)


def test_pieces() -> None:
    island = HOLE * 0.5 + (0.75, 0.75)  # in the hole of the first piece
    domain = clvoro.Polygon.from_pieces([[SQUARE, HOLE], [island[::-1]]])
    assert domain.n_pieces == 2
    assert domain.piece_of_ring.tolist() == [0, 0, 1]
    assert domain.measure == 11.25
    assert domain.contains(np.array([(1.5, 1.5), (1.05, 1.05), (0.5, 0.5)])).tolist() == [1, 0, 1]
    assert "2 pieces, 1 hole" in repr(domain)
    touching = clvoro.Polygon.from_pieces([[SQUARE], [HOLE + np.array([3, 2])]])  # in the corner (4, 3)
    assert touching.measure == 13


def test_all_sources_give_the_same_domain(tmp_path) -> None:
    parts = [shapely.Polygon(SQUARE, [HOLE]), shapely.Polygon(SQUARE[::-1] + 10)]
    several = clvoro.Polygon.from_pieces([[SQUARE, HOLE], [SQUARE[::-1] + 10]])
    whole = shapely.MultiPolygon(parts)
    assert clvoro.Polygon.from_shapely(whole) == several
    assert clvoro.Polygon.from_wkt(whole.wkt) == several
    assert clvoro.Polygon.from_wkt(shapely.force_3d(whole, 7).wkt) == several
    geometry = shapely.geometry.mapping(whole)
    feature = {"type": "Feature", "properties": {}, "geometry": geometry}
    features = [{"type": "Feature", "geometry": shapely.geometry.mapping(part), "properties": None} for part in parts]
    collection = {"type": "FeatureCollection", "features": features}
    group = {"type": "GeometryCollection", "geometries": [f["geometry"] for f in features]}
    path = tmp_path / "domain.geojson"
    path.write_text(json.dumps(collection))
    sources = geometry, feature, collection, group, json.dumps(feature), path, str(path)
    for source in sources:
        assert clvoro.Polygon.from_geojson(source) == several
    path.write_text('{"type": "Polygon", "coordinates": [[[0, 0], [2, 2], [2, 0], [0, 2]]]}')
    with pytest.raises(InputError, match=r"domain\.geojson: Polygon is not valid: Self-intersection"):
        clvoro.Polygon.from_geojson(path)
    assert clvoro.Polygon.from_shapely(parts[0]) == clvoro.Polygon(SQUARE, [HOLE])


def test_equal_domains() -> None:
    one, same = clvoro.Polygon(SQUARE, [HOLE]), clvoro.Polygon(SQUARE.tolist(), [HOLE.copy()])
    assert one == same
    assert hash(one) == hash(same)
    others = [
        clvoro.Polygon(SQUARE),
        clvoro.Polygon(SQUARE[::-1], [HOLE]),  # other numbers of edges
        clvoro.Polygon(SQUARE, [HOLE + 1e-15]),
        clvoro.Box((0, 0), (4, 3)),
        clvoro.Polygon.from_pieces([[SQUARE], [HOLE + 9]]),
    ]
    assert all(one != other for other in others)
    twice = clvoro.Polygon(SQUARE[::-1], [HOLE])
    for copy in (pickle.loads(pickle.dumps(twice)), clvoro.Polygon.described(**twice.describe())):
        assert copy == twice
        assert copy.vertices.tolist() == twice.vertices.tolist()
    assert json.loads(json.dumps(twice.describe())) == twice.describe()


def test_area_is_exact() -> None:
    # Far from the origin products of coordinates have 32 digits more than the area.
    far = np.array([2.0**33, -(2.0**33)])
    ring = (star(200) * 2**10).round(6) / 2**10 + far
    x = [(Fraction(a), Fraction(b)) for a, b in ring.tolist()]
    twice = sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(x, x[1:] + x[:1], strict=True))
    assert clvoro.Polygon(ring).measure == float(twice / 2)


def test_points_are_located() -> None:
    rings = [star(150), star(60, 5, (0.05, 0.0), 0.2)]
    domain = clvoro.Polygon(rings[0], rings[1:])
    x = np.random.default_rng(1).uniform(-1.2, 1.2, (4000, 2))
    inside = crossings(x, rings)
    assert 500 < inside.sum() < 3500
    assert (domain.contains(x) == inside).all()
    distance = distances(x, rings)
    # Round-off of coordinates up to 1.2 is 1.1e-16; a projection has a dozen operations.
    assert np.abs(domain.boundary_distance(x) - distance).max() < 4e-15
    nearest = domain.nearest(x)
    assert (nearest[inside] == x[inside]).all()
    away = np.linalg.norm(nearest - x, axis=1)
    assert np.abs(away - np.where(inside, 0, distance)).max() < 4e-15
    assert domain.contains(nearest).all()


def test_threads_locate_points_at_the_same_time() -> None:
    """Those of several devices do: the indices of shapely are made before."""
    angle, rng = np.linspace(0, 2 * np.pi, 4000, endpoint=False), np.random.default_rng(5)
    x = rng.uniform(-1, 1, (400, 2))
    for _ in range(10):
        radius = 1 + 0.1 * np.sin(7 * angle) + 0.001 * rng.random(len(angle))
        disc = clvoro.Polygon(radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))
        found = Team(4).run(
            lambda peers, disc=disc: (disc.covers(x).sum(), disc.sees(x[:99, None], x[1:100, None]).sum())
        )
        assert len(set(found)) == 1


def test_the_boundary_belongs_to_the_domain() -> None:
    for shift in (0.0, 1e6, -1e-6):
        domain = clvoro.Polygon(star(300) + shift, [star(50, 3, (0, 0), 0.2) + shift])
        t = np.random.default_rng(2).random((len(domain.vertices), 20, 1))
        a, b = (end[:, None] for end in domain.edge_ends(np.arange(len(t))))
        points = (a + t * (b - a)).reshape(-1, 2)
        assert domain.contains(points).all()
        assert domain.contains(domain.vertices).all()
        # The tolerance is not larger than round-off.
        out = np.array([[domain.upper[0] * (1 + np.sign(domain.upper[0]) * 1e-14), points[0, 1]]])
        assert not domain.contains(out).any()


def test_frame_and_clip_box() -> None:
    domain = clvoro.Polygon(SQUARE * 16, [HOLE])
    lower, upper = domain.clip_box
    assert lower.tolist() == [-1, -1]
    assert upper.tolist() == [65, 49]
    origin, scale = domain.frame
    assert origin.tolist() == [-1, -1]
    assert scale == 128
    corners = domain.device_corners(np.dtype("float32"))
    assert corners[0].tolist() == [0, 0, 0, 0]
    assert corners[1].tolist() == [66 / 128, 50 / 128, 0, 0]
    assert domain.dim == 2


ONE = lambda *ring: lambda: clvoro.Polygon(ring)  # noqa: E731
PIECES = lambda *rings: lambda: clvoro.Polygon.from_pieces([[r] for r in rings])  # noqa: E731


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (ONE((0, 0), (1, 0), (float("nan"), 1)), r"outer ring has vertex 2 at \(nan, 1\), expected finite"),
        (ONE((0, 0), (1, 1), (3, 3)), r"on the line from \(0, 0\) to \(3, 3\), expected a ring with an area"),
        (ONE((0, 0, 0), (1, 0, 0), (1, 1, 0)), r"outer ring has shape \(3, 3\), expected \(n, 2\)"),
        (ONE((0, 0), (1, 0), (1,)), "outer ring is not an array"),
        (ONE(("a", "b"), ("c", "d"), ("e", "f")), "outer ring has dtype"),
        (lambda: clvoro.Polygon.from_pieces([]), "no rings"),
        (lambda: clvoro.Polygon.from_pieces([[]]), "no rings for piece 1"),
        (lambda: clvoro.Polygon.from_pieces([clvoro.Polygon(SQUARE)]), "piece 1 is a Polygon, expected a list of its"),
        (lambda: clvoro.Polygon(SQUARE, 3), "holes is a int"),
        (lambda: clvoro.Polygon.from_wkt("POLYGON ((0 0, 1"), "not well-known text"),
        (lambda: clvoro.Polygon.from_wkt("POLYGON EMPTY"), "empty Polygon"),
        (lambda: clvoro.Polygon.from_wkt(3), "text is a int"),
        (lambda: clvoro.Polygon.from_geojson(3), "source is a int"),
        (lambda: clvoro.Polygon.from_geojson("missing.geojson"), "cannot read missing.geojson"),
        (lambda: clvoro.Polygon.from_geojson("{"), "not JSON"),
        (lambda: clvoro.Polygon.from_geojson({}), "expected an object with a type"),
        (lambda: clvoro.Polygon.from_geojson({"type": "FeatureCollection", "features": []}), "no Polygon"),
        (lambda: clvoro.Polygon.from_geojson({"type": "Polygon", "coordinates": 3}), "coordinates 3"),
        (lambda: clvoro.Polygon.from_geojson({"type": "Polygon", "coordinates": [3]}), "the ring 3"),
        (lambda: clvoro.Polygon.from_geojson({"type": "Polygon", "coordinates": [[3, 4]]}), "shape"),
        (lambda: clvoro.Polygon.from_geojson({"type": "MultiPolygon", "coordinates": [3]}), "MultiPolygon of 3"),
    ],
)
def test_invalid_polygons_are_refused(make, says: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=says):
        make()


def test_holes_may_touch_in_points() -> None:
    touching = [(0, 1), (1, 1), (1, 2)]  # touches the outer ring with a vertex of the hole
    corner = [(4, 3), (3, 2), (3.5, 2)]  # a corner
    domain = clvoro.Polygon(SQUARE, [touching, corner])
    assert domain.measure == 12 - 0.5 - 0.25
    assert domain.contains(np.array([(0.0, 1), (4, 3), (0.9, 1.5), (0.1, 1.2)])).tolist() == [1, 1, 0, 1]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("edge_numbers", [1, 2]),
        ("names", {"a": [8]}),
        ("names", [0]),
        ("ring_starts", [0, 3, 8]),
        ("ring_starts", [0, 4, 9]),
        ("ring_starts", [0, -4, 8]),
        ("ring_starts", "a"),
        ("piece_of_ring", [0, 10**9]),
        ("piece_of_ring", [0, -1]),
        ("piece_of_ring", []),
        ("vertices", None),
        ("vertices", [[0, 0, 0]] * 8),
        ("vertices", SQUARE.tolist()),
    ],
)
def test_damaged_descriptions_are_refused(name: str, value: object) -> None:
    good = clvoro.Polygon(SQUARE, [HOLE]).describe()
    assert clvoro.Polygon.described(**good).describe() == good
    with pytest.raises((InputError, InputTypeError)):
        clvoro.Polygon.described(**{**good, name: value})


def result_of(domain: clvoro.Polygon) -> clvoro.Result:
    """A result with a single cell and arbitrary values."""
    from clvoro.mesh.diagram import Diagram
    from clvoro.mesh.results import HISTORY_DTYPE

    ones, starts = np.ones(1), np.array([0, 1], np.int32)
    arrays = {
        "points": np.ones((1, 2)),
        "volumes": ones,
        "centroids": np.ones((1, 2)),
        "neighbor_starts": starts,
        "neighbors": np.array([-8], np.int32),
        "face_measures": ones,
        "face_centroids": np.ones((1, 2)),
        "vertices": np.ones((1, 2)),
        "cell_vertex_starts": starts,
        "cell_vertices": np.array([0], np.int32),
        "face_vertex_starts": np.array([0, 2], np.int32),
        "face_vertices": np.zeros(2, np.int32),
    }
    return clvoro.Result(
        points=arrays["points"],
        diagram=Diagram(domain, arrays),
        target_size=ones,
        size_error=ones,
        quality=ones,
        history=np.zeros(1, HISTORY_DTYPE),
        converged=True,
        stop_reason="none",
    )


def test_checkpoints_tell_domains_apart() -> None:
    from clvoro.adaptation.checkpoint import domain_fingerprint

    domains = [clvoro.Polygon(SQUARE), clvoro.Polygon(SQUARE, [HOLE]), clvoro.Box((0, 0), (4, 3))]
    described = [json.dumps(domain_fingerprint(d)) for d in domains]
    assert len(set(described)) == 3
    again = domain_fingerprint(clvoro.Polygon(SQUARE.copy()))
    assert json.dumps(again) == described[0]


@pytest.mark.parametrize("how", ["rings", "shapely", "wkt", "geojson"])
def test_repaired_rings_cover_what_shapely_says(how):
    """The shore crosses itself, two islands overlap, and a vertex is there nearly twice."""
    shore = [(0, 0), (6, 0), (6, 4), (6 + 1e-14, 4), (5, 4), (4, 5), (5, 5), (4, 4), (0, 4)]
    islands = [[(1, 1), (2, 1), (2, 2), (1, 2)], [(1.5, 1.5), (3, 1.5), (3, 3), (1.5, 3)]]
    make, given = {
        "rings": (clvoro.Polygon, (shore, islands)),
        "shapely": (clvoro.Polygon.from_shapely, (shapely.Polygon(shore, islands),)),
        "wkt": (clvoro.Polygon.from_wkt, (shapely.Polygon(shore, islands).wkt,)),
        "geojson": (clvoro.Polygon.from_geojson, (shapely.geometry.mapping(shapely.Polygon(shore, islands)),)),
    }[how]
    with pytest.raises(InputError):
        make(*given)
    names = {"island": range(9, 17), "right": [1]}
    with pytest.warns(MismatchWarning, match="its area changes by"):
        made = make(*given, names=names, repair=True)
    land = shapely.union_all([shapely.Polygon(island) for island in islands])
    sea = shapely.make_valid(shapely.Polygon(shore)).difference(land)
    assert made.measure == pytest.approx(sea.area, rel=1e-12)
    assert made.n_pieces == 2
    assert set(made.boundary_names) >= {"island", "right"}
    edges = made.boundary("right")
    assert np.allclose(sorted([*edges.begin[:, 1], *edges.end[:, 1]]), [0, 4])
    island = made.boundary("island")
    assert np.hypot(*(island.end - island.begin).T).sum() == pytest.approx(land.length)


def test_repair_changes_nothing_in_a_valid_domain(recwarn):
    ring, hole = [(0, 0), (3, 0), (3, 3), (0, 3)], [(1, 1), (2, 1), (2, 2)]
    assert clvoro.Polygon(ring, [hole], repair=True).measure == clvoro.Polygon(ring, [hole]).measure
    assert not recwarn
    with pytest.raises(InputError, match="expected numbers of edges from 0 to 6"):
        clvoro.Polygon(ring, [hole], names={"all": "outer"}, repair=True)
    with pytest.raises(InputError, match="no area that is left"):
        clvoro.Polygon(hole, [ring], repair=True)
