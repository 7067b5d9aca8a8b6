"""Chords of many lines at once against one line after the other."""

import numpy as np
import pytest

from clvoro.finite_volumes.chords import Lines, chord_costs, complex_of, concave_prices, kept_points
from tests.reference import chords as reference


def random_lines(seed: int, count: int) -> tuple[list, list, np.ndarray]:
    """Lines of 1 to 30 points: walks that turn by little or by much, some points fixed."""
    rng = np.random.default_rng(seed)
    lines, fixed, sizes = [], [], rng.uniform(0.5, 2.0, count)
    for size in sizes:
        k = int(rng.choice([1, 2, 3, rng.integers(4, 30)]))
        angle = rng.uniform(0, 6) + np.cumsum(rng.normal(0, rng.choice([0.05, 0.4, 1.2]), k))
        steps = rng.uniform(0.2, 1, k)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        line = rng.uniform(-1, 1, 2) + np.cumsum(size * 1.5 / k * steps, axis=0)
        lines.append(list(map(tuple, line.tolist())))
        fixed.append((rng.random(k) < 0.05).tolist())
    return lines, fixed, sizes


@pytest.mark.parametrize("seed", range(3))
def test_many_lines_at_once_have_the_same_chords_and_costs(seed):
    rng = np.random.default_rng(seed + 10)
    rows, fixed, sizes = random_lines(seed, 400)
    starts = np.concatenate([[0], np.cumsum(list(map(len, rows)))])
    lines = Lines(starts, complex_of(np.concatenate(rows)), np.concatenate(fixed), sizes)
    centroids = complex_of(rng.uniform(-1, 1, (400, 2)))
    behind, ahead = (rng.uniform(-2, 2, (400, 2)) + 1j * rng.uniform(-2, 2, (400, 2)) for _ in "ab")
    found = kept_points(lines)
    wanted = [reference.kept(*z) for z in zip(rows, fixed, sizes.tolist(), strict=True)]
    assert np.flatnonzero(found).tolist() == [int(s) + k for s, left in zip(starts, wanted, strict=False) for k in left]
    # Something of every kind happens: stretches end, kinks are dropped, some stay.
    assert found.sum() > 2 * len(rows) - sum(len(row) == 1 for row in rows)
    assert found.sum() < 0.5 * len(found)
    costs, prices = (chord_costs(lines, found, centroids), concave_prices(lines, found, behind, ahead))
    for i, (row, left) in enumerate(zip(rows, wanted, strict=True)):
        point = (centroids[i].real, centroids[i].imag)
        assert costs[i] == pytest.approx(reference.cost(row, left, sizes[i], point), rel=1e-12, abs=1e-14)
        way = [(z.real, z.imag) for z in behind[i]] + [row[k] for k in left]
        way += [(z.real, z.imag) for z in ahead[i]]
        assert prices[i] == pytest.approx(reference.concave_price(way, sizes[i]), rel=1e-12)


def test_no_lines():
    none = np.zeros(0)
    lines = Lines(np.zeros(1, int), none.astype(complex), none.astype(bool), none)
    assert kept_points(lines).size == 0
