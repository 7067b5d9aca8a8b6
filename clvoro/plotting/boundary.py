"""The boundary of polygonal domains in pictures: its line, and clipping to the domain."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from ..geometry.box import Domain
from ..geometry.polygon import Polygon
from .style import frame_domain

_LINE = {"edgecolor": "#1A1A1A", "linewidth": 0.8, "facecolor": "none", "joinstyle": "round"}
_MARGIN = 0.01  # of the longer side, around a whole domain


def outline_path(domain: Polygon) -> Path:
    """Return the domain as a path: outer rings run counter-clockwise, holes clockwise."""
    closed = [np.vstack([ring, ring[:1]]) for ring in domain.oriented.rings]
    return Path.make_compound_path(*(Path(ring, closed=True) for ring in closed))


def frame_part(ax: Any, domain: Domain, lower: Any, upper: Any, ticks: bool = True) -> None:
    """Show the part of the domain from `lower` to `upper` to scale: a frame, and of a polygon its boundary.

    A polygon shown as a whole has no other frame.
    """
    if not isinstance(domain, Polygon):
        frame_domain(ax, lower, upper, ticks)
        return
    whole = np.array_equal(lower, domain.lower) and np.array_equal(upper, domain.upper)
    room = _MARGIN * domain.extent.max() if whole else 0.0
    frame_domain(ax, np.subtract(lower, room), np.add(upper, room), ticks)
    if whole:
        for spine in ax.spines.values():
            spine.set_visible(False)
    ax.add_patch(PathPatch(outline_path(domain), zorder=2.5, **_LINE))


def clip_to_domain(ax: Any, domain: Domain, *artists: Any) -> None:
    """Clip `artists` to the domain."""
    if isinstance(domain, Polygon):
        for artist in artists:
            artist.set_clip_path(outline_path(domain), ax.transData)
