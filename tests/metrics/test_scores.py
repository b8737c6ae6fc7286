"""Scores on worked examples, and the streams against loops over the whole record."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import savgol_filter

from limsim_jax.metrics.motion import motion_flush, motion_init, motion_update
from limsim_jax.metrics.scores import (
    LimSimStep,
    NuPlanEpisode,
    against_flow_init,
    against_flow_update,
    carla_score,
    limsim_comfort,
    limsim_corrected,
    limsim_efficiency,
    limsim_faithful,
    limsim_init,
    limsim_piecewise,
    limsim_score,
    limsim_update,
    nuplan_score,
    nuplan_ttc,
)

DT = 0.1


def f(x):
    return jnp.asarray(x, jnp.float32)


def flag(x):
    return jnp.asarray(x, bool)


# --- nuPlan ------------------------------------------------------------------------------------------

PERFECT = {
    "at_fault": 0,
    "off_road": flag(False),
    "against_flow": f(0.0),
    "progress": f(120.0),
    "reference_progress": f(120.0),
    "ttc_within_bound": flag(True),
    "overspeed": f(0.0),
    "duration": f(15.0),
    "comfortable": flag(True),
}


@pytest.mark.parametrize(
    ("changes", "score"),
    [
        ({}, 1.0),
        ({"at_fault": 1}, 0.0),
        ({"at_fault_vru": 1}, 0.0),
        ({"at_fault_object": 1}, 0.5),
        ({"at_fault_object": 2}, 0.0),
        ({"off_road": flag(True)}, 0.0),
        ({"against_flow": f(1.99)}, 1.0),
        ({"against_flow": f(2.0)}, 0.5),
        ({"against_flow": f(5.99)}, 0.5),
        ({"against_flow": f(6.0)}, 0.0),
        ({"ttc_within_bound": flag(False)}, 11 / 16),
        ({"comfortable": flag(False)}, 14 / 16),
        ({"overspeed": f(2.23 * 15 / 4)}, 15 / 16),  # a quarter of 2.23 m/s on average
        ({"overspeed": f(2.23 * 15 * 2)}, 12 / 16),
        ({"progress": f(60.0)}, (5 * 0.5 + 11) / 16),
        ({"progress": f(150.0)}, 1.0),
        ({"progress": f(24.0)}, 0.0),  # a fifth is no progress
        ({"progress": f(25.2)}, (5 * 0.21 + 11) / 16),
        ({"progress": f(0.0), "reference_progress": f(1.5)}, 1.0),  # waits as the reference does
        ({"progress": f(-1.9), "reference_progress": f(1.5)}, 1.0),
        ({"progress": f(-2.1), "reference_progress": f(1.5)}, 0.0),  # drives back
        ({"against_flow": f(3.0), "at_fault_object": 1, "comfortable": flag(False)}, 0.25 * 14 / 16),
    ],
)
def test_nuplan_score(changes, score):
    assert float(nuplan_score(NuPlanEpisode(**(PERFECT | changes))).score) == pytest.approx(score, rel=1e-5)


def test_nuplan_parts():
    found = nuplan_score(NuPlanEpisode(**(PERFECT | {"progress": f(60.0), "against_flow": f(3.0)})))
    assert found._asdict() == pytest.approx(
        {
            "score": 0.5 * 13.5 / 16,
            "no_at_fault_collisions": 1,
            "drivable_area": 1,
            "driving_direction": 0.5,
            "making_progress": 1,
            "progress": 0.5,
            "ttc": 1,
            "speed_limit": 1,
            "comfort": 1,
        }
    )


def test_nuplan_sees_contacts_on_its_grid_of_times():
    begin = np.array([-5.0, 0.0, 0.04, 0.89, 0.9, 0.91, 0.95, 2.0, 0.31, 0.31, 0.2, -9.0, 5.0])
    cease = np.array([9.0, 0.05, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0, 0.39, 0.41, 0.2, -1.0, 1.0])
    expected = []
    for first, last in zip(begin, cease, strict=True):
        times = np.arange(0.1, 3.0, 0.1)
        touching = times[(first - 1e-9 <= times) & (times <= last + 1e-9)]
        expected.append(not (touching.size and touching[0] <= 0.95))
    found = np.asarray(nuplan_ttc(f(begin), f(cease), jnp.ones(begin.size, bool)))
    np.testing.assert_array_equal(found, expected)
    assert sorted(set(expected)) == [False, True]
    assert bool(nuplan_ttc(f(begin), f(cease), jnp.zeros(begin.size, bool)).all())


def test_against_flow_is_the_worst_net_loss_within_a_second():
    ds = np.array([1.0, -0.5, -0.5, -0.5, 0.2] + [0.0] * 8 + [-0.4] * 15 + [2.0] * 3)

    def step(carry, x):
        return against_flow_update(carry, x)

    _, found = jax.lax.scan(step, against_flow_init(11), f(ds))
    expected = [max(-ds[max(0, i - 10) : i + 1].sum(), 0) for i in range(ds.size)]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert max(expected) == pytest.approx(4.4)  # eleven steps of 0.4 m


# --- CARLA -------------------------------------------------------------------------------------------


def test_carla_score_by_hand():
    perfect = carla_score(f(1.0), {})
    assert (float(perfect.score), float(perfect.penalty)) == (100.0, 1.0)
    found = carla_score(f(0.8), {"vehicles": jnp.asarray(1, jnp.int32), "red_lights": 2})
    assert float(found.penalty) == pytest.approx(0.6 * 0.49)
    assert float(found.score) == pytest.approx(80 * 0.6 * 0.49)
    each = {
        "pedestrians": 0.5,
        "static": 0.65,
        "stop_signs": 0.8,
        "scenario_timeouts": 0.7,
        "emergency_vehicles": 0.7,
    }
    for name, penalty in each.items():
        assert float(carla_score(f(1.0), {name: 1}).penalty) == pytest.approx(penalty)
    # a tenth of the way outside does not count; half the speed of the traffic costs 15 %
    found = carla_score(f(1.0), {}, outside=f(0.1), speed_ratio=f(0.5))
    assert float(found.penalty) == pytest.approx(0.9 * 0.85)
    assert float(carla_score(f(1.0), {}, speed_ratio=f(1.7)).penalty) == 1.0
    with pytest.raises(ValueError, match="unknown infraction 'cars'; there are pedestrians, vehicles"):
        carla_score(f(1.0), {"cars": 1})


# --- LimSim++ ----------------------------------------------------------------------------------------


def test_limsim_pieces_by_hand():
    bounds = (0.9, 1.47, 3.07)
    x = f([0.0, 0.9, 1.185, 1.47, -1.47, 2.27, 3.07, 9.0])
    np.testing.assert_allclose(limsim_piecewise(x, bounds), [1, 1, 0.8, 0.6, 0.6, 0.3, 0, 0], atol=1e-6)
    v, others = f([10, 10, 10, 0, 20, 10]), f([12.5, 12.5, 30, 0.05, 5, 0])
    there = flag([True, False, True, True, True, False])
    found = limsim_efficiency(v, others, there, f([20.0] * 6))
    np.testing.assert_allclose(found, [0.8, 0.5, 0.5, 1.0, 1.0, 0.5], rtol=1e-6)


def test_limsim_score_by_hand():
    found = limsim_score(
        comfort=f(0.8), efficiency=f(0.6), safety=f(0.9), reds=1, speeding=f(0.2), failed=flag(True),
        completion=f(0.5),
    )  # fmt: skip
    drive = 100 * (0.2 + 0.15 + 0.45) * 0.7 * 0.81 * 0.6
    assert float(found.drive) == pytest.approx(drive, rel=1e-5)
    assert float(found.total) == pytest.approx(drive / 2, rel=1e-5)


def pieces(x, bounds):
    return np.interp(np.abs(x), bounds, (1, 0.6, 0))


def comfort(a, lateral, jerk, lateral_jerk):
    ahead, braking = pieces(a, (0.9, 1.47, 3.07)), pieces(a, (0.9, 2, 5.08))
    jerks = pieces(jerk, (0.6, 0.9, 2)), pieces(lateral_jerk, (0.6, 0.9, 2))
    return np.where(np.asarray(a) > 0, ahead, braking), pieces(lateral, (0.9, 4, 5.6)), *jerks


def drive(*args, **kwargs):
    """Both scores of a record, see `judged`."""
    return judged(*args, **kwargs)[:2]


def judged(record, success=True, completion=1.0, failed=False):
    """Both scores of a record, and its worst second; arrays have a value per step, the start first."""
    names = ("v", "v_others", "others", "limit", "ttc", "red_light", "in_junction", "waits_at_red")

    def step(carry, x):
        motion, limsim = carry
        t, heading, a, values = x
        motion, filtered = motion_update(DT, motion, t=t, v=values["v"], a=a, heading=heading)
        limsim = limsim_update(DT, limsim, filtered, LimSimStep(t=t, a=a, lateral=motion.lateral, **values))
        return (motion, limsim), None

    @jax.jit
    def run(t, heading, a, values):
        (motion, limsim), _ = jax.lax.scan(step, (motion_init(DT), limsim_init()), (t, heading, a, values))
        _, rest = motion_flush(DT, motion)
        ends = {"completion": f(completion)}
        return (
            limsim_faithful(limsim, success=flag(success), **ends),
            limsim_corrected(limsim, rest, failed=flag(failed), **ends),
            limsim.worst,
        )

    n = len(record["v"])
    values = {k: (flag if record[k].dtype == bool else f)(record[k]) for k in names}
    return run(f(np.arange(n) * DT), f(record["heading"]), f(record["a"]), values)


def record(n, seed=None):
    """A steady drive, or a random one."""
    rng = np.random.default_rng(seed)
    steady = {
        "v": np.full(n, 12.0), "a": np.zeros(n), "heading": np.zeros(n), "v_others": np.full(n, 15.0),
        "others": np.ones(n, bool), "limit": np.full(n, 13.9), "ttc": np.full(n, 1e6),
        "red_light": np.zeros(n, bool), "in_junction": np.zeros(n, bool), "waits_at_red": np.zeros(n, bool),
    }  # fmt: skip
    if seed is not None:
        steady |= {
            "v": rng.uniform(8, 14.2, n), "a": rng.normal(size=n) * 1.5 + 4 * np.sin(np.arange(n) / 9 + seed),
            "heading": np.cumsum(rng.normal(size=n)) * 0.02, "v_others": rng.uniform(5, 16, n),
            "others": rng.random(n) < 0.5, "ttc": rng.uniform(0.5, 20, n), "red_light": rng.random(n) < 0.2,
            "in_junction": rng.random(n) < 0.4, "waits_at_red": rng.random(n) < 0.2,
        }  # fmt: skip
    return steady


def test_limsim_comfort_by_its_bounds():
    a, b, c, d = np.random.default_rng(1).uniform(-1, 1, (4, 500)) * np.array([[6.0], [6.0], [2.2], [2.2]])
    np.testing.assert_allclose(limsim_comfort(f(a), f(b), f(c), f(d)), comfort(a, b, c, d), atol=1e-5)


@pytest.mark.parametrize("seed", [0, 1])
def test_limsim_streams_are_loops_over_the_record(seed):
    n = 64  # the start, six seconds, and three steps that do not count
    r = record(n, seed)
    r["a"][0] = r["a"][10] - 0.7  # the jerk of the first second is one that costs something, not all
    faithful, corrected, worst = judged(r, success=False, completion=0.7, failed=True)
    lateral = np.concatenate([[0.0], r["v"][1:] * np.diff(r["heading"]) / DT])
    c, e, ec, s, speeding, reds = [], [], [], [], [], 0
    for k in range(6):
        w = slice(1 + 10 * k, 11 + 10 * k)
        end, before = 10 + 10 * k, 10 * k
        jerks = r["a"][end] - r["a"][before], lateral[end] - lateral[before]
        c.append(np.mean(comfort(r["a"][w].mean(), lateral[w].mean(), *jerks)))
        around = r["others"][w]
        others = r["v_others"][w][around].mean() if around.any() else np.inf
        e.append(min(1, r["v"][w].mean() / min(others, r["limit"][end])))
        ec.append(1.0 if r["waits_at_red"][end] else e[-1])
        s.append(min(r["ttc"][w].min() / 5, 1))
        speeding.append(r["v"][w].max() > r["limit"][end])
        reds += r["red_light"][w].any() and r["in_junction"][end]
    assert 0 < reds < r["red_light"][1:61].sum()
    seconds = 100 * (0.25 * np.array(c) + 0.25 * np.array(ec) + 0.5 * np.array(s))
    assert float(worst.value) == pytest.approx(seconds.min(), rel=1e-4)
    assert float(worst.time) == pytest.approx(1 + np.argmin(seconds), abs=1e-4)
    parts = 0.25 * np.mean(c) + 0.25 * np.mean(e) + 0.5 * np.mean(s)
    expected = 100 * parts * 0.7**reds * 0.9 ** (10 * np.mean(speeding)) * 0.6
    assert float(faithful.drive) == pytest.approx(expected, rel=1e-4)
    assert float(faithful.total) == pytest.approx(0.7 * expected, rel=1e-4)

    a, b = savgol_filter(r["a"][1:], 8, 2), savgol_filter(lateral[1:], 8, 2)
    jerks = (savgol_filter(x, 15, 2, deriv=1, delta=DT) for x in (a, b))
    c = np.mean([x.mean() for x in comfort(a, b, *jerks)])
    speeding = np.mean(r["v"][1:] > r["limit"][1:])
    expected = 100 * (0.25 * c + 0.25 * np.mean(ec) + 0.5 * np.mean(s)) * 0.7 ** r["red_light"].sum()
    expected *= 0.9 ** (10 * speeding) * 0.6
    assert float(corrected.comfort) == pytest.approx(c, abs=1e-3)
    assert float(corrected.drive) == pytest.approx(expected, rel=2e-3)


@pytest.mark.engine
def test_what_the_corrected_version_corrects():
    n = 61
    steady = record(n)
    assert [float(x.drive) for x in drive(steady)] == pytest.approx([100 * (0.75 + 0.25 * 12 / 13.9)] * 2)
    # oscillation: +-2.5 m/s^2 within every second has a mean of nothing
    t = np.arange(n) * DT
    shaken = steady | {"a": 2.5 * np.sin(2 * np.pi * t)}
    faithful, corrected = drive(shaken)
    assert float(faithful.comfort) == pytest.approx(1.0, abs=1e-4)
    assert float(corrected.comfort) < 0.9
    # waiting at a red light while others pass
    waiting = steady | {"v": np.zeros(n), "waits_at_red": np.ones(n, bool)}
    faithful, corrected = drive(waiting)
    assert (float(faithful.efficiency), float(corrected.efficiency)) == (0.0, 1.0)
    # a red light crossed, and the junction left, between two full seconds
    red, junction = np.zeros(n, bool), np.zeros(n, bool)
    red[13], junction[13:19] = True, True
    faithful, corrected = drive(steady | {"red_light": red, "in_junction": junction})
    assert (float(faithful.red_lights), float(corrected.red_lights)) == pytest.approx((1.0, 0.7))
    junction[13:22] = True
    faithful, _ = drive(steady | {"red_light": red, "in_junction": junction})
    assert float(faithful.red_lights) == pytest.approx(0.7)
    # one step above the limit: a tenth of a second, or a whole one
    fast = steady | {"v": np.where(np.arange(n) == 25, 14.0, 12.0)}
    faithful, corrected = drive(fast)
    assert float(faithful.speeding) == pytest.approx(0.9 ** (10 / 6))
    assert float(corrected.speeding) == pytest.approx(0.9 ** (10 / 60))
    # at the limit, but for rounding
    for excess, counts in (0.005, False), (0.015, True):
        at_limit = drive(steady | {"v": steady["limit"] + excess})
        assert [float(x.speeding) for x in at_limit] == pytest.approx([0.9 ** (10 * counts)] * 2)
    # an ego that arrives has completed the route, whatever is left of it
    faithful, _ = drive(steady, completion=0.98)
    assert float(faithful.total) == pytest.approx(float(faithful.drive))
    # standing still until the time is over
    faithful, corrected = drive(steady, success=False, completion=0.5)
    assert (float(faithful.failure), float(corrected.failure)) == pytest.approx((0.6, 1.0))


@pytest.mark.engine
def test_without_a_full_second_there_is_no_limsim_score():
    assert [bool(x.valid) for x in drive(record(10))] == [False, False]
    assert [bool(x.valid) for x in drive(record(15))] == [True, True]
