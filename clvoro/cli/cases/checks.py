"""Check the tables of a case file against their types; errors name the key, the value, and the nearest known name."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PureWindowsPath
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from ...adaptation.options import EFFORTS
from ...errors import InputError

T = TypeVar("T")

_LONGEST_NAME = 200  # bytes: file systems allow 255, and some files get a further suffix
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_MESSAGE = re.compile(r"(?P<text>.*?)(?: - at `\$(?P<path>.*)`)?", re.DOTALL)
_WORDS = {
    "object": "a table",
    "array": "a list",
    "int": "a whole number",
    "float": "a number",
    "str": "a text in quotes",
    "bool": "true or false",
}
"""The types of values, as the author of a case file calls them."""


def check(kind: type[T], content: object, place: str, homes: Mapping[str, Iterable[str]]) -> T:
    """Return `content` as an instance of `kind`.

    - `kind`: a `msgspec.Struct` of `schema`.
    - `content`: tables, lists and values as TOML has them.
    - `place`: name of `content` in errors: ``"case.toml:"`` or ``"name: run"``.
    - `homes`: keys by the names of the tables that take them, for hints.

    Raises `InputError` with the first key that is wrong, its value and what was expected.
    """
    _require_finite(content, place)
    try:
        return msgspec.convert(content, kind)
    except msgspec.ValidationError as error:
        raise InputError(_explain(str(error), kind, content, place, homes)) from None


def file_name(value: str, place: str) -> str:
    """Check for a name that is valid for a file or folder, without a path, on any system."""
    alone = PureWindowsPath(value).name == value != ".."  # Windows paths know all separators and drives
    spelt = value.encode("utf-8", "replace")  # with a ? for invalid characters
    if (
        not value.strip()
        or not alone
        or len(spelt) > _LONGEST_NAME
        or _CONTROL.search(value)
        or spelt.decode() != value
    ):
        raise InputError(
            f"{place} is {value[: _LONGEST_NAME + 1]!r}, expected a name in UTF-8 without slashes, no '.' or '..' "
            "(results go to out/NAME; --out chooses another folder); the case may give one: name = ..."
        )
    return value


def _require_finite(node: object, place: str) -> None:
    """Reject numbers that are not finite. They would pass bounds, and integers may be beyond any float."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            _require_finite(value, _below(place, str(key)))
    elif isinstance(node, (list, tuple)):
        for i, value in enumerate(node):
            _require_finite(value, f"{place}[{i}]")
    elif isinstance(node, (int, float)) and not (abs(node) < 2**63 if isinstance(node, int) else math.isfinite(node)):
        raise InputError(f"{place} is {node!r:.60}, expected a finite number")


def _explain(message: str, kind: Any, content: object, place: str, homes: Mapping[str, Iterable[str]]) -> str:
    """Return the message of an error: the place in the file, what is there, what was expected, and what may help."""
    found = _MESSAGE.fullmatch(message)
    assert found is not None
    text, path = found["text"], found["path"] or ""
    where, got, keys = place, content, []
    for key, index in re.findall(r"\.([^.\[]+)|\[(\d+)\]", path.split("[...]")[0]):
        keys.append(int(index) if index else key)
        got = got[keys[-1]] if index or key in got else None  # type: ignore[index, operator]
        where = f"{where}[{index}]" if index else _below(where, key)
    name = "".join(re.findall(r"`(.*)`", text)[:1])
    tables, others = _types_at(inspect.type_info(kind), content, keys)
    if text.startswith("Object"):
        known = [f.encode_name for table in _chosen(tables, got) for f in table.fields]
        tags = [str(table.tag) for table in tables]
        takes = f"it takes {', '.join(known)}" if known else f"expected kind = one of {', '.join(tags)}"
        if "missing" in text:
            return f"{where} lacks {name}; {takes}"
        kinds = [repr(t.tag) for t in tables if any(name == f.encode_name for f in t.fields)]
        hint = next(
            (f" (it belongs to {home})" for home, taken in homes.items() if name in taken), _nearest(name, known)
        )
        hint = f" (it is for kind = {' or '.join(kinds)})" if kinds else hint
        return f"{where} has the unknown key {name!r}{hint}; {takes}"
    if text.startswith("Invalid"):  # a word, where others are expected
        if tables and keys[-1] == "kind":
            known = [str(table.tag) for table in tables]
        else:
            known = [str(word) for k in others if isinstance(k, inspect.LiteralType) for word in k.values]
            names = [type(k).__name__.removesuffix("Type").lower() for k in others]
            known += [_WORDS[name] for name in names if name in _WORDS]
            for values in (k.value_type for k in others if isinstance(k, inspect.DictType)):
                known += [str(word) for word in getattr(values, "values", ())]
            if isinstance(got, Mapping):
                key = next(key for key, word in got.items() if word not in known)
                where, got = _below(where, key), got[key]
        hint = (
            f" (it is an effort: write effort = {got!r}, or --effort {got})"
            if got in EFFORTS and keys[-1] != "effort"
            else ""
        )
        return f"{where} is {got!r:.60}{hint or _nearest(got, known)}; expected one of {', '.join(known)}"
    if not text.startswith("Expected"):  # an error of a table as a whole
        return f"{where} {text}"
    expected = text.partition(", got")[0].removeprefix("Expected ").replace(" | null", "").replace(" | ", "` or `")
    expected = re.sub("`([a-z]+)`", lambda word: _WORDS.get(word[1], word[0]), expected)
    if "[...]" in path:  # it does not say which
        got_type = re.sub("`([a-z]+)`.*", lambda word: _WORDS.get(word[1], word[0]), text.partition(", got ")[2])
        return f"{where} has a value that is {got_type or 'out of bounds'}, expected {expected}"
    hint = ""
    if "a list" in expected and "a table" not in expected and isinstance(got, Mapping):
        hint = "; put it in [ ], or under a heading in double brackets"
    return f"{where} is {got!r:.200}, expected {expected}{hint}"


def _types_at(
    kind: inspect.Type, node: Any, keys: Sequence[str | int]
) -> tuple[list[inspect.StructType], list[inspect.Type]]:
    """Return the tables and the other types that the value at `keys` below `node` may be.

    A key `kind` that chooses the type of its table has the types of that table.
    """
    kinds = [k.type if isinstance(k, inspect.Metadata) else k for k in getattr(kind, "types", (kind,))]
    tables = [k for k in kinds if isinstance(k, inspect.StructType)]
    if keys and isinstance(keys[0], str):
        inner = [f.type for table in _chosen(tables, node) for f in table.fields if f.encode_name == keys[0]]
    elif keys:
        inner = [k.item_type for k in kinds if isinstance(k, inspect.ListType)]
    else:
        inner = []
    if not inner:
        return tables, [k for k in kinds if k not in tables]
    return _types_at(inner[0], node[keys[0]], keys[1:])


def _chosen(tables: list[inspect.StructType], node: Any) -> list[inspect.StructType]:
    """Return the table that the key `kind` of `node` names, or the only one."""
    return tables if len(tables) < 2 else [table for table in tables if table.tag == node.get("kind")]


def _below(place: str, key: str) -> str:
    """Name a key of the table at `place`; the file itself is the place "case.toml:"."""
    return f"{place} {key}" if place.endswith(":") else f"{place}.{key}"


def _nearest(name: object, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(name), list(known), 1, 0.5)
    return f" (did you mean {near[0]!r}?)" if near else ""
