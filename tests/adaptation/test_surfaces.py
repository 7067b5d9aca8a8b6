"""Surfaces inside boxes and solids: faces on them, regions on both sides, files, and what is refused."""

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError
from clvoro.geometry.solid.solid import Solid

BOX = clvoro.Box((0, 0, 0), (1, 1, 1))
CUBE = Solid.box((0.3, 0.3, 0.3), (0.7, 0.72, 0.7))


def rectangle(low, high, z=0.5, rise=0.0):
    corners = [(low, low, z - rise), (high, low, z - rise), (high, high, z + rise), (low, high, z + rise)]
    return np.array(corners), np.array([(0, 1, 2), (0, 2, 3)])


def fault(slope):
    """Two halves of a plane that is 0.5 + slope * (z - 0.5) in x, which meet where another one crosses."""
    x = [0.5 + slope * (z - 0.5) for z in (-0.1, 0.5, 1.1)]
    points = [(a, y, z) for a, z in zip(x, (-0.1, 0.5, 1.1), strict=True) for y in (-0.1, 1.1)]
    return np.array(points), np.array([(0, 1, 3), (0, 3, 2), (2, 3, 5), (2, 5, 4)])


FAULTED = 0.425, 0.425, 0.075, 0.075  # the volumes between them

CASES = {
    "cube": (BOX, {"heater": CUBE}, "float64", {"heater": CUBE.measure}, 1e-9),
    "touching": (
        BOX,
        {"left": Solid.box((0.25, 0.3, 0.3), (0.5, 0.7, 0.7)), "right": Solid.box((0.5, 0.3, 0.3), (0.75, 0.7, 0.7))},
        "float64",
        {"left": 0.04, "right": 0.04},
        1e-9,
    ),
    "crossing": (BOX, [fault(0.3), fault(-0.3)], "float64", {f"region-{k}": v for k, v in enumerate(FAULTED)}, 1e-9),
    "oblique": (BOX, rectangle(-0.2, 1.2, rise=0.3), "float32", {"region-0": 0.5, "region-1": 0.5}, 1e-5),
    "at a wall": (BOX, {"slab": Solid.box((0, 0, 0), (0.3, 1, 1))}, "float64", {"slab": 0.3}, 1e-9),
    "ball": (BOX, {"ball": Solid.ball((0.5, 0.5, 0.5), 0.3)}, "float64", {"ball": 4 / 3 * np.pi * 0.027}, 0.006),
    "solid": (
        Solid.box((0, 0, 0), (1, 1, 1)),
        {"rod": Solid.cylinder((0.5, 0.5, -0.2), (0.5, 0.5, 1.2), 0.25)},
        "float64",
        {"rod": np.pi / 16},
        0.003,
    ),
}

RADII = {"ball": 0.3, "solid": 0.25}
"""Of the curved surfaces."""


@pytest.fixture(scope="module")
def mesh(ctx):
    return clvoro.Adapter(ctx).run(BOX.with_surfaces({"heater": CUBE}), 0.12, "fast")


@pytest.mark.parametrize("case", CASES)
def test_faces_lie_on_surfaces_between_regions_with_the_volumes_of_the_solids(ctx, case):
    domain, surfaces, dtype, volumes, within = CASES[case]
    domain = domain.with_surfaces(surfaces)
    d = clvoro.Adapter(ctx, dtype).run(domain, 0.1, "fast").diagram
    f, region, rows = d.faces, d.cell_region, d.border_faces
    found = {name: d.volumes[region == k].sum() for k, name in enumerate(d.region_names)}
    for name, volume in volumes.items():
        assert found[name] == pytest.approx(volume, rel=within)
    assert sum(found.values()) == pytest.approx(1, rel=1e-6)
    i, j = f.owner[: f.n_inner], f.neighbor[: f.n_inner]
    assert np.array_equal(np.flatnonzero(region[i] != region[j]), rows)
    corners = np.concatenate([f.corners[f.starts[k] : f.starts[k + 1]] for k in rows])
    # Vertices are off curved surfaces by as much as their polygons cut off: at most .2 h^2 times the curvature.
    limit = 0.2 * 0.1**2 / RADII[case] if case in RADII else 1e-9 if dtype == "float64" else 2e-6
    assert domain.borders.sheets.distance(f.points[corners]).max() < limit
    # One face for each pair, about as large as a cell.
    assert np.median(f.area[rows]) == pytest.approx(0.01, rel=0.2)
    assert d.check(solver="openfoam")
    report = d.check()
    assert report, str(report)
    # Beside curved surfaces vertices are not on bisectors, and volumes are those of the corners. In float32 round-off
    # may do the same beside oblique ones.
    assert d.has_moved_vertices == ("surfaces inside" in report.checked)
    assert d.has_moved_vertices == (case in RADII) or dtype == "float32"
    x = d.vertices.copy()
    k = corners[np.abs(x[corners] - 0.5).sum(axis=1).argmin()]
    x[k] += 0.1 * (x[k] - 0.5) if case in RADII else 5e-3
    found = {finding.name for finding in d.with_arrays(vertices=x).check().findings}
    assert found >= {"face measures", "surfaces inside"}
    if case == "ball":
        assert d.transfer(d.centroids, d) == pytest.approx(d.centroids, abs=1e-12)


def test_open_surfaces_end_in_faces(ctx):
    domain = BOX.with_surfaces({"baffle": rectangle(0.3, 0.7)})
    d = clvoro.Adapter(ctx).run(domain, 0.1, "fast").diagram
    assert d.region_names == ["region-0"]
    assert d.faces.area[d.border_faces].sum() == pytest.approx(0.16, rel=1e-9)
    assert np.abs(d.faces.normal[d.border_faces][:, 2]) == pytest.approx(1)


def test_regions_and_faces_are_in_all_files(mesh, tmp_path):
    d = mesh.diagram
    for name in ("mesh.npz", "mesh.vtu"):
        mesh.save(tmp_path / name)
        again = clvoro.load(tmp_path / name).diagram
        assert again.domain.borders.names == ("heater",)
        assert np.array_equal(again.cell_region, d.cell_region)
        assert np.array_equal(again.border_faces, d.border_faces)
    mesh.save(tmp_path / "constant" / "polyMesh")
    zones = (tmp_path / "constant" / "polyMesh" / "cellZones").read_text()
    assert "region-0\n" in zones
    assert f"heater\n{{\n    type cellZone;\n    cellLabels List<label>\n{(d.cell_region == 1).sum()}\n" in zones
    faces = (tmp_path / "constant" / "polyMesh" / "faceZones").read_text()
    flips = faces.split("bool>")[1].split("(")[1].split(")")[0].split()
    # All normals point out of the cube, as those of its surface do.
    rows, against = d.domain.borders.face_sets(d)["heater"]
    assert len(flips) == len(rows)
    out = np.where(against, -1, 1) * np.where(d.cell_region[d.faces.owner[rows]] == 1, 1, -1)
    assert (out == 1).all()


def test_generators_beside_surfaces_are_mirror_images_and_nearest_to_them(mesh):
    domain, size = mesh.diagram.domain, lambda x: 0.08 + 0.05 * x[:, 0]
    pairs = domain.borders.place(domain, domain, size)
    surface = domain.borders.surface
    at = np.random.default_rng(1).dirichlet(np.ones(3), (400, len(surface)))
    x = np.einsum("ktc,tcd->ktd", at, surface.corners).reshape(-1, 3)
    away = np.sort(np.linalg.norm(x[:, None] - pairs.points, axis=2), axis=1)
    assert away[:, 0] == pytest.approx(away[:, 1], abs=1e-9)
    # Generators outside of all balls are farther from each point.
    inside = np.random.default_rng(2).uniform(0, 1, (20000, 3))
    free = inside[(np.linalg.norm(inside[:, None] - pairs.centers, axis=2) > pairs.radii).all(axis=1)]
    assert len(free) > 1000
    nearest = np.array([np.linalg.norm(free - p, axis=1).min() for p in x[::7]])
    assert (nearest > away[::7, 0]).all()


def test_domains_with_other_surfaces_are_other_domains():
    room, other = BOX.with_surfaces({"heater": CUBE}), BOX.with_surfaces({"oven": CUBE})
    assert room == BOX.with_surfaces({"heater": CUBE})
    assert len({room, BOX.with_surfaces({"heater": CUBE}), other, BOX}) == 3
    assert room.same_region(BOX)
    assert CUBE.with_surfaces(rectangle(0, 1)) != CUBE


def test_segments_cross_surfaces_as_often_as_they_change_sides():
    torus = Solid.torus((0.5, 0.5, 0.5), 0.3, 0.1, edge=0.05)
    sheets = BOX.with_surfaces(torus).borders.sheets
    a, b = np.random.default_rng(3).uniform(0, 1, (2, 500, 3))
    assert np.array_equal(sheets.crossed(a, b) % 2 == 1, torus.contains(a) != torus.contains(b))
    plate = BOX.with_surfaces(rectangle(0, 1)).borders.sheets
    through = np.array([(0.5, 0.5), (0.3, 0.3), (0.2, 0.7)])  # on the diagonal edge, too
    ends = [np.column_stack([through, np.full(3, z)]) for z in (0.2, 0.8)]
    assert plate.crossed(*ends).tolist() == [1, 1, 1]


MOEBIUS = np.array([(np.cos(t), np.sin(t), 0.0) for t in np.linspace(0, 2 * np.pi, 13)[:-1]])
STRIP = np.concatenate(
    [
        MOEBIUS * (1 + s * np.cos(np.arange(12) * np.pi / 12))[:, None]
        + s * np.outer(np.sin(np.arange(12) * np.pi / 12), (0, 0, 1))
        for s in (-0.3, 0.3)
    ]
)
TWIST = [(k, (k + 1) % 12 + 12 * (k == 11), k + 12) for k in range(12)] + [
    ((k + 1) % 12 + 12 * (k == 11), (k + 1) % 12 + 12 * (k < 11), k + 12) for k in range(12)
]


@pytest.mark.parametrize(
    ("domain", "surfaces", "error"),
    [
        (BOX, [CUBE, Solid.box((0.5, 0.5, 0.5), (0.9, 0.9, 0.9))], "cross or cover each other"),
        (BOX, Solid.box((2, 2, 2), (3, 3, 3)), "outside of"),
        (BOX, [], "is empty"),
        (BOX, [3], "expected a clvoro.Solid"),
        (BOX, (STRIP + 0.5, np.array(TWIST)), "one side only"),
        (clvoro.Box((0, 0), (1, 1)), CUBE, "are in space"),
        (clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True), rectangle(-0.1, 1.1), "periodic side"),
        (clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True), Solid.ball((0.5, 0.5, 0.5), 0.2), "curved"),
    ],
)
def test_what_is_refused_at_the_door(domain, surfaces, error):
    with pytest.raises((InputError, TypeError), match=error):
        domain.with_surfaces(surfaces)


@pytest.mark.filterwarnings("ignore::clvoro.errors.CoarseSizeWarning")
@pytest.mark.parametrize(
    ("surfaces", "size", "error"),
    [
        (Solid.ball((0.5, 0.5, 0.5), 0.1), 0.15, "too curved"),
        ([rectangle(0, 1, 0.5), rectangle(0, 1, 0.55)], 0.1, "too near to each other"),
        (rectangle(0, 1, 0.995), 0.1, "a wall is too near"),
        (Solid.box((0, 0, 0), (1, 1, 0.5)), 7.0, "smaller than the size"),
        (Solid.box((0, 0, 0), (1, 1, 1)), 0.1, "on the walls"),
        (Solid.box((0.3, 0.3, 0.3), (0.7, 0.7, 0.33)), 0.1, "is no edge"),
    ],
)
def test_surfaces_without_room_are_refused_with_the_place(ctx, surfaces, size, error):
    domain = BOX.with_surfaces(surfaces)
    with pytest.raises(InputError, match=error):
        clvoro.Adapter(ctx).run(domain, size, "fast")
    with pytest.raises(InputError, match="leave out the layers"):
        domain.borders.place(domain, BOX, lambda x: np.full(len(x), size))
