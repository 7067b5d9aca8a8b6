"""Make OpenCL runtimes that pip installed known to the OpenCL loader.

pip cannot write to `/etc/OpenCL/vendors`, where the loader looks for runtimes. Intel's CPU runtime
(`pip install "clvoro[cpu]"`) therefore lies in `<prefix>/lib` unseen. Loaders read two further
places that only *add* to the system's runtimes, and both are filled here, before the first query
of platforms:

- `$PYOPENCL_HOME/.libs/*.icd`, in the loader that PyOpenCL's wheel brings (ocl-icd). PyOpenCL
  points that variable at its own folder when imported; the folder made here repeats its entries.
- `$OCL_ICD_FILENAMES`, in Khronos' loader, which other builds of PyOpenCL use.

`OCL_ICD_VENDORS` would *replace* the system's runtimes, and stays the user's.
"""

from __future__ import annotations

import hashlib
import os
import sys
from importlib import metadata
from pathlib import Path

_DISTRIBUTION = "intel-opencl-rt"
_LIBRARY = "libintelocl.so"


def register() -> Path | None:
    """Announce Intel's CPU runtime, if pip installed it and nobody announced it before.

    Call it after `import pyopencl` and before the first query of platforms. Costs a fraction of a
    millisecond when the runtime is not installed. Never raises: a runtime that cannot be announced
    is a device less, which the choice of a device reports.

    Returns
    -------
    pathlib.Path or None
        The runtime's library, if it was announced.
    """
    if not sys.platform.startswith("linux"):
        return None
    try:
        library = _installed_library()
        if library is None or _already_announced():
            return None
        home = _loader_home(library)
    except (OSError, ValueError, metadata.PackageNotFoundError):
        return None
    os.environ["PYOPENCL_HOME"] = str(home)
    others = os.environ.get("OCL_ICD_FILENAMES")
    os.environ["OCL_ICD_FILENAMES"] = f"{others}:{library}" if others else str(library)
    return library


def _installed_library() -> Path | None:
    """Return the runtime's library in the running Python's environment."""
    for file in metadata.distribution(_DISTRIBUTION).files or []:
        if file.name == _LIBRARY:
            path = Path(os.fspath(file.locate())).resolve()
            return path if path.is_file() else None
    return None


def _already_announced() -> bool:
    """Tell whether the loader finds an Intel CPU runtime anyway; two copies would collide."""
    if "intelocl" in os.environ.get("OCL_ICD_FILENAMES", ""):
        return True
    vendors = os.environ.get("OCL_ICD_VENDORS") or os.environ.get("OPENCL_VENDOR_PATH")
    place = Path(vendors or "/etc/OpenCL/vendors")
    entries = place.glob("*.icd") if place.is_dir() else [place] if place.is_file() else []
    # The library must exist too: a removed oneAPI leaves its entry behind.
    for entry in entries:
        name = entry.read_text(errors="replace").strip()
        if "intelocl" in name and (os.sep not in name or Path(name).is_file()):
            return True
    return False


def _loader_home(library: Path) -> Path:
    """Return a folder with `.libs/*.icd` for the loader: PyOpenCL's own entries and `library`.

    The folder's name is a hash of what is in it, so that environments do not disturb each other
    and a second process finds it complete.
    """
    import platformdirs  # PyOpenCL depends on it

    own = Path(os.environ.get("PYOPENCL_HOME", os.devnull)) / ".libs"
    entries = {"clvoro-intel-cpu.icd": str(library)}
    for icd in sorted(own.glob("*.icd")):
        name = icd.read_text().strip()
        # A bare name is a library beside the entry.
        entries[icd.name] = str(own / name) if (own / name).is_file() else name
    text = "\n".join(f"{key}={value}" for key, value in sorted(entries.items()))
    name = "icd-" + hashlib.sha256(text.encode()).hexdigest()[:16]
    try:
        return _write_home(Path(platformdirs.user_cache_dir("clvoro")) / name, entries)
    except OSError:  # no home directory, or one that cannot be written
        return _temporary_home(entries)


def _write_home(home: Path, entries: dict[str, str]) -> Path:
    """Fill `home`, file by file with an atomic replace, unless all is there already."""
    folder = home / ".libs"
    folder.mkdir(parents=True, exist_ok=True)
    for name, library in entries.items():
        path = folder / name
        if path.is_file() and path.read_text() == library + "\n":
            continue
        temporary = folder / f".{name}.{os.getpid()}"
        temporary.write_text(library + "\n")
        os.replace(temporary, path)
    return home


def _temporary_home(entries: dict[str, str]) -> Path:
    """Fill a private temporary folder that goes away with this process."""
    import atexit
    import shutil
    import tempfile

    home = Path(tempfile.mkdtemp(prefix="clvoro-icd-"))
    owner = os.getpid()  # a forked child runs the hook too, and must leave the folder

    def remove() -> None:
        if os.getpid() == owner:
            shutil.rmtree(home, ignore_errors=True)

    atexit.register(remove)
    return _write_home(home, entries)
