"""Short policies of one's own: one in JAX, and one on the host.

The README and `limsim_jax.policies.host` show them. With this folder on the path an experiment can name them:

    PYTHONPATH=experiments limsim-jax bench policy roundabout --policy own_policies:Cautious
    PYTHONPATH=experiments limsim-jax bench policy roundabout --policy own_policies:follower
"""
# ruff: noqa: D101, D102, D103

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from limsim_jax.maps.signal_table import SignalState
from limsim_jax.policies.base import Policy
from limsim_jax.policies.host import HostPolicy
from limsim_jax.policies.reference import reference_path
from limsim_jax.traffic.command import Command


@dataclass(frozen=True)
class Cautious(Policy):
    share: float = 0.8  # of the speed limit

    def __call__(self, config, lane_map, state, memory, key):
        path = reference_path(lane_map, state)
        v = jnp.minimum(state.v[state.egos.slot], self.share * path.limit[:, 0])[:, None]
        s = v * 0.2 * jnp.arange(16.0)[None]  # m, in 3 s
        trajectory = path.trajectory(s, v, t0=config.time(state.step), dt=0.2)
        return Command(trajectory=trajectory), memory


def follow(seen):
    x, y = seen.way_x[..., 5] + seen.wheelbase / 2, seen.way_y[..., 5]  # 10 m ahead, from the rear axle
    steering = np.arctan(2 * seen.wheelbase * y / (x * x + y * y))
    ahead = seen.there & (np.abs(seen.other_y) < 1.5) & (seen.other_x > 0)
    gap = np.where(ahead, seen.other_x - (seen.other_length + seen.length[..., None]) / 2, 1e6)
    first = gap.argmin(-1)[..., None]
    gap = np.maximum(np.take_along_axis(gap, first, -1)[..., 0], 0.1)
    closing = np.where(gap < 1e5, seen.v - np.take_along_axis(seen.other_v, first, -1)[..., 0], 0)
    stops = (seen.light <= SignalState.YELLOW) & (seen.light_distance < gap)
    gap, closing = np.where(stops, seen.light_distance, gap), np.where(stops, seen.v, closing)
    wish = np.maximum(2 + 1.2 * seen.v + seen.v * closing / (2 * 3**0.5), 0)
    a = 1.5 * (1 - (seen.v / seen.limit) ** 4 - (wish / gap) ** 2)
    return {"acceleration": np.clip(a, -8, 1.5), "steering": steering}


def follower():
    return HostPolicy(follow)
