"""A size field from a formula in a small language, which is parsed here."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np

from ..errors import InputError, InputTypeError
from .field import Field

if TYPE_CHECKING:
    from .codegen import CodeWriter

_MAX_LENGTH = 4096  # characters
_MAX_DEPTH = 40  # of nested brackets and ?:
_OPERATIONS = 32  # per part of a combined field

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?![\w.])"
    r"|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<operator><=|>=|==|!=|&&|\|\||[-+*/()<>?:,!]))",
    re.ASCII,
)

_CONSTANTS = {"pi": math.pi, "M_PI": math.pi}
_AXES = {"x": 0, "y": 1, "z": 2, "lon": 0, "lat": 1}
_DEGREES = {"lon", "lat"}


class _Function(NamedTuple):
    arguments: int
    opencl: str
    numpy: Callable[..., np.ndarray]


def _smoothstep(low: np.ndarray, high: np.ndarray, value: np.ndarray) -> np.ndarray:
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


_FUNCTIONS = {
    **{
        name: _Function(1, name, getattr(np, name))
        for name in (
            "fabs",
            "sqrt",
            "cbrt",
            "exp",
            "exp2",
            "log",
            "log2",
            "log10",
            "sin",
            "cos",
            "tan",
            "sinh",
            "cosh",
            "tanh",
            "floor",
            "ceil",
        )
    },
    "abs": _Function(1, "fabs", np.abs),
    "asin": _Function(1, "asin", np.arcsin),
    "acos": _Function(1, "acos", np.arccos),
    "atan": _Function(1, "atan", np.arctan),
    "atan2": _Function(2, "atan2", np.arctan2),
    "pow": _Function(2, "pow", np.power),
    "hypot": _Function(2, "hypot", np.hypot),
    "fmod": _Function(2, "fmod", np.fmod),
    "min": _Function(2, "size_min", np.minimum),
    "fmin": _Function(2, "size_min", np.minimum),
    "max": _Function(2, "size_max", np.maximum),
    "fmax": _Function(2, "size_max", np.maximum),
    "clamp": _Function(3, "clamp", lambda v, low, high: np.minimum(np.maximum(v, low), high)),
    "mix": _Function(3, "mix", lambda a, b, t: a + (b - a) * t),
    "step": _Function(2, "step", lambda edge, v: np.where(v < edge, 0.0, 1.0)),
    "smoothstep": _Function(3, "smoothstep", _smoothstep),
}

# Precedence of the binary operators, as in C.
_PRECEDENCE = {"||": 1, "&&": 2, "==": 3, "!=": 3, "<": 4, ">": 4, "<=": 4, ">=": 4, "+": 5, "-": 5, "*": 6, "/": 6}
_TRUTH = frozenset(("||", "&&", "==", "!=", "<", ">", "<=", ">="))

_NUMPY = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    "<": np.less,
    ">": np.greater,
    "<=": np.less_equal,
    ">=": np.greater_equal,
    "==": np.equal,
    "!=": np.not_equal,
    "&&": np.logical_and,
    "||": np.logical_or,
}


class _Node(NamedTuple):
    """One operation. `arguments` are indices of earlier nodes, so that a list is evaluated in order."""

    kind: str  # "number", "axis", "negate", "not", "choose", "binary", "call"
    value: Any
    arguments: tuple[int, ...] = ()


class Expression(Field):
    """A formula in x, y (and z): ``Expression("0.02 + 0.3*fabs(hypot(x-0.9, y-0.75)-0.3)")``.

    The formula is written as in OpenCL C, with this grammar::

        formula = truth [ "?" formula ":" formula ]
        truth   = sums joined by  < > <= >=  == !=  (not chained)  &&  ||
        sum     = products joined by  + -
        product = factors joined by  * /
        factor  = { + - ! } value
        value   = number | x | y | z | lon | lat | pi | "(" formula ")" | name "(" formula { "," formula } ")"

    Functions: abs fabs sqrt cbrt exp exp2 log log2 log10 sin cos tan asin acos atan atan2 sinh cosh
    tanh floor ceil pow hypot fmod min fmin max fmax clamp mix step smoothstep. Precedence is that
    of C.

    *All numbers are real*: ``1/2`` is 0.5. A comparison is 1 or 0; any number but 0 is true. Both sides of ``?:``,
    ``&&`` and ``||`` are evaluated. x, y, z are physical coordinates. lon and lat are
    degrees on a `clvoro.Sphere`, and otherwise other names of x and y. In float32 they have 7 digits, so the origin
    should be near the domain.

    The text is parsed into a list of operations, and the OpenCL code is generated from that list, never from the text.

    Raises
    ------
    InputError
        If the text is not a formula; the message has the column.
    """

    def __init__(self, text: str):
        if not isinstance(text, str):
            raise InputTypeError(f"Expression got {type(text).__name__}, expected a string")
        self.text = text
        parser = _Parser(text)
        self._nodes = parser.parse()
        self._axes = 1 + max((n.value for n in self._nodes if n.kind == "axis"), default=-1)
        used = {word for kind, word, _ in parser.tokens if kind == "name" and word in _AXES}
        if used & _DEGREES and used - _DEGREES:
            raise InputError(f"Expression {text!r} has {', '.join(sorted(used))}, expected lon and lat, or x, y and z")
        self.dim = 2 if used & _DEGREES else 3 if self._axes == 3 else None
        self.parts = 1 + len(self._nodes) // _OPERATIONS

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        values: list[Any] = []
        with np.errstate(all="ignore"):
            for kind, value, arguments in self._nodes:
                a = [values[i] for i in arguments]
                if kind == "number":
                    result = np.float64(value)
                elif kind == "axis":
                    result = points[:, value]
                elif kind == "negate":
                    result = -a[0]
                elif kind == "not":
                    result = np.equal(a[0], 0).astype(float)
                elif kind == "choose":
                    result = np.where(a[0] != 0, a[1], a[2])
                elif kind == "call":
                    result = _FUNCTIONS[value].numpy(*a)
                else:
                    result = _NUMPY[value](*a)
                    if value in _TRUTH:
                        result = result.astype(float)
                values.append(result)
        return np.array(np.broadcast_to(values[-1], (len(points),)), dtype=float)

    def _emit(self, writer: CodeWriter) -> str:
        frame = writer.store(writer.scale, 1.0 / writer.scale, writer.origin)
        exponents = self._exponents()
        names: list[str] = []
        for node, (kind, value, arguments) in enumerate(self._nodes):
            a = [names[i] for i in arguments]
            if kind == "number":
                # Formulas that differ in numbers share a kernel. The compiler knows powers of given exponents.
                code = f"(REAL)({value!r})" if node in exponents else f"data[{writer.store(value)}]"
            elif kind == "axis":
                code = f"x[{value}] * data[{frame}] + data[{frame + 2 + value}]"
            elif kind == "negate":
                code = f"-{a[0]}"
            elif kind == "not":
                code = f"(REAL)({a[0]} == 0)"
            elif kind == "choose":
                code = f"{a[0]} != 0 ? {a[1]} : {a[2]}"
            elif kind == "call":
                code = f"{_FUNCTIONS[value].opencl}({', '.join(a)})"
            elif value in _TRUTH:
                code = f"(REAL)({a[0]} {value} {a[1]})"
            else:
                code = f"{a[0]} {value} {a[1]}"
            names.append(writer.variable(code))
        return writer.variable(f"{names[-1]} * data[{frame + 1}]")

    def _exponents(self) -> set[int]:
        """Return the nodes that are second arguments of `pow`, and the numbers that such nodes negate."""
        found = {arguments[1] for _, value, arguments in self._nodes if value == "pow"}
        for node in range(len(self._nodes) - 1, -1, -1):
            if node in found and self._nodes[node].kind == "negate":
                found.update(self._nodes[node].arguments)
        return found

    def __repr__(self) -> str:
        short = self.text if len(self.text) <= 60 else self.text[:57] + "..."
        return f"Expression({short!r})"


class _Parser:
    """Recursive descent with precedence climbing. The last node of the result is the value."""

    def __init__(self, text: str):
        self.text = text
        if len(text) > _MAX_LENGTH:
            raise InputError(
                f"Expression has {len(text)} characters, expected at most {_MAX_LENGTH}; use a Raster instead"
            )
        self.tokens = self._tokens()
        self.at = 0
        self.depth = 0
        self.nodes: list[_Node] = []

    def parse(self) -> list[_Node]:
        self._formula()
        if self._kind() != "end":
            self._fail(f"unexpected {self._word()!r}, expected an operator or the end")
        return self.nodes

    def _tokens(self) -> list[tuple[str, str, int]]:
        found, position = [], 0
        end = len(self.text.rstrip())
        while position < end:
            match = _TOKEN.match(self.text, position)
            if match is None:
                rest = self.text[position:]
                column = position + len(rest) - len(rest.lstrip())
                self._reject(column)
            kind = match.lastgroup or ""
            found.append((kind, match[kind], match.start(kind)))
            position = match.end()
        found.append(("end", "", end))
        return found

    def _reject(self, column: int) -> NoReturn:
        rest = self.text[column:]
        number = re.match(r"\.?\d[\w.]*", rest, re.ASCII)
        if number:
            self._fail(f"{number[0]!r} is not a number; write 0.5 or 5e-1, without suffix", column)
        others = {"^": "; write pow(a, b) for a power", "%": "; write fmod(a, b) for a remainder"}
        self._fail(f"unexpected character {rest[0]!r}{others.get(rest[0], '')}", column)

    def _kind(self) -> str:
        return self.tokens[self.at][0]

    def _word(self) -> str:
        return self.tokens[self.at][1]

    def _fail(self, what: str, column: int | None = None) -> NoReturn:
        column = self.tokens[self.at][2] if column is None else column
        begin = max(0, column - 20)
        near = self.text[begin : column + 20]
        raise InputError(
            f"Expression, column {column + 1}, near {near!r}: {what}. Allowed are numbers, "
            "x, y, z, lon, lat, pi, + - * / ( ), comparisons, && || !, ?: and the functions "
            "listed in clvoro.sizing.Expression"
        )

    def _take(self, word: str) -> bool:
        if self._kind() == "operator" and self._word() == word:
            self.at += 1
            return True
        return False

    def _need(self, word: str) -> None:
        if not self._take(word):
            got = repr(self._word()) if self._kind() != "end" else "the end"
            self._fail(f"expected {word!r}, got {got}")

    def _add(self, kind: str, value: object, *arguments: int) -> int:
        self.nodes.append(_Node(kind, value, arguments))
        return len(self.nodes) - 1

    def _formula(self) -> int:
        self.depth += 1
        if self.depth > _MAX_DEPTH:
            self._fail(f"nested more than {_MAX_DEPTH} deep; simplify it, or use a Raster")
        result = self._binary(1)
        if self._take("?"):
            yes = self._formula()
            self._need(":")
            no = self._formula()
            result = self._add("choose", None, result, yes, no)
        self.depth -= 1
        return result

    def _binary(self, least: int) -> int:
        left = self._unary()
        compared = False
        while self._kind() == "operator" and _PRECEDENCE.get(self._word(), 0) >= least:
            word = self._word()
            comparison = _PRECEDENCE[word] in (3, 4)
            if comparison and compared:
                self._fail("comparisons cannot be chained; write a < b && b < c")
            self.at += 1
            if word == "*" and self._kind() == "operator" and self._word() == "*":
                self._fail("there is no operator **; write pow(a, b)")
            right = self._binary(_PRECEDENCE[word] + 1)
            left = self._add("binary", word, left, right)
            compared = comparison
        return left

    def _unary(self) -> int:
        signs = []
        while self._kind() == "operator" and self._word() in "+-!":
            signs.append(self._word())
            self.at += 1
        result = self._primary()
        for sign in reversed(signs):
            if sign != "+":
                result = self._add("negate" if sign == "-" else "not", None, result)
        return result

    def _primary(self) -> int:
        kind, word, _ = self.tokens[self.at]
        if kind == "number":
            value = float(word)
            if not math.isfinite(value):
                self._fail(f"{word} is too large for a number")
            self.at += 1
            return self._add("number", value)
        if kind == "name":
            return self._name(word)
        if self._take("("):
            result = self._formula()
            self._need(")")
            return result
        if kind == "end":
            self._fail("it ends where a value is expected" if self.tokens[:-1] else "it is empty")
        self._fail(f"unexpected {word!r}, expected a value")
        raise AssertionError

    def _name(self, word: str) -> int:
        if word in _AXES or word in _CONSTANTS:
            self.at += 1
            if word in _AXES:
                return self._add("axis", _AXES[word])
            return self._add("number", _CONSTANTS[word])
        if word not in _FUNCTIONS:
            self._fail(f"unknown name {word!r}")
        begin = self.at
        self.at += 1
        self._need("(")
        arguments = [self._formula()]
        while self._take(","):
            arguments.append(self._formula())
        self._need(")")
        expected = _FUNCTIONS[word].arguments
        if len(arguments) != expected:
            self._fail(f"{word} got {len(arguments)} arguments, expected {expected}", self.tokens[begin][2])
        return self._add("call", word, *arguments)
