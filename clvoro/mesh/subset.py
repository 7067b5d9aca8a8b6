"""Meshes on a sphere from which cells are removed."""

from __future__ import annotations

import dataclasses
from typing import TypeVar, cast

import numpy as np

from ..errors import InputError, InputTypeError
from ..geometry.sphere import Sphere
from ..geometry.sphere_region import COAST, SphereRegion
from .connectivity import face_owners
from .diagram import Diagram
from .results import HISTORY_DTYPE, Result

Mesh = TypeVar("Mesh", Result, Diagram)


def take_subset(mesh: Mesh, keep: object, boundary: str) -> Mesh:
    """Return `mesh` without the cells where `keep` is False; see `MeshOutput.subset`."""
    diagram = mesh.diagram if isinstance(mesh, Result) else mesh
    if diagram.domain.globe is None:
        raise InputError(
            f"subset() is for meshes on a sphere, and this one is in {diagram.domain}; for another domain make a new "
            "mesh in a clvoro.Polygon with holes"
        )
    kept = check_mask("keep", keep, len(diagram))
    if not kept.any():
        raise InputError(
            f"keep selects none of the {len(kept)} cells, expected at least one that is True; is it the opposite mask?"
        )
    if kept.all():
        return mesh
    part = _subset_diagram(diagram, diagram.domain.globe, kept, boundary)
    if not isinstance(mesh, Result):
        return cast("Mesh", part)
    taken = {name: getattr(mesh, name)[kept] for name in ("target_size", "size_error", "quality")}
    made = dataclasses.replace(
        mesh,
        points=part.points,
        diagram=part,
        **taken,
        history=np.zeros(0, HISTORY_DTYPE),
        stop_reason=f"{len(part)} of {len(kept)} cells; {mesh.stop_reason}",
        initial=None,
        final=None,
        origin=None if mesh.origin is None else mesh.origin[kept],
    )
    return cast("Mesh", made)


def check_mask(name: str, mask: object, n: int) -> np.ndarray:
    """Return `mask` as an array of n bool.

    Raises
    ------
    InputError, InputTypeError
        If it has another length or shape, or other values.
    """
    array = np.asarray(mask)
    if array.dtype != bool:
        remedy = f"; write {name} == 1, or use np.isin" if array.dtype.kind in "iuf" else ""
        raise InputTypeError(f"{name} has dtype {array.dtype}, expected an array of {n} bool, one per cell{remedy}")
    if array.shape != (n,):
        grid = "; for a mask on a grid pass a function of longitude and latitude that looks it up"
        raise InputError(
            f"{name} has shape {array.shape}, expected ({n},): one bool per cell{grid if array.ndim == 2 else ''}"
        )
    return array


def _subset_diagram(d: Diagram, sphere: Sphere, kept: np.ndarray, boundary: str) -> Diagram:
    """Return the kept cells; faces towards removed cells become faces on the boundary."""
    number = np.cumsum(kept) - 1
    owner = face_owners(d)
    faces = np.flatnonzero(kept[owner])
    behind = d.neighbors[faces]
    lost = (behind >= 0) & ~kept[behind]
    former, removed = np.unique(-1 - behind[behind < 0]), np.unique(behind[lost])
    neighbors = np.where(
        behind < 0,
        -1 - np.searchsorted(former, -1 - behind),
        np.where(lost, -1 - len(former) - np.searchsorted(removed, behind), number[behind]),
    )
    labels = [sphere.boundary_names[k] for k in sphere.boundary_index[former]]
    labels += [boundary] * len(removed)
    beyond = [d.points[removed]]
    if len(former):
        beyond.insert(0, sphere.mirrored(former, d.points[:0]))
    region = SphereRegion(
        sphere.radius,
        within=d.points[np.unique(owner[faces[neighbors < 0]])],
        beyond=np.concatenate(beyond),
        area=min(float(d.volumes[kept].sum()), Sphere(sphere.radius).measure),
        names=_names(labels),
    )
    corners = d.cell_vertices[faces]
    used, renumbered = np.unique(corners, return_inverse=True)
    starts = np.concatenate([[0], np.cumsum(np.diff(d.neighbor_starts)[kept])]).astype(np.int32)
    arrays = {
        **{name: getattr(d, name)[kept] for name in ("points", "volumes", "centroids")},
        "neighbor_starts": starts,
        "neighbors": neighbors.astype(np.int32),
        **{name: getattr(d, name)[faces] for name in ("face_measures", "face_centroids")},
        "vertices": d.vertices[used],
        "cell_vertex_starts": starts,
        "cell_vertices": renumbered.ravel().astype(np.int32),
    }
    return Diagram(region, arrays)


def _names(labels: list[str]) -> dict[str, list[int]] | None:
    """Return the numbers of walls by name, without those of the default name."""
    names: dict[str, list[int]] = {}
    for k, label in enumerate(labels):
        if label != COAST:
            names.setdefault(label, []).append(k)
    return names or None
