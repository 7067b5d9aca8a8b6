"""Pictures of 3D meshes on planes through them."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from numpy.typing import ArrayLike

from ..errors import InputError
from ..mesh.connectivity import face_owners
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .cells import edge_style
from .colors import Color, Coloring, cell_norm, coloring_of, picture_of, without_ends
from .cutaway import draw_cutaway
from .legends import add_key
from .section import Section, cut_cells, plane_axes
from .style import WIDTH, corners_of, ends_of, frame_domain, interactive_figure, new_figure, nice, styled

_AXES = {"x": 0, "y": 1, "z": 2}


def require_space(diagram: Diagram) -> None:
    """Raise InputError unless the diagram is three-dimensional."""
    if diagram.domain.cell_dim != 3:
        raise InputError("slices and cut-away views need cells in 3D, and these are in 2D; call result.plot()")


def focus(result: Result) -> np.ndarray:
    """Return the point that pictures of a 3D mesh show: among its smallest cells, well inside the domain."""
    box = result.diagram.domain
    smallest = result.points[result.target_size <= 1.1 * result.target_size.min()]
    lower, extent = np.array(box.lower), box.extent
    if len(smallest) > 0.5 * len(result.points):  # a uniform mesh
        return lower + 0.5 * extent
    # A round number for the titles; half a cell makes no difference.
    step = nice(0.5 * float(result.target_size.min()), up=False)
    center = np.round(smallest.mean(axis=0) / step) * step + 0.0
    return np.clip(center, lower + 0.25 * extent, lower + 0.75 * extent)


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
    """
    result = picture_of(mesh)
    diagram = result.diagram
    require_space(diagram)
    scheme, direction = coloring_of(result, color, label), as_normal(normal)
    point = focus(result) if through is None else np.asarray(through, float)
    if point.shape != (3,):
        raise InputError(f"through has shape {point.shape}, expected 3 coordinates")
    section = cut_cells(diagram, direction, point)
    if not len(section.cells):
        raise InputError(f"the plane through {point.tolist()} does not intersect {diagram.domain}; give a point inside")
    right, up = plane_axes(direction)
    flat = np.stack([section.corners @ right, section.corners @ up], axis=1)
    lower, upper = _shown_part(diagram, flat, direction, right, up) if window is None else corners_of(window)
    values = scheme.values(result)
    with styled():
        if ax is None:
            extent = upper - lower
            height = min((WIDTH - 1.3) * float(extent[1] / extent[0]), 1.2 * WIDTH)
            ax = interactive_figure(WIDTH, height + 0.6).add_subplot()
        ends = scheme.limits(values) if limits is None else ends_of(limits)
        cells = _draw_section(ax, section, flat, values, scheme, ends)
        frame_domain(ax, lower, upper)
        if edges:
            _draw_sides(ax, diagram, section, (right, up), upper - lower)
        axis, aligned = _axis_of(direction)
        if not aligned and window is None:
            ax.set_axis_off()
        if aligned:
            ax.set_xlabel("xyz"[int(np.argmax(right))])
            ax.set_ylabel("xyz"[int(np.argmax(up))])
        where = f"${'xyz'[axis]} = {point[axis]:.3g}$" if aligned else None
        if title is not None or where is not None:
            ax.set_title(where if title is None else title)
        if key:
            add_key(cells, ax, scheme, values, ends)
    return ax.figure


def _axis_of(direction: np.ndarray) -> tuple[int, bool]:
    """Return the axis nearest to a unit vector, and whether the vector is along it."""
    axis = int(np.argmax(np.abs(direction)))
    return axis, bool(abs(direction[axis]) > 1 - 1e-9)


def _shown_part(
    diagram: Diagram, flat: np.ndarray, direction: np.ndarray, right: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the shown rectangle: that of the domain, or of all polygons of an oblique plane."""
    if not _axis_of(direction)[1]:
        return flat.min(axis=0), flat.max(axis=0)
    ends = np.array([diagram.domain.lower, diagram.domain.upper])
    ends = np.stack([ends @ right, ends @ up], axis=1)
    return ends.min(axis=0), ends.max(axis=0)


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
    """
    result = picture_of(mesh)
    diagram = result.diagram
    require_space(diagram)
    scheme = coloring_of(result, color, label)
    point = focus(result) if through is None else np.asarray(through, float)
    values = scheme.values(result)
    ends = scheme.limits(values) if limits is None else ends_of(limits)
    normals, columns, extents = _panels(diagram)
    with styled():
        if figure is None:
            figure = interactive_figure(WIDTH, slices_height(diagram))
        rows = -(-(len(normals) + (len(normals) == 3)) // columns)
        widths = [max(e[0] for e in extents[c::columns]) for c in range(columns)]
        heights = [max(e[1] for e in extents[r * columns : (r + 1) * columns]) for r in range(rows)]
        grid = figure.add_gridspec(rows, columns, width_ratios=widths, height_ratios=heights)
        axes = [figure.add_subplot(grid[k // columns, k % columns]) for k in range(rows * columns)]
        for ax, normal in zip(axes, normals, strict=False):
            plot_slice(result, color, ax, normal=normal, through=point, limits=ends, key=False)
            ax.locator_params(nbins=5)
        if len(normals) == 3:
            draw_cutaway(axes[3], result, values, scheme, ends, through=point, labels=False)
        if title is not None:
            figure.suptitle(title, fontsize=10)
        add_key(axes[0].collections[0], axes, scheme, values, ends, below=True)
    return figure


def slices_height(diagram: Diagram) -> float:
    """Height in inches that suits `plot_slices`."""
    normals, columns, extents = _panels(diagram)
    width = sum(max(e[0] for e in extents[c::columns]) for c in range(columns))
    rows = -(-(len(normals) + (len(normals) == 3)) // columns)
    height = sum(max(e[1] for e in extents[r * columns : (r + 1) * columns]) for r in range(rows))
    return min((WIDTH - 0.55 * columns) * height / width, 1.6 * WIDTH) + 0.52 * rows + 0.65


def new_slices(result: Result, color: str, **options: Any) -> Any:
    """Return `plot_slices` on a new figure, outside of pyplot."""
    return plot_slices(result, color, new_figure(WIDTH, slices_height(result.diagram)), **options)


def _panels(diagram: Diagram) -> tuple[list[str], int, list[tuple[float, float]]]:
    """Return the normals of the planes, the number of columns, and the extent of each panel."""
    x, y, z = (float(e) for e in diagram.domain.extent)
    if max(x, y, z) <= 2.5 * min(x, y, z):
        return ["y", "x", "z"], 2, [(x, z), (y, z), (x, y), (y, y)]
    longest = "xyz"[int(np.argmax([x, y, z]))]
    if longest == "z":
        return ["y", "x"], 2, [(x, z), (y, z)]
    if longest == "x":
        return ["y", "z"], 1, [(x, z), (x, y)]
    return ["x", "z"], 2, [(y, z), (x, y)]


def _draw_section(
    ax: Any, section: Section, flat: np.ndarray, values: np.ndarray, scheme: Coloring, limits: tuple[float, float]
) -> PolyCollection:
    """Add the filled polygons, an outline in their own color hiding the seams."""
    cells = PolyCollection(
        np.split(flat, section.starts[1:-1]),
        array=without_ends(values[section.cells]),
        cmap=scheme.color_map,
        norm=cell_norm(scheme, limits),
        edgecolors="face",
        linewidths=0.25,
        rasterized=len(section.cells) > 3000,
    )
    ax.add_collection(cells, autolim=False)
    return cells


def _draw_sides(
    ax: Any, diagram: Diagram, section: Section, axes: tuple[np.ndarray, np.ndarray], extent: np.ndarray
) -> None:
    """Add each side once, as a line; its width follows the size of its cells."""
    owner, neighbor = face_owners(diagram)[section.rows], diagram.neighbors[section.rows]
    lengths = np.cbrt(diagram.volumes)
    beyond = np.where(neighbor >= 0, neighbor, owner)
    widths, colors = edge_style(ax, np.minimum(lengths[owner], lengths[beyond]), extent)
    # For a face in the plane, only one cell has the sides.
    cut = np.zeros(len(diagram), bool)
    cut[section.cells] = True
    seam = diagram.shifts[section.rows].any(axis=1)
    once = np.flatnonzero(((neighbor < owner) | ~cut[beyond] | seam) & (widths > 0.06))
    lines = np.stack([section.edges[once] @ axes[0], section.edges[once] @ axes[1]], axis=-1)
    ax.add_collection(
        LineCollection(
            list(lines), colors=colors[once], linewidths=widths[once], capstyle="round", rasterized=len(once) > 9000
        ),
        autolim=False,
    )
