"""
A polycrystal
=============

Grains with prescribed volumes fill a periodic box: the cells of a power diagram, whose weights optimal transport finds.
"""

import matplotlib.pyplot as plt
import numpy as np

import clvoro

# %%
# Volumes of grains are log-normal, as in many metals. They sum to the volume of the box.

rng = np.random.default_rng(1)
box = clvoro.Box((0, 0, 0), (1, 1, 1), periodic=True)
volumes = rng.lognormal(sigma=0.5, size=200)
volumes *= box.measure / volumes.sum()

# %%
# With `relax` generators move to the centroids of their grains before the last transport. Grains become rounder; their
# volumes stay as prescribed.

figure, ax = plt.subplots(layout="constrained")
for relax in (0, 10):
    grains = clvoro.transport(box, rng.random((200, 3)), volumes, relax=relax).diagram
    off = abs(grains.volumes / volumes - 1).max()
    faces = np.diff(grains.neighbor_starts)
    surface = np.bincount(np.repeat(np.arange(200), faces), grains.face_measures)
    roundness = 36 * np.pi * grains.volumes**2 / surface**3
    print(f"relax={relax}: volumes to {off:.0e}, {faces.mean():.1f} faces, mean roundness {roundness.mean():.3f}")
    ax.hist(roundness, bins=30, histtype="step", label=f"relax={relax}")
ax.set(xlabel=r"$36 \pi V^2 / S^3$", ylabel="grains")
ax.legend()

# %%
# Cells lie around their generators, partly outside of the box, so that a finite-element code can pair the seams.

grains.plot("volume")
plt.show()
