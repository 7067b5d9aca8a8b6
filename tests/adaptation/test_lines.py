"""Faces of the cells of a run lie on the lines of its domain, and regions between them are in all files."""

import warnings

import numpy as np
import pytest

import clvoro
from clvoro.errors import InputError, MismatchWarning
from clvoro.geometry.lines.pairs import place_pairs

from ..geometry.test_lines import BED, BOX, FAULT, PAIRS


@pytest.fixture(scope="module")
def mesh(ctx):
    return clvoro.Adapter(ctx).run(BOX.with_lines([FAULT, BED]), 0.08, "fast", seed=1)


def covered(mesh):
    """Return the share of the lines that faces lie on."""
    d = mesh.diagram
    return d.faces.area[d.border_faces].sum() / d.domain.borders.inside(d.domain).length


@pytest.mark.sparse(4)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("kind", list(PAIRS))
def test_faces_cover_the_lines(ctx, dtype, kind):
    domain, lines = PAIRS[kind]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", clvoro.errors.SizeErrorWarning)
        mesh = clvoro.Adapter(ctx, dtype).run(domain.with_lines(lines), 0.08, "fast")
    assert covered(mesh) == pytest.approx(1, abs=1e-9 if dtype == "float64" and kind != "crossing" else 0.01)
    assert np.abs(mesh.size_error).mean() < 0.06
    assert mesh.diagram.volumes.sum() == pytest.approx(domain.measure, rel=1e-6)


def test_levels_counts_and_wells_go_with_lines(ctx):
    wells = [(0.3, 0.9), (1.7, 0.2)]
    deep = clvoro.MultilevelOptions(levels=1)
    domain = BOX.with_lines([FAULT, BED])
    adapter, given = clvoro.Adapter(ctx), {"fixed": wells, "n_cells": 700, "options": deep}
    mesh = adapter.run(domain, 0.06, "fast", **given)
    assert len(mesh) == 700
    # A number of cells scales all sizes, in narrow places, too.
    scaled = adapter.run(domain, 6.0, "fast", **given, max_steps=1)
    assert 100 * scaled.size_factor == pytest.approx(mesh.size_factor, rel=0.05)
    assert np.array_equal(mesh.points[:2], wells)
    assert covered(mesh) == pytest.approx(1, abs=1e-9)


def test_generators_leave_the_balls(ctx, mesh):
    """One launch against NumPy: out of each ball in turn."""
    from clvoro.adaptation.motion import Moving
    from clvoro.adaptation.options import RunArguments
    from clvoro.adaptation.preparation import prepare, start
    from clvoro.adaptation.stages import Stages
    from clvoro.opencl.engine import Engine

    domain = mesh.diagram.domain
    adapter = clvoro.Adapter(ctx)
    engine = Engine(ctx, adapter.queue, 2, np.dtype(float), domain.traits(np.dtype(float)))
    arguments = RunArguments.of(domain, 0.08, "density", clvoro.MultilevelOptions(levels=0))
    state = start(prepare(Stages(engine), arguments.checked(engine.real)))
    pairs, balls = state.setup.around, state.balls
    points, labels = state.points.get(), state.labels.get()
    scale = domain.frame[1]
    centers, radii = pairs.centers / scale, pairs.radii / scale
    moving = np.flatnonzero(labels >= state.fixed)
    # A neighbor of a generator beside a line goes into one of its balls.
    starts, neighbors = state.t.starts.get(), state.t.neighbors.get()
    for i in moving:
        row = neighbors[starts[i] : starts[i + 1]]
        row = row[(row >= 0) & (labels[row] < state.fixed)]
        if len(row):
            ball = pairs.balls[pairs.ball_starts[labels[row[0]]]]
            points[i] = centers[ball] + 0.3 * (points[i] - centers[ball])
    state.points.set(points)
    state.stages.motion.leave_balls(
        domain, state.t, balls, Moving(state.points, state.velocity, state.labels, state.fixed)
    )
    after = state.points.get()
    gaps = np.linalg.norm(after[moving, None] - centers, axis=2) / radii
    before = np.linalg.norm(points[moving, None] - centers, axis=2) / radii
    assert (before.min(axis=1) < 0.99).sum() > 20
    assert (gaps.min(axis=1) < 0.99).sum() <= 2
    assert np.array_equal(after[labels < state.fixed], points[labels < state.fixed])


def test_regions_are_in_files(mesh, tmp_path):
    regions = mesh.diagram.cell_region
    assert np.bincount(regions).tolist() == [(regions == 0).sum(), (regions == 1).sum()]
    y = 0.6 - 0.05 * mesh.points[:, 0]
    assert np.array_equal(regions == regions[mesh.points[:, 1].argmax()], mesh.points[:, 1] > y)
    for name in ("a.npz", "a.vtu"):
        mesh.save(tmp_path / name)
        again = clvoro.load(tmp_path / name).diagram
        assert np.array_equal(again.cell_region, regions)
        assert len(again.border_faces) == len(mesh.diagram.border_faces)
    mesh.save(tmp_path / "a.nc")
    assert b"region" in (tmp_path / "a.nc").read_bytes()
    mesh.to_openfoam(tmp_path / "case.foam", zones={"left": mesh.points[:, 0] < 1})
    folder = tmp_path / "constant" / "polyMesh"
    text = (folder / "cellZones").read_text()
    assert [text.count(f"\n{name}\n") for name in ("region-0", "region-1", "left")] == [1, 1, 1]
    assert f"List<label>\n{len(mesh.diagram.border_faces)}\n" in (folder / "faceZones").read_text()
    clvoro.voronoi(BOX, mesh.points).to_openfoam(tmp_path / "case.foam")
    assert not list(folder.glob("*Zones"))


@pytest.mark.parametrize("zones", [{"a": [1, 0]}, {"a b": None}, {"region-0": None}, [True]])
def test_wrong_zones_are_refused(mesh, tmp_path, zones):
    if isinstance(zones, dict) and None in zones.values():
        zones = dict.fromkeys(zones, mesh.points[:, 0] < 1)
    with pytest.raises(clvoro.errors.ClvoroError, match="zones"):
        mesh.to_openfoam(tmp_path / "x.foam", zones=zones)
    assert not list(tmp_path.iterdir())


def test_what_does_not_go_with_lines_is_said(ctx):
    adapter, domain = clvoro.Adapter(ctx), BOX.with_lines([FAULT, BED])
    for more, message in (
        ({"method": "transport"}, "has lines"),
        ({"n_cells": 10}, "beside the lines"),
        ({"fixed": [(0.5, 0.3)]}, "from lines at"),
    ):
        with pytest.raises(InputError, match=message):
            adapter.run(domain, 0.1, "fast", **more)
    close = BOX.with_lines([[(0.2, 0.5), (1.8, 0.5)], [(0.2, 0.5001), (1.8, 0.5001)]])
    with pytest.warns(MismatchWarning, match="no room"):
        pairs = adapter.run(close, 0.1, "fast", max_steps=3)
    assert len(pairs) > 100
    with pytest.warns(MismatchWarning, match="layers"):
        adapter.run(domain, 0.1, "fast", layers=clvoro.Layers(0.02, 2, edges=["xMin"]), max_steps=3)


def test_pairs_in_part_of_a_domain():
    domain = BOX.with_lines([BED])
    half = clvoro.Box((0, 0), (1, 1))
    pairs = place_pairs(half, domain.borders.network(half), lambda x: np.full(len(x), 0.1))
    assert pairs.points[:, 0].max() < 1
