"""Does a device work? Build and run a small kernel on it, and see what comes back."""

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

_PROBE = """
#if PROBE_FP64
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double probe_real;
#else
typedef float probe_real;
#endif
__kernel void clvoro_probe(__global const int *in, __global int *out)
{
    int i = (int)get_global_id(0);
    probe_real x = (probe_real)in[i] / (probe_real)4;
    out[i] = (int)(sqrt(x * x) * (probe_real)12) + i;   /* 3 in[i] + i, exact in both precisions */
}
"""
_PROBE_SIZE = 64

_lock = threading.Lock()
_verdicts: dict[int, str] = {}
_process: int | None = None
"""The process in which OpenCL is at work."""


def check_process() -> None:
    """Refuse a process that was forked from one where OpenCL is at work: without its threads, calls wait for ever.

    Raises
    ------
    DeviceError
    """
    global _process
    if _process is None:
        _process = os.getpid()
    if _process != os.getpid():
        raise DeviceError(
            "this process was forked from one that has used OpenCL, whose threads did not come along; start processes "
            "anew, as by multiprocessing.get_context('spawn'), or fork before anything of clvoro is used"
        )


def has_fp64(device: cl.Device) -> bool:
    """Tell whether `device` computes in float64."""
    try:
        return bool(device.double_fp_config) or "cl_khr_fp64" in device.extensions.split()
    except cl.Error:  # the query is unknown to runtimes without the extension
        return False


def verdict(device: cl.Device, ctx: cl.Context | None = None) -> str:
    """Return why `device` does not work, or an empty string; a device is tried once, in `ctx` if one is given."""
    key = device.int_ptr
    with _lock:
        if key not in _verdicts:
            _verdicts[key] = probe(device, ctx)
        return _verdicts[key]


def probe(device: cl.Device, ctx: cl.Context | None = None) -> str:
    """Build and run a small kernel on `device`; return what went wrong, or an empty string."""
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
    except Exception as error:  # whatever a broken runtime does, it is that device's verdict
        return failure(error)
    if not np.array_equal(got, 4 * values):
        return "it computes wrong results"
    return ""


def failure(error: Exception) -> str:
    """Return the reason against a device on which `error` was raised."""
    return f"it cannot build and run a kernel: {one_line(str(error) or repr(error), 300)}"


def crashing_platforms(timeout: float = 300.0) -> dict[int, str]:
    """Try all devices of all platforms in a child process; return those that end it, and how.

    Runtimes do that: PoCL, for one, calls `abort` while it lists its devices, if it is refused
    `/sys` or finds too little memory.

    Returns
    -------
    dict
        Reason by the platform's index; empty too if no child process can be started.
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
        except (OSError, TypeError, ValueError):  # Python is embedded, or may not start processes
            return crashed
        begun = [int(line) for line in out.split() if line.isdigit()]
        if code == 0 or not begun or begun[-1] in crashed:
            return crashed
        words = one_line(last_words, 200)
        crashed[begun[-1]] = f"{how}: {words}" if words else how


def survey() -> None:
    """Try all devices, print each platform's index before; leave out the indices in `sys.argv`."""
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
        except cl.Error:  # the parent meets it too, and reports it
            pass


def _ending(code: int) -> str:
    """Name the signal that ended a child process, or its exit code."""
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"exit code {code}"


def one_line(text: str, limit: int) -> str:
    """Fold a message, often a compiler's log, into one line of at most `limit` characters."""
    folded = " ".join(text.split())
    return folded if len(folded) <= limit else folded[: limit - 3] + "..."
