"""Periodic boxes with holes: faces lie on the outlines, and the cells inside are removed."""

import numpy as np
import pytest
import shapely

import clvoro
from clvoro.cli.cases import Case
from clvoro.cli.cases.files import write_toml
from clvoro.errors import InputError, InputTypeError

TUBE, WEDGE = clvoro.curves.circle((0, 0), 0.2), [(0.8, 0.35), (1.3, 0.5), (0.8, 0.65)]
BOTH = clvoro.Box((0, 0), (2, 1), periodic=True)


@pytest.fixture(scope="module")
def mesh(ctx):
    domain = BOTH.without([clvoro.curves.circle((0, 0), 0.2, name="tube"), WEDGE])
    size = clvoro.sizing.Distance(domain.holes, 0.04, growth=1.2, h_max=0.1)
    evaluated, on_host = [], type(size)._evaluate
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(size), "_evaluate", lambda field, x: evaluated.append(len(x)) or on_host(field, x))
        found = clvoro.Adapter(ctx).run(domain, size, "fast", seed=1)
    assert sum(evaluated) < 5_000  # cells are counted on the device
    return domain, found


def test_a_mesh_ends_at_holes_across_seams(mesh):
    domain, found = mesh
    d, faces = found.diagram, found.diagram.faces
    assert found.check().ok
    assert d.domain.boundary_names == ("tube", "hole-2")
    assert d.volumes.sum() == pytest.approx(2 - domain.holes.measure, rel=2e-3)
    assert np.abs(found.size_error).mean() < 0.06
    walls = faces.neighbor < 0
    ends = faces.points[faces.corners.reshape(-1, 2)]
    which = d.domain.boundary_index[-1 - faces.neighbor[walls]]
    x = domain.wrap(ends[walls][which == 0].reshape(-1, 2))
    corners = np.array([(a, b) for a in (0, 2) for b in (0, 1)])
    away = np.linalg.norm(x[:, None] - corners, axis=2).min(axis=1)
    assert np.abs(away - 0.2).max() < 1e-6  # the tolerance of curves
    outline = shapely.LinearRing(WEDGE)
    assert shapely.distance(shapely.points(ends[walls][which == 1]), outline).max() < 1e-9
    assert faces.area[walls][which == 1].sum() == pytest.approx(outline.length, rel=1e-9)
    assert (domain.holes.hole_of(d.points) < 0).all()


def test_solvers_get_cyclics_and_holes(mesh, tmp_path):
    _, found = mesh
    assert found.check("openfoam").ok
    found.save(tmp_path / "case.foam")
    text = (tmp_path / "constant" / "polyMesh" / "boundary").read_text()
    assert text.count("cyclic;") == 4
    assert all(f"    {name}\n" in text for name in ("tube", "hole-2"))
    for name in ("a.npz", "a.vtu"):
        found.save(tmp_path / name)
        assert clvoro.load(tmp_path / name).domain == found.domain


def test_one_direction_with_walls(ctx):
    domain = clvoro.Box((0, 0), (1, 1), (False, True), {"inlet": "xMin"}).without([[(0.4, -0.1), (0.6, 0), (0.4, 0.1)]])
    found = clvoro.Adapter(ctx).run(domain, 0.08, "fast")
    assert found.domain.boundary_names == ("hole-1", "inlet", "xMax")
    assert found.diagram.volumes.sum() == pytest.approx(0.98, rel=1e-5)
    assert found.check("openfoam").ok


@pytest.mark.parametrize(
    ("holes", "names", "error", "says"),
    [
        ([], None, InputError, "holes is empty"),
        (3, None, InputTypeError, "expected a list of rings"),
        ([[(0, 0), (1, 1)]], None, InputError, r"holes\[0\]: "),
        ([TUBE], {"tube": 1}, InputError, "hole 1"),
    ],
)
def test_wrong_holes(holes, names, error, says):
    with pytest.raises(error, match=says):
        BOTH.without(holes, names)


def test_holes_in_a_case():
    text = "[domain]\nlower = [0, 0]\nupper = [2, 1]\nperiodic = true\nholes = [{ kind = 'circle', center = [0, 0], "
    text += "radius = 0.2 }, [[0.8, 0.4], [1.3, 0.5], [0.8, 0.6]]]\nhole_names = { tube = 0 }\n"
    text += "[size]\nkind = 'constant'\nvalue = 0.1\n"
    case = Case.from_toml(text, "my.toml")
    wanted = BOTH.without([TUBE, [(0.8, 0.4), (1.3, 0.5), (0.8, 0.6)]])
    for one in (case, Case.from_toml(write_toml(case.table), "my.toml")):
        assert one.domain.holes.describe() == wanted.holes.describe()
        assert one.domain.holes.parts.names == ("tube", "hole-2")
