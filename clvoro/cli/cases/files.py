"""Paths of the files that a case names."""

from __future__ import annotations

import re
from pathlib import Path

FOLDER = Path(__file__).parent
"""Folder of the built-in cases and their files."""
WRITTEN = re.compile(
    r"(mesh|history)(-.*)?\.(vtu|npz|csv|foam|nc|vtk|ply|obj)|graph\.info|case\.toml|report\.html|frames\.csv|frames|pictures|constant"
)
"""Names of the files that a run writes into its folder."""


def locate(folder: Path, name: str) -> Path:
    """Return the path of a file that a case names: beside the case, otherwise among the built-in ones."""
    path, own = folder / name, FOLDER / name
    alone = Path(name).name == name
    return own if alone and own.is_file() and not path.exists() else path
