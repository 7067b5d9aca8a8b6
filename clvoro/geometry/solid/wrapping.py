"""Wrap triangles that bound no region, or have details finer than cells: a closed surface a little outside of them.

The distance from the triangles is sampled on a grid. Places farther than `reach` from them that are connected with the
border of the grid are outside, and a surface bounds these. A second surface lies `reach` - `off` inside of the first,
so that it is `off` outside of the triangles where no ball of the radius `reach` is kept from touching them. It closes
holes and gaps up to 2 `reach` wide, and makes plates of sheets. Source of the two steps: closing of sets, Serra (1982),
Image Analysis and Mathematical Morphology.
"""

from __future__ import annotations

import math
from numbers import Real

import numpy as np
import scipy

from ...errors import InputError
from ..surface import Surface
from .combining import library

_OFF = 0.5
"""Distance of the closed surface from the triangles, over `reach`."""
_STEP, _EDGE = 3, 1.5
"""Grid points per reach; length of edges of the wrap in steps of the grid."""
_SIMPLER = 0.1
"""How far triangles may move to be fewer, in steps of the grid."""
_BLOCK = 8
"""Distances are computed in cubic blocks of the grid near the triangles: grid points along the edge of one."""
_MOST = 50_000_000
"""Most points of a grid."""


def wrapped(surface: Surface, reach: float) -> tuple[Surface, str]:
    """Return a closed surface around all triangles, and what was done.

    Raises
    ------
    InputError
        If `reach` is no length, longer than the surface, or so small that the grid would have too many points.
    MissingLibraryError
        If manifold3d is not installed.
    """
    if isinstance(reach, bool) or not (isinstance(reach, Real) and 0 < reach < math.inf):
        raise InputError(f"{surface.name} wrap is {reach!r}, expected a length")
    reach, longest = float(reach), float(np.ptp(surface.vertices, axis=0).max())
    if reach > longest:
        raise InputError(
            f"{surface.name} wrap is {reach:g}, longer than the surface, {longest:g}; give it in the unit of the "
            "solid, which is meters with `units`"
        )
    step = reach / _STEP
    low = surface.vertices.min(axis=0) - reach - 3 * step
    shape = np.ceil((surface.vertices.max(axis=0) + reach + 3 * step - low) / step) + 1
    if (count := math.prod(shape.tolist())) > _MOST:
        least = reach * (count / _MOST) ** (1 / 3)
        raise InputError(
            f"{surface.name} wrap is {reach:g}, which is too small for its extent; use {least:.2g} or more"
        )
    grid = _Sampled(low, step, shape.astype(int))
    away = grid.distance(surface, 2 * reach)
    part = scipy.ndimage.label(away > reach)[0]
    outer = part == part[0, 0, 0]
    first = grid.level(surface.name, np.where(outer, reach - away, np.abs(away - reach)))
    depth = np.where(outer, 0, grid.distance(first, 2 * reach, ~outer))
    made = grid.level(surface.name, depth - (1 - _OFF) * reach)
    return made, f"wrapped, at most {_distance(surface, made.vertices, math.inf).max():.3g} away from what was given"


class _Sampled:
    """Points `step` apart."""

    def __init__(self, low: np.ndarray, step: float, shape: np.ndarray) -> None:
        self.low, self.step, self.shape = low, step, shape

    def distance(self, surface: Surface, reach: float, where: np.ndarray | None = None) -> np.ndarray:
        """Return the distance of each grid point from a surface; farther ones, and those not `where`, have `reach`."""
        blocks = np.stack(np.meshgrid(*(np.arange(0, n, _BLOCK) for n in self.shape), indexing="ij"), -1).reshape(-1, 3)
        begin = self.low + self.step * blocks
        met = np.unique(surface.tree.meeting(begin - reach, begin + _BLOCK * self.step + reach)[0])
        found = np.full(self.shape, reach)
        near = np.zeros(self.shape, bool)
        for i, j, k in blocks[met].tolist():
            near[i : i + _BLOCK, j : j + _BLOCK, k : k + _BLOCK] = True
        if where is not None:
            near &= where
        found[near] = _distance(surface, self.low + self.step * np.argwhere(near), reach)
        return found

    def level(self, name: str, values: np.ndarray) -> Surface:
        """Return the surface where `values` on the grid are 0, around those above.

        The library asks for one place after the other: first for all places, whose values are computed together.
        """
        low, high = self.low + 0.5 * self.step, self.low + (np.array(self.shape) - 1.5) * self.step
        bounds = [*low.tolist(), *high.tolist()]
        places: list[tuple[float, float, float]] = []

        def note(*x: float) -> float:
            places.append(x)  # type: ignore[arg-type]
            return -1.0

        manifold = library().Manifold
        manifold.level_set(note, bounds, _EDGE * self.step)
        x = (np.array(places) - self.low) / self.step
        found = dict(zip(places, scipy.ndimage.map_coordinates(values, x.T, order=1).tolist(), strict=True))
        mesh = manifold.level_set(lambda *x: found[x], bounds, _EDGE * self.step)
        mesh = mesh.simplify(_SIMPLER * self.step).to_mesh64()
        return Surface(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts, np.int64), name)


def _distance(surface: Surface, points: np.ndarray, reach: float) -> np.ndarray:
    """Return the distance of `points` (n, 3) from a surface, up to `reach`, (n,)."""
    from .solid import NearestTriangles

    return np.minimum(NearestTriangles(surface, np.arange(len(surface))).feet(points, reach).distance, reach)
