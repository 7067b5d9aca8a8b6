"""A synthetic coast: fractal rings by displaced midpoints, for the built-in case "lake".

``python -m clvoro.cli.cases.coast lake.geojson`` writes that lake again, to the same bytes.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import shapely

_DIGITS = 4  # of coordinates in the file: a tenth of a meter, if the unit is a kilometer


def fractal_ring(corners: np.ndarray, levels: int, roughness: float, rng: np.random.Generator) -> np.ndarray:
    """Return the ring `corners` (k, 2) with each edge's midpoint displaced sideways, `levels` times.

    Displacements are normal, with a standard deviation of `roughness` edge lengths, at most 0.45. They are
    halved where edges would cross.

    Returns
    -------
    (k 2^levels, 2) float64
    """
    ring = np.asarray(corners, float)
    for _ in range(levels):
        begin, end = ring, np.roll(ring, -1, axis=0)
        along = end - begin
        across = np.column_stack([-along[:, 1], along[:, 0]])
        shift = np.clip(rng.normal(0, roughness, len(ring)), -0.45, 0.45)
        place = rng.uniform(0.4, 0.6, len(ring))
        while True:
            middle = begin + place[:, None] * along + shift[:, None] * across
            finer = np.stack([begin, middle], axis=1).reshape(-1, 2)
            crossing = _crossing_edges(finer) // 2
            if not crossing.size:
                break
            shift[crossing] *= 0.5
        ring = finer
    return ring


def _crossing_edges(ring: np.ndarray) -> np.ndarray:
    edges = np.asarray(shapely.linestrings(np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)))
    pairs = shapely.STRtree(edges).query(edges, predicate="crosses")
    return np.unique(pairs)


def _ellipse(center: tuple[float, float], a: float, b: float, turn: float, k: int) -> np.ndarray:
    t = np.arange(k) * (2 * math.pi / k)
    x, y = a * np.cos(t), b * np.sin(t)
    c, s = math.cos(turn), math.sin(turn)
    return np.column_stack([center[0] + c * x - s * y, center[1] + s * x + c * y])


# Center, half axes and turn of each island; the two in the north-east leave a strait.
_ISLANDS = (
    ((2.6, 2.3), 0.75, 0.4, 0.4),
    ((5.2, 3.3), 0.5, 0.35, -0.6),
    ((6.35, 3.15), 0.4, 0.28, 0.9),
    ((4.4, 1.5), 0.18, 0.12, 0.0),
    ((7.9, 2.3), 0.25, 0.12, 1.2),
    ((1.2, 3.1), 0.16, 0.1, 2.0),
)


def lake(seed: int = 20269) -> dict:
    """Return a lake of 9 x 5 with six islands as a GeoJSON Feature."""
    rng = np.random.Generator(np.random.PCG64(seed))
    shore = fractal_ring(_ellipse((4.5, 2.5), 4.3, 2.0, 0.0, 12), 7, 0.14, rng)
    islands = [fractal_ring(_ellipse(*island, 6), 4 if island[1] < 0.3 else 5, 0.13, rng) for island in _ISLANDS]
    rings = [np.vstack([r, r[:1]]).round(_DIGITS).tolist() for r in (shore, *islands)]
    return {
        "type": "Feature",
        "properties": {"name": "A lake that is nowhere", "unit": "km"},
        "geometry": {"type": "Polygon", "coordinates": rings},
    }


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(lake(), separators=(",", ":")) + "\n", encoding="utf-8")
