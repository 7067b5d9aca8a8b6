"""Solids from others: the region around a body, several solids as one, and booleans by manifold3d."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...arguments import warn
from ...errors import InputError, MismatchWarning, MissingLibraryError
from ..triangles import NamedTriangles

if TYPE_CHECKING:
    from .solid import Solid

_ON_SIDE = 1e-9
"""Distance of vertices of a body from a side of its box, over the extent of the box, up to which they are on it."""
_LARGER = 10
"""A body that is so many times as long as its box along all axes is probably in another unit."""


def named_triangles(solid: Solid) -> NamedTriangles:
    """Return the surface of a solid with its names as groups."""
    names, surface = solid.boundaries, solid.surface
    return NamedTriangles(surface.vertices, surface.triangles, names.index[solid.patch].astype(np.int64), names.names)


def around(body: Solid, box: Solid) -> NamedTriangles:
    """Return the surface of the region of a box around a body.

    Names of the body that a side of the box has get the prefix ``body-``.
    """
    vertices, triangles, _, names = own = named_triangles(body)
    groups = own.numbers(names)
    outside = (body.shell_volumes > 0)[body.shells[1]]
    sides = box.boundary_names
    names = [f"body-{name}" if name in sides else name for name in names]
    inside = (np.array(body.lower) > box.lower).all() and (np.array(body.upper) < box.upper).all()
    if inside:
        turned = triangles[outside][:, ::-1]
        return NamedTriangles.merged([named_triangles(box), NamedTriangles(vertices, turned, groups[outside], names)])
    if not ((np.array(body.upper) > box.lower).all() and (np.array(body.lower) < box.upper).all()):
        raise InputError(
            f"Solid.outside got a body from {body.lower} to {body.upper} and a box from {box.lower} to {box.upper}, "
            "which do not overlap; do they have the same unit? Solid.read has units="
        )
    if (body.extent > _LARGER * box.extent).all():
        warn(
            f"Solid.outside got a body from {body.lower} to {body.upper} and a box from {box.lower} to {box.upper}, of "
            "which little is left; do they have the same unit? Solid.read has units=",
            MismatchWarning,
        )
    # A body that stands on a side is on it up to round-off only.
    for side in (np.array(box.lower), np.array(box.upper)):
        vertices = np.where(np.abs(vertices - side) < _ON_SIDE * box.extent.max(), side, vertices)
    return boolean("-", named_triangles(box), NamedTriangles(vertices, triangles[outside], groups[outside], names))


def library() -> Any:
    """Return the module manifold3d.

    Raises `MissingLibraryError` if it is not installed.
    """
    try:
        import manifold3d
    except ImportError as error:
        raise MissingLibraryError(
            "booleans of solids, repair of holes and overlaps, wraps, and bodies that touch or cross their box need "
            "manifold3d; pip install 'clvoro[solids]' (or pip install manifold3d)"
        ) from error
    return manifold3d


def boolean(operation: str, *parts: NamedTriangles, simpler: float = 0.0) -> NamedTriangles:
    """Return the surface of a boolean of solids: their sum (+), common part (^), or the first without the others (-).

    Triangles become fewer where the surface moves by less than the distance `simpler`.

    Raises `MissingLibraryError` if manifold3d is not installed. Raises `InputError` if nothing is left.
    """
    manifold3d = library()
    names = tuple(dict.fromkeys(name for part in parts for name in part.names))
    start = manifold3d.Manifold.reserve_ids(len(names))
    manifolds = []
    for part in parts:
        number = part.numbers(names)
        order = np.argsort(number, kind="stable")
        used, begin = np.unique(number[order], return_index=True)
        mesh = manifold3d.Mesh64(
            np.array(part.vertices, np.float64),
            np.array(part.triangles[order], np.uint64),
            run_index=(3 * np.append(begin, len(order))).astype(np.uint64),
            run_original_id=(start + used).astype(np.uint32),
        )
        made = manifold3d.Manifold(mesh)
        if made.status() != manifold3d.Error.NoError:
            raise InputError(f"a boolean of solids got a surface that manifold3d refuses: {made.status().name}")
        manifolds.append(made)
    kinds = {"+": manifold3d.OpType.Add, "-": manifold3d.OpType.Subtract, "^": manifold3d.OpType.Intersect}
    whole = manifold3d.Manifold.batch_boolean(manifolds, kinds[operation])
    result = (whole.simplify(simpler) if simpler else whole).to_mesh64()
    if not len(result.tri_verts):
        raise InputError("a boolean of solids leaves nothing, expected a region; do the solids overlap?")
    lengths = np.diff(np.asarray(result.run_index).astype(np.int64)) // 3
    groups = np.repeat(np.asarray(result.run_original_id).astype(np.int64) - start, lengths)
    vertices, triangles = np.asarray(result.vert_properties)[:, :3], np.asarray(result.tri_verts).astype(np.int64)
    return NamedTriangles(vertices, triangles, groups, names)
