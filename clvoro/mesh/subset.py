"""Meshes from which cells are removed."""

from __future__ import annotations

import dataclasses
from typing import TypeVar, cast

import numpy as np

from ..arguments import format_point, warn
from ..connectivity import starts_of, take_rows, used_indices
from ..errors import InputError, InputTypeError, MismatchWarning
from ..geometry.domain import Domain
from ..geometry.subdomain import COAST, SphereRegion, Subdomain
from ..geometry.surface import Surface
from .diagram import Diagram
from .results import Result, figures

Mesh = TypeVar("Mesh", Result, Diagram)


def take_subset(mesh: Mesh, keep: object, boundary: str | np.ndarray) -> Mesh:
    """Return `mesh` without the cells where `keep` is False; see `MeshOutput.subset`."""
    diagram = mesh.diagram if isinstance(mesh, Result) else mesh
    diagram.demand_voronoi("subset")
    shape = isinstance(keep, Domain | Surface)
    kept = _within(keep, diagram) if shape else check_mask("keep", keep, len(diagram))
    if not kept.any():
        raise InputError(
            f"keep selects none of the {len(kept)} cells, expected at least one that is True; is it the opposite mask?"
        )
    if kept.all():
        return mesh
    part = _kept(diagram, kept, boundary)
    if not isinstance(mesh, Result):
        return cast("Mesh", part)
    reason = f"{len(part)} of {len(kept)} cells; {mesh.stop_reason}"
    return cast("Mesh", dataclasses.replace(_result_of(mesh, part, kept), stop_reason=reason))


def _within(shape: Domain | Surface, diagram: Diagram) -> np.ndarray:
    """Return which generators of `diagram` lie inside of `shape`, (n,) bool.

    Raises `InputError` if it has another dimension than the mesh.
    """
    domain = diagram.domain
    if shape.dim != domain.dim:
        remedy = _OTHER_SHAPES[domain.dim] if domain.globe is None else "clvoro.earth.inside(mesh, keep)"
        raise InputError(
            f"keep is a {type(shape).__name__} with {shape.dim} coordinates, expected {domain.dim}, as the mesh has; "
            f"pass {remedy}"
        )
    return shape.contains(diagram.points)


_OTHER_SHAPES = {2: "a shape in the plane", 3: "keep.contains(mesh.points[:, :2])"}


def _result_of(mesh: Result, part: Diagram, kept: np.ndarray) -> Result:
    """Return `mesh` with the diagram `part`, which has the cells `kept` (n,) bool."""
    taken = {name: getattr(mesh, name)[kept] for name in ("target_size", "size_error", "quality")}
    origin = None if mesh.origin is None else mesh.origin[kept]
    history = mesh.history.copy()
    if len(history):
        last = {"cells": len(part), "deleted": history["deleted"][-1] + np.count_nonzero(~kept)}
        for name, value in (last | figures(taken["size_error"], taken["quality"])).items():
            history[name][-1] = value
    more = {"origin": origin, "history": history, "initial": None, "final": None, "parts": None}
    return dataclasses.replace(mesh, points=part.points, diagram=part, **taken, **more)


def without_holes(mesh: Result) -> Result:
    """Return `mesh` without the cells in the holes of its domain; faces on a hole have its name."""
    holes = None if mesh.parts else mesh.diagram.domain.holes
    if holes is None:
        return mesh
    inside = holes.hole_of(mesh.points)
    made = _result_of(mesh, _kept(mesh.diagram, inside < 0, holes.names_of(inside)), inside < 0)
    faces, domain = made.diagram.faces, made.diagram.domain
    cut = np.flatnonzero(faces.neighbor < 0)
    cut = cut[domain.removed_behind(-1 - faces.neighbor[cut])]
    ends = faces.points[faces.corners.reshape(-1, 2)[cut]]
    off = cut[~holes.covers(domain.uncut, ends)]
    if len(off):
        warn(
            f"{len(off)} faces around holes do not lie on their outlines, the first at "
            f"{format_point(faces.center[off[0]])}; use smaller sizes there",
            MismatchWarning,
        )
    return made


def check_mask(name: str, mask: object, n: int) -> np.ndarray:
    """Return `mask` as an array of n bool.

    Raises `InputError` or `InputTypeError` if it has another length or shape, or other values.
    """
    array = np.asarray(mask)
    if array.dtype != bool:
        remedy = "; for the cells in a shape pass clvoro.Polygon.from_shapely(shape).contains(mesh.points)"
        remedy = f"; write {name} == 1, or use np.isin" if array.dtype.kind in "iuf" else remedy
        raise InputTypeError(f"{name} has dtype {array.dtype}, expected an array of {n} bool, one per cell{remedy}")
    if array.shape != (n,):
        grid = "; for a mask on a grid pass a function of longitude and latitude that looks it up"
        raise InputError(
            f"{name} has shape {array.shape}, expected ({n},): one bool per cell{grid if array.ndim == 2 else ''}"
        )
    return array


def _kept(d: Diagram, kept: np.ndarray, boundary: str | np.ndarray) -> Diagram:
    """Return the kept cells; faces towards removed cells become walls of a `Subdomain`.

    `boundary` is the name of these walls, or one for each cell that is removed, (n,) object.
    """
    number, owner = np.cumsum(kept) - 1, d.half_faces.owner
    faces = np.flatnonzero(kept[owner])
    behind = d.neighbors[faces]
    whole = d.domain.uncut
    w = len(whole.boundary_index)
    lost = (behind >= 0) & ~kept[np.maximum(behind, 0)]
    cut = lost.copy()
    cut[behind < 0] = d.domain.removed_behind(-1 - behind[behind < 0])
    neighbors = np.where(behind < 0, behind, number[np.maximum(behind, 0)])
    neighbors[cut] = -1 - w - np.arange(cut.sum())
    within, beyond = d.points[owner[faces[cut]]], d.half_faces.behind(faces[cut])
    labels = np.broadcast_to(np.asarray(boundary, object), len(d))[np.maximum(behind, 0)]
    old = cut & (behind < 0)
    labels[old] = [d.domain.boundary_names[k] for k in d.domain.boundary_index[-1 - behind[old]]]
    names = _names(labels[cut].tolist(), d.domain.boundary_names, w)
    kind = Subdomain if whole.globe is None else SphereRegion
    domain = kind(whole, within, beyond, float(d.volumes[kept].sum()), names)
    shifts = np.where(cut[:, None], 0, d.shifts[faces]).astype(np.int8)
    return Diagram(domain, {**_arrays(d, kept, faces, neighbors), "shifts": shifts})


def _arrays(d: Diagram, kept: np.ndarray, faces: np.ndarray, neighbors: np.ndarray) -> dict[str, np.ndarray]:
    """Return the arrays of the cells that are `kept`, (n,) bool, with the rows `faces` and new `neighbors`, (m,)."""
    arrays = {name: getattr(d, name)[kept] for name in ("points", "volumes", "centroids")}
    arrays |= {"layer": d.layer[kept]} if d.layer.any() else {}
    arrays |= {name: getattr(d, name)[faces] for name in ("face_measures", "face_centroids")}
    arrays["neighbor_starts"] = starts_of(np.diff(d.neighbor_starts)[kept], np.int32)
    arrays["neighbors"] = neighbors.astype(np.int32)
    rows = {"cell_vertex": np.flatnonzero(kept), "face_vertex": faces}
    corners = {}
    for name, own in rows.items():
        starts = f"{name}_starts"
        if starts in d._arrays:
            arrays[starts], items = take_rows(getattr(d, starts), getattr(d, _CORNERS[name]), own)
            arrays[starts], corners[name] = arrays[starts].astype(np.int32), items
    used, renumbered = used_indices(np.concatenate([*corners.values()]), len(d.vertices))
    parts = np.split(renumbered, np.cumsum([len(c) for c in corners.values()])[:-1])
    arrays |= {_CORNERS[name]: part for name, part in zip(corners, parts, strict=True)}
    return {**arrays, "vertices": d.vertices[used]}


_CORNERS = {"cell_vertex": "cell_vertices", "face_vertex": "face_vertices"}


def _names(labels: list[str], before: tuple[str, ...], first: int) -> dict[str, list[int]] | None:
    """Return the walls of each name but the default one, numbered from `first` on; names in `before` come first."""
    names: dict[str, list[int]] = {name: [] for name in (*before, *labels)}
    for k, label in enumerate(labels):
        names[label].append(first + k)
    return {name: walls for name, walls in names.items() if walls and name != COAST} or None
