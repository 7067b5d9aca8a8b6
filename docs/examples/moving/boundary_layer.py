"""
Find a boundary layer
=====================

A wind carries warm air to two cold walls: convection and diffusion. The layers at these walls are thinner than the cells of the first
mesh. The loop solves, estimates and adapts, and finds them; nobody says where they are. The exact solution is known.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.sparse import csr_array
from scipy.sparse.linalg import spsolve

import clvoro
from clvoro import sizing

N, CYCLES, EPS = 1500, 3, 0.01
box = clvoro.Box((0, 0), (1, 1))

# %%
# Warm air enters at the left and at the bottom; the walls at the right and at the top are cold. The product of two functions solves
# ``u_x + u_y = EPS (u_xx + u_yy)``.


def exact(points):
    x, y = ((1 - np.exp((t - 1) / EPS)) / (1 - np.exp(-1 / EPS)) for t in points.T)
    return x * y


# %%
# The solver, of finite volumes. The line between two generators is normal to their face: the flux through it is that of the solution in
# one dimension between them (Scharfetter and Gummel). It is central where cells are small, upwind where they are large, and makes no new
# extrema.


def bernoulli(x):
    """Return x / (exp(x) - 1)."""
    x = np.where(np.abs(x) < 1e-9, 1e-9, np.clip(x, -500, 500))
    return x / np.expm1(x)


def solve(mesh):
    f, n, k = mesh.faces, len(mesh), mesh.faces.n_inner
    own, other, beside = f.owner[:k], f.neighbor[:k], f.owner[k:]
    apart = np.concatenate([mesh.points[other], f.center[k:]]) - mesh.points[f.owner]
    spread = EPS * f.area / (apart * f.normal).sum(axis=1)
    peclet = f.normal.sum(axis=1) * f.area / spread
    out, back = spread * bernoulli(-peclet), spread * bernoulli(peclet)
    rows = np.concatenate([f.owner, own, other, other])
    columns = np.concatenate([f.owner, other, own, other])
    matrix = csr_array((np.concatenate([out, -back[:k], -out[:k], back[:k]]), (rows, columns)), shape=(n, n))
    return spsolve(matrix.tocsc(), np.bincount(beside, back[k:] * exact(f.center[k:]), n))


# %%
# The error, of linear interpolation between the generators and the walls.

somewhere = np.random.default_rng(1).random((100_000, 2))


def error(mesh, u):
    walls = mesh.faces.center[mesh.faces.n_inner :]
    between = LinearNDInterpolator(np.concatenate([mesh.points, walls]), np.concatenate([u, exact(walls)]))
    return np.nanmean(np.abs(between(somewhere) - exact(somewhere)))


# %%
# The loop: solve, estimate, follow.

adapter = clvoro.Adapter()
run = adapter.start(box, 1 / np.sqrt(N), "fast", n_cells=N, seed=7)
mesh = run.finish().diagram
frames = []
for cycle in range(CYCLES + 1):
    u = solve(mesh)
    smallest = mesh.volumes.min() ** 0.5
    print(f"{len(mesh):,} cells, smallest {smallest:.4f}: error {error(mesh, u):.1e}")
    frames.append((mesh, u))
    if cycle < CYCLES:
        run.follow(sizing.hessian_size(u, on=mesh, n_cells=N, p=1, h_max=0.1, growth=1.4))
        mesh = run.finish().diagram

# %%
# A uniform mesh of four times as many cells.

fine = adapter.run(box, 0.5 / np.sqrt(N), "fast", n_cells=4 * N, seed=7).diagram
print(f"uniform, {len(fine):,} cells: error {error(fine, solve(fine)):.1e}")

# %%
# The first mesh and the last one.

figure, axes = plt.subplots(1, 3, figsize=(12, 4.2), layout="constrained")
for ax, (frame, values), title in zip(axes, (frames[0], frames[-1]), ("first mesh", "last mesh"), strict=False):
    frame.plot(values, ax=ax, key=False, title=title)
mesh.plot(u, ax=axes[2], key=False, window=((0.9, 0.9), (1, 1)), title="its corner")
plt.show()
