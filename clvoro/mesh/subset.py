"""Meshes from which cells are removed."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import TypeVar, cast

import numpy as np

from ..errors import InputError, InputTypeError
from ..geometry.domain import Domain
from ..geometry.sphere import COAST, Sphere, SphereRegion
from ..geometry.subdomain import Subdomain
from .connectivity import face_owners, neighbor_points, take_rows
from .diagram import Diagram
from .results import HISTORY_DTYPE, Result

Mesh = TypeVar("Mesh", Result, Diagram)


def take_subset(mesh: Mesh, keep: object, boundary: str) -> Mesh:
    """Return `mesh` without the cells where `keep` is False; see `MeshOutput.subset`."""
    diagram = mesh.diagram if isinstance(mesh, Result) else mesh
    diagram.demand_voronoi("subset")
    kept = keep.contains(diagram.points) if isinstance(keep, Domain) else check_mask("keep", keep, len(diagram))
    if not kept.any():
        raise InputError(
            f"keep selects none of the {len(kept)} cells, expected at least one that is True; is it the opposite mask?"
        )
    if kept.all():
        return mesh
    globe = diagram.domain.globe
    make = _in_space if globe is None else partial(_on_sphere, sphere=globe)
    part = make(diagram, kept, boundary)
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


def _in_space(d: Diagram, kept: np.ndarray, boundary: str) -> Diagram:
    """Return the kept cells in a box or polygon; faces towards removed cells become walls of a `Subdomain`."""
    number, owner = np.cumsum(kept) - 1, face_owners(d)
    faces = np.flatnonzero(kept[owner])
    behind = d.neighbors[faces]
    whole = d.domain.uncut
    w = len(whole.boundary_index)
    lost = (behind >= 0) & ~kept[np.maximum(behind, 0)]
    cut = lost.copy()
    cut[behind < 0] = d.domain.removed_behind(-1 - behind[behind < 0])
    neighbors = np.where(behind < 0, behind, number[np.maximum(behind, 0)])
    neighbors[cut] = -1 - w - np.arange(cut.sum())
    within, beyond = d.points[owner[faces[cut]]], neighbor_points(d, faces[cut])
    labels = np.full(len(behind), boundary, object)
    old = cut & (behind < 0)
    labels[old] = [d.domain.boundary_names[k] for k in d.domain.boundary_index[-1 - behind[old]]]
    domain = Subdomain(whole, within, beyond, float(d.volumes[kept].sum()), _names(labels[cut].tolist(), w))
    arrays = {name: getattr(d, name)[kept] for name in ("points", "volumes", "centroids")}
    arrays |= {name: getattr(d, name)[faces] for name in ("shifts", "face_measures", "face_centroids")}
    arrays["shifts"] = np.where(cut[:, None], 0, arrays["shifts"]).astype(np.int8)
    arrays["neighbor_starts"] = np.concatenate([[0], np.cumsum(np.diff(d.neighbor_starts)[kept])]).astype(np.int32)
    arrays["neighbors"] = neighbors.astype(np.int32)
    rows = {"cell_vertex": np.flatnonzero(kept), "face_vertex": faces}
    corners = {}
    for name, own in rows.items():
        starts = f"{name}_starts"
        if starts in d._arrays:
            arrays[starts], items = take_rows(getattr(d, starts), getattr(d, _CORNERS[name]), own)
            arrays[starts], corners[name] = arrays[starts].astype(np.int32), items
    used, renumbered = np.unique(np.concatenate([*corners.values()]), return_inverse=True)
    parts = np.split(renumbered.ravel().astype(np.int32), np.cumsum([len(c) for c in corners.values()])[:-1])
    arrays |= {_CORNERS[name]: part for name, part in zip(corners, parts, strict=True)}
    return Diagram(domain, {**arrays, "vertices": d.vertices[used]})


_CORNERS = {"cell_vertex": "cell_vertices", "face_vertex": "face_vertices"}


def _on_sphere(d: Diagram, kept: np.ndarray, boundary: str, sphere: Sphere) -> Diagram:
    """Return the kept cells; faces towards removed cells become faces on the boundary."""
    number = np.cumsum(kept) - 1
    owner = face_owners(d)
    faces = np.flatnonzero(kept[owner])
    behind = d.neighbors[faces]
    lost = (behind >= 0) & ~kept[np.maximum(behind, 0)]
    former, removed = np.unique(-1 - behind[behind < 0]), np.unique(behind[lost])
    neighbors = np.where(
        behind < 0,
        -1 - np.searchsorted(former, -1 - behind),
        np.where(lost, -1 - len(former) - np.searchsorted(removed, behind), number[np.maximum(behind, 0)]),
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


def _names(labels: list[str], first: int = 0) -> dict[str, list[int]] | None:
    """Return the numbers of walls by name, from `first` on, without those of the default name."""
    names: dict[str, list[int]] = {}
    for k, label in enumerate(labels):
        if label != COAST:
            names.setdefault(label, []).append(first + k)
    return names or None
