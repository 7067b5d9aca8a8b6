"""Updates in 2D and 3D have one interface."""

import inspect

from clvoro.tessellation.incremental import IncrementalUpdate
from clvoro.tessellation.polyhedra_update import PolyhedraUpdate


def test_arguments_have_the_same_names_and_order():
    flat, solid = (inspect.signature(kind.update).parameters for kind in (IncrementalUpdate, PolyhedraUpdate))
    assert list(flat) == list(solid)
