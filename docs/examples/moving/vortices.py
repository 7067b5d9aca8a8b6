"""
Periodic shear layer
====================

The second derivatives of a solution give the size: small cells where the vorticity bends, large cells elsewhere. The box is periodic
in both directions.
"""

import matplotlib.pyplot as plt
import numpy as np

import clvoro
from clvoro import sizing

# %%
# The vorticity of two rolled-up shear layers. The grid covers one period and half a period more on each side, so that sizes also
# grow across the seams.

nodes = np.linspace(-0.5, 1.5, 513)
x, y = np.meshgrid(nodes, nodes)


def roll(x, y, sign):
    """Return a spiral of vorticity around its center."""
    dx, dy = (x + 0.5) % 1 - 0.5, (y + 0.5) % 1 - 0.5
    r = np.hypot(dx, dy)
    wave = np.sin(np.arctan2(dy, dx) - sign * 14 * np.exp(-3 * r))
    return sign * np.tanh(4 * wave * np.tanh(r / 0.05)) * np.exp(-((r / 0.2) ** 4))


vorticity = roll(x - 0.27, y - 0.3, 1) + roll(x - 0.72, y - 0.72, -1)

# %%
# `hessian_size` makes the interpolation error small for 12,000 cells in each period. `Graded` limits the growth.

wide = clvoro.Box((-0.5, -0.5), (1.5, 1.5))
best = sizing.hessian_size(sizing.Raster(vorticity, wide.lower, wide.upper), n_cells=48000, h_min=0.003, h_max=0.05)
size = sizing.Graded(best, growth=1.2, box=wide)
box = clvoro.Box((0, 0), (1, 1), periodic=True)
mesh = clvoro.adapt(box, size)
print(mesh)

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained")
axes[0].pcolormesh(x, y, vorticity, cmap="RdBu_r", shading="gouraud")
axes[0].set(aspect="equal", title="vorticity", xticks=[], yticks=[], xlim=(0, 1), ylim=(0, 1))
mesh.plot("size", ax=axes[1], key=False)
axes[1].set(title=f"{len(mesh.points):,} cells", xticks=[], yticks=[], xlabel="", ylabel="")
plt.show()

# %%
# Cells go on across the seams.

mesh.plot("size", window=((0, 0.55), (0.25, 0.8)))
