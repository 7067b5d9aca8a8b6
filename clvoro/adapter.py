"""The entry: checks what the user gives, and has the stages for it."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from typing import NoReturn

import numpy as np
import pyopencl as cl

from .adaptation.diagnostics import warn_of_errors
from .adaptation.estimates import check_memory, memory_needed
from .adaptation.options import Options
from .adaptation.preparation import Preparation
from .adaptation.run import Files, carry_out
from .adaptation.stages import Stages
from .arguments import Naming, check_callable, check_number, check_points
from .errors import InputError, InputTypeError, MemoryLimitError, UnusedOptionWarning
from .geometry.boundary_layers import Layers
from .geometry.box import Domain
from .mesh.results import Diagram, Result
from .opencl import devices as device
from .opencl.probe import check_process
from .opencl.program import Engine
from .tessellation.readback.fetch import fetch_diagram
from .tessellation.tessellator import Tessellator

CHECKPOINT_EVERY = 60.0
"""Seconds from one checkpoint to the next, unless the caller says otherwise."""


class Adapter:
    """Adapts Voronoi meshes on one device.

    Kernels are built when they are first needed, and kept; so is memory. One adapter does one thing at a time: calls
    from other threads wait. Processes that are forked once OpenCL is at work cannot use it (`DeviceError`): have them
    spawned.

    Parameters
    ----------
    ctx : pyopencl.Context, optional
        Any context; with None, `clvoro.create_context()`.
    dtype : "float64" or "float32"
        Precision on the device.

    Attributes
    ----------
    ctx, queue : pyopencl.Context, pyopencl.CommandQueue
    dtype : numpy.dtype
    told : callable, optional
        What a run calls with the bytes that it takes on the device, before it begins; see `memory_needed`.

    Raises
    ------
    DeviceError
        If there is no working device, or it has no double precision and `dtype` is "float64".
    InputError, InputTypeError
        If `dtype` is another one, or `ctx` no context.

    Examples
    --------
    >>> adapter = clvoro.Adapter(dtype="float32")
    >>> unit = clvoro.Box((0, 0), (1, 1))
    >>> result = adapter.run(unit, lambda p: 0.05 + 0.1 * p[:, 0], effort="fast", seed=7)
    >>> result.points.shape == (len(result.diagram), 2)
    True
    """

    def __init__(self, ctx: cl.Context | None = None, dtype: object = "float64") -> None:
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
        self.ctx = device.create_context() if ctx is None else ctx
        self.dtype = real
        if real == np.float64:
            device.require_fp64(self.ctx)
        self.queue = cl.CommandQueue(self.ctx)
        self._stages: dict[tuple[object, ...], Stages] = {}
        self._busy = threading.Lock()
        self._owner: int | None = None
        self._watch: Callable[[np.void], None] | None = None
        self.told: Callable[[float], object] | None = None

    def __repr__(self) -> str:
        return f"Adapter({self.dtype.name} on {self.queue.device.name.strip()})"

    def __reduce__(self) -> NoReturn:
        raise InputTypeError(
            "an Adapter belongs to its device and process, and is neither copied nor pickled; make another one where "
            "it is needed, as by clvoro.Adapter(adapter.ctx, adapter.dtype)"
        )

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """One call at a time: the stages' buffers are shared. Other threads wait; a callback must not call back."""
        check_process()
        if self._owner == threading.get_ident():
            raise InputError(
                "the adapter is at work: a callback may not use it; expected another Adapter for it"
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
        """Work on `queue`, and show each new row of a history to `watch` before the caller's callback (see `profile`).

        Another queue than the adapter's own comes with buffers of its own.
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
        self, callback: Callable[[np.void], object] | None
    ) -> Callable[[np.void], object] | None:
        """Return what to call with each row."""
        watch = self._watch
        if watch is None:
            return callback

        def both(row: np.void) -> object:
            watch(row)
            return callback is not None and callback(row)

        return both

    def _stages_for(self, domain: Domain) -> Stages:
        if not isinstance(domain, Domain):
            shapely = type(domain).__module__.startswith("shapely")
            hint = "; write clvoro.Polygon.from_shapely(domain)" if shapely else ""
            raise InputTypeError(
                f"domain is a {type(domain).__name__}, expected a clvoro.Box or a clvoro.Polygon{hint}"
            )
        kind = domain.dim, domain.defines(self.dtype)
        if kind not in self._stages:
            engine = Engine(self.ctx, self.queue, domain.dim, self.dtype, kind[1])
            self._stages[kind] = Stages(engine)
        return self._stages[kind]

    def diagram(self, domain: Domain, points: np.ndarray) -> Diagram:
        """Tessellate `domain` by `points`.

        To save or plot such a diagram, with sizes beside it, take no step from the points:
        ``run(domain, size, points=points, method="lloyd", max_steps=0)``.

        Parameters
        ----------
        domain : Box or Polygon
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

    def _diagram(self, domain: Domain, points: np.ndarray) -> Diagram:
        stages = self._stages_for(domain)
        host = check_points(points, domain)
        n, engine = len(host), stages.engine
        check_memory(engine, n, memory_needed(engine, n, domain, run=False))
        binned = stages.bins.build(domain, engine.upload(domain.place(host, self.dtype)), n)
        labels, sorted_points = binned.items[:n].copy(), binned.points[:n].copy()
        with Naming(host, domain, self.dtype):
            tessellator = Tessellator(stages, domain)
            stages.bins.renumber(binned, n)
            t = tessellator.tessellate(sorted_points, n, exact=True, binned=binned)
            t, unfolded = tessellator.final(t)
        return fetch_diagram(engine, domain, t, labels, unfolded=unfolded)

    def run(
        self,
        domain: Domain,
        size: object,
        points: np.ndarray | None = None,
        method: str = "adaptive",
        n_cells: int | None = None,
        start: str = "density",
        max_steps: int | None = None,
        tol: float = 1e-3,
        alpha: float | None = None,
        k: float = 0.5,
        seed: int = 0,
        callback: Callable[[np.void], object] | None = None,
        *,
        effort: str = "default",
        levels: int | str = "auto",
        error_target: float | None = None,
        layers: Layers | Sequence[Layers] = (),
        checkpoint: str | PathLike[str] | None = None,
        checkpoint_every: float = CHECKPOINT_EVERY,
        resume: str | PathLike[str] | None = None,
    ) -> Result:
        """Adapt generators until their cells have the target size and a good shape.

        Parameters
        ----------
        domain : Box or Polygon
        size : number, callable or clvoro.sizing field
            Target size h(x) > 0: a cell of the right size has volume h^d. A callable takes points (n, d), returns
            (n,), and is evaluated on the host: each step then moves all points there and back.
        points : (n, d) array, optional
            Generators to start from. "adaptive" and "exact" only correct and polish a finished mesh that is near
            `size` already (mean |e| up to 0.15, count off by 2 % at most, cells as good as the effort makes them), as
            after the field has moved by a few cells; any others take the whole way.
        method : str
            "adaptive" goes from coarse to fine, inserts and deletes generators, and ends with good cells of the
            right size; "exact" lets every cell take the size asked for, to about 1e-4. The others repeat one kind of
            step: "lloyd", "poisson" and "coupled" as published, "weighted-lloyd" and "weighted" with the density
            h^-d (see `clvoro.adaptation.methods`).
        n_cells : int, optional
            Number of generators; by default the integral of h^-d over the domain. "adaptive" and "exact" end with
            exactly that many; they scale the size field by the common factor at which the mean of log(L / h) vanishes,
            and report it as ``Result.size_factor``.
        start : "density" or "uniform"
            Random generators with density h^-d, or uniform (the paper's).
        max_steps : int, optional
            Most steps, over all levels. By default 100, or what the plan of "adaptive" and "exact" takes.
        tol : float
            Stop when mean error and mean quality have improved by less than this share over ten steps;
            0 takes all steps. Not of "adaptive" and "exact", which end with their plan.
        alpha, k : float
            Of the paper's (3.4), (3.5), for methods that repeat one kind of step: largest relaxation coefficient of the
            correction (by default d; not of the weighted ones), and bound of its length over h ("weighted-lloyd" and
            "weighted": of the whole displacement's). "lloyd" reports such a correction, and does not move by it.
        seed : int
            Of the random start.
        callback : callable, optional
            Called with each new row of the history (fields as in `Result.history`: ``row["mean_error"]``, ...); the
            run stops when it returns True.
        effort : "fast", "default" or "best"
            Work that "adaptive" and "exact" take.
        levels : int or "auto"
            Coarser levels that "adaptive" and "exact" begin with: 2^levels h. From the caller's `points` it is the
            number of refinements that lead from them to the finest level.
        error_target : float, optional
            Mean |log(L / h)| that the last steps of "adaptive" aim at, as do those of "exact" before its projection, by
            default .0025 (.0035 for "fast", .0039 for "best"). The larger, the better the cells' shape.
        layers : Layers or sequence of them
            Rows of generators along walls, in 2D, that stay where they are: the first of the result. Beyond them sizes
            are bounded by what grows from there; see `Layers`. Their cells count as being of the right size.
        checkpoint : path, optional
            File to which the run's state is written every so often, and where the callback stops it. It is replaced
            at one stroke: whenever the process dies, the file is a whole one. No file but a checkpoint is replaced.
        checkpoint_every : float
            Seconds from one checkpoint to the next; 0: after every step.
        resume : path, optional
            Checkpoint to go on from, given the same other arguments as that run. On the same device the run ends as
            it would have, bit for bit (seconds apart).

        Returns
        -------
        Result

        Raises
        ------
        InputError, InputTypeError
            If an argument is not as expected, or the checkpoint is damaged or of another run.
        SizeFieldError
            If h is not positive and finite somewhere; names the place.
        MemoryLimitError
            If the run would need more memory than the device has.
        SolverError
            If a linear solve breaks down.

        Warns
        -----
        CheckpointWarning
            If a checkpoint cannot be written, as the disk is full; the run goes on, and the one before stays.
        MisfitWarning, CoarseSizeWarning
            If a part of the input hardly meets the domain, as in another unit of length.
        PrecisionWarning
            If `dtype` is too coarse for the sizes.
        SizeErrorWarning
            If the sizes of a mesh that "adaptive" or "exact" has finished are far from those asked for.
        UnusedOptionWarning
            If an option is given that the method does not use, or `checkpoint_every` without a `checkpoint`.
        """
        options = Options(
            method=method, start=start, effort=effort, levels=levels, seed=seed, tol=tol, k=k, alpha=alpha,
            max_steps=max_steps, n_cells=n_cells, error_target=error_target,
            layers=layers,  # type: ignore[arg-type]
        )  # fmt: skip
        if callback is not None and not callable(callback):
            raise InputTypeError(
                f"callback is {callback!r} of type {type(callback).__name__}, expected a function "
                "of a row of the history"
            )
        if callback is not None:
            check_callable(
                "callback", callback, "a row of the history", "write lambda row: callback(...)"
            )
        if isinstance(size, Domain) and not isinstance(domain, Domain):
            raise InputTypeError(
                f"size is the domain {size!r}, and domain is a {type(domain).__name__}; exchange them: "
                "run(domain, size)"
            )
        every = check_number("checkpoint_every", checkpoint_every, least=0)
        if checkpoint is None and every != CHECKPOINT_EVERY:
            warnings.warn(
                f"checkpoint_every is {every:g}, and no file to write to is given: say checkpoint=path",
                UnusedOptionWarning,
                stacklevel=2,
            )
        with self._alone():
            for kept in self._stages.values():
                kept.release()  # a diagram's buffers, or a failed run's, are not part of what this one takes
            stages = self._stages_for(domain)
            host = None if points is None else check_points(points, domain)
            result = carry_out(
                stages, domain, size, host, options, Files(checkpoint, every, resume),
                self._shown(callback), self.told,
            )  # fmt: skip
        if options.planned and result.converged:
            warn_of_errors(result, stacklevel=2)
        return result

    def memory_needed(
        self,
        domain: Domain,
        size: object,
        points: np.ndarray | None = None,
        method: str = "adaptive",
        n_cells: int | None = None,
        *,
        levels: int | str = "auto",
        layers: Layers | Sequence[Layers] = (),
    ) -> float:
        """Return how many bytes `run` takes on the device with these arguments, as it is told before it begins.

        A run does not exceed it by more than a tenth. Where sizes change several-fold from one cell to the next it may
        take a fifth less, at seams of periodic boxes up to three fifths. Reading all arrays of the diagram afterwards
        is allowed for: in 3D it takes more than the run.

        Parameters
        ----------
        domain, size, points, method, n_cells, levels, layers
            As those of `run`.

        Raises
        ------
        MemoryLimitError
            If the device has not as much; says how much it would be.
        InputError, InputTypeError, SizeFieldError
            As `run` does.

        Examples
        --------
        >>> adapter = clvoro.Adapter()
        >>> bytes_ = adapter.memory_needed(clvoro.Box((0, 0), (1, 1)), 0.01)
        >>> 4e6 < bytes_ < 5e6
        True
        """
        options = Options(method=method, n_cells=n_cells, levels=levels, layers=layers)  # type: ignore[arg-type]
        with self._alone():
            stages = self._stages_for(domain)
            host = None if points is None else check_points(points, domain)
            return Preparation(stages, domain, size, host, options).memory
