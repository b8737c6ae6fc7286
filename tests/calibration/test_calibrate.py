"""The front door of calibration: one call, tables that print, a population for traffic."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from limsim_jax.calibration import calibrate
from limsim_jax.calibration.parameters import PARAMETERS
from limsim_jax.calibration.synthetic import drivers, follow
from limsim_jax.cli import app
from limsim_jax.traffic.car_following import IDM
from limsim_jax.traffic.population_file import read_population
from limsim_jax.traffic.vehicles import PARAMETERS as ALL
from limsim_jax.traffic.vehicles import default_population, sample_vehicles

pytestmark = pytest.mark.engine

LENGTH = 4.5


def table(count):
    """Made-up followers as a table with names and units of its own, and their parameters."""
    rng = np.random.default_rng(4)
    truth = drivers(count, 0.1, rng)
    parts = []
    for one in follow(truth, rng, noise=0.05):
        time = one.dt * np.arange(len(one))
        way = np.append(0, np.cumsum(0.5 * (one.v_lead[1:] + one.v_lead[:-1]) * one.dt)) + 100
        own = (way - LENGTH - one.gap) / 1000
        parts.append(pd.DataFrame({"t": time, "leader": way / 1000, "me": own, "name": one.driver}))
    return pd.concat(parts), truth


def drawn(population):
    """Drivers of cars from a population."""
    driver, shape = sample_vehicles(population, jax.random.key(0), jnp.arange(64))
    return jax.tree.map(lambda x: np.asarray(x)[np.asarray(shape.vehicle_class) == 0], driver)


COLUMNS = {"time": "t", "x_lead": "leader", "x": "me", "id": "name"}
OPTIONS = {"columns": COLUMNS, "units": {"x": "km"}, "length": LENGTH}


@pytest.fixture(scope="module")
def one():
    data, truth = table(1)
    return calibrate(data, **OPTIONS, model=IDM(), starts=2, speed_limit=20.0), truth


def test_one_driver_is_found_and_printed(one):
    found, truth = one
    np.testing.assert_allclose(found.fit.parameters, truth, rtol=0.12)
    text = str(found)
    assert "IDM, 1 driver" in text and "95 % interval" in text and "RMSE gap, m" in text
    assert all(f"{name}, " in text for name in PARAMETERS)
    assert "<table>" in found._repr_html_() and "desired speed" in found._repr_html_()
    row = found.drivers.to_pylist()[0]
    assert row["T_low"] < row["T"] < row["T_high"] and row["T_identified"]
    assert 0 < row["gap_rmse"] < 0.3 and 0 < row["speed_rmse"] < 0.3


def test_one_driver_makes_a_population_of_copies(one, tmp_path):
    found, _ = one
    population, usual = found.population, default_population()
    at = [ALL.index(name) for name in ("T", "s0", "a", "b")]
    np.testing.assert_allclose(population.median[0, jnp.array(at)], found.fit.parameters[0, 1:], rtol=1e-4)
    assert float(jnp.abs(population.spread[0, jnp.array(at)]).max()) == 0
    speed = float(population.median[0, ALL.index("speed_factor")])
    assert speed == pytest.approx(found.fit["v0"][0] / 20.0, rel=1e-4)
    np.testing.assert_array_equal(population.median[1], usual.median[1])  # other classes
    found.write_population(tmp_path / "drivers.json")
    again = read_population(tmp_path / "drivers.json")
    np.testing.assert_allclose(again.median, population.median, rtol=1e-6)


def test_two_drivers_make_a_population_of_their_spread(tmp_path):
    data, _ = table(2)
    found = calibrate(data, **OPTIONS, starts=2)
    k = PARAMETERS.index("T")
    median = np.exp(np.log(found.fit.parameters[:, k]).mean())
    spread = np.log(found.fit.parameters[:, k]).std()
    population = found.population
    assert float(population.median[0, ALL.index("T")]) == pytest.approx(median, rel=1e-4)
    assert float(population.spread[0, ALL.index("T")]) == pytest.approx(spread, rel=1e-3)
    assert "median driver of the others" in str(found)
    assert "population of 2 drivers: cars are spread like these two in v0, T, " in str(found)
    assert found.drivers["T_bound"].to_pylist() == [None, None]
    found.write_population(tmp_path / "drivers.json")
    cars = drawn(read_population(tmp_path / "drivers.json"))
    assert np.log(cars.T).std() == pytest.approx(spread, rel=0.3) and np.ptp(cars.s0) > 0
    with pytest.raises(ValueError, match="no driver 'x'; known are"):
        found.plot("x")
    assert len(found.plot().axes) == 2


def test_the_command_line_reads_a_table(tmp_path):
    path, out, result = tmp_path / "pairs.csv", tmp_path / "drivers.json", tmp_path / "found.json"
    table(1)[0].to_csv(path, index=False)
    command = ["calibrate", str(path), "--columns", "time=t,x_lead=leader,x=me,id=name", "--units", "x=km"]
    command += ["--length", "4.5", "--out", str(out), "--json", str(result), "--bounds", "T=0.3:1,v0=5:60"]
    run = CliRunner().invoke(app, command)
    assert run.exit_code == 0, run.output
    assert "IDM, 1 driver" in run.output
    assert "bounds that bind: T at 1 s; wider ones (bounds, --bounds) may fit better" in run.output
    assert "cars are copies of this driver in v0, " in run.output
    content = json.loads(result.read_text())
    assert content["bounds"]["T"] == {"lower": 0.3, "upper": 1.0, "at_lower": 0.0, "at_upper": 1.0}
    assert content["bounds"]["v0"] == {"lower": 5.0, "upper": 60.0, "at_lower": 0.0, "at_upper": 0.0}
    assert content["drivers"][0]["parameters"]["T"]["at_bound"] == "upper"
    assert "T" not in json.loads(out.read_text())["parameters"]  # its data do not tell it
    assert json.loads(out.read_text())["parameters"]["v_max"]["upper"] == 60.0
    cars, usual = (drawn(them) for them in (read_population(out), default_population()))
    assert np.ptp(cars.s0) == 0 and np.ptp(cars.v_max) == 0
    np.testing.assert_array_equal(cars.T, usual.T)
    for bounds, message in (("T=1", "PARAMETER=LOW:HIGH is expected"), ("T=3:1", "0 < low < high")):
        bad = CliRunner().invoke(app, ["calibrate", "none.csv", "--bounds", bounds])
        assert message in bad.output + str(bad.exception)
    bad = CliRunner().invoke(app, ["calibrate", str(path), "--columns", "time"])
    assert bad.exit_code == 2
