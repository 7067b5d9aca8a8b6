"""Checks of diagrams on a sphere: cells rebuilt from their corners, and from generators and neighbors alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...geometry.sphere import Sphere
from ...geometry.spherical_triangles import triangle_areas
from ..connectivity import face_ends, following, neighbor_points
from ..diagram import Diagram
from ..spherical import bisector_corners, rebuild_on_sphere
from .findings import ROUNDINGS
from .rebuilt import Rebuilt, find_precision

if TYPE_CHECKING:
    from .findings import Check

RADIUS_ROUNDINGS = 16
"""Tolerance of the radius of positions, in units of the round-off of a number: a few operations with vectors."""


class SphereCells(Rebuilt):
    """The cells of a diagram on a sphere, computed from generators, corners and the graph alone.

    Attributes are those of `Rebuilt`: measures are arcs and volumes are areas on the sphere; `areas` and `directions`
    have two coordinates, along the tangents at the cell's generator.
    """

    def __init__(self, d: Diagram, dtype: object = None, real: np.dtype | None = None) -> None:
        sphere, n = d.domain.globe, len(d)
        assert sphere is not None
        self.real = find_precision(d, dtype) if real is None else real
        radius, fine = sphere.radius, float(np.finfo(float).eps)
        eps = float(np.finfo(self.real).eps)
        self.unit = (2 * eps + fine) * radius
        self.owner = np.repeat(np.arange(n), np.diff(d.neighbor_starts))
        first, last = face_ends(d).T
        self.cells, self.corners = self.owner, first
        self._set_directions(d, sphere)
        at, x = d.points[self.owner], d.vertices
        edge = self._along_tangents(x[last] - x[first])
        self.areas = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
        arrays = rebuild_on_sphere(d)
        self.measures = arrays["face_measures"]
        self.middles = arrays["face_centroids"] - at
        self.centroids = arrays["centroids"] - d.points
        corners = [sphere.wrap(y) / radius for y in (at, x[first], x[last])]
        self.volumes = np.bincount(self.owner, radius**2 * triangle_areas(*corners), n)
        self.perimeters = np.bincount(self.owner, self.measures, n)
        self.adopted = np.zeros(len(self.owner), bool)
        self._on_wall = self.adopted
        self._following = following(d.neighbor_starts)
        self._distances = np.linalg.norm(x[first] - at, axis=1)
        self.reach = np.zeros(n)
        np.maximum.at(self.reach, self.cells, self._distances)
        self._vertex_count = len(x)
        self.unit_of_cell = eps * self.reach + fine * radius
        self.period_off = 0.0
        given = d._arrays.get("face_measures")
        self.remade = given is not None and np.array_equal(d.face_measures, self.measures)

    def _set_directions(self, d: Diagram, sphere: Sphere) -> None:
        """Set tangents, directions to neighbors and distances of generators, and the corners that follow from them."""
        unit = sphere.wrap(d.points) / sphere.radius
        self._tangents = [axis[self.owner] for axis in sphere.tangents(sphere.wrap(d.points))]
        behind = neighbor_points(d, np.arange(len(self.owner)))
        between = sphere.wrap(behind) / sphere.radius - unit[self.owner]
        normal = self._along_tangents(between)
        level = (between**2).sum(axis=1) / 2
        length = np.maximum(np.linalg.norm(normal, axis=1), 1e-300)
        self.directions = normal / length[:, None]
        self.spacings = sphere.radius * np.maximum(np.linalg.norm(between, axis=1), 1e-300)
        # The bisectors of two neighbors are the lines n.p = |d|^2 / 2 in the tangent plane.
        corners, _ = bisector_corners(d.neighbor_starts, normal, level)
        with np.errstate(all="ignore"):
            corner = unit[self.owner] + sum(p[:, None] * t for p, t in zip(corners.T, self._tangents, strict=True))
            self.expected_corners = sphere.wrap(corner)

    def _along_tangents(self, vectors: np.ndarray) -> np.ndarray:
        return np.stack([(vectors * axis).sum(axis=1) for axis in self._tangents], axis=1)

    def from_generators(self, d: Diagram) -> SphereCells:
        """Return the cells whose corners follow from generators and neighbors, not from the diagram's vertices."""
        arrays = {
            "points": d.points,
            "neighbor_starts": d.neighbor_starts,
            "neighbors": d.neighbors,
            "vertices": self.expected_corners,
            "cell_vertex_starts": d.neighbor_starts,
            "cell_vertices": np.arange(len(self.owner)),
        }
        return SphereCells(Diagram(d.domain, arrays), real=self.real)


def rebuild_cells(diagram: Diagram, dtype: object = None) -> Rebuilt:
    """Return the rebuilt cells of a diagram in a box, in a polygon or on a sphere; `dtype` as for `find_precision`."""
    made = SphereCells if diagram.domain.curved else Rebuilt
    return made(diagram, dtype)


def check_places(check: Check, g: Rebuilt) -> None:
    """Check that all positions are on the sphere, up to round-off."""
    d = check.diagram
    radius = d.domain.frame[1]
    allowed = RADIUS_ROUNDINGS * float(np.finfo(g.real).eps)
    for name in ("points", "vertices", "centroids", "face_centroids"):
        off = np.abs(np.linalg.norm(getattr(d, name), axis=1) / radius - 1)
        check.note(
            "on the sphere",
            np.maximum(off - allowed, 0),
            lambda k, name=name, off=off: (
                f"{name}[{k}] is {getattr(d, name)[k]}, off the sphere of radius {radius:g} by {off[k]:.3g} of it"
            ),
        )


def check_generators(check: Check, g: Rebuilt) -> None:
    """Check areas and arcs against cells whose corners follow from generators and neighbors alone.

    The device computes a cell relative to its generator. The round-off is therefore relative to the size of the cell,
    not of the sphere as that of the vertices, unless arcs come from the vertices in a file.
    """
    d = check.diagram
    if g.remade or not isinstance(g, SphereCells):
        return
    own = g.from_generators(d)
    doubts = own.doubts(ROUNDINGS * own.unit_of_cell)
    pairs = (
        ("volumes", d.volumes, own.volumes, doubts.volumes),
        ("face measures", d.face_measures, own.measures, doubts.measures),
    )
    for name, given, found, width in pairs:
        check.note(
            f"{name} of the generators",
            np.maximum(np.abs(given - found) - width, 0),
            lambda k, name=name, given=given, found=found: (
                f"{name.replace(' ', '_')}[{k}] is {given[k]:.17g}, generators and neighbors give {found[k]:.17g}"
            ),
        )
