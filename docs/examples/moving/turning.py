"""
Let a solver carry its mesh
===========================

A disk turns with the flow around the middle of a square. A finite-volume solver of a few lines moves it; after each part of the turn
the mesh follows what the solver has found. Nobody says where the disk is.
"""

import matplotlib.pyplot as plt
import numpy as np

import clvoro
from clvoro import sizing

N, PARTS = 1000, 18
turn = 2 * np.pi / PARTS

# %%
# The solver, of finite volumes. The velocity is (-y, x). The value at a face is extrapolated from the upwind cell by its
# gradient, and limited to the range of the values in the two cells of the face. No flux crosses the walls. Heun's method
# advances in time.


def advance(mesh, u, length):
    """Return the means over the cells after a time."""
    f, n = mesh.faces, len(mesh)
    own, other, center = f.owner[: f.n_inner], f.neighbor[: f.n_inner], f.center[: f.n_inner]
    flux = f.area[: f.n_inner] * (f.normal[: f.n_inner] * np.column_stack([-center[:, 1], center[:, 0]])).sum(axis=1)
    upwind = np.where(flux > 0, own, other)
    to_face = center - mesh.centroids[upwind]
    outflow = np.bincount(upwind, np.abs(flux), n)
    steps = int(np.ceil(length / (0.4 * (mesh.volumes / outflow).min())))

    def rate(u):
        gradient = sizing.derivatives(u, on=mesh)[0]
        value = u[upwind] + (gradient[upwind] * to_face).sum(axis=1)
        value = np.clip(value, np.minimum(u[own], u[other]), np.maximum(u[own], u[other]))
        return (np.bincount(other, flux * value, n) - np.bincount(own, flux * value, n)) / mesh.volumes

    dt = length / steps
    for _ in range(steps):
        first = u + dt * rate(u)
        u = (u + first + dt * rate(first)) / 2
    return u


def disk(points):
    """Return the disk at the start: 1 inside, 0 outside."""
    return 0.5 - 0.5 * np.tanh((np.hypot(points[:, 0] - 0.5, points[:, 1]) - 0.2) / 0.03)


# %%
# The sizes: those of the solution now, and those of the solution as it will be after the next part. The disk stays inside of fine
# cells until the mesh is adapted again.


def sizes(mesh, u):
    now = sizing.hessian_size(u, on=mesh, n_cells=N, h_max=0.2)
    c, s = np.cos(turn), np.sin(turn)
    back = np.clip(mesh.centroids @ [[c, -s], [s, c]], -1, 1)
    ahead = sizing.Estimate(mesh, now(back), now.error)
    return sizing.normalize(sizing.combine(now, ahead), n_cells=N, h_max=0.2)


# %%
# The first mesh is uniform. Three times it follows the disk at the start, which is known.

adapter = clvoro.Adapter()
run = adapter.start(clvoro.Box((-1, -1), (1, 1)), 2 / np.sqrt(N), "fast", seed=7)
mesh = run.finish()
for _ in range(3):
    run.follow(sizes(mesh, disk(mesh.centroids)))
    mesh = run.finish()
u = disk(mesh.centroids)
total = mesh.volumes @ u
frames = [(mesh, u)]

# %%
# The loop: solve, estimate, follow, transfer.

for part in range(PARTS):
    u = advance(mesh, u, turn)
    run.follow(sizes(mesh, u))
    after = run.finish()
    mesh, u = after, mesh.transfer(u, onto=after, order=2)
    if part in (PARTS // 3 - 1, PARTS - 1):
        frames.append((mesh, u))

# %%
# A uniform mesh of as many cells for comparison.

plain = adapter.run(mesh.domain, 2 / np.sqrt(N), "fast", n_cells=N, seed=7)
moved = advance(plain, disk(plain.centroids), 2 * np.pi)


def error(mesh, u):
    return mesh.volumes @ np.abs(u - disk(mesh.centroids)) / total


print(f"error after one turn: {error(mesh, u):.0%} of the disk, uniform {error(plain, moved):.0%}")
print(f"the integral is off by {mesh.volumes @ u / total - 1:.0e}")

# %%
# At the start, after a third of the turn, and after the turn.

figure, axes = plt.subplots(1, 3, figsize=(12, 4), layout="constrained")
for ax, (frame, values) in zip(axes, frames, strict=True):
    frame.plot(values, ax=ax, key=False, title=f"{len(frame):,} cells")
plt.show()
