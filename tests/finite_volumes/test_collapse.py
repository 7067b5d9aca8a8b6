"""Short edges and small faces in 3D are collapsed; cells remain valid and fill the domain, seams are images."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial import KDTree

import clvoro
from clvoro.connectivity import following, take_rows
from clvoro.finite_volumes import collapse
from clvoro.finite_volumes.collapse import collapse_short
from clvoro.finite_volumes.defects import DefectLimits
from clvoro.finite_volumes.merging import Merges
from clvoro.finite_volumes.seams import pack, unpack
from tests.reference import polyhedra
from tests.reference.solids import solid_diagram

LOWER, UPPER = (-1.0, 0.0, 2.0), (1.0, 1.5, 3.0)


def lattice(k, shift, offsets=((0, 0, 0),)):
    """Points of a lattice in the unit box, each moved by up to `shift` times its period."""
    grid = (np.stack(np.meshgrid(*3 * [np.arange(k)]), axis=-1).reshape(-1, 3) + 0.25) / k
    points = np.concatenate([grid + np.array(o) / k for o in offsets])
    return points + shift / k * np.random.default_rng(7).uniform(-1, 1, points.shape)


def near_edges(count):
    """Points of which many are close to walls, edges and corners."""
    points = np.random.default_rng(8).uniform(0.02, 0.98, (count, 3))
    for axis in range(3):
        points[axis * 20 : axis * 20 + 40, axis] *= 0.05
    return points


BODY = ((0, 0, 0), (0.5, 0.5, 0.5))
POINTS = {
    "random": np.random.default_rng(5).random((400, 3)),
    "cubic": lattice(5, 1e-9),
    "cubic, rough": lattice(5, 1e-3),
    "cubic, loose": lattice(5, 2e-2),
    "body-centered": lattice(4, 1e-9, BODY),
    "edges": near_edges(150),
}
PERIODIC = {"closed": False, "periodic": True, "channel": (True, False, False)}


def grid():
    """Points and kinds of box; the fast tests have each kind of points once."""
    for i, points in enumerate(POINTS):
        for j, box in enumerate(PERIODIC):
            marks = [] if i % len(PERIODIC) == j else [pytest.mark.slow]
            yield pytest.param(f"{points}; {box}", marks=marks)


@pytest.fixture(scope="module", params=grid())
def meshes(request, ctx):
    """A diagram, its mesh, and its mesh with short edges collapsed."""
    points, periodic = request.param.split("; ")
    box = clvoro.Box(LOWER, UPPER, periodic=PERIODIC[periodic])
    diagram = clvoro.Adapter(ctx).diagram(box, POINTS[points] * box.extent + LOWER)
    before = diagram.solver_mesh(collapse=False)
    return diagram, before, diagram.solver_mesh()


@pytest.mark.sparse(2)
def test_short_edges_and_small_faces_are_gone(meshes):
    """Cells with edges shorter than 0.02 h, and with faces smaller than 0.001 h^2."""
    _, *both = meshes
    edges = [np.count_nonzero(mesh.measures.shortest_edge < 0.02) for mesh in both]
    faces = [np.count_nonzero(mesh.measures.smallest_face < 1e-3) for mesh in both]
    assert edges[1] <= 0.03 * edges[0]
    assert faces[1] <= 0.03 * faces[0]


@pytest.mark.sparse(2)
def test_skewed_faces_are_rarer(meshes):
    """Small faces between two cells, far from the line between the centroids."""
    diagram, *both = meshes
    skewed = []
    for mesh in both:
        areas = np.linalg.norm(mesh.measures.geometry.areas, axis=1)
        i, j = mesh.owner, np.where(mesh.neighbor < 0, mesh.owner, mesh.neighbor)
        h = np.cbrt(np.minimum(diagram.volumes[i], diagram.volumes[j]))
        small = (mesh.neighbor >= 0) & (areas < 5e-3 * h**2)
        skewed.append(np.count_nonzero(small & (mesh.measures.skewness > 1.8)))
    assert skewed[1] <= 0.2 * skewed[0]


@pytest.mark.sparse(2)
def test_cells_fill_the_domain(meshes):
    diagram, _, after = meshes
    volumes = after.measures.geometry.volumes
    assert volumes.sum() == pytest.approx(diagram.domain.measure, rel=1e-13)
    assert volumes == pytest.approx(diagram.volumes, rel=0.08)
    assert after.measures.openness.max() < 1e-13
    assert after.n_cells == len(diagram)


@pytest.mark.sparse(2)
def test_walls_edges_and_corners_stay(meshes):
    diagram, _, after = meshes
    box = diagram.domain
    areas = after.measures.geometry.areas
    for k in np.flatnonzero(np.repeat(~np.array(box.periodic), 2)):
        axis, upper = divmod(int(k), 2)
        faces = np.flatnonzero(after.neighbor == -1 - k)
        corners = np.concatenate([after.corners[after.starts[f] : after.starts[f + 1]] for f in faces])
        plane = (box.upper if upper else box.lower)[axis]
        np.testing.assert_allclose(after.points[corners, axis], plane, rtol=0, atol=1e-15)
        wanted = (1 if upper else -1) * box.measure / box.extent[axis] * np.eye(3)[axis]
        if not any(box.periodic):
            assert areas[faces].sum(axis=0) == pytest.approx(wanted, abs=1e-13)
        assert (areas[faces][:, axis] * wanted[axis] > 0).all()
    if not any(box.periodic):
        corners = np.stack(np.meshgrid(*zip(LOWER, UPPER, strict=True)), axis=-1).reshape(-1, 3)
        away = np.abs(after.points[None] - corners[:, None]).max(axis=2)
        assert away.min(axis=1).max() < 1e-15


@pytest.mark.sparse(2)
def test_cells_are_polyhedra(meshes):
    """Euler's formula, two faces at each edge, and faces that meet on one path."""
    _, _, after = meshes
    loops = np.split(after.corners, after.starts[1:-1])
    cells = [[] for _ in range(after.n_cells)]
    for f, loop in enumerate(loops):
        assert len(set(loop.tolist())) == len(loop) >= 3
        cells[after.owner[f]].append(loop.tolist())
        if after.neighbor[f] >= 0 and after.twin[f] < 0:
            cells[after.neighbor[f]].append(loop[::-1].tolist())
    for faces in cells:
        sides = [s for loop in faces for s in polyhedra.sides_of(loop)]
        assert len(faces) >= 4
        assert len(set(sides)) == len(sides)
        assert {(b, a) for a, b in sides} == set(sides)
        assert len({a for a, _ in sides}) - len(sides) // 2 + len(faces) == 2
        assert all(polyhedra.meet_on_a_path(f, g) for f, g in combinations(faces, 2))
    inner = after.neighbor >= 0
    pairs = np.column_stack([after.owner, after.neighbor, after.shift])[inner]
    assert len(np.unique(pairs, axis=0)) == len(pairs)


@pytest.mark.sparse(2)
def test_faces_are_flat_and_cells_convex(meshes):
    _, _, after = meshes
    m = after.measures
    assert m.flatness.min() >= 0.95
    assert m.pyramids.min() > 0
    assert m.bad_tetrahedra.sum() == 0
    assert not m.concave.any()


@pytest.mark.sparse(2)
def test_faces_are_in_order_and_seams_are_images(meshes):
    _, _, after = meshes
    inner = list(zip(after.owner[: after.n_inner], after.neighbor[: after.n_inner], strict=True))
    assert inner == sorted(inner)
    extent = np.array(after.domain.extent)
    for f in np.flatnonzero(after.twin >= 0):
        there = after.twin[f]
        a = after.points[after.corners[after.starts[f] : after.starts[f + 1]]]
        b = after.points[after.corners[after.starts[there] : after.starts[there + 1]]]
        b = np.concatenate([b[:1], b[:0:-1]]) + after.shift[f] * extent
        assert after.twin[there] == f
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-14 * extent.max() * 8)


@pytest.mark.sparse(2)
def test_faces_have_the_geometry_of_their_points(meshes):
    """Centers and areas from the diagram, also at seams and walls, against those of the corners."""
    diagram, before, _ = meshes
    cells, faces = collapse._fold(before, diagram)
    found = cells.geometry(np.arange(len(faces)))
    cells.edited[:] = True
    for a, b in zip(found, cells.geometry(np.arange(len(faces))), strict=True):
        # Slivers near round-off have ill-conditioned centers. A mistake at a seam is as large as the box.
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5)


def one_edge(cells, a, b):
    """The ends of an edge as the only set to merge."""
    return Merges(
        np.array([0, 2]),
        np.array([a, b]),
        np.zeros(2, np.int64),
        np.zeros(1, np.int64),
        np.zeros(1),
        np.full(1, np.inf),
    )


def test_merges_are_those_of_a_slow_reference():
    """Merge one pair of vertices, near or far, connected or not: it is valid exactly if the reference says so."""
    rng = np.random.default_rng(12)
    diagram = solid_diagram((0, 0, 0), (1, 1, 1), rng.random((25, 3)))
    mesh = diagram.solver_mesh(collapse=False)
    whole = polyhedra.Mesh.of(mesh)
    ends = np.stack([mesh.corners, mesh.corners[following(mesh.starts)]], axis=1)
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    length = np.linalg.norm(mesh.points[ends[:, 0]] - mesh.points[ends[:, 1]], axis=1)
    ends = ends[np.argsort(length)][:12]
    apart = [
        rng.choice(mesh.corners[mesh.starts[f] : mesh.starts[f + 1]], 2, replace=False)
        for f in rng.integers(len(mesh.owner), size=6)
    ]
    limits, verdicts = DefectLimits(non_orthogonality=60, skewness=4), []
    for a, b in [*ends.tolist(), *np.array(apart).tolist()]:
        cells, _ = collapse._fold(mesh, diagram)
        cells.limits = limits
        walls = np.array([sum(1 << k for k in cells.wall_sets[w]) for w in cells.walls])
        did = cells.merge(one_edge(cells, a, b))
        union = walls[a] | walls[b]
        x, fits = mesh.points, None
        if union in (walls[a], walls[b]):
            was = polyhedra.quality(whole, {a, b})
            for target in ((x[a] + x[b]) / 2, x[a], x[b]):
                target = target.copy()
                on = x[a] if walls[a] == union else x[b]
                for axis in range(3):
                    if int(union) >> (2 * axis) & 3:
                        target[axis] = on[axis]
                new = whole.merged(a, b, target)
                if new is None or not new.is_manifold():
                    break
                q = polyhedra.quality(new, {a})
                if (
                    q.positive
                    and q.flatness >= limits.flatness
                    and q.cosine <= limits.concavity
                    and q.angle <= max(was.angle + 0.02, limits.non_orthogonality)
                    and q.skewness <= max(was.skewness * 1.02, limits.skewness)
                ):
                    fits = target
                    break
        assert did == (fits is not None), (a, b)
        verdicts.append(did)
        if did:
            assert cells.points[cells.now[a]] == pytest.approx(fits, abs=1e-15)
            made = polyhedra.Mesh.of(collapse._unfold(mesh, cells, np.arange(len(mesh.owner))))
            assert len(made.faces) == len(new.faces)
            assert len(made.points) == len(new.points)
    assert 3 < sum(verdicts) < len(verdicts) - 3


def test_clear_meshes_are_left_alone():
    diagram = solid_diagram((0, 0, 0), (1, 1, 1), lattice(2, 0))
    mesh = diagram.solver_mesh(collapse=False)
    assert collapse_short(mesh, diagram) is mesh


@pytest.mark.sparse(2)
def test_corners_of_faces_that_are_not_chosen_stay():
    """Faces beside the chosen ones that become small are left as they are."""
    diagram = solid_diagram((0, 0, 0), (1, 1, 1), np.random.default_rng(2).random((200, 3)))
    mesh = diagram.solver_mesh(collapse=False)
    low = np.append(diagram.points[:, 0] < 0.5, False)
    chosen = low[mesh.owner] | low[np.maximum(mesh.neighbor, -1)]
    made = collapse_short(mesh, diagram, chosen=chosen)
    assert len(made) < len(mesh)
    others = np.setdiff1d(mesh.corners, take_rows(mesh.starts, mesh.corners, np.flatnonzero(chosen))[1])
    assert KDTree(made.points).query(mesh.points[others])[0].max() < 1e-12


def test_suspects_are_all_that_would_be_flagged(meshes):
    """The screening against a scan of all faces."""
    diagram, before, _ = meshes
    cells, faces = collapse._fold(before, diagram)
    flagged = faces[collapse._Scan(cells, np.arange(len(cells.owner))).flagged]
    suspects = collapse.find_suspects(before, diagram)
    assert len(flagged)
    assert suspects[flagged].all()
    assert np.count_nonzero(~suspects) > 0


def test_offsets_are_packed():
    offsets = np.array(np.meshgrid(*3 * [range(-2, 3)])).reshape(3, -1).T
    np.testing.assert_array_equal(unpack(pack(offsets)), offsets)
    np.testing.assert_array_equal(unpack(pack(offsets) - pack(offsets[::-1])), offsets - offsets[::-1])
