"""Spheres: the whole one, and regions of cells that are left of one; areas and arcs on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..arguments import check_integer, check_number, check_rows
from ..errors import InputError
from ..opencl.engine import Traits
from .boundary_names import BoundaryNames, Walls
from .box import Box
from .domain import LARGEST_EDGE, Chart, Domain

DEGREES = Box((-180, -90), (180, 90))
"""All longitudes and latitudes."""
_SHORT = 1e-4
"""Square of the sine of an arc below which a series replaces a difference."""


def triangle_areas(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the areas of triangles of great circles with the corners a, b, c, unit vectors (n, 3) each: (n,).

    An area is positive if the corners are counter-clockwise as seen from outside, and smaller than 2 pi. With E the
    area, tan(E / 2) = a.(b x c) / (1 + a.b + b.c + c.a) (Van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30 (1983)
    125). The triple product is that of differences, so that small triangles keep their digits.
    """
    volume = (a * np.cross(b - a, c - a)).sum(axis=1)
    cosines = (a * b + b * c + c * a).sum(axis=1)
    return 2 * np.arctan2(volume, 1 + cosines)


def arc_excess(sines: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """Return arc / sin(arc) - 1 for arcs with the given sines, not negative, and cosines."""
    s2 = sines**2
    series = s2 * (1 / 6 + s2 * (3 / 40 + s2 * (5 / 112)))
    direct = np.arctan2(sines, cosines) / np.where(s2 > _SHORT, sines, 1.0) - 1
    return np.where((s2 > _SHORT) | (cosines < 0), direct, series)


EARTH_RADIUS = 6371229.0
"""Radius of the Earth in meters as ocean and atmosphere models have it."""


def directions(points: np.ndarray) -> np.ndarray:
    """Return longitudes in [-180, 180] and latitudes of vectors (n, 3) of any length, in degrees, (n, 2)."""
    x, y, z = points.T
    return np.degrees(np.column_stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))]))


def farthest_place(points: np.ndarray) -> tuple[float, float, float]:
    """Return longitude and latitude of about the place farthest from `points` on the unit sphere, and that distance."""
    places = Sphere(1).even_points(4000)
    chord = np.asarray(scipy.spatial.KDTree(points).query(places)[0])
    lon, lat = directions(places[chord.argmax() :][:1])[0]
    return float(lon), float(lat), float(np.degrees(2 * np.arcsin(min(chord.max() / 2, 1))))


@dataclass(frozen=True, eq=False)
class Sphere(Domain):
    """The surface of a sphere around the origin.

    Positions are vectors (x, y, z) of the length `radius`; the z axis goes through the north pole, and the x axis
    through the equator at longitude 0. Functions that take positions also take longitudes and latitudes, arrays
    (n, 2) in degrees. Lengths are those of great circles, and areas those of the sphere.

    Parameters
    ----------
    radius : float
        By default that of the Earth in meters.

    Raises
    ------
    InputError, InputTypeError
        If the radius is not a positive number.

    Examples
    --------
    >>> earth = clvoro.Sphere()
    >>> earth.radius, round(earth.measure / 1e12)
    (6371229.0, 510)
    >>> clvoro.Sphere(1).positions([(0, 0), (90, 0), (0, 90)]).round(15).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """

    radius: float = EARTH_RADIUS

    # Not fields of the dataclass: random starts of so few generators leave a side of the sphere free.
    evenly_below = 200
    for_c_grids = True

    def __post_init__(self) -> None:
        check_number("Sphere radius", self.radius, above=0)
        if not 1 / LARGEST_EDGE <= self.radius <= LARGEST_EDGE:
            raise InputError(
                f"Sphere radius is {self.radius:g}, expected {1 / LARGEST_EDGE:g} to {LARGEST_EDGE:g}, so that areas "
                "and moments of cells do not overflow; choose another unit of length"
            )
        object.__setattr__(self, "radius", float(self.radius))

    @property
    def lower(self) -> tuple[float, ...]:  # type: ignore[override]
        """Lower corner of the bounding box."""
        return (-self.radius,) * 3

    @property
    def upper(self) -> tuple[float, ...]:  # type: ignore[override]
        """Upper corner of the bounding box."""
        return (self.radius,) * 3

    @property
    def cell_dim(self) -> int:
        """2: cells have areas."""
        return 2

    region = None  # type: ignore[assignment]

    @property
    def map_domain(self) -> Domain:
        """Longitudes and latitudes in degrees."""
        return DEGREES

    def same_surface(self, other: Domain) -> bool:
        """Return whether `other` is on the same sphere."""
        return other.globe is not None and other.globe.radius == self.radius

    @property
    def largest_size(self) -> float:
        """The radius."""
        return self.radius

    def least_cells(self, adapted: bool) -> int:
        """Return the least number of cells: fewer leave a half free, at once or while sizes are `adapted`."""
        return 20 if adapted else 4

    @property
    def measure(self) -> float:
        """Area."""
        return 4 * np.pi * self.radius**2

    @property
    def globe(self) -> Sphere:
        """The sphere itself."""
        return self

    @cached_property
    def landmarks(self) -> np.ndarray:
        """The vertices of an icosahedron and the middles of its edges, (42, 3)."""
        return self.icosahedral_points(1)

    @property
    def boundary_measure(self) -> float:
        """0: a sphere has no boundary."""
        return 0.0

    def wall_planes(self, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return no planes: a sphere has no walls."""
        return np.empty((len(walls), 3)), np.empty((len(walls), 3))

    def closest_walls(self, points: np.ndarray) -> np.ndarray:
        """Return -1 for each of `points` (n, 3): a sphere has no walls."""
        return np.full(len(points), -1)

    def boundary_distance(self, points: np.ndarray) -> np.ndarray:
        """Return an infinite distance for each of `points` (n, 3): (n,)."""
        return np.full(len(points), np.inf)

    def default_names(self) -> BoundaryNames:
        """Return the parts of the boundary with their default names."""
        return BoundaryNames((), np.empty(0, np.int32), "side")

    def boundary(self, walls: Walls | None = None) -> NoReturn:
        """Raise an error, because a sphere has no boundary."""
        del walls
        raise InputError("a Sphere has no boundary; expected a Box or a Polygon")

    def describe(self) -> dict[str, Any]:
        """Return the arguments of this sphere."""
        return {"radius": self.radius}

    def positions(self, lonlat: ArrayLike) -> np.ndarray:
        """Return the positions (n, 3) of longitudes and latitudes (n, 2) in degrees.

        Raises
        ------
        InputError, InputTypeError
            If `lonlat` is not an array of finite numbers of that shape, or a latitude is beyond 90 degrees.
        """
        return self._positions("lonlat", lonlat)

    def _positions(self, name: str, lonlat: object) -> np.ndarray:
        given = check_rows(name, lonlat, 2)
        bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
        if bad.size:
            raise InputError(f"{name}[{bad[0]}] is {given[bad[0]]}, expected finite numbers")
        far = np.flatnonzero((np.abs(given[:, 1]) > 90) | (np.abs(given[:, 0]) > 720))
        if far.size:
            raise InputError(
                f"{name}[{far[0]}] is {given[far[0]]}, expected a longitude and a latitude (-90 to 90) in degrees"
            )
        lon, lat = np.radians(given).T
        # Exact at the poles and on the axes.
        quarter = np.abs(given[:, 1]) == 90
        c, s = np.where(quarter, 0, np.cos(lat)), np.where(quarter, np.sign(lat), np.sin(lat))
        return self.radius * np.column_stack([c * np.cos(lon), c * np.sin(lon), s])

    def placed(self, what: str, places: np.ndarray, on_globe: bool) -> np.ndarray:
        """Return places (n, k) of another program on this sphere; theirs may have another radius."""
        if on_globe:
            return self.positions(places)
        x = super().placed(what, places, on_globe)
        lengths = np.linalg.norm(x, axis=1)
        if not (lengths > 0).all() or np.ptp(lengths) > 1e-3 * lengths.max():
            raise InputError(f"{what} has points off a sphere around (0, 0, 0); give a box or a solid as domain")
        return x * (self.radius / lengths)[:, None]

    def icosahedral_points(self, bisections: int) -> np.ndarray:
        """Return the vertices of an icosahedron whose edges are bisected repeatedly, 10 * 4^k + 2 positions (n, 3).

        Raises
        ------
        InputError, InputTypeError
            If `bisections` is not an integer from 0 to 11.
        """
        k = check_integer("bisections", bisections, 0)
        if k > 11:
            raise InputError(f"bisections is {k}, expected at most 11, which are 42 million points")
        golden = (1 + np.sqrt(5)) / 2
        one = np.array([(a, b * golden, 0.0) for a in (1, -1) for b in (1, -1)])
        x = np.concatenate([one, np.roll(one, 1, axis=1), np.roll(one, 2, axis=1)])
        x /= np.linalg.norm(x[0])
        triangles = scipy.spatial.ConvexHull(x).simplices
        for _ in range(k):
            pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
            edges, of = np.unique(pairs, axis=0, return_inverse=True)
            a, b, c = (len(x) + of.reshape(-1, 3)).T
            p, q, r = triangles.T
            triangles = np.concatenate([np.column_stack(t) for t in ((p, a, c), (q, b, a), (r, c, b), (a, b, c))])
            middle = x[edges].sum(axis=1)
            x = np.concatenate([x, middle / np.linalg.norm(middle, axis=1)[:, None]])
        return self.radius * x

    def chart(self) -> Chart:
        """Return the box of r longitude and r sin(latitude): Lambert's cylindrical equal-area projection."""
        r = self.radius

        def position(points: np.ndarray) -> np.ndarray:
            lon, sine = np.asarray(points, float).reshape(-1, 2).T / r
            cosine = np.sqrt(np.maximum((1 - sine) * (1 + sine), 0))
            return r * np.column_stack([cosine * np.cos(lon), cosine * np.sin(lon), sine])

        def place(points: np.ndarray) -> np.ndarray:
            x, y, z = (np.asarray(points, float).reshape(-1, 3) / r).T
            return r * np.column_stack([np.arctan2(y, x), np.clip(z / np.hypot(np.hypot(x, y), z), -1, 1)])

        return Chart(Box((-np.pi * r, -r), (np.pi * r, r)), position, place)

    def even_points(self, n: int) -> np.ndarray:
        """Return `n` evenly spread positions (n, 3), on a spiral in golden angles (Fibonacci lattice)."""
        z = 1 - (2 * np.arange(n) + 1) / n
        turn, r = np.pi * (3 - np.sqrt(5)) * np.arange(n), np.sqrt(1 - z * z)
        return self.radius * np.column_stack([r * np.cos(turn), r * np.sin(turn), z])

    def lonlat(self, points: ArrayLike) -> np.ndarray:
        """Return longitudes in [-180, 180] and latitudes of positions (n, 3), in degrees, (n, 2)."""
        return directions(np.asarray(points, float))

    def lengths(self, chords: ArrayLike) -> np.ndarray:
        """Return the lengths of the arcs of great circles over chords, (n,)."""
        return 2 * self.radius * np.arcsin(np.minimum(np.asarray(chords) / (2 * self.radius), 1))

    def tangents(self, points: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return two unit vectors tangential to the sphere at positions (n, 3), each (n, 3).

        The second one is counter-clockwise from the first as seen from outside. They do not depend continuously on the
        position (Duff et al. 2017, Building an orthonormal basis, revisited).
        """
        x, y, z = (np.asarray(points, float) / self.radius).T
        sign = np.where(z < 0, -1.0, 1.0)
        s = -1 / (sign + z)
        t = x * y * s
        one = np.column_stack([1 + sign * x * x * s, sign * t, -sign * x])
        return one, np.column_stack([t, sign + y * y * s, -y])

    def check_rows(self, name: str, points: object) -> np.ndarray:
        """Return positions of any length (n, 3), or longitudes and latitudes (n, 2), as positions on the sphere (n, 3).

        Raises `InputError` or `InputTypeError` if `points` is not an array of real numbers of such a shape, or a row is
        zero or not finite.
        """
        shape = np.shape(points) if isinstance(points, list | tuple | np.ndarray) else ()
        if len(shape) == 2 and shape[1] == 2:
            return self._positions(name, points)
        x = check_rows(name, points, 3)
        with np.errstate(over="ignore", invalid="ignore"):
            length = np.hypot(np.hypot(x[:, 0], x[:, 1]), x[:, 2])
            bad = np.flatnonzero(~(np.isfinite(length) & (length > 0)))
        if bad.size:
            raise InputError(
                f"{name}[{bad[0]}] is {x[bad[0]]}, expected a position on the sphere, or a vector towards one"
            )
        return self.radius * (x / length[:, None])

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return True for each of `points`, (n, 3) or longitudes and latitudes (n, 2): (n,) bool."""
        return np.ones(len(self.check_rows("points", points)), bool)

    def inner_points(self) -> np.ndarray:
        """Return the place at longitude 0 on the equator, (1, 3)."""
        return np.array([(self.radius, 0.0, 0.0)])

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """Return the nearest position on the sphere to each of `points` (n, 3)."""
        return self.wrap(points)

    def place_name(self, x: np.ndarray) -> str:
        """Return the longitude and latitude of a position (3,) in words."""
        lon, lat = self.lonlat(np.asarray(x)[None])[0]
        return f"longitude {lon:.6g}, latitude {lat:.6g}"

    def wrap(self, points: np.ndarray) -> np.ndarray:
        """Return the positions on the sphere, (n, 3), in the direction of `points`."""
        x = np.asarray(points, float)
        return self.radius * (x / np.linalg.norm(x, axis=1, keepdims=True))

    def onto(self, points: np.ndarray) -> np.ndarray:
        """Return the positions on the sphere, (n, 3), in the direction of `points`."""
        return self.wrap(points)

    def along_surface(self, vectors: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the parts of `vectors` (n, 3) in the planes that touch the sphere at `points` (n, 3)."""
        up = points / self.radius
        return vectors - (vectors * up).sum(axis=1)[:, None] * up

    def triangle_areas(self, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Return the areas of triangles of great circles with the corners `a`, `b`, `c` (n, 3): (n,)."""
        return self.radius**2 * triangle_areas(*(self.wrap(x) / self.radius for x in (a, b, c)))

    @property
    def frame(self) -> tuple[np.ndarray, float]:
        """Origin and scale of the device's coordinates: unit vectors."""
        return np.zeros(3), self.radius

    def given_weights(self, weights: np.ndarray) -> np.ndarray:
        """Return the given weights (n,) of those w that generators have on the device: 2 log(1 + w / 2)."""
        return 2 * np.log1p(weights / 2)

    def lift(self, points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return as for other domains: with s_i = exp((w_i - max w) / (2 R^2)), s_i x_i and R sqrt(1 - s_i^2).

        From there the square of the distance to y is 2 R^2 - 2 s_i x_i.y.
        """
        less = np.expm1((weights - weights.max()) / (2 * self.radius**2))
        return less[:, None] * points, self.radius * np.sqrt(-less * (2 + less))

    def plane_shares(self, squares: np.ndarray, excess: np.ndarray) -> np.ndarray:
        """Return as for other domains; the planes contain the center of the sphere."""
        lift, rise = np.expm1(-excess / (2 * self.radius**2)), squares / (2 * self.radius**2)
        return (lift + rise) / ((2 + lift) * rise)

    def traits(self, real: np.dtype) -> Traits:
        """Return for what kernels are built."""
        del real
        return Traits(("SPHERE",), curved=True)
