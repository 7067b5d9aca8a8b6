"""Files of parts of meshes on a sphere. The reference for MPAS is the file of the whole mesh, culled table by table."""

import re

import numpy as np
import pytest
from scipy.spatial import KDTree

import clvoro
from clvoro.errors import InputError
from tests.earth.test_netcdf_mpas import check_energy
from tests.earth.test_sphere_mpas import Globe
from tests.reference.netcdf_files import read, result_of
from tests.reference.spheres import grid_of_rings, random_points

MESHES = {"random": lambda: random_points(300, 77), "four cells at a vertex": grid_of_rings}


@pytest.fixture(scope="module", params=MESHES)
def globe(ctx, request):
    points = MESHES[request.param]()
    return result_of(clvoro.Adapter(ctx).diagram(clvoro.Sphere(6.4e6), points))


def kept_of(mesh):
    lon, lat = mesh.diagram.domain.lonlat(mesh.points).T
    keep = ~((lat > 52) | ((np.abs(lat - 12) < 20) & (lon > 31)))
    keep[np.flatnonzero(lat < -40)[[0, 9, 30]]] = False
    return keep


@pytest.fixture(scope="module")
def part(globe):
    return globe.subset(kept_of(globe))


@pytest.fixture(scope="module")
def files(globe, part, tmp_path_factory):
    folder = tmp_path_factory.mktemp("mpas")
    globe.to_netcdf(folder / "globe.nc", convention="mpas")
    part.to_netcdf(folder / "part.nc", convention="mpas")
    return Globe(folder / "globe.nc"), Globe(folder / "part.nc")


class Maps:
    """Cells, edges and vertices of the whole mesh that those of the part are, found by their places."""

    def __init__(self, whole, part):
        self.cell, self.edge, self.vertex = (
            self._found(getattr(whole, what), getattr(part, what)) for what in ("cell", "edge", "vertex")
        )

    @staticmethod
    def _found(places, wanted):
        distance, found = KDTree(places).query(wanted)
        assert (distance < 1e-14).all()
        return found


@pytest.fixture(scope="module")
def maps(files):
    return Maps(*files)


def test_mpas_items_are_those_of_kept_cells(globe, files, maps):
    whole = files[0]
    kept = kept_of(globe)
    assert np.array_equal(maps.cell, np.flatnonzero(kept))
    with_edges = [e for e in range(whole.e) if kept[whole.cellsOnEdge[e]].any()]
    assert sorted(maps.edge) == with_edges
    around = [[i for i in row if i >= 0] for row in whole.cellsOnVertex]
    with_vertices = [v for v in range(whole.v) if kept[around[v]].any()]
    # Where two kept cells touch in a vertex only, each has one of its own.
    assert sorted(set(maps.vertex)) == with_vertices
    assert len(maps.vertex) - len(set(maps.vertex)) == touching(whole, kept)


def touching(whole, kept):
    """Number of vertices that are separate for two kept cells."""
    count = 0
    for row in whole.cellsOnVertex:
        cells = [i for i in row if i >= 0]
        changes = sum(kept[a] != kept[b] for a, b in zip(cells, cells[1:] + cells[:1], strict=True))
        count += max(changes // 2 - 1, 0)
    return count


def test_mpas_measures_do_not_change(files, maps):
    whole, part = files
    for names, rows in (
        (("areaCell", "latCell", "lonCell", "nEdgesOnCell"), maps.cell),
        (("dvEdge", "dcEdge", "latEdge", "lonEdge"), maps.edge),
        (("latVertex", "lonVertex"), maps.vertex),
    ):
        for name in names:
            # The order in which kites are added to an area may differ; positions are equal.
            np.testing.assert_allclose(part[name], whole[name][rows], rtol=1e-13, atol=1e-15)


def test_mpas_tables_are_culled(globe, files, maps):
    whole, part = files
    number = np.full(whole.n, -1)
    number[maps.cell] = np.arange(part.n)
    for i, old in enumerate(maps.cell):
        k = len(part.edgesOnCell[i])
        turn = maps.edge[part.edgesOnCell[i]].tolist().index(whole.edgesOnCell[old][0])
        here = [(turn + a) % k for a in range(k)]
        assert maps.edge[part.edgesOnCell[i]][here].tolist() == whole.edgesOnCell[old]
        assert maps.vertex[part.verticesOnCell[i]][here].tolist() == whole.verticesOnCell[old]
        across = number[whole.cellsOnCell[old]].tolist()
        assert [part.cellsOnCell[i][a] for a in here] == across
    for e, old in enumerate(maps.edge):
        cells = number[whole.cellsOnEdge[old]].tolist()
        ends = whole.verticesOnEdge[old]
        if cells[0] < 0:  # the cell that is left comes first, and is on the left of its edge
            cells, ends = cells[::-1], ends[::-1]
        assert part.cellsOnEdge[e] == cells
        assert maps.vertex[part.verticesOnEdge[e]].tolist() == ends
    for v, old in enumerate(maps.vertex):
        mine, theirs = (
            {i: mesh["kiteAreasOnVertex"][w, k] for k, i in enumerate(row) if i >= 0}
            for mesh, w, row in (
                (part, v, part.cellsOnVertex[v]),
                (whole, old, [number[i] if i >= 0 else -1 for i in whole.cellsOnVertex[old]]),
            )
        )
        assert mine.items() <= theirs.items() or mine == pytest.approx({i: theirs[i] for i in mine}, rel=1e-12)
        missing = np.array(part.cellsOnVertex[v]) < 0
        assert (part["kiteAreasOnVertex"][v][missing] == 0).all()
        assert part["areaTriangle"][v] == pytest.approx(sum(mine.values()), rel=1e-13)
    # Each corner of a kept cell is there once.
    assert sum(i >= 0 for row in part.cellsOnVertex for i in row) == sum(map(len, part.verticesOnCell))


def turned(whole, part, maps):
    """-1 for edges whose normal has been turned, since it pointed out of a removed cell; else 1."""
    first = np.array(part.cellsOnEdge)[:, 0]
    return np.where(maps.cell[first] == np.array(whole.cellsOnEdge)[maps.edge, 0], 1, -1)


def test_mpas_normals_at_the_boundary_point_outwards(files, maps):
    whole, part = files
    sign = turned(whole, part, maps)
    assert (sign < 0).any()
    off = part["angleEdge"] - whole["angleEdge"][maps.edge] - np.where(sign < 0, np.pi, 0)
    np.testing.assert_allclose(np.cos(off), 1, rtol=1e-14)


def test_mpas_weights_are_those_of_the_kept_cells(files, maps):
    whole, part = files
    sign = turned(whole, part, maps)
    for e, old in enumerate(maps.edge):
        theirs = dict(zip(whole.edgesOnEdge[old], whole["weightsOnEdge"][old], strict=False))
        mine = {
            maps.edge[k]: w * sign[e] * sign[k]
            for k, w in zip(part.edgesOnEdge[e], part["weightsOnEdge"][e], strict=False)
        }
        # All edges of a kept cell are left, those of a removed one are not in the sum.
        around = {k for i in part.cellsOnEdge[e] if i >= 0 for k in part.edgesOnCell[i]}
        assert set(mine) == {maps.edge[k] for k in around} - {old}
        assert mine == pytest.approx({k: theirs[k] for k in mine}, rel=1e-10, abs=1e-13)
    check_energy(part)


def test_mpas_zones_of_a_limited_area(globe, tmp_path):
    lat = globe.diagram.domain.lonlat(globe.points)[:, 1]
    ring = clvoro.earth.rings(globe, lat > 40, 2)
    area = globe.subset(ring >= 0, "open")
    zones = ring[ring >= 0]
    area.to_netcdf(tmp_path / "area.nc", convention="mpas", cell_data={"bdyMaskCell": zones})
    mesh = Globe(tmp_path / "area.nc")
    assert np.array_equal(mesh["bdyMaskCell"], zones)
    for name, table in (("bdyMaskEdge", mesh.cellsOnEdge), ("bdyMaskVertex", mesh.cellsOnVertex)):
        assert mesh[name].dtype == np.int32
        assert mesh[name].tolist() == [min(zones[i] for i in row if i >= 0) for row in table]
    outermost = np.array(mesh.cellsOnEdge)[:, 1] < 0
    assert (mesh["bdyMaskEdge"][outermost] == 2).all()


def test_ugrid_has_the_coast(part, tmp_path):
    part.save(tmp_path / "mesh.nc")
    file, d = read(tmp_path / "mesh.nc"), part.diagram
    assert file.about["boundary"]["flag_meanings"] == b"coast"
    outer = file["mesh_edge_faces"][:, 1] < 0
    assert np.array_equal(file["boundary"] == 0, outer)
    assert np.array_equal(file["wall"] >= 0, outer)
    assert outer.sum() == np.count_nonzero((d.neighbors < 0) & (np.ptp(d.half_faces.ends, axis=1) > 0))
    assert np.array_equal(file["area"], d.volumes)


def test_damaged_regions_are_refused(part, tmp_path):
    path = tmp_path / "mesh.npz"
    part.save(path)
    with np.load(path) as file:
        arrays = dict(file)
    about = str(arrays["about"])
    for changed in (
        re.sub(r'"area": [^,}]*', '"area": -1', about),
        re.sub(r'"beyond": \[\[', '"beyond": [["x", ', about),
        re.sub(r'"beyond": \[\[.*?\]\]', '"beyond": [[1.0, 0.0, 0.0]]', about),
        about.replace('"within"', '"without"'),
    ):
        assert changed != about
        np.savez(path, **{**arrays, "about": np.array(changed)})
        with pytest.raises(InputError, match="cannot load"):
            clvoro.load(path)


def test_graphs_for_metis_leave_removed_cells_out(part, tmp_path):
    part.save(tmp_path / "graph.info")
    n, edges = map(int, (tmp_path / "graph.info").read_text().split()[:2])
    assert (n, edges) == (len(part.points), part.diagram.faces.n_inner)
