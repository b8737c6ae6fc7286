"""Fits of car-following models: rollouts, gradients, recovery of known drivers, other optimisers."""

import inspect
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differential_evolution import fit_by_evolution
from paths import REPO, SHARED, needs_shared
from scipy.optimize import differential_evolution

from limsim_jax.calibration import calibrate
from limsim_jax.calibration.cleaning import Segment, segments
from limsim_jax.calibration.fit import (
    MODELS,
    OBJECTIVES,
    Data,
    Problem,
    _normal_equations,
    _residuals,
    errors,
    fit,
    residuals,
    rollout,
    stack,
)
from limsim_jax.calibration.parameters import BOUNDS, BOX, PARAMETERS, UNITS
from limsim_jax.calibration.synthetic import TYPICAL, drivers, follow
from limsim_jax.calibration.uncertainty import uncertainty
from limsim_jax.cli.fitting import calibrate as cli_calibrate
from limsim_jax.recordings import read_recording
from limsim_jax.traffic.car_following import IDM

pytestmark = pytest.mark.engine

DT = 0.1


@pytest.fixture(scope="module")
def known():
    """Drivers that are known, how they follow, and what a fit says."""
    rng = np.random.default_rng(3)
    truth = drivers(96, 0.12, rng)
    recorded = follow(truth, rng)
    return truth, recorded, fit(recorded, objective="gap")


def segment(gap, v, v_lead, driver="one", dt=DT):
    gap, v, v_lead = (np.broadcast_to(np.asarray(x, float), np.shape(v_lead)) for x in (gap, v, v_lead))
    return Segment(
        driver=driver, leader="leader", source="made up", line=1, dt=dt, time=0.0, vehicle_class=0,
        gap=gap, v=v, v_lead=v_lead,
    )  # fmt: skip


def put(value, at, odd):
    """50 equal values but one."""
    values = np.full(50, value)
    values[at] = odd
    return values


@dataclass(frozen=True)
class Lost(IDM):
    """A model that does not know."""

    def __call__(self, *args, **kwargs):
        return super().__call__(*args, **kwargs) * jnp.nan


def idm_by_hand(parameters, gap, v, v_lead):
    """A loop over steps: IDM and ballistic step in double precision."""
    v0, time_gap, s0, a, b = parameters
    gaps, speeds = [], []
    for k in range(len(v_lead)):
        gaps.append(gap)
        speeds.append(v)
        wanted = s0 + max(0.0, v * time_gap + v * (v - v_lead[k]) / (2 * np.sqrt(a * b)))
        acc = max(a * (1 - (v / v0) ** 4 - (wanted / max(gap, 0.01)) ** 2), -9.0) if gap > 0 else -9.0
        after = v + acc * DT
        moved = v * DT + 0.5 * acc * DT**2 if after >= 0 else -v * v / (2 * acc)
        after = max(after, 0.0)
        following = v_lead[min(k + 1, len(v_lead) - 1)]
        gap += 0.5 * DT * (v_lead[k] + following) - moved
        v = after
    return np.array(gaps), np.array(speeds)


def test_a_rollout_is_the_loop_by_hand():
    """Two segments of unequal length, each from where its recording starts, and a stop in between."""
    t = np.arange(400) * DT
    lead = np.maximum(12 + 3 * np.sin(0.4 * t) - 2.0 * np.clip(t - 12, 0, 7.5) + 2 * np.clip(t - 25, 0, 5), 0)
    parts = [segment(15.0, 12.0, lead), segment(30.0, 20.0, lead[:150] + 8)]
    _, data, dt = stack(parts)
    assert data.gap.shape == (1, 640)
    gap, v = rollout(MODELS["idm"], jnp.asarray(TYPICAL), jax.tree.map(lambda x: jnp.asarray(x[0]), data), dt)
    at = 0
    for part in parts:
        expected = idm_by_hand(TYPICAL, part.gap[0], part.v[0], part.v_lead)
        # the leader's speed one step on is that of the next segment at a segment's very end
        rows = slice(at, at + len(part))
        np.testing.assert_allclose(gap[rows], expected[0], atol=2e-3)
        np.testing.assert_allclose(v[rows], expected[1], atol=1e-3)
        at += len(part)
    assert np.asarray(v)[300:].min() == 0.0  # it did stand


def test_objectives_by_their_formulas():
    rng = np.random.default_rng(0)
    recorded, simulated = rng.uniform(2, 30, 128), rng.uniform(2, 30, 128)
    weight = np.r_[np.ones(100), np.zeros(28)]
    values = {name: np.zeros(128) for name in Data._fields} | {"gap": recorded, "weight": weight}
    data = Data(**{name: jnp.asarray(x, jnp.float32) for name, x in values.items()})
    s, r = simulated[:100], recorded[:100]
    expected = {
        "gap": np.sqrt(np.mean((s - r) ** 2)),
        "speed": np.sqrt(np.mean(s**2)),
        "mixed": np.sqrt(np.mean((s - r) ** 2 / r) / np.mean(r)),
        "log": np.sqrt(np.mean(np.log(s / r) ** 2)),
        "relative": np.sqrt(np.mean((s / r - 1) ** 2)),
        "absolute": np.sqrt(np.mean((s - r) ** 2)) / np.mean(r),
    }
    assert set(expected) == set(OBJECTIVES)
    for name, value in expected.items():
        off = residuals(name, jnp.asarray(simulated, jnp.float32), jnp.asarray(simulated, jnp.float32), data)
        assert np.sqrt(np.sum(np.square(off)) / 100) == pytest.approx(value, rel=1e-5), name


def test_only_the_beginning_of_a_stop_counts():
    v = np.r_[np.full(20, 5.0), np.zeros(60), np.full(20, 5.0)]
    _, data, _ = stack([segment(10.0, v, v)])
    assert np.flatnonzero(data.weight[0, :100] == 0).tolist() == list(range(40, 80))
    assert not data.weight[0, 100:].any()


@pytest.mark.parametrize("model", MODELS)
def test_gradients_agree_with_finite_differences(model):
    """In double precision, with a stop and a start; central differences of 1e-6."""
    rng = np.random.default_rng(1)
    _, narrow, _ = stack(follow(drivers(1, 0.1, rng), rng, samples=640))
    with jax.enable_x64(True):
        data = jax.tree.map(lambda x: jnp.asarray(x[0], jnp.float64), narrow)
        problem = Problem(MODELS[model], "mixed", DT)
        u = jnp.asarray([0.31, 0.22, 0.27, 0.24, 0.36])
        cost, slope, _ = jax.jit(_normal_equations, static_argnums=0)(problem, u, data)
        several = jax.jit(jax.vmap(lambda u: jnp.sum(_residuals(problem, u, data, None) ** 2)))
        step = 1e-6 * np.eye(len(PARAMETERS))
        up, down = (np.asarray(several(u[None] + sign * step)) for sign in (1, -1))
        np.testing.assert_allclose(2 * slope, (up - down) / 2e-6, rtol=1e-4, atol=1e-8)
        assert float(cost) == pytest.approx(float(several(u[None])[0]))
        assert np.abs(slope).min() > 1e-7


def test_known_drivers_are_recovered(known):
    """v0, T, a within 5 %, s0 and b within 15 %, with an error of the gap of 0.3 m."""
    truth, _, found = known
    off = np.abs(found.parameters / truth - 1)
    limit = np.array([0.05, 0.05, 0.15, 0.05, 0.15])
    assert (np.median(off, axis=0) < 0.5 * limit).all()
    assert ((off < limit).mean(axis=0) >= 0.85).all()
    assert (np.abs(np.median(found.parameters / truth, axis=0) - 1) < 0.02).all()
    assert np.median(found.error) == pytest.approx(0.26, abs=0.03)  # the noise, and no more


def test_intervals_hold_the_truth(known):
    truth, recorded, found = known
    sure = uncertainty(found, recorded)
    inside = (sure.interval[:, 0] <= truth) & (truth <= sure.interval[:, 1])
    assert 0.88 <= inside.mean() <= 0.98
    assert (inside.mean(axis=0) >= 0.82).all()
    # as wide as the errors are, too
    error = 1.48 * np.median(np.abs(found.parameters / truth - 1), axis=0)
    np.testing.assert_allclose(np.median(sure.standard_error / truth, axis=0), error, rtol=0.35)
    assert sure.identified.all()
    assert np.median(sure.rho) == pytest.approx(0.95, abs=0.015)
    assert np.median(sure.sigma) == pytest.approx(0.3, abs=0.05)


def test_what_data_cannot_tell_is_flagged():
    """Steady following behind an even leader: no free flow, no approach, no stop."""
    rng = np.random.default_rng(5)
    t = np.arange(250) * DT
    lead = 10 + 0.3 * np.sin(0.5 * t)
    gap, v = idm_by_hand(TYPICAL, 16.0, 10.0, lead)
    recorded = [segment(gap + rng.normal(0, 0.3), v, lead, driver=f"{i}") for i in range(3)]
    noisy = [
        segment(
            one.gap + np.convolve(rng.normal(0, 0.4, 259), np.ones(10) / 10, "valid"), one.v, lead, one.driver
        )
        for one in recorded
    ]
    found = fit(noisy, objective="gap", samples=896)
    sure = uncertainty(found, noisy)
    names = np.asarray(PARAMETERS)
    for i in range(3):
        assert not {"s0", "b"} & set(names[sure.identified[i]])
    assert (sure.condition > 1e3).all()
    assert np.isfinite(sure.standard_error).all()
    assert not sure.identified[sure.at_bound].any()


def test_gradients_find_what_differential_evolution_finds(known):
    _, recorded, _ = known
    some = recorded[:12]
    here = fit(some)
    there = fit_by_evolution(some, seed=1)
    assert (here.error <= 1.01 * there.error).all()
    assert here.seconds > 0 and here.drivers == there.drivers
    # and what SciPy's finds, on its own
    _, data, dt = stack(some[:1])

    def cost(x):
        return np.asarray(mixed(jnp.asarray(x.T, jnp.float32)), float)

    @jax.jit
    def mixed(p):
        same = jax.tree.map(lambda x: jnp.broadcast_to(jnp.asarray(x), (p.shape[0], x.shape[-1])), data)
        return errors(MODELS["idm"], p, same, dt)["mixed"]

    bounds = list(zip(*BOX, strict=True))
    peer = differential_evolution(
        cost, bounds, maxiter=80, vectorized=True, updating="deferred", polish=False, rng=1
    )
    assert here.error[0] == pytest.approx(peer.fun, rel=0.01)
    assert there.error[0] == pytest.approx(peer.fun, rel=0.01)


@pytest.mark.parametrize("method", ["adam", "lbfgs"])
def test_other_methods_agree(method, known):
    _, recorded, _ = known
    here = fit(recorded[:3], objective="gap")
    there = fit(
        recorded[:3],
        objective="gap",
        method=method,
        starts=2,
        iterations=200 if method == "adam" else 40,
    )
    np.testing.assert_allclose(there.error, here.error, rtol=0.01)
    np.testing.assert_allclose(there["v0"], here["v0"], rtol=0.01)


def test_a_fit_does_not_depend_on_the_other_drivers(known):
    _, recorded, found = known
    alone = fit(recorded[7:10], objective="gap")
    np.testing.assert_allclose(alone.error, found.error[7:10], rtol=1e-3)
    np.testing.assert_allclose(alone.parameters, found.parameters[7:10], rtol=2e-2)


def test_a_bound_that_binds_is_told_and_wider_ones_find_the_driver():
    """Two drivers with time gaps beyond the default box, one within."""
    rng = np.random.default_rng(8)
    truth = np.tile(TYPICAL, (3, 1))
    truth[:2, 1] = 5.0
    recorded = follow(truth, rng, noise=0.05)
    usual, wide = (fit(recorded, objective="gap", bounds=b) for b in (None, {"T": (0.2, 8.0)}))
    sure = uncertainty(usual, recorded)
    assert sure.side[:, 1].tolist() == [1, 1, 0]
    assert sure.bound_shares[:, 1] == pytest.approx([0, 2 / 3])
    assert usual["T"][:2] == pytest.approx(BOUNDS["T"][1])
    assert not sure.identified[:2, 1].any()
    np.testing.assert_allclose(wide["T"], truth[:, 1], rtol=0.02)
    assert (wide.error[:2] < 0.2 * usual.error[:2]).all()
    again = uncertainty(wide, recorded)
    assert not again.at_bound[:, 1].any() and again.identified[:, 1].all()
    assert (again.interval[:2, 1, 1] > BOUNDS["T"][1]).all()  # not cut at the default box


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        ({"tau": (1, 2)}, "bounds: no parameter 'tau'; known are v0, T, s0, a, b"),
        ({"T": (3.0, 0.3)}, "bounds: T within (3.0, 0.3); finite numbers of s with 0 < low < high"),
        ({"T": (1.0, 1.0)}, "bounds: T within (1.0, 1.0)"),
        ({"b": (-1.0, 2.0)}, "bounds: b within (-1.0, 2.0); finite numbers of m/s^2"),
        ({"a": (0, 2)}, "bounds: a within (0, 2)"),
        ({"s0": (1.0, np.inf)}, "bounds: s0 within (1.0, inf)"),
        ({"s0": (np.nan, 2.0)}, "bounds: s0 within (nan, 2.0)"),
        ({"v0": (5, 30, 45)}, "bounds: v0 within (5, 30, 45)"),
    ],
)
def test_bounds_that_cannot_be_are_refused(bounds, message):
    with pytest.raises(ValueError) as caught:
        fit([], bounds=bounds)  # before anything is looked at
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="bounds"):
        calibrate("none.csv", bounds=bounds)


def test_default_bounds_are_documented():
    text = (REPO / "docs" / "guides" / "calibrate.md").read_text() + inspect.getsource(cli_calibrate)
    for name, (low, high) in BOUNDS.items():
        assert f"{name}={low:g}:{high:g}" in text
        assert f"| `{name}` | {UNITS[name].replace('^2', '²')} | {low:g} to {high:g} |" in text
        assert f"{name} {low:g} to {high:g}" in " ".join((calibrate.__doc__ or "").split())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"gap": put(10.0, 7, np.nan)}, "gap[7] = nan; a finite gap above 0 m is expected"),
        ({"gap": put(10.0, 7, np.inf)}, "gap[7] = inf; a finite gap above 0 m"),
        ({"gap": put(10.0, 7, -2.0)}, "gap[7] = -2; a finite gap above 0 m"),
        ({"v": put(3.0, 9, -1.0)}, "v[9] = -1; a speed from 0 to 70 m/s is expected"),
        ({"v": put(3.0, 9, np.nan)}, "v[9] = nan; a speed"),
        ({"v_lead": put(3.0, 0, 1e9)}, "v_lead[0] = 1e+09; a speed"),
        ({"v": np.full(49, 3.0)}, "v has shape (49,), gap (50,); one axis of equal length"),
        ({"dt": np.nan}, "dt = nan; a finite number above 0"),
        ({"dt": -0.1}, "dt = -0.1; a finite number above 0"),
        ({"length_lead": 0.0}, "length_lead = 0; a finite number above 0"),
    ],
)
def test_a_segment_that_cannot_be_is_refused(changed, message):
    """In one line that names driver, series, sample and value."""
    with pytest.raises(ValueError) as caught:
        replace(segment(10.0, 3.0, np.full(50, 3.0)), **changed)
    assert str(caught.value).startswith(f"segment of driver 'one': {message}")
    assert "\n" not in str(caught.value)


def test_arguments_are_checked(known):
    _, recorded, _ = known
    with pytest.raises(ValueError, match="segment of driver 'one': 1 samples; 2 or more"):
        stack([segment(10.0, 3.0, np.full(1, 3.0))])
    wrong: list[dict[str, Any]] = [{"shortest": np.nan}, {"speed_limit": -5.0}, {"starts": 0}]
    for argument in wrong:
        with pytest.raises(
            ValueError, match=f"{next(iter(argument))} = .*; a finite number above 0 is expected"
        ):
            calibrate("none.csv", **argument)
    with pytest.raises(ValueError, match="driver '000': Lost gives no finite gaps for any parameters"):
        fit(recorded[:1], Lost(), starts=1)
    with pytest.raises(ValueError, match="objective 'rmse' is unknown"):
        fit(recorded, objective="rmse")
    with pytest.raises(ValueError, match="method 'ga' is unknown"):
        fit(recorded, method="ga")
    with pytest.raises(ValueError, match="no segments"):
        fit([])
    with pytest.raises(ValueError, match=r"steps of 0.1, 0.2 s"):
        stack([recorded[0], segment(9.0, 3.0, np.full(50, 3.0), dt=0.2)])


@needs_shared
@pytest.mark.parametrize(
    "model", ["idm", *(pytest.param(name, marks=pytest.mark.slow) for name in ("iidm", "acc"))]
)
def test_real_followers_are_fitted_as_well_as_by_differential_evolution(model):
    path = SHARED / "trajectories" / "ngsim_i80_0400_pairs.csv.gz"
    recorded, _ = segments(read_recording(path))
    some = recorded[::8]  # 12 of 94
    here = fit(some, MODELS[model], samples=896)  # as above: one program for both
    there = fit_by_evolution(some, MODELS[model], samples=896)
    assert (here.error <= 1.01 * there.error).all()
    assert 0.05 < np.median(here.error) < 0.29  # published: 11 to 29 %
