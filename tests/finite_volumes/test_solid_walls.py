"""Meshes of solids: cells that end at a triangulated surface."""

import contextlib
import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import scipy
from scipy.spatial import ConvexHull

import clvoro
from clvoro.connectivity import following
from clvoro.errors import InputError, MismatchWarning
from clvoro.finite_volumes.solid_walls import balance, mend
from clvoro.finite_volumes.solid_walls.cures import Cures
from clvoro.finite_volumes.solid_walls.editing import judge
from clvoro.finite_volumes.solid_walls.mesh import _Maker, diagram_of, off_middle, outer_generators, solid_diagram
from clvoro.finite_volumes.solid_walls.near_walls import NearWalls
from clvoro.finite_volumes.solid_walls.settling import CellTargets
from clvoro.finite_volumes.solid_walls.wall_surface import WallSurface

H = 0.25


def el():
    """Return an L: a square of 2 without a quarter, of height 1."""
    flat = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)
    n = len(flat)
    vertices = np.concatenate([np.column_stack([flat, np.full(n, z)]) for z in (0.0, 1.0)])
    cap = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)])
    k = np.arange(n)
    after = (k + 1) % n
    side = np.concatenate([np.stack([k, after, after + n], axis=1), np.stack([k, after + n, k + n], axis=1)])
    return clvoro.Solid(vertices, np.concatenate([cap[:, ::-1], cap + n, side]))


SOLIDS = {
    "cube": lambda: clvoro.Solid.box((0, 0, 0), (1.2, 1, 1)),
    "L": el,
    "cylinder": lambda: clvoro.Solid.cylinder((0, 0, 0), (0, 0, 1), 0.7, edge=0.07),
    "ball": lambda: clvoro.Solid.ball((0, 0, 0), 0.8, edge=0.08),
}


def generators(solid):
    """Return a lattice that is a little disturbed, away from walls; around the crease of the L it is regular."""
    k = [np.arange(low + H / 2, high, H) for low, high in zip(solid.lower, solid.upper, strict=True)]
    x = np.stack(np.meshgrid(*k, indexing="ij"), axis=-1).reshape(-1, 3)
    fixed = (np.abs(x[:, :2] - 1) < 0.6 * H).all(axis=1)
    x += np.where(fixed, 0, 0.1)[:, None] * H * np.random.default_rng(1).uniform(-1, 1, x.shape)
    return x[solid.signed_distance(x) < -0.2 * H]


def whole_faces(ctx, solid, x, h):
    """Return the faces of the diagram of generators and outer generators in a box around the solid."""
    box = clvoro.Box(np.subtract(solid.lower, 4 * H), np.add(solid.upper, 4 * H))
    return clvoro.Adapter(ctx).diagram(box, np.concatenate([x, outer_generators(WallSurface(solid), x, h)])).faces


@pytest.fixture(scope="module", params=SOLIDS)
def made(request, ctx):
    solid = SOLIDS[request.param]()
    x = generators(solid)
    h = np.full(len(x), H)
    diagram = solid_diagram(WallSurface(solid), x, h, lambda x: whole_faces(ctx, solid, x, h))
    assert np.array_equal(diagram.home, np.arange(len(x)))
    return solid, diagram.faces


def test_outer_generators_of_a_lattice_differ():
    """Those of two generators behind each other would be at the same place."""
    x = np.stack(np.meshgrid(*[np.arange(0.1, high, 0.2) for high in (1.2, 1, 1)], indexing="ij"), axis=-1)
    x = x.reshape(-1, 3)
    placed = outer_generators(WallSurface(SOLIDS["cube"]()), x, np.full(len(x), 0.2001))
    assert len(placed) > 100
    assert scipy.spatial.KDTree(placed).query(placed, 2)[0][:, 1].min() > 0.1


def sides_of_cells(faces):
    """Return cell, begin and end of each side of each face as seen from each of its cells."""
    face = np.repeat(np.arange(len(faces)), np.diff(faces.starts))
    here, after = faces.corners, faces.corners[following(faces.starts)]
    inner = faces.neighbor[face] >= 0
    return (
        np.concatenate([faces.owner[face], faces.neighbor[face][inner]]),
        np.concatenate([here, after[inner]]),
        np.concatenate([after, here[inner]]),
    )


def test_cells_that_a_collapse_would_spoil_stay_as_they_are(made, monkeypatch):
    _, faces = made
    calls = []

    def spoiled(before, made):
        """Reject all changed cells at first, then none."""
        calls.append(mend.changed_cells(before, made))
        return calls[0] if len(calls) == 1 else np.zeros(before.n_cells, bool)

    monkeypatch.setattr(mend, "spoiled_near_walls", spoiled)
    diagram_of(faces).solver_mesh()
    first, *others = calls
    assert len(others) == first.any()
    assert not any((first & changed).any() for changed in others)


def test_a_cell_with_a_vertex_beyond_its_other_side_is_spoiled(made):
    _, faces = made
    assert not mend.spoiled_near_walls(faces, faces).any()
    cell = int(faces.owner[-1])
    points = faces.points.copy()
    mine = np.flatnonzero((faces.owner == cell) | (faces.neighbor == cell))
    vertex = faces.corners[faces.starts[mine[0]]]
    points[vertex] += 3 * (faces.generators[cell] - points[vertex])
    assert mend.spoiled_near_walls(faces, replace(faces, points=points))[cell]


def test_an_edge_that_runs_back_is_found_between_cells_that_touch_a_wall_in_vertices(ctx):
    """The two cells at the concave crease of an L have no wall. Tetrahedra at their common face are inverted."""
    k = np.arange(0.5, 6)
    x = np.stack(np.meshgrid(k, k, k, indexing="ij"), axis=-1).reshape(-1, 3)
    faces = clvoro.Adapter(ctx).diagram(clvoro.Box((0, 0, 0), (6, 6, 6)), x).faces
    faces = faces.part(~(faces.generators[:, :2] > 3).all(axis=1))[0]
    judged = np.ones(faces.n_cells, bool)
    assert not mend.rejected_at_walls(faces, judged).size
    at_crease = scipy.spatial.KDTree(faces.generators).query([(2.5, 2.5, 2.5), (2.5, 2.5, 3.5)])[1]
    assert not mend.at_wall(faces)[at_crease].any()
    p, q = scipy.spatial.KDTree(faces.points).query([(2, 2, 3), (3, 2, 3)])[1]
    n, loops = len(faces.points), np.split(faces.corners, faces.starts[1:-1])
    for row, loop in enumerate(loops):
        for i, edge in enumerate(zip(loop, np.roll(loop, -1), strict=True)):
            if set(edge) == {p, q}:
                loops[row] = np.insert(loop, i + 1, [n, n + 1] if edge == (p, q) else [n + 1, n])
    folded = replace(
        faces,
        points=np.concatenate([faces.points, [(2.51, 2, 3), (2.49, 2, 3)]]),
        corners=np.concatenate(loops),
        starts=np.append(0, np.cumsum([len(loop) for loop in loops])),
    )
    assert np.isin(at_crease, mend.rejected_at_walls(folded, judged)).all()


def test_cells_are_closed(made):
    _, faces = made
    cell, begin, end = sides_of_cells(faces)
    there = np.stack([cell, begin, end], axis=1)
    back = np.stack([cell, end, begin], axis=1)
    assert len(np.unique(there, axis=0)) == len(there)
    assert np.array_equal(np.unique(there, axis=0), np.unique(back, axis=0))
    vertices = np.bincount(np.unique(there[:, :2], axis=0)[:, 0])
    edges = np.bincount(cell) / 2
    counts = np.bincount(np.concatenate([faces.owner, faces.neighbor[faces.neighbor >= 0]]))
    assert np.array_equal(vertices - edges + counts, np.full(faces.n_cells, 2))


def test_faces_are_in_order(made):
    _, faces = made
    k = faces.n_inner
    key = faces.owner[:k].astype(int) * faces.n_cells + faces.neighbor[:k]
    assert (np.diff(key) > 0).all()
    assert (faces.owner[:k] < faces.neighbor[:k]).all()
    assert (np.diff(-faces.neighbor[k:]) >= 0).all()
    assert (faces.neighbor[k:] < 0).all()


def test_volumes_fill_the_solid(made):
    solid, faces = made
    assert (faces.volumes > 0.2 * H**3).all()
    assert faces.volumes.sum() == pytest.approx(solid.measure, rel=1e-2 if WallSurface(solid).bent.any() else 1e-12)


def test_walls_follow_the_surface(made):
    """Vertices are in flat patches, and off curved ones by less than the sagitta; the curvature is 1.25 or 1.43."""
    solid, faces = made
    face = np.repeat(np.arange(len(faces)), np.diff(faces.starts))
    on_wall, reach2 = faces.neighbor[face] < 0, np.zeros(len(faces.points))
    np.maximum.at(
        reach2, faces.corners[on_wall], ((faces.points[faces.corners] - faces.center[face]) ** 2).sum(axis=1)[on_wall]
    )
    for p in range(solid.n_patches):
        walls = np.unique(faces.corners[faces.neighbor[face] == -1 - p])
        triangle = np.flatnonzero(solid.patch == p)[0]
        off = np.abs((faces.points[walls] - solid.surface.corners[triangle, 0]) @ solid.normals[triangle])
        if WallSurface(solid).bent[p]:
            off = solid.boundary_distance(faces.points[walls])
        assert (off < (1.43 / 2 * reach2[walls] if WallSurface(solid).bent[p] else 1e-9)).all()
    walls = np.unique(faces.corners[on_wall])
    # Corners are vertices.
    for corner in solid.surface.vertices[solid.corners]:
        assert np.abs(faces.points[walls] - corner).max(axis=1).min() < 1e-12


def test_the_tip_of_a_cone_is_a_vertex(ctx):
    """Its cell has several wall polygons, not one across."""
    solid = clvoro.Solid.cone((0, 0, 0), (0, 0, 1.5), 0.8)
    x = generators(solid)
    h = np.full(len(x), H)
    faces = solid_diagram(WallSurface(solid), x, h, lambda x: whole_faces(ctx, solid, x, h)).faces
    assert np.linalg.norm(faces.points - (0, 0, 1.5), axis=1).min() < 0.15 * H


def test_walls_cut_off_as_much_as_they_add(made):
    """On balanced walls the depth of polygons has the mean 0, and faces between cells stay as plane as they were."""
    solid, faces = made
    surface = WallSurface(solid)
    center, vector = faces.vectors
    normal = vector / faces.area[:, None]
    walls = np.flatnonzero(faces.neighbor < 0)
    depth = balance._depths(surface.feet, faces, walls, center, normal)
    assert abs((depth * faces.area[walls]).sum() / faces.area[walls].sum()) < 5e-3 * H
    again = balance.balanced(faces, np.maximum(-1 - faces.neighbor, -1), surface.bent, surface.feet)
    off = [plane_errors(f).max() for f in (faces, again)]
    assert off[1] < off[0] + 1e-2 * H


def test_vertices_are_no_farther_from_a_ball_than_plane_polygons_need(ctx):
    """A regular hexagon that cuts off as much as it adds has corners 7 / (36 sqrt(3)) A kappa off, A its area."""
    ball = clvoro.Solid.ball((0, 0, 0), 1, edge=0.06)
    f = clvoro.Adapter(ctx).run(ball, 0.25, effort="fast").diagram.faces
    walls = np.unique(f.corners[f.starts[f.n_inner] :])
    off, area = np.linalg.norm(f.points[walls], axis=1) - 1, f.area[f.n_inner :]
    assert off.mean() == pytest.approx(7 / (36 * np.sqrt(3)) * area.mean(), rel=0.1)
    assert 0 < off.min() < off.max() < 7 / (36 * np.sqrt(3)) * 1.2 * area.max()


def test_few_rejected_cells_are_cured_in_a_sheet_half_as_thick_as_a_cell(ctx):
    """Though they are a large share: the mesh has no inverted cell, and the warning of sizes no negative one.

    The progress counts them.
    """
    adapter, told = clvoro.Adapter(ctx), []
    adapter.on_work = told.append
    sheet = clvoro.Polygon([(0, 0), (1.6, 0), (1.6, 0.2), (0.2, 0.2), (0.2, 1.4), (0, 1.4)])
    with pytest.warns(MismatchWarning, match=r"of the walls are nearer than a cell|narrower than half a cell"):
        mesh = adapter.run(clvoro.Solid.extruded(sheet, 0, 1.2), 0.4, effort="fast")
    counted = [part for part in told if part.startswith("cells that are rejected at walls: ")]
    assert len(counted) > 10
    failed = {c.name for c in mesh.check("openfoam").criteria if c.demanded and not c.ok}
    assert failed <= {"determinant"}  # of `checkMesh -allGeometry` only: all faces between cells are upright there


def plane_errors(faces):
    """Return the largest distance of the corners of each face between cells from its plane, (f,)."""
    center, vector = faces.vectors
    face = np.repeat(np.arange(len(faces)), np.diff(faces.starts))
    off = np.abs(((faces.points[faces.corners] - center[face]) * vector[face]).sum(axis=1)) / faces.area[face]
    return np.maximum.reduceat(off, faces.starts[:-1])[: faces.n_inner]


def test_a_cell_has_one_polygon_on_each_patch(made):
    _, faces = made
    walls = np.stack([faces.owner, faces.neighbor], axis=1)[faces.n_inner :]
    assert len(np.unique(walls, axis=0)) == len(walls)


def test_check_finds_what_is_wrong(made):
    solid, faces = made
    diagram = diagram_of(faces)
    assert diagram.check()
    arrays = {name: getattr(diagram, name).copy() for name in diagram._arrays}
    wall = faces.corners[faces.starts[faces.n_inner]]
    out = faces.points[wall] - faces.generators[faces.owner[faces.n_inner]]
    arrays["vertices"][np.flatnonzero((diagram.vertices == faces.points[wall]).all(axis=1))] += out
    arrays["volumes"][0] *= 1.001
    text = str(type(diagram)(solid, arrays).check())
    assert "walls" in text
    assert "volumes[" in text


@pytest.mark.parametrize("seed", [4, 21])
def test_an_edge_across_a_crease_with_both_ends_outside_closes_a_face(ctx, seed):
    """The face between two of its cells has no corner inside: the edge and a vertex on the crease are its corners."""
    solid, k = clvoro.Solid.box((0, 0, 0), (1, 1, 1)), np.arange(H / 2, 1, H)
    x = np.stack(np.meshgrid(k, k, k, indexing="ij"), axis=-1).reshape(-1, 3)
    x += np.random.default_rng(seed).uniform(-0.35, 0.35, x.shape) * H
    h = np.full(len(x), H)
    faces = solid_diagram(WallSurface(solid), x, h, lambda x: whole_faces(ctx, solid, x, h)).faces
    walls = np.bincount(-1 - faces.neighbor[faces.n_inner :], faces.area[faces.n_inner :])
    assert np.abs(walls - 1).max() < 1e-12
    assert abs(faces.volumes.sum() - 1) < 1e-12


def test_faces_that_end_on_a_narrow_strip_cross_both_of_its_creases(ctx):
    """The wall on both sides of the strip is one patch."""
    angle = np.radians(np.linspace(50, 310, 33))
    tip = [(0.9, -0.3 * H), (0.9, 0.3 * H)]
    solid = clvoro.Solid.extruded(clvoro.Polygon([*np.column_stack([np.cos(angle), np.sin(angle)]) * 0.6, *tip]), 0, 1)
    x = generators(solid)
    h = np.full(len(x), H)
    faces = solid_diagram(WallSurface(solid), x, h, lambda x: whole_faces(ctx, solid, x, h)).faces
    strip = np.isclose(faces.normal[:, 0], 1, atol=1e-9) & (faces.neighbor < 0)
    assert faces.area[strip].sum() == pytest.approx(0.6 * H, rel=1e-9)


def test_a_cell_with_a_concave_crease_is_cut(ctx):
    """Where generators beside the crease are off their places, it passes through a cell."""
    solid = el()
    x = generators(solid)
    x[np.linalg.norm(x - (1, 1, 0.5), axis=1) < H] += 0.25 * H * np.array([1, -0.6, 0.1])
    h = np.full(len(x), H)
    with pytest.warns(clvoro.errors.MismatchWarning, match="cells that are parts of others"):
        d = solid_diagram(WallSurface(solid), x, h, lambda x: whole_faces(ctx, solid, x, h), straight=False)
    assert d.check("openfoam")
    assert d.check()
    assert d.volumes.sum() == pytest.approx(solid.measure, rel=1e-9)
    assert np.array_equal(d.points[: len(x)], x)
    assert len(d) > len(x)


def test_a_crease_that_cannot_be_followed_is_left_out(ctx, monkeypatch):
    """Where one generator beside the crease is missing, faces of the others lie in a wall."""
    solid = el()
    x = generators(solid)
    x = np.delete(x, np.linalg.norm(x - (1 + H / 2, 1 - H / 2, 0.5), axis=1).argmin(), axis=0)
    h = np.full(len(x), H)
    with pytest.warns(clvoro.errors.MismatchWarning, match="leave out creases"):
        d = solid_diagram(WallSurface(solid), x, h, lambda x: whole_faces(ctx, solid, x, h))
    assert d.check("openfoam")
    assert np.abs(d.left_out.measures).sum() < 0.5 * H**3
    assert d.volumes.sum() == pytest.approx(solid.measure, rel=0.01)
    monkeypatch.setattr("clvoro.finite_volumes.solid_walls.mesh._MANY", 0)
    monkeypatch.setattr("clvoro.finite_volumes.solid_walls.mesh._SHARE", 0)
    with pytest.warns(clvoro.errors.MismatchWarning, match=r"not accept them; .* details finer than cells.* wrap=0.1"):
        spared = solid_diagram(WallSurface(solid), x, h, lambda x: whole_faces(ctx, solid, x, h))
    assert not spared.check("openfoam")
    assert spared.volumes.sum() == pytest.approx(solid.measure, rel=0.01)


def test_generators_around_concave_creases_stay_in_the_middle():
    ledge = clvoro.Solid.extruded(clvoro.Polygon([(0, 0), (2, 0), (2, 1), (0.1, 1), (0.1, 2), (0, 2)]), 0, 1)
    x = np.array([[0.05, 1.05, 0.5], [0.05, 1.7, 0.5], [0.05, 1.8, 0.5]])
    moved = off_middle(WallSurface(ledge), x, np.full(len(x), 0.15))
    assert (moved != x).any(axis=1).tolist() == [False, True, True]


def test_a_plate_thinner_than_a_cell_keeps_its_cells(ctx):
    """Spread across it, its generators have cells that OpenFOAM accepts, but for those with few neighbors."""
    solid, rng = clvoro.Solid.box((0, 0, 0), (2, 2, 0.7 * H)), np.random.default_rng(1)
    k = np.arange(H / 2, 2, H)
    x = np.stack(np.meshgrid(k, k, [0.35 * H], indexing="ij"), axis=-1).reshape(-1, 3)
    x[:, :2] += rng.uniform(-0.2, 0.2, (len(x), 2)) * H
    h = np.full(len(x), H)
    moved = off_middle(WallSurface(solid), x, h)
    assert 0.05 < np.abs(moved - x)[:, 2].max() / H < 0.2
    thin = []
    for points in (x, moved):
        with pytest.warns(clvoro.errors.MismatchWarning, match="as thin as the solid"):
            d = solid_diagram(WallSurface(solid), points, h, lambda x, h=h: whole_faces(ctx, solid, x, h))
        assert len(d) == len(x)
        assert d.volumes.sum() == pytest.approx(solid.measure, rel=1e-9)
        thin.append(np.count_nonzero(d.faces.measures.determinant < 1e-3))
    assert thin[0] == len(x)
    assert thin[1] < 0.25 * len(x)


def l_cell(ctx):
    """Return the cures of an L whose crease passes through cells without stations, and one of these cells."""
    solid, x = el(), generators(el())
    x[np.linalg.norm(x - (1, 1, 0.5), axis=1) < H] += 0.25 * H * np.array([1, -0.6, 0.1])
    h = np.full(len(x), H)
    surface = WallSurface(solid)
    near = NearWalls.of(surface, x, h, whole_faces(ctx, solid, x, h))
    made = _Maker(surface, near, np.zeros(len(near.sizes), np.int8)).mesh()
    cures = Cures(surface, made.faces, made.home, near.sizes[made.home])
    return cures, [c for c in range(made.faces.n_cells) if cures._concave_edges(cures.edits, c)]


def test_cures_keep_cells_closed_and_cuts_their_volume(ctx):
    """Trials of all cures are there; cuts change no volume but by the folds in divided faces."""
    cures, cells = l_cell(ctx)
    edits, cell = cures.edits, cells[0]
    wall_cell = int(edits.mesh.owner[edits.mesh.n_inner])
    count = {}
    for name in ("cuts", "transfers", "collapses", "mergers", "halves", "unions", "losses"):
        for c in (cell, wall_cell):
            trials = [t for t in getattr(cures, name)(edits, c) if all(t.is_sound(k) for k in t.alive(t.touched))]
            count[name] = count.get(name, 0) + len(trials)
        if name in ("cuts", "halves"):
            for trial in getattr(cures, name)(edits, cell):
                volume, whole = (sum(cures._volume(e, c) for c in e.alive(trial.touched)) for e in (trial, edits))
                assert volume == pytest.approx(whole, rel=0.01)
    assert count["cuts"] > 5
    assert count["halves"] > 5
    assert count["unions"] > 0
    cures.strictly = True
    assert min(gain for gain, *_ in cures._judged(edits, list(cures.slides(edits, cell))))[1] < -1  # less oblique


def test_a_cut_makes_two_convex_cells_of_one(ctx):
    """Its neighbors stay accepted, as divided faces are folded into the cell."""
    cures, cells = l_cell(ctx)
    edits, cell = cures.edits, cells[0]
    assert judge([(edits, [cell])])[0][0][0] > 0
    found = []
    for trial in cures.cuts(edits, cell):
        parts = [cell, edits.next_cell]
        excess = judge([(trial, parts)])[0][0]
        found.append(excess.sum())
        assert len(trial.alive(parts)) == 2
    assert min(found) == 0


def test_a_surface_recalls_its_answers():
    """Only points that are new since the last meshes are searched for."""
    solid, asked = SOLIDS["cube"](), list[int]()
    surface = WallSurface(solid, lambda x, _: (asked.append(len(x)), solid.feet(x).triangle)[1])
    x = np.random.default_rng(1).random((200, 3))
    for new in (200, 0, 50):
        x[:new] += 0.01
        for found, expected in zip(surface.closest(x), solid.closest(x), strict=True):
            np.testing.assert_array_equal(found, expected)
        surface.recall()
    assert asked == [200, 50]


def test_cures_are_repeated_where_cells_are_the_same(ctx):
    """The other mesh has its vertices and loops in another order; then one of its cells differs."""
    cures, cells = l_cell(ctx)
    assert [cures.cure(c) for c in cells[:2]] == [True, True]
    mesh = cures.edits.mesh
    order = np.random.default_rng(1).permutation(len(mesh.points))
    points = np.empty_like(mesh.points)
    points[order] = mesh.points
    corners = np.concatenate([np.roll(order[mesh.corners[a:b]], 1) for a, b in itertools.pairwise(mesh.starts)])
    other = replace(mesh, points=points, corners=corners.astype(np.int32))
    again = Cures(cures.surface, other, cures.names, cures.sizes, cures)
    assert len(again.edits.taken) == len(cures.edits.taken) > 0
    (expected, numbers), found = cures.edits.result(), again.edits.result()[0]
    assert found.n_cells == expected.n_cells > mesh.n_cells
    middles, of = cures.edits.middles([(cures.edits, c) for c in numbers.tolist()]), expected.measures.geometry
    np.testing.assert_allclose(middles, np.column_stack([of.centroids, of.volumes]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.measures.volumes, expected.measures.volumes, rtol=1e-9)
    first = cures.edits.taken[0]
    v = order[next(v for k in first.faces_of(cells[0]) for v in first.face(k)[2] if v < len(order))]
    points[v] += 1e-3 * H
    again = Cures(cures.surface, replace(other, points=points.copy()), cures.names, cures.sizes, cures)
    assert len(again.edits.taken) < len(cures.edits.taken)


def test_mergers_losses_and_collapses_change_what_they_name(ctx):
    """With sizes three times as large, cells and edges count as small. Faces that are joined are not quite flat."""
    cures, _ = l_cell(ctx)
    edits, cures.sizes = cures.edits, 3 * cures.sizes
    cell = int(edits.mesh.owner[edits.mesh.n_inner])

    def volume(e, cells):
        return sum(cures._volume(e, c) for c in e.alive(cells))

    merged, lost = next(cures.mergers(edits, cell)), next(cures.losses(edits, cell))
    for trial, less in ((merged, 0), (lost, volume(edits, [cell]))):
        assert not trial.faces_of(cell)
        assert all(trial.is_sound(c) for c in trial.touched)
        assert volume(trial, trial.touched) == pytest.approx(volume(edits, trial.touched) - less, rel=0.01)
    counts = [len(t.vertices(cell)) for t in cures.collapses(edits, cell) if t.is_sound(cell)]
    assert 3 < min(counts) <= max(counts) < len(edits.vertices(cell))
    names = edits.mesh.domain.boundaries.index
    walls = {c: [n for k in edits.faces_of(c) if (n := edits.across(k, c)) < 0] for c in range(edits.mesh.n_cells)}
    cell = max(walls, key=lambda c: len(walls[c]))
    joined = [[t.across(k, cell) for k in t.faces_of(cell)] for t in cures.joins(edits, cell) if t.is_sound(cell)]
    assert len({names[-1 - n] for n in walls[cell]}) == 1
    assert {sum(n < 0 for n in beyond) for beyond in joined} == {len(walls[cell]) - 1}


def test_parts_in_trials_that_are_dropped_leave_no_trace(ctx):
    """The same number of a new cell is that of parts of different cells in different trials."""
    cures, cells = l_cell(ctx)
    edits = cures.edits
    one, other = (next(cures.cuts(edits, c)) for c in cells[:2])
    assert one.origins == {edits.next_cell: cells[0]}
    assert other.origins == {edits.next_cell: cells[1]}
    edits.take(one)
    assert edits.origins == one.origins


@pytest.mark.parametrize("seed", [0, 47, 63, 69, 93])
def test_few_cells_in_thin_solids(ctx, seed):
    """They are meshed, or refused with a place, also if there are fewer cells than walls."""
    rng = np.random.default_rng(seed)
    points = rng.random((6, 3)) * (1, 1, 0.2)
    solid = clvoro.Solid(points, ConvexHull(points).simplices, repair=True)
    inside = rng.random((400, 3)) * (1, 1, 0.2)
    inside = inside[solid.contains(inside)][:3]
    with contextlib.suppress(InputError):
        assert clvoro.Adapter(ctx).diagram(solid, inside).solver_mesh().n_cells <= 3


@pytest.mark.parametrize(("straight", "centerings"), [(True, 6), (True, 0), (False, 6)])
def test_generators_move_to_centroids_where_faces_are_oblique(ctx, monkeypatch, straight, centerings):
    """Without that faces turn or collapse."""
    monkeypatch.setattr("clvoro.finite_volumes.solid_walls.mesh._CENTERINGS", centerings)
    solid = clvoro.Solid.box((0, 0, 0), (1, 1, 1))
    x, h = generators(solid), np.full(64, H)
    x[0] += 0.5 * H * np.array([1, -1, 1])
    whole = partial(whole_faces, ctx, solid, h=h)
    d = solid_diagram(WallSurface(solid), x, h, whole, straight=straight)
    assert (d.faces.measures.non_orthogonality.max() < 20) == straight
    assert np.array_equal(d.points, x) == (not straight or not centerings)
    assert d.volumes.sum() == pytest.approx(1, rel=1e-9)


@pytest.mark.parametrize("first", [False, True])
def test_generators_at_walls_settle(ctx, monkeypatch, first):
    """Volumes and centroids are closer, those around concave creases stay, and all where a face would be oblique."""
    solid, held = el(), 5
    x = generators(solid)
    h = np.full(len(x), H)
    volumes = np.full(len(x), solid.measure / len(x))
    whole = partial(whole_faces, ctx, solid, h=h)

    def made(targets):
        d = solid_diagram(WallSurface(solid), x, h, whole, targets=targets)
        return d, np.abs(np.cbrt(d.volumes / volumes) - 1), np.linalg.norm(d.centroids - d.points, axis=1).mean() / H

    (_, before, off_before), (d, after, off) = made(None), made(CellTargets(volumes, held, first))
    stays = WallSurface(solid).at_concave_creases(x, h)
    stays[:held] = True
    assert 0 < stays.sum() < len(x) / 2
    assert np.array_equal(d.points[stays], x[stays])
    assert after[~stays].mean() < (0.2 if first else 0.5) * before[~stays].mean()
    assert first or off < 0.7 * off_before
    monkeypatch.setattr("clvoro.finite_volumes.solid_walls.settling._WORSE", 0.0)
    assert np.array_equal(made(CellTargets(volumes, held, first))[0].points, x)


@pytest.mark.parametrize(("enough", "meshes"), [((1, 180), 1), ((0.005, 180), 2), ((0.005, 0), 9), ((0, 180), 9)])
def test_settling_stops_when_sizes_and_angles_are_good(ctx, monkeypatch, enough, meshes):
    """Otherwise it makes a mesh before each of eight steps, and one after them."""
    monkeypatch.setattr("clvoro.finite_volumes.solid_walls.settling._ENOUGH", enough)
    solid = clvoro.Solid.box((0, 0, 0), (1, 1, 1))
    x, h = generators(solid), np.full(64, H)
    count = itertools.count()

    def whole(points):
        next(count)
        return whole_faces(ctx, solid, points, h=h)

    solid_diagram(WallSurface(solid), x, h, whole, targets=CellTargets(h**3))
    assert next(count) == meshes
