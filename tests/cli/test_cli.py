"""The command line: files, exit codes, progress, Ctrl-C, and that a run can be repeated."""

import functools
import io
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import clvoro
from clvoro.cli import command as cli
from clvoro.cli import jobs, progress
from clvoro.errors import BuildError, DeviceError, MemoryLimitError, SolverError
from clvoro.io import load
from clvoro.mesh.results import HISTORY_DTYPE

CASE = """
title = "A small box"
size = 0.11

[domain]
lower = [0, 0]
upper = [1, 1]

[run]
methods = ["lloyd", "coupled"]
start = "uniform"
max_steps = 4
tol = 0
seed = 3141
"""


HERE = ("small.toml", CASE)


def call(*arguments):
    return cli.main([str(a) for a in arguments])


def test_run_writes_everything(here, capsys, monkeypatch):
    monkeypatch.setattr("clvoro.cli.progress.EVERY", 1e9)
    assert call("run", "small.toml") == cli.OK
    out = here / "out" / "small"
    written = {p.name for p in out.iterdir()}
    assert written == {
        "mesh.vtu",
        "mesh.npz",
        "history.csv",
        "mesh-lloyd.npz",
        "history-lloyd.csv",
        "case.toml",
        "report.html",
        "pictures",
    }
    printed = capsys.readouterr()
    assert printed.err == ""  # no progress in a log before its first time has come
    last = printed.out.splitlines()[-1]
    folder, _, names = last.partition(": ")
    assert folder == "written into out/small"
    assert {name.rstrip("/") for name in names.split(", ")} == written
    mesh = load(out / "mesh.npz")
    row = re.search(r"^coupled +(\d+) +(\d+) +([\d.]+)", printed.out, re.MULTILINE)
    assert (int(row[1]), int(row[2])) == (len(mesh.points), 4)
    assert float(row[3]) == pytest.approx(np.abs(mesh.size_error).mean(), abs=5e-5)


def test_further_formats(here, capsys):
    options = ["--method", "lloyd", "--no-report", "--quiet", "--format", "foam,nc", "--out", "a"]
    assert call("run", "small.toml", *options) == cli.OK
    assert (here / "a/constant/polyMesh/owner").is_file()
    assert call("check", "a", "a/mesh.foam", "a/constant/polyMesh") == cli.OK
    assert capsys.readouterr().out.count("openfoam: accepted") == 3
    assert call("check", "--for", "modflow", "a/mesh.npz", "a/mesh.foam") == cli.BAD_INPUT
    printed = capsys.readouterr()
    assert "modflow: accepted" in printed.out
    assert "a/mesh.foam is a mesh for OpenFOAM, and --for modflow is for mesh.npz" in printed.err
    assert call("convert", "a/mesh.foam", "b.vtu") == cli.BAD_INPUT
    assert "OpenFOAM's meshes have no generators; load the mesh.npz or mesh.vtu" in capsys.readouterr().err
    assert (here / "a/mesh.nc").read_bytes().startswith((b"CDF", b"\x89HDF"))
    # A second run may replace them.
    assert call("run", "small.toml", *options) == cli.OK


PATCHED = """
size = 0.3
[domain]
lower = [0, 0]
upper = [1, 1]
names = {inlet = "xMin", sea-open = "xMax"}
[patches]
yMax = "symmetry"
[run]
effort = "fast"
"""


def test_types_of_patches_are_those_of_the_case_of_options_and_of_names(here):
    (here / "patched.toml").write_text(PATCHED)
    options = ["--no-report", "--quiet", "--format", "openfoam"]

    def types(folder):
        text = (here / folder / "constant/polyMesh/boundary").read_text()
        return dict(re.findall(r"([\w-]+)\s*\{\s*type\s+(\w+)", text))

    assert call("run", "patched.toml", *options, "--types", "yMin=symmetryPlane,sea-open=wall", "--out", "a") == cli.OK
    planes = {"back": "empty", "front": "empty"}
    expected = {"inlet": "patch", "sea-open": "wall", "yMin": "symmetryPlane", "yMax": "symmetry", **planes}
    assert types("a") == expected
    assert call("run", "a/case.toml", *options, "--out", "b") == cli.OK
    assert types("b") == expected
    assert call("convert", "a/mesh.npz", "c/c.foam", "--types", "inlet=wall") == cli.OK
    assert types("c") == {"inlet": "wall", "sea-open": "patch", "yMin": "wall", "yMax": "wall", **planes}


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("yMax =", "yMx =", "patched.toml: patches is 'yMx', expected the name of a boundary: inlet, sea-open, yMin"),
        (
            '"symmetry"',
            '"symetry"',
            "patches.yMax is 'symetry' (did you mean 'symmetry'?); expected one of patch, symmetry",
        ),
        ("[patches]", "[[layers]]\nheight = 0.1\nedges = 'inlte'\n[patches]", "layers[0].edges is 'inlte', expected"),
        (
            "size = 0.3",
            "size = {kind = 'min', fields = [1, {kind = 'distance', h_min = 1, slope = 1, "
            "shapes = [{kind = 'boundary', edges = ['inlte']}]}]}",
            "patched.toml: size.fields[1].shapes[0].edges is 'inlte', expected the name of a boundary",
        ),
    ],
)
def test_names_of_boundaries_are_refused_with_their_key(here, capsys, old, new, says):
    (here / "patched.toml").write_text(PATCHED.replace(old, new))
    assert call("run", "patched.toml") == cli.BAD_INPUT
    assert says in capsys.readouterr().err


def test_formats_that_are_refused(here, capsys):
    with pytest.raises(SystemExit) as left:
        call("run", "small.toml", "--format", "foam,stl")
    assert left.value.code == cli.BAD_INPUT
    assert "'stl' is not a mesh format, expected one or more of openfoam, " in capsys.readouterr().err
    assert call("run", "sphere", "--format", "nc", "--out", "b") == cli.BAD_INPUT
    assert "format nc is for meshes in 2D" in capsys.readouterr().err
    assert not (here / "b").exists()


def test_convert(here, capsys):
    assert call("run", "small.toml", "--no-report", "--quiet", "--steps", 1, "--out", "a") == cli.OK
    capsys.readouterr()
    for name in ("copy.vtu", "copy.npz", "copy.foam", "copy.nc"):
        assert call("convert", "a/mesh.npz", name) == cli.OK
        more = " (with constant/polyMesh)" if name == "copy.foam" else ""
        assert capsys.readouterr().out == f"written: {name}{more}\n"
        assert (here / name).exists()
    assert np.array_equal(load(here / "copy.npz").points, load(here / "a/mesh.npz").points)
    assert call("convert", "copy.vtu", "again.nc", "--convention", "mpas") == cli.OK
    assert call("convert", "copy.nc", "again.vtu") == cli.BAD_INPUT
    assert "copy.nc: it is a mesh in the plane, expected one on a sphere" in capsys.readouterr().err
    assert call("convert", "copy.npz", "again.xyz") == cli.BAD_INPUT
    assert not (here / "again.xyz").exists()


CIRCLE = [[0.5 + 0.2 * np.cos(t), 0.5 + 0.2 * np.sin(t)] for t in np.arange(60) * np.pi / 30]
ROUND = f"""
size = 0.08
[domain]
outer = [[0, 0], [1, 0], [1, 1], [0, 1]]
holes = [{np.array(CIRCLE).tolist()}]
[run]
effort = "fast"
"""


def test_meshes_are_checked_for_a_solver(here, capsys, monkeypatch):
    (here / "round.toml").write_text(ROUND)
    quick = ["run", "round.toml", "--no-report", "--quiet", "--out", "a"]
    monkeypatch.setenv("PATH", str(here))  # without OpenFOAM
    assert call(*quick, "--check-solver", "openfoam") == cli.OK
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "warning: OpenFOAM's checkMesh is not installed" in printed.err
    exact = ["--walls", "exact"]
    assert call(*quick, "--check-solver", "openfoam", *exact, "--json") == cli.FAILED
    *_, last = capsys.readouterr().out.splitlines()
    said = json.loads(last)
    assert (said["ok"], said["solver"], said["checkMesh"]) == (False, "openfoam", None)
    assert call("check", "--for", "openfoam", "a/mesh.vtu") == cli.OK
    assert "openfoam: accepted" in capsys.readouterr().out
    assert call("check", "--for", "openfoam", *exact, "a/mesh.npz") == cli.FAILED
    assert "rejected: concavity" in capsys.readouterr().out
    assert call("check", *exact, "a/mesh.npz") == cli.BAD_INPUT
    assert call(*quick, *exact) == cli.BAD_INPUT
    assert "no mesh is written for OpenFOAM" in capsys.readouterr().err
    assert call(*quick, *exact, "--format", "openfoam") == cli.FAILED
    assert "clvoro with --unchecked" in capsys.readouterr().err
    assert call(*quick, *exact, "--format", "openfoam", "--unchecked") == cli.OK
    assert call("convert", "a/mesh.npz", "b.foam", *exact) == cli.FAILED
    assert call("convert", "a/mesh.npz", "b.foam", *exact, "--unchecked") == cli.OK


def test_a_solver_checks_the_mesh_itself(here, capsys, monkeypatch):
    """With a stand-in for checkMesh, which has the last word."""
    (here / "round.toml").write_text(ROUND)
    program = here / "checkMesh"
    monkeypatch.setenv("PATH", str(here), prepend=os.pathsep)
    quick = ["run", "round.toml", "--no-report", "--out", "a", "--check-solver", "openfoam"]
    for says, code in (("Mesh OK.", cli.OK), (" ***Bad cells", cli.FAILED)):
        program.write_text(f"#!/bin/sh\ntest -f $4/constant/polyMesh/faces && echo '{says}'\n")
        program.chmod(0o755)
        assert call(*quick) == code
        assert f"checkMesh: {says.strip(' *.')}" in capsys.readouterr().out


def test_written_case_repeats_the_mesh(here):
    assert call("run", "small.toml", "--no-report", "--quiet", "--k", "0.7", "--out", "a") == 0
    assert call("run", "a/case.toml", "--no-report", "--quiet", "--out", "b") == 0
    for name in ("mesh.npz", "mesh-lloyd.npz"):
        one, two = load(here / "a" / name), load(here / "b" / name)
        assert np.array_equal(one.points, two.points)
    assert (here / "a" / "case.toml").read_text() == (here / "b" / "case.toml").read_text()
    assert not (here / "a" / "report.html").exists()


def test_json_lines(here, capsys):
    assert call("run", "small.toml", "--json", "--no-report", "--dtype", "float32") == cli.OK
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["method"] for line in lines] == ["lloyd", "coupled"]
    mesh = load(here / "out" / "small" / "mesh.npz")
    assert lines[1]["cells"] == len(mesh.points)
    assert lines[1]["mean_quality"] == pytest.approx(mesh.quality.mean())
    assert lines[1]["settings"]["dtype"] == "float32"
    assert lines[1]["steps"] == 4


def test_options_override_the_case(here, capsys):
    options = ["--method", "poisson", "--cells", 33, "--steps", 2, "--start", "density"]
    options += ["--seed", 77, "--k", 0.25, "--tol", 0.5]
    assert call("run", "small.toml", "--json", "--no-report", *options) == cli.OK
    (line,) = capsys.readouterr().out.splitlines()
    settings = json.loads(line)["settings"]
    wanted = {"method": "poisson", "n_cells": 33, "max_steps": 2, "start": "density", "seed": 77, "k": 0.25, "tol": 0.5}
    assert {key: settings[key] for key in wanted} == wanted
    repeat = (here / "out" / "small" / "case.toml").read_text()
    assert 'method = "poisson"' in repeat
    assert "methods" not in repeat


def test_methods_of_a_case_start_alike(here, capsys):
    assert call("run", "small.toml", "--no-report", "--quiet", "--steps", 0) == cli.OK
    lloyd, coupled = (load(here / "out/small" / f) for f in ("mesh-lloyd.npz", "mesh.npz"))
    assert np.array_equal(lloyd.points, coupled.points)
    assert capsys.readouterr().out == ""


def test_start_from_points(here):
    points = np.random.default_rng(12).random((20, 2))
    np.save(here / "start.npy", points)
    text = CASE.replace('start = "uniform"', 'points = "start.npy"')
    (here / "warm.toml").write_text(text)
    assert call("run", "warm.toml", "--no-report", "--quiet", "--steps", 0) == cli.OK
    # The device's coordinates are scaled by a power of two: nothing is rounded here.
    assert np.array_equal(load(here / "out/warm/mesh.npz").points, points)
    assert (here / "out/warm/start.npy").exists()
    assert call("run", "out/warm/case.toml", "--no-report", "--quiet", "--out", "again") == cli.OK


def test_an_interrupt_after_the_last_step_leaves_a_complete_mesh(here, monkeypatch, capsys):
    plain = clvoro.Adapter.run

    def run(*args, **options):
        result = plain(*args, **options)
        signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(clvoro.Adapter, "run", run)
    (here / "one.toml").write_text(ROUND)
    assert call("run", "one.toml", "--no-report") == cli.INTERRUPTED
    said = capsys.readouterr().err
    assert "no step was left: the mesh is complete" in said
    assert "to go on" not in said
    assert load(here / "out/one/mesh.npz").stop_reason == "plan completed"
    assert "interrupted" not in (here / "out/one/case.toml").read_text()


@pytest.mark.sparse(1)
@pytest.mark.parametrize("last_step", [0, 2])
def test_interrupt_keeps_what_there_is(here, monkeypatch, capsys, last_step):
    plain = progress.ProgressDisplay.__call__

    def pressing(self, row):
        plain(self, row)
        if row["step"] == last_step:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(progress.ProgressDisplay, "__call__", pressing)
    handler = signal.getsignal(signal.SIGINT)
    report = last_step > 0  # once, because pictures take time
    assert call("run", "small.toml", *([] if report else ["--no-report"])) == cli.INTERRUPTED
    assert signal.getsignal(signal.SIGINT) is handler
    assert "stopping after this step" in capsys.readouterr().err
    out = here / "out" / "small"
    # The first method was stopped, the second not begun: its mesh is the result.
    mesh = load(out / "mesh.npz")
    assert mesh.history["step"].tolist() == list(range(last_step + 1))
    assert mesh.stop_reason == "interrupted"
    assert (out / "report.html").exists() == report
    assert not list(out.glob("*-lloyd*"))
    assert "interrupted" in (out / "case.toml").read_text().splitlines()[0]


def test_an_interrupted_run_prints_the_command_that_continues(here, monkeypatch, capsys):
    plain, last = progress.ProgressDisplay.__call__, [3]

    def pressing(self, row):
        plain(self, row)
        if row["step"] in last:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(progress.ProgressDisplay, "__call__", pressing)
    (here / "one.toml").write_text(ROUND)
    command = ["run", "one.toml", "--no-report", "--out", "my out", "--seed", "4"]
    assert call(*command) == cli.INTERRUPTED
    said = next(line for line in capsys.readouterr().err.splitlines() if "to go on: " in line)
    words = shlex.split(said.split("to go on: ")[1])
    assert words == ["clvoro", *command, "--resume", "my out/run.checkpoint"]
    last[:] = [9]
    assert call(*words[1:]) == cli.INTERRUPTED  # once more
    assert f"to go on: {shlex.join(words)}" in capsys.readouterr().err
    assert load(here / "my out/mesh.npz").history["step"].tolist() == list(range(10))
    last.clear()
    assert call(*words[1:]) == cli.OK
    assert load(here / "my out/mesh.npz").stop_reason == "plan completed"
    # Another size field is named as such.
    (here / "one.toml").write_text(ROUND.replace("size = 0.08", "size = 0.05"))
    assert call(*words[1:]) == cli.BAD_INPUT
    assert "its size field differs; at (" in capsys.readouterr().err


def test_failure_of_a_later_method_keeps_the_earlier_ones(here, monkeypatch, capsys):
    plain = clvoro.Adapter.run

    @functools.wraps(plain)
    def run(self, *arguments, method, **options):
        if method == "coupled":
            raise SolverError("no convergence")
        return plain(self, *arguments, method=method, **options)

    monkeypatch.setattr(clvoro.Adapter, "run", run)
    assert call("run", "small.toml", "--no-report") == cli.FAILED
    assert "no convergence" in capsys.readouterr().err
    assert len(load(here / "out" / "small" / "mesh.npz").history) == 5


def test_an_unknown_method_is_refused_before_the_first_runs(here, capsys):
    assert call("run", "small.toml", "--method", "lloyd,copled") == cli.BAD_INPUT
    assert "run.methods[1] is 'copled' (did you mean 'coupled'?)" in capsys.readouterr().err
    assert not (here / "out").exists()


def test_warnings_are_one_line(here, capsys):
    text = CASE.replace("size = 0.11", "size = 110")
    assert text != CASE
    (here / "meters.toml").write_text(text)
    assert call("run", "meters.toml", "--no-report", "--quiet", "--method", "lloyd") == cli.OK
    printed = capsys.readouterr().err
    assert printed.startswith("clvoro: warning: h is larger than the domain: the size field requires")
    assert all(line.startswith("clvoro: warning: ") for line in printed.splitlines())


def test_every_file_is_checked(here, capsys):
    call("run", "small.toml", "--no-report", "--quiet")
    files = "small.toml", "nothing.npz", "out/small/mesh.npz"
    assert call("check", *files) == cli.BAD_INPUT
    printed = capsys.readouterr()
    assert "small.toml is no mesh, expected a .npz" in printed.err
    assert "nothing.npz" in printed.err
    assert "out/small/mesh.npz: " in printed.out


def test_second_interrupt_quits_at_once(here, monkeypatch, capsys):
    monkeypatch.setattr(clvoro.Adapter, "run", pressing_run(signal.SIGINT))
    assert call("run", "small.toml") == cli.INTERRUPTED
    assert not list((here / "out" / "small").iterdir())
    assert "nothing more has been written" in capsys.readouterr().err


def pressing_run(number):
    """Return a stand-in for Adapter.run during which the key is pressed twice."""

    def run(self, domain, size, **options):
        for _ in range(2):
            signal.raise_signal(number)

    return run


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (["run", "papre"], cli.BAD_INPUT, "did you mean 'paper'"),
        (["run", "part.STL"], cli.BAD_INPUT, "solid = 'part.STL' below [domain]"),
        (["run", "part.stl.gz"], cli.BAD_INPUT, "solid = 'part.stl.gz' below [domain]"),
        (["run", "small.toml", "--steps", -1], cli.BAD_INPUT, "run.max_steps is -1"),
        (["run", "small.toml", "--method", "magic"], cli.BAD_INPUT, "magic"),
        (["run", "small.toml", "--out", "small.toml"], cli.BAD_INPUT, "folder cannot be created"),
        (["run", "small.toml", "--device", "abacus"], cli.NO_DEVICE, "abacus"),
        (["cases", "papre"], cli.BAD_INPUT, "airfoil, channel, lake, ocean, paper, sphere, surface"),
    ],
)
def test_errors_are_one_message(here, capsys, arguments, code, named):
    assert call(*arguments) == code
    printed = capsys.readouterr()
    assert named in printed.err
    assert printed.err.startswith("clvoro: ")
    assert "Traceback" not in printed.err
    assert printed.out == ""


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (DeviceError("no device"), cli.NO_DEVICE, "no device"),
        (BuildError("no build"), cli.FAILED, "no build"),
        (MemoryLimitError("no room"), cli.FAILED, "no room"),
        (OSError("disk full"), cli.FAILED, "disk full"),
        (PermissionError(13, "denied", "a/b"), cli.BAD_INPUT, "cannot reach a/b: denied"),
    ],
)
def test_exit_codes_of_failures(here, monkeypatch, capsys, error, code, said):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(clvoro, "create_context", fail)
    assert call("run", "small.toml") == code
    assert capsys.readouterr().err == f"clvoro: {said}\n"


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(here):
    folder = here / "locked"
    folder.mkdir(mode=0o500)
    with pytest.raises(clvoro.ClvoroError, match=r"can be (made|written)|cannot write"):
        jobs.check_folder(folder / "inside")


def test_report_without_matplotlib_is_refused_before_the_run(here, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert call("run", "small.toml") == cli.FAILED
    assert "clvoro[plot]" in capsys.readouterr().err
    assert call("run", "small.toml", "--no-report", "--steps", 1) == cli.OK


@pytest.mark.parametrize("arguments", [[], ["run"], ["run", "paper", "--stps", "3"], ["fly"]])
def test_usage(arguments, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main(arguments)
    assert left.value.code == cli.BAD_INPUT
    assert "usage:" in capsys.readouterr().err


def test_cases_are_listed_and_printed(here, capsys):
    assert call("cases") == cli.OK
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [
        "airfoil",
        "channel",
        "lake",
        "ocean",
        "paper",
        "sphere",
        "surface",
    ]
    assert call("cases", "paper") == cli.OK
    (here / "mine.toml").write_text(capsys.readouterr().out)
    assert call("run", "mine.toml", "--steps", 0, "--no-report", "--quiet") == cli.OK


def test_devices(capsys):
    assert call("devices") == cli.OK
    assert "float64" in capsys.readouterr().out


@pytest.mark.slow
def test_module_and_version():
    run = [sys.executable, "-m", "clvoro", "--version"]
    shown = subprocess.run(run, capture_output=True, text=True, check=True)
    assert shown.stdout == f"clvoro {clvoro.__version__}\n"


# --- progress ------------------------------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self):
        return True


def row(step, seconds, cells=1000, progress=0.1):
    values = np.zeros((), HISTORY_DTYPE)
    values["step"], values["cells"], values["seconds"] = step, cells, seconds
    values["progress"] = progress
    values["mean_error"], values["max_error"] = 0.125, 1.5
    values["mean_quality"], values["min_quality"] = 0.75, 0.5
    return values[()]


def test_line_holds_the_numbers():
    shown = progress.ProgressDisplay("paper lloyd", 10, io.StringIO())
    for step in range(6):
        shown(row(step, 0.5 * step))
    line = shown.line(row(5, 2.5))
    assert len(line) < 80
    for part in ["lloyd 5/10", "|e| 0.1250", "max 1.5", "min 0.50", "2k cells/s", "2 s left"]:
        assert part in line


def test_line_of_a_run_of_unknown_length():
    shown = progress.ProgressDisplay("paper", None, io.StringIO())
    for step, cells in enumerate([10, 10, 10, 40, 40, 40]):
        shown(row(step, float(step), cells, progress=step / 8))
    line = shown.line(row(5, 5.0, 40, progress=0.625))
    assert line.startswith("paper 5 (62%)")
    assert "32.5 cells/s" in line  # 10 and 40 three times in four seconds
    assert line.endswith("3 s left")


def test_the_time_left_is_told_by_the_pace_of_the_latter_half():
    """Kernels are built before and in the first two steps, so the first four steps are not representative."""
    shown = progress.ProgressDisplay("paper", None, io.StringIO())
    seconds = [90, 100, 110, 111, 112, 113, 114, 115, *range(116, 300)]
    lines = []
    for step, at in enumerate(seconds):
        values = row(step, float(at), progress=step / 400)
        shown(values)
        lines.append(shown.line(values))
    assert not any("left" in line for line in lines[: progress.PACED + 1])
    assert "cells/s" not in lines[1]
    assert "100 cells/s" in lines[2]
    assert all("left" in line for line in lines[progress.PACED + 1 :])
    # 192 steps done, one a second since the third: 208 to go.
    assert lines[-1].endswith("3 min 29 s left")
    assert "1k cells/s" in lines[-1]


def test_terminal_gets_one_changing_line(monkeypatch):
    monkeypatch.setattr(progress, "REFRESH", 0.0)
    stream = Terminal()
    with progress.ProgressDisplay("x", 5, stream) as shown:
        for step in range(3):
            shown(row(step, step))
    text = stream.getvalue()
    assert "\n" not in text
    # The preparation, three steps, and the final clearing of the line.
    assert text.startswith("\rx: preparing")
    assert text.count("\r") == 5


def test_terminal_shows_how_many_kernels_are_built():
    stream = Terminal()
    with progress.ProgressDisplay("x", 5, stream) as shown:
        shown.show_builds(3, 50)
    assert "\rx: building kernels, once for this device: 3 of 50" in stream.getvalue()
    silent = io.StringIO()
    progress.ProgressDisplay("x", 5, silent).show_builds(3, 50)
    assert silent.getvalue() == ""


def test_work_after_the_last_step_is_named(monkeypatch):
    stream, log = Terminal(), io.StringIO()
    with progress.ProgressDisplay("x", 5, stream) as shown:
        shown(row(4, 4.0))
        shown.show_work("walls of 9 cells")
    assert "\rx: walls of 9 cells" in stream.getvalue()
    shown = progress.ProgressDisplay("x", 5, log)
    shown.show_work("short edges")  # soon
    monkeypatch.setattr(progress, "EVERY", 0.0)
    shown.show_work("walls")
    assert log.getvalue() == "x: walls\n"


@pytest.mark.parametrize("kind", ["log", "terminal"])
def test_a_line_that_stays(kind):
    stream = io.StringIO() if kind == "log" else Terminal()
    with progress.ProgressDisplay("x", 5, stream) as shown:
        shown.tell("takes [1] MiB")
    text = stream.getvalue()
    assert re.search(r"takes \[1\] MiB\S*\s*\n", text)
    assert kind != "log" or text == "takes [1] MiB\n"


def test_work_that_takes_long_is_named(monkeypatch, capsys):
    assert progress.during("short", False, lambda: 3) == 3
    monkeypatch.setattr(progress, "LONG", 0.0)
    begun = threading.Event()
    monkeypatch.setattr(progress, "print", lambda *a, **k: (print(*a, **k), begun.set()), raising=False)
    assert progress.during("long", False, lambda: begun.wait(10))
    progress.during("quiet", True, lambda: time.sleep(0.01))
    assert capsys.readouterr() == ("", "long\n")


def test_log_gets_a_line_now_and_then(monkeypatch):
    stream = io.StringIO()
    clock = iter(range(0, 1000, 2))
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    with progress.ProgressDisplay("x", 20, stream) as shown:
        for step in range(10):  # two seconds each
            shown(row(step, 2.0 * step))
    lines = stream.getvalue().splitlines()
    assert 2 <= len(lines) <= 20 / progress.EVERY
    assert all(re.match(r"x \d+/20  ", line) for line in lines)
