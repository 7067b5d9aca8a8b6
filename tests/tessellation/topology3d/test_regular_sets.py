"""Sets that people have and in which many cells meet in a point or along a line: lattices, rings, spheres, layers.

Round-off decides there which faces a cell has. Generators may be as near each other as `LEAST_SEPARATION`.
"""

import numpy as np
import pytest

import clvoro
from clvoro.tessellation.device_diagram import LEAST_SEPARATION
from tests.tessellation.test_polyhedra import directions, hexagonal, lattice

CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))
TORUS = clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True)


def turned(points):
    """Turn a set in the unit cube, so that it is parallel to no wall."""
    turn, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))
    return 0.5 + 0.57 * (points - 0.5) @ turn


def cubic(k):
    return lattice("cubic", k) / (2, 1.5, 1)


def pipe(radii, n, layers):
    """Rings of `n` generators around an axis, and several layers of them."""
    turn = 2 * np.pi * np.arange(n) / n + 0.1
    ring = np.column_stack([np.cos(turn), np.sin(turn)])
    rings = 0.5 + np.concatenate([r * ring for r in radii])
    return np.vstack([np.pad(rings, ((0, 0), (0, 1)), constant_values=(k + 0.5) / layers) for k in range(layers)])


def ring(n, radius, seed):
    """Anywhere on a circle whose axis is parallel to no wall."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, 2 * np.pi, n)
    plane = np.linalg.qr(rng.standard_normal((3, 3)))[0][:2]
    return 0.5 + radius * np.column_stack([np.cos(turn), np.sin(turn)]) @ plane


def spiral(n):
    """Unit vectors that are spread evenly."""
    k = np.arange(n) + 0.5
    across, turn = np.sqrt(1 - (1 - 2 * k / n) ** 2), np.pi * (1 + np.sqrt(5)) * k
    return np.column_stack([np.cos(turn) * across, np.sin(turn) * across, 1 - 2 * k / n])


def globe(rows, columns):
    """Generators on circles of latitude."""
    down, round_ = np.meshgrid((np.arange(rows) + 0.5) / rows * np.pi, 2 * np.pi * np.arange(columns) / columns)
    across = np.sin(down)
    return 0.5 + 0.4 * np.stack([across * np.cos(round_), across * np.sin(round_), np.cos(down)], -1).reshape(-1, 3)


def torus(n, m):
    a, b = np.meshgrid(2 * np.pi * np.arange(n) / n, 2 * np.pi * np.arange(m) / m)
    r = 0.3 + 0.12 * np.cos(b)
    return 0.5 + np.stack([r * np.cos(a), r * np.sin(a), 0.12 * np.sin(b)], -1).reshape(-1, 3)


RNG = np.random.default_rng(61301)
PLANE = RNG.random((150, 2))
SETS = {
    "cubic": cubic(8),
    "cubic, turned": turned(cubic(5)),
    "hexagonal, turned": turned(hexagonal(5, False)),
    "close-packed, turned": turned(hexagonal(5, True)),
    "coarse and fine": np.vstack([cubic(4) * (0.5, 1, 1), cubic(8) * (0.5, 1, 1) + (0.5, 0, 0)]),
    "ring": pipe([0.4], 300, 1),
    "pipe": pipe(np.arange(0.05, 0.46, 0.08), 40, 5),
    "pipe, turned": turned(pipe([0.1, 0.2, 0.3, 0.4], 12, 3)),
    "ring anywhere": ring(60, 0.3, 0),
    "ring, turned": turned(pipe([0.4], 200, 1)),
    "sphere": 0.5 + 0.4 * directions(160, RNG),
    "large sphere": 0.5 + 0.4 * directions(2000, RNG),
    "even sphere": 0.5 + 0.4 * spiral(500),
    "sphere with its center": 0.5 + np.vstack([0.4 * spiral(100), [[0, 0, 0]]]),
    "shells": 0.5 + np.vstack([r * spiral(200) for r in (0.1, 0.2, 0.3, 0.4)]),
    "layers around a sphere": 0.5 + np.vstack([(0.2 + 3e-3 * 1.5**k) * spiral(100) for k in range(8)]),
    "globe": globe(20, 40),
    "torus": turned(torus(60, 24)),
    "layers": np.vstack([np.pad(PLANE, ((0, 0), (0, 1)), constant_values=z) for z in (0.003, 0.01, 0.03, 0.1, 0.3)]),
    "line among others": np.vstack([np.linspace(0.2, 0.8, 150)[:, None] * (1, 1, 1), RNG.random((60, 3))]),
}
IN_TORUS = ("cubic", "hexagonal, turned", "ring", "pipe", "sphere", "even sphere", "shells", "globe", "layers")


def check(adapter, box, points):
    diagram = adapter.diagram(box, box.wrap(points))
    report = diagram.check()
    assert report, report
    assert diagram.volumes.sum() == pytest.approx(1, rel=1e-6)
    return diagram


@pytest.mark.sparse(10)
@pytest.mark.parametrize("name", SETS)
def test_regular_sets(adapter, name):
    diagram = check(adapter, CUBE, SETS[name])
    # No cell has dozens of vertices on a line that all cells share.
    assert len(diagram.vertices) < 8 * len(diagram)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("name", IN_TORUS)
def test_regular_sets_in_a_periodic_box(adapter, name):
    points = SETS[name] if name != "ring" else pipe([0.4], 80, 2)
    check(adapter, TORUS, points)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("units", [50, 200, 800])
def test_lattices_that_are_off_by_units_of_round_off(adapter, units):
    """Faces along all edges, as narrow as round-off: one that is merged must not merge all others."""
    noise = np.random.default_rng(1).standard_normal((729, 3))
    check(adapter, CUBE, cubic(9) + units * np.finfo(adapter.dtype).eps * noise)


def near_each_other(gap, seed=0):
    """Generators of which some are `gap` apart, by the kind of the set."""
    rng = np.random.default_rng(seed)
    base = 0.01 + 0.98 * rng.random((200, 3))
    block, turn = np.array(list(np.ndindex(4, 4, 4))), np.pi * np.arange(12) / 6
    circle = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    return {
        "pairs": np.vstack([base, base + gap * directions(200, rng)]),
        "block": np.vstack([base, 0.6 + gap * block]),
        "line": np.vstack([base, 0.3 + gap * np.arange(60)[:, None] * directions(1, rng)]),
        "circle": np.vstack([base, 0.5 + gap * circle / 0.51]),
        "layers": np.column_stack([np.tile(base[:80, :2], (4, 1)), np.repeat(gap * np.arange(1, 5), 80)]),
    }


KINDS = list(near_each_other(1))


@pytest.mark.sparse(4)
@pytest.mark.parametrize("periodic", [False, True], ids=["walls", "seams"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_least_separation(adapter, kind, periodic):
    gap = 1.01 * LEAST_SEPARATION[adapter.dtype.name]
    check(adapter, TORUS if periodic else CUBE, near_each_other(gap)[kind])


@pytest.mark.sparse(4)
@pytest.mark.parametrize("kind", KINDS)
def test_nearer_generators(adapter, kind):
    """The result is a correct mesh, or an error that names the two. A few units of round-off apart it is the error."""
    eps, errors = float(np.finfo(adapter.dtype).eps), []
    for gap in (1e3 * eps, 30 * eps, 4 * eps):
        points = near_each_other(gap)[kind].astype(adapter.dtype)
        try:
            check(adapter, CUBE, np.unique(points, axis=0))
        except clvoro.ClvoroError as error:
            errors.append(str(error))
    assert errors
    assert all("too close to each other" in error for error in errors), errors
    if adapter.dtype == np.float32:
        assert all("use dtype='float64'" in error for error in errors)
