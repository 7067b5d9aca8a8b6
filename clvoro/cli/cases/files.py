"""Case files: paths of the files that a case names, and TOML text, by `tomllib` and `tomli_w`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib  # type: ignore[no-redef]

FOLDER = Path(__file__).parent
"""Folder of the built-in cases and their files."""
WRITTEN = re.compile(
    r"(mesh|history)(-.*)?\.(vtu|npz|csv|foam|nc|vtk|ply|obj)|graph\.info(\.part\.\d+)?|case\.toml|report\.html|pictures|constant"
)
"""Names of the files that a run writes into its folder."""
LONGEST = 1 << 21
"""Most bytes of a case file; large polygons and arrays are in other files."""
_DEEPEST = 16  # most parts of a dotted key, as each part makes a table
# Skips comments and strings, also unterminated ones, in one pass of linear time.
_PART = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\\n]+|\\.)*"?|'[^'\n]*'?)"""
_DOT = rf"[ \t]*\.[ \t]*{_PART}"
_TOKENS = re.compile(
    r"""#[^\n]*|\"{3}(?:[^"\\]+|\\[\s\S]|"(?!""))*(?:"{3,5})?|'{3}(?:[^']+|'(?!''))*(?:'{3,5})?"""
    rf"|{_PART}(?:{_DOT}){{0,{_DEEPEST - 1}}}(?P<deep>{_DOT})?"
)
_FLAT = re.compile(r"\[\n((?: +[^\[\]{}\"\n]+,\n)+) *\]")
"""A list of numbers, one a line."""


def locate(folder: Path, name: str) -> Path:
    """Return the path of a file that a case names: beside the case, otherwise among the built-in ones."""
    path, own = folder / name, FOLDER / name
    alone = Path(name).name == name
    return own if alone and own.is_file() and not path.exists() else path


def read_toml(text: str) -> dict:
    """Parse TOML text; raises ``ValueError`` if it is too long, with line and column if it is not TOML."""
    if len(text) > LONGEST:
        raise ValueError(f"it is longer than {LONGEST} characters")
    for token in _TOKENS.finditer(text):
        if token["deep"]:
            line = text.count("\n", 0, token.start()) + 1
            raise ValueError(f"{token[0]:.40}... has more than {_DEEPEST} parts (at line {line})")
    return tomllib.loads(text)


def write_toml(table: Mapping[str, Any], header: Sequence[str] = ()) -> str:
    """Return `table` as TOML text, with the lines of `header` as comments above it.

    Reading it gives the same table, floats with all their digits. A list of numbers stands on one line.
    """
    lines = [f"# {line}".rstrip() for line in header]
    text = _FLAT.sub(lambda found: f"[{' '.join(found[1].split())[:-1]}]", tomli_w.dumps(table))
    return "\n".join([*lines, *[""] * bool(lines), text])
