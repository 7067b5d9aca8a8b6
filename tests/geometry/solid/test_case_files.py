"""Solids in case files."""

import pytest

from clvoro import Solid
from clvoro.cli.cases import Case
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


def test_wrong_keys_of_a_solid_are_refused():
    with pytest.raises(InputError, match="unknown key 'unit'"):
        Case.from_toml(TABLE.format(more='unit = "mm"'), "case.toml")
    with pytest.raises(InputError, match="units is 'inch'"):
        Case.from_toml(TABLE.format(more='units = "inch"'), "case.toml")
