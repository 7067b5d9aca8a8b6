"""Kernels compiled for the host by clang with its sanitizers, and what they find.

While a piece of work runs on an OpenCL device, launches of every kernel are recorded: arguments, buffers before and
after. The same source, with OpenCL's built-in functions from `host_opencl.h`, then becomes a program of the host
(`host_main.c`) that repeats these launches under MemorySanitizer (values that depend on uninitialized private memory),
and under AddressSanitizer and UndefinedBehaviorSanitizer (accesses out of private arrays and buffers, overflow,
conversions and alignment that C leaves undefined). What it writes must be what the device has written: a second
compiler, and one work-item after the other, from the first to the last and the other way round.

Needs clang with its run-time libraries; Debian's PoCL brings both. Out of reach are global memory that nobody has
written (`test_uninitialized.py`), local memory likewise, and races (`test_oclgrind.py`).
"""

from __future__ import annotations

import collections
import functools
import hashlib
import re
import shutil
import struct
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyopencl as cl

from clvoro.opencl import kernels as _kernels
from clvoro.opencl import program as _program
from tests.robustness.oclgrind_work import buffers_of_their_own

HERE = Path(__file__).parent
PATIENCE = 900
"""Seconds after which a program that is built or repeated counts as one that hangs."""
SANITIZERS = {
    "memory": ["-fsanitize=memory", "-fsanitize-memory-track-origins", "-DMEMORY_SANITIZER"],
    "address": [
        "-fsanitize=address,undefined,float-cast-overflow,local-bounds",
        # OpenCL's types are not C's, to clang 17 and later.
        "-fno-sanitize=function",
        "-fno-sanitize-recover=all",
    ],
}
COMMON = ["-O0", "-g1", "-w", "-ffp-contract=off", "-fno-omit-frame-pointer"]
KERNEL = ["-x", "cl", "-cl-std=CL1.2", "-Xclang", "-cl-ext=+all", "-fgnu89-inline", "-include", "opencl-c-base.h"]


@functools.cache
def compiler() -> str | None:
    """Return a clang that can build with sanitizers, or None."""
    for name in ("clang", *(f"clang-{k}" for k in range(22, 13, -1))):
        path = shutil.which(name)
        if path is None:
            continue
        tried = [path, *SANITIZERS["memory"], "-x", "c", "-o", "/dev/null", "-"]
        done = subprocess.run(tried, input=b"int main(void) { return 0; }", capture_output=True)
        if done.returncode == 0:
            return path
    return None


@dataclass
class Program:
    """An OpenCL program as the device got it, with the kernels of which launches were recorded."""

    text: str
    defines: dict[str, object]
    signatures: dict[str, list[tuple[str, str]]]
    jobs: list[Path] = field(default_factory=list)


class Recorder:
    """While it is entered, writes launches into `folder`: the first of each kernel, and ever fewer later ones."""

    def __init__(self, folder: Path, most: int = 8) -> None:
        self.folder, self.most = folder, most
        self.programs: dict[int, Program] = {}
        self.launches: collections.Counter[tuple[int, str]] = collections.Counter()
        self.taken: collections.Counter[tuple[int, str]] = collections.Counter()
        self._plain = (_kernels.set_changed, cl.enqueue_nd_range_kernel, cl.Kernel.set_args)
        self._build = _program.build_program
        self._share = lambda: None

    def __enter__(self) -> Recorder:
        def noted(args):
            return [getattr(a, "base_data", np.int32(a) if type(a) is int else a) for a in args]

        def noted_changed(kernel, args, changed):
            kernel.noted = noted(args)
            self._plain[0](kernel, args, changed)

        def noted_args(kernel, *args):
            kernel.noted = noted(args)
            self._plain[2](kernel, *args)

        def noted_build(ctx, name, defines, prelude):
            program = self._build(ctx, name, defines, prelude)
            if program.int_ptr not in self.programs:
                text = prelude + "\n" + _program.source_text(name)
                self.programs[program.int_ptr] = Program(text, dict(defines), signatures(ctx, text, defines))
            return program

        _kernels.set_changed, cl.Kernel.set_args = noted_changed, noted_args
        cl.enqueue_nd_range_kernel = self._enqueue
        _program.build_program = noted_build
        self._share = buffers_of_their_own()
        return self

    def __exit__(self, *_: object) -> None:
        _kernels.set_changed, cl.enqueue_nd_range_kernel, cl.Kernel.set_args = self._plain
        _program.build_program = self._build
        self._share()

    def _enqueue(self, queue, kernel, size, group, *rest, **more):
        number = kernel.get_info(cl.kernel_info.PROGRAM).int_ptr
        program = self.programs.get(number)
        if program is None:  # PyOpenCL's own
            return self._plain[1](queue, kernel, size, group, *rest, **more)
        name = kernel.function_name
        which = (number, name)
        self.launches[which] += 1
        # Launches 1, 2, 4, ...: late launches of a run have other input than early ones.
        count, taken = self.launches[which], self.taken[which]
        if taken >= self.most or count < 2**taken:
            return self._plain[1](queue, kernel, size, group, *rest, **more)
        self.taken[which] += 1
        buffers = list({a.int_ptr: a for a in kernel.noted if isinstance(a, cl.MemoryObject)}.values())
        before = [fetch(queue, each) for each in buffers]
        event = self._plain[1](queue, kernel, size, group, *rest, **more)
        after = [fetch(queue, each) for each in buffers]
        path = self.folder / f"{kernel.stage}.{name}.{which[0]:x}.{count}"
        at_once = group[0] > 1 and "barrier(" in program.text
        write_job(path, kernel, program.signatures[name], at_once, size[0], group[0], buffers, before, after)
        program.jobs.append(path)
        return event


def fetch(queue: cl.CommandQueue, buffer: cl.Buffer) -> bytes:
    host = np.empty(buffer.size, np.uint8)
    cl.enqueue_copy(queue, host, buffer)
    return host.tobytes()


def signatures(ctx: cl.Context, text: str, defines) -> dict[str, list[tuple[str, str]]]:
    """Return the address space and the type of every argument of every kernel."""
    options = [f"-D{key}={value}" for key, value in sorted(defines.items())]
    # A program from PyOpenCL's cache is a binary, in which some runtimes do not know of arguments.
    program = cl.Program(ctx, text).build([*options, "-cl-kernel-arg-info"], cache_dir=False)
    info, spaces = cl.kernel_arg_info, cl.kernel_arg_address_qualifier
    names = {spaces.GLOBAL: "global", spaces.CONSTANT: "constant", spaces.LOCAL: "local", spaces.PRIVATE: "private"}
    return {
        kernel.function_name: [
            (names[kernel.get_arg_info(k, info.ADDRESS_QUALIFIER)], kernel.get_arg_info(k, info.TYPE_NAME))
            for k in range(kernel.num_args)
        ]
        for kernel in program.all_kernels()
    }


def write_job(path, kernel, signature, at_once, size, group, buffers, before, after) -> None:
    """Write a launch for `host_main.c`.

    The name; whether items of a group run at once; group size; groups; buffers (bytes of a real number or 0, size,
    content); arguments (a buffer's number, or minus the size and the value); buffers afterwards.
    """
    types = {
        a.int_ptr: type_.replace(" ", "")
        for a, (_, type_) in zip(kernel.noted, signature, strict=True)
        if isinstance(a, cl.MemoryObject)
    }
    int_ = struct.Struct("<q").pack
    name = kernel.function_name.encode()
    parts = [int_(len(name)), name, b"\0"]
    parts += map(int_, (at_once, group, size // group, len(buffers)))
    for buffer, content in zip(buffers, before, strict=True):
        kind = re.fullmatch(r"(double|float)\d*\*", types[buffer.int_ptr])
        real = {"double": 8, "float": 4}[kind[1]] if kind else 0
        parts += [int_(real), int_(len(content)), content]
    place = {each.int_ptr: k for k, each in enumerate(buffers)}
    parts.append(int_(len(kernel.noted)))
    for a in kernel.noted:
        if isinstance(a, cl.MemoryObject):
            parts.append(int_(place[a.int_ptr]))
        else:
            parts += [int_(-len(value := np.asarray(a).tobytes())), value]
    path.write_bytes(b"".join(parts + after))


def translation(program: Program) -> tuple[str, str]:
    """Return the kernels' source for clang, and in C the table of the functions that launch them.

    There is one per kernel, which takes the arguments from a row of words.
    """
    parts = [f'#include "{HERE / "host_opencl.h"}"', program.text, '#line 1 "launch"']
    for name, args in program.signatures.items():
        taken = [
            f"*(private {type_} *)args[{k}]" if space == "private" else f"({space} {type_})args[{k}]"
            for k, (space, type_) in enumerate(args)
        ]
        parts.append(f"void launch_{name}(private ulong *args) {{ {name}({', '.join(taken)}); }}")
    names = list(program.signatures)
    table = ["#include <stdint.h>", "typedef struct { const char *name; void (*launch)(uint64_t *); } kernel_t;"]
    table += [f"void launch_{name}(uint64_t *);" for name in names]
    rows = "".join(f'{{"{name}", launch_{name}}}, ' for name in names)
    table.append(f"const kernel_t kernels[] = {{{rows}{{0, 0}}}};")
    return "\n".join(parts) + "\n", "\n".join(table) + "\n"


def build(program: Program, sanitizer: str, folder: Path) -> Path:
    """Compile and link the kernels of `program` with what repeats their launches."""
    source, table = translation(program)
    defines = [f"-D{key}={value}" for key, value in sorted(program.defines.items())]
    flags = [*COMMON, *SANITIZERS[sanitizer]]
    parts = (source, (HERE / "host_opencl.h").read_text(), table, *defines, *flags)
    name = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
    out = folder / f"{sanitizer}-{name}"
    if out.exists():
        return out
    kernels = out.with_suffix(".kernels.o")
    call([compiler(), *flags, *KERNEL, *defines, "-c", "-o", kernels, "-"], source)
    main = folder / f"{sanitizer}-main.o"
    if not main.exists():
        call([compiler(), *flags, "-c", "-o", main, HERE / "host_main.c"])
    objects = ["-x", "c", "-", "-x", "none", main, kernels, "-lm", "-lpthread"]
    call([compiler(), *flags, "-o", out, *objects], table)
    return out


def call(command, text: str = "") -> None:
    done = subprocess.run(command, input=text, text=True, capture_output=True, timeout=PATIENCE)
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, command))}\n{done.stderr[:4000]}")


@dataclass(frozen=True)
class Outcome:
    """How the repetition of one launch ended.

    Bytes of integers that differ from the device's, largest difference of real numbers over the largest of their
    buffer and this difference itself, and bytes written that depend on uninitialized memory.
    """

    kernel: str
    differing: int
    difference: float
    absolute: float
    unwritten: int


def repeat(program: Program, sanitizer: str, folder: Path) -> tuple[list[Outcome], str]:
    """Repeat the launches of `program`; return their outcomes, and what the sanitizer says."""
    if not program.jobs:
        return [], ""
    command = [build(program, sanitizer, folder), *program.jobs]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=PATIENCE)
    outcomes = []
    for line in done.stdout.splitlines():
        path, differing, difference, absolute, unwritten = line.rsplit(" ", 4)
        kernel = ".".join(Path(path).name.split(".")[:2])
        outcomes.append(Outcome(kernel, int(differing), float(difference), float(absolute), int(unwritten)))
    said = done.stderr.strip()
    if done.returncode and not said:
        said = f"ended with {done.returncode}"
    return outcomes, said
