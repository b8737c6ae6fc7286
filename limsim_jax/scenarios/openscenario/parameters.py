"""Parameters and variables: declarations, types, constraints.

ASAM OpenSCENARIO XML 1.3, section "Parameters". The groups of constraints of a parameter are alternatives;
within a group all constraints hold.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from limsim_jax.scenarios.openscenario.expressions import (
    ExpressionError,
    Value,
    names,
    resolve,
    written,
)
from limsim_jax.scenarios.openscenario.source import Node

RULES: dict[str, Callable[[float, float], bool]] = {
    "equalTo": lambda a, b: a == b,
    "notEqualTo": lambda a, b: a != b,
    "greaterThan": lambda a, b: a > b,
    "greaterOrEqual": lambda a, b: a >= b,
    "lessThan": lambda a, b: a < b,
    "lessOrEqual": lambda a, b: a <= b,
}
"""Comparisons by their names in files."""

_WHOLE = {
    "int": (-(2**31), 2**31 - 1),
    "integer": (-(2**31), 2**31 - 1),
    "unsignedInt": (0, 2**32 - 1),
    "unsignedShort": (0, 2**16 - 1),
}
TYPES = ("boolean", "dateTime", "double", "string", *_WHOLE)


class Constraint(NamedTuple):
    """A bound of a parameter, whose value may name other parameters."""

    rule: str
    value: str


class Declaration(NamedTuple):
    """A parameter as it is declared, before its value is known."""

    name: str
    type: str
    value: str  # as written
    groups: tuple[tuple[Constraint, ...], ...]
    node: Node


def read_declarations(node: Node, tag: str = "ParameterDeclarations") -> list[Declaration]:
    """The declarations within an element; none where there are none."""
    block = node.optional(tag)
    one = tag.removesuffix("s")
    kind = "variableType" if one.startswith("Variable") else "parameterType"
    found = []
    for item in [] if block is None else block.children(one):
        for attribute in ("name", "value"):
            item.source.asked(item.element, attribute)
        name = item.element.get("name", "").strip()
        if not name:
            raise item.error("attribute 'name' is missing")
        if item.element.get("value") is None:
            raise item.error(f"parameter '{name}' has no value")
        groups = []
        for group in item.children("ConstraintGroup"):
            rules = []
            for one_rule in group.children("ValueConstraint"):
                rule = one_rule.choice("rule", RULES)
                one_rule.source.asked(one_rule.element, "value")
                rules.append(Constraint(rule, one_rule.element.get("value", "")))
            groups.append(tuple(rules))
        type_ = item.choice(kind, TYPES)
        found.append(Declaration(name, type_, item.element.get("value"), tuple(groups), item))
    return found


def typed(declaration: Declaration, value: Value) -> Value:
    """A value as the type of its parameter.

    Raises:
      OpenScenarioError: it does not fit.
    """
    kind, text = declaration.type, written(value).strip()
    if kind in ("string", "dateTime"):
        return text
    if kind == "boolean":
        if text.lower() not in ("true", "false", "1", "0"):
            raise declaration.node.error(
                f"parameter '{declaration.name}': '{text}' is neither true nor false"
            )
        return text.lower() in ("true", "1")
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        raise declaration.node.error(f"parameter '{declaration.name}': '{text}' is no number")
    if kind in _WHOLE:
        low, high = _WHOLE[kind]
        if math.isinf(number) or number != math.floor(number) or not low <= number <= high:
            raise declaration.node.error(f"parameter '{declaration.name}': '{text}' is no {kind}")
        return int(number)
    return number


def settle(
    declarations: list[Declaration],
    given: Mapping[str, Value] | None = None,
    outer: Mapping[str, Value] | None = None,
) -> dict[str, Value]:
    """The values of parameters, as given or as declared.

    A declared value may name parameters before it.

    Raises:
      OpenScenarioError: a value that does not fit its type, or an expression without value.
    """
    values: dict[str, Value] = {}
    scope = dict(outer or {})
    for one in declarations:
        if given is not None and one.name in given:
            value = given[one.name]
        else:
            try:
                value = resolve(one.value, scope)
            except ExpressionError as error:
                raise one.node.error(f"parameter '{one.name}': {error}") from None
        values[one.name] = scope[one.name] = typed(one, value)
    return values


def broken(declaration: Declaration, values: Mapping[str, Value]) -> str | None:
    """The constraint that a value breaks, in words; None if it keeps them."""
    if not declaration.groups:
        return None
    own, said = values[declaration.name], []
    for group in declaration.groups:
        failed = [x for x in group if not _holds(declaration, own, x, values)]
        if not failed:
            return None
        said.append(" and ".join(f"{x.rule} {x.value}" for x in failed))
    return f"{declaration.name} = {written(own)} is not {' or '.join(said)}"


def _holds(declaration: Declaration, own: Value, one: Constraint, values: Mapping[str, Value]) -> bool:
    try:
        bound = resolve(one.value, values)
    except ExpressionError as error:
        raise declaration.node.error(f"constraint of '{declaration.name}': {error}") from None
    return compare(own, one.rule, bound)


def compare(a: Value, rule: str, b: Value) -> bool:
    """Whether `a rule b`; texts are equal or not, and have no order."""
    try:
        return RULES[rule](float(a), float(b))
    except ValueError:
        same = written(a).strip() == written(b).strip()
        return same if rule == "equalTo" else not same if rule == "notEqualTo" else False


def needs(declaration: Declaration) -> set[str]:
    """The parameters on which the constraints of one depend, itself included."""
    found = {declaration.name}
    for group in declaration.groups:
        for one in group:
            try:
                found |= names(one.value)
            except ExpressionError as error:
                raise declaration.node.error(f"constraint of '{declaration.name}': {error}") from None
    return found
