"""The multigrid preconditioner against dense NumPy, and how many iterations it leaves."""

import functools

import graphs
import numpy as np
import pyopencl as cl
import pytest
import scipy.sparse as sp

from clvoro import create_context
from clvoro._program import Engine
from clvoro.coarsening import Coarsening, Graph
from clvoro.errors import SolverError
from clvoro.multigrid import Multigrid
from clvoro.poisson import Laplacian, Poisson


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
    return (
        engine.upload(W.indptr, np.int32),
        engine.upload(W.indices, np.int32),
        engine.upload(W.data),
    )


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


@pytest.mark.parametrize("name", GRAPHS)
def test_groups_and_their_graph(make, name):
    """Against P^T W P of SciPy, P the groups' indicator."""
    engine, W = make(3 if "3D" in name else 2, np.float32), GRAPHS[name]()
    n = W.shape[0]
    coarsening = Coarsening(engine, "float")
    fine = Graph(*upload(engine, W))
    _, groups, coarse = coarsening.coarsen(fine, 0)
    group, count = groups.group.get(), len(groups)
    starts, members = groups.starts.get(), groups.members.get()
    assert sorted(members) == list(range(n))
    assert np.array_equal(group[members], np.repeat(np.arange(count), np.diff(starts)))
    # Two passes at least halve twice, but for a star, where all wait for the hub.
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
    blocks = Coarsening(engine, "float").pairs(Graph(*upload(engine, W)), 0)
    partner, same, other = (a.get() for a in (blocks.partner, blocks.same, blocks.other))
    heaviest = W.toarray().argmax(axis=1)
    mutual = heaviest[heaviest] == np.arange(n)
    assert np.array_equal(partner, np.where(mutual, heaviest, np.arange(n)))
    assert 0.3 < mutual.mean() < 0.9
    A = np.diag(W.toarray().sum(axis=1)) - W.toarray()
    B = np.diag(A.diagonal())
    B[np.arange(n)[mutual], heaviest[mutual]] = A[np.arange(n)[mutual], heaviest[mutual]]
    got = np.zeros((n, n))
    got[np.arange(n), partner] = other
    got[np.arange(n), np.arange(n)] = same
    expected = np.linalg.inv(B)
    assert np.abs(got - expected).max() <= 1e-4 * np.abs(expected).max()
    spectrum = np.linalg.eigvals(expected @ A).real
    assert spectrum.max() <= 2 + 1e-12


def reference_cycle(multigrid, depth, b):
    """One cycle in dense float64 from the device's levels."""
    level = multigrid._levels[depth]
    W = matrix_of(level.graph).toarray().astype(float)
    np.fill_diagonal(W, 0)
    n = len(W)
    A = np.diag(W.sum(axis=1)) - W
    partner, same, other = (
        a.get().astype(float) for a in (level.pairs.partner, level.pairs.same, level.pairs.other)
    )
    if level.groups is None:
        mean = A.trace() / n
        return np.linalg.solve(A + mean / n + 1e-6 * mean * np.eye(n), b)

    def smooth(x, omega):
        t = b - A @ x
        return x + omega * (same * t + other * t[partner.astype(int)])

    low, high = 0.35, 2.0
    roots = (low + high) / 2 + (high - low) / 2 * np.cos(np.pi * np.array([1, 3]) / 4)
    x = smooth(smooth(np.zeros(n), 1 / roots[0]), 1 / roots[1])
    group = level.groups.group.get()
    coarse = np.bincount(group, b - A @ x)
    e = reference_cycle(multigrid, depth + 1, coarse)
    if depth + 1 == 2 and multigrid._levels[2].groups is not None:
        C = matrix_of(multigrid._levels[2].graph).toarray().astype(float)
        C = np.diag(C.sum(axis=1)) - C
        e = e + reference_cycle(multigrid, 2, coarse - C @ e)
    x = x + e[group]
    return smooth(smooth(x, 1 / roots[1]), 1 / roots[0])


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
    # float32 inside; the coarsest matrix has a condition number of a few hundred.
    assert np.abs(u.get() - expected).max() <= 2e-4 * np.abs(expected).max()


def test_preconditioner_is_symmetric_positive_definite(make):
    engine, n = make(), 300
    multigrid = Multigrid(engine)
    multigrid.set_up(*upload(engine, random_weights(n)))
    columns, u = [], engine.zeros(n)
    for i in range(n):
        e = np.zeros(n)
        e[i] = 1
        multigrid.apply(engine.upload(e), u)
        columns.append(u.get())
    M = np.array(columns)
    assert np.abs(M - M.T).max() <= 1e-5 * np.abs(M).max()
    assert np.linalg.eigvalsh(0.5 * (M + M.T)).min() > 0


def solve(engine, W, seed=17, tolerance=1e-8):
    n = W.shape[0]
    graph = Graph(*upload(engine, W))
    poisson = Poisson(engine)
    D = np.asarray(W.sum(axis=1)).ravel()
    laplacian = Laplacian(
        graph.starts, graph.columns, graph.weights, engine.upload(D),
        engine.upload(1 / np.where(D > 0, D, 1)), engine.zeros((n, engine.dim)),
    )  # fmt: skip
    b = np.random.default_rng(seed).standard_normal(n)
    phi = engine.zeros(n)
    solution = poisson.solve(
        laplacian, engine.upload(b), phi, preconditioner="multigrid", tolerance=tolerance
    )
    A = sp.diags(D) - W
    b = b - b.mean()
    true = np.linalg.norm(b - A @ phi.get().astype(float)) / np.linalg.norm(b)
    return solution, true


def test_iterations_random(make):
    """Twice to four times fewer than the smoothed or plain aggregation of a textbook."""
    solution, true = solve(make(), random_weights(10000, seed=71))
    assert solution.converged
    assert solution.iterations <= 18
    assert true <= 1.01e-8


def test_iterations_graded_and_weighted(make):
    rng = np.random.default_rng(72)
    # Spacing over two decades, density its inverse square.
    points = (0.05 + 0.95 * rng.random((4000, 2))) ** 3
    points = points[graphs.morton_order(points)]
    graph = (points, *graphs.voronoi_graph(points))
    assert solve(make(), weights_of(graph))[0].iterations <= 20
    density = 1 / (1e-3 + points.prod(axis=1) ** (2 / 3))
    assert solve(make(), weights_of(graph, density))[0].iterations <= 25


@pytest.mark.parametrize(
    ("name", "most"), [("lattice", 20), ("random 3D", 20), ("chain", 40), ("star", 20)]
)
def test_iterations_of_other_graphs(make, name, most):
    solution, true = solve(make(3 if "3D" in name else 2), GRAPHS[name]())
    assert solution.converged
    assert solution.iterations <= most
    assert true <= 1.01e-8


def test_float32(make):
    solution, true = solve(make(real=np.float32), random_weights(3000, seed=73), tolerance=1e-5)
    assert solution.converged
    assert solution.iterations <= 15
    assert true <= 5e-5


@pytest.mark.parametrize("n", [2, 3, 64, 65, 66])
def test_few_cells(make, n):
    solution, _ = solve(make(), random_weights(n, seed=74))
    assert solution.converged
    assert solution.iterations <= 12


def test_disconnected_graphs_end(make):
    """Two meshes side by side, and cells without neighbours: no solution, but an end."""
    two = sp.block_diag([random_weights(200), random_weights(150)]).tocsr()
    lonely = sp.block_diag([random_weights(200), sp.csr_matrix((100, 100))]).tocsr()
    for W in (two, lonely, sp.csr_matrix((90, 90))):
        try:
            solution, _ = solve(make(), W)
        except SolverError:
            continue
        assert not solution.converged


def test_repeats_bit_by_bit(make):
    engine, W = make(), random_weights(3000, seed=75)
    one, two = (solve(engine, W)[0] for _ in range(2))
    assert np.array_equal(one.residuals, two.residuals)


def test_set_up_again_for_another_graph(make):
    """Room of a larger graph is used again for a smaller one."""
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
