"""Smooth patches of a triangulated surface, and the creases and corners between them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...connectivity import components

SMOOTH, CONVEX, CONCAVE = 0, 1, 2
"""Kinds of the sides and corners of triangles; a patch goes on across smooth and convex ones."""
_STRAIGHT = math.radians(1)  # a crease whose angle is at most this much less than 180 degrees counts as concave
_SOFT = math.radians(60)  # borders of groups at which a wrap turns by less take the mean angle of all between the two
_TURN = math.radians(50)  # a chain that turns by more than this at a vertex has a corner there
_SAME_ANGLE = 1e-9  # angles of triangles around an edge that differ by less are the same


@dataclass(frozen=True)
class Creases:
    """The edges between smooth patches."""

    edges: np.ndarray
    """(e, 2) int. Ends, as vertices of the surface. The edges of a chain follow each other, each from its first end to
    its second."""
    patches: np.ndarray
    """(e, 2) int32. The patches to the left and to the right of each edge, seen from outside of the region with the
    edge upwards."""
    triangles: np.ndarray
    """(e, 2) int. The triangles there."""
    angle: np.ndarray
    """(e,) float. Interior dihedral angle in radians: below pi at convex edges, above pi at concave ones, pi at borders
    that are drawn on a smooth surface."""
    chain: np.ndarray
    """(e,) int. The chain of each edge, ascending. Chains end at corners, or are closed."""

    def __len__(self) -> int:
        return len(self.edges)

    @cached_property
    def concave(self) -> np.ndarray:
        """Whether each edge is concave, or a border that is drawn on a smooth surface, (e,) bool."""
        return self.angle > math.pi - _STRAIGHT

    @property
    def n_chains(self) -> int:
        """Number of chains."""
        return int(self.chain[-1]) + 1 if len(self) else 0

    @cached_property
    def starts(self) -> np.ndarray:
        """First edge of each chain, and the end, (chains + 1,) int."""
        return np.searchsorted(self.chain, np.arange(self.n_chains + 1))

    def vertices(self, chain: int) -> np.ndarray:
        """Return the vertices along a chain, (m + 1,) int; the first one again at the end of a closed chain."""
        mine = self.edges[self.starts[chain] : self.starts[chain + 1]]
        return np.append(mine[:, 0], mine[-1, 1])

    def closed(self, chain: int) -> bool:
        """Return whether a chain ends where it begins."""
        return bool(self.edges[self.starts[chain], 0] == self.edges[self.starts[chain + 1] - 1, 1])


def pair_sides(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pair the sides of triangles (t, 3): two that run along one edge in opposite directions.

    Where four or more triangles share an edge (bodies that touch there), those pair up that bound one wedge of the
    inside.

    Results:
    - `twin` (3 t,) int: for side s of triangle k, at 3 k + s, the other side of the pair; -1 without one.
    - `bad` (b,) int: sides without a partner: of holes, or of triangles that are oriented differently.
    """
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    low, high = ends.min(axis=1), ends.max(axis=1)
    forward = ends[:, 0] < ends[:, 1]
    order = np.lexsort((forward, high, low))
    key_changes = (np.diff(low[order], prepend=-1) != 0) | (np.diff(high[order], prepend=-1) != 0)
    starts = np.flatnonzero(key_changes)
    counts = np.diff(np.append(starts, len(order)))
    twin = np.full(len(ends), -1, np.int64)
    pair = starts[counts == 2]
    a, b = order[pair], order[pair + 1]
    sound = forward[a] != forward[b]
    twin[a[sound]], twin[b[sound]] = b[sound], a[sound]
    for start, count in zip(starts[counts > 2], counts[counts > 2], strict=True):
        sides = order[start : start + count]
        if 2 * forward[sides].sum() == count:
            _pair_around(vertices, triangles, sides, forward[sides], twin)
    return twin, np.flatnonzero(twin < 0)


def _pair_around(vertices: np.ndarray, triangles: np.ndarray, sides: np.ndarray, forward: np.ndarray, twin: np.ndarray):
    """Pair the `sides` at one edge by the angles of their triangles around it."""
    item, side = np.divmod(sides, 3)
    ends = np.stack([triangles[item[0], side[0]], triangles[item[0], (side[0] + 1) % 3]])
    if not forward[0]:
        ends = ends[::-1]
    axis = vertices[ends[1]] - vertices[ends[0]]
    axis = axis / np.linalg.norm(axis)
    third = vertices[triangles[item, (side + 2) % 3]] - vertices[ends[0]]
    u = third[0] - (third[0] @ axis) * axis
    u /= max(np.linalg.norm(u), 1e-300)
    angle = np.arctan2(third @ np.cross(axis, u), third @ u)
    angle[angle < -_SAME_ANGLE] += 2 * math.pi
    # Around the edge, seen against its direction, the inside lies behind a forward side in the negative direction.
    order = np.lexsort((forward, angle))
    for k in range(len(order) - 1):  # bodies that touch, and sheets: at one angle the inside begins and ends in turn
        at, after = order[k : k + 2]
        if angle[after] - angle[at] < _SAME_ANGLE and forward[at] == forward[order[k - 1]] != forward[after]:
            order[k : k + 2] = after, at
    for k, at in enumerate(order):
        before = order[k - 1]
        if forward[at] and not forward[before]:
            twin[sides[at]], twin[sides[before]] = sides[before], sides[at]


def triangle_normals(vertices: np.ndarray, triangles: np.ndarray, twin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (t, 3) and areas (t,). A triangle without area gets the normal across its longest side."""
    corner = vertices[triangles]
    sides = np.roll(corner, -1, axis=1) - corner
    product = np.cross(sides[:, 0], -sides[:, 2])
    double = np.linalg.norm(product, axis=1)
    length2 = (sides**2).sum(axis=2)
    sound = double > 1e-10 * length2.max(axis=1)
    normal = np.where(sound[:, None], product / np.where(sound, double, 1)[:, None], 0.0)
    across = twin[3 * np.arange(len(triangles)) + length2.argmax(axis=1)] // 3
    for _ in range(20):
        left = np.flatnonzero(~normal.any(axis=1) & (across >= 0))
        if not left.size:
            break
        normal[left] = normal[across[left]]
    return normal, 0.5 * double


def dihedral_turns(vertices: np.ndarray, triangles: np.ndarray, twin: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return by how much the surface turns at each side (3 t,): positive at convex edges, negative at concave."""
    side = np.arange(len(twin))
    a, b = triangles[side // 3, side % 3], triangles[side // 3, (side + 1) % 3]
    along = vertices[b] - vertices[a]
    length = np.linalg.norm(along, axis=1)
    along = along / np.where(length > 0, length, 1)[:, None]
    n, m = normals[side // 3], normals[np.maximum(twin, 0) // 3]
    sine = np.einsum("ij,ij->i", np.cross(n, m), along)
    turn = np.arctan2(sine, np.einsum("ij,ij->i", n, m))
    return np.where(twin >= 0, turn, 0.0)


def even_turns(turns: np.ndarray, twin: np.ndarray, group: np.ndarray, border: np.ndarray) -> None:
    """Give all sides between two groups of a rough surface the mean of their angles, if they turn little.

    - `turns`, `twin` (3 t,): angles, which change, and sides of the neighbors
    - `group` (t,) int
    - `border` (3 t,) bool: sides between groups
    """
    soft = np.flatnonzero(border & (np.abs(turns) < _SOFT))
    pair = np.sort(group[np.stack([soft, twin[soft]]) // 3], axis=0)
    place = np.unique(pair, axis=1, return_inverse=True)[1].reshape(-1)
    turns[soft] = (np.bincount(place, turns[soft]) / np.bincount(place))[place]


def connect(n: int, pairs: np.ndarray) -> tuple[int, np.ndarray]:
    """Return the number of components of a graph of n nodes with edges `pairs` (m, 2), and that of each node."""
    count, label = components(n, *pairs.T)
    first = np.unique(label, return_index=True)[1]
    rank = np.empty(count, np.int64)
    rank[np.argsort(first)] = np.arange(count)
    return count, rank[label]


def find_creases(
    vertices: np.ndarray, triangles: np.ndarray, twin: np.ndarray, turns: np.ndarray, border: np.ndarray
) -> tuple[np.ndarray, Creases, np.ndarray]:
    """Divide a surface into patches at the sides where `border` (3 t,) is true.

    Results:
    - `patch`: (t,) int32
    - `creases`: Creases
    - `corners` (c,) int: vertices where chains meet, end or turn sharply, ascending.
    """
    side = np.arange(len(twin))
    joined = side[~border & (twin > side)]
    patch = connect(len(triangles), np.column_stack([joined, twin[joined]]) // 3)[1].astype(np.int32)
    mine = side[border & (side < twin)]
    edges = np.column_stack([triangles[mine // 3, mine % 3], triangles[mine // 3, (mine + 1) % 3]])
    both = np.column_stack([mine, twin[mine]]) // 3
    angle = math.pi - turns[mine]
    corners, order, flipped, chain = find_chains(vertices, edges, patch[both], angle)
    edges, both = edges[order], both[order]
    edges[flipped], both[flipped] = edges[flipped, ::-1], both[flipped, ::-1]
    return patch, Creases(edges, patch[both], both, angle[order], chain), corners


def find_chains(vertices: np.ndarray, edges: np.ndarray, patches: np.ndarray, angle: np.ndarray):
    """Return the corners, and the edges in the order of chains: their rows, whether they are reversed, and chains."""
    ends, at = np.unique(edges, return_inverse=True)
    at = at.reshape(-1, 2)
    degree = np.bincount(at.ravel(), minlength=len(ends))
    meeting = np.argsort(at.ravel(), kind="stable")  # half-edges 2 e + end at each vertex
    first = np.cumsum(degree) - degree
    corner = degree != 2
    pair = meeting[first[~corner, None] + np.arange(2)].reshape(-1, 2)
    e, end = pair // 2, pair % 2
    out = vertices[edges[e, 1 - end]] - vertices[edges[e, end]]
    out /= np.linalg.norm(out, axis=2, keepdims=True)
    turned = -np.einsum("ij,ij->i", out[:, 0], out[:, 1]) < math.cos(_TURN)
    concave = angle > math.pi - _STRAIGHT
    turned |= concave[e[:, 0]] != concave[e[:, 1]]
    turned |= (np.sort(patches[e[:, 0]], axis=1) != np.sort(patches[e[:, 1]], axis=1)).any(axis=1)
    corner[np.flatnonzero(~corner)] = turned
    following = np.full(2 * len(edges), -1)  # the half-edge at the same vertex in the same chain
    passed = pair[~turned]
    following[passed[:, 0]], following[passed[:, 1]] = passed[:, 1], passed[:, 0]
    order, flipped, chain = [], [], []
    done = np.zeros(len(edges), bool)
    from_corner = np.flatnonzero(corner[at.ravel()])
    n = 0
    for half in (*from_corner.tolist(), *range(0, 2 * len(edges), 2)):
        if done[half // 2]:
            continue
        while half >= 0 and not done[half // 2]:
            done[half // 2] = True
            order.append(half // 2)
            flipped.append(half % 2 == 1)
            chain.append(n)
            half = int(following[half ^ 1])
        n += 1
    rows, turn_back = np.array(order, np.int64), np.array(flipped, bool)
    return ends[corner], rows, turn_back, np.array(chain, np.int64)


def corner_normals(vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Return a unit normal of the patch at each corner of each triangle, (t, 3, 3): the mean weighted by angles."""
    corner = vertices[triangles]
    ahead, behind = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    sine = np.linalg.norm(np.cross(ahead, behind), axis=2)
    angle = np.arctan2(sine, np.einsum("tkd,tkd->tk", ahead, behind))
    key = triangles * (int(patch.max()) + 1) + patch[:, None]
    unique, place = np.unique(key, return_inverse=True)
    place = place.reshape(-1)
    total = np.zeros((len(unique), 3))
    np.add.at(total, place, (angle[:, :, None] * normals[:, None]).reshape(-1, 3))
    length = np.linalg.norm(total, axis=1)[place].reshape(-1, 3, 1)
    mean = total[place].reshape(-1, 3, 3)
    return np.where(length > 1e-6, mean / np.where(length > 0, length, 1), normals[:, None])
