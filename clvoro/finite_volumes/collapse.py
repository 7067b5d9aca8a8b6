"""Collapse short edges and small faces of 3D meshes."""

from __future__ import annotations

import numpy as np

from ..connectivity import components, distinct, following, rows_of, slices, starts_of, take_ranges, take_rows
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.geometry import cross_columns, dots, lengths, smaller_size, sum_columns
from .defects import SMALL_FACE, DefectLimits
from .merging import Merges, MergingCells
from .seams import pack

SHORT_EDGE = 0.02
"""Edges shorter than this share of h, the cube root of a cell's volume, are collapsed."""
SKEWED = 1.8
"""Faces of a greater skewness are collapsed, if they are small."""
_SKEWED_FACE = 2e-2
"""How small, as a share of h^2."""
_WIDEST = 0.15
"""Most extent of vertices that become one, as a share of h."""
_LONGEST = 0.25
"""Longest edge that is collapsed, if it is the shortest of a small face."""
LIMITS = (DefectLimits(), DefectLimits(non_orthogonality=20), DefectLimits(non_orthogonality=40, skewness=3))
"""Tried in turn, the later ones where short edges or small faces are left."""
_CHUNK = 1 << 12
"""Faces that are read at a time: their arrays fit the caches."""
_SURE = 1.05
"""Margin of the suspects: areas of the diagram differ a little from those of the mesh."""


def collapse_short(
    mesh: Faces,
    diagram: Diagram | None,
    unwanted: np.ndarray | None = None,
    chosen: np.ndarray | None = None,
    suspects: np.ndarray | None = None,
) -> Faces:
    """Return `mesh` without edges shorter than 0.02 h and faces smaller than 0.001 h^2, where its cells stay valid.

    Faces smaller than 0.02 h^2 whose skewness exceeds 1.8 are collapsed, too.

    The ends of an edge, or the corners of a face, become one point: their mean, or one of them. Points on walls, edges
    and corners of the box stay on them, and images of a point move together. The cells therefore still fill the domain.
    Faces that lose their area vanish, and their cells are no longer neighbors. An edge or face is left as it is if
    otherwise a face would be warped or a cell concave; see `DefectLimits`.

    - `mesh`: of the diagram, in 3D.
    - `diagram`: what measures come from; None if they follow from the corners.
    - `unwanted` (f,) bool: faces that are collapsed whatever their size.
    - `chosen` (f,) bool: faces whose corners may move; all by default.
    - `suspects` (f,) bool: what `find_suspects` returns; by default it is called.
    """
    if suspects is None:
        suspects = find_suspects(mesh, diagram, chosen)
    elif chosen is not None:
        suspects = suspects & chosen
    if unwanted is not None:
        suspects = suspects | unwanted
    if not suspects.any():
        return mesh.compact()
    cells, faces = _fold(mesh, diagram)
    if unwanted is not None:
        cells.unwanted = unwanted[faces]
    scan = _Scan(cells, np.flatnonzero(suspects[faces]))
    cells.prepare(scan.vertices)
    for cells.limits in LIMITS:
        pending = active = scan.flagged
        while len(active):
            cells.touched[:], cells.changed[:] = False, False
            for kind in (_Scan.clusters, _Scan.small_faces, _Scan.slivers, _Scan.edges):
                if cells.merge(kind(scan)):
                    scan = _Scan(cells, active)
            # Where nothing has changed, another try is in vain.
            again = cells.changed.copy()
            again[pending] |= cells.is_touched(pending)
            if chosen is not None:
                again &= chosen[faces]
            scan = _Scan(cells, np.flatnonzero(again))
            active = scan.flagged
            pending = distinct(np.concatenate([pending, active]))
        scan = _Scan(cells, pending)
    unchanged = (cells.now == np.arange(len(cells.now))).all()
    return mesh.compact() if unchanged else _unfold(mesh, cells, faces)


def find_suspects(mesh: Faces, diagram: Diagram | None, chosen: np.ndarray | None = None) -> np.ndarray:
    """Return which faces may be small or skew, or have a short side, (f,) bool. A few may have none of these.

    All faces, or those that are `chosen` (f,) bool, are read here, and never again. Their areas are those of the
    diagram, if there is one.
    """
    rows = np.arange(len(mesh)) if chosen is None else np.flatnonzero(chosen)
    volumes, areas = (mesh.volumes, mesh.area) if diagram is None else (diagram.volumes, diagram.face_measures)
    h = smaller_size(mesh.owner[rows], mesh.neighbor[rows], np.cbrt(volumes))
    small = areas[rows if diagram is None else mesh.half_face[rows]] < _SURE * _SKEWED_FACE * h**2
    limit, (x, *others) = (_SURE * SHORT_EDGE * h) ** 2, np.ascontiguousarray(mesh.points.T)
    for part in slices(len(rows), _CHUNK):
        starts, begin = take_rows(mesh.starts, mesh.corners, rows[part])
        head, last = starts[:-1], starts[1:] - 1
        end, step, here = np.empty_like(begin), np.empty(len(begin)), x.take(begin)
        end[:-1], end[last] = begin[1:], begin[head]
        np.subtract(here[1:], here[:-1], out=step[:-1])
        step[last] = here[head] - here[last]
        step *= step
        limits, most = limit[part], limit[part].max()
        # Few sides are short along the first axis: the other axes are read for these.
        near = np.flatnonzero(step < most)
        begin, end, squares = begin[near], end[near], step[near]
        for y in others:
            squares += (y.take(end) - y.take(begin)) ** 2
        near, squares = near[squares < most], squares[squares < most]
        at = np.searchsorted(starts, near, "right") - 1
        small[part.start + at[squares < limits[at]]] = True
    found = np.zeros(len(mesh), bool)
    found[rows[small]] = True
    return found


def _fold(mesh: Faces, diagram: Diagram | None) -> tuple[MergingCells, np.ndarray]:
    """Return the cells of `mesh` with faces at seams and images of points once; the faces of `mesh` that they have."""
    upper = np.flatnonzero((mesh.twin < 0) | (mesh.twin > np.arange(len(mesh.twin))))
    points, extent = mesh.points, np.asarray(mesh.domain.extent, float)
    if len(upper) < len(mesh.owner):
        starts, corners = take_rows(mesh.starts, mesh.corners, upper)
        _, first, classes = np.unique(mesh.images, return_index=True, return_inverse=True)
        away = np.where(mesh.domain.periodic, (points - points[first[classes]]) / extent, 0)
        codes, face_codes = pack(np.rint(away))[corners], pack(mesh.shift[upper])
        points, corners = points[first], classes[corners].astype(np.int32)
    else:
        starts, corners = mesh.starts, mesh.corners
        codes, face_codes = (np.broadcast_to(0, len(of)) for of in (corners, upper))
    cells = MergingCells(
        mesh, diagram, points, starts, corners, codes, mesh.owner[upper], mesh.neighbor[upper], face_codes, upper
    )
    on = np.flatnonzero(cells.walls)
    here = cells.points[on]
    cells.points[on] = mesh.domain.onto_walls(here, here, cells.walls[on], cells.wall_sets)
    return cells, upper


def _unfold(mesh: Faces, cells: MergingCells, upper: np.ndarray) -> Faces:
    """Return `mesh` as `cells` have become."""
    alive = cells.count > 0
    kept = np.zeros(len(mesh.owner), bool)
    kept[upper] = alive
    seam = upper[mesh.twin[upper] >= 0]
    kept[mesh.twin[seam]] = kept[seam]
    left, points = np.flatnonzero(kept), cells.points
    if len(seam):
        # The lower face at a seam has the corners of the upper one in opposite order.
        place = np.full(len(mesh.owner), -1)
        place[upper] = np.arange(len(upper))
        lower = place[left] < 0
        source = place[np.where(lower, mesh.twin[left], left)]
        starts, where = take_ranges(cells.begin[source], cells.count[source], np.arange(len(cells.corners)), lower)
        shift = np.repeat(np.where(lower, cells.face_codes[source], 0), np.diff(starts))
        vertices, codes = cells.corners[where], cells.codes[where] - shift
        order = np.lexsort((codes, vertices))
        new = np.ones(len(order), bool)
        new[1:] = (np.diff(vertices[order]) != 0) | (np.diff(codes[order]) != 0)
        corners = np.empty_like(vertices)
        corners[order] = np.cumsum(new) - 1
        points = cells.positions(vertices[order][new], codes[order][new]).T
    else:
        starts, corners = take_ranges(cells.begin[left], cells.count[left], cells.corners)
    made = mesh.take_faces(left, points=points, starts=starts, corners=corners).compact()
    if not len(seam):
        made.take_vectors(mesh, left, cells.edited[left])
    return made


class _Scan:
    """The sides of some faces, from one corner to the next, and which are short; which of the faces are small.

    - `faces`: (f,) int
    - `starts` (f + 1,) int: rows of the sides of each face.
    - `begin`, `end` (k,) int: vertices.
    - `code` (k,) int: packed offset of the end from the beginning.
    - `length`, `h`: (k,) float
    - `small` (f,) bool: skewed faces count as small.
    """

    def __init__(self, cells: MergingCells, faces: np.ndarray) -> None:
        self.cells, self.faces = cells, faces[cells.count[faces] > 0]
        self.starts, places = cells.face_corners(self.faces)
        face = rows_of(self.starts)
        x = cells.positions(cells.corners[places], cells.codes[places])
        after = following(self.starts)
        h = smaller_size(cells.owner[self.faces], cells.neighbor[self.faces], cells.sizes)
        self.begin = cells.corners[places].astype(np.int64)
        self.end = self.begin[after]
        self.code = cells.codes[places][after] - cells.codes[places]
        self.length, self.h = lengths(x.take(after, axis=1) - x), h[face]
        self.short = self.length < SHORT_EDGE * self.h
        away = x - x.take(self.starts[face], axis=1)
        twice = sum_columns(face, cross_columns(away, away.take(after, axis=1)), len(self.faces))
        area = lengths(twice) / 2
        self.small = area < SMALL_FACE * h**2
        rows = ~self.small & (area < _SKEWED_FACE * h**2) & (cells.neighbor[self.faces] >= 0)
        self.small[rows] = self._skewness(np.flatnonzero(rows), x, twice) > SKEWED
        self.small |= cells.unwanted[self.faces]

    @property
    def flagged(self) -> np.ndarray:
        """Those of the faces that are small or have a short side."""
        found = self.small.copy()
        found[np.searchsorted(self.starts, np.flatnonzero(self.short), "right") - 1] = True
        return self.faces[found]

    @property
    def vertices(self) -> np.ndarray:
        """The ends of short sides, and the corners of small faces."""
        wanted = np.repeat(self.small, np.diff(self.starts)) | self.short
        return distinct(np.concatenate([self.begin[wanted], self.end[self.short]]))

    def _skewness(self, rows: np.ndarray, x: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the approximate skewness of some of the faces, all between two cells."""
        c, faces = self.cells, self.faces[rows]
        starts, places = take_rows(self.starts, np.arange(x.shape[1]), rows)
        face = rows_of(starts)
        x, n = x.take(places, axis=1), normals[:, rows]
        center = sum_columns(face, x, len(rows)) / np.diff(starts)
        own, other = c.centroids[c.owner[faces]].T, c.centroids[c.neighbor[faces]].T
        line, arm = other + c.offsets(c.face_codes[faces]) - own, center - own
        off = arm - dots(n, arm) / dots(n, line) * line
        size = np.maximum(lengths(off), 1e-300)
        along = dots(x - center.take(face, axis=1), (off / size).take(face, axis=1))
        reach = 0.2 * lengths(line)
        np.maximum.at(reach, face, np.abs(along))
        return size / reach

    def clusters(self) -> Merges:
        """Return the vertices that short sides connect."""
        i, j = self.begin[self.short], self.end[self.short]
        vertices, local = np.unique(np.concatenate([i, j]), return_inverse=True)
        i, j = local.reshape(2, -1)
        k, label = components(len(vertices), i, j)
        h = np.full(k, np.inf)
        np.minimum.at(h, label[i], self.h[self.short])
        order = np.argsort(label, kind="stable")
        starts = starts_of(np.bincount(label, minlength=k))
        return self._sets(starts, vertices[order], h)

    def small_faces(self) -> Merges:
        """Return the corners of small faces."""
        rows = np.flatnonzero(self.small)
        starts, places = take_rows(self.starts, np.arange(len(self.begin)), rows)
        return self._sets(starts, self.begin[places], self.h[self.starts[rows]])

    def edges(self) -> Merges:
        """Return the ends of short sides, and of the shortest side of each small face."""
        wanted = self.short & (self.begin != self.end)
        rows = np.flatnonzero(self.small)
        if len(rows):
            face = rows_of(self.starts)
            order = np.lexsort((self.length, face))
            wanted[order[self.starts[rows]]] = True
        i, j = self.begin[wanted], self.end[wanted]
        i, j = np.minimum(i, j), np.maximum(i, j)
        _, first = np.unique(i * len(self.cells.points) + j, return_index=True)
        pairs = np.stack([i[first], j[first]], axis=1)
        starts = 2 * np.arange(len(pairs) + 1)
        return self._sets(starts, pairs.ravel(), self.h[wanted][first], widest=_LONGEST)

    def slivers(self) -> Merges:
        """Return the ends of the short sides of faces that vanish if all of them become points."""
        face = rows_of(self.starts)
        left = np.diff(self.starts) - np.bincount(face[self.short], minlength=len(self.faces))
        several = np.diff(self.starts) - left > 1
        rows = np.flatnonzero(self.short & ((left < 3) & several)[face])
        i, j, set_of = self.begin[rows], self.end[rows], face[rows]
        apart = np.ones(len(rows), bool)  # sides that begin where another one ends are clusters
        apart[np.isin(set_of * len(self.cells.points) + i, set_of * len(self.cells.points) + j)] = False
        good = np.bincount(set_of[~apart], minlength=len(self.faces)) == 0
        rows, pairs = rows[good[set_of]], np.stack([i, j], axis=1)[good[set_of]]
        sets = np.unique(face[rows], return_inverse=True)[1]
        return self._sets(2 * np.arange(len(rows) + 1), pairs.ravel(), self.h[rows], sets)

    def _sets(
        self,
        starts: np.ndarray,
        vertices: np.ndarray,
        h: np.ndarray,
        sets: np.ndarray | None = None,
        widest: float = _WIDEST,
    ) -> Merges:
        """Return those groups of vertices that are close together; each is a set, or has its place in `sets`."""
        g = len(starts) - 1
        sets = np.arange(g) if sets is None else sets
        group = rows_of(starts)
        x = self.cells.points[vertices]
        away = x - x[starts[:-1]][group]
        steps = np.rint(away / self.cells.extent)
        away -= steps * self.cells.extent
        width = np.zeros(g)
        np.maximum.at(width, group, lengths(away.T))
        k = int(sets.max(initial=-1)) + 1
        extent, size = np.zeros(k), np.full(k, np.inf)
        np.maximum.at(extent, sets, width)
        np.minimum.at(size, sets, h)
        reach = 1.2 * np.maximum(extent, SHORT_EDGE * size)
        merges = Merges(starts, vertices, -pack(steps), sets, extent / np.maximum(size, 1e-300), reach)
        return merges.take(np.flatnonzero(extent <= widest * size))
