"""Options of a run, checked when they are made, and the methods that use each of them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from numbers import Real
from typing import Any, Literal, NamedTuple, TypedDict, get_args

import numpy as np
from numpy.typing import ArrayLike

from ..arguments import (
    check_callable,
    check_choice,
    check_flag,
    check_integer,
    check_number,
    check_path,
    check_points,
    warn,
)
from ..errors import InputError, InputTypeError, UnusedOptionWarning
from ..geometry.boundary_layers import Layers
from ..geometry.domain import Domain
from .fixed_points import check_fixed
from .methods import MOVING, PUBLISHED

MethodName = Literal[
    "adaptive",
    "exact",
    "transport",
    "lloyd",
    "poisson",
    "coupled",
    "weighted-lloyd",
    "weighted",
    "mmpde",
    "monge-ampere",
]
EffortName = Literal["fast", "default", "best"]
Start = Literal["density", "uniform"]
METHODS, EFFORTS, STARTS = get_args(MethodName), get_args(EffortName), get_args(Start)
_MULTILEVEL = ("adaptive", "exact", "transport")
_MOST_STEPS = 10**6  # schedule and history are lists with one entry per step

_USERS = {
    "effort": _MULTILEVEL,
    "levels": _MULTILEVEL,
    "error_target": _MULTILEVEL,
    "correct": _MULTILEVEL,
    "tol": (*PUBLISHED, *MOVING),
    "alpha": ("lloyd", "poisson", "coupled"),  # "lloyd" reports the correction that it leaves out
    "k": PUBLISHED,
    "start": tuple(name for name in METHODS if name not in MOVING),
}
"""Options that only some methods use, and these methods."""
_WITHOUT_EFFECT = {"tol": 0, "levels": 0}
"""Values that change nothing in the other methods: these take all steps, and have no coarser levels."""

_CHECKS: dict[str, Callable[[str, object], float]] = {
    "levels": partial(check_integer, least=0, beside="'auto'"),
    "error_target": partial(check_number, above=0),
    "tol": partial(check_number, least=0),
    "alpha": partial(check_number, above=0),
    "k": partial(check_number, above=0),
    "seed": partial(check_integer, least=0, most=np.inf),
    "max_steps": partial(check_integer, least=0, most=_MOST_STEPS),
    "n_cells": partial(check_integer, least=1),
    "correct": check_flag,
    "every": lambda name, value: math.inf if value == math.inf else check_number(name, value, least=0),
}


def _check_values(options: Any) -> None:
    """Replace the numbers and flags among the fields of `options` by checked ones."""
    for option in fields(options):
        value = getattr(options, option.name)
        absent = value is None or (isinstance(value, str) and value == "auto")
        if option.name in _CHECKS and not (absent and value == option.default):
            object.__setattr__(options, option.name, _CHECKS[option.name](option.name, value))


@dataclass(frozen=True)
class MultilevelOptions:
    """Options of the methods "adaptive", "exact" and "transport", which go from coarse to fine levels.

    Parameters
    ----------
    levels : int or "auto"
        Number of coarser levels before the finest one. Level l has the size 2^l h. With generators of the caller it is
        the number of refinements that lead from them to the finest level.
    error_target : float, optional
        Mean |log(L / h)| that the last steps aim at; a larger one gives cells of a better shape. By default .0025
        (effort "fast": .0035, "best": .0039) where sizes are smooth. In the plane, with more than about 2,800 cells,
        it grows with the share of the cells where sizes are steep, |grad h| > .1, up to .0155 ("fast": .007,
        "best": .01). On spheres, in 3D and with "exact" it does not. In 2D the default nearly meets targets from 1e-4
        on, from about 2,800 cells on; "best" ends at .00014 to .0002, "fast" with a target of .001 at .004, and runs
        with one level at .0007 to .0009. The shape is as good as it gets at a mean error of about .05 on steep fields,
        of .03 on smooth ones ("fast": .06 to .07, and .04). With a larger target the mesh stays there,
        ``settings["trade"]`` says so, and the largest error stays bounded to about .25 ("fast": .28).
    correct : bool
        Whether a mesh of the caller that nearly has the sizes is only corrected. A correction changes it little, and
        many of them add up to cells of a poorer shape. With False the run takes all its steps.

    Raises
    ------
    InputError, InputTypeError
        If `levels` is not an integer >= 0, or `error_target` is not positive and finite.

    Examples
    --------
    >>> options = clvoro.MultilevelOptions(levels=0, error_target=0.01)
    >>> clvoro.Adapter().run(clvoro.Box((0, 0), (1, 1)), 0.1, options=options).settings["levels"]
    0
    """

    levels: int | Literal["auto"] = "auto"
    error_target: float | None = None
    correct: bool = True

    def __post_init__(self) -> None:
        _check_values(self)


@dataclass(frozen=True)
class PaperOptions:
    """Options of the methods that repeat one kind of step: the paper's, the weighted ones and moving meshes.

    Parameters
    ----------
    tol : float
        Stop when mean error and mean quality have improved by less than this share over ten steps. With 0 the run
        takes all steps. "mmpde" stops when ten steps have decreased its functional by less than this share of the
        decrease so far, "monge-ampere" when the logarithm of its equation is constant to this number.
    alpha : float, optional
        Largest relaxation coefficient of the correction, in the paper's (3.4); by default d. Only "lloyd", "poisson"
        and "coupled" use it.
    k : float
        Bound of the correction's length over h, in the paper's (3.5). "weighted-lloyd" and "weighted" bound the whole
        displacement; moving meshes do not use it.

    Raises
    ------
    InputError, InputTypeError
        If `tol` is negative, `alpha` or `k` is not positive, or one of them is not a finite number.

    Examples
    --------
    >>> options = clvoro.PaperOptions(tol=0, alpha=1, k=0.3)
    >>> result = clvoro.Adapter().run(
    ...     clvoro.Box((0, 0), (1, 1)), 0.1, method="coupled", max_steps=5, options=options
    ... )
    >>> result.settings["k"]
    0.3
    """

    tol: float = 1e-3
    alpha: float | None = None
    k: float = 0.5

    def __post_init__(self) -> None:
        _check_values(self)


@dataclass(frozen=True)
class Checkpoint:
    """A file from which a run continues after the process has ended.

    The file is replaced only when the new one is complete. A file that is not a checkpoint is never replaced. Over
    ranks each has a piece beside the file, which a run on any number of ranks, or without ranks, continues.

    A run with checkpoints computes its mesh anew from the generators after every tenth step, whether or not it writes
    one there. So its mesh does not depend on the times of writing, and a resumed run has the same bits as one that was
    not interrupted. A run without checkpoints has other bits, and a mesh as good.

    Parameters
    ----------
    path : path, optional
        File that the run writes at intervals, and when its callback or Ctrl-C stops it. With None nothing is written.
    every : float
        Least number of seconds between two checkpoints. With `math.inf` there is only the one of a run that is stopped,
        and a run that is not has the bits of one without checkpoints. With 0 the run computes its mesh anew, and writes
        a checkpoint, after every step and after every change of the number of cells.
    resume : path or True, optional
        Checkpoint to continue from; True takes `path`, if that file exists. The other arguments of the run must be the
        same as before. On the same device the run then ends with the same bits (`seconds` in the history apart), unless
        a callback has stopped it between two places where it computes its mesh anew.

    Raises
    ------
    InputError, InputTypeError
        If `every` is negative, or `resume` is True without a `path`.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "run.checkpoint"
    >>> half = clvoro.Checkpoint(file, every=0, resume=True)
    >>> box, adapter = clvoro.Box((0, 0), (1, 1)), clvoro.Adapter()
    >>> first = adapter.run(box, 0.2, checkpoint=half, callback=lambda row: row["step"] == 3)
    >>> adapter.run(box, 0.2, checkpoint=half).history["step"][:4].tolist()
    [0, 1, 2, 3]
    """

    path: str | os.PathLike[str] | None = None
    every: float = 60.0
    resume: str | os.PathLike[str] | Literal[True] | None = None

    def __post_init__(self) -> None:
        _check_values(self)
        if isinstance(self.resume, bool) and self.resume and self.path is None:
            raise InputError(
                "resume is True without a path, expected Checkpoint(path, resume=True) or Checkpoint(resume=path)"
            )
        if self.path is None and self.every != Checkpoint.every:
            warn(
                f"every is {self.every:g} without a path: no checkpoint is written; give Checkpoint(path, every)",
                UnusedOptionWarning,
            )

    @property
    def source(self) -> str | os.PathLike[str] | None:
        """The file to continue from now, if any."""
        if not isinstance(self.resume, bool):
            return self.resume
        return self.path if self.resume and os.path.exists(check_path("checkpoint", self.path)) else None


@dataclass(frozen=True)
class Options:
    """All options of a run in one place; see `Adapter.run`. `levels` is settled when the number of cells is known.

    Raises `InputError` or `InputTypeError` if a value is not as expected.
    Warns with `UnusedOptionWarning` if an option is given that the method does not use.
    """

    method: str = "adaptive"
    start: str = "density"
    effort: str = "default"
    levels: int | str = MultilevelOptions.levels
    seed: int = 0
    tol: float = PaperOptions.tol
    k: float = PaperOptions.k
    alpha: float | None = None
    max_steps: int | None = None
    n_cells: int | None = None
    error_target: float | None = None
    correct: bool = True
    layers: Sequence[Layers] = ()

    def __post_init__(self) -> None:
        if isinstance(self.method, str) and self.method in EFFORTS:
            raise InputError(f"method is {self.method!r}, which is an effort; write effort={self.method!r}")
        check_choice("method", self.method, METHODS)
        check_choice("points", self.start, STARTS)
        if not isinstance(self.effort, str):
            raise InputTypeError(
                f"effort is {self.effort!r:.60} of type {type(self.effort).__name__}, expected one of "
                f"{', '.join(EFFORTS)}; the size comes second and the effort third: run(domain, size, 'default')"
            )
        if self.effort in METHODS:
            raise InputError(f"effort is {self.effort!r}, which is a method; write method={self.effort!r}")
        check_choice("effort", self.effort, EFFORTS)
        layers: object = self.layers  # the caller may give one Layers
        if not isinstance(layers, Layers | Sequence):
            hint = f"; write clvoro.Layers({layers!r})" if isinstance(layers, Real) else ""
            raise InputTypeError(f"layers is {layers!r}, expected clvoro.Layers or a sequence of them{hint}")
        _check_values(self)
        object.__setattr__(self, "layers", (layers,) if isinstance(layers, Layers) else tuple(layers))
        for layer in self.layers:
            if not isinstance(layer, Layers):
                raise InputTypeError(f"layers has a {type(layer).__name__}, expected clvoro.Layers")
        if self.layers and self.method == "transport":
            raise InputError(
                "layers are given with the method transport, expected none: the cells of a power diagram do not keep "
                "their rows; use method='exact'"
            )
        warn_of_unused(vars(self), [self.method])

    @property
    def multilevel(self) -> bool:
        """Whether a plan leads from coarse to fine, in place of one kind of step that is repeated."""
        return self.method in _MULTILEVEL


class RunOptions(TypedDict, total=False):
    """Arguments of `Adapter.run` beside the domain, the size, the effort and the callback."""

    points: ArrayLike | Start
    method: MethodName
    n_cells: int | None
    layers: Layers | Sequence[Layers]
    fixed: ArrayLike | os.PathLike[str] | Mapping[str, Any] | None
    seed: int
    max_steps: int | None
    options: MultilevelOptions | PaperOptions | None
    checkpoint: str | os.PathLike[str] | Checkpoint | None


class RunArguments(NamedTuple):
    """Arguments of `Adapter.run`."""

    domain: Domain
    size: object
    options: Options
    points: Any = None
    """Generators of the caller, if they are not random."""
    fixed: Any = None
    checkpoint: Any = None

    @classmethod
    def of(
        cls,
        domain: Domain,
        size: object,
        points: ArrayLike | Start = "density",
        options: object = None,
        fixed: object = None,
        checkpoint: object = None,
        **given: Any,
    ) -> RunArguments:
        """Merge all options, and check what does not need the domain.

        Raises
        ------
        InputError, InputTypeError
            If a value is not as expected.
        """
        if options is not None and not isinstance(options, MultilevelOptions | PaperOptions):
            raise InputTypeError(
                f"options is {options!r:.60} of type {type(options).__name__}, expected clvoro.MultilevelOptions "
                "(methods adaptive, exact, transport) or clvoro.PaperOptions (the other methods)"
            )
        start, own = (points, None) if isinstance(points, str) else ("density", points)
        special = {} if options is None else vars(options)
        merged = Options(start=start, **given, **special)
        if isinstance(size, Domain) and not isinstance(domain, Domain):
            raise InputTypeError(
                f"size is the domain {size!r}, and domain is a {type(domain).__name__}; exchange them: run(domain, "
                "size)"
            )
        return cls(domain, size, merged, own, fixed, checkpoint)

    def checked(self, real: np.dtype) -> RunArguments:
        """Return the same with arrays in place of `points` and `fixed`, and a `Checkpoint`.

        Raises `InputError` or `InputTypeError` if generators are not distinct positions inside the domain.
        """
        files = self.checkpoint if isinstance(self.checkpoint, Checkpoint) else Checkpoint(self.checkpoint)
        points = None if self.points is None else check_points(self.points, self.domain)
        return self._replace(points=points, fixed=check_fixed(self.fixed, self.domain, real), checkpoint=files)


def check_callback(callback: Callable[[np.void], object] | None) -> None:
    """Check the function that a run calls with each row of its history.

    Raises `InputTypeError`.
    """
    if callback is None:
        return
    if not callable(callback):
        raise InputTypeError(
            f"callback is {callback!r} of type {type(callback).__name__}, expected a function of a row of the history"
        )
    check_callable("callback", callback, "a row of the history", "write lambda row: callback(...)")


def arguments_of_run(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `Adapter.run` for the `settings` of a case.

    The fields of `MultilevelOptions` or `PaperOptions` become `options`. The name of a start becomes `points`.
    """
    given = dict(settings)
    start = given.pop("start", None)
    if start is not None:
        given.setdefault("points", start)
    for kind in (MultilevelOptions, PaperOptions):
        mine = {f.name: given.pop(f.name) for f in fields(kind) if f.name in given}
        if mine:
            given["options"] = kind(**mine)
    return given


def uses(method: str, option: str) -> bool:
    """Return whether `method` uses an option of a run."""
    return method in _USERS.get(option, METHODS)


def warn_of_unused(given: Mapping[str, object], methods: Sequence[str]) -> None:
    """Warn of each option that is `given` and that none of `methods` uses.

    Warns with `UnusedOptionWarning`.
    """
    defaults = {option.name: option.default for option in fields(Options)}
    for name, value in given.items():
        idle = name not in _USERS or value in (defaults[name], _WITHOUT_EFFECT.get(name))
        if idle or any(uses(method, name) for method in methods):
            continue
        one = len(methods) == 1
        what = f"the method {methods[0]} does not use" if one else "none of the methods uses"
        warn(
            f"{name} is {value!r}, which {what}: it is for {', '.join(_USERS[name])}; leave it out, or choose one of "
            "these methods",
            UnusedOptionWarning,
        )
