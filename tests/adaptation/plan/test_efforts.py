"""The error target that a run chooses: the share of steep cells against a grid, and the meshes that follow."""

import re
import warnings

import numpy as np
import pytest

import clvoro
from clvoro import sizing
from clvoro.adaptation.plan.efforts import EFFORTS, EFFORTS_3D, choose_error_target, steep_share
from clvoro.adaptation.plan.schedule import adaptive_schedule, n_steps
from clvoro.adaptation.sampling.start import density_tree
from clvoro.adaptation.tuning import SINGLE_LEVEL_ERROR_TARGET, STEEP, STEEPEST

BOX = clvoro.Box((0, 0), (2.5, 1.5))
RIDGE = sizing.Expression("0.0095 + 0.14 * fabs(y - 0.75 - 0.3 * sin(1.6 * pi * x))")
"""A kink along a curve, and slopes from 0.14 to 0.25; 3,600 cells."""
SMOOTH = sizing.Expression("0.03 + 0.004 * x")


def share_on_grid(field, box, step):
    """Return the share of steep cells, each point of a grid weighted by h^-2, with differences of NumPy."""
    axes = [np.arange(low + step / 2, high, step) for low, high in zip(box.lower, box.upper, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    h = field(points.reshape(-1, 2)).reshape(points.shape[:2])
    slope = np.hypot(*np.gradient(h, step))
    steepness = np.clip((slope - STEEP) / (STEEPEST - STEEP), 0, 1)
    return (steepness * h**-2).sum() / (h**-2).sum()


@pytest.mark.sparse(2)
@pytest.mark.parametrize(
    "field",
    [
        RIDGE,
        RIDGE * 0.7,
        SMOOTH,
        sizing.Distance(sizing.Circle((0.9, 0.75), 0.3), 0.02, slope=0.13, h_max=0.06),
        sizing.Expression("0.02 + 0.012 * sin(4 * x) * cos(5 * y)"),
    ],
)
def test_share_of_steep_cells(field):
    """Boxes of the tree are a few cells wide: where the slope varies, their mean slope differs by a few percent."""
    tree = density_tree(field, BOX)
    found = steep_share(tree.slopes_of_size, tree.cells)
    assert found == pytest.approx(share_on_grid(field, BOX, 0.002), abs=0.03)


def test_slopes_in_a_polygon_are_those_of_the_part_inside():
    domain = clvoro.Polygon([(0, 0), (2, 0.3), (1.2, 1.7)])
    tree = density_tree(sizing.Expression("0.02 + 0.09 * x + 0.12 * y"), domain)
    inside = tree.cells > 0
    # Samples outside are moved inside, some onto each other: the slopes of boxes that are cut can be too
    # small. Those of wide boxes are by up to 5 % too large, as differences of log h times the mean h.
    assert tree.slopes_of_size[inside].max() == pytest.approx(0.15, abs=0.01)
    share = tree.slopes_of_size @ tree.cells / tree.cells.sum()
    assert share == pytest.approx(0.15, abs=0.01)


@pytest.mark.parametrize("effort", EFFORTS)
def test_chosen_error_targets(effort):
    smooth, loose = EFFORTS[effort].error_target, EFFORTS[effort].steep_error_target
    assert choose_error_target(2, effort, levels=1) == smooth
    assert choose_error_target(2, effort, levels=0) == SINGLE_LEVEL_ERROR_TARGET
    assert choose_error_target(2, effort, levels=0, near=True) == smooth
    assert choose_error_target(2, effort, levels=2, steep=1.0) == pytest.approx(loose)
    assert smooth < choose_error_target(2, effort, levels=2, steep=0.3) < loose
    assert choose_error_target(3, effort, levels=1, steep=1.0) == EFFORTS_3D[effort].error_target


@pytest.mark.sparse(2)
@pytest.mark.parametrize(
    ("field", "arguments", "target", "words"),
    [
        (SMOOTH, {}, 0.0025, "sizes come first"),
        (SMOOTH, {"effort": "best"}, 0.0039, "sizes come first"),
        (RIDGE, {"options": clvoro.MultilevelOptions(error_target=0.003)}, 0.003, "as given"),
        (RIDGE, {"method": "exact"}, 0.0025, "sizes come first"),
        (RIDGE, {"n_cells": 600}, 0.0017, "sizes come first"),
    ],
)
def test_sizes_come_first_where_they_can(adapter, field, arguments, target, words):
    result = adapter.run(BOX, field, max_steps=0, **arguments)
    assert result.settings["error_target"] == target
    assert result.summary()["trade"] == f"error target {target:g}" + (
        f", {words}" if words == "as given" else f": {words}"
    )


@pytest.mark.slow
def test_a_kinked_and_steep_field_gets_cells_of_a_good_shape(adapter):
    """Mean Q is 0.983 and the least Q 0.91 with an error target of 0.0025."""
    result = adapter.run(BOX, RIDGE, seed=31)
    target = result.settings["error_target"]
    assert 0.01 < target < 0.0155
    assert "in place of 0.0025" in result.summary()["trade"]
    inner = ~np.logical_or.reduceat(result.diagram.neighbors < 0, result.diagram.neighbor_starts[:-1])
    assert result.quality[inner].mean() > 0.985
    assert result.quality[inner].min() > 0.92
    # The last step, against short edges, lowers the error by less than a tenth.
    assert 0.85 * target < abs(result.size_error).mean() < min(1.1 * target, 0.015)
    # The choice and the number itself give the same mesh.
    explicit = clvoro.MultilevelOptions(error_target=target)
    again = adapter.run(BOX, RIDGE, seed=31, options=explicit, max_steps=0)
    assert again.settings["error_target"] == target


@pytest.mark.parametrize("effort", EFFORTS_3D)
def test_few_cells_take_more_steps_from_a_lattice(effort):
    cells = (500, 2000, 4000, 16_000, 10**6)
    steps = [n_steps(adaptive_schedule(3, effort, 0, False, begins="lattice", cells=n)) for n in cells]
    assert steps == sorted(steps, reverse=True)
    assert steps[0] == steps[1] > steps[-1]
    assert steps[0] < n_steps(adaptive_schedule(3, effort, 0, False)) + 16


@pytest.mark.slow
def test_a_target_beyond_the_best_shape_ends_there_and_does_not_warn(adapter):
    """With effort "fast", mean |e| is then 0.07 on this field, and the largest 0.28."""
    options = clvoro.MultilevelOptions(error_target=0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error", clvoro.errors.SizeErrorWarning)
        result = adapter.run(BOX, RIDGE, seed=31, effort="fast", options=options)
    error = np.abs(result.size_error)
    assert 0.05 < error.mean() < 0.1
    assert error.max() < 0.32
    assert re.search("as given; it ends at 0.[0-9]+$", result.summary()["trade"])


def test_small_error_targets_are_met(adapter):
    """Without a smaller first penalty and the exact number of cells, mean |e| is 6e-4."""
    options = clvoro.MultilevelOptions(error_target=2e-4)
    result = adapter.run(BOX, RIDGE, seed=31, options=options)
    assert abs(result.size_error).mean() < 3e-4
    assert result.summary()["trade"] == "error target 0.0002, as given"
