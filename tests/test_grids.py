"""What the fast set keeps of a grid of parameters."""

from itertools import product
from types import SimpleNamespace

import pytest

from tests.grids import points_to_leave


def item(axes, params, *marks):
    """As much of a test as the choice looks at; an axis may have several names."""
    found = [pytest.mark.parametrize(names, [None]).mark for names in axes]
    found += [mark.mark for mark in marks]
    return SimpleNamespace(
        nodeid="test_it[...]",
        callspec=SimpleNamespace(params=params),
        params=params,
        iter_markers=lambda name: (m for m in found if m.name == name),
        get_closest_marker=lambda name: next((m for m in found if m.name == name), None),
    )


def test_every_value_of_every_axis_is_kept():
    sizes, shapes, reals = [(1, "a"), (2, "a"), (3, "b"), (4, "b")], ["box", "star"], [32, 64]
    # The axis of precisions is a fixture's: no mark names it.
    items = [
        item([("n", "kind"), "shape"], {"n": n, "kind": kind, "shape": shape, "real": real}, pytest.mark.sparse)
        for (n, kind), shape, real in product(sizes, shapes, reals)
    ]
    left = list(points_to_leave(items))
    kept = [i.params for i in items if i not in left]
    assert sorted(p["n"] for p in kept) == [1, 2, 3, 4]
    for name in ("shape", "real"):
        values = [p[name] for p in kept]
        assert sorted(values.count(v) for v in set(values)) == [2, 2]


def test_unmarked_and_slow_grids_stay_as_they_are():
    pairs = list(product([1, 2], [3, 4]))
    plain = [item(["a", "b"], {"a": a, "b": b}) for a, b in pairs]
    slow = [item(["a", "b"], {"a": a, "b": b}, pytest.mark.sparse, pytest.mark.slow) for a, b in pairs]
    assert not list(points_to_leave(plain + slow))


def test_number_of_points():
    pairs = list(product([1, 2, 3], ["a", "b"]))
    for count, kept in ((1, [(1, "a")]), (2, [(1, "a"), (2, "b")]), (9, pairs)):
        items = [item(["n", "kind"], {"n": n, "kind": k}, pytest.mark.sparse(count)) for n, k in pairs]
        left = list(points_to_leave(items))
        assert [(i.params["n"], i.params["kind"]) for i in items if i not in left] == kept
