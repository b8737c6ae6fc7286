"""Training of the end-to-end driver without the traffic engine: losses, samples, steps, what is refused."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax.policies.end_to_end.network import (
    CHANGES,
    DENSITY_GRID,
    Design,
    Network,
    Outputs,
    Trained,
    blank_inputs,
    fresh_weights,
    two_hot,
)
from limsim_jax.training import end_to_end
from limsim_jax.training.collect import Labels, Sample
from limsim_jax.training.end_to_end import Learner, Losses, Store, importance, losses, train

DESIGN = Design(cameras=False, hidden=32)


def labels(count: int, change: Any = 0.0, **changes: Any) -> Any:
    """Labels of moments on an empty road."""
    rows, columns = DENSITY_GRID.shape
    plain: Any = dict(
        path=np.zeros((count, 10), np.float32),
        known=np.ones((count, 10), bool),
        change=np.full(count, change, np.float32),
        waypoints=np.zeros((count, 8, 2), np.float32),
        density=np.zeros((count, rows, columns, 8), np.float32),
        rules=np.zeros((count, 3), bool),
    )
    return Labels(**(plain | changes))


def samples(count: int) -> Any:
    """Moments in which what is ahead says what to do: brake for a point that is near."""
    draw = np.random.default_rng(1)
    near = draw.random(count) < 0.5
    inputs: Any = jax.tree.map(np.array, blank_inputs(count))
    inputs.bands[:, :, 5, 0] = np.where(near, 8.0, 80.0)[:, None]
    inputs.ego[:, 0] = 0.5
    change = np.where(near, -3.0, 1.0).astype(np.float32)
    path = np.where(near, 1.0, 0.0)[:, None].repeat(10, 1).astype(np.float32)
    good: Any = np.ones(count, bool)
    return Sample(inputs, labels(count, change=change, path=path), good)


cost = jax.jit(losses)


def perfect(told: Labels) -> Outputs:
    """What a network would say that knows the labels."""
    density = np.array(told.density)
    density[..., 0] = np.where(density[..., 0] > 0, 20, -20)
    return Outputs(
        path=jnp.asarray(told.path),
        speed=jnp.log(two_hot(jnp.asarray(told.change)) + 1e-12),
        waypoints=jnp.asarray(told.waypoints),
        density=jnp.asarray(density),
        rules=jnp.where(jnp.asarray(told.rules), 20.0, -20.0),
    )


def test_a_perfect_network_has_no_loss_and_an_error_costs_its_own_part():
    told = labels(2, change=1.0)
    told.density[0, 5, 5] = (1, 0.1, 0.2, 1, 0, 1, 1, 0.5)
    told.rules[1, 2] = True
    said = perfect(told)
    least = cost(said, told)
    for name, value in least._asdict().items():
        assert float(value) == pytest.approx(0, abs=1e-4), name
    worse: dict[str, Outputs] = {
        "path": said._replace(path=said.path + 1.0),
        "speed": said._replace(speed=said.speed[:, ::-1]),
        "waypoints": said._replace(waypoints=said.waypoints + 1.0),
        "density": said._replace(density=said.density.at[0, 5, 5, 0].set(-20)),
        "rules": said._replace(rules=-said.rules),
    }
    for name, changed in worse.items():
        found = cost(changed, told)
        for part in Losses._fields:
            assert (float(getattr(found, part)) > 0.1) == (part == name), (name, part)


def test_points_that_the_plan_does_not_reach_cost_nothing():
    told = labels(2)
    told.known[:, 4:] = False
    said = perfect(told)
    off = said._replace(path=said.path.at[:, 4:].set(9.0))
    assert float(cost(off, told).path) == 0
    off = said._replace(path=said.path.at[:, 3].set(1.0))
    assert float(cost(off, told).path) == pytest.approx(0.875 / 4)


def test_an_ablation_without_a_path_learns_waypoints_only():
    parts = Losses(*(jnp.float32(x) for x in (1, 10, 100, 0, 0)))
    assert float(parts.total(Design())) == pytest.approx(11)
    assert float(parts.total(Design(waypoints=True))) == pytest.approx(30)


@functools.cache
def store() -> Store:
    found = Store(seed=0)
    whole = samples(64)
    for k in range(0, 64, 16):
        found.add("toy", jax.tree.map(lambda x: x[k : k + 16], whole))  # noqa: B023
    return found


def test_some_segments_are_held_out_and_old_samples_make_room():
    kept, held = store().samples(), store().samples(held=True)
    assert len(kept.good) + len(held.good) == 64 and len(held.good) % 16 == 0 and len(held.good) > 0
    assert store().counts == {"toy": 64} and len(store()) == len(kept.good)
    small = Store(most=20, seed=0)
    for _ in range(4):
        small.add("toy", samples(16))
    assert len(small.samples().good) == 20 and small.counts == {"toy": 64}
    small.add("toy", jax.tree.map(lambda x: x[:0], samples(16)))
    assert len(small) == 20


def test_rare_and_important_moments_are_drawn_more_often():
    told = labels(4, change=np.array([0, -3, 1, 0], np.float32))
    told.rules[3, 1] = True
    ego = np.zeros((4, 9), np.float32)
    ego[:, 0] = (1, 1, 0, 1)
    np.testing.assert_allclose(importance(told, ego), [1, 3, 4, 3])


@pytest.mark.engine  # it compiles a step of training
def test_the_loss_of_a_toy_batch_falls_and_the_best_weights_are_kept(monkeypatch):
    monkeypatch.setattr(end_to_end, "BATCH", 32)
    learner = Learner(DESIGN)
    begin = learner.look(store())
    clock = iter(np.arange(0, 1000, 0.01))
    found = list(learner.learn(store(), seconds=2.2, clock=lambda: float(next(clock))))
    assert [steps for steps, *_ in found][:2] == [100, 200]
    end = found[-1][2]
    assert float(end.speed) < 0.5 * float(begin.speed) and float(end.path) < 0.5 * float(begin.path)
    best, weights = learner.best
    said = Network(DESIGN).apply({"params": weights}, store().samples(held=True).inputs)
    assert isinstance(said, Outputs)
    assert float(losses(said, store().samples(held=True).labels).total(DESIGN)) == pytest.approx(
        best, rel=0.3
    )
    near = np.asarray(store().samples(held=True).labels.change) < 0
    change = np.asarray(jax.nn.softmax(said.speed)) @ np.array(CHANGES)
    assert (change[near] < change[~near].min()).all()


def test_the_speed_is_hidden_at_random():
    ego = np.ones((400, 9), np.float32)
    some = samples(400)
    hidden = Learner(DESIGN)._without_speed(some._replace(inputs=some.inputs._replace(ego=ego)))
    found = np.asarray(hidden.inputs.ego)
    lost = found[:, -1] == 0
    assert 0.2 < lost.mean() < 0.4
    assert (found[lost][:, :2] == 0).all() and (found[~lost] == 1).all() and (found[:, 2:-1] == 1).all()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"rounds": -1}, "-1 rounds; expected 0 or more"),
        ({"worlds": 0}, "0 worlds; expected at least 1"),
        ({"minutes": 0.0}, "0 minutes; expected more than 0"),
        ({"scenarios": []}, "no scenarios"),
    ],
)
def test_settings_without_sense_are_refused(tmp_path, options, says):
    with pytest.raises(ValueError, match=says):
        train(tmp_path / "w.npz", **options)


def test_weights_differ_by_seed_only():
    one, same, other = (fresh_weights(DESIGN, seed) for seed in (1, 1, 2))
    assert all(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(same)))
    assert not np.array_equal(one["path"]["kernel"], other["path"]["kernel"])


def test_a_training_that_is_stopped_at_once_still_says_so():
    about = {"seconds": 30.0, "samples": {}, "steps": 0, "held_out": None}
    report = end_to_end.Report(Trained(DESIGN, {}, about), stopped=True)
    assert str(report) == "stopped after 0.5 min: 0 samples, 0 steps, held-out loss unknown"
