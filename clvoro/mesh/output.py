"""Files, pictures, other libraries and parts of meshes: the methods that `Diagram` and `Result` share."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, cast

import numpy as np

from ..arguments import warn
from ..errors import MismatchWarning

if TYPE_CHECKING:
    import meshio
    import pyvista
    from numpy.typing import ArrayLike

    from ..adapter import Adapter
    from ..finite_volumes.solver_mesh import WallShape
    from ..geometry.boundary_names import Walls
    from ..geometry.domain import Domain
    from ..geometry.surface import Surface
    from ..io.disv import Disv
    from ..io.fipy_mesh import VoronoiMesh2D, VoronoiMesh3D
    from ..io.foam import PatchType
    from ..plotting.colors import Color
    from ..plotting.pictures import View
    from .diagram import Diagram
    from .faces import Faces
    from .left_out import LeftOut
    from .results import Result


Mesh = TypeVar("Mesh", bound="MeshOutput")


class MeshOutput:
    """Base of `Diagram` and `Result`: save, plot, select and convert the cells."""

    default_color: ClassVar[Color] = "error"

    @property
    def _self(self) -> Result | Diagram:
        return cast("Result | Diagram", self)

    @property
    def _diagram(self) -> Diagram:
        raise NotImplementedError

    def subset(self: Mesh, keep: ArrayLike | Domain | Surface, boundary: str = "coast") -> Mesh:
        """Return the mesh without some of its cells, in a box, a polygon or a solid, or on a sphere.

        The cells that are left do not change. Their faces towards removed cells become faces on a boundary. So all
        faces are on bisectors, as models on C grids need it at coasts. The domain of the new mesh is a
        `clvoro.geometry.subdomain.Subdomain`, on a sphere a `clvoro.geometry.subdomain.SphereRegion`.
        `clvoro.earth` finds the cells of oceans and of limited areas on a sphere. Meshes for OpenFOAM of a part
        of a box in 3D keep their short edges.

        Parameters
        ----------
        keep : (n,) array of bool, domain or `clvoro.sizing.Surface`
            Which cells are left; they keep their order. A domain, such as a `clvoro.Polygon`, and a closed surface keep
            the cells that have their generators in it.
        boundary : str
            Name of the new boundary. A mesh that has a boundary already keeps the name of that one.

        Returns
        -------
        Diagram or Result
            That of a result has sizes, errors and quality of the cells that are left, as has the last row of its
            history. The same mesh if all cells are left.

        Raises
        ------
        InputError, InputTypeError
            If `keep` is not one bool per cell or has no True, or `boundary` is no word or another boundary's name;
            for power diagrams.

        Examples
        --------
        >>> earth = clvoro.Sphere()
        >>> globe = clvoro.voronoi(earth, earth.icosahedral_points(2))
        >>> north = globe.subset(earth.lonlat(globe.points)[:, 1] > 10, "open")
        >>> len(globe), len(north), north.domain.boundary_names
        (162, 65, ('open',))

        A lake on a C grid:

        >>> lake = clvoro.Polygon([(1, 1), (4, 0.8), (3, 2.5), (1.2, 3)])
        >>> points = np.random.default_rng(1).random((400, 2)) * 5
        >>> cells = clvoro.voronoi(clvoro.Box((0, 0), (5, 5)), points).subset(lake)
        >>> len(cells), cells.domain.boundary_names[-1]
        (64, 'coast')
        """
        from .subset import take_subset

        return cast("Mesh", take_subset(cast("Diagram", self), keep, boundary))

    def boundary_cells(self, boundary: Walls | None = None) -> np.ndarray:
        """Return the indices of the cells with a face on the boundary of any domain, (k,).

        They are ascending.

        Parameters
        ----------
        boundary : str, int or sequence of them, optional
            A part of it: names and numbers of edges or sides. By default all of it.

        Raises
        ------
        InputError, InputTypeError
            If there is no such boundary.

        Examples
        --------
        >>> box = clvoro.Box((0, 0), (1, 1), names={"inlet": "xMin"})
        >>> cells = clvoro.voronoi(box, [(0.8, 0.5), (0.5, 0.5), (0.2, 0.5)])
        >>> cells.boundary_cells("inlet").tolist()
        [2]
        """
        diagram = self._diagram
        walls = diagram.domain.boundaries.select("boundary", boundary)
        return np.unique(diagram.half_faces.owner[np.isin(-1 - diagram.neighbors, walls)])

    def save(
        self, path: str | PathLike[str], *, cell_data: Mapping[str, ArrayLike] | None = None, **others: object
    ) -> None:
        """Write the mesh to `path`; the suffix selects the format.

        The file of a diagram has no sizes, errors and history. Meshes in boxes, polygons and solids and on spheres are
        written in all formats, except that OpenFOAM has no meshes on spheres.

        ``.npz``
            Everything; `clvoro.load` reads it.
        ``.vtu``
            For ParaView and other VTK programs, and for `clvoro.load`; `to_vtu` has options.
        ``.pvtu``
            For ParaView: the cells of each rank of MPI in a ``.vtu`` file beside it. All ranks save together.
        ``.../constant/polyMesh`` or ``CASE/name.foam``
            A folder for OpenFOAM, alone or within a case that ParaView opens, too; `to_openfoam` has options. All ranks
            of MPI write together: rank 0 gathers the mesh and writes a decomposed case.
        ``.cgns``
            CGNS (HDF5): polyhedra as NGON_n and NFACE_n, boundaries by their names, and cell data; with h5py.
        ``.nc``
            Meshes in 2D and on spheres as netCDF by UGRID; `to_netcdf` has other conventions.
        ``.info``, ``.graph``
            The neighbors of each cell as a graph for METIS, which divides it among the ranks of a parallel run.
        ``.part.N``, as in ``graph.info.part.8``
            The rank of each cell, as METIS writes it and MPAS reads it: N ranks have equal numbers of cells, divided by
            planes. Over N ranks of MPI each has its own cells.
        ``.vtk``, ``.ply``, ``.obj``
            Meshes in 2D and on spheres, written by meshio (``pip install "clvoro[formats]"``); the latter two without
            cell data. Cells are sorted by their number of corners; in ``.vtk`` the cell data `label` is the row in the
            mesh.

        Parameters
        ----------
        path : str or path
        cell_data : mapping, optional
            Data of your own by name, (n,) or (n, k) arrays of real numbers: cell data in ``.vtu`` and ``.vtk``,
            variables in ``.nc``, members ``cell_data.<name>`` in ``.npz``, which `clvoro.load` leaves out. Other
            formats hold none.
        **others
            Refused: options of one format belong to its method, which the error names.

        Raises
        ------
        InputError, InputTypeError
            If the format is unknown or cannot hold the cells, an option is given, or the file cannot be written. An
            existing file is then unchanged.
        """
        from ..io import save

        # Not `_self`: `clvoro.io.save` may get an object that is no mesh, which it refuses.
        save(cast("Result | Diagram", self), path, cell_data=cell_data, **others)

    def to_openfoam(
        self,
        path: str | PathLike[str],
        *,
        patches: Mapping[str, Walls] | None = None,
        types: Mapping[str, PatchType] | None = None,
        thickness: float | None = None,
        binary: bool = False,
        walls: WallShape = "straight",
        zones: Mapping[str, ArrayLike] | None = None,
        check: bool = True,
        processors: int | ArrayLike | None = None,
    ) -> None:
        """Write the mesh in a box, a polygon or a solid for OpenFOAM.

        In 2D it is one layer of prisms between patches of type `empty`. Each periodic direction is one pair of cyclic
        patches; with several of them, these are for OpenFOAM of openfoam.com.

        Parameters
        ----------
        path : str or path
            The folder ``.../constant/polyMesh``, or a file ``CASE/name.foam``, which ParaView opens.
        patches : mapping, optional
            Names of patches, each with its walls: numbers, names of the domain, or a sequence of them. Walls that are
            not mentioned keep the name that the domain gives them.
        types : mapping, optional
            Type of each patch by name: "wall", "patch", "symmetry" or "symmetryPlane", as in
            ``types={"top": "symmetry"}``. By default "patch" where the name says that the boundary is open, such as
            inlet, outlet, far-field or open, and "wall" elsewhere.
        thickness : float, optional
            For a mesh in 2D: height of the layer of prisms. By default the mean width of a cell.
        binary : bool
            Write numbers as bytes (labels of 32 bits, scalars of 64), which is faster and takes less space.
        walls : {"straight", "exact"}
            With "straight" the cells are those of `solver_mesh`: convex, with straight faces on the boundary and
            without short edges. Solvers reject cells that are not convex. With "exact" all faces are those of the
            diagram.
        zones : mapping, optional
            Zones of cells by name, each with one bool per cell, as ``{"pipe": surface.contains(mesh.points)}``:
            sources, porous media, parts that rotate. If the domain has lines, the parts between them are the zones
            ``region-0``, ``region-1``, ..., and the faces on them the zone of faces ``lines``.
        check : bool
            Refuse a mesh that OpenFOAM's checkMesh rejects. With False it is written all the same.
        processors : int or (n,) array of int, optional
            Write a decomposed case, too, for parallel runs of OpenFOAM: its folders ``processor0``, ``processor1``, ...
            have the meshes that `decomposePar` would make, and `reconstructPar` puts fields together again. The number
            of processors, or the processor of each cell from 0 on. Parts have equal numbers of cells, divided
            by planes across their longest extent. Over the ranks of MPI the default is one processor for each rank,
            with its cells.

        Raises
        ------
        InputError, InputTypeError
            On a sphere, for a cell around an island, if an argument is wrong or the files cannot be written; if
            OpenFOAM rejects the mesh: names the criteria, the worst place and the remedy.
        """
        from ..io import write

        options = {"patches": patches, "types": types, "thickness": thickness, "binary": binary, "walls": walls}
        options |= {"zones": zones, "check": check, "processors": processors}
        write(self._self, path, kind=".foam", **options)

    def to_netcdf(
        self,
        path: str | PathLike[str],
        *,
        convention: Literal["ugrid", "mpas", "scrip"] = "ugrid",
        units: str = "m",
        cell_data: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Write the mesh in 2D, in a box or a polygon, or on a sphere as netCDF.

        It is for models of oceans and atmospheres, QGIS, ParaView and xarray.

        Parameters
        ----------
        path : str or path
            A file ``.nc``.
        convention : {"ugrid", "mpas", "scrip"}
            With "ugrid": cells as polygons with size, error, quality and area, and for each edge the number of its wall
            and its boundary; at seams as in ``.vtu``. With "mpas": cells, edges and vertices with all variables of the
            MPAS mesh specification for C grids; cells at seams are connected. On a sphere UGRID has longitudes and
            latitudes in degrees; MPAS has positions, and both in radians. With "scrip", on spheres only: centers,
            corners and areas, for tools that remap data between grids.
        units : str
            Unit of the coordinates, as UDUNITS writes it. In UGRID, "degrees" stands for longitudes and latitudes. On a
            sphere: unit of the radius.
        cell_data : mapping, optional
            As for `save`.

        Raises
        ------
        InputError, InputTypeError
            In 3D, if an argument is wrong or the file cannot be written. An existing file is then unchanged.
        """
        from ..io import write

        write(self._self, path, cell_data, ".nc", convention=convention, units=units)

    def to_vtu(
        self, path: str | PathLike[str], *, walls: WallShape = "exact", cell_data: Mapping[str, ArrayLike] | None = None
    ) -> None:
        """Write the mesh in a box, a polygon or a solid, or on a sphere for ParaView and other VTK programs.

        Cells are polygons or polyhedra with size, error, quality, boundary and more as cell data; row i is cell i of
        the mesh. VTK's `vtkCellSizeFilter` (PyVista's `compute_cell_sizes`) is wrong for cells that are not convex, as
        there are along the boundary of a polygon: use the cell data `volume`. meshio 5.3 reads a mesh in 2D as one
        block of cells for each run of cells with equally many corners; a ``.vtk`` file has one block for each number of
        corners. In 3D it refuses most files, as its reader assigns cell data to the wrong blocks of polyhedra.

        Parameters
        ----------
        path : str or path
            A file ``.vtu``.
        walls : {"straight", "exact"}
            With "straight" the cells are those of `solver_mesh`, which `clvoro.load` does not read. With "exact" all
            faces are those of the diagram.
        cell_data : mapping, optional
            As for `save`.

        Raises
        ------
        InputError, InputTypeError
            If an argument is wrong or the file cannot be written. An existing file is then unchanged.
        """
        from ..io import write

        write(self._self, path, cell_data, ".vtu", walls=walls)

    def solver_mesh(self, walls: WallShape = "straight", collapse: bool = True) -> Faces:
        """Return the mesh as a finite-volume solver sees it: points, and each face with corners, owner and neighbor.

        The mesh is in a box, also a periodic one, in a polygon or in a solid.

        Solvers reject or mistrust cells that are not convex, and faces that are much smaller than their cells. The
        diagram itself has such cells where the boundary has corners or is finer than the mesh. With `collapse` the
        diagram keeps the mesh, so that `check` and `save` do not make it again.

        Parameters
        ----------
        walls : {"straight", "exact"}
            With "straight", in a polygon: each cell is convex. It has one straight face where it meets the boundary, or
            several with the convex corners of the domain and the ends of its named parts between them. Re-entrant
            corners within a cell are cut off. What is smaller than a cell is left out. The change of area is the mesh's
            `area_change`.
        collapse : bool
            Whether the ends of short faces become one point: in 2D of faces shorter than 0.055 times the size of
            the smaller cell and 0.2 times the width of the thinner one, while cells remain convex. Corners and ends
            of names stay in place. In 3D edges shorter than 0.02 h and faces smaller than 0.001 h^2 are collapsed,
            with h the cube root of the smaller cell's volume; so are faces smaller than 0.02 h^2 whose skewness
            exceeds 1.8. Faces may then be
            slightly warped: their flatness is at least 0.95. Points on the box stay on it, so that the cells still fill
            it. What would make a cell concave is left as it is.

        Returns
        -------
        Faces
            See `clvoro.mesh.faces.Faces`. Its `measures` are those of OpenFOAM's `checkMesh`.

        Raises
        ------
        InputError
            If `walls` is something else, or the diagram is on a sphere.

        Warns
        -----
        MismatchWarning
            If straight walls change the area by more than 1 % of the domain, or leave out parts as large as half a
            cell; says where.

        Examples
        --------
        >>> points = [(0.2, 0.3), (0.7, 0.2), (0.8, 0.8), (0.3, 0.7)]
        >>> mesh = clvoro.voronoi(clvoro.Box((0, 0), (1, 1)), points).solver_mesh()
        >>> mesh, mesh.measures.non_orthogonality.max().round(1)
        (Faces(4 cells, 13 faces), np.float64(9.6))
        """
        from ..finite_volumes.solver_mesh import make_solver_mesh

        return make_solver_mesh(self._diagram, walls, collapse)

    @property
    def left_out(self) -> LeftOut:
        """What the mesh for solvers leaves out of a polygon or solid, or adds: measures and places of the parts.

        They are bays, dead ends and islands, fins and cavities that cells are too large for. It makes the mesh; see
        `solver_mesh`. Volumes of parts of solids are counted, to about 0.01 of a cell.

        Examples
        --------
        >>> sea = clvoro.Polygon([(0, 0), (4, 0), (4, 4), (0, 4)], [[(2, 2), (2.1, 2), (2, 2.1)]])
        >>> left = clvoro.adapt(sea, 0.7, "fast").left_out
        >>> left.measures.round(3), np.abs(left.places - 2.03).max() < 0.03
        (array([-0.005]), np.True_)
        """
        return self.solver_mesh().left_out

    def transfer(
        self,
        values: ArrayLike,
        onto: Result | Diagram,
        order: int = 1,
        *,
        limited: bool = True,
        covered: bool = False,
        adapter: Adapter | None = None,
    ) -> Any:
        """Transfer cell data to another mesh, conservatively.

        Both meshes have one domain, or domains that overlap: a globe and its ocean, a box and a lake in it. A new cell
        that this mesh covers in part gets the mean over that part.

        A new cell gets the mean over its intersections with the old cells. With `order` 1 a value is constant in an old
        cell. With `order` 2 it is a linear function about the centroid. Its slope fits the values of the neighbors by
        least squares, and is limited by Barth and Jespersen (AIAA 89-0366, 1989): at no corner of the cell does the
        function exceed the values of cell and neighbors. On a sphere cells are intersected along great circles, and the
        function is linear in the position.

        Parameters
        ----------
        values : (n,) or (n, k) array of real numbers
            Means over the cells of this mesh, in the order of its points.
        onto : Result or Diagram
            The new mesh.
        order : 1 or 2
        limited : bool
            Whether slopes are limited. Without limits linear functions are exact up to round-off, at walls and extrema,
            too, where a cell has d neighbors in different directions, but new values may exceed the old ones. On a
            sphere they are then exact to the second order.
        covered : bool
            Whether to return the covered share of each new cell, too.
        adapter : Adapter, optional
            The adapter whose device does the work; by default that of `create_context()`. In float64 where the device
            has it.

        Returns
        -------
        (n_new,) or (n_new, k) float64
            The mass, the sum of volume times value, is kept to 1e-12 of that of the absolute values. Every new value
            lies between the least and the largest old value nearby (unless `limited` is False). A correction in
            proportion to the distance from these bounds compensates the round-off of the mass. Between float32 meshes
            the bounds take precedence: the mass of a constant differs as the sums of the volumes do. Between different
            domains the mass in their common part is kept. Where this mesh covers nothing, the value is NaN.
        (n_new,) float64
            With `covered`, the share of each new cell that this mesh covers, from 0 to 1. Between meshes of one domain
            it is 1. At the walls of a solid cells end at their own faces, and the share is that of their overlap
            (0.97 to 1 in a ball of 500 to 8000 cells, ``bench/transfer.py --on ball``); the mass is kept all the same,
            and a new cell that overlaps none has the value of the nearest old one.

        Raises
        ------
        InputError, InputTypeError
            If the meshes are in different spaces or have different periods, one has cells that a surface cuts in 3D,
            `values` has another shape or is not finite, or `order` is neither 1 nor 2.
        ClvoroError
            If one of the meshes is not the Voronoi diagram of its points.

        Warns
        -----
        MismatchWarning
            If new cells are not covered, and `covered` is False; says how many.

        Examples
        --------
        >>> box = clvoro.voronoi(clvoro.Box((0, 0), (2, 1)), [(0.5, 0.5), (1.5, 0.5)])
        >>> shore = clvoro.Polygon([(0.5, 0.2), (2.5, 0.2), (2.5, 0.8), (0.5, 0.8)])
        >>> lake = clvoro.voronoi(shore, [(1, 0.5), (2, 0.5)])
        >>> values, share = box.transfer([1.0, 3.0], lake, covered=True)
        >>> values.round(3).tolist(), share.round(3).tolist()
        ([2.0, 3.0], [1.0, 0.5])
        """
        from ..remapping.cell_data import transfer_values

        found, share, missing = transfer_values(self._diagram, values, onto, order, limited, adapter)
        if covered:
            return found, share
        if missing:
            warn(
                f"{missing} of {len(share)} new cells are not covered by this mesh, or only in part, and have the "
                "means over the covered parts, or NaN; pass covered=True for their covered shares",
                MismatchWarning,
            )
        return found

    def plot(self, color: Color | ArrayLike | None = None, view: View | None = None, **options: Any) -> Any:
        """Draw the cells with Matplotlib.

        Parameters
        ----------
        color : str or (n,) array of real numbers, optional
            "quality", "sides", "skewness", "volume", for a result also "error" and "size", or data of your own. By
            default "error" for a result, "quality" for a diagram.
        view : {"cells", "globe", "slices", "slice", "cutaway"}, optional
            A mesh in the plane has "cells", one on a sphere "globe". One in 3D has "slices" (the default; planes along
            the axes and a cut-away view), "slice" and "cutaway".
        **options
            Those of the view, with their defaults:

            ============  ======================================  ==========================================
            view          function                                options
            ============  ======================================  ==========================================
            ``cells``     `clvoro.plotting.plot_cells`            ax, window, edges, key
            ``globe``     `clvoro.plotting.plot_globe`            ax, projection, center, across, window,
                                                                  coasts, edges, key
            ``slices``    `clvoro.plotting.plot_slices`           through
            ``slice``     `clvoro.plotting.plot_slice`            ax, normal, through, window, edges, key
            ``cutaway``   `clvoro.plotting.plot_cutaway`          ax, cut, through, angles, edges, key
            ============  ======================================  ==========================================

            All have `label` (text at the color bar), `limits` (ends of the color scale) and `title`.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        InputError, InputTypeError
            If a color does not exist, or the mesh has no such view, or the view no such option.
        ClvoroError
            If Matplotlib is not installed; for a mesh in 3D PyVista; for one on a sphere Cartopy.
        """
        from ..plotting import plot_mesh

        return plot_mesh(self._self, self.default_color if color is None else color, view, **options)

    def to_shapely(self) -> np.ndarray:
        """Return the cells in 2D, in a box or a polygon, as polygons of shapely.

        Returns
        -------
        (n,) array of shapely.Polygon
            Around the generators; in a periodic box the polygons are not cut at the seams. A cell around an island has
            a hole. A cell may also be a MultiPolygon where it touches itself.

        Raises
        ------
        InputError
            In 3D, and on a sphere.

        Examples
        --------
        >>> d = clvoro.voronoi(clvoro.Box((0, 0), (2, 1)), [(0.5, 0.5), (1.5, 0.5)])
        >>> [cell.bounds for cell in d.to_shapely()]
        [(0.0, 0.0, 1.0, 1.0), (1.0, 0.0, 2.0, 1.0)]
        """
        self._diagram.domain.require_plane("shapely has polygons in the plane", "use to_pyvista() or to_meshio()")
        return self._diagram._shapes.copy()

    def to_pyvista(
        self, cell_data: Mapping[str, ArrayLike] | None = None, cut: bool = False
    ) -> pyvista.UnstructuredGrid:
        """Return the cells in a box, a polygon or a solid, or on a sphere as an unstructured grid of PyVista.

        Parameters
        ----------
        cell_data : mapping, optional
            As for `save`.
        cut : bool
            Cut cells at the sides of a periodic box, for viewing: their images fill it, and "label" says of which
            cell each part is. By default cells lie whole around their generators, partly outside of the box.

        Returns
        -------
        pyvista.UnstructuredGrid
            Polygons or polyhedra in the order of the generators, with the cell data of a ``.vtu`` file,
            for a result sizes included.

        Raises
        ------
        ClvoroError
            If PyVista is not installed (``pip install "clvoro[pyvista]"``).
        InputError, InputTypeError
            If `cell_data` does not fit the cells.
        """
        from ..io.contents import Contents
        from ..io.convert import to_pyvista

        return to_pyvista(Contents.of(self, cell_data), cut)

    def to_meshio(self, cell_data: Mapping[str, ArrayLike] | None = None) -> meshio.Mesh:
        """Return the cells in a box, a polygon or a solid, or on a sphere as a mesh of meshio.

        Parameters
        ----------
        cell_data : mapping, optional
            As for `save`.

        Returns
        -------
        meshio.Mesh
            One block of cells for each number of corners; the cell data `label` is the row of a cell in this mesh. The
            other cell data are those of a ``.vtu`` file.

        Raises
        ------
        ClvoroError
            If meshio is not installed (``pip install "clvoro[formats]"``).
        InputError, InputTypeError
            As for `to_pyvista`.
        """
        from ..io.contents import Contents
        from ..io.convert import to_meshio

        return to_meshio(Contents.of(self, cell_data))

    def to_disv(self, walls: WallShape = "straight") -> Disv:
        """Return the cells in a box or a polygon in 2D as a grid for MODFLOW 6's DISV package, as FloPy takes it.

        The cell centers are the generators: control-volume finite differences need the line between two centers
        perpendicular to the face, and that is the Voronoi property. FloPy is not needed here.

        Parameters
        ----------
        walls : {"straight", "exact"}
            See `solver_mesh`.

        Returns
        -------
        Disv
            ``ModflowGwfdisv(model, nlay=1, top=top, botm=bottom, **disv.gridprops)`` makes the package.
            ``disv.boundaries["river"]`` has the cells at that boundary, and lengths and distances of their faces.

        Raises
        ------
        InputError
            In 3D, on a sphere, in a periodic box, and for a cell around an island.

        Examples
        --------
        >>> basin = clvoro.Box((0, 0), (2, 1), names={"river": "xMax"})
        >>> disv = clvoro.voronoi(basin, [(0.5, 0.5), (1.5, 0.5)]).to_disv()
        >>> disv.gridprops["cell2d"]
        [(0, 0.5, 0.5, 4, 0, 3, 2, 1), (1, 1.5, 0.5, 4, 0, 4, 5, 3)]
        >>> river = disv.boundaries["river"]
        >>> river.cells.tolist(), river.conductance(0.01).tolist()
        ([1], [0.02])
        """
        from ..io.disv import make_disv

        return make_disv(self._diagram, walls)

    def to_fipy(self, walls: WallShape = "straight") -> VoronoiMesh2D | VoronoiMesh3D:
        """Return the cells in a box, also a periodic one, in a polygon or in a solid as a mesh of FiPy.

        The cell centers are the generators. The center of a face is where the line between two generators crosses it,
        on walls the foot of the generator's perpendicular. There FiPy's two-point flux has no error of first order.
        Cells on both sides of a periodic seam are neighbors; FiPy's viewers draw them across the box.

        Parameters
        ----------
        walls : {"straight", "exact"}
            See `solver_mesh`.

        Returns
        -------
        fipy.meshes.mesh2D.Mesh2D or fipy.meshes.mesh.Mesh
            In the order of the generators. ``mesh.physicalFaces["inlet"]`` marks the faces of a boundary, for
            ``variable.constrain(value, mesh.physicalFaces["inlet"])``.

        Raises
        ------
        ClvoroError
            If FiPy is not installed (``pip install "clvoro[solvers]"``).
        InputError
            On a sphere, for a cell that borders on its own periodic image, and in 2D for a cell around an island.
        """
        from ..io.convert import to_fipy

        return to_fipy(self._diagram, walls)
