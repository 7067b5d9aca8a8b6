"""Tests of devices, their choice, error messages, and the registration of Intel's runtime."""

import os
import subprocess
import sys
import threading
from importlib import metadata
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from clvoro.errors import DeviceError, InputError, InputTypeError, RankError
from clvoro.opencl import devices as device
from clvoro.opencl import probe as _probe
from clvoro.opencl import program
from clvoro.opencl import runtimes as _runtimes
from clvoro.opencl.threads import Team

ROOT = Path(__file__).parents[2]


class FakeDevice:
    """The attributes of a pyopencl.Device that the choice uses."""

    def __init__(self, key, platform, name, kind, fp64=True, vendor="Maker"):
        self.int_ptr, self.name, self.type, self.vendor = key, name, kind, vendor
        self.platform = type("FakePlatform", (), {"name": platform})()
        self.double_fp_config, self.extensions = (63 if fp64 else 0), ""
        self.version, self.global_mem_size, self.max_compute_units = "OpenCL 3.0", 2**31, 4


CPU, GPU, EVERYTHING = cl.device_type.CPU, cl.device_type.GPU, 15
GRIND = FakeDevice(-1, "Oclgrind", "Oclgrind Simulator", EVERYTHING)
INTEL = FakeDevice(-2, "Intel(R) OpenCL", "Some CPU", CPU)
POCL = FakeDevice(-3, "Portable Computing Language", "pthread-Some CPU", CPU)
SMALL_GPU = FakeDevice(-4, "Vendor", "Graphics", GPU, fp64=False)
BIG_GPU = FakeDevice(-5, "Vendor", "Tensor 9000", GPU)


@pytest.fixture
def machine(monkeypatch):
    """Replace the devices of the machine by given ones, some of them broken; a context is a list of devices."""

    def install(*devices, broken=()):
        monkeypatch.delenv("PYOPENCL_CTX", raising=False)
        found = [device._describe(d, f"{i}:0") for i, d in enumerate(devices)]
        monkeypatch.setattr(device, "_candidates", lambda **_: (found, []))
        monkeypatch.setattr(_probe, "crashing_platforms", dict)
        reasons = {d.int_ptr: "it cannot build" if d in broken else "" for d in devices}
        monkeypatch.setattr(_probe, "_verdicts", reasons)
        monkeypatch.setattr(device, "start_workers", lambda _: None)
        monkeypatch.setattr(device.cl, "Context", lambda devices: devices)

    return install


@pytest.mark.parametrize(
    ("devices", "broken", "expected"),
    [
        ([GRIND, INTEL, POCL, SMALL_GPU, BIG_GPU], [], BIG_GPU),
        ([GRIND, INTEL, POCL, SMALL_GPU, BIG_GPU], [BIG_GPU], SMALL_GPU),
        ([GRIND, INTEL, POCL, BIG_GPU], [BIG_GPU], POCL),
        ([GRIND, INTEL, POCL], [POCL], INTEL),
        ([GRIND, POCL, INTEL], [], POCL),
    ],
)
def test_order_of_choice(machine, devices, broken, expected):
    machine(*devices, broken=broken)
    assert device.create_context() == [expected]
    chosen = [d for d in device.list_devices() if d.default]
    assert [d.name for d in chosen] == [expected.name]


def test_ranks_of_a_node_take_its_gpus_in_turn(machine, monkeypatch):
    """Two nodes of two GPUs: four ranks have one each; a fifth shares one, which is refused. CPUs may be shared."""
    gpus = [FakeDevice(-10 - k, "Maker", f"GPU {k}", GPU) for k in range(2)]
    for k, gpu in enumerate(gpus):
        gpu.pci_domain_id_nv, gpu.pci_bus_id_nv, gpu.pci_slot_id_nv = 0, 0x3B + k, 0
    machine(*gpus, SMALL_GPU, POCL)
    assert [device.context_for(None, False, place)[0].name[-1] for place in range(4)] == ["0", "1", "0", "1"]
    assert device.context_for("0000:3c:00.0", False, 0) == [gpus[1]]
    nodes = threading.local()
    monkeypatch.setattr(device.socket, "gethostname", lambda: getattr(nodes, "name", "node0"))

    def choose(peers, ranks_per_node, make):
        nodes.name = f"node{peers.number // ranks_per_node}"
        made = make(peers)
        device.refuse_shared_gpus(peers, made[0])
        return made[0].name

    def create(peers):
        return device.create_context(comm=peers)

    assert Team(4).run(lambda peers: choose(peers, 2, create)) == ["GPU 0", "GPU 1"] * 2
    with pytest.raises(InputError, match=r"ranks 0 and 2 of 3 have one GPU, 0000:3b:00.0 of node0.*share_gpus"):
        Team(3).run(lambda peers: choose(peers, 3, create))
    assert Team(2).run(lambda peers: choose(peers, 2, lambda _: [POCL])) == [POCL.name] * 2
    with pytest.raises((DeviceError, RankError)):
        Team(2).run(lambda peers: device.create_context("none" if peers.number else None, comm=peers))


ON_INTEL = FakeDevice(-6, "Portable Computing Language", "cpu-Intel(R) Xeon(R)", CPU, vendor="GenuineIntel")


@pytest.mark.parametrize("query", ["intel", "Intel(R)", " INTEL "])
def test_platform_matches_before_the_device_name(machine, query):
    machine(ON_INTEL, INTEL)
    assert device.create_context(query) == [INTEL]
    assert device.create_context("pocl") == device.create_context("xeon") == [ON_INTEL]
    assert device.create_context("cpu") == [ON_INTEL]
    # A runtime that does not work is not replaced by another one.
    machine(ON_INTEL, INTEL, broken=[INTEL])
    with pytest.raises(DeviceError, match="it cannot build"):
        device.create_context(query)
    # Without such a runtime the name is that of the processor or its vendor.
    machine(POCL, ON_INTEL, BIG_GPU)
    assert device.create_context(query) == device.create_context("genuine") == [ON_INTEL]


def test_simulator_is_never_the_default(machine):
    machine(GRIND)
    with pytest.raises(DeviceError, match="pocl-opencl-icd"):
        device.create_context()
    with pytest.raises(DeviceError):
        device.create_context("gpu")  # it claims to be one
    assert device.create_context("oclgrind") == [GRIND]
    assert device.create_context("0:0") == [GRIND]
    assert not any(d.default for d in device.list_devices())


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("intel", INTEL),
        ("POCL", POCL),
        ("portable", POCL),
        ("cpu", POCL),
        ("gpu", BIG_GPU),
        ("graph", SMALL_GPU),
        ("3:0", SMALL_GPU),
        (" 1:0 ", INTEL),
        ("", BIG_GPU),
    ],
)
def test_choice_by_name_kind_and_index(machine, query, expected):
    machine(GRIND, INTEL, POCL, SMALL_GPU, BIG_GPU)
    assert device.create_context(query) == [expected]


@pytest.mark.parametrize(
    ("devices", "query", "remedy"),
    [
        ([INTEL, POCL], "nvidia", f"leave the device out to use {POCL.platform.name} / {POCL.name}, or install the "),
        ([POCL, BIG_GPU], "amd", f"leave the device out to use {BIG_GPU.platform.name} / {BIG_GPU.name}, or install "),
        ([POCL], "gpu", "install the OpenCL driver of the one that you want"),
        # Indices select one platform, though others may have better devices.
        ([POCL, BIG_GPU], "0:7", "use device='1:0' to use "),
        ([GRIND], "gpu", "pocl-opencl-icd"),
        ([POCL], "pocl", "pocl-opencl-icd"),  # and it does not work
        ([SMALL_GPU, INTEL, POCL], "pocl", f"use {INTEL.platform.name} / "),  # the GPU has no float64
    ],
)
def test_messages_suggest_an_existing_device(machine, monkeypatch, devices, query, remedy):
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    machine(*devices, broken=[POCL] if query == "pocl" else [])
    with pytest.raises(DeviceError) as caught:
        device.create_context(query, fp64=True)
    told = str(caught.value).split("remedy: ")[1]
    assert remedy in told
    assert ("install a CPU runtime" in told) == ("pocl-opencl-icd" in remedy)


def test_float64_skips_devices_without_double_precision(machine):
    machine(SMALL_GPU, POCL)
    assert device.create_context() == [SMALL_GPU]
    assert device.create_context(fp64=True) == [POCL]
    with pytest.raises(DeviceError, match="dtype='float32'"):
        device.create_context("graphics", fp64=True)
    with pytest.raises(DeviceError, match=r"Graphics has no double.*dtype='float32'"):
        device.require_fp64(SMALL_GPU)
    device.require_fp64(SMALL_GPU, "float32")
    device.require_fp64(POCL, np.float64)


def test_messages_list_devices_and_what_to_install(machine):
    machine(INTEL, BIG_GPU, broken=[BIG_GPU])
    with pytest.raises(DeviceError) as caught:
        device.create_context("vendor")
    text = str(caught.value)
    for part in (
        "'vendor'",
        "Tensor 9000: it cannot build",
        "there is 0:0 Intel(R) OpenCL / Some CPU (cpu)",
        "leave the device out",
    ):
        assert part in text
    with pytest.raises(InputTypeError, match="device got a int"):
        device.create_context(0)
    machine()
    with pytest.raises(DeviceError, match=r"knows no platform\n.*pocl-opencl-icd.*\[cpu\]"):
        device.create_context()
    assert "pocl-opencl-icd" in device.format_devices(device.list_devices())


def test_environment_variable_chooses(ctx, monkeypatch):
    entry = next(d for d in device.list_devices() if d.works)
    monkeypatch.setenv("PYOPENCL_CTX", entry.index)
    assert device.create_context().devices[0].name.strip() == entry.name
    monkeypatch.setenv("PYOPENCL_CTX", "987:654")
    with pytest.raises(DeviceError, match="PYOPENCL_CTX='987:654'"):
        device.create_context()
    assert not any(d.default for d in device.list_devices())
    with pytest.raises(DeviceError, match=f"there is {entry.index}"):
        device.create_context("987:654")
    # What the caller passes comes first.
    assert device.create_context(entry.index).devices[0].name.strip() == entry.name


@pytest.mark.slow
def test_real_devices_are_listed_with_their_verdict(ctx):
    entries = device.list_devices()
    default = [d for d in entries if d.default]
    assert [d.name for d in default] == [ctx.devices[0].name.strip()]
    assert default[0].works
    assert default[0].reason == ""
    table = device.format_devices(entries)
    assert all(d.name in table and d.reason[:60] in table for d in entries)
    assert sum(line.startswith("*  ") for line in table.splitlines()) == 1


@pytest.mark.sparse(2)
@pytest.mark.parametrize(
    ("good", "bad", "verdict"),
    [
        ("x * x", "x * undeclared", "cannot build and run"),
        ("sqrt(x * x)", "0 * sqrt(x * x)", "wrong results"),
        ("#if PROBE_FP64", "#define fma(a, b, c) ((a)*(b) + (c))\n#if PROBE_FP64", "rounds the product"),
        ("return a * b;", "return fma(a, b, (T)1e-7);", "contracts"),
    ],
)
def test_probe_detects_broken_runtimes(ctx, monkeypatch, good, bad, verdict):
    assert _probe.probe(ctx.devices[0]) == ""
    assert good in _probe._PROBE
    monkeypatch.setattr(_probe, "_PROBE", _probe._PROBE.replace(good, bad))
    reason = _probe.probe(ctx.devices[0])
    assert verdict in reason
    assert "\n" not in reason
    monkeypatch.setattr(_probe, "_verdicts", {})
    with pytest.raises(DeviceError, match=verdict):
        device.create_context(ctx.devices[0])


def test_probe_detects_contraction(ctx, monkeypatch):
    """PoCL contracts by default where the processor has fma."""
    cpu = Path("/proc/cpuinfo")
    if ctx.devices[0].platform.name.strip() != program.POCL or " fma " not in (cpu.read_text() if cpu.exists() else ""):
        pytest.skip("needs a device that contracts by default")
    monkeypatch.setattr(_probe, "_PROBE", _probe._PROBE.replace("FP_CONTRACT OFF", "FP_CONTRACT ON"))
    assert _probe.CONTRACT_OFF in _probe.probe(ctx.devices[0])
    assert _probe.CONTRACT_OFF in program.source_text("opencl/real.h")


def test_quotients_are_rounded_where_the_device_can(monkeypatch):
    """On GPUs that have the option, all programs get it; it is an error elsewhere."""
    plain, rounding = 0x3F, 0xBF
    for single_fp_config, options in ((plain, ()), (rounding, (program.ROUNDED_QUOTIENTS,))):
        monkeypatch.setattr(FakeDevice, "single_fp_config", single_fp_config, raising=False)
        assert program.device_options(BIG_GPU) == options
        assert program.device_options(POCL) == ()


def test_options_of_the_device_are_built_with(ctx, monkeypatch):
    monkeypatch.setattr(program, "device_options", lambda _: ("-DFROM_DEVICE=7",))
    built = program.compile_text(ctx, "kernel void put(global int *x) { x[0] = FROM_DEVICE; }", ())
    assert built.get_build_info(ctx.devices[0], cl.program_build_info.OPTIONS).count("FROM_DEVICE=7") == 1


@pytest.mark.slow
def test_runtime_that_crashes_is_listed(ctx, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\n"
        "import pyopencl as cl\n"
        "def crash(platform):\n"
        "    print('no memory', file=sys.stderr, flush=True)\n"
        "    os.abort()\n"
        "cl.Platform.get_devices = crash\n"
    )
    assert _probe.crashing_platforms() == {}
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    entries = device.list_devices()
    assert len(entries) == len(cl.get_platforms())
    for entry in entries:
        assert not entry.works
        assert not entry.default
        assert entry.reason == "it ends the process (SIGABRT): no memory"
        assert entry.reason in device.format_devices(entries)


# --- what the runtimes need ---


class FakeFile:
    def __init__(self, path):
        self.name, self._path = path.name, path

    def locate(self):
        return self._path


@pytest.fixture
def pip_runtime(tmp_path, monkeypatch):
    """A fake installation of Intel's runtime, and an environment for it."""
    library = tmp_path / "prefix with space" / "lib" / "libintelocl.so"
    library.parent.mkdir(parents=True)
    library.write_bytes(b"")
    home = tmp_path / "pyopencl"
    (home / ".libs").mkdir(parents=True)
    (home / ".libs" / "pocl.icd").write_text("libpocl-1.so\n")
    (home / ".libs" / "libpocl-1.so").write_bytes(b"")
    files = type("Distribution", (), {"files": [FakeFile(library)]})
    monkeypatch.setattr(_runtimes.metadata, "distribution", lambda name: files)
    monkeypatch.setattr(_runtimes, "_NVIDIA_FOLDERS", (str(tmp_path / "nvidia"),))
    (tmp_path / "vendors").mkdir()
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path / "vendors"))
    monkeypatch.setenv("PYOPENCL_HOME", str(home))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("OCL_ICD_FILENAMES", "")  # so that it is undone
    return library


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the runtime is for Linux")
def test_pip_runtime_is_added_to_the_others(pip_runtime, tmp_path):
    before = Path(os.environ["PYOPENCL_HOME"])
    assert _runtimes.register_runtimes() == [pip_runtime]
    icds = Path(os.environ["PYOPENCL_HOME"], ".libs").glob("*.icd")
    assert sorted(icd.read_text() for icd in icds) == sorted(
        [f"{pip_runtime}\n", f"{before / '.libs' / 'libpocl-1.so'}\n"]
    )
    assert os.environ["OCL_ICD_FILENAMES"] == str(pip_runtime)
    assert os.environ["OCL_ICD_VENDORS"] == str(tmp_path / "vendors")
    # In a child, PyOpenCL resets its variable and the other one is inherited.
    after, os.environ["PYOPENCL_HOME"] = os.environ["PYOPENCL_HOME"], str(before)
    assert _runtimes.register_runtimes() == [pip_runtime]
    assert os.environ["PYOPENCL_HOME"] == after
    assert os.environ["OCL_ICD_FILENAMES"] == str(pip_runtime)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the runtime is for Linux")
def test_registered_runtime_is_not_added_again(pip_runtime, tmp_path):
    (tmp_path / "vendors" / "intel.icd").write_text("/removed/libintelocl.so\n")
    assert _runtimes.register_runtimes() == [pip_runtime]  # its library is gone
    (tmp_path / "vendors" / "intel.icd").write_text(f"{pip_runtime}\n")
    assert _runtimes.register_runtimes() == []


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the paths are Linux's")
def test_driver_without_an_entry_is_registered(pip_runtime, tmp_path):
    """In containers the entry of NVIDIA's driver is often missing."""
    driver = tmp_path / "nvidia" / "libnvidia-opencl.so.1"
    driver.parent.mkdir()
    driver.write_bytes(b"")
    os.environ["OCL_ICD_FILENAMES"] = "/other.so"
    assert _runtimes.register_runtimes() == [pip_runtime, driver]
    icds = Path(os.environ["PYOPENCL_HOME"], ".libs").glob("*.icd")
    assert {f"{pip_runtime}\n", f"{driver}\n"} <= {icd.read_text() for icd in icds}
    assert os.environ["OCL_ICD_FILENAMES"] == f"/other.so:{pip_runtime}:{driver}"
    (tmp_path / "vendors" / "nvidia.icd").write_text("libnvidia-opencl.so.1\n")
    assert _runtimes.register_runtimes() == [pip_runtime]


def test_environment_is_unchanged_without_a_pip_runtime(monkeypatch):
    def missing(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(_runtimes.metadata, "distribution", missing)
    monkeypatch.setattr(_runtimes, "_NVIDIA_FOLDERS", ())
    before = dict(os.environ)
    assert _runtimes.register_runtimes() == []
    assert dict(os.environ) == before


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the cache folder is Linux's")
def test_process_gets_a_cache_if_the_users_is_read_only(tmp_path):
    # A file where the folder should be stops root, too.
    (tmp_path / "file").write_text("")
    code = (
        "import os; from clvoro.opencl import devices as device; "
        "device.create_context(); print(os.environ['XDG_CACHE_HOME'])"
    )
    blocked = {"XDG_CACHE_HOME": str(tmp_path / "file" / "cache"), "TMPDIR": str(tmp_path)}
    given = {key: value for key, value in os.environ.items() if key != "POCL_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env={**given, **blocked}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    folder = Path(done.stdout.strip())
    assert folder.parent == tmp_path
    assert not folder.exists()  # gone with the process


def test_pip_runtime_works_without_others(tmp_path):
    try:
        metadata.distribution("intel-opencl-rt")
    except metadata.PackageNotFoundError:
        pytest.skip('needs `pip install "clvoro[cpu]"`')
    code = "from clvoro.opencl import devices as device; print(device.create_context('intel').devices[0].platform.name)"
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OCL_", "OPENCL_"))}
    environment["OCL_ICD_VENDORS"] = str(tmp_path)  # no system-wide runtime
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == "Intel(R) OpenCL", done.stderr
