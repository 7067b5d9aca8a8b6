"""The 2D diagram: comparison with references, and invariants, over point sets and precisions."""

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.tessellation import report
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.cells import ROW_CAPACITY, SLOT, Cells
from clvoro.tessellation.part import Part
from clvoro.tessellation.readback.diagram import order_of, used_indices
from tests.reference import diagrams as reference

BOX = clvoro.Box((0.0, 0.0), (2.5, 1.5))
COLLAPSED = 4  # FLAG_COLLAPSED of tessellation/report.h


def lattice(nx, ny, box=BOX):
    lower, extent = np.array(box.lower), box.extent
    ij = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), axis=-1).reshape(-1, 2)
    return lower + (ij + 0.5) / [nx, ny] * extent


def point_sets():
    rng = np.random.default_rng(20261)
    square = rng.random((300, 2)) * BOX.extent
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([1.2 + 0.5 * np.cos(angle), 0.7 + 0.5 * np.sin(angle)], axis=1)
    walls = np.concatenate(
        [
            [[0, 0], [2.5, 0], [2.5, 1.5], [0, 1.5]],
            np.stack([rng.random(20) * 2.5, np.zeros(20)], axis=1),
            np.stack([np.full(20, 2.5), rng.random(20) * 1.5], axis=1),
            rng.random((40, 2)) * BOX.extent,
        ]
    )
    return {
        "one": np.array([[0.3, 1.1]]),
        "two": np.array([[0.3, 1.1], [2.0, 0.2]]),
        "three": np.array([[0.3, 1.1], [2.0, 0.2], [1.0, 0.9]]),
        "random": square,
        "lattice": lattice(12, 9),
        "sheared lattice": lattice(12, 9) + np.arange(108)[:, None] % 9 * [0.01, 0.0],
        "cocircular": circle,
        "cocircular with center": np.concatenate([circle, [[1.2, 0.7]]]),
        "collinear": np.stack([np.linspace(0.1, 2.4, 31), np.full(31, 0.4)], axis=1),
        "diagonal": np.linspace([0.1, 0.1], [2.4, 1.4], 37),
        "walls and corners": walls,
        "clusters": np.concatenate(
            [c + s * rng.random((40, 2)) for c, s in [((0.4, 0.4), 1e-2), ((1.8, 1.0), 1e-4)]]
            + [rng.random((20, 2)) * BOX.extent]
        ),
        "graded": rng.random((600, 2)) ** 3 * BOX.extent,
    }


POINTS = point_sets()


@pytest.fixture(params=list(POINTS))
def points(request):
    return POINTS[request.param]


@pytest.mark.sparse(10)
def test_invariants(adapter, points):
    assert not reference.faults(adapter.diagram(BOX, points))


@pytest.mark.sparse(6)
def test_against_exact_arithmetic(adapter64, points):
    points = points[:: max(1, len(points) // 40)]
    diagram = adapter64.diagram(BOX, points)
    for i, cell in enumerate(reference.exact_cells(BOX.lower, BOX.upper, points)):
        assert diagram.volumes[i] == pytest.approx(cell.area, rel=1e-9, abs=1e-12 * BOX.measure)
        assert np.abs(diagram.centroids[i] - cell.centroid).max() < 1e-9 * np.sqrt(cell.area)
        row = slice(*diagram.neighbor_starts[i : i + 2])
        exact = dict(zip(cell.neighbors, face_lengths(cell.polygon), strict=True))
        seen = dict(zip(diagram.neighbors[row].tolist(), diagram.face_measures[row], strict=True))
        # Faces of zero length (cocircular generators) may exist on one side only.
        for j in set(exact) | set(seen):
            assert seen.get(j, 0) == pytest.approx(exact.get(j, 0), rel=1e-9, abs=1e-13)


def face_lengths(polygon):
    return np.hypot(*(np.roll(polygon, -1, axis=0) - polygon).T)


def test_against_qhull(adapter64):
    rng = np.random.default_rng(773)
    points = rng.random((1500, 2)) * BOX.extent
    diagram = adapter64.diagram(BOX, points)
    cells = reference.box_voronoi(BOX.lower, BOX.upper, points)
    area = np.array([c.area for c in cells])
    # The error of Qhull's vertices is about 1e-13 of the box.
    assert np.abs(diagram.volumes - area).max() < 1e-12 * BOX.measure
    assert np.abs(diagram.volumes / area - 1).max() < 1e-9
    centroids = np.array([c.centroid for c in cells])
    assert np.abs(diagram.centroids - centroids).max() < 1e-10
    for i, cell in enumerate(cells):
        row = diagram.neighbors[slice(*diagram.neighbor_starts[i : i + 2])].tolist()
        start = row.index(cell.neighbors[0])
        assert row[start:] + row[:start] == cell.neighbors


def test_lattice_has_square_cells_of_four_faces(adapter):
    diagram = adapter.diagram(clvoro.Box((0, 0), (7, 5)), lattice(7, 5, clvoro.Box((0, 0), (7, 5))))
    assert (np.diff(diagram.neighbor_starts) == 4).all()
    assert len(diagram.vertices) == 8 * 6
    assert np.abs(diagram.volumes - 1).max() < 64 * float(np.finfo(adapter.dtype).eps)


@pytest.mark.parametrize("scale", [1e-49, 1e-30, 1e-3, 1e6, 1e30, 1e49])
def test_any_scale_and_place(adapter64, scale):
    rng = np.random.default_rng(5150)
    unit = rng.random((200, 2)) * [2.5, 1.5]
    plain = adapter64.diagram(BOX, unit)
    box = clvoro.Box((-scale, 3 * scale), (1.5 * scale, 4.5 * scale))
    diagram = adapter64.diagram(box, np.clip(unit * scale + box.lower, box.lower, box.upper))
    assert diagram.volumes.sum() == pytest.approx(box.measure, rel=1e-14)
    # A shift rounds positions to eps, and so areas to eps over the size of a cell.
    assert diagram.volumes / scale**2 == pytest.approx(plain.volumes, rel=1e-11)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-9, 1e-12, 1e-14, 2e-16])
def test_near_duplicates(adapter64, gap):
    """Gaps are valid as long as bisectors with far generators differ; smaller gaps are rejected."""
    cluster = np.array([0.7, 0.6]) + gap * np.array([[0, 0], [1, 0], [0, 1]])
    points = np.concatenate([cluster, POINTS["random"]])
    refused = None
    try:
        diagram, few = (adapter64.diagram(BOX, some) for some in (points, points[:60]))
    except clvoro.ClvoroError as error:
        refused = str(error)
    if refused is not None:
        assert gap < 1e-12
        assert "too close" in refused
    else:
        assert not reference.faults(diagram)
        for i, cell in enumerate(reference.exact_cells(BOX.lower, BOX.upper, points[:60])[:3]):
            assert few.volumes[i] == pytest.approx(cell.area, abs=1e-12 * BOX.measure / gap * 1e-3)


def test_result_does_not_depend_on_the_order_of_points(adapter64):
    points = POINTS["graded"]
    order = np.random.default_rng(99).permutation(len(points))
    a, b = adapter64.diagram(BOX, points), adapter64.diagram(BOX, points[order])
    assert b.volumes == pytest.approx(a.volumes[order], rel=1e-12)


def test_many_cocircular_neighbors_enlarge_the_capacity(adapter64):
    angle = np.linspace(0, 2 * np.pi, 150, endpoint=False)
    ring = np.stack([1.25 + 0.6 * np.cos(angle), 0.75 + 0.6 * np.sin(angle)], axis=1)
    points = np.concatenate([ring, [[1.25, 0.75]]])
    diagram = adapter64.diagram(BOX, points)
    assert np.diff(diagram.neighbor_starts)[-1] == 150
    assert not reference.faults(diagram)


@pytest.mark.parametrize("name", ["random", "graded"])
def test_faces_of_the_loop_are_those_of_the_result_in_single_precision(adapter64, name):
    """Faces of the final diagram are measured in full precision; rounded, they have the same bits."""
    engine = Engine(adapter64.ctx, adapter64.queue, 2, np.dtype(float))
    points = engine.upload(POINTS[name] / BOX.frame[1])
    n, cells = len(points), Cells(engine)
    t = cells.tessellate(Part.alone(points, BOX), Bins(engine).build(BOX, points, n))
    exact, m = cells.measure_faces(BOX, t), int(t.starts.get()[-1])
    for array in ("face_measures", "face_centroids"):
        at_work, full = (getattr(d, array).get()[:m] for d in (t, exact))
        assert at_work.dtype == np.float32
        assert full.dtype == np.float64
        assert np.array_equal(at_work, full.astype(np.float32))
        assert (at_work != full).mean() > 0.9
    assert np.array_equal(exact.neighbors.get(), t.neighbors.get())


def test_later_meshes_do_not_keep_an_enlarged_capacity(adapter64):
    """A mesh with a cell of very many faces does not make later, larger meshes reserve as much."""
    engine = Engine(adapter64.ctx, adapter64.queue, 2, np.dtype(float))
    bins, cells = Bins(engine), Cells(engine)

    def tessellate(points):
        n, x = len(points), engine.upload(points / BOX.frame[1])
        return cells.tessellate(Part.alone(x, BOX), bins.build(BOX, x, n))

    angle = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    ring = np.stack([1.25 + 0.6 * np.cos(angle), 0.75 + 0.6 * np.sin(angle)], axis=1)
    tessellate(np.concatenate([ring, [[1.25, 0.75]]]))
    assert cells.row_capacity >= 100
    tessellate(POINTS["graded"])
    assert cells.row_capacity == ROW_CAPACITY
    with pytest.raises(clvoro.ClvoroError, match="32-bit"):
        cells.take_rows(2**31 // SLOT + 1, BOX, None, exact=True)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 12), st.integers(0, 8), st.integers(-1, 1), st.integers(-1, 1)),
        min_size=1,
        max_size=40,
        unique_by=lambda p: p[:2],
    )
)
def test_degenerate_sets(adapter64, places):
    """Subsets of a lattice that covers the box and its walls; some points are off by one ulp."""
    a = np.array(places, float)
    points = a[:, :2] / [12, 8] * BOX.extent
    points = np.where(a[:, 2:] == 0, points, np.nextafter(points, points + a[:, 2:]))
    points = np.clip(points, BOX.lower, BOX.upper)
    assert not reference.faults(adapter64.diagram(BOX, points))


@pytest.mark.parametrize("seed", [1, 4])
def test_a_repeated_search_widens(ctx, seed):
    """Cells of generators that coincide in single precision shrink to a point, while others need more capacity."""
    rng = np.random.default_rng(seed)
    around = rng.uniform(0, 1, (40, 2))
    cluster = 0.3 + rng.normal(size=(300, 2)) * 10.0 ** -rng.uniform(6, 8)
    with pytest.raises(clvoro.ClvoroError, match=r"coincide|too close"):
        clvoro.Adapter(ctx, "float32").diagram(clvoro.Box((0, 0), (1, 1)), np.concatenate([around, cluster]))


@pytest.mark.parametrize("doubtful", [False, True])
def test_cells_with_two_faces_are_rejected(ctx, doubtful):
    """Round-off makes such rows if generators are too close for the precision."""
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype("float64"))
    cells, points = Cells(engine), engine.upload([[0.2, 0.2], [0.5, 0.3], [0.4, 0.6]])
    for two in (True, False):
        lists = [[1, 2] if two else [1, 2, -1], [0, -3, 2], [0, 1, -4]]
        rows, n = cells.take_rows(3, BOX, points, exact=True), len(lists)
        slots = np.zeros((n, SLOT), np.int32)
        for i, labels in enumerate(lists):
            slots[i, : len(labels)] = labels
        rows.slots.set(slots.ravel())
        rows.places.set(np.arange(n, dtype=np.int32))
        # A doubtful cell has all rows compared, and all agree.
        sign = -1 if doubtful else 1
        rows.counts.set(np.array([sign * len(labels) for labels in lists], np.int32))
        rows.report.set(np.array([report.DOUBT * doubtful] + [0] * (report.SIZE - 1), np.int32))
        flags, m = cells._match(rows)
        assert m == 9 - two
        assert flags == (COLLAPSED if two else 0) | (report.DOUBT if doubtful else 0)


@pytest.mark.parametrize("labels", [[], [0], [3], [2, 0, 1], [7, 1, 4], [10**9, 5, 0], [0, 4, 2, 9]])
def test_order_of_labels(labels):
    given = np.array(labels, np.int32)
    assert np.array_equal(order_of(given), np.argsort(given))


@pytest.mark.parametrize("indices", [[], [2], [4, 0, 4, 1], [[3, 3], [0, 1]]])
def test_used_indices(indices):
    given = np.array(indices, int)
    used, places = used_indices(given, 5)
    assert np.array_equal(used, np.unique(given))
    assert np.array_equal(used[places], given)
    assert places.shape == given.shape
