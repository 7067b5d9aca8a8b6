"""Half-faces of a diagram: each face as each of its cells has it. In 2D they are half-edges, in loops around cells."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..connectivity import following, rows_of, starts_of
from ..errors import ClvoroError
from .diagram import Diagram
from .read_only import read_only

FLAT = 1e-6
"""A face counts as plane if its corners are nearer to a plane than this, over the width of the cell."""


class HalfFaceArrays:
    """The half-faces of a diagram, in the order of its rows; arrays are made when they are first used."""

    def __init__(self, diagram: Diagram) -> None:
        self.diagram = diagram

    @cached_property
    def owner(self) -> np.ndarray:
        """The cell of each half-face, (m,) int32."""
        d = self.diagram
        return read_only(np.repeat(np.arange(len(d), dtype=np.int32), np.diff(d.neighbor_starts)))

    @cached_property
    def opposite(self) -> np.ndarray:
        """Place of the half-face on the other side, (m,) int64; -1 on walls and where the neighbor lacks it."""
        inner = np.flatnonzero(self.diagram.neighbors >= 0)
        here, there = self.keys(inner)
        one, two = np.argsort(here), np.argsort(there)
        if not np.array_equal(here[one], there[two]):
            _, one, two = np.intersect1d(here, there, return_indices=True)
        found = np.full(len(self.diagram.neighbors), -1)
        found[inner[one]] = inner[two]
        return read_only(found)

    @property
    def ends(self) -> np.ndarray:
        """First and last vertex of each half-face in 2D, (m, 2); its cell is on the left."""
        return self.diagram.face_vertices.reshape(-1, 2)

    @cached_property
    def next(self) -> np.ndarray:
        """The next half-face in 2D in the loop around the cell, (m,) int64.

        In the row of a cell one loop follows the other. A loop ends where the next face does not begin in its last
        vertex.
        """
        ends, starts = self.ends, self.diagram.neighbor_starts
        m = len(ends)
        breaks = np.zeros(m, bool)
        breaks[starts[1:][starts[1:] > starts[:-1]] - 1] = True
        breaks[:-1] |= ends[:-1, 1] != ends[1:, 0]
        places = np.arange(1, m + 1)
        stops = np.flatnonzero(breaks)
        places[stops] = np.concatenate([[0], stops[:-1] + 1])[: len(stops)]
        return read_only(places)

    @cached_property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """The corners of each half-face as ragged rows: starts (m + 1,) and vertices.

        In 2D the cell is on the left of the way from the first to the second corner. In 3D the order is
        counter-clockwise as seen from outside of the cell. A repeated corner is given once. A face that then has no
        measure (fewer than 2 corners in 2D, 3 in 3D) has an empty row.
        """
        d = self.diagram
        least, starts, corners = d.domain.cell_dim, d.face_vertex_starts, d.face_vertices
        kept = np.empty(len(corners), bool)
        np.not_equal(corners[1:], corners[:-1], out=kept[:-1])
        filled = np.flatnonzero(starts[1:] > starts[:-1])
        last = starts[1:][filled] - 1
        kept[last] = corners[last] != corners[starts[filled]]
        if kept.all() and (np.diff(starts) >= least).all():
            return starts, corners
        rows = rows_of(starts)
        counts = np.bincount(rows[kept], minlength=len(starts) - 1)
        counts[counts < least] = 0
        kept &= counts[rows] > 0
        return read_only(starts_of(counts)), read_only(corners[kept])

    @cached_property
    def cell_corners(self) -> tuple[np.ndarray, np.ndarray]:
        """The corners of each cell in 2D as ragged rows: starts (n + 1,) and vertices, counter-clockwise.

        A repeated corner is given once. Several loops are joined by bridges, as in the diagram.
        """
        starts, corners = self.diagram.cell_vertex_starts, self.diagram.cell_vertices
        cell = rows_of(starts)
        kept = corners != corners[following(starts)]
        counts = np.bincount(cell[kept], minlength=len(self.diagram))
        return read_only(starts_of(counts)), read_only(corners[kept])

    def behind(self, faces: np.ndarray) -> np.ndarray:
        """Return the generators, or their images, behind the half-faces `faces` (k,): (k, d).

        Behind a wall it is the mirror image of the cell's own, or the generator of the cell that was removed there.
        """
        d = self.diagram
        neighbors = d.neighbors[faces]
        found = d.points[np.maximum(neighbors, 0)] + d.shifts[faces] * d.domain.extent
        walls = np.flatnonzero(neighbors < 0)
        if walls.size:
            found[walls] = d.domain.mirrored(-1 - neighbors[walls], d.points[self.owner[faces[walls]]])
        return found

    def plane_shares(self, faces: np.ndarray) -> np.ndarray:
        """Return where planes of half-faces (k,) between cells cross the lines between generators, in shares of these.

        1/2 in a Voronoi diagram; for a power diagram see `Domain.plane_shares`.
        """
        d = self.diagram
        if not d.is_power:
            return np.full(len(faces), 0.5)
        i, j = self.owner[faces], d.neighbors[faces]
        between = self.behind(faces) - d.points[i]
        return d.domain.plane_shares((between**2).sum(axis=1), d.weights[j] - d.weights[i])

    def planes(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return unit normals (k, d) of half-faces (k,), and the distances (k,) of their planes from the generators."""
        d = self.diagram
        behind, walls = d.neighbors[faces] < 0, -1 - d.neighbors[faces]
        own = d.points[self.owner[faces]]
        between = self.behind(faces[~behind]) - own[~behind]
        lengths = np.linalg.norm(between, axis=1)
        normals, gaps = np.empty_like(own), np.empty(len(own))
        normals[~behind] = between / lengths[:, None]
        gaps[~behind] = self.plane_shares(faces[~behind]) * lengths
        normals[behind], gaps[behind] = d.domain.toward_walls(walls[behind], own[behind])
        return normals, gaps

    @cached_property
    def bent_cells(self) -> np.ndarray:
        """Whether each cell in 3D has a face with corners off its bisector or wall, (n,) bool."""
        d = self.diagram
        face = rows_of(d.face_vertex_starts)
        owner, (normals, gaps) = self.owner[face], self.planes(np.arange(len(d.neighbors)))
        heights = ((d.vertices[d.face_vertices] - d.points[owner]) * normals[face]).sum(axis=1)
        off = np.abs(heights - gaps[face]) > FLAT * np.cbrt(d.volumes[owner])
        return read_only(np.bincount(owner[off], minlength=len(d)) > 0)

    def keys(self, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return keys of the half-faces `faces` (k,) between two cells, and keys of their opposite half-faces.

        Keys sort by cell, neighbor and shift, and in a polygon, where two cells may share several faces, then by
        vertices; (k,) int64 each.
        """
        d = self.diagram
        n, dim = len(d), d.domain.dim
        i, j = self.owner[faces].astype(np.int64), d.neighbors[faces].astype(np.int64)
        here, there = i * n + j, j * n + i
        if any(d.domain.periodic):
            codes = (d.shifts[faces] + 1) @ 3 ** np.arange(dim)
            here = here * 3**dim + codes
            there = there * 3**dim + (3**dim - 1 - codes)
        if not d.domain.cuts_cells:
            return here, there
        begin, end = self.ends[faces].T
        columns = [np.concatenate(c) for c in ((end, begin), (begin, end), (here, there))]
        order = np.lexsort(columns)
        new = np.any([np.diff(c[order], prepend=-1) != 0 for c in columns], axis=0)
        numbers = np.empty(len(order), np.int64)
        numbers[order] = np.cumsum(new)
        return numbers[: len(faces)], numbers[len(faces) :]

    def edges(self, glued: bool) -> HalfEdges:
        """Return the half-edges in 2D. With `glued`, those at the seams of a periodic box have twins across.

        Raises `ClvoroError` if a face exists on one side only.
        """
        d, ends = self.diagram, self.ends
        rows = np.flatnonzero(ends[:, 0] != ends[:, 1])
        place = np.full(len(ends) + 1, -1)
        place[rows] = np.arange(len(rows))
        onward = self.next[rows]
        while (place[onward] < 0).any():
            onward = np.where(place[onward] < 0, self.next[onward], onward)
        onward = place[onward]
        previous = np.empty_like(onward)
        previous[onward] = np.arange(len(rows))
        twin, joined = place[self.opposite[rows]], d.neighbors[rows] >= 0
        if (twin[joined] < 0).any():
            raise ClvoroError(
                "the arrays of the diagram contradict each other: two cells have different common faces; call "
                "diagram.check(), or make the diagram again"
            )
        if not glued:
            twin[d.shifts[rows].any(axis=1)] = -1
        lower = (twin < 0) | (np.arange(len(rows)) < twin)
        first = np.flatnonzero(lower)
        edge = np.empty(len(rows), np.int64)
        edge[first] = np.arange(len(first))
        edge[~lower] = edge[twin[~lower]]
        cell = self.owner[rows]
        starts = starts_of(np.bincount(cell, minlength=len(d)))
        begin, end = ends[rows].T
        return HalfEdges(rows, cell, starts, begin, end, onward, previous, twin, edge, first)


@dataclass(frozen=True)
class HalfEdges:
    """The half-faces in 2D that have a length, and their edges: cell by cell, loop by loop.

    A half-edge runs counter-clockwise around its cell, which lies on its left. An edge between two cells is a pair of
    half-edges in opposite directions; an edge on the boundary is a single one.
    """

    rows: np.ndarray
    """(h,) int. Place of each half-edge in the diagram's graph."""
    cell: np.ndarray
    """(h,) int."""
    starts: np.ndarray
    """(n + 1,) int. Cell i has the half-edges `starts[i]` to `starts[i + 1]`."""
    begin: np.ndarray
    end: np.ndarray
    """`begin`, `end`: (h,) int. Vertices of the diagram."""
    next: np.ndarray
    previous: np.ndarray
    """`next`, `previous`: (h,) int. Next and previous half-edge in the loop."""
    twin: np.ndarray
    """(h,) int. The opposite half-edge; -1 on the boundary."""
    edge: np.ndarray
    """(h,) int. Number of the edge."""
    first: np.ndarray
    """(e,) int. The lower-numbered half-edge of each edge, ascending: edges are sorted by their lower cell."""

    @property
    def counts(self) -> np.ndarray:
        """Number of edges of each cell, (n,)."""
        return np.diff(self.starts)
