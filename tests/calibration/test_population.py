"""Populations from fits: known ones are found, files go to scenarios, `calibrate` does it all."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from paths import SHARED, needs_shared

from limsim_jax.calibration.fit import MODELS, Data, Fit, fit, stack
from limsim_jax.calibration.parameters import BOX, PARAMETERS
from limsim_jax.calibration.population import (
    Law,
    Residual,
    _expectation_maximisation,
    estimate,
    predictive_check,
    residual_process,
    write_population,
)
from limsim_jax.calibration.report import calibrate
from limsim_jax.calibration.synthetic import TYPICAL, follow
from limsim_jax.recordings import RecordingError
from limsim_jax.sweeps.episode import Episodes
from limsim_jax.sweeps.experiment import ExperimentError, read_experiments
from limsim_jax.traffic.population_file import read_population
from limsim_jax.traffic.vehicles import default_population, sample_vehicles

pytestmark = pytest.mark.engine

SPREAD = np.array([0.1, 0.2, 0.15, 0.15, 0.15])
CORRELATION = np.eye(5)
CORRELATION[1, 3] = CORRELATION[3, 1] = -0.7
COVARIANCE = CORRELATION * np.outer(SPREAD, SPREAD)


@pytest.fixture(scope="module")
def known():
    """Drivers of a known population and the population that was estimated."""
    rng = np.random.default_rng(11)
    truth = np.exp(rng.multivariate_normal(np.log(TYPICAL), COVARIANCE, 96))
    recorded = follow(truth, rng)
    found = fit(recorded, objective="gap")
    return truth, recorded, estimate(found, recorded, rounds=1)


def law(residual=None):
    """A law made by hand."""
    rng = np.random.default_rng(0)
    return Law(
        mean=np.log(TYPICAL),
        covariance=COVARIANCE,
        drivers=("a", "b", "c"),
        posterior_mean=rng.multivariate_normal(np.log(TYPICAL), COVARIANCE, 3),
        posterior_covariance=np.tile(COVARIANCE / 100, (3, 1, 1)),
        identified=np.array([0.9, 0.8, 0.7, 0.6, 0.2]),
        bound_shares=np.zeros((2, 5)),
        model=MODELS["idm"],
        objective="gap",
        residual=residual or Residual(sigma=0.2, tau=1.5),
    )


def test_a_known_population_is_found(known):
    truth, _, found = known
    np.testing.assert_allclose(np.exp(found.mean), np.exp(np.log(truth).mean(axis=0)), rtol=0.03)
    np.testing.assert_allclose(
        [found.spread[name] for name in PARAMETERS], np.log(truth).std(axis=0), rtol=0.25
    )
    sample = np.corrcoef(np.log(truth).T)
    assert found.correlation[1, 3] == pytest.approx(sample[1, 3], abs=0.15)
    assert np.abs(found.correlation - sample)[np.triu_indices(5, 1)].max() < 0.3


def test_expectation_maximisation_draws_unsure_drivers_to_the_others():
    """Against the closed form of one Gaussian unknown per driver: 50 sure of 2.0, one unsure of 6.0."""
    size, count = 5, 51
    centre = np.log(BOX).mean(axis=0)
    estimates = np.tile(centre, (count, 1))
    estimates[:, 2] += np.r_[np.random.default_rng(0).normal(0, 0.3, count - 1), np.log(3.0)]
    precision = np.r_[np.full(count - 1, 1e6), 1.0]
    information = precision[:, None, None] * np.eye(size)
    pull = np.einsum("dij,dj->di", information, estimates)
    mean, covariance, posterior, spread = _expectation_maximisation(information, pull, BOX)
    np.testing.assert_allclose(posterior[:-1], estimates[:-1], atol=1e-3)
    weight = 1 / (1 + 1 / covariance[2, 2])
    expected = weight * estimates[-1, 2] + (1 - weight) * mean[2]
    assert posterior[-1, 2] == pytest.approx(expected, abs=1e-3)
    assert spread[-1, 2, 2] == pytest.approx(weight, rel=1e-3)


def test_predictions_hold_what_they_say(known):
    _, recorded, found = known
    late = [replace(part.part(448, 896), driver=part.driver) for part in recorded]
    quiet = replace(found, residual=Residual(sigma=0.02, tau=1.0))
    check = predictive_check(quiet, late)
    assert check["inside_50"] == pytest.approx(0.5, abs=0.12)
    assert check["inside_90"] == pytest.approx(0.9, abs=0.06)
    assert predictive_check(quiet, late, known=True)["width_90"] < 0.5 * check["width_90"]


def test_the_residual_acceleration_is_found():
    """Followers whose acceleration is that of the model plus a known Ornstein-Uhlenbeck process."""
    rng = np.random.default_rng(2)
    dt, sigma, tau = 0.1, 0.3, 1.5
    shape = (16, 1280)
    data = {name: np.zeros(shape) for name in Data._fields}
    data["weight"] += 1
    data["start"][:, 0] = 1
    data["v_lead"] += 12
    data["gap"] += 20
    keep = np.exp(-dt / tau)
    noise = rng.normal(0, sigma, shape)
    for k in range(1, shape[1]):
        noise[:, k] = keep * noise[:, k - 1] + sigma * np.sqrt(1 - keep**2) * noise[:, k] / sigma
    # At gap 20 and v = 12 m/s, what the IDM wants; the speed drifts with the process only a little.
    parameters = np.tile(TYPICAL, (16, 1))
    v0, time_gap, s0, a, b = TYPICAL
    v = np.full(16, 12.0)
    for k in range(shape[1]):
        data["v"][:, k] = v
        wanted = s0 + np.maximum(v * time_gap + v * (v - 12) / (2 * np.sqrt(a * b)), 0)
        v = v + dt * (a * (1 - (v / v0) ** 4 - (wanted / 20) ** 2) + noise[:, k])
    arrays = Data(**{name: jnp.asarray(x, jnp.float32) for name, x in data.items()})
    found = residual_process(MODELS["idm"], parameters, arrays, dt)
    assert found.sigma == pytest.approx(sigma, rel=0.1)
    assert found.tau == pytest.approx(tau, rel=0.2)


def test_scenarios_draw_from_the_file(tmp_path):
    """Medians, spreads and correlations of the file; other classes and parameters as ever."""
    path = tmp_path / "drivers.json"
    write_population(law(), path, sources=["somewhere/i80.csv"], speed_limit=20.0)
    content = json.loads(path.read_text())
    assert content["sources"] == ["i80.csv"]
    assert list(content["parameters"]) == ["speed_factor", "T", "s0", "a", "b"]
    population = read_population(path, {"car": 1.0, "truck": 1.0})
    draw = jax.jit(lambda population: sample_vehicles(population, jax.random.key(1), jnp.arange(8192)))
    (driver, shape), (usual, _) = draw(population), draw(default_population({"car": 1.0, "truck": 1.0}))
    car = np.asarray(shape.vehicle_class) == 0
    for name, k in (("T", 1), ("s0", 2), ("a", 3), ("b", 4)):
        values = np.log(np.asarray(getattr(driver, name))[car])
        assert np.median(values) == pytest.approx(np.log(TYPICAL[k]), abs=0.02)
        assert values.std() == pytest.approx(SPREAD[k], rel=0.1)
    assert np.median(driver.speed_factor[car]) == pytest.approx(0.8, abs=0.01)
    together = np.corrcoef(np.log(driver.T[car]), np.log(driver.a[car]))[0, 1]
    assert together == pytest.approx(-0.7, abs=0.05)
    np.testing.assert_allclose(driver.T[~car], usual.T[~car], rtol=1e-5)
    np.testing.assert_allclose(driver.politeness, usual.politeness, rtol=1e-5)


def test_v0_is_written_only_where_data_tell_it(tmp_path):
    path = tmp_path / "drivers.json"
    write_population(law(), path)
    assert "v_max" in json.loads(path.read_text())["parameters"]
    write_population(replace(law(), identified=np.full(5, 0.4)), path)
    assert list(json.loads(path.read_text())["parameters"]) == ["T", "s0", "a", "b"]
    # of one or two drivers any parameter
    write_population(replace(law(), drivers=("a", "b")), path)
    assert list(json.loads(path.read_text())["parameters"]) == ["v_max", "T", "s0", "a"]
    with pytest.raises(ValueError, match=r"the data of 1 driver\(s\) tell none of v0, T"):
        write_population(replace(law(), drivers=("a",), identified=np.zeros(5)), path)


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        (("format",), "other", "its 'format' has to be"),
        (("classes",), ["tank"], "classes: ['tank']"),
        (("parameters", "T", "median"), "1.2", "parameters.T.median: '1.2'"),
        (("parameters", "T", "upper"), 0.9, "parameters.T: median 1.2"),
        (("parameters", "tau"), {}, "parameters.tau: no such parameter"),
        (("correlation", 0, 1), 2.0, "correlation: a positive definite matrix of 5 rows"),
    ],
)
def test_a_bad_file_of_drivers_is_refused(where, value, message, tmp_path):
    path = tmp_path / "drivers.json"
    write_population(law(), path)
    content = json.loads(path.read_text())
    at = content
    for key in where[:-1]:
        at = at[key]
    at[where[-1]] = value
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError) as caught:
        read_population(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)


def test_experiments_name_a_file_of_drivers(tmp_path):
    write_population(law(), tmp_path / "drivers.json")
    text = 'map = "highway"\nhorizon = 1.0\nslots = 8\n[traffic]\nvehicles = 3\ndrivers = "drivers.json"\n'
    (tmp_path / "real.toml").write_text(text)
    episodes = Episodes(read_experiments(tmp_path / "real.toml")[0])
    median = np.asarray(episodes._demand.population.median)
    assert median[0, 2] == pytest.approx(1.2)
    assert len(episodes.provenance()["drivers"]) == 64
    (tmp_path / "drivers.json").write_text("{}")
    with pytest.raises(ExperimentError, match=r"real: traffic: .*drivers.json: no file of drivers"):
        Episodes(read_experiments(tmp_path / "real.toml")[0])
    (tmp_path / "drivers.json").unlink()
    with pytest.raises(ExperimentError, match=r"real: traffic: drivers.json: No such file"):
        Episodes(read_experiments(tmp_path / "real.toml")[0])


@needs_shared
def test_calibrate_reads_validates_and_writes(tmp_path):
    path = SHARED / "trajectories" / "openacc_zalazone_no_ACC_handling_part26.csv.gz"
    result = calibrate(path, starts=2)
    text = result.text()
    assert "5 drivers in 5 segments" in text and "11% to 29%" in text
    content = json.loads(json.dumps(result.as_json()))
    assert [row["driver"] for row in content["drivers"]] == list(result.fit.drivers)
    assert 0.05 < content["errors"]["calibration"]["mixed"]["median"] < 0.29
    assert content["errors"]["validation"]["mixed"]["median"] < 0.5
    result.write_population(tmp_path / "drivers.json")
    assert read_population(tmp_path / "drivers.json")
    _, data, _ = stack(result.segments)
    assert data.gap.shape[0] == 5


def test_too_little_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="at least one file"):
        calibrate([])
    with pytest.raises(ValueError, match=r"first = 1\.5"):
        calibrate(tmp_path / "x.csv", first=1.5)
    with pytest.raises(RecordingError, match=r"x\.csv: no such file"):
        calibrate(tmp_path / "x.csv")
    two = np.tile(TYPICAL, (2, 1))
    found = Fit(
        model=MODELS["idm"], objective="gap", method="lm", drivers=("a", "b"), parameters=two,
        error=np.ones(2), starts=np.ones((2, 1)), seconds=0.0,
    )  # fmt: skip
    with pytest.raises(ValueError, match="population from 2 drivers"):
        estimate(found, [])
