"""Demand: the vehicles on the road at the start, and those that enter later.

On the host `build_demand` turns `Flow`s and a density into a `Demand`, arrays for the device. From it
`sample_scenario` draws a world: a start state, and a `Schedule` with one queue per departure lane. While
a world runs, `enter` lets the first vehicle of every queue in when there is room; no vehicle is dropped.
"""

from limsim_jax.traffic.demand.arrays import NEVER, Demand, EgoStart
from limsim_jax.traffic.demand.build import build_demand
from limsim_jax.traffic.demand.departures import AT_ONCE, delayed, enter
from limsim_jax.traffic.demand.flows import Flow
from limsim_jax.traffic.demand.sample import overflow, sample_scenario
from limsim_jax.traffic.demand.tables import CHANGE_ROOM, CHANGE_TIME

__all__ = [
    "AT_ONCE",
    "CHANGE_ROOM",
    "CHANGE_TIME",
    "NEVER",
    "Demand",
    "EgoStart",
    "Flow",
    "build_demand",
    "delayed",
    "enter",
    "overflow",
    "sample_scenario",
]
