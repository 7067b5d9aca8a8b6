"""uxarray opens the files of meshes on a sphere, and agrees on areas and on means along parallels."""

import numpy as np
import pytest

import clvoro

pytestmark = pytest.mark.slow  # Numba compiles for minutes
ux = pytest.importorskip("uxarray")


@pytest.mark.parametrize("convention", ["ugrid", "mpas", "scrip"])
def test_areas_and_zonal_means(ctx, tmp_path, convention):
    earth = clvoro.Sphere()
    d = clvoro.Adapter(ctx).run(earth, 1.0, n_cells=642, effort="fast").diagram
    d.to_netcdf(tmp_path / "mesh.nc", convention=convention)
    grid = ux.open_grid(tmp_path / "mesh.nc")
    assert grid.n_face == len(d)
    found = grid.compute_face_areas()
    areas = np.asarray(found[0] if isinstance(found, tuple) else found)
    # uxarray integrates by a quadrature.
    assert areas == pytest.approx(d.volumes / earth.radius**2, rel=1e-7)
    values = np.cos(np.radians(earth.lonlat(d.points)[:, 1])) ** 2
    field = ux.UxDataArray(values, dims=["n_face"], uxgrid=grid, name="f")
    parallels, count = np.array([-75.0, -30, 0, 10, 60]), 40_000
    found = field.zonal_mean(lat=parallels).values
    lon = np.linspace(-180, 180, count, endpoint=False)
    for lat, mean in zip(parallels, found, strict=True):
        cells = d.locate(np.column_stack([lon, np.full(count, lat)]))
        # Each of the 70 edges that a parallel crosses is placed to a sample.
        assert mean == pytest.approx(values[cells].mean(), abs=70 * np.ptp(values[cells]) / count)
