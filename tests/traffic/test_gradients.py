"""Gradients of traffic through junctions, with empty slots and standing queues."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from traffic_worlds import bundled, scattered

from limsim_jax.traffic.car_following import IDM
from limsim_jax.traffic.engine import Traffic, drive
from limsim_jax.types import Config

pytestmark = pytest.mark.engine

CONFIG = Config(dt=0.1)
TRAFFIC = Traffic(IDM(), lane_changes=False)


def test_through_junctions_with_queues_and_empty_slots():
    _, lane_map = bundled("intersection")
    start = scattered("intersection", 20, seed=3, spacing=18.0, v=7.0)
    rng = np.random.default_rng(0)
    standing = jnp.asarray(rng.random(20) < 0.4)
    there = jnp.asarray(np.arange(20) < 17)
    start = dataclasses.replace(start, active=there, v=jnp.where(standing, 0.0, start.v))

    def travelled(T):
        state = dataclasses.replace(start, driver=dataclasses.replace(start.driver, T=T))
        end, _ = jax.lax.scan(
            lambda state, _: drive(CONFIG, TRAFFIC, lane_map, state), state, None, length=12
        )
        return jnp.sum(jnp.where(there, end.distance, 0.0)), end

    T = jnp.asarray(rng.uniform(1.0, 1.6, 20), jnp.float32)
    (_, end), gradient = jax.jit(jax.value_and_grad(travelled, has_aux=True))(T)
    gradient = np.asarray(gradient)
    assert np.isfinite(gradient).all(), "everywhere, whatever stands and whichever slot is empty"
    assert not gradient[17:].any()
    crossed = np.asarray((end.lane != start.lane) & end.active)
    queued = np.asarray((end.v < 0.5) & end.active)
    assert crossed.sum() >= 3 and queued.sum() >= 2, "the world has what the test is about"

    # forwards as backwards
    push = jnp.asarray(rng.normal(size=20), jnp.float32)
    _, along, _ = jax.jit(lambda T: jax.jvp(travelled, (T,), (push,), has_aux=True))(T)
    np.testing.assert_allclose(float(along), float(gradient @ np.asarray(push)), rtol=2e-3, atol=1e-3)

    # where nothing discrete flips within the step, the slope is that of finite differences
    many = jax.jit(jax.vmap(lambda T: travelled(T)[0]))
    h = 0.02
    steps = jnp.eye(20)[:17] * h
    slope = np.asarray(many(T[None] + steps) - many(T[None] - steps)) / (2 * h)
    matters = np.abs(gradient[:17]) > 0.05
    close = np.abs(slope - gradient[:17]) < 0.05 * np.abs(slope) + 0.02
    assert matters.sum() >= 4 and (close & matters).sum() >= 0.75 * matters.sum(), (gradient[:17], slope)
