r"""
Coastal ocean: sizes from depths
================================

Long waves travel with the speed :math:`\sqrt{g \, \text{depth}}`. If cells are as large as the distance that a wave goes in
one time step, the whole mesh runs at the same time step. Depths come on a grid, as from a bathymetry file.
"""

import matplotlib.pyplot as plt
import numpy as np

import clvoro
from clvoro import sizing

# %%
# A bathymetry in meters on a grid of 500 m: a shelf, a canyon that cuts into it, and a seamount. Lengths are in km.

x, y = np.meshgrid(np.arange(0, 240.1, 0.5), np.arange(0, 160.1, 0.5))
coast = 26 + 9 * np.sin(x / 21) + 5 * np.sin(x / 7.3 + 1)
away = y - coast
shelf = 55 + 12 * np.sin(x / 30)
canyon = 42 * np.exp(-(((x - 135 - 0.1 * away) / 9) ** 2))
depth = 15 + 2 * np.clip(away, 0, None) + 2600 / (1 + np.exp(-(away - shelf + canyon) / 7))
depth -= 2200 * np.exp(-(((x - 60) / 10) ** 2) - ((y - 125) / 10) ** 2)

# %%
# The domain is the water. The coast is a polyline with a vertex every kilometer.

line = np.arange(240, -0.5, -1)
shore = np.column_stack([line, 26 + 9 * np.sin(line / 21) + 5 * np.sin(line / 7.3 + 1)])
sea = clvoro.Polygon([*shore, (0, 160), (240, 160)], names={"coast": range(240)})

# %%
# `Graded` limits the growth: real bathymetries have cliffs.

waves = sizing.Raster(0.08 * np.sqrt(depth), (0, 0), (240, 160))
size = sizing.Graded(waves, growth=1.12)
mesh = clvoro.adapt(sea, size)
print(mesh)

# %%
# The depths, and the mesh.

figure, axes = plt.subplots(2, 1, figsize=(7, 7.6), layout="constrained")
image = axes[0].pcolormesh(x, y, np.where(away > 0, depth, np.nan), cmap="Blues")
figure.colorbar(image, ax=axes[0], label="depth [m]", shrink=0.7)
axes[0].set(aspect="equal", xlim=(0, 240), ylim=(10, 160), ylabel="y [km]")
mesh.plot("size", ax=axes[1])
axes[1].set(xlabel="x [km]", ylabel="y [km]")
plt.show()
