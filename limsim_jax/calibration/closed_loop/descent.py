"""Descent of the distances by the medians and spreads of a population."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy.stats import truncnorm

from limsim_jax.calibration.closed_loop.chains import Chains
from limsim_jax.calibration.closed_loop.distances import (
    Distances,
    Samples,
    distances,
    edie,
    headway,
    simulate_samples,
)
from limsim_jax.calibration.parameters import BOX, PARAMETERS, Box
from limsim_jax.calibration.population import IDENTIFIED, Law
from limsim_jax.traffic.car_following import CarFollowing
from limsim_jax.traffic.vehicles import CUT, default_population, sample_vehicles

SPEED_LIMIT = 30.0
"""m/s, where the recording tells none; only the default population asks for it."""

WEIGHTS = {"headway": 1.0, "speed": 2.0, "gap": 1.0, "mean_speed": 1.0, "flow": 1.0}
"""Of the distances in the loss, each over the spread of its quantity: three of them tell of spacing, two of
speed."""

_TAME = 0.05  # weight of what the population has moved, in standard deviations of its parameters

Floats = NDArray[np.float64]


def scores(draws: int, drivers: int, seed: int) -> Float[Array, "K D P"]:
    """Standard normal scores of all drivers, cut at `CUT`."""
    rng = np.random.default_rng(seed)
    drawn = truncnorm.rvs(-CUT, CUT, size=(draws, drivers, len(PARAMETERS)), random_state=rng)
    return jnp.asarray(drawn, jnp.float32)


def drawn(
    mean: Float[Array, " P"], root: Float[Array, "P P"], z: Float[Array, "K D P"], box: Box = BOX
) -> Float[Array, "K D P"]:
    """Drivers with these scores: log-normal parameters within the box."""
    low, high, mean = (jnp.broadcast_to(jnp.asarray(x, z.dtype), z.shape) for x in (*box, mean))
    return jnp.clip(jnp.exp(mean + z @ root.T), low, high)


def default_drivers(draws: int, drivers: int, seed: int, speed_limit: float) -> Float[Array, "K D P"]:
    """Default drivers of cars in the simulator, in the order of `PARAMETERS`."""
    them = sample_vehicles(
        default_population({"car": 1.0}), jax.random.key(seed), jnp.arange(draws * drivers)
    )[0]
    v0 = jnp.minimum(them.speed_factor * speed_limit, them.v_max)
    return jnp.stack([v0, them.T, them.s0, them.a, them.b], -1).reshape(draws, drivers, -1)


class _Point(NamedTuple):
    """Where in the space of populations, seen from the start."""

    shift: Array  # [P], of the medians, in logarithms
    wider: Array  # [P], logarithm of the factor on the spreads


@partial(jax.jit, static_argnames=("model", "dt", "points", "iterations", "box"))
def descend(
    model: CarFollowing,
    mean: Array,
    root: Array,
    z: Array,
    chains: Chains,
    recorded: Samples,
    scale: Array,
    dt: float,
    points: int,
    iterations: int,
    box: Box,
) -> tuple[_Point, Array]:
    """Adam from the start; the best point and the losses."""

    def loss(point: _Point) -> Array:
        parameters = drawn(*moved(mean, root, point), z, box)
        gap, v = simulate_samples(model, parameters, chains, recorded, dt)
        found = distances(recorded, gap, v, points)
        tame = jnp.sum(point.shift**2 / jnp.sum(root * root, axis=-1)) + jnp.sum(point.wider**2)
        return jnp.sum(jnp.stack(found) * scale) + _TAME * tame

    def rate(count: Any) -> Any:
        return 0.03 * (1 + jnp.cos(jnp.pi / iterations * count.astype(mean.dtype)))

    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))

    def step(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], Array]:
        point, state, best, least = carry
        value, g = jax.value_and_grad(loss)(point)
        g = jax.tree.map(jnp.nan_to_num, g)
        better = value < least
        best = jax.tree.map(lambda x, y: jnp.where(better, x, y), point, best)
        updates, state = optimizer.update(g, state)
        return (optax.apply_updates(point, updates), state, best, jnp.minimum(value, least)), value

    zero = jnp.zeros_like(mean)
    point = _Point(zero, zero)
    with jax.numpy_dtype_promotion("standard"):  # optax counts in integers
        first = (point, optimizer.init(point), point, jnp.asarray(jnp.inf, mean.dtype))
        carry, losses = jax.lax.scan(step, first, None, length=iterations)
    return carry[2], losses


def moved(mean: Array, root: Array, point: _Point) -> tuple[Array, Array]:
    """Mean and root of the covariance of the log-parameters of a population."""
    return mean + point.shift, jnp.exp(point.wider)[:, None] * root


def usual_population(speed_limit: float) -> tuple[Floats, Floats]:
    """Mean and covariance of the log-parameters of the simulator's drivers."""
    drivers = np.log(np.asarray(default_drivers(64, 64, 0, speed_limit), float)).reshape(-1, len(PARAMETERS))
    return drivers.mean(axis=0), np.cov(drivers.T) + 1e-6 * np.eye(len(PARAMETERS))


def start_populations(law: Law, mean: Floats, covariance: Floats) -> list[tuple[Array, Array]]:
    """Means and roots of the covariances of log-parameters to start from: the law's, the simulator's.

    Of desired speeds that few of the drivers tell, as in congestion, the simulator's are taken in both.
    """
    own_mean, own = law.mean.copy(), law.covariance.copy()
    if law.identified[0] <= IDENTIFIED:
        own_mean[0], own[0], own[:, 0] = mean[0], 0.0, 0.0
        own[0, 0] = covariance[0, 0]
    return [
        (jnp.asarray(m, jnp.float32), jnp.asarray(np.linalg.cholesky(c), jnp.float32))
        for m, c in ((own_mean, own), (mean, covariance))
    ]


def loss_scale(recorded: Samples, weights: Mapping[str, float]) -> Array:
    """What the distances are multiplied with in the loss."""
    times = headway(recorded.gap, recorded.v, recorded.length_lead)
    q = edie(recorded, recorded.gap[None], recorded.v[None], int(recorded.point.max()) + 1)[1]
    speed = jnp.std(recorded.v)
    spread = jnp.stack([jnp.std(times), speed, jnp.std(recorded.gap), speed, 3600 * jnp.mean(q)])
    return jnp.asarray([weights[name] for name in Distances._fields]) / jnp.maximum(spread, 1e-3)


__all__ = [
    "SPEED_LIMIT",
    "WEIGHTS",
    "default_drivers",
    "descend",
    "drawn",
    "loss_scale",
    "moved",
    "scores",
    "start_populations",
    "usual_population",
]
