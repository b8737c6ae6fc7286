"""Expressions of OpenSCENARIO."""

import math

import pytest

from limsim_jax.scenarios.openscenario.expressions import ExpressionError, evaluate, names, resolve

VALUES = {"speed": 36.0, "flag": True, "text": "7.5", "name": "car"}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("$speed / 3.6", 10),
        ("2 + 3 * 4", 14),
        ("(2 + 3) * 4", 20),
        ("-2 ^ 2", -4),
        ("2 ^ 3 ^ 2", 512),
        ("2 ^ -1", 0.5),
        ("7 % 3", 1),
        ("-7 % 3", -1),
        ("10 - 4 - 3", 3),
        ("100 / 10 / 2", 5),
        ("--3", 3),
        ("1e3 + .5", 1000.5),
        ("sqrt(16) + abs(-1)", 5),
        ("pow(2, 10)", 1024),
        ("round(2.5) + round(-2.5)", 0),
        ("floor(-1.5) + ceil(1.2)", 0),
        ("max(1, $speed) - min(2, 3)", 34),
        ("sign(-3)", -1),
        ("sin(pi / 2)", 1),
        ("$text * 2", 15),
        ("10.0 * (-20.0 / 3.6)", -200 / 3.6),
    ],
)
def test_numbers(text, value):
    assert evaluate(text, VALUES) == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "value"),
    [("$flag and not false", True), ("false or $flag", True), ("not $flag", False), ("true", True)],
)
def test_flags(text, value):
    assert evaluate(text, VALUES) is value


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a value is missing"),
        ("1 +", "a value is missing before the end"),
        ("(1", "'\\)' is missing"),
        ("1 2", "'2' is not expected"),
        ("$nothing", "parameter \\$nothing is not declared"),
        ("1 / 0", "a division by zero"),
        ("5 % 0", "a division by zero"),
        ("sqrt(-1)", "sqrt\\(-1\\) has no value"),
        ("pow(10, 400)", "has no value"),
        ("pow(1)", "pow takes 2 numbers, not 1"),
        ("__import__('os')", "is no part of an expression"),
        ("exec(1)", "'exec' is no function"),
        ("$name + 1", "'car' is no number"),
        ("true + 1", "true is no number"),
        ("1 and 2", "neither true nor false"),
        ("1e308 * 1e308", "not finite"),
        ("(" * 100 + "1" + ")" * 100, "nested more than"),
        ("-" * 100 + "1", "nested more than"),
        ("(" * 1_000_000, "an expression of 1000000 characters"),
    ],
)
def test_what_is_wrong(text, said):
    with pytest.raises(ExpressionError, match=said):
        evaluate(text, VALUES)


def test_attributes():
    assert resolve("$speed", VALUES) == 36.0
    assert resolve(" ${$speed / 2} ", VALUES) == 18.0
    assert resolve("plain", VALUES) == "plain"
    assert names("${$a + sqrt($b)}") == {"a", "b"}
    assert names("$a") == {"a"}
    assert names("a") == set()
    with pytest.raises(ExpressionError, match="'}' is missing"):
        resolve("${1", VALUES)


def test_values_have_no_surprise():
    assert math.isclose(float(evaluate("0.1 + 0.2", {})), 0.3)
