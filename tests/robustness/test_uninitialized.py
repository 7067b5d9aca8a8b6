"""No kernel reads what none has written: results are the same to the bit, whatever fresh memory holds.

Oclgrind's check for uninitialized reads does not look at global memory, so new buffers, and what is taken of the
workspace, are filled here with one pattern of bytes or another: NaN and -1, large numbers, zeros. Whoever reads them
gives it away, as does who reads an array of the workspace whose frame is over, once another has its place.
"""

import numpy as np
import pyopencl.array as cla
import pytest

import clvoro
from clvoro.opencl.engine import Engine
from clvoro.tessellation.part import Part
from tests.robustness.test_concurrency import BOX, SIZE, WORK, digest

PATTERNS = (0xFF, 0x00, 0x4B)


@pytest.fixture
def filled(monkeypatch):
    """Set the byte that fresh device memory is full of."""
    ways = {"empty": Engine.empty, "scratch": Engine.scratch}

    def fill_with(byte):
        for name, plain in ways.items():

            def filled(self, shape, dtype=None, plain=plain):
                array = plain(self, shape, dtype)
                if array.nbytes:
                    array.set(np.full(array.nbytes, byte, np.uint8).view(array.dtype).reshape(array.shape))
                return array

            monkeypatch.setattr(Engine, name, filled)

    return fill_with


@pytest.mark.sparse(1)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("options", WORK, ids=[str(w["method"]) for w in WORK])
def test_runs(ctx, filled, options, dtype):
    found = set()
    for byte in PATTERNS:
        filled(byte)
        adapter = clvoro.Adapter(ctx, dtype)
        found.add(digest(adapter.run(BOX, clvoro.sizing.Expression(SIZE), **options)))
    assert len(found) == 1


def test_diagrams(ctx, filled):
    rng = np.random.default_rng(7303)
    clusters = np.concatenate([rng.random((30, 2)), 0.3 + 1e-5 * rng.random((60, 2))])
    for points in (rng.random((1, 2)), rng.random((150, 2)), clusters):
        found = set()
        for byte in PATTERNS:
            filled(byte)
            d = clvoro.Adapter(ctx).diagram(BOX, points)
            found.add(b"".join(a.tobytes() for a in (d.volumes, d.neighbors, d.vertices, d.centroids)))
        assert len(found) == 1


def test_multigrid(ctx, filled):
    from clvoro.solvers.poisson import Poisson

    found = set()
    points = np.random.default_rng(7307).random((900, 2))
    for byte in PATTERNS:
        filled(byte)
        adapter = clvoro.Adapter(ctx)
        adapter.diagram(BOX, points[:1])
        stages, (origin, scale) = adapter._stages_for(BOX), BOX.frame
        engine = stages.engine
        x = engine.upload((points - origin) / scale)
        t = stages.cells.tessellate(Part.alone(x, BOX), stages.bins.build(BOX, x, 900))
        stage = Poisson(engine)
        laplacian = stage.assemble(t.starts, t.neighbors, t.face_measures, t.points)
        rhs, phi = engine.upload(points[:, 0]), engine.zeros(900)
        assert stage.solve(laplacian, rhs, phi, preconditioner="multigrid").converged
        found.add(phi.get().tobytes())
    assert len(found) == 1


def test_the_check_can_fail(ctx, filled):
    filled(0xFF)
    engine = clvoro.Adapter(ctx)._stages_for(BOX).engine
    assert isinstance(engine.empty(3), cla.Array)
    assert np.isnan(engine.empty(3).get()).all()
    filled(0x00)
    assert (engine.empty(3).get() == 0).all()
