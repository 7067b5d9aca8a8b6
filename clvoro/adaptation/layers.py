"""Layers of a run: rows of generators along walls in 2D, prisms on the walls of solids; and the sizes beside them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arguments import warn
from ..errors import InputError, MismatchWarning
from ..geometry.boundary_layers import (
    Layers,
    apart_from,
    beyond_layers,
    check_extruded,
    check_gaps,
    columns_of,
    count_prisms,
    count_rows,
    free_domain,
    place_layers,
    sample_walls,
)
from ..geometry.domain import Domain
from ..opencl.engine import Engine
from ..sizing.distance import before_layers, limit_beside_borders, limit_beside_layers
from ..sizing.field import Field
from .estimates import check_memory, check_prisms

COARSER, FINER = 2.0, 1e-3
"""Size of the cells of layers over the size field above which a run warns, and their default width over it below which
it warns."""
THICKEST, FLATTEST, THINNEST = 3.0, 1000.0, 0.02
"""Limits of layers of prisms beyond which a run warns: largest thickness of all layers over the size field, largest
size field over the height of the first layer, and least height of the last layer over the size field."""
NARROWER = 0.8
"""Default width of layers over the size field below which the settings of the result say so."""
SAMPLE = 64
"""Largest number of points along a layer at which its sizes are compared with the size field."""


@dataclass(frozen=True)
class Layout:
    """The domain of a run with its layers: where other generators move, and the sizes there."""

    domain: Domain
    layers: Sequence[Layers]
    given: Field
    """The size field of the caller."""
    field: Field
    """The same, limited beside layers, and beside lines and surfaces inside."""
    rows: np.ndarray
    """(m, d) ndarray. Generators of layers, which do not move. Layers of prisms have none."""
    free: Domain
    """The domain without layers of rows."""

    @property
    def after_layers(self) -> Field | None:
        """If layers of prisms compress cells, the sizes of cells afterwards; `field` has those before."""
        return self.given if self.layers and not len(self.rows) else None

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Return the indices of the `points` of the caller, (n, d), that are beyond the layers.

        Raises
        ------
        InputError
            If there are none.
        """
        extruded = self.domain.extrudes_layers
        beyond = (
            beyond_layers(self.domain, self.layers, points) if extruded else apart_from(points, self.rows, self.free)
        )
        if not beyond.any():
            raise InputError(
                f"points has {len(points)} points in the layers, expected some beyond them; give others, or leave "
                "points out"
            )
        return np.flatnonzero(beyond)

    @property
    def narrow_layers(self) -> str:
        """Where the default width of layers is smaller than the size field, in words; empty if it is nowhere."""
        found = []
        for k, layer in enumerate(self.layers):
            if layer.spacing is None and not self.domain.extrudes_layers:
                h = _size_along(layer, layer.count, columns_of(self.domain, layer), self.given, self.domain)
                if layer.width < NARROWER * h:
                    found.append(
                        f"layers[{k}] have cells {layer.width:.3g} wide, the last layer's height, where the size field "
                        f"is {h:.3g}: give spacing for others"
                    )
        return "; ".join(found)

    def check_prisms(self, size: Callable[[np.ndarray], np.ndarray]) -> None:
        """Raise `MemoryLimitError` if the prisms on walls of the sizes `size` need too much memory of the host."""
        if self.domain.extrudes_layers:
            check_prisms(count_prisms(self.domain, self.layers, size))

    def warn_of_mismatches(self) -> None:
        """Warn of parts of the input that do not match the domain, and of layers that do not match the size field.

        Warns
        -----
        MismatchWarning
        """
        found = self.domain.warnings() + self.given.warnings(self.domain)
        for k, layer in enumerate(self.layers):
            found += layer_mismatches(f"layers[{k}]", layer, self.given, self.domain)
        for text in found:
            warn(text, MismatchWarning)


def lay_out(
    engine: Engine, domain: Domain, field: Field, layers: Sequence[Layers], n_cells: int | None, n_fixed: int
) -> Layout:
    """Place `layers` in `domain`, and limit the size `field` beside them.

    Parameters
    ----------
    n_cells : int or None
        Number of cells that the caller wants.
    n_fixed : int
        Number of fixed generators.

    Raises
    ------
    InputError
        If layers meet or do not fit, or leave no cells of `n_cells` for the rest of the domain.
    MemoryLimitError
    """
    rows, free, limited = np.empty((0, domain.dim)), domain, field
    if layers and domain.extrudes_layers:
        check_extruded(domain, layers)
        limited = before_layers(field, domain, layers)
    elif layers:
        check_memory(engine, count_rows(domain, layers), domain)
        check_gaps(domain, layers)
        rows, free = place_layers(domain, layers), free_domain(domain, layers)
        least = len(rows) + max(free.n_pieces, n_fixed)
        if n_cells is not None and n_cells < least:
            raise InputError(
                f"n_cells is {n_cells}, but layers have {len(rows)} cells, expected at least {least}; leave "
                "n_cells out, or make the cells of the layers wider"
            )
        limited = limit_beside_layers(field, domain, layers)
    if domain.borders is not None:
        limited = limit_beside_borders(limited, *domain.borders.narrow_places(free, limited))
    return Layout(domain, layers, field, limited, rows, free)


def layer_mismatches(name: str, layer: Layers, field: Field, domain: Domain) -> list[str]:
    """Return warnings if the cells of `layer` have a very different size than `field` there.

    Layers are usually finer than the field across the wall. But their width along the wall, if it is not given, can be
    far too small.
    """
    if domain.extrudes_layers:
        return _prism_mismatches(name, layer, field, domain)
    columns = columns_of(domain, layer)
    for row in sorted({0, layer.count - 1}):
        h, height = _size_along(layer, row, columns, field, domain), float(layer.heights[row])
        what = f"{name} has cells {layer.width:.3g} wide and {height:.3g} high where the size field is {h:.3g}"
        if math.sqrt(layer.width * height) > COARSER * h:
            remedy = "make the layers finer or the size field larger along these walls"
            return [f"{what}: sizes jump there; {remedy}"]
        if row == layer.count - 1 and layer.spacing is None and layer.width < FINER * h:
            return [
                f"{what}: their width is the last layer's height, because no spacing is given; do layers and size "
                "field have the same unit? Otherwise give spacing, the width along the wall"
            ]
    return []


def _size_along(layer: Layers, row: int, columns: tuple[np.ndarray, np.ndarray], field: Field, domain: Domain) -> float:
    """Return the median of `field` along row `row` of `layer`, at its `columns`; nan if it is outside of the domain."""
    feet, normals = columns
    places = (feet + layer.rows[row] * normals)[:: -(-len(feet) // SAMPLE)]
    places = places[domain.contains(places)]
    return float(np.median(field(places))) if len(places) else math.nan


def _prism_mismatches(name: str, layer: Layers, field: Field, domain: Domain) -> list[str]:
    """Return warnings if prisms are far thicker or thinner than the cells beside them."""
    _, h = sample_walls(domain, layer, field, SAMPLE)
    smallest, largest = float(h.min()), float(h.max())
    if layer.thickness > THICKEST * smallest:
        return [
            f"{name} are {layer.thickness:.3g} thick where the size field is {smallest:.3g}, expected at most "
            f"{THICKEST:g} times as much, as all cells beside them are compressed; use fewer or thinner layers"
        ]
    if largest > FLATTEST * layer.height:
        return [
            f"{name} have a first height of {layer.height:.3g} where the size field is {largest:.3g}: OpenFOAM's "
            f"checkMesh rejects cells more than {FLATTEST:g} times as wide as high; use a larger height, or smaller "
            "sizes there"
        ]
    if layer.heights[-1] < THINNEST * smallest:
        return [
            f"the last of {name} is {layer.heights[-1]:.3g} high beside cells of {smallest:.3g}, where sizes jump; use "
            "more layers, or a larger growth"
        ]
    return []
