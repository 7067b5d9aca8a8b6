"""Cells rebuilt from the arrays of a diagram: in boxes and polygons, and on spheres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import shapely

from ...connectivity import following, rows_of
from ...geometry.sphere import Sphere, arc_excess, triangle_areas
from ..diagram import Diagram
from ..geometry import sum_rows
from .findings import ROUNDINGS, Check


def rebuild_on_sphere(diagram: Diagram) -> dict[str, np.ndarray]:
    """Return the arrays of a diagram on a sphere that follow from its corners: arcs, their middles, and centroids.

    The integral of the position over a cell of the unit sphere is half the sum over its edges, from v to w, of
    arc n, with n the unit vector along v x w (Gauss). The centroid has its direction; that of an empty cell is the
    generator.
    """
    sphere = diagram.domain
    radius, owner = sphere.frame[1], diagram.half_faces.owner
    points, vertices = (sphere.wrap(x) / radius for x in (diagram.points, diagram.vertices))
    v, w = (vertices[ends] for ends in diagram.half_faces.ends.T)
    a, b = (_relative(x, points[owner]) for x in (v, w))
    cross = np.cross(v, w)
    # Of the vectors v x w the parts with the generator add up to zero. Without them small cells lose no digits.
    sines, cosines = np.linalg.norm(cross, axis=1), (v * w).sum(axis=1)
    terms = np.cross(a, b) + arc_excess(sines, cosines)[:, None] * cross
    integrals = np.column_stack([np.bincount(owner, t, len(diagram)) for t in terms.T])
    empty = np.diff(diagram.neighbor_starts) == 0
    integrals[empty] = points[empty]
    return {
        "face_measures": radius * np.arctan2(sines, cosines),
        "face_centroids": sphere.wrap(v + w),
        "centroids": sphere.wrap(integrals),
    }


def bisector_corners(starts: np.ndarray, normals: np.ndarray, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the bisectors of each cell cross those before them, in the tangent plane at the generator.

    - `starts` (n + 1,) int: rows of the cells.
    - `normals`, `levels` (m, 2), (m,) float64: the lines n.p = level.

    Results:
    - `corners` (m, 2) float64: not finite where lines are parallel.
    - `sines` (m,) float64: of the angles from the normals before to the normals.
    """
    before = np.argsort(following(starts))
    one, other = normals[before], normals
    cross = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    with np.errstate(all="ignore"):
        x = (levels[before] * other[:, 1] - levels * one[:, 1]) / cross
        y = (levels * one[:, 0] - levels[before] * other[:, 0]) / cross
        lengths = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
        return np.column_stack([x, y]), cross / lengths


def _relative(x: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return x - origin for unit vectors, with the radial part -|x - origin|^2 / 2, which the difference rounds."""
    d = x - origin
    return d - ((d * origin).sum(axis=1) + (d * d).sum(axis=1) / 2)[:, None] * origin


ADOPTED = 1024
"""Distance of a face from the bisector of its generators, in units of round-off, up to which it is part of it."""


@dataclass(frozen=True)
class Doubts:
    """Bounds of the round-off in the numbers of a diagram."""

    measures: np.ndarray
    middles: np.ndarray
    """`measures`, `middles`: (m,) float. Bounds for the measures and the centroids of faces."""
    volumes: np.ndarray
    """(n,) float."""


class Rebuilt:
    """The cells of a diagram, computed from generators, corners and the graph alone.

    - `owner` (m,) int: cell of each face.
    - `areas` (m, d) float: outward normal of each face times its measure.
    - `middles` (m, d) float: centroids of the faces.
    - `perimeters` (n,) float: sum of the faces' measures (surface in 3D).
    - `volumes`, `centroids`: (n,) and (n, d) float
    - `cells`, `corners` (k,) int: every corner of every cell: the cell and the vertex.
    - `unit`: round-off of a position.
    - `unit_of_cell` (n,) float: round-off of a corner relative to its generator.
    - `period_off`: round-off of the periods of a periodic box, together; see `Box`.
    - `remade`: whether the diagram's own measures of faces come from its corners, too, so that their round-off is that
      of positions.
    """

    edges: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    """In 3D each edge of each face: the face, and the vertices from which and to which it runs; (k,) each."""
    directions: np.ndarray
    """(m, d): unit vectors from the generator to that of the neighbor or to the wall; normals of adopted faces."""
    adopted: np.ndarray
    """(m,) bool: faces in a polygon that are not on the bisector of their generators, since the boundary has cut off a
    part of a cell there, which another cell has adopted."""

    def __init__(self, d: Diagram, dtype: object = None, real: np.dtype | None = None) -> None:
        n = len(d)
        self.real = find_precision(d, dtype) if real is None else real
        eps, fine = float(np.finfo(self.real).eps), np.finfo(float).eps
        far, size = self._extent(d)
        # The host adds the origin in float64.
        self.unit = eps * size + fine * far
        self.owner = rows_of(d.neighbor_starts)
        self._set_cells(d)
        self.perimeters = np.bincount(self.owner, self.measures, minlength=n)
        self._distances = np.linalg.norm(d.vertices[self.corners] - d.points[self.cells], axis=1)
        self.reach = np.zeros(n)
        np.maximum.at(self.reach, self.cells, self._distances)
        self._vertex_count = len(d.vertices)
        self.unit_of_cell = eps * self.reach + fine * far
        self.period_off = eps * d.domain.frame[1] * d.domain.dim**0.5 / 2
        given = getattr(d, "face_measures", None)
        self.remade = given is not None and np.array_equal(given, self.measures)

    def _extent(self, d: Diagram) -> tuple[float, float]:
        """Return the distance of the domain from 0, and its size."""
        return max(map(abs, (*d.domain.lower, *d.domain.upper))), float(np.linalg.norm(d.domain.extent))

    def _set_cells(self, d: Diagram) -> None:
        """Set faces, corners, volumes and centroids."""
        dim, n = d.domain.dim, len(d)
        self.directions, self.spacings = _across(d, self.owner)
        {2: self._set_polygons, 3: self._set_polyhedra}[dim](d)
        self.measures = np.linalg.norm(self.areas, axis=1)
        self._find_adopted(d)
        # The cell as the sum of the cones from its generator to its faces.
        cones = np.einsum("ij,ij->i", self.areas, self.middles) / dim
        self.volumes = np.bincount(self.owner, cones, minlength=n)
        share = dim / (dim + 1)
        moments = sum_rows(self.owner, (cones * share)[:, None] * self.middles, n)
        self.centroids = moments / np.where(self.volumes > 0, self.volumes, 1)[:, None]

    def _set_polygons(self, d: Diagram) -> None:
        """Set areas and middles of faces, and the corners of cells, in 2D."""
        at = d.points[self.owner]  # relative to it, small cells far from the origin keep their digits
        first, last = d.half_faces.ends.T
        a, b = d.vertices[first] - at, d.vertices[last] - at
        edge = b - a
        self.areas = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        self.middles = (a + b) / 2
        self.cells, self.corners = self.owner, first
        self._on_wall = d.neighbors < 0
        self._following = d.half_faces.next

    def _set_polyhedra(self, d: Diagram) -> None:
        """Set areas and middles of faces, and the corners and edges of cells, in 3D."""
        at, x = d.points[self.owner], d.vertices
        face = rows_of(d.face_vertex_starts)
        first = d.face_vertex_starts[:-1][face]
        after = following(d.face_vertex_starts)
        a = x[d.face_vertices] - at[face]
        b = x[d.face_vertices[after]] - at[face]
        o = x[d.face_vertices[first]] - at[face]
        triangle = np.cross(a - o, b - o) / 2
        m = len(self.owner)
        self.areas = sum_rows(face, triangle, m)
        total = np.linalg.norm(self.areas, axis=1)
        normal = self.areas / np.where(total > 0, total, 1)[:, None]
        weight = np.einsum("ij,ij->i", triangle, normal[face])
        moment = weight[:, None] * (a + b + o) / 3
        sums = sum_rows(face, moment, m)
        self.middles = np.where((total > 0)[:, None], sums / np.where(total > 0, total, 1)[:, None], 0.0)
        self.cells, self.corners = self.owner[face], d.face_vertices
        self.edges = (face, d.face_vertices, d.face_vertices[after])
        self._tails, self._edge, self._before = a, b - a, np.argsort(after)

    def _find_adopted(self, d: Diagram) -> None:
        """Set `adopted`, and the directions of adopted faces."""
        self.adopted = np.zeros(len(self.owner), bool)
        if d.domain.outline is None:
            return
        inner = d.neighbors >= 0
        across = np.where(inner, self.spacings, 0.0)
        # Both ends decide: the middle of an adopted face may lie on the bisector by chance.
        half = np.stack([-self.areas[:, 1], self.areas[:, 0]], axis=1) / 2
        ends = [self.middles - half, self.middles + half]
        off = np.max([np.abs((end * self.directions).sum(axis=1) - across / 2) for end in ends], axis=0)
        far = np.max([np.linalg.norm(end, axis=1) for end in ends], axis=0)
        # At smaller distances the quotient would overflow.
        least = np.maximum(1e-200 * far, np.finfo(float).tiny)
        noise = ADOPTED * self.unit * (1 + far / np.maximum(across, least))
        self.adopted = inner & (off > noise) & (self.measures > 0)
        # An adopted face can lie on the bisector, too, if each cell has adopted a part of the other's region. Then
        # another generator is nearer there, or neither of the two sees the face.
        inward = np.flatnonzero(inner & ~self.adopted & ((self.areas * self.directions).sum(axis=1) < 0))
        if inward.size:
            own = d.points[self.owner[inward]]
            places = own + self.middles[inward]
            away = np.linalg.norm(self.middles[inward], axis=1)
            nearest = scipy.spatial.KDTree(d.points).query(places)[0]
            ways = shapely.linestrings(np.stack([own, places], axis=1))
            hidden = ~shapely.covers(d.domain.outline.geometry, ways)
            self.adopted[inward[hidden | (nearest < away - noise[inward] / 16)]] = True
        normals = self.areas / np.maximum(self.measures, 1e-300)[:, None]
        self.directions[self.adopted] = normals[self.adopted]

    def are_slits(self, places: np.ndarray, slack: float) -> np.ndarray:
        """Return which open edges of cells in 3D, (k,) bool, border slits as narrow as round-off.

        Where faces end in the middle of an edge, within round-off, one face may have a vertex there that the other
        lacks. The middle of such an edge lies on another open edge of the cell; at a missing face it does not. The
        tolerance is that of bisectors (see `doubts`) for a tolerance `slack` of positions.
        """
        assert self.edges is not None
        spacings = self.spacings[self.edges[0][places]]
        width = slack * (1 + np.linalg.norm(self._tails[places], axis=1) / spacings)
        result = np.zeros(len(places), bool)
        ends, cells = self._tails[places] + self._edge[places], self.cells[places]
        order = np.argsort(cells, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(cells[order])) + 1):
            a, edge = self._tails[places[rows]], self._edge[places[rows]]
            square = np.maximum((edge**2).sum(axis=1), 1e-300)
            for row in rows:
                middle = (self._tails[places[row]] + ends[row]) / 2
                t = np.clip(((middle - a) * edge).sum(axis=1) / square, 0, 1)
                off = np.linalg.norm(a + t[:, None] * edge - middle, axis=1)
                off[rows == row] = np.sqrt(square[rows == row]) / 2
                result[row] = (off <= np.maximum(width[row], width[rows])).any()
        return result

    def doubts(self, slack: float | np.ndarray) -> Doubts:
        """Return bounds of the round-off, for positions with the tolerance `slack`: one number or one per cell (n,).

        The bisector of two generators at the distance d has the error e = ``slack (1 + r / d)`` at the distance r: the
        error of its direction grows as the generators approach each other. A corner is the intersection of bisectors,
        and its error is larger the more parallel they are: with unit normals n it lies within the ellipsoid of
        ``C = (sum n n^T / e^2)^-1``, but not beyond the cell. A number that depends on corners has the error
        sqrt(g^T C g) from each corner, with the gradient g.
        """
        doubts = self._doubts_2d if self.directions.shape[1] == 2 else self._doubts_3d
        return doubts(np.broadcast_to(slack, self.reach.shape))

    def _doubts_2d(self, per_cell: np.ndarray) -> Doubts:
        slack = per_cell[self.cells]
        here = np.arange(len(self.corners))
        before = np.argsort(self._following)  # corner k lies between the faces before[k] and k
        one, two = (1 + self._distances / self.spacings[f] for f in (before, here))
        a, b = self.directions[before], self.directions[here]
        sine = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        with np.errstate(all="ignore"):
            off = slack * np.hypot(one, two) / sine
        off = np.where(off < self.reach[self.cells], off, self.reach[self.cells])
        of_domain = self._on_wall[before] & self._on_wall[here]
        off[of_domain] = slack[of_domain]
        # A vertex is the corner of several cells, and any of them may have placed it.
        worst = np.zeros(self._vertex_count)
        np.maximum.at(worst, self.corners, np.maximum(off, slack))
        off = worst[self.corners]
        ends = np.maximum(off, off[self._following])
        swept = np.bincount(self.owner, ends * self.measures, len(self.reach))
        return Doubts(ends, ends, swept + per_cell**2)

    def _doubts_3d(self, per_cell: np.ndarray) -> Doubts:
        assert self.edges is not None
        face, key = self.edges[0], self.cells.astype(np.int64) * self._vertex_count + self.corners
        _, first, group = np.unique(key, return_index=True, return_inverse=True)
        k, cells = len(first), self.cells[first]
        slack, reach = per_cell[cells], self.reach[cells]
        e = 1 + self._distances[first][group] / self.spacings[face]
        normal = self.directions[face] / e[:, None]
        m = np.empty((k, 3, 3))
        for i in range(3):
            for j in range(i, 3):
                m[:, i, j] = m[:, j, i] = np.bincount(group, normal[:, i] * normal[:, j], k)
        values, axes = np.linalg.eigh(m)
        # An eigenvalue below round-off counts as 0: along this axis the corner may be anywhere in the cell.
        sure = values > 16 * np.finfo(float).eps * values[:, -1:]
        off = slack[:, None] / np.sqrt(np.where(sure, values, 1.0))
        off = np.where(sure & (off < reach[:, None]), off, np.maximum(reach, slack)[:, None])
        # A vertex has the position of its most accurate corner.
        best = np.full(self._vertex_count, np.inf)
        np.minimum.at(best, self.corners[first], off.max(axis=1))
        placed = np.maximum(best[self.corners[first]], slack)

        def change(gradient: np.ndarray, which: np.ndarray) -> np.ndarray:
            along = np.einsum("kij,ki->kj", axes[which], gradient) * off[which]
            return np.linalg.norm(along, axis=1) + placed[which] * np.linalg.norm(gradient, axis=1)

        preceding, ahead = -self._edge[self._before], self._edge
        rim = np.cross(ahead - preceding, self.directions[face]) / 2
        faces = np.bincount(face, change(rim, group), len(self.owner))
        ears = np.cross(ahead, preceding) / 6
        cone = sum_rows(group, ears, k)
        cell = np.bincount(cells, change(cone, np.arange(k)), len(self.reach))
        widths = self.reach[self.owner]
        spread = faces * 2 * widths / np.maximum(self.measures, 1e-300)
        own = per_cell[self.owner]
        return Doubts(faces + own * widths, own + spread, cell + per_cell * self.perimeters)


def _across(d: Diagram, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vector across each face, outward, and the distance of its generators (infinite at a wall)."""
    inner, walls = np.flatnonzero(d.neighbors >= 0), np.flatnonzero(d.neighbors < 0)
    across = np.zeros((len(owner), d.domain.dim))
    across[inner] = d.half_faces.behind(inner) - d.points[owner[inner]]
    across[walls] = d.domain.toward_walls(-1 - d.neighbors[walls], d.points[owner[walls]])[0]
    distance = np.maximum(np.linalg.norm(across, axis=1), 1e-300)
    spacing = distance.copy()
    spacing[walls] = np.inf
    return across / distance[:, None], spacing


def find_precision(d: Diagram, dtype: object = None) -> np.dtype:
    """Return the precision in which `d` was computed; if `dtype` is ``"float64"``, it is not float32.

    In float32, volumes and generators or lengths are float32 numbers in the device's unit. The unit is a power of two,
    or the radius of a sphere, with which products are rounded.
    """
    origin, scale = d.domain.frame
    cell_dim = d.domain.cell_dim
    volumes = d.volumes / scale**cell_dim
    points = (d.points - origin) / scale
    lengths = getattr(d, "face_measures", points) / scale ** (cell_dim - 1)
    # Adding and subtracting the origin has round-off. Some generators were moved onto a wall or into a polygon on the
    # host: if a quarter are float32 numbers, all were.
    fine = np.finfo(float).eps
    rounded = 0.0 if np.frexp(scale)[0] == 0.5 else 4 * fine
    noise = 4 * fine * np.maximum(np.abs(np.array(origin)) / scale, 1)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(points - points.astype(np.float32))
        single, short = (
            bool((np.abs(x - x.astype(np.float32)) <= rounded * np.abs(x)).all()) for x in (volumes, lengths)
        )
    single &= (short or bool((off <= noise).mean() >= 0.25)) and dtype != "float64"
    return np.dtype(np.float32 if single else np.float64)


def rebuild(diagram: Diagram) -> dict[str, np.ndarray]:
    """Return the arrays of a diagram that follow from its corners: measures and centroids of faces, centroids."""
    with np.errstate(all="ignore"):  # the check reports numbers that are not finite
        g = Rebuilt(diagram)
        warped = diagram.has_moved_vertices  # then faces are not plane
        centroids = diagram.faces.measures.geometry.centroids if warped else g.centroids + diagram.points
    return {"face_measures": g.measures, "face_centroids": g.middles + diagram.points[g.owner], "centroids": centroids}


RADIUS_ROUNDINGS = 16
"""Tolerance of the radius of positions, in units of the round-off of a number: a few operations with vectors."""


class SphereCells(Rebuilt):
    """The cells of a diagram on a sphere, computed from generators, corners and the graph alone.

    Attributes are those of `Rebuilt`: measures are arcs and volumes are areas on the sphere; `areas` and `directions`
    have two coordinates, along the tangents at the cell's generator.
    """

    def _extent(self, d: Diagram) -> tuple[float, float]:
        return d.domain.frame[1], 2 * d.domain.frame[1]

    def _set_cells(self, d: Diagram) -> None:
        sphere = d.domain.globe
        assert sphere is not None
        first, last = d.half_faces.ends.T
        self.cells, self.corners = self.owner, first
        self._set_directions(d, sphere)
        at, x = d.points[self.owner], d.vertices
        edge = self._along_tangents(x[last] - x[first])
        self.areas = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        arrays = rebuild_on_sphere(d)
        self.measures = arrays["face_measures"]
        self.middles = arrays["face_centroids"] - at
        self.centroids = arrays["centroids"] - d.points
        corners = [sphere.wrap(y) / sphere.radius for y in (at, x[first], x[last])]
        self.volumes = np.bincount(self.owner, sphere.radius**2 * triangle_areas(*corners), len(d))
        self.adopted = self._on_wall = np.zeros(len(self.owner), bool)
        self._following = following(d.neighbor_starts)

    def _set_directions(self, d: Diagram, sphere: Sphere) -> None:
        """Set tangents, directions to neighbors and distances of generators, and the corners that follow from them."""
        unit = sphere.wrap(d.points) / sphere.radius
        self._tangents = [axis[self.owner] for axis in sphere.tangents(sphere.wrap(d.points))]
        behind = d.half_faces.behind(np.arange(len(self.owner)))
        between = sphere.wrap(behind) / sphere.radius - unit[self.owner]
        normal = self._along_tangents(between)
        level = (between**2).sum(axis=1) / 2
        if d.is_power:
            level += np.expm1((d.weights[self.owner] - d.weights[d.neighbors]) / (2 * sphere.radius**2))
        length = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
        self.directions = normal / length[:, None]
        self.spacings = sphere.radius * np.maximum(np.linalg.norm(between, axis=1), 1e-300)
        # The bisectors of two neighbors are the lines n.p = |d|^2 / 2 in the tangent plane; see `Rings` for weights.
        corners, _ = bisector_corners(d.neighbor_starts, normal, level)
        with np.errstate(all="ignore"):
            corner = unit[self.owner] + sum(p[:, None] * t for p, t in zip(corners.T, self._tangents, strict=True))
            self.expected_corners = sphere.wrap(corner)

    def _along_tangents(self, vectors: np.ndarray) -> np.ndarray:
        return np.stack([(vectors * axis).sum(axis=1) for axis in self._tangents], axis=1)

    def from_generators(self, d: Diagram) -> SphereCells:
        """Return the cells whose corners follow from generators and neighbors, not from the diagram's vertices."""
        arrays = {
            "points": d.points,
            "neighbor_starts": d.neighbor_starts,
            "neighbors": d.neighbors,
            "vertices": self.expected_corners,
            "cell_vertex_starts": d.neighbor_starts,
            "cell_vertices": np.arange(len(self.owner)),
        }
        arrays |= {"weights": d.weights} if d.is_power else {}
        return SphereCells(Diagram(d.domain, arrays), real=self.real)


def rebuild_cells(diagram: Diagram, dtype: object = None) -> Rebuilt:
    """Return the rebuilt cells of a diagram in a box, in a polygon or on a sphere; `dtype` as for `find_precision`."""
    made = SphereCells if diagram.domain.curved else Rebuilt
    return made(diagram, dtype)


def check_places(check: Check, g: Rebuilt) -> None:
    """Check that all positions are on the sphere, up to round-off."""
    d = check.diagram
    radius = d.domain.frame[1]
    allowed = RADIUS_ROUNDINGS * float(np.finfo(g.real).eps)
    for name in ("points", "vertices", "centroids", "face_centroids"):
        off = np.abs(np.linalg.norm(getattr(d, name), axis=1) / radius - 1)
        check.note(
            "on the sphere",
            np.maximum(off - allowed, 0),
            lambda k, name=name, off=off: (
                f"{name}[{k}] is {getattr(d, name)[k]}, off the sphere of radius {radius:g} by {off[k]:.3g} of it"
            ),
        )


def check_generators(check: Check, g: Rebuilt) -> None:
    """Check areas and arcs against cells whose corners follow from generators and neighbors alone.

    The device computes a cell relative to its generator. The round-off is therefore relative to the size of the cell,
    not of the sphere as that of the vertices, unless arcs come from the vertices in a file.
    """
    d = check.diagram
    if g.remade or not isinstance(g, SphereCells):
        return
    own = g.from_generators(d)
    doubts = own.doubts(ROUNDINGS * own.unit_of_cell)
    source = "generator and neighbors"
    check.compare("volumes of the generators", d.volumes, own.volumes, doubts.volumes, source)
    check.compare("face measures of the generators", d.face_measures, own.measures, doubts.measures, source)
