"""Lines inside a domain: what they are made of, their network and regions, and the pairs of generators beside them."""

import json

import numpy as np
import pytest
import shapely
from scipy.spatial import KDTree

import clvoro
from clvoro.errors import InputError, InputTypeError
from clvoro.geometry.lines.pairs import place_pairs

BOX = clvoro.Box((0, 0), (2, 1))
FAULT, BED = [(0.3, 0.2), (1.6, 0.8)], [(0.0, 0.6), (2.0, 0.5)]
LINE_STRING = {"type": "LineString", "coordinates": FAULT}
PAIRS = {
    "crossing": (BOX, [FAULT, BED, clvoro.curves.circle((1.6, 0.3), 0.15)]),
    "junction": (BOX, [[(0.0, 0.5), (2.0, 0.5)], [(1.0, 0.5), (1.0, 0.9)]]),
    "three": (BOX, [[(1, 0.5), (1.6, 0.5)], [(1, 0.5), (0.7, 0.9)], [(1, 0.5), (0.7, 0.1)]]),
    "acute": (BOX, [[(0.1, 0.5), (1.9, 0.5)], [(0.6, 0.5), (1.8, 0.9)]]),
    "zigzag": (BOX, [[(0.2, 0.3), (0.8, 0.6), (1, 0.2), (1.5, 0.8), (1.8, 0.1)]]),
    "close": (BOX, [[(0.2, 0.5), (1.8, 0.5)], [(0.2, 0.54), (1.8, 0.54)]]),
    "wall": (BOX, [[(0, 0.2), (1.2, 1)], [(0, 0.8), (2, 0.9)]]),
    "island": (
        clvoro.Polygon([(0, 0), (2, 0), (2, 1), (0, 1)], [clvoro.curves.circle((1, 0.5), 0.2)]),
        [[(0, 0.5), (2, 0.55)], [(1, 0), (1, 1)]],
    ),
    "periodic": (clvoro.Box((0, 0), (2, 1), True), [[(0.0, 0.3), (2, 0.3)], [(1.7, 0.1), (2.3, 0.8)]]),
    "straight across a seam": (clvoro.Box((0, 0), (2, 1), (True, False)), [[(0.0, 0.4), (2, 0.4)]]),
}


@pytest.mark.parametrize(
    "source",
    [
        FAULT,
        np.array(FAULT),
        [FAULT],
        shapely.LineString(FAULT),
        [shapely.MultiLineString([FAULT])],
        LINE_STRING,
        {"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {}, "geometry": LINE_STRING}]},
        json.dumps(LINE_STRING),
    ],
    ids=["list", "array", "lists", "shapely", "several", "dict", "collection", "text"],
)
def test_lines_are_taken_in_all_forms(source):
    assert BOX.with_lines(source).borders.describe() == [[[0.3, 0.2], [1.6, 0.8]]]


def test_lines_are_read_from_a_file_and_polygons_are_rings(tmp_path):
    (tmp_path / "faults.geojson").write_text(json.dumps(LINE_STRING))
    assert len(BOX.with_lines(tmp_path / "faults.geojson").borders) == 1
    ring = BOX.with_lines(shapely.box(0.5, 0.2, 1.5, 0.8))
    assert [round(part.area, 9) for part in ring.borders.regions(ring)] == [1.4, 0.6]


@pytest.mark.parametrize(
    ("domain", "source", "message"),
    [
        (BOX, [(0.5, 0.5)], "single point"),
        (BOX, [(0.5, np.nan), (1, 1)], "finite"),
        (BOX, 3, "expected points"),
        (BOX, shapely.Point(1, 1), "a Point"),
        (BOX, {"type": "Point", "coordinates": [1, 1]}, "a Point"),
    ],
)
def test_what_is_no_line_in_the_domain_is_refused(domain, source, message):
    with pytest.raises((InputError, InputTypeError), match=message):
        domain.with_lines(source)


def test_regions_count_from_the_largest_and_join_at_seams():
    ground = BOX.with_lines([FAULT, BED])
    assert ground.borders.region_of(ground, np.array([(0.1, 0.1), (1.9, 0.9), (1.9, 0.1)])).tolist() == [0, 1, 0]
    ring = clvoro.Box((0, 0), (2, 1), periodic=True).with_lines([[(0.0, 0.3), (2, 0.3)], [(0.0, 0.7), (2, 0.7)]])
    regions = ring.borders.regions(ring)
    assert [round(part.area, 9) for part in regions] == [1.2, 0.8]
    assert ring.borders.region_of(ring, np.array([(0.5, 0.1), (0.5, 0.9), (0.5, 0.5)])).tolist() == [0, 0, 1]


def test_lines_stay_in_copies_of_the_domain_and_make_it_another_one():
    import copy

    for bare in (BOX, PAIRS["island"][0]):
        domain = bare.with_lines(FAULT)
        assert copy.copy(domain).borders.describe() == domain.borders.describe()
        assert copy.copy(domain) == domain == bare.with_lines(FAULT)
        assert domain not in (bare, bare.with_lines([FAULT, BED]))
        assert domain.same_region(bare)


@pytest.mark.parametrize("kind", list(PAIRS))
def test_pairs_make_faces_on_the_lines_wherever_other_generators_are(kind):
    """On each chord two generators are nearest, at equal distances, among the pairs and others outside of the balls."""
    domain, lines = PAIRS[kind]
    domain = domain.with_lines(lines)
    size = 0.08
    pairs = place_pairs(domain, domain.borders.network(domain), lambda x: np.full(len(x), size))
    assert not len(pairs.left_out)
    assert domain.contains(pairs.points).all()
    period = np.where(domain.periodic, domain.extent, 0.0)
    others = np.random.default_rng(0).uniform(domain.lower, domain.upper, (4000, 2))
    near = KDTree(domain.wrap(pairs.centers), boxsize=period).query_ball_point(others, pairs.radii.max())
    way = [others[i] - pairs.centers[rows] for i, rows in enumerate(near)]
    way = [w - period * np.rint(w / np.where(period > 0, period, np.inf)) for w in way]
    out = [bool((np.hypot(*w.T) > pairs.radii[rows]).all()) for w, rows in zip(way, near, strict=True)]
    tree = KDTree(np.concatenate([pairs.points, others[out]]), boxsize=period)
    t = np.linspace(0.02, 0.98, 7)[:, None]
    for a, b in pairs.chords:
        distance, row = tree.query(domain.wrap(a + t * (b - a)), k=2)
        assert distance[:, 1] == pytest.approx(distance[:, 0], rel=1e-9)
        assert (row < len(pairs.points)).all()
    length = np.hypot(*(pairs.chords[:, 1] - pairs.chords[:, 0]).T).sum()
    assert length == pytest.approx(domain.borders.inside(domain).length, rel=1e-9 if kind != "crossing" else 0.01)
    assert np.median(pairs.sizes) == pytest.approx(size if kind != "close" else 0.024, rel=0.2)


def test_chords_follow_the_sizes():
    ground = BOX.with_lines([[(0.0, 0.5), (2.0, 0.5)]])
    pairs = place_pairs(ground, ground.borders.network(ground), lambda x: 0.02 + 0.08 * x[:, 0])
    middle = pairs.chords.mean(axis=1)[:, 0]
    assert pairs.sizes == pytest.approx(0.02 + 0.08 * middle, rel=0.1)
