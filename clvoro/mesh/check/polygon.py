"""Checks of diagrams in polygonal domains, beside those of all diagrams."""

from __future__ import annotations

import numpy as np
import scipy
import shapely

from ...connectivity import following, rows_of
from ...geometry.polygon import BOUNDARY_SHIFTS, Polygon
from ..diagram import Diagram
from .findings import Check
from .rebuilt import Rebuilt

ASIDE = 16 + 2 * max(BOUNDARY_SHIFTS)
"""Distance of corners from the domain, in units of round-off, that is allowed: the device shifts the boundary where it
cannot follow it exactly (in its own unit, which is up to twice the size of the domain)."""


def check_outlines(check: Check) -> None:
    """Check that faces form loops, and that the corners of a cell follow the loops, with bridges there and back."""
    d = check.diagram
    owner, ends, onward = d.half_faces.owner, d.half_faces.ends, d.half_faces.next
    check.note(
        "faces closed",
        ends[:, 1] != ends[onward, 0],
        lambda f: f"face {f} of cell {owner[f]} ends in vertex {ends[f, 1]}, where no face of it begins",
    )
    corners, starts = d.cell_vertices, d.cell_vertex_starts
    cell = rows_of(starts)
    # Count each way from vertex to vertex, minus the ways back: the two ways of a bridge cancel.
    of = np.concatenate([owner, cell])
    a = np.concatenate([ends[:, 0], corners])
    b = np.concatenate([ends[:, 1], corners[following(starts)]])
    times = np.repeat([1, -1], [len(owner), len(cell)]) * np.sign(b - a)
    order = np.lexsort((np.maximum(a, b), np.minimum(a, b), of))
    new = np.zeros(len(order), bool)
    for key in (of, np.minimum(a, b), np.maximum(a, b)):
        new |= np.diff(key[order], prepend=-1) != 0
    left = np.bincount(np.cumsum(new) - 1, times[order])
    where = order[new]
    check.note(
        "outlines",
        left != 0,
        lambda k: (
            f"the corners of cell {of[where[k]]} do not go along its faces between vertices "
            f"{a[where[k]]} and {b[where[k]]}"
        ),
    )


def check_edges(check: Check, domain: Polygon, g: Rebuilt, slack: float) -> None:
    """Check that the faces on each edge of the polygon cover it without gap or overlap."""
    d = check.diagram
    rows = np.flatnonzero(d.neighbors < 0)
    oriented = domain.oriented
    edge = oriented.places[-1 - d.neighbors[rows]]
    begin, length = oriented.vertices, oriented.lengths
    along = oriented.along / length[:, None]
    first, last = (((d.vertices[v] - begin[edge]) * along[edge]).sum(axis=1) for v in d.half_faces.ends[rows].T)
    order = np.lexsort((first + last, edge))
    edge, first, last = edge[order], first[order], last[order]
    # Each face begins where the previous one ends, the first at 0; the last one ends with the edge.
    new = np.diff(edge, prepend=-1) != 0
    gap = np.abs(first - np.where(new, 0.0, np.roll(last, 1)))
    check.note(
        "edges covered",
        np.maximum(gap - 2 * slack, 0),
        lambda k: (
            f"on edge {oriented.edge_numbers[edge[k]]} there is a gap or an overlap of {gap[k]:.3g} before the "
            f"face of cell {g.owner[rows[order[k]]]}"
        ),
    )
    reached = np.zeros(len(length))
    reached[edge] = last  # the last one written is the last on the edge
    rest = np.abs(length - reached)
    check.note(
        "edges covered",
        np.maximum(rest - 2 * slack, 0),
        lambda e: (
            f"the faces on edge {oriented.edge_numbers[e]} of length {length[e]:.6g} end {rest[e]:.3g} from its end"
        ),
    )


def check_cells(check: Check, domain: Polygon, g: Rebuilt, slack: float) -> None:
    """Check that each cell contains its generator: its faces wind around it once. Those of power diagrams need not."""
    d = check.diagram
    if d.is_power:
        return
    begin, end = (d.vertices[v] - d.points[g.owner] for v in d.half_faces.ends.T)
    angle = np.arctan2(begin[:, 0] * end[:, 1] - begin[:, 1] * end[:, 0], (begin * end).sum(axis=1))
    turns = np.bincount(g.owner, angle, len(d)) / (2 * np.pi)
    # A generator on the boundary is inside or outside by round-off.
    edge = end - begin
    t = -(begin * edge).sum(axis=1) / np.maximum((edge**2).sum(axis=1), 1e-300)
    off = np.linalg.norm(begin + np.clip(t, 0, 1)[:, None] * edge, axis=1)
    near = np.full(len(d), np.inf)
    np.minimum.at(near, g.owner, off)
    wrong = np.flatnonzero((np.abs(turns - 1) > 1e-3) & (near > slack))
    if wrong.size and len(d) > 1:
        # Of two generators on the boundary at one place within round-off, either one may have all of the cell.
        beside = scipy.spatial.KDTree(d.points).query(d.points[wrong], k=2)[0][:, 1]
        wrong = wrong[(beside > slack) | (domain.boundary_distance(d.points[wrong]) > slack)]
    check.note(
        "generators in their cells",
        np.isin(np.arange(len(d)), wrong),
        lambda i: f"the faces of cell {i} go {turns[i]:.3g} times around its generator, expected once",
    )


def hidden(
    d: Diagram,
    domain: Polygon,
    tree: scipy.spatial.KDTree,
    places: np.ndarray,
    corners: np.ndarray,
    slack: float,
    unit: float,
) -> np.ndarray:
    """Return those of `places` in the cells' `corners` from which one of the nearest generators is not visible.

    A corner belongs to the cell of its nearest generator if the line between them lies in the domain. Otherwise the
    boundary may have cut off that part of the region, which then belongs to another cell. Where pieces of the domain
    touch in a point, both pieces are visible from it, but a generator there belongs to one of them. Also, a generator
    that is visible from a re-entrant corner may be hidden right beside it.

    Face k begins in corner k of `corners`.
    """
    at = d.vertices[corners[places]]
    distances = tree.query(at - np.array(domain.lower))[0]
    nearest = tree.query_ball_point(at - np.array(domain.lower), distances + 4 * slack)
    place = np.repeat(np.arange(len(places)), [len(some) for some in nearest])
    goal = d.points[np.array([j for some in nearest for j in some], int)]
    way = goal - at[place]
    # The corner itself may be outside of the domain within round-off.
    part = np.minimum(ASIDE * unit / np.maximum(np.linalg.norm(way, axis=1), 1e-300), 1)
    ends = np.stack([at[place] + part[:, None] * way, goal], axis=1)
    lines = np.asarray(shapely.linestrings(ends))
    away = np.bincount(place, ~shapely.covers(domain.geometry, lines), len(places)) > 0
    # The line crosses slits that are no wider: nothing behind them is visible from their sides.
    before = np.argsort(d.half_faces.next)
    for faces in (places, before[places]):
        begin, end = domain.edge_ends(np.maximum(-1 - d.neighbors[faces], 0))
        along = end - begin
        along /= np.linalg.norm(along, axis=1)[:, None]
        right = along[place, 1] * way[:, 0] - along[place, 0] * way[:, 1]
        away[place[(right > 4 * unit) & (d.neighbors[faces] < 0)[place]]] = True
    # In a slit as narrow as round-off the side of a corner or generator is not determined.
    away |= domain.is_slit(at, ASIDE * unit)
    away[place[domain.is_slit(goal, ASIDE * unit)]] = True
    away |= near_shared_corners(domain, at, slack) | near_places(at, _reflex_corners(domain), slack)
    # Nothing is visible through a point where pieces touch.
    away[place[near_shared_corners(domain, lines, slack)]] = True
    return places[away]


def near_shared_corners(domain: Polygon, places: np.ndarray, slack: float) -> np.ndarray:
    """Return which of `places`, points (k, 2) or shapes (k,), are within `slack` of a corner of several rings."""
    once, times = np.unique(domain.oriented.vertices, axis=0, return_counts=True)
    return near_places(places, once[times > 1], slack)


def near_places(places: np.ndarray, others: np.ndarray, slack: float) -> np.ndarray:
    """Return which of `places`, points (k, 2) or shapes (k,), are within `slack` of one of `others` (m, 2)."""
    near = np.zeros(len(places), bool)
    if len(places) and len(others):
        tree = shapely.STRtree(np.asarray(shapely.points(others)))
        shapes = shapely.points(places) if places.ndim == 2 else places
        near[tree.query(shapes, predicate="dwithin", distance=slack)[0]] = True
    return near


def _reflex_corners(domain: Polygon) -> np.ndarray:
    """Return the re-entrant corners (m, 2) of the domain."""
    after, vertices = domain.oriented.next_vertex, domain.oriented.vertices
    edges = vertices[after] - vertices
    turn = edges[:, 0] * edges[after, 1] - edges[:, 1] * edges[after, 0]
    return vertices[after[turn < 0]]
