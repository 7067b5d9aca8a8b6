"""Files with inconsistent arrays are refused; the error names the array."""

import dataclasses

import numpy as np
import pytest

import clvoro
from clvoro.io import vtu
from clvoro.io.contents import Contents
from clvoro.io.vtu import write_vtu
from tests.reference.solids import solid_diagram, solid_result


@pytest.fixture(scope="module")
def meshes(ctx):
    box = clvoro.Box((-3.0, -0.5), (7.0, 8.5))
    points = np.random.default_rng(5417).uniform(box.lower, box.upper, (30, 2))
    flat = clvoro.Adapter(ctx).run(box, 1.7, points=points, method="lloyd", max_steps=1)
    points = np.random.default_rng(5419).random((30, 3))
    return {"flat": flat, "solid": solid_result(solid_diagram((0, 0, 0), (1, 1, 1), points))}


def swap(a):
    a[[4, 5]] = a[[5, 4]]


def put(index, value):
    def change(a):
        a[index] = value

    return change


CASES = [
    ("solid", "polyhedra", "connectivity", swap),
    ("solid", "polyhedra", "connectivity", put(7, -1)),
    ("solid", "polyhedra", "connectivity", put(7, 10**8)),
    ("solid", "polyhedra", "offsets", put(3, 1)),
    ("solid", "polyhedra", "offsets", put(-1, 10**8)),
    ("solid", "cell_data", "faces_of_cell", put(3, 5)),
    ("solid", "cell_data", "label", swap),
    ("flat", "cell_data", "label", swap),
    ("flat", "cell_data", "sides", put(3, 11)),
    ("flat", "cell_data", "generator", put((3, 2), 1e-9)),
    ("flat", "in_space", "Points", put((9, 2), np.nan)),
]


@pytest.mark.sparse(4)
@pytest.mark.parametrize(("kind", "part", "name", "change"), CASES)
def test_arrays_for_other_programs_have_to_agree(meshes, kind, part, name, change, tmp_path, monkeypatch):
    path = tmp_path / "m.vtu"
    write_vtu(Contents.of(meshes[kind]), path)
    clvoro.load(path)
    make = getattr(vtu, part)

    def spoilt(*given):
        arrays = make(*given)
        if part != "in_space":
            arrays[name] = arrays[name].copy()
            change(arrays[name])
        elif len(arrays) == len(meshes[kind].diagram.vertices):
            change(arrays)
        return arrays

    with monkeypatch.context() as patched:
        if part == "polyhedra":
            patched.setitem(vtu.KINDS, 3, dataclasses.replace(vtu.KINDS[3], topology=spoilt))
        else:
            patched.setattr(vtu, part, spoilt)
        write_vtu(Contents.of(meshes[kind]), path)
    with pytest.raises(clvoro.ClvoroError, match=rf"(\b{name}\b|not finite)"):
        clvoro.load(path)
