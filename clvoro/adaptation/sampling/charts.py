"""Size fields in the charts of curved domains."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...geometry.domain import Domain


class Charted:
    """A size field on a curved domain as a function of places in its chart.

    Parameters
    ----------
    field : callable
        h(points (n, d)) -> (n,).
    domain : Domain
    """

    def __init__(self, field: Callable[[np.ndarray], np.ndarray], domain: Domain) -> None:
        self._field, self._domain, self._chart = field, domain, domain.chart()

    @property
    def real(self) -> np.dtype:
        """Precision of the field."""
        return getattr(self._field, "real", np.dtype(float))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return h at places in the chart, (n,)."""
        return self._field(self._chart.position(points))

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return the field's landmarks in the chart `domain`; see `Field.landmarks`."""
        del domain
        known: Any = getattr(self._field, "landmarks", None)
        return self._chart.place(np.empty((0, self._domain.dim)) if known is None else known(self._domain))


def charted(
    domain: Domain, field: Callable[[np.ndarray], np.ndarray]
) -> tuple[Domain, Callable[[np.ndarray], np.ndarray]]:
    """Return the domain's chart, and the field there; `domain` and `field` if it is plane already."""
    return (domain.chart().domain, Charted(field, domain)) if domain.curved else (domain, field)
