"""Comfort metrics against SciPy on the whole record, and episodes with known answers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from limsim_jax.metrics.motion import (
    filter_init,
    filter_result,
    filter_update,
    filters,
    motion_init,
    motion_result,
    motion_update,
    stream,
)
from limsim_jax.metrics.reductions import on_host
from limsim_jax.standards import COMFORT

DT = 0.1


def savgol(x, window, order, **options) -> np.ndarray:
    return np.asarray(signal.savgol_filter(x, window, order, **options))


def whole_record(v, a, heading):
    """nuPlan's quantities by SciPy: the second sample is the first with an acceleration."""
    turn = np.diff(np.unwrap(heading))
    along, across = a[1:], v[1:] * turn / DT
    smooth = {
        "acceleration": savgol(along, 8, 2),
        "lateral_acceleration": savgol(across, 8, 2),
    }
    magnitude = savgol(np.hypot(along, across), 8, 2)
    return smooth | {
        "jerk": savgol(magnitude, 15, 2, deriv=1, delta=DT),
        "longitudinal_jerk": savgol(smooth["acceleration"], 15, 2, deriv=1, delta=DT),
        "yaw_rate": savgol(np.unwrap(heading), 5, 2, deriv=1, delta=DT),
        "yaw_acceleration": savgol(np.unwrap(heading), 5, 3, deriv=2, delta=DT),
    }


@jax.jit
def streamed(v, a, heading):
    def step(carry, x):
        t, v, a, heading = x
        return motion_update(DT, carry, t=t, v=v, a=a, heading=heading)[0], None

    t = jnp.arange(v.shape[0], dtype=v.dtype) * DT
    carry, _ = jax.lax.scan(step, motion_init(DT), (t, v, a, heading))
    return motion_result(DT, carry)[0]


def measure(v, a, heading):
    return on_host(streamed(*(jnp.asarray(x, jnp.float32) for x in (v, a, heading))))


@pytest.mark.parametrize(
    ("n", "dt", "windows"),
    [(n, DT, (8, 15, 5, 5)) for n in (23, 24, 60)] + [(24, 0.5, (3, 3, 3, 4))],  # at least the order and one
)
@pytest.mark.parametrize("name", ["acceleration", "jerk", "yaw_rate", "yaw_acceleration"])
def test_a_stream_gives_what_scipy_gives_on_the_whole_record(name, n, dt, windows):
    kept = getattr(filters(dt), name)
    rng = np.random.default_rng(n)
    x = rng.normal(size=(n, 2)) + 3.0

    def step(carry, row):
        carry, y, new = filter_update(kept, carry, row, jnp.ones((), bool))
        return carry, (y, new)

    carry, (y, new) = jax.lax.scan(step, filter_init(kept, 2), jnp.asarray(x, jnp.float32))
    rest, valid = filter_result(kept, carry)
    found = np.concatenate([np.asarray(y)[np.asarray(new)], np.asarray(rest)[np.asarray(valid)]])
    smooth = savgol(x, windows[0], 2, axis=0)
    expected = {
        "acceleration": smooth,
        "jerk": savgol(smooth, windows[1], 2, deriv=1, delta=dt, axis=0),
        "yaw_rate": savgol(x, windows[2], 2, deriv=1, delta=dt, axis=0),
        "yaw_acceleration": savgol(x, windows[3], 3, deriv=2, delta=dt, axis=0),
    }[name]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dt", [0.05, 0.1, 0.25, 0.5])
@pytest.mark.parametrize("name", ["acceleration", "jerk", "yaw_rate", "yaw_acceleration"])
def test_a_record_shorter_than_a_filter_is_one_polynomial(name, dt):
    kept = getattr(filters(dt), name)
    update = jax.jit(lambda carry, row: filter_update(kept, carry, row, jnp.ones((), bool)))
    rng = np.random.default_rng(3)
    for n in {1, 2, 3, 4, kept.window - 2, kept.window - 1} & set(range(1, kept.window)):
        x = rng.normal(size=(n, 2)) + 3.0
        carry, news = filter_init(kept, 2), []
        for row in jnp.asarray(x, jnp.float32):
            carry, _, new = update(carry, row)
            news.append(bool(new.any()))
        assert not any(news)  # all values are known at the end only
        found, valid = (np.asarray(part) for part in filter_result(kept, carry))
        assert valid.sum() == n
        t = np.arange(n) * dt
        for column in (0, 1):
            fit = np.polynomial.Polynomial.fit(t, x[:, column], min(kept.order, n - 1))
            expected = fit.deriv(kept.derivative)(t) if kept.derivative else fit(t)
            scale = max(1.0, np.abs(expected).max())
            np.testing.assert_allclose(found[valid][:, column] / scale, expected / scale, atol=1e-4)


def test_a_filter_whose_edges_look_further_than_its_middle_is_refused():
    def odd(x):
        y = x.copy()
        y[0] += x[20]
        return y

    with pytest.raises(ValueError, match="edges"):
        stream(odd, 9, 2, 0, DT)


def test_extremes_are_those_of_the_whole_record():
    rng = np.random.default_rng(1)
    n = 80
    a = rng.normal(size=n) * 2 - 0.5  # unequal extremes on both sides
    v = 12 + rng.normal(size=n)
    heading = 3.0 + np.cumsum(rng.normal(size=n) * 0.02 + 0.02)  # across pi
    heading = (heading + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.diff(heading)).max() > 6  # it does wrap
    expected, found = whole_record(v, a, heading), measure(v, a, heading)
    assert found["min_acceleration"] == pytest.approx(expected["acceleration"].min(), abs=1e-4)
    assert found["max_acceleration"] == pytest.approx(expected["acceleration"].max(), abs=1e-4)
    for name in list(COMFORT)[1:]:
        assert found[f"max_{name}"] == pytest.approx(np.abs(expected[name]).max(), rel=2e-4), name
    for name, key in (("acceleration", "acceleration"), ("jerk", "longitudinal_jerk")):
        assert found[f"rms_{name}"] == pytest.approx(np.sqrt(np.mean(expected[key] ** 2)), rel=1e-4)


def test_steady_braking_and_a_circle():
    n = 40
    found = measure(np.linspace(20, 8, n), np.full(n, -3.0), np.zeros(n))
    assert found["min_acceleration"] == pytest.approx(-3.0, abs=1e-4)
    assert found["max_acceleration"] == pytest.approx(-3.0, abs=1e-4)
    assert found["max_longitudinal_jerk"] == pytest.approx(0.0, abs=1e-3)
    assert found["comfortable"] == 1.0
    # radius 25 m at 10 m/s: 4 m/s^2 to the right, 0.4 rad/s
    found = measure(np.full(n, 10.0), np.zeros(n), 2.0 - 0.4 * DT * np.arange(n))
    assert found["max_lateral_acceleration"] == pytest.approx(4.0, abs=1e-3)
    assert found["max_yaw_rate"] == pytest.approx(0.4, abs=1e-4)
    assert found["max_yaw_acceleration"] == pytest.approx(0.0, abs=2e-3)
    assert found["rms_acceleration"] == pytest.approx(0.0, abs=1e-4)
    assert found["comfortable"] == 1.0


def test_a_ramp_of_acceleration_has_its_slope_as_jerk():
    n = 300
    v, a, heading = np.full(n, 10.0), -2.0 * DT * np.arange(n), np.zeros(n)
    found = measure(v, a, heading)
    assert found["rms_jerk"] == pytest.approx(2.0, rel=2e-3)
    # nuPlan's even window shifts the middle against the ends: too high there by an eighth
    assert np.abs(whole_record(v, a, heading)["longitudinal_jerk"]).max() == pytest.approx(2.2528, rel=1e-4)
    assert found["max_longitudinal_jerk"] == pytest.approx(2.2528, rel=1e-3)
    assert found["max_jerk"] == pytest.approx(2.2528, rel=1e-3)
    assert found["min_acceleration"] == pytest.approx(-2.0 * DT * (n - 1), rel=1e-3)


def test_the_acceleration_before_the_start_does_not_count():
    n = 40
    a = np.zeros(n)
    a[0] = -9.0
    assert measure(np.full(n, 10.0), a, np.zeros(n))["min_acceleration"] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(
    ("a", "heading", "comfortable"),
    [(2.39, 0.0, True), (2.41, 0.0, False), (-4.04, 0.0, True), (-4.06, 0.0, False),
     (0.0, 0.94, True), (0.0, -0.96, False)],
)  # fmt: skip
def test_comfort_has_nuplans_bounds(a, heading, comfortable):
    n = 40
    found = measure(np.full(n, 2.0), np.full(n, a), heading * DT * np.arange(n))
    assert found["comfortable"] == float(comfortable)


@pytest.mark.parametrize("n", [2, 3, 9, 22])
def test_a_short_record_has_all_values(n):
    raw = streamed(*(jnp.full(n, x) for x in (10.0, -5.0, 0.0)))
    found = on_host(raw)
    assert all(bool(jnp.isfinite(x.value).all()) for x in raw.values())
    assert found["min_acceleration"] == pytest.approx(-5.0, abs=1e-5)
    assert found["max_jerk"] == found["max_yaw_rate"] == pytest.approx(0.0, abs=1e-4)
    assert found["comfortable"] == 0.0
    alone = on_host(streamed(*(jnp.ones(1) for _ in range(3))))  # nothing is driven yet
    assert alone["max_acceleration"] is alone["comfortable"] is None


def test_windows_keep_their_length_in_seconds():
    assert filters(0.05).yaw_rate.window == 2 * filters(0.1).yaw_rate.window + 1  # even windows look further
    n, dt = 60, 0.05
    x = np.sin(np.arange(n) * dt)
    kept = filters(dt).yaw_rate
    h = kept.head.shape[0] - 1
    middle = kept.head[-1] @ x[: kept.window]
    assert middle == pytest.approx(savgol(x, 10, 2, deriv=1, delta=dt)[h], abs=1e-9)
