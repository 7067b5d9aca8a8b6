"""The result of `clvoro.transport`: a power diagram with prescribed volumes, and the steps to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .diagram import Diagram
from .read_only import Sealed


@dataclass(frozen=True, eq=False)
class Transported(Sealed):
    """A power diagram whose cells have prescribed volumes.

    Attributes
    ----------
    diagram : Diagram
        Its `weights` are those found; their mean is arbitrary.
    errors : (k + 1,) float64
        Largest |V - m| / m at the start and after each of k steps of Newton's method.
    shares : (k,) float64
        Share of each Newton step that was taken: 1 without damping.
    converged : bool
        Whether the last error is within the tolerance.
    """

    diagram: Diagram
    errors: np.ndarray
    shares: np.ndarray
    converged: bool

    def __repr__(self) -> str:
        return (
            f"Transported({len(self.diagram)} cells, relative error {self.errors[-1]:.2g} after "
            f"{len(self.shares)} steps)"
        )
