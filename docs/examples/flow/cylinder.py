"""
Cylinder in a channel
=====================

The benchmark of Schäfer and Turek (1996): flow around a cylinder that stands off the center line of a channel. The
mesh has boundary layers at the cylinder and names for all parts of the boundary.
"""

import clvoro
from clvoro import sizing

# %%
# The edges of the channel have the numbers 0 to 3, counted along the ring. The cylinder is a curve with a name.

cylinder = clvoro.curves.circle((0.2, 0.2), 0.05, name="cylinder")
domain = clvoro.Polygon(
    [(0, 0), (2.2, 0), (2.2, 0.41), (0, 0.41)], [cylinder], names={"walls": [0, 2], "outlet": 1, "inlet": 3}
)

# %%
# The wake needs fine cells far behind the cylinder.

body = sizing.Distance(domain.boundary("cylinder"), h_min=0.005, growth=1.12, h_max=0.025)
wake = sizing.Distance(sizing.Segment((0.2, 0.2), (1.2, 0.2)), h_min=0.012, growth=1.06)
layers = clvoro.Layers(0.0015, count=3, growth=1.3, spacing=0.004, edges="cylinder")

mesh = clvoro.adapt(domain, sizing.minimum(body, wake), layers=layers)
print(mesh)
mesh.plot("size")

# %%
# The criteria of OpenFOAM's `checkMesh`, with the worst values and their places. OpenFOAM is not needed for that.

print(mesh.check(solver="openfoam"))
mesh.plot("quality", window=((0.1, 0.1), (0.4, 0.3)))

# %%
# OpenFOAM reads this folder.

mesh.to_openfoam("cylinder/cylinder.foam", types={"inlet": "patch", "outlet": "patch"})
