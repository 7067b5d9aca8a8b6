"""The documentation: code on its pages and its examples run, and what it names exists."""

import ast
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest

import clvoro
from clvoro.cli import command
from clvoro.cli.cases import Case

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="the tests lie outside a source tree")
PAGES = {p.relative_to(DOCS).as_posix(): p.read_text() for p in sorted(DOCS.rglob("*.md"))}
OWN = {**PAGES, **{n: (ROOT / n).read_text() for n in ("README.md", "CONTRIBUTING.md") if (ROOT / n).is_file()}}
SOLVERS = ("fipy", "flopy")
"""Programs that pages and examples import, of the extra `solvers`."""
EXAMPLES = sorted((DOCS / "examples").rglob("*.py"))


def needs(text):
    """Skip the test if `text` imports a solver that is not installed."""
    for name in SOLVERS:
        if re.search(rf"^import {name}$", text, re.MULTILINE):
            pytest.importorskip(name)


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", OWN[page], re.MULTILINE | re.DOTALL)


def rows(page):
    """Return the cells of all table rows of a page, but for heads and rules."""
    lines = [line.strip("| ").split(" | ") for line in PAGES[page].splitlines() if line.startswith("| ")]
    return [[cell.strip(" |") for cell in line] for line in lines]


def test_members_that_the_reference_leaves_out_exist():
    given = re.search(r'_INTERNAL = """(.*?)"""', (DOCS / "conf.py").read_text(), re.DOTALL)[1].split()
    source = "".join(path.read_text() for path in Path(clvoro.__file__).parent.rglob("*.py"))
    for name in given:
        *kinds, member = name.split(".")
        assert all(re.search(rf"^class {kind}\b", source, re.MULTILINE) for kind in kinds), name
        assert re.search(rf"^    (def )?{member}\b", source, re.MULTILINE), name


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in OWN if blocks(p, "python")])
def test_python_on_pages_runs(page, tmp_path, monkeypatch):
    needs(OWN[page])
    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg")
    names = {}
    for block in blocks(page, "python"):
        exec(compile(block, page, "exec"), names)


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "toml")])
def test_cases_on_pages_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number, block in enumerate(blocks(page, "toml")):
        Case.from_toml(block, page)
        path = tmp_path / f"case{number}.toml"
        path.write_text(block)
        run = ["run", str(path), "--steps", "1", "--cells", "100", "--no-report", "--quiet"]
        assert command.main(run) == command.OK


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda p: p.stem)
def test_example_runs_and_draws(example, tmp_path):
    needs(example.read_text())
    code = (
        "import matplotlib, runpy, sys, warnings; matplotlib.use('Agg'); from matplotlib import pyplot; "
        "import clvoro.errors as e; [warnings.simplefilter('error', w) for w in vars(e).values() "
        "if isinstance(w, type) and issubclass(w, Warning)]; "
        "runpy.run_path(sys.argv[1]); assert pyplot.get_fignums()"
    )
    done = subprocess.run([sys.executable, "-c", code, str(example)], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("option", sorted(set(re.findall(r"`(--[a-z-]+)", PAGES.get("guide/command_line.md", "")))))
def test_options_of_the_command_exist(option, capsys):
    with pytest.raises(SystemExit):
        command.main(["run", "--help"])
    assert option in capsys.readouterr().out


def test_cases_of_the_command_exist():
    section = PAGES["guide/command_line.md"].split("## Built-in cases")[1]
    named = set(re.findall(r"^\| `(\w+)`", section, re.MULTILINE))
    there = {p.stem for p in (ROOT / "clvoro" / "cli" / "cases").glob("*.toml")}
    assert named == there


def names_in(path):
    """Return functions, classes and ``Class.method`` of a module."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{m.name}" for m in node.body if isinstance(m, ast.FunctionDef)}
    return found


def kernels_in(path):
    return set(re.findall(r"^(?:(?:kernel|inline) )?\w+ (\w+)\(", path.read_text(), re.MULTILINE))


def unknown(cell, folder):
    """Return what a cell of the tables names and is not there: paths, and after each what is in that file."""
    missing, there = [], set()
    for name in re.findall(r"`([^`]+)`", cell):
        if "/" in name or name.endswith((".py", ".cl", ".h")):
            path = folder / name
            if not path.exists():
                missing.append(name)
                there = set()
            elif path.suffix in (".py", ".cl", ".h"):
                there = names_in(path) if path.suffix == ".py" else kernels_in(path)
        elif name not in there:
            missing.append(name)
    return missing


def test_where_is_what_names_what_is_there():
    missing = []
    tables = [row for row in rows("developer/where.md") if "`" in "".join(row[1:])]
    assert len(tables) > 40
    for row in tables:
        missing += unknown(row[1], ROOT / "clvoro")
        missing += unknown(row[2], ROOT / "cl_kernels") if len(row) > 2 else []
    assert not missing, missing


def test_where_is_what_looks(tmp_path):
    (tmp_path / "a.py").write_text("class C:\n    def m(self): ...\n\ndef f(): ...\n")
    (tmp_path / "a.cl").write_text("kernel void k(int n)\n{\n}\n")
    assert unknown("`a.py` `C.m`, `f`; `a.cl` `k`", tmp_path) == []
    assert unknown("`a.py` `C.n`; `b.py`; `a.cl` `f`", tmp_path) == ["C.n", "b.py", "f"]


def test_every_equation_of_the_method_has_its_place():
    numbers = {n for n in re.findall(r"\((\d\.\d)\)", PAGES["theory/method.md"])}
    assert numbers <= set(re.findall(r"\((\d\.\d)\)", PAGES["developer/where.md"]))


def test_architecture_lists_the_packages_in_their_order():
    from tests.test_layout import ORDER

    listed = [row[0].strip("`") for row in rows("developer/architecture.md") if row[0].startswith("`")]
    folders = {p.parent.name for p in (ROOT / "clvoro").glob("*/__init__.py")}
    assert listed == [name for name in ORDER if name in folders]
    picture = (DOCS / "developer" / "packages.svg").read_text()
    assert folders <= set(re.findall(r">([a-z_]+)</text>", picture))


@pytest.mark.parametrize("page", sorted(OWN))
def test_links_and_commands_lead_somewhere(page):
    text = OWN[page]
    folder = ROOT if page in ("README.md", "CONTRIBUTING.md") else (DOCS / page).parent
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (folder / target).exists(), target
    for target in re.findall(r"\{doc\}`(?:[^`<]*<)?([^`>]+)>?`", text):
        made = "gallery/" in target  # when the site is built, from the examples
        path = folder / (target.replace("gallery/", "examples/") + ".py" if made else f"{target}.md")
        assert path.is_file() or path.with_suffix(".rst").is_file(), target
    for script in re.findall(r"python (bench/\w+\.py)", text) + re.findall(r"(tests/[\w/]+\.py)", text):
        assert (ROOT / script).is_file(), script
    for module in re.findall(r"-m (tests\.[\w.]+)", text):
        assert (ROOT / (module.replace(".", "/") + ".py")).is_file(), module


def test_public_names_are_in_the_reference():
    listed = "".join(p.read_text() for p in (DOCS / "api").glob("*.rst"))
    names = set(re.findall(r"^   (?:clvoro\.)?(?:\w+\.)*(\w+)$", listed, re.MULTILINE))
    assert set(clvoro.__all__) - {"curves", "profile", "earth", "foam", "sizing", "ClvoroError", "Interrupted"} <= names
    assert {n for n in clvoro.sizing.__all__ if n not in ("Sizing", "generate_code")} <= names


@pytest.mark.parametrize("page", sorted((DOCS / "api").glob("*.rst")), ids=lambda p: p.stem)
def test_what_api_pages_list_exists(page):
    module = ""
    for line in page.read_text().splitlines():
        name = line.strip()
        if line.startswith(".. currentmodule:: "):
            module = line.split()[-1] + "."
        elif re.fullmatch(r"   [\w.]+", line) and not (page.parent / f"{name}.rst").is_file():
            assert pydoc.locate(module + name), name
