"""Traffic signals: programs, phases, and plans for lights without timing.

Programs follow SUMO: a phase is a duration and one letter per link; a positive offset starts the
cycle that much later. OpenDRIVE says where lights stand and which of them switch together, but not
when; `generate_programs` makes a plan for them by the formulas of traffic engineering.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from limsim_jax.maps.conflicts import ConflictType, build_conflicts
from limsim_jax.maps.network import (
    Control,
    ImportReport,
    MapError,
    Movement,
    Network,
    Phase,
    Program,
    TrafficLight,
    Turn,
)
from limsim_jax.maps.signal_table import SignalState, SignalTable

Array = np.ndarray | jax.Array

GREEN = 25.0
"""Green time (s) of a generated stage with through traffic."""

GREEN_TURN = 10.0
"""Green time (s) of a generated stage of turns only."""

LONGEST_CYCLE = 120.0
"""Longest cycle (s) of a generated program, RiLSA (2015)."""

LEAST_GREEN = 7.0
"""Least green time (s) where the cycle would take longer."""

REACTION = 1.0
"""Perception and reaction time (s) in the yellow time."""

DECELERATION = 3.0
"""Deceleration (m/s2) in the yellow time."""

VEHICLE_LENGTH = 5.0
"""Length (m) of the vehicle that must have left before the next stage begins."""

LATERAL = 3.0
"""Lateral acceleration (m/s2) that limits the speed of turns in the clearance time."""


_LETTERS = dict(zip("rygGusoO", SignalState, strict=True))


def build_signals(network: Network, rows: Mapping[str, int]) -> SignalTable:
    """Build the arrays of all signal programs.

    Where movements with different lights begin on the same connector, `lane_link` has the first of
    them and `movement_link` distinguishes them. Movements that cross no connector have no lane of their
    own and are only found by movement.

    Raises:
        MapError: a program without phases, with state strings of different lengths, a letter that is
            none of `rygGusoO`, a cycle of no length, or a movement whose program or link is not there.
    """
    programs = list(network.programs.values())
    for program in programs:
        _check(network, program)
    index = {program.id: i for i, program in enumerate(programs)}
    num = len(programs) + 1
    phases = max([1, *(len(p.phases) for p in programs)])
    links = max([1, *(len(p.phases[0].state) for p in programs)])
    duration, shortest, longest = (np.zeros((num, phases), np.float32) for _ in range(3))
    next_phase = np.zeros((num, phases), np.int32)
    state = np.zeros((num, phases, links), np.int32)
    for i, program in enumerate(programs):
        for p, phase in enumerate(program.phases):
            duration[i, p] = phase.duration
            shortest[i, p] = phase.duration if phase.min_duration is None else phase.min_duration
            longest[i, p] = phase.duration if phase.max_duration is None else phase.max_duration
            next_phase[i, p] = phase.next[0] if phase.next else (p + 1) % len(program.phases)
            state[i, p, : len(phase.state)] = [_LETTERS[letter] for letter in phase.state]
    duration[-1, 0] = shortest[-1, 0] = longest[-1, 0] = 1.0
    state[-1, 0] = SignalState.OFF

    lane_program, lane_link = (np.full(len(rows) + 1, -1, np.int32) for _ in range(2))
    movement_program, movement_link = (np.full(len(network.movements) + 1, -1, np.int32) for _ in range(2))
    for movement in network.movements:
        if movement.program is None or movement.link is None:
            continue
        where = f"movement {movement.incoming} -> {movement.outgoing}"
        if movement.program not in index:
            raise MapError(f"no signal program '{movement.program}'", file=network.source, element=where)
        program = index[movement.program]
        if not 0 <= movement.link < len(programs[program].phases[0].state):
            reason = f"program '{movement.program}' has no link {movement.link}"
            raise MapError(reason, file=network.source, element=where)
        movement_program[movement.index], movement_link[movement.index] = program, movement.link
        row = rows.get(movement.via[0]) if movement.via else None
        if row is not None and lane_program[row] < 0:
            lane_program[row], lane_link[row] = program, movement.link
    return SignalTable(
        duration=duration,
        min_duration=shortest,
        max_duration=longest,
        next_phase=next_phase,
        state=state,
        offset=np.array([p.offset for p in programs] + [0.0], np.float32),
        cycle=duration.sum(1),
        num_phases=np.array([len(p.phases) for p in programs] + [1], np.int32),
        actuated=np.array([p.type != "static" for p in programs] + [False]),
        lane_program=lane_program,
        lane_link=lane_link,
        movement_program=movement_program,
        movement_link=movement_link,
    )


def _check(network: Network, program: Program) -> None:
    def refuse(reason: str) -> None:
        raise MapError(reason, file=network.source, element=f"signal program '{program.id}'")

    if not program.phases:
        refuse("has no phases")
    if len({len(phase.state) for phase in program.phases}) > 1:
        refuse("its phases have state strings of different lengths")
    for n, phase in enumerate(program.phases):
        for letter in phase.state:
            if letter not in _LETTERS:
                refuse(f"phase {n} has the state '{letter}'; known are {', '.join(_LETTERS)}")
        if not (math.isfinite(phase.duration) and phase.duration >= 0):
            refuse(f"phase {n} lasts {phase.duration:g} s")
        if any(not 0 <= p < len(program.phases) for p in phase.next):
            refuse(f"phase {n} is followed by one that is not there")
    if not sum(phase.duration for phase in program.phases) > 0:
        refuse("its phases last 0 s together")


def phase_at(table: SignalTable, t: Float[Array, ""] | float) -> Int[Array, " G"]:
    """Phase of every program at time `t` (s since the start).

    As in SUMO, the cycle starts at `t = offset`. A phase includes its first moment, not its last.
    Actuated programs run their nominal durations here, too. An actuated controller has to keep its own phase.
    """
    into = jnp.mod(jnp.asarray(t, jnp.float32) - table.offset, table.cycle)
    ends = jnp.cumsum(jnp.asarray(table.duration), axis=-1)
    phase = (into[:, None] >= ends).sum(-1, dtype=jnp.int32)
    return jnp.minimum(phase, table.num_phases - 1)


def lane_states(table: SignalTable, phase: Int[Array, " G"]) -> Int[Array, " L"]:
    """The `SignalState` at the entry of every lane in these phases."""
    program = jnp.asarray(table.lane_program)
    return jnp.asarray(table.state)[program, jnp.asarray(phase)[program], table.lane_link]


def lane_states_on_host(table: SignalTable, phase: Any) -> NDArray[np.int32]:
    """`lane_states` of many moments, `[T, G]` to `[T, L]`, in NumPy."""
    program, link = np.asarray(table.lane_program), np.asarray(table.lane_link)
    return np.asarray(table.state)[program, np.asarray(phase)[:, program], link]


def movement_states(table: SignalTable, phase: Int[Array, " G"]) -> Int[Array, " M"]:
    """The `SignalState` of every movement in these phases."""
    program = jnp.asarray(table.movement_program)
    return jnp.asarray(table.state)[program, jnp.asarray(phase)[program], table.movement_link]


# --- programs for lights without timing -------------------------------------------------------


def yellow_time(speed: float) -> float:
    """Yellow time (s) for an approach speed (m/s): `t + v / (2 a)`.

    Within 3 to 6 s, rounded up to 0.1 s. The kinematic equation on level ground, with t = 1 s and
    a = 3 m/s^2 (Gazis, Herman and Maradudin 1960; ITE, Guidelines for Determining Traffic Signal Change and
    Clearance Intervals, 2020).
    """
    return _round_up(min(6.0, max(3.0, REACTION + speed / (2 * DECELERATION))))


def all_red_time(distance: float, speed: float) -> float:
    """All-red time (s) to clear `distance` (m): `(w + L) / v`.

    `L` = 5 m is the length of a vehicle. Within 1 to 6 s, rounded up to 0.1 s. Source as for
    `yellow_time`.
    """
    return _round_up(min(6.0, max(1.0, (distance + VEHICLE_LENGTH) / max(speed, 1.0))))


def _round_up(seconds: float) -> float:
    return math.ceil(seconds * 10 - 1e-9) / 10


def generate_programs(network: Network, *, green: float = GREEN, green_turn: float = GREEN_TURN) -> Network:
    """Add a program for every junction whose lights have no timing.

    A movement is signalised if a traffic light stands for one of its connectors or for its incoming
    lane (an arrow light: for its turn); movements that already have a program keep it. Every
    junction gets one static program, a link per movement:

    - Units switch together: the movements of a controller, or where there is none (or where it
      would show green to crossing traffic) those of an approach with the same arrow or none. Lanes
      that only turn across the opposite direction are a unit of their own if they have to yield.
    - Stages are sets of units that do not conflict. Turns across the opposite direction share its
      stage and yield, unless they are a unit of their own, which is then protected and comes before
      the rest of its approach. U-turns yield to all others. A unit is green in every stage with
      which it is compatible.
    - A stage is green for `green` s (`green_turn` s if it has turns only). A movement that is red in
      the next one is then yellow (`yellow_time` at the fastest approach) and red (`all_red_time` over the
      longest way to the end of the last conflict, at the speed limit or that of the turn).
    - Green is major where no other green movement goes first, otherwise minor.
    - Where the cycle would take more than `LONGEST_CYCLE`, green is shorter, but `LEAST_GREEN` at least.
    - A junction with a single stage alternates with 10 s of red.

    Notes: one `added` per program, one `ignored` per light that governs no movement.
    """
    lights: dict[str, list[TrafficLight]] = defaultdict(list)
    for light in network.traffic_lights:
        for spot in light.spots:
            lights[spot.lane].append(light)
    signalised: dict[str, list[Movement]] = defaultdict(list)
    for movement in network.movements:
        lit = movement.control is Control.SIGNAL or _lights_of(movement, lights)
        if movement.program is None and lit:
            signalised[movement.junction].append(movement)
    planner = _Planner(network, lights) if signalised else None
    programs, movements = dict(network.programs), list(network.movements)
    report = ImportReport(counts=network.report.counts.copy(), notes=list(network.report.notes))
    for junction, members in signalised.items():
        assert planner is not None
        stages = planner.stages(members)
        program = planner.program(_free_id(junction, programs), members, stages, green, green_turn)
        programs[program.id] = program
        for link, movement in enumerate(members):
            movements[movement.index] = dataclasses.replace(
                movement, program=program.id, link=link, control=Control.SIGNAL
            )
        cycle = sum(phase.duration for phase in program.phases)
        report.added(
            "signal program",
            f"junction {junction}",
            f"the lights have no timing; made a program of {len(stages)} stages, {cycle:g} s",
        )
    governed: dict[str, set[Turn]] = defaultdict(set)
    for movement in movements:
        for name in (*movement.via, movement.incoming) if movement.program is not None else ():
            governed[name].add(movement.turn)
    for light in network.traffic_lights:
        turns = {turn for spot in light.spots for turn in governed.get(spot.lane, ())}
        if not (turns & set(light.turns) if light.turns else turns):
            report.ignored(
                "signal program", f"signal {light.id}", "governs no movement of a junction", light.line
            )
    return dataclasses.replace(network, programs=programs, movements=tuple(movements), report=report)


def _in_one_cycle(phases: Sequence[Phase]) -> tuple[Phase, ...]:
    """The phases, green cut in proportion to keep `LONGEST_CYCLE`."""
    cycle = sum(phase.duration for phase in phases)
    green = sum(phase.duration for phase in phases if phase.name.endswith("green"))
    if cycle <= LONGEST_CYCLE or not green:
        return tuple(phases)
    share = max(LONGEST_CYCLE - (cycle - green), 0.0) / green

    def cut(phase: Phase) -> Phase:
        least = min(LEAST_GREEN, phase.duration)
        return dataclasses.replace(phase, duration=max(math.floor(share * phase.duration), least))

    return tuple(cut(phase) if phase.name.endswith("green") else phase for phase in phases)


def _lights_of(movement: Movement, lights: Mapping[str, Sequence[TrafficLight]]) -> list[TrafficLight]:
    """The lights for a movement, arrows first.

    They stand over its connectors or, if there are none, over its incoming lane.
    """
    for names in (movement.via, (movement.incoming,)):
        over = [light for name in names for light in lights.get(name, ())]
        arrows = [light for light in over if movement.turn in light.turns]
        if found := arrows or [light for light in over if not light.turns]:
            return found
    return []


def _free_id(junction: str, taken: Set[str] | Mapping[str, object]) -> str:
    names = itertools.chain([junction], (f"{junction}_{n}" for n in itertools.count(1)))
    return next(name for name in names if name not in taken)


@dataclass(frozen=True)
class _Meeting:
    """How a movement meets another, and where it has passed it."""

    yields: bool
    clear: float  # m from its entry into the junction


class _Planner:
    """Stages and times for the lights of junctions."""

    def __init__(self, network: Network, lights: Mapping[str, Sequence[TrafficLight]]) -> None:
        self.network, self.lights = network, lights
        self.meetings: dict[tuple[int, int], _Meeting] = {}
        rows = {lane.id: row for row, lane in enumerate(network.drivable_lanes())}
        ids = list(rows)
        through: dict[str, list[tuple[Movement, float]]] = defaultdict(list)
        for movement in network.movements:
            entry = 0.0
            for name in movement.via:
                through[name].append((movement, entry))
                entry += network.lanes[name].length
        table = build_conflicts(network, rows)
        meets = (table.type == ConflictType.CROSS) | (table.type == ConflictType.MERGE)
        for k, c in np.argwhere(np.asarray(meets)):
            lane, foe = ids[table.lane[k]], ids[table.lane[table.foe[k, c]]]
            for (one, entry), (two, _) in itertools.product(through[lane], through[foe]):
                old = self.meetings.get((one.index, two.index), _Meeting(False, 0.0))
                self.meetings[one.index, two.index] = _Meeting(
                    old.yields or bool(table.prio[k, c] <= 0),
                    max(old.clear, entry + float(table.s_out[k, c])),
                )

    def stages(self, members: Sequence[Movement]) -> list[list[Movement]]:
        """The movements that are green together, in the order of the cycle."""
        units = self._units(members)
        roads = list(dict.fromkeys(self._road(m) for m in members))
        order = [min(roads.index(self._road(m)) for m in unit) for unit in units]
        protected = [all(map(self._crosses_oncoming, unit)) for unit in units]
        numbers = sorted(range(len(units)), key=lambda n: (not protected[n], order[n]))

        def fits(n: int, stage: Sequence[int]) -> bool:
            return all(
                n == other or self._compatible(units[n], units[other], protected[n] != protected[other])
                for other in stage
            )

        stages: list[list[int]] = []
        for n in numbers:
            stage = next((stage for stage in stages if fits(n, stage)), None)
            if stage is None:
                stages.append([n])
            else:
                stage.append(n)
        stages.sort(key=lambda stage: (min(order[n] for n in stage), not all(protected[n] for n in stage)))
        for stage in stages:
            stage.extend(n for n in numbers if n not in stage and fits(n, stage))
        return [[m for n in stage for m in units[n]] for stage in stages]

    def _units(self, members: Sequence[Movement]) -> list[list[Movement]]:
        """Movements that switch together, in file order."""
        together: dict[tuple[str | None, tuple[Turn, ...]], list[Movement]] = defaultdict(list)
        for movement in members:
            over = _lights_of(movement, self.lights)
            controller = min(
                (light.controller for light in over if light.controller is not None), default=None
            )
            together[controller, over[0].turns if controller is None else ()].append(movement)
        units: list[list[Movement]] = []
        for (controller, _), unit in together.items():
            clash = any(self._hard(a, b) for a, b in itertools.combinations(unit, 2))
            if controller is not None and not clash:
                units.append(unit)
                continue
            by_road: dict[str, list[Movement]] = defaultdict(list)
            for movement in unit:
                by_road[self._road(movement)].append(movement)
            for approach in by_road.values():
                units.extend(self._split(approach, members))
        order = {movement.index: n for n, movement in enumerate(members)}
        return sorted(units, key=lambda unit: order[unit[0].index])

    def _split(self, approach: list[Movement], members: Sequence[Movement]) -> list[list[Movement]]:
        """Set apart lanes that only turn across oncoming traffic."""
        lanes: dict[str, list[Movement]] = defaultdict(list)
        for movement in approach:
            lanes[movement.incoming].append(movement)
        turning = [m for lane in lanes.values() if all(map(self._crosses_oncoming, lane)) for m in lane]
        rest = [m for m in approach if m not in turning]
        oncoming = any(self._permissive(m, n) and n.turn is not Turn.U_TURN for m in turning for n in members)
        return [turning, rest] if turning and rest and oncoming else [approach]

    def _compatible(self, unit: Sequence[Movement], other: Sequence[Movement], protect: bool) -> bool:
        """Whether two units may be green together.

        `protect`: one of them must not meet any movement.
        """
        return not any(
            self._hard(a, b) or (protect and self._permissive(a, b) and self._road(a) != self._road(b))
            for a in unit
            for b in other
        )

    def _road(self, movement: Movement) -> str:
        return self.network.lanes[movement.incoming].road

    def _hard(self, one: Movement, two: Movement) -> bool:
        """Whether two movements meet and may not be green together."""
        if (one.index, two.index) not in self.meetings:
            return False
        return not (self._road(one) == self._road(two) or self._permissive(one, two))

    def _permissive(self, one: Movement, two: Movement) -> bool:
        """Whether of two movements that meet one may wait inside."""
        if (one.index, two.index) not in self.meetings:
            return False
        if Turn.U_TURN in (one.turn, two.turn):
            return True
        turned = self._approach(two) - self._approach(one)
        opposing = abs(math.remainder(turned, math.tau)) > math.radians(120)
        return opposing and (self._crosses_oncoming(one) or self._crosses_oncoming(two))

    def _approach(self, movement: Movement) -> float:
        return float(self.network.lanes[movement.incoming].heading[-1])

    def _crosses_oncoming(self, movement: Movement) -> bool:
        road = self.network.roads.get(self.network.lanes[movement.incoming].road)
        across = (Turn.LEFT, Turn.SLIGHT_LEFT)
        if road is not None and road.left_hand:
            across = (Turn.RIGHT, Turn.SLIGHT_RIGHT)
        return movement.turn in across or movement.turn is Turn.U_TURN

    def program(
        self,
        name: str,
        members: Sequence[Movement],
        stages: Sequence[Sequence[Movement]],
        green: float,
        green_turn: float,
    ) -> Program:
        """Green, yellow and all red of every stage."""
        phases = []
        letters = [self._green(stage) for stage in stages]
        for n, (stage, go) in enumerate(zip(stages, letters, strict=True)):
            after = letters[(n + 1) % len(stages)] if len(stages) > 1 else {}
            ending = [m for m in stage if m.index not in after]
            stays = {i: letter for i, letter in go.items() if i in after}
            through = any(m.turn is Turn.STRAIGHT for m in stage)
            intervals = [("green", green if through else green_turn, go)]
            if ending:
                yellow = max(yellow_time(self.network.lanes[m.incoming].speed_limit) for m in ending)
                clearance = max(all_red_time(self._clear(m), self._speed(m)) for m in ending)
                yellows = dict.fromkeys((m.index for m in ending), "y")
                intervals.append(("yellow", yellow, stays | yellows))
                intervals.append(("all red", clearance if len(stages) > 1 else 10.0, stays))
            for title, duration, shown in intervals:
                state = "".join(shown.get(m.index, "r") for m in members)
                phases.append(Phase(duration=duration, state=state, name=f"stage {n + 1} {title}"))
        return Program(
            id=name,
            name=f"generated for junction {members[0].junction}",
            phases=_in_one_cycle(phases),
            movements=tuple((m.index,) for m in members),
            generated=True,
        )

    def _green(self, stage: Sequence[Movement]) -> dict[int, str]:
        """The kind of green of every movement of a stage."""
        together = {m.index for m in stage}
        minor = {a for (a, b), meeting in self.meetings.items() if {a, b} <= together and meeting.yields}
        return {i: "g" if i in minor else "G" for i in together}

    def _clear(self, movement: Movement) -> float:
        """Way (m) from the entry to the end of the last conflict."""
        return max([m.clear for (one, _), m in self.meetings.items() if one == movement.index], default=0.0)

    def _speed(self, movement: Movement) -> float:
        """Speed (m/s) through the junction."""
        speed = self.network.lanes[movement.incoming].speed_limit
        for name in movement.via:
            lane = self.network.lanes[name]
            turned = abs(float(lane.heading[-1] - lane.heading[0]))
            speed = min(speed, lane.speed_limit, math.sqrt(LATERAL * lane.length / max(turned, 1e-3)))
        return speed
