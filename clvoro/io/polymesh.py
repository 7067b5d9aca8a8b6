"""A diagram as OpenFOAM describes meshes: points, faces between cells, and the boundary as patches.

In 2D the cells become one layer of prisms between two patches of type `empty`. The seams of a periodic box become
patches of type `cyclic`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np

from ..errors import InputError, InputTypeError
from ..finite_volumes.gate import warn_of_rejection
from ..finite_volumes.prisms import polyhedra
from ..finite_volumes.solver_mesh import WallShape, make_solver_mesh
from ..geometry.boundary_names import Walls
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from .cyclic import FoamPatch, cyclic_patches

PatchType = Literal["wall", "patch", "symmetry", "symmetryPlane"]
"""Types of patches for `poly_mesh`."""


def poly_mesh(
    diagram: Diagram,
    patches: Mapping[str, Walls] | None = None,
    types: Mapping[str, PatchType] | None = None,
    thickness: float | None = None,
    walls: WallShape = "straight",
) -> tuple[Faces, list[FoamPatch], float]:
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
    walls : {"straight", "exact"}, optional
        See `Diagram.solver_mesh`.

    Returns
    -------
    Faces
        The cells as polyhedra. The faces of the patches follow those between two cells, patch by patch.
    list of Patch
    float
        `Faces.area_change` of the mesh, in 2D of its polygons.

    Raises
    ------
    InputError, InputTypeError
        If `patches` names walls that do not exist, or a wall twice; if `types` names a patch or type that does not
        exist; if `thickness` is not positive, or given in 3D; if a name is that of a cyclic or empty patch; or for a
        cell around an island, as a face of OpenFOAM has no hole.

    Warns
    -----
    MismatchWarning
        If OpenFOAM rejects the mesh in a polygon with straight walls, for a cell at a wall; says where.
    """
    domain = diagram.domain
    parts = domain.boundaries if patches is None else domain.boundaries.renamed("patches", patches)
    kinds = _kinds(parts.names, types)
    mesh = make_solver_mesh(diagram, walls, walls == "straight", parts.index)
    cells = polyhedra(mesh, thickness)
    if domain.outline is not None and walls == "straight":
        warn_of_rejection(mesh)
    groups = parts.index[-1 - mesh.neighbor[mesh.n_inner : mesh.n_outer]]
    counts = np.bincount(groups, minlength=len(parts.names)).tolist()
    made = [FoamPatch(*patch) for patch in zip(parts.names, kinds, counts, strict=True)]
    made += cyclic_patches(mesh)
    if len(cells) > len(mesh):
        made += [FoamPatch("back", "empty", mesh.n_cells), FoamPatch("front", "empty", mesh.n_cells)]
    own = {patch.name for patch in made[len(parts.names) :]}
    clash = [name for name in parts.names if name in own]
    if clash:
        raise InputError(
            f"the boundary {clash[0]!r} has the name of a patch that OpenFOAM needs here; choose another name"
        )
    order = np.arange(len(cells))
    order[mesh.n_inner : mesh.n_outer] = mesh.n_inner + np.argsort(groups, kind="stable")
    return cells.take_faces(order), made, mesh.area_change


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
            raise InputError(f"types has {name!r:.60}, expected names of patches: {', '.join(names)}")
        if kind not in known:
            raise InputError(f"types has {kind!r:.60} for {name}, expected one of {', '.join(known)}")
    return [given.get(name, "wall") for name in names]
