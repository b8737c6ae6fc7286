"""Evaluators of one ego, of several, and of the traffic alone, on the same random records."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from observed_worlds import CONFIG, N, crossing, random_tick, stacked

from limsim_jax.metrics.catalog import EGO, TRAFFIC
from limsim_jax.metrics.measure import Metric
from limsim_jax.metrics.observer import EvaluateEgo, EvaluateEgos, EvaluateTraffic
from limsim_jax.metrics.reductions import on_host
from limsim_jax.simulation.rollout import measured_start

STEPS = 7

pytestmark = pytest.mark.engine


class Worst(Metric):
    name, unit = "worst_offset", "m"

    def init(self, slots):
        return jnp.float32(0)

    def update(self, carry, step):
        return jnp.maximum(carry, jnp.abs(step.d))

    def result(self, carry):
        return carry


def story(seed: int, rows: int = 2) -> list[Any]:
    """Steps of one world, its egos in the same slots all the time."""
    rng = np.random.default_rng(seed)
    slot = int(rng.integers(N))
    ticks = [random_tick(rng, slot) for _ in range(STEPS)]
    first = ticks[0].state
    return [
        tick._replace(
            state=dataclasses.replace(
                tick.state,
                goal=first.goal,
                egos=jax.tree.map(lambda x: x[:rows], first.egos),
            )
        )
        for tick in ticks
    ]


OWN = (Worst(),)


@functools.cache
def program(evaluator: Any) -> Any:
    """Results over the steps after the first one, in decisions of two."""

    def all_of(lane_map, start, ticks):
        carry = measured_start(evaluator, CONFIG, lane_map, start)
        records = jax.vmap(lambda tick: evaluator.record(CONFIG, lane_map, tick))(ticks)
        decisions = jax.tree.map(lambda x: x.reshape(STEPS // 2, 2, *x.shape[1:]), records)

        def update(carry, records):
            return evaluator.update(CONFIG, lane_map, carry, records), None

        return evaluator.result(CONFIG, lane_map, jax.lax.scan(update, carry, decisions)[0])

    return jax.jit(all_of)


def measure(evaluator: Any, ticks: list[Any]) -> dict[str, Any]:
    return on_host(jax.device_get(program(evaluator)(crossing(), ticks[0].state, stacked(ticks[1:]))))


def assert_same(found, expected):
    assert set(found) == set(expected)
    for name, value in expected.items():
        value = np.nan if value is None else value
        np.testing.assert_allclose(np.float64(found[name]), value, rtol=1e-5, atol=1e-5, err_msg=name)


@pytest.fixture(scope="module")
def both():
    pairs = []
    for seed in range(3):
        ticks = story(seed)
        alone = [measure(EvaluateEgo(ego=k, metrics=OWN), ticks) for k in range(2)]
        pairs.append((measure(EvaluateEgos(2, metrics=OWN), ticks), alone))
    return pairs


def test_several_egos_have_the_metrics_of_each_alone(both):
    for together, alone in both:
        assert {value.shape for value in together.values()} == {(2,)}
        for k in range(2):
            assert_same({name: value[k] for name, value in together.items()}, alone[k])


def test_egos_of_one_world_differ(both):
    differ = {
        name
        for together, _ in both
        for name, (a, b) in together.items()
        if not name.startswith("traffic_") and a != b and not (np.isnan(a) and np.isnan(b))
    }
    assert {"distance", "mean_speed", "min_distance", "worst_offset"} <= differ


def test_one_of_several_is_one_ego():
    ticks = story(5)
    alone = measure(EvaluateEgo(metrics=OWN), ticks)
    together = measure(EvaluateEgos(1, metrics=OWN), ticks)
    assert {value.shape for value in together.values()} == {(1,)}
    for name, value in alone.items():
        np.testing.assert_array_equal(together[name][0], np.nan if value is None else value)


def test_traffic_alone_has_the_traffic_metrics_of_a_world_with_an_ego():
    ticks = story(6)
    found = measure(EvaluateEgo(metrics=OWN), ticks)
    expected = {name: value for name, value in found.items() if name.startswith("traffic_")}
    assert set(expected) == {column.name for column in TRAFFIC}
    assert_same(measure(EvaluateTraffic(), story(6, rows=0)), expected)


def test_columns_of_several_egos_are_those_of_one():
    names = [column.name for column in (*EGO, *TRAFFIC)]
    assert list(EvaluateEgos(3).units) == list(EvaluateEgo(ego=2).units) == names


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: EvaluateEgo(ego=-1), "ego is -1; a row of State.egos is expected"),
        (lambda: EvaluateEgos(0), "count is 0; at least 1 ego"),
    ],
)
def test_egos_that_cannot_be(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("evaluator", [EvaluateEgo(ego=2), EvaluateEgos(3)])
def test_an_ego_that_the_world_does_not_have_is_named(evaluator):
    state = story(0)[0].state
    with pytest.raises(ValueError, match="ego 2 is measured, but the world has 2 egos"):
        jax.eval_shape(lambda state: evaluator.init(CONFIG, crossing(), state), state)
