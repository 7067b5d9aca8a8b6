"""Conservative transfer of cell data from one mesh to another: the entry that `Result.transfer` calls."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
import pyopencl as cl

from ..errors import ClvoroError, InputError, InputTypeError, MemoryLimitError
from ..geometry.box import Box
from ..geometry.domain import Domain
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from ..opencl import probe
from ..opencl.devices import shared_context
from ..opencl.engine import Engine
from ..opencl.memory_limits import available_memory, in_bytes
from ..tessellation.bins import Bins
from .device_transfer import CellData, CellGraph, ConservativeTransfer, joined, transfer_bytes
from .host_transfer import TINY, find_defect, transfer_on_host
from .sphere_transfer import transfer_on_sphere
from .unfolded import Unfolded, farthest_neighbor, unfold

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..adapter import Adapter


def transfer_values(
    old: Result | Diagram,
    values: ArrayLike,
    new: Result | Diagram,
    order: int = 1,
    limited: bool = True,
    adapter: Adapter | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Transfer `values` of the cells of `old` to the cells of `new`; see `Diagram.transfer`.

    Returns
    -------
    values : (n_new,) or (n_new, k) float64
        NaN where old cells cover nothing.
    covered : (n_new,) float64
        The covered share of each new cell; see `Diagram.transfer`.
    """
    source, target = _diagram("self", old), _diagram("onto", new)
    _require_one_space(source, target)
    if isinstance(order, bool) or order not in (1, 2):
        raise InputError(f"order is {order!r}, expected 1 or 2")
    given = _checked(values, len(source))
    columns = np.ascontiguousarray(given.reshape(len(source), -1), np.float64)
    # If `values` has no columns, one of zeros is transferred for the shares.
    filled = columns if columns.shape[1] else np.zeros((len(source), 1))
    # Scale to numbers around 1 by powers of two: this is exact, and no product overflows.
    scale = np.exp2(np.ceil(np.log2(np.maximum(np.abs(filled).max(axis=0), 1e-300))))
    same = source.domain == target.domain
    # At the curved walls of a solid the cells of two meshes end at different planes.
    partial = not same or source.domain.curved_walls
    task = source, target, filled / scale, order, bool(limited), partial
    if _on_host(source.domain, target.domain):
        means, low, high, covered = _transfer_on_host(*task)
    else:
        with adapter._alone() if adapter is not None else nullcontext():
            ctx = shared_context() if adapter is None else adapter.ctx
            means, low, high, covered = _transfer_on_device(ctx, *task)
    bounded = order == 1 or bool(limited)
    if same:
        means = _conserve_mass(filled / scale, source.volumes, means, target.volumes, low, high, bounded)
        covered = np.where(covered > 0, 1.0, 0.0)
    elif bounded:
        means = np.clip(means, low, np.maximum(low, high))
    means[covered == 0] = np.nan
    shape = len(target), *given.shape[1:]
    return (means * scale)[:, : columns.shape[1]].reshape(shape), np.minimum(covered, 1)


def _on_host(a: Domain, b: Domain) -> bool:
    """Return whether the host intersects the cells: in polygons and on spheres."""
    return a.curved or a.cuts_cells or b.cuts_cells


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
        diagram.demand_voronoi("transfer")
        return diagram
    raise InputTypeError(f"{name} is a {type(mesh).__name__}, expected a clvoro.Result or a clvoro.Diagram")


def _checked(values: ArrayLike, n: int) -> np.ndarray:
    """Return `values` as an array (n,) or (n, k) of finite float64."""
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InputError(
            f"values cannot be converted to an array ({error}), expected shape ({n},) or ({n}, k)"
        ) from error
    if array.dtype.kind not in "fiub":
        raise InputTypeError(
            f"values has dtype {array.dtype}, expected real numbers; pass the real and the imaginary part of complex "
            "numbers as two columns"
        )
    if array.ndim not in (1, 2) or array.shape[0] != n:
        transposed = array.ndim == 2 and array.shape[1] == n
        raise InputError(
            f"values has shape {array.shape}, expected ({n},) or ({n}, k): a row for each cell of the mesh; "
            + ("pass values.T" if transposed else "call transfer() of the mesh that the values belong to")
        )
    array = array.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(array.reshape(n, -1)).all(axis=1))
    if bad.size:
        raise InputError(
            f"values[{bad[0]}] is {array[bad[0]]}, expected finite numbers ({bad.size} of {n} rows are not): "
            "replace them first"
        )
    return array


def _transfer_on_device(
    ctx: cl.Context, source: Diagram, target: Diagram, columns: np.ndarray, order: int, limited: bool, partial: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return means over the new cells, bounds of the old data in them, and covered shares, float64."""
    queue = cl.CommandQueue(ctx)
    # Double precision where the device has it, whatever the precision of the meshes: intersections lose digits.
    real = np.dtype(np.float64 if probe.has_fp64(queue.device) else np.float32)
    engine = Engine(ctx, queue, source.domain.dim, real)
    box, images, after = _graphs(source, target, partial)
    before = max(images, key=len)
    sizes = ((len(graph), len(graph.neighbors)) for graph in (before, after))
    needed = transfer_bytes(engine, *sizes, columns.shape[1], order)  # type: ignore[arg-type]
    device = queue.device
    if needed > available_memory(device):
        raise MemoryLimitError(
            f"the transfer of {columns.shape[1]} columns from {len(source)} cells to {len(target)} needs "
            f"{in_bytes(needed)} on the device, {device.name.strip()} has {in_bytes(available_memory(device))}: pass "
            "fewer columns at a time, or use another device"
        )
    bins, stage = Bins(engine), ConservativeTransfer(engine)
    new = _upload(engine, box, after)
    sequence = bins.build(box, new.points, new.n).items[: new.n].copy()
    offsets = (source.centroids - source.points) / box.frame[1]
    parts = []
    for image in images:
        old = _upload(engine, box, image)
        binned = bins.build(box, old.points, old.n)
        values, centroids = engine.upload(columns[image.cells]), engine.upload(offsets[image.cells])
        if order == 2:
            data = stage.fit_slopes(box, old, values, centroids, limited)
        else:
            data = CellData(values, values, values, centroids)
        parts.append(stage.transfer(box, old, binned, data, new, sequence, partial))
    got = joined(parts)
    if not partial:
        _require_cover(got.covered, got.volumes, box.dim)
    covered = got.covered / np.maximum(got.volumes, TINY)
    return got.means.astype(float), got.low.astype(float), got.high.astype(float), covered.astype(float)


def _graphs(source: Diagram, target: Diagram, partial: bool) -> tuple[Any, list[Unfolded], Unfolded]:
    """Return a box around all cells, and the cells of both meshes as the device takes them.

    Those of the old mesh are several sets: where the new mesh alone is periodic, one for each image of the old one.
    """
    domain = source.domain
    if domain.plain and not partial:
        return domain, [_as_given(source)], _as_given(target)
    new = unfold(target)
    far = farthest_neighbor(source) + farthest_neighbor(target)
    lower, upper = target.points.min(axis=0) - 2 * far, target.points.max(axis=0) + 2 * far
    old = unfold(source, lower, upper) if any(domain.periodic) else unfold(source)
    alone = np.array(target.domain.periodic) & ~np.array(domain.periodic)
    images = _images(old, target.domain.extent * alone, lower, upper)
    every = np.concatenate([*(image.points for image in images), new.points])
    margin = 0.01 * float(np.ptp(every, axis=0).max())
    return Box(tuple(every.min(axis=0) - margin), tuple(every.max(axis=0) + margin)), images, new


def _images(old: Unfolded, periods: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> list[Unfolded]:
    """Return the images of cells by `periods` (d,), 0 where there are none, with generators between two corners."""
    generators = old.points[: len(old)]
    bottom, top = generators.min(axis=0), generators.max(axis=0)
    steps = [
        range(math.ceil((a - t) / p), math.floor((b - s) / p) + 1) if p else (0,)
        for a, b, s, t, p in zip(lower, upper, bottom, top, periods, strict=True)
    ]
    offsets = [np.array(step) * periods for step in product(*steps)]
    return [replace(old, points=old.points + x, offsets=old.offsets + x) for x in offsets] or [old]


def _as_given(diagram: Diagram) -> Unfolded:
    """Return the cells of a diagram in a box without periodic sides. The device cuts them at the walls of the box."""
    n = len(diagram)
    starts, neighbors = diagram.neighbor_starts, diagram.neighbors
    return Unfolded(diagram.points, starts, neighbors, np.arange(n), np.zeros((n, diagram.domain.dim)))


def _transfer_on_host(
    source: Diagram, target: Diagram, columns: np.ndarray, order: int, limited: bool, partial: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Do what `_transfer_on_device` does, for polygons and spheres."""
    work = transfer_on_sphere if source.domain.curved else transfer_on_host
    means, low, high, covered = work(source, target, columns, order, limited)
    if not partial:
        unit = source.domain.frame[1] ** 2
        _require_cover(covered / unit, target.volumes / unit, 2)
    return means, low, high, covered / target.volumes


def _require_cover(covered: np.ndarray, volumes: np.ndarray, dim: int) -> None:
    """Raise ClvoroError unless the intersections of each cell fill it. Volumes are normalized."""
    worst = find_defect(covered, volumes, dim)
    if worst is not None:
        raise ClvoroError(
            f"the intersections of new cell {worst} with old cells fill {covered[worst] / volumes[worst]:.6g} of it, "
            "expected 1: one of the meshes is not the Voronoi diagram of its points; call diagram.check() on both"
        )


def _upload(engine: Engine, box: Any, graph: Unfolded) -> CellGraph:
    """Copy the graph of cells to the device."""
    origin, scale = box.frame
    return CellGraph(
        len(graph),
        engine.upload((graph.points - origin) / scale),
        engine.upload(graph.starts, np.int32),
        engine.upload(graph.neighbors, np.int32),
    )


def _conserve_mass(
    columns: np.ndarray,
    old_volumes: np.ndarray,
    means: np.ndarray,
    volumes: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    bounded: bool,
) -> np.ndarray:
    """Correct `means` (n, width) so that their mass is that of `columns`, with the volumes of the diagrams.

    The intersections of a cell sum to its volume to round-off, so the mass is wrong by round-off. Each cell takes a
    share of the missing mass in proportion to V times the distance of its mean from the upper bound of its data; a
    surplus likewise with the lower bound. No mean leaves its bounds, and constant data stays constant.
    """
    # The means exceed the bounds by round-off at most.
    q = np.clip(means, low, high) if bounded else means.copy()
    # Twice: the second pass corrects the round-off of the first.
    for _ in range(2):
        for c in range(q.shape[1]):
            missing = _sum(old_volumes, columns[:, c]) - _sum(volumes, q[:, c])
            bound = high[:, c] if missing > 0 else low[:, c]
            room = bound - q[:, c]
            if not bounded:
                room = np.maximum(room, 0) if missing > 0 else np.minimum(room, 0)
            capacity = _sum(volumes, room)
            if missing != 0 and capacity != 0:
                q[:, c] += min(missing / capacity, 1.0) * room
    return np.clip(q, low, high) if bounded else q


def _sum(volumes: np.ndarray, values: np.ndarray) -> float:
    """Sum the products, in extended precision where the platform has it."""
    return np.sum(np.multiply(volumes, values, dtype=np.longdouble))
