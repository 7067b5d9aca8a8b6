"""Errors that clvoro raises; all derive from `ClvoroError`, but for `Interrupted`, and warnings."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .mesh.results import Result


class ClvoroError(Exception):
    """Base of every error that clvoro raises."""


class InputError(ClvoroError, ValueError):
    """An argument has the wrong value or shape: what arrived, what was expected, the remedy."""


class InputTypeError(ClvoroError, TypeError):
    """An argument has the wrong type."""


class OutputError(InputError):
    """A file cannot be written: no such folder, no right, no space."""


class DeviceError(ClvoroError, RuntimeError):
    """No usable OpenCL device, or the device lacks what was asked of it."""


class BuildError(DeviceError):
    """A kernel did not compile; the message carries the compiler's log."""


class MemoryLimitError(ClvoroError, MemoryError):
    """A run needs more memory than the device has; says how many cells and bytes."""


class SizeFieldError(InputError):
    """A size field is not positive and finite on the domain; the message names the place."""


class SolverError(ClvoroError, ArithmeticError):
    """A linear solve broke down (not positive definite, or not finite)."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C during a run. It carries the mesh so far, of the size and the number of cells that were requested.

    Attributes
    ----------
    result : Result
        Its `stop_reason` is "interrupted". Its quality and errors are those of an unfinished run.

    Examples
    --------
    >>> def press(row):
    ...     if row["step"] == 3:
    ...         raise KeyboardInterrupt  # as Ctrl-C does
    >>> try:
    ...     mesh = clvoro.adapt(clvoro.Box((0, 0), (1, 1)), 0.1, "fast", callback=press)
    ... except clvoro.Interrupted as interrupted:
    ...     mesh = interrupted.result
    >>> mesh.stop_reason
    'interrupted'
    """

    def __init__(self, result: Result) -> None:
        super().__init__("interrupted: the mesh so far is in the exception's attribute `result`")
        self.result = result


class Aborted(BaseException):
    """The user quits at once. A run does not catch it, unlike KeyboardInterrupt."""


class CheckpointWarning(UserWarning):
    """A checkpoint could not be written; the run goes on, and the one from before is still there."""


class CoarseSizeWarning(UserWarning):
    """A size field asks for less than half a cell in the whole domain: units that do not agree, most likely."""


class MisfitWarning(UserWarning):
    """A part of the input hardly meets the domain or the sizes: units or places that do not agree, most likely."""


class PrecisionWarning(UserWarning):
    """A run cannot meet its size field as well as usual in the precision asked for; says what limits it."""


class SizeErrorWarning(UserWarning):
    """A mesh does not meet its size field, which changes faster than cells can follow; says where."""


class UnusedOptionWarning(UserWarning):
    """An option of a run was given that its method does not use; names the methods that do."""
