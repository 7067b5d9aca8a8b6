"""Cases: TOML files with a domain, a size field and settings of a run; and the built-in ones."""

from __future__ import annotations

import copy
import difflib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ...adaptation.options import uses
from ...errors import InputError
from ...files import open_plain, read_text
from ...geometry.boundary_layers import Layers
from ...geometry.domain import Domain
from ...geometry.sphere import Sphere
from ...io.atomic import atomic_file
from . import schema, toml
from .checks import file_name
from .domains import build_domain
from .fields import build_size, load_array, named_files
from .files import FOLDER, WRITTEN, locate

__all__ = ["WRITTEN", "Case", "builtin_cases", "load_case"]

_RUN_ORDER = (
    "method",
    "methods",
    "effort",
    "levels",
    "error_target",
    "start",
    "points",
    "fixed",
    "n_cells",
    "max_steps",
    "tol",
    "alpha",
    "k",
    "seed",
    "dtype",
)


@dataclass(frozen=True)
class Case:
    """One case file, checked.

    Attributes
    ----------
    name, title : str
    domain : Domain
    size : dict
        The size field's tree of tables; `size_field` builds it.
    run : dict
        The keys of the file's `[run]` table.
    folder : Path
        Folder of the files that the case names; those of the built-in cases are found, too.
    place : dict
        The keys of the file's `[domain]` table; empty for a box or a sphere made in Python.
    layers : tuple of dict
        The tables of the file's `[[layers]]`.
    frames : int
        Number of meshes that follow a moving size field, the first included; see `clvoro.cli.sequence`.
    """

    name: str
    title: str
    domain: Domain
    size: dict[str, Any]
    run: dict[str, Any] = field(default_factory=dict)
    folder: Path = Path()
    place: dict[str, Any] = field(default_factory=dict)
    frames: int = 1
    layers: tuple[dict[str, Any], ...] = ()

    @classmethod
    def from_toml(cls, text: str, name: str, folder: Path = Path()) -> Case:
        """Read a case from TOML text; `name` is its name in errors, and the default of its key `name`.

        Raises
        ------
        InputError
            With the key, its value and what was expected.
        """
        place = f"{name}:"
        try:
            content = toml.read(text)
        except ValueError as error:
            raise InputError(f"{place} not a TOML file: {error}") from error
        except RecursionError as error:
            raise InputError(f"{place} not a case: it is nested too deep") from error
        try:
            checked = schema.case(content, place)
        except (OverflowError, RecursionError) as error:
            raise InputError(f"{place} not a case: a number is too large or the nesting too deep ({error})") from error
        run = checked.get("run", {})
        if "method" in run and "methods" in run:
            raise InputError(f"{place} run has both method and methods; keep one of them")
        stem = file_name(checked.get("name", Path(name).stem), f"{place} name")
        return cls(
            name=stem,
            title=str(checked.get("title", stem)),
            domain=build_domain(checked["domain"], folder),
            size=checked["size"],
            run=run,
            folder=folder,
            place=checked["domain"],
            frames=checked.get("sequence", {}).get("frames", 1),
            layers=tuple(checked.get("layers", ())),
        )

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
        return replace(self, run=schema.run({**run, **changes}, f"{self.name}: run"))

    def size_field(self, time: float = 0.0) -> Any:
        """Build the size field (an object of `clvoro.sizing`), with `time` for {t} in expressions."""
        return build_size(_at(self.size, time), self.folder, self.domain)

    def run_arguments(self) -> dict[str, Any]:
        """Return the arguments of `Adapter.run` that the case sets, except method and dtype."""
        apart = ("method", "methods", "dtype")
        arguments = {key: value for key, value in self.run.items() if key not in apart}
        for key in ("points", "fixed"):
            if isinstance(arguments.get(key), str):
                arguments[key] = load_array(self.folder / arguments[key], f"run.{key}")
        if self.layers:
            arguments["layers"] = [Layers(**table) for table in self.layers]
        return arguments

    def table(self) -> dict[str, Any]:
        """Return the case as the table that its TOML file holds."""
        return {
            "name": self.name,
            "title": self.title,
            "domain": self.place or _place(self.domain),
            "size": self.size,
            "run": {key: self.run[key] for key in _RUN_ORDER if key in self.run},
            **({"layers": list(self.layers)} if self.layers else {}),
            **({"sequence": {"frames": self.frames}} if self.frames > 1 else {}),
        }

    def sources(self) -> list[Path]:
        """Return the paths of the files that the case names."""
        return [locate(self.folder, node[key]).resolve() for node, key in self._entries()]

    def _entries(self) -> list[tuple[dict[str, Any], str]]:
        """Return the tables of the case that name files, and the keys with the names."""
        entries = [(node, "file") for node in named_files(self.size)]
        entries += [(self.place, "file")] * ("file" in self.place)
        entries += [(self.run, k) for k in ("points", "fixed") if isinstance(self.run.get(k), str)]
        return entries

    def _moved(self) -> tuple[Case, dict[str, Path]]:
        """Return the case with all its files in one folder, and their present paths: {name: source}."""
        moved = replace(self, size=copy.deepcopy(self.size), run=dict(self.run), place=dict(self.place))
        taken: dict[str, Path] = {}
        for (node, key), source in zip(moved._entries(), self.sources(), strict=True):
            target = source.name
            while WRITTEN.fullmatch(target) or taken.setdefault(target, source) != source:
                target = f"other-{target}"
            node[key] = target
        return moved, taken

    def text(self, header: tuple[str, ...] = ()) -> str:
        """Return the text of `case.toml`."""
        return toml.write(self._moved()[0].table(), header)

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


def _place(domain: Domain) -> dict[str, Any]:
    """Return the table of a box or a sphere."""
    if isinstance(domain, Sphere):
        return {"kind": "sphere", "radius": domain.radius}
    table: dict[str, Any] = {"lower": list(domain.lower), "upper": list(domain.upper)}
    return {**table, "periodic": list(domain.periodic)} if any(domain.periodic) else table


def _at(node: Any, time: float) -> Any:
    """Return a tree of tables with `time` in the place of {t} in its expressions."""
    if isinstance(node, Mapping):
        return {
            key: value.replace("{t}", f"({time!r})") if key == "expression" else _at(value, time)
            for key, value in node.items()
        }
    return [_at(item, time) for item in node] if isinstance(node, list) else node


def builtin_cases() -> Mapping[str, str]:
    """Return the TOML texts of the built-in cases by name."""
    files = sorted(FOLDER.glob("*.toml"))
    return {path.stem: path.read_text(encoding="utf-8") for path in files}


def load_case(name: str | Path) -> Case:
    """Return the case of a built-in name or of a TOML file.

    Raises
    ------
    InputError
        If there is neither, or the file is not a case.
    """
    known = builtin_cases()
    if str(name) in known:
        return Case.from_toml(known[str(name)], str(name))
    path = Path(name)
    try:
        text = read_text(path, toml.LONGEST)
    except (OSError, UnicodeDecodeError) as error:
        near = difflib.get_close_matches(str(name), list(known), 1, 0.5)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise InputError(
            f"case {str(name)!r} is neither a file that can be read ({error}) nor a built-in case "
            f"({', '.join(known)}){hint}"
        ) from error
    return Case.from_toml(text, path.name, path.parent)
