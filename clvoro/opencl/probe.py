"""Test devices: build and run a small kernel, and check its result."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pyopencl as cl

from ..errors import DeviceError
from .program import compile_text

CONTRACT_OFF = "#pragma OPENCL FP_CONTRACT OFF"
"""Geometry relies on the rounding of each operation; see opencl/real.h."""
_PROBE = (
    CONTRACT_OFF
    + r"""
#if PROBE_FP64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double probe_real;
#else
typedef float probe_real;
#endif
/* x = 1 + small: x x - (1 + 2 small) is 0 if the product is rounded, and small^2 with fma. */
#define PROBE_ROUNDING(T, small)                                                                                       \
    static inline T product_##T(T a, T b)                                                                              \
    {                                                                                                                  \
        return a * b;                                                                                                  \
    }                                                                                                                  \
    static inline int contracts_##T(int one)                                                                           \
    {                                                                                                                  \
        const T e = (T)one * (small), x = 1 + e, c = 1 + 2 * e, d = x * x;                                             \
        return x * x - c != 0 || c - x * x != 0 || x * x + -c != 0 || d - c != 0 || product_##T(x, x) - c != 0;        \
    }                                                                                                                  \
    static inline int fma_rounds_twice_##T(int one)                                                                    \
    {                                                                                                                  \
        const T e = (T)one * (small), x = 1 + e;                                                                       \
        return fma(x, x, -(1 + 2 * e)) != e * e;                                                                       \
    }
PROBE_ROUNDING(float, 0.0001220703125f)
#if PROBE_FP64
PROBE_ROUNDING(double, 7.450580596923828125e-09)
#endif
__kernel void clvoro_probe(__global const int *in, __global int *out)
{
    int i = (int)get_global_id(0);
    probe_real x = (probe_real)in[i] / (probe_real)4;
    out[i] = (int)(sqrt(x * x) * (probe_real)12) + i;   /* 3 in[i] + i, exact in both precisions */
    if (i == 0) {
        out[0] = contracts_float(in[1]) + 2 * fma_rounds_twice_float(in[1]);
#if PROBE_FP64
        out[0] |= contracts_double(in[1]) + 2 * fma_rounds_twice_double(in[1]);
#endif
    }
}
"""
)
_PROBE_SIZE = 64
_FAULTS = {
    1: f"it contracts a * b - c to one operation despite {CONTRACT_OFF}, and geometry needs both roundings",
    2: "its fma(a, b, c) rounds the product",
}

_lock = threading.Lock()
_verdicts: dict[int, str] = {}
_process: int | None = None
"""The process that uses OpenCL."""


def check_process() -> None:
    """Raise if this process was forked from one that uses OpenCL: calls hang without its threads.

    Raises `DeviceError`.
    """
    global _process
    if _process is None:
        _process = os.getpid()
    if _process != os.getpid():
        raise DeviceError(
            "this process was forked from one that uses OpenCL, whose threads it lacks; expected a spawned process; "
            "use multiprocessing.get_context('spawn'), or fork before clvoro is used"
        )


def has_fp64(device: cl.Device) -> bool:
    """Return whether `device` computes in float64."""
    try:
        return bool(device.double_fp_config) or "cl_khr_fp64" in device.extensions.split()
    except cl.Error:  # runtimes without the extension do not know the query
        return False


def verdict(device: cl.Device, ctx: cl.Context | None = None) -> str:
    """Return the reason why `device` does not work, or an empty string. A device is tested once, in `ctx` if given."""
    key = device.int_ptr
    with _lock:
        if key not in _verdicts:
            _verdicts[key] = probe(device, ctx)
        return _verdicts[key]


def probe(device: cl.Device, ctx: cl.Context | None = None) -> str:
    """Build and run a small kernel on `device`; return the reason of a failure, or an empty string."""
    try:
        if not device.available or not device.compiler_available:
            return "the runtime says that it is not available"
        values = np.arange(_PROBE_SIZE, dtype=np.int32)
        got = np.full_like(values, -1)
        ctx = cl.Context([device]) if ctx is None else ctx
        queue = cl.CommandQueue(ctx)
        flags = cl.mem_flags
        given = cl.Buffer(ctx, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=values)
        out = cl.Buffer(ctx, flags.WRITE_ONLY | flags.COPY_HOST_PTR, hostbuf=got)
        program = compile_text(ctx, _PROBE, (f"-DPROBE_FP64={int(has_fp64(device))}",))
        program.clvoro_probe(queue, (_PROBE_SIZE,), None, given, out)
        cl.enqueue_copy(queue, got, out)
        queue.finish()
    except Exception as error:  # a broken runtime may raise anything
        return failure(error)
    if not np.array_equal(got[1:], 4 * values[1:]):
        return "it computes wrong results"
    return "; ".join(text for fault, text in _FAULTS.items() if got[0] & fault)


def failure(error: Exception) -> str:
    """Return why a device is unusable on which `error` was raised."""
    return f"it cannot build and run a kernel: {one_line(str(error) or repr(error), 300)}"


def crashing_platforms(timeout: float = 300.0) -> dict[int, str]:
    """Test all devices in a child process; return the platforms that end the process.

    For example, PoCL calls `abort` if it cannot read `/sys` or finds too little memory.

    Reasons are by the platform's index; the result is empty if no child process can be started.
    """
    crashed: dict[int, str] = {}
    search = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    while True:
        skip = [str(p) for p in crashed]
        try:
            child = subprocess.run(
                [sys.executable, "-c", "from clvoro.opencl import probe; probe.survey()", *skip],
                env={**os.environ, "PYTHONPATH": search.rstrip(os.pathsep)},
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=timeout,
            )
            code, out, last_words = child.returncode, child.stdout, child.stderr
            how = f"it ends the process ({_ending(code)})"
        except subprocess.TimeoutExpired as error:
            out = error.stdout.decode(errors="replace") if error.stdout else ""
            code, last_words, how = -1, "", f"it does not answer within {timeout:g} seconds"
        except (OSError, TypeError, ValueError):  # Python is embedded, or cannot start processes
            return crashed
        begun = [int(line) for line in out.split() if line.isdigit()]
        if code == 0 or not begun or begun[-1] in crashed:
            return crashed
        words = one_line(last_words, 200)
        crashed[begun[-1]] = f"{how}: {words}" if words else how


def survey() -> None:
    """Test all devices, except for platforms with indices in `sys.argv`; print each platform's index before."""
    from . import devices as device  # noqa: F401  prepares the runtimes

    try:
        platforms = cl.get_platforms()
    except cl.Error:
        return
    for p, platform in enumerate(platforms):
        if str(p) in sys.argv[1:]:
            continue
        print(p, flush=True)
        try:
            for each in platform.get_devices():
                probe(each)
        except cl.Error:  # the parent process reports it
            pass


def _ending(code: int) -> str:
    """Return the name of the signal that ended a child process, or its exit code."""
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"exit code {code}"


def one_line(text: str, limit: int) -> str:
    """Return a message, such as a compiler's log, as one line of at most `limit` characters."""
    folded = " ".join(text.split())
    return folded if len(folded) <= limit else folded[: limit - 3] + "..."
