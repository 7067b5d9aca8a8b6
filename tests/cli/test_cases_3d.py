"""The built-in cases in three dimensions, surfaces that a case names, and what is refused."""

import json

import numpy as np
import pytest

from clvoro.adaptation.sampling.start import count_cells
from clvoro.cli import command as cli
from clvoro.cli.cases import Case, load_case
from clvoro.io import load
from clvoro.sizing import Sizing
from tests.reference import patch

CASE = """
[domain]
lower = [-1, -1, -1]
upper = [1, 1, 1]

[size]
kind = "distance"
h_min = 0.25
slope = 0.3

[[size.shapes]]
kind = "surface"
file = "part.off"
closed = true
"""
CORNERS = [(x, y, z) for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)]
QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
TRIANGLES = [t for a, b, c, d in QUADS for t in ((a, b, c), (a, c, d))]


def off(corners, triangles):
    lines = ["OFF", f"{len(corners)} {len(triangles)} 0"]
    lines += [" ".join(map(str, c)) for c in corners]
    return "\n".join(lines + ["3 " + " ".join(map(str, t)) for t in triangles]) + "\n"


def twice():
    """Two cubes, the second one pushed half into the first."""
    moved = [(x + 0.4, y + 0.3, z + 0.2) for x, y, z in CORNERS]
    return off(CORNERS + moved, TRIANGLES + [tuple(i + 8 for i in t) for t in TRIANGLES])


HERE = ("mine.toml", CASE)


def call(*arguments):
    return cli.main([str(a) for a in arguments])


# The built-in cases.


@pytest.mark.parametrize(
    ("name", "least", "most"), [("sphere", 15e3, 4e4), pytest.param("surface", 2e4, 4e4, marks=pytest.mark.slow)]
)
def test_counts(ctx, name, least, most):
    case = load_case(name)
    field = Sizing(patch.make_engine(ctx, dim=3), case.domain, case.size_field())
    assert least < count_cells(field, case.domain) < most


def test_the_body_is_the_formula_it_names():
    """u -> 0.5 (1 + 0.35 s^5 cos(5 phi)) u, z times 0.6; closed, and well inside its box."""
    case = load_case("surface")
    (body,) = case.size_field().shapes
    assert body.closed
    assert len(body.crossings()) == 0
    p = body.vertices / [1, 1, 0.6]
    length = np.linalg.norm(p, axis=1)
    s = np.hypot(p[:, 0], p[:, 1]) / length
    expected = 0.5 * (1 + 0.35 * s**5 * np.cos(5 * np.arctan2(p[:, 1], p[:, 0])))
    assert length == pytest.approx(expected, abs=5e-5)  # five decimals
    assert (body.vertices > np.array(case.domain.lower) + 0.3).all()
    assert (body.vertices < np.array(case.domain.upper) - 0.3).all()
    assert case.size_field()(body.vertices) == pytest.approx(0.025)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere", pytest.param("surface", marks=pytest.mark.slow)])
def test_run_writes_everything(here, capsys, name):
    assert call("run", name, "--cells", 300, "--effort", "fast", "--json") == cli.OK
    out = here / "out" / name
    result = load(out / "mesh.npz")
    result.check().demand()
    assert len(result.points) == 300
    assert json.loads(capsys.readouterr().out)["cells"] == 300
    pictures = {p.stem for p in (out / "pictures").iterdir()}
    assert {"size", "cells", "cutaway", "quality", "history", "distributions"} <= pictures
    assert (out / "report.html").stat().st_size > 10_000
    again = Case.from_toml((out / "case.toml").read_text(), "case.toml", out)
    assert again.domain == load_case(name).domain
    if name == "surface":
        assert (out / "lobes.obj").is_file(), "the case's file is copied along"


@pytest.mark.slow
def test_printed_case_runs_elsewhere(here, capsys):
    """Its surface is found among the built-in cases' files, unless one of that name lies beside it."""
    assert call("cases", "surface") == cli.OK
    (here / "my.toml").write_text(capsys.readouterr().out)
    options = ("--cells", 60, "--steps", 1, "--no-report", "--quiet")
    assert call("run", "my.toml", *options) == cli.OK
    (here / "lobes.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert call("run", "my.toml", *options) == cli.BAD_INPUT
    assert "is open: 3 edges" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("surfaces", "names", "extent"),
    [("'part.off'", ("surface-1",), 1.0), ("[{ file = 'part.off', name = 'core', units = 'cm' }]", ("core",), 0.01)],
)
def test_surfaces_inside_are_in_case_files(here, surfaces, names, extent):
    (here / "part.off").write_text(off(CORNERS, TRIANGLES))
    (here / "mine.toml").write_text(
        f"size = 0.3\n[domain]\nlower = [-1, -1, -1]\nupper = [1, 1, 1]\nsurfaces = {surfaces}"
    )
    case = load_case("mine.toml")
    (here / "copy").mkdir()
    for borders in (case.domain.borders, load_case(case.write(here / "copy")).domain.borders):
        assert borders.names == names
        assert np.ptp(borders.surface.vertices, axis=0) == pytest.approx([extent] * 3)
    assert case.copies() == ["part.off"]


# Bad input.


@pytest.mark.parametrize(
    ("part", "named"),
    [
        (off(CORNERS, TRIANGLES[:-1]), "is open: 3 edges belong to a single triangle"),
        (twice(), "intersects itself"),
        (off(CORNERS, []), "no triangles"),
        ("", "cannot be read as OFF"),
        ("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "part.off"),
        (off([(0, 0, 0)] * 8, TRIANGLES), "none of which has an area"),
        (off([("nan", 0, 0), *CORNERS[1:]], TRIANGLES), "part.off"),
        (None, "no surface file"),
    ],
)
def test_bad_surfaces(here, capsys, part, named):
    """Refused in one message, and nothing is written."""
    if part is not None:
        (here / "part.off").write_text(part)
    before = sorted(here.iterdir())
    assert call("run", "mine.toml", "--quiet") == cli.BAD_INPUT
    error = capsys.readouterr().err
    assert error.startswith("clvoro: ")
    assert named in error
    assert "part.off" in error
    assert sorted(here.iterdir()) == before


def test_open_surfaces_will_do_for_distances(here):
    (here / "part.off").write_text(off(CORNERS, TRIANGLES[:-1]))
    (here / "mine.toml").write_text(CASE.replace("closed = true", ""))
    assert call("run", "mine.toml", "--steps", 2, "--no-report", "--quiet") == cli.OK
    load(here / "out/mine/mesh.npz").check().demand()


def test_gap_is_closed_by_join(here):
    """Each triangle with corners of its own, a hair apart."""
    rng = np.random.default_rng(8)
    corners = np.array([CORNERS[i] for t in TRIANGLES for i in t]) + rng.normal(0, 1e-7, (36, 3))
    (here / "part.off").write_text(off(corners, np.arange(36).reshape(-1, 3)))
    assert call("run", "mine.toml", "--quiet") == cli.BAD_INPUT
    (here / "mine.toml").write_text(CASE + "join = 1e-5\n")
    assert load_case("mine.toml").size_field().shapes[0].closed


@pytest.mark.parametrize(
    ("old", "new"), [pytest.param("0.25", "1e-4", marks=pytest.mark.slow), ("slope = 0.3", "slope = 1e-9")]
)
def test_more_cells_than_memory(here, capsys, old, new):
    """What a run would need is said before it begins."""
    (here / "part.off").write_text(off(CORNERS, TRIANGLES))
    (here / "mine.toml").write_text(CASE.replace(old, new).replace("0.25", "1e-3"))
    assert call("run", "mine.toml", "--quiet") == cli.FAILED
    assert "GiB on the device" in (error := capsys.readouterr().err) or "32-bit" in error
    assert "cells" in error
    assert not list((here / "out").rglob("*.*")), "nothing half written"
