"""Pictures of meshes on a sphere: the polygons that are drawn cover the picture once, and belong to their cells."""

import sys

import numpy as np
import pytest
import shapely
from cartopy import crs
from cartopy.mpl.geoaxes import GeoAxes
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

import clvoro
from clvoro.errors import ClvoroError, InputError, MissingPicturesWarning
from clvoro.plotting import globe, map_projection, plot_globe, write_report
from clvoro.plotting.colors import kilometer_of
from clvoro.plotting.globe import default_center, outlines, project_cells
from clvoro.plotting.pictures import pictures_of
from tests.reference.netcdf_files import result_of

SPHERE = clvoro.Sphere(2.0)
GRID = [(lon, lat) for lat in (-70, -40, -10, 10, 40, 70) for lon in range(0, 360, 60)]
"""Cells that meet at the poles, and faces along the limits of longitude."""
ICOSAHEDRON = SPHERE.positions(
    [(0, 90), *((72 * k + 36 * (s < 0), s * np.degrees(np.arctan(0.5))) for s in (1, -1) for k in range(5)), (0, -90)]
)
"""Two cells around the poles, faces of 42 degrees."""


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


VIEWS = [("orthographic", (-45, 30)), ("orthographic", (0, 90)), ("plate", (0, 0)), ("plate", (-150, 0)), ("robinson",)]


@pytest.mark.sparse(6)
@pytest.mark.parametrize("view", VIEWS)
def test_polygons_cover_the_picture_once(diagram, view):
    projection = crs.Robinson() if view == ("robinson",) else map_projection(*view)
    source = projection.as_geodetic()
    cells, polygons = project_cells(diagram, projection, source)
    low, high = np.transpose([projection.x_limits, projection.y_limits])
    places = low + np.random.default_rng(8).random((900, 2)) * (high - low)
    lonlat = source.transform_points(projection, *places.T)[:, :2]
    seen = np.isfinite(lonlat).all(axis=1)
    seen &= np.hypot(*places.T) < 0.99 * high[1] if view[0] == "orthographic" else seen
    if view == ("robinson",):
        seen &= shapely.Polygon(projection.boundary).contains(shapely.points(places))
    places, cell = places[seen], diagram.locate(SPHERE.positions(lonlat[seen]))
    tree = shapely.STRtree([shapely.Polygon(p).buffer(0) for p in polygons])
    which, found = tree.query(shapely.points(places), "within")
    # Chords of arcs lie within 2e-4 of the globe from them, and near poles within 4 degrees of longitude.
    counts = np.bincount(which, minlength=len(places))
    assert np.mean(counts != 1) < 0.01
    assert np.mean(cells[found] != cell[which]) < 0.01


def test_outlines_follow_arcs(diagram):
    starts, points = outlines(diagram)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=1e-14)
    rows = np.repeat(np.arange(len(diagram)), np.diff(starts))
    steps = np.linalg.norm(points - np.roll(points, -1, axis=0), axis=1)[:-1][rows[1:] == rows[:-1]]
    assert np.degrees(steps.max()) < 3  # 2 degrees, a little unequal
    # A point of a face is as near to the generator of its cell as to the next one.
    generators = diagram.points / SPHERE.radius
    own = np.linalg.norm(points - generators[rows], axis=1)
    nearest, _ = cKDTree(generators).query(points)
    np.testing.assert_allclose(own, nearest, atol=1e-7)


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


def test_edges_are_as_thin_as_their_cells_look(mesh):
    (cells,) = collections(mesh.plot(coasts=False), PolyCollection)
    widths = cells.get_linewidths()
    middles = np.array([path.vertices[:-1].mean(axis=0) for path in cells.get_paths()])
    off = np.hypot(*middles.T) / middles.max()
    # On the globe, lines become thinner towards the limb.
    assert np.mean(np.array(widths)[off > 0.97]) < 0.6 * np.median(widths)
    (plain,) = collections(mesh.plot(coasts=False, edges=False), PolyCollection)
    plain.update_scalarmappable()
    np.testing.assert_array_equal(plain.get_edgecolor(), plain.get_facecolor())


def test_pixels_show_the_cells_they_are_in(mesh, monkeypatch):
    monkeypatch.setattr("clvoro.plotting.cells.MOST_POLYGONS", 10)
    monkeypatch.setattr("clvoro.plotting.cells.PER_INCH", 10)
    own = np.arange(len(mesh.points))
    figure = mesh.plot(own, center=(-45, 40), edges=False)
    (image,) = figure.axes[0].images
    assert not collections(figure, PolyCollection)[0].get_paths()
    shown = image.get_array()
    middle = np.array(shown.shape) // 2
    assert 40 < shown.shape[0] == shown.shape[1] < 80
    assert shown.mask[0, 0]
    around = mesh.diagram.locate(SPHERE.positions([(-45, 40)]))[0]
    near = np.linalg.norm(mesh.points - mesh.points[around], axis=1) < 0.4
    assert near[int(shown[tuple(middle)])]
    # From another side, the same pixels show other cells.
    (image,) = mesh.plot(own, center=(135, -40), edges=False).axes[0].images
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
    assert ax.get_xlim() == (-30, 30)  # around 180 degrees
    (cells,) = collections(figure, PolyCollection)
    corners = np.concatenate([path.vertices for path in cells.get_paths()])
    assert corners[:, 0].min() < -30
    assert corners[:, 0].max() > 30
    figure.draw_without_rendering()
    (lines,) = ax.gridliners if hasattr(ax, "gridliners") else [a for a in ax.artists if hasattr(a, "xlabel_artists")]
    names = {label.get_text() for label in lines.xlabel_artists if label.get_visible()}
    assert {"160°E", "180°", "160°W"} <= names
    lonlat = mesh.diagram.domain.lonlat(mesh.points)
    area = mesh.subset((np.abs(lonlat[:, 0]) > 150) & (np.abs(lonlat[:, 1]) < 20))
    for options, most in (({}, 0.65 * 6371229), ({"projection": "plate"}, 40)):  # which is all in the picture
        (low, high), side = (ax := area.plot(**options).axes[0]).get_xlim(), ax.get_ylim()
        assert -most < low < high < most
        assert -most < side[0] < side[1] < most


def test_other_projections_and_maps_of_the_caller(mesh):
    assert mesh.plot(projection=crs.Robinson()).axes[0].projection == crs.Robinson()
    ax = Figure().add_subplot(projection=map_projection("plate", (100, 0)))
    ax.set(xlim=(-20, 20), ylim=(-10, 30))
    assert mesh.plot("quality", ax=ax, key=False) is ax.figure
    assert ax.get_xlim() == (-20, 20)
    (cells,) = [c for c in ax.collections if isinstance(c, PolyCollection)]
    assert 0 < len(cells.get_paths()) < 0.2 * len(mesh.points)
    with pytest.raises(InputError, match="ax has no projection, expected a map of Cartopy"):
        mesh.plot(ax=Figure().add_subplot())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"projection": "mercator"}, "projection is 'mercator', expected one of orthographic, plate"),
        ({"center": (0, 100)}, r"center is \(0, 100\), expected a longitude, and then a latitude"),
        ({"center": "here"}, "center is 'here'"),
        ({"across": 0}, "across is 0, expected a finite number > 0"),
        ({"across": 200}, "across is 200, expected an angle of at most 180 degrees"),
        ({"window": ((0, 0), (-1, 1)), "projection": "plate"}, "expected two corners"),
        ({"window": 3, "projection": "plate"}, "expected two corners"),
        ({"view": "slice"}, "view is 'slice', expected one of globe for this mesh"),
    ],
)
def test_bad_options(mesh, options, message):
    with pytest.raises(InputError, match=message):
        mesh.plot(**options)


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
    asked = []
    monkeypatch.setattr(GeoAxes, "coastlines", lambda ax, scale, **_: asked.append(scale))
    monkeypatch.setattr(globe, "_has_coasts", lambda scale: False)
    mesh.plot(coasts=True)  # without data there are none, and none are downloaded
    monkeypatch.setattr(globe, "_has_coasts", lambda scale: scale != "50m")
    mesh.plot()  # by default none on a sphere of this size
    assert asked == []
    for across in (None, 20.0, 5.0):
        mesh.plot(coasts=True, across=across)
    assert asked == ["110m", "110m", "10m"]
    assert [kilometer_of(r) for r in (6371229.0, 6371.0, 1.0, 1737400.0)] == [1000, 1, None, None]


def test_data_of_coasts_are_found(tmp_path, monkeypatch):
    import cartopy

    monkeypatch.setitem(cartopy.config, "data_dir", tmp_path)
    assert not globe._has_coasts("110m")
    (tmp_path / "shapefiles/natural_earth/physical").mkdir(parents=True)
    (tmp_path / "shapefiles/natural_earth/physical/ne_110m_coastline.shp").touch()
    assert globe._has_coasts("110m")


def test_without_cartopy(mesh, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cartopy", None)
    with pytest.raises(ClvoroError, match=r"needs Cartopy.*pip install 'clvoro\[maps\]'"):
        mesh.plot()
    with pytest.warns(MissingPicturesWarning, match=r"no pictures of the mesh.*clvoro\[maps\]"):
        files = write_report(mesh, tmp_path, dpi=30)
    assert {f.stem for f in files} == {"report", "history"}


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
