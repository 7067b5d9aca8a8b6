"""Correct diagrams of hard polygons pass the check; wrong ones fail."""

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError
from clvoro.mesh.check.rebuilt import Rebuilt
from clvoro.mesh.diagram import Diagram
from tests.reference.shores import UNIT, scattered, slit

REALS = ("float64", "float32")


@pytest.fixture(scope="module")
def adapters(ctx):
    return {real: clvoro.Adapter(ctx, real) for real in REALS}


@pytest.mark.parametrize("real", REALS)
def test_faces_of_pieces_that_went_to_other_cells(adapters, real):
    """Two pieces in a prong belong to cells beside it. The middle of their common face is on another bisector."""
    gaps = [(0.57, 1), (0.57, 0.1), (0.55, 0.1), (0.55, 1), (0.45, 1), (0.45, 0.1), (0.43, 0.1), (0.43, 1)]
    domain = clvoro.Polygon([(0, 0), (1, 0), (1, 1), *gaps, (0, 1)])
    for side in (1, -1):
        above, below = (0.5 - 0.04 * side, 0.7), (0.5 + 0.04 * side, 0.4)
        diagram = adapters[real].diagram(domain, [above, below, (0.43, 0.55), (0.57, 0.55)])
        report = diagram.check()
        assert report, report
        begin, end = diagram.vertices[diagram.face_vertices.reshape(-1, 2)].transpose(1, 0, 2)
        upright = np.isclose(begin, end)[:, 0] & (diagram.neighbors >= 0) & (diagram.face_measures > 0.01)
        middles = np.isclose((begin + end) / 2, (0.5, 0.55)).all(axis=1)
        assert (upright & middles).sum() == 2
        assert Rebuilt(diagram).adopted[upright & middles].all()


def test_slits_that_are_no_wider_than_some_roundings_hide_what_is_behind_them(adapters):
    """A corner on one side of a slit, and a generator on its other side that is nearer than the cell's own."""
    checked = 0
    for width in (2.5e-7, 1e-6):
        for seed in range(12):
            domain = clvoro.Polygon(slit(width))
            try:
                diagram = adapters["float32"].diagram(domain, scattered(domain, 20, seed))
            except InputError:  # the sides are in the same place
                continue
            report = diagram.check()
            assert report, report
            checked += 1
    assert checked > 15
    # A spike: its width in x is less than the round-off of y, because y is much larger than x.
    x = 68.53 + 1.28e-13 * np.arange(2)
    sides = [(x[1], 37913.1), ((x[0] + x[1]) / 2, 37909.5), (x[0], 37913.1)]
    far = [(68.52, 37908.0), (68.54, 37908), (68.54, 37913.1), *sides, (68.52, 37913.1)]
    domain = clvoro.Polygon(far)
    assert domain.is_slit(np.array([sides[0], far[2]]), 1e-11).tolist() == [True, False]
    others = [(68.535, 37913.1), (68.525, 37910.0), (68.532, 37912.0)]
    report = adapters["float64"].diagram(domain, np.array([sides[2], *others])).check()
    assert report, report
    # Two exchanged generators beside the slit are found.
    domain = clvoro.Polygon(slit(1e-6))
    points = np.array([(0.3, 0.8), (0.7, 0.6), (0.8, 0.9)])
    diagram = adapters["float32"].diagram(domain, points)
    arrays = {name: getattr(diagram, name) for name in diagram._arrays}
    arrays["points"] = arrays["points"][[0, 2, 1]]
    report = Diagram(domain, arrays).check()
    assert any("nearest generators" in str(finding) for finding in report.findings)


def test_one_generator_on_the_boundary_has_its_precision(adapters):
    """Positions are moved into the polygon in float64. The lengths show the precision of the mesh."""
    for angle in (0.1, 0.2, 0.3):
        turned = UNIT @ np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
        domain = clvoro.Polygon(turned)
        for middle in (turned + np.roll(turned, -1, axis=0)) / 2:
            for real, adapter in adapters.items():
                report = adapter.diagram(domain, middle[None]).check()
                assert report, report
                assert real in str(report)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("method", ["coupled", "weighted", "exact"])
def test_pieces_of_one_cell_each_have_no_potential(adapters, method):
    """The source of an isolated cell minus its mean is 0 up to round-off."""
    corner, rng = np.array([(0, 0), (1, 0), (0.3, 0.7)]), np.random.default_rng(5)
    domain = clvoro.Polygon.from_pieces([[corner * rng.uniform(0.1, 0.9) + (k % 4, k // 4)] for k in range(12)])
    points = domain.inner_points()
    for adapter in adapters.values():
        result = adapter.run(domain, 0.3, points=points, method=method, max_steps=2)
        report = result.check()
        assert report, report
