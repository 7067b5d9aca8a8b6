"""Files, and meshes of other libraries: of diagrams, and with data of the caller."""

import io
import zipfile

import numpy as np
import pytest
from scipy.io import netcdf_file

import clvoro
from clvoro.errors import ClvoroError, InputError, InputTypeError

SQUARE = np.array([(0.0, 0), (1, 0), (1, 1), (0, 1)])
DOMAINS = {
    "flat": clvoro.Box((-1, 0), (2, 1.5), names={"inlet": "xMin"}),
    "torus": clvoro.Box((0, 0), (3, 1.5), periodic=True),
    "channel": clvoro.Box((3, -2), (5.5, -0.5), periodic=(True, False)),
    "polygon": clvoro.Polygon(
        [(0, 0), (4, 0), (4, 3), (2, 1), (0, 3)], [[(1, 0.5), (2, 0.5), (2, 0.8)]], names={"isle": [5, 7], "in": [1]}
    ),
    "pieces": clvoro.Polygon.from_pieces(
        [[SQUARE, SQUARE * 0.3 + 0.3], [SQUARE * 0.1 + 0.4], [SQUARE + 1]], names={"far": [9]}
    ),
    "solid": clvoro.Box((0, 0, 5), (1, 2, 6)),
    "slab": clvoro.Box((0, 0, 0), (2, 1, 1.3), periodic=(True, False, True)),
}


@pytest.fixture(scope="module", params=list(DOMAINS))
def diagram(request, ctx):
    domain = DOMAINS[request.param]
    points = np.random.default_rng(3).uniform(domain.lower, domain.upper, (300, domain.dim))
    points = np.concatenate([domain.inner_points(), points[domain.contains(points)]])
    return clvoro.Adapter(ctx).diagram(domain, points[:40])


@pytest.fixture(scope="module")
def result(ctx):
    return clvoro.Adapter(ctx).run(DOMAINS["flat"], 0.3, effort="fast")


def data_for(n):
    rng = np.random.default_rng(8)
    return {
        "pressure": rng.standard_normal(n),
        "velocity": rng.standard_normal((n, 2)).astype(np.float32),
        "kind": np.arange(n) % 3 == 0,
        "big.number": np.arange(n, dtype=np.int64) + 2**40,
    }


@pytest.mark.sparse(3)
@pytest.mark.parametrize("suffix", [".npz", ".vtu"])
def test_a_diagram_is_loaded_as_it_was_saved(diagram, tmp_path, suffix):
    path = tmp_path / f"diagram{suffix}"
    diagram.save(path, cell_data=data_for(len(diagram)))
    again = clvoro.load(path)
    assert type(again) is clvoro.Diagram
    assert again.domain == diagram.domain
    assert again.check()
    for name in diagram._there() if suffix == ".npz" else ("points", "volumes", "neighbors", "shifts"):
        np.testing.assert_array_equal(getattr(again, name), getattr(diagram, name))
    assert again.domain.boundary_names == diagram.domain.boundary_names
    assert np.array_equal(again.domain.boundary_index, diagram.domain.boundary_index)


def test_own_data_in_vtu_and_npz(diagram, tmp_path):
    data = data_for(len(diagram))
    diagram.save(tmp_path / "a.npz", cell_data=data)
    with np.load(tmp_path / "a.npz") as file:
        for name, values in data.items():
            np.testing.assert_array_equal(file[f"cell_data.{name}"], values)
    diagram.save(tmp_path / "a.vtu", cell_data=data)
    text = (tmp_path / "a.vtu").read_bytes().decode("latin-1")
    assert 'Name="velocity" NumberOfComponents="3"' in text
    assert 'CellData Scalars="volume"' in text
    if diagram.domain.dim == 2:
        meshio = pytest.importorskip("meshio")
        mesh = meshio.read(tmp_path / "a.vtu")
        for name, values in data.items():
            found = np.concatenate(mesh.cell_data[name])
            np.testing.assert_array_equal(found[:, :2] if values.ndim == 2 else found, values)


@pytest.mark.sparse(2)
def test_own_data_in_other_formats(diagram, result, tmp_path):
    data = data_for(len(diagram))
    for suffix in (".foam", ".ply"):
        if suffix == ".foam" or diagram.domain.dim == 2:
            with pytest.raises(InputError, match="cannot write cell_data"):
                diagram.save(tmp_path / f"a{suffix}", cell_data=data)
            assert not list(tmp_path.iterdir())
    if diagram.domain.dim == 3:
        return
    for convention in ("ugrid", "mpas"):
        if convention == "mpas" and isinstance(diagram.domain, clvoro.Polygon):
            continue
        diagram.to_netcdf(tmp_path / "a.nc", cell_data=data, convention=convention)
        with netcdf_file(tmp_path / "a.nc", mmap=False) as file:
            for name, values in data.items():
                np.testing.assert_array_equal(file.variables[name][:], values)
            assert ("size" in file.variables) is False
        diagram.to_netcdf(tmp_path / "b.nc", convention=convention)
    with pytest.raises(InputError, match="is that of another variable"):
        result.save(tmp_path / "c.nc", cell_data={"mesh_node_x": result.quality})


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        ({"size": [1]}, InputError, "'size', which clvoro uses itself"),
        ({"a b": [1]}, InputError, "expected a word of ASCII letters"),
        ({1: [1]}, InputError, "has the name 1"),
        ({"p": [1, 2]}, InputError, r"shape \(2,\), expected \(1,\) or \(1, k\)"),
        ({"p": [[[1]]]}, InputError, r"shape \(1, 1, 1\)"),
        ({"p": np.ma.masked_equal([1], 1)}, InputError, "masked numbers"),
        ({"p": ["a"]}, InputTypeError, "expected real numbers"),
        ({"p": [1j]}, InputTypeError, "dtype complex128"),
        ([1], InputTypeError, "expected a mapping"),
    ],
)
def test_bad_data(ctx, tmp_path, data, error, message):
    diagram = clvoro.Adapter(ctx).diagram(DOMAINS["flat"], [(0, 1)])
    with pytest.raises(error, match=message):
        diagram.save(tmp_path / "a.vtu", cell_data=data)
    with pytest.raises(error, match=message):
        diagram.to_meshio(data)
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputTypeError, match=r"mesh is a list, expected a clvoro.Result"):
        clvoro.io.save([diagram], tmp_path / "a.vtu")


def test_results_of_version_1_are_read(result, tmp_path):
    """Sizes and errors had other names."""
    result.save(tmp_path / "new.npz")
    former = {"target_size.npy": "size.npy", "size_error.npy": "error.npy"}
    with zipfile.ZipFile(tmp_path / "new.npz") as new, zipfile.ZipFile(tmp_path / "old.npz", "w") as old:
        for name in new.namelist():
            content = new.read(name)
            if name == "version.npy":
                buffer = io.BytesIO()
                np.save(buffer, np.array(1))
                content = buffer.getvalue()
            old.writestr(former.get(name, name), content)
    again = clvoro.load(tmp_path / "old.npz")
    np.testing.assert_array_equal(again.target_size, result.target_size)
    np.testing.assert_array_equal(again.size_error, result.size_error)


def test_to_meshio(diagram):
    pytest.importorskip("meshio")
    n = len(diagram)
    mesh = diagram.to_meshio({"row": np.arange(n)})
    seen = []
    for block, rows, volumes in zip(mesh.cells, mesh.cell_data["row"], mesh.cell_data["volume"], strict=True):
        for cell, row, volume in zip(block.data, rows, volumes, strict=True):
            seen.append(row)
            x0 = np.append(diagram.points[row], 0)[:3]
            if diagram.domain.dim == 2:
                x = (mesh.points[cell] - x0)[:, :2]
                found = sum(np.linalg.det([a, b]) / 2 for a, b in zip(x, np.roll(x, -1, 0), strict=True))
            else:
                found = 0.0
                for face in cell:
                    x = mesh.points[face] - x0
                    found += sum(np.linalg.det([x[0], *x[j : j + 2]]) / 6 for j in range(1, len(x) - 1))
            assert found == pytest.approx(volume, rel=1e-9)
            assert volume == diagram.volumes[row]
    assert sorted(seen) == list(range(n))


def test_sizes_are_cell_data(result):
    pytest.importorskip("meshio")
    mesh = result.to_meshio()
    order = np.concatenate(mesh.cell_data["label"])
    np.testing.assert_array_equal(np.concatenate(mesh.cell_data["size"]), result.target_size[order])


@pytest.mark.sparse(2)
def test_to_pyvista(diagram):
    pytest.importorskip("pyvista")
    grid = diagram.to_pyvista({"row": np.arange(len(diagram))})
    assert grid.n_cells == len(diagram)
    np.testing.assert_array_equal(grid.cell_data["row"], np.arange(len(diagram)))
    np.testing.assert_array_equal(grid.cell_data["volume"], diagram.volumes)
    for i in range(len(diagram)):
        corners = np.unique(grid.get_cell(i).points[:, : diagram.domain.dim], axis=0)
        np.testing.assert_array_equal(corners, np.unique(diagram.cell(i).vertices, axis=0))


@pytest.mark.parametrize("periodic", [(True, True), (False, True), (True, True, False), (True, True, True)])
def test_cells_cut_at_the_box_fill_it(ctx, periodic):
    pytest.importorskip("pyvista")
    dim = len(periodic)
    box = clvoro.Box((1,) * dim, (3,) * dim, periodic=periodic)
    diagram = clvoro.Adapter(ctx).diagram(box, 1 + 2 * np.random.default_rng(5).random((30, dim)))
    grid = diagram.to_pyvista(cut=True)
    bounds = np.reshape(grid.bounds, (3, 2))[:dim]
    assert bounds == pytest.approx(np.tile([1.0, 3.0], (dim, 1)), abs=1e-6)
    assert grid.cell_data["label"].dtype == np.int32
    sizes = grid.compute_cell_sizes()["Volume" if dim == 3 else "Area"]
    parts = np.bincount(grid.cell_data["label"], sizes, minlength=30)
    assert parts == pytest.approx(diagram.volumes, rel=1e-4)
    assert grid.n_cells > 30
    if dim == 2:  # parts stay polygons: most cells have more than three corners
        assert np.median(np.diff(grid.cell_offsets)) > 3


@pytest.mark.parametrize("library", ["meshio", "pyvista"])
def test_missing_libraries_are_named(result, monkeypatch, library):
    monkeypatch.setitem(__import__("sys").modules, library, None)
    with pytest.raises(ClvoroError, match=rf"to_{library}\(\) needs .*pip install 'clvoro\["):
        getattr(result, f"to_{library}")()


def test_summary(result):
    figures = result.summary()
    assert figures["cells"] == len(result.points)
    assert figures["mean_error"] == np.abs(result.size_error).mean()
