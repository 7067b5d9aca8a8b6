"""Slow, obvious references for diagrams of polygonal domains: half-planes, shapely and nothing else."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

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


def convex_cells(lower, upper, points) -> list[tuple[np.ndarray, list[int]]]:
    """Corners (k, 2) of each Voronoi cell in a box, and behind which generator (-1: wall) face k lies."""
    points = np.asarray(points, float)
    tree = cKDTree(points)
    cells = []
    for i, x in enumerate(points):
        a, b = lower - x, upper - x
        polygon = np.array([a, (b[0], a[1]), b, (a[0], b[1])])
        labels = [-1] * 4
        k, done = min(16, len(points)), {i}
        while True:
            distances, order = tree.query(x, k=np.arange(1, k + 1))
            reach = np.hypot(*polygon.T).max()
            for j, distance in zip(order, distances, strict=True):
                if distance > 2 * reach:
                    break
                if j in done:
                    continue
                done.add(int(j))
                polygon, labels = _clip(polygon, labels, points[j] - x, int(j))
                reach = np.hypot(*polygon.T).max()
            if k == len(points) or distances[-1] > 2 * reach:
                break
            k = min(4 * k, len(points))
        cells.append((polygon + x, labels))
    return cells


def _clip(polygon, labels, d, j):
    side = polygon @ d - d @ d / 2
    if (side <= 0).all():
        return polygon, labels
    corners, faces = [], []
    for k, (p, face, s) in enumerate(zip(polygon, labels, side, strict=True)):
        q, t = polygon[(k + 1) % len(polygon)], side[(k + 1) % len(polygon)]
        if s <= 0:
            corners.append(p)
            faces.append(face)
        if (s <= 0) != (t <= 0):
            corners.append(p + s / (s - t) * (q - p))
            faces.append(j if s <= 0 else face)
    return np.array(corners), faces


def polygon_voronoi(domain, points) -> PolygonCells:
    """Return the diagram of a `clvoro.Polygon` by `points` (n, 2)."""
    points = np.asarray(points, float)
    n, whole = len(points), domain.geometry
    small = 1e-11 * float(domain.extent.max())
    lower, upper = domain.clip_box
    cells = convex_cells(lower, upper, points)
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


def faults(diagram, real: str = "float64") -> list[str]:
    """Return the faults of a diagram of a polygonal domain that can be found without a reference."""
    d, domain = diagram, diagram.domain
    eps = float(np.finfo(real).eps)
    size, n = float(domain.extent.max()), len(d.points)
    far = max(map(abs, (*domain.lower, *domain.upper)))
    # Tolerance of corners of updated cells, in units of the device.
    slack = 64 * (eps * domain.frame[1] + 2.3e-16 * far)
    found = []

    def demand(holds, text: str) -> None:
        if not holds:
            found.append(text)

    starts, j = d.neighbor_starts, d.neighbors
    owner = np.repeat(np.arange(n), np.diff(starts))
    for name in ("volumes", "centroids", "face_measures", "face_centroids", "vertices"):
        demand(np.isfinite(getattr(d, name)).all(), f"{name} not finite")
    demand((d.volumes > 0).all(), f"volumes {d.volumes.min():.3g} of cell {d.volumes.argmin()}")
    total = d.volumes.sum() - domain.measure
    ends = domain.oriented.vertices[domain.oriented.next_vertex]
    around = float(np.hypot(*(ends - domain.oriented.vertices).T).sum())
    demand(abs(total) <= slack * (around + size) / 8, f"areas: {total / domain.measure:.3g} too much")
    # Far ends of faces between generators that are close to each other round by as much more; where three are, as on a
    # circle around an end, by the square.
    a, b = d.vertices[d.face_vertices.reshape(-1, 2)].transpose(1, 0, 2)
    reach, loose = np.zeros(n), slack
    np.maximum.at(reach, owner, np.hypot(*(a - d.points[owner]).T))
    if n > 1:
        near = np.maximum(cKDTree(d.points).query(d.points, k=2)[0][:, 1], 1e-12 * size)
        slack *= max(1.0, 1e-3 * size / near.min())
        loose = np.maximum(slack, loose * 1e-3 * (reach / near) ** 2)
    loose = np.broadcast_to(loose, n)[owner]
    # The same faces from both sides, in the same numbers.
    inner = j >= 0
    demand((j[inner] != owner[inner]).all(), "a cell is its own neighbor")
    pair = np.stack([owner, j], axis=1)[inner]
    here = np.lexsort((d.face_measures[inner], pair[:, 1], pair[:, 0]))
    there = np.lexsort((d.face_measures[inner], pair[:, 0], pair[:, 1]))
    same = np.array_equal(pair[here], pair[there][:, ::-1])
    demand(same, "neighbors are not symmetric")
    if same:
        off = np.abs(d.face_measures[inner][here] - d.face_measures[inner][there])
        demand(
            (off <= 2 * loose[inner][here]).all(),  # both ends may be off
            f"faces differ from both sides by {off.max(initial=0):.3g}",
        )
    # Edges are covered once.
    edges = domain.oriented.places[-1 - j[~inner]]
    demand((edges < len(ends)).all(), "no such edge")
    covered = np.bincount(edges, d.face_measures[~inner], minlength=len(ends))
    off = np.abs(covered - np.hypot(*(ends - domain.oriented.vertices).T))
    demand(off.max() <= 8 * slack, f"faces on edge {off.argmax()}: off by {off.max():.3g}")
    # Faces run from vertex to vertex, in loops, the cell on their left.
    off = np.abs(np.hypot(*(b - a).T) - d.face_measures)
    demand((off <= 2 * loose).all(), f"face measures are not the distance of their ends: {off.max():.3g}")
    off = np.abs((a + b) / 2 - d.face_centroids).max(axis=1)
    demand((off <= loose).all(), f"face centroids: {off.max():.3g}")
    x = d.points[owner]
    cross = (a - x)[:, 0] * (b - x)[:, 1] - (a - x)[:, 1] * (b - x)[:, 0]
    off = np.bincount(owner, cross / 2, minlength=n) - d.volumes
    perimeter = np.bincount(owner, d.face_measures, minlength=n)
    # A part that was cut off may lie far from the generator: here products of such distances round.
    apart = 8 * 2.3e-16 * reach**2
    demand((np.abs(off) <= slack * perimeter + slack**2 + apart).all(), f"volumes: {np.abs(off).max():.3g}")
    moment = np.stack([np.bincount(owner, cross * (a + b - 2 * x)[:, c], minlength=n) for c in (0, 1)])
    with np.errstate(all="ignore"):
        center = (moment / (6 * d.volumes)).T + d.points
        off = np.hypot(*(center - d.centroids).T) - (4 * slack * perimeter + apart) * reach / d.volumes - slack
    demand((off <= 0).all(), f"centroids: {off.max():.3g}")
    _check_loops(d, demand)
    return found


def _check_loops(d, demand) -> None:
    """Rows run along loops: each begins where it ends, and each cell is bounded by one or more."""
    first, last = d.face_vertices.reshape(-1, 2).T
    for i, (a, b) in enumerate(pairwise(d.neighbor_starts.tolist())):
        breaks = np.flatnonzero(last[a : b - 1] != first[a + 1 : b]) + a + 1
        begins, ends = [a, *breaks.tolist()], [*breaks.tolist(), b]
        whole = b > a and all(first[p] == last[q - 1] for p, q in zip(begins, ends, strict=True))
        demand(whole, f"the faces of cell {i} are not in loops")


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
