"""
Follow a wave around the globe
==============================

A hill of water collapses in an ocean four kilometers deep on a rotating Earth. The wave runs around the globe, and the mesh follows it. The
solver of the shallow-water equations is of finite volumes.
"""

import matplotlib.pyplot as plt
import numpy as np

import clvoro
from clvoro import sizing

N, PARTS, PART = 1600, 3, 2 * 3600.0
GRAVITY, ROTATION, DEPTH = 9.80616, 7.292e-5, 4000.0
globe = clvoro.Sphere(6.37122e6)

# %%
# The solver. The state of a cell is the depth h and the momentum h v, where the velocity v has three components in space. The component of the
# change that would leave the sphere is removed. Values at a face are extrapolated from the cells on both sides, and Rusanov's flux is computed
# from them. A face is an arc of a great circle, which has one normal, so that a sea at rest stays at rest.


def rate(mesh, state):
    """Return the rates of change of the depth and of the three components of the momentum, (n, 4)."""
    f, n = mesh.faces, len(mesh)
    slopes = sizing.derivatives(state, on=mesh)[0]
    sides = [
        state[cells] + np.einsum("fkd,fd->fk", slopes[cells], f.center - mesh.centroids[cells])
        for cells in (f.owner, f.neighbor)
    ]
    total, fastest = 0, 0
    for side in sides:
        h, momentum = side[:, :1], side[:, 1:]
        across = (momentum * f.normal).sum(axis=1, keepdims=True) / h
        total += np.hstack([h * across, momentum * across + GRAVITY * h**2 / 2 * f.normal])
        fastest = np.maximum(fastest, np.abs(across) + np.sqrt(GRAVITY * h))
    flux = (total - fastest * (sides[1] - sides[0])) / 2 * f.area[:, None]
    up = mesh.centroids / np.linalg.norm(mesh.centroids, axis=1, keepdims=True)
    change = np.stack([np.bincount(f.neighbor, c, n) - np.bincount(f.owner, c, n) for c in flux.T], axis=1)
    change /= mesh.volumes[:, None]
    change[:, 1:] -= 2 * ROTATION * up[:, 2:] * np.cross(up, state[:, 1:])
    change[:, 1:] -= (change[:, 1:] * up).sum(axis=1, keepdims=True) * up
    return change


def advance(mesh, state, time):
    """Return the state after a time, by Heun's method."""
    f = mesh.faces
    around = np.bincount(f.owner, f.area, len(mesh)) + np.bincount(f.neighbor, f.area, len(mesh))
    steps = int(np.ceil(time / (0.8 * (mesh.volumes / around).min() / np.sqrt(GRAVITY * state[:, 0].max()))))
    for _ in range(steps):
        first = state + time / steps * rate(mesh, state)
        state = (state + first + time / steps * rate(mesh, first)) / 2
    return state


# %%
# First a check: a zonal flow in balance is steady (Williamson et al. 1992, test 2).

adapter = clvoro.Adapter()
run = adapter.start(globe, globe.radius * np.sqrt(4 * np.pi / N), "fast", n_cells=N, seed=7)
mesh = run.finish().diagram
speed = 2 * np.pi * globe.radius / (12 * 86400)
sine = mesh.centroids[:, 2] / globe.radius
h = 2.94e4 / GRAVITY - (globe.radius * ROTATION * speed + speed**2 / 2) / GRAVITY * sine**2
zonal = np.column_stack([h, h[:, None] * speed / globe.radius * np.cross([0, 0, 1], mesh.centroids)])
after = advance(mesh, zonal, 86400)
print(f"test 2: the depth is off by {np.sqrt(np.mean((after[:, 0] / h - 1) ** 2)):.1e} after a day")

# %%
# The hill is at 30 degrees north. The first mesh is adapted to it three times. Later meshes have to fit the wave for two hours: the solver
# goes ahead on the old mesh, and the sizes are those for the wave now, after one hour and after two.


def hill(mesh):
    angle = np.arccos(np.clip(mesh.centroids @ globe.positions([(0, 30)])[0] / globe.radius**2, -1, 1))
    depth = DEPTH + 200 * np.exp(-((angle / 0.2) ** 2))
    return np.column_stack([depth, np.zeros((len(mesh), 3))])


def sizes(mesh, *states):
    found = [sizing.hessian_size(s[:, 0], on=mesh, n_cells=N, h_min=1e5, h_max=1e6) for s in states]
    return sizing.normalize(sizing.combine(*found), n_cells=N, h_min=1e5, h_max=1e6)


for _ in range(3):
    run.follow(sizes(mesh, hill(mesh)))
    mesh = run.finish().diagram
state = hill(mesh)
total, frames = mesh.volumes @ state[:, 0], []
for _ in range(PARTS):
    half = advance(mesh, state, PART / 2)
    run.follow(sizes(mesh, state, half, advance(mesh, half, PART / 2)))
    after = run.finish().diagram
    mesh, state = after, mesh.transfer(state, onto=after, order=2)
    state = advance(mesh, state, PART)
    frames.append((mesh, state[:, 0] - DEPTH))
print(f"volume of water off by {mesh.volumes @ state[:, 0] / total - 1:.0e}")

# %%
# After two hours.

early, height = frames[0]
early.plot(height, label="height [m]", center=(0, 30), title=f"{len(early):,} cells")
plt.show()

# %%
# After six hours.

mesh.plot(frames[-1][1], label="height [m]", center=(40, 40), title=f"{len(mesh):,} cells")
plt.show()
