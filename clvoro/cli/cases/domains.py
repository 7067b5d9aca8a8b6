"""Turn the checked `[domain]` table of a case into a domain."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...files import LONGEST_GEOMETRY, read_text
from ...geometry.box import Box, Domain
from ...geometry.polygon import Polygon
from .files import locate
from .naca import naca4


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


def _ring(node: Any) -> np.ndarray:
    """Return the vertices of a ring: its own, or those of a shape."""
    if not isinstance(node, Mapping):
        return np.array(node, float)
    rest = {key: value for key, value in node.items() if key != "kind"}
    if node["kind"] == "naca4":
        return naca4(**rest)
    turn = np.linspace(0, 2 * np.pi, rest.get("n_points", 64), endpoint=False)
    return np.array(rest["center"]) + rest["radius"] * np.column_stack([np.cos(turn), np.sin(turn)])
