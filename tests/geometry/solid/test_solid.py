"""Solids: where points are, patches and creases, the planes that cut cells; against formulas and slow references."""

import pickle
import warnings

import numpy as np
import pytest
import shapely

from clvoro import Polygon, Solid
from clvoro.adaptation.diagnostics import warn_of_narrow_parts
from clvoro.errors import InputError, MismatchWarning
from clvoro.geometry.columns import Columns
from clvoro.geometry.triangles import packed_rows, packed_weights, pierced


def winding(corners, points):
    """The winding number as the sum of solid angles (van Oosterom and Strackee)."""
    v = corners - points[:, None, None]
    length = np.linalg.norm(v, axis=-1)
    a, b, c = np.moveaxis(v, -2, 0)
    la, lb, lc = np.moveaxis(length, -1, 0)
    rest = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return 2 * np.arctan2(np.einsum("...k,...k->...", a, np.cross(b, c)), rest).sum(axis=1) / (4 * np.pi)


def away(x, triangle):
    """Distances to one triangle: to its plane above it, and else to its sides."""
    sides = np.roll(triangle, -1, axis=0) - triangle
    normal = np.cross(sides[0], sides[1])
    best = np.full(len(x), np.inf)
    above = np.full(len(x), bool(normal.any()))
    for a, side in zip(triangle, sides, strict=True):
        t = np.clip((x - a) @ side / max(side @ side, 1e-300), 0, 1)
        best = np.minimum(best, np.linalg.norm(x - a - t[:, None] * side, axis=1))
        above &= np.cross(side, x - a) @ normal >= 0
    return np.where(above, np.abs((x - triangle[0]) @ normal) / max(np.linalg.norm(normal), 1e-300), best)


def around(solid, n, seed=0):
    """Points in a box somewhat larger than the solid."""
    return np.random.default_rng(seed).uniform(
        solid.lower - 0.1 * solid.extent, solid.upper + 0.1 * solid.extent, (n, 3)
    )


def frames(inner, outer):
    """A box with a box-shaped cavity: the sides of the inner one point into the cavity."""
    a, b = Solid.box(*outer), Solid.box(*inner)
    triangles = np.vstack([a.surface.triangles, b.surface.triangles[:, ::-1] + len(a.surface.vertices)])
    return Solid(np.vstack([a.surface.vertices, b.surface.vertices]), triangles)


SOLIDS = {
    "box": Solid.box((0, 0, 0), (1, 2, 3)),
    "ball": Solid.ball((1, 2, 3), 2, edge=0.5),
    "cylinder": Solid.cylinder((0, 0, 0), (1, 1, 1), 0.7, edge=0.2),
    "cavity": frames(((1, 1, 1), (2, 2, 2)), ((0, 0, 0), (3, 3, 4))),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_points_inside_are_those_with_winding_number_one(name):
    solid = SOLIDS[name]
    x = around(solid, 400)
    wound = winding(solid.surface.corners, x)
    assert np.array_equal(solid.surface.columns.winding(x), np.rint(wound))
    assert np.array_equal(solid.contains(x), np.rint(wound) > 0)
    distance = solid.signed_distance(x)
    assert np.array_equal(distance < 0, np.rint(wound) > 0)
    slow = np.full(len(x), np.inf)
    for triangle in solid.surface.corners:
        slow = np.minimum(slow, away(x, triangle))
    assert np.abs(distance) == pytest.approx(slow, abs=1e-12)
    assert solid.contains(solid.surface.vertices).all()
    assert solid.contains(solid.surface.corners.mean(axis=1)).all()
    assert solid.contains(solid.inner_points()).all()
    assert (solid.boundary_distance(solid.nearest(x)) < np.abs(distance) * (distance < 0) + 1e-12).all()


def test_rays_through_edges_and_vertices_count_once():
    """A lattice whose rays meet vertices, edges and vertical sides of the surface."""
    solid = Solid.box((0, 0, 0), (1, 1, 1))
    x = np.stack(np.meshgrid(*3 * [np.arange(-0.25, 1.5, 0.25)], indexing="ij"), axis=-1).reshape(-1, 3)
    off = (solid.boundary_distance(x) > 0) & np.isfinite(x).all(axis=1)
    wound = Columns(solid.surface.corners).winding(x)
    assert np.array_equal(wound[off], np.rint(winding(solid.surface.corners, x[off])))
    assert np.array_equal(solid.contains(x), ((x >= 0) & (x <= 1)).all(axis=1))


@pytest.mark.parametrize("kind", ["any", "two corners at one place", "corners on a line", "a point"])
def test_distances_to_triangles(kind):
    rng = np.random.default_rng(7)
    x, corners = rng.normal(size=(500, 3)), rng.normal(size=(500, 3, 3))
    if kind == "two corners at one place":
        corners[:, 2] = corners[:, 1]
    elif kind == "corners on a line":
        corners[:, 2] = 0.3 * corners[:, 0] + 0.7 * corners[:, 1]
    elif kind == "a point":
        corners[:] = corners[:, :1]
    s, t, distance2 = packed_weights(x, packed_rows(corners))
    slow = [away(p[None], triangle)[0] for p, triangle in zip(x, corners, strict=True)]
    assert np.sqrt(distance2) == pytest.approx(slow, abs=1e-7)
    weights = np.column_stack([1 - s - t, s, t])
    foot = np.einsum("nk,nkd->nd", weights, corners)
    assert weights.min() > -1e-15
    assert np.linalg.norm(x - foot, axis=1) == pytest.approx(slow, abs=1e-7)


def test_segments_meet_triangles_where_a_linear_system_says():
    rng = np.random.default_rng(4)
    begin, end, corners = rng.normal(size=(300, 3)), rng.normal(size=(300, 3)), rng.normal(size=(300, 3, 3))
    share = pierced(begin, end, corners)
    for p, q, (a, b, c), t in zip(begin, end, corners, share, strict=True):
        at, u, v = np.linalg.solve(np.column_stack([q - p, a - b, a - c]), a - p)
        meets = 0 <= at <= 1 and u >= 0 and v >= 0 and u + v <= 1
        assert np.isfinite(t) == meets
        assert not meets or t == pytest.approx(at)
    assert np.isfinite(share).sum() > 5


def test_box_cylinder_and_cavity_have_their_patches_and_creases():
    box, cylinder, cavity = SOLIDS["box"], SOLIDS["cylinder"], SOLIDS["cavity"]
    assert box.boundary_names == ("xMin", "xMax", "yMin", "yMax", "zMin", "zMax")
    assert np.degrees(box.creases.angle) == pytest.approx(90)
    assert (box.creases.n_chains, len(box.corners), box.boundary_measure) == (12, 8, pytest.approx(22))
    assert cylinder.boundary_names == ("side", "bottom", "top")
    assert (cylinder.creases.n_chains, len(cylinder.corners)) == (2, 0)
    assert cylinder.creases.closed(0)
    assert not cylinder.creases.concave.any()
    assert (cavity.measure, cavity.n_pieces, cavity.n_patches) == (pytest.approx(35), 1, 12)
    assert cavity.creases.concave.sum() == 12
    assert np.degrees(cavity.creases.angle[cavity.creases.concave]) == pytest.approx(270)


def test_a_solid_comes_back_from_its_description():
    solid = SOLIDS["cylinder"]
    again = Solid.described(**solid.describe())
    assert again == solid
    assert hash(again) == hash(solid)
    assert again.boundary_names == solid.boundary_names
    assert pickle.loads(pickle.dumps(solid)) == solid
    drawn = Solid.box((0, 0, 0), (1, 1, 1), creases=np.array([[0, 6], [2, 4]]))
    assert Solid.described(**drawn.describe()).n_patches == drawn.n_patches == 7
    assert again != SOLIDS["ball"]


def test_thin_parts_and_gaps_are_found():
    def size(x):
        return np.full(len(x), 0.2)

    plate = Solid.box((0, 0, 0), (1, 1, 0.02))
    gap = Solid.outside(Solid.box((0, 0, 0.03), (1, 1, 0.5)), ((-1, -1, 0), (2, 2, 1)))
    for solid, width in ((plate, 0.02), (gap, 0.03)):
        strait = solid.narrow_parts(size)[0]
        assert strait.width == pytest.approx(width)
        assert solid.contains(strait.place[None])[0]
    strait, thin = Solid.box((0, 0, 0), (1, 1, 0.15)).narrow_parts(size)
    assert (strait, thin.share) == (None, pytest.approx(2 / 2.6, rel=0.01))
    for solid in (SOLIDS["box"], SOLIDS["ball"], Solid.cone((0, 0, 0), (0, 0, 1), 0.2)):
        assert solid.narrow_parts(lambda x: np.full(len(x), 0.1)) == (None, None)


@pytest.mark.parametrize(
    ("gap", "thick", "h", "found"),
    [(3, 1, 1.5, True), (3, 1, 1.2, True), (3, 1, 0.99, False), (6, 1, 1.5, False), (3, 2, 1.5, False)],
)
def test_gaps_of_few_cells_between_thin_fins_are_found(gap, thick, h, found):
    """Thicker fins, wider gaps and smaller cells are not found; the message's size is among these."""
    pitch = gap + thick
    body = shapely.union_all(
        [shapely.box(0, 0, 4 * pitch, 5), *[shapely.box(x, 4, x + thick, 20) for x in range(2, 4 * pitch, pitch)]]
    )
    fins = Solid.extruded(Polygon.from_shapely(body), 0, 20).outside(((-9, -9, -9), (4 * pitch + 9, 30, 30)))
    strait, gaps = fins.narrow_parts(lambda x: np.full(len(x), h))
    assert strait is None
    assert (gaps is not None) == found
    if found:
        assert (gaps.width, gaps.behind) == pytest.approx((3, 1))
        assert fins.contains(gaps.place[None])[0]
        with pytest.warns(MismatchWarning, match="gaps of less than 3 cells .* Use sizes of at most 0.99 there"):
            warn_of_narrow_parts(fins, lambda x: np.full(len(x), h))


def test_voxels_are_recognized_and_have_a_remedy():
    """The remedy is that of the guide."""
    ndimage, measure = pytest.importorskip("scipy.ndimage"), pytest.importorskip("skimage.measure")
    mask = np.pad(np.linalg.norm(np.moveaxis(np.indices((9, 9, 9)), 0, -1) - 4, axis=-1) < 4.2, 1)
    corners = []
    for axis, side in np.ndindex(3, 2):
        u, v = np.eye(3)[[axis - 2, axis - 1]]
        at = np.argwhere(mask & ~np.roll(mask, 1 - 2 * side, axis)) + side * np.eye(3)[axis]
        corners.append(np.stack([at, at + u, at + u + v, at + v][:: 2 * side - 1], axis=1).reshape(-1, 3))
    quads = np.arange(len(np.concatenate(corners))).reshape(-1, 4)
    with pytest.warns(MismatchWarning, match="voxels 2 wide, with creases around .* Smooth the mask"):
        solid = Solid(np.concatenate(corners) * (1, 1, 2), quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3))
    assert solid.measure == 2 * mask.sum()
    vertices, triangles, _, _ = measure.marching_cubes(ndimage.gaussian_filter(np.pad(mask, 3).astype(float), 0.7), 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert Solid(vertices, triangles[:, ::-1], angle=60).measure == pytest.approx(mask.sum(), rel=0.15)
        fins = shapely.union_all([shapely.box(0, -5, 60, 0), *(shapely.box(x, -5, x + 1, 25) for x in range(2, 60, 4))])
        assert Solid.extruded(Polygon.from_shapely(fins), 0, 50).n_patches > 50  # a heat sink


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Solid.ball((0, 0, 0), 0), "ball radius is 0"),
        (lambda: Solid.ball((0, 0, 0), 1, edge=-1), "ball edge is -1"),
        (lambda: Solid.ball((0, 0), 1), "3 coordinates"),
        (lambda: Solid.cylinder((0, 0, 0), (0, 0, 0), 1), "ends that differ"),
        (lambda: Solid.box((0, 0, 0), (1, 0, 1)), "expected lower < upper"),
        (lambda: Solid.torus((0, 0, 0), 1, -0.3), "torus tube is -0.3"),
    ],
)
def test_wrong_sizes_of_shapes_are_named(made, said):
    with pytest.raises(InputError, match=said):
        made()


def test_parts_without_cells():
    """A mesh has the walls of a cube: what a solid has besides is left out, and what it lacks is covered."""
    cube, h = Solid.box((0, 0, 0), (1, 1, 1)), 0.2
    fin, dent = Solid.box((0.4, 0.4, 0.9), (0.6, 0.6, 1.3)), Solid.box((0.3, 0.3, 0.7), (0.7, 0.7, 1.2))
    cavity, other = Solid.ball((0.5, 0.5, 0.5), 0.05, edge=0.02), Solid.ball((3, 0, 0), 0.3, edge=0.1)
    for solid, volume, places, share in (
        (cube, [], [], 0),
        (cube + fin, [0.012], [(0.5, 0.5, 1.2)], 0.05),
        (cube - dent, [-0.048], [(0.5, 0.5, 0.85)], 0.15),  # near its edges the walls are not far
        (cube - cavity, [-cavity.measure], [(0.5, 0.5, 0.5)], 1e-9),
        (cube + other, [other.measure], [(3, 0, 0)], 1e-9),
    ):
        measures, found = solid.uncovered(lambda: (cube.surface.corners, np.full(12, h)), 0.25)
        assert measures == pytest.approx(volume, rel=share)
        assert np.abs(found - np.array(places).reshape(-1, 3)).max(initial=0) < 0.35
        assert (solid.covers(found) == (measures > 0)).all()


def test_long_triangles_have_the_normal_of_a_tip_only_within_h_of_it():
    turn = 2 * np.pi * np.arange(48) / 48
    rim = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(48)])
    k, after = np.arange(48), (np.arange(48) + 1) % 48
    side = np.column_stack([np.full(48, 48), k, after])
    base = np.column_stack([np.full(48, 49), after, k])
    cone = Solid(np.vstack([rim, [(0, 0, 2), (0, 0, 0)]]), np.concatenate([side, base]))
    walls, h = cone.wall_triangles, 0.2
    sides = np.cross(walls.corners[:, 1] - walls.corners[:, 0], walls.corners[:, 2] - walls.corners[:, 0])
    areas = np.linalg.norm(sides, axis=1) / 2
    assert np.bincount(walls.items, areas) == pytest.approx(cone._areas)
    assert np.einsum("ti,ti->t", sides / areas[:, None], cone.normals[walls.items]) == pytest.approx(2)
    x, normals = walls.corners.reshape(-1, 3), walls.corner_normals(1.0, lambda x: np.full(len(x), h))
    normals = normals[..., :3].reshape(-1, 3)
    on_side = cone.normals[np.repeat(walls.items, 3), 2] > 0
    away = np.linalg.norm(x - (0, 0, 2), axis=1)
    assert normals[on_side & (away == 0)] == pytest.approx(np.tile((0.0, 0.0, 1.0), (48, 1)), abs=1e-9)
    far = on_side & (away >= h)
    exact = np.column_stack([2 * x[far, :2] / np.linalg.norm(x[far, :2], axis=1)[:, None], np.ones(far.sum())])
    assert normals[far] == pytest.approx(exact / np.sqrt(5), abs=0.01)
    near = on_side & (away > 0) & (away < h)
    assert near.any()
    assert (normals[near, 2] > 1 / np.sqrt(5) + 0.01).all()
