"""The numbers of the behaviour model: junctions, lane changes, and driving in general.

Parameters of drivers and bodies, which differ from vehicle to vehicle, are in `vehicles.DEFAULTS`. The
numbers here are the same for all vehicles. `PARAMETERS` is the table of all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A row of the table."""

    group: str
    """`JUNCTIONS`, `LANE_CHANGES` or `DRIVING`"""
    name: str
    """Field of the group."""
    value: float
    unit: str
    meaning: str
    source: str
    """A paper, a standard, SUMO's attribute for the same thing, or "chosen" with the reason."""
    bounds: tuple[float, float]
    """Values that make sense."""


def _number(value: float, unit: str, meaning: str, source: str, bounds: tuple[float, float]) -> Any:
    about = {"unit": unit, "meaning": meaning, "source": source, "bounds": bounds}
    return field(default=value, metadata=about)


@dataclass(frozen=True, kw_only=True)
class Junctions:
    """Right of way, gap acceptance, lights and signs. Units, meanings and sources are in `PARAMETERS`."""

    gap_lead: float = _number(
        0.7,
        "s",
        "gap from leaving a conflict area to the arrival of a vehicle with priority, for a `gap_factor` of 1",
        "capacities of left turns from a major road, HCM 6, ch. 20; SUMO: jmTimegapMinor, 1 s",
        (0.3, 4.0),
    )
    gap_side: float = _number(
        1.0,
        "s",
        "added to that where the other comes from the side, not from ahead",
        "capacities of minor roads, HCM 6, ch. 20: critical gaps of 6.5 and 7.1 s, of the left turn 4.1 s",
        (0.0, 3.0),
    )
    gap_merge: float = _number(
        0.7,
        "s",
        "the same where paths merge, between the vehicle that goes first and one with priority",
        "capacities of roundabouts, HCM 6, ch. 22",
        (0.1, 4.0),
    )
    gap_lead_entered: float = _number(
        0.3,
        "1",
        "factor on these gaps for a vehicle that is past the stop line",
        "chosen: a vehicle inside the junction completes its manoeuvre",
        (0.0, 1.0),
    )
    gap_follow: float = _number(
        0.5,
        "s",
        "gap from the exit of the vehicle that goes first to the arrival of the other",
        "chosen; SUMO has none",
        (0.0, 2.0),
    )
    merge_braking: float = _number(
        2.0,
        "m/s^2",
        "braking that a merging vehicle may ask of the vehicle with priority",
        "chosen: the comfortable deceleration of cars",
        (0.5, 4.0),
    )
    merge_headway: float = _number(
        0.5,
        "1",
        "share of the time gap T that must be free behind the vehicle that a merging vehicle follows",
        "chosen: gaps are short in a merge and open afterwards",
        (0.2, 1.0),
    )
    impatience_start: float = _number(5.0, "s", "waiting time from which gaps shrink", "chosen", (0.0, 60.0))
    impatience_time: float = _number(
        60.0,
        "s",
        "further waiting time over which gaps shrink to the least",
        "chosen; SUMO: --time-to-impatience, 180 s",
        (10.0, 300.0),
    )
    impatience: float = _number(
        0.6,
        "1",
        "share by which gaps shrink at most",
        "chosen; SUMO: impatience, up to 1",
        (0.0, 0.9),
    )
    tie_time: float = _number(
        3.0,
        "s",
        "waiting time of both vehicles after which right before left no longer holds",
        "chosen: long enough to see which vehicle starts",
        (1.0, 10.0),
    )
    turn_time: float = _number(
        1.0,
        "s",
        "difference of waiting times at a four-way stop from which the first that came goes first",
        "chosen: what drivers can tell apart",
        (0.1, 5.0),
    )
    priority_time: float = _number(
        20.0,
        "s",
        "waiting time of both vehicles after which priority no longer holds",
        "chosen: resolves gridlock that signs alone do not; SUMO: --time-to-teleport, 300 s",
        (5.0, 300.0),
    )
    firm_braking: float = _number(
        4.0,
        "m/s^2",
        "a vehicle that needs harder braking to wait goes first",
        "chosen; SUMO: decel, 4.5",
        (2.0, 6.0),
    )
    easy_braking: float = _number(
        2.0,
        "m/s^2",
        "braking distance within which a conflict ahead is looked at",
        "chosen: the comfortable deceleration of cars",
        (1.0, 4.0),
    )
    sight_time: float = _number(
        1.5, "s", "time added to that distance, at the present speed", "chosen: T and a decision", (0.5, 4.0)
    )
    sight_room: float = _number(
        12.0, "m", "length added to that distance", "chosen: a car and its gap, twice", (5.0, 50.0)
    )
    exit_acceleration: float = _number(
        0.7,
        "1",
        "share of its acceleration expected of another vehicle that clears the conflict area",
        "chosen: on the safe side",
        (0.3, 1.0),
    )
    passing_acceleration: float = _number(
        0.8,
        "1",
        "share of its acceleration that a vehicle counts on to pass before another",
        "chosen: on the safe side",
        (0.3, 1.0),
    )
    soonest: float = _number(
        0.85,
        "1",
        "share of the time through a turn at its tightest speed that another vehicle may take",
        "chosen: a turn is tight in a part of it",
        (0.5, 1.0),
    )
    turn_length: float = _number(
        15.0,
        "m",
        "of a connector, on which its tightest speed counts for that time",
        "chosen: a turn",
        (5.0, 50.0),
    )
    calm_factor: float = _number(
        2.0,
        "1",
        "a vehicle within this many braking distances does not let an obstructing vehicle go first",
        "chosen: halves the braking",
        (1.0, 4.0),
    )
    margin: float = _number(
        0.5,
        "m",
        "front bumper to the stop line or conflict area",
        "chosen; SUMO: jmStoplineGap, 1 m",
        (0.1, 2.0),
    )
    standstill: float = _number(1.0, "m/s", "speed below which a vehicle stands", "chosen", (0.1, 2.0))
    starting: float = _number(
        0.2, "m/s^2", "acceleration above which a vehicle that stood moves off", "chosen", (0.05, 1.0)
    )
    pulling_out: float = _number(
        2.0,
        "m",
        "to a conflict area: nearer, a vehicle that moves off does not stop for one that can wait",
        "chosen: the first step of a start, and the margin",
        (0.0, 5.0),
    )
    slowing: float = _number(
        1.0,
        "m/s^2",
        "braking from which others expect a vehicle to stop inside the junction",
        "chosen: more than the engine brakes",
        (0.3, 3.0),
    )
    queue_gap: float = _number(
        2.0, "1", "gap of a queued vehicle to its leader, over s0", "chosen", (1.0, 4.0)
    )
    queue_room: float = _number(1.0, "m", "length added to that gap", "chosen", (0.0, 5.0))
    exit_time: float = _number(
        2.0,
        "s",
        "a leader beyond the junction is counted this much further on, at its speed",
        "chosen: the time until the own vehicle gets there",
        (0.0, 5.0),
    )
    yellow_braking: float = _number(
        3.0,
        "m/s^2",
        "a driver that can stop with this stops at yellow",
        "ITE (2020), Guidelines for Determining Traffic Signal Change Intervals: 10 ft/s^2 = 3.05",
        (1.5, 5.0),
    )
    yellow_late: float = _number(
        1.5,
        "1",
        "factor on `yellow_braking` for a driver that would reach the line after yellow",
        "chosen: few run the red",
        (1.0, 2.5),
    )
    yellow_time: float = _number(
        2.5, "s", "duration of yellow that drivers count on", "below the 3 s of RiLSA at 50 km/h", (1.0, 5.0)
    )
    yellow_hardest: float = _number(
        5.0,
        "m/s^2",
        "no driver brakes harder than this for yellow",
        "chosen: above `yellow_late` times `yellow_braking`",
        (3.0, 9.0),
    )
    red_braking: float = _number(
        0.9,
        "1",
        "a vehicle that can stop with this share of b_max stops at red",
        "chosen: a reserve below the limit",
        (0.5, 1.0),
    )
    over_line: float = _number(
        2.0, "m", "beyond the line, where a rolling vehicle still stops for a light", "chosen", (0.0, 5.0)
    )
    sign_distance: float = _number(
        2.5,
        "m",
        "to the line, within which a stop counts for a stop sign",
        "chosen: a driver stops before the line or at it",
        (0.5, 5.0),
    )
    sign_speed: float = _number(
        1.0,
        "m/s",
        "speed that counts as a stop at a sign, except of egos",
        "most drivers roll; with it roads with a stop sign have the follow-up times of HCM 6, ch. 20",
        (0.0, 2.0),
    )
    sign_stop: float = _number(
        0.3, "m/s", "speed that counts as a stop of an ego at a sign", "chosen: a full stop", (0.0, 1.0)
    )


@dataclass(frozen=True, kw_only=True)
class LaneChanging:
    """Lane changes: incentive, safety, courtesy, motion. Units, meanings and sources are in `PARAMETERS`."""

    route_base: float = _number(
        0.5,
        "m/s^2",
        "incentive for a change that the route needs, at no urgency",
        "chosen, as the lane-change bias of Treiber, Kesting (2013), ch. 14; SUMO: lcStrategic",
        (0.0, 2.0),
    )
    route_urgent: float = _number(
        4.0,
        "m/s^2",
        "added to that at full urgency",
        "chosen: above any acceleration that MOBIL weighs against it",
        (1.0, 8.0),
    )
    safe_urgent: float = _number(
        3.0,
        "m/s^2",
        "added to b_safe at full urgency",
        "chosen; SUMO: lcAssertive",
        (0.0, 5.0),
    )
    caution: float = _number(
        40.0,
        "m",
        "before the last place to change, where a driver wants to have finished",
        "chosen: room for a second attempt",
        (0.0, 200.0),
    )
    ease_off: float = _number(
        1.0,
        "m/s^2",
        "braking distance per lane to cross, if that is longer than `caution`",
        "chosen: a vehicle that brakes for the end no longer fits into a gap",
        (0.3, 3.0),
    )
    change_room: float = _number(
        12.0,
        "m",
        "length added to the way that a lane change takes at the present speed",
        "chosen: a car and its gap, twice",
        (0.0, 50.0),
    )
    courteous: float = _number(
        0.15,
        "1",
        "urgency from which a vehicle takes the pace of the other lane, and is let in there",
        "chosen; SUMO: lcCooperative",
        (0.0, 1.0),
    )
    intent: float = _number(
        0.3,
        "1",
        "urgency from which a driver looks only where the route goes, and swaps lanes with an abreast one",
        "chosen: twice `courteous`",
        (0.0, 1.0),
    )
    abreast_time: float = _number(
        2.0, "s", "ahead, at which it counts which of two vehicles is behind", "chosen", (0.5, 5.0)
    )
    slowed: float = _number(
        0.5,
        "1",
        "share of its speed to which a vehicle slows to finish before the lanes part",
        "chosen",
        (0.2, 1.0),
    )
    on_time: float = _number(
        0.9,
        "1",
        "share of the speed that just finishes before the lanes part",
        "chosen: drivers approach their desired speed from above",
        (0.5, 1.0),
    )
    behind_room: float = _number(
        2.5,
        "m",
        "left to the rear of a vehicle that changes to the own lane from a standstill",
        "chosen: the swing of its rear",
        (0.5, 10.0),
    )
    rest: float = _number(
        12.0,
        "s",
        "from the end of a lane change to the next voluntary one",
        "chosen: few are reversed within 15 s",
        (0.0, 30.0),
    )
    return_factor: float = _number(
        3.0,
        "1",
        "lane-change times per lane that a change away from the route must leave to come back",
        "chosen: one to change, two to find gaps",
        (1.0, 10.0),
    )
    jam_speed: float = _number(
        4.0, "m/s", "least speed that is assumed for that", "chosen: a jam may dissolve", (1.0, 10.0)
    )
    detour_time: float = _number(
        9.0,
        "s",
        "at the speed limit, before the last place to change back, without changes away from the route",
        "chosen: 300 m on a motorway, the first of two signs before a lane ends",
        (0.0, 30.0),
    )
    stall_time: float = _number(
        3.0, "s", "standing in a lane change, after which it is given up", "chosen", (1.0, 30.0)
    )
    shunt_time: float = _number(
        15.0,
        "s",
        "of a lane change by a vehicle that has stood for `patience`: it shunts to and fro",
        "chosen; a car gets out of a parking space in about that time",
        (5.0, 60.0),
    )
    stall_offset: float = _number(
        1.0,
        "m",
        "from the middle of the lane, up to which that is possible",
        "chosen: a car hardly reaches into the next lane",
        (0.0, 1.5),
    )
    yielding_speed: float = _number(
        3.0,
        "m/s",
        "speed above which a driver also lets in a vehicle that is still beside",
        "chosen: in a queue no vehicle has to fall back",
        (0.0, 10.0),
    )
    let_time: float = _number(
        10.0, "s", "standing to let another vehicle in, after which a driver goes on", "chosen", (3.0, 60.0)
    )
    hardest: float = _number(
        0.5,
        "1",
        "share of b_max that a lane change may ask of any vehicle, however urgent it is",
        "chosen: b_safe of most drivers",
        (0.2, 1.0),
    )
    unseen: float = _number(
        0.5, "s", "from the start of a lane change until the new follower sees it", "a decision", (0.0, 2.0)
    )
    room: float = _number(0.5, "m", "least gap to the new leader and the new follower", "chosen", (0.1, 5.0))
    courtesy_braking: float = _number(
        2.0,
        "m/s^2",
        "hardest braking to let another vehicle in, or to find a gap",
        "chosen: the comfortable deceleration of cars",
        (0.5, 4.0),
    )
    beside_room: float = _number(
        0.35,
        "m",
        "to the side, from which a vehicle is clear of its leader on the lane that it leaves",
        "chosen: a mirror and a hand",
        (0.1, 1.0),
    )
    nearer: float = _number(
        0.7,
        "1",
        "share of s0 that a vehicle which pulls out needs less to one that stands for good",
        "chosen: drivers steer with half a metre left",
        (0.0, 0.9),
    )
    least_way: float = _number(
        12.0,
        "m",
        "least way of a lane change, at walking pace",
        "a car with a turning radius R moves w aside in sqrt(4 R w - w^2), 8.5 to 11 m, and turns its wheels",
        (8.0, 50.0),
    )
    way_over: float = _number(
        0.75,
        "1",
        "share of that way which must be left before lanes part",
        "a tenth of the way aside is left then: 1 - the quintic at 0.75",
        (0.5, 1.0),
    )
    way_least: float = _number(
        0.4,
        "1",
        "the same for a vehicle that has stood there for `patience`",
        "chosen: it cuts the corner, and no vehicle stands for good",
        (0.1, 1.0),
    )
    long_way: float = _number(
        2.5, "1", "least way over the length of a long vehicle", "chosen: its rear swings little", (0.5, 5.0)
    )
    drift: float = _number(
        0.5,
        "m/s",
        "lateral speed of the return to the middle of the lane",
        "chosen: below the mean of lane changes, 0.8",
        (0.1, 2.0),
    )
    steepest: float = _number(
        0.2,
        "rad",
        "largest angle of a body to its lane in a lane change",
        "chosen: the ends of long bodies stay near their lane",
        (0.05, 0.5),
    )


@dataclass(frozen=True, kw_only=True)
class Driving:
    """Bends, ends of lanes, stopping. Units, meanings and sources are in `PARAMETERS`."""

    bend_braking: float = _number(
        0.7,
        "1",
        "share of b with which a driver slows down for a bend or a lower limit ahead",
        "chosen: drivers brake earlier than they have to",
        (0.3, 1.0),
    )
    bend_room: float = _number(
        10.0,
        "m",
        "least distance ahead in which bends of the own lane are looked for",
        "chosen: a body and a half",
        (5.0, 50.0),
    )
    walking_speed: float = _number(
        1.5,
        "m/s",
        "speed below which a vehicle waits",
        "walking pace; SUMO counts waiting below 0.1 m/s",
        (0.1, 2.0),
    )
    line_room: float = _number(
        0.4, "m", "of the gap s0 to a stop obstacle that a stop at walking speed uses", "chosen", (0.0, 1.0)
    )
    line_near: float = _number(
        1.0, "m", "to a stop obstacle, within which such a stop is made", "chosen", (0.2, 5.0)
    )
    line_braking: float = _number(
        0.5,
        "m/s^2",
        "braking need from which such a stop is made",
        "chosen: below it drivers roll",
        (0.1, 2.0),
    )
    line_hardest: float = _number(2.5, "m/s^2", "braking at most in such a stop", "chosen", (1.0, 5.0))
    jerk: float = _number(
        12.65,
        "m/s^3",
        "how fast a driver changes its acceleration",
        "UN Regulation 157, guidance on performance models: 0.774 g built up within 0.6 s",
        (2.0, 1000.0),
    )
    emergency: float = _number(
        6.0,
        "m/s^2",
        "braking that begins at once",
        "chosen: nothing but an emergency asks for more",
        (0.0, 10.0),
    )
    patience: float = _number(
        20.0,
        "s",
        "waiting time at the end of a wrong lane after which a driver takes another goal",
        "chosen; SUMO: --time-to-teleport, 300 s",
        (5.0, 300.0),
    )
    fast_limit: float = _number(
        25.0,
        "m/s",
        "speed limit above which `fast_patience` holds",
        "chosen: motorways, where a standing vehicle is a danger",
        (15.0, 40.0),
    )
    fast_patience: float = _number(0.25, "1", "share of `patience` on such roads", "chosen", (0.0, 1.0))
    end_room: float = _number(
        40.0, "m", "to the end of the lane, within which that waiting counts", "chosen", (10.0, 200.0)
    )
    end_gap: float = _number(
        1.0, "m", "front bumper to the end of a lane that does not lead on", "chosen", (0.2, 5.0)
    )
    end_clear: float = _number(
        25.0,
        "m",
        "kept free before that end, to start a lane change from a standstill",
        "chosen: twice `least_way`",
        (5.0, 100.0),
    )
    end_comfort: float = _number(
        2.0,
        "m/s^2",
        "braking to a stop at the end of a lane; while less is enough, a driver does not slow down for it",
        "chosen: comfortable, so that vehicles accelerate on acceleration lanes",
        (1.0, 4.0),
    )
    end_sight: float = _number(
        1.0, "s", "before that, at which the end begins to count", "chosen: two decisions", (0.0, 3.0)
    )
    end_braking: float = _number(
        3.0,
        "m/s^2",
        "braking up to which that room is kept free",
        "chosen: as for yellow",
        (1.0, 6.0),
    )
    gentle_braking: float = _number(
        2.5,
        "m/s^2",
        "braking at most to leave room for a vehicle that has to cross over",
        "chosen",
        (1.0, 5.0),
    )
    stand_speed: float = _number(
        0.1, "m/s", "speed below which a vehicle may stand for good", "SUMO", (0.01, 1.0)
    )
    stand_time: float = _number(
        8.0,
        "s",
        "standing without a reason, after which others drive around a vehicle",
        "chosen: long for a driver behind; after a crash at once",
        (2.0, 60.0),
    )
    stand_room: float = _number(
        15.0,
        "m",
        "free before it, to the next vehicle and to a line: otherwise it waits there",
        "chosen: three cars",
        (5.0, 50.0),
    )
    stand_braking: float = _number(
        4.0,
        "m/s^2",
        "braking up to which a driver leaves room to drive around a vehicle that stands for good",
        "chosen: firm",
        (1.0, 8.0),
    )
    stand_sight: float = _number(
        300.0, "m", "from which a driver sees that a vehicle stands for good", "chosen", (30.0, 300.0)
    )
    goal_room: float = _number(
        2.0,
        "m",
        "beyond the end of a goal, within which a vehicle that left is still in the way",
        "chosen: s0",
        (0.0, 10.0),
    )
    grip_share: float = _number(
        0.5,
        "1",
        "share of the friction of a slippery road that drivers use outside emergencies",
        "chosen: half is kept for what comes unexpectedly",
        (0.2, 1.0),
    )


JUNCTIONS = Junctions()
"""The numbers in use at junctions."""

LANE_CHANGES = LaneChanging()
"""The numbers in use for lane changes."""

DRIVING = Driving()
"""The numbers in use everywhere."""


def _rows(name: str, group: Junctions | LaneChanging | Driving) -> tuple[Parameter, ...]:
    return tuple(
        Parameter(group=name, name=x.name, value=getattr(group, x.name), **x.metadata) for x in fields(group)
    )


PARAMETERS: tuple[Parameter, ...] = (
    *_rows("JUNCTIONS", JUNCTIONS),
    *_rows("LANE_CHANGES", LANE_CHANGES),
    *_rows("DRIVING", DRIVING),
)
"""All of them, one row each."""
