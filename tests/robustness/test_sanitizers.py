"""Kernels under clang's sanitizers, and beside what a second compiler makes of them; see sanitized.py.

    python -m pytest -n 2 -m "slow or not slow" tests/robustness/test_sanitizers.py

repeats launches of every kernel, in about five minutes on two idle cores; without `slow` it only looks whether what is
wrong on purpose is found.
"""

from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

import clvoro
from clvoro.opencl import engine
from clvoro.opencl import program as _program
from tests.robustness import sanitizers as sanitized
from tests.robustness.gpu_like import use_groups
from tests.robustness.oclgrind_work import WORK

pytestmark = pytest.mark.skipif(sanitized.compiler() is None, reason="no clang with sanitizers")
USEFUL = [name for name in WORK if not name.startswith("broken")]
VARIANTS = {"float64": "float64", "float32": "float32", "work-groups": "float64"}

TRAPS = {
    "memory": {
        "branch": "int s[4]; s[n & 1] = n; if (s[a[0] + 2]) a[i] = 1;",
        "stored": "int s[4]; s[n & 1] = n; a[i] = s[a[0] + 2];",
        "vector": "int4 s; s.x = n; a[i] = any(s > 7);",
    },
    "address": {
        "beyond": "a[i + 1] = n;",
        "before": "a[i - 1] = n;",
        "private": "int s[4]; s[a[0] + n] = n; a[i] = s[n & 3];",
        "overflow": "a[i] = (INT_MAX - a[0]) + n;",
        "conversion": "a[i] = (int)(n * 1e30f);",
        "alignment": "*(global int4 *)(a + 1) = n;",
        "division": "a[i] = n / a[0];",
    },
}
KERNEL = "kernel void trap(global int *a, const int n) {{ int i = get_global_id(0); {} }}"


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """Folder of programs built with sanitizers: many pieces of work share them."""
    return tmp_path_factory.mktemp("sanitized")


@pytest.fixture(scope="module")
def harmless(ctx, tmp_path_factory):
    """A recorded launch of a correct kernel, whose source is then exchanged."""
    folder = tmp_path_factory.mktemp("trap")
    (folder / "trap.cl").write_text(KERNEL.format("a[i] = n;"))
    with pytest.MonkeyPatch.context() as patch, sanitized.Recorder(folder) as recorder:
        patch.setattr(_program, "kernel_folder", lambda: folder)
        program = _program.build_program(ctx, "trap.cl", {}, "")
        kernel = program.all_kernels()[0]
        kernel.stage = "trap"
        queue = cl.CommandQueue(ctx)
        buffer = cl.Buffer(ctx, cl.mem_flags.COPY_HOST_PTR, hostbuf=np.zeros(16, np.int32))
        kernel.set_args(buffer, np.int32(5))
        cl.enqueue_nd_range_kernel(queue, kernel, (16,), (16,))
    (found,) = recorder.programs.values()
    assert len(found.jobs) == 1
    return found


@pytest.mark.sparse(1)
@pytest.mark.parametrize("sanitizer", list(TRAPS))
def test_what_is_right_passes(harmless, built, sanitizer):
    outcomes, said = sanitized.repeat(harmless, sanitizer, built)
    assert outcomes == [sanitized.Outcome("trap.trap", 0, 0.0, 0.0, 0)]
    assert said == ""


@pytest.mark.sparse(3)
@pytest.mark.parametrize(("sanitizer", "trap"), [(s, t) for s in TRAPS for t in TRAPS[s]])
def test_what_is_wrong_is_found(harmless, built, sanitizer, trap):
    wrong = replace(harmless, text=KERNEL.format(TRAPS[sanitizer][trap]))
    outcomes, said = sanitized.repeat(wrong, sanitizer, built)
    assert said or outcomes[0].unwritten


def test_other_results_are_found(harmless, built):
    other = replace(harmless, text=KERNEL.format("a[i] = i ? n : 0;"))
    outcomes, said = sanitized.repeat(other, "address", built)
    assert (outcomes[0].differing, said) == (1, "")


FUNCTIONS = {
    "mmpde.descend_functional",
    "bins.sort_bins",
    "density.evaluate_density",
    "metric.evaluate_metric",
    "insertion_deletion.mark_split_delete",
    "volume_projection.assemble_projection",
    "quality_descent.compute_cell_forces",
    "surface_descent.compute_surface_forces",
    "size_field.evaluate_size",
    "size_field.evaluate_size_gradient",
}
"""Kernels with functions that OpenCL does not ask to be rounded correctly (as log, cbrt, cos): libraries differ."""
ROUNDINGS = 128
"""Over the largest number of an array: small size errors, and slopes, are differences of nearly equal numbers."""
NEAR_ZERO = {"metric.evaluate_metric", "cells.measure_cells", "row_order.order_rows"}
"""Kernels that write arrays that may be round-off alone: errors of roots of prescribed volumes, and on a sphere offsets
of regular cells."""
ROUNDINGS_NEAR_ZERO = 4
"""OpenCL's cube root may be wrong by 2 ulp, that of C is by 1, and the division rounds."""
IN_SINGLE = {"volume_projection.assemble_projection"}
"""Of these kernels, those that compute in single precision for generators of any precision."""
ORDERED = {
    "bins.count_root",
    "bins.count_in_child_bins",
    "boundary_crossings.count_chords",
    "own_planes.find_own_planes",
    "polyhedra.clip_polyhedra",
    "polyhedra_update.list_marked_cells",
    "polyhedra_update.update_cells",
    "walks.walk_all_cells",
}
"""Kernels whose work-items take places in the order of their execution. A later kernel sorts, or rows name places."""


@pytest.fixture
def grouped(monkeypatch):
    """Work-groups of many work-items, with barriers, as on a GPU."""
    monkeypatch.setattr(engine, "group_sizes", engine.group_sizes)
    use_groups(16, 3)


@pytest.mark.slow
@pytest.mark.parametrize("variant", list(VARIANTS))
@pytest.mark.parametrize("name", USEFUL)
def test_nothing_is_found(ctx, request, tmp_path, built, name, variant):
    if variant == "work-groups":
        request.getfixturevalue("grouped")
    with sanitized.Recorder(tmp_path) as recorder:
        WORK[name](clvoro.Adapter(ctx, VARIANTS[variant]))
    programs = [program for program in recorder.programs.values() if program.jobs]
    assert programs
    for program in programs:
        single = program.defines.get("REAL") == "float"
        for sanitizer in sanitized.SANITIZERS:
            outcomes, said = sanitized.repeat(program, sanitizer, built)
            assert said == "", said[:3000]
            assert len(outcomes) == len(program.jobs)
            for outcome in outcomes:
                assert outcome.unwritten == 0, outcome
                if outcome.kernel in ORDERED:
                    continue
                assert outcome.differing == 0, outcome
                real = np.float32 if single or outcome.kernel in IN_SINGLE else np.float64
                # On a sphere areas and arcs are angles.
                rounds = outcome.kernel in FUNCTIONS or "SPHERE" in program.defines
                allowed = ROUNDINGS * np.finfo(real).eps if rounds else 0
                if (
                    rounds
                    and outcome.kernel in NEAR_ZERO
                    and outcome.absolute <= ROUNDINGS_NEAR_ZERO * np.finfo(real).eps
                ):
                    continue
                assert outcome.difference <= allowed, outcome
