"""A policy of two modules, named by experiments of tests."""

from dataclasses import dataclass, field

from limsim_jax.policies.simple import ConstantSpeed, FollowLane
from limsim_jax.policies.view import View


@dataclass(frozen=True)
class Blind(FollowLane):
    """It would keep its distance, but detects nothing."""

    view: View = field(default=View(misses=1.0), kw_only=True)
    privileged: bool = field(default=False, kw_only=True)


class Modular(ConstantSpeed):
    """As blind as before with one module replaced; with the other, it looks."""

    def variants(self, seen):
        return {"prediction": ConstantSpeed(), "planning": FollowLane()}
