"""Two implementations of OpenCL agree: PoCL and Intel's runtime, if both are installed (`pip install '.[cpu]'`)."""

import importlib
import sys

import pytest

import clvoro
from tests.test_bench import BENCH, records

DEVICES = ("pocl", "Intel(R) OpenCL")


def platforms():
    found = set()
    for name in DEVICES:
        try:
            found.add(clvoro.create_context(name).devices[0].platform.name)
        except clvoro.ClvoroError:
            continue
    return found


@pytest.fixture(scope="module")
def both():
    if not BENCH.is_dir() or len(platforms()) < len(DEVICES):
        pytest.skip("there are not both PoCL and Intel's runtime")


@pytest.fixture
def agreement(monkeypatch):
    if not BENCH.is_dir():
        pytest.skip("the tests lie outside a source tree")
    monkeypatch.syspath_prepend(str(BENCH))
    yield importlib.import_module("two_devices")
    for name in ("two_devices", "_common"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_diagrams_and_steps(both, dtype):
    """To the tolerances that the script states."""
    rows = records("two_devices.py", "--cells", "2e3", "--no-runs", "--dtype", dtype)
    assert [(r["dim"], r["what"]) for r in rows] == [(2, "diagram"), (2, "3 steps"), (3, "diagram"), (3, "3 steps")]
    assert all(r["graph"] for r in rows if r["what"] == "diagram")


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_whole_runs(both, dtype):
    rows = records("two_devices.py", "--cells", "2e3", "--dtype", dtype)
    assert [r["what"] for r in rows] == ["diagram", "3 steps", "fast", "default"] * 2


DIAGRAM = {"what": "diagram", "dtype": "float64", "graph": True, "off": 1e-13}
STEPS = {"what": "3 steps", "dtype": "float64", "graph": True, "off": 1e-8}
RUN = {
    "what": "fast",
    "dtype": "float64",
    "cells": 2000,
    "cells_off": 1,
    "mean_error": [0.0025, 0.0026],
    "mean_quality": [0.97, 0.971],
}


@pytest.mark.parametrize("record", [DIAGRAM, STEPS, RUN], ids=lambda r: r["what"])
def test_what_agrees_passes(agreement, record):
    assert agreement.good(record)


@pytest.mark.parametrize(
    "record",
    [
        DIAGRAM | {"graph": False},
        DIAGRAM | {"off": 1e-11},
        DIAGRAM | {"off": float("nan")},
        STEPS | {"off": 1e-5},
        RUN | {"cells_off": 7},
        RUN | {"mean_error": [0.0025, 0.0036]},
        RUN | {"mean_quality": [0.97, 0.976]},
    ],
)
def test_what_differs_is_found(agreement, record):
    assert not agreement.good(record)


@pytest.mark.slow
def test_one_device_is_no_second_one(agreement):
    """Intel's processors are called so under any implementation."""
    records("two_devices.py", "--devices", "pocl,pocl", code=1)
