"""
Cooling by a pipe, in FiPy
==========================

Heat in a block with a pipe and a hot surface, solved by FiPy on a Voronoi mesh. Parts of the boundary keep their names. A
second run with a known solution shows the order of the errors.
"""

import fipy
import matplotlib.pyplot as plt
import numpy as np

import clvoro
from clvoro import sizing

# %%
# Edges of the block have the numbers 0 to 5, counted along the ring; the pipe is a curve with a name.

pipe = clvoro.curves.circle((0.7, 0.5), 0.2, name="pipe")
block = clvoro.Polygon(
    [(0, 0), (2, 0), (2, 1.6), (1.2, 1.6), (1.2, 1), (0, 1)], [pipe], names={"hot": 1, "sides": [0, 2, 3, 4, 5]}
)
size = sizing.Distance(block.boundary("pipe"), h_min=0.015, growth=1.12, h_max=0.06)
mesh = clvoro.adapt(block, size)
print(mesh)

# %%
# `to_fipy()` returns a mesh of FiPy. The hot surface has 80 degrees, the pipe 15; the other sides are insulated. The block
# begins at 15 degrees.

cells = mesh.to_fipy()
heat = fipy.CellVariable(mesh=cells, value=15.0)
heat.constrain(80.0, cells.physicalFaces["hot"])
heat.constrain(15.0, cells.physicalFaces["pipe"])

equation = fipy.TransientTerm() == fipy.DiffusionTerm(coeff=1.0)
for _ in range(10):
    equation.solve(heat, dt=0.01)
mesh.plot(heat.value, label="temperature after t = 0.1")

fipy.DiffusionTerm(coeff=1.0).solve(heat)
mesh.plot(heat.value, label="steady temperature")

flux = (heat.faceGrad.value * np.asarray(cells.faceNormals)).sum(axis=0) * cells._faceAreas
for name in ("hot", "pipe", "sides"):
    print(f"heat through {name}: {flux[cells.physicalFaces[name].value].sum():+.4f}")

# %%
# With a known temperature u and the source that it needs, the errors of FiPy fall by a factor of four if cells are half as large. On the
# walls u is given at `faceCenters`, which are the feet of the perpendiculars from the cell centers.


def temperature(x, y):
    """Return u; its Laplacian is -4 u."""
    return np.sin(2 * x + 0.5) + np.cos(2 * y)


sizes, largest, mean = [], [], []
for scale in (2, 1, 0.5):
    mesh = clvoro.adapt(block, size * scale)
    cells = mesh.to_fipy()
    u = fipy.CellVariable(mesh=cells)
    u.constrain(temperature(*cells.faceCenters.value), cells.exteriorFaces)
    source = fipy.CellVariable(mesh=cells, value=4 * temperature(*mesh.diagram.centroids.T))
    (fipy.DiffusionTerm(coeff=1.0) + source == 0).solve(u, solver=fipy.LinearLUSolver())
    error = abs(u.value - temperature(*cells.cellCenters.value))
    sizes.append((block.measure / len(error)) ** 0.5)
    largest.append(error.max())
    mean.append((np.average(error**2, weights=mesh.diagram.volumes)) ** 0.5)

figure, ax = plt.subplots(layout="constrained")
ax.loglog(sizes, largest, "o-", label="largest error")
ax.loglog(sizes, mean, "s-", label="root of the mean square")
ax.loglog(sizes, 0.3 * np.square(sizes), "k--", lw=0.8, label="second order")
ax.set(xlabel="mean width of a cell", ylabel="error")
ax.legend()
print("largest errors", ", ".join(f"{e:.1e}" for e in largest))
plt.show()
