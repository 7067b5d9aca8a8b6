"""A Voronoi diagram as NumPy arrays, in the caller's order and units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from ..errors import InputError
from ..opencl.probe import check_process
from .output import MeshOutput
from .read_only import read_only, seal

if TYPE_CHECKING:
    import scipy.sparse
    from numpy.typing import ArrayLike

    from ..finite_volumes.gate import Solver, SolverReport
    from ..finite_volumes.solver_mesh import WallShape
    from ..geometry.domain import Domain
    from .check.findings import Report
    from .faces import Faces
    from .half_faces import HalfFaceArrays
    from .lookup import Cell, Locator
    from .quality import Measures


class Diagram(MeshOutput):
    """A Voronoi diagram clipped to its domain, as `clvoro.voronoi` and `Adapter.diagram` return it.

    Row i belongs to the i-th generator of the caller. Arrays are read from the device when they are first used. They
    are read-only; take a ``copy()`` to change one.

    The graph is stored by cells: the row of a cell lists its faces, each with the neighbor behind it. A face between
    two cells is in the rows of both (two half-faces). `faces` has each face once.

    In a polygonal domain a cell is the part of its generator's Voronoi region that lies in the domain and is connected
    to the generator there. Parts of the region that the boundary cuts off belong to the adjacent cell with which they
    share the longest face, or to their generator if there is no such cell. A cell need not be convex. It may surround
    holes, and then has several loops of faces. It may share several faces with one neighbor, which its row then lists
    several times.

    In a solid the rows are those of the generators that have a cell, in their order. Then follow further parts of cells
    that are cut along concave creases, each with its centroid in place of a generator.

    Attributes
    ----------
    domain : Box, Polygon, Sphere, Solid, SphereRegion or Subdomain
    points : (n, d) float64
        Generators, in the domain's unit of length.
    volumes : (n,) float64
        Volumes of the cells; areas in 2D.
    centroids : (n, d) float64
        Centroids of the cells.
    neighbor_starts : (n + 1,) int32
        The row of cell i is ``neighbors[neighbor_starts[i]:neighbor_starts[i + 1]]``, and likewise in all arrays with m
        entries, one per half-face.
    neighbors : (m,) int32
        Cell behind each half-face, or ``-1 - k`` for wall k of the domain. In a box wall 2 a is the lower side of axis
        a, and wall 2 a + 1 the upper one. In a polygon wall k is the edge that begins in vertex k, as the caller gave
        them. Its name is ``domain.boundary_names[domain.boundary_index[k]]``. In 2D the order is counter-clockwise
        around the cell; in a polygon loop by loop, clockwise around holes.
    shifts : (m, d) int8
        In a periodic box the neighbor j behind half-face k is the image of generator j at
        ``points[j] + shifts[k] * domain.extent``. Zeros in other domains, and on walls.
    face_measures : (m,) float64
        Areas of the faces; lengths in 2D.
    face_centroids : (m, d) float64
        Centroids of the faces.
    vertices : (v, d) float64
        Voronoi vertices, each once. In a periodic box cells are not cut at the seams: their faces and corners lie
        around their generators, partly outside of the box. Each image of a vertex that is a corner of a cell is listed
        as a separate vertex.
    cell_vertex_starts : (n + 1,) int32, 2D only
    cell_vertices : (c,) int32, 2D only
        Corners of cell i, ``cell_vertices[cell_vertex_starts[i]:cell_vertex_starts[i + 1]]``, counter-clockwise. In a
        box face k of a cell runs from its corner k to its corner k + 1. In a polygonal domain several loops of a cell
        are joined by bridges there and back, so that it has more corners than faces.
    face_vertex_starts : (m + 1,) int32
    face_vertices : (k,) int32
        Corners of half-face f, ``face_vertices[face_vertex_starts[f]:face_vertex_starts[f + 1]]``. In 2D the two ends,
        with the cell on the left of the way from the first to the second. In 3D the order is counter-clockwise as seen
        from outside of the cell; the opposite half-face has the opposite order. Empty where a face is as narrow as
        round-off.
    home : (n,) int or None
        In a solid the row i of each cell's generator among those that the mesh was made of; -1 - i for further parts
        of its cell. Beside surfaces inside a box the rows of the cells. None elsewhere: cell i is that of generator i.
    weights : (n,) float64
        Weights w of the generators in a power diagram, in the square of the domain's unit of length. Zeros in a Voronoi
        diagram.
    layer : (n,) int16
        Number of the layer of each cell along walls of a solid, 1 at the wall; 0 for other cells. See `clvoro.Layers`.

    Raises
    ------
    AttributeError
        For arrays that diagrams of such a domain do not have.

    Examples
    --------
    >>> points = [(0.2, 0.3), (0.7, 0.2), (0.8, 0.8), (0.3, 0.7)]
    >>> d = clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), points)

    The corners of a cell, and the Delaunay triangles:

    >>> d.cell(0).vertices.round(2).tolist()
    [[0.0, 0.0], [0.4, 0.0], [0.49, 0.44], [0.0, 0.56]]
    >>> d.triangles().tolist()
    [[0, 1, 3], [1, 2, 3]]

    The flux out of each cell for the velocity (1, 0), which has no sources:

    >>> import numpy as np
    >>> f = d.faces
    >>> flux = f.area * f.normal[:, 0]
    >>> inner = f.neighbor >= 0
    >>> out = np.bincount(f.owner, flux, len(d)) - np.bincount(f.neighbor[inner], flux[inner], len(d))
    >>> bool(abs(out).max() < 1e-15)
    True
    """

    _NAMES = (
        "points",
        "volumes",
        "centroids",
        "neighbor_starts",
        "neighbors",
        "shifts",
        "face_measures",
        "face_centroids",
        "vertices",
        "cell_vertex_starts",
        "cell_vertices",
        "face_vertex_starts",
        "face_vertices",
        "weights",
        "layer",
    )

    def __init__(self, domain: Domain, arrays: Mapping[str, np.ndarray | Callable[[], np.ndarray]]) -> None:
        """`arrays` has arrays by name, or functions that return them, called when they are first used.

        Arrays that are missing follow from the others, or diagrams of such a domain do not have them.
        """
        self.domain = domain
        self._arrays = {n: a if callable(a) else read_only(a) for n, a in arrays.items()}
        self._derived: dict[str, np.ndarray] = {}
        self.home: np.ndarray | None = None

    def __getattr__(self, name: str) -> np.ndarray:
        if name not in self._NAMES:
            # A copy under construction has no arrays yet; `copy` looks for private names.
            there = "" if name.startswith("_") else f"; it has {', '.join(self._there())}"
            raise AttributeError(f"a Diagram has no {name!r}{there}", name=name, obj=self)
        value = self._arrays.get(name)
        if value is None:
            if name not in self._there():
                raise AttributeError(
                    f"a diagram in {self.domain.dim}D has no {name}; it has {', '.join(self._there())}"
                )
            if name not in self._derived:
                self._derived[name] = read_only(self._derive(name))
            return self._derived[name]
        if callable(value):
            check_process()  # it may still be on a device
            value = self._arrays[name] = read_only(value())
        return value

    def _derive(self, name: str) -> np.ndarray:
        """Return an array that follows from others."""
        if name == "shifts":
            return np.zeros((len(self.neighbors), self.domain.dim), np.int8)
        if name == "weights":
            return np.zeros(len(self.points))
        if name == "layer":
            return np.zeros(len(self.points), np.int16)
        if name == "face_vertex_starts":
            return 2 * np.arange(len(self.cell_vertices) + 1, dtype=np.int32)
        from ..connectivity import following

        corners = self.cell_vertices
        return np.stack([corners, corners[following(self.cell_vertex_starts)]], axis=1).ravel()

    def _there(self) -> list[str]:
        """Return the names of the arrays."""
        derived = ["shifts", "weights", "layer"]
        if "cell_vertices" in self._arrays:
            derived += ["face_vertex_starts", "face_vertices"]
        return [n for n in self._NAMES if n in derived or n in self._arrays]

    def put_points(self, points: np.ndarray) -> None:
        """Replace the positions of generators by `points` (n, d), which differ by round-off."""
        self._arrays["points"] = read_only(points)

    def with_arrays(self, **arrays: np.ndarray) -> Diagram:
        """Return a diagram with other arrays of these names, and its own ones otherwise."""
        made = Diagram(self.domain, {**self._arrays, **arrays})
        made.home = self.home
        return made

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._there()]

    @property
    def is_power(self) -> bool:
        """Whether it is a power diagram. Its cells need not contain their generators, and may be empty."""
        return "weights" in self._arrays

    @cached_property
    def has_moved_vertices(self) -> bool:
        """Whether vertices are off the planes between generators: in solids, and beside curved surfaces inside."""
        domain = self.domain
        return domain.curved_walls or (domain.sheets is not None and bool(self.half_faces.bent_cells.any()))

    def __reduce__(self) -> tuple[Any, ...]:
        # Arrays that may still be on a device are read.
        return _rebuilt, (self.domain, {n: getattr(self, n) for n in self._arrays}), {"home": self.home}

    @property
    def _diagram(self) -> Diagram:
        return self

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        kind = ""
        if self.is_power:
            kind = "power diagram: "
            if len(self.empty_cells):
                kind += f"{len(self.empty_cells)} empty of "
        return f"Diagram({kind}{len(self)} cells in {self.domain})"

    @property
    def empty_cells(self) -> np.ndarray:
        """Rows of cells without volume: none in a Voronoi diagram, (k,) int."""
        return np.flatnonzero(self.volumes == 0)

    def demand_voronoi(self, what: str) -> None:
        """Raise an InputError that `what` is for Voronoi diagrams, if this is a power diagram."""
        if self.is_power:
            raise InputError(
                f"{what} takes Voronoi diagrams, and this is a power diagram, whose cells need not contain their "
                "generators; use clvoro.voronoi(domain, points), or a method other than transport"
            )

    def demand_cells(self, what: str) -> None:
        """Raise an InputError that `what` needs cells with a volume, if some are empty."""
        if self.is_power and len(self.empty_cells):
            raise InputError(
                f"{what} needs cells with a volume, and {len(self.empty_cells)} of {len(self)} are empty, the first is "
                f"{self.empty_cells[0]}; leave out their generators, which does not change the other cells: keep = "
                "d.volumes > 0; clvoro.power_diagram(d.domain, d.points[keep], d.weights[keep])"
            )

    # The graph.

    @cached_property
    def half_faces(self) -> HalfFaceArrays:
        """Every face as each of its cells has it, in the order of the rows: owner, opposite, and loops in 2D.

        See `clvoro.mesh.half_faces.HalfFaceArrays` for the arrays, which are computed when first used.

        Examples
        --------
        >>> d = clvoro.voronoi(clvoro.Box((0, 0), (2, 1)), [(0.5, 0.5), (1.5, 0.5)])
        >>> d.half_faces.owner.tolist(), d.half_faces.opposite.max()
        ([0, 0, 0, 0, 1, 1, 1, 1], np.int64(7))
        """
        from .half_faces import HalfFaceArrays

        return HalfFaceArrays(self)

    @cached_property
    def faces(self) -> Faces:
        """Every face once, seams and walls included: owner, neighbor, boundary, area, normal, center, distance.

        See `clvoro.mesh.faces.Faces` for the arrays, which are computed when first used.

        Examples
        --------
        >>> d = clvoro.voronoi(clvoro.Box((0, 0), (2, 1)), [(0.5, 0.5), (1.5, 0.5)])
        >>> f = d.faces
        >>> f.owner[0], f.neighbor[0], f.area[0], f.normal[0].tolist(), f.center[0].tolist(), f.distance[0]
        (np.int32(0), np.int32(1), np.float64(1.0), [1.0, 0.0], [1.0, 0.5], np.float64(1.0))
        >>> [d.domain.boundary_names[k] for k in f.boundary[f.n_inner:]]
        ['xMin', 'xMax', 'yMin', 'yMin', 'yMax', 'yMax']
        """
        from .faces import make_faces

        return make_faces(self)

    @cached_property
    def adjacency(self) -> scipy.sparse.csr_array:
        """The graph of the cells: a symmetric sparse array (n, n) with the area (2D: length) that two cells share.

        A cell that borders on its own periodic image has an entry on the diagonal.

        Examples
        --------
        >>> points = [(0.2, 0.3), (0.7, 0.2), (0.8, 0.8), (0.3, 0.7)]
        >>> graph = clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), points).adjacency
        >>> graph.nnz, graph.sum(axis=1).round(3).tolist()
        (10, [0.952, 0.997, 0.894, 1.123])
        """
        import scipy.sparse

        f, k = self.faces, self.faces.n_inner
        i, j, area = f.owner[:k], f.neighbor[:k], f.area[:k]
        both = np.concatenate([i, j]), np.concatenate([j, i])
        graph = scipy.sparse.coo_array((np.concatenate([area, area]), both), (len(self), len(self)))
        return graph.tocsr()

    @cached_property
    def cell_region(self) -> np.ndarray:
        """Region of each cell, (n,) int32: lines or surfaces inside divide the domain, and 0 is the largest region.

        All formats of files hold it, if the domain has borders inside: as cell data, or as zones of cells for OpenFOAM.
        """
        if self.domain.borders is None:
            return np.zeros(len(self), np.int32)
        return self.domain.borders.region_of_cells(self)

    @property
    def region_names(self) -> list[str]:
        """Names of the regions: those of closed surfaces inside that have one, else ``region-0``, ``region-1``, ..."""
        return ["region-0"] if self.domain.borders is None else self.domain.borders.region_names(self)

    @cached_property
    def border_faces(self) -> np.ndarray:
        """Rows of the `faces` that lie on lines or surfaces inside the domain, (k,) int, such as those of a fault."""
        return np.empty(0, np.int64) if self.domain.borders is None else self.domain.borders.faces_of(self)

    def cell(self, i: int) -> Cell:
        """Return one cell: generator, centroid, volume, neighbors, vertices and faces.

        Parameters
        ----------
        i : int
            Row of the cell; a negative one counts from the end.

        Returns
        -------
        Cell
            See `clvoro.mesh.lookup.Cell`.

        Raises
        ------
        InputError, InputTypeError
            If `i` is not an integer, or there is no such cell.

        Examples
        --------
        >>> d = clvoro.voronoi(clvoro.Box((0, 0, 0), (2, 1, 1)), [(0.5, 0.5, 0.5), (1.5, 0.5, 0.5)])
        >>> cell = d.cell(0)
        >>> cell.volume, len(cell.vertices), len(cell.faces), sorted(cell.neighbors.tolist())
        (1.0, 8, 6, [-6, -5, -4, -3, -1, 1])
        """
        from .lookup import make_cell

        return make_cell(self, i)

    def locate(self, points: ArrayLike) -> np.ndarray:
        """Return the cell that holds each of some points, in a box, a polygon or a solid, or on a sphere.

        A point on a face is in one of the cells that meet there.

        Parameters
        ----------
        points : (k, d) array of float
            In the domain's unit of length. In periodic directions any coordinate is inside.

        Returns
        -------
        (k,) int32
            Rows of cells; -1 for points outside of the domain.

        Raises
        ------
        InputError, InputTypeError
            If `points` is not an array of real numbers of this shape.

        Examples
        --------
        >>> d = clvoro.voronoi(clvoro.Box((0, 0), (2, 1)), [(0.5, 0.5), (1.5, 0.5)])
        >>> d.locate([(0.1, 0.9), (1.2, 0.5), (2.1, 0.5)]).tolist()
        [0, 1, -1]
        """
        return self._locator.find(points)

    @cached_property
    def _locator(self) -> Locator:
        from .lookup import Locator

        return Locator(self)

    def triangles(self) -> np.ndarray:
        """Return the dual triangulation in 2D or on a sphere: triples of generators whose cells meet in a vertex.

        They are the Delaunay triangles whose circumcenter lies in the domain. Where more than three cells meet, as in a
        square lattice, the polygon of their generators is divided into triangles.

        Returns
        -------
        (t, 3) int32
            Counter-clockwise, sorted by vertex.

        Raises
        ------
        InputError
            In 3D, and in periodic boxes, where corners of triangles may be images.
        """
        from .lookup import dual_triangles

        return dual_triangles(self)

    # Measures and checks.

    @cached_property
    def measures(self) -> Measures:
        """Quality, skewness, angles and ratios that matter to finite-volume methods; computed when first used."""
        from .quality import measure_mesh

        return measure_mesh(self)

    @overload
    def check(self, solver: None = None, *, walls: WallShape | None = None) -> Report: ...

    @overload
    def check(self, solver: Solver, *, walls: WallShape | None = None) -> SolverReport: ...

    def check(self, solver: Solver | None = None, *, walls: WallShape | None = None) -> Report | SolverReport:
        """Verify the diagram, in any domain, on the host: graph, faces, volumes, and the Voronoi property.

        Parameters
        ----------
        solver : {"openfoam", "mpas", "modflow"}, optional
            Check the mesh that a solver gets instead, by that solver's criteria. "openfoam": those of `checkMesh
            -allGeometry -allTopology` of OpenFOAM v1912, by its formulas, for the mesh that `save` writes. OpenFOAM
            need not be installed. "mpas", on a sphere and in the plane: what models on C grids need, such as vertices
            inside of their Delaunay triangles; see `Measures.c_grid`. "modflow", in the plane: what MODFLOW 6 needs of
            a DISV grid.
        walls : {"straight", "exact"}, optional
            With solvers "openfoam" and "modflow": as for `to_openfoam` and `to_disv`.

        Returns
        -------
        Report or SolverReport
            True if every property holds, or if the solver accepts the mesh. ``print`` it, or call its ``demand()``,
            which raises an error otherwise. A `SolverReport` lists each criterion with value, limit and worst place.

        Raises
        ------
        InputError
            If the solver or `walls` is something else, or `walls` is given without that solver, or the solver has no
            meshes of such a domain: "openfoam" on a sphere, "mpas" in 3D, "modflow" in 3D, on a sphere and in a
            periodic box.

        Examples
        --------
        >>> points = [(0.2, 0.3), (0.7, 0.2), (0.8, 0.8), (0.3, 0.7)]
        >>> report = clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), points).check(solver="openfoam")
        >>> report.ok, round(report["non-orthogonality"].value, 1), report["skewness"].limit
        (True, 9.6, 4)
        """
        if solver is None:
            if walls is not None:
                raise InputError(f"walls is {walls!r:.60}, and no solver; say which one: solver='openfoam'")
            from .check.mesh import check_diagram

            return check_diagram(self)
        from ..finite_volumes.gate import check_for_solver

        return check_for_solver(self, solver, walls)

    default_color = "quality"

    @cached_property
    def _shapes(self) -> np.ndarray:
        from .lookup import cell_shapes

        return cell_shapes(self)


def _rebuilt(domain: Domain, arrays: dict[str, np.ndarray]) -> Diagram:
    """Return an unpickled diagram."""
    for array in arrays.values():
        seal(array)
    return Diagram(domain, arrays)
