"""Faces of a Voronoi diagram between two cells, trimmed by the surface of a solid: what is inside, closed by chords."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...connectivity import following, rows_and_places, rows_of, starts_of, take_ranges
from .pierce import IN, WALL, PiercedEdges
from .wall_surface import WallSurface


@dataclass(frozen=True)
class TrimmedFaces:
    """Parts of faces inside of the solid."""

    face: np.ndarray
    """(p,) int. The face that each part comes from; a face may have several."""
    starts: np.ndarray
    """(p + 1,) int."""
    items: np.ndarray
    """(k,) int. Corners: vertices, and after these the piercings of edges."""
    chord: np.ndarray
    """(k,) bool. Whether the part goes from this corner to the next one along the wall."""

    def take(self, rows: np.ndarray) -> TrimmedFaces:
        """Return some of the parts."""
        begin, counts = self.starts[:-1][rows], np.diff(self.starts)[rows]
        starts, items = take_ranges(begin, counts, self.items)
        return TrimmedFaces(self.face[rows], starts, items, take_ranges(begin, counts, self.chord)[1])


def trim_faces(
    surface: WallSurface,
    starts: np.ndarray,
    corners: np.ndarray,
    edges: np.ndarray,
    forward: np.ndarray,
    sides: np.ndarray,
    pierced: PiercedEdges,
    points: np.ndarray,
    h: np.ndarray,
) -> TrimmedFaces:
    """Keep the parts of faces that are inside of the solid.

    A part of two corners is an edge with both ends outside, of a face without a corner inside. It has an area once a
    vertex on a crease follows on its chord.

    - `starts`, `corners` (f + 1,), (k,) int: corners of each face, in order.
    - `edges`, `forward` (k,) int, (k,) bool: edge from each corner to the next, and whether it begins there.
    - `sides` (v,) int8: of each vertex: IN, WALL or OUT.
    - `points` (v + p, 3) float: of vertices and piercings.
    - `h`: (f,) float
    """
    v = len(sides)
    face = rows_of(starts)
    crossings = np.diff(pierced.first)[edges]
    begins = np.where(forward, pierced.starts_inside[edges], pierced.ends_inside[edges])
    finishes = np.where(forward, pierced.ends_inside[edges], pierced.starts_inside[edges])
    # One item for each corner, followed by those of the piercings of its edge.
    place = np.cumsum(crossings + 1) - (crossings + 1)
    n = int(crossings.sum()) + len(corners)
    items, inside, kept = np.empty(n, np.int64), np.empty(n, bool), np.ones(n, bool)
    items[place], inside[place] = corners, begins
    row, number = rows_and_places(crossings)
    which = np.where(forward[row], number, crossings[row] - 1 - number)
    items[place[row] + 1 + number] = v + pierced.first[edges[row]] + which
    inside[place[row] + 1 + number] = begins[row] ^ (number % 2 == 0)
    before = np.empty(len(corners), bool)
    before[following(starts)] = finishes
    side = sides[corners]
    kept[place] = (side == IN) | (side == WALL) & (begins | before)
    of = np.repeat(face, crossings + 1)[kept]
    items, gap = items[kept], ~inside[kept]
    counts = np.bincount(of, minlength=len(starts) - 1)
    gaps = np.bincount(of, gap, minlength=len(starts) - 1)
    whole = TrimmedFaces(np.arange(len(starts) - 1), starts_of(counts), items, gap)
    several = np.flatnonzero(gaps > 1)
    simple = whole.take(np.flatnonzero((counts >= 2) & (gaps <= 1)))
    made = [simple]
    if several.size:
        made.append(_divide(surface, whole, several, points, h))
    found = _joined(made)
    # Faces without a corner inside are kept if their middle is inside: strips across plates.
    lies_in = np.append(sides, np.zeros(len(points) - v, np.int8))[found.items] == IN
    deep = np.bitwise_or.reduceat(lies_in, found.starts[:-1]) if len(found.face) else np.zeros(0, bool)
    shallow = np.flatnonzero(~deep)
    if shallow.size:
        part = found.take(shallow)
        middle = np.add.reduceat(points[part.items], part.starts[:-1]) / np.diff(part.starts)[:, None]
        deep[shallow] = surface.closest(middle)[2] < -1e-3 * h[part.face]
    return found.take(np.flatnonzero(deep))


def _divide(
    surface: WallSurface, whole: TrimmedFaces, rows: np.ndarray, points: np.ndarray, h: np.ndarray
) -> TrimmedFaces:
    """Return the parts of faces that leave the solid several times.

    A chord leads from the place where a face leaves to that where it returns. If these are not the two ends of one gap,
    the face falls into parts. Chords near the surface are the right ones.
    """
    faces, lists, chords = [], [], []
    cut: list[tuple[int, list[np.ndarray], np.ndarray, np.ndarray]] = []
    for row in rows.tolist():
        begin, end = whole.starts[row], whole.starts[row + 1]
        items, gap = whole.items[begin:end], whole.chord[begin:end]
        first = int(np.flatnonzero(gap)[0]) + 1
        items, gap = np.roll(items, -first), np.roll(gap, -first)
        last = np.flatnonzero(gap)  # places of the ends of runs
        runs = np.split(items, last[:-1] + 1)
        ends, heads = points[items[last]], points[[run[0] for run in runs]]
        # A chord is as long as it must be: among equally deep ones the shorter.
        longer = 0.05 * np.linalg.norm(ends[:, None] - heads[None], axis=2)
        cut.append((row, runs, (ends[:, None] + heads[None]) / 2, longer))
    middles = np.concatenate([middle.reshape(-1, 3) for _, _, middle, _ in cut])
    depths = np.split(np.abs(surface.closest(middles)[2]), np.cumsum([longer.size for *_, longer in cut])[:-1])
    for (row, runs, _, longer), depth in zip(cut, depths, strict=True):
        g = len(runs)
        depth = depth.reshape(g, g) + longer
        following_run = _best_pairing(depth)
        left = set(range(g))
        while left:
            k = start = min(left)
            loop: list[int] = []
            marks: list[bool] = []
            while True:
                left.discard(k)
                loop += runs[k].tolist()
                marks += [False] * (len(runs[k]) - 1) + [True]
                k = following_run[k]
                if k == start:
                    break
            if len(loop) >= 2:
                faces.append(int(whole.face[row]))
                lists.append(loop)
                chords.append(marks)
    counts = [len(loop) for loop in lists]
    return TrimmedFaces(
        np.array(faces, np.int64),
        starts_of(counts),
        np.array([i for loop in lists for i in loop], np.int64),
        np.array([c for marks in chords for c in marks], bool),
    )


def _best_pairing(depth: np.ndarray) -> list[int]:
    """Return for the end of each run the run where its chord leads, without chords that cross."""
    g = len(depth)
    if g == 2:
        together = depth[0, 1] + depth[1, 0]
        return [1, 0] if together <= depth[0, 0] + depth[1, 1] else [0, 1]
    # Runs that are closed by a chord of their own, if that is less deep than the chords beside it.
    alone = [k for k in range(g) if depth[k, k] < min(depth[k, (k + 1) % g], depth[k - 1, k])]
    rest = [k for k in range(g) if k not in alone]
    found = list(range(g))
    for k, after in zip(rest, rest[1:] + rest[:1], strict=True):
        found[k] = after
    return found


def _joined(parts: list[TrimmedFaces]) -> TrimmedFaces:
    starts, end = [np.zeros(1, np.int64)], 0
    for part in parts:
        starts.append(part.starts[1:] + end)
        end += int(part.starts[-1])
    face, items, chord = (np.concatenate([getattr(p, name) for p in parts]) for name in ("face", "items", "chord"))
    return TrimmedFaces(face, np.concatenate(starts), items, chord)
