"""What is done to triangles before they bound a solid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from ...arguments import warn
from ...errors import InputError, InputTypeError, MismatchWarning
from ..boundary_names import Walls, check_word
from ..surface import Skin, Surface
from ..triangles import areas_of
from .checks import grounded, repaired, require_bounding, volume_inside
from .wrapping import kept_groups, wrapped

if TYPE_CHECKING:
    from typing_extensions import Unpack


class Preparation(TypedDict, total=False):
    """The options of `clvoro.Solid` that change its triangles, in the order in which they do."""

    join: float
    bottom: float | None
    repair: bool
    wrap: float | None
    inside: Sequence[float] | None


class ShapeOptions(TypedDict, total=False):
    """The options of `clvoro.Solid` that name and divide its boundary."""

    groups: object
    group_names: Sequence[str]
    names: Mapping[str, Walls] | None
    angle: float | None
    creases: object
    name: str | None


class SolidOptions(ShapeOptions, Preparation, total=False):
    """The options of `clvoro.Solid`."""


def prepared(
    vertices: object,
    triangles: object,
    groups: object,
    group_names: Sequence[str] | None,
    names: Mapping[str, Walls] | None,
    name: str,
    **options: Unpack[Preparation],
) -> tuple[Skin, np.ndarray]:
    """Return the surface of a solid, with one vertex for each place, and the partners of its sides (3 t,) int.

    The arguments are those of `Solid`. Raises `InputError` if one of them is wrong, or the surface bounds no region.
    Warns with `MismatchWarning` of what was done.
    """
    unknown = sorted(set(options) - set(Preparation.__annotations__))
    if unknown:
        raise InputTypeError(
            f"{name} got {unknown[0]!r}, expected an option of Solid: {', '.join(SolidOptions.__annotations__)}"
        )
    surface = Surface(vertices, triangles, name, options.get("join", 0.0))
    group = _checked_groups(name, groups, len(surface))
    known = [check_word(f"{name} group_names has", word) for word in group_names or ()]
    known += [f"group-{g}" for g in range(len(known), int(group.max()) + 1)]
    skin = Skin(surface, group, tuple(known))
    bottom, wrap, inside = options.get("bottom"), options.get("wrap"), options.get("inside")
    repair = options.get("repair", False) or bottom is not None
    if bottom is not None:
        skin = grounded(skin, bottom)
    n_given = len(skin.names)
    if repair:
        skin = repaired(skin)
    if wrap is not None:
        rest = known[0] if n_given == 1 else "wall"
        skin = wrapped(skin, wrap, inside, kept_groups(name, names, skin.names), rest)
    elif inside is not None:
        raise InputError(f"{name} has inside without wrap, expected a point in the space that a wrap bounds")
    vertices, triangles = skin.surface.welded
    whole = (triangles != np.roll(triangles, -1, axis=1)).all(axis=1)
    triangles = triangles[whole]
    twin = require_bounding(skin, vertices, triangles, repair)
    if skin.done:
        was, now = ((float(np.nansum(areas_of(x))), volume_inside(x)) for x in (surface.corners, skin.surface.corners))
        warn(
            f"{name} was repaired: {'; '.join(skin.done)}. Its area was {was[0]:.6g} and is {now[0]:.6g}, its "
            f"volume was {was[1]:.6g} and is {now[1]:.6g}",
            MismatchWarning,
        )
    return Skin(Surface(vertices, triangles, name), skin.groups[whole], skin.names, skin.done), twin


def _checked_groups(name: str, groups: object, count: int) -> np.ndarray:
    """Return the group of each triangle, (t,) int64; 0 by default."""
    if groups is None:
        return np.zeros(count, np.int64)
    array = np.asarray(groups)
    if array.shape != (count,) or array.dtype.kind not in "iu" or (array < 0).any():
        raise InputError(
            f"{name} groups have shape {array.shape} and dtype {array.dtype}, expected one number, 0 or more, for each "
            f"of the {count} triangles"
        )
    return array.astype(np.int64)
