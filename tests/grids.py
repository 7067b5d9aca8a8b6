"""Split grids of parameters: the fast set of tests runs some of their points, the slow set the others."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator

import pytest

Point = list[tuple[object, ...]]


def points_to_leave(items: Iterable[pytest.Item]) -> Iterator[pytest.Item]:
    """Yield the tests that are marked `sparse` and left to the slow set.

    The fast set keeps every value of every axis at least once; with `sparse(n)` it keeps n points, the first among
    them. They differ as much as possible, and equals are from evenly spaced places of the list.
    """
    grids: dict[str, list[tuple[pytest.Item, Point]]] = defaultdict(list)
    most: dict[str, int | None] = {}
    for item in items:
        mark = item.get_closest_marker("sparse")
        if mark and not item.get_closest_marker("slow"):
            name = item.nodeid.partition("[")[0]
            grids[name].append((item, _point_of(item)))
            most[name] = mark.args[0] if mark.args else None
    for name, left in grids.items():
        if n := most[name]:
            spaced = {k * len(left) // n for k in range(n)}
            left = [left[k] for k in sorted(range(len(left)), key=lambda k: k not in spaced)]
        used: Counter[tuple[object, ...]] = Counter()
        kept = 0
        while left:
            # The point with most new values; among equals, the one whose values are rarest so far.
            item, point = min(left, key=lambda p: (sum(v in used for v in p[1]), sum(used[v] for v in p[1])))
            if all(v in used for v in point) if most[name] is None else kept == most[name]:
                yield from (item for item, _ in left)
                break
            kept += 1
            used.update(point)
            left.remove((item, point))


def _point_of(item: pytest.Item) -> Point:
    """Return one value per axis: of each `parametrize`, and of each fixture with parameters."""
    params = dict(item.callspec.params) if hasattr(item, "callspec") else {}
    point: Point = []
    for mark in item.iter_markers("parametrize"):
        names = mark.args[0] if mark.args else mark.kwargs["argnames"]
        names = [n.strip() for n in names.split(",")] if isinstance(names, str) else list(names)
        point.append((*names, *(id(params.pop(name)) for name in names)))
    return point + [(name, id(value)) for name, value in params.items()]
