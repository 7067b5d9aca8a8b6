"""Text of many numbers at once against Python's own."""

import numpy as np
import pytest

from clvoro.io.number_text import decimals, integers, joined


def texts(characters):
    return [joined(row[None]).decode() for row in characters]


RNG = np.random.default_rng(271)
NUMBERS = {
    "special": [0.0, -0.0, np.inf, -np.inf, np.nan, 5e-324, 1.7976931348623157e308, -1e16, 1e22],
    "limits": np.concatenate([np.nextafter(x, [0, x, np.inf]) for x in 10.0 ** np.arange(-6, 18)]),
    "powers of two": 2.0 ** np.arange(-60, 60),
    "unit box": RNG.random(20000),
    "all sizes": RNG.choice([-1, 1], 20000) * 10 ** RNG.uniform(-6, 18, 20000),
    "few digits": RNG.integers(1, 10**6, 20000) / 10.0 ** RNG.integers(0, 12, 20000),
    "ties": RNG.integers(0, 2**40, 20000) * 5 * 2.0**-38,
    "neighbors": np.nextafter(np.round(RNG.random(20000), 4), RNG.choice([-1, 2], 20000)),
    "integers": RNG.integers(0, 2**53, 20000).astype(float),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_decimals_are_those_of_repr(name):
    values = np.array(NUMBERS[name], float)
    assert texts(decimals(values)) == [repr(x) for x in values.tolist()]


@pytest.mark.parametrize("largest", [9, 9999, 10**4, 10**8, 2**31, 2**62])
def test_integers_are_those_of_str(largest):
    values = np.append(np.random.default_rng(2).integers(0, largest, 500), [0, largest])
    assert texts(integers(values)) == [str(x) for x in values.tolist()]


def test_rows_are_joined():
    values = np.array([7, 12345])
    assert (
        joined(b"(", integers(values), b" ", decimals(values / 2), b")\n")
        == b"(7 3.5)\n(12345 6172.5)\n"
    )
