"""Changes that make failures go away, and parameters that results hang on: where both are known."""

import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from limsim_jax.sweeps import sensitivity as sensitivity_module
from limsim_jax.sweeps import variation
from limsim_jax.sweeps.sensitivity import ARRIVALS, TRAFFIC
from limsim_jax.sweeps.store import Outcome
from limsim_jax.traffic.demand.draws import Layout, Number

sensitivity: Any = sensitivity_module.sensitivity  # of doubles of episodes
least_change: Any = variation.least_change
VEHICLES = 4


class TwoParameters:
    """Worlds of four vehicles with a time gap T and a braking b, and two arrivals."""

    scenario, policy, chunk, egos = "queue", "still", 32, 1

    given: Any = None

    def __init__(self, rule):
        numbers = [Number("gap", -1, 0, 0, k) for k in range(2)]
        numbers += [Number(what, k, -1, 0, k) for k in range(VEHICLES) for what in ("T", "b", "goal")]
        kinds = np.array(["uniform", "uniform"] + ["normal", "normal", "uniform"] * VEHICLES)
        self.layout = Layout(tuple(numbers), kinds, {"roles": (VEHICLES, 2), "order": (0,)}, {})
        self.units = {"speed": "m/s", "quiet": "1", "hit": "bodies"}
        self.town, self.rule, self.ran = SimpleNamespace(lane_ids=["main"]), rule, [0]

    def numbers(self, seeds):
        rows = [np.random.default_rng(seed).standard_normal(self.layout.size) for seed in seeds]
        return self.layout.from_normals(np.array(rows))

    def scenario_of(self, seed):
        return SimpleNamespace(schedule=SimpleNamespace(time=np.array([1.0, 2.0, 3.0, 99.0])))

    def from_numbers(self, given):
        other = copy.copy(self)
        other.given = given
        return other

    def run(self, seeds):
        assert 1 <= len(seeds) <= self.chunk
        self.ran[0] += len(seeds)
        z = self.layout.to_normals(self.given(np.asarray(seeds))[0])
        metrics = {name: np.asarray(x, float) for name, x in self.rule(z).items()}
        rows = np.asarray(seeds, np.int64)
        return Outcome(rows, np.zeros(len(rows), np.int32), metrics, {}, np.zeros(len(rows), np.uint64))


def of(layout, what, vehicle=None):
    return [k for k, x in enumerate(layout.numbers) if x.what == what and vehicle in (None, x.vehicle)]


def hits(metrics):
    return metrics["hit"] > 0


def rule_of(index, bound):
    def rule(z):
        hit = z[:, index] > bound
        return {"speed": z[:, 0], "quiet": np.ones(len(z)), "hit": hit}

    return rule


def seed_with(episodes, index, least):
    return next(s for s in range(500) if episodes.layout.to_normals(episodes.numbers([s]))[0, index] > least)


def test_the_number_that_a_failure_hangs_on_is_found():
    layout = TwoParameters(lambda z: {}).layout
    (index,) = of(layout, "b", 2)
    episodes = TwoParameters(rule_of(index, 0.5))
    seed = seed_with(episodes, index, 1.5)
    found = least_change(episodes, seed, hits)
    assert found.again and found.vehicles == ("vehicle 3 that enters on lane main",)
    assert found.change.what == "b" and found.change.numbers.tolist() == [index]
    assert found.change.before > 1.5
    step = found.change.before / variation.STEPS
    assert 0.5 - step <= found.change.after <= 0.5 + 1e-6, "the least change, within a step"
    assert found.worlds == episodes.ran[0] < 100
    assert str(found.change).startswith("b of vehicle 3 that enters on lane main: from +")


def test_two_numbers_of_a_vehicle_together():
    layout = TwoParameters(lambda z: {}).layout
    t, b = of(layout, "T", 0)[0], of(layout, "b", 0)[0]

    def rule(z):
        return {"speed": z[:, 0], "quiet": z[:, 0], "hit": (z[:, t] > 1) | (z[:, b] > 1)}

    episodes = TwoParameters(rule)
    seed = next(
        s for s in range(900) if (episodes.layout.to_normals(episodes.numbers([s]))[0, [t, b]] > 1).all()
    )
    found = least_change(episodes, seed, hits)
    assert found.change.what == "all numbers" and found.change.where == "vehicle 1 that enters on lane main"
    assert 0 < found.change.after < found.change.before


def test_a_failure_in_every_world_does_not_go_away():
    found = least_change(TwoParameters(lambda z: {"hit": np.ones(len(z))}), 0, hits)
    assert found == (True, None, (), found.worlds)


def test_a_failure_that_does_not_come_again_is_told():
    found = least_change(TwoParameters(lambda z: {"hit": np.zeros(len(z))}), 0, hits)
    assert not found.again and found.change is None


def test_vehicles_that_enter_afterwards_do_not_count():
    layout = TwoParameters(lambda z: {}).layout
    (index,) = of(layout, "T", 3)  # enters at 99 s
    episodes = TwoParameters(rule_of(index, 0.0))
    seed = seed_with(episodes, index, 0.5)
    assert least_change(episodes, seed, hits).change is not None
    assert least_change(episodes, seed, hits, until=50.0).change is None


def linear(z):
    layout = TwoParameters(lambda z: {}).layout
    t, b = z[:, of(layout, "T")].mean(1), z[:, of(layout, "b")].mean(1)
    return {
        "speed": 3 * t - b + 0.1 * z[:, of(layout, "goal")].sum(1),
        "quiet": np.ones(len(z)),
        "hit": t > 0,
    }


def test_slopes_are_those_of_the_model():
    found = sensitivity(TwoParameters(linear), ["speed", "quiet", "hit"], seeds=40)
    slopes = {x.parameter: x for x in found.of("speed")}
    assert list(slopes) == ["T", "b", ARRIVALS, TRAFFIC]
    assert slopes["T"].slope == pytest.approx((3, 3, 3), abs=1e-3)
    assert slopes["b"].slope == pytest.approx((-1, -1, -1), abs=1e-3)
    assert slopes[ARRIVALS].slope.estimate == 0 and slopes[ARRIVALS].total.estimate == 0
    assert slopes["T"].total.low > slopes["b"].total.high > 0
    assert slopes["T"].p < 0.01 and slopes[ARRIVALS].p > 0.05
    assert "quiet" not in found.means, "a metric that never changes has no effects"
    assert found.of("hit")[0].parameter == "T"
    assert found.worlds == 40 * (3 + 2)
    assert "T                  +3 [+3, +3] per standard deviation" in str(found)


def test_total_indices_of_an_additive_model_add_up():
    """Of three independent parts the indices are shares of the variance; chance is one of them."""
    found = sensitivity(TwoParameters(linear), ["speed"], seeds=300)
    total = {x.parameter: x.total.estimate for x in found.of("speed")}
    assert sum(total.values()) == pytest.approx(1, abs=0.25)
    assert total["T"] / total["b"] == pytest.approx(9, rel=0.35)


def test_intervals_of_slopes_hold_the_truth():
    """A metric with noise from the traffic: of twenty intervals about one misses."""
    noise = np.random.default_rng(0)

    def rule(z):
        layout = TwoParameters(lambda z: {}).layout
        return {"speed": 0.5 * z[:, of(layout, "T")].mean(1) + noise.standard_normal(len(z))}

    held = 0
    for seed in range(40):
        slope = {
            x.parameter: x.slope
            for x in sensitivity(TwoParameters(rule), ["speed"], seeds=30, seed=seed).effects
        }
        held += slope["T"].low <= 0.5 <= slope["T"].high
    assert held >= 34


def test_bad_input_is_one_line():
    with pytest.raises(ValueError, match="seeds: 3; at least 8"):
        sensitivity(TwoParameters(linear), ["speed"], seeds=3)
    with pytest.raises(ValueError, match="metrics: no metric 'sped'"):
        sensitivity(TwoParameters(linear), ["sped"], seeds=30)
