"""Coastlines, if Cartopy and its data are installed."""

from __future__ import annotations

from functools import cache

import numpy as np

from ..geometry.sphere import EARTH_RADIUS

_SCALES = (("110m", 40.0), ("50m", 8.0), ("10m", 0.0))
"""Scales of the data, and the smallest angle in degrees across a picture that has them."""


def kilometer_of(radius: float) -> float | None:
    """Return the length of a kilometer if `radius` is about that of the Earth in meters or kilometers, else None."""
    units = (1000.0, 1.0)
    return next((k for k in units if abs(radius / k / (EARTH_RADIUS / 1000) - 1) < 0.005), None)


def is_earth(radius: float) -> bool:
    """Return whether a radius is about that of the Earth, in meters or kilometers."""
    return kilometer_of(radius) is not None


def coastlines(span: float) -> list[np.ndarray]:
    """Return the coastlines of the Earth as longitudes and latitudes, each (k, 2), for a picture of `span` degrees.

    Without Cartopy, or without its data, there are none. The data are of Natural Earth. They are not downloaded here:
    Cartopy's program ``cartopy_feature_download physical`` does that.
    """
    fitting = [scale for scale, least in _SCALES if span >= least]
    for scale in [*fitting[:1], *(s for s, _ in _SCALES if s not in fitting[:1])]:
        lines = _read(scale)
        if lines:
            return lines
    return []


@cache
def _read(scale: str) -> list[np.ndarray]:
    try:
        from cartopy import config
        from cartopy.io import Downloader, shapereader

        words = {"resolution": scale, "category": "physical", "name": "coastline"}
        source = Downloader.from_config(("shapefiles", "natural_earth", *words.values()))
        given = {"config": config, **words}
        paths = (source.pre_downloaded_path(given), source.target_path(given))
        found = next((path for path in paths if path is not None and path.exists()), None)
        if found is None:
            return []
        shapes = list(shapereader.Reader(found).geometries())
        lines = [line for shape in shapes for line in getattr(shape, "geoms", [shape])]
        return [np.asarray(line.coords, float)[:, :2] for line in lines]
    except Exception:  # a picture without coasts is better than none
        return []
