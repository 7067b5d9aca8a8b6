"""A correct mesh on a sphere passes the check. Each kind of damage is found and named."""

import numpy as np
import pytest
from scipy.spatial import SphericalVoronoi

import clvoro
from clvoro.mesh.check.rebuilt import SphereCells, find_precision
from clvoro.mesh.diagram import Diagram
from tests.mesh.test_check import add, names_of, of_diagram, put, spoilt, swap

EARTH = clvoro.Sphere()


def scattered(n, seed=11):
    points = np.random.default_rng(seed).standard_normal((n, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


def clustered(n):
    """Half of the points in a region a hundredth of a radian wide."""
    points = scattered(n)
    points[: n // 2] = points[0] + 1e-2 * points[: n // 2]
    return points


def icosahedron():
    golden = (1 + 5**0.5) / 2
    flat = [(a, b * golden, 0) for a in (1, -1) for b in (1, -1)]
    return np.concatenate([np.roll(flat, k, axis=1) for k in range(3)])


POINTS = {
    "icosahedron": icosahedron(),
    "few": scattered(60, seed=4),
    "many": scattered(1000),
    "cluster": clustered(1000),
}


@pytest.mark.sparse(6)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("radius", [1.0, EARTH.radius, 1e-3])
@pytest.mark.parametrize("name", list(POINTS))
def test_right_diagrams_pass(ctx, dtype, radius, name):
    report = clvoro.Adapter(ctx, dtype).diagram(clvoro.Sphere(radius), POINTS[name]).check()
    assert report, report
    assert report.cells == len(POINTS[name])
    assert report.precision == dtype
    assert {"on the sphere", "Euler's formula", "volumes of the generators"} <= set(report.checked)


@pytest.fixture(scope="module", params=["float64", "float32"])
def result(ctx, request):
    points = scattered(400)
    adapter = clvoro.Adapter(ctx, request.param)
    return adapter.run(EARTH, 1.1e6, points=points, n_cells=400, method="lloyd", max_steps=3)


@pytest.mark.sparse(1)
def test_right_result_passes(result):
    report = result.check()
    assert report, report
    assert {"size_error", "quality", "history"} <= set(report.checked)
    assert report.precision == result.settings["dtype"]


def test_areas_are_those_of_scipy(ctx):
    points = scattered(500)
    d = clvoro.Adapter(ctx, "float64").diagram(clvoro.Sphere(2.0), points)
    cells = SphereCells(d)
    other = SphericalVoronoi(points)
    other.sort_vertices_of_regions()
    # SciPy's angles have the round-off of 1 in cells of 0.02.
    assert cells.volumes == pytest.approx(4 * other.calculate_areas(), rel=1e-11)
    assert cells.from_generators(d).volumes == pytest.approx(cells.volumes, rel=1e-11)
    assert len(other.vertices) == len(d.vertices)


def test_arcs_and_centroids_are_those_of_quadrature(ctx):
    d = clvoro.Adapter(ctx, "float64").diagram(clvoro.Sphere(1.0), POINTS["few"])
    cells = SphereCells(d)
    for i in range(0, 60, 7):
        corners = d.cell(i).vertices
        following = np.roll(corners, -1, axis=0)
        rows = slice(d.neighbor_starts[i], d.neighbor_starts[i + 1])
        arcs = np.arccos((corners * following).sum(axis=1))
        # arccos loses digits at small arcs.
        assert cells.measures[rows] == pytest.approx(arcs, rel=1e-12, abs=1e-8)
        total = sum(integral_of_position(d.points[i], a, b) for a, b in zip(corners, following, strict=True))
        centroid = total / np.linalg.norm(total)
        # Midpoint rule on 4^6 triangles per corner.
        assert d.points[i] + cells.centroids[i] == pytest.approx(centroid, abs=1e-4)


def integral_of_position(a, b, c, depth=6):
    """Sum of flat area times middle over small triangles of the spherical one."""
    corners = np.array([[a, b, c]])
    for _ in range(depth):
        a, b, c = corners.transpose(1, 0, 2)
        ab, bc, ca = (x / np.linalg.norm(x, axis=1)[:, None] for x in (a + b, b + c, c + a))
        corners = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    a, b, c = corners.transpose(1, 0, 2)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    middles = a + b + c
    middles /= np.linalg.norm(middles, axis=1)[:, None]
    return (areas[:, None] * middles).sum(axis=0)


def test_small_cells_keep_their_digits(ctx):
    """Cells of 1e-5 radians: two ways to place their corners give the same measures, up to round-off."""
    points = scattered(400)
    points[:200] = points[0] + 1e-4 * points[:200]
    d = clvoro.Adapter(ctx, "float64").diagram(clvoro.Sphere(1.0), points)
    cells = SphereCells(d)
    small = np.flatnonzero(cells.reach < 1e-4)
    assert small.size > 100
    own = cells.from_generators(d)
    # Positions have the round-off 1e-16, and a cell that is far from round may be 100 times as wide as high.
    assert own.volumes[small] == pytest.approx(cells.volumes[small], rel=1e-8)
    assert d.volumes[small] == pytest.approx(own.volumes[small], rel=1e-9)
    off = np.linalg.norm(d.centroids - d.points - cells.centroids, axis=1)
    assert off[small].max() < 1e-13


def slide(shift):
    """Move vertex 7 along the sphere by `shift` radii."""

    def change(x):
        radius = np.linalg.norm(x[7])
        x[7] += shift * radius * np.cross(x[7], (0.6, 0, 0.8)) / radius
        x[7] *= radius / np.linalg.norm(x[7])

    return change


def scale(index, factor):
    def change(array):
        array[index] *= factor

    return change


def reverse(array):
    array[:] = array[::-1].copy()


DAMAGE = {
    "generator off the sphere": ({"points": scale(5, 1.001)}, {"on the sphere"}),
    "vertex off the sphere": ({"vertices": scale(7, 1.001)}, {"on the sphere"}),
    "centroid off the sphere": ({"centroids": scale(5, 0.999)}, {"on the sphere"}),
    "face centroid off the sphere": ({"face_centroids": scale(5, 0.999)}, {"on the sphere"}),
    "vertex moved": ({"vertices": slide(0.02)}, {"nearest generators", "face measures"}),
    "wrong area": ({"volumes": scale(5, 1.002)}, {"volumes of the generators"}),
    "very wrong area": ({"volumes": scale(5, 1.3)}, {"volumes", "volumes sum"}),
    "negative area": ({"volumes": scale(5, -1)}, {"volumes", "volumes sum"}),
    "wrong arc": ({"face_measures": lambda x: scale(int(np.argmax(x)), 1.002)(x)}, {"face measures of the generators"}),
    "very wrong arc": (
        {"face_measures": lambda x: scale(int(np.argmax(x)), 1.3)(x)},
        {"face measures", "faces the same from both sides"},
    ),
    "wrong centroids": ({"centroids": swap(4, 5)}, {"centroids"}),
    "wrong face centroids": ({"face_centroids": swap(0, 2)}, {"face centroids"}),
    "swapped neighbors": ({"neighbors": swap(0, 2)}, {"vertices once", "faces outward"}),
    "one-sided neighbor": ({"neighbors": lambda x: put(0, (x[0] + 200) % 400)(x)}, {"graph symmetric"}),
    "wall": ({"neighbors": put(3, -1)}, {"neighbors exist"}),
    "shift": ({"shifts": put((3, 0), 1)}, {"shifts"}),
    "corner of another vertex": ({"cell_vertices": put(0, 700)}, {"vertices once", "nearest generators"}),
    "vertex without cell": ({"vertices": lambda x: np.concatenate([x, x[:1]])}, {"vertices used", "Euler's formula"}),
    "not a number": ({"vertices": add((3, 1), np.nan)}, {"finite"}),
    "generators in other rows": ({"points": swap(4, 5)}, {"nearest generators"}),
}


@pytest.mark.sparse(14)
@pytest.mark.parametrize("name", list(DAMAGE))
def test_damage_is_found(result, name):
    changes, expected = DAMAGE[name]
    report = of_diagram(result, **changes).diagram.check()
    assert expected <= names_of(report), report
    with pytest.raises(clvoro.ClvoroError):
        report.demand()


def test_clockwise_cells_are_found(result):
    d = result.diagram
    report = spoilt(
        result,
        cell_vertices=reverse,
        cell_vertex_starts=lambda s: s[-1] - s[::-1],
        neighbor_starts=lambda s: s[-1] - s[::-1],
        neighbors=lambda j: len(d) - 1 - j[::-1],
        points=reverse,
        volumes=reverse,
        centroids=reverse,
        face_measures=reverse,
        face_centroids=reverse,
    ).check()
    assert {"orientation", "volumes"} <= names_of(report)


def test_moved_generators_are_found(result):
    """Cells of slightly different generators. The shift is 1/20 of a cell."""
    noise = 0.005 * np.random.default_rng(3).standard_normal(result.points.shape)
    moved = EARTH.wrap(result.points + EARTH.radius * noise)
    report = spoilt(result, points=lambda _: moved).check()
    assert {"nearest generators", "volumes of the generators"} <= names_of(report)


def test_quality_is_the_planes_formula_with_area_and_arcs(result):
    d = result.diagram
    n = np.diff(d.neighbor_starts)
    perimeter = np.add.reduceat(d.face_measures, d.neighbor_starts[:-1])
    expected = 4 * n * np.tan(np.pi / n) * d.volumes / perimeter**2
    # The device computes it in its own precision.
    tolerance = 64 * float(np.finfo(result.settings["dtype"]).eps)
    assert result.quality == pytest.approx(expected, rel=tolerance)
    assert d.measures.quality == pytest.approx(expected)


@pytest.mark.parametrize("radius", [1.0, 0.3, EARTH.radius])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_precision_is_known_from_the_numbers(ctx, radius, dtype):
    d = clvoro.Adapter(ctx, dtype).diagram(clvoro.Sphere(radius), POINTS["few"])
    assert find_precision(d).name == dtype


def test_diagram_from_corners_alone_passes(result):
    """As from a file: arcs and centroids follow from the corners, and have their round-off."""
    d = result.diagram
    cells = SphereCells(d)
    arrays = {name: getattr(d, name) for name in Diagram._NAMES if name in d._arrays}
    arrays |= {
        "face_measures": cells.measures,
        "face_centroids": cells.middles + d.points[cells.owner],
        "centroids": cells.centroids + d.points,
    }
    report = Diagram(d.domain, arrays).check()
    assert report, report
    assert "volumes of the generators" not in report.checked
