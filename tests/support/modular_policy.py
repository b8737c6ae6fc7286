"""A policy of two modules, named by experiments of tests."""

from limsim_jax.policies.simple import ConstantSpeed, FollowLane


class Modular(ConstantSpeed):
    """As blind as before with one module replaced; with the other, it looks."""

    def variants(self, seen):
        return {"prediction": ConstantSpeed(), "planning": FollowLane()}
