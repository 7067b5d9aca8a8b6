"""Conservative transfer of cell data from one mesh to another: the entry that `Result.transfer` calls."""

from __future__ import annotations

from contextlib import nullcontext
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

from ..errors import ClvoroError, InputError, InputTypeError, MemoryLimitError
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from ..opencl import probe
from ..opencl.devices import create_context
from ..opencl.engine import Engine
from ..opencl.memory_limits import available_memory, in_bytes
from ..tessellation.bins import Bins
from .device_transfer import CellData, CellGraph, ConservativeTransfer, transfer_bytes
from .host_transfer import find_defect, transfer_on_host
from .sphere_transfer import transfer_on_sphere

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
) -> np.ndarray:
    """Transfer `values` of the cells of `old` to the cells of `new`; see `Result.transfer`."""
    source, target = _diagram("self", old), _diagram("onto", new)
    if source.domain != target.domain:
        raise InputError(
            f"onto is a mesh of {target.domain}, the values are on {source.domain}; expected the same domain: make "
            "both meshes with one domain"
        )
    on_host = not source.domain.plain
    if on_host and source.domain.cell_dim == 3:
        raise InputError(
            f"the meshes are of {source.domain}; expected a domain with walls, since transfer in 3D periodic boxes is "
            "not supported"
        )
    if isinstance(order, bool) or order not in (1, 2):
        raise InputError(f"order is {order!r}, expected 1 or 2")
    given = _checked(values, len(source))
    columns = np.ascontiguousarray(given.reshape(len(source), -1), np.float64)
    if columns.shape[1] == 0:
        return np.zeros((len(target), 0))
    # Scale to numbers around 1 by powers of two: this is exact, and no product overflows.
    scale = np.exp2(np.ceil(np.log2(np.maximum(np.abs(columns).max(axis=0), 1e-300))))
    task = source, target, columns / scale, order, bool(limited)
    if on_host:
        means, low, high = _transfer_on_host(*task)
    else:
        with adapter._alone() if adapter is not None else nullcontext():
            ctx = _default_context() if adapter is None else adapter.ctx
            means, low, high = _transfer_on_device(ctx, *task)
    bounded = order == 1 or bool(limited)
    conserved = _conserve_mass(columns / scale, source.volumes, means, target.volumes, low, high, bounded)
    return (conserved * scale).reshape(len(target), *given.shape[1:])


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


@lru_cache(maxsize=1)
def _default_context() -> cl.Context:
    """Return one context for all calls, so that programs are built once."""
    return create_context()


def _transfer_on_device(
    ctx: cl.Context, source: Diagram, target: Diagram, columns: np.ndarray, order: int, limited: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return means over the new cells and bounds of the old data in them, (n, width) float64 each."""
    queue = cl.CommandQueue(ctx)
    # Double precision where the device has it, whatever the precision of the meshes: intersections lose digits.
    real = np.dtype(np.float64 if probe.has_fp64(queue.device) else np.float32)
    engine, box = Engine(ctx, queue, source.domain.dim, real), source.domain
    before, after = ((len(mesh), len(mesh.neighbors)) for mesh in (source, target))
    needed = transfer_bytes(engine, before, after, columns.shape[1], order)
    device = queue.device
    if needed > available_memory(device):
        raise MemoryLimitError(
            f"the transfer of {columns.shape[1]} columns from {len(source)} cells to {len(target)} needs "
            f"{in_bytes(needed)} on the device, {device.name.strip()} has {in_bytes(available_memory(device))}: pass "
            "fewer columns at a time, or use another device"
        )
    bins, stage = Bins(engine), ConservativeTransfer(engine)
    old, new = _upload(engine, source), _upload(engine, target)
    sequence = bins.build(box, new.points, new.n).items[: new.n].copy()
    binned = bins.build(box, old.points, old.n)
    values = engine.upload(columns)
    centroids = engine.upload((source.centroids - source.points) / box.frame[1])
    if order == 2:
        data = stage.fit_slopes(box, old, values, centroids, limited)
    else:
        data = CellData(values, values, values, centroids)
    got = stage.transfer(box, old, binned, data, new, sequence)
    _require_cover(got.covered, got.volumes, box.dim)
    return got.means.astype(float), got.low.astype(float), got.high.astype(float)


def _transfer_on_host(
    source: Diagram, target: Diagram, columns: np.ndarray, order: int, limited: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Do what `_transfer_on_device` does, for polygons, 2D periodic boxes and spheres."""
    work = transfer_on_sphere if source.domain.curved else transfer_on_host
    means, low, high, covered = work(source, target, columns, order, limited)
    unit = source.domain.frame[1] ** 2
    _require_cover(covered / unit, target.volumes / unit, 2)
    return means, low, high


def _require_cover(covered: np.ndarray, volumes: np.ndarray, dim: int) -> None:
    """Raise ClvoroError unless the intersections of each cell fill it. Volumes are normalized."""
    worst = find_defect(covered, volumes, dim)
    if worst is not None:
        raise ClvoroError(
            f"the intersections of new cell {worst} with old cells fill {covered[worst] / volumes[worst]:.6g} of it, "
            "expected 1: one of the meshes is not the Voronoi diagram of its points; call diagram.check() on both"
        )


def _upload(engine: Engine, diagram: Diagram) -> CellGraph:
    """Copy the graph of a diagram to the device."""
    origin, scale = diagram.domain.frame
    return CellGraph(
        len(diagram),
        engine.upload((diagram.points - origin) / scale),
        engine.upload(diagram.neighbor_starts, np.int32),
        engine.upload(diagram.neighbors, np.int32),
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
