"""Turn the checked size tree of a case into an object of `clvoro.sizing`."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ... import earth, sizing
from ...earth.sizes import DEGREES
from ...errors import InputError
from ...geometry.box import Box
from ...geometry.curves import Curve
from ...geometry.domain import Domain
from ...geometry.polygon import Polygon
from ...geometry.sphere import Sphere
from ...io.arrays import read_array
from .files import locate
from .grids import read_grid


def build_size(node: Mapping[str, Any], folder: Path, domain: Domain) -> Any:
    """Return the size field that `node` describes.

    Parameters
    ----------
    node : mapping
        A tree that `schema.size` has passed.
    folder : Path
        Folder of the files that it names.
    domain : Domain
        Default extent of a raster.
    """

    def inner(child: Mapping[str, Any]) -> Any:
        return build_size(child, folder, domain)

    kind = node["kind"]
    if kind == "constant":
        return sizing.Constant(node["value"])
    if kind == "expression":
        return sizing.Expression(node["expression"])
    if kind == "caps":
        return _caps(node, domain)
    if kind == "raster":
        return _raster(node, folder, domain)
    if isinstance(domain, Sphere) and kind in ("hessian", "gradient", "graded"):
        raise InputError(
            f"size.kind is {kind!r}, which is for boxes and polygons, not for {domain}; expected caps, distance, "
            "expression, raster or a combination of them"
        )
    if kind in ("hessian", "gradient"):
        values = load_array(folder / node["file"], "size.file")
        corners = node.get("lower", domain.lower), node.get("upper", domain.upper)
        options = _given(node, "n_cells", "eps", "p", "h_min", "h_max", "at", "missing")
        make = sizing.hessian_size if kind == "hessian" else sizing.gradient_size
        return make(values, *corners, **options)
    if kind == "distance":
        options = _given(node, "growth", "slope", "h_max")
        shapes = [_shape(s, folder, domain) for s in node["shapes"]]
        return sizing.Distance(shapes, node["h_min"], **options)
    if kind == "feature":
        if not isinstance(domain, Polygon):
            raise InputError(f"size.kind is 'feature', which needs a polygon as domain, not {domain}")
        options = _given(node, "cells_across", "growth", "h_min", "h_max", "curvature")
        return sizing.FeatureSize(domain, **options)
    if kind == "graded":
        options = _given(node, "growth", "slope", "resolution")
        return sizing.Graded(inner(node["field"]), box=domain, **options)
    if kind == "min":
        return sizing.minimum(*map(inner, node["fields"]))
    if kind == "max":
        return sizing.maximum(*map(inner, node["fields"]))
    if kind == "sum":
        return functools.reduce(operator.add, map(inner, node["fields"]))
    if kind == "product":
        return functools.reduce(operator.mul, map(inner, node["fields"]))
    if kind == "quotient":
        return functools.reduce(operator.truediv, map(inner, node["fields"]))
    if kind == "scale":
        return node["factor"] * inner(node["field"])
    raise AssertionError(f"the schema passed a size field of kind {kind!r}")


def _caps(node: Mapping[str, Any], domain: Domain) -> Any:
    if not isinstance(domain, Sphere):
        raise InputError(
            f"size.kind is 'caps', which is for a sphere, not for {domain}; expected distance, or kind = \"sphere\" "
            "in [domain]"
        )
    regions = [(r["center"], r["radius"], r["size"]) for r in node["regions"]]
    return earth.Caps(regions, h_max=node["h_max"], sphere=domain, **_given(node, "growth", "slope"))


def _raster(node: Mapping[str, Any], folder: Path, domain: Domain) -> Any:
    """Return a raster of an array with given corners, or of a grid with longitudes and latitudes."""
    path = folder / node["file"]
    grid = read_grid(path, node.get("variable"))
    if grid is not None:
        for key in ("lower", "upper", "at"):
            if key in node:
                raise InputError(f"size.{key} is given, and {path} has longitudes and latitudes; leave it out")
        return earth.from_xarray(grid, **_given(node, "missing", "outside"))
    if "variable" in node:
        raise InputError(
            f"size.variable is {node['variable']!r}, and {path} is neither a netCDF nor a .npz file; leave it out"
        )
    values = load_array(path, "size.file")
    extent = DEGREES if isinstance(domain, Sphere) else domain
    corners = node.get("lower", extent.lower), node.get("upper", extent.upper)
    return sizing.Raster(values, *corners, **_given(node, "at", "missing", "outside"))


def _given(node: Mapping[str, Any], *keys: str) -> dict[str, Any]:
    return {key: node[key] for key in keys if key in node}


def _shape(node: Mapping[str, Any], folder: Path, domain: Domain) -> Any:

    kind = node["kind"]
    if kind == "surface":
        surface = sizing.Surface.read(locate(folder, node["file"]), **_given(node, "join"))
        if node.get("closed", False):
            surface.require_closed()
            if "join" not in node:  # nearly coincident corners would make triangles intersect
                surface.check()
        return surface
    if kind == "boundary":
        if isinstance(domain, Sphere):
            domain.boundary()  # raises
        return domain if "edges" not in node else domain.boundary(node["edges"])
    if kind == "box":
        if isinstance(domain, Sphere) and not {"lower", "upper"} <= node.keys():
            raise InputError("size.shapes has a box without corners, expected lower and upper in degrees on a sphere")
        return Box(node.get("lower", domain.lower), node.get("upper", domain.upper))
    if kind in ("circle", "sphere"):
        return sizing.Circle(node["center"], node["radius"])
    if kind == "segment":
        return sizing.Segment(node["a"], node["b"])
    if kind == "polyline":
        return sizing.Polyline(node["points"])
    if kind == "closed_polyline":
        return sizing.ClosedPolyline(node["points"])
    return Curve.described(node)


def load_array(path: Path, place: str) -> np.ndarray:
    """Read an array from a `.npy` file, or the array `points` from a `.npz` file.

    Raises
    ------
    InputError
        If there is no such file or it holds no such array.
    """
    try:
        return read_array(path, "points")
    except InputError as error:
        raise InputError(
            f"{place} names {str(path)!r}, which cannot be read as an array ({error}); "
            "give a .npy file beside the case file"
        ) from error


def named_files(node: dict[str, Any]) -> list[dict[str, Any]]:
    """Return every table of the tree that names a file, so that the files can be copied along."""
    children = [*node.get("fields", []), *([node["field"]] if "field" in node else [])]
    own = [part for part in (node, *node.get("shapes", [])) if "file" in part]
    return own + [found for child in children for found in named_files(child)]
