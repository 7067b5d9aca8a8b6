"""Cells in sharp corners: the best quality that geometry allows, and what meshes reach.

    python bench/sharp_corners.py [--angles 10,20,30,45,60] [--device NAME] [--dtype float32] [--json]

The first table has the largest quality Q of a convex polygon with n corners whose first corner is the tip of a wedge. A
cell with three corners has one inner face, which OpenFOAM refuses; the cell of a solver mesh has four or more. The
maximum is numerical, over the places of the other corners.

The second table has meshes of wedges with 400 cells of equal size: the least Q, the largest non-orthogonality and
skewness of the solver mesh, and whether the criteria of OpenFOAM are met.
"""

from __future__ import annotations

import numpy as np
from _common import FIRST_SEED, Report, counts, heading, make_adapter, parser
from scipy.optimize import minimize

import clvoro


def quality(corners: np.ndarray) -> float:
    """Return the paper's (4.1), Q = 4 n tan(pi / n) A / P^2, of a polygon (n, 2)."""
    after = np.roll(corners, -1, axis=0)
    area = 0.5 * (corners[:, 0] * after[:, 1] - corners[:, 1] * after[:, 0]).sum()
    around = np.hypot(*(after - corners).T).sum()
    n = len(corners)
    return float(4 * n * np.tan(np.pi / n) * area / around**2)


def best_quality(angle: float, corners: int) -> float:
    """Return the largest Q of a convex polygon with its tip in a wedge of `angle` radians."""
    inner = corners - 3
    a = angle / 2

    def polygon(x: np.ndarray) -> np.ndarray:
        r, s = np.abs(x[:2])
        ends = [(r * np.cos(a), -r * np.sin(a))], [(s * np.cos(a), s * np.sin(a))]
        return np.concatenate([[(0.0, 0.0)], ends[0], x[2:].reshape(-1, 2), ends[1]])

    def loss(x: np.ndarray) -> float:
        p = polygon(x)
        along = np.roll(p, -1, axis=0) - p
        before = np.roll(along, 1, axis=0)
        turn = before[:, 0] * along[:, 1] - before[:, 1] * along[:, 0]
        return -quality(p) + 100 * float((np.minimum(turn, 0) ** 2).sum())

    best = 0.0
    for reach in (1.0, 1.1, 1.3):
        angles = np.linspace(-a, a, inner + 2)[1:-1]
        middle = reach * np.column_stack([np.cos(angles), np.sin(angles)])
        start = np.concatenate([[1.0, 1.0], middle.ravel()])
        options = {"maxiter": 20_000, "maxfev": 20_000, "xatol": 1e-9, "fatol": 1e-12}
        found = minimize(loss, start, method="Nelder-Mead", options=options)
        best = max(best, -float(found.fun))
    return best


def main() -> None:
    """Run the bench."""
    options_of = parser(__doc__)
    options_of.add_argument("--angles", type=counts, default=[10, 15, 20, 25, 30, 35, 45, 60])
    options = options_of.parse_args()
    adapter = make_adapter(options)
    report = Report(
        options.json,
        {
            "angle": lambda r: r["angle"],
            "largest Q, n = 3": lambda r: f"{r['bound'][0]:.2f}",
            "n = 4": lambda r: f"{r['bound'][1]:.2f}",
            "n = 5": lambda r: f"{r['bound'][2]:.2f}",
            "run": lambda r: r["run"],
            "min Q": lambda r: f"{r['quality']:.2f}",
            "non-orth.": lambda r: f"{r['non_orthogonality']:.1f}",
            "skewness": lambda r: f"{r['skewness']:.2f}",
            "accepted": lambda r: "yes" if r["accepted"] else "no",
        },
    )
    for degrees in options.angles:
        angle = np.radians(degrees)
        bound = [best_quality(angle, n) for n in (3, 4, 5)]
        wedge = clvoro.Polygon([(0, 0), (1, 0), (np.cos(angle), np.sin(angle))])
        size = (wedge.measure / 400) ** 0.5
        for run, settings in (("default", {}), ("best", {"effort": "best"}), ("exact", {"method": "exact"})):
            result = adapter.run(wedge, size, seed=FIRST_SEED, **settings)
            solver = result.measures.solver.summary()
            found = {
                "angle": degrees,
                "bound": bound,
                "run": run,
                "quality": float(result.quality.min()),
                "non_orthogonality": solver["max_non_orthogonality"],
                "skewness": solver["max_skewness"],
                "accepted": bool(result.check(solver="openfoam")),
            }
            report.add(found, f"{degrees} degrees, {run}")
    report.finish(heading(adapter, "Sharp corners"))


if __name__ == "__main__":
    main()
