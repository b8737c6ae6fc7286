"""Probabilities of rare events of any function of random numbers."""

from limsim_jax.rare_events.estimate import RareEvent, rare_event

__all__ = ["RareEvent", "rare_event"]
