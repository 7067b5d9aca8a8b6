"""What OpenCL runtimes need before the first query of platforms: to be found, and a cache to write.

pip cannot write to `/etc/OpenCL/vendors`, where the loader looks for runtimes. Intel's CPU runtime
(`pip install "clvoro[cpu]"`) therefore lies in `<prefix>/lib` unseen. Loaders read two further
places that only *add* to the system's runtimes, and both are filled here, before the first query
of platforms:

- `$PYOPENCL_HOME/.libs/*.icd`, in the loader that PyOpenCL's wheel brings (ocl-icd). PyOpenCL
  points that variable at its own folder when imported; the folder made here repeats its entries.
- `$OCL_ICD_FILENAMES`, in Khronos' loader, which other builds of PyOpenCL use.

`OCL_ICD_VENDORS` would *replace* the system's runtimes, and stays the user's.

PoCL lists no device and PyOpenCL's cache of binaries raises if the user's cache folder cannot be
written (a container under a foreign user id, a cluster's read-only home), and PoCL ends the process
if its disk is full. The process then gets a cache of its own.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import sys
import tempfile
from importlib import metadata
from pathlib import Path

_ROOM = 1 << 22
"""Bytes that must be left where kernels are cached: those of a run take two to twenty million."""
_DISTRIBUTION = "intel-opencl-rt"
_LIBRARY = "libintelocl.so"


def prepare() -> None:
    """Do both; call it after `import pyopencl` and before the first query of platforms."""
    provide_cache()
    announce()


def provide_cache() -> Path | None:
    """Point `XDG_CACHE_HOME` to a temporary folder if the user's cache folder cannot be written, or is full.

    Returns
    -------
    pathlib.Path or None
        The temporary folder, if one was needed and there is a place for it. It goes away with this process.
    """
    if not sys.platform.startswith("linux"):
        return None
    with contextlib.suppress(OSError, RuntimeError):  # no such folder can be made, or nobody's home
        place = cache_home()
        place.mkdir(parents=True, exist_ok=True)
        if _has_room(place):
            return None
    for parent in (None, "/dev/shm"):
        with contextlib.suppress(OSError):
            if _has_room(parent):
                folder = _temporary_folder(parent)
                os.environ["XDG_CACHE_HOME"] = str(folder)
                return folder
    return None  # devices that do not work then are reported with `cache_remedy`


def _has_room(folder: Path | str | None) -> bool:
    """Tell whether files can be made in `folder`, with `_ROOM` bytes; None: where temporary files go."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, _ROOM)
    except OSError as error:  # not every file system can tell by this call
        return error.errno in (errno.EINVAL, errno.EOPNOTSUPP)
    return True


def cache_remedy() -> str:
    """Return what to do about kernels in caches that are damaged or full: runtimes do not recover from that."""
    try:
        home = cache_home()
    except RuntimeError:  # nobody's home
        home = Path("~/.cache")
    pocl = os.environ.get("POCL_CACHE_DIR") or home / "pocl"
    return (
        f"If kernels in a cache are damaged (after a power cut, say), remove {pocl} and {home / 'pytools'}; if its "
        "disk is full or not to be written, set XDG_CACHE_HOME to another folder"
    )


def cache_home() -> Path:
    """Return the user's cache folder, as PoCL and PyOpenCL see it."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def announce() -> Path | None:
    """Announce Intel's CPU runtime, if pip installed it and nobody announced it before.

    Costs a fraction of a millisecond when the runtime is not installed. Never raises: a runtime
    that cannot be announced is a device less, which the choice of a device reports.

    Returns
    -------
    pathlib.Path or None
        The runtime's library, if it was announced.
    """
    if not sys.platform.startswith("linux"):
        return None
    try:
        library = _installed_library()
        if library is None or _known_to_system():
            return None
        home = _loader_home(library)
    except (OSError, RuntimeError, ValueError, metadata.PackageNotFoundError):
        return None
    os.environ["PYOPENCL_HOME"] = str(home)
    # A child process inherits this variable, while PyOpenCL resets the other one in it.
    others = os.environ.get("OCL_ICD_FILENAMES", "")
    if "intelocl" not in others:
        os.environ["OCL_ICD_FILENAMES"] = f"{others}:{library}" if others else str(library)
    return library


def _installed_library() -> Path | None:
    """Return the runtime's library in the running Python's environment."""
    for file in metadata.distribution(_DISTRIBUTION).files or []:
        if file.name == _LIBRARY:
            path = Path(os.fspath(file.locate())).resolve()
            return path if path.is_file() else None
    return None


def _known_to_system() -> bool:
    """Tell whether the loader finds an Intel CPU runtime anyway; two copies would collide."""
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
    own = Path(os.environ.get("PYOPENCL_HOME", os.devnull)) / ".libs"
    entries = {"clvoro-intel-cpu.icd": str(library)}
    for icd in sorted(own.glob("*.icd")):
        name = icd.read_text().strip()
        # A bare name is a library beside the entry.
        entries[icd.name] = str(own / name) if (own / name).is_file() else name
    text = "\n".join(f"{key}={value}" for key, value in sorted(entries.items()))
    name = "icd-" + hashlib.sha256(text.encode()).hexdigest()[:16]
    return _write_home(cache_home() / "clvoro" / name, entries)


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


def _temporary_folder(parent: str | None = None) -> Path:
    """Make a private temporary folder that goes away with this process."""
    import atexit
    import shutil

    folder = Path(tempfile.mkdtemp(prefix="clvoro-cache-", dir=parent))
    owner = os.getpid()  # a forked child runs the hook too, and must leave the folder

    def remove() -> None:
        if os.getpid() == owner:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder
