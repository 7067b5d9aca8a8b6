"""Half-faces and corners of cells in 3D, one by one in NumPy."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.polyhedra import Polyhedra
from clvoro.tessellation.topology3d.consistency import FaceSharing
from tests.tessellation.test_polyhedra import BOX, POINTS, tessellation


class Seen:
    """The half-faces of the cells of some points, on the host."""

    def __init__(self, ctx, points):
        adapter = clvoro.Adapter(ctx)
        engine = Engine(adapter.ctx, adapter.queue, 3, adapter.dtype)
        t = tessellation(engine, Bins(engine), Polyhedra(engine), points)
        sharing = FaceSharing(engine, BOX, t)
        self.x, self.edges = t.points.get(), BOX.extent / BOX.frame[1]
        self.row_starts, self.neighbors = t.starts.get(), t.neighbors.get()
        for name, array in vars(sharing.half_faces).items():
            setattr(self, name, array.get())
        self.vertices = sharing.labels.get()
        self.at = self.corners + self.x[self.owners]
        self.faces = [frozenset(faces) for faces in self.corner_faces.tolist()]
        self.u = np.arange(len(self.owners))

    def normal(self, u, label):
        """Return the unit normal of a corner's face, out of the cell; infinite distance for a wall."""
        if label < 0:
            out = np.zeros(3)
            out[(-1 - label) // 2] = 1 if (-1 - label) % 2 else -1
            return out, np.inf
        d = self.x[label] - self.x[self.owners[u]]
        return d / np.linalg.norm(d), np.linalg.norm(d)


@pytest.fixture(scope="module", params=["random", "two", "fcc", "close-packed", "lattice on walls"])
def seen(ctx, request):
    return Seen(ctx, POINTS[request.param])


def off_walls(seed):
    """Some of a lattice that fills the box and its walls, each off by an ulp or not: they may just touch walls."""
    rng = np.random.default_rng(seed)
    places = np.array(list(np.ndindex(7, 5, 4)))[rng.permutation(140)[:45]]
    points = places / [6, 4, 3] * BOX.extent
    points = np.nextafter(points, points + rng.integers(-1, 2, points.shape))
    return np.clip(points, BOX.lower, BOX.upper)


@pytest.mark.sparse(1)
def test_corners_lie_on_their_faces(seen):
    for u in seen.u:
        normals, share, r = [], 1.0, np.linalg.norm(seen.corners[u])
        for label in seen.corner_faces[u].tolist():
            normal, d = seen.normal(u, label)
            normals.append(normal)
            if label < 0:
                wall = seen.edges[(-1 - label) // 2] if (-1 - label) % 2 else 0
                assert seen.at[u, (-1 - label) // 2] == pytest.approx(wall, abs=1e-14)
            else:
                share *= d / (d + r)
                away = np.linalg.norm(seen.at[u] - seen.x[label])
                assert away == pytest.approx(r, rel=1e-9)
        span = np.linalg.det(normals)
        assert span > 0  # counter-clockwise
        assert seen.sharpness[u] == pytest.approx(span * share, rel=1e-5)


@pytest.mark.sparse(2)
def test_corners_of_one_vertex(seen):
    by_faces = {(i, faces): u for u, (i, faces) in enumerate(zip(seen.owners, seen.faces, strict=True))}
    for u in seen.u:
        i, found = seen.owners[u], u
        for j in sorted(seen.faces[u]):
            other = by_faces.get((j, (seen.faces[u] | {i}) - {j}))
            if 0 <= j < i and other is not None:
                found = other
                break
        assert seen.twin_corners[u] == found
        # Corners of a lattice's cell are apart by its edges, or the same to rounding.
        own = np.flatnonzero(seen.owners == i)
        near = own[np.linalg.norm(seen.at[own] - seen.at[u], axis=1) < 1e-12]
        assert seen.same[u] == near[0]
    ends = np.concatenate([seen.same, seen.twin_corners])
    pairs = coo_matrix((np.ones(len(ends)), (np.tile(seen.u, 2), ends)), shape=(len(seen.u),) * 2)
    _, of = connected_components(pairs, directed=False)
    least = np.full(of.max() + 1, len(of))
    np.minimum.at(least, of, seen.u)
    assert np.array_equal(seen.vertices, least[of])


@pytest.mark.sparse(2)
def test_half_faces_are_rows_and_then_walls(seen):
    check_half_faces(seen)


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_walls_that_cells_just_touch(ctx, seed):
    """Half-faces that the graph lacks follow its faces."""
    seen = Seen(ctx, off_walls(seed))
    assert len(seen.labels) > seen.row_starts[-1]
    check_half_faces(seen)


def check_half_faces(seen):
    n = len(seen.x)
    for i in range(n):
        row = seen.neighbors[seen.row_starts[i] : seen.row_starts[i + 1]].tolist()
        own = np.flatnonzero(seen.owners == i)
        touched = set().union(*(seen.faces[u] for u in own))
        labels = seen.labels[seen.starts[i] : seen.starts[i + 1]].tolist()
        assert labels[: len(row)] == row
        assert len(set(labels)) == len(labels)
        assert set(labels[len(row) :]) == touched - set(row)
        for half_face in range(seen.starts[i], seen.starts[i + 1]):
            loop = seen.loops[seen.loop_starts[half_face] : seen.loop_starts[half_face + 1]]
            label = seen.labels[half_face]
            assert sorted(loop) == [u for u in own if label in seen.faces[u]]
            for u, v in zip(loop, np.roll(loop, -1), strict=True):
                faces = seen.corner_faces[u].tolist()
                # The edge that leaves a corner counter-clockwise is shared with the face before.
                assert faces[faces.index(label) - 1] in seen.faces[v]
    assert seen.loop_starts[-1] == 3 * len(seen.owners)
    assert np.array_equal(np.unique(seen.loops, return_counts=True)[1], np.full(len(seen.owners), 3))
