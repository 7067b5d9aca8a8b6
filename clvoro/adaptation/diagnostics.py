"""Warnings for plausible input mistakes: units and positions that differ, and sizes that cells cannot follow."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..arguments import warn
from ..errors import MismatchWarning, SizeErrorWarning
from ..geometry.boundary_layers import Layers, columns_of
from ..geometry.box import Domain
from ..mesh.results import Result
from ..sizing.field import Field

COARSER, FINER = 2.0, 1e-3
"""Ratios of the size of layers to the size field beside them from which on there is a mistake."""
SAMPLE = 64
"""Number of places along a layer that are compared."""
MEAN_ERROR, LARGEST_ERROR = 0.05, 1.0
"""Bounds of |e| above which a finished mesh causes a warning. For fields that cells can follow the mean is at most
0.02, the largest 0.3; where sizes jump 1 : 2 from one cell to the next, the largest is 1."""
STEEP = 1.25
"""Ratio of the sizes of adjacent cells from which on the change of sizes causes the error."""


def warn_of_mismatches(field: Field, domain: Domain, layers: Sequence[Layers]) -> None:
    """Warn of each part of the input that hardly fits `domain`, and of layers that hardly fit `field`.

    Parameters
    ----------
    field : Field
        The field as the caller gave it, without the bounds of layers.

    Warns
    -----
    MismatchWarning
    """
    found = field.warnings(domain)
    for k, layer in enumerate(layers):
        found += layer_mismatches(f"layers[{k}]", layer, field, domain)
    for text in found:
        warn(text, MismatchWarning)


def layer_mismatches(name: str, layer: Layers, field: Field, domain: Domain) -> list[str]:
    """Return warnings if the cells of `layer` have quite another size than `field` has there.

    Layers have flat cells, so that finer ones are right. But a width along the wall that is a default may be far too
    small.
    """
    feet, normals = columns_of(domain, layer)
    some = slice(None, None, -(-len(feet) // SAMPLE))
    for row in sorted({0, layer.count - 1}):
        places = (feet + layer.rows[row] * normals)[some]
        places = places[domain.contains(places)]
        if not len(places):
            continue
        h, height = float(np.median(field(places))), float(layer.heights[row])
        what = f"{name} has cells {layer.width:.3g} wide and {height:.3g} high where the size field is {h:.3g}"
        if math.sqrt(layer.width * height) > COARSER * h:
            remedy = "make the layers finer or the size field larger along these walls"
            return [f"{what}: sizes jump there; {remedy}"]
        if row == layer.count - 1 and layer.spacing is None and layer.width < FINER * h:
            return [
                f"{what}: their width is the last layer's height, as no spacing is given; are layers and size field in "
                "the same unit? Otherwise give spacing, the width along the wall"
            ]
    return []


def warn_of_errors(result: Result) -> None:
    """Warn if the mesh of a run whose plan is completed does not meet its size field, and say where it does so least.

    Warns
    -----
    SizeErrorWarning
    """
    amounts = np.abs(result.size_error)
    worst = int(amounts.argmax())
    mean, largest = float(amounts.mean()), float(amounts[worst])
    if mean < MEAN_ERROR and largest < LARGEST_ERROR:
        return
    diagram, sizes = result.diagram, result.target_size
    wanted, made = float(sizes[worst]), float(diagram.volumes[worst]) ** (1 / diagram.domain.dim)
    if len(diagram) == 1 and 2 * made**diagram.domain.dim < wanted**diagram.domain.dim:
        return  # `CoarseSizeWarning` says it before the run
    place = ", ".join(f"{x:.6g}" for x in result.points[worst])
    row = diagram.neighbors[diagram.neighbor_starts[worst] : diagram.neighbor_starts[worst + 1]]
    beside = sizes[[worst, *row[row >= 0]]]
    if beside.max() > STEEP * beside.min():
        why = (
            "sizes change there by more than cells can follow from one to the next: bound their growth, as by "
            "sizing.Graded(size, growth=1.2), or use more cells"
        )
    else:
        why = (
            f"the domain has a measure of {diagram.domain.measure:.6g}, which cells of this size do not fill evenly: "
            "use smaller sizes, or n_cells, which scales the sizes to a number of cells"
        )
    warn(
        f"the mesh does not meet its size field: mean |e| is {mean:.2g}, and a cell at ({place}) has the size "
        f"{made:.3g} where the size field is {wanted:.3g}; {why}",
        SizeErrorWarning,
    )
