"""Flow metrics against loops over the record and streams of vehicles with known answers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from limsim_jax.metrics.reductions import on_host
from limsim_jax.metrics.traffic import HEADWAY_BIN, HEADWAY_BINS, Detectors, TrafficMetrics, TrafficStep

DT = 0.1
LANES = (100.0, 150.0, 200.0)  # m; driven one after the other
TOTAL = sum(LANES)


def record(start, v, steps, *, v_free=20.0, inside=None, changed=None):
    """Vehicles that start `start` m along the way at speeds `v` (a number or `[T, N]`); first the start."""
    start = np.asarray(start, float)
    n = start.size
    speeds = np.broadcast_to(np.asarray(v, float), (steps, n))
    way = start + np.concatenate([np.zeros((1, n)), np.cumsum(speeds[1:] * DT, 0)])
    ends = np.cumsum(LANES)
    lane = np.searchsorted(ends, way)
    before = np.concatenate([way[:1], way[:-1]])
    there = way <= ends[-1]
    left = ~there & (before <= ends[-1])
    s = way - np.concatenate([[0], ends])[lane]
    # slots of vehicles that have left hold harmless numbers, as in the engine
    return {
        "t": np.arange(steps) * DT,
        "active": there,
        "lane": np.where(there, lane, -1),
        "s": np.where(there, s, 77.0),
        "dx": np.where(there | left, way - before, 0.0),
        "v": np.where(there, speeds, 0.0),
        "v_free": np.full((steps, n), v_free),
        "inside": np.ones((steps, n), bool) if inside is None else inside,
        "changed": np.zeros((steps, n), bool) if changed is None else changed,
        "left": left,
        "entered": np.zeros((steps, n)),
    }


def run(record, detectors=((0, 50.0),), length=TOTAL, **options):
    metrics = TrafficMetrics(DT, **options)
    places = Detectors(
        jnp.asarray([lane for lane, _ in detectors], jnp.int32),
        jnp.asarray([s for _, s in detectors], jnp.float32),
    )
    dtypes = {"lane": jnp.int32} | dict.fromkeys(("active", "inside", "changed", "left"), bool)
    steps = TrafficStep(**{k: jnp.asarray(x, dtypes.get(k, jnp.float32)) for k, x in record.items()})
    n = record["s"].shape[1]

    @jax.jit
    def go(steps):
        carry = metrics.init(n, len(detectors))
        carry, _ = jax.lax.scan(lambda c, x: (metrics.update(c, places, x), None), carry, steps)
        return metrics.result(carry, length), metrics.detector_result(carry)

    return tuple(on_host(x) for x in go(steps))


def test_edie_by_hand():
    """Three vehicles at 10, 10 and 20 m/s on 450 m for 10 s."""
    found, _ = run(record([0, 50, 100], [10, 10, 20], 101))
    assert found["vehicle_km"] == pytest.approx(0.4, rel=1e-4)
    assert found["mean_speed"] == pytest.approx(400 / 30, rel=1e-4)
    assert found["density_per_km"] == pytest.approx(30 / (450 * 10) * 1000, rel=1e-4)
    assert found["flow_per_hour"] == pytest.approx(400 / (450 * 10) * 3600, rel=1e-4)
    assert found["flow_per_hour"] == pytest.approx(
        3.6 * found["density_per_km"] * found["mean_speed"], rel=1e-5
    )
    # at a free speed of 20 m/s, 10 m/s loses half of the time
    assert found["delay_share"] == pytest.approx((5 + 5 + 0) / 30, rel=1e-3)
    assert found["delay_per_km"] == pytest.approx(10 / 0.4, rel=1e-3)


def test_the_clock_need_not_start_at_0():
    r = record([0, 50, 100], [10, 10, 20], 101)
    expected = run(r, interval=4.0, intervals=3)
    r["t"] += 7.0
    r["entered"] += 7.0
    for one, other in zip(expected, run(r, interval=4.0, intervals=3), strict=True):
        for name, value in one.items():
            np.testing.assert_allclose(np.array(value, float), np.array(other[name], float), rtol=1e-4)


def test_only_the_region_and_active_slots_count():
    r = record([0, 50, 100], [10, 10, 20], 101)
    r["active"] = r["active"] & np.array([True, True, False])
    r["inside"] = np.arange(101)[:, None] * np.ones((1, 3)) <= np.array([50, 100, 100])
    r["v"][:, 2] = np.nan
    found, _ = run(r)
    assert found["vehicle_km"] == pytest.approx(0.15, rel=1e-4)
    assert found["density_per_km"] == pytest.approx(15 / (450 * 10) * 1000, rel=1e-4)


def test_queues_lane_changes_and_trips():
    v = np.full((101, 4), 10.0)
    v[20:51, :2] = 1.0  # two stand in a queue for 3.1 s
    changed = np.zeros((101, 4), bool)
    changed[30, 1] = changed[60, 3] = True
    r = record([0, 30, 60, 380], v, 101, changed=changed)
    r["entered"][:, 3] = -5.0  # had entered 5 s before the start
    found, _ = run(r)
    assert found["max_queue"] == 2.0
    assert found["mean_queue"] == pytest.approx(2 * 31 / 100, rel=1e-4)
    # the fourth leaves after 70 m: 7.1 s, and its change of lanes was before that
    assert found["trips"] == 1.0
    assert found["mean_travel_time"] == pytest.approx(12.1, abs=0.11)
    assert found["sd_travel_time"] == pytest.approx(0.0, abs=0.02)
    assert found["lane_changes_per_km"] == pytest.approx(2 / found["vehicle_km"], rel=1e-4)


def test_travel_times_have_a_mean_and_a_spread():
    r = record([400, 420, 440], 10.0, 101)
    found, _ = run(r)
    times = np.array([5.1, 3.1, 1.1])
    assert found["trips"] == 3.0
    assert found["mean_travel_time"] == pytest.approx(times.mean(), abs=0.07)
    assert found["sd_travel_time"] == pytest.approx(times.std(), abs=0.02)


def test_detectors_count_as_a_loop_over_the_record():
    rng = np.random.default_rng(0)
    n, steps = 12, 300
    start = np.sort(rng.uniform(0, 300, n))
    v = np.repeat(rng.uniform(2, 14, (steps // 20, n)), 20, 0)
    r = record(start, v, steps)
    places = [(0, 99.99), (1, 0.01), (1, 75.0), (2, 0.0), (2, 199.9)]
    _, by = run(r, places, interval=10.0, intervals=3)
    way = start + np.concatenate([np.zeros((1, n)), np.cumsum(v[1:] * DT, 0)])
    counts, slowness = np.zeros((5, 3)), np.zeros((5, 3))
    for d, (lane, s) in enumerate(places):
        at = np.concatenate([[0], np.cumsum(LANES)])[lane] + s
        for i in range(1, steps):
            passed = (way[i - 1] < at) & (at <= way[i])
            k = min(int((i * DT - 1e-6) / 10), 2)
            counts[d, k] += passed.sum()
            slowness[d, k] += np.sum(1 / v[i][passed])
    assert counts.sum() > 25 and (counts.sum(1) > 0).all()
    duration = np.array([10.0, 10.0, 9.9])
    np.testing.assert_allclose(by["flow_per_hour"], 3600 * counts / duration, rtol=1e-4)
    some = counts > 0
    harmonic = np.divide(counts, slowness, where=some, out=np.full_like(counts, np.nan))
    np.testing.assert_allclose(by["harmonic_speed"], harmonic, rtol=1e-3)
    np.testing.assert_allclose(
        by["density_per_km"][some], (1000 * counts / duration / harmonic)[some], rtol=1e-3
    )
    assert np.isnan(by["mean_speed"][~some]).all()


def test_intervals_that_are_not_over_or_have_not_begun():
    _, by = run(record([0.0, -75.0], 10.0, 151), [(0, 50.0)], interval=10.0, intervals=4)  # 15 s
    np.testing.assert_allclose(by["flow_per_hour"][0], [360.0, 720.0, np.nan, np.nan], rtol=1e-4)


def test_headways_and_saturation_flow():
    """A queue that discharges: 3.1 s, 2.6 s, 2.4 s, 2.3 s, then every 2.1 s; a break; another queue."""
    gaps = [3.13, 2.64, 2.41, 2.27, 2.13, 2.13, 2.13]
    first = np.concatenate([[0], np.cumsum(gaps)])
    times = 1.03 + np.concatenate([first, first[-1] + 12.0 + first[:4]])
    _, by = run(record(50 - 10 * times, 10.0, 500), [(0, 50.0)])
    headways = np.diff(times)
    expected, _ = np.histogram(headways, HEADWAY_BIN * np.append(np.arange(HEADWAY_BINS), 1e9))
    np.testing.assert_allclose(by["headway_histogram"][0], expected / headways.size, atol=1e-6)
    # of the first queue the fifth to the eighth count: 2.27 s and three of 2.13 s; the second is too short
    assert by["saturation_flow_per_hour"][0] == pytest.approx(
        3600 / np.mean([2.27, 2.13, 2.13, 2.13]), rel=1e-3
    )
    assert by["flow_per_hour"][0, 0] == pytest.approx(3600 * 12 / 49.9, rel=1e-4)


@pytest.mark.engine
def test_who_stops_at_a_detector_has_passed_it_once():
    _, by = run(record([40.0], 10.0, 40), [(0, 50.0)])  # a metre per step: it is there after ten
    assert by["flow_per_hour"][0, 0] == pytest.approx(3600 / 3.9, rel=1e-5)


def test_the_start_itself_is_no_passage():
    r = record([50.0], 10.0, 40)
    r["dx"][0] = 1.0  # whatever it did before
    found, by = run(r, [(0, 50.0)])
    assert by["flow_per_hour"][0, 0] == 0.0 and found["vehicle_km"] == pytest.approx(0.039, rel=1e-4)


@pytest.mark.engine
def test_short_records_and_short_headways():
    """Not a second, and vehicles 0.3 and 0.7 s apart, side by side as on a wide lane."""
    found, by = run(record([49.0, 46.0, 39.0], 10.0, 13), [(0, 50.0)])
    assert by["flow_per_hour"][0, 0] == pytest.approx(3 * 3600 / 1.2, rel=1e-4)
    assert by["headway_histogram"][0, :3].tolist() == [0.5, 0.5, 0.0]  # bins of half a second
    found, by = run(record([49.0, 46.0], 10.0, 9), [(0, 50.0)])
    assert by["flow_per_hour"][0, 0] == pytest.approx(2 * 3600 / 0.8, rel=1e-4)
    assert found["flow_per_hour"] == pytest.approx(3600 * 16 / (0.8 * TOTAL), rel=1e-4)
    assert by["headway_histogram"][0, 0] == 1.0  # a single one


def test_a_lane_change_is_no_passage():
    """From lane 0 to lane 1 beside it, level with a detector on both lanes: counted once, on lane 1."""
    steps = 3
    one = {k: np.zeros((steps, 1), bool) for k in ("changed", "left")}
    r = one | {
        "t": np.arange(steps) * DT, "active": np.ones((steps, 1), bool), "inside": np.ones((steps, 1), bool),
        "lane": np.array([[0], [1], [1]]), "s": np.array([[49.5], [50.5], [51.5]]), "dx": np.ones((steps, 1)),
        "v": np.full((steps, 1), 10.0), "v_free": np.full((steps, 1), 20.0), "entered": np.zeros((steps, 1)),
    }  # fmt: skip
    _, by = run(r, [(0, 50.0), (1, 50.0), (1, 60.0)])
    np.testing.assert_allclose(by["flow_per_hour"][:, 0] * 0.2 / 3600, [0, 1, 0], atol=1e-5)


def test_who_appears_has_passed_nothing():
    r = record([0.0], 10.0, 60)
    r["active"][:50] = False  # appears at 50 m, with the metre before already driven
    _, by = run(r, [(0, 50.0)])
    assert by["flow_per_hour"][0, 0] == 0.0


def test_slots_and_worlds_do_not_matter():
    rng = np.random.default_rng(1)
    n, steps = 10, 200
    v = np.repeat(rng.uniform(1, 14, (steps // 20, n)), 20, 0)
    r = record(rng.uniform(0, 400, n), v, steps, changed=rng.random((steps, n)) < 0.01)
    places = [(0, 60.0), (1, 100.0)]
    expected = run(r, places)
    order = rng.permutation(n)
    shuffled = {k: x if x.ndim == 1 else x[:, order] for k, x in r.items()}
    for one, other in zip(expected, run(shuffled, places), strict=True):
        for name in one:
            np.testing.assert_allclose(one[name], other[name], rtol=1e-5, atol=1e-6)


def test_nothing_measured_is_none():
    found, by = run(record([440.0], 10.0, 1))
    assert found["mean_speed"] is found["flow_per_hour"] is found["mean_travel_time"] is None
    assert found["trips"] == 0.0
    assert np.isnan(by["saturation_flow_per_hour"][0]) and np.isnan(by["flow_per_hour"][0, 0])
