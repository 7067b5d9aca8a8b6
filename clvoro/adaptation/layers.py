"""Layers of a run: rows of generators along walls in 2D, prisms on the walls of solids; and the sizes beside them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arguments import warn
from ..errors import InputError, MismatchWarning
from ..geometry.boundary_layers import LayerPrisms, LayerRows, Layers
from ..geometry.domain import Domain
from ..geometry.shapes import Edges
from ..opencl.engine import Engine
from ..sizing.distance import Distance
from ..sizing.field import Field, maximum, minimum
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


_WALLS, _COMPRESSED, _FADING = 1024, 0.995, 0.4
"""Points on walls at which sizes are averaged; least factor on sizes that is neglected; share of the depth over which
the factor grows to 1."""
_GROWTH = 1.2
"""Growth of sizes beyond layers of constant height."""
_CLASS = 1.4
"""Columns whose widths differ by less than this factor have one distance field."""


@dataclass(frozen=True)
class Layout:
    """The domain of a run with its layers: where other generators move, and the sizes there."""

    domain: Domain
    layers: LayerRows | LayerPrisms | None
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
        return self.given if isinstance(self.layers, LayerPrisms) else None

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Return the indices of the `points` of the caller, (n, d), that are beyond the layers.

        Raises
        ------
        InputError
            If there are none.
        """
        beyond = np.ones(len(points), bool) if self.layers is None else self.layers.beyond(points)
        if not beyond.any():
            raise InputError(
                f"points has {len(points)} points in the layers, expected some beyond them; give others, or leave "
                "points out"
            )
        return np.flatnonzero(beyond)

    @property
    def narrow_layers(self) -> str:
        """Where the default width of layers is smaller than the size field, in words; empty if it is nowhere."""
        if not isinstance(self.layers, LayerRows):
            return ""
        found = []
        for k, layer in enumerate(self.layers.layers):
            if layer.spacing is None:
                h = _size_along(self.layers, k, layer.count, self.given)
                if layer.width < NARROWER * h:
                    found.append(
                        f"layers[{k}] have cells {layer.width:.3g} wide, the last layer's height, where the size field "
                        f"is {h:.3g}: give spacing for others"
                    )
        return "; ".join(found)

    def check_prisms(self, size: Callable[[np.ndarray], np.ndarray]) -> None:
        """Raise `MemoryLimitError` if the prisms on walls of the sizes `size` need too much memory of the host."""
        if isinstance(self.layers, LayerPrisms):
            check_prisms(self.layers.count(size))

    def warn_of_mismatches(self) -> None:
        """Warn of parts of the input that do not match the domain, and of layers that do not match the size field.

        Warns
        -----
        MismatchWarning
        """
        found = self.domain.warnings() + self.given.warnings(self.domain)
        for text in found + layer_mismatches(self.layers, self.given):
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
    made, rows, free, limited = None, np.empty((0, domain.dim)), domain, field
    if layers and domain.extrudes_layers:
        made = LayerPrisms(domain, layers)
        limited = _before_prisms(field, made)
    elif layers:
        made = LayerRows(domain, layers)
        check_memory(engine, made.count(), domain)
        made.check_gaps()
        rows, free = made.points, made.free
        least = len(rows) + max(free.n_pieces, n_fixed)
        if n_cells is not None and n_cells < least:
            raise InputError(
                f"n_cells is {n_cells}, but layers have {len(rows)} cells, expected at least {least}; give "
                "more, or make the cells of the layers wider"
            )
        limited = _beside_rows(field, made)
    if domain.borders is not None:
        segments, sizes = domain.borders.narrow_places(free, limited)
        limited = _limited(limited, segments, sizes, 1.0, math.log(_GROWTH))
    return Layout(domain, made, field, limited, rows, free)


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


def _limited(field: Field, segments: np.ndarray, widths: np.ndarray, width: float, slope: float) -> Field:
    """Return `field`, limited to sizes that grow from the `widths` (k,) at `segments` (k, 2, d).

    Those of one class, counted from `width`, have one distance field.
    """
    classes = np.floor(np.log(widths / width) / math.log(_CLASS) + 0.5)
    for one in np.unique(classes):
        row = Edges(*np.moveaxis(segments[classes == one], 1, 0))
        field = minimum(field, Distance(row, h_min=float(widths[classes == one].mean()), slope=slope))
    return field


def layer_mismatches(layers: LayerRows | LayerPrisms | None, field: Field) -> list[str]:
    """Return warnings for cells of layers that have a very different size than `field` there.

    Layers are usually finer than the field across the wall. But their width along the wall, if it is not given, can be
    far too small.
    """
    if layers is None:
        return []
    count = range(len(layers.layers))
    if isinstance(layers, LayerRows):
        found = [_row_mismatch(layers, k, field) for k in count]
    else:
        found = [_prism_mismatch(layers, k, field) for k in count]
    return [text for text in found if text]


def _row_mismatch(rows: LayerRows, k: int, field: Field) -> str:
    """Return a warning if the cells of layer `k` are too large or far too narrow."""
    layer = rows.layers[k]
    for row in sorted({0, layer.count - 1}):
        h, height = _size_along(rows, k, row, field), float(layer.heights[row])
        what = f"layers[{k}] has cells {layer.width:.3g} wide and {height:.3g} high where the size field is {h:.3g}"
        if math.sqrt(layer.width * height) > COARSER * h:
            return f"{what}: sizes jump there; make the layers finer or the size field larger along these walls"
        if row == layer.count - 1 and layer.spacing is None and layer.width < FINER * h:
            return (
                f"{what}: their width is the last layer's height, because no spacing is given; do layers and size "
                "field have the same unit? Otherwise give spacing, the width along the wall"
            )
    return ""


def _size_along(rows: LayerRows, k: int, row: int, field: Field) -> float:
    """Return the median of `field` along row `row` of layer `k`; nan if that is outside of the domain."""
    feet, normals = rows.columns(k)
    places = (feet + rows.layers[k].rows[row] * normals)[:: -(-len(feet) // SAMPLE)]
    places = places[rows.domain.contains(places)]
    return float(np.median(field(places))) if len(places) else math.nan


def _prism_mismatch(prisms: LayerPrisms, k: int, field: Field) -> str:
    """Return a warning if the prisms of layer `k` are far thicker or thinner than the cells beside them."""
    layer, h = prisms.layers[k], prisms.sample(k, field, SAMPLE)
    smallest, largest = float(h.min()), float(h.max())
    if layer.thickness > THICKEST * smallest:
        return (
            f"layers[{k}] are {layer.thickness:.3g} thick where the size field is {smallest:.3g}, expected at most "
            f"{THICKEST:g} times as much, as all cells beside them are compressed; use fewer or thinner layers"
        )
    if largest > FLATTEST * layer.height:
        return (
            f"layers[{k}] have a first height of {layer.height:.3g} where the size field is {largest:.3g}: OpenFOAM's "
            f"checkMesh rejects cells more than {FLATTEST:g} times as wide as high; use a larger height, or smaller "
            "sizes there"
        )
    if layer.heights[-1] < THINNEST * smallest:
        return (
            f"the last of layers[{k}] is {layer.heights[-1]:.3g} high beside cells of {smallest:.3g}, where sizes "
            "jump; use more layers, or a larger growth"
        )
    return ""
