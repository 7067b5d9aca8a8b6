"""netCDF files by the MPAS mesh specification: its definitions, and the theory of C grids.

Tables are looked at one by one, as loops over what the file itself says; places are nearest images.
"""

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError
from tests.io.test_io import BOX, make_diagram
from tests.reference import netcdf_files
from tests.reference.netcdf_files import PLANE, made, read, result_of, shoelace

TABLES = {
    "cellsOnCell": ("nCells", "maxEdges"),
    "edgesOnCell": ("nCells", "maxEdges"),
    "verticesOnCell": ("nCells", "maxEdges"),
    "nEdgesOnCell": ("nCells",),
    "cellsOnEdge": ("nEdges", "TWO"),
    "verticesOnEdge": ("nEdges", "TWO"),
    "edgesOnEdge": ("nEdges", "maxEdges2"),
    "nEdgesOnEdge": ("nEdges",),
    "cellsOnVertex": ("nVertices", "vertexDegree"),
    "edgesOnVertex": ("nVertices", "vertexDegree"),
    "indexToCellID": ("nCells",),
    "indexToEdgeID": ("nEdges",),
    "indexToVertexID": ("nVertices",),
}
MEASURES = {
    **{
        f"{axis}{what}": (many,)
        for axis in ("x", "y", "z", "lat", "lon")
        for what, many in (("Cell", "nCells"), ("Edge", "nEdges"), ("Vertex", "nVertices"))
    },
    "areaCell": ("nCells",),
    "areaTriangle": ("nVertices",),
    "dvEdge": ("nEdges",),
    "dcEdge": ("nEdges",),
    "angleEdge": ("nEdges",),
    "meshDensity": ("nCells",),
    "kiteAreasOnVertex": ("nVertices", "vertexDegree"),
    "weightsOnEdge": ("nEdges", "maxEdges2"),
}


class Mesh:
    """The tables of a file with indices from 0, -1 for missing items, and rows without padding."""

    def __init__(self, path, name):
        self.name, self.file = name, read(path)
        sizes = self.file.dimensions
        self.n, self.e, self.v = sizes["nCells"], sizes["nEdges"], sizes["nVertices"]
        counts = {"OnCell": self["nEdgesOnCell"], "OnEdge": self["nEdgesOnEdge"]}
        for table in ("cellsOnCell", "edgesOnCell", "verticesOnCell", "edgesOnEdge"):
            rows = zip(self[table] - 1, counts[table[-6:]], strict=True)
            setattr(self, table, [row[:k].tolist() for row, k in rows])
        for table in ("cellsOnEdge", "verticesOnEdge"):
            setattr(self, table, (self[table] - 1).tolist())
        self.edgesOnVertex = [[e for e in row if e >= 0] for row in self["edgesOnVertex"] - 1]
        self.cellsOnVertex = (self["cellsOnVertex"] - 1).tolist()
        self.cell, self.edge, self.vertex = (
            np.stack([self[f"{axis}{what}"] for axis in "xy"], axis=1) for what in ("Cell", "Edge", "Vertex")
        )
        self.periods = np.array([self.file.attributes[f"{axis}_period"] for axis in "xy"])

    def __getitem__(self, name):
        return self.file[name]

    def away(self, a, b):
        """The way from a to the nearest image of b."""
        periods = np.where(self.periods > 0, self.periods, np.inf)
        d = np.asarray(b) - a
        return d - np.where(self.periods > 0, self.periods * np.rint(d / periods), 0)

    def normal(self, e):
        """The way between the cells at an edge, None on the boundary."""
        i, j = self.cellsOnEdge[e]
        return None if j < 0 else self.away(self.cell[i], self.cell[j])

    def sign(self, i, e):
        """1 if the normal of edge e points out of cell i, else -1."""
        return 1 if self.cellsOnEdge[e][0] == i else -1

    def kite(self, v, i):
        """Area of cell i that is a part of the triangle at v."""
        (k,) = (k for k, j in enumerate(self.cellsOnVertex[v]) if j == i)
        return self["kiteAreasOnVertex"][v, k]


@pytest.fixture(scope="module", params=PLANE)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def result(ctx, name):
    return made(ctx, name)


@pytest.fixture(scope="module")
def mesh(result, name, tmp_path_factory):
    path = tmp_path_factory.mktemp("mpas") / "mesh.nc"
    result.to_netcdf(path, convention="mpas")
    return Mesh(path, name)


def tight(mesh, reference=1.0):
    """Tolerance for sums of dozens of products of coordinates below 4."""
    return pytest.approx(reference, rel=0, abs=2e-13)


@pytest.mark.sparse(3)
def test_the_file_has_all_variables_of_the_specification(result, mesh):
    file, domain = mesh.file, result.diagram.domain
    assert file.attributes["on_a_sphere"] == b"NO"
    assert file.attributes["mesh_spec"] == b"1.0"
    assert file.attributes["sphere_radius"] == 0
    assert file.attributes["is_periodic"] == (b"YES" if any(domain.periodic) else b"NO")
    assert (mesh.periods == np.where(domain.periodic, domain.extent, 0)).all()
    for name, dimensions in {**TABLES, **MEASURES}.items():
        assert file.dimensions_of[name] == dimensions
        assert file[name].dtype == (np.int32 if name in TABLES else np.float64)
        assert np.isfinite(file[name]).all()
    assert file.dimensions["TWO"] == 2
    assert file.dimensions["maxEdges"] == file["nEdgesOnCell"].max()
    assert file.dimensions["maxEdges2"] == 2 * file.dimensions["maxEdges"]
    for what, count in (("Cell", mesh.n), ("Edge", mesh.e), ("Vertex", mesh.v)):
        assert file[f"indexTo{what}ID"].tolist() == list(range(1, count + 1))
        for axis in ("z", "lat", "lon"):
            assert not file[f"{axis}{what}"].any()
    assert np.array_equal(mesh.cell, result.points)
    density = result.target_size**-4.0
    np.testing.assert_allclose(file["meshDensity"], density / density.max(), rtol=1e-13)
    degree = 4 if "squares" in mesh.name else 3
    assert file.dimensions["vertexDegree"] == degree
    for table, missing in (("edgesOnVertex", 0), ("cellsOnVertex", 0), ("kiteAreasOnVertex", 0)):
        known = file["edgesOnVertex"] > 0
        assert (known[:, :-1] >= known[:, 1:]).all()
        assert (file[table][~known] == missing).all()
    for table in ("edgesOnEdge", "weightsOnEdge", "cellsOnCell", "edgesOnCell", "verticesOnCell"):
        counts = file["nEdgesOnEdge" if table.endswith("Edge") else "nEdgesOnCell"]
        assert not file[table][np.arange(file[table].shape[1]) >= counts[:, None]].any()


def test_coordinates_are_within_the_domain(result, mesh):
    domain = result.diagram.domain
    lower, upper = np.array(domain.lower), np.array(domain.upper)
    for places in (mesh.cell, mesh.edge, mesh.vertex):
        assert (places >= lower).all()
        assert ((places < upper) | (~np.array(domain.periodic) & (places <= upper))).all()


def test_euler_formula_holds(result, mesh):
    """Pieces minus holes; 0 on a torus or a ring."""
    expected = {"torus": 0, "channel": 0, "hexagons": 0, "squares without walls": 0, "shore, cut": 2, "torus, cut": -1}
    assert mesh.v - mesh.e + mesh.n == expected.get(mesh.name, 1)


def test_graph_is_the_diagrams(result, mesh):
    d, starts = result.diagram, result.diagram.neighbor_starts
    for i in range(mesh.n):
        row = slice(starts[i], starts[i + 1])
        kept = d.face_measures[row] > 0
        expected = np.maximum(d.neighbors[row], -1)[kept].tolist()
        assert sorted(mesh.cellsOnCell[i]) == sorted(expected)
    inner = (d.neighbors >= 0) & (d.face_measures > 0)
    walls = (d.neighbors < 0) & (d.face_measures > 0)
    assert mesh.e == inner.sum() // 2 + walls.sum()


def test_tables_agree(mesh):
    beside = [[] for _ in range(mesh.e)]
    for i in range(mesh.n):
        edges, k = mesh.edgesOnCell[i], len(mesh.edgesOnCell[i])
        assert len(set(edges)) == k
        for a in range(k):
            e, onward, vertex = edges[a], edges[(a + 1) % k], mesh.verticesOnCell[i][a]
            beside[e].append(i)
            assert sorted([i, mesh.cellsOnCell[i][a]]) == sorted(mesh.cellsOnEdge[e])
            # The vertex between an edge and the next one is an end of both.
            assert vertex in mesh.verticesOnEdge[e]
            assert vertex in mesh.verticesOnEdge[onward]
            assert i in mesh.cellsOnVertex[vertex]
    for e in range(mesh.e):
        first, second = mesh.cellsOnEdge[e]
        assert sorted(beside[e]) == sorted(j for j in (first, second) if j >= 0)
        assert second == -1 or first < second
        assert min(mesh.verticesOnEdge[e]) >= 0
        for v in mesh.verticesOnEdge[e]:
            assert mesh.edgesOnVertex[v].count(e) == 1
    for v, edges in enumerate(mesh.edgesOnVertex):
        cells, k = mesh.cellsOnVertex[v], len(edges)
        assert all(v in mesh.verticesOnEdge[e] for e in edges)
        is_open = any(mesh.cellsOnEdge[e][1] < 0 for e in edges)
        # The k-th cell lies between edges k and k + 1; at the boundary the last place is outside.
        assert sum(j >= 0 for j in cells) == k - is_open
        for a in range(k - is_open):
            assert cells[a] in mesh.cellsOnEdge[edges[a]]
            assert cells[a] in mesh.cellsOnEdge[edges[(a + 1) % k]]


@pytest.mark.sparse(3)
def test_edges_and_vertices_are_in_counter_clockwise_order(result, mesh):
    for i in range(mesh.n):
        corners = [mesh.away(mesh.cell[i], mesh.vertex[v]) for v in mesh.verticesOnCell[i]]
        assert shoelace(np.array(corners)) == tight(mesh, result.diagram.volumes[i])
    for v, edges in enumerate(mesh.edgesOnVertex):
        # Along the edges to their other vertices.
        angles = []
        for e in edges:
            (other,) = (w for w in mesh.verticesOnEdge[e] if w != v)
            x, y = mesh.away(mesh.vertex[v], mesh.vertex[other])
            angles.append(np.arctan2(y, x))
        steps = np.mod(np.diff([*angles, angles[0]]), 2 * np.pi)
        # One full turn.
        assert steps.sum() == pytest.approx(2 * np.pi, abs=1e-9)


@pytest.mark.sparse(3)
def test_normals_point_from_the_first_cell_to_the_second(mesh):
    for e in range(mesh.e):
        i, j = mesh.cellsOnEdge[e]
        a, b = mesh.verticesOnEdge[e]
        begin = mesh.away(mesh.cell[i], mesh.vertex[a])
        end = mesh.away(mesh.cell[i], mesh.vertex[b])
        along, angle = end - begin, mesh["angleEdge"][e]
        normal = np.array([np.cos(angle), np.sin(angle)])
        foot = mesh.away(mesh.cell[i], mesh.edge[e])
        assert mesh["dvEdge"][e] == tight(mesh, np.hypot(*along))
        # The distance of the removed generator, except off the bisector.
        if j < 0 and "cut" in mesh.name and along @ foot == tight(mesh, 0):
            assert foot + normal * mesh["dcEdge"][e] / 2 == tight(mesh, 2 * foot)
            continue
        if j < 0:
            assert mesh["dcEdge"][e] == pytest.approx(3**0.5 * mesh["dvEdge"][e], rel=1e-15)
            assert foot == tight(mesh, (begin + end) / 2)
            # The normal points outwards if the cell is on the left.
            assert normal @ (along[1], -along[0]) == tight(mesh, np.hypot(*along))
            continue
        line = mesh.normal(e)
        assert mesh["dcEdge"][e] == pytest.approx(np.hypot(*line), rel=1e-12)
        assert normal * np.hypot(*line) == tight(mesh, line)
        assert foot == tight(mesh, line / 2)
        # Orthogonal and right-handed.
        assert along @ line == tight(mesh, 0)
        assert line[0] * along[1] - line[1] * along[0] == tight(mesh, np.hypot(*along) * np.hypot(*line))


@pytest.mark.sparse(3)
def test_kites_are_the_parts_of_cells_and_triangles(result, mesh):
    kites, domain = mesh["kiteAreasOnVertex"], result.diagram.domain
    of_cells = np.zeros(mesh.n)
    for v, cells in enumerate(mesh.cellsOnVertex):
        edges = mesh.edgesOnVertex[v]
        for k, i in enumerate(cells):
            if i < 0:
                assert kites[v, k] == 0
                continue
            of_cells[i] += kites[v, k]
            # The kite: vertex, edge, generator, next edge.
            around = [
                mesh.away(mesh.vertex[v], place)
                for place in (mesh.edge[edges[k]], mesh.cell[i], mesh.edge[edges[(k + 1) % len(edges)]])
            ]
            assert kites[v, k] == tight(mesh, shoelace(np.array([(0, 0), *around])))
        assert mesh["areaTriangle"][v] == tight(mesh, kites[v].sum())
        if len(edges) == sum(i >= 0 for i in cells):
            # All kites of a vertex: the polygon of its generators.
            corners = [mesh.away(mesh.vertex[v], mesh.cell[i]) for i in cells if i >= 0]
            assert mesh["areaTriangle"][v] == tight(mesh, shoelace(np.array(corners)))
    np.testing.assert_allclose(of_cells, mesh["areaCell"], rtol=1e-13)
    np.testing.assert_allclose(mesh["areaCell"], result.diagram.volumes, rtol=1e-11)
    for areas in (mesh["areaCell"], mesh["areaTriangle"]):
        assert areas.sum() == pytest.approx(domain.measure, rel=1e-12)


# --- TRiSK ---


def slow_weights(mesh, e):
    """Other edges and their weights by the formula, around the first cell, then the second."""
    found = []
    for i in mesh.cellsOnEdge[e]:
        if i < 0:
            continue
        edges, vertices = mesh.edgesOnCell[i], mesh.verticesOnCell[i]
        k, at, passed = len(edges), mesh.edgesOnCell[i].index(e), 0.0
        for step in range(1, k):
            other = edges[(at + step) % k]
            passed += mesh.kite(vertices[(at + step - 1) % k], i) / mesh["areaCell"][i]
            weight = mesh.sign(i, e) * mesh.sign(i, other) * (0.5 - passed)
            found.append((other, weight * mesh["dvEdge"][other] / mesh["dcEdge"][e]))
    return found


def check_weights(mesh):
    """Weights are those of the formula."""
    for e in range(mesh.e):
        others, weights = zip(*slow_weights(mesh, e), strict=True)
        assert mesh.edgesOnEdge[e] == list(others)
        row = mesh["weightsOnEdge"][e, : len(others)]
        np.testing.assert_allclose(row, weights, rtol=1e-10, atol=1e-13 * np.abs(row).max())


@pytest.mark.sparse(3)
def test_weights_are_those_of_the_formula(mesh):
    check_weights(mesh)


def matrix(mesh):
    """The weights as a dense matrix (e, e)."""
    made = np.zeros((mesh.e, mesh.e))
    for e in range(mesh.e):
        for other, weight in zip(mesh.edgesOnEdge[e], mesh["weightsOnEdge"][e], strict=False):
            made[e, other] += weight
    return made


def check_energy(mesh):
    """Energy is conserved: W is antisymmetric in the inner product of velocities with the weights dv dc."""
    power = mesh["dvEdge"][:, None] * mesh["dcEdge"][:, None] * matrix(mesh)
    assert np.abs(power).max() > 0
    # Shares of an area sum to 1 up to round-off.
    assert np.abs(power + power.T).max() < 1e-14 * np.abs(power).max()


def test_the_coriolis_force_does_no_work(mesh):
    check_energy(mesh)


def check_divergence(mesh):
    """The flow out of a triangle by the rotated velocities is the mean over its kites of the flow out of the cells.

    So it is for any velocities (Ringler et al., J. Comput. Phys. 229 (2010) 3065, 2.5), and a flow without divergence
    has none when it is rotated: geostrophic balance stays steady.
    """
    u = np.random.default_rng(93).standard_normal(mesh.e)
    v = matrix(mesh) @ u
    divergence = np.zeros(mesh.n)
    for i, edges in enumerate(mesh.edgesOnCell):
        for e in edges:
            divergence[i] += mesh.sign(i, e) * u[e] * mesh["dvEdge"][e] / mesh["areaCell"][i]
    tested = 0
    for vertex, edges in enumerate(mesh.edgesOnVertex):
        cells = [i for i in mesh.cellsOnVertex[vertex] if i >= 0]
        if len(cells) < len(edges):
            continue
        # Tangential velocities cross the sides of the triangle, of length dc.
        out = [1 if mesh.verticesOnEdge[e][0] == vertex else -1 for e in edges]
        flows = [s * v[e] * mesh["dcEdge"][e] for s, e in zip(out, edges, strict=True)]
        expected = sum(mesh.kite(vertex, i) * divergence[i] for i in cells)
        assert sum(flows) == pytest.approx(expected, rel=0, abs=1e-12)
        tested += 1
    assert tested > 20


def test_divergence_of_the_rotated_flow_is_the_mean_of_the_cells(mesh):
    check_divergence(mesh)


@pytest.mark.parametrize("name", ["room", "torus"])
def test_balances_hold_in_single_precision(ctx, tmp_path, name):
    result = made(ctx, name, "float32")
    result.to_netcdf(tmp_path / "mesh.nc", convention="mpas")
    mesh = Mesh(tmp_path / "mesh.nc", name)
    # Round-off of corners is 2^-24 of the frame; cells are 0.1 wide.
    np.testing.assert_allclose(mesh["areaCell"], result.diagram.volumes, rtol=1e-4)
    kites = np.bincount(np.maximum(mesh["cellsOnVertex"].ravel() - 1, 0), mesh["kiteAreasOnVertex"].ravel())
    np.testing.assert_allclose(kites, mesh["areaCell"], rtol=1e-13)
    check_energy(mesh)
    check_divergence(mesh)


@pytest.mark.parametrize("name", ["shore", "slit"])
def test_coasts_that_cut_cells_are_refused_with_a_remedy_that_works(ctx, tmp_path, name):
    mesh = made(ctx, name)
    says = r"\(edges off the bisector of their cells: \d+, .*mesh\.subset\(polygon\) keeps"
    with pytest.raises(InputError, match=says):
        mesh.to_netcdf(tmp_path / "mesh.nc", convention="mpas")
    report = mesh.check(solver="mpas")
    assert report["edge off its bisector"].value > 0.01
    assert not report
    domain = mesh.diagram.domain
    box = clvoro.Box(np.subtract(domain.lower, 0.1), np.add(domain.upper, 0.1))
    points = netcdf_files.random_points(box, 300)
    kept = result_of(clvoro.Adapter(ctx).diagram(box, points)).subset(domain)
    assert np.array_equal(kept.points, points[domain.contains(points)])
    kept.to_netcdf(tmp_path / "mesh.nc", convention="mpas")
    assert read(tmp_path / "mesh.nc").dimensions["vertexDegree"] == 3


def test_three_cells_at_a_reentrant_corner_are_refused(ctx, tmp_path):
    corner = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)])
    diagram = clvoro.Adapter(ctx).diagram(corner, [(0.8, 0.8), (1.2, 0.8), (0.8, 1.2)])
    with pytest.raises(InputError, match=r"\(vertices with more edges: 1, the worst 4 at \(1, 1\)\)"):
        diagram.to_netcdf(tmp_path / "mesh.nc", convention="mpas")
    assert diagram.check(solver="mpas")["edges at a vertex"].count == 1


def test_faces_without_length_are_no_edges(tmp_path):
    """Four cells share a corner; the face between two of them has no length."""
    points = netcdf_files.grid(BOX, 5, 4)
    points += 1e-12 * np.random.default_rng(4).standard_normal(points.shape)
    diagram = make_diagram(points)
    ends = diagram.half_faces.ends
    assert (ends[:, 0] == ends[:, 1]).sum() > 10
    result_of(diagram).to_netcdf(tmp_path / "mesh.nc", convention="mpas")
    mesh = Mesh(tmp_path / "mesh.nc", "squares")
    assert {len(row) for row in mesh.cellsOnCell} == {4}
    assert mesh.file.dimensions["vertexDegree"] == 4
    assert (mesh.n, mesh.e, mesh.v) == (20, 49, 30)
    assert mesh["areaTriangle"].sum() == pytest.approx(BOX.measure, rel=1e-9)
    result_of(diagram).save(tmp_path / "mesh.nc")
    assert (read(tmp_path / "mesh.nc")["mesh_face_nodes"] >= 0).sum() == 80


def test_weights_of_regular_hexagons(ctx, tmp_path):
    """Thuburn et al.: 1/3, 1/6, 0, 1/6, 1/3 over the square root of 3, exact for constant flows."""
    made(ctx, "hexagons").to_netcdf(tmp_path / "mesh.nc", convention="mpas")
    mesh = Mesh(tmp_path / "mesh.nc", "hexagons")
    assert {len(row) for row in mesh.edgesOnEdge} == {10}
    expected = np.array([2, 1, 0, 1, 2] * 2) / 6 / 3**0.5
    for e, row in enumerate(mesh["weightsOnEdge"][:, :10]):
        i, j = mesh.cellsOnEdge[e]
        owners = [i] * 5 + [j] * 5
        signs = [mesh.sign(k, e) * mesh.sign(k, other) for k, other in zip(owners, mesh.edgesOnEdge[e], strict=True)]
        halves = np.array([1, 1, 0, -1, -1] * 2)
        assert row == pytest.approx(expected * halves * signs, abs=1e-14)
    angle = mesh["angleEdge"]
    for flow in ([1, 0], [0, 1], [0.3, -2]):
        across = np.cos(angle) * flow[0] + np.sin(angle) * flow[1]
        along = -np.sin(angle) * flow[0] + np.cos(angle) * flow[1]
        assert matrix(mesh) @ across == pytest.approx(along, abs=1e-13)
    np.testing.assert_allclose(mesh["kiteAreasOnVertex"], 3**0.5 / 12, rtol=1e-12)


# --- meshes that the specification excludes ---


def test_a_cell_around_an_island_is_refused(ctx, tmp_path):
    domain, points = netcdf_files.around_an_island()
    result = result_of(clvoro.Adapter(ctx).diagram(domain, points))
    with pytest.raises(InputError, match=r"mesh\.nc: cell 0 \(1 in all\) goes around"):
        result.to_netcdf(tmp_path / "mesh.nc", convention="mpas")
    assert not list(tmp_path.iterdir())
    result.save(tmp_path / "mesh.nc")


@pytest.mark.parametrize(
    ("periodic", "nx", "ny", "fits"),
    [
        (True, 1, 1, False),
        (True, 2, 5, False),
        (True, 5, 2, False),
        ((True, False), 3, 1, True),
        ((True, False), 2, 3, False),
        (True, 3, 3, True),
    ],
)
def test_places_half_a_period_away_are_refused(ctx, tmp_path, periodic, nx, ny, fits):
    box = clvoro.Box((0, 0), (2, 2), periodic=periodic)
    result = result_of(clvoro.Adapter(ctx).diagram(box, netcdf_files.grid(box, nx, ny)))
    if fits:
        result.to_netcdf(tmp_path / "mesh.nc", convention="mpas")
        mesh = Mesh(tmp_path / "mesh.nc", "few")
        assert (mesh.n, mesh["areaCell"].sum()) == (nx * ny, pytest.approx(4))
        return
    with pytest.raises(InputError, match=r"across a period of 2, .*use more cells"):
        result.to_netcdf(tmp_path / "mesh.nc", convention="mpas")
    result.save(tmp_path / "mesh.nc")
