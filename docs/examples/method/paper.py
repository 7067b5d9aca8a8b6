"""
Lloyd, Poisson, and both
========================

The paper's validation case from one random start: Lloyd's steps give good cells of the wrong size, the Poisson correction ugly cells of
the right size, both together good cells of the right size.
"""

import matplotlib.pyplot as plt

import clvoro
from clvoro import sizing

domain = clvoro.Box((0, 0), (2.5, 1.5))
size = sizing.Distance(sizing.Circle((0.9, 0.75), radius=0.3), h_min=0.02, slope=0.3)

# %%
# These methods repeat one kind of step. They start from the same random points. `tol=0` takes all 100 steps.

adapter = clvoro.Adapter()
options = clvoro.PaperOptions(tol=0, k=1)
runs = {
    method: adapter.run(domain, size, points="uniform", method=method, seed=20251, max_steps=100, options=options)
    for method in ("lloyd", "poisson", "coupled")
}

# %%
figure, axes = plt.subplots(3, 1, figsize=(6.4, 11), layout="constrained")
for ax, (method, run) in zip(axes, runs.items(), strict=True):
    run.plot("quality", ax=ax, limits=(0.5, 1), title=method)
plt.show()

# %%
# The history has one row per step.

figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
for method, run in runs.items():
    axes[0].semilogy(run.history["step"], run.history["mean_error"], label=method)
    axes[1].plot(run.history["step"], run.history["mean_quality"], label=method)
axes[0].set(xlabel="step", ylabel="mean $|e|$")
axes[1].set(xlabel="step", ylabel="mean $Q$")
axes[1].legend()
plt.show()
