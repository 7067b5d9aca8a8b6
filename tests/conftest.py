"""What all tests share: repeatable examples, no windows, a context on the default device."""

import base64
import binascii
import gc
import os
import re
import signal
from functools import partial
from pathlib import Path

import pytest
from hypothesis import settings

from tests.grids import points_to_leave

gc.disable()  # until all tests are collected
os.environ.setdefault("MPLBACKEND", "Agg")
# Dense references are small: more threads of a BLAS library only take the cores of other tests.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# So do more threads of PoCL. The first of several processes keeps them, so that kernels run in parallel somewhere.
if os.environ.get("PYTEST_XDIST_WORKER", "gw0") != "gw0":
    os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", "1")
# PoCL links each kernel. Most of the time this reads libraries; see the script. It needs the linker that it calls.
if os.access("/usr/bin/ld", os.X_OK):
    os.environ.setdefault("COMPILER_PATH", str(Path(__file__).with_name("linker")))

# Examples are the same in every run, and the first build of a kernel may take its time.
settings.register_profile("clvoro", derandomize=True, deadline=None, database=None)
settings.load_profile("clvoro")

# Background jobs of a shell ignore Ctrl-C, and under nohup lost terminals. Tests send such signals.
for number, handler in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    if hasattr(signal, number) and signal.getsignal(getattr(signal, number)) is signal.SIG_IGN:
        signal.signal(getattr(signal, number), handler)


@pytest.fixture(scope="session", autouse=True)
def lanes_for_small_meshes():
    """Let the small meshes of tests exercise the cells in vector lanes, too."""
    from clvoro.tessellation.back_ends import LANES_FROM

    before = dict(LANES_FROM)
    LANES_FROM.update(dict.fromkeys(LANES_FROM, 0))
    yield
    LANES_FROM.update(before)


class Invokers(dict):
    """Code with which PyOpenCL sets the arguments of kernels, by the types of arguments.

    PyOpenCL reads it from a file and compiles it for each kernel object. Tests make ten thousands of them, as adapters
    of their own share none.
    """

    store_if_not_present = dict.setdefault


@pytest.fixture(scope="session", autouse=True)
def invokers_in_memory():
    from pyopencl import invoker

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(invoker, "invoker_cache", Invokers(), raising=False)
        yield


UNOPTIMIZED = re.compile(
    "-D(REAL=float|PERIODIC|POLYGON|SOLID|SPHERE|WEIGHTED|(CELL|FACE)_CAPACITY=(?!24$|32$)|GROUP_SIZE=(?!1$))"
)
"""Macros of programs that the fast tests build without optimization: all but those for boxes with walls in float64, for
single work-items and cells of the first capacities."""


@pytest.fixture(scope="session", autouse=True)
def quick_builds(request):
    """Let PoCL build many kernels of the fast tests without optimization, which takes a third of the time.

    Their bits are the same: see `test_optimization_changes_no_bit`.
    """
    from clvoro.opencl import prebuild, program

    with pytest.MonkeyPatch.context() as patch:
        fast = request.config.option.markexpr == "not slow"
        if fast and "CLVORO_TEST_OPTIMIZED" not in os.environ:
            patch.setattr(program, "compile_text", partial(compile_quickly, program.compile_text))
            patch.setattr(prebuild, "_start", lambda _: None)  # workers would optimize
        yield


def compile_quickly(plain, ctx, text, options, short=True):
    """Call `plain`, which is `compile_text` of clvoro."""
    # There are many programs with a size field. Their kernels take a few operations.
    quick = "size_at" in text or any(map(UNOPTIMIZED.match, options))
    quick = quick and ctx.devices[0].platform.name == "Portable Computing Language"
    return plain(ctx, text, (*options, "-cl-opt-disable") if quick else options, short)


@pytest.fixture(scope="session")
def ctx():
    from clvoro.opencl.devices import create_context

    return create_context()


@pytest.fixture(scope="module")
def adapter(ctx):
    import clvoro

    return clvoro.Adapter(ctx)


@pytest.fixture(scope="module")
def adapter32(ctx):
    import clvoro

    return clvoro.Adapter(ctx, "float32")


@pytest.fixture
def here(request, tmp_path, monkeypatch):
    """The present folder, in which there is only the file `HERE` of the module: a name and a text."""
    monkeypatch.chdir(tmp_path)
    name, text = request.module.HERE
    (tmp_path / name).write_text(text)
    return tmp_path


@pytest.fixture
def meshio_for_vtu():
    """The module, if it can read VTU: it wants base64 that stops at padding, as Python's did before 3.13."""
    meshio = pytest.importorskip("meshio")
    try:
        stops = base64.b64decode("QQ==QUI=") == b"A"
    except binascii.Error:
        stops = False
    return meshio if stops else pytest.skip("meshio does not read VTU by this Python's base64")


if "CLVORO_TEST_GROUPS" in os.environ:
    from tests.robustness.gpu_like import use_groups, use_ranges

    use_groups(int(os.environ["CLVORO_TEST_GROUPS"]))
    use_ranges()

if "CLVORO_TEST_DIVISION" in os.environ:
    from tests.robustness.rough_division import use_rough_division

    use_rough_division()


@pytest.hookimpl(trylast=True)
def pytest_collection_finish():
    """Let the garbage collector pass over modules and tests, a million objects that stay, and work less often."""
    gc.enable()
    gc.freeze()
    gc.set_threshold(20_000)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark before pytest selects by marks."""
    for item in points_to_leave(items):
        item.add_marker(pytest.mark.slow)
