"""Prepare OpenCL runtimes before the first query of platforms: register those not listed, and provide a kernel cache.

The loader looks for runtimes in `/etc/OpenCL/vendors`, where pip cannot write. So it does not find
Intel's CPU runtime (`pip install "clvoro[cpu]"`), which lies in `<prefix>/lib`. In containers the entry of NVIDIA's
driver is often missing, though the driver is there. Loaders read two more places, which *add* runtimes to those of the
system. Both are filled here:

- `$PYOPENCL_HOME/.libs/*.icd`, for the loader in PyOpenCL's wheel (ocl-icd). When imported,
  PyOpenCL sets the variable to its own folder; the folder made here repeats its entries.
- `$OCL_ICD_FILENAMES`, for Khronos' loader, which other builds of PyOpenCL use.

`OCL_ICD_VENDORS` would *replace* the system's runtimes. It is not changed.

If the user's cache folder is not writable (in a container, on a cluster), PoCL lists no device and
PyOpenCL's cache of binaries raises. If its disk is full, PoCL ends the process. In both cases the
process gets a temporary cache.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

_ROOM = 1 << 22
"""Bytes that must be free in the cache. The kernels of a run take 2 to 20 MB."""
_HELD = 5.0
"""Seconds after which a lock of PyOpenCL's cache is that of a dead process. Others hold it for milliseconds."""
_DISTRIBUTION = "intel-opencl-rt"
_LIBRARY = "libintelocl.so"
_NVIDIA_LIBRARY = "libnvidia-opencl.so.1"
_NVIDIA_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/local/nvidia/lib64",
    "/usr/lib/wsl/lib",
)
"""Folders in which distributions, container toolkits and clusters install NVIDIA's driver."""


def prepare() -> None:
    """Provide a cache and register runtimes; call it after `import pyopencl`, before platforms are queried."""
    provide_cache()
    register_runtimes()


def provide_cache() -> Path | None:
    """Point `XDG_CACHE_HOME` to a temporary folder if the user's cache folder cannot be written, or is full.

    Return the temporary folder, if one is needed and can be made. It is removed when this process ends.
    """
    if not sys.platform.startswith("linux"):
        return None
    with contextlib.suppress(OSError, RuntimeError):  # the folder cannot be made, or the user has no home
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
    return None  # messages about devices that do not work include `cache_remedy`


def _has_room(folder: Path | str | None) -> bool:
    """Return whether `_ROOM` bytes can be written to `folder`, or with None to the folder of temporary files."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            os.posix_fallocate(file.fileno(), 0, _ROOM)
    except OSError as error:  # not every file system supports this call
        return error.errno in (errno.EINVAL, errno.EOPNOTSUPP)
    return True


def cache_remedy() -> str:
    """Return advice about damaged or full kernel caches, which runtimes do not repair."""
    try:
        home = cache_home()
    except RuntimeError:  # the user has no home
        home = Path("~/.cache")
    pocl = os.environ.get("POCL_CACHE_DIR") or home / "pocl"
    return (
        f"If kernels in a cache are damaged (after a power cut, say), remove {pocl}, {home / 'pyopencl'} and "
        f"{home / 'pytools'}; "
        "if its disk is full or not writable, set XDG_CACHE_HOME to another folder"
    )


def full_cache_remedy() -> str:
    """Return what to do if the user's cache folder cannot be written to; "" if it can."""
    with contextlib.suppress(RuntimeError):  # the user has no home
        if not _has_room(cache_home()):
            return f"nothing can be written to {cache_home()}. {cache_remedy()}. "
    return ""


def remove_dead_locks() -> None:
    """Remove the lock of PyOpenCL's cache that a process has left which was killed while it read or wrote the cache.

    With such a lock PyOpenCL waits for a minute, and fails.
    """
    with contextlib.suppress(RuntimeError):  # the user has no home
        for lock in cache_home().glob("pyopencl/*/lock"):
            with contextlib.suppress(OSError):  # it is gone
                made, began = lock.stat().st_mtime_ns, time.monotonic()
                while lock.stat().st_mtime_ns == made:
                    if time.monotonic() - began > _HELD:
                        lock.unlink()
                    time.sleep(0.01)


def cache_home() -> Path:
    """Return the user's cache folder, as PoCL and PyOpenCL see it."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


def register_runtimes() -> list[Path]:
    """Register two runtimes if they are installed and the loader does not know them: Intel's from pip, NVIDIA's driver.

    Takes a fraction of a millisecond if neither is installed. Never raises: a missing runtime is reported when a device
    is chosen.
    """
    if not sys.platform.startswith("linux"):
        return []
    found = {"intelocl": _intel_library, "nvidia-opencl": _nvidia_library}
    libraries = []
    for word, find in found.items():
        with contextlib.suppress(OSError, RuntimeError, ValueError, metadata.PackageNotFoundError):
            library = find()
            if library is not None and not _known_to_system(word):
                libraries.append(library)
    try:
        home = _loader_home(libraries) if libraries else None
    except (OSError, RuntimeError, ValueError):
        home = None
    if home is None:
        return []
    os.environ["PYOPENCL_HOME"] = str(home)
    # Child processes inherit this variable. In them PyOpenCL sets the other one again.
    others = [name for name in os.environ.get("OCL_ICD_FILENAMES", "").split(":") if name]
    new = [str(library) for library in libraries if str(library) not in others]
    os.environ["OCL_ICD_FILENAMES"] = ":".join(others + new)
    return libraries


def _intel_library() -> Path | None:
    """Return the library of Intel's runtime in the running Python's environment."""
    for file in metadata.distribution(_DISTRIBUTION).files or []:
        if file.name == _LIBRARY:
            path = Path(os.fspath(file.locate())).resolve()
            return path if path.is_file() else None
    return None


def _nvidia_library() -> Path | None:
    """Return the library of NVIDIA's driver for OpenCL."""
    paths = (Path(folder, _NVIDIA_LIBRARY) for folder in _NVIDIA_FOLDERS)
    return next((path for path in paths if path.is_file()), None)


def _known_to_system(word: str) -> bool:
    """Return whether the loader finds a runtime with `word` in its name; two copies would collide."""
    vendors = os.environ.get("OCL_ICD_VENDORS") or os.environ.get("OPENCL_VENDOR_PATH")
    place = Path(vendors or "/etc/OpenCL/vendors")
    entries = place.glob("*.icd") if place.is_dir() else [place] if place.is_file() else []
    # The library must exist, too. When a runtime is removed, its entry may stay.
    for entry in entries:
        name = entry.read_text(errors="replace").strip()
        if word in name and (os.sep not in name or Path(name).is_file()):
            return True
    return False


def _loader_home(libraries: list[Path]) -> Path:
    """Return a folder with `.libs/*.icd` for the loader: PyOpenCL's own entries and `libraries`.

    The folder's name is a hash of its content. So environments do not share a folder, and other
    processes find it complete.
    """
    own = Path(os.environ.get("PYOPENCL_HOME", os.devnull)) / ".libs"
    entries = {f"clvoro-{library.name}.icd": str(library) for library in libraries}
    for icd in sorted(own.glob("*.icd")):
        name = icd.read_text().strip()
        # A bare name is a library beside the entry.
        entries[icd.name] = str(own / name) if (own / name).is_file() else name
    text = "\n".join(f"{key}={value}" for key, value in sorted(entries.items()))
    name = "icd-" + hashlib.sha256(text.encode()).hexdigest()[:16]
    return _write_home(cache_home() / "clvoro" / name, entries)


def _write_home(home: Path, entries: dict[str, str]) -> Path:
    """Write missing files to `home`, each by an atomic replace."""
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
    """Make a private temporary folder, which is removed when this process ends."""
    import atexit
    import shutil

    folder = Path(tempfile.mkdtemp(prefix="clvoro-cache-", dir=parent))
    owner = os.getpid()  # forked children call `remove`, too, and must keep the folder

    def remove() -> None:
        if os.getpid() == owner:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder
