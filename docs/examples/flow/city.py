"""
Wind in a city
==============

A horizontal section through some blocks of a city. Each street gets at least six cells across, wide or narrow.
"""

import numpy as np
import shapely
from shapely import affinity

import clvoro
from clvoro import sizing

# %%
# Buildings are boxes in rows, some of them turned, some of them joined.

rng = np.random.default_rng(4)
buildings = []
for x in np.arange(60, 300, 48):
    for y in np.arange(40, 200, 44):
        width, depth = rng.uniform(22, 36, 2)
        block = shapely.box(x, y, x + width, y + depth)
        buildings.append(affinity.rotate(block, rng.uniform(-12, 12)))
tower = shapely.Point(178, 112).buffer(17)
solid = shapely.union_all([b for b in buildings if b.distance(tower) > 6] + [tower])
air = shapely.box(0, 0, 400, 240).difference(solid)
domain = clvoro.Polygon.from_shapely(air)

# %%
# `FeatureSize` measures the gaps between walls.

size = sizing.FeatureSize(domain, cells_across=6, growth=1.15, h_min=0.8, h_max=9)
mesh = clvoro.adapt(domain, size)
print(mesh)
mesh.plot("size")

# %%
# The round tower and the streets around it.

mesh.plot("quality", window=((140, 75), (230, 150)))
