"""From the engine to the metrics: what an episode is said to be, against loops over its trace."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ego_records import as_steps, free

from limsim_jax.maps.lane_map import NO_LANE
from limsim_jax.maps.signal_table import SignalState
from limsim_jax.maps.signals import lane_states
from limsim_jax.metrics.ego import EgoMetrics
from limsim_jax.metrics.reductions import on_host
from limsim_jax.metrics.safety import encounter, overlaps
from limsim_jax.sweeps import episode
from limsim_jax.sweeps.episode import Episodes, succeeds
from limsim_jax.sweeps.estimate import estimate
from limsim_jax.sweeps.experiment import Bounds, ExperimentFile
from limsim_jax.sweeps.moments import key_moments

pytestmark = pytest.mark.engine

SEEDS = (0, 3, 5)
SLOTS = 32


def experiment(policy: str, **more) -> ExperimentFile:
    """A short crossing with lights; blind egos do hit others here."""
    told = {
        "name": "crossing", "map": "intersection", "horizon": 20.0, "slots": SLOTS,
        "ego": {"start": "6-", "s": 60.0, "goal": "2", "policy": policy},
        "traffic": {"vehicles": 20, "flow": [{"rate": 350}]},
    }  # fmt: skip
    return ExperimentFile.model_validate(told | more)


@functools.cache
def episodes(policy: str) -> Episodes:
    return Episodes(experiment(policy), chunk=4)


@functools.cache
def replayed(policy: str, seed: int):
    return episodes(policy).replay(seed)


def cases():
    return [(policy, seed) for policy in ("like_traffic", "constant_speed") for seed in SEEDS]


@pytest.mark.parametrize("policy, seed", cases())
def test_the_ego_as_its_trace_has_it(policy, seed):
    _, lane_map, trace, ego, _, metrics, _ = replayed(policy, seed)
    on = trace.active[:, ego]
    v, lane, s = trace.v[on, ego], trace.lane[on, ego], trace.s[on, ego]
    assert metrics["duration"] == pytest.approx(trace.time[on][-1], abs=0.11)
    assert metrics["distance"] == pytest.approx(v.sum() * 0.1, rel=0.01)
    assert metrics["mean_speed"] == pytest.approx(metrics["distance"] / metrics["duration"], rel=1e-4)
    limit = np.asarray(lane_map.speed_limit)[lane]
    assert metrics["max_overspeed"] == pytest.approx(np.maximum(v - limit, 0).max(), abs=1e-4)
    assert metrics["speeding"] == pytest.approx((v > limit + 0.01).mean(), abs=0.005)
    egos = episodes(policy)._egos
    assert egos is not None and egos.goal is not None and egos.lane is not None
    goal = egos.goal[0]
    to_go = np.asarray(lane_map.routes.distance)[lane, goal] - s
    reached = to_go < 1e8
    start = np.asarray(lane_map.routes.distance)[egos.lane[0], goal] - 60.0
    share = 1 - to_go[reached][-1] / start
    expected = 1.0 if metrics["arrived"] else share
    assert metrics["completion"] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("policy, seed", cases())
def test_contacts_are_where_bodies_overlap(policy, seed):
    _, _, trace, ego, _, metrics, _ = replayed(policy, seed)
    still = jnp.zeros(2)
    first, who = None, None
    for t in range(len(trace.time)):
        others = [j for j in range(SLOTS) if j != ego and trace.active[t, j] and trace.active[t, ego]]
        hit = [j for j in others if overlaps(encounter(trace.box[t, ego], still, trace.box[t, j], still))]
        if hit:
            first, who = float(trace.time[t]), hit[0]
            break
    if first is None:
        assert metrics["contacts"] == 0 and np.isnan(metrics["contact_time"])
    else:
        assert metrics["contact_time"] == pytest.approx(first, abs=1e-4)
        assert metrics["contact_other"] == who and metrics["contacts"] >= 1 and metrics["success"] == 0


def test_both_kinds_of_end_occur():
    contacts = [replayed("constant_speed", seed).metrics["contacts"] for seed in SEEDS]
    assert max(contacts) > 0, "otherwise the test above tells little"
    assert all(replayed("like_traffic", seed).metrics["contacts"] == 0 for seed in SEEDS)


def test_the_module_that_is_to_blame():
    blind, modular = (episodes(name) for name in ("constant_speed", "modular_policy:Modular"))
    hit = [seed for seed in SEEDS if replayed("constant_speed", seed).metrics["contacts"]]
    for seed in hit[:2]:
        row = modular.replay(seed).moments[0]
        assert (row["kind"], row["module"]) == ("contact", "planning")
        alone = replayed("constant_speed", seed).moments[0]
        assert alone["module"] is None and alone["avoidable_by_ego"] == row["avoidable_by_ego"]
    calm = next(seed for seed in SEEDS if not replayed("like_traffic", seed).metrics["contacts"])
    assert not any(row.get("module") for row in replayed("like_traffic", calm).moments)
    assert blind._reruns._references == {}


def test_a_brief_replay_is_the_beginning_of_the_whole_one(monkeypatch):
    run = episodes("like_traffic")
    monkeypatch.setattr(episode, "AFTERWARDS", 1.0)
    monkeypatch.setattr(run.worlds, "rollout", replace(run.worlds.rollout, horizon=150.0))  # egos arrive
    which = [(seed, 0) for seed in SEEDS]
    whole, brief = run.replays(which), run.replays(which, brief=True)
    steps = len(brief[0].trace.time)
    assert 100 < steps < len(whole[0].trace.time) == 1500, "otherwise this tells little"
    for long, short in zip(whole, brief, strict=True):
        for field, x, y in zip(long.trace._fields, long.trace, short.trace, strict=True):
            assert (x is None) == (y is None)
            if x is not None:
                np.testing.assert_array_equal(x[:steps], y, err_msg=field)
        assert str(long.moments) == str(short.moments)
        of_traffic = {name for name in long.metrics if name.startswith("traffic_")}
        for name in long.metrics.keys() - of_traffic:
            np.testing.assert_equal(long.metrics[name], short.metrics[name], err_msg=name)


@pytest.mark.parametrize("policy, seed", cases())
def test_lights_crossed_on_red(policy, seed):
    _, lane_map, trace, ego, _, metrics, _ = replayed(policy, seed)
    egos, crossed = episodes(policy)._egos, 0
    assert egos is not None and egos.goal is not None
    for t in range(1, len(trace.time)):
        if not trace.active[t, ego]:
            continue
        before, lane = trace.lane[t - 1, ego], trace.lane[t, ego]
        line = min(float(lane_map.stop_s[before]) + 0.5, float(lane_map.length[before]))
        entered = lane != before and trace.s[t, ego] < 5  # not a lane change
        front = trace.s[t, ego] + (float(lane_map.length[before]) if entered else 0)
        onto = lane if entered else lane_map.routes.next_lane[lane, egos.goal[0]]
        shows = np.asarray(lane_states(lane_map.signals, trace.phase[t]))
        crossed += bool(trace.s[t - 1, ego] <= line < front and shows[onto] == SignalState.RED)
    assert metrics["red_lights"] == crossed
    if policy == "like_traffic":
        assert crossed == 0


@pytest.mark.parametrize("policy, seed", cases())
def test_headway_to_the_leader_on_the_lane(policy, seed):
    """At least as short as to the nearest on the same lane, found by a loop."""
    _, _, trace, ego, _, metrics, _ = replayed(policy, seed)
    least = np.inf
    until = metrics["contact_time"] - 0.5 if metrics["contacts"] else np.inf
    for t in range(5, len(trace.time)):
        lane = trace.lane[t, ego]
        if not trace.active[t, ego] or lane == NO_LANE or trace.time[t] > until or trace.d[t, ego] != 0:
            continue
        ahead = trace.active[t] & (trace.lane[t] == lane) & (trace.s[t] > trace.s[t, ego])
        ahead &= trace.lane[t] == trace.lane[t - 5]  # since the last decision at least
        if ahead.any() and trace.v[t, ego] > 0.5:
            gap = (trace.s[t] - trace.box[t, :, 3])[ahead].min() - trace.s[t, ego]
            least = min(least, gap / trace.v[t, ego])
    if np.isfinite(least):
        assert metrics["min_thw"] <= least * 1.02 + 0.02


@pytest.mark.parametrize("policy, seed", cases())
def test_traffic_as_the_trace_has_it(policy, seed):
    _, _, trace, _, _, metrics, _ = replayed(policy, seed)
    time = trace.active.sum() * 0.1
    distance = (trace.v * trace.active).sum() * 0.1
    assert metrics["traffic_mean_speed"] == pytest.approx(distance / time, rel=0.01)
    assert metrics["traffic_vehicle_km"] == pytest.approx(distance / 1000, rel=0.01)
    assert metrics["traffic_trips"] == metrics["traffic_left"]
    queue = [(trace.active[t] & (trace.v[t] < 5 / 3.6)).sum() for t in range(len(trace.time))]
    assert metrics["traffic_max_queue"] == max(queue)
    assert metrics["traffic_mean_queue"] == pytest.approx(np.mean(queue), abs=0.05)


def test_a_batch_says_the_same_as_worlds_alone():
    outcome = episodes("constant_speed").run([5, 0, 3])
    for i, seed in enumerate((5, 0, 3)):
        alone = replayed("constant_speed", seed).metrics
        for name, value in alone.items():
            # jerk is a difference of small numbers: programs that keep the trace may round otherwise
            np.testing.assert_allclose(outcome.metrics[name][i], value, rtol=2e-3, atol=1e-3, err_msg=name)
    again = episodes("constant_speed").run([3])
    assert again.digest[0] == outcome.digest[2] != outcome.digest[1]
    assert outcome.seeds.tolist() == [5, 0, 3]
    with pytest.raises(ValueError, match="5 seeds at once; at most 4"):
        episodes("constant_speed").run(range(5))


# --- from numbers to rows ----------------------------------------------------------------------------


def rows(**columns):
    """Two worlds in which nothing is measured but what is told."""
    names = (
        "contact_time contact_delta_v contact_other contact_responsibility off_road_time off_road "
        "red_light_time red_lights near_miss_time near_miss_ttc near_miss_other max_drac_time max_drac "
        "max_drac_other rss_first_time policy_failed policy_failed_time "
        "worst_second_time worst_second"
    ).split()
    nothing = {name: np.array([np.nan, np.nan]) for name in names}
    return nothing | {name: np.array(values, float) for name, values in columns.items()}


def test_key_moments_are_ranked():
    nan = np.nan
    found = key_moments(
        np.array([7, 9]),
        np.array([0, 0], np.int32),
        rows(
            contact_time=[nan, 12.0], contact_delta_v=[nan, 6.5], contact_other=[nan, 4],
            contact_responsibility=[nan, 1], near_miss_time=[3.0, 11.9], near_miss_ttc=[1.2, 0.0],
            max_drac_time=[5.0, 4.0], max_drac=[3.3, 4.4], max_drac_other=[2, 3], near_miss_other=[6, 4],
            rss_first_time=[2.0, nan],
            off_road_time=[nan, 13.0], off_road=[0, 0.1],
            worst_second_time=[8.0, 9.0], worst_second=[50.0, 49.5],
            policy_failed=[1.0, 0.0], policy_failed_time=[9.5, nan],
        ),
        {9: "of another episode"},
    )  # fmt: skip
    table = list(zip(*(found[name].tolist() for name in ("seed", "rank", "kind", "time")), strict=True))
    assert table == [
        (7, 1, "policy_failed", 9.5),
        (7, 2, "near_miss", 3.0),  # 3.3 m/s^2 is not hard
        (7, 3, "unsafe", 2.0),
        (9, 1, "contact", 12.0),
        (9, 2, "off_road", 13.0),
        (9, 3, "hard_brake", 4.0),  # the near miss is that contact
        (9, 4, "score_drop", 9.0),
    ]
    assert found["responsible"].tolist() == [None, None, None, "ego", None, None, None]
    assert found["other"].tolist()[1] == 6 and found["other"].tolist()[5] == 3
    assert found["other"].tolist()[3] == 4 and found["value"].tolist()[3] == 6.5
    assert found["reason"].tolist() == ["a command that is not finite", *[None] * 6]


@pytest.mark.parametrize("dt", [0.25, 0.3, 0.5])
def test_every_time_step_that_a_file_may_name_is_measured(dt):
    """Metrics of a drive at constant speed; no engine is compiled."""
    metrics = EgoMetrics(dt)
    r = {name: x[:: round(dt / 0.1)][:14] if np.ndim(x) else x for name, x in free(61).items()}
    r["t"] = np.arange(len(r["v"])) * dt
    r["moved"] = np.full(len(r["v"]), 10.0 * dt)
    steps = as_steps(r)

    @jax.jit
    def run(steps):
        carry = metrics.init(1, steps.zones.id.shape[1])
        carry = jax.lax.scan(lambda carry, step: (metrics.update(carry, step), None), carry, steps)[0]
        return metrics.result(carry)

    found = on_host(jax.device_get(run(steps)))
    assert found["duration"] == pytest.approx((len(r["v"]) - 1) * dt, rel=1e-5)
    assert found["mean_speed"] == pytest.approx(10.0, rel=1e-5)
    assert found["max_jerk"] == found["max_yaw_rate"] == pytest.approx(0.0, abs=1e-4)
    assert found["comfortable"] == 1.0 and found["limsim_corrected_total"] is not None


def test_success_is_what_the_file_says():
    metrics = {"arrived": np.array([1.0, 1, 0, 1]), "completion_time": np.array([20.0, 31, np.nan, 30])}
    good = succeeds(metrics, {"arrived": True, "completion_time": Bounds(max=30)})
    assert good.tolist() == [1, 0, 0, 1]
    assert succeeds(metrics, {"completion_time": Bounds(min=21)}).tolist() == [0, 1, 0, 1]


def test_worlds_from_arrays_run_by_the_same_program():
    """The numbers of a seed make its world; numbers that differ make another one."""
    one = episodes("constant_speed")
    values = one.numbers(SEEDS)
    changed = np.concatenate([values, values[:1]])
    changed[3, np.flatnonzero(one.layout.kinds == "normal")] = 0.5
    given = one.from_numbers(lambda seeds: (changed[seeds], seeds.astype(np.int32)))
    found, plain = given.run(range(4)), one.run(SEEDS)
    for name in ("contacts", "duration", "distance", "min_ttc", "min_distance"):
        np.testing.assert_allclose(found.metrics[name][:3], plain.metrics[name], rtol=1e-3, err_msg=name)
    assert any(x[3] != x[0] for x in found.metrics.values())
    assert given.worlds._drive_name == one.worlds._drive_name is not None, "the program of the sweep"
    assert given.worlds._look_name == one.worlds._look_name is not None
    replay = given.replay(3, explain=False)
    assert replay.metrics["distance"] == found.metrics["distance"][3]


def test_an_estimate_of_an_event_in_real_worlds():
    one = episodes("constant_speed")
    found = estimate(one, "contact", None, method="crude", worlds=200)
    plain = one.run(range(4)).metrics
    assert 0 < found.probability.low < found.probability.estimate < 1
    assert found.km * 1e3 == pytest.approx(plain["distance"].mean(), rel=0.3)
    assert all(failure.metrics["contacts"] > 0 for failure in found.failures)
    again = found.episodes.run(range(2)).metrics
    assert [x.metrics["contact_time"] for x in found.failures[:2]] == again["contact_time"].tolist()
