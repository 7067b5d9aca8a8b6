"""Moving mesh equations (MMPDE): Huang's functional on the triangulation of a lattice (`mmpde.cl`).

W. Huang, Y. Ren, R. D. Russell, SIAM J. Numer. Anal. 31, 1994; W. Huang, L. Kamenski, J. Comput. Phys. 301, 2015.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import pyopencl.array as cla
import scipy

from ...arguments import warn
from ...connectivity import starts_of
from ...errors import TangledMeshWarning
from ...geometry.domain import Domain
from ...opencl.engine import Engine
from ...opencl.primitives import Summaries
from ..motion import Displacement, Method
from .lattice import mirrored

if TYPE_CHECKING:
    from ..state import MeshState

RATE = 0.4
"""Step of the descent, over the inverse of the estimated second derivative."""
MOST_MOMENTUM = 0.99
"""Largest share of the last displacement that is added. After m steps without a restart it is m / (m + 3)."""
WINDOW = 10
"""Steps over which decreases of the functional are compared."""
LONGEST = 0.5
"""Largest displacement over min(L, h)."""
ROOM = 0.3
"""Largest displacement over the least height of the simplices. Two vertices that approach each other by less than half
of it each cannot turn a simplex over."""
IMAGE_DEPTH = 2.6
"""Depth of the mirror images over the spacing of the lattice: two layers."""
JITTER = 1e-6
"""Random displacement over the spacing, by which cospherical points of the lattice get a triangulation."""
FLAT = 1e-3
"""Volume over the cube of the longest edge below which a simplex is left out: cospherical points have such."""


@dataclass(frozen=True)
class Connections:
    """The simplices around each generator of a lattice, on the device."""

    starts: cla.Array
    """(n + 1,) int32. Row of each generator."""
    vertices: cla.Array
    """(m, d) int32. The other vertices of each of its simplices: generators, then images."""
    owners: cla.Array
    codes: cla.Array
    """`owners`, `codes`: (g,) int32. Of the images; see `Mirrored`."""
    reference: cla.Array
    """(n, d) real. Positions in the lattice."""


def connect(engine: Engine, domain: Domain, points: np.ndarray) -> Connections:
    """Return the Delaunay simplices of a lattice (n, d) and of its images at the walls of a box."""
    n, d = points.shape
    spacing = (domain.measure / n) ** (1 / d)
    images = mirrored(points, np.array(domain.lower), np.array(domain.upper), IMAGE_DEPTH * spacing)
    shaken = images.points + np.random.default_rng(7).uniform(-1, 1, images.points.shape) * JITTER * spacing
    simplices = scipy.spatial.Delaunay(shaken).simplices
    simplices = simplices[(simplices < n).any(axis=1)]
    corners = images.points[simplices]
    longest = np.max(
        [np.linalg.norm(corners[:, a] - corners[:, b], axis=1) for a, b in combinations(range(d + 1), 2)], 0
    )
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    simplices = simplices[volume > FLAT * longest**d]
    # One entry per simplex and vertex, ordered by vertex.
    entries = np.concatenate([np.roll(simplices, -k, axis=1) for k in range(d + 1)])
    entries = entries[entries[:, 0] < n]
    entries = entries[np.argsort(entries[:, 0], kind="stable")]
    starts = starts_of(np.bincount(entries[:, 0], minlength=n))
    return Connections(
        engine.upload(starts, np.int32),
        engine.upload(entries[:, 1:], np.int32),
        engine.upload(images.owners[n:], np.int32),
        engine.upload(images.codes[n:], np.int32),
        engine.upload(domain.place(points, engine.real)),
    )


class Mmpde:
    """The kernels of `mmpde.cl`."""

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._kernels = engine.kernels("adaptation/moving/mmpde")
        self._summaries = Summaries(engine, ("energy", "power", "flat"))

    def descend_functional(
        self, mesh: MeshState, connections: Connections, gradient: cla.Array, descent: cla.Array, room: cla.Array
    ) -> tuple[float, float, int]:
        """Write the step of the steepest descent to `descent` (n, d), and the least height of simplices to `room` (n,).

        Return the functional, its derivative along the last displacement, and the number of generators beside simplices
        without volume. `gradient` (n, d) is grad log h.
        """
        c, real = connections, self.engine.real.type
        energy, power, flat = (self.engine.scratch(mesh.n) for _ in range(3))
        simplices = c.starts, c.vertices, c.owners, c.codes, c.reference
        state = mesh.points, mesh.h, gradient, mesh.velocity, real(RATE)
        results = descent, energy, power, flat, room
        self.engine.run_each(
            self._kernels.descend_functional,
            mesh.n,
            *simplices,
            *state,
            *mesh.domain.device_args(self.engine),
            *results,
        )
        self._summaries.collect_all({"energy": energy, "power": power, "flat": flat}, mesh.n)
        found = self._summaries.read()
        return found["energy"].sum, found["power"].sum, round(found["flat"].sum)

    def bound_displacement(self, mesh: MeshState, descent: cla.Array, share: float, room: cla.Array) -> None:
        """Add `share` of the last displacement to `descent` (n, d), and bound its length."""
        real = self.engine.real.type
        limits = real(share), real(LONGEST), real(ROOM), mesh.local_length, room
        self.engine.run_each(self._kernels.bound_displacement, mesh.n, mesh.velocity, *limits, descent)


@dataclass
class MmpdeMethod(Method):
    """Descent of Huang's functional, with Nesterov's momentum that restarts when the last step goes uphill.

    - `lattice` (n, d) float64: the generators at the start, in the order of their labels.
    - `tolerance`: least decrease of the functional over `WINDOW` steps, over that since the start.
    - `age`: steps since the last restart.
    - `steps`: steps done.
    - `first`, `energy`: the functional at the start, and at the begin of the window.
    - `finished`: whether the functional no longer decreases.
    - `warned`: 1 after a warning.
    """

    lattice: np.ndarray = field(repr=False)
    tolerance: float = 1e-3
    age: int = 0
    steps: int = 0
    first: float = 0.0
    energy: float = 0.0
    finished: bool | None = False
    warned: int = 0
    connections: Connections | None = field(default=None, repr=False)

    def step(self, mesh: MeshState) -> Displacement:
        """Evaluate the displacement as `lloyd`; the correction is zero.

        Warns with `TangledMeshWarning` if simplices have lost their volume.
        """
        engine, stage = mesh.engine, mesh.stages.mmpde
        if self.connections is None:
            self.connections = connect(engine, mesh.domain, self.lattice[mesh.labels.get()])
        descent, correction = engine.scratch(mesh.points.shape), engine.scratch(mesh.points.shape)
        correction.fill(0)
        room = engine.scratch(mesh.n)
        with engine.workspace.frame():
            gradient, sizes = engine.scratch(mesh.points.shape), engine.scratch(mesh.n)
            mesh.sizing.evaluate_with_gradient(mesh.points, mesh.n, sizes, gradient)
            energy, power, folded = stage.descend_functional(mesh, self.connections, gradient, descent, room)
        self._warn(folded, mesh.n)
        self._compare(energy)
        # Uphill: forget the last displacement.
        self.age = 0 if power > 0 else self.age + 1
        stage.bound_displacement(mesh, descent, min(MOST_MOMENTUM, self.age / (self.age + 3)), room)
        mesh.summarize_displacements(descent, correction)
        return Displacement(descent, correction, mesh.h)

    def _compare(self, energy: float) -> None:
        """Finish if the functional has hardly decreased over a window of steps."""
        if self.steps == 0:
            self.first = energy
        elif self.steps % WINDOW == 0:
            self.finished = self.energy - energy <= self.tolerance * (self.first - energy)
        if self.steps % WINDOW == 0:
            self.energy = energy
        self.steps += 1

    def _warn(self, folded: int, n: int) -> None:
        if folded and not self.warned:
            self.warned = 1
            warn(
                f"mmpde: {folded} of {n} generators are beside simplices of the lattice that have no volume any more, "
                "because the size field changes too much for a mesh of fixed topology; use method='adaptive', or limit "
                "the growth of the sizes (clvoro.sizing.Graded)",
                TangledMeshWarning,
            )
