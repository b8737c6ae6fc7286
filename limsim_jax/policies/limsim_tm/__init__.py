"""LimSim-TM: predict, decide by search, plan trajectories; for egos and for traffic around them."""

from limsim_jax.policies.limsim_tm.policy import LimSimTM as LimSimTM
