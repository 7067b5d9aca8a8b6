"""Cut a cell in two by a plane through an edge where it is concave."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .editing import Edge, Edits, area_of, between, edges_of

_FOLD = 0.02
"""Faces to other cells are folded along the cut: by this share of the length of the fold. Were both parts of such a
face in one plane, OpenFOAM could take the cell behind it for concave."""
_ROOM = 3.0
"""Least angle, in degrees, between a cut and the continuation of a face at the edge."""
_PLANES = 10
"""Most planes through an edge that are tried."""


def planes_through(edits: Edits, cell: int, edge: Edge, turn: float, outward: np.ndarray, h: float) -> list[np.ndarray]:
    """Return the normals of planes through a concave edge that leave less than 180 degrees on both sides.

    They point to the side of the face left of the edge, with the normal `outward`. The angle of the cell at the edge is
    `turn` degrees beyond 180.
    """
    x = edits.point(edge[0])
    along = edits.point(edge[1]) - x
    along /= np.linalg.norm(along)
    across, inward = np.cross(outward, along), -outward
    across -= (across @ along) * along
    across /= np.linalg.norm(across)
    inward = np.cross(along, across) if np.cross(along, across) @ inward > 0 else -np.cross(along, across)
    least, most = math.radians(turn + _ROOM), math.radians(180 - _ROOM)
    middle = math.radians(180 + turn) / 2
    if least > most:
        angles = [middle]
    else:  # also through vertices of the cell
        arms = edits.positions(sorted(edits.vertices(cell) - set(edge))) - x
        far = np.hypot(arms @ across, arms @ inward) > 0.2 * h
        at = np.arctan2(arms @ inward, arms @ across)[far] % (2 * math.pi)
        at = at[(at >= least) & (at <= most)]
        at = at[np.argsort(np.abs(at - middle))][: _PLANES - 5]
        angles = [middle, *at.tolist(), *(least + s * (most - least) for s in (0, 0.25, 0.75, 1))]
    return [math.sin(t) * across - math.cos(t) * inward for t in angles]


class CellCut:
    """A plane through a concave edge of a cell, and the side of it on which each vertex of the cell is.

    Vertices near the plane count as in it, and as above. So the section, the polygon in which the plane cuts the cell,
    crosses only edges of the cell with one end below.

    - `edits`: which the cut changes.
    - `edge`: (int, int)
    - `below`: the face right of the edge; it is on the lower side.
    - `normal` (3,) float: of the plane, upward.
    - `near`: vertices nearer to the plane than this are in it.
    """

    def __init__(self, edits: Edits, cell: int, edge: Edge, below: int, normal: np.ndarray, near: float) -> None:
        self.edits, self.cell, self.edge, self.below, self.normal = edits, cell, edge, below, normal
        vertices = sorted(edits.vertices(cell))
        places = edits.positions(vertices) - edits.point(edge[0])
        self.heights = dict(zip(vertices, (places @ normal).tolist(), strict=True))
        flat = {v for v, d in self.heights.items() if abs(d) < near} | set(edge)
        up = {v for v, d in self.heights.items() if d > 0} | flat
        beside = {v for pair in edges_of(edits.face(below)[2]) if set(pair) & set(edge) for v in pair} - set(edge)
        beside = {v for v in beside if self.heights[v] < 2 * near}
        self.up, self.flat = up - beside, flat - beside
        self.least = 1e-9 * near
        self.parts: dict[int, list[tuple[int, ...]]] = {}  # of faces

    def make(self, onto: Callable[[Edits, int, list[Edge], np.ndarray], np.ndarray]) -> bool:
        """Cut the cell; return whether it falls into two parts. If not, the changes are of no use.

        `onto` returns a place on an edge of a cell moved onto the walls that have the edge.
        """
        path = self._path()
        vertices = self._vertices(path, onto)
        section = []
        for k, *ends in path:
            i, j = (vertices[edge] for edge in ends)
            across = self._divide(k, i, j) if i != j else []
            if across is None:
                return False
            section += [i, *across]
        section = [v for k, v in enumerate(section) if v != section[k - 1]]
        return len(section) >= 3 and len(set(section)) == len(section) and self._separate(tuple(section))

    def _path(self) -> list[tuple[int, Edge, Edge]]:
        """Return the faces that the section crosses, in turn, and on which edges it enters and leaves each.

        It begins at the concave edge. The path is empty if the section is not one closed line.
        """
        chords = {k: self._chords(self.edits.seen(k, self.cell)) for k in self.edits.faces_of(self.cell)}
        at: dict[Edge, list[int]] = {}
        for k, pairs in chords.items():
            for pair in pairs:
                for key in pair:
                    at.setdefault(key, []).append(k)
        first = [pair for pair in chords[self.below] if any(set(key) & set(self.edge) for key in pair)]
        if not first or any(len(faces) != 2 for faces in at.values()):
            return []
        k, (begin, there) = self.below, first[0]
        path = [(k, begin, there)]
        while there != begin:
            here = there
            one, other = at[here]
            k = other if k == one else one
            there = next(q if p == here else p for p, q in chords[k] if here in (p, q))
            path.append((k, here, there))
            if len(path) > len(at):
                return []
        return path

    def _chords(self, loop: tuple[int, ...]) -> list[tuple[Edge, Edge]]:
        """Return the lines in which the plane cuts a face: the edges of the face at both ends of each."""
        ends = [(p, q) for p, q in edges_of(loop) if (p in self.up) != (q in self.up)]
        keys = [(min(e), max(e)) for e in ends]
        if len(ends) > 2:
            along = np.cross(area_of(self.edits.positions(loop)), self.normal)
            at = []
            for p, q in ends:
                high, deep = abs(self.heights[p]), abs(self.heights[q])
                share = high / max(high + deep, 1e-300)
                at.append(float(((1 - share) * self.edits.point(p) + share * self.edits.point(q)) @ along))
            keys = [keys[k] for k in np.argsort(at, kind="stable").tolist()]
        return list(zip(keys[::2], keys[1::2], strict=True))

    def _vertices(
        self, path: list[tuple[int, Edge, Edge]], onto: Callable[[Edits, int, list[Edge], np.ndarray], np.ndarray]
    ) -> dict[Edge, int]:
        """Return the vertex of the section on each edge: its upper end if that is in the plane, or a new one."""
        found: dict[Edge, int] = {}
        ends, places = list[Edge](), list[np.ndarray]()
        for _, key, _ in path:
            p, q = key if key[0] in self.up else key[::-1]
            if p in self.flat:
                found[key] = p
            else:
                high, deep = max(self.heights[p], self.least), max(-self.heights[q], self.least)
                share = high / (high + deep)
                ends.append((p, q))
                places.append((1 - share) * self.edits.point(p) + share * self.edits.point(q))
        if ends:
            for (p, q), x in zip(ends, onto(self.edits, self.cell, ends, np.array(places)), strict=True):
                found[min(p, q), max(p, q)] = self.edits.divide_edge(self.cell, p, q, x)
        return found

    def _divide(self, k: int, i: int, j: int) -> list[int] | None:
        """Divide face k along the section, from its vertex i to its vertex j.

        A face whose upper part is in the plane stays whole: the section follows its sides. Return the vertices of the
        section between i and j, or None if the cell cannot be cut like this.
        """
        edits, loop, after = self.edits, self.edits.seen(k, self.cell), list[int]()
        if k in self.parts or i not in loop or j not in loop:
            return None
        forth, back = between(loop, i, j), between(loop, j, i)
        turned = any(v in self.heights and v not in self.up for v in forth)
        higher = back[::-1] if turned else forth
        if self.flat.issuperset(higher):
            return list(higher[1:-1])
        before = []
        if k == self.below:  # the section also has the other end of the concave edge
            if i in self.edge and (forth[1] in self.edge or back[-2] in self.edge):
                i = next(v for v in self.edge if v != i)
                before = [i]
            elif j in self.edge and (back[1] in self.edge or forth[-2] in self.edge):
                last, j = j, next(v for v in self.edge if v != j)
                after = [j, last]
            forth, back = between(loop, i, j), between(loop, j, i)
        fold = [edits.add_point(self._fold(loop, i, j))] if edits.across(k, self.cell) >= 0 else []
        self.parts[k] = [(*forth, *fold), (*back, *fold)]
        return before + fold + after

    def _fold(self, loop: tuple[int, ...], i: int, j: int) -> np.ndarray:
        """Return the middle of the line across a face that is divided, moved into the cell that is cut."""
        x, y = self.edits.point(i), self.edits.point(j)
        out = area_of(self.edits.positions(loop))
        out -= (out @ self.normal) * self.normal
        out /= max(float(np.linalg.norm(out)), 1e-300)
        return (x + y) / 2 - _FOLD * float(np.linalg.norm(y - x)) * out

    def _separate(self, section: tuple[int, ...]) -> bool:
        """Give the faces on one side of the section to a new cell; return False if there are not two sides."""
        edits, cell = self.edits, self.cell
        border = set(edges_of(section))
        border |= {(q, p) for p, q in border}
        if self.edge not in border:
            return False
        pieces: list[tuple[int, int, tuple[int, ...]]] = []
        for k in edits.faces_of(cell):
            pieces += [(k, edits.across(k, cell), loop) for loop in self.parts.get(k, [edits.seen(k, cell)])]
        side = _components([loop for *_, loop in pieces], border)
        if max(side) != 1:
            return False
        upper = next(s for s, (*_, loop) in zip(side, pieces, strict=True) if self.edge in edges_of(loop))
        open_edges = {e for s, (*_, loop) in zip(side, pieces, strict=True) if s == upper for e in edges_of(loop)}
        floors = [f for f in (section, section[::-1]) if all((q, p) in open_edges for p, q in edges_of(f))]
        if not floors:
            return False
        new, n = edits.add_cell(cell), edits.mesh.n_cells
        x = edits.point(self.edge[0])
        over = cell >= n or (edits.mesh.generators[cell] - x) @ self.normal > 0
        mine = upper if over else 1 - upper
        for k in self.parts:
            edits.drop(k)
        for s, (k, beyond, loop) in zip(side, pieces, strict=True):
            if k in self.parts:
                edits.add(cell if s == mine else new, beyond, loop)
            elif s != mine:
                edits.drop(k)
                edits.put(k, new, beyond, loop)
        edits.add(*((cell, new) if mine == upper else (new, cell)), floors[0])
        return True


def _components(loops: list[tuple[int, ...]], border: set[tuple[int, int]]) -> list[int]:
    """Return for each face the number of the part that it belongs to; parts meet at the `border` only."""
    at: dict[tuple[int, int], list[int]] = {}
    for k, loop in enumerate(loops):
        for edge in edges_of(loop):
            if edge not in border:
                at.setdefault((min(edge), max(edge)), []).append(k)
    part = [-1] * len(loops)
    number = 0
    for first in range(len(loops)):
        if part[first] >= 0:
            continue
        todo = [first]
        part[first] = number
        while todo:
            for p, q in edges_of(loops[todo.pop()]):
                for k in at.get((min(p, q), max(p, q)), ()):
                    if part[k] < 0:
                        part[k] = number
                        todo.append(k)
        number += 1
    return part
