"""The output folder of a run: checks before it begins, and writing that continues after an error."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from ..errors import ClvoroError, InputError
from ..io import check_writable, make_folder
from ..io.foam import polymesh_folder
from .cases import WRITTEN


def refuse_own_files(folder: Path, named: Mapping[str, Path | None]) -> None:
    """Reject input files that the results of a run in `folder` would replace; `named` maps their purpose to the path.

    Raises `InputError`.
    """
    for what, path in named.items():
        if path is None:
            continue
        place = Path(os.path.realpath(path))
        if place.parent == Path(os.path.realpath(folder)) and WRITTEN.fullmatch(place.name):
            raise InputError(
                f"{what} is {str(path)!r}, which the run's results would replace; choose another name, or "
                "another folder with --out"
            )


def check_folder(folder: Path) -> None:
    """Create `folder` if needed and check that a file can be written there.

    Raises `InputError` or `OutputError` before any work that would be lost.
    """
    make_folder(folder)
    check_writable(folder)
    for name in ("mesh.vtu", "mesh.npz", "history.csv", "case.toml", "report.html"):
        if (folder / name).is_dir():
            raise InputError(
                f"{folder / name} is a folder, expected none or a file; remove it, or choose another folder with --out"
            )


def written_names(path: Path) -> str:
    """Return the name of a written file, for a file ``.foam`` with that of its mesh."""
    return f"{path} (with {polymesh_folder(path)})" if path.suffix.lower() == ".foam" else str(path)


def do_all(tasks: Iterable[Callable[[], object]]) -> None:
    """Call all `tasks`, even if some fail; raise the last error and print the earlier ones."""
    failed: Exception | None = None
    for task in tasks:
        try:
            task()
        except (ClvoroError, OSError, MemoryError) as error:
            if failed is not None:
                print(f"clvoro: {failed}", file=sys.stderr)
            failed = error
    if failed is not None:
        raise failed


def require_plots() -> None:
    """Raise an error before the run if the report cannot be drawn."""
    # Pictures are only written to files, whatever backend a notebook has set.
    os.environ["MPLBACKEND"] = "agg"
    try:
        import matplotlib

        matplotlib.use("agg")
    except ModuleNotFoundError as error:
        raise ClvoroError(
            "the report needs Matplotlib, which is not installed; pip install 'clvoro[plot]', or run with --no-report"
        ) from error
    except Exception as error:  # for example broken settings
        raise ClvoroError(
            f"the report needs Matplotlib, which cannot be used ({error}); repair it, or run with --no-report"
        ) from error


MESH_FILES = {
    "openfoam": ("mesh.foam", None),
    "cgns": ("mesh.cgns", None),
    "nc": ("mesh.nc", "ugrid"),
    "mpas": ("mesh-mpas.nc", "mpas"),
    "scrip": ("mesh-scrip.nc", "scrip"),
    "vtk": ("mesh.vtk", None),
    "ply": ("mesh.ply", None),
    "obj": ("mesh.obj", None),
    "metis": ("graph.info", None),
}
"""By the name of the format: the file, and its convention, which `clvoro.io.write` takes."""
NAMES = {"foam": "openfoam", "ugrid": "nc", "info": "metis"}
"""Formats that are also known by a suffix or a convention."""
PLANE = ("nc", "mpas", "vtk", "ply", "obj")
"""Formats that hold polygons only."""
