"""A diagram as OpenFOAM describes meshes: points, faces between cells, and the boundary as patches.

In 2D the cells become one layer of prisms between two patches of type `empty`. The seams of a periodic box become
patches of type `cyclic`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ..arguments import check_number
from ..errors import InputError, InputTypeError
from ..geometry.boundary_names import Walls
from ..mesh.connectivity import (
    FaceTopology,
    cell_corners,
    face_topology,
    take_rows,
)
from ..mesh.diagram import Diagram
from .cyclic import CyclicPair, Patch, add_cyclic_faces

PatchType = Literal["wall", "patch", "symmetry", "symmetryPlane"]
"""Types of patches for `poly_mesh`."""


@dataclass(frozen=True)
class PolyMesh:
    """A mesh in the arrays of OpenFOAM's polyMesh.

    Attributes
    ----------
    points : (v, 3) float
    starts : (f + 1,) int, corners : int
        Corners of each face, counter-clockwise as seen from its neighbor or from outside.
    owner : (f,) int
        Owner of each face.
    neighbor : (inner,) int
        Neighbor of each inner face; owner < neighbor. Inner faces come first, in upper-triangular order: by owner, then
        by neighbor.
    patches : list of Patch
        The faces of the patches follow the inner faces, patch by patch.
    """

    points: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    owner: np.ndarray
    neighbor: np.ndarray
    patches: list[Patch]


def poly_mesh(
    diagram: Diagram,
    patches: Mapping[str, Walls] | None = None,
    types: Mapping[str, PatchType] | None = None,
    thickness: float | None = None,
) -> PolyMesh:
    """Describe `diagram` for OpenFOAM; faces without measure and points without a face are left out.

    The patches are the boundaries of the domain by their names, then one pair of cyclic patches for each periodic
    direction (see `cyclic`), then in 2D `back` and `front`. Cells of a periodic box are not cut at its seams.

    Parameters
    ----------
    patches : mapping, optional
        Names of patches, each with its walls: numbers, names of the domain, or a sequence of them. Walls that are not
        mentioned keep the name that the domain gives them.
    types : mapping, optional
        Type of each patch by name: "wall", "patch", "symmetry" or "symmetryPlane". By default "wall".
    thickness : float, optional
        In 2D: height of the prisms, whose bottoms are at z = 0. By default the mean width of a cell.

    Raises
    ------
    InputError, InputTypeError
        If `patches` names walls that do not exist, or a wall twice; if `types` names a patch or type that does not
        exist; if `thickness` is not positive, or given in 3D; if a name is that of a cyclic or empty patch; or for a
        cell around an island, as a face of OpenFOAM has no hole.
    """
    domain = diagram.domain
    parts = domain.boundaries if patches is None else domain.boundaries.renamed("patches", patches)
    kinds = _kinds(parts.names, types)
    faces = _by_group(face_topology(diagram), parts.index)
    walls = -1 - faces.neighbor[faces.inner :]
    counts = np.bincount(parts.index[walls], minlength=len(parts.names)).tolist()
    made = [Patch(*patch) for patch in zip(parts.names, kinds, counts, strict=True)]
    pairs: list[CyclicPair] = []
    if any(domain.periodic):
        faces, pairs = add_cyclic_faces(diagram, faces)
    owner, neighbor = faces.owner, faces.neighbor[: faces.inner]
    if domain.dim == 2:
        height = _height(diagram, thickness)
        points, starts, corners = _extruded(diagram, faces.corners, height)
    elif thickness is not None:
        raise InputError(
            "thickness is for meshes in 2D, and the mesh has 3 dimensions; leave it out"
        )
    else:
        points, starts, corners = diagram.vertices, faces.starts, faces.corners
    first = len(owner) - 2 * sum(pair.size for pair in pairs)
    for pair in pairs:
        corners = pair.align(points, starts, corners, first)
        made += pair.patches()
        first += 2 * pair.size
    if domain.dim == 2:
        owner = np.concatenate([owner, *2 * [np.arange(len(diagram))]])
        made += [Patch("back", "empty", len(diagram)), Patch("front", "empty", len(diagram))]
    own = {patch.name for patch in made[len(parts.names) :]}
    clash = [name for name in parts.names if name in own]
    if clash:
        raise InputError(
            f"the boundary {clash[0]!r} has the name of a patch that OpenFOAM needs here; choose another name"
        )
    used, corners = np.unique(corners, return_inverse=True)
    return PolyMesh(points[used], starts, corners.ravel(), owner, neighbor, made)


def _kinds(names: tuple[str, ...], types: Mapping[str, PatchType] | None) -> list[str]:
    """Return the type of each patch."""
    known = get_args(PatchType)
    given = {} if types is None else types
    if not isinstance(given, Mapping):
        raise InputTypeError(
            f"types is {types!r:.60} of type {type(types).__name__}, expected a mapping from names of patches to "
            "types, such as {'inlet': 'patch'}"
        )
    for name, kind in given.items():
        if name not in names:
            raise InputError(
                f"types has {name!r:.60}, expected names of patches: {', '.join(names)}"
            )
        if kind not in known:
            raise InputError(
                f"types has {kind!r:.60} for {name}, expected one of {', '.join(known)}"
            )
    return [given.get(name, "wall") for name in names]


def _height(diagram: Diagram, thickness: float | None) -> float:
    if thickness is None:
        return float(np.sqrt(diagram.domain.measure / len(diagram)))
    return check_number("thickness", thickness, above=0)


def _by_group(faces: FaceTopology, groups: np.ndarray) -> FaceTopology:
    """Return `faces` with the faces on the boundary sorted by the group of their wall."""
    outer = np.argsort(groups[-1 - faces.neighbor[faces.inner :]], kind="stable") + faces.inner
    if (np.diff(outer) > 0).all():
        return faces
    order = np.concatenate([np.arange(faces.inner), outer])
    starts, corners = take_rows(faces.starts, faces.corners, order)
    return FaceTopology(
        faces.owner[order],
        faces.neighbor[order],
        faces.rows[order],
        starts,
        corners,
        faces.flipped[order],
    )


def _extruded(
    diagram: Diagram, sides: np.ndarray, thickness: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, and starts and corners of the faces of prisms: sides, then bottoms, then tops."""
    flat, v = diagram.vertices, len(diagram.vertices)
    points = np.concatenate([np.pad(flat, ((0, 0), (0, 1))), np.pad(flat, ((0, 0), (0, 1)))])
    points[v:, 2] = thickness
    a, b = sides.reshape(-1, 2).T
    walls = np.stack([a, b, b + v, a + v], axis=1)
    starts, corners = cell_corners(diagram)
    everyone = np.arange(len(diagram))
    key = np.sort(np.repeat(everyone, np.diff(starts)) * v + corners)
    twice = key[1:][np.diff(key) == 0] // max(v, 1)
    if twice.size:
        raise InputError(
            f"cell {twice[0]} ({len(np.unique(twice))} in all) goes around a part of the boundary or touches itself, "
            "and a face in OpenFOAM has no hole; use smaller cells there, leave out the hole, or save as .vtu"
        )
    _, bottoms = take_rows(starts, corners, everyone, np.ones(len(diagram), bool))
    lengths = np.concatenate([np.full(len(walls), 4), np.diff(starts), np.diff(starts)])
    return (
        points,
        np.concatenate([[0], np.cumsum(lengths)]),
        np.concatenate([walls.ravel(), bottoms, corners + v]),
    )
