"""Drivers by which UN Regulation No. 157 tells whether a collision is preventable.

They keep lane, speed and distance as a lane-keeping system does, and brake when another vehicle becomes a
danger; none of them steers around it. What they do then is the difference: see the classes. Sources of
numbers, as named at the fields:

- R157: UN Regulation No. 157 (ALKS), ECE/TRANS/WP.29/2020/81: Annex 4, Appendix 3, or the paragraph named.
- esmini: values of its controller ALKS_R157SM, where the regulation gives none.
- FSM: Mattas et al., Fuzzy surrogate safety metrics for real-time assessment of rear-end collision risk,
  Accident Analysis & Prevention 148, 2020; performance model 2 of later versions of R157.
- RSS: Shalev-Shwartz, Shammah and Shashua 2017, arXiv 1708.06374.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass, field, fields
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from limsim_jax.maps.lane_map import LaneMap, width
from limsim_jax.policies.base import Policy
from limsim_jax.policies.reference import project_onto, reference_path
from limsim_jax.policies.simple import steer_along
from limsim_jax.traffic.bodies import body_place
from limsim_jax.traffic.command import Command
from limsim_jax.traffic.ego import Control, Limits
from limsim_jax.traffic.motion import boxes
from limsim_jax.traffic.outside import is_held
from limsim_jax.types import Config, State

GRAVITY = 9.81
"""m/s^2."""

_FAR = 1e3  # s or m
_CLOSING = 0.1  # m/s, from which a gap closes
_BUILDS = 0.6  # s, until the brake is fully on (R157)
_CROSSES = 0.7  # sine of the angle to the lane, from which a body crosses it
_TICK = 1e-4  # s, for times that are sums of steps
_STAND = 2.0  # m to the vehicle ahead at a standstill
_MILD = 2.0  # m/s^2, acceleration and braking without danger (esmini)
_FIRM = 4.0  # m/s^2, hardest braking without danger (esmini)
_AT_ONCE = 1e3  # m/s^3
_LIMITS = Limits()
_ABOVE = ("comfortable", "hardest", "leader", "deceleration", "lateral", "jerk", "range")

WANDERING = 0.375
"""m sideways that a vehicle in the middle of its lane may move (R157)."""


class Others(NamedTuple):
    """Other vehicles as an ego sees them along its way, `[E, N]`."""

    there: Bool[Array, "E N"]  # ahead, within its range, and not hidden by a vehicle in the lane
    gap: Float[Array, "E N"]  # m between the bodies along the way
    length: Float[Array, "E N"]  # m, of both bodies along the way
    aside: Float[Array, "E N"]  # m sideways between the middles
    beside: Float[Array, "E N"]  # m sideways between the bodies; negative: they overlap
    wrapped: Float[Array, "E N"]  # m that the narrower body lacks to lie within the other sideways
    inside: Float[Array, "E N"]  # m that a body is over the marking of the lane of the ego
    nears: Float[Array, "E N"]  # m/s sideways towards the ego
    v: Float[Array, "E N"]  # m/s along the way
    a: Float[Array, "E N"]  # m/s^2
    closing: Float[Array, "E N"]  # m/s
    ttc: Float[Array, "E N"]  # s to contact at the present speeds, unless the present braking avoids it
    headway: Float[Array, "E N"]  # s until the ego is where the vehicle is now
    crosses: Bool[Array, "E N"]  # points across the lane
    next: Bool[Array, "E N"]  # in the lane, or no longer in the middle of the next one


class Memory(NamedTuple):
    """What a driver remembers."""

    speed: Float[Array, " E"]  # m/s, to keep
    aside: Float[Array, "E N"]  # m sideways at the last decision
    farthest: Float[Array, "E N"]  # m sideways, most of all so far
    noticed: Float[Array, "E N"]  # s for which a vehicle has been a danger
    since: Float[Array, " E"]  # s since the danger was perceived; -1: there is none
    held: Float[Array, " E"]  # m/s^2, acceleration at that time
    brake: Float[Array, " E"]  # m/s^2, of the last decision
    second: Float[Array, " E"]  # as `since`, of a second system


@dataclass(frozen=True)
class Reference(Policy):
    """A reference driver of UN R157.

    Without danger it keeps its speed and a distance to the vehicle ahead: that of the intelligent driver
    model with the time gap that R157 5.2.3.3 asks for, and 4 m/s² at most. From a danger to the reaction it
    holds its acceleration and accelerates no more; then it brakes. The lag of the drive train is made up for.
    What is behind the vehicle ahead it sees once that leaves the lane.

    Attributes:
      follows: whether it keeps a distance without danger.
      range: m, within which it sees vehicles.
    """

    follows: bool = True
    range: float = 100.0  # esmini
    privileged: bool = field(default=True, kw_only=True)

    decision_time: ClassVar[float] = 0.1

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                continue
            if one.name in _ABOVE and not value > 0:
                raise ValueError(f"{one.name}: {value}; expected more than 0")
            if not value >= 0:
                raise ValueError(f"{one.name}: {value}; expected 0 or more")

    def init(self, config: Config, lane_map: LaneMap, state: State) -> Memory:
        """No danger, and the present speed."""
        v = state.v[state.egos.slot]
        aside = others(config, lane_map, state, None, self.range).aside
        none, zero = jnp.full_like(v, -1.0), jnp.zeros_like(v)
        return Memory(v, aside, aside, jnp.zeros_like(aside), none, zero, zero, none)

    def __call__(
        self, config: Config, lane_map: LaneMap, state: State, memory: Memory, key: jax.Array
    ) -> tuple[Command, Memory]:
        """Keep lane, speed and distance, or brake."""
        del key
        slot = state.egos.slot
        v, held = state.v[slot], is_held(state)[slot]
        now = others(config, lane_map, state, memory.aside, self.range)
        # a vehicle that has arrived in the lane comes from nowhere
        farthest = jnp.where(now.aside < WANDERING, now.aside, jnp.maximum(memory.farthest, now.aside))
        speed = jnp.where(held, v, memory.speed)
        memory = memory._replace(speed=speed, farthest=farthest)
        calm = self._calm(state, now, speed)
        memory, brake, waits = self.brake(config, state, now, memory, calm)
        memory = memory._replace(
            aside=now.aside,
            noticed=jnp.where(held[:, None], 0, memory.noticed),
            since=jnp.where(held, -1.0, memory.since),
            brake=jnp.where(held, 0, brake),
            second=jnp.where(held, -1.0, memory.second),
        )
        wish = jnp.where(waits, memory.held, jnp.where(brake > 0, jnp.minimum(calm, -brake), calm))
        wish = jnp.minimum(wish, -brake)
        a = _with_lag(config, state.egos.a, wish)
        return Command(control=Control(acceleration=a, steering=steer_along(lane_map, state))), memory

    @abstractmethod
    def brake(
        self, config: Config, state: State, now: Others, memory: Memory, calm: Float[Array, " E"]
    ) -> tuple[Memory, Float[Array, " E"], Bool[Array, " E"]]:
        """How hard it brakes until the next decision, m/s².

        Args:
          config: of the run.
          state: the world now.
          now: other vehicles.
          memory: before.
          calm: m/s², acceleration without danger.

        Returns:
          The memory, the braking (0 or more), and whether the driver has not reacted yet.
        """

    def _calm(self, state: State, now: Others, speed: Float[Array, " E"]) -> Float[Array, " E"]:
        """Acceleration without danger (m/s²)."""
        v = state.v[state.egos.slot]
        ratio = v / jnp.maximum(speed, 0.1)
        free = _MILD * (1 - jnp.minimum(ratio, 2.0) ** 4)
        wish = jnp.where(ratio > 1, jnp.maximum(speed - v, -_MILD), jnp.minimum(free, speed - v))
        if not self.follows:
            return wish
        ahead = now.there & (now.beside < 0)
        time_gap = 1.0 + 3.6 * v / 100.0  # R157 5.2.3.3
        approach = v[:, None] * now.closing / (2 * _MILD)
        wanted = _STAND + jnp.maximum(v[:, None] * time_gap[:, None] + approach, 0)
        near = _MILD * (1 - (wanted / jnp.maximum(now.gap, 0.1)) ** 2)
        near = jnp.where(ahead, near, _MILD).min(-1)
        return jnp.clip(jnp.minimum(wish, near), -_FIRM, _MILD)


@dataclass(frozen=True)
class CarefulDriver(Reference):
    """The careful and competent human driver of UN R157.

    It perceives a vehicle that comes over from another lane by how far that has moved sideways: beyond its
    wandering, for as long as perception takes at 1.8 m/s. A danger in its lane it perceives after a time: a
    vehicle that is too near in time, or that brakes hard within its headway. It reacts, and then the brake
    builds up. Its car has an emergency brake, too.

    Attributes:
      wandering: m sideways that a vehicle in its lane may move.
      perceived: m sideways beyond that, until one that comes over is perceived: 0.4 s at 1.8 m/s.
      perception: s, until any other danger is perceived.
      critical: s to contact, below which there is a danger.
      headway: s to a vehicle that brakes hard, below which there is a danger.
      hard: m/s^2, from which a vehicle brakes hard.
      reaction: s from the perceived danger to the brake.
      deceleration: m/s^2, hardest braking: 0.774 g.
      jerk: m/s^3, with which it builds up, within 0.6 s.
      release: m/s^2, deceleration before the brake, without the accelerator.
      emergency: whether the car has the brake of `EmergencyBrake`.
    """

    wandering: float = WANDERING  # R157
    perceived: float = 0.72  # R157
    perception: float = 0.4  # R157
    critical: float = 2.0  # R157
    headway: float = 2.0  # R157
    hard: float = 5.0  # R157
    reaction: float = 0.75  # R157
    deceleration: float = 0.774 * GRAVITY  # R157
    jerk: float = 0.774 * GRAVITY / _BUILDS  # R157
    release: float = 0.4  # esmini
    emergency: bool = True  # R157

    default_name = "r157_careful"

    def brake(
        self, config: Config, state: State, now: Others, memory: Memory, calm: Float[Array, " E"]
    ) -> tuple[Memory, Float[Array, " E"], Bool[Array, " E"]]:
        """After perception and reaction, as long as a gap closes."""
        moved = memory.farthest - now.aside
        comes = now.there & now.next & (moved >= self.wandering + self.perceived)
        crosses = now.there & now.crosses & (now.nears > 0) & (now.beside >= 0)
        seen = now.there & (now.beside < 0)
        near = now.ttc < self.critical
        brakes = seen & (now.a <= -self.hard) & (now.headway < self.headway)
        danger = ((seen | crosses) & near) | brakes
        noticed = jnp.where(danger, memory.noticed + config.decision_time, 0)
        aware = noticed - config.decision_time >= self.perception - _TICK
        found = ((comes & near) | (danger & aware)).any(-1)
        lasts = ((comes | seen | crosses) & (now.closing > _CLOSING)).any(-1)
        alert = (memory.noticed > 0).any(-1)
        memory = _timed(config, memory, found, lasts, jnp.minimum(calm, -self.release), alert)
        memory = memory._replace(noticed=noticed)
        brake = _ramp(config, memory.since, self.reaction, self.jerk, self.deceleration)
        if self.emergency:
            second, more = EmergencyBrake().second(config, now, memory.second)
            memory, brake = memory._replace(second=second), jnp.maximum(brake, more)
        perceives = (memory.since < 0) & danger.any(-1)
        return memory, brake, perceives | _waits(memory.since, self.reaction)


@dataclass(frozen=True)
class EmergencyBrake(Reference):
    """An automatic emergency brake, as UN R157 takes from UN R152.

    It brakes for a vehicle straight ahead, with the whole of the narrower body before the other.

    Attributes:
      critical: s to contact, below which it brakes.
      tolerance: m that the bodies may lack to that.
      deceleration: m/s^2: 0.85 g.
      jerk: m/s^3, with which it builds up, within 0.6 s.
    """

    critical: float = 1.5  # esmini
    tolerance: float = 0.2  # esmini
    deceleration: float = 0.85 * GRAVITY  # R157
    jerk: float = 0.85 * GRAVITY / _BUILDS  # R157

    default_name = "r157_aeb"

    def brake(
        self, config: Config, state: State, now: Others, memory: Memory, calm: Float[Array, " E"]
    ) -> tuple[Memory, Float[Array, " E"], Bool[Array, " E"]]:
        """At once, as long as a gap closes."""
        second, brake = self.second(config, now, memory.second)
        return memory._replace(second=second), brake, jnp.zeros_like(brake, bool)

    def second(
        self, config: Config, now: Others, since: Float[Array, " E"]
    ) -> tuple[Float[Array, " E"], Float[Array, " E"]]:
        """Time since it began (s, -1: it has not) and braking (m/s²)."""
        ahead = now.there & (now.wrapped <= self.tolerance)
        found = (ahead & (now.ttc < self.critical)).any(-1)
        lasts = (ahead & (now.closing > _CLOSING)).any(-1)
        since = _since(config, since, found, lasts)
        return since, _ramp(config, since, 0.0, self.jerk, self.deceleration)


@dataclass(frozen=True)
class Regulation(Reference):
    """The least that UN R157 asks of a system at a cut-in.

    By 5.2.5.2 a collision has to be avoided if, once a vehicle is over the marking, the time to contact is
    longer than `closing speed / (2 deceleration) + delay`: a delay, and then constant braking.

    Attributes:
      intrusion: m over the marking, from which a vehicle is in the lane.
      delay: s.
      deceleration: m/s^2.
      margin: s before the last moment at which it decides.
      range: m, within which it sees vehicles.
    """

    intrusion: float = 0.3  # R157 5.2.5.2
    delay: float = 0.35  # R157 5.2.5.2
    deceleration: float = 6.0  # R157 5.2.5.2
    margin: float = 0.2  # esmini: 0.1, and 0.1 for the time of a decision
    range: float = 46.0  # R157 7.1.1

    default_name = "r157_regulation"

    def brake(
        self, config: Config, state: State, now: Others, memory: Memory, calm: Float[Array, " E"]
    ) -> tuple[Memory, Float[Array, " E"], Bool[Array, " E"]]:
        """After the delay, as long as a gap closes."""
        inside = now.there & (now.inside > self.intrusion)
        bound = now.closing / (2 * self.deceleration) + self.delay + self.margin
        found = (inside & (now.ttc < bound)).any(-1)
        lasts = (inside & (now.closing > _CLOSING)).any(-1)
        memory = _timed(config, memory, found, lasts, jnp.minimum(calm, 0))
        brake = _ramp(config, memory.since, self.delay, _AT_ONCE, self.deceleration)
        return memory, brake, _waits(memory.since, self.delay)


@dataclass(frozen=True)
class FuzzyDriver(Reference):
    """The fuzzy safety model (FSM), performance model 2 of UN R157.

    Of a vehicle in its lane, or one that will be there before the ego has passed it, it tells how unsafe the
    distance is: by the proactive measure, if that one braked now, and by the critical measure, with the
    present speeds. Each goes from 0, where comfortable braking would do, to 1, where the hardest would not.
    It brakes accordingly after its reaction.

    Attributes:
      reaction: s.
      comfortable: m/s^2, braking that it likes.
      hardest: m/s^2, its hardest.
      leader: m/s^2, hardest braking of the vehicle ahead.
      margin: m at a standstill.
      late: s that a vehicle may come over later than the ego has passed.
      jerk: m/s^3, with which the brake builds up.
      range: m, within which it sees vehicles.
    """

    reaction: float = 0.75  # FSM
    comfortable: float = 4.0  # FSM
    hardest: float = 6.0  # FSM
    leader: float = 7.0  # FSM
    margin: float = 2.0  # FSM
    late: float = 0.1  # FSM
    jerk: float = 12.65  # FSM
    range: float = 46.0  # esmini

    default_name = "r157_fsm"

    def brake(
        self, config: Config, state: State, now: Others, memory: Memory, calm: Float[Array, " E"]
    ) -> tuple[Memory, Float[Array, " E"], Bool[Array, " E"]]:
        """After the reaction, as hard as the measures ask for."""
        slot = state.egos.slot
        v, a = state.v[slot][:, None], state.egos.a[:, None]
        closes = now.closing > _CLOSING
        passed = (now.gap + now.length) / jnp.maximum(now.closing, _CLOSING) + self.late
        comes = (now.nears > _CLOSING) & (now.beside / jnp.maximum(now.nears, _CLOSING) < passed)
        minded = now.there & closes & ((now.beside < 0) | comes)
        gap = jnp.maximum(now.gap, 0)
        proactive = jnp.where(minded, self.proactive(gap, v, now.v), 0).max(-1)
        critical = jnp.where(minded, self.critical(gap, v, now.v, a), 0).max(-1)
        found = (proactive > 0) | (critical > 0)
        memory = _timed(config, memory, found, found, jnp.minimum(calm, 0))
        asked = jnp.where(
            critical > 0,
            self.comfortable + critical * (self.hardest - self.comfortable),
            proactive * self.comfortable,
        )
        built = jnp.minimum(asked, memory.brake + self.jerk * config.decision_time)
        brake = jnp.where(memory.since >= self.reaction - _TICK, built, 0)
        return memory, brake, _waits(memory.since, self.reaction)

    def proactive(
        self, gap: Float[Array, "*b"], v: Float[Array, "*b"], lead: Float[Array, "*b"]
    ) -> Float[Array, "*b"]:
        """PFS: how unsafe a gap (m) is if the vehicle ahead brakes now, 0 to 1; speeds in m/s."""
        v, lead = jnp.maximum(v, 0), jnp.maximum(lead, 0)
        stop = v * self.reaction - lead * lead / (2 * self.leader)
        unsafe = stop + v * v / (2 * self.hardest)
        safe = stop + v * v / (2 * self.comfortable) + self.margin
        return jnp.clip((safe - (gap - self.margin)) / jnp.maximum(safe - unsafe, 1e-3), 0, 1)

    def critical(
        self,
        gap: Float[Array, "*b"],
        v: Float[Array, "*b"],
        lead: Float[Array, "*b"],
        a: Float[Array, "*b"],
    ) -> Float[Array, "*b"]:
        """CFS: how unsafe a gap (m) is at the present speeds (m/s) and acceleration (m/s²), 0 to 1."""
        a = jnp.maximum(a, -self.comfortable)
        after = v + a * self.reaction
        reacting = ((v + after) / 2 - lead) * self.reaction
        rest = jnp.maximum(after - lead, 0)
        safe = reacting + rest * rest / (2 * self.comfortable)
        unsafe = reacting + rest * rest / (2 * self.hardest)
        between = jnp.clip((safe - gap) / jnp.maximum(safe - unsafe, 1e-3), 0, 1)
        # it is slower than the vehicle ahead before its reaction
        soon = (v - lead) ** 2 / jnp.maximum(-2 * a, 1e-3)
        found = jnp.where(after < lead, (gap < soon).astype(v.dtype), between)
        return jnp.where(v > lead, found, 0)


@dataclass(frozen=True)
class RssDriver(Reference):
    """A driver that keeps the distances of RSS (responsibility-sensitive safety).

    A vehicle is a danger if it is nearer than the safe distances both along the lane and sideways. It brakes
    after the response time, until one of both distances is safe.

    Attributes:
      response: s.
      accelerate: m/s^2, hardest acceleration during the response.
      deceleration: m/s^2, braking of both vehicles.
      lateral: m/s^2, hardest acceleration and braking sideways.
      margin: m, for swaying sideways.
      jerk: m/s^3, with which the brake builds up.
    """

    response: float = 0.75  # esmini
    accelerate: float = 3.0  # esmini
    deceleration: float = 0.774 * GRAVITY  # esmini
    lateral: float = 1.0  # esmini
    margin: float = 0.3  # esmini
    jerk: float = 12.65  # esmini

    default_name = "r157_rss"

    def brake(
        self, config: Config, state: State, now: Others, memory: Memory, calm: Float[Array, " E"]
    ) -> tuple[Memory, Float[Array, " E"], Bool[Array, " E"]]:
        """After the response, as long as both distances are unsafe."""
        v = state.v[state.egos.slot][:, None]
        along = now.gap < self.along(v, jnp.maximum(now.v, 0))
        aside = now.beside < self.sideways(now.nears)
        found = (now.there & along & aside & (now.closing > _CLOSING)).any(-1)
        memory = _timed(config, memory, found, found, jnp.minimum(calm, 0))
        brake = _ramp(config, memory.since, self.response, self.jerk, self.deceleration)
        return memory, brake, _waits(memory.since, self.response)

    def along(self, v: Float[Array, "*b"], lead: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """Safe distance along the lane, m (RSS, Lemma 2); speeds in m/s."""
        after = v + self.response * self.accelerate
        way = (v + after) / 2 * self.response
        return jnp.maximum(way + (after * after - lead * lead) / (2 * self.deceleration), 0)

    def sideways(self, nears: Float[Array, "*b"]) -> Float[Array, "*b"]:
        """Safe distance sideways, m (RSS, Lemma 4); the other comes at `nears` m/s."""
        both = jnp.zeros_like(nears)
        for speed in (both, nears):
            after = speed + self.response * self.lateral
            both += (speed + after) / 2 * self.response + after * jnp.abs(after) / (2 * self.lateral)
        return self.margin + jnp.maximum(both, 0)


# --- what they share ---------------------------------------------------------------------------------


def others(
    config: Config, lane_map: LaneMap, state: State, before: Float[Array, "E N"] | None, reach: float
) -> Others:
    """Other vehicles along the ways of the egos.

    A vehicle in the way hides those behind it, unless it leaves.

    Args:
      config: of the run.
      lane_map: the map.
      state: the world now.
      before: m sideways at the last decision; None: nothing moves sideways.
      reach: m, within which they count.
    """
    slot = state.egos.slot
    box = boxes(lane_map, state)
    count, egos = box.shape[0], slot.shape[0]
    path = reference_path(lane_map, state)
    x, y = (jnp.broadcast_to(box[None, :, k], (egos, count)) for k in (0, 1))
    s, d, along = project_onto(path, x, y)
    mine = jnp.take_along_axis(d, slot[:, None], 1)
    turn = box[None, :, 2] - along
    c, z = jnp.abs(jnp.cos(turn)), jnp.abs(jnp.sin(turn))
    long, wide = box[None, :, 3], box[None, :, 4]
    own_long, own_wide = box[slot, 3][:, None], box[slot, 4][:, None]
    deep, breadth = c * long + z * wide, z * long + c * wide
    length = deep + own_long
    gap = s - length / 2
    aside = jnp.abs(d - mine)
    narrower = jnp.minimum(breadth, own_wide)
    beside = aside - (breadth + own_wide) / 2
    lane, place = body_place(lane_map, state, slot)
    half = width(lane_map, lane, place)[:, None] / 2
    v_ego, v = state.v[slot][:, None], state.v[None] * jnp.cos(turn)
    closing = v_ego - v
    nears = jnp.zeros_like(aside) if before is None else (before - aside) / config.decision_time
    other = state.active[None] & (jnp.arange(count)[None] != slot[:, None])
    there = other & (s > 0) & (gap < reach)
    in_way = there & (beside < 0)
    hides = in_way & ~((aside > WANDERING) & (nears < -_CLOSING))
    first = jnp.where(hides, gap, _FAR).min(-1, keepdims=True)
    there &= ~(in_way & (gap > first))
    near = jnp.maximum(gap, 0)
    ttc = near / jnp.maximum(closing, _CLOSING)
    avoided = closing * closing < -2 * state.egos.a[:, None] * near
    return Others(
        there=there,
        gap=gap,
        length=length,
        aside=aside,
        beside=beside,
        wrapped=narrower + beside,
        inside=half - (jnp.abs(d) - breadth / 2),
        nears=nears,
        v=v,
        a=jnp.broadcast_to(state.a[None], v.shape),
        closing=closing,
        ttc=jnp.where(there & (closing > _CLOSING) & ~avoided, ttc, _FAR),
        headway=near / jnp.maximum(v_ego, _CLOSING),
        crosses=z > _CROSSES,
        next=jnp.abs(d) < 2 * half - WANDERING,
    )


def _since(
    config: Config, since: Float[Array, " E"], found: Bool[Array, " E"], lasts: Bool[Array, " E"]
) -> Float[Array, " E"]:
    """Time since a danger was found (s); -1 once it does not last."""
    after = jnp.where((since >= 0) & (lasts | found), since + config.decision_time, -1.0)
    return jnp.where((after < 0) & found, 0.0, after)


def _timed(
    config: Config,
    memory: Memory,
    found: Bool[Array, " E"],
    lasts: Bool[Array, " E"],
    calm: Float[Array, " E"],
    alert: Bool[Array, " E"] | bool = False,
) -> Memory:
    """The memory with `since`, and the acceleration to hold in a danger.

    `alert`: whether the driver has noticed one before it perceives it."""
    known = (memory.since >= 0) | alert
    since = _since(config, memory.since, found, lasts)
    return memory._replace(since=since, held=jnp.where(known, memory.held, calm))


def _ramp(
    config: Config, since: Float[Array, " E"], wait: float, jerk: float, most: float
) -> Float[Array, " E"]:
    """Braking (m/s²) at the next decision: it builds up `wait` s after a danger."""
    built = jnp.clip(jerk * (since + config.decision_time - wait), 0, most)
    return jnp.where(since >= 0, built, 0)


def _waits(since: Float[Array, " E"], wait: float) -> Bool[Array, " E"]:
    """Whether there is a danger, but no reaction yet."""
    return (since >= 0) & (since < wait - _TICK)


def _with_lag(config: Config, now: Float[Array, " E"], wish: Float[Array, " E"]) -> Float[Array, " E"]:
    """The command (m/s²) for an acceleration at the next decision."""
    rest = math.exp(-config.decision_time / float(_LIMITS.acceleration_lag))
    return (wish - rest * now) / (1 - rest)
