"""Write plain settings as TOML text; reading is `tomllib`'s."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib  # type: ignore[no-redef]

__all__ = ["read", "write"]

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
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def read(text: str) -> dict:
    """Parse TOML text; raises ``ValueError`` if it is too long, with line and column if it is not TOML."""
    if len(text) > LONGEST:
        raise ValueError(f"it is longer than {LONGEST} characters")
    for token in _TOKENS.finditer(text):
        if token["deep"]:
            line = text.count("\n", 0, token.start()) + 1
            raise ValueError(f"{token[0]:.40}... has more than {_DEEPEST} parts (at line {line})")
    return tomllib.loads(text)


def write(table: Mapping[str, object], header: Sequence[str] = ()) -> str:
    """Return `table` as TOML text, with the lines of `header` as comments above it.

    Parameters
    ----------
    table : mapping
        Strings, booleans, integers, floats, lists of these, tables, and lists of tables; keys whose
        value is None are left out. Floats are written with all their digits: reading them gives
        the same number.

    Raises
    ------
    TypeError
        For a value that TOML cannot represent.
    """
    lines = [f"# {line}".rstrip() for line in header]
    lines += [""] * bool(lines)
    _write_table(lines, (), table)
    return "\n".join(lines).strip("\n") + "\n"


def _write_table(lines: list[str], path: tuple[str, ...], table: Mapping[str, object]) -> None:
    """Append the plain keys of `table` first, then its sub-tables, as TOML demands."""
    nested = []
    for key, value in table.items():
        if isinstance(value, Mapping) or _is_table_list(value):
            nested.append((key, value))
        elif value is not None:
            lines.append(f"{_key(key)} = {_value(value)}")
    for key, value in nested:
        below = (*path, key)
        name = ".".join(map(_key, below))
        for item in [value] if isinstance(value, Mapping) else value:
            lines += ["", f"[{name}]" if isinstance(value, Mapping) else f"[[{name}]]"]
            _write_table(lines, below, item)


def _is_table_list(value: object) -> bool:
    return isinstance(value, (list, tuple)) and len(value) > 0 and all(isinstance(item, Mapping) for item in value)


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _string(text: str) -> str:
    # JSON's escapes are TOML's, except that TOML also wants DEL escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: Any) -> str:
    if hasattr(value, "tolist"):  # NumPy scalars and arrays
        value = value.tolist()
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, Mapping):  # inside a list that also holds plain values
        return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    raise TypeError(f"TOML has no form for {value!r} ({type(value).__name__})")
