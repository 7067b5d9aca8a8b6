"""Criteria of solvers: values, limits, places; the report as text."""

import warnings

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError, MismatchWarning
from clvoro.mesh.check.findings import CheckError
from tests.finite_volumes.test_straight_walls import ELL, SQUARE, circle


@pytest.fixture(scope="module")
def good(ctx) -> clvoro.Result:
    domain = clvoro.Polygon(SQUARE, [circle(60, 0.2)])
    return clvoro.Adapter(ctx).run(domain, 0.06, effort="fast")


@pytest.fixture(scope="module")
def bad(ctx) -> clvoro.Diagram:
    """A single cell with the corner at (0.5, 0.5)."""
    points = np.array([(0.4, 0.4)])
    return clvoro.Adapter(ctx).diagram(clvoro.Polygon(ELL), points)


def test_a_good_mesh_is_accepted(good):
    report = good.check(solver="openfoam")
    assert report
    assert good.diagram.check("openfoam") == report
    report.demand()
    mesh = good.solver_mesh()
    assert (report.cells, report.faces) == (mesh.n_cells, len(mesh.owner))
    assert report.area_change == mesh.area_change
    text = str(report)
    assert "openfoam: accepted" in text.splitlines()[0]
    assert f"change the area by {100 * mesh.area_change:+.2g} %" in text.splitlines()[0]
    assert len(text.splitlines()) == 2 + len(report.criteria)
    assert report.as_dict()["criteria"][0]["name"] == "boundary openness"


def test_exact_walls_of_a_circle_are_rejected(good):
    report = good.check(solver="openfoam", walls="exact")
    assert not report
    concave = report["concavity"]
    assert concave.value == pytest.approx(6)
    assert concave.count > 10
    assert not concave.ok
    assert report.area_change == 0
    distance = np.linalg.norm(np.array(concave.place) - 0.5)
    assert 0.2 < distance < 0.3
    assert np.allclose(good.diagram.centroids[concave.cell], concave.place, atol=0.01)


def test_a_corner_is_named_with_its_place(bad):
    report = bad.check(solver="openfoam")
    assert not report.ok
    concave = report["concavity"]
    assert (concave.value, concave.cell, concave.count) == (pytest.approx(90), 0, 1)
    assert len(concave.place) == 2
    assert "rejected" in str(report)
    assert "1 fail" in str(concave)
    assert "cell 0 at (" in str(concave)
    with pytest.raises(CheckError, match="concavity"):
        report.demand()


def test_an_island_within_a_cell_is_left_out(ctx):
    points = np.array([(0.6, 0.5), (0.05, 0.5), (0.95, 0.5)])
    domain = clvoro.Polygon(SQUARE, [circle(5, 0.05)], names={"rock": range(4, 9)})
    diagram = clvoro.Adapter(ctx).diagram(domain, points)
    with pytest.warns(MismatchWarning, match=r"leaves out 1 part of the boundary .* at \(0\.49"):
        mesh = diagram.solver_mesh()
    assert mesh.left_out is diagram.left_out
    assert mesh.left_out.measures == pytest.approx([domain.measure - 1], rel=1e-12)
    assert np.hypot(*(mesh.left_out.places[0] - 0.5)) < 0.05
    assert set(-1 - mesh.neighbor[mesh.n_inner :]) == set(range(4))
    assert mesh.area_change == pytest.approx(1 / domain.measure - 1, rel=1e-12)
    with warnings.catch_warnings():  # the mesh is kept, and warned of once
        warnings.simplefilter("error")
        assert diagram.check(solver="openfoam")["concavity"].ok
        assert diagram.solver_mesh() is mesh
    assert diagram.solver_mesh("exact") is not mesh


def test_two_regions_are_reported_but_accepted(ctx):
    domain = clvoro.Polygon.from_shapely(two_squares())
    report = clvoro.Adapter(ctx).run(domain, 0.1, effort="fast").check(solver="openfoam")
    assert report.ok
    assert (report["regions"].value, report["regions"].count) == (2, 1)


def two_squares():
    import shapely

    return shapely.MultiPolygon([shapely.box(0, 0, 1, 1), shapely.box(1.5, 0, 2.5, 1)])


def test_wrong_arguments_are_refused(good, bad):
    with pytest.raises(InputError, match="solver is 'fluent', expected one of openfoam"):
        good.check(solver="fluent")
    for mesh in (good, bad):
        with pytest.raises(InputError, match="walls is 'exact', and no solver"):
            mesh.check(walls="exact")
    with pytest.raises(InputError, match="walls is 'round'"):
        good.check(solver="openfoam", walls="round")
