"""Outlines of raster masks: sizes, shapes and OpenFOAM's criteria where cells are larger than the pixels.

    python bench/masks.py [--sizes 1,1.5,2,3] [--masks 4] [--effort default] [--device NAME] [--json]

A mask is the water of a smooth random field on 60 x 60 pixels, with walls along the edges of pixels. All cells have the
same size, in pixels. Rows have means over the masks, of the domain as given and `simplified` by 1.5 sizes, and how many
solver meshes meet OpenFOAM's criteria.
"""

from __future__ import annotations

import warnings

import numpy as np
from _common import Report, heading, make_adapter, parser
from _sites import mask

SIMPLIFIED = 1.5  # tolerance over the size


COLUMNS = {
    "size, pixels": lambda r: r["size"],
    "domain": lambda r: "simplified" if r["simplified"] else "given",
    "mean e at walls": lambda r: f"{r['boundary_mean_error']:.4f}",
    "inside": lambda r: f"{r['inner_mean_error']:.4f}",
    "mean Q at walls": lambda r: f"{r['boundary_mean_quality']:.3f}",
    "Q inside": lambda r: f"{r['inner_mean_quality']:.3f}",
    "min Q": lambda r: f"{r['min_quality']:.2f}",
    "accepted": lambda r: f"{r['accepted']:.0f} of {r['masks']}",
}
MEANS = ["boundary_mean_error", "inner_mean_error", "boundary_mean_quality", "inner_mean_quality", "min_quality"]


def main() -> None:
    """Run the bench."""
    options_of = parser(__doc__)
    options_of.add_argument("--sizes", default="1,1.5,2,3", metavar="PIXELS")
    options_of.add_argument("--masks", type=int, default=4, metavar="N")
    options_of.add_argument("--effort", default="default")
    options = options_of.parse_args()
    adapter = make_adapter(options)
    warnings.simplefilter("ignore")  # bays and straits that are narrower than a cell
    report = Report(options.json, COLUMNS)
    for size in map(float, options.sizes.split(",")):
        for simplified in (False, True):
            rows = []
            for seed in range(1, options.masks + 1):
                domain = mask(seed).domain
                domain = domain.simplified(SIMPLIFIED * size) if simplified else domain
                result = adapter.run(domain, size, effort=options.effort)
                accepted = bool(result.check(solver="openfoam"))
                rows.append({**result.summary(), "accepted": accepted})
            found = {name: float(np.mean([row[name] for row in rows])) for name in MEANS}
            found |= {"size": size, "simplified": simplified, "masks": len(rows)}
            found["accepted"] = sum(row["accepted"] for row in rows)
            report.add(found, f"{size} pixels, {'simplified' if simplified else 'given'}")
    report.finish(heading(adapter, f"Masks, {options.effort}"))


if __name__ == "__main__":
    main()
