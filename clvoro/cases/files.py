"""Where the files that a case names are."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
"""Where the built-in cases and their files lie."""


def locate(folder: Path, name: str) -> Path:
    """Return the path of a file that a case names: beside the case, else a built-in case's own."""
    path, own = folder / name, FOLDER / name
    alone = Path(name).name == name
    return own if alone and own.is_file() and not path.exists() else path
