"""The edges of a polygon that stand for curves: rings with curves in them, and nearest points on the curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arguments import check_rows
from ..errors import InputError, InputTypeError
from .curves.curve import CLOSE, Curve

_GAP = 1e-6  # of a ring's extent: a smaller gap between a curve and the next item is a mistake
_OFF = 1e-6  # of a curve's extent: its largest distance from its vertices in a file


@dataclass(frozen=True)
class CurvedEdges:
    """Curves of a polygon, or of one ring, and the part of a curve that each edge stands for.

    - `curves`: tuple of Curve
    - `curve` (k,) int32: number in `curves` for each edge; -1 for an edge that belongs to no curve.
    - `span` (k,) int32: number of the smooth part of the curve; -1 for a straight edge.
    - `ends` (k, 2) float64: parameters of the curve at the begin and the end of each edge.
    """

    curves: tuple[Curve, ...]
    curve: np.ndarray
    span: np.ndarray
    ends: np.ndarray

    @classmethod
    def straight(cls, count: int) -> CurvedEdges:
        """Return `count` straight edges."""
        return cls((), np.full(count, -1, np.int32), np.full(count, -1, np.int32), np.zeros((count, 2)))

    @classmethod
    def join(cls, parts: Sequence[CurvedEdges]) -> CurvedEdges:
        """Join the edges of rings, one after the other."""
        first, curve = 0, []
        for part in parts:
            curve.append(np.where(part.curve >= 0, part.curve + first, -1).astype(np.int32))
            first += len(part.curves)
        return cls(
            tuple(c for part in parts for c in part.curves),
            np.concatenate(curve),
            np.concatenate([part.span for part in parts]),
            np.concatenate([part.ends for part in parts]),
        )

    def nearest(self, points: np.ndarray, edges: np.ndarray, begins: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return the nearest points (n, 2) to `points` on the parts of curves that `edges` (n,) stand for.

        Points of straight edges are returned as they are. `begins` and `ends`, (n, 2) each, are the vertices of the
        edges; a point that is nearest to one of them is moved there exactly.
        """
        found = np.array(points, dtype=float)
        key = np.where(self.span[edges] >= 0, self.curve[edges], -1)
        for c in np.unique(key[key >= 0]):
            for s, span in enumerate(self.curves[c].spans):
                rows = np.flatnonzero((key == c) & (self.span[edges] == s))
                if not rows.size:
                    continue
                low, high = self.ends[edges[rows]].T
                t = span.nearest(found[rows], low, high)
                at = span.at(t)[0]
                at = np.where((t == low)[:, None], begins[rows], at)
                found[rows] = np.where((t == high)[:, None], ends[rows], at)
        return found

    def label(self, edge: int) -> str:
        """Return the curve of an edge for error messages; empty for other edges."""
        return f" on {self.curves[self.curve[edge]]!r}" if self.curve[edge] >= 0 else ""

    def describe(self) -> list[dict[str, Any]]:
        """Return plain values for files: each curve, its first edge and number of edges, and parameters of vertices."""
        found = []
        for c, curve in enumerate(self.curves):
            edges = np.flatnonzero(self.curve == c)
            spans = [edges[self.span[edges] == s] for s in range(len(curve.spans))]
            found.append(
                {
                    "curve": curve.describe(),
                    "edges": [int(edges[0]), len(edges)],
                    "parameters": [[*self.ends[e, 0].tolist(), float(self.ends[e[-1], 1])] for e in spans],
                }
            )
        return found

    @classmethod
    def described(cls, values: object, begins: np.ndarray, ends: np.ndarray) -> CurvedEdges:
        """Return the edges from the values that `describe` returns; `begins`, `ends`: vertices of all edges, (k, 2).

        Raises `InputError` or `InputTypeError` if the values do not describe curves through the vertices.
        """
        made = cls.straight(len(begins))
        curves = []
        try:
            for c, item in enumerate(values):  # type: ignore[arg-type]
                curve = Curve.described(item["curve"])
                first, count = item["edges"]
                edges = np.arange(len(begins))[first : first + count]
                if first < 0 or not 0 < count == len(edges) or (made.curve[edges] >= 0).any():
                    raise ValueError("edges")
                made.curve[edges] = c
                for s, (span, given) in enumerate(zip(curve.spans, item["parameters"], strict=True)):
                    t = np.array(given, float)
                    mine, edges = edges[: len(t) - 1], edges[len(t) - 1 :]
                    if not (t.ndim == 1 and 2 <= len(t) == len(mine) + 1 and (np.diff(t) > 0).all()):
                        raise ValueError("parameters")
                    if not (t[0] == span.begin and t[-1] == span.end):
                        raise ValueError("parameters")
                    made.span[mine], made.ends[mine] = s, np.column_stack([t[:-1], t[1:]])
                    off = span.at(t)[0] - np.concatenate([begins[mine], ends[mine[-1:]]])
                    if not (np.abs(off) <= _OFF * curve.extent).all():
                        raise ValueError("a curve does not pass through its vertices")
                curves.append(curve)
        except (InputError, InputTypeError):
            raise
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(f"the description of a Polygon's curves is damaged ({error})") from error
        return cls(tuple(curves), made.curve, made.span, made.ends)


def has_curves(ring: object) -> bool:
    """Return whether `ring` is a curve or a list with curves in it."""
    return isinstance(ring, Curve) or (isinstance(ring, list | tuple) and any(isinstance(item, Curve) for item in ring))


def unroll(ring: Any, name: str) -> tuple[np.ndarray, CurvedEdges]:
    """Return the vertices (k, 2) of a ring that has curves in it, without a closing vertex, and its edges.

    Where a curve ends in a point of the ring, the point is the vertex. Straight edges join all other ends.

    - `name`: name of the ring in errors.

    Raises `InputError` or `InputTypeError` if the ring is one open curve, has a closed one beside other items, or a gap
    that is larger than round-off and smaller than 1e-6 of the ring; names the place.
    """
    items = [ring] if isinstance(ring, Curve) else list(ring)
    if isinstance(ring, Curve) and not ring.closed:
        raise InputError(
            f"Polygon's {name} is open: {ring!r} does not return to its start; write [curve] to close it by a straight "
            "edge, or a list of curves and points"
        )
    whole = len(items) == 1 and items[0].closed
    ends_of_ring = [item for item in (items[0], items[-1]) if not isinstance(item, Curve)]
    if len(ends_of_ring) == 2 and np.array_equal(*ends_of_ring):
        items = items[:-1]
    vertices, curve, span, ends, is_curve = [], [], [], [], []
    curves: list[Curve] = []
    for i, item in enumerate(items):
        if not isinstance(item, Curve):
            try:
                vertices.append(check_rows(f"item {i}", [item], 2))
            except (InputError, InputTypeError) as error:
                raise type(error)(
                    f"Polygon's {name} has item {i}, expected a point (x, y) or a curve: {error}"
                ) from error
            parts = CurvedEdges.straight(1)
        elif item.closed and not whole:
            raise InputError(
                f"Polygon's {name} has the closed curve {item!r} beside other items, expected open curves; make it a "
                "ring of its own"
            )
        else:
            parts = _edges_of(item)
            vertices.append(item.vertices)
        curve.append(np.where(parts.curve >= 0, len(curves), -1))
        span.append(parts.span)
        ends.append(parts.ends)
        is_curve.append(np.full(len(parts.span), isinstance(item, Curve)))
        curves += parts.curves
    number = np.repeat(np.arange(len(items)), [len(v) for v in vertices])
    every, on_curve = np.concatenate(vertices), np.concatenate(is_curve)
    made = CurvedEdges(
        tuple(curves),
        np.concatenate(curve).astype(np.int32),
        np.concatenate(span).astype(np.int32),
        np.concatenate(ends),
    )
    if whole:
        return every, made
    return _merge_ends(every, made, number, on_curve, name)


def _edges_of(curve: Curve) -> CurvedEdges:
    """Return one edge for each vertex of `curve`; the one behind the last vertex is straight if it is not the curve's.

    The straight edge that closes a closed curve belongs to the curve.
    """
    t, spans = curve.nodes
    extra = len(curve.vertices) - len(t)
    numbers = np.zeros(len(t) + extra, np.int32)
    if extra and not curve.closed:
        numbers[-1] = -1
    return CurvedEdges(
        (curve,), numbers, np.append(spans, [-1] * extra).astype(np.int32), np.concatenate([t, np.zeros((extra, 2))])
    )


def _merge_ends(
    every: np.ndarray, made: CurvedEdges, item: np.ndarray, on_curve: np.ndarray, name: str
) -> tuple[np.ndarray, CurvedEdges]:
    """Merge the last vertex of each item with the first one of the next where a curve ends in it."""
    after = np.roll(np.arange(len(every)), -1)
    last = np.flatnonzero((item != item[after]) & (on_curve | on_curve[after]))
    if item[0] == item[-1] and on_curve[0]:  # one open curve alone
        last = np.array([len(every) - 1])
    first = after[last]
    extent = np.ptp(every, axis=0).max()
    away = np.hypot(*(every[last] - every[first]).T)
    bad = np.flatnonzero((away > CLOSE * extent) & (away < _GAP * extent))
    if bad.size:
        k = bad[0]
        x, y = every[last[k]]
        raise InputError(
            f"Polygon's {name} is open at ({x:.12g}, {y:.12g}): items {item[last[k]]} and {item[first[k]]} are "
            f"{away[k]:.3g} apart, expected a common point or a longer straight edge; give both with more digits"
        )
    near = away <= CLOSE * extent
    kept = np.ones(len(every), bool)
    for a, b in zip(last[near].tolist(), first[near].tolist(), strict=True):
        kept[a] = False
        if not on_curve[a]:
            every[b] = every[a]
    return every[kept], CurvedEdges(made.curves, made.curve[kept], made.span[kept], made.ends[kept])
