"""Checks at the door: what a caller passes is looked at once, here, and trusted from then on."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .errors import InputError, InputTypeError

if TYPE_CHECKING:
    from .domain import Domain


def check_points(points: object, domain: Domain) -> np.ndarray:
    """Return `points` as a float64 array (n, d) inside `domain`.

    Raises
    ------
    InputTypeError
        If `points` is not an array of real numbers.
    InputError
        If its shape is not (n, d) with n >= 1, or a value is not finite or outside; names the first.
    """
    if np.ma.is_masked(points):
        raise InputError(
            f"points has {np.ma.count_masked(points)} masked numbers, expected all to be there; pass "
            "numpy.ma.compress_rows(points)"
        )
    try:
        array = np.asarray(points)
    except ValueError as error:
        raise InputError(
            f"points is no array ({error}), expected shape (n, {domain.dim})"
        ) from error
    if array.dtype.kind not in "fiu":
        raise InputTypeError(
            f"points has dtype {array.dtype}, expected real numbers; convert with points.astype(float)"
        )
    d = domain.dim
    if array.ndim != 2 or array.shape[1] != d:
        remedy = "pass points.T" if array.ndim == 2 and array.shape[0] == d else "reshape it"
        raise InputError(f"points has shape {array.shape}, expected (n, {d}); {remedy}")
    if len(array) == 0:
        raise InputError(f"points has shape {array.shape}, expected at least one generator")
    array = array.astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
    if bad.size:
        raise InputError(
            f"points[{bad[0]}] is {array[bad[0]]}, expected finite numbers ({bad.size} of "
            f"{len(array)} points are not); remove them"
        )
    bad = np.flatnonzero(~domain.contains(array))
    if bad.size:
        raise InputError(
            f"points[{bad[0]}] is {array[bad[0]]}, outside {domain} ({bad.size} of {len(array)} "
            "points are); move or remove them, or enlarge the domain"
        )
    return array


def coincident_pair(points: np.ndarray) -> tuple[int, int] | None:
    """Return the indices of two equal rows of `points` (n, d), or None."""
    order = np.lexsort(points.T)
    equal = np.flatnonzero((np.diff(points[order], axis=0) == 0).all(axis=1))
    if not equal.size:
        return None
    i, j = sorted(order[equal[0] : equal[0] + 2].tolist())
    return i, j


def check_integer(name: str, value: object, least: int, most: float = 2**63 - 1) -> int:
    """Return `value` as an int of at least `least`, at most `most`."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise InputTypeError(
            f"{name} is {value!r} of type {type(value).__name__}, expected an integer"
        )
    if value < least:
        raise InputError(f"{name} is {value}, expected at least {least}")
    if value > most:
        raise InputError(f"{name} has {len(str(value))} digits, expected at most {most:.3g}")
    return int(value)


def check_number(
    name: str, value: object, *, above: float = -np.inf, least: float = -np.inf
) -> float:
    """Return `value` as a finite float above `above` and not under `least`."""
    try:
        if isinstance(value, str | bytes):  # in which float() would find a number
            raise TypeError
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputTypeError(
            f"{name} is {value!r} of type {type(value).__name__}, expected a number"
        ) from None
    except OverflowError:
        number = np.inf
    if not np.isfinite(number) or number <= above or number < least:
        bound = f"> {above:g}" if above > -np.inf else f">= {least:g}"
        raise InputError(f"{name} is {value!r}, expected a finite number {bound}")
    return number


def check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Refuse `value` if it is none of `choices`."""
    if value not in choices:
        raise InputError(f"{name} is {value!r}, expected one of {', '.join(choices)}")


class Naming:
    """Says which of the caller's points coincide, when the device has found that some do."""

    def __init__(self, points: np.ndarray, domain: Domain, real: np.dtype) -> None:
        self.points, self.domain, self.real = points, domain, real

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if not isinstance(error, InputError):
            return
        pair = coincident_pair(self.domain.place(self.points, self.real))
        if pair is not None:
            other = "" if self.real == np.float64 else " or use dtype='float64'"
            raise InputError(
                f"points[{pair[0]}] and points[{pair[1]}] coincide in {self.real}, expected distinct "
                f"generators; remove duplicates (numpy.unique(points, axis=0)){other}"
            ) from error
