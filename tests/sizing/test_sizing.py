"""Size fields: the device against NumPy, the grammar of expressions, what is refused."""

import functools
import math

import numpy as np
import pytest
import shapely

from clvoro import sizing
from clvoro.adapter import Adapter
from clvoro.errors import InputError, InputTypeError, SizeFieldError
from clvoro.geometry.box import Box
from clvoro.opencl.engine import Engine

N = 3001
PLANE = Box((-0.7, 100.2), (1.8, 101.7))  # away from the origin: normalization matters
SPACE = Box((0.5, -2.0, 3.0), (1.5, -1.2, 4.4))

_rng = np.random.default_rng(20240611)


def _wavy(n, center, radius):
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)
    r = radius * (1 + 0.2 * np.cos(7 * t))
    return np.column_stack([center[0] + r * np.cos(t), center[1] + r * np.sin(t)])


def _within(box, n, margin=0.0):
    return _rng.uniform(np.subtract(box.lower, margin), np.add(box.upper, margin), (n, box.dim))


_CIRCLE = sizing.Distance(sizing.Circle((0.2, 100.9), 0.3), 0.02, growth=1.3)
_ENDS = _within(PLANE, 60, 0.3).reshape(30, 2, 2)
_SEGMENTS = [sizing.Segment(a, a + 0.1 * (b - a)) for a, b in _ENDS]
_CIRCLES = [sizing.Circle(c, r) for c, r in zip(_within(PLANE, 40), _rng.uniform(0, 0.4, 40), strict=True)]
_HELIX = np.column_stack(
    [
        1 + 0.3 * np.cos(np.linspace(0, 20, 300)),
        -1.6 + 0.3 * np.sin(np.linspace(0, 20, 300)),
        np.linspace(3.1, 4.3, 300),
    ]
)
_IMAGE = _rng.uniform(0.1, 0.3, (17, 23))

PLANE_FIELDS = {
    "constant": sizing.Constant(0.05),
    "circle": _CIRCLE,
    "point": sizing.Distance(sizing.Circle((0.2, 100.9), 0), 0.02, slope=0.2),
    "capped": sizing.Distance(sizing.Segment((0, 100.5), (1, 101)), 0.01, slope=0.5, h_max=0.1),
    "flat": sizing.Distance(sizing.Segment((0, 100.5), (1, 101)), 0.01, growth=1),
    "polygon": sizing.Distance(sizing.ClosedPolyline(_wavy(700, (0.5, 101), 0.4)), 0.001, growth=1.1),
    "polygon capped": sizing.Distance(
        sizing.ClosedPolyline(_wavy(700, (0.5, 101), 0.4)), 0.001, growth=1.1, h_max=0.004
    ),
    "polyline": sizing.Distance(sizing.Polyline(_wavy(9, (0.5, 101), 0.4)), 0.01, growth=1.1),
    "polygon 9": sizing.Distance(sizing.ClosedPolyline(_wavy(9, (0.5, 101), 0.4)), 0.01, growth=1.1),
    "mixed": sizing.Distance([*_SEGMENTS, *_CIRCLES], 0.01, growth=1.5),
    "zero segments": sizing.Distance(
        [sizing.Polyline([(0, 101), (0, 101), (1, 101)]), sizing.Segment((1, 101), (1, 101))], 0.01, slope=1
    ),
    "raster": sizing.Raster(_IMAGE, (-0.5, 100.4), (1.5, 101.5)),
    "raster centers": sizing.Raster(_IMAGE, (-0.7, 100.2), (1.8, 101.7), at="centers"),
    "raster row": sizing.Raster(_IMAGE[:1], (-0.7, 100.2), (1.8, 101.7)),
    "raster one": sizing.Raster([[3]], (-0.7, 100.2), (1.8, 101.7)),
    "expression": sizing.Expression("0.02 + 0.3*fabs(hypot(x-0.2, y-100.9)-0.3)"),
    "scaled": 2 * _CIRCLE,
    "halved": _CIRCLE / 2,
    "sum": _CIRCLE + 0.01 + sizing.Expression("0.1*(y - 100)"),
    "product": _CIRCLE * sizing.Raster(_IMAGE * 10, (-1, 100), (2, 102)) * 2,
    "quotient": 0.5 * _CIRCLE / sizing.Expression("1 + 0.3*sin(3*x)") / 3,
    "reciprocal": 0.02 / (0.3 + _CIRCLE),
    "minimum": sizing.minimum(_CIRCLE, 0.1, sizing.Raster(_IMAGE, (-1, 100), (2, 102))),
    "maximum": sizing.maximum(_CIRCLE * 0.5, sizing.Expression("0.05*(y > 101)"), 0.03),
}
SPACE_FIELDS = {
    "constant": sizing.Constant(0.05),
    "sphere": sizing.Distance(sizing.Ball((1, -1.6, 3.5), 0.25), 0.04, slope=0.3),
    "helix": sizing.Distance(sizing.Polyline(_HELIX), 0.004, growth=1.2),
    "raster": sizing.Raster(_rng.uniform(1, 2, (5, 6, 7)), (0.5, -2.0, 3.0), (1.5, -1.2, 4.4)),
    "raster slab": sizing.Raster(_rng.uniform(1, 2, (5, 1, 7)), (0.5, -2.0, 3.0), (1.5, -1.2, 4)),
    "expression": sizing.Expression("0.1 + 0.01*(x*y*z > 0 ? x : z)"),
    "minimum": sizing.minimum(sizing.Expression("0.1*z"), 0.35) * 2,
    "segment": sizing.Distance(sizing.Segment((0.6, -2, 3), (1.4, -1.3, 4)), 0.02, slope=0.3),
    "product": sizing.Expression("1 + 0.1*x*z") * sizing.Distance(sizing.Ball((1, -1.6, 3.5), 0.25), 0.04, slope=0.3),
    "quotient": 0.3 / (sizing.Expression("2 + sin(5*y)") / 2 + 1),
    "box": sizing.Distance(Box((0.7, -1.9, 3.2), (1.4, -1.4, 4.1)), 0.01, growth=1.2),
}
CASES = [
    *(pytest.param(PLANE, f, id=f"2D {k}") for k, f in PLANE_FIELDS.items()),
    *(pytest.param(SPACE, f, id=f"3D {k}") for k, f in SPACE_FIELDS.items()),
]


@pytest.fixture
def double(queue):
    return lambda dim: Engine(queue.context, queue, dim, np.dtype("float64"))


def _tolerance(engine, domain, field):
    """Rounding of a few operations on coordinates of size 1, seen in h (slopes are < 30).

    Expressions compute with physical coordinates, which have `largest` in place of 1.
    """
    largest = np.abs([domain.lower, domain.upper]).max()
    in_physical = "Expression" in repr(field)
    return 100 * np.finfo(engine.real).eps * domain.frame[1] * (largest if in_physical else 1)


def _device_points(engine, domain, points):
    origin, scale = domain.frame
    return engine.upload((points - origin) / scale)


@pytest.mark.sparse(16)
@pytest.mark.parametrize(("domain", "field"), CASES)
def test_device_agrees_with_numpy(make_engine, domain, field):
    engine = make_engine(domain.dim)
    stage = sizing.Sizing(engine, domain, field)
    points = _device_points(engine, domain, _within(domain, N))
    h = engine.zeros(N + 5)
    stage.evaluate(points, N, h)
    stage.check(points, h)
    # The reference is evaluated at the rounded points, so the difference is the error of the kernel.
    origin, scale = domain.frame
    exact = field(points.get().astype(float) * scale + origin)
    assert np.all(exact > 0)
    near_jump = np.zeros(N, bool)
    if ">" in repr(field):  # on either side of a jump either value is right
        x = points.get().astype(float) * scale + origin
        near_jump = np.abs(x[:, 1] - 101) < 1e-3
    error = np.abs(h.get()[:N] * scale - exact)[~near_jump]
    assert error.max() <= _tolerance(engine, domain, field)
    assert not h.get()[N:].any()


@pytest.mark.sparse(16)
@pytest.mark.parametrize(("domain", "field"), CASES)
def test_gradient(make_engine, domain, field):
    """Against the host's own central differences over the same stretch."""
    engine = make_engine(domain.dim)
    stage = sizing.Sizing(engine, domain, field)
    points = _device_points(engine, domain, _within(domain, 400))
    h, gradient = engine.empty(400), engine.empty((400, domain.dim))
    stage.evaluate_with_gradient(points, 400, h, gradient)
    origin, scale = domain.frame
    x = points.get().astype(float)
    size = field(x * scale + origin) / scale
    step = size * (1e-3 if engine.real == np.float64 else 5e-2)
    noise = _tolerance(engine, domain, field) / scale / (step * size)
    jumps = ">" in repr(field)
    for a in range(domain.dim):
        ahead, behind = x.copy(), x.copy()
        ahead[:, a] = np.minimum(x[:, a] + step, domain.extent[a] / scale)
        behind[:, a] = np.maximum(x[:, a] - step, 0)
        rise = (field(ahead * scale + origin) - field(behind * scale + origin)) / scale
        expected = rise / ((ahead - behind)[:, a] * size)
        # The device rounds ahead - behind to its precision: a relative error of eps / step.
        eps = 4 * np.finfo(engine.real).eps / step
        off = np.abs(gradient.get()[:, a] - expected) > 2 * noise + eps * (1 + np.abs(expected))
        assert np.count_nonzero(off) <= (2 if jumps else 0)
    assert np.abs(h.get() - size).max() <= _tolerance(engine, domain, field)


def test_gradient_of_a_cone(make_engine):
    """Grad log h of h = h0 + slope r is slope / h along r, for cells of 1/1000 of the box too."""
    engine = make_engine(2)
    domain = Box((0, 0), (1, 1))
    field = sizing.Distance(sizing.Circle((0.4, 0.4), 0), 1e-3, slope=0.3)
    rng = np.random.default_rng(515)
    x = 0.4 + rng.uniform(0.01, 0.5, 500)[:, None] * [0.6, 0.8]
    points = engine.upload(x)
    h, gradient = engine.empty(500), engine.empty((500, 2))
    sizing.Sizing(engine, domain, field).evaluate_with_gradient(points, 500, h, gradient)
    expected = 0.3 / field(x)[:, None] * [0.6, 0.8]
    # In float32 4e-3 of the slope is allowed: rounding of h (1e-7) over 2 * 5 % of h = 4e-3.
    allowed = 1e-6 if engine.real == np.float64 else 2e-2
    assert np.abs(gradient.get() / expected - 1).max() < allowed


def test_bits_repeat(make_engine):
    engine = make_engine(2)
    points = _device_points(engine, PLANE, _within(PLANE, N))
    found = []
    for _ in range(2):
        h, gradient = engine.empty(N), engine.empty((N, 2))
        stage = sizing.Sizing(engine, PLANE, PLANE_FIELDS["mixed"])
        stage.evaluate_with_gradient(points, N, h, gradient)
        found.append((h.get(), gradient.get()))
    assert all(np.array_equal(a, b) for a, b in zip(*found, strict=True))


def test_formulas_that_differ_in_numbers_share_a_kernel():
    """All numbers are data, but the exponents of pow."""
    first, second, other = (
        sizing.generate_code(sizing.Expression(text), PLANE)
        for text in ("0.1 + 2*pow(x, -3)", "0.7 + 5*pow(x, -3)", "0.1 + 2*pow(x, -2)")
    )
    assert first.prelude == second.prelude != other.prelude
    assert (first.data != second.data).sum() == 2


@pytest.mark.sparse(1)
def test_callable_is_evaluated_on_the_host(make_engine):
    engine = make_engine(2)
    seen = []

    def cone(x):
        seen.append(x)
        return 0.02 + 0.3 * np.hypot(x[:, 0], x[:, 1] - 101)

    twin = sizing.Expression("0.02 + 0.3*hypot(x, y - 101)")
    host = sizing.Sizing(engine, PLANE, sizing.minimum(cone, 0.3))
    device = sizing.Sizing(engine, PLANE, sizing.minimum(twin, 0.3))
    assert host.prelude is None
    points = _device_points(engine, PLANE, _within(PLANE, N))
    results = []
    for stage in (host, device):
        h, gradient = engine.empty(N), engine.empty((N, 2))
        stage.evaluate_with_gradient(points, N, h, gradient)
        h1 = engine.empty(N)
        stage.evaluate(points, N, h1)
        assert np.array_equal(h1.get(), h.get())
        results.append((h.get(), gradient.get()))
    tolerance = _tolerance(engine, PLANE, twin)
    assert np.abs(results[0][0] - results[1][0]).max() < tolerance
    smooth = np.abs(results[0][0] * PLANE.frame[1] - 0.3) > 0.03  # the kink is seen over other steps
    smooth &= results[0][0] * PLANE.frame[1] > 0.1  # and so is the tip
    step = 1e-3 if engine.real == np.float64 else 5e-2
    off = np.abs(results[0][1] - results[1][1])[smooth]
    assert off.max() < tolerance / (step * 0.03**2) + step**2
    for x in seen:
        assert x.dtype == np.float64
        assert PLANE.contains(x).all()


@pytest.mark.sparse(1)
def test_parts_of_a_mixed_field_run_on_the_device(make_engine, monkeypatch):
    """Beside a callable the rest is still evaluated on the device, also where it is negative."""
    engine = make_engine(2)
    polygon = PLANE_FIELDS["polygon"]
    field = 0.5 * sizing.maximum(
        sizing.minimum(lambda x: 0.05 + 0.1 * np.abs(x[:, 0]), polygon), sizing.Expression("0.02*(x - 0.5)")
    )
    points = _within(PLANE, 500)
    expected = field(points)
    stage = sizing.Sizing(engine, PLANE, field)
    monkeypatch.setattr(sizing.Distance, "distance", None)
    assert stage.prelude is None
    assert np.abs(stage(points) - expected).max() < _tolerance(engine, PLANE, field)
    x, h, slope = _device_points(engine, PLANE, points), engine.empty(500), engine.empty((500, 2))
    stage.evaluate_with_gradient(x, 500, h, slope)
    stage.check(x, h)
    assert np.abs(h.get() * PLANE.frame[1] - expected).max() < _tolerance(engine, PLANE, field)
    # |grad h| is at most the largest slope, ln 1.1 or 0.1, halved; the rest is rounding.
    bound = 0.055 + (1e-6 if engine.real == np.float64 else 0.05)
    assert np.abs(slope.get() * h.get()[:, None]).max() < bound


@pytest.mark.slow
def test_operators_are_those_of_numbers(double):
    a = sizing.Expression("1 + x")
    b = sizing.Expression("2 + y*y")
    domain = Box((0, 0), (3, 1))
    x = np.random.default_rng(88).uniform(domain.lower, domain.upper, (60, 2))
    u, v = 1 + x[:, 0], 2 + x[:, 1] ** 2
    for field, expected in (
        (a + b, u + v),
        (a * b, u * v),
        (a / b, u / v),
        (b / a, v / u),
        (2 * a, 2 * u),
        (a * 2, 2 * u),
        (a / 4, u / 4),
        (3 / a, 3 / u),
        (1 + a, 1 + u),
        (a * (lambda p: p[:, 1] + 1), u * (x[:, 1] + 1)),
        ((lambda p: p[:, 1] + 1) / a, (x[:, 1] + 1) / u),
        (np.float32(0.5) * a, 0.5 * u),
        (a * b + a / b * 2, u * v + 2 * u / v),
    ):
        assert field(x) == pytest.approx(expected, rel=1e-14)
        assert sizing.Sizing(double(2), domain, field)(x) == pytest.approx(expected, rel=1e-13)


def test_gradient_of_a_product(double):
    engine, domain = double(2), Box((0, 0), (3, 1))
    field = sizing.Expression("1 + x*x") * sizing.Expression("0.01*(2 + y)") / (sizing.Expression("1 + x*y"))
    x = np.random.default_rng(87).uniform((0.1, 0.1), (2.9, 0.9), (60, 2))
    scale = domain.frame[1]
    h, slope = engine.empty(60), engine.empty((60, 2))
    sizing.Sizing(engine, domain, field).evaluate_with_gradient(_device_points(engine, domain, x), 60, h, slope)
    a, b = x.T
    expected = [2 * a / (1 + a * a) - b / (1 + a * b), 1 / (2 + b) - a / (1 + a * b)]
    # Differences over 1e-3 of h, of the order of 1e-4: second order in that.
    assert slope.get().T / scale == pytest.approx(np.array(expected), abs=1e-6)


def test_distance_to_simple_shapes():
    """Numbers that can be verified by mental arithmetic."""
    points = [(0, 0), (3, 4), (5, 0), (-1, 2)]
    ring = sizing.Distance(sizing.Circle((0, 0), 2), 1, slope=1)
    assert ring(points).tolist() == pytest.approx([3, 4, 4, math.sqrt(5) - 1])
    square = sizing.Distance(sizing.ClosedPolyline([(0, 0), (4, 0), (4, 4), (0, 4)]), 1, slope=1)
    assert square([(2, 1), (1, 2), (-3, -4), (5, 2)]).tolist() == [2, 2, 6, 2]
    line = sizing.Distance(sizing.Polyline([(0, 0), (4, 0), (4, 4)]), 1, slope=1, h_max=2.5)
    assert line([(0, 2), (2, 1), (4, 6), (3, 3)]).tolist() == [2.5, 2, 2.5, 2]
    growing = sizing.Distance(sizing.Segment((0, 0), (0, 1)), 1, growth=math.e)
    assert growing([(3, 0.5)]).tolist() == pytest.approx([4])


def test_distance_to_geometries_of_shapely_and_geojson():
    """All points, lines and rings count, in collections and multipolygons, too: shapely measures the same."""
    court = shapely.box(0, 0, 4, 4).difference(shapely.box(1, 1, 2, 3))
    lines = shapely.MultiLineString([[(6, 0), (7, 2), (9, 2)], [(8, 8), (9, 9)]])
    places = shapely.MultiPoint([(-3, 5), (-4, 6)])
    geometry = shapely.GeometryCollection([court, lines, places])
    points = np.random.default_rng(2).uniform(-5, 10, (200, 2))
    edges = shapely.GeometryCollection([court.boundary, lines, places])
    expected = 1 + 0.5 * shapely.distance(edges, shapely.points(points))
    for shapes in (geometry, [court, lines, places], shapely.to_geojson(geometry)):
        assert sizing.Distance(shapes, 1, slope=0.5)(points) == pytest.approx(expected, rel=1e-12)
    with pytest.raises(InputError, match="not empty"):
        sizing.Distance(shapely.Polygon(), 1, slope=0.5)
    with pytest.raises(InputError, match="got no shapes, expected at least one"):
        sizing.Distance({"type": "FeatureCollection", "features": []}, 1, slope=0.5)
    with pytest.raises(InputError, match=r"length 1e\+160, expected at most"):
        sizing.Distance(shapely.Point(0, 1e160), 1, slope=0.5)


def test_growth_is_the_ratio_of_neighboring_cells():
    """Cells laid end to end, each as long as h at its middle, grow by g (to first order)."""
    field = sizing.Distance(sizing.Segment((0, -1), (0, 1)), 0.01, growth=1.05)
    edge, lengths = 0.0, []
    for _ in range(20):
        length = 0.01
        for _ in range(50):
            length = field([(edge + length / 2, 0)])[0]
        lengths.append(length)
        edge += length
    assert np.divide(lengths[1:], lengths[:-1]) == pytest.approx(1.05, abs=1e-3)


def test_raster_convention():
    values = [[1, 2, 3], [4, 5, 7]]  # row 0 at the bottom
    field = sizing.Raster(values, (0, 0), (2, 1))
    inside = field([(0, 0), (1, 0), (2, 1), (0.5, 0.5), (1.5, 1)])
    assert inside.tolist() == [1, 2, 7, 3, 6]
    assert field([(-5, 0), (5, 0.5), (1, 9)]).tolist() == [1, 5, 5]
    pixels = sizing.Raster(values, (0, 0), (3, 2), at="centers")
    assert pixels([(0.5, 0.5), (1, 0.5), (3, 2), (0, 1)]).tolist() == [1, 1.5, 7, 2.5]


ACCEPTED = {
    "1/2": 0.5,
    "7/2*2": 7,
    "1-2-3": -4,
    "2+3*4": 14,
    "(2+3)*4": 20,
    "-2*-3": 6,
    "- - 3": 3,
    "!0 + !5": 1,
    "1e-3 + .5 + 2. + 1E2": 102.501,
    "pi": math.pi,
    "x + 10*y": 2.3 + 17,
    "x < y ? 1 : 2": 2,
    "x > y ? 1 : x > 2 ? 3 : 4": 1,
    "x < y ? 1 : x < 2 ? 3 : 4": 4,
    "1 + (x > 1 && y > 1)": 2,
    "(x > 1 && y > 2) || x == 2.3": 1,
    "1 || 0 && 0": 1,
    "1 < 2 == 1": None,  # chained
    "(1 < 2) == 1": 1,
    "x != y": 1,
    "2 >= 2": 1,
    "3 <= 2": 0,
    "min(x, y) + max(x, y)": 4.0,
    "fmin(x, y) * fmax(x, y)": 2.3 * 1.7,
    "pow(x, 2) - x*x + 1": 1,
    "hypot(3, 4)": 5,
    "abs(-2) + fabs(-2)": 4,
    "sqrt(16) + cbrt(27)": 7,
    "exp(0) + exp2(3) + log(1) + log2(8) + log10(100)": 14,
    "sin(0) + cos(0) + tan(0)": 1,
    "asin(1) + acos(1) + atan(1) + atan2(1, 0)": 1.25 * math.pi,
    "sinh(0) + cosh(0) + tanh(0)": 1,
    "floor(2.7) + ceil(2.2) + fmod(7, 4)": 8,
    "clamp(x, 0, 2) + mix(1, 3, 0.25)": 3.5,
    "step(2, x) + step(3, x) + smoothstep(0, 1, 0.5)": 1.5,
    "  x\n+\ty ": 4.0,
    "(" * 35 + "x" + ")" * 35: 2.3,
    "+".join(["x"] * 900): 900 * 2.3,
    "-" * 1000 + "x": 2.3,
}

REFUSED = {
    "": "empty",
    "   ": "empty",
    "x; y": "';'",
    "x } y": "'}'",
    "__import__('os')": "unknown name '__import__'",
    "x.__class__": "'.'",
    "get_global_id(0)": "get_global_id",
    "data[0]": "data",
    "x[0]": r"'\['",
    "*x": "'\\*'",
    "&x": "'&'",
    "x = 1": "'='",
    "x += 1": "'='",
    "x, y": "','",
    "printf(x)": "printf",
    "while(1)": "while",
    "x /* y */ + 1": "'\\*'",
    "x // y": "'/'",
    "#define x": "'#'",
    "x \\\n y": "'",
    '"x"': "'",
    "w + 1": "unknown name 'w'",
    "X": "unknown name 'X'",
    "sin": r"expected '\('",
    "sin()": "sin got 0 arguments, expected 1",
    "sin(x": r"expected '\)' after '\(', got the end",
    "sin(x, y)": "sin got 2 arguments, expected 1",
    "pow(x)": "pow got 1 arguments, expected 2",
    "(x": r"expected '\)' after '\('",
    "x)": "unexpected",
    "x +": "ends where",
    "x y": "column 3, .*unexpected 'y', expected an operator",
    "x (y)": "'x' is not a function",
    "x ? (1 : 2)": "unexpected ':'",
    "x : 1 ? 2": "unexpected ':'",
    "x +\n": "ends where",
    "2x": "'2x' is not a number",
    "0.5f": "without suffix",
    "0x10": "is not a number",
    "1e": "is not a number",
    "1..2": "is not a number",
    "1e999": "too large",
    "x ? 1": "expected ':'",
    "x ** 2": r"pow\(a, b\)",
    "x ^ 2": r"'\^'",
    "x % 2": "'%'",
    "1 < x < 2": "chained",
    "1 < 2 == 1": "chained",
    "x\u00b2": "unexpected character",
    "\u0661": "unexpected character",
    "x\0": "unexpected character",
    "(" * 41 + "x" + ")" * 41: "nested",
    "(" * 3000: "nested",
    "sin(" * 900: "nested",
    "x?1:" * 900 + "1": "nested",
    "x+" * 5000 + "x": "characters",
}


@pytest.mark.parametrize("text", [t for t, v in ACCEPTED.items() if v is not None])
def test_expression_accepts(text):
    value = sizing.Expression(text)([(2.3, 1.7)])
    assert value.shape == (1,)
    assert value[0] == pytest.approx(ACCEPTED[text], rel=1e-13)


@pytest.mark.parametrize("text", REFUSED)
def test_expression_rejects(text):
    with pytest.raises(InputError, match=REFUSED[text]):
        sizing.Expression(text)


def test_expression_names_the_column():
    with pytest.raises(InputError, match="column 9, near 'x \\+ sin\\(q\\)'"):
        sizing.Expression("x + sin(q)")


@pytest.mark.parametrize("text", [None, 3, b"x"])
def test_expression_needs_a_string(text):
    with pytest.raises(InputTypeError, match="string"):
        sizing.Expression(text)


def test_accepted_expressions_agree_on_the_device(double):
    """All accepted formulas, device against NumPy: the short ones in one sum, with a weight each."""
    engine = double(2)
    domain = Box((1, 1), (3, 3))
    points = np.random.default_rng(808).uniform(1, 3, (50, 2))
    texts = [t for t, v in ACCEPTED.items() if v is not None]
    short = " + ".join(f"{k} * ({t})" for k, t in enumerate(texts, start=1) if len(t) < 50)
    for text in (short, *(t for t in texts if len(t) >= 50)):
        field = sizing.Expression(f"1000 + ({text})")  # positive
        # 1e-12 of 1000: a few ulp of each function.
        assert sizing.Sizing(engine, domain, field)(points) == pytest.approx(field(points), rel=1e-12)


def test_z_needs_three_dimensions(double):
    field = sizing.Expression("0.1 + z*z")
    with pytest.raises(InputError, match="3 dimensions"):
        sizing.Sizing(double(2), PLANE, field)
    with pytest.raises(InputError, match="3 dimensions"):
        field([(0, 0)])
    with pytest.raises(InputError, match="dimensions"):
        sizing.minimum(field, _CIRCLE)


BAD_VALUES = {
    "zero": (sizing.Expression("x > 1 ? 0 : 1"), "0"),
    "negative": (sizing.Expression("1 - x"), "-"),
    "nan": (sizing.Expression("sqrt(1 - x)"), "nan"),
    "infinite": (sizing.Expression("x > 1 ? 1/0 : 1"), "inf"),
    "nan under a minimum": (sizing.minimum(sizing.Expression("log(1 - x)*0 + 1"), 1), "nan"),
    "raster": (sizing.Raster([[1, -1]], (0, 0), (2, 1)), "-|0"),
    "divided by zero": (1 / sizing.Expression("x > 1 ? 0 : 1"), "inf"),
    "negative factor": (sizing.Expression("1 - x") * sizing.Constant(2), "-"),
    "callable": (sizing.Function(lambda p: 1 - p[:, 0]), "-"),
}


@pytest.mark.parametrize("field", [sizing.Expression("0.1 + x / 3"), lambda p: 0.1 + p[:, 0] / 3])
def test_sizes_times_a_factor(make_engine, field):
    """To the last bit the product of both, on the device and on the host."""
    engine, domain = make_engine(2), Box((0, 0), (2, 1))
    stage = sizing.Sizing(engine, domain, field)
    x = _device_points(engine, domain, _within(domain, N))
    h, scaled = engine.empty(N), engine.empty(N)
    stage.evaluate(x, N, h)
    stage.evaluate(x, N, scaled, 1.7)
    assert np.array_equal(scaled.get(), engine.real.type(1.7) * h.get())


@pytest.mark.sparse(3)
@pytest.mark.parametrize("case", BAD_VALUES)
@pytest.mark.parametrize("gradient", [False, True])
def test_invalid_sizes_are_reported_with_their_place(make_engine, case, gradient):
    field, value = BAD_VALUES[case]
    engine = make_engine(2)
    domain = Box((0, 0), (2, 1))
    # Half a size beside x = 1, because samples for the gradient of a callable are refused, too.
    points = np.array([(0.1, 0.5), (0.3, 0.5), (1.75, 0.25), (1.9, 0.5), (0.2, 0.2)])
    stage = sizing.Sizing(engine, domain, field)
    x, h, slope = _device_points(engine, domain, points), engine.empty(5), engine.empty((5, 2))

    def evaluate(n):
        if gradient:
            stage.evaluate_with_gradient(x, n, h, slope)
        else:
            stage.evaluate(x, n, h)
        stage.check(x, h)

    evaluate(2)
    for _ in range(2):  # the second time, too
        with pytest.raises(SizeFieldError, match=rf"is .*{value}.* at \(1.75, 0.25\)"):
            evaluate(5)
        evaluate(2)
    with pytest.raises(SizeFieldError, match=r"\(1.75, 0.25\)"):
        stage(points)


@pytest.mark.sparse(1)
def test_sizes_beyond_the_domain_and_the_precision(make_engine):
    """A size larger than the domain is valid; one outside the range of the precision is not."""
    engine = make_engine(2)
    domain = Box((0, 0), (2, 1))
    points = np.array([(0.5, 0.5), (0.0, 1.0)])
    assert sizing.Sizing(engine, domain, 1e9)(points) == pytest.approx(1e9, rel=1e-6)
    h, gradient = engine.empty(2), engine.empty((2, 2))
    stage = sizing.Sizing(engine, domain, sizing.Expression("1e9*(1 + x)"))
    stage.evaluate_with_gradient(_device_points(engine, domain, points), 2, h, gradient)
    rise = gradient.get()[:, 0]
    # The stretch is then the whole domain: (h(2) - h(0)) / (2 h(x)), times the scale of 2.
    assert rise == pytest.approx([2 / 1.5, 2.0], rel=1e-5)
    tiny = sizing.Sizing(engine, domain, sizing.Expression("1e-60 * (1 + x)"))
    if engine.real == np.float64:
        assert tiny(points).max() < 2e-60
    else:
        with pytest.raises(SizeFieldError):
            tiny(points)
    # Sizes that float64 holds, but not (L - h) / L or h^-2. Numbers beyond float32 are not clipped.
    for huge in (3e9, 1e39, 1e300, sizing.Expression("x > 0.2 ? 1e100 : 1"), lambda x: 1e200 + x[:, 0]):
        with pytest.raises(SizeFieldError, match="at most 2e"):
            sizing.Sizing(engine, domain, huge)(points)
        with pytest.raises(SizeFieldError, match="at most 2e"):
            Adapter(engine.ctx, engine.real).run(domain, huge, n_cells=3, max_steps=0)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: sizing.Constant(0), InputError, "positive"),
        (lambda: sizing.Constant(float("nan")), InputError, "nan"),
        (lambda: sizing.Constant("1"), InputTypeError, "positive number"),
        (lambda: sizing.Constant(True), InputTypeError, "True"),
        (lambda: sizing.Circle((0, 0), -1), InputError, "radius"),
        (lambda: sizing.Circle((0, 0), "1"), InputTypeError, "radius"),
        (lambda: sizing.Circle((0,), 1), InputError, "2 or 3 coordinates"),
        (lambda: sizing.Circle("ab", 1), InputTypeError, "center"),
        (lambda: sizing.Segment((0, 0), (1, 1, 1)), InputError, "same number"),
        (lambda: sizing.Segment((0, float("inf")), (1, 1)), InputError, "finite"),
        (lambda: sizing.Polyline([(0, 0)]), InputError, "at least 2"),
        (lambda: sizing.ClosedPolyline([(0, 0), (1, 1)]), InputError, "at least 3"),
        (lambda: sizing.ClosedPolyline(np.zeros((5, 4))), InputError, "shape"),
        (lambda: sizing.Distance([], 1, growth=1.2), InputError, "no shapes"),
        (lambda: sizing.Distance([(0, 0)], 1, growth=1.2), InputTypeError, "tuple"),
        (lambda: sizing.Distance(_CIRCLES, 1), InputError, "exactly one"),
        (lambda: sizing.Distance(_CIRCLES, 1, growth=1.2, slope=1), InputError, "exactly one"),
        (lambda: sizing.Distance(_CIRCLES, 1, slope=-1), InputError, "slope"),
        (lambda: sizing.Distance(_CIRCLES, 0, slope=1), InputError, "h_min"),
        (lambda: sizing.Distance(_CIRCLES, 1, slope=1, h_max=0.5), InputError, "h_max"),
        (
            lambda: sizing.Distance([sizing.Circle((0, 0), 1), sizing.Circle((0, 0, 0), 1)], 1, 1.1),
            InputError,
            "2 and of 3",
        ),
        (lambda: sizing.Raster([1, 2], (0, 0), (1, 1)), InputError, "shape"),
        (lambda: sizing.Raster([["a"]], (0, 0), (1, 1)), InputTypeError, "type"),
        (lambda: sizing.Raster([[1]], (0, 0, 0), (1, 1, 1)), InputError, "corners"),
        (lambda: sizing.Raster([[1]], (0, 0), (1, 1), at="edges"), InputError, "at="),
        (lambda: sizing.Function(3), InputTypeError, "callable"),
        (lambda: sizing.as_field(-3), InputError, "-3"),
        (lambda: _CIRCLE * 0, InputError, "factor"),
        (lambda: _CIRCLE * "2", TypeError, "multiply"),
        (lambda: _CIRCLE + "2", TypeError, "operand"),
        (lambda: _CIRCLE / 0, InputError, "divisor"),
        (lambda: "2" / _CIRCLE, TypeError, "operand"),
        (lambda: 0 / _CIRCLE, InputError, "positive"),
        (lambda: _CIRCLE * sizing.Expression("z"), InputError, "dimensions"),
        (lambda: sizing.minimum(), InputError, "at least one"),
        (lambda: _CIRCLE(np.zeros((2, 5))), InputError, "pass points.T"),
        (lambda: _CIRCLE(np.zeros(2)), InputError, "expected"),
        (lambda: _CIRCLE("ab"), InputTypeError, "numbers"),
    ],
)
def test_bad_input(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_numbers_are_converted_to_fields():
    assert sizing.as_field(_CIRCLE) is _CIRCLE
    assert sizing.as_field(np.float32(0.5)).value == 0.5
    assert sizing.as_field(np.array(3)).value == 3
    assert (0.25 * _CIRCLE)([(0.2, 100.9)])[0] == (_CIRCLE * 0.25)([(0.2, 100.9)])[0]
    assert (1 + _CIRCLE)([(0.5, 100.9)])[0] == pytest.approx(1.02)


def test_empty_points(double):
    assert _CIRCLE(np.zeros((0, 2))).shape == (0,)


def test_constants_are_combined_on_the_host():
    """One constant stands for thousands: they need no kernel of their own."""
    values = np.random.default_rng(5).uniform(0.1, 9, 20_000)
    x = np.full((3, 2), 0.2)
    for make, of in ((sizing.minimum, np.min), (sizing.maximum, np.max)):
        few = make(*values.tolist(), sizing.Expression("0.5*x"), 4.5)
        assert few.parts == 3  # it, the formula and one number
        assert (few(x) == of([of([*values, 4.5]), 0.1])).all()
    ratio = sizing.as_field(2) / sizing.as_field(0.5) * sizing.as_field(3)
    assert isinstance(ratio, sizing.Constant)
    assert ratio.value == 12


def test_invalid_constants_may_be_combined():
    huge = sizing.Constant(1e300)
    assert (huge * huge / huge)(np.zeros((1, 2)))[0] == math.inf
    assert isinstance(sizing.Constant(2) + sizing.Constant(3), sizing.Constant)


def test_too_many_parts_are_rejected():
    """Kernels of hundreds of formulas take minutes to build, and nested ones end Python's stack."""
    formulas = [sizing.Expression(f"0.1 + {i}*x") for i in range(257)]
    sizing.minimum(*formulas[:256])
    with pytest.raises(InputError, match=r"257 parts, expected at most 256.*Raster"):
        sizing.minimum(*formulas)
    for grow in (lambda f: f + formulas[1], lambda f: 1.5 * f, lambda f: sizing.Graded(f, slope=1)):
        with pytest.raises(InputError, match="parts"):
            functools.reduce(lambda f, _, grow=grow: grow(f), range(20_000), formulas[0])
    long = sizing.Expression("+".join(["x*y"] * 1000))
    assert long.parts > 100
    with pytest.raises(InputError, match="parts"):
        sizing.maximum(long, long, long)
    # The least of the least is one field.
    least = formulas[0]
    for f in formulas[1:200]:
        least = sizing.minimum(least, f)
    assert least.parts == 201


def test_numpy_combines_fields():
    """NumPy's functions of the same meaning give the same fields."""
    points = np.random.default_rng(0).random((50, 2))
    values = _CIRCLE(points)
    for made, expected in (
        (np.minimum(_CIRCLE, 0.1), np.minimum(values, 0.1)),
        (np.maximum(0.1, _CIRCLE), np.maximum(0.1, values)),
        (np.minimum(_CIRCLE, lambda p: p[:, 0]), np.minimum(values, points[:, 0])),
        (np.float64(2) * _CIRCLE, 2 * values),
        (_CIRCLE / np.float32(2), values / 2),
        (np.add(_CIRCLE, _CIRCLE), 2 * values),
    ):
        assert isinstance(made, sizing.Field)
        assert np.array_equal(made(points), expected)


def test_a_tile_refines_where_it_is(ctx):
    coarse = sizing.Raster(np.full((6, 10), 400.0), (0, 0), (10e3, 6e3))
    tile = sizing.Raster(np.full((11, 11), 60.0), (4e3, 2e3), (5e3, 3e3), outside="ignore")
    both = sizing.minimum(coarse, tile)
    points = np.array([(9e3, 5e3), (4.5e3, 2.5e3), (4e3, 2e3), (3.9e3, 2e3)])
    assert both(points).tolist() == pytest.approx([400, 60, 60, 400])
    assert np.isinf(tile(points)).tolist() == [True, False, False, True]
    domain = Box((0, 0), (10e3, 6e3))
    inside = points[[0, 1, 3]]
    for dtype in ("float64", "float32"):
        result = Adapter(ctx, dtype).run(domain, both, points=inside, max_steps=0, method="lloyd")
        assert result.target_size.tolist() == pytest.approx([400, 60, 400], rel=1e-6)
