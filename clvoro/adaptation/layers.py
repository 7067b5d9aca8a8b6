"""Layers of a run: rows of generators along walls in 2D, prisms on the walls of solids; and the sizes beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arguments import warn
from ..errors import InputError, MismatchWarning
from ..geometry.boundary_layers import LayerPrisms, LayerRows, Layers, PlacedLayers
from ..geometry.domain import Domain
from ..geometry.shapes import Edges
from ..opencl.engine import Engine
from ..sizing import Sizing
from ..sizing.distance import Distance
from ..sizing.field import Field, maximum, minimum
from .estimates import check_memory
from .sampling.start import density_tree

_WALLS, _COMPRESSED, _FADING = 1024, 0.995, 0.4
"""Points on walls at which sizes are averaged; least factor on sizes that is neglected; share of the depth over which
the factor grows to 1."""
_GROWTH = 1.2
"""Growth of sizes beyond layers of constant height."""
_ROUNDS = 3
"""Rounds in which narrow places and the factor on the sizes follow each other."""
_CLASS = 1.4
"""Columns whose widths differ by less than this factor have one distance field."""


@dataclass(frozen=True)
class Layout:
    """The domain of a run with its layers: where other generators move, and the sizes there."""

    domain: Domain
    layers: PlacedLayers
    given: Field
    """The size field of the caller."""
    field: Field
    """The same, limited beside layers, and beside lines and surfaces inside."""

    @property
    def after_layers(self) -> Field | None:
        """If layers of prisms compress cells, the sizes of cells afterwards; `field` has those before."""
        return self.given if self.layers.compress else None

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Return the indices of the `points` of the caller, (n, d), that are beyond the layers.

        Raises `InputError` if there are none.
        """
        beyond = self.layers.beyond(points)
        if not beyond.any():
            raise InputError(
                f"points has {len(points)} points in the layers, expected some beyond them; give others, or leave "
                "points out"
            )
        return np.flatnonzero(beyond)

    def warn_of_mismatches(self) -> None:
        """Warn of parts of the input that do not match the domain, and of layers that do not match the size field.

        Warns with `MismatchWarning`.
        """
        found = self.domain.warnings() + self.given.warnings(self.domain)
        for text in found + self.layers.mismatches(self.given):
            warn(text, MismatchWarning)


def lay_out(
    engine: Engine,
    domain: Domain,
    field: Field,
    layers: Sequence[Layers],
    n_cells: int | None,
    n_fixed: int,
    scaled: bool,
) -> Layout:
    """Place `layers` in `domain`, and limit the size `field` beside them.

    - `n_cells`: number of cells that the caller wants.
    - `n_fixed`: number of fixed generators.
    - `scaled`: whether all sizes are scaled to have `n_cells`.

    Raises `InputError` if layers meet or do not fit, or leave no cells of `n_cells` for the rest of the domain. Raises
    `MemoryLimitError`.
    """
    made, limited = PlacedLayers(domain), field
    if layers and domain.extrudes_layers:
        made = LayerPrisms(domain, layers)
        limited = _before_prisms(field, made)
    elif layers:
        made = LayerRows(domain, layers)
        check_memory(engine, made.count(), domain)
        made.check_gaps()
        count = len(made.points)
        least = count + max(made.free.n_pieces, n_fixed)
        if n_cells is not None and n_cells < least:
            raise InputError(
                f"n_cells is {n_cells}, but layers have {count} cells, expected at least {least}; give more, or make "
                "the cells of the layers wider"
            )
        limited = _beside_rows(field, made)
    if domain.borders is not None:
        limited = _beside_borders(engine, domain, made.free, limited, n_cells if scaled else None)
    return Layout(domain, made, field, limited)


def _beside_rows(field: Field, rows: LayerRows) -> Field:
    """Return `field`, limited to sizes that grow into the domain from the widths of the columns at the last row."""
    for k, layer in enumerate(rows.layers):
        slope = math.log(layer.growth if layer.growth > 1 else _GROWTH)
        field = _limited(field, *rows.outer_segments(k), layer.width, slope)
    return field


def _before_prisms(field: Field, prisms: LayerPrisms) -> Field:
    """Return the sizes of cells of a solid before layers of prisms compress them to the sizes of `field`."""
    for k, walls in enumerate(prisms.walls):
        ratio, depth = prisms.compression(k, float(prisms.sample(k, field, _WALLS).mean()))
        if ratio < _COMPRESSED:
            # The ratio near walls, and 1 beyond the depth.
            slope = (1 - ratio) / (_FADING * depth)
            begin = ratio - (1 - 0.5 * _FADING) * depth * slope
            ramp = Distance(walls, h_min=begin, slope=slope, h_max=1.0)
            field = field / maximum(ramp, ratio)
    return field


def _beside_borders(engine: Engine, domain: Domain, free: Domain, field: Field, n_cells: int | None) -> Field:
    """Return `field`, limited to sizes that grow from narrow places beside borders.

    Places are narrow for the cells of the run: with `n_cells` all sizes are scaled to have that number.
    """
    assert domain.borders is not None
    limited, factor = field, 1.0
    for _ in range(1 if n_cells is None else _ROUNDS):
        cells = density_tree(Sizing(engine, domain, limited), free).integral
        if n_cells is not None:
            cells, factor = n_cells, (cells / n_cells) ** (1 / domain.cell_dim)
        check_memory(engine, cells, domain)  # before borders have generators
        segments, sizes = domain.borders.narrow_places(free, lambda x, factor=factor: factor * np.asarray(field(x)))
        limited = _limited(field, segments, sizes / factor, 1 / factor, math.log(_GROWTH) / factor)
    return limited


def _limited(field: Field, segments: np.ndarray, widths: np.ndarray, width: float, slope: float) -> Field:
    """Return `field`, limited to sizes that grow from the `widths` (k,) at `segments` (k, 2, d).

    Those of one class, counted from `width`, have one distance field.
    """
    classes = np.floor(np.log(widths / width) / math.log(_CLASS) + 0.5)
    for one in np.unique(classes):
        row = Edges(*np.moveaxis(segments[classes == one], 1, 0))
        field = minimum(field, Distance(row, h_min=float(widths[classes == one].mean()), slope=slope))
    return field
