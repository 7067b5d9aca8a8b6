"""Faces and corners of a diagram on the host: half-faces, loops around cells, each face once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from .diagram import Diagram

if TYPE_CHECKING:
    from ..geometry.boundary_names import Walls


def face_owners(diagram: Diagram) -> np.ndarray:
    """Return the cell of each half-face, (m,) int32."""
    starts = diagram.neighbor_starts
    return np.repeat(np.arange(len(diagram), dtype=np.int32), np.diff(starts))


def boundary_cells(diagram: Diagram, walls: Walls | None) -> np.ndarray:
    """Return the cells with a face on one of `walls`, ascending; see `Diagram.boundary_cells`."""
    chosen = diagram.domain.boundaries.select("boundary", walls)
    return np.unique(face_owners(diagram)[np.isin(-1 - diagram.neighbors, chosen)])


def neighbor_points(diagram: Diagram, faces: np.ndarray) -> np.ndarray:
    """Return the generators, or their images, behind the half-faces `faces` (k,): (k, d).

    Behind a wall it is the mirror image of the cell's own, on a part of a sphere the generator of the removed cell.
    """
    domain, neighbors = diagram.domain, diagram.neighbors[faces]
    found = diagram.points[np.maximum(neighbors, 0)] + diagram.shifts[faces] * domain.extent
    walls = np.flatnonzero(neighbors < 0)
    if walls.size:
        own = diagram.points[face_owners(diagram)[faces[walls]]]
        found[walls] = domain.mirrored(-1 - neighbors[walls], own)
    return found


def plane_shares(diagram: Diagram, faces: np.ndarray) -> np.ndarray:
    """Return where the planes of half-faces cross the lines between their generators, as shares of these lines, (k,).

    1/2 in a Voronoi diagram; for a power diagram see `Domain.plane_shares`. `faces` (k,) are between cells.
    """
    if not diagram.is_power:
        return np.full(len(faces), 0.5)
    i, j = face_owners(diagram)[faces], diagram.neighbors[faces]
    between = neighbor_points(diagram, faces) - diagram.points[i]
    return diagram.domain.plane_shares((between**2).sum(axis=1), diagram.weights[j] - diagram.weights[i])


def face_keys(diagram: Diagram, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return keys of the half-faces `faces` (k,) between two cells, and keys of their opposite half-faces.

    Keys sort by cell, neighbor and shift, and in a polygon, where two cells may share several faces, then by vertices;
    (k,) int64 each.
    """
    n, dim = len(diagram), diagram.domain.dim
    i, j = face_owners(diagram)[faces].astype(np.int64), diagram.neighbors[faces].astype(np.int64)
    here, there = i * n + j, j * n + i
    if any(diagram.domain.periodic):
        codes = (diagram.shifts[faces] + 1) @ 3 ** np.arange(dim)
        here = here * 3**dim + codes
        there = there * 3**dim + (3**dim - 1 - codes)
    if not diagram.domain.cuts_cells:
        return here, there
    begin, end = face_ends(diagram)[faces].T
    columns = [np.concatenate(c) for c in ((end, begin), (begin, end), (here, there))]
    order = np.lexsort(columns)
    new = np.any([np.diff(c[order], prepend=-1) != 0 for c in columns], axis=0)
    numbers = np.empty(len(order), np.int64)
    numbers[order] = np.cumsum(new)
    return numbers[: len(faces)], numbers[len(faces) :]


def face_ends(diagram: Diagram) -> np.ndarray:
    """Return the first and last vertex of each half-face in 2D, (m, 2); its cell is on the left."""
    return diagram.face_vertices.reshape(-1, 2)


def next_faces(diagram: Diagram) -> np.ndarray:
    """Return for each half-face in 2D the next one in its loop around the cell, (m,).

    In the row of a cell one loop follows the other. A loop ends where the next face does not begin in its last vertex.
    """
    ends, starts = face_ends(diagram), diagram.neighbor_starts
    m = len(ends)
    last = np.zeros(m, bool)
    last[starts[1:][starts[1:] > starts[:-1]] - 1] = True
    breaks = last.copy()
    breaks[:-1] |= ends[:-1, 1] != ends[1:, 0]
    places = np.arange(1, m + 1)
    stops = np.flatnonzero(breaks)
    places[stops] = np.concatenate([[0], stops[:-1] + 1])[: len(stops)]
    return places


def following(starts: np.ndarray) -> np.ndarray:
    """Return for each item of ragged rows, taken as loops, the place of the next item of its loop."""
    places = np.arange(1, starts[-1] + 1)
    filled = starts[1:] > starts[:-1]
    places[starts[1:][filled] - 1] = starts[:-1][filled]
    return places


def distinct(values: np.ndarray) -> np.ndarray:
    """Return the different `values`, ascending: `np.unique` by sorting, in a tenth of the time for integers."""
    values = np.sort(values)
    new = np.ones(len(values), bool)
    new[1:] = values[1:] != values[:-1]
    return values[new]


def inverse(starts: np.ndarray, items: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return for each of `size` items the rows of the ragged array `starts` and `items` that have it, also ragged."""
    import scipy.sparse

    rows = scipy.sparse.csc_array((np.ones(len(items), np.int8), items, starts), (size, len(starts) - 1)).tocsr()
    return rows.indptr, rows.indices


def take_rows(
    starts: np.ndarray, items: np.ndarray, rows: np.ndarray, backwards: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the selected `rows` (indices) of the ragged array `starts` and `items`, as starts and items.

    Where `backwards` (bool, one per row) is set, the items of a row are reversed, but the first stays first.
    """
    begin = starts[:-1][rows]
    return take_ranges(begin, starts[1:][rows] - begin, items, backwards)


def take_ranges(
    begin: np.ndarray, counts: np.ndarray, items: np.ndarray, backwards: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of `items`: row i has ``counts[i]`` of them, from ``begin[i]`` on; see `take_rows`."""
    taken = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=taken[1:])
    found = np.empty((taken[-1], *items.shape[1:]), items.dtype)
    for part in slices(len(counts)):
        first, end = int(taken[part.start]), int(taken[part.stop])
        base, many = begin[part], counts[part]
        places = np.repeat(base - taken[part], many)
        places += np.arange(first, end)
        if backwards is not None and backwards[part].any():
            turned = np.repeat(backwards[part], many) & (places > np.repeat(base, many))
            places = np.where(turned, np.repeat(2 * base + many, many) - places, places)
        found[first:end] = items.take(places, axis=0)
    return taken, found


def slices(count: int, size: int = 1 << 14) -> Iterator[slice]:
    """Cut `count` rows into parts whose arrays fit the caches: large arrays cost a system call and cleared memory."""
    return (slice(k, min(k + size, count)) for k in range(0, count, size))


def face_corners(diagram: Diagram) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of each half-face as ragged rows: starts (m + 1,) and vertices.

    In 2D the cell is on the left of the way from the first to the second corner. In 3D the order is counter-clockwise
    as seen from outside of the cell. A repeated corner is given once. A face that then has no measure (fewer than 2
    corners in 2D, 3 in 3D) has an empty row.
    """
    least, starts, corners = diagram.domain.cell_dim, diagram.face_vertex_starts, diagram.face_vertices
    kept = np.empty(len(corners), bool)
    np.not_equal(corners[1:], corners[:-1], out=kept[:-1])
    filled = np.flatnonzero(starts[1:] > starts[:-1])
    last = starts[1:][filled] - 1
    kept[last] = corners[last] != corners[starts[filled]]
    if kept.all() and (np.diff(starts) >= least).all():
        return starts, corners
    rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    counts = np.bincount(rows[kept], minlength=len(starts) - 1)
    counts[counts < least] = 0
    kept &= counts[rows] > 0
    return np.concatenate([[0], np.cumsum(counts)]), corners[kept]


def cell_corners(diagram: Diagram) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of each cell in 2D as ragged rows: starts (n + 1,) and vertices, counter-clockwise.

    A repeated corner is given once. Several loops are joined by bridges, as in the diagram.
    """
    starts, corners = diagram.cell_vertex_starts, diagram.cell_vertices
    cell = np.repeat(np.arange(len(diagram)), np.diff(starts))
    kept = corners != corners[following(starts)]
    counts = np.bincount(cell[kept], minlength=len(diagram))
    return np.concatenate([[0], np.cumsum(counts)]), corners[kept]
