"""The pictures of a mesh by its kind: what `Diagram.plot` and `Result.plot` draw."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from typing import Any, Literal

from numpy.typing import ArrayLike

from ..errors import InputError
from ..geometry.domain import Domain
from ..mesh.diagram import Diagram
from ..mesh.results import Result
from .cells import plot_cells
from .colors import Color, picture_of
from .globe import plot_globe
from .solids import plot_cutaway, plot_slice, plot_slices

View = Literal["cells", "globe", "slices", "slice", "cutaway"]
VIEWS: dict[str, Callable[..., Any]] = {
    "cells": plot_cells,
    "globe": plot_globe,
    "slices": plot_slices,
    "slice": plot_slice,
    "cutaway": plot_cutaway,
}


def views_of(domain: Domain) -> tuple[str, ...]:
    """Return the views of meshes in `domain`, the default first."""
    if domain.curved:
        return ("globe",)
    return {2: ("cells",), 3: ("slices", "slice", "cutaway")}[domain.cell_dim]


def plot_mesh(
    mesh: Result | Diagram, color: Color | ArrayLike = "error", view: View | None = None, **options: Any
) -> Any:
    """Draw a mesh; see `Diagram.plot`.

    Raises
    ------
    InputError, InputTypeError
        If the mesh does not have the view, the view does not have an option, or a color does not exist.
    MissingLibraryError
        If a library for this view is not installed.
    """
    fitting = views_of(picture_of(mesh).diagram.domain)
    chosen = fitting[0] if view is None else view
    if chosen not in fitting:
        raise InputError(f"view is {view!r}, expected one of {', '.join(fitting)} for this mesh")
    known = [name for name in signature(VIEWS[chosen]).parameters if name not in ("mesh", "color")]
    for name in options:
        if name not in known:
            others = [k for k, draw in VIEWS.items() if name in signature(draw).parameters]
            where = f"is an option of the view {' and '.join(others)}" if others else "is no option"
            raise InputError(f"{name} {where}; the view {chosen} has {', '.join(known)}")
    return VIEWS[chosen](mesh, color, **options)
