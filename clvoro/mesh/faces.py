"""The mesh on the host: every face once, with corners, owner and neighbor. All else is a view of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ..connectivity import components, following, inverse, slices, starts_of, take_rows
from .geometry import face_vectors, polygon_areas
from .read_only import Sealed, read_only

if TYPE_CHECKING:
    from ..finite_volumes.measures import SolverMeasures
    from ..geometry.domain import Domain
    from .diagram import Diagram
    from .left_out import LeftOut

OFF_BISECTOR = 1e-3
"""Largest distance of a face from the bisector of its generators over their distance, and largest slope against it.

In a polygonal domain a part of a cell that the boundary cuts off belongs to another cell. Its faces are not on the
bisector of the generators of the two cells."""
FLATTEST = 1e-3
"""Least distance of a generator from the plane of a face, over that from its center, at which the foot is used."""


@dataclass(frozen=True, eq=False, repr=False)
class Faces(Sealed):
    """Every face of a mesh in a box, also a periodic one, a polygon or a solid, on a sphere or a part of one.

    `Diagram.faces` are those of a diagram, each once. The faces between two cells come first, sorted by (owner,
    neighbor). The faces on walls follow, wall by wall, each in the order of the owners. Faces without measure are left
    out. Their areas, normals, centers and distances are those of the diagram.

    `Diagram.solver_mesh` returns the faces as a finite-volume solver gets them. Those at the seams of a periodic box
    are the last ones, twice each, once for each of the two cells: for each periodic direction those on the upper side,
    then in the same order those on the lower side. Areas, normals and centers follow from the corners.

    Signs and positions are those of the owner.

    Attributes
    ----------
    domain : Box, Polygon, Sphere, Solid, SphereRegion or Subdomain
    generators : (n, d) float64
        Cell i is that of generator i.
    points : (v, d) float64
        Corners of faces. At seams each image is a separate point.
    starts : (f + 1,) int64
    corners : (k,) int32 or int64
        Corners of face i, ``corners[starts[i]:starts[i + 1]]``. In 2D the owner lies to the left of the way from the
        first corner to the second. In 3D the order is counter-clockwise as seen from the neighbor. Where a seam has
        its faces twice, the corners of the lower face are the images of those of the upper face, in opposite order; in
        3D the first is the image of the first.
    owner : (f,) int32
        Cell on the side from which the normal points away.
    neighbor : (f,) int32
        Cell on the other side, owner <= neighbor (equal where a cell borders on its own periodic image); -1 - k on
        wall k of the domain.
    twin : (f,) int64
        At a seam the image of the face, if it has its faces twice; -1 for other faces.
    shift : (f, d) int8
        The neighbor lies at ``generators[neighbor] + shift * domain.extent``: not 0 only at seams.
    half_face : (f,) int64
        Place of the face in the arrays of the diagram that have one entry per half-face, as ``face_measures``; -1 for a
        face that the diagram does not have.
    diagram : Diagram or None
        The diagram that the measures of the faces come from; None if they follow from the corners, as in a solid.
    layer : (n,) int16 or None
        See `Diagram.layer`; None if no cell is in layers of a solid.
    """

    domain: Domain
    generators: np.ndarray
    points: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    owner: np.ndarray
    neighbor: np.ndarray
    twin: np.ndarray
    shift: np.ndarray
    half_face: np.ndarray
    diagram: Diagram | None = None
    layer: np.ndarray | None = None

    @property
    def dim(self) -> int:
        """Number of coordinates."""
        return int(self.points.shape[1])

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return len(self.generators)

    @cached_property
    def n_inner(self) -> int:
        """Number of faces between two cells, without those that seams have twice: the first ones."""
        return int(np.count_nonzero((self.neighbor >= 0) & (self.twin < 0)))

    @cached_property
    def n_outer(self) -> int:
        """Number of faces between two cells or on walls: all but those that seams have twice, which are the last."""
        return int(np.count_nonzero(self.twin < 0))

    def __len__(self) -> int:
        return len(self.owner)

    def __repr__(self) -> str:
        change = self.area_change if self.diagram is None else 0
        changed = f", area {100 * change:+.2g} %" if change else ""
        return f"Faces({self.n_cells} cells, {len(self)} faces{changed})"

    # Geometry.

    @cached_property
    def boundary(self) -> np.ndarray:
        """Index in ``domain.boundary_names`` for faces on walls; -1 between cells; (f,) int32."""
        walls = self.neighbor < 0
        found = np.full(len(self), -1, np.int32)
        found[walls] = self.domain.boundary_index[-1 - self.neighbor[walls]]
        return read_only(found)

    @cached_property
    def _geometry(self) -> dict[str, np.ndarray]:
        """Area and center; those of a diagram with normal and distance."""
        if self.diagram is not None:
            made = _geometry_of_diagram(self, self.diagram)
            return {name: read_only(values) for name, values in made.items()}
        center, vector = self.vectors
        return {"area": read_only(np.linalg.norm(vector, axis=1)), "center": center}

    @cached_property
    def vectors(self) -> tuple[np.ndarray, np.ndarray]:
        """Centers and area vectors by the corners, (f, d) float64 each."""
        center, vector = face_vectors(self.points, self.starts, self.corners)
        return read_only(center), read_only(vector)

    def take_vectors(self, other: Faces, rows: np.ndarray, changed: np.ndarray) -> None:
        """Take `vectors` from the faces `rows` (f,) of another mesh, if it has computed them.

        Those of faces that have `changed`, (f,) bool, are computed.
        """
        if "vectors" not in vars(other):
            return
        center, vector = (values.take(rows, axis=0) for values in other.vectors)
        new = np.flatnonzero(changed)
        center[new], vector[new] = face_vectors(self.points, *take_rows(self.starts, self.corners, new))
        vars(self)["vectors"] = read_only(center), read_only(vector)

    @property
    def area(self) -> np.ndarray:
        """Area; length in 2D; (f,) float64."""
        return self._geometry["area"]

    @cached_property
    def normal(self) -> np.ndarray:
        """Unit normal, from owner to neighbor, or out of the domain; (f, d) float64."""
        if self.diagram is not None:
            return self._geometry["normal"]
        return read_only(self.vectors[1] / np.where(self.area > 0, self.area, 1)[:, None])

    @property
    def center(self) -> np.ndarray:
        """Centroid; (f, d) float64. In a periodic box it lies beside the owner, possibly outside of the box."""
        return self._geometry["center"]

    @cached_property
    def distance(self) -> np.ndarray:
        """Distance between the two generators, or of the owner's generator from the wall; (f,) float64.

        On a sphere distances are along great circles. On a wall it is that of the wall's plane, 0 or negative where the
        generator lies on that plane or behind it, as can happen at re-entrant corners of polygons; on a sphere it is
        that of the arc towards a removed cell. In a mesh for solvers it is the sum of `near` and `far`.
        """
        return self._geometry["distance"] if self.diagram is not None else self.near + self.far

    # The two-point flux ``conductance * (u[neighbor] - u[owner])``, with the unknowns at the generators.

    @cached_property
    def _two_point(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Near, far and foot."""
        center, normal, inner = self.center, self.normal, self.neighbor >= 0
        here = self.generators[self.owner].astype(float)
        near, is_flat = _distances(center - here, normal)
        foot = here + near[:, None] * normal
        there = self.generators[self.neighbor[inner]] + self.shift[inner] * np.array(self.domain.extent)
        far = np.zeros(len(near))
        far[inner], flat = _distances(there - center[inner], normal[inner])
        share = near[inner] / (near[inner] + far[inner])
        foot[inner] = here[inner] + share[:, None] * (there - here[inner])
        is_flat[inner] |= flat
        foot[is_flat] = center[is_flat]
        return read_only(near), read_only(far), read_only(foot)

    @property
    def near(self) -> np.ndarray:
        """Distance of the plane of the face from the owner's generator, (f,) float64.

        At a re-entrant corner the plane of a wall may pass through or behind the generator (`FLATTEST`): then it is the
        distance of the center, which is the foot. Straight lines are measured, on a sphere, too.
        """
        return self._two_point[0]

    @property
    def far(self) -> np.ndarray:
        """Distance of the plane of the face from the neighbor's generator, (f,) float64; 0 on walls."""
        return self._two_point[1]

    @property
    def foot(self) -> np.ndarray:
        """Point of the plane of the face on the line from generator to generator, (f, d) float64.

        On a wall it is the foot of the generator's perpendicular, where the value of the wall belongs. It may lie
        beside the face.
        """
        return self._two_point[2]

    @property
    def conductance(self) -> np.ndarray:
        """Area over the sum of the distances `near` and `far`, (f,)."""
        return self.area / (self.near + self.far)

    # The mesh for solvers.

    @cached_property
    def measures(self) -> SolverMeasures:
        """Non-orthogonality, skewness and more as OpenFOAM computes them; each is computed when first used."""
        from ..finite_volumes.measures import SolverMeasures

        return SolverMeasures(self)

    @cached_property
    def volumes(self) -> np.ndarray:
        """Volume of each cell, (n,) float64; area in 2D."""
        return read_only(polygon_areas(self)) if self.dim == 2 else self.measures.geometry.volumes

    @cached_property
    def area_change(self) -> float:
        """Volume (2D: area) of all cells minus that of the domain, over that of the domain; 0 up to round-off.

        Straight walls cut off parts of the domain, and add others.
        """
        walls, low = self.starts[self.n_inner :], np.array(self.domain.lower)
        corners = self.points[self.corners[walls[0] :]] - low
        centers, areas = face_vectors(corners, walls - walls[0], np.arange(len(corners)))
        total = float((centers * areas).sum() / self.dim)
        change = total / self.domain.measure - 1
        return change if abs(change) > 1e-12 else 0.0

    @cached_property
    def left_out(self) -> LeftOut:
        """What the cells leave out of the domain, or add to it, where they are too large for its boundary."""
        from .left_out import left_out_at_walls, left_out_of_polygon

        outline = self.domain.outline
        return left_out_at_walls(self) if outline is None else left_out_of_polygon(self, outline)

    @cached_property
    def images(self) -> np.ndarray:
        """Class of each point, (v,) int64: points that are periodic images of one another have the same number."""
        upper = np.flatnonzero(self.twin > np.arange(len(self.twin)))
        v = len(self.points)
        _, there = take_rows(self.starts, self.corners, upper)
        counts, back = take_rows(self.starts, self.corners, self.twin[upper], np.ones(len(upper), bool))
        if self.dim == 2:
            back = back[following(counts)]
        return components(v, there, back)[1].astype(np.int64)

    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the cell and the face of each side of each face, (s,) each: those of the owners come first."""
        k = self.n_inner
        cells = np.concatenate([self.owner, self.neighbor[:k]]).astype(np.int64)
        return cells, np.concatenate([np.arange(len(self)), np.arange(k)])

    def side_ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Return in 2D the two points of each side (see `sides`), (s,) each; its cell is on the left."""
        (a, b), k = self.corners.reshape(-1, 2).T, self.n_inner
        return np.concatenate([a, b[:k]]), np.concatenate([b, a[:k]])

    def cell_faces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the sides (see `sides`) of each cell as ragged rows: starts (n + 1,) and places among the sides."""
        cells, _ = self.sides()
        starts = starts_of(np.bincount(cells, minlength=self.n_cells))
        return starts, np.argsort(cells, kind="stable")

    def with_half_faces(self, half_face: np.ndarray) -> Faces:
        """Return the same mesh with other `half_face` (f,), without a diagram; keep what follows from its corners."""
        made = replace(self, half_face=half_face, diagram=None)
        known = "vectors", "_geometry", "measures", "n_inner"
        if self.diagram is None:
            vars(made).update({name: vars(self)[name] for name in known if name in vars(self)})
        return made

    def take_faces(self, kept: np.ndarray, **arrays: Any) -> Faces:
        """Return the mesh with the faces `kept` (indices or a mask) only, and with some other `arrays`."""
        rows = np.flatnonzero(kept) if kept.dtype == bool else kept
        place = np.full(len(self.owner) + 1, -1)
        place[rows] = np.arange(len(rows))
        if "starts" not in arrays:
            arrays["starts"], arrays["corners"] = take_rows(self.starts, self.corners, rows)
        taken = {name: getattr(self, name)[rows] for name in ("owner", "neighbor", "shift", "half_face")}
        return replace(self, **{**taken, "twin": place[self.twin[rows]], **arrays})

    def part(self, kept: np.ndarray) -> tuple[Faces, np.ndarray]:
        """Return the mesh of the cells that are `kept`, (n,) bool, and the number of each of its points.

        Faces towards other cells are on wall 0.
        """
        cells, seam = np.flatnonzero(kept), self.twin >= 0
        place = np.full(self.n_cells, -1)
        place[cells] = np.arange(len(cells))
        beyond = np.maximum(self.neighbor, 0)
        here, there = kept[self.owner], (self.neighbor >= 0) & kept[beyond]
        one = np.flatnonzero(here & ~there | ~seam & there & ~here)
        both, twice = np.flatnonzero(here & there & ~seam), np.flatnonzero(here & there & seam)
        rows = np.concatenate([both, one, twice])
        turned = ~here[rows]
        starts, corners = take_rows(self.starts, self.corners, rows, turned)
        if self.dim == 2:
            ends = corners.reshape(-1, 2)  # a view
            ends[turned] = ends[turned, ::-1]
        owner = place[np.where(turned, beyond[rows], self.owner[rows])]
        neighbor = place[beyond[rows]]
        outer = np.where(self.neighbor[one] < 0, self.neighbor[one], -1)
        neighbor[len(both) : len(both) + len(one)] = outer
        taken = self.take_faces(
            rows,
            generators=self.generators[cells],
            starts=starts,
            corners=corners,
            owner=owner.astype(np.int32),
            neighbor=neighbor.astype(np.int32),
            layer=None if self.layer is None else self.layer[cells],
        )
        made = taken.compact()
        made.take_vectors(self, rows, turned)
        return made, np.flatnonzero(np.bincount(corners))

    def compact(self) -> Faces:
        """Return the mesh without points that no face has."""
        used = np.zeros(len(self.points), bool)
        for part in slices(len(self.corners)):
            used[self.corners[part]] = True
        if used.all():
            return self
        place, corners = np.cumsum(used) - 1, np.empty_like(self.corners)
        for part in slices(len(corners)):
            corners[part] = place.take(self.corners[part])
        return replace(self, points=self.points.take(np.flatnonzero(used), axis=0), corners=corners)


def make_faces(diagram: Diagram) -> Faces:
    """Return every face of `diagram` that has a measure, once."""
    owner, neighbor = diagram.half_faces.owner, diagram.neighbors
    starts, corners = diagram.half_faces.corners
    filled = np.diff(starts) > 0
    inner = np.flatnonzero(filled & (neighbor >= 0))
    # Of two half-faces that of the lower cell is taken, or that which is there.
    here, there = diagram.half_faces.keys(inner)
    first, second = np.flatnonzero(here < there), np.flatnonzero(here > there)
    key, other = here[first], there[second]
    order = np.argsort(key, kind="stable")
    # Keys in the order of the cells are nearly sorted, which is fast to complete.
    by_cell = inverse(np.arange(len(second) + 1), neighbor[inner[second]], len(diagram))[1]
    nearly = other[by_cell]
    if not np.array_equal(key[order], np.sort(nearly, kind="stable")):
        second = second[~np.isin(other, key)]
        first, key = np.concatenate([first, second]), np.concatenate([key, there[second]])
        order = np.argsort(key, kind="stable")
    chosen = first[order]
    inner, flipped = inner[chosen], here[chosen] > there[chosen]
    outer = np.flatnonzero(filled & (neighbor < 0))
    outer = outer[np.lexsort((owner[outer], -neighbor[outer]))]
    rows = np.concatenate([inner, outer])
    flipped = np.concatenate([flipped, np.zeros(len(outer), bool)])
    one, other = owner[rows], neighbor[rows]
    between = other >= 0
    taken, vertices = take_rows(starts, corners, rows, flipped)
    shift = diagram.shifts[rows]
    return Faces(
        domain=diagram.domain,
        generators=diagram.points,
        points=diagram.vertices,
        starts=taken,
        corners=vertices,
        owner=np.where(between, np.minimum(one, other), one).astype(np.int32, copy=False),
        neighbor=np.where(between, np.maximum(one, other), other).astype(np.int32, copy=False),
        twin=np.full(len(rows), -1),
        shift=np.where(flipped[:, None], -shift, shift) if flipped.any() else shift,
        half_face=rows,
        diagram=None if diagram.has_moved_vertices else diagram,
        layer=diagram.layer if diagram.layer.any() else None,
    )


def _geometry_of_diagram(f: Faces, diagram: Diagram) -> dict[str, np.ndarray]:
    """Return areas, normals, centers and distances of the faces `f` of a diagram."""
    domain, points, inner = f.domain, f.generators, f.neighbor >= 0
    walls = -1 - f.neighbor[~inner]
    center = diagram.face_centroids[f.half_face].astype(float)
    if any(domain.periodic):  # where only the neighbor has the face, its position is beside the neighbor
        away = diagram.half_faces.owner[f.half_face] != f.owner
        away |= (diagram.shifts[f.half_face] != f.shift).any(axis=1)
        center = center + np.where(away[:, None], f.shift * domain.extent, 0.0)
    normal, distance = np.empty((len(f), f.dim)), np.empty(len(f))
    across = points[f.neighbor[inner]] + f.shift[inner] * domain.extent
    between = across - points[f.owner[inner]]
    length = np.linalg.norm(between, axis=1)
    normal[inner], distance[inner] = between / length[:, None], domain.lengths(length)
    normal[~inner], gaps = domain.toward_walls(walls, points[f.owner[~inner]])
    distance[~inner] = domain.lengths(2 * gaps) / 2
    if domain.cuts_cells:
        _correct_cut_faces(f, normal, distance, center)
    area = diagram.face_measures[f.half_face]
    return {"area": area, "normal": normal, "center": center, "distance": distance}


def _correct_cut_faces(f: Faces, normal: np.ndarray, distance: np.ndarray, center: np.ndarray) -> None:
    """Take the normals of faces that are not on the bisector of their generators from their ends.

    The other generator may be that of a cell that is not in the domain any more.
    """
    begin, end = f.points[f.corners.reshape(-1, 2)].swapaxes(0, 1)
    along = end - begin
    length = np.hypot(*along.T)
    far = OFF_BISECTOR * distance
    cut = np.abs((along * normal).sum(axis=1)) > np.maximum(OFF_BISECTOR * length, far)
    k = np.flatnonzero(f.neighbor >= 0)
    middle = (f.generators[f.owner[k]] + f.generators[f.neighbor[k]]) / 2
    cut[k] |= np.abs(((center[k] - middle) * normal[k]).sum(axis=1)) > far[k]
    normal[cut] = np.stack([along[cut, 1], -along[cut, 0]], axis=1) / length[cut, None]


def _distances(arm: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the parts of `arm` along `normal` (f, d), and where they are too short, so that lengths replace them."""
    along, length = (arm * normal).sum(axis=1), np.linalg.norm(arm, axis=1)
    is_flat = along < FLATTEST * length
    return np.where(is_flat, length, along), is_flat
