"""Domains in files: what a domain says of itself, and the domain from that."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..geometry import box, polygon, sphere, sphere_region  # noqa: F401 - so that their classes are found by name
from ..geometry.domain import Domain
from .arrays import FileError


def describe(domain: Domain) -> dict[str, Any]:
    """Return a domain of any kind as numbers, strings and lists."""
    return {"kind": type(domain).__name__, **domain.describe()}


def described(description: Mapping[str, Any]) -> Domain:
    """Return the domain that `describe` has described.

    Raises
    ------
    FileError
        If no class of this name is known.
    """
    values = dict(description)
    kind = values.pop("kind")
    if kind not in Domain.kinds:
        known = ", ".join(Domain.kinds)
        raise FileError(f"its domain is a {kind!r:.40}, expected one of {known}; import the class before")
    return Domain.kinds[kind].described(**values)
