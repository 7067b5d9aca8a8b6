"""The Poisson solve against SciPy and a dense conjugate gradient method in NumPy."""

import numpy as np
import pyopencl as cl
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as sla

from clvoro import Box, create_context
from clvoro.errors import InputError, SolverError
from clvoro.opencl.engine import Engine
from clvoro.opencl.launch import COSTS_ON_CPU, COSTS_ON_GPU, COSTS_ON_SHARED_MEMORY, cost_factors
from clvoro.solvers import conjugate_gradient
from clvoro.solvers.conjugate_gradient import ConjugateGradient
from clvoro.solvers.linear_system import Limits, Operator
from clvoro.solvers.poisson import Poisson, expected_costs
from tests.reference import graphs

REALS = [np.float64, np.float32]


@pytest.fixture(scope="module", params=[0, 3000], ids=["launches", "alone"])
def make(request):
    """Engines of the default device by dimension and precision; one work-group solves, or all."""
    ctx = create_context()
    queue = cl.CommandQueue(ctx)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(conjugate_gradient, "one_group_limit", lambda engine: request.param)
        yield lambda dim=2, real=np.float64: Engine(ctx, queue, dim, np.dtype(real))


def assembled(engine, graph, density=None, tolerance=0.0):
    points, starts, neighbors, measures, _ = graph
    poisson = Poisson(engine)
    laplacian = poisson.assemble(
        engine.upload(starts, np.int32),
        engine.upload(neighbors, np.int32),
        engine.upload(measures),
        engine.upload(points),
        None if density is None else engine.upload(density),
        tolerance=tolerance,
    )
    return poisson, laplacian


def as_matrix(laplacian):
    """The device's operator as a SciPy matrix."""
    n, starts = len(laplacian), laplacian.starts.get()
    weights, columns = (laplacian.weights.get()[: starts[-1]], laplacian.neighbors.get()[: starts[-1]])
    assert not weights[columns < 0].any()
    rows = np.repeat(np.arange(n), np.diff(starts))
    off = sp.csr_matrix((weights, np.where(columns < 0, rows, columns), starts), (n, n))
    return sp.csr_matrix(sp.diags(np.asarray(off.sum(axis=1)).ravel()) - off)


def singular(poisson, laplacian):
    """The Laplacian as a general operator, without the fused kernels."""
    return Operator(lambda p, q: poisson.apply(laplacian, p, q), singular=True)


def dense_cg(A, b, iterations):
    """Relative residuals of the textbook's Jacobi-preconditioned conjugate gradients."""
    x, r, D = np.zeros(len(b)), b.copy(), A.diagonal()
    u = r / D
    p, gamma, norms = u.copy(), r @ u, [1.0]
    for _ in range(iterations):
        q = A @ p
        alpha = gamma / (p @ q)
        x += alpha * p
        r -= alpha * q
        u = r / D
        gamma, old = r @ u, gamma
        p = u + gamma / old * p
        norms.append(np.linalg.norm(r) / np.linalg.norm(b))
    return np.array(norms)


def direct(A, b):
    """Solution of mean zero of the singular system: sparse direct, one value fixed."""
    x = np.zeros(len(b))
    x[1:] = sla.spsolve(sp.csc_matrix(A[1:, 1:]), b[1:])
    return x - x.mean()


def density_of(points):
    """A smooth density over two decades, h^-2 of h growing from 0.1 to 1."""
    return (0.1 + 0.9 * points[:, 0]) ** -2.0


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("weighted", [False, True])
def test_matrix(make, dim, real, weighted):
    graph = graphs.random_graph(700 if dim == 2 else 300, dim, seed=915)
    density = density_of(graph[0]) if weighted else None
    poisson, laplacian = assembled(make(dim, real), graph, density)
    A = as_matrix(laplacian)
    assert (A != A.T).nnz == 0
    reference = graphs.laplacian_matrix(*graph[:4], density)
    # Short distances lose digits in the difference of coordinates: 1e-3 of the box loses three.
    eps = 1e4 * np.finfo(real).eps
    assert abs(A - reference).max() <= eps * abs(reference).max()
    inverse = poisson.inverse_diagonal(laplacian).get()
    assert np.allclose(inverse * A.diagonal(), 1, rtol=0, atol=16 * np.finfo(real).eps)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("start", ["zero", "near"])
@pytest.mark.parametrize("preconditioner", ["jacobi", "multigrid"])
def test_large_tolerances_use_single_precision(make, preconditioner, start):
    """The operator is rounded, and the residual of the recurrence is correct, also for many cells."""
    engine, n = make(), 8000
    graph = graphs.random_graph(n, seed=916)
    poisson, laplacian = assembled(engine, graph, density_of(graph[0]), tolerance=1e-3)
    assert laplacian.weights.dtype == np.float32
    full = as_matrix(assembled(engine, graph, density_of(graph[0]))[1])
    A = as_matrix(laplacian)
    assert (A != A.T).nnz == 0
    off = abs(A - full) - 2.0**-24 * abs(full)
    off.setdiag(0)
    assert off.max() <= 0
    # A smooth right side: potentials are large, and rounding them to float32 would cost digits within the tolerance.
    b = np.cos(np.pi * graph[0][:, 0]) + 0.1 * np.random.default_rng(917).standard_normal(n)
    b -= b.mean()
    phi = engine.upload(0.999 * direct(full, b)) if start == "near" else engine.zeros(n)
    solution = poisson.solve(
        laplacian,
        engine.upload(b),
        phi,
        tolerance=1e-3 if start == "zero" else 2e-4,
        preconditioner=preconditioner,
        from_zero=start == "zero",
    )
    assert solution.reason == "converged"
    assert solution.iterations > 2
    left = np.linalg.norm(b - full @ phi.get()) / np.linalg.norm(b)
    assert left <= 1.05 * (1e-3 if start == "zero" else 2e-4)


def test_one_sided_face_has_no_weight(make):
    """Faces shorter than rounding may be seen from one side only."""
    engine = make()
    points = np.array([[0.1, 0.5], [0.5, 0.5], [0.9, 0.5]])
    starts, neighbors = np.array([0, 2, 3, 4]), np.array([1, 2, 0, 1])
    _, laplacian = assembled(engine, (points, starts, neighbors, np.ones(4), None))
    A = as_matrix(laplacian).toarray()
    assert np.array_equal(A, A.T)
    assert A[0, 2] == 0
    assert A[1, 2] == 0
    assert A[0, 1] == -2.5


def test_cells_with_several_faces():
    """Around a periodic box, or a hole, two cells may have more than one: all count, on both sides alike."""
    ctx = create_context()
    domain = Box((0, 0), (1, 1), periodic=(True, False))
    engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(np.float64), domain.traits(np.dtype(np.float64)))
    points = np.array([[0.2, 0.5], [0.6, 0.5], [0.5, 0.9]])
    starts, neighbors = np.array([0, 4, 8, 10]), np.array([1, -3, 1, 2, 0, 2, 0, -3, 0, 1])
    measures = np.array([1.0, 1, 0.5, 0.1, 0.51, 0.2, 1.01, 1, 0.1, 0.2])
    _, laplacian = assembled(engine, (points, starts, neighbors, measures, None))
    A = as_matrix(laplacian).toarray()
    assert np.array_equal(A, A.T)
    assert A[0, 1] == pytest.approx(-(1.5 + 1.52) / 2 / 0.4, rel=1e-14)
    assert A[1, 2] == pytest.approx(-0.2 / np.hypot(0.1, 0.4), rel=1e-14)


def test_measures_of_a_face_are_averaged(make):
    points = np.array([[0.25, 0.5], [0.75, 0.5]])
    graph = (points, np.array([0, 2, 4]), np.array([1, -1, 0, -2]), np.array([1.0, 1, 1.5, 1]), None)
    A = as_matrix(assembled(make(), graph)[1]).toarray()
    assert np.array_equal(A, [[2.5, -2.5], [-2.5, 2.5]])


@pytest.mark.sparse(1)
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_solution(make, dim, weighted):
    engine = make(dim)
    graph = graphs.random_graph(500, dim, seed=77)
    density = density_of(graph[0]) if weighted else None
    poisson, laplacian = assembled(engine, graph, density)
    b = np.random.default_rng(78).standard_normal(500)
    phi = engine.zeros(500)
    solution = poisson.solve(laplacian, engine.upload(b), phi, tolerance=1e-11)
    A = graphs.laplacian_matrix(*graph[:4], density)
    expected = direct(A, b - b.mean())
    assert solution.converged
    assert solution.reason == "converged"
    assert solution.residual <= 1e-11
    assert len(solution.residuals) == solution.iterations + 1
    # Condition number about 1e4.
    assert np.abs(phi.get() - expected).max() <= 1e-7 * np.abs(expected).max()
    assert abs(phi.get().mean()) <= 1e-14 * np.abs(expected).max()


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", REALS)
def test_residuals_equal_those_of_a_dense_solver(make, real):
    engine = make(real=real)
    graph = graphs.random_graph(900, seed=361)
    poisson, laplacian = assembled(engine, graph)
    b = np.random.default_rng(5).standard_normal(900)
    tolerance = 1e-8 if real is np.float64 else 1e-4
    solution = poisson.solve(laplacian, engine.upload(b), engine.zeros(900), tolerance=tolerance)
    expected = dense_cg(graphs.laplacian_matrix(*graph[:4]).toarray(), b - b.mean(), 40)
    # Roundings grow from step to step; over forty steps they stay in the last third of the digits.
    rtol = 1e-9 if real is np.float64 else 2e-2
    assert np.allclose(solution.residuals[:40], expected[:40], rtol=rtol, atol=0)
    true = as_matrix(laplacian).astype(float)
    phi = engine.zeros(900)
    solution = poisson.solve(laplacian, engine.upload(b), phi, tolerance=tolerance)
    residual = np.linalg.norm(b - b.mean() - true @ phi.get()) / np.linalg.norm(b - b.mean())
    assert residual == pytest.approx(solution.residual, rel=0.5)


@pytest.mark.sparse(1)
def test_float32_reports_stagnation(make):
    engine = make(real=np.float32)
    poisson, laplacian = assembled(engine, graphs.random_graph(900, seed=361))
    b = engine.upload(np.random.default_rng(6).standard_normal(900))
    solution = poisson.solve(laplacian, b, engine.zeros(900), tolerance=1e-12)
    assert not solution.converged
    assert solution.reason == "stagnated"
    assert solution.residual < 1e-5


@pytest.mark.sparse(3)
@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize("scale", [1e-30, 1e25])
def test_tiny_and_huge_right_sides(make, real, scale):
    """Squares of these leave the range of float32."""
    engine = make(real=real)
    poisson, laplacian = assembled(engine, graphs.random_graph(300, seed=19))
    b = np.random.default_rng(20).standard_normal(300)
    small, plain = engine.zeros(300), engine.zeros(300)
    first = poisson.solve(laplacian, engine.upload(b), plain, tolerance=1e-4)
    second = poisson.solve(laplacian, engine.upload(b * scale), small, tolerance=1e-4)
    assert first.converged
    assert second.converged
    difference = small.get().astype(float) / scale - plain.get()
    assert np.abs(difference).max() <= 1e-2 * np.abs(plain.get()).max()


def test_mean_of_the_source_is_subtracted(make):
    engine = make()
    points, *_, volumes = graph = graphs.random_graph(400, seed=33)
    poisson, _ = assembled(engine, graph)
    source = np.sin(5 * points[:, 0]) + 3
    rhs = engine.empty(400)
    poisson.subtract_mean_source(engine.upload(source), engine.upload(volumes), rhs)
    expected = volumes * (source - (volumes @ source) / volumes.sum())
    assert np.allclose(rhs.get(), expected, rtol=0, atol=1e-15)
    assert abs(rhs.get().sum()) < 1e-14


@pytest.mark.parametrize("b", [np.zeros(50), np.full(50, 0.1)])
def test_zero_right_side(make, b):
    """Right sides of zero, also after their mean is subtracted, give zero for any start."""
    engine = make()
    poisson, laplacian = assembled(engine, graphs.random_graph(50, seed=4))
    phi = engine.upload(np.arange(50.0))
    solution = poisson.solve(laplacian, engine.upload(b), phi)
    assert solution.iterations == 0
    assert solution.converged
    assert not phi.get().any()


@pytest.mark.parametrize("real", REALS)
def test_one_and_two_cells(make, real):
    engine = make(real=real)
    poisson, laplacian = assembled(engine, graphs.random_graph(1, seed=9))
    phi = engine.upload([3.0])
    assert poisson.solve(laplacian, engine.upload([2.0]), phi).iterations == 0
    assert phi.get() == 0
    points = np.array([[0.25, 0.5], [0.75, 0.5]])
    poisson, laplacian = assembled(engine, (points, *graphs.voronoi_graph(points)))
    phi = engine.zeros(2)
    solution = poisson.solve(laplacian, engine.upload([1.0, -1.0]), phi, tolerance=1e-6)
    assert solution.converged
    # w = 1 / 0.5, so 2 (phi_0 - phi_1) = 1.
    assert np.allclose(phi.get(), [0.25, -0.25], rtol=1e-6)


@pytest.mark.sparse(1)
def test_auto_takes_the_cheaper_preconditioner(make):
    """Jacobi for few cells, multigrid from some thousand on, from fewer for smaller tolerances."""
    for dim in (2, 3):
        for tolerance in (1e-1, 1e-2, 1e-5, 1e-8):
            costs = [expected_costs(n, dim, tolerance) for n in (200, 10**5, 10**7)]
            assert [jacobi < multigrid for jacobi, multigrid in costs] == [True, False, False]
    assert np.argmin(expected_costs(3000, 2, 1e-1)) == 0
    assert np.argmin(expected_costs(3000, 2, 1e-8)) == 1
    # For a thousand cells a solve in one work-group costs less than one in many launches.
    assert expected_costs(1000, 2, 1e-2, one_group=True)[0] < 0.5 * expected_costs(1000, 2, 1e-2)[0]
    for n, jacobi in ((600, True), (8000, False)):
        engine = make()
        poisson, laplacian = assembled(engine, graphs.random_graph(n, seed=14))
        b = engine.upload(np.random.default_rng(15).standard_normal(n))
        solution = poisson.solve(laplacian, b, engine.zeros(n), tolerance=1e-2)
        assert solution.reason == "converged"
        assert (solution.iterations > 20) == jacobi


def test_warm_start(make):
    engine = make()
    poisson, laplacian = assembled(engine, graphs.random_graph(600, seed=12))
    b = engine.upload(np.random.default_rng(13).standard_normal(600))
    phi = engine.zeros(600)
    cold = poisson.solve(laplacian, b, phi)
    again = poisson.solve(laplacian, b, phi)
    assert cold.iterations > 50
    assert again.iterations == 0
    assert again.residual <= 1e-8


def test_start_far_from_the_solution(make):
    """The residual of the start is a thousand times the right side."""
    engine, graph = make(), graphs.random_graph(900, seed=61)
    poisson, laplacian = assembled(engine, graph)
    rng, A = np.random.default_rng(62), as_matrix(laplacian)
    b, start = (rng.standard_normal(900) for _ in range(2))
    start *= 1e3 * np.linalg.norm(b) / np.linalg.norm(A @ start)
    x = engine.upload(start)
    solution = poisson.solve(laplacian, engine.upload(b), x, tolerance=1e-8, preconditioner="jacobi")
    assert solution.converged
    expected = direct(A, b - b.mean())
    # Condition number about 1e4.
    assert np.abs(x.get() - expected).max() <= 1e-4 * np.abs(expected).max()


@pytest.mark.sparse(1)
@pytest.mark.parametrize("preconditioner", ["jacobi", "multigrid"])
@pytest.mark.parametrize("left", [np.nan, 1e3])
def test_buffers_of_earlier_solves_do_not_matter(make, preconditioner, left):
    """In the sums, the state and the records, which stay."""
    engine, found = make(), []
    b = engine.upload(np.random.default_rng(60).standard_normal(900))
    for soiled in (False, True):
        poisson, laplacian = assembled(engine, graphs.random_graph(900, seed=59))
        solver, options = (poisson._conjugate_gradient, {"tolerance": 1e-6, "preconditioner": preconditioner})
        poisson.solve(laplacian, b, engine.zeros(900), max_iterations=300, **options)
        for array in (solver.partial, solver.state, solver.record, solver._group_state) * soiled:
            array.fill(left)
        x = engine.zeros(900)
        solution = poisson.solve(laplacian, b, x, max_iterations=300, **options)
        assert solution.converged
        found.append((solution.residuals, x.get()))
    for one, other in zip(*found, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.sparse(1)
def test_result_does_not_depend_on_the_lookahead(make):
    engine = make()
    _, laplacian = assembled(engine, graphs.random_graph(800, seed=57))
    poisson = Poisson(engine)
    b = engine.upload(np.random.default_rng(58).standard_normal(800))
    results = []
    for lookahead in (1, 7, 200):
        x = engine.zeros(800)
        solution = ConjugateGradient(engine).solve(
            singular(poisson, laplacian), b, x, poisson.inverse_diagonal(laplacian), Limits(1e-6, 500, lookahead)
        )
        results.append((solution.iterations, x.get()))
    assert len({iterations for iterations, _ in results}) == 1
    assert all(np.array_equal(x, results[0][1]) for _, x in results)


@pytest.mark.parametrize(
    ("n", "group_size"),
    [(1500, None), pytest.param(15, 4, marks=pytest.mark.slow)],  # barriers in loops take long to compile
    ids=["cpu", "gpu"],
)
def test_one_work_group_solves_alike(n, group_size, monkeypatch):
    """It does the same as many launches, except for the order of sums, also with many work-items."""
    ctx, results = create_context(), []
    b = np.random.default_rng(59).standard_normal(n)
    for few in (0, n):
        monkeypatch.setattr(conjugate_gradient, "one_group_limit", lambda engine, few=few: few)
        engine = Engine(ctx, cl.CommandQueue(ctx), 2, np.dtype(np.float64))
        if group_size is not None:
            object.__setattr__(engine, "group_size", group_size)
        poisson, laplacian = assembled(engine, graphs.random_graph(n, seed=58))
        x = engine.zeros(n)
        solution = poisson.solve(laplacian, engine.upload(b), x, preconditioner="jacobi")
        assert solution.converged
        results.append((solution, x.get()))
    (one, x), (other, y) = results
    # Rounding grows over hundreds of iterations: an H200 took 263 and 260.
    assert abs(one.iterations - other.iterations) <= 2 + one.iterations // 50
    assert np.abs(x - y).max() <= 1e-7 * np.abs(x).max()


@pytest.mark.sparse(1)
def test_callable_preconditioner(make):
    """Jacobi's as a callable gives the iterates of the built-in one.

    It is applied once per iteration, where the host looks after each.
    """
    engine, applied = make(), 0
    poisson, laplacian = assembled(engine, graphs.random_graph(800, seed=57))
    inverse = poisson.inverse_diagonal(laplacian).copy()
    b = engine.upload(np.random.default_rng(58).standard_normal(800))

    def jacobi(r, u, spare):
        nonlocal applied
        applied += 1
        u[:] = inverse * r

    x, y = engine.zeros(800), engine.zeros(800)
    limits = Limits(1e-8, 500, 1, verify=False)
    solution = ConjugateGradient(engine).solve(singular(poisson, laplacian), b, x, jacobi, limits)
    assert solution.converged
    assert applied == solution.iterations > 10
    expected = poisson.solve(laplacian, b, y)
    assert abs(solution.iterations - expected.iterations) <= 2
    assert np.abs(x.get() - y.get()).max() <= 1e-5 * np.abs(y.get()).max()


def test_breakdown_is_reported(make):
    """An indefinite operator, and numbers that are not finite."""
    engine = make()
    poisson, laplacian = assembled(engine, graphs.random_graph(100, seed=21))
    b = np.random.default_rng(22).standard_normal(100)
    solver = ConjugateGradient(engine)
    negative = engine.zeros(100)

    def apply(p, q):
        poisson.apply(laplacian, p, q)
        q[:] = -q

    with pytest.raises(SolverError, match="positive definite"):
        solver.solve(
            Operator(apply, singular=True),
            engine.upload(b),
            negative,
            poisson.inverse_diagonal(laplacian),
            Limits(1e-8, 50),
        )
    b[7] = np.nan
    with pytest.raises(SolverError, match="not finite"):
        poisson.solve(laplacian, engine.upload(b), engine.zeros(100))


def test_parts_of_a_graph_have_their_own_means(make):
    """Two pairs of cells and a single one, in which the sources do not cancel: the means of the pairs are removed."""
    engine = make()
    points = np.array([[0.1, 0.1], [0.2, 0.1], [0.8, 0.9], [0.9, 0.9], [0.5, 0.5]])
    graph = (points, np.array([0, 1, 2, 3, 4, 5]), np.array([1, 0, 3, 2, -1]), np.ones(5), None)
    poisson, laplacian = assembled(engine, graph)
    phi = engine.zeros(5)
    solution = poisson.solve(laplacian, engine.upload([1.0, 0, 0, 2, 7]), phi, tolerance=1e-8, preconditioner="jacobi")
    assert solution.converged
    assert as_matrix(laplacian) @ phi.get() == pytest.approx([0.5, -0.5, -1, 1, 0], abs=1e-7)


def test_bad_input(make):
    engine = make()
    poisson, laplacian = assembled(engine, graphs.random_graph(60, seed=91))
    b, phi = engine.zeros(60), engine.zeros(60)
    with pytest.raises(InputError, match="rhs got shape"):
        poisson.solve(laplacian, engine.zeros(59), phi)
    with pytest.raises(InputError, match="preconditioner got 'ilu'"):
        poisson.solve(laplacian, b, phi, preconditioner="ilu")
    with pytest.raises(InputError, match="tolerance got"):
        poisson.solve(laplacian, b, phi, tolerance=0)


def test_from_zero_and_unverified(make):
    """The content of the start does not matter; the residual of the recurrence equals the true one."""
    engine = make()
    graph = graphs.random_graph(900, seed=363)
    poisson, laplacian = assembled(engine, graph)
    b = np.random.default_rng(7).standard_normal(900)
    b -= b.mean()
    results = []
    for start in (np.zeros(900), np.full(900, np.nan)):
        phi = engine.upload(start)
        solution = poisson.solve(laplacian, engine.upload(b), phi, tolerance=1e-2, from_zero=True)
        left = np.linalg.norm(b - as_matrix(laplacian) @ phi.get()) / np.linalg.norm(b)
        assert solution.residual <= 1e-2
        assert solution.reason == "converged"
        assert left == pytest.approx(solution.residual, rel=1e-9)
        results.append(phi.get())
    assert np.array_equal(*results)


def crossover(dim, tolerance, factors):
    """The number of cells from which on multigrid is chosen."""
    sizes = np.unique(np.geomspace(100, 1e7, 2000).astype(int))
    better = [b < a for a, b in (expected_costs(int(n), dim, tolerance, False, factors) for n in sizes)]
    first = better.index(True)
    assert all(better[first:])
    return sizes[first]


@pytest.mark.parametrize("dim", [2, 3])
def test_choice_of_the_preconditioner_by_kind_of_device(dim):
    """On GPUs the many small launches of coarse levels cost more than cells, so Jacobi pays for larger meshes."""

    class Device:
        type = cl.device_type.GPU
        host_unified_memory = False

    assert cost_factors(Device) == COSTS_ON_GPU
    Device.host_unified_memory = True
    assert cost_factors(Device) == COSTS_ON_SHARED_MEMORY
    Device.type |= cl.device_type.CPU
    assert cost_factors(Device) == COSTS_ON_CPU
    for tolerance in (1e-2, 1e-8):
        kinds = COSTS_ON_CPU, COSTS_ON_SHARED_MEMORY, COSTS_ON_GPU
        cpu, shared, gpu = (crossover(dim, tolerance, factors) for factors in kinds)
        assert cpu == shared < gpu < 50 * cpu
