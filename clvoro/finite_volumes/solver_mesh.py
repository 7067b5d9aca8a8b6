"""The mesh as a solver sees it: points, and faces with corners, owner and neighbor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ..arguments import check_choice, warn
from ..errors import InputError, MismatchWarning
from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from ..geometry.sphere import Sphere
from ..mesh.connectivity import following, slices, take_rows
from ..mesh.diagram import Diagram
from ..mesh.read_only import Sealed
from .geometry import face_geometry
from .measures import SolverMeasures
from .seams import faces_with_seams

_LARGE_CHANGE = 0.01
"""Change of the domain's area, as a share of it, beyond which there is a warning."""

WallShape = Literal["straight", "exact"]
"""What the wall faces of one cell become: one straight face, or as many as the domain has edges there."""


@dataclass(frozen=True, eq=False, repr=False)
class SolverMesh(Sealed):
    """A mesh as a finite-volume solver sees it.

    The faces between two cells come first, in upper-triangular order: by owner, then by neighbor. The faces on walls
    follow, wall by wall, each in the order of the owners. The last are the faces at the seams of a periodic box, twice
    each, once for each of the two cells: for each periodic direction those on the upper side, then in the same order
    those on the lower side.

    Attributes
    ----------
    domain : Box or Polygon
    cells : int
        Number of cells. Cell i is that of generator i.
    points : (v, d) float64
        Corners of faces. At seams each image is a separate point.
    starts : (f + 1,) int64
    corners : (k,) int64, in 3D int32
        Corners of face i, ``corners[starts[i]:starts[i + 1]]``. In 2D the owner lies to the left of the way from the
        first corner to the second. In 3D the order is counter-clockwise as seen from outside of the owner. At a seam
        the corners of the lower face are the images of those of the upper face, in opposite order; in 3D the
        first is the image of the first.
    owner : (f,) int32
    neighbor : (f,) int32
        Cell on the other side, owner < neighbor for the first `inner` faces; -1 - k on wall k of the domain.
    twin : (f,) int64
        At a seam the image of the face; -1 for other faces.
    shift : (f, d) int8
        At a seam the image of the face is at ``shift * domain.extent``, counted from the twin. Else 0.
    half_face : (f,) int64
        A half-face of the diagram for each face; -1 for a face that the diagram does not have.
    """

    domain: Domain
    cells: int
    points: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    owner: np.ndarray
    neighbor: np.ndarray
    twin: np.ndarray
    shift: np.ndarray
    half_face: np.ndarray

    @property
    def dim(self) -> int:
        """Number of dimensions."""
        return int(self.points.shape[1])

    @cached_property
    def inner(self) -> int:
        """Number of faces between two cells, without those at seams: the first ones."""
        return int(np.count_nonzero((self.neighbor >= 0) & (self.twin < 0)))

    @cached_property
    def outer(self) -> int:
        """Number of faces between two cells or on walls: all but the last ones, at seams."""
        return int(np.count_nonzero(self.twin < 0))

    def __len__(self) -> int:
        return self.cells

    def __repr__(self) -> str:
        changed = f", area {100 * self.area_change:+.2g} %" if self.area_change else ""
        return f"SolverMesh({self.cells} cells, {len(self.owner)} faces{changed})"

    @cached_property
    def area_change(self) -> float:
        """Volume (2D: area) of all cells minus that of the domain, over that of the domain; 0 up to round-off.

        Straight walls cut off parts of the domain, and add others.
        """
        d, measure = self.dim, self.domain.measure
        walls = slice(self.inner, len(self.owner))
        low = np.array(self.domain.lower)
        starts = self.starts[walls.start :] - self.starts[walls.start]
        corners = self.points[self.corners[self.starts[walls.start] :]] - low
        if d == 2:
            a, b = corners.reshape(-1, 2, 2).swapaxes(0, 1)
            total = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)
        else:
            count = np.arange(len(corners))
            centers, areas = face_geometry(corners, starts, count)
            total = float((centers * areas).sum() / 3)
        change = total / measure - 1
        return change if abs(change) > 1e-12 else 0.0

    def take_faces(self, kept: np.ndarray, **arrays: Any) -> SolverMesh:
        """Return the mesh with the faces `kept` (ascending indices or a mask) only, and with some other `arrays`.

        Points without a face are dropped.
        """
        rows = np.flatnonzero(kept) if kept.dtype == bool else kept
        place = np.full(len(self.owner) + 1, -1)
        place[rows] = np.arange(len(rows))
        if "starts" not in arrays:
            arrays["starts"], arrays["corners"] = take_rows(self.starts, self.corners, rows)
        taken = {
            "owner": self.owner[rows],
            "neighbor": self.neighbor[rows],
            "twin": place[self.twin[rows]],
            "shift": self.shift[rows],
            "half_face": self.half_face[rows],
        }
        return compact(replace(self, **{**taken, **arrays}))

    @cached_property
    def measures(self) -> SolverMeasures:
        """Non-orthogonality, skewness and more as OpenFOAM computes them; each is computed when first used."""
        return SolverMeasures(self)

    @cached_property
    def images(self) -> np.ndarray:
        """Class of each point, (v,) int64: points that are periodic images of one another have the same number."""
        import scipy.sparse

        upper = np.flatnonzero(self.twin > np.arange(len(self.twin)))
        v = len(self.points)
        _, there = take_rows(self.starts, self.corners, upper)
        counts, back = take_rows(self.starts, self.corners, self.twin[upper], np.ones(len(upper), bool))
        if self.dim == 2:
            back = back[following(counts)]
        graph = scipy.sparse.coo_array((np.ones(len(there)), (there, back)), (v, v))
        return scipy.sparse.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def make_solver_mesh(
    diagram: Diagram, walls: WallShape = "straight", collapse: bool = True, parts: np.ndarray | None = None
) -> SolverMesh:
    """Return `diagram` as a solver sees it; see `Diagram.solver_mesh`.

    The diagram keeps meshes with `collapse`, which take the longest, so that one is made once to be checked and saved.
    `parts` (k,) int is the index of the named part of the boundary of each wall, if it is not the domain's.
    """
    check_choice("walls", walls, ("straight", "exact"))
    diagram.demand_cells("solver_mesh")
    check_not_sphere(
        diagram,
        "meshes for solvers have cells in the plane or polyhedra",
        "use the diagram itself, as diagram.faces, or a file with walls='exact'",
    )
    parts = diagram.domain.boundaries.index if parts is None else parts
    if not collapse:
        return _made(diagram, walls, collapse, parts)
    kept: dict[tuple[str, bytes], SolverMesh] = vars(diagram).setdefault("_solver_meshes", {})
    key = (walls, parts.tobytes()) if diagram.domain.dim == 2 else ("", b"")
    if key not in kept:
        kept[key] = _made(diagram, walls, collapse, parts)
    return kept[key]


def _made(diagram: Diagram, walls: WallShape, collapse: bool, parts: np.ndarray) -> SolverMesh:
    """Take the faces of `diagram`, straighten its walls, collapse short faces, and repair bad cells."""
    from .collapse import collapse_short
    from .convex_corners import join_faces, move_concave_points
    from .repair.relaxation import relax_points
    from .short_edges import collapse_short_edges
    from .straight_walls import straight_walls

    faces, twin, shift = faces_with_seams(diagram)
    mesh = SolverMesh(
        domain=diagram.domain,
        cells=len(diagram),
        points=diagram.vertices.astype(np.float64, copy=False),
        starts=faces.starts.astype(np.int64, copy=False),
        corners=faces.corners.astype(np.int64 if diagram.domain.dim == 2 else np.int32, copy=False),
        owner=faces.owner,
        neighbor=faces.neighbor,
        twin=twin,
        shift=shift,
        half_face=faces.rows,
    )
    if mesh.dim == 3:
        return collapse_short(mesh, diagram) if collapse else compact(mesh)
    straight = walls == "straight" and isinstance(diagram.domain, Polygon)
    if straight:
        mesh = straight_walls(join_faces(mesh), diagram, parts)
    if collapse:
        mesh = collapse_short_edges(mesh, parts)
    if straight:
        mesh = move_concave_points(mesh)
    if collapse:
        mesh = relax_points(mesh, parts, straight)
    mesh = compact(mesh)
    if straight and abs(mesh.area_change) > _LARGE_CHANGE:
        warn(
            f"straight walls change the area of the domain by {100 * mesh.area_change:+.2g} %: its boundary has "
            "features as large as the cells. Use smaller cells there, or keep the exact walls with walls='exact'",
            MismatchWarning,
        )
    return mesh


def check_not_sphere(diagram: Diagram, why: str, instead: str) -> None:
    """Refuse a diagram on a sphere.

    Raises
    ------
    InputError
        Says `why`, and what to do `instead`.
    """
    if isinstance(diagram.domain, Sphere):
        raise InputError(f"{why}, and the cells on {diagram.domain} are pieces of a curved surface; {instead}")


def compact(mesh: SolverMesh) -> SolverMesh:
    """Return `mesh` without points that no face has."""
    used = np.zeros(len(mesh.points), bool)
    for part in slices(len(mesh.corners)):
        used[mesh.corners[part]] = True
    if used.all():
        return mesh
    place, corners = np.cumsum(used) - 1, np.empty_like(mesh.corners)
    for part in slices(len(corners)):
        corners[part] = place.take(mesh.corners[part])
    return replace(mesh, points=mesh.points.take(np.flatnonzero(used), axis=0), corners=corners)
