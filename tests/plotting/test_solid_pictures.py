"""Pictures of 3D meshes show the cells that a plane cuts, or that a viewer sees."""

import dataclasses
import sys

import numpy as np
import pytest
import shapely
from matplotlib.collections import PolyCollection
from matplotlib.path import Path
from scipy.spatial import cKDTree

from clvoro import Adapter, Box, Solid, voronoi
from clvoro.errors import ClvoroError, InputError, MissingPicturesWarning
from clvoro.plotting import (
    page,
    pictures,
    plot_cells,
    plot_cutaway,
    plot_distributions,
    plot_size,
    plot_slice,
    plot_slices,
    write_report,
)
from clvoro.plotting.solids import VIEW, around_body, cut_cells, focus, kept_cells, plane_axes, view_axes, visible_faces
from tests.reference import solids

LOWER, UPPER = (-1.0, 0.0, 2.0), (1.0, 1.0, 3.5)


@pytest.fixture(scope="module")
def result():
    points = np.random.default_rng(77123).uniform(LOWER, UPPER, (150, 3))
    return solids.solid_result(solids.solid_diagram(LOWER, UPPER, points))


def has_color_bar(figure):
    (ax,) = figure.axes
    return len(ax.child_axes) == 1  # beside the picture, as high


def flattened(polygons, normal):
    """Polygons of a plane in the picture's coordinates, by shapely."""
    axes = np.stack(plane_axes(np.array(normal, float)), axis=1)
    return [shapely.Polygon(polygon @ axes) for polygon in polygons]


@pytest.mark.sparse(2)
@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, -1, 0), (0.3, -1, 0.7)])
def test_section_is_that_of_the_cells(result, normal):
    """A point of the plane is in the polygon of the cell whose generator is nearest."""
    d = result.diagram
    normal, point = np.array(normal, float) / np.linalg.norm(normal), np.array([0.1, 0.45, 2.9])
    cells, polygons = cut_cells(d, normal, point)
    right, up = plane_axes(normal)
    rng = np.random.default_rng(5)
    places = point + rng.uniform(-1.5, 1.5, (900, 1)) * right + rng.uniform(-1.5, 1.5, (900, 1)) * up
    places = places[d.domain.contains(places)]
    assert len(places) > 100
    nearest = cKDTree(d.points).query(places)[1]
    flat = flattened(polygons, normal)
    tree = shapely.STRtree(flat)
    which, found = tree.query(shapely.points(places @ np.stack([right, up], axis=1)), "within")
    assert np.array_equal(which, np.arange(len(places)))
    assert np.array_equal(cells[found], nearest)


def test_section_covers_the_plane_once_even_along_faces():
    d = solids.cubes()
    for height in (0.5, 1.0, 1.0 + 1e-15, 2.0):
        _, polygons = cut_cells(d, np.array([0, 0, 1.0]), np.array([0, 0, height]))
        flat = flattened(polygons, (0, 0, 1))
        assert [p.area for p in flat] == pytest.approx(12 * [1])
        assert shapely.union_all(flat).area == pytest.approx(12)
    assert len(cut_cells(d, np.array([0, 0, 1.0]), np.array([0, 0, 2.5]))[0]) == 0


@pytest.mark.sparse(2)
@pytest.mark.parametrize("color", ["error", "quality", "size", "sides", "skewness"])
def test_slice_is_drawn_with_its_values(result, color):
    figure = plot_slice(result, color, normal="y", through=(0, 0.3, 3))
    ax = figure.axes[0]
    (cells,) = (c for c in ax.collections if isinstance(c, PolyCollection))
    rows, polygons = cut_cells(result.diagram, np.array([0, 1.0, 0]), np.array([0, 0.3, 3]))
    values = {
        "error": result.size_error,
        "quality": result.quality,
        "size": result.target_size,
        "sides": np.clip(np.diff(result.diagram.neighbor_starts), 12, 16),
        "skewness": result.measures.worst_of_cell("skewness"),
    }[color]
    np.testing.assert_array_equal(cells.get_array(), values[rows])
    for path, polygon in zip(cells.get_paths(), polygons, strict=True):
        np.testing.assert_array_equal(path.vertices[:-1], polygon[:, [0, 2]])
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_title()) == ("x", "z", "$y = 0.3$")
    assert ax.get_xlim() == pytest.approx((-1, 1))
    assert ax.get_ylim() == pytest.approx((2, 3.5))
    assert ax.get_aspect() == 1


@pytest.mark.sparse(1)
@pytest.mark.parametrize("cut", ["octant", (0.0, -1.0, 0.0), None])
@pytest.mark.parametrize("periodic", [False, True])
def test_what_is_drawn_last_is_what_the_viewer_sees(ctx, result, cut, periodic):
    """The first kept cell, or image of one, on a line of sight is that of the last polygon drawn there."""
    d = result.diagram
    if periodic:
        d = Adapter(ctx).diagram(Box(LOWER, UPPER, periodic=(True, True, False)), d.points)
    right, up, towards = view_axes(VIEW)
    screen = np.stack([right, up], axis=1)
    through, what = np.array([0.1, 0.5, 2.7]), cut if cut is None or isinstance(cut, str) else np.array(cut)
    cells, polygons, normals = visible_faces(d, what, through, towards)
    assert (normals @ towards > 0).all()
    for polygon, normal in zip(polygons, normals, strict=True):
        assert np.abs((polygon - polygon[0]) @ normal).max() < 1e-7
    steps = np.array([(i, j, 0) for i in (0, -1, 1) for j in (0, -1, 1)]) if periodic else np.zeros((1, 3))
    images = (d.points + (steps * d.domain.extent)[:, None]).reshape(-1, 3)
    rows = np.tile(np.arange(len(d)), len(steps))
    kept = kept_cells(what, through, towards, rows, images)
    tree = cKDTree(images)
    paths = [Path(polygon @ screen) for polygon in polygons]
    rng, along = np.random.default_rng(31), np.linspace(4, -4, 8001)
    seen = wrong = 0
    for anchor in rng.uniform(LOWER, UPPER, (40, 3)):
        ray = anchor + along[:, None] * towards
        nearest = tree.query(ray[((ray >= LOWER) & (ray <= UPPER)).all(axis=1)])[1]
        first = rows[nearest[kept[nearest]][:1]]
        drawn = [cell for cell, path in zip(cells, paths, strict=True) if path.contains_point(anchor @ screen)]
        seen += len(first)
        wrong += len(first) != bool(drawn) or (len(first) and first[0] != drawn[-1])
    assert seen > 25
    # A ray may pass a corner of a cell between two of its steps.
    assert wrong <= 1


def test_octant_that_is_cut_out_faces_the_viewer(result):
    towards = view_axes(VIEW)[2]
    kept = kept_cells("octant", np.array([0.0, 0.5, 2.75]), towards, np.arange(150), result.points)
    gone = result.points[~kept]
    assert len(gone) > 5
    assert ((gone - [0.0, 0.5, 2.75]) * [1, -1, 1] > 0).all()


def test_cutaway_takes_marks_and_directions(result):
    figure = plot_cutaway(result, "quality", cut=result.points[:, 0] < 0, title="half")
    assert figure.axes[0].get_title() == "half"
    (faces,) = (c for c in figure.axes[0].collections if isinstance(c, PolyCollection))
    right = view_axes(VIEW)[0]
    widest = max(path.vertices[:, 0].max() for path in faces.get_paths())
    assert widest < np.array([1.0, 1.0, 0.0]) @ right
    for cut in ("x", "y", "z", (1, 1, 0), None):
        assert has_color_bar(plot_cutaway(result, cut=cut, angles=(30, 40)))


@pytest.mark.parametrize(
    ("cut", "message"), [("w", "cut is 'w'"), (np.ones(3, bool), r"one mark per cell \(150,\)"), ((0, 0, 0), "cut is")]
)
def test_bad_cuts_are_named(result, cut, message):
    with pytest.raises(InputError, match=message):
        plot_cutaway(result, cut=cut)


def test_bad_planes_are_named(result):
    with pytest.raises(InputError, match="normal is 'w'"):
        plot_slice(result, normal="w")
    with pytest.raises(InputError, match="does not intersect"):
        plot_slice(result, through=(0, 0, 7))
    with pytest.raises(InputError, match="3 coordinates"):
        plot_slice(result, through=(0, 0))
    with pytest.raises(InputError, match=r"'hue'.*error, quality, size, sides, skewness"):
        plot_slices(result, "hue")


def test_result_plots_itself(result):
    assert len(result.plot().axes) == 5  # three planes, the cut-away view, the color bar
    assert len(result.plot("sides").legends) == 1
    assert has_color_bar(result.plot("quality", view="slice", normal="x"))
    assert has_color_bar(result.plot("size", view="cutaway", cut="y"))
    with pytest.raises(InputError, match="view is 'front'"):
        result.plot(view="front")
    with pytest.raises(InputError, match="ParaView"):
        plot_cells(result)
    with pytest.raises(InputError, match="is in 3D"):
        plot_size(lambda x: x[:, 0], result.diagram.domain)


@pytest.mark.sparse(1)
@pytest.mark.parametrize(("upper", "panels"), [((6, 1, 1.5), 2), ((1, 1, 5), 2), ((1, 4, 1), 2)])
def test_long_domains_are_shown_lengthwise(upper, panels):
    points = np.random.default_rng(2029).uniform((0, 0, 0), upper, (40, 3))
    long = solids.solid_result(solids.solid_diagram((0, 0, 0), upper, points))
    figure = plot_slices(long, "size")
    names = [ax.get_xlabel() + ax.get_ylabel() for ax in figure.axes[:panels]]
    assert len(figure.axes) == panels + 1
    assert all("xyz"[int(np.argmax(upper))] in name for name in names)


def test_focus_is_amid_the_smallest_cells_and_inside(result):
    sizes = np.linalg.norm(result.points - [0.4, 0.6, 2.6], axis=1) + 0.3
    near = dataclasses.replace(result, target_size=sizes)
    assert np.linalg.norm(focus(near) - [0.4, 0.6, 2.6]) < 0.2
    # Half of the smallest cell is 0.21 large: planes lie at multiples of a fifth.
    assert 0.4 < sizes.min() < 1
    assert focus(near) * 5 == pytest.approx(np.round(focus(near) * 5), abs=1e-9)
    corner = dataclasses.replace(result, target_size=np.linalg.norm(result.points - LOWER, axis=1) ** 3)
    assert focus(corner) == pytest.approx(np.array(LOWER) + 0.25 * Box(LOWER, UPPER).extent)
    alike = dataclasses.replace(result, target_size=np.ones(150))
    assert focus(alike) == pytest.approx(np.add(LOWER, UPPER) / 2)


def test_slices_meet_cells_of_pieces_on_both_sides_of_the_center():
    pieces = Solid.box((0, 0, 0), (1, 1, 1)) + Solid.box((2, 2, 2), (3, 3, 3))
    mesh = voronoi(pieces, np.random.default_rng(1).random((20, 3)) + np.repeat([[0], [2]], 10, axis=0))
    assert all(ax.collections for ax in plot_slices(mesh, "volume").axes[:3])


def test_distributions_are_complete(result):
    figure = plot_distributions(result)
    faces = figure.axes[2]
    heights = {round(b.get_x() + 0.5): b.get_height() for b in faces.patches}
    counts = np.diff(result.diagram.neighbor_starts)
    assert heights == pytest.approx({k: 100 * np.mean(counts == k) for k in heights})
    assert sum(heights.values()) == pytest.approx(100)


@pytest.mark.slow
def test_report_of_a_solid(result, tmp_path, monkeypatch):
    """With the figures of all pictures; `test_few_cells` renders them."""
    monkeypatch.setattr(page, "render", lambda *_: b"")
    first = dataclasses.replace(result, size_error=2 * result.size_error)
    files = write_report({"lloyd": first, "coupled": result}, tmp_path, initial=first)
    names = {f.stem for f in files}
    assert names == {
        "report",
        "size",
        "cells",
        "cutaway",
        "quality",
        "diagrams_error",
        "diagrams_quality",
        "history",
        "distributions",
        "sides",
    }
    text = files[0].read_text(encoding="utf-8")
    assert "Measures for finite volumes" in text
    assert f"{result.measures.summary()['mean_skewness']:.4g}" in text


def test_closer_look_at_a_large_mesh(result, monkeypatch):
    monkeypatch.setitem(pictures.MANY_CELLS, "slices", 100)
    sharp = dataclasses.replace(result, target_size=np.where(np.arange(150) == 7, 0.005, 0.2))
    (draw,) = (d for name, _, d in pictures.pictures_of({"coupled": sharp}) if name == "closer")
    wide, close = draw().axes[:2]
    assert np.ptp(wide.get_xlim()) == pytest.approx(160 * 0.005)
    assert np.ptp(close.get_xlim()) == pytest.approx(40 * 0.005)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2])
def test_few_cells(tmp_path, n):
    points = np.random.default_rng(6).uniform(LOWER, UPPER, (n, 3))
    few = solids.solid_result(solids.solid_diagram(LOWER, UPPER, points))
    assert write_report(few, tmp_path)[0] == tmp_path / "report.html"


@pytest.fixture(scope="module")
def periodic(ctx):
    box = Box((-1, 0, 2), (1, 1, 3.5), periodic=(True, True, False))
    points = np.random.default_rng(4411).uniform(LOWER, UPPER, (150, 3))
    return solids.solid_result(Adapter(ctx).diagram(box, points))


@pytest.mark.sparse(1)
@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, 1, 0)])
def test_section_of_a_periodic_box_covers_it_once(periodic, normal):
    d, normal = periodic.diagram, np.array(normal, float)
    lower, upper = np.array([d.domain.lower, d.domain.upper])
    flat = flattened(cut_cells(d, normal, lower + 0.1 * d.domain.extent)[1], normal)
    axes = np.stack(plane_axes(normal), axis=1)
    window = shapely.box(*(lower @ axes), *(upper @ axes))
    assert sum(p.area for p in flat) == pytest.approx(window.area, rel=1e-9)
    assert shapely.union_all(flat).symmetric_difference(window).area < 1e-7


def test_cutaway_of_a_periodic_box_has_its_flat_sides(periodic):
    d = periodic.diagram
    right, up, towards = view_axes(VIEW)
    screen = np.stack([right, up], axis=1)
    areas = []
    for cut in (None, "octant"):
        _, polygons, _ = visible_faces(d, cut, np.array([0.0, 0.5, 2.75]), towards)
        corners = np.concatenate(polygons)
        assert ((corners > np.subtract(LOWER, 1e-7)) & (corners < np.add(UPPER, 1e-7))).all()
        on_sides = [p @ screen for p in polygons if (np.ptp(p, axis=0) < 1e-5).any()]
        areas.append(shapely.union_all([shapely.Polygon(p) for p in on_sides]).area)
    assert areas[0] == pytest.approx(np.abs(towards) @ (np.prod(d.domain.extent) / d.domain.extent), rel=1e-6)
    assert 0.5 * areas[0] < areas[1] < 0.9 * areas[0]


@pytest.mark.parametrize("periodic", [False, True])
def test_faces_in_a_cut_are_darker(ctx, periodic):
    box = Box((0, 0, 0), (1, 1, 1), periodic=periodic)
    d = Adapter(ctx).diagram(box, np.random.default_rng(3).random((60, 3)))
    brightest = []
    for cut in (None, "x"):  # seen along x: one side of the box, then the cut alone
        ax = plot_cutaway(d, np.ones(60), cut=cut, angles=(0, 0)).axes[0]
        (faces,) = (c for c in ax.collections if isinstance(c, PolyCollection))
        brightest.append(faces.get_facecolor()[:, 1].max())
    assert brightest[1] < 0.8 * brightest[0]


def test_an_octant_of_a_thin_plate_has_cells_on_both_sides_of_its_middle(ctx):
    i, j = np.divmod(np.arange(64), 8)
    places = np.column_stack([(i + 0.5) / 8, (j + 0.5) / 8, 0.05 + 0.002 * (-1.0) ** (i + j)])
    d = Adapter(ctx).diagram(Box((0, 0, 0), (1, 1, 0.1)), places)
    counts = []
    for through in (None, (0.5, 0.5, -1), (0.5, 0.5, 0.05)):
        ax = plot_cutaway(d, np.ones(64), through=through).axes[0]
        counts += [len(c.get_paths()) for c in ax.collections if isinstance(c, PolyCollection)]
    assert counts[0] == counts[1] < counts[2]


def test_a_body_is_seen_where_cells_around_it_are_removed(ctx):
    body = Solid.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    air = Solid.outside(body, ((-2, -2, -2), (2, 2, 2)))
    at = np.arange(-5, 6, 2) / 3 + 0.01
    points = np.stack(np.meshgrid(at, at, at), axis=-1).reshape(-1, 3)
    d = Adapter(ctx).diagram(air, points[np.abs(points).max(axis=1) > 0.5])
    assert around_body(d)
    ax = plot_cutaway(d, np.ones(len(d)), cut="y", through=(0, 0, 0)).axes[0]
    # The viewer is beyond xMax, yMin and zMax.
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["body-xMax", "body-yMin", "body-zMax"]
    assert plot_cutaway(d, np.ones(len(d)), cut=None).axes[0].get_legend() is None
    assert not around_body(Adapter(ctx).diagram(body, points[np.abs(points).max(axis=1) < 0.5]))


def test_without_pyvista(result, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    for view in ("slices", "slice", "cutaway"):
        with pytest.raises(ClvoroError, match=r"needs PyVista.*pip install 'clvoro\[pyvista\]'"):
            result.plot(view=view)
    with pytest.warns(MissingPicturesWarning, match=r"no pictures of the mesh.*clvoro\[pyvista\]"):
        files = write_report(result, tmp_path, dpi=30)
    assert {f.stem for f in files} == {"report", "history", "distributions"}
    assert "pip install &#x27;clvoro[pyvista]&#x27;" in files[0].read_text(encoding="utf-8")
