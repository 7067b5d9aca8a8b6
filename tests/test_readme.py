"""What README.md shows runs as it stands there, and README.md is short."""

import re
from pathlib import Path

import matplotlib

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
MOST = 8000
"""Bytes."""


def test_python_blocks_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    blocks = re.findall(r"^```python\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    assert blocks
    names = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    assert {p.name for p in tmp_path.iterdir()} == {"mesh.vtu", "quality.png"}
    assert "cells, mean |e|" in capsys.readouterr().out


def test_pictures_are_there():
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", TEXT)
    assert pictures
    for picture in pictures:
        assert (ROOT / picture).read_bytes().startswith(b"\x89PNG")


def test_is_short():
    assert len(TEXT.encode()) <= MOST
