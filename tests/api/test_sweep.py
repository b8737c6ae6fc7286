"""Sweep, results, worlds, forks and the environment, on one small experiment."""

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.compute as pc
import pytest

import limsim_jax as lj
from limsim_jax.sweeps.store import ResultsError

pytestmark = pytest.mark.engine

EGOS = [lj.Ego(start="1-", s=40.0, goal="3+"), lj.Ego(start="2-", s=30.0, goal="4+")]


class SlowTime(lj.Metric):
    name, unit, better = "slow_time", "s below 2 m/s", "lower"

    def init(self, slots):
        return jnp.float32(0)

    def update(self, carry, step):
        return carry + jnp.where(step.v < 2, step.dt, 0)

    def result(self, carry):
        return carry


@pytest.fixture(scope="module")
def drive():
    return lj.Experiment(
        map="roundabout", name="pair", horizon=6.0, slots=8, vehicles=4, ego=EGOS, metrics=[SlowTime()]
    )


@pytest.fixture(scope="module")
def results(drive, tmp_path_factory):
    policies = [lj.ConstantSpeed(speed=8.0), lj.named("slow", lj.ConstantSpeed(speed=1.0))]
    out = tmp_path_factory.mktemp("sweep") / "results"
    return lj.sweep(drive, policies=policies, seeds=3, out=out, chunk=4, progress=False)


def test_every_ego_has_a_row_of_metrics(results):
    rows = results.episodes.to_pylist()
    keys = [(row["policy"], row["seed"], row["ego"]) for row in rows]
    assert keys == [(p, s, e) for p in ("constant_speed", "slow") for s in range(3) for e in range(2)]
    by = {key: row for key, row in zip(keys, rows, strict=True)}
    for seed in range(3):
        assert by["constant_speed", seed, 0]["digest"] == by["constant_speed", seed, 1]["digest"]
        assert by["constant_speed", seed, 0]["completion"] != by["constant_speed", seed, 1]["completion"]
        for ego in range(2):
            assert by["constant_speed", seed, ego]["mean_speed"] == pytest.approx(8.0, abs=0.6)
            assert by["slow", seed, ego]["mean_speed"] < 3.0


def test_a_metric_of_ones_own_is_a_column(results):
    assert results.units["slow_time"].startswith("s below 2 m/s")
    slow = results.episodes.filter(pc.field("policy") == "slow").column("slow_time").to_pylist()
    fast = results.episodes.filter(pc.field("policy") == "constant_speed").column("slow_time").to_pylist()
    assert min(slow) > 2.0 and max(fast) == 0.0


def test_results_print_and_show_themselves(results):
    text, page = str(results), results._repr_html_()
    assert "pair / constant_speed" in text and "success" in text
    assert page.lstrip().startswith("<") and "pair / slow" in page
    assert results.policies == ["constant_speed", "slow"] and len(results) == 12
    assert results.to_pandas().shape[0] == 12


def test_comparison_pairs_seeds_and_egos(results):
    found = results.compare("constant_speed", "slow")
    row = next(row for row in found.table.to_pylist() if row["metric"] == "mean_speed")
    assert "pair" in str(row["scenario"])
    with pytest.raises(ValueError, match="no policy 'fast'; there are constant_speed, slow"):
        results.compare("constant_speed", "fast")
    assert str(found).startswith("metric ") and "<table>" in found._repr_html_()
    assert len(found.text(k=3).rows) == 3


def test_worst_rows_are_replayed(results):
    row = results.worst(1)[0]
    world = row.replay()
    assert (world.scenario, world.policy, world.seed) == (row.scenario, row.policy, row.seed)
    again = results.row(row.seed, policy=row.policy, ego=world.ego)
    for name in ("mean_speed", "distance", "slow_time"):
        assert world.metrics[name] == pytest.approx(again[name], rel=1e-3)


def test_trajectories_are_one_long_table(results, tmp_path):
    table = results.trajectories([0, 2], policy="slow")
    assert table.column_names[:4] == ["scenario", "policy", "seed", "time"]
    assert set(table.column("seed").to_pylist()) == {0, 2}
    driven = table.filter(pc.field("driven"))
    assert len(set(driven.column("slot").to_pylist())) == 2
    one = table.filter((pc.field("seed") == 0) & (pc.field("slot") == 0))
    x, y, v = (one.column(name).to_numpy() for name in ("x", "y", "v"))
    moved = np.hypot(np.diff(x), np.diff(y))
    np.testing.assert_allclose(moved, 0.1 * (v[1:] + v[:-1]) / 2, atol=0.02)


def test_a_folder_resumes_and_opens(results, drive):
    policies = [lj.ConstantSpeed(speed=8.0), lj.named("slow", lj.ConstantSpeed(speed=1.0))]
    opened = lj.open_results(results.path)
    assert opened.episodes.equals(results.episodes)
    with pytest.raises(ResultsError, match="made with policy from Python"):
        opened.replay(0, policy="slow")
    with pytest.raises(ResultsError, match="holds other results of pair/slow"):
        other = [policies[0], lj.named("slow", lj.ConstantSpeed(speed=2.0))]
        lj.sweep(drive, policies=other, seeds=3, out=results.path, chunk=4, progress=False)


def test_a_world_is_forked(results):
    world = results.replay(1, policy="slow")
    futures = world.fork(at=2.0, policies=[None, lj.ConstantSpeed(speed=8.0)], count=2, seconds=2.0)
    table = futures.table().to_pylist()
    assert [(row["policy"], row["copy"]) for row in table] == [
        ("slow", 0), ("slow", 1), ("constant_speed", 0), ("constant_speed", 1),
    ]  # fmt: skip
    assert table[0]["mean_speed"] < table[2]["mean_speed"]
    then = np.searchsorted(world.trace.time, 2.0, side="right") - 1
    seen = futures[0].trace
    np.testing.assert_allclose(seen.time[0], 2.1, atol=1e-4)
    np.testing.assert_allclose(seen.box[4, 0, :2], world.trace.box[then + 5, 0, :2], atol=0.05)
    with pytest.raises(ValueError, match="nothing is left"):
        world.fork(at=6.0)


def test_a_world_is_forked_at_several_moments(results):
    world = results.replay(1, policy="slow")

    def faster(state, k):
        return state.replace(v=state.v.at[state.egos.slot].set(4.0 + k.astype(jnp.float32)))

    kept = lj.ConstantSpeed()  # the speed of the moment
    futures = world.fork(at=[3.0, 4.0], policies=[kept], count=2, change=faster, seconds=1.0)
    rows = futures.table().to_pylist()
    assert [(row["at"], row["copy"]) for row in rows] == [(3.0, 0), (3.0, 1), (4.0, 0), (4.0, 1)]
    np.testing.assert_allclose([row["mean_speed"] for row in rows], [4, 5, 4, 5], atol=0.3)
    np.testing.assert_allclose([future.trace.time[0] for future in futures], [3.1, 3.1, 4.1, 4.1], atol=1e-4)
    assert str(futures) == "4 futures from 3, 4 s on (constant_speed)"


def test_plain_traffic_is_swept():
    traffic = lj.Experiment(
        map="roundabout", ego=None, flows=[lj.Flow(rate=600)], horizon=6, slots=8, vehicles=4
    )
    found = lj.sweep(traffic, seeds=2, chunk=2, progress=False)
    assert found.policies == ["traffic"] and len(found) == 2
    assert "success" not in found.units and found.episodes.column("traffic_entered").to_pylist()[0] >= 4
    world = found.replay(0)
    assert world.ego == -1 and world.trajectories().num_rows > 100
    text = str(found)
    assert "mean speed, m/s" in text and "flow per lane, vehicles/h" in text and "density" in text


def test_an_environment_steps_and_batches():
    drive = lj.Experiment(
        map="roundabout", horizon=3.0, slots=8, vehicles=4, ego=lj.Ego(start="1-", s=40.0, goal="3+", v=8.0)
    )
    env = lj.Env(drive)
    reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
    keys = jax.random.split(jax.random.key(0), 2)
    obs, state = reset(keys)
    assert obs.v.shape == (2, 1) and obs.other_x.shape[:2] == (2, 1)
    action = {"acceleration": jnp.asarray([[1.0], [-2.0]]), "steering": jnp.zeros((2, 1))}
    before, rewards = obs, []
    reward = terminated = info = None
    for k in range(env.horizon):
        obs, state, reward, terminated, truncated, info = step(keys, state, action)
        rewards.append(reward)
        assert bool(truncated.all()) == (k == env.horizon - 1)
    assert reward is not None and terminated is not None and info is not None
    assert reward.shape == (2, 1) and terminated.shape == (2, 1)
    assert obs.v[0, 0] > before.v[0, 0] > obs.v[1, 0]
    assert sum(r[0, 0] for r in rewards) > sum(r[1, 0] for r in rewards)
    np.testing.assert_allclose(info.time, 3.0, atol=1e-5)
    alone, _ = jax.jit(env.reset)(keys[1])
    np.testing.assert_array_equal(np.asarray(alone.v), np.asarray(before.v[1]))


def test_an_environment_shows_what_the_ego_sees():
    def there(**ego):
        ego = lj.Ego(start="1-", s=40.0, goal="3+", v=8.0, **ego)
        env = lj.Env(lj.Experiment(map="roundabout", horizon=3.0, slots=8, vehicles=6, ego=ego))
        return np.asarray(jax.jit(env.reset)(jax.random.key(0))[0].there).sum()

    assert there(view={"range": 1.0}) == 0 < there() < there(view={"range": 1e4})
    assert there(view={"range": 1.0}, privileged=True) == there(view={"range": 1e4})
    with pytest.raises(ValueError, match=r"view\.latency: 0\.3 s; expected a multiple of 0\.5 s"):
        there(view={"latency": 0.3})


def test_an_environment_needs_an_ego_and_a_known_action():
    with pytest.raises(lj.ExperimentError, match="ego: an environment needs at least one"):
        lj.Env(lj.Experiment(map="roundabout", ego=None, horizon=5, vehicles=2))
    with pytest.raises(ValueError, match="action: 'wheel'; known are control"):
        lj.Env("roundabout", action="wheel")  # pyright: ignore[reportArgumentType]
