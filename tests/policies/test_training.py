"""PDM-Hybrid: inputs, trajectory, weights, and training on rollouts."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, motorway, state_of

from limsim_jax.policies.pdm import PDMClosed, learned
from limsim_jax.policies.pdm.learned import (
    BEYOND,
    Features,
    Offset,
    PDMHybrid,
    features,
    load_weights,
    no_past,
    remember,
    save_weights,
)
from limsim_jax.sweeps.identity import describe
from limsim_jax.traffic.ego import from_lane
from limsim_jax.traffic.motion import boxes
from limsim_jax.training import Samples, errors, fit, train
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
N = 4


@functools.cache
def world():
    """An ego behind another vehicle on the motorway."""
    lane_map = bundled("highway")[1]
    row, goal = motorway()
    state = state_of(
        "highway", [row] * N, [60.0, 100.0, 10.0, 10.0], [20.0, 15.0, 0.0, 0.0], [goal] * N,
        active=jnp.array([True, True, False, False]),
    )  # fmt: skip
    return lane_map, dataclasses.replace(
        state, egos=from_lane(lane_map, state, boxes(lane_map, state), [0], True)
    )


@functools.cache
def foreseen():
    """What the rules, the inputs and the network say of that world."""

    @jax.jit
    def all_of_it(lane_map, state):
        past = remember(no_past(CONFIG, state), state)
        plan = PDMClosed().plan(CONFIG, lane_map, state, beyond=BEYOND)
        seen = features(CONFIG, lane_map, state, past, plan)
        return plan, seen, PDMHybrid().foresee(CONFIG, lane_map, state, past)

    return jax.device_get(all_of_it(*world()))


def test_inputs_are_in_the_frame_of_the_ego():
    plan, seen, _ = foreseen()
    history = seen.history[0]
    # straight on at 20 m/s: 4 m every 0.2 s
    np.testing.assert_allclose(history[:, 0], -4.0 * np.arange(11), atol=0.3)
    np.testing.assert_allclose(history[:, 1:3], 0, atol=0.1)
    np.testing.assert_allclose(history[:, 3], 20.0, atol=1e-3)
    line = seen.centre_line[0]
    np.testing.assert_allclose(line[0], 0, atol=0.02)
    np.testing.assert_allclose(np.hypot(*np.diff(line[:, :2], axis=0).T), 1.0, atol=0.01)
    x, y = plan.trajectory.x[0], plan.trajectory.y[0]
    np.testing.assert_allclose(
        np.hypot(*seen.plan[0, 3, :2]), np.hypot(x[20] - x[0], y[20] - y[0]), atol=0.02
    )
    assert seen.plan.shape == (1, 16, 3) and (np.diff(seen.plan[0, :, 0]) > 0).all()


def test_two_seconds_are_those_of_the_rules_and_the_rest_is_corrected():
    plan, seen, (command, poses) = foreseen()
    trajectory = command.trajectory
    for name in ("x", "y", "heading", "v"):
        ours, rules = getattr(trajectory, name)[0], getattr(plan.trajectory, name)[0]
        np.testing.assert_allclose(ours[:21], rules[:21], atol=1e-4)
    assert trajectory.x.shape == (1, 81)
    # at the poses the trajectory is what the network says
    _, state = world()
    x0, y0, h0 = (float(getattr(state.egos, k)[0]) for k in ("x", "y", "heading"))
    dx, dy = trajectory.x[0, 25::5] - x0, trajectory.y[0, 25::5] - y0
    np.testing.assert_allclose(np.cos(h0) * dx + np.sin(h0) * dy, poses[0, 4:, 0], atol=0.05)
    np.testing.assert_allclose(np.cos(h0) * dy - np.sin(h0) * dx, poses[0, 4:, 1], atol=0.05)
    assert np.abs(poses - seen.plan).max() > 0.01, "the weights that come along do something"
    assert np.isfinite(poses).all() and (trajectory.v >= 0).all()


def made_up(count, seed=0):
    """Moments in which the future is 3 % slower than planned and bends to the left with the history."""
    rng = np.random.default_rng(seed)
    history, line = rng.normal(size=(count, 11, 8)), rng.normal(size=(count, 120, 3))
    way = rng.uniform(2, 15, (count, 1)) * 0.5 * np.arange(1, 17)
    aside = 0.05 * (0.5 * np.arange(1, 17)) ** 2 * history[:, :1, 1]
    plan = np.stack([way, 0 * way, 0 * way], -1)
    future = np.stack([0.97 * way, aside, 0 * way], -1)
    seen = Features(*(jnp.asarray(x, jnp.float32) for x in (history, line, plan)))
    return Samples(seen, future.astype(np.float32), np.zeros(count, np.int32))


def test_fitting_learns_what_can_be_learned(tmp_path):
    samples, unseen = made_up(2000), made_up(300, 1)
    weights = fit(samples, hidden=32, epochs=25, batch=200)
    before = errors(unseen.features.plan, unseen.future)
    after = errors(Offset(32).apply({"params": weights}, unseen.features), unseen.future)
    assert after.ade < 0.7 * before.ade and after.l1 < 0.7 * before.l1
    assert before.ade == pytest.approx(
        np.mean(np.hypot(*np.moveaxis(np.asarray(unseen.features.plan) - unseen.future, -1, 0)[:2])), rel=1e-5
    )
    save_weights(tmp_path / "w.npz", weights)
    read = load_weights(str(tmp_path / "w.npz"))
    for layer, values in weights.items():
        for name, value in values.items():
            np.testing.assert_allclose(read[layer][name], value, rtol=2e-3, atol=1e-4)


def test_an_untrained_network_is_the_plan():
    some = made_up(5)
    model = Offset(16)
    weights = model.init(jax.random.key(0), some.features)
    np.testing.assert_array_equal(model.apply(weights, some.features), some.features.plan)


def test_wrong_files_of_weights_are_named(tmp_path):
    assert learned.WEIGHTS.stat().st_size < 1e6
    with pytest.raises(ValueError, match=r"missing\.npz: no weights of PDM-Hybrid"):
        PDMHybrid(weights=str(tmp_path / "missing.npz"))
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match=r"other\.npz: layers that see"):
        PDMHybrid(weights=str(tmp_path / "other.npz"))
    whole = learned.WEIGHTS.read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2]):
        (tmp_path / "broken.npz").write_bytes(content)
        with pytest.raises(ValueError, match=r"broken\.npz: no weights of PDM-Hybrid"):
            PDMHybrid(weights=str(tmp_path / "broken.npz"))
    with pytest.raises(ValueError, match="0 seeds to learn from"):
        train(tmp_path / "w.npz", seeds=0)


def test_a_file_that_is_trained_again_is_another_policy(tmp_path):
    file = str(tmp_path / "w.npz")
    some = made_up(1)
    first, second = (Offset(8).init(jax.random.key(seed), some.features)["params"] for seed in (0, 1))
    save_weights(file, first)
    old, same = PDMHybrid(weights=file), PDMHybrid(weights=file)
    save_weights(file, second)
    new = PDMHybrid(weights=file)
    assert old == same != new and describe(old) == describe(same) != describe(new)
    for policy, weights in ((old, first), (new, second)):  # each drives as what it read
        kernel = np.asarray(weights["Dense_0"]["kernel"])
        np.testing.assert_allclose(policy.network["Dense_0"]["kernel"], kernel, rtol=2e-3, atol=1e-4)


@pytest.mark.slow
def test_training_by_one_call(tmp_path):
    lines: list[str] = []
    report = train(
        tmp_path / "w.npz", experiments=["intersection"], seeds=6, held_out=2, hidden=32, epochs=10, chunk=4,
        tell=lines.append,
    )  # fmt: skip
    assert report.samples > 200 and report.held_out > 50 and lines
    assert report.after.l1 < report.before.l1
    assert PDMHybrid(weights=str(tmp_path / "w.npz")).free
