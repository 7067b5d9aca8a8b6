"""What a mesh for solvers leaves out of its domain, or adds to it, because cells are too large for the boundary."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import shapely

from ..arguments import format_point
from ..connectivity import following, rows_of, take_rows
from ..geometry.polygon import Polygon
from .faces import Faces
from .geometry import polygon_areas
from .read_only import Sealed

SMALLEST = 0.25
"""Smallest measure of a part over that of cells there."""

NO_AREA = 1e-14
"""Area of parts that are round-off, over that of the domain."""


@dataclass(frozen=True, eq=False)
class LeftOut(Sealed):
    """Parts of the domain that a mesh for solvers leaves out, and parts of its outside that cells cover.

    - `measures` (k,) float64: areas in 2D, volumes in 3D: positive for bays, dead ends and other parts without a cell,
      negative for land that is covered, such as an island within a cell. The largest ones come first.
    - `places` (k, d) float64: a point in each.
    """

    measures: np.ndarray
    places: np.ndarray

    @property
    def total(self) -> float:
        """The sum of the absolute measures."""
        return float(np.abs(self.measures).sum())

    def __len__(self) -> int:
        """Return the number of parts."""
        return len(self.measures)

    def __str__(self) -> str:
        if not len(self):
            return ""
        parts = "1 part" if len(self) == 1 else f"{len(self)} parts"
        unit = "area" if self.places.shape[1] == 2 else "volume"
        return (
            f"leaves out {parts} of the boundary that cells do not resolve, of the {unit} {self.total:.3g}; the "
            f"largest is at {format_point(self.places[0])}"
        )


def left_out_at_walls(mesh: Faces) -> LeftOut:
    """Return the parts of a solid that the cells of `mesh` do not cover, and the parts of its outside that they cover.

    Parts are left away that are smaller than `SMALLEST` times the cells there. Whole bodies and cavities are found
    whatever their size is. Of other domains nothing is left out.
    """

    def triangles() -> tuple[np.ndarray, np.ndarray]:
        walls = np.arange(mesh.n_inner, mesh.n_outer)
        starts, corners = take_rows(mesh.starts, mesh.corners, walls)
        face, after = rows_of(starts), following(starts)
        ends = mesh.points[corners], mesh.points[corners[after]], mesh.center[walls][face]
        return np.stack(ends, axis=1), np.cbrt(mesh.volumes[mesh.owner[walls]])[face]

    measures, places = mesh.domain.uncovered(triangles, SMALLEST)
    order = np.argsort(-np.abs(measures), kind="stable")
    return LeftOut(measures[order], places[order])


def left_out_of_polygon(mesh: Faces, domain: Polygon) -> LeftOut:
    """Return the parts of `domain` that the cells of `mesh` do not cover, and the parts of its outside that they cover.

    Parts are left away that are smaller than `SMALLEST` times the nearest cell. Islands on which no cell has a wall are
    found whatever their size is.
    """
    walls = slice(mesh.n_inner, mesh.n_outer)
    sides = mesh.points[mesh.corners.reshape(-1, 2)[walls]]
    covered = shapely.build_area(shapely.unary_union(shapely.linestrings(sides)))
    rings, edges = domain.oriented.rings, domain.oriented.places[-1 - mesh.neighbor[walls]]
    used = np.zeros(len(rings), bool)
    used[np.searchsorted(domain.oriented.ring_starts, edges, side="right") - 1] = True
    is_outer = np.diff(domain.piece_of_ring, prepend=-1) > 0
    kept = used | is_outer
    pieces = [
        shapely.Polygon(rings[k], [rings[i] for i in np.flatnonzero(kept & (domain.piece_of_ring == piece))[1:]])
        for piece, k in enumerate(np.flatnonzero(is_outer).tolist())
    ]
    whole = shapely.union_all(pieces)
    without, added = (_parts_of(a.difference(b), domain.measure) for a, b in ((whole, covered), (covered, whole)))
    parts = np.concatenate([without, added])
    measures = np.concatenate([shapely.area(without), -shapely.area(added)])
    islands = np.array([shapely.Polygon(rings[k]) for k in np.flatnonzero(~kept)], object)
    parts = np.concatenate([parts, islands])
    measures = np.concatenate([measures, -shapely.area(islands)])
    places = shapely.get_coordinates(shapely.point_on_surface(parts))
    nearest = scipy.spatial.KDTree(mesh.generators).query(places)[1] if len(parts) else np.empty(0, int)
    large = np.abs(measures) >= SMALLEST * np.abs(polygon_areas(mesh))[nearest]
    found = np.flatnonzero(large | (np.arange(len(parts)) >= len(parts) - len(islands)))
    found = found[np.argsort(-np.abs(measures[found]), kind="stable")]
    return LeftOut(measures[found], places[found])


def _parts_of(shape: shapely.Geometry, scale: float) -> np.ndarray:
    """Return the polygons of a shape in a domain of the area `scale`, without those that are round-off."""
    parts = shapely.get_parts(shape)
    return parts[shapely.area(parts) > NO_AREA * scale]
