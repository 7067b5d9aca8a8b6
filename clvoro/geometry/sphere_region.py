"""A part of a sphere: the cells of a mesh that are left when others are removed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import scipy

from ..arguments import check_number, check_rows
from ..errors import InputError
from .boundary_names import BoundaryNames, Walls
from .sphere import Sphere

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..opencl.engine import Traits

COAST = "coast"
"""Name of the boundary unless the caller gives another one."""


@dataclass(frozen=True, eq=False, repr=False)
class SphereRegion(Sphere):
    """Part of a `Sphere`: the domain of a mesh after `Diagram.subset` has removed cells from it.

    Its boundary consists of faces of the cells that are left. Wall k is the part towards the k-th removed cell. Such a
    face lies on the bisector of two generators, as any other face does: that of its cell, and that of the removed cell.

    Parameters
    ----------
    radius : float
        Radius of the sphere.
    within : (k, 3) array
        Generators of the cells on the boundary.
    beyond : (b, 3) array
        Generators of the removed cells behind them, one per wall.
    area : float
        Area of the region.
    names : mapping, optional
        Names of boundaries, each with its walls. Walls that are not mentioned are the "coast".

    Raises
    ------
    InputError, InputTypeError
        If the arrays do not have this shape, a row is zero or not finite, the area is not positive or larger than that
        of the sphere, or names are wrong.
    """

    within: ArrayLike = field(kw_only=True)
    beyond: ArrayLike = field(kw_only=True)
    area: float = field(kw_only=True)
    names: Mapping[str, Walls] | None = field(default=None, kw_only=True)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("within", "beyond"):
            what = f"SphereRegion {name}"
            points = check_rows(what, getattr(self, name), 3)
            if not len(points) or not (np.isfinite(points).all() and points.any(axis=1).all()):
                raise InputError(f"{what} has {len(points)} rows, expected one or more finite positions on the sphere")
            points = points.copy()
            points.setflags(write=False)
            object.__setattr__(self, name, points)
        check_number("SphereRegion area", self.area, above=0)
        object.__setattr__(self, "area", float(self.area))
        whole = Sphere(self.radius).measure
        if self.area > whole * (1 + 1e-6):  # areas of cells may be in single precision
            raise InputError(f"SphereRegion area is {self.area:g}, expected at most that of the sphere, {whole:g}")
        object.__setattr__(self, "names", self._checked_names())

    def __repr__(self) -> str:
        share = self.area / Sphere(self.radius).measure
        return f"SphereRegion({share:.3%} of Sphere(radius={self.radius!r}), {', '.join(self.boundary_names)})"

    @property
    def measure(self) -> float:
        """Area."""
        return self.area

    def default_names(self) -> BoundaryNames:
        """Return the parts of the boundary with their default names."""
        return BoundaryNames((COAST,), np.zeros(len(np.asarray(self.beyond)), np.int32), "wall")

    def removed_behind(self, walls: np.ndarray) -> np.ndarray:
        """Return for each of `walls` (k,) int whether a removed cell is behind it: always, (k,) bool."""
        return np.ones(len(walls), bool)

    def boundary(self, walls: Walls | None = None) -> NoReturn:
        """Raise an error, because the boundary consists of arcs, for which there is no shape."""
        del walls
        raise InputError(
            "the boundary of a SphereRegion is no shape for sizes; choose sizes on the Sphere, then remove cells"
        )

    def describe(self) -> dict[str, Any]:
        """Return the arguments of this region as numbers, strings and lists."""
        return {
            "radius": self.radius,
            "within": np.asarray(self.within).tolist(),
            "beyond": np.asarray(self.beyond).tolist(),
            "area": self.area,
            **({"names": dict(self.names)} if self.names else {}),
        }

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points`, (n, 3) or longitudes and latitudes (n, 2), whether it lies in the region.

        The way from a point to the nearest of all generators at the boundary does not cross the boundary. So the side
        of that generator is the side of the point.
        """
        nearest = np.asarray(self._tree.query(self.check_rows("points", points))[1])
        return nearest < len(np.asarray(self.within))

    def closest_walls(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, 3) on the boundary the wall towards the closest removed cell, (n,) int."""
        return np.asarray(scipy.spatial.KDTree(self.beyond).query(points)[1])

    def toward_walls(self, walls: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return unit vectors (k, 3) from `points` to the removed generators behind `walls`, and half the ways (k,)."""
        ways = self.mirrored(walls, points) - points
        length = np.linalg.norm(ways, axis=1)
        return ways / length[:, None], length / 2

    def mirrored(self, walls: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the removed generators behind `walls` (k,) int, (k, 3)."""
        del points
        return np.asarray(self.beyond)[walls]

    @cached_property
    def _tree(self) -> scipy.spatial.KDTree:
        return scipy.spatial.KDTree(np.concatenate([self.within, self.beyond]))

    def traits(self, real: np.dtype) -> Traits:
        """Raise an error, because a mesh is made on the whole sphere before cells are removed."""
        del real
        raise InputError(
            f"the domain is a {self}, which is for meshes from which cells were removed; make the mesh on the Sphere, "
            "then remove cells with its subset()"
        )
