"""Faces that connect other cells, where points alone do not help."""

import copy

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.finite_volumes.repair import relaxation
from clvoro.finite_volumes.repair.patch import take_patch
from clvoro.finite_volumes.repair.pricing import PricedPatch
from clvoro.finite_volumes.repair.reconnection import _Connections
from clvoro.finite_volumes.repair.relaxation import relax_points
from clvoro.mesh.faces import Faces
from tests.finite_volumes.repair.test_patch import with_positions
from tests.finite_volumes.test_straight_walls import concave_by, polygons

# A coast with spits, bays and an island, about as fine as the cells.
COAST = [
    (0, 0),
    (0.31, 0.02),
    (0.4, 0.12),
    (0.46, 0.01),
    (1, 0),
    (1, 0.4),
    (0.82, 0.45),
    (1, 0.5),
    (1, 1),
    (0.6, 1),
    (0.55, 0.83),
    (0.52, 1),
    (0.2, 1),
    (0.1, 0.9),
    (0, 1),
    (0, 0.55),
    (0.14, 0.5),
    (0, 0.46),
]
ISLAND = [(0.4, 0.45), (0.62, 0.5), (0.41, 0.53)]
DOMAIN = clvoro.Polygon(COAST, [ISLAND], names={"island": [18, 19, 20], "south": range(5)})


def coast(ctx, seed: int) -> clvoro.Diagram:
    """Random generators after thirty steps of Lloyd's."""
    points = np.random.default_rng(seed).random((190, 2))
    adapter = clvoro.Adapter(ctx)
    diagram = adapter.diagram(DOMAIN, points[DOMAIN.contains(points)])
    for _ in range(30):
        inside = DOMAIN.contains(diagram.centroids)
        points = np.where(inside[:, None], diagram.centroids, diagram.points)
        diagram = adapter.diagram(DOMAIN, points)
    return diagram


def unrepaired(diagram) -> Faces:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(relaxation, "relax_points", lambda mesh, *_: mesh)
        return copy.copy(diagram).solver_mesh()


def lengths_of_parts(mesh) -> np.ndarray:
    walls = slice(mesh.n_inner, mesh.n_outer)
    a, b = mesh.points[mesh.corners.reshape(-1, 2)[walls]].swapaxes(0, 1)
    part = DOMAIN.boundaries.index[-1 - mesh.neighbor[walls]]
    return np.bincount(part, np.hypot(*(b - a).T))


@pytest.mark.sparse(1)
@pytest.mark.parametrize("seed", [0, 2])
def test_repaired_meshes_are_accepted_and_whole(ctx, seed):
    diagram = coast(ctx, seed)
    before, after = unrepaired(diagram), diagram.solver_mesh()
    was, now = before.measures, after.measures
    rows = slice(0, len(after.owner))
    assert was.non_orthogonality.max() > 20 or was.skewness.max() > 2 or was.concave.any()
    assert now.non_orthogonality.max() <= 19.01
    assert now.skewness[rows].max() <= 1.91
    assert not now.concave.any()
    assert diagram.check(solver="openfoam")
    # Each generator has its cell, the cells cover what the walls enclose, and overlap nowhere.
    cells = polygons(after)
    assert len(cells) == len(diagram)
    total = shapely.union_all(cells).area
    assert total == pytest.approx(sum(p.area for p in cells), rel=1e-9)
    assert total == pytest.approx(DOMAIN.measure * (1 + after.area_change), rel=1e-12)
    # Faces are in order, each pair of cells has one, and named parts keep their places.
    pairs = list(zip(after.owner[: after.n_inner].tolist(), after.neighbor[: after.n_inner].tolist(), strict=True))
    assert pairs == sorted(set(pairs))
    assert (after.owner[: after.n_inner] < after.neighbor[: after.n_inner]).all()
    assert (np.diff(-1 - after.neighbor[after.n_inner : after.n_outer]) >= 0).all()
    assert lengths_of_parts(after) == pytest.approx(lengths_of_parts(before), rel=0.03)
    areas = np.array([p.area for p in cells])
    assert np.median(np.abs(areas / diagram.volumes - 1)) < 0.02


@pytest.mark.slow
def test_points_alone_do_not_suffice(ctx, monkeypatch):
    """Without other connections some of these meshes remain beyond the limits."""

    def not_repaired(given, *_):
        yield from ()
        return given

    monkeypatch.setattr(relaxation, "repaired", not_repaired)
    measures = [coast(ctx, seed).solver_mesh().measures for seed in (0, 2)]
    assert any(m.concave.any() or m.non_orthogonality.max() > 20 or m.skewness.max() > 2 for m in measures)


def test_all_changes_of_faces_keep_the_mesh_consistent(ctx):
    """Each change gives cells that are simple rings, with the same sum of areas as their outline."""
    mesh = unrepaired(coast(ctx, 1))
    patch, ring = with_positions(mesh, take_patch(mesh, np.ones(mesh.n_cells, bool)))
    given = PricedPatch.of(patch)
    connections, count = _Connections(given, ring), {-1: 0, 0: 0}
    for face in given.cells.faces.tolist():
        for made in connections.changes(face):
            fewer = len(made.owner) - len(patch.owner)
            count[fewer] += 1
            changed = PricedPatch.of(made, given.goals)
            if changed is None:
                continue
            inner = made.neighbor >= 0
            assert (made.owner[inner] < made.neighbor[inner]).all()
            areas = changed.cells.figures(*made.points.T).area
            a, b = made.points[made.ends[made.walls]].swapaxes(0, 1)
            outline = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2
            assert areas.sum() == pytest.approx(outline, rel=1e-9)
            if fewer == 0:
                new = {int(made.owner[face]), int(made.neighbor[face])}
                assert new != {int(patch.owner[face]), int(patch.neighbor[face])}
                assert made.half_face[face] == -1
            fixed = patch.points[patch.fixed]
            assert {tuple(p) for p in fixed.tolist()} <= {tuple(p) for p in made.points.tolist()}
    assert min(count.values()) > 100


@pytest.mark.slow
def test_a_passage_one_cell_wide_gets_faces_that_are_not_parallel(ctx):
    """OpenFOAM refuses cells whose faces to others all have the same direction."""
    domain = clvoro.Polygon([(0, 0), (3, 0), (3, 0.22), (0, 0.18)])
    points = np.column_stack([np.arange(15) * 0.2 + 0.1, np.full(15, 0.1)])
    points[:, 0] += np.random.default_rng(0).uniform(-0.01, 0.01, 15)
    diagram = clvoro.Adapter(ctx).diagram(domain, points)
    assert unrepaired(diagram).measures.determinant.min() < 1e-4
    m = diagram.solver_mesh().measures
    inside = m.geometry.centroids[:, 0]
    inside = (inside > 0.3) & (inside < 2.7)
    assert m.determinant[inside].min() > 1e-3
    assert m.non_orthogonality.max() < 30  # the faces lean


def test_a_mesh_that_needs_nothing_stays(ctx):
    diagram = clvoro.Adapter(ctx).diagram(
        clvoro.Polygon([(0, 0), (1, 0), (1, 1), (0, 1)]), [(0.3, 0.3), (0.7, 0.3), (0.5, 0.75)]
    )
    mesh = unrepaired(diagram)
    assert max(map(concave_by, polygons(mesh))) < 0
    assert relax_points(mesh, diagram.domain.boundaries.index) is mesh
