"""Sizes from the surface of a solid: by its curvature, and by the width of gaps and thin parts."""

from __future__ import annotations

import math

import numpy as np

from ..errors import InputError, InputTypeError
from ..geometry.solid.solid import Solid
from ..geometry.surface import Surface
from .arguments import check_positive
from .distance import Distance
from .field import Constant, Field, minimum

_STEP = math.sqrt(2)  # ratio of the sizes of neighboring classes of triangles


def curvature_size(solid: Solid, *, h_max: float, h_min: float, per_turn: float = 16.0, growth: float = 1.2) -> Field:
    """Return sizes with a number of cells around curved walls: h = 2 pi / (per_turn * curvature) on the surface.

    Away from it sizes grow. On the surface they are rounded down to steps of a factor of sqrt(2).

    Parameters
    ----------
    solid : Solid
    h_max, h_min : float
        Bounds of h. Flat walls have h_max.
    per_turn : float
        Cells on a full circle.
    growth : float
        Ratio of the sizes of neighboring cells, at least 1; see `Distance`.

    Raises
    ------
    InputError, InputTypeError
        If a number is out of range.

    Examples
    --------
    >>> part = clvoro.Solid.cylinder((0, 0, 0), (0, 0, 2), 0.5)
    >>> size = clvoro.sizing.curvature_size(part, h_min=0.02, h_max=0.3, per_turn=12)
    >>> bool(0.15 < size(np.array([(0.49, 0.0, 1.0)]))[0] < 0.3)
    True
    """
    _require_surface("curvature_size", solid)
    per_turn = check_positive("curvature_size per_turn", per_turn)
    with np.errstate(divide="ignore"):
        wanted = 2 * math.pi / (per_turn * solid.curvature)
    return _from_walls("curvature_size", solid, wanted, h_min, h_max, growth)


def gap_size(solid: Solid, *, h_max: float, h_min: float, cells: float = 3.0, growth: float = 1.2) -> Field:
    """Return sizes with a number of cells across gaps and thin parts: h = width / cells on the surface.

    Away from it sizes grow. On the surface they are rounded down to steps of a factor of sqrt(2).

    Parameters
    ----------
    solid : Solid
    h_max, h_min : float
        Bounds of h. Where the solid is wider than cells * h_max it is h_max.
    cells : float
        Cells across.
    growth : float
        Ratio of the sizes of neighboring cells, at least 1; see `Distance`.

    Raises
    ------
    InputError, InputTypeError
        If a number is out of range.

    Examples
    --------
    >>> plate = clvoro.Solid.box((0, 0, 0), (1, 1, 0.1))
    >>> size = clvoro.sizing.gap_size(plate, h_min=0.01, h_max=0.2, cells=4)
    >>> bool(0.015 < size(np.array([(0.5, 0.5, 0.0)]))[0] <= 0.025)
    True
    """
    _require_surface("gap_size", solid)
    cells, h_max = check_positive("gap_size cells", cells), check_positive("gap_size h_max", h_max)
    width = solid.widths(np.arange(len(solid.patch)), np.full(len(solid.patch), cells * h_max))
    return _from_walls("gap_size", solid, width / cells, h_min, h_max, growth)


def _require_surface(name: str, domain: object) -> None:
    if not hasattr(domain, "surface"):
        raise InputTypeError(
            f"{name} got a {type(domain).__name__}, expected a clvoro.Solid; FeatureSize is for polygons, and a box is "
            "clvoro.Solid.box(lower, upper)"
        )


def _from_walls(name: str, solid: Solid, wanted: np.ndarray, h_min: float, h_max: float, growth: float) -> Field:
    """Return sizes that grow from `wanted` (t,) on the triangles of a solid."""
    h_min, h_max = check_positive(f"{name} h_min", h_min), check_positive(f"{name} h_max", h_max)
    if h_min > h_max:
        raise InputError(f"{name} got h_min {h_min:g} and h_max {h_max:g}, expected h_min <= h_max")
    step = np.ceil(np.log(h_max / np.clip(wanted, h_min, h_max)) / math.log(_STEP) - 1e-9).astype(int)
    fields: list[Field] = [Constant(h_max)]
    for k in np.unique(step[step > 0]).tolist():
        part = Surface(solid.surface.vertices, solid.surface.triangles[step == k], name)
        fields.append(Distance(part, h_min=max(h_max / _STEP**k, h_min), growth=growth, h_max=h_max))
    return minimum(*fields) if len(fields) > 1 else fields[0]
