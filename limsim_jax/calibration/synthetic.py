"""Followers whose drivers are known: what a calibration should find, and how sure it should be."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from limsim_jax.calibration.cleaning import Segment
from limsim_jax.calibration.fit import Data, rollout
from limsim_jax.calibration.parameters import PARAMETERS
from limsim_jax.traffic.car_following import IDM, CarFollowing

TYPICAL = (16.0, 1.2, 2.2, 1.3, 2.0)
"""v0, T, s0, a, b in towns."""

Floats = NDArray[np.float64]


def leader_speed(samples: int, dt: float, rng: np.random.Generator) -> Floats:
    """Cruise, slow traffic, a stop and a start again, m/s: what it takes to identify all parameters."""
    t = np.arange(samples) * dt
    cruise = np.interp(t, [0, 20, 21, 26, 40, 46, 60, 75, 1e3], [14, 15, 15, 4, 4, 0, 0, 13, 14])
    wave = np.sin(2 * np.pi * t / rng.uniform(9, 17) + rng.uniform(0, 6))
    return np.maximum(cruise + wave * np.interp(t, [0, 42, 44, 62, 66], [1, 1, 0, 0, 1]), 0)


def drivers(count: int, spread: float, rng: np.random.Generator) -> Floats:
    """Parameters `[count P]`, log-normal around `TYPICAL`."""
    return np.asarray(TYPICAL) * np.exp(rng.normal(0, spread, (count, len(PARAMETERS))))


def follow(
    parameters: Floats,
    rng: np.random.Generator,
    *,
    samples: int = 896,
    dt: float = 0.1,
    noise: float = 0.3,
    memory: float = 0.95,
    model: CarFollowing = IDM(),
) -> list[Segment]:
    """One segment per driver, behind leaders that cruise, crawl, stop and start.

    Args:
      parameters: of the drivers, `[D P]`.
      rng: draws leaders and errors.
      samples: per segment; 900 or so hold it all.
      dt: s.
      noise: m, standard deviation of the error of the gap.
      memory: its correlation from one sample to the next.
      model: of car following, that drives.
    """
    lead = np.stack([leader_speed(samples, dt, rng) for _ in parameters])
    start = np.zeros(lead.shape)
    start[:, 0] = 1
    first = 18 + parameters[:, 2:3]
    values = {
        "gap": np.broadcast_to(first, lead.shape),
        "v": np.broadcast_to(lead[:, :1], lead.shape),
        "v_lead": lead,
        "a_lead": np.diff(lead, prepend=lead[:, :1], axis=1) / dt,
        "start": start,
        "weight": np.ones(lead.shape),
    }
    data = Data(**{name: jnp.asarray(x, jnp.float32) for name, x in values.items()})
    run = jax.jit(jax.vmap(lambda p, data: rollout(model, p, data, dt)))
    gap, v = (np.asarray(x, float) for x in run(jnp.asarray(parameters, jnp.float32), data))
    error = np.empty(lead.shape)
    error[:, 0] = rng.normal(0, noise, len(lead))
    for k in range(1, samples):
        error[:, k] = memory * error[:, k - 1] + rng.normal(0, noise * np.sqrt(1 - memory**2), len(lead))
    return [
        Segment(
            driver=f"{i:03d}",
            leader="leader",
            source="made up",
            line=1,
            dt=dt,
            time=0.0,
            vehicle_class=0,
            gap=gap[i] + error[i],
            v=v[i],
            v_lead=lead[i],
        )
        for i in range(len(lead))
    ]


__all__ = ["TYPICAL", "drivers", "follow", "leader_speed"]
