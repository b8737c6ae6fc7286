"""The random numbers of a world as one array."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from traffic_worlds import bundled, demand_of

from limsim_jax.traffic.demand import Flow, sample_scenario
from limsim_jax.traffic.demand.draws import Layout, draw
from limsim_jax.traffic.vehicles import default_population

pytestmark = pytest.mark.engine


@functools.cache
def demand():
    flows = [Flow(origin="1-", rate=400), Flow(origin="2-", rate=200)]
    return demand_of("roundabout", flows, default_population(), horizon=30.0, density=10.0)


@functools.cache
def layout():
    return Layout.of(demand())


@functools.cache
def drawn():
    """Draws of three keys, `[3, ...]`."""
    keys = jax.random.split(jax.random.key(1), 3)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda key: draw(demand(), key)))(keys))


@functools.cache
def values_of():
    return jax.jit(layout().values)


def test_all_numbers_that_matter_are_in_the_array():
    kinds = {number.what for number in layout().numbers}
    assert {"gap", "seat", "place", "goal", "type", "T", "length", "aggressiveness"} <= kinds
    assert "delta" not in kinds, "a parameter that is the same for all drivers is no number of a world"
    gaps = [number for number in layout().numbers if number.what == "gap"]
    assert len({(x.stream, x.place) for x in gaps}) == len(gaps)
    assert len({x.lane for x in gaps}) == len({x.stream for x in gaps}) >= 2
    entering = {x.vehicle for x in layout().numbers if 0 <= x.vehicle < layout().rows}
    assert len(entering) == int(np.asarray(demand().start)[-1]), "a row per vehicle, no padding"


def test_an_array_makes_the_draws_that_it_came_from():
    for k in range(3):
        one = jax.tree.map(lambda x: jnp.asarray(x[k]), drawn())  # noqa: B023
        values = values_of()(one)
        assert values.shape == (layout().size,)
        back = layout().draws(values)
        assert (values_of()(back) == values).all()
        assert (back.place == one.place).all() and (back.order == one.order).all()
        rows = int(np.asarray(demand().start)[-1])
        assert (back.roles[:rows] == one.roles[:rows]).all()


def test_draws_are_normal_numbers():
    values = np.stack([np.asarray(values_of()(jax.tree.map(lambda x: x[k], drawn()))) for k in range(3)])  # noqa: B023
    z = layout().to_normals(values)
    for kind in ("uniform", "gumbel", "normal"):
        some = z[:, layout().kinds == kind].ravel()
        assert stats.kstest(some, "norm").pvalue > 1e-3, kind
    np.testing.assert_allclose(layout().from_normals(z), values, rtol=1e-5, atol=1e-6)


def test_extreme_numbers_stay_within_their_range():
    for z in (-8.0, 8.0):
        values = layout().from_normals(np.full((1, layout().size), z))
        assert np.isfinite(values).all()
        uniform = values[:, layout().kinds == "uniform"]
        assert (uniform >= 0).all() and (uniform < 1).all()


def test_a_world_from_its_array_is_that_of_its_key():
    lane_map = bundled("roundabout")[1]
    sample = jax.jit(lambda of: sample_scenario(demand(), lane_map, of, 32))
    for key in jax.random.split(jax.random.key(7), 2):
        world = sample(key)
        values = layout().values(draw(demand(), key))
        again = sample(layout().draws(values))
        comes = np.asarray(world.schedule.time) < 1e8
        for x, y in zip(jax.tree.leaves(world.start), jax.tree.leaves(again.start), strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-6, atol=1e-6)
        for name in ("time", "lane", "s", "v", "goal"):
            x, y = np.asarray(getattr(world.schedule, name)), np.asarray(getattr(again.schedule, name))
            np.testing.assert_allclose(x[comes], y[comes], rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(world.schedule.driver.T[comes], again.schedule.driver.T[comes], rtol=1e-6)


def test_a_number_moves_what_it_stands_for():
    lane_map = bundled("roundabout")[1]
    sample = jax.jit(lambda of: sample_scenario(demand(), lane_map, layout().draws(of), 32).schedule)
    z = np.random.default_rng(0).standard_normal(layout().size)
    before = sample(layout().from_normals(z))
    first = next(k for k, x in enumerate(layout().numbers) if x.what == "gap" and x.place == 1)
    headway = next(k for k, x in enumerate(layout().numbers) if x.what == "T" and x.vehicle == 0)
    other = z.copy()
    other[first] += 1
    later = np.asarray(sample(layout().from_normals(other)).time) - np.asarray(before.time)
    moved = np.flatnonzero(later > 0)
    assert len(moved) and (later >= 0).all()
    lanes = np.asarray(before.lane)[moved]
    assert set(lanes.tolist()) == {layout().numbers[first].lane}, "another flow does not change"
    other = z.copy()
    other[headway] += 1
    change = np.asarray(sample(layout().from_normals(other)).driver.T) - np.asarray(before.driver.T)
    assert change[0] > 0 and (change[1:] == 0).all()
