"""The base class of size fields; constants, callables, and combinations of fields; fields as they are on a domain."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from functools import singledispatch
from numbers import Real
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from ..arguments import check_callable
from ..errors import ClvoroError, InputError, InputTypeError, SizeFieldError
from ..geometry.domain import Domain
from .arguments import check_positive

if TYPE_CHECKING:
    from .codegen import CodeWriter

_MAX_PARTS = 256  # kernels of 200 parts take 3 s to build, kernels of 400 parts 20 s


class Field:
    """A size field h(x): a call with points returns the sizes there.

    A call evaluates the field on the host in float64, as a reference. Fields with ``on_device`` are
    also evaluated on the device, as OpenCL from `generate_code`. Fields combine with each other, with positive numbers
    and with callables: ``f + g``, ``f * g``, ``f / g``, ``2 * f``, ``1 / f``, `minimum`, `maximum`. A combination is
    one function on the device. Values are multiplied and divided in the unit of the coordinates: one factor of a
    product is a plain number, such as a weight from a `Raster`.

    Attributes
    ----------
    dim : int or None
        2 or 3 if the field belongs to one dimension, None if it fits both.
    on_device : bool
        Whether the field has a device form.
    parts : int
        Number of fields in the combination, itself included; long formulas count more than once.
    on_sphere : bool
        Whether the field is one of a sphere, where fields of longitude and latitude may be combined with it.
    """

    dim: int | None = None
    on_device: bool = True
    parts: int = 1
    on_sphere: bool = False

    def __call__(self, points: object) -> np.ndarray:
        """Return h at `points`.

        - `points` (n, d) float: physical coordinates.

        The result is (n,) float64: sizes, in the unit of the coordinates.

        Raises `InputError` if `points` does not have the shape (n, d) with the field's d.
        """
        try:
            array = np.asarray(points, dtype=float)
        except (TypeError, ValueError) as error:
            raise InputTypeError(
                f"points of a size field are {type(points).__name__}, expected numbers of shape (n, d)"
            ) from error
        if array.ndim != 2 or array.shape[1] not in (2, 3):
            hint = "; pass points.T" if array.ndim == 2 and array.shape[0] in (2, 3) else ""
            raise InputError(f"points of a size field have shape {array.shape}, expected (n, 2) or (n, 3){hint}")
        self.check_dim(array.shape[1])
        return self._evaluate(array)

    def check_dim(self, dim: int) -> None:
        """Raise InputError if the field is not for `dim` dimensions."""
        if self.dim not in (None, dim):
            raise InputError(
                f"the size field {self!r} is for {self.dim} dimensions, got a domain or points "
                f"of {dim}; build it with {dim} coordinates"
                + (
                    ". If these are positions on a sphere, and the field is one of longitude and latitude, write "
                    "clvoro.earth.LonLat(field)(points)"
                    if dim == 3
                    else ""
                )
            )

    def map_parts(self, change: Callable[[Field], Field]) -> Field:
        """Return the field with `change` applied to each field that it combines."""
        return self

    def landmarks(self, domain: Domain) -> np.ndarray:
        """Return points (m, d) at which h is likely to be smallest, so that sampling does not miss small features.

        Their density follows the size of `domain`; they may lie outside of it. By default there are none.
        """
        return np.zeros((0, domain.dim))

    def warnings(self, domain: Domain) -> list[str]:
        """Return warnings for plausible mistakes in the field on `domain`, each with a remedy."""
        return []

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _emit(self, writer: CodeWriter) -> str:
        """Add the field to `writer` and return the name of the variable with h' = h / scale."""
        raise InputError(f"{self!r} has no form for the device; define _emit, or set on_device = False in its class")

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
            return Scaled(self, 1.0 / check_positive("a divisor of a size field", other))
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
        return _fold_constants(operation, [as_field(f) for f in operands])

    def __sub__(self, other: object) -> NoReturn:
        raise InputTypeError(
            f"{self!r} is subtracted or negated, but size fields have no -, because sizes are positive; write an "
            "Expression, or a function such as lambda points: field(points) - 0.1 * points[:, 0]"
        )

    __rsub__ = __sub__

    def __neg__(self) -> NoReturn:
        self.__sub__(None)

    def __pow__(self, other: object) -> NoReturn:
        raise InputTypeError(
            f"{self!r} is raised to a power, but size fields have no **; write an Expression, or a function such as "
            "lambda points: field(points) ** 0.5"
        )

    def __lt__(self, other: object) -> NoReturn:
        raise InputTypeError(
            f"{self!r} is compared with {other!r:.60}, but fields differ from point to point; write "
            "clvoro.sizing.minimum(...) or maximum(...), which compare at each point"
        )

    __gt__ = __le__ = __ge__ = __lt__

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: object, **options: object) -> Field:
        """Combine fields by NumPy's functions for ``+``, ``*``, ``/`` and `minimum` and `maximum`; reject others."""
        if ufunc in (np.subtract, np.negative):
            self.__sub__(None)
        operation = _OF_UFUNCS.get(ufunc)
        if operation is None or method != "__call__" or options:
            raise InputTypeError(
                f"numpy.{ufunc.__name__} got {self!r}, but a size field is not an array; write an Expression, or a "
                f"function such as lambda points: numpy.{ufunc.__name__}(field(points))"
            )
        numbers = [float(f) if isinstance(f, Real) else as_field(f) for f in inputs]
        return operation(*numbers)


class Constant(Field):
    """A constant size. A number that is given as a size field becomes one.

    Raises
    ------
    InputError
        If `value` is not positive and finite.
    """

    def __init__(self, value: float):
        self.value = check_positive("a constant size h", value)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return np.full(len(points), self.value)

    def _emit(self, writer: CodeWriter) -> str:
        return writer.variable(f"data[{writer.store(self.value / writer.scale)}]")

    def __repr__(self) -> str:
        return f"Constant({self.value!r})"


class Scaled(Field):
    """A field times a positive number: ``2 * field``."""

    def __init__(self, field: Field, factor: float):
        self.field, self.factor = field, check_positive("a factor of a size field", factor)
        self.dim, self.on_device, self.on_sphere = field.dim, field.on_device, field.on_sphere
        self.parts = count_parts(field)

    def check_dim(self, dim: int) -> None:  # noqa: D102
        self.field.check_dim(dim)

    def map_parts(self, change: Callable[[Field], Field]) -> Field:  # noqa: D102
        return Scaled(change(self.field), self.factor)

    def landmarks(self, domain: Domain) -> np.ndarray:  # noqa: D102
        return self.field.landmarks(domain)

    def warnings(self, domain: Domain) -> list[str]:  # noqa: D102
        return self.field.warnings(domain)

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        return self.factor * self.field._evaluate(points)

    def _emit(self, writer: CodeWriter) -> str:
        inner = self.field._emit(writer)
        return writer.variable(f"data[{writer.store(self.factor)}] * {inner}")

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
    """Two or more fields, combined by one of ``+``, ``*``, ``/``, ``min``, ``max`` from left to right."""

    def __init__(self, operation: str, *fields: Field):
        dims = {f.dim for f in fields if f.dim is not None}
        self.on_sphere = any(f.on_sphere for f in fields)
        if len(dims) > 1 and not self.on_sphere:
            raise InputError(
                f"a size field was combined from fields of {sorted(dims)} dimensions, expected "
                "fields of the same dimension"
            )
        self.operation, self.fields = operation, fields
        self.dim = max(dims, default=None)
        self.on_device = all(f.on_device for f in fields)
        self.parts = count_parts(*fields)

    def check_dim(self, dim: int) -> None:  # noqa: D102
        for f in self.fields:
            f.check_dim(dim)

    def map_parts(self, change: Callable[[Field], Field]) -> Field:  # noqa: D102
        return Combined(self.operation, *map(change, self.fields))

    def landmarks(self, domain: Domain) -> np.ndarray:  # noqa: D102
        return np.concatenate([f.landmarks(domain) for f in self.fields])

    def warnings(self, domain: Domain) -> list[str]:  # noqa: D102
        return [text for f in self.fields for text in f.warnings(domain)]

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        combine = _COMBINE[self.operation][0]
        result = self.fields[0]._evaluate(points)
        for f in self.fields[1:]:
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                result = combine(result, f._evaluate(points))
        return result

    def _emit(self, writer: CodeWriter) -> str:
        template = _COMBINE[self.operation][1]
        name = self.fields[0]._emit(writer)
        scale = writer.store(writer.scale) if "scale" in template else None
        for f in self.fields[1:]:
            name = writer.variable(template.format(name, f._emit(writer), scale=scale))
        return name

    def __repr__(self) -> str:
        if self.operation in "+*/":
            return "(" + f" {self.operation} ".join(map(repr, self.fields)) + ")"
        return f"{self.operation}imum({', '.join(map(repr, self.fields))})"


def minimum(*fields: object) -> Field:
    """Return the pointwise minimum of `fields` (fields, numbers or callables) as a field."""
    return _combined("min", fields)


def maximum(*fields: object) -> Field:
    """Return the pointwise maximum of `fields` (fields, numbers or callables) as a field."""
    return _combined("max", fields)


_OF_UFUNCS: dict[object, Callable[..., Field]] = {
    np.add: operator.add,
    np.multiply: operator.mul,
    np.divide: operator.truediv,
    np.minimum: minimum,
    np.maximum: maximum,
}


def _combined(operation: str, fields: tuple[object, ...]) -> Field:
    if not fields:
        raise InputError(f"{operation}imum got no size field, expected at least one")
    made: list[Field] = []
    for f in map(as_field, fields):
        alike = isinstance(f, Combined) and f.operation == operation
        made += f.fields if alike else [f]  # type: ignore[attr-defined]
    constants = [f for f in made if isinstance(f, Constant)]
    if len(constants) > 1:
        others = [f for f in made if not isinstance(f, Constant)]
        made = [*others, _fold_constants(operation, constants)]
    return made[0] if len(made) == 1 else Combined(operation, *made)


def _fold_constants(operation: str, fields: Sequence[Field]) -> Field:
    """Return `fields` combined. Constants combine to a constant, if that is a valid size."""
    if all(isinstance(f, Constant) for f in fields):
        value = fields[0].value  # type: ignore[attr-defined]
        with np.errstate(over="ignore", under="ignore"):
            for f in fields[1:]:
                value = float(_COMBINE[operation][0](value, f.value))  # type: ignore[attr-defined]
        if 0 < value < math.inf:
            return Constant(value)
    return Combined(operation, *fields)


def count_parts(*fields: Field) -> int:
    """Return the number of parts of a combination of `fields`.

    Raises `InputError` if there are too many to build kernels.
    """
    parts = sum(f.parts for f in fields)
    if parts > _MAX_PARTS:
        raise InputError(
            f"a size field is combined from {parts} parts, expected at most {_MAX_PARTS}, because larger kernels take "
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
    # These modules import this one.
    from .distance import Shape

    if callable(size):
        return Function(size)

    hint = ""
    if isinstance(size, str):
        hint = f"; write sizing.Expression({size!r})"
    elif isinstance(size, (np.ndarray, list, tuple)):
        hint = "; write sizing.Raster(values, lower, upper), or points= for initial generators"
    elif isinstance(size, Shape):
        hint = "; write sizing.Distance(shape, h_min, growth) for cells that grow away from it"
    raise InputTypeError(
        f"size is {type(size).__name__}, expected a number, a callable h(points (n, d)) -> (n,) "
        f"or a field of clvoro.sizing{hint}"
    )


@singledispatch
def on_domain(domain: Domain, field: Field) -> Field:
    """Return `field` for `domain`: the same, unless a function is registered for domains of this kind."""
    del domain
    return field


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

    def __repr__(self) -> str:
        return f"Function({getattr(self.function, '__name__', type(self.function).__name__)})"
