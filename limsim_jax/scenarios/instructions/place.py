"""An `Intent` on a map: where vehicles start, and when they do what."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from limsim_jax.maps.map import Map
from limsim_jax.maps.network import Turn
from limsim_jax.scenarios.instructions.corridor import (
    MOTORWAY_LIMIT,
    TOWN_LIMIT,
    Corridor,
    Meeting,
    Merge,
    Way,
    corridors,
    light_at,
    meetings,
    merges,
    signalled,
)
from limsim_jax.scenarios.instructions.intent import Act, Actor, InstructionError, Intent, middle
from limsim_jax.scenarios.instructions.plans import (
    EGO,
    FOLLOWS,
    LENGTHS,
    SIDES,
    Plan,
    Tuning,
    plan,
    speed_of,
)

HORIZON, LONGER = 25.0, 60.0
"""s of an episode; where traffic lights may have to change first, and where the road is slippery."""

MEET = 7.0
"""s after the start at which two vehicles meet at a junction or a ramp."""

MEETS = (MEET, MEET + 2, MEET + 4, MEET - 2, MEET - 3)
"""s, moments at which they may meet, in the order in which they are tried."""

SLOWEST = 5.0
"""m/s of a vehicle on its way to a red light, at least."""

PATIENT = (1.0, 0.8, 0.65)
"""Factors on the speed of the ego, of which it takes the first that gets it to its light in time."""

GREEN = 3.0
"""s for which the ego has had a green light when a vehicle runs the red one: it need not brake for it."""

DENSITY = {"none": 0.0, "light": 4.0, "moderate": 10.0, "dense": 20.0}
"""Vehicles per km of lane: on a motorway, levels of service A, B to C, and E (HCM, exhibit 12-15)."""

ON_RAMP = 0.9
"""Share of its limit that is driven on a ramp."""

MERGES = 10.0
"""m between a vehicle that merges and the ego."""

NO_TUNING = Tuning()

SPEEDS = {"motorway": 25.0, "ramp": 25.0, "rural": 22.0, "town": 12.0, "crossing": 11.0, "roundabout": 9.0}
"""m/s of the ego, unless the instruction or the limit says less."""


_WORDS = {
    "motorway": "motorway", "rural": "rural road", "town": "street", "ramp": "ramp", "crossing": "junction",
    "roundabout": "roundabout",
}  # fmt: skip
"""Kinds of roads in messages."""


@dataclass
class Placed:
    """A scenario on a map: fields of an experiment."""

    map: Map
    ego: dict[str, Any]
    vehicles: list[dict[str, Any]] = field(default_factory=list)
    obstacles: list[dict[str, Any]] = field(default_factory=list)
    speed: float = 0.0
    """m/s of the ego."""
    actors: list[tuple[str, int]] = field(default_factory=list)
    """Of each actor: "vehicle" or "obstacle", and its number there; of several, the first."""
    signalled: bool = False


class NoPlace(InstructionError):
    """None of the maps has a place for a scenario."""


class _NoRoom(Exception):
    """This place does not do; the reason."""


def place(intent: Intent, maps: Sequence[Map], tuning: Tuning = NO_TUNING) -> Placed:
    """Find a place on one of the maps.

    Args:
      intent: what is asked for.
      maps: in the order in which they are tried.
      tuning: what is changed because it did not work before.

    Raises:
      NoPlace: none of the maps has such a place; one line with the reason.
      InstructionError: it needs another kind of road.
    """
    seen: list[str] = []
    number = 0
    for town in maps:
        reason = f"no {_WORDS[intent.kind_of_road]} as it is asked for"
        for spot in _spots(intent, town):
            try:
                found = _on(intent, spot, tuning)
            except _NoRoom as error:
                reason = str(error)
                continue
            if number == tuning.which:
                return found
            number += 1
            if number > tuning.which + 8:
                break
        seen.append(f"{town.name}: {reason}")
    if number:
        raise NoPlace(f"only {number} places fit")
    raise NoPlace(f"no map has a place for this; {'; '.join(dict.fromkeys(seen))}")


def _spots(intent: Intent, town: Map) -> Iterator[Corridor | Meeting | Merge]:
    kind = intent.kind_of_road
    if kind == "ramp":
        yield from merges(town, 150.0)
    elif kind in ("crossing", "roundabout"):
        found = [x for x in meetings(town, 60.0, ring=kind == "roundabout") if _meets(intent, x)]
        # without a word about lights, those places first that have none
        yield from sorted(found, key=lambda x: intent.lights is None and signalled(x))
    else:
        yield from (x for x in corridors(town, 150.0) if _is(kind, intent, x))


def _is(kind: str, intent: Intent, found: Corridor) -> bool:
    lanes = found.place[1]
    if intent.lanes is not None and lanes != intent.lanes:
        return False
    if kind == "motorway":
        return found.limit >= MOTORWAY_LIMIT and lanes >= 2
    if kind == "town":
        return found.limit < TOWN_LIMIT
    one = intent.lanes is not None or lanes == 1
    return one and TOWN_LIMIT <= found.limit <= 28.0 and found.both_ways


def _meets(intent: Intent, found: Meeting) -> bool:
    """Whether two ways meet as the instruction says."""
    crossing, turn = intent.road != "roundabout", found.ego.movement.turn
    if intent.lights is not None and signalled(found) != intent.lights:
        return False
    turns = {"left": (Turn.LEFT,), "right": (Turn.RIGHT,), "straight": (Turn.STRAIGHT,)}
    if crossing and turn not in turns[intent.turn or "straight"]:
        return False
    for actor in intent.actors:
        for act in actor.acts or (Act(kind="cross"),):
            other = found.other.movement.turn
            if act.kind == "turn_across" and not (found.comes_from == "ahead" and other is Turn.LEFT):
                return False
            if act.kind in ("cross", "run_red", "drive"):
                if crossing and other is not Turn.STRAIGHT:
                    return False
                wanted = "ahead" if actor.place == "oncoming" else act.side
                if (wanted is None and found.comes_from == "ahead") or wanted not in (None, found.comes_from):
                    return False
    return not _runs_red(intent) or signalled(found)


def _runs_red(intent: Intent) -> bool:
    return any(act.kind == "run_red" for actor in intent.actors for act in actor.acts)


def _on(intent: Intent, spot: Corridor | Meeting | Merge, tuning: Tuning) -> Placed:
    if isinstance(spot, Corridor):
        return _on_corridor(intent, spot, tuning)
    return _at_merge(intent, spot, tuning) if isinstance(spot, Merge) else _at_junction(intent, spot, tuning)


def own_speed(intent: Intent, limit: float) -> float:
    """m/s of the ego at the start."""
    most = limit if intent.limit is None else intent.limit
    return middle(intent.speed, min(SPEEDS[intent.kind_of_road], most))


def _put(corridor: Corridor, x: float, side: int, length: float) -> dict[str, Any]:
    """Start and s of a front at `x` m of a corridor."""
    found = corridor.at(x, side)
    if found is None:
        raise _NoRoom("a lane is missing, or the road is too short")
    lane, s = found
    if lane.junction is not None or s < length:
        back = corridor.at(x - length - 1.0, side)
        if lane.junction is not None or back is None or back[0].id != lane.id:
            raise _NoRoom("a vehicle would start in a junction or across the end of a lane")
    return {"start": lane.id, "s": round(s, 2)}


def _goal(corridor: Corridor) -> str:
    goals = corridor.goals()
    if not goals:
        raise _NoRoom("no way out can be reached")
    return goals[0]


# ---- along a road


def _on_corridor(intent: Intent, corridor: Corridor, tuning: Tuning) -> Placed:
    town, v = corridor.map, own_speed(intent, corridor.limit)
    plans = [plan(actor, v, tuning, intent) for actor in intent.actors]
    back = max([30.0, *(x.length + 15 - x.front for x in plans)])
    ahead = max([100.0, 0.6 * v * HORIZON, *(x.front + 5 for x in plans)])
    if corridor.length < back + ahead:
        raise _NoRoom(f"no road of {back + ahead:.0f} m without a junction")
    x = min(max(back, 0.1 * corridor.length), corridor.length - ahead)
    sides = [0, *(side for one in plans for side in (one.side, one.side + one.moves))]
    right, left = corridor.sides(x - back + 1, x + ahead - 1)
    if min(sides) < right or max(sides) > left:
        raise _NoRoom("a lane beside the ego's is missing")
    goal = _goal(corridor)
    placed = Placed(town, _put(corridor, x, 0, EGO) | {"goal": goal, "v": round(v, 2)}, speed=v)
    for actor, one in zip(intent.actors, plans, strict=True):
        _add(placed, actor, one, corridor, x, goal)
    return placed


def _add(placed: Placed, actor: Actor, one: Plan, corridor: Corridor, x: float, goal: str) -> None:
    """Put an actor, and those behind it where there are several."""
    room = 0.0
    for number in range(actor.count):
        at = x + one.front + (room if one.front >= 0 else -room)
        place_ = _put(corridor, at, one.side, one.length)
        room += one.length + max(one.v * FOLLOWS, 8.0)
        if number == 0:
            kind = "obstacle" if actor.kind == "obstacle" else "vehicle"
            placed.actors.append((kind, len(placed.obstacles if kind == "obstacle" else placed.vehicles)))
        if actor.kind == "obstacle":
            placed.obstacles.append(place_)
            continue
        placed.vehicles.append(
            place_
            | {"v": round(one.v, 2), "goal": goal, "vehicle": actor.kind, "keeps_lane": True}
            | ({"driver": one.driver} if one.driver else {})
            | ({"action": one.actions} if one.actions else {})
        )


# ---- ramps


def _at_merge(intent: Intent, spot: Merge, tuning: Tuning) -> Placed:
    """Vehicles from the ramp and on the motorway reach its end together."""
    v = own_speed(intent, min(spot.main.limit, SPEEDS["motorway"] * 1.2))
    slower = min(v, spot.ramp.limit) * ON_RAMP
    longest = min(MEET, spot.main_at / v - 1.5, spot.ramp_at / slower - 1.5)
    reason: Exception = _NoRoom("the roads before the ramp are too short")
    for time in np.arange(longest, min(longest, MEET - 4) - 0.1, -1.0):
        try:
            return _merge_after(intent, spot, tuning, v, slower, float(time))
        except _NoRoom as error:
            reason = error
    raise reason


def _merge_after(intent: Intent, spot: Merge, tuning: Tuning, v: float, slower: float, time: float) -> Placed:
    """They reach it after `time` s."""
    goal = _goal(spot.main)
    line, at, own = (spot.ramp, spot.ramp_at, slower) if intent.merges else (spot.main, spot.main_at, v)
    x = at - own * time
    placed = Placed(spot.main.map, _put(line, x, 0, EGO) | {"goal": goal, "v": round(own, 2)}, speed=v)
    back = 0.0
    for actor in intent.actors:
        kinds = {act.kind for act in actor.acts}
        if kinds & {"cross", "turn_across", "run_red"}:
            raise InstructionError("a vehicle that crosses or turns across needs a junction, not a ramp")
        merging = "merge" in kinds
        if not merging and kinds - {"drive"} and not intent.merges:
            _add(placed, actor, plan(actor, v, tuning, intent), spot.main, x, goal)
            continue
        line, at, usual = (spot.ramp, spot.ramp_at, slower) if merging else (spot.main, spot.main_at, v)
        speed = speed_of(actor, v) if actor.speed or actor.faster else usual
        gap = next((act.gap for act in actor.acts if act.gap is not None), actor.gap)
        near = tuning.nearer if gap is None else 1.0
        apart = middle(gap, MERGES) * near * tuning.severe + LENGTHS[actor.kind]
        front = at - speed * time + (-apart if actor.place == "behind" else apart) + speed * tuning.earlier
        side = SIDES[actor.lane]
        side = 0 if merging or line.at(front, side) is None else side
        more = {} if merging else {"action": [{"speed": round(speed, 2)}]}
        back = _queue(placed, actor, line, front - back, side, speed, {"goal": goal} | more)
        back = 0.0 if intent.merges else back
    return placed


def _queue(
    placed: Placed, actor: Actor, line: Corridor, front: float, side: int, v: float, more: dict[str, Any]
) -> float:
    """Put an actor, and those behind it where there are several; m of road that they take."""
    length, taken = LENGTHS[actor.kind], 0.0
    placed.actors.append(("vehicle", len(placed.vehicles)))
    for _ in range(actor.count):
        where = _put(line, front - taken, side, length)
        placed.vehicles.append(where | {"v": round(v, 2), "vehicle": actor.kind} | more)
        taken += length + v * FOLLOWS
    return taken


# ---- junctions


def _at_junction(intent: Intent, spot: Meeting, tuning: Tuning) -> Placed:
    """The ego and the others reach the meeting point together."""
    town = spot.ego.approach.map
    v = own_speed(intent, min(spot.ego.approach.limit, spot.other.approach.limit))
    if None in [way.goal(town) for way in (spot.ego, spot.other)]:
        raise _NoRoom("no way out can be reached")
    runs = _runs_red(intent)
    others = [SLOWEST if runs else speed_of(x, v) for x in intent.actors]
    reason: Exception = _NoRoom("the roads before the junction are too short")
    for own in [v * x for x in PATIENT] if runs and intent.speed is None else [v]:
        longest = min(_time(spot.ego, own), *(_time(spot.other, speed) for speed in others), 1e3)
        for time in np.arange(MEET - 3, longest) if runs else MEETS:
            if time < longest:
                try:
                    return _meet(intent, spot, tuning, own, float(time))
                except _NoRoom as error:
                    reason = error
    raise reason


def _meet(intent: Intent, spot: Meeting, tuning: Tuning, v: float, time: float) -> Placed:
    """The ego and the others reach that place after `time` s."""
    town = spot.ego.approach.map
    own, theirs = (way.goal(town) for way in (spot.ego, spot.other))
    ego = _put(spot.ego.approach, _before(spot.ego, v, time), 0, EGO) | {"goal": own, "v": round(v, 2)}
    placed = Placed(town, ego, speed=v, signalled=signalled(spot))
    back = 0.0
    for actor in intent.actors:
        kind = actor.acts[0].kind if actor.acts else "cross"
        if kind not in ("cross", "turn_across", "run_red", "drive"):
            raise InstructionError(f"'{kind.replace('_', ' ')}' needs a stretch of road, not a junction")
        speed = speed_of(actor, v)
        more: dict[str, Any] = {"goal": theirs, "keeps_lane": True}
        if kind == "run_red":
            if actor.speed is None and actor.faster is None:  # the road before may be short
                speed = min(speed, (_time(spot.other, 1.0) - back) / time)
            if not _has_red(spot, time, v, speed, tuning):
                raise _NoRoom("no moment at which the ego has green and the other one red")
        if actor.careless or kind == "run_red":
            more["action"] = [{"speed": round(speed, 2), "careful": False}]
        front = _before(spot.other, speed, time - tuning.earlier) - back
        back += _queue(placed, actor, spot.other.approach, front, 0, speed, more)
    return placed


def _has_red(spot: Meeting, time: float, own: float, speed: float, tuning: Tuning) -> bool:
    """Whether the ego comes at green, and the other one at red."""
    network = spot.ego.approach.map.network
    passes = time - spot.ego.crossing / own
    other = time - tuning.earlier - spot.other.crossing / speed
    green = [light_at(network, spot.ego.movement, t) or "" for t in (passes - GREEN, passes, passes + 1.0)]
    red = [light_at(network, spot.other.movement, t) for t in (other - 0.5, other, other + 0.5)]
    return set(green) <= set("gG") and red == ["r"] * 3


def _time(way: Way, v: float) -> float:
    """s from the first place on an approach to the meeting point."""
    return (way.approach.length - 15.0 + way.crossing) / v


def _before(way: Way, v: float, time: float) -> float:
    """m along an approach, `time` s before the meeting point."""
    x = way.approach.length + way.crossing - v * time
    if x > way.approach.length - 3.0:
        raise _NoRoom("the road before the junction is too short")
    return x
