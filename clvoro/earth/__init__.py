"""Meshes of the Earth: sizes by longitude and latitude, oceans and limited areas, C grids, and files of their models.

What the other packages leave open on a sphere is registered here: size fields of longitude and latitude
(`sizing.on_domain`), the conventions "mpas" and "scrip" of ``.nc`` files and their reader (`io`), and the criteria of
the solver "mpas" (`finite_volumes.gate`).
"""

from ..finite_volumes.gate import SOLVERS
from ..io import CONVENTIONS, READERS
from .c_grid import check_for_mpas
from .lonlat_grid import from_xarray
from .mpas import write_mpas
from .netcdf_read import load_netcdf
from .regions import crossed, inside, ocean, rings
from .scrip import write_scrip
from .sizes import Caps, LonLat

__all__ = ["Caps", "LonLat", "crossed", "from_xarray", "inside", "ocean", "rings"]

CONVENTIONS.update(mpas=write_mpas, scrip=write_scrip)
READERS[".nc"] = load_netcdf
SOLVERS["mpas"] = check_for_mpas
