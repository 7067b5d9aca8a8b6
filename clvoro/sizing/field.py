"""The base of all size fields, the simplest ones, and what combines them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from numbers import Real
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from ..arguments import check_callable
from ..errors import ClvoroError, InputError, InputTypeError, SizeFieldError
from .arguments import positive

if TYPE_CHECKING:
    from ..geometry.box import Domain
    from .bind import Binder

_MOST_PARTS = 256  # the time to build kernels grows faster than they do: 3 s for 200, 20 s for 400


class Field:
    """A size field h(x): called with points it gives sizes.

    Every field is evaluated on the host by calling it, in float64: slow, and the reference. Fields
    with ``on_device`` true are also turned into OpenCL by `bind`. Fields combine with each other,
    with positive numbers and with callables: ``f + g``, ``f * g``, ``f / g``, ``2 * f``, ``1 / f``,
    `minimum`, `maximum`. The combination is itself one function on the device, so that the gradient
    of h is taken of it as a whole. Numbers are multiplied and divided as they stand, in the unit of
    the coordinates: one of the factors is a plain number, such as a weight from a `Raster`.

    Attributes
    ----------
    dim : int or None
        2 or 3 if the field belongs to one dimension, None if it fits both.
    on_device : bool
        Whether the field has a device form.
    parts : int
        Number of fields that it is combined from, itself among them; long formulas count more than once.
    """

    dim: int | None = None
    on_device: bool = True
    parts: int = 1

    def __call__(self, points: object) -> np.ndarray:
        """Return h at `points`.

        Parameters
        ----------
        points : (n, d) float
            Physical coordinates.

        Returns
        -------
        (n,) float64
            Sizes, in the unit of the coordinates.

        Raises
        ------
        InputError
            If `points` does not have the shape (n, d) with the field's d.
        """
        try:
            array = np.asarray(points, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputTypeError(
                f"points of a size field are {type(points).__name__}, expected numbers of "
                "shape (n, d)"
            ) from error
        if array.ndim != 2 or array.shape[1] not in (2, 3):
            hint = "; pass points.T" if array.ndim == 2 and array.shape[0] in (2, 3) else ""
            raise InputError(
                f"points of a size field have shape {array.shape}, expected (n, 2) or (n, 3){hint}"
            )
        self.check_dim(array.shape[1])
        return self._evaluate(array)

    def check_dim(self, dim: int) -> None:
        """Raise InputError if the field cannot serve `dim` dimensions."""
        if self.dim is not None and self.dim != dim:
            raise InputError(
                f"the size field {self!r} is for {self.dim} dimensions, got a domain or points "
                f"of {dim}; build it with {dim} coordinates"
            )

    def with_parts(self, change: Callable[[Field], Field]) -> Field:
        """Return the field with `change` applied to each of the fields that it combines, if any."""
        return self

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return points (m, d) at which h is likely to be least, for those who must see it.

        They may lie outside `domain`, whose size tells how dense they should be. By default none.
        """
        return np.zeros((0, domain.dim))

    def misfits(self, domain: Domain) -> list[str]:
        """Return what in the field is a mistake on `domain`, most likely: sentences, each with a remedy."""
        return []

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _emit(self, binder: Binder) -> str:
        """Add the field to `binder` and return the name of the variable that holds h'."""
        raise NotImplementedError

    def __mul__(self, other: object) -> Field:
        if isinstance(other, Real):
            return Scaled(self, float(other))
        return self._combine("*", self, other)

    def __rmul__(self, other: object) -> Field:
        if isinstance(other, Real):
            return Scaled(self, float(other))
        return self._combine("*", other, self)

    def __truediv__(self, other: object) -> Field:
        if isinstance(other, Real):
            return Scaled(self, 1.0 / positive("a divisor of a size field", other))
        return self._combine("/", self, other)

    def __rtruediv__(self, other: object) -> Field:
        return self._combine("/", other, self)

    def __add__(self, other: object) -> Field:
        return self._combine("+", self, other)

    def __radd__(self, other: object) -> Field:
        return self._combine("+", other, self)

    @staticmethod
    def _combine(operation: str, *operands: object) -> Field:
        if not all(isinstance(f, (Field, Real)) or callable(f) for f in operands):
            return NotImplemented
        return _folded(operation, [as_field(f) for f in operands])

    def __sub__(self, other: object) -> NoReturn:
        raise InputTypeError(
            f"{self!r} is subtracted from or negated, and sizes are positive: size fields have no -; write one "
            "Expression, or a function such as lambda points: field(points) - 0.1 * points[:, 0]"
        )

    __rsub__ = __sub__

    def __neg__(self) -> NoReturn:
        self.__sub__(None)

    def __pow__(self, other: object) -> NoReturn:
        raise InputTypeError(
            f"{self!r} is raised to a power, and size fields have no **; write one Expression, or a function such as "
            "lambda points: field(points) ** 0.5"
        )

    def __lt__(self, other: object) -> NoReturn:
        raise InputTypeError(
            f"{self!r} is compared with {other!r:.60}, and neither is smaller everywhere; write "
            "clvoro.sizing.minimum(...) or maximum(...), which choose at each point"
        )

    __gt__ = __le__ = __ge__ = __lt__

    # NumPy leaves operators between its arrays and a field to the field, which then refuses them.
    __array_ufunc__ = None


class Constant(Field):
    """The same size everywhere; a plain number given as size field becomes one.

    Raises
    ------
    InputError
        If `value` is not positive and finite.
    """

    def __init__(self, value: float):
        self.value = positive("a constant size h", value)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return np.full(len(points), self.value)

    def _emit(self, binder: Binder) -> str:
        return binder.variable(f"data[{binder.store(self.value / binder.scale)}]")

    def __repr__(self) -> str:
        return f"Constant({self.value!r})"


class Function(Field):
    """A vectorized Python callable ``h(points (n, d)) -> (n,)``, evaluated on the host.

    Each evaluation brings the points to the host and takes the sizes back (8 to 16 bytes per
    coordinate both ways, and the queue waits meanwhile), and runs at the speed of the callable,
    1 + 2 d times where the gradient of h is needed too. A field combined with a `Function` is
    combined on the host. Where a `Raster`, `Distance` or `Expression` can say the same, it is much
    faster.

    The callable gets C-contiguous float64 points in physical coordinates, inside the domain or on
    its walls.
    """

    on_device = False

    def __init__(self, function: Callable[[np.ndarray], object]):
        if not callable(function):
            raise InputTypeError(
                f"Function got {type(function).__name__}, expected a callable "
                "h(points (n, d)) -> (n,)"
            )
        check_callable(
            "size", function, "points (n, d)",
            "write lambda points: h(points[:, 0], points[:, 1]) around a function of x and y",
        )  # fmt: skip
        self.function = function

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        n = len(points)
        try:
            # A copy: what the function does to its argument is its own affair.
            given = self.function(np.array(points, dtype=float, order="C"))
        except (TypeError, ValueError) as error:
            if isinstance(error, ClvoroError):
                raise
            # Formulas for a single point end so, most likely.
            kind = InputTypeError if isinstance(error, TypeError) else InputError
            raise kind(
                f"{self!r} failed for points of shape {points.shape} ({error}), expected sizes of shape ({n},); it "
                "must be vectorized: points[:, 0] are all x, numpy.sqrt takes arrays, and numpy.where stands for if"
            ) from error
        try:
            sizes = np.asarray(given)
        except Exception as error:  # whatever an array of another library says
            raise InputTypeError(
                f"{self!r} returned a {type(given).__name__} that is no array ({error}), expected real numbers of "
                f"shape ({n},)"
            ) from error
        if np.ma.is_masked(given):
            raise SizeFieldError(
                f"{self!r} returned {np.ma.count_masked(given)} masked sizes for {n} points, expected all to be there; "
                "fill them, by numpy.ma.filled(sizes, value)"
            )
        if sizes.dtype.kind not in "fiu":
            what = "None" if given is None else f"values of type {sizes.dtype}"
            raise InputTypeError(f"{self!r} returned {what}, expected real numbers of shape ({n},)")
        if sizes.shape != (n,):
            hint = "it must be vectorized, h(points (n, d)) -> (n,)"
            if sizes.shape == ():
                hint = "it must be vectorized; of a size that is the same everywhere give the number itself"
            elif sizes.shape == (n, 1):
                hint = "return its only column, sizes[:, 0]"
            elif sizes.shape == points.shape[1:]:
                hint = "it must be vectorized: points[:, 0] are all x, points[0] is a point"
            raise InputError(
                f"{self!r} returned shape {sizes.shape} for {n} points, expected ({n},); {hint}"
            )
        return sizes.astype(float)

    def _emit(self, binder: Binder) -> str:
        raise InputError(
            f"{self!r} runs on the host and has no device form; use Expression, Raster or Distance"
        )

    def __repr__(self) -> str:
        return f"Function({getattr(self.function, '__name__', type(self.function).__name__)})"


class Scaled(Field):
    """A field times a positive number; made by ``2 * field``."""

    def __init__(self, field: Field, factor: float):
        self.field, self.factor = field, positive("a factor of a size field", factor)
        self.dim, self.on_device = field.dim, field.on_device
        self.parts = counted(field)

    def check_dim(self, dim: int) -> None:  # noqa: D102
        self.field.check_dim(dim)

    def with_parts(self, change: Callable[[Field], Field]) -> Field:  # noqa: D102
        return Scaled(change(self.field), self.factor)

    def landmarks(self, domain: Domain) -> np.ndarray:  # noqa: D102
        return self.field.landmarks(domain)

    def misfits(self, domain: Domain) -> list[str]:  # noqa: D102
        return self.field.misfits(domain)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self.factor * self.field._evaluate(points)

    def _emit(self, binder: Binder) -> str:
        inner = self.field._emit(binder)
        return binder.variable(f"data[{binder.store(self.factor)}] * {inner}")

    def __repr__(self) -> str:
        return f"{self.factor!r} * {self.field!r}"


# With h' = h / scale on the device, (h g)' = h' (g' scale) and (h / g)' = h' / (g' scale).
_COMBINE = {
    "+": (np.add, "{} + {}"),
    "*": (np.multiply, "{} * ({} * data[{scale}])"),
    "/": (np.divide, "{} / ({} * data[{scale}])"),
    "min": (np.minimum, "size_min({}, {})"),
    "max": (np.maximum, "size_max({}, {})"),
}


class Combined(Field):
    """Two or more fields under one of ``+``, ``*``, ``/``, ``min``, ``max``, from left to right."""

    def __init__(self, operation: str, *fields: Field):
        dims = {f.dim for f in fields if f.dim is not None}
        if len(dims) > 1:
            raise InputError(
                f"a size field was combined from fields of {sorted(dims)} dimensions, expected "
                "fields of the same dimension"
            )
        self.operation, self.fields = operation, fields
        self.dim = dims.pop() if dims else None
        self.on_device = all(f.on_device for f in fields)
        self.parts = counted(*fields)

    def check_dim(self, dim: int) -> None:  # noqa: D102
        for f in self.fields:
            f.check_dim(dim)

    def with_parts(self, change: Callable[[Field], Field]) -> Field:  # noqa: D102
        return Combined(self.operation, *map(change, self.fields))

    def landmarks(self, domain: Domain) -> np.ndarray:  # noqa: D102
        return np.concatenate([f.landmarks(domain) for f in self.fields])

    def misfits(self, domain: Domain) -> list[str]:  # noqa: D102
        return [text for f in self.fields for text in f.misfits(domain)]

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        combine = _COMBINE[self.operation][0]
        result = self.fields[0]._evaluate(points)
        for f in self.fields[1:]:
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                result = combine(result, f._evaluate(points))
        return result

    def _emit(self, binder: Binder) -> str:
        template = _COMBINE[self.operation][1]
        name = self.fields[0]._emit(binder)
        scale = binder.store(binder.scale) if "scale" in template else None
        for f in self.fields[1:]:
            name = binder.variable(template.format(name, f._emit(binder), scale=scale))
        return name

    def __repr__(self) -> str:
        if self.operation in "+*/":
            return "(" + f" {self.operation} ".join(map(repr, self.fields)) + ")"
        return f"{self.operation}imum({', '.join(map(repr, self.fields))})"


def minimum(*fields: object) -> Field:
    """Return the least of `fields` (fields, numbers or callables) at each point, as a field."""
    return _combined("min", fields)


def maximum(*fields: object) -> Field:
    """Return the greatest of `fields` (fields, numbers or callables) at each point, as a field."""
    return _combined("max", fields)


def _combined(operation: str, fields: tuple[object, ...]) -> Field:
    if not fields:
        raise InputError(f"{operation}imum got no size field, expected at least one")
    made: list[Field] = []
    for f in map(as_field, fields):
        alike = isinstance(f, Combined) and f.operation == operation
        made += f.fields if alike else [f]  # type: ignore[attr-defined]
    constants = [f for f in made if isinstance(f, Constant)]
    if len(constants) > 1:  # one does for all
        others = [f for f in made if not isinstance(f, Constant)]
        made = [*others, _folded(operation, constants)]
    return made[0] if len(made) == 1 else Combined(operation, *made)


def _folded(operation: str, fields: Sequence[Field]) -> Field:
    """Return `fields` combined; constants alone make a constant, where it is one that a size may have."""
    if all(isinstance(f, Constant) for f in fields):
        value = fields[0].value  # type: ignore[attr-defined]
        with np.errstate(over="ignore", under="ignore"):
            for f in fields[1:]:
                value = float(_COMBINE[operation][0](value, f.value))  # type: ignore[attr-defined]
        if 0 < value < math.inf:
            return Constant(value)
    return Combined(operation, *fields)


def counted(*fields: Field) -> int:
    """Return the number of parts of a field that stands on `fields`.

    Raises
    ------
    InputError
        If they are too many for compilers of kernels, and for Python to go through.
    """
    parts = sum(f.parts for f in fields)
    if parts > _MOST_PARTS:
        raise InputError(
            f"a size field is combined from {parts} parts, expected at most {_MOST_PARTS}: kernels of more take "
            "minutes to build; put many shapes into one Distance, many values into a Raster, or write a callable "
            "of NumPy arrays"
        )
    return 1 + parts


def as_field(size: object) -> Field:
    """Return `size` as a `Field`: a number becomes a `Constant`, a callable a `Function`.

    Raises
    ------
    InputTypeError
        If it is neither a number, nor a callable, nor a field.
    """
    if isinstance(size, Field):
        return size
    if isinstance(size, np.ndarray) and size.ndim == 0:
        size = size.item()
    if isinstance(size, Real) and not isinstance(size, (bool, np.bool_)):
        return Constant(size)  # type: ignore[arg-type]
    if callable(size):
        return Function(size)
    from .distance import Shape  # which stands on this

    hint = ""
    if isinstance(size, str):
        hint = f"; write sizing.Expression({size!r})"
    elif isinstance(size, (np.ndarray, list, tuple)):
        hint = (
            "; write sizing.Raster(values, lower, upper), and points= for generators to start from"
        )
    elif isinstance(size, Shape):
        hint = "; write sizing.Distance(shape, h_min, growth) for cells that grow away from it"
    raise InputTypeError(
        f"size is {type(size).__name__}, expected a number, a callable h(points (n, d)) -> (n,) "
        f"or a field of clvoro.sizing{hint}"
    )
