"""Polygonal domains on the host: checks, measures, files, pictures, transfer."""

import dataclasses
import json
import warnings

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.cli import command as cli
from clvoro.errors import InputError, InputTypeError
from clvoro.geometry.polygon import Polygon
from clvoro.io.vtu_read import load_vtu
from clvoro.mesh.straightening import count_sides
from tests.io import test_foam
from tests.mesh.test_check import add, put, spoilt, swap
from tests.reference.shores import spit, star

SQUARE = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])
ROUND = np.array([(np.cos(t), np.sin(t)) for t in np.arange(12) * np.pi / 6])


def bay() -> Polygon:
    """A concave outline; a triangle, a slit that cuts cells apart, a speck that is an island within a cell."""
    outer = [(0, 0), (4, 0), (4, 1), (2.5, 1.2), (2.4, 3), (0, 3)]
    slit = [(1.5, 2.0), (1.505, 2.0), (1.505, 2.7), (1.5, 2.7)]
    speck = [(3, 0.4), (3.03, 0.41), (3.02, 0.44)]
    return Polygon(outer, [[(0.5, 0.5), (1.1, 0.5), (1.0, 1.3)], slit, speck])


def ring() -> Polygon:
    """A ragged ring around a hole with corners of 30 degrees, where round-off decides on sides."""
    rng, k = np.random.default_rng(3), 150
    angle = (np.arange(k) + rng.uniform(0, 0.9, k)) * 2 * np.pi / k
    r = 1 + 0.25 * np.sin(5 * angle) + rng.uniform(-0.05, 0.05, k)
    outer = np.column_stack([r * np.cos(angle), r * np.sin(angle)])
    return Polygon(outer, [ROUND * (0.2, 0.1) + (0.1, 0)])


def comb() -> Polygon:
    """Narrow teeth that cut cells into many parts."""
    teeth = [(0.06, 1.0), (0.05, 0.25), (0.04, 1.0)]
    top = [(0.1 * k + x, y) for k in range(39, -1, -1) for x, y in teeth]
    return Polygon([(0, 0), (4, 0), (4, 1), *top, (0, 1)])


def three() -> Polygon:
    """Three pieces: one with a hole, one in the hole, one that touches the first in a corner."""
    return Polygon.from_pieces([[SQUARE, SQUARE * 0.3 + 0.3], [SQUARE * 0.1 + 0.4], [SQUARE + 1]])


DOMAINS = {"bay": bay, "ring": ring, "comb": comb, "three": three}


def scattered(domain: Polygon, n: int, seed: int = 1) -> np.ndarray:
    """Return `n` points well inside, some in every piece."""
    rng = np.random.default_rng(seed)
    inner = domain.inner_points()
    x = rng.uniform(domain.lower, domain.upper, (20 * n, 2))
    x = x[domain.contains(x) & (domain.boundary_distance(x) > 1e-3)]
    return np.concatenate([inner, x])[:n]


def size(x: np.ndarray) -> np.ndarray:
    return 0.2 + 0.02 * x[:, 0] ** 2


def mesh(ctx, domain: Polygon, n: int, dtype: str = "float64") -> clvoro.Result:
    points, steps = scattered(domain, n), 2 if domain.n_pieces == 1 else 0
    adapter = clvoro.Adapter(ctx, dtype)
    return adapter.run(domain, size, points=points, method="lloyd", max_steps=steps)


@pytest.fixture(scope="module")
def result(ctx) -> clvoro.Result:
    return mesh(ctx, bay(), 60)


# Checks.


@pytest.mark.sparse(2)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("n", [3, 60, 900])
@pytest.mark.parametrize("name", list(DOMAINS))
def test_correct_meshes_pass(ctx, name: str, n: int, dtype: str) -> None:
    report = mesh(ctx, DOMAINS[name](), n, dtype).check()
    assert report.ok, report
    expected = {
        "outlines",
        "edges covered",
        "generators in their cells",
        "volumes sum",
        "faces closed",
        "nearest generators",
        "quality",
        "faces the same from both sides",
        "walls",
    }
    assert expected <= set(report.checked)
    assert report.precision == dtype


SPOILT = {
    "volume": ({"volumes": add(7, 1e-9)}, "volumes"),
    "no such edge": ({"neighbors": put(5, -17)}, "neighbors exist"),
    "other edge": ({"neighbors": lambda j: np.where(j == -1, -3, j)}, "walls"),
    "edges": ({"neighbors": lambda j: np.where(j == -1, -3, j)}, "edges covered"),
    "cells": ({"points": swap(8, 30)}, "generators in their cells"),
    "outside": ({"points": put(8, (0.9, 0.8))}, "generators inside"),
    "vertex": ({"vertices": add((20, 0), 1e-5)}, "face measures"),
    "vertex outside": ({"vertices": add((20, 0), 3.0)}, "vertices inside"),
    "ends": ({"face_vertices": swap(3, 12)}, "graph symmetric"),
    "corners": ({"cell_vertices": swap(3, 12)}, "outlines"),
    "starts": ({"face_vertex_starts": add(3, 1)}, "shapes"),
}


def test_a_generator_in_a_corner_where_pieces_touch(ctx) -> None:
    """It belongs to one piece; in the other one it may be nearer to cells than their own generators."""
    domain = Polygon.from_pieces([[SQUARE * 0.5], [SQUARE * 0.5 + 0.5]])
    points = [(0, 0), (0, 0.5), (0.5, 0), (0.5, 0.5), (0.5, 1), (1, 0.5), (1, 1)]
    report = clvoro.Adapter(ctx).diagram(domain, points).check()
    assert report, report


def test_a_face_as_short_as_round_off_may_be_a_side(ctx) -> None:
    a = np.array([(0, 4), (1, 4), (1, 5), (0, 5)]) / 7
    domain = Polygon.from_pieces([[a], [a + np.array([1, -1]) / 7]])
    x = [
        (0.1369047619047619, 0.5718085607390168),
        (0.14247715354669752, 0.5773809523809523),
        (0.1488095238095238, 0.571048582118126),
    ]
    made = clvoro.Adapter(ctx).run(domain, 0.05, points=x, method="lloyd", max_steps=0)
    assert made.diagram.face_measures.min() < 1e-14
    assert made.check(), made.check()


def test_sides_in_a_corner_of_two_holes(ctx) -> None:
    """Parts of a cell meet in the corner: the ends of its sides there are ambiguous."""
    holes = [[(0.25, 0.75), (0.5, 0.5), (0.25, 0.25)], [(0.75, 0.75), (0.75, 0.25), (0.5, 0.5)]]
    x = [
        (0.5122103171985511, 0.48721031719855123),
        (0.48778968280144874, 0.48721031719855123),
        (0.5135252778420708, 0.5142524999357069),
        (0.5113436115611626, 0.5164341662166151),
        (0.504798612718438, 0.5229791650593397),
        (0.5603541682739935, 0.5785347206148953),
    ]
    made = clvoro.Adapter(ctx).run(Polygon(SQUARE, holes), 0.05, points=x, method="lloyd", max_steps=0)
    assert made.check(), made.check()
    # Elsewhere they are not: a side more or less is detected.
    quality = made.quality.copy()
    quality[5] *= 6 * np.tan(np.pi / 6) / (5 * np.tan(np.pi / 5))
    assert not dataclasses.replace(made, quality=quality).check()


@pytest.mark.parametrize("scale", [1e-45, 1e10, 1e45])
def test_checks_in_any_unit(ctx, scale: float) -> None:
    domain = Polygon(SQUARE * scale, [SQUARE * 0.2 * scale + 0.3 * scale])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report = (
            clvoro.Adapter(ctx).diagram(domain, scattered(Polygon(SQUARE, [SQUARE * 0.2 + 0.3]), 9) * scale).check()
        )
    assert report, report


@pytest.mark.sparse(6)
@pytest.mark.parametrize("case", list(SPOILT))
def test_checks_name_each_fault(result, case: str) -> None:
    changes, name = SPOILT[case]
    report = spoilt(result, **changes).check()
    assert name in {finding.name for finding in report.findings}, report


def test_open_loops_are_found(result) -> None:
    face = int(np.flatnonzero(result.diagram.neighbors < 0)[0])
    report = spoilt(result, face_vertices=put(2 * face + 1, 0)).check()
    assert "faces closed" in {finding.name for finding in report.findings}


# Walls.


def test_walls_of_polygons() -> None:
    domain = bay()
    walls = np.arange(len(domain.vertices))
    normals, anchors = domain.wall_planes(walls)
    rings = [(ring + np.roll(ring, -1, axis=0)) / 2 for ring in domain.rings]
    middle = np.concatenate(rings)
    assert np.abs(((middle - anchors) * normals).sum(axis=1)).max() < 1e-15
    assert not domain.contains(middle + 1e-3 * normals).any()
    assert domain.contains(middle - 1e-3 * normals).all()
    assert domain.boundary_measure == pytest.approx(domain.geometry.length, rel=1e-15)
    assert clvoro.Box((0, 0, 0), (1, 2, 3)).boundary_measure == 22


def cells_of(diagram) -> list:
    """Each cell as a shapely geometry, from the ends of its faces only."""
    x, ends = diagram.vertices, diagram.half_faces.ends
    found = []
    for a, b in zip(diagram.neighbor_starts[:-1], diagram.neighbor_starts[1:], strict=True):
        lines = [shapely.LineString(x[e]) for e in ends[a:b] if (x[e[0]] != x[e[1]]).any()]
        parts = shapely.get_parts(shapely.polygonize(lines))
        # The cell is on the left of its outline; islands in it are not parts of it.
        islands = [shapely.Polygon(hole) for part in parts for hole in part.interiors]
        kept = [p for p in parts if not any(p.equals(island) for island in islands)]
        found.append(shapely.union_all(kept))
    return found


def test_faces_are_the_outlines_of_cells(result) -> None:
    cells = cells_of(result.diagram)
    # Round-off of sums of a dozen products of numbers up to 4.
    assert np.abs(shapely.area(cells) - result.diagram.volumes).max() < 1e-13
    assert any(len(part.interiors) for cell in cells for part in shapely.get_parts(cell))
    following = result.diagram.half_faces.next
    ends = result.diagram.half_faces.ends
    assert (ends[:, 1] == ends[following, 0]).all()
    assert sorted(following.tolist()) == list(range(len(following)))


def test_a_cell_without_neighbors_has_the_sides_of_its_piece(ctx) -> None:
    square_and_hole = Polygon(SQUARE, [SQUARE * 0.2 + 0.4])
    diagram = clvoro.Adapter(ctx).diagram(square_and_hole, np.array([(0.3, 0.3)]))
    assert count_sides(diagram).tolist() == [4]
    circle = Polygon([(np.cos(t), np.sin(t)) for t in np.arange(100) * np.pi / 50])
    diagram = clvoro.Adapter(ctx).diagram(circle, np.array([(0.0, 0.0)]))
    assert count_sides(diagram).tolist() == [100]


def test_measures(result) -> None:
    d, m = result.diagram, result.measures
    assert np.abs(m.quality - result.quality).max() < 1e-13
    owner = np.repeat(np.arange(len(d)), np.diff(d.neighbor_starts))
    behind = 0
    for f in np.flatnonzero(d.neighbors < 0):
        (a,), (b,) = d.domain.edge_ends(-1 - d.neighbors[f : f + 1])
        along = (b - a) / np.linalg.norm(b - a)
        x = d.points[owner[f]]
        gap = along[0] * (x - a)[1] - along[1] * (x - a)[0]
        foot = a + along * ((x - a) @ along)
        expected = np.linalg.norm(d.face_centroids[f] - foot) / (2 * gap) if gap > 0 else np.inf
        assert m.skewness[f] == pytest.approx(expected, rel=1e-9)
        behind += gap <= 0
    assert behind
    assert np.isfinite(list(m.summary().values())).all()
    assert m.summary()["max_skewness"] == m.skewness[m.inner].max()


# Files.


@pytest.mark.sparse(2)
@pytest.mark.parametrize("name", list(DOMAINS))
def test_vtu_is_read_back(ctx, tmp_path, name: str) -> None:
    made = mesh(ctx, DOMAINS[name](), 40)
    path = tmp_path / "mesh.vtu"
    made.save(path)
    again = load_vtu(path)
    assert again.check().ok, again.check()
    d, e = made.diagram, again.diagram
    assert e.domain == d.domain
    assert np.array_equal(e.cell_vertices, d.cell_vertices)
    assert np.array_equal(e.neighbor_starts, d.neighbor_starts)
    rows = [
        [
            sorted(zip(m.neighbors[a:b].tolist(), m.half_faces.ends[a:b].tolist(), strict=True))
            for a, b in zip(m.neighbor_starts[:-1], m.neighbor_starts[1:], strict=True)
        ]
        for m in (d, e)
    ]
    assert rows[0] == rows[1]
    assert cli.main(["check", str(path)]) == 0


def test_vtu_with_a_slit_without_width(ctx, tmp_path) -> None:
    """In single precision both sides of the slit have the same corners, like a bridge between loops."""
    shore = np.vstack([spit(1e-12)[:-1], (0, 1), (0, 0.5)])
    domain = Polygon(shore, [star(7, 3, (0.3, 0.3), 0.1), star(5, 4, (0.2, 0.8), 0.05)])
    made = mesh(ctx, domain, 3, "float32")
    ends = made.diagram.half_faces.ends
    cell = np.repeat(np.arange(3), np.diff(made.diagram.neighbor_starts))
    keys = {(c, *sorted(pair)) for c, pair in zip(cell.tolist(), ends.tolist(), strict=True)}
    assert len(keys) < len(ends)
    made.save(tmp_path / "mesh.vtu")
    again = load_vtu(tmp_path / "mesh.vtu")
    assert again.check()
    assert np.array_equal(again.diagram.neighbors, made.diagram.neighbors)


def test_a_moved_corner_in_a_vtu_is_found(result, tmp_path) -> None:
    d = spoilt(result, vertices=add((20, 0), 1e-3))
    path = tmp_path / "mesh.vtu"
    dataclasses.replace(result, diagram=d).save(path)
    assert not load_vtu(path).check()
    assert cli.main(["check", str(path)]) == 1


def assert_same_areas(read, d: clvoro.Diagram, slack: float) -> None:
    """Areas of the cells that meshio read."""
    assert sum(len(block) for block in read.cells) == len(d)
    x = read.points[:, :2]
    areas = [((z := x[c] @ (1, 1j)).conj() * np.roll(z, -1)).imag.sum() / 2 for block in read.cells for c in block.data]
    assert np.sort(areas) == pytest.approx(np.sort(d.volumes), abs=slack)


@pytest.mark.parametrize("name", ["mesh.vtk", "mesh.ply", "mesh.obj"])
def test_other_programs_read_the_cells(result, tmp_path, name) -> None:
    meshio = pytest.importorskip("meshio")
    result.save(tmp_path / name)
    # The other formats have fewer digits than VTK's.
    assert_same_areas(meshio.read(tmp_path / name), result.diagram, 1e-13 if name == "mesh.vtk" else 1e-5)


def test_other_programs_read_a_vtu(result, tmp_path, meshio_for_vtu) -> None:
    result.save(tmp_path / "mesh.vtu")
    read = meshio_for_vtu.read(tmp_path / "mesh.vtu")
    assert_same_areas(read, result.diagram, 1e-13)
    described = json.loads(read.field_data["domain"].tobytes())
    assert np.array_equal(described["vertices"], result.diagram.domain.vertices)


@pytest.fixture(scope="module")
def pond(ctx) -> clvoro.Result:
    """A mesh without islands in cells, in which some cells have two faces in common."""
    domain = Polygon(bay().rings[0][::-1], [ring[::-1] for ring in bay().rings[1:3]])
    return mesh(ctx, domain, 60)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("walls", ["exact", "straight"])
def test_openfoam_cells_are_closed(pond, tmp_path, walls) -> None:
    pond.to_openfoam(tmp_path / "constant" / "polyMesh", walls=walls, check=False)
    points, faces, owner, neighbor, _ = test_foam.read(tmp_path / "constant" / "polyMesh")
    pairs = list(zip(owner[: len(neighbor)].tolist(), neighbor.tolist(), strict=True))
    assert pairs == sorted(pairs)
    # Straight, two faces that follow each other between the same cells are one.
    assert (len(set(pairs)) < len(pairs)) == (walls == "exact")
    assert all(i < j for i, j in pairs)
    volumes, depth = test_foam.volumes_of_closed_cells(points, faces, owner, neighbor), points[:, 2].max()
    if walls == "exact":
        assert volumes == pytest.approx(pond.diagram.volumes * depth, abs=1e-13)
    change = volumes.sum() / depth / pond.diagram.domain.measure - 1
    assert pond.solver_mesh(walls).area_change == pytest.approx(change, abs=1e-12)


@pytest.mark.parametrize(
    ("patches", "says"),
    [
        ({"a": [99]}, r"patches\['a'\] has edge 99"),
        ({"a": []}, r"patches\['a'\] is empty"),
        ({"a": [1], "b": [0, 1]}, "edge 1 both in 'a' and in 'b'"),
        ({"a b": [1]}, "the name 'a b'"),
        ([0, 1], r"patches is \[0, 1\] of type list.*'inlet': \[0, 1\]"),
        ({"a": [0.5]}, r"patches\['a'\] is \[0\.5\]"),
        ({"a": "01"}, r"patches\['a'\] is '01'"),
    ],
)
def test_wrong_patches_are_refused(pond, tmp_path, patches: object, says: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=says):
        pond.to_openfoam(tmp_path / "case.foam", patches=patches)
    assert not list(tmp_path.iterdir())


# Pictures and reports.


def pixel(figure, place) -> list:
    """Color (red, green, blue; 0 to 255) of a figure's first axes at a place of its plane."""
    figure.canvas.draw()
    image = np.asarray(figure.canvas.buffer_rgba())
    x, y = figure.axes[0].transData.transform(place)
    return image[image.shape[0] - 1 - int(y), int(x), :3].tolist()


OUTSIDE = [(0.85, 0.8), (3.5, 2.0), (3.017, 0.417)]  # the triangle, beyond the outline, the speck
INSIDE = [(0.2, 2.8), (2.0, 0.3), (2.0, 1.7)]


@pytest.mark.sparse(2)
@pytest.mark.parametrize("color", ["error", "quality", "size", "sides", "skewness"])
def test_cells_fill_the_domain_and_nothing_else(result, color: str) -> None:
    pytest.importorskip("matplotlib")
    figure = result.plot(color, edges=False)
    figure.set_dpi(400)  # the speck is three hundredths of a unit
    assert all(pixel(figure, place) == [255, 255, 255] for place in OUTSIDE)
    if color not in ("error", "sides"):  # their color maps have a white middle
        assert all(pixel(figure, place) != [255, 255, 255] for place in INSIDE)
    lines = [patch for patch in figure.axes[0].patches if len(patch.get_path().vertices) == 20]
    assert len(lines) == 1  # all four rings, closed


@pytest.mark.slow
def test_size_is_evaluated_inside_only(result) -> None:
    pytest.importorskip("matplotlib")
    from clvoro.plotting import plot_size

    domain = result.diagram.domain

    def asked(x: np.ndarray) -> np.ndarray:
        assert domain.contains(x).all()
        return size(x)

    figure = plot_size(asked, domain)
    figure.set_dpi(200)
    assert all(pixel(figure, place) == [255, 255, 255] for place in OUTSIDE)
    assert all(max(pixel(figure, place)) < 250 for place in INSIDE)
    # Up to the boundary: a raster would end in steps there.
    beside = np.add(*domain.edge_ends(np.arange(len(domain.vertices)))) / 2
    inward = beside - 0.02 * domain.wall_planes(np.arange(len(beside)))[0]
    kept = inward[:9][domain.contains(inward[:9])]
    assert len(kept) == 9
    assert all(pixel(figure, place) != [255, 255, 255] for place in kept)


def test_boundary_cells_are_reported_separately(result, tmp_path, monkeypatch) -> None:
    """With the figures of all pictures, which are not rendered."""
    pytest.importorskip("matplotlib")
    from clvoro.mesh.results import boundary_line, summary
    from clvoro.plotting import page as module
    from clvoro.plotting import write_report

    d = result.diagram
    touching = [
        (d.neighbors[a:b] < 0).any() for a, b in zip(d.neighbor_starts[:-1], d.neighbor_starts[1:], strict=True)
    ]
    s = summary(result)
    assert (s["boundary_cells"], s["inner_cells"]) == (sum(touching), 60 - sum(touching))
    for name, which in (("boundary", np.array(touching)), ("inner", ~np.array(touching))):
        assert s[f"{name}_mean_error"] == pytest.approx(np.abs(result.size_error[which]).mean())
        assert s[f"{name}_mean_quality"] == pytest.approx(result.quality[which].mean())
        assert s[f"{name}_min_quality"] == result.quality[which].min()
    assert f"{sum(touching)} boundary cells: mean |e|" in boundary_line(result)
    assert 0 < s["corner_cells"] < s["boundary_cells"]
    assert f"; {s['corner_cells']} of them at corners: mean |e|" in boundary_line(result)
    monkeypatch.setattr(module, "render", lambda *_: b"")
    page = write_report(result, tmp_path, size=size)[0].read_text()
    assert "Cells on the boundary" in page
    assert f"<td>{sum(touching)}</td>" in page


def test_a_piece_with_one_cell_has_no_inner_cells(ctx) -> None:
    from clvoro.mesh.results import boundary_line, summary

    alone = mesh(ctx, Polygon(SQUARE), 1)
    assert summary(alone)["inner_mean_error"] is None
    assert "inner" not in boundary_line(alone)


# Transfer.


@pytest.fixture(scope="module")
def pair(ctx):
    """Two diagrams of one domain, with islands in cells and cells in parts."""
    adapter = clvoro.Adapter(ctx)
    return [adapter.diagram(bay(), scattered(bay(), n, seed)) for n, seed in ((60, 1), (45, 5))]


def test_overlaps_sum_to_the_cells(pair) -> None:
    old, new = pair
    before, after = cells_of(old), cells_of(new)
    got = old.transfer(np.eye(60), new)
    expected = np.array([[new_.intersection(old_).area for old_ in before] for new_ in after])
    # Round-off of areas of numbers up to 4; the rest of the mass is distributed over all cells.
    assert np.abs(got * new.volumes[:, None] - expected).max() < 1e-13
    assert (expected > 0).sum() > 60
