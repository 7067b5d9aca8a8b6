"""Boundaries of domains in pictures: the outline, clipping to the domain, and named boundaries."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from ..geometry.domain import Domain
from .style import METHOD_COLORS, WIDTH, frame_domain, interactive_figure, single_height, styled

if TYPE_CHECKING:
    from ..geometry.shapes import Edges

_LINE = {"edgecolor": "#1A1A1A", "linewidth": 0.8, "facecolor": "none", "joinstyle": "round"}
_MARGIN = 0.01  # of the longer side, around a whole domain
_DASHES = ("-", "--", ":", "-.")  # for more names than colors


def plot_boundaries(domain: Domain, ax: Any = None, *, numbers: bool = False) -> Any:
    """Draw the boundary of a 2D domain with one color for each name, before or over a mesh.

    Parameters
    ----------
    domain : Box or Polygon
    ax : matplotlib axes, optional
        Drawn into; a new figure by default.
    numbers : bool
        Write the number of each edge or side at its middle.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    InputError
        For a domain in 3D or on a sphere.
    """
    domain.require_plane("plot_boundaries draws in the plane", "call result.plot()")
    with styled():
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
                ax.annotate(
                    str(wall),
                    segment.mean(axis=0),
                    color=color,
                    zorder=4,
                    ha="center",
                    va="center",
                    bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
                )
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=4, frameon=False)
    return ax.figure


def frame_part(ax: Any, domain: Domain, lower: Any, upper: Any, ticks: bool = True) -> None:
    """Show the part of the domain from `lower` to `upper` to scale: a frame, and its outline if it has one.

    An outline shown as a whole has no other frame.
    """
    whole = np.array_equal(lower, domain.lower) and np.array_equal(upper, domain.upper)
    outline = _outline_path(domain)
    room = _MARGIN * domain.extent.max() if whole and outline else 0.0
    frame_domain(ax, np.subtract(lower, room), np.add(upper, room), ticks)
    if outline:
        if whole:
            for spine in ax.spines.values():
                spine.set_visible(False)
        ax.add_patch(PathPatch(outline, zorder=2.5, **_LINE))


def clip_to_domain(ax: Any, domain: Domain, artist: Any) -> None:
    """Clip `artist` to the outline of the domain."""
    outline = _outline_path(domain)
    if outline:
        artist.set_clip_path(outline, ax.transData)


def _outline_path(domain: Domain) -> Path | None:
    """Return the outline as a path, or None: outer rings run counter-clockwise, holes clockwise."""
    if domain.outline is None:
        return None
    closed = [np.vstack([ring, ring[:1]]) for ring in domain.outline.oriented.rings]
    return Path.make_compound_path(*(Path(ring, closed=True) for ring in closed))
