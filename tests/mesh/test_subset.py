"""Meshes from which cells were removed."""

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError, InputTypeError
from tests.reference import spheres
from tests.reference.netcdf_files import random_points, result_of

L_SHAPE = clvoro.Polygon([(0, 0), (2, 0), (2, 2), (1, 2), (1, 1), (0, 1)], names={"river": [0]})
DOMAINS = {
    "box": clvoro.Box((0, 0), (2, 2), names={"inlet": "xMin"}),
    "channel": clvoro.Box((0, 0), (2, 2), periodic=(True, False)),
    "torus": clvoro.Box((0, 0), (2, 2), periodic=True),
    "polygon": L_SHAPE,
    "solid": clvoro.Box((0, 0, 0), (2, 2, 2), periodic=(False, False, True)),
    "globe": clvoro.Sphere(2),
}


@pytest.fixture(scope="module", params=DOMAINS)
def whole(request, ctx):
    domain = DOMAINS[request.param]
    points = np.random.default_rng(12).random((400 if domain.dim == 2 else 150, domain.dim)) * 2
    points = points if domain.globe is None else spheres.random_points(400, 12) * 2
    return clvoro.Adapter(ctx).diagram(domain, points[domain.contains(points)])


@pytest.fixture(scope="module")
def keep(whole):
    return np.linalg.norm(whole.points - (1.3, 1, 1)[: whole.domain.dim], axis=1) > 0.4


@pytest.fixture(scope="module")
def part(whole, keep):
    return whole.subset(keep, "hole")


def test_kept_cells_do_not_change(whole, keep, part):
    rows = np.flatnonzero(keep)
    assert np.array_equal(part.points, whole.points[keep])
    for new, old in enumerate(rows):
        one, other = part.cell(new), whole.cell(old)
        assert one.volume == other.volume
        for name in ("generator", "centroid", "vertices"):
            assert np.array_equal(getattr(one, name, 0), getattr(other, name, 0))
        for k, (a, b) in enumerate(zip(one.neighbors, other.neighbors, strict=True)):
            assert (rows[a] if a >= 0 else a) == b if b < 0 or keep[b] else a < -len(whole.domain.boundary_index)
            assert one.areas[k] == other.areas[k]
    assert len(part.vertices) == len(np.unique(part.face_vertices))
    assert part.domain.measure == pytest.approx(whole.volumes[keep].sum(), rel=1e-14)
    assert part.domain.boundary_names[0] == "hole"
    beside = np.flatnonzero(whole.adjacency[:, ~keep].sum(axis=1) > 0)
    assert rows[part.boundary_cells("hole")].tolist() == [i for i in beside if keep[i]]


@pytest.mark.parametrize("suffix", [".npz", ".vtu"])
def test_parts_are_checked_saved_and_cut_again(part, tmp_path, suffix):
    again = part.subset(part.points[:, 0] > 0.5)
    for diagram in (part, again):
        diagram.check().demand()
        diagram.save(tmp_path / f"part{suffix}")
        loaded = clvoro.load(tmp_path / f"part{suffix}")
        assert loaded.domain == diagram.domain
        assert loaded.domain.boundary_names == diagram.domain.boundary_names
        assert np.array_equal(loaded.domain.boundary_index, diagram.domain.boundary_index)
        for name in ("points", "volumes", "neighbors", "vertices", "face_vertices"):
            assert np.array_equal(getattr(loaded, name), getattr(diagram, name))
        loaded.check().demand()
    assert {"hole", "coast"} <= set(again.domain.boundary_names)


def test_faces_towards_removed_cells_know_their_generators(whole, keep, part):
    faces = part.faces
    walls = -1 - faces.neighbor[faces.n_inner :]
    cut = part.domain.removed_behind(walls)
    assert cut.sum() == len(part.domain.beyond)
    mirrored = part.domain.mirrored(walls[cut], part.points[faces.owner[faces.n_inner :][cut]])
    away = np.abs(whole.domain.wrap(mirrored)[:, None] - whole.points[~keep]).max(axis=2).min(axis=1)
    assert away.max() < 1e-12
    assert part.domain.contains(part.points).all()
    assert not part.domain.contains(whole.points[~keep]).any()


def test_normals_of_faces_are_right_on_both_sides_of_cuts(ctx):
    """Cells at a thin slit end where its tip cuts their faces, also if the cell on the other side was removed."""
    comb = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1.02, 1), (1.02, 0.3), (0.98, 0.3), (0.98, 1), (0, 1)])
    points = np.random.default_rng(0).uniform([0, 0], [2, 1], (60, 2))
    whole = clvoro.Adapter(ctx).diagram(comb, points[comb.contains(points)])
    beside = np.abs(whole.points[:, 0] - 1) < 0.3
    for side in (-1, 1):
        part = whole.subset(~beside | (side * (whole.points[:, 0] - 1) > 0))
        begin, end = part.faces.points[part.faces.corners.reshape(-1, 2)].swapaxes(0, 1)
        assert ((end - begin) * part.faces.normal).sum(axis=1) == pytest.approx(0, abs=1e-9)


def test_solvers_get_parts(part, tmp_path):
    if part.domain.curved:
        return  # see tests/io/test_region_files.py
    part.to_openfoam(tmp_path / "polyMesh")
    assert "hole" in (tmp_path / "polyMesh" / "boundary").read_text()


def test_a_cell_that_hangs_by_one_face_is_refused_with_what_to_keep(ctx, tmp_path):
    points = np.stack(np.meshgrid(*[np.arange(3) + 0.5] * 3, indexing="ij"), -1).reshape(-1, 3)
    cubes = clvoro.Adapter(ctx).diagram(clvoro.Box((0, 0, 0), (3, 3, 3)), points)
    hanging = points[:, 2] < 1
    hanging[4 * 3 + 1] = True
    with pytest.raises(InputError, match=r"determinant is 0, .*let subset keep more or fewer of the cells there"):
        cubes.subset(hanging).to_openfoam(tmp_path / "polyMesh")
    hanging[4 * 3 + 1] = False
    hanging |= points[:, 2] < 2
    cubes.subset(hanging).to_openfoam(tmp_path / "polyMesh")


def test_a_result_and_a_domain_select_cells(ctx):
    box = DOMAINS["box"]
    result = result_of(clvoro.Adapter(ctx).diagram(box, random_points(box, 200)))
    part = result.subset(L_SHAPE)
    assert np.array_equal(part.points, result.points[L_SHAPE.contains(result.points)])
    assert len(part.target_size) == len(part)
    assert result.subset(np.ones(200, bool)) is result


def test_a_closed_surface_selects_cells(ctx):
    diagram = clvoro.Adapter(ctx).diagram(DOMAINS["solid"], np.random.default_rng(3).random((150, 3)) * 2)
    ball = clvoro.Solid.ball((1, 1, 1), 0.7).surface
    assert np.array_equal(diagram.subset(ball).points, diagram.points[ball.contains(diagram.points)])


def test_shapes_of_another_dimension_are_refused_with_what_to_pass(ctx):
    adapter, rng = clvoro.Adapter(ctx), np.random.default_rng(3)
    space = adapter.diagram(clvoro.Box((0, 0, 0), (2, 2, 2)), rng.random((50, 3)) * 2)
    with pytest.raises(InputError, match=r"keep is a Polygon with 2 coordinates.*contains\(mesh.points\[:, :2"):
        space.subset(L_SHAPE)
    assert len(space.subset(L_SHAPE.contains(space.points[:, :2])))
    globe = adapter.diagram(clvoro.Sphere(), clvoro.Sphere().icosahedral_points(1))
    with pytest.raises(InputError, match=r"pass clvoro\.earth\.inside\(mesh, keep\)"):
        globe.subset(L_SHAPE)
    with pytest.raises(InputError, match="keep is a Solid with 3 coordinates, expected 2"):
        adapter.diagram(DOMAINS["box"], random_points(DOMAINS["box"], 20)).subset(clvoro.Solid.ball((1, 1, 1), 0.7))


def test_wrong_parts_are_refused(ctx, part, whole):
    with pytest.raises(InputTypeError, match="keep has dtype int64"):
        whole.subset(np.arange(len(whole)))
    with pytest.raises(InputTypeError, match=r"pass clvoro\.Polygon\.from_shapely\(shape\)\.contains\(mesh\.points\)"):
        whole.subset(L_SHAPE.geometry)
    with pytest.raises(InputError, match="keep selects none"):
        whole.subset(np.zeros(len(whole), bool))
    with pytest.raises(InputError, match=r"shape \(3,\), expected \(\d+,\)"):
        whole.subset(np.ones(3, bool))
    with pytest.raises(InputError, match=r"shape \(\d+, 1\)"):
        whole.subset(np.ones((len(whole), 1), bool))
    with pytest.raises(InputError, match="has the name 'the coast', expected a word"):
        whole.subset(whole.points[:, 0] > 1, "the coast")
    with pytest.raises(InputError, match="make the mesh in the whole domain, then remove cells"):
        clvoro.Adapter(ctx).run(part.domain, 0.1)
    with pytest.raises(InputError, match="is no shape for sizes"):
        part.domain.boundary()
    known = part.domain.describe()
    for changes, says in (
        ({"area": -1.0}, "area"),
        ({"area": 1e20}, "expected at most that of the sphere") if part.domain.curved else ({"area": 0}, "area"),
        ({"within": np.zeros((0, part.domain.dim))}, "within has 0 rows"),
        ({"names": {"ice": [9999]}}, "has wall 9999, expected numbers"),
        ({"within": known["within"][:-1]}, "differ in shape"),
        ({"beyond": np.full_like(known["beyond"], np.nan)}, "finite"),
    ):
        with pytest.raises(InputError, match=says):
            type(part.domain).described(**{**known, **changes})
