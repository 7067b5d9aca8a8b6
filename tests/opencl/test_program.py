"""Programs are built for the first kernel that is used, from short declarations with PoCL."""

import os
import subprocess
import sys
import uuid

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest

import clvoro
from clvoro.opencl import program, runtimes
from clvoro.opencl.program import source_text
from clvoro.sizing.expression import _FUNCTIONS


def test_program_is_built_for_its_first_kernel(engine, monkeypatch):
    built = []
    build = program.build_program
    monkeypatch.setattr(program, "build_program", lambda *a: built.append(a[1]) or build(*a))
    kernels = engine.kernels("opencl/primitives")
    assert not built
    assert kernels.gather_rows is kernels.gather_rows
    assert built == ["opencl/primitives.cl"]


def test_pocl_reads_short_declarations(ctx, monkeypatch):
    if not program.has_short_declarations(ctx):
        pytest.skip("for some versions of PoCL only")
    texts = []
    plain = cl.Program

    def noted(ctx, text):
        texts.append(text)
        return plain(ctx, text)

    monkeypatch.setattr(program.cl, "Program", noted)
    ours = "kernel void put(global double *x) { x[0] = sqrt(x[1]); }"
    program.compile_text(ctx, ours, ())
    program.compile_text(ctx, ours, (), short=False)
    # A function that no kernel of ours calls is found in PoCL's own declarations.
    other = ours.replace("sqrt", "erfc")
    program.compile_text(ctx, other, ())
    assert [text.endswith(ours) or text.endswith(other) for text in texts] == [True] * 4
    whole = [program.NO_ABI_WARNINGS + text for text in (ours, other)]
    assert [text in whole for text in texts] == [False, True, False, True]


@pytest.mark.slow
def test_lock_of_a_killed_process_is_removed(ctx, tmp_path, monkeypatch):
    """PyOpenCL keeps binaries of devices that keep none. A process that is killed meanwhile leaves its lock."""
    monkeypatch.setattr("pyopencl.characterize.has_src_build_cache", lambda device: False)
    monkeypatch.setattr(program, "has_src_build_cache", lambda device: False)
    monkeypatch.setattr(runtimes, "_HELD", 0.1)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = "kernel void put(global double *x) { x[0] = x[1]; }"
    program.compile_text(ctx, source, ())
    (folder,) = tmp_path.glob("pyopencl/*")
    lock = folder / "lock"
    lock.touch()
    program.compile_text(ctx, source, ())  # PyOpenCL by itself waits for a minute, and fails
    assert not lock.exists()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_short_declarations_are_enough_for_all_programs(ctx, dtype, monkeypatch):
    from tests.robustness.gpu_programs import programs_of_all_kinds

    if not program.has_short_declarations(ctx):
        pytest.skip("for some versions of PoCL only")
    built, plain = [], cl.Program
    monkeypatch.setattr(program.cl, "Program", lambda *a: built.append(a[1]) or plain(*a))
    programs_of_all_kinds(ctx, dtype, group=None)
    assert built
    assert all("DECLARE_REALS" in text for text in built)


@pytest.mark.sparse(1)
@pytest.mark.parametrize(("real", "dtype"), [("double", "float64"), ("float", "float32")])
def test_short_declarations_have_the_functions_of_formulas(ctx, monkeypatch, real, dtype):
    """As PoCL's own: the same calls, so the same bits."""
    if not program.has_short_declarations(ctx):
        pytest.skip("for some versions of PoCL only")
    names = ("x[0]", "x[1]", "x[2]")
    calls = [f.opencl.format(*names[: f.arguments]) for f in _FUNCTIONS.values()]
    puts = "\n".join(f"h[{row}] = {call};" for row, call in enumerate(calls))
    text = (
        f"{source_text('sizing/size_fields.h')}\n"
        f"kernel void evaluate(global {real} *x, global {real} *h) {{\n{puts}\n}}"
    )
    texts, plain = [], cl.Program
    monkeypatch.setattr(program.cl, "Program", lambda *a: texts.append(a[1]) or plain(*a))
    found = []
    for short in (True, False):
        built = program.compile_text(ctx, text, (f"-DREAL={real}", "-DDIM=2"), short=short)
        assert ("DECLARE_REALS" in texts[-1]) == short
        with cl.CommandQueue(ctx) as queue:
            x = cla.to_device(queue, np.array([0.3, 0.7, 0.4], dtype))
            h = cla.zeros(queue, len(calls), dtype)
            built.evaluate(queue, (1,), (1,), x.data, h.data)
            found.append(h.get())
    assert found[0].tobytes() == found[1].tobytes()
    expected = [f.numpy(*(0.3, 0.7, 0.4)[: f.arguments]) for f in _FUNCTIONS.values()]
    np.testing.assert_allclose(found[0], expected, rtol=1e-5 if real == "float" else 1e-13)


def test_programs_are_the_same_for_all_periods(ctx):
    """Stages and their memory are kept for the last periods only."""
    adapter = clvoro.Adapter(ctx)
    engines = [adapter._stages_for(clvoro.Box((0, 0, 0), (1, 1, z), periodic=True)).engine for z in (1, 0.9)]
    assert len(adapter._stages) == 1
    assert adapter._stages_for(clvoro.Box((0, 0, 0), (2, 2, 1.8), periodic=True)).engine is engines[1]
    assert [engine.period_args[0][2] for engine in engines] == pytest.approx([1, 0.9])
    texts = [engine.all_defines("adaptation/motion", {}) for engine in engines]
    assert texts[0] == texts[1]
    assert texts[0]["PERIODIC"] == 1


RUN_WITHOUT_A_CACHE = """
import pyopencl.characterize
pyopencl.characterize.has_src_build_cache = lambda device: False
import clvoro
clvoro.Adapter().diagram(clvoro.Box((0, 0), (1, 1)), [(0.2, 0.3), (0.7, 0.6)])
"""


@pytest.mark.slow
def test_binaries_are_kept_where_the_driver_keeps_none(ctx, tmp_path):
    """PyOpenCL does it. PoCL stands for another driver here."""
    kept = []
    for run in range(2):
        places = {"XDG_CACHE_HOME": tmp_path, "POCL_CACHE_DIR": tmp_path / f"pocl {run}", "POCL_KERNEL_CACHE": 0}
        environment = {**os.environ, **{name: str(value) for name, value in places.items()}}
        subprocess.run([sys.executable, "-c", RUN_WITHOUT_A_CACHE], env=environment, check=True)
        kept.append({path: path.stat().st_mtime for path in tmp_path.glob("pyopencl/**/binary")})
    assert kept[0]
    assert kept[0] == kept[1]


def test_vectors_of_eight_doubles_give_no_warnings(ctx, capfd):
    """On CPUs without AVX-512, too. The text is a new one, as PoCL warns only of what its cache does not have."""
    if not program.on_pocl(ctx.devices[0]):
        pytest.skip("for PoCL only")
    text = f"// {uuid.uuid4()}\n" + (
        "double8 half_of(double8 x) { return 0.5 * x; }\n"
        "kernel void halve(global double8 *x) { x[0] = half_of(x[0]); }\n"
    )
    program.compile_text(ctx, text, ())
    assert "warning" not in capfd.readouterr().err
    program.compile_text(ctx, "#warning seen\n" + text, (), short=False)
    assert "warning" in capfd.readouterr().err


def test_long_kernels_call_their_body(ctx):
    """Lines keep their numbers. All long kernels are found, and macros of arguments become those of calls."""
    text = (
        "#define PERIODS , periods\n"
        "kernel void move(const int size, global REAL *x,\n"
        "                 const REAL h PERIOD_ARGS)\n"
        "{\n    LONG_ITEM(i);\n    x[i] = h;\n}\n"
    )
    split = program.with_long_bodies_once(text)
    given = "const int size, global REAL *x, const REAL h PERIOD_ARGS"
    assert split.splitlines()[1] == f"OUT_OF_LINE void move_once(const int i, {given})"
    assert f"}} kernel void move({given}) {{ WORK_ITEM(i); move_once(i, size, x, h PERIODS); }}" in split
    files = [path.relative_to(program.kernel_folder()).as_posix() for path in program.kernel_folder().rglob("*.cl")]
    for name in files:
        text = source_text(name)
        long = text.count("    LONG_ITEM(") + text.count("    LONG_GROUP;")
        assert program.with_long_bodies_once(text).count("_once(const ") == long, name
