"""`RouteReward` by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

import limsim_jax as lj
from limsim_jax.api.env import Info


def info(**changes):
    """Two egos that drive 5 m of 100 m, soundly, unless told."""
    no = jnp.zeros(2, bool)
    values = {
        "progress": jnp.full(2, 5.0), "collided": no, "off_road": no, "arrived": no, "broken": no,
        "time": jnp.float32(1.0), "red_light": no, "route": jnp.full(2, 100.0), "speed": jnp.full(2, 10.0),
        "limit": jnp.full(2, 13.9), "acceleration": jnp.zeros(2), "closing": no,
    }  # fmt: skip
    first = {name: values[name].at[0].set(x) for name, x in changes.items()}
    return Info(**(values | first))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 0.5),
        ({"speed": 13.9 + 1.115}, 0.25),
        ({"speed": 20.0}, 0.0),
        ({"acceleration": -4.1}, 0.25),
        ({"acceleration": 2.5, "closing": True}, 0.125),
        ({"progress": -5.0, "closing": True}, -0.5),
        ({"route": jnp.nan}, 0.0),
        ({"collided": True}, -4.5),
        ({"off_road": True, "red_light": True}, -4.5),
        ({"broken": True, "progress": 0.0}, -5.0),
    ],
)
def test_the_route_counts_times_soft_penalties(changes, expected):
    reward, terms = lj.RouteReward()(info(), info(**changes))
    np.testing.assert_allclose(np.asarray(reward), [expected, 0.5], rtol=1e-3, atol=1e-6)
    assert all(x.shape == (2,) for x in terms.values())
    assert float(terms["infraction"][0]) == (expected <= -4)


def test_an_infraction_costs_once():
    hit = info(collided=True)
    reward, _ = lj.RouteReward(penalty=7.0)(hit, hit)
    np.testing.assert_allclose(np.asarray(reward), 0.5, rtol=1e-5)
