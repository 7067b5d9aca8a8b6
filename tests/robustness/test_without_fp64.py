"""Devices without double precision: float32 programs contain no double, and meshes need none."""

import subprocess

import numpy as np
import pytest

import clvoro
from clvoro.opencl import devices, probe
from clvoro.remapping import cell_data
from tests.robustness import gpu_programs

HARMLESS = "warning: double precision constant requires cl_khr_fp64, casting to single precision"
needs_clang = pytest.mark.skipif(gpu_programs.clang() is None, reason="needs clang")


def complaints(text, options, fp64):
    """Return what clang reports on a program for a device with or without double precision."""
    extension = [] if fp64 else ["-Xclang", "-cl-ext=-cl_khr_fp64,-__opencl_c_fp64"]
    done = subprocess.run(
        [
            gpu_programs.clang(),
            *gpu_programs.CLANG,
            *extension,
            "-fsyntax-only",
            "-target",
            "spir64",
            "-Wall",
            "-Wdouble-promotion",
            "-Wno-unused",
            *options,
            "-",
        ],
        input=text,
        text=True,
        capture_output=True,
    )
    found = [line for line in done.stderr.splitlines() if "warning:" in line or "error:" in line]
    return [line for line in found if HARMLESS not in line]


def check(sources, devices_have_it=(False, True)):
    """Check for devices without double precision, and for others, where no number may become a double silently."""
    assert len(sources) > 15
    for source in sources:
        assert not any("double" in option for option in source.options), source[:2]
        for fp64 in devices_have_it:
            assert not complaints(source.text, source.options, fp64), source.name


@needs_clang
def test_float32_programs_need_no_double(ctx):
    """Those of first runs. Where there is double precision, each use of it is reported."""
    plane, space = (gpu_programs.programs_of_a_first_run(ctx, dim, "float32") for dim in (2, 3))
    check(plane + space, [True])


@needs_clang
@pytest.mark.slow
def test_all_float32_programs_need_no_double(ctx, monkeypatch):
    """Also those of transfers, surfaces and size fields, on a device that reports no double precision."""
    monkeypatch.setattr(probe, "has_fp64", lambda _: False)
    monkeypatch.setattr(devices, "has_fp64", lambda _: False)
    check(gpu_programs.programs_of_all_kinds(ctx, "float32", group=None))


@needs_clang
@pytest.mark.parametrize("line", ["double y = x[0];", "x[0] = x[0] * 0.1;"])
def test_doubles_are_found(line):
    text = f"kernel void put(global float *x) {{ {line} }}"
    assert complaints(text, (), False) or complaints(text, (), True)


def test_transfer_without_double_precision(ctx, monkeypatch):
    """Integrals are kept in float32, too, up to its round-off."""
    monkeypatch.setattr(probe, "has_fp64", lambda _: False)
    monkeypatch.setattr(devices, "has_fp64", lambda _: False)
    adapter, rng = clvoro.Adapter(ctx, "float32"), np.random.default_rng(9)
    box = clvoro.Box((0, 0), (1, 1))
    old, new = (adapter.diagram(box, rng.random((n, 2))) for n in (300, 200))
    reals, plain = set(), cell_data.Engine
    with monkeypatch.context() as patch:
        patch.setattr(cell_data, "Engine", lambda *args: reals.add(args[3]) or plain(*args))
        values = old.transfer(1 + old.points[:, 0], new)
    assert reals == {np.dtype(np.float32)}
    before, after = (1 + old.points[:, 0]) @ old.volumes, values @ new.volumes
    assert after == pytest.approx(before, rel=1e-5)
