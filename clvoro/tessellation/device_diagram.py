"""A diagram on the device, as all other stages use it, and the error for generators that are too close."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import pyopencl.array as cla
import scipy

from ..errors import InputError
from ..geometry.sphere import directions, farthest_place

if TYPE_CHECKING:
    from ..geometry.domain import Domain
    from ..opencl.engine import Engine, PartialSums
    from .clipped.trim import Trimmed
    from .part import Part
    from .periodic.ghost_images import Folded

EXACT_SHARE, ROUGH_SHARE = 0.01, 0.5
"""Largest share of a cell that round-off may make uncertain: in a final diagram, and in the steps of a run."""
LEAST_SEPARATION = {"float64": 1e-6, "float32": 3e-3}
"""Of generators in 3D, as a share of the longest edge of the domain. Nearer ones may be rejected."""
HALF = 85.0
"""Degrees to the nearest generator from which on generators may leave a half of a sphere free."""


class OpenCellError(InputError):
    """Generators on a sphere leave a half of it free, or weights are so different that a cell reaches so far.

    - `points` (n, 3) ndarray: the generators, as unit vectors.
    """

    def __init__(self, points: np.ndarray) -> None:
        lon, lat, away = farthest_place(points.astype(float))
        if away < HALF:
            super().__init__(
                "the weights on the sphere are so different that a cell reaches 89 degrees from its generator, "
                "expected less; use weights that differ less, such as weights / 10"
            )
            return
        there = np.abs(directions(points)).max(axis=0)
        hint = ""
        if len(points) > 1 and (there <= (2 * np.pi + 1e-6, np.pi / 2 + 1e-6)).all():
            hint = "; longitudes and latitudes look like radians, expected degrees: use numpy.degrees"
        super().__init__(
            f"the {len(points)} generators on the sphere leave a half of it free: there is none within {away:.0f} "
            f"degrees of longitude {lon:.0f}, latitude {lat:.0f}; expected at least four, on all sides of the sphere "
            f"(in a run: more cells, or sizes that change less from cell to cell){hint}"
        )


class CloseError(InputError):
    """Generators too close to be distinguished. Positions are those of the device until `within` converts them.

    - `points` (n or more, d) real, on the device: generators in normalized coordinates.
    - `n`: number of generators.

    Its attributes:
    - `place` (d,) float: position of one generator of the closest pair.
    - `gap`: distance of the pair.
    """

    def __init__(self, points: cla.Array, n: int) -> None:
        x = points.get()[:n].astype(np.float64)
        gaps = scipy.spatial.KDTree(x).query(x, k=2)[0][:, 1]
        first = gaps.argmin()
        self.place, self.gap, self.real = x[first], float(gaps[first]), points.dtype
        super().__init__(self._text(self.place, self.gap))

    def _text(self, place: np.ndarray, gap: float) -> str:
        other = "" if self.real == np.float64 else ", or use dtype='float64'"
        if len(place) == 3 and self.gap >= LEAST_SEPARATION[self.real.name]:
            return (
                f"round-off leaves too much of a cell uncertain in {self.real}, though the nearest generators, at "
                f"{place}, are {gap:.3g} apart; perturb generators that lie on a common sphere or circle{other}"
            )
        what = "coincide" if gap == 0 else "are too close to each other"
        return (
            f"generators at {place}, {gap:.3g} apart, {what} in {self.real}, which leaves too much of a cell to "
            f"round-off; remove one or move it{other}"
        )

    def within(self, domain: Domain) -> InputError:
        """Return the error in the units of `domain`."""
        gap, thin = self.gap * domain.frame[1], float(domain.extent.min())
        if 0 < thin < gap:
            wider = "" if self.real == np.float64 else "use dtype='float64', or "
            return InputError(
                f"{domain} is {thin:.3g} thin where generators are {gap:.3g} apart, which leaves too much of a cell to "
                f"round-off in {self.real}; {wider}give it a thickness closer to the size of cells"
            )
        return InputError(self._text(domain_position(domain, self.place), gap))


def domain_position(domain: Domain, place: np.ndarray) -> np.ndarray:
    """Return the position in `domain` of a point (d,) in normalized coordinates, also if it is that of an image."""
    origin, scale = domain.frame
    x, lower = origin + scale * place, np.array(domain.lower)
    return np.where(domain.periodic, lower + (x - lower) % domain.extent, x)


@dataclass(frozen=True)
class Tessellation:
    """A Voronoi or power diagram on the device: normalized coordinates, vectors relative to the row's generator."""

    n: int
    points: cla.Array
    """(n, d) real."""
    starts: cla.Array
    """(n + 1,) int32."""
    neighbors: cla.Array
    """(m,) int32. A generator, or ``-1 - wall``; counter-clockwise in 2D."""
    face_measures: cla.Array
    """(m,) real, or single."""
    face_centroids: cla.Array
    """(m, d) real, or single. Relative to the generator; see `Engine.face` for the precision."""
    volumes: cla.Array
    """(n,) real."""
    offsets: cla.Array
    """(n, d) real. Centroid minus generator: the Lloyd displacement."""
    covariances: cla.Array
    """(n, 3) or (n, 6) real. Second moments about the centroid per unit volume: xx, xy, yy in 2D, on a sphere along the
    tangents at the generator (geometry/site.h); xx, xy, xz, yy, yz, zz in 3D."""
    outlines: tuple[cla.Array, ...] = ()
    """The OUTLINE_ARGS of kernels (tessellation/clipped/outline.h): empty where no boundary cuts cells."""
    vertices: tuple[cla.Array, ...] = ()
    """In 3D, while generators move: the vertices as triples of faces, (2 m,) uint32, and the keys of the faces, (m,)
    uint32 (tessellation/polyhedra_update.cl); else empty."""
    part: Part | None = None
    """The part whose rows `neighbors` and `points` name. None if these are the n generators, as in a folded diagram."""
    whole: Tessellation | None = None
    """The diagram of a part with the cells of ghosts, if they have been built."""
    folded: Folded | None = None
    """How the diagram was made from that of generators and images. None after an update, and without images."""
    trimmed: Trimmed | None = None
    """How a boundary cut it out of convex cells. None where no boundary cuts cells."""
    reach: cla.Array | None = None
    """(n,) float32, optional. Distance of the farthest corner of each cell from its generator, or a bound of it, if the
    domain has parts."""
    round_off: int = 0
    """What round-off may have spoiled, for `topology3d.consistency`: bits `NARROW`, faces may be no wider than
    round-off, and `UNEVEN`, cells may differ about their common faces by more than a thousandth of a cell."""
    sites: cla.Array = None  # type: ignore[assignment]
    """(n, d) or (n, d + 1) real. The generators as kernels of the tessellation take them: in a power diagram each row
    ends with the weight."""

    def __post_init__(self) -> None:
        if self.sites is None:
            object.__setattr__(self, "sites", self.points)

    @property
    def graph(self) -> tuple[cla.Array, cla.Array]:
        """Starts and neighbors, as arguments of kernels."""
        return self.starts, self.neighbors

    @property
    def rows(self) -> int:
        """Number of rows of arrays of values that neighbors name: generators, and ghosts if there are any."""
        return self.n if self.part is None else self.part.count

    def first(self, n: int) -> Tessellation:
        """Return the first `n` rows, as views."""
        return replace(
            self,
            n=n,
            starts=self.starts[: n + 1],
            volumes=self.volumes[:n],
            offsets=self.offsets[:n],
            covariances=self.covariances[:n],
            reach=None if self.reach is None else self.reach[:n],
        )

    def forward(self, engine: Engine, *values: cla.Array, sums: PartialSums | None = None) -> np.ndarray:
        """Fill the rows of ghosts in each of `values` (rows, ...), if there are any; see `Part.forward`."""
        return np.empty(0) if self.part is None else self.part.forward(engine, *values, sums=sums)

    def with_ghosts(self, engine: Engine, *values: cla.Array, sums: PartialSums | None = None) -> list[cla.Array]:
        """Return each of `values` (n, ...) followed by those of ghosts, in the workspace; without ghosts, `values`."""
        return list(values) if self.part is None else self.part.with_ghosts(engine, *values, sums=sums)

    def names(self, engine: Engine, labels: cla.Array) -> cla.Array:
        """Return `labels` (n,) int32 of the generators, followed by those of ghosts."""
        known = None if self.part is None else self.part.labels
        return self.with_ghosts(engine, labels)[0] if known is None else known

    def fixed_args(self, engine: Engine, labels: cla.Array | None, fixed: int) -> tuple[object, ...]:
        """Return `labels` (n,) int32 with those of ghosts, and `fixed`, as arguments of kernels.

        Generators with labels below `fixed` are. Without `labels` none is, and another array stands for them.
        """
        return self.starts if labels is None else self.names(engine, labels), np.int32(fixed)

    @property
    def name_args(self) -> tuple[object, ...]:
        """The NAME_ARGS of kernels (adaptation/site_key.h): the labels of a part."""
        labels = None if self.part is None else self.part.labels
        return (np.int32(0), self.starts) if labels is None else (np.int32(1), labels)

    @property
    def is_power(self) -> bool:
        """Whether it is a power diagram."""
        return self.sites.shape[1] > self.points.shape[1]


Follow: TypeAlias = Callable[[Tessellation, cla.Array | None], list[int]]
"""What a caller does with a diagram. It enqueues work, reads its results together with the report (int32), and returns
the numbers of the report. These tell whether the diagram is right. If it is not, its graph is that of the diagram
before, and the caller is called again. Without a report the diagram is right. The last call is with the result."""


def read_report(_: Tessellation, report: cla.Array | None) -> list[int]:
    """Read the report, and do nothing else: the simplest `Follow`."""
    return [] if report is None else report.get().tolist()


@dataclass(frozen=True)
class NeighborRows:
    """Neighbors that the cells of `n` generators start from, on the device; -1 for none."""

    n: int
    starts: cla.Array
    """(n + 1,) int32."""
    neighbors: cla.Array
    """(m,) int32."""

    @property
    def graph(self) -> tuple[cla.Array, cla.Array]:
        """Starts and neighbors, as arguments of kernels."""
        return self.starts, self.neighbors

    @classmethod
    def copy_of(cls, t: Tessellation) -> NeighborRows:
        """Return a copy of the graph of `t`, or of the convex cells that it was cut from."""
        whole = t if t.trimmed is None else t.trimmed.convex
        return cls(whole.n, whole.starts.copy(), whole.neighbors.copy())
