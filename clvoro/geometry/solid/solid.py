"""The solid: a domain in space whose boundary is a triangulated surface."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from numbers import Real
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from ...arguments import check_rows, counted, format_point, warn
from ...errors import InputError, MismatchWarning
from ...files import pack_array, unpack_array
from ..boundary_names import BoundaryNames, Walls
from ..box import Box
from ..columns import Columns
from ..domain import Domain
from ..gaps import NARROW, NARROW_GAP, NarrowPart
from ..nearest_triangles import Feet, NearestTriangles, heights_over
from ..polygon import Polygon
from ..shapes import Edges
from ..surface import Surface
from ..surface_files import SOLIDS, FilePath, named_parts, parts_of, read_parts, unit_length
from ..triangles import NamedTriangles, pierced
from ..wall_triangles import WallTriangles
from . import primitives
from .checks import sharp_edges, volume_inside, voxel_width
from .combining import around, boolean, named_triangles
from .creases import (
    CONCAVE,
    CONVEX,
    connect,
    corner_normals,
    dihedral_turns,
    even_turns,
    find_creases,
    triangle_normals,
)
from .preparation import Preparation, ShapeOptions, SolidOptions, prepared
from .stations import Stations, place_stations
from .wrapping import kept_groups

if TYPE_CHECKING:
    from typing_extensions import Unpack

_ON = 1e-12  # of the diagonal: points this close to the surface lie on it
_PROBES = 4096  # places on the surface from which widths are measured
_MANY_CROWDED = 200  # cells at the walls of narrow gaps beside thin bodies, from which a run says so before it
_MANY_THIN = 0.1  # share of the surface: if more of it is nearer to a facing wall than a cell, a run says so before it
_FACING = -0.7  # product of the normals of two walls that face each other
_WRAPPED = 150.0  # degrees: a wrap has no creases
_MARGIN = 0.05  # of the longest edge, by which the clip box is larger than the region


class Solid(Domain):
    """The inside of a closed triangulated surface.

    The surface is divided at its creases into smooth patches. A patch is a wall: a face on patch k has the neighbor
    -1 - k.

    Parameters
    ----------
    vertices : (v, 3) float
        Vertices at the same place count as one.
    triangles : (t, 3) int
        Indices into `vertices`, counter-clockwise seen from outside of the region.
    groups : (t,) int, optional
        A number for each triangle. Triangles of different groups belong to different patches, even on a flat wall.
    group_names : sequence of str, optional
        The names of the groups 0, 1, ...; by default ``group-0``, ... Without `groups` the whole surface has the first
        one; by default `name`, or ``wall``.
    names : mapping, optional
        Names of boundaries, each with its patches: numbers, names of groups, or a sequence of them.
    angle : float, optional
        Edges at which the surface turns by more than this are creases, in degrees; by default 30, or 150 with `wrap`.
    creases : (e, 2) int, optional
        More edges at which patches end, as pairs of vertices.
    name : str, optional
        Name of the solid in error messages, and of the boundary of a simple one, such as `box`.
    **preparation
        What is done to the triangles before, in this order:

        - `join` float: vertices within this distance count as one.
        - `bottom` float: the triangles are a terrain, and the solid is the ground below them, down to this height z,
          repaired. Its walls and its bottom are the boundaries ``side`` and ``bottom``. The air above is
          ``Solid.outside(ground, box)``.
        - `repair` bool: join vertices across small gaps, remove duplicate triangles, close flat holes, orient
          triangles and unite parts that cross or touch, with a warning that says what was done. Closed holes are
          boundaries with the names ``hole-1``, ... Other holes, and parts that cross themselves, stay errors.
        - `wrap` float: take a closed surface around all triangles in their place, whatever is wrong with them. It is
          about wrap / 2 outside of them, and closes holes and gaps up to 2 wrap wide; sheets become plates as thick as
          `wrap`. What is finer is left out, with sharp edges. Groups that `names` mentions stay, all others become one:
          ``wall``. A warning says how far the surface is from the triangles at most. It suits cells of 1.5 wrap, or
          smaller ones.
        - `inside` three numbers: with `wrap`, the solid is the space around this point, up to about wrap / 2 from the
          triangles.

    Attributes
    ----------
    surface : Surface
        The surface, with one vertex for each place.
    patch : (t,) int32
        The smooth patch of each triangle.
    creases : Creases
    corners : (c,) int
        Vertices where chains of creases meet, end or turn sharply.

    Raises
    ------
    InputError, InputTypeError
        If the surface is not closed, intersects itself, or its normals do not point outwards; or a number or name is
        wrong.
    MissingLibraryError
        If a repair or a wrap needs manifold3d, which is not installed.

    Warns
    -----
    MismatchWarning
        If the surface was repaired, or has edges sharper than 10 degrees.

    Examples
    --------
    >>> cube = clvoro.Solid.box((0, 0, 0), (1, 1, 1))
    >>> cube.measure, len(cube.creases), len(cube.corners)
    (1.0, 12, 8)
    """

    curved_walls = extrudes_layers = True
    leaves_out = "volume"
    remedy_for_narrow_parts = (
        "Use smaller sizes there, as sizing.gap_size does, or fill such gaps around a body by wrap=, two thirds of the "
        "size of cells"
    )

    def __init__(
        self,
        vertices: object,
        triangles: object,
        groups: object = None,
        group_names: Sequence[str] | None = None,
        names: Mapping[str, Walls] | None = None,
        angle: float | None = None,
        creases: object = None,
        name: str | None = None,
        **preparation: Unpack[Preparation],
    ):
        if groups is None and group_names is None:
            group_names = [name or "wall"]
        name, wraps = name or "Solid", preparation.get("wrap") is not None
        if creases is not None and wraps:
            raise InputError(f"{name} has creases and wrap, expected one of them: a wrap has other vertices")
        skin, self.twin = prepared(vertices, triangles, groups, group_names, names, name, **preparation)
        self.surface, self._group, self._group_names, _ = skin
        angle = (_WRAPPED if wraps else 30) if angle is None else angle
        if not (isinstance(angle, Real) and 0 < angle < 180):
            raise InputError(f"{name} angle is {angle!r}, expected degrees between 0 and 180")
        self.angle = float(angle)
        given, vertices, triangles = vertices, self.surface.vertices, self.surface.triangles
        self.normals, self._areas = triangle_normals(vertices, triangles, self.twin)
        turns = dihedral_turns(vertices, triangles, self.twin, self.normals)
        across = self._group[self.twin // 3] != np.repeat(self._group, 3)
        border = (np.abs(turns) > math.radians(self.angle)) | across | self._drawn(given, creases)
        if self.angle >= 90:  # a wrap is rough, and borders of its groups are convex or concave as a whole
            even_turns(turns, self.twin, self._group, across)
        self.patch, self.creases, self.corners = find_creases(vertices, triangles, self.twin, turns, border)
        self.n_patches = int(self.patch.max()) + 1
        lower, upper = vertices[triangles].min(axis=(0, 1)), vertices[triangles].max(axis=(0, 1))
        self.lower, self.upper = tuple(lower.tolist()), tuple(upper.tolist())
        self.names = names
        self.names = self._checked_names()
        voxel = voxel_width(vertices[triangles].reshape(-1, 3), self.normals, self._areas, self.patch)
        if voxel is not None:
            warn(
                f"{name} is a surface of voxels {voxel:.3g} wide, with creases around {self.n_patches} patches: "
                "cells of about this size take minutes. Smooth the mask first, with SciPy and scikit-image (see the "
                "Limits in the guide on solids); for the flow around it pass wrap=, two thirds of the size of cells",
                MismatchWarning,
            )
        sharp = sharp_edges(self.creases.angle)
        if sharp.size:
            where = vertices[self.creases.edges[sharp[0]]].mean(axis=0)
            warn(
                f"{name} has {counted(len(sharp), 'edge')} sharper than 10 degrees, the first at "
                f"{format_point(where)}; cells there are poor. Blunt them by about h, or use smaller sizes there",
                MismatchWarning,
            )

    def _drawn(self, vertices: object, creases: object) -> np.ndarray:
        """Return the sides of triangles (3 t,) that are among the edges `creases` between the caller's `vertices`."""
        triangles, name, given = self.surface.triangles, self.surface.name, np.asarray(vertices, float)
        self._drawn_edges = np.zeros((0, 2), np.int64)
        if creases is None:
            return np.zeros(triangles.size, bool)
        edges = np.asarray(creases)
        if edges.ndim != 2 or edges.shape[1] != 2 or edges.dtype.kind not in "iu":
            raise InputError(f"{name} creases have shape {edges.shape}, expected pairs of vertices (e, 2) int")
        if edges.size and not (0 <= edges.min() and edges.max() < len(given)):
            raise InputError(f"{name} creases have vertices up to {edges.max()}, expected those of the surface")
        n = len(self.surface.vertices)
        place = scipy.spatial.KDTree(self.surface.vertices).query(given[edges.reshape(-1)])[1]
        edges = self._drawn_edges = np.sort(place.reshape(-1, 2), axis=1)
        ends = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        return np.isin(ends @ (n, 1), edges @ (n, 1))

    @classmethod
    def read(
        cls, path: FilePath | Sequence[FilePath], units: str | float | None = None, **options: Unpack[SolidOptions]
    ) -> Solid:
        """Read a solid from STL, OBJ, PLY, OFF or 3MF files with trimesh, or from a STEP file with Gmsh.

        Solids of an STL file, groups of an OBJ file, objects of a 3MF file and named faces of a STEP file give
        boundaries their names. Parts of a STEP file that touch or overlap are united. Several files are parts of one
        surface, which have the names of their files.

        Parameters
        ----------
        path : str, path, or a sequence of them
            Files may be packed by gzip: ``part.stl.gz``.
        units : str or float, optional
            The unit of the numbers in the file: m, mm, cm, km, um, in, ft, or its length in meters. The solid is in
            meters then; by default numbers stay as they are. STEP files say their unit: the solid is in meters.
        **options
            As for `Solid`.

        Raises
        ------
        InputError
            If the file cannot be read, or its surface bounds no region.
        MissingLibraryError
            If the file needs a library that is not installed.
        """
        unit = unit_length(units)
        made = named_parts(read_parts(path, SOLIDS), unit)
        first, *others = [path] if isinstance(path, str | PathLike) else path
        name = f"solid {str(first)!r}" + (f" with {len(others)} more files" if others else "")
        if others and options.get("wrap") is not None:
            names = options.get("names") or {}
            left = set(made.names) - set(kept_groups(name, names, tuple(made.names)))
            options["names"] = {**{group: group for group in made.names if group in left}, **names}
        return cls._of(made, options, name)

    @classmethod
    def _of(cls, made: NamedTriangles, options: Any, title: str | None = None) -> Solid:
        """Return the solid of a surface and the caller's `options`; a single name is for all its triangles.

        - `title`: the name of a surface in messages; its groups are more than parts of a shape, and stay
        """
        named = "name" in options and (title is None or made.groups is None)
        names = options.pop("group_names", [str(options["name"])] if named else made.names)
        groups = options.pop("groups", None if len(names) == 1 else made.groups)
        return cls(made.vertices, made.triangles, groups, names, **dict(name=title) | options)

    @classmethod
    def from_trimesh(cls, mesh: Any, **options: Unpack[SolidOptions]) -> Solid:
        """Return the solid inside of a ``trimesh.Trimesh``, or of all meshes of a ``trimesh.Scene`` and their names."""
        return cls._of(named_parts(parts_of(mesh)), options, "Solid")

    def outside(self, box: Box | tuple[Sequence[float], Sequence[float]], **options: Unpack[SolidOptions]) -> Solid:
        """Return the region of a box around this body, for external flow.

        The sides of the box have the names xMin, xMax, ..., or those of a `Box`; the others are those of the body.
        Cavities of the body are not meshed. A body that touches or crosses the box needs manifold3d.

        Parameters
        ----------
        box : Box, or its lower and upper corner
        **options
            As for `Solid`.

        Raises
        ------
        InputError
            If the box is periodic.
        """
        if isinstance(box, Box) and any(box.periodic):
            raise InputError(f"Solid.outside box is {box}, expected a box with walls; leave out `periodic`")
        lower, upper = (box.lower, box.upper) if isinstance(box, Box) else box
        frame = self.box(lower, upper, names=box.names if isinstance(box, Box) else None)
        made = around(self, frame)
        if self.angle >= 90:  # the edges of the box stay creases
            x, triangles = made.vertices, made.triangles
            on = np.isclose(np.hstack([x, x]), np.hstack([lower, upper]), rtol=0, atol=_ON * frame.extent.max())
            ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
            options["creases"] = np.unique(np.sort(ends[on[ends].all(axis=1).sum(axis=1) > 1], axis=1), axis=0)
        return self._of(made, {"angle": self.angle, **options}, "Solid")

    def __add__(self, other: Solid) -> Solid:
        return self._combined(other, "+")

    def __sub__(self, other: Solid) -> Solid:
        return self._combined(other, "-")

    def __and__(self, other: Solid) -> Solid:
        return self._combined(other, "^")

    def _combined(self, other: Solid, operation: str) -> Solid:
        """Return a boolean of two solids; names stay."""
        if not isinstance(other, Solid):
            return NotImplemented
        return Solid(*boolean(operation, named_triangles(self), named_triangles(other)), angle=self.angle)

    @classmethod
    def box(cls, lower: Sequence[float], upper: Sequence[float], **options: Unpack[ShapeOptions]) -> Solid:
        """Return a box; its sides have the names xMin, xMax, yMin, ..."""
        return cls._of(primitives.box(lower, upper), options)

    @classmethod
    def cone(
        cls,
        begin: Sequence[float],
        end: Sequence[float],
        radius: float,
        edge: float | None = None,
        **options: Unpack[ShapeOptions],
    ) -> Solid:
        """Return a cone from its base around `begin` to its tip `end`, with the boundaries bottom and side."""
        return cls._of(primitives.cone(begin, end, radius, edge), options)

    @classmethod
    def torus(
        cls,
        center: Sequence[float],
        radius: float,
        tube: float,
        edge: float | None = None,
        **options: Unpack[ShapeOptions],
    ) -> Solid:
        """Return a torus around an axis in z: a tube of the radius `tube` around a circle of `radius`."""
        return cls._of(primitives.torus(center, radius, tube, edge), options)

    @classmethod
    def turned(
        cls, profile: Sequence[Sequence[float]], edge: float | None = None, **options: Unpack[ShapeOptions]
    ) -> Solid:
        """Return what a closed profile of points (radius, height) sweeps around the z axis.

        The boundaries are edge-0, edge-1, ..., one for each edge of the profile that is not on the axis.
        """
        return cls._of(primitives.turned(profile, edge), options)

    @classmethod
    def extruded(cls, polygon: Polygon, bottom: float, top: float, **options: Unpack[ShapeOptions]) -> Solid:
        """Return a `Polygon`, with its holes, between two heights; its boundaries, and those named bottom and top."""
        return cls._of(primitives.extruded(polygon, bottom, top), options)

    @classmethod
    def polyhedron(cls, normals: object, offsets: object, **options: Unpack[ShapeOptions]) -> Solid:
        """Return the convex polyhedron of the points x with normals (m, 3) . x <= offsets (m,).

        The boundaries are plane-0, plane-1, ...
        """
        return cls._of(primitives.polyhedron(normals, offsets), options)

    @classmethod
    def ball(
        cls, center: Sequence[float], radius: float, edge: float | None = None, **options: Unpack[ShapeOptions]
    ) -> Solid:
        """Return a ball. `edge` is the length of the triangles' edges; by default a sixteenth of the radius."""
        return cls._of(primitives.ball(center, radius, edge), options)

    @classmethod
    def cylinder(
        cls,
        begin: Sequence[float],
        end: Sequence[float],
        radius: float,
        edge: float | None = None,
        **options: Unpack[ShapeOptions],
    ) -> Solid:
        """Return a cylinder around the axis from `begin` to `end`, with the boundaries side, bottom and top."""
        return cls._of(primitives.cylinder(begin, end, radius, edge), options)

    @property
    def meeting_walls(self) -> np.ndarray:
        """Pairs of patches that meet at creases, (k, 2) int."""
        return self.creases.patches

    @property
    def unit_hint(self) -> str:  # type: ignore[override]
        """How long the solid is, and how to say the unit of a file."""
        files = "STEP files say their unit; of others units='mm' says that they are in millimeters"
        return f" (The solid is {max(self.extent):.3g} long. {files}.)"

    # Where points are.

    @cached_property
    def _diagonal(self) -> float:
        return float(np.linalg.norm(self.extent))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 3) whether it lies in the solid, walls included; (n,) bool."""
        x = check_rows("points", points, 3)
        inside = self.covers(x)
        outside = np.flatnonzero(~inside & np.isfinite(x).all(axis=1))
        inside[outside] = self.feet(x[outside], _ON * self._diagonal).triangle >= 0
        return inside

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 3) whether it lies in the solid, (n,) bool; on a wall it may or may not."""
        return self.surface.columns.winding(points) > 0

    @cached_property
    def _whole(self) -> NearestTriangles:
        """All triangles, for nearest points."""
        return NearestTriangles(self.surface, np.arange(len(self.patch)))

    def feet(self, points: np.ndarray, reach: float = math.inf, triangles: np.ndarray | None = None) -> Feet:
        """Return the nearest point of the surface to each of `points` (n, 3), within `reach`.

        `triangles` (n,) are the nearest ones, if they are known.
        """
        return (
            self._whole.feet(np.asarray(points, float), reach)
            if triangles is None
            else self._whole.feet_on(points, triangles)
        )

    def closest(
        self, points: np.ndarray, triangles: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return triangle (n,) int, foot (n, 3) and distance (n,), negative inside, of `points` (n, 3).

        `triangles`: see `feet`.
        """
        feet = self.feet(points, triangles=triangles)
        return feet.triangle, feet.point, np.where(self.covers(points), -1, 1) * feet.distance

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of `points` (n, 3) to the surface, negative inside; (n,)."""
        return self.closest(check_rows("points", points, 3))[2]

    def boundary_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each of `points` (n, 3) to the surface, inside and outside; (n,)."""
        return self.feet(check_rows("points", points, 3)).distance

    def heights_over(self, points: np.ndarray, starts: np.ndarray, corners: np.ndarray) -> np.ndarray:
        """Return how high the surface is curved over polygons; see `Domain.heights_over`."""
        return heights_over(self.feet, self.normals, points[corners], starts)

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return the nearest point of the solid to each of `points` (n, 3)."""
        found = check_rows("points", points, 3).copy()
        outside = ~self.contains(found)
        found[outside] = self.feet(found[outside]).point
        return found

    def onto_walls(
        self, points: np.ndarray, anchors: np.ndarray, rows: np.ndarray, sets: Sequence[tuple[int, ...]]
    ) -> np.ndarray:
        """Return `anchors` (k, 3), since other points may be off the surface."""
        return np.where(np.isnan(points), np.nan, anchors)

    def closest_walls(self, points: np.ndarray) -> np.ndarray:
        """Return the patch nearest to each of `points` (n, 3), (n,) int."""
        return self.patch[self.feet(points).triangle].astype(np.int64)

    # What cuts cells.

    @cached_property
    def corner_normals(self) -> np.ndarray:
        """Unit normals of the patches at the triangles' corners, (t, 3, 3). Between them they are interpolated."""
        return corner_normals(self.surface.vertices, self.surface.triangles, self.normals, self.patch)

    @cached_property
    def side_kinds(self) -> np.ndarray:
        """Kinds (t, 3) int8 of the triangles' sides, from corner k to k + 1: `SMOOTH`, `CONVEX` or `CONCAVE`."""
        kinds = np.zeros((len(self.patch), 3), np.int8)
        ends = np.stack([self.surface.triangles, np.roll(self.surface.triangles, -1, axis=1)], axis=2)
        for column in range(2):
            item = self.creases.triangles[:, column]
            edge = self.creases.edges[:, ::-1] if column else self.creases.edges
            side = (ends[item] == edge[:, None]).all(axis=2).argmax(axis=1)
            kinds[item, side] = np.where(self.creases.concave, CONCAVE, CONVEX)
        return kinds

    @cached_property
    def corner_kinds(self) -> np.ndarray:
        """Kinds (t, 3) int8 of the triangles' corners: the largest of the patch's sides that end there."""
        kinds = np.maximum(self.side_kinds, np.roll(self.side_kinds, 1, axis=1))
        key = self.surface.triangles * self.n_patches + self.patch[:, None]
        _, place = np.unique(key, return_inverse=True)
        most = np.zeros(int(place.max()) + 1, np.int8)
        np.maximum.at(most, place.reshape(-1), kinds.reshape(-1))
        return most[place.reshape(-1)].reshape(-1, 3)

    @cached_property
    def wall_triangles(self) -> WallTriangles:  # type: ignore[override]
        """The surface as kernels take it."""
        return WallTriangles(self.surface.corners, self.patch, self.corner_normals, self.side_kinds, self.corner_kinds)

    @cached_property
    def _patches(self) -> list[NearestTriangles]:
        """The triangles of each patch, for nearest points."""
        order = np.argsort(self.patch, kind="stable")
        parts = np.split(order, np.searchsorted(self.patch[order], np.arange(1, self.n_patches)))
        return [NearestTriangles(self.surface, part) for part in parts]

    def stations(
        self, size: Callable[[np.ndarray], np.ndarray], free: Domain | None = None, fixed: np.ndarray | None = None
    ) -> Stations:
        """Return generators around concave creases and corners, for sizes h = size(points (n, 3)).

        Faces between their cells meet in the creases, so that no cell is concave there.
        """
        del free, fixed
        return place_stations(self, size)

    def uncovered(
        self, walls: Callable[[], tuple[np.ndarray, np.ndarray]], smallest: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the parts that a mesh does not cover, and those of the outside that it covers."""
        from .uncovered import uncovered

        return uncovered(self, *walls(), smallest)

    def narrow_parts(self, size: Callable[[np.ndarray], np.ndarray]) -> tuple[NarrowPart | None, NarrowPart | None]:
        """Return where the solid is narrower than half a cell, or where it is narrowest if many walls are that near.

        If few are, the second is where many cells are in gaps of less than 3 cells beside bodies thinner than a cell,
        as between fins: cells on both sides of such a body reach through it.

        The width is that of thin parts and of gaps between bodies, measured inwards from a sample of the surface. Sharp
        edges, where two walls meet, do not count.
        """
        areas = np.cumsum(self._areas)
        k = np.arange(_PROBES)
        even = np.minimum(np.searchsorted(areas, (k + 0.5) / _PROBES * areas[-1]), len(areas) - 1)
        item = np.unique(np.concatenate([even, k * len(areas) // _PROBES]))
        begin = self.surface.corners[item].mean(axis=1)
        h = np.asarray(size(begin), float)
        width = self.widths(item, h)
        share_of = np.bincount(np.searchsorted(item, even), minlength=len(item)) / _PROBES
        share = float(share_of[width < h].sum())
        width = np.minimum(width, float(self.extent.min()))
        worst = int((width / h).argmin())
        place = begin[worst] - 0.5 * width[worst] * self.normals[item[worst]]
        part = NarrowPart(place, float(width[worst]), float(h[worst]), share)
        strait = part if part.width < NARROW * part.size else None
        return strait, part if share > _MANY_THIN else self._crowded(item, share_of, h)

    def _crowded(self, items: np.ndarray, share_of: np.ndarray, h: np.ndarray) -> NarrowPart | None:
        """Return the narrowest gap beside bodies thinner than a cell, if many cells are there; see `narrow_parts`.

        - `items`, `h` (k,) int and float: triangles, and the sizes there.
        - `share_of` (k,) float: the share of the surface that each stands for.
        """
        begin, normals, patch = self.surface.corners[items].mean(axis=1), self.normals[items], self.patch[items]
        gap, behind = np.full(len(items), math.inf), self.clearance(begin, normals, h, patch, behind=True)
        rows = np.flatnonzero(behind < h)
        gap[rows] = self.clearance(begin[rows], -normals[rows], NARROW_GAP * h[rows], patch[rows])
        rows = np.flatnonzero(np.isfinite(gap))
        share = share_of[rows]
        if float((share * self._areas.sum() / h[rows] ** 2).sum()) < _MANY_CROWDED:
            return None
        k = rows[int((gap[rows] / h[rows]).argmin())]
        place = begin[k] - 0.5 * gap[k] * normals[k]
        return NarrowPart(place, float(gap[k]), float(h[k]), float(share.sum()), float(behind[k]))

    def widths(self, items: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return how far the wall is that faces each of the triangles `items` (k,), up to `reach` (k,); else inf.

        From the middle of a triangle inwards. Walls that share a crease with the triangle's patch do not count.
        """
        return self.clearance(self.surface.corners[items].mean(axis=1), -self.normals[items], reach, self.patch[items])

    def clearance(
        self, points: np.ndarray, directions: np.ndarray, reach: np.ndarray, patch: np.ndarray, behind: bool = False
    ) -> np.ndarray:
        """Return how far the wall is that faces `points` (k, 3) of the surface, up to `reach` (k,); else inf; (k,).

        Along unit vectors `directions` (k, 3). Walls that share a crease with `patch` (k,) do not count.
        With `behind` these vectors lead out of the solid, to where it begins again.
        """
        width = np.full(len(points), math.inf)
        meets = np.sort(self.creases.patches, axis=1) @ (self.n_patches, 1)
        for first in range(0, len(points), _PROBES):
            part = slice(first, first + _PROBES)
            begin, along, far, mine = points[part], directions[part], reach[part], patch[part]
            end = begin + far[:, None] * along
            who, other = self.surface.tree.meeting(np.minimum(begin, end), np.maximum(begin, end))
            facing = (-1 if behind else 1) * np.einsum("ij,ij->i", along[who], self.normals[other]) > -_FACING
            pair = np.sort(np.column_stack([mine[who], self.patch[other]]), axis=1) @ (self.n_patches, 1)
            rows = np.flatnonzero(facing & ~np.isin(pair, meets))
            share = pierced(begin[who[rows]], end[who[rows]], self.surface.corners[other[rows]])
            seen = share > 1e-9
            np.minimum.at(width, first + who[rows[seen]], share[seen] * far[who[rows[seen]]])
        return width

    def feet_on_patch(self, patch: int, points: np.ndarray) -> np.ndarray:
        """Return the point of a patch that is nearest to each of `points` (k, 3), (k, 3)."""
        return self._patches[patch].feet(points, math.inf).point

    @cached_property
    def curvature(self) -> np.ndarray:
        """Largest curvature of the surface in each triangle, in the directions of its sides; 1 / length, (t,)."""
        sides = np.roll(self.surface.corners, -1, axis=1) - self.surface.corners
        turn = np.roll(self.corner_normals, -1, axis=1) - self.corner_normals
        length2 = np.einsum("tkd,tkd->tk", sides, sides)
        along = np.abs(np.einsum("tkd,tkd->tk", turn, sides))
        return np.divide(along, length2, out=np.zeros_like(along), where=length2 > 0).max(axis=1)

    def crease_edges(self, walls: Walls | None = None, *, concave: bool | None = None) -> Edges:
        """Return the edges of creases, from which `clvoro.sizing.Distance` measures distances.

        Parameters
        ----------
        walls : int, str, or a sequence of them, optional
            Numbers or names of patches, such as those of a body in a flow: only creases of these; by default all.
        concave : bool, optional
            Whether only creases that are concave, or convex.

        Raises
        ------
        InputError
            If there are none.
        """
        chosen = np.isin(self.creases.patches, self.boundaries.select("walls", walls)).any(axis=1)
        if concave is not None:
            chosen &= self.creases.concave == concave
        if not chosen.any():
            kind = "" if concave is None else "concave " if concave else "convex "
            raise InputError(f"{self} has no {kind}creases{'' if walls is None else f' at {walls!r:.60}'}")
        ends = self.surface.vertices[self.creases.edges[chosen]]
        return Edges(ends[:, 0], ends[:, 1])

    # The protocol of domains.

    def default_names(self) -> BoundaryNames:
        """Return the patches with the names of their groups."""
        group = np.zeros(self.n_patches, np.int64)
        group[self.patch] = self._group
        used, index = np.unique(group, return_inverse=True)
        names = tuple(self._group_names[g] for g in used.tolist())
        return BoundaryNames(names, index.reshape(-1).astype(np.int32), "patch")

    def why_sizes_are_missed(self, x: np.ndarray, h: float, cells: int) -> str:
        """Return why the cell at `x` (3,) of a mesh of `cells` has not the size `h`, where sizes vary little."""
        if self.feet(x[None], h).triangle[0] < 0:
            return super().why_sizes_are_missed(x, h, cells)
        return (
            "walls and creases there are as near to each other as cells are wide: use smaller sizes there, as "
            "sizing.gap_size and sizing.curvature_size do, or leave out such details by wrap="
        )

    @property
    def plain(self) -> bool:
        """A solid does not fill its bounding box."""
        return False

    def contains_well(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Return for each of `points` (n, 3) whether it is inside and at least `margin` from the surface, (n,) bool."""
        inside = self.covers(points)
        inside[inside] = self.feet(points[inside], margin).triangle < 0
        return inside

    def meets_wall(self, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return for boxes with the corners `lower`, `upper` (n, 3) whether triangles may meet them, (n,) bool."""
        met = np.zeros(len(lower), bool)
        met[self.surface.tree.meeting(lower, upper)[0]] = True
        return met

    @property
    def measure(self) -> float:
        """Volume."""
        return self._volume

    @cached_property
    def _volume(self) -> float:
        return volume_inside(self.surface.corners)

    @property
    def boundary_measure(self) -> float:
        """Area of the surface."""
        return float(self._areas.sum())

    @property
    def clip_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of a box a little larger than the region."""
        margin = _MARGIN * self.extent.max()
        return np.array(self.lower) - margin, np.array(self.upper) + margin

    def boundary(self, walls: Walls | None = None) -> Surface:
        """Return patches as a shape for `clvoro.sizing.Distance`; by default all.

        Parameters
        ----------
        walls : int, str, or a sequence of them, optional
            Numbers or names of patches.
        """
        chosen = self.boundaries.select("boundary", walls)
        return Surface(self.surface.vertices, self.surface.triangles[np.isin(self.patch, chosen)], "boundary")

    @property
    def region(self) -> Surface:  # type: ignore[override]
        """The whole surface."""
        return self.boundary()

    @cached_property
    def shells(self) -> tuple[int, np.ndarray]:
        """Number of connected parts of the surface, and the part of each triangle, (t,) int."""
        side = np.arange(len(self.twin))
        return connect(len(self.patch), np.column_stack([side, self.twin]) // 3)

    @cached_property
    def shell_volumes(self) -> np.ndarray:
        """Volume inside of each connected part of the surface, negative for cavities, (s,) float."""
        count, shell = self.shells
        a, b, c = np.moveaxis(self.surface.corners - np.add(self.lower, self.upper) / 2, 1, 0)
        return np.bincount(shell, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6, count)

    @cached_property
    def _pieces(self) -> list[np.ndarray]:
        """The triangles of each separate piece of the region: an outer shell, and those of its cavities."""
        shell, volume, corners = self.shells[1], self.shell_volumes, self.surface.corners
        outer = [s for s in np.argsort(volume) if volume[s] > 0]  # the smallest first
        parts = {s: [np.flatnonzero(shell == s)] for s in outer}
        around = {s: Columns(corners[parts[s][0]]) for s in outer} if len(outer) > 1 else {}
        for s in np.flatnonzero(volume <= 0):
            mine = np.flatnonzero(shell == s)
            place = corners[mine[:1]].mean(axis=1)
            holder = next((o for o in outer if o in around and around[o].winding(place)[0] > 0), outer[-1])
            parts[holder].append(mine)
        return [np.concatenate(parts[s]) for s in sorted(outer)]

    @property
    def n_pieces(self) -> int:
        """Number of separate pieces. Each one needs a generator."""
        return len(self._pieces)

    def piece_of(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 3) the piece that holds it, (n,) int; -1 outside."""
        x = check_rows("points", points, 3)
        piece = np.where(self.contains(x), 0, -1)
        if self.n_pieces == 1:
            return piece
        left = np.flatnonzero(piece == 0)
        if left.size:
            near = np.full((self.n_pieces, len(left)), -1.0)
            for p, items in enumerate(self._pieces):
                near[p] = Columns(self.surface.corners[items]).winding(x[left]) > 0
            piece[left] = near.argmax(axis=0)
        return piece

    def inner_points(self) -> np.ndarray:
        """Return a point inside of each piece, (n_pieces, 3), away from its walls."""
        return np.array([self._inner_point(items) for items in self._pieces])

    def _inner_point(self, items: np.ndarray) -> np.ndarray:
        corners = self.surface.corners[items]
        largest = np.argsort(-self._areas[items], kind="stable")[:16]
        begin = corners[largest].mean(axis=1)
        inward = -self.normals[items[largest]] * self._diagonal
        best, most = begin[0], -1.0
        for x, v in zip(begin, inward, strict=True):
            share = pierced(np.broadcast_to(x, (len(items), 3)), np.broadcast_to(x + v, (len(items), 3)), corners)
            share = share[share > 1e-9]
            if share.size:
                middle = x + 0.5 * share.min() * v
                room = float(self.feet(middle[None]).distance[0])
                if room > most and self.contains(middle[None])[0]:
                    best, most = middle, room
        return best

    def share_within(self, lower: np.ndarray, upper: np.ndarray) -> float:
        """Return the share of the solid in a part of its bounding box, to about a percent of that part."""
        k = (np.arange(24) + 0.5) / 24
        at = np.stack(np.meshgrid(k, k, k, indexing="ij"), axis=-1).reshape(-1, 3)
        inside = self.covers(lower + at * (upper - lower))
        return float(inside.mean() * np.prod(upper - lower) / self.measure)

    def just_inside(self, points: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 3) the nearest point of the surface, moved inwards by `depth` (n,)."""
        feet = self.feet(points)
        return feet.point - depth[:, None] * self.normals[feet.triangle]

    def wall_distance(self, walls: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the distance of each of `points` (k, 3) to its patch of `walls` (k,)."""
        return self._wall_feet(walls, points)[2]

    def toward_walls(self, walls: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the normals (k, 3) of `walls` (k,) at the feet of `points` (k, 3), and the distances (k,) to them."""
        point, normal, _ = self._wall_feet(walls, points)
        return normal, np.einsum("ij,ij->i", point - points, normal)

    def _wall_feet(self, walls: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return foot, normal and distance of each of `points` on its patch."""
        foot, normal, distance = np.zeros((len(walls), 3)), np.zeros((len(walls), 3)), np.zeros(len(walls))
        for k in np.unique(walls):
            rows = np.flatnonzero(walls == k)
            feet = self._patches[k].feet(points[rows], math.inf)
            mean = np.einsum("nk,nkd->nd", feet.weights, self.corner_normals[feet.triangle])
            foot[rows], distance[rows] = feet.point, feet.distance
            normal[rows] = mean / np.linalg.norm(mean, axis=1)[:, None]
        return foot, normal, distance

    # Files.

    def describe(self) -> dict[str, Any]:
        """Return the arguments of this solid as numbers and strings; arrays are compressed."""
        return {
            "vertices": pack_array(self.surface.vertices, "<f8"),
            "triangles": pack_array(self.surface.triangles, "<i8"),
            "groups": pack_array(self._group, "<i8"),
            "group_names": list(self._group_names),
            "angle": self.angle,
            **({"creases": self._drawn_edges.tolist()} if len(self._drawn_edges) else {}),
            **({"names": dict(self.names)} if self.names else {}),
        }

    @classmethod
    def described(cls, **values: Any) -> Solid:
        """Return the solid from the values that `describe` returns."""
        values["vertices"] = unpack_array(values["vertices"], "<f8").reshape(-1, 3)
        values["triangles"] = unpack_array(values["triangles"], "<i8").reshape(-1, 3)
        values["groups"] = unpack_array(values["groups"], "<i8")
        return cls(**values)

    def __repr__(self) -> str:
        return f"Solid({len(self.patch)} triangles, {self.n_patches} patches, volume {self.measure:.6g})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _described, (self.describe(),), {"borders": self.borders}

    def __hash__(self) -> int:
        return int(hashlib.sha256(self.surface.vertices.tobytes()).hexdigest()[:15], 16)


def _described(values: dict[str, Any]) -> Solid:
    return Solid.described(**values)
