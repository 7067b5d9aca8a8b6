"""Fields from the files of other programs."""

import csv

import numpy as np
import pytest
import scipy

import clvoro
from clvoro import sizing
from clvoro.errors import ClvoroError, InputError, InputTypeError, MismatchWarning

SQUARE = clvoro.Box((0, 0), (1, 1))
CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))
GLOBE = clvoro.Sphere(6371e3)


def bent(x):
    """A quadratic function of positions (n, d)."""
    return 1 + x[:, 0] - 2 * x[:, 0] * x[:, 1] + 3 * x[:, 1] ** 2


@pytest.fixture(scope="module")
def mesh():
    return clvoro.adapt(SQUARE, 0.1, "fast")


@pytest.fixture(scope="module")
def globe():
    return clvoro.voronoi(GLOBE, GLOBE.icosahedral_points(3))


def grid(dim, n=9):
    return np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * dim), axis=-1).reshape(-1, dim)


def save_table(path, mesh):
    x = np.random.default_rng(1).random((200, 2))
    with open(path, "w", newline="") as file:
        csv.writer(file).writerows([["x", "y", "u", "w:0", "w:1"], *np.column_stack([x, bent(x), x]).tolist()])


def save_arrays(path, mesh):
    x = grid(2)
    np.savez(path, points=x, u=bent(x), w=x)


def save_mesh(path, mesh):
    u = bent(mesh.centroids)
    mesh.save(path, cell_data={"u": u, "w": np.column_stack([mesh.centroids, 0 * u])})


def save_ugrid(path, mesh):
    mesh.save(path, cell_data={"u": bent(mesh.points), "w": mesh.points})


def save_triangles(path, mesh):
    import meshio

    x = grid(2)
    space = np.column_stack([x, 0 * x[:, 0]])
    cells = [("triangle", scipy.spatial.Delaunay(x).simplices), ("line", np.array([[0, 1]]))]
    meshio.Mesh(space, cells, point_data={"u": bent(x), "w": space}).write(path)


def save_quadrilaterals(path, mesh):
    """One layer of hexahedra, with data in cells."""
    import meshio

    n = 12
    x = grid(2, n + 1)
    x = np.concatenate([np.column_stack([x, 0 * x[:, 0] + z]) for z in (0, 0.1)])
    k = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    base = np.stack([k, k + 1, k + n + 2, k + n + 1], axis=1)
    cells = np.concatenate([base, base + (n + 1) ** 2], axis=1)
    center = x[cells].mean(axis=1)
    meshio.Mesh(x, [("hexahedron", cells)], cell_data={"u": [bent(center)], "w": [center * [1, 1, 0]]}).write(path)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("points.csv", save_table),
        ("points.npz", save_arrays),
        ("mesh.npz", save_mesh),
        ("mesh.vtu", save_mesh),
        ("mesh.nc", save_ugrid),
        ("triangles.vtu", save_triangles),
        ("triangles.xdmf", save_triangles),
        ("hexahedra.vtk", save_quadrilaterals),
    ],
)
def test_fields_in_the_plane(mesh, tmp_path, name, write):
    """A quadratic function is exact, wherever the values are; the second field is the position."""
    write(tmp_path / name, mesh)
    found, values = clvoro.read_fields(tmp_path / name, ["u", "w"], domain=SQUARE)
    x = found.centroids
    assert values["w"] == pytest.approx(x, abs=1e-9)
    assert values["u"] == pytest.approx(bent(x), abs=1e-9)
    bend = sizing.derivatives(values["u"], found)[1]
    assert bend == pytest.approx(np.tile([[0.0, -2], [-2, 6]], (len(x), 1, 1)), abs=1e-8)
    assert found.volumes.sum() == pytest.approx(1)
    size = sizing.hessian_size([values["u"], values["w"]], on=found, n_cells=300)
    assert size.n_cells == pytest.approx(300, rel=1e-3)
    assert set(clvoro.read_fields(tmp_path / name, domain=SQUARE)[1]) >= {"u", "w"}


def test_fields_in_space(tmp_path):
    """Of tetrahedra, in a box and in a ball; their corners are on the walls."""
    import meshio

    x = grid(3, 6)
    meshio.Mesh(x, [("tetra", scipy.spatial.Delaunay(x).simplices)], point_data={"u": bent(x)}).write(
        tmp_path / "t.vtu"
    )
    found, values = clvoro.read_fields(tmp_path / "t.vtu", "u", domain=CUBE)
    assert len(found) == len(x)
    assert values["u"] == pytest.approx(bent(found.points), abs=1e-12)
    ball = clvoro.Solid.ball((0.5, 0.5, 0.5), 0.4)
    found, values = clvoro.read_fields(tmp_path / "t.vtu", domain=ball)
    assert 20 < len(found) < len(x)
    assert found.volumes.sum() > 0.7 * ball.measure
    assert values["u"] == pytest.approx(bent(found.points), abs=1e-12)


@pytest.mark.parametrize("convention", ["ugrid", "mpas"])
def test_fields_on_a_sphere(globe, tmp_path, convention):
    u = globe.points[:, 2] / 6371e3
    globe.to_netcdf(tmp_path / "g.nc", convention=convention, cell_data={"u": u, "v": np.column_stack([u, 2 * u])})
    found, values = clvoro.read_fields(tmp_path / "g.nc", ["u", "v"], domain=clvoro.Sphere(1.0))
    assert values["u"] == pytest.approx(found.points[:, 2], abs=1e-9)
    assert values["v"] == pytest.approx(np.column_stack([u, 2 * u])[np.argsort(u)][np.argsort(np.argsort(values["u"]))])
    after = clvoro.adapt(clvoro.Sphere(1.0), sizing.OnCells(found, 0.2 + 0.1 * values["u"]), "fast")
    north = after.points[:, 2] > 0
    assert north.sum() < 0.7 * (~north).sum()


@pytest.mark.parametrize("on_globe", [False, True])
def test_faces_whose_corners_alone_have_coordinates(tmp_path, on_globe):
    """By UGRID: counted from 1, rows that are filled up, and on the globe faces across the date line."""
    globe = clvoro.Sphere(1.0)
    x = globe.icosahedral_points(1) if on_globe else grid(2)
    corners = scipy.spatial.ConvexHull(x).simplices if on_globe else scipy.spatial.Delaunay(x).simplices
    middle = x[corners].mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1)[:, None] if on_globe else 1
    file = scipy.io.netcdf_file(tmp_path / "m.nc", "w")
    for name, size in (("node", len(x)), ("face", len(corners)), ("side", 4)):
        file.createDimension(name, size)
    filled = np.pad(corners.astype(np.int32) + 1, ((0, 0), (0, 1)), constant_values=-1)
    plane = globe.lonlat(x) if on_globe else x
    for name, kind, dims, values in (
        ("lon", "d", ("node",), plane[:, 0]),
        ("lat", "d", ("node",), plane[:, 1]),
        ("table", "i", ("side", "face"), filled.T),
        ("u", "d", ("face",), middle[:, -1]),
        ("topology", "i", (), 0),
    ):
        file.createVariable(name, kind, dims)[...] = values
    if on_globe:
        file.variables["lon"].units, file.variables["lat"].units = "degrees_east", "degrees_north"
    else:
        file.variables["lon"].units = file.variables["lat"].units = "m"
    file.variables["table"].start_index, file.variables["table"]._FillValue = 1, -1
    for key, text in (("node_coordinates", "lon lat"), ("face_node_connectivity", "table"), ("face_dimension", "face")):
        setattr(file.variables["topology"], key, text)
    file.variables["u"].mesh, file.variables["u"].location = "topology", "face"
    file.close()
    found, values = clvoro.read_fields(tmp_path / "m.nc", "u", domain=globe if on_globe else SQUARE)
    assert len(found) == len(corners)
    assert values["u"] == pytest.approx(found.points[:, -1], abs=1e-9)


def write_ocean(path):
    """Longitudes and latitudes at three times, without values on land."""
    lon, lat = np.meshgrid(np.arange(5.0, 365, 10), np.arange(-85.0, 90, 10))
    lon, lat = lon.ravel(), lat.ravel()
    u = np.array([t + np.sin(np.radians(lat)) for t in range(3)])
    u[:, lat < -70] = -999
    file = scipy.io.netcdf_file(path, "w")
    for name, size in (("time", 3), ("n", len(lon))):
        file.createDimension(name, size)
    for name, dims, values in (("lon", ("n",), lon), ("lat", ("n",), lat), ("t", ("time", "n"), u)):
        file.createVariable(name, "d", dims)[:] = values
    file.variables["lon"].units, file.variables["lat"].units = "degrees_east", "degrees_north"
    file.variables["t"].coordinates = "lon lat"
    file.variables["t"]._FillValue = -999.0
    file.close()


def test_times_and_missing_values(tmp_path):
    path = tmp_path / "ocean.nc"
    write_ocean(path)
    for time, least in ((None, 2), (0, 0)):
        found, values = clvoro.read_fields(path, domain=clvoro.Sphere(1.0), time=time)
        assert values["t"] == pytest.approx(least + found.points[:, 2])
        assert len(found) == 36 * 16
    with pytest.raises(InputError, match="t has 3 times, and time is 7; expected 0 to 2"):
        clvoro.read_fields(path, domain=clvoro.Sphere(1.0), time=7)


def table(text, **options):
    def call(tmp_path):
        (tmp_path / "f.csv").write_bytes(text.encode(options.pop("encoding", "utf-8")))
        return clvoro.read_fields(tmp_path / "f.csv", **{"domain": SQUARE, **options})

    return call


def arrays(**given):
    def call(tmp_path):
        np.savez(tmp_path / "f.npz", **given)
        return clvoro.read_fields(tmp_path / "f.npz", domain=SQUARE)

    return call


POINTS = "\n".join(f"{x},{y},{x + y}" for x in (0.1, 0.5, 0.9) for y in (0.1, 0.5, 0.9))


@pytest.mark.parametrize(
    ("call", "kind", "text"),
    [
        (table("x,y,u\n" + POINTS, fields=["p", "u"]), InputError, "it has no field p; it has u"),
        (table("x,y,u\n" + POINTS, domain=None), InputTypeError, "domain is none, expected that to be adapted"),
        (table("x,y,u\n" + POINTS, time=2), InputError, "it has no times, and time is 2; leave it out"),
        (table("x,y,u\n" + POINTS, fields=[]), InputTypeError, "expected names of fields"),
        (table("a,b,u\n" + POINTS), InputError, "expected x, y .* or lon, lat among them"),
        (table("x,y\n" + POINTS), InputError, "row '0.1, 0.1, 0.2.*' has 3 items, expected 2 numbers"),
        (table("x,y,u\n1,2\n"), InputError, "expected 3 numbers"),
        (table("x,y,u\n1,2,three\n"), InputError, "column u has other items than numbers .*three"),
        (table("x,y,x\n" + POINTS), InputError, "two columns 'x', expected one"),
        (table("x,y,u\n" + POINTS, encoding="utf-16"), InputError, "no text in UTF-8; save it"),
        (table("x,y,u\nnan,0.5,1\n" + POINTS), InputError, r"has a point \[nan, 0.5\], expected finite .*1 of 10"),
        (table("x,y,u\n" + POINTS, fields=3), InputTypeError, "expected names of fields"),
        (table("x,y,u\n" + POINTS, time=np.nan), InputError, "time is nan, expected a finite number$"),
        (arrays(points=np.zeros((0, 2)), u=np.zeros((0, 1))), InputError, "u has shape|points of shape"),
        (arrays(points=grid(2), u=3.0), InputError, "it has no fields"),
        (arrays(points=grid(2), u=np.zeros((81, 0))), InputError, r"u has shape \(81, 0\)"),
        (arrays(points=grid(2), u=np.ones(81) * 1j), InputError, "dtype complex128, expected"),
        (table("x,y,u\n0,0,nan\n1,1,3\n" + POINTS), InputError, r"u is nan at \[0.0, 0.0\], expected finite values"),
        (table("x,y,u\n" + POINTS, domain=clvoro.Box((100, 0), (200, 1))), InputError, "of which 0 are in Box"),
        (table("x,y,u\n" + POINTS, domain=CUBE), InputError, "points with 2 coordinates, expected 3"),
        (table("lon,lat,u\n" + POINTS, domain=CUBE), InputError, "expected 3 in"),
        (lambda folder: clvoro.read_fields(folder / "none.vtu", domain=SQUARE), InputError, "No such file"),
        (lambda folder: clvoro.read_fields(folder, domain=SQUARE), InputError, "^/.* has no system/controlDict"),
        (lambda folder: clvoro.read_fields(3, domain=SQUARE), InputTypeError, "name of a file"),
    ],
)
def test_bad_files_are_refused(tmp_path, call, kind, text):
    with pytest.raises(kind, match=text):
        call(tmp_path)


def test_tables_of_other_programs(tmp_path):
    """A separator at the end of lines, texts in other columns, and both names that ParaView gives to components."""
    rows = POINTS.split("\n")
    labels = "x;y;u;part;\n" + "\n".join(row.replace(",", ";") + ";wall;" for row in rows)
    for mark in ":_":
        head = f"Points{mark}0,Points{mark}1,U{mark}0,U{mark}1\n"
        x = table(head + "\n".join(f"{row},1" for row in rows), fields="U")(tmp_path)[1]["U"]
        assert x.tolist() == [[u, 1] for u in x[:, 0]]
        found, values = table(labels, fields="u")(tmp_path)
        assert values["u"].tolist() == x[:, 0].tolist() == pytest.approx(found.points.sum(axis=1))


def test_files_that_are_damaged(tmp_path, capfd):
    for name in ("f.vtu", "f.nc", "f.npz", "f.vtk", "f.msh"):
        (tmp_path / name).write_bytes(b"\x00what is this?")
        with pytest.raises(ClvoroError, match=f"cannot load .*{name}"):
            clvoro.read_fields(tmp_path / name, domain=SQUARE)
    assert capfd.readouterr() == ("", "")


def test_names_in_files_of_clvoro(mesh, tmp_path):
    """An error has all names; whole numbers are read by name."""
    for name in ("mesh.vtu", "mesh.npz", "mesh.nc"):
        mesh.save(tmp_path / name, cell_data={"u": mesh.volumes, "k": np.arange(len(mesh))})
        assert set(clvoro.read_fields(tmp_path / name, "k", domain=SQUARE)[1]["k"]) == set(range(len(mesh)))
        with pytest.raises(InputError, match=r"it has no field v; it has .*k"):
            clvoro.read_fields(tmp_path / name, ["u", "v"], domain=SQUARE)


def test_fields_that_cover_little_are_warned_of(tmp_path):
    with pytest.warns(MismatchWarning, match="covers 0.07"):
        table("x,y,u\n" + POINTS, domain=clvoro.Box((0, 0), (3, 3)))(tmp_path)
