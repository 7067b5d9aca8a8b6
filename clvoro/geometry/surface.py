"""Triangulated surfaces, as arrays or from STL, OBJ, PLY and OFF files."""

from __future__ import annotations

import math
from functools import cached_property
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from ..arguments import format_point
from ..connectivity import components
from ..errors import InputError, InputTypeError
from .bvh import Tree
from .columns import Columns
from .shapes import coordinates
from .surface_files import joined, read_parts
from .triangles import areas_of, crossing, packed_rows, packed_weights

_ROUND_OFF = 1e-12  # of the extent: vertices that are nearer to each other are one
_BLOCK = 1 << 14  # pairs of triangles per batch: they stay in the caches


class Surface:
    """A triangulated surface in 3D.

    Parameters
    ----------
    vertices : (v, 3) float
    triangles : (t, 3) int
        Indices into `vertices`. `contains` needs the same orientation in all triangles; distances do not depend on it.
    name : str
        Name of the surface in error messages.
    join : float
        Distance within which vertices count as one for `closed` and `open_edges`, in the unit of the coordinates. With
        0 only vertices at the same place are one.

    Raises
    ------
    InputError, InputTypeError
        If no triangle has an area, a vertex is not finite, or an index is out of range; names the first.

    Notes
    -----
    Corners at the same place, up to round-off, count as one vertex, so a file of separate triangles (STL) serves as
    well as one with shared vertices. Open, branching and self-intersecting surfaces are accepted, because distances to
    them are well defined. `require_closed` and `check` refuse them.

    Examples
    --------
    Cells of 0.01 on a part, growing by a tenth per cell away from it::

        part = clvoro.sizing.Surface.read("part.stl")
        size = clvoro.sizing.Distance(part, h_min=0.01, growth=1.1, h_max=0.2)
    """

    dim = 3
    """Number of coordinates."""

    def __init__(self, vertices: object, triangles: object, name: str = "Surface", join: float = 0.0):
        if not (isinstance(join, Real) and 0 <= join < math.inf):
            raise InputError(f"{name} join is {join!r}, expected a finite distance, 0 or more")
        self.name, self.join = name, float(join)
        self.vertices = coordinates(f"{name} vertices", vertices, 2)
        if self.vertices.shape[1] != 3:
            raise InputError(
                f"{name} vertices have shape {self.vertices.shape}, expected (v, 3); "
                "in 2D use ClosedPolyline or Polyline"
            )
        given = np.asarray(triangles)
        if given.size and given.dtype.kind not in "iu":
            raise InputTypeError(
                f"{name} triangles have dtype {given.dtype}, expected integers, the indices of vertices"
            )
        if given.ndim != 2 or given.shape[1] != 3 or not len(given):
            raise InputError(
                f"{name} triangles have shape {given.shape}, expected (t, 3) with at least one; "
                "split larger faces into triangles"
            )
        bad = np.argwhere((given < 0) | (given >= len(self.vertices)))
        if len(bad):
            row, column = bad[0].tolist()
            raise InputError(
                f"{name} triangles[{row}, {column}] is {given[row, column]}, expected an index of "
                f"one of the {len(self.vertices)} vertices, 0 to {len(self.vertices) - 1}"
            )
        self.triangles = given.astype(np.int64)
        self.triangles.flags.writeable = False
        if not (self.areas > 0).any():
            raise InputError(
                f"{name} has {len(given)} triangles, none of which has an area; expected a "
                "surface. Is a column of the coordinates missing?"
            )

    @classmethod
    def read(cls, path: str | PathLike[str], join: float = 0.0) -> Surface:
        """Read a surface from an STL, OBJ, PLY or OFF file, with trimesh.

        Parameters
        ----------
        path : str or path
        join : float
            See `Surface`.

        Raises
        ------
        InputError
            If trimesh is not installed, the file cannot be read, or it holds no valid surface.
        """
        vertices, triangles, _ = joined(read_parts(path))
        return cls(vertices, triangles, f"surface {str(Path(path))!r}", join)

    @cached_property
    def corners(self) -> np.ndarray:
        """Corners of the triangles, (t, 3, 3) float."""
        return self.vertices[self.triangles]

    @cached_property
    def rows(self) -> np.ndarray:
        """What distances to the triangles need, (t, 21); see `packed_rows`."""
        return packed_rows(self.corners)

    @cached_property
    def _unit_corners(self) -> np.ndarray:
        """Corners relative to the center of the bounding box, in units of its longest edge."""
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        extent = (high - low).max()
        return (self.corners - (low + 0.5 * (high - low))) / (extent if extent > 0 else 1.0)

    @cached_property
    def areas(self) -> np.ndarray:
        """Areas of the triangles, (t,) float, in units of the bounding box's longest edge squared."""
        return areas_of(self._unit_corners)

    @cached_property
    def tree(self) -> Tree:
        """Bounding boxes of the triangles."""
        return Tree(self.corners.min(axis=1), self.corners.max(axis=1))

    @cached_property
    def columns(self) -> Columns:
        """The triangles in columns along one axis, for winding numbers."""
        vertices, triangles = self.welded
        return Columns(vertices[triangles])

    @cached_property
    def _joined(self) -> tuple[np.ndarray, np.ndarray]:
        """The places (p, 3), and that of each vertex, (v,) int."""
        unique, places = np.unique(self.vertices + 0.0, axis=0, return_inverse=True)
        places = places.reshape(-1)
        join = max(self.join, _ROUND_OFF * float(np.ptp(unique, axis=0).max()))
        near = scipy.spatial.KDTree(unique).query_pairs(join, output_type="ndarray")
        if len(near):
            joined = components(len(unique), *near.T)[1]
            unique, places = unique[np.unique(joined, return_index=True)[1]], joined[places]
        return unique, places

    @property
    def places(self) -> np.ndarray:
        """The place of each vertex in `welded`, (v,) int."""
        return self._joined[1]

    @cached_property
    def welded(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (p, 3) and triangles (t, 3), with one place for all vertices that are joined."""
        unique, places = self._joined
        return unique, places[self.triangles]

    @cached_property
    def _edges(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Edges (e, 2) between places, the number of triangles at each, and one of its triangles and sides, 3 t + s.

        Triangles without three distinct corners are left out.
        """
        merged = self.welded[1]
        whole = (merged != np.roll(merged, -1, axis=1)).all(axis=1)
        ends = np.stack([merged[whole], np.roll(merged[whole], -1, axis=1)], axis=2).reshape(-1, 2)
        edges, first, count = np.unique(np.sort(ends, axis=1), axis=0, return_index=True, return_counts=True)
        return edges, count, 3 * np.flatnonzero(whole)[first // 3] + first % 3

    @property
    def open_sides(self) -> np.ndarray:
        """Sides of triangles at edges of a single one, 3 t + s, (k,) int."""
        return self._edges[2][self._edges[1] == 1]

    @cached_property
    def open_edges(self) -> np.ndarray:
        """Edges of a single triangle, (k, 2) int, as indices of vertices."""
        triangle, side = np.divmod(self.open_sides, 3)
        return np.column_stack([self.triangles[triangle, side], self.triangles[triangle, (side + 1) % 3]])

    @property
    def closed(self) -> bool:
        """Whether every edge belongs to an even number of triangles. Then the surface has an inside."""
        return not (self._edges[1] % 2).any()

    def require_closed(self, remedy: str = "") -> None:
        """Raise if the surface is not closed.

        Raises `InputError` with the number of open edges, the place of the first one, and a `remedy`.
        """
        if self.closed:
            return
        edges = self.open_edges
        if len(edges):
            a, b = (format_point(self.vertices[i]) for i in edges[0])
            raise InputError(
                f"{self.name} is open: {len(edges)} edges belong to a single triangle, the first from "
                f"{a} to {b}; expected a closed surface"
                + (remedy or ": fill the holes, or pass join= if vertices that should coincide are a little apart")
            )
        edges, count, where = self._edges
        odd = np.flatnonzero(count % 2)
        triangle, side = divmod(int(where[odd[0]]), 3)
        a, b = (format_point(self.corners[triangle, (side + k) % 3]) for k in (0, 1))
        raise InputError(
            f"{self.name} is not closed: {len(odd)} edges belong to an odd number of triangles, the "
            f"first, from {a} to {b}, to {count[odd[0]]}; " + (remedy or "remove the surplus triangles")
        )

    def crossings(self) -> np.ndarray:
        """Return the pairs of triangles that intersect or cover each other, (k, 2) int, sorted.

        Contact without overlap is no intersection. Triangles thinner than 1e-7 of their length are skipped.
        """
        i, j = self.tree.overlaps()
        corners = self._unit_corners
        low, high = corners.min(axis=1), corners.max(axis=1)
        found = []
        for first in range(0, len(i), _BLOCK):
            p, q = i[first : first + _BLOCK], j[first : first + _BLOCK]
            meet = ((low[p] <= high[q]) & (low[q] <= high[p])).all(axis=1)
            p, q = p[meet], q[meet]
            hit = crossing(corners[p], corners[q])
            found.append(np.column_stack([p[hit], q[hit]]))
        pairs = np.concatenate(found)
        return pairs[np.lexsort(pairs.T[::-1])]

    def check(self) -> None:
        """Raise if the surface intersects itself.

        Raises `InputError` with the first pair of triangles, their places and the number of pairs.
        """
        pairs = self.crossings()
        if len(pairs):
            p, q = pairs[0].tolist()
            raise InputError(
                f"{self.name} intersects itself: triangles {p}, at "
                f"{format_point(self.corners[p].mean(axis=0))}, and {q}, at "
                f"{format_point(self.corners[q].mean(axis=0))}, and {len(pairs) - 1} more pairs; "
                "expected a surface without self-intersections. Repair it in the program that made it, for "
                "instance with a boolean union of its parts"
            )

    def contains(self, points: object) -> np.ndarray:
        """Return for each of `points` (n, 3) whether it lies inside the closed surface, (n,) bool.

        By the winding number; see `Columns`. Exact for points that are not on the surface. All triangles must have the
        same orientation, inwards or outwards.

        Raises
        ------
        InputError
            If the surface is not closed.
        """
        self.require_closed()
        return self.columns.winding(coordinates("points", points, 2)) != 0

    def distance2(self, points: np.ndarray) -> np.ndarray:
        """Return the squared distances of `points` (n, 3) to the surface, (n,) float64."""
        used = self.vertices[np.unique(self.triangles)]
        bound = scipy.spatial.KDTree(used).query(points)[0] * (1 + 1e-12)
        return self.tree.nearest2(points, bound**2, lambda x, item: packed_weights(x, self.rows[item])[2])

    def landmarks(self, spacing: float, most: int) -> np.ndarray:
        """Return at most `most` points on the surface, about `spacing` apart."""
        total = np.cumsum(self.areas)
        unit = np.ptp(self.vertices, axis=0).max()
        count = int(min(max(total[-1] * (unit / spacing) ** 2, 1), most))
        # Equal shares of the area, and in each triangle a low-discrepancy sequence (plastic number, R2).
        item = np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1])
        item = np.minimum(item, len(total) - 1)
        k = np.arange(count)
        s, t = np.sqrt((0.5 + 0.7548776662466927 * k) % 1), (0.5 + 0.5698402909980532 * k) % 1
        weights = np.column_stack([1 - s, s * (1 - t), s * t])
        return np.einsum("nk,nkd->nd", weights, self.corners[item])

    def packed(self, origin: np.ndarray, scale: float, real: np.dtype) -> tuple[np.ndarray, Tree]:
        """Return the triangles as the device takes them, (t, 21) in the order of the tree, and the tree.

        See `packed_rows`. Coordinates are x' = (x - origin) / scale. They are rounded to `real` first, so that the rest
        is consistent with them.
        """
        corners = ((self.corners - origin) / scale).astype(real)
        tree = Tree(corners.min(axis=1), corners.max(axis=1))
        return packed_rows(corners[tree.order].astype(float), real), tree

    def __len__(self) -> int:
        return len(self.triangles)

    def __repr__(self) -> str:
        return f"Surface({len(self.vertices)} vertices, {len(self.triangles)} triangles)"


class Skin(NamedTuple):
    """A surface that may bound a solid: its triangles are in groups that have names."""

    surface: Surface
    groups: np.ndarray
    """Group of each triangle, (t,) int."""
    names: tuple[str, ...]
    done: tuple[str, ...] = ()
    """What was done to the surface, for messages."""


def box_surface(lower: np.ndarray, upper: np.ndarray) -> Surface:
    """Return the six sides of a box as twelve triangles, counter-clockwise from outside."""
    bits = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Surface(np.where(bits, upper, lower), triangles, "Box")
