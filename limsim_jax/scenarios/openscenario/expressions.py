"""Expressions `${...}` of OpenSCENARIO, by a small parser of our own.

Nothing is ever handed to Python's `eval`. Length, nesting and the size of numbers are bounded, so that a
hostile expression ends in one line. ASAM OpenSCENARIO XML 1.3, section "Expressions".
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

Value = float | int | bool | str
"""What a parameter is worth."""

LONGEST = 10_000
"""Characters of an expression, at most."""

DEEPEST = 64
"""Nested brackets, signs and functions, at most."""

_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|\$(?P<name>\w+)|(?P<word>[A-Za-z]\w*)"
    r"|(?P<sign>[-+*/%^(),]))"
)
_SPACE = re.compile(r"\s*")


def _sign(x: float) -> float:
    return float((x > 0) - (x < 0))


def _round(x: float) -> float:
    """Half away from zero, as C does it."""
    return math.copysign(math.floor(abs(x) + 0.5), x)


_FUNCTIONS: dict[str, tuple[int, Callable[..., float]]] = {
    "round": (1, _round),
    "floor": (1, lambda x: float(math.floor(x))),
    "ceil": (1, lambda x: float(math.ceil(x))),
    "sqrt": (1, math.sqrt),
    "abs": (1, math.fabs),
    "sign": (1, _sign),
    "sin": (1, math.sin),
    "cos": (1, math.cos),
    "tan": (1, math.tan),
    "asin": (1, math.asin),
    "acos": (1, math.acos),
    "atan": (1, math.atan),
    "pow": (2, math.pow),
    "min": (2, lambda a, b: min(a, b)),
    "max": (2, lambda a, b: max(a, b)),
}


class ExpressionError(ValueError):
    """What is wrong with an expression, without the place where it stands."""


class _Token(NamedTuple):
    kind: str  # "number", "name", "word", "sign", "end"
    text: str


def _tokens(text: str) -> list[_Token]:
    if len(text) > LONGEST:
        raise ExpressionError(f"an expression of {len(text)} characters; at most {LONGEST}")
    found, at = [], 0
    while (match := _TOKEN.match(text, at)) is not None:
        kind = str(match.lastgroup)
        found.append(_Token(kind, match.group(kind)))
        at = match.end()
    space = _SPACE.match(text, at)
    at = at if space is None else space.end()
    if at < len(text):
        raise ExpressionError(f"'{text[at : at + 10]}' is no part of an expression")
    return [*found, _Token("end", "the end")]


class _Parser:
    """Recursive descent: or, and, sum, product, sign, power, atom."""

    def __init__(self, text: str, values: Mapping[str, Value]) -> None:
        self.tokens, self.at, self.depth, self.values = _tokens(text), 0, 0, values

    @property
    def next(self) -> _Token:
        return self.tokens[self.at]

    def take(self, *texts: str) -> str | None:
        if self.next.kind in ("sign", "word") and self.next.text in texts:
            self.at += 1
            return self.tokens[self.at - 1].text
        return None

    def expect(self, text: str) -> None:
        if self.take(text) is None:
            raise ExpressionError(f"'{text}' is missing before {self.next.text}")

    def whole(self) -> Value:
        value = self.disjunction()
        if self.next.kind != "end":
            raise ExpressionError(f"'{self.next.text}' is not expected there")
        return value

    def disjunction(self) -> Value:
        value = self.conjunction()
        while self.take("or"):
            other = self.conjunction()
            value = _flag(value) or _flag(other)
        return value

    def conjunction(self) -> Value:
        value = self.sum()
        while self.take("and"):
            other = self.sum()
            value = _flag(value) and _flag(other)
        return value

    def sum(self) -> Value:
        value = self.product()
        while (sign := self.take("+", "-")) is not None:
            a, b = _number(value), _number(self.product())
            value = a + b if sign == "+" else a - b
        return value

    def product(self) -> Value:
        value = self.signed()
        while (sign := self.take("*", "/", "%")) is not None:
            a, b = _number(value), _number(self.signed())
            if sign == "*":
                value = a * b
                continue
            if b == 0:
                raise ExpressionError("a division by zero")
            value = a / b if sign == "/" else math.fmod(a, b)
        return value

    def signed(self) -> Value:
        self.depth += 1
        if self.depth > DEEPEST:
            raise ExpressionError(f"nested more than {DEEPEST} levels deep")
        if (sign := self.take("-", "+")) is not None:
            number = _number(self.signed())
            value: Value = -number if sign == "-" else number
        elif self.take("not"):
            value = not _flag(self.signed())
        else:
            value = self.power()
        self.depth -= 1
        return value

    def power(self) -> Value:
        value = self.atom()
        if self.take("^") is None:
            return value
        return _called("pow", math.pow, (_number(value), _number(self.signed())))

    def atom(self) -> Value:
        kind, text = self.next
        if kind != "end":
            self.at += 1
        if kind == "number":
            return float(text)
        if kind == "name":
            if text not in self.values:
                raise ExpressionError(f"parameter ${text} is not declared")
            return self.values[text]
        if kind == "word" and text in ("true", "false"):
            return text == "true"
        if kind == "word" and text == "pi":
            return math.pi
        if kind == "word" and text in _FUNCTIONS:
            count, function = _FUNCTIONS[text]
            self.expect("(")
            given = [_number(self.disjunction())]
            while self.take(","):
                given.append(_number(self.disjunction()))
            self.expect(")")
            if len(given) != count:
                raise ExpressionError(f"{text} takes {count} numbers, not {len(given)}")
            return _called(text, function, tuple(given))
        if kind == "sign" and text == "(":
            value = self.disjunction()
            self.expect(")")
            return value
        if kind == "word":
            raise ExpressionError(f"'{text}' is no function; known are {', '.join(_FUNCTIONS)}")
        raise ExpressionError(f"a value is missing before {text}")


def _called(name: str, function: Callable[..., float], given: tuple[float, ...]) -> float:
    try:
        return float(function(*given))
    except (ValueError, OverflowError):
        numbers = ", ".join(f"{x:g}" for x in given)
        raise ExpressionError(f"{name}({numbers}) has no value") from None


def _number(value: Value) -> float:
    if isinstance(value, bool):
        raise ExpressionError(f"{str(value).lower()} is no number")
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            raise ExpressionError(f"'{value[:40]}' is no number") from None
    return float(value)


def _flag(value: Value) -> bool:
    if isinstance(value, str) and value in ("true", "false"):
        return value == "true"
    if not isinstance(value, bool):
        raise ExpressionError(f"{value} is neither true nor false")
    return value


def evaluate(text: str, values: Mapping[str, Value]) -> Value:
    """The value of what stands between `${` and `}`.

    Args:
      text: such as `$speed / 3.6`.
      values: of parameters by name, without the `$`.

    Raises:
      ExpressionError: no expression, an unknown parameter, or no finite value.
    """
    value = _Parser(text, values).whole()
    if isinstance(value, float) and not math.isfinite(value):
        raise ExpressionError("the value is not finite")
    return value


def resolve(text: str, values: Mapping[str, Value]) -> Value:
    """The value of an attribute: a parameter `$name`, an expression `${...}`, or the text itself.

    Raises:
      ExpressionError: as `evaluate`.
    """
    text = text.strip()
    if text.startswith("${"):
        if not text.endswith("}"):
            raise ExpressionError("'}' is missing at the end of an expression")
        return evaluate(text[2:-1], values)
    if text.startswith("$"):
        name = text[1:]
        if name not in values:
            raise ExpressionError(f"parameter ${name[:40]} is not declared")
        return values[name]
    return text


def names(text: str) -> set[str]:
    """Parameters that an attribute names."""
    text = text.strip()
    if text.startswith("${"):
        return {token.text for token in _tokens(text[2:].removesuffix("}")) if token.kind == "name"}
    return {text[1:]} if text.startswith("$") else set()


def written(value: Value) -> str:
    """A value as an attribute of a file has it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and abs(value) < 1e15 and value == int(value):
        return str(int(value))
    return str(value)
