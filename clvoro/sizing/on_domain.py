"""Size fields as they are on a domain: on a sphere those of two dimensions take longitudes and latitudes."""

from __future__ import annotations

from ..geometry.domain import Domain
from ..geometry.sphere import Sphere
from .distance import Distance
from .field import Combined, Field, Scaled
from .graded import Graded
from .graded_sphere import ArcGraded
from .lonlat import ArcDistance, LonLat


def on_domain(field: Field, domain: Domain) -> Field:
    """Return `field` for `domain`: on a sphere fields of two dimensions are functions of longitude and latitude.

    Raises
    ------
    InputError
        For a `Graded` field with a box on a sphere.
    """
    if not isinstance(domain, Sphere):
        return field
    if isinstance(field, (Scaled, Combined)):
        return field.map_parts(lambda part: on_domain(part, domain))
    if isinstance(field, Graded):
        return ArcGraded(field, on_domain(field.field, domain), domain)
    if field.dim != 2 or isinstance(field, (LonLat, ArcDistance)):
        return field
    return ArcDistance(field, domain) if isinstance(field, Distance) else LonLat(field)
