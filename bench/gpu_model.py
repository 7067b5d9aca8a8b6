"""What the kernels take of a GPU, by its compilers. No GPU is needed.

    python bench/gpu_model.py [--dtypes float64,float32] [--all]

Compiles every program that small work of all kinds builds, in all variants, with groups of 128 work-items as
on a GPU, for NVIDIA by ``ptxas -v -arch=sm_90`` (PTX of clang -O3) and for AMD by clang -O3 (gfx90a). Needed are clang,
the built-in functions libclc of the same version (`apt-get install clang-14 libclc-14`) and ptxas (in the wheel
nvidia-cuda-nvcc-cu12 on PyPI: `pip download --no-deps nvidia-cuda-nvcc-cu12`, unzip it, and put
nvidia/cuda_nvcc/bin on the PATH). Each row is the largest of a kernel's variants. "private" is the stack frame of one
work-item in bytes, "spills" the bytes of its stores and loads, "local" the bytes of a group, "warps" how many of 64
warps fit on a multiprocessor, and "resident" the private memory of all work-items that an H200 runs at a time if it
is full. Kernels above the limits `--registers` and `--private` are in the table; the last row is for all others.
"""

from __future__ import annotations

import json
import sys
import tempfile
from functools import partial
from pathlib import Path

from _common import heading, make_adapter, markdown, names, parser

from tests.robustness import gpu_programs

DTYPES = ("float64", "float32")

UNITS, WARPS, REGISTERS = 132, 64, 65536
"""Multiprocessors of an H200, and resident warps of 32 work-items and 32-bit registers of one."""


def resident_warps(registers: int, local: int = 0, group: int = 128) -> int:
    """Return the warps of a kernel that are resident on a multiprocessor, in whole groups."""
    of_group = -(-group // 32)
    # Registers are given to warps in units of 256; 228 kB are shared by the groups.
    per_warp = -(-max(registers, 1) * 32 // 256) * 256
    fitting = [REGISTERS // per_warp // of_group, WARPS // of_group]
    if local:
        fitting.append(228 * 1024 // (local + 1024))
    return min(fitting) * of_group


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
        resident = UNITS * WARPS * 32 * nvidia["private"] / 2**30
        own += [
            str(nvidia["registers"]),
            str(nvidia["spills"]),
            f"{nvidia['private']:,}",
            f"{nvidia['local']:,}",
            str(resident_warps(nvidia["registers"], nvidia["local"])),
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


def main() -> None:
    options_of = parser(__doc__)
    options_of.add_argument("--dtypes", type=names, default=list(DTYPES))
    options_of.add_argument("--all", action="store_true", help="show every kernel")
    options_of.add_argument("--registers", type=int, default=128)
    options_of.add_argument("--private", type=int, default=512, metavar="BYTES")
    options = options_of.parse_args()
    if unknown := set(options.dtypes) - set(DTYPES):
        options_of.error(f"no precision {', '.join(unknown)}; there are {', '.join(DTYPES)}")
    adapter = make_adapter(options)
    records = kernel_records(dict.fromkeys(options.dtypes, adapter))
    if options.json:
        print(*map(json.dumps, records), sep="\n")
    else:
        print(heading(adapter, f"{len(records)} kernels of all variants for GPUs") + "\n")
        print(kernel_table(largest(records), options.registers, options.private, options.all))


if __name__ == "__main__":
    main()
