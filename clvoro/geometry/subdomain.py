"""Parts of domains: the cells of a mesh that are left when others are removed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
import scipy

from ..arguments import check_number, check_rows
from ..errors import InputError
from ..opencl.engine import Traits
from .boundary_names import BoundaryNames, Walls
from .domain import Domain
from .sphere import Sphere

COAST = "coast"
"""Name of the boundary towards removed cells unless the caller gives another one."""
_SINGLE = 1 + 1e-4
"""Area of a part of a sphere over that of the sphere: sums of areas may be in single precision."""
_ROUNDINGS = 64 * float(np.finfo(np.float32).eps)
"""Distance to a generator, over itself, by which a point may be beyond the boundary: that of meshes in float32."""


@dataclass(frozen=True, eq=False, repr=False)
class Subdomain(Domain):
    """Part of a `Box`, `Polygon` or `Solid`: the domain of a mesh after `Diagram.subset` has removed cells from it.

    Its walls are those of the whole domain, then one for each face towards a removed cell, which lies on the bisector
    of two generators: that of its cell, and that of the removed cell.

    - `whole`: the domain of the mesh before cells were removed.
    - `within`, `beyond` (k, d) array: generators on both sides of each face towards a removed cell, in a periodic box
      the nearest images.
    - `area`: measure of the cells that are left.
    - `names`: names of boundaries, each with its walls. Faces towards removed cells that are not mentioned are the
      "coast".

    Raises `InputError` or `InputTypeError` if the arrays do not have this shape, a number is not finite or the area not
    positive, or names are wrong.
    """

    whole: Domain
    within: np.ndarray
    beyond: np.ndarray
    area: float
    names: Mapping[str, Walls] | None = None

    def __post_init__(self) -> None:
        for name in ("periodic", "cuts_cells", "curved_walls"):
            object.__setattr__(self, name, getattr(self.whole, name))
        for name in ("within", "beyond"):
            what = f"Subdomain {name}"
            points = np.array(check_rows(what, getattr(self, name), self.dim))
            if not len(points) or not np.isfinite(points).all():
                raise InputError(f"{what} has {len(points)} rows, expected one or more of finite numbers")
            points.setflags(write=False)
            object.__setattr__(self, name, points)
        if self.within.shape != self.beyond.shape or (self.within == self.beyond).all(axis=1).any():
            raise InputError("Subdomain within and beyond differ in shape or have equal rows, expected pairs of points")
        check_number("Subdomain area", self.area, above=0)
        object.__setattr__(self, "names", self._checked_names())

    def __repr__(self) -> str:
        share, names = self.area / self.whole.measure, ", ".join(self.boundary_names)
        return f"{type(self).__name__}({share:.3%} of {self.whole!r}, {names})"

    @property
    def lower(self) -> tuple[float, ...]:  # type: ignore[override]
        """Lower corner of the bounding box of the whole domain."""
        return self.whole.lower

    @property
    def upper(self) -> tuple[float, ...]:  # type: ignore[override]
        """Upper corner of the bounding box of the whole domain."""
        return self.whole.upper

    @property
    def measure(self) -> float:
        """Area or volume."""
        return float(self.area)

    @property
    def plain(self) -> bool:
        """Whether the domain is its bounding box: never."""
        return False

    @property
    def uncut(self) -> Domain:
        """The domain before cells were removed."""
        return self.whole

    @property
    def n_whole(self) -> int:
        """Number of walls of the whole domain, which come first."""
        return len(self.whole.boundary_index)

    @property
    def boundary_measure(self) -> float:
        """Length or area of the whole domain's boundary, which serves as a scale."""
        return self.whole.boundary_measure

    def default_names(self) -> BoundaryNames:
        """Return the parts of the boundary with their default names: those of the whole domain, and the coast."""
        known = self.whole.boundaries
        names = known.names if COAST in known.names else (*known.names, COAST)
        cut = np.full(len(self.beyond), names.index(COAST), np.int32)
        return BoundaryNames(names, np.concatenate([known.index, cut]).astype(np.int32), "wall")

    def removed_behind(self, walls: np.ndarray) -> np.ndarray:
        """Return for each of `walls` (k,) int whether a removed cell is behind it, (k,) bool."""
        return walls >= self.n_whole

    def wall_planes(self, walls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return outward unit normals of `walls` (k,) int, and a point on each, (k, d) each."""
        cut = self.removed_behind(walls)
        pairs = walls[cut] - self.n_whole
        normals, anchors = np.zeros((len(walls), self.dim)), np.zeros((len(walls), self.dim))
        normals[~cut], anchors[~cut] = self.whole.wall_planes(walls[~cut])
        way = self.beyond[pairs] - self.within[pairs]
        normals[cut] = way / np.linalg.norm(way, axis=1)[:, None]
        anchors[cut] = self.within[pairs] + way / 2
        return normals, anchors

    def toward_walls(self, walls: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the normals (k, d) of `walls` (k,) near `points` (k, d), and the distances (k,) to them."""
        cut = self.removed_behind(walls)
        normals, gaps = np.zeros((len(walls), self.dim)), np.zeros(len(walls))
        normals[~cut], gaps[~cut] = self.whole.toward_walls(walls[~cut], points[~cut])
        normals[cut], gaps[cut] = super().toward_walls(walls[cut], points[cut])
        return normals, gaps

    def wall_distance(self, walls: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the distance of each of `points` (k, d) to its wall of `walls` (k,)."""
        cut = self.removed_behind(walls)
        found = np.zeros(len(walls))
        found[~cut] = self.whole.wall_distance(walls[~cut], points[~cut])
        found[cut] = super().wall_distance(walls[cut], points[cut])
        return found

    def mirrored(self, walls: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the mirror images (k, d) of `points` (k, d) behind `walls` (k,) int; there the removed generators."""
        found, cut = super().mirrored(walls, points), self.removed_behind(walls)
        found[cut] = self.beyond[walls[cut] - self.n_whole]
        return found

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) whether it lies in a cell that is left, on the boundary included."""
        points = self.whole.check_rows("points", points)
        here, there = self._away(points)
        return self.whole.contains(points) & ((here - there) / 2 <= _ROUNDINGS * here)

    def boundary_distance(self, points: np.ndarray) -> np.ndarray:
        """Return a lower bound of the distance of each of `points` (n, d) to the boundary, (n,)."""
        here, there = self._away(points)
        return np.minimum(self.whole.boundary_distance(points), np.abs(here - there) / 2)

    def closest_walls(self, points: np.ndarray) -> np.ndarray:
        """Return for each of `points` (n, d) on the boundary the closest wall, (n,) int."""
        found = self.whole.closest_walls(points)
        middles = (self.within + self.beyond) / 2
        away, pair = scipy.spatial.KDTree(middles).query(points)
        at_cut = away < self.whole.boundary_distance(points)
        return np.where(at_cut, self.n_whole + np.asarray(pair), found)

    def _away(self, points: np.ndarray) -> list[np.ndarray]:
        """Return how far each of `points` (n, d) is from generators that are left, and from removed ones, (n,) each."""
        return [tree.query(self.whole.wrap(points))[0] for tree in self._trees]

    @cached_property
    def _trees(self) -> tuple[scipy.spatial.KDTree, scipy.spatial.KDTree]:
        images = [self.extent * shift for shift in np.ndindex(*(3 if p else 1 for p in self.periodic))]
        back = np.where(self.periodic, self.extent, 0.0)
        near = [np.concatenate([x + move - back for move in images]) for x in (self.within, self.beyond)]
        return scipy.spatial.KDTree(near[0]), scipy.spatial.KDTree(near[1])

    def boundary(self, walls: Walls | None = None) -> NoReturn:
        """Raise an error, because the boundary changes with the mesh."""
        del walls
        raise InputError(
            f"the boundary of {self} is no shape for sizes; choose sizes in the whole domain, then remove cells"
        )

    def describe(self) -> dict[str, Any]:
        """Return the arguments of this domain as numbers, strings and lists."""
        return {
            "whole": {"kind": type(self.whole).__name__, **self.whole.describe()},
            "within": self.within.tolist(),
            "beyond": self.beyond.tolist(),
            "area": float(self.area),
            **({"names": dict(self.names)} if self.names else {}),
        }

    @classmethod
    def described(cls, **values: Any) -> Subdomain:
        """Return the domain from the values that `describe` returns."""
        whole = dict(values.pop("whole"))
        return cls(Domain.kinds[whole.pop("kind")].described(**whole), **values)

    def traits(self, real: np.dtype) -> Traits:
        """Raise an error, because a mesh is made in the whole domain before cells are removed."""
        del real
        raise InputError(
            f"the domain is a {self}, which is for meshes from which cells were removed; make the mesh in the whole "
            "domain, then remove cells with its subset()"
        )


class SphereRegion(Subdomain, Sphere):
    """Part of a `Sphere`: the domain of a mesh after `Diagram.subset` has removed cells from it.

    As a `Subdomain`; all of its walls are faces towards removed cells, arcs on bisectors of two generators.
    """

    whole: Sphere

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.area > self.whole.measure * _SINGLE:
            raise InputError(
                f"SphereRegion area is {self.area:g}, expected at most that of the sphere, {self.whole.measure:g}"
            )

    @property
    def radius(self) -> float:  # type: ignore[override]
        """Radius of the sphere."""
        return self.whole.radius
