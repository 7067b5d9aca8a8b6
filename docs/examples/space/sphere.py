"""
Sphere and its wake in 3D
=========================

A box around a sphere. Cells are small at its surface and in the wake behind it.
"""

import clvoro
from clvoro import sizing

# %%
# The sphere is a source of size: cells cover its inside as well.

box = clvoro.Box((-1, -1, -1), (3, 1, 1))
sphere = sizing.Distance(sizing.Ball((0, 0, 0), radius=0.5), h_min=0.05, growth=1.2, h_max=0.25)
wake = sizing.Distance(sizing.Segment((0.5, 0, 0), (3, 0, 0)), h_min=0.08, growth=1.15)
mesh = clvoro.adapt(box, sizing.minimum(sphere, wake))
print(mesh)
print(mesh.measures)

# %%
# A view into the mesh: the cells of one octant are left out.

mesh.plot("size", view="cutaway")

# %%
# The same on three planes.

mesh.plot("quality", view="slices")
