"""Cells in 3D that teams of work-items build have the bits of those by single work-items.

PoCL takes minutes to hours to compile barriers in nested loops. So these tests need an NVIDIA GPU, or Intel's runtime.
"""

import itertools

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.errors import BuildError
from clvoro.opencl import engine as engine_module
from clvoro.opencl import program, ranges
from clvoro.opencl.engine import Engine
from clvoro.opencl.hooks import watching
from clvoro.tessellation import back_ends
from clvoro.tessellation.bins import Bins
from clvoro.tessellation.part import Part
from clvoro.tessellation.polyhedra import Polyhedra
from tests.reference.diagrams3d import directions
from tests.robustness.gpu_like import by_teams, groups
from tests.tally import Tally
from tests.tessellation.test_polyhedra import BOX, POINTS

ARRAYS = ("starts", "neighbors", "face_measures", "face_centroids", "volumes", "offsets", "covariances")


def more_sets():
    rng = np.random.default_rng(77)
    random = POINTS["random"]
    center = np.array([1.0, 0.75, 0.5])
    return {
        "five": rng.random((5, 3)) * BOX.extent,
        "radial": center + (0.01 + 0.45 * rng.random((400, 1)) ** 3) * directions(400, rng),
        "near duplicates": np.concatenate([random, random[:20] + 1e-4 * directions(20, rng)]),
        "many faces": np.concatenate([center + 0.4 * directions(100, rng), [center], 0.1 * random]),
        "many": rng.random((3000, 3)) * BOX.extent,
    }


SETS = {
    name: POINTS[name]
    for name in ("one", "two", "random", "graded", "bcc", "prism", "walls, edges and corners", "lattice on walls")
} | more_sets()


@pytest.fixture(scope="module")
def ctx():
    """A context on a device whose compiler builds the kernel."""
    for name in (program.NVIDIA, "Intel(R) OpenCL"):
        try:
            found = clvoro.create_context(name)
        except clvoro.ClvoroError:
            continue
        if back_ends.has_warps(found.devices[0]) or not program.on_nvidia(found.devices[0]):
            return found
    pytest.skip("needs an NVIDIA GPU of compute capability 8, or Intel's runtime: pip install '.[cpu]'")


def diagrams(ctx, dtype, points, wanted):
    """Return the arrays of a new diagram, and of one that begins with it, by teams or not."""
    with groups(128), by_teams(wanted):
        engine = Engine(ctx, cl.CommandQueue(ctx), 3, np.dtype(dtype))
        bins, cells, n = Bins(engine), Polyhedra(engine), len(points)
    rng, found, t = np.random.default_rng(4), {}, None
    for turn in ("new", "warm"):
        x = engine.upload((points - np.array(BOX.lower)) / BOX.frame[1])
        binned = bins.build(BOX, x, n)
        t = cells.tessellate(Part.alone(x, BOX), binned, t, exact=False)
        m = int(t.starts.get()[n])
        for name in ARRAYS:
            array = getattr(t, name).get()
            found[turn, name] = array[:m] if name.startswith(("nei", "face")) else array
        found[turn, "corners"] = corners(t, found[turn, "starts"])
        found[turn, "reach"] = binned.reach.get()[:n]
        points = np.clip(points + 0.01 * (rng.random(points.shape) - 0.5), BOX.lower, BOX.extent)
    assert (cells._team is not None) == wanted, "the other kernel has run"
    return found


def corners(t, starts):
    """Return the triples of the cells that have them, with their state, and the state of the others."""
    triples = t.vertices[0].get().view(np.uint8).reshape(-1, 4)
    rows = [triples[2 * a : 2 * b - 4] for a, b in itertools.pairwise(starts)]
    return np.concatenate([row if row[0, 3] else row[:1, 3:].repeat(4, 1) for row in rows])


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", list(SETS))
def test_same_bits_as_by_single_items(ctx, name, dtype):
    plain, by_team = (diagrams(ctx, dtype, SETS[name], wanted) for wanted in (False, True))
    for key, array in plain.items():
        assert np.array_equal(array, by_team[key]), key
    counts = np.diff(plain["new", "starts"])
    assert (counts.max() > back_ends.TEAM) == (name == "many faces")


def test_same_bits_in_ranges(ctx, monkeypatch):
    """A range has whole teams, and their numbers go on."""
    expected, begins = diagrams(ctx, "float64", SETS["random"], True), []
    plain = cl.enqueue_nd_range_kernel

    def noted(queue, kernel, size, group, offset=(0,)):
        if kernel.function_name == "clip_polyhedra_by_teams":
            begins.append((offset[0], size[0]))
        return plain(queue, kernel, size, group, offset)

    def in_parts(queue, kernel, items, group, limit):
        limit.items, limit.known = 7 * back_ends.TEAM + 5, True
        return ranges.enqueue_ranges(queue, kernel, items, group, limit)

    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", noted)
    monkeypatch.setattr(engine_module.ranges, "may_be_interrupted", lambda _: True)
    monkeypatch.setattr(ranges.Range, "learn", lambda *_: None)
    monkeypatch.setattr(engine_module, "enqueue_ranges", in_parts)
    found = diagrams(ctx, "float64", SETS["random"], True)
    assert len(begins) > 50
    assert not any(number % back_ends.TEAM for pair in begins for number in pair)
    assert all(np.array_equal(found[key], array) for key, array in expected.items())


@pytest.mark.slow
@pytest.mark.parametrize("periodic", [False, True])
def test_same_bits_of_a_run(ctx, periodic):
    box = clvoro.Box((0, 0, 0), (2, 1.5, 1), periodic=periodic)

    def run(wanted):
        with groups(128), by_teams(wanted):
            adapter, tally = clvoro.Adapter(ctx, "float64"), Tally()
            with watching(adapter.queue, tally):
                result = adapter.run(box, 0.25, seed=3)
            built = tally.calls["polyhedra_by_teams", "clip_polyhedra_by_teams"]
            assert (built > 0) == (wanted and not periodic)
            return result.diagram

    plain, by_team = run(False), run(True)
    for name in ("points", "neighbor_starts", "neighbors", "face_measures", "volumes", "centroids"):
        assert np.array_equal(getattr(plain, name), getattr(by_team, name)), name


# On any device.


def test_items_work_alone_if_the_kernel_is_not_built(monkeypatch):
    adapter, build, asked = clvoro.Adapter(dtype="float32"), program.build_program, set()

    def fails(context, name, defines, prelude):
        if name.endswith("by_teams.cl"):
            asked.add(name)
            raise BuildError("no")
        return build(context, name, defines, prelude)

    def mesh(adapter):
        return adapter.run(BOX, 0.5, points=POINTS["random"][:60], method="lloyd", max_steps=3).points

    expected = mesh(adapter)
    monkeypatch.setattr(program, "build_program", fails)
    with by_teams(True):
        found = mesh(clvoro.Adapter(adapter.ctx, "float32"))
    assert len(asked) == 1
    assert np.array_equal(found, expected)


@pytest.mark.parametrize(
    ("platform", "capability", "expected"),
    [("NVIDIA CUDA", 9, True), ("NVIDIA CUDA", 8, True), ("NVIDIA CUDA", 7, False), ("Intel(R) OpenCL", 9, False)],
)
def test_devices_with_teams(platform, capability, expected):
    class Device:
        compute_capability_major_nv = capability

        class platform:  # noqa: N801
            name = ""

    Device.platform.name = platform
    assert back_ends.teams_are_faster(Device) == expected


def test_domains_with_teams():
    context, traits_of = clvoro.create_context(), engine_module.Traits
    with by_teams(True):
        for traits in (traits_of(), traits_of(("PERIODIC",), (1.0, 1.0, 1.0)), traits_of(("WEIGHTED",), site_values=1)):
            made = Engine(context, cl.CommandQueue(context), 3, np.dtype(np.float32), traits)
            assert back_ends.has_teams(made) == (traits == engine_module.PLAIN)
