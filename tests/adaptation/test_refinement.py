"""Refinement: parents, middles of edges, and the rule at walls, counted and placed by NumPy."""

import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree

import clvoro
from clvoro.adaptation.refinement import Refinement, most_checked
from clvoro.adaptation.stages import Stages
from clvoro.adaptation.tuning import SHORT_FACE
from clvoro.tessellation.tessellator import Tessellator
from tests.reference import patch
from tests.reference.shores import POLYGONS, lattice, scattered

BOX = patch.BOX


def refine(engine, points, h):
    t = patch.tessellate(engine, points)
    return patch.fetch(t), Refinement(engine).refine(BOX, t, engine.upload(h)).get()


def as_sorted(points):
    return points[np.lexsort(points.T)]


@pytest.mark.sparse(4)
@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("n", [1, 2, 3, 40, 700])
def test_children(ctx, real, n):
    engine = patch.make_engine(ctx, real)
    points = patch.random_points(n, n + 41).astype(real)
    points[:2] = [(0, 0.3), (0.6, 1e-6)][:n]  # on a wall, and nearly on one
    h = np.random.default_rng(n).uniform(0.5, 1, n).astype(real) * np.sqrt(0.75 / n / 4)
    host, finer = refine(engine, points, h)
    assert np.array_equal(finer[:n], points), "the parents come first, in their order"
    expected = patch.children(host, BOX, h)
    assert len(finer) == n + len(expected)
    eps = float(np.finfo(real).eps)
    assert as_sorted(finer[n:]) == pytest.approx(as_sorted(expected), abs=2 * eps)
    assert BOX.contains(finer).all()


def children_in(shape, tangents, host, h, labels, fixed):
    """Middles that a longer common face has not given yet, if in sight, else those of faces; by shapely.

    Where a corner of the boundary would put them all but on their generator, they are at the face.
    """

    def leaves(x, y):
        """Parameter at which the segment from x to y leaves the domain; 1 if it does not."""
        inside = shapely.LineString([x, y]).intersection(shape)
        if inside.geom_type == "MultiLineString":
            inside = min(inside.geoms, key=shapely.Point(x).distance)
        t = inside.length / np.hypot(*(y - x))
        return 1 if t > 1 - 1e-9 else t

    def kept(x, y):
        t = leaves(x, y)
        return y if t == 1 else x + t / 2 * (y - x)

    def apart(x, y, other, least):
        y = kept(x, y)
        # Places that the parents do not see may belong to layers.
        other = kept(x, other) if fixed else other
        gap, another = np.hypot(*(y - x)), np.hypot(*(other - x))
        return other if gap < least and another > gap else y

    children, sizes = [], host.face_measures
    for k, (i, j) in enumerate(zip(host.owners, host.neighbors, strict=True)):
        x, m, row = host.points[i], host.face_centroids[k], np.flatnonzero(host.owners == i)
        if labels[i] < fixed or (j >= 0 and labels[j] < fixed):
            continue
        if 0 <= j < i or sizes[k] <= SHORT_FACE * np.sqrt(host.volumes[i]):
            continue
        alike = row[host.neighbors[row] == j] if j >= 0 else row[host.neighbors[row] < 0]
        longest = k == alike[sizes[alike].argmax()]  # the first of several
        if j >= 0:
            middle = (x + host.points[j]) / 2
            seen = longest and leaves(x, middle) == 1
            children.append(middle if seen else apart(x, x + m, x + m, h[i] / 16))
        elif longest:
            inwards = np.array([-tangents[-1 - j, 1], tangents[-1 - j, 0]])
            gap = -m @ inwards
            ways = host.points[host.neighbors[row][host.neighbors[row] >= 0]] - x
            room = patch.free_depth(ways, inwards, gap, h[i] / 2)
            way = min(gap / 2, h[i] / 4) if gap > h[i] / 8 else room / 2
            goal = x + m + way * inwards
            children.append(apart(x, goal, kept(x + m, goal), h[i] / 16))
    return np.array(children)


@pytest.mark.sparse(4)
@pytest.mark.parametrize("fixed", [0, 30])
@pytest.mark.parametrize("name", ["star", "holes", "islands", "comb", "fine comb", "corner"])
def test_children_in_polygons(ctx, name, fixed):
    domain, n = POLYGONS[name](), 80
    engine = patch.make_engine(ctx, box=domain)
    points = domain.place(scattered(domain, n, 5801), engine.real)
    t = Tessellator(Stages(engine), domain).tessellate(engine.upload(points), n)
    rng = np.random.default_rng(5802)
    labels, h = rng.permutation(n), rng.uniform(0.02, 0.2, n)
    given = [engine.upload(labels, np.int32), fixed] if fixed else []
    finer = Refinement(engine).refine(domain, t, engine.upload(h), *given).get()
    assert np.array_equal(finer[:n], points)
    origin, scale = domain.frame
    shape = shapely.transform(domain.geometry, lambda y: (y - origin) / scale)
    along = domain.oriented.vertices[domain.oriented.next_vertex] - domain.oriented.vertices
    tangents = along / np.hypot(*along.T)[:, None]
    expected = children_in(shape, tangents, patch.fetch(t), h, labels, fixed)
    assert len(expected) > n
    # The children of a generator follow in the order of its faces; crossings round by their angle's cosecant.
    assert finer[n:] == pytest.approx(expected, rel=0, abs=1e-12)


@pytest.mark.parametrize(("side", "count"), [(1, 2), (2, 12), (4, 52)])
def test_equal_boundary_edges_bring_one_generator(ctx, side, count):
    """Squares at the edges of a square; those at its corners have two walls there."""
    domain = POLYGONS["square"]()
    engine, n = patch.make_engine(ctx, box=domain), side**2
    points = engine.upload(domain.place(lattice(side), engine.real))
    t = Tessellator(Stages(engine), domain).tessellate(points, n)
    h = engine.upload(np.full(n, 0.5 / side))
    finer = Refinement(engine).refine(domain, t, h).get() * domain.frame[1] + domain.frame[0]
    # Parents, middles between neighbors in rows and columns, and one for each square at an edge.
    assert count == n + 2 * side * (side - 1) + n - max(side - 2, 0) ** 2
    assert len(finer) == len(np.unique(finer, axis=0)) == count
    assert domain.contains(finer).all()


def test_a_lattice_is_carried_over(ctx):
    """A hexagonal lattice is refined to that of half the spacing, away from walls."""
    a = 1 / 16
    points = patch.hexagons(a)
    engine = patch.make_engine(ctx)
    _, finer = refine(engine, points, np.full(len(points), a / 2))
    host = patch.fetch(patch.tessellate(engine, finer))
    inside = ((finer > 1.5 * a) & (finer < np.array(BOX.upper) - 1.5 * a)).all(axis=1)
    assert inside.sum() > 300
    assert (np.diff(host.starts)[inside] == 6).all()
    assert host.volumes[inside] == pytest.approx(np.full(inside.sum(), (a / 2) ** 2 * np.sqrt(3) / 2))


def test_squares_get_no_point_twice(ctx):
    """Four cells share a vertex: diagonals without a face bring no new generator."""
    xy = np.stack(np.meshgrid(np.arange(8), np.arange(6), indexing="ij"), -1).reshape(-1, 2)
    points = (xy + 0.5) / 8
    _, finer = refine(patch.make_engine(ctx), points, np.full(48, 1 / 16))
    assert len(finer) == 48 + 7 * 6 + 8 * 5 + 2 * (8 + 6)
    assert len(np.unique(finer, axis=0)) == len(finer)


def test_new_generators_that_coincide_are_removed(ctx):
    """Those with others, and of two new ones the second. 1,600 islands bring some at 6,000 generators."""
    engine, old = patch.make_engine(ctx), patch.random_points(30, 5)
    new = np.array([[0.25, 0.5], old[7] * (1 + 1e-15), [0.3, 0.5], [0.25, 0.5]])
    finer = engine.upload(np.concatenate([old, new]))
    found = Refinement(engine)._without_coincident(finer, 30).get()
    assert np.array_equal(found, np.concatenate([old, new[[0, 2]]]))
    ring = np.array([[np.cos(a), np.sin(a)] for a in np.arange(4800) * (2 * np.pi / 4800)])
    assert most_checked(clvoro.Polygon(ring)) > 6000
    assert most_checked(POLYGONS["square"]()) < 6000


@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("share", [0, 1e-4, 0.99, 1.01])
def test_new_generators_keep_a_distance_at_walls(ctx, real, share):
    """There is no new generator between a wall and a generator very near it, nor in thin boxes."""
    h = 0.08
    for thin in (0.75, 0.0625):
        room = min(h, thin / 2)
        gap = share * room / 8  # around the least gap that has room
        box = patch.Box((0, 0), (1, thin))
        engine = patch.make_engine(ctx, real, box=box)
        points = np.array([(0.3, gap), (0.7, thin - gap)], real)
        t = patch.tessellate(engine, points, box)
        finer = Refinement(engine).refine(box, t, engine.upload(np.full(2, h))).get()
        assert box.contains(finer).all()
        apart, _ = cKDTree(finer).query(finer, k=2)
        assert apart[:, 1].min() > 0.06 * room  # half of the least gap: a sixteenth


@pytest.mark.parametrize("real", ["float64", "float32"])
@pytest.mark.parametrize("count", [4, 15, 40])
def test_no_child_beyond_a_cell(ctx, real, count):
    """Cells much flatter than h in a thin strip: new generators at walls stay in their cells."""
    box = patch.Box((0, 0), (0.125, 1))
    engine = patch.make_engine(ctx, real, box=box)
    step = 0.125 / (count + 1)
    points = np.column_stack([step * np.arange(1, count + 1), np.full(count, 0.25)]).astype(real)
    t = patch.tessellate(engine, points, box)
    finer = Refinement(engine).refine(box, t, engine.upload(np.full(count, 0.1))).get()
    apart, _ = cKDTree(finer).query(finer, k=2)
    assert apart[:, 1].min() > 0.2 * step  # half a gap, or half of that beyond it
