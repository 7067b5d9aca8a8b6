"""Read, build and cache OpenCL programs.

A program is a file `cl_kernels/<stage>.cl`. Its `#include` lines are replaced by the text of the headers, once each,
with `#line` directives. So the driver gets the complete text, which is also the key of its cache.
"""

from __future__ import annotations

import atexit
import contextlib
import re
import threading
import time
import warnings
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future
from functools import cache
from pathlib import Path

import pyopencl as cl
from pyopencl.characterize import has_src_build_cache

from ..errors import BuildError
from .runtimes import full_cache_remedy, remove_dead_locks

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
_lock = threading.Lock()
_one_at_a_time = threading.Lock()
_programs: dict[tuple, Future[cl.Program]] = {}
_building = 0.0
_threads: list[threading.Thread] = []
_ending = threading.Event()
_silent = 0
quick: set[tuple[str, tuple[str, ...]]] = set()
"""Text and options of programs that are now built without optimization; see `prebuild`."""
_IGNORED = ("ignore", None, cl.CompilerWarning, None, 0)
NO_ABI_WARNINGS = '#pragma clang diagnostic ignored "-Wpsabi"\n'
"""Put before programs for PoCL. On a CPU without AVX-512 clang warns that other compilers pass vectors of eight doubles
in another way. That does not matter, because kernels call no code of other compilers."""
ROUNDED_QUOTIENTS = "-cl-fp32-correctly-rounded-divide-sqrt"
UNOPTIMIZED = "-cl-opt-disable"
STATIC_FUNCTIONS = "#define inline static inline\n"
"""Put before programs; see `needs_static_functions`."""
POCL = "Portable Computing Language"
"""Name of PoCL's platform."""
NVIDIA = "NVIDIA CUDA"
"""Name of NVIDIA's platform."""


def kernel_folder() -> Path:
    """Folder of the `.cl` files: inside the installed package, else beside it in a checkout."""
    package = Path(__file__).parent.parent
    inside = package / "cl_kernels"
    return inside if inside.is_dir() else package.parent / "cl_kernels"


@cache
def source_text(name: str) -> str:
    """Return the text of `cl_kernels/<name>` with every include pasted in once; files are read once."""
    return _paste(name, set())


def _paste(name: str, seen: set[str]) -> str:
    lines = [f'#line 1 "{name}"']
    for number, line in enumerate((kernel_folder() / name).read_text().splitlines(), start=1):
        match = _INCLUDE.match(line)
        if match is None:
            lines.append(line)
        elif match[1] not in seen:
            seen.add(match[1])
            lines += [_paste(match[1], seen), f'#line {number + 1} "{name}"']
        else:
            lines.append("")
    return "\n".join(lines)


def build_program(ctx: cl.Context, name: str, defines: Mapping[str, object], prelude: str) -> cl.Program:
    """Build `cl_kernels/<name>` after `prelude`; the same text on the same context is built once.

    Raises `BuildError` with the compiler's log, if the source does not compile.
    """
    try:
        return _build_once(ctx, *program_text(name, defines, prelude))
    except cl.Error as error:
        raise BuildError(f"cl_kernels/{name} does not compile: {full_cache_remedy()}{error}") from error


def _build_once(ctx: cl.Context, text: str, options: tuple[str, ...]) -> cl.Program:
    """Build a program, or wait for the thread that builds it. Whoever comes first builds it."""
    global _building
    if (text, options) in quick:
        options = (*options, UNOPTIMIZED)
    key = (ctx.int_ptr, text, options)
    began = time.perf_counter()
    with _lock:
        known = _programs.get(key)
        result = _programs[key] = Future() if known is None else known
        waits = not result.done()
    if known is None:
        try:
            with _one_at_a_time if on_pocl(ctx.devices[0]) else contextlib.nullcontext():
                result.set_result(compile_text(ctx, text, options))
        except BaseException as error:
            del _programs[key]
            result.set_exception(error)
    program = result.result()
    if waits and threading.current_thread() is threading.main_thread():
        _building += time.perf_counter() - began
    return program


def build_in_threads(ctx: cl.Context, programs: Iterable[tuple[str, tuple[str, ...]]], threads: int) -> None:
    """Begin to build `programs`, (text, options), in their order.

    `build_program` waits for a program that a thread builds, and builds others itself.
    """
    waiting = deque(programs)

    def work() -> None:
        while not _ending.is_set():
            with contextlib.suppress(cl.Error):  # `build_program` raises it again
                try:
                    text, options = waiting.popleft()
                except IndexError:
                    return
                _build_once(ctx, text, options)

    if not _threads:
        atexit.register(_end_threads)
    _threads[:] = [thread for thread in _threads if thread.is_alive()]
    for _ in range(min(threads, len(waiting))):
        _threads.append(threading.Thread(target=work, daemon=True))
        _threads[-1].start()


def _end_threads() -> None:
    """Wait for the builds that have begun: the interpreter must not end meanwhile."""
    _ending.set()
    for thread in _threads:
        thread.join()


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Ignore what compilers print. `warnings.catch_warnings` must not be used in several threads at a time."""
    global _silent
    with _lock:
        if _silent == 0:
            warnings.simplefilter("ignore", cl.CompilerWarning)
        _silent += 1
    try:
        yield
    finally:
        with _lock:
            _silent -= 1
            if _silent == 0:
                with contextlib.suppress(ValueError):
                    warnings.filters.remove(_IGNORED)  # type: ignore[attr-defined]


def program_text(name: str, defines: Mapping[str, object], prelude: str) -> tuple[str, tuple[str, ...]]:
    """Return the text of the program in `cl_kernels/<name>` after `prelude`, and its options."""
    options = tuple(f"-D{key}={value}" for key, value in sorted(defines.items()))
    return prelude + "\n" + source_text(name), options


def compile_text(ctx: cl.Context, text: str, options: tuple[str, ...], short: bool = True) -> cl.Program:
    """Build `text`; if `short`, with our declarations of built-in functions where the driver can do without its own."""
    with _silenced():
        if short and has_short_declarations(ctx):
            with contextlib.suppress(cl.Error):  # a function that they lack
                return _build(ctx, *text_for_driver(ctx, text, options))
        return _build(ctx, *text_for_driver(ctx, text, options, short=False))


def _build(ctx: cl.Context, text: str, options: tuple[str, ...]) -> cl.Program:
    program = cl.Program(ctx, text)
    if not has_src_build_cache(ctx.devices[0]):
        remove_dead_locks()
    return program.build(options=list(options))


def text_for_driver(
    ctx: cl.Context, text: str, options: tuple[str, ...], short: bool = True
) -> tuple[str, tuple[str, ...]]:
    """Return the text and the options that the driver gets, which are also the key of its cache."""
    device = ctx.devices[0]
    options = (*options, *device_options(device))
    if on_pocl(device):
        text = NO_ABI_WARNINGS + with_long_bodies_once(text)
    if needs_static_functions(device):
        text = STATIC_FUNCTIONS + text
    if short and has_short_declarations(ctx):
        text, options = f"{source_text('opencl/pocl_builtins.h')}\n{text}", (*options, "-D_OPENCL_H_")
    return text, options


_LONG_KERNEL = re.compile(
    r"^kernel void (\w+)\(([^)]*)\)\n\{\n    LONG_(ITEM\(\w+\)|GROUP);(.*?)^\}$", re.DOTALL | re.MULTILINE
)


def with_long_bodies_once(text: str) -> str:
    """Return `text` with the bodies of kernels that begin with LONG_ITEM or LONG_GROUP in functions.

    PoCL compiles a kernel three times: itself, and with its body in two launchers. Functions that it calls are compiled
    once, if they contain no barrier and do not ask for the work-item. Lines keep their numbers.
    """

    def split(found: re.Match[str]) -> str:
        name, given, kind, body = found.groups()
        given = " ".join(given.split())
        if kind == "GROUP":
            begin, first, more = "MAKE_GROUP", "group_t group", "group"
        else:
            more = kind[len("ITEM(") : -1]
            begin, first = f"WORK_ITEM({more})", f"int {more}"
        return (
            f"OUT_OF_LINE void {name}_once(const {first}, {given})\n{{\n{body}}} "
            f"kernel void {name}({given}) {{ {begin}; {name}_once({more}, {_passed(given, text)}); }}"
        )

    return _LONG_KERNEL.sub(split, text)


def _passed(given: str, text: str) -> str:
    """Return the arguments of a call with the parameters `given`. PERIOD_ARGS there are PERIODS in a call."""
    calls = []
    for part in given.split(","):
        words = re.findall(r"\w+", part)
        macros = [word.removesuffix("_ARGS") for word in words if word.endswith("_ARGS")]
        names = [f"{m}S" if f"#define {m}S" in text else m for m in macros]
        calls.append(" ".join([*words[: len(words) - len(macros)][-1:], *names]))
    return ", ".join(calls)


def device_options(device: cl.Device) -> tuple[str, ...]:
    """Return the options of all programs on `device`: float32 quotients and square roots are rounded correctly.

    Without it they may be off by 2.5 and 3 ulp. A device may lack the option. PoCL does not need it.
    """
    rounds = device.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
    return (ROUNDED_QUOTIENTS,) if rounds and not on_pocl(device) else ()


def needs_static_functions(device: cl.Device) -> bool:
    """Return whether device functions must be static on `device`: on all but CPUs.

    In C99 an inline function has no body where a call is not inlined, unless it is static. PoCL inlines all calls of
    functions that are not static. Of static ones it does not, and large cells then overflow the stack of a thread.
    """
    return bool(device.type & (cl.device_type.GPU | cl.device_type.ACCELERATOR))


def on_pocl(device: cl.Device) -> bool:
    """Return whether `device` is one of PoCL's, which builds one program at a time, whatever the number of threads."""
    return device.platform.name.strip() == POCL


def on_nvidia(device: cl.Device) -> bool:
    """Return whether NVIDIA's compiler builds programs for `device`."""
    return device.platform.name.strip() == NVIDIA


def has_short_declarations(ctx: cl.Context) -> bool:
    """Return whether the driver is a version of PoCL for which opencl/pocl_builtins.h has been tested."""
    device = ctx.devices[0]
    return on_pocl(device) and "PoCL 3." in device.platform.version


def build_seconds() -> float:
    """Return the time that this process has spent on building programs."""
    return _building
