"""What the kernels take of a GPU, by its compilers, and a model of a step on an H200. No GPU is needed.

    python bench/gpu_model.py [--parts kernels,steps,path] [--dtypes float64,float32] [--all] [--sizes 1e6,1e7]

"kernels" compiles every program that small work of all kinds builds, in all variants, with groups of 128 work-items as
on a GPU, for NVIDIA by ``ptxas -v -arch=sm_90`` (PTX of clang -O3) and for AMD by clang -O3 (gfx90a). Needed are clang,
the built-in functions libclc of the same version (`apt-get install clang-14 libclc-14`) and ptxas (in the wheel
nvidia-cuda-nvcc-cu12 on PyPI: `pip download --no-deps nvidia-cuda-nvcc-cu12`, unzip it, and put
nvidia/cuda_nvcc/bin on the PATH). Each row is the largest of a kernel's variants. "private" is the stack frame of one
work-item in bytes, "spills" the bytes of its stores and loads, "local" the bytes of a group, "warps" how many of 64
warps fit on a multiprocessor, and "resident" the private memory of all work-items that an H200 runs at a time if it
is full. Kernels above the limits `--registers` and `--private` are in the table; the last row is for all others.

"steps" models the time of a step, and of a new diagram of random points, on an H200 from launches, which are counted on
this device in the groups that a GPU takes (`--measured-at` cells), and from the instructions and bytes that each kernel
executes, which Oclgrind has counted (`gpu_counts.json`; `--count 2,3` writes it where Oclgrind is installed: see
CONTRIBUTING.md). In 3D teams build and update cells, as on NVIDIA's GPUs. A kernel takes the largest of five times:
"instructions" and "real" (those in float64) at the device's rates, with the share of lanes that work; "access", its
reads and writes at a quarter of the coalesced rate; "memory", bytes that miss the caches at 70 % of the bandwidth, or
all at that of the level-2 cache; and "depth", one work-item on its own. Few resident warps reduce the rates. The host
takes 40 us for each launch, and 57 us for each copy, fill and blocking read, as measured; it works beside the device,
so that a part takes the larger of both. The constants of this file are the assumptions. The model does not know how
accesses of neighboring work-items coalesce, what the caches hold, how far lanes diverge, and what NVIDIA's own compiler
for OpenCL does.

"path" takes the processor time of steps and diagrams on a CPU as it works, and on the path that GPUs take (scalar
kernels, groups of 32 to 256 work-items, scans and sums by groups), by turns; medians of three.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import _gpu_steps as gpu_steps
from _common import counts, heading, make_adapter, markdown, names, parser

from tests.robustness import gpu_programs
from tests.robustness.gpu_like import groups

DTYPES = ("float64", "float32")
GROUPS = (32, 64, 128, 256)
"""Work-items of a group with which the path of GPUs runs on this device."""


class Device(NamedTuple):
    """An NVIDIA GPU, and what the model assumes of it.

    Attributes
    ----------
    name : str
    units : int
        Multiprocessors.
    warps, registers : int
        Largest number of resident warps of 32 work-items, and 32-bit registers, of one.
    clock : float
        Cycles per second.
    bandwidth, cached : float
        Bytes per second of memory that kernels reach, and of the level-2 cache.
    flops : float
        Operations in float64 per second; a multiply-add is two.
    first_cache, second_cache : float
        Bytes of the caches, the first of each multiprocessor.
    """

    name: str
    units: int
    warps: int
    registers: int
    clock: float
    bandwidth: float
    cached: float
    flops: float
    first_cache: float
    second_cache: float

    def resident_warps(self, registers: int, local: int = 0, group: int = 128) -> int:
        """Return the warps of a kernel that are resident on a multiprocessor, in whole groups."""
        of_group = -(-group // 32)
        # Registers are given to warps in units of 256; 228 kB are shared by the groups.
        per_warp = -(-max(registers, 1) * 32 // 256) * 256
        fitting = [self.registers // per_warp // of_group, self.warps // of_group]
        if local:
            fitting.append(228 * 1024 // (local + 1024))
        return min(fitting) * of_group


H200 = Device(
    "H200",
    units=132,
    warps=64,
    registers=65536,
    clock=1.98e9,
    bandwidth=0.7 * 4.8e12,
    cached=5.5e12,
    flops=34e12,
    first_cache=192e3,
    second_cache=50e6,
)
LAUNCH, MOVE = 40e-6, 57e-6
"""Seconds of the host for a launch, with its arguments and the Python around it, and for a copy, fill or read.

Measured in the run of a million cells on an H200 (see "On a GPU" in RESULTS.md): 1.75 s for 43,172 launches, 0.53 s for
9,250 copies, reads and fills."""
SCATTERED = 8
"""Bytes that an access of one byte of private memory moves where work-items access different indices, as when they walk
along links: NVIDIA interleaves private memory by words of 4 bytes, and moves sectors of 32."""
WALKING = "clip_polygons", "clip_polyhedra", "clip_marked", "update_cells"
"""Kernels that do."""
ALU_WARPS, MEMORY_WARPS = 16, 32
"""Resident warps from which on arithmetic, and reads of memory, hide their latencies."""
WORKING, WORKING_IN_CLIPS, WORKING_IN_TEAMS = 0.7, 0.1, 0.33
"""Share of the lanes of a warp that work: in clips loops of neighboring cells differ in length, and in teams members
wait for others. With these shares the model took as long as was measured for a diagram of 10^7 random cells in 2D and
for the clip of 10^6 by teams in 3D, whose kernel has changed since."""
LANES_PER_CYCLE = 8
"""Accesses of memory per cycle of a multiprocessor: 32 if all were coalesced."""
CYCLES, CYCLES_OF_ACCESS = 6, 100
"""Cycles between dependent instructions, and of an access, of one work-item on its own."""
ASSUMED_REGISTERS = 128
"""Of a kernel that ptxas does not measure."""


def kernel_records(adapter_of: dict[str, object]) -> list[dict[str, object]]:
    """Return the figures of every kernel of every program, variant and precision, one record each."""
    records = []
    for dtype, adapter in adapter_of.items():
        sources = gpu_programs.programs_of_all_kinds(adapter.ctx, dtype)  # type: ignore[attr-defined]
        print(f"{len(sources)} programs in {dtype}", file=sys.stderr, flush=True)
        with tempfile.TemporaryDirectory() as folder:
            by_vendor = {
                vendor: gpu_programs.for_each(partial(figures, folder=Path(folder)), sources)
                for vendor, figures in gpu_programs.FIGURES.items()
                if gpu_programs.can_measure(vendor)
            }
        if not by_vendor:
            raise SystemExit("neither clang, libclc and ptxas nor clang and libclc are installed; see --help")
        for i, source in enumerate(sources):
            found = {vendor: answers[i][1] for vendor, answers in by_vendor.items()}
            for kernel in next(iter(found.values())):
                records.append(
                    {
                        "file": source.name.removesuffix(".cl"),
                        "kernel": kernel,
                        "dim": source.macro("DIM") or "-",
                        "dtype": dtype,
                        "options": source.options,
                        **{vendor: each[kernel]._asdict() for vendor, each in found.items()},
                    }
                )
    return records


def largest(records: list[dict]) -> list[dict]:
    """Return one record for each kernel, dimension and precision: the largest figures of its variants."""
    rows: dict[tuple, dict] = {}
    for r in records:
        row = rows.setdefault((r["file"], r["kernel"], r["dim"], r["dtype"]), {**r, "variants": 0})
        row["variants"] += 1
        for vendor in gpu_programs.FIGURES:
            if vendor in r:
                row[vendor] = {k: max(v, row[vendor][k]) for k, v in r[vendor].items()}
    return list(rows.values())


def _row(r: dict) -> list[str]:
    own = [r["file"].rpartition("/")[2] + "." + r["kernel"], r["dim"], r["dtype"][5:], str(r["variants"])]
    nvidia, amd = r.get("NVIDIA"), r.get("AMD")
    if nvidia:
        resident = H200.units * H200.warps * 32 * nvidia["private"] / 2**30
        own += [
            str(nvidia["registers"]),
            str(nvidia["spills"]),
            f"{nvidia['private']:,}",
            f"{nvidia['local']:,}",
            str(H200.resident_warps(nvidia["registers"], nvidia["local"])),
            f"{resident:.2f} GiB",
        ]
    else:
        own += ["-"] * 6
    return own + ([str(amd["registers"]), str(amd["spills"]), f"{amd['private']:,}"] if amd else ["-"] * 3)


def kernel_table(rows: list[dict], registers: int, private: int, everything: bool) -> str:
    """Return the table of kernels above the limits, with one row for the others."""

    def is_large(r: dict) -> bool:
        figures = [r[v] for v in gpu_programs.FIGURES if v in r]
        return any(f["registers"] > registers or f["private"] > private or f["spills"] for f in figures)

    shown = [r for r in rows if everything or is_large(r)]
    rest = [r for r in rows if not (everything or is_large(r))]
    vendors = [v for v in gpu_programs.FIGURES if all(v in r for r in rows)]
    size = lambda r: tuple(-r[v][k] for v in vendors for k in ("private", "registers"))  # noqa: E731
    lines = [_row(r) for r in sorted(shown, key=size)]
    if rest:
        most = {v: {k: max(r[v][k] for r in rest) for k in rest[0][v]} for v in vendors}
        name = f"the other {len({(r['file'], r['kernel']) for r in rest})} kernels, largest"
        total = sum(r["variants"] for r in rest)
        lines.append(_row({"file": "", "kernel": name, "dim": "", "dtype": " " * 5, "variants": total, **most}))
        lines[-1][0] = name
    header = [
        "kernel",
        "dim",
        "bits",
        "variants",
        "registers",
        "spills",
        "private",
        "local",
        "warps",
        "resident",
        "VGPRs",
        "AMD spills",
        "AMD private",
    ]
    return markdown(header, lines)


class Term(NamedTuple):
    """The modeled seconds of all launches of a kernel in a step, by what limits them; `total` is the largest."""

    kernel: str
    calls: float
    instructions: float
    real: float
    access: float
    memory: float
    depth: float

    @property
    def total(self) -> float:
        """Seconds by the model."""
        return max(self[2:])

    @property
    def limit(self) -> str:
        """Name of the largest term."""
        return max(self._fields[2:], key=lambda name: getattr(self, name))


def work_of(pair: list[dict[str, Any]], kernel: str, items: float, n: float, calls: float) -> dict[str, float] | None:
    """Return the work of one of `calls` over `items` work-items for `n` cells, from that counted at two sizes."""
    few, many = (each["kernels"][kernel] for each in pair)
    names_of = [name for name in many if name not in ("launches", "items")]
    if kernel.startswith("update_cells"):
        # Launches have room for more cells than are updated again: the work of all launches is that of the cells.
        return {k: many[k] / pair[1]["cells"] * n / calls for k in names_of}
    (_, f), (j, g) = ((w["items"] / w["launches"], {k: w[k] / w["launches"] for k in names_of}) for w in (few, many))
    if not is_fixed(pair, kernel):
        return {k: g[k] / j * items for k in names_of}
    # Each work-item has a fixed share, and its part of the cells.
    slopes = {k: max(g[k] - f[k], 0) / (pair[1]["cells"] - pair[0]["cells"]) for k in names_of}
    rest = {k: max(g[k] - slopes[k] * pair[1]["cells"], 0) for k in names_of}
    return {k: rest[k] * items / j + slopes[k] * n for k in names_of}


def is_fixed(pair: list[dict[str, Any]], kernel: str) -> bool:
    """Return whether `kernel` has as many work-items for any number of cells: it works in blocks, or in one group."""
    sizes = [w["items"] / w["launches"] for w in (each["kernels"][kernel] for each in pair)]
    return sizes[0] == sizes[1] and sizes[0] in (gpu_steps.COUNTED_ITEMS, gpu_steps.COUNTED_GROUP, 1)


def term(
    device: Device,
    kernel: str,
    launches: gpu_steps.Launches,
    work: dict[str, float],
    figures: gpu_programs.Figures | None,
    items: float,
    bound: float,
) -> Term:
    """Return the time of the launches of a kernel; `bound` are the bytes of all buffers of one launch."""
    registers = figures.registers if figures else ASSUMED_REGISTERS
    private = figures.private if figures else 0
    units = min(device.units, max(items / launches.group, 1))
    warps = min(
        device.resident_warps(registers, figures.local if figures else 0, launches.group), max(items / 32 / units, 1)
    )
    working = WORKING_IN_CLIPS if kernel.startswith("clip_") else WORKING
    if kernel.endswith("_by_teams"):
        working = WORKING_IN_TEAMS
    rate = units * device.clock * min(1, warps / ALU_WARPS) * min(working, launches.group / 32)
    touched = min(private, work["stored_private_bytes"] / items) * warps * 32
    scattered = SCATTERED if kernel in WALKING else 1
    missed = max(0, 1 - device.first_cache / touched) if touched else 0
    missed_again = max(0, 1 - device.second_cache / (touched * units)) if touched else 0
    spilled = work["private_bytes"] * missed * scattered
    loaded = work["global_bytes"]
    moved = (min(loaded, bound) if bound else loaded) + spilled * missed_again
    share = min(1, warps / MEMORY_WARPS) * min(1, 2 * units / device.units)
    return Term(
        kernel,
        launches.calls,
        *(
            launches.calls * seconds
            for seconds in (
                work["instructions"] / (128 * rate),
                work["real"] / (rate / device.clock * device.flops / 2 / device.units),
                work["accesses"] / (LANES_PER_CYCLE * units * device.clock),
                max(moved / (device.bandwidth * share), (loaded + spilled) / (device.cached * share)),
                (CYCLES * work["instructions"] + CYCLES_OF_ACCESS * work["accesses"]) / items / device.clock,
            )
        ),
    )


def modeled(
    found: gpu_steps.Commands, pair: list[dict[str, Any]], figures: dict[str, gpu_programs.Figures], n: float
) -> tuple[list[Term], list[str]]:
    """Return the times of the kernels of a step of `n` cells on an H200, and kernels that were not counted."""
    terms, missing = [], []
    for kernel, launches in found.launches.items():
        per_launch = launches.items / launches.calls
        if not all(kernel in each["kernels"] for each in pair):
            missing.append(kernel)
            continue
        items = per_launch if is_fixed(pair, kernel) else per_launch * n / found.cells
        work = work_of(pair, kernel, items, n, launches.calls)
        bound = launches.bytes / launches.calls * n / found.cells
        terms.append(term(H200, kernel, launches, work, figures.get(kernel), items, bound))
    return sorted(terms, key=lambda t: -t.total), missing


def step_records(adapter: Any, sizes: list[int], measured_at: dict[int, int]) -> list[dict[str, Any]]:
    """Return the modeled time of each kind of step and of a new diagram, in 2D and 3D."""
    counted = gpu_steps.load_counts()
    records = []
    for name, parts in counted.items():
        dim, kind = int(name[0]), name[3:]
        with gpu_steps.gpu_groups(), gpu_programs.noting_programs() as sources:
            run = gpu_steps.Run(adapter, dim, kind, measured_at[dim])
            commands = {part: gpu_steps.commands(run, part) for part in run.parts}
        if dim == 3:
            commands = {part: gpu_steps.with_teams(found) for part, found in commands.items()}
            sources += gpu_programs.team_programs(adapter.ctx, "float64", warps=True)
        print(f"{kind} step in {dim}D: {run.n} cells", file=sys.stderr, flush=True)
        figures: dict[str, gpu_programs.Figures] = {}
        if gpu_programs.can_measure("NVIDIA"):
            with tempfile.TemporaryDirectory() as folder:
                measure = partial(gpu_programs.nvidia_figures, folder=Path(folder))
                for _, answer in gpu_programs.for_each(measure, sources):
                    figures |= answer
        for part, found in commands.items():
            if part == "diagram" and kind != "weighted":
                continue
            for n in sizes:
                terms, missing = modeled(found, parts[part], figures, n)
                device = sum(t.total for t in terms)
                moves = found.copies + found.reads
                host = LAUNCH * (found.count - found.copies) + MOVE * moves
                total = max(device, host)
                records.append(
                    {
                        "dim": dim,
                        "part": kind if part == "step" else "new diagram",
                        "cells": n,
                        "seconds": total,
                        "device": device,
                        "host": host,
                        "launches": found.count,
                        "reads": found.reads,
                        "rate": n / total,
                        "missing": missing,
                        "kernels": [{**t._asdict(), "total": t.total, "limit": t.limit} for t in terms],
                    }
                )
    return records


def path_records(adapter: Any, measured_at: dict[int, int], repeat: int = 3) -> list[dict[str, Any]]:
    """Return the processor time of steps and new diagrams on a CPU, as it works and in a GPU's groups, by turns."""
    records = []
    for dim, kind in gpu_steps.COUNTED:
        runs, n = {}, measured_at[dim]
        runs["own"] = gpu_steps.Run(adapter, dim, kind, n)
        for size in GROUPS:
            with groups(size):
                runs[size] = gpu_steps.Run(adapter, dim, kind, n)
        for part in runs["own"].parts:
            if part == "diagram" and kind != "weighted":
                continue
            seconds: dict[Any, list[float]] = {name: [] for name in runs}
            for _ in range(repeat):
                for name, run in runs.items():
                    queue = run.mesh.engine.queue
                    queue.finish()
                    start = time.process_time()
                    run.parts[part]()
                    queue.finish()
                    seconds[name].append(time.process_time() - start)
            records.append(
                {
                    "dim": dim,
                    "part": kind if part == "step" else "new diagram",
                    "cells": runs["own"].n,
                    **{str(name): statistics.median(each) for name, each in seconds.items()},
                }
            )
    return records


def step_tables(records: list[dict[str, Any]]) -> str:
    """Return the table of times, and that of the longest kernels at the largest size."""
    rows = [
        [
            f"{r['part']}, {r['dim']}D",
            f"{r['cells']:.0e}".replace("+0", ""),
            f"{r['launches']:.0f}",
            f"{r['reads']:.0f}",
            f"{1e3 * r['device']:.2f}",
            f"{1e3 * r['host']:.2f}",
            f"{1e-6 * r['rate']:.0f}",
        ]
        for r in records
    ]
    text = markdown(["part", "cells", "launches", "reads", "kernels, ms", "host, ms", "M cells/s"], rows)
    largest_n = max(r["cells"] for r in records)
    lines = []
    for r in records:
        if r["cells"] == largest_n:
            for k in r["kernels"][:4]:
                share = k["total"] / r["device"]
                lines.append(
                    [
                        f"{r['part']}, {r['dim']}D",
                        k["kernel"],
                        f"{k['calls']:.0f}",
                        f"{1e3 * k['total']:.2f}",
                        f"{share:.0%}",
                        k["limit"],
                        *(f"{1e3 * k[name]:.2f}" for name in Term._fields[2:]),
                    ]
                )
    header = ["part", "kernel", "calls", "ms", "share", "limit", *Term._fields[2:]]
    missing = sorted({kernel for r in records for kernel in r["missing"]})
    note = f"\n\nNot counted: {', '.join(missing)}." if missing else ""
    return f"{text}\n\n{markdown(header, lines)}{note}"


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--parts", type=names, default=["kernels", "steps"], help="kernels, steps")
    options_of.add_argument("--dtypes", type=names, default=list(DTYPES))
    options_of.add_argument("--all", action="store_true", help="show every kernel")
    options_of.add_argument("--registers", type=int, default=128)
    options_of.add_argument("--private", type=int, default=512, metavar="BYTES")
    options_of.add_argument("--sizes", type=counts, default=[10**6, 10**7], help="of the model")
    options_of.add_argument(
        "--measured-at",
        type=counts,
        default=[10**5, 3 * 10**4],
        metavar="N,N",
        help="cells of the meshes whose launches are counted, in 2D and 3D",
    )
    options_of.add_argument(
        "--count", type=counts, metavar="DIMS", help=f"write {gpu_steps.COUNTS.name}, by Oclgrind: 2,3"
    )
    options_of.add_argument("--count-one", type=names, help=argparse.SUPPRESS)
    options = options_of.parse_args()
    if options.count_one:
        dim, kind, n = options.count_one
        gpu_steps.count_in_this_process(int(dim), kind, int(n))
        return
    if options.count:
        gpu_steps.save_counts(options.count)
        return
    if unknown := set(options.dtypes) - set(DTYPES):
        options_of.error(f"no precision {', '.join(unknown)}; there are {', '.join(DTYPES)}")
    adapter = make_adapter(options)
    if "kernels" in options.parts:
        records = kernel_records(dict.fromkeys(options.dtypes, adapter))
        if options.json:
            print(*map(json.dumps, records), sep="\n")
        else:
            rows = largest(records)
            print(heading(adapter, f"{len(records)} kernels of all variants for GPUs") + "\n")
            print(kernel_table(rows, options.registers, options.private, options.all))

    at = dict(zip((2, 3), options.measured_at, strict=True))
    if "path" in options.parts:
        records = path_records(adapter, at)
        if options.json:
            print(*map(json.dumps, records), sep="\n")
        else:
            print(
                "\n"
                + heading(adapter, "Milliseconds of processor time as a CPU works, and in the groups of a GPU")
                + "\n"
            )
            columns = ["own", *map(str, GROUPS)]
            lines = [
                [f"{r['part']}, {r['dim']}D", f"{r['cells']:,}", *(f"{1e3 * r[c]:.0f}" for c in columns)]
                for r in records
            ]
            print(markdown(["part", "cells", "own groups", *(f"{g} items" for g in GROUPS)], lines))
    if "steps" in options.parts:
        records = step_records(adapter, options.sizes, at)
        if options.json:
            print(*map(json.dumps, records), sep="\n")
        else:
            print("\n" + heading(adapter, "Model of an H200; launches counted on this device") + "\n")
            print(step_tables(records))


if __name__ == "__main__":
    main()
