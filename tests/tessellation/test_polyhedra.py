"""The 3D diagram: comparison with references, and invariants, over point sets and precisions."""

import itertools

import numpy as np
import pytest

import clvoro
from clvoro.opencl import engine, ranges
from clvoro.opencl.engine import Engine
from clvoro.tessellation import cut_cells, polyhedra
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.part import Part
from clvoro.tessellation.polyhedra import Polyhedra
from tests.reference import diagrams3d as reference3d
from tests.reference.diagrams import faults
from tests.reference.diagrams3d import LATTICES, directions, lattice

BOX = clvoro.Box((0.0, 0.0, 0.0), (2.0, 1.5, 1.0))


def hexagonal(k, close_packed):
    j, i, layer = np.meshgrid(*[np.arange(k)] * 3, indexing="ij")
    if close_packed:
        x, y = 2 * i + (j + layer) % 2, np.sqrt(3) * (j + layer % 2 / 3)
        points = np.stack([x, y, 2 * np.sqrt(6) / 3 * layer], axis=-1)
    else:
        points = np.stack([i + j % 2 / 2, np.sqrt(0.75) * j, layer], axis=-1)
    points = points.reshape(-1, 3) + 0.4
    return points / (points.max() + 0.4) * BOX.extent.min()


def point_sets():
    rng = np.random.default_rng(20261)
    extent, middle = BOX.extent, np.array([1.0, 0.75, 0.5])
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([1 + 0.4 * np.cos(angle), 0.7 + 0.4 * np.sin(angle)], axis=1)
    corners = np.array(list(np.ndindex(2, 2, 2))) * extent
    sphere = middle + 0.4 * directions(60, rng)
    spread = rng.random((30, 3)) * extent
    few = np.array([[0.3, 1.1, 0.2], [1.7, 0.2, 0.9], [1.0, 0.9, 0.4]])
    return {
        "one": few[:1],
        "two": few[:2],
        "three": few,
        "random": rng.random((300, 3)) * extent,
        # The reference needs mirror images that differ from their points.
        "graded": (0.02 + 0.96 * rng.random((400, 3)) ** 3) * extent,
        "cubic": lattice("cubic", 5) * extent,
        "bcc": lattice("bcc", 4) * extent,
        "fcc": lattice("fcc", 4) * extent,
        "hexagonal": hexagonal(5, close_packed=False),
        "close-packed": hexagonal(5, close_packed=True),
        "sphere": sphere,
        "sphere with center": np.concatenate([sphere, [middle]]),
        "coplanar": np.column_stack([rng.random((70, 2)) * extent[:2], np.full(70, 0.3)]),
        "collinear": np.column_stack([np.linspace(0.1, 1.9, 31), np.full(31, 0.4), np.full(31, 0.6)]),
        "diagonal": np.linspace([0.1, 0.1, 0.1], [1.9, 1.4, 0.9], 37),
        "circle": np.column_stack([circle, np.full(24, 0.5)]),
        "prism": np.concatenate([np.column_stack([circle, np.full(24, z)]) for z in (0.2, 0.5, 0.8)]),
        "walls, edges and corners": np.concatenate(
            [
                corners,
                np.column_stack([rng.random(15) * extent[0], np.zeros((15, 2))]),
                np.column_stack([np.full(15, extent[0]), rng.random((15, 2)) * extent[1:]]),
                spread,
            ]
        ),
        "lattice on walls": np.array(list(np.ndindex(4, 4, 4))) / 3 * extent,
        "clusters": np.concatenate(
            [np.array(c) + s * rng.random((30, 3)) for c, s in [((0.4, 0.4, 0.4), 1e-2), ((1.8, 1.0, 0.7), 1e-3)]]
            + [spread]
        ),
    }


POINTS = point_sets()
FINE = [name for name in POINTS if name not in ("walls, edges and corners", "lattice on walls")]


@pytest.mark.sparse(6)
@pytest.mark.parametrize("name", list(POINTS))
def test_invariants(adapter, name):
    assert not faults(adapter.diagram(BOX, POINTS[name]))


@pytest.mark.sparse(1)
@pytest.mark.parametrize("kind", list(LATTICES))
@pytest.mark.parametrize("roundings", [1, 50, 500, 5000])
def test_lattices_off_by_round_off(adapter, kind, roundings):
    """Up to eight cells nearly meet at a vertex: from ties to faces that are hundreds of eps wide."""
    rng = np.random.default_rng(8231)
    cube, eps = clvoro.Box((0, 0, 0), (1, 1, 1)), float(np.finfo(adapter.dtype).eps)
    straight = lattice(kind, 5 if kind == "cubic" else 3)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    for points in (straight, 0.5 + 0.55 * (straight - 0.5) @ turn):
        diagram = adapter.diagram(cube, points + roundings * eps * rng.standard_normal(points.shape))
        assert not faults(diagram)


@pytest.mark.sparse(4)
@pytest.mark.parametrize("name", FINE)
def test_against_qhull(adapter64, name):
    points = POINTS[name]
    diagram = adapter64.diagram(BOX, points)
    # The error of Qhull's vertices is about 1e-13 of the box, more in thin cells.
    rel = 1e-9 if name == "clusters" else 1e-10
    for i, cell in enumerate(reference3d.box_voronoi(BOX.lower, BOX.upper, points)):
        assert diagram.volumes[i] == pytest.approx(cell.volume, rel=rel)
        size = cell.volume ** (1 / 3)
        assert np.abs(diagram.centroids[i] - cell.centroid).max() < rel * max(size, 0.1)
        row = slice(*diagram.neighbor_starts[i : i + 2])
        seen = dict(zip(diagram.neighbors[row].tolist(), diagram.face_measures[row], strict=True))
        # Faces of zero area (where many cells meet) may exist on one side only.
        either = set(cell.faces) | set(seen)
        areas, expected = ([faces.get(j, 0) for j in either] for faces in (seen, cell.faces))
        np.testing.assert_allclose(areas, expected, rtol=1e-8, atol=1e-11)


def test_faces_and_moments_against_qhull(adapter64):
    points = POINTS["random"]
    engine = Engine(adapter64.ctx, adapter64.queue, 3, np.dtype(float))
    t = tessellation(engine, Bins(engine), Polyhedra(engine), points)
    starts, neighbors = t.starts.get(), t.neighbors.get()
    centroids = t.face_centroids.get() * BOX.frame[1]
    covariances = t.covariances.get() * BOX.frame[1] ** 2
    for i, cell in enumerate(reference3d.box_voronoi(BOX.lower, BOX.upper, points)):
        for k in range(starts[i], starts[i + 1]):
            if cell.faces.get(neighbors[k], 0) > 1e-6:
                expected = cell.face_centroids[neighbors[k]] - points[i]
                assert centroids[k] == pytest.approx(expected, abs=1e-9)
        expected = cell.covariance[np.triu_indices(3)]
        assert covariances[i] == pytest.approx(expected, rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("name", ["walls, edges and corners", "lattice on walls"])
def test_volumes_of_points_on_walls(adapter64, name):
    """Mirror images coincide with these points, so the reference intersects half-spaces."""
    points = POINTS[name]
    diagram = adapter64.diagram(BOX, points)
    for i in range(0, len(points), 3):
        volume = reference3d.half_space_volume(np.array(BOX.lower), np.array(BOX.upper), points, i)
        assert diagram.volumes[i] == pytest.approx(volume, rel=1e-10)


@pytest.mark.parametrize(
    ("kind", "count"), [("cubic", 6), ("bcc", 14), ("fcc", 12)]
)  # cube, truncated octahedron, rhombic dodecahedron
def test_cells_of_a_lattice(adapter, kind, count):
    cube = clvoro.Box((0, 0, 0), (1, 1, 1))
    diagram = adapter.diagram(cube, lattice(kind, 5))
    # Cells two layers away from the walls are those of an infinite lattice.
    inner = (np.abs(diagram.points - 0.5) < 0.27).all(axis=1)
    assert inner.sum() >= 8
    assert (np.diff(diagram.neighbor_starts)[inner] == count).all()


def tessellation(engine, bins, cells, points, previous=None):
    n, x = len(points), engine.upload((points - np.array(BOX.lower)) / BOX.frame[1])
    return cells.tessellate(Part.alone(x, BOX), bins.build(BOX, x, n), previous)


def test_warm_start_gives_the_same_cells(adapter64):
    engine = Engine(adapter64.ctx, adapter64.queue, 3, np.dtype(float))
    bins, cells = Bins(engine), Polyhedra(engine)
    rng = np.random.default_rng(515)
    points = POINTS["random"]
    moved = np.clip(points + 0.02 * (rng.random(points.shape) - 0.5), 0, BOX.extent)
    before = tessellation(engine, bins, cells, points)
    warm = tessellation(engine, bins, cells, moved, before)
    starts, neighbors, volumes = warm.starts.get(), warm.neighbors.get(), warm.volumes.get()
    again = tessellation(engine, bins, cells, moved, tessellation(engine, bins, cells, points))
    assert (again.volumes.get() == volumes).all()
    assert (again.neighbors.get()[: starts[-1]] == neighbors[: starts[-1]]).all()
    cold = tessellation(engine, Bins(engine), Polyhedra(engine), moved)
    assert volumes == pytest.approx(cold.volumes.get(), rel=1e-12)
    assert (starts == cold.starts.get()).all()
    other = cold.neighbors.get()
    for a, b in itertools.pairwise(starts.tolist()):
        assert set(neighbors[a:b].tolist()) == set(other[a:b].tolist())


@pytest.mark.sparse(1)
@pytest.mark.parametrize("n", [100, 300])
def test_many_neighbors_enlarge_the_capacity(adapter64, n):
    """The cell in the middle of a sphere of generators has a face with each, and is the only one that needs room."""
    center = np.array([1.0, 0.75, 0.5])
    points = np.concatenate([center + 0.4 * directions(n, np.random.default_rng(31)), [center]])
    diagram = adapter64.diagram(BOX, points)
    assert np.diff(diagram.neighbor_starts)[-1] == n
    assert not faults(diagram)


@pytest.mark.slow
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_where_cells_are_clipped_changes_no_bit(ctx, real, monkeypatch):
    """In private memory, or in turns in few places of global memory, in launches of any size."""
    rng = np.random.default_rng(97)
    center = np.array([1.0, 0.75, 0.5])
    rings = [center + r * directions(50, rng) for r in (0.3, 0.305)]
    points = np.concatenate([center + 0.01 * directions(9, rng), *rings, POINTS["random"]])

    def arrays():
        diagram = clvoro.Adapter(ctx, real).diagram(BOX, points)
        return diagram.volumes, diagram.centroids, diagram.neighbors, diagram.face_centroids

    expected = arrays()
    assert np.diff(clvoro.Adapter(ctx, real).diagram(BOX, points).neighbor_starts).max() > 32
    monkeypatch.setattr(cut_cells, "LEAST_SPACE", 3 * cut_cells.cell_bytes(128, np.dtype(real)))
    few = arrays()

    def in_thirds(queue, kernel, items, group, limit):
        limit.items, limit.known = group * (1 + items // group // 3), True
        return ranges.enqueue_ranges(queue, kernel, items, group, limit)

    monkeypatch.setattr(engine.ranges, "may_be_interrupted", lambda _: True)
    monkeypatch.setattr(engine, "enqueue_ranges", in_thirds)
    divided = arrays()
    for module in (cut_cells, polyhedra):
        monkeypatch.setattr(module, "FACE_CAPACITY", 64)
    for one, *others in zip(expected, few, divided, arrays(), strict=True):
        assert all(np.array_equal(one, other) for other in others)


def test_degenerate_sets(adapter64):
    """Subsets of a lattice that covers the box and its walls, rotated or not; some points are off by one ulp."""
    rng = np.random.default_rng(4099)
    for _ in range(25):
        chosen = rng.permutation(7 * 5 * 4)[: rng.integers(1, 50)]
        places = np.stack(np.unravel_index(chosen, (7, 5, 4)), axis=-1)
        points = places / [6, 4, 3] * BOX.extent
        towards = points + rng.integers(-1, 2, points.shape)
        points = np.clip(np.nextafter(points, towards), BOX.lower, BOX.upper)
        assert not faults(adapter64.diagram(BOX, points))
        turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        turned = (places - [3, 2, 1.5]) / 14 @ turn + BOX.extent / 2
        assert not faults(adapter64.diagram(BOX, turned))
