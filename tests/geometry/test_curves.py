"""Curves as boundaries: resolution, rings with curves, nearest points, files, refusals."""

import copy
import json
import math
import pickle

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from scipy.interpolate import CubicSpline

import clvoro
from clvoro.curves import arc, circle, ellipse, naca, spline
from clvoro.errors import ClvoroError, InputError, InputTypeError

BOX = [(-4, -4), (4, -4), (4, 4), (-4, 4)]
DROP = [(0, 0), (1, 0.6), (1.6, 0), (1, -0.6)]
CURVES = {
    "circle": circle((0.2, 0.3), 0.7),
    "arc": arc((1, 0), 2, 30, -100),
    "ellipse": ellipse((0, 0), (3, 0.5), 30),
    "half-ellipse": ellipse((0, 0), (3, 0.5), 30, 90, 270),
    "naca": naca("0012"),
    "cambered": naca("4415", 2.0, (1, 1), 10, "blunt"),
    "spline": spline([(0, 0), (1, 0.2), (1.5, 1), (0, 2)], closed=True),
    "drop": spline(DROP, closed=True, corners=[0]),
    "open": spline([(0, 0), (1, 0.2), (1.5, 1), (0, 2)]),
}
each_curve = pytest.mark.parametrize("curve", CURVES.values(), ids=CURVES)


def sagittas(curve):
    """Largest distance of the curve from each edge of its polyline, by dense samples."""
    found = []
    ends, number = curve.nodes
    for s, span in enumerate(curve.spans):
        for low, high in ends[number == s]:
            p = span.at(np.linspace(low, high, 9))[0]
            along = (p[-1] - p[0]) / np.hypot(*(p[-1] - p[0]))
            found.append(np.abs((p - p[0]) @ np.array([-along[1], along[0]])).max())
    return np.array(found)


@pytest.mark.sparse(3)
@each_curve
def test_the_polyline_has_equal_sagittas(curve):
    found = sagittas(curve)
    assert found.max() <= 1.05 * curve.tolerance
    # Not wastefully fine: a polyline of the same tolerance needs about as many edges.
    assert np.median(found) >= 0.8 * curve.tolerance
    finer = clvoro.curves.Curve.described({**curve.describe(), "tolerance": curve.tolerance / 16})
    assert len(finer.nodes[0]) == pytest.approx(4 * len(curve.nodes[0]), rel=0.03)


def test_edges_turn_by_two_degrees_at_most():
    coarse = circle((0, 0), 1, tolerance=0.5)
    assert len(coarse.vertices) == 180
    assert len(arc((0, 0), 1, 0, 360 - 1e-9, tolerance=0.5).vertices) == 181


@each_curve
def test_derivatives(curve):
    for span in curve.spans:
        step = 1e-6 * (span.end - span.begin)
        t = np.linspace(span.begin + step, span.end - step, 40)
        difference = (span.at(t + step)[0] - span.at(t - step)[0]) / (2 * step)
        given = span.at(t)[1]
        assert np.abs(difference - given).max() <= 1e-6 * np.abs(given).max()


@each_curve
def test_spans_join(curve):
    for first, second in zip(curve.spans[:-1], curve.spans[1:], strict=True):
        (a,), (b,) = first.at(np.array([first.end]))[0], second.at(np.array([second.begin]))[0]
        assert a == pytest.approx(b, abs=1e-15)


def test_circles_are_exact_at_the_axes():
    v = circle((0, 0), 1).vertices
    n = len(v) // 4
    assert v[::n].tolist() == [[1, 0], [0, 1], [-1, 0], [0, -1]]
    assert np.abs(np.hypot(*v.T) - 1).max() < 3e-16


def test_arcs_run_either_way():
    forth, back = arc((1, 2), 3, -20, 130).vertices, arc((1, 2), 3, 130, -20).vertices
    assert forth == pytest.approx(back[::-1], abs=1e-14)
    assert forth[0] == pytest.approx([1 + 3 * math.cos(math.pi / 9), 2 - 3 * math.sin(math.pi / 9)])


def test_ellipses_are_rotated():
    v = ellipse((1, 2), (3, 0.5), 30).vertices - (1, 2)
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    x, y = v @ np.array([c, s]), v @ np.array([-s, c])
    assert (x / 3) ** 2 + (y / 0.5) ** 2 == pytest.approx(1, abs=1e-14)


# --- NACA sections


def thickness(blunt):
    """Half thickness of a section of 10 %, in powers of sqrt(x): an independent evaluation."""
    last = 0.1015 if blunt else 0.1036
    return 0.5 * Polynomial([0, 0.2969, -0.1260, 0, -0.3516, 0, 0.2843, 0, -last])


@pytest.mark.parametrize("edge", ["closed", "blunt"])
def test_symmetric_sections(edge):
    v = naca("0010", trailing_edge=edge).vertices
    wanted = thickness(edge == "blunt")(np.sqrt(v[:, 0]))
    assert np.abs(v[:, 1]) == pytest.approx(wanted, abs=1e-15)
    # The published section: thickest at 30 % of the chord.
    assert v[v[:, 1].argmax()] == pytest.approx([0.30, 0.05], abs=5e-3)
    half = Polynomial([0, 2]) * thickness(edge == "blunt")  # dx = 2 s ds
    assert clvoro.Polygon(v).measure == pytest.approx(2 * half.integ()(1), rel=1e-4)
    blunt = np.ptp(v[[0, -1]], axis=0)
    assert blunt[1] == pytest.approx(2 * wanted[0]) if edge == "blunt" else v[0] == pytest.approx([1, 0])


def test_cambered_sections():
    upper, lower = np.split(naca("2410").vertices, [np.hypot(*naca("2410").vertices.T).argmin()])
    # The middle of both sides' points of equal parameter is the camber line.
    x = np.linspace(0, 1, 7)[1:-1] ** 2
    middle = [0.05 / 4 * (0.8 * u - u**2) * 10 if u < 0.4 else 0.02 / 0.36 * (0.2 + 0.8 * u - u**2) for u in x]
    section = naca("2410")
    for u, y in zip(x, middle, strict=True):
        found = []
        for span in section.spans:
            for t in (math.sqrt(u), -math.sqrt(u)):
                if span.begin <= t <= span.end:
                    found.append(span.at(np.array([t]))[0][0])
        assert np.mean(found, axis=0) == pytest.approx([u, y], abs=1e-15)
        half = thickness(blunt=False)(math.sqrt(u))
        assert np.hypot(*(found[0] - found[1])) == pytest.approx(2 * half, rel=1e-12)
    assert upper[1:, 1].min() > 0 > lower[1:, 1].min()


def test_sections_are_scaled_turned_and_moved():
    plain, moved = naca("4415"), naca("4415", 2.0, (1.0, -3.0), 30.0)
    # Nose up about the leading edge: the trailing edge goes down.
    assert moved.vertices[0] == pytest.approx([1 + 2 * math.cos(math.pi / 6), -3 - 1.0])
    t = np.linspace(-0.9, -0.7, 5)
    (a, _), (b, _) = plain.spans[0].at(t), moved.spans[0].at(t)
    assert np.hypot(*(b - (1, -3)).T) == pytest.approx(2 * np.hypot(*a.T))


# --- splines


def test_splines_are_those_of_scipy():
    points = np.array([(0, 0), (1, 0.2), (1.5, 1), (0, 2)])
    closed = np.vstack([points, points[:1]])
    for given, ends in ((points, "not-a-knot"), (closed, "periodic")):
        lengths = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(given, axis=0).T))])
        wanted = CubicSpline(lengths, given, bc_type=ends)
        (span,) = spline(points, closed=ends == "periodic").spans
        t = np.linspace(0, lengths[-1], 50)
        assert span.at(t)[0] == pytest.approx(wanted(t), abs=1e-15)
    assert spline(closed, closed=True) == spline(points, closed=True)


def test_splines_keep_corners():
    v = spline(DROP, closed=True, corners=[2, 0]).vertices
    along = np.roll(v, -1, axis=0) - v
    after = np.roll(along, -1, axis=0)
    turn = np.degrees(np.arctan2(along[:, 0] * after[:, 1] - along[:, 1] * after[:, 0], (along * after).sum(axis=1)))
    sharp = v[(np.flatnonzero(np.abs(turn) > 3) + 1) % len(v)]
    assert sorted(map(tuple, sharp.round(12).tolist())) == [(0, 0), (1.6, 0)]
    straight = spline([(0, 0), (1, 0), (1, 1)], corners=[1]).vertices
    assert straight.tolist() == [[0, 0], [1, 0], [1, 1]]


# --- rings


def test_a_rounded_step():
    ring = [(0, 0.5), arc((0.9, 0.4), 0.1, 90, 0, name="edge"), (1, 0), (3, 0), (3, 1), (0, 1)]
    step = clvoro.Polygon(ring)
    assert step.boundary_names == ("outer", "edge")
    count = len(arc((0.9, 0.4), 0.1, 90, 0).nodes[0])
    assert step.boundary_index.tolist() == [0] + [1] * count + [0] * 5
    assert step.measure == pytest.approx(3 - 0.5 + 0.1**2 * (1 - math.pi / 4), abs=2e-8)


def test_ends_of_curves_are_merged_with_points():
    third = 1 / 3  # ends of arcs are off by round-off
    half = clvoro.Polygon([(-third, 0), (third, 0), arc((0, 0), third, 0, 180)])
    alone = clvoro.Polygon([arc((0, 0), third, 0, 180)])
    assert len(half.vertices) == len(alone.vertices) == len(arc((0, 0), third, 0, 180).vertices)
    assert half.vertices[0].tolist() == [-third, 0]
    closed = clvoro.Polygon([(-third, 0), (third, 0), arc((0, 0), third, 0, 180), (-third, 0)])
    assert closed == half
    two = clvoro.Polygon([arc((0, 0), 1, 10, 200), arc((0, 0), 1, 200, 370)])
    assert two.measure == pytest.approx(math.pi, rel=1e-5)
    assert len(two.curves) == 2
    assert (two.curved_edges.span >= 0).all()


def test_names_of_curves():
    wings = [naca("0012", leading_edge=(x, 0), trailing_edge="blunt", name="wing") for x in (-3, 0)]
    domain = clvoro.Polygon(BOX, wings, names={"far": "outer"})
    assert domain.boundary_names == ("far", "wing")
    assert np.bincount(domain.boundary_index).tolist() == [4, len(domain.vertices) - 4]
    renamed = clvoro.Polygon(BOX, [circle((0, 0), 1)], names={"cylinder": "hole-1"})
    assert renamed.boundary_names == ("cylinder", "outer")
    with pytest.raises(InputError, match="both in"):
        clvoro.Polygon(BOX, wings[:1], names={"a": "wing", "b": [4]})


def test_curves_are_shapes_of_size_fields():
    size = clvoro.sizing.Distance(circle((0, 0), 1), 0.1, slope=0.5)
    assert size(np.array([(0, 0.25), (3, 0)])) == pytest.approx([0.1 + 0.375, 1.1], abs=1e-5)
    size = clvoro.sizing.Distance(arc((0, 0), 1, 0, 90), 0.1, slope=1)
    assert size(np.array([(-1.0, 0)])) == pytest.approx(0.1 + math.sqrt(2))


# --- nearest points


@pytest.mark.sparse(3)
@each_curve
def test_points_on_curves(curve):
    ring = curve if curve.closed else [curve]
    domain = clvoro.Polygon(ring)
    rng = np.random.default_rng(3)
    edges = np.repeat(np.arange(len(domain.vertices)), 3)
    begin, end = domain.vertices[edges], domain.vertices[domain._next_given[edges]]
    points = begin + rng.random((len(edges), 1)) * (end - begin)
    found = domain.on_curve(points, edges)
    curved = domain.curved_edges.span[edges] >= 0
    assert (found[~curved] == points[~curved]).all()
    assert np.hypot(*(found - points).T).max() <= 1.05 * curve.tolerance
    # Reference: the parameter by bisection of (points - curve) . tangent.
    for s, span in enumerate(curve.spans):
        rows = np.flatnonzero(domain.curved_edges.span[edges] == s)
        low, high = domain.curved_edges.ends[edges[rows]].T
        for _ in range(70):
            middle = (low + high) / 2
            at, ahead = span.at(middle)
            beyond = ((points[rows] - at) * ahead).sum(axis=1) > 0
            low, high = np.where(beyond, middle, low), np.where(beyond, high, middle)
        assert np.abs(found[rows] - span.at(low)[0]).max() < 1e-14 * max(1, np.abs(found).max())
    vertices = domain.on_curve(domain.vertices, np.arange(len(domain.vertices)))
    assert (vertices == domain.vertices).all()
    assert (domain.on_curve(end, edges) == end).all()


def test_points_beside_curves():
    domain = clvoro.Polygon(BOX, [circle((0, 0), 1)])
    points = np.array([(0.3, 0.4), (3, 4), (3.0, -4)])
    edges, _ = domain.nearest_edge(points)
    on = domain.on_curve(points[:1], edges[:1])
    assert on == pytest.approx(np.array([(0.6, 0.8)]), abs=1e-15)
    for wrong in ([4.5], [-1], [len(domain.vertices)], [4, 5]):
        with pytest.raises(InputError, match="edges has"):
            domain.on_curve(points[:1], wrong)


# --- equality, files


def test_equal_domains_have_equal_curves(tmp_path):
    def make(**more):
        return clvoro.Polygon(BOX, [naca("2412", trailing_edge="blunt", name="wing", **more), circle((0, 2), 1)])

    domain = make()
    assert domain == make()
    assert hash(domain) == hash(make())
    assert domain != make(chord=1.5)
    plain = clvoro.Polygon(domain.rings[0], domain.rings[1:])
    assert (plain.vertices == domain.vertices).all()
    assert plain != domain
    assert "2 holes, 2 curves" in repr(domain)
    again = [
        pickle.loads(pickle.dumps(domain)),
        copy.deepcopy(domain),
        clvoro.Polygon.described(**json.loads(json.dumps(domain.describe()))),
    ]
    mesh = clvoro.voronoi(domain, [(-2.0, 0), (2, 0), (3, 3)])
    for name in ("mesh.npz", "mesh.vtu"):
        mesh.save(tmp_path / name)
        again.append(clvoro.load(tmp_path / name).domain)
    points = domain.vertices + 1e-7
    for other in again:
        assert other == domain
        assert other.curves == domain.curves
        assert other.boundary_names == domain.boundary_names == ("outer", "wing", "hole-2")
        edges = np.arange(len(points))
        assert (other.on_curve(points, edges) == domain.on_curve(points, edges)).all()


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.update(curve={"kind": "circle", "center": [0, 0], "radius": 2.0}),
        lambda c: c.update(curve={"kind": "square"}),
        lambda c: c.update(curve={"kind": "circle", "size": 3}),
        lambda c: c.update(edges=[-1, 10]),
        lambda c: c.update(edges=[4, 10**6]),
        lambda c: c.update(edges="x"),
        lambda c: c.update(parameters=c["parameters"][:-1]),
        lambda c: c["parameters"][0].reverse(),
        lambda c: c["parameters"][0].__setitem__(3, math.nan),
        lambda c: c.pop("curve"),
    ],
)
def test_damaged_descriptions(change):
    values = clvoro.Polygon(BOX, [circle((0, 0), 1)]).describe()
    change(values["curves"][0])
    with pytest.raises(ClvoroError):
        clvoro.Polygon.described(**values)


# --- refusals


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: circle((0, 0), 0), "circle radius is 0"),
        (lambda: circle((0, 0), -1), "circle radius is -1"),
        (lambda: circle((0, math.nan), 1), "circle center"),
        (lambda: circle((0, 0, 0), 1), "circle center"),
        (lambda: circle((0, 0), 1, tolerance=0), "tolerance is 0"),
        (lambda: circle((0, 0), 1, tolerance=1e-16), "tolerance is 1e-16, expected at least"),
        (lambda: circle((0, 0), 1, name="a b"), "name is 'a b'"),
        (lambda: arc((0, 0), 0, 0, 90), "arc radius is 0"),
        (lambda: ellipse((0, 0), (1, 0)), "semi_axes"),
        (lambda: ellipse((0, 0), (1, 1), start=0, end=400), "at most 360"),
        (lambda: naca("0012", chord=0), "chord is 0"),
        (lambda: naca("0012", chord=1e160), r"extent of 1e\+160, expected 1e-50 to"),
        (lambda: naca("0012", trailing_edge="round"), "trailing_edge is 'round'"),
        (lambda: spline([(0, 0)]), "at least 2"),
        (lambda: spline([(0, 0), (1, 0), (0, 0)], closed=True), "at least 3"),
        (lambda: spline([(0, 0), (1, math.inf)]), r"points\[1\]"),
        (lambda: spline([(0, 0), (1, 0)], corners=[2]), "corners has 2"),
    ],
)
def test_what_is_no_curve(make, says):
    with pytest.raises(InputError, match=says):
        make()


def test_wrong_types():
    for make in (lambda: naca(2412), lambda: circle("x", 1), lambda: circle((0, 0), "1")):
        with pytest.raises(InputTypeError):
            make()


@pytest.mark.parametrize(
    ("outer", "holes", "says"),
    [
        ([(0, 0), "x", arc((0, 0), 1, 0, 90)], [], "has item 1, expected a point"),
        ([(0, 0), (1, 0, 0), arc((0, 0), 1, 0, 90)], [], "has item 1, expected a point"),
    ],
)
def test_refused_rings(outer, holes, says):
    with pytest.raises((InputError, InputTypeError), match=says):
        clvoro.Polygon(outer, holes)
