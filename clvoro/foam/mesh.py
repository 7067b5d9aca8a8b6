"""The mesh of a case: its cells and patches as OpenFOAM sees them, and its boundary as a domain."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..finite_volumes.solid_walls.mesh import diagram_of
from ..geometry.domain import Domain
from ..geometry.polygon import Polygon
from ..geometry.rings import signed_area
from ..geometry.solid.solid import Solid
from ..io.arrays import FileError, explained
from ..io.foam_read import FoamFile, FoamPatchFaces, count_cells
from ..mesh.diagram import Diagram
from ..mesh.faces import Faces
from ..mesh.geometry import cell_geometry, face_geometry
from .case import has_file


@dataclass(frozen=True)
class FoamMesh:
    """A polyMesh.

    Attributes
    ----------
    points : (v, 3) float64
    starts, corners : (f + 1,), (k,) int64
        Corners of the faces.
    owner, neighbor : (f,), (i,) int64
        Cells of each face; inner faces come first.
    patches : list
        Name, kind, and faces of each part of the boundary.
    n_cells : int
        Number of cells.
    zones : dict of str to (k,) int64
        Cells of each zone of cells.
    lost_zones : tuple of str
        Zones of faces and of points.
    """

    points: np.ndarray
    starts: np.ndarray
    corners: np.ndarray
    owner: np.ndarray
    neighbor: np.ndarray
    patches: list[FoamPatchFaces]
    n_cells: int
    zones: dict[str, np.ndarray] = field(default_factory=dict)
    lost_zones: tuple[str, ...] = ()

    @classmethod
    def read(cls, folder: Path) -> FoamMesh:
        """Read a folder ``polyMesh``.

        Raises
        ------
        InputError
            If a file is missing or damaged, or there is no boundary.
        """
        with explained(folder, "the files points, faces, owner, neighbour and boundary"):
            points = FoamFile.read(folder, "points").vectors()
            starts, corners = FoamFile.read(folder, "faces").rows()
            owner = FoamFile.read(folder, "owner").labels()
            neighbor = FoamFile.read(folder, "neighbour").labels()
            patches = FoamFile.read(folder, "boundary").patches()
            if not any(len(patch.faces) for patch in patches if patch.kind != "empty"):
                raise FileError("its boundary has no patch with faces, expected walls, inlets, ...")
            n_cells = count_cells(points, starts, corners, owner, neighbor)
            listed = np.sort(np.concatenate([patch.faces for patch in patches]))
            if not np.array_equal(listed, np.arange(len(neighbor), len(owner))):
                raise FileError(
                    f"its patches have {len(listed)} faces, the boundary {len(owner) - len(neighbor)}, expected each "
                    "of them in one patch"
                )
            names = [patch.name for patch in patches]
            twice = [name for name in names if names.count(name) > 1]
            if twice:
                raise FileError(f"it has two patches {twice[0]}, expected one for each name")
            zones = _zones(folder, "cellZones")
            if any(not ((rows >= 0) & (rows < n_cells)).all() for rows in zones.values()):
                raise FileError(f"its zones have cells beyond {n_cells}, expected those of the mesh")
            lost = (*_zones(folder, "faceZones"), *_zones(folder, "pointZones"))
            return cls(points, starts, corners, owner, neighbor, patches, n_cells, zones, lost)

    @cached_property
    def faces(self) -> tuple[np.ndarray, np.ndarray]:
        """Centers and area vectors of the faces, (f, 3) each; these point out of the owner."""
        return face_geometry(self.points, self.starts, self.corners)

    @cached_property
    def _cells(self) -> tuple[np.ndarray, np.ndarray]:
        """Centroids and volumes."""
        return cell_geometry(*self.faces, self.owner, self.neighbor, self.n_cells)

    @property
    def volumes(self) -> np.ndarray:
        """Volumes of the cells, (n,)."""
        return self._cells[1]

    @property
    def centroids(self) -> np.ndarray:
        """Centroids of the cells, (n, 3)."""
        return self._cells[0]

    @cached_property
    def is_plane(self) -> bool:
        """Whether it is one layer of cells between empty patches, normal to z."""
        flat = [patch.faces for patch in self.patches if patch.kind == "empty" and len(patch.faces)]
        return (
            bool(flat)
            and len(np.concatenate(flat)) == 2 * self.n_cells
            and bool(np.abs(self.faces[1][np.concatenate(flat), :2]).max() < 1e-6 * np.abs(self.faces[1]).max())
        )

    @property
    def thickness(self) -> float | None:
        """Height of the layer of cells; None in space."""
        return float(np.ptp(self.points[:, 2])) if self.is_plane else None

    @property
    def types(self) -> dict[str, str]:
        """Types of the patches with faces, without those of the layer and of seams."""
        return {patch.name: patch.kind for patch in self.patches if patch.kind not in ("empty", "cyclic")}

    def keep_groups(self, boundary: Path) -> None:
        """Write the groups of the patches into the file `boundary` of another mesh with the same patches."""
        text = boundary.read_text()
        for patch in self.patches:
            if patch.groups:
                entry = f"inGroups {len(patch.groups)}({' '.join(patch.groups)});"
                text = re.sub(rf"(?m)^(\s*{re.escape(patch.name)}\s*\{{)", rf"\1\n        {entry}", text)
        boundary.write_text(text)

    def domain(self) -> Domain:
        """Return the inside of the boundary: a polygon, or a solid. Boundaries have the names of the patches.

        Raises
        ------
        InputError
            If patches are of a kind that these domains lack, such as cyclic or wedge; or the boundary is not closed.
        """
        known = ("wall", "patch", "symmetry", "symmetryPlane")
        other = [f"{p.name} ({p.kind})" for p in self.patches if p.kind not in (*known, "empty") and len(p.faces)]
        if other:
            raise InputError(
                f"the case has patches {', '.join(other)}, expected types {', '.join(known)}, or one layer of cells "
                "between empty patches; wedges, baffles and other pairs of patches cannot be adapted, cyclic "
                "seams can if clvoro made the mesh: pass it as mesh="
            )
        if self.is_plane:
            return self._polygon()
        flat = [p.name for p in self.patches if p.kind == "empty" and len(p.faces)]
        if flat:
            raise InputError(
                f"the empty patches {', '.join(flat)} do not bound one layer of cells normal to z, expected that; turn "
                'the case, from y by transformPoints -rotate "((0 1 0) (0 0 1))" -rotateFields'
            )
        return self._solid()

    def diagram(self, domain: Domain) -> Diagram:
        """Return the mesh in space as a diagram: its generators are the centroids of the cells."""
        names = list(domain.boundary_names)
        neighbor = np.full(len(self.owner), -1)
        neighbor[: len(self.neighbor)] = self.neighbor
        for patch in self.patches:
            if len(patch.faces):
                neighbor[patch.faces] = -1 - np.flatnonzero(domain.boundary_index == names.index(patch.name))[0]
        none, still = np.full(len(neighbor), -1), np.zeros((len(neighbor), 3), np.int8)
        return diagram_of(
            Faces(
                domain, self.centroids, self.points, self.starts, self.corners, self.owner, neighbor, none, still, none
            )
        )

    def _polygon(self) -> Polygon:
        ends, names = [], []
        low = self.points[:, 2] < self.points[:, 2].mean()
        for patch in self.patches:
            if patch.kind == "empty":
                continue
            for face in patch.faces.tolist():
                corners = self.corners[self.starts[face] : self.starts[face + 1]]
                below = corners[low[corners]]
                if len(below) != 2:
                    raise InputError(f"face {face} of patch {patch.name} is not one edge high; pass mesh=")
                ends.append(below)
                names.append(patch.name)
        return polygon_of_edges(self.points[:, :2], np.array(ends), names)

    def _solid(self) -> Solid:
        triangles, groups = [], []
        for k, patch in enumerate(self.patches):
            for face in patch.faces.tolist():
                corners = self.corners[self.starts[face] : self.starts[face + 1]]
                fan = np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
                triangles.append(fan)
                groups += [k] * len(fan)
        used, rows = np.unique(np.concatenate(triangles), return_inverse=True)
        return Solid(self.points[used], rows.reshape(-1, 3), groups, [patch.name for patch in self.patches])


def _zones(folder: Path, name: str) -> dict[str, np.ndarray]:
    """Return the zones with cells, faces or points of a file that need not be there."""
    if not has_file(folder, name):
        return {}
    return {zone: rows for zone, rows in FoamFile.read(folder, name).zones().items() if len(rows)}


def polygon_of_edges(points: np.ndarray, ends: np.ndarray, names: list[str]) -> Polygon:
    """Return the polygon whose boundary is made of edges; straight runs of edges with one name become one edge.

    - `points`: (v, 2) float
    - `ends`: (k, 2) int

    Raises `InputError` if they do not close.
    """
    # Both sides of a baffle have vertices of their own at the same points.
    grid = (points / (1e-9 * np.ptp(points, axis=0).max())).round()
    _, first, same = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    ends = first[same.reshape(-1)[ends]]
    at: dict[int, list[int]] = {}
    for k, pair in enumerate(ends.tolist()):
        for v in pair:
            at.setdefault(v, []).append(k)
    open_ends = [v for v, edges in at.items() if len(edges) != 2]
    if open_ends:
        x, y = points[open_ends[0]]
        raise InputError(
            f"the boundary is not closed, or touches itself, at ({x:g}, {y:g}), expected rings without baffles; "
            "if clvoro made the mesh pass it as mesh="
        )
    left, rings = set(range(len(ends))), []
    while left:
        edge = min(left)
        begin, v = ends[edge].tolist()
        ring = [(begin, names[edge])]
        left.discard(edge)
        while v != begin:
            edge = next(k for k in at[v] if k != edge)
            left.discard(edge)
            ring.append((v, names[edge]))
            a, b = ends[edge].tolist()
            v = b if a == v else a
        rings.append(_without_straight_corners(points, ring))
    rings.sort(key=lambda ring: -abs(signed_area(points[[v for v, _ in ring]])))
    every = [name for ring in rings for _, name in ring]
    edges = {name: [k for k, other in enumerate(every) if other == name] for name in dict.fromkeys(names)}
    made = [points[[v for v, _ in ring]] for ring in rings]
    return Polygon(made[0], made[1:], names=edges)


def _without_straight_corners(points: np.ndarray, ring: list[tuple[int, str]]) -> list[tuple[int, str]]:
    """Return the ring without the corners between two edges of one name on one line."""
    x = points[[v for v, _ in ring]]
    before, after = x - np.roll(x, 1, axis=0), np.roll(x, -1, axis=0) - x
    turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    kept = [k for k, (_, name) in enumerate(ring) if abs(turn[k]) > 1e-7 * size[k] or name != ring[k - 1][1]]
    return [ring[k] for k in kept] if len(kept) > 2 else ring
