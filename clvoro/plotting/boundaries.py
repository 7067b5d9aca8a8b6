"""Pictures of the boundary of a domain: its names, and the numbers of its walls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Patch

from ..errors import InputError, InputTypeError
from ..geometry.domain import Domain
from ..io.convert import missing
from .cells import frame_part
from .solids import VIEW, brightness, fills_box, view_axes
from .style import METHOD_COLORS, WIDTH, frame_domain, interactive_figure, single_height, styled

if TYPE_CHECKING:
    from ..geometry.shapes import Edges
    from ..geometry.surface import Surface

_DASHES = ("-", "--", ":", "-.")  # for more names than colors
_PARTS = 64  # Pieces of triangles are smaller than this part of the domain's longest edge.
_HUES = np.array([to_rgb(color) for color in METHOD_COLORS])
_LABEL_ROOM = 0.04
"""Least distance of two numbers, over the extent."""
_LABEL: Any = {
    "ha": "center",
    "va": "center",
    "zorder": 4,
    "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 0.8},
}


def plot_boundaries(domain: Domain, ax: Any = None, *, numbers: bool = False) -> Any:
    """Draw the boundary of a domain with one color for each name; in 2D before or over a mesh.

    A domain in 3D is seen from two opposite directions, above and below. If it is the space in a box, around a body or
    without one, walls nearer to the viewer are left out, so that those behind are seen.

    Parameters
    ----------
    domain : Box, Polygon or Solid
    ax : matplotlib axes, optional
        Drawn into, in 2D; a new figure by default.
    numbers : bool
        Write the number of each edge, side or patch at its middle. In 3D each patch then has a color of its own. Those
        hidden in both views are listed.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError, InputTypeError
        For a mesh, for a domain on a sphere or periodic in all directions, or if axes are given for a domain in 3D.
    MissingLibraryError
        If trimesh is not installed, in 3D (``pip install "clvoro[solids]"``).
    """
    if not isinstance(domain, Domain):
        raise InputTypeError(f"domain is a {type(domain).__name__}, expected a domain; that of a mesh is mesh.domain")
    domain.require_flat("plot_boundaries draws domains in the plane and in space", "call result.plot()")
    if not domain.boundary_names:
        raise InputError(f"{domain!r:.80} has no boundary: it is periodic in all directions")
    with styled():
        if domain.cell_dim == 3:
            if ax is not None:
                raise InputError(f"ax is given, and {domain!r:.80} is drawn in a figure of its own; leave ax out")
            return _plot_in_space(domain, numbers)
        return _plot_in_plane(domain, ax, numbers)


def _plot_in_plane(domain: Domain, ax: Any, numbers: bool) -> Any:
    if ax is None:
        height = single_height(domain.lower, domain.upper, legend=True)
        ax = interactive_figure(WIDTH, height).add_subplot()
        frame_part(ax, domain, domain.lower, domain.upper)
    for k, name in enumerate(domain.boundary_names):
        walls = np.flatnonzero(domain.boundary_index == k)
        if domain.outline is not None:  # edges without length cannot be drawn
            walls = walls[domain.outline.oriented.places[walls] >= 0]
        curves = [cast("Edges", domain.boundary(wall)) for wall in walls.tolist()]
        segments = [np.vstack([c.begin, c.end]) for c in curves]
        color = METHOD_COLORS[k % len(METHOD_COLORS)]
        style = _DASHES[k // len(METHOD_COLORS) % len(_DASHES)]
        lines = LineCollection(
            segments, colors=color, linestyles=style, linewidths=2, label=name, zorder=3, clip_on=False
        )
        ax.add_collection(lines, autolim=False)
        for wall, segment in zip(walls, segments, strict=True) if numbers else ():
            ax.annotate(str(wall), segment.mean(axis=0), color=color, **_LABEL)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4, frameon=False)
    return ax.figure


def _plot_in_space(domain: Domain, numbers: bool) -> Any:
    walls = np.flatnonzero(domain.boundary_index >= 0)
    triangles = [cast("Surface", domain.boundary(wall)).corners for wall in walls.tolist()]
    pieces, wall = _pieces(np.concatenate(triangles), np.repeat(walls, [len(t) for t in triangles]), domain)
    normals = np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0])
    areas = np.linalg.norm(normals, axis=1) / 2
    normals /= np.maximum(2 * areas, 1e-300)[:, None]
    outwards = -1 if fills_box(domain, cast("Any", pieces), areas) else 1
    hues = (_hues(domain)[wall] if numbers else domain.boundary_index[wall]) % len(METHOD_COLORS)
    figure = interactive_figure(WIDTH, WIDTH / 2)
    hidden = set(walls.tolist())
    for ax, angles in zip(figure.subplots(1, 2), (VIEW, (VIEW[0] + 180, -VIEW[1])), strict=True):
        right, up, towards = view_axes(angles)
        flat, facing = pieces @ np.stack([right, up], axis=1), outwards * normals @ towards
        shown = np.flatnonzero(facing > 0)
        shown = shown[np.argsort(pieces[shown].mean(axis=1) @ towards, kind="stable")]
        frame_domain(ax, flat.min(axis=(0, 1)), flat.max(axis=(0, 1)), ticks=False)
        ax.set_axis_off()
        colors = (0.4 + 0.6 * _HUES[hues[shown]]) * brightness(outwards * normals[shown], angles)[:, None]
        seen: Any = flat[shown]  # an array takes half the time of a list
        drawn = PolyCollection(seen, facecolors=colors, edgecolors=colors, linewidths=0.3, rasterized=True)
        ax.add_collection(drawn, autolim=False)
        placed = np.zeros((0, 2))
        for k, place in _places(flat[shown], wall[shown], domain).items() if numbers else ():
            if (np.linalg.norm(placed - place, axis=1) > _LABEL_ROOM * domain.extent.max()).all():
                ax.annotate(str(k), place, **_LABEL)
                placed = np.vstack([placed, place])
                hidden.discard(k)
    if not numbers:
        names = [Patch(color=_HUES[k % len(_HUES)], label=name) for k, name in enumerate(domain.boundary_names)]
        figure.legend(handles=names, loc="outside lower center", ncols=4, frameon=False)
    elif hidden:
        figure.supxlabel(f"without a number: {', '.join(map(str, sorted(hidden)))}", fontsize=8)
    return figure


def _hues(domain: Domain) -> np.ndarray:
    """Return a color for each wall, (k,) int: of those that no earlier wall beside it has, the one used least."""
    hues, pairs = np.zeros(len(domain.boundary_index), int), np.asarray(domain.meeting_walls)
    used = np.zeros(len(METHOD_COLORS))
    for k in range(len(hues)):
        beside = np.unique(pairs[(pairs == k).any(axis=1)])
        taken = np.bincount(hues[beside[beside < k]], minlength=len(used)) > 0
        hues[k] = (used + len(hues) * taken).argmin()
        used[hues[k]] += 1
    return hues


def _pieces(corners: np.ndarray, wall: np.ndarray, domain: Domain) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles (t, 3, 3) in small pieces (k, 3, 3), and the walls (k,) of these.

    Small pieces hide each other rightly if those nearer to the viewer are drawn later.
    """
    try:
        from trimesh.remesh import subdivide_to_size
    except ModuleNotFoundError as error:
        raise missing("trimesh", "solids", "a picture of the boundary in 3D") from error
    most = float(domain.extent.max()) / _PARTS
    vertices, faces, origin = cast("Any", subdivide_to_size)(
        corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), most, max_iter=20, return_index=True
    )
    return vertices[faces], wall[origin]


def _places(flat: np.ndarray, wall: np.ndarray, domain: Domain) -> dict[int, np.ndarray]:
    """Return for walls that are seen a place (2,) in the middle of the part that is.

    - `flat` (k, 3, 2) float: pieces of walls, those nearer to the viewer later.
    - `wall`: (k,) int
    """
    middle = flat.mean(axis=1)
    pixel = np.floor(middle * (_PARTS / float(domain.extent.max()))).astype(int)
    # Of the pieces in a pixel the nearest one is seen.
    _, last = np.unique(pixel[::-1], axis=0, return_index=True)
    seen = len(wall) - 1 - last
    found = {}
    for k in np.unique(wall[seen]).tolist():
        places = middle[seen[wall[seen] == k]]
        found[k] = places[np.linalg.norm(places - places.mean(axis=0), axis=1).argmin()]
    return found
