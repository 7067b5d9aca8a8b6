"""Slow, obvious references for diagrams of polygonal domains: half-planes, shapely and nothing else."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .diagrams import box_voronoi

ROUNDS = 6
"""Largest number of cells between a piece and the cell that takes it, as in clvoro/tessellation/clipped/trim.py."""


@dataclass
class Piece:
    """A part of a Voronoi region within the domain: the generator of the region, and the cell that gets the part."""

    home: int
    shape: shapely.Polygon
    root: int
    touched: bool


@dataclass
class PolygonCells:
    """Areas (n,), centroids (n, 2), and the length of the common faces of i and j (or edge -1 - e), lengths[i, j].

    `close` (n,) bool marks cells where round-off decides which generator gets a piece. `regions` are
    the connected parts of cells.
    """

    areas: np.ndarray
    centroids: np.ndarray
    lengths: dict[tuple[int, int], float]
    pieces: list[Piece]
    close: np.ndarray
    regions: int


def polygon_voronoi(domain, points) -> PolygonCells:
    """Return the diagram of a `clvoro.Polygon` by `points` (n, 2)."""
    points = np.asarray(points, float)
    n, whole = len(points), domain.geometry
    small = 1e-11 * float(domain.extent.max())
    lower, upper = domain.clip_box
    cells = [(cell.polygon, cell.neighbors) for cell in box_voronoi(lower, upper, points)]
    shore = whole.boundary.buffer(small / 1000)
    pieces: list[Piece] = []
    mine: list[list[int]] = []
    close = np.zeros(n, bool)
    for i, (corners, _) in enumerate(cells):
        cell = shapely.MultiPoint(corners).convex_hull  # short faces may be lost to round-off
        touched = not shapely.contains_properly(whole, cell)
        parts = shapely.get_parts(shapely.intersection(whole, cell)) if touched else [cell]
        parts = [p for p in parts if p.geom_type == "Polygon" and p.area > 0]
        away = [p.distance(shapely.Point(points[i])) for p in parts]
        own = int(np.argmin(away))
        close[i] = sum(a < small for a in away) > 1
        mine.append(list(range(len(pieces), len(pieces) + len(parts))))
        pieces += [Piece(i, p, i if k == own else -1, touched) for k, p in enumerate(parts)]
    # Faces between pieces: the parts of faces between regions that lie in the domain.
    faces: list[tuple[int, int, float]] = []
    for i, (corners, labels) in enumerate(cells):
        for k, j in enumerate(labels):
            if j < i:
                continue
            line = shapely.LineString([corners[k], corners[(k + 1) % len(corners)]])
            inside = shapely.intersection(whole, line) if pieces[mine[i][0]].touched else line
            if shapely.intersection(inside, shore).length > small:  # along an edge
                inside = shapely.difference(inside, shore)
            for part in shapely.get_parts(inside):
                if part.geom_type != "LineString" or part.length <= small:
                    continue
                middle = part.interpolate(0.5, normalized=True)
                a, b = (min(mine[c], key=lambda p: pieces[p].shape.distance(middle)) for c in (i, j))
                faces.append((a, b, part.length))
    _adopt(pieces, faces, close, small)
    lengths: dict[tuple[int, int], float] = defaultdict(float)
    for a, b, length in faces:
        i, j = pieces[a].root, pieces[b].root
        if i != j:
            lengths[i, j] += length
            lengths[j, i] += length
    tree = shapely.STRtree([p.shape for p in pieces])
    rings = domain.oriented
    ends = rings.vertices[rings.next_vertex]
    for e, a, b in zip(rings.edge_numbers.tolist(), rings.vertices, ends, strict=True):
        for home in {pieces[p].home for p in tree.query(shapely.LineString([a, b]).buffer(small))}:
            # An edge that lies on a face counts to the cell on the left.
            left = small / 1000 * np.array([a[1] - b[1], b[0] - a[0]]) / math.dist(a, b)
            t = _within(a + left, b + left, points[home], points)
            exact = _within(a, b, points[home], points)
            if t is not None and exact is not None and np.abs(np.subtract(t, exact)).max() < 1e-9:
                t = exact
            if t is None or (t[1] - t[0]) * math.dist(a, b) <= small:
                continue
            middle = shapely.Point(a + left + (t[0] + t[1]) / 2 * (b - a))
            piece = min(mine[home], key=lambda p: pieces[p].shape.distance(middle))
            lengths[pieces[piece].root, -1 - e] += (t[1] - t[0]) * math.dist(a, b)
    areas, moments = np.zeros(n), np.zeros((n, 2))
    for piece in pieces:
        area, center = _measures(piece.shape)
        areas[piece.root] += area
        moments[piece.root] += area * center
    inner = [(a, b) for a, b, _ in faces if pieces[a].root == pieces[b].root]
    graph = coo_array((np.ones(len(inner)), np.reshape(inner, (-1, 2)).T), shape=(len(pieces),) * 2)
    regions = int(connected_components(graph, directed=False)[0])
    return PolygonCells(areas, moments / areas[:, None], dict(lengths), pieces, close, regions)


def _measures(shape) -> tuple[float, np.ndarray]:
    area = shape.area
    return area, np.array(shapely.get_coordinates(shapely.centroid(shape))[0])


def _within(a, b, x, points) -> tuple[float, float] | None:
    """Return the part of the edge from a to b that is nearer to x than to all other points."""
    d = points - x
    level = (d * (points + x)).sum(axis=1) / 2
    s, e = level - d @ a, d @ (b - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = s / e
    first = max(0.0, t[e < 0].max(initial=0.0))
    last = min(1.0, t[e > 0].min(initial=1.0))
    if (s[(e == 0) & (d != 0).any(axis=1)] < 0).any():
        return None
    return (first, last) if last > first else None


def _adopt(pieces, faces, close, small) -> None:
    """Give pieces without a generator to the cell beyond their longest face, round by round."""
    beside = defaultdict(list)
    for a, b, length in faces:
        beside[a].append((length, b))
        beside[b].append((length, a))
    for _ in range(ROUNDS):
        roots = [p.root for p in pieces]
        for a, piece in enumerate(pieces):
            if roots[a] >= 0:
                continue
            best = [(length, roots[b]) for length, b in beside[a] if roots[b] >= 0 and pieces[b].touched]
            if best:
                length, piece.root = max(best)
                if any(root != piece.root and length - other < small for other, root in best):
                    close[[root for _, root in best]] = True
    for piece in pieces:
        if piece.root < 0:
            piece.root = piece.home


def euler_excess(diagram, cells: PolygonCells) -> int:
    """V - E + F - C - 1 of the plane graph of all faces, 0 if it is one: regions F from the reference, C components."""
    d = diagram
    ends = np.unique(np.sort(d.face_vertices.reshape(-1, 2), axis=1), axis=0)
    v = len(np.unique(ends))
    components = connected_components(
        coo_array((np.ones(len(ends)), ends.T), shape=(len(d.vertices),) * 2), directed=False
    )[0] - (len(d.vertices) - v)
    outside = 1 + len(d.domain.piece_of_ring) - d.domain.n_pieces
    return v - len(ends) + cells.regions + outside - components - 1
