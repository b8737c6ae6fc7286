"""Distributions of parameters: a file of them is a batch axis.

Deterministic ones (sets, ranges, sets of values) make a product, which the constraints of the parameters
filter. Stochastic ones are drawn: run `k` depends on the seed of the file and `k` alone. ASAM OpenSCENARIO
XML 1.3, section "Parameter value distribution".
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from limsim_jax.scenarios.openscenario.expressions import ExpressionError, Value, names
from limsim_jax.scenarios.openscenario.parameters import Declaration, broken, needs, settle
from limsim_jax.scenarios.openscenario.source import Node

MOST = 10_000_000
"""Combinations of a file, at most."""

MOST_VALUES = 1_000_000
"""Values of one parameter, at most."""

_TRIES = 1000  # draws until one keeps the constraints


class Variants(Protocol):
    """Values of parameters, variant by variant."""

    names: tuple[str, ...]
    """Parameters that vary."""

    product: int
    """Variants before constraints."""

    def __len__(self) -> int:
        """Variants."""
        ...

    def __getitem__(self, k: int) -> dict[str, Value]:
        """Values of the `k`-th variant."""
        ...


class One:
    """A scenario without distributions: one variant."""

    names: tuple[str, ...] = ()
    product = 1

    def __len__(self) -> int:
        return 1

    def __getitem__(self, k: int) -> dict[str, Value]:
        return {}


class Axis(NamedTuple):
    """Values that one distribution gives to its parameters together."""

    names: tuple[str, ...]
    values: tuple[tuple[Value | None, ...], ...]  # None: as declared


class Product:
    """The product of deterministic distributions; the last one varies fastest.

    Args:
      axes: distributions in the order of the file.
      declarations: of the scenario, with constraints.
    """

    def __init__(self, axes: Sequence[Axis], declarations: Sequence[Declaration]) -> None:
        self.axes = tuple(axes)
        self.names = tuple(name for axis in axes for name in axis.names)
        shape = tuple(len(axis.values) for axis in axes)
        self.product = math.prod(shape)
        self._shape = shape
        keep = np.ones(shape, bool)
        for one in declarations:
            if one.groups:
                keep &= self._allowed(one, declarations)
        self._kept: NDArray[np.int64] = np.flatnonzero(keep.ravel())

    def _allowed(self, one: Declaration, declarations: Sequence[Declaration]) -> NDArray[np.bool_]:
        """Where the constraints of one parameter hold; of size 1 along axes that do not matter."""
        wanted = _all_needs(one, declarations)
        mine = [k for k, axis in enumerate(self.axes) if wanted & set(axis.names)]
        chosen = [x for x in declarations if x.name in wanted]
        table = np.ones([self._shape[k] if k in mine else 1 for k in range(len(self.axes))], bool)
        for where in itertools.product(*(range(n) for n in table.shape)):
            given = {
                name: value
                for k in mine
                for name, value in zip(self.axes[k].names, self.axes[k].values[where[k]], strict=True)
                if value is not None
            }
            table[where] = broken(one, settle(chosen, given)) is None
        return table

    def __len__(self) -> int:
        return len(self._kept)

    def __getitem__(self, k: int) -> dict[str, Value]:
        where = np.unravel_index(self._kept[k], self._shape)
        return {
            name: value
            for axis, i in zip(self.axes, where, strict=True)
            for name, value in zip(axis.names, axis.values[int(i)], strict=True)
            if value is not None
        }


def _all_needs(one: Declaration, declarations: Sequence[Declaration]) -> set[str]:
    """Parameters that matter for the constraints of one, also through declared expressions."""
    by_name = {x.name: x for x in declarations}
    found: set[str] = set()
    todo = needs(one)
    while todo:
        name = todo.pop()
        if name in found or name not in by_name:
            continue
        found.add(name)
        try:
            todo |= names(by_name[name].value)
        except ExpressionError as error:
            raise by_name[name].node.error(f"parameter '{name}': {error}") from None
    return found


Draw = Callable[[float], Value]
"""A value from a number that is uniform in 0..1."""


class Draws:
    """Runs of stochastic distributions.

    Args:
      draws: by parameter.
      runs: how many.
      seed: of the file.
      declarations: of the scenario, whose constraints all runs keep.
      node: of the file, for errors.
    """

    def __init__(
        self,
        draws: Mapping[str, Draw],
        runs: int,
        seed: int,
        declarations: Sequence[Declaration],
        node: Node,
    ) -> None:
        self.names, self.product = tuple(draws), runs
        self._draws, self._seed, self._node = dict(draws), seed, node
        self._declarations = list(declarations)

    def __len__(self) -> int:
        return self.product

    def __getitem__(self, k: int) -> dict[str, Value]:
        if not 0 <= k < self.product:
            raise IndexError(k)
        said = ""
        for attempt in range(_TRIES):
            chance = np.random.default_rng([self._seed, k, attempt]).random(len(self._draws))
            found = {
                name: draw(float(u)) for (name, draw), u in zip(self._draws.items(), chance, strict=True)
            }
            values = settle(self._declarations, found)
            faults = [fault for x in self._declarations if (fault := broken(x, values)) is not None]
            if not faults:
                return found
            said = faults[0]
        raise self._node.error(f"{_TRIES} draws of run {k} break the constraints; the last: {said}")


def read_distributions(node: Node, declarations: Sequence[Declaration]) -> Variants:
    """The variants that `<ParameterValueDistribution>` names.

    Raises:
      OpenScenarioError: parameters that are not declared or named twice, or too many combinations.
    """
    block = node.only(("Deterministic", "Stochastic"), beside=("ScenarioFile",))
    if block is None:
        raise node.error("its distributions are not supported")
    if block.tag == "Stochastic":
        return _stochastic(block, declarations)
    axes = []
    for one in block.every():
        if one.tag == "DeterministicSingleParameterDistribution":
            axes.append(_single(one))
        elif one.tag == "DeterministicMultiParameterDistribution":
            axes.append(_multi(one))
        else:
            raise one.error("is no deterministic distribution")
    _check_names(node, [name for axis in axes for name in axis.names], declarations)
    total = math.prod(len(axis.values) for axis in axes)
    if total > MOST:
        raise node.error(f"{total} combinations; at most {MOST}")
    variants = Product(axes, declarations)
    if not len(variants):
        raise node.error(f"none of its {total} combinations keeps the constraints of the parameters")
    return variants


def _check_names(node: Node, given: Sequence[str], declarations: Sequence[Declaration]) -> None:
    known = {x.name for x in declarations}
    for k, name in enumerate(given):
        if name not in known:
            said = ", ".join(sorted(known)) or "none"
            raise node.error(f"parameter '{name}' is not declared by the scenario; known are {said}")
        if name in given[:k]:
            raise node.error(f"parameter '{name}' has two distributions")


def _range(node: Node) -> tuple[float, float]:
    low, high = node.number("lowerLimit"), node.number("upperLimit")
    if high < low:
        raise node.error(f"upperLimit {high:g} is below lowerLimit {low:g}")
    return low, high


def _single(node: Node) -> Axis:
    name = node.raw("parameterName").removeprefix("$")
    one = node.only(("DistributionSet", "DistributionRange"))
    if one is None:
        raise node.error("its distribution is not supported")
    values: list[Value]
    if one.tag == "DistributionSet":
        values = [x.value("value") for x in one.children("Element")]
    else:
        step = one.number("stepWidth", above=0)
        low, high = _range(one.child("Range"))
        count = math.floor((high - low) / step + 1e-9) + 1
        if count > MOST_VALUES:
            raise one.error(f"{count} values; at most {MOST_VALUES}")
        values = [round(low + k * step, 12) for k in range(count)]
    if not values:
        raise one.error("has no value")
    return Axis((name,), tuple((x,) for x in values))


def _multi(node: Node) -> Axis:
    sets = []
    for one in node.child("ValueSetDistribution").children("ParameterValueSet"):
        given: dict[str, Value] = {}
        for assignment in one.children("ParameterAssignment"):
            name = assignment.raw("parameterRef").removeprefix("$")
            if name in given:
                raise assignment.error(f"parameter '{name}' is there twice")
            given[name] = assignment.value("value")
        sets.append(given)
    order = tuple(dict.fromkeys(name for given in sets for name in given))
    if not order:
        raise node.error("has no value")
    return Axis(order, tuple(tuple(x.get(name) for name in order) for x in sets))


# --- stochastic


def _stochastic(node: Node, declarations: Sequence[Declaration]) -> Draws:
    runs = node.integer("numberOfTestRuns", least=1)
    if runs > MOST:
        raise node.error(f"{runs} runs; at most {MOST}")
    seed = int(abs(node.number("randomSeed", 0.0)))
    draws: dict[str, Draw] = {}
    order = []
    for one in node.children("StochasticDistribution"):
        name = one.raw("parameterName").removeprefix("$")
        order.append(name)
        draws[name] = _draw(one)
    if not draws:
        raise node.error("has no distribution")
    _check_names(node, order, declarations)
    return Draws(draws, runs, seed, declarations, node)


def _draw(node: Node) -> Draw:
    one = node.only(
        (
            "NormalDistribution",
            "LogNormalDistribution",
            "UniformDistribution",
            "PoissonDistribution",
            "Histogram",
            "ProbabilityDistributionSet",
        )
    )
    if one is None:
        raise node.error("its distribution is not supported")
    if one.tag == "UniformDistribution":
        low, high = _range(one.child("Range"))
        return lambda u: low + u * (high - low)
    if one.tag == "Histogram":
        bins = [(x.number("weight", least=0), *_range(x.child("Range"))) for x in one.children("Bin")]
        edges = _shares(one, [x[0] for x in bins])

        def from_bin(u: float) -> Value:
            k = min(int(np.searchsorted(edges, u, side="right")) - 1, len(bins) - 1)
            share = (u - edges[k]) / (edges[k + 1] - edges[k])
            return bins[k][1] + share * (bins[k][2] - bins[k][1])

        return from_bin
    if one.tag == "ProbabilityDistributionSet":
        items = [(x.number("weight", least=0), x.value("value")) for x in one.children("Element")]
        edges = _shares(one, [x[0] for x in items])
        return lambda u: items[min(int(np.searchsorted(edges, u, side="right")) - 1, len(items) - 1)][1]
    return _of_scipy(one)


def _shares(node: Node, weights: Sequence[float]) -> NDArray[np.float64]:
    """Bounds of the shares of some weights, from 0 to 1."""
    if not weights or sum(weights) <= 0:
        raise node.error("its weights add up to nothing")
    return np.concatenate([[0.0], np.cumsum(weights) / sum(weights)])


def _of_scipy(node: Node) -> Draw:
    """A distribution with a formula, cut to its range."""
    from scipy import stats

    block = node.optional("Range")
    low, high = (-math.inf, math.inf) if block is None else _range(block)
    if node.tag == "PoissonDistribution":
        law: Any = stats.poisson(node.number("expectedValue", above=0))
        low = math.ceil(low) - 1 if math.isfinite(low) else low  # P(X <= low) leaves out the bound itself
    else:
        mean, variance = node.number("expectedValue"), node.number("variance", above=0)
        if node.tag == "NormalDistribution":
            law = stats.norm(mean, math.sqrt(variance))
        else:  # mean and variance are those of the variable itself, not of its logarithm
            if mean <= 0:
                raise node.error(f"expectedValue {mean:g} of a log-normal variable; above 0 is expected")
            spread = math.log1p(variance / mean**2)
            law = stats.lognorm(math.sqrt(spread), scale=mean * math.exp(-spread / 2))
    a, b = float(law.cdf(low)), float(law.cdf(high))
    if b - a < 1e-12:
        raise node.error(f"its range from {low:g} to {high:g} has no probability")
    return lambda u: float(law.ppf(a + u * (b - a)))
