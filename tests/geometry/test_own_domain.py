"""Domains that a stranger adds, each by one class: the rest of the package takes them as it takes those of clvoro."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

import clvoro
from clvoro.geometry.boundary_names import BoundaryNames
from clvoro.geometry.domain import Domain
from clvoro.io import load


class Slab(Domain):
    """The space between two plates, periodic along them."""

    def __init__(self, length, bottom, top):
        self.lower, self.upper = (0.0, bottom), (length, top)
        self.periodic, self.names = (True, False), None

    def default_names(self):
        return BoundaryNames(("bottom", "top"), np.array([-1, -1, 0, 1], np.int32), "plate")

    def describe(self):
        return {"length": self.upper[0], "bottom": self.lower[1], "top": self.upper[1]}


class Corner(clvoro.Polygon):
    """A square of which a line from (cut, 0) to (0, cut) takes a corner away."""

    def __init__(self, cut):
        self.cut = cut
        super().__init__([(cut, 0), (1, 0), (1, 1), (0, 1), (0, cut)], names={"oblique": 4})

    def describe(self):
        return {"cut": self.cut}

    @classmethod
    def described(cls, **values):
        return cls(**values)


OWN = {"slab": Slab(3.0, 1.0, 2.0), "corner": Corner(0.4)}
BOUNDARIES = {"slab": ("bottom", "top"), "corner": ("oblique", "outer")}


@pytest.fixture(params=OWN)
def domain(request):
    return OWN[request.param]


def test_diagram(domain):
    points = np.array(domain.lower) + domain.extent * np.random.default_rng(1).random((60, 2))
    points = points[domain.contains(points)]
    diagram = clvoro.voronoi(domain, points)
    assert diagram.check().ok
    assert diagram.volumes.sum() == pytest.approx(domain.measure)
    assert diagram.domain is domain


def test_run(domain, tmp_path):
    size = clvoro.sizing.Distance(domain, 0.05, growth=1.3)
    mesh = clvoro.adapt(domain, size, effort="fast")
    assert mesh.check().ok
    for name in domain.boundary_names:
        assert len(mesh.diagram.boundary_cells(name)) > 5
    for path in (tmp_path / "mesh.npz", tmp_path / "mesh.vtu"):
        mesh.save(path)
        back = load(path)
        assert back.diagram.domain == domain
        assert np.array_equal(back.diagram.neighbors, mesh.diagram.neighbors)
    assert np.array_equal(mesh.transfer(np.ones(len(mesh.points)), mesh), np.ones(len(mesh.points)))
    mesh.plot("size")
    plt.close("all")
