"""Break kernels in one place at a time, and see whether the tests notice:

    python -m tests.robustness.mutants bins.cl tessellation/bins.h --tests tests/tessellation/test_bins.py --count 40

A mutant has one operator, bound, constant, branch or statement changed. The tests that are named run with it, to the
first failure. A mutant with which they all pass is printed: code that no test looks at, code that serves for nothing,
or a change that makes no difference (`<` for `<=` where equality never comes). It begins with its place: `--only PLACE`
tries it again. Names of files are relative to cl_kernels. Mutants run in children of this process, which are stopped
after twice the processor time that the tests take with the kernels as they are. Works where processes fork.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import resource
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pytest

# Modules of tests are imported once, before processes fork. None of them opens a device.
import clvoro  # noqa: F401
import clvoro.opencl.program as program

_TOKEN = re.compile(
    r"\d+\.\d*(?:e[+-]?\d+)?f?|\d+e[+-]?\d+f?|0x[0-9a-fA-F]+|\d+|[A-Za-z_]\w*"
    r"|<<=?|>>=?|[<>=!+\-*/%&|^]=|&&|\|\||\+\+|--|->|\S"
)
_IGNORED = re.compile(r"/\*.*?\*/|//[^\n]*|^[ \t]*#(?:\\\n|[^\n])*|\"[^\"\n]*\"", re.S | re.M)
_SWAPPED = {
    "<": "<=",
    "<=": "<",
    ">": ">=",
    ">=": ">",
    "==": "!=",
    "!=": "==",
    "&&": "||",
    "||": "&&",
    "+": "-",
    "-": "+",
    "*": "/",
    "/": "*",
    "+=": "-=",
    "-=": "+=",
    "*=": "/=",
    "&": "|",
    "|": "&",
    "&=": "|=",
    "|=": "&=",
    "<<": ">>",
    ">>": "<<",
    "min": "max",
    "max": "min",
    "fmin": "fmax",
    "fmax": "fmin",
    "any": "all",
    "all": "any",
}
_STATEMENT = re.compile(
    r"(?<=[;{})])\s*((?:return|continue|break"
    r"|(?:\+\+|\*)?\w[\w.\[\]>\-+* ]*(?:[+\-*/|&]?= [^;{}]*|\([^;{}]*\)|\+\+|--));)"
)
_DECLARED = re.compile(r"(?:const |global |local |private )*(?:[A-Za-z_]\w*) \*?\w+(?: =|\[|;|,)")


_SIZED = re.compile(r"\b(?!return)[A-Za-z_]\w* \w+\[$")


@dataclass(frozen=True)
class Mutant:
    file: str
    line: int
    column: int
    start: int
    end: int
    new: str
    text: str

    @property
    def place(self) -> str:
        return f"{self.file}:{self.line}:{self.column}:{self.new or 'gone'}"

    def __str__(self) -> str:
        begin = self.text.rfind("\n", 0, self.start) + 1
        end = self.text.find("\n", self.end)
        mutated = f"{self.text[begin : self.start]}[{self.text[self.start : self.end]} -> {self.new}]"
        return f"{self.place}\n    {(mutated + self.text[self.end : end]).strip()}"


def mutants(file: str) -> list[Mutant]:
    """Return all mutants of one file of kernels."""
    text = (program.kernel_folder() / file).read_text()
    # Places stay where they are.
    code = _IGNORED.sub(lambda m: re.sub(r"[^\n]", " ", m[0]), text)
    found: list[Mutant] = []

    def add(start: int, end: int, new: str) -> None:
        line = text.count("\n", 0, start) + 1
        column = start - text.rfind("\n", 0, start)
        found.append(Mutant(file, line, column, start, end, new, text))

    before = ""
    for token in _TOKEN.finditer(code):
        name, start, end = token[0], token.start(), token.end()
        spaced = code[start - 1 : start].isspace() and code[end : end + 1].isspace()
        if name[0].isdigit():
            number = name.rstrip("f")
            if _SIZED.search(code, code.rfind("\n", 0, start), start):
                pass  # room to spare
            elif re.fullmatch(r"\d+", name):
                add(start, end, str(int(name) + 1))
            elif not name.startswith("0x"):
                add(start, end, f"{2 * float(number)!r}{name[len(number) :]}")
        elif name == "!":
            add(start, end, "")
        elif name == "-" and not spaced:
            add(start, end, "")  # a sign
        elif name in _SWAPPED and (spaced or name.isalpha()) and before not in ("const", "global"):
            add(start, end, _SWAPPED[name])
        elif name == "if" or name == "while":
            opening = code.index("(", end)
            depth, closing = 1, opening
            while depth:
                closing += 1
                depth += {"(": 1, ")": -1}.get(code[closing], 0)
            if name == "if":
                add(opening + 1, closing, "1")
            add(opening + 1, closing, "0")
        before = name
    for statement in _STATEMENT.finditer(code):
        if not _DECLARED.match(statement[1]):
            add(statement.start(1), statement.end(1), ";")
    return found


def unchanged(file: str) -> Mutant:
    """Return a mutant that only adds a comment, so that no cache has its kernels."""
    text = (program.kernel_folder() / file).read_text()
    return Mutant(file, 1, 1, len(text), len(text), f"/* {os.getpid()} */\n", text)


def mutate(mutant: Mutant, folder: Path) -> None:
    """Copy the kernels to `folder`, one of them mutated."""
    shutil.copytree(program.kernel_folder(), folder)
    text = mutant.text[: mutant.start] + mutant.new + mutant.text[mutant.end :]
    (folder / mutant.file).write_text(text)


def outcome(mutant: Mutant, tests: list[str], seconds: int) -> tuple[str, float]:
    """Run tests with a mutant; return the outcome and the processor time."""
    with tempfile.TemporaryDirectory() as name:
        folder, log = Path(name), Path(name) / "log"
        mutate(mutant, folder / "kernels")
        child = os.fork()
        if child == 0:
            program.kernel_folder = lambda: folder / "kernels"
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
            out = os.open(log, os.O_WRONLY | os.O_CREAT)
            os.dup2(out, 1)
            os.dup2(out, 2)
            os._exit(pytest.main(["-x", "-q", "--tb=line", "-p", "no:cacheprovider", *tests]))
        _, status, used = os.wait4(child, 0)
        said = log.read_text(errors="replace")
    taken = used.ru_utime + used.ru_stime
    if "does not compile" in said:
        return "does not compile", taken
    if os.WIFSIGNALED(status):
        return "killed", taken
    code = os.WEXITSTATUS(status)
    if code in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.NO_TESTS_COLLECTED):
        sys.exit(said)
    return "survives" if code == 0 else "killed", taken


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("files", nargs="*", metavar="FILE")
    parser.add_argument(
        "--tests", nargs="+", required=True, help='as pytest takes them; options in one word: "-k one or other"'
    )
    parser.add_argument("--count", type=int, default=50, help="mutants in all, drawn by chance")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", default=[], metavar="PLACE")
    arguments = parser.parse_args()
    files = arguments.files or sorted({place.split(":")[0] for place in arguments.only})
    every = [m for file in files for m in mutants(file)]
    if arguments.only:
        chosen = [m for m in every if m.place in arguments.only]
    else:
        drawn = random.Random(arguments.seed).sample(every, min(arguments.count, len(every)))
        chosen = sorted(drawn, key=lambda m: (m.file, m.start))
    came, taken = outcome(unchanged(files[0]), arguments.tests, 3600)
    if came != "survives":
        sys.exit("the tests fail with the kernels as they are")
    print(f"{len(chosen)} of {len(every)} mutants; the tests take {taken:.0f} s", flush=True)
    counts = dict.fromkeys(("killed", "survives", "does not compile"), 0)
    for mutant in chosen:
        came, _ = outcome(mutant, arguments.tests, int(2 * taken) + 5)
        counts[came] += 1
        if came == "survives":
            print(mutant, flush=True)
    print(counts)
    return int(counts["survives"] > 0)


if __name__ == "__main__":
    sys.exit(main())
