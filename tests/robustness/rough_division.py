"""Float32 quotients and roots as a GPU may round them, on any device.

OpenCL allows errors of 2.5 ulp in quotients and 3 ulp in square roots of float32. Here they are off by up to 2 and 3
units in the last place, pseudo-random by their bits. Quotients are found in the text of the programs.
"""

import re
from functools import cache

from clvoro.opencl import program

_TOKEN = re.compile(
    r"(?P<space>\s+)|(?P<word>[A-Za-z_]\w*)|(?P<number>(?:\d|\.\d)(?:[eEpP][+-]|[\w.])*)"
    r"|(?P<sign>->|\+\+|--|<<=|>>=|[-+*/%&|^!=<>]=|&&|\|\||<<|>>|##|.)",
    re.DOTALL,
)
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_TYPES = re.compile(r"(REAL|STORE|SOURCE|FACE|float|double|int|uint|long|ulong|size_t|short)\d*")
_STOPS = set("+ - = < > ! & | ^ ? : , ; { } == != <= >= && || << >> += -= *= /= return".split())
_OPEN, _CLOSE = "([{", ")]}"
_ROOTS = {"sqrt": 3, "cbrt": 2, "exp": 3, "log": 3, "sin": 4, "cos": 4}
"""Functions, and the units in the last place by which they are off."""


_ROUGH = r"""
#define ROUGH(T, I, U)                                                                                                 \
    static __attribute__((overloadable)) T rough(T x, int most)                                                        \
    {                                                                                                                  \
        const U bits = __builtin_astype(fabs(x), U) * 2654435761u >> 20;                                               \
        const I off = __builtin_astype(bits, I) % (2 * most + 1) - most;                                               \
        return select(x, __builtin_astype(__builtin_astype(x, I) + off, T), isnormal(x));                              \
    }
#define EXACT(T)                                                                                                       \
    static __attribute__((overloadable)) T rough(T x, int most)                                                        \
    {                                                                                                                  \
        return x;                                                                                                      \
    }
"""


def _prelude() -> str:
    text = _ROUGH
    for width in ("", "2", "3", "4", "8", "16"):
        text += f"ROUGH(float{width}, int{width}, uint{width})\n"
        text += "".join(f"EXACT({kind}{width})\n" for kind in ("int", "uint", "long", "ulong"))
        text += f"#ifdef cl_khr_fp64\nEXACT(double{width})\n#endif\n"
    for name, most in _ROOTS.items():
        text += f"#define rough_{name}(x) rough({name}(x), {most})\n"
    return text


def rough_quotients(text: str) -> str:
    """Return `text` with each quotient q of reals replaced by rough(q, 2)."""
    text = _COMMENT.sub(lambda m: "\n" * m[0].count("\n") or " ", text)
    text = text.replace("\\\n", " ")
    lines, body = [], []

    def flush() -> None:
        lines.append(_rewrite("\n".join(body)))
        body.clear()

    for line in text.split("\n"):
        define = re.match(r"(\s*#\s*define\s+\w+(?:\([^)]*\))?)(.*)", line)
        if define:
            flush()
            lines.append(define[1] + _rewrite(define[2]))
        elif line.lstrip().startswith("#"):
            flush()
            lines.append(line)
        else:
            body.append(line)
    flush()
    return _prelude() + "\n".join(lines)


def _rewrite(code: str) -> str:
    tokens = [m[0] for m in _TOKEN.finditer(code)]
    place = 0
    while place < len(tokens):
        if tokens[place] in _ROOTS:
            tokens[place] = f"rough_{tokens[place]}"
        if tokens[place] in ("/", "/="):
            place = _wrap(tokens, place)
        place += 1
    return "".join(tokens)


def _wrap(tokens: list[str], place: int) -> int:
    """Wrap the quotient at `place`, and return the place of its sign."""
    if tokens[place] == "/=":
        first, last = _lvalue(tokens, place), _statement_end(tokens, place)
        left = "".join(tokens[first:place])
        tokens[last:last] = ["), 2)"]
        tokens[place] = f"= rough({left} / ("
        return place
    first, last = _chain_start(tokens, place), _operand_end(tokens, place + 1)
    words = [t for t in tokens[first:last] if t.strip()]
    right = [t for t in tokens[place + 1 : last] if t.strip()]
    exact = len(right) == 1 and re.fullmatch(r"2|4|8|16|32|64|128", right[0])
    constant = all(re.fullmatch(r"[A-Z_0-9]+|\d+|\W+", t) for t in words)
    if exact or constant:
        return place
    tokens[last:last] = [", 2)"]
    tokens[first:first] = ["rough("]
    return place + 1


def _skip_space(tokens: list[str], place: int, step: int) -> int:
    while 0 <= place < len(tokens) and not tokens[place].strip():
        place += step
    return place


def _match(tokens: list[str], place: int) -> int:
    """Return the place of the bracket that closes or opens that at `place`."""
    step, depth = (1 if tokens[place] in _OPEN else -1), 0
    while True:
        depth += (_net(tokens[place])) * step
        if depth == 0:
            return place
        place += step


def _net(token: str) -> int:
    return sum(c in _OPEN for c in token) - sum(c in _CLOSE for c in token)


def _chain_start(tokens: list[str], place: int) -> int:
    """Return the place of the first operand of the products and quotients that end before `place`."""
    first, here = place, place - 1
    while here >= 0:
        token = tokens[here]
        if token in _STOPS or _net(token) > 0:
            break
        if _net(token) < 0:
            depth = _net(token)
            while depth < 0:
                here -= 1
                depth += _net(tokens[here])
            if tokens[here] == "rough(":  # a call
                first = here
        if tokens[here].strip():
            first = here
        here -= 1
    return first


def _lvalue(tokens: list[str], place: int) -> int:
    here = _skip_space(tokens, place - 1, -1)
    while tokens[here] == "]":
        here = _skip_space(tokens, _match(tokens, here) - 1, -1)
    while here >= 1 and tokens[_skip_space(tokens, here - 1, -1)] in (".", "->"):
        here = _skip_space(tokens, _skip_space(tokens, here - 1, -1) - 1, -1)
        while tokens[here] == "]":
            here = _skip_space(tokens, _match(tokens, here) - 1, -1)
    return here


def _statement_end(tokens: list[str], place: int) -> int:
    here, depth = place + 1, 0
    while tokens[here] not in (";", ",") or depth:
        if depth + _net(tokens[here]) < 0:
            break
        depth += _net(tokens[here])
        here += 1
    return here


def _operand_end(tokens: list[str], place: int) -> int:
    """Return the place behind the operand that begins at `place`: prefix signs, casts, one primary, what follows it."""
    here = _skip_space(tokens, place, 1)
    while tokens[here] in ("-", "+", "!", "~", "*", "&"):
        here = _skip_space(tokens, here + 1, 1)
    if tokens[here] == "(":
        end = _match(tokens, here)
        inside = "".join(tokens[here + 1 : end]).strip()
        if _TYPES.fullmatch(inside):
            return _operand_end(tokens, end + 1)
        here = end + 1
    else:
        here += 1
    while here < len(tokens):
        if tokens[here] in ("(", "["):
            here = _match(tokens, here) + 1
        elif tokens[here] in (".", "->"):
            here = _skip_space(tokens, here + 1, 1) + 1
        else:
            break
    return here


def use_rough_division() -> None:
    """Let every program built from now on round float32 quotients and roots roughly."""
    plain = program.source_text
    program.source_text = cache(lambda name: rough_quotients(plain(name)))
    # PoCL's short declarations lack some of the functions.
    program.has_short_declarations = lambda _: False
