"""Find OpenCL devices that work, and choose the best.

A device works if a small kernel has been built and run on it. Some runtimes list devices for which
they cannot build kernels.
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import pyopencl as cl
from numpy.typing import DTypeLike

from ..errors import DeviceError, InputError, InputTypeError
from . import probe as _probe
from . import runtimes as _runtimes
from .peers import Peers, peers_of
from .prebuild import start_workers
from .probe import has_fp64, one_line

_runtimes.prepare()

INSTALL_HINT = (
    "install a CPU runtime (`apt-get install pocl-opencl-icd`, or without root rights on x86-64 "
    'Linux `pip install "clvoro[cpu]"`) or your GPU\'s OpenCL driver'
)
"""Advice in messages about a missing device."""


@dataclass(frozen=True)
class DeviceInfo:
    """One OpenCL device as `clvoro devices` shows it.

    Attributes
    ----------
    index : str
        ``"platform:device"``, accepted by `create_context`.
    platform, name, version : str
        As the runtime reports them.
    kind : str
        ``"gpu"``, ``"cpu"``, ``"accelerator"`` or ``"simulator"`` (Oclgrind, never the default).
    memory : int
        Global memory in bytes.
    units : int
        Compute units (cores of a CPU).
    fp64 : bool
        Whether it computes in float64.
    works : bool
        Whether a test kernel gives the right result.
    reason : str
        Why it does not work; empty if it does.
    default : bool
        Whether `create_context()` takes it.
    """

    index: str
    platform: str
    name: str
    kind: str
    version: str
    memory: int
    units: int
    fp64: bool
    works: bool
    reason: str = ""
    default: bool = False


@dataclass(frozen=True)
class _Candidate:
    """A device with its indices and names."""

    index: str
    device: cl.Device
    platform: str
    name: str
    kind: str

    @property
    def title(self) -> str:
        return f"{self.platform} / {self.name}"

    @property
    def rank(self) -> tuple[int, int]:
        """Sort key, best first: GPUs (with float64 before others), PoCL, other CPUs, the rest."""
        if self.kind == "gpu":
            return (0, 0 if has_fp64(self.device) else 1)
        if self.kind == "cpu":
            return (1 if self.platform.startswith("Portable Computing Language") else 2, 0)
        return (3, 0)


def create_context(device: str | cl.Device | None = None, *, fp64: bool = False, comm: object = None) -> cl.Context:
    """Return a context on the best working device.

    The order is: `device`, the environment variable `PYOPENCL_CTX`, a GPU, PoCL, any other CPU.
    The simulator Oclgrind is taken only by its name or index.

    Parameters
    ----------
    device : str or pyopencl.Device, optional
        Part of a platform's name in any case (``"nvidia"``, ``"pocl"``) or, where no platform has it,
        of a device's or vendor's; a kind (``"gpu"``, ``"cpu"``), or indices ``"platform:device"``
        as `list_devices` gives them; or the PCI address of a GPU, such as ``"0000:3b:00.0"``.
    fp64 : bool
        Take only devices that compute in float64.
    comm : mpi4py.MPI.Comm, optional
        All ranks of this communicator call this together. The ranks of a node take its GPUs in turn, if several are
        equally good.

    Returns
    -------
    pyopencl.Context
        Of one device. The same object in every call that chooses this device, so that kernels are built once.

    Raises
    ------
    DeviceError
        If no such device works. The message lists the devices found and what to install.
    InputTypeError
        If `device` is of another type.
    """
    peers = peers_of(comm)
    place = place_on_node(peers)
    return peers.agree(lambda: context_for(device, fp64, place))


def context_of(ctx: cl.Context | None, real: np.dtype, place: int) -> cl.Context:
    """Return `ctx`, or a context of `context_for` if it is None, and check that its device computes in `real`."""
    found = context_for(None, real == np.float64, place) if ctx is None else ctx
    require_fp64(found, real)
    return found


def contexts_of(
    devices: Sequence[str | cl.Device | cl.Context | None], real: np.dtype, may_share: bool
) -> list[cl.Context]:
    """Return a context on each of `devices`. A name that is given several times stands for equally good ones in turn.

    Raises `DeviceError`, `InputError` or `InputTypeError` if one of them does not work, or does not compute in `real`;
    if two are the same, unless they `may_share` it.
    """
    if isinstance(devices, str) or not isinstance(devices, Sequence) or not devices:
        raise InputTypeError(
            f"devices is {devices!r:.60}, expected a list of names, indices, devices or contexts, such as "
            "['0:0', '0:1']; `clvoro devices` lists them"
        )
    found = []
    for number, given in enumerate(devices):
        place = list(devices[:number]).count(given)
        if isinstance(given, cl.Context):
            found.append(context_of(given, real, place))
        else:
            found.append(context_for(given, real == np.float64, place))
    places = [pci_address(ctx.devices[0]) or ctx.devices[0] for ctx in found]
    for number, place in enumerate(places):
        if (first := places.index(place)) < number and not may_share:
            raise InputError(
                f"devices {first} and {number} are the same, {found[number].devices[0].name.strip()}, expected "
                "different ones; leave one of them out, or let parts of the mesh share it: share_gpus=True"
            )
    return found


def context_for(device: str | cl.Device | None, fp64: bool, place: int) -> cl.Context:
    """Return a context as `create_context` does, for the rank at this `place` among those of its node."""
    _probe.check_process()
    if isinstance(device, cl.Device):
        return _checked_context(_describe(device, "given"), fp64)
    if device is not None and not isinstance(device, str):
        raise InputTypeError(
            f"device got a {type(device).__name__}, expected a string or a pyopencl.Device; "
            'write device="gpu", part of its name, or "platform:device" indices'
        )
    if device is None and os.environ.get("PYOPENCL_CTX"):
        return _checked_context(_from_environment(), fp64)

    # With indices no other platform is queried: some crash.
    index = re.fullmatch(r"\s*(\d+)\s*:\s*\d+\s*", device or "")
    found, broken = _candidates(only=int(index[1]) if index else None)
    if device is None or not device.strip():
        wanted = [c for c in found if c.kind != "simulator"]
        subject = "no working OpenCL device"
    else:
        wanted = _matching(found, device.strip())
        subject = f"device={device!r}: no working OpenCL device of that name or index"
    failures = []
    for candidate in _from_place(sorted(wanted, key=lambda c: c.rank), place):
        ctx, reason = _try_device(candidate.device, fp64)
        if ctx is not None:
            return ctx
        failures.append(f"{candidate.index} {candidate.title}: {reason}")
    chosen = index is not None or "PYOPENCL_CTX" in os.environ
    raise DeviceError(_complaint(subject, found, failures, broken, chosen, fp64))


def _from_place(candidates: list[_Candidate], place: int) -> list[_Candidate]:
    """Rotate the equally good best ones of `candidates`, which are sorted, so that the one at `place` comes first."""
    best = sum(c.rank == candidates[0].rank for c in candidates)
    first = place % max(best, 1)
    return [*candidates[first:best], *candidates[:first], *candidates[best:]]


def place_on_node(peers: Peers) -> int:
    """Return how many parts with lower numbers run on the same machine. All parts call this together."""
    node = socket.gethostname()
    return peers.gather_text(node)[: peers.number].count(node)


def pci_address(device: cl.Device) -> str:
    """Return the PCI address of a GPU, as ``"0000:3b:00.0"``; "" if its driver does not give one."""
    try:
        domain = getattr(device, "pci_domain_id_nv", 0)
        return f"{domain:04x}:{device.pci_bus_id_nv:02x}:{device.pci_slot_id_nv >> 3:02x}.{device.pci_slot_id_nv & 7}"
    except (cl.Error, AttributeError):
        pass
    try:
        topology = device.topology_amd
        return f"0000:{topology.bus:02x}:{topology.device:02x}.{topology.function}"
    except (cl.Error, AttributeError):
        return ""


def refuse_shared_gpus(peers: Peers, device: cl.Device) -> None:
    """Raise if two parts have one GPU. All parts call this together.

    Raises `InputError` on all parts. A GPU whose driver gives no PCI address is not refused.
    """
    address = pci_address(device) if device.type & cl.device_type.GPU else ""
    places = peers.gather_text(f"{address} of {socket.gethostname()}" if address else "")
    for number, place in enumerate(places):
        if place and (first := places.index(place)) < number:
            raise InputError(
                f"ranks {first} and {number} of {peers.count} have one GPU, {place}, expected one for each; start at "
                "most as many ranks on a node as it has GPUs, choose a device for each rank, or let them share it: "
                "Adapter(..., share_gpus=True), clvoro run --share-gpus"
            )


@cache
def shared_context() -> cl.Context:
    """Return the context on the default device of all that runs without an adapter: programs are built once."""
    return create_context()


def list_devices() -> list[DeviceInfo]:
    """Test every OpenCL device and return one entry for each, in the order of the platforms.

    A child process tests them first. So runtimes that crash are listed with a reason. This takes about
    a second.

    Returns
    -------
    list of DeviceInfo
        With ``index``, ``name``, ``kind``, ``works`` and, if it does not, the ``reason``.

    Examples
    --------
    >>> any(device.works for device in clvoro.list_devices())
    True
    """
    _probe.check_process()
    crashed = _probe.crashing_platforms()
    found, broken = _candidates(skip=crashed)
    reasons = {c.index: _probe.verdict(c.device) for c in found}
    best = _default_index(found, reasons, [title for index, title, _ in broken if crashed])
    entries = [
        DeviceInfo(
            index=c.index,
            platform=c.platform,
            name=c.name,
            kind=c.kind,
            version=c.device.version.strip(),
            memory=int(c.device.global_mem_size),
            units=int(c.device.max_compute_units),
            fp64=has_fp64(c.device),
            works=not reasons[c.index],
            reason=reasons[c.index],
            default=c.index == best,
        )
        for c in found
    ]
    for index, platform, reason in broken:
        entries.append(DeviceInfo(index, platform, "-", "-", "-", 0, 0, False, False, reason))
    return entries


def format_devices(devices: Sequence[DeviceInfo]) -> str:
    """Return `devices` as a table in plain text; ``*`` marks the default."""
    if not devices:
        return f"No OpenCL device found: {INSTALL_HINT}."
    header = ("", "index", "kind", "units", "memory", "float64", "works", "platform / device")
    rows = [
        (
            "*" if d.default else "",
            d.index,
            d.kind,
            str(d.units),
            f"{d.memory / 2**30:.1f} GiB",
            "yes" if d.fp64 else "no",
            "yes" if d.works else "NO",
            f"{d.platform} / {d.name}",
        )
        for d in devices
    ]
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    lines = []
    for row, entry in zip([header, *rows], [None, *devices], strict=True):
        lines.append("  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip())
        if entry is not None and entry.reason:
            lines.append(f"       {one_line(entry.reason, 300)}")
    if any(d.kind in ("cpu", "-") and not d.works for d in devices):
        lines.append(f"{_runtimes.cache_remedy()}.")
    if any(d.default for d in devices):
        lines.append("* is the default.")
    elif os.environ.get("PYOPENCL_CTX"):
        lines.append(f"PYOPENCL_CTX={os.environ['PYOPENCL_CTX']!r} does not select a working device.")
    else:
        lines.append(f"There is no default: {INSTALL_HINT}.")
    return "\n".join(lines)


def require_fp64(where: cl.Context | cl.Device, dtype: DTypeLike = np.float64) -> None:
    """Check that a context's first device (or a device) computes in `dtype`.

    Raises `DeviceError` if `dtype` is float64 and the device has no double precision.
    """
    if np.dtype(dtype) != np.float64:
        return
    device = getattr(where, "devices", [where])[0]  # a context, or the device itself
    if not has_fp64(device):
        raise DeviceError(
            f"dtype is 'float64', but the device {device.name.strip()} has no double precision; use "
            "dtype='float32', or another device (`clvoro devices` lists them)"
        )


def _describe(device: cl.Device, index: str) -> _Candidate:
    """Return a device with its names. Oclgrind has the types CPU, GPU and accelerator at once."""
    platform, name = device.platform.name.strip(), device.name.strip()
    if "oclgrind" in f"{platform} {name}".lower():
        kind = "simulator"
    elif device.type & cl.device_type.GPU:
        kind = "gpu"
    elif device.type & cl.device_type.CPU:
        kind = "cpu"
    else:
        kind = "accelerator"
    return _Candidate(index, device, platform, name, kind)


def _candidates(
    only: int | None = None, skip: Mapping[int, str] | None = None
) -> tuple[list[_Candidate], list[tuple[str, str, str]]]:
    """Return all devices, and (index, platform, reason) of each platform without any.

    With `only`, no other platform is queried. `skip` has reasons not to query platforms.
    """
    try:
        platforms = cl.get_platforms()
    except cl.Error:  # the loader raises if there is no platform
        return [], []
    if only is not None and only >= len(platforms):
        only = None  # for the message, which lists all devices
    found: list[_Candidate] = []
    broken: list[tuple[str, str, str]] = []
    for p, platform in enumerate(platforms):
        devices: Collection[cl.Device] = []
        reason = "it lists no device"
        if only not in (None, p):
            continue
        if skip and p in skip:
            reason = skip[p]
        else:
            try:
                devices = platform.get_devices()
            except cl.Error as error:
                reason += f": {one_line(str(error), 300)}"
        found += [_describe(device, f"{p}:{d}") for d, device in enumerate(devices)]
        if not devices:
            broken.append((f"{p}:-", platform.name.strip(), reason))
    return found, broken


def _matching(found: Iterable[_Candidate], query: str) -> list[_Candidate]:
    """Return the devices that match `query`: by indices, else by platform or kind, else by name or vendor."""
    by_index = [c for c in found if c.index == query.replace(" ", "")]
    if by_index:
        return by_index
    text = query.lower()
    aliases = {"Portable Computing Language": "pocl"}
    # Platforms first: PoCL names its device after the processor, such as "Intel".
    for parts in (
        lambda c: pci_address(c.device).lower(),
        lambda c: f"{c.platform} / {aliases.get(c.platform, '')}",
        lambda c: f"{c.device.vendor} / {c.platform} / {c.name}",
    ):
        meant = [c for c in found if text in parts(c).lower() or text == c.kind]
        if meant:
            return meant
    return []


def _from_environment() -> _Candidate:
    """Return the first device that `PYOPENCL_CTX` chooses."""
    value = os.environ["PYOPENCL_CTX"]
    try:
        device = cl.create_some_context(interactive=False).devices[0]
    except Exception as error:
        raise DeviceError(
            f"PYOPENCL_CTX={value!r} does not select an OpenCL device ({one_line(str(error), 200)}); "
            "unset it, or set it to indices that `clvoro devices` shows"
        ) from error
    return _describe(device, f"PYOPENCL_CTX={value!r}")


@cache
def _context_on(device: cl.Device) -> cl.Context:
    """Return the context on `device` that all of this process shares: kernels are built once per context."""
    return cl.Context([device])


def _checked_context(candidate: _Candidate, fp64: bool) -> cl.Context:
    """Return a context on this device, or raise with the reason."""
    ctx, reason = _try_device(candidate.device, fp64)
    if ctx is None:
        raise DeviceError(
            f"the device {candidate.title} ({candidate.index}) cannot be used: {reason}; "
            "choose another (`clvoro devices` lists them)"
        )
    return ctx


def _try_device(device: cl.Device, fp64: bool) -> tuple[cl.Context | None, str]:
    """Return a context on `device` and an empty string, or None and the reason against the device."""
    if fp64 and not has_fp64(device):
        return None, "it has no double precision (use dtype='float32')"
    start_workers(device)
    try:
        ctx = _context_on(device)
    except cl.Error as error:
        return None, _probe.failure(error)
    # A second context would make PoCL load its compiler's library again, which takes 0.4 s.
    reason = _probe.verdict(device, ctx)
    return (None, reason) if reason else (ctx, "")


def _default_index(found: Iterable[_Candidate], reasons: dict[str, str], avoid: Iterable[str]) -> str | None:
    """Return the index of the device that `create_context()` takes.

    `avoid` has names of platforms that must not be queried.
    """
    wish = os.environ.get("PYOPENCL_CTX")
    if wish:
        first = wish.split(":")[0].strip().lower()
        if first.isdigit() and not any(c.index.startswith(f"{first}:") for c in found):
            return None
        if any(first in name.lower() for name in avoid):
            return None
        try:
            chosen = _from_environment().device
        except DeviceError:
            return None
        return next((c.index for c in found if c.device == chosen and not reasons[c.index]), None)
    usable = [c for c in found if c.kind != "simulator" and not reasons[c.index]]
    return min(usable, key=lambda c: c.rank).index if usable else None


def _complaint(
    subject: str,
    found: Sequence[_Candidate],
    failures: Sequence[str],
    broken: Sequence[tuple[str, str, str]],
    chosen: bool,
    fp64: bool,
) -> str:
    """Return the error message: the request, the devices found, and advice.

    `chosen` is True if a device was requested by indices or the environment.
    """
    lines = [subject]
    lines += [f"  tried {text}" for text in failures]
    lines += [f"  platform {title}: {reason}" for _, title, reason in broken]
    others = [c for c in found if not any(f.startswith(f"{c.index} ") for f in failures)]
    lines += [f"  there is {c.index} {c.title} ({c.kind})" for c in others]
    if not found and not broken:
        lines.append("  the OpenCL loader knows no platform")
    elif failures or broken:
        lines.append(f"  {_runtimes.cache_remedy()}")
    remedy = INSTALL_HINT
    left = [c for c in others if c.kind != "simulator" and (has_fp64(c.device) or not fp64)]
    if left:
        best = min(left, key=lambda c: c.rank)
        how = f"use device={best.index!r}" if chosen else "leave the device out"
        remedy = f"{how} to use {best.title}, or install the OpenCL driver of the one that you want"
    lines.append(f"  remedy: {remedy}; `clvoro devices` tests each device")
    return "\n".join(lines)
