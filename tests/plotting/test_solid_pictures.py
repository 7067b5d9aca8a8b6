"""Pictures of 3D meshes show the cells that a plane cuts, or that a viewer sees."""

import dataclasses

import numpy as np
import pytest
import shapely
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.path import Path
from scipy.spatial import cKDTree

from clvoro import Adapter, Box
from clvoro.errors import InputError
from clvoro.mesh.connectivity import face_corners, face_owners, following
from clvoro.plotting import (
    page,
    plot_cells,
    plot_cutaway,
    plot_displacements,
    plot_distributions,
    plot_size,
    plot_slice,
    plot_slices,
    write_report,
)
from clvoro.plotting.cutaway import VIEW, kept_cells, view_axes, visible_faces
from clvoro.plotting.pictures import pictures_of
from clvoro.plotting.section import cut_cells, plane_axes
from clvoro.plotting.slices import focus
from tests.reference import solids

LOWER, UPPER = (-1.0, 0.0, 2.0), (1.0, 1.0, 3.5)


@pytest.fixture(scope="module")
def result():
    points = np.random.default_rng(77123).uniform(LOWER, UPPER, (150, 3))
    return solids.solid_result(solids.solid_diagram(LOWER, UPPER, points))


def has_color_bar(figure):
    (ax,) = figure.axes
    return len(ax.child_axes) == 1  # beside the picture, as high


def polygon_areas(section, normal):
    corners, nexts = section.corners, section.corners[following(section.starts)]
    doubled = np.cross(corners, nexts) @ (normal / np.linalg.norm(normal))
    return 0.5 * np.add.reduceat(doubled, section.starts[:-1])


@pytest.mark.sparse(2)
@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, -1, 0), (0.3, -1, 0.7)])
def test_section_is_that_of_the_cells(result, normal):
    """A point of the plane is in the polygon of the cell whose generator is nearest."""
    d = result.diagram
    normal, point = np.array(normal, float), np.array([0.1, 0.45, 2.9])
    section = cut_cells(d, normal, point)
    right, up = plane_axes(normal)
    for axis in (right, up):
        assert axis @ normal == pytest.approx(0, abs=1e-14)
    rng = np.random.default_rng(5)
    places = point + rng.uniform(-1.5, 1.5, (900, 1)) * right + rng.uniform(-1.5, 1.5, (900, 1)) * up
    places = places[d.domain.contains(places)]
    assert len(places) > 100
    nearest = cKDTree(d.points).query(places)[1]
    paths = {}
    for k, cell in enumerate(section.cells):
        corners = section.corners[section.starts[k] : section.starts[k + 1]]
        paths[cell] = Path(np.stack([corners @ right, corners @ up], axis=1))
    flat = np.stack([places @ right, places @ up], axis=1)
    found = np.array([[cell for cell, p in paths.items() if p.contains_point(x)] for x in flat])
    assert np.array_equal(found[:, 0], nearest)
    assert (polygon_areas(section, normal) > 0).all()


def test_section_covers_the_plane_once_even_along_faces():
    axes = (np.arange(k) + 0.5 for k in (3, 4, 2))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    d = solids.solid_diagram((0, 0, 0), (3, 4, 2), points)
    for height in (0.5, 1.0, 1.0 + 1e-15, 2.0):
        section = cut_cells(d, (0, 0, 1), (0, 0, height))
        assert len(section.cells) == 12
        assert polygon_areas(section, np.array([0, 0, 1.0])) == pytest.approx(1)
        assert (points[section.cells, 2] < height + 1e-9).all()
    assert len(cut_cells(d, (0, 0, 1), (0, 0, 2.5)).cells) == 0


@pytest.mark.sparse(2)
@pytest.mark.parametrize("color", ["error", "quality", "size", "sides", "skewness"])
def test_slice_is_drawn_with_its_values(result, color):
    figure = plot_slice(result, color, normal="y", through=(0, 0.3, 3))
    ax = figure.axes[0]
    (cells,) = (c for c in ax.collections if isinstance(c, PolyCollection))
    section = cut_cells(result.diagram, (0, 1, 0), (0, 0.3, 3))
    values = {
        "error": result.size_error,
        "quality": result.quality,
        "size": result.target_size,
        "sides": np.clip(np.diff(result.diagram.neighbor_starts), 12, 16),
        "skewness": result.measures.worst_of_cell("skewness"),
    }[color]
    np.testing.assert_array_equal(cells.get_array(), values[section.cells])
    for path, a, b in zip(cells.get_paths(), section.starts[:-1], section.starts[1:], strict=True):
        np.testing.assert_array_equal(path.vertices[:-1], section.corners[a:b][:, [0, 2]])
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_title()) == ("x", "z", "$y = 0.3$")
    assert ax.get_xlim() == pytest.approx((-1, 1))
    assert ax.get_ylim() == pytest.approx((2, 3.5))
    assert ax.get_aspect() == 1


def test_every_side_of_a_slice_is_drawn_once(result):
    ax = plot_slice(result, normal="z", through=(0, 0, 2.7)).axes[0]
    (lines,) = (c for c in ax.collections if isinstance(c, LineCollection))
    drawn = sum(np.hypot(*(b - a)) for a, b in lines.get_segments())
    section = cut_cells(result.diagram, (0, 0, 1), (0, 0, 2.7))
    lengths = np.linalg.norm(section.edges[:, 1] - section.edges[:, 0], axis=1)
    walls = result.diagram.neighbors[section.rows] < 0
    # Edges of cells that are too small to be seen are left out. These cells are all large enough.
    assert drawn == pytest.approx(lengths[walls].sum() + lengths[~walls].sum() / 2)
    assert lengths[walls].sum() == pytest.approx(6)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("cut", ["octant", (0.0, -1.0, 0.0), None])
def test_what_is_drawn_last_is_what_the_viewer_sees(result, cut):
    """The first kept cell on a line of sight is that of the last polygon drawn there."""
    d = result.diagram
    right, up, towards = view_axes(VIEW)
    through = np.array([0.1, 0.5, 2.7])
    kept = kept_cells(d, cut if cut is None or isinstance(cut, str) else np.array(cut), through, towards)
    assert kept.all() == (cut is None)
    rows, normals = visible_faces(d, kept, towards)
    assert (normals @ towards > 0).all()
    starts, corners = face_corners(d)
    owner = face_owners(d)
    paths = []
    for row in rows:
        loop = d.vertices[corners[starts[row] : starts[row + 1]]]
        paths.append(Path(np.stack([loop @ right, loop @ up], axis=1)))
    rng = np.random.default_rng(31)
    tree = cKDTree(d.points)
    steps = np.linspace(4, -4, 8001)
    seen = wrong = 0
    for anchor in rng.uniform(LOWER, UPPER, (60, 3)):
        ray = anchor + steps[:, None] * towards
        ray = ray[d.domain.contains(ray)]
        nearest = tree.query(ray)[1]
        first = nearest[kept[nearest]][:1]
        place = (anchor @ right, anchor @ up)
        drawn = [owner[row] for row, path in zip(rows, paths, strict=True) if path.contains_point(place)]
        seen += len(first)
        wrong += len(first) != bool(drawn) or (len(first) and first[0] != drawn[-1])
    assert seen > 40
    # A ray may pass a corner of a cell between two of its steps.
    assert wrong <= 1


def test_octant_that_is_cut_out_faces_the_viewer(result):
    towards = view_axes(VIEW)[2]
    kept = kept_cells(result.diagram, "octant", np.array([0.0, 0.5, 2.75]), towards)
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
    with pytest.raises(InputError, match=r"plot_slice.*ParaView"):
        plot_cells(result)
    with pytest.raises(InputError, match="this mesh is in 3D"):
        plot_displacements(result)
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
    monkeypatch.setattr("clvoro.plotting.pictures.MANY_SOLID_CELLS", 100)
    sharp = dataclasses.replace(result, target_size=np.where(np.arange(150) == 7, 0.005, 0.2))
    (draw,) = (d for name, _, d in pictures_of({"coupled": sharp}) if name == "closer")
    ax = draw().axes[0]
    assert np.ptp(ax.get_xlim()) == pytest.approx(60 * 0.005)


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


def clipped_area(section, lower, upper, right, up):
    """Area of the polygons inside of the box, by shapely."""
    window = shapely.box(lower @ right, lower @ up, upper @ right, upper @ up)
    flat = np.stack([section.corners @ right, section.corners @ up], axis=1)
    polygons = [shapely.Polygon(p) for p in np.split(flat, section.starts[1:-1])]
    return sum(p.intersection(window).area for p in polygons), shapely.union_all(polygons), window


@pytest.mark.sparse(1)
@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, 1, 0)])
def test_section_of_a_periodic_box_covers_its_whole_width(periodic, normal):
    d = periodic.diagram
    lower, upper = np.array(d.domain.lower), np.array(d.domain.upper)
    section = cut_cells(d, np.array(normal), lower + 0.1 * d.domain.extent)
    area, union, window = clipped_area(section, lower, upper, *plane_axes(np.array(normal)))
    assert union.buffer(1e-9).covers(window)
    assert area == pytest.approx(window.area, rel=1e-9)  # and covers it once


def test_cutaway_of_a_periodic_box_is_closed(periodic):
    """Faces at seams are drawn: the visible faces project to the silhouette of all cells."""
    d = periodic.diagram
    right, up, towards = view_axes(VIEW)
    rows, normals = visible_faces(d, np.ones(len(d), bool), towards)
    assert d.shifts[rows].any(axis=1).any()
    starts, corners = face_corners(d)
    faces = [d.vertices[corners[starts[r] : starts[r + 1]]] for r in range(len(starts) - 1)]
    flat = [shapely.Polygon(np.stack([f @ right, f @ up], axis=1)).buffer(0) for f in faces if len(f)]
    seen = [shapely.Polygon(np.stack([f @ right, f @ up], axis=1)).buffer(0) for f in (faces[r] for r in rows)]
    assert shapely.union_all(seen).area == pytest.approx(shapely.union_all(flat).area, rel=1e-9)
    for row, normal in zip(rows, normals, strict=True):
        corners = faces[row] - faces[row][0]
        assert np.abs(corners @ normal).max() < 1e-7


def test_cutaway_of_a_periodic_box_is_not_cropped(periodic):
    (ax, *_) = plot_cutaway(periodic, "quality").axes
    drawn = np.concatenate([path.vertices for path in ax.collections[1].get_paths()])
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    assert left < drawn[:, 0].min()
    assert drawn[:, 0].max() < right
    assert bottom < drawn[:, 1].min()
    assert drawn[:, 1].max() < top
