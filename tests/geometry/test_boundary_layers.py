"""Boundary layers: layers of cells along walls, whose generators do not move."""

import re
from itertools import pairwise

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.adaptation.options import Options
from clvoro.errors import InputError, InputTypeError
from clvoro.finite_volumes.prisms import cell_loops
from clvoro.geometry.boundary_layers import LayerRows, Layers
from tests.reference import shores

BOX = clvoro.Box((0, 0), (2, 1))
HOLE = 0.2 * np.stack([np.cos(np.arange(80) * np.pi / 40), np.sin(np.arange(80) * np.pi / 40)], axis=1)
CHANNEL = clvoro.Polygon([(-1, -0.5), (2, -0.5), (2, 0.5), (-1, 0.5)], [HOLE])


def test_bisectors_are_the_borders_of_layers():
    layers = Layers(0.01, count=4, growth=1.3)
    tops = np.cumsum(layers.heights)
    assert layers.heights == pytest.approx(0.01 * 1.3 ** np.arange(4))
    assert (layers.rows[1:] + layers.rows[:-1]) / 2 == pytest.approx(tops)
    assert layers.thickness == pytest.approx(tops[-1])
    # Every generator is at the same share of its layer.
    assert (tops - layers.rows[:-1]) / layers.heights == pytest.approx(1.3 / 2.3)


def test_layers_of_a_straight_wall_are_rectangles(adapter):
    layers = Layers(0.02, count=2, growth=1.5, edges=[2])
    result = adapter.run(BOX, 0.1, layers=layers, effort="fast")
    rows = LayerRows(BOX, [layers]).points
    n, d = len(rows), result.diagram
    # They come first and have not moved, up to round-off of the device's coordinates.
    assert np.abs(result.points[:n] - rows).max() < 1e-14
    first = np.flatnonzero(np.isclose(rows[:, 1], layers.rows[0]))
    columns = round(2 / layers.width)
    assert len(first) == columns
    assert d.volumes[first] == pytest.approx(0.02 * 2 / columns, rel=1e-12)
    second = np.flatnonzero(np.isclose(rows[:, 1], layers.rows[1]))
    assert d.volumes[second] == pytest.approx(0.03 * 2 / columns, rel=1e-12)
    for i in first:
        assert d.neighbor_starts[i + 1] - d.neighbor_starts[i] == 4
    # The error of the others is that of a run without layers: 0.010 to 0.021 for twelve seeds.
    error = np.abs(result.size_error)
    assert error[:n].max() == 0
    assert error[n:].mean() < 0.025
    assert result.check()


RAMP = clvoro.Polygon([(0, 0), (0.93, 0), (1.4, 0.12), (2, 0.2), (2, 1), (0, 1)])
UNEVEN = np.radians([0, 38, 80, 121, 160, 200, 243, 281, 320])  # turns of less than 50 degrees
RAGGED = clvoro.Polygon(
    [(-1, -0.7), (1, -0.7), (1, 0.7), (-1, 0.7)], [0.45 * np.column_stack([np.cos(UNEVEN), np.sin(UNEVEN)])]
)


@pytest.mark.sparse(2)
@pytest.mark.parametrize(
    ("domain", "edges", "spacing"),
    [
        (RAMP, range(3), 0.05),
        (CHANNEL, range(4, 84), 0.0075),
        (CHANNEL, range(4, 84), 0.014),
        (CHANNEL, range(4, 84), 0.034),
        (RAGGED, range(4, 13), 0.06),
    ],
    ids=["ramp", "circle, two to an edge", "circle, one to an edge", "circle, two edges each", "loop"],
)
def test_corners_of_the_wall_are_corners_of_cells(adapter, domain, edges, spacing):
    """No face on the wall is a sliver that a corner of the wall cuts off."""
    layers = Layers(0.4 * spacing, count=2, spacing=spacing, edges=edges)
    rows = LayerRows(domain, [layers]).points
    diagram = adapter.diagram(domain, rows)
    owners = np.repeat(np.arange(len(rows)), np.diff(diagram.neighbor_starts))
    walls = -1 - diagram.neighbors
    mine = np.isin(walls, edges)
    lengths = diagram.face_measures[mine]
    ends = domain.boundary_distance(rows[owners[mine]]) < 1.01 * layers.rows[0]
    assert ends.all()  # the first row covers the wall
    each = np.unique(owners[mine], return_counts=True)[1]
    two_edges = spacing > 0.03 and domain is CHANNEL
    assert (each == (2 if two_edges else 1)).all()
    # Half the length of two edges, or a column on an edge that is no multiple of the spacing.
    assert lengths.min() > (0.4 if two_edges else 0.7) * spacing
    assert lengths.max() < 1.3 * spacing
    assert lengths.sum() == pytest.approx(
        sum(np.linalg.norm(b - a) for a, b in LayerRows(domain, [layers]).segments(0)), rel=1e-12
    )


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_layers_of_a_periodic_channel_go_through_the_seam(adapter, axis):
    """Cells on both walls are rectangles, also at the seam."""
    shape = (2.0, 1.0) if axis == 0 else (1.0, 2.0)
    channel = clvoro.Box((0, 0), shape, periodic=(axis == 0, axis == 1))
    layers = Layers(0.02, count=3, growth=1.2)
    result = adapter.run(channel, 0.1, layers=layers, effort="fast")
    rows, d = LayerRows(channel, [layers]).points, result.diagram
    columns = round(2 / layers.width)
    assert len(rows) == 2 * 4 * columns
    moved = result.points[: len(rows)] - rows
    assert np.abs(moved - np.rint(moved / channel.extent) * channel.extent).max() < 1e-14
    heights = np.minimum(rows[:, 1 - axis], 1 - rows[:, 1 - axis])
    for row, height in zip(layers.rows[:-1], layers.heights, strict=True):
        layer = np.flatnonzero(np.isclose(heights, row))
        assert len(layer) == 2 * columns
        assert d.volumes[layer] == pytest.approx(height * 2 / columns, rel=1e-12)
        assert (np.diff(d.neighbor_starts)[layer] == 4).all()
    assert d.volumes.sum() == pytest.approx(2, rel=1e-12)
    # The error of the others is that of a run without layers. None is between the rows.
    assert np.abs(result.size_error[len(rows) :]).mean() < 0.025
    others = result.points[len(rows) :, 1 - axis]
    assert np.minimum(others, 1 - others).min() > layers.rows[-1]
    result.check().demand()
    with pytest.raises(InputError, match="expected one of " + ("2, 3" if axis == 0 else "0, 1")):
        adapter.run(channel, 0.1, layers=Layers(0.02, edges=[0, 2]))


def test_sizes_grow_from_the_layers(adapter):
    layers = Layers(0.02, count=3, growth=1.2, edges=range(4, 84))
    result = adapter.run(CHANNEL, 0.2, layers=layers, effort="fast")
    distance = np.hypot(*result.points.T) - 0.2
    beyond = np.flatnonzero((distance > layers.rows[-1] * 1.01) & (distance < 0.25))
    # Sizes depend on the distance to edges, whose middles are inside the circle.
    expected = layers.width + np.log(1.2) * distance[beyond]
    assert result.target_size[beyond] == pytest.approx(expected, abs=1e-3)
    n = len(LayerRows(CHANNEL, [layers]).points)
    assert np.abs(result.size_error[n:]).mean() < 0.02
    assert CHANNEL.contains(result.points).all()
    assert result.diagram.volumes.sum() == pytest.approx(CHANNEL.measure, rel=1e-12)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("method", ["lloyd", "coupled", "weighted", "exact"])
def test_no_method_moves_generators_of_layers(adapter, method):
    layers = Layers(0.04, count=2, edges=range(4, 84))
    options = (
        {"max_steps": 8} if method != "exact" else {"effort": "fast", "options": clvoro.MultilevelOptions(levels=1)}
    )
    result = adapter.run(CHANNEL, 0.1, layers=layers, method=method, **options)
    made = LayerRows(CHANNEL, [layers])
    rows, free = made.points, made.free
    assert np.abs(result.points[: len(rows)] - rows).max() < 1e-14
    assert free.contains(result.points[len(rows) :]).all()


def test_layers_in_corners_and_gaps_belong_to_the_nearest_wall():
    comb = clvoro.Polygon([(0, 0), (3, 0), (3, 1), (2, 1), (2, 0.15), (1, 0.15), (1, 1), (0, 1)])
    layers = Layers(0.02, count=3, growth=1.2)
    rows = LayerRows(comb, [layers]).points
    assert comb.contains(rows).all()
    near = comb.boundary_distance(rows)
    # Each is on a row, counted from the nearest wall.
    off = np.abs(near[:, None] - layers.rows).min(axis=1)
    assert off.max() < 0.1 * layers.rows[-1] + 1e-12
    gaps = np.hypot(*(rows[:, None] - rows).T) + np.eye(len(rows))
    corner = np.min([np.hypot(*(rows - c).T) for c in ((1, 0.15), (2, 0.15))], axis=0)
    away = corner > layers.rows[1] * 1.01
    assert gaps[away].min() >= 0.6 * 0.02 - 1e-12
    # Four generators of each row around each of the two re-entrant corners, at the distance of the row.
    for row in layers.rows[:2]:
        assert np.count_nonzero(np.abs(corner - row) < 1e-12) == 8
    assert gaps.min() == pytest.approx(2 * layers.rows[0] * np.sin(np.pi / 12))


def test_columns_are_narrow_where_the_wall_is_curved_and_beside_sharp_edges():
    """A wing: the wall leaves the chord of a cell by a quarter of the first height at most."""
    wing = clvoro.curves.naca("0012", name="wing")
    domain = clvoro.Polygon(clvoro.curves.circle((0.5, 0), 6), [wing])
    layers = Layers(1e-3, count=3, growth=1.3, spacing=0.05, edges="wing")
    made = LayerRows(domain, [layers])
    (segments, _), (feet, normals) = made.outer_segments(0), made.columns(0)
    gaps = np.hypot(*np.diff(feet, axis=0).T)
    turns = np.arccos(np.clip((normals[1:] * normals[:-1]).sum(axis=1), -1, 1))
    assert (gaps * turns / 8).max() < 1.2 * 0.25 * layers.height  # w^2 / (8 r), and r is w / turn
    assert gaps.max() == pytest.approx(0.05, rel=0.1)
    tail = np.hypot(*(feet - (1, 0)).T)
    assert np.sort(tail)[:2] == pytest.approx(2 * [8 * layers.height], rel=0.25)
    # Neighboring columns differ by little, so the last row has no jumps, either.
    ratio = np.maximum(gaps[1:] / gaps[:-1], gaps[:-1] / gaps[1:])
    assert ratio.max() < 1.5
    assert domain.contains(segments.reshape(-1, 2)).all()


@pytest.mark.parametrize("start", [0, 14, 90])
def test_widths_of_columns_change_gradually_where_a_closed_wall_begins(start):
    """An ellipse, narrow at its tips, begins in a tip, beside it and on its flat side."""
    body = clvoro.curves.ellipse((0, 0), (1, 0.03), start=start, end=start + 360, name="body")
    domain = clvoro.Polygon(clvoro.curves.circle((0, 0), 6), [body])
    feet, _ = LayerRows(domain, [Layers(1e-3, count=3, spacing=0.1, edges="body")]).columns(0)
    gaps = np.hypot(*(np.roll(feet, -1, axis=0) - feet).T)
    assert gaps.min() < 0.004
    assert gaps.max() == pytest.approx(0.1, rel=0.02)
    ratio = gaps / np.roll(gaps, 1)
    assert 1 / 1.4 < ratio.min() < ratio.max() < 1.4


@pytest.mark.slow
def test_wings_with_thin_layers_are_accepted_by_solvers(adapter):
    wing = clvoro.curves.naca("0012", name="wing")
    domain = clvoro.Polygon([(-1, -1), (2, -1), (2, 1), (-1, 1)], [wing])
    layers = Layers(2e-4, count=6, growth=1.35, spacing=0.01, edges="wing")
    size = clvoro.sizing.Distance(wing, h_min=0.03, slope=0.3)
    mesh = adapter.run(domain, size, layers=layers, effort="fast")
    report = mesh.check(solver="openfoam")
    assert report, report


@pytest.mark.sparse(1)
@pytest.mark.parametrize("spacing", [0.01, 0.04])
@pytest.mark.parametrize("angle", [50.5, 90, 120, 170])
def test_faces_end_in_the_corners_of_bodies_with_layers(adapter, angle, spacing):
    """A triangle with a corner that turns by `angle`: cells around it are convex."""
    slope = np.tan(np.radians(180 - angle) / 2)
    body = [(0, 0), (-0.3, -0.3 * slope), (-0.3, 0.3 * slope)]
    shift = body[1][1] - 0.2
    domain = clvoro.Polygon([(-0.5, shift), (0.2, shift), (0.2, -shift), (-0.5, -shift)], [body])
    layers = Layers(0.004, count=3, spacing=spacing, edges="hole-1")
    mesh = adapter.run(domain, 0.08, layers=layers, effort="fast").solver_mesh()
    faces = mesh.points[mesh.corners.reshape(-1, 2)]
    for corner in body:
        assert (faces[: mesh.n_inner] == corner).all(axis=-1).any()
    starts, loops = cell_loops(mesh)
    for first, last in pairwise(starts.tolist()):
        x = mesh.points[loops[first:last]]
        a, b = x - np.roll(x, 1, axis=0), np.roll(x, -1, axis=0) - x
        turns = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
        assert turns.min() > -1e-9


@pytest.mark.slow
def test_there_are_no_levels_too_coarse_for_the_gaps_between_layers(adapter):
    """Cells do not spread past layers, which are fine on all levels."""
    tubes = [clvoro.curves.circle((x, 0.5), 0.2, name=f"tube-{x}") for x in (0.3, 0.9)]
    domain = clvoro.Polygon([(0, 0), (1.2, 0), (1.2, 1), (0, 1)], tubes)
    layers = clvoro.Layers(0.002, 3, 1.3, spacing=0.012, edges=["tube-0.3", "tube-0.9"])
    mesh = adapter.run(domain, 0.016, layers=layers, effort="fast")
    assert mesh.settings["levels"] == 0
    assert np.abs(mesh.size_error).mean() < 0.01


@pytest.mark.slow
def test_sizes_are_met_where_columns_of_two_walls_come_close(adapter):
    """In this corner they are 4.5 apart. Sizes beyond had that limit once, and |e| was up to 75."""
    domain = clvoro.Polygon([(600, 2100), (-200, 900), (0, 0), (700, 900)])
    layers = clvoro.Layers(8, 4, 1.2, spacing=25, edges=(0, 1))
    segments, widths = LayerRows(domain, [layers]).outer_segments(0)
    lengths = np.hypot(*(segments[:, 1] - segments[:, 0]).T)
    assert lengths.min() < 5 < 0.5 * layers.width < widths.min()
    result = adapter.run(domain, 60.0, layers=layers, seed=3)
    assert np.abs(result.size_error).max() < 0.3


def test_runs_with_layers_resume_to_the_same_bits(adapter, tmp_path):
    layers = Layers(0.04, count=2, edges=range(4, 84))
    options = {"layers": layers, "effort": "fast", "options": clvoro.MultilevelOptions(levels=1)}
    whole = adapter.run(CHANNEL, 0.1, checkpoint=clvoro.Checkpoint(tmp_path / "whole", every=0), **options)
    steps = []
    adapter.run(
        CHANNEL,
        0.1,
        checkpoint=clvoro.Checkpoint(tmp_path / "half", every=0),
        callback=lambda row: steps.append(row) or len(steps) == 9,
        **options,
    )
    resumed = adapter.run(CHANNEL, 0.1, checkpoint=clvoro.Checkpoint(resume=tmp_path / "half"), **options)
    assert np.array_equal(whole.points, resumed.points)
    with pytest.raises(InputError, match="layers"):
        adapter.run(
            CHANNEL,
            0.1,
            checkpoint=clvoro.Checkpoint(resume=tmp_path / "half"),
            effort="fast",
            options=clvoro.MultilevelOptions(levels=1),
        )


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Layers(0), "height"),
        (lambda: Layers(0.1, count=0), "count"),
        (lambda: Layers(0.1, growth=0.9), "growth"),
        (lambda: LayerRows(BOX, [Layers(0.1, edges=[4])]).points, "has side 4, expected numbers from 0 to 3"),
        (lambda: LayerRows(BOX, [Layers(0.1, edges=[])]).points, "empty"),
        (lambda: LayerRows(BOX, [Layers(0.4, edges=[2, 3])]).free, "no room"),
        (lambda: LayerRows(CHANNEL, [Layers(0.4)]).free, "no room"),
    ],
)
def test_impossible_layers_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


@pytest.mark.parametrize(
    ("layers", "expected"),
    [
        # Refused at once: the number of generators is estimated before any is placed.
        (lambda: Layers(1e300), InputError),
        (lambda: Layers(0.01, count=10**7, growth=1), InputError),
        (lambda: Layers(0.01, count=10**18), InputError),
        (lambda: Layers(0.01, count=10**400), InputError),
        (lambda: Layers(10**400), InputError),
        (lambda: Layers(0.01, count=3, growth=1e200), InputError),
        (lambda: Layers(1e308, count=2, growth=1e308), InputError),
        (lambda: Layers(0.01, spacing=1e308), InputError),
        (lambda: Layers(0.1, edges=3.0), InputTypeError),
        (lambda: Layers(0.1, edges={3: "a"}), InputTypeError),
        (lambda: Layers(0.1, edges="nowhere"), InputError),
        (lambda: ["thin"], InputTypeError),
    ],
)
@pytest.mark.filterwarnings("error")
def test_layers_of_extreme_size_are_refused(adapter, layers, expected):
    for domain in (BOX, CHANNEL):
        with pytest.raises(expected):
            adapter.run(domain, 0.2, layers=layers(), effort="fast")


@pytest.mark.parametrize("growth", [1, 1 + 1e-15, 1.2, 3])
def test_thickness_is_that_of_all_heights(growth):
    layers = Layers(0.01, count=7, growth=growth)
    assert layers.thickness == pytest.approx(layers.heights.sum(), rel=1e-14)
    assert layers.width == pytest.approx(layers.heights[-1], rel=1e-14)


@pytest.mark.parametrize(("domain", "edges"), [(BOX, None), (CHANNEL, None), (CHANNEL, range(4))])
def test_the_count_bounds_the_number_of_generators(domain, edges):
    layers = Layers(0.02, count=3, edges=edges)
    count, placed = LayerRows(domain, [layers]).count(), len(LayerRows(domain, [layers]).points)
    assert 0.8 * count < placed <= count


@pytest.mark.sparse(2)
@pytest.mark.parametrize("beside", [-1e-13, -1e-14, 0, 1e-14, 1e-13, 1e-10])
def test_strips_may_end_beside_corners(adapter, beside):
    """The region beyond them has no edge as short as round-off there."""
    layer = clvoro.Layers(0.05, count=1, spacing=0.1, edges=[0])
    reach = layer.rows[-1] + 0.03
    shore = clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1), (0, reach + beside)])
    assert LayerRows(shore, [layer]).free.lower[1] == pytest.approx(reach, abs=1e-9)
    assert adapter.run(shore, 0.1, layers=layer, method="lloyd", max_steps=1).check()


def test_domains_without_walls_in_2d_are_refused():
    for domain in (clvoro.Box((0, 0, 0), (1, 1, 1)), clvoro.Box((0, 0), (1, 1), periodic=True)):
        with pytest.raises(InputTypeError, match="walls"):
            LayerRows(domain, [Layers(0.1)])
    with pytest.raises(InputTypeError, match="Layers"):
        Options(layers=[0.1])


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_new_generators_keep_away_from_layers_around_corners(ctx, dtype):
    """Cells in narrow tips reach around corners into the layers on the other side. No generator is inserted there."""
    for seed in (4, 6, 15):
        tips = int(np.random.default_rng(seed).integers(12, 40))
        star = clvoro.Polygon(shores.star(tips, seed, (0.5, 0.5), 0.5))
        layer = clvoro.Layers(0.004, count=2, growth=2.0, spacing=0.03, edges=range(0, tips, 2))
        result = clvoro.Adapter(ctx, dtype).run(
            star, 0.03, layers=layer, options=clvoro.MultilevelOptions(levels=1), effort="fast", max_steps=20, seed=1
        )
        result.check().demand()
        others = result.points[len(LayerRows(star, [layer]).points) :]
        away = shapely.distance(LayerRows(star, [layer]).free.geometry, shapely.points(others))
        assert away.max() <= 16 * np.finfo(dtype).eps
        assert (result.history["inserted"] > 0).sum() >= 2, "by refinement, and to meet the count"


def test_layers_thicker_than_their_gap_are_refused_with_a_thickness_that_fits(ctx):
    channel = clvoro.Polygon([(0, 0), (4, 0), (4, 1), (0, 1)], [clvoro.curves.circle((1, 0.5), 0.2, name="pipe")])
    for edges in ("pipe", None):
        layers = Layers(0.05, count=8, growth=1.3, edges=edges)
        with pytest.raises(
            InputError, match=r"layers\[0\] are 1.19 thick, and the gap at .* is ([\d.]+) wide"
        ) as raised:
            clvoro.Adapter(ctx).run(channel, 0.1, layers=layers)
        fits = float(re.search("at most ([0-9.]+)", str(raised.value))[1])
        thinner = Layers(0.05 * fits / layers.thickness, count=8, growth=1.3, spacing=0.1, edges=edges)
        result = clvoro.Adapter(ctx).run(channel, 0.1, "fast", layers=thinner)
        assert np.abs(result.size_error).mean() < 0.05
    # The place is in the throat, not in a sharp corner, where gaps are ever narrower.
    throat = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1.2, 0.1), (0.8, 0.1), (0, 1)])
    with pytest.raises(
        InputError, match=r"the gap at \(1\.\d*, 0\.1\) is 0\.1 wide, with layers on both sides"
    ) as raised:
        LayerRows(throat, [Layers(0.01, count=6)]).check_gaps()
    fits = float(re.search("at most ([0-9.]+)", str(raised.value))[1])
    LayerRows(throat, [Layers(fits / 6, count=6, spacing=0.01)]).check_gaps()


def test_a_default_width_below_the_size_field_is_said(ctx):
    box, adapter = clvoro.Box((0, 0), (1, 1)), clvoro.Adapter(ctx)
    thin = adapter.run(box, 0.1, "fast", layers=Layers(0.02, edges="yMin"), max_steps=0)
    assert thin.settings["widths"].startswith("layers[0] have cells 0.02 wide, the last layer's height, where the size")
    given = adapter.run(box, 0.1, "fast", layers=Layers(0.02, spacing=0.1, edges="yMin"), max_steps=0)
    assert "widths" not in given.settings
