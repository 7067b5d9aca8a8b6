"""Verification of a mesh: everything is recomputed by NumPy on the host, independently of the device's code.

Cells are rebuilt from their corners, errors and quality follow from the paper's formulas. A search tree over all
generators verifies the property that defines a Voronoi diagram: no generator is nearer to a corner of a cell than the
cell's own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from ...connectivity import components, rows_of, take_rows
from ..diagram import Diagram
from ..geometry import sum_rows
from ..lookup import lifted, power_tree
from ..results import Result
from .findings import ROUNDINGS, Check, Report, StopError
from .polygon import check_cells, check_edges, check_outlines, hidden
from .rebuilt import Doubts, Rebuilt, check_generators, check_places, rebuild_cells
from .values import check_values


def check_corners(check: Check) -> None:
    """Check that a face has the same corners from both sides, which finds vertices that are stored twice.

    Polygons need no such check: there the symmetry of the graph depends on the corners. The two sides of a seam have
    different vertices.
    """
    d = check.diagram
    if d.domain.cuts_cells:
        return
    inner = np.flatnonzero((d.neighbors >= 0) & ~d.shifts.any(axis=1))
    here, there = inner, d.half_faces.opposite[inner]
    flat = d.domain.cell_dim == 2
    if flat:
        ends = d.half_faces.ends
        wrong = (ends[here] != ends[there][:, ::-1]).any(axis=1)
    else:
        starts, corners = d.face_vertex_starts, d.face_vertices
        a, b = (take_rows(starts, corners, rows) for rows in (here, there))
        wrong = np.diff(a[0]) != np.diff(b[0])
        same = ~wrong
        row_a, row_b = (rows_of(x[0]) for x in (a, b))
        one, two = a[1][same[row_a]], b[1][same[row_b]]
        row = row_a[same[row_a]]
        off = one[np.lexsort((one, row))] != two[np.lexsort((two, row))]
        wrong[row[off]] = True
    owner = d.half_faces.owner
    check.note(
        "vertices once",
        wrong,
        lambda k: f"the face of cells {owner[here[k]]} and {owner[there[k]]} has other vertices from either side",
    )
    if flat and not any(d.domain.periodic):
        # Across seams a vertex has several numbers.
        expected = _euler_characteristic(d)
        v, e = len(d.vertices), len(d.neighbors) - len(inner) // 2
        c = int(np.count_nonzero(np.diff(d.neighbor_starts)))
        check.note(
            "Euler's formula",
            np.array([expected is not None and v - e + c != expected]),
            lambda _: (
                f"{v} vertices - {e} faces + {c} cells is {v - e + c}, expected {expected}: faces "
                "cross, or two vertices have one number"
            ),
        )


def _euler_characteristic(d: Diagram) -> int | None:
    """Return vertices - faces + cells of a mesh without gaps; None where parts of a boundary touch in a vertex.

    It is 2 for each connected part of a sphere, less one for each of its boundaries, as that of a rectangle: the plane
    is a part of a sphere.
    """
    if d.domain.plain:
        return 1
    owner = d.half_faces.owner
    walls = d.neighbors < 0
    ends = d.half_faces.ends[walls]
    if len(np.unique(ends[:, 0])) < len(ends):
        return None
    empty = int(np.count_nonzero(np.diff(d.neighbor_starts) == 0))
    parts = components(len(d), owner[~walls], d.neighbors[~walls])[0] - empty
    # All other vertices are parts of their own.
    others = len(d.vertices) - len(np.unique(ends))
    return 2 * parts - (components(len(d.vertices), *ends.T)[0] - others)


def check_measures(check: Check, g: Rebuilt, positions: Doubts) -> None:
    """Check that the measures of the faces close each cell and give its volume, on the bisectors of the generators.

    The device computes a cell relative to its generator. The round-off of its measures is therefore relative to the
    size of the cell, not of the domain as that of `positions`, unless they come from the corners in a file.
    """
    d = check.diagram
    if g.remade:
        return
    dim, n, cut = d.domain.dim, len(d), d.domain.cuts_cells
    own = ROUNDINGS * g.unit_of_cell
    doubts = g.doubts(own)
    normals, height = g.directions, g.spacings / 2
    inner = np.flatnonzero(d.neighbors >= 0)
    height[inner] = d.half_faces.plane_shares(inner) * g.spacings[inner]
    walls = np.flatnonzero(d.neighbors < 0)
    planes, anchors = d.domain.wall_planes(-1 - d.neighbors[walls])
    height[walls] = ((anchors - d.points[g.owner[walls]]) * planes).sum(axis=1)
    loose = np.zeros(len(g.owner), bool)
    if cut:
        # Faces of parts that the boundary has cut off from their generators are not on bisectors: their corners give
        # their places. Such a part lies at the boundary, and so does the cell that it belongs to.
        there = g.areas / np.maximum(g.measures, 1e-300)[:, None]
        at_boundary = np.bincount(g.owner[walls], minlength=n) > 0
        at_wall = at_boundary[g.owner] | at_boundary[np.where(d.neighbors < 0, g.owner, d.neighbors)]
        off = np.linalg.norm(there - normals, axis=1) * g.measures
        adopted = off > np.where(at_wall, doubts.measures, positions.measures)
        adopted &= (d.neighbors >= 0) & (g.measures > 0)
        normals = np.where(adopted[:, None], there, normals)
        # Edges of the domain pass through their corners within round-off.
        loose = adopted | (d.neighbors < 0)
    rounding = np.where(loose, 2 * positions.measures, 0.0)
    # The round-off of the device's periods moves neighbors across seams.
    across = np.where(d.shifts.any(axis=1), g.period_off, 0.0) * d.face_measures
    turned = across / g.spacings
    width = np.bincount(g.owner, doubts.measures + rounding + turned, n)
    _check_sum(check, g.owner, d.face_measures[:, None] * normals, width)
    if cut:  # corners alone give the places of cut faces
        return
    if d.is_power and dim == 2:
        # A small cell may be far from its generator: one of its corners is the better origin. In 3D the device, too,
        # sums the cones from the generator.
        corner = np.zeros((n, dim))
        corner[g.cells] = d.vertices[g.corners] - d.points[g.cells]
        height = height - (corner[g.owner] * normals).sum(axis=1)
    volumes = np.bincount(g.owner, d.face_measures * height, n) / dim
    # Corners of a cell at the limit of the precision may all be rounded to one point, and give no measures.
    width = doubts.volumes + np.bincount(g.owner, d.face_measures, n) * own
    width += np.bincount(g.owner, across, n) / (2 * dim)
    check.compare("volumes", d.volumes, volumes, width, "faces and their measures")


def _check_sum(check: Check, owner: np.ndarray, areas: np.ndarray, width: np.ndarray) -> None:
    """Check that the vectors `areas` (m, d) of the faces of each cell add up to 0, up to `width` (n,)."""
    gap = np.linalg.norm(sum_rows(owner, areas, len(check.diagram)), axis=1)
    check.note(
        "measures close",
        np.maximum(gap - width, 0),
        lambda i: f"the measures of the faces of cell {i} do not close it, by {gap[i]:.3g}",
    )


SAGITTAS = 2
"""Largest distance of a wall vertex from the surface, over the heights of the surface over its polygons."""
MOVED = 0.4
"""Largest difference between the distances from an inner vertex of a solid to its generators, over the cell's size.

Vertices move by at most 0.15 of it when short edges are merged, and by 0.03 where they are put on the surface."""


def check_diagram(diagram: Diagram) -> Report:
    """Check a diagram in 2D or 3D; see `Diagram.check`."""
    return _finish(Check(diagram))


def check_result(result: Result) -> Report:
    """Check a result: its diagram, sizes, error (the paper's 3.1), quality (4.1) and history; see `Result.check`."""
    check = Check(result.diagram)
    return _finish(check, result.settings.get("dtype"), lambda geometry: check_values(check, result, geometry))


def _finish(check: Check, dtype: object = None, more: Callable[[Rebuilt], None] | None = None) -> Report:
    diagram, geometry = check.diagram, None
    try:
        # Wrong numbers may cause divisions by 0; they become findings.
        with np.errstate(all="ignore"):
            _check_structure(check)
            geometry = rebuild_cells(diagram, dtype)
            if diagram.has_moved_vertices:
                check_solid(check, geometry)
            else:
                _check_geometry(check, geometry)
            if more is not None:
                more(geometry)
    except StopError:
        pass
    names = tuple(dict.fromkeys(check.checked))
    real = "unknown precision" if geometry is None else geometry.real.name
    faces = len(diagram.neighbors)
    return Report(tuple(check.findings), names, len(diagram), faces, real)


def _check_structure(check: Check) -> None:
    """Check that the shapes of the arrays match, and check the graph."""
    d = check.diagram
    dim, n, m, cut = d.domain.dim, len(d.points), len(d.neighbors), d.domain.cuts_cells
    floats = {"points": (n, dim), "volumes": (n,), "centroids": (n, dim), "weights": (n,), "face_measures": (m,)}
    floats |= {"face_centroids": (m, dim), "vertices": (len(d.vertices), dim)}
    for name, shape in floats.items():
        check.shape(name, getattr(d, name), shape)
    check.shape("neighbor_starts", d.neighbor_starts, (n + 1,), "iu")
    check.shape("neighbors", d.neighbors, (m,), "i")
    check.shape("shifts", d.shifts, (m, dim), "i")
    _check_starts(check, "neighbor_starts", d.neighbor_starts, m)
    if d.domain.cell_dim == 2:
        check.shape("cell_vertex_starts", d.cell_vertex_starts, (n + 1,), "iu")
        _check_starts(check, "cell_vertex_starts", d.cell_vertex_starts, len(d.cell_vertices))
        corners = d.cell_vertices
        if cut:
            check.shape("face_vertex_starts", d.face_vertex_starts, (m + 1,), "iu")
            check.shape("face_vertices", d.face_vertices, (2 * m,), "iu")
            check.note(
                "shapes",
                d.face_vertex_starts != 2 * np.arange(m + 1),
                lambda k: f"face_vertex_starts[{k}] is {d.face_vertex_starts[k]}, expected {2 * k}",
                stop=True,
            )
            corners = np.concatenate([corners, d.face_vertices])
        else:
            check.note(
                "shapes",
                d.cell_vertex_starts != d.neighbor_starts,
                lambda i: (
                    f"cell_vertex_starts[{i}] is {d.cell_vertex_starts[i]}, expected as many corners "
                    f"as faces, {d.neighbor_starts[i]}"
                ),
                stop=True,
            )
    else:
        check.shape("face_vertex_starts", d.face_vertex_starts, (m + 1,), "iu")
        _check_starts(check, "face_vertex_starts", d.face_vertex_starts, len(d.face_vertices))
        corners = d.face_vertices
    check.note(
        "corners exist",
        (corners < 0) | (corners >= len(d.vertices)),
        lambda k: f"corner {k} is vertex {corners[k]} of {len(d.vertices)}",
        stop=True,
    )
    j, walls = d.neighbors, len(d.domain.boundary_index)
    check.note(
        "neighbors exist",
        (j >= n) | (j < -walls),
        lambda f: f"face {f} leads to {j[f]}, expected a cell below {n} or a wall from {-walls} to -1",
        stop=True,
    )
    used = np.bincount(corners, minlength=len(d.vertices))
    check.note("vertices used", used == 0, lambda v: f"vertex {v} is no cell's corner")
    _check_shifts(check)
    _check_graph(check)
    check_corners(check)
    if cut:
        check_outlines(check)


def _check_graph(check: Check) -> None:
    """Check that no cell lists a neighbor twice, and that neighbors list each other."""
    d = check.diagram
    i, j = d.half_faces.owner, d.neighbors
    check.note("neighbors", (i == j) & ~d.shifts.any(axis=1), lambda f: f"cell {j[f]} is its own neighbor")
    inner = np.flatnonzero(j >= 0)
    there, back = d.half_faces.keys(inner)
    order = np.argsort(there)
    sorted_ = there[order]

    def pair(key: int) -> tuple[int, int]:
        """Return the cells of a face."""
        face = inner[order[np.searchsorted(sorted_, key)]]
        return int(i[face]), int(j[face])

    twice = np.flatnonzero(sorted_[1:] == sorted_[:-1])
    check.note(
        "neighbors",
        np.isin(np.arange(len(there)), twice),
        lambda k: "cell {} lists cell {} twice".format(*pair(sorted_[k])),
    )
    lone = np.setdiff1d(there, back)
    check.note(
        "graph symmetric",
        np.ones(len(lone)),
        lambda k: "cell {} lists cell {}, which does not list it".format(*pair(lone[k])),
        stop=True,
    )


def _check_shifts(check: Check) -> None:
    """Check that faces lead to images only in periodic directions, and to walls only in the others."""
    d = check.diagram
    periodic = np.array(d.domain.periodic)
    shifts, j = d.shifts, d.neighbors
    allowed = np.where(periodic & (j >= 0)[:, None], 1, 0)
    check.note(
        "shifts",
        (np.abs(shifts) > allowed).any(axis=1),
        lambda f: f"shifts[{f}] of the face to {j[f]} is {shifts[f]}, expected -1 to 1 along periodic axes, else 0",
        stop=True,
    )
    if periodic.any():
        walls = np.flatnonzero(j < 0)
        check.note(
            "walls",
            d.domain.boundary_index[-1 - j[walls]] < 0,
            lambda k: f"face {walls[k]} leads to wall {-1 - j[walls[k]]}, across a periodic axis",
            stop=True,
        )


def _check_starts(check: Check, name: str, starts: np.ndarray, total: int) -> None:
    """Check that `starts` are ascending offsets from 0 to `total`."""
    good = len(starts) > 0 and starts[0] == 0 and starts[-1] == total
    rises = np.diff(starts.astype(np.int64)) if len(starts) else np.zeros(0)
    check.note(
        "shapes",
        np.array([not good or bool((rises < 0).any())]),
        lambda _: f"{name} does not cut {total} entries into rows",
        stop=True,
    )


def _check_geometry(check: Check, g: Rebuilt) -> None:
    """Check positions, volumes and faces against the rebuilt cells `g`."""
    d = check.diagram
    n, domain = len(d), d.domain
    slack = ROUNDINGS * g.unit
    doubts = g.doubts(slack)
    if domain.curved:
        check_places(check, g)
    else:
        _check_inside(check, slack)
    # Cells of a power diagram may be empty.
    filled = np.diff(d.neighbor_starts) > 0 if d.is_power else np.ones(n, bool)
    check.note(
        "volumes",
        ~(d.volumes > 0) & (filled | (d.volumes != 0)),
        lambda i: f"volumes[{i}] is {d.volumes[i]}, expected > 0",
    )
    check.note(
        "orientation",
        ~(g.volumes >= -slack * (g.perimeters + slack)),
        lambda i: f"the corners of cell {i} go around clockwise (volume {g.volumes[i]:.4g})",
    )
    check.compare("volumes", d.volumes, g.volumes, doubts.volumes + slack**domain.cell_dim)
    total = float(d.volumes.sum())
    border = domain.boundary_measure
    allowed = slack * (g.perimeters.sum() / np.sqrt(n) + border)
    check.note(
        "volumes sum",
        np.array([abs(total - domain.measure) > allowed]),
        lambda _: f"the volumes' sum is {total:.17g}, expected the domain's {domain.measure:.17g}",
    )
    _check_faces(check, g, slack, doubts)
    if domain.curved:
        check_generators(check, g)
    else:
        check_measures(check, g, doubts)
    # The error of a centroid is relative to the volume.
    doubt = slack + doubts.volumes * g.reach / np.maximum(g.volumes, 1e-300)
    check.compare("centroids", d.centroids, d.points + g.centroids, doubt)
    if (outline := domain.outline) is not None:
        check_edges(check, outline, g, slack)
        check_cells(check, outline, g, slack)
    _check_nearest(check, g, slack)


def check_solid(check: Check, g: Rebuilt) -> None:
    """Check a mesh with moved vertices: measures are those of its corners, and wall polygons follow the surface.

    Wall polygons are chords of a curved surface, and their corners no farther from it than `SAGITTAS`: what the cells
    lack of the solid, or have beyond it, lies between the polygons and the surface. Inside, vertices are
    equidistant from the generators around them up to what merging and the surface have moved them, `MOVED` of the size
    of a cell.
    """
    d, slack = check.diagram, ROUNDINGS * g.unit
    faces, domain = d.faces, d.domain
    geometry = faces.measures.geometry
    check.note("volumes", ~(d.volumes > 0), lambda i: f"volumes[{i}] is {d.volumes[i]}, expected > 0")
    check.compare("volumes", d.volumes, geometry.volumes, slack * g.perimeters)
    check.compare("centroids", d.centroids, geometry.centroids, slack)
    check.compare("face measures", d.face_measures, g.measures, slack * g.reach[g.owner])
    _check_sum(check, g.owner, g.areas, slack * g.reach)
    _check_closed(check, g, slack)
    corners = _check_walls_of_solid(check, slack)
    inner = np.ones(len(d.vertices), bool)
    inner[corners] = False
    if domain.sheets is not None:
        starts, corners = take_rows(faces.starts, faces.corners, d.border_faces)
        deepest = _largest_at(corners, starts, domain.sheets.heights_over(d.vertices[corners], starts), len(d.vertices))
        placed = np.unique(corners)
        placed = placed[inner[placed]]
        off = domain.sheets.distance(d.vertices[placed])
        check.note(
            "surfaces inside",
            np.maximum(off - 10 * slack - SAGITTAS * deepest[placed], 0),
            lambda k: f"vertex {placed[k]} of a face on a surface inside is off it by {off[k]:.3g}",
        )
        inner[placed] = False
    if not d.layer.any():  # else inner vertices have made room for layers
        _check_nearest_of_solid(check, g, np.flatnonzero(inner[g.corners]), slack)


def _largest_at(corners: np.ndarray, starts: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    """Return for `n` vertices the largest of the `values` (f,) of the faces with these `corners` (c,), at least 0."""
    found = np.zeros(n)
    np.maximum.at(found, corners, np.repeat(values, np.diff(starts)))
    return found


def _check_walls_of_solid(check: Check, slack: float) -> np.ndarray:
    """Check wall vertices and the sum of the volumes; return the vertices of faces on walls, (k,) int."""
    d = check.diagram
    faces, domain = d.faces, d.domain
    wall = faces.starts[faces.n_inner]
    corners = np.unique(faces.corners[wall:])
    # Faces towards cells that `subset` removed are not on the surface.
    on_surface = ~domain.removed_behind(-1 - faces.neighbor[faces.n_inner :])
    starts = faces.starts[faces.n_inner :] - wall
    held = np.unique(faces.corners[wall:][np.repeat(on_surface, np.diff(starts))])
    heights = domain.uncut.heights_over(d.vertices, starts, faces.corners[wall:])
    deepest = _largest_at(faces.corners[wall:], starts, np.where(on_surface, heights, 0), len(d.vertices))
    away = domain.uncut.boundary_distance(d.vertices[held])
    check.note(
        "walls",
        np.maximum(away - 1e3 * slack - SAGITTAS * deepest[held], 0),
        lambda k: f"vertex {held[k]} of a face on a wall is off the surface by {away[k]:.3g}",
    )
    center, area = faces.center[faces.n_inner :], faces.area[faces.n_inner :]
    between = float((area * domain.boundary_distance(center)).sum())
    total = float(d.volumes.sum())
    most = 2 * between + slack * domain.boundary_measure
    if abs(total - domain.measure) > most and len(d.left_out):  # parts are counted to about 0.01 of a cell
        most += float(np.abs(d.left_out.measures).sum() + 0.01 * d.volumes.max())
    check.note(
        "volumes sum",
        np.array([abs(total - domain.measure) > most]),
        lambda _: f"the volumes' sum is {total:.17g}, expected {domain.measure:.17g} up to {most:.3g}",
    )
    return corners


def _check_nearest_of_solid(check: Check, g: Rebuilt, kept: np.ndarray, slack: float) -> None:
    """Check that the corners `kept` (k,) int of cells are nearest to the generators of these, up to `MOVED`."""
    d = check.diagram
    x, own = d.vertices[g.corners[kept]], g.cells[kept]
    # Parts of cells that have been cut come last, with their centroids as generators.
    whole = np.flatnonzero(np.linalg.norm(d.points - d.centroids, axis=1) > slack)
    n = int(whole[-1]) + 1 if whole.size else len(d)
    tree, home = scipy.spatial.KDTree(d.points[:n]), np.arange(len(d))
    home[n:] = tree.query(d.points[n:])[1]
    size = np.cbrt(np.maximum(d.volumes, 0))
    beyond = np.linalg.norm(x - d.points[home[own]], axis=1) - tree.query(x)[0] - MOVED * size[home[own]]
    check.note(
        "nearest generators",
        np.maximum(beyond, 0),
        lambda k: f"vertex {g.corners[kept[k]]} of cell {own[k]} is nearer to another generator, by {beyond[k]:.3g}",
    )


def _check_inside(check: Check, slack: float) -> None:
    """Check that generators and vertices lie in the domain."""
    d, domain = check.diagram, check.diagram.domain
    check.note(
        "generators inside",
        ~domain.contains(d.points) | (domain.wrap(d.points) != d.points).any(axis=1),
        lambda i: f"generator {i} at {d.points[i]} lies outside {domain}",
    )
    outside = np.flatnonzero(~domain.contains(d.vertices))
    if not domain.plain:  # vertices on oblique walls have round-off
        outside = outside[domain.boundary_distance(d.vertices[outside]) > slack]
    check.note(
        "vertices inside",
        np.ones(len(outside)),
        lambda k: f"vertex {outside[k]} at {d.vertices[outside[k]]} lies outside {domain}",
    )


def _check_faces(check: Check, g: Rebuilt, slack: float, doubts: Doubts) -> None:
    """Check faces: closed around each cell, right measures, outward, on their walls, equal on both sides."""
    d, width = check.diagram, doubts.measures
    if not d.domain.curved:
        _check_closed(check, g, slack)
    check.compare("face measures", d.face_measures, g.measures, width)
    middle = d.face_centroids - d.points[g.owner]
    off = np.linalg.norm(middle - g.middles, axis=1)
    if g.edges is not None:
        # The centroid of a needle is uncertain along it: compare first moments.
        off = np.minimum(off, off * g.measures / np.maximum(g.reach[g.owner], 1e-150) ** 2)
    check.note(
        "face centroids",
        np.maximum(off - 4 * doubts.middles, 0),
        lambda f: (
            f"face_centroids[{f}] of cell {g.owner[f]} is {d.face_centroids[f]}, its corners give "
            f"{d.points[g.owner[f]] + g.middles[f]}"
        ),
    )
    _check_sides(check, g, slack, width)


def _check_closed(check: Check, g: Rebuilt, slack: float) -> None:
    """Check that the faces of each cell close it: at edges in 3D, and as a sum of vectors."""
    d = check.diagram
    n = len(d)
    if g.edges is not None:
        face, a, b = g.edges
        key = (g.owner[face].astype(np.int64), np.minimum(a, b), np.maximum(a, b))
        order = np.lexsort(key[::-1])
        new = np.any([np.diff(k[order], prepend=-1) != 0 for k in key], axis=0)
        group = np.cumsum(new) - 1
        turns = np.bincount(group, np.where(a < b, 1, np.where(a > b, -1, 0))[order])
        where = order[new]
        odd = np.flatnonzero(turns)
        turns[odd[g.are_slits(where[odd], slack)]] = 0
        check.note(
            "faces closed",
            turns != 0,
            lambda k: (
                f"cell {g.owner[face[where[k]]]} is open, or its faces turn different ways, at the edge "
                f"from vertex {a[where[k]]} to {b[where[k]]}"
            ),
        )
    gap = np.linalg.norm(sum_rows(g.owner, g.areas, n), axis=1)
    bound = np.full(n, slack)
    if g.edges is not None:
        # Between neighboring faces slits may remain, as wide as the round-off of their bisectors.
        near = np.full(n, np.inf)
        np.minimum.at(near, g.owner, g.spacings)
        bound *= 2 * g.reach * (1 + g.reach / near)
    check.note("faces closed", np.maximum(gap - bound, 0), lambda i: f"the faces of cell {i} do not close")


def _check_sides(check: Check, g: Rebuilt, slack: float, width: np.ndarray) -> None:
    """Check that faces point outward, lie on their walls, and have one measure on both sides (within `width`)."""
    d = check.diagram
    inner, walls = np.flatnonzero(d.neighbors >= 0), np.flatnonzero(d.neighbors < 0)
    inward = -np.einsum("ij,ij->i", g.areas, g.directions)
    if d.domain.cuts_cells:
        # A part that the boundary cuts off from its generator belongs to an adjacent cell. Its faces are not on the
        # bisector, and single ones between the same two cells may point inward.
        pair = np.unique(g.owner * (len(d) + 1) + np.maximum(d.neighbors, -1) + 1, return_inverse=True)[1]
        together = np.bincount(pair, inward)[pair]
        inward = np.where(d.neighbors >= 0, np.minimum(inward, together), inward)
    check.note(
        "faces outward",
        np.maximum(inward - width, 0),
        lambda f: f"face {f} of cell {g.owner[f]} does not look towards {d.neighbors[f]}",
    )
    if len(walls) and not d.domain.curved:
        # Faces towards removed cells are on bisectors; see `check_generators`.
        middles = g.middles[walls] + d.points[g.owner[walls]]
        height = d.domain.wall_distance(-1 - d.neighbors[walls], middles)
        height[g.measures[walls] == 0] = 0  # a face without measure has no place
        check.note(
            "walls",
            np.maximum(height - slack, 0),
            lambda k: f"face {walls[k]} of cell {g.owner[walls[k]]} is off its wall by {height[k]:.3g}",
        )
    here, there = inner, d.half_faces.opposite[inner]
    off = np.abs(d.face_measures[here] - d.face_measures[there])
    wide = np.maximum(width[here], width[there])
    check.note(
        "faces the same from both sides",
        np.maximum(off - 2 * wide, 0),
        lambda k: (
            f"the face of cells {g.owner[here[k]]} and {d.neighbors[here[k]]} measures "
            f"{d.face_measures[here[k]]:.17g} and {d.face_measures[there[k]]:.17g}"
        ),
    )


def _check_nearest(check: Check, g: Rebuilt, slack: float) -> None:
    """Check the property of a Voronoi diagram: no generator is nearer to a corner of a cell than the cell's own.

    Generators whose cells meet in a vertex then have the same distance from it. On a sphere distances are arcs. In a
    power diagram they are lengths in the space of `power_tree`.
    """
    d = check.diagram
    corners = d.vertices[g.corners]
    lower, periods = np.array(d.domain.lower), np.where(d.domain.periodic, d.domain.extent, 0.0)
    last = np.where(periods > 0, np.nextafter(periods, 0), np.inf)
    # The tree takes a period of 0 for an axis that is not periodic.
    tree = power_tree(d, np.minimum(d.points - lower, last), periods)
    lengths = d.domain.lengths
    own, nearest = corners - d.points[g.cells], tree.query(lifted(d, d.vertices - lower))[0][g.corners]
    if d.is_power:
        moved, heights = d.domain.lift(d.points, d.weights)
        own = np.column_stack([own - np.broadcast_to(moved, d.points.shape)[g.cells], heights[g.cells]])
    own, nearest = np.linalg.norm(own, axis=1), nearest
    if not d.is_power:
        own, nearest = lengths(own), lengths(nearest)
    excess = np.maximum(own - nearest - slack, 0)
    if d.domain.outline is not None and not d.is_power:
        excess[hidden(d, d.domain.outline, tree, np.flatnonzero(excess), g.corners, slack, g.unit)] = 0
    check.note(
        "nearest generators",
        excess,
        lambda k: (
            f"vertex {g.corners[k]} of cell {g.cells[k]} is nearer to another generator, by {own[k] - nearest[k]:.3g}"
        ),
    )
