"""Sizes below the resolution of a precision cause an error or warning; others are met as in double precision."""

import warnings

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.adaptation import diagnostics
from clvoro.errors import InputError, PrecisionWarning
from clvoro.opencl.engine import Engine
from clvoro.sizing import Circle, Distance, Expression, Sizing

BOX = clvoro.Box((1, 0), (3, 1))
SPACING = {"float32": 2.0**-24 * 2, "float64": 2.0**-53 * 2}
"""Round-off of positions in the box above, whose frame has the unit 2."""


@pytest.fixture(params=list(SPACING))
def real(request):
    return request.param


def stage(ctx, real, size, box=BOX):
    engine = Engine(ctx, cl.CommandQueue(ctx), box.dim, np.dtype(real))
    return Sizing(engine, box, size)


def test_mean_ratio_of_spacing_to_h(ctx, real):
    points = BOX.lower + np.random.default_rng(5).random((50, 2)) * BOX.extent
    found = diagnostics.check_precision(stage(ctx, real, lambda x: 0.1 * x[:, 0]), BOX, points, 0.5)
    assert found == pytest.approx((SPACING[real] / (0.05 * points[:, 0])).mean(), rel=1e-5)


def test_warnings_and_errors_at_the_bounds(ctx, real):
    """A spacing of 1 / 16 of the least size, or 1e-2 of most sizes, gives a warning, one of the least size an error."""
    unit, points = SPACING[real], np.array([[1.5, 0.5]] * 99 + [[2.5, 0.5]])

    def check(size, size_beyond_2=1.0):
        field = stage(ctx, real, lambda x: np.where(x[:, 0] > 2, size_beyond_2, size))
        diagnostics.check_precision(field, BOX, points)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(unit / 0.0099)
        check(1.0, unit * 16.1)
    with pytest.warns(PrecisionWarning, match=f"{real} .* mean error of 0.001"):
        check(unit / 0.0103)
    with pytest.warns(PrecisionWarning, match="0.063 of the smallest"):
        check(1.0, unit * 15.9)
    with pytest.raises(InputError, match=r"coincide.*(float64|smaller domain)"):
        check(1.0, unit * 0.99)
    with pytest.warns(PrecisionWarning):
        check(1.0, unit * 1.01)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("noise", [1e-2, 1e-1])
@pytest.mark.parametrize(("box", "h"), [(clvoro.Box((0, 0), (1, 1)), 0.05), (clvoro.Box((0,) * 3, (1,) * 3), 0.15)])
def test_what_rounding_adds(ctx, box, h, noise):
    """Changes of up to half a spacing cost `ROUND_OFF_ERROR` on uniform meshes, to a third."""
    adapter = clvoro.Adapter(ctx)
    result = adapter.run(box, h, effort="fast", seed=1)
    by = np.random.default_rng(3).uniform(-noise, noise, result.points.shape) * h
    moved = adapter.diagram(box, np.clip(result.points + by, box.lower, box.upper))
    length = moved.volumes ** (1 / box.dim)
    change = np.abs((length - h) / np.minimum(length, h) - result.size_error).mean()
    assert 0.6 * diagnostics.ROUND_OFF_ERROR < change / (2 * noise) < 1.1 * diagnostics.ROUND_OFF_ERROR


def test_runs_say_it_before_they_begin(ctx):
    """A core of 1250 cells as small as 17 spacings of single precision, in a mesh of 11,000: only double meets it."""
    h = 1e-6
    box = clvoro.Box((0, 0), (1, 1))
    field = Expression(f"fmax({h}, 0.2*(hypot(x-0.5,y-0.5)-{20 * h}))")
    single, double = (clvoro.Adapter(ctx, real) for real in ("float32", "float64"))
    with pytest.warns(PrecisionWarning, match="use dtype='float64'"):
        single.run(box, field, method="weighted", max_steps=0, seed=5)
    with pytest.raises(InputError, match="would coincide; use dtype='float64'"):
        single.run(box, 0.04 * field, method="weighted", max_steps=0, n_cells=2000, seed=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error", PrecisionWarning)
        double.run(box, field, method="weighted", max_steps=0, seed=5)


@pytest.mark.slow
def test_single_precision_with_sizes_1_to_1000(ctx):
    """The mean error is that of double precision to 1e-3, without a warning."""
    box = clvoro.Box((0, 0), (2.5, 1.5))
    field = Distance([Circle((0.9, 0.75), 0.0)], 1.5e-4, slope=999 * 1.5e-4 / 1.767)
    mean = {}
    for real in SPACING:
        with warnings.catch_warnings():
            warnings.simplefilter("error", PrecisionWarning)
            result = clvoro.Adapter(ctx, real).run(box, field, effort="default", seed=2)
        h = field(result.points)
        length = np.sqrt(result.diagram.volumes)
        mean[real] = (np.abs(length - h) / np.minimum(length, h)).mean()
        assert h.max() > 700 * h.min()
    assert mean["float64"] < 0.004
    assert mean["float32"] < mean["float64"] + 1e-3


def test_edges_on_a_sphere_in_single_precision(ctx):
    """Corners are rounded to 2^-24 of the radius, and the shortest edges are 0.13 h: at 5e-3 they lose four digits."""
    sphere = clvoro.Sphere(2)
    engine = Engine(ctx, cl.CommandQueue(ctx), 3, np.dtype(np.float32), sphere.traits(np.dtype(np.float32)))
    points = sphere.even_points(200)
    limit = 2 * 2**-24 / (1e-4 * 0.13)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        diagnostics.check_precision(Sizing(engine, sphere, 1.02 * limit), sphere, points)
    half = Expression(f"z > 0 ? {0.5 * limit} : {2 * limit}")
    with pytest.warns(PrecisionWarning, match=r"off by up to 0\.0002 .* in 50% of the cells .*dtype='float64'"):
        diagnostics.check_precision(Sizing(engine, sphere, half), sphere, points)
