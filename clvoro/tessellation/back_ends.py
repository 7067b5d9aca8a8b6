"""The back ends that build and update cells, and the rules by which an engine takes one.

=======  ==========================================================================================================
scalar   One work-item for each cell. It works everywhere, and makes the cells that the others leave.
lanes    Eight cells at a time in the lanes of a CPU's vectors (`cl_kernels/simd/`): in float64, without weights.
         New cells from a number of them on; before, the build of the kernels takes longer than it saves.
teams    In 3D a team of work-items for each new cell: on NVIDIA's GPUs, in boxes with walls, without weights.
=======  ==========================================================================================================

In 2D all give the same bits. In 3D teams have those of scalar. Lanes have the same graph, but sum over the vertices of
a cell in the order in which they trace them, as updates do, not that in which scalar clips.
"""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from ..errors import BuildError
from ..opencl.engine import PLAIN, Engine
from ..opencl.kernels import Kernels
from ..opencl.program import on_nvidia
from .bins import MAX_LEVELS
from .cut_cells import FACE_CAPACITY

LANES = 8
"""Cells in the lanes of a vector."""
LANES_FROM = {2: 1000, 3: 15_000}
"""Number of cells from which new ones are built in lanes, by their dimension."""
TEAM = 32
"""Number of work-items of a team. A cell has at most as many faces (MOST_FACES in `tessellation/row_counts.h`)."""


def has_lanes(engine: Engine) -> bool:
    """Return whether eight cells at a time are built, measured and checked."""
    return engine.group_size == 1 and engine.real == np.float64 and not engine.traits.site_values


def teams_are_faster(device: cl.Device) -> bool:
    """Return whether teams build cells faster than single work-items on `device`: on NVIDIA's GPUs.

    By the platform, not by a measurement: the same choice in every run. The kernel for 1e6 random generators in float64
    took 43.9 ms by teams and 138.5 ms without on an H200 (see "On a GPU" in bench/RESULTS.md).
    """
    return has_warps(device)


def has_warps(device: cl.Device) -> bool:
    """Return whether `device` has the warp instructions of team.h: NVIDIA's from compute capability 8 on."""
    return on_nvidia(device) and device.compute_capability_major_nv >= 8


def has_teams(engine: Engine) -> bool:
    """Return whether teams build cells in 3D: in boxes with walls on all sides, on devices where they are faster."""
    return engine.traits == PLAIN and FACE_CAPACITY == TEAM and teams_are_faster(engine.queue.device)


def team_defines(warps: bool) -> dict[str, object]:
    """Return the defines of kernels by teams, with or without warp instructions."""
    macros: dict[str, object] = {"MAX_DEPTH": MAX_LEVELS, "FACE_CAPACITY": FACE_CAPACITY}
    return macros | {"WARP_ASM": 1} if warps else macros


class TeamKernel:
    """A kernel whose groups are teams.

    - `kernels`: those of its program, which is not built yet.
    """

    def __init__(self, device: cl.Device, kernels: Kernels, name: str) -> None:
        self._kernels: Kernels | None = kernels
        self._device, self._name = device, name

    def get(self) -> cl.Kernel | None:
        """Return the kernel; None if the driver does not build it, or the device has no room for a team."""
        if self._kernels is not None:
            try:
                kernel = getattr(self._kernels, self._name)
                if _fits(kernel, self._device):
                    return kernel
            except BuildError:
                pass
            self._kernels = None
        return None


def _fits(kernel: cl.Kernel, device: cl.Device) -> bool:
    """Return whether `device` has room for a team of `kernel`: work-items of a group, and local memory."""
    info = cl.kernel_work_group_info
    most = kernel.get_work_group_info(info.WORK_GROUP_SIZE, device)
    local = kernel.get_work_group_info(info.LOCAL_MEM_SIZE, device)
    return most >= TEAM and local <= device.local_mem_size
