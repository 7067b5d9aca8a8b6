"""Read polygons from GeoJSON, well-known text, shapely and descriptions: rings, piece by piece."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from ..arguments import warn
from ..errors import InputError, InputTypeError, MismatchWarning
from ..files import LONGEST_GEOMETRY, read_text

_GEOGRAPHIC = re.compile(r"CRS:?84\b|EPSG:[\d.]*:?4326\b|WGS ?84$", re.IGNORECASE)
_ALIKE = 0.95  # lengths of degrees of longitude and latitude with at least this ratio count as equal
_FAR = 3  # distance from the equator, over the extent, from which coordinates are longitudes and latitudes
FOREIGN = (".shp", ".gpkg", ".kml", ".gml", ".fgb")
"""Files of maps that GeoPandas and GDAL read."""
_DEEPEST = 8  # nested parentheses: a MULTIPOLYGON has three, and GEOS uses a stack frame for each


def _parts_of(geometry: Any) -> list[Any]:
    """Return the geometries in a collection, also in collections within it."""
    inside = getattr(geometry, "geoms", None) if geometry.geom_type == "GeometryCollection" else None
    return [geometry] if inside is None else [part for item in inside for part in _parts_of(item)]


def pieces_of_shape(geometry: Any) -> list[list[np.ndarray]]:
    """Return the rings of a shapely Polygon or MultiPolygon, or of those in a collection, piece by piece."""
    if getattr(geometry, "geom_type", "") == "GeometryCollection":  # lines and points have no area
        geometry = shapely.union_all([part for part in _parts_of(geometry) if "Polygon" in part.geom_type])
    kind = getattr(geometry, "geom_type", type(geometry).__name__)
    if kind not in ("Polygon", "MultiPolygon"):
        several = isinstance(geometry, list | tuple | np.ndarray)
        hint = "; pass shapely.union_all(polygons)" if several else ""
        raise InputTypeError(f"geometry is a {kind}, expected a shapely Polygon or MultiPolygon{hint}")
    parts = geometry.geoms if kind == "MultiPolygon" else [geometry]
    found = [
        [np.asarray(ring.coords)[:, :2] for ring in (part.exterior, *part.interiors)]
        for part in parts
        if not part.is_empty
    ]
    if not found:
        raise InputError(f"geometry is an empty {kind}, expected at least one ring")
    return found


def pieces_of_wkt(text: str) -> list[list[np.ndarray]]:
    """Return the rings of a POLYGON or MULTIPOLYGON in well-known text, piece by piece."""
    if not isinstance(text, str):
        raise InputTypeError(f"text is a {type(text).__name__}, expected well-known text")
    letters = np.frombuffer(text.encode("utf-8", "replace"), np.uint8)
    brackets = letters[(letters == ord("(")) | (letters == ord(")"))]
    if np.where(brackets == ord("("), 1, -1).cumsum().max(initial=0) > _DEEPEST:
        raise InputError(
            f"text {text!r:.60} has more than {_DEEPEST} nested parentheses, expected a POLYGON or MULTIPOLYGON"
        )
    try:
        with np.errstate(all="ignore"):  # coordinates that are not finite are refused below
            geometry = shapely.from_wkt(text)
    except shapely.errors.GEOSException as error:
        numbers = " and finite numbers" if re.search(r"\bnan\b", text, re.IGNORECASE) else ""
        raise InputError(
            f"text {text!r:.60} is not well-known text ({error!s:.200}), expected closed rings{numbers}"
        ) from error
    return pieces_of_shape(geometry)


def pieces_of_geojson(
    source: str | PathLike[str] | Mapping[str, Any], planar: bool = True
) -> tuple[list[list[object]], dict[str, list[int]] | None]:
    """Read the polygons in a GeoJSON file, text or object. With `planar`, warn of longitudes and latitudes.

    Results:
    - `pieces`: for each polygon its outer ring and its holes.
    - `names`: names of boundaries and the numbers of their edges, from the property "boundaries" of Features.
    """
    found, name = read_geojson(source)
    names: dict[str, list[int]] = {}
    pieces: list[list[object]] = []
    _collect(found, name, pieces, names)
    if not pieces:
        raise InputError(f"{name} has no Polygon, expected at least one")
    if planar:
        _warn_of_degrees(found, pieces, name)
    return pieces, names or None


def read_geojson(source: Any) -> tuple[Any, str]:
    """Return the object in a GeoJSON file, text or object, and its name for error messages."""
    # Geometries of shapely, geopandas and other libraries.
    source = getattr(source, "__geo_interface__", source)
    if isinstance(source, Mapping):
        return source, "GeoJSON"
    if not isinstance(source, (str, PathLike)):
        raise InputTypeError(f"source is a {type(source).__name__}, expected a path, a text or a dict of GeoJSON")
    name = "GeoJSON"
    text = source if isinstance(source, str) and source.lstrip().startswith("{") else None
    if text is None:
        name = str(source)
        if (suffix := Path(source).suffix.lower()) in (*FOREIGN, ".csv"):
            array = "pass points as an array, as numpy.loadtxt reads it"
            shape = "pass geopandas.read_file(path).union_all(), for a polygon by Polygon.from_shapely, or convert it"
            raise InputError(f"{name} is a {suffix} file, expected GeoJSON; {array if suffix == '.csv' else shape}")
        try:
            text = read_text(source, LONGEST_GEOMETRY)
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"cannot read {name} ({error}), expected GeoJSON") from error
    try:
        return json.loads(text), name
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is not JSON ({error}), expected GeoJSON") from error


def geometries_of_geojson(source: Any) -> Iterator[Any]:
    """Yield the geometries of all features in a GeoJSON file, text or object, as those of shapely."""
    found, name = read_geojson(source)
    nodes = [found]
    while nodes:
        node = nodes.pop()
        kind = node.get("type") if isinstance(node, Mapping) else None
        if kind == "FeatureCollection":
            nodes += reversed(list(node.get("features") or ()))
        elif kind == "Feature":
            nodes.append(node.get("geometry"))
        elif node is not None:  # features may have no geometry
            try:
                yield shapely.geometry.shape(dict(node))
            except Exception as error:
                raise InputError(f"{name} has {node!r:.60} ({error!s:.100}), expected GeoJSON") from error


def pieces_of_description(values: Mapping[str, Any]) -> list[list[np.ndarray]]:
    """Return the rings in the values that `Polygon.describe` returns, piece by piece."""
    if "edge_numbers" in values:
        raise InputError(
            "the Polygon was written by an earlier version of clvoro, which numbered its edges in another order; "
            "make the mesh again"
        )
    try:
        starts = np.array(values["ring_starts"], np.int32)
        pieces = np.array(values["piece_of_ring"], np.int32)
        vertices = np.array(values["vertices"], float)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"the description of a Polygon is damaged ({error})") from error
    steps = np.diff(pieces, prepend=-1)
    if not (
        starts.shape == (len(pieces) + 1,)
        and pieces.size
        and (np.diff(starts, prepend=0) >= 0).all()
        and (steps * (steps - 1) == 0).all()
        and pieces[0] == 0
        and vertices.shape == (starts[-1], 2)
    ):
        raise InputError("the description of a Polygon is damaged: its arrays do not match")
    # Close the rings: a last vertex equal to the first one would be dropped as the closing one.
    rings = [np.concatenate([vertices[a:b], vertices[a : a + 1]]) for a, b in pairwise(starts)]
    firsts = [*np.flatnonzero(steps), len(rings)]
    return [rings[a:b] for a, b in pairwise(firsts)]


def may_be_degrees(lower: Sequence[float], upper: Sequence[float]) -> bool:
    """Return whether a bounding box can be one of longitudes and latitudes."""
    return -180 <= lower[0] and upper[0] <= 360 and -90 <= lower[1] and upper[1] <= 90


def _warn_of_degrees(node: Any, pieces: list[list[object]], name: str) -> None:
    """Warn if GeoJSON has longitudes and latitudes, by its crs or apparently, and their degrees differ in length.

    Without a crs the standard says that these are longitudes and latitudes, but plans in meters are written so, too.
    They lie around the origin or beside it.
    """
    crs = node.get("crs")
    properties = crs.get("properties") if isinstance(crs, Mapping) else None
    system = properties.get("name") if isinstance(properties, Mapping) else None
    if isinstance(system, str) and not _GEOGRAPHIC.search(system):
        return
    try:
        x = np.concatenate([np.asarray(ring, float).reshape(-1, 2) for p in pieces for ring in p])
    except (ValueError, TypeError):  # `make_rings` raises a better error
        return
    if len(x) and may_be_degrees(x.min(axis=0).tolist(), x.max(axis=0).tolist()):
        text = squeezed(x, name, system if isinstance(system, str) else None)
        if text:
            warn(text, MismatchWarning)


def squeezed(x: np.ndarray, name: str, system: str | None = None) -> str:
    """Return a warning if `x` (k, 2) look like degrees whose lengths differ, else an empty text.

    Without a coordinate reference `system` they are degrees only if they lie far from the equator for their extent.
    """
    fits = may_be_degrees(x.min(axis=0).tolist(), x.max(axis=0).tolist())
    if not fits or (system is None and np.abs(x).min(axis=0)[1] < _FAR * np.ptp(x, axis=0).max()):
        return ""
    latitude = float(np.abs(x[:, 1]).max())
    ratio = math.cos(math.radians(latitude))
    if ratio >= _ALIKE:
        return ""
    has = "coordinates like degrees" if system is None else f"longitudes and latitudes ({system})"
    return (
        f"{name} has {has}, which are used as lengths in the plane: at latitude {latitude:.3g} cells would be "
        f"{ratio:.2g} times as wide as high; project the coordinates first"
        f"{', or remove the crs if they are projected' if system else ''}"
    )


_MEMBERS = {"FeatureCollection": "features", "GeometryCollection": "geometries"}


def _collect(node: object, name: str, pieces: list[list[object]], names: dict[str, list[int]]) -> None:
    """Walk through collections and features; append the rings of each polygon to `pieces`, and add to `names`."""
    kind = node.get("type") if isinstance(node, Mapping) else None
    if not isinstance(node, Mapping) or not isinstance(kind, str):
        raise InputError(f"{name} has {node!r:.40}, expected an object with a type")
    if kind in _MEMBERS:
        for member in _list(node, _MEMBERS[kind], name):
            _collect(member, name, pieces, names)
    elif kind == "Feature":
        if node.get("geometry") is None:
            raise InputError(f"{name} has a Feature without geometry, expected Polygons only; leave it out")
        before = len(pieces)
        _collect(node["geometry"], name, pieces, names)
        _add_names(node.get("properties"), name, pieces, before, names)
    elif kind == "Polygon":
        pieces.append([_flat(ring, name) for ring in _list(node, "coordinates", name)])
    elif kind == "MultiPolygon":
        for piece in _list(node, "coordinates", name):
            if not isinstance(piece, (list, tuple)):
                raise InputError(f"{name} has a MultiPolygon of {piece!r:.40}, expected lists")
            pieces.append([_flat(ring, name) for ring in piece])
    else:
        raise InputError(f"{name} has a {kind!r:.40}, expected Polygon or MultiPolygon only; leave others out")


def _add_names(
    properties: object, name: str, pieces: list[list[object]], before: int, names: dict[str, list[int]]
) -> None:
    """Add the names of a feature's boundaries to `names`; its own pieces follow the first `before` ones."""
    given = properties.get("boundaries") if isinstance(properties, Mapping) else None
    if not isinstance(given, Mapping):
        return
    counts = [sum(map(_count_edges, piece)) for piece in pieces]
    first, count = sum(counts[:before]), sum(counts[before:])
    for key, edges in given.items():
        numbers = edges if isinstance(edges, list | tuple) else [edges]
        for number in numbers:
            if type(number) is not int or not 0 <= number < count:
                raise InputError(
                    f"{name} has the boundary {key!r:.40} with {number!r:.40}, expected numbers of edges of its "
                    f"Feature, 0 to {count - 1}"
                )
        names.setdefault(key, []).extend(first + number for number in numbers)


def _count_edges(ring: object) -> int:
    if not isinstance(ring, list):
        return 0
    return len(ring) - (len(ring) > 1 and ring[0] == ring[-1])


def _flat(ring: object, name: str) -> object:
    """Drop z coordinates."""
    if not isinstance(ring, (list, tuple)):
        raise InputError(f"{name} has the ring {ring!r:.40}, expected a list of positions")
    for k, p in enumerate(ring):
        # NumPy would convert these to numbers.
        if isinstance(p, (list, tuple)) and any(type(c) in (bool, str) for c in p[:2]):
            raise InputError(f"{name} has the position {p!r:.60} at {k} of a ring, expected numbers")
    return [p[:2] if isinstance(p, (list, tuple)) else p for p in ring]


def _list(node: Mapping[str, Any], member: str, name: str) -> Sequence[Any]:
    found = node.get(member)
    if not isinstance(found, (list, tuple)):
        raise InputError(f"{name} has a {node['type']} with {member} {found!r:.40}, expected a list")
    return found
