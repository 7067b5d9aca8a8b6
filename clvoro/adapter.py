"""`Adapter`: the full interface."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, NoReturn

import numpy as np
import pyopencl as cl
from numpy.typing import ArrayLike, DTypeLike

from .adaptation.estimates import check_memory
from .adaptation.options import (
    Checkpoint,
    EffortName,
    MethodName,
    MultilevelOptions,
    PaperOptions,
    RunArguments,
    RunOptions,
    Start,
    check_callback,
)
from .adaptation.preparation import prepare
from .adaptation.run import INTERRUPTED, Run, check_shared, not_interrupted
from .adaptation.stages import Stages
from .adaptation.transport import RELAXED, power_diagram_of, transport_to
from .arguments import check_integer, check_points, coincident_named
from .errors import InputError, InputTypeError, MemoryLimitError
from .geometry.boundary_layers import Layers
from .geometry.domain import Domain
from .mesh.diagram import Diagram
from .mesh.results import Result, Transported
from .opencl import devices as device
from .opencl.engine import Engine
from .opencl.peers import ALONE, Peers, peers_of
from .opencl.prebuild import BuildNotice, renew, report_builds
from .opencl.probe import check_process
from .opencl.threads import Team, Threads
from .tessellation.readback.diagram import make_diagram

if TYPE_CHECKING:
    from typing_extensions import Unpack


class Adapter:
    """Adapts Voronoi meshes on one device, or on several together.

    An adapter builds kernels when it first needs them, and keeps them and its device memory. Calls from several threads
    wait for each other. A process that was forked after the first use of OpenCL cannot use it (`DeviceError`); spawn
    processes instead.

    Parameters
    ----------
    ctx : pyopencl.Context, optional
        Any context; by default that of `clvoro.create_context()`.
    dtype : "float64" or "float32"
        Precision on the device.
    comm : mpi4py.MPI.Comm, optional
        Share runs among the ranks of this communicator: all of them create an adapter and call `run` with the same
        arguments. Each gets a `Result` of its own cells, and ``result.gather()`` returns the whole mesh on rank 0. The
        domain is a box, a polygon or a sphere; "transport", moving meshes and layers are refused. Without `ctx` the
        ranks of a node take its GPUs in turn.
    share_gpus : bool
        Whether several ranks may have one GPU, or `devices` the same one several times. Otherwise this raises an
        `InputError`.
    devices : list of str, pyopencl.Device or pyopencl.Context, optional
        Share runs among these devices of this machine, in place of `ctx` and `comm`. Names are those that
        `clvoro.create_context` takes; a name that is given several times stands for equally good devices in turn. Each
        device makes the cells of a part of the generators, in a thread of its own, which also calls size functions.
        `run` returns the whole mesh, as the first device holds it, and refuses what is refused with `comm`. All other
        methods use the first device.

    Attributes
    ----------
    ctx, queue : pyopencl.Context, pyopencl.CommandQueue
        Those of the first device.
    devices : tuple of pyopencl.Device
        All that share a run of this process.
    dtype : numpy.dtype
    on_memory : callable, optional
        Called by a run, before it begins, with the bytes that it needs on the device; see `memory_needed`.
    on_build : callable, optional
        Called by a first run with the number of kernels that are built, and of those that it needs. Without it such a
        run shows a line on the terminal, if the standard error is one.
    on_work : callable, optional
        Called with each part of the work after the last step, at the walls of a solid, and how far it is.

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
        self,
        ctx: cl.Context | None = None,
        dtype: Literal["float64", "float32"] | DTypeLike = "float64",
        comm: object = None,
        share_gpus: bool = False,
        devices: Sequence[str | cl.Device | cl.Context | None] | None = None,
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
        contexts = []
        if devices is not None:
            if ctx is not None or comm is not None:
                raise InputError(
                    f"devices and {'ctx' if comm is None else 'comm'} are given, expected one of them; leave one out"
                )
            ctx, *contexts = device.contexts_of(devices, real, share_gpus)
        self._peers = peers_of(comm)
        place = device.place_on_node(self._peers)
        self.ctx = self._peers.agree(lambda: device.context_of(ctx, real, place))
        self.dtype = real
        if not share_gpus:
            device.refuse_shared_gpus(self._peers, self.ctx.devices[0])
        self.queue = cl.CommandQueue(self.ctx)
        self._stages: dict[tuple[int, tuple[str, ...], bool], Stages] = {}
        self._busy = threading.Lock()
        self._owner: int | None = None
        self._watch: Callable[[np.void], None] | None = None
        self.on_memory: Callable[[float], object] | None = None
        self.on_build: Callable[[int, int], object] | None = None
        self.on_work: Callable[[str], object] | None = None
        self._others = [Adapter(other, real) for other in contexts]
        self.devices = tuple(adapter.ctx.devices[0] for adapter in (self, *self._others))
        self._team = Team(1 + len(contexts))
        if contexts:
            for adapter, peers in zip((self, *self._others), self._team.peers, strict=True):
                adapter._peers = peers
            self._peers.gathers = True

    def __repr__(self) -> str:
        more = f" and {len(self._others)} more" if self._others else ""
        return f"Adapter({self.dtype.name} on {self.queue.device.name.strip()}{more})"

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

    def _engine_for(self, domain: Domain, peers: Peers = ALONE) -> Engine:
        if not isinstance(domain, Domain):
            hint = ""
            if type(domain).__module__.startswith("shapely"):
                hint = "; write clvoro.Polygon.from_shapely(domain)"
            elif isinstance(domain, str | PathLike):
                reader = "Polygon.from_geojson" if str(domain).lower().endswith("json") else "Solid.read"
                hint = f"; write clvoro.{reader}(domain)"
            elif isinstance(domain, list | tuple | np.ndarray):
                hint = "; write clvoro.Polygon(domain)"
            raise InputTypeError(
                f"domain is a {type(domain).__name__}, expected a clvoro.Box, clvoro.Polygon, clvoro.Sphere or "
                f"clvoro.Solid{hint}"
            )
        return Engine(self.ctx, self.queue, domain.dim, self.dtype, domain.traits(self.dtype), peers=peers)

    def _stages_for(self, domain: Domain, peers: Peers = ALONE) -> Stages:
        engine = self._engine_for(domain, peers)
        key = domain.dim, engine.traits.macros, peers.shared
        stages = self._stages.get(key)
        if stages is not None:
            renew(stages.engine)
        if stages is None or stages.engine.traits != engine.traits:
            # Stages of other periods are dropped. The programs are cached elsewhere and serve these, too.
            stages = self._stages[key] = Stages(engine)
        return stages

    def diagram(self, domain: Domain, points: ArrayLike) -> Diagram:
        """Return the Voronoi diagram of `points` in `domain`.

        `clvoro.voronoi` uses the adapter that all calls share, on the best device.

        For a `Result`, which also has target sizes, make a run without steps:
        ``clvoro.adapt(domain, size, points=points, method="lloyd", max_steps=0)``.

        Parameters
        ----------
        domain : Box, Polygon, Sphere or Solid
        points : (n, d) array of float
            Distinct generators inside the domain, walls included, in the domain's unit of length.

        Returns
        -------
        Diagram
            Row i belongs to ``points[i]``.

        Raises
        ------
        DeviceError
            If no device works.
        InputError, InputTypeError
            If the points are not as expected, or too close together for the precision.
        MemoryLimitError
            If the device has not enough memory.

        Examples
        --------
        >>> points = [(0.2, 0.3), (0.7, 0.2), (0.8, 0.8)]
        >>> clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), points).volumes.round(3).tolist()
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
        """Return the power diagram (Laguerre diagram) of `points` with `weights` in `domain`.

        `clvoro.power_diagram` uses the adapter that all calls share, on the best device.

        The cell of generator i is the set of y with ``|y - x_i|^2 - w_i <= |y - x_j|^2 - w_j`` for all j (Aurenhammer
        1987, SIAM J. Comput. 16, 78). Its faces are at right angles to the lines between generators, and a larger
        weight makes the cell larger. It need not contain its generator, and may be empty. Equal weights give the
        Voronoi diagram. In a polygon a cell is the whole part of the domain that the definition gives it: on both sides
        of a wall thinner than a cell, if need be, where `voronoi` gives the part without the generator to a neighbor.
        On a sphere of radius R it is the set of y with ``exp(w_i / 2R^2) x_i.y >= exp(w_j / 2R^2) x_j.y`` for all j,
        which is the same for cells that are small; faces are arcs of great circles (Sugihara 2002, J. Geom. Graph. 6,
        69).

        Parameters
        ----------
        domain : Box, Polygon or Sphere
        points : (n, d) array of float
            Distinct generators inside the domain.
        weights : (n,) array of float
            In the square of the domain's unit of length. Only their differences count.

        Returns
        -------
        Diagram
            Row i belongs to ``points[i]``. It has `weights`; its `empty_cells` are the rows of cells without volume.

        Raises
        ------
        DeviceError
            If no device works.
        InputError, InputTypeError
            If an argument is not as expected, the domain is a solid or has holes, or points are too close together for
            the precision.
        MemoryLimitError
            If the device has not enough memory.

        Warns
        -----
        EmptyCellsWarning
            If cells are empty; says how many.

        Examples
        --------
        >>> points = [(0.5, 0.5), (1.5, 0.5)]
        >>> d = clvoro.power_diagram(clvoro.Box((0, 0), (2, 1)), points, [0.2, 0])
        >>> d.volumes.round(3).tolist(), d.empty_cells.tolist()
        ([1.1, 0.9], [])
        """
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
        """Find the weights with which the cells of a power diagram have prescribed `volumes`.

        `clvoro.transport` uses the adapter that all calls share, on the best device.

        These cells transport the volume of the domain to the generators at the least cost, the integral of the squared
        distance. Damped steps of Newton's method find them for any volumes that sum to that of the domain (Kitagawa,
        Merigot and Thibert 2019, J. Eur. Math. Soc. 21, 2603). On a sphere the cost is -log of the cosine of the angle:
        a cell lies within 90 degrees of its generator, so that areas that are very different from those of the Voronoi
        cells may have no solution.

        Parameters
        ----------
        domain : Box, Polygon or Sphere
        points : (n, d) array of float
            Distinct generators inside the domain. They stay where they are, without `relax`.
        volumes : (n,) array of float
            Volumes > 0 of the cells (areas in 2D). Their sum is that of the domain, in each of its pieces.
        tolerance : float, optional
            Largest relative error of a volume; by default 1e-10, in float32 1e-3.
        max_steps : int
            Largest number of Newton steps.
        relax : int
            How often generators move to the centroids of their cells, which have `volumes` to 1 % then, before the last
            transport. Cells become round, as the grains of a polycrystal. ``diagram.points`` are the generators at the
            end.

        Returns
        -------
        Transported

        Raises
        ------
        DeviceError, InputError, InputTypeError, MemoryLimitError
            As `power_diagram`; also if the volumes do not have the sum of the domain.
        SolverError
            If a linear solve breaks down.

        Warns
        -----
        SizeErrorWarning
            If some volumes are farther off than the tolerance at the end; says how many.

        Examples
        --------
        >>> points = [(0.2, 0.3), (0.7, 0.2), (0.8, 0.8)]
        >>> found = clvoro.transport(clvoro.Box((0, 0), (1, 1)), points, [0.2, 0.3, 0.5])
        >>> found.diagram.volumes.round(9).tolist(), found.converged
        ([0.2, 0.3, 0.5], True)
        """
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
        fixed: ArrayLike | PathLike[str] | Mapping[str, Any] | None = None,
        seed: int = 0,
        max_steps: int | None = None,
        options: MultilevelOptions | PaperOptions | None = None,
        checkpoint: str | PathLike[str] | Checkpoint | None = None,
        callback: Callable[[np.void], object] | None = None,
    ) -> Result:
        """Mesh `domain` by Voronoi cells of the target size.

        `clvoro.adapt` is this method of one adapter that all calls share, on the best device, in float64 where a device
        has it. Calls from several threads wait for each other. For a device or a precision of your own use
        ``clvoro.Adapter(ctx, dtype).run(...)``.

        Parameters
        ----------
        domain : Box, Polygon, Sphere or Solid
            "transport" needs a box, a polygon or a sphere, a moving mesh a box without periodic sides.
        size : number, callable or clvoro.sizing field
            Target size h(x) > 0, in the domain's unit of length: a cell of the right size has volume h^d. A callable
            takes points (n, d), returns (n,), and is evaluated on the host: each step then moves all points there and
            back.
        effort : "fast", "default" or "best"
            Amount of work of "adaptive", "exact" and "transport".
        points : (n, d) array of float, "density" or "uniform"
            Generators to start from: those of the array, ones with density h^-d, or uniform random ones as in the
            paper. Those with density h^-d are random or, from 1,000 cells of the same size in space on, a body-centered
            cubic lattice in a random direction, unless `options` has levels. From an array, "adaptive" and "exact" only
            correct and polish a mesh that nearly has the sizes already (mean |e| up to 0.15, count off by 2 % at most,
            cells as good as after a run with this effort), as after the size field has moved by a few cells; see
            `MultilevelOptions`. From any other array they run all levels. Where its number of points is far from that
            of the sizes, random ones replace them, unless `options` has levels.
        method : str
            "adaptive" goes from coarse to fine, inserts and deletes generators, and ends with good cells of the right
            size. "exact" gives every cell its target size, to about 1e-4; "transport" to 1e-10 (float32: 1e-3), in a
            power diagram, not in solids. The others repeat one kind of step: "lloyd", "poisson" and
            "coupled" as published, "weighted-lloyd" and "weighted" with the density h^-d, and the moving meshes "mmpde"
            and "monge-ampere", which map a lattice in a box (see `clvoro.adaptation.methods`).
        n_cells : int, optional
            Number of generators; by default the integral of h^-d over the domain. "adaptive", "exact" and "transport"
            end with exactly that many. They scale the size field by a common factor so that the mean of log(L / h)
            vanishes, and report it as ``Result.size_factor``; "transport" always does.
        layers : Layers or sequence of Layers
            Rows of generators along walls of a box in 2D or a polygon. They do not move. In the result they follow
            `fixed` and the generators that a run places in concave corners. Beyond them the sizes grow gradually from
            the size of the layers; see `Layers`. Their cells count as having the right size.
        fixed : (k, d) array of float, or points of shapely or GeoJSON, optional
            Generators that do not move, such as wells: rows 0 to k - 1 of the result, exactly at these positions. Their
            neighbors move until all have their sizes. Not for "transport" and moving meshes, which move all of them.
            GeoJSON is a file, such as "wells.geojson", or a mapping.
        seed : int
            Seed of the random start.
        max_steps : int, optional
            Largest number of steps, over all levels. By default 100, or all steps of the schedule of "adaptive",
            "exact" and "transport". From given points these leave out sweeps, so that their last steps, which polish,
            are among them.
        options : MultilevelOptions or PaperOptions, optional
            Further options: `MultilevelOptions` for those three methods, `PaperOptions` for the others.
        checkpoint : path or Checkpoint, optional
            File to which the state of the run is written once per minute. `Checkpoint` chooses the interval, and
            continues a run.
        callback : callable, optional
            Called with each new row of the history (fields as in `Result.history`: ``row["mean_error"]``, ...). The
            run stops if it returns True. Over ranks it is called where steps are taken: on rank 0 for each row.

        Returns
        -------
        Result

        Raises
        ------
        DeviceError
            If no device works.
        InputError, InputTypeError
            If an argument is not as expected, or a generator of `fixed` is outside, on a wall, within a layer, or at
            the place of another one; says where. Also if the checkpoint is damaged or belongs to another run.
        SizeFieldError
            If h is not positive and finite somewhere; names the place.
        MemoryLimitError
            If the run needs more memory than the device has.
        SolverError
            If a linear solve breaks down.
        Interrupted
            On Ctrl-C: a `KeyboardInterrupt` with the result so far.

        Warns
        -----
        CheckpointWarning
            If a checkpoint cannot be written, for example on a full disk. The run continues, and the previous
            checkpoint is kept.
        MismatchWarning, CoarseSizeWarning
            If a part of the input barely overlaps the domain, for example because it has another unit of length, or the
            domain is narrower than half a cell somewhere, or has a dead end narrower than a cell, or a generator of
            `fixed` is near a wall or another one for the size there; says where.
        ObtuseTrianglesWarning
            If obtuse triangles are left in a mesh on a sphere that "adaptive" or "exact" has finished.
        PrecisionWarning
            If the precision of the device is too coarse for the sizes.
        SizeErrorWarning
            If the cells of a mesh that "adaptive" or "exact" has finished are far from their target sizes.
        TangledMeshWarning
            If a moving mesh would fold; says at how many generators.
        UnusedOptionWarning
            If an argument is given that the method does not use.

        Examples
        --------
        >>> mesh = clvoro.adapt(clvoro.Box((0, 0), (2, 1)), lambda p: 0.05 + 0.1 * p[:, 0], "fast")
        >>> bool(abs(mesh.diagram.volumes.sum() - 2) < 1e-12), bool(abs(mesh.size_error).mean() < 0.05)
        (True, True)
        """
        given = {"effort": effort, "seed": seed, "max_steps": max_steps, "n_cells": n_cells, "layers": layers}
        arguments = RunArguments.of(domain, size, points, options, fixed, checkpoint, method=method, **given)
        check_callback(callback)
        with self._alone():
            run = self._run_together if self._others else self._run
            return not_interrupted(run(arguments, callback))

    def _run(self, arguments: RunArguments, callback: Callable[[np.void], object] | None) -> Result:
        """Do what `run` does on this device; after Ctrl-C return the mesh so far."""
        for kept in self._stages.values():
            kept.release()  # buffers of a diagram, or of a failed run, are not part of this run's memory
        stages = self._stages_for(arguments.domain, self._peers)
        if self._peers.shared:
            check_shared(arguments)
        with report_builds(stages.engine, self.on_build) as notice:
            shown = self._shown(callback, notice)
            stages.engine.pool.on_work = self.on_work
            try:
                return Run(stages, arguments, shown, self.on_memory).conclude()
            except BaseException as error:
                self._peers.fail(error)
                raise
            finally:
                stages.engine.pool.on_work = None

    def _run_together(self, arguments: RunArguments, callback: Callable[[np.void], object] | None) -> Result:
        """Do the same on all devices, and return the whole mesh."""
        for other in self._others:
            other.on_build = lambda *_: None

        def work(peers: Threads) -> Result | None:
            def answer(row: np.void) -> object:
                if peers.number == 0 and callback is not None and peers.ask(partial(callback, row)):
                    return True
                return peers.team.interrupted

            adapter = (self, *self._others)[peers.number]
            return adapter._run(arguments, answer).gather()

        result = self._team.run(work)[0]
        assert result is not None
        if not self._team.interrupted:
            return result
        return dataclasses.replace(result, converged=False, stop_reason=INTERRUPTED)

    def start(self, domain: Domain, size: object, effort: EffortName = "default", **options: Unpack[RunOptions]) -> Run:
        """Start a run that goes on step by step, shows its mesh at any time, and follows other size fields.

        It has buffers of its own: the adapter may be used between two steps. Stepped to its end, it gives the same
        mesh, to the last bit, as `run`.

        Parameters
        ----------
        domain : Box, Polygon, Sphere or Solid
        size, effort, **options
            As those of `run`, without `callback`.

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
        arguments = RunArguments.of(domain, size, effort=effort, **options)
        if self._peers.shared:
            raise InputError(
                "start is called with an Adapter that has comm or devices, expected run: they share whole runs"
            )
        stages = Stages(self._engine_for(domain))
        with self._at_work(stages):
            shown = self._shown(None, None)
            return Run(stages, arguments, shown, self.on_memory, self._at_work)

    @contextmanager
    def _at_work(self, stages: Stages) -> Iterator[None]:
        with self._alone(), report_builds(stages.engine, self.on_build):
            yield

    def memory_needed(self, domain: Domain, size: object, **options: Unpack[RunOptions]) -> float:
        """Estimate the bytes that `run` needs on the device, or on each of several, with these arguments.

        A run of some thousand cells needs at most a quarter more, and no less than three quarters of it. Where sizes
        change several-fold from one cell to the next it may need half of it. The estimate includes reading all arrays
        of the diagram afterwards: in 3D that needs more than the run. Prisms in layers of solids are made on the
        host, and do not count; where they need more than this process may use, the run is refused, too.

        Parameters
        ----------
        domain : Box, Polygon, Sphere or Solid
        size, **options
            As those of `run`, without `effort` and `callback`.

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
        arguments = RunArguments.of(domain, size, **options)
        with self._alone():
            stages = self._stages_for(domain, self._peers)
            return prepare(stages, arguments.checked(self.dtype)).memory
