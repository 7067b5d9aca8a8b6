"""Queries of a diagram: one cell, the cells that hold points, the dual triangles, shapes of shapely."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import shapely

from ..arguments import check_integer
from ..connectivity import rows_and_places, rows_of, starts_of, take_rows
from ..errors import InputError
from .diagram import Diagram
from .read_only import Sealed

_STEPS = 200
"""Most cells on the way to the one that holds a point."""


@dataclass(frozen=True, eq=False)
class Cell(Sealed):
    """One cell; see `Diagram.cell`. Lengths are in the domain's unit.

    Attributes
    ----------
    index : int
    generator, centroid : (d,) float64
    volume : float
        Area in 2D.
    neighbors : (k,) int32
        Cell behind each face, or -1 - w on wall w of the domain.
    areas : (k,) float64
        Measure of each face; length in 2D.
    vertices : (v, d) float64
        Corners of the cell, each once; in 2D counter-clockwise, clockwise around holes.
    faces : tuple of k int arrays
        Corners of each face, as indices in `vertices`: two in 2D; in 3D counter-clockwise as seen from outside. An
        array is empty where a face is as narrow as round-off.
    """

    index: int
    generator: np.ndarray
    centroid: np.ndarray
    volume: float
    neighbors: np.ndarray
    areas: np.ndarray
    vertices: np.ndarray
    faces: tuple[np.ndarray, ...]


def make_cell(diagram: Diagram, i: int) -> Cell:
    """Return cell `i` of `diagram`.

    Raises
    ------
    InputError, InputTypeError
        If `i` is not an integer, or there is no such cell.
    """
    n = len(diagram)
    i = check_integer("i", i, -n)
    if i >= n:
        raise InputError(f"i is {i}, expected at most {n - 1}: the diagram has {n} cells")
    i %= n
    first, last = (int(k) for k in diagram.neighbor_starts[i : i + 2])
    starts = diagram.face_vertex_starts[first : last + 1]
    corners = diagram.face_vertices[starts[0] : starts[-1]]
    _, place, inverse = np.unique(corners, return_index=True, return_inverse=True)
    order = np.argsort(place)  # corners in the order in which faces have them
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return Cell(
        index=i,
        generator=diagram.points[i],
        centroid=diagram.centroids[i],
        volume=float(diagram.volumes[i]),
        neighbors=diagram.neighbors[first:last],
        areas=diagram.face_measures[first:last],
        vertices=diagram.vertices[corners[place[order]]],
        faces=tuple(np.split(rank[inverse.ravel()], (starts - starts[0])[1:-1])),
    )


def power_tree(diagram: Diagram, places: np.ndarray, periods: np.ndarray) -> scipy.spatial.KDTree:
    """Return a search tree of the generators at `places` (n, d); 0 in `periods` stands for walls.

    In a power diagram there is a further coordinate; see `Domain.lift`. `lifted` adds it to points.
    """
    if not diagram.is_power:
        return scipy.spatial.KDTree(places, boxsize=periods)
    moved, heights = diagram.domain.lift(diagram.points, diagram.weights)
    return scipy.spatial.KDTree(np.column_stack([places + moved, heights]), boxsize=np.append(periods, 0.0))


def lifted(diagram: Diagram, places: np.ndarray) -> np.ndarray:
    """Return `places` (k, d) as a tree of `power_tree` takes them."""
    return np.pad(places, ((0, 0), (0, 1))) if diagram.is_power else places


class Locator:
    """Finds the cells that hold points.

    In a box the cell is that of the nearest generator, by the power distance, also across seams. In a polygonal domain
    the boundary cuts cells off, so the point may be in the cell of another generator. There the shape of the cell
    decides.
    """

    def __init__(self, diagram: Diagram) -> None:
        self.diagram, self.domain = diagram, diagram.domain
        self.origin = np.array(self.domain.lower)
        periods = np.where(self.domain.periodic, self.domain.extent, 0.0)
        self.last = np.where(periods > 0, np.nextafter(periods, 0), np.inf)
        self.tree = power_tree(diagram, self._place(diagram.points), periods)

    def _place(self, points: np.ndarray) -> np.ndarray:
        """Return positions relative to the lower corner, in periodic directions within one period."""
        return np.minimum(self.domain.wrap(points) - self.origin, self.last)

    def find(self, points: object) -> np.ndarray:
        """Return the cell that holds each of `points` (k, d), (k,) int32; -1 outside."""
        x = self.domain.check_rows("points", points)
        found = np.full(len(x), -1, np.int32)
        inside = np.flatnonzero(self.domain.contains(x))
        x = x[inside]
        if not len(x):
            return found
        found[inside] = self.tree.query(lifted(self.diagram, self._place(x)))[1]
        if self.domain.cuts_cells:
            found[inside] = self._corrected(x, found[inside])
        if self.diagram.layer.any():
            found[inside] = self._walked(x, found[inside])
        return found

    def _walked(self, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Return the cells of a solid that hold the points `x` (k, 3), on the way from `cells` (k,) across faces.

        With layers, the nearest generator may be that of a cell beside.
        """
        f, cells = self.diagram.faces, cells.astype(np.int64)
        starts, places = f.cell_faces()
        face = f.sides()[1]
        moving, best, least = np.arange(len(x)), cells.copy(), np.full(len(x), np.inf)
        for _ in range(_STEPS):
            begin, side = take_rows(starts, places, cells[moving])
            row, back = rows_of(begin), side >= len(f)
            k = face[side]
            beyond = ((x[moving][row] - f.center[k]) * f.normal[k]).sum(axis=1) * np.where(back, -1, 1)
            behind = np.where(back, f.owner[k], f.neighbor[k])
            beyond[behind < 0] = -np.inf
            last = np.lexsort((beyond, row))[begin[1:] - 1]
            better = beyond[last] < least[moving]
            best[moving[better]], least[moving[better]] = cells[moving[better]], beyond[last][better]
            going = beyond[last] > 0
            moving = moving[going]
            if not len(moving):
                break
            cells[moving] = behind[last[going]]
        return best

    def _corrected(self, x: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """Return the cells whose shape holds the points `x`, of which the nearest generators are those of `cells`."""
        shapes = self.diagram.to_shapely()
        rest = np.flatnonzero(~shapely.intersects_xy(shapes[cells], x[:, 0], x[:, 1]))
        if rest.size:
            places = shapely.points(x[rest])
            # Between two shapes there may be a gap as wide as round-off. There the nearest shape counts.
            row, cell = shapely.STRtree(shapes).query_nearest(places, all_matches=False)
            cells = cells.copy()
            cells[rest[row]] = cell
        return cells


def dual_triangles(diagram: Diagram) -> np.ndarray:
    """Return the triples of generators whose cells meet in a vertex (t, 3) int32; see `Diagram.triangles`."""
    if diagram.domain.cell_dim != 2 or any(diagram.domain.periodic):
        raise InputError(
            f"triangles are for meshes in the plane without seams and on spheres, not for {diagram.domain}; use "
            "neighbors and shifts, which every diagram has"
        )
    n, starts = len(diagram), diagram.cell_vertex_starts
    cells = rows_of(starts)
    # A cell with several loops lists the ends of its bridges twice.
    pairs = np.unique(diagram.cell_vertices * np.int64(n) + cells)
    vertices, cells = pairs // n, pairs % n
    centers = diagram.vertices
    if diagram.is_power:
        # The generators need not lie around the vertex, but around their own middle.
        number = np.bincount(vertices, minlength=len(centers))
        sums = [np.bincount(vertices, diagram.points[cells, a], len(centers)) for a in range(centers.shape[1])]
        centers = np.column_stack(sums) / number[:, None]
    arms = diagram.points[cells] - centers[vertices]
    axes = diagram.domain.tangents(diagram.vertices)
    arms = np.column_stack([(arms * axis[vertices]).sum(axis=1) for axis in axes])
    # Around each vertex counter-clockwise.
    order = np.lexsort((np.arctan2(arms[:, 1], arms[:, 0]), vertices))
    cells = cells[order]
    first = np.flatnonzero(np.diff(vertices, prepend=-1))
    counts = np.diff(first, append=len(vertices))
    # A fan of counts - 2 triangles; one triangle at most vertices.
    fans = np.maximum(counts - 2, 0)
    row, place = rows_and_places(fans)
    apex, step = first[row], place + 1
    return np.column_stack([cells[apex], cells[apex + step], cells[apex + step + 1]]).astype(np.int32)


def cell_shapes(diagram: Diagram, chosen: np.ndarray | None = None) -> np.ndarray:
    """Return each cell of a diagram in 2D, or of `chosen` rows, as a shapely geometry; see `Diagram.to_shapely`."""
    ends, following = diagram.half_faces.ends, diagram.half_faces.next
    owner = diagram.half_faces.owner
    # One loop follows the other; each ends where the next face is its first one.
    begins = np.concatenate([[True], following[:-1] != np.arange(1, len(following))])
    loop = np.cumsum(begins) - 1
    sizes = np.bincount(loop)
    ring = np.repeat(np.arange(len(sizes)), sizes + 1)
    starts = starts_of(sizes)
    # The first corner comes again at the end.
    place = np.arange(len(ring)) - ring
    place = np.where(place == starts[ring + 1], starts[ring], place)
    of = owner[starts[:-1]]
    cells = np.empty(len(diagram), object)
    wanted = np.arange(len(diagram)) if chosen is None else chosen
    usable = (sizes >= 3) & np.isin(of, wanted)
    rings = np.full(len(sizes), None, object)
    kept = usable[ring]
    numbers = np.cumsum(usable) - 1
    rings[usable] = shapely.linearrings(diagram.vertices[ends[place[kept], 0]], indices=numbers[ring[kept]])
    lone = np.bincount(of[usable], minlength=len(diagram))[of] == 1
    cells[of[usable & lone]] = shapely.polygons(rings[usable & lone])
    several = np.flatnonzero(usable & ~lone)
    for i in np.unique(of[several]):
        cells[i] = _joined(rings[several[of[several] == i]])
    cells = cells[wanted]
    cells[[cell is None for cell in cells]] = shapely.Polygon()
    bad = ~shapely.is_valid(cells)  # outlines that touch or cross themselves within round-off
    cells[bad] = [_areas(shapely.make_valid(cell)) for cell in cells[bad]]
    return cells


def _joined(rings: np.ndarray) -> Any:
    """Return the region on the left of all `rings`."""
    outer = shapely.is_ccw(rings)
    parts = [_areas(shapely.make_valid(part)) for part in np.asarray(shapely.polygons(rings))]
    whole = shapely.union_all([p for p, o in zip(parts, outer, strict=True) if o])
    return shapely.difference(whole, shapely.union_all([p for p, o in zip(parts, outer, strict=True) if not o]))


def _areas(shape: Any) -> Any:
    """Return the parts of a shape that have an area."""
    flat = [p for p in shapely.get_parts(shape) if p.geom_type in ("Polygon", "MultiPolygon")]
    return shapely.union_all(flat) if flat else shapely.Polygon()
