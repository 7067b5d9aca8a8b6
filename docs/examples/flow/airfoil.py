"""
Airfoil with boundary layers and a wake
=======================================

A NACA 2412 airfoil in a wind tunnel. Four rows of flat cells lie along the airfoil, and the wake is finer than the
rest.
"""

import clvoro
from clvoro import sizing

# %%
# The airfoil is a hole in the domain: a curve, which the mesh resolves as finely as it needs.

airfoil = clvoro.curves.naca("2412", name="airfoil")
domain = clvoro.Polygon([(-1.2, -1), (3, -1), (3, 1), (-1.2, 1)], [airfoil])

# %%
# Sizes grow from the airfoil and, more slowly, from a line behind it.

near = sizing.Distance(domain.boundary("airfoil"), h_min=0.008, growth=1.15, h_max=0.12)
wake = sizing.Distance(sizing.Segment((1, 0), (3, -0.1)), h_min=0.02, growth=1.1)
layers = clvoro.Layers(0.002, count=4, growth=1.3, spacing=0.008, edges="airfoil")

mesh = clvoro.adapt(domain, sizing.minimum(near, wake), layers=layers)
print(mesh)

# %%
# The whole mesh, colored by the target size.

mesh.plot("size")

# %%
# The trailing edge.

mesh.plot("size", window=((0.78, -0.12), (1.16, 0.1)))

# %%
# OpenFOAM reads this folder. Patches have the names of the domain, and are walls unless `types` says otherwise.

mesh.to_openfoam("airfoil/airfoil.foam", types={"outer": "patch"})
