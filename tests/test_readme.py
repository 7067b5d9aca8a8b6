"""What README.md shows is run as it stands there."""

import re
from pathlib import Path

import matplotlib
import pytest

from clvoro import cli
from clvoro.cases import Case

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


def test_python_blocks_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    assert len(blocks("python")) >= 1
    names = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    written = {"mesh.vtu", "mesh.nc", "quality.png", "polyMesh", "layers.png", "torus.vtu"}
    assert {p.name for p in tmp_path.iterdir()} == written
    assert re.search(r"\d+ cells, \d+ inner faces, area 3\.750000", capsys.readouterr().out)


def test_case_blocks_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert len(blocks("toml")) >= 1
    for number, block in enumerate(blocks("toml")):
        Case.from_toml(block, "README.md")
        path = tmp_path / f"case{number}.toml"
        path.write_text(block)
        run = ["run", str(path), "--steps", "1", "--cells", "200", "--no-report", "--quiet"]
        assert cli.main(run) == cli.OK


def test_pictures_exist():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", TEXT)
    assert pictures
    for picture in pictures:
        assert (ROOT / picture).read_bytes().startswith(b"\x89PNG")


def test_map_names_files_that_are_there_and_all_stages():
    section = TEXT.split("### Where it is in the code")[1].split("\n## ")[0]
    folders = [ROOT / f for f in ("clvoro", "clvoro/sizing", "cl_kernels", "cl_kernels/common")]
    named = set(re.findall(r"`(\w+\.(?:py|cl|h))`", section)) - {"x.py"}
    assert len(named) > 50
    for name in named:
        assert any((folder / name).is_file() for folder in folders), name
    kernels = {p.name for p in (ROOT / "cl_kernels").glob("*.cl")} - {"copy.cl"}  # of a profile
    assert kernels <= named
    assert {Path(k).with_suffix(".py").name for k in kernels} - {
        "hulls.py", "walks.py", "gradation.py", "sizing.py", "primitives.py"
    } <= named  # fmt: skip


SECTION = TEXT.split("## Command line")[1].split("\n## ")[0]


@pytest.mark.parametrize("option", sorted(set(re.findall(r"`(--[a-z-]+)", SECTION))))
def test_options_exist(option, capsys):
    with pytest.raises(SystemExit):
        cli.main(["run", "--help"])
    assert option in capsys.readouterr().out
