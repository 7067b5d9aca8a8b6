"""The protocol of domains: what the rest of the package asks of the region to mesh."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
import shapely

from ..arguments import check_rows, format_point
from ..errors import InputError
from ..opencl.engine import PLAIN, Traits
from .boundary_names import BoundaryNames, Walls
from .gaps import NARROW, NarrowPart
from .shapes import Edges
from .surface import Surface, box_surface

if TYPE_CHECKING:
    import pyopencl.array as cla

    from ..opencl.engine import Engine
    from .borders import Borders
    from .fixed_generators import FixedGenerators
    from .lines.obstacles import Obstacles
    from .polygon import Polygon
    from .sphere import Sphere
    from .surfaces.sheets import Sheets
    from .wall_triangles import WallTriangles

LARGEST_EDGE = 1e50
"""Longest edge of a domain, and the inverse of the shortest: fifth powers of lengths must not overflow float64."""
FOR_CALLERS = frozenset(
    """boundary boundary_distance boundary_index boundary_names cell_dim contains dim extent lower measure n_pieces
    names nearest periodic piece_of upper with_lines with_surfaces wrap""".split()
)
"""What all domains have for callers. Their other common members are what the package asks of a domain."""


class ClipBox(ABC):
    """The box that clips cells: a `Domain`, or a box that a stage makes. Stages use nothing else of a domain.

    Attributes
    ----------
    plane_count : int
        Number of planes of walls that cut single cells, in a solid.
    """

    plane_count: int = 0

    @abstractmethod
    def device_corners(self, real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Corners in the device's coordinates, padded to four numbers as kernels take them."""

    def clip_args(self, engine: Engine) -> tuple[object, ...]:
        """Return the CLIP_BOX_ARGS of kernels in 3D (tessellation/own_planes.h)."""
        return self.device_corners(engine.real)

    def look_farther(self, points: cla.Array) -> bool:
        """Find walls of a solid as far as cells of `points` (n, 3) reach; kernels have noted that.

        Returns whether planes of walls have been lost for want of room.
        """
        return False


class Chart(NamedTuple):
    """A plane domain of the same measure as a domain, and maps of points (n, d') -> (n, d) from it and (n, d) to it."""

    domain: Domain
    position: Callable[[np.ndarray], np.ndarray]
    place: Callable[[np.ndarray], np.ndarray]


class Domain(ClipBox):
    """The region to mesh: a box between two corners in all that a class does not say otherwise.

    Attributes
    ----------
    lower, upper : tuples of d floats
        Opposite corners of the bounding box.
    periodic : tuple of d bool
        Directions in which the domain is periodic.
    names : mapping or None
        The caller's names of boundaries.
    borders : Borders or None
        Lines or surfaces inside, on which faces of cells lie; see `with_lines` and `with_surfaces`.
    holes : Obstacles or None
        The same borders if their insides are removed from meshes; see `Box.without`.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    names: Mapping[str, Walls] | None = None
    borders: Borders | None = None
    holes: Obstacles | None = None

    def __dir__(self) -> list[str]:
        common = {name for kind in Domain.__mro__ for name in vars(kind) if not name.startswith("__")}
        return [name for name in super().__dir__() if name in FOR_CALLERS or name not in common]

    def with_lines(self, lines: object) -> Domain:
        """Return the same domain in 2D with lines inside, on which faces of the cells of a run lie.

        Such lines are faults, breaklines, rivers, borders of materials. Generators stand beside them in pairs that are
        mirror images, about h apart, and do not move. Lines may cross, end anywhere, and reach walls.

        Parameters
        ----------
        lines : array_like, curve, shapely geometry, GeoJSON, or list of them
            One or more lines: their vertices (k, 2); curves of `clvoro.curves`; lines, or polygons whose rings are
            lines, of shapely; or a path, text or dict of GeoJSON. What is outside of the domain is left out.

        Raises
        ------
        InputError, InputTypeError
            If the domain is not in the plane, or `lines` are no lines or not in the domain.

        Examples
        --------
        >>> fault = [(0.3, 0.2), (1.6, 0.8)]
        >>> ground = clvoro.Box((0, 0), (2, 1)).with_lines([fault, [(0, 0.6), (2, 0.5)]])
        >>> mesh = clvoro.adapt(ground, 0.1, "fast")
        >>> covered = mesh.diagram.faces.area[mesh.diagram.border_faces].sum() / ground.borders.inside(ground).length
        >>> round(float(covered), 9), sorted(set(mesh.diagram.cell_region.tolist()))
        (1.0, [0, 1])
        """
        from .lines.lines import Lines

        self.require_plane("lines are in the plane", "leave them out")
        self.require_no_holes("lines are given")
        made = type(self).described(**self.describe())
        found = Lines(lines)
        if not len(found.network(made).chains):
            raise InputError(f"lines are outside of {self}, expected a part of one inside; do units of length agree?")
        vars(made)["borders"] = found
        return made

    def with_surfaces(self, surfaces: object, angle: float = 30.0) -> Domain:
        """Return the same domain in 3D with surfaces inside, on which faces of the cells of a run lie.

        Such surfaces bound porous zones, solid parts for conjugate heat transfer, and other regions with cells of their
        own; or they are baffles, fracture planes, layers of rock. Generators stand beside them in pairs that are mirror
        images, about h apart, and do not move. Surfaces may be open or closed, meet in common edges, and reach walls.

        Parameters
        ----------
        surfaces : Solid, Surface, path, mesh of trimesh, (vertices, triangles), list or mapping of these
            What is outside of the domain is left out. Names of a mapping or a file are those of the regions inside of
            closed surfaces, and of the faces on them.
        angle : float
            Edges at which a surface turns by more than this, in degrees, become edges of cells.

        Raises
        ------
        InputError, InputTypeError
            If the domain is not in space, or surfaces cross each other, reach a periodic side, or are not in the
            domain.

        Examples
        --------
        >>> heater = clvoro.Solid.box((0.3, 0.3, 0.3), (0.7, 0.7, 0.7))
        >>> room = clvoro.Box((0, 0, 0), (1, 1, 1)).with_surfaces({"heater": heater})
        >>> d = clvoro.adapt(room, 0.1, "fast").diagram
        >>> d.region_names, [round(float(d.volumes[d.cell_region == k].sum()), 6) for k in range(2)]
        (['region-0', 'heater'], [0.936, 0.064])
        """
        from .surfaces.surfaces import Surfaces

        if self.cell_dim != 3:
            raise InputError(f"surfaces are in space, but the domain is {self}; use with_lines in the plane")
        made = type(self).described(**self.describe())
        found = Surfaces(surfaces, angle)
        found.check_within(made)
        vars(made)["borders"] = found
        return made

    @property
    def described_borders(self) -> dict[str, Any]:
        """What describes the borders inside, for files."""
        return {} if self.borders is None else {self.borders.word: self.borders.describe()}

    @cached_property
    def periodic(self) -> tuple[bool, ...]:
        """Directions in which the domain is periodic. By default none."""
        return (False,) * self.dim

    @property
    def dim(self) -> int:
        """Number of coordinates, 2 or 3."""
        return len(self.lower)

    @property
    def cell_dim(self) -> int:
        """Dimension of the cells: 2 on a sphere in 3D."""
        return self.dim

    @property
    def curved(self) -> bool:
        """Whether cells are pieces of a curved surface."""
        return self.cell_dim < self.dim

    cuts_cells: bool = False
    """Whether the boundary cuts cells anywhere. Cells at walls then need not be convex, they may have several loops,
    and each face stores both of its ends."""

    curved_walls: bool = False
    """Whether walls may be curved. The faces on them need not be plane, and cells there are not quite Voronoi cells."""

    leaves_out: str = ""
    """"area" or "volume" where meshes for solvers may leave out parts of the domain; see `Diagram.left_out`."""

    extrudes_layers: bool = False
    """Whether layers along walls are prisms, made when the mesh is read, and no rows of fixed generators."""

    @property
    def meeting_walls(self) -> np.ndarray:
        """Pairs of walls that meet at creases, (k, 2) int; known where layers are prisms."""
        return np.zeros((0, 2), np.int64)

    @property
    def shapes_cells(self) -> bool:
        """Whether walls may have any shape: they cut cells, or are curved."""
        return self.cuts_cells or self.curved_walls

    @property
    def plain(self) -> bool:
        """Whether the domain is its bounding box, with walls on all sides."""
        return not (self.curved or self.cuts_cells or any(self.periodic))

    @property
    def may_have_parts(self) -> bool:
        """Whether ranks can share a mesh of it."""
        return self.borders is None and self.wall_triangles is None

    @property
    def sheets(self) -> Sheets | None:
        """The surfaces inside, onto which vertices of meshes are moved; None without any."""
        return None if self.borders is None else self.borders.sheets

    @property
    def landmarks(self) -> np.ndarray:
        """Places (k, d) all over a sphere; all parts of a mesh know the generators nearest to them. None elsewhere.

        Without these generators cells of a part of a sphere would be unbounded.
        """
        return np.empty((0, self.dim))

    @property
    def globe(self) -> Sphere | None:
        """The sphere whose longitudes and latitudes positions have, or None."""
        return None

    @property
    def outline(self) -> Polygon | None:
        """The polygon whose edges are the boundary and cut the cells, or None."""
        return None

    evenly_below: int = 0
    """Starts of fewer generators are `even_points`, not random ones."""
    for_c_grids: bool = False
    """Whether models have C grids on its meshes, so that runs open obtuse triangles."""

    @cached_property
    def region(self) -> Any:
        """The domain as a closed shape: of shapely in the plane, a `Surface` in 3D; None on spheres."""
        if self.dim == 2:
            (a, b), (c, d) = self.lower, self.upper
            return shapely.box(a, b, c, d)
        return box_surface(np.array(self.lower), np.array(self.upper))

    def same_surface(self, other: Domain) -> bool:
        """Return whether cells of both domains can overlap: on spheres, whether their radii are equal."""
        del other
        return True

    @property
    def largest_size(self) -> float:
        """Largest size of cells."""
        return math.inf

    def even_points(self, n: int) -> np.ndarray:
        """Return `n` evenly spread points (n, d), of domains with `evenly_below` or a `largest_size`."""
        raise NotImplementedError(f"{type(self).__name__}.even_points")

    def least_cells(self, adapted: bool) -> int:
        """Return the least number of cells; `adapted`: of meshes that go from coarse to fine."""
        return self.n_pieces if adapted else 1

    @property
    def map_domain(self) -> Domain:
        """The domain of coordinates in which rasters and outlines are given: longitudes and latitudes on a sphere."""
        return self

    @property
    def uncut(self) -> Domain:
        """The domain before `subset` removed cells of its mesh: itself, unless it is what is left."""
        return self

    @property
    def extent(self) -> np.ndarray:
        """Edge lengths of the bounding box, (d,)."""
        return np.subtract(self.upper, self.lower)

    @property
    def n_pieces(self) -> int:
        """Number of separate pieces. Each one needs a generator."""
        return 1

    @property
    def measure(self) -> float:
        """Area or volume."""
        return float(np.prod(self.extent))

    # The boundary: walls are the sides of a box or the edges of a polygon.

    def default_names(self) -> BoundaryNames:
        """Return the parts of the boundary with their default names."""
        sides = [f"{axis}{end}" for axis in "xyz"[: self.dim] for end in ("Min", "Max")]
        walls = np.flatnonzero(~np.repeat(self.periodic, 2))
        index = np.full(len(sides), -1, np.int32)
        index[walls] = np.arange(len(walls))
        return BoundaryNames(tuple(sides[w] for w in walls), index, "side")

    @cached_property
    def boundaries(self) -> BoundaryNames:
        """The parts of the boundary, with the caller's names."""
        default = self.default_names()
        return default.renamed(f"{type(self).__name__} names", self.names) if self.names else default

    @property
    def boundary_names(self) -> tuple[str, ...]:
        """Names of the parts of the boundary: the caller's first, then the default names of all other walls."""
        return self.boundaries.names

    @property
    def boundary_index(self) -> np.ndarray:
        """Index in `boundary_names` for each wall, (k,) int32; -1 for the periodic sides of a box.

        A face with the neighbor -1 - k belongs to ``boundary_names[boundary_index[k]]``.
        """
        return self.boundaries.index

    @property
    def boundary_measure(self) -> float:
        """Length or area of all sides, periodic ones included."""
        return float(2 * sum(np.prod(np.delete(self.extent, a)) for a in range(self.dim)))

    def wall_planes(self, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return outward unit normals of sides (k,) int, and a point on each, (k, d) each."""
        axis, upper = walls // 2, walls % 2
        normals = np.zeros((len(walls), self.dim))
        normals[np.arange(len(walls)), axis] = 2.0 * upper - 1
        return normals, np.array([self.lower, self.upper])[upper]

    def removed_behind(self, walls: np.ndarray) -> np.ndarray:
        """Return for each of `walls` (k,) int whether a cell that `subset` removed is behind it, (k,) bool."""
        return np.zeros(len(walls), bool)

    def wall_distance(self, walls: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the distance of each of `points` (k, d) to its wall of `walls` (k,); by default to the plane."""
        normals, anchors = self.wall_planes(walls)
        return np.abs(((points - anchors) * normals).sum(axis=1))

    def toward_walls(self, walls: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the normals (k, d) of `walls` (k,) int, and the signed distances (k,) of `points` (k, d) from them."""
        normals, anchors = self.wall_planes(walls)
        return normals, ((anchors - points) * normals).sum(axis=1)

    def mirrored(self, walls: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the mirror images (k, d) of `points` (k, d) behind `walls` (k,) int; removed generators are there."""
        normals, gaps = self.toward_walls(walls, points)
        return points + 2 * gaps[:, None] * normals

    def _gaps(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (n, 2 d) of `points` to the planes of all sides, inf for periodic ones."""
        gaps = np.stack([np.subtract(points, self.lower), np.subtract(self.upper, points)], axis=2)
        gaps[:, np.array(self.periodic)] = np.inf
        return gaps.reshape(len(points), 2 * self.dim)

    def onto_walls(
        self, points: np.ndarray, anchors: np.ndarray, rows: np.ndarray, sets: Sequence[tuple[int, ...]]
    ) -> np.ndarray:
        """Return `points` (k, d) moved onto all walls of their sets, given `anchors` (k, d) that are there.

        `rows` (k,) are the places of their sets of walls in `sets`. Coordinates that are nan stay so.
        """
        del anchors
        moved = points.copy()
        for row in np.unique(rows).tolist():
            here = np.flatnonzero(rows == row)
            for side in sets[row]:
                axis, above = divmod(side, 2)
                moved[here, axis] = (self.upper if above else self.lower)[axis]
        return np.where(np.isnan(points), np.nan, moved)

    def closest_walls(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) the side whose plane is the closest one, (n,) int."""
        return self._gaps(points).argmin(axis=1)

    def boundary_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each of `points` (n, d) to the walls, inside and outside; (n,), inf without walls."""
        gaps = self._gaps(points)
        outside = np.linalg.norm(np.minimum(gaps, 0), axis=1)
        return np.where(outside > 0, outside, gaps.min(axis=1))

    def heights_over(self, points: np.ndarray, starts: np.ndarray, corners: np.ndarray) -> np.ndarray:
        """Return the height of the walls over polygons, (k,): of the points nearest to corners over that at the middle.

        Polygon i has the corners ``points[corners[starts[i]:starts[i + 1]]]``.
        """
        return np.zeros(len(starts) - 1)

    def boundary(self, walls: Walls | None = None) -> Edges | Surface:
        """Return sides as a shape for `clvoro.sizing.Distance`: segments in 2D, triangles in 3D.

        Parameters
        ----------
        walls : int, str, or a sequence of them, optional
            Numbers or names of sides; by default all that are not periodic.

        Raises
        ------
        InputError, InputTypeError
            If a side or name does not exist, or the box has no walls.
        """
        chosen = self.boundaries.select("boundary", walls)
        if not chosen.size:
            raise InputError(f"{self} is periodic in every direction, expected a box with a boundary")
        lower, upper = np.array(self.lower), np.array(self.upper)
        if self.dim == 3:
            whole = box_surface(lower, upper)
            sides = whole.triangles.reshape(6, 2, 3)[[4, 5, 2, 3, 0, 1]]
            return Surface(whole.vertices, sides[chosen].reshape(-1, 3), "boundary")
        corners = np.array([(0, 1), (0, 0), (1, 0), (1, 1)])  # counter-clockwise, side 0 first
        order = np.array([0, 2, 1, 3])[chosen]  # place of each side in this order
        x = np.where(corners, upper, lower)
        return Edges(x[order], x[(order + 1) % 4])

    def crease_edges(self, walls: Walls | None = None, *, concave: bool | None = None) -> Edges:
        """Raise an `InputError`, as only solids have creases; see `Solid.crease_edges`."""
        raise InputError(f"{self} has no creases, expected a solid")

    def _checked_names(self) -> dict[str, list[int]] | None:
        """Check the caller's names, and return them with the numbers of their walls; None without names."""
        parts = self.boundaries
        return {n: parts.select(n, n).tolist() for n in self.names} if self.names else None

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return the arguments of the domain as numbers, strings and lists, for files."""

    @classmethod
    def described(cls, **values: Any) -> Domain:
        """Return the domain from the values that `describe` returns."""
        return cls(**values)

    kinds: ClassVar[dict[str, type[Domain]]] = {}
    """All classes of domains by their names, for files."""

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        Domain.kinds[cls.__name__] = cls

    # Equal domains are the same region, with the same borders inside. Names may differ.

    @cached_property
    def _identity(self) -> dict[str, Any]:
        return {key: value for key, value in self.describe().items() if key != "names"}

    def same_region(self, other: Domain) -> bool:
        """Return whether the boundary of another domain is the same; names and borders inside may differ."""
        return self is other or (type(other) is type(self) and self._identity == other._identity)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{key}={value}' for key, value in self.describe().items())})"

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return self.same_region(other) and self.described_borders == other.described_borders

    def __hash__(self) -> int:
        return hash((type(self), self.lower, self.upper))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) whether it lies in the box, walls included; (n,) bool.

        In a periodic direction every finite coordinate is inside.
        """
        points = check_rows("points", points, self.dim)
        inside = (points >= self.lower) & (points <= self.upper)
        return np.all(inside | (np.array(self.periodic) & np.isfinite(points)), axis=1)

    def sees(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return for segments from `a` (k, 1, d) to `b` (k, m, d) whether they lie in the domain, (k, m).

        By default, where no wall can be in between, all of them.
        """
        return np.ones(np.broadcast_shapes(a.shape, b.shape)[:-1], bool)

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) whether it lies in the domain; on a wall it may or may not. Fast."""
        return self.contains(points)

    def contains_well(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Return for each of `points` (n, d) whether it is inside, at least `margin` from the boundary."""
        return self.contains(points) & (self.boundary_distance(points) >= margin)

    def meets_wall(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return for boxes with the corners `lower`, `upper` (n, d) whether walls may meet them, (n,) bool."""
        middle, reach = (lower + upper) / 2, np.linalg.norm(upper - lower, axis=1) / 2
        return self.boundary_distance(middle) <= reach

    def just_inside(self, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) the nearest wall's point, moved inwards by `depth` (n,)."""
        normals, gaps = self.toward_walls(self.closest_walls(points), points)
        return points + (gaps - depth)[:, None] * normals

    def check_rows(self, name: str, points: object) -> np.ndarray:
        """Return `points`, an array_like of real numbers, as a float64 array (n, d); see `arguments.check_rows`."""
        return check_rows(name, points, self.dim)

    def wrap(self, points: np.ndarray) -> np.ndarray:
        """Return `points` (n, d) with coordinates in [lower, upper) along the periodic directions."""
        points, lower, extent = np.asarray(points, float), np.array(self.lower), self.extent
        if not any(self.periodic):
            return points
        inside = (points >= lower) & (points < self.upper)
        with np.errstate(invalid="ignore"):  # callers refuse infinite coordinates
            moved = lower + np.mod(points - lower, extent)
        last = np.nextafter(np.array(self.upper), lower)  # for positions that are rounded up to the seam
        moved = np.clip(moved, lower, last)
        return np.where(inside | ~np.array(self.periodic), points, moved)

    def lengths(self, chords: np.ndarray) -> np.ndarray:
        """Return the lengths in the domain of straight segments of the lengths `chords`; arcs on a sphere."""
        return np.asarray(chords)

    def onto(self, points: np.ndarray) -> np.ndarray:
        """Return the positions of the curved surface that are nearest to `points` (n, d); in flat domains `points`."""
        return points

    def along_surface(self, vectors: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the parts of `vectors` (n, d) that are tangential to the domain at `points` (n, d)."""
        del points
        return vectors

    def triangle_areas(self, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Return the areas of triangles with the corners `a`, `b`, `c` (n, d), counter-clockwise; in 2D, (n,)."""
        p, q = b - a, c - a
        return (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]) / 2

    def tangents(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return `cell_dim` orthogonal unit vectors tangential to the domain at `points` (n, d), each (n, d)."""
        return tuple(np.broadcast_to(axis, np.shape(points)) for axis in np.eye(self.dim))

    def warnings(self) -> list[str]:
        """Return warnings for plausible mistakes in the domain, for a run. By default there are none."""
        return []

    def require_plane(self, what: str, remedy: str) -> None:
        """Raise InputError, which begins with `what` and ends with `remedy`, unless the domain is part of a plane."""
        if self.dim > 2:
            raise InputError(f"{what}, and {self} is in 3D or on a sphere; {remedy}")

    def require_flat(self, what: str, remedy: str) -> None:
        """Raise InputError, which begins with `what` and ends with `remedy`, if cells lie on a curved surface."""
        if self.curved:
            raise InputError(f"{what}, and the cells on {self} are pieces of a curved surface; {remedy}")

    def require_globe(self, what: str, remedy: str) -> Sphere:
        """Return the sphere whose longitudes and latitudes positions have.

        Raises `InputError` if there is none; begins with `what`, and ends with `remedy`.
        """
        if self.globe is None:
            raise InputError(f"{what}, not for {self}; {remedy}")
        return self.globe

    def require_no_holes(self, what: str) -> None:
        """Raise InputError, which begins with `what`, if holes are removed from meshes of the domain."""
        if self.holes is not None:
            raise InputError(f"{what}, which does not go with the holes of {self}; use it in the box without holes")

    def require_power_diagrams(self) -> None:
        """Raise InputError if there are no power diagrams in the domain."""
        self.require_no_holes("weights or volumes are given")
        if self.curved_walls:
            raise InputError(
                f"the domain is {self}, expected a polygon, a box or a sphere: there are no power diagrams in solids"
            )

    def given_weights(self, weights: np.ndarray) -> np.ndarray:
        """Return the given weights (n,) of those that generators have on the device, in the unit there."""
        return weights

    def lift(self, points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what adds a coordinate to generators, so that cells of a power diagram are those of the nearest one.

        - `points`, `weights`: (n, d), (n,) float

        Results:
        - `moved` (n, d) or () float: to be added to the positions.
        - `heights` (n,) float: the further coordinate, which is 0 for other points: sqrt(max w - w_i) (Aurenhammer
          1987).
        """
        del points
        return np.zeros(()), np.sqrt(weights.max() - weights)

    def plane_shares(self, squares: np.ndarray, excess: np.ndarray) -> np.ndarray:
        """Return where the planes between two cells cross the lines of their generators, as shares of these, (k,).

        - `squares` (k,) float: of the distances of the generators.
        - `excess` (k,) float: by how much the weight of the second generator exceeds that of the first.
        """
        return (1 - excess / squares) / 2

    def place_name(self, x: np.ndarray) -> str:
        """Return a position (d,) in words, for messages."""
        return format_point(x)

    def share_within(self, lower: np.ndarray, upper: np.ndarray) -> float:
        """Return the share of the domain in a part of its bounding box with the corners `lower` and `upper`, (d,)."""
        return float(np.prod((upper - lower) / self.extent))

    def piece_of(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) in the domain the piece that holds it, (n,) int; -1 elsewhere."""
        return np.where(self.contains(points), 0, -1)

    def inner_points(self) -> np.ndarray:
        """Return the center, (1, d)."""
        return (np.array([self.lower]) + self.upper) / 2

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return the nearest point of the box to each of `points` (n, d)."""
        return np.where(self.periodic, points, np.clip(points, self.lower, self.upper))

    def placed(self, what: str, places: np.ndarray, on_globe: bool) -> np.ndarray:
        """Return places (n, k) of another program in the coordinates of this domain, (n, d).

        `what` has them; `on_globe` says that they are longitudes and latitudes in degrees.

        Raises `InputError` if they have too few coordinates.
        """
        if places.shape[1] < self.dim:
            raise InputError(
                f"{what} has points with {places.shape[1]} coordinates, expected {self.dim} in {self}; add columns, or "
                "lon and lat on a sphere"
            )
        return places[:, : self.dim]

    def uncovered(
        self, walls: Callable[[], tuple[np.ndarray, np.ndarray]], smallest: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what lies between the boundary and the walls of a mesh, if walls may be curved.

        - `walls`: returns the corners (t, 3, 3) of triangles of the walls, counter-clockwise from outside, and the
          sizes h of the cells there, (t,). They bound the cells without gaps.
        - `smallest`: volume over h^3 of the smallest parts, but for whole bodies and cavities.

        Results:
        - `measures` (k,) float: positive for parts of the domain, negative for parts of its outside.
        - `places` (k, d) float: a point in each.
        """
        return np.empty(0), np.empty((0, self.dim))

    def narrow_parts(self, size: Callable[[np.ndarray], np.ndarray]) -> tuple[NarrowPart | None, NarrowPart | None]:
        """Return where the domain is narrower than half a cell of `size`, and a dead end narrower than a cell, or None.

        By default there are no dead ends.
        """
        place = np.add(self.lower, self.upper) / 2
        width = float(np.where(self.periodic, np.inf, self.extent).min())
        strait = NarrowPart(place, width, float(size(place[None])[0]))
        return strait if strait.width < NARROW * strait.size else None, None

    remedy_for_narrow_parts = "Use smaller sizes there"
    """What a warning of narrow parts advises."""

    def why_sizes_are_missed(self, x: np.ndarray, h: float, cells: int) -> str:
        """Return why the cell at `x` (d,) of a mesh of `cells` has not the size `h`, where sizes vary little."""
        del x, h, cells
        return (
            f"the domain has a measure of {self.measure:.6g}, which cells of this size do not fill evenly: use smaller "
            "sizes, or n_cells, which scales the sizes to a number of cells"
        )

    cutting_edges: int = 0
    """Number of edges of the boundary that cut cells in the plane."""

    def along_cutting_edges(self, function: Callable[[np.ndarray], np.ndarray], samples: int) -> float:
        """Return the integral of `function` of places (k, d) along those edges, from about `samples` places."""
        del function, samples
        return 0.0

    unit_hint: str = ""
    """What a user of coarse sizes should know of the unit of the coordinates."""

    def stations(
        self, size: Callable[[np.ndarray], np.ndarray], free: Domain, fixed: np.ndarray
    ) -> FixedGenerators | None:
        """Return generators that must stay so that faces end in re-entrant corners and creases: none here.

        - `size`: target size at points (k, d), (k,).
        - `free`: the domain without layers.
        - `fixed` (m, d) array: other generators that stay.
        """
        del size, free, fixed
        return None

    def chart(self) -> Chart:
        """Return the domain in which generators are drawn and sizes are integrated: itself, unless it is curved."""
        return Chart(self, np.asarray, np.asarray)

    # The device's view.

    framed_by: Domain | None = None
    """The domain that this one is a part of; its frame is used on the device."""

    @property
    def frame(self) -> tuple[np.ndarray, float]:
        """Origin and scale of the device's coordinates, x' = (x - origin) / scale in [0, 1].

        The scale is a power of two, so scaling is exact.
        """
        if self.framed_by is not None:
            return self.framed_by.frame
        lower, upper = self.clip_box
        return lower, 2.0 ** math.ceil(math.log2((upper - lower).max()))

    def periods(self, real: np.dtype) -> np.ndarray:
        """Return the lengths of periods in the device's coordinates, (d,) float64; 0 across walls.

        Raises `InputError` if a period is shorter than 1000 units of round-off.
        """
        step = float(np.finfo(real).eps)
        lengths = np.rint(self.extent / self.frame[1] / step) * step
        short = np.flatnonzero(np.array(self.periodic) & (lengths < 1000 * step))
        if short.size:
            raise InputError(
                f"{self} is too thin along its periodic axis {short[0]} for {np.dtype(real).name}, expected at least "
                f"{1000 * step:.1g} of the longest edge; use dtype='float64' or a thicker box"
            )
        return np.where(self.periodic, lengths, 0.0)

    def place(self, points: np.ndarray, real: np.dtype) -> np.ndarray:
        """Return positions (n, d) in the device's coordinates and precision, in [0, period) along periods."""
        origin, scale = self.frame
        if not any(self.periodic):
            return ((points - origin) / scale).astype(real)
        x, periods = (self.wrap(points) - origin) / scale, self.periods(real)
        along, step = np.array(self.periodic), float(np.finfo(real).eps)
        x = np.where(along, np.rint(x / step) * step, x)
        return np.where(along & (x >= periods), x - periods, x).astype(real)

    @property
    def clip_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the box that clips cells."""
        return np.array(self.lower), np.array(self.upper)

    def device_corners(self, real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
        """Corners of `clip_box` in the device's coordinates, padded to four numbers as kernels take them."""
        # Cached, because every stage needs them in every step.
        known: dict[np.dtype, tuple[np.ndarray, np.ndarray]] = vars(self).setdefault("_corners", {})
        if real not in known:
            origin, scale = self.frame
            corners = np.zeros((2, 4), real)
            corners[:, : self.dim] = (np.array(self.clip_box) - origin) / scale
            if any(self.periodic):
                corners[1, : self.dim] = np.where(self.periodic, self.periods(real), corners[1, : self.dim])
            corners.setflags(write=False)
            known[real] = corners[0], corners[1]
        return known[real]

    @property
    def wall_triangles(self) -> WallTriangles | None:
        """The triangles whose planes cut the cells near them, in a solid; else None."""
        return None

    def traits(self, real: np.dtype) -> Traits:
        """Return for what kernels are built, with the periods in the device's coordinates."""
        if self.wall_triangles is not None:
            return Traits(("SOLID", "OWN_WALLS"))
        if not any(self.periodic):
            return PLAIN
        x, y, z = [float(period) for period in self.periods(real)] + [0.0] * (3 - self.dim)
        return Traits(("PERIODIC",), (x, y, z))

    def device_args(self, engine: Engine) -> tuple[object, ...]:
        """Return the arguments of kernels with DOMAIN_ARGS; see geometry/domain.h."""
        walls = () if self.wall_triangles is None else self.wall_triangles.arguments(engine, self.frame)
        return *self.device_corners(engine.real), *walls, *engine.period_args


def images_in(domain: Domain, lower: np.ndarray, upper: np.ndarray, within: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the cells, or of a periodic domain also their images, that reach into a box.

    `lower` and `upper` (n, d) are the corners of the cells' bounding boxes, `within` those of the box.

    The result is a list of (rows (k,), offset (d,)).
    """
    found = []
    for step in product(*((0, -1, 1) if p else (0,) for p in domain.periodic)):
        by = step * domain.extent
        # An image must reach in by more than round-off.
        slack = 1e-9 * domain.extent * any(step)
        seen = ((upper + by >= within[0] + slack) & (lower + by <= within[1] - slack)).all(axis=1)
        found.append((np.flatnonzero(seen), by))
    return found
