"""What a vehicle along a road does, as the ego sees it: where it starts, and its actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from limsim_jax.scenarios.instructions.intent import Act, Actor, InstructionError, Intent, middle

FIRST = 4.0
"""s after the start at which the first act begins, unless the instruction says when."""

CUT_IN = 12.0
"""m to the ego at which a vehicle cuts in."""

FOLLOWS, CLOSE = 1.5, 0.5
"""s behind the one ahead: of vehicles that follow, and of one that tailgates."""

CHANGE = 3.0
"""s that a lane change takes."""

QUICKEST = 1.5
"""s that a lane change takes at least: of a vehicle that is much faster than the ego, and stays near."""

SLOWER = 3.0
"""m/s by which a vehicle that cuts in is slower than the ego."""

STEADY = 4.0
"""m/s^2, braking without a word about it."""

SLOWED = 0.4
"""Share of its speed that a vehicle keeps which brakes, but not to a stop."""

STANDS, COMFORT = 4.0, 2.5
"""s that the ego has before it must brake for a standing vehicle, and m/s^2 with which."""

CLEARS = 5.0
"""s from the ego to a standing vehicle behind one that cuts out."""

OVERTAKES = 25.0
"""m behind the ego at which a vehicle starts that overtakes."""

BESIDE = 2.0
"""m ahead of the ego before which no vehicle that overtakes changes lanes."""

EGO = 5.0
"""m, length of the ego."""

LENGTHS = {
    "car": 5.0, "van": 6.0, "truck": 14.0, "bus": 13.0, "motorcycle": 2.5, "emergency": 6.5, "obstacle": 4.0,
}  # fmt: skip
"""m, for distances from middle to middle and for room; at least those of the vehicles."""

SIDES = {"left": 1, "right": -1, "same": 0, None: 0}
"""Lanes to the left of the ego."""

_TURNS = {1: "left", -1: "right"}


@dataclass(frozen=True)
class Tuning:
    """What repairs change.

    Attributes:
      earlier: s by which other vehicles are ahead of their time at a junction or ramp.
      nearer: factor on distances to the ego that the instruction does not say.
      severe: factor on all distances to the ego.
      later: s by which the first act is delayed.
      which: number of the place among those that fit.
    """

    earlier: float = 0.0
    nearer: float = 1.0
    severe: float = 1.0
    later: float = 0.0
    which: int = 0


@dataclass
class Plan:
    """A vehicle along a road, as the ego sees it.

    Attributes:
      front: m from the front of the ego to that of the vehicle.
      side: lanes to the left of the ego.
      v: m/s.
      length: m.
      actions: of the script.
      moves: lanes to the left by which it changes.
      driver: parameters that differ.
    """

    front: float
    side: int
    v: float
    length: float
    actions: list[dict[str, Any]] = field(default_factory=list)
    moves: int = 0
    driver: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Case:
    """What plans are made from.

    Attributes:
      actor: the vehicle.
      act: its leading act.
      ego: m/s of the ego.
      v: m/s of the vehicle.
      time: s of its first act.
      gap: m to the ego at the start, where the instruction says it.
      length: m.
      tuning: repairs.
      stands: m from the ego to the tail of a standing vehicle of another actor; None: there is none.
    """

    actor: Actor
    act: Act
    ego: float
    v: float
    time: float
    gap: float | None
    length: float
    tuning: Tuning
    stands: float | None

    @property
    def kinds(self) -> list[str]:
        return [act.kind for act in self.actor.acts]

    @property
    def holds(self) -> dict[str, Any]:
        """The order to hold its speed."""
        return {"speed": round(self.v, 2)}

    def ahead(self, otherwise: float) -> float:
        """m to the front of a vehicle ahead of the ego."""
        asked = self.gap if self.act.gap is None else middle(self.act.gap, 0.0)
        return self.scaled(otherwise, asked) + self.length

    def behind(self, otherwise: float) -> float:
        """m to the front of a vehicle that starts behind the ego: negative."""
        return -self.scaled(otherwise, self.gap) - EGO

    def scaled(self, otherwise: float, asked: float | None) -> float:
        """m that the instruction says, or that are usual, after repairs."""
        return self.tuning.severe * (otherwise * self.tuning.nearer if asked is None else asked)

    def plan(self, front: float, side: int, **more: Any) -> Plan:
        return Plan(**({"front": front, "side": side, "v": self.v, "length": self.length} | more))


# ---- by the leading act


def _stand(case: _Case) -> Plan:
    room = case.ego**2 / (2 * COMFORT) + STANDS * case.ego if case.stands is None else case.stands
    stays = [{"stop": True, "careful": False}]
    return case.plan(case.ahead(room), SIDES[case.actor.lane], v=0.0, actions=stays)


def _cut_in(case: _Case) -> Plan:
    """Into the ego's lane ahead of it: from ahead if it is slower, from behind if it is faster."""
    asked = None if case.act.gap is None else middle(case.act.gap, CUT_IN)
    near = case.scaled(CUT_IN, asked)
    side = SIDES[case.actor.lane] or SIDES[case.act.side] or 1
    faster = case.v - case.ego
    move: dict[str, Any] = {"change_lane": _TURNS[-side], "duration": CHANGE}
    if "overtake" in case.kinds:
        front, passes = case.behind(OVERTAKES), max(faster, 1.0)
        middle_at = (near + case.length - front) / passes
        move["duration"] = round(min(max(2 * (near - BESIDE) / passes, QUICKEST), CHANGE), 2)
        past = (BESIDE + case.length - front) / passes
        move["at"] = round(max(middle_at - move["duration"] / 2, past), 2)
    elif faster < -0.5:
        front = max(near - faster * case.time if case.gap is None else case.gap, near + 1) + case.length
        move["within"] = round(near + (case.length + EGO) / 2, 2)
    else:
        front = (near - faster * case.time if case.gap is None else case.gap) + case.length
        move["at"] = round(max(case.time - CHANGE / 2, 0.0), 2)
    hold = case.holds | {"careful": faster <= 0.5}
    return case.plan(front, side, moves=-side, actions=[hold, move])


def _cut_out(case: _Case) -> Plan:
    """Out of the ego's lane, if something stands there in good time."""
    side = SIDES[case.act.side] or 1
    front = case.ahead(FOLLOWS * case.ego)
    move: dict[str, Any] = {"change_lane": _TURNS[side], "duration": CHANGE}
    if case.stands is None:
        move["at"] = round(case.time, 2)
    else:
        room = case.stands - front - (CHANGE + 0.5) * case.v
        if room <= 0:
            raise InstructionError(
                f"what stands is too near for a vehicle to cut out before it at {case.v:.0f} m/s"
            )
        move["travelled"] = round(room, 1)
    hold = case.holds | {"careful": case.stands is None}
    return case.plan(front, 0, moves=side, actions=[hold, move])


def _change_lane(case: _Case) -> Plan:
    moves = SIDES[case.act.side] or -SIDES[case.actor.lane] or 1
    side, front = SIDES[case.actor.lane], case.ahead(FOLLOWS * case.ego)
    if case.actor.place == "beside":
        side, front = side or moves, 0.0
    move = {"change_lane": _TURNS[moves], "duration": CHANGE, "at": round(case.time, 2)}
    return case.plan(front, side, moves=moves, actions=[case.holds, move])


def _overtake(case: _Case) -> Plan:
    return case.plan(case.behind(OVERTAKES), SIDES[case.actor.lane] or 1, actions=[case.holds])


def _tailgate(case: _Case) -> Plan:
    driver = {"T": CLOSE, "s0": 1.0, "speed_factor": 1.2}
    return case.plan(case.behind(CLOSE * case.ego), SIDES[case.actor.lane], v=case.ego, driver=driver)


def _drive(case: _Case) -> Plan:
    """Ahead, unless the instruction says otherwise; a slower one is further away."""
    side = SIDES[case.actor.lane]
    if case.actor.place == "beside":
        return case.plan(0.0, side or 1, actions=[case.holds])
    if case.actor.place == "behind":
        return case.plan(case.behind(FOLLOWS * case.ego), side, actions=[case.holds])
    room = FOLLOWS * case.ego + max(case.ego - case.v, 0.0) * 2 * FIRST
    return case.plan(case.ahead(room), side, actions=[case.holds])


_LEADING: dict[str, Callable[[_Case], Plan]] = {
    "stand": _stand, "cut_in": _cut_in, "cut_out": _cut_out, "overtake": _overtake, "tailgate": _tailgate,
    "change_lane": _change_lane,
}  # fmt: skip
"""Plans by the first of these acts that a vehicle has; all others drive."""


# ---- plans


def speed_of(actor: Actor, ego: float, otherwise: float = 0.0) -> float:
    """m/s of a vehicle; unless it is said, `otherwise` more than the ego."""
    if actor.speed is not None:
        return middle(actor.speed, 0.0)
    return max(ego + middle(actor.faster, otherwise), 1.0)


def plan(actor: Actor, ego: float, tuning: Tuning, intent: Intent) -> Plan:
    """A vehicle along a road.

    Args:
      actor: the vehicle.
      ego: m/s of the ego.
      tuning: repairs.
      intent: the others.

    Raises:
      InstructionError: it does what is possible at a junction only.
    """
    kinds = [act.kind for act in actor.acts]
    bad = [kind for kind in kinds if kind in ("cross", "turn_across", "run_red", "merge")]
    if bad or actor.place == "oncoming":
        word = bad[0].replace("_", " ") if bad else "oncoming"
        raise InstructionError(f"'{word}' needs a junction or a ramp, not a stretch of road")
    lead = next((kind for kind in _LEADING if kind in kinds), kinds[0] if kinds else "drive")
    act = actor.acts[kinds.index(lead)] if kinds else Act(kind="drive")
    case = _Case(
        actor=actor, act=act, ego=ego, tuning=tuning,
        v=speed_of(actor, ego, -SLOWER if lead == "cut_in" else 0.0),
        time=next((act.at for act in actor.acts if act.at is not None), FIRST + tuning.later),
        gap=None if actor.gap is None else middle(actor.gap, 0.0),
        length=LENGTHS[actor.kind], stands=_stands_at(actor, intent, ego),
    )  # fmt: skip
    found = _LEADING.get(lead, _drive)(case)
    found.actions += _speeds(actor, found.v, case.time, len(found.actions) > 1)
    return found


def _stands_at(actor: Actor, intent: Intent, ego: float) -> float | None:
    """m from the ego to what a vehicle cuts out before; None: nothing."""
    kinds = {id(x): [act.kind for act in x.acts] for x in intent.actors}
    standing = [x for x in intent.actors if "stand" in kinds[id(x)]]
    if not standing or not any("cut_out" in found for found in kinds.values()):
        return None
    gap = standing[0].gap
    return (
        CLEARS * ego + LENGTHS["truck"] if gap is None else middle(gap, 0.0) + FOLLOWS * ego + LENGTHS["car"]
    )


def _speeds(actor: Actor, v: float, time: float, moved: bool) -> Iterator[dict[str, Any]]:
    """Actions that change the speed of a vehicle, in their order."""
    wait: dict[str, Any] = {"after": CHANGE + 0.5} if moved else {"at": round(time, 2)}
    for act in actor.acts:
        if act.kind == "brake":
            rate = STEADY if act.rate is None else act.rate
            to = SLOWED * v if act.speed is None else act.speed
            lasts = {} if to == 0 else {"duration": round(max((v - to) / rate, 0.2), 2)}
            yield wait | {"brake": rate} | lasts
            if lasts:
                yield {"after": lasts["duration"], "speed": round(to, 2)}
            v = to
        elif act.kind == "stop":
            yield wait | {"stop": True}
            v = 0.0
        elif act.kind == "accelerate":
            v = v + 5.0 if act.speed is None else act.speed
            yield wait | {"speed": round(v, 2)} | ({} if act.rate is None else {"rate": act.rate})
        else:
            continue
        wait = {"after": FIRST}
