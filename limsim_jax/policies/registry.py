"""Policies by the names that experiment files and the command line use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from limsim_jax.policies.area import AreaOfInterest
from limsim_jax.policies.base import LikeTraffic, PolicyLike, build_policy
from limsim_jax.policies.delayed import Delayed
from limsim_jax.policies.end_to_end import EndToEnd
from limsim_jax.policies.language.driver import language
from limsim_jax.policies.language.rules import RuleTable
from limsim_jax.policies.limsim_tm import LimSimTM
from limsim_jax.policies.pdm import PDMClosed, PDMHybrid
from limsim_jax.policies.r157 import CarefulDriver, EmergencyBrake, FuzzyDriver, Regulation, RssDriver
from limsim_jax.policies.simple import ConstantSpeed, FollowLane


def area_of_interest(
    around: str | PolicyLike = "limsim_tm",
    ego: str | PolicyLike | None = None,
    slots: int = 8,
    radius: float = 50.0,
    leave: float | None = None,
    dwell: float = 3.0,
    options: Mapping[str, Any] | None = None,
) -> AreaOfInterest:
    """`AreaOfInterest` with planners by name; `options` are those of `around`.

    Raises:
      ValueError: an unknown name or option, or a value that makes no sense.
    """
    return AreaOfInterest(
        around=_by_name(around, options or {}),
        ego=None if ego is None else _by_name(ego, {}),
        slots=slots,
        radius=radius,
        leave=leave,
        dwell=dwell,
    )


def late(
    of: str | PolicyLike = "pdm_closed", delay: float = 0.5, options: Mapping[str, Any] | None = None
) -> Delayed:
    """`Delayed` with a planner by name; `options` are those of the planner.

    Raises:
      ValueError: an unknown name or option, or a value that makes no sense.
    """
    return Delayed(_by_name(of, options or {}), delay)


def _by_name(policy: str | PolicyLike, options: Mapping[str, Any]) -> PolicyLike:
    if not isinstance(policy, str):
        return policy
    if policy not in POLICIES or policy == "area_of_interest":
        known = ", ".join(name for name in POLICIES if name != "area_of_interest")
        raise ValueError(f"unknown policy '{policy}'; known are {known}")
    return build_policy(POLICIES[policy], options)


def _preset(factory: Callable[..., PolicyLike], **preset: Any) -> Callable[..., PolicyLike]:
    """The factory with some options set; it takes the others as before."""

    def build(**options: Any) -> PolicyLike:
        return build_policy(factory, preset | options)

    return build


POLICIES: dict[str, Callable[..., PolicyLike]] = {
    "like_traffic": LikeTraffic,
    "constant_speed": ConstantSpeed,
    "follow_lane": FollowLane,
    "pdm_closed": PDMClosed,
    "pdm_closed_rules": _preset(PDMClosed, rules=True),
    "pdm_hybrid": PDMHybrid,
    "limsim_tm": LimSimTM,
    "limsim_tm_privileged": _preset(LimSimTM, privileged=True, name="limsim_tm_privileged"),
    "area_of_interest": area_of_interest,
    "end_to_end": EndToEnd,
    "delayed": late,
    "rule_table": RuleTable,
    "language": language,
    "r157_careful": CarefulDriver,
    "r157_aeb": EmergencyBrake,
    "r157_regulation": Regulation,
    "r157_fsm": FuzzyDriver,
    "r157_rss": RssDriver,
}
"""Factories by name; other policies are named by module and factory, `package.module:factory`."""
