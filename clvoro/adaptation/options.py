"""What a run is asked for: options, checked as they are made, and which of them matter to which method."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from numbers import Real

import numpy as np

from ..arguments import check_choice, check_integer, check_number
from ..errors import InputTypeError, UnusedOptionWarning
from ..geometry.boundary_layers import Layers
from .methods import PUBLISHED
from .schedule import EFFORTS

_PLANNED = ("adaptive", "exact")
METHODS = (*_PLANNED, *PUBLISHED)
STARTS = ("density", "uniform")
_MOST_STEPS = 10**6  # of a run: its plan, which names each, and its history are lists

_USERS = {
    "effort": _PLANNED,
    "levels": _PLANNED,
    "error_target": _PLANNED,
    "tol": PUBLISHED,
    "alpha": ("lloyd", "poisson", "coupled"),  # "lloyd" reports the correction that it leaves out
    "k": PUBLISHED,
}
"""Methods that an option matters to, where it does not to all: without it they do and report something else."""
_AS_IT_IS = {"tol": 0, "levels": 0}
"""Values of these that ask for what the other methods do anyway: take all steps, begin on no coarser level."""


@dataclass(frozen=True)
class Options:
    """What `Adapter.run` was asked for; see there. `levels` awaits the number of cells.

    Raises
    ------
    InputError, InputTypeError
        If they are not as they should be.

    Warns
    -----
    UnusedOptionWarning
    """

    method: str = "adaptive"
    start: str = "density"
    effort: str = "default"
    levels: int | str = "auto"
    seed: int = 0
    tol: float = 1e-3
    k: float = 0.5
    alpha: float | None = None
    max_steps: int | None = None
    n_cells: int | None = None
    error_target: float | None = None
    layers: tuple[Layers, ...] = ()

    def __post_init__(self) -> None:
        check_choice("method", self.method, METHODS)
        check_choice("start", self.start, STARTS)
        check_choice("effort", self.effort, tuple(EFFORTS))
        layers: object = self.layers
        if not isinstance(layers, Layers | Sequence):
            hint = f"; write clvoro.Layers({layers!r})" if isinstance(layers, Real) else ""
            raise InputTypeError(
                f"layers is {layers!r}, expected clvoro.Layers or a sequence of them{hint}"
            )
        for name, value in self._numbers():
            object.__setattr__(self, name, value)
        object.__setattr__(
            self, "layers", (layers,) if isinstance(layers, Layers) else tuple(layers)
        )
        warn_of_unused(vars(self), [self.method], stacklevel=4)

    def _numbers(self) -> Iterator[tuple[str, object]]:
        """Yield the names of numbers that were given, each with what it is."""
        if not (isinstance(self.levels, str) and self.levels == "auto"):
            yield "levels", check_integer("levels", self.levels, 0, beside="'auto'")
        yield "seed", check_integer("seed", self.seed, 0, np.inf)
        yield "tol", check_number("tol", self.tol, least=0)
        yield "k", check_number("k", self.k, above=0)
        if self.alpha is not None:
            yield "alpha", check_number("alpha", self.alpha, above=0)
        if self.max_steps is not None:
            yield "max_steps", check_integer("max_steps", self.max_steps, 0, _MOST_STEPS)
        if self.n_cells is not None:
            yield "n_cells", check_integer("n_cells", self.n_cells, 1)
        if self.error_target is not None:
            yield "error_target", check_number("error_target", self.error_target, above=0)

    @property
    def planned(self) -> bool:
        """Whether a plan leads from coarse to fine, and not one kind of step is repeated."""
        return self.method in _PLANNED


def uses(method: str, option: str) -> bool:
    """Tell whether an option of a run matters to `method`."""
    return method in _USERS.get(option, METHODS)


def warn_of_unused(given: Mapping[str, object], methods: Sequence[str], stacklevel: int) -> None:
    """Warn of each option that was `given`, though it matters to none of `methods`.

    Parameters
    ----------
    stacklevel : int
        Of the caller that is to see it, as `warnings.warn` would take it there.

    Warns
    -----
    UnusedOptionWarning
    """
    defaults = {option.name: option.default for option in fields(Options)}
    for name, value in given.items():
        idle = name not in _USERS or value in (defaults[name], _AS_IT_IS.get(name))
        if idle or any(uses(method, name) for method in methods):
            continue
        one = len(methods) == 1
        what = f"the method {methods[0]} does not use" if one else "none of the methods uses"
        warnings.warn(
            f"{name} is {value!r}, which {what}: it is for {', '.join(_USERS[name])}; leave it out, or choose one of "
            "these methods",
            UnusedOptionWarning,
            stacklevel=stacklevel + 1,
        )
