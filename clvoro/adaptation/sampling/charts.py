"""Plane charts of domains that are not plane, in which start generators are drawn."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...geometry.box import Box
from ...geometry.domain import Domain
from ...geometry.sphere import Sphere


class Charted:
    """A size field on a sphere as a function of positions in the sphere's chart.

    Parameters
    ----------
    field : callable
        h(points (n, 3)) -> (n,).
    sphere : Sphere
    """

    def __init__(self, field: Callable[[np.ndarray], np.ndarray], sphere: Sphere) -> None:
        self._field, self._sphere = field, sphere

    @property
    def real(self) -> np.dtype:
        """Precision of the field."""
        return getattr(self._field, "real", np.dtype(float))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return h at points (n, 2) of the chart, (n,)."""
        return self._field(from_chart(self._sphere, points))

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the field's landmarks in the chart `domain`; see `Field.landmarks`."""
        del domain
        known: Any = getattr(self._field, "landmarks", None)
        marks = np.empty((0, 3)) if known is None else known(self._sphere)
        return into_chart(self._sphere, marks)


def charted(
    domain: Domain, field: Callable[[np.ndarray], np.ndarray]
) -> tuple[Domain, Callable[[np.ndarray], np.ndarray]]:
    """Return a plane domain of the same area, and the field there; `domain` and `field` if it is plane already.

    A sphere of radius r becomes the box of r longitude and r sin(latitude) (Lambert's cylindrical equal-area
    projection).
    """
    if not isinstance(domain, Sphere):
        return domain, field
    r = domain.radius
    return Box((-np.pi * r, -r), (np.pi * r, r)), Charted(field, domain)


def from_chart(sphere: Sphere, points: np.ndarray) -> np.ndarray:
    """Return the positions (n, 3) of points (n, 2) of the chart."""
    lon, sine = np.asarray(points, float).reshape(-1, 2).T / sphere.radius
    cosine = np.sqrt(np.maximum((1 - sine) * (1 + sine), 0))
    return sphere.radius * np.column_stack([cosine * np.cos(lon), cosine * np.sin(lon), sine])


def into_chart(sphere: Sphere, points: np.ndarray) -> np.ndarray:
    """Return the points (n, 2) of the chart at positions (n, 3)."""
    x, y, z = (np.asarray(points, float).reshape(-1, 3) / sphere.radius).T
    return sphere.radius * np.column_stack([np.arctan2(y, x), np.clip(z / np.hypot(np.hypot(x, y), z), -1, 1)])
