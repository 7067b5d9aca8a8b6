"""Pictures of 3D meshes: planes through them, and views into them, by the filters of PyVista (extra `pyvista`).

PyVista cuts the cells, and Matplotlib draws the polygons, so that no graphics driver is needed. The views are parallel
projections. Along any line of sight the cells of a Voronoi diagram follow each other in the order of their generators:
drawn in that order, each covers those behind it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.patches import Patch
from numpy.typing import ArrayLike

from ..arguments import format_point
from ..connectivity import following, starts_of, take_rows
from ..errors import InputError
from ..geometry.domain import Domain, images_in
from ..io.convert import cut_at_sides, missing
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.results import Result
from .cells import draw_polygons, edge_widths
from .colors import Color, Paint, paint_of, picture_of
from .legends import add_key, finished
from .style import METHOD_COLORS, WIDTH, corners_of, frame_domain, interactive_figure, nice, styled

if TYPE_CHECKING:
    import pyvista

VIEW = (-60.0, 26.0)
"""Azimuth and elevation of the viewer, degrees: x-max, y-min and z-max walls are in front."""
_AXES = {"x": 0, "y": 1, "z": 2}
_VTK_POLYHEDRON = 42
_IN_CUT = 0.7
"""Brightness of faces in the cut, over that of faces on walls and sides of the box."""
_IN_BOX, _NAMES = 0.5, 10
"""Least share of the sides of its bounding box that are walls of a space in a box; names of boundaries in a picture."""
_FEW_ACROSS = 1.8
"""Cells across a domain below which a removed octant has all of them: those left would stand alone."""


def plot_slice(
    mesh: Result | Diagram,
    color: Color | ArrayLike = "error",
    ax: Any = None,
    *,
    normal: str | ArrayLike = "z",
    through: ArrayLike | None = None,
    label: str | None = None,
    limits: tuple[float, float] | None = None,
    window: tuple[ArrayLike, ArrayLike] | None = None,
    edges: bool = True,
    key: bool = True,
    title: str | None = None,
) -> Any:
    """Draw the cross-sections of the cells of a 3D mesh in a plane.

    Parameters
    ----------
    mesh : Result or Diagram
        In a box, periodic or not.
    color : {"error", "quality", "size", "sides", "skewness", "volume"} or (n,) array of real numbers
        As for `plot_cells`.
    ax : matplotlib axes, optional
        Drawn into; a new figure by default.
    normal : {"x", "y", "z"} or 3 floats
        Direction at right angles to the plane.
    through : 3 floats, optional
        A point of the plane; by default among the smallest cells.
    label, limits, edges, key, title
        As for `plot_cells`.
    window : (lower, upper), optional
        Corners (2 floats each) of the part to show, in the picture's coordinates.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        For a 2D mesh, an unknown color, or a plane outside of the domain.
    MissingLibraryError
        If PyVista is not installed (``pip install "clvoro[pyvista]"``).
    """
    result = picture_of(mesh)
    diagram = result.diagram
    require_space(diagram)
    paint, direction, point = paint_of(result, color, label, limits), as_normal(normal), _point(result, through)
    cells, polygons = cut_cells(diagram, direction, point)
    if not len(cells):
        place = format_point(point)
        raise InputError(f"the plane through {place} does not intersect {diagram.domain}; give a point inside")
    axis = int(np.argmax(np.abs(direction)))
    aligned = bool(abs(direction[axis]) > 1 - 1e-9)
    right, up = plane_axes(direction)
    flat = [polygon @ np.stack([right, up], axis=1) for polygon in polygons]
    # An oblique plane is shown as far as it cuts the box.
    ends = np.array([diagram.domain.lower, diagram.domain.upper])
    shown = np.stack([ends @ right, ends @ up], axis=1) if aligned else np.concatenate(flat)
    lower, upper = (shown.min(axis=0), shown.max(axis=0)) if window is None else corners_of(window)
    with styled():
        if ax is None:
            ax = interactive_figure(WIDTH, _slice_height(upper - lower)).add_subplot()
        frame_domain(ax, lower, upper)
        draw_polygons(ax, cells, flat, paint, edge_widths(ax, flat) if edges else np.zeros(len(flat)))
        if aligned:
            ax.set(xlabel="xyz"[int(np.argmax(right))], ylabel="xyz"[int(np.argmax(up))])
        elif window is None:
            ax.set_axis_off()
        if title is None:
            x = ", ".join(f"{value:.3g}" for value in point)
            n = ", ".join(f"{value:.2g}" for value in direction)
            title = f"${'xyz'[axis]} = {point[axis]:.3g}$" if aligned else f"plane through ({x}), normal ({n})"
        return finished(ax, paint, key, title)


def plot_slices(
    mesh: Result | Diagram,
    color: Color | ArrayLike = "error",
    figure: Any = None,
    *,
    through: ArrayLike | None = None,
    label: str | None = None,
    limits: tuple[float, float] | None = None,
    title: str | None = None,
) -> Any:
    """Draw a 3D mesh on planes along the axes, all to one scale, with a cut-away view beside them.

    For a long domain: the two planes along it.

    Parameters
    ----------
    mesh, color, label, through, limits, title
        As for `plot_slice`.
    figure : matplotlib figure, optional
        An empty one to draw into, of `slices_height`.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError, MissingLibraryError
        As for `plot_slice`.
    """
    result = picture_of(mesh)
    diagram = result.diagram
    require_space(diagram)
    paint, point = paint_of(result, color, label, limits), _point(result, through)
    normals, columns, widths, heights = _panels(diagram)
    with styled():
        if figure is None:
            figure = interactive_figure(WIDTH, slices_height(diagram))
        axes = figure.subplots(len(heights), columns, width_ratios=widths, height_ratios=heights, squeeze=False).ravel()
        for ax, normal in zip(axes, normals, strict=False):
            plot_slice(result, color, ax, normal=normal, through=point, limits=paint.limits, key=False)
            ax.locator_params(nbins=5)
        if len(normals) < len(axes):
            _draw_cutaway(axes[-1], diagram, paint, "octant", _corner(result, through, VIEW), VIEW)
        if title is not None:
            figure.suptitle(title, fontsize=10)
        add_key(axes, paint, below=True)
    return figure


def plot_cutaway(
    mesh: Result | Diagram,
    color: Color | ArrayLike = "error",
    ax: Any = None,
    *,
    cut: str | ArrayLike | None = "octant",
    through: ArrayLike | None = None,
    angles: tuple[float, float] = VIEW,
    label: str | None = None,
    limits: tuple[float, float] | None = None,
    edges: bool = True,
    walls: bool = False,
    key: bool = True,
    title: str | None = None,
) -> Any:
    """Draw a 3D mesh with part of its cells removed, in parallel projection.

    Parameters
    ----------
    mesh : Result or Diagram
        In a box. Where it is periodic, cells and their images end at its sides.
    color : {"error", "quality", "size", "sides", "skewness", "volume"} or (n,) array of real numbers
    ax : matplotlib axes, optional
        Two-dimensional ones to draw into; a new figure by default.
    cut : "octant", "x", "y", "z", 3 floats, (n,) bool or None
        The removed part: the cells with generators between the point and the viewer, in all three directions;
        those in front of a plane with this normal, on the viewer's side for "x", "y" and "z"; those that are not
        marked as kept; or nothing. Faces in the cut are darker than those on walls and sides of the box. The walls
        of a body are shown where cells are removed around it, with a color for each boundary.
    through : 3 floats, optional
        The point; by default among the smallest cells, or behind all that are in a thin plate.
    angles : (azimuth, elevation), degrees
        Direction of the viewer.
    walls : bool
        Give faces on walls a color for each wall: for each side of a box, and for each smooth patch of a solid.
    label, limits, edges, key, title
        As for `plot_cells`.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        For a 2D mesh, an unknown color or cut.
    MissingLibraryError
        If PyVista is not installed (``pip install "clvoro[pyvista]"``).
    """
    result = picture_of(mesh)
    require_space(result.diagram)
    paint = paint_of(result, color, label, limits)
    with styled():
        if ax is None:
            ax = interactive_figure(WIDTH, cutaway_height(result, angles)).add_subplot()
        _draw_cutaway(ax, result.diagram, paint, cut, _corner(result, through, angles), angles, edges, walls)
        _label_axes(ax, result.diagram, *view_axes(angles))
        return finished(ax, paint, key, title)


def cutaway_height(result: Result, angles: tuple[float, float] = VIEW) -> float:
    """Height in inches that suits `plot_cutaway`."""
    right, up, _ = view_axes(angles)
    width, height = (np.abs(axis) @ result.diagram.domain.extent for axis in (right, up))
    return min(float((WIDTH - 0.9) * height / width), 1.1 * WIDTH) + 0.4


def slices_height(diagram: Diagram) -> float:
    """Height in inches that suits `plot_slices`."""
    _, columns, widths, heights = _panels(diagram)
    height = (WIDTH - 0.55 * columns) * sum(heights) / sum(widths)
    return min(height, 1.6 * WIDTH) + 0.52 * len(heights) + 0.65


def require_pyvista() -> Any:
    """Return the module PyVista, or raise MissingLibraryError."""
    try:
        import pyvista
    except ModuleNotFoundError as error:
        raise missing("PyVista", "pyvista", "a picture of a 3D mesh") from error
    return pyvista


def require_space(diagram: Diagram) -> None:
    """Raise InputError unless the diagram is three-dimensional."""
    if diagram.domain.cell_dim != 3:
        raise InputError("slices and cut-away views need cells in 3D, and these are in 2D; call result.plot()")


def focus(result: Result) -> np.ndarray:
    """Return the point that pictures of a 3D mesh show: among its smallest cells, well inside the domain.

    The planes through it along the axes intersect cells, also where the domain has several pieces.
    """
    box = result.diagram.domain
    smallest = result.points[result.target_size <= 1.1 * result.target_size.min()]
    lower, extent = np.array(box.lower), box.extent
    center = lower + 0.5 * extent
    if len(smallest) <= 0.5 * len(result.points):  # not a uniform mesh
        # A round number for the titles; half a cell makes no difference.
        step = nice(0.5 * float(result.target_size.min()), up=False)
        center = np.round(smallest.mean(axis=0) / step) * step + 0.0
        center = np.clip(center, lower + 0.25 * extent, lower + 0.75 * extent)
    d = result.diagram
    corners, starts = d.vertices[d.face_vertices], d.face_vertex_starts[:-1]
    met = (np.minimum.reduceat(corners, starts) < center) & (center < np.maximum.reduceat(corners, starts))
    nearest = np.abs(d.centroids - center).argmin(axis=0)
    return np.where(met.any(axis=0), center, d.centroids[nearest, np.arange(3)])


def as_normal(normal: str | ArrayLike) -> np.ndarray:
    """Return a unit vector from "x", "y", "z" or three numbers, or raise InputError."""
    if isinstance(normal, str) and normal in _AXES:
        return np.eye(3)[_AXES[normal]]
    try:
        vector = np.asarray(normal, float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
        raise InputError(f"normal is {normal!r}, expected 'x', 'y', 'z' or three numbers not all 0")
    return vector / np.linalg.norm(vector)


def plane_axes(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors in the plane, to the right and up; along axes: x or y to the right, z or y up."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    if abs(normal[2]) < 1 - 1e-9:
        up = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
        up /= np.linalg.norm(up)
        right = np.cross(up, normal)
        # Seen from the side with increasing coordinates to the right.
        return (right if right[np.argmax(np.abs(right))] > 0 else -right), up
    return np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])


def view_axes(angles: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the picture's unit vectors: to the right, up, and towards the viewer."""
    azimuth, elevation = (math.radians(angle) for angle in angles)
    towards = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    return right, np.cross(towards, right), towards


def brightness(normals: np.ndarray, angles: tuple[float, float]) -> np.ndarray:
    """Return the brightness (n,) of faces with `normals` (n, 3), in light from above, a little from the left."""
    right, up, towards = view_axes(angles)
    light = 0.5 * towards + 0.62 * up - 0.3 * right
    return 0.72 + 0.28 * np.clip(normals @ light / np.linalg.norm(light), 0, 1)


def cut_cells(diagram: Diagram, normal: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the cells (k,) that a plane cuts, and the polygons (c, 3) in which it does.

    A face of the mesh that lies in the plane belongs to one of its cells. In a periodic box the images of cells that
    reach into the box are cut, too; polygons end at its sides.
    """
    low, high = _bounds(diagram, (diagram.vertices - point) @ normal)
    grid = _polyhedra(diagram, lambda rows, by: (low[rows] <= -by @ normal) & (high[rows] >= -by @ normal))
    section = grid.slice(normal=normal, origin=point, generate_triangles=False)
    return (section.cell_data["cell"], _polygons(section)) if section.n_cells else (np.zeros(0, int), [])


def _bounds(diagram: Diagram, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each cell the lowest and the highest of the `values` of its vertices."""
    starts, corners = diagram.half_faces.corners
    starts, corners = np.minimum(starts[diagram.neighbor_starts[:-1]], len(corners) - 1), values[corners]
    return np.minimum.reduceat(corners, starts, axis=0), np.maximum.reduceat(corners, starts, axis=0)


def _polyhedra(diagram: Diagram, chosen: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> pyvista.UnstructuredGrid:
    """Return cells as polyhedra. Where the box is periodic they end at its sides, and their images fill it.

    They are those for which `chosen` is true, given the rows (k,) and the offset (3,) of an image. The cell data "cell"
    are their rows, "generator" the positions of their generators or of images of these.
    """
    pyvista, domain = require_pyvista(), diagram.domain
    faces = diagram.half_faces.corners
    box = np.array([domain.lower, domain.upper])
    parts, images = [], [(np.arange(len(diagram)), np.zeros(3))]
    if any(domain.periodic):
        images = images_in(domain, *_bounds(diagram, diagram.vertices), box)
    for rows, by in images:
        rows = rows[chosen(rows, by)]
        if not len(rows):
            continue
        # The items of a cell: their number, that of its faces, and for each face that of its corners and the corners.
        first, half_faces = take_rows(diagram.neighbor_starts, np.arange(len(faces[0]) - 1), rows)
        starts, corners = take_rows(*faces, half_faces)
        shown = np.diff(starts) > 0
        counts = np.diff(starts_of(shown)[first])
        ends = starts_of(np.diff(starts) + shown)[first]
        stream = np.insert(corners.astype(np.int64), starts[:-1][shown], np.diff(starts)[shown])
        heads = np.column_stack([np.diff(ends) + 1, counts]).ravel()
        cells = np.insert(stream, np.repeat(ends[:-1], 2), heads)
        grid = pyvista.UnstructuredGrid(cells, np.full(len(rows), _VTK_POLYHEDRON, np.uint8), diagram.vertices + by)
        grid.cell_data.update({"cell": rows, "generator": diagram.points[rows] + by})
        parts.append(grid)
    return cut_at_sides(parts, domain)


def _polygons(surface: pyvista.PolyData) -> list[np.ndarray]:
    """Return the corners (c, 3) of each polygon of a surface, counter-clockwise as seen from outside."""
    pyvista, polygons = require_pyvista(), surface.GetPolys()
    starts, corners = map(pyvista.convert_array, (polygons.GetOffsetsArray(), polygons.GetConnectivityArray()))
    return np.split(np.asarray(surface.points)[corners], starts[1:-1])


def kept_cells(cut: Any, through: np.ndarray, towards: np.ndarray, rows: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return which of the cells `rows` (k,), with generators at `places` (k, 3), stay, (k,) bool.

    `cut` is "octant", a vector, None, or marks of the cells.
    """
    if cut is None:
        return np.ones(len(rows), bool)
    if isinstance(cut, str):  # remove the corner between the point and the viewer
        return ~np.all((places - through) * np.where(towards >= 0, 1, -1) > 0, axis=1)
    return cut[rows] if cut.dtype == bool else (places - through) @ cut <= 0


def visible_faces(
    diagram: Diagram, cut: Any, through: np.ndarray, towards: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Return the faces of the kept cells that face the viewer, the farthest first.

    Results:
    - `cells` (f,) int: the cell of each face.
    - `polygons`: list of (c, 3) float
    - `normals`: (f, 3) float
    """
    domain, neighbor = diagram.domain, np.maximum(diagram.neighbors, 0)
    low, high = _bounds(diagram, diagram.vertices) if any(domain.periodic) else (diagram.points, diagram.points)

    def bare(rows: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Return which cells stay and have a face that is seen, or a part beyond a seam."""
        stays = kept_cells(cut, through, towards, rows, diagram.points[rows] + by)
        images = diagram.points[neighbor] + diagram.shifts * domain.extent + by
        seen = (diagram.neighbors < 0) | ~kept_cells(cut, through, towards, neighbor, images)
        seen = np.logical_or.reduceat(seen, diagram.neighbor_starts[:-1])[rows]
        return stays & (seen | ((low[rows] + by < domain.lower) | (high[rows] + by > domain.upper)).any(axis=1))

    surface = _polyhedra(diagram, bare).extract_surface(algorithm="geometry")
    if not surface.n_cells:
        return np.zeros(0, int), [], np.zeros((0, 3))
    polygons = _polygons(surface)
    starts = starts_of([len(p) for p in polygons])
    arms = np.concatenate([p - p[0] for p in polygons])
    normals = np.add.reduceat(np.cross(arms, arms[following(starts)]), starts[:-1], axis=0)
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    facing = np.flatnonzero(normals @ towards > 1e-9)
    order = facing[np.argsort((surface.cell_data["generator"] @ towards)[facing], kind="stable")]
    return surface.cell_data["cell"][order], [polygons[k] for k in order], normals[order]


def _walls_of(diagram: Diagram, polygons: list[np.ndarray]) -> np.ndarray:
    """Return the wall of each polygon, (f,) int; -1 for others."""
    rows = np.flatnonzero(diagram.neighbors < 0)
    if not len(rows):
        return np.full(len(polygons), -1)
    starts, corners = take_rows(*diagram.half_faces.corners, rows)
    counts = np.maximum(np.diff(starts), 1)
    middles = np.add.reduceat(diagram.vertices[corners], starts[:-1]) / counts[:, None]
    far, row = scipy.spatial.KDTree(middles).query([polygon.mean(axis=0) for polygon in polygons])
    walls = -1 - diagram.neighbors[diagram.neighbors < 0]
    return np.where(np.asarray(far) < 1e-6 * diagram.domain.extent.max(), walls[row], -1)


def _on_sides(domain: Domain, polygons: Sequence[np.ndarray]) -> np.ndarray:
    """Return which polygons lie on a side of the box, (f,) bool."""
    starts = np.cumsum([0, *map(len, polygons)])[:-1]
    gaps = np.stack([np.concatenate(polygons) - side for side in (domain.lower, domain.upper)], axis=1)
    farthest = np.maximum.reduceat(np.abs(gaps), starts, axis=0)
    return (farthest < 1e-5 * domain.extent.max()).any(axis=(1, 2))


def around_body(diagram: Diagram) -> bool:
    """Return whether the domain is the space around a body: walls on most sides of its bounding box, and others."""
    if not diagram.domain.curved_walls:
        return False
    polygons, areas = _wall_polygons(diagram.faces), diagram.faces.area[diagram.faces.n_inner :]
    return bool(_is_body(diagram, polygons).any()) and fills_box(diagram.domain, polygons, areas)


def fills_box(domain: Domain, polygons: Sequence[np.ndarray], areas: np.ndarray) -> bool:
    """Return whether walls, given as `polygons` with their `areas` (f,), are most of the sides of the bounding box."""
    x, y, z = domain.extent
    return bool(areas[_on_sides(domain, polygons)].sum() > 2 * _IN_BOX * (x * y + y * z + z * x))


def _wall_polygons(faces: Faces) -> list[np.ndarray]:
    starts = faces.starts[faces.n_inner : -1]
    return np.split(faces.points[faces.corners[starts[0] :]], starts[1:] - starts[0])


def _is_body(diagram: Diagram, polygons: list[np.ndarray]) -> np.ndarray:
    """Return which walls are on patches that no side of the bounding box has, given their `polygons`, (f,) bool."""
    patch = -1 - diagram.faces.neighbor[diagram.faces.n_inner :]
    return ~np.isin(patch, patch[_on_sides(diagram.domain, polygons)])


def _body_faces(
    diagram: Diagram, cut: Any, through: np.ndarray, towards: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Return the walls of a body that face the viewer where cells are removed, as `visible_faces` does."""
    if cut is None or not around_body(diagram):
        return np.zeros(0, int), [], np.zeros((0, 3))
    faces, polygons = diagram.faces, _wall_polygons(diagram.faces)
    cells, normals = faces.owner[faces.n_inner :], faces.normal[faces.n_inner :]
    removed = ~kept_cells(cut, through, towards, cells, diagram.points[cells])
    seen = np.flatnonzero(removed & _is_body(diagram, polygons) & (normals @ towards < 0))
    seen = seen[np.argsort((faces.center[faces.n_inner :] @ towards)[seen], kind="stable")]
    return cells[seen], [polygons[k] for k in seen], normals[seen]


def _draw_cutaway(
    ax: Any,
    diagram: Diagram,
    paint: Paint,
    cut: Any,
    through: np.ndarray,
    angles: Any,
    edges: bool = True,
    walls: bool = False,
) -> None:
    """Add the view to `ax`: the faces of the kept cells that are seen, and the edges of the box."""
    right, up, towards = view_axes(angles)
    screen = np.stack([right, up], axis=1)
    cut = _cut(cut, len(diagram), towards)
    body = _body_faces(diagram, cut, through, towards)
    cells, polygons, normals = visible_faces(diagram, cut, through, towards)
    cells, polygons, normals = np.append(cells, body[0]), polygons + body[1], np.concatenate([normals, body[2]])
    flat = [polygon @ screen for polygon in polygons]
    corners = np.stack(np.meshgrid(*np.transpose([diagram.domain.lower, diagram.domain.upper])), axis=-1).reshape(-1, 3)
    pairs = [(a, b) for i, a in enumerate(corners) for b in corners[i + 1 :] if np.count_nonzero(a != b) == 1]
    frame = np.array(pairs) @ screen
    lower, upper = frame.min(axis=(0, 1)), frame.max(axis=(0, 1))
    margin = 0.02 * (upper - lower).max()
    frame_domain(ax, lower - margin, upper + margin)
    ax.set_axis_off()
    ax.add_collection(LineCollection(list(frame), colors="#B0B0B0", linewidths=0.6, zorder=0))
    of_body = np.arange(len(polygons)) >= len(polygons) - len(body[0])
    shade = brightness(np.where(of_body[:, None], -normals, normals), angles)
    widths, colors = edge_widths(ax, flat) if edges else np.zeros(len(flat)), paint.rgba(cells)
    wall = _walls_of(diagram, polygons) if polygons else np.zeros(0, int)
    if polygons:
        shade[(wall < 0) & ~of_body & ~_on_sides(diagram.domain, polygons)] *= _IN_CUT
    hues = np.array([to_rgba(color) for color in METHOD_COLORS])
    if walls:
        colors[wall >= 0] = 0.5 + 0.5 * hues[wall[wall >= 0] % len(hues)]
    elif of_body.any():
        seen, number = np.unique(diagram.domain.boundary_index[wall[of_body]], return_inverse=True)
        hues = 0.3 + 0.7 * hues
        colors[of_body] = hues[number.reshape(-1) % len(hues)]
        names = [diagram.domain.boundary_names[k] for k in seen[:_NAMES]]
        keys = [Patch(color=hues[k % len(hues)], label=name) for k, name in enumerate(names)]
        ax.legend(handles=keys, loc="upper left", fontsize=8, frameon=False)
    draw_polygons(ax, cells, flat, paint, widths, light=shade, colors=colors)


def _label_axes(ax: Any, diagram: Diagram, right: np.ndarray, up: np.ndarray, towards: np.ndarray) -> None:
    """Write the name and range of each axis beside an edge on the outline of the picture."""
    box = np.array([diagram.domain.lower, diagram.domain.upper])
    center, screen = box.mean(axis=0), np.stack([right, up], axis=1)
    front = (towards > 0).astype(int)
    for axis, name in enumerate("xyz"):
        if np.linalg.norm(screen[axis]) < 1e-9:  # seen end-on
            continue
        # An edge of the outline lies between a visible and a hidden wall. Take the lowest, for z the leftmost.
        places = []
        for flip in {0, 1, 2} - {axis}:
            sides = np.where(np.arange(3) == flip, 1 - front, front)
            places.append(np.where(np.arange(3) == axis, center, box[sides, np.arange(3)]) @ screen)
        place = min(places, key=lambda flat: flat[0 if axis == 2 else 1])
        edge = screen[axis] / np.linalg.norm(screen[axis])
        outwards = np.array([-edge[1], edge[0]])
        outwards *= np.sign(outwards @ (place - center @ screen)) or 1
        ends = np.where(np.abs(box[:, axis]) < 1e-9 * np.ptp(box), 0.0, box[:, axis])
        ax.annotate(
            f"${name}$ from {ends[0]:g} to {ends[1]:g}".replace("-", "−"),
            place,
            rotation=90 - (90 - math.degrees(math.atan2(edge[1], edge[0]))) % 180,  # in (-90, 90]
            rotation_mode="default",
            ha="center",
            va="center",
            xytext=tuple(16 * outwards),
            textcoords="offset points",
            fontsize=8,
            color="#333333",
            annotation_clip=False,
        )


def _panels(diagram: Diagram) -> tuple[list[str], int, list[float], list[float]]:
    """Return the normals of the planes, the number of columns, and the widths and heights of the panels."""
    x, y, z = (float(e) for e in diagram.domain.extent)
    if max(x, y, z) <= 2.5 * min(x, y, z):
        return ["y", "x", "z"], 2, [x, y], [z, y]
    longest = int(np.argmax([x, y, z]))
    if longest == 0:
        return ["y", "z"], 1, [x], [z, y]
    return (["x", "z"], 2, [y, x], [max(z, y)]) if longest == 1 else (["y", "x"], 2, [x, y], [z])


def _slice_height(extent: np.ndarray) -> float:
    """Height in inches of a picture of one plane."""
    return min((WIDTH - 1.3) * float(extent[1] / extent[0]), 1.2 * WIDTH) + 0.6


def _point(result: Result, through: ArrayLike | None) -> np.ndarray:
    """Return the point that a picture is about, or raise InputError."""
    point = focus(result) if through is None else np.asarray(through, float)
    if point.shape != (3,):
        raise InputError(f"through has shape {point.shape}, expected 3 coordinates")
    return point


def _corner(result: Result, through: ArrayLike | None, angles: tuple[float, float]) -> np.ndarray:
    """Return the corner of the octant that a view leaves out: `through`, or a point among the smallest cells.

    Along axes on which the domain is less than two cells thick, it lies behind all cells.
    """
    point, domain = _point(result, through), result.diagram.domain
    if through is not None:
        return point
    behind = np.where(view_axes(angles)[2] >= 0, domain.lower, domain.upper)
    return np.where(domain.extent < _FEW_ACROSS * np.cbrt(np.median(result.diagram.volumes)), behind, point)


def _cut(cut: Any, n: int, towards: np.ndarray) -> Any:
    """Return `cut` as `kept_cells` takes it, or raise InputError."""
    if cut is None or (isinstance(cut, str) and cut == "octant"):
        return cut
    if not isinstance(cut, str):
        marks = np.asarray(cut)
        if marks.dtype == bool:
            if marks.shape != (n,):
                raise InputError(f"cut has shape {marks.shape}, expected one mark per cell ({n},)")
            return marks
    try:
        normal = as_normal(cut)
    except InputError as error:
        raise InputError(
            f"cut is {cut!r}, expected 'octant', 'x', 'y', 'z', three numbers, a mark per cell or None"
        ) from error
    return -normal if isinstance(cut, str) and normal @ towards < 0 else normal
