"""Planners that drive the vehicles under test.

`POLICIES` has those that an experiment file can name; others are named by module and factory.
"""

from limsim_jax.policies.registry import POLICIES as POLICIES
