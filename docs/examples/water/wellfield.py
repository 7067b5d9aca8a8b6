"""
A well field for MODFLOW 6
==========================

A steady model of a well field beside a river. FloPy writes the input of MODFLOW 6 from a graded Voronoi grid. Where
MODFLOW is not installed, SciPy solves the same equations. In the end the drawdown of a single well is compared with the
formula of Theis.
"""

import shutil
import tempfile

import flopy
import matplotlib.pyplot as plt
import numpy as np
import scipy.sparse
import scipy.sparse.linalg
import scipy.special

import clvoro
from clvoro import sizing

# %%
# The river is a part of the boundary and has a name. Cells are small at the wells. Each well is the center of its cell, exactly: `fixed`
# wells are the first generators of the mesh.

outline = [
    (0, 0),
    (900, -150),
    (1800, 50),
    (2700, -100),
    (3500, 100),
    (3600, 1500),
    (2400, 2300),
    (600, 2100),
    (-200, 900),
]
wells = np.array([(900, 500), (1400, 700), (1900, 500), (2400, 700)])
pumping = np.array([0.02, 0.03, 0.03, 0.02])  # m3/s

domain = clvoro.Polygon(outline, names={"river": range(4), "divide": range(4, 9)})
size = sizing.minimum(
    sizing.Distance(domain.boundary("river"), h_min=35, growth=1.15, h_max=120),
    *(sizing.Distance(sizing.Circle(w, radius=1), h_min=6, growth=1.15) for w in wells),
)
mesh = clvoro.adapt(domain, size, fixed=wells)
grid = mesh.to_disv()
print(grid)

# %%
# One confined layer of 20 m with a conductivity of 5e-4 m/s, and a little rain. The river leaks through its bed: the package GHB
# takes the conductance between the bank and the center of each cell there. The head of the river falls by 2 m along its way.

thickness, conductivity, rain = 20.0, 5e-4, 5e-9
river = grid.boundaries["river"]
stage = 50 - 2 * river.feet[:, 0] / 3500
conductance = river.conductance(conductivity * thickness)
cells = np.arange(len(wells))

folder = tempfile.mkdtemp()
sim = flopy.mf6.MFSimulation(sim_ws=folder, exe_name="mf6")
flopy.mf6.ModflowTdis(sim)
flopy.mf6.ModflowIms(sim, complexity="moderate")
model = flopy.mf6.ModflowGwf(sim, modelname="wells")
flopy.mf6.ModflowGwfdisv(model, nlay=1, top=20.0, botm=[0.0], **grid.gridprops)
flopy.mf6.ModflowGwfnpf(model, k=conductivity)
flopy.mf6.ModflowGwfic(model, strt=50.0)
flopy.mf6.ModflowGwfrcha(model, recharge=rain)
bank = zip(river.cells.tolist(), stage.tolist(), conductance.tolist(), strict=True)
flopy.mf6.ModflowGwfghb(model, stress_period_data=[((0, i), h, c) for i, h, c in bank])
taken = zip(cells.tolist(), pumping.tolist(), strict=True)
flopy.mf6.ModflowGwfwel(model, stress_period_data=[((0, i), -q) for i, q in taken])
flopy.mf6.ModflowGwfoc(model, head_filerecord="wells.hds", saverecord=[("HEAD", "ALL")])
sim.write_simulation(silent=True)

# %%
# MODFLOW's flow between two cells is the transmissivity times the length of their face over the distance of their
# centers, times the difference of heads.


def flow_matrix(diagram, transmissivity):
    """Return the matrix of the flow out of each cell."""
    f, n = diagram.faces, len(diagram)
    i, j = f.owner[: f.n_inner], f.neighbor[: f.n_inner]
    c = transmissivity * (f.area / f.distance)[: f.n_inner]
    upper = scipy.sparse.coo_array((c, (i, j)), shape=(n, n))
    return scipy.sparse.diags_array((upper + upper.T).sum(axis=1)) - upper - upper.T


n = len(mesh.points)
inflow = rain * mesh.diagram.volumes - np.bincount(cells, pumping, n)
inflow += np.bincount(river.cells, conductance * stage, n)
leakage = scipy.sparse.diags_array(np.bincount(river.cells, conductance, n))
matrix = flow_matrix(mesh.diagram, conductivity * thickness) + leakage
head = scipy.sparse.linalg.spsolve(matrix.tocsc(), inflow)

if shutil.which("mf6"):
    sim.run_simulation(silent=True)
    of_modflow = model.output.head().get_data().ravel()
    print(f"largest difference from MODFLOW: {abs(of_modflow - head).max():.1e} m")
from_river = (conductance * (stage - head[river.cells])).sum()
print(f"wells {pumping.sum():.4f}, rain {rain * domain.measure:.4f}, river {from_river:.4f} m3/s")

figure = mesh.plot(head, label="head [m]")
figure.axes[0].plot(*wells.T, "o", color="white", ms=5, mec="black")

# %%
# How right is that? Two hours after a single well in a wide aquifer has begun to pump, the drawdown is that of Theis (1935). Half the
# size, a quarter of the error. Of two numbers of time steps the error in time is extrapolated.

transmissivity, storage, rate, end = 5e-3, 2e-4, 0.02, 7200.0
aquifer = clvoro.Polygon([(0, 0), (3000, -200), (4200, 1500), (3500, 3600), (1200, 3900), (-500, 2000)])
place = (1700, 1700)
coarse = sizing.Distance(sizing.Circle(place, radius=1), h_min=20, slope=0.1, h_max=150)


def drawdown(diagram, steps):
    """Return the drawdown s(T) by implicit Euler steps from s = 0. The first steps are the shortest."""
    flow = flow_matrix(diagram, transmissivity)
    s, source = np.zeros(len(diagram)), rate * (np.arange(len(diagram)) == 0)
    for dt in np.diff(end * np.linspace(0, 1, steps + 1) ** 3):
        capacity = storage * diagram.volumes / dt
        s = scipy.sparse.linalg.spsolve((flow + scipy.sparse.diags_array(capacity)).tocsc(), source + capacity * s)
    return s


figure, ax = plt.subplots(layout="constrained")
for scale in (1, 0.5):
    diagram = clvoro.adapt(aquifer, coarse * scale, fixed=[place]).diagram
    s = 2 * drawdown(diagram, 40) - drawdown(diagram, 20)
    r = np.linalg.norm(diagram.points - place, axis=1)
    theis = scipy.special.exp1(r**2 * storage / (4 * transmissivity * end))
    theis *= rate / (4 * np.pi * transmissivity)
    seen = (r > 100) & (r < 1500)
    print(f"{len(diagram)} cells: largest error {abs(s - theis)[seen].max():.4f} m")
    ax.semilogx(r[r > 0], s[r > 0], ".", ms=4 * scale, label=f"{len(diagram)} cells")
order = np.argsort(r)[1:]
ax.semilogx(r[order], theis[order], "k", lw=0.8, label="Theis")
ax.set(xlabel="distance from the well [m]", ylabel="drawdown [m]")
ax.legend()
plt.show()
