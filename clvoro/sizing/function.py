"""Size fields of Python callables, evaluated on the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ..arguments import check_callable
from ..errors import ClvoroError, InputError, InputTypeError, SizeFieldError
from .field import Field

if TYPE_CHECKING:
    from .codegen import CodeWriter


class Function(Field):
    """A vectorized Python callable ``h(points (n, d)) -> (n,)``, evaluated on the host.

    Each evaluation copies the points to the host and the sizes back, while the device waits, and calls the function
    once, or 1 + 2 d times for the gradient of h. Combinations with a `Function` are evaluated on the host. A `Raster`,
    `Distance` or `Expression` is much faster.

    The callable gets C-contiguous float64 points in physical coordinates, inside the domain or on its walls.
    """

    on_device = False

    def __init__(self, function: Callable[[np.ndarray], object]):
        if not callable(function):
            raise InputTypeError(
                f"Function got {type(function).__name__}, expected a callable h(points (n, d)) -> (n,)"
            )
        check_callable(
            "size",
            function,
            "points (n, d)",
            "write lambda points: h(points[:, 0], points[:, 1]) around a function of x and y",
        )
        self.function = function

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        n = len(points)
        try:
            # A copy, because the function may change its argument.
            given = self.function(np.array(points, dtype=float, order="C"))
        except (TypeError, ValueError) as error:
            if isinstance(error, ClvoroError):
                raise
            # Functions of a single point typically fail like this.
            kind = InputTypeError if isinstance(error, TypeError) else InputError
            raise kind(
                f"{self!r} failed for points of shape {points.shape} ({error}), expected sizes of shape ({n},); it "
                "must be vectorized: points[:, 0] are all x, numpy.sqrt takes arrays, and numpy.where replaces if"
            ) from error
        try:
            sizes = np.asarray(given)
        except Exception as error:  # arrays of other libraries may raise any error
            raise InputTypeError(
                f"{self!r} returned a {type(given).__name__} that is not an array ({error}), expected real numbers of "
                f"shape ({n},)"
            ) from error
        if np.ma.is_masked(given):
            raise SizeFieldError(
                f"{self!r} returned {np.ma.count_masked(given)} masked sizes for {n} points, expected none; "
                "fill them with numpy.ma.filled(sizes, value)"
            )
        if sizes.dtype.kind not in "fiu":
            what = "None" if given is None else f"values of type {sizes.dtype}"
            raise InputTypeError(f"{self!r} returned {what}, expected real numbers of shape ({n},)")
        if sizes.shape != (n,):
            hint = "it must be vectorized, h(points (n, d)) -> (n,)"
            if sizes.shape == ():
                hint = "it must be vectorized; for a constant size give the number itself"
            elif sizes.shape == (n, 1):
                hint = "return its only column, sizes[:, 0]"
            elif sizes.shape == points.shape[1:]:
                hint = "it must be vectorized: points[:, 0] are all x, points[0] is a point"
            raise InputError(f"{self!r} returned shape {sizes.shape} for {n} points, expected ({n},); {hint}")
        return sizes.astype(float)

    def _emit(self, writer: CodeWriter) -> str:
        raise InputError(f"{self!r} runs on the host and has no device form; use Expression, Raster or Distance")

    def __repr__(self) -> str:
        return f"Function({getattr(self.function, '__name__', type(self.function).__name__)})"
