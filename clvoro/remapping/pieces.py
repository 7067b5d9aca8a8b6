"""The cells of a mesh as convex pieces. The device intersects those of two meshes (`device_transfer.py`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from ..mesh.connectivity import following, take_rows
from ..mesh.diagram import Diagram
from ..mesh.geometry import sum_rows
from ..mesh.half_faces import FLAT
from ..mesh.lookup import cell_shapes

_STRAIGHT = 1e-9
"""A corner that points inwards counts as straight if its edges span no more than this share of the cell's area."""
_THIN = 1e-12
"""A triangle with less than this share of the cell's area is left out."""
_ON_WALL = 1e-3
"""A generator counts as on a wall if its distance from it is less than this share of the cell's width."""


@dataclass(frozen=True)
class Pieces:
    """Convex pieces of cells.

    A convex cell with plane faces is one piece. Other cells are divided into triangles, in 3D into pyramids.

    - `cells` (k,) int: the cell that each piece is a part of, ascending.
    - `origins` (k, d) float64: a point near each piece, and in it in 3D: the generator, unless it is on a wall or
      outside of its cell.
    - `points` (v, d) float64: in 2D and on a sphere corners of cells; in 3D generators, and mirror images of origins in
      walls and other faces.
    - `starts`, `items` (k + 1,), (m,) int: row i lists those of `points` that bound piece i: its corners,
      counter-clockwise; in 3D the piece is nowhere nearer to one of them than to its origin.
    """

    cells: np.ndarray
    origins: np.ndarray
    points: np.ndarray
    starts: np.ndarray
    items: np.ndarray

    @classmethod
    def of(cls, diagram: Diagram) -> Pieces:
        """Return the pieces of the cells of a diagram."""
        return {2: _between_corners, 3: _between_bisectors}[diagram.domain.cell_dim](diagram)

    def __len__(self) -> int:
        return len(self.cells)

    def summed(self, values: np.ndarray, n: int) -> np.ndarray:
        """Return for each of `n` cells the sum of `values` (k,) or (k, width) over its pieces."""
        return sum_rows(self.cells, values.reshape(len(values), -1), n).reshape(n, *values.shape[1:])


def _between_corners(diagram: Diagram) -> Pieces:
    """Return the pieces of polygons."""
    cells, x, n = np.arange(len(diagram)), diagram.vertices, len(diagram)
    inside = diagram.points
    if diagram.domain.curved:
        inside = diagram.centroids if diagram.is_power else inside
        inside = inside * (diagram.domain.frame[1] / np.linalg.norm(inside, axis=1))[:, None]
    if not (diagram.domain.cuts_cells or diagram.is_power):
        return Pieces(cells, inside, x, diagram.cell_vertex_starts, diagram.cell_vertices)
    starts, items = diagram.half_faces.cell_corners
    usable = np.diff(starts) >= 3
    if not diagram.domain.cuts_cells:
        return Pieces(cells[usable], inside[usable], x, *take_rows(starts, items, cells[usable]))
    owner = np.repeat(np.arange(n), np.diff(starts))
    after = following(starts)
    edges = x[items[after]] - x[items]
    along = edges[after]
    turns = edges[:, 0] * along[:, 1] - edges[:, 1] * along[:, 0]
    slack = _STRAIGHT * diagram.volumes[owner]
    back = (turns < -slack) | ((turns <= slack) & ((edges * along).sum(axis=1) < 0))
    convex = usable & (np.bincount(owner, back, n) == 0)
    cells = np.flatnonzero(convex)
    bent = np.flatnonzero(usable & ~convex)
    starts, items = take_rows(starts, items, cells)
    if bent.size:
        parts = shapely.constrained_delaunay_triangles(cell_shapes(diagram, bent))
        triangles, of = shapely.get_parts(parts, return_index=True)
        corners = shapely.get_coordinates(shapely.orient_polygons(triangles)).reshape(-1, 4, 2)[:, :3]
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        # By round-off, the lines through the sides of a thinner triangle may enclose nothing.
        thick = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > _THIN * diagram.volumes[bent[of]]
        corners, of = corners[thick], of[thick]
        items = np.concatenate([items, len(x) + np.arange(3 * len(corners))])
        starts = np.concatenate([starts, starts[-1] + 3 * np.arange(1, len(corners) + 1)])
        cells, x = np.concatenate([cells, bent[of]]), np.concatenate([x, corners.reshape(-1, 2)])
        order = np.argsort(cells, kind="stable")
        cells = cells[order]
        starts, items = take_rows(starts, items, order)
    return Pieces(cells, inside[cells], x, starts, items)


def _between_bisectors(diagram: Diagram) -> Pieces:
    """Return the pieces of polyhedra. Faces on no bisector, as those at walls, get mirror images of the origins."""
    owner, neighbors, n = diagram.half_faces.owner, diagram.neighbors.copy(), len(diagram)
    filled = np.diff(diagram.neighbor_starts) > 0
    alone = (neighbors < 0) | diagram.shifts.any(axis=1)
    normals, gaps = np.zeros((len(owner), 3)), np.ones(len(owner))
    normals[alone], gaps[alone] = diagram.half_faces.planes(np.flatnonzero(alone))
    # A generator on a wall has no mirror image, and one outside of its cell is in no piece.
    moved = np.zeros(n, bool) | diagram.is_power | (not filled.all())
    moved[owner[gaps < _ON_WALL * np.cbrt(diagram.volumes[owner])]] = True
    others = np.flatnonzero(moved[owner] & ~alone)
    normals[others], gaps[others] = diagram.half_faces.planes(others)
    alone[others] = True
    origins = np.where(moved[:, None], diagram.centroids, diagram.points)
    alone = np.flatnonzero(alone)
    own, normal = owner[alone], normals[alone]
    gap = gaps[alone] + ((diagram.points[own] - origins[own]) * normal).sum(axis=1)
    neighbors[alone] = n + np.arange(len(alone))
    points = np.concatenate([diagram.points, origins[own] + 2 * gap[:, None] * normal])
    if not diagram.has_moved_vertices:
        cells = np.flatnonzero(filled)
        starts = np.append(diagram.neighbor_starts[:-1][filled], len(neighbors))
        return Pieces(cells, origins[cells], points, starts, neighbors)
    bent = diagram.half_faces.bent_cells
    cells = np.flatnonzero(filled & ~bent)
    starts, items = take_rows(diagram.neighbor_starts, neighbors, cells)
    parts = _pyramids(diagram, np.flatnonzero(bent[owner]))
    cells, order = np.concatenate([cells, parts.cells]), np.argsort(np.concatenate([cells, parts.cells]), kind="stable")
    starts = np.concatenate([starts, starts[-1] + parts.starts[1:]])
    items = np.concatenate([items, len(points) + parts.items])
    origins = np.concatenate([origins[cells[: len(cells) - len(parts)]], parts.origins])
    points = np.concatenate([points, parts.points])
    return Pieces(cells[order], origins[order], points, *take_rows(starts, items, order))


def _pyramids(diagram: Diagram, faces: np.ndarray) -> Pieces:
    """Return the parts of cells between half-faces (k,) and centroids of the cells: pyramids over flat convex faces.

    Over other faces they are tetrahedra, with the centroid of the face as a corner, as volumes of cells are defined.
    """
    starts, items = take_rows(diagram.face_vertex_starts, diagram.face_vertices, faces)
    face, after = np.repeat(np.arange(len(faces)), np.diff(starts)), following(starts)
    owner = diagram.half_faces.owner[faces]
    apex, middle, width = diagram.centroids[owner], diagram.face_centroids[faces], np.cbrt(diagram.volumes[owner])
    corners = diagram.vertices[items]
    area = np.add.reduceat(np.cross(corners - middle[face], corners[after] - middle[face]), starts[:-1])
    normal = area / np.maximum(np.linalg.norm(area, axis=1), 1e-300)[:, None]
    edges = corners[after] - corners
    off = np.abs(((corners - middle[face]) * normal[face]).sum(axis=1)) > FLAT * width[face]
    off |= (np.cross(edges, edges[after]) * normal[face]).sum(axis=1) < -((FLAT * width[face]) ** 2)
    flat = np.bincount(face, off, len(faces)) == 0
    heights = np.cross(corners - middle[face], corners[after] - middle[face])
    volumes = ((middle - apex)[face] * heights).sum(axis=1) / 6
    # Each edge has a piece of its own, or that of its flat face; pieces without a volume are left out.
    piece = np.where(flat[face], starts[face], np.arange(len(face)))
    kept = np.bincount(piece, volumes, len(face))[piece] > FLAT**2 * diagram.volumes[owner][face]
    kept &= np.linalg.norm(edges, axis=1) > FLAT * width[face]
    rows, own = np.unique(piece[kept], return_inverse=True)
    of, single = face[rows], ~flat[face[rows]]
    origins = 0.75 * middle[of] + 0.25 * apex[of]
    origins[single] = (apex[of] + middle[of] + corners[rows] + corners[after[rows]])[single] / 4
    kept, tops, alone = np.flatnonzero(kept), apex[of], rows[single]
    through = [apex[face[kept]], middle[of], tops[single], tops[single]]
    across = [
        np.cross(corners[kept] - through[0], corners[after[kept]] - through[0]),
        np.where(single[:, None], heights[rows], area[of]),
        np.cross(middle[of][single] - tops[single], corners[alone] - tops[single]),
        np.cross(middle[of][single] - tops[single], corners[after[alone]] - tops[single]),
    ]
    behind = np.concatenate([own, np.arange(len(rows)), np.flatnonzero(single), np.flatnonzero(single)])
    normals = np.concatenate(across)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    gaps = ((np.concatenate(through) - origins[behind]) * normals).sum(axis=1)
    counts = np.bincount(behind, minlength=len(rows))
    return Pieces(
        owner[of],
        origins,
        origins[behind] + 2 * gaps[:, None] * normals,
        np.append(0, np.cumsum(counts)),
        np.argsort(behind, kind="stable"),
    )
