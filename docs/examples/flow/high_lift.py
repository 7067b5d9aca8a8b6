"""
Wing with slat and flap
=======================

A wing section of three elements in a far field: boundaries are curves. Rows of flat cells lie along all three elements,
and the gaps between them have at least six cells.
"""

import clvoro
from clvoro import sizing
from clvoro.curves import circle, naca, spline

# %%
# The main element is a spline with three corners: both ends of its blunt trailing edge, and the front end of the cove
# into which the flap retracts. Slat and flap are NACA sections. All lengths are in chords.

main = spline(
    [
        (0.86, 0.05),
        (0.7, 0.078),
        (0.5, 0.1),
        (0.3, 0.102),
        (0.16, 0.086),
        (0.07, 0.055),
        (0.03, 0.02),
        (0.04, -0.018),
        (0.1, -0.036),
        (0.25, -0.045),
        (0.45, -0.042),
        (0.62, -0.03),
        (0.64, 0.0),
        (0.69, 0.024),
        (0.76, 0.036),
        (0.86, 0.046),
    ],
    closed=True,
    corners=[0, 11, 15],
    name="main",
)
slat = naca("4415", chord=0.18, leading_edge=(-0.14, -0.06), angle_of_attack=-35, name="slat")
flap = naca("4412", chord=0.32, leading_edge=(0.84, 0.005), angle_of_attack=32, name="flap")
far = circle((0.5, 0), 8, name="far-field")
domain = clvoro.Polygon(far, [slat, main, flap])
print(domain)

# %%
# Sizes follow the curvature of the walls and the width of the gaps, and grow by an eighth per cell. The nose of the slat
# is the sharpest, so its cells are the narrowest.

size = sizing.FeatureSize(domain, cells_across=6, curvature=5, growth=1.12, h_min=0.0015, h_max=0.8)
near = sizing.Distance([slat, main, flap], h_min=0.012, growth=1.12, h_max=0.8)
layers = [
    clvoro.Layers(0.0003, count=5, growth=1.3, spacing=0.0015, edges="slat"),
    clvoro.Layers(0.0004, count=5, growth=1.3, spacing=0.0025, edges=["main", "flap"]),
]

mesh = clvoro.adapt(domain, sizing.minimum(size, near), layers=layers)
print(mesh)
mesh.plot("size", window=((-0.3, -0.3), (1.3, 0.3)))

# %%
# The cove, and the gap between main element and flap.

mesh.plot("size", window=((0.6, -0.06), (0.9, 0.09)))

# %%
# All points on walls of the mesh that a solver reads lie on the curves. OpenFOAM accepts it, and reads the folder.

print(mesh.solver_mesh().measures)
assert mesh.check(solver="openfoam")
mesh.to_openfoam("high_lift/high_lift.foam", types={"far-field": "patch"})
