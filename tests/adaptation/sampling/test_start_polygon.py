"""Count and start in polygonal domains: h is evaluated inside only, shares are exact, pieces are not empty."""

import numpy as np
import pytest

import clvoro
from clvoro import sizing
from clvoro.adaptation.sampling.box_tree import BoxTree
from clvoro.adaptation.sampling.coverage import PolygonCoverage
from clvoro.adaptation.sampling.quadrature import DensityTree
from clvoro.adaptation.sampling.start import count_cells, sample_density, sample_uniform
from clvoro.errors import InputError
from tests.reference.polygons import HOLE, SQUARE, crossings
from tests.reference.shores import star

ANNULUS = clvoro.Polygon(star(400), [star(90, 5, (0.05, 0.0), 0.2)])
NEEDLE = clvoro.Polygon([(0, 0), (1e-3, 0), (3, 2), (3, 2 + 1e-3)])  # along a diagonal
PIECES = clvoro.Polygon.from_pieces(
    [[SQUARE, HOLE], [SQUARE * 1e-3 + 7], [HOLE * 0.5 + (0.75, 0.75)], [SQUARE[::-1] + np.array([4, 3])]]
)
DOMAINS = {"annulus": ANNULUS, "needle": NEEDLE, "pieces": PIECES}
GROWING = sizing.Expression("0.01 + 0.1 * hypot(x - 0.6, y)")
DIP = sizing.Distance(sizing.Segment((-2, 0.1), (2, 0.4)), 0.01, slope=0.1)
STAR = clvoro.Polygon(star(50), [star(11, 5, (0.05, 0.0), 0.2)])


def guarded(domain: clvoro.Polygon, field):
    """Return `field` that raises an error for a point outside of `domain`."""

    def size(points: np.ndarray) -> np.ndarray:
        assert domain.contains(points).all()
        return np.broadcast_to(field(points) if callable(field) else field, len(points))

    if hasattr(field, "landmarks"):
        size.landmarks = field.landmarks
    return size


@pytest.mark.sparse(1)
@pytest.mark.parametrize("name", DOMAINS)
def test_constant_sizes_count_the_area(name: str) -> None:
    domain = DOMAINS[name]
    h = np.sqrt(domain.measure / 1000)
    # Shares are areas of some thousand intersections, each with a round-off of 1e-16 of its box.
    assert count_cells(guarded(domain, h), domain) == pytest.approx(1000, rel=1e-10)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("field", [GROWING, DIP], ids=["growing", "dip"])
def test_counts_of_varying_sizes(field) -> None:
    """The reference is a sum over the midpoints of 1200 x 1200 pixels, of which the boundary cuts one in 200."""
    n = 1200
    x = (np.arange(n) + 0.5) / n * 2 - 1
    grid = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    inside = grid[crossings(grid, STAR.rings)]
    expected = (field(inside) ** -2.0).sum() * (2 / n) ** 2
    assert count_cells(guarded(STAR, field), STAR) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("name", DOMAINS)
def test_shares_are_those_of_area(name: str) -> None:
    domain = DOMAINS[name]
    boxes = BoxTree(domain)
    coverage = PolygonCoverage(boxes, domain)
    for _ in range(4):
        coverage.split(coverage.occupied)
        areas = np.prod(boxes.edges(), axis=1)
        assert (coverage.share * areas).sum() == pytest.approx(domain.measure, rel=1e-9)
    assert (coverage.share == 0).any()
    cut = (coverage.share > 0) & (coverage.share < 1)
    assert domain.covers(coverage.inner[cut]).all()
    lower, upper = boxes.points(np.array([[0.0, 0.0], [1, 1]])).transpose(1, 0, 2)
    assert ((coverage.inner >= lower) & (coverage.inner <= upper))[cut].all()
    rng = np.random.default_rng(1)
    at = boxes.points(rng.random((len(boxes), 200, 2)))
    inside = domain.contains(at.reshape(-1, 2)).reshape(-1, 200)
    assert inside[coverage.share == 1].all()
    assert not inside[coverage.share == 0].any()
    # 200 trials each: six standard deviations of a binomial, over a thousand boxes.
    spread = 6 * np.sqrt(0.25 / 200)
    assert np.abs(inside.mean(axis=1) - coverage.share).max() < spread


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("start", ["density", "uniform"])
@pytest.mark.parametrize("name", DOMAINS)
def test_points_are_distinct_and_strictly_inside(name: str, start: str, real: str) -> None:
    domain = DOMAINS[name]
    real, n = np.dtype(real), 800
    if start == "density":
        size = guarded(domain, sizing.Expression("0.01 + 0.1*fabs(x - 0.5)"))
        points = sample_density(size, domain, n, 7, real)
        again = sample_density(size, domain, n, 7, real)
    else:
        points, again = (sample_uniform(domain, n, 7, real) for _ in range(2))
    assert points.shape == (n, 2)
    assert (points == again).all()
    origin, scale = domain.frame
    working = ((points - origin) / scale).astype(real)
    assert len(np.unique(working, axis=0)) == n
    back = working.astype(float) * scale + origin
    assert domain.covers(back).all()
    # Rounding moves a point by up to half an ulp; four ulps are kept free.
    assert domain.boundary_distance(back).min() > 3 * np.finfo(real).eps * scale
    assert (np.bincount(domain.piece_of(points), minlength=domain.n_pieces) > 0).all()


def test_samples_follow_the_density() -> None:
    """Systematic samples: the number in a part is off by less than one for each visit of the curve."""
    n = 3000
    tree = DensityTree(GROWING, ANNULUS, tolerance=1e-3)  # as that of the samples
    points = sample_density(GROWING, ANNULUS, n, 3)
    middle = tree.boxes.points(np.full((1, 2), 0.5))[:, 0]
    for axis in (0, 1):
        for share in (0.25, 0.5, 0.75):  # between boxes
            cut = ANNULUS.lower[axis] + share * ANNULUS.extent[axis]
            beyond = middle[:, axis] > cut
            expected = tree.cells[beyond].sum() / tree.integral * n
            stays = np.count_nonzero(beyond[1:] & ~beyond[:-1]) + beyond[0]
            assert stays <= 8
            assert abs(np.count_nonzero(points[:, axis] > cut) - expected) < stays


def test_uniform_samples_are_uniform() -> None:
    n, side = 20000, 8
    points = sample_uniform(ANNULUS, n, 5)
    boxes = BoxTree(clvoro.Box((-1, -1), (1, 1)))
    coverage = PolygonCoverage(boxes, ANNULUS)
    for _ in range(3):
        coverage.split(np.ones(len(boxes), bool))
    expected = coverage.share * 4 / len(boxes) / ANNULUS.measure * n
    cell = boxes.find((points + 1) / 2)
    got = np.bincount(cell, minlength=side * side)
    used = expected > 5
    chi2 = ((got - expected)[used] ** 2 / expected[used]).sum()
    # Mean k, variance 2 k: five standard deviations.
    k = np.count_nonzero(used)
    assert 40 < k
    assert abs(chi2 - k) < 5 * np.sqrt(2 * k)


def test_few_points_still_reach_every_piece() -> None:
    for n in (4, 5, 40):
        for points in (sample_uniform(PIECES, n, 2), sample_density(0.5, PIECES, n, 2)):
            assert sorted(set(PIECES.piece_of(points))) == [0, 1, 2, 3]
    for sample in (lambda: sample_uniform(PIECES, 3, 2), lambda: sample_density(0.5, PIECES, 3, 2)):
        with pytest.raises(InputError, match="n is 3, expected at least 4"):
            sample()


def test_sizes_are_checked_inside_only() -> None:
    field = sizing.Expression("x < 1.5 && y < 1.5 && x > 1.05 && y > 1.05 ? -1.0 : 0.1")
    assert count_cells(field, clvoro.Polygon(SQUARE, [HOLE])) == pytest.approx(1100, rel=1e-3)
    with pytest.raises(InputError, match="is -1 at"):
        count_cells(field, clvoro.Polygon(SQUARE))


def test_two_common_faces_bring_two_generators(ctx) -> None:
    """The common face of two cells is cut by an obstacle, beside which both generators see their middle."""
    from clvoro.tessellation.tessellator import Tessellator

    outer = np.array([(-3.0, -2), (3, -2), (3, 2), (-3, 2)])
    obstacle = np.array([(1.0, -0.1), (1.2, -0.1), (1.2, 0.1), (1, 0.1)])
    domain = clvoro.Polygon(outer, [obstacle])
    stages = clvoro.Adapter(ctx)._stages_for(domain)
    upload = stages.engine.upload
    points = upload(domain.place(np.array([(0.0, -1), (0, 1)]), np.dtype(float)))
    t = Tessellator(stages, domain).tessellate(points, 2, exact=True)
    origin, scale = domain.frame
    finer = stages.refinement.refine(domain, t, upload([0.5, 0.5])).get() * scale + origin
    assert len(finer) == len(np.unique(finer, axis=0)) == 6  # the parents, two middles, one before each's longest wall
    assert domain.contains(finer).all()
    for middle in ((0.0, 0), (2.1, 0)):
        assert np.hypot(*(finer - middle).T).min() < 1e-12


@pytest.mark.sparse(1)
@pytest.mark.parametrize("method", ["coupled", "adaptive"])
def test_sources_are_balanced_per_component(ctx, method: str) -> None:
    """The Poisson equation on a graph of two parts has a solution only if the sources of each part sum up to 0."""
    corner = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])
    domain = clvoro.Polygon.from_pieces([[corner], [corner * 2 + np.array([3, 0])]])
    options = {"method": method, "max_steps": 60} if method == "coupled" else {"effort": "fast"}
    result = clvoro.Adapter(ctx).run(domain, 0.15, seed=1, **options)
    assert result.check().ok
    assert np.isin(result.history["iterations"], np.arange(1, 100)).any()
    # At most a tenth of the size of a cell. Rounding the number of cells of a piece costs a twentieth.
    assert np.abs(result.size_error).mean() < 0.1


def test_coarse_levels_reach_every_piece(ctx) -> None:
    """Each piece of the domain has a cell on coarse levels, too, where there would be fewer cells than pieces."""
    corner = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])
    pieces = [[corner + np.array([2 * i, 3 * (i % 2)])] for i in range(9)]
    domain = clvoro.Polygon.from_pieces(pieces)
    result = clvoro.Adapter(ctx).run(domain, 0.3, effort="fast", options=clvoro.MultilevelOptions(levels=2), seed=1)
    assert len(set(domain.piece_of(result.points))) == 9
    assert result.check().ok
