"""Conservative transfer of cell data by the intersections of old and new cells, on the device (`transfer.cl`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pyopencl.array as cla
import shapely

from ..connectivity import following, rows_of, take_rows
from ..errors import ClvoroError, InputError
from ..geometry.bvh import Tree, curve_order
from ..mesh.diagram import Diagram
from ..mesh.geometry import sum_rows
from ..mesh.half_faces import FLAT
from ..mesh.lookup import cell_shapes
from ..opencl.engine import Engine

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
    owner = rows_of(starts)
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
    face, after = rows_of(starts), following(starts)
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


FACES = {2: 32, 3: 32}
"""Initial face capacity of a piece by dimension; doubled when a piece needs more."""
MOST_FACES = {2: 4096, 3: 512}
"""Largest face capacity by dimension."""
DONE, PIECE_LARGE, FAILED = range(3)
"""Outcomes of a piece; see `transfer.cl`."""


@dataclass(frozen=True)
class Space:
    """The coordinates in which two meshes are intersected."""

    origin: np.ndarray
    scale: float
    """`origin`, `scale`: (d,) float64, float. A position x has the coordinates (x - origin) / scale."""
    lower: np.ndarray
    upper: np.ndarray
    """`lower`, `upper`: (d,) float64. Corners of a box around all cells, in these coordinates."""

    def place(self, x: np.ndarray) -> np.ndarray:
        """Return the coordinates of positions."""
        return (x - self.origin) / self.scale

    def corners(self, real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of the box as kernels take them."""
        lower, upper = np.zeros((2, 4), real)
        lower[: len(self.lower)], upper[: len(self.upper)] = self.lower, self.upper
        return lower, upper


@dataclass(frozen=True)
class PieceArrays:
    """Pieces on the device."""

    pieces: Pieces
    args: tuple[cla.Array, ...]
    """The arguments `PIECES_ARGS` of kernels in `transfer.cl`."""


@dataclass(frozen=True)
class PieceMeasures:
    """Measures of pieces on the host, in the coordinates of the `Space`."""

    volumes: np.ndarray
    centroids: np.ndarray
    """`volumes`, `centroids`: (k,), (k, d) float64. On a sphere centroids are means of positions, inside the sphere."""
    lower: np.ndarray
    upper: np.ndarray
    """`lower`, `upper`: (k, d) float64. Corners of a box around each piece."""


@dataclass(frozen=True)
class CellData:
    """Data of the old cells, on the device."""

    cells: cla.Array
    """(k,) int32. The cell of each piece."""
    values: cla.Array
    """(n, width) real. Means over the cells."""
    least: cla.Array
    most: cla.Array
    """`least`, `most`: (n, width) real. Bounds of the data inside a cell."""
    means: cla.Array
    """(n, d) real. Centroids; on a sphere means of the position."""
    slopes: cla.Array | None = None
    """(n, width, d) real. Slopes of the data in each cell; None for constants."""

    @property
    def kernel_args(self) -> tuple[object, ...]:
        """CELL_DATA_ARGS of `transfer.cl`."""
        slopes = self.values if self.slopes is None else self.slopes
        values = np.int32(self.values.shape[1]), self.values, self.least, self.most, self.means
        return self.cells, *values, np.int32(self.slopes is not None), slopes


@dataclass(frozen=True)
class CellGraph:
    """Neighbors of the old cells."""

    starts: np.ndarray
    neighbors: np.ndarray
    """`starts`, `neighbors`: (n + 1,), (m,) int. Negative neighbors are walls."""
    shifts: np.ndarray
    """(m, d) int8. Number of periods along each axis to the image that is the neighbor."""
    periods: np.ndarray
    """(d,) float64. In the coordinates of the `Space`."""


def transfer_bytes(engine: Engine, old: Pieces, new: Pieces, half_faces: int, width: int, order: int) -> float:
    """Estimate the device memory in bytes that a transfer of `width` columns needs.

    - `half_faces`: those of the old mesh.
    - `order`: slopes exist for order 2 only.
    """
    d, real = engine.dim, engine.real.itemsize
    pieces = sum((len(p.points) + len(p)) * d * real + 4 * len(p.items) for p in (old, new))
    rows = 4 * (len(old) + len(new))
    cells = int(old.cells[-1]) + 1
    data = (width + d + (order - 1) * width * (2 + d)) * real * cells + 4 * len(old)
    nodes = 1 << (2 + max(0, len(old) - 1).bit_length())
    tree = nodes * d * real + 8 * len(old)
    results = ((3 * width + 1) * real + 8) * len(new)
    graph = (order - 1) * (half_faces * (4 + d) + 12 * cells)
    return pieces + rows + data + max(tree + results, graph)


class ConservativeTransfer:
    """Average data over the intersections of the cells of two meshes."""

    def __init__(self, engine: Engine, space: Space) -> None:
        self.engine, self.space = engine, space
        self._box = space.corners(engine.real)
        self._build(FACES[engine.cell_dim])

    def _build(self, faces: int) -> None:
        """Build the kernels for pieces of up to `faces` faces."""
        self._faces, dim = faces, self.engine.cell_dim
        name = {2: "CELL_CAPACITY", 3: "FACE_CAPACITY"}[dim]
        self._kernels = self.engine.kernels("remapping/transfer", {name: faces})
        # On a CPU the private arrays of a whole work-group lie on one thread's stack: large ones need groups of one.
        self._group = None if faces == FACES[dim] else 1

    def _are_large(self, status: np.ndarray, cells: np.ndarray, what: str) -> np.ndarray:
        """Return the rows of `status` that need more faces, after the capacity is doubled for them.

        Raises `ClvoroError` or `InputError` if a piece has too many faces, or is none.
        """
        failed = np.flatnonzero(status == FAILED)
        if failed.size:
            raise InputError(
                f"cell {cells[failed[0]]} of {what} ({failed.size} in all) cannot be built from its faces, expected "
                "Voronoi diagrams of distinct generators"
            )
        large, most = np.flatnonzero(status == PIECE_LARGE), MOST_FACES[self.engine.cell_dim]
        if large.size and 2 * self._faces > most:
            raise ClvoroError(
                f"cell {cells[large[0]]}, or its intersection with an old cell, has more than {self._faces} faces, "
                f"expected at most {most}: perturb the generators of the mesh"
            )
        if large.size:
            self._build(2 * self._faces)
        return large

    def upload(self, pieces: Pieces) -> PieceArrays:
        """Copy pieces to the device."""
        upload = self.engine.upload
        places = (upload(self.space.place(x)) for x in (pieces.origins, pieces.points))
        return PieceArrays(pieces, (*places, upload(pieces.starts, np.int32), upload(pieces.items, np.int32)))

    def measure(self, mesh: PieceArrays, what: str) -> PieceMeasures:
        """Measure pieces; `what` names their mesh in errors."""
        engine, k, d = self.engine, len(mesh.pieces), self.engine.dim
        volumes, status = engine.empty(k), engine.empty(k, np.int32)
        centroids, lower, upper = (engine.empty((k, d)) for _ in range(3))
        results = volumes, centroids, lower, upper
        while True:
            engine.run_each(
                self._kernels.measure_pieces, k, *mesh.args, *self._box, *results, status, group=self._group
            )
            if not self._are_large(status.get(), mesh.pieces.cells, what).size:
                return PieceMeasures(*(array.get().astype(np.float64) for array in results))

    def fit_slopes(self, old: PieceArrays, graph: CellGraph, data: CellData, limited: bool) -> CellData:
        """Fit a linear function in each cell to the means of the cell and its neighbors.

        - `limited`: limit the slopes, so that the function stays within the values of the cell and its neighbors.
        """
        engine, (n, width) = self.engine, data.values.shape
        slopes = engine.empty((n, width, engine.dim))
        least, most = engine.empty((n, width)), engine.empty((n, width))
        status = engine.empty(n, np.int32)
        parts = np.searchsorted(old.pieces.cells, np.arange(n + 1))
        periods = np.zeros(4, engine.real)
        periods[: engine.dim] = graph.periods
        lists = engine.upload(graph.starts, np.int32), engine.upload(graph.neighbors, np.int32)
        rows = engine.upload(parts, np.int32), *old.args, *lists, engine.upload(graph.shifts, np.int8), periods
        while True:
            cells = np.int32(width), *rows, *self._box, data.means, data.values, np.int32(limited)
            found = slopes, least, most, status
            engine.run_each(self._kernels.fit_slopes, n, *cells, *found, group=self._group)
            if not self._are_large(status.get(), np.arange(n), "the diagram of the values").size:
                return replace(data, least=least, most=most, slopes=slopes)

    def transfer(
        self, new: PieceArrays, old: PieceArrays, boxes: PieceMeasures, periods: np.ndarray, data: CellData
    ) -> tuple[np.ndarray, ...]:
        """Return integrals of `data` over the new pieces, bounds of the data there, and volumes.

        - `boxes`: those of the old pieces.
        - `periods` (d,) float64: by which the old mesh is repeated; 0 where it is not.

        Results:
        - `masses`, `low`, `high`: (k, width) real
        - `volumes`, `covered` (k,) real: those of the pieces, and what old pieces cover of them.
        """
        engine, (k, width) = self.engine, (len(new.pieces), data.values.shape[1])
        entries, shifts = (
            np.column_stack([np.arange(len(old.pieces)), np.zeros(len(old.pieces), int)]),
            np.zeros((1, engine.dim)),
        )
        if periods.any():
            entries, shifts = _images(self.measure(new, "onto"), boxes, periods)
        moved = shifts[entries[:, 1]]
        lower, upper = boxes.lower[entries[:, 0]] + moved, boxes.upper[entries[:, 0]] + moved
        tree = Tree(lower, upper, curve_order(lower + upper), leaf=1)
        order = curve_order(new.pieces.origins)
        results = *(engine.empty((k, width)) for _ in range(3)), engine.empty(k), engine.empty(k)
        status = engine.empty(k, np.int32)
        status.fill(DONE)
        boxes_args = np.int32(tree.n), np.int32(tree.levels), engine.upload(tree.boxes)
        images = engine.upload(entries[tree.order], np.int32), engine.upload(shifts)
        args = *new.args, *old.args, *boxes_args, *images, *self._box, *data.kernel_args, *results, status
        while order.size:
            engine.run_each(
                self._kernels.transfer_cell_data, len(order), engine.upload(order, np.int32), *args, group=self._group
            )
            order = self._are_large(status.get(), new.pieces.cells, "one of the diagrams")
        return tuple(array.get() for array in results)


def _images(new: PieceMeasures, old: PieceMeasures, periods: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return images of old pieces that may overlap new ones: pairs (m, 2) of piece and image; shifts (images, d)."""
    lower, upper = new.lower.min(axis=0), new.upper.max(axis=0)
    period = np.where(periods > 0, periods, np.inf)
    first, last = np.floor((lower - old.upper.max(axis=0)) / period), np.ceil((upper - old.lower.min(axis=0)) / period)
    first, last = np.where(periods > 0, [first, last], 0).astype(int)
    shifts = np.array(list(product(*(range(a, b + 1) for a, b in zip(first, last, strict=True))))) * periods
    pairs = []
    for image, shift in enumerate(shifts):
        rows = np.flatnonzero(((old.upper + shift >= lower) & (old.lower + shift <= upper)).all(axis=1))
        pairs.append(np.column_stack([rows, np.full(len(rows), image)]))
    found = np.concatenate(pairs)
    # A tree has entries, also where the meshes lie apart.
    return (found if len(found) else np.zeros((1, 2), int)), shifts
