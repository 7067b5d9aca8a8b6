"""Pictures of meshes on a sphere: the polygons that are drawn cover the picture once, and belong to their cells."""

import sys

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from scipy.spatial import SphericalVoronoi

import clvoro
from clvoro.errors import InputError
from clvoro.mesh.diagram import Diagram
from clvoro.plotting import coasts, pixels, plot_cells, plot_globe, plot_slice
from clvoro.plotting.globe import default_center
from clvoro.plotting.pictures import pictures_of
from clvoro.plotting.projections import Orthographic, Plate, outlines, unit_vectors
from tests.reference.netcdf_files import result_of

SPHERE = clvoro.Sphere(2.0)
GRID = [(lon, lat) for lat in (-70, -40, -10, 10, 40, 70) for lon in range(0, 360, 60)]
"""Cells that meet at the poles, and faces along the limits of longitude."""
ICOSAHEDRON = SPHERE.positions(
    [(0, 90), *((72 * k + 36 * (s < 0), s * np.degrees(np.arctan(0.5))) for s in (1, -1) for k in range(5)), (0, -90)]
)
"""Two cells around the poles, faces of 42 degrees."""


@pytest.fixture(scope="module")
def adapter(ctx):
    return clvoro.Adapter(ctx)


@pytest.fixture(scope="module", params=["random", "grid", "icosahedron", "turned"])
def diagram(request, adapter):
    rng = np.random.default_rng(5)
    points = {
        "random": rng.normal(size=(400, 3)),
        "grid": SPHERE.positions(GRID),
        "icosahedron": ICOSAHEDRON,
        "turned": ICOSAHEDRON @ np.linalg.qr(rng.normal(size=(3, 3)))[0],
    }
    return adapter.diagram(SPHERE, points[request.param])


@pytest.fixture(scope="module")
def mesh(adapter):
    def size(x):
        angle = np.arccos(np.clip(x @ SPHERE.positions([(-45, 40)])[0] / SPHERE.radius**2, -1, 1))
        return 0.12 + 0.1 * angle

    return adapter.run(SPHERE, size, effort="fast")


@pytest.fixture(scope="module")
def cube():
    """Six cells of 109 degrees across, corners included, as SciPy finds them."""
    points = np.concatenate([np.eye(3), -np.eye(3)])
    found = SphericalVoronoi(points)
    found.sort_vertices_of_regions()
    rings = []
    for point, ring in zip(points, found.regions, strict=True):
        a, b = found.vertices[ring[:2]] - point
        rings.append(np.array(ring if np.cross(a, b) @ point > 0 else ring[::-1]))
    begin, end = (found.vertices[np.concatenate(r)] for r in (rings, [np.roll(r, -1) for r in rings]))
    middle = (begin + end) / np.linalg.norm(begin + end, axis=1)[:, None]
    starts = 4 * np.arange(7)
    arrays = {
        "points": 2 * points,
        "vertices": 2 * found.vertices,
        "cell_vertex_starts": starts,
        "cell_vertices": np.concatenate(rings),
        "neighbor_starts": starts,
        "face_measures": 2 * np.arccos((begin * end).sum(axis=1)),
        "face_centroids": 2 * middle,
    }
    return Diagram(SPHERE, arrays)


def test_the_cell_opposite_to_the_viewer_is_seen_around_the_others(cube):
    # The viewer is opposite to a point near a corner of cell 5, which reaches beyond the limb on the other side.
    hidden = cube.cell_vertices[cube.cell_vertex_starts[5]]
    direction = cube.vertices[hidden] / 2 + 0.1 * cube.points[5] / 2
    lon, lat = SPHERE.lonlat(-direction[None])[0]
    view = Orthographic((lon, lat))
    polygons = view.polygons(cube, np.arange(6))
    assert polygons.cells[0] == 5
    assert area(drawn(polygons)[0]) == pytest.approx(np.pi, rel=1e-3)
    test_polygons_cover_the_picture_once(cube, view)


def drawn(polygons):
    return np.split(polygons.corners, polygons.starts[1:-1])


def area(ring):
    x, y = ring.T
    return 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1))


def winding(ring, places):
    """Return how many times `ring` runs around each of `places`."""
    to = ring[None] - places[:, None]
    angle = np.arctan2(to[..., 1], to[..., 0])
    turns = np.diff(angle, axis=1, append=angle[:, :1])
    turns -= 2 * np.pi * np.round(turns / (2 * np.pi))
    return np.round(turns.sum(axis=1) / (2 * np.pi)).astype(int)


VIEWS = [Orthographic((-45, 30)), Orthographic((0, 90)), Orthographic((180, 0)), Plate((0, 0)), Plate((-150, 0))]


@pytest.mark.sparse(6)
@pytest.mark.parametrize("view", VIEWS)
def test_polygons_cover_the_picture_once(diagram, view):
    polygons = view.polygons(diagram, np.arange(len(diagram)))
    places = view.lower + np.random.default_rng(8).random((700, 2)) * (view.upper - view.lower)
    # Chords of arcs of two degrees lie within 2e-4 of the limb.
    places = places[np.hypot(*places.T) < 0.999] if isinstance(view, Orthographic) else places
    inside, directions = view.directions(places)
    assert inside.all()
    cell = diagram.locate(SPHERE.radius * directions)
    counts, last = np.zeros(len(places), int), np.full(len(places), -1)
    rings = drawn(polygons)
    # The whole disk is drawn below the others.
    below = np.array([isinstance(view, Orthographic) and abs(area(r) - np.pi) < 0.01 for r in rings])
    assert below.sum() <= 1
    for ring, i, under in zip(rings, polygons.cells, below, strict=True):
        around = winding(ring, places)
        assert set(around) <= {0, 1}  # counter-clockwise
        counts += 0 if under else around
        last[around == 1] = i
    assert counts.max() == 1
    if not below.any():
        assert counts.min() == 1
    # Chords of arcs: up to 2e-4 of the globe, and near poles 4 degrees of longitude.
    assert np.mean(last != cell) < 0.005


def test_copies_at_the_limits_of_longitude(diagram):
    view = Plate((0, 0))
    polygons = view.polygons(diagram, np.arange(len(diagram)))
    low, high = ([f(r[:, 0]) for r in drawn(polygons)] for f in (np.min, np.max))
    low, high, cells = np.array(low), np.array(high), polygons.cells
    assert (low < 180).all()
    assert (high > -180).all()
    twice = np.bincount(cells, minlength=len(diagram)) == 2
    for i in np.flatnonzero(twice):
        at = np.sort(low[cells == i])
        assert at[1] - at[0] == pytest.approx(360)
    assert set(cells[(low < -180 - 1e-6) | (high > 180 + 1e-6)]) <= set(np.flatnonzero(twice))
    assert set(cells) == set(range(len(diagram)))


def test_poles_are_lines(adapter):
    points = [(0, 90), *[(lon, 20) for lon in range(0, 360, 45)], *[(lon, -50) for lon in range(0, 360, 90)]]
    diagram = adapter.diagram(SPHERE, SPHERE.positions(points))
    rings, cells = (lambda p: (drawn(p), p.cells))(Plate((0, 0)).polygons(diagram, np.arange(13)))
    around = [ring for ring, i in zip(rings, cells, strict=True) if i == 0]
    assert all(np.ptp(ring[:, 0]) == pytest.approx(360) for ring in around)
    assert all((ring[:, 1] == 90).sum() == 2 for ring in around)
    # The four southern cells meet in a corner at the pole, and share its line.
    assert sum((ring[:, 1] < -89.9).sum() >= 2 for ring in rings) >= 4


def test_outlines_follow_arcs(diagram):
    starts, points, faces = outlines(diagram, np.arange(len(diagram)))
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-14)
    begin = diagram.vertices[diagram.cell_vertices] / SPHERE.radius
    first = np.flatnonzero(np.diff(faces, prepend=-1))
    np.testing.assert_allclose(points[first], begin[faces[first]], atol=1e-12)
    middle = diagram.face_centroids[faces] / SPHERE.radius
    normal = np.cross(begin[faces], middle)
    length = np.linalg.norm(normal, axis=1)
    clear = length > 1e-6
    off = np.abs((points * normal).sum(axis=1))[clear] / length[clear]
    assert off.max() < 1e-8  # the plane of an arc of 1e-6 is known to about 1e-10 over its length
    rows = np.repeat(np.arange(len(diagram)), np.diff(starts))
    same = rows[1:] == rows[:-1]
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)[same]
    assert np.degrees(steps.max()) < 3  # 2 degrees, a little unequal


def test_the_back_is_hidden():
    view = Orthographic((20, 10))
    points = np.random.default_rng(1).normal(size=(500, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    flat = view.flat(points)
    behind = points @ view.towards < 0
    assert (np.hypot(*flat[behind].T) > 1).all()
    assert (np.hypot(*flat[~behind].T) <= 1 + 1e-12).all()
    _, again = view.directions(flat[~behind])
    np.testing.assert_allclose(again, points[~behind], atol=1e-7)
    middle = view.flat(unit_vectors(np.array([(20.0, 10.0)])))
    np.testing.assert_allclose(middle, 0, atol=1e-15)
    east, north = view.flat(unit_vectors(np.array([(21.0, 10.0), (20.0, 11.0)])))
    assert east[0] > 0
    assert north[1] > 0
    lines = view.lines(unit_vectors(np.column_stack([np.arange(361), np.zeros(361)])))
    assert all((np.hypot(*line.T) < 1 + 1e-12).all() for line in lines)


def collections(figure, kind):
    return [c for c in figure.axes[0].collections if type(c) is kind]


@pytest.mark.sparse(4)
@pytest.mark.parametrize("options", [{}, {"projection": "plate"}, {"across": 30.0}])
@pytest.mark.parametrize("color", ["error", "quality", "size", "sides", "own"])
def test_values_are_those_of_the_cells(mesh, color, options):
    own = np.arange(len(mesh.points))
    figure = mesh.plot(own if color == "own" else color, **options)
    (cells,) = collections(figure, PolyCollection)
    wanted = {
        "error": mesh.size_error,
        "quality": mesh.quality,
        "size": mesh.target_size,
        "sides": np.clip(np.diff(mesh.diagram.neighbor_starts), 4, 8),
        "own": own,
    }[color]
    values = np.asarray(cells.get_array())
    assert len(values) == len(cells.get_paths())
    assert set(values) <= set(wanted.astype(float))
    if options == {"projection": "plate"}:
        assert set(values) == set(wanted.astype(float))
    if options == {"across": 30.0}:
        assert len(values) < 0.2 * len(wanted)


def test_edges_are_drawn_once_and_only_if_legible(mesh):
    lines, _ = collections(mesh.plot(projection="plate", coasts=False), LineCollection)
    middles = np.array([segment.mean(axis=0) for segment in lines.get_segments()])
    _, counts = np.unique(middles.round(6), axis=0, return_counts=True)
    assert counts.max() == 1
    assert len(middles) >= len(mesh.diagram.faces)
    assert len(collections(mesh.plot(edges=False, coasts=False), LineCollection)) == 1
    widths = lines.get_linewidths()
    assert min(widths) > 0.06
    # On the globe, lines fade towards the limb.
    lines, _ = collections(mesh.plot(coasts=False), LineCollection)
    off = np.array([np.hypot(*segment.mean(axis=0)) for segment in lines.get_segments()])
    assert off.max() < 0.9999
    assert np.mean(np.array(lines.get_linewidths())[off > 0.97]) < 0.6 * np.median(lines.get_linewidths())


def test_pixels_show_the_cells_they_are_in(mesh, monkeypatch):
    monkeypatch.setattr(pixels, "MOST_POLYGONS", 10)
    monkeypatch.setattr(pixels, "PER_INCH", 10)
    own = np.arange(len(mesh.points))
    figure = mesh.plot(own, center=(-45, 40))
    (image,) = figure.axes[0].images
    assert not collections(figure, PolyCollection)
    shown = image.get_array()
    middle = np.array(shown.shape) // 2
    assert 40 < shown.shape[0] == shown.shape[1] < 80
    assert shown.mask[0, 0]
    around = mesh.diagram.locate(SPHERE.positions([(-45, 40)]))[0]
    near = np.linalg.norm(mesh.points - mesh.points[around], axis=1) < 0.4
    assert near[int(shown[tuple(middle)])]
    # From another side, the same pixels show other cells.
    (image,) = mesh.plot(own, center=(135, -40)).axes[0].images
    assert not near[int(image.get_array()[tuple(middle)])]


def test_center(mesh, adapter):
    lon, lat = default_center(mesh)
    assert abs(lon + 45) <= 10
    assert abs(lat - 40) <= 10
    even = adapter.run(clvoro.Sphere(1), 0.3)
    assert default_center(even) == (0, 25)


def test_longitudes_of_windows_go_on(mesh):
    figure = mesh.plot(projection="plate", window=((150, -30), (210, 30)))
    ax = figure.axes[0]
    assert ax.get_xlim() == (150, 210)
    (cells,) = collections(figure, PolyCollection)
    corners = np.concatenate([path.vertices for path in cells.get_paths()])
    assert corners[:, 0].min() < 150
    assert corners[:, 0].max() > 210
    names = [tick.get_text() for tick in ax.get_xticklabels()]
    assert names == ["150°E", "165°E", "180°", "165°W", "150°W"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"projection": "mercator"}, "projection is 'mercator', expected one of orthographic, plate"),
        ({"center": (0, 100)}, r"center is \(0, 100\), expected a longitude, and then a latitude"),
        ({"center": "here"}, "center is 'here'"),
        ({"across": 0}, "across is 0, expected a finite number > 0"),
        ({"across": 200}, "across is 200, expected an angle of at most 180 degrees"),
        ({"across": 10, "projection": "plate"}, "across is for projection='orthographic'"),
        ({"window": ((0, 0), (1, 1))}, "window is for projection='plate'"),
        ({"window": ((0, 0), (-1, 1)), "projection": "plate"}, "expected two corners"),
        ({"window": 3, "projection": "plate"}, "expected two corners"),
        ({"view": "slice"}, "view is 'slice', which is for meshes in 3D"),
        ({"cut": None}, "cut is for cutaway, and this picture is sphere"),
    ],
)
def test_bad_options(mesh, options, message):
    with pytest.raises(InputError, match=message):
        mesh.plot(**options)


def test_other_pictures_refuse(mesh, adapter):
    with pytest.raises(InputError, match=r"call result\.plot"):
        plot_cells(mesh)
    with pytest.raises(InputError, match="need cells in 3D"):
        plot_slice(mesh)
    plane = adapter.diagram(clvoro.Box((0, 0), (1, 1)), [(0.2, 0.3), (0.7, 0.6)])
    with pytest.raises(InputError, match="draws meshes on a sphere"):
        plot_globe(plane)
    with pytest.raises(InputError, match="projection is for sphere, and this picture is 2D"):
        plane.plot(projection="plate")


@pytest.mark.sparse(1)
@pytest.mark.parametrize("number", [1, 2])
def test_pictures_of_a_report(mesh, number):
    pictures = pictures_of({f"run {k}": mesh for k in range(number)})
    names = [name for name, _, _ in pictures]
    assert names[:3] == ["size", "plate", "cells"]
    assert ("diagrams_error" in names) == (number > 1)
    for _, _, draw in pictures:
        assert draw().axes


def test_coasts(mesh, monkeypatch):
    coasts._read.cache_clear()
    monkeypatch.setitem(sys.modules, "cartopy", None)
    assert coasts.coastlines(180.0) == []
    mesh.plot(coasts=True)
    coasts._read.cache_clear()
    asked = []
    line = np.column_stack([np.linspace(-80, 10, 50), np.linspace(10, 60, 50)])
    monkeypatch.setattr(coasts, "_read", lambda scale: asked.append(scale) or [line])
    count = [len(collections(mesh.plot(coasts=c), LineCollection)) for c in (None, True)]
    assert count == [2, 3]  # by default none on a sphere of this size
    mesh.plot(coasts=True, across=5.0)
    assert asked == ["110m", "10m"]
    assert [coasts.is_earth(r) for r in (6371229.0, 6371.0, 1.0, 1737400.0)] == [True, True, False, False]


@pytest.mark.sparse(2)
@pytest.mark.parametrize(
    ("radius", "color", "label", "number"),
    [
        (6371229.0, "size", "target size $h$ [km]", 1000.0),
        (6371.229, "size", "target size $h$ [km]", 1.0),
        (6371229.0, "volume", "area of the cell [km²]", 1e6),
        (1.0, "size", "target size $h$", 1.0),
    ],
)
def test_sizes_on_the_earth_are_in_kilometers(adapter, radius, color, label, number):
    diagram = adapter.diagram(clvoro.Sphere(radius), ICOSAHEDRON)
    mesh = result_of(diagram)
    figure = plot_globe(mesh, color)
    figure.canvas.draw()
    bar = next(ax for ax in figure.findobj(Axes) if ax.get_ylabel() == label)
    low = (mesh.target_size if color == "size" else diagram.volumes).min()
    shown = float(bar.get_yticklabels()[0].get_text().replace("−", "-"))
    assert shown == pytest.approx(low / number, rel=0.06)
