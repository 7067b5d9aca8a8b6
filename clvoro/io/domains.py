"""Domains in files: what a domain says of itself, and the domain from that."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..geometry.box import Box
from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from ..geometry.sphere import Sphere
from ..geometry.sphere_region import SphereRegion
from .arrays import FileError

_DOMAINS = {"Box": Box, "Polygon": Polygon.described, "Sphere": Sphere, "SphereRegion": SphereRegion}


def describe(domain: Domain) -> dict[str, Any]:
    """Return a domain of any kind as numbers, strings and lists."""
    return {"kind": type(domain).__name__, **domain.describe()}


def described(description: Mapping[str, Any]) -> Domain:
    """Return the domain that `describe` has described.

    Raises
    ------
    FileError
        If this version of clvoro has no such domain.
    """
    values = dict(description)
    kind = values.pop("kind")
    if kind not in _DOMAINS:
        raise FileError(f"its domain is a {kind!r:.40}, which this version of clvoro does not have")
    return _DOMAINS[kind](**values)
