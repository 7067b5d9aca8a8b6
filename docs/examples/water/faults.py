"""
An aquifer with faults
======================

Faults are lines inside the domain: faces of cells lie on them. A fault that hardly leaks is a resistance of these faces
alone.
"""

import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from matplotlib.collections import LineCollection

import clvoro
from clvoro import sizing

# %%
# Two faults cross, and a clay lens has a border. Cells are small at the faults.

outline = [(0, 0), (1800, -100), (3500, 100), (3600, 1500), (2400, 2300), (600, 2100), (-200, 900)]
faults = [[(500, 300), (1500, 1200), (2900, 1700)], [(1100, 2000), (2000, 600), (2200, 200)]]
lens = clvoro.curves.ellipse((2700, 800), (400, 250))
ground = clvoro.Polygon(outline, names={"river": range(2), "hills": range(2, 7)}).with_lines([*faults, lens])
mesh = clvoro.adapt(ground, sizing.Distance(ground.borders, h_min=40, growth=1.15, h_max=110))
d = mesh.diagram
print(f"{len(mesh)} cells, {len(d.border_faces)} faces on lines, regions with {np.bincount(d.cell_region)} cells")

# %%
# The flow between two cells is the conductance of their face times the difference of their heads. The clay in the lens
# conducts a hundredth of what the sand around it does. The core of a fault is of clay, too: it adds a resistance to the
# faces on the fault. It adds none to the faces on the border of the lens, whose two cells are in different regions.

f = d.faces
i, j = f.owner[: f.n_inner], f.neighbor[: f.n_inner]
lens_cells = d.cell_region == d.cell_region[d.locate([(2700, 800)])[0]]
k = np.where(lens_cells, 5e-6, 5e-4)
resistance = f.distance[: f.n_inner] / 2 * (1 / k[i] + 1 / k[j])
on_fault = d.border_faces[lens_cells[i[d.border_faces]] == lens_cells[j[d.border_faces]]]
resistance[on_fault] += 5.0 / 1e-6
conductance = 20 * f.area[: f.n_inner] / resistance

n = len(mesh)
matrix = scipy.sparse.coo_array((conductance, (i, j)), (n, n))
matrix = scipy.sparse.diags_array((matrix + matrix.T).sum(axis=1)) - matrix - matrix.T
bank, hills = mesh.boundary_cells("river"), mesh.boundary_cells("hills")
leak = np.zeros(n)
leak[bank], leak[hills] = 1.0, 1.0
head = scipy.sparse.linalg.spsolve(
    (matrix + scipy.sparse.diags_array(leak)).tocsc(), leak * np.isin(np.arange(n), hills) * 10
)

# %%
# The head jumps at the faults.

figure = mesh.plot(head, label="head [m]", edges=False)
figure.axes[0].add_collection(
    LineCollection(f.points[f.corners.reshape(-1, 2)[d.border_faces]], colors="black", linewidths=1)
)
plt.show()
