"""Size fields on a sphere: those of two dimensions take longitudes and latitudes, and growth is along great circles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..geometry.sphere import Sphere
from ..sizing.distance import Distance
from ..sizing.field import Combined, Field, Scaled, on_domain
from ..sizing.graded import Graded
from ..sizing.region import Region
from .sizes import ArcDistance, ArcRegion, LonLat

if TYPE_CHECKING:
    from ..geometry.domain import Domain
    from ..sizing.codegen import CodeWriter


class ArcGraded(Field):
    """A `Graded` field on a sphere: ``h(x) = min over y of field(y) + slope (arc from x to y)``.

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

    def lonlat(self, writer: CodeWriter | None = None) -> LonLat:
        """Return the field as a raster in longitude and latitude. It is computed once for each precision."""
        # A region of the sphere has the grid of the whole sphere.
        whole = Sphere(self.sphere.radius)
        return LonLat(self.given.raster(whole) if writer is None else self.given.raster_for(writer, whole))

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the landmarks of the raster as positions on the sphere."""
        return self.lonlat().landmarks(domain)

    def warnings(self, domain: Domain) -> list[str]:
        """Return the warnings of the field whose growth is limited."""
        return self.field.warnings(domain)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self.lonlat()._evaluate(points)

    def _emit(self, writer: CodeWriter) -> str:
        return self.lonlat(writer)._emit(writer)

    def __repr__(self) -> str:
        return repr(self.given)


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
