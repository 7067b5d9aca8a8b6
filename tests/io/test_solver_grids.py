"""Grids for other solvers: MODFLOW 6's DISV, FiPy, and names of boundaries in VTU."""

import itertools
import math
import sys

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg
import scipy.special

import clvoro
from clvoro import sizing
from clvoro.errors import ClvoroError, InputError
from clvoro.io.contents import Contents
from clvoro.io.vtu import cell_data

LAKE = clvoro.Polygon(
    [(0, 0), (2, 0.1), (2.2, 1.2), (1, 1.6), (-0.1, 1)],
    [[(0.7, 0.5), (1.4, 0.6), (0.9, 1.0)]],
    names={"inlet": [4], "island": "hole-1"},
)


@pytest.fixture(scope="module")
def lake():
    size = sizing.Distance(LAKE.boundary("island"), h_min=0.07, slope=0.2, h_max=0.15)
    return clvoro.adapt(LAKE, size, "fast")


def modflow_connections(disv):
    """Return length and distances of each connection as MODFLOW computes them from a DISV grid, and the other edges.

    Cells are connected that share two consecutive vertices; the distances are those of the cell centers from the line
    through both (MODFLOW 6, `DisvGeom`).
    """
    props = disv.gridprops
    x = {k: np.array(p) for k, *p in props["vertices"]}
    assert list(x) == list(range(props["nvert"]))
    edges = {}
    for i, *center, count, corners in ((*c[:4], c[4:]) for c in props["cell2d"]):
        assert len(corners) == count == len(set(corners))
        for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
            edges.setdefault(frozenset((a, b)), []).append((i, np.array(center), a, b))
    found, single = {}, []
    for sides in edges.values():
        length, distances = None, []
        for _, center, a, b in sides:
            along = x[b] - x[a]
            length = math.hypot(*along)
            off = center - x[a]
            distances.append(abs(along[0] * off[1] - along[1] * off[0]) / length)
        if len(sides) == 2:
            (i, _, a, b), (j, _, c, d) = sides
            assert (a, b) == (d, c)  # opposite ways
            found[min(i, j), max(i, j)] = length, sum(distances)
        else:
            assert len(sides) == 1
            single.append((sides[0][0], length, distances[0]))
    return found, single


@pytest.mark.sparse(1)
@pytest.mark.parametrize("walls", ["exact", "straight"])
def test_modflow_finds_the_conductances_of_the_diagram(lake, walls):
    disv, d = lake.to_disv(walls), lake.diagram
    connections, outer = modflow_connections(disv)
    f = d.faces
    k = f.n_inner
    # Faces as short as round-off are left out.
    faces = np.flatnonzero(f.area[:k] > 1e-12)
    expected = dict(zip(zip(f.owner[faces], f.neighbor[faces], strict=True), faces, strict=True))
    assert connections.keys() == expected.keys()
    on_wall, cut = set(f.owner[k:].tolist()), 0
    for (i, j), (length, distance) in connections.items():
        face = expected[i, j]
        along = f.normal[face] @ (d.points[j] - d.points[i])
        if along < (1 - 1e-9) * f.distance[face]:
            cut += 1  # by the boundary at a re-entrant corner, and not on the bisector
        else:
            turned = walls == "straight" and bool({i, j} & on_wall)  # a face with a moved end
            assert distance == pytest.approx(f.distance[face], rel=0.15 if turned else 1e-6)
        if walls == "exact" or not {i, j} & on_wall:
            assert length == pytest.approx(f.area[face], rel=1e-6, abs=1e-12)
    assert cut <= 2
    # The boundaries by name are the other edges.
    named = [
        item for b in disv.boundaries.values() for item in zip(b.cells.tolist(), b.lengths, b.distances, strict=True)
    ]
    assert len(named) == len(outer)
    if walls == "exact":
        pairs = list(zip(sorted(named), sorted(outer), strict=True))
        assert all(mine[:2] == pytest.approx(theirs[:2], rel=1e-6) for mine, theirs in pairs)
        # At a re-entrant corner the line of an edge may pass behind the center.
        other = [mine for mine, theirs in pairs if mine[2] != pytest.approx(theirs[2], rel=1e-6)]
        assert len(other) <= 2
        assert all(distance > 0 for *_, distance in other)


def test_cells_are_clockwise_and_have_their_areas(lake):
    disv = lake.to_disv("exact")
    x, starts = disv.vertices[disv.cell_vertices], disv.cell_vertex_starts
    for i, (a, b) in enumerate(itertools.pairwise(starts)):
        p, q = x[a:b], np.roll(x[a:b], -1, axis=0)
        area = (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum() / 2
        assert area == pytest.approx(-lake.diagram.volumes[i])
    assert np.array_equal(disv.centers, lake.points)


def test_faces_in_a_row_as_short_as_round_off_are_left_out():
    """Generators on a circle up to round-off have many vertices in its center."""
    angle = 2 * np.pi * np.arange(12) / 12 + 0.1
    ring = 0.5 + 0.3 * np.column_stack([np.cos(angle), np.sin(angle)])
    ring += np.random.default_rng(9).uniform(-1e-14, 1e-14, ring.shape)
    diagram = clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), ring)
    disv = diagram.to_disv()
    assert len(disv.cell_vertices) < len(diagram.cell_vertices)
    areas, lengths = [], []
    for corners in np.split(disv.cell_vertices, disv.cell_vertex_starts[1:-1]):
        p, q = disv.vertices[corners], disv.vertices[np.roll(corners, -1)]
        areas.append((p[:, 1] * q[:, 0] - p[:, 0] * q[:, 1]).sum() / 2)
        lengths.extend(np.hypot(*(q - p).T))
    np.testing.assert_allclose(areas, diagram.volumes, rtol=1e-11)
    assert min(lengths) > 0


@pytest.mark.slow
def test_faces_of_no_length_at_curved_walls_are_left_out(ctx):
    """Corners of layers that move onto the curve can pass each other by a millionth of a cell."""
    pipe = clvoro.curves.circle((0.2, 0.2), 0.05, name="pipe")
    domain = clvoro.Polygon([(0, 0), (2.2, 0), (2.2, 0.41), (0, 0.41)], [pipe])
    layers = clvoro.Layers(0.001, count=5, growth=1.2, spacing=0.003, edges="pipe")
    mesh = clvoro.Adapter(ctx).run(domain, 0.05, "fast", layers=layers)
    assert mesh.check(solver="modflow")["angle to the normal"].ok


def test_boundaries_have_names_cells_and_lengths(lake):
    disv, d = lake.to_disv(), lake.diagram
    assert tuple(disv.boundaries) == d.domain.boundary_names
    assert disv.boundaries["inlet"].lengths.sum() == pytest.approx(math.hypot(0.1, 1))
    for k, (name, b) in enumerate(disv.boundaries.items()):
        faces = d.faces.boundary == k
        assert set(b.cells) <= set(d.faces.owner[faces].tolist()), name
        assert np.array_equal(b.cells, np.sort(b.cells))
        assert b.conductance(2.0) == pytest.approx(2 * b.lengths / b.distances)
    with pytest.raises(InputError, match="boundaries has no 'inlt', expected the name of a boundary: inlet, "):
        disv.boundaries["inlt"]
    feet = disv.boundaries["inlet"].feet
    assert np.abs(feet[:, 0] * 1 + feet[:, 1] * 0.1).max() < 1e-12  # on the line from (-0.1, 1) to (0, 0)


def test_lines_inside_have_cells_that_are_connected():
    """Four cells meet in points on a line. Far from the origin some of them have faces as short as round-off."""
    ground = clvoro.Box((5e6, 5e6), (5e6 + 1000, 5e6 + 1000)).with_lines(
        [[(5e6 + 100, 5e6 + 400), (5e6 + 900, 5e6 + 600)]]
    )
    mesh = clvoro.adapt(ground, 60, "fast")
    disv = mesh.to_disv()
    assert len(disv.lines) < len(mesh.diagram.border_faces)
    connections = modflow_connections(disv)[0]
    lengths = [connections[i, j][0] for i, j in disv.lines.tolist()]
    assert sum(lengths) == pytest.approx(math.hypot(800, 200), rel=0.05)


def test_flopy_takes_the_grid(lake, tmp_path):
    flopy = pytest.importorskip("flopy")
    disv = lake.to_disv()
    river = disv.boundaries["inlet"]
    sim = flopy.mf6.MFSimulation(sim_ws=tmp_path)
    flopy.mf6.ModflowTdis(sim)
    flopy.mf6.ModflowIms(sim)
    gwf = flopy.mf6.ModflowGwf(sim)
    flopy.mf6.ModflowGwfdisv(gwf, nlay=2, top=10, botm=[5, 0], **disv.gridprops)
    flopy.mf6.ModflowGwfghb(
        gwf, stress_period_data=[((0, i), 9.0, c) for i, c in zip(river.cells, river.conductance(1e-3), strict=True)]
    )
    sim.write_simulation(silent=True)
    again = flopy.mf6.MFSimulation.load(sim_ws=tmp_path, verbosity_level=0).get_model()
    grid = again.modelgrid
    assert (grid.nlay, grid.ncpl) == (2, len(lake.points))
    centers = np.column_stack([grid.xcellcenters, grid.ycellcenters])
    np.testing.assert_allclose(centers, lake.points, atol=1e-7)  # FloPy writes eight digits
    assert again.disv.nvert.data == len(disv.vertices)
    records = again.ghb.stress_period_data.data[0]
    assert [cell for _, cell in records["cellid"]] == river.cells.tolist()
    np.testing.assert_allclose(records["cond"], river.conductance(1e-3), rtol=1e-7)


@pytest.mark.slow
def test_drawdown_of_a_well_is_that_of_theis():
    """A confined aquifer, discretized as MODFLOW does it: from vertices and centers of the DISV grid only."""
    radius, transmissivity, storage, pumping = 3000.0, 5e-3, 2e-4, 0.02
    angle = np.arange(60) * (2 * np.pi / 60)
    domain = clvoro.Polygon(radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    size = sizing.Distance(sizing.Circle((0, 0), 1), h_min=2, slope=0.15, h_max=300)
    disv = clvoro.adapt(domain, size, "fast").to_disv()
    connections, _ = modflow_connections(disv)
    i, j = np.array(list(connections)).T
    c = transmissivity * np.array([length / distance for length, distance in connections.values()])
    n = len(disv.centers)
    upper = scipy.sparse.coo_array((c, (i, j)), (n, n))
    flow = (scipy.sparse.diags_array((upper + upper.T).sum(axis=1)) - upper - upper.T).tocsc()
    x = disv.vertices[disv.cell_vertices]
    after = np.concatenate([np.roll(np.arange(a, b), -1) for a, b in itertools.pairwise(disv.cell_vertex_starts)])
    cell = np.repeat(np.arange(n), np.diff(disv.cell_vertex_starts))
    twice = x[after, 0] * x[:, 1] - x[after, 1] * x[:, 0]
    areas = np.bincount(cell, twice, n) / 2
    r = np.hypot(*disv.centers.T)
    source = np.zeros(n)
    source[r.argmin()] = pumping
    well = disv.centers[r.argmin()]
    r = np.hypot(*(disv.centers - well).T)
    drawdown, time, end = np.zeros(n), 0.0, 4 * 3600.0
    for step in np.diff(end * np.linspace(0, 1, 121) ** 3):  # short steps first
        capacity = scipy.sparse.diags_array(storage * areas / step)
        right = source + storage * areas / step * drawdown
        drawdown = scipy.sparse.linalg.spsolve((flow + capacity).tocsc(), right)
        time += step
    theis = scipy.special.exp1(r**2 * storage / (4 * transmissivity * time))
    theis *= pumping / (4 * np.pi * transmissivity)
    seen = (r > 10) & (r < 1500)
    assert seen.sum() > 500
    assert np.abs(drawdown - theis)[seen].max() < 0.01 * theis[r > 10].max()


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dim", [2, 3])
def test_fipy_has_the_generators_and_volumes(dim):
    fipy = pytest.importorskip("fipy")
    if dim == 2:
        domain = clvoro.Polygon([(0, 0), (2, 0.1), (2.2, 1.2), (-0.1, 1)], names={"inlet": [3]})
    else:
        domain = clvoro.Box((0, 0, 0), (1, 1, 1), names={"inlet": "xMin"})
    result = clvoro.adapt(domain, 0.2, "fast")
    mesh, d = result.to_fipy("exact"), result.diagram
    np.testing.assert_allclose(mesh.cellCenters.value, d.points.T)
    np.testing.assert_allclose(mesh.cellVolumes, d.volumes, rtol=1e-9)
    names = d.domain.boundary_names
    assert tuple(mesh.physicalFaces) == names
    on = [int(mesh.physicalFaces[name].value.sum()) for name in names]
    assert on == [int((d.faces.boundary == k).sum()) for k in range(len(names))]
    assert np.array_equal(sum(m.value for m in mesh.physicalFaces.values()), mesh.exteriorFaces)
    # A linear function is a solution to round-off, and so is its integral over a boundary.
    phi = fipy.CellVariable(mesh=mesh)
    slope = np.arange(1.0, dim + 1)
    x = mesh.faceCenters.value
    phi.constrain(slope @ x, mesh.exteriorFaces)
    fipy.DiffusionTerm(1.0).solve(phi, solver=fipy.LinearLUSolver())
    np.testing.assert_allclose(phi.value, d.points @ slope, atol=1e-9)
    flux = (phi.faceGrad.value * np.asarray(mesh.faceNormals)).sum(axis=0) * mesh._faceAreas
    inlet = mesh.physicalFaces["inlet"].value
    expected = ((slope @ np.asarray(mesh.faceNormals)) * mesh._faceAreas)[inlet].sum()
    assert flux[inlet].sum() == pytest.approx(expected, rel=1e-6)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dim", [2, 3])
def test_faces_of_fipy_close_each_cell(dim):
    """Also at re-entrant corners, and whatever cell FiPy calls the first of a face."""
    fipy = pytest.importorskip("fipy")
    domain = clvoro.Box((0, 0, 0), (1, 1, 1)) if dim == 3 else LAKE
    result = clvoro.adapt(domain, 0.25, "fast")
    mesh = result.to_fipy()
    slope = np.arange(1.0, dim + 1)
    constant = fipy.CellVariable(mesh=mesh, value=1.0)
    np.testing.assert_allclose(constant.grad.value, 0, atol=1e-11)
    linear = fipy.CellVariable(mesh=mesh, value=result.points @ slope)
    linear.constrain(slope @ mesh.faceCenters.value, mesh.exteriorFaces)
    off = np.abs(linear.grad.value - slope[:, None])
    # Of 64 cells most are on walls, where FiPy's gradient is of first order: 0.12 in 3D. A wrong sign gives 1 and more.
    assert np.median(off) < 0.2
    # The sum over all cells is the sum over the boundary.
    total = (linear.grad.value * mesh.cellVolumes).sum(axis=1)
    expected = slope * mesh.cellVolumes.sum()
    np.testing.assert_allclose(total, expected, rtol=0.1)


def test_fipy_orders_the_faces_of_cells(lake):
    pytest.importorskip("fipy")
    mesh = lake.to_fipy()
    corners = mesh._orderedCellVertexIDs
    for i in range(len(lake.points)):
        x = mesh.vertexCoords[:, np.ma.compressed(np.ma.asarray(corners)[:, i])].T
        y = np.roll(x, -1, axis=0)
        area = (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum() / 2
        assert area == pytest.approx(mesh.cellVolumes[i], rel=1e-9)


def test_a_missing_fipy_is_named(lake, monkeypatch):
    for name in [n for n in sys.modules if n == "fipy" or n.startswith(("fipy.", "clvoro.io.fipy"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "fipy", None)
    with pytest.raises(ClvoroError, match=r"needs FiPy.*clvoro\[solvers\]"):
        lake.to_fipy()


def test_grids_that_solvers_lack_are_refused():
    cube = clvoro.voronoi(clvoro.Box((0, 0, 0), (1, 1, 1)), [(0.2, 0.5, 0.5), (0.7, 0.5, 0.5)])
    with pytest.raises(InputError, match=r"layers of cells in the plane, and Box.* is in 3D"):
        cube.to_disv()
    torus = clvoro.voronoi(clvoro.Box((0, 0), (1, 1), periodic=(True, False)), [(0.2, 0.5), (0.7, 0.5)])
    with pytest.raises(InputError, match="no periodic sides"):
        torus.to_disv()
    with pytest.raises(InputError, match="walls is 'round'"):
        cube.solver_mesh("round")
    alone = clvoro.voronoi(LAKE, [(0.1, 0.8)])
    with pytest.raises(InputError, match=r"cell 0 \(1 in all\) goes around a part of the boundary"):
        alone.to_disv(walls="exact")


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dim", [2, 3])
def test_fipy_joins_the_sides_of_periodic_boxes(dim):
    """The mean of cos(2 pi x) decays at its rate, and constants have no gradient."""
    fipy = pytest.importorskip("fipy")
    box = clvoro.Box((0,) * dim, (1,) * dim, periodic=(True, False, True)[:dim])
    result = clvoro.adapt(box, 0.15, "fast")
    d, mesh = result.diagram, result.to_fipy()
    assert mesh.numberOfFaces == len(d.faces)
    assert int(mesh.exteriorFaces.value.sum()) == int((d.faces.neighbor < 0).sum())
    np.testing.assert_allclose(mesh.cellVolumes, d.volumes, rtol=1e-9)
    constant = fipy.CellVariable(mesh=mesh, value=1.0)
    np.testing.assert_allclose(constant.grad.value, 0, atol=1e-11)
    # The matrix of a step, against that of the diagram.
    u0 = np.cos(2 * np.pi * result.points[:, 0])
    u = fipy.CellVariable(mesh=mesh, value=u0)
    (fipy.TransientTerm() == fipy.DiffusionTerm(1.0)).solve(u, dt=0.01, solver=fipy.LinearLUSolver())
    f = d.faces
    k, n = f.n_inner, len(d)
    matrix = np.diag(d.volumes / 0.01)
    for i, j, a in zip(f.owner, f.neighbor, f.area[:k] / f.distance[:k]):  # noqa: B905
        matrix[i, i] += a
        matrix[j, j] += a
        matrix[i, j] -= a
        matrix[j, i] -= a
    expected = np.linalg.solve(matrix, d.volumes / 0.01 * u0)
    assert n == len(u.value)
    np.testing.assert_allclose(u.value, expected, atol=1e-9)


@pytest.mark.parametrize("walls", ["exact", "straight"])
def test_vtu_has_the_names_of_boundaries(lake, tmp_path, meshio_for_vtu, walls):
    lake.to_vtu(tmp_path / "lake.vtu", walls=walls)
    read = meshio_for_vtu.read(tmp_path / "lake.vtu").cell_data
    assert {name for name in read if name.startswith("boundary:")} == {"boundary:inlet", "boundary:island"}
    label = np.concatenate(read["label"])
    if walls == "exact":
        f = lake.diagram.faces
        owner, part = f.owner, f.boundary
    else:
        mesh = lake.solver_mesh()
        owner = mesh.owner
        part = np.where(mesh.neighbor < 0, LAKE.boundary_index[np.maximum(-1 - mesh.neighbor, 0)], -1)
    for name in ("inlet", "island"):
        marked = label[np.concatenate(read[f"boundary:{name}"]) == 1]
        assert set(marked) == set(owner[part == LAKE.boundary_names.index(name)].tolist())


def test_named_cells_in_3d():
    box = clvoro.Box((0, 0, 0), (1, 1, 1), names={"inlet": "xMin"})
    d = clvoro.voronoi(box, np.random.default_rng(0).random((50, 3)))
    data = cell_data(Contents.of(d))
    touching = [i for i in range(50) if -1 in d.cell(i).neighbors]
    assert np.flatnonzero(data["boundary:inlet"]).tolist() == touching
    assert [name for name in data if name.startswith("boundary:")] == ["boundary:inlet"]
