"""
Follow a moving bubble
======================

A hot bubble drifts to the right. The mesh follows it, each time from the mesh before, and the temperature is carried
along conservatively.
"""

import matplotlib.pyplot as plt
import numpy as np

import clvoro
from clvoro import sizing

domain = clvoro.Box((0, 0), (2, 1))


def size(x):
    """Return the size field of a bubble whose center is at x."""
    rim = sizing.Circle((x, 0.5), radius=0.22)
    return sizing.Distance(rim, h_min=0.01, growth=1.15, h_max=0.06)


def temperature(points, x):
    """Return hot gas inside of the bubble, cold gas outside."""
    r = np.hypot(*(points - [x, 0.5]).T)
    return 300 + 500 * (1 - np.tanh((r - 0.22) / 0.012))


# %%
# The first mesh starts from nothing.

adapter = clvoro.Adapter()
places = 0.5 + 0.02 * np.arange(26)
mesh = adapter.run(domain, size(places[0]), seed=3)
values = temperature(mesh.points, places[0])
frames = [(mesh, values)]

# %%
# All others start from the mesh before. The bubble moves by two cells at a time, so that a few steps are enough. A solver would
# advance the temperature in between. Here it is transferred to the new mesh, and the formula gives the next one.

steps, lost = [], []
for x in places[1:]:
    after = adapter.run(domain, size(x), points=mesh.points)
    carried = mesh.transfer(values, onto=after, order=2)
    steps.append(after.history["step"][-1])
    lost.append((carried * after.diagram.volumes).sum() / (values * mesh.diagram.volumes).sum() - 1)
    mesh, values = after, temperature(after.points, x)
    frames.append((mesh, values))

print(f"{np.median(steps):.0f} steps per mesh, the first one took {frames[0][0].history['step'][-1]}")
print(f"total after a transfer off by {np.abs(lost).max():.0e} at most")

# %%
# The temperature and the sizes of the first mesh, of one in the middle, and of the last one.

figure, axes = plt.subplots(3, 2, figsize=(10, 8), layout="constrained")
for row, k in zip(axes, (0, 12, 25), strict=True):
    result, data = frames[k]
    result.plot(data, label="temperature [K]", ax=row[0], edges=False)
    result.plot("size", ax=row[1], title=f"mesh {k}: {len(result.points):,} cells")
plt.show()
