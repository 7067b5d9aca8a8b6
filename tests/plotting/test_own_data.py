"""Pictures of data of the caller, and of diagrams without sizes."""

from itertools import pairwise

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError, InputTypeError
from clvoro.plotting.colors import _most

POINTS = np.random.default_rng(6).random((30, 3))


@pytest.fixture(scope="module", params=[2, 3])
def diagram(request, ctx):
    d = request.param
    return clvoro.Adapter(ctx).diagram(clvoro.Box((0,) * d, (1,) * d), POINTS[:, :d])


def colored(figure):
    """The values of the cells that are drawn first."""
    (cells,) = [c for c in figure.axes[0].collections if c.get_array() is not None]
    return cells


def labels(figure):
    axes = [a for ax in figure.axes for a in (ax, *ax.child_axes)]
    return {ax.get_xlabel() for ax in axes} | {ax.get_ylabel() for ax in axes}


@pytest.mark.sparse(1)
def test_own_data(diagram):
    values = np.arange(30) - 10
    figure = diagram.plot(values, label="pressure [Pa]")
    assert set(colored(figure).get_array()) <= set(values)
    assert "pressure [Pa]" in labels(figure)
    assert colored(figure).get_clim() == (-10, 19)
    constant = colored(diagram.plot(np.full(30, 7.0)))
    assert constant.get_clim()[0] < 7 < constant.get_clim()[1]
    gaps = np.where(values < 0, np.nan, values)
    assert np.isfinite(colored(diagram.plot(gaps)).get_clim()).all()


def test_few_values_far_from_the_others_do_not_set_the_scale():
    values = np.arange(1000.0)
    for far, ends in ((1e5, (10, 989)), (1900, (0, 1900)), (np.inf, (0, 998))):
        values[-1] = far
        assert _most(values) == pytest.approx(ends, abs=1)


@pytest.mark.sparse(1)
def test_diagrams(diagram):
    if diagram.domain.dim == 2:
        drawn = colored(diagram.plot()).get_array()
        np.testing.assert_array_equal(drawn, diagram.measures.quality)
    for color in ("sides", "skewness", "volume"):
        diagram.plot(color)
    for color in ("error", "size"):
        with pytest.raises(InputError, match=f"'{color}', which a diagram without sizes does not"):
            diagram.plot(color)
    assert "mine" in labels(diagram.plot("volume", label="mine"))


def test_coordinates_of_maps_have_all_digits(ctx):
    ring = np.add([(0, 0), (3000, 0), (3000, 2000), (0, 2000)], (3_500_000, 5_400_000))
    points = ring.mean(axis=0) + 500 * POINTS[:, :2]
    figure = clvoro.Adapter(ctx).diagram(clvoro.Polygon(ring), points).plot()
    figure.draw_without_rendering()
    for axis in (figure.axes[0].xaxis, figure.axes[0].yaxis):
        texts = [t.get_text() for t in axis.get_ticklabels()]
        assert all(t.isdigit() and len(t) == 7 for t in texts)
        assert not axis.get_offset_text().get_text()
    boxes = [t.get_window_extent() for t in figure.axes[0].get_xticklabels()]
    assert all(a.x1 < b.x0 for a, b in pairwise(boxes))


def test_views(diagram):
    if diagram.domain.dim == 2:
        figure = diagram.plot("volume", window=((0, 0), (0.5, 0.5)), edges=False, title="part")
        assert figure.axes[0].get_xlim() == (0, 0.5)
        seen = colored(figure).get_array()
        assert len(seen) < 30
        assert colored(figure).get_clim() == (seen.min(), seen.max())
        with pytest.raises(InputError, match="view is 'slice', expected one of cells for this mesh"):
            diagram.plot(view="slice")
        with pytest.raises(InputError, match="cut is an option of the view cutaway; the view cells has ax, label"):
            diagram.plot(cut=None)
    else:
        assert diagram.plot(view="slice", normal="x").axes[0].get_xlabel() == "y"
        diagram.plot(view="cutaway", cut=POINTS[:, 0] < 0.5, angles=(30, 30))
        with pytest.raises(InputError, match="ax is an option of the view cells and globe and slice and cutaway"):
            diagram.plot(ax="any")
        with pytest.raises(InputError, match="view is 'all', expected one of slices, slice"):
            diagram.plot(view="all")
        with pytest.raises(InputError, match="hue is no option; the view slices has figure, through"):
            diagram.plot(hue="size")


@pytest.mark.parametrize(
    ("color", "error", "message"),
    [
        (np.zeros(29), InputError, r"shape \(29,\), expected \(30,\)"),
        (np.zeros((30, 1)), InputError, "one number per cell"),
        (["a"] * 30, InputTypeError, "an array of real numbers"),
        ("shade", InputError, "expected one of error"),
    ],
)
def test_bad_colors(diagram, color, error, message):
    with pytest.raises(error, match=message):
        diagram.plot(color)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"limits": (1,)}, "expected two numbers"),
        ({"limits": (1, 1)}, "expected two numbers"),
        ({"window": (0, 0, 1, 1)}, "expected two corners"),
        ({"window": ((1, 1), (0, 0))}, "the lower left one first"),
        ({"window": ((5, 5), (6, 6))}, r"no cell is in the window \(5, 5\), \(6, 6\)"),
    ],
)
def test_bad_parts_and_scales(diagram, options, message):
    flat = diagram.domain.dim == 2
    if not flat and options.get("window", ((0, 0),))[0] == (5, 5):
        pytest.skip("a slice may show empty space")
    with pytest.raises(InputError, match=message):
        diagram.plot("volume", view=None if flat else "slice", **options)
