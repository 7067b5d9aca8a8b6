"""Find cells at curved walls that checkMesh takes for concave, and the faces whose collapse mends them."""

from __future__ import annotations

import numpy as np

from ...mesh.connectivity import take_rows
from ...mesh.faces import Faces
from ...mesh.geometry import loop_geometry
from ..defects import DefectLimits, concave_pairs
from ..gate import LEAST_DETERMINANT, rejected_cells

_NARROW = 0.08
"""Faces between two cells smaller than this share of h^2 are collapsed if their cells are concave there."""
_FOLDED = 1e-3
"""Least sine of the angle at which the halves of a wall polygon meet that is split."""


def find_concave(faces: Faces) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of faces of a cell at a wall that are concave: the faces (2, p) and the cell (p,)."""
    at_wall = np.zeros(faces.n_cells, bool)
    at_wall[faces.owner[faces.n_inner :]] = True
    cells, face = faces.sides()
    starts, places = faces.cell_faces()
    kept = at_wall[cells[places]]
    places = places[kept]
    counts = np.diff(starts)[at_wall]
    face, sign = face[places], np.where(places >= len(faces), -1.0, 1.0)
    centers = np.ascontiguousarray(faces.center[face].T)
    areas = np.ascontiguousarray((faces.normal[face] * (faces.area[face] * sign)[:, None]).T)
    rows = np.concatenate([[0], np.cumsum(counts)])
    pairs = concave_pairs(centers, areas, rows, DefectLimits().concavity, np.ones(len(face), bool))
    return face[pairs], np.repeat(np.flatnonzero(at_wall), counts)[pairs[0]]


def narrow_faces(faces: Faces, sizes: np.ndarray) -> np.ndarray:
    """Return the small faces between two cells whose centers lie outside of the plane of another face, (f,) bool.

    At curved walls the chord between two cells may bulge out of both wall polygons. If their common face is small, its
    center does so, too.
    """
    pairs, _ = find_concave(faces)
    chosen = np.zeros(len(faces), bool)
    chosen[pairs.ravel()] = True
    chosen[faces.n_inner :] = False
    h = np.minimum(sizes[faces.owner], sizes[np.maximum(faces.neighbor, 0)])
    return chosen & (faces.area < _NARROW * h**2)


def rejected_at_walls(faces: Faces) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells at walls, or beside these, that OpenFOAM rejects, and whether they are tips, (k,) each.

    A tip has neighbors on one side only.
    """
    k = faces.n_inner
    a, b = faces.owner[:k], faces.neighbor[:k]
    rings = [np.zeros(faces.n_cells, bool)]
    rings[0][faces.owner[k:]] = True
    for _ in range(2):
        ring = rings[-1].copy()
        ring[a[rings[-1][b]]] = ring[b[rings[-1][a]]] = True
        rings.append(ring)
    cells, part = np.flatnonzero(rings[2]), faces.part(rings[2])[0]
    # Faces of other cells are those of the diagram.
    at_wall = rings[0][cells]
    judged = np.flatnonzero(at_wall[part.owner] | (at_wall[np.maximum(part.neighbor, 0)] & (part.neighbor >= 0)))
    rows = np.flatnonzero(rejected_cells(part, judged) & rings[1][cells])
    return cells[rows], part.measures.determinant[rows] < LEAST_DETERMINANT


def split_walls(faces: Faces, cells: np.ndarray) -> Faces:
    """Return the mesh with wall polygons of `cells` (k,) split along a diagonal where this makes the cell convex.

    A polygon that bends around an edge of the solid becomes two that meet there.
    """
    starts, places = faces.cell_faces()
    side_face, k = faces.sides()[1], len(faces)
    centroids = faces.measures.geometry.centroids
    found: dict[int, tuple[list[int], list[int]]] = {}
    for c in cells.tolist():
        mine = places[starts[c] : starts[c + 1]]
        rows, sign = side_face[mine], np.where(mine >= k, -1.0, 1.0)
        centers, normals = faces.center[rows], faces.normal[rows] * sign[:, None]
        for place in np.flatnonzero(faces.neighbor[rows] < 0).tolist():
            loop = faces.corners[faces.starts[rows[place]] : faces.starts[rows[place] + 1]].tolist()
            others = np.arange(len(rows)) != place
            pair = _best_halves(faces.points[loop], centers[others], normals[others], centroids[c])
            if pair is not None:
                a, b = pair
                found[int(rows[place])] = (loop[a : b + 1], loop[b:] + loop[: a + 1])
                break
    if not found:
        return faces
    order = np.sort(np.concatenate([np.arange(k), list(found)]))
    first = np.concatenate([[True], order[1:] != order[:-1]])
    loops = [
        found[r][0 if new else 1] if r in found else faces.corners[faces.starts[r] : faces.starts[r + 1]]
        for r, new in zip(order.tolist(), first.tolist(), strict=True)
    ]
    return faces.take_faces(
        order,
        starts=np.concatenate([[0], np.cumsum([len(loop) for loop in loops])]).astype(np.int64),
        corners=np.concatenate(loops).astype(faces.corners.dtype),
    )


def _best_halves(x: np.ndarray, centers: np.ndarray, normals: np.ndarray, middle: np.ndarray) -> tuple[int, int] | None:
    """Return the ends of the diagonal of a polygon x (n, 3) whose halves fit best into a convex cell, if any does.

    Parameters
    ----------
    centers, normals : (f, 3) float
        Of the other faces of the cell, outward.
    middle : (3,) float
        Of the cell.
    """
    best, found = -_FOLDED, None
    for a in range(len(x)):
        for b in range(a + 2, len(x) - (a == 0)):
            halves = [x[a : b + 1], np.concatenate([x[b:], x[: a + 1]])]
            c, s = centers, normals
            sound = True
            for half in halves:
                center, area = (v[:, 0] for v in loop_geometry(np.ascontiguousarray(half.T), np.array([0, len(half)])))
                size = np.linalg.norm(area)
                after = np.roll(half, -1, axis=0)
                high = np.cross(half - center, after - center) @ (center - middle)
                sound &= bool(size > 0 and (high > 0).all())
                c, s = np.vstack([c, center]), np.vstack([s, area / max(size, 1e-300)])
            if not sound:
                continue
            apart = c[None] - c[:, None]
            cosine = np.einsum("ijk,ik->ij", apart, s) / np.maximum(np.linalg.norm(apart, axis=2), 1e-300)
            np.fill_diagonal(cosine, -1)
            if cosine.max() < best:
                best, found = float(cosine.max()), (a, b)
    return found


def without_cells(faces: Faces, cells: np.ndarray) -> Faces:
    """Return the mesh without some small cells (k,) at walls: their faces to others become walls in their place."""
    k = faces.n_inner
    gone = np.zeros(faces.n_cells, bool)
    gone[cells] = True
    wall = np.full(faces.n_cells, -1)
    by_area = k + np.argsort(faces.area[k:], kind="stable")
    wall[faces.owner[by_area]] = faces.neighbor[by_area]
    one, other = gone[faces.owner], gone[np.maximum(faces.neighbor, 0)] & (faces.neighbor >= 0)
    rows = np.flatnonzero(~(one & (other | (faces.neighbor < 0))))
    turned = one[rows]
    own, there = faces.owner[rows], faces.neighbor[rows]
    owner = np.where(turned, there, own)
    neighbor = np.where(turned | other[rows], wall[np.where(turned, own, np.maximum(there, 0))], there)
    number = np.cumsum(~gone) - 1
    owner, inner = number[owner], neighbor >= 0
    neighbor = np.where(inner, number[np.maximum(neighbor, 0)], neighbor)
    order = np.lexsort((np.where(inner, neighbor, owner), np.where(inner, owner, -neighbor), ~inner))
    starts, corners = take_rows(faces.starts, faces.corners, rows[order], turned[order])
    return faces.take_faces(
        rows[order],
        generators=faces.generators[~gone],
        owner=owner[order].astype(np.int32),
        neighbor=neighbor[order].astype(np.int32),
        starts=starts,
        corners=corners,
    ).compact()
