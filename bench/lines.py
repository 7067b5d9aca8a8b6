"""Lines and modules of each package, of kernels, tests and scripts, now and at other states of the repository.

python bench/lines.py [REVISION ...] [--json]
"""

from __future__ import annotations

import argparse
import collections
import subprocess
from pathlib import Path

from _common import Report

HOUSE = Path(__file__).parent.parent
PARTS = {"clvoro": (".py",), "cl_kernels": (".cl", ".h"), "tests": (".py",), "bench": (".py",)}


def counts(revision: str | None) -> dict[str, tuple[int, int]]:
    """Return lines and files of each part, of what git tracks, or of a revision."""
    found: dict[str, list[int]] = collections.defaultdict(lambda: [0, 0])
    listing = ("ls-tree", "-r", "--name-only", revision) if revision else ("ls-files",)
    names = subprocess.check_output(("git", *listing), cwd=HOUSE, text=True).split("\n")
    for name in names:
        top, *rest = name.split("/")
        if not name.endswith(PARTS.get(top, ("\0",))):
            continue
        if revision:
            text = subprocess.check_output(("git", "show", f"{revision}:{name}"), cwd=HOUSE)
        else:
            text = (HOUSE / name).read_bytes()
        for part in (top, f"clvoro/{rest[0]}") if top == "clvoro" and len(rest) > 1 else (top,):
            found[part][0] += text.count(b"\n")
            found[part][1] += 1
    return {part: (lines, files) for part, (lines, files) in found.items()}


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("revisions", nargs="*", metavar="REVISION")
    asked.add_argument("--json", action="store_true", help="print one JSON object per line instead")
    options = asked.parse_args()
    states = {name or "now": counts(name) for name in (*options.revisions, None)}
    columns = {"part": lambda r: r["part"], **{name: lambda r, name=name: r[name] for name in states}}
    report = Report(options.json, columns)
    for part in sorted(states["now"]):
        cells = {name: "{:,} in {}".format(*state.get(part, (0, 0))) for name, state in states.items()}
        report.add({"part": part, **cells})
    report.finish("Lines and files of Python and OpenCL")


if __name__ == "__main__":
    main()
