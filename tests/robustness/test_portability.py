"""Requirements of other devices that can be tested without them: work-groups, and other compilers."""

from functools import partial

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.opencl import program as _program
from tests.robustness import gpu_programs
from tests.robustness.gpu_like import groups
from tests.robustness.gpu_programs import compile_for, static, undefined_functions
from tests.robustness.gpu_programs import for_each as each

BOX = clvoro.Box((0, 0), (2.5, 1.5))
CUBE = clvoro.Box((0, 0, 0), (1, 1, 1))
MAIN = {
    2: [
        "tessellation/cells",
        "tessellation/incremental",
        "solvers/volume_projection",
        "solvers/poisson",
        "adaptation/descent/quality_descent",
    ],
    3: [
        "tessellation/polyhedra",
        "tessellation/polyhedra_update",
        "solvers/volume_projection",
        "adaptation/descent/surface_descent",
    ],
}
"""Programs whose kernels take most of the time of a step."""
COMMON_LIMITS = 128, 512
"""Registers, and bytes of private memory, that a work-item of a kernel may take, by NVIDIA's and AMD's compilers."""
LIMITS = {
    "clip_polygons": (272, 2304),
    "clip_by_rings": (160, 768),
    "clip_marked": (224, 720),
    "measure_cells": (192, 512),
    "descend_quality": (144, 512),
    "clip_polyhedra": (224, 5760),
    "clip_polyhedra_by_teams": (192, 320),
    "update_cells": (160, 5632),
    "descend_surface": (176, 2112),
    "count_corners": (288, 4608),
    "list_corners": (288, 4608),
    "find_loops": (176, 256),
    "walk_edges": (176, 64),
    "find_own_planes": (160, 768),
    "fit_quadratics": (192, 640),
    "fit_slopes": (224, 4608),
    "order_rows": (144, 5632),
    "transfer_cell_data": (224, 6144),
}
"""The same for kernels that take more. No variant of any kernel spills registers."""
IN_BOXES = LIMITS | {"clip_polygons": (272, 1400), "clip_polyhedra": (128, 5632)}
"""Those of the programs of a first run."""
needs_clang = pytest.mark.skipif(gpu_programs.clang() is None, reason="needs clang")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "domain", "size"),
    [
        ("float32", BOX, 0.12),
        pytest.param("float64", BOX, 0.06, marks=pytest.mark.slow),
        pytest.param("float64", CUBE, 0.2, marks=pytest.mark.slow),
        pytest.param("float32", CUBE, 0.2, marks=pytest.mark.slow),
    ],
)
def test_groups_change_nothing_but_rounding(ctx, dtype, domain, size):
    """Sums are added in another order, which the linear solve sees to its tolerance of 1e-4."""

    def run():
        adapter = clvoro.Adapter(ctx, dtype)
        return adapter.run(domain, size, seed=5, method="coupled", max_steps=3, options=clvoro.PaperOptions(tol=0))

    plain = run()
    with groups(32):
        other = run()
    assert np.abs(plain.points - other.points).max() < 1e-3 * plain.target_size.min()
    assert abs(plain.size_error - other.size_error).max() < 1e-2


@pytest.mark.slow
@needs_clang
def test_kernels_of_cpus_compile_without_a_warning(ctx, tmp_path):
    """Kernels in vector lanes are included. The first user of a kernel would see its warnings."""
    sources = gpu_programs.programs_of_all_kinds(ctx, "float64", group=None)
    names = {source.name for source in sources}
    assert {*gpu_programs.CPU_ONLY, "tessellation/incremental.cl"} <= names
    for source, (_, said) in each(partial(compile_for, "SPIR", folder=tmp_path), sources):
        assert not said, f"{source.name}: {said[:2000]}"


@pytest.mark.slow
@needs_clang
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_kernels_compile_for_gpus(ctx, dtype, tmp_path):
    """Every program that small work of all kinds builds, for three kinds of GPU: no warning, all calls have a body."""
    sources = gpu_programs.programs_of_all_kinds(ctx, dtype)
    folder = _program.kernel_folder()
    every = {path.relative_to(folder).as_posix() for path in folder.rglob("*.cl")}
    assert {source.name for source in sources} == every - set(gpu_programs.CPU_ONLY)
    for target in gpu_programs.TARGETS:
        for source, (_, said) in each(partial(compile_for, target, folder=tmp_path), sources):
            assert not said, f"{source.name} for {target}: {said[:2000]}"
        for source, missing in each(partial(undefined_functions, target, folder=tmp_path), map(static, sources)):
            assert not missing, f"{source.name} for {target} calls {missing} without a body"


@needs_clang
def test_kernels_of_first_runs_compile_with_generic_pointers(ctx, tmp_path):
    """As in OpenCL 3.0, for example by PoCL 5: a pointer to private memory says so before it is passed on."""
    sources = gpu_programs.programs_of_a_first_run(ctx, 3, "float64")
    assert "tessellation/polyhedra_update.cl" in {source.name for source in sources}
    compiled = partial(compile_for, "generic", folder=tmp_path, optimize="-O0")
    for source, (_, said) in each(compiled, sources):
        assert not said, f"{source.name}: {said[:2000]}"


def test_functions_are_static_on_gpus(ctx, monkeypatch):
    """PoCL inlines all functions only if they are not static."""
    texts, plain = [], cl.Program
    monkeypatch.setattr(_program.cl, "Program", lambda ctx, text: texts.append(text) or plain(ctx, text))
    for gpu in (False, True):
        monkeypatch.setattr(_program, "needs_static_functions", lambda _, gpu=gpu: gpu)
        text = "inline int two(int i) { return 2 * i; } kernel void k(global int *a) { a[0] = two(a[1]); }"
        _program.compile_text(ctx, text, (), short=False)
        assert texts.pop().startswith(_program.STATIC_FUNCTIONS) == gpu


@pytest.mark.parametrize(("kind", "expected"), [("CPU", False), ("GPU", True), ("ACCELERATOR", True)])
def test_kinds_of_devices_with_static_functions(kind, expected):
    class Device:
        type = getattr(cl.device_type, kind)

    assert _program.needs_static_functions(Device) == expected


def test_a_function_without_a_body_is_found(tmp_path):
    text = "inline int two(int i) { return 2 * i; } kernel void k(global int *a) { a[0] = two(a[1]); }"
    source = gpu_programs.Source("k.cl", (), text)
    assert undefined_functions("NVIDIA", source, tmp_path) == ["two"]
    assert undefined_functions("NVIDIA", source._replace(text=f"static {text}"), tmp_path) == []


def check_figures(vendor, sources, folder, limits):
    """Compare what a work-item takes with the limits of its kernel."""
    for source, figures in each(partial(gpu_programs.FIGURES[vendor], folder=folder), sources):
        assert figures, source.name
        for kernel, found in figures.items():
            registers, private = limits.get(kernel, COMMON_LIMITS)
            what = f"{kernel} of {source.name} {source.options}: {found}"
            assert found.private <= private, what
            assert found.registers <= registers, what
            assert not found.spills, what


@pytest.mark.slow
@pytest.mark.skipif(not gpu_programs.can_measure("AMD"), reason="needs clang and libclc")
@pytest.mark.parametrize("dim", [2, 3])
def test_main_kernels_take_few_registers_and_little_private_memory(ctx, dim, tmp_path):
    sources = gpu_programs.programs_of_a_first_run(ctx, dim, "float64")
    by_name = {source.name: source for source in sources}
    main = [by_name[f"{name}.cl"] for name in MAIN[dim]]
    check_figures("AMD", main, tmp_path, IN_BOXES)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("vendor", ["NVIDIA", "AMD"])
def test_kernels_take_few_registers_and_little_private_memory(ctx, vendor, dtype, tmp_path):
    if not gpu_programs.can_measure(vendor):
        pytest.skip("needs clang, libclc and, for NVIDIA, ptxas: see gpu_programs.py")
    sources = gpu_programs.programs_of_all_kinds(ctx, dtype)
    check_figures(vendor, sources, tmp_path, LIMITS)


@pytest.mark.slow
@pytest.mark.skipif(not gpu_programs.can_measure("NVIDIA"), reason="needs clang, libclc and ptxas")
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_teams_by_warp_instructions(ctx, dtype, tmp_path):
    """PoCL never builds this program. Six teams fit in the least local memory of a multiprocessor, 48 kB."""
    source = gpu_programs.team_program(ctx, dtype, warps=True)
    assembly, _ = compile_for("NVIDIA", gpu_programs.static(source), tmp_path)
    assert "redux.sync" in assembly
    assert "barrier" not in assembly
    check_figures("NVIDIA", [source], tmp_path, LIMITS)
    (figures,) = gpu_programs.nvidia_figures(source, tmp_path).values()
    assert figures.local <= 7168
