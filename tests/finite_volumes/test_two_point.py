"""The two-point flux: its distances, and its order on graded meshes with walls."""

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import clvoro
from clvoro import sizing

PENTAGON = [(0, 0), (2, 0.1), (2.2, 1.2), (1, 1.6), (-0.1, 1)]
ISLAND = [(0.7, 0.5), (1.4, 0.6), (0.9, 1.0)]


def u(x):
    return np.sin(2 * x[:, 0]) * np.cos(1.3 * x[:, 1]) + np.exp(x[:, 0] / 2)


def minus_laplacian(x):
    return (4 + 1.69) * np.sin(2 * x[:, 0]) * np.cos(1.3 * x[:, 1]) - np.exp(x[:, 0] / 2) / 4


def errors(mesh, walls, place="foot"):
    """Return the largest and the mean square error for u at a place on each wall."""
    d = mesh.diagram
    n, f = len(d), d.solver_mesh(walls, collapse=False)
    matrix, right = scipy.sparse.lil_array((n, n)), d.volumes * minus_laplacian(d.centroids)
    for i, j, a, value in zip(f.owner, f.neighbor, f.conductance, u(getattr(f, place)), strict=True):
        matrix[i, i] += a
        if j < 0:
            right[i] += a * value
        else:
            matrix[j, j] += a
            matrix[i, j] -= a
            matrix[j, i] -= a
    off = np.abs(scipy.sparse.linalg.spsolve(matrix.tocsc(), right) - u(d.points))
    return off.max(), np.sqrt((d.volumes * off**2).sum() / d.volumes.sum())


@pytest.mark.sparse(1)
@pytest.mark.parametrize("walls", ["straight", "exact"])
def test_errors_are_of_second_order_up_to_the_walls(walls):
    domain = clvoro.Polygon(PENTAGON, [ISLAND])
    size = sizing.Distance(domain.boundary("hole-1"), h_min=0.05, slope=0.2, h_max=0.2)
    meshes = [clvoro.adapt(domain, size * s, "fast") for s in (1, 0.25)]
    step = np.log(len(meshes[1].points) / len(meshes[0].points)) / 2
    (most, mean), (finer_most, finer_mean) = (errors(mesh, walls) for mesh in meshes)
    assert np.log(most / finer_most) / step > 1.6
    assert np.log(mean / finer_mean) / step > 1.85
    (most, _), (finer_most, _) = (errors(mesh, walls, "center") for mesh in meshes)
    assert np.log(most / finer_most) / step < 1.4


@pytest.mark.parametrize("dim", [2, 3])
def test_faces_are_those_of_the_diagram(dim):
    """In a box, where nothing is straightened: areas, distances, names; u = x is solved exactly."""
    box = clvoro.Box((0,) * dim, (1,) * dim, names={"inlet": "xMin"})
    d = clvoro.voronoi(box, np.random.default_rng(dim).random((60, dim)))
    f = d.solver_mesh(collapse=False)
    there = {(i, j): k for k, (i, j) in enumerate(zip(d.faces.owner, d.faces.neighbor, strict=True))}
    rows = [there[i, j] for i, j in zip(f.owner, f.neighbor, strict=True)]
    assert len(rows) == len(there)
    np.testing.assert_allclose(f.area, d.faces.area[rows], rtol=1e-9, atol=1e-14)
    large = f.area > 1e-6
    np.testing.assert_allclose(f.normal[large], d.faces.normal[rows][large], atol=1e-7)
    np.testing.assert_allclose((f.near + f.far)[large], d.faces.distance[rows][large], rtol=1e-9, atol=1e-14)
    assert np.array_equal(f.boundary, d.faces.boundary[rows])
    # The flux of u = x is exact if u on walls is that of the foot.
    beyond = np.where(f.neighbor >= 0, d.points[f.neighbor, 0], f.foot[:, 0])
    flux = (beyond - d.points[f.owner, 0]) / (f.near + f.far)
    np.testing.assert_allclose(flux[large], f.normal[large, 0], atol=1e-7)


def test_seams_have_the_distance_to_the_image():
    box = clvoro.Box((0, 0), (1, 1), periodic=(True, False))
    d = clvoro.voronoi(box, [(0.1, 0.5), (0.5, 0.5), (0.9, 0.5)])
    f = d.solver_mesh()
    between = f.neighbor >= 0
    seam = between & (np.abs(f.owner - f.neighbor) == 2)
    assert seam.sum() == 2
    assert (f.near + f.far)[between] == pytest.approx(np.where(seam[between], 0.2, 0.4))
    assert sorted(f.foot[seam, 0]) == pytest.approx([0, 1])


def test_a_generator_behind_the_plane_of_a_wall_uses_the_center():
    """At a corner of 315 degrees one cell has walls whose planes pass behind its generator."""
    ring = [(0, 0), (2, 0), (2, 1), (1, 1), (2, 1.9), (2, 2), (0, 2)]
    d = clvoro.voronoi(clvoro.Polygon(ring), [(0.9, 1.02), (0.3, 0.3), (1.7, 0.3), (0.4, 1.7)])
    f = d.solver_mesh("exact")
    behind = f.near * 0 + ((f.center - d.points[f.owner]) * f.normal).sum(axis=1) <= 0
    assert behind.any()
    assert (f.near > 0).all()
    assert np.array_equal(f.foot[behind], f.center[behind])
