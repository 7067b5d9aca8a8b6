"""A part of the generators of a domain: those with cells, and the ghosts that shape these cells.

Ghosts are images of generators beyond periodic boundaries, generators of another part, whose halo they form, or
auxiliary generators outside of a polygon. Rows of a part are numbered by its own generators, then by its ghosts, and
the diagram of a part names neighbors by these rows. A stage that reads ``values[neighbors[k]]`` takes the diagram of a
part as it is, with arrays of all rows whose ghosts `Part.forward` has filled.

The diagram of a periodic box is folded as the last step (`GhostImages.fold`): neighbors name the owners of images.
Values then need no ghosts, steps need no launch to fill them, and an update needs no images. Kernels that compute the
position of a neighbor take its nearest image (the PERIODIC macros).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl.array as cla

from ..geometry.domain import ClipBox
from ..opencl.engine import Engine


@dataclass(frozen=True)
class Home:
    """Where the values of g ghosts come from, on the device.

    Attributes
    ----------
    rows : (>= g,) int32
        Row of the owner in its part; -1 for a ghost without owner.
    parts : (>= g,) int32, optional
        Number of the owner's part; None if all owners are in this one.
    codes : (>= g,) int32, optional
        Codes of periodic images: the sum over the axes a of (c + 1) 3^a, where the image is shifted by c periods, c =
        -1, 0 or 1.
    firsts : (n_own + 1,) int32, optional
        The images of generator i begin at ``firsts[i]``.
    """

    rows: cla.Array
    parts: cla.Array | None = None
    codes: cla.Array | None = None
    firsts: cla.Array | None = None


@dataclass(frozen=True)
class Part:
    """Generators with cells and unknowns, and ghosts that only shape cells, on the device.

    Attributes
    ----------
    n_own, count : int
        Number of generators with cells; number of generators and ghosts.
    points : (>= count, d) real
        In the device's coordinates, ghosts last. In a power diagram rows end with weights.
    box : ClipBox
        Contains all of them, and clips cells.
    home : Home, optional
        None if the ghosts have no values, or there are none.
    halo_args : tuple
        What kernels need to test whether the ghosts are enough: HALO_ARGS in a periodic box (periodic/halo.h).
    """

    n_own: int
    count: int
    points: cla.Array
    box: ClipBox
    home: Home | None = None
    halo_args: tuple[object, ...] = ()

    def name_owners(self, engine: Engine, starts: cla.Array, neighbors: cla.Array) -> cla.Array:
        """Return `neighbors` (m,) with owners in place of the ghosts that have one in this part.

        They are in the workspace. Rows begin at `starts` (n_own + 1,).
        """
        if self.home is None or self.home.parts is not None:
            return neighbors
        named = engine.scratch(len(neighbors), np.int32)
        kernel = engine.kernels("tessellation/part").name_owners
        engine.run_each(kernel, self.n_own, np.int32(self.n_own), self.home.rows, starts, neighbors, named)
        return named

    def forward(self, engine: Engine, values: cla.Array, others: Sequence[cla.Array] = ()) -> None:
        """Fill the rows of ghosts in `values` (count, ...), of any type, with the values of their owners.

        Parameters
        ----------
        others : sequence of arrays, optional
            Values of each part, by its number, if owners are in other parts. Rows without owner stay as they are.
        """
        if self.home is None:
            return
        words = np.int32(int(np.prod(values.shape[1:])) * values.dtype.itemsize // 4)
        forward = engine.kernels("tessellation/part").forward_values
        parts = self.home.rows if self.home.parts is None else self.home.parts
        for number, owned in enumerate(others or [values]):
            chosen = np.int32(-1 if self.home.parts is None else number)
            ghosts = self.count - self.n_own
            engine.run_each(forward, ghosts, np.int32(self.n_own), self.home.rows, parts, chosen, words, owned, values)
