"""Turn the checked `[domain]` table of a case into a domain."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from ...files import LONGEST_GEOMETRY, read_text
from ...geometry.boundary_layers import Layers
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
        Where the file that it names is looked for.
    """
    rest = {key: value for key, value in node.items() if key != "kind"}
    if node["kind"] == "box":
        return Box(**rest)
    if "file" not in node:
        return Polygon(_ring(node["outer"]), [_ring(hole) for hole in node.get("holes", [])])
    path = locate(folder, node["file"])
    if path.suffix.lower() not in (".wkt", ".txt"):
        return Polygon.from_geojson(path)
    try:
        text = read_text(path, LONGEST_GEOMETRY)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path} ({error}), expected well-known text") from error
    return Polygon.from_wkt(text)


def _ring(node: Any) -> np.ndarray:
    """Return the vertices of a ring: its own, or those of a shape."""
    if not isinstance(node, Mapping):
        return np.array(node, float)
    rest = {key: value for key, value in node.items() if key != "kind"}
    if node["kind"] == "naca4":
        return naca4(**rest)
    turn = np.linspace(0, 2 * np.pi, rest.get("n_points", 64), endpoint=False)
    return np.array(rest["center"]) + rest["radius"] * np.column_stack([np.cos(turn), np.sin(turn)])


def build_layers(node: Mapping[str, Any], domain: Domain) -> Layers:
    """Return the layers that `node` describes, a table that `schema.LAYERS` has passed, along walls of `domain`."""
    rest = {key: value for key, value in node.items() if key != "rings"}
    if "edges" in rest and isinstance(domain, Polygon):
        rest["edges"] = edges_of(domain, rest["edges"]).tolist()
    if "rings" not in node:
        return Layers(**rest)
    if not isinstance(domain, Polygon):
        raise InputError("layers has rings, expected a polygonal domain, or edges")
    starts = domain.ring_starts
    missing = [ring for ring in node["rings"] if ring >= len(starts) - 1]
    if missing:
        raise InputError(f"layers.rings has {missing}, expected 0 to {len(starts) - 2}")
    edges = [e for ring in node["rings"] for e in range(starts[ring], starts[ring + 1])]
    return Layers(**{**rest, "edges": sorted({*rest.get("edges", ()), *edges})})


def edges_of(domain: Polygon, numbers: list[int]) -> np.ndarray:
    """Return the edges of `domain` whose `numbers` are those of the rings as the case gives them."""
    unknown = np.setdiff1d(numbers, domain.edge_numbers)
    if unknown.size:
        raise InputError(
            f"edges has {unknown[0]}, expected numbers of edges of the domain's rings, from 0 to "
            f"{domain.edge_numbers.max()}"
        )
    return np.flatnonzero(np.isin(domain.edge_numbers, numbers))
