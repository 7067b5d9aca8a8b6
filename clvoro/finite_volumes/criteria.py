"""Reports on whether a solver accepts a mesh: criteria with value, limit and worst place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..arguments import counted, format_point
from ..geometry.sphere import Sphere
from ..mesh.check.findings import Verdict


@dataclass(frozen=True)
class Criterion:
    """One criterion of a solver.

    Attributes
    ----------
    name : str
    value : float
        The worst value in the mesh.
    limit : float
    above : bool
        Whether the solver complains of values above the limit; else of those below.
    demanded : bool
        Whether the solver rejects a mesh that fails. It only warns of the others.
    count : int
        Number of faces or cells that fail.
    cell : int or None
        The cell with the worst value, or one of the two cells of the face.
    place : tuple of float or None
        Centroid of that cell, or center of the face. On a sphere longitude and latitude.
    unit : str
        Unit of `place`: "°" on a sphere, otherwise that of the domain, and empty.
    """

    name: str
    value: float
    limit: float
    above: bool
    demanded: bool
    count: int
    cell: int | None = None
    place: tuple[float, ...] | None = None
    unit: str = ""

    @property
    def ok(self) -> bool:
        """Whether no face or cell fails."""
        return self.count == 0

    def on_sphere(self, sphere: Sphere) -> Criterion:
        """Return the criterion with its place as longitude and latitude."""
        if self.place is None:
            return self
        lonlat = sphere.lonlat(np.array([self.place]))[0]
        return replace(self, place=tuple(lonlat.tolist()), unit="°")

    def __str__(self) -> str:
        verdict = "ok" if self.ok else f"{self.count} fail" if self.demanded else f"{self.count} warn"
        limit = f"{'<=' if self.above else '>='} {self.limit:.4g}"
        where = ""
        if self.place is not None:
            where = f"cell {self.cell} at {format_point(self.place, self.unit)}"
        return f"{self.name:28}{self.value:>12.5g}  {limit:<12} {verdict:<12}{where}".rstrip()


@dataclass(frozen=True)
class SolverReport(Verdict):
    """The verdict on a mesh; it is true if the solver accepts it.

    Attributes
    ----------
    solver : str
    criteria : tuple of Criterion
    cells, faces : int
    area_change : float
        Volume (2D: area) of the mesh that the solver gets minus that of the domain, over that of the domain.
    left_out : str
        What it leaves out of the domain, in words; see `Diagram.left_out`. Empty for nothing.
    """

    solver: str
    criteria: tuple[Criterion, ...]
    cells: int
    faces: int
    area_change: float
    left_out: str = ""

    @property
    def ok(self) -> bool:
        """Whether the solver accepts the mesh."""
        return all(c.ok for c in self.criteria if c.demanded)

    def __getitem__(self, name: str) -> Criterion:
        """Return a criterion by its name."""
        return next(c for c in self.criteria if c.name == name)

    def __str__(self) -> str:
        failed = [c.name for c in self.criteria if c.demanded and not c.ok]
        verdict = "accepted" if self.ok else f"rejected: {', '.join(failed)}"
        changed = ""
        if self.area_change:
            changed = f"; straight walls change the area by {100 * self.area_change:+.2g} %"
        left = f"; {self.left_out}" if self.left_out else ""
        head = f"{self.solver}: {verdict}; {counted(self.cells, 'cell')}, {self.faces} faces{changed}{left}"
        columns = f"{'criterion':28}{'worst':>12}  {'limit':<12} {'verdict':<12}where"
        return "\n  ".join([head, columns, *map(str, self.criteria)])


@dataclass(frozen=True)
class Rows:
    """Places, (k, 3), with their cells, (k,) or None for cells themselves; whether each is judged, (k,) bool."""

    places: np.ndarray
    cells: np.ndarray | None
    dim: int
    judged: np.ndarray | None = None

    def __call__(
        self,
        name: str,
        values: np.ndarray,
        limit: float,
        *,
        above: bool = True,
        demanded: bool = True,
        strict: bool = True,
        failing: np.ndarray | None = None,
    ) -> Criterion:
        """Return a criterion: the worst of `values` (k,), the limit, and the cell with the worst one."""
        if self.judged is not None:
            rows = np.flatnonzero(self.judged)
            cells = rows if self.cells is None else self.cells[rows]
            only, mask = Rows(self.places[rows], cells, self.dim), None if failing is None else failing[rows]
            return only(name, values[rows], limit, above=above, demanded=demanded, strict=strict, failing=mask)
        if not len(values):
            return Criterion(name, 0.0 if above else np.inf, limit, above, demanded, 0)
        bad = failing
        if bad is None:
            bad = values > limit if above else values < limit
            bad = bad if strict else values >= limit
        worst = int(np.argmax(values) if above else np.argmin(values))
        if bad.any() and not bad[worst]:
            worst = int(np.flatnonzero(bad)[0])
        cell = worst if self.cells is None else int(self.cells[worst])
        place = tuple(self.places[worst, : self.dim].tolist())
        return Criterion(name, float(values[worst]), limit, above, demanded, int(bad.sum()), cell, place)
