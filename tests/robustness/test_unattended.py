"""Unattended runs with broken streams, signals, full disks and forks: they continue, or name the remedy."""

import contextlib
import errno
import io
import os
import signal
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.adaptation import checkpoint
from clvoro.adaptation.checkpoint import Saved
from clvoro.cli import command as cli
from clvoro.cli import outputs, progress
from clvoro.errors import BuildError, CheckpointWarning, DeviceError, InputError, MemoryLimitError, OutputError
from clvoro.io import npz
from clvoro.opencl import memory_limits
from clvoro.opencl import runtimes as _runtimes
from clvoro.opencl.kernels import KernelPool, Kernels
from clvoro.opencl.memory_limits import in_bytes

ROOT = Path(__file__).parents[2]
BOX = clvoro.Box((0, 0), (1, 1))
CASE = """size = 0.15
[domain]
lower = [0, 0]
upper = [1, 1]
[run]
method = "lloyd"
max_steps = 3
tol = 0
"""
FEW = {"method": "lloyd", "max_steps": 4, "options": clvoro.PaperOptions(tol=0.0)}


HERE = ("small.toml", CASE)


def call(*arguments):
    return cli.main(["run", "small.toml", "--no-report", *map(str, arguments)])


# Standard streams.


class Breaking(io.StringIO):
    """A stream that fails at every write, or only at a flush."""

    def __init__(self, number, late):
        super().__init__()
        self.number, self.late = number, late

    def write(self, text):
        if not self.late:
            raise OSError(self.number, os.strerror(self.number))
        return len(text)

    def flush(self):
        if self.late:
            raise OSError(self.number, os.strerror(self.number))


@pytest.mark.sparse
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize(
    ("number", "code"), [(errno.EPIPE, cli.OK), (errno.ENOSPC, cli.FAILED), (errno.EIO, cli.FAILED)]
)
def test_an_output_that_breaks_costs_no_mesh(here, monkeypatch, capsys, number, code, late):
    monkeypatch.setattr(sys, "stdout", Breaking(number, late))
    assert call("--json") == code
    assert (here / "out/small/mesh.npz").exists()
    lost = "clvoro: cannot write to the standard output: " + os.strerror(number)
    assert capsys.readouterr().err == ("" if code == cli.OK else f"{lost}\n")


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_messages_that_nobody_can_read_change_nothing(here, monkeypatch, number):
    monkeypatch.setattr(sys, "stderr", Breaking(number, late=False))
    assert call() == cli.OK
    assert cli.main(["run", "nothing"]) == cli.BAD_INPUT


def test_streams_that_are_missing(here, monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert call() == cli.OK
    assert cli.main(["run", "nothing"]) == cli.BAD_INPUT
    assert (sys.stdout, sys.stderr) == (None, None)


def test_characters_that_a_stream_does_not_know(here, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stream)
    assert call("--out", "über") == cli.OK
    assert b"\\xfcber: mesh.vtu" in stream.buffer.getvalue()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
def test_the_process_ends_by_its_exit_code_and_a_message():
    """Nor by Python's own, when it fails again to write the rest."""
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "clvoro", "cases"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env={k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"},
        )
    assert done.returncode == cli.FAILED
    assert done.stderr.count("\n") == 1
    assert "standard output: No space left" in done.stderr


# Signals.


def pressing(monkeypatch, number):
    plain = progress.ProgressDisplay.__call__

    def press(self, row):
        plain(self, row)
        if row["step"] == 1:
            signal.raise_signal(number)

    monkeypatch.setattr(progress.ProgressDisplay, "__call__", press)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGXCPU"])
def test_other_signals_end_a_run_as_the_key_does(here, monkeypatch, name):
    number = getattr(signal, name, None) or pytest.skip("not on this system")
    pressing(monkeypatch, number)
    before = signal.getsignal(number)
    assert call() == cli.INTERRUPTED
    assert signal.getsignal(number) is before
    assert clvoro.load(here / "out/small/mesh.npz").stop_reason == "interrupted"


@pytest.mark.parametrize("name", ["SIGINT", "SIGHUP"])
def test_signals_that_are_ignored_stay_so(here, monkeypatch, name):
    """By nohup, or a shell that starts it in the background."""
    number = getattr(signal, name, None) or pytest.skip("not on this system")
    pressing(monkeypatch, number)
    before = signal.signal(number, signal.SIG_IGN)
    try:
        assert call() == cli.OK
    finally:
        signal.signal(number, before)


# Disks.


@contextlib.contextmanager
def room(size):
    """No file may become longer than `size` bytes: as if the disk were full then."""
    resource = pytest.importorskip("resource")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def in_little_room(function, size):
    def limited(*arguments, **options):
        with room(size):
            return function(*arguments, **options)

    return limited


def test_a_file_that_does_not_fit_costs_no_other(here, monkeypatch, capsys):
    monkeypatch.setattr(npz, "write_arrays", in_little_room(npz.write_arrays, 1000))
    assert call("--quiet") == cli.FAILED
    error = capsys.readouterr().err
    assert error.startswith("clvoro: cannot write out/small/mesh.npz: File too large; choose")
    assert error.count("\n") == 1
    assert sorted(os.listdir("out/small")) == ["case.toml", "history.csv", "mesh.vtu"]


def test_all_files_that_fail_are_named(capsys):
    done = []

    def fail(name):
        raise OutputError(name)

    with pytest.raises(OutputError, match="third"):
        outputs.do_all([lambda: fail("first"), lambda: done.append(1), lambda: fail("third"), lambda: done.append(2)])
    assert done == [1, 2]
    assert capsys.readouterr().err == "clvoro: first\n"


@pytest.mark.parametrize("name", ["mesh.vtu", "mesh.npz", "history.csv", "case.toml"])
def test_folders_in_the_place_of_files_are_found_before_the_run(here, capsys, name):
    (here / "out/small" / name).mkdir(parents=True)
    assert call() == cli.BAD_INPUT
    assert f"{name} is a folder, expected none or a file" in capsys.readouterr().err
    assert os.listdir("out/small") == [name]


def test_a_checkpoint_that_does_not_fit_costs_neither_the_run_nor_the_one_before(adapter, tmp_path, monkeypatch):
    path = tmp_path / "state"
    options = {**FEW, "checkpoint": clvoro.Checkpoint(path, every=0)}
    both = clvoro.Checkpoint(path, every=0, resume=True)
    adapter.run(BOX, 0.15, callback=lambda row: row["step"] == 1, **options)
    before = path.read_bytes()
    monkeypatch.setattr(checkpoint.Checkpointer, "write", in_little_room(checkpoint.Checkpointer.write, 1000))
    with pytest.warns(CheckpointWarning, match="File too large.* The run continues"):
        result = adapter.run(BOX, 0.15, **{**options, "checkpoint": both})
    other = clvoro.Checkpoint(tmp_path / "other", every=0)
    monkeypatch.undo()
    whole = adapter.run(BOX, 0.15, **{**options, "checkpoint": other})
    (tmp_path / "other").unlink()
    assert np.array_equal(result.points, whole.points)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["state"]


@pytest.mark.sparse(1)
@pytest.mark.parametrize("content", [b"precious", b"PK\x03\x04", "mesh"])
def test_checkpoints_replace_nothing_else(adapter, tmp_path, content):
    path = tmp_path / "file.npz"
    if content == "mesh":
        adapter.run(BOX, 0.3, **FEW).save(path)
    else:
        path.write_bytes(content)
    before = path.read_bytes()
    with pytest.raises(InputError, match="is not a checkpoint; choose another name, or remove it"):
        adapter.run(BOX, 0.15, checkpoint=clvoro.Checkpoint(path, every=0), **FEW)
    assert path.read_bytes() == before
    path.write_bytes(b"")  # as mktemp makes it
    adapter.run(BOX, 0.15, checkpoint=clvoro.Checkpoint(path, every=0), **FEW)
    assert Saved(path).state["steps"] == FEW["max_steps"]
    adapter.run(BOX, 0.2, checkpoint=clvoro.Checkpoint(path, every=0), **FEW)  # another run's checkpoint


def test_results_replace_neither_checkpoints_nor_what_a_run_begins_with(here, capsys):
    out = ["--out", "a"]
    assert call("--quiet", *out) == cli.OK
    before = (here / "a/mesh.npz").read_bytes()
    assert call(*out, "--checkpoint", "a/mesh.npz") == cli.BAD_INPUT
    assert "checkpoint is 'a/mesh.npz', which the run's results would" in capsys.readouterr().err
    (here / "a/again.toml").write_text(CASE + 'points = "mesh.npz"\n')
    again = ["run", "a/again.toml", "--no-report", "--quiet", "--steps", "0", "--out"]
    assert cli.main([*again, "a"]) == cli.BAD_INPUT
    assert "mesh.npz', which the run's results would replace" in capsys.readouterr().err
    assert (here / "a/mesh.npz").read_bytes() == before
    # In another folder, the copy of the input does not replace the result.
    assert cli.main([*again, "b"]) == cli.OK
    assert (here / "b/other-mesh.npz").read_bytes() == before
    assert len(clvoro.load(here / "b/mesh.npz").history) == 1
    assert cli.main(["run", "b/case.toml", *again[2:], "c"]) == cli.OK
    meshes = [clvoro.load(here / name / "mesh.npz").points for name in "abc"]
    assert np.array_equal(meshes[0], meshes[1])
    assert np.array_equal(meshes[0], meshes[2])


# Names.


@pytest.mark.parametrize("option", ["--out", "--checkpoint", "--resume"])
def test_names_of_variables_that_are_not_set(here, capsys, option):
    with pytest.raises(SystemExit) as left:
        call(option, "")
    assert left.value.code == cli.BAD_INPUT
    assert f"argument {option}: it is empty, expected a name" in capsys.readouterr().err
    assert os.listdir(here) == ["small.toml"]


def test_checkpoints_that_nobody_would_write(here, capsys):
    assert call("--checkpoint-every", "5") == cli.BAD_INPUT
    assert "say which file: --checkpoint FILE" in capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="names are text there")
def test_names_that_are_no_text(here, capsys):
    (here / os.fsdecode(b"b\xff.toml")).write_text(CASE)
    assert cli.main(["run", os.fsdecode(b"b\xff.toml")]) == cli.BAD_INPUT
    error = capsys.readouterr().err
    assert "expected a name in UTF-8" in error
    assert "name = ..." in error
    assert call("--quiet", "--out", os.fsdecode(b"o\xff")) == cli.OK
    assert clvoro.load(os.fsdecode(b"o\xff/mesh.npz"))


@pytest.mark.parametrize("suffix", [".npz", ".vtu", ".vtk"])
def test_the_longest_names(adapter, tmp_path, suffix):
    result = adapter.run(BOX, 0.3, **FEW)
    for letter in "xü☃🜂":
        name = letter * ((255 - len(suffix)) // len(letter.encode())) + suffix
        result.save(tmp_path / name)
    assert len(os.listdir(tmp_path)) == 4
    with pytest.raises(InputError, match="File name too long"):
        result.save(tmp_path / ("x" * 252 + suffix))
    with pytest.raises(InputError, match="File name too long"):
        adapter.run(BOX, 0.3, checkpoint=tmp_path / ("x" * 256), **FEW)
    with pytest.raises(InputError, match="characters that the file system knows"):
        result.save(tmp_path / f"\ud800{suffix}")


# What the process has, or has not.


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_forked_processes_are_told_that_they_cannot_work(ctx):
    adapter = clvoro.Adapter(ctx)
    result = adapter.run(BOX, 0.2, **FEW)
    attempts = [
        lambda: adapter.run(BOX, 0.2, **FEW),
        lambda: clvoro.Adapter(ctx),
        clvoro.create_context,
        clvoro.list_devices,
        lambda: result.diagram.vertices,
    ]
    end, begin = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(60)  # without an error the child would wait forever
        for attempt in attempts:
            try:
                attempt()
            except DeviceError as error:
                os.write(begin, b"+" if "get_context('spawn')" in str(error) else b"-")
            except BaseException:
                os.write(begin, b"!")
        os._exit(0)
    os.close(begin)
    with os.fdopen(end, "rb") as told:
        assert told.read() == b"+" * len(attempts)
    os.waitpid(child, 0)
    assert result.diagram.vertices.shape[1] == 2  # the parent works on


def test_the_hosts_memory_ends(here, monkeypatch, capsys):
    def fail(*_, **__):
        raise MemoryError("Unable to allocate 7 PiB")

    monkeypatch.setattr(clvoro, "create_context", fail)
    assert call() == cli.FAILED
    assert "out of memory (Unable to allocate 7 PiB); give" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("own", "limits", "least"),
    [
        ("0::/job/step\n", {"job/memory.max": "3e9", "job/step/memory.max": "max"}, None),
        ("0::/job/step\n", {"job/memory.max": "3000000", "job/step/memory.max": "max"}, 3e6),
        ("0::/\n", {"memory.max": "4000000\n"}, 4e6),
        ("5:cpu:/x\n3:memory,pids:/job\n", {"memory/job/memory.limit_in_bytes": "5000000"}, 5e6),
        (None, {"memory/memory.limit_in_bytes": "6000000"}, 6e6),
        ("no such line", {}, None),
    ],
)
def test_limits_of_containers_and_batch_systems_hold(adapter, tmp_path, monkeypatch, own, limits, least):
    """Work beyond the limit is refused, because the system would kill the process without a message."""
    whole = memory_limits.host_memory()
    for name, text in limits.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    if own is not None:
        (tmp_path / "self").write_text(own)
    monkeypatch.setattr(memory_limits, "GROUPS", tmp_path)
    monkeypatch.setattr(memory_limits, "OWN_GROUPS", tmp_path / "self")
    assert memory_limits.host_memory() == (least or whole)
    device = adapter.queue.device
    if least and device.type & cl.device_type.CPU:
        assert adapter.memory_needed(BOX, 0.05) < least
        with pytest.raises(MemoryLimitError, match=rf"has {in_bytes(least)}\."):
            adapter.run(BOX, 0.005)


def test_pictures_need_no_display(here, monkeypatch, capsys):
    import matplotlib

    monkeypatch.setenv("MPLBACKEND", "module://of.a.notebook")
    outputs.require_plots()
    assert os.environ["MPLBACKEND"] == "agg"  # before it is imported, and by its children

    def fail(_):
        raise ValueError("no such backend")

    monkeypatch.setattr(matplotlib, "use", fail)
    assert cli.main(["run", "small.toml"]) == cli.FAILED
    assert "Matplotlib, which cannot be used (no such backend)" in capsys.readouterr().err


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the cache folder is Linux's")
def test_caches_go_where_there_is_room(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert _runtimes.provide_cache() is None
    with room(_runtimes._ROOM - 1):  # nowhere
        assert _runtimes.provide_cache() is None
        assert _runtimes.full_cache_remedy().startswith(f"nothing can be written to {tmp_path}. If")
    assert _runtimes.full_cache_remedy() == ""
    assert os.environ["XDG_CACHE_HOME"] == str(tmp_path)
    full = {tmp_path}
    plain = _runtimes._has_room
    monkeypatch.setattr(_runtimes, "_has_room", lambda f: f not in full and plain(f))
    assert _runtimes.provide_cache().parent == Path(tempfile.gettempdir())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    full.add(None)
    if os.access("/dev/shm", os.W_OK):
        assert _runtimes.provide_cache().parent == Path("/dev/shm")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(_runtimes, "_has_room", lambda _: False)
    assert _runtimes.provide_cache() is None


def test_kernels_lost_from_a_cache(ctx, monkeypatch):
    monkeypatch.delenv("POCL_CACHE_DIR", raising=False)
    program = cl.Program(ctx, "kernel void other(global int *x) { x[0] = 0; }").build()
    lost = Kernels(lambda _: program, "sizing/size_field", KernelPool())
    with pytest.raises(BuildError, match=r"without its kernel evaluate_size\. If .* remove .*pocl"):
        _ = lost.evaluate_size
    with pytest.raises(AttributeError, match="has no kernel evalate"):
        _ = lost.evalate


# Numbers.


def test_numbers_without_end(adapter):
    with pytest.raises(InputError, match="max_steps has 10 digits, expected at most 1e"):
        adapter.run(BOX, 0.2, method="lloyd", max_steps=2**31)
    with pytest.raises(InputError, match=r"a constant size h is 1000.*expected a positive, finite"):
        adapter.run(BOX, 10**400)


def test_strict_floating_point_of_the_caller(adapter):
    values = np.full((20, 20), 0.2)
    values[9, 9] = 1e-300
    field = clvoro.sizing.Raster(values, (0, 0), (1, 1))
    with np.errstate(all="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", clvoro.errors.SizeErrorWarning)
        assert np.isfinite(adapter.run(BOX, field, effort="fast").size_error).all()


def test_callbacks_do_not_write_into_the_history(adapter):
    def spoil(row):
        row["mean_error"] = np.nan

    assert np.isfinite(adapter.run(BOX, 0.2, callback=spoil, **FEW).history["mean_error"]).all()
