"""The size field beside boundary layers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..geometry.boundary_layers import Layers, chosen_segments, outer_segments
from ..geometry.domain import Domain
from ..geometry.shapes import Edges
from .distance import Distance
from .field import Field, as_field, minimum

_GROWTH = 1.2
"""Growth of sizes beyond layers of constant height."""
_CLASS = 1.4
"""Columns whose widths differ by less than this factor have one distance field."""


def limit_beside_layers(size: object, domain: Domain, layers: Sequence[Layers]) -> Field:
    """Return `size`, limited to sizes that grow into the domain from the widths of the columns at the last row."""
    field = as_field(size)
    for layer in layers:
        slope = math.log(layer.growth if layer.growth > 1 else _GROWTH)
        segments, widths = outer_segments(domain, layer)
        if not len(segments):
            segments = chosen_segments(domain, layer)
            widths = np.full(len(segments), layer.width)
        classes = np.floor(np.log(widths / layer.width) / math.log(_CLASS) + 0.5)
        for one in np.unique(classes):
            row = Edges(*np.moveaxis(segments[classes == one], 1, 0))
            width = float(widths[classes == one].mean())
            field = minimum(field, Distance(row, h_min=width, slope=slope))
    return field
