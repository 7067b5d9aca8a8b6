"""
A global ocean
==============

A mesh for ocean models such as MPAS-Ocean: Voronoi cells on the sphere, without those on land. The continents are polygons of
longitudes and latitudes, here two that were drawn by hand; a GeoJSON file, such as the land of Natural Earth, takes their place.
"""

import matplotlib.pyplot as plt
import shapely

import clvoro

# %%
# First the whole sphere, with 10,000 cells of one size.

globe = clvoro.adapt(clvoro.Sphere(), 1.0, "fast", n_cells=10_000)

# %%
# The second continent crosses the date line, and has a sea without an outlet: its strait is narrower than a cell. `passages`
# keep the cells along lines open. Lakes are removed.

america = [
    (-165, 65),
    (-100, 72),
    (-80, 68),
    (-55, 52),
    (-80, 27),
    (-97, 22),
    (-83, 10),
    (-50, 0),
    (-35, -8),
    (-48, -27),
    (-66, -54),
    (-75, -50),
    (-70, -18),
    (-81, -4),
    (-79, 8),
    (-105, 20),
    (-125, 40),
    (-135, 58),
]
old_world = [
    (-17, 15),
    (-6, 36),
    (-9, 43),
    (8, 58),
    (28, 71),
    (70, 73),
    (105, 77),
    (179, 69),
    (-170, 66),
    (160, 58),
    (140, 52),
    (122, 38),
    (120, 25),
    (108, 12),
    (100, 2),
    (97, 17),
    (80, 8),
    (72, 20),
    (57, 25),
    (51, 13),
    (40, -15),
    (28, -33),
    (18, -34),
    (12, -5),
    (8, 4),
]
sea = [(0, 38), (10, 42), (30, 35), (32, 31), (15, 32)]
land = shapely.MultiPolygon([shapely.Polygon(america), shapely.Polygon(old_world, [sea])])

keep = clvoro.earth.ocean(globe, land, passages=[(-12, 36), (3, 37.5)])
ocean = globe.subset(keep)
print(ocean)
print(ocean.diagram.check())

# %%
# The faces towards land are a boundary with the name "coast".

faces = ocean.diagram.faces
coast = faces.boundary == ocean.diagram.domain.boundary_names.index("coast")
print(f"{faces.area[coast].sum() / 1e3:,.0f} km of coast")

ocean.plot("quality", projection="plate")

# %%
# In the file for MPAS, 0 stands for missing cells beyond the coast.

ocean.to_netcdf("ocean.nc", convention="mpas")

# %%
# A limited area for the atmosphere has seven rings of neighbors around it, in which values are relaxed or given.

area = clvoro.Polygon([(-30, 20), (20, 20), (35, 60), (-40, 60)])
ring = clvoro.earth.rings(globe, clvoro.earth.inside(globe, area))
limited = globe.subset(ring >= 0, "open")
limited.to_netcdf("limited_area.nc", convention="mpas", cell_data={"bdyMaskCell": ring[ring >= 0]})
limited.plot(ring[ring >= 0].astype(float), label="ring", center=(0, 40))
plt.show()
