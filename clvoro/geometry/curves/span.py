"""Smooth parts of curves: their polylines within a tolerance, and nearest points on them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...errors import InputError
from ..angles import angles

LARGEST_TURN = math.radians(2)
"""Largest turn of a smooth curve from one edge of its polyline to the next."""
SAMPLES = 64
"""Least number of intervals that show the shape of a span."""
_MOST_SAMPLES = 1 << 16
_SAMPLE_TURN = 0.1  # radians between samples, at most, up to `_MOST_SAMPLES`
_MOST_EDGES = 1 << 20  # of one span
_SLACK = 1.04  # an edge is divided if its sagitta exceeds the tolerance by this factor
_ROUNDS = 50


@dataclass(frozen=True)
class Span:
    """A smooth part of a curve, for parameters from `begin` to `end`.

    Attributes
    ----------
    begin, end : float
    at : callable
        Takes parameters (n,) and returns points (n, 2) and derivatives (n, 2) by the parameter.
    samples : int
        Number of intervals that show the shape of the span.
    """

    begin: float
    end: float
    at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    samples: int = SAMPLES

    def nearest(self, points: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
        """Return the parameters (n,) from `lower` to `upper`, (n,) each, of the nearest points to `points` (n, 2).

        Gauss-Newton iteration. It converges for points whose distance is less than the radius of curvature, and
        reaches round-off in a few steps beside the curve.
        """
        begin, end = self.at(lower)[0], self.at(upper)[0]
        along = end - begin
        share = ((points - begin) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
        t = lower + np.clip(share, 0, 1) * (upper - lower)
        for _ in range(_ROUNDS):
            at, ahead = self.at(t)
            step = ((points - at) * ahead).sum(axis=1) / (ahead**2).sum(axis=1)
            new = np.clip(t + step, lower, upper)
            done = np.abs(new - t) <= 4 * np.finfo(float).eps * np.maximum(np.abs(t), upper - lower)
            t = new
            if done.all():
                break
        return t

    def resolve(self, tolerance: float) -> np.ndarray:
        """Return parameters (k + 1,), from `begin` to `end`, of a polyline with equal sagittas below `tolerance`."""
        m = self.samples
        while True:
            t = np.linspace(self.begin, self.end, m + 1)
            points, ahead = self.at(t)
            turns = np.abs(angles(ahead[:-1], ahead[1:]))
            if turns.max() <= _SAMPLE_TURN or m >= _MOST_SAMPLES:
                break
            m *= 2
        lengths = np.hypot(*np.diff(points, axis=0).T)
        # An arc of n edges that turns by a over the length s has the sagitta a s / (8 n^2).
        counts = np.maximum(np.sqrt(turns * lengths / (8 * tolerance)), turns / LARGEST_TURN)
        total = counts.sum()
        if total > _MOST_EDGES:
            raise InputError(
                f"the curve needs {total:.3g} edges for a tolerance of {tolerance:g}, expected at most {_MOST_EDGES}; "
                "give a larger tolerance"
            )
        n = max(1, math.ceil(total - 1e-9))
        reached = np.concatenate([[0.0], np.cumsum(counts)])
        found = np.interp(np.linspace(0, reached[-1], n + 1), reached, t) if total > 0 else t[:1]
        found = np.append(found[:n], self.end)
        found[0] = self.begin
        # Beside inflections curvature changes within an edge.
        wide = np.flatnonzero(self._sagittas(found) > _SLACK * tolerance)
        return np.sort(np.concatenate([found, (found[wide] + found[wide + 1]) / 2]))

    def _sagittas(self, t: np.ndarray) -> np.ndarray:
        """Return the largest distance of the curve from each edge between the parameters `t` (k + 1,), (k,)."""
        ends = self.at(t)[0]
        along = np.diff(ends, axis=0)
        along /= np.maximum(np.hypot(*along.T), 1e-300)[:, None]
        away = []
        for share in (0.25, 0.5, 0.75):
            off = self.at(t[:-1] + share * np.diff(t))[0] - ends[:-1]
            away.append(np.abs(off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0]))
        return np.max(away, axis=0)
