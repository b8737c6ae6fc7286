"""Vehicles: samples against the declared distributions (SciPy), SUMO's types, the published table."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vehicle_table
from paths import SHARED, needs_shared
from scipy import stats

from limsim_jax.maps.lane_map import VEHICLE_CLASSES
from limsim_jax.maps.network import MapError
from limsim_jax.maps.sumo import read_demand
from limsim_jax.traffic import vehicles as vh

N = 100_000


@pytest.fixture(scope="module")
def draw():
    """Vehicles as a dict of NumPy arrays."""
    jitted = jax.jit(vh.sample_vehicles)

    def run(population, seed=0, n=N, vehicle_type=None):
        types = None if vehicle_type is None else jnp.full(n, vehicle_type)
        driver, shape = jitted(population, jax.random.key(seed), jnp.arange(n), types)
        return {k: np.asarray(v) for k, v in (vars(driver) | vars(shape)).items()}

    return run


def column(population, vehicle_type, name):
    p = vh.PARAMETERS.index(name)
    leaves = (population.median, population.spread, population.loading, population.lower, population.upper)
    return tuple(float(leaf[vehicle_type, p]) for leaf in leaves)


@pytest.mark.engine
@pytest.mark.parametrize("vehicle_class", ["car", "truck"])
def test_parameters_have_the_declared_distributions(draw, vehicle_class):
    """Kolmogorov-Smirnov against truncated normals, of the logarithm where the parameter is log-normal."""
    population = vh.default_population()
    row = VEHICLE_CLASSES.index(vehicle_class)
    values = draw(population, vehicle_type=row)
    assert (values["vehicle_class"] == row).all()
    for name in vh.PARAMETERS:
        median, spread, _, lower, upper = column(population, row, name)
        if spread == 0:
            assert (values[name] == np.float32(median)).all(), name
            continue
        x, ends = values[name].astype(float), np.array([lower, upper])
        if name not in vh.NORMAL:
            x, ends, median = np.log(x), np.log(ends), np.log(median)
        low, high = (ends - median) / spread
        assert stats.kstest(x, stats.truncnorm(low, high, median, spread).cdf).pvalue > 1e-3, name


@pytest.mark.engine
def test_parameters_correlate_as_declared(draw):
    """Normal scores correlate by the product of the loadings, drivers and bodies apart."""
    population = vh.default_population()
    values = draw(population, vehicle_type=0)
    names = [name for name in vh.PARAMETERS if column(population, 0, name)[1] > 0]
    scores = [stats.norm.ppf(stats.rankdata(values[name]) / (N + 1)) for name in names]
    loading = np.array([column(population, 0, name)[2] for name in names])
    body = np.array([name in vh.BODY for name in names])
    want = np.where(body[:, None] == body, np.outer(loading, loading), 0)
    np.fill_diagonal(want, 1)
    np.testing.assert_allclose(np.corrcoef(scores), want, atol=0.015)
    i = {name: k for k, name in enumerate(names)}  # an aggressive driver: close, quick, impolite
    assert want[i["T"], i["a"]] < -0.3 and want[i["T"], i["politeness"]] > 0.3
    assert want[i["speed_factor"], i["gap_factor"]] < -0.3 and want[i["length"], i["wheelbase"]] > 0.8


@pytest.mark.engine
def test_all_vehicles_are_sensible(draw):
    for shares in (vh.URBAN, vh.HIGHWAY):
        population = vh.default_population(shares)
        values = draw(population, seed=3)
        row = values["vehicle_class"]
        for p, name in enumerate(vh.PARAMETERS):
            assert np.isfinite(values[name]).all()
            assert (values[name] >= np.asarray(population.lower)[row, p]).all(), name
            assert (values[name] <= np.asarray(population.upper)[row, p]).all(), name
        assert (values["b"] < values["b_max"]).all() and values["b_max"].max() <= 9
        assert (values["wheelbase"] < values["length"]).all()
        assert values["width"].max() <= np.float32(2.55) and values["T"].min() >= np.float32(0.6)
        trucks = row == VEHICLE_CLASSES.index("truck")
        assert values["v_max"][trucks].max() < 26 < values["v_max"][~trucks].min()
        counts = np.bincount(row, minlength=6)
        expected = N * np.array([shares[name] for name in VEHICLE_CLASSES])
        assert stats.chisquare(counts, expected * counts.sum() / expected.sum()).pvalue > 1e-3


def test_classes_without_a_share_do_not_occur(draw):
    values = draw(vh.default_population({"van": 3, "motorcycle": 1}))
    counts = np.bincount(values["vehicle_class"], minlength=6)
    assert counts[[0, 2, 3, 5]].sum() == 0
    assert stats.binomtest(int(counts[1]), N, 0.75).pvalue > 1e-3


@pytest.mark.engine
def test_a_vehicle_does_not_depend_on_its_batch():
    population, key = vh.default_population(), jax.random.key(7)
    sample = jax.jit(vh.sample_vehicles)
    ids = jnp.arange(64)
    whole = sample(population, key, ids)
    some = jnp.array([40, 3, 17])
    part = sample(population, key, some)
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
        assert a.shape == (64,) and b.shape == (3,)
        np.testing.assert_array_equal(a[some], b)
    one = jax.jit(vh.sample)(population, jax.random.fold_in(key, 17))
    for a, b in zip(jax.tree.leaves(part), jax.tree.leaves(one), strict=True):
        assert b.shape == ()
        np.testing.assert_allclose(a[2], b, rtol=1e-5)
    other = sample(population, jax.random.key(8), ids)
    assert (whole[0].T != other[0].T).mean() > 0.9
    assert len(np.unique(whole[0].T)) == 64


def test_populations_of_one_size_share_a_program():
    traces = []

    @jax.jit
    def run(population, key):
        traces.append(1)
        return vh.sample(population, key)

    for shares in (vh.URBAN, vh.HIGHWAY, {"bus": 1.0}):
        run(vh.default_population(shares), jax.random.key(0))
    assert len(traces) == 1


def test_uniform_population(draw):
    values = draw(vh.uniform_population("bus", T=1.7, politeness=0.0), n=50)
    for name in vh.PARAMETERS:
        want = {"T": 1.7, "politeness": 0.0}.get(name, vh.DEFAULTS[name].median[3])
        assert (values[name] == np.float32(want)).all(), name
    assert (values["vehicle_class"] == 3).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: vh.uniform_population("lorry"), "vehicle class 'lorry' is unknown; known are car, van"),
        (lambda: vh.uniform_population(tau=1.0), "parameter 'tau' is unknown; known are speed_factor"),
        (lambda: vh.default_population({"cars": 1.0}), "'cars' is unknown"),
        (lambda: vh.default_population({"car": -1.0, "van": 2.0}), "0 or more"),
        (lambda: vh.default_population({"car": float("nan")}), "0 or more"),
        (lambda: vh.default_population({}), "one of them positive"),
    ],
)
def test_mistakes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# ---- SUMO's vehicle types

VTYPES = """<routes>
  <vType id="fast" accel="1.9" decel="2.5" emergencyDecel="8" tau="0.9" minGap="1.5" maxSpeed="44" sigma="0.3"
         length="4.4" width="1.75" speedFactor="normc(1.1,0.2,0.9,1.6)" probability="0.25"
         carFollowModel="IDM" delta="3.5"/>
  <vType id="lorry" vClass="truck" speedFactor="0.9" speedDev="0" emergencyDecel="2" probability="0.75"/>
</routes>"""


def read_types(tmp_path, text):
    path = tmp_path / "types.rou.xml"
    path.write_text(text)
    return list(read_demand(path).types.values())


@pytest.mark.engine
def test_vtypes(tmp_path, draw):
    population = vh.from_vtypes(read_types(tmp_path, VTYPES))
    fast, lorry = (draw(population, vehicle_type=row) for row in (0, 1))
    given = {"a": 1.9, "b": 2.5, "b_max": 8, "T": 0.9, "s0": 1.5, "v_max": 44, "delta": 3.5}
    for name, value in (given | {"length": 4.4, "width": 1.75, "wheelbase": 4.4 * 2.6 / 4.5}).items():
        np.testing.assert_allclose(fast[name], value, rtol=1e-6)
        assert np.ptp(fast[name]) == 0
    factor = stats.truncnorm((0.9 - 1.1) / 0.2, (1.6 - 1.1) / 0.2, 1.1, 0.2)
    assert stats.kstest(fast["speed_factor"], factor.cdf).pvalue > 1e-3
    assert np.ptp(fast["politeness"]) > 0.2  # vTypes know none: the default distribution
    # defaults of SUMO's class, and no emergency braking below the comfortable one
    for name, value in {"a": 1.3, "b": 4.0, "b_max": 4.0, "T": 1, "length": 7.1, "speed_factor": 0.9}.items():
        np.testing.assert_allclose(lorry[name], value, rtol=1e-6)
    row = draw(population)["vehicle_class"]
    assert set(row) == {VEHICLE_CLASSES.index("car"), VEHICLE_CLASSES.index("truck")}
    assert stats.binomtest(int((row == 0).sum()), N, 0.25).pvalue > 1e-3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<routes/>", "no vehicle type with a positive probability"),
        ('<routes><vType id="a" probability="0"/></routes>', "no vehicle type with a positive probability"),
        ('<routes>\n<vType id="b" vClass="bicycle"/></routes>', ":2: vType b: vClass 'bicycle' is no motor"),
        (
            '<routes>\n<vType id="c" delta="four"/></routes>',
            ":2: vType c: delta='four' is no positive number",
        ),
    ],
)
def test_vtypes_that_cannot_be_used(tmp_path, text, message):
    with pytest.raises(MapError, match=message):
        vh.from_vtypes(read_types(tmp_path, text))


@needs_shared
def test_vtypes_of_real_demand(draw):
    types = read_demand(SHARED / "sumo" / "bologna_pasubio" / "pasubio_vtypes.add.xml").types.values()
    types = [vtype for vtype in types if vtype.engine_class is not None]
    assert len(types) > 2
    population = vh.from_vtypes(types)
    for row, vtype in enumerate(types):
        values = draw(population, n=10, vehicle_type=row)
        np.testing.assert_allclose(values["length"], vtype.length, rtol=1e-6)
        np.testing.assert_allclose(values["s0"], vtype.min_gap, rtol=1e-6)
        assert (values["vehicle_class"] == VEHICLE_CLASSES.index(str(vtype.engine_class))).all()


# ---- the table


def test_published_table_is_what_the_command_writes():
    for name, page in vehicle_table.pages().items():
        assert (vehicle_table.RESULTS / f"{name}.md").read_text(encoding="utf-8") == page


def test_every_parameter_has_a_default_and_a_source():
    assert set(vh.DEFAULTS) == set(vh.PARAMETERS)
    for name, parameter in vh.DEFAULTS.items():
        assert parameter.source and parameter.unit and len(parameter.median) == len(VEHICLE_CLASSES), name
