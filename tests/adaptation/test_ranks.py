"""Runs that parts of a domain share: in threads, and over the ranks of MPI."""

import gc
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import threading
import types
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import clvoro
from clvoro.adaptation import estimates, run, tuning
from clvoro.adaptation.plan import schedule
from clvoro.cli.cases import load_case
from clvoro.cli.jobs import Job
from clvoro.cli.ranks import this_rank
from clvoro.errors import (
    CheckpointWarning,
    InputError,
    InputTypeError,
    MemoryLimitError,
    MissingLibraryError,
    OutputError,
    RankError,
    SizeErrorWarning,
)
from clvoro.io import arrays
from clvoro.opencl import memory_limits
from clvoro.opencl.engine import Engine
from clvoro.opencl.peers import Peers
from clvoro.opencl.threads import Team
from clvoro.tessellation.part_steps import FIRST_REACH, PartSteps
from clvoro.tessellation.readback.parts import CellRows
from clvoro.tessellation.stages import UPDATES

ARRAYS = (
    *("points", "volumes", "centroids", "neighbor_starts", "neighbors", "face_measures", "face_centroids"),
    "vertices",
)
SCRIPT = """
import os, resource, sys
import clvoro, numpy as np
from clvoro.cli import main
from clvoro.opencl import peers, prebuild
from mpi4py import MPI

prebuild._start = lambda device: None  # no workers beside the ranks
folder, rank, pieces = sys.argv[1], MPI.COMM_WORLD.rank, ["--pieces", "--json"]
out = open(f"{folder}/{rank}", "w")
adapter, box = clvoro.Adapter(comm=MPI.COMM_WORLD), clvoro.Box((0, 0), (1, 1))
mesh = adapter.run(box, lambda p: 0.1 * (1 + p[:, 0]), effort="fast")
whole = mesh.gather()
assert (whole is None) == (rank > 0)
if whole is not None:
    assert whole.check(), whole.check()
    print(len(whole), len(mesh), whole.history["cells"][-1], file=out)

def messages():
    ranks, (mine, theirs) = peers.Ranks(MPI.COMM_WORLD), (np.full((k + 2, 2), k) for k in (rank, 1 - rank))
    received = np.empty((len(theirs), 2), int)
    sizes = [np.where(np.arange(2) == rank, 0, len(rows)) for rows in (mine, theirs)]
    sums = ranks.swap(peers.Swap(mine, sizes[0], received, sizes[1]), np.array(rank))
    assert np.array_equal(received, theirs)
    assert np.array_equal(ranks.exchange([mine] * 2)[1 - rank], theirs)
    assert [int(k) for k in sums] == [int(k) for k in ranks.gather(np.array(rank))] == [0, 1]
    assert (ranks.exchanges, ranks.reductions, ranks.waits) == (2, 2, 4)

messages()
peers.FEW = 1  # as many ranks do it
messages()

def fail(row):
    if rank == 1 and row["step"] == 2:
        raise OSError("no space left")

try:
    adapter.run(box, 0.1, "fast", callback=fail)
except Exception as error:
    print(type(error).__name__, error, file=out)

for name, options in {"whole": ["--no-report"], "pieces": pieces, "missing": [], "full": pieces}.items():
    if name == "full" and rank == 1:
        out.flush()
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
    case = f"{folder}/{'missing' if name == 'missing' else 'box'}.toml"
    print(name, main(["run", case, "--out", f"{folder}/{name}", *options]), end=" ", file=out)
"""
LAKE = clvoro.Polygon(
    [(0, 0), (1, 0), (1, 0.4), (0.6, 0.5), (1, 0.6), (1, 1), (0, 1)],
    [[(0.3, 0.3), (0.4, 0.3), (0.35, 0.45)], [(0.2, 0.7), (0.5, 0.72), (0.5, 0.725), (0.2, 0.74)]],
)
"""With a concave corner, an island and a thin wall."""
CASE = """
[domain]
lower = [0.0, 0.0]
upper = [1.0, 1.0]
[size]
kind = "constant"
value = 0.12
[run]
method = "lloyd"
max_steps = 2
"""


def run_in(parts, ctx, *given, dtype="float64", path=None, **options):
    """Return the results of `parts` threads, each with an adapter, and the whole mesh; save them in `path`."""

    def work(peers):
        mesh = clvoro.Adapter(ctx, dtype, peers).run(*given, **options)
        for name in () if path is None else ("mesh.pvtu", "graph.info", f"graph.info.part.{parts}", "case/case.foam"):
            if name[:4] != "case" or not given[0].curved:
                mesh.save(path / name)
        return mesh, mesh.gather()

    found = Team(parts).run(work)
    assert all(whole is None for _, whole in found[1:])
    return [mesh for mesh, _ in found], found[0][1]


def ramp(h):
    return lambda p: h * (1 + 2 * np.abs(p[:, 0]))


@pytest.mark.sparse(3)
@pytest.mark.parametrize(
    ("dim", "kind"), [(2, "walls"), (3, "walls"), (2, "periodic"), (3, "periodic"), (3, "sphere"), (2, "polygon")]
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_diagram_has_the_same_bits_in_any_number_of_parts(ctx, dim, dtype, kind):
    """Clusters of very different density, so that balls reach far: ghosts are enough, or bits differ.

    Between walls in 3D one cell has 60 faces: it is clipped and ordered in global memory.
    The whole of a periodic box is made anew from the generators, but its errors and qualities come from the parts. On a
    sphere most parts have generators on one side only. In a polygon each part traces the whole boundary; the whole is
    made anew, too, in one part.
    """
    rng, periodic = np.random.default_rng(70101), kind == "periodic"
    x = np.concatenate([rng.random((150, dim)), (0.3 + 0.02 * rng.standard_normal((150, dim))) % 1])
    if dim == 3 and kind == "walls":
        away = rng.standard_normal((60, 3))
        x[:61] = 0.75 + np.concatenate([np.zeros((1, 3)), 0.1 * away / np.linalg.norm(away, axis=1)[:, None]])
    box = clvoro.Box((0,) * dim, (1,) * dim, periodic=(periodic, periodic, False)[:dim])
    given = {"sphere": clvoro.Sphere(2), "polygon": LAKE}.get(kind, box), 0.1
    x[:150] -= 0.5 if kind == "sphere" else 0
    x = x[LAKE.contains(x)] if kind == "polygon" else x
    options = {"points": x.astype(dtype), "method": "lloyd", "max_steps": 0, "dtype": dtype}
    runs = [run_in(parts, ctx, *given, **options) for parts in (1, 2, 4)]
    meshes = [whole for _, whole in runs]
    for part in runs[2][0]:
        rows = np.searchsorted(np.sort(np.concatenate([mesh.parts.labels for mesh in runs[2][0]])), part.parts.labels)
        assert periodic or np.array_equal(part.volumes, meshes[2].volumes[rows])
    plain = clvoro.Adapter(ctx, dtype).diagram(given[0], options["points"])
    assert np.allclose(meshes[0].volumes, plain.volumes, rtol=1e-3 if dtype == "float32" else 1e-9)
    for mesh in meshes[1:]:
        for name in (*ARRAYS, "size_error", "quality"):
            assert np.array_equal(getattr(mesh, name), getattr(meshes[0], name)), name


@pytest.mark.parametrize("kind", ["plane", "space", "polygon"])
def test_steps_have_the_same_bits_in_any_number_of_parts(ctx, kind, monkeypatch):
    """Generators move by Lloyd's algorithm, in boxes across a seam. Cells are made anew at first, and updated later.

    No ball in which a part claims to know all generators meets the way of another one, also where limits are mended.
    """
    dim = 3 if kind == "space" else 2
    updated, update, finish = [], UPDATES[dim].update, PartSteps._finished

    def proved(steps, part, t):
        found = finish(steps, part, t)
        if found is not None and part.ghosts is not None:
            x, labels, ways = steps._balls.centers, part.labels.get()[: part.count], len(steps._shifts)
            known = labels * ways + np.concatenate([np.full(len(x), ways // 2), steps._sides % ways])
            own = np.column_stack([labels[: len(x)], x, steps._limits[:, 1]])
            every = np.concatenate(steps.peers.exchange([own] * steps.peers.count))
            for way, shift in enumerate(steps._shifts):
                others = every[~np.isin(every[:, 0] * ways + way, known), 1:]
                away = np.linalg.norm(x[:, None] - others[:, :dim] - shift, axis=2)
                assert (away > steps._limits[:, :1] + others[:, dim] - 1e-9).all()
        return found

    def noted(stage, *given, **more):
        found = update(stage, *given, **more)
        updated.append((stage.engine.peers.count, found is not None))
        return found

    monkeypatch.setattr(UPDATES[dim], "update", noted)
    if kind == "plane":
        monkeypatch.setattr(PartSteps, "_finished", proved)
        monkeypatch.setitem(FIRST_REACH, 2, 1.2)  # cells need larger balls than those for which parts have asked
    box = clvoro.Box((0,) * dim, (6, *[1] * (dim - 1)), periodic=(True, *[False] * (dim - 1)))
    x = np.random.default_rng(70102).random((800, dim)) * box.extent
    if kind == "polygon":
        box, x = LAKE, x[LAKE.contains(x * 0.2)] * 0.2
    one, two, three = (
        run_in(parts, ctx, box, 0.1, points=x, method="lloyd", max_steps=2 * dim + 4)[1] for parts in (1, 2, 3)
    )
    assert {(1, True), (2, True)} <= set(updated)
    for mesh in (two, three):
        for name in ("points", "neighbors", "size_error", "quality"):
            assert np.array_equal(getattr(mesh, name), getattr(one, name)), name
    assert kind == "polygon" or np.abs(one.points[:, 0] - x[:, 0]).max() > 5


def test_parts_ask_once_where_few_cells_need_larger_balls(ctx, monkeypatch):
    """Five cells need larger balls than those for which the parts have asked, and get them without other ghosts."""
    asked, finish = set(), PartSteps._finished

    def noted(steps, part, t):
        found = finish(steps, part, t)
        if found is not None and part.ghosts is not None:
            asked.add(steps.asked)
        return found

    monkeypatch.setattr(PartSteps, "_finished", noted)
    monkeypatch.setitem(FIRST_REACH, 3, 1.6)
    x = (np.indices((12, 12, 12)).reshape(3, -1).T + 0.4 + 0.2 * np.random.default_rng(70103).random((1728, 3))) / 12
    given = clvoro.Box((0, 0, 0), (1, 1, 1)), 1 / 12
    one, two = (run_in(parts, ctx, *given, points=x, method="lloyd", max_steps=0)[1] for parts in (1, 2))
    assert asked == {1}
    assert np.array_equal(one.neighbors, two.neighbors)


def test_a_part_that_is_alone_updates_what_it_has_updated_last(ctx, monkeypatch):
    """So cells that fitted at the last step are checked quickly, as without parts."""
    known, update = [], PartSteps.update

    def noted(steps, *given):
        last = steps.stages.update._last
        before = given[2].whole or given[2]
        known.append(last is not None and last() is (before if before.trimmed is None else before.trimmed.convex))
        return update(steps, *given)

    monkeypatch.setattr(PartSteps, "update", noted)
    x = np.random.default_rng(70105).random((300, 2))
    for domain in (clvoro.Box((0, 0), (1, 1)), LAKE):
        known.clear()
        run_in(1, ctx, domain, 0.05, points=x[domain.contains(x)], method="lloyd", max_steps=8)
        assert any(known), domain


def test_a_mesh_is_read_when_it_is_used(ctx, monkeypatch):
    """Neither at the end of a run, nor twice, and no later than the diagram, whose memory is then free."""
    read, of = [], CellRows.of
    monkeypatch.setattr(CellRows, "of", lambda *given: read.append(given) or of(*given))

    def work(peers):
        mesh = clvoro.Adapter(ctx, comm=peers).run(clvoro.Box((0, 0), (1, 1)), 0.1, method="lloyd", max_steps=1)
        peers.any(False)
        before = len(read)
        peers.any(False)
        volumes, told = mesh.volumes, len(read)
        return before, told > 0, volumes.sum(), mesh.gather()

    found = Team(2).run(work)
    assert [before for before, *_ in found] == [0, 0]
    assert all(told for _, told, *_ in found)
    assert len(read) == 2
    assert found[0][-1].volumes.sum() == pytest.approx(sum(volume for *_, volume, _ in found))


def test_parts_agree_about_faces_in_single_precision(ctx):
    """An update may miss a face of less than 1e-4 of a cell; the mesh at the end has all of them on both sides."""
    box = clvoro.Box((0, 0, 0), (1, 1, 1))
    assert run_in(5, ctx, box, ramp(0.03), effort="fast", dtype="float32")[1].diagram.check()


def test_a_run_in_parts_of_a_periodic_box(ctx, tmp_path):
    """From levels of few cells on, by way of a checkpoint; what has too few cells across a period is refused."""
    given = clvoro.Box((0, 0), (1, 1), periodic=True), lambda p: 0.08 * (1.5 + np.sin(2 * np.pi * p[:, 0]))
    short, state = {"effort": "fast", "max_steps": 20}, tmp_path / "state"
    run_in(2, ctx, *given, **short, checkpoint=state, callback=lambda row: row["step"] == 12)
    again = clvoro.Checkpoint(resume=state)
    meshes, whole = run_in(3, ctx, *given, **short, path=tmp_path, checkpoint=again)
    assert whole.check()
    assert whole.history["step"][-1] == 20
    assert whole.history["mean_quality"][-1] > 0.9
    assert clvoro.load(tmp_path / "mesh.pvtu").check()
    (tmp_path / "mesh_0.vtu").write_bytes((tmp_path / "mesh_1.vtu").read_bytes())
    with pytest.raises(InputError, match=r"mesh\.pvtu"):
        clvoro.load(tmp_path / "mesh.pvtu")
    for mesh in meshes:
        assert mesh.domain.measure == pytest.approx(mesh.volumes.sum())
        assert not any(len(mesh.boundary_cells(name)) for name in mesh.domain.boundary_names if "rank" not in name)
    x = np.random.default_rng(70104).random((9, 2))
    with pytest.raises(InputError, match="half a period away"):
        run_in(2, ctx, given[0], 0.3, points=x, method="lloyd", max_steps=0)
    assert run_in(2, ctx, given[0], 0.1, points=np.random.default_rng(1).random((90, 2)), method="lloyd", max_steps=0)[
        1
    ].check()


@pytest.mark.parametrize("kind", ["plane", "space", "sphere", "polygon"])
def test_a_run_in_parts(ctx, kind, tmp_path, monkeypatch):
    """Each part has its own cells, in balance; the whole has the sizes and shapes of a run without parts.

    On the coarsest of three levels one part works, on the next one two.

    ParaView's library reads the pieces of all parts as one mesh.
    """
    dim = 2 if kind in ("plane", "polygon") else 3
    domain = {"sphere": clvoro.Sphere(0.5), "polygon": LAKE}.get(kind, clvoro.Box((0,) * dim, (1,) * dim))
    given = domain, ramp({"plane": 0.05, "polygon": 0.03}.get(kind, 0.1))
    few = clvoro.MultilevelOptions(levels=1 if kind == "sphere" else 2)
    wells = [(0.25, 0.25)] if kind == "polygon" else None
    alone = clvoro.Adapter(ctx).run(*given, effort="fast", options=few, fixed=wells)
    monkeypatch.setitem(run.PART_CELLS, domain.cell_dim, len(alone) / 2**domain.cell_dim / 2.5)
    meshes, whole = run_in(3, ctx, *given, effort="fast", options=few, fixed=wells, path=tmp_path)
    assert whole.check()
    assert wells is None or np.array_equal(whole.points[0], wells[0])
    assert whole.history["level"][0] == few.levels
    for name in set(whole.history.dtype.names) - {"seconds"}:
        assert all(np.array_equal(mesh.history[name], whole.history[name]) for mesh in meshes), name
    if dim == 3:
        again = clvoro.Adapter(devices=[ctx] * 3, share_gpus=True).run(*given, effort="fast", options=few)
        assert again.parts is None
        for name in ARRAYS:
            assert np.array_equal(getattr(again, name), getattr(whole, name)), name
    sizes = [len(mesh) for mesh in meshes]
    assert sum(sizes) == len(whole)
    assert max(sizes) < 1.15 * len(whole) / 3
    assert abs(len(whole) / len(alone) - 1) < 0.03
    for name in ("mean_error", "mean_quality"):
        one, other = alone.history[name][-1], whole.history[name][-1]
        assert abs(one - other) < (0.3 * one if name == "mean_error" else 0.01)
    assert kind != "sphere" or whole.measures.c_grid.obtuse == 0
    labels_by_part = np.concatenate([mesh.parts.labels for mesh in meshes])
    labels = np.sort(labels_by_part)
    assert (np.diff(labels) > 0).all()
    for number, mesh in enumerate(meshes):
        names = set(mesh.domain.boundary_names)
        assert {f"rank{k}" for k in range(3) if k != number} & names
        assert f"rank{number}" not in names
        rows = np.searchsorted(labels, mesh.parts.labels)
        for array in ("points", "volumes", "size_error", "quality"):
            assert np.array_equal(getattr(mesh, array), getattr(whole, array)[rows])

    owners = np.loadtxt(tmp_path / "graph.info.part.3", int)
    assert np.array_equal(owners, np.repeat(range(3), sizes)[np.argsort(labels_by_part, kind="stable")])
    pairs = np.unique(np.sort([whole.half_faces.owner, whole.neighbors], axis=0)[:, whole.neighbors >= 0], axis=1)
    assert (tmp_path / "graph.info").read_text().split()[:2] == [str(len(whole)), str(pairs.shape[1])]
    for number, size in enumerate(sizes if kind != "sphere" else ()):
        cells = tmp_path / f"case/processor{number}/constant/polyMesh/cellProcAddressing"
        assert f"\n{size}\n(" in cells.read_text()

    loaded = clvoro.load(tmp_path / "mesh.pvtu")
    assert loaded.check()
    assert loaded.diagram.domain == domain
    for array in ("points", "size_error", "quality"):
        assert np.allclose(
            getattr(loaded, array), np.concatenate([getattr(mesh, array) for mesh in meshes]), atol=1e-12
        )
    pyvista = pytest.importorskip("pyvista")
    read = pyvista.read(tmp_path / "mesh.pvtu")
    assert read.n_cells == len(whole)
    assert np.isclose(read.cell_data["volume"].sum(), domain.measure)
    assert np.array_equal(read.cell_data["error"], np.concatenate([mesh.size_error for mesh in meshes]))


def test_parts_hold_what_one_device_does_not(ctx, monkeypatch):
    """Ten parts need little more than a tenth; rank 0 refuses to gather what it does not hold."""
    engines = [Engine(ctx, clvoro.Adapter(ctx).queue, 3, np.dtype(float), peers=peers) for peers in (Peers(), Peers())]
    engines[1].peers.count = 10
    needed = [estimates.check_memory(engine, 1e6) for engine in engines]
    assert 0.1 < needed[1] / needed[0] < 0.125
    given = clvoro.Box((0, 0), (1, 1)), 0.03
    adapter, limit = clvoro.Adapter(ctx), memory_limits.VARIABLE
    needed = adapter.memory_needed(*given)
    with monkeypatch.context() as patch:
        patch.setenv(limit, str(needed))
        adapter.run(*given, "fast").diagram.vertices  # noqa: B018
        assert needed / 2 < memory_limits.MOST_TAKEN[ctx.devices[0]] <= needed
        patch.setenv(limit, f"{needed / 2**11:.3f} KiB")
        with pytest.raises(MemoryLimitError, match="the size field requires"):
            adapter.run(*given, "fast")
        patch.setattr(estimates, "available_memory", lambda _: np.inf)
        with pytest.raises(MemoryLimitError, match="as CLVORO_MEMORY_LIMIT says"):
            clvoro.Adapter(ctx).run(*given, "fast")
        patch.setenv(limit, "much")
        with pytest.raises(InputError, match="'much', expected a number of bytes"):
            clvoro.Adapter(ctx).run(*given, "fast")
    gc.collect()
    assert memory_limits.TAKEN[ctx.devices[0]] < memory_limits.MOST_TAKEN[ctx.devices[0]]
    alone, few = (estimates.estimate_memory(clvoro.Adapter(ctx)._engine_for(given[0]), n) for n in (1111, 700))
    monkeypatch.setattr(estimates, "available_memory", lambda _: (few + alone) / 2)
    with pytest.raises(MemoryLimitError):
        clvoro.Adapter(ctx).run(*given, method="lloyd", max_steps=0)

    def work(peers):
        mesh = clvoro.Adapter(ctx, comm=peers).run(*given, method="lloyd", max_steps=0)
        monkeypatch.setattr(estimates, "available_memory", lambda _: 1.0)
        with pytest.raises(MemoryLimitError) if peers.number == 0 else nullcontext():
            mesh.gather()

    # The whole mesh of several devices must be held by the first one, or by a CPU.
    with pytest.raises(MemoryLimitError):
        clvoro.Adapter(devices=[ctx] * 4, share_gpus=True).run(*given, method="lloyd", max_steps=0)
    engine, limits = clvoro.Adapter(ctx)._engine_for(given[0]), [1.0, 1e9]
    with monkeypatch.context() as patch:
        patch.setattr(estimates, "available_memory", lambda _: limits.pop(0))
        assert estimates.holder_of_all(engine, 1111, given[0]).queue != engine.queue
    Team(4).run(work)


def test_checkpoints_are_resumed_on_any_number_of_parts(ctx, tmp_path, monkeypatch):
    """On as many parts with the same bits; a piece that one part cannot write leaves the last checkpoint whole."""
    given, state = (LAKE, ramp(0.08)), tmp_path / "state"
    short = {"effort": "fast", "max_steps": 16}
    options = {**short, "checkpoint": clvoro.Checkpoint(state, 0)}
    whole = run_in(2, ctx, *given, **options)[1]
    stopped = run_in(2, ctx, *given, **options, callback=lambda row: row["step"] == 11)[1]
    assert stopped.history["step"][-1] == 11
    files = {file.name for file in tmp_path.iterdir()}
    assert len(files) == 3
    assert all(re.fullmatch(r"state(\.[0-9a-f]{16}\.[01])?", name) for name in files)

    write = arrays.write_arrays

    def fill_disk(path, *given, **how):
        if str(path).endswith(".1"):
            raise OutputError("no space left")
        write(path, *given, **how)

    with monkeypatch.context() as patch:
        patch.setattr(arrays, "write_arrays", fill_disk)
        again = {**short, "checkpoint": clvoro.Checkpoint(state, 0, resume=True)}
        with pytest.warns(CheckpointWarning, match="no space left"):
            run_in(2, ctx, *given, **again, callback=lambda row: row["step"] == 13)
    resumed = run_in(2, ctx, *given, **short, checkpoint=clvoro.Checkpoint(None, resume=state))[1]
    for name in ARRAYS:
        assert np.array_equal(getattr(resumed, name), getattr(whole, name)), name
    for parts in (1, 3):
        other = run_in(parts, ctx, *given, **short, checkpoint=clvoro.Checkpoint(None, resume=state))[1]
        assert other.check()
        assert other.history["step"][-1] == whole.history["step"][-1]
        assert abs(len(other) / len(whole) - 1) < 0.03
        assert np.array_equal(other.history["cells"][:12], whole.history["cells"][:12])
    alone = clvoro.Adapter(ctx).run(*given, **short, checkpoint=clvoro.Checkpoint(state, 0, resume=True))
    assert abs(alone.history["mean_error"][-1] / whole.history["mean_error"][-1] - 1) < 0.5
    run_in(2, ctx, *given, **options, callback=lambda row: row["step"] == 1)
    next(file for file in tmp_path.iterdir() if file.name.endswith(".1")).unlink()
    with pytest.raises((InputError, RankError), match="No such file"):
        run_in(2, ctx, *given, **short, checkpoint=clvoro.Checkpoint(None, resume=state))


def test_parts_join_a_run(ctx, tmp_path, monkeypatch):
    """From a checkpoint of a level on which one part works, and where that level turns out to be too coarse."""
    monkeypatch.setitem(tuning.COARSEST, 2, 60)
    given = clvoro.Box((0, 0), (4, 0.7), periodic=(False, True)), 0.06
    state, short = tmp_path / "state", {"effort": "fast", "max_steps": 9}
    whole = run_in(2, ctx, *given, **short, checkpoint=clvoro.Checkpoint(state, 0))[1]
    assert whole.settings["levels"] == whole.history["level"][0] == 1 < schedule.auto_levels(len(whole), 2)
    options = {**short, "checkpoint": clvoro.Checkpoint(state, 0)}
    assert run_in(2, ctx, *given, **options, callback=lambda row: row["step"] == 2)[1].history["step"][-1] == 2
    assert [file.name for file in tmp_path.iterdir()] == ["state"]
    for parts in (2, 3):
        again = run_in(parts, ctx, *given, **short, checkpoint=clvoro.Checkpoint(None, resume=state))[1]
        assert again.check()
        assert again.history["step"][-1] == 9
        assert parts == 3 or np.array_equal(again.points, whole.points)


def test_devices_share_a_run(ctx):
    """One callback, warning, error and result of all devices. Ctrl-C gives the mesh so far."""
    adapter = clvoro.Adapter(devices=[ctx, ctx], share_gpus=True)
    box, here, steps = clvoro.Box((0, 0), (1, 1)), threading.get_ident(), []

    def note(row):
        assert threading.get_ident() == here
        steps.append(int(row["step"]))
        if len(steps) == 9:
            raise KeyboardInterrupt
        if len(steps) > 9:
            raise OSError("no space left")

    with pytest.raises(clvoro.Interrupted) as caught:
        adapter.run(box, ramp(0.05), callback=note)
    assert steps == list(range(9))
    assert caught.value.result.stop_reason == "interrupted"
    assert caught.value.result.check()
    with pytest.raises(OSError, match="no space left"):
        adapter.run(box, ramp(0.05), callback=note)
    with pytest.warns(SizeErrorWarning) as warned:
        mesh = adapter.run(box, 0.01, points=np.random.default_rng(70103).random((60, 2)), method="lloyd", max_steps=1)
    assert len(warned) == 1
    assert Path(warned[0].filename) == Path(__file__)
    assert len(mesh) == 60
    assert "and 1 more" in repr(adapter)
    with pytest.raises(InputError, match="devices 0 and 1 are the same"):
        clvoro.Adapter(devices=[ctx, ctx])
    with pytest.raises(InputTypeError, match="expected a list of names"):
        clvoro.Adapter(devices="gpu")
    with pytest.raises(InputError, match="devices and ctx are given"):
        clvoro.Adapter(ctx, devices=[ctx])


def test_threads_end_together():
    """An error is the only one that is raised, a thread that ends early lets no other wait, and so does Ctrl-C."""

    def fail(peers):
        if peers.number == 1:
            raise ValueError("out of range")
        peers.total(1)

    def press(peers):
        if peers.number == 0:
            for _ in range(2):
                peers.ask(lambda: signal.raise_signal(signal.SIGINT))
        peers.total(1)

    team = Team(3)
    with pytest.raises(ValueError, match="out of range"):
        team.run(fail)
    with pytest.raises(RankError, match="part 0 of 3 has ended"):
        team.run(lambda peers: peers.number and peers.total(1))
    with pytest.raises(KeyboardInterrupt):
        team.run(press)
    assert team.run(lambda peers: int(peers.before(2))) == [0, 2, 4]


@pytest.mark.parametrize("domain", [clvoro.Box((0, 0), (1, 1)), LAKE])
@pytest.mark.parametrize("change", [{"method": "transport"}, {"layers": clvoro.Layers(0.1)}])
def test_what_ranks_cannot_share_is_refused(ctx, domain, change):
    with pytest.raises(InputError, match="devices share the run"):
        run_in(1, ctx, domain, 0.2, **change)
    with pytest.raises(InputTypeError, match="communicator"):
        clvoro.Adapter(ctx, comm=4)
    alone = Peers()
    alone.shared = True
    with pytest.raises(InputError, match="expected run"):
        clvoro.Adapter(ctx, comm=alone).start(clvoro.Box((0, 0), (1, 1)), 0.2)


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("seed", "seed = 1, expected 0"),
        ("points", "points = "),
        ("size", "cells"),
        ("case", "case = 1, expected 0, as"),
    ],
)
def test_parts_with_other_input_are_refused(ctx, name, shown):
    def work(peers):
        adapter, errors = clvoro.Adapter(ctx, comm=peers), InputError if peers.number == 0 else RankError
        changed = {"seed": peers.number, "points": [(0.5, 0.2 + 0.1 * peers.number)], "size": 0.2 - 0.1 * peers.number}
        call = partial(adapter.run, clvoro.Box((0, 0), (1, 1)), **{"size": 0.2, name: changed.get(name)})
        if name == "case":
            call = partial(peers.agree, lambda: None, lambda _: {"case": f"[run]\n{peers.number}"})
        with pytest.raises(errors, match=f"rank 1 of 2 has {shown}"):
            call()

    Team(2).run(work)


@pytest.mark.skipif(importlib.util.find_spec("mpi4py") is None, reason="mpi4py is not installed")
def test_under_mpiexec(tmp_path):
    """A script, then commands: rank 0 speaks and writes; in pieces each rank writes its cells.

    What fails on one rank is said once.
    """
    (tmp_path / "box.toml").write_text(CASE)
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    mpiexec = Path(sys.executable).parent / "mpiexec"
    environment = {**os.environ, "POCL_MAX_PTHREAD_COUNT": "1", "PYTHONPATH": str(Path(clvoro.__file__).parents[1])}
    command = [str(mpiexec if mpiexec.exists() else "mpiexec"), "-n", "2", sys.executable, str(script), str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr[-3000:]

    (line, *of_first), of_second = ((tmp_path / rank).read_text().splitlines() for rank in "01")
    cells, own, recorded = map(int, line.split())
    assert cells == recorded > own > cells / 3
    codes = "whole 0 pieces 0 missing 2 full 1 "
    assert of_first == ["RankError rank 1 of 2 has failed: OSError: no space left", codes]
    assert of_second == ["OSError no space left", codes]
    assert done.stdout.count("written into") == 1
    shown = [line for line in done.stderr.splitlines() if line.startswith("clvoro: ")]
    assert len(shown) == 2, done.stderr
    assert "missing.toml" in shown[0]
    assert "mesh_1.vtu" in shown[1]
    assert "File too large" in shown[1]
    assert {file.name for file in (tmp_path / "whole").iterdir()} == {
        "mesh.vtu",
        "mesh.npz",
        "history.csv",
        "case.toml",
    }
    files = {file.name for file in (tmp_path / "pieces").iterdir()}
    assert files == {"mesh.pvtu", "mesh_0.vtu", "mesh_1.vtu", "history.csv", "case.toml"}
    whole = clvoro.load(tmp_path / "whole/mesh.npz")
    assert whole.check()
    record = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("{")))
    assert record["cells"] == len(whole) == sum(len(clvoro.load(tmp_path / f"pieces/mesh_{k}.vtu")) for k in (0, 1))
    assert np.isclose(record["mean_error"], np.abs(whole.size_error).mean())


def test_what_the_command_refuses_over_ranks(tmp_path, monkeypatch):
    """Each call works without what the error says."""
    (tmp_path / "box.toml").write_text(CASE)
    case, ranks = load_case(tmp_path / "box.toml"), Peers()
    ranks.count = 2
    with pytest.raises(InputError, match="one process has the whole mesh"):
        Job(case, tmp_path, pieces=True)._refuse_pieces()
    for changed in ({"mesh_formats": ("vtk",)}, {"solver": "openfoam"}, {}):
        monkeypatch.setattr(Job, "_land", None if changed else "land.geojson", raising=False)
        with pytest.raises(InputError, match="needs the whole mesh, and pieces"):
            Job(case, tmp_path, pieces=True, peers=ranks, **changed)._refuse_pieces()
        Job(case, tmp_path, peers=ranks, **changed)._refuse_pieces()
    with pytest.raises(InputError, match="processors are given, and nothing"):
        Job(case, tmp_path, processors=2)._refuse_formats()
    Job(case, tmp_path, processors=2, mesh_formats=("openfoam",))._refuse_formats()
    with pytest.raises(InputError, match="has 2 devices, expected one"):
        Job(case, tmp_path, "0:0,0:1", peers=ranks)._refuse_pieces()
    Job(case, tmp_path, "a processor, in two words", peers=ranks)._refuse_pieces()

    monkeypatch.setenv("PMI_SIZE", "2")
    mpi4py = types.ModuleType("mpi4py")
    monkeypatch.setitem(sys.modules, "mpi4py", mpi4py)
    monkeypatch.delitem(sys.modules, "mpi4py.MPI", raising=False)  # FiPy loads it
    with pytest.raises(MissingLibraryError, match="call clvoro without mpiexec"):
        this_rank()
    alone = types.SimpleNamespace(Get_rank=lambda: 0, Get_size=lambda: 1, Iallgather=None)
    alone.Dup = lambda: alone
    mpi4py.MPI = types.SimpleNamespace(COMM_WORLD=alone, Get_library_version=lambda: "MPICH")
    with pytest.raises(InputError, match="mpi4py belongs to another MPI"):
        this_rank()
    monkeypatch.setenv("PMI_SIZE", "1")
    assert this_rank().count == 1
