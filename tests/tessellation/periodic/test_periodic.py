"""Periodic boxes: comparison of diagrams with Qhull, lattices, few generators; runs; files."""

import itertools

import numpy as np
import pytest
from scipy.spatial import Voronoi, cKDTree

import clvoro
from clvoro import sizing
from clvoro.errors import InputError, InputTypeError
from clvoro.mesh.quality import measure_mesh
from clvoro.opencl import program as _program
from clvoro.tessellation.device_diagram import read_report
from clvoro.tessellation.periodic.ghost_images import GhostImages
from clvoro.tessellation.periodic.images import FewCellsError, Images
from clvoro.tessellation.tessellator import Tessellator

UNIT = clvoro.Box((0, 0), (1, 1), periodic=True)
CHANNEL = clvoro.Box((3, -2), (5.5, -0.5), periodic=(True, False))
CUBE = clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True)
SLAB = clvoro.Box((0, 0, 0), (2, 1, 1.3), periodic=(True, False, True))
ROUNDING = {"float64": 1e-12, "float32": 2e-5}
"""Tolerance of a volume over the mean volume: about 1e4 eps, since corners are quotients of differences of squares."""


@pytest.fixture(scope="module")
def double(ctx):
    return clvoro.Adapter(ctx)


def some_points(box, n, seed=0):
    rng = np.random.default_rng(100 * n + seed)
    return np.array(box.lower) + box.extent * rng.random((n, box.dim))


def torus_voronoi(box, points):
    """Faces {(i, j, shift): measure} and volumes (n,), by Qhull on all images a period away, and theirs behind walls.

    Walls are faces (i, -1 - wall, zeros).
    """
    n, dim = points.shape
    steps = [(0, -1, 1) if p else (0,) for p in box.periodic]
    shifts = list(itertools.product(*steps))
    assert shifts[0] == (0,) * dim
    sets = [(points + np.array(s) * box.extent, s, None) for s in shifts]
    for a in np.flatnonzero(~np.array(box.periodic)):
        for side, level in enumerate((box.lower[a], box.upper[a])):
            for x, s, wall in list(sets):
                if wall is None:
                    mirrored = x.copy()
                    mirrored[:, a] = 2 * level - mirrored[:, a]
                    sets.append((mirrored, s, -1 - 2 * int(a) - side))
    diagram = Voronoi(np.concatenate([x for x, _, _ in sets]))
    faces, volumes = {}, np.zeros(n)
    for (p, q), ridge in zip(diagram.ridge_points, diagram.ridge_vertices, strict=True):
        for i, j in ((p, q), (q, p)):
            if i >= n:
                continue
            assert -1 not in ridge
            corners = diagram.vertices[ridge]
            if dim == 2:
                measure = np.linalg.norm(corners[1] - corners[0])
            else:
                fan = np.cross(corners[1:-1] - corners[0], corners[2:] - corners[0])
                measure = np.linalg.norm(fan.sum(axis=0)) / 2
            _, shift, wall = sets[j // n]
            key = (i, j % n, shift) if wall is None else (i, wall, (0,) * dim)
            faces[key] = faces.get(key, 0) + measure
            volumes[i] += measure * np.linalg.norm(diagram.points[i] - diagram.points[j]) / 2 / dim
    return faces, volumes


def faces_of(diagram):
    keys = zip(
        diagram.half_faces.owner.tolist(), diagram.neighbors.tolist(), map(tuple, diagram.shifts.tolist()), strict=True
    )
    return dict(zip(keys, diagram.face_measures.tolist(), strict=True))


@pytest.mark.sparse(2)
@pytest.mark.parametrize("n", [1, 2, 3, 7, 60, 500])
@pytest.mark.parametrize("box", [UNIT, CHANNEL, CUBE, SLAB], ids=["unit", "channel", "cube", "slab"])
def test_against_qhull(adapter, box, n):
    points = some_points(box, n)
    diagram = adapter.diagram(box, points)
    faces, volumes = torus_voronoi(box, box.wrap(points))
    mean = box.measure / n
    tolerance = ROUNDING[adapter.dtype.name]
    assert np.abs(diagram.volumes - volumes).max() < tolerance * mean
    found = faces_of(diagram)
    size = mean ** (1 - 1 / box.dim)
    # Round-off decides whether faces of no size exist.
    for key in found.keys() | faces.keys():
        assert abs(found.get(key, 0) - faces.get(key, 0)) < 10 * tolerance * size
    assert len(found) == len(diagram.neighbors)
    assert {(j, i, tuple(-s for s in shift)) for i, j, shift in found if j >= 0} == {
        key for key in found if key[1] >= 0
    }
    assert diagram.check()


@pytest.mark.parametrize("box", [UNIT, CUBE], ids=["2D", "3D"])
def test_euler(double, box):
    # Three cells meet at a vertex in 2D, four in 3D. Each vertex exists once per image in use.
    n = 300
    d = double.diagram(box, some_points(box, n, 3))
    wrapped = np.rint(d.vertices * 10**9).astype(np.int64) % 10**9
    vertices, edges_and_faces = len(np.unique(wrapped, axis=0)), len(d.neighbors) // 2
    if box.dim == 2:
        assert vertices - edges_and_faces + n == 0
    else:  # four edges at a vertex
        assert vertices - 2 * vertices + edges_and_faces - n == 0


@pytest.mark.sparse(2)
@pytest.mark.parametrize("box", [UNIT, SLAB], ids=["unit", "slab"])
def test_translation(adapter, box):
    """An exact translation along the periods gives the same cells, apart from the order of sums."""
    points = np.round(some_points(box, 200), 3)
    points = np.round((points - box.lower) * 1024) / 1024 + box.lower
    points = np.unique(points, axis=0)
    by = np.where(box.periodic, [0.375, 0.8125, 0.6875][: box.dim], 0.0)
    one, two = adapter.diagram(box, points), adapter.diagram(box, points + by)
    steps = np.rint((points + by - two.points) / box.extent)

    def unwrapped(diagram, lifted):
        return {
            (i, j, tuple(np.subtract(shift, lifted[j] - lifted[i]).astype(int).tolist()))
            for i, j, shift in faces_of(diagram)
            if j >= 0
        }

    assert steps.any()
    assert unwrapped(one, np.zeros_like(steps)) == unwrapped(two, steps)
    tolerance = 64 * np.finfo(adapter.dtype).eps * box.measure / len(points)
    assert np.abs(one.volumes - two.volumes).max() <= 16 * tolerance
    moved = one.centroids - one.points - (two.centroids - two.points)
    assert np.abs(moved).max() < 1e4 * np.finfo(adapter.dtype).eps


def square(n):
    return np.indices((n, n)).reshape(2, -1).T / n, (1, 1), 4


def hexagonal(n):
    at = np.indices((n, n)).reshape(2, -1).T.astype(float)
    at[:, 0] += 0.5 * (at[:, 1] % 2)
    at[:, 1] *= np.sqrt(3) / 2
    return at / n, (1, np.sqrt(3) / 2), 6


def cubic(n):
    return np.indices((n, n, n)).reshape(3, -1).T / n, (1, 1, 1), 6


def bcc(n):
    at = cubic(n)[0]
    return np.concatenate([at, at + 0.5 / n]), (1, 1, 1), 14


@pytest.mark.sparse(12)
@pytest.mark.parametrize("offset", [0, 1 / 3])
@pytest.mark.parametrize(
    ("lattice", "n"),
    [
        (square, 1),
        (square, 2),
        (square, 7),
        (hexagonal, 2),
        (hexagonal, 10),
        (cubic, 1),
        (cubic, 5),
        (bcc, 1),
        (bcc, 3),
    ],
)
def test_lattices(adapter, lattice, n, offset):
    """Cells of lattices are equal, with generators on the boundary or not; four or more cells meet at a vertex."""
    points, edges, sides = lattice(n)
    box = clvoro.Box((0,) * len(edges), edges, periodic=True)
    d = adapter.diagram(box, points + offset * np.array(edges))
    assert (np.diff(d.neighbor_starts) == sides).all()
    assert np.abs(d.volumes * len(points) / box.measure - 1).max() < 40 * np.finfo(adapter.dtype).eps * n
    assert d.check()


@pytest.mark.sparse(1)
def test_clusters_need_a_deep_halo(adapter):
    """A cell as long as half a period needs images from many spacings away."""
    rng = np.random.default_rng(5)
    for at in ((0.5, 0.5), (0.0, 0.98)):
        points = np.concatenate([np.array(at) + 0.03 * rng.random((200, 2)), rng.random((2, 2))])
        d = adapter.diagram(UNIT, points)
        volumes = torus_voronoi(UNIT, UNIT.wrap(points))[1]
        assert np.abs(d.volumes - volumes).max() < ROUNDING[adapter.dtype.name]
        assert d.check()


@pytest.mark.sparse(1)
@pytest.mark.parametrize("box", [CHANNEL, SLAB], ids=["channel", "slab"])
def test_images_include_all_that_cells_need(adapter, box):
    """All generators on the balls around vertices have images, none lies inside; small cells need few."""
    rng = np.random.default_rng(11)
    n = {2: 600, 3: 1200}[box.dim]
    unit = rng.random((n, box.dim)) ** 3
    points = np.array(box.lower) + box.extent * unit
    stages = adapter._stages_for(box)
    x = stages.engine.upload(box.place(points, adapter.dtype))
    periodic = Tessellator(stages, box)
    part = periodic.tessellate(x, n, complete=True).folded.part
    taken = part.points.get()[: part.count].astype(float)
    diagram, scale = adapter.diagram(box, points), box.frame[1]
    owner = diagram.half_faces.owner
    if box.dim == 2:
        corners = diagram.vertices[diagram.cell_vertices]
    else:
        owner = np.repeat(owner, np.diff(diagram.face_vertex_starts))
        corners = diagram.vertices[diagram.face_vertices]
    radii = np.linalg.norm(corners - diagram.points[owner], axis=1) / scale
    corners = (corners - np.array(box.frame[0])) / scale
    steps = [(-1, 0, 1) if p else (0,) for p in box.periodic]
    all_images = np.concatenate(
        [x.get() + np.array(step) * box.periods(adapter.dtype) for step in itertools.product(*steps) if any(step)]
    )
    # Centers of large balls have a round-off of radius / distance of the generators.
    noise = 1e-5 if adapter.dtype == np.float64 else 1e-3
    every = cKDTree(all_images)
    inside = every.query_ball_point(corners, radii * (1 - noise), return_length=True)
    assert inside.max() == 0
    near = every.query_ball_point(corners, radii * (1 + noise / 1e3))
    needed = np.unique(np.concatenate([np.array(found, int) for found in near]))
    distance, _ = cKDTree(taken).query(all_images[needed])
    assert len(needed) > n / 30
    assert distance.max() < 1e-6
    # With one depth everywhere nearly all images would be taken: some cells are as long as half the box.
    assert len(taken) - n < 0.7 * len(all_images)


def test_cells_lie_around_their_generators(double):
    d = double.diagram(UNIT, some_points(UNIT, 50))
    owner = d.half_faces.owner
    assert (np.abs(d.face_centroids - d.points[owner]) < 0.5).all()
    assert (np.abs(d.vertices[d.cell_vertices] - d.points[owner]) < 0.5).all()
    assert (d.vertices < 0).any()
    assert (d.vertices > 1).any()
    assert ((d.points >= 0) & (d.points < 1)).all()
    # Each face lies halfway to the image of its neighbor.
    image = d.points[d.neighbors] + d.shifts * UNIT.extent
    away = d.face_centroids - (image + d.points[owner]) / 2
    assert np.abs(np.einsum("ij,ij->i", away, image - d.points[owner])).max() < 1e-14


def test_points_are_wrapped(double):
    points = some_points(UNIT, 40)
    beyond = points + np.random.default_rng(1).integers(-3, 4, (40, 2))
    one, two = double.diagram(UNIT, points), double.diagram(UNIT, beyond)
    assert np.abs(one.points - two.points).max() < 1e-15 * 8
    assert faces_of(one).keys() == faces_of(two).keys()
    with pytest.raises(InputError, match="outside"):
        double.diagram(CHANNEL, [[100.0, 0.0]])
    on_seam = UNIT.wrap(np.array([[1.0, -1e-30], [0.0, 1 + 1e-16]]))
    assert ((on_seam >= 0) & (on_seam < 1)).all()


def test_plain_boxes_have_no_shifts(double):
    d = double.diagram(clvoro.Box((0, 0), (1, 1)), some_points(UNIT, 10))
    assert d.shifts.shape == (len(d.neighbors), 2)
    assert d.shifts.dtype == np.int8
    assert not d.shifts.any()


def test_arguments(adapter):
    assert clvoro.Box((0, 0), (1, 1), periodic=(False, True)).periodic == (False, True)
    assert repr(UNIT) == "Box(lower=(0.0, 0.0), upper=(1.0, 1.0), periodic=(True, True))"
    assert clvoro.Box((0, 0), (1, 1)) == clvoro.Box((0, 0), (1, 1), periodic=False) != UNIT
    with pytest.raises(InputTypeError, match="periodic 1"):
        clvoro.Box((0, 0), (1, 1), periodic=1)
    with pytest.raises(InputError, match="3 directions, expected 2"):
        clvoro.Box((0, 0), (1, 1), periodic=(True, True, False))
    step = float(np.finfo(adapter.dtype).eps)
    thin = clvoro.Box((0, 0), (1, 500 * step), periodic=True)
    with pytest.raises(InputError, match="too thin"):
        adapter.diagram(thin, [[0.5, 0]])
    with pytest.raises(InputError, match="coincide"):
        adapter.diagram(UNIT, [[0.5, 0.0], [0.25, 0.5], [0.5, 1.0]])


# Runs.

SPOT = sizing.Expression("0.05 + 0.3 * fmax(hypot(x - 0.05 - floor(x + 0.45), y - 0.9 - floor(y - 0.4)) - 0.1, 0)")
"""A refined spot around (0.05, 0.9), across two periodic boundaries."""


@pytest.mark.sparse(1)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"method": "exact", "effort": "fast"},
        {"method": "adaptive", "n_cells": 150, "points": "uniform"},
        {"method": "coupled", "max_steps": 30},
        {"method": "poisson", "max_steps": 5},
        {"method": "weighted", "max_steps": 8},
    ],
    ids=lambda options: "-".join(map(str, options.values())) or "default",
)
def test_runs(adapter, options):
    result = adapter.run(UNIT, SPOT, seed=3, **options)
    assert result.check()
    assert (np.abs(result.diagram.shifts).max(axis=0) == 1).all()
    assert abs(result.diagram.volumes.sum() - 1) < 4 * np.finfo(adapter.dtype).eps * len(result.points)
    if not options:
        # The count is correct to two cells, and less than a third of a cell changes nothing: pairs of defects have
        # priority. Each surplus cell makes all smaller by 1 / 2n, which is most of the error of so few cells.
        n, fitting = len(result.points), (result.diagram.volumes / result.target_size**2).sum()
        assert abs(n - fitting) < 2.7
        assert np.abs(result.size_error).mean() < abs(n - fitting) / (2 * n) + 0.003
        assert result.quality.mean() > 0.955  # of so few; .960 to .977 over twelve starts


@pytest.mark.sparse(1)
def test_incremental_update_across_periodic_boundaries(adapter):
    """Diagrams updated from step to step equal those made anew."""
    stages = adapter._stages_for(UNIT)
    engine, n = stages.engine, 800
    rng = np.random.default_rng(11)
    points = rng.random((n, 2))
    periodic, fresh = Tessellator(stages, UNIT), Tessellator(stages, UNIT)
    x = engine.upload(UNIT.place(points, adapter.dtype))
    t = periodic.tessellate(x, n)
    for _ in range(4):
        points = points + 0.0003 * rng.standard_normal((n, 2))
        x = engine.upload(UNIT.place(points, adapter.dtype))
        t = periodic.steps.update(x, n, t, None, read_report)
        assert t is not None
        rows = [set(row) for row in np.split(*rows_of(t))]
        volumes = t.volumes.get()
        new = fresh.tessellate(x, n)
        assert rows == [set(row) for row in np.split(*rows_of(new))]
        assert np.abs(volumes - new.volumes.get()).max() * n < ROUNDING[adapter.dtype.name]


def rows_of(t):
    starts = t.starts.get()
    return t.neighbors.get()[: starts[-1]], starts[1:-1]


@pytest.mark.sparse(1)
def test_rows_do_not_depend_on_cells_of_images(adapter):
    """Rows of generators are the same whether or not images get cells, even in lattices off by one ulp."""
    eps = np.finfo(adapter.dtype).eps
    for box, lattice in ((UNIT, square(12)[0]), (CUBE, bcc(4)[0])):
        stages, n = adapter._stages_for(box), len(lattice)
        for noise in (0, eps, 1e3 * eps):
            moved = lattice + noise * np.random.default_rng(2).standard_normal(lattice.shape)
            x = stages.engine.upload(box.place(moved, adapter.dtype))
            found = []
            for whole in (True, False):
                t = Tessellator(stages, box).tessellate(x, n, complete=whole)
                starts = t.starts.get()
                i = np.repeat(np.arange(n), np.diff(starts))
                j = t.neighbors.get()[: starts[-1]]
                assert set(zip(i, j, strict=True)) == set(zip(j, i, strict=True))
                found.append(t.volumes.get().copy())
            assert np.abs(found[0] - found[1]).max() * n < 100 * n * eps


def test_faces_of_one_side_only_are_dropped(adapter):
    from tests.robustness.oclgrind_work import drop_faces

    drop_faces(adapter)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("box", [UNIT, CHANNEL], ids=["unit", "channel"])
def test_ends_of_a_dropped_face_become_one_vertex(adapter, box, monkeypatch):
    """Four cells meet at each vertex up to round-off, and images are cut in another order."""
    eps, fold, dropped = float(np.finfo(adapter.dtype).eps), GhostImages.fold, []

    def folded(self, *arguments):
        found = fold(self, *arguments)
        dropped.append(found[0].folded.places is not None)
        return found

    monkeypatch.setattr(GhostImages, "fold", folded)
    for n in (12, 13):
        middles = (np.stack(np.meshgrid(np.arange(n), np.arange(n)), -1).reshape(-1, 2) + 0.5) / n
        for seed in range(25):
            noise = np.random.default_rng(seed).standard_normal((n * n, 2))
            x = np.array(box.lower) + (middles + 10 * eps * noise) * box.extent
            adapter.diagram(box, x).check().demand()
    assert sum(dropped) < len(dropped)
    # In the channel there may be none.
    assert box is CHANNEL or sum(dropped)


@pytest.mark.slow
def test_coarse_levels_with_too_few_cells_are_left_out(double):
    from clvoro.adaptation.plan.schedule import auto_levels

    box = clvoro.Box((0, 0, 0), (4, 4, 0.3), periodic=True)
    result = double.run(box, 0.07, effort="fast", max_steps=1)
    assert auto_levels(len(result.points), 3) > result.settings["levels"] == 0
    with pytest.raises(FewCellsError):
        double.run(box, 0.07, options=clvoro.MultilevelOptions(levels=1), max_steps=1)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("box", [CUBE, SLAB], ids=["cube", "slab"])
def test_runs_3d(double, box):
    size = sizing.Constant(0.16)
    for options in ({"effort": "fast"}, {"method": "exact"}, {"method": "coupled", "max_steps": 4}):
        result = double.run(box, size, seed=5, **options)
        assert result.check()
        assert abs(result.diagram.volumes.sum() - box.measure) < 1e-12
    assert (np.abs(result.diagram.shifts).max(axis=0) == box.periodic).all()


@pytest.mark.sparse(1)
@pytest.mark.parametrize(("lattice", "n"), [(hexagonal, 10), (bcc, 5)])
def test_a_lattice_stays(double, lattice, n):
    """All forces vanish by symmetry: generators move by round-off only."""
    points, edges, _ = lattice(n)
    box = clvoro.Box((0,) * len(edges), edges, periodic=True)
    size = (box.measure / len(points)) ** (1 / box.dim)
    for method in ("coupled", "weighted"):
        result = double.run(box, size, points=points, method=method, max_steps=5, options=clvoro.PaperOptions(tol=0))
        moved = result.points - box.wrap(points)
        assert np.abs(moved - np.rint(moved / box.extent) * box.extent).max() < 1e-12


def test_refinement_across_periodic_boundaries(double):
    """The midpoints of edges of a hexagonal lattice form the lattice of half the spacing."""
    points, edges, _ = hexagonal(6)
    box = clvoro.Box((0, 0), edges, periodic=True)
    size = (box.measure / 144) ** 0.5
    result = double.run(box, size, points=points, options=clvoro.MultilevelOptions(levels=1), max_steps=0)
    assert len(result.points) == 144
    assert (np.diff(result.diagram.neighbor_starts) == 6).all()
    assert np.abs(result.diagram.volumes * 144 / box.measure - 1).max() < 1e-12


def test_too_few_cells_for_a_run(double):
    with pytest.raises(FewCellsError, match="half a period"):
        double.run(UNIT, 0.5, method="coupled")


# Files, pictures, cases.


def test_one_cell_that_borders_on_itself(double):
    diagram = double.diagram(CUBE, [[0.1, 0.2, 0.3]])
    measures = measure_mesh(diagram)
    assert (diagram.neighbors == 0).all()
    assert np.abs(measures.skewness).max() < 1e-15
    assert measures.inner.all()
    assert (measures.volume_ratio == 1).all()


def test_a_wrong_shift_is_found(double):
    d = double.diagram(UNIT, some_points(UNIT, 30))
    names = [n for n in d._NAMES if not n.startswith("face_vert")]
    arrays = {name: getattr(d, name).copy() for name in names}
    k = int(np.flatnonzero(d.shifts[:, 0])[0])
    arrays["shifts"][k, 0] *= -1
    report = clvoro.mesh.results.Diagram(UNIT, arrays).check()
    assert not report
    assert "graph symmetric" in str(report)


def test_pictures_are_filled_up_to_the_boundary(double):
    """Images of cells cover the window; each position lies in one polygon."""
    from matplotlib.collections import PolyCollection
    from matplotlib.path import Path

    result = double.run(UNIT, 0.2, method="lloyd", max_steps=1)
    figure = result.plot("quality")
    (cells,) = (c for c in figure.axes[0].collections if isinstance(c, PolyCollection))
    places = np.random.default_rng(4).random((300, 2))
    covered = sum(Path(p.vertices).contains_points(places).astype(int) for p in cells.get_paths())
    assert (covered == 1).all()
    assert len(cells.get_paths()) > len(result.points)


def test_a_case():
    from clvoro.cli.cases import Case

    text = "size = 0.2\n[domain]\nlower = [0, 0]\nupper = [1, 1]\nperiodic = [true, true]\n"
    case = Case.from_toml(text, "wave")
    assert case.domain == Case.from_toml(case.text(), "wave").domain == UNIT
    with pytest.raises(InputError, match="periodic"):
        Case.from_toml(text.replace("[true, true]", "1"), "wave")


@pytest.mark.sparse(1)
@pytest.mark.parametrize("periodic", [(True, True), (True, False)])
@pytest.mark.parametrize("order", [1, 2])
def test_transfer_across_periodic_boundaries(adapter, periodic, order):
    """The transfer is conservative and bounded, and has the given order for a smooth periodic function."""
    box = clvoro.Box((0.5, -1.0), (2.5, 0.0), periodic=periodic)
    # Volumes of float32 meshes have single precision, and so do their sums.
    tight = 1e-12 if adapter.dtype == np.float64 else 1e-5
    rng = np.random.default_rng(2211)

    def mean_error(n: int) -> float:
        old, new = (adapter.diagram(box, rng.uniform(box.lower, box.upper, (n, 2))) for _ in range(2))

        def field(x: np.ndarray) -> np.ndarray:
            return np.sin(np.pi * (x[:, 0] - 0.5)) + np.cos(np.pi * x[:, 1]) ** 2

        values = field(old.centroids)
        got = old.transfer(values, onto=new, order=order)
        assert np.abs(old.transfer(np.ones(n), onto=new, order=order) - 1).max() < tight
        mass = values @ old.volumes
        assert got @ new.volumes == pytest.approx(mass, abs=tight * (np.abs(values) @ old.volumes))
        assert values.min() - 1e-12 <= got.min()
        assert got.max() <= values.max() + 1e-12
        return float(np.abs(got - field(new.centroids)) @ new.volumes / box.measure)

    # With four times the cells errors fall by 2 and by 4, less the effect of limiting and of random cells.
    assert mean_error(1200) < mean_error(300) / (1.6 if order == 1 else 2.4)


@pytest.mark.sparse(1)
def test_each_attempt_begins_with_the_previous_graph(adapter, monkeypatch):
    """A second attempt, after a halo that is too shallow, must not start from the graph of the first."""
    n, stages = 300, adapter._stages_for(SLAB)
    points, begun = some_points(SLAB, n), []
    x = stages.engine.upload(SLAB.place(points, adapter.dtype))
    tessellator = Tessellator(stages, SLAB)
    previous = tessellator.tessellate(x, n)
    rows = previous.starts.get(), previous.neighbors.get()[: previous.starts.get()[-1]]
    extend, unfold = GhostImages.extend, GhostImages.unfold

    def narrow(ghost_images, domain, points, n, halo, factor, grow, room):
        short = len(begun) < 3
        return extend(ghost_images, domain, points, n, halo, 0.4 if short else factor, grow and not short, room)

    def seen(ghost_images, images, graph):
        begun.append((graph.starts.get(), graph.neighbors.get()[: len(rows[1])]))
        assert all(map(np.array_equal, begun[-1], rows))  # before they are read: there would be other labels
        return unfold(ghost_images, images, graph)

    monkeypatch.setattr(Images, "update", lambda *_: None)
    monkeypatch.setattr(GhostImages, "extend", narrow)
    monkeypatch.setattr(GhostImages, "unfold", seen)
    again = tessellator.tessellate(x, n, previous)
    assert len(begun) > 3
    volumes = again.volumes.get() * SLAB.frame[1] ** 3
    stages.release()
    off = np.abs(volumes - adapter.diagram(SLAB, points).volumes)
    assert off.max() < ROUNDING[adapter.dtype.name] * volumes.mean()


@pytest.mark.sparse(1)
@pytest.mark.parametrize(("dim", "size"), [(3, "0.3"), (2, "0.15")])
def test_boxes_of_other_lengths_share_their_kernels(double, dim, size):
    """Kernels on folded rows in 2D have the periods built in; building these takes a second or so."""
    size, periodic = sizing.Expression(size), (True, False, True)[:dim]
    built = []
    for length in (1.53, 1.71):
        before = set(_program._programs)
        box = clvoro.Box((0,) * dim, (length, 1.5, 1.5)[:dim], periodic=periodic)
        double.run(box, size, method="adaptive", max_steps=3)
        built.append(set(_program._programs) - before)
    assert all(any(option.startswith("-DFOLD_0") for option in options) for *_, options in built[1])
    assert bool(built[1]) == (dim == 2)
