"""
Airfoil with boundary layers and a wake
=======================================

A NACA 2412 airfoil in a wind tunnel. Four rows of flat cells lie along the airfoil, and the wake is finer than the
rest.
"""

import numpy as np

import clvoro
from clvoro import sizing

# %%
# The outline is that of the NACA formula: thickness around a camber line. Points are dense at both ends.

s = 0.5 * (1 - np.cos(np.linspace(0, np.pi, 81)))
camber = np.where(s < 0.4, 0.125 * (0.8 * s - s**2), 0.02 / 0.36 * (0.2 + 0.8 * s - s**2))
powers = np.stack([np.sqrt(s), s, s**2, s**3, s**4])
half = 0.6 * np.array([0.2969, -0.1260, -0.3516, 0.2843, -0.1036]) @ powers
half[-1] = 0
airfoil = np.concatenate(
    [np.stack([s, camber + half], 1)[::-1], np.stack([s, camber - half], 1)[1:-1]]
)

# %%
# The airfoil is a hole in the domain, and its boundary gets a name.

tunnel = [(-1.2, -1), (3, -1), (3, 1), (-1.2, 1)]
domain = clvoro.Polygon(tunnel, [airfoil], names={"airfoil": "hole-1"})

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

mesh.plot("size", window=((0.78, -0.12), (1.16, 0.1)), key=False)

# %%
# OpenFOAM reads this folder. Patches have the names of the domain, and are walls unless `types` says otherwise.

mesh.save("airfoil/airfoil.foam", types={"outer": "patch"})
