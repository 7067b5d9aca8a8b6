"""`adapt` and `voronoi`: what most callers need, with one adapter for all of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from .adaptation.options import EffortName, MethodName, Start
from .adapter import Adapter
from .errors import DeviceError
from .geometry.boundary_layers import Layers
from .geometry.domain import Domain
from .mesh.diagram import Diagram
from .mesh.results import Result, Transported

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_shared: Adapter | None = None
_sharing = threading.Lock()


def shared_adapter() -> Adapter:
    """Return the adapter of `adapt` and `voronoi`, on the best device; it is created by the first call.

    It computes in float64, or in float32 if no device computes in float64.

    Raises
    ------
    DeviceError
        If no device works.
    """
    global _shared
    with _sharing:
        if _shared is None:
            try:
                _shared = Adapter()
            except DeviceError:
                _shared = Adapter(dtype="float32")
        return _shared


def adapt(
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
    callback: Callable[[np.void], object] | None = None,
) -> Result:
    """Mesh `domain` by Voronoi cells of the target size, on the best device.

    All calls share one adapter, in float64 where a device has it. Calls from several threads wait for each other. For
    a device, a precision or further options of your own use ``clvoro.Adapter(ctx, dtype).run(...)``.

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
        Generators to start from: those of the array, random ones with density h^-d, or uniform random ones as in
        the paper. From an array, "adaptive" and "exact" only correct and polish a mesh that nearly has the sizes
        already (mean |e| up to 0.15, count off by 2 % at most, cells as good as after a run with this effort), as
        after the size field has moved by a few cells. From any other array they run all levels.
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
        Rows of generators along walls of a box in 2D or a polygon. They do not move and are the first rows of the
        result. Beyond them the sizes grow gradually from the size of the layers; see `Layers`. Their cells count as
        having the right size.
    fixed : (k, d) array of float, optional
        Generators that do not move, such as wells: rows 0 to k - 1 of the result, exactly at these positions. Their
        neighbors move until all have their sizes. Not for "transport" and moving meshes, which move all of them.
    seed : int
        Seed of the random start.
    callback : callable, optional
        Called with each new row of the history (fields as in `Result.history`: ``row["mean_error"]``, ...). The
        run stops if it returns True.

    Returns
    -------
    Result

    Raises
    ------
    DeviceError
        If no device works.
    InputError, InputTypeError
        If an argument is not as expected, or a generator of `fixed` is outside, on a wall, within a layer, or at the
        place of another one; says where.
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
    return shared_adapter().run(
        domain,
        size,
        effort,
        points=points,
        method=method,
        n_cells=n_cells,
        layers=layers,
        fixed=fixed,
        seed=seed,
        callback=callback,
    )


def power_diagram(domain: Domain, points: ArrayLike, weights: ArrayLike) -> Diagram:
    """Return the power diagram (Laguerre diagram) of `points` with `weights` in `domain`, on the best device.

    The cell of generator i is the set of y with ``|y - x_i|^2 - w_i <= |y - x_j|^2 - w_j`` for all j (Aurenhammer 1987,
    SIAM J. Comput. 16, 78). Its faces are at right angles to the lines between generators, and a larger weight makes
    the cell larger. It need not contain its generator, and may be empty. Equal weights give the Voronoi diagram. In a
    polygon a cell is the whole part of the domain that the definition gives it: on both sides of a wall thinner than a
    cell, if need be, where `voronoi` gives the part without the generator to a neighbor. On a sphere of radius R it is
    the set of y with ``exp(w_i / 2R^2) x_i.y >= exp(w_j / 2R^2) x_j.y`` for all j, which is the same for cells that are
    small; faces are arcs of great circles (Sugihara 2002, J. Geom. Graph. 6, 69).

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
    return shared_adapter().power_diagram(domain, points, weights)


def transport(
    domain: Domain,
    points: ArrayLike,
    volumes: ArrayLike,
    *,
    tolerance: float | None = None,
    max_steps: int = 100,
    relax: int = 0,
) -> Transported:
    """Find the weights with which the cells of a power diagram have prescribed `volumes`, on the best device.

    These cells transport the volume of the domain to the generators at the least cost, the integral of the squared
    distance. Damped steps of Newton's method find them for any volumes that sum to that of the domain (Kitagawa,
    Merigot and Thibert 2019, J. Eur. Math. Soc. 21, 2603). On a sphere the cost is -log of the cosine of the angle: a
    cell lies within 90 degrees of its generator, so that areas that are very different from those of the Voronoi cells
    may have no solution.

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
        transport. Cells become round, as the grains of a polycrystal. ``diagram.points`` are the generators at the end.

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
    return shared_adapter().transport(domain, points, volumes, tolerance=tolerance, max_steps=max_steps, relax=relax)


def voronoi(domain: Domain, points: ArrayLike) -> Diagram:
    """Return the Voronoi diagram of `points` in `domain`, computed on the best device.

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
    return shared_adapter().diagram(domain, points)
