"""Solids in case files."""

import gzip

import pytest

from clvoro import Solid
from clvoro.cli.cases import Case, load_case
from clvoro.errors import InputError

TABLE = '[domain]\nsolid = "lobes.obj"\n{more}\n[size]\nkind = "constant"\nvalue = 0.2\n'


@pytest.mark.parametrize(
    ("more", "volume", "inside"),
    [
        ("", 1, True),
        ('units = "mm"', 1e-9, True),
        ("outside = { lower = [-1, -1, -0.75], upper = [2, 1, 0.75], names = { inlet = 'xMin' } }", None, False),
    ],
)
def test_a_case_names_a_file_and_the_box_around_it(more, volume, inside):
    case = Case.from_toml(TABLE.format(more=more), "case.toml")
    body = Solid.read("clvoro/cli/cases/lobes.obj")
    expected = 9 - body.measure if volume is None else volume * body.measure
    assert case.domain.measure == pytest.approx(expected)
    assert ("inlet" in case.domain.boundary_names) != inside


def test_a_case_names_several_files_and_takes_them_along(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    box, files = Solid.box((0, 0, 0), (1, 1, 1)), {"xMin.stl.gz": [0], "xMax.stl": [1], "walls.stl": [2, 3, 4, 5]}
    for name, sides in {**files, "apart.stl": [0]}.items():
        part = box.boundary(sides)
        shift = (-0.01, 0, 0) if name == "apart.stl" else (0, 0, 0)
        stl = trimesh.Trimesh(part.vertices + shift, part.triangles).export(file_type="stl")
        (tmp_path / name).write_bytes(gzip.compress(stl) if name.endswith("gz") else stl)
    text = TABLE.replace('"lobes.obj"', str(list(files))).format(more="")
    case = Case.from_toml(text, "case.toml", tmp_path)
    (tmp_path / "copy").mkdir()
    case.write(tmp_path / "copy")
    assert load_case(tmp_path / "copy" / "case.toml").domain.boundary_names == ("xMin", "xMax", "walls")
    with pytest.raises(InputError, match=r"4 edges .* All are of walls"):
        Case.from_toml(text.replace(", 'xMax.stl'", ""), "case.toml", tmp_path)
    with pytest.raises(InputError, match=r"8 are between apart and walls, up to 0\.01 apart, at \(-?0"):
        Case.from_toml(text.replace("xMin.stl.gz", "apart.stl"), "case.toml", tmp_path)


def test_creases_are_shapes_of_sizes():
    sizes = '[size]\nkind = "distance"\nh_min = 0.1\ngrowth = 1.2\nshapes = [{ kind = "creases", edges = "xMin" }]\n'
    around = "outside = { lower = [-1, -1, -0.75], upper = [2, 1, 0.75] }"
    case = Case.from_toml(TABLE.format(more=around).partition("[size]")[0] + sizes, "case.toml")
    assert case.size_field()([[-1, -1, 0], [-1, 0, 0.75], [2, 0, 0]]) == pytest.approx([0.1, 0.1, 0.664], abs=1e-3)
    with pytest.raises(InputError, match="expected a solid"):
        Case.from_toml("[domain]\nlower = [0, 0]\nupper = [1, 1]\n" + sizes, "case.toml").size_field()


def test_wrong_keys_of_a_solid_are_refused():
    with pytest.raises(InputError, match="unknown key 'unit'"):
        Case.from_toml(TABLE.format(more='unit = "mm"'), "case.toml")
    with pytest.raises(InputError, match="units is 'inch'"):
        Case.from_toml(TABLE.format(more='units = "inch"'), "case.toml")
