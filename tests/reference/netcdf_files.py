"""Meshes for tests of netCDF files, and what is in a file."""

from dataclasses import dataclass, field

import numpy as np
from scipy.io import netcdf_file

import clvoro
from clvoro.mesh.diagram import Diagram
from clvoro.mesh.results import HISTORY_DTYPE, Result
from tests.reference.shores import scattered, slit, star

ROOM = clvoro.Box((-1, 3), (1, 4))
HEXAGONS = clvoro.Box((0, 0), (6, 4 * 3**0.5), periodic=True)
ISLAND = np.array([(0.1, 0.1), (0.4, 0.15), (0.2, 0.45)])
SPECK = np.array([(0.1, 0.1), (0.13, 0.1), (0.1, 0.13)])


def random_points(box: clvoro.Box, n: int, seed: int = 8291) -> np.ndarray:
    return box.lower + np.random.default_rng(seed).random((n, 2)) * box.extent


def grid(box: clvoro.Box, nx: int, ny: int) -> np.ndarray:
    """Generators of nx times ny equal rectangles."""
    x, y = ((np.arange(k) + 0.5) / k for k in (nx, ny))
    return box.lower + np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) * box.extent


def hexagons() -> np.ndarray:
    """Generators of 48 regular hexagons that fill HEXAGONS, neighbors at distance 1."""
    i, j = np.meshgrid(np.arange(6), np.arange(8))
    return np.stack([i + 0.5 * (j % 2) + 0.2, j * 3**0.5 / 2 + 0.3], axis=-1).reshape(-1, 2)


def _scattered(domain, n):
    return domain, scattered(domain, n)


def _random(box, n):
    return box, random_points(box, n)


MESHES = {
    "room": lambda: _random(ROOM, 120),
    "torus": lambda: _random(clvoro.Box((0, 0), (2, 1), periodic=True), 150),
    "channel": lambda: _random(clvoro.Box((1, 1), (3, 2), periodic=(True, False)), 130),
    "hexagons": lambda: (HEXAGONS, hexagons()),
    "squares": lambda: (ROOM, grid(ROOM, 8, 4)),
    "squares without walls": lambda: (box := clvoro.Box((0, 0), (5, 5), periodic=True), grid(box, 5, 5)),
    "shore": lambda: _scattered(clvoro.Polygon(star(60), [ISLAND]), 150),
    "slit": lambda: _scattered(clvoro.Polygon(slit(0.01)), 90),
    "two pieces": lambda: _scattered(clvoro.Polygon.from_pieces([[star(9)], [star(7, center=(3, 0))]]), 80),
}
"""Domains and generators. In "shore" and "slit" the boundary divides cells; their far pieces belong to other cells."""


PLANE = {
    **{name: mesh for name, mesh in MESHES.items() if name not in ("shore", "slit", "two pieces")},
    "shore, cut": MESHES["shore"],
    "torus, cut": MESHES["torus"],
}
"""Those that C grids can use. From "cut" ones cells are removed: those at walls, and those around a point."""


def around_an_island() -> tuple[clvoro.Polygon, np.ndarray]:
    """Four square cells, within one of which there is an island."""
    square = np.array([(0.0, 0), (2, 0), (2, 2), (0, 2)])
    return clvoro.Polygon(square, [SPECK]), square / 2 + 0.5


def result_of(diagram: Diagram) -> Result:
    """A Result with `diagram` and made-up data."""
    rng, n = np.random.default_rng(5), len(diagram)
    return Result(
        points=diagram.points,
        diagram=diagram,
        target_size=0.1 + rng.random(n),
        size_error=rng.standard_normal(n),
        quality=rng.random(n),
        history=np.zeros(0, HISTORY_DTYPE),
        converged=True,
        stop_reason="made up",
        settings={"name": "é", "seed": 3},
    )


def made(ctx, name: str, dtype: str = "float64") -> Result:
    """Return the mesh of `MESHES` or `PLANE` with this name."""
    diagram = clvoro.Adapter(ctx, dtype).diagram(*{**MESHES, **PLANE}[name]())
    if "cut" in name:
        kept = np.linalg.norm(diagram.points - diagram.points[7], axis=1) > 0.2
        kept[diagram.boundary_cells()] = False
        diagram = diagram.subset(kept)
    return result_of(diagram)


@dataclass(repr=False)
class Contents:
    """What is in a file: variables, their attributes, the file's own, and the lengths of dimensions."""

    values: dict[str, np.ndarray]
    about: dict[str, dict] = field(default_factory=dict)
    attributes: dict = field(default_factory=dict)
    dimensions: dict[str, int] = field(default_factory=dict)
    dimensions_of: dict[str, tuple] = field(default_factory=dict)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[name]


def read(path) -> Contents:
    """Read a file as SciPy does."""
    with netcdf_file(path, mmap=False) as file:
        found = file.variables
        return Contents(
            {k: v.data.astype(v.data.dtype.newbyteorder("=")) for k, v in found.items()},
            {k: dict(v._attributes) for k, v in found.items()},
            dict(file._attributes),
            dict(file.dimensions),
            {k: v.dimensions for k, v in found.items()},
        )


def shoelace(polygon: np.ndarray) -> float:
    """Signed area of a polygon (k, 2)."""
    x, y = (polygon - polygon[0]).T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
