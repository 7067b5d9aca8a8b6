"""The purpose of each safeguard of the incremental update: without it a diagram is wrong, or made anew."""

import numpy as np
import pytest

from clvoro.tessellation import incremental as repair
from tests.reference import patch
from tests.tessellation.test_incremental import Carried


@pytest.fixture
def generous(monkeypatch):
    """Let the update accept any share of changed cells, in lanes as well."""
    for name, value in (("MAX_SHARE", 1.0), ("AGAIN_SHARE", 3.0), ("FEW", 1)):
        monkeypatch.setattr(repair, name, value)


@pytest.fixture(params=["as it is", "one by one"])
def group_size(request):
    """CPUs check rows in lanes, GPUs one by one."""
    return None if request.param == "as it is" else 128


def carry(ctx, real, group_size, points, moved):
    """Return the diagram updated from `points` to `moved`, None if the update gave up, and that made anew."""
    engine = patch.make_engine(ctx, real, group_size=group_size)
    points, moved = (np.array(x, engine.real) for x in (points, moved))
    carried = Carried(engine, points)
    t, was = carried.move(moved)
    return t if was else None, carried.reference(moved)


def assert_same(t, expected):
    assert np.array_equal(t.starts, expected.starts)
    assert np.array_equal(t.neighbors, expected.neighbors)
    assert np.array_equal(t.volumes, expected.volumes)


def wound_twice(of_three, spacing=0.06):
    """z -> z^2 about a generator, or in the middle of three, two of which come to lie level above the third's foot.

    The two sheets lie apart, and all rows stay right but for those there, and at walls.
    """
    i, j = (k.ravel() for k in np.meshgrid(np.arange(-40, 41), np.arange(-40, 41)))
    z = spacing * (i + j / 2 + 1j * 0.75**0.5 * j)
    if of_three:
        z += spacing * (0.5 + 0.5j / 3**0.5)
    w = 0.625 * z * (z + 0.15 * spacing)
    if of_three:
        p, q, r = np.argsort(abs(z))[:3]
        turn = abs(w[p] - w[q]) / (w[p] - w[q])
        turn *= np.sign(((w[r] - w[q]) * turn).imag)
        w, z = w * turn, z * turn**0.5
        w[p] = w[p].real + 1j * w[q].imag
    inside = (abs(w.real) < 0.49) & (abs(w.imag) < 0.365)
    at, to = (np.column_stack([v.real, v.imag])[inside] for v in (z, w))
    middle = np.array([0.5, 0.375])
    return middle + 0.36 * at / abs(z[inside]).max(), middle + to


@pytest.mark.sparse(1)
@pytest.mark.parametrize("of_three", [False, True], ids=["generator", "three"])
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_cells_that_cover_the_box_twice(ctx, real, group_size, generous, of_three):
    """A cell that winds twice around its generator, or three cells reversed at a corner, reveal it."""
    t, expected = carry(ctx, real, group_size, *wound_twice(of_three))
    assert expected.volumes.sum() == pytest.approx(0.75, rel=1e-6)
    assert t is None or t.volumes.sum() == pytest.approx(0.75, rel=1e-6)


@pytest.mark.sparse(1)
def test_former_neighbors_are_clipped_again(ctx, group_size, generous):
    """One of four cells loses neighbors that still list it: all are clipped again."""
    points = np.array([[0.27, 0.01], [0.38, 0.0], [0.57, 0.02], [0.03, 0.03]])
    moved = points.copy()
    moved[2] = 0.26, 0.01
    t, expected = carry(ctx, "float64", group_size, points, moved)
    assert t is None or np.allclose(t.volumes, expected.volumes, rtol=0, atol=1e-15)


@pytest.mark.sparse(1)
def test_two_cells_that_do_not_fit_are_clipped_again(ctx, group_size, generous):
    points = np.array(
        [
            [0.7414, 0.2586],
            [0.6, 0.6],
            [0.6, 0.2],
            [0.7414, 0.5414],
            [0.4, 0.4],
            [0.4586, 0.2586],
            [0.8, 0.4],
            [0.4586, 0.5414],
        ]
    )
    moved = points + np.array([[0, 2], [0, -3], [0, 3], [0, -2], [0, 0], [0, 2], [0, 0], [0, -2]]) * 1e-4
    t, expected = carry(ctx, "float64", group_size, points, moved)
    assert_same(t, expected)


CROSS = [[0.22, 0.34], [0.19, 0.34], [0.22, 0.25], [0.25, 0.31]]


def test_rows_that_drop_different_faces_of_zero_length_stay(ctx, group_size):
    """Four generators on a circle up to round-off: both pairs may be neighbors, or neither."""
    t, expected = carry(ctx, "float64", group_size, CROSS, CROSS)
    assert_same(t, expected)


@pytest.mark.parametrize(
    ("real", "points", "moved"),
    [
        # A face becomes as short as round-off.
        (
            "float64",
            [[0.2811, 0.2812], [0.3126, 0.2812], [0.2813, 0.3438], [0.3126, 0.3438]],
            [[0.28, 0.28], [0.31, 0.28], [0.28, 0.34], [0.31, 0.34]],
        ),
        # Four generators on a circle that is far smaller than their cells.
        (
            "float32",
            [[0.6991, 0.22476], [0.70043, 0.22476], [0.70043, 0.22576], [0.6991, 0.22576]],
            [[0.6991, 0.22476], [0.70043, 0.22476], [0.70043, 0.22576], [0.6991, 0.22575]],
        ),
        # A cluster whose corners differ by little more than the round-off of positions.
        (
            "float32",
            [
                [0.40047, 0.40051],
                [0.40058, 0.40043],
                [0.40075, 0.40016],
                [0.40034, 0.40043],
                [0.40042, 0.40038],
                [0.40053, 0.40041],
                [0.40055, 0.40058],
            ],
            [
                [0.45948, 0.40124],
                [0.45953, 0.40117],
                [0.4596, 0.40089],
                [0.45943, 0.40116],
                [0.45947, 0.40111],
                [0.45951, 0.40114],
                [0.45952, 0.40132],
            ],
        ),
    ],
    ids=["short faces", "near generators", "small distances"],
)
def test_bits_where_round_off_decides(ctx, real, points, moved, group_size, generous):
    """The updated diagram has the faces of the one made anew, including those of zero length."""
    t, expected = carry(ctx, real, group_size, points, moved)
    if t is not None:
        assert_same(t, expected)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("noise", [1e-6, 1e-5])
def test_a_square_lattice_is_updated(ctx, noise, generous):
    """In single precision four cells meet at almost every vertex, and may have different faces there."""
    rng, k = np.random.default_rng(50301), (np.arange(60) + 0.5) / 60
    points = np.stack(np.meshgrid(k, 0.75 * k), axis=-1).reshape(-1, 2)
    moved = points + noise * rng.standard_normal(points.shape)
    before = points + (noise < 1e-5) * noise * rng.standard_normal(points.shape)
    t, expected = carry(ctx, "float32", None, before, moved)
    assert t is not None
    assert np.abs(t.volumes - expected.volumes).max() < 1e-3 * expected.volumes.mean()


@pytest.mark.parametrize("count", [14, 18])
def test_cells_of_many_faces(ctx, count, group_size, generous):
    """A cell with more than sixteen faces is clipped again in every update."""
    rng, turn = np.random.default_rng(50302), 2 * np.pi * np.arange(count) / count
    ring = [0.5, 0.375] + 0.2 * np.column_stack([np.cos(turn), np.sin(turn)])
    points = np.concatenate([[[0.5, 0.375]], ring + 1e-4 * rng.random(ring.shape)])
    moved = points + 1e-5 * rng.random(points.shape)
    t, expected = carry(ctx, "float64", group_size, points, moved)
    assert t.starts[1] == count
    assert_same(t, expected)
