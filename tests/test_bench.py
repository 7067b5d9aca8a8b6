"""The scripts of bench/ that show what the README says, each on small meshes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).parent.parent / "bench"
pytestmark = pytest.mark.skipif(not BENCH.is_dir(), reason="the tests lie outside a source tree")


def records(script, *options, code=0):
    """Run a script; return what it prints with --json."""
    done = subprocess.run([sys.executable, str(BENCH / script), "--json", *options], capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted(p.name for p in BENCH.glob("[a-z]*.py")))
def test_every_script_runs_from_a_checkout(script, tmp_path):
    """From any folder, with nothing but the script's own way to the package."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    command = [sys.executable, str(BENCH / script), "--help"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert script in done.stdout.splitlines()[0]


@pytest.mark.slow
def test_adaptive():
    """Within the script's own targets at 2,000 cells: it fails above them."""
    options = ("--spaces", "plane", "--functions", "kink", "--cells", "2000", "--cycles", "3")
    rows = records("adaptive.py", *options)
    assert rows[0]["mesh"] == "clvoro"
    assert rows[0]["uniform2"] > 2 * rows[0]["L2"]


@pytest.mark.slow
def test_following():
    followed, uniform = records("following.py", "--cells", "500", "--cycles", "12", "--uniform", "500")
    assert followed["mass"] < 1e-13
    assert followed["extrema"] <= 0
    assert followed["drift"] < 0.02
    assert followed["l1"] < 0.7 * uniform["l1"]


@pytest.mark.slow
def test_peers():
    options = ("--sizes", "300", "--sets", "uniform,cubed", "--dims", "2", "--peers", "clvoro", "--samples", "50")
    rows = records("peers.py", *options)
    assert [r["note"] for r in rows] == ["right"] * 2
    assert max(r["worst"] for r in rows) < 1e-6


@pytest.mark.slow
def test_transfer():
    rows = records("transfer.py", "--sizes", "500,4000", "--dims", "2", "--repeat", "1")
    first, second, free = (r for r in rows if r["rate"] is not None)
    assert first["rate"] > 0.8
    assert min(second["rate"], free["rate"]) > 1.6
    assert first["beyond"] == second["beyond"] == 0
    assert max(r["mass"] for r in rows) < 1e-12


@pytest.mark.slow
def test_shallow_water():
    # The script itself fails if a run is unstable, or a balance is not round-off.
    rows = records(
        "shallow_water.py", "--quick", "--reference", "10242", "--meshes", "uniform,uniform+2,icosahedral+50"
    )
    runs = [r for r in rows if "stable" in r]
    assert len(runs) == 13
    assert len(rows) == 26
    l2 = {(r["case"], r["mesh"], r["cells"]): r.get("l2") for r in runs}
    assert l2.pop((5, "icosahedral+50", 10242)) is None, "the reference of its case"
    assert l2[2, "uniform", 2562] < l2[2, "uniform", 642] / 1.8
    # Centroids of cells as generators make the difference between the meshes.
    assert l2[2, "uniform+2", 2562] < l2[2, "uniform", 2562] / 2
    assert l2[2, "uniform+2", 2562] < 3 * l2[2, "icosahedral+50", 2562]


@pytest.mark.slow
def test_sheets(tmp_path):
    rows = records("sheets.py", "--only", "fields", "--effort", "fast", "--out", str(tmp_path))
    assert len(rows) == 6
    assert (tmp_path / "fields.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_methods():
    """On the paper's case: Lloyd misses the sizes, transport maps stretch cells, the default has both right."""
    methods = "lloyd; coupled; monge-ampere; adaptive, default; insertion and deletion"
    rows = records("methods.py", "--fields", "paper", "--methods", methods)
    found = {r["method"]: (r["mean_error"], r["mean_quality"]) for r in rows}
    assert len(found) == 5
    assert found["lloyd"][0] > 0.5
    assert found["monge-ampere"][0] < 0.1
    assert found["monge-ampere"][1] < 0.9
    assert found["coupled"][1] > 0.93
    assert found["adaptive, default"][0] < 0.005
    assert found["adaptive, default"][1] > 0.96


@pytest.mark.slow
def test_a_table_is_markdown():
    command = [sys.executable, str(BENCH / "transfer.py"), "--sizes", "300", "--dims", "3", "--repeat", "1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if line.startswith("|")]
    assert len(lines) == 5
    assert len({line.count("|") for line in lines}) == 1


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("simpleFoam") is None, reason="needs OpenFOAM")
def test_cylinder():
    rows = records("cylinder.py", "--cells", "1500", "--meshers", "clvoro; clvoro, layers; blockMesh; followed, forces")
    assert [r["mesher"] for r in rows] == ["clvoro", "clvoro, layers", "blockMesh", "followed, forces"]
    # In percent: 0.1, 0.1 and 0.6 for drag, and at most 3 for the pressure difference.
    assert all(abs(r["drag"][0]) < 0.8 for r in rows)
    assert all(abs(r["pressure"][0]) < 4 for r in rows)
    assert all(r["cells"][0] == pytest.approx(1500, rel=0.02) for r in rows)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("simpleFoam") is None, reason="needs OpenFOAM")
def test_bodies(tmp_path):
    options = ("--uniform", "3000", "--graded", "700", "--adapted", "700", "--cycles", "3", "--pictures", str(tmp_path))
    uniform, graded, adapted = records("bodies.py", *options)
    assert abs(adapted["error"][0]) < 0.4 * abs(uniform["error"][0])
    assert abs(graded["error"][0]) < 0.5 * abs(uniform["error"][0])
    assert (tmp_path / "airfoil.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_outlines():
    """Sizes are met on staircases, too: mean |e| at walls was 0.14 where a face ended in each of their corners."""
    options = ("--kinds", "shores", "--sizes", "3", "--seeds", "2", "--domains", "given,simplified")
    given, simplified = records("outlines.py", *options)
    assert given["boundary_mean_error"] < 0.05
    assert given["accepted"] == simplified["accepted"] == 2
    assert given["left_out"] > 0
    assert simplified["boundary_mean_quality"] > given["boundary_mean_quality"]


@pytest.mark.slow
def test_truncation_of_trisk():
    """Near pentagons the gradient of the kinetic energy is off by a constant over dx, and elsewhere by less."""
    coarse, fine = records("shallow_water.py", "--truncation", "--cells", "642,2562", "--meshes", "icosahedral+50")
    assert coarse["odd"] == fine["odd"] == 12
    assert fine["kinetic"][0] > 1.6 * coarse["kinetic"][0]
    assert fine["kinetic"][1] < 0.2 * fine["kinetic"][0]
