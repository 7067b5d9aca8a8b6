"""Points that move away from skew faces and faces far from orthogonal."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg.lapack
from threadpoolctl import threadpool_info, threadpool_limits

import clvoro
from clvoro.finite_volumes.repair import relaxation
from clvoro.finite_volumes.repair.patch import LIMITS
from clvoro.finite_volumes.repair.relaxation import face_measures, relax_points
from clvoro.mesh.faces import Faces
from clvoro.mesh.geometry import polygon_areas
from tests.finite_volumes.test_straight_walls import concave_by, polygons


def ell(ctx, steps: int) -> Faces:
    """Return an L of 121 cells after some of Lloyd's steps."""
    domain = clvoro.Polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)])
    adapter = clvoro.Adapter(ctx)
    points = np.random.default_rng(5).random((150, 2)) * 0.98 + 0.01
    diagram = adapter.diagram(domain, points[domain.contains(points)])
    for _ in range(steps):
        diagram = adapter.diagram(domain, diagram.centroids)
    return diagram.solver_mesh(collapse=False)


@pytest.fixture(scope="module")
def mesh(ctx) -> Faces:
    """Some faces are bad."""
    return ell(ctx, 1)


def test_angles_and_skewness_are_those_of_the_prisms(mesh):
    angle, skewness = face_measures(mesh)
    exact, k = mesh.measures, len(mesh.owner)
    np.testing.assert_allclose(np.degrees(angle), exact.non_orthogonality[:k], atol=1e-6)
    np.testing.assert_allclose(skewness, exact.skewness[:k], rtol=1e-6, atol=1e-6)


def test_bad_faces_become_fewer_and_nothing_else_suffers(mesh):
    relaxed = relax_points(mesh, mesh.domain.boundaries.index)
    before, after = face_measures(mesh), face_measures(relaxed)
    assert before[0].max() > np.radians(20)
    assert after[0].max() < np.radians(19)
    assert after[1].max() < 1.9
    assert relaxed.area_change == pytest.approx(mesh.area_change, abs=1e-12)
    held = np.unique(mesh.corners[mesh.starts[mesh.n_inner] :])
    np.testing.assert_array_equal(relaxed.points[held], mesh.points[held])
    assert max(map(concave_by, polygons(relaxed))) < 1e-4
    np.testing.assert_allclose(polygon_areas(relaxed), polygon_areas(mesh), rtol=0.3)
    shortest = [m.measures.shortest_edge.min() for m in (mesh, relaxed)]
    assert shortest[1] >= 0.9 * min(shortest[0], 0.05)


def test_many_bad_faces_raise_the_limits(mesh, monkeypatch):
    """Only what is beyond the second limits is improved: fewer points move."""
    parts, worst = mesh.domain.boundaries.index, np.sort(face_measures(mesh)[0])[-2:]
    assert worst[0] > np.radians(19)
    usual = relax_points(mesh, parts, straight=False)
    second = (worst.mean(), 9.0)
    monkeypatch.setattr(relaxation, "_LIMITS", (LIMITS, second))
    monkeypatch.setattr(relaxation, "_MOST", 1)
    monkeypatch.setattr(relaxation, "_NOT_ADAPTED", 1)
    relaxed = relax_points(mesh, parts, straight=False)
    assert face_measures(relaxed)[0].max() < second[0]
    moved = [(m.points != mesh.points).any(axis=1).sum() for m in (relaxed, usual)]
    assert 0 < moved[0] < moved[1]


def test_blas_has_one_thread_meanwhile(mesh, monkeypatch):
    """Otherwise the bits would depend on the number of cores."""
    found, solve = [], scipy.linalg.lapack.dposv

    def threads() -> set[int]:
        return {x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"}

    def spy(*args, **options):
        found.append(threads())
        return solve(*args, **options)

    monkeypatch.setattr(scipy.linalg.lapack, "dposv", spy)
    with threadpool_limits(2, user_api="blas"):
        relax_points(mesh, mesh.domain.boundaries.index)
        assert threads() == {2}
    assert found
    assert all(x == {1} for x in found)


def test_points_far_from_bad_faces_stay(ctx):
    """Pull one vertex aside: only its surroundings move."""
    mesh = ell(ctx, 4)
    mesh = relax_points(mesh, mesh.domain.boundaries.index)
    p = int(np.argmin(np.hypot(*(mesh.points - 0.25).T)))
    points = mesh.points.copy()
    points[p] += 0.02
    pulled = replace(mesh, points=points)
    relaxed = relax_points(pulled, pulled.domain.boundaries.index)
    assert face_measures(pulled)[0].max() > np.radians(22)
    assert face_measures(relaxed)[0].max() < np.radians(20)
    moved = np.hypot(*(relaxed.points - pulled.points).T)
    assert moved[p] > 0.005
    assert moved[np.hypot(*(mesh.points - mesh.points[p]).T) > 0.5].max() == 0


def test_faces_remain_where_too_many_cells_are_bad(mesh, monkeypatch):
    """Points move all the same, and a warning says where and what helps."""
    parts = mesh.domain.boundaries.index
    points = mesh.points.copy()
    at = int(np.argmin(np.hypot(*(points - 0.25).T)))
    points[at] += 0.05  # cells there are inverted
    pulled = replace(mesh, points=points)
    monkeypatch.setattr(relaxation, "_TRIES", ())
    for most, few in ((100, True), (0, False)):
        monkeypatch.setattr(relaxation, "_MOST_PLACES", most)
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            made = relax_points(pulled, parts)
        assert (face_measures(made)[0].max() < np.radians(20)) == few
        assert [bool(WARNED.search(str(w.message))) for w in seen] == ([] if few else [True])


WARNED = re.compile(r"^\d+ cells of the mesh .* at \(0\.[23].*, 0\.[23].*\), .*simplified\(1\.5 \* h\)")


def test_a_mesh_that_was_not_adapted_is_left_alone(ctx):
    points = np.random.default_rng(8).random((300, 2))
    given = clvoro.Adapter(ctx).diagram(clvoro.Box((0, 0), (1, 1)), points)
    mesh = given.solver_mesh(collapse=False)
    assert relax_points(mesh, mesh.domain.boundaries.index) is mesh
