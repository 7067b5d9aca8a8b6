"""Corners of polygons on faces and on vertices: ties that all edges and cells must decide in the same way.

Most such polygons do not reveal a wrong rule. Each rule in boundary_crossings.cl has some here that do.
"""

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.tessellation.clipped import cut as cut_module
from clvoro.tessellation.clipped.boundary_crossings import Boundary, BoundaryError
from tests.reference.diagrams import faults
from tests.reference.shores import blocks, slit, spit

RING = [(x, y) for x in range(-25, 26) for y in range(-25, 26) if x * x + y * y == 625]
"""Integer points exactly on a circle: all faces between neighbors meet at its center."""


@pytest.fixture(scope="module")
def adapters(ctx):
    return [clvoro.Adapter(ctx, real) for real in ("float64", "float32")]


def check(adapters, shape, points):
    domain = clvoro.Polygon.from_shapely(shape)
    points = np.unique(points[domain.contains(points)], axis=0)
    for adapter in adapters if len(points) else ():
        diagram = adapter.diagram(domain, points)
        assert not faults(diagram)
        # Round-off of some hundred corners in the unit square.
        eps = float(np.finfo(adapter.dtype).eps)
        assert diagram.volumes.sum(dtype=float) == pytest.approx(domain.measure, abs=64 * eps)


@pytest.mark.sparse(10)
@pytest.mark.parametrize("seed", [*range(160, 190), 5215])
def test_blocks_and_lattices(adapters, seed):
    """Squares of a lattice, some cut in half, with some generators of the same lattice or of a finer one."""
    rng = np.random.default_rng(seed)
    side = int(rng.choice([2, 3, 4]))
    shape = blocks(rng, side)
    if seed % 3 == 1:
        for i, j in np.argwhere(rng.random((side, side)) < 0.3) / side:
            corner = shapely.Polygon([(i, j), (i + 1 / side, j), (i, j + 1 / side)])
            shape = shape.difference(corner)
    k = int(rng.choice([1, 2, 4])) * side
    line = (np.arange(k) + 0.5) / k if rng.random() < 0.5 else np.arange(k + 1) / k
    points = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    check(adapters, shape, points[rng.random(len(points)) < rng.choice([0.3, 0.6, 1.0])])


@pytest.mark.sparse(9)
@pytest.mark.parametrize("seed", [*range(20), 111, 160, 211, 333, 385, 438, 5553])
def test_corners_where_many_faces_meet(adapters, seed):
    """A wedge of the square, a hole, or a polygon, with a corner at the center of generators on a circle."""
    rng = np.random.default_rng(seed)
    center, ends = np.array([0.5, 0.5]), rng.integers(0, 9, (3, 2)) / 8
    square = shapely.box(0, 0, 1, 1)
    if seed % 3 == 0:
        shape = square.difference(shapely.Polygon([center, ends[0], ends[1]]))
    elif seed % 3 == 1:
        shape = square.difference(shapely.Polygon([center, *(center + (ends[:2] - 0.5) / 4)]))
    else:
        shape = shapely.Polygon([center, *ends]).buffer(0)
    if shape.area < 0.01:
        pytest.skip("too little is left")
    ring = center + np.array(RING) / 64
    points = ring[rng.random(len(ring)) < rng.choice([0.15, 0.3, 0.6])]
    if rng.random() < 0.5:
        points = np.concatenate([points, rng.integers(0, 9, (4, 2)) / 8])
    check(adapters, shape, points)


@pytest.mark.slow
@pytest.mark.parametrize("real", [0, 1])
def test_generators_as_close_as_a_slit_is_wide(adapters, real):
    """Two close generators have nearly the same face with a third.

    The order in which the sides of the slit cross these faces follows from the face between the two generators.
    """
    adapter = adapters[real]
    for seed in range(40):
        rng = np.random.default_rng(seed)
        width = float(np.finfo(adapter.dtype).eps) * 10 ** rng.uniform(2, 6)
        domain = clvoro.Polygon(slit(width))
        near = [0.5, 1] + rng.uniform(-1, 1, (3, 2)) * (width, 0.3)
        near[:, 1] = np.minimum(near[:, 1], 2 - near[:, 1])
        points = np.concatenate([domain.vertices[3:6:2], near, rng.random((3, 2))])
        points = points[domain.contains(points)]
        placed = domain.place(points, adapter.dtype)
        diagram = adapter.diagram(domain, points[np.unique(placed, axis=0, return_index=True)[1]])
        assert not faults(diagram)
        report = diagram.check()
        assert report, report


@pytest.mark.sparse(1)
@pytest.mark.parametrize("make", [slit, spit])
@pytest.mark.parametrize("real", [0, 1])
def test_faces_across_the_tip_of_a_wedge(adapters, real, make):
    """Near the tip both sides cross a face within round-off, in a definite order."""
    adapter = adapters[real]
    domain = clvoro.Polygon(make(100 * float(np.finfo(adapter.dtype).eps)))
    tip = np.array([(0.5, 0.3), (2, 0.5)])[int(make is spit)]
    for seed in range(30):
        rng = np.random.default_rng(seed)
        points = np.concatenate([rng.random((20, 2)), tip + rng.normal(0, 0.05, (20, 2))])
        diagram = adapter.diagram(domain, points[domain.contains(points)])
        assert not faults(diagram)


PAIR = clvoro.Polygon.from_shapely(shapely.union(shapely.box(0, 0, 1, 1), shapely.box(1, 1, 2, 2)))
"""Two squares with a common corner."""


def crowd(seed: int, n: int) -> np.ndarray:
    """Return generators on a circle around that corner, where their faces meet up to round-off."""
    rng = np.random.default_rng(seed)
    angles = rng.uniform(0, 7) + 2 * np.pi * np.arange(n) / n
    points = 1 + rng.uniform(0.05, 0.3) * np.column_stack([np.cos(angles), np.sin(angles)])
    return points[PAIR.contains(points)]


@pytest.mark.sparse(2)
@pytest.mark.parametrize("real", [0, 1])
@pytest.mark.parametrize("n", [8, 60, 200])
def test_crowds_around_a_corner(adapters, real, n):
    """Edges once found no path from the corner through cells that round-off cuts off there."""
    for seed in range(10):
        diagram = adapters[real].diagram(PAIR, crowd(seed, n))
        assert not faults(diagram)
        report = diagram.check()
        assert report, report


def test_edges_without_a_path_shift_the_boundary_or_raise(adapters, monkeypatch):
    """The boundary is shifted slightly; an error is raised if that does not help."""
    monkeypatch.setattr(cut_module, "BOUNDARY_SHIFTS", ())
    with pytest.raises(BoundaryError, match="cannot be traced"):
        adapters[0].diagram(PAIR, crowd(0, 200))
    # Nothing of it is left.
    diagram = adapters[0].diagram(PAIR, crowd(0, 8))
    assert not faults(diagram)


@pytest.mark.parametrize("real", [0, 1])
def test_a_shifted_boundary(adapters, monkeypatch, real):
    """The shift equals the width of a hole in single precision: generators at its corners stay in the domain."""
    cut, shifts = Boundary.cut, []

    def cut_aside(boundary, t, generators, shift):
        shifts.append(any(shift))
        if not any(shift):
            raise BoundaryError
        return cut(boundary, t, generators, shift)

    monkeypatch.setattr(Boundary, "cut", cut_aside)
    adapter = adapters[real]
    eps = float(np.finfo(adapter.dtype).eps)
    rng = np.random.default_rng(5)
    angles = np.arange(8) * 0.8
    radius = max(20 * eps, 4e-12)  # edges are not shorter than 1e-12
    hole = shapely.Polygon(0.4 + radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    domain = clvoro.Polygon.from_shapely(shapely.box(0, 0, 1, 1).difference(hole))
    points = np.concatenate([domain.vertices[4::2], rng.random((30, 2))])
    diagram = adapter.diagram(domain, points)
    assert domain.contains(diagram.points).all()
    assert not faults(diagram)
    report = diagram.check()
    assert report, report
    # Measures are those of the shifted boundary, some eps away.
    off = domain.boundary_distance(diagram.vertices[~domain.contains(diagram.vertices)])
    assert 0 < off.max() <= (cut_module.BOUNDARY_SHIFTS[0] + 4) * eps * domain.frame[1]
    assert shifts == [False, True]
