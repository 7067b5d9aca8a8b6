"""What README.md shows is run as it stands there."""

import re
from pathlib import Path

import matplotlib
import pytest

from clvoro.cli import command as cli
from clvoro.cli.cases import Case

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


SECTION = TEXT.split("## Command line")[1].split("\n## ")[0]


@pytest.mark.parametrize("option", sorted(set(re.findall(r"`(--[a-z-]+)", SECTION))))
def test_options_exist(option, capsys):
    with pytest.raises(SystemExit):
        cli.main(["run", "--help"])
    assert option in capsys.readouterr().out
