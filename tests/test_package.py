"""The package as it is shipped: wheel, sdist and installs have all kernels, wherever they lie."""

import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SOURCES = ("clvoro", "cl_kernels", "pyproject.toml", "README.md", "LICENSE")

# Prints the folder that its kernels came from.
PROGRAM = """
import numpy as np
import clvoro
from clvoro.opencl.program import kernel_folder

points = np.random.default_rng(7043).random((60, 2))
diagram = clvoro.Adapter().diagram(clvoro.Box((0, 0), (1, 1)), points)
assert abs(diagram.volumes.sum() - 1) < 1e-12  # float64; 60 terms
print(kernel_folder())
"""

pytestmark = pytest.mark.skipif(not (ROOT / "pyproject.toml").is_file(), reason="the tests lie outside a source tree")


def shipped(folder):
    """Files under `folder` that belong into a package, relative to ROOT."""
    files = (p.relative_to(ROOT) for p in (ROOT / folder).rglob("*") if p.is_file())
    return {p.as_posix() for p in files if "__pycache__" not in p.parts}


def build(source, target, kind):
    pytest.importorskip("hatchling")
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(target)]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    (built,) = target.glob("*.whl" if kind == "wheel" else "*.tar.gz")
    return built


def run_program(python, cwd, **environment):
    """Run PROGRAM far from the checkout; return the folder of its kernels."""
    inherited = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [str(python), "-c", PROGRAM], cwd=cwd, env={**inherited, **environment}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return Path(done.stdout.strip())


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build(ROOT, tmp_path_factory.mktemp("wheel"), "wheel")


@pytest.fixture(scope="module")
def sdist(tmp_path_factory):
    return build(ROOT, tmp_path_factory.mktemp("sdist"), "sdist")


def contents(wheel):
    """Map each file of the package in a wheel to its bytes, the wheel's own metadata left out."""
    with zipfile.ZipFile(wheel) as archive:
        names = [n for n in archive.namelist() if ".dist-info/" not in n]
        return {name: archive.read(name) for name in names}


def test_wheel_holds_package_and_kernels_and_no_more(wheel):
    kernels = {f"clvoro/{name}" for name in shipped("cl_kernels")}
    assert kernels
    found = contents(wheel)
    assert set(found) == shipped("clvoro") | kernels
    for name in kernels:
        assert found[name] == (ROOT / name.removeprefix("clvoro/")).read_bytes()


@pytest.mark.slow
def test_sdist_holds_sources_and_builds_the_same_wheel(sdist, wheel, tmp_path):
    with tarfile.open(sdist) as archive:
        names = {n.split("/", 1)[1] for n in archive.getnames() if "/" in n}
        archive.extractall(tmp_path)
    for folder in ("clvoro", "cl_kernels", "tests"):
        assert shipped(folder) <= names
    assert {"pyproject.toml", "README.md", "LICENSE"} <= names
    (source,) = tmp_path.iterdir()
    again = build(source, tmp_path, "wheel")
    assert contents(again) == contents(wheel)


def test_unpacked_wheel_runs_in_a_path_with_a_space(wheel, tmp_path):
    place = tmp_path / "site packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(place)
    folder = run_program(sys.executable, tmp_path, PYTHONPATH=str(place))
    assert folder == place / "clvoro" / "cl_kernels"


@pytest.mark.slow
def test_checkout_runs_in_a_path_with_a_space(tmp_path):
    place = copy_sources(tmp_path / "my checkout")
    assert run_program(sys.executable, place) == place / "cl_kernels"


def copy_sources(place):
    place.mkdir()
    for name in SOURCES:
        source = ROOT / name
        ignore = shutil.ignore_patterns("__pycache__")
        if source.is_dir():
            shutil.copytree(source, place / name, ignore=ignore)
        else:
            shutil.copy(source, place / name)
    return place


@pytest.mark.slow  # installs the dependencies from the package index, three times
@pytest.mark.parametrize("how", ["wheel", "folder", "editable"])
def test_fresh_environment(how, wheel, tmp_path):
    environment = tmp_path / "my environment"
    venv.create(environment, with_pip=True)
    python = environment / ("Scripts" if os.name == "nt" else "bin") / "python"
    source = copy_sources(tmp_path / "my checkout")
    what = {"wheel": [str(wheel)], "folder": [str(source)], "editable": ["-e", str(source)]}[how]
    install = [str(python), "-m", "pip", "install", "--quiet", *what]
    done = subprocess.run(install, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    folder = run_program(python, tmp_path)
    assert folder.is_relative_to(source if how == "editable" else environment)
    script = python.with_name("clvoro")
    done = subprocess.run([str(script), "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stdout[:7]) == (0, "clvoro "), done.stderr
