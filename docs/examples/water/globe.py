r"""
A globe with nested resolutions
===============================

A global ocean model resolves the North Atlantic three times finer than its surroundings, and those three times finer than
the rest of the globe: 3, 9 and 27 km. One mesh of the whole sphere does it, without boundaries between grids.
"""

import numpy as np

import clvoro

# %%
# Positions on a sphere are vectors in meters. The size depends on the distance along a great circle from 45° W, 45° N.

earth = clvoro.Sphere()
center = earth.positions([(-45, 45)])[0] / earth.radius


def size(x):
    """Return 3 km within 1500 km, 9 km from 2300 to 4000 km, and 27 km from 6000 km on."""
    chord = np.linalg.norm(x / earth.radius - center, axis=1)
    distance = 2 * earth.radius * np.arcsin(chord / 2)
    ends = np.array([1500e3, 2300e3, 4000e3, 6000e3])
    return np.exp(np.interp(distance, ends, np.log([3e3, 9e3, 9e3, 27e3])))


# %%
# That mesh has more than two million cells. With `n_cells` all sizes grow by one factor, here to a mesh for a first test.

mesh = clvoro.adapt(earth, size, n_cells=20_000)
print(mesh)
print(
    f"sizes times {mesh.size_factor:.2f}: {mesh.target_size.min() / 1e3:.0f} km to {mesh.target_size.max() / 1e3:.0f} km"
)

# %%
# The globe, seen from above the smallest cells. Cartopy adds coasts if it is installed with its data.

mesh.plot("size", label="size h [m]")

# %%
# The transition from fine to coarse cells, 25 degrees across.

mesh.plot("error", center=(-25, 45), across=25)

# %%
# The whole globe in longitudes and latitudes.

mesh.plot("size", label="size h [m]", projection="plate", center=(-45, 0))
