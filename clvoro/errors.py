"""Errors and warnings of clvoro. All errors except `Interrupted` derive from `ClvoroError`."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .mesh.results import Result


class ClvoroError(Exception):
    """Base of every error that clvoro raises."""


class InputError(ClvoroError, ValueError):
    """An argument has the wrong value or shape. The message says what arrived, what was expected, and the remedy."""


class InputTypeError(ClvoroError, TypeError):
    """An argument has the wrong type."""


class OutputError(InputError):
    """A file cannot be written: no folder, no permission, the disk is full, or OpenFOAM rejects the mesh."""


class DeviceError(ClvoroError, RuntimeError):
    """No OpenCL device works, or the device lacks a required feature."""


class BuildError(DeviceError):
    """A kernel did not compile; the message contains the compiler's log."""


class MemoryLimitError(ClvoroError, MemoryError):
    """A run needs more memory than the device has; the message names cells and bytes."""


class SizeFieldError(InputError):
    """A size field is not positive and finite on the domain; the message names the place."""


class MissingLibraryError(ClvoroError):
    """An optional library is not installed; the message names the extra that installs it."""


class SolverError(ClvoroError, ArithmeticError):
    """A linear solve broke down (not positive definite, or not finite)."""


class RankError(ClvoroError, RuntimeError):
    """Another rank of the run has failed; the message has its error."""


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
    """A checkpoint could not be written. The run continues, and the previous checkpoint is kept."""


class CoarseSizeWarning(UserWarning):
    """The size field gives less than half a cell in the whole domain: probably the units differ."""


class EmptyCellsWarning(UserWarning):
    """Cells of a power diagram are empty, because of the weights of their generators; the message says how many."""


class LostFieldsWarning(UserWarning):
    """Fields of a case of OpenFOAM are not transferred to its next mesh; the message names them."""


class MismatchWarning(UserWarning):
    """A part of the input does not match the domain or the sizes: units or positions probably differ."""


class MissingPicturesWarning(UserWarning):
    """A report has no pictures of a kind, for which a library is not installed; the message says what to install."""


class ObtuseTrianglesWarning(UserWarning):
    """A mesh on a sphere has obtuse Delaunay triangles, unfit for C grids; the message says how many, where and why."""


class PrecisionWarning(UserWarning):
    """The precision is too low for a run to reach its target sizes as well as usual; the message says why."""


class SizeErrorWarning(UserWarning):
    """The cells of a finished mesh are far from their target sizes; the message says where and why."""


class SolverWarning(UserWarning):
    """A solver's own check of a mesh was requested, and the solver is not installed."""


class TangledMeshWarning(UserWarning):
    """A moving mesh would fold; the message says how many cells are concerned."""


class UnusedOptionWarning(UserWarning):
    """An option was given that the method of a run does not use; the message names the methods that do."""
