"""Make the mesh of a solid from its generators."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy

from ...arguments import format_point, warn
from ...connectivity import distinct, following, ranges, rows_of, starts_of, take_ranges, take_rows
from ...errors import InputError, MismatchWarning
from ...mesh.diagram import Diagram
from ...mesh.faces import Faces
from ..collapse import collapse_short
from ..moves import FEW, MOVES, at_generators, least_bad, moved
from .balance import balanced, unbalanced
from .chains import Crossings, cross_cells
from .cures import Cures, cured
from .editing import REJECTED, WANTED_ANGLE, over_wanted
from .mend import at_wall, changed_cells, narrow_faces, rejected_at_walls, touching_walls, with_neighbors
from .near_walls import NearWalls
from .pierce import IN, ON, OUT, WALL, pierce_edges, sides, simplified
from .polygons import Divider, chain_loops, open_sides
from .settling import CellTargets, MadeCells, settled
from .trimmed_faces import TrimmedFaces, trim_faces
from .wall_surface import SNAP_CREASE, WallSurface, nearest

OUTSIDE = 1.6
"""Distance of outer generators from the surface, over h."""
_CERTAIN = 0.3
"""Vertices are not examined if the depths of their generators show that they are deeper than this share of h."""
_CLEAR = 1.4
"""Least distance of outer generators from the whole surface, over h: no cell is that wide at a wall."""
_SAME = 1e-3
"""Two outer generators are at the same place if they are nearer to each other than this share of the least h."""
EXACT, FILLED, ROUNDED = range(3)
"""How the walls of a cell are made: with all creases; without concave creases; without creases.

Each next one makes more cells convex, and leaves out more of the surface."""
_ACROSS = 0.35
"""How far generators are spread across thin parts, over h."""
_OFF_CENTER = 0.15
"""Least distance over h from which the generators of cells with oblique faces are moved to the centroids."""
_CENTERINGS = 6
"""How often generators are moved there."""
_LAST_MOVES, _FEW_LEFT = 2, 12
"""How often generators move where faces are still oblique after cures, and for how many generators."""
_MANY, _SHARE = 250, 0.05
"""So many rejected cells, and such a share of those at walls, are more than cures can mend in a time like the run's:
they stay as they are."""
_GOLDEN = (5**0.5 - 1) / 2
_SIMPLER, _SIMPLER_AFTER = 3, 2
"""How often walls of rejected cells become simpler, at first and after each move of generators."""
_BESIDE = 1.3
"""Distance over h up to which walls become simpler around rejected cells whose walls have no creases any more."""
_CREASED = 3.0
"""Distance from all creases, over h, beyond which a cell has the same walls however they are made."""
_RIM, _FLAT = 0.22, 0.05
"""Vertices beyond a facet that is narrower than `SNAP_CREASE`, up to this share of h from a concave crease, count as on
it at this share of the usual distance only: the faces between the cells on both sides go on into the thin part."""
_MISSED = 0.1
"""A crossing of a crease becomes a vertex of a chord on its face that is farther from it than this share of h."""


@dataclass(frozen=True)
class _Made:
    """Cells near the surface that end there.

    - `near`: NearWalls
    - `walls` (p + 1,) int: how the walls of each cell are made.
    - `faces`: Faces
    - `home` (m,) int: the cell of `NearWalls` that each one was.
    - `own` (m,) bool: whether it holds the generator. Those that do come first, ascending; then follow further parts of
      cells that have been cut along concave creases.
    - `rejected` (k,) int: see `rejected_at_walls`.
    - `cures`: what has been done to the cells.
    """

    near: NearWalls
    walls: np.ndarray
    faces: Faces
    home: np.ndarray
    own: np.ndarray
    rejected: np.ndarray
    cures: Cures | None = None

    def count_rejected(self) -> np.ndarray:
        """Return the number of rejected cells of each generator, and of cells without one, (n + 1,) float."""
        return at_generators(self.near.numbers[self.home[self.rejected]], len(self.near.points))

    def weigh_oblique(self) -> np.ndarray:
        """Return how bad the cells of each generator are, those with oblique faces, too, (n + 1,) float.

        A face is as bad as the square of its angle over `WANTED_ANGLE`, less 1.
        """
        inner = slice(self.faces.n_inner)
        pairs = self.near.numbers[self.home][np.stack([self.faces.owner[inner], self.faces.neighbor[inner]])]
        excess = np.maximum(self.faces.measures.non_orthogonality[inner] / WANTED_ANGLE - 1, 0) ** 2
        excess[(pairs < 0).any(axis=0)] = 0
        oblique = at_generators(pairs.ravel(), len(self.near.points), np.tile(excess, 2))
        return REJECTED * self.count_rejected() + oblique

    def worst(self) -> np.ndarray:
        """Return how oblique or skewed the faces of each generator's cells are, see `over_wanted`, (n + 1,) float."""
        over, numbers = over_wanted(self.faces.measures), self.near.numbers[self.home]
        worst = np.zeros(len(self.near.points) + 1)
        pairs = np.append(numbers, 0)[np.stack([self.faces.owner, np.maximum(self.faces.neighbor, -1)])]
        kept = (pairs >= 0).all(axis=0)
        for cells in (self.faces.owner, self.faces.neighbor):
            chosen = kept & (cells >= 0)
            np.maximum.at(worst, numbers[cells[chosen]], over[chosen])
        return worst

    def weigh_left(self) -> np.ndarray:
        """Return the same, where faces are more oblique or skewed than wanted."""
        worst = self.worst()
        return REJECTED * self.count_rejected() + np.where(worst > 1, worst - 0.9, 0)

    def oblique_cells(self) -> np.ndarray:
        """Return the cells of faces that are more oblique or skewed than wanted, (k,) int."""
        f, rest = self.faces, np.append(self.near.numbers[self.home] < 0, False)
        found = (over_wanted(f.measures) > 1) & ~rest[f.owner] & ~rest[np.maximum(f.neighbor, -1)]
        return distinct(np.concatenate([f.owner[found], f.neighbor[found & (f.neighbor >= 0)]]))


def outer_generators(surface: WallSurface, points: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return points (m, 3) outside of a solid that bound the cells of generators at its surface.

    They are farther from each point of the solid than its nearest generator is. So they do not change the diagram
    inside.

    - `points` (n, 3) float: generators inside.
    - `sizes` (n,) float: h at the generators.
    """
    near, foot, distance = surface.close_to(points, 1.5 * sizes)
    h = sizes[near]
    normal = foot - points[near]
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    normal *= np.where(distance > 0, -1, 1)[:, None]
    placed = foot + OUTSIDE * h[:, None] * normal
    clear = surface.closest(placed)[2] > _CLEAR * h
    placed, h = placed[clear], h[clear]
    if not len(placed):
        return placed
    # Generators of a lattice in one line upright on a wall have the same outer one.
    twice = scipy.spatial.KDTree(placed).query_pairs(_SAME * float(h.min()), output_type="ndarray")
    return np.delete(placed, twice[:, 1], axis=0)


def off_middle(surface: WallSurface, points: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Return the generators with those in parts as thin as a cell moved a little across, in turn to both sides.

    Where all stand halfway between two walls, the normals of all faces between cells lie in one plane. OpenFOAM rejects
    such cells.

    - `points` (n, 3) float: generators inside.
    - `sizes` (n,) float: h at the generators.
    """
    near, across, depth = surface.thin_parts(points, sizes)
    share = (_GOLDEN * np.arange(len(near)) % 1)[:, None] - 0.5
    moved = points.copy()
    moved[near] += share * np.minimum(_ACROSS * sizes[near], depth)[:, None] * across
    return moved


def solid_diagram(
    surface: WallSurface,
    points: np.ndarray,
    sizes: np.ndarray,
    whole: Callable[[np.ndarray], Faces],
    tell: Callable[[str], object] = lambda _: None,
    warns: bool = True,
    held: int = 0,
    straight: bool = True,
    targets: CellTargets | None = None,
) -> Diagram:
    """Return the mesh of a solid as a diagram, without short edges at walls.

    Where OpenFOAM would reject cells, their generators and those beside them are moved a little, and the mesh is made
    again.

    - `points` (n, 3) float: generators inside.
    - `sizes` (n,) float: h at the generators.
    - `whole`: returns the faces of the diagram of generators (n, 3), and of `outer_generators` after them, in a box
      around the solid.
    - `tell`: called with the name of each part of the work.
    - `warns`: whether it warns of what is wrong with the mesh.
    - `held`: how many of the first generators are not moved.
    - `straight`: where faces are oblique, move generators to the centroids of their cells, then turn or collapse faces.
    - `targets`: move generators near walls first; see `settled`.

    Raises `InputError` if generators have no cell, as the solid is too thin there.
    With `warns` it warns with `MismatchWarning` if generators have no cell, cells are cut, leave out creases, or are
    concave. It says how many, and the first place.
    """
    trials = _Trials(surface, points, sizes, whole, tell, held, straight)
    if targets is not None:
        trials.settle(targets)
    mesh = trials.best()
    tell("cells without walls")
    faces, home = mesh.near.put_back(mesh.faces, mesh.home, mesh.own)
    if warns:
        _warn_of(mesh, home)
    diagram = diagram_of(faces)
    diagram.home = home
    return diagram


class _Trials:
    """Makes the mesh of a solid, and again with moved generators or simpler walls; see `solid_diagram`.

    A state (n, 4) of a trial has the generators, and how simple the walls of their cells are.
    """

    def __init__(
        self,
        surface: WallSurface,
        points: np.ndarray,
        sizes: np.ndarray,
        whole: Callable[[np.ndarray], Faces],
        tell: Callable[[str], object],
        held: int,
        straight: bool,
    ) -> None:
        self.surface, self.points, self.sizes, self.whole = surface, points, sizes, whole
        self.tell, self.held, self.straight = tell, held, straight
        self._tree, self._turned = scipy.spatial.KDTree(points), None
        self._uncured: _Made | None = None

    def settle(self, targets: CellTargets) -> None:
        """Move generators before the first mesh; see `settled`."""
        self.tell("settling of cells at walls")
        with suppress(InputError):  # the solid is too thin: that is said of the mesh itself
            self.points = settled(self.surface, self.points, self.sizes, targets, self._cells)
        self._tree = scipy.spatial.KDTree(self.points)

    def _cells(self, points: np.ndarray) -> MadeCells:
        """Return the cells near walls, without cures."""
        self.surface.recall()
        made = self._uncured = self._made(np.column_stack([points, np.full(len(points), EXACT)]), None)
        numbers = made.near.numbers[made.home]
        worst = (made.worst() + REJECTED * made.count_rejected())[:-1]
        worst[np.setdiff1d(made.near.rows, numbers)] = REJECTED
        return MadeCells(made.faces, numbers, worst)

    def _made(self, state: np.ndarray, near: NearWalls | None) -> _Made:
        """Return the mesh of a state before cures; `near` are its cells near walls, if they are known."""
        points = state[:, :3]
        if near is None or not np.array_equal(near.points, points):
            near = NearWalls.of(self.surface, points, self.sizes, self.whole(points))
        self.tell(f"walls of {len(near.rows)} cells")
        raw = _Maker(self.surface, near, np.append(state[near.rows, 3], EXACT)).mesh()
        _check_lost(self.surface, near, raw.home)
        return _shortened(self.surface, raw)

    def best(self) -> _Made:
        """Return the mesh with the fewest rejected cells, then the least oblique faces."""
        state = np.column_stack([self.points, np.full(len(self.points), EXACT)])
        mesh = self._remade(state, None)
        assert mesh is not None
        spared = self.straight and _are_many(mesh.near, mesh.rejected)
        if not spared:
            goes_on = [True] * _SIMPLER + MOVES * [False, *[True] * _SIMPLER_AFTER]
            mesh = self._least_bad(mesh, state, _Made.count_rejected, self._remade, goes_on)
        if not self.straight or spared:
            return mesh
        self._latest = mesh
        centered = least_bad(
            mesh,
            self._state_of(mesh),
            self.sizes,
            _Made.weigh_oblique,
            self._centered,
            self._remade,
            [True] * _CENTERINGS,
        )
        mesh = self._straightened(min(centered, mesh, key=lambda made: len(made.rejected)))
        if not 0 < np.count_nonzero(mesh.weigh_left()) <= _FEW_LEFT:
            return mesh
        goes_on = [False] * _LAST_MOVES
        return self._least_bad(mesh, self._state_of(mesh), _Made.weigh_left, self._remade_straight, goes_on)

    def _least_bad(
        self,
        mesh: _Made,
        state: np.ndarray,
        badness: Callable[[_Made], np.ndarray],
        remake: Callable[[np.ndarray, _Made | None], _Made | None],
        goes_on: list[bool],
    ) -> _Made:
        """Return the best mesh of trials: walls become simpler or, where `goes_on` is False, generators move."""

        def change(state: np.ndarray, rows: np.ndarray, number: int) -> np.ndarray:
            if goes_on[number]:
                return self._simpler(state, rows)
            return self._moved(state, rows, goes_on[:number].count(False))

        return least_bad(mesh, state, self.sizes, badness, change, remake, goes_on)

    def _state_of(self, mesh: _Made) -> np.ndarray:
        """Return the state of which `mesh` was made."""
        state = np.column_stack([mesh.near.points, np.full(len(self.points), EXACT)])
        state[mesh.near.rows, 3] = mesh.walls[:-1]
        return state

    def _remade(self, state: np.ndarray, last: _Made | None) -> _Made | None:
        """Return the mesh of a state, if there is one. What it shares with the `last` mesh is taken from there."""
        self.surface.recall()
        if last is not None and last.cures is not None and last.cures.are_spent:
            return None
        made, self._uncured = self._uncured, None
        try:
            if made is None or not np.array_equal(made.near.points, state[:, :3]):
                made = self._made(state, None if last is None else last.near)
        except InputError:  # a simpler cell of a thin part may be nothing
            if last is None:
                raise
            return None
        cures, spares = None if last is None else last.cures, self.straight and last is None
        self._latest = _finished(self.surface, made, cures, self.tell, spares)
        return self._latest

    def _remade_straight(self, state: np.ndarray, last: _Made | None) -> _Made | None:
        made = self._remade(state, last)
        return None if made is None else self._straightened(made)

    def _straightened(self, made: _Made) -> _Made:
        """Return a mesh whose oblique faces are turned or collapsed where that helps."""
        oblique, near = made.oblique_cells(), made.near
        if not len(oblique):
            return made
        names, h = near.numbers[made.home], near.sizes[made.home]
        faces, origin, own, rejected, self._turned = cured(
            self.surface, made.faces, names, made.own, h, made.rejected, self._turned, oblique, self.tell
        )
        return replace(made, faces=faces, home=made.home[origin], own=own, rejected=rejected)

    def _moved(self, state: np.ndarray, rows: np.ndarray, move: int) -> np.ndarray:
        """Return the state with the generators `rows` (k,) moved for the `move`-th time."""
        if len(rows) > FEW * len(state):
            return state
        surface, sizes, trial = self.surface, self.sizes, state.copy()
        trial[:, :3] = moved(surface.solid, self._depth, sizes, state[:, :3], rows, move, self.held)
        trial[rows, 3] = EXACT
        if surface.widths.min() < SNAP_CREASE * sizes.max(initial=0.0):
            # Generators around narrow facets stay, unless OpenFOAM rejects their own cells.
            beside = np.setdiff1d(np.flatnonzero((trial[:, :3] != state[:, :3]).any(axis=1)), rows)
            beside = beside[surface.at_concave_creases(state[beside, :3], sizes[beside])]
            trial[beside, :3] = state[beside, :3]
        return trial

    def _simpler(self, state: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the state with simpler walls of the cells `rows` (k,) at creases, and of those beside them."""
        trial = state.copy()
        creased = rows[self.surface.nearest_crease(state[rows, :3], _CREASED * self.sizes[rows])[0] >= 0]
        rounded = creased[state[creased, 3] == ROUNDED]
        beside = self._tree.query_ball_point(self.points[rounded], _BESIDE * self.sizes[rounded])
        creased = np.array(sorted({*creased.tolist()}.union(*beside)), np.int64)
        trial[creased, 3] = np.minimum(state[creased, 3] + 1, ROUNDED)
        return trial

    def _centered(self, state: np.ndarray, rows: np.ndarray, number: int) -> np.ndarray:
        """Return the state with the generators `rows` (k,) at the centroids of their cells in the latest mesh."""
        del number
        made, trial = self._latest, state.copy()
        home = np.where(made.own, made.near.numbers[made.home], -1)
        cells = np.flatnonzero(np.isin(home, rows[rows >= self.held]))
        rows, x = home[cells], made.faces.measures.geometry.centroids[cells]
        far = np.linalg.norm(x - state[rows, :3], axis=1) > _OFF_CENTER * self.sizes[rows]
        far[far] = self._depth(x[far]) > 0
        trial[rows[far], :3] = x[far]
        return trial

    def _depth(self, x: np.ndarray) -> np.ndarray:
        return -self.surface.closest(x)[2]


def _warn_of(mesh: _Made, home: np.ndarray) -> None:
    """Warn of generators without cells, and of cells that are cut, leave out creases, or are rejected.

    `home` is that of all cells of the diagram; see `solid_diagram`.
    """
    near, points, rejected = mesh.near, mesh.near.points, mesh.faces.generators[mesh.rejected]
    lost, remedy = np.setdiff1d(np.arange(len(points)), home), ""
    if _are_many(near, mesh.rejected):
        wrap = np.median(near.sizes[mesh.home[mesh.rejected]]) / 1.5
        remedy = f", or leave out details finer than cells, as Solid(..., wrap={wrap:.2g}) and Solid.read do"
    for rows, what, why in (
        (points[lost], "generators without a cell", "the solid is thinner than a cell, which is left out"),
        (points[-1 - home[home < 0]], "cells that are parts of others", "these were concave, and are cut"),
        (
            near.generators[mesh.walls >= FILLED],
            "cells that leave out creases or corners",
            "several of these meet within a cell",
        ),
        (rejected, "cells that are concave, inverted, or as thin as the solid", "OpenFOAM does not accept them"),
    ):
        if len(rows):
            place = f"{len(rows)}, the first at {format_point(rows[0])}"
            more = remedy if rows is rejected else ""
            warn(f"the mesh has {what} ({place}): {why}; use smaller sizes there{more}", MismatchWarning)


def _check_lost(surface: WallSurface, near: NearWalls, home: np.ndarray) -> None:
    """Raise an `InputError` if many generators have no cell; `home` is that of the cells."""
    lost = np.setdiff1d(np.arange(len(near.rows)), home)
    if len(lost) > FEW * len(near.points):
        place = format_point(near.generators[lost[0]])
        raise InputError(
            f"{surface.solid} is too thin for cells of this size: generators without one: {len(lost)}, the first at "
            f"{place}, where h is {near.sizes[lost[0]]:.3g}; use smaller cells there"
        )


def _are_many(near: NearWalls, rejected: np.ndarray) -> bool:
    """Return whether so many cells are `rejected` (k,) that cures of all would take long, and help few."""
    return len(rejected) > max(_MANY, _SHARE * len(near.rows))


def _shortened(surface: WallSurface, raw: _Made) -> _Made:
    """Return `raw` cells near the surface without short edges and slivers, with walls that keep their volumes."""
    near, home = raw.near, raw.home
    faces, changed = _collapsed(raw.faces, near.sizes[home])
    chords = faces.points
    faces = balanced(faces, np.maximum(-1 - faces.neighbor, -1), surface.bent, surface.feet)
    changed |= touching_walls(faces)
    rejected = rejected_at_walls(faces, changed)
    if len(rejected) and faces.points is not chords:
        faces, moved = unbalanced(faces, chords, rejected)
        rejected = rejected_at_walls(faces, changed & with_neighbors(faces, moved))
    if len(rejected):  # where a face has been collapsed, another small one may bulge out
        suspect = np.zeros(faces.n_cells, bool)
        suspect[rejected] = True
        faces, changed = _collapsed(faces, near.sizes[home], with_neighbors(faces, suspect))
        rejected = rejected_at_walls(faces, with_neighbors(faces, changed | suspect))
    return replace(raw, faces=faces, rejected=rejected)


def _finished(
    surface: WallSurface, made: _Made, earlier: Cures | None, tell: Callable[[str], object], spares: bool
) -> _Made:
    """Return the cells `made` near the surface, cured where OpenFOAM rejects them.

    `earlier` cures are repeated in cells that both meshes share. With `spares`, none is made if they are many.
    """
    near, faces, home, own, rejected, cures = made.near, made.faces, made.home, made.own, made.rejected, None
    if len(rejected) and not (spares and _are_many(near, rejected)):
        names, h = near.numbers[home], near.sizes[home]
        faces, origin, own, rejected, cures = cured(surface, faces, names, own, h, rejected, earlier, tell=tell)
        home = home[origin]
    if not own.all():
        centroids = faces.measures.geometry.centroids
        faces = replace(faces, generators=np.where(own[:, None], faces.generators, centroids))
    return replace(made, faces=faces, home=home, own=own, rejected=rejected, cures=cures)


def _collapsed(faces: Faces, sizes: np.ndarray, among: np.ndarray | None = None) -> tuple[Faces, np.ndarray]:
    """Return a mesh without short edges and small faces of cells at walls, and without faces that bulge out.

    Cells that are not `among` (n,) bool stay as they are, but for the vertices that they share with the others. Return
    also which cells have changed, (n,) bool.
    """
    examined = at_wall(faces)
    if among is not None:
        examined &= among
    chosen = examined[faces.owner] | examined[np.maximum(faces.neighbor, 0)]
    numbered = faces.with_half_faces(np.arange(len(faces)))
    made = collapse_short(numbered, None, narrow_faces(numbered, sizes, examined), chosen)
    changed = changed_cells(numbered, made, with_neighbors(faces, examined, 2))
    return made.with_half_faces(faces.half_face[made.half_face]), changed


def diagram_of(faces: Faces) -> Diagram:
    """Return the mesh `faces` in 3D as a diagram; all measures follow from the corners.

    `faces` come in the order of `Diagram.faces`.
    """
    starts, places = faces.cell_faces()
    face = faces.sides()[1][places]
    back = places >= len(faces)
    half_face = np.empty(len(faces), np.int64)
    half_face[places[~back]] = np.flatnonzero(~back)
    faces = faces.with_half_faces(half_face)

    @cache
    def loops() -> tuple[np.ndarray, np.ndarray]:
        return take_rows(faces.starts, faces.corners, face, back)

    diagram = Diagram(
        faces.domain,
        {
            "points": faces.generators,
            "volumes": lambda: faces.measures.geometry.volumes,
            "centroids": lambda: faces.measures.geometry.centroids,
            "neighbor_starts": starts.astype(np.int32),
            "neighbors": np.where(back, faces.owner[face], faces.neighbor[face]).astype(np.int32),
            "face_measures": lambda: faces.area[face],
            "face_centroids": lambda: faces.center[face],
            "vertices": faces.points,
            "face_vertex_starts": lambda: loops()[0].astype(np.int32),
            "face_vertices": lambda: loops()[1].astype(np.int32),
            **({} if faces.layer is None else {"layer": faces.layer}),
        },
    )
    diagram.faces = faces
    return diagram


class _Maker:
    """Makes the mesh; vertices are those of the diagram, then piercings of edges, crossings of creases, and corners.

    - `points`: (v, 3) float
    - `site` (v,) int: see `WallSurface`; -1 for vertices inside.
    """

    def __init__(self, surface: WallSurface, near: NearWalls, walls: np.ndarray) -> None:
        self.surface, self.near, self.walls = surface, near, walls
        self.tree, self.sizes, self.generators = scipy.spatial.KDTree(near.generators), near.sizes, near.generators
        self.cells = near.cells
        self.owner, self.neighbor = self.cells.owner, self.cells.neighbor
        self.starts, self.corners, self.points = self.cells.starts, self.cells.corners, self.cells.points
        self.n, self.at_wall = len(self.sizes), near.at_wall
        self.filled, self.rounded = walls >= FILLED, walls == ROUNDED

    def mesh(self) -> _Made:
        """Return the mesh; no cell is checked."""
        touches = self.at_wall[self.owner] & self.at_wall[self.neighbor]
        near, far = np.flatnonzero(touches), np.flatnonzero(~touches)
        parts = self._to_creases(self._trim(near))
        return self._assemble(far, parts, self._wall_polygons(parts, far))

    def _certified(self, starts: np.ndarray, corners: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Return a lower bound of the depth in the solid of each vertex of the faces `near`, (v,); -inf for others.

        A vertex is as deep as each of its generators, up to its distance from it.
        """
        cells = distinct(np.concatenate([self.owner[near], self.neighbor[near]]))
        depth = np.full(self.n, -np.inf)
        depth[cells] = -self.surface.closest(self.generators[cells])[2]
        face = np.repeat(near, np.diff(starts))
        bound = np.full(len(self.points), -np.inf)
        for side in (self.owner, self.neighbor):
            i = side[face]
            away = np.linalg.norm(self.points[corners] - self.generators[i], axis=1)
            np.maximum.at(bound, corners, depth[i] - away)
        return bound

    def _trim(self, near: np.ndarray) -> TrimmedFaces:
        """Decide about the vertices and edges of the faces `near`, and return their parts inside."""
        starts, corners = take_rows(self.starts, self.corners, near)
        h_face = np.minimum(self.sizes[self.owner[near]], self.sizes[self.neighbor[near]])
        used = distinct(corners)
        h = np.full(len(self.points), np.inf)
        np.minimum.at(h, corners, np.repeat(h_face, np.diff(starts)))
        after = corners[following(starts)]
        signed = -self._certified(starts, corners, near)
        side = np.full(len(self.points), IN, np.int8)
        self.site = np.full(len(self.points), -1)
        face = np.repeat(near, np.diff(starts))
        at_filled = self.filled[self.owner[face]] | self.filled[self.neighbor[face]]
        free = np.zeros(len(self.points), bool)
        free[corners[at_filled]] = True
        at_wall = used[signed[used] > -_CERTAIN * h[used]]
        for _ in range(2):
            triangle, foot, signed[at_wall] = self.surface.closest(self.points[at_wall])
            side[at_wall] = sides(signed[at_wall], h[at_wall])
            narrow = self.surface.widths[self.surface.patch[triangle]] < SNAP_CREASE * h[at_wall]
            rows = np.flatnonzero(narrow & (signed[at_wall] > _FLAT * ON * h[at_wall]) & (side[at_wall] == WALL))
            edge = self.surface.nearest_crease(self.points[at_wall[rows]], _RIM * h[at_wall[rows]])[0]
            rows = rows[edge >= 0][self.surface.solid.creases.concave[edge[edge >= 0]]]
            side[at_wall[rows]] = OUT
            on = side[at_wall] == WALL
            at = at_wall[on]
            self.site[at], self.points[at] = self.surface.sites(foot[on], triangle[on], h[at], free[at])
            signed[at] = 0
            # Edges that may leave the solid need true distances of both ends.
            known = np.zeros(len(self.points), bool)
            known[at_wall] = True
            leave = known[corners] & (side[corners] != IN) | known[after] & (side[after] != IN)
            at_wall = distinct(np.concatenate([corners[leave & ~known[corners]], after[leave & ~known[after]]]))
        # Edges, each once.
        v = len(self.points)
        keys, edges = np.unique(np.minimum(corners, after) * v + np.maximum(corners, after), return_inverse=True)
        a, b = keys // v, keys % v
        h_edge = np.minimum(h[a], h[b])
        pierced = pierce_edges(
            self.surface, self.points[a], self.points[b], np.stack([signed[a], signed[b]], axis=1), h_edge
        )
        simple = np.zeros(len(a), bool)
        simple[edges[at_filled]] = True
        if simple.any():
            pierced = simplified(pierced, side[a], side[b], simple)
        edge = pierced.edge
        site, placed = self.surface.sites(pierced.points, pierced.triangles, h_edge[edge], simple[edge])
        self.points = np.concatenate([self.points, placed])
        self.site = np.concatenate([self.site, site])
        parts = trim_faces(
            self.surface, starts, corners, edges, corners == a[edges], side, pierced, self.points, h_face
        )
        return TrimmedFaces(near[parts.face], parts.starts, parts.items, parts.chord)

    def _to_creases(self, parts: TrimmedFaces) -> TrimmedFaces:
        """Put a vertex on the crease between the two ends of a chord that lie on different patches.

        Parts that still have two corners are left out.
        """
        after = parts.items[following(parts.starts)]
        face = parts.face[rows_of(parts.starts)]
        creased = parts.chord & ~self.rounded[self.owner[face]] & ~self.rounded[self.neighbor[face]]
        chords = np.flatnonzero(creased)
        one, other = self.site[parts.items[chords]], self.site[after[chords]]
        apart = self.surface.common(one, other)[0] == 0
        chords, one, other = chords[apart], one[apart], other[apart]
        face = parts.face[np.searchsorted(parts.starts, chords, "right") - 1]
        crossings = cross_cells(self.surface, self.generators, self.tree, self.sizes)
        filled = self.filled[crossings.cells].any(axis=1)
        edge = np.minimum(crossings.edge, len(self.surface.ends) - 1)
        crossings = crossings.take(~filled | ~self.surface.solid.creases.concave[edge])
        sites = self.surface.n_patches + crossings.edge
        middle = (self.points[parts.items[chords]] + self.points[after[chords]]) / 2
        keys = self.owner[face] * self.n + self.neighbor[face]
        rank = self._match(crossings, keys, one, other, middle)
        left = np.flatnonzero(rank < 0)
        pairs = self._match_twice(crossings, keys[left], one[left], other[left])
        twice = np.array([left[k] for k in pairs], np.int64)
        # Where vertices have been moved onto a crease, it may cross another face: take its nearest point.
        left = np.setdiff1d(left, twice)
        h = np.minimum(self.sizes[self.owner[face[left]]], self.sizes[self.neighbor[face[left]]])
        edge, foot = self.surface.nearest_crease(middle[left], h, (one[left], other[left]))
        filled = self.filled[self.owner[face[left]]] | self.filled[self.neighbor[face[left]]]
        filled[edge < 0] = False
        filled[filled] = self.surface.solid.creases.concave[edge[filled]]
        edge[filled] = -1
        left, edge, foot = left[edge >= 0], edge[edge >= 0], foot[edge >= 0]
        rank[left] = len(sites) + np.arange(len(left))
        first = len(self.points)
        self.points = np.concatenate([self.points, crossings.points, foot])
        self.site = np.concatenate([self.site, sites, self.surface.n_patches + edge])
        found = np.flatnonzero(rank >= 0)
        rows = chords[np.concatenate([found, np.repeat(twice, 2)])]
        taken = np.concatenate([rank[found], np.array(list(pairs.values()), np.int64).ravel()])
        beside = self._bypassed(parts, crossings, np.setdiff1d(np.flatnonzero(creased), rows), taken)
        rows, taken = np.concatenate([rows, beside[0]]), np.concatenate([taken, beside[1]])
        order = np.argsort(rows, kind="stable")
        rows, taken = rows[order], taken[order]
        counts = np.diff(parts.starts)
        added = np.bincount(np.searchsorted(parts.starts, rows, "right") - 1, minlength=len(counts))
        counts += added
        made = TrimmedFaces(
            parts.face,
            starts_of(counts),
            np.insert(parts.items, rows + 1, first + taken),
            np.insert(parts.chord, rows + 1, True),
        )
        return made.take(np.flatnonzero(counts >= 3))

    def _match(
        self, crossings: Crossings, face: np.ndarray, one: np.ndarray, other: np.ndarray, middle: np.ndarray
    ) -> np.ndarray:
        """Return for each chord the crossing on its face that lies on patches of both ends, the nearest; or -1.

        `face` (k,) are keys of faces, `one` and `other` (k,) the sites of the ends, and `middle` (k, 3) the middles of
        chords.
        """
        found = np.full(len(face), -1)
        key = crossings.cells[:, 0] * self.n + crossings.cells[:, 1]
        low, high = np.searchsorted(key, face, "left"), np.searchsorted(key, face, "right")
        row, which = ranges(low, high - 1)
        site = self.surface.n_patches + crossings.edge[which]
        fits = (self.surface.common(site, one[row])[0] > 0) & (self.surface.common(site, other[row])[0] > 0)
        row, which = row[fits], which[fits]
        far = ((crossings.points[which] - middle[row]) ** 2).sum(axis=1)
        order = np.lexsort((far, row))
        first = np.unique(row[order], return_index=True)[1]
        found[row[order[first]]] = which[order[first]]
        return found

    def _bypassed(
        self, parts: TrimmedFaces, crossings: Crossings, chords: np.ndarray, taken: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return chords that miss one or two crossings on their face, and each crossing, in turn, (k,) each.

        Both ends of such a chord lie on one patch, but between them the face ends on others.
        """
        free = np.setdiff1d(np.arange(len(crossings.edge)), taken)
        face = parts.face[np.searchsorted(parts.starts, chords, "right") - 1]
        key = self.owner[face] * self.n + self.neighbor[face]
        order = np.argsort(key, kind="stable")
        of_crossing = crossings.cells[free, 0] * self.n + crossings.cells[free, 1]
        low, high = (np.searchsorted(key[order], of_crossing, side) for side in ("left", "right"))
        which = np.repeat(free, high - low)
        chord = chords[order[take_ranges(low, high - low, np.arange(len(order)))[1]]]
        begin, end = parts.items[chord], parts.items[following(parts.starts)[chord]]
        site = self.surface.n_patches + crossings.edge[which]
        fits = (self.surface.common(site, self.site[begin])[0] > 0) & (self.surface.common(site, self.site[end])[0] > 0)
        a, b, x = self.points[begin], self.points[end], crossings.points[which]
        along = b - a
        share = ((x - a) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
        away = np.linalg.norm(x - a - np.clip(share, 0, 1)[:, None] * along, axis=1)
        rows = np.flatnonzero(fits)
        rows = rows[np.lexsort((away[rows], which[rows]))]
        rows = rows[np.unique(which[rows], return_index=True)[1]]  # each crossing is on the nearest chord
        missed = chord[rows[away[rows] > _MISSED * self.sizes[crossings.cells[which[rows], 0]]]]
        rows = rows[np.isin(chord[rows], missed)]
        rows = rows[np.lexsort((-away[rows], chord[rows]))]
        place = np.arange(len(rows)) - np.searchsorted(chord[rows], chord[rows])
        rows = rows[place < 2]  # a face that ends on a strip between two creases crosses both
        rows = rows[np.lexsort((share[rows], chord[rows]))]
        return chord[rows], which[rows]

    def _match_twice(
        self, crossings: Crossings, face: np.ndarray, one: np.ndarray, other: np.ndarray
    ) -> dict[int, tuple[int, int]]:
        """Return two crossings for each chord between patches that have a third one between them, the nearest pair."""
        key = crossings.cells[:, 0] * self.n + crossings.cells[:, 1]
        found: dict[int, tuple[int, int]] = {}
        for k, (low, high) in enumerate(
            zip(*(np.searchsorted(key, face, side) for side in ("left", "right")), strict=True)
        ):
            here = [set(self.surface.patches_of(self.surface.n_patches + crossings.edge[c])) for c in range(low, high)]
            begin, end = (set(self.surface.patches_of(site[k])) for site in (one, other))
            pairs = [
                (float(np.linalg.norm(crossings.points[low + i] - crossings.points[low + j])), (low + i, low + j))
                for i, a in enumerate(here)
                for j, b in enumerate(here)
                if i != j and a & begin and a & b and b & end
            ]
            if pairs:
                found[k] = min(pairs)[1]
        return found

    def _wall_polygons(self, parts: TrimmedFaces, far: np.ndarray) -> Divider:
        """Close the cells at the surface."""
        is_open = np.zeros(self.n, bool)  # a thin edge of the solid may open a cell without a chord
        is_open[self.owner[parts.face]] = is_open[self.neighbor[parts.face]] = True
        far = far[is_open[self.owner[far]] | is_open[self.neighbor[far]]]
        starts, corners = take_rows(self.starts, self.corners, far)
        faces = np.repeat(np.concatenate([parts.face, far]), np.concatenate([np.diff(parts.starts), np.diff(starts)]))
        here = np.concatenate([parts.items, corners])
        after = np.concatenate([parts.items[following(parts.starts)], corners[following(starts)]])
        cell = np.concatenate([self.owner[faces], self.neighbor[faces]])
        begin, end = np.concatenate([here, after]), np.concatenate([after, here])
        mine = is_open[cell]
        cell, begin, end = open_sides(cell[mine], begin[mine], end[mine])
        label = self._labels(cell, begin, end)
        order, starts = chain_loops(cell, begin, end, label)
        cell, begin, label = cell[order], begin[order], label[order]
        label = self._joined_runs(cell, begin, end[order], label, starts)
        corner_vertex: dict[int, int] = {}
        taken = self.site[begin] - self.surface.first_corner
        for vertex, c in zip(begin[taken >= 0].tolist(), taken[taken >= 0].tolist(), strict=True):
            corner_vertex[c] = vertex
        corners_of: dict[int, list[int]] = {}
        cells = nearest(self.tree, self.surface.corners)[1]
        for c, i in enumerate(cells.tolist()):
            if c not in corner_vertex and not self.filled[i]:
                corners_of.setdefault(i, []).append(c)
        new_points: list[np.ndarray] = []

        def vertex_of(c: int) -> int:
            if c not in corner_vertex:
                corner_vertex[c] = len(self.points) + len(new_points)
                new_points.append(self.surface.corners[c])
            return corner_vertex[c]

        def place_of(v: int) -> np.ndarray:
            return self.points[v] if v < len(self.points) else new_points[v - len(self.points)]

        divider = Divider(self.surface, corners_of, vertex_of, place_of)
        uniform = np.minimum.reduceat(label, starts[:-1]) == np.maximum.reduceat(label, starts[:-1])
        first, mixed = starts[:-1], np.flatnonzero(~uniform).tolist()
        for tip, patch, around in self._tips():
            loops = np.flatnonzero(uniform & (cell[first] == around) & (label[first] == patch))
            for k in loops.tolist() if len(loops) == 1 else ():
                uniform[k] = False
                loop = [*begin[starts[k] : starts[k + 1]].tolist(), int(begin[starts[k]])]
                top = len(self.points) + len(new_points)
                new_points.append(self.surface.vertices[tip])
                for a in range(0, len(loop) - 1, 2):
                    divider.polygons.add(around, patch, [top, *loop[a : a + 3]])
        self.whole = take_rows(starts, begin, np.flatnonzero(uniform))
        self.whole_cell, self.whole_patch = cell[starts[:-1][uniform]], label[starts[:-1][uniform]]
        for k in mixed:
            s = slice(starts[k], starts[k + 1])
            divider.divide(int(cell[starts[k]]), begin[s].tolist(), label[s].tolist())
        if new_points:
            self.points = np.concatenate([self.points, new_points])
        return divider

    def _tips(self) -> Iterator[tuple[int, int, int]]:
        """Return the vertex and the patch of each tip that is straight over a cell, and the cell around it."""
        tips, patch, straight = self.surface.tips
        cells = nearest(self.tree, self.surface.vertices[tips])[1]
        wide = straight >= self.sizes[cells]
        return zip(tips[wide].tolist(), patch[wide].tolist(), cells[wide].tolist(), strict=True)

    def _joined_runs(
        self, cell: np.ndarray, begin: np.ndarray, end: np.ndarray, label: np.ndarray, starts: np.ndarray
    ) -> np.ndarray:
        """Return the labels of the sides of loops; in cells without creases runs of sides are joined.

        A run is joined with the longest neighbor that no convex crease parts from it.
        """
        label = label.copy()
        convex = np.zeros(self.surface.first_corner + len(self.surface.corners), bool)
        convex[self.surface.n_patches : self.surface.first_corner] = ~self.surface.solid.creases.concave
        convex[self.surface.first_corner :] = True
        for k in np.flatnonzero(self.filled[cell[starts[:-1]]]).tolist():
            s = slice(starts[k], starts[k + 1])
            sides = label[s]
            length = np.linalg.norm(self.points[end[s]] - self.points[begin[s]], axis=1)
            real = convex[self.site[begin[s]]] & ~self.rounded[cell[starts[k]]]
            while True:
                cuts = np.flatnonzero(sides != np.roll(sides, 1))
                open_ = cuts[~real[cuts]]
                if not len(open_):
                    break
                run = np.cumsum(sides != np.roll(sides, 1)) % max(len(cuts), 1)
                total = np.bincount(run, length, minlength=max(len(cuts), 1))
                pair = [(total[run[c - 1]], total[run[c]], c) for c in open_.tolist()]
                before, after, c = min(pair, key=lambda p: min(p[:2]))
                small, large = (c - 1, c) if before < after else (c, c - 1)
                sides[run == run[small]] = sides[large]
            label[s] = sides
        return label

    def _labels(self, cell: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Return the patch of each side at a wall: that of both ends, or the nearest to its middle."""
        count, label = self.surface.common(self.site[begin], self.site[end])
        rows = np.flatnonzero(count != 1)
        middle = (self.points[begin[rows]] + self.points[end[rows]]) / 2
        middle += 0.05 * (self.generators[cell[rows]] - middle)
        near = self.surface.patch[self.surface.closest(middle)[0]].astype(np.int64)
        fits = [self.surface.common(near, self.site[ends[rows]])[0] > 0 for ends in (begin, end)]
        label[rows] = np.where(np.all(fits, axis=0) | (count[rows] == 0), near, label[rows])
        return label

    def _assemble(self, far: np.ndarray, parts: TrimmedFaces, divider: Divider) -> _Made:
        """Put all faces together."""
        starts, corners = take_rows(self.starts, self.corners, far)
        owner = np.concatenate([self.owner[far], self.owner[parts.face]])
        neighbor = np.concatenate([self.neighbor[far], self.neighbor[parts.face]])
        counts = np.concatenate([np.diff(starts), np.diff(parts.starts)])
        items = np.concatenate([corners, parts.items])
        p = divider.polygons
        wall_counts = np.concatenate([np.diff(self.whole[0]), [len(loop) for loop in p.loops]]).astype(np.int64)
        wall_items = np.concatenate([self.whole[1], np.array([v for loop in p.loops for v in loop], np.int64)])
        wall_owner = np.concatenate([self.whole_cell, np.array(p.cell, np.int64)])
        wall_patch = np.concatenate([self.whole_patch, np.array(p.patch, np.int64)])
        row = np.concatenate([self.cells.row[far], np.full(len(parts.face), -1)])
        inner = np.lexsort((neighbor, owner))
        walls = np.lexsort((wall_owner, wall_patch))
        one = take_rows(starts_of(counts), items, inner)
        two = take_rows(starts_of(wall_counts), wall_items, walls)
        f = len(inner) + len(walls)
        owner = np.concatenate([owner[inner], wall_owner[walls]])
        neighbor = np.concatenate([neighbor[inner], -1 - wall_patch[walls]])
        seen = np.bincount(owner, minlength=self.n) + np.bincount(neighbor[neighbor >= 0], minlength=self.n) > 0
        number = np.cumsum(seen) - 1
        owner, neighbor = number[owner], np.where(neighbor >= 0, number[np.maximum(neighbor, 0)], neighbor)
        faces = Faces(
            domain=self.surface.solid,
            generators=self.generators[seen],
            points=self.points,
            starts=np.concatenate([one[0], one[0][-1] + two[0][1:]]),
            corners=np.concatenate([one[1], two[1]]).astype(np.int32),
            owner=owner.astype(np.int32),
            neighbor=neighbor.astype(np.int32),
            twin=np.full(f, -1),
            shift=np.zeros((f, 3), np.int8),
            half_face=np.concatenate([row[inner], np.full(len(walls), -1)]),
        ).compact()
        home = np.flatnonzero(seen)
        return _Made(self.near, self.walls, faces, home, np.ones(len(home), bool), np.zeros(0, np.int64))
