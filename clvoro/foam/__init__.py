"""Cases of OpenFOAM that follow their solution: a mesh from the latest time, all fields transferred to it."""

from .fields import FoamField, Values, read_field
from .loop import FieldSizes, FoamCycle, adapt_case
from .mesh import FoamMesh

__all__ = ["FieldSizes", "FoamCycle", "FoamField", "FoamMesh", "Values", "adapt_case", "read_field"]
