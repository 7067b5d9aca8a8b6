"""Generators near each other, seen from far away: products of distances lose the digits in which they differ.

A cell at the other end of the domain and those near each other have to see the same faces between them; where they did
not, such sets were refused, or a corner was wrong.
"""

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError

UNIT = clvoro.Box((0, 0), (1, 1))


def pairs(diagram):
    """What is beside what, by places: the order of generators is the device's."""
    first = np.repeat(np.arange(len(diagram)), np.diff(diagram.neighbour_starts))
    places = [tuple(x) for x in diagram.points.tolist()]
    return {
        (places[i], places[j] if j >= 0 else j)
        for i, j in zip(first.tolist(), diagram.neighbours.tolist(), strict=True)
    }


@pytest.mark.parametrize("seed", [0, 2, 3, 5, 11, 20])
def test_a_line_among_others(ctx, seed):
    """In single precision; all but 5 were refused once. The positions are the same in both, and so is the diagram."""
    rng = np.random.default_rng(seed)
    n, step = int(rng.integers(20, 150)), rng.choice([1e-4, 2.5e-4, 5e-4])
    way = rng.uniform(0, 6.28)
    middle = 0.5 + 0.2 * rng.uniform(-1, 1, 2)
    line = middle + np.outer((np.arange(n) - n / 2) * step, [np.cos(way), np.sin(way)])
    points = np.vstack([line, rng.random((40, 2))]).astype(np.float32).astype(float)
    single = clvoro.Adapter(ctx, "float32").diagram(UNIT, points)
    report = single.check()
    assert report, report
    assert pairs(single) == pairs(clvoro.Adapter(ctx, "float64").diagram(UNIT, points))


def cluster(seed, real):
    """A few generators near each other (at random, on a line, on a circle), and fewer anywhere."""
    rng = np.random.default_rng(seed)
    k, size = int(rng.integers(3, 40)), 10 ** rng.uniform(-5 if real == "float32" else -13, -3)
    centre = rng.random(2)
    if seed % 3 == 0:
        x = centre + size * rng.standard_normal((k, 2))
    elif seed % 3 == 1:
        x = centre + np.outer(rng.uniform(-1, 1, k) * size * 10, [np.cos(seed), np.sin(seed)])
    else:
        t = rng.uniform(0, 6.28, k)
        x = centre + size * np.column_stack([np.cos(t), np.sin(t)])
    others = rng.random((int(rng.integers(1, 10)), 2))
    return np.unique(np.clip(np.vstack([x, others]), 0, 1).astype(real), axis=0).astype(float)


ONCE_REFUSED = {"float32": [4, 7, 13, 16, 17, 20, 134, 269], "float64": [16, 22, 25, 46, 56, 73]}


@pytest.mark.parametrize("real", ["float64", "float32"])
def test_clusters_among_few(ctx, real):
    """Right, or refused, as few are: mostly circles, in which all corners are one."""
    adapter, refused = clvoro.Adapter(ctx, real), 0
    for seed in [*range(60), *ONCE_REFUSED[real]]:
        try:
            diagram = adapter.diagram(UNIT, cluster(seed, real))
        except InputError:
            assert seed not in ONCE_REFUSED[real]
            refused += 1
            continue
        report = diagram.check()
        assert report, report
    # Of 60 there are 2 and 8; other devices round otherwise.
    assert refused <= (4 if real == "float64" else 12)


@pytest.mark.parametrize("real", ["float64", "float32"])
def test_three_two_roundings_apart(ctx, real):
    """Most are told apart, whatever is around them."""
    box, adapter, refused = clvoro.Box((0, 0), (4, 4)), clvoro.Adapter(ctx, real), 0
    step = 2 * float(np.spacing(np.asarray(2.75, real)))
    for seed in range(20):
        others = np.random.default_rng(seed).random((300, 2)) * 4
        three = 2.75 + step * np.array([(0, 0), (-1, 0), (1, 0)])
        try:
            report = adapter.diagram(box, np.vstack([others, three])).check()
        except InputError:
            refused += 1
            continue
        assert report, report
    # Of 20 there are 6 and 5; before corners were looked at from near by 19 and 18.
    assert refused <= 9


def test_corners_are_right_or_refused(ctx):
    """A corner was off by as much as the corner of a large cell may be without changing its area by a hundredth."""
    with pytest.raises(InputError, match="too close to each other"):
        clvoro.Adapter(ctx, "float32").diagram(UNIT, cluster(666, "float32"))
