"""Builders of cells in 2D and 3D have one interface."""

import inspect

import pytest

from clvoro.tessellation.cells import Cells
from clvoro.tessellation.incremental import IncrementalUpdate
from clvoro.tessellation.polyhedra import Polyhedra
from clvoro.tessellation.polyhedra_update import PolyhedraUpdate


@pytest.mark.parametrize(
    ("flat", "solid"),
    [
        (Cells.tessellate, Polyhedra.tessellate),
        (Cells.measure_faces, Polyhedra.measure_faces),
        (IncrementalUpdate.update, PolyhedraUpdate.update),
    ],
)
def test_arguments_have_the_same_names_and_order(flat, solid):
    assert list(inspect.signature(flat).parameters) == list(inspect.signature(solid).parameters)
