"""
Groundwater: wells and a river
==============================

A finite-volume model on a Voronoi mesh in forty lines. Cells are small at the wells and along the river. The line between two
generators is perpendicular to their face, so that the two-point flux is consistent: the control-volume method of groundwater codes
needs exactly this.
"""

import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse
import scipy.sparse.linalg

import clvoro
from clvoro import sizing

# %%
# The catchment, the river and the wells, in meters. Each well is a generator that does not move: the wells have the first cells.

x = [0, 500, 1500, 2300, 2400, 1700, 700, 100]
y = [300, 0, -100, 300, 1100, 1600, 1500, 1000]
catchment = np.column_stack([x, y])
river = np.array([(300, 400), (700, 550), (1000, 500), (1400, 700), (1800, 680), (2200, 900)])
wells = np.array([(800, 1000), (1250, 1150), (1500, 350)])
pumping = np.array([0.02, 0.03, 0.015])  # m3/s

domain = clvoro.Polygon(catchment)
size = sizing.minimum(
    sizing.Distance(sizing.Polyline(river), h_min=20, growth=1.15, h_max=90),
    *(sizing.Distance(sizing.Circle(w, radius=1), h_min=4, growth=1.2) for w in wells),
)
mesh = clvoro.adapt(domain, size, fixed=wells)
print(mesh)

# %%
# Steady flow of a confined aquifer: the transmissivity times the gradient of the head flows through each face; rain comes in,
# wells take out, and the river has a given head. `faces` lists each face once, those between cells first.

cells = mesh.diagram
faces = cells.faces
inner = slice(faces.n_inner)
i, j = faces.owner[inner], faces.neighbor[inner]
conductance = 0.01 * faces.area[inner] / faces.distance[inner]

n = len(cells)
upper = scipy.sparse.coo_array((conductance, (i, j)), shape=(n, n))
matrix = scipy.sparse.diags_array((upper + upper.T).sum(axis=1)) - upper - upper.T

water = 6e-9 * cells.volumes  # m3/s of recharge
water[: len(wells)] -= pumping

leak = np.where(sizing.Distance(sizing.Polyline(river), h_min=1, slope=1)(cells.points) < 21, 1e-2, 0)
stage = 100 - 0.004 * cells.points[:, 0]
head = scipy.sparse.linalg.spsolve((matrix + scipy.sparse.diags_array(leak)).tocsc(), water + leak * stage)
print(f"recharge {6e-9 * domain.measure:.4f}, wells {pumping.sum():.4f} m3/s")
print(f"from the river {(leak * (stage - head)).sum():.4f} m3/s")

# %%
# The mesh is colored by the head.

figure, ax = plt.subplots(figsize=(8, 5.4), layout="constrained")
mesh.plot(head, label="hydraulic head [m]", ax=ax)
ax.plot(*river.T, color="tab:cyan", lw=1.5)
ax.plot(*wells.T, "o", color="white", ms=5, mec="black")
ax.set(xlabel="x [m]", ylabel="y [m]")
plt.show()
