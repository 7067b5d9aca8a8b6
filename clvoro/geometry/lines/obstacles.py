"""Obstacles in a periodic box: closed lines whose insides are removed from the mesh of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import shapely

from ...arguments import format_point
from ...errors import InputError, InputTypeError
from ..boundary_names import BoundaryNames, Walls
from ..domain import Domain
from ..polygon import Polygon
from .lines import Lines, Network

_RING = "outer"  # the default name of a polygon's ring
_CLEAR = 1e-6  # of the domain: least distance between obstacles, and from walls


class Obstacles(Lines):
    """Holes in a box that is periodic; `Box.without` makes them. Also a shape for `clvoro.sizing.Distance`.

    - `parts`: the boundaries that the holes are, by name.
    - `measure`: area of all holes.
    """

    def __init__(self, domain: Domain, holes: Sequence[object], names: Mapping[str, Walls] | None = None) -> None:
        if not isinstance(holes, Sequence | np.ndarray) or isinstance(holes, str):
            raise InputTypeError(f"holes is a {type(holes).__name__}, expected a list of rings")
        if not len(holes):
            raise InputError("holes is empty, expected one ring or more")
        made = [_polygon(domain, k, hole) for k, hole in enumerate(holes)]
        rings = [_moved_inside(domain, polygon) for polygon in made]
        super().__init__([np.concatenate([ring, ring[:1]]) for ring in rings])
        # The name of a curve that is the whole hole, or that of the hole.
        own = [polygon.boundary_names for polygon in made]
        labels = [name[0] if len(name) == 1 and name[0] != _RING else f"hole-{k + 1}" for k, name in enumerate(own)]
        default = tuple(dict.fromkeys(labels))
        parts = BoundaryNames(default, np.array([default.index(name) for name in labels], np.int32), "hole")
        self.parts = parts.renamed("holes names", names) if names else parts
        sides = {*domain.boundary_names, *(f"{axis}{end}" for axis in "xy" for end in ("Min", "Max"))}
        clash = sides.intersection(self.parts.names)
        if clash:
            raise InputError(f"holes names has {min(clash)!r}, the name of a side of the box; choose another name")
        shapes = [shapely.Polygon(ring) for ring in rings]
        self.measure = float(sum(shape.area for shape in shapes))
        steps = [(-1, 0, 1) if p else (0,) for p in domain.periodic]
        shifts = np.array([*product(*steps)]) * domain.extent
        self._holes = np.tile(np.arange(len(rings)), len(shifts))
        self._images = np.array([shapely.transform(s, lambda x, w=way: x + w) for way in shifts for s in shapes])
        self._tree = shapely.STRtree(self._images)
        near = _CLEAR * float(domain.extent.max())
        rows, others = self._tree.query(np.array(shapes), predicate="dwithin", distance=near)
        own = (len(shifts) // 2) * len(rings) + rows  # the image that is not moved
        for k, other in zip(rows[others != own].tolist(), self._holes[others[others != own]].tolist(), strict=True):
            which = f"holes[{other}] or an image of it" if other != k else "its own image"
            raise InputError(f"holes[{k}] touches {which}, expected holes that are apart; join them, or move one")
        # Images beyond half a period are not the nearest ones of any point in the box.
        half = np.where(domain.periodic, domain.extent / 2, 0.0)
        reach = shapely.box(*(domain.lower - half), *(domain.upper + half))
        walls = [image.exterior for image in self._images if shapely.intersects(image, reach)]
        self._walls = [shapely.get_coordinates(wall) for wall in walls]

    def __repr__(self) -> str:
        return f"Obstacles({len(self)} holes, {', '.join(self.parts.names)})"

    def items(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the ends (m, 2), (m, 2) and radii (m,) of all segments, images included, for `sizing.Distance`."""
        begin = np.concatenate([wall[:-1] for wall in self._walls])
        return begin, np.concatenate([wall[1:] for wall in self._walls]), np.zeros(len(begin))

    def network(self, domain: Domain) -> Network:
        """Return each outline as one chain, which seams do not divide."""
        del domain
        ends = np.arange(len(self))
        return Network(np.array([path[0] for path in self.paths]), list(self.paths), np.column_stack([ends, ends]))

    def _with_images(self, domain: Domain) -> Any:
        """Return the outlines and their images."""
        del domain
        return shapely.multilinestrings([image.exterior for image in self._images])

    def hole_of(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 2) in the box the number of its hole, (n,) int; -1 outside of holes."""
        found = np.full(len(points), -1)
        rows, images = self._tree.query(shapely.points(points), predicate="intersects")
        found[rows] = self._holes[images]
        return found

    def names_of(self, holes: np.ndarray) -> np.ndarray:
        """Return the names of the boundaries of `holes` (n,) int, (n,) object."""
        return np.array(self.parts.names, object)[self.parts.index[holes]]


def _polygon(domain: Domain, k: int, hole: object) -> Polygon:
    """Return a hole as a polygon, checked."""
    try:
        made = Polygon(hole)
    except (InputError, InputTypeError) as error:
        raise type(error)(f"holes[{k}]: {error}") from error
    lower, upper, near = np.array(made.lower), np.array(made.upper), _CLEAR * float(domain.extent.max())
    outside = (lower < np.add(domain.lower, near)) | (upper > np.subtract(domain.upper, near))
    outside &= ~np.array(domain.periodic)
    if outside.any():
        axis = "xy"[int(np.argmax(outside))]
        raise InputError(
            f"holes[{k}] from {format_point(lower)} to {format_point(upper)} reaches a wall of {domain} across {axis}, "
            f"expected a hole inside; move it, or make the box periodic along {axis}"
        )
    return made


def _moved_inside(domain: Domain, hole: Polygon) -> np.ndarray:
    """Return the vertices (m, 2) of a hole, moved by periods so that its lower corner is in the box."""
    lower = np.array([hole.lower])
    return hole.vertices + np.where(domain.periodic, domain.wrap(lower) - lower, 0.0)
