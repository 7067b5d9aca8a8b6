"""Runs in solids: sizes at walls, stations, starts, and the same bits."""

import numpy as np
import pytest

import clvoro
from clvoro.adaptation.state import MeshState
from clvoro.errors import InputError
from tests.tessellation.test_own_planes import corner

H = 0.3


@pytest.fixture
def volumes(monkeypatch):
    """The volumes of the device's cells at the end of a run, in the order of labels."""
    found, before = [], MeshState.finalize

    def finalize(mesh):
        again = before(mesh)
        found[:] = [mesh.to_host(mesh.t.volumes, mesh.domain.frame[1] ** 3)]
        return again

    monkeypatch.setattr(MeshState, "finalize", finalize)
    return found


def test_cells_in_a_solid_with_a_concave_crease(ctx, volumes):
    solid, adapter, told = corner(), clvoro.Adapter(ctx), []
    adapter.on_work = told.append
    result = adapter.run(solid, H, "fast")
    work = [part.split(" of ")[0] for part in told[:3] + told[-1:]]
    assert work == ["diagram", "settling", "walls", "cells without walls"]
    around = solid.stations(lambda x: np.full(len(x), H))
    stations = around.points
    lengths = np.cbrt(volumes[0])
    assert solid.contains(result.points).all()
    assert volumes[0].sum() == pytest.approx(solid.measure, rel=1e-12)
    assert np.abs(lengths / H - 1).mean() < 0.01
    assert len(stations) > 3
    assert result.points[: len(stations)] == pytest.approx(stations, abs=1e-12)
    assert lengths[: len(stations)] == pytest.approx(H, rel=0.02)
    others = result.points[len(stations) :]
    gaps = np.linalg.norm(others[:, None] - around.centers, axis=2) / around.radii
    assert 0.99 < gaps.min() < 1.3
    again = adapter.run(solid, H, "fast")
    assert np.array_equal(again.points, result.points)


def test_curved_walls(ctx, volumes, tmp_path):
    ball, adapter = clvoro.Solid.ball((0, 0, 0), 1.0, edge=0.1), clvoro.Adapter(ctx, dtype="float32")
    result = adapter.run(ball, 0.3, "fast")
    result.save(tmp_path / "ball.vtu")
    back = clvoro.load(tmp_path / "ball.vtu")
    assert back.check().ok
    assert np.array_equal(back.diagram.volumes, result.diagram.volumes)
    assert result.diagram.subset(result.points[:, 2] > 0).check().ok
    # Wall polygons of two meshes lie apart: what is constant stays, and so does the mass.
    other = adapter.diagram(ball, 0.97 * result.points)
    assert result.transfer(np.ones(len(result.points)), other) == pytest.approx(1)
    moved = result.transfer(result.diagram.centroids[:, 0], other)
    assert np.abs(moved - other.centroids[:, 0]).max() < 0.1
    mass = result.diagram.volumes @ result.diagram.centroids[:, 0]
    assert moved @ other.volumes == pytest.approx(mass, abs=1e-9)
    # The run measures cells as the mesh has them.
    assert volumes[0].sum() == pytest.approx(result.diagram.volumes.sum(), rel=0.01)
    assert np.abs(np.cbrt(volumes[0]) / 0.3 - 1).mean() < 0.01
    assert np.abs(result.size_error).mean() < 0.01


def test_exact_sizes_and_given_generators(ctx):
    cube, adapter = clvoro.Solid.box((0, 0, 0), (1, 1, 1)), clvoro.Adapter(ctx)
    result = adapter.run(cube, 0.2, "fast", method="exact")
    assert np.abs(result.size_error).max() < 5e-3
    near = adapter.run(cube, 0.2, "fast", points=result.points)
    assert len(near.points) == len(result.points)
    assert near.history["step"][-1] < result.history["step"][-1]


def test_exact_sizes_are_those_of_the_mesh_at_curved_walls(ctx):
    drum = clvoro.Solid.cylinder((0, 0, 0), (0, 0, 1), 0.6, edge=0.1)
    result = clvoro.Adapter(ctx).run(drum, 0.25, "fast", method="exact")
    # With those of the device's cells they are 0.006 and 0.04, and there is one cell too many.
    assert np.abs(result.size_error).mean() < 1.5e-3
    assert np.abs(result.size_error).max() < 0.015


def test_cells_that_walls_do_not_bound_are_warned_of(ctx):
    ball = clvoro.Solid.ball((0, 0, 0), 1.0, edge=0.2)
    with pytest.warns(clvoro.errors.MismatchWarning, match="do not bound"), np.errstate(all="ignore"):
        clvoro.Adapter(ctx).run(ball, 0.9, "fast")


@pytest.mark.filterwarnings("ignore::clvoro.errors.SizeErrorWarning", "ignore::clvoro.errors.MismatchWarning")
def test_cells_at_a_sharp_tip_may_have_few_faces(ctx):
    cone = clvoro.Solid.cone((0, 0, 0), (0, 0, 2), 1.0, edge=0.13)
    result = clvoro.Adapter(ctx).run(cone, 0.25, "fast")
    assert result.diagram.volumes.sum() == pytest.approx(cone.measure, rel=0.06)


def test_teeth_that_stations_cut_off_get_their_number_of_cells(ctx):
    turn = np.pi / 6 * (np.arange(3)[:, None] + [0.02, 0.14, 0.36, 0.48]).ravel()
    teeth = np.tile([0.75, 1.0, 1.0, 0.75], 3)[:, None] * np.column_stack([np.cos(turn), np.sin(turn)])
    gear = clvoro.Solid.extruded(clvoro.Polygon([*teeth, (0.08, 0.29), (0.3, 0)]), 0, 0.4)
    result = clvoro.Adapter(ctx).run(gear, 0.1)
    # By the number of all cells alone, teeth have 13 to 17 cells in place of 15: .014 and .16.
    assert np.abs(result.size_error).mean() < 3e-3
    assert np.abs(result.size_error).max() < 0.05
    # With one scale of log(L / h) the projection pushes cells against others: .30.
    assert result.quality.min() > 0.4


def test_what_solids_do_not_have_is_refused(ctx):
    adapter, cube = clvoro.Adapter(ctx), clvoro.Solid.box((0, 0, 0), (1, 1, 1))
    with pytest.raises(InputError, match="no power diagrams"):
        adapter.run(cube, 0.4, method="transport")
    with pytest.raises(InputError, match="no power diagrams"):
        adapter.transport(cube, [(0.3, 0.5, 0.5), (0.7, 0.5, 0.5)], [0.5, 0.5])
    with pytest.raises(InputError, match="leave out `periodic`"):
        clvoro.Solid.outside(cube, clvoro.Box((-1, -1, -1), (2, 2, 2), periodic=True))


def test_generators_without_a_cell_in_the_mesh_are_deleted(ctx, monkeypatch):
    """Fixed ones stay."""
    own, delete, seen = MeshState.sizes_over_mesh, MeshState.delete_lost, {}

    def sizes_over_mesh(mesh):
        factors = own(mesh)
        assert np.isfinite(factors).all()
        labels = mesh.labels.get()[: mesh.n]
        lost = np.isin(labels, [0, *labels[labels >= mesh.fixed][:3]])
        factors[lost] = np.inf
        seen.update(n=mesh.total, lost=labels[lost])
        return factors

    def delete_lost(mesh, lost):
        count = delete(mesh, lost)
        seen.update(count=count, left=seen["n"] - mesh.total, kept=np.isin(seen["lost"], mesh.labels.get()))
        return count

    monkeypatch.setattr(MeshState, "sizes_over_mesh", sizes_over_mesh)
    monkeypatch.setattr(MeshState, "delete_lost", delete_lost)
    clvoro.Adapter(ctx).run(corner(), H, "fast", method="exact")
    assert seen["count"] == seen["left"] == 3
    assert np.array_equal(seen["lost"][seen["kept"]], [0])
