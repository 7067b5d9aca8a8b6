"""Straight walls: chords, corners that faces meet, names that faces do not cross."""

import numpy as np
import pytest
import shapely

import clvoro
from clvoro import Polygon
from clvoro.errors import InputError
from clvoro.mesh.straightening import along_rings

SQUARE = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])
ELL = np.array([(0.0, 0), (1, 0), (1, 0.5), (0.5, 0.5), (0.5, 1), (0, 1)])


def circle(k: int, r: float, turned: float = 0.1) -> np.ndarray:
    angle = np.arange(k) * (2 * np.pi / k) + turned
    return 0.5 + r * np.column_stack([np.cos(angle), np.sin(angle)])


def adapt(ctx, domain, size=0.08, **options) -> clvoro.Result:
    return clvoro.Adapter(ctx).run(domain, size, effort="fast", **options)


def wall_faces(mesh) -> list:
    """The faces on walls: (owner, edge of the domain, first point, second point)."""
    walls = range(mesh.n_inner, mesh.n_outer)
    ends = mesh.points[mesh.corners.reshape(-1, 2)]
    return [(int(mesh.owner[f]), -1 - int(mesh.neighbor[f]), *ends[f]) for f in walls]


def polygons(mesh) -> list:
    """The cells, one after the other, from the points and faces alone."""
    sides = {i: {} for i in range(mesh.n_cells)}
    for f, (a, b) in enumerate(mesh.corners.reshape(-1, 2).tolist()):
        sides[mesh.owner[f]][a] = b
        if f < mesh.n_inner:
            sides[mesh.neighbor[f]][b] = a
    found = []
    for cell in sides.values():
        loop = [next(iter(cell))]
        while cell[loop[-1]] != loop[0]:
            loop.append(cell[loop[-1]])
        assert len(loop) == len(cell)
        found.append(shapely.Polygon(mesh.points[loop]))
    return found


def concave_by(polygon: shapely.Polygon) -> float:
    """Largest interior angle minus 180 degrees."""
    x = np.array(polygon.exterior.coords)[:-1]
    a, b = x - np.roll(x, 1, axis=0), np.roll(x, -1, axis=0) - x
    turns = np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
    return -np.degrees(turns.min())


@pytest.fixture(scope="module")
def ring(ctx) -> clvoro.Result:
    """A square with a circle of 90 edges."""
    return adapt(ctx, Polygon(SQUARE, [circle(90, 0.2)], names={"circle": range(4, 94)}))


def test_exact_walls_are_those_of_the_diagram(ring):
    mesh = ring.solver_mesh("exact", collapse=False)
    assert [p.area for p in polygons(mesh)] == pytest.approx(ring.diagram.volumes, abs=1e-13)
    assert mesh.area_change == 0
    assert len(mesh.owner) == len(ring.diagram.faces)
    with pytest.raises(InputError, match="walls is 'round', expected"):
        ring.solver_mesh("round")


def test_cells_on_a_circle_have_one_straight_face_there(ring, tmp_path):
    mesh = ring.solver_mesh()
    on_circle = [face for face in wall_faces(mesh) if face[1] >= 4]
    assert len({face[0] for face in on_circle}) == len(on_circle)
    assert len(ring.solver_mesh("exact").owner) > len(mesh.owner)
    cells = polygons(mesh)
    assert max(concave_by(p) for p in cells) < 1e-9
    # Chords are inside of the circle: the domain grows by the segments between chord and boundary.
    edges = [shapely.LineString([a, b]) for _, _, a, b in on_circle]
    loop = shapely.polygonize(edges).geoms[0]
    grown = shapely.Polygon(circle(90, 0.2)).area - loop.area
    assert grown > 1e-4
    assert mesh.area_change == pytest.approx(grown / ring.diagram.domain.measure, rel=1e-9)
    assert sum(p.area for p in cells) == pytest.approx(1 - loop.area, rel=1e-12)
    assert f"area {100 * mesh.area_change:+.2g} %" in repr(mesh)
    ring.save(tmp_path / "polyMesh")
    noted = f"straight walls change the area by {100 * mesh.area_change:+.3g} %"
    assert noted in (tmp_path / "polyMesh" / "points").read_text()


def test_cells_do_not_overlap(ring):
    cells = polygons(ring.solver_mesh())
    tree = shapely.STRtree(cells)
    for i, j in tree.query(cells, predicate="overlaps").T:
        assert cells[i].intersection(cells[j]).area < 1e-14


def test_a_single_cell_is_the_domain(ctx):
    mesh = clvoro.Adapter(ctx).diagram(Polygon(ELL), np.array([(0.4, 0.4)])).solver_mesh()
    assert [p.equals(shapely.Polygon(ELL)) for p in polygons(mesh)] == [True]


@pytest.mark.filterwarnings("ignore::clvoro.errors.MismatchWarning")
def test_a_corner_without_a_face_end_is_filled(ctx):
    diagram = clvoro.Adapter(ctx).diagram(Polygon(ELL), np.array([(0.4, 0.4), (0.1, 0.9), (0.9, 0.1)]))
    mesh = diagram.solver_mesh(collapse=False)
    assert max(map(concave_by, polygons(mesh))) < -0.1
    assert mesh.area_change > 0


@pytest.mark.parametrize("rise", [0, 0.01, 0.05])
def test_a_cell_in_whose_wall_a_name_ends_is_convex(ctx, rise):
    """OpenFOAM counts a cell as concave if two of its faces are in one plane."""
    domain = Polygon([(0, 0), (1.4, rise), (3, 0), (3, 3), (0, 3)], names={"west": [0]})
    x, y = np.meshgrid([0.5, 1.5, 2.5], [0.5, 1.5, 2.5])
    points = np.column_stack([x.ravel(), y.ravel()]) + np.random.default_rng(3).uniform(-0.05, 0.05, (9, 2))
    diagram = clvoro.Adapter(ctx).diagram(domain, points)
    mesh = diagram.solver_mesh()
    west = mesh.points[mesh.corners.reshape(-1, 2)[mesh.neighbor == -1]]
    assert west[:, :, 0].max() == pytest.approx(1.4, abs=0.1 * rise + 1e-9)
    assert max(map(concave_by, polygons(mesh))) < -1e-3
    assert mesh.area_change == pytest.approx(0, abs=1e-5 + rise / 50)
    assert diagram.check(solver="openfoam")


def test_faces_do_not_cross_from_one_name_to_another(ctx):
    domain = Polygon(circle(64, 0.4), names={"in": range(20), "out": range(30, 64)})
    mesh = adapt(ctx, domain).solver_mesh()
    changes = domain.vertices[[0, 20, 30]]
    ends = np.array([face[2:] for face in wall_faces(mesh)]).reshape(-1, 2)
    for place in changes:
        assert np.linalg.norm(ends - place, axis=1).min() == 0
    for _, edge, a, b in wall_faces(mesh):
        middle = (a + b) / 2 - 0.5
        angle = (np.arctan2(middle[1], middle[0]) - 0.1) % (2 * np.pi) / (2 * np.pi) * 64
        assert (edge < 20, edge < 30) == (angle < 20, angle < 30)
    one = adapt(ctx, Polygon(circle(64, 0.4))).solver_mesh()
    ends = np.array([face[2:] for face in wall_faces(one)]).reshape(-1, 2)
    assert min(np.linalg.norm(ends - place, axis=1).min() for place in changes) > 0


def test_a_rough_coast_becomes_smooth(ctx):
    """Boundaries with ten edges per cell that turn to and fro."""
    rng = np.random.default_rng(5)
    shore = circle(400, 0.4)
    shore = 0.5 + (shore - 0.5) * (1 + 0.01 * rng.standard_normal(400))[:, None]
    result = adapt(ctx, Polygon(shore))
    mesh = result.solver_mesh()
    cells = polygons(mesh)
    assert min(p.area for p in cells) > 0
    assert max(map(concave_by, cells)) < 1e-9
    assert abs(mesh.area_change) < 0.02
    assert len(wall_faces(mesh)) < 2 * len({face[0] for face in wall_faces(mesh)})


def test_points_on_curved_walls_lie_on_the_curves(ctx):
    """A wing section with a sharp trailing edge, an ellipse, and a rounded corner."""
    wing = clvoro.curves.naca("0012", 1.0, (0, 0), 5)
    oval = clvoro.curves.ellipse((0.5, 0.7), (0.4, 0.1))
    outer = [(-1, -1), (2, -1), clvoro.curves.arc((1.5, 1), 0.5, 0, 90), (-1, 1.5)]
    domain = Polygon(outer, [wing, oval])
    size = clvoro.sizing.Distance([wing, oval], 0.04, slope=0.2, h_max=0.2)
    result = adapt(ctx, domain, size)
    ends = np.array([face[2:] for face in wall_faces(result.solver_mesh())]).reshape(-1, 2)
    edges = domain.nearest_edge(ends)[0]
    assert np.abs(domain.on_curve(ends, edges) - ends).max() < 1e-12
    assert set(domain.curved_edges.curve[edges].tolist()) == {-1, 0, 1, 2}
    tip = domain.vertices[domain.ring_starts[1]]
    # Beside the tip no generators are at equal distances, and it may be cut off.
    assert np.hypot(*(ends - tip).T).min() < 0.05 * 0.04
    assert result.solver_mesh("exact", collapse=False).area_change == 0


@pytest.mark.slow
def test_the_change_of_area_is_of_second_order(ctx):
    """Cells beside a circle: chords between points on the circle."""
    disc = clvoro.curves.circle((0.5, 0.5), 0.4)
    changes = []
    for h in (0.1, 0.05, 0.025):
        mesh = adapt(ctx, Polygon(disc), h).solver_mesh()
        assert max(map(concave_by, polygons(mesh))) < 1e-9
        area = sum(p.area for p in polygons(mesh))
        changes.append(1 - area / (np.pi * 0.4**2))
    order = np.log2(np.array(changes[:-1]) / changes[1:])
    assert order == pytest.approx(2, abs=0.3)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("name", ["solid", "plane"])
def test_vtu_files_hold_solver_meshes(request, ctx, tmp_path, name):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    if name == "plane":
        result = request.getfixturevalue("ring")
    else:
        result = clvoro.Adapter(ctx).run(clvoro.Box((0, 0, 0), (1, 1, 1)), 0.2, effort="fast")
    result.to_vtu(tmp_path / "exact.vtu", walls="exact")
    result.save(tmp_path / "mesh.vtu")
    assert (tmp_path / "mesh.vtu").read_bytes() == (tmp_path / "exact.vtu").read_bytes()
    result.to_vtu(tmp_path / "mesh.vtu", walls="straight", cell_data={"mine": result.quality})
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(tmp_path / "mesh.vtu"))
    sizes = vtk.vtkCellSizeFilter()
    sizes.SetInputConnection(reader.GetOutputPort())
    sizes.Update()
    grid = sizes.GetOutput()
    data = {
        key: vtk_to_numpy(grid.GetCellData().GetArray(key)) for key in ("volume", "error", "mine", "Area", "Volume")
    }
    mesh = result.solver_mesh()
    measured = data["Area" if name == "plane" else "Volume"]
    # In 3D faces are slightly warped, and VTK divides them into other triangles than OpenFOAM.
    assert measured == pytest.approx(data["volume"], rel=1e-6 if name == "plane" else 5e-3)
    assert data["volume"].sum() == pytest.approx(result.diagram.domain.measure * (1 + mesh.area_change))
    assert (data["error"] == result.size_error).all()
    assert (data["mine"] == result.quality).all()
    assert grid.GetNumberOfPoints() == len(mesh.points)
    with pytest.raises(InputError, match="holds the mesh for solvers, which is no diagram"):
        clvoro.load(tmp_path / "mesh.vtu")


def test_other_formats_have_exact_walls(ring, tmp_path):
    for name, walls in (("mesh.npz", "exact"), ("mesh.nc", "straight"), ("mesh.vtk", "exact")):
        with pytest.raises(InputError, match=r"with walls, which is for OpenFOAM and \.vtu; save as \.foam or"):
            clvoro.io.write(ring, tmp_path / name, walls=walls)
    with pytest.raises(InputError, match="walls is 'round', expected one of straight, exact"):
        ring.to_vtu(tmp_path / "mesh.vtu", walls="round")
    assert not list(tmp_path.iterdir())


def test_a_large_change_of_the_area_gives_a_warning():
    """Six cells in a disc."""
    disc = clvoro.Polygon(clvoro.curves.circle((0, 0), 1))
    angle = np.arange(6) * (np.pi / 3)
    cells = clvoro.voronoi(disc, 0.5 * np.column_stack([np.cos(angle), np.sin(angle)]))
    with pytest.warns(clvoro.errors.MismatchWarning, match=r"changes the area of the domain by -4\.\d %"):
        mesh = cells.solver_mesh()
    assert mesh.area_change < -0.04
    cells.solver_mesh(walls="exact")  # no warning


def test_rings_of_many_edges_are_closed(ctx):
    """Edges times vertices exceed the range of int32."""
    domain = Polygon(circle(50_000, 1.0))
    points = np.random.default_rng(3).random((50, 2))
    diagram = clvoro.Adapter(ctx).diagram(domain, points)
    onward = along_rings(diagram, domain)
    walls = np.flatnonzero(diagram.neighbors < 0)
    np.testing.assert_array_equal(np.sort(onward[walls]), walls)


def test_the_two_sides_of_a_thin_wall_keep_their_cells_apart(ctx):
    """Faces end on the side that their cells see, so that nothing is lost."""
    square = clvoro.Polygon([(0, 0), (0.995, 0), (1, 1), (1.005, 0), (2, 0), (2, 2), (0, 2)])
    mesh = clvoro.Adapter(ctx).run(square, 0.15, "fast").solver_mesh()
    assert mesh.area_change == 0
    assert len(np.unique(mesh.corners)) == len(mesh.points)  # OpenFOAM refuses points that no face has
