"""Sizes by the boundary of a polygonal domain: distance to edges, narrow places, curves."""

import math

import numpy as np
import pyopencl as cl
import pytest
from scipy.spatial import Delaunay

import clvoro
from clvoro import sizing
from clvoro.adaptation.sampling.start import sample_uniform
from clvoro.errors import InputError, InputTypeError
from clvoro.geometry.gaps import FACING
from clvoro.opencl.engine import Engine
from tests.reference.polygons import HOLE, SQUARE
from tests.reference.shores import star

CIRCLE = np.column_stack([f(np.arange(200) * math.pi / 100) for f in (np.cos, np.sin)])


def inner(domain: clvoro.Polygon, n: int = 4000) -> np.ndarray:
    return np.concatenate([sample_uniform(domain, n, 1), domain.oriented.vertices])


# --- distance to the boundary --------------------------------------------------------------------


def test_distance_to_the_boundary_of_the_domain() -> None:
    domain = clvoro.Polygon(star(60)[::-1], [star(20, 5, (0.05, 0.0), 0.2)])
    x = inner(domain)
    size = sizing.Distance(domain, 0.1, slope=0.5)(x)
    assert np.abs(size - 0.1 - 0.5 * domain.boundary_distance(x)).max() < 1e-15
    chosen = [3, 60, 17]
    mask = np.isin(np.arange(80), chosen)
    rings = [np.roll(ring, -1, axis=0) for ring in domain.rings]
    for edges in (chosen, mask):
        a, b = domain.vertices[mask], np.concatenate(rings)[mask]
        wanted = [sizing.Distance(sizing.Segment(p, q), 0.1, slope=0.5)(x) for p, q in zip(a, b, strict=True)]
        found = sizing.Distance(domain.boundary(edges), 0.1, slope=0.5)(x)
        assert np.abs(found - np.min(wanted, axis=0)).max() < 1e-15
    with pytest.raises(InputError, match="has edge 80, expected numbers from 0 to 79"):
        domain.boundary([80])
    with pytest.raises(InputError, match="at least one"):
        domain.boundary([])


# --- narrow places -------------------------------------------------------------------------------


def test_number_of_cells_across_a_channel() -> None:
    channel = clvoro.Polygon([(0, 0), (10, 0), (10, 1), (0, 1)])
    for across in (2, 4, 9.5):
        size = sizing.FeatureSize(channel, across, h_max=2)
        h = size(inner(channel))
        assert h.min() >= 1 / across * (1 - 1e-9)  # in the corners, too
        y = np.linspace(0, 1, 1001)
        for x in (1.0, 4.9, 5.05):
            cells = np.mean(1 / size(np.column_stack([np.full(1001, x), y])))
            # Sources are an eighth of the width apart at most: the size in between is larger by slope / 16.
            least = (1 - 1e-9) / (1 + size.slope * across / 16)
            assert least <= cells / across <= 1 + 1e-9


def test_square_has_no_gaps() -> None:
    square = clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1)])
    assert sizing.FeatureSize(square)(inner(square)).min() == 0.1
    assert sizing.FeatureSize(square, h_max=1)(inner(square)).min() >= 0.25


def test_facing_tips_form_a_gap() -> None:
    """No normal of an edge points through a neck between two corners."""
    ring = [(0, 0), (4, 0), (5, 0.45), (6, 0), (10, 0), (10, 1), (6, 1), (5, 0.55), (4, 1), (0, 1)]
    neck = clvoro.Polygon(ring)
    size = sizing.FeatureSize(neck, 5)
    assert size(np.array([(5, 0.5), (5, 0.45)])) == pytest.approx(0.02, rel=1e-6)
    # A tip in front of a wall, and one piece in front of another.
    hole = clvoro.Polygon(np.array(SQUARE), [[(2, 0.1), (2.2, 1), (1.8, 1)]])
    # Directions at corners are 7.5 degrees apart: the chord deviates from the vertical by a quarter of that.
    size = sizing.FeatureSize(hole, 5)
    aside = 0.05 * math.tan(math.radians(7.5 / 4))
    found = size(np.array([(2, 0.05)]))[0]
    assert 0.02 <= found <= 0.02 / math.cos(math.radians(7.5 / 4)) + size.slope * aside


def test_gaps_outside_of_the_domain_are_ignored() -> None:
    apart = clvoro.Polygon.from_pieces([[SQUARE], [SQUARE + np.array([4.01, 0])]])
    assert sizing.FeatureSize(apart)(inner(apart)).min() > 0.3


def reference(domain: clvoro.Polygon, x: np.ndarray, across: float, slope: float, facing: float) -> np.ndarray:
    """The same size from the empty circumcircles of the Delaunay triangles of a dense sample of the boundary."""
    start, end = domain.oriented.vertices, domain.oriented.vertices[domain.oriented.next_vertex]
    t = (np.arange(120) + 0.5)[:, None, None] / 120
    apart = np.hypot(*(end - start).T).max() / 120
    p = np.concatenate([*(start + t * (end - start)), start])
    corners = p[Delaunay(p).simplices]
    a, b, c = corners.transpose(1, 0, 2)
    u, v = b - a, c - a
    twice = 2 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    uu, vv = (u**2).sum(1), (v**2).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_center = np.column_stack([v[:, 1] * uu - u[:, 1] * vv, u[:, 0] * vv - v[:, 0] * uu]) / twice[:, None]
    center = a + to_center
    fine = np.isfinite(center).all(axis=1)
    fine[fine] = domain.contains(center[fine])
    sources = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        one, two = corners[fine, i] - center[fine], corners[fine, j] - center[fine]
        radius2 = (one**2).sum(1)
        faces = (one * two).sum(1) <= math.cos(facing) * radius2
        found = corners[fine][faces][:, [i, j]]
        sources.append(found[np.hypot(*(found[:, 0] - found[:, 1]).T) > 8 * apart])  # shorter ones are not resolved
    chords = np.concatenate(sources)
    begin, along = chords[:, 0], chords[:, 1] - chords[:, 0]
    length2 = (along**2).sum(1)
    t = np.clip((((x[:, None] - begin) * along).sum(2) / length2), 0, 1)
    away = np.linalg.norm(begin + t[:, :, None] * along - x[:, None], axis=2)
    return (np.sqrt(length2) / across + slope * away).min(axis=1)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gaps_of_random_polygons(seed: int) -> None:
    domain = clvoro.Polygon(star(14, seed), [star(7, seed + 9, (0.05, 0.0), 0.2)])
    x = inner(domain, 300)
    size = sizing.FeatureSize(domain, 4, slope=0.3, h_min=0.02, h_max=0.5, curvature=0)
    h = size(x)
    # The sample is 1/120 of an edge apart, so are the ends of its chords off; edges that just face each other,
    # or just do not, may be classified otherwise: ten degrees either way.
    step = np.hypot(*(domain.oriented.vertices[domain.oriented.next_vertex] - domain.oriented.vertices).T).max() / 120
    turn = math.radians(10)
    more, fewer = (reference(domain, x, 4, 0.3, FACING + s * turn).clip(0.02, 0.5) for s in (-1, 1))
    assert (h >= more - (0.25 + 0.3) * step).all()
    # Between two chords from one corner, 7.5 degrees apart, the size is larger by slope * across * tan(7.5 / 2), as
    # much again between those from a wall, a fourth of the ball's radius apart.
    between = 2 * 0.3 * 4 * math.tan(math.radians(7.5 / 2))
    assert (h <= (1 + between) * fewer + (0.25 + 0.3) * step).all()
    assert np.ptp(h) > 0.05


def test_growth_is_bounded() -> None:
    domain = clvoro.Polygon(star(40), [star(20, 5, (0.05, 0.0), 0.2)])
    size = sizing.FeatureSize(domain, h_min=0.003, h_max=0.2, growth=1.3)
    rng = np.random.default_rng(4)
    x = rng.uniform(-1, 1, (3000, 2))
    y = x + rng.normal(0, 0.03, x.shape)
    change = np.abs(size(x) - size(y)) / np.hypot(*(x - y).T)
    assert change.max() <= math.log(1.3) * (1 + 1e-9)
    assert 0.003 <= size(x).min() < size(x).max() <= 0.2


# --- curves --------------------------------------------------------------------------------------


def test_number_of_cells_per_radius_of_curvature() -> None:
    holes = [0.1 * CIRCLE, 0.5 * CIRCLE + (2, 2)]
    domain = clvoro.Polygon(SQUARE * 2 - 2, holes)
    size = sizing.FeatureSize(domain, cells_across=0.5, curvature=5, h_max=1)
    # The polygon's radius of curvature is that of the circle inscribed in it; near sources are thinned out.
    inscribed = math.cos(math.pi / 200)
    for r, center in ((0.1, 0), (0.5, 2)):
        h = size(r * CIRCLE + center) / (r / 5 * inscribed)
        assert 1 - 1e-9 <= h.min() <= 1 + 1e-9
        assert h.max() <= 1 + size.slope / 11
    plain = sizing.FeatureSize(domain, cells_across=0.5, curvature=0, h_max=1)
    assert plain(inner(domain)).min() == 1
    corners = clvoro.Polygon(SQUARE, [HOLE[:3] * 0.01 + 1])  # short edges between sharp corners
    assert sizing.FeatureSize(corners, cells_across=1, h_max=0.5)(inner(corners)).min() == 0.5


# --- on the device, and what is refused ----------------------------------------------------------


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_device_and_host_agree(ctx, dtype: str) -> None:
    domain = clvoro.Polygon(star(40) + 100, [star(20, 5, (100.05, 100.0), 0.2)])
    size = sizing.FeatureSize(domain, h_min=0.003, h_max=0.2)
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(dtype))
    x = inner(domain)
    on_device = sizing.Sizing(engine, domain, size)(x)
    # Positions and sums are rounded to a few eps of the frame, which is 4 wide.
    allowed = 40 * np.finfo(dtype).eps
    assert np.abs(on_device - size(x)).max() < allowed


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"domain": clvoro.Box((0, 0), (1, 1))}, "domain is a Box, expected a clvoro.Polygon"),
        ({"cells_across": 0}, "cells_across is 0"),
        ({"cells_across": 1e300}, "at most 1e"),
        ({"growth": 1}, "no growth"),
        ({"growth": 1.2, "slope": 0.1}, "exactly one"),
        ({"h_min": -1}, "h_min is -1"),
        ({"h_min": 0.1, "h_max": 0.05}, "h_max is 0.05, expected at least h_min"),
        ({"curvature": -1}, "curvature is -1"),
    ],
)
def test_bad_input(options: dict, says: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=says):
        sizing.FeatureSize(**{"domain": clvoro.Polygon(SQUARE), **options})


# --- other fields in polygons --------------------------------------------------------------------


def test_graded_fields_are_evaluated_inside_only() -> None:
    """A jump becomes a ramp, and values of the field outside are not used."""
    domain = clvoro.Polygon(star(60), [star(20, 5, (0.05, 0.0), 0.2)])

    def jump(x: np.ndarray) -> np.ndarray:
        assert domain.contains(x).all()
        return np.where(x[:, 0] < 0.3, 0.02, 0.4)

    graded = sizing.Graded(jump, slope=0.4, resolution=401)
    graded.raster(domain)
    x = inner(domain)
    h = graded(x)
    # The shortest way from the left is perpendicular to the jump. The error of the scheme is the growth over a spacing.
    exact = np.minimum(np.where(x[:, 0] < 0.3, 0.02, 0.02 + 0.4 * (x[:, 0] - 0.3)), 0.4)
    spacing = domain.extent.max() / 400
    assert (h >= exact - 2 * 0.4 * spacing).all()
    assert h.max() < 0.4


def test_rasters_must_cover_the_domain_if_required(ctx) -> None:
    values = np.full((5, 7), 0.1)
    lower, upper = (0, 0), (4, 2.5)
    domain = clvoro.Polygon(SQUARE)  # up to y = 3
    field = sizing.Raster(values, lower, upper, outside="error")
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(float))
    with pytest.raises(InputError, match=r"does not cover the domain: it has no value at \(4, 3\)"):
        sizing.Sizing(engine, domain, sizing.minimum(field, 0.5))
    with pytest.raises(InputError, match=r"it has no value at \(1, 2.6\)"):
        field(np.array([(1, 1), (1, 2.6)]))
    with pytest.raises(InputError, match="outside='no'"):
        sizing.Raster(values, lower, upper, outside="no")
    low = clvoro.Polygon(SQUARE * [1, 2.5 / 3])
    sizing.Sizing(engine, low, field)
    sizing.Sizing(engine, clvoro.Box(lower, upper), field)
    assert sizing.Raster(values, lower, upper)(np.array([(9.0, 9)])) == 0.1


def test_graded_fields_resolve_narrow_straits() -> None:
    """A canal thinner than the spacing of the nodes."""
    canal = [
        (0, 0),
        (1, 0),
        (1, 0.503),
        (2, 0.503),
        (2, 0),
        (3, 0),
        (3, 1),
        (2, 1),
        (2, 0.504),
        (1, 0.504),
        (1, 1),
        (0, 1),
    ]
    domain = clvoro.Polygon(canal)
    graded = sizing.Graded(sizing.Expression("x > 1 && x < 2 ? 0.01 : 0.3"), slope=0.2, resolution=151)
    graded.raster(domain)
    h = graded(np.array([(1.5, 0.5035), (0.5, 0.5035), (0.5, 0.9)]))
    # The error is the growth over a spacing of 0.02, and over some distance across the corner.
    assert h == pytest.approx([0.01, 0.01 + 0.2 * 0.5, 0.01 + 0.2 * math.hypot(0.5, 0.3965)], abs=2 * 0.2 * 0.02)
