"""What a run gives back: `Diagram` and `Result`, as NumPy arrays in the caller's order and units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from ..opencl.probe import check_process

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..adapter import Adapter
    from ..geometry.box import Domain
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
"""One row per step of a run, and one more if cells or the sizes asked for have changed after the last."""


def _read_only(array: np.ndarray) -> np.ndarray:
    """Return a view that cannot be written to: what the caller has is another's, or both's."""
    if array.flags.writeable:
        array = array.view()
        array.flags.writeable = False
    return array


class _Sealed:
    """A dataclass whose arrays cannot be written to, one that comes from a pickle included."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, _read_only(value))

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        _seal(state)


def _seal(arrays: Mapping[str, object]) -> None:
    """Make those of `arrays` that are some read-only as they are, where nobody else has them."""
    for array in arrays.values():
        if isinstance(array, np.ndarray):
            array.flags.writeable = False


class Diagram:
    """A Voronoi diagram clipped to its domain. Every attribute is a NumPy array, fetched when first asked for.

    The arrays are read-only, as are those of a `Result`: what one shares with the other stays as it was made. Take a
    `copy()` to change one.

    In a polygonal domain a cell is the part of its generator's Voronoi region (all that is nearer to it than to the
    others, as the crow flies) that lies in the domain and is connected to the generator there. Parts of the region that
    the boundary cuts off go to the cell beside them with which they share the longest face, and stay with their
    generator if there is none. A cell need not be convex, may go around holes and then has several loops of faces, and
    may have several faces in common with one neighbor, which its row then names as often.

    Attributes
    ----------
    domain : Box or Polygon
    points : (n, d) float
        Generators.
    volumes : (n,) float
        Areas in 2D.
    centroids : (n, d) float
    neighbor_starts : (n + 1,) int32
        Row i of the graph is ``neighbors[neighbor_starts[i]:neighbor_starts[i + 1]]``.
    neighbors : (m,) int32
        A generator's index, or ``-1 - k`` for wall k of the domain: in a box wall 2 a is the lower side of axis a,
        wall 2 a + 1 the upper one; in a polygon wall k is the edge from vertex k on, as the caller gave them. Its name
        is ``domain.boundary_names[domain.boundary_index[k]]``. In 2D in counter-clockwise order around the cell, in a
        polygon loop by loop, clockwise around holes.
    shifts : (m, d) int8
        In a periodic box: face k of cell i lies towards the image of its neighbor j at
        ``points[j] + shifts[k] * domain.extent``. Zeros in other domains, and towards walls.
    face_measures : (m,) float
        Lengths in 2D, areas in 3D.
    face_centroids : (m, d) float
    vertices : (v, d) float
        Each Voronoi vertex once. In a periodic box cells are not cut at the seams: their faces and corners lie around
        their generators, partly outside of the box, and a vertex is there once for each of its images that is a corner
        of a cell: cells on both sides of a seam have vertices of their own.
    cell_vertex_starts : (n + 1,) int32, 2D only
    cell_vertices : (m,) int32, 2D only
        Polygon corners, counter-clockwise; face k of a cell runs from its corner k to its corner k + 1. In a
        polygonal domain a cell of several loops has them joined to one by bridges there and back: it has more corners
        than faces, and `face_vertices` tells which are whose.
    face_vertex_starts : (m + 1,) int32, in 3D and in polygonal domains
    face_vertices : (k,) int32, in 3D and in polygonal domains
        Corners of face f of the graph, ``face_vertices[face_vertex_starts[f]:face_vertex_starts[f + 1]]``.
        In 3D counter-clockwise as seen from outside of the cell to whose row the face belongs; the other cell has
        them in the opposite order. Empty where the face is as narrow as its vertices round. In a polygonal domain the
        two ends, the cell on the left on the way from the first to the second.

    Raises
    ------
    AttributeError
        For the arrays that diagrams of such a domain do not have.

    Examples
    --------
    The neighbor graph as a sparse matrix, with the faces' lengths:

    >>> import numpy as np, scipy.sparse, clvoro
    >>> points = [(0.2, 0.3), (0.7, 0.2), (0.8, 0.8), (0.3, 0.7)]
    >>> d = clvoro.Adapter().diagram(clvoro.Box((0, 0), (1, 1)), points)
    >>> owners = np.repeat(np.arange(len(d)), np.diff(d.neighbor_starts))  # whose face each is
    >>> inner = d.neighbors >= 0
    >>> edges = owners[inner], d.neighbors[inner]
    >>> graph = scipy.sparse.csr_array((d.face_measures[inner], edges), shape=(len(d), len(d)))
    >>> graph.nnz, graph.sum(axis=1).round(3).tolist()
    (10, [0.952, 0.997, 0.894, 1.123])

    The corners of a cell, and the Delaunay triangles:

    >>> corners = d.vertices[d.cell_vertices[d.cell_vertex_starts[0]:d.cell_vertex_starts[1]]]
    >>> corners.round(2).tolist()
    [[0.0, 0.0], [0.4, 0.0], [0.49, 0.44], [0.0, 0.56]]
    >>> d.triangles().tolist()
    [[0, 1, 3], [1, 2, 3]]
    """

    _NAMES = (
        "points", "volumes", "centroids", "neighbor_starts", "neighbors", "shifts",
        "face_measures", "face_centroids", "vertices", "cell_vertex_starts", "cell_vertices", "face_vertex_starts",
        "face_vertices",
    )  # fmt: skip

    def __init__(self, domain: Domain, arrays: Mapping[str, np.ndarray | Callable[[], np.ndarray]]):
        self.domain = domain
        self._arrays = {n: a if callable(a) else _read_only(a) for n, a in arrays.items()}

    def __getattr__(self, name: str) -> np.ndarray:
        if name not in Diagram._NAMES:
            # A copy that is being made has no arrays yet, and is asked for what begins so.
            there = "" if name.startswith("_") else f"; it has {', '.join(self._there())}"
            raise AttributeError(f"a Diagram has no {name!r}{there}", name=name, obj=self)
        if name == "shifts" and name not in self._arrays:
            none = np.zeros((len(self.neighbors), self.domain.dim), np.int8)
            self._arrays[name] = _read_only(none)
        if name not in self._arrays:
            raise AttributeError(
                f"{name}: a diagram in {self.domain.dim}D has none; it has {', '.join(self._there())}"
            )
        value = self._arrays[name]
        if callable(value):
            check_process()  # it may be on a device still
            value = self._arrays[name] = _read_only(value())
        return value

    def _there(self) -> list[str]:
        return [n for n in Diagram._NAMES if n == "shifts" or n in self._arrays]

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._there()]

    def __getstate__(self) -> dict[str, Any]:
        # Arrays that have not been asked for are fetched: they may be on a device still.
        return {"domain": self.domain, "_arrays": {n: getattr(self, n) for n in self._arrays}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        _seal(self._arrays)

    def triangles(self) -> np.ndarray:
        """Return the dual triangulation in the plane: triples of generators whose cells meet in a vertex.

        They are the Delaunay triangles whose circumcenter lies in the domain (those of others, between cells that meet
        only beyond a wall, are not there). Where more than three cells meet, as in a square lattice, their generators'
        polygon is cut into triangles.

        Returns
        -------
        (t, 3) int32
            Counter-clockwise, sorted by vertex.

        Raises
        ------
        InputError
            In 3D, and in periodic boxes, where a triangle's corners may be images.
        """
        from .delaunay import dual_triangles

        return dual_triangles(self)

    def check(self) -> Report:
        """Verify the diagram on the host: graph, faces, volumes, and that it is the Voronoi diagram of its generators.

        Returns
        -------
        Report
            True if nothing is wrong; ``print`` it, or call its ``demand()`` to have an error raised.
        """
        from .check import check_diagram

        return check_diagram(self)

    def transfer(
        self,
        values: ArrayLike,
        onto: Result | Diagram,
        order: int = 1,
        *,
        limited: bool = True,
        adapter: Adapter | None = None,
    ) -> np.ndarray:
        """Carry cell data over to another mesh of the same domain, conservatively.

        A new cell gets the mean over its parts, each of which it has in common with one old cell. With `order` 1 an
        old cell has its value everywhere; with 2 it has a linear function about its centroid, whose slope fits the
        neighbors' values by least squares, limited as by Barth and Jespersen (AIAA 89-0366, 1989): at no corner of the
        cell beyond the values of cell and neighbors.

        Parameters
        ----------
        values : (n,) or (n, k) array of real numbers
            Means over the cells of this mesh, in the order of its points.
        onto : Result or Diagram
            The new mesh.
        order : 1 or 2
        limited : bool
            With False slopes are as they are: linear functions stay exact (to rounding) at walls and extrema too,
            wherever a cell has d neighbors in different directions, and values may leave the bounds of the old ones.
        adapter : Adapter, optional
            Whose device does the work; by default that of `create_context()`. In float64 where the device has it.
            Between meshes of a polygonal domain, whose cells need not be convex, the host does it.

        Returns
        -------
        (n_new,) or (n_new, k) float64
            The mass, the sum of volume times value, is kept to 1e-12 of that of the absolute values, and every new
            value lies between the least and the largest old one nearby (unless `limited` is False). Rounding leaves
            the mass off by little; that is made up for in proportion to the room up to those bounds. Between float32
            meshes, whose volumes are rounded, bounds take precedence: the mass of a constant is off as the sums of
            volumes are.

        Raises
        ------
        InputError, InputTypeError
            If the meshes have different domains or a periodic one in 3D, `values` has another shape or is not finite (a
            mean with a NaN is none), or `order` is neither 1 nor 2.
        ClvoroError
            If one of the meshes is not the Voronoi diagram of its points.
        """
        from ..remapping.remap import transfer_values

        return transfer_values(self, values, onto, order, limited, adapter)

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"Diagram({len(self)} cells in {self.domain})"


@dataclass(frozen=True)
class Displacements(_Sealed):
    """The two halves of one step, before they are combined: the paper's Figure 6.

    Attributes
    ----------
    points : (n, d) float
        Generators before the step.
    lloyd, poisson : (n, d) float
        Displacement towards the centroids, and the metric correction; lengths in the domain's unit.
    """

    points: np.ndarray
    lloyd: np.ndarray
    poisson: np.ndarray


@dataclass(frozen=True)
class Result(_Sealed):
    """A finished (or interrupted) run. Its arrays are read-only; take a `copy()` to change one.

    Attributes
    ----------
    points : (n, d) float
        Generators: `diagram.points`, in the order of `origin`.
    diagram : Diagram
    target_size : (n,) float
        Target size h at the generators, in the domain's unit of length.
    size_error : (n,) float
        Signed metric error e, the paper's (3.1).
    quality : (n,) float
        Cell quality, the paper's (4.1), 1 for a regular polygon; in 3D the isoperimetric quotient 36 pi V^2 / S^3. In a
        polygonal domain it is that of the polygon in which faces on the boundary are one straight side as long as they
        turn by no more than 30 degrees in sum; holes within a cell are no sides.
    history : structured array of `HISTORY_DTYPE`
        One row per step: ``history["mean_error"]``, ...; the last one tells of this mesh. One more follows where a run
        is stopped before all is done (on a coarser level, before sizes are scaled to `n_cells`, or amid a step).
    converged : bool
        Whether the run ended by itself: at its tolerance, or with its plan.
    stop_reason : str
        Why it ended, for people.
    initial, final : Displacements or None
        Lloyd and Poisson displacements of the first and of the last step; where a run may end after any step (methods
        that repeat one kind, a callback that stops it), those of the step that would come next are the last.
    size_factor : float
        With `n_cells` of methods "adaptive" and "exact", `target_size` is the size field times this common factor;
        else 1.
    settings : dict
        What is needed to repeat the run: of the options those that its method uses.
    origin : (n,) int32 or None
        Index, in the points that the run began with, of the generator that each row continues; -1 where it was
        inserted. Rows stand in this order, inserted ones last. What is not listed was deleted.
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

    def check(self) -> Report:
        """Verify diagram, sizes, error, quality and history on the host (see `Diagram.check`)."""
        from .check import check_result

        return check_result(self)

    def transfer(
        self,
        values: ArrayLike,
        onto: Result | Diagram,
        order: int = 1,
        *,
        limited: bool = True,
        adapter: Adapter | None = None,
    ) -> np.ndarray:
        """Carry cell data (n,) or (n, k) over to another mesh of the same domain; see `Diagram.transfer`."""
        return self.diagram.transfer(values, onto, order, limited=limited, adapter=adapter)

    def save(self, path: str | PathLike[str], **options: Any) -> None:
        """Write the mesh to `path`: `.npz` (for `clvoro.load`), `.vtu`, netCDF (`.nc`), OpenFOAM's `polyMesh`, ...

        See `clvoro.io.save` for all formats and their options.
        """
        from ..io import save

        save(self, path, **options)

    def plot(self, color: str = "error", **options: Any) -> Any:
        """Draw the cells colored by "error", "quality", "size", "sides" or "skewness"; returns the Matplotlib figure.

        In 3D `view` is "slices" (default), "slice" or "cutaway"; see `clvoro.plotting` for further options.
        """
        from ..plotting import plot_mesh

        return plot_mesh(self, color, **options)

    @cached_property
    def measures(self) -> Measures:
        """Skewness, angles and ratios that matter to finite-volume methods; computed when first asked for."""
        from .quality import measure_mesh

        return measure_mesh(self.diagram)

    def __repr__(self) -> str:
        e, q = np.abs(self.size_error), self.quality
        return (
            f"Result({len(self.points)} cells, mean |e| {e.mean():.4f}, max |e| {e.max():.4f}, "
            f"mean Q {q.mean():.4f}, min Q {q.min():.4f}; {self.stop_reason})"
        )
