"""Domains that a stranger adds, each by one class: the rest of the package takes them as it takes those of clvoro."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

import clvoro
from clvoro.geometry.boundary_names import BoundaryNames
from clvoro.geometry.domain import Domain


class Slab(Domain):
    """The space between two plates across the last axis, periodic along them."""

    def __init__(self, *size):
        self.lower, self.upper = (0.0,) * len(size), size
        self.periodic = (True,) * (len(size) - 1) + (False,)

    def default_names(self):
        seams = [-1] * (2 * self.dim - 2)
        return BoundaryNames(("bottom", "top"), np.array([*seams, 0, 1], np.int32), "plate")

    def describe(self):
        return {"size": self.upper}

    @classmethod
    def described(cls, size):
        return cls(*size)


class Corner(clvoro.Polygon):
    """A square of which a line from (cut, 0) to (0, cut) takes a corner away."""

    def __init__(self, cut):
        self.cut = cut
        super().__init__([(cut, 0), (1, 0), (1, 1), (0, 1), (0, cut)], names={"oblique": 4})

    def describe(self):
        return {"cut": self.cut}

    @classmethod
    def described(cls, cut):
        return cls(cut)


OWN = {"slab": Slab(3.0, 1.0), "slab in 3D": Slab(1.0, 2.0, 0.5), "corner": Corner(0.4)}


@pytest.fixture(params=OWN)
def domain(request):
    return OWN[request.param]


def points_in(domain, n):
    points = np.array(domain.lower) + domain.extent * np.random.default_rng(1).random((n, domain.dim))
    return points[domain.contains(points)]


def test_diagrams_are_right_and_come_back_from_files(domain, tmp_path):
    diagram = clvoro.voronoi(domain, points_in(domain, 60))
    assert diagram.check()
    assert diagram.domain is domain
    assert diagram.volumes.sum() == pytest.approx(domain.measure)
    assert all(len(diagram.boundary_cells(name)) for name in domain.boundary_names)
    for path in (tmp_path / "mesh.npz", tmp_path / "mesh.vtu"):
        diagram.save(path)
        back = clvoro.load(path)
        assert back.domain == domain
        assert back.check()
        assert np.array_equal(back.neighbors, diagram.neighbors)


@pytest.mark.parametrize("name", ["slab", "corner"])
def test_runs(name):
    domain = OWN[name]
    first = domain.boundary_names[0]
    size = clvoro.sizing.Distance(domain.boundary(first), 0.05, growth=1.3)
    mesh = clvoro.adapt(domain, size, effort="fast", layers=clvoro.Layers(0.01, 2, edges=first))
    assert mesh.check()
    assert abs(mesh.size_error).mean() < 0.1
    assert np.ptp(mesh.transfer(np.ones(len(mesh.points)), mesh)) < 1e-14
    mesh.plot("size")
    plt.close("all")
