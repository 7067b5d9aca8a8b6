"""Surfaces inside a domain in 3D, on which faces of cells lie: borders of materials, porous zones, baffles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import cached_property
from numbers import Real
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

from ...arguments import format_point
from ...connectivity import components
from ...errors import InputError, InputTypeError
from ...files import pack_array, unpack_array
from ..borders import Borders, Size
from ..columns import Columns
from ..domain import Domain
from ..fixed_generators import FixedGenerators
from ..solid.solid import Solid
from ..surface import Surface
from ..surface_files import SOLIDS, FilePart, parts_of, read_parts, word
from .pairs import place_pairs
from .sheets import Sheets

if TYPE_CHECKING:
    from ...mesh.diagram import Diagram

_EXPECTED = (
    "a clvoro.Solid, a clvoro.sizing.Surface, a mesh of trimesh, the path of a surface file, arrays (vertices, "
    "triangles), a list of these, or a mapping from names to these"
)
_FLAT = 1 - 1e-9
"""Least cosine between the normals of a flat patch."""
_ON_WALL = 1e-7
"""Triangles whose corners are this near to the walls, over the domain's extent, lie on them."""
_SMALL = 1e-3
"""Area over the 2/3 power of the smaller cell's volume below which a face does not connect regions."""


class Surfaces(Borders):
    """Triangulated surfaces inside a domain; `Domain.with_surfaces` makes them.

    - `names`: one for each surface.
    - `surface`: all triangles, such as for `clvoro.sizing.Distance`.
    - `part` (t,) int: the surface that each triangle belongs to.
    - `angle`: in degrees; see `Solid`.
    """

    word = "surfaces"
    sheets: Sheets

    def __init__(self, source: object, angle: float = 30.0) -> None:
        if not (isinstance(angle, Real) and 0 < angle < 180):
            raise InputError(f"surfaces angle is {angle!r}, expected degrees between 0 and 180")
        parts = list(_parts(source, ""))
        if not parts:
            raise InputError(f"surfaces is empty, expected {_EXPECTED}")
        self.angle = float(angle)
        self._named = [bool(part.name) for part in parts]
        self.names = tuple(word(part.name, 0) if part.name else f"surface-{k + 1}" for k, part in enumerate(parts))
        if len(set(self.names)) < len(self.names):
            twice = next(name for name in self.names if self.names.count(name) > 1)
            raise InputError(f"surfaces has the name {twice!r} twice, expected one name for each surface")
        self.parts = [
            Surface(part.vertices, part.triangles, f"surface {n!r}") for part, n in zip(parts, self.names, strict=True)
        ]
        counts = np.cumsum([0, *(len(p.vertices) for p in self.parts)])
        whole = Surface(
            np.concatenate([p.vertices for p in self.parts]),
            np.concatenate([p.triangles + first for p, first in zip(self.parts, counts, strict=False)]),
            "surfaces",
        )
        places, triangles = whole.welded
        part = np.repeat(np.arange(len(self.parts)), [len(p) for p in self.parts])
        sound = (triangles != np.roll(triangles, -1, axis=1)).all(axis=1)
        triangles, part = triangles[sound], part[sound]
        # Triangles that two surfaces share are one.
        first = np.sort(np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)[1])
        self.part = part[first]
        self.sheets = Sheets.of(places, triangles[first], math.radians(self.angle), "surfaces")
        self.surface = self.sheets.surface

    def __repr__(self) -> str:
        return f"Surfaces({', '.join(self.names)}: {len(self.surface)} triangles)"

    def __len__(self) -> int:
        return len(self.parts)

    def describe(self) -> dict[str, Any]:
        """Return names and arrays, which are compressed, for files."""
        return {
            "angle": self.angle,
            "parts": [
                [name if named else "", pack_array(p.vertices, "<f8"), pack_array(p.triangles, "<i8")]
                for name, named, p in zip(self.names, self._named, self.parts, strict=True)
            ],
        }

    def check_within(self, domain: Domain) -> None:
        """Raise an `InputError` if surfaces are outside of a domain, reach periodic sides, or cross each other in it.

        They may cross on its walls or beyond them, as nested pipes that leave it do at their ends.
        """
        corners = self.surface.corners
        low, high, extent = corners.min(axis=(0, 1)), corners.max(axis=(0, 1)), float(domain.extent.max())
        if (low >= domain.upper).any() or (high <= domain.lower).any():
            raise InputError(
                f"surfaces are outside of {domain}, expected a part of one inside; do units of length agree?"
            )
        bent = any(
            (self.sheets.normals[self.sheets.patch == p] @ self.sheets.normals[self.sheets.patch == p][0] < _FLAT).any()
            for p in range(self.sheets.n_patches if any(domain.periodic) else 0)
        )
        if bent:
            raise InputError(
                f"surfaces are curved, but {domain} is periodic, expected flat ones there; use a box with walls"
            )
        beyond = np.array(domain.periodic) & ((low <= domain.lower) | (high >= domain.upper))
        if beyond.any():
            raise InputError(
                f"surfaces reach a periodic side of {domain} along {'xyz'[int(beyond.argmax())]}, expected surfaces "
                "within the box there; use walls, or move the surfaces"
            )

        pairs = self.surface.crossings()
        met = corners[pairs]
        within = (met.max(axis=2) > domain.lower).all(axis=2) & (met.min(axis=2) < domain.upper).all(axis=2)
        pairs = pairs[within.all(axis=1)]
        if len(pairs):
            off = domain.boundary_distance(corners[pairs].reshape(-1, 3)).reshape(-1, 2, 3) > _ON_WALL * extent
            pairs = pairs[off.any(axis=(1, 2))]
        if len(pairs):
            one, other = (self.names[k] for k in self.part[pairs[0]])
            place = format_point(corners[pairs[0, 0]].mean(axis=0))
            raise InputError(
                f"surfaces {one!r} and {other!r} cross or cover each other at {place}, expected surfaces that meet in "
                "common triangles or edges only; cut them where they meet in the program that made them"
            )

    @cached_property
    def closed(self) -> list[Columns | None]:
        """For each surface what tells the inside from the outside; None for open ones."""
        found: list[Columns | None] = []
        for p in self.parts:
            places, triangles = p.welded
            sheets = Sheets.of(places, triangles, math.pi, p.name) if p.closed else None
            found.append(None if sheets is None or len(sheets.edges) else Columns(sheets.surface.corners))
        return found

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return for points (n, 3) in which of the closed surfaces they are, (n, s) bool; open ones have no inside."""
        found = np.zeros((len(points), len(self.parts)), bool)
        for k, columns in enumerate(self.closed):
            if columns is not None:
                found[:, k] = columns.winding(points) != 0
        return found

    def place(self, domain: Domain, free: Domain, size: Size) -> FixedGenerators:
        """Return the generators beside the surfaces.

        Raises `InputError` if there is no room for them.
        """
        if free is not domain:
            raise InputError(
                "layers are given, but the domain has surfaces inside, expected one of them; leave out the layers"
            )
        return place_pairs(self.sheets, domain, size)

    @cached_property
    def _open(self) -> Sheets | None:
        """The triangles of surfaces that are not closed."""
        rows = np.flatnonzero(np.array([columns is None for columns in self.closed])[self.part])
        if not len(rows):
            return None
        return Sheets.of(self.surface.vertices, self.surface.triangles[rows], math.radians(self.angle), "surfaces")

    def faces_of(self, diagram: Diagram) -> np.ndarray:
        """Return the rows of the faces between cells on both sides of a surface, (k,) int."""
        f = diagram.faces
        inner = np.arange(f.n_inner)
        i, j = f.owner[inner], f.neighbor[inner]
        bits = self.inside(diagram.points)
        differ = (bits[i] != bits[j]).any(axis=1)
        if self._open is not None:
            left = inner[~differ & ~f.shift[inner].any(axis=1)]
            begin, end = diagram.points[f.owner[left]], diagram.points[f.neighbor[left]]
            differ[left] = self._open.crossed(begin, end) % 2 == 1
        return np.flatnonzero(differ)

    def region_of_cells(self, diagram: Diagram) -> np.ndarray:
        """Return the region of each cell, (n,) int32: a region is connected by faces that are not on surfaces."""
        f, n = diagram.faces, len(diagram)
        joins = np.ones(f.n_inner, bool)
        joins[diagram.border_faces] = False
        rows = np.flatnonzero(joins)
        scale = np.minimum(diagram.volumes[f.owner[rows]], diagram.volumes[f.neighbor[rows]]) ** (2 / 3)
        rows = rows[f.area[rows] > _SMALL * scale]
        count, label = components(n, f.owner[rows], f.neighbor[rows])
        volumes = np.bincount(label, diagram.volumes, count)
        rank = np.empty(count, np.int32)
        rank[np.lexsort((np.arange(count), -np.round(volumes / volumes.sum(), 9)))] = np.arange(count)
        return rank[label]

    def region_names(self, diagram: Diagram) -> list[str]:
        """Return the names of the regions: each has that of the smallest closed surface with a name around it."""
        region = diagram.cell_region
        first = np.unique(region, return_index=True)[1]
        bits = self.inside(diagram.points[first])
        sizes = np.array(
            [
                np.inf if c is None else np.prod(np.ptp(p.vertices, axis=0))
                for c, p in zip(self.closed, self.parts, strict=True)
            ]
        )
        found: list[str] = []
        for k, row in enumerate(bits):
            holders = np.flatnonzero(row & np.array(self._named))
            name = self.names[holders[sizes[holders].argmin()]] if len(holders) else f"region-{k}"
            found.append(f"{name}-{k}" if name in found else name)
        return found

    def face_sets(self, diagram: Diagram) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return the faces on each surface: rows (k,) int, and whether the normals point the other way, (k,) bool."""
        f, rows = diagram.faces, diagram.border_faces
        if not len(rows):
            return {}
        feet = self.sheets.feet(f.center[rows])
        part = self.part[feet.triangle]
        against = np.einsum("ij,ij->i", f.normal[rows], self.sheets.normals[feet.triangle]) < 0
        return {name: (rows[part == k], against[part == k]) for k, name in enumerate(self.names) if (part == k).any()}


def _parts(source: Any, name: str) -> Iterator[FilePart]:
    """Yield all surfaces of `source`."""
    if isinstance(source, Surfaces):
        for own, named, p in zip(source.names, source._named, source.parts, strict=True):
            yield FilePart(own if named else "", p.vertices, p.triangles)
    elif isinstance(source, Solid):
        yield FilePart(name, source.surface.vertices, source.surface.triangles)
    elif isinstance(source, Surface):
        yield FilePart(name, source.vertices, source.triangles)
    elif isinstance(source, str | PathLike):
        parts = read_parts(source, SOLIDS)
        for part in parts:
            both = f"{name}-{part.name}" if name and part.name and len(parts) > 1 else name or part.name
            yield part._replace(name=both.strip())
    elif isinstance(source, Mapping) and {"angle", "parts"} == set(source):
        for own, vertices, triangles in source["parts"]:
            yield FilePart(
                own, unpack_array(vertices, "<f8").reshape(-1, 3), unpack_array(triangles, "<i8").reshape(-1, 3)
            )
    elif isinstance(source, Mapping):
        for own, item in source.items():
            if not isinstance(own, str) or not own:
                raise InputError(f"surfaces has the name {own!r:.60}, expected a word")
            yield from _parts(item, own)
    elif hasattr(source, "graph") or (hasattr(source, "vertices") and hasattr(source, "faces")):
        for part in parts_of(source):
            yield part._replace(name=name or part.name)
    elif isinstance(source, tuple) and len(source) == 2 and np.ndim(source[0]) == 2 and np.ndim(source[1]) == 2:
        yield FilePart(name, np.asarray(source[0], float), np.asarray(source[1]))
    elif isinstance(source, list | tuple):
        for item in source:
            yield from _parts(item, name)
    else:
        raise InputTypeError(f"surfaces is {source!r:.60}, expected {_EXPECTED}")
