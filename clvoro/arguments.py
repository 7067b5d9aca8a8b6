"""Checks of arguments: values are checked once, where the caller passes them."""

from __future__ import annotations

import inspect
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from os import fsdecode, fsencode, fspath
from typing import TYPE_CHECKING

import numpy as np

from .errors import InputError, InputTypeError

if TYPE_CHECKING:
    from .geometry.domain import Domain

WARNING: ContextVar[Callable[[str, type[Warning]], object] | None] = ContextVar("WARNING", default=None)
"""A function that `warn` calls with message and category instead of giving the warning; each thread has its own."""


def warn(message: str, category: type[Warning]) -> None:
    """Give a warning at the line of the user's code that called clvoro, or call `WARNING` instead."""
    if (other := WARNING.get()) is not None:
        other(message, category)
        return
    frame, level = sys._getframe(1), 2
    package = __name__.partition(".")[0]
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)


def format_point(place: Iterable[float], unit: str = "") -> str:
    """Return coordinates as text for messages: six digits, and tenths of large ones, as those of national grids."""
    return "(" + ", ".join(_digits(float(x)) + unit for x in place) + ")"


def counted(n: int, what: str) -> str:
    """Return a number of things as text for messages: "1 cell", "2 cells"."""
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _digits(x: float) -> str:
    return f"{x:.1f}".removesuffix(".0") if 1e5 <= abs(x) < 1e9 else f"{x:.6g}"


def check_cell_values(name: str, values: object, n: int, *, finite: bool = True, least: int = 1) -> np.ndarray:
    """Return data of `n` cells as an array (n,) or (n, k) with at least `least` columns.

    With `finite` it is of float64, else of the type of `values`.

    Raises `InputError` or `InputTypeError` if they are no such real numbers, some are masked, or with `finite` some are
    not finite; names the first row.
    """
    expected = f"expected ({n},) or ({n}, k)"
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InputError(f"{name} cannot be converted to an array ({error}), {expected}") from error
    if np.ma.is_masked(values):
        raise InputError(f"{name} has masked numbers, expected none; fill them")
    if array.dtype.kind not in "fiub":
        raise InputTypeError(
            f"{name} has dtype {array.dtype}, expected real numbers; pass the real and the imaginary part of complex "
            "numbers as two columns"
        )
    if array.ndim not in (1, 2) or len(array) != n or (array.ndim == 2 and array.shape[1] < least):
        transposed = array.ndim == 2 and array.shape[1] == n
        raise InputError(
            f"{name} has shape {array.shape}, {expected}: a row for each cell of the mesh; "
            + ("pass values.T" if transposed else "pass the mesh that the values belong to")
        )
    if not finite:
        return array
    array = array.astype(float)
    bad = np.flatnonzero(~np.isfinite(array.reshape(n, -1)).all(axis=1))
    if bad.size:
        raise InputError(
            f"{name}[{bad[0]}] is {array[bad[0]]}, expected finite numbers ({bad.size} of {n} rows are not): replace "
            "them first. Has the solver diverged?"
        )
    return array


def check_points(points: object, domain: Domain, name: str = "points") -> np.ndarray:
    """Return `points` as a float64 array (n, d) inside `domain`; errors call them `name`.

    Raises `InputTypeError` if `points` is not an array of real numbers. Raises `InputError` if its shape is not (n, d)
    with n >= 1, or a value is not finite or outside; names the first.
    """
    array = domain.check_rows(name, points)
    if len(array) == 0:
        raise InputError(f"{name} has shape {array.shape}, expected at least one generator")
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise InputError(
            f"{name}[{bad[0]}] is {array[bad[0]]}, expected finite numbers ({bad.size} of "
            f"{len(array)} points are not); remove them"
        )
    bad = np.flatnonzero(~domain.contains(array))
    if bad.size:
        raise InputError(
            f"{name}[{bad[0]}] is {array[bad[0]]}, outside {domain} ({bad.size} of {len(array)} "
            "points are); move or remove them, or enlarge the domain"
        )
    return array


def check_rows(name: str, value: object, d: int) -> np.ndarray:
    """Return `value`, an array_like of real numbers, as a float64 array (n, d); n may be 0.

    Raises `InputTypeError` if it holds anything but real numbers. Raises `InputError` if it has another shape, or
    numbers are masked.
    """
    if np.ma.is_masked(value):
        raise InputError(
            f"{name} has {np.ma.count_masked(value)} masked numbers, expected none; pass numpy.ma.compress_rows(array)"
        )
    expected = f"expected an array of real numbers of shape (n, {d}), one row per point"
    try:
        array = np.asarray(value)
    except Exception as error:  # arrays of other libraries raise anything
        kind = InputError if isinstance(error, ValueError) else InputTypeError
        raise kind(f"{name} is not an array ({error}); {expected}") from error
    if array.ndim == 0:
        inner = getattr(value, "points", None)
        hint = f"; pass its points, {name}.points" if isinstance(inner, np.ndarray) else ""
        if isinstance(value, Iterator):
            hint = f"; pass list({name})"
        raise InputTypeError(f"{name} is of type {type(value).__name__}, {expected}{hint}")
    if array.size == 0 and array.ndim < 3:
        return np.empty((0, d))
    if array.dtype.kind not in "fiu":
        hint = "convert with astype(float)"
        if array.dtype.kind == "c":
            hint = "pass numpy.column_stack([z.real, z.imag])"
        if array.dtype.names:
            hint = "pass numpy.lib.recfunctions.structured_to_unstructured(array)"
        raise InputTypeError(f"{name} has dtype {array.dtype}, expected real numbers; {hint}")
    if array.ndim != 2 or array.shape[1] != d:
        remedy = "reshape it"
        if array.ndim == 2:
            remedy = "pass its transpose, array.T"
            if array.shape[0] != d:
                remedy = f"pass its coordinates, array[:, :{d}]"
        if array.ndim == 2 and array.shape[1] < d:
            remedy = f"points have {d} coordinates here"
        if array.ndim == 1:
            one = len(array) == d
            remedy = "pass [point] for a single one" if one else "pass numpy.column_stack([x, y]), say"
        raise InputError(f"{name} has shape {array.shape}, expected (n, {d}); {remedy}")
    return array.astype(np.float64)


def check_path(name: str, value: object) -> str:
    """Return `value`, the name of a file, as a string."""
    try:
        path = fspath(value)  # type: ignore[call-overload]
    except TypeError:
        raise InputTypeError(
            f"{name} is {value!r} of type {type(value).__name__}, expected the name of a file"
        ) from None
    path = fsdecode(path)
    if "\0" in path:
        raise InputError(f"{name} is {path!r}, expected the name of a file, without zero bytes")
    try:
        fsencode(path)
    except UnicodeEncodeError as error:
        raise InputError(
            f"{name} is {path!r}, expected the name of a file, in characters that the file system knows "
            f"({error.reason})"
        ) from None
    return path


def check_callable(name: str, value: Callable[..., object], argument: str, hint: str) -> None:
    """Reject a callable whose signature does not accept one argument. Callables without a signature pass."""
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):  # many built-in functions have no signature
        return
    try:
        signature.bind(None)
    except TypeError:
        what = getattr(value, "__name__", type(value).__name__)
        if isinstance(value, type):
            raise InputTypeError(f"{name} is the class {what}, expected an object; write {what}(...)") from None
        raise InputTypeError(
            f"{name} is the {what}{signature}, expected a callable of one argument, {argument}; {hint}"
        ) from None


def coincident_pair(points: np.ndarray) -> tuple[int, int] | None:
    """Return the indices of two equal rows of `points` (n, d), or None."""
    order = np.lexsort(points.T)
    equal = np.flatnonzero((np.diff(points[order], axis=0) == 0).all(axis=1))
    if not equal.size:
        return None
    i, j = sorted(order[equal[0] : equal[0] + 2].tolist())
    return i, j


def check_integer(name: str, value: object, least: int, most: float = 2**63 - 1, beside: str = "") -> int:
    """Return `value` as an int from `least` to `most`; errors name the values that are allowed `beside` integers."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        expected = f"an integer or {beside}" if beside else "an integer"
        raise InputTypeError(f"{name} is {value!r} of type {type(value).__name__}, expected {expected}")
    if value < least:
        raise InputError(f"{name} is {value}, expected at least {least}")
    if value > most:
        raise InputError(f"{name} has {len(str(value))} digits, expected at most {most:.3g}")
    return int(value)


def check_flag(name: str, value: object) -> bool:
    """Return `value` as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise InputTypeError(f"{name} is {value!r:.60} of type {type(value).__name__}, expected True or False")
    return bool(value)


def check_number(name: str, value: object, *, above: float = -np.inf, least: float = -np.inf) -> float:
    """Return `value` as a finite float > `above` and >= `least`."""
    try:
        if isinstance(value, str | bytes):  # float() would accept them
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputTypeError(f"{name} is {value!r} of type {type(value).__name__}, expected a number") from None
    except OverflowError:
        number = np.inf
    if not np.isfinite(number) or number <= above or number < least:
        bound = f" > {above:g}" if above > -np.inf else f" >= {least:g}" if least > -np.inf else ""
        raise InputError(f"{name} is {value!r}, expected a finite number{bound}")
    return number


def check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Reject `value` unless it is one of `choices`."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{name} is {value!r:.60}, expected one of {', '.join(choices)}")


FIRST_ROWS = "numpy.sort(numpy.unique({}, axis=0, return_index=True)[1])"
"""NumPy expression for the first row of each set of equal rows, in ascending order; `{}` is the array."""


@contextmanager
def coincident_named(points: np.ndarray, domain: Domain, real: np.dtype) -> Iterator[None]:
    """Name the caller's coincident points in an error by which the device has found that some coincide."""
    try:
        yield
    except InputError as error:
        pair = coincident_pair(domain.place(points, real))
        if pair is None:
            raise
        other = "" if real == np.float64 else " or use dtype='float64'"
        raise InputError(
            f"points[{pair[0]}] and points[{pair[1]}] coincide in {real}, expected distinct "
            f"generators; keep the first of each: points[{FIRST_ROWS.format('points')}]{other}"
        ) from error
