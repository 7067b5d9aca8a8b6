"""What a run leaves in its folder: checked before it begins, and written whatever else cannot be."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from ..errors import ClvoroError, InputError
from ..io import check_writable, make_folder
from .cases import WRITTEN


def refuse_own_files(folder: Path, named: Mapping[str, Path | None]) -> None:
    """Refuse files, by what they are for, that the results of a run in `folder` would replace.

    Raises
    ------
    InputError
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
    """Make `folder` if need be and check that a file can be written there.

    Raises
    ------
    InputError, OutputError
        Before any work is done that would then be lost.
    """
    make_folder(folder)
    check_writable(folder)
    for name in ("mesh.vtu", "mesh.npz", "history.csv", "case.toml", "report.html"):
        if (folder / name).is_dir():
            raise InputError(
                f"{folder / name} is a folder, expected none or a file; remove it, or choose another folder with --out"
            )


def do_all(tasks: Iterable[Callable[[], object]]) -> None:
    """Call all `tasks`, whichever of them fail, as for want of space; raise the last error, print those before."""
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
    """Say before the run that the report cannot be drawn."""
    # Pictures become files: nothing is shown, and what a notebook has its processes use need not be there.
    os.environ["MPLBACKEND"] = "agg"
    try:
        import matplotlib

        matplotlib.use("agg")
    except ModuleNotFoundError as error:
        raise ClvoroError(
            "the report needs Matplotlib, which is not installed; pip install 'clvoro[plot]', "
            "or run with --no-report"
        ) from error
    except Exception as error:  # whatever is wrong with its settings or folders
        raise ClvoroError(
            f"the report needs Matplotlib, which cannot be used ({error}); mend that, or run with --no-report"
        ) from error
