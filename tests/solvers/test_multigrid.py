"""The multigrid preconditioner against dense NumPy, and the iterations that it takes."""

import functools

import numpy as np
import pyopencl as cl
import pytest
import scipy.sparse as sp
from scipy.spatial import Delaunay

from clvoro import create_context
from clvoro.opencl.engine import Engine
from clvoro.solvers import multigrid as multigrids
from clvoro.solvers.aggregation import Aggregation, Graph
from clvoro.solvers.multigrid import Multigrid
from clvoro.solvers.poisson import Laplacian, Poisson
from tests.reference import graphs, patch


@pytest.fixture(scope="module")
def make():
    """Engines of the default device, by dimension and precision."""
    ctx = create_context()
    queue = cl.CommandQueue(ctx)
    return lambda dim=2, real=np.float64: Engine(ctx, queue, dim, np.dtype(real))


def weights_of(graph, density=None):
    """Weight matrix W of a Voronoi graph: A = diag(W 1) - W."""
    A = graphs.laplacian_matrix(*graph[:4], density)
    W = sp.csr_matrix(sp.diags(A.diagonal()) - A)
    W.setdiag(0)
    W.eliminate_zeros()
    return W


def upload(engine, W):
    W = sp.csr_matrix(W)
    W.sort_indices()
    return (engine.upload(W.indptr, np.int32), engine.upload(W.indices, np.int32), engine.upload(W.data))


def matrix_of(graph):
    n = len(graph)
    return sp.csr_matrix((graph.weights.get(), graph.columns.get(), graph.starts.get()), (n, n))


@functools.cache
def random_weights(n, seed=404):
    return weights_of(graphs.random_graph(n, seed=seed))


def chain(n):
    return sp.diags([np.ones(n - 1), np.ones(n - 1)], [-1, 1]).tocsr()


def star(n):
    W = sp.lil_matrix((n, n))
    W[0, 1:] = W[1:, 0] = 1 + np.arange(n - 1) / n
    return W.tocsr()


def lattice(m):
    """m x m squares: all weights equal, so that everything is a tie."""
    return (sp.kron(chain(m), sp.eye(m)) + sp.kron(sp.eye(m), chain(m))).tocsr()


GRAPHS = {
    "random": lambda: random_weights(1500),
    "random 3D": lambda: weights_of(graphs.random_graph(500, 3, seed=405)),
    "lattice": lambda: lattice(30),
    "chain": lambda: chain(200),
    "star": lambda: star(150),
}


@pytest.mark.sparse(2)
@pytest.mark.parametrize("name", GRAPHS)
def test_aggregates_and_coarse_graph(make, name):
    """Against P^T W P of SciPy, P the groups' indicator."""
    engine, W = make(3 if "3D" in name else 2, np.float32), GRAPHS[name]()
    n = W.shape[0]
    aggregation = Aggregation(engine)
    fine = Graph(*upload(engine, W))
    _, groups, coarse = aggregation.coarsen(fine, 0)
    group, count = groups.aggregate.get(), len(groups)
    starts, members = groups.starts.get(), groups.members.get()
    assert sorted(members) == list(range(n))
    assert np.array_equal(group[members], np.repeat(np.arange(count), np.diff(starts)))
    # Each of two passes leaves at most half of the cells, except for a star, where all wait for the hub.
    assert count <= 0.3 * n
    P = sp.csr_matrix((np.ones(n), (np.arange(n), group)), (n, count))
    expected = sp.csr_matrix(P.T @ W @ P).toarray() * (count / n) ** (1 / engine.dim)
    np.fill_diagonal(expected, 0)
    got = matrix_of(coarse).toarray()
    # Sums of a few dozen positive terms in float32.
    assert np.allclose(got, expected, rtol=1e-5, atol=0)
    assert np.all(np.diff(coarse.starts.get()) == (got > 0).sum(axis=1))
    # Groups hang together.
    W = sp.coo_matrix(W)
    same = group[W.row] == group[W.col]
    inside = sp.csr_matrix((W.data[same], (W.row[same], W.col[same])), W.shape)
    assert sp.csgraph.connected_components(inside)[0] == count


def test_pair_inverse(make):
    engine, W = make(2, np.float32), random_weights(400)
    n = W.shape[0]
    # Weights within a group, which rows of coarse graphs contain, are ignored.
    within = sp.diags(np.random.default_rng(17).uniform(0.5, 2, n) * W.max())
    blocks = Aggregation(engine).match_pairs(Graph(*upload(engine, sp.csr_matrix(W + within))), 0)
    partner, own, both = (a.get() for a in (blocks.partner, blocks.own, blocks.both))
    D = W.toarray().sum(axis=1)
    first = (W.toarray() * (1 / D[:, None] + 1 / D)).argmax(axis=1)
    mutual = first[first] == np.arange(n)
    assert np.array_equal(partner, np.where(mutual, first, np.arange(n)))
    assert 0.3 < mutual.mean() < 0.9
    A = np.diag(W.toarray().sum(axis=1)) - W.toarray()
    B = np.diag(A.diagonal())
    B[np.arange(n)[mutual], first[mutual]] = A[np.arange(n)[mutual], first[mutual]]
    got = np.zeros((n, n))
    got[np.arange(n), partner] = both
    got[np.arange(n), np.arange(n)] = own + both
    expected = np.linalg.inv(B)
    assert np.abs(got - expected).max() <= 1e-4 * np.abs(expected).max()
    spectrum = np.linalg.eigvals(expected @ A).real
    assert spectrum.max() <= 2 + 1e-12


def dense_graph(graph):
    """A of a level in float64."""
    W = matrix_of(graph).toarray().astype(float)
    np.fill_diagonal(W, 0)
    return np.diag(W.sum(axis=1)) - W


def reference_cycle(multigrid, depth, b):
    """One cycle in dense float64 from the device's levels; b (n,) or (n, columns)."""
    level = multigrid._levels[depth]
    A = dense_graph(level.graph)
    n, sparse = len(A), sp.csr_matrix(A)
    partner, own, both = (a.get() for a in (level.pairs.partner, level.pairs.own, level.pairs.both))
    if level.aggregates is None:
        # The mean is taken away from both sides; in between the last value is zero.
        x = np.zeros(b.shape)
        b = b - b.mean(axis=0)
        x[:-1] = np.linalg.solve(A[:-1, :-1], b[:-1]) if n > 1 else 0
        return x - x.mean(axis=0)
    cells = np.arange(n)
    S = sp.csr_matrix((both.astype(float), (cells, partner)), (n, n)) + sp.diags(
        own + np.where(partner == cells, 0, both.astype(float))
    )
    P = sp.csr_matrix((np.ones(n), (cells, level.aggregates.aggregate.get())), (n, len(level.aggregates)))
    low, high = 0.35, 2.0
    roots = (low + high) / 2 + (high - low) / 2 * np.cos(np.pi * np.array([1, 3]) / 4)
    x = np.zeros(b.shape)
    for root in roots:
        x = x + S @ (b - sparse @ x) / root
    x = x + P @ reference_cycle(multigrid, depth + 1, P.T @ (b - sparse @ x))
    for root in roots[::-1]:
        x = x + S @ (b - sparse @ x) / root
    return x


@pytest.mark.parametrize("n", [30, 900])
def test_cycle_in_place(make, n):
    """Work in place on float32 vectors gives the same bits for any previous content, and keeps r."""
    engine = make(real=np.float32)
    multigrid = Multigrid(engine)
    multigrid.set_up(*upload(engine, random_weights(n)))
    right = np.random.default_rng(8).standard_normal(n).astype(np.float32)
    r, u = engine.upload(right), engine.zeros(n)
    multigrid.apply(r, u)
    for rest in (0.0, np.nan):
        v, spare = engine.upload(np.full(n, rest)), engine.upload(np.full(n, rest))
        multigrid.apply(r, v, spare)
        assert np.array_equal(u.get(), v.get())
    assert np.array_equal(r.get(), right)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("group_size", [None, 16], ids=["cpu", "gpu"])
@pytest.mark.parametrize("name", ["random", "random 3D", "star"])
def test_merged_steps_and_levels_give_the_same_bits(make, monkeypatch, name, group_size):
    """Against launches of their own for each step of each level, whose cells then fill several work-groups."""
    W, found, plain = GRAPHS[name](), [], cl.enqueue_nd_range_kernel
    right = np.random.default_rng(6).standard_normal(W.shape[0])
    engine = patch.make_engine(make().ctx, group_size=group_size)
    for most, merged in ((0, False), (0, True), (10**6, False), (300, True)):
        monkeypatch.setattr(multigrids, "one_group_limit", lambda _, most=most: most)
        multigrid = Multigrid(engine)
        multigrid._cycle.merged = merged
        multigrid.set_up(*upload(engine, W))
        assert len(multigrid.sizes) > 2 or name == "star"
        r, u = engine.upload(right), engine.empty(len(right))
        launched = []
        with monkeypatch.context() as patched:
            patched.setattr(
                cl,
                "enqueue_nd_range_kernel",
                lambda *args, into=launched: into.append(args[1].function_name) or plain(*args),
            )
            multigrid.apply(r, u)
        levels = launched.count("smooth_pairs_from_zero" if merged else "smooth_from_zero")
        assert levels == (1 if most == 10**6 else len(multigrid.sizes) - 1) or most == 300
        assert launched.count("cycle_by_group") == 1
        found.append(u.get())
    assert all(np.array_equal(u, found[0]) for u in found)


def test_walls_are_ignored(make):
    """Negative columns of weight 0, as diagrams have them, anywhere in the rows, in the graph and in the cycle."""
    engine, W = make(real=np.float32), random_weights(300)
    starts, columns, weights = W.indptr, W.indices, W.data
    rows, rng = np.repeat(np.arange(300), np.diff(starts)), np.random.default_rng(9)
    walls = rng.integers(0, 300, 90)
    rows, columns = np.concatenate([rows, walls]), np.concatenate([columns, np.full(90, -3)])
    order = np.lexsort((np.concatenate([np.arange(W.nnz), rng.integers(0, W.nnz, 90)]), rows))
    with_walls = Graph(
        engine.upload(np.searchsorted(rows[order], np.arange(301)), np.int32),
        engine.upload(columns[order], np.int32),
        engine.upload(np.concatenate([weights, np.zeros(90)])[order]),
    )
    plain = Graph(*upload(engine, W))
    pairs, groups, coarse = Aggregation(engine).coarsen(plain, 0)
    others = Aggregation(engine).coarsen(with_walls, 0)
    for a, b in zip((pairs, groups, coarse), others, strict=True):
        for name, array in vars(a).items():
            assert name == "ghosts" or np.array_equal(array.get(), getattr(b, name).get())
    r, results = engine.upload(rng.standard_normal(300)), []
    for graph in (plain, with_walls):
        multigrid, u = Multigrid(engine), engine.zeros(300)
        multigrid.set_up(graph.starts, graph.columns, graph.weights)
        multigrid.apply(r, u)
        results.append(u.get())
    # Eight entries of a row are added up at a time: walls between them change which.
    assert np.abs(results[0] - results[1]).max() <= 1e-5 * np.abs(results[0]).max()


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", [np.float64, np.float32])
@pytest.mark.parametrize("n", [30, 900, 3000])
def test_cycle(make, real, n):
    engine = make(real=real)
    multigrid = Multigrid(engine)
    multigrid.set_up(*upload(engine, random_weights(n)))
    assert len(multigrid.sizes) == {30: 1, 900: 3, 3000: 4}[n]
    assert multigrid.sizes[-1] <= 64
    r = np.random.default_rng(8).standard_normal(n)
    r -= r.mean()
    u = engine.zeros(n)
    multigrid.apply(engine.upload(r), u)
    expected = reference_cycle(multigrid, 0, r)
    difference = u.get() - expected
    # float32 inside; the coarsest matrix has a condition number of a few hundred.
    assert np.abs(difference).max() <= 2e-4 * np.abs(expected).max()


def test_coarse_graphs_are_symmetric_to_the_last_bit(make):
    engine, W = make(2, np.float32), weighted_weights("decades", 3000)
    coarse = Aggregation(engine).coarsen(Graph(*upload(engine, W)), 0)[2]
    assert (matrix_of(coarse) != matrix_of(coarse).T).nnz == 0


def density_of(name, points):
    """h^-2 of the size fields that adapted meshes are weighted with, and worse."""
    x, y = points.T
    if name == "decades":  # eight, evenly
        return 1e8 ** (x * (0.7 + 0.3 * y))
    if name == "jump":  # h jumps by 100 across a line
        return np.where(x + 0.2 * y < 0.55, 1e4, 1.0)
    if name == "random":  # eight decades from cell to cell
        return 1e8 ** np.random.default_rng(871).random(len(x))
    if name == "islands":  # five thousand times as heavy, in the light
        return np.where((np.floor(11 * x) + np.floor(11 * y)) % 2 == 0, 5e3, 1.0)
    return np.ones(len(x))


@functools.cache
def weighted_weights(name, n, mesh="random"):
    rng = np.random.default_rng(872)
    points = rng.random((n, 2))
    if mesh == "refined":
        points = refine(0.05 + 0.9 * rng.random((n // 8, 2)) ** 1.5, n, rng)
    points = points[graphs.morton_order(points)]
    return weights_of((points, *graphs.voronoi_graph(points)), density_of(name, points))


def refine(points, n, rng):
    """Add points near midpoints of Delaunay edges, as refinement does: cells beside others twice as large."""
    while len(points) < n:
        triangles = Delaunay(points).simplices
        edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0)
        # Not quite the midpoints: Qhull may see one on an edge that it already lies on.
        share = rng.uniform(0.45, 0.55, (len(edges), 1))
        middle = share * points[edges[:, 0]] + (1 - share) * points[edges[:, 1]]
        # One side of the mesh only.
        middle = middle[middle[:, 0] < 0.4 + 0.2 * middle[:, 1]]
        points = np.concatenate([points, middle[: n - len(points)]])
    return points


WEIGHTS = ["even", "decades", "jump", "random", "islands"]


@pytest.mark.sparse(1)
@pytest.mark.parametrize("mesh", ["random", "refined"])
@pytest.mark.parametrize("name", WEIGHTS)
def test_preconditioner_is_symmetric_positive_definite(make, name, mesh):
    engine, n = make(), 1900
    multigrid = Multigrid(engine)
    multigrid.set_up(*upload(engine, weighted_weights(name, n, mesh)))
    assert len(multigrid.sizes) >= 4
    # On the device: (a, M^-1 b) = (b, M^-1 a), and (b, M^-1 b) > 0, for rough, smooth and few.
    u, rng = engine.zeros(n), np.random.default_rng(873)
    A = dense_graph(multigrid._levels[0].graph)
    sides = rng.standard_normal((24, n))
    sides[::3] = sides[::3] @ A
    sides[1::3] *= rng.random((8, n)) < 5 / n
    sides -= sides.mean(axis=1, keepdims=True)
    images = []
    for r in sides:
        multigrid.apply(engine.upload(r), u)
        images.append(u.get())
    M = sides @ np.array(images).T
    assert np.all(np.diag(M) > 0)
    size = np.sqrt(np.diag(M))
    assert np.abs(M - M.T).max() <= 1e-3 * np.outer(size, size).max()
    # The cycle in exact arithmetic: no less than a fraction of Jacobi's.
    M = reference_cycle(multigrid, 0, np.eye(n))
    assert np.abs(M - M.T).max() <= 1e-5 * np.abs(M).max()
    D = np.sqrt(A.diagonal())
    np.linalg.cholesky(D[:, None] * (0.5 * (M + M.T)) * D - 0.1 * np.eye(n))


@pytest.mark.parametrize("decades", [8, 16])
def test_coarsest_level_of_any_weights(make, decades):
    """Against elimination in float64, on a graph in two parts with unequal weights."""
    engine, rng = make(), np.random.default_rng(874)
    W = sp.block_diag([weights_of(graphs.random_graph(k, seed=875)) for k in (37, 26)]).tocoo()
    scale = 10.0 ** (0.5 * decades * rng.random(63))
    W = sp.csr_matrix((W.data * scale[W.row] * scale[W.col], (W.row, W.col)), W.shape)
    multigrid = Multigrid(engine)
    multigrid.set_up(*upload(engine, W))
    assert multigrid.sizes == [63]
    u = engine.zeros(63)
    heaviest = np.unravel_index(W.toarray().argmax(), W.shape)
    for i, j in [(0, 36), (37, 62), (5, 20), heaviest]:
        r = np.zeros(63)
        r[i], r[j] = 1, -1
        multigrid.apply(engine.upload(r), u)
        energy = r @ u.get()
        assert energy > 0
        w = dense_graph(multigrid._levels[0].graph)
        w = np.diag(w.diagonal()) - w
        expected = 0.0
        for p in range(62):
            d = w[p, p + 1 :].sum()
            if d > 0:
                expected += r[p] ** 2 / d
                r[p + 1 :] += w[p, p + 1 :] * r[p] / d
                w[p + 1 :, p + 1 :] += np.outer(w[p, p + 1 :], w[p, p + 1 :]) / d
        # Two neighbors with so large a weight that their difference is below the round-off of float32.
        if (i, j) != heaviest or decades == 8:
            assert energy == pytest.approx(expected, rel=1e-3)


def solve(engine, W, seed=17, tolerance=1e-8):
    n = W.shape[0]
    graph = Graph(*upload(engine, W))
    poisson = Poisson(engine)
    D = np.asarray(W.sum(axis=1)).ravel()
    laplacian = Laplacian(graph.starts, graph.columns, graph.weights)
    b = np.random.default_rng(seed).standard_normal(n)
    if engine.real == np.float32:
        # For a rough solution. With weights over many decades, the differences of a smooth one between heavy cells
        # are below round-off.
        b = (sp.diags(D) - W) @ b
    phi = engine.zeros(n)
    solution = poisson.solve(laplacian, engine.upload(b), phi, preconditioner="multigrid", tolerance=tolerance)
    A = sp.diags(D) - W
    b = b - b.mean()
    true = np.linalg.norm(b - A @ phi.get().astype(float)) / np.linalg.norm(b)
    return solution, true


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", [np.float64, np.float32])
@pytest.mark.parametrize("mesh", ["random", "refined"])
@pytest.mark.parametrize(
    ("name", "most"), [("even", 18), ("decades", 22), ("jump", 22), ("random", 90), ("islands", 70)]
)
def test_iterations_with_strongly_varying_weights(make, name, most, mesh, real):
    engine = make(real=real)
    tolerance = 1e-8 if real is np.float64 else 1e-4
    solution, true = solve(engine, weighted_weights(name, 6000, mesh), tolerance=tolerance)
    assert solution.converged
    assert solution.reason == "converged"
    assert solution.iterations <= most
    # In float32 the operator itself is rounded.
    assert true <= (1.01e-8 if real is np.float64 else 1e-3)


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", [np.float64, np.float32])
@pytest.mark.parametrize("scale", [1e-25, 1e20])
def test_weights_of_any_unit(make, real, scale):
    """Weights in float64 outside the range of the cycle's float32."""
    scale = scale if real is np.float32 else scale**4
    W = weighted_weights("jump", 3000)
    solution, _ = solve(make(real=real), W * scale, tolerance=1e-4)
    assert solution.reason == "converged"
    assert solution.iterations == solve(make(real=real), W, tolerance=1e-4)[0].iterations


@pytest.mark.sparse(1)
@pytest.mark.parametrize(("name", "most"), [("lattice", 20), ("random 3D", 20), ("chain", 40), ("star", 20)])
def test_iterations_of_other_graphs(make, name, most):
    solution, true = solve(make(3 if "3D" in name else 2), GRAPHS[name]())
    assert solution.converged
    assert solution.iterations <= most
    assert true <= 1.01e-8


@pytest.mark.parametrize("n", [2, 3, 64, 65, 66])
def test_few_cells(make, n):
    solution, _ = solve(make(), random_weights(n, seed=74))
    assert solution.converged
    assert solution.iterations <= 12


@pytest.mark.sparse(1)
@pytest.mark.parametrize("fault", ["indefinite", "negative", "not finite", "useless"])
def test_jacobi_continues_after_a_failure(make, monkeypatch, fault):
    """A failed preconditioner costs its iterations, and raises no exception."""
    apply, calls = Multigrid.apply, [0]

    def faulty(self, r, u, spare):
        apply(self, r, u, spare)
        calls[0] += 1
        if fault == "indefinite" and calls[0] > 3:
            u[: len(u) // 2] = -3 * u[: len(u) // 2]
            u *= -1.0 if calls[0] % 2 else 1.0
        elif fault == "negative":
            u *= -1.0
        elif fault == "not finite" and calls[0] > 2:
            u[17] = np.nan
        elif fault == "useless":
            u[:] = r * 10.0 ** (np.arange(len(u)) % 9)

    monkeypatch.setattr(Multigrid, "apply", faulty)
    solution, true = solve(make(), random_weights(2500, seed=79))
    assert solution.converged
    assert solution.reason.startswith("converged (Jacobi after ")
    assert len(solution.residuals) == solution.iterations + 1
    assert solution.residuals[-1] <= 1e-8
    assert true <= 1.01e-8
    monkeypatch.undo()


@pytest.mark.parametrize("rest", [sp.csr_matrix((0, 0)), sp.csr_matrix((100, 100)), random_weights(150)])
def test_disconnected_graphs_are_solved_part_by_part(make, rest):
    """A mesh, and beside it nothing, cells without neighbors, or a mesh in which the sources do not cancel, either."""
    W = sp.block_diag([random_weights(200), rest]).tocsr()
    engine = make()
    b = np.random.default_rng(17).standard_normal(W.shape[0])
    phi = engine.zeros(len(b))
    laplacian = Laplacian(*upload(engine, W))
    solution = Poisson(engine).solve(laplacian, engine.upload(b), phi, preconditioner="multigrid", tolerance=1e-8)
    assert solution.converged
    part = sp.csgraph.connected_components(W)[1]
    b -= (np.bincount(part, b) / np.bincount(part))[part]
    A = sp.diags(np.asarray(W.sum(axis=1)).ravel()) - W
    assert np.linalg.norm(b - A @ phi.get()) <= 1.01e-8 * np.linalg.norm(b)


@pytest.mark.parametrize("rest", [np.nan, 1e300])
def test_entries_behind_the_last_row_are_ignored(make, rest):
    engine = make()
    n = 500
    starts, columns, weights = upload(engine, random_weights(n, seed=76))
    r = engine.upload(np.random.default_rng(80).standard_normal(n))
    u, v = engine.zeros(n), engine.zeros(n)
    multigrid = Multigrid(engine)
    multigrid.set_up(starts, columns, weights)
    multigrid.apply(r, u)
    columns = engine.upload(np.concatenate([columns.get(), np.full(77, 3)]), np.int32)
    weights = engine.upload(np.concatenate([weights.get(), np.full(77, rest)]))
    multigrid.set_up(starts, columns, weights)
    multigrid.apply(r, v)
    assert np.array_equal(u.get(), v.get())


def test_set_up_again_for_another_graph(make):
    """Memory of a larger graph is used again for a smaller one."""
    engine = make()
    multigrid = Multigrid(engine)
    small, large = random_weights(500, seed=76), random_weights(2500, seed=77)
    r = np.random.default_rng(78).standard_normal(500)
    results = []
    for first in (None, large):
        if first is not None:
            multigrid.set_up(*upload(engine, first))
        multigrid.set_up(*upload(engine, small))
        u = engine.zeros(500)
        multigrid.apply(engine.upload(r), u)
        results.append(u.get())
    assert np.array_equal(*results)


def neighboring_weights(n, amount, seed=404):
    """Weights of the same random cells before and after each has moved by `amount` of their spacing."""
    points = graphs.random_graph(n, seed=seed)[0]
    noise = np.random.default_rng(seed + 1).normal(0, amount / np.sqrt(n), (n, 2))
    moved = np.clip(points + noise, 1e-3, 1 - 1e-3)
    after = (moved, *graphs.voronoi_graph(moved))
    return weights_of((points, *graphs.voronoi_graph(points))), weights_of(after)


def test_updated_cycle(make):
    """The finest level is the new graph's, in the old pairs; groups and coarse graphs are the old ones."""
    engine, n = make(), 900
    before, after = neighboring_weights(n, 0.3)
    assert (before != after).nnz > 0.5 * before.nnz
    multigrid = Multigrid(engine)
    multigrid.set_up(*upload(engine, before))
    coarse = dense_graph(multigrid._levels[1].graph)
    partner = multigrid._levels[0].pairs.partner.get()
    multigrid.update_finest(*upload(engine, after))
    assert np.array_equal(multigrid._levels[0].pairs.partner.get(), partner)
    assert np.array_equal(dense_graph(multigrid._levels[1].graph), coarse)
    A = sp.diags(np.asarray(after.sum(axis=1)).ravel()) - after
    fine = dense_graph(multigrid._levels[0].graph)
    # Weights in single precision, times a power of two.
    scale = fine.max() / A.max()
    assert np.log2(scale) == pytest.approx(round(np.log2(scale)), abs=1e-5)
    assert np.abs(fine - scale * A.toarray()).max() <= 1e-6 * fine.max()
    r = np.random.default_rng(9).standard_normal(n)
    r -= r.mean()
    u = engine.zeros(n)
    multigrid.apply(engine.upload(r), u)
    expected = reference_cycle(multigrid, 0, r)
    assert np.abs(u.get() - expected).max() <= 2e-4 * np.abs(expected).max()


@pytest.mark.parametrize("amount", [0.05, 0.5, 3.0])
def test_updated_cycle_is_positive_definite(make, amount):
    """Even if the coarse levels do not fit the new graph."""
    engine, n = make(), 400
    before, after = neighboring_weights(n, amount)
    multigrid = Multigrid(engine)
    multigrid.set_up(*upload(engine, before))
    multigrid.update_finest(*upload(engine, after))
    M = reference_cycle(multigrid, 0, np.eye(n))
    assert np.abs(M - M.T).max() <= 1e-6 * np.abs(M).max()
    assert np.linalg.eigvalsh((M + M.T) / 2).min() > 0


def test_coarse_levels_are_reused_while_they_converge(make):
    """Small motions cost a few iterations. After large ones the next solve builds a new multigrid."""
    engine, n = make(), 1500
    first, second = neighboring_weights(n, 0.05)
    scattered = neighboring_weights(n, 1.5)[1]
    poisson, cells = Poisson(engine), object()
    b = np.random.default_rng(10).standard_normal(n)

    def solve(W, ordering):
        diagonal = np.asarray(W.sum(axis=1)).ravel()
        laplacian = Laplacian(*upload(engine, W))
        phi = engine.zeros(n)
        solution = poisson.solve(laplacian, engine.upload(b), phi, preconditioner="multigrid", ordering=ordering)
        assert solution.reason == "converged"
        A = sp.diags(diagonal) - W
        left = np.linalg.norm(b - b.mean() - A @ phi.get()) / np.linalg.norm(b - b.mean())
        assert left == pytest.approx(solution.residual, rel=0.1)
        return solution.iterations, poisson._multigrid._levels[1].graph

    anew, coarse = solve(first, cells)
    again, kept = solve(second, cells)
    assert again <= anew + 5
    assert kept is coarse
    worse, kept = solve(scattered, cells)
    assert kept is coarse
    assert worse > anew + 5
    better, kept = solve(scattered, cells)
    assert kept is not coarse
    assert abs(better - anew) <= 2
    assert solve(second, None)[1] is not kept
    assert solve(second, object())[1] is not kept
