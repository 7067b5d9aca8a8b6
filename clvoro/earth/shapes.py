"""Polygons and lines in longitudes and latitudes, in degrees.

Edges are straight in longitude and latitude, as in GeoJSON; along parallels they are not great circles. Rings may
cross the date line, go around a pole, and have any orientation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from os import PathLike
from typing import Any, Literal

import numpy as np
import shapely

from ..arguments import check_rows, warn
from ..errors import InputError, InputTypeError, MismatchWarning
from ..geometry.geojson import pieces_of_geojson, pieces_of_shape
from ..geometry.lines.lines import EXPECTED, paths_of
from ..geometry.polygon import Polygon

_Predicate = Literal["intersects", "contains"]
_FARTHEST = 720.0  # longitude
_NEAR_POLE = 90 - 1e-7  # latitude


@dataclass(frozen=True)
class LonLatArea:
    """Polygons on a sphere."""

    outer: np.ndarray
    holes: np.ndarray
    """`outer`, `holes`: (k,) arrays of shapely geometries. Rings as regions of the plane with continuous longitudes, in
    [-180, 180] and beyond."""
    piece_of_outer: np.ndarray
    piece_of_hole: np.ndarray
    """`piece_of_outer`, `piece_of_hole`: (k,) int. Number of the polygon of each ring."""

    def contains(self, lonlat: np.ndarray) -> np.ndarray:
        """Return whether each position (n, 2), longitudes in [-180, 180], is in a polygon or on its edge; (n,) bool."""
        n = len(lonlat)
        # A ring around a pole is closed along it, so that the pole itself is on edges.
        near = np.clip(lonlat[:, 1], -_NEAR_POLE, _NEAR_POLE)
        tree = shapely.STRtree(np.asarray(shapely.points(lonlat[:, 0], near)))
        inside = np.unique(self._keys(tree, self.outer, self.piece_of_outer, "intersects", n))
        removed = self._keys(tree, self.holes, self.piece_of_hole, "contains", n)
        found = np.zeros(n, bool)
        found[np.setdiff1d(inside, removed) % n] = True
        return found

    def whole(self) -> shapely.Geometry:
        """Return the polygons in the plane, with their images one and two turns to both sides."""
        turns = [np.array([360.0 * turn, 0.0]) for turn in range(-2, 3)]
        outer, holes = (
            shapely.union_all([shapely.transform(ring, lambda x, way=way: x + way) for way in turns for ring in rings])
            for rings in (self.outer, self.holes)
        )
        return shapely.difference(outer, holes)

    @staticmethod
    def _keys(
        tree: shapely.STRtree, rings: np.ndarray, pieces: np.ndarray, predicate: _Predicate, n: int
    ) -> np.ndarray:
        """Return piece * n + place for all places in the tree that are in a ring, at any multiple of 360 degrees."""
        shapes, owner = [rings[:0]], [pieces[:0]]
        bounds = shapely.bounds(rings)
        for turn in range(-4, 5):
            there = (bounds[:, 0] + 360 * turn <= 180) & (bounds[:, 2] + 360 * turn >= -180)
            way = np.array([360.0 * turn, 0.0])
            moved = shapely.transform(rings[there], lambda x, way=way: x + way)
            shapes.append(moved)
            owner.append(pieces[there])
        ring, place = tree.query(np.concatenate(shapes), predicate=predicate)
        return np.concatenate(owner)[ring] * np.int64(n) + place


def area_of(name: str, shape: object) -> LonLatArea:
    """Return polygons given as a `Polygon`, a geometry of shapely, or a path, text or dict of GeoJSON.

    An edge that spans more than 180 degrees of longitude crosses the date line: it goes the short way. Only an edge of
    360 degrees, from -180 to 180, goes along its whole parallel. A ring around a pole is on one side of the equator, or
    closed along the pole, from (180, 90) to (-180, 90).

    Raises `InputError` or `InputTypeError` if `shape` is something else, has no area, or has positions that are not
    longitudes and latitudes in degrees; or if a ring goes around the globe and crosses the equator, or goes around it
    more than once.
    """
    if isinstance(shape, Polygon):
        pieces = _pieces_of_polygon(shape)
    elif isinstance(shape, shapely.Geometry):
        pieces = pieces_of_shape(shape)
    elif isinstance(shape, str | PathLike | Mapping) or hasattr(shape, "__geo_interface__"):
        pieces = pieces_of_geojson(shape, planar=False)[0]  # type: ignore[arg-type]
    else:
        raise InputTypeError(
            f"{name} is a {type(shape).__name__}, expected a clvoro.Polygon or a shapely Polygon in longitudes and "
            "latitudes in degrees, a path or dict of GeoJSON, an array of bool, or a function of longitude and latitude"
        )
    checked = [[check_lonlat(name, ring) for ring in piece] for piece in pieces]
    warn_of_radians(name, np.concatenate([ring for piece in checked for ring in piece]))
    outer = [_region(name, piece[0]) for piece in checked]
    holes = [_region(name, ring) for piece in checked for ring in piece[1:]]
    piece_of_hole = np.repeat(np.arange(len(checked)), [len(piece) - 1 for piece in checked])
    return LonLatArea(np.array(outer, object), np.array(holes, object), np.arange(len(outer)), piece_of_hole)


def lines_of(name: str, lines: Any) -> list[np.ndarray]:
    """Return lines (k, 2) with continuous longitudes; see `paths_of` for what they are given as.

    Raises `InputError` or `InputTypeError` if there are no lines, a line has fewer than two positions, or a position is
    not a longitude and a latitude.
    """
    parts = list(paths_of(name, lines))
    if not parts:
        raise InputError(f"{name} is empty, expected {EXPECTED}")
    checked = [check_lonlat(f"{name}[{k}]", part) for k, part in enumerate(parts)]
    for k, line in enumerate(checked):
        if len(line) < 2:
            raise InputError(f"{name}[{k}] has {len(line)} position, expected at least 2")
    warn_of_radians(name, np.concatenate(checked))
    return [np.column_stack([_unwrapped(x[:, 0], np.diff(x[:, 0])), x[:, 1]]) for x in checked]


def check_lonlat(name: str, positions: object) -> np.ndarray:
    """Return `positions` as an array (k, 2) of longitudes and latitudes in degrees.

    Raises `InputError` or `InputTypeError` if it is not an array of finite numbers of this shape, or a latitude is
    beyond 90, or a longitude beyond 720.
    """
    x = check_rows(name, positions, 2)
    bad = ~np.isfinite(x).all(axis=1) | (np.abs(x[:, 1]) > 90) | (np.abs(x[:, 0]) > _FARTHEST)
    if bad.any():
        lon, lat = x[np.flatnonzero(bad)[0]]
        swapped = " (are they in the order latitude, longitude?)" if abs(lon) <= 90 else ""
        raise InputError(
            f"{name} has the position ({lon:g}, {lat:g}), expected a longitude and a latitude from -90 to 90, in "
            f"degrees{swapped}"
        )
    return x


def warn_of_radians(name: str, x: np.ndarray) -> None:
    """Warn if all longitudes and latitudes `x` (n, 2) would be within one turn in radians.

    A single position in whole numbers, such as (0, 0), says nothing.
    """
    lon, lat = np.abs(x).max(axis=0)
    if len(np.unique(x, axis=0)) == 1 and (x == np.round(x)).all():
        return
    if lon <= 2 * np.pi + 1e-6 and lat <= np.pi / 2 + 1e-6:
        warn(
            f"{name} has longitudes up to {lon:.3g} and latitudes up to {lat:.3g}, which look like radians, expected "
            "degrees; use numpy.degrees",
            MismatchWarning,
        )


def _pieces_of_polygon(polygon: Polygon) -> list[list[np.ndarray]]:
    rings = [polygon.vertices[a:b] for a, b in pairwise(polygon.ring_starts)]
    firsts = [*np.flatnonzero(np.diff(polygon.piece_of_ring, prepend=-1)), len(rings)]
    return [rings[a:b] for a, b in pairwise(firsts)]


def _region(name: str, ring: np.ndarray) -> shapely.Geometry:
    """Return the region of the plane inside a ring, with continuous longitudes."""
    if len(ring) > 1 and (ring[0] == ring[-1]).all():
        ring = ring[:-1]
    if len(ring) < 3:
        raise InputError(f"{name} has a ring of {len(ring)} positions, expected at least 3")
    lon, lat = ring.T
    steps = _short_steps(np.diff(lon, append=lon[0]))
    x = np.concatenate([lon[:1], lon[0] + np.cumsum(steps)])
    turns = round((x[-1] - x[0]) / 360)
    if abs(turns) > 1:
        raise InputError(f"{name} has a ring that goes around the globe {abs(turns)} times, expected at most once")
    if turns:
        if lat.min() < 0 < lat.max():
            raise InputError(
                f"{name} has a ring around the globe with latitudes from {lat.min():g} to {lat.max():g}, so that "
                "either pole may be inside; add that which is inside, as (180, 90), (-180, 90) after a longitude of 180"
            )
        pole = 90.0 if lat.max() > 0 else -90.0
        around = np.column_stack([x, np.append(lat, lat[0])])
        region = shapely.Polygon([*around, (x[-1], pole), (x[0], pole)])
    else:
        region = shapely.Polygon(np.column_stack([x[:-1], lat]))
    return region if region.is_valid else shapely.make_valid(region)


def _short_steps(steps: np.ndarray) -> np.ndarray:
    """Return differences of longitudes around a ring, the short way where they are more than 180 degrees.

    One of 360 degrees goes along the whole parallel, unless its neighbors go the opposite way: then the ring has
    positions on both sides of the date line.
    """
    whole = np.abs(np.abs(steps) - 360) < 1e-9
    beside = np.sign(np.roll(steps, 1)) + np.sign(np.roll(steps, -1))
    stays = (np.abs(steps) <= 180) | (whole & (beside * steps >= 0))
    return np.where(stays, steps, steps - 360 * np.rint(steps / 360))


def _unwrapped(lon: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the longitudes of a line, which goes the short way around the globe."""
    short = np.where(np.abs(steps) <= 180, steps, steps - 360 * np.rint(steps / 360))
    return lon[0] + np.concatenate([[0.0], np.cumsum(short)])
