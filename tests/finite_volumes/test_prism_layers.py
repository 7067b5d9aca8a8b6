"""Layers of prisms along walls of solids."""

import numpy as np
import pytest

import clvoro
from clvoro import Layers, Solid
from clvoro.errors import InputError, InputTypeError, MemoryLimitError, MismatchWarning

HEIGHTS = 0.02 * 1.3 ** np.arange(3)
T = HEIGHTS.sum()


@pytest.fixture(scope="module")
def cube(adapter):
    """A cube with layers on two sides that meet, and none on the others."""
    layers = Layers(0.02, 3, 1.3, edges=["xMin", "zMax"])
    return adapter.run(Solid.box((0, 0, 0), (1, 1, 1)), 0.25, effort="fast", layers=layers)


@pytest.fixture(scope="module")
def adapter(ctx):
    return clvoro.Adapter(ctx)


def closes(diagram):
    """Return the largest openness of a cell."""
    f = diagram.faces
    total = np.zeros((len(diagram), 3))
    np.add.at(total, f.owner, f.normal * f.area[:, None])
    np.subtract.at(total, f.neighbor[: f.n_inner], (f.normal * f.area[:, None])[: f.n_inner])
    return np.abs(total).max()


def test_layers_fill_the_cube_with_the_heights_asked_for(cube):
    d = cube.diagram
    f = d.faces
    assert abs(d.volumes.sum() - 1) < 1e-12  # exact on planes, up to round-off
    assert closes(d) < 1e-14
    assert cube.check()
    assert cube.check("openfoam")
    # Faces between two layers over xMin lie in the planes at the sums of heights.
    i, j = f.owner[: f.n_inner], f.neighbor[: f.n_inner]
    along = np.flatnonzero((d.layer[i] != d.layer[j]) & (f.normal[: f.n_inner, 0] > 1 - 1e-9))
    along = np.union1d(along, np.flatnonzero((d.layer[i] != d.layer[j]) & (f.normal[: f.n_inner, 0] < 1e-9 - 1)))
    outer = np.maximum(d.layer[i[along]], d.layer[j[along]])
    inner = np.minimum(d.layer[i[along]], d.layer[j[along]])
    level = np.where(inner == 0, 3, inner)
    assert len(along) >= 3
    assert (outer - inner).max() <= 3
    assert np.abs(f.center[along, 0] - np.cumsum(HEIGHTS)[level - 1]).max() < 1e-12
    # One column stands on each wall polygon; all reach the full thickness.
    counts = np.bincount(d.layer, minlength=4)
    assert counts[1] == counts[2] == counts[3] > 25
    assert cube.summary()["thickness"] == [
        pytest.approx({"asked": T, "min": T, "mean": T, "max": T, "full_share": 1.0}, rel=1e-12)
    ]
    # Prisms have their own size, and error 0.
    assert np.abs(cube.size_error[d.layer > 0]).max() < 1e-12
    assert (cube.origin[d.layer > 0] == -1).all()


def test_names_stay_and_sides_of_prisms_lie_on_the_patch_beside(cube):
    d = cube.diagram
    owner, names = d.half_faces.owner, d.domain.boundary_names
    walls = np.flatnonzero(d.neighbors < 0)
    name = np.array(names)[d.domain.boundary_index[-1 - d.neighbors[walls]]]
    for axis, side, end in (
        (0, "xMin", 0),
        (0, "xMax", 1),
        (1, "yMin", 0),
        (1, "yMax", 1),
        (2, "zMin", 0),
        (2, "zMax", 1),
    ):
        some = walls[name == side]
        assert np.abs(d.face_centroids[some, axis] - end).max() < 1e-12
        assert abs(d.face_measures[some].sum() - 1) < 1e-12
        # Patches with layers have prisms only, and the far ones none.
        expected = {"xMin": {1}, "zMax": {1}, "xMax": {0, 1, 2, 3}, "zMin": {0, 1, 2, 3}}
        assert set(d.layer[owner[some]]) == expected.get(side, {0, 1, 2, 3})


def test_files_parts_and_queries_know_layers(cube, tmp_path):
    for file in ("mesh.npz", "mesh.vtu"):
        cube.save(tmp_path / file)
        back = clvoro.load(tmp_path / file)
        assert np.array_equal(back.layer, cube.layer)
        assert back.solver_mesh().n_cells == len(cube)
        assert back.check("openfoam")
    assert np.array_equal(cube.locate(cube.centroids), np.arange(len(cube)))
    part = cube.subset(cube.layer > 0)
    assert part.layer.min() == 1


def test_gaps_squeeze_layers_and_warn(adapter):
    plate = Solid.box((0, 0, 0), (1, 1, 0.3))
    with pytest.warns(MismatchWarning, match=r"wall polygons have thinner ones, or none, .* the thinnest at \("):
        mesh = adapter.run(plate, 0.15, effort="fast", layers=Layers(0.05, 2, 1.2, edges=["zMin", "zMax"]))
    prisms = mesh.layer > 0
    # 0.25 of the gap from each side; at creases with patches without layers gaps do not count.
    assert 0.45 * 0.3 < mesh.volumes[prisms].sum() < 0.55 * 0.3
    assert abs(mesh.volumes.sum() - 0.3) < 1e-12
    assert mesh.check("openfoam")


def test_layers_end_where_they_cannot_lie_on_the_patch_beside(adapter):
    outline = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], names={"step": 2})
    bend = Solid.extruded(outline, 0, 1)
    with pytest.warns(MismatchWarning, match="none, because of gaps, sharp edges or borders"):
        mesh = adapter.run(bend, 0.35, effort="fast", layers=Layers(0.03, 2, edges="step"))
    assert abs(mesh.volumes.sum() - 3) < 1e-12
    assert closes(mesh.diagram) < 1e-14
    assert mesh.check("openfoam")
    # At the concave crease in x = 1 the wall vertices stay where they are.
    prisms = np.flatnonzero(mesh.layer > 0)
    assert len(prisms)
    assert mesh.centroids[prisms, 1].min() > 1 - 0.07


def test_curved_walls_keep_the_thickness(adapter):
    pipe = Solid.cylinder((0, 0, 0), (0, 0, 2), 1)
    mesh = adapter.run(pipe, 0.35, effort="fast", layers=Layers(0.03, 2, 1.5, edges="side"))
    f = mesh.faces
    side = np.flatnonzero(f.boundary == pipe.boundary_names.index("side"))
    # Chords and normals over polygons change the thickness by their squared turn; the pipe is narrower inside.
    assert mesh.volumes[mesh.layer > 0].sum() / f.area[side].sum() == pytest.approx(0.075 * (1 - 0.075 / 2), rel=0.03)
    assert mesh.check("openfoam")
    # Cells beside them have the sizes of the field, though they have made room: the prisms take 13 % of the volume.
    assert mesh.volumes[mesh.layer == 0].mean() == pytest.approx(0.35**3, rel=0.02)
    assert np.abs(mesh.size_error[mesh.layer == 0]).mean() < 0.03


def test_layers_on_a_ball_are_full_though_wall_polygons_have_short_sides(adapter):
    mesh = adapter.run(Solid.ball((0, 0, 0), 0.6, edge=0.1), 0.15, effort="fast", layers=Layers(0.015, 4))
    assert mesh.summary()["thickness"][0]["full_share"] > 0.99  # 0.80 where the ends of a side move as they like


def test_small_faces_that_bulge_out_do_not_thin_layers(adapter):
    """They are collapsed or flattened, on coarse meshes with a concave wall, too."""
    block = Solid.box((-1, -1, 0), (1, 1, 1)) - Solid.cylinder((0, 0, -1), (0, 0, 2), 0.5)
    mesh = adapter.run(block, 0.2, effort="fast", layers=Layers(0.4 * 0.2 / 6.187, 4, 1.3))
    assert mesh.summary()["thickness"][0]["full_share"] > 0.99  # 0.23 with these faces
    assert mesh.check("openfoam")
    assert closes(mesh.diagram) < 1e-14
    assert mesh.check()


@pytest.mark.slow
def test_layers_around_a_wrap_end_in_few_places(adapter):
    """On the ground, too. Where a cell stays rejected, layers end around it only, and its corners stay."""
    trimesh = pytest.importorskip("trimesh")
    blocks = [((0, 0, -1), (2, 1, 2)), ((1, 0.5, -1), (3, 2, 1.2)), ((-2, -2, -1), (-1, 1, 1.5))]
    town = trimesh.util.concatenate([trimesh.creation.box(bounds=b) for b in blocks])
    air = Solid.outside(Solid.from_trimesh(town, wrap=0.4, name="town"), ((-3, -3, 0), (4, 3, 3.5)))
    mesh = adapter.run(air, 0.6, effort="fast", seed=2, layers=Layers(0.06, 3, 1.3, edges=["town", "zMin"]))
    (told,) = mesh.summary()["thickness"]
    assert told["mean"] > 0.4 * told["asked"]  # 0.06 where they end as far around all places as around the worst
    assert mesh.check("openfoam")


def test_a_mesh_with_layers_is_a_start(adapter, cube):
    again = adapter.run(
        cube.domain, 0.25, points=cube.points[::-1], layers=Layers(0.02, 3, 1.3, edges=["xMin", "zMax"])
    )
    assert abs((again.layer == 0).sum() / (cube.layer == 0).sum() - 1) < 0.1
    # Points in layers are left out; `origin` counts them.
    there = again.origin >= 0
    assert there.any()
    assert (cube.layer[::-1][again.origin[there]] == 0).all()


def test_points_in_layers_only_are_refused(adapter):
    with pytest.raises(InputError, match="points has 1 points in the layers, expected some beyond them"):
        adapter.run(Solid.box((0, 0, 0), (1, 1, 1)), 0.3, points=[[0.01, 0.5, 0.5]], layers=Layers(0.02))


def test_fixed_generators_that_make_room_for_layers_are_told(adapter):
    with pytest.warns(MismatchWarning, match=r"fixed\[1\] at \(0.16, 0.5, 0.5\) has moved by .* 2 of 2 have moved"):
        adapter.run(
            Solid.box((0, 0, 0), (1, 1, 1)),
            0.3,
            effort="fast",
            layers=Layers(0.02, 2),
            fixed=[[0.5, 0.5, 0.5], [0.16, 0.5, 0.5]],
        )


@pytest.mark.parametrize(
    ("layers", "error", "message"),
    [
        (Layers(0.1, 10), InputError, "layers leave no room"),
        (Layers(1e-6, 40_000, 1), InputError, "expected at most 32767"),
        ([0.1], InputTypeError, "expected clvoro.Layers"),
        (Layers(0.1, edges="lid"), InputError, "lid"),
    ],
)
def test_wrong_layers_are_refused(adapter, layers, error, message):
    with pytest.raises(error, match=message):
        adapter.run(Solid.box((0, 0, 0), (1, 1, 1)), 0.4, effort="fast", layers=layers)


def test_prisms_that_memory_does_not_hold_are_refused(adapter, monkeypatch):
    monkeypatch.setattr("clvoro.adaptation.estimates.host_memory", lambda: 2.0**20)
    with pytest.raises(MemoryLimitError, match=r"layers have about 2.76e\+03 prisms, which need .* MiB; .* 1 MiB"):
        adapter.run(Solid.box((0, 0, 0), (1e-3, 1e-3, 1e-3)), 2e-4, layers=Layers(1e-6, 20, 1))


def test_walls_beside_layers_stay_on_the_surface(adapter):
    """Vertices of a curved patch without layers follow those of its crease."""
    pipe = Solid.cylinder((0, 0, 0), (0, 0, 2), 0.7)
    assert adapter.run(pipe, 0.25, effort="fast", layers=Layers(0.02, 3, 1.3, edges="top")).check()


def test_a_cavity_that_is_left_out_passes_the_check(adapter):
    block = Solid.box((0, 0, 0), (1, 1, 1)) - Solid.ball((0.5, 0.5, 0.5), 0.04)
    mesh = adapter.run(block, 0.4, effort="fast", layers=Layers(0.02, edges="zMin"))
    assert len(mesh.left_out) == 1
    assert mesh.check()


def test_a_box_in_space_says_what_to_write(adapter):
    with pytest.raises(InputTypeError, match=r"write clvoro.Solid.box\(lower, upper\)"):
        adapter.run(clvoro.Box((0, 0, 0), (1, 1, 1)), 0.4, layers=Layers(0.01))
