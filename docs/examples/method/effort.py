"""
How much work is worth it
=========================

The same size field with the three efforts: cells by their number of sides. Cells with other than six sides are what limits the quality.
"""

import matplotlib.pyplot as plt
import numpy as np

import clvoro
from clvoro import sizing

domain = clvoro.Box((0, 0), (1.6, 1))
circle = sizing.Circle((0.6, 0.5), radius=0.25)
size = sizing.Distance(circle, h_min=0.01, growth=1.15, h_max=0.06)

# %%
meshes = {effort: clvoro.adapt(domain, size, effort=effort) for effort in ("fast", "default", "best")}
figure, axes = plt.subplots(3, 1, figsize=(6.4, 11.6), layout="constrained")
for ax, (effort, mesh) in zip(axes, meshes.items(), strict=True):
    mesh.plot("sides", ax=ax, title=effort)
plt.show()

# %%
for effort, mesh in meshes.items():
    error, quality, steps = np.abs(mesh.size_error), mesh.quality, mesh.history["step"][-1]
    print(f"{effort:8} {len(mesh.points)} cells after {steps} steps:", end=" ")
    print(f"mean |e| {error.mean():.4f}, mean Q {quality.mean():.4f}, min Q {quality.min():.3f}")
