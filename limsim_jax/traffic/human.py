"""Human drivers: reaction time, errors of perception, anticipation.

The human driver model of Treiber, Kesting, Helbing, Physica A 360 (2006) 71, on top of any car-following
model. Its numbers are `HumanDriver`; without one, drivers see everything at once and without an error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from limsim_jax.traffic.car_following import NO_GAP, CarFollowing
from limsim_jax.traffic.motion import Decision, attentive, desired, seen
from limsim_jax.traffic.neighbors import Obstacles, Pair
from limsim_jax.types import Config, Driver, HumanMemory, State
from limsim_jax.xla import column_min

_LONGEST = 5.0  # s, of a reaction time
_FARTHEST = 10  # vehicles ahead
_ROLLS = 1.0  # m/s, below which drivers do not err in their acceleration


@dataclass(frozen=True)
class HumanDriver:
    """What sets human drivers apart from a car-following model. All static.

    The errors are those of the paper. The reaction time is chosen: below the time gap of the default drivers.

    Raises:
      ValueError: a number out of range.
    """

    reaction: float = 0.7
    """s, T': the acceleration follows from what was seen that long ago."""
    anticipates: bool = True
    """Within the reaction time a driver counts on its own acceleration and on an even speed of its leader."""
    vehicles_ahead: int = 1
    """n_a: vehicles that a driver looks at; T and s0 are reduced so that the gaps in equilibrium stay."""
    gap_error: float = 0.05
    """V_s: relative standard deviation of the gap that a driver sees."""
    approach_error: float = 0.01
    """1/s, r_c: standard deviation of the leader's speed that a driver sees, per metre of gap."""
    error_time: float = 20.0
    """s, tau: for how long errors last."""
    noise: float = 0.0
    """m^2/s^3, Q: intensity of a random acceleration, even between two decisions (Treiber, Kesting, Transp.
    Res. B 117 (2018) 613)."""

    def __post_init__(self) -> None:
        ranges = {
            "reaction": (0, _LONGEST), "vehicles_ahead": (1, _FARTHEST), "gap_error": (0, 1),
            "approach_error": (0, 1), "error_time": (1e-3, math.inf), "noise": (0, math.inf),
        }  # fmt: skip
        for name, (least, most) in ranges.items():
            value, whole = getattr(self, name), name == "vehicles_ahead"
            if not isinstance(value, int if whole else (int, float)):
                raise ValueError(f"{name} = {value!r}: must be a {'whole ' if whole else ''}number")
            if not least <= value <= most:
                upto = f" to {most}" if math.isfinite(most) else " or more"
                raise ValueError(f"{name} = {value}: must be {least}{upto}")

    @property
    def errs(self) -> bool:
        """Whether anything is random."""
        return self.gap_error > 0 or self.approach_error > 0 or self.noise > 0


def first_memory(human: HumanDriver, config: Config, n: int) -> HumanMemory:
    """Before the first decision, for `n` slots."""
    kept = math.ceil(human.reaction / config.dt - 1e-6)
    zero = jnp.zeros(n, jnp.float32)
    return HumanMemory(gap=zero, speed=zero, noise=zero, a=jnp.zeros((n, kept), jnp.float32))


def perceive(human: HumanDriver, config: Config, state: State, key: Key[Array, ""]) -> State:
    """Let the errors of all drivers go on until the next decision.

    Ornstein-Uhlenbeck processes of variance 1, stationary from the start.
    """
    if not human.errs:
        return state
    memory = _memory(state)
    stays = jnp.where(state.step == 0, 0, math.exp(-config.decision_time / human.error_time))
    new = jax.random.normal(key, (3, *state.s.shape))
    gap, speed = (
        stays * old + jnp.sqrt(1 - stays * stays) * x
        for old, x in zip((memory.gap, memory.speed), new[:2], strict=True)
    )
    return replace(state, human=replace(memory, gap=gap, speed=speed, noise=new[2]))


def vehicles_beyond(human: HumanDriver, state: State, own: Pair, lanes: Array) -> Obstacles | None:
    """Vehicles ahead of the leader, with the sum of the gaps between.

    A vehicle that leaves the way of the driver, or whose leader does, ends the look ahead.

    Args:
      human: how far.
      state: the world.
      own: leader of every vehicle.
      lanes: on the way of every vehicle, `[N, D]`.
    """
    if human.vehicles_ahead < 2:
        return None
    lead, gap, found = own.lead, own.lead_gap, []
    for _ in range(human.vehicles_ahead - 1):
        there = lead >= 0
        gap = jnp.where(there, gap + own.lead_gap[lead], NO_GAP)
        lead = jnp.where(there, own.lead[lead], -1)
        on_way = (state.lane[lead][:, None] == lanes).any(-1) & (gap < NO_GAP)
        lead, gap = jnp.where(on_way, lead, -1), jnp.where(on_way, gap, NO_GAP)
        found.append((lead, gap))
    return Obstacles(*(jnp.stack(x, -1) for x in zip(*found, strict=True)))


def _memory(state: State) -> HumanMemory:
    if state.human is None:
        raise ValueError("human drivers in a state without `human`: it comes from `first_memory`")
    return state.human


class _Situation(NamedTuple):
    """What a driver takes a situation to be, `[K, N]`."""

    gap: Array
    v: Array
    v_lead: Array
    a_lead: Array


@jax.named_scope("human")
def human_accelerations(
    human: HumanDriver,
    config: Config,
    model: CarFollowing,
    state: State,
    decision: Decision,
    x: Float[Array, " N"],
) -> tuple[Float[Array, " N"], HumanMemory]:
    """Acceleration (m/s^2) of every vehicle, and what drivers remember.

    Vehicles are followed with errors and late. Places to stop are known: drivers plan for them.

    Args:
      human: the drivers.
      config: of the run.
      model: car following.
      state: the world.
      decision: the last one.
      x: m travelled since then.
    """
    found, v0 = seen(state, decision.obstacles, x), desired(state, decision, x)
    driver, v_free = jax.tree.map(lambda value: value[None], (state.driver, v0))

    def least(drivers: Driver, situation: _Situation) -> Array:
        return model(drivers, **situation._asdict(), v0=v_free)

    gap = jnp.where(found.moving, found.gap, NO_GAP)
    followed = _Situation(
        gap, state.v[None], jnp.where(found.moving, found.v_lead, state.v[None]), found.a_lead
    )
    followed = _taken_for(human, state, followed)
    if decision.beyond is None:
        wish = column_min(least(driver, followed))
    else:
        beyond = seen(state, decision.beyond, x)
        further = _taken_for(
            human, state, _Situation(beyond.gap, state.v[None], beyond.v_lead, beyond.a_lead)
        )
        wish = _together(least, driver, followed, further)
    line = jnp.where(found.moving, NO_GAP, found.gap)
    place = _Situation(
        line, state.v[None], jnp.where(found.moving, state.v[None], found.v_lead), found.a_lead
    )
    stops = column_min(least(driver, place))
    memory, late = _late(human, config, state, wish)
    if human.noise:
        late += jnp.where(state.v > _ROLLS, math.sqrt(human.noise / config.decision_time) * memory.noise, 0)
        late = jnp.clip(late, -state.driver.b_max, state.driver.a)
    return attentive(model, state, decision, x, jnp.minimum(late, stops), line), memory


def _taken_for(human: HumanDriver, state: State, true: _Situation) -> _Situation:
    """A situation with errors, as expected after the reaction time."""
    gap, v, v_lead, a_lead = true
    there, memory = gap < NO_GAP, _memory(state)
    if human.approach_error:
        v_lead = jnp.where(there, v_lead + gap * human.approach_error * memory.speed[None], v)
    if human.gap_error:
        gap = jnp.where(there, gap * jnp.exp(human.gap_error * memory.gap[None]), NO_GAP)
    if human.anticipates:
        change = human.reaction * state.a[None]
        gap = jnp.where(there, gap + human.reaction * (v_lead - v), NO_GAP)
        v_lead, v = jnp.maximum(v_lead + change, 0), jnp.maximum(v + change, 0)
    return _Situation(gap, v, jnp.maximum(v_lead, 0), a_lead)


def _together(
    least: Callable[[Driver, _Situation], Array], driver: Driver, followed: _Situation, further: _Situation
) -> Array:
    """The sum of what several vehicles ahead ask for, after the paper.

    The first column of `followed` is the leader on the own lane. T and s0 are divided by the square root of
    the sum of 1 / m^2 over the vehicles m that are there.
    """
    there = further.gap < NO_GAP
    m = jnp.arange(2, 2 + there.shape[0], dtype=further.gap.dtype)[:, None]
    root = jnp.sqrt(1 + jnp.where(there, 1 / (m * m), 0).sum(0))[None]
    close = replace(driver, T=driver.T / root, s0=driver.s0 / root)
    leader = _Situation(*(x[:1] for x in followed))
    free = least(close, leader._replace(gap=jnp.full_like(leader.gap, NO_GAP)))
    more = jnp.where(there, least(close, further) - free, 0).sum(0)
    others = column_min(least(driver, followed._replace(gap=followed.gap.at[0].set(NO_GAP))))
    return jnp.minimum(others, least(close, leader)[0] + more)


def _late(
    human: HumanDriver, config: Config, state: State, wish: Float[Array, " N"]
) -> tuple[HumanMemory, Float[Array, " N"]]:
    """What drivers remember, and what they wanted a reaction time ago (m/s^2).

    A vehicle that has just entered has no past: it drives as it wants to now.
    """
    memory = _memory(state)
    past, whole = jnp.concatenate([wish[:, None], memory.a], -1), memory.a.shape[1]
    part = whole - human.reaction / config.dt  # of a step
    late = past[:, whole] if whole == 0 else (1 - part) * past[:, whole] + part * past[:, whole - 1]
    new = config.time(state.step) - state.entered < human.reaction
    return replace(memory, a=past[:, :whole]), jnp.where(new, wish, late)
