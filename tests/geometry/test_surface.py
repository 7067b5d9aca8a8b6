"""Triangulated surfaces: distance against brute force, reading, closedness, self-intersection."""

import warnings

import numpy as np
import pytest

from clvoro import Box, sizing
from clvoro.errors import InputError, InputTypeError
from clvoro.geometry.bvh import Tree
from clvoro.geometry.triangles import crossing
from clvoro.opencl.engine import Engine

DOMAIN = Box((3.0, -1.0, 10.0), (5.0, 1.0, 11.5))


def torus(n, m, center=(4.0, 0.0, 10.75), radii=(0.5, 0.2)):
    """Vertices and outward triangles of a torus of 2 n m triangles."""
    u, v = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.arange(m) * 2 * np.pi / m, indexing="ij")
    r = radii[0] + radii[1] * np.cos(v)
    places = np.stack([r * np.cos(u), r * np.sin(u), radii[1] * np.sin(v)], axis=-1)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    corner = [((i + a) % n * m + (j + b) % m).ravel() for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    triangles = np.concatenate(
        [np.column_stack([corner[0], corner[1], corner[2]]), np.column_stack([corner[0], corner[2], corner[3]])]
    )
    return places.reshape(-1, 3) + center, triangles


CUBE = (
    np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)], float),
    np.array(
        [
            [0, 2, 3],
            [0, 3, 1],
            [4, 5, 7],
            [4, 7, 6],
            [0, 1, 5],
            [0, 5, 4],
            [2, 6, 7],
            [2, 7, 3],
            [0, 4, 6],
            [0, 6, 2],
            [1, 3, 7],
            [1, 7, 5],
        ]
    ),
)


def soup(n, seed):
    """Triangles of sizes from 1e-4 to 1, among them thin ones, segments and points."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(DOMAIN.lower, DOMAIN.upper, (n, 1, 3))
    corners = middle + 10 ** rng.uniform(-4, 0, (n, 1, 1)) * rng.normal(size=(n, 3, 3))
    k = n // 8
    t = rng.uniform(0, 1, (3, k, 1))
    thin = 10.0 ** rng.integers(-12, 0, (k, 1))
    corners[:k, 2] = corners[:k, 0] + t[0] * (corners[:k, 1] - corners[:k, 0])
    corners[:k, 2] += thin * rng.normal(size=(k, 3))
    corners[k, 1] = corners[k, 0]
    corners[k + 1, :] = corners[k + 1, :1]
    return corners.reshape(-1, 3), np.arange(3 * n).reshape(n, 3)


def brute_force(points, vertices, triangles):
    """Smallest distance to all triangles, by the seven features of each."""
    best = np.full(len(points), np.inf)
    for corners in vertices[triangles]:
        for k in range(3):
            a, d = corners[k], corners[(k + 1) % 3] - corners[k]
            best = np.minimum(best, np.linalg.norm(points - a, axis=1))
            if d.any():
                t = (points - a) @ (d / np.abs(d).max()) / (d @ (d / np.abs(d).max()))
                foot = a + t[:, None] * d
                away = np.linalg.norm(points - foot, axis=1)
                best = np.where((t >= 0) & (t <= 1), np.minimum(best, away), best)
        # The projection onto the plane, in an orthonormal basis.
        q, r = np.linalg.qr((corners[1:] - corners[0]).T)
        if abs(r[0, 0] * r[1, 1]) > 1e-13 * np.abs(r).max() ** 2:
            s, t = np.linalg.solve(r, q.T @ (points - corners[0]).T)
            away = np.abs((points - corners[0]) @ np.cross(q[:, 0], q[:, 1]))
            inside = (s >= 0) & (t >= 0) & (s + t <= 1)
            best = np.where(inside, np.minimum(best, away), best)
    return best


MESHES = {
    "torus": torus(24, 12),
    "cube": (CUBE[0] * 0.7 + (3.6, -0.4, 10.3), CUBE[1]),
    "one": (np.array([[3.1, -0.5, 10.2], [4.9, -0.4, 10.6], [3.9, 0.9, 11.3]]), [[0, 1, 2]]),
    "soup": soup(400, 7310),
}


@pytest.fixture(params=["float64", "float32"])
def engine(request, ctx):
    import pyopencl as cl

    return Engine(ctx, cl.CommandQueue(ctx), 3, np.dtype(request.param))


def near_and_far(vertices, triangles, n, seed):
    rng = np.random.default_rng(seed)
    far = rng.uniform(DOMAIN.lower, DOMAIN.upper, (n, 3))
    corners = np.asarray(vertices)[np.asarray(triangles)]
    picked = corners[rng.integers(0, len(corners), n)]
    on = np.einsum("nk,nkd->nd", rng.dirichlet((0.5, 0.5, 0.5), n), picked)
    near = on + 10 ** rng.uniform(-6, -1, (n, 1)) * rng.normal(size=(n, 3))
    points = np.concatenate([far, on, near, np.asarray(vertices)[:n]])
    return np.clip(points, DOMAIN.lower, DOMAIN.upper)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("name", MESHES)
def test_distance_on_the_device_is_that_of_brute_force(engine, name):
    vertices, triangles = MESHES[name]
    field = sizing.Distance(sizing.Surface(vertices, triangles), h_min=1.0, slope=1.0)
    points = near_and_far(vertices, triangles, 150, 929)
    found = sizing.Sizing(engine, DOMAIN, field)(points) - 1
    expected = brute_force(points, vertices, np.asarray(triangles))
    # h = 1 + distance in a frame of scale 2: round-off of coordinates and of h; triangles thinner
    # than 1e-7 of their length count as their sides.
    assert np.abs(found - expected).max() < 40 * np.finfo(engine.real).eps + 2e-7 * (name == "soup")
    assert np.abs(field(points) - 1 - expected).max() < 1e-14 + 2e-7 * (name == "soup")


@pytest.mark.sparse(1)
def test_distance_to_shapes_of_all_kinds(engine):
    """The minimum over spheres, curves, a box and two surfaces, with a common upper bound."""
    rng = np.random.default_rng(4711)
    shapes = [
        sizing.Ball((3.5, 0.5, 10.4), 0.2),
        sizing.Segment((3, -1, 10), (4, 0, 11)),
        sizing.Polyline(rng.uniform(DOMAIN.lower, DOMAIN.upper, (20, 3))),
        sizing.Surface(*MESHES["torus"]),
        sizing.Surface(*MESHES["one"]),
        DOMAIN,
    ]
    points = rng.uniform(DOMAIN.lower, DOMAIN.upper, (700, 3))
    each = [sizing.Distance(s, 0.01, slope=0.4, h_max=0.05)(points) for s in shapes]
    field = sizing.Distance(shapes, 0.01, slope=0.4, h_max=0.05)
    assert np.allclose(field(points), np.min(each, axis=0), rtol=0, atol=1e-15)
    found = sizing.Sizing(engine, DOMAIN, field)(points)
    # Slope 0.4 times the round-off of coordinates in a frame of scale 2.
    assert np.abs(found - field(points)).max() < 20 * np.finfo(engine.real).eps


@pytest.mark.parametrize("dim", [2, 3])
def test_distance_to_a_box_is_to_its_sides(dim):
    box = Box((1.0,) * dim, (2.0, 4.0, 3.0)[:dim])
    points = np.random.default_rng(33).uniform(0, 5, (500, dim))
    to_walls = np.minimum(points - box.lower, np.subtract(box.upper, points)).min(axis=1)
    outside = np.maximum(np.maximum(box.lower - points, points - np.array(box.upper)), 0)
    expected = np.where(box.contains(points), to_walls, np.linalg.norm(outside, axis=1))
    field = sizing.Distance(box, 1, slope=1)
    assert np.allclose(field(points) - 1, expected, rtol=0, atol=1e-14)


@pytest.mark.sparse(1)
def test_bits_repeat(engine):
    field = sizing.Distance(sizing.Surface(*MESHES["soup"]), 0.01, growth=1.2)
    points = near_and_far(*MESHES["soup"], 300, 17)
    a, b = (sizing.Sizing(engine, DOMAIN, field)(points) for _ in range(2))
    assert np.array_equal(a, b)


def test_landmarks_lie_on_the_surface_and_reach_all_of_it():
    surface = sizing.Surface(*torus(60, 30))
    marks = sizing.Distance(surface, 0.1, slope=1).landmarks(DOMAIN)
    assert surface.distance2(marks).max() < 1e-28
    assert len(marks) <= 1 << 14
    gap = np.linalg.norm(marks[:, None] - surface.vertices[None, ::7], axis=2).min(axis=0)
    # Twice their spacing of 1.5 / 64.
    assert gap.max() < 3 / 64


@pytest.mark.slow
def test_a_triangulated_ball_needs_as_many_cells_as_a_sphere(engine):
    """The thin shell of small cells is found, and their number is that of the exact sphere."""
    from clvoro.adaptation.sampling.quadrature import DensityTree

    n, m = 24, 36  # rings from pole to pole
    a, b = np.meshgrid(np.pi * np.arange(n + 1) / n, 2 * np.pi * np.arange(m) / m, indexing="ij")
    ball = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)], axis=-1)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
    here, there = i * m + j, i * m + (j + 1) % m
    triangles = np.vstack([np.column_stack([here, here + m, there + m]), np.column_stack([here, there + m, there])])
    center = (4.0, 0.0, 10.75)
    # The vertices of a pole differ by round-off.
    surface = sizing.Surface(center + 0.5 * ball.reshape(-1, 3), triangles, join=1e-12)
    assert surface.closed
    law = {"h_min": 0.02, "slope": 0.5, "h_max": 0.2}
    counts = [
        DensityTree(sizing.Sizing(engine, DOMAIN, sizing.Distance(s, **law)), DOMAIN, 1e-3).integral
        for s in (surface, sizing.Ball(center, 0.5))
    ]
    # The area of the facets is 0.7 % less than that of the sphere; the number of cells differs a little more.
    assert counts[0] == pytest.approx(counts[1], rel=8e-3)


@pytest.mark.sparse(3)
@pytest.mark.parametrize("unit", [1e-45, 1e-20, 1e20, 1e45])
def test_units_do_not_matter(engine, unit):
    vertices, triangles = MESHES["torus"]
    points = np.random.default_rng(10).uniform(DOMAIN.lower, DOMAIN.upper, (200, 3))
    plain = sizing.Distance(sizing.Surface(vertices, triangles), 0.01, slope=0.3)
    wanted = sizing.Sizing(engine, DOMAIN, plain)(points)
    surface = sizing.Surface(vertices * unit, triangles)
    field = sizing.Distance(surface, 0.01 * unit, slope=0.3)
    domain = Box(np.multiply(DOMAIN.lower, unit), np.multiply(DOMAIN.upper, unit))
    found = sizing.Sizing(engine, domain, field)(points * unit) / unit
    assert found == pytest.approx(wanted, rel=300 * float(np.finfo(engine.real).eps))
    assert len(field.landmarks(domain)) == len(plain.landmarks(DOMAIN))
    assert len(surface.crossings()) == 0


def test_tree_finds_every_overlap():
    rng = np.random.default_rng(2718)
    low = rng.uniform(0, 1, (333, 3))
    high = low + 10 ** rng.uniform(-3, -0.5, (333, 3))
    i, j = Tree(low, high).overlaps()
    assert (i < j).all()
    assert len(np.unique(i * 333 + j)) == len(i)
    found = set(zip(i.tolist(), j.tolist(), strict=True))
    meet = (low[:, None] <= high).all(axis=2) & (low <= high[:, None]).all(axis=2)
    expected = {(a, b) for a, b in np.argwhere(meet).tolist() if a < b}
    assert expected <= found


# --- closed, open, crossing ----------------------------------------------------------------------


def test_closed_surfaces():
    vertices, triangles = torus(8, 6)
    whole = sizing.Surface(vertices, triangles)
    assert whole.closed
    whole.require_closed()
    # The same with separate triangles, and with triangles of two equal corners.
    apart = sizing.Surface(vertices[triangles].reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3))
    assert apart.closed
    assert sizing.Surface(vertices, np.vstack([triangles, [[3, 3, 9]]])).closed
    holed = sizing.Surface(vertices, triangles[1:], name="part")
    assert not holed.closed
    ends = {frozenset(e) for e in holed.open_edges.tolist()}
    a, b, c = triangles[0].tolist()
    assert ends == {frozenset(e) for e in ((a, b), (b, c), (c, a))}
    with pytest.raises(InputError, match=r"part is open: 3 edges .* from \(.*fill the holes"):
        holed.require_closed()
    shaken = vertices[triangles] + 1e-9 * np.random.default_rng(55).random((len(triangles), 3, 3))
    loose = shaken.reshape(-1, 3), np.arange(triangles.size).reshape(-1, 3)
    assert not sizing.Surface(*loose).closed
    assert not sizing.Surface(*loose, join=1e-12).closed
    assert sizing.Surface(*loose, join=1e-8).closed
    with pytest.raises(InputError, match="open"):
        holed.contains([(0, 0, 0)])
    fins = sizing.Surface(vertices, np.vstack([triangles, [[a, b, 30]], [[a, b, 30]], [[a, b, 30]]]))
    with pytest.raises(InputError, match="odd number of triangles"):
        fins.require_closed()


def test_inside_of_a_torus():
    center = np.array([4.0, 0.0, 10.75])
    points = np.random.default_rng(606).uniform(DOMAIN.lower, DOMAIN.upper, (600, 3))
    ring = np.hypot(*(points - center)[:, :2].T) - 0.5
    depth = np.hypot(ring, (points - center)[:, 2]) - 0.2
    off = np.abs(depth) > 0.01  # facets are off the torus by up to 0.5 (pi / 48)^2
    surface = sizing.Surface(*torus(48, 24))
    assert np.array_equal(surface.contains(points)[off], depth[off] < 0)
    flipped = sizing.Surface(surface.vertices, surface.triangles[:, ::-1])
    assert np.array_equal(flipped.contains(points), surface.contains(points))


def test_valid_surfaces_have_no_intersections():
    for vertices, triangles in (torus(24, 12), CUBE, torus(7, 5)):
        surface = sizing.Surface(vertices, triangles)
        assert surface.crossings().shape == (0, 2)
        surface.check()
    # Two cubes side by side share a side; boxes in contact do not intersect.
    shifted = sizing.Surface(np.vstack([CUBE[0], CUBE[0] + (1.0, 1.0, 0)]), np.vstack([CUBE[1], CUBE[1] + 8]))
    assert len(shifted.crossings()) == 0


def pierces(a, b):
    """Whether a side of a intersects b, by signs of volumes, for one pair."""

    def volume(*p):
        return np.linalg.det(np.subtract(p[1:], p[0]))

    for k in range(3):
        p, q = a[k], a[(k + 1) % 3]
        if volume(*b, p) * volume(*b, q) < 0:
            signs = [np.sign(volume(p, q, b[m], b[(m + 1) % 3])) for m in range(3)]
            if abs(sum(signs)) == 3:
                return True
    return False


def test_intersections_agree_with_a_scalar_reference():
    rng = np.random.default_rng(1618)
    a, b = rng.uniform(0, 1, (2, 1500, 3, 3))
    expected = np.array([pierces(s, t) or pierces(t, s) for s, t in zip(a, b, strict=True)])
    assert 200 < expected.sum() < 1300
    assert np.array_equal(crossing(a, b), expected)
    assert np.array_equal(crossing(b, a), expected)


def test_intersections_in_one_plane_and_at_common_corners():
    flat = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    cases = [
        (flat, flat, True),  # equal
        (flat, flat[[1, 2, 0]] * 0.25 + (0.1, 0.1, 0), True),  # one in the other
        (flat, np.array([[1, 0, 0], [0, 1, 0], [1, 1, 0]]), False),  # neighbors in a plane
        (flat, np.array([[1, 0, 0], [0, 1, 0], [0.1, 0.1, 0]]), True),  # folded over
        (flat, np.array([[1, 0, 0], [0, 1, 0], [1, 1, 0.5]]), False),  # neighbors at an angle
        (flat, flat + np.array([2, 0, 0]), False),
        (flat, np.array([[0, 0, 0], [1, 1, 0.5], [1, 1, -0.5]]), True),  # cuts from a common corner
        (flat, np.array([[0, 0, 0], [-1, -1, 0.5], [-1, -1, -0.5]]), False),
        (flat, np.array([[0.2, 0.2, 0], [1, 1, 0.5], [0, 1, 0.5]]), False),  # stands on it
        (flat, np.array([[0.2, 0.2, 0], [0.4, 0.4, 0], [0.3, 0.3, 0]]), False),  # no area
    ]
    turn, _ = np.linalg.qr(np.random.default_rng(141).normal(size=(3, 3)))
    for a, b, expected in cases:
        for move in (np.eye(3), turn):
            assert crossing((a @ move)[None], (b @ move)[None])[0] == expected


def test_self_intersection_names_two_triangles():
    first, second = torus(16, 8), torus(12, 8, center=(4.5, 0, 10.8))
    vertices = np.vstack([first[0], second[0]])
    triangles = np.vstack([first[1], second[1] + len(first[0])])
    surface = sizing.Surface(vertices, triangles, name="parts")
    pairs = surface.crossings()
    corners = vertices[triangles]
    low, high = corners.min(axis=1), corners.max(axis=1)
    expected = []
    for p in range(len(first[1])):
        for q in range(len(first[1]), len(triangles)):
            if (low[p] <= high[q]).all() and (low[q] <= high[p]).all():
                if pierces(corners[p], corners[q]) or pierces(corners[q], corners[p]):
                    expected.append([p, q])
    assert pairs.tolist() == expected
    p, q = expected[0]
    with pytest.raises(InputError, match=rf"parts intersects itself: triangles {p}, .* and {q}, .*more"):
        surface.check()


# --- reading and refusing ------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["stl", "obj", "ply", "off"])
def test_files_are_read(tmp_path, kind):
    pytest.importorskip("trimesh")
    meshio = pytest.importorskip("meshio")
    vertices, triangles = torus(10, 6)
    path = tmp_path / f"part.{kind.upper()}"
    mesh = meshio.Mesh(vertices, {"triangle": triangles})
    meshio.write(path, mesh, file_format=kind)
    surface = sizing.Surface.read(path)
    assert len(surface) == len(triangles)
    assert surface.closed
    points = np.random.default_rng(9).uniform(DOMAIN.lower, DOMAIN.upper, (100, 3))
    # STL and meshio's OFF and OBJ keep 7 digits or more of coordinates of size 10.
    assert np.sqrt(surface.distance2(points)) == pytest.approx(
        np.sqrt(sizing.Surface(vertices, triangles).distance2(points)), abs=1e-5
    )


def test_broken_files_are_refused(tmp_path):
    pytest.importorskip("trimesh")
    for name, content in {
        "empty.stl": b"",
        "empty.obj": b"# nothing\n",
        "points.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\n",
        "noise.ply": b"ply\nformat ascii 1.0\nelement vertex 3\n",
        "noise.off": b"OFF\n3 1 0\n0 0 0\n1 0",
        "noise.stl": bytes(range(256)),
        "index.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
        "nan.obj": b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n",
        "flat.obj": b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n",
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name.replace(".", r"\.")):
            sizing.Surface.read(tmp_path / name)
    with pytest.raises(InputError, match=r"no surface file .*absent\.stl"):
        sizing.Surface.read(tmp_path / "absent.stl")
    with pytest.raises(InputError, match=r"\.stl, \.obj, \.ply, \.off"):
        sizing.Surface.read(tmp_path / "part.step")


def test_invalid_normals_in_files_are_ignored(tmp_path, caplog):
    """Normals are those of the triangles; warnings of the reader are not printed."""
    pytest.importorskip("trimesh")
    corners = "vertex 0 0 0 vertex 1 0 0 vertex 0 1 0"
    (tmp_path / "part.stl").write_text(
        f"solid\nfacet normal 0 zero 1\nouter loop\n{corners}\nendloop\nendfacet\nendsolid\n"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # raised by NumPy
        assert len(sizing.Surface.read(tmp_path / "part.stl")) == 1
    assert not caplog.records


@pytest.mark.parametrize(
    ("vertices", "triangles", "error", "message"),
    [
        (np.zeros((0, 3)), [[0, 1, 2]], InputError, r"triangles\[0, 0\] is 0"),
        (CUBE[0], [[0, 1, 8]], InputError, r"triangles\[0, 2\] is 8.*0 to 7"),
        (CUBE[0], [[0, 1, 2], [0, -1, 2]], InputError, r"triangles\[1, 1\] is -1"),
        (CUBE[0], [[0.0, 1.0, 2.0]], InputTypeError, "integers"),
        (np.where(CUBE[0] > 0, np.nan, 0), CUBE[1], InputError, r"vertices\[1, 0\] is nan"),
        ("ab", CUBE[1], InputTypeError, "numbers"),
    ],
)
def test_bad_surfaces(vertices, triangles, error, message):
    with pytest.raises(error, match=message):
        sizing.Surface(vertices, triangles)


def test_surface_needs_three_dimensions():
    field = sizing.Distance(sizing.Surface(*CUBE), 0.1, slope=1)
    with pytest.raises(InputError, match="3 dimensions"):
        sizing.generate_code(field, Box((0, 0), (1, 1)))
    with pytest.raises(InputError, match="2 and of 3"):
        sizing.Distance([sizing.Surface(*CUBE), sizing.Circle((0, 0), 1)], 0.1, slope=1)
