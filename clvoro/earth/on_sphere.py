"""Size fields as they are on a sphere: those of two dimensions take longitudes and latitudes."""

from __future__ import annotations

from ..geometry.sphere import Sphere
from ..sizing.distance import Distance
from ..sizing.field import Combined, Field, Scaled
from ..sizing.graded import Graded
from ..sizing.on_domain import on_domain
from .graded import ArcGraded
from .sizes import ArcDistance, LonLat


@on_domain.register
def on_sphere(domain: Sphere, field: Field) -> Field:
    """Return `field` for a sphere: fields of two dimensions are functions of longitude and latitude.

    Raises
    ------
    InputError
        For a `Graded` field with a box.
    """
    if isinstance(field, (Scaled, Combined)):
        return field.map_parts(lambda part: on_sphere(domain, part))
    if isinstance(field, Graded):
        return ArcGraded(field, on_sphere(domain, field.field), domain)
    if field.dim != 2 or isinstance(field, (LonLat, ArcDistance)):
        return field
    return ArcDistance(field, domain) if isinstance(field, Distance) else LonLat(field)
