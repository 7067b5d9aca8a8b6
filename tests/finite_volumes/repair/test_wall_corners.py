"""Walls that change where a cell would be refused: tips of spits, bumps between bays, dead ends."""

import copy
import warnings
from typing import NamedTuple

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.errors import MismatchWarning
from clvoro.finite_volumes.repair import relaxation
from clvoro.finite_volumes.repair.patch import put_back, restored, take_patch
from clvoro.finite_volumes.repair.pricing import PricedPatch
from clvoro.finite_volumes.repair.wall_corners import WallCorners, WallEdges, _meet
from tests.finite_volumes.repair.test_patch import with_positions
from tests.finite_volumes.repair.test_reconnection import coast, unrepaired
from tests.finite_volumes.test_straight_walls import concave_by, polygons


class Place(NamedTuple):
    """A piece of a real coast about one cell, which has the size 1."""

    vertices: list[tuple[float, float]]
    points: list[tuple[float, float]]
    refused: str
    """What OpenFOAM refuses if walls do not change."""
    cut: tuple[float, float] | None = None
    """The corner that is cut off."""


PLACES = {
    "blunt tip": Place(
        [
            (-1.99, -1.04),
            (-1.76, -0.68),
            (-1.36, -0.77),
            (-1.1, -0.35),
            (-0.43, -0.44),
            (-0.21, -0.02),
            (-0.49, 0.32),
            (-1.09, 0.01),
            (-1.55, 0.1),
            (-1.81, -0.16),
            (-2, -0.09),
            (-2, 2),
            (2, 2),
            (2, -2),
            (-2, -2),
            (-2, -1.03),
        ],
        [
            (1.93, -1.64),
            (0.29, -1.45),
            (1.5, 0.79),
            (-1.61, -1.37),
            (1.08, -0.16),
            (-0.41, 1.86),
            (0.41, 0.78),
            (-1.2, 1.48),
            (0, -0.29),
            (-1.94, 0.37),
            (-1.25, 0.47),
            (1.12, 1.71),
            (-0.72, -0.8),
        ],
        "concavity",
        (-0.21, -0.02),
    ),
    "wide tip": Place(
        [
            (1.07, -1.26),
            (0.58, -0.17),
            (0.11, -0.19),
            (-0.15, -0.84),
            (-0.57, -1.1),
            (-1.24, -0.99),
            (-1.56, -0.43),
            (-1.43, 0.05),
            (-0.39, 0.88),
            (-0.41, 1.25),
            (-0.03, 1.6),
            (-0.02, 2),
            (2, 2),
            (2, -2),
            (0.01, -2),
            (0.11, -1.72),
        ],
        [
            (-1.42, -0.66),
            (1.98, 1.74),
            (-0.55, 0.42),
            (0.09, 0.85),
            (1.22, -1.52),
            (0.83, -0.31),
            (1.36, -1.19),
            (1.17, 1.56),
            (0.47, 0.1),
        ],
        "concavity",
        (0.11, -0.19),
    ),
    "bump between bays": Place(
        [
            (0.93, -1.86),
            (0.45, -1.7),
            (-0.37, -0.89),
            (-0.39, -0.25),
            (-0.06, 0.07),
            (-0.05, 0.4),
            (-0.38, 0.73),
            (-0.32, 1.53),
            (0.12, 1.87),
            (1.05, 1.87),
            (1.19, 2),
            (2, 2),
            (2, -2),
            (0.98, -2),
        ],
        [(0.84, 0.22), (0.1, 1.3), (-0.07, -0.01), (1.34, -1.99), (1.31, -0.54), (1.51, 1.18), (0.72, -1.48)],
        "concavity",
    ),
    "dead end": Place(
        [
            (1.58, 0.26),
            (1.31, -0.42),
            (0.45, -0.45),
            (0.1, -0.08),
            (0.08, 0.61),
            (0.4, 1.08),
            (1.2, 1.31),
            (1.21, 2),
            (2, 2),
            (2, 0.66),
        ],
        [(1.52, 1.3), (1.85, 1.86), (0.95, 1.1), (0.7, -0.4)],
        "determinant",
    ),
    "dead end with a corner": Place(
        [
            (-0.68, -1.76),
            (-0.99, -1.44),
            (-0.98, 0.17),
            (-0.57, 0.55),
            (-0.07, 0.56),
            (0.92, -0.47),
            (0.6, -0.81),
            (0.59, -1.45),
            (1.22, -1.76),
            (0.98, -2.5),
            (-0.69, -2.5),
        ],
        [(0.6, -0.79), (0.72, -0.58), (0.89, -2.11)],
        "determinant",
    ),
}


def made(diagram) -> tuple[clvoro.mesh.faces.Faces, list[str]]:
    """The solver mesh, and warnings of corners that are cut off."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always", MismatchWarning)
        mesh = diagram.solver_mesh()
    return mesh, [str(w.message) for w in seen if "cut off" in str(w.message)]


@pytest.mark.filterwarnings("ignore::clvoro.errors.MismatchWarning")
@pytest.mark.parametrize(
    "name",
    [
        "blunt tip",
        pytest.param("wide tip", marks=pytest.mark.slow),
        "dead end",
        "dead end with a corner",
        pytest.param("bump between bays", marks=pytest.mark.slow),
    ],
)
def test_refused_cells_become_accepted(ctx, name, monkeypatch):
    place = PLACES[name]
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Polygon(place.vertices), np.array(place.points))
    mesh, warned = made(diagram)
    report = diagram.check(solver="openfoam")
    assert report, report
    cells = polygons(mesh)
    assert max(map(concave_by, cells)) < 0
    # The cells cover what the walls enclose, and overlap nowhere. The names of boundaries keep their walls.
    total = shapely.union_all(cells).area
    assert total == pytest.approx(sum(p.area for p in cells), rel=1e-9)
    assert total == pytest.approx(diagram.domain.measure * (1 + mesh.area_change), rel=1e-12)
    assert (np.diff(-1 - mesh.neighbor[mesh.n_inner : mesh.n_outer]) >= 0).all()
    assert len(warned) == (place.cut is not None)
    if place.cut is not None:
        assert f"({place.cut[0]:g}, {place.cut[1]:g})" in warned[0]
        assert not (mesh.points == place.cut).all(axis=1).any()
    # Without changes of walls it is refused.
    usual = relaxation.repaired

    def repaired(given, ring, walls=None):
        return given if walls else (yield from usual(given, ring))

    monkeypatch.setattr(relaxation, "repaired", repaired)
    before = copy.copy(diagram).check(solver="openfoam")
    assert not before
    assert not before[place.refused].ok


def test_all_changes_of_walls_keep_the_mesh_consistent(ctx):
    """Cells are simple rings, and have the area of their outline; what is taken back to the mesh is the same."""
    mesh = unrepaired(coast(ctx, 1))
    every = np.ones(mesh.n_cells, bool)
    patch, _ = with_positions(mesh, take_patch(mesh, every))
    given = PricedPatch.of(patch)
    # Also corners that are convex.
    given.bent = np.ones(len(given.bent), bool)
    walls = WallEdges(np.empty((0, 2, 2)), np.empty(0, int), mesh.domain.boundaries.index)
    parts = mesh.domain.boundaries.index
    count = {-1: 0, 0: 0, 1: 0}
    for made in WallCorners(given, walls).changes(every):
        changed = PricedPatch.of(made, given.goals)
        if changed is None:
            continue
        count[int(np.clip(len(made.owner) - len(patch.owner), -1, 1))] += 1
        inner = made.neighbor >= 0
        assert (made.owner[inner] < made.neighbor[inner]).all()
        pairs = np.stack([made.owner, made.neighbor], axis=1)[inner]
        assert len(np.unique(pairs, axis=0)) == len(pairs)
        areas = changed.cells.figures(*made.points.T).area
        a, b = made.points[made.ends[made.walls]].swapaxes(0, 1)
        outline = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2
        assert areas.sum() == pytest.approx(outline, rel=1e-9)
        # Each part of the boundary begins and ends where it did.
        assert _ends_of_parts(made, parts) == _ends_of_parts(patch, parts)
        back = put_back(mesh, [restored(patch, made)])
        assert back.area_change == pytest.approx(outline / mesh.domain.measure - 1, abs=1e-12)
    assert min(count.values()) > 5


def _ends_of_parts(patch, parts) -> set:
    rows = np.flatnonzero(patch.walls)
    part = parts[-1 - patch.neighbor[rows]]
    ends = patch.points[patch.ends[rows]]
    begin = {(*x, k) for x, k in zip(ends[:, 0].tolist(), part.tolist(), strict=True)}
    end = {(*x, k) for x, k in zip(ends[:, 1].tolist(), part.tolist(), strict=True)}
    return begin ^ end


def test_corners_are_not_cut_off_through_another_wall(ctx):
    """Behind the tip is a pond."""
    place = PLACES["blunt tip"]
    diagram = clvoro.Adapter(ctx).diagram(clvoro.Polygon(place.vertices), np.array(place.points))
    mesh = unrepaired(diagram)
    every = np.ones(mesh.n_cells, bool)
    patch, _ = with_positions(mesh, take_patch(mesh, every))
    given = PricedPatch.of(patch)
    pond = np.array([[(-0.4, -0.06), (-0.36, 0.02)]])
    beside = pond - 0.6
    cuts = []
    for ends in (pond, beside):
        walls = WallEdges(ends, np.array([-1]), mesh.domain.boundaries.index)
        found = WallCorners(given, walls).changes(every)
        cuts.append({(cut.x, cut.y) for made in found for cut in made.cuts})
    assert cuts[1] - cuts[0] == {place.cut}


def test_walls_beside_a_patch_are_those_of_other_cells_nearby():
    ends = np.array([[(0, 0), (1, 0)], [(1, 0), (1, 1)], [(5, 5), (6, 5)], [(-9, -9), (9, 9)]], float)
    walls = WallEdges(ends, np.array([0, 1, 2, 3]), np.zeros(4, int))
    beside = walls.beside(np.array([1, 8]), np.array([(0.2, -0.5), (0.6, 0.5)]))
    assert beside.owner.tolist() == [0, 3]
    np.testing.assert_array_equal(beside.ends, ends[[0, 3]])


def test_segments_that_meet_a_triangle_are_those_of_shapely():
    rng = np.random.default_rng(3)
    met = 0
    for _ in range(20):
        triangle, segments = rng.random((3, 2)), rng.random((30, 2, 2))
        exact = shapely.intersects(shapely.Polygon(triangle), shapely.linestrings(segments))
        np.testing.assert_array_equal(_meet(triangle, segments), exact)
        met += exact.sum()
    assert 100 < met < 500
