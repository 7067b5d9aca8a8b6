"""Measures for finite volumes: known shapes, and one face after the other."""

import re

import numpy as np
import pytest

import clvoro
from clvoro.geometry.box import Box
from clvoro.mesh.diagram import Diagram
from clvoro.mesh.quality import measure_mesh
from tests.io.test_io import BOX, make_diagram
from tests.reference import solids

LOWER, UPPER = (-1.0, 0.0, 2.0), (1.0, 1.0, 3.5)


@pytest.fixture(scope="module")
def solid():
    points = np.random.default_rng(9182).uniform(LOWER, UPPER, (120, 3))
    return solids.solid_diagram(LOWER, UPPER, points)


@pytest.fixture(scope="module")
def plane():
    points = BOX.lower + np.random.default_rng(9183).random((60, 2)) * BOX.extent
    return make_diagram(points)


@pytest.fixture(params=["solid", "plane"])
def diagram(request):
    return request.getfixturevalue(request.param)


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.sqrt((a @ a) * (b @ b)), -1, 1)))


def test_cube_lattice():
    m = measure_mesh(solids.cubes(0.5))
    assert m.quality == pytest.approx(np.pi / 6)
    assert m.faces.tolist() == [6] * 24
    assert m.face_ratio == pytest.approx(1)
    assert m.volume_ratio == pytest.approx(1)
    # Zero but for rounding, of lengths about one.
    assert m.skewness == pytest.approx(0, abs=1e-14)
    assert m.centroid_angle == pytest.approx(0, abs=1e-12)


def test_two_cells_by_hand():
    """Two unit squares: the face from (1, 0) to (1, 1); the generators are a quarter above the floor."""
    diagram = Diagram(
        Box((0, 0), (2, 1)),
        {
            "points": np.array([[0.5, 0.25], [1.5, 0.25]]),
            "volumes": np.array([1.0, 1.0]),
            "centroids": np.array([[0.5, 0.5], [1.5, 0.5]]),
            "neighbor_starts": np.array([0, 4, 8], np.int32),
            "neighbors": np.array([-3, 1, -4, -1, -3, -2, -4, 0], np.int32),
            "face_measures": np.ones(8),
            "face_centroids": np.array(
                [[0.5, 0], [1, 0.5], [0.5, 1], [0, 0.5], [1.5, 0], [2, 0.5], [1.5, 1], [1, 0.5]]
            ),
        },
    )
    m = measure_mesh(diagram)
    # Upright faces have their middles a quarter above the generators, which are 1 apart, as from their images.
    assert m.skewness == pytest.approx([0, 0.25, 0, 0.25, 0, 0.25, 0, 0.25])
    assert m.quality == pytest.approx([1, 1])
    assert m.centroid_angle == pytest.approx(np.zeros(8))
    assert m.worst_of_cell("skewness") == pytest.approx([0.25, 0.25])
    assert m.summary()["mean_skewness"] == pytest.approx(0.125)


@pytest.mark.sparse(1)
def test_one_face_after_the_other(diagram):
    d, m = diagram, measure_mesh(diagram)
    box, dim = d.domain, d.domain.dim
    owner = d.half_faces.owner
    planes = [side[a] for a in range(dim) for side in (box.lower, box.upper)]
    for k, (i, j) in enumerate(zip(owner, d.neighbors, strict=True)):
        x = d.points[i]
        if j >= 0:
            y = d.points[j]
            angle = degrees_between(y - x, d.centroids[j] - d.centroids[i])
            ratio = max(d.volumes[i] / d.volumes[j], d.volumes[j] / d.volumes[i])
        else:
            y, angle, ratio = x.copy(), 0, 1
            y[(-1 - j) // 2] = 2 * planes[-1 - j] - x[(-1 - j) // 2]
        length = np.linalg.norm(y - x)
        skewness = np.linalg.norm(d.face_centroids[k] - (x + y) / 2) / length
        assert m.skewness[k] == pytest.approx(skewness)
        # The arc cosine of the reference loses half the digits near zero.
        assert m.centroid_angle[k] == pytest.approx(angle, abs=1e-5)
        assert m.volume_ratio[k] == pytest.approx(ratio)
        assert m.inner[k] == (j >= 0)
    for i in range(len(d)):
        areas = d.face_measures[d.neighbor_starts[i] : d.neighbor_starts[i + 1]]
        v, n, s = d.volumes[i], len(areas), areas.sum()
        quality = 4 * v * n * np.tan(np.pi / n) / s**2 if dim == 2 else 36 * np.pi * v**2 / s**3
        assert m.quality[i] == pytest.approx(quality)
        assert m.face_ratio[i] == pytest.approx(areas.min() / areas.max())
        assert m.faces[i] == n
        assert m.worst_of_cell("centroid_angle")[i] == m.centroid_angle[owner == i].max()


@pytest.mark.sparse(1)
def test_faces_are_at_right_angles_to_the_lines_of_the_generators(diagram):
    """Up to round-off, so `Measures` has no angle between face and generators."""
    d = diagram
    starts, corners = d.half_faces.corners
    owner = d.half_faces.owner
    checked = 0
    for k in np.flatnonzero(d.neighbors >= 0):
        loop = d.vertices[corners[starts[k] : starts[k + 1]]]
        size = d.face_measures[k] ** (1 / (d.domain.dim - 1))
        if size < 1e-3:
            continue  # the round-off of vertices turns the normals of the smallest faces
        line = d.points[d.neighbors[k]] - d.points[owner[k]]
        if d.domain.dim == 2:
            normal = np.array([loop[1, 1] - loop[0, 1], loop[0, 0] - loop[1, 0]])
        else:
            normal = solids.loop_area(loop)
        cosine = normal @ line / np.sqrt((normal @ normal) * (line @ line))
        # Vertices of Qhull are accurate to about 1e-12; in 2D the helper joins those nearer than 1e-9.
        assert cosine == pytest.approx(1, abs=1e-9)
        checked += 1
    assert checked > 100


@pytest.mark.parametrize(("y", "skewness"), [(0.5, 0), (0.4, np.inf)])
def test_generator_on_a_wall(y, skewness):
    d = solids.solid_diagram((0, 0, 0), (1.5, 1, 1), np.array([[1e-3, y, 0.5], [1.0, 0.4, 0.5]]))
    points = np.array([[0.0, y, 0.5], [1.0, 0.4, 0.5]])
    middles = np.where(d.neighbors[:, None] == -1, [0.0, 0.5, 0.5], d.face_centroids)
    m = measure_mesh(Diagram(d.domain, {**d._arrays, "points": points, "face_centroids": middles}))
    assert m.skewness[d.neighbors == -1] == skewness
    assert np.isfinite(m.skewness[d.neighbors != -1]).all()
    assert np.isfinite(m.centroid_angle).all()


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_cells_of_many_sides(ctx, real):
    """Regular polygons of up to 19 sides and their neighbors: the device finds the same quality as the host."""
    adapter, box = clvoro.Adapter(ctx, real), Box((0, 0), (1, 1))
    for n in (3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 19):
        turn = 2 * np.pi * (np.arange(n) + 0.2) / n
        ring = 0.2 * np.column_stack([np.cos(turn), np.sin(turn)])
        points = 0.5 + np.concatenate([np.zeros((1, 2)), ring])
        result = adapter.run(box, 1.0, points=points, method="lloyd", max_steps=0)
        # Corners, 0.1 from the generator, have a round-off of some ulps of positions.
        allowed = 64 * float(np.finfo(real).eps)
        assert np.diff(result.diagram.neighbor_starts)[0] == n
        assert result.quality[0] == pytest.approx(1, abs=allowed)
        assert result.quality == pytest.approx(measure_mesh(result.diagram).quality, abs=allowed)


def test_result_measures_itself_once(solid):
    result = solids.solid_result(solid)
    assert result.measures is result.measures
    np.testing.assert_allclose(result.measures.quality, result.quality, rtol=1e-12)
    s = result.measures.summary()
    assert s["max_volume_ratio"] >= s["mean_volume_ratio"] > 1
    assert 0 <= s["min_face_ratio"] <= s["mean_face_ratio"] <= 1


def test_line_for_people(solid):
    result = solids.solid_result(solid)
    s = result.measures.summary()
    numbers = [float(x) for x in re.findall(r"[\d.]+", str(result.measures))]
    names = ("mean_faces", "mean_skewness", "max_skewness", "mean_centroid_angle", "max_centroid_angle")
    assert numbers == pytest.approx([s[name] for name in names], abs=0.05)
    assert numbers[0] == pytest.approx(len(solid.neighbors) / len(solid), abs=0.005)
