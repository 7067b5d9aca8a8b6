"""The size field beside boundary layers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..geometry.boundary_layers import Layers, chosen_segments
from ..geometry.box import Domain
from ..geometry.shapes import Edges
from .distance import Distance
from .field import Field, as_field, minimum

_GROWTH = 1.2
"""Growth of sizes beyond layers of constant height."""


def limit_beside_layers(size: object, domain: Domain, layers: Sequence[Layers]) -> Field:
    """Return `size`, limited to sizes that grow from the width of the layers into the domain."""
    field = as_field(size)
    for layer in layers:
        walls = Edges(*np.moveaxis(chosen_segments(domain, layer), 1, 0))
        slope = math.log(layer.growth if layer.growth > 1 else _GROWTH)
        field = minimum(field, Distance(walls, h_min=layer.width, slope=slope))
    return field
