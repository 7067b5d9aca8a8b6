"""Write meshes on a sphere by the SCRIP conventions, for tools that remap data between grids (ESMF, NCO, TempestRemap).

See Jones (1998), A user's guide for SCRIP. Longitudes and latitudes are in degrees, areas in steradians. The corners of
cells are counter-clockwise; cells of fewer corners repeat the last one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..io.contents import Contents
from ..io.netcdf import NetCDF


def write_scrip(contents: Contents, path: Path, unit: str = "m") -> None:
    """Write centers, corners and areas of the cells, and a mask of ones; `unit` has no meaning here."""
    del unit
    diagram, domain = contents.diagram, contents.diagram.domain
    what = f"cannot write {path}: SCRIP files are for meshes on a Sphere"
    globe = domain.require_globe(what, "leave out convention='scrip'")
    starts, corners = diagram.half_faces.cell_corners
    counts, n = np.diff(starts), len(diagram)
    most = int(counts.max())
    table = corners[starts[:-1, None] + np.minimum(np.arange(most), counts[:, None] - 1)]
    file = NetCDF(
        path,
        contents,
        {"grid_size": n, "grid_corners": most, "grid_rank": 1},
        {"title": "Voronoi cells", "Conventions": "SCRIP"},
    )
    file.add("grid_dims", ("grid_rank",), np.array([n], np.int32))
    file.add("grid_imask", ("grid_size",), np.ones(n, np.int32), units="unitless")
    centers, around = globe.lonlat(diagram.centroids), globe.lonlat(diagram.vertices)
    for column, name in enumerate(("lon", "lat")):
        file.add(f"grid_center_{name}", ("grid_size",), centers[:, column], units="degrees")
        shape = ("grid_size", "grid_corners")
        file.add(f"grid_corner_{name}", shape, around[table, column], units="degrees")
    areas = diagram.volumes / globe.radius**2
    file.add("grid_area", ("grid_size",), areas, units="radians^2", long_name="area of a cell")
    file.add_extra("grid_size")
    file.write()
