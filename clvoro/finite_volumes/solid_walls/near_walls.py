"""The cells of a diagram near the surface of a solid, taken out to be ended there, and put back.

All other cells of the solid are one cell meanwhile, the rest. So the work depends on the surface, not on the volume.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...connectivity import rows_with, take_rows, used_indices
from ...mesh.faces import Faces
from .wall_surface import WallSurface

_REACH = 2.5
"""Cells of generators farther from the surface, over h, do not reach it, unless an outer cell is their neighbor."""
_RINGS = 2
"""Rings of cells around those that reach the surface: one shares vertices that may move, one is their neighbors'."""


@dataclass(frozen=True)
class CellFaces:
    """Faces between cells."""

    owner: np.ndarray
    neighbor: np.ndarray
    """`owner`, `neighbor`: (f,) int."""
    starts: np.ndarray
    corners: np.ndarray
    """`starts`, `corners`: (f + 1,), (k,) int. Corners, counter-clockwise as seen from the neighbor."""
    points: np.ndarray
    """(v, 3) float."""
    row: np.ndarray
    """(f,) int. The face of the diagram that each is."""


@dataclass(frozen=True)
class NearWalls:
    """The cells near a surface, p of n, and the rest as cell p.

    - `faces`: of the whole diagram, with outer cells beyond n.
    - `points` (n, 3) float: generators.
    - `rows` (p,) int: cells near the surface, ascending.
    - `at_wall` (p + 1,) bool: cells that may reach the surface.
    - `generators`, `sizes` (p + 1, 3), (p + 1,) float: those of the rest are far away.
    - `cells`: without those towards outer cells.
    """

    faces: Faces
    points: np.ndarray
    rows: np.ndarray
    at_wall: np.ndarray
    generators: np.ndarray
    sizes: np.ndarray
    cells: CellFaces

    @property
    def numbers(self) -> np.ndarray:
        """Return the generator of each cell, (p + 1,) int; -1 for the rest."""
        return np.append(self.rows, -1)

    @classmethod
    def of(cls, surface: WallSurface, points: np.ndarray, sizes: np.ndarray, faces: Faces) -> NearWalls:
        """Take the cells near the surface out of the diagram `faces` of generators `points` (n, 3) and outer ones."""
        n = len(points)
        at_wall = _may_reach(surface, points, sizes, faces)
        near = np.append(at_wall, np.zeros(faces.n_cells - n + 1, bool))  # the last one is beyond a wall
        for _ in range(_RINGS):
            touched = np.zeros(len(faces.points), bool)
            touched[take_rows(faces.starts, faces.corners, _faces_of(faces, near))[1]] = True
            beside = rows_with(faces.starts, touched[faces.corners])
            near[faces.owner[beside]] = near[faces.neighbor[beside & (faces.neighbor >= 0)]] = True
            near[n:] = False
        rows = np.flatnonzero(near)
        p = len(rows)
        number = np.full(n, p)
        number[rows] = np.arange(p)
        taken = _faces_of(faces, near)
        taken = taken[(faces.owner[taken] < n) & (faces.neighbor[taken] >= 0) & (faces.neighbor[taken] < n)]
        owner, neighbor = number[faces.owner[taken]], number[faces.neighbor[taken]]
        turned = owner == p
        owner[turned], neighbor[turned] = neighbor[turned], p
        starts, corners = take_rows(faces.starts, faces.corners, taken, turned)
        vertices, corners = used_indices(corners, len(faces.points))
        points_there = faces.points[vertices].astype(float)
        cells = CellFaces(owner, neighbor, starts, corners.astype(np.int64), points_there, taken)
        away = np.asarray(surface.solid.upper) + 1e6 * surface.solid.extent
        return cls(
            faces,
            points,
            rows,
            np.append(at_wall[rows], False),
            np.vstack([points[rows], away]),
            np.append(sizes[rows], np.inf),
            cells,
        )

    def put_back(self, made: Faces, home: np.ndarray, own: np.ndarray) -> tuple[Faces, np.ndarray]:
        """Put the cells near the surface back among those of the rest.

        - `made`: the cells near the surface as they have become. Faces to the rest are as they were, with the number of
          `CellFaces.row` as their `half_face`.
        - `home` (m,) int: the cell, here, that each of them was.
        - `own` (m,) bool: whether it holds the generator. Those that do come first, ascending.

        Results:
        - `faces`: the mesh of the solid.
        - `home` (m,) int: see `Diagram.home`.
        """
        whole, n, p = self.faces, len(self.points), len(self.rows)
        generator = np.append(self.rows, n)[home]
        near = np.zeros(whole.n_cells, bool)
        near[self.rows] = True
        has = np.append(~near[:n], False)
        has[generator[own]] = True
        has[n] = False
        count = int(has.sum())
        number = np.cumsum(has) - 1
        numbers = np.where(own, number[generator], count + np.cumsum(~own) - 1)
        # Faces of the rest, also those between it and the cells near the surface, are those of the whole diagram.
        inside = (whole.owner < n) & (whole.neighbor >= 0) & (whole.neighbor < n)
        kept = np.flatnonzero(inside & ~(near[whole.owner] & near[np.maximum(whole.neighbor, 0)]))
        is_rest = np.append(home == p, False)
        at_rest = is_rest[made.owner] | is_rest[np.maximum(made.neighbor, -1)]
        rim, mine = np.flatnonzero(at_rest), np.flatnonzero(~at_rest)
        place = np.full(len(made.points), -1)
        there = made.half_face[rim]
        there_corners = take_rows(whole.starts, whole.corners, there, ~near[whole.owner[there]])[1]
        here_corners = take_rows(made.starts, made.corners, rim)[1]
        assert np.array_equal(made.points[here_corners], whole.points[there_corners]), "faces to the rest have changed"
        place[here_corners] = there_corners
        new = np.flatnonzero(place < 0)
        place[new] = len(whole.points) + np.arange(len(new))
        owner = np.concatenate([number[whole.owner[kept]], numbers[made.owner[mine]]])
        wall = made.neighbor[mine]
        neighbor = np.concatenate(
            [number[whole.neighbor[kept]], np.where(wall < 0, wall, numbers[np.maximum(wall, 0)])]
        )
        between = np.flatnonzero(neighbor >= 0)
        # Two sorted lists: that is fast to complete.
        order = between[np.argsort(owner[between] * (count + len(home)) + neighbor[between], kind="stable")]
        order = np.concatenate([order, np.flatnonzero(neighbor < 0)])
        starts, corners = take_rows(
            np.concatenate([whole.starts, whole.starts[-1] + made.starts[1:]]),
            np.concatenate([whole.corners, place[made.corners].astype(whole.corners.dtype)]),
            np.concatenate([kept, len(whole) + mine])[order],
        )
        faces = Faces(
            domain=made.domain,
            generators=np.concatenate([self.points[has[:n]], made.generators[~own]]),
            points=np.concatenate([whole.points, made.points[new]]),
            starts=starts,
            corners=corners,
            owner=owner[order].astype(np.int32),
            neighbor=neighbor[order].astype(np.int32),
            twin=np.full(len(order), -1),
            shift=np.broadcast_to(np.zeros(3, np.int8), (len(order), 3)),
            half_face=np.full(len(order), -1),
        )
        return faces.compact(), np.concatenate([np.flatnonzero(has), -1 - generator[~own]])


def _faces_of(faces: Faces, cells: np.ndarray) -> np.ndarray:
    """Return the faces that have one of the `cells`, (n + 1,) bool; the last one is beyond walls."""
    return np.flatnonzero(cells[faces.owner] | cells[np.maximum(faces.neighbor, -1)])


def _may_reach(surface: WallSurface, points: np.ndarray, sizes: np.ndarray, faces: Faces) -> np.ndarray:
    """Return which cells may reach the surface, (n,) bool."""
    n = len(points)
    near = np.zeros(faces.n_cells + 1, bool)
    near[:n] = surface.touches(points, _REACH * sizes)
    near[faces.owner[(faces.neighbor < 0) | (faces.neighbor >= n)]] = True
    near[n:] = False
    rows = _faces_of(faces, near)
    rows = rows[(faces.neighbor[rows] >= 0) & (faces.neighbor[rows] < n) & (faces.owner[rows] < n)]
    # Both generators of a face are equally far from its vertices.
    starts, corners = take_rows(faces.starts, faces.corners, rows)
    owner, neighbor = faces.owner[rows], faces.neighbor[rows]
    square = np.zeros(len(corners))
    for x, y in zip(np.ascontiguousarray(faces.points.T), points.T, strict=True):
        square += (x.take(corners) - np.repeat(y[owner], np.diff(starts))) ** 2
    farthest = np.maximum.reduceat(square, starts[:-1]) if len(rows) else square
    reach = np.full(n, -1.0)
    for cells in (owner, neighbor):
        np.maximum.at(reach, cells, farthest)
    reach[reach < 0] = np.inf  # a cell without neighbors ends at walls only
    found = np.zeros(n, bool)
    cells = np.flatnonzero(near[:n])
    found[cells] = surface.touches(points[cells], np.sqrt(reach[cells]) + 0.1 * sizes[cells])
    return found
