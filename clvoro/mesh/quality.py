"""Measures of mesh quality for finite-volume methods, computed on the host from a `Diagram`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .diagram import Diagram
from .straightening import cell_quality

if TYPE_CHECKING:
    from ..earth.c_grid import CGridMeasures
    from ..finite_volumes.measures import SolverMeasures


@dataclass(frozen=True, repr=False)
class Measures:
    """Measures of a mesh, one per cell (n,) or one per half-face (m,). Further ones for C grids: `c_grid`.

    The line between the generators x_i and x_j crosses the plane of their face at a right angle, in (x_i + x_j) / 2, by
    the definition of a Voronoi diagram: with the unknowns at the generators a mesh has no non-orthogonality. At a wall
    the mirror image of the generator takes the place of x_j.

    Attributes
    ----------
    quality : (n,) float
        2D: 4 A n tan(pi / n) / P^2 (the paper's 4.1), 1 for a regular polygon and less for all others; n is the number
        of faces. Faces on the boundary of a polygonal domain count as one straight side while they turn by at most 30
        degrees in sum.
        3D: the isoperimetric quotient 36 pi V^2 / S^3, 1 for a ball, .753 for a truncated octahedron, .524 for a cube.
    skewness : (m,) float
        Distance from the centroid of the face to the point where the line between the generators crosses its plane,
        over the distance of the generators: the offset of linear interpolation along the line. It is infinite for a
        generator on a wall or behind it (a cell may reach around a corner of a polygon). On a sphere both are arcs.
    centroid_angle : (m,) float
        Angle in degrees between the normal of the face and the line from centroid to centroid: the
        non-orthogonality of solvers that keep their unknowns at the centroids. 0 on walls.
    face_ratio : (n,) float
        Measure of the cell's smallest face over that of its largest.
    volume_ratio : (m,) float
        Larger over smaller volume of the two cells at the face; 1 on walls.
    faces : (n,) int
        Number of faces of the cell.
    inner : (m,) bool
        Whether the face is between two cells.
    diagram : Diagram or None
    """

    quality: np.ndarray
    skewness: np.ndarray
    centroid_angle: np.ndarray
    face_ratio: np.ndarray
    volume_ratio: np.ndarray
    faces: np.ndarray
    inner: np.ndarray
    diagram: Diagram = field(compare=False)

    @cached_property
    def exact(self) -> SolverMeasures:
        """Measures of the diagram as OpenFOAM defines them, with unknowns at the centroids.

        Among them `shortest_edge` and `smallest_face` relative to the size of the cell; `summary()` has percentiles.
        """
        return self.diagram.solver_mesh("exact", collapse=False).measures

    @cached_property
    def solver(self) -> SolverMeasures:
        """The same of the mesh that a solver gets: with straight walls, without short edges; see `solver_mesh`."""
        return self.diagram.solver_mesh().measures

    @cached_property
    def c_grid(self) -> CGridMeasures:
        """Measures for C grids, as of ocean and atmosphere models: angles of Delaunay triangles, kites and offsets.

        On spheres, and in boxes in 2D; `InputError` in other domains.
        """
        from ..earth.c_grid import measure_c_grid

        return measure_c_grid(self.diagram)

    def __repr__(self) -> str:
        return f"Measures({self.line()})"

    def line(self) -> str:
        """Return faces per cell, skewness and angles as one line of text."""
        s = self.summary()
        return (
            f"{s['mean_faces']:.2f} faces per cell; skewness mean {s['mean_skewness']:.3f}, "
            f"max {s['max_skewness']:.3f}; angle of centroids mean {s['mean_centroid_angle']:.2f}°, "
            f"max {s['max_centroid_angle']:.1f}°"
        )

    def worst_of_cell(self, name: str) -> np.ndarray:
        """Return the largest value of `name`, a measure of faces, among the faces of each cell, (n,)."""
        values, counts = getattr(self, name), self.faces
        worst = np.zeros(len(counts))
        some = counts > 0
        starts = np.cumsum(counts) - counts
        worst[some] = np.maximum.reduceat(values, starts[some]) if len(values) else 0.0
        return worst

    def summary(self) -> dict[str, float]:
        """Return the mean and the worst of every measure, by name.

        Means of `centroid_angle` and `volume_ratio` are over the faces between cells, and so are mean and maximum of
        `skewness` in a polygon or solid, whose walls may have generators behind them. On a sphere those of `c_grid`
        follow.
        """
        domain = self.diagram.domain
        of_c_grid = self.c_grid.summary() if domain.for_c_grids else {}
        angle, ratio = (
            values[self.inner] if self.inner.any() else values for values in (self.centroid_angle, self.volume_ratio)
        )
        between = not domain.plain and self.inner.any()
        skewness = self.skewness[self.inner] if between else self.skewness
        return {
            "mean_faces": float(self.faces.mean()),
            "mean_quality": float(self.quality.mean()),
            "min_quality": float(self.quality.min()),
            "mean_skewness": float(skewness.mean()),
            "max_skewness": float(skewness.max()),
            "mean_centroid_angle": float(angle.mean()),
            "max_centroid_angle": float(angle.max()),
            "mean_face_ratio": float(self.face_ratio.mean()),
            "min_face_ratio": float(self.face_ratio.min()),
            "mean_volume_ratio": float(ratio.mean()),
            "max_volume_ratio": float(ratio.max()),
            **of_c_grid,
        }


def measure_mesh(diagram: Diagram) -> Measures:
    """Measure the cells and half-faces of a diagram in 2D or 3D.

    A wall counts as an infinite plane, through a side of a box or an edge of a polygon. On a sphere the generator of
    the removed cell is behind it.
    """
    owner, neighbor = diagram.half_faces.owner, diagram.neighbors
    points, centroids, volumes = diagram.points, diagram.centroids, diagram.volumes
    areas, middles = diagram.face_measures, diagram.face_centroids
    starts = diagram.neighbor_starts
    inner = neighbor >= 0
    other = np.where(inner, neighbor, 0)
    domain = diagram.domain
    line = points[other] + diagram.shifts * domain.extent - points[owner]
    walls = np.flatnonzero(~inner)
    normals, gaps = domain.toward_walls(-1 - neighbor[walls], points[owner[walls]])
    line[walls] = 2 * gaps[:, None] * normals
    distance = np.linalg.norm(line, axis=1)
    distance[walls[gaps <= 0]] = 0
    share = np.full(len(line), 0.5)
    share[inner] = diagram.half_faces.plane_shares(np.flatnonzero(inner))
    crossing = points[owner] + share[:, None] * line
    crossing = domain.onto(crossing)
    offset, distance = domain.lengths(np.linalg.norm(middles - crossing, axis=1)), domain.lengths(distance)
    skewness = np.where(offset > 0, np.inf, 0.0)  # remains where the distance is 0
    np.divide(offset, distance, out=skewness, where=distance > 0)

    angle = np.zeros(len(line))
    between = centroids[other] + diagram.shifts * diagram.domain.extent - centroids[owner]
    angle[inner] = _angles(line[inner], domain.along_surface(between, crossing)[inner])

    counts = np.diff(starts)
    some = counts > 0  # in a power diagram cells may be empty
    surface, largest, smallest = (np.ones(len(counts)) for _ in range(3))
    for values, function in ((surface, np.add), (largest, np.maximum), (smallest, np.minimum)):
        values[some] = function.reduceat(areas, starts[:-1][some])
    with np.errstate(divide="ignore", invalid="ignore"):
        quality = cell_quality(diagram, surface)
    quality[~some] = 0
    here, there = volumes[owner], np.where(inner, volumes[other], volumes[owner])
    ratio = np.maximum(here, there) / np.minimum(here, there)
    return Measures(quality, skewness, angle, smallest / largest, ratio, counts, inner, diagram)


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles in degrees between vectors (m, d), accurate for small angles, too."""
    a = a / np.linalg.norm(a, axis=1)[:, None]
    b = b / np.linalg.norm(b, axis=1)[:, None]
    halves = np.arctan2(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    return np.degrees(2 * halves)
