"""The last part of the method "transport": a power diagram whose cells have their target volumes.

The volumes h(x_i)^d are prescribed, times the factor that makes their sum the volume of the domain. Damped Newton steps
find the weights. Then the generators move to the centroids of their cells, and so on (de Goes et al. 2012, ACM Trans.
Graph. 31, 171). With fixed volumes this descends the transport cost, the sum of the integrals of |y - x_i|^2.
"""

from __future__ import annotations

import pyopencl.array as cla

from ...solvers.conjugate_gradient import Solution
from ...tessellation.tessellator import Tessellator
from ..state import MeshState


class PowerPhase:
    """Turns the diagram of a mesh into a power diagram."""

    def __init__(self, mesh: MeshState) -> None:
        self.mesh = mesh
        mesh.power = Tessellator(mesh.stages, mesh.domain, weighted=True)
        self._weights: cla.Array | None = None

    def prescribe(self) -> Solution:
        """Give the cells their target volumes, and evaluate the mesh; return the last linear solve."""
        mesh, stages = self.mesh, self.mesh.stages
        assert mesh.power is not None
        mesh.sizing.evaluate(mesh.points, mesh.n, mesh.h, mesh.size_factor)
        mesh.sizing.check(mesh.points, mesh.h, mesh.size_factor)
        prescribed = stages.transport.prescribe_sizes(mesh.h)
        mesh.tessellation, self._weights, newton = stages.transport.solve(
            mesh.power, mesh.points, prescribed, self._weights
        )
        factor = newton.factor ** (1 / mesh.engine.cell_dim)
        mesh.size_factor *= factor
        stages.metric.scale_sizes(factor, mesh.h)
        mesh.compare_and_evaluate()
        return newton.solution

    def aim(self) -> None:
        """Set the displacements of the mesh to those to the centroids, to the end of the workspace's frame."""
        mesh = self.mesh
        mesh.allocate_step()
        mesh.lloyd = mesh.t.offsets
        mesh.correction.fill(0)
        mesh.summarize_displacements()
