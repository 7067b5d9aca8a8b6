"""Arrays of a frame do not overlap; the next frame uses the same memory."""

import gc
import weakref

import numpy as np
import pyopencl as cl
import pytest

from clvoro import sizing
from clvoro.adaptation.methods import ProjectedMethod, PublishedMethod, Relaxation, WeightedMethod
from clvoro.adaptation.stages import Stages
from clvoro.errors import MemoryLimitError
from clvoro.opencl import memory_limits, primitives
from clvoro.opencl.engine import Engine
from clvoro.opencl.workspace import MOST_VIEWS, SMALL, SPARE
from tests.reference import patch


@pytest.fixture
def made(monkeypatch):
    """Sizes of the buffers that were allocated."""
    sizes, plain = [], cl.Buffer

    class Counted(plain):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            sizes.append(self.size)

    monkeypatch.setattr(cl, "Buffer", Counted)
    return sizes


SHAPES = [(5, np.int32), ((100, 2), None), (1, np.uint8), (0, None), (7000, np.float32), (3, None)]


def take(engine):
    """Take arrays of several types and fill each with another number."""
    arrays = [engine.scratch(*shape) for shape in SHAPES]
    for k, array in enumerate(arrays):
        if array.size:
            array.fill(k + 1)
    return arrays


def check(arrays):
    for k, (array, (shape, dtype)) in enumerate(zip(arrays, SHAPES, strict=True)):
        assert array.shape == (shape if isinstance(shape, tuple) else (shape,))
        assert array.dtype == (np.float64 if dtype is None else dtype)
        assert (array.get() == k + 1).all()


def test_arrays_of_open_frames_do_not_overlap(engine):
    """In nested frames, too: while the memory grows, and when it is large enough."""
    for _ in range(3):
        with engine.workspace.frame():
            outer = take(engine)
            for _ in range(2):
                with engine.workspace.frame():
                    check([a for a, _ in zip(take(engine), outer, strict=True)])
            check(outer)
            again = take(engine)
            check(outer)
            check(again)


def test_frames_take_the_same_memory_in_turn(engine, made):
    """The first frame finds the sizes, and later ones allocate nothing."""
    for turn in range(5):
        if turn == 1:
            before = len(made)
        with engine.workspace.frame():
            take(engine)
            for _ in range(3):
                with engine.workspace.frame():
                    take(engine)
    assert len(made) == before
    once = sum(max(np.prod(shape, dtype=int) * np.dtype(dtype or float).itemsize, 1) for shape, dtype in SHAPES)
    # Two of each at a time.
    assert 2 * once <= sum(made) <= 2 * once * (1 + 1 / SPARE) + SMALL


def test_different_needs_in_turn_soon_allocate_nothing(engine, made):
    """Buffers that are too small are replaced. The memory is less than that of all needs together."""
    rng = np.random.default_rng(0)
    needs = [rng.integers(1, 10**5, size=rng.integers(1, 9)).tolist() for _ in range(12)]
    for turn in range(6):
        if turn == 5:
            before = len(made)
        for need in needs:
            with engine.workspace.frame():
                for n in need:
                    engine.scratch(n, np.uint8)
    assert len(made) == before
    held = sum(b.size for b in engine.workspace._buffers.values())
    most = max(map(sum, needs))
    assert most <= held <= 2 * most, "the pool is much larger than the largest need"


def test_choices_are_repeated_as_long_as_their_buffers_exist(engine):
    """Nested frames of random needs, some again and again: arrays in use never share a buffer, and all are counted."""
    rng, pool = np.random.default_rng(4), engine.workspace
    needs = [rng.integers(1, 10**5, size=6).tolist() for _ in range(9)]
    taken = {}
    for turn in range(300):
        k = int(rng.integers(len(needs)))
        with pool.frame():
            arrays = [engine.scratch(n, np.uint8) for n in needs[k][:3]]
            for inner in (needs[k][3:], needs[k - 1][3:]):
                with pool.frame():
                    all_ = [*arrays, *(engine.scratch(n, np.uint8) for n in inner)]
                    held = {buffer.int_ptr for buffer in pool._buffers.values()}
                    used = [array.base_data.int_ptr for array in all_]
                    assert len(set(used)) == len(used)
                    assert held.issuperset(used)
        if turn >= 250:
            assert all(a is b for a, b in zip(arrays, taken.get(k, arrays), strict=True))
            taken[k] = arrays


def test_arrays_begin_at_the_start_of_a_buffer(engine):
    """Kernels get buffers. Sub-buffers make NVIDIA's driver crash."""
    with engine.workspace.frame():
        buffers = [array.base_data for array in take(engine) if array.size]
        assert all(buffer.get_info(cl.mem_info.ASSOCIATED_MEMOBJECT) is None for buffer in buffers)
        assert len({buffer.int_ptr for buffer in buffers}) == len(buffers)


def test_failing_frame_frees_its_arrays(engine, made):
    def fail():
        with engine.workspace.frame():
            take(engine)
            raise ZeroDivisionError

    for _ in range(4):
        with pytest.raises(ZeroDivisionError):
            fail()
        count = len(made)
    with engine.workspace.frame():
        check(take(engine))
    assert len(made) == count


def test_arrays_outside_frames_have_their_own_memory(engine):
    arrays = take(engine)
    with engine.workspace.frame():
        take(engine)
    take(engine)
    check(arrays)


def test_clear_frees_memory_only_outside_frames(engine, made):
    with engine.workspace.frame():
        outer = take(engine)
        engine.workspace.clear()
        check(take(engine))
        check(outer)
    engine.workspace.clear()
    before = len(made)
    with engine.workspace.frame():
        check(take(engine))
    assert len(made) > before


def test_few_views_are_kept(engine):
    """Arrays of many sizes are not kept."""
    with engine.workspace.frame():
        engine.scratch(10**5)
    for n in range(3 * MOST_VIEWS // 2):
        with engine.workspace.frame():
            assert engine.scratch(n + 1).shape == (n + 1,)
    assert len(engine.workspace._views) <= MOST_VIEWS


@pytest.mark.sparse(1)
@pytest.mark.parametrize("method", [WeightedMethod(tolerance=1e-2), ProjectedMethod(), ProjectedMethod("quality", 0.3)])
def test_steps_allocate_nothing(engine, made, method):
    """After two similar steps, a step of displacement, motion, update of the diagram and quality allocates nothing."""
    field = sizing.Expression("0.05 + 0.02 * x")
    points = engine.upload(patch.relaxed_points(500, 3) / patch.BOX.frame[1])
    mesh = patch.make_mesh(Stages(engine), patch.BOX, sizing.Sizing(engine, patch.BOX, field), points)
    counts = []
    for _ in range(7):
        with engine.workspace.frame():
            mesh.move(method.step(mesh))
        mesh.update()
        counts.append(len(made))
    assert counts[3:] == counts[3:4] * 4


@pytest.mark.slow
def test_search_for_flaws_frees_its_memory(engine, made, monkeypatch):
    """Memory of the search is freed before the next diagram, if it is not small."""
    monkeypatch.setattr(primitives, "KEPT", 0)
    size = sizing.Sizing(engine, patch.BOX, sizing.Constant(0.05))
    points = engine.upload(patch.relaxed_points(1200, 3) / patch.BOX.frame[1])
    mesh = patch.make_mesh(Stages(engine), patch.BOX, size, points)
    mesh.fixed, before = mesh.n, len(made)  # all stay where they are
    assert mesh.repair_cells(deficit=0.06, split=False) == (0, 0)
    assert len(made) > before  # it has looked
    assert not mesh.stages.insertion_deletion._room._arrays


def test_released_stages_leave_no_memory(engine, monkeypatch):
    """Memory is freed at once, without the collection of reference cycles."""
    alive, plain = weakref.WeakSet(), cl.Buffer

    class Watched(plain):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            alive.add(self)

    monkeypatch.setattr(cl, "Buffer", Watched)
    stages, host = Stages(engine), patch.relaxed_points(500, 3) / patch.BOX.frame[1]
    gc.collect()
    gc.disable()
    try:
        size = sizing.Sizing(engine, patch.BOX, sizing.Constant(0.05))
        mesh = patch.make_mesh(stages, patch.BOX, size, engine.upload(host))
        for method in (PublishedMethod(Relaxation(), True, True), WeightedMethod(), ProjectedMethod()):
            with engine.workspace.frame():
                mesh.move(method.step(mesh))
            mesh.update()
        mesh.insert_delete()
        stages.poisson.set_up_multigrid(
            stages.poisson.assemble(mesh.t.starts, mesh.t.neighbors, mesh.t.face_measures, mesh.points)
        )
        assert len(alive) > 20
        stages.release()
        del mesh, size
        assert len(alive) == 0
    finally:
        gc.enable()


def test_kernels_are_not_shared_until_released(engine):
    first, second = engine.kernels("opencl/primitives"), engine.kernels("opencl/primitives")
    held = {kernels.scan_blocks.int_ptr for kernels in (first, second)}
    assert first.scan_blocks is first.scan_blocks
    assert len(held) == 2
    engine.pool.release()
    third, fourth = (
        engine.kernels("opencl/primitives"),
        engine.replaced(real=np.dtype(np.float32)).kernels("opencl/primitives"),
    )
    assert third.scan_blocks.int_ptr in held
    assert fourth.scan_blocks.int_ptr not in held  # another program
    with pytest.raises(AttributeError, match="has no kernel nothing"):
        _ = third.nothing


def test_no_buffer_is_larger_than_the_device_allows(engine, made, monkeypatch):
    """Spare room, too, stays within the largest buffer that the device can allocate."""
    monkeypatch.setattr(memory_limits, "largest_allocation", lambda _: 40_000)
    engine = Engine(engine.ctx, engine.queue, 2, engine.real)
    with engine.workspace.frame():
        engine.scratch(39_990, np.uint8)
    assert made == [40_000]
    with pytest.raises(MemoryLimitError, match=r"needs 39\.1 KiB, and .* at most 39\.1 KiB for one"):
        engine.empty(40_001, np.uint8)
    with engine.workspace.frame(), pytest.raises(MemoryLimitError, match="at most"):
        engine.scratch(5001)
    assert max(made) <= 40_000
