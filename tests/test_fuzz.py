"""The fuzzer's inputs mostly end in a mesh, of every kind: else what it says of them is little."""

import collections

import pytest

from tests import fuzz
from tests.fuzz import WORK


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(WORK))
def test_inputs_mostly_end_in_a_mesh(kind):
    """And never in anything but that or an error: `attempt` raises."""
    ends = collections.Counter(fuzz.attempt(kind, seed)[0] for seed in range(12))
    assert kind == "file" or ends["mesh"] >= 0.6 * (ends.total() - ends["left out"])


def test_the_table_counts_what_there_was():
    ends = {"run": collections.Counter(mesh=3, error=1, failed=1), "solid": collections.Counter()}
    errors = {"run": collections.Counter({"InputError: k is # expected": 1})}
    head, row, error = fuzz.table(ends, errors).splitlines()
    assert row.split() == ["run", "5", "3", "1", "1", "60%"]
    assert head.split()[:5] == ["kind", "inputs", "mesh", "error", "failed"]
    assert error == "run: 1 x InputError: k is # expected"


@pytest.mark.parametrize("seed", [5, 300])
def test_parts_that_were_cut_off_pass_the_check(seed):
    """Around corners of holes, and in a cell with two faces towards one neighbour: both were refused once."""
    assert fuzz.attempt("layers", seed)[0] == "mesh"


def test_run_that_stops_early_among_layers_alone_ends_on_its_finest_level():
    """Where all generators are of layers, refinement adds none: the history had no row of what it came to."""
    assert fuzz.attempt("layers", 910000469)[0] == "mesh"
