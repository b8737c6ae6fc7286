"""Differential evolution (Storn, Price 1997) of all drivers at once: a yardstick of `calibration.fit`.

best/1/bin with dithering; needs no gradients.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key
from scipy.stats import qmc

from limsim_jax.calibration.cleaning import Segment
from limsim_jax.calibration.fit import Data, Fit, Problem, cost, stack
from limsim_jax.calibration.parameters import BOX, PARAMETERS
from limsim_jax.traffic.car_following import IDM, CarFollowing

MEMBERS = 15
"""Points of a driver per parameter."""


def fit_by_evolution(
    segments: Sequence[Segment],
    model: CarFollowing = IDM(),
    *,
    objective: str = "mixed",
    generations: int = 100,
    seed: int = 0,
    samples: int = 0,
) -> Fit:
    """A fit of every driver on its own; arguments and errors as of `calibration.fit.fit`."""
    begin = time.perf_counter()
    drivers, data, dt = stack(segments, samples)
    data = jax.tree.map(jnp.asarray, data)
    count, size = len(drivers), len(PARAMETERS)
    members = MEMBERS * size
    u = qmc.LatinHypercube(size, rng=seed).random(members * count).reshape(count, members, size)
    u, costs = _differential_evolution(
        Problem(model, objective, dt), jnp.asarray(u, jnp.float32), data, jax.random.key(seed), generations
    )
    error = np.sqrt(np.asarray(costs, float))
    return Fit(
        model=model, objective=objective, method="de", drivers=drivers,
        parameters=BOX.parameters(np.asarray(u, float)), error=error, starts=error[:, None],
        seconds=time.perf_counter() - begin,
    )  # fmt: skip


@partial(jax.jit, static_argnames=("problem",))
def _differential_evolution(
    problem: Problem, u: Array, data: Data, key: Key[Array, ""], generations: int
) -> tuple[Array, Array]:
    """best/1/bin with dithering from populations `u [D, M, P]`; best points and costs."""
    size = u.shape[-2]

    def evolve(u: Array, key: Array, data: Data) -> tuple[Array, Array]:
        def generation(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            u, costs = carry
            keys = jax.random.split(jax.random.fold_in(key, k), 5)
            # Two others, unlike each other and the member itself: offsets around the circle.
            one = jax.random.randint(keys[0], (size,), 1, size)
            other = 1 + (one - 1 + jax.random.randint(keys[1], (size,), 1, size - 1)) % (size - 1)
            at = jnp.arange(size)
            strength = jax.random.uniform(keys[2], (), u.dtype, 0.5, 1.0)
            best = jnp.broadcast_to(u[jnp.argmin(costs)], u.shape)
            mutant = best + strength * (u[(at + one) % size] - u[(at + other) % size])
            inside = (mutant >= 0) & (mutant <= 1)
            mutant = jnp.where(inside, mutant, jax.random.uniform(keys[3], u.shape, u.dtype))
            cross = jax.random.uniform(keys[4], (size, u.shape[-1] + 1), u.dtype)
            forced = jnp.floor(cross[:, -1:] * u.shape[-1]) == jnp.arange(u.shape[-1], dtype=u.dtype)[None]
            trial = jnp.where((cross[:, :-1] < 0.7) | forced, mutant, u)
            found = jax.vmap(lambda one: cost(problem, one, data))(trial)
            better = found <= costs
            return jnp.where(better[:, None], trial, u), jnp.where(better, found, costs)

        first = (u, jax.vmap(lambda one: cost(problem, one, data))(u))
        u, costs = jax.lax.fori_loop(0, generations, generation, first)
        best = jnp.argmin(costs)
        return u[best], costs[best]

    return jax.vmap(evolve)(u, jax.random.split(key, u.shape[0]), data)
