"""Units and places that do not agree: what is told of before a run begins, though it could be meant."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np

from .domain import Domain
from .errors import MisfitWarning
from .layers import Layers, columns_of
from .sizing.field import Field

COARSER, FINER = 2.0, 1e-3
"""Layers so much coarser or finer than the size field asks for beside them are a mistake."""
SAMPLE = 64
"""Places along a layer at which that is seen."""


def warn_of_misfits(
    field: Field, domain: Domain, layers: Sequence[Layers], stacklevel: int
) -> None:
    """Warn of each part of the input that hardly meets `domain`, or of layers that hardly meet `field`.

    Parameters
    ----------
    field : Field
        As the caller gave it, without what layers add to it.
    stacklevel : int
        Of the caller that is to see it, as `warnings.warn` would take it there.

    Warns
    -----
    MisfitWarning
    """
    found = field.misfits(domain)
    for k, layer in enumerate(layers):
        found += misfits_of_layer(f"layers[{k}]", layer, field, domain)
    for text in found:
        warnings.warn(text, MisfitWarning, stacklevel=stacklevel + 1)


def misfits_of_layer(name: str, layer: Layers, field: Field, domain: Domain) -> list[str]:
    """Return what is to be said of `layer` if its cells are of quite another size than `field` asks for there.

    Flat cells are what layers are for, so that finer ones are right; but a width along the wall that nobody has asked
    for may be far too small.
    """
    feet, normals = columns_of(domain, layer)
    some = slice(None, None, -(-len(feet) // SAMPLE))
    for row in sorted({0, layer.count - 1}):
        places = (feet + layer.rows[row] * normals)[some]
        places = places[domain.contains(places)]
        if not len(places):
            continue
        h, height = float(np.median(field(places))), float(layer.heights[row])
        what = f"{name} has cells {layer.width:.3g} wide and {height:.3g} high where the size field asks for {h:.3g}"
        if math.sqrt(layer.width * height) > COARSER * h:
            remedy = "make the layers finer or the size field larger along these walls"
            return [f"{what}: sizes jump there; {remedy}"]
        if row == layer.count - 1 and layer.spacing is None and layer.width < FINER * h:
            return [
                f"{what}: their width is the last layer's height, as no spacing is given; are layers and size field in "
                "the same unit? Otherwise give spacing, the width along the wall"
            ]
    return []
