"""
Body from a surface file in 3D
==============================

Cells grow away from a body that comes as triangles: STL, OBJ, PLY or OFF, read by trimesh.
"""

from pathlib import Path

import clvoro
from clvoro import sizing

# %%
# A smooth body with five lobes, from the built-in case `surface`.

file = Path(clvoro.__file__).parent / "cli" / "cases" / "lobes.obj"
body = sizing.Surface.read(file)
size = sizing.Distance(body, h_min=0.04, growth=1.2, h_max=0.2)
box = clvoro.Box((-1, -1, -0.75), (2, 1, 0.75))
mesh = clvoro.adapt(box, size, effort="fast")
print(mesh)
mesh.plot("size", view="slices")

# %%
# What is below the middle plane.

mesh.plot("size", view="cutaway", cut="z", through=(0, 0, 0))
