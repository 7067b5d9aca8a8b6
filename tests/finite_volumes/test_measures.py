"""Measures of solver meshes: cubes by hand, and the figures that OpenFOAM's checkMesh prints."""

import re
from dataclasses import replace

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.finite_volumes.measures import PlaneMeasures, SolverMeasures
from tests.finite_volumes.test_straight_walls import ELL, SQUARE, circle, polygons
from tests.io.test_foam import check_mesh, needs_openfoam
from tests.reference import solids

NUMBER = r"([-+.\deE]*\d)"
COUNTED = {"concavity": "concave", "face pyramids": "pyramids"}
"""Criteria whose faces or cells checkMesh counts."""


def random_points(n: int, d: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((n, d))


def diagram_of(name: str, ctx) -> clvoro.Diagram:
    adapter = clvoro.Adapter(ctx)
    if name == "solid":
        return solids.solid_diagram((0, 0, 0), (1, 1, 1), random_points(150, 3, 5))
    if name in ("corner", "hole"):
        domain = clvoro.Polygon(ELL) if name == "corner" else clvoro.Polygon(SQUARE, [circle(40, 0.2)])
        points = shapely.points(random_points(400, 2, 6))
        inside = points[shapely.contains(shapely.Polygon(domain.rings[0], domain.rings[1:]), points)]
        return adapter.diagram(domain, shapely.get_coordinates(inside))
    domain = {
        "adapted": clvoro.Box((0, 0), (1, 1)),
        "flat": clvoro.Box((0, 0), (1, 0.5)),
        "periodic": clvoro.Box((0, 0), (1, 1), periodic=(True, False)),
        "torus": clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True),
        "adapted solid": clvoro.Box((0, 0, 0), (1, 1, 1)),
    }[name]
    if name.startswith("adapted"):
        return adapter.run(domain, 0.1 if domain.dim == 2 else 0.2, effort="fast").diagram
    points = random_points(200, domain.dim, 7) * domain.extent
    return adapter.diagram(domain, points)


def printed(text: str) -> dict[str, float]:
    """The figures in the output of checkMesh; those that it does not print are absent."""
    patterns = {
        "non_orthogonality": rf"non-orthogonality Max: {NUMBER}",
        "mean_non_orthogonality": rf"non-orthogonality Max: .* average: {NUMBER}",
        "skewness": rf"Max skewness = {NUMBER}",
        "aspect_ratio": rf"[Mm]ax aspect ratio[:=]? = ?{NUMBER}",
        "determinant": rf"wellposedness\) : minimum: {NUMBER}",
        "weight": rf"interpolation weight : minimum: {NUMBER}",
        "volume_ratio": rf"volume ratio : minimum: {NUMBER}",
        "flatness": rf"butterfly\) : min = {NUMBER}",
        "area": rf"Minimum face area = {NUMBER}",
        "volume": rf"Min volume = {NUMBER}",
        "concave": r"Concave cells .*number of cells: (\d+)",
        "pyramids": r"face pyramids: (\d+)",
        "tetrahedra": r"face tets: (\d+)",
    }
    found = {name: re.search(pattern, text) for name, pattern in patterns.items()}
    return {name: float(match[1]) for name, match in found.items() if match}


def measured(m: SolverMeasures) -> dict[str, float]:
    s = m.summary()
    return {
        "non_orthogonality": s["max_non_orthogonality"],
        "mean_non_orthogonality": s["mean_non_orthogonality"],
        "skewness": s["max_skewness"],
        "aspect_ratio": m.aspect_ratio.max(),
        "determinant": m.determinant.min(),
        "weight": m.weight.min(),
        "volume_ratio": m.volume_ratio.min(),
        "flatness": m.flatness.min(),
        "area": np.linalg.norm(m.geometry.areas, axis=1).min(),
        "volume": m.geometry.volumes.min(),
        "concave": s["concave_cells"],
        "pyramids": np.count_nonzero(m.pyramids < -1e-15),
        "tetrahedra": m.bad_tetrahedra.sum(),
    }


@pytest.mark.sparse(2)
@needs_openfoam
@pytest.mark.parametrize("walls", ["exact", "straight"])
@pytest.mark.parametrize("name", ["adapted", "flat", "periodic", "corner", "hole", "solid", "torus", "adapted solid"])
def test_figures_are_those_of_openfoam(ctx, tmp_path, name, walls):
    diagram = diagram_of(name, ctx)
    text = check_mesh(diagram, tmp_path, walls=walls)
    expected = printed(text)
    found = measured(diagram.solver_mesh(walls, walls == "straight").measures)
    assert expected.keys() >= {"non_orthogonality", "skewness", "determinant", "area", "volume"}
    for key, value in found.items():
        # Six digits are printed; the angle from the arc cosine of a mean loses half of its digits near 0.
        assert value == pytest.approx(expected.get(key, value), rel=2e-5, abs=1e-12), key
        if key in ("concave", "pyramids", "tetrahedra"):
            assert value == expected.get(key, 0), key
    report = diagram.check(solver="openfoam", walls=walls)
    assert report.ok == ("Mesh OK." in text), f"{text}\n{report}"
    assert report["regions"].value == float(re.search(r"Number of regions: (\d+)", text)[1])
    for name, key in COUNTED.items():
        assert report[name].count == expected.get(key, 0), name
    shown = re.search(r"Max skewness = .*?, (\d+) highly skew", text)
    assert report["skewness"].count == (int(shown[1]) if shown else 0)


def test_cubes_by_hand():
    cubes = solids.cubes(0.5)
    mesh = cubes.solver_mesh()
    m = mesh.measures
    assert m.geometry.volumes == pytest.approx(0.125)
    assert m.geometry.centroids == pytest.approx(cubes.points)
    assert m.non_orthogonality == pytest.approx(0, abs=1e-9)
    assert m.skewness == pytest.approx(0, abs=1e-9)
    assert m.aspect_ratio == pytest.approx(1)
    assert m.weight[m.coupled] == pytest.approx(0.5)
    assert m.shortest_edge == pytest.approx(1)
    assert m.smallest_face == pytest.approx(1)
    assert not m.concave.any()
    assert m.determinant.min() > 0.01
    assert mesh.area_change == 0
    assert (replace(mesh, points=0 * mesh.points).measures.determinant == 0).all()


def test_centroids_and_concavity_in_2d_are_those_of_polygons(ctx):
    mesh = diagram_of("hole", ctx).solver_mesh("exact", collapse=False)
    m = mesh.measures
    height = m.cells.points[:, 2].max()
    assert height == pytest.approx(np.sqrt(mesh.domain.measure / mesh.n_cells))
    for i, p in enumerate(polygons(mesh)):
        assert m.geometry.volumes[i] == pytest.approx(p.area * height, rel=1e-9)
        if not m.concave[i]:  # OpenFOAM's centers of concave faces are not their centroids
            assert m.geometry.centroids[i, :2] == pytest.approx(np.array(p.centroid.coords)[0])
            assert m.concavity[i] == 0
        x = np.array(p.exterior.coords)
        lengths = np.hypot(*np.diff(x, axis=0).T)
        assert m.shortest_edge[i] >= lengths.min() / np.sqrt(p.area) * (1 - 1e-9)
    assert m.concavity.max() == pytest.approx(9)


def test_measures_of_a_diagram_lead_to_those_of_solvers(ctx):
    diagram = diagram_of("hole", ctx)
    m = diagram.measures
    lengths = np.minimum.reduceat(diagram.face_measures, diagram.neighbor_starts[:-1])
    assert (m.exact.shortest_edge >= lengths / np.sqrt(diagram.volumes) * (1 - 1e-9)).all()
    assert (m.exact.shortest_edge < 30 * lengths / np.sqrt(diagram.volumes)).all()
    assert m.solver.shortest_edge.min() > m.exact.shortest_edge.min()
    assert m.solver.concave.sum() < m.exact.concave.sum()
    assert "concave cells" in repr(m.solver)


def test_edges_and_faces_have_percentiles(ctx):
    s = diagram_of("solid", ctx).measures.exact.summary()
    for kind in ("edge", "face"):
        least = s[f"min_{kind}"]
        assert 0 < least <= s[f"{kind}_percentile_0.1"] <= s[f"{kind}_percentile_1"]
        assert s[f"{kind}_percentile_1"] < s[f"{kind}_percentile_10"] < 1


@pytest.mark.parametrize("name", ["corner", "periodic"])
def test_measures_in_the_plane_are_those_of_prisms(ctx, name):
    mesh = diagram_of(name, ctx).solver_mesh()
    plane, prisms = PlaneMeasures(mesh), mesh.measures
    assert np.allclose(plane.centroids, prisms.geometry.centroids[:, :2], rtol=0, atol=1e-12)
    assert np.allclose(plane.skewness, prisms.skewness[: len(mesh)], rtol=0, atol=1e-10)
    assert np.allclose(plane.non_orthogonality, prisms.non_orthogonality[: len(mesh)], rtol=0, atol=1e-6)
    assert np.allclose(plane.determinant, prisms.determinant, rtol=1e-9, atol=1e-12)
