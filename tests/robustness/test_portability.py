"""What other devices need, as far as it shows without them: work-groups, and other compilers."""

import re
import shutil
import subprocess

import numpy as np
import pytest

import clvoro
from clvoro.opencl import engine
from clvoro.opencl import program as _program
from tests.robustness import oclgrind_work
from tests.robustness.gpu_like import use_groups

BOX = clvoro.Box((0, 0), (2.5, 1.5))
CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))
TARGETS = {
    "NVIDIA": ["nvptx64-nvidia-nvcl"],
    "AMD": ["amdgcn-amd-amdhsa", "-mcpu=gfx906", "-nogpulib"],
    "SPIR": ["spir64", "-emit-llvm"],
}
MOST_STACK = 32 * 1024
"""Bytes of private memory that a work-item may take: with a GPU's 270,000 in flight that is 8 GiB."""


@pytest.fixture
def gpu_like(monkeypatch):
    monkeypatch.setattr(engine, "group_sizes", engine.group_sizes)
    use_groups(32)


@pytest.mark.parametrize(
    ("dtype", "domain", "size"),
    [
        ("float64", BOX, 0.06),
        pytest.param("float32", BOX, 0.06, marks=pytest.mark.slow),
        pytest.param("float64", CUBE, 0.2, marks=pytest.mark.slow),
        pytest.param("float32", CUBE, 0.2, marks=pytest.mark.slow),
    ],
)
def test_groups_change_nothing_but_rounding(ctx, dtype, domain, size, monkeypatch):
    """Sums are added in another order, which the linear solve sees to its tolerance of 1e-4."""

    def run():
        adapter = clvoro.Adapter(ctx, dtype)
        return adapter.run(
            domain, size, seed=5, method="coupled", max_steps=3, options=clvoro.PaperOptions(tol=0)
        )

    plain = run()
    monkeypatch.setattr(engine, "group_sizes", engine.group_sizes)
    use_groups(32)
    other = run()
    assert np.abs(plain.points - other.points).max() < 1e-3 * plain.target_size.min()
    assert abs(plain.size_error - other.size_error).max() < 1e-2


def programs_of_all_kinds(ctx, dtype, monkeypatch):
    """Every program that small work of all kinds builds: (text, options) and the name of its file."""
    programs = {}
    build = _program.build_program

    def noted(context, name, defines, prelude):
        options = tuple(f"-D{key}={value}" for key, value in sorted(defines.items()))
        programs[prelude + "\n" + _program.source_text(name), options] = name
        return build(context, name, defines, prelude)

    monkeypatch.setattr(_program, "build_program", noted)
    adapter = clvoro.Adapter(ctx, dtype)
    for name, work in oclgrind_work.WORK.items():
        if not name.startswith("broken"):
            work(adapter)
    return programs


def compile_for(target, source, out, defines):
    """What clang says of `source`."""
    done = subprocess.run(
        [
            "clang", "-x", "cl", "-cl-std=CL1.2", "-Xclang", "-finclude-default-header", "-O1", "-Wall",
            "-Wno-unused", "-target", *TARGETS[target], *defines, "-S", "-o", str(out), str(source),
        ],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0 or done.stderr
    return done.stderr


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("clang") is None, reason="needs clang")
def test_kernels_of_cpus_compile_without_a_warning(ctx, monkeypatch, tmp_path):
    """What is built in lanes of vectors, too. A warning is a line on the terminal of whoever runs them first."""
    programs = programs_of_all_kinds(ctx, "float64", monkeypatch)
    assert {"simd/hulls.cl", "simd/walks.cl", "tessellation/incremental.cl"} <= set(
        programs.values()
    )
    source, out = tmp_path / "program.cl", tmp_path / "program.s"
    for (text, defines), name in programs.items():
        source.write_text(text)
        said = compile_for("SPIR", source, out, defines)
        assert not said, f"{name}: {said[:2000]}"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("clang") is None, reason="needs clang")
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_kernels_compile_for_gpus(ctx, dtype, gpu_like, monkeypatch, tmp_path):
    """Every program that small work of all kinds builds, for three kinds of GPU, without a warning."""
    programs = programs_of_all_kinds(ctx, dtype, monkeypatch)
    names = set(programs.values())
    folder = _program.kernel_folder()
    cpu_only = {"simd/hulls.cl", "simd/walks.cl"}
    assert (
        names == {name.relative_to(folder).as_posix() for name in folder.rglob("*.cl")} - cpu_only
    )
    source, out = tmp_path / "program.cl", tmp_path / "program.s"
    for (text, defines), name in programs.items():
        source.write_text(text)
        for target in TARGETS:
            said = compile_for(target, source, out, defines)
            assert not said, f"{name} for {target}: {said[:2000]}"
            if target == "NVIDIA":
                stacks = map(int, re.findall(r"__local_depot\d+\[(\d+)\]", out.read_text()))
                assert max(stacks, default=0) <= MOST_STACK, name
