"""`Adapter`: the full interface."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from typing import TYPE_CHECKING, Literal, NoReturn

import numpy as np
import pyopencl as cl

from .adaptation.estimates import check_memory
from .adaptation.options import (
    Checkpoint,
    EffortName,
    MethodName,
    MultilevelOptions,
    PaperOptions,
    Start,
    merged_options,
)
from .adaptation.preparation import prepare
from .adaptation.run import Run, check_run
from .adaptation.stages import Stages
from .adaptation.transport import RELAXED, power_diagram_of, transport_to
from .arguments import check_choice, check_integer, check_points, coincident_named
from .errors import InputError, InputTypeError, MemoryLimitError
from .geometry.boundary_layers import Layers
from .geometry.domain import Domain
from .mesh.diagram import Diagram
from .mesh.results import Result, Transported
from .opencl import devices as device
from .opencl.build_notice import BuildNotice, report_builds
from .opencl.engine import Engine
from .opencl.prebuild import renew
from .opencl.probe import check_process
from .tessellation.readback.diagram import make_diagram

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, DTypeLike


class Adapter:
    """Adapts Voronoi meshes on one device.

    An adapter builds kernels when it first needs them, and keeps them and its device memory. Calls from several threads
    wait for each other. A process that was forked after the first use of OpenCL cannot use it (`DeviceError`); spawn
    processes instead.

    Parameters
    ----------
    ctx : pyopencl.Context, optional
        Any context; by default that of `clvoro.create_context()`.
    dtype : "float64" or "float32"
        Precision on the device.

    Attributes
    ----------
    ctx, queue : pyopencl.Context, pyopencl.CommandQueue
    dtype : numpy.dtype
    on_memory : callable, optional
        Called by a run, before it begins, with the bytes that it needs on the device; see `memory_needed`.
    on_build : callable, optional
        Called by a first run with the number of kernels that are built, and of those that it needs. Without it such a
        run shows a line on the terminal, if the standard error is one.
    on_work : callable, optional
        Called with the name of each part of the work after the last step: that at the walls of a solid.

    Raises
    ------
    DeviceError
        If no device works, or it has no double precision and `dtype` is "float64".
    InputError, InputTypeError
        If `dtype` is another type, or `ctx` is not a context.

    Examples
    --------
    >>> adapter = clvoro.Adapter(dtype="float32")
    >>> unit = clvoro.Box((0, 0), (1, 1))
    >>> result = adapter.run(unit, lambda p: 0.05 + 0.1 * p[:, 0], effort="fast", seed=7)
    >>> result.points.shape == (len(result.diagram), 2)
    True
    """

    def __init__(
        self, ctx: cl.Context | None = None, dtype: Literal["float64", "float32"] | DTypeLike = "float64"
    ) -> None:
        try:
            real = np.dtype(dtype)  # type: ignore[arg-type]
        except TypeError:
            real = np.dtype(object)
        if dtype is None or real not in (np.dtype(np.float64), np.dtype(np.float32)):
            raise InputError(f"dtype is {dtype!r}, expected 'float64' or 'float32'")
        if ctx is not None and not isinstance(ctx, cl.Context):
            raise InputTypeError(
                f"ctx is {ctx!r} of type {type(ctx).__name__}, expected a pyopencl.Context or None; write "
                "clvoro.create_context(device), with a device or a part of its name"
            )
        check_process()
        self.ctx = device.create_context(fp64=real == np.float64) if ctx is None else ctx
        self.dtype = real
        if real == np.float64:
            device.require_fp64(self.ctx)
        self.queue = cl.CommandQueue(self.ctx)
        self._stages: dict[tuple[int, tuple[str, ...]], Stages] = {}
        self._busy = threading.Lock()
        self._owner: int | None = None
        self._watch: Callable[[np.void], None] | None = None
        self.on_memory: Callable[[float], object] | None = None
        self.on_build: Callable[[int, int], object] | None = None
        self.on_work: Callable[[str], object] | None = None

    def __repr__(self) -> str:
        return f"Adapter({self.dtype.name} on {self.queue.device.name.strip()})"

    def __reduce__(self) -> NoReturn:
        raise InputTypeError(
            "an Adapter belongs to its device and process, and cannot be copied or pickled; create another one where "
            "it is needed: clvoro.Adapter(adapter.ctx, adapter.dtype)"
        )

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Exclude other threads, as calls share buffers; reject calls from a callback."""
        check_process()
        if self._owner == threading.get_ident():
            raise InputError(
                "the adapter is running: a callback may not use it; create another Adapter for the callback"
            )
        with self._busy:
            self._owner = threading.get_ident()
            try:
                yield
            except cl.MemoryError as error:
                raise MemoryLimitError(
                    f"{self.queue.device.name.strip()} is out of memory ({error}); use a larger size, n_cells, "
                    "dtype='float32' or another device"
                ) from error
            finally:
                self._owner = None

    @contextmanager
    def watched(self, queue: cl.CommandQueue, watch: Callable[[np.void], None]) -> Iterator[None]:
        """Use `queue`, and call `watch` with each new row of a history before the caller's callback (see `profile`).

        A queue other than the adapter's has separate buffers.
        """
        with self._alone():
            kept = self.queue, self._stages, self._watch
            stages = self._stages if queue is self.queue else {}
            self.queue, self._stages, self._watch = queue, stages, watch
        try:
            yield
        finally:
            with self._alone():
                self.queue, self._stages, self._watch = kept

    def _shown(
        self, callback: Callable[[np.void], object] | None, notice: BuildNotice | None
    ) -> Callable[[np.void], object] | None:
        """Return the function that a run calls with each row."""
        watches = [watch for watch in (notice and notice.clear, self._watch) if watch is not None]
        if not watches:
            return callback

        def all_of_them(row: np.void) -> object:
            for watch in watches:
                watch(row)
            return callback is not None and callback(row)

        return all_of_them

    def _engine_for(self, domain: Domain) -> Engine:
        if not isinstance(domain, Domain):
            hint = ""
            if type(domain).__module__.startswith("shapely"):
                hint = "; write clvoro.Polygon.from_shapely(domain)"
            elif isinstance(domain, str | PathLike):
                hint = "; write clvoro.Polygon.from_geojson(domain)"
            elif isinstance(domain, list | tuple | np.ndarray):
                hint = "; write clvoro.Polygon(domain)"
            raise InputTypeError(
                f"domain is a {type(domain).__name__}, expected a clvoro.Box, clvoro.Polygon, clvoro.Sphere or "
                f"clvoro.Solid{hint}"
            )
        return Engine(self.ctx, self.queue, domain.dim, self.dtype, domain.traits(self.dtype))

    def _stages_for(self, domain: Domain) -> Stages:
        engine = self._engine_for(domain)
        key = domain.dim, engine.traits.macros
        stages = self._stages.get(key)
        if stages is not None:
            renew(stages.engine)
        if stages is None or stages.engine.traits != engine.traits:
            # Stages of other periods are dropped. The programs are cached elsewhere and serve these, too.
            stages = self._stages[key] = Stages(engine)
        return stages

    def diagram(self, domain: Domain, points: ArrayLike) -> Diagram:
        """Return the Voronoi diagram of `points` in `domain`.

        To have target sizes beside it, take no step from the points:
        ``run(domain, size, points=points, method="lloyd", max_steps=0)``.

        Parameters
        ----------
        domain : Box, Polygon, Sphere or Solid
        points : (n, d) array of float
            Distinct generators inside the domain, walls included.

        Returns
        -------
        Diagram
            Row i belongs to ``points[i]``.

        Raises
        ------
        InputError
            If the points are not as expected, or too close together for the precision.
        MemoryLimitError
            If the device has not enough memory.

        Examples
        --------
        >>> points = np.array([(0.2, 0.3), (0.7, 0.2), (0.8, 0.8)])
        >>> clvoro.Adapter().diagram(clvoro.Box((0, 0), (1, 1)), points).volumes.round(3).tolist()
        [0.391, 0.275, 0.334]
        """
        with self._alone():
            return self._diagram(domain, points)

    def _diagram(self, domain: Domain, points: ArrayLike) -> Diagram:
        stages = self._stages_for(domain)
        domain.require_no_holes("points of a diagram are given")
        host = check_points(points, domain)
        check_memory(stages.engine, len(host), domain, run=False)
        with coincident_named(host, domain, self.dtype):
            return make_diagram(stages, domain, host)

    def power_diagram(self, domain: Domain, points: ArrayLike, weights: ArrayLike) -> Diagram:
        """Return the power diagram of `points` with `weights`, not in a Solid; see `clvoro.power_diagram`."""
        with self._alone():
            return power_diagram_of(self._stages_for(domain), domain, points, weights)

    def transport(
        self,
        domain: Domain,
        points: ArrayLike,
        volumes: ArrayLike,
        *,
        tolerance: float | None = None,
        max_steps: int = 100,
        relax: int = 0,
    ) -> Transported:
        """Return the power diagram of `points` whose cells have `volumes`, not in a Solid; see `clvoro.transport`."""
        check_integer("relax", relax, 0, 10**6)
        with self._alone():
            stages = self._stages_for(domain)
            with report_builds(stages.engine, self.on_build, "transport"):
                for _ in range(relax):
                    near = max(tolerance or 0.0, RELAXED)
                    found = transport_to(stages, domain, points, volumes, near, max_steps).diagram
                    points = domain.wrap(domain.nearest(found.centroids))
                return transport_to(stages, domain, points, volumes, tolerance, max_steps)

    def run(
        self,
        domain: Domain,
        size: object,
        effort: EffortName = "default",
        *,
        points: ArrayLike | Start = "density",
        method: MethodName = "adaptive",
        n_cells: int | None = None,
        layers: Layers | Sequence[Layers] = (),
        fixed: ArrayLike | None = None,
        seed: int = 0,
        max_steps: int | None = None,
        options: MultilevelOptions | PaperOptions | None = None,
        checkpoint: str | PathLike[str] | Checkpoint | None = None,
        callback: Callable[[np.void], object] | None = None,
        on_interrupt: Literal["raise", "return"] = "raise",
    ) -> Result:
        """Adapt generators until their cells have the target size and a good shape, as `clvoro.adapt` does.

        Parameters
        ----------
        domain : Box, Polygon, Sphere or Solid
        size, effort, points, method, n_cells, layers, fixed, seed, callback
            As those of `clvoro.adapt`.
        max_steps : int, optional
            Largest number of steps, over all levels. By default 100, or all steps of the schedule of "adaptive",
            "exact" and "transport".
        options : MultilevelOptions or PaperOptions, optional
            Further options: `MultilevelOptions` for those three methods, `PaperOptions` for the others.
        checkpoint : path or Checkpoint, optional
            File to which the state of the run is written once per minute. `Checkpoint` chooses the interval, and
            continues a run.
        on_interrupt : "raise" or "return"
            What Ctrl-C does: raise `Interrupted`, which carries the result so far, or return that result.

        Returns
        -------
        Result

        Raises
        ------
        InputError, InputTypeError, SizeFieldError, MemoryLimitError, SolverError, Interrupted
            As `clvoro.adapt`; also if the checkpoint is damaged or belongs to another run.

        Warns
        -----
        CheckpointWarning
            If a checkpoint cannot be written, for example on a full disk. The run continues, and the previous
            checkpoint is kept. Other warnings are those of `clvoro.adapt`.
        """
        given = {"effort": effort, "seed": seed, "max_steps": max_steps, "n_cells": n_cells, "layers": layers}
        merged, own = merged_options(points, options, method=method, **given)
        check_choice("on_interrupt", on_interrupt, ("raise", "return"))
        check_run(domain, size, callback)
        with self._alone():
            for kept in self._stages.values():
                kept.release()  # buffers of a diagram, or of a failed run, are not part of this run's memory
            stages = self._stages_for(domain)
            with report_builds(stages.engine, self.on_build) as notice:
                shown = self._shown(callback, notice)
                run = Run(stages, domain, size, own, fixed, merged, checkpoint, shown, self.on_memory)
                stages.engine.pool.on_work = self.on_work
                try:
                    return run.conclude(on_interrupt)
                finally:
                    stages.engine.pool.on_work = None

    def start(
        self,
        domain: Domain,
        size: object,
        effort: EffortName = "default",
        *,
        points: ArrayLike | Start = "density",
        method: MethodName = "adaptive",
        n_cells: int | None = None,
        layers: Layers | Sequence[Layers] = (),
        fixed: ArrayLike | None = None,
        seed: int = 0,
        max_steps: int | None = None,
        options: MultilevelOptions | PaperOptions | None = None,
        checkpoint: str | PathLike[str] | Checkpoint | None = None,
    ) -> Run:
        """Start a run that goes on step by step, shows its mesh at any time, and follows other size fields.

        It has buffers of its own: the adapter may be used between two steps. Stepped to its end, it gives the same
        mesh, to the last bit, as `run`.

        Parameters
        ----------
        domain : Box, Polygon, Sphere or Solid
        size, effort, points, method, n_cells, layers, fixed, seed, max_steps, options, checkpoint
            As those of `run`.

        Returns
        -------
        Run

        Raises
        ------
        InputError, InputTypeError, SizeFieldError, MemoryLimitError
            As `run`.

        Examples
        --------
        >>> run = clvoro.Adapter().start(clvoro.Box((0, 0), (1, 1)), 0.1, "fast")
        >>> while run.step():
        ...     quality = run.history["mean_quality"][-1]
        >>> run.finish().converged
        True
        """
        given = {"effort": effort, "seed": seed, "max_steps": max_steps, "n_cells": n_cells, "layers": layers}
        merged, own = merged_options(points, options, method=method, **given)
        check_run(domain, size, None)
        stages = Stages(self._engine_for(domain))
        with self._at_work(stages):
            shown = self._shown(None, None)
            return Run(stages, domain, size, own, fixed, merged, checkpoint, shown, self.on_memory, self._at_work)

    @contextmanager
    def _at_work(self, stages: Stages) -> Iterator[None]:
        with self._alone(), report_builds(stages.engine, self.on_build):
            yield

    def memory_needed(
        self,
        domain: Domain,
        size: object,
        *,
        points: ArrayLike | Start = "density",
        method: MethodName = "adaptive",
        n_cells: int | None = None,
        layers: Layers | Sequence[Layers] = (),
        options: MultilevelOptions | PaperOptions | None = None,
    ) -> float:
        """Estimate the bytes that `run` needs on the device with these arguments.

        A run of some thousand cells needs at most a quarter more, and no less than three quarters of it. Where sizes
        change several-fold from one cell to the next it may need half of it. The estimate includes reading all arrays
        of the diagram afterwards: in 3D that needs more than the run. Prisms in layers of solids are made on the
        host, and do not count; where they need more than this process may use, the run is refused, too.

        Parameters
        ----------
        domain : Box, Polygon, Sphere or Solid
        size, points, method, n_cells, layers, options
            As those of `run`.

        Raises
        ------
        MemoryLimitError
            If the device has less; names the estimate.
        InputError, InputTypeError, SizeFieldError
            As `run` does.

        Examples
        --------
        >>> adapter = clvoro.Adapter()
        >>> bytes_ = adapter.memory_needed(clvoro.Box((0, 0), (1, 1)), 0.01)
        >>> 5e6 < bytes_ < 7e6
        True
        """
        merged, own = merged_options(points, options, method=method, n_cells=n_cells, layers=layers)
        with self._alone():
            stages = self._stages_for(domain)
            host = None if own is None else check_points(own, domain)
            return prepare(stages, domain, size, host, merged).memory
