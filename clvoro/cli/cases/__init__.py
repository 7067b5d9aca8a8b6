"""Cases: TOML files with a domain, a size field and settings of a run; and the built-in ones."""

from __future__ import annotations

import copy
import difflib
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from ...adaptation.options import uses
from ...errors import InputError
from ...files import open_plain, read_text
from ...geometry.boundary_layers import Layers
from ...geometry.domain import Domain
from ...geometry.polygon import Polygon
from ...io.atomic import atomic_file
from . import schema
from .checks import file_name
from .files import FOLDER, LONGEST, WRITTEN, locate, read_toml, write_toml

__all__ = ["WRITTEN", "Case", "builtin_cases", "load_case"]


@dataclass(frozen=True)
class Case:
    """One case file, checked."""

    table: dict[str, Any]
    """What the file holds, by the tables and keys of `schema.CaseTable`, with a name and a title."""
    domain: Domain
    folder: Path = Path()
    """Folder of the files that the case names; those of the built-in cases are found, too."""

    @classmethod
    def from_toml(cls, text: str, name: str, folder: Path = Path()) -> Case:
        """Read a case from TOML text; `name` is its name in errors, and the default of its key `name`.

        Raises `InputError` with the key, its value and what was expected.
        """
        place = f"{name}:"
        try:
            checked = schema.check_case(read_toml(text), place)
        except InputError:
            raise
        except ValueError as error:
            bare = re.search(r"[=\[,] *[-+]?(\.\d+)", text)
            hint = f"; write 0{bare[1]} for {bare[1]}" if bare else ""
            raise InputError(f"{place} not a TOML file: {error}{hint}") from error
        except RecursionError as error:
            raise InputError(f"{place} not a case: it is nested too deep") from error
        checked.name = file_name(Path(name).stem if checked.name is None else checked.name, f"{place} name")
        checked.title = checked.title or checked.name
        table, domain = msgspec.to_builtins(checked), checked.domain.build(folder)
        _check_walls(table, domain, place)
        return cls(table, domain, folder)

    @property
    def name(self) -> str:
        """Name of the case, and of its output folder."""
        return self.table["name"]

    @property
    def title(self) -> str:
        """Title of reports."""
        return self.table["title"]

    @property
    def run(self) -> dict[str, Any]:
        """The keys of the file's `[run]` table."""
        return self.table.get("run", {})

    @property
    def land(self) -> Polygon | None:
        """Polygons, in longitudes and latitudes, whose cells are removed from a mesh of the sphere, if any."""
        name = self.table["domain"].get("land")
        return None if name is None else schema.read_polygon(locate(self.folder, name), "domain.land", planar=False)

    @property
    def patches(self) -> dict[str, Any]:
        """Types of OpenFOAM's patches by name: the file's `[patches]` table."""
        return self.table.get("patches", {})

    def with_patches(self, types: Mapping[str, str]) -> Case:
        """Return this case with other types of patches."""
        return replace(self, table={**self.table, "patches": {**self.patches, **types}}) if types else self

    @property
    def methods(self) -> tuple[str | None, ...]:
        """Methods to run in turn, all from the same start; the last one is the main one."""
        return tuple(self.run.get("methods", [self.run.get("method")]))

    def with_run(self, **changes: Any) -> Case:
        """Return this case with other keys in `[run]`; those that are None stay as they are.

        With another method, settings that it does not use are dropped, unless they are in `changes`.
        """
        changes = {key: value for key, value in changes.items() if value is not None}
        dropped: set[str] = set()
        if {"method", "methods"} & set(changes):
            methods = changes.get("methods", [changes.get("method")])
            unused = {key for key in self.run if not any(uses(method, key) for method in methods)}
            dropped = {"method", "methods", *unused}
        run = {key: value for key, value in self.run.items() if key not in dropped}
        checked = schema.check_run({**run, **changes}, f"{self.name}: run")
        return replace(self, table={**self.table, "run": msgspec.to_builtins(checked)})

    def size_field(self) -> Any:
        """Build the size field (an object of `clvoro.sizing`)."""
        size = msgspec.convert(self.table["size"], schema.Size)
        return schema.build_size(size, self.folder, self.domain)

    def run_arguments(self) -> dict[str, Any]:
        """Return the arguments of `Adapter.run` that the case sets, except method and dtype."""
        apart = ("method", "methods", "dtype")
        arguments = {key: value for key, value in self.run.items() if key not in apart}
        for key in ("points", "fixed"):
            if isinstance(arguments.get(key), str):
                arguments[key] = schema.load_points(self.folder / arguments[key], f"run.{key}")
        if "layers" in self.table:
            arguments["layers"] = [Layers(**layers) for layers in self.table["layers"]]
        return arguments

    def sources(self) -> list[Path]:
        """Return the paths of the files that the case names."""
        return [locate(self.folder, node[key]).resolve() for node, key in _files(self.table)]

    def _moved(self) -> tuple[dict[str, Any], dict[str, Path]]:
        """Return the case's table with all its files in one folder, and their present paths: {name: source}."""
        moved = copy.deepcopy(self.table)
        taken: dict[str, Path] = {}
        for (node, key), source in zip(_files(moved), self.sources(), strict=True):
            if source.is_dir() or source.suffix in (".foam", ".xdmf"):  # more than one file: it stays where it is
                node[key] = str(source)
                continue
            target = source.name
            while WRITTEN.fullmatch(target) or taken.setdefault(target, source) != source:
                target = f"other-{target}"
            node[key] = target
        return moved, taken

    def copies(self) -> list[str]:
        """Return the names of the copies of the case's files that `write` makes."""
        return list(self._moved()[1])

    def text(self, header: tuple[str, ...] = ()) -> str:
        """Return the text of `case.toml`."""
        return write_toml(self._moved()[0], header)

    def write(self, folder: Path, header: tuple[str, ...] = ()) -> Path:
        """Write `case.toml` into `folder`, with copies of the files that it names; return its path.

        The folder is self-contained: it can be moved and read again.
        """
        for target, source in self._moved()[1].items():
            if source != (folder / target).resolve():
                with open_plain(source) as given, atomic_file(folder / target) as file:
                    shutil.copyfileobj(given, file)
        path = folder / "case.toml"
        with atomic_file(path) as file:
            file.write(self.text(header).encode())
        return path


def _files(node: Any) -> Iterator[tuple[Any, Any]]:
    """Iterate over the tables and lists of a case that name files, and the keys with the names."""
    for item in node.values() if isinstance(node, dict) else node:
        if isinstance(item, (dict, list)):
            yield from _files(item)
    if isinstance(node, dict):
        for key in ("file", "solid", "points", "fixed", "land", "lines", "shapes", "surfaces"):
            value = node.get(key)
            if isinstance(value, str):
                yield node, key
            elif isinstance(value, list):
                yield from ((value, k) for k, item in enumerate(value) if isinstance(item, str))


def _check_walls(table: dict[str, Any], domain: Domain, place: str) -> None:
    """Check all walls that a case names, and the types of patches."""
    for key, node in _tables({key: table[key] for key in ("size", "layers") if key in table}, place):
        of_walls = key.startswith(f"{place} layers") or node.get("kind") in ("boundary", "creases")
        if of_walls and node.get("edges") is not None:
            domain.boundaries.select(f"{key}.edges", node["edges"])
    for name in table.get("patches", {}):
        domain.boundaries.select(f"{place} patches", name)


def _tables(node: Any, place: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Iterate over the tables below `node` and their places."""
    if isinstance(node, dict):
        yield place, node
    below = node.items() if isinstance(node, dict) else enumerate(node)
    for key, item in below:
        if isinstance(item, (dict, list)):
            inner = f"{place}[{key}]" if isinstance(key, int) else f"{place}{' ' if place.endswith(':') else '.'}{key}"
            yield from _tables(item, inner)


def builtin_cases() -> Mapping[str, str]:
    """Return the TOML texts of the built-in cases by name."""
    files = sorted(FOLDER.glob("*.toml"))
    return {path.stem: path.read_text(encoding="utf-8") for path in files}


GEOMETRIES = {
    **dict.fromkeys((".json", ".geojson"), "polygon"),
    **dict.fromkeys((".stl", ".obj", ".ply", ".off", ".3mf", ".step", ".stp"), "solid"),
}
"""Suffixes of files that a case names, and the key below [domain] that does."""


def load_case(name: str | Path) -> Case:
    """Return the case of a built-in name or of a TOML file.

    Raises `InputError` if there is neither, or the file is not a case.
    """
    known = builtin_cases()
    if str(name) in known:
        return Case.from_toml(known[str(name)], str(name))
    path = Path(name)
    if key := GEOMETRIES.get(Path(path.name.lower().removesuffix(".gz")).suffix):
        unit = "; for sizes in meters, add units = 'mm' if the file is in millimeters" * (key == "solid")
        raise InputError(
            f"{str(name)!r} is a geometry, expected a case: write a file .toml with {key} = {path.name!r} below "
            f"[domain], and above that a line with the width of cells, such as size = 0.1{unit}"
        )
    try:
        text = read_text(path, LONGEST)
    except (OSError, UnicodeDecodeError) as error:
        near = difflib.get_close_matches(str(name), list(known), 1, 0.5)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise InputError(
            f"case {str(name)!r} is neither a file that can be read ({error}) nor a built-in case "
            f"({', '.join(known)}){hint}"
        ) from error
    return Case.from_toml(text, path.name, path.parent)
