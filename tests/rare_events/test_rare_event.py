"""Probabilities of events with a closed form."""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import norm

import limsim_jax as lj
from limsim_jax.rare_events import samplers

V, DELAY, BRAKE, GAP = 25.0, 0.5, 8.0, 22.0
"""m/s of both, s of delay and m/s^2 of the follower, m of the gap."""

WORST = V * V / (2 * (V * DELAY + V * V / (2 * BRAKE) - GAP))
"""m/s^2: the follower touches a leader that brakes harder."""


def linear(p):
    beta = -norm.ppf(p)
    return lambda z: beta - z.sum(-1) / math.sqrt(z.shape[-1])


def braking_leader(p):
    """Least gap (m), step by step, behind a leader that brakes at a log-normal rate."""
    median = WORST * math.exp(0.3 * norm.ppf(p))

    def least_gap(z):
        own, leader = np.full(len(z), V), np.full(len(z), V)
        gap, least, dt = np.full(len(z), GAP), np.full(len(z), GAP), 0.05
        hard = median * np.exp(0.3 * z[:, 0])
        for step in range(120):
            slower = np.maximum(own - (BRAKE * dt if step * dt >= DELAY - 1e-9 else 0), 0)
            # exact distances, also of a vehicle that stops within the step
            own_way = np.where(slower > 0, dt * (own + slower) / 2, own * np.minimum(own / (2 * BRAKE), dt))
            ahead = np.maximum(leader - hard * dt, 0)
            way = np.where(ahead > 0, dt * (leader + ahead) / 2, leader * leader / (2 * hard))
            gap, own, leader = gap + way - own_way, slower, ahead
            least = np.minimum(least, gap)
        return least

    return least_gap


@pytest.mark.parametrize("p", [1e-2, 1e-4, 1e-6])
def test_braking_leader_has_its_closed_form_within_the_interval(p):
    found = lj.rare_event(braking_leader(p), 5, method="subset", samples=300, seed=1)
    assert found.probability.low < p < found.probability.high
    assert found.probability.high < 5 * p
    hard = found.points[:, 0]
    assert norm.cdf(-hard).max() <= p * (1 + 1e-6), "every point of the event is beyond the critical braking"


@pytest.mark.parametrize("p", [1e-2, 1e-4, 1e-6])
def test_subset_simulation_errs_as_published(p):
    """Means and spreads of one run as in the table of Au and Beck's method, with a thousand points."""
    found = lj.rare_event(linear(p), 2, method="subset", runs=40, seed=2)
    spread = found.runs.std(ddof=1) / found.runs.mean()
    expected = {1e-2: 0.19, 1e-4: 0.32, 1e-6: 0.45}[p]
    assert 0.6 * expected < spread < 1.6 * expected
    assert abs(found.runs.mean() / p - 1) < 4 * spread / math.sqrt(40)
    assert found.calls / 40 == pytest.approx({1e-2: 2400, 1e-4: 4200, 1e-6: 6000}[p], rel=0.1)


@pytest.mark.engine
def test_a_hundred_dimensions_cost_no_more():
    p = 2 * norm.cdf(-4.0)
    found = lj.rare_event(lambda z: 4 - abs(z.sum(-1)) / 10, 100, method="subset", runs=30)
    assert found.probability.low < p < found.probability.high
    assert found.calls / 30 < 5500
    sides = np.sign(found.points.sum(-1))
    assert 0.2 < np.mean(sides > 0) < 0.8, "both regions are found"


@pytest.mark.parametrize("method", ["subset", "cross-entropy"])
def test_intervals_hold_the_truth_as_often_as_they_say(method):
    p, held = 1e-3, 0
    for seed in range(100):
        found = lj.rare_event(linear(p), 2, method=method, samples=200, seed=seed).probability
        held += found.low <= p <= found.high
    assert 90 <= held <= 99


def test_splitting_in_time_agrees_with_counting():
    steps, wall = 20, 14.0

    def walk(z):
        return wall - np.cumsum(z, 1)

    moments = np.arange(steps)
    found = lj.rare_event(walk, steps, method="splitting", born=moments, samples=300, seed=3)
    plain = lj.rare_event(lambda z: walk(z).min(1), steps, method="crude", samples=20_000, seed=4)
    assert found.probability.low < plain.probability.high
    assert plain.probability.low < found.probability.high
    assert found.probability.high < 2 * plain.probability.estimate
    assert walk(found.points).min(1).max() <= 0


def test_clones_keep_their_past():
    """Only numbers drawn after the moment at which a path got beyond the level are drawn anew."""
    steps = 6
    sampler = samplers.splitting(np.random.default_rng(0), steps, 50, 1e-6, np.arange(steps))
    first = next(sampler)
    path = 8.0 - np.cumsum(first, 1)
    clones = sampler.send(path)
    level = np.sort(path.min(1))[::-1][4]
    for clone in clones:
        shared = (first == clone).sum(1)
        parent, kept = int(np.argmax(shared)), int(shared.max())
        assert (
            kept >= 1 and (path[parent, :kept].min() < level) and not (path[parent, : kept - 1] < level).any()
        )


@pytest.mark.parametrize("method", ["auto", "subset", "crude", "cross-entropy"])
def test_an_event_that_never_happens_has_a_bound(method):
    found = lj.rare_event(lambda z: 1 + np.abs(z[:, 0]), 3, method=method, samples=100, least=1e-5)
    assert found.probability.estimate == 0 and found.probability.low == 0
    assert found.probability.high == pytest.approx(3e-3, rel=0.01)
    assert not len(found.points)
    assert str(found).startswith("below 0.00299")


def test_an_event_that_gets_less_probable_for_ever_has_the_bound_of_its_last_level():
    found = lj.rare_event(lambda z: np.exp(-z[:, 0]), 2, samples=100, least=1e-5)
    assert found.probability == (0, 0, pytest.approx(1e-5))
    assert "if the limit state leads there" in found.notes[0]


@pytest.mark.parametrize("method", ["auto", "subset", "crude", "cross-entropy"])
def test_an_event_that_always_happens_has_probability_one(method):
    found = lj.rare_event(lambda z: -1 - np.abs(z[:, 0]), 3, method=method, samples=100)
    assert found.probability == (1, pytest.approx(0.996, abs=1e-3), 1)


def test_common_events_are_counted():
    found = lj.rare_event(lambda z: z[:, 0] + 1, 3, samples=500)
    assert found.method == "crude" and found.calls == 11 * 500
    assert found.probability.low < norm.cdf(-1) < found.probability.high


def test_two_values_are_no_limit_state():
    found = lj.rare_event(lambda z: np.where(z[:, 0] > 4.5, -1.0, 1.0), 2, method="subset", samples=100)
    assert "leads no further" in " ".join(found.notes)
    assert found.probability.high == pytest.approx(3e-3, rel=0.01)


def test_points_of_one_batch_come_from_all_runs():
    sizes = []

    def f(z):
        sizes.append(len(z))
        return linear(1e-3)(z)

    found = lj.rare_event(f, 2, method="subset", samples=100, runs=12)
    assert sizes[0] == 12 * 100 and sizes[1] == 12 * 10
    assert found.calls == sum(sizes)


def test_equal_seeds_are_equal_and_runs_independent():
    one, same, other = (
        lj.rare_event(linear(1e-3), 2, method="subset", samples=100, seed=s).runs for s in (5, 5, 6)
    )
    assert (one == same).all() and (one != other).any()
    assert len(set(one)) > 5


FAULTS = [
    ({"dim": 0}, "dim: 0; at least 1"),
    ({"method": "magic"}, "method: 'magic'; known are auto, crude, subset, cross-entropy, splitting"),
    ({"samples": 5}, "samples: 5; at least 20 per level and run"),
    ({"runs": 3}, "runs: 3; at least 10"),
    ({"least": 0.0}, "least: 0; a probability"),
    ({"level": 95}, "the level must lie between 0 and 1"),
    ({"method": "cross-entropy", "dim": 31}, "cross-entropy serves 30 dimensions at most, and there are 31"),
    ({"born": [0, 1]}, "born: of the method 'splitting', not of 'auto'"),
    ({"method": "splitting"}, "born: splitting needs a whole number per dimension, 2 of them"),
    ({"method": "splitting", "born": [1, 1]}, "born: all numbers are drawn at the same moment"),
]


@pytest.mark.parametrize(("given", "said"), FAULTS, ids=[said[:24] for _, said in FAULTS])
def test_faults_are_one_line(given, said):
    with pytest.raises(ValueError, match=r"^[^\n]+$") as error:
        lj.rare_event(linear(0.1), **{"dim": 2, **given})
    assert said in str(error.value)


def test_limit_states_are_checked():
    with pytest.raises(ValueError, match=r"f: it returned the shape \[1000, 2\] for 1000 points; \[1000\]"):
        lj.rare_event(lambda z: z, 2)
    with pytest.raises(ValueError, match="f: its value is NaN at"):
        lj.rare_event(lambda z: np.where(z[:, 0] > 2, np.nan, 1.0), 2)


def test_weights_of_importance_samples_are_bounded():
    z = np.array(list(itertools.product([-6.0, 0.0, 6.0], repeat=2)))
    weights = samplers._ratio(z, np.array([3.0, 3.0]), np.array([0.3, 0.3]))
    assert (weights > 0).all() and weights.max() <= 1 / samplers.DEFENSIVE + 1e-9
