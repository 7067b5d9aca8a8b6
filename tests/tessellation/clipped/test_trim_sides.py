"""Sides of cells at the boundary: which parts of it count as one side, on the device and on the host."""

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.adaptation.stages import Stages
from clvoro.mesh.straightening import straighten
from clvoro.opencl.engine import Engine
from clvoro.tessellation.tessellator import Tessellator
from tests.reference.shores import DIAMOND, POLYGONS, TOUCHING, UNIT, comb, scattered
from tests.reference.wall_sides import outlines

REALS = ("float64", "float32")
BLUNT = np.array([(0.5, 0.5), (0.4, 0.9), (0.1, 0.5), (0.4, 0.1)])
"""A hole with a corner of 28 degrees, so blunt that its two edges are one side."""


def blunt_holes() -> clvoro.Polygon:
    """Return two such holes that touch at that corner: the domain has tips above and below it."""
    return clvoro.Polygon(UNIT, [BLUNT, BLUNT * (-1, 1) + (1, 0)])


def circle(k: int, turned: float = 0.0) -> np.ndarray:
    angle = np.arange(k) * (2 * np.pi / k) + turned
    return np.column_stack([np.cos(angle), np.sin(angle)])


@pytest.fixture(scope="module")
def adapters(ctx):
    return {real: clvoro.Adapter(ctx, real) for real in REALS}


def compare(adapter, domain, points):
    """Compare sides and qualities of host, device and reference; return the outlines and the result."""
    result = adapter.run(domain, 1.0, points=points, method="lloyd", max_steps=0)
    diagram, real = result.diagram, adapter.dtype
    found, straight = outlines(diagram), straighten(diagram)
    assert straight.sides.tolist() == [o.sides for o in found]
    some = [i for i, o in enumerate(found) if o.sides >= 3 and o.area > 0]
    areas, perimeters = np.array([(found[i].area, found[i].perimeter) for i in some]).T
    size = float(domain.extent.max())
    far = max(map(abs, (*domain.lower, *domain.upper)))
    # Sums over some hundred faces, each rounded twice.
    rounding = 1024 * (2.2e-16 * (size + far))
    assert np.abs(straight.areas[some] - areas).max() < rounding * size + 64 * size**2 * (np.finfo(real).eps)
    assert np.abs(straight.perimeters[some] - perimeters).max() < rounding + 64 * size * (np.finfo(real).eps)
    report = result.check()
    assert report, report
    return found, result


@pytest.mark.parametrize("real", REALS)
def test_a_boundary_goes_along_its_rings_where_they_touch(adapters, real):
    """One cell has both tips at the corner that two holes share; its sides are those of the holes."""
    for points in (
        [(0.09, 0.35), (0.62, 0.02), (0.87, 0.85)],
        [(0.85, 0.16), (0.74, 0.02), (0.08, 1.0)],
        [(0.51, 0.95), (0.14, 0.95), (0.55, 0.03), (0.13, 0.4)],
    ):
        compare(adapters[real], blunt_holes(), np.array(points))


@pytest.mark.parametrize("real", REALS)
def test_parts_of_a_cell_on_both_sides_of_a_face_are_one(adapters, real):
    """A cell with parts on both sides of x = 1/2: the bottom is one side, a hole is none."""
    outer = [(0, 0), (0.62, 0), (0.48, 0.6), (0.66, 0), (1, 0), (1, 1), (0, 1)]
    hole = np.array([(0.47, 0.1), (0.53, 0.1), (0.53, 0.2), (0.47, 0.2)])
    points = np.array([(0.3, 0.3), (0.7, 0.3)])
    for holes in ([], [hole], [hole + 0.01, DIAMOND * 0.1 + (0.1, 0.1)]):
        found, result = compare(adapters[real], clvoro.Polygon(outer, holes), points)
        bisector = result.diagram.neighbors >= 0
        assert found[0].sides == 5  # left, bottom, across the spit, top; the bisector
        assert bisector.sum() == 2
        assert (result.diagram.neighbors == -1).sum() == 2  # the bottom is cut, and none the less one side


@pytest.mark.parametrize("real", REALS)
def test_a_cell_cuts_re_entrant_corners_and_keeps_convex_ones(adapters, real):
    """Cells of a row above teeth: the sides and areas that a drawing gives."""
    teeth = [(1.2, 0), (1.5, 0.4), (1.8, 0), (2.2, 0), (2.5, -0.4), (2.8, 0)]
    domain = clvoro.Polygon([(0, 0), *teeth, (4, 0), (4, 1), (0, 1)])
    found, result = compare(adapters[real], domain, np.column_stack([np.arange(4) + 0.5, np.full(4, 0.6)]))
    assert [o.sides for o in found] == [4, 4, 5, 4]
    assert [o.area for o in found] == pytest.approx([1, 1, 1.2, 1], abs=1e-5)
    assert result.diagram.volumes == pytest.approx([1, 0.88, 1.12, 1], abs=1e-5)
    assert (1 + result.size_error)[:2] == pytest.approx([1, 1], abs=1e-5)


@pytest.mark.sparse(5)
@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize("name", [*POLYGONS, *(f"touching {name}" for name in TOUCHING)])
def test_sides_of_all_kinds_of_cells(adapters, real, name):
    if name.startswith("thin") and real == "float32":
        pytest.skip("its sides are in the same place")
    domain = (TOUCHING[name[9:]] if name.startswith("touching ") else POLYGONS[name])()
    for n in (1, 2, 3, 60):
        compare(adapters[real], domain, scattered(domain, n, n + 7))


@pytest.mark.parametrize("real", REALS)
def test_sides_along_edges_without_a_length(adapters, real):
    """Edges below round-off have no faces, but still turn the boundary."""
    tiny = 3e-11
    corner = np.array([(1 - tiny, 0), (1, tiny)])  # by 45 degrees twice
    bend = np.array([(0.5 - tiny, 1), (0.5 - 2 * tiny, 1 - 0.1 * tiny)])  # by some degrees, in sum by none
    domain = clvoro.Polygon(np.concatenate([[(0, 0)], corner, [(1, 1)], bend, [(0, 1)]]))
    _, result = compare(adapters[real], domain, np.array([(0.4, 0.3)]))
    assert len(result.diagram.neighbors) == (7 if real == "float64" else 5)
    compare(adapters[real], domain, scattered(domain, 40, 3))


@pytest.mark.sparse(1)
@pytest.mark.parametrize("real", REALS)
def test_missing_neighbors(ctx, real):
    """A cell at a straight wall lacks 2 neighbors, in a corner of 90 degrees 3.5, of 270 degrees 0.5."""
    for domain in (clvoro.Polygon(comb(2, 0.5, 0.3)), blunt_holes(), POLYGONS["islands"]()):
        dtype = np.dtype(real)
        engine = Engine(ctx, cl.CommandQueue(ctx), 2, dtype, domain.traits(dtype))
        points = scattered(domain, 90, 4)
        stages = Stages(engine)
        t = Tessellator(stages, domain).tessellate(engine.upload(domain.place(points, dtype)), len(points))
        missing = 6 - t.outlines[0].get().reshape(-1, 2)[: len(points), 1]
        diagram = clvoro.Adapter(ctx, real).diagram(domain, points)
        expected = [o.missing for o in outlines(diagram)]
        # Round-off of sums of up to a dozen turns.
        assert missing == pytest.approx(expected, abs=64 * float(np.finfo(dtype).eps))
        assert {0.0, 2.0} <= set(np.round(expected, 6).tolist())
