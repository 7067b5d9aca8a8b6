"""The size field beside boundary layers and lines."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..geometry.boundary_layers import Layers, chosen_segments, outer_segments
from ..geometry.domain import Domain
from ..geometry.lines.pairs import LinePairs
from ..geometry.shapes import Edges
from .distance import Distance
from .field import Field, as_field, minimum

_GROWTH = 1.2
"""Growth of sizes beyond layers of constant height."""
_SMALLER = 0.8
"""Sizes beside lines that count as smaller than the size field, as a share of it."""
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
        field = _limited(field, segments, widths, layer.width, slope)
    return field


def limit_beside_lines(field: Field, pairs: LinePairs) -> Field:
    """Return `field`, limited beside lines whose cells are smaller, as lines are near to each other there."""
    smaller = pairs.sizes < _SMALLER * np.asarray(field(pairs.chords.mean(axis=1)), float)
    return _limited(field, pairs.chords[smaller], pairs.sizes[smaller], 1.0, math.log(_GROWTH))


def _limited(field: Field, segments: np.ndarray, widths: np.ndarray, width: float, slope: float) -> Field:
    """Return `field`, limited to sizes that grow from the `widths` (k,) at `segments` (k, 2, 2).

    Those of one class, counted from `width`, have one distance field.
    """
    classes = np.floor(np.log(widths / width) / math.log(_CLASS) + 0.5)
    for one in np.unique(classes):
        row = Edges(*np.moveaxis(segments[classes == one], 1, 0))
        field = minimum(field, Distance(row, h_min=float(widths[classes == one].mean()), slope=slope))
    return field
