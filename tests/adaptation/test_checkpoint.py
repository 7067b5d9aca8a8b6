"""A run resumed from a checkpoint gives the same bits; other files are rejected with the reason."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

import clvoro
from clvoro.adaptation import run as run_module
from clvoro.adaptation.checkpoint import Saved, domain_fingerprint
from clvoro.adaptation.run import STALLED
from clvoro.cli import command as cli
from clvoro.errors import InputError

BOX = clvoro.Box((0, 0), (2.5, 1.5))
SIZE = clvoro.sizing.Expression("0.06 + 0.3*fabs(hypot(x-0.9, y-0.75)-0.3)")
BOX_3D = clvoro.Box((0, 0, 0), (1, 1.5, 1))
SIZE_3D = clvoro.sizing.Expression("0.16 + 0.2*fabs(hypot(x-0.4, y-0.7)-0.3)")
CUBE = clvoro.Solid.box((0.3, 0.3, 0.3), (0.7, 1.2, 0.7))
CORNER = clvoro.Polygon([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)])
PERIODIC = clvoro.Box((0, 0), (1, 1), periodic=True)
FEW = {"effort": "fast", "options": clvoro.MultilevelOptions(levels=1)}
RUNS = {
    "coupled": (BOX, SIZE, {"method": "coupled", "max_steps": 9}),
    "adaptive": (BOX, SIZE, FEW),
    "fixed": (BOX, SIZE, {**FEW, "fixed": [(0.4, 0.4), (1.7, 1.1)]}),
    "mmpde": (BOX, SIZE, {"method": "mmpde", "max_steps": 9}),
    "in 3D": (BOX_3D, SIZE_3D, {**FEW, "method": "exact"}),
    "surfaces inside": (BOX_3D.with_surfaces(CUBE), 0.2, {**FEW, "method": "exact"}),
    "monge-ampere": (BOX, SIZE, {"method": "monge-ampere", "max_steps": 9}),
    "count held": (BOX, SIZE, {"method": "exact", "effort": "fast", "n_cells": 250}),
    "transport": (BOX, SIZE, {**FEW, "method": "transport"}),
    "transport in 3D": (BOX_3D, SIZE_3D, {"method": "transport", "effort": "fast"}),
    "polygon": (CORNER, 0.12, {**FEW, "method": "exact"}),
    "sphere": (clvoro.Sphere(1.0), 0.2, {"effort": "fast"}),
    "periodic": (PERIODIC, 0.05, FEW),
    "periodic in 3D": (clvoro.Box((0,) * 3, (1,) * 3, periodic=True), 0.16, {"effort": "fast"}),
}


def stop_after(rows):
    seen = []

    def callback(row):
        seen.append(row)
        return len(seen) > rows

    return callback


def assert_same(a, b):
    for name in ("points", "target_size", "size_error", "quality", "origin"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    corners = "cell_vertices" if a.diagram.domain.cell_dim == 2 else "face_vertices"
    for name in ("volumes", "neighbors", "vertices", corners, "face_measures", "centroids"):
        assert np.array_equal(getattr(a.diagram, name), getattr(b.diagram, name)), name
    for name in set(a.history.dtype.names) - {"seconds"}:
        assert np.array_equal(a.history[name], b.history[name]), name
    for part in ("initial", "final"):
        for name in ("points", "lloyd", "poisson"):
            one, other = (getattr(getattr(r, part), name) for r in (a, b))
            assert np.array_equal(one, other), (part, name)
    assert (a.converged, a.stop_reason, a.size_factor) == (b.converged, b.stop_reason, b.size_factor)
    assert a.settings == b.settings


def run(adapter, domain, size, path=None, every=0, **options):
    """Run with checkpoints, each of which begins anew; by default to a file of its own."""
    if "checkpoint" not in options:
        options["checkpoint"] = clvoro.Checkpoint(path, every=every)
    return adapter.run(domain, size, **options)


def fast(kind, dtype):
    """The others are for the slow set."""
    return (kind, dtype) in (("coupled", "float64"), ("surfaces inside", "float64"), ("transport", "float32"))


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [
        pytest.param(kind, dtype, marks=() if fast(kind, dtype) else pytest.mark.slow)
        for kind in RUNS
        for dtype in ("float64", "float32")
    ],
)
def test_resumed_runs_end_the_same(ctx, tmp_path, dtype, kind):
    domain, size, options = RUNS[kind]
    whole = run(clvoro.Adapter(ctx, dtype), domain, size, tmp_path / "whole", seed=5, **options)
    rows, path = len(whole.history), tmp_path / "state"
    # Stops at both ends are tested below, too.
    for stop in (2 * rows // 3,) if fast(kind, dtype) else (1, 2 * rows // 3, rows - 1):
        stopped = run(clvoro.Adapter(ctx, dtype), domain, size, path, seed=5, callback=stop_after(stop), **options)
        assert stopped.stop_reason == "stopped by the callback"
        resume = clvoro.Checkpoint(resume=path)
        resumed = clvoro.Adapter(ctx, dtype).run(domain, size, seed=5, checkpoint=resume, **options)
        assert_same(resumed, whole)
        assert (np.diff(resumed.history["seconds"]) >= 0).all()


def test_runs_begin_anew_at_the_same_steps(ctx, tmp_path, monkeypatch):
    """However often they write, and when."""
    monkeypatch.setattr(run_module, "RENEWAL", 5)
    domain, size, options = RUNS["adaptive"]
    whole = run(clvoro.Adapter(ctx), domain, size, tmp_path / "whole", every=1e9, **options)
    path, kept = tmp_path / "state", tmp_path / "kept"

    def keep(row):
        if row["step"] == 13:
            shutil.copy(path, kept)

    written = run(clvoro.Adapter(ctx), domain, size, path, every=1e-9, callback=keep, **options)
    assert_same(written, whole)
    assert Saved(kept).state["steps"] == 10
    again = clvoro.Checkpoint(path, every=1e9, resume=kept)
    assert_same(clvoro.Adapter(ctx).run(domain, size, checkpoint=again, **options), whole)


def test_a_run_with_checkpoints_has_as_good_a_mesh(ctx, tmp_path):
    """It begins anew after each step, and has other bits."""
    domain, size, options = RUNS["adaptive"]
    plain = clvoro.Adapter(ctx).run(domain, size, seed=8, **options)
    written = run(clvoro.Adapter(ctx), domain, size, tmp_path / "state", seed=8, **options)
    for name, factor in (("size_error", 1.3), ("quality", 1.01)):
        one, other = (np.abs(getattr(r, name)).mean() for r in (plain, written))
        assert other / factor < one < factor * other
    # The last one is at the end of the plan: only the arrays must be read.
    resume = clvoro.Checkpoint(resume=tmp_path / "state")
    assert_same(clvoro.Adapter(ctx).run(domain, size, seed=8, checkpoint=resume, **options), written)
    assert os.listdir(tmp_path) == ["state"]


def test_own_points_and_callables(ctx, tmp_path):
    points = np.random.default_rng(12).random((200, 2)) * BOX.extent
    path = tmp_path / "state"
    options = {"points": points, "method": "weighted", "max_steps": 8, "options": clvoro.PaperOptions(tol=0.0)}

    def size(x):
        return 0.1 + 0.02 * x[:, 0]

    whole = run(clvoro.Adapter(ctx), BOX, size, tmp_path / "whole", **options)
    run(clvoro.Adapter(ctx), BOX, size, path, callback=stop_after(4), **options)
    assert_same(clvoro.Adapter(ctx).run(BOX, size, checkpoint=clvoro.Checkpoint(resume=path), **options), whole)


def test_stopped_before_the_first_step(ctx, tmp_path):
    domain, size, options = RUNS["adaptive"]
    path = tmp_path / "state"
    run(clvoro.Adapter(ctx), domain, size, path, callback=stop_after(0), **options)
    resumed = clvoro.Adapter(ctx).run(domain, size, checkpoint=clvoro.Checkpoint(resume=path), **options)
    whole = run(clvoro.Adapter(ctx), domain, size, tmp_path / "whole", **options)
    assert_same(resumed, whole)


def test_resume_at_the_end_of_the_run(ctx, tmp_path):
    """A callback stops in the row that would end the run as stalled. Resumed, the run ends there, too."""
    path, options = (tmp_path / "state", {"method": "coupled", "options": clvoro.PaperOptions(tol=0.5)})
    whole = run(clvoro.Adapter(ctx), BOX, SIZE, tmp_path / "whole", **options)
    assert whole.stop_reason == STALLED
    rows = len(whole.history) - 1
    assert rows < 100
    run(clvoro.Adapter(ctx), BOX, SIZE, path, callback=stop_after(rows), **options)
    assert_same(clvoro.Adapter(ctx).run(BOX, SIZE, checkpoint=clvoro.Checkpoint(resume=path), **options), whole)


@pytest.mark.sparse(1)
@pytest.mark.parametrize("before", ["diagram", "failed run"])
@pytest.mark.parametrize("square", [clvoro.Box((0, 0), (1, 1)), clvoro.Box((0,) * 3, (1,) * 3)])
def test_after_something_larger(ctx, tmp_path, square, before):
    """A run and its checkpoint do not depend on what the adapter did before."""
    path, size = tmp_path / "state", 0.29 if square.dim == 2 else 0.4
    options = {"method": "coupled", "max_steps": 6, "options": clvoro.PaperOptions(tol=0.0)}
    adapter = clvoro.Adapter(ctx)

    def fail(row):
        raise LookupError

    if before == "diagram":
        adapter.diagram(square, np.random.default_rng(0).random((8000, square.dim)))
    else:
        with pytest.raises(LookupError):
            adapter.run(square, 8000 ** (-1 / square.dim), method="lloyd", callback=fail)
    run(adapter, square, size, path, callback=stop_after(3), **options)
    whole = run(clvoro.Adapter(ctx), square, size, tmp_path / "whole", **options)
    assert_same(clvoro.Adapter(ctx).run(square, size, checkpoint=clvoro.Checkpoint(resume=path), **options), whole)


@pytest.fixture(scope="module")
def saved(ctx, tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "state"
    options = {"method": "coupled", "max_steps": 6, "seed": 5}
    clvoro.Adapter(ctx).run(BOX, SIZE, callback=stop_after(2), checkpoint=path, **options)
    return path, options


OTHERS = {
    "seed": {"seed": 6},
    "method": {"method": "lloyd"},
    "max_steps": {"max_steps": 7},
    "k": {"options": clvoro.PaperOptions(k=0.25)},
    "n_cells": {"n_cells": 300},
    "points": {"points": np.random.default_rng(4).random((50, 2))},
    "fixed": {"fixed": [(0.5, 0.5)]},
}


@pytest.mark.parametrize("name", list(OTHERS))
def test_other_settings_are_rejected(ctx, saved, name):
    path, options = saved
    with pytest.raises(InputError, match=rf"cannot resume.*{name} = "):
        clvoro.Adapter(ctx).run(BOX, SIZE, checkpoint=clvoro.Checkpoint(resume=path), **{**options, **OTHERS[name]})


def test_other_domains_precisions_and_fields_are_rejected(ctx, saved):
    path, options = saved
    with pytest.raises(InputError, match="domain = "):
        clvoro.Adapter(ctx).run(
            clvoro.Box((0, 0), (2.5, 1.6)), SIZE, checkpoint=clvoro.Checkpoint(resume=path), **options
        )
    with pytest.raises(InputError, match="dtype = float64"):
        clvoro.Adapter(ctx, "float32").run(BOX, SIZE, checkpoint=clvoro.Checkpoint(resume=path), **options)
    with pytest.raises(InputError, match=r"size field differs.*this field's is [0-9]"):
        clvoro.Adapter(ctx).run(BOX, 1.0001 * SIZE, checkpoint=clvoro.Checkpoint(resume=path), **options)
    with pytest.raises(InputError, match=r"checkpoint is .*, a folder"):
        clvoro.Adapter(ctx).run(BOX, SIZE, checkpoint=path.parent, **options)
    with pytest.raises(InputError, match="no folder"):
        clvoro.Adapter(ctx).run(BOX, SIZE, checkpoint=path / "none" / "state", **options)


RECTANGLE = [(0, 0), (2.5, 0), (2.5, 1.5), (0, 1.5)]
ALIKE = {
    "box": BOX,
    "periodic": clvoro.Box((0, 0), (2.5, 1.5), periodic=True),
    "channel": clvoro.Box((0, 0), (2.5, 1.5), periodic=(True, False)),
    "polygon": clvoro.Polygon(RECTANGLE),
    "from another corner": clvoro.Polygon(RECTANGLE[1:] + RECTANGLE[:1]),
    "turned round": clvoro.Polygon(RECTANGLE[::-1]),
    "with a hole": clvoro.Polygon(RECTANGLE, [[(1, 1), (1.1, 1), (1, 1.1)]]),
}


def test_domains_of_the_same_extent_have_different_fingerprints(saved):
    """By their fingerprints."""
    told = {name: domain_fingerprint(domain) for name, domain in ALIKE.items()}
    assert len({json.dumps(t, sort_keys=True) for t in told.values()}) == len(ALIKE)
    assert domain_fingerprint(clvoro.Polygon(RECTANGLE)) == told["polygon"]
    for name in set(ALIKE) - {"box"}:
        with pytest.raises(InputError, match=r"domain = Box\(.*'walls': 4.* has domain = "):
            Saved(saved[0]).check_fingerprint({**Saved(saved[0]).fingerprint, "domain": told[name]})


def rewrite(path, target, change):
    """Copy a checkpoint with some of its arrays changed, all checksums right."""
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for info in old.infolist():
            with old.open(info) as stream:
                array = np.lib.format.read_array(stream)
            name = info.filename.removesuffix(".npy")
            with new.open(info.filename, "w") as stream:
                np.lib.format.write_array(stream, np.asanyarray(change(name, array)))


def with_state(**values):
    def change(name, array):
        if name != "about":
            return array
        about = json.loads(array.item())
        about["state"] |= values
        return np.array(json.dumps(about))

    return change


def spoil(which, index, value):
    def change(name, array):
        if name == which:
            array[index] = value
        return array

    return change


DAMAGED = {
    "labels": spoil("mesh.labels", 0, 10**6),
    "labels twice": lambda name, a: np.where(a == 3, 4, a) if name == "mesh.labels" else a,
    "points": spoil("mesh.points", (0, 0), np.nan),
    "outside": spoil("mesh.points", (0, 0), 1.5),
    "sizes": spoil("mesh.h", 3, 0.0),
    "velocity": spoil("mesh.velocity", (0, 0), np.inf),
    "position": with_state(position=-1),
    "far position": with_state(position=10**9),
    "level": with_state(level=3),
    "text": with_state(steps="3"),
    "size_factor": with_state(size_factor="nan"),
    "shape": lambda name, array: array[:-1] if name == "mesh.velocity" else array,
    "type": lambda name, array: array.astype(np.float32) if name == "mesh.h" else array,
}


@pytest.mark.parametrize("name", list(DAMAGED))
def test_damaged_checkpoints_are_rejected(ctx, saved, tmp_path, name):
    path, options = saved
    rewrite(path, tmp_path / "state", DAMAGED[name])
    with pytest.raises(InputError, match="cannot resume"):
        clvoro.Adapter(ctx).run(BOX, SIZE, checkpoint=clvoro.Checkpoint(resume=tmp_path / "state"), **options)


def flipped(data):
    """Return `data` with one bit changed in the middle, which is in an array."""
    place = len(data) // 2
    return data[:place] + bytes([data[place] ^ 16]) + data[place + 1 :]


def test_truncated_and_foreign_files_are_rejected(saved, tmp_path):
    data = saved[0].read_bytes()
    for content in (data[:-100], data[: len(data) // 2], b"", b"PK\x03\x04", flipped(data)):
        (tmp_path / "state").write_bytes(content)
        with pytest.raises(InputError, match="cannot load"):
            Saved(tmp_path / "state")
    with pytest.raises(InputError, match="cannot load"):
        Saved(tmp_path / "none")
    clvoro.Adapter().run(BOX, 0.3, method="lloyd", max_steps=0).save(tmp_path / "m.npz")
    with pytest.raises(InputError, match="its format is"):
        Saved(tmp_path / "m.npz")


CASE = """[domain]
lower = [0, 0]
upper = [2.5, 1.5]
[size]
kind = "expression"
expression = "0.02 + 0.1*fabs(hypot(x-0.9, y-0.75)-0.3)"
[run]
method = "coupled"
max_steps = 400
tol = 0
"""


def test_command_line_stops_at_sigterm_and_resumes(tmp_path, capsys):
    case, state, out = tmp_path / "c.toml", tmp_path / "state", tmp_path / "out"
    case.write_text(CASE)
    command = ["run", str(case), "--out", str(out), "--no-report", "--quiet", "--checkpoint"]
    child = subprocess.Popen(
        [sys.executable, "-m", "clvoro", *command, str(state), "--checkpoint-every", "0.2"],
        cwd=Path(__file__).parents[2],
    )
    until = time.monotonic() + 120
    while not state.exists() and time.monotonic() < until and child.poll() is None:
        time.sleep(0.05)
    child.send_signal(signal.SIGTERM)
    assert child.wait(60) == 130
    stopped = clvoro.load(out / "mesh.npz")
    assert stopped.stop_reason == "interrupted"
    # The checkpoint is where it stopped.
    assert Saved(state).state["steps"] == stopped.history["step"][-1]
    again = [*command, str(state), "--resume", str(state)]
    assert cli.main([*again, "--seed", "9"]) == 2
    assert "seed = 0" in capsys.readouterr().err
    assert cli.main([*again, "--method", "coupled,lloyd"]) == 2
    assert "--method" in capsys.readouterr().err


def test_an_endless_interval_keeps_the_bits_and_writes_what_is_interrupted(ctx, tmp_path):
    adapter, box, file = clvoro.Adapter(ctx), clvoro.Box((0, 0), (1, 1)), tmp_path / "run.checkpoint"
    whole = adapter.run(box, 0.2)
    kept = adapter.run(box, 0.2, checkpoint=clvoro.Checkpoint(file, np.inf))
    assert np.array_equal(kept.points, whole.points)
    assert not file.exists()

    def press(row):
        if row["step"] == 3:
            raise KeyboardInterrupt

    with pytest.raises(clvoro.Interrupted):
        adapter.run(box, 0.2, checkpoint=clvoro.Checkpoint(file, np.inf), callback=press)
    resumed = adapter.run(box, 0.2, checkpoint=clvoro.Checkpoint(resume=file))
    assert resumed.stop_reason == whole.stop_reason
    assert len(resumed.history) >= len(whole.history)
