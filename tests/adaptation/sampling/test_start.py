"""Count and start: the quadrature against known integrals, samples against their expectation."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clvoro import Solid, sizing
from clvoro.adaptation.sampling.box_tree import BoxTree, hilbert_tables
from clvoro.adaptation.sampling.quadrature import DensityTree
from clvoro.adaptation.sampling.start import (
    _distinct,
    count_cells,
    density_tree,
    sample_density,
    sample_even,
    sample_lattice,
    sample_uniform,
)
from clvoro.errors import InputError, InputTypeError
from clvoro.geometry.box import Box
from clvoro.opencl.engine import Engine

BOX = Box((0, 0), (2.5, 1.5))
CUBE = Box((1, 1, 1), (2, 2, 2))
F1 = sizing.Distance(sizing.Circle((0.9, 0.75), 0.3), 0.02, slope=0.3)
F2 = sizing.Distance(sizing.Circle((0.9, 0.75), 0.3), 0.002, slope=0.08)
F3 = 0.9306 / 4 * sizing.Distance(sizing.Circle((0.8, 0.75), 0.25), 0.02, growth=1.3, h_max=0.15)


def _line_dip(h_min, slope, h_max, length, area):
    """Cells of h = min(h_min + slope * distance, h_max) about a line that cuts the domain."""
    reach = (h_max - h_min) / slope
    inside = 2 * length * (1 / h_min - 1 / h_max) / slope
    return inside + (area - 2 * length * reach) / h_max**2


INTEGRALS = {
    "constant": (BOX, 0.01, 37500),
    "larger than the domain": (BOX, sizing.Constant(100.0), 3.75e-4),
    "constant 3D": (CUBE, 0.05, 8000),
    "needle": (Box((0, -1e-3), (1000, 1e-3)), 0.1, 200),
    "far away and small": (Box((1e6, 1e6), (1e6 + 0.25, 1e6 + 0.5)), 0.01, 1250),
    # Reference: the integral in polar coordinates by scipy.integrate.quad, to 1e-8.
    "F1": (BOX, F1, 587.81130194),
    "F2": (BOX, F2, 22972.2421613),
    "F3": (BOX, F3, 11454.1213852),
    "exponential": (BOX, sizing.Expression("0.05*exp(-2*x)"), 1.5 / 0.0025 * math.expm1(10) / 4),
    "exponential 3D": (CUBE, sizing.Expression("0.2*exp(-(x+y+z-3))"), (math.expm1(3) / 3) ** 3 / 0.008),
    "jump of 100 along a line": (
        BOX,
        sizing.Expression("x + 0.3*y < 1.50033 ? 0.005 : 0.5"),
        (1.5 * 1.50033 - 0.15 * 1.5**2) * (1 / 0.005**2 - 4) + 3.75 * 4,
    ),
    "jump along the boxes": (BOX, sizing.Expression("x < 1.00001 ? 0.005 : 0.5"), 1.500015 * 40000 + 2.249985 * 4),
    # The width of the dip is 1/170 of the domain: only the landmarks on the line find it.
    "thin dip at a line": (
        BOX,
        sizing.Distance(sizing.Segment((-1, 0.7331), (3, 0.7331)), 0.001, slope=2, h_max=0.01),
        _line_dip(0.001, 2, 0.01, 2.5, 3.75),
    ),
    # A formula has no landmarks. Some samples hit the dip, and the tree follows it from box to box.
    "thin dip in a formula": (
        BOX,
        sizing.Expression("min(0.001 + 2*fabs(y - 0.7 - 0.01*x)/sqrt(1.0001), 0.01)"),
        _line_dip(0.001, 2, 0.01, 2.5 * math.sqrt(1.0001), 3.75),
    ),
}


@pytest.mark.sparse(6)
@pytest.mark.parametrize("case", INTEGRALS)
def test_count_of_known_integrals(case):
    domain, field, expected = INTEGRALS[case]
    # The tree of the oblique dip, with dh/dx = 2, reaches the limit of its work.
    relative = 1e-3 if case == "thin dip in a formula" else 1.5e-4
    assert count_cells(field, domain) == pytest.approx(expected, rel=relative)


def test_small_minimum_of_a_raster_is_found():
    """Nine low values among 1000 x 600 are found by their landmark."""
    values = np.full((601, 1001), 0.1)
    values[232:235, 776:779] = 1e-3
    field = sizing.Raster(values, BOX.lower, BOX.upper)
    side = 0.0025  # of a pixel
    t = (np.arange(2000) + 0.5) / 2000  # the four corner pixels by the midpoint rule
    corner = 0.1 - (0.1 - 1e-3) * np.outer(t, t)
    spot = 4 * side**2 / 1e-3**2 + 8 * side**2 / (1e-3 * 0.1) + 4 * side**2 * (corner**-2).mean()
    expected = spot + (3.75 - 16 * side**2) / 0.1**2
    assert spot > 20
    assert count_cells(field, BOX) == pytest.approx(expected, rel=1.5e-4)


def test_tolerance_is_met():
    errors = [abs(count_cells(F2, BOX, t) / 22972.2421613 - 1) for t in (1e-2, 1e-3, 1e-5)]
    assert errors[0] < 1e-2
    assert errors[1] < 1e-3
    assert errors[2] < 1e-5


@pytest.mark.sparse(2)
@pytest.mark.parametrize(
    "text",
    [
        "hypot(x-0.7771, y-0.3111)",  # the integral diverges, no sample is zero
        "fabs(x - 0.7771) + 1e-9",
        "0.01 + 0.0099*sin(1e5*x)*cos(1e5*y)",
        "0.001 + 10*fabs(hypot(x-0.9, y-0.75)-0.3)",
    ],
)
def test_work_is_bounded_for_hard_fields(text):
    samples = 0

    def counting(points):
        nonlocal samples
        samples += len(points)
        return sizing.Expression(text)(points)

    tree = DensityTree(counting, BOX)
    assert np.isfinite(tree.integral)
    assert len(tree.boxes) <= 1 << 17
    assert samples < 9 * 1.4 * (1 << 17)  # each split box is examined once, its children too


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: count_cells(F1, BOX, 0), InputError, "tolerance"),
        (lambda: count_cells(F1, BOX, "1"), InputError, "tolerance"),
        (lambda: sample_density(F1, BOX, 0, 3), InputError, "n is 0"),
        (lambda: sample_density(F1, BOX, 2.5, 3), InputTypeError, "n is 2.5"),
        (lambda: sample_density(F1, BOX, 5, -3), InputError, "seed is -3"),
        (lambda: sample_uniform(BOX, -1, 3), InputError, "n is -1"),
        (lambda: sample_uniform(BOX, 5, None), InputTypeError, "seed is None"),
    ],
)
def test_bad_input(make, error, message):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize("dim", [2, 3])
def test_hilbert_curve_is_continuous(dim):
    """In a uniform tree each box shares a face with the one before, roots included."""
    boxes = BoxTree(Box((0,) * dim, (2.9, 1.9, 1.0)[:dim]))
    for level in range(1, 4):
        boxes.split(np.ones(len(boxes), bool))
        step = 0.5**level
        root = np.floor(boxes.corner)
        moves = np.abs(np.diff(boxes.corner, axis=0)).sum(axis=1)
        inside = (np.diff(root, axis=0) == 0).all(axis=1)
        assert (moves[inside] == step).all()
        assert len(np.unique(boxes.corner, axis=0)) == len(boxes)


@pytest.mark.parametrize("dim", [2, 3])
def test_hilbert_tables_are_permutations(dim):
    place, after, rank = hilbert_tables(dim)
    code = place @ (1 << np.arange(dim))
    assert (np.sort(code, axis=1) == np.arange(1 << dim)).all()
    assert (np.take_along_axis(rank, code, axis=1) == np.arange(1 << dim)).all()
    assert after.min() >= 0
    assert after.max() < len(place)


@pytest.fixture(scope="module", params=["F2", "3D"])
def tree(request):
    if request.param == "F2":
        return DensityTree(F2, BOX, 1e-3)
    field = sizing.Distance(sizing.Ball((1.5, 1.5, 1.4), 0.25), 0.04, slope=0.3)
    return DensityTree(field, CUBE, 1e-2)


def test_boxes_tile_the_domain(tree):
    boxes = tree.boxes
    domain = BOX if boxes.dim == 2 else CUBE
    assert np.prod(boxes.edges(), axis=1).sum() == pytest.approx(domain.measure, rel=1e-12)
    rng = np.random.default_rng(909)
    places = rng.uniform(0, domain.extent / boxes.root, (200, boxes.dim))
    low, high = boxes.corner, boxes.corner + 0.5 ** boxes.level.astype(float)[:, None]
    holds = ((places[:, None] >= low) & (places[:, None] < high)).all(axis=2)
    assert (holds.sum(axis=1) == 1).all()
    assert np.array_equal(tree.boxes.find(places), holds.argmax(axis=1))


def test_neighbors_differ_by_one_level(tree):
    boxes = tree.boxes
    edge = 0.5 ** boxes.level.astype(float)[:, None]
    end = np.rint((boxes.upper - boxes.origin) / boxes.root)
    for axis in range(boxes.dim):
        for side in (-1, 1):
            places = boxes.corner + 0.5 * edge
            places[:, axis] += side * edge[:, 0] * 0.75
            inside = ((places > 0) & (places < end)).all(axis=1)
            there = tree.boxes.find(places[inside])
            assert (boxes.level[there] >= boxes.level[inside] - 1).all()


def test_known_sizes_are_bounds(tree):
    """The bounds of h of a box include those at its landmarks after any refinement."""
    box = tree.boxes.find(tree._landmarks)
    assert np.array_equal(box, tree._landmark_box)
    assert (tree._low[box] <= tree._landmark_sizes).all()
    assert (tree._high[box] >= tree._landmark_sizes).all()


@pytest.mark.sparse(3)
@pytest.mark.parametrize(("n", "seed"), [(1, 11), (7, 12), (588, 13), (22972, 14)])
def test_each_box_gets_its_share(tree, n, seed):
    """Every box of the tree has its expected number of points, rounded up or down."""
    field, boxes = tree.field, tree.boxes
    domain = BOX if boxes.dim == 2 else CUBE
    points = sample_density(field, domain, n, seed)
    assert points.shape == (n, boxes.dim)
    reference = DensityTree(field, domain, 1e-3)
    found = reference.boxes.find((points - reference.boxes.origin) / reference.boxes.root)
    counts = np.bincount(found, minlength=len(reference.boxes))
    expected = reference.cells * (n / reference.integral)
    assert np.abs(counts - expected).max() < 1 + 1e-6


def test_samples_follow_the_density_along_an_axis():
    """The empirical distribution of x against the exact one, for h^-2 proportional to exp(4 x)."""
    n = 4000
    points = sample_density(sizing.Expression("exp(-2*x)"), BOX, n, 3141)
    x = np.sort(points[:, 0])
    exact = np.expm1(4 * x) / math.expm1(10)
    # Independent samples would stay within 1.36 / sqrt(n) = 0.021 (95 %); systematic ones do better.
    assert np.abs(exact - (np.arange(n) + 0.5) / n).max() < 0.007
    y = np.sort(points[:, 1]) / 1.5
    assert np.abs(y - (np.arange(n) + 0.5) / n).max() < 0.015


def test_position_inside_a_box_follows_the_slope():
    """A sample of one point has one box, the domain. The slope of h in it then determines the distribution."""
    domain = Box((0, 0), (1, 1))
    field = sizing.Expression("exp(-x)")
    x = np.array([sample_density(field, domain, 1, seed)[0, 0] for seed in range(100, 250)])
    mean = (1 + 1 / math.tanh(1)) / 2 - 0.5  # of the density 2 exp(2 x) / (e^2 - 1)
    assert mean == pytest.approx(0.6565, abs=1e-4)
    # Standard deviation 0.26 / sqrt(150) = 0.021; uniform positions would give 0.5.
    assert x.mean() == pytest.approx(mean, abs=0.07)


def test_starts_repeat_bit_by_bit():
    for sample in (lambda s: sample_density(F1, BOX, 588, s), lambda s: sample_uniform(BOX, 588, s)):
        first = sample(2718)
        assert np.array_equal(first, sample(2718))
        assert not np.array_equal(first, sample(2719))


def test_uniform_is_plain_uniform():
    points = sample_uniform(BOX, 20000, 515)
    counts, _, _ = np.histogram2d(*points.T, bins=(5, 3), range=[(0, 2.5), (0, 1.5)])
    # 15 bins of 1333 each, standard deviation 35: plain random points scatter, but not by 4 of it.
    assert np.abs(counts - 20000 / 15).max() < 4 * 35.3
    assert np.std(counts) > 10


@pytest.mark.parametrize("name", ["box", "two balls", "torus", "outside"])
def test_lattices_fill_domains(name):
    """All points are off the walls, each has eight neighbors at the same distance, and others are farther.

    They are the start where sizes are the same in the whole domain.
    """
    domains = {
        "box": lambda: Box((1, 2, 3), (2, 4, 3.5)),
        "two balls": lambda: Solid.ball((0, 0, 0), 1) + Solid.ball((3, 0, 0), 0.3),
        "torus": lambda: Solid.torus((0, 0, 0), 1, 0.4, edge=0.1),
        "outside": lambda: Solid.outside(Solid.ball((0, 0, 0), 0.5), Box((-1, -1, -1), (1, 1, 1))),
    }
    domain, n = domains[name](), 8000
    spacing = (domain.measure / n) ** (1 / 3)
    points = sample_lattice(domain, spacing, 3)
    tree = density_tree(spacing, domain)
    assert len(sample_even(tree, domain, round(tree.integral), 3, np.float64, (spacing,))) == len(points)
    assert domain.contains_well(points, 0.05 * spacing).all()
    # Points near walls are left out: a layer of 0.05 spacings, and their number scatters.
    assert len(points) == pytest.approx(n, rel=0.03)
    assert len(np.unique(domain.piece_of(points))) == domain.n_pieces
    inner = domain.contains_well(points, 1.2 * spacing)
    assert inner.any()
    near = cKDTree(points).query(points[inner], k=10)[0][:, 1:]
    edge = 2 ** (1 / 3) * spacing
    assert np.allclose(near[:, :8], edge * 3**0.5 / 2, rtol=1e-9)
    assert np.allclose(near[:, 8], edge, rtol=1e-6)
    assert np.array_equal(points, sample_lattice(domain, spacing, 3))
    assert not np.array_equal(points, sample_lattice(domain, spacing, 4))


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ("0.05", {0.05: 8000}),
        ("0.05 + 0.0003*(x - 1)", {0.05015: 7928}),
        ("0.05 + 0.01*(x - 1)", {}),
        ("fmin(0.1, 0.05 + fmax(x - 1.25, 0)/2)", {0.05: 2000, 0.1: 650}),
        ("x < 1.25 ? 0.04 : 0.05", {0.05: 6000, 0.04: 3906}),
    ],
)
def test_even_sizes_are_found(size, expected):
    found = DensityTree(sizing.Expression(size), CUBE).even_sizes(500)
    assert list(found) == pytest.approx(list(expected), rel=1e-3)
    assert list(found.values()) == pytest.approx(list(expected.values()), rel=0.05)


@pytest.mark.parametrize("name", ["two balls", "outside"])
def test_lattices_are_where_sizes_are_the_same(name):
    """Elsewhere points are random. There are as many as the sizes ask for."""
    small = Solid.ball((3, 0, 0), 0.1)
    domain = {
        "two balls": Solid.ball((2.2, 0, 0), 0.6) + small,
        "outside": Solid.outside(small, Box((1.8, -0.5, -0.5), (3.2, 0.5, 0.5))),
    }[name]
    field = sizing.Expression("0.05 + fmin(0.03, fmax(0, 0.2*(2.4 - x)))")
    tree = density_tree(field, domain)
    n = 2 * round(tree.integral)
    sizes = tuple(tree.even_sizes(300))
    assert sorted(sizes) == pytest.approx([0.05, 0.08], rel=1e-3)
    points = sample_even(tree, domain, n, 3, np.float64, sizes)
    expected = 2 * domain.measure * (field(sample_uniform(domain, 50_000, 1)) ** -3).mean()
    assert len(points) == pytest.approx(expected, rel=0.04)
    assert np.unique(domain.piece_of(points)).size == domain.n_pieces
    near, those = cKDTree(points).query(points, k=10)
    spacing, h = 2 ** (-1 / 3) * field(points), field(points)
    of_lattice = np.abs(near[:, 1:9] - 2 ** (1 / 3) * 3**0.5 / 2 * spacing[:, None]).max(axis=1) < 3e-3 * spacing
    for size in sizes:
        inner = (np.abs(h[those] / size - 1) < 0.009).all(axis=1) & domain.contains_well(points, 1.2 * size)
        assert np.count_nonzero(inner) > 50
        assert of_lattice[inner].mean() > 0.8
    assert not of_lattice[np.abs(h[:, None] / sizes - 1).min(axis=1) > 0.02].any()


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", [np.float64, np.float32, np.float16])
@pytest.mark.parametrize("start", ["density", "uniform"])
def test_points_are_distinct_and_inside(real, start):
    """Points are distinct also if rounding makes many coincide: 4000 points in float16 have thousands of duplicates."""
    domain = Box((-3, 5), (-1.9, 5.7))
    n = 4000 if real is np.float16 else 30000
    field = sizing.Expression("0.001 + 0.2*hypot(x+2.2, y-5.1)")
    if start == "density":
        points = sample_density(field, domain, n, 161, real)
    else:
        points = sample_uniform(domain, n, 161, real)
    origin, scale = domain.frame
    working = ((points - origin) / scale).astype(real)
    assert len(np.unique(working, axis=0)) == n
    assert (working > 0).all()
    assert (working < (domain.extent / scale).astype(real)).all()
    assert (points > domain.lower).all()
    assert (points < domain.upper).all()


def test_more_points_than_the_precision_has():
    """With h = 1e-10 + 0.3 r two fifths of the cells lie within one unit of float32 round-off of the tip."""
    field = sizing.Distance(sizing.Circle((0.7, 0.7), 0), 1e-10, slope=0.3)
    box = Box((0, 0), (1, 1))
    assert len(sample_density(field, box, 1500, 99)) == 1500
    with pytest.raises(InputError, match=r"n is 1500.*float32 has not.*use dtype='float64'"):
        sample_density(field, box, 1500, 99, np.float32)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_device_and_host_agree(ctx, dtype):
    import pyopencl as cl

    queue = cl.CommandQueue(ctx)
    engine = Engine(queue.context, queue, 2, np.dtype(dtype))
    stage = sizing.Sizing(engine, BOX, F1)
    assert count_cells(stage, BOX) == pytest.approx(587.8113, rel=1.5e-4)
    points = sample_density(stage, BOX, 588, 4711)
    assert np.array_equal(points, sample_density(stage, BOX, 588, 4711))
    working = (points / BOX.frame[1]).astype(dtype)
    assert len(np.unique(working, axis=0)) == 588
    if dtype == "float64":
        # Boxes and shares are the same up to round-off. The points are the same, except for rare swaps.
        host = sample_density(F1, BOX, 588, 4711)
        assert np.mean(np.abs(host - points).max(axis=1) < 1e-6) > 0.9


def test_callable_and_number_as_field():
    def cone(points):
        assert BOX.contains(points).all()
        return F1(points)

    assert count_cells(cone, BOX) == pytest.approx(587.8113, rel=1.5e-4)
    assert np.array_equal(sample_density(cone, BOX, 60, 5), sample_density(F1, BOX, 60, 5))
    assert sample_density(0.1, BOX, 375, 5).shape == (375, 2)


def test_draws_reach_a_point_just_below_the_surface_of_a_solid():
    cube, inner = Solid.box((0, 0, 0), (1, 1, 1)), np.array([[1 - 1e-10, 0.5, 0.5]])

    def draw(rows, attempt):
        return inner[rows] + 0.5 ** max(0, attempt - 20) * np.array([0.1, 0.2, 0.2])

    assert cube.contains(_distinct(draw, cube, np.empty((0, 3)), 1, np.dtype(float))).all()
