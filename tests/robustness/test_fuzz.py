"""Most inputs of the fuzzer, of every kind, give a mesh. If most gave errors, it would test little."""

import collections

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError
from tests.reference import shores
from tests.robustness import fuzz
from tests.robustness.fuzz import WORK
from tests.robustness.fuzz_judge import Wrong, demand_truth


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(WORK))
def test_inputs_mostly_end_in_a_mesh(kind):
    """All others end in an error of clvoro; otherwise `attempt` raises."""
    ends = collections.Counter(fuzz.attempt(kind, seed)[0] for seed in range(12))
    assert kind in ("file", "rings") or ends["mesh"] >= 0.6 * (ends.total() - ends["left out"])


def test_the_table_counts_what_there_was():
    ends = {"run": collections.Counter(mesh=3, error=1, failed=1), "solid": collections.Counter()}
    errors = {"run": collections.Counter({"InputError: k is # expected": 1})}
    head, row, error = fuzz.table(ends, errors).splitlines()
    assert row.split() == ["run", "5", "3", "1", "1", "60%"]
    assert head.split()[:5] == ["kind", "inputs", "mesh", "error", "failed"]
    assert error == "run: 1 x InputError: k is # expected"


def test_refusals_have_to_be_true():
    """The judge checks an error that edges or generators are too close to each other: some must be."""
    error = InputError("edges of it are too close to each other, or generators are, for the precision")
    apart, near = np.array([(0.2, 0.2), (0.8, 0.2)]), np.array([(0.2, 0.2), (0.2 + 1e-7, 0.2)])
    eps = float(np.finfo(np.float32).eps)
    for wide, points in ((100 * eps, None), (0.1, apart), (np.inf, None), (np.inf, apart)):
        domain = clvoro.Polygon(shores.slit(wide) if wide < 1 else shores.UNIT)
        with pytest.raises(Wrong, match="edges of it are too close"):
            demand_truth(error, domain, "float32", points)
    demand_truth(error, clvoro.Polygon(shores.slit(eps)), "float32", None)
    demand_truth(error, clvoro.Polygon(shores.UNIT), "float32", near)
    with pytest.raises(Wrong):
        demand_truth(error, clvoro.Polygon(shores.UNIT), "float64", near)
    demand_truth(InputError("n is 3, expected at least 4"), domain, "float32", None)
    generators = InputError("generators at [0 0], 6e-08 apart, are too close to each other")
    with pytest.raises(Wrong, match="not so in the plane"):
        demand_truth(generators, domain, "float64", near)
    generators = InputError("generators at [0 0], 1e-08 apart, are too close to each other")
    demand_truth(generators, domain, "float32", near)


@pytest.mark.sparse(4)
@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("polygon", 703016),
        pytest.param("polygon-run", 50000082, marks=pytest.mark.slow),
        pytest.param("hard-polygon", 70000154, marks=pytest.mark.slow),
        pytest.param("hard-polygon", 70000338, marks=pytest.mark.slow),
        pytest.param("hard-polygon", 71000383, marks=pytest.mark.slow),
        ("hard-polygon", 120000326),
        ("hard-polygon", 210000134),
        pytest.param("hard-polygon", 210001839, marks=pytest.mark.slow),
        ("polygon", 210001878),
        pytest.param("polygon-run", 410000584, marks=pytest.mark.slow),
        ("polygon", 757286782),
        ("hard-polygon", 483733786),
        ("hard-polygon", 483733990),
        ("hard-polygon", 483738857),
        pytest.param("hard-polygon", 530437850, marks=pytest.mark.slow),
        ("hard-polygon", 530440997),
        pytest.param("hard-polygon", 95364880, marks=pytest.mark.slow),
        pytest.param("polygon-run", 220638134, marks=pytest.mark.slow),
        ("hard-polygon", 2450810770),
    ],
)
def test_polygons_that_failed_once(kind, seed):
    """Generators as near as a slit is wide; a face across its tip; edges along faces where three cells meet; spits;
    new generators of few cells at the same corner; one in the tip of a spit that leaves it; sentinels that see too
    little; crowds around a corner; generators at the corners of a hole of some roundings; parts of two regions that
    change places; generators on both sides of a slit of some roundings, or near each other and far from all others, or
    on a slanted edge far from 0; faces that look back, of parts that two cells exchange."""
    assert fuzz.attempt(kind, seed)[0] == "mesh"


@pytest.mark.sparse(1)
@pytest.mark.parametrize(
    ("kind", "seed"),
    [("around", 822841374), pytest.param("around", 220865677, marks=pytest.mark.slow), ("hard-polygon", 95364499)],
)
def test_vertices_that_were_elsewhere_once(kind, seed):
    """Near a corner of the box; where very many cells meet in space; at the tip of a needle that sticks out of the
    domain. A mesh that is right or an error: else this raises."""
    fuzz.attempt(kind, seed)


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        pytest.param("run", 104533427, marks=pytest.mark.slow),
        ("run", 1359923794),
        ("periodic", 1359924102),
        pytest.param("around", 311905425, marks=pytest.mark.slow),
        pytest.param("around", 311906760, marks=pytest.mark.slow),
        pytest.param("around", 21192475, marks=pytest.mark.slow),
        pytest.param("around", 21193788, marks=pytest.mark.slow),
    ],
)
def test_generators_that_were_told_to_coincide_once(kind, seed):
    """In a thin strip what came from its wall was put on a generator; sizes far above the domain drove them into its
    corner; rounding of a cell's reach hid one of two that are roundings apart, or what was at twice the distance of a
    corner of nearly parallel faces."""
    assert fuzz.attempt(kind, seed)[0] == "mesh"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [pytest.param(5, marks=pytest.mark.slow), 300])
def test_parts_that_were_cut_off_pass_the_check(seed):
    """Around corners of holes, and in a cell with two faces to one neighbor. Earlier versions refused both."""
    assert fuzz.attempt("layers", seed)[0] == "mesh"


def test_run_that_stops_early_among_layers_alone_ends_on_its_finest_level():
    """If all generators are of layers, refinement adds none. The history lacked the last row."""
    assert fuzz.attempt("layers", 910000469)[0] == "mesh"
