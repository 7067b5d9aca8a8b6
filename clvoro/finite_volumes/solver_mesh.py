"""The mesh as a solver sees it: straight walls, short faces collapsed."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from ..arguments import check_choice, warn
from ..errors import MismatchWarning
from ..geometry.polygon import Polygon
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from .seams import faces_with_seams

_ROUNDS = 8
"""Largest number of attempts to improve rejected cells."""
_LARGE_CHANGE = 0.01
"""Change of the domain's area, as a share of it, beyond which there is a warning."""

WallShape = Literal["straight", "exact"]
"""What the wall faces of one cell become: one straight face, or as many as the domain has edges there."""


def make_solver_mesh(
    diagram: Diagram, walls: WallShape = "straight", collapse: bool = True, parts: np.ndarray | None = None
) -> Faces:
    """Return `diagram` as a solver sees it; see `Diagram.solver_mesh`.

    The diagram keeps meshes with `collapse`, which take the longest, so that one is made once to be checked and saved.
    `parts` (k,) int is the index of the named part of the boundary of each wall, if it is not the domain's.
    """
    check_choice("walls", walls, ("straight", "exact"))
    diagram.demand_cells("solver_mesh")
    diagram.domain.require_flat(
        "meshes for solvers have cells in the plane or polyhedra",
        "use the diagram itself, as diagram.faces, or a file with walls='exact'",
    )
    parts = diagram.domain.boundaries.index if parts is None else parts
    if not collapse:
        return _made(diagram, walls, collapse, parts)
    kept: dict[tuple[str, bytes], Faces] = vars(diagram).setdefault("_solver_meshes", {})
    key = ("" if diagram.domain.outline is None else walls, parts.tobytes())
    if key not in kept:
        kept[key] = _made(diagram, walls, collapse, parts)
    return kept[key]


def _made(diagram: Diagram, walls: WallShape, collapse: bool, parts: np.ndarray) -> Faces:
    """Take the faces of `diagram`, or make straight walls, and collapse short faces."""
    outline = diagram.domain.outline if walls == "straight" else None
    if outline is None:
        mesh = faces_with_seams(diagram)
        points = mesh.points.astype(np.float64, copy=False)
        if mesh.diagram is not None or points is not mesh.points:
            mesh = replace(mesh, points=points, diagram=None)
        return _COLLAPSED[mesh.dim](mesh, diagram, parts, collapse)
    mesh = _in_polygon(diagram, outline, parts, collapse)
    found = []
    if len(mesh.left_out):
        found.append(str(mesh.left_out))
    if abs(mesh.area_change) > _LARGE_CHANGE:
        found.append(f"changes the area of the domain by {100 * mesh.area_change:+.2g} %")
    if found:
        warn(
            f"the mesh for solvers {', and '.join(found)}. Use smaller cells there, or drop what is smaller than a "
            "cell first, as domain.simplified(size) does",
            MismatchWarning,
        )
    return mesh


def _in_polygon(diagram: Diagram, outline: Polygon, parts: np.ndarray, collapse: bool) -> Faces:
    """Return the mesh with straight walls: cells divided anew where OpenFOAM would reject them."""
    from .redivision import redivide
    from .short_edges import collapse_short_edges
    from .walls import straight_walls

    mesh = straight_walls(diagram, outline, parts)
    if not collapse:
        return mesh.compact()
    return redivide(collapse_short_edges(mesh, parts).compact(), parts)


def _collapsed_polygons(mesh: Faces, diagram: Diagram, parts: np.ndarray, collapse: bool) -> Faces:
    from .short_edges import collapse_short_edges

    del diagram
    return (collapse_short_edges(mesh, parts) if collapse else mesh).compact()


def _collapsed_polyhedra(mesh: Faces, diagram: Diagram, parts: np.ndarray, collapse: bool) -> Faces:
    from .collapse import collapse_short, find_suspects
    from .solid_walls.mend import spoiled_near_walls, with_neighbors

    del parts
    corners = mesh.corners.astype(np.int32, copy=False)
    if corners is not mesh.corners:
        mesh = replace(mesh, corners=corners)
    # What short edges may become depends on the sides of a box; those of layers are wanted.
    whole = mesh.domain.uncut is mesh.domain and mesh.layer is None
    if not collapse or not whole:
        return mesh.compact()
    known = diagram.faces.diagram
    suspects = find_suspects(mesh, known)
    made = collapse_short(mesh, known, suspects=suspects)
    if known is not None:  # Voronoi cells are convex
        return made
    # Where OpenFOAM would reject collapsed cells at a surface, these and their neighbors stay as they are.
    held = np.zeros(mesh.n_cells, bool)
    for _ in range(_ROUNDS):
        rejected = spoiled_near_walls(mesh, made) & ~held
        if not rejected.any():
            break
        held |= with_neighbors(mesh, rejected)
        free = ~(held[mesh.owner] | held[np.maximum(mesh.neighbor, 0)])
        made = collapse_short(mesh, None, chosen=free, suspects=suspects)
    return made


_COLLAPSED = {2: _collapsed_polygons, 3: _collapsed_polyhedra}
