"""Size fields on a sphere: those of two dimensions take longitudes and latitudes, and growth is along great circles."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..geometry.sphere import Sphere
from ..opencl.engine import Engine
from ..sizing.distance import Distance
from ..sizing.evaluation import Sizing
from ..sizing.field import Combined, Field, Scaled, on_domain
from ..sizing.gradation import Gradation, globe_columns
from ..sizing.graded import BATCH, MOST_NODES, Graded, default_engine
from ..sizing.raster import Raster
from ..sizing.region import Region
from .sizes import ArcDistance, ArcRegion, LonLat

if TYPE_CHECKING:
    from ..geometry.domain import Domain
    from ..sizing.codegen import CodeWriter

_PROBES = 1 << 13
"""Positions that sample the smallest size."""
_COARSEST = 128
"""Least number of nodes along the equator."""


class ArcGraded(Field):
    """A `Graded` field on a sphere: ``h(x) = min over y of field(y) + slope (arc from x to y)``.

    It is computed on a grid of longitude and latitude whose nodes are the centers of pixels, by the scheme of
    `gradation.cl`. The grid is closed across the date line and across the poles.

    - `field`: the field of `given`, for positions on the sphere.

    Raises `InputError` if `given` has a box that is not this sphere, or several numbers as its resolution.
    """

    dim, on_sphere = 3, True

    def __init__(self, given: Graded, field: Field, sphere: Sphere) -> None:
        if given.box is not None and given.box != sphere:
            raise InputError(
                f"{given!r} has the box {given.box!r}, and on a sphere growth is limited everywhere; leave out box"
            )
        if isinstance(given.resolution, tuple):
            raise InputError(
                f"Graded resolution is {given.resolution}, expected one number on a sphere: the nodes along the equator"
            )
        self.given, self.field, self.sphere = given, field, sphere
        self.parts = given.parts

    def lonlat(self, engine: Engine | None = None) -> LonLat:
        """Return the field as a raster in longitude and latitude. It is computed once for each precision."""
        # A region of the sphere has the grid of the whole sphere.
        whole = Sphere(self.sphere.radius)
        known = self.given._rasters
        found = [raster for (box, _), raster in known.items() if box == whole]
        if engine is None and found:
            return LonLat(found[0])
        engine = engine or default_engine(3, whole.traits(np.dtype(np.float64)))
        key = (whole, engine.real)
        if key not in known:
            known[key] = self._compute(whole, engine)
        return LonLat(known[key])

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the landmarks of the raster as positions on the sphere."""
        return self.lonlat().landmarks(domain)

    def warnings(self, domain: Domain) -> list[str]:
        """Return the warnings of the field whose growth is limited."""
        return self.field.warnings(domain)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self.lonlat()._evaluate(points)

    def _emit(self, writer: CodeWriter) -> str:
        known = len(self.given._rasters)
        field = self.lonlat(writer.engine)
        if len(self.given._rasters) > known:
            writer.peak_bytes = max(writer.peak_bytes, self.given._peak_bytes)
        return field._emit(writer)

    def _compute(self, sphere: Sphere, engine: Engine) -> Raster:
        evaluate = Sizing(engine, sphere, self.field)
        marks = self.field.landmarks(sphere)
        at_marks = evaluate(marks) if len(marks) else np.zeros(0)
        nx = self._columns(sphere, evaluate, at_marks)
        ny = nx // 2
        self.given._check_room(nx * ny, engine)
        values = np.empty(nx * ny)
        for first in range(0, len(values), BATCH):
            flat = np.arange(first, min(first + BATCH, len(values)))
            values[flat] = evaluate(_nodes(sphere, nx, flat % nx, flat // nx))
        self._seed(sphere, values, nx, marks, at_marks)
        peak_bytes = evaluate.peak_bytes
        del evaluate  # frees its memory
        plane = Engine(engine.ctx, engine.queue, 2, engine.real, workspace=engine.workspace, pool=engine.pool)
        on_device = plane.upload(values / sphere.radius)
        self.given._peak_bytes = max(peak_bytes, on_device.nbytes)
        Gradation(plane, globe=True).sweep_tiles(
            on_device, (nx, ny), (2 * math.pi / nx, math.pi / ny), self.given.slope
        )
        limited = np.minimum(on_device.get().astype(float) * sphere.radius, values)
        return Raster(limited.reshape(ny, nx), (-180, -90), (180, 90), at="centers")

    def _columns(self, sphere: Sphere, evaluate: Callable[[np.ndarray], np.ndarray], at_marks: np.ndarray) -> int:
        """Return the number of nodes along the equator."""
        if isinstance(self.given.resolution, int):
            return globe_columns(self.given.resolution)
        least = min(evaluate(sphere.even_points(_PROBES)).min(), at_marks.min(initial=math.inf))
        wanted = max(2 * math.pi * sphere.radius / least, _COARSEST)
        columns = globe_columns(min(wanted, math.sqrt(2 * MOST_NODES)))
        while columns * columns // 2 > MOST_NODES:
            columns = globe_columns(columns - 64)
        return columns

    def _seed(self, sphere: Sphere, values: np.ndarray, nx: int, marks: np.ndarray, at_marks: np.ndarray) -> None:
        """Lower the nodes around each landmark to the values that it allows."""
        ny, spacing = nx // 2, 360 / nx
        lon, lat = sphere.lonlat(marks).T
        first = np.floor((lon + 180) / spacing - 0.5).astype(int)
        below = np.floor((lat + 90) / spacing - 0.5).astype(int)
        for column in (first, first + 1):
            for row in (below, below + 1):
                i, j = column % nx, np.clip(row, 0, ny - 1)
                away = np.linalg.norm(_nodes(sphere, nx, i, j) - marks, axis=1)
                np.minimum.at(values, i + nx * j, at_marks + self.given.slope * sphere.lengths(away))

    def __repr__(self) -> str:
        return repr(self.given)


def _nodes(sphere: Sphere, nx: int, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Return the positions (n, 3) of nodes of a grid with `nx` columns."""
    spacing = 360 / nx
    return sphere.positions(np.column_stack([column + 0.5, row + 0.5]) * spacing - (180, 90))


@on_domain.register
def on_sphere(domain: Sphere, field: Field) -> Field:
    """Return `field` for a sphere: fields of two dimensions are functions of longitude and latitude."""
    if isinstance(field, (Scaled, Combined)):
        return field.map_parts(lambda part: on_sphere(domain, part))
    if isinstance(field, Graded):
        return ArcGraded(field, on_sphere(domain, field.field), domain)
    if field.dim != 2 or isinstance(field, (LonLat, ArcDistance)):
        return field
    if isinstance(field, Region):
        return ArcRegion(field, domain)
    return ArcDistance(field, domain) if isinstance(field, Distance) else LonLat(field)
