"""Faces that end in re-entrant corners, cells in tips; the projection against NumPy, and whole runs."""

from itertools import combinations

import numpy as np
import pyopencl as cl
import pytest
from scipy.spatial import KDTree

import clvoro
from clvoro.adaptation import corners, tuning
from clvoro.adaptation.corners import find_corners
from clvoro.adaptation.stages import Stages
from clvoro.adaptation.state import MeshState
from clvoro.mesh.connectivity import face_ends
from clvoro.mesh.straightening import cross
from clvoro.opencl.engine import Engine
from clvoro.sizing import Sizing, as_field

H = 0.1
SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
L = clvoro.Polygon([(0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)])
WEDGE = clvoro.Polygon([(0, 0), (1, 0), (1, 0.42), (0.5, 0.5), (1, 0.55), (1, 1), (0, 1)])
ISLAND = clvoro.Polygon(SQUARE, [[(0.42, 0.45), (0.6, 0.42), (0.52, 0.6)]])
POST = clvoro.Polygon(SQUARE, [[(0.45, 0.3), (0.53, 0.3), (0.53, 0.7), (0.45, 0.7)]])
TWO = clvoro.Polygon.from_pieces([[L.vertices], [np.array([(1.2, 0), (2, 0), (1.8, 0.3), (2, 1), (1.2, 1)])]])


def ring(k, r):
    angle = np.arange(k) * (2 * np.pi / k)
    return 0.5 + r * np.column_stack([np.cos(angle), np.sin(angle)])


def corners_of(domain, h=H):
    groups = find_corners(domain, np.full(len(domain.oriented.vertices), h))
    return groups, domain.oriented.vertices[groups.vertices]


def pocket(x, i, j):
    """The area between the ring `x` and the segment from vertex i to j: of both ways the smaller one, with its sign."""
    ways = [(i, j), (j, i)]
    paths = [x[np.arange(a, a + (b - a) % len(x) + 1) % len(x)] for a, b in ways]
    areas = [np.sum(cross(p, np.roll(p, -1, axis=0))) / 2 for p in paths]
    return min(areas, key=abs)


def test_vertices_near_an_earlier_one_that_is_kept_are_left_out():
    """Against all pairs, on a rough coast around a rough island."""
    rng = np.random.default_rng(2)
    rough = [ring(150, r * rng.uniform(0.9, 1.1, (150, 1))) for r in (0.5, 0.25)]
    rings = clvoro.Polygon(rough[0], [rough[1]]).oriented
    x, (first, second, end) = rings.vertices, rings.ring_starts.tolist()
    bend, h = rng.uniform(0, 3, 300), rng.uniform(0.03, 0.2, 300)
    order, kept, pockets = rng.permutation(300)[:250], [], 0
    for i in order:
        close = in_pocket = False
        for j in kept:
            size = min(h[i], h[j])
            gap = np.hypot(*(x[i] - x[j])) / size
            fan = tuning.SPACING - tuning.FAN * (bend[i] + bend[j]) / 2
            close |= gap < max(fan, tuning.LEAST_SPACING)
            if (i < second) == (j < second):
                a, b = (first, second) if i < second else (second, end)
                area = pocket(x[a:b], i - a, j - a) / size**2
                is_pocket = tuning.POCKETS[0] < area < tuning.POCKETS[1]
                in_pocket |= is_pocket and gap < tuning.POCKET_SPACING
        pockets += in_pocket and not close
        if not (close or in_pocket):
            kept.append(i)
    assert 50 < len(kept) < 200
    assert pockets > 10
    np.testing.assert_array_equal(corners._spaced(rings, bend, h, order), kept)


@pytest.mark.parametrize(
    ("domain", "expected"),
    [
        (clvoro.Polygon(SQUARE), []),
        (L, [(0.5, 0.5)]),
        (WEDGE, [(0.5, 0.5)]),
        (POST, [(0.45, 0.3), (0.53, 0.3), (0.53, 0.7), (0.45, 0.7)]),
        (clvoro.Polygon(SQUARE, [ring(180, 0.2)]), []),
        # A turn of 6 degrees is no corner.
        (clvoro.Polygon([(0, 0), (0.5, 0.05), (1, 0), (1, 1), (0, 1)]), []),
    ],
)
def test_corners_that_matter(domain, expected):
    _, found = corners_of(domain)
    assert sorted(map(tuple, found.tolist())) == sorted(expected)


def test_blunt_tip_is_one_corner():
    slit = [(0.499, 1), (0.499, 0.4), (0.501, 0.4), (0.501, 1)]
    groups, found = corners_of(clvoro.Polygon([(0, 0), (1, 0), (1, 1), *slit[::-1], (0, 1)]))
    assert len(found) == 1
    assert np.degrees(groups.angles[0]) > 350


def test_shape_of_a_corner():
    groups, found = corners_of(WEDGE)
    walls = np.array([(1, 0.55), (1, 0.42)]) - found[0]
    toward, back = (np.arctan2(y, x) for x, y in walls)
    assert groups.directions[0] == pytest.approx(toward)
    assert groups.angles[0] == pytest.approx((back - toward) % (2 * np.pi))


def test_crowded_corners():
    """Of corners with less distance than a cell between them, the sharper ones remain."""
    k = np.arange(40)
    saw = np.column_stack([1 - k / 40, 0.8 + 0.01 * (k % 2)])
    domain = clvoro.Polygon([(0, 0), (1, 0), *saw, (0, 0.8)])
    for h, gap, most in ((0.05, 0.05, 20), (0.076, 0.1, 10)):
        _, found = corners_of(domain, h)
        assert most - 2 <= len(found) <= most
        assert KDTree(found).query(found, k=2)[0][:, 1].min() == pytest.approx(gap)


def test_stairs_that_are_finer_than_the_cells(adapter):
    """Not every corner of a staircase has a face: cells meet their sizes, where mean |e| at walls was 0.2."""
    k = np.arange(41)
    stairs = 0.05 * np.column_stack([20 - k // 2, 10 + (k + 1) // 2])
    domain = clvoro.Polygon([(0, 0), (1, 0), *stairs])
    groups, found = corners_of(domain, 0.12)
    found = found[groups.angles > np.pi]  # the others are tips
    assert KDTree(found).query(found, k=2)[0][:, 1].min() > tuning.POCKET_SPACING * 0.12
    result = adapter.run(domain, 0.12, effort="fast")
    assert result.summary()["boundary_mean_error"] < 0.04


# The projection at a single corner in NumPy.

NEAREST, REACH, OTHERS, OTHERS_STEP = 6, 2.2, 1.3, 0.15
MARGIN, MOST_TURN, LEAST_RADIUS = 0.15, 0.15, 0.3


def over(x, most):
    return max(x - most, 0.0)


def cost_of(chosen, d, a, angle):
    margin = min(MARGIN, (2 * np.pi - angle) / 4 + 0.01)
    widest, r = np.pi - margin, d[list(chosen)].mean()
    cost = sum((d[p] - r) ** 2 if p in chosen else over(OTHERS * r, d[p]) ** 2 for p in range(len(d)))
    own = a[list(chosen)]
    faces = np.concatenate([[0], (own[1:] + own[:-1]) / 2, [angle]])
    for width in np.diff(faces):
        off = max(width - 2.5, 1.3 - width, 0.0)
        cost += r * r * (4 * over(width, widest) ** 2 + 0.3 * off * off)
    mean = (own[0] + own[-1]) / 2
    return cost + 4 * (r * (mean - np.clip(mean, angle - widest, widest))) ** 2


def turn_all(x, corner, turn):
    c, s = np.cos(turn), np.sin(turn)
    return corner + (x - corner) @ np.array([[c, s], [-s, c]])


def shared(domain, points, h):
    """Return `points` after the projection at the single corner of `domain`, far from other walls."""
    groups, (corner,) = corners_of(domain, h)
    angle = groups.angles[0]
    away = np.hypot(*(points - corner).T)
    near = np.argsort(away)[:NEAREST]
    near = near[away[near] < REACH * h]
    v = points[near] - corner
    a = (np.arctan2(v[:, 1], v[:, 0]) - groups.directions[0]) % (2 * np.pi)
    near, a = near[np.argsort(a)], np.sort(a)
    d = away[near]
    sizes = (3, 4) if angle > 5.8 else (2, 3)
    choices = [c for m in sizes for c in combinations(range(len(near)), m) if d.argmin() in c]
    chosen = list(min(choices, key=lambda c: cost_of(c, d, a, angle)))
    new, margin = points.copy(), min(MARGIN, (2 * np.pi - angle) / 4)
    mean = (a[chosen[0]] + a[chosen[-1]]) / 2
    turn = np.clip(np.clip(mean, angle - np.pi + margin, np.pi - margin) - mean, -MOST_TURN, MOST_TURN)
    a[chosen] += turn
    new[near[chosen]] = turn_all(new[near[chosen]], corner, turn)
    for side, pair in ((0, chosen[:2]), (1, chosen[-2:])):
        face = a[pair].mean()
        turn = min(over(angle - face if side else face, np.pi - margin), MOST_TURN)
        turn = turn if side else -turn
        a[pair] += turn
        new[near[pair]] = turn_all(new[near[pair]], corner, turn)
    own = near[chosen]
    r = max(d[chosen].mean(), LEAST_RADIUS * h)
    new[own] = corner + (new[own] - corner) * (r / away[own])[:, None]
    for p in set(near.tolist()) - set(own.tolist()):
        if away[p] < OTHERS * r:
            far = min(OTHERS * r, away[p] + OTHERS_STEP * h)
            new[p] = corner + (points[p] - corner) * (far / away[p])
    return new, own


def make_mesh(ctx, domain, points, real, fixed=0, h=H, free=None):
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(real), domain.traits(np.dtype(real)))
    sizing = Sizing(engine, domain, as_field(h))
    on_device = engine.upload(domain.place(points, engine.real))
    return MeshState.create(Stages(engine), domain, sizing, on_device, free=free, fixed=fixed)


def lattice(domain, seed):
    """Return generators about H apart, all off the walls."""
    rng = np.random.default_rng(seed)
    x = (np.indices((12, 12)).reshape(2, -1).T + 0.5) / 12 + rng.uniform(-0.03, 0.03, (144, 2))
    return x[domain.contains_well(x, 0.01)]


def project(ctx, domain, points, real="float64", fixed=0):
    mesh = make_mesh(ctx, domain, points, real, fixed)
    assert mesh.walls.corners is not None
    mesh.stages.corners.share(mesh.walls.corners, mesh.free, mesh.t, mesh.moving)
    origin, scale = domain.frame
    return origin + mesh.to_host(mesh.points, scale), mesh.to_host(mesh.velocity, scale)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("domain", [L, WEDGE], ids=["L", "wedge"])
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_projection(ctx, domain, real):
    for seed in range(2):
        points = lattice(domain, seed)
        expected, own = shared(domain, points, H)
        found, velocity = project(ctx, domain, points, real)
        eps = float(np.finfo(real).eps)
        assert found == pytest.approx(expected, abs=40 * eps)
        assert velocity == pytest.approx(found - points, abs=40 * eps)
        away = np.hypot(*(found[own] - 0.5).T)
        assert len(own) >= (3 if domain is WEDGE else 2)
        assert np.ptp(away) < 8 * eps


def test_generators_that_sit_still_stay(ctx):
    """Generators that already share the corner do not move, nor do those of layers."""
    points = lattice(L, 1)
    once, _ = project(ctx, L, points)
    twice, _ = project(ctx, L, once)
    assert twice == pytest.approx(once, abs=1e-14)
    still, _ = project(ctx, L, points, fixed=len(points))
    assert still == pytest.approx(points, abs=1e-15)
    assert not np.allclose(once, points)


def test_corner_without_generators_nearby(ctx):
    """Where cells are much larger than h at the corner, the nearest ones share it all the same."""
    points = np.array([(0.27, 0.42), (0.42, 0.26), (0.1, 0.85), (0.85, 0.1), (0.1, 0.1)])
    away = np.hypot(*(points[:2] - 0.5).T)
    assert away.min() > 2.2 * H
    assert away.max() < min(1.3 * away.min(), 3 * H)
    moved, _ = project(ctx, L, points)
    assert np.ptp(np.hypot(*(moved[:2] - 0.5).T)) < 1e-14


def test_corners_of_unlike_size_share_generators():
    """The larger of both sizes says whether they may."""
    for gap, together in ((0.15, True), (0.17, False)):
        left, right = 0.45, 0.45 + gap
        domain = clvoro.Polygon(SQUARE, [[(left, 0.3), (right, 0.3), (right, 0.7), (left, 0.7)]])
        groups = find_corners(domain, np.where(domain.oriented.vertices[:, 0] < 0.5, H, H / 2))
        assert len(groups.vertices) == 4
        assert len(groups) == (2 if together else 4)


def test_generators_stay_out_of_layers(ctx):
    """Layers fill the L below y = 0.47, where its corner at y = 0.5 would have some of the others."""
    below = 0.47
    free = clvoro.Polygon([(0, below), (1, below), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)])
    free.framed_by = L
    left = moved = 0
    for seed in range(12):
        points = lattice(L, seed)
        points = points[np.argsort(points[:, 1] > below, kind="stable")]
        fixed = int((points[:, 1] <= below).sum())
        found = []
        for part in (L, free):
            mesh = make_mesh(ctx, L, points, "float64", fixed, free=part)
            mesh.walls.adjust(mesh)
            origin, scale = L.frame
            found.append((origin + mesh.to_host(mesh.points, scale))[fixed:])
        left += (found[0][:, 1] < below).sum()
        assert found[1][:, 1].min() > below
        moved += not np.allclose(found[1], points[fixed:])
    assert left > 0
    assert moved > 0


# Tips.


def wedge(degrees):
    """Return a triangle with its tip in (0, 0.5)."""
    t = np.radians(degrees) / 2
    return clvoro.Polygon([(0, 0.5), (np.cos(t), 0.5 - np.sin(t)), (np.cos(t), 0.5 + np.sin(t))])


# A bay whose end is a wedge of 60 degrees, between two capes.
BAY = clvoro.Polygon([(0, 0), (0.42, 0), (0.5, -0.14), (0.58, 0), (1, 0), (1, 1), (0, 1)])


@pytest.mark.parametrize(
    ("domain", "h", "expected"),
    [
        (wedge(30), H, [(0, 0.5)]),
        (wedge(60), H, []),
        (clvoro.Polygon(SQUARE), H, []),
        (clvoro.Polygon(SQUARE, [[(0.4, 0.5), (0.9, 0.45), (0.9, 0.55)]]), H, []),
        (BAY, H, [(0.5, -0.14)]),
        (BAY, H / 4, []),
    ],
)
def test_tips_that_matter(domain, h, expected):
    groups, found = corners_of(domain, h)
    assert sorted(map(tuple, found[groups.angles < np.pi].tolist())) == expected


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_projection_at_a_tip(ctx, real):
    """The second and the third generator get their mean distance, and turn apart until 0.4 of the angle is between."""
    domain, rng = wedge(30), np.random.default_rng(3)
    for _ in range(4):
        x = np.cumsum(rng.uniform(0.08, 0.12, 4)) + 0.02
        points = np.column_stack([x, 0.5 + 0.1 * x * rng.uniform(-1, 1, 4)])
        expected = points.copy()
        (groups, (tip,)), v = corners_of(domain), points - (0, 0.5)
        away, angle = np.hypot(*v.T), np.arctan2(v[:, 1], v[:, 0])
        assert groups.directions[0] == pytest.approx(-np.radians(15))
        _, j, k = np.argsort(away)[:3]
        j, k = (j, k) if angle[j] < angle[k] else (k, j)
        turn = min(max((0.4 * np.radians(30) - (angle[k] - angle[j])) / 2, 0), MOST_TURN / 2)
        for p, way in ((j, -turn), (k, turn)):
            on = turn_all(points[p], tip, way) - tip
            expected[p] = tip + on * (away[[j, k]].mean() / away[p])
        found, _ = project(ctx, domain, points, real)
        assert found == pytest.approx(expected, abs=60 * float(np.finfo(real).eps))


def test_wide_tips(ctx):
    """In the bay two generators get the same distance from its end only if the first one has a single neighbor."""
    others = [(0.2, 0.2), (0.8, 0.2), (0.5, 0.7)]
    for behind, equal in (([(0.44, 0.06), (0.55, 0.07)], False), ([(0.5, 0.05), (0.52, 0.12)], True)):
        moved, _ = project(ctx, BAY, np.array([(0.5, -0.07), *behind, *others]))
        away = np.hypot(*(moved[1:3] - (0.5, -0.14)).T)
        assert (np.ptp(away) < 1e-9) == equal


@pytest.mark.sparse(1)
@pytest.mark.parametrize("degrees", [12, 20, 30, 42])
@pytest.mark.parametrize(("method", "effort"), [("adaptive", "fast"), ("adaptive", "default"), ("exact", "default")])
def test_cells_in_tips_have_two_neighbors(degrees, method, effort, adapter):
    domain = wedge(degrees)
    result = adapter.run(domain, np.sqrt(domain.measure / 150), method=method, effort=effort, seed=2)
    assert result.check(solver="openfoam")
    assert (np.bincount(result.diagram.adjacency.nonzero()[0]) > 1).all()


def test_shared_by_two_corners(ctx):
    """A generator in front of a blunt post lies at equal distances with others from both of its corners."""
    points = np.concatenate([lattice(POST, 2), [(0.49, 0.23)]])
    for _ in range(8):
        points, _ = project(ctx, POST, points)
    tree = KDTree(points)
    for corner in corners_of(POST)[1]:
        d = tree.query(corner, k=2)[0]
        assert np.ptp(d) < 1e-14


def test_no_two_groups_move_the_same_generator(ctx):
    """Sixteen triangles about four cells apart, among random generators."""
    rng = np.random.default_rng(23)
    h, holes = 0.05, []
    for center in 0.13 + 0.25 * np.indices((4, 4)).reshape(2, -1).T:
        middle = center + rng.uniform(-0.015, 0.015, 2)
        angle = rng.uniform(0, 6) + np.array([0, 2.1, 4.2])
        holes.append(middle + 0.035 * np.column_stack([np.cos(angle), np.sin(angle)]))
    domain, points = clvoro.Polygon(SQUARE, holes), rng.random((250, 2))
    mesh = make_mesh(ctx, domain, points[domain.contains_well(points, 0.003)], "float64", h=h)
    mesh.stages.corners.share(mesh.walls.corners, mesh.free, mesh.t, mesh.moving)
    moved = mesh.walls.corners.moved.get()
    moved = moved[moved >= 0]
    assert len(moved) > 50
    assert len(np.unique(moved)) == len(moved)


def test_domains_without_corners_have_no_kernel(ctx):
    for domain in (clvoro.Polygon(SQUARE), clvoro.Box((0, 0), (1, 1))):
        mesh = make_mesh(ctx, domain, lattice(L, 3), "float64")
        assert mesh.walls.corners is None
        assert "corners" not in mesh.stages.__dict__


def gaps(diagram, h):
    """Return the distance over h of the nearest face end from each corner."""
    _, found = corners_of(diagram.domain, h)
    ends = face_ends(diagram)[diagram.neighbors >= 0]
    return KDTree(diagram.vertices[np.unique(ends)]).query(found)[0] / h


def concavity(diagram):
    """Return the largest interior angle of a cell with straightened walls beyond 180 degrees, in degrees."""
    return float(diagram.solver_mesh().measures.concavity.max())


RUNS = [
    ("adaptive", "float64", ISLAND, {}),
    ("adaptive", "float32", POST, {}),
    ("adaptive", "float64", TWO, {"levels": 1}),
    ("exact", "float64", L, {}),
    ("adaptive", "float64", WEDGE, {"n_cells": 400}),
    ("lloyd", "float64", ISLAND, {"max_steps": 20}),
    ("coupled", "float32", L, {"max_steps": 20}),
    ("weighted", "float64", POST, {"max_steps": 30}),
]


@pytest.mark.sparse(1)
@pytest.mark.parametrize(("method", "real", "domain", "more"), RUNS)
def test_faces_end_in_corners(method, real, domain, more, adapter, adapter32):
    h, more = 0.045, dict(more)
    if "levels" in more:
        more["options"] = clvoro.MultilevelOptions(levels=more.pop("levels"))
    used = adapter if real == "float64" else adapter32
    result = used.run(domain, h, method=method, seed=4, **more)
    own = h * result.size_factor
    found = gaps(result.diagram, own)
    assert len(found) > 0
    assert found.max() < 1e3 * np.finfo(real).eps / own
    if method in ("adaptive", "exact"):
        assert concavity(result.diagram) < 1


def test_stations_stand_around_corners_with_room():
    """Three around a corner of 270 degrees, at one distance, each in a sector of 90; none where there is no room."""
    corner = int(np.flatnonzero(L.oriented.turns < 0)[0])
    none = np.empty((0, 2))
    stations = L.stations(lambda x: np.full(len(x), 0.05), L, none)
    assert stations.corners.tolist() == [corner]
    away = stations.points - L.oriented.vertices[corner]
    assert np.allclose(np.hypot(*away.T), 0.05 / np.sqrt(2))
    assert np.allclose(np.degrees(np.arctan2(*away.T[::-1])) % 90, 45)
    assert np.allclose(L.boundary_distance(stations.points)[[0, 2]], 0.025)
    for given, h in ((stations.points[1:2] + 0.01, 0.05), (none, 0.5)):
        assert len(L.stations(lambda x, h=h: np.full(len(x), h), L, given)) == 0


@pytest.mark.parametrize(("h", "count"), [(0.1, 2), (0.35, 0)])
def test_corners_with_short_sides_have_no_stations(h, count):
    stairs = clvoro.Polygon([(0, 0), (4, 0), (4, 1), (2.5, 1), (2.5, 1.5), (2, 1.5), (2, 2.5), (0, 2.5)])
    stations = stairs.stations(lambda x: np.full(len(x), h), stairs, np.empty((0, 2)))
    assert len(stations.corners) == count


@pytest.mark.parametrize("method", ["adaptive", "exact"])
def test_stations_stay_and_their_faces_end_in_the_corner(ctx, method):
    result = clvoro.Adapter(ctx).run(L, 0.08, effort="fast", seed=2, method=method)
    corner = L.oriented.vertices[np.flatnonzero(L.oriented.turns < 0)]
    away = result.diagram.points[:3] - corner
    assert np.allclose(np.hypot(*away.T), np.hypot(*away[0]))
    if method == "adaptive":  # faces of weighted cells are off by little
        inner = result.solver_mesh()
        gap = np.hypot(*(inner.points - corner).T)
        ends = inner.corners.reshape(-1, 2)[: inner.n_inner]
        assert np.count_nonzero((gap < 1e-9)[ends].any(axis=1)) == 2
    assert result.check(solver="openfoam")
