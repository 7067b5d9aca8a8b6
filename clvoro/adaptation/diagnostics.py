"""Warnings for plausible input mistakes: before a run for its input and precision, after it for its errors."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..arguments import counted, format_point, warn
from ..errors import InputError, MismatchWarning, ObtuseTrianglesWarning, PrecisionWarning, SizeErrorWarning
from ..geometry.domain import Domain
from ..geometry.gaps import NARROW_GAP
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from ..sizing import Sizing

MOVED = 1e-3
"""Way of a fixed generator over h above which a run says so."""
MISSED = 0.2
"""Mean |e| above which a run has not met its sizes."""
FAR_ERROR = 10.0
"""Mean |e| from which a method that keeps the number of cells says that the sizes are others."""
MEAN_ERROR, LARGEST_ERROR = 0.05, 1.0
"""Limits of |e|. For size fields of moderate growth the mean is at most 0.02 and the largest value at most 0.3; where h
jumps 1 : 2 between two cells, the largest value is 1."""
STEEP = 1.25
"""Ratio of the sizes of adjacent cells above which a size error is attributed to the growth of h."""
ROUND_OFF_ERROR = 0.1
"""Mean |e| because of round-off, over the ratio of the spacing of positions to h. Random changes of up to half a
spacing cost 0.095 (0.07 in 3D) times this ratio (`tests/adaptation/test_precision.py`)."""
MAX_ROUND_OFF_ERROR = 1e-3
"""Mean |e| because of round-off above which a run warns."""
SHORTEST_EDGE, MAX_EDGE_ERROR = 0.13, 1e-4
"""On a sphere: length of the shortest edges over h, and the relative error of edges from corner to corner above which a
run warns. The spacing of positions over the shortest edge is about the largest error (`bench/sphere.py --single`)."""
MAX_SPACING = 1 / 16
"""Spacing of positions over the smallest h above which a run warns: random starts have pairs much closer than h."""

_SAFELY = 0.99  # of the size below which the gap is wide and the body thick enough: it is rounded


def warn_of_narrow_parts(domain: Domain, size: Callable[[np.ndarray], np.ndarray]) -> None:
    """Warn if cells of the target size do not fit between walls of `domain`, in many places, or into a dead end.

    - `size`: takes points (n, d) and returns target sizes (n,).

    Warns with `MismatchWarning`.
    """
    strait, dead_end = domain.narrow_parts(size)
    found = strait or dead_end
    if found is None:
        return
    here = f"{found.width:.3g} wide at {format_point(found.place)}, where the size field is {found.size:.3g}; "
    remedy = domain.remedy_for_narrow_parts
    if strait is not None:
        text = f"the domain is narrower than half a cell: {here}cells there are long and reach from wall to wall"
    elif found.behind:
        text = (
            f"{found.share:.0%} of the walls are in gaps of less than {NARROW_GAP:g} cells beside bodies thinner than "
            f"a cell: such a gap is {here}a body beside it is {found.behind:.3g} thick. Such meshes take longer, and "
            "OpenFOAM may not accept cells there"
        )
        remedy = f"Use sizes of at most {_SAFELY * min(found.behind, found.width / NARROW_GAP):.3g} there"
    elif found.share:
        text = (
            f"{found.share:.0%} of the walls are nearer than a cell to one that faces them: the domain is {here}such "
            "meshes take longer, and OpenFOAM may not accept cells there"
        )
    else:
        text = f"the domain has a dead end that is narrower than a cell: {here}cells there have poor shapes"
    warn(f"{text}. {remedy}", MismatchWarning)


def warn_of_moved_points(fixed: np.ndarray, diagram: Diagram, sizes: np.ndarray) -> None:
    """Warn if `fixed` generators (k, 3) have made room for layers of prisms in `diagram`.

    They are the first generators of the run, whose target sizes are `sizes` (n,).

    Warns with `MismatchWarning`.
    """
    assert diagram.home is not None
    cells = np.flatnonzero((diagram.home >= 0) & (diagram.home < len(fixed)))
    who = diagram.home[cells]
    away = np.linalg.norm(diagram.points[cells] - fixed[who], axis=1)
    moved = away > MOVED * sizes[who]
    if moved.any():
        k = int(away.argmax())
        warn(
            f"fixed[{who[k]}] at {format_point(fixed[who[k]])} has moved by {away[k]:.2g}, as its cell makes room for "
            f"layers of prisms; {np.count_nonzero(moved)} of {len(fixed)} have moved. Use thinner layers, or none on "
            "walls near fixed generators",
            MismatchWarning,
        )


def warn_of_other_sizes(result: Result) -> None:
    """Warn if a method that keeps the number of cells ends with cells of a size far from that of the field.

    Warns with `SizeErrorWarning`.
    """
    mean = float(np.abs(result.size_error).mean())
    if mean < FAR_ERROR or len(result) == 1:  # another warning says that the size is larger than the domain
        return
    dim = result.diagram.domain.cell_dim
    ratio = f"{float(f'{np.median(result.diagram.volumes ** (1 / dim) / result.target_size):.2g}'):g}"
    warn(
        f"mean |e| is {mean:.3g}: the cells have {ratio} times the sizes of the size field, as method "
        f"{result.settings['method']!r} keeps {result.history['cells'][-1]} cells; use the field times {ratio}, or "
        "method='adaptive', which makes as many cells as the field requires",
        SizeErrorWarning,
    )


def warn_of_errors(result: Result, size: Callable[[np.ndarray], np.ndarray]) -> None:
    """Warn if a converged mesh does not have the sizes of its field `size`, and name the worst cell.

    Warns with `SizeErrorWarning`.
    """
    amounts = np.abs(result.size_error)
    worst = int(amounts.argmax())
    # Prisms have no error.
    mean, largest = float(amounts[result.diagram.layer == 0].mean()), float(amounts[worst])
    # The caller may have given a large error target.
    settings = result.settings
    aimed = settings.get("error_target") if settings.get("method") == "adaptive" else None
    if mean < max(MEAN_ERROR, aimed or 0.0) and largest < LARGEST_ERROR:
        return
    diagram, sizes = result.diagram, result.target_size
    wanted = float(sizes[worst])
    made = max(float(diagram.volumes[worst]), 0.0) ** (1 / diagram.domain.cell_dim)  # a cell may be inverted
    if len(diagram) == 1 and 2 * made**diagram.domain.cell_dim < wanted**diagram.domain.cell_dim:
        return  # `CoarseSizeWarning` says it before the run
    place = diagram.domain.place_name(result.points[worst])
    near = [worst, *_ring(diagram, worst)]
    pairs = np.array([(i, j) for i in near for j in [i, *_ring(diagram, i)]])
    # Not `target_size`: cells at creases have sizes of their own.
    rows, place_of = np.unique(pairs, return_inverse=True)
    first, second = np.log(size(diagram.points[rows]))[place_of.reshape(-1, 2)].T
    steep = bool(np.abs(first - second).max() > math.log(STEEP))
    if diagram.layer.any():
        why = (
            "cells beside layers of prisms make room for them, and are too large where these are thinner than given: "
            "use thinner layers"
        )
    elif not made > 0:
        why = "that cell has no volume, as walls there are nearer to each other than cells are wide: use smaller sizes"
    elif steep and any(diagram.shifts[slice(*diagram.neighbor_starts[i : i + 2])].any() for i in near):
        why = (
            "sizes jump at a seam of the periodic box: a field must have the period of the box; repeat its shapes one "
            "period away"
        )
    elif steep:
        scaled = f"{result.size_factor:.3g} * size" if abs(math.log(result.size_factor)) > math.log(STEEP) else "size"
        why = (
            "sizes change there by more than cells can follow from one to the next: bound their growth, as by "
            f"sizing.Graded({scaled}, growth=1.2), or use more cells"
        )
    else:
        why = diagram.domain.why_sizes_are_missed(result.points[worst], wanted, len(diagram))
    empty = int(np.count_nonzero(~np.isfinite(amounts)))
    found = f"{counted(empty, 'cell')} of size 0" if empty else f"mean |e| is {mean:.2g}"
    warn(
        f"the mesh does not meet its size field: {found}, and a cell at {place} has the size "
        f"{made:.3g} where the size field is {wanted:.3g}; {why}",
        SizeErrorWarning,
    )


def _ring(diagram: Diagram, i: int) -> np.ndarray:
    """Return the neighbors of cell `i`, without walls."""
    row = diagram.neighbors[diagram.neighbor_starts[i] : diagram.neighbor_starts[i + 1]]
    return row[row >= 0]


def warn_of_obtuse_triangles(result: Result) -> None:
    """Warn if a mesh on a sphere has obtuse triangles, and name the worst.

    Warns with `ObtuseTrianglesWarning`.
    """
    diagram, sizes, grid = result.diagram, result.target_size, result.measures.c_grid
    if grid.obtuse == 0:
        return
    k = int(grid.angles.argmax())
    half_face = grid.corners[k]
    pair = int(diagram.half_faces.owner[half_face]), int(diagram.neighbors[half_face])
    vertex = diagram.vertices[diagram.half_faces.ends[half_face, 0]]
    ratios = np.concatenate([sizes[_ring(diagram, i)] / sizes[i] for i in pair])
    growth = max(ratios.max(), 1 / ratios.min())
    if growth > STEEP:
        why = (
            f"sizes grow by a factor of {growth:.2g} from cell to cell there: bound their growth, as by "
            "sizing.Graded(size, growth=1.2)"
        )
    else:
        why = "another seed, or more cells, may give a mesh without"
    some = f"{grid.obtuse} obtuse triangles" if grid.obtuse > 1 else "an obtuse triangle"
    warn(
        f"the mesh has {some}, which C grids do not allow, with an angle of up to {grid.angles[k]:.1f} degrees at "
        f"{diagram.domain.place_name(vertex)}; {why}",
        ObtuseTrianglesWarning,
    )


def check_precision(sizing: Sizing, domain: Domain, points: np.ndarray, factor: float = 1.0) -> float:
    """Raise or warn if the device's precision does not resolve the sizes of `sizing` times `factor`.

    Positions in the domain's frame are rounded to multiples of 2^-24 (in single precision).

    - `points` (n, d) float64: generators, or a sample of them on a coarser level, with the density of the cells.

    Return the mean over `points` of the spacing of positions over h.

    Raises `InputError` if h is less than the spacing of positions at one of `points`.
    Warns with `PrecisionWarning` if round-off costs more than `MAX_ROUND_OFF_ERROR`, or the spacing is more than
    `MAX_SPACING` times h; on a sphere also if edges are off by more than `MAX_EDGE_ERROR`.
    """
    real = sizing.real
    spacing = float(np.finfo(real).eps) / 2 * domain.frame[1]
    h = sizing(points) * factor
    remedy = "use dtype='float64', a smaller domain or larger sizes"
    if real == np.float64:
        remedy = "use a smaller domain or larger sizes"
    least = int(np.argmin(h))
    if h[least] < spacing:
        where = domain.place_name(points[least])
        raise InputError(
            f"the size field is {h[least]:.3g} at {where}, but positions in {real} are "
            f"{spacing:.3g} apart in this domain: generators would coincide; {remedy}"
        )
    if domain.curved:
        short = spacing > MAX_EDGE_ERROR * SHORTEST_EDGE * h
        if short.any():
            warn(
                f"positions in {real} are {spacing:.3g} apart on {domain}: edges are off by up to "
                f"{spacing / (SHORTEST_EDGE * h[least]):.1g} of their lengths, and in {short.mean():.0%} of the cells "
                f"by more than {MAX_EDGE_ERROR:g}; models on C grids divide by them: {remedy}",
                PrecisionWarning,
            )
    mean = float((spacing / h).mean())
    if ROUND_OFF_ERROR * mean > MAX_ROUND_OFF_ERROR or spacing > MAX_SPACING * h[least]:
        warn(
            f"positions in {real} are {spacing:.3g} apart in this domain, which is {mean:.2g} of the sizes on average "
            f"and {spacing / h[least]:.2g} of the smallest: round-off alone costs a mean error of "
            f"{ROUND_OFF_ERROR * mean:.2g}, and generators may coincide; {remedy}",
            PrecisionWarning,
        )
    return mean
