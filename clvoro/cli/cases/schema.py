"""The tables of a case file: their keys, the values that these take, and what a run makes of them.

Each table is a `msgspec.Struct`. A table of several kinds is a union of classes with the key `kind` as their tag.
`build` returns the object that a table describes: a shape, a size field or a domain. `folder` is that of the files that
the table names; `domain` is what sizes are for, and the default extent of rasters.
"""

from __future__ import annotations

import csv
import functools
import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

import msgspec
import numpy as np
import shapely
from msgspec import Meta

from ... import earth, sizing
from ...adaptation.options import EffortName, MethodName, Start
from ...errors import InputError
from ...fields import read_fields
from ...files import LONGEST_GEOMETRY, read_text
from ...geometry.box import Box
from ...geometry.curves import Curve
from ...geometry.domain import Domain
from ...geometry.geojson import FOREIGN, geometries_of_geojson, pieces_of_geojson
from ...geometry.polygon import Polygon
from ...geometry.solid.solid import Solid
from ...geometry.sphere import Sphere
from ...geometry.surface_files import SOLIDS, FilePart, joined, read_parts, unit_length
from ...io.arrays import read_array
from ...io.foam import PatchType
from . import checks
from .files import locate
from .grids import read_grid

Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Count = Annotated[int, Meta(ge=1)]
Natural = Annotated[int, Meta(ge=0)]
Text = Annotated[str, Meta(min_length=1)]
Plane = tuple[float, float]
Space = tuple[float, float, float]
Point = Annotated[tuple[float, ...], Meta(min_length=2, max_length=3)]
Walls = int | str | Annotated[list[int | str], Meta(min_length=1)]
"""Edges or sides: a number, a name, or a list of them."""


class Table(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A table. Keys with the value None are not given."""

    CHOICE: ClassVar[tuple[str, ...]] = ()
    """Keys of which exactly one is required."""

    def __post_init__(self) -> None:
        found = [key for key in self.CHOICE if getattr(self, key) is not None]
        if self.CHOICE and len(found) != 1:
            raise ValueError(
                f"has {', '.join(found) or 'none'} of {', '.join(self.CHOICE)}, expected exactly one of them"
            )

    def given(self, *without: str) -> dict[str, Any]:
        """Return the values of the keys that are given, except `without`."""
        values = {key: getattr(self, key) for key in self.__struct_fields__ if key not in without}
        return {key: value for key, value in values.items() if value is not None}


class Kind(Table, tag_field="kind"):
    """A table of a kind, which its key `kind` names. By default it holds arguments of `MAKE`."""

    MAKE: ClassVar[Callable[..., Any]]

    def build(self, folder: Path, domain: Any = None) -> Any:
        return type(self).MAKE(**self.given())


# Curves, which are rings of domains and shapes of sizes.


class CurveTable(Kind):
    """A curve of `clvoro.curves`."""

    name: Text | None = None
    tolerance: Positive | None = None

    def build(self, folder: Path, domain: Any = None) -> Curve:
        return Curve.described(msgspec.to_builtins(self))


class CircleCurve(CurveTable, tag="circle", kw_only=True):
    center: Plane
    radius: Positive


class Arc(CurveTable, tag="arc", kw_only=True):
    center: Plane
    radius: Positive
    start: float
    end: float


class Ellipse(CurveTable, tag="ellipse", kw_only=True):
    center: Plane
    semi_axes: Plane
    angle: float | None = None
    start: float | None = None
    end: float | None = None


class Naca(CurveTable, tag="naca", kw_only=True):
    code: Text
    chord: Positive | None = None
    leading_edge: Plane | None = None
    angle_of_attack: float | None = None
    trailing_edge: Literal["closed", "blunt"] | None = None


class Spline(CurveTable, tag="spline", kw_only=True):
    points: Annotated[list[Plane], Meta(min_length=2)]
    closed: bool | None = None
    corners: list[Natural] | None = None


# Shapes that sizes are measured from.


class CircleShape(Kind, tag="circle"):
    MAKE = sizing.Circle
    center: Point
    radius: NotNegative


class BallShape(Kind, tag="sphere"):
    MAKE = sizing.Ball
    center: Space
    radius: NotNegative


class BoxShape(Kind, tag="box"):
    lower: Point | None = None
    upper: Point | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        if domain.map_domain is not domain and None in (self.lower, self.upper):
            raise InputError(f"size.shapes has a box without corners, expected lower and upper in degrees on {domain}")
        return Box(self.lower or domain.lower, self.upper or domain.upper)


class BoundaryShape(Kind, tag="boundary"):
    edges: Walls | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        shape = domain.boundary(self.edges)  # an error where there is none
        return domain if self.edges is None else shape


class CreasesShape(Kind, tag="creases"):
    edges: Walls | None = None
    concave: bool | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        return domain.crease_edges(self.edges, concave=self.concave)


class SurfaceShape(Kind, tag="surface"):
    file: Text
    closed: bool = False
    join: Positive | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        surface = sizing.Surface.read(locate(folder, self.file), **self.given("file", "closed"))
        if self.closed:
            surface.require_closed()
            if self.join is None:  # nearly coincident corners would make triangles intersect
                surface.check()
        return surface


class SegmentShape(Kind, tag="segment"):
    MAKE = sizing.Segment
    a: Point
    b: Point


class PolylineShape(Kind, tag="polyline"):
    MAKE = sizing.Polyline
    points: Annotated[list[Point], Meta(min_length=2)]


class ClosedPolylineShape(Kind, tag="closed_polyline"):
    MAKE = sizing.ClosedPolyline
    points: Annotated[list[Point], Meta(min_length=3)]


Shape = (
    CircleShape
    | BallShape
    | BoxShape
    | BoundaryShape
    | CreasesShape
    | SurfaceShape
    | SegmentShape
    | PolylineShape
    | ClosedPolylineShape
    | Arc
    | Ellipse
    | Naca
    | Spline
)


def _built(shapes: Any, folder: Path, domain: Any) -> list[Any]:
    """Return the shapes of a table, with the paths of those that are files of GeoJSON."""
    given = [shapes] if isinstance(shapes, str) else shapes
    return [locate(folder, s) if isinstance(s, str) else s.build(folder, domain) for s in given]


class PolygonShape(Kind, tag="polygon"):
    """Polygons in a file of GeoJSON or well-known text, or a ring of points with holes."""

    CHOICE = ("file", "outer")
    file: Text | None = None
    outer: Annotated[list[Plane], Meta(min_length=3)] | None = None
    holes: list[Annotated[list[Plane], Meta(min_length=3)]] | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        if self.file is None:
            return Polygon(self.outer, self.holes or [])
        return read_polygon(locate(folder, self.file), "size.shapes.file", planar=domain.map_domain is domain)


RegionShape = (
    CircleShape | BallShape | BoxShape | PolygonShape | SurfaceShape | ClosedPolylineShape | Ellipse | Naca | Spline
)

# Size fields.

_ON_SPHERE = "fields in a file, or caps, distance, expression, graded, raster or a combination of them"


class ConstantTable(Kind, tag="constant"):
    MAKE = sizing.Constant
    value: Positive


class CapTable(Table):
    center: Plane
    radius: NotNegative
    size: Positive


class CapsTable(Kind, tag="caps"):
    CHOICE = ("growth", "slope")
    regions: Annotated[list[CapTable], Meta(min_length=1)]
    h_max: Positive
    growth: Positive | None = None
    slope: Positive | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        remedy = 'distance, or kind = "sphere" in [domain]'
        _require(domain.globe is not None, self, remedy, domain)
        regions = [(r.center, r.radius, r.size) for r in self.regions]
        return earth.Caps(regions, sphere=domain.globe, **self.given("regions"))


class DistanceTable(Kind, tag="distance"):
    CHOICE = ("growth", "slope")
    shapes: Text | Annotated[list[Shape | Text], Meta(min_length=1)]
    h_min: Positive
    growth: Positive | None = None
    slope: Positive | None = None
    h_max: Positive | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        return sizing.Distance(_built(self.shapes, folder, domain), **self.given("shapes"))


class RegionTable(Kind, tag="region"):
    CHOICE = ("growth", "slope")
    shapes: Text | Annotated[list[RegionShape | Text], Meta(min_length=1)]
    h: Positive
    growth: Positive | None = None
    slope: Positive | None = None
    h_max: Positive | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        return sizing.Region(_built(self.shapes, folder, domain), **self.given("shapes"))


class ExpressionTable(Kind, tag="expression"):
    expression: Text

    def build(self, folder: Path, domain: Any = None) -> Any:
        return sizing.Expression(self.expression)


class ArrayTable(Kind):
    """A size field from an array in a file, over the box from `lower` to `upper`, by default over the domain."""

    file: Text
    lower: Point | None = None
    upper: Point | None = None
    at: Literal["nodes", "centers"] | None = None
    missing: Literal["error", "nearest"] | None = None

    def over(self, domain: Domain, values: np.ndarray) -> Any:
        """Return the values as a raster over `domain`, or between the corners that the table has."""
        corners = self.lower or domain.lower, self.upper or domain.upper
        given = {key: value for key, value in self.given().items() if key in ("at", "missing", "outside")}
        return sizing.Raster(values, *corners, **given)


class RasterTable(ArrayTable, tag="raster"):
    variable: Text | None = None
    outside: Literal["nearest", "error", "ignore"] | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        path = folder / self.file
        grid = read_grid(path, self.variable)
        if grid is not None:
            for key in self.given("file", "variable", "missing", "outside"):
                raise InputError(f"size.{key} is given, and {path} has longitudes and latitudes; leave it out")
            return earth.from_xarray(grid, **self.given("file", "variable"))
        if self.variable is not None:
            raise InputError(
                f"size.variable is {self.variable!r}, and {path} is neither a netCDF nor a .npz file; leave it out"
            )
        return self.over(domain.map_domain, load_array(path, "size.file"))


class CellsTable(Kind, tag="cells"):
    """Sizes in the cells, or at the points, of a file of any program."""

    file: Text
    field: Text
    time: float | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        mesh, values = read_fields(folder / self.file, self.field, domain=domain, time=self.time)
        return sizing.OnCells(mesh, values[self.field])


_OF_FIELDS, _OF_ARRAYS = ("time", "growth"), ("lower", "upper", "at", "missing")


class Gradient(ArrayTable, tag="gradient"):
    """Sizes from a solution: an array, or `fields` in the file of any program."""

    MAKE = staticmethod(sizing.gradient_size)
    CHOICE = ("n_cells", "eps")
    fields: Annotated[list[Text], Meta(min_length=1)] | None = None
    time: float | None = None
    growth: Positive | None = None
    n_cells: Positive | None = None
    eps: Positive | None = None
    h_min: NotNegative | None = None
    h_max: Positive | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        unused = self.given().keys() & set(_OF_FIELDS if self.fields is None else _OF_ARRAYS)
        if unused:
            other, remedy = ("without", "name fields") if self.fields is None else ("with", "leave it out")
            raise InputError(f"size has {', '.join(sorted(unused))} {other} fields; {remedy}")
        if self.fields is None:
            _require(domain.map_domain is domain, self, _ON_SPHERE, domain)
            solution = self.over(domain, load_array(folder / self.file, "size.file"))
            return type(self).MAKE(solution, **self.given("file", *_OF_ARRAYS))
        mesh, values = read_fields(folder / self.file, self.fields, domain=domain, time=self.time)
        return type(self).MAKE(list(values.values()), on=mesh, **self.given("file", "fields", "time"))


class Hessian(Gradient, tag="hessian"):
    MAKE = staticmethod(sizing.hessian_size)
    p: Positive | None = None


class Feature(Kind, tag="feature"):
    cells_across: Positive | None = None
    growth: Positive | None = None
    h_min: Positive | None = None
    h_max: Positive | None = None
    curvature: NotNegative | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        _require(domain.outline is not None, self, "distance, or a polygon in [domain]", domain)
        return sizing.FeatureSize(domain.outline, **self.given())


class GradedTable(Kind, tag="graded"):
    CHOICE = ("growth", "slope")
    field: Size
    growth: Positive | None = None
    slope: Positive | None = None
    resolution: Annotated[int, Meta(ge=2)] | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        return sizing.Graded(build_size(self.field, folder, domain), box=domain, **self.given("field"))


class Scale(Kind, tag="scale"):
    factor: Positive
    field: Size

    def build(self, folder: Path, domain: Any = None) -> Any:
        return self.factor * build_size(self.field, folder, domain)


class Min(Kind, tag="min"):
    MAKE = staticmethod(sizing.minimum)
    fields: Annotated[list[Size], Meta(min_length=1)]

    def build(self, folder: Path, domain: Any = None) -> Any:
        return type(self).MAKE(*(build_size(field, folder, domain) for field in self.fields))


class Max(Min, tag="max"):
    MAKE = staticmethod(sizing.maximum)


def _joined(operation: Callable[[Any, Any], Any]) -> Any:
    return staticmethod(lambda *fields: functools.reduce(operation, fields))


class Sum(Min, tag="sum"):
    MAKE = _joined(operator.add)


class Product(Min, tag="product"):
    MAKE = _joined(operator.mul)


class Quotient(Min, tag="quotient"):
    MAKE = _joined(operator.truediv)
    fields: Annotated[list[Size], Meta(min_length=2)]


Size = (
    Positive
    | ConstantTable
    | CapsTable
    | DistanceTable
    | RegionTable
    | ExpressionTable
    | RasterTable
    | CellsTable
    | Hessian
    | Gradient
    | Feature
    | GradedTable
    | Scale
    | Min
    | Max
    | Sum
    | Product
    | Quotient
)


def build_size(size: Any, folder: Path, domain: Domain) -> Any:
    """Return the size field that `size` describes, an instance of `Size`.

    `folder` is that of the files that it names; `domain` is the default extent of a raster.
    """
    return sizing.Constant(size) if isinstance(size, float) else size.build(folder, domain)


def _require(fits: bool, size: Kind, remedy: str, domain: Domain) -> None:
    if not fits:
        kind = size.__struct_config__.tag
        raise InputError(f"size.kind is {kind!r}, which is not for {domain}; expected {remedy}")


def load_points(path: Path, place: str) -> np.ndarray:
    """Read points from a file of GeoJSON, of comma-separated values, or of an array; `place` is the key that names it.

    Tables of values have a line with names of columns. Those of points are x, y and z, or lon and lat.

    Raises `InputError` if there is no such file or it holds no points.
    """
    if path.suffix.lower() in (".json", ".geojson"):
        shapes = list(geometries_of_geojson(path))
        wrong = {shape.geom_type for shape in shapes} - {"Point", "MultiPoint"}
        if wrong or not shapes:
            raise InputError(f"{place} names {str(path)!r} with {min(wrong, default='nothing')}, expected points alone")
        return shapely.get_coordinates(shapes)
    if path.suffix.lower() != ".csv":
        return load_array(path, place)
    try:
        rows = list(csv.DictReader(read_text(path, LONGEST_GEOMETRY).splitlines()))
        columns = {name.strip().lower(): name for name in (rows[0] if rows else {}) if name}
        wanted = ("x", "y", "z") if "x" in columns else ("lon", "lat")
        names = [columns[name] for name in wanted if name in columns]
        if len(names) < 2:
            raise ValueError(f"its columns are {', '.join(columns) or 'none'}")
        return np.array([[row[name] for name in names] for row in rows], float)
    except (OSError, TypeError, ValueError) as error:
        raise InputError(
            f"{place} names {str(path)!r}, which cannot be read ({error}), expected columns x and y, or lon and lat, "
            "with numbers"
        ) from error


def load_array(path: Path, place: str) -> np.ndarray:
    """Read an array from a `.npy` file, or the array `points` from a `.npz` file; `place` is the key that names it.

    Raises `InputError` if there is no such file or it holds no such array.
    """
    try:
        return read_array(path, "points")
    except InputError as error:
        raise InputError(
            f"{place} names {str(path)!r}, which cannot be read as an array ({error}); "
            "give a .npy file beside the case file, or fields = [...] of a file of another kind"
        ) from error


# Domains.


class BoxRing(Kind, tag="box"):
    """A rectangle as a ring of a domain."""

    lower: Plane
    upper: Plane

    def build(self, folder: Path, domain: Any = None) -> list[Plane]:
        (a, b), (c, d) = self.lower, self.upper
        if not (a < c and b < d):
            raise InputError(f"domain has a box from {self.lower} to {self.upper}, expected lower < upper")
        return [(a, b), (c, b), (c, d), (a, d)]


Names = dict[str, Walls]
RingCurve = CircleCurve | Arc | Ellipse | Naca | Spline
Ring = RingCurve | BoxRing | list[Plane | RingCurve]


def _ring(ring: Any) -> Any:
    if isinstance(ring, Kind):
        return ring.build(Path())
    return [item.build(Path()) if isinstance(item, CurveTable) else item for item in ring]


Line = RingCurve | Annotated[list[Plane], Meta(min_length=2)]


class SurfaceTable(Table):
    """A file of a surface inside a domain, its unit of length, and the name of the surface."""

    file: Text
    units: Text | Positive | None = None
    name: str | None = None


def _with_surfaces(domain: Any, surfaces: Text | list[SurfaceTable] | None, folder: Path) -> Any:
    """Return `domain` with surfaces inside: those of one file, or of a list of files with units and names."""
    if surfaces is None:
        return domain
    if isinstance(surfaces, str):
        return domain.with_surfaces(locate(folder, surfaces))
    made = []
    for surface in surfaces:
        path, unit = locate(folder, surface.file), unit_length(surface.units)
        parts = [(part.name, (unit * part.vertices, part.triangles)) for part in read_parts(path, SOLIDS)]
        if surface.name is None:
            made += [{name: arrays} if name else arrays for name, arrays in parts]
        else:
            vertices, triangles, _ = joined([FilePart("", *arrays) for _, arrays in parts])
            made.append({surface.name: (vertices, triangles)})
    return domain.with_surfaces(made)


def _with_lines(domain: Any, lines: Text | list[Line] | None, folder: Path) -> Any:
    """Return `domain` with the lines of a table: a file of GeoJSON, or a list of lines."""
    if lines is None:
        return domain
    if isinstance(lines, str):
        return domain.with_lines(locate(folder, lines))
    return domain.with_lines([line.build(folder) if isinstance(line, CurveTable) else line for line in lines])


class BoxTable(Kind, tag="box"):
    MAKE = Box
    lower: Point
    upper: Point
    periodic: bool | list[bool] | None = None
    names: Names | None = None
    lines: Text | list[Line] | None = None
    surfaces: Text | list[SurfaceTable] | None = None
    holes: list[Ring] | None = None
    hole_names: Names | None = None

    def build(self, folder: Path, domain: Any = None) -> Any:
        box = _with_surfaces(Box(**self.given("lines", "surfaces", "holes", "hole_names")), self.surfaces, folder)
        made = _with_lines(box, self.lines, folder)
        if self.holes is not None and len(self.lower) == 2 and not any(made.periodic):
            raise InputError(
                "domain is a box with holes and no periodic side; write it as "
                f'outer = {{ kind = "box", lower = {list(made.lower)}, upper = {list(made.upper)} }} with these holes'
            )
        return made if self.holes is None else made.without([_ring(hole) for hole in self.holes], self.hole_names)


class PolygonTable(Kind, tag="polygon"):
    CHOICE = ("file", "outer")
    file: Text | None = None
    outer: Ring | None = None
    holes: list[Ring] | None = None
    names: Names | None = None
    repair: bool = False
    simplified: Positive | None = None
    lines: Text | list[Line] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.file and self.holes:
            raise ValueError("has both a file and holes, expected holes beside outer only")

    def build(self, folder: Path, domain: Any = None) -> Polygon:
        domain = self._whole(folder)
        made = domain if self.simplified is None else domain.simplified(self.simplified)
        return _with_lines(made, self.lines, folder)

    def _whole(self, folder: Path) -> Polygon:
        if self.file is None:
            return Polygon(_ring(self.outer), [_ring(hole) for hole in self.holes or []], self.names, self.repair)
        return read_polygon(locate(folder, self.file), "domain.polygon", self.names, repair=self.repair)


class SphereTable(Kind, tag="sphere"):
    """A sphere; `land` names polygons in longitudes and latitudes whose cells are removed after the run."""

    radius: Positive | None = None
    land: Text | None = None

    def build(self, folder: Path, domain: Any = None) -> Sphere:
        return Sphere(**self.given("land"))


class Around(Table):
    """The box around a body: two corners, and names of its sides."""

    lower: Space
    upper: Space
    names: Names | None = None


class SolidTable(Kind, tag="solid", rename={"file": "solid"}):
    """The inside of a surface from one file or several, or with `outside` the region of a box around it."""

    file: Text | Annotated[list[Text], Meta(min_length=1)]
    units: Text | Positive | None = None
    outside: Around | None = None
    names: Names | None = None
    angle: Positive | None = None
    join: NotNegative | None = None
    repair: bool | None = None
    wrap: Positive | None = None
    inside: Space | None = None
    bottom: float | None = None
    surfaces: Text | list[SurfaceTable] | None = None

    def build(self, folder: Path, domain: Any = None) -> Solid:
        options = self.given("file", "units", "outside", "names", "surfaces")
        one = isinstance(self.file, str)
        path = locate(folder, self.file) if one else [locate(folder, file) for file in self.file]
        if self.outside is None:
            made = Solid.read(path, self.units, names=self.names, **options)
        else:
            box = Box(**self.outside.given())
            made = Solid.outside(Solid.read(path, self.units, **options), box, names=self.names)
        return _with_surfaces(made, self.surfaces, folder)


DomainTable = BoxTable | PolygonTable | SphereTable | SolidTable


def with_kind(domain: object, place: str) -> object:
    """Return the table `domain` with its key `kind`, which boxes, polygons and solids may leave out."""
    if not isinstance(domain, Mapping) or "kind" in domain:
        return domain
    if "solid" in domain and not {"lower", "upper", "polygon", "outer"} & set(domain):
        return {"kind": "solid", **domain}
    corners = [key for key in ("lower", "upper", "periodic") if key in domain]
    rings = [key for key in ("polygon", "outer") if key in domain]
    if corners and rings:
        raise InputError(
            f"{place} has both {corners[0]}, of a box, and {rings[0]}, of a polygon; leave one of them out"
        )
    if not corners and not rings:
        raise InputError(
            f"{place} is neither a box nor a polygon, a solid or a sphere, expected lower and upper, or outer, or "
            'polygon = FILE, or solid = FILE, or kind = "sphere"'
        )
    named = {"file" if key == "polygon" else key: value for key, value in domain.items()}
    return {"kind": "polygon" if rings else "box", **named}


def read_polygon(
    path: Path, key: str, names: Names | None = None, planar: bool = True, repair: bool = False
) -> Polygon:
    """Read polygons from a file of GeoJSON or well-known text; `key` names it in the case.

    Raises `InputError`.
    """
    if path.suffix.lower() in FOREIGN:
        raise InputError(
            f"{key} names {str(path)!r}, expected GeoJSON or well-known text; convert it, with GDAL: "
            f"ogr2ogr -t_srs EPSG:NUMBER {path.stem}.geojson {path.name}, where NUMBER is a projection in meters"
        )
    if path.suffix.lower() not in (".wkt", ".txt"):
        if planar:
            return Polygon.from_geojson(path, names, repair)
        return Polygon.from_pieces(pieces_of_geojson(path, planar=False)[0])
    try:
        text = read_text(path, LONGEST_GEOMETRY)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path} ({error}), expected well-known text") from error
    return Polygon.from_wkt(text, names, repair)


# The case.


class RunSettings(Table):
    method: MethodName | None = None
    methods: Annotated[list[MethodName], Meta(min_length=1)] | None = None
    effort: EffortName | None = None
    levels: Literal["auto"] | Natural | None = None
    error_target: Positive | None = None
    start: Start | None = None
    points: Text | None = None
    fixed: Text | Annotated[list[Point], Meta(min_length=1)] | None = None
    n_cells: Count | None = None
    max_steps: Natural | None = None
    tol: NotNegative | None = None
    alpha: Positive | None = None
    k: Positive | None = None
    seed: Natural | None = None
    dtype: Literal["float64", "float32"] | None = None

    def __post_init__(self) -> None:
        if self.method and self.methods:
            raise ValueError("has both method and methods; keep one of them")
        if len(set(self.methods or ())) < len(self.methods or ()):
            raise ValueError(f"has methods = {self.methods}, expected each name once")


class LayersTable(Table):
    """Layers of cells along edges or sides."""

    height: Positive
    count: Count | None = None
    growth: Positive | None = None
    spacing: Positive | None = None
    edges: Walls | None = None


class CaseTable(Table, kw_only=True):
    name: str | None = None
    title: Text | None = None
    domain: DomainTable
    size: Size
    run: RunSettings | None = None
    layers: Annotated[list[LayersTable], Meta(min_length=1)] | None = None
    patches: dict[str, PatchType] | None = None


def _keys(*tables: type[Table]) -> set[str]:
    return {key for table in tables for key in table.__struct_fields__}


HOMES = {
    "the case itself, above all tables": _keys(CaseTable),
    "[domain]": _keys(*get_args(DomainTable)),
    "[[domain.surfaces]]": _keys(SurfaceTable),
    "[size]": _keys(*get_args(Size)[1:]),
    "[run]": _keys(RunSettings),
    "[[layers]]": _keys(LayersTable),
}
"""The keys of each table."""


def check_case(content: object, place: str) -> CaseTable:
    """Check a whole case; see `checks.check`."""
    if isinstance(content, Mapping) and "domain" in content:
        content = {**content, "domain": with_kind(content["domain"], f"{place} domain")}
    return checks.check(CaseTable, content, place, HOMES)


def check_run(content: Mapping[str, object], place: str) -> RunSettings:
    """Check the settings of a run; see `checks.check`."""
    return checks.check(RunSettings, content, place, HOMES)
