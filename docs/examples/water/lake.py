"""
Lake with islands
=================

A lake from a GeoJSON file. Straits and coves get at least four cells across; the open water gets large cells.
"""

from pathlib import Path

import clvoro
from clvoro import sizing

# %%
# The file is the one of the built-in case `lake`. Coordinates of your own should be in meters.

file = Path(clvoro.__file__).parent / "cli" / "cases" / "lake.geojson"
lake = clvoro.Polygon.from_geojson(file)
print(lake)

# %%
# Some creeks are narrower than the smallest cell. `simplified` fills them, and leaves vertices out that no cell resolves.

lake = lake.simplified(0.012)
print(lake)

# %%
size = sizing.FeatureSize(lake, cells_across=4, growth=1.15, h_min=0.012, h_max=0.25)
mesh = clvoro.adapt(lake, size)
print(mesh)
mesh.plot("size")

# %%
# Cells follow the shore. Their quality is that of the cell with its shore straightened.

mesh.plot("quality")

# %%
# netCDF by the UGRID conventions: QGIS, xugrid and uxarray read it.

mesh.save("lake.nc")
