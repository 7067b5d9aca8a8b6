"""Turn the checked `[domain]` table of a case into a domain."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...files import LONGEST_GEOMETRY, read_text
from ...geometry.box import Box
from ...geometry.curves import Curve
from ...geometry.domain import Domain
from ...geometry.polygon import Polygon
from ...geometry.sphere import Sphere
from .files import locate


def build_domain(node: Mapping[str, Any], folder: Path) -> Domain:
    """Return the domain that `node` describes.

    Parameters
    ----------
    node : mapping
        A table that `schema.DOMAIN` has passed.
    folder : Path
        Folder of the file that it names.
    """
    rest = {key: value for key, value in node.items() if key != "kind"}
    if node["kind"] == "box":
        return Box(**rest)
    if node["kind"] == "sphere":
        return Sphere(**rest)
    domain = _polygon(node, folder)
    return domain.simplified(node["simplified"]) if "simplified" in node else domain


def _polygon(node: Mapping[str, Any], folder: Path) -> Polygon:
    names = node.get("names")
    if "file" not in node:
        return Polygon(_ring(node["outer"]), [_ring(hole) for hole in node.get("holes", [])], names)
    path = locate(folder, node["file"])
    if path.suffix.lower() not in (".wkt", ".txt"):
        return Polygon.from_geojson(path, names)
    try:
        text = read_text(path, LONGEST_GEOMETRY)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path} ({error}), expected well-known text") from error
    return Polygon.from_wkt(text, names)


def _ring(node: Any) -> Any:
    """Return a ring: a curve, or points and curves."""
    if isinstance(node, Mapping):
        return Curve.described(node)
    return [Curve.described(item) if isinstance(item, Mapping) else item for item in node]
