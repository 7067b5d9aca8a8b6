"""The results of runs: meshes with sizes and history, figures that describe them, prescribed volumes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from .diagram import Diagram
from .output import MeshOutput
from .read_only import Sealed
from .straightening import have_corners

if TYPE_CHECKING:
    from ..adaptation.gathering import ResultParts
    from ..finite_volumes.gate import Solver, SolverReport
    from ..finite_volumes.solver_mesh import WallShape
    from .check.findings import Report
    from .quality import Measures

HISTORY_DTYPE = np.dtype(
    [
        ("step", "i4"),  # 0 is the start, before any motion
        ("level", "i4"),  # 0 is the finest; coarser levels count up
        ("cells", "i4"),
        ("mean_error", "f8"),  # mean of |e|, the paper's (3.1)
        ("max_error", "f8"),
        ("mean_quality", "f8"),  # the paper's (4.1) in 2D, isoperimetric quotient in 3D
        ("min_quality", "f8"),
        ("energy", "f8"),  # CVT energy, the paper's (2.3), in physical units
        ("lloyd", "f8"),  # mean length of the Lloyd displacement over h
        ("poisson", "f8"),  # mean length of the metric correction over h
        ("iterations", "i4"),  # of the linear solver in this step
        ("residual", "f8"),  # its relative residual at the end
        ("changed", "i4"),  # cells whose set of neighbors changed in this step
        ("ever_changed", "f8"),  # share of cells whose set of neighbors has changed on this level
        ("inserted", "i4"),
        ("deleted", "i4"),
        ("progress", "f8"),  # share of the planned work that is done
        ("seconds", "f8"),  # wall time since the run began
    ]
)
"""Columns of the history: one row per step, and one more if cells or target sizes have changed after the last step."""


@dataclass(frozen=True, eq=False)
class Displacements(Sealed):
    """The two displacements of one step, before they are combined: the paper's Figure 6.

    Attributes
    ----------
    points : (n, d) float64
        Generators before the step.
    lloyd, poisson : (n, d) float64
        Displacement to the centroids, and the metric correction, in the domain's unit of length.
    """

    points: np.ndarray
    lloyd: np.ndarray
    poisson: np.ndarray


@dataclass(frozen=True, eq=False)
class Result(Sealed, MeshOutput):
    """The mesh of a run, with its sizes, errors, quality and history.

    Arrays are read-only; take a ``copy()`` to change one.

    Attributes
    ----------
    points : (n, d) float64
        Generators: `diagram.points`, in the domain's unit of length.
    diagram : Diagram
        Cells, faces and vertices.
    target_size : (n,) float64
        Target size h at the generators, in the domain's unit of length.
    size_error : (n,) float64
        Signed metric error e, the paper's (3.1): positive where a cell is too large. In a polygonal domain sizes and
        quality are those of cells with straight walls, as the mesh for solvers has them: along the boundary a cell has
        one straight side, or several with the convex corners of the domain between. Areas in `diagram` are exact.
    quality : (n,) float64
        Cell quality: in 2D the paper's (4.1), 1 for a regular polygon; in 3D the isoperimetric quotient
        36 pi V^2 / S^3.
    history : structured array of `HISTORY_DTYPE`
        One row per step: ``history["mean_error"]``, ... The last row describes this mesh. It is an additional one if
        the run was stopped on a coarser level, before sizes were scaled to `n_cells`, or within a step. Cells in the
        holes of a periodic box are deleted in it.
    converged : bool
        Whether the run ended by itself: at its tolerance, or at the end of its plan.
    stop_reason : str
        Why the run ended.
    initial, final : Displacements or None
        Lloyd and Poisson displacements of the first and of the last step. If the last step is not known beforehand
        (methods that repeat one kind of step, a callback that stops the run), `final` is those of
        one more step of the same method.
    size_factor : float
        With `n_cells` of methods "adaptive" and "exact", and always with "transport", `target_size` is the size field
        times this common factor; else 1.
    settings : dict
        The options that the method uses, to repeat the run. ``settings["error_target"]`` is the one that the run had,
        given or chosen by the size field, and ``settings["trade"]`` says so in words; ``settings["path"]`` says whether
        the mesh of given points was only corrected, and why; ``settings["widths"]`` says where
        the default width of layers is below the size field. ``settings["thickness"]`` has a dict for each of the layers
        in a solid, with the thickness ``asked`` for, the ``min``, ``mean`` and ``max`` on polygons of the wall, and
        ``full_share``, the share of the wall's area where it is at least 0.9 of that.
    origin : (n,) int32 or None
        Index of each generator in the points with which the run began, of a fixed one that of the point whose place it
        has taken; -1 for inserted generators, which come last, for those of layers, and for those that have replaced
        given points far from the target sizes.
    parts : ResultParts or None
        Over the ranks of MPI: what `gather` needs. The arrays above are then those of the cells of this rank, and faces
        towards the cells of rank K are on a wall called ``"rankK"``, such as ``"rank1"``.
    """

    points: np.ndarray
    diagram: Diagram
    target_size: np.ndarray
    size_error: np.ndarray
    quality: np.ndarray
    history: np.ndarray
    converged: bool
    stop_reason: str
    initial: Displacements | None = None
    final: Displacements | None = None
    size_factor: float = 1.0
    settings: dict[str, Any] = field(default_factory=dict)
    origin: np.ndarray | None = None
    parts: ResultParts | None = None

    def gather(self) -> Result | None:
        """Return the mesh of all ranks on rank 0, with rows in the order of generators, and None on the others.

        All ranks call this together. The result of a run without ranks returns itself.

        Raises
        ------
        MemoryLimitError
            On rank 0, if its device does not hold the mesh; save it as ``.pvtu`` instead.
        """
        return self if self.parts is None else self.parts.gather(self)

    @overload
    def check(self, solver: None = None, *, walls: WallShape | None = None) -> Report: ...

    @overload
    def check(self, solver: Solver, *, walls: WallShape | None = None) -> SolverReport: ...

    def check(self, solver: Solver | None = None, *, walls: WallShape | None = None) -> Report | SolverReport:
        """Verify diagram, sizes, error, quality and history on the host, or the mesh of a solver.

        See `Diagram.check`.
        """
        if solver is not None or walls is not None:
            return self.diagram.check(solver, walls=walls)
        from .check.mesh import check_result

        return check_result(self)

    def summary(self) -> dict[str, Any]:
        """Return the figures that describe the mesh and the run.

        Returns
        -------
        dict
            ``cells``, ``steps``, ``mean_error`` and ``max_error`` (of |e|), ``mean_quality``, ``min_quality``,
            ``size_factor``, ``error_target`` and ``trade`` (the mean error that the run aimed at, and why; None with
            the methods that repeat one kind of step), ``ever_changed`` (share of cells whose set of neighbors changed
            on the finest level), ``converged``, ``stop_reason`` and ``seconds``. In a polygonal domain also
            ``boundary_cells``, ``boundary_mean_error``, ..., and ``inner_cells``, ... for the cells on the boundary and
            the others; and ``corner_cells``, ... for those on the boundary with a corner of more than 30 degrees, where
            the domain limits the quality (None where there is no such cell); and ``left_out_parts`` and
            ``left_out_area`` of `left_out`. In a solid ``left_out_parts`` and ``left_out_volume``; with layers also
            ``layer_cells``, and their ``thickness`` as in `settings`.

        Examples
        --------
        >>> mesh = clvoro.adapt(clvoro.Box((0, 0), (1, 1)), 0.1, "fast")
        >>> figures = mesh.summary()
        >>> figures["cells"] == len(mesh.points), figures["stop_reason"]
        (True, 'plan completed')
        """
        return summary(self)

    @property
    def measures(self) -> Measures:
        """Skewness, angles and ratios that matter to finite-volume methods; computed when first used."""
        return self.diagram.measures

    @property
    def _diagram(self) -> Diagram:
        return self.diagram

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.points)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Return an attribute of the diagram, such as `volumes`, `neighbors` or `domain`."""
            there = name == "domain" or name in Diagram._NAMES or hasattr(Diagram, name)
            if there and not name.startswith("_"):
                return getattr(self.diagram, name)
            raise AttributeError(f"a Result has no {name!r}", name=name, obj=self)

    def __repr__(self) -> str:
        e, q, scaled = np.abs(self.size_error), self.quality, self.scaling
        return (
            f"Result({len(self.points)} cells, mean |e| {e.mean():.4f}, max |e| {e.max():.4f}, "
            f"mean Q {q.mean():.4f}, min Q {q.min():.4f}; {scaled + '; ' if scaled else ''}{self.stop_reason})"
        )

    @property
    def scaling(self) -> str:
        """By which factor `n_cells` has scaled the sizes, and how many cells the field alone would give, in words.

        Empty without `n_cells`, and where the factor is 1 to three digits.
        """
        factor = self.size_factor
        if self.settings.get("n_cells") is None or round(factor, 3) == 1:
            return ""
        alone = round(len(self.points) * factor**self.diagram.domain.cell_dim)
        return f"sizes x {factor:.3g} (the field alone: {alone:,} cells)"


def result_of_file(
    diagram: Diagram, target_size: np.ndarray, size_error: np.ndarray, quality: np.ndarray, kind: str
) -> Result:
    """Return the result that a file of `kind`, such as ".vtu", holds: it has no history."""
    return Result(
        points=diagram.points,
        diagram=diagram,
        target_size=target_size,
        size_error=size_error,
        quality=quality,
        history=np.zeros(0, HISTORY_DTYPE),
        converged=False,
        stop_reason=f"read from a {kind} file",
    )


def figures(size_error: np.ndarray, quality: np.ndarray) -> dict[str, float]:
    """Return mean and largest |e|, and mean and least Q, by their names in the history."""
    error = np.abs(size_error)
    return {
        "mean_error": float(error.mean()),
        "max_error": float(error.max()),
        "mean_quality": float(quality.mean()),
        "min_quality": float(quality.min()),
    }


def summary(result: Result) -> dict[str, Any]:
    """Return the figures of a run; see `Result.summary`. Over ranks they are those of all cells."""
    history = result.history
    parts = beside_boundary(result).items()
    apart = {f"{part}_{name}": value for part, some in parts for name, value in some.items()}
    cells, now = len(result.points), figures(result.size_error, result.quality)
    if result.parts is not None:
        last = result.history[-1]
        cells, now = int(last["cells"]), {name: float(last[name]) for name in now}
    what = result.diagram.domain.leaves_out
    if what and not result.diagram.is_power:
        left = result.diagram.left_out
        apart |= {"left_out_parts": len(left), f"left_out_{what}": left.total}
    if in_layers := int(np.count_nonzero(result.diagram.layer)):
        apart |= {"layer_cells": in_layers, "thickness": result.settings.get("thickness")}
    return {
        "cells": cells,
        "steps": int(history["step"][-1]) if len(history) else 0,
        **now,
        "size_factor": float(result.size_factor),
        "error_target": result.settings.get("error_target"),
        "trade": result.settings.get("trade"),
        "path": result.settings.get("path"),
        "ever_changed": float(history["ever_changed"][-1]) if len(history) else 0.0,
        "converged": bool(result.converged),
        "stop_reason": result.stop_reason,
        "seconds": float(history["seconds"][-1]) if len(history) else 0.0,
        **apart,
    }


def beside_boundary(result: Result) -> dict[str, dict[str, Any]]:
    """Return number, mean |e|, mean and least Q of `boundary` cells, those of them at a `corner`, and `inner` cells.

    A corner is a turn of the boundary by more than 30 degrees; see `have_corners`. The values are None if there is no
    such cell. Where no edges cut cells, there are no such parts.
    """
    d = result.diagram
    if not d.domain.cutting_edges:
        return {}
    on_boundary = np.bincount(d.half_faces.owner, d.neighbors < 0, len(d)) > 0
    found = {}
    at_corner = have_corners(d)
    for name, which in (("boundary", on_boundary), ("corner", at_corner), ("inner", ~on_boundary)):
        error, quality = np.abs(result.size_error[which]), result.quality[which]
        some = bool(which.any())
        found[name] = {
            "cells": int(which.sum()),
            "mean_error": float(error.mean()) if some else None,
            "mean_quality": float(quality.mean()) if some else None,
            "min_quality": float(quality.min()) if some else None,
        }
    return found


def thickness_in_words(thickness: Sequence[Mapping[str, float]]) -> list[str]:
    """Return for each of the layers in a solid in words how thick they are; see `Result.settings`."""
    return [
        f"layers[{k}] are {t['min']:.3g} to {t['max']:.3g} thick, {t['mean']:.3g} in the mean, and {t['asked']:.3g} on "
        f"{100 * t['full_share']:.3g} % of their walls"
        for k, t in enumerate(thickness)
    ]


def boundary_line(result: Result) -> str:
    """Return the figures of cells on the boundary, of those at its corners, and of the others as one line of text."""
    names = {"boundary": "boundary cells", "corner": "of them at corners", "inner": "inner cells"}
    return "; ".join(
        f"{s['cells']} {names[name]}: mean |e| {s['mean_error']:.4f}, mean Q {s['mean_quality']:.4f}, "
        f"min Q {s['min_quality']:.3f}"
        for name, s in beside_boundary(result).items()
        if s["cells"]
    )


@dataclass(frozen=True, eq=False)
class Transported(Sealed):
    """A power diagram whose cells have prescribed volumes.

    Attributes
    ----------
    diagram : Diagram
        Its `weights` are those found; their mean is arbitrary.
    errors : (k + 1,) float64
        Largest |V - m| / m at the start and after each of k steps of Newton's method.
    shares : (k,) float64
        Share of each Newton step that was taken: 1 without damping.
    converged : bool
        Whether the last error is within the tolerance.
    """

    diagram: Diagram
    errors: np.ndarray
    shares: np.ndarray
    converged: bool

    def __repr__(self) -> str:
        return (
            f"Transported({len(self.diagram)} cells, relative error {self.errors[-1]:.2g} after "
            f"{len(self.shares)} steps)"
        )
