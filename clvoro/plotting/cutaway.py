"""A view into a 3D mesh: whole cells are removed, and the visible faces of the others are drawn.

The picture is a parallel projection. Along any line of sight the cells of a Voronoi diagram follow each other in the
order of their generators. Faces are drawn in that order, so that each covers the faces behind it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Colormap

from ..mesh.connectivity import face_corners, face_owners, take_rows
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .cells import edge_style
from .colors import Coloring, cell_norm

VIEW = (-60.0, 26.0)
"""Azimuth and elevation of the viewer, degrees: x-max, y-min and z-max walls are in front."""


def view_axes(view: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the picture's unit vectors: to the right, up, and towards the viewer."""
    azimuth, elevation = (math.radians(angle) for angle in view)
    towards = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    return right, np.cross(towards, right), towards


def kept_cells(diagram: Diagram, cut: Any, through: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Return which cells stay, (n,) bool: `cut` is "octant", a vector, None, or that array itself."""
    if cut is None:
        return np.ones(len(diagram), bool)
    if isinstance(cut, str):  # remove the corner between the point and the viewer
        return ~np.all((diagram.points - through) * np.where(towards >= 0, 1, -1) > 0, axis=1)
    cut = np.asarray(cut)
    return cut if cut.dtype == bool else (diagram.points - through) @ cut <= 0


def visible_faces(diagram: Diagram, kept: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the faces (half-faces) of the kept cells that face the viewer, and their normals, the farthest first."""
    owner, neighbor = face_owners(diagram), diagram.neighbors
    # The cell across the seam of a periodic box lies on the other side of the picture.
    bare = (neighbor < 0) | ~kept[np.maximum(neighbor, 0)] | diagram.shifts.any(axis=1)
    rows = np.flatnonzero(kept[owner] & bare)
    cell, beyond = owner[rows], neighbor[rows]
    normals = diagram.points[np.maximum(beyond, 0)] - diagram.points[cell]
    normals += diagram.shifts[rows] * diagram.domain.extent
    walls = np.flatnonzero(beyond < 0)
    wall = -1 - beyond[walls]
    normals[walls] = 0
    normals[walls, wall // 2] = 2 * (wall % 2) - 1
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    facing = normals @ towards > 1e-9
    rows, cell, normals = rows[facing], cell[facing], normals[facing]
    order = np.argsort((diagram.points @ towards)[cell], kind="stable")
    return rows[order], normals[order]


def draw_cutaway(
    ax: Any,
    result: Result,
    values: np.ndarray,
    scheme: Coloring,
    limits: tuple[float, float],
    *,
    through: np.ndarray,
    cut: Any = "octant",
    view: tuple[float, float] = VIEW,
    edges: bool = True,
    labels: bool = True,
) -> ScalarMappable:
    """Add the view to `ax`; return the mappable for a color bar."""
    diagram = result.diagram
    right, up, towards = view_axes(view)
    kept = kept_cells(diagram, cut, through, towards)
    rows, normals = visible_faces(diagram, kept, towards)
    starts, corners = face_corners(diagram)
    rows, normals = (a[np.diff(starts)[rows] > 0] for a in (rows, normals))
    starts, corners = take_rows(starts, corners, rows)
    flat = np.stack([diagram.vertices[corners] @ right, diagram.vertices[corners] @ up], axis=1)
    cell = face_owners(diagram)[rows]
    color_map = scheme.color_map
    color_map = color_map if isinstance(color_map, Colormap) else colormaps[color_map]
    mappable = ScalarMappable(cell_norm(scheme, limits), color_map)
    mappable.set_array(values)
    colors = mappable.to_rgba(values[cell])
    # The light comes from above, a little from the left.
    light = 0.5 * towards + 0.62 * up - 0.3 * right
    light /= np.linalg.norm(light)
    colors[:, :3] *= (0.72 + 0.28 * np.clip(normals @ light, 0, 1))[:, None]

    frame = _outline(diagram)
    drawn = np.stack([frame @ right, frame @ up], axis=-1)
    extremes = np.concatenate([drawn.reshape(-1, 2), flat])  # cells of periodic boxes reach beyond the box
    lower, upper = extremes.min(axis=0), extremes.max(axis=0)
    margin = 0.02 * (upper - lower).max()
    ax.set_aspect("equal")
    ax.set_xlim(lower[0] - margin, upper[0] + margin)
    ax.set_ylim(lower[1] - margin, upper[1] + margin)
    ax.set_axis_off()
    ax.add_collection(LineCollection(list(drawn), colors="#B0B0B0", linewidths=0.6, zorder=0))
    widths, lines = np.full(len(rows), 0.25), colors.copy()
    if edges:
        thin, ink = edge_style(ax, np.cbrt(diagram.volumes)[cell], upper - lower)
        alpha = ink[:, 3:] * 0.9
        lines[:, :3] = (1 - alpha) * colors[:, :3] + alpha * ink[:, :3]
        widths = np.maximum(thin, 0.25)
    ax.add_collection(
        PolyCollection(
            np.split(flat, starts[1:-1]) if len(rows) else [],
            facecolors=colors,
            edgecolors=lines,
            linewidths=widths,
            joinstyle="round",
            rasterized=len(rows) > 3000,
            zorder=1,
        ),
        autolim=False,
    )
    if labels:
        _label_axes(ax, diagram, right, up, towards)
    return mappable


def _outline(diagram: Diagram) -> np.ndarray:
    """Return the edges of the domain, (12, 2, 3)."""
    corners = np.array(np.meshgrid(*np.transpose([diagram.domain.lower, diagram.domain.upper])))
    corners = corners.reshape(3, -1).T
    pairs = [(a, b) for i, a in enumerate(corners) for b in corners[i + 1 :] if np.count_nonzero(a != b) == 1]
    return np.array(pairs)


def _label_axes(ax: Any, diagram: Diagram, right: np.ndarray, up: np.ndarray, towards: np.ndarray) -> None:
    """Write the name and range of each axis beside an edge on the outline of the picture."""
    box = np.array([diagram.domain.lower, diagram.domain.upper])
    center = box.mean(axis=0)
    flat_center = np.array([center @ right, center @ up])
    gap = 0.02 * float(np.linalg.norm(box[1] - box[0]))
    front = (towards > 0).astype(int)
    for axis, name in enumerate("xyz"):
        # An edge of the outline lies between a visible and a hidden wall. Take the lowest, for z the leftmost.
        others = [a for a in range(3) if a != axis]
        best, place = math.inf, flat_center
        for flip in others:
            middle = center.copy()
            for a in others:
                middle[a] = box[front[a] if a != flip else 1 - front[a], a]
            flat = np.array([middle @ right, middle @ up])
            rank = flat[0] if axis == 2 else flat[1]
            if rank < best:
                best, place = rank, flat
        edge = np.array([right[axis], up[axis]])
        edge /= np.linalg.norm(edge)
        outwards = np.array([-edge[1], edge[0]])
        if outwards @ (place - flat_center) < 0:
            outwards = -outwards
        angle = 90 - (90 - math.degrees(math.atan2(edge[1], edge[0]))) % 180  # in (-90, 90]
        ax.annotate(
            f"${name}$ from {box[0, axis]:g} to {box[1, axis]:g}".replace("-", "−"),
            place + gap * outwards,
            rotation=angle,
            rotation_mode="default",
            ha="center",
            va="center",
            xytext=tuple(9 * outwards),
            textcoords="offset points",
            fontsize=8,
            color="#333333",
            annotation_clip=False,
        )
