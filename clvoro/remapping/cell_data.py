"""Conservative transfer of cell data from one mesh to another: the entry that `Result.transfer` calls."""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl
import scipy

from ..arguments import check_cell_values
from ..errors import ClvoroError, InputError, InputTypeError, MemoryLimitError
from ..geometry.box import Box
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from ..opencl import probe
from ..opencl.devices import shared_context
from ..opencl.engine import PLAIN, Engine, Traits
from ..opencl.memory_limits import available_memory, in_bytes
from .device_transfer import CellData, CellGraph, ConservativeTransfer, Pieces, Space, transfer_bytes

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..adapter import Adapter

_COVERED = 1e-6
"""A new cell counts as covered if old cells leave no more than this share of it bare."""
COVER_TOLERANCE = 1e-3
"""Largest accepted difference between a cell's volume and that of its pieces or intersections, as a share of it."""


def transfer_values(
    old: Result | Diagram,
    values: ArrayLike,
    new: Result | Diagram,
    order: int = 1,
    limited: bool = True,
    adapter: Adapter | None = None,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Transfer `values` of the cells of `old` to the cells of `new`; see `Diagram.transfer`.

    Results:
    - `values` (n_new,) or (n_new, k) float64: NaN where old cells cover nothing, unless the meshes have one domain.
    - `covered` (n_new,) float64: the covered share of each new cell; see `Diagram.transfer`.
    - `missing`: number of cells that are not covered, or only in part; 0 if the meshes have one domain.
    """
    source, target = _diagram("self", old), _diagram("onto", new)
    _require_one_space(source, target)
    if isinstance(order, bool) or order not in (1, 2):
        raise InputError(f"order is {order!r}, expected 1 or 2")
    if adapter is not None and not hasattr(adapter, "ctx"):
        raise InputTypeError(f"adapter is a {type(adapter).__name__}, expected a clvoro.Adapter, or None")
    given = check_cell_values("values", values, len(source), least=0)
    columns = np.ascontiguousarray(given.reshape(len(source), -1), np.float64)
    # If `values` has no columns, one of zeros is transferred for the shares.
    filled = columns if columns.shape[1] else np.zeros((len(source), 1))
    # Scale to numbers around 1 by powers of two: this is exact, and no product overflows.
    scale = np.exp2(np.floor(np.log2(np.maximum(np.abs(filled).max(axis=0), 1e-300))))
    same = source.domain.same_region(target.domain)
    with adapter._alone() if adapter is not None else nullcontext():
        ctx = shared_context() if adapter is None else adapter.ctx
        means, low, high, covered = _intersected(ctx, source, target, filled / scale, order, bool(limited))
    bare = np.flatnonzero(covered == 0)
    if same:
        if not (source.has_moved_vertices or target.has_moved_vertices):
            _require_cover(np.where(target.volumes > 0, covered, 1))
            covered = np.where(covered > 0, 1.0, 0.0)
        if bare.size:  # empty cells, and thin ones between a curved wall and the planes that bound old cells there
            nearest = scipy.spatial.KDTree(source.centroids).query(target.centroids[bare])[1]
            means[bare] = low[bare] = high[bare] = (filled / scale)[nearest]
        if order == 2 and not limited:
            low, high = np.minimum(low, means), np.maximum(high, means)
        means = conserved(filled / scale, source.volumes, means, target.volumes, low, high)
    else:
        if order == 1 or limited:
            means = np.clip(means, low, np.maximum(low, high))
        means[bare] = np.nan
    missing = 0 if same else int((covered < 1 - _COVERED).sum())
    shape = len(target), *given.shape[1:]
    return (means * scale)[:, : columns.shape[1]].reshape(shape), np.minimum(covered, 1), missing


def _require_one_space(source: Diagram, target: Diagram) -> None:
    """Raise InputError if cells of the meshes cannot overlap: of different dimensions, spheres or periods."""
    a, b = source.domain, target.domain
    if (a.cell_dim, a.dim) != (b.cell_dim, b.dim):
        raise InputError(
            f"onto is a mesh of {b}, the values are on {a}; expected meshes in one space: both in the plane, in 3D, or "
            "on a sphere"
        )
    if not a.same_surface(b):
        raise InputError(
            f"onto is a mesh of {b}, the values are on {a}; expected one radius: give both spheres the same unit"
        )
    both = np.array(a.periodic) & np.array(b.periodic)
    apart = both & (a.extent != b.extent)
    if apart.any():
        axis = int(apart.argmax())
        raise InputError(
            f"the meshes have periods of {a.extent[axis]:g} and {b.extent[axis]:g} along axis {axis}, expected one "
            "period; transfer onto a box with walls, or with the same period"
        )


def _diagram(name: str, mesh: object) -> Diagram:
    """Return the diagram of a mesh."""
    diagram = mesh.diagram if isinstance(mesh, Result) else mesh
    if isinstance(diagram, Diagram):
        return diagram
    raise InputTypeError(f"{name} is a {type(mesh).__name__}, expected a clvoro.Result or a clvoro.Diagram")


def _intersected(
    ctx: cl.Context, source: Diagram, target: Diagram, columns: np.ndarray, order: int, limited: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return means over the new cells, bounds of the old data in them, and covered shares, float64."""
    queue, domain = cl.CommandQueue(ctx), source.domain
    device, n = queue.device, len(target)
    # Double precision where the device has it, whatever the precision of the meshes: intersections lose digits.
    real = np.dtype(np.float64 if probe.has_fp64(device) else np.float32)
    engine = Engine(ctx, queue, domain.dim, real, Traits(("SPHERE",), curved=True) if domain.curved else PLAIN)
    parts = Pieces.of(source), Pieces.of(target)
    needed = transfer_bytes(engine, *parts, len(source.neighbors), columns.shape[1], order)
    if needed > available_memory(device):
        raise MemoryLimitError(
            f"the transfer of {columns.shape[1]} columns from {len(source)} cells to {len(target)} needs "
            f"{in_bytes(needed)} on the device, {device.name.strip()} has {in_bytes(available_memory(device))}: pass "
            "fewer columns at a time, or use another device"
        )
    space = _space(source, target)
    stage = ConservativeTransfer(engine, space)
    old, new = (stage.upload(p) for p in parts)
    measures = stage.measure(old, "the diagram of the values")
    _require_volumes("self", source, parts[0].summed(measures.volumes, len(source)), space)
    means = space.place(source.centroids)
    if domain.curved:
        means[parts[0].cells] = measures.centroids
    elif source.has_moved_vertices:  # as the pieces have them, so that slopes add no mass
        moments = parts[0].summed(measures.volumes[:, None] * measures.centroids, len(source))
        volumes = parts[0].summed(measures.volumes, len(source))
        means = np.where(volumes[:, None] > 0, moments / np.maximum(volumes, 1e-300)[:, None], means)
    values = engine.upload(columns)
    data = CellData(engine.upload(old.pieces.cells, np.int32), values, values, values, engine.upload(means))
    periods = np.where(domain.periodic, domain.extent, 0) / space.scale
    if order == 2:
        graph = CellGraph(source.neighbor_starts, source.neighbors, source.shifts, periods)
        data = stage.fit_slopes(old, graph, data, limited)
    other = np.where(target.domain.periodic, target.domain.extent, 0) / space.scale
    results = stage.transfer(new, old, measures, np.maximum(periods, other), data)
    means, low, high, volumes, covered = _of_cells(parts[1], n, *(x.astype(np.float64) for x in results))
    _require_volumes("onto", target, volumes, space)
    return means, low, high, covered / np.where(volumes > 0, volumes, 1)


def _of_cells(
    pieces: Pieces,
    n: int,
    masses: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    volumes: np.ndarray,
    covered: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Return means and bounds of `n` cells, their volumes and covered volumes, from those of their pieces."""
    if len(pieces) != n:
        masses, volumes, covered = (pieces.summed(x, n) for x in (masses, volumes, covered))
        bounds = np.full((n, low.shape[1]), np.inf), np.full((n, low.shape[1]), -np.inf)
        np.minimum.at(bounds[0], pieces.cells, low)
        np.maximum.at(bounds[1], pieces.cells, high)
        low, high = bounds
    return masses / np.where(covered > 0, covered, 1)[:, None], low, high, volumes, covered


def _space(source: Diagram, target: Diagram) -> Space:
    """Return coordinates in which both meshes are in the unit box; on a sphere its radius is 1."""
    if source.domain.curved:
        return Space(*source.domain.frame, np.full(3, -1.0), np.full(3, 1.0))
    # Cells extend beyond their domain by half of it at most: across seams, and between planes at curved walls.
    ends = [end for d in (source.domain, target.domain) for end in (d.lower - d.extent / 2, d.upper + d.extent / 2)]
    lower, upper = np.min(ends, axis=0), np.max(ends, axis=0)
    origin, scale = Box(tuple(lower), tuple(upper)).frame
    return Space(origin, scale, (lower - origin) / scale, (upper - origin) / scale)


def _require_volumes(name: str, diagram: Diagram, found: np.ndarray, space: Space) -> None:
    """Raise InputError unless cells have the volumes `found`, in the coordinates of the space."""
    if diagram.has_moved_vertices:
        return
    dim = diagram.domain.cell_dim
    volumes = diagram.volumes / space.scale**dim
    slack = 64 * np.finfo(np.float32).eps * volumes ** (1 - 1 / dim)
    defect = np.abs(found - volumes) - COVER_TOLERANCE * volumes - slack
    worst = int(defect.argmax())
    if defect[worst] > 0:
        raise InputError(
            f"cell {worst} of {name}, rebuilt from its faces, has {found[worst] / volumes[worst]:.6g} of its volume, "
            "expected Voronoi diagrams of distinct generators: call diagram.check() on it"
        )


def _require_cover(covered: np.ndarray) -> None:
    """Raise ClvoroError unless the intersections of each cell fill it; `covered` are the shares."""
    off = np.abs(covered - 1)
    worst = int(off.argmax())
    if off[worst] > COVER_TOLERANCE:
        raise ClvoroError(
            f"the intersections of new cell {worst} with old cells fill {covered[worst]:.6g} of it, expected 1"
        )


def conserved(
    columns: np.ndarray,
    old_volumes: np.ndarray,
    means: np.ndarray,
    volumes: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """Correct `means` (n, width) so that their mass is that of `columns` (m, width), within bounds.

    The intersections of a cell sum to its volume to round-off, so the mass is wrong by round-off. Each cell takes a
    share of the missing mass in proportion to V times the distance of its mean from the upper bound of its data; a
    surplus likewise with the lower bound. No mean leaves its bounds, and constant data stays constant.

    - `old_volumes`, `volumes`: (m,), (n,) float64
    - `low`, `high`: (n, width) or (width,) float64
    """
    low, high = (np.broadcast_to(bound, means.shape) for bound in (low, high))
    # The means exceed the bounds by round-off at most.
    q = np.clip(means, low, high)
    # Twice: the second pass corrects the round-off of the first.
    for _ in range(2):
        for c in range(q.shape[1]):
            missing = _sum(old_volumes, columns[:, c]) - _sum(volumes, q[:, c])
            room = (high[:, c] if missing > 0 else low[:, c]) - q[:, c]
            capacity = _sum(volumes, room)
            if missing != 0 and capacity != 0:
                q[:, c] += min(missing / capacity, 1.0) * room
    return np.clip(q, low, high)


def _sum(volumes: np.ndarray, values: np.ndarray) -> float:
    """Sum the products, in extended precision where the platform has it."""
    return np.sum(np.multiply(volumes, values, dtype=np.longdouble))
