"""Solids from files, bodies in a box, booleans; and surfaces that bound no region."""

import numpy as np
import pytest

from clvoro import Box, Solid
from clvoro.errors import ClvoroError, InputError, MismatchWarning
from clvoro.geometry import surface_files
from clvoro.geometry.solid import wrapping

CUBE = Solid.box((0, 0, 0), (1, 1, 1))
V, T = CUBE.surface.vertices, CUBE.surface.triangles


def ascii_stl(parts):
    """An STL file with a solid for each name."""
    lines = []
    for name, triangles in parts.items():
        lines.append(f"solid {name}")
        for corners in V[triangles]:
            lines += ["facet normal 0 0 0", "outer loop", *(f"vertex {x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners)]
            lines += ["endloop", "endfacet"]
        lines.append(f"endsolid {name}")
    return "\n".join(lines) + "\n"


def test_solids_of_an_stl_file_become_boundaries(tmp_path):
    (tmp_path / "part.stl").write_text(ascii_stl({"in let": T[:2], "outlet": T[2:4], "wall": T[4:]}))
    solid = Solid.read(tmp_path / "part.stl", units="mm", names={"walls": ["wall"]})
    assert solid.measure == pytest.approx(1e-9)
    assert solid.boundary_names == ("walls", "in_let", "outlet")
    assert np.bincount(solid.boundary_index).tolist() == [4, 1, 1]


@pytest.mark.parametrize("kind", ["stl", "ply", "off", "obj", "3mf"])
def test_every_format_brings_the_same_solid(tmp_path, kind):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / f"ball.{kind}"
    ball = Solid.ball((1, 2, 3), 0.5, edge=0.2)
    mesh = trimesh.Trimesh(ball.surface.vertices, ball.surface.triangles, process=False)
    mesh.export(path)
    solid = Solid.read(path)
    assert solid.measure == pytest.approx(ball.measure, rel=1e-6)
    assert (solid.n_patches, solid.n_pieces) == (1, 1)
    assert Solid.from_trimesh(mesh).measure == pytest.approx(ball.measure)


def test_ends_of_a_vessel_that_are_not_quite_flat_are_closed():
    """The border of a sheet is none: it is as large as its part."""
    pytest.importorskip("manifold3d")
    pipe = Solid.cylinder((0, 0, 0), (0, 0, 4), 0.5, edge=0.1)
    wall = pipe.surface.triangles[np.abs(pipe.normals[:, 2]) < 0.5]
    vertices = pipe.surface.vertices + np.outer(0.03 * pipe.surface.vertices[:, 0] ** 2 / 0.25, (0, 0, 1))
    with pytest.warns(MismatchWarning, match="closed 2 flat holes"):
        vessel = Solid(vertices, wall, repair=True)
    assert vessel.measure == pytest.approx(pipe.measure, rel=0.01)
    short = vertices * (1, 1, 0.1)
    with pytest.raises(InputError, match="is open"):
        Solid(short + np.outer(0.03 * vertices[:, 0] ** 2 / 0.25, (0, 0, 1)), wall, repair=True)


def test_parts_of_step_files_are_united(tmp_path, monkeypatch):
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.addCylinder(0, 0, 0, 0, 0, 20, 5)
        gmsh.model.occ.addBox(-2, -2, 15, 4, 4, 10)  # overlaps
        gmsh.model.occ.addBox(-2, -2, 25, 4, 4, 5)  # touches
        gmsh.model.occ.synchronize()
        gmsh.write(str(tmp_path / "part.step"))
    finally:
        gmsh.finalize()
    solid = Solid.read(tmp_path / "part.step")
    assert solid.measure == pytest.approx(np.pi * 0.005**2 * 0.02 + 0.004**2 * 0.01, rel=0.02)
    assert (solid.n_patches, solid.n_pieces) == (3 + 5, 1)
    monkeypatch.setattr(surface_files, "_MOST_POINTS", 99)
    with pytest.raises(InputError, match=r"expected at most 99, .* export it as STL"):
        Solid.read(tmp_path / "part.step")


def test_tiny_fillets_of_step_files_become_chamfers_of_few_triangles(tmp_path):
    gmsh = pytest.importorskip("gmsh")
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        plate = gmsh.model.occ.addBox(0, 0, 0, 100, 80, 10)
        gmsh.model.occ.synchronize()
        gmsh.model.occ.fillet([plate], [8], [0.05])
        gmsh.model.occ.synchronize()
        gmsh.write(str(tmp_path / "plate.step"))
    finally:
        gmsh.finalize()
    solid = Solid.read(tmp_path / "plate.step")
    assert solid.measure == pytest.approx(8e-5, rel=1e-5)
    assert len(solid.surface.triangles) < 20_000  # 239,000 if they are as small as the fillet bends
    assert solid.n_patches == 6  # as of a chamfer


def test_the_outside_of_a_body_has_the_names_of_both():
    for option in ({"group_names": ["body"]}, {"name": "body"}):
        assert Solid.box((0, 0, 0), (1, 1, 1), **option).boundary_names == ("body",)
    body = Solid.ball((0, 0, 0), 1, edge=0.3, group_names=("ball",))
    region = body.outside(Box((-2, -2, -2), (4, 2, 2), names={"inlet": "xMin"}))
    assert region.boundary_names == ("inlet", "xMax", "yMin", "yMax", "zMin", "zMax", "ball")
    assert region.measure == pytest.approx(6 * 16 - body.measure)
    assert region.contains(np.array([(0, 0, 0), (1.5, 0, 0)])).tolist() == [False, True]
    assert Solid.outside(CUBE, ((-1, -1, -1), (2, 2, 2))).boundary_names[6:] == tuple(
        f"body-{axis}{end}" for axis in "xyz" for end in ("Min", "Max")
    )
    with pytest.raises(InputError, match="do not overlap"):
        Solid.outside(CUBE, ((5, 5, 5), (6, 6, 6)))
    pytest.importorskip("manifold3d")
    with pytest.warns(MismatchWarning, match="do they have the same unit"):
        Solid(1000 * V, T).outside(((-1, -1, -1), (1, 1, 1)))


def test_a_cavity_of_the_body_is_not_outside():
    shell = Solid.outside(CUBE, ((-1, -1, -1), (2, 2, 2)))
    assert Solid.outside(shell, ((-5, -5, -5), (5, 5, 5))).measure == pytest.approx(1000 - 27)


def test_booleans_keep_names():
    pytest.importorskip("manifold3d")
    pin = Solid.cylinder((0.5, 0.5, -1), (0.5, 0.5, 2), 0.2, group_names=("pin", "low", "high"))
    hole = CUBE - pin
    assert hole.boundary_names == (*CUBE.boundary_names, "pin")
    area = CUBE.measure - hole.measure
    assert area == pytest.approx(np.pi * 0.04, rel=0.01)
    assert (CUBE + pin).measure == pytest.approx(1 + 2 * area)
    assert (CUBE & pin).measure == pytest.approx(area)
    on_floor = Solid.outside(CUBE, ((-1, -1, 0), (2, 2, 2)))
    uneven = Solid(V + 1e-16 * np.random.default_rng(0).standard_normal(V.shape), T)
    assert Solid.outside(uneven, ((-1, -1, 0), (2, 2, 2))).measure == pytest.approx(17)
    assert on_floor.measure == pytest.approx(17)
    with pytest.raises(InputError, match="leaves nothing"):
        CUBE - Solid.box((-1, -1, -1), (2, 2, 2))


def test_several_solids_and_their_pieces():
    far = Solid(np.vstack([V, V + 3, V + np.array([0, 0, 5])]), np.vstack([T, T + 8, T + 16]))
    assert (far.n_pieces, far.measure) == (3, pytest.approx(3))
    assert far.piece_of(np.array([(0.5, 0.5, 0.5), (3.5, 3.5, 3.5), (0.5, 0.5, 5.5), (2, 2, 2)])).tolist() == [
        0,
        1,
        2,
        -1,
    ]
    assert far.piece_of(far.inner_points()).tolist() == [0, 1, 2]


def with_gap(apart):
    """The cube as separate triangles, with some corners a little apart."""
    corners = V[T].copy()
    corners[5, 1] += apart
    return corners.reshape(-1, 3), np.arange(36).reshape(-1, 3)


FLIPPED = np.vstack([T[:3, ::-1], T[3:]])


@pytest.mark.parametrize(
    ("vertices", "triangles", "says"),
    [
        (V, T[1:], r"3 edges .* Here repair=True closes it .closed 1 flat hole\)"),
        (V, T[:2], "4 edges .* with_surfaces. Or pass wrap="),
        (*with_gap(1e-4), r"join=0\.000\d+ closes it"),
        (V, np.vstack([T, T[:1], T[3:4]]), "2 duplicate triangles"),
        (V, FLIPPED, "oriented differently"),
        (V, T[:, ::-1], "inside out"),
        (np.vstack([V, V + 0.5]), np.vstack([T, T + 8]), "intersects itself"),
        (np.vstack([V, 0.5 * V + 0.25]), np.vstack([T, T + 8]), "lie in each other"),
        (np.where((V == 1).all(axis=1)[:, None], -0.2, V), T, "triangles"),
    ],
)
def test_surfaces_that_bound_no_region_are_refused_with_the_place(vertices, triangles, says):
    with pytest.raises(InputError, match=says):
        Solid(vertices, triangles)


def sides(vertices, *axes):
    """The triangles of a cube without the sides across the axes."""
    flat = [np.ptp(vertices[T][:, :, axis], axis=1) == 0 for axis in axes]
    return T[~np.any(flat, axis=0)]


SMALL = 0.5 * V + 0.25
TALL = SMALL * (1, 1, 2) - (0, 0, 0.5)
FIN = np.vstack([V, (2, 0.5, 0.5)])


@pytest.mark.parametrize(
    ("vertices", "triangles", "says", "volume"),
    [
        (*with_gap(1e-4), "joined vertices", 1),
        (V, np.vstack([T, T[:1], T[3:4]]), "removed 2 duplicate", 1),
        (FIN, np.vstack([T, [(0, 1, 8), (0, 8, 1)]]), "removed 2 duplicate", 1),
        (V, FLIPPED, "flipped 3 triangles", 1),
        (V, T[:, ::-1], "flipped 12 triangles", 1),
        (np.vstack([V, SMALL]), np.vstack([T, T + 8]), "flipped 12 triangles", 0.875),
        (V, sides(V, 2), "closed 2 flat holes", 1),
        (np.vstack([V, TALL]), np.vstack([sides(V, 2), sides(TALL, 2) + 8]), "closed 2 flat holes", 0.75),
        (np.vstack([V, V + 0.5]), np.vstack([T, T + 8]), "united 2 parts", 1.875),
        (np.vstack([V, np.add(V, (1, 0, 0))]), np.vstack([T, T + 8]), "removed 4 duplicate", 2),
        (np.vstack([V, V * (1, -1, 1) + (1, 1, 0)]), np.vstack([T, T[:, ::-1] + 8]), "united 2 parts", 2),
        (np.vstack([V, np.add(V, (1, 0.5, 0)), V + 3]), np.vstack([T, T + 8, T + 16]), "united 2 parts", 3),
    ],
)
def test_repair_mends_what_is_certain_and_says_so(vertices, triangles, says, volume):
    with pytest.raises(InputError):
        Solid(vertices, triangles)
    with pytest.warns(MismatchWarning, match=says):
        solid = Solid(vertices, triangles, repair=True)
    assert solid.measure == pytest.approx(volume, rel=1e-3)
    holes = [name for name in solid.boundary_names if name.startswith("hole")]
    assert holes == (["hole-1", "hole-2"] if "holes" in says else [])


RING = np.array([(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])


@pytest.mark.parametrize(
    ("vertices", "triangles", "bottom", "volume"),
    [
        (V, T[(V[T][:, :, 2] == 1).all(axis=1)], -2, 3),
        (V + 5, T[(V[T][:, :, 2] == 0).all(axis=1)], 4, 1),  # normals downwards
        (  # with a hole
            np.vstack([RING, 0.5 * RING + (0.25, 0.25, 0.5)]),
            [t for k in range(4) for t in ((k, (k + 1) % 4, (k + 1) % 4 + 4), (k, (k + 1) % 4 + 4, k + 4))],
            0,
            0.75,
        ),
    ],
)
def test_the_ground_below_a_sheet_is_a_solid(vertices, triangles, bottom, volume):
    ground = Solid(vertices, triangles, group_names=["top"], bottom=bottom)
    assert ground.measure == pytest.approx(volume)
    assert ground.boundary_names == ("top", "side", "bottom")


@pytest.mark.parametrize(
    ("vertices", "triangles", "wrap", "volume"),
    [
        (V, T[:2], np.float32(0.2), 0.267),  # a sheet: a plate with round edges
        (V, T[2:], 0.2, 1.0),  # five sides of a cube: a hollow one
        (V, sides(V, 2)[1:], 0.2, 0.8),
        (np.vstack([V, V + 0.5]), np.vstack([T, T[:2], T + 8]), 0.2, 3.07),  # cubes that cross, and triangles twice
        (V, T, 1, 5.8),  # an integer
    ],
)
def test_a_wrap_is_closed_around_all_triangles(vertices, triangles, wrap, volume):
    with pytest.warns(MismatchWarning, match="wrapped, at most 0") as caught:
        solid = Solid(vertices, triangles, group_names=["body"], wrap=wrap)
    assert solid.measure == pytest.approx(volume, rel=0.1)
    assert (len(caught), len(solid.creases), solid.boundary_names) == (1, 0, ("body",))
    air = Solid.outside(solid, Box((-1, -1, -1), (3, 3, 3), names={"sides": range(6)}))
    assert (air.n_patches, air.boundary_names) == (7, ("sides", "body"))
    given = vertices[np.unique(triangles)]
    assert solid.contains(given).all()
    assert solid.boundary_distance(given).min() > 0.06


@pytest.mark.filterwarnings("ignore::clvoro.errors.MismatchWarning")
def test_a_wrap_that_would_cross_itself_keeps_more_triangles(monkeypatch):
    monkeypatch.setattr(wrapping, "_SIMPLER", (2.0, 2.0))
    with pytest.raises(InputError, match="intersects itself"):
        Solid(V, T[2:], wrap=0.2)
    monkeypatch.setattr(wrapping, "_SIMPLER", (2.0, 0.1))
    assert Solid(V, T[2:], wrap=0.2).measure > 0.2


COPY = {"groups": np.arange(13) // 12, "group_names": ["a", "b"]}
SIX = {"groups": np.arange(12) // 2, "group_names": list("abcdef")}


@pytest.mark.parametrize(
    ("inside", "shift", "chains", "corners", "volume"),
    [(None, 0, 2, 0, 1.65), ((1e7 + 0.5, 1e7 + 0.5, 1e7 + 0.5), 1e7, 12, 8, 0.455)],
)
def test_a_wrap_keeps_the_groups_that_names_mention(inside, shift, chains, corners, volume):
    names = {"inlet": "a", "outlet": "b"} if inside is None else {"inlet": "a", **{name: name for name in "bcdef"}}
    with pytest.warns(MismatchWarning, match="wrapped"):
        solid = Solid(V + shift, T, **SIX, wrap=0.2, names=names, inside=inside)
    assert solid.boundary_names == (*names, *(["wall"] if inside is None else []))
    assert (solid.creases.n_chains, len(solid.corners), solid.n_patches) == (chains, corners, len(solid.boundary_names))
    assert solid.measure == pytest.approx(volume, rel=0.05)


def test_vertices_within_round_off_are_one():
    assert Solid(*with_gap(1e-15)).measure == pytest.approx(1)


def test_edges_sharper_than_ten_degrees_are_warned_of():
    wedge = np.array([(0, 0, 0), (1, 0, 0), (1, 0.1, 0)])
    vertices = np.vstack([wedge, wedge + np.array([0, 0, 1])])
    triangles = [(0, 2, 1), (3, 4, 5), (0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)]
    with pytest.warns(MismatchWarning, match="1 edge sharper than 10 degrees"):
        Solid(vertices, triangles)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"groups": [0, 1]}, "groups have shape"),
        ({"name": "my part"}, "group_names has 'my part', expected a word"),
        ({"wrp": 0.1}, "got 'wrp', expected an option of Solid: .*wrap"),
        ({"angle": 200}, "angle is 200"),
        ({"creases": [(0, 99)]}, "creases have vertices up to 99"),
        ({"names": {"inlet": "nowhere"}}, "nowhere"),
        ({"wrap": -1}, "wrap is -1, expected a length"),
        ({"wrap": True}, "wrap is True, expected a length"),
        ({"wrap": 1e-20}, "too small for its extent"),
        ({"wrap": 20}, "wrap is 20, longer than the surface, 1; .* unit"),
        ({"wrap": 0.2, "creases": [(0, 1)]}, "creases and wrap"),
        ({"wrap": 0.2, "names": {"inlet": "c"}}, "names has 'c', expected a group, wall"),
        ({"inside": (0, 0, 0)}, "inside without wrap"),
        ({"wrap": 0.2, "inside": (0.5, 0.5, 0.03)}, "from the surface, expected a point farther"),
        ({"wrap": 0.2, "inside": (0.5, 2)}, "expected a point, three numbers"),
        ({"wrap": 0.2, "inside": (0.5, 0.5, 0.5), "triangles": T[2:]}, r"gap 1.07 wide leads out at \(0, 0\.4"),
        ({"wrap": 0.2, "triangles": [*T, T[0]], "names": {"b": "b"}} | COPY, "no place for 'b'"),
    ],
)
def test_wrong_options_are_refused(options, says):
    with pytest.raises(ClvoroError, match=says):
        Solid(**{"vertices": V, "triangles": T, **options})


def test_creases_can_be_drawn_on_a_flat_wall():
    solid = Solid.box((0, 0, 0), (1, 1, 1), creases=np.array([[0, 6], [2, 4]]))
    assert solid.n_patches == 7
    assert np.count_nonzero(solid.creases.concave) == 1
    with pytest.raises(InputError, match="units is 'inch'"):
        Solid.read(__file__.replace("test_files_and_booleans.py", "none.stl"), units="inch")
