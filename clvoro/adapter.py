"""The loop of the paper's Figure 1."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pyopencl as cl

from . import device
from ._arrays import check_integer, check_number, check_points, coincident_pair
from ._program import Engine
from .domain import Box
from .errors import InputError, InputTypeError
from .fetch import fetch_diagram
from .mesh import Mesh, Stages, check_memory
from .methods import METHODS, Method, Relaxation, make_method
from .results import HISTORY_DTYPE, Diagram, Displacements, Result
from .sizing import Sizing, as_field
from .start import count_cells, sample_density, sample_uniform

STARTS = ("density", "uniform")
WINDOW = 10
"""Steps over which error and quality are watched for progress."""


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
        real = np.dtype(dtype)  # type: ignore[arg-type]
        if real not in (np.dtype(np.float64), np.dtype(np.float32)):
            raise InputError(f"dtype is {dtype!r}, expected 'float64' or 'float32'")
        self.ctx = device.create_context() if ctx is None else ctx
        self.dtype = real
        if real == np.float64:
            device.require_fp64(self.ctx)
        self.queue = cl.CommandQueue(self.ctx)
        self._stages: dict[int, Stages] = {}

    def _stages_for(self, domain: Box) -> Stages:
        if domain.dim not in self._stages:
            engine = Engine(self.ctx, self.queue, domain.dim, self.dtype)
            self._stages[domain.dim] = Stages(engine)
        return self._stages[domain.dim]

    def diagram(self, domain: Box, points: np.ndarray) -> Diagram:
        """Tessellate `domain` by `points`.

        Parameters
        ----------
        domain : Box
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
        """
        host = check_points(points, domain)
        stages, n = self._stages_for(domain), len(host)
        engine = stages.engine
        origin, scale = domain.frame
        binned = stages.bins.build(engine.upload((host - origin) / scale), n)
        labels, sorted_points = binned.items[:n].copy(), binned.points[:n].copy()
        binned = stages.bins.build(sorted_points, n)
        with _Naming(host, origin, scale, self.dtype):
            t = stages.cells.tessellate(domain, sorted_points, n, binned)
        return fetch_diagram(engine, domain, t, labels)

    def run(
        self,
        domain: Box,
        size: object,
        points: np.ndarray | None = None,
        method: str = "coupled",
        n_cells: int | None = None,
        start: str = "density",
        max_steps: int = 100,
        tol: float = 1e-3,
        alpha: float | None = None,
        k: float = 0.5,
        seed: int = 0,
        callback: Callable[[np.void], object] | None = None,
    ) -> Result:
        """Adapt generators until their cells have the target size.

        Parameters
        ----------
        domain : Box
        size : number, callable or clvoro.sizing field
            Target size h(x) > 0: a cell of the right size has volume h^d. A callable takes points (n, d), returns
            (n,), and is evaluated on the host: each step then moves all points there and back.
        points : (n, d) array, optional
            Generators to start from.
        method : "lloyd", "poisson", "coupled", "weighted-lloyd" or "weighted"
            See `clvoro.methods`.
        n_cells : int, optional
            Number of generators; by default the integral of h^-d over the domain.
        start : "density" or "uniform"
            Random generators with density h^-d, or uniform (the paper's).
        max_steps : int
        tol : float
            Stop when mean error and mean quality have improved by less than this share over ten steps;
            0 takes all `max_steps`.
        alpha : float, optional
            Largest relaxation coefficient of the paper's (3.4); by default d.
        k : float
            Bound of the paper's (3.5): displacement over h of the fastest generator.
        seed : int
            Of the random start.
        callback : callable, optional
            Called with each new row of the history; the run stops when it returns True.

        Returns
        -------
        Result

        Raises
        ------
        InputError, InputTypeError
            If an argument is not as expected.
        SizeFieldError
            If h is not positive and finite somewhere; names the place.
        MemoryLimitError
            If the run would need more memory than the device has.
        """
        if not isinstance(domain, Box):
            raise InputTypeError(f"domain is a {type(domain).__name__}, expected a clvoro.Box")
        if method not in METHODS:
            raise InputError(f"method is {method!r}, expected one of {', '.join(METHODS)}")
        max_steps = check_integer("max_steps", max_steps, 0)
        tol = check_number("tol", tol, least=0)
        relaxation = Relaxation(
            None if alpha is None else check_number("alpha", alpha, above=0),
            check_number("k", k, above=0),
        )
        stages = self._stages_for(domain)
        sizing = Sizing(stages.engine, domain, as_field(size))
        if points is None:
            host = self._start(domain, sizing, n_cells, start, check_integer("seed", seed, 0))
        else:
            host = check_points(points, domain)
        settings = {
            "method": method, "n_cells": len(host), "start": start if points is None else "points",
            "max_steps": max_steps, "tol": tol, "alpha": alpha, "k": k, "seed": seed,
            "dtype": self.dtype.name,
        }  # fmt: skip
        origin, scale = domain.frame
        with _Naming(host, origin, scale, self.dtype):
            mesh = Mesh(stages, domain, sizing, stages.engine.upload((host - origin) / scale))
        loop = _Loop(mesh, make_method(method, relaxation), max_steps, tol, callback)
        return loop.run(settings)

    def _start(
        self, domain: Box, sizing: Sizing, n_cells: int | None, start: str, seed: int
    ) -> np.ndarray:
        if start not in STARTS:
            raise InputError(f"start is {start!r}, expected one of {', '.join(STARTS)}")
        if n_cells is None:
            n = max(1, round(count_cells(sizing, domain)))
        else:
            n = check_integer("n_cells", n_cells, 1)
        check_memory(sizing.engine, n)
        if start == "uniform":
            return sample_uniform(domain, n, seed)
        return sample_density(sizing, domain, n, seed, self.dtype)


class _Loop:
    """One level's run: step, record, decide whether to go on."""

    def __init__(
        self,
        mesh: Mesh,
        method: Method,
        max_steps: int,
        tol: float,
        callback: Callable[[np.void], object] | None,
    ) -> None:
        self.mesh, self.method = mesh, method
        self.max_steps, self.tol, self.callback = max_steps, tol, callback
        self.rows: list[np.ndarray] = []
        self.began = time.perf_counter()

    def run(self, settings: dict[str, Any]) -> Result:
        mesh, method = self.mesh, self.method
        initial, converged, reason = None, False, "max_steps reached"
        stop = self.record(0, None)
        try:
            for step in range(1, self.max_steps + 1):
                if stop:
                    break
                solution = method.displace(mesh)
                if initial is None:
                    initial = self.displacements()
                method.move(mesh)
                mesh.update()
                stop = self.record(step, solution)
                if not stop and self.stalled():
                    converged, reason = True, "error and quality no longer improve"
                    break
            if stop:
                reason = "stopped by the callback"
        except KeyboardInterrupt:
            reason = "interrupted"
            mesh.update()
        method.displace(mesh)
        final = self.displacements()
        return Result(
            points=(diagram := mesh.diagram()).points,
            diagram=diagram,
            size=mesh.values(mesh.h, mesh.domain.frame[1]),
            error=mesh.values(mesh.error),
            quality=mesh.values(mesh.quality),
            history=np.concatenate(self.rows),
            converged=converged,
            stop_reason=reason,
            initial=initial,
            final=final,
            settings=settings,
        )

    def record(self, step: int, solution: Any) -> bool:
        """Append a row of the history; True if the callback wants to stop."""
        mesh = self.mesh
        s, n = mesh.assess(), mesh.n
        mesh.sizing.check(mesh.points, mesh.h)
        row = np.zeros(1, HISTORY_DTYPE)
        row["step"], row["cells"] = step, n
        row["mean_error"], row["max_error"] = s["error"].magnitude / n, s["error"].peak
        row["mean_quality"], row["min_quality"] = s["quality"].sum / n, s["quality"].least
        row["energy"] = s["energy"].sum * mesh.domain.frame[1] ** (mesh.engine.dim + 2)
        row["changed"], row["ever_changed"] = round(s["changed"].sum), s["ever"].sum / n
        if solution is not None:
            row["lloyd"], row["poisson"] = s["lloyd"].sum / n, s["correction"].sum / n
            row["iterations"], row["residual"] = solution.iterations, solution.residual
        row["seconds"] = time.perf_counter() - self.began
        self.rows.append(row)
        return bool(self.callback is not None and self.callback(row[0]))

    def stalled(self) -> bool:
        """Tell whether neither mean error nor mean quality has improved by `tol` over the last steps."""
        if self.tol == 0 or len(self.rows) <= 2 * WINDOW:
            return False
        history = np.concatenate(self.rows)
        old, new = history[-2 * WINDOW : -WINDOW], history[-WINDOW:]
        better_error = 1 - new["mean_error"].mean() / max(old["mean_error"].mean(), 1e-300)
        better_quality = new["mean_quality"].mean() / old["mean_quality"].mean() - 1
        return bool(max(better_error, better_quality) < self.tol)

    def displacements(self) -> Displacements:
        mesh, (origin, scale) = self.mesh, self.mesh.domain.frame
        return Displacements(
            mesh.values(mesh.points, scale) + origin,
            mesh.values(mesh.lloyd, scale),
            mesh.values(mesh.correction, scale),
        )


class _Naming:
    """Says which of the caller's points coincide, when the device has found that some do."""

    def __init__(self, points: np.ndarray, origin: np.ndarray, scale: float, real: np.dtype):
        self.working = ((points - origin) / scale).astype(real)

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, InputError):
            pair = coincident_pair(self.working)
            if pair is not None:
                raise InputError(
                    f"points[{pair[0]}] and points[{pair[1]}] coincide in {self.working.dtype}, expected "
                    "distinct generators; remove duplicates (numpy.unique(points, axis=0))"
                    + ("" if self.working.dtype == np.float64 else " or use dtype='float64'")
                ) from error
