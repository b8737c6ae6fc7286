"""What drives the vehicles under test.

`POLICIES` has those that an experiment file can name; others are named by module and factory.
"""

from __future__ import annotations

from collections.abc import Callable

from limsim_jax.policies.area import AreaOfInterest
from limsim_jax.policies.base import LikeTraffic, Policy
from limsim_jax.policies.limsim_tm import LimSimTM
from limsim_jax.policies.pdm import PDMClosed, PDMHybrid
from limsim_jax.policies.simple import ConstantSpeed, FollowLane

POLICIES: dict[str, Callable[..., Policy]] = {
    "like_traffic": LikeTraffic,
    "constant_speed": ConstantSpeed,
    "follow_lane": FollowLane,
    "pdm_closed": PDMClosed,
    "pdm_hybrid": PDMHybrid,
    "limsim_tm": LimSimTM,
    "area_of_interest": AreaOfInterest,
}
