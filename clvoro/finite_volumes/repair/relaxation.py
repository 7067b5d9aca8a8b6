"""Repair of a solver mesh in 2D, where faces are skew or far from orthogonal, or cells not convex.

Around each such place a patch of cells is improved: first its points inside move, then those on walls slide along the
boundary, and if that is not enough faces are connected in another way; see `moves` and `repaired`. Corners of the
domain, points where the name of the boundary changes, and points at seams stay.
"""

from __future__ import annotations

import threading

import numpy as np
import scipy.sparse

from ...arguments import format_point, warn
from ...errors import MismatchWarning
from ...geometry.ring_coordinate import RingCoordinate
from ...mesh.connectivity import following
from ...mesh.faces import Faces
from ...mesh.geometry import polygon_centroids, turns
from ..chords import FILLED
from ..prisms import simple_loops
from ..short_edges import CORNER, point_kinds
from .figures import face_figures
from .patch import LIMITS, Patch, part_of, put_back, take_patch
from .pricing import LEAST_DETERMINANT, STRAIGHT, PricedPatch
from .reconnection import repaired
from .tasks import Move, Task, in_step, run_task
from .wall_corners import CornerCut, WallEdges

_RINGS = 5
"""Rings of cells around those beyond a limit that make a patch."""
_TRIES = (1, 3)
"""Rings of cells whose points inside move, one try after the other."""
_STEPS = 15
_MOST, _SHARE = 50, 0.005
"""If more faces are bad than this number, and than this share, the next limits hold. Then the time for the repair
remains a small part of that of a run."""
_LIMITS = (LIMITS, (np.radians(30), 2.5), (np.radians(45), 3.0))
_MOST_REFUSED = 50
"""Walls change if at most this many cells are refused after other attempts, or the repair would take long in vain."""
_MOST_PLACES, _PLACES_SHARE = 200, 0.005
"""Faces are connected in another way if at most this many cells, or this share of all, are bad after points have moved.

More are bad where the boundary has more features than the mesh has cells; their repair takes minutes, and fails."""
_NOT_ADAPTED = 0.12
"""Nothing changes if more faces than this share are bad by the first limits: the generators were not adapted."""

_BLAS = threading.Lock()
"""Held while BLAS has one thread, which is a setting of the process."""


def relax_points(mesh: Faces, parts: np.ndarray, straight: bool = True) -> Faces:
    """Return `mesh` with fewer faces that are skew or far from orthogonal, and fewer cells that are not convex.

    Parameters
    ----------
    mesh : Faces
    parts : (k,) int
        Index of the named part of the boundary for each wall.
    straight : bool
        Whether the walls are straight. Else points inside move where faces are beyond a limit, and nothing else.
    """
    from threadpoolctl import threadpool_limits

    loops = simple_loops(mesh)
    limited = _limited(mesh)
    if limited is None:
        return mesh
    limits, faces = limited
    bad = _bad_cells(mesh, loops, faces, straight)
    if not bad.any():
        return mesh
    outline = mesh.domain.outline if straight else None
    ring = None if outline is None else RingCoordinate(outline)
    kinds = point_kinds(mesh, parts)
    region = _grown(loops, bad)
    around, groups = take_patch(mesh, region), _connected_parts(mesh, region, bad)
    around.limits = limits
    on_walls = slice(mesh.n_inner, mesh.n_outer)
    walls = WallEdges(mesh.points[mesh.corners.reshape(-1, 2)[on_walls]], mesh.owner[on_walls], parts)
    patches = [_with_positions(_patch_of(around, cells), ring, kinds) for cells in groups]
    given = [made for made in map(PricedPatch.of, patches) if made is not None and made.bad.any()]
    # The last bits of sums in BLAS depend on its number of threads.
    with _BLAS, threadpool_limits(1, user_api="blas"):
        better = run_task(in_step([_moved(patch) for patch in given]), ring)
        if straight and _are_few(better, max(_MOST_PLACES, int(_PLACES_SHARE * mesh.n_cells))):
            better = run_task(in_step([repaired(patch, ring) for patch in better]), ring)
        refused = sum(int(patch.refused.sum()) for patch in better)
        if straight and 0 < refused <= _MOST_REFUSED:
            better = run_task(in_step([repaired(patch, ring, walls) for patch in better]), ring)
    made = [b.patch for a, b in zip(given, better, strict=True) if b.price < a.price]
    _report([cut for patch in made for cut in patch.cuts])
    return put_back(mesh, made) if made else mesh


def _report(cuts: list[CornerCut]) -> None:
    """Warn if a corner of a wall that was cut off is far from the new wall face."""
    far = max(cuts, key=lambda cut: cut.far / cut.size, default=None)
    if far is None or far.far <= FILLED * far.size:
        return
    what = "1 corner of the boundary is" if len(cuts) == 1 else f"{len(cuts)} corners of the boundary are"
    warn(
        f"{what} cut off, because no convex cells fit there, as the one at {format_point(np.array(far[:2]))}, which is "
        f"{far.far:.3g} from the wall, where cells are {far.size:.3g} wide; use smaller cells there",
        MismatchWarning,
    )


def _moved(given: PricedPatch) -> Task[PricedPatch]:
    """Find a patch of lower price after moves of its points inside, the same if there is none."""
    for rings in _TRIES:
        if not given.bad.any():
            break
        (made,) = yield [Move(given, given.near(given.bad, rings), False, _STEPS)]
        given = made if made.price < given.price else given
    return given


def _are_few(patches: list[PricedPatch], most: int) -> bool:
    """Return whether at most so many cells of `patches` are bad; warn if not."""
    count = sum(int(patch.bad.sum()) for patch in patches)
    if count <= most:
        return True
    patch = max(patches, key=lambda patch: patch.prices.max())
    c, worst = patch.cells, int(np.argmax(patch.prices))
    place = patch.patch.points[c.loop[c.row == worst]].mean(axis=0)
    warn(
        f"{count} cells of the mesh for solvers are concave, or have skew faces or faces far from orthogonal, as the "
        f"one at {format_point(place)}, and are left so: they are too many for a repair. "
        "The boundary has features smaller than the cells; drop these first, as domain.simplified(1.5 * h) does with h "
        "the size of the cells there, or use smaller cells",
        MismatchWarning,
    )
    return False


def _limited(mesh: Faces) -> tuple[tuple[float, float], np.ndarray] | None:
    """Return the limits that hold for `mesh`, and the faces beyond one of them; None if it was not adapted."""
    angle, skewness = face_measures(mesh)
    beyond = [np.flatnonzero((angle > a) | (skewness > s)) for a, s in _LIMITS]
    if len(beyond[0]) > max(_MOST, _NOT_ADAPTED * len(angle)):
        return None
    few = [len(faces) <= max(_MOST, _SHARE * len(angle)) for faces in beyond]
    k = few.index(True) if any(few) else -1
    return _LIMITS[k], beyond[k]


def _bad_cells(mesh: Faces, loops: tuple[np.ndarray, ...], faces: np.ndarray, all_kinds: bool) -> np.ndarray:
    """Return which cells have one of the `faces`, (n,) bool.

    With `all_kinds`, also cells that are not convex or have a low determinant.
    """
    starts, points, broken = loops
    found = np.zeros(mesh.n_cells, bool)
    found[mesh.owner[faces]] = True
    found[mesh.neighbor[faces[mesh.neighbor[faces] >= 0]]] = True
    if all_kinds:
        bent = turns(mesh.points[points], following(starts)) < STRAIGHT
        found[np.repeat(np.arange(mesh.n_cells), np.diff(starts))[bent]] = True
        found |= _determinants(mesh) < LEAST_DETERMINANT
    found[broken] = False
    return found


def _determinants(mesh: Faces) -> np.ndarray:
    """Return the determinant of each cell in 2D, (n,), as `SolverMeasures.determinant`."""
    k, n = mesh.n_inner, mesh.n_cells
    between = np.concatenate([np.arange(k), np.arange(mesh.n_outer, len(mesh.owner))])
    a, b = mesh.points[mesh.corners.reshape(-1, 2)[np.concatenate([between, np.arange(k)])]].swapaxes(0, 1)
    cell = np.concatenate([mesh.owner[between], mesh.neighbor[:k]])
    x, y = (b - a).T
    mean = np.bincount(cell, np.hypot(x, y), n) / np.maximum(np.bincount(cell, minlength=n), 1)
    xx, xy, yy = (np.bincount(cell, z, n) for z in (x * x, x * y, y * y))
    return (xx * yy - xy * xy) / (8 * np.maximum(mean, 1e-75) ** 4)


def _grown(loops: tuple[np.ndarray, ...], chosen: np.ndarray) -> np.ndarray:
    """Return the cells `chosen` (n,) bool and rings around them, without those that are no simple polygons."""
    starts, points, broken = loops
    cell = np.repeat(np.arange(len(chosen)), np.diff(starts))
    touched = np.zeros(points.max(initial=-1) + 1, bool)
    found = chosen.copy()
    for _ in range(_RINGS):
        touched[points[found[cell]]] = True
        found[cell[touched[points]]] = True
    found[broken] = False
    return found


def _connected_parts(mesh: Faces, region: np.ndarray, bad: np.ndarray) -> list[np.ndarray]:
    """Return the parts of a `region` (n,) bool that are connected by faces and have bad cells, each (n,) bool."""
    n, here, there = mesh.n_cells, mesh.owner[: mesh.n_inner], mesh.neighbor[: mesh.n_inner]
    within = region[here] & region[there]
    pairs = (here[within], there[within])
    graph = scipy.sparse.coo_array((np.ones(len(pairs[0])), pairs), (n, n))
    part = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    return [part == k for k in np.unique(part[bad])]


def _patch_of(around: Patch, cells: np.ndarray) -> Patch:
    """Return the `cells` (n,) bool of the mesh that are in the patch `around`, as a patch of the mesh."""
    patch = part_of(around, cells[around.cells])
    patch.cells, patch.ids = around.cells[patch.cells], around.ids[patch.ids]
    return patch


def _with_positions(patch: Patch, ring: RingCoordinate | None, kinds: np.ndarray) -> Patch:
    """Return `patch` with the positions of points on walls; those that are no corners can slide.

    Parameters
    ----------
    kinds : (v,) int
        Of the points of the mesh; see `point_kinds`.
    """
    walls, at = np.flatnonzero(patch.walls), np.flatnonzero(patch.on_walls)
    if ring is None or not at.size:
        return patch
    edge, reach = np.zeros((2, len(patch.points)))
    ends = patch.ends[walls]
    lengths = np.hypot(*(patch.points[ends[:, 1]] - patch.points[ends[:, 0]]).T)
    for side in ends.T:
        edge[side] = -1 - patch.neighbor[walls]
        np.maximum.at(reach, side, 2 * lengths)
    patch.positions[at] = ring.find(patch.points[at], edge[at].astype(np.int64), reach[at])
    between = np.zeros(len(patch.points), bool)
    between[patch.ends[patch.neighbor >= 0]] = True
    patch.fixed[at] = patch.held[at] | (kinds[patch.ids[at]] == CORNER) | ~between[at]
    return patch


def face_measures(mesh: Faces) -> tuple[np.ndarray, np.ndarray]:
    """Return non-orthogonality in radians and skewness of each face in 2D, (f,) each; 0 at seams."""
    _, centroids = polygon_centroids(mesh)
    k = mesh.n_outer
    ends = mesh.points[mesh.corners.reshape(-1, 2)[:k]].reshape(k, 4)
    there = mesh.neighbor[:k]
    found = np.zeros((2, len(mesh.owner)))
    here, beyond = (tuple(centroids[c].T) for c in (mesh.owner[:k], np.maximum(there, 0)))
    found[:, :k] = face_figures(tuple(ends.T), here, beyond, there < 0)[:2]
    return found[0], found[1]
