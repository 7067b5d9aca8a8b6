"""Regions of one size: what is inside, and how sizes grow outside, on the host and on the device."""

import numpy as np
import pytest
import shapely

import clvoro
from clvoro import curves, sizing
from clvoro.errors import InputTypeError
from clvoro.geometry.surface import box_surface
from clvoro.sizing.field import on_domain

RING = clvoro.Polygon([(1, 0.4), (3, 0.4), (2, 0.9)], [[(1.8, 0.5), (2.2, 0.5), (2, 0.6)]])
PLANE = clvoro.Box((0, 0), (4, 1))
SPACE = clvoro.Box((0, 0, 0), (2, 2, 2))
CASES = {
    "box": (clvoro.Box((1, 0.3), (3, 0.7)), PLANE, shapely.box(1, 0.3, 3, 0.7)),
    "ring": (RING, PLANE, RING.geometry),
    "several": ([RING, shapely.box(2.5, 0, 3.5, 0.6)], PLANE, RING.geometry | shapely.box(2.5, 0, 3.5, 0.6)),
    "geojson": (shapely.to_geojson(RING.geometry), PLANE, RING.geometry),
    "curve": (curves.ellipse((2, 0.5), (1, 0.3)), PLANE, shapely.Polygon(curves.ellipse((2, 0.5), (1, 0.3)).vertices)),
}


def on_device(field, domain, points, real):
    adapter = clvoro.Adapter(dtype=real)
    return adapter.run(domain, field, points=points, method="lloyd", max_steps=0).target_size


@pytest.mark.parametrize("name", CASES)
def test_regions_in_the_plane(name):
    shapes, domain, area = CASES[name]
    field = sizing.Region(shapes, 0.02, slope=0.3, h_max=0.2)
    points = np.random.default_rng(3).random((600, 2)) * domain.extent
    expected = np.minimum(0.02 + 0.3 * shapely.distance(shapely.points(points), area), 0.2)
    assert field(points) == pytest.approx(expected, rel=1e-3 if name == "curve" else 1e-12)
    assert on_device(field, domain, points, "float64") == pytest.approx(field(points), rel=1e-12)
    single = np.abs(on_device(field, domain, points, "float32") / field(points) - 1)
    assert np.sort(single)[-3] < 1e-4  # a point within round-off of an edge may change sides


def test_regions_in_space():
    ball, box = sizing.Ball((1, 1, 1), 0.4), clvoro.Box((0.9, 0.9, 0.9), (1.8, 1.6, 1.7))
    lower, upper = np.array(box.lower), np.array(box.upper)
    points = np.random.default_rng(3).random((500, 3)) * 2
    to_ball = np.linalg.norm(points - 1, axis=1) - 0.4
    to_box = np.linalg.norm(np.maximum(np.maximum(lower - points, points - upper), 0), axis=1)
    expected = 0.05 + 0.2 * np.maximum(np.minimum(to_ball, to_box), 0)
    for other in (box, box_surface(lower, upper)):
        field = sizing.Region([ball, other], 0.05, slope=0.2)
        assert field(points) == pytest.approx(expected, rel=1e-12)
        assert on_device(field, SPACE, points, "float64") == pytest.approx(expected, rel=1e-12)


def test_the_region_of_a_solid_is_its_inside():
    signs = np.array(list(np.ndindex(2, 2, 2))) * 2 - 1
    octahedron = clvoro.Solid.polyhedron(signs, signs.sum(axis=1) + 0.8)  # around (1, 1, 1)
    points = np.random.default_rng(3).random((500, 3)) * 2
    inside = np.abs(points - 1).sum(axis=1) < 0.8
    field = sizing.Region(octahedron, 0.05, slope=0.2)
    assert 30 < inside.sum() < 100
    assert ((field(points) == 0.05) == inside).all()
    assert on_device(field, SPACE, points, "float64") == pytest.approx(field(points), rel=1e-12)


def test_regions_on_the_sphere():
    earth = clvoro.Sphere()
    points = earth.icosahedral_points(4)
    lon, lat = earth.lonlat(points).T
    inside = ((lat > -40) & (lat < 50) & ((lon > 160) | (lon < -160))) | (lat > 75)
    field = sizing.Region([shapely.box(160, -40, 200, 50), sizing.Circle((0, 90), 15)], 2e5, 1.2, 8e5)
    h = on_domain(earth, field)(points)
    assert ((h == 2e5) == inside).all()
    assert on_device(field, earth, points, "float64") == pytest.approx(h, rel=1e-9)
    away = np.radians(lat - 50) * earth.radius  # from the northern edge, where it is the nearest
    beside = (np.abs(lon - 180) < 5) & (lat > 52) & (lat < 58)
    assert h[beside] == pytest.approx(np.minimum(2e5 + np.log(1.2) * away[beside], 8e5), rel=0.02)


def test_cells_have_one_size_in_the_region():
    mesh = clvoro.adapt(PLANE, sizing.Region(clvoro.Box((1, 0.3), (3, 0.7)), 0.05, 1.2, 0.2), "fast")
    inner = (np.abs(mesh.points - (2, 0.5)) < (0.95, 0.15)).all(axis=1)
    assert np.sqrt(mesh.diagram.volumes[inner]) == pytest.approx(0.05, rel=0.05)
    assert 0.8 / 0.05**2 < len(mesh) < 2 / 0.05**2


def test_a_small_region_is_not_missed():
    field = sizing.Region(clvoro.Box((3.001, 0.5), (3.003, 0.502)), 0.001, slope=1e6, h_max=0.5)
    assert field(field.landmarks(PLANE)).min() == 0.001


@pytest.mark.parametrize(
    ("shape", "error", "says"),
    [
        (sizing.Segment((0, 0), (1, 1)), InputTypeError, "has no inside"),
        (sizing.Circle((0, 0), 0), InputTypeError, "has no inside"),
        (curves.arc((0, 0), 1, 0, 90), InputTypeError, "has no inside"),
    ],
)
def test_shapes_without_an_inside_are_refused(shape, error, says):
    with pytest.raises(error, match=says):
        sizing.Region(shape, 0.1, 1.2)
