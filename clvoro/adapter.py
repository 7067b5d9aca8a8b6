"""The entry: checks what the user gives, and runs the loop."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from typing import Any

import numpy as np
import pyopencl as cl

from . import device
from ._arrays import Naming, check_choice, check_integer, check_number, check_points
from ._program import Engine
from .checkpoint import Checkpointer, Saved, describe
from .domain import Domain
from .errors import InputError, InputTypeError, MemoryLimitError
from .fetch import fetch_diagram
from .layers import Layers, apart_from, bounded, free_domain, place_layers
from .loop import Loop
from .mesh import Mesh, Stages, check_memory
from .methods import PUBLISHED, Relaxation, make_method
from .plans import EFFORTS, Action, auto_levels, is_near, plan_adaptive, plan_steps
from .precision import check_precision
from .results import Diagram, Result
from .sizing import Sizing, as_field
from .start import count_cells, sample_density, sample_uniform
from .tessellator import Tessellator
from .torus import FewCellsError

METHODS = ("adaptive", "exact", *PUBLISHED)
STARTS = ("density", "uniform")
GRADIENT_STEP = 0.2
"""Step over h in which the exact projection sees the gradient of the size field."""
STEPS = 100
"""Steps of a method that repeats one kind of step, unless the caller says otherwise."""


class Adapter:
    """Adapts Voronoi meshes on one device.

    Parameters
    ----------
    ctx : pyopencl.Context, optional
        Any context; with None, `clvoro.create_context()`.
    dtype : "float64" or "float32"
        Precision on the device.

    Raises
    ------
    DeviceError
        If there is no working device, or it has no double precision and `dtype` is "float64".
    """

    def __init__(self, ctx: cl.Context | None = None, dtype: object = "float64") -> None:
        try:
            real = np.dtype(dtype)  # type: ignore[arg-type]
        except TypeError:
            real = np.dtype(object)
        if dtype is None or real not in (np.dtype(np.float64), np.dtype(np.float32)):
            raise InputError(f"dtype is {dtype!r}, expected 'float64' or 'float32'")
        self.ctx = device.create_context() if ctx is None else ctx
        self.dtype = real
        if real == np.float64:
            device.require_fp64(self.ctx)
        self.queue = cl.CommandQueue(self.ctx)
        self._stages: dict[tuple[object, ...], Stages] = {}
        self._busy = threading.Lock()
        self._owner: int | None = None
        self._tried = 0
        self._watch: Callable[[np.void], None] | None = None

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """One call at a time: the stages' buffers are shared. Other threads wait; a callback must not call back."""
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
            raise InputTypeError(f"domain is a {type(domain).__name__}, expected a clvoro.Box")
        kind = domain.dim, domain.defines(self.dtype)
        if kind not in self._stages:
            engine = Engine(self.ctx, self.queue, domain.dim, self.dtype, kind[1])
            self._stages[kind] = Stages(engine)
        return self._stages[kind]

    def diagram(self, domain: Domain, points: np.ndarray) -> Diagram:
        """Tessellate `domain` by `points`.

        Parameters
        ----------
        domain : Domain
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
        """
        with self._alone():
            return self._diagram(domain, points)

    def _diagram(self, domain: Domain, points: np.ndarray) -> Diagram:
        stages = self._stages_for(domain)
        host = check_points(points, domain)
        n, engine = len(host), stages.engine
        check_memory(engine, n)
        binned = stages.bins.build(domain, engine.upload(domain.place(host, self.dtype)), n)
        labels, sorted_points = binned.items[:n].copy(), binned.points[:n].copy()
        with Naming(host, domain, self.dtype):
            tessellator = Tessellator(stages, domain)
            t = tessellator.tessellate(sorted_points, n, exact=True)
        return fetch_diagram(engine, domain, t, labels, unfolded=tessellator.unfolded)

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
        checkpoint_every: float = 60.0,
        resume: str | PathLike[str] | None = None,
    ) -> Result:
        """Adapt generators until their cells have the target size and a good shape.

        Parameters
        ----------
        domain : Domain
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
            h^-d (see `clvoro.methods`).
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
            0 takes all steps. "adaptive" and "exact" end with their plan.
        alpha, k : float
            Of the paper's (3.4), (3.5): largest relaxation coefficient (by default d), and bound of the
            displacement over h.
        seed : int
            Of the random start.
        callback : callable, optional
            Called with each new row of the history; the run stops when it returns True.
        effort : "fast", "default" or "best"
            Work that "adaptive" and "exact" take.
        levels : int or "auto"
            Coarser levels that "adaptive" and "exact" begin with: 2^levels h. From the caller's `points` it is the
            number of refinements that lead from them to the finest level.
        error_target : float, optional
            Mean |log(L / h)| that the last steps of "adaptive" aim at, by default .0025 (.0035 for "fast", .0039 for
            "best"). The larger, the better the cells' shape.
        layers : Layers or sequence of them
            Rows of generators along walls, in 2D, that stay where they are: the first of the result. Beyond them sizes
            are bounded by what grows from there; see `Layers`. Their cells count as being of the right size.
        checkpoint : path, optional
            File to which the run's state is written every so often, and where the callback stops it. It is replaced
            at one stroke: whenever the process dies, the file is a whole one.
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
        """
        check_choice("method", method, METHODS)
        check_choice("start", start, STARTS)
        check_choice("effort", effort, tuple(EFFORTS))
        options = {
            "method": method, "start": start, "effort": effort, "levels": levels,
            "seed": check_integer("seed", seed, 0),
            "tol": check_number("tol", tol, least=0),
            "k": check_number("k", k, above=0),
            "alpha": None if alpha is None else check_number("alpha", alpha, above=0),
            "max_steps": None if max_steps is None else check_integer("max_steps", max_steps, 0),
            "n_cells": None if n_cells is None else check_integer("n_cells", n_cells, 1),
            "error_target": None if error_target is None
            else check_number("error_target", error_target, above=0),
        }  # fmt: skip
        if callback is not None and not callable(callback):
            raise InputTypeError(
                f"callback is {callback!r} of type {type(callback).__name__}, expected a function "
                "of a row of the history"
            )
        options["layers"] = (layers,) if isinstance(layers, Layers) else tuple(layers)
        every = check_number("checkpoint_every", checkpoint_every, least=0)
        files = checkpoint, every, resume
        with self._alone():
            return self._run(domain, size, points, options, self._shown(callback), *files)

    def _run(
        self,
        domain: Domain,
        size: object,
        points: np.ndarray | None,
        options: dict[str, Any],
        *rest: Any,
    ) -> Result:
        """Run with as many coarse levels as a periodic box allows for: one more would have too few cells around it."""
        most = 99
        while True:
            try:
                return self._try(domain, size, points, options, *rest, most)
            except FewCellsError:
                if options["levels"] != "auto" or self._tried == 0:
                    raise
                most = self._tried - 1

    def _try(
        self,
        domain: Domain,
        size: object,
        points: np.ndarray | None,
        options: dict[str, Any],
        callback: Callable[[np.void], object] | None,
        checkpoint: str | PathLike[str] | None,
        every: float,
        resume: str | PathLike[str] | None,
        most: int,
    ) -> Result:
        """Build mesh and plan, and carry the plan out, with at most `most` levels; the options are checked."""
        stages = self._stages_for(domain)
        engine, method, n_cells = stages.engine, options["method"], options["n_cells"]
        planned = method not in PUBLISHED
        host = None if points is None else check_points(points, domain)
        made_by = describe(domain, options, self.dtype, host)
        saved = None if resume is None else Saved(resume)
        if saved is not None:
            saved.fit(made_by)
        if host is not None and not planned and n_cells not in (None, len(host)):
            raise InputError(
                f"n_cells is {n_cells}, but {len(host)} points are given, and method {method!r} "
                "keeps their number; leave n_cells out, or use method='adaptive'"
            )
        rows, free = np.empty((0, domain.dim)), domain
        if options["layers"]:
            rows, free = (
                place_layers(domain, options["layers"]),
                free_domain(domain, options["layers"]),
            )
            size = bounded(size, domain, options["layers"])
        sizing = Sizing(engine, domain, as_field(size), gradient_step=GRADIENT_STEP)
        given = host is not None and not planned
        asked = float(len(host)) if given else count_cells(sizing, free) + len(rows)
        target = n_cells if n_cells is not None else max(1, round(asked))
        check_memory(engine, max(target, 0 if host is None else len(host)))
        factor = (asked / target) ** (1 / domain.dim) if planned and n_cells is not None else 1.0
        levels = self._levels(options["levels"], engine, target, host) if planned else 0
        if options["levels"] == "auto":
            levels = min(levels, most, most if saved is None else saved.levels)
        self._tried = levels
        if host is None and saved is None:
            least = free.n_pieces if levels else 1
            n = max(least, round((target - len(rows)) / 2 ** (domain.dim * levels)))
            if options["start"] == "uniform":
                host = sample_uniform(free, n, options["seed"], self.dtype)
            else:
                host = sample_density(sizing, free, n, options["seed"], self.dtype)
        if host is not None:
            check_precision(sizing, domain, host, factor)
        if host is not None and len(rows):
            host = np.concatenate([rows, apart_from(host, rows, free)])
        mesh, near = None, False
        if host is not None and (saved is None or (planned and levels == 0)):
            with Naming(host, domain, self.dtype):
                unsorted = engine.upload(domain.place(host, self.dtype))
                mesh = Mesh(
                    stages,
                    domain,
                    sizing,
                    unsorted,
                    coarsening=factor * 2.0**levels,
                    free=free,
                    fixed=len(rows),
                )
            near = points is not None and planned and levels == 0
            near = near and self._near(mesh, n_cells, options["effort"])
        plan: list[Action]
        if planned:
            plan = plan_adaptive(
                domain.dim, options["effort"], levels, method == "exact", options["error_target"],
                warm=points is not None, near=near,
            )  # fmt: skip
        else:
            relaxation = Relaxation(options["alpha"], options["k"])
            steps = STEPS if options["max_steps"] is None else options["max_steps"]
            plan = plan_steps(make_method(method, relaxation), steps)
        tol = None if planned else options["tol"]
        writer = None if checkpoint is None else Checkpointer(checkpoint, every, made_by, plan)
        if saved is not None:
            mesh = saved.restore(stages, domain, sizing, plan, free, len(rows))
        assert mesh is not None
        loop = Loop(mesh, plan, levels, options["max_steps"], tol, callback)
        loop.checkpoint = writer
        if saved is not None:
            saved.set(loop)
        settings = {**options, "levels": levels, "dtype": self.dtype.name}
        settings["layers"] = [repr(layer) for layer in options["layers"]]
        if points is not None:
            settings["start"] = "points"
        return loop.run(n_cells if planned else None, float(target), settings)

    @staticmethod
    def _near(mesh: Mesh, n_cells: int | None, effort: str) -> bool:
        """Tell whether a mesh that was given needs no more than correction."""
        missing = mesh.missing() if n_cells is None else float(n_cells - mesh.n)
        s, n = mesh.assess(), mesh.n
        return is_near(
            mesh.engine.dim, effort, n, missing, s["error"].magnitude / n, s["quality"].sum / n
        )

    @staticmethod
    def _levels(levels: int | str, engine: Engine, target: int, host: np.ndarray | None) -> int:
        """Return the number of coarser levels that lead to `target` cells, from points `host` or from a sample."""
        dim = engine.dim
        if levels == "auto":
            if host is None:
                return auto_levels(target, dim)
            return max(0, round(np.log2(target / len(host)) / dim))
        count = check_integer("levels", levels, 0)
        most = int(np.log2(max(target, 1)) / dim)
        if host is None and count > most:
            raise InputError(
                f"levels is {levels}, expected at most {most} for {target} cells, or 'auto': each "
                f"level has {2**dim} times fewer"
            )
        check_memory(engine, 0 if host is None else len(host) * 2.0 ** (dim * min(count, 99)))
        return count
