"""Fields from values on the cells of a mesh, such as sizes from a solver's solution."""

from __future__ import annotations

from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from ..arguments import check_cell_values
from ..connectivity import rows_of
from ..errors import InputError
from .arguments import coverage_warnings
from .derivatives import CellStencils, derivatives
from .field import Field

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..geometry.domain import Domain
    from ..mesh.diagram import Diagram
    from ..mesh.results import Result
    from .codegen import CodeWriter

_LEAF = 8  # cells in a leaf of the tree, about
_BLEND = 2.0  # squared distance, over that of the nearest centroid, at which a cell has no more weight
_LANDMARKS = 4096


class _Tree(NamedTuple):
    """A k-d tree: all leaves are at one depth, leaf k has the rows (k n) >> levels to ((k + 1) n) >> levels."""

    levels: int
    order: np.ndarray
    """(n,) int. The points, leaf by leaf."""
    axes: np.ndarray
    splits: np.ndarray
    """`axes`, `splits`: (2^levels - 1,) int and float. Axis and coordinate at which each node divides its points; the
    children of node k are 2 k + 1 and 2 k + 2."""

    @classmethod
    def of(cls, points: np.ndarray) -> _Tree:
        n = len(points)
        levels = max(0, int(np.log2(max(n / _LEAF, 1))))
        order, axes, splits = np.arange(n), [np.zeros(0, int)], [np.zeros(0)]
        for level in range(levels):
            starts = (np.arange(2**level + 1) * n) >> level
            x = points[order]
            spans = np.maximum.reduceat(x, starts[:-1]) - np.minimum.reduceat(x, starts[:-1])
            axis = spans.argmax(axis=1)
            node = rows_of(starts)
            along = x[np.arange(n), axis[node]]
            sort = np.lexsort((along, node))
            order, along = order[sort], along[sort]
            middle = ((2 * np.arange(2**level) + 1) * n) >> (level + 1)
            axes.append(axis)
            splits.append((along[middle - 1] + along[middle]) / 2)
        return cls(levels, order, np.concatenate(axes), np.concatenate(splits))


class OnCells(Field):
    """A field from values on the cells of a mesh: sizes from a solution, or any other data of cells.

    In each cell the field is linear, with the slope of `derivatives`, and stays between the values of the cell and its
    neighbors; in a cell at a wall, where it is extrapolated, between the extreme values of all cells. Towards the next
    cells these functions are blended, so that the field is continuous: cell j has the weight
    ``max(0, 1 - 3 (r_j^2 - r^2) / (r_j^2 + r^2))^2``, r_j the distance of its centroid and r that of the nearest one.
    The field is of second order in the size of the cells, and has no new extrema. Centroids are found by a tree: sizes
    may differ by any factor.

    Parameters
    ----------
    mesh : Result or Diagram
        In any domain: a box, also a periodic one, a polygon, a solid, or a sphere.
    values : (n,) array of float
        One for each cell; as sizes, in the unit of the coordinates.

    Attributes
    ----------
    mesh : Diagram
    values : (n,) float64

    Raises
    ------
    InputError, InputTypeError
        If there is not a finite number for each cell. (Values that are not positive are an error only if the final
        field is not positive.)

    Examples
    --------
    Half the sizes of another mesh:

    >>> box = clvoro.Box((0, 0), (2, 1))
    >>> mesh = clvoro.adapt(box, lambda p: 0.05 + 0.1 * p[:, 0], "fast")
    >>> finer = clvoro.adapt(box, 0.5 * clvoro.sizing.OnCells(mesh, mesh.target_size), "fast")
    >>> 3.5 < len(finer) / len(mesh) < 4.5
    True
    """

    def __init__(self, mesh: Result | Diagram, values: ArrayLike):
        self._stencils = CellStencils.of(mesh)
        self.mesh = self._stencils.mesh
        self.values = check_cell_values(f"{type(self).__name__} values", values, len(self._stencils))
        if self.values.ndim != 1:
            raise InputError(
                f"{type(self).__name__} values have shape {self.values.shape}, expected ({len(self.values)},): one "
                "for each cell; make a field of each column"
            )
        domain = self.mesh.domain
        self.dim, self.on_sphere = domain.dim, domain.cell_dim < domain.dim

    @property
    def _places(self) -> np.ndarray:
        """Where the values hold, (n, d)."""
        return self.mesh.centroids

    @cached_property
    def _cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (k, d), with the images that a periodic box needs, and values, bounds and slopes, (k, 3 + d)."""
        v = self.values
        low, high = self._stencils.bounds(v)
        # A cell at a wall ends beyond its centroid: values rise, or fall, as much towards the wall as away from it.
        wall = self._stencils.at_wall
        least, most = np.maximum(2 * v - high, v.min()), np.minimum(2 * v - low, v.max())
        low, high = np.where(wall, np.minimum(low, least), low), np.where(wall, np.maximum(high, most), high)
        slopes = derivatives(v, self.mesh)[0]
        points, rows = self._places, np.arange(len(v))
        domain = self.mesh.domain
        if any(domain.periodic):
            reach = 1.5 * self._stencils.lengths.max(initial=0.0)
            steps = product(*([-1, 0, 1] if periodic else [0] for periodic in domain.periodic))
            shifted = np.concatenate([points + np.array(step) * domain.extent for step in steps])
            near = ((shifted > domain.lower - reach) & (shifted < domain.upper + reach)).all(axis=1)
            points, rows = shifted[near], np.tile(rows, len(shifted) // len(v))[near]
        return points, np.column_stack([v, low, high, slopes])[rows]

    @cached_property
    def _search(self) -> scipy.spatial.KDTree:
        return scipy.spatial.KDTree(self._cells[0])

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        centroids, cells = self._cells
        result, left, count = np.empty(len(points)), np.arange(len(points)), 8
        while len(left):
            count = min(count, len(centroids))
            x = points[left]
            distance2, rows = (a.reshape(len(left), -1) for a in self._search.query(x, count))
            distance2 = distance2**2
            nearest = distance2[:, :1]
            whole = (distance2[:, -1] >= _BLEND * nearest[:, 0]) | (count == len(centroids))
            with np.errstate(invalid="ignore"):
                weight = np.maximum(0, 1 - 3 * (distance2 - nearest) / (distance2 + nearest)) ** 2
            weight[distance2 <= nearest] = 1
            found = cells[rows]
            rise = np.einsum("kjd,kjd->kj", found[..., 3:], x[:, None] - centroids[rows])
            at = np.clip(found[..., 0] + rise, found[..., 1], found[..., 2])
            result[left[whole]] = ((weight * at).sum(axis=1) / weight.sum(axis=1))[whole]
            left, count = left[~whole], 4 * count
        return result

    def _emit(self, writer: CodeWriter) -> str:
        points, cells = self._cells
        unit = writer.scale
        x = writer.normalize(points)
        tree = _Tree.of(x)
        # Values and bounds are sizes; slopes have no unit.
        scaled = np.column_stack([x, cells[:, :3] / unit, cells[:, 3:]])[tree.order]
        at = writer.store(np.column_stack([tree.axes, tree.splits]), scaled)
        return writer.variable(f"size_on_cells(x, data + {at}, {len(x)}, {tree.levels})")

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the places of the smallest values in groups of cells, at most 4096."""
        order = _Tree.of(self._places).order
        groups = np.array_split(order, min(len(order), _LANDMARKS))
        return self._places[[group[self.values[group].argmin()] for group in groups]]

    def warnings(self, domain: Domain) -> list[str]:
        """Return a warning if the mesh covers little of `domain`."""
        if domain.same_region(self.mesh.domain):
            return []
        remedy = "give values on a mesh of the whole domain"
        return coverage_warnings(repr(self), domain, self.mesh.domain.lower, self.mesh.domain.upper, remedy)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self.values)} cells in {self.mesh.domain})"
