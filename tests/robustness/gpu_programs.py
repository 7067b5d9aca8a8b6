"""Every program with its macros, and what the compilers of GPUs make of its kernels.

Needed are clang, the built-in functions libclc of the same version (`apt-get install clang-14 libclc-14`) and ptxas (in
the wheel nvidia-cuda-nvcc-cu12 on PyPI: `pip download --no-deps nvidia-cuda-nvcc-cu12`, unzip it, and put
nvidia/cuda_nvcc/bin on the PATH).
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import pyopencl as cl

import clvoro
from clvoro.opencl import prebuild
from clvoro.opencl import program as _program
from clvoro.opencl.engine import Engine
from clvoro.tessellation.back_ends import TEAM, team_defines
from clvoro.tessellation.cells import CELL_CAPACITY
from clvoro.tessellation.cut_cells import FACE_CAPACITY
from tests.robustness import oclgrind_work
from tests.robustness.gpu_like import groups

CPU_ONLY = ("simd/hulls.cl", "simd/walks.cl")
"""Programs for the vector units of CPUs."""
TARGETS = {
    "NVIDIA": ["-target", "nvptx64-nvidia-nvcl"],
    "AMD": ["-target", "amdgcn-amd-amdhsa", "-mcpu=gfx90a", "-nogpulib"],
    "SPIR": ["-target", "spir64", "-emit-llvm"],
    "generic": ["-target", "spir64", "-cl-std=CL2.0", "-emit-llvm", "-Wno-constant-logical-operand"],
}
CLANG = ["-x", "cl", "-cl-std=CL1.2", "-Xclang", "-finclude-default-header", "-Xclang", "-fdeclare-opencl-builtins"]
PATIENCE = 900
"""Seconds after which a compiler counts as one that hangs."""
LIBRARIES = ("/usr/lib/clc", "/usr/lib/llvm-*/share/clc", "/usr/share/clc")
"""Folders of the built-in functions in LLVM's bitcode (Debian's packages libclc-*)."""
FIRST_CAPACITIES = {
    "tessellation/cells": {"CELL_CAPACITY": CELL_CAPACITY},
    "tessellation/polyhedra": {"FACE_CAPACITY": FACE_CAPACITY},
}
Answer = TypeVar("Answer")


class Source(NamedTuple):
    """A program: its file below `cl_kernels/`, its options of the compiler, and its text with all headers."""

    name: str
    options: tuple[str, ...]
    text: str

    def macro(self, name: str) -> str:
        """Return the value of the macro `name`; nothing if it is not set."""
        begin = f"-D{name}="
        return next((o.removeprefix(begin) for o in self.options if o.startswith(begin)), "")


class Figures(NamedTuple):
    """What one work-item of a kernel takes. Bytes but for registers; `spills` are stores and loads."""

    registers: int
    spills: int
    private: int
    local: int


@contextlib.contextmanager
def noting_programs() -> Iterator[list[Source]]:
    """Collect the programs that are built inside the ``with`` block, each once."""
    found: dict[Source, None] = {}
    sources: list[Source] = []
    build = _program.build_program

    def noted(context: cl.Context, name: str, defines: Mapping[str, object], prelude: str) -> cl.Program:
        text, options = _program.program_text(name, defines, prelude)
        source = Source(name, options, text)
        if source not in found:
            found[source] = None
            sources.append(source)
        return build(context, name, defines, prelude)

    _program.build_program = noted
    try:
        yield sources
    finally:
        _program.build_program = build


def on_sphere(adapter: clvoro.Adapter) -> None:
    """Make meshes on a sphere: its kernels are variants of those of the plane."""
    for effort, method in (("default", "adaptive"), ("fast", "exact"), ("fast", "coupled"), ("fast", "transport")):
        steps = 3 if method == "coupled" else None
        adapter.run(clvoro.Sphere(1.0), 0.45, seed=5, method=method, effort=effort, max_steps=steps)


def programs_of_all_kinds(ctx: cl.Context, dtype: str, group: int | None = 128) -> list[Source]:
    """Return every program that small work of all kinds builds: for GPUs in groups of `group`, for a CPU with None.

    That of teams is among those for GPUs, without warp instructions, which only NVIDIA's compiler has.
    """
    with contextlib.ExitStack() as stack:
        if group is not None:
            stack.enter_context(groups(group))
        sources = stack.enter_context(noting_programs())
        adapter = clvoro.Adapter(ctx, dtype)
        for name, work in oclgrind_work.WORK.items():
            if not name.startswith("broken"):
                work(adapter)
        on_sphere(adapter)
    return sources if group is None else [*sources, team_program(ctx, dtype, warps=False)]


def team_program(ctx: cl.Context, dtype: str, warps: bool) -> Source:
    """Return the program that builds cells in 3D by teams, with or without warp instructions."""
    stage, engine = "tessellation/polyhedra_by_teams", Engine(ctx, cl.CommandQueue(ctx), 3, np.dtype(dtype))
    defines = engine.all_defines(stage, team_defines(warps)) | {"GROUP_SIZE": TEAM}
    text, options = _program.program_text(f"{stage}.cl", defines, "")
    return Source(f"{stage}.cl", options, text)


def programs_of_a_first_run(ctx: cl.Context, dim: int, dtype: str) -> list[Source]:
    """Return the programs of a first run in a box on a GPU, as they are recorded for a CPU. Nothing is built."""
    with groups(128):
        engine = Engine(ctx, cl.CommandQueue(ctx), dim, np.dtype(dtype))
    recorded = prebuild._record()[f"{dim}D float64"]["programs"]
    sources = []
    for stage, defines in recorded:
        if f"{stage}.cl" in CPU_ONLY:
            continue
        scalar = {"IN_LANES": "0"} if "IN_LANES" in defines else {}
        real = {
            name: dtype.replace("float64", "double").replace("float32", "float")
            for name, value in defines.items()
            if value == "double"
        }
        full = engine.all_defines(stage, defines | scalar | real | FIRST_CAPACITIES.get(stage, {}))
        text, options = _program.program_text(f"{stage}.cl", full, "")
        sources.append(Source(f"{stage}.cl", options, text))
    return sources


def compile_for(target: str, source: Source, folder: Path, *more: str, optimize: str = "-O1") -> tuple[str, str]:
    """Return the text that clang makes of `source`, and its messages."""
    stem = uuid.uuid4().hex  # two programs may be the same text, at the same time
    given, made = folder / f"{stem}.cl", folder / f"{stem}.s"
    given.write_text(source.text)
    flags = [clang() or "clang", *CLANG, optimize, "-Wall", "-Wno-unused", *TARGETS[target], *source.options, *more]
    done = subprocess.run([*flags, "-S", "-o", made, given], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0 or done.stderr
    text = made.read_text() if made.exists() else ""
    for path in (given, made):
        path.unlink(missing_ok=True)
    return text, done.stderr


def undefined_functions(target: str, source: Source, folder: Path) -> list[str]:
    """Return the functions that `source` calls, but that have no body where a compiler does not inline them.

    Without optimization all calls remain in the text. The names of OpenCL's own functions are mangled.
    """
    text, said = compile_for(target, source, folder, "-emit-llvm", optimize="-O0")
    assert text, said
    return re.findall(r"^declare [^@]*@(?!_Z|llvm\.)([\w.]+)\(", text, re.MULTILINE)


@cache
def clang() -> str | None:
    """Return the compiler: `CLANG` of the environment, else clang, else the newest version such as PoCL installs."""
    versions = [p for p in Path("/usr/bin").glob("clang-*") if p.name.removeprefix("clang-").isdigit()]
    newest = max(versions, key=lambda p: int(p.name.removeprefix("clang-")), default=None)
    return shutil.which(os.environ.get("CLANG", "clang")) or (str(newest) if newest else None)


def library(name: str) -> Path | None:
    """Return the built-in functions of OpenCL for a target, or None if they are not installed."""
    found = (
        path / name
        for pattern in (os.environ.get("LIBCLC", ""), *LIBRARIES)
        if pattern
        for path in sorted(Path("/").glob(pattern.lstrip("/")))
    )
    return next((path for path in found if path.exists()), None)


def linking(bitcode: Path) -> list[str]:
    return ["-Xclang", "-mlink-builtin-bitcode", "-Xclang", str(bitcode)]


def static(source: Source) -> Source:
    """Return `source` with static functions: those that are not inlined keep a body."""
    return source._replace(text=_program.STATIC_FUNCTIONS + source.text)


def can_measure(vendor: str) -> bool:
    """Return whether the compilers of `vendor`, "NVIDIA" or "AMD", are installed."""
    has_assembler = vendor == "AMD" or shutil.which("ptxas") is not None
    return has_assembler and clang() is not None and library(_LIBRARY[vendor]) is not None


_LIBRARY = {"NVIDIA": "nvptx64--nvidiacl.bc", "AMD": "amdgcn--amdhsa.bc"}


def nvidia_figures(source: Source, folder: Path, arch: str = "sm_90") -> dict[str, Figures]:
    """Return the figures of each kernel by ``ptxas -v``, from PTX of clang with libclc's functions."""
    triple = [
        "-target",
        "nvptx64--nvidiacl",
        "-Xclang",
        "-target-cpu",
        "-Xclang",
        "sm_80",
        "-Xclang",
        "-target-feature",
        "-Xclang",
        "+ptx70",
    ]
    bitcode = library(_LIBRARY["NVIDIA"])
    assert bitcode is not None
    ptx, said = compile_for("NVIDIA", static(source), folder, *triple, *linking(bitcode), optimize="-O3")
    assert ptx, f"{source.name}: {said[:1000]}"
    stem = folder / f"{abs(hash(ptx)):x}.ptx"
    stem.write_text(ptx)
    done = subprocess.run(
        ["ptxas", "-v", f"-arch={arch}", "-o", stem.with_suffix(".cubin"), stem],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    for path in (stem, stem.with_suffix(".cubin")):
        path.unlink(missing_ok=True)
    assert done.returncode == 0, f"{source.name}: {done.stderr[:1000]}"
    found = {}
    for name, block in re.findall(r"Compiling entry function '(\w+)'(.*?)(?=Compiling entry|\Z)", done.stderr, re.S):
        frame, stores, loads = map(
            int,
            re.findall(
                rf"Function properties for {name}\n\s*(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+)", block
            )[0],
        )
        found[name] = Figures(
            _number(r"Used (\d+) registers", block),
            stores + loads,
            max(frame, _number(r"(\d+) bytes cumulative stack", block)),
            _number(r"(\d+) bytes smem", block),
        )
    return found


def amd_figures(source: Source, folder: Path) -> dict[str, Figures]:
    """Return the figures of each kernel in clang's assembly for gfx90a; `spills` are registers, 4 bytes each."""
    bitcode = library(_LIBRARY["AMD"])
    assert bitcode is not None
    text, said = compile_for("AMD", static(source), folder, *linking(bitcode), optimize="-O3")
    assert text, f"{source.name}: {said[:1000]}"
    found = {}
    for block in text[text.index("amdhsa.kernels:") :].split("\n  - .")[1:]:
        name = re.findall(r"^    \.name:\s+(\w+)", block, re.M)[0]
        found[name] = Figures(
            _number(r"\.vgpr_count:\s+(\d+)", block),
            4 * _number(r"\.vgpr_spill_count:\s+(\d+)", block),
            _number(r"\.private_segment_fixed_size:\s+(\d+)", block),
            _number(r"\.group_segment_fixed_size:\s+(\d+)", block),
        )
    return found


FIGURES: dict[str, Callable[[Source, Path], dict[str, Figures]]] = {"NVIDIA": nvidia_figures, "AMD": amd_figures}


def for_each(function: Callable[[Source], Answer], sources: Iterable[Source]) -> list[tuple[Source, Answer]]:
    """Return each source with what `function` says of it; as many at a time as there are cores."""
    sources = list(sources)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(zip(sources, pool.map(function, sources), strict=True))


def _number(pattern: str, text: str) -> int:
    found = re.search(pattern, text)
    return int(found[1]) if found else 0
