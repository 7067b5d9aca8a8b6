"""A case of OpenFOAM as a folder: its times, its meshes, its settings, and its solver."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import ClvoroError, InputError
from ..io.atomic import atomic_file
from .fields import FoamField, read_field

try:
    import fcntl
except ImportError:  # of Unix only
    fcntl = None

_EXCHANGE, _HERE = 2, -100  # RENAME_EXCHANGE and AT_FDCWD of Linux
_HOME = "/usr/share/openfoam"  # of Debian's package, whose programs need the variable
_TAIL = 1500
_APART = re.compile(r'//[^\n]*|/\*.*?\*/|"[^"]*"', re.DOTALL)
_BACKUP = re.compile(r"^\.|(~|\.bak|\.old|\.orig|\.save)(\.gz)?$")  # names that OpenFOAM ignores, too
_BLOCK = re.compile(r"\{[^{}]*\}")


class Time(NamedTuple):
    """A time that has been written: its folder's name, and its value."""

    name: str
    value: float


class FoamCase:
    """A folder with ``system`` and ``constant``, and a folder for each time.

    Raises `InputError` if it is no case.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        if not (self.folder / "system" / "controlDict").is_file():
            raise InputError(
                f"{self.folder} has no system/controlDict, expected the folder of a case of OpenFOAM: the one that has "
                "system, constant and 0"
            )
        if (self.folder / "processor0").exists():
            raise InputError(
                f"{self.folder} is decomposed (processor0, ...), expected a whole case; run reconstructPar "
                "-latestTime, and remove the folders processor*"
            )
        self.own = self.folder / "clvoro"
        self._lock: tuple[int, ...] = ()

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Hold the case: no other call changes it, nor the solver of a call that was killed, which holds it, too.

        Raises `InputError` if one of them does.
        """
        if fcntl is None:
            yield
            return
        file = os.open(self.folder, os.O_RDONLY)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(file)
            raise InputError(
                f"{self.folder} is in use by another call, or by the solver of one that was killed, expected one at a "
                "time; wait until it ends, or end it"
            ) from error
        except OSError:  # some file systems of networks have no locks
            pass
        self._lock = (file,)
        try:
            yield
        finally:
            self._lock = ()
            os.close(file)

    def times(self) -> list[Time]:
        """Return the times with fields, in ascending order."""
        found = []
        for path in self.folder.iterdir():
            if re.fullmatch(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?", path.name) and path.is_dir() and any(path.iterdir()):
                found.append(Time(path.name, float(path.name)))
        return sorted(found, key=lambda time: time.value)

    def latest(self) -> Time:
        """Return the latest time.

        Raises `InputError` if none has been written.
        """
        times = self.times()
        if not times:
            raise InputError(
                f"{self.folder} has no time with fields, expected folders such as 0 or 500; run the solver first"
            )
        return times[-1]

    def mesh_folder(self, time: Time) -> Path:
        """Return the folder ``polyMesh`` that holds at a time: that of the latest time before it that has one.

        Raises `InputError` if there is no mesh.
        """
        for earlier in reversed(self.times()):
            folder = self.folder / earlier.name / "polyMesh"
            if earlier.value <= time.value and has_file(folder, "faces"):
                return folder
        folder = self.folder / "constant" / "polyMesh"
        if not has_file(folder, "faces"):
            raise InputError(f"{self.folder} has no mesh, expected constant/polyMesh; write it by mesh.to_openfoam")
        return folder

    def check_kind(self) -> None:
        """Raise InputError if the case has several meshes, or one that the solver moves or refines."""
        if (self.folder / "constant" / "regionProperties").exists():
            raise InputError(
                f"{self.folder} has several regions (constant/regionProperties), expected a case with one mesh"
            )
        path = self.folder / "constant" / "dynamicMeshDict"
        text = path.read_text() if path.exists() else ""
        place = _entry(text, "dynamicFvMesh")
        kind = text[place] if place else "staticFvMesh"
        if kind != "staticFvMesh":
            raise InputError(
                f"{path} has dynamicFvMesh {kind}, expected staticFvMesh: a mesh that the solver moves or refines "
                "cannot be adapted; change the entry if the mesh can stand still"
            )

    def fields(self, time: Time) -> list[FoamField]:
        """Return all fields of a time, those that are not in cells included."""
        found = []
        for path in sorted((self.folder / time.name).iterdir()):
            left_out = _BACKUP.search(path.name) or (path.suffix == ".gz" and path.with_suffix("").exists())
            if path.is_file() and not left_out:
                field = read_field(path)
                if "Field" in field.kind:
                    found.append(field)
        return found

    def folders(self, time: Time) -> list[str]:
        """Return the folders of a time that have neither its mesh nor its state, such as "lagrangian"."""
        inside = (path for path in (self.folder / time.name).iterdir() if path.is_dir())
        return sorted(path.name for path in inside if path.name not in ("polyMesh", "uniform"))

    def put_time(self, name: str, made: Path) -> None:
        """Put the folder `made` in place of that of a time, in one step.

        Without a system call that exchanges folders it takes two steps. In between the time before is the latest one,
        whose fields fit its mesh, too; `mend` ends an exchange that was interrupted.
        """
        target = self.folder / name
        if not target.exists():
            os.rename(made, target)
        elif _exchange(made, target):
            shutil.rmtree(made)
        else:
            old = self.own / "old"
            shutil.rmtree(old, ignore_errors=True)
            (made / ".complete").touch()
            os.rename(target, old)
            os.rename(made, target)
            (target / ".complete").unlink()
            shutil.rmtree(old)

    def mend(self) -> None:
        """End an exchange of folders that was interrupted, and remove what is incomplete."""
        if not self.own.is_dir():
            return
        for made in self.own.glob("next-*"):
            target = self.folder / made.name.removeprefix("next-")
            if (made / ".complete").exists() and not target.exists():
                os.rename(made, target)
                (target / ".complete").unlink()
            else:
                shutil.rmtree(made)
        shutil.rmtree(self.own / "old", ignore_errors=True)

    # Settings and the solver.

    @property
    def control(self) -> Path:
        """The file of the times of a run."""
        return self.folder / "system" / "controlDict"

    @property
    def control_before(self) -> Path:
        """The copy of it from before the first call changed it."""
        return self.own / "controlDict.before"

    def control_number(self, name: str) -> float | None:
        """Return the number of an entry of ``system/controlDict``; None if it is missing, or not a number."""
        text = self.control.read_text()
        place = _entry(text, name)
        try:
            return float(text[place]) if place else None
        except ValueError:
            return None

    def viscosity(self) -> float:
        """Return the kinematic viscosity, `nu` of ``constant/transportProperties``.

        Raises `InputError` if it is not there.
        """
        path = self.folder / "constant" / "transportProperties"
        text = path.read_text() if path.exists() else ""
        place = _entry(text, "nu")
        try:
            return float(text[place].split()[-1] if place else "")
        except ValueError as error:
            raise InputError(
                f"{path} has no number nu, expected the kinematic viscosity, by which cells count for adjoints; write "
                "it there, or pass viscosity="
            ) from error

    def set_control(self, **entries: object) -> None:
        """Change entries of ``system/controlDict``; the first time a copy is kept beside the reports."""
        text = self.control.read_text()
        if not self.control_before.exists():
            self.own.mkdir(exist_ok=True)
            shutil.copy2(self.control, self.control_before)
        for name, value in entries.items():
            place = _entry(text, name)
            if place is None:
                text = f"{text.rstrip()}\n{name} {value};\n"
            else:
                text = f"{text[: place.start]}{value}{text[place.stop :]}"
        with atomic_file(self.control) as file:
            file.write(text.encode())

    def run(self, solver: str, log: Path) -> None:
        """Run a program of OpenFOAM in the case; what it prints goes into `log`.

        Raises `InputError` if it is not installed. Raises `ClvoroError` if it fails; with the end of the log.
        """
        words = check_solver(solver)
        environment = {"WM_PROJECT_DIR": _HOME, **os.environ}
        with open(log, "wb") as file:
            code = subprocess.run(
                words, cwd=self.folder, env=environment, stdout=file, stderr=file, pass_fds=self._lock, check=False
            )
        if code.returncode:
            ended = signal.Signals(-code.returncode).name if code.returncode < 0 else f"code {code.returncode}"
            raise ClvoroError(f"{solver} failed with {ended}: {log.read_text(errors='replace')[-_TAIL:]}\nsee {log}")

    def monitors(self) -> dict[str, float]:
        """Return the last values of the tables in ``postProcessing``, by function object and column."""
        found: dict[str, float] = {}
        for function in sorted((self.folder / "postProcessing").glob("*")):
            starts = [path for path in function.glob("*") if re.fullmatch(r"[\d.eE+-]+", path.name)]
            for path in sorted(max(starts, key=lambda p: float(p.name)).glob("*.dat")) if starts else []:
                found |= {f"{function.name}.{column}": value for column, value in _last_row(path).items()}
        return found


def check_solver(solver: str) -> list[str]:
    """Return the words of a command, whose first one is a program.

    Raises `InputError` if it is not installed.
    """
    words = solver.split()
    if not words or shutil.which(words[0]) is None:
        raise InputError(f"solver is {solver!r}, which is not on the PATH; load OpenFOAM's environment first")
    return words


def has_file(folder: Path, name: str) -> bool:
    """Return whether a file is there, or its compressed form."""
    return (folder / name).exists() or (folder / f"{name}.gz").exists()


def _entry(text: str, name: str) -> slice | None:
    """Return where a dictionary has the value of an entry, the last one of that name: not in dictionaries inside it."""
    text = _APART.sub(lambda found: " " * len(found[0]), text)
    while (outside := _BLOCK.sub(lambda found: ";" * len(found[0]), text)) != text:
        text = outside
    places = [slice(*found.span(1)) for found in re.finditer(rf"(?:^|[;\n])\s*{name}\s+([^;\s][^;]*?)\s*;", text)]
    return places[-1] if places else None


def _last_row(path: Path) -> dict[str, float]:
    """Return the values in the last row of a table by the names of their columns, without the first, the time.

    There are none if the names do not fit the row, or it has anything but numbers.
    """
    lines = path.read_text(errors="replace").splitlines()
    heads = [line.strip("# \t").split() for line in lines if line.startswith("#")]
    rows = [line.split() for line in lines if line and not line.startswith("#")]
    if not heads or not rows or len(heads[-1]) != len(rows[-1]):
        return {}
    try:
        values = np.array(rows[-1], float)
    except ValueError:
        return {}
    return dict(zip(heads[-1][1:], values[1:].tolist(), strict=True))


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two folders in one step; return whether the system can do that."""
    try:
        call = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    return call(_HERE, os.fsencode(a), _HERE, os.fsencode(b), _EXCHANGE) == 0
