"""A size field with bounded growth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, InputTypeError, MemoryLimitError
from ..geometry.domain import Domain
from ..opencl.engine import PLAIN, Engine, Traits
from ..opencl.memory_limits import host_memory
from .arguments import check_slope, coverage_warnings
from .field import Field, as_field, count_parts, on_domain
from .gradation import GlobeGrid, Gradation, Grid, globe_columns
from .raster import Raster

if TYPE_CHECKING:
    from .codegen import CodeWriter

_MOST_NODES = 1 << 22  # by default
_MAX_NODES_GIVEN = 2**31 - 1  # of a resolution that the caller gives
_BATCH = 1 << 18  # nodes that are evaluated at once
_BYTES_PER_NODE = 48  # on the host, at most
_PROBES = {2: 129, 3: 33}  # nodes along the longest side of the grid that samples the smallest size
_PROBES_ON_GLOBE, _LEAST_ON_GLOBE = 1 << 13, 128  # places that sample it on a sphere, least number along the equator


class Graded(Field):
    """A field with its growth limited: the largest one below it with ``|grad h| <= slope``.

    ``h(x) = min over y of field(y) + slope |x - y|``: small sizes stay, and sizes grow from them with bounded slope.
    It is computed once per domain, on a grid, when it is first needed: a first-order upwind scheme solves the Eikonal
    equation. Between nodes it is a `Raster`. The error of the scheme is about the growth over one spacing, mostly
    towards larger sizes: slopes of the result are within the bound along the axes, and up to a few per cent above it
    in other directions. At a node the result is never above `field`. Minima narrower than the spacing are included if
    they are landmarks of the field (shapes of a `Distance`, minima of a `Raster`) or at a node.

    Parameters
    ----------
    field : Field, number or callable
    growth : float, optional
        Geometric growth rate g >= 1, the ratio of the sizes of neighboring cells. The slope is ln(growth), as for
        `Distance`.
    slope : float, optional
        Bound of |grad h|, in place of `growth`. 0 gives the smallest size everywhere.
    box : Box, Polygon or Solid, optional
        Region of the grid; by default the domain. Outside, the nearest value is used. In a polygon `field` is
        evaluated inside only; sizes also grow straight across the outside. Not for spheres.
    resolution : int or sequence of d ints, optional
        Number of nodes along the longest side of the box, or along each axis. By default the spacing is the smallest
        size (of the field on a coarse grid and at its landmarks), with at least 129 nodes along the longest side (33 in
        3D) and at most 2^22 in total (2048 x 2048, 161^3; 32 MiB in float64). On a sphere it is the number of nodes
        along the equator, at most 2848 by default (14 km on the Earth). The error of the growth is about slope times
        the spacing.

    Raises
    ------
    InputError, InputTypeError
        If an argument is out of range or of the wrong kind.
    MemoryLimitError
        When it is computed, if host or device have not enough memory for the nodes of `resolution`.
    SizeFieldError
        When it is computed, if `field` is not positive and finite at a node.

    Examples
    --------
    A jump in size by 20 becomes a ramp on its coarse side::

        jump = clvoro.sizing.Expression("x < 1 ? 0.01 : 0.2")
        size = clvoro.sizing.Graded(jump, growth=1.2)
        clvoro.Adapter().run(clvoro.Box((0, 0), (3, 1)), size).plot("size")
    """

    def __init__(
        self,
        field: object,
        growth: float | None = None,
        *,
        slope: float | None = None,
        box: Domain | None = None,
        resolution: int | Sequence[int] | None = None,
    ):
        self.field = as_field(field)
        self.parts = count_parts(self.field)
        self.slope = check_slope("Graded", growth, slope)
        self.on_sphere = self.field.on_sphere
        if box is not None and not isinstance(box, Domain):
            raise InputTypeError(f"Graded box is {type(box).__name__}, expected a clvoro.Box or clvoro.Polygon")
        if box is not None:
            on_domain(box, self.field).check_dim(box.dim)
        self.box, self.dim = box, self.field.dim if box is None else box.dim
        self.resolution = None if resolution is None else _check_resolution(resolution, self.dim)
        self._rasters: dict[tuple, Raster] = {}
        self._latest: Domain | None = box
        self._peak_bytes = 0  # device memory of the latest computation

    def raster(self, domain: Domain | None = None, engine: Engine | None = None) -> Raster:
        """Return the field as a `Raster` over its box, or over `domain`. It is computed once.

        Raises
        ------
        InputError
            If there is neither a box nor a domain.
        """
        box = self.box or domain or self._latest
        if box is None:
            raise InputError(
                f"{self!r} has no domain to be computed on; pass box=, such as Graded(field, 1.2, box=domain)"
            )
        self._latest = box
        known = [raster for (b, _), raster in self._rasters.items() if b == box]
        if engine is None and known:
            return known[0]
        engine = engine or default_engine(box.dim, PLAIN if box.globe is None else box.traits(np.dtype(np.float64)))
        key = (box, engine.real)
        if key not in self._rasters:
            self._rasters[key] = self._compute(box, engine)
        return self._rasters[key]

    def check_dim(self, dim: int) -> None:  # noqa: D102
        super().check_dim(dim)
        self.field.check_dim(dim)

    def landmarks(self, domain: Domain) -> np.ndarray:  # noqa: D102
        return self.raster(domain).landmarks(domain)

    def warnings(self, domain: Domain) -> list[str]:  # noqa: D102
        found = self.field.warnings(domain if self.box is None else self.box)
        if self.box is not None:
            found += coverage_warnings(repr(self), domain, self.box.lower, self.box.upper, "give a larger box")
        return found

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self.raster()._evaluate(points)

    def _emit(self, writer: CodeWriter) -> str:
        return self.raster_for(writer, writer.domain)._emit(writer)

    def raster_for(self, writer: CodeWriter, domain: Domain) -> Raster:
        """Return `raster` for `domain`, and tell `writer` what memory its computation took, if there was one."""
        known = len(self._rasters)
        raster = self.raster(domain, writer.engine)
        if len(self._rasters) > known:
            writer.peak_bytes = max(writer.peak_bytes, self._peak_bytes)
        return raster

    def _compute(self, box: Domain, engine: Engine) -> Raster:
        from .evaluation import Sizing

        evaluate = Sizing(engine, box, self.field)
        marks = evaluate.field.landmarks(box)
        marks = marks[box.contains(marks)]
        at_marks = evaluate(marks) if len(marks) else np.zeros(0)
        grid = self._grid(box, evaluate, at_marks)
        self._check_room(len(grid), engine)
        values = np.empty(len(grid))
        for first in range(0, len(values), _BATCH):
            rows = np.arange(first, min(first + _BATCH, len(values)))
            values[rows] = self._at_nodes(box, evaluate, grid, rows)
        # Nodes outside of the domain: above all values that sizes can grow to.
        far = np.isinf(values)
        values[far] = values[~far].max(initial=0) + self.slope * box.extent.sum()
        for rows in grid.around(marks) if len(marks) else ():
            away = box.lengths(np.linalg.norm(grid.nodes(rows) - marks, axis=1))
            np.minimum.at(values, rows, at_marks + self.slope * away)
        scale, peak_bytes = box.frame[1], evaluate.peak_bytes
        del evaluate  # frees its memory
        if grid.globe:
            engine = Engine(engine.ctx, engine.queue, 2, engine.real, workspace=engine.workspace, pool=engine.pool)
        on_device = engine.upload(values / scale)
        self._peak_bytes = max(peak_bytes, on_device.nbytes)
        Gradation(engine, grid.globe).sweep_tiles(on_device, grid.counts.tolist(), grid.spacing, self.slope)
        limited = np.minimum(on_device.get().astype(float) * scale, values)
        return Raster(limited.reshape(grid.counts[::-1]), *grid.corners, at=grid.at)

    def _at_nodes(
        self, box: Domain, evaluate: Callable[[np.ndarray], np.ndarray], grid: Grid, rows: np.ndarray
    ) -> np.ndarray:
        """Return the field at nodes (k,) int of `grid`; infinite at those outside the domain.

        A node at most one spacing outside gets the value that the nearest point inside allows, so that no narrow strait
        is lost between the nodes.
        """
        polygon, nodes = box.outline, grid.nodes(rows)
        if polygon is None:
            return evaluate(nodes)
        values = np.full(len(nodes), math.inf)
        inside = box.contains(nodes)
        out = np.flatnonzero(~inside)
        spacing = float(np.hypot(*(axis[1] - axis[0] for axis in grid.axes)))
        edge, nearest = polygon.nearest_edge(nodes[out], within=spacing)
        near = edge >= 0
        places = np.concatenate([nodes[inside], nearest[near]])
        if len(places):
            h = evaluate(places)
            away = np.hypot(*(nearest - nodes[out])[near].T)
            values[inside] = h[: np.count_nonzero(inside)]
            values[out[near]] = h[np.count_nonzero(inside) :] + self.slope * away
        return values

    def _grid(self, box: Domain, evaluate: Callable[[np.ndarray], np.ndarray], at_marks: np.ndarray) -> Grid:
        """Return the grid over `box`, for a field with the values `at_marks`."""
        globe = box.globe
        if globe is None:
            return Grid(box, self._counts(box, evaluate, at_marks))
        if isinstance(self.resolution, int):
            return GlobeGrid(globe, globe_columns(self.resolution))
        least = min(evaluate(globe.even_points(_PROBES_ON_GLOBE)).min(), at_marks.min(initial=math.inf))
        wanted = max(2 * math.pi * globe.radius / least, _LEAST_ON_GLOBE)
        columns = globe_columns(min(wanted, math.sqrt(2 * _MOST_NODES)))
        while columns * columns // 2 > _MOST_NODES:
            columns = globe_columns(columns - 64)
        return GlobeGrid(globe, columns)

    def _counts(self, box: Domain, evaluate: Callable[[np.ndarray], np.ndarray], at_marks: np.ndarray) -> np.ndarray:
        """Return the numbers of nodes along the axes."""
        if isinstance(self.resolution, tuple):
            return np.array(self.resolution)
        longest = box.extent.max()
        if self.resolution is not None:
            counts = _along(box, longest / (self.resolution - 1))
            if np.prod(counts, dtype=float) > _MAX_NODES_GIVEN:
                raise InputError(
                    f"Graded resolution is {self.resolution}, which makes {np.prod(counts, dtype=float):.3g} nodes of "
                    f"{box!r}, expected fewer than 2^31; leave it out, or give a smaller one"
                )
            return counts
        coarse = longest / (_PROBES[box.dim] - 1)
        counts = _along(box, coarse)
        probes = np.stack(np.meshgrid(*Grid(box, counts).axes, indexing="ij"), axis=-1).reshape(-1, box.dim)
        if box.cuts_cells:
            probes = np.concatenate([probes[box.contains(probes)], box.inner_points()])
        least = min(evaluate(probes).min(), at_marks.min(initial=math.inf))
        finest = (box.measure / _MOST_NODES) ** (1 / box.dim)
        spacing = min(max(least, finest), coarse)
        while np.prod(_along(box, spacing), dtype=float) > _MOST_NODES:
            spacing *= 1.02
        return _along(box, spacing)

    def _check_room(self, n: int, engine: Engine) -> None:
        """Raise if host or device have not enough memory for `n` nodes."""
        device = engine.queue.device
        name, own = device.name.strip(), n * engine.real.itemsize
        for where, needed, has in (
            ("the host", n * _BYTES_PER_NODE, host_memory()),
            (name, own, device.global_mem_size),
            (f"{name} in one piece", own, device.max_mem_alloc_size),
        ):
            if needed > has:
                raise MemoryLimitError(
                    f"Graded resolution is {self.resolution}, which makes {n:.3g} nodes and needs "
                    f"{needed / 2**30:.3g} GiB; {where} has {has / 2**30:.3g} GiB. Give a smaller one, or leave it out"
                )

    def __repr__(self) -> str:
        return f"Graded({self.field!r}, slope={self.slope:g})"


def _along(box: Domain, spacing: float) -> np.ndarray:
    """Return the numbers of nodes along the axes for a spacing of at most `spacing`, at least two."""
    return np.maximum(np.ceil(box.extent / spacing * (1 - 1e-12)).astype(np.int64), 1) + 1


def _check_resolution(resolution: int | Sequence[int], dim: int | None) -> int | tuple[int, ...]:
    given = np.asarray(resolution)
    if given.dtype.kind not in "iu":
        raise InputTypeError(f"Graded resolution is {resolution!r}, expected integers")
    if given.ndim > 1 or (given.ndim and given.size not in ((dim,) if dim else (2, 3))):
        raise InputError(f"Graded resolution has shape {given.shape}, expected one number of nodes or one per axis")
    if given.min() < 2 or np.prod(given, dtype=float) > _MAX_NODES_GIVEN:
        raise InputError(
            f"Graded resolution is {resolution!r}, expected at least 2 nodes along each axis and fewer than 2^31 in all"
        )
    return tuple(given.tolist()) if given.ndim else int(given)


def default_engine(dim: int, traits: Traits = PLAIN) -> Engine:
    """Return an engine on the default device, in float64 where it has that."""
    import pyopencl as cl

    from ..opencl.devices import has_fp64, shared_context

    ctx = shared_context()
    queue = cl.CommandQueue(ctx)
    return Engine(ctx, queue, dim, np.dtype(np.float64 if has_fp64(queue.device) else np.float32), traits)
