"""Pictures and the report show what was computed, completely."""

import base64
import dataclasses
import itertools
import re

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

import clvoro
from clvoro.errors import InputError
from clvoro.plotting import page, pictures, plot_cells, plot_history, plot_size, write_report
from clvoro.plotting.legends import short
from clvoro.plotting.pictures import pictures_of, render
from clvoro.plotting.style import nice

BOX = clvoro.Box((-1, 2), (1, 3))


def size(x):
    return 0.08 + 0.2 * np.hypot(x[:, 0], x[:, 1] - 2.5)


@pytest.fixture(scope="module")
def results(adapter):
    return {
        method: adapter.run(
            BOX, size, method=method, points="uniform", max_steps=6, options=clvoro.PaperOptions(tol=0), seed=4711
        )
        for method in ("lloyd", "coupled")
    }


@pytest.fixture(scope="module")
def result(results):
    return results["coupled"]


def of_kind(figure, kind):
    return [c for c in figure.axes[0].collections if isinstance(c, kind)]


@pytest.mark.parametrize("color", ["error", "quality", "size", "sides"])
def test_cells_are_drawn_with_their_values(result, color):
    (cells,) = of_kind(plot_cells(result, color), PolyCollection)
    wanted = {
        "error": result.size_error,
        "quality": result.quality,
        "size": result.target_size,
        "sides": np.clip(np.diff(result.diagram.cell_vertex_starts), 4, 8),
    }
    assert np.array_equal(cells.get_array(), wanted[color])
    starts, corners = result.diagram.cell_vertex_starts, result.diagram.cell_vertices
    for i, path in enumerate(cells.get_paths()):
        polygon = result.diagram.vertices[corners[starts[i] : starts[i + 1]]]
        assert np.array_equal(path.vertices[:-1], polygon)


def test_faces_are_as_thin_as_their_cells_are_small(result):
    small = Figure(figsize=(1.0, 0.6)).add_subplot()
    plot_cells(result, "quality", small, key=False)
    (cells,) = [c for c in small.collections if isinstance(c, PolyCollection)]
    widths, inks = np.array(cells.get_linewidths()), cells.get_edgecolor()[:, :3]
    sizes = np.sqrt(result.diagram.volumes)
    # The line of a face is at most as wide as a twentieth of its cell. Thinner ones take the color of the cell.
    assert widths.max() <= 0.05 * sizes.max() * 72 / BOX.extent[0]
    cells.update_scalarmappable()
    contrast = np.abs(inks - cells.get_facecolor()[:, :3]).max(axis=1)
    assert np.corrcoef(contrast, sizes)[0, 1] > 0.3
    assert contrast[np.argmin(sizes)] < 0.5 * contrast.max()


def test_faces_are_seen_in_the_darkest_cells(result):
    for color in ("error", "quality", "size", "skewness", result.points[:, 0]):
        (cells,) = of_kind(plot_cells(result, color), PolyCollection)
        cells.update_scalarmappable()
        dark = cells.get_facecolor()[:, :3] @ (0.3, 0.6, 0.1)
        lines = cells.get_edgecolor()[:, :3] @ (0.3, 0.6, 0.1)
        assert np.abs(dark - lines).min() > 0.06


def test_islands_in_a_cell_have_no_bridge(adapter):
    island = [(0.45, 0.45), (0.55, 0.45), (0.55, 0.55), (0.45, 0.55)]
    domain = clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1)], [island])
    figure = adapter.diagram(domain, [(0.42, 0.5)]).plot()
    (cells,), (lines,) = of_kind(figure, PolyCollection), of_kind(figure, LineCollection)
    assert list(cells.get_linewidths()) == [0]
    assert sum(np.hypot(*np.subtract(*s)) for s in lines.get_segments()) == pytest.approx(4.4)


def test_error_scale_is_the_same_on_both_sides_of_zero(result):
    (cells,) = of_kind(plot_cells(result, "error"), PolyCollection)
    low, high = cells.get_clim()
    assert low == -high
    assert high >= np.quantile(np.abs(result.size_error), 0.99)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("shape", [(3.0, 1.0), (1.0, 1.0), (0.6, 2.0)])
@pytest.mark.parametrize("color", ["error", "quality", "size"])
def test_color_bar_is_as_high_as_the_picture_and_readable(adapter, shape, color):
    domain = clvoro.Box((0, 0), shape)
    result = adapter.run(domain, lambda x: 0.05 + 0.1 * x[:, 1], method="lloyd", max_steps=1)
    figure = plot_cells(result, color)
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    (ax,) = figure.axes
    (bar,) = ax.child_axes
    picture = ax.get_window_extent(renderer)
    long_axis = bar.get_window_extent(renderer)
    arrows = 1.2  # those at the ends belong to the bar's height, not to its axes
    assert picture.height / arrows < long_axis.height <= picture.height * 1.001
    assert bar.get_tightbbox(renderer).x1 <= figure.bbox.x1 + 1  # the label is not cut off
    boxes = [
        t.get_window_extent(renderer)
        for t in bar.get_yticklabels()
        if long_axis.y0 - 1 <= t.get_window_extent(renderer).y1 and t.get_text()
    ]
    assert len(boxes) >= 2
    boxes.sort(key=lambda b: b.y0)
    for lower, upper in itertools.pairwise(boxes):
        assert lower.y1 < upper.y0  # numbers do not touch


def test_color_bar_of_a_flat_picture_is_below_it(adapter):
    domain = clvoro.Box((0, 0), (8, 0.8))
    figure = adapter.run(domain, 0.2, method="lloyd", max_steps=1).plot("size")
    figure.canvas.draw()
    ax, bar = figure.axes
    assert bar.get_window_extent().y1 < ax.get_window_extent().y0
    assert ax.get_window_extent().width > 0.8 * figure.bbox.width
    assert bar.get_tightbbox().y0 >= -1


def test_a_scale_of_integers_has_no_other_numbers(result):
    ticks = {}
    for divisor in (1, 2):
        figure = plot_cells(result, np.arange(len(result)) % 4 / divisor)
        figure.canvas.draw()
        ((bar,),) = (ax.child_axes for ax in figure.axes)
        ticks[divisor] = np.mod(bar.get_yticks(), 1)
    assert not ticks[1].any()
    assert ticks[2].any()


def test_axes_of_a_plain_figure_make_room_for_the_color_bar(result):
    figure = Figure(figsize=(6, 4))
    plot_cells(result, "quality", figure.add_subplot())
    assert len(figure.axes) == 2


@pytest.mark.parametrize(
    ("value", "text"), [(0.0024, "0.0024"), (12345.0, "12000"), (3e-7, "3e−07"), (-0.05, "−0.05"), (2.0, "2")]
)
def test_numbers_of_a_scale_are_short(value, text):
    assert short(value) == text


def test_limits_and_window_are_taken(result):
    window = ((0.0, 2.4), (0.3, 2.6))
    figure = plot_cells(result, "quality", window=window, limits=(0.25, 0.75))
    (cells,) = of_kind(figure, PolyCollection)
    assert cells.get_clim() == (0.25, 0.75)
    assert figure.axes[0].get_xlim() == (0.0, 0.3)
    shown = len(cells.get_paths())
    inside = ((result.points > window[0]) & (result.points < window[1])).all(axis=1).sum()
    assert inside <= shown < len(result.points)


RING = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (0, 1)], [[(0.4, 0.4), (1.6, 0.4), (1.6, 0.6)]])


@pytest.mark.parametrize("domain", [BOX, RING, clvoro.Box((0, 0), (2, 1), periodic=True)], ids=str)
def test_pixels_have_the_values_of_their_cells(adapter, domain, monkeypatch):
    monkeypatch.setattr("clvoro.plotting.cells.MOST_POLYGONS", 10)
    points = domain.lower + np.random.default_rng(3).random((300, 2)) * domain.extent
    diagram = adapter.diagram(domain, points[domain.contains(points)])
    own = np.arange(len(diagram))
    figure = plot_cells(diagram, own, edges=False)
    (image,) = figure.axes[0].images
    assert not of_kind(figure, PolyCollection)[0].get_paths()
    shown, box = image.get_array(), np.reshape(image.get_extent(), (2, 2)).T
    counts = np.array(shown.shape[::-1])
    places = np.argwhere(np.ones(shown.shape))[:, ::-1]
    cells = diagram.locate(box[0] + (places + 0.5) / counts * (box[1] - box[0]))
    inside = cells >= 0
    assert inside.mean() == pytest.approx(domain.measure / np.prod(box[1] - box[0]), abs=0.01)
    assert np.array_equal(shown.ravel()[inside], own[cells[inside]])
    # Beside the boundary are a few more pixels; the rest is blank, and the boundary cuts them off.
    assert (~shown.mask.ravel()).mean() - inside.mean() < 0.05
    assert (image.get_clip_path() is not None) == (domain is RING)
    # Another color takes the same pixels.
    monkeypatch.setattr(type(diagram), "locate", None)
    (again,) = plot_cells(diagram, -own).axes[0].images
    assert np.array_equal(again.get_array().filled(1), -shown.filled(-1))


def test_side_shares_are_complete(result):
    legend = plot_cells(result, "sides").axes[0].get_legend()
    shares = [float(re.search(r"([\d.]+)%", t.get_text())[1]) for t in legend.get_texts()]
    # Each share is rounded to 0.1.
    assert sum(shares) == pytest.approx(100, abs=0.05 * len(shares))


def test_infinite_values_have_the_color_beyond_the_scale(adapter):
    # The generator on the wall is not in the middle of its wall face.
    points = np.array([[0.3, 2.0], [-0.8, 2.2], [0.0, 2.7], [0.7, 2.5]])
    result = adapter.run(BOX, 0.5, points=points, method="lloyd", max_steps=0)
    assert np.isinf(result.measures.worst_of_cell("skewness")).tolist() == [True] + 3 * [False]
    (cells,) = of_kind(plot_cells(result, "skewness"), PolyCollection)
    cells.update_scalarmappable()
    largest = cells.to_rgba(cells.get_clim()[1])
    assert np.array_equal(cells.get_facecolor()[0], largest)
    assert (cells.get_facecolor()[:, 3] == 1).all()


def test_unknown_color_is_named(result):
    with pytest.raises(InputError, match=r"'hue'.*error, quality, size, sides, skewness"):
        plot_cells(result, "hue")


def test_result_plots_itself(result):
    assert len(of_kind(result.plot("sides", title="five and seven"), PolyCollection)) == 1


def test_size_field_is_sampled_right_way_up():
    figure = plot_size(lambda x: 1 + x[:, 0] + 10 * (x[:, 1] - 2), BOX)
    (image,) = figure.axes[0].images
    values = image.get_array()
    assert values[0, 0] == pytest.approx(0)
    assert values[0, -1] == pytest.approx(2)
    assert values[-1, 0] == pytest.approx(10)
    assert tuple(image.get_extent()) == (-1, 1, 2, 3)
    assert image.origin == "lower"


def test_history_is_drawn_as_recorded(results):
    figure = plot_history(results)
    error, quality = figure.axes
    assert error.get_yscale() == "log"
    drawn = [line.get_ydata() for line in error.lines]
    for number, result in enumerate(results.values()):
        assert np.array_equal(drawn[2 * number], result.history["mean_error"])
        assert np.array_equal(drawn[2 * number + 1], result.history["max_error"])
    assert np.array_equal(quality.lines[3].get_ydata(), results["coupled"].history["min_quality"])
    assert {"lloyd", "coupled"} <= {t.get_text() for t in figure.legends[0].get_texts()}


@pytest.mark.parametrize(
    ("value", "up", "rounded"),
    [(0.3, True, 0.5), (0.3, False, 0.2), (5.0, True, 5.0), (5.0, False, 5.0), (0.0, True, 1.0)],
)
def test_round_numbers(value, up, rounded):
    assert nice(value, up) == rounded


def test_a_closer_look_stays_in_the_domain(result, monkeypatch):
    monkeypatch.setitem(pictures.MANY_CELLS, "cells", 10)
    (draw,) = (d for name, _, d in pictures_of({"coupled": result}) if name == "closer")
    wide, close = draw().axes[:2]
    assert wide.get_xlim() == (BOX.lower[0], BOX.upper[0])
    small = dataclasses.replace(result, target_size=np.where(np.arange(len(result.points)) == 3, 0.004, 0.1))
    (draw,) = (d for name, _, d in pictures_of({"coupled": small}) if name == "closer")
    wide, close = draw().axes[:2]
    assert np.ptp(close.get_xlim()) == pytest.approx(0.16)
    assert np.mean(close.get_xlim()) == pytest.approx(result.points[3, 0], abs=0.16)


@pytest.mark.slow
def test_report_holds_its_pictures(results, adapter, tmp_path):
    first = results["coupled"].initial.points
    initial = adapter.run(BOX, size, points=first, max_steps=0)
    title, case, told = "Cells & <size>", '# a "case" <b>', []
    files = write_report(
        results, tmp_path, initial=initial, size=size, title=title, case=case, formats=("png", "svg"), tell=told.append
    )
    assert [line.split(",")[0] for line in told] == [f"picture {k} of 6" for k in range(1, 7)]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert files[0] == tmp_path / "report.html"
    assert all(file.stat().st_size > 500 for file in files)
    assert sorted(files) == sorted(p for p in tmp_path.rglob("*") if p.is_file())
    sources = re.findall(r'src="([^"]*)"', page)
    assert len(sources) == len([f for f in files if f.suffix == ".png"]) == 6
    for source in sources:
        kind, data = source.split(",")
        assert kind == "data:image/png;base64"
        assert base64.b64decode(data).startswith(b"\x89PNG")
    assert "<title>Cells &amp; &lt;size&gt;</title>" in page
    assert "&lt;b&gt;" in page
    for result in results.values():
        assert f"{np.abs(result.size_error).mean():.4f}" in page
        assert f"{result.quality.min():.3f}" in page


@pytest.mark.slow
def test_same_run_gives_the_same_page(result, tmp_path):
    for folder in ("a", "b"):
        write_report(result, tmp_path / folder, size=size)
    one, two = ((tmp_path / folder / "report.html").read_bytes() for folder in ("a", "b"))
    assert one == two


@pytest.mark.slow
def test_a_picture_that_fails_costs_no_other(result, tmp_path, monkeypatch):
    drawn = pictures_of({"coupled": result})

    def fail():
        raise MemoryError("no room for it")

    broken = [(name, caption, fail if k == 1 else draw) for k, (name, caption, draw) in enumerate(drawn)]
    monkeypatch.setattr(page, "pictures_of", lambda *_: broken)
    with pytest.raises(MemoryError, match="no room"):
        write_report(result, tmp_path)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert text.count("src=") == len(list(tmp_path.glob("pictures/*.png"))) == len(drawn) - 1


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)])
def test_few_cells_and_no_steps(adapter, tmp_path, n):
    tiny = adapter.run(BOX, 1.0, n_cells=n, max_steps=0, seed=99)
    assert tiny.initial is None
    assert (tmp_path / "report.html") == write_report(tiny, tmp_path)[0]


def test_pdf_is_a_pdf(result):
    figures = {name: draw for name, _, draw in pictures_of({"coupled": result})}
    assert render(figures["cells"](), "pdf").startswith(b"%PDF")
