"""
A heater in a room
==================

Surfaces inside a box divide it into regions: cells end at a heater and at the wall of a duct.
"""

import numpy as np

import clvoro

# %%
# Regions have the names of the surfaces around them. The duct goes through the room; what is outside is left out.

heater = clvoro.Solid.box((0.15, 0.2, 0.1), (0.5, 0.8, 0.35))
duct = clvoro.Solid.cylinder((0.75, -0.2, 0.65), (0.75, 1.2, 0.65), 0.15)
room = clvoro.Box((0, 0, 0), (1, 1, 1)).with_surfaces({"heater": heater, "duct": duct})
mesh = clvoro.adapt(room, clvoro.sizing.Distance(room.borders.surface, 0.045, growth=1.15, h_max=0.1), effort="fast")
d = mesh.diagram
volumes = np.bincount(d.cell_region, d.volumes)
print({name: round(float(v), 4) for name, v in zip(d.region_names, volumes, strict=True)}, "heater:", heater.measure)

# %%
# Half of the room. Faces lie on the surfaces: each cell is on one side of them.

mesh.plot(d.cell_region, label="region", view="cutaway", cut="y", through=(0.5, 0.5, 0.5))

# %%
# In OpenFOAM each region is a zone of cells, and each surface a zone of faces. `splitMeshRegions -cellZones` then makes
# the meshes of the regions for conjugate heat transfer.

mesh.save("room/constant/polyMesh")
