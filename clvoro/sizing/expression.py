"""A size field from a formula in a small language, which Python's `ast` parses."""

from __future__ import annotations

import ast
import bisect
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
_PYTHON = {"&&": "and", "||": "or", "!": "~", "?": "if (", ":": ") else"}
"""Python's words for those of C, of the same precedence. ``a ? b : c`` becomes ``a if (b) else c``, which Python parses
as a choice with the parts `body`, `test` and `orelse`, here condition, first and second value."""

_CONSTANTS = {"pi": math.pi, "M_PI": math.pi}
_AXES = {"x": 0, "y": 1, "z": 2, "lon": 0, "lat": 1}
_DEGREES = {"lon", "lat"}


class _Operation(NamedTuple):
    arguments: int
    opencl: str
    numpy: Callable[..., np.ndarray]


def _smoothstep(low: np.ndarray, high: np.ndarray, value: np.ndarray) -> np.ndarray:
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _call(arguments: int, name: str, numpy: Callable[..., np.ndarray]) -> _Operation:
    return _Operation(arguments, f"{name}({', '.join(['{}'] * arguments)})", numpy)


def _truth(opencl: str, numpy: Callable[..., Any]) -> _Operation:
    return _Operation(opencl.count("{}"), f"(REAL)({opencl})", lambda *a: numpy(*a).astype(float))


_SAME_NAME = "fabs sqrt cbrt exp exp2 log log2 log10 sin cos tan sinh cosh tanh floor ceil"
_FUNCTIONS = {
    **{name: _call(1, name, getattr(np, name)) for name in _SAME_NAME.split()},
    "abs": _call(1, "fabs", np.abs),
    "asin": _call(1, "asin", np.arcsin),
    "acos": _call(1, "acos", np.arccos),
    "atan": _call(1, "atan", np.arctan),
    "atan2": _call(2, "atan2", np.arctan2),
    "pow": _call(2, "pow", np.power),
    "hypot": _call(2, "hypot", np.hypot),
    "fmod": _call(2, "fmod", np.fmod),
    "min": _call(2, "size_min", np.minimum),
    "fmin": _call(2, "size_min", np.minimum),
    "max": _call(2, "size_max", np.maximum),
    "fmax": _call(2, "size_max", np.maximum),
    "clamp": _call(3, "clamp", lambda v, low, high: np.minimum(np.maximum(v, low), high)),
    "mix": _call(3, "mix", lambda a, b, t: a + (b - a) * t),
    "step": _call(2, "step", lambda edge, v: np.where(v < edge, 0.0, 1.0)),
    "smoothstep": _call(3, "smoothstep", _smoothstep),
}
_OPERATORS: dict[type[ast.AST], _Operation] = {
    ast.Add: _Operation(2, "{} + {}", np.add),
    ast.Sub: _Operation(2, "{} - {}", np.subtract),
    ast.Mult: _Operation(2, "{} * {}", np.multiply),
    ast.Div: _Operation(2, "{} / {}", np.divide),
    ast.USub: _Operation(1, "-{}", np.negative),
    ast.Invert: _truth("{} == 0", np.logical_not),
    ast.Lt: _truth("{} < {}", np.less),
    ast.Gt: _truth("{} > {}", np.greater),
    ast.LtE: _truth("{} <= {}", np.less_equal),
    ast.GtE: _truth("{} >= {}", np.greater_equal),
    ast.Eq: _truth("{} == {}", np.equal),
    ast.NotEq: _truth("{} != {}", np.not_equal),
    ast.And: _truth("{} && {}", np.logical_and),
    ast.Or: _truth("{} || {}", np.logical_or),
    ast.IfExp: _Operation(3, "{} != 0 ? {} : {}", lambda a, b, c: np.where(a != 0, b, c)),
}


class _Node(NamedTuple):
    """A number, the index of a coordinate, or an operation on earlier nodes, so that a list is evaluated in order."""

    value: float | int | _Operation
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

    Python parses the text, after its words have been checked. The result is a list of known operations, and the OpenCL
    code is generated from that list, never from the text.

    Raises
    ------
    InputError
        If the text is not a formula; the message has the column.
    """

    def __init__(self, text: str):
        if not isinstance(text, str):
            raise InputTypeError(f"Expression got {type(text).__name__}, expected a string")
        self.text = text
        if len(text) > _MAX_LENGTH:
            raise InputError(
                f"Expression has {len(text)} characters, expected at most {_MAX_LENGTH}; use a Raster instead"
            )
        parser = _Parser(text)
        self._nodes = parser.nodes
        self._axes = 1 + max((n.value for n in self._nodes if isinstance(n.value, int)), default=-1)
        used = {word for word, _ in parser.tokens if word in _AXES}
        if used & _DEGREES and used - _DEGREES:
            raise InputError(f"Expression {text!r} has {', '.join(sorted(used))}, expected lon and lat, or x, y and z")
        self.dim = 2 if used & _DEGREES else 3 if self._axes == 3 else None
        self.parts = 1 + len(self._nodes) // _OPERATIONS

    def _evaluate(self, points: np.ndarray) -> np.ndarray:
        values: list[Any] = []
        with np.errstate(all="ignore"):
            for value, arguments in self._nodes:
                if isinstance(value, _Operation):
                    values.append(value.numpy(*(values[i] for i in arguments)))
                else:
                    values.append(points[:, value] if isinstance(value, int) else np.float64(value))
        return np.array(np.broadcast_to(values[-1], (len(points),)), dtype=float)

    def _emit(self, writer: CodeWriter) -> str:
        frame = writer.store(writer.scale, 1.0 / writer.scale, writer.origin)
        exponents = self._exponents()
        names: list[str] = []
        for node, (value, arguments) in enumerate(self._nodes):
            if isinstance(value, _Operation):
                code = value.opencl.format(*(names[i] for i in arguments))
            elif isinstance(value, int):
                code = f"x[{value}] * data[{frame}] + data[{frame + 2 + value}]"
            else:
                # Formulas that differ in numbers share a kernel. The compiler knows powers of given exponents.
                code = f"(REAL)({value!r})" if node in exponents else f"data[{writer.store(value)}]"
            names.append(writer.variable(code))
        return writer.variable(f"{names[-1]} * data[{frame + 1}]")

    def _exponents(self) -> set[int]:
        """Return the nodes that are second arguments of `pow`, and the numbers that such nodes negate."""
        found = {arguments[1] for value, arguments in self._nodes if value is _FUNCTIONS["pow"]}
        for node in range(len(self._nodes) - 1, -1, -1):
            if node in found and self._nodes[node].value is _OPERATORS[ast.USub]:
                found.update(self._nodes[node].arguments)
        return found

    def __repr__(self) -> str:
        short = self.text if len(self.text) <= 60 else self.text[:57] + "..."
        return f"Expression({short!r})"


class _Parser:
    """Checks the words of a formula, lets Python parse them, and lists the operations. The last node is the value."""

    def __init__(self, text: str):
        self.text = text
        self.tokens = self._tokens()
        """The words, and where they begin."""
        self.starts: list[int] = []
        """Where they begin in Python's text."""
        self.nodes: list[_Node] = []
        self._list(self._parse())

    def _tokens(self) -> list[tuple[str, int]]:
        found: list[tuple[str, int]] = []
        position, end = 0, len(self.text.rstrip())
        while position < end:
            match = _TOKEN.match(self.text, position)
            if match is None:
                rest = self.text[position:]
                self._reject(position + len(rest) - len(rest.lstrip()))
            kind, position = str(match.lastgroup), match.end()
            word, column = match[kind], match.start(kind)
            if kind == "number" and not math.isfinite(float(word)):
                self._fail(f"{word} is too large for a number", column)
            if kind == "name" and not any(word in known for known in (_AXES, _CONSTANTS, _FUNCTIONS)):
                self._fail(f"unknown name {word!r}", column)
            if word == "*" and found and found[-1][0] == "*":
                self._fail("there is no operator **; write pow(a, b)", column)
            found.append((word, column))
        return found

    def _reject(self, column: int) -> NoReturn:
        rest = self.text[column:]
        number = re.match(r"\.?\d[\w.]*", rest, re.ASCII)
        if number:
            self._fail(f"{number[0]!r} is not a number; write 0.5 or 5e-1, without suffix", column)
        others = {"^": "; write pow(a, b) for a power", "%": "; write fmod(a, b) for a remainder"}
        self._fail(f"unexpected character {rest[0]!r}{others.get(rest[0], '')}", column)

    def _fail(self, what: str, column: int) -> NoReturn:
        begin = max(0, column - 20)
        near = self.text[begin : column + 20]
        raise InputError(
            f"Expression, column {column + 1}, near {near!r}: {what}. Allowed are numbers, "
            "x, y, z, lon, lat, pi, + - * / ( ), comparisons, && || !, ?: and the functions "
            "listed in clvoro.sizing.Expression"
        )

    def _parse(self) -> ast.AST:
        """Return Python's tree of the formula."""
        python, depths = "", [1]
        for word, column in self.tokens:
            if word == ")":
                depths = depths[:-1] or [0]
            elif word in ("(", "?"):
                deeper = depths[-1] + 1
                if deeper > _MAX_DEPTH:
                    self._fail(f"nested more than {_MAX_DEPTH} deep; simplify it, or use a Raster", column)
                depths = [*depths, deeper] if word == "(" else [*depths[:-1], deeper]
            self.starts.append(len(python))
            python += (repr(float(word)) if word[0] in ".0123456789" else _PYTHON.get(word, word)) + " "
        if not self.tokens:
            self._fail("it is empty", 0)
        try:
            return ast.parse(python.rstrip(), mode="eval").body
        except SyntaxError as error:
            self._explain(error, python)
        except (MemoryError, RecursionError):
            self._fail("nested too deep; simplify it, or use a Raster", 0)

    def _explain(self, error: SyntaxError, python: str) -> NoReturn:
        """Say in the words of the formula what Python's parser found."""
        two_values = "forgot" in error.msg  # a comma between them, it supposes, and names both
        place = ((error.end_offset if two_values else error.offset) or 0) - 1 - two_values
        if not 0 <= place < len(python) - 1:
            self._fail("it ends where a value is expected", len(self.text.rstrip()))
        word, column = self._token_at(place)
        if "closed" in error.msg:
            self._fail(f"expected {':' if word == '?' else ')'!r} after {word!r}, got the end", column)
        expected = "an operator or the end" if word[0].isalnum() or word in ("(", ")") else "a value"
        self._fail(f"unexpected {word!r}, expected {expected}", column)

    def _token_at(self, place: int) -> tuple[str, int]:
        """Return the word at an offset in Python's text, and where it begins in the formula."""
        return self.tokens[max(0, bisect.bisect_right(self.starts, place) - 1)]

    def _list(self, tree: ast.AST) -> None:
        """Append the nodes of a tree, operands first."""
        todo: list[ast.AST | tuple[_Operation, int]] = [tree]
        done: list[int] = []
        while todo:
            item = todo.pop()
            if isinstance(item, tuple):
                operation, count = item
                node = _Node(operation, tuple(done[-count:]))
                del done[-count:]
            else:
                value, operands = self._read(item)
                if isinstance(value, _Operation):
                    todo += [(value, len(operands)), *reversed(operands)]
                    continue
                node = _Node(value)
            done.append(len(self.nodes))
            self.nodes.append(node)

    def _read(self, tree: Any) -> tuple[float | int | _Operation, list[Any]]:
        """Return what a tree stands for, and the trees of its operands."""
        while isinstance(tree, ast.UnaryOp) and isinstance(tree.op, ast.UAdd):
            tree = tree.operand
        word, column = self._token_at(tree.col_offset)
        match tree:
            case ast.Constant(float(value)):
                return value, []
            case ast.Name(name):
                if name in _FUNCTIONS:
                    self._fail(f"expected '(' after {name!r}", column)
                return _AXES.get(name, _CONSTANTS.get(name, 0)), []
            case ast.Call(ast.Name(name), operands) if name in _FUNCTIONS:
                expected = _FUNCTIONS[name].arguments
                if len(operands) != expected:
                    self._fail(f"{name} got {len(operands)} arguments, expected {expected}", column)
                return _FUNCTIONS[name], operands
            case ast.Call():
                self._fail(f"{word!r} is not a function; write * for a product", column)
            case ast.UnaryOp(operator, operand):
                return _OPERATORS[type(operator)], [operand]
            case ast.BinOp(left, operator, right) | ast.Compare(left, [operator], [right]):
                return _OPERATORS[type(operator)], [left, right]
            case ast.BoolOp(operator, [left, right]):
                return _OPERATORS[type(operator)], [left, right]
            case ast.BoolOp(operator, [*others, last]):
                first = ast.copy_location(ast.BoolOp(operator, others), tree)
                return _OPERATORS[type(operator)], [first, last]
            case ast.IfExp(second, condition, third):
                return _OPERATORS[ast.IfExp], [condition, second, third]
            case ast.Compare():
                self._fail("comparisons cannot be chained; write a < b && b < c", column)
            case ast.Tuple([_, second, *_]):
                self._fail("unexpected ',', expected an operator or the end", self._token_at(second.col_offset)[1])
        self._fail(f"unexpected {word!r}, expected a value", column)
