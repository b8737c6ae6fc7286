"""The traffic engine: decisions at intervals, and the motion in between.

`decide` looks at the whole world once. Everything discrete happens there, for all vehicles from the same
state. `drive` then integrates `Config.decision_every` physics steps, which need no look-ups.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from limsim_jax.maps.lane_map import NO_LANE, LaneMap, curvature, room_beside
from limsim_jax.maps.routing import NO_ROOM
from limsim_jax.traffic.bodies import tails
from limsim_jax.traffic.car_following import ACC, NO_GAP, CarFollowing, desired_speed
from limsim_jax.traffic.collision import AfterCollision, after_collision
from limsim_jax.traffic.collision import record as record_events
from limsim_jax.traffic.command import Command, hold_and_brake, without_broken
from limsim_jax.traffic.demand import enter
from limsim_jax.traffic.ego import (
    Control,
    Limits,
    arrived,
    assign,
    at_slots,
    is_free,
    meta_acceleration,
    meta_lane,
    step_free,
    sync,
    track,
    with_free,
)
from limsim_jax.traffic.human import HumanDriver, human_accelerations, perceive, vehicles_beyond
from limsim_jax.traffic.lane_change import LaneChoice, choose_lane, place_beside, side_to_look, start
from limsim_jax.traffic.motion import Decision, accelerations, advance, boxes, creep_speed, smooth, without
from limsim_jax.traffic.neighbors import (
    Ahead,
    Obstacles,
    Pair,
    look_ahead,
    neighbors,
    other_lane,
    place_of,
    sort_vehicles,
)
from limsim_jax.traffic.outside import Player, is_held, put
from limsim_jax.traffic.parameters import DRIVING, LANE_CHANGES
from limsim_jax.traffic.right_of_way import approaches_ahead, give_way
from limsim_jax.traffic.script import (
    accelerate,
    begin,
    grip,
    leaves,
    limits_with_grip,
    ordered_change,
    speed_orders,
    with_grip,
    without_speed,
)
from limsim_jax.traffic.signals import crosses_on_red, switch
from limsim_jax.traffic.speeds import BEND_POINTS, bend_squares, lane_speed
from limsim_jax.traffic.standing import obstructed, pulling_out
from limsim_jax.types import Actions, Config, Schedule, State, Status
from limsim_jax.xla import computed_once, mapped_like


@dataclass(frozen=True)
class Traffic:
    """Behaviour of the background traffic, and the effect of collisions. All static."""

    model: CarFollowing = field(default_factory=ACC)
    lane_changes: bool = True
    after_collision: AfterCollision = "stop"
    look_for_contacts: Literal["step", "decision"] = "step"  # how often bodies are compared
    limits: Limits = field(default_factory=Limits)  # of free egos
    player: Player | None = None  # moves vehicles from outside, `State.outside`
    human: HumanDriver | None = None  # reaction time, errors and anticipation


class Tick(NamedTuple):
    """What a physics step passes to the recorder."""

    state: State
    box: Float[Array, "N 5"]  # as `motion.boxes`
    left: Bool[Array, " N"]  # has left at the end of its goal in this step
    off_road: Bool[Array, " N"] | None  # as `collision.off_road`; None: it is looked for at decisions only
    time: Float[Array, ""]  # s since the start, after the step
    decision: Decision  # the one that this step follows
    x: Float[Array, " N"]  # m travelled since then
    dx: Float[Array, " N"]  # m of that in this step
    command: Command  # of the egos, since then


@jax.named_scope("decide")
def decide(
    config: Config,
    traffic: Traffic,
    lane_map: LaneMap,
    state: State,
    command: Command,
    actions: Actions | None = None,
) -> tuple[State, Decision]:
    """Decide for all vehicles: leaders, right of way, lights, bends, lane changes.

    Args:
      config: of the run.
      traffic: behaviour.
      lane_map: where.
      state: the world now.
      command: of the egos.
      actions: that an experiment orders.

    Returns:
      The state, with lights switched and lane changes started, and what was decided.
    """
    state = _give_up(lane_map, state)
    order = sort_vehicles(lane_map, state)
    ahead = look_ahead(config, lane_map, state)
    v0, v_ahead, distance = _speeds(lane_map, state, ahead)
    # changes to the left and to the right start in turns, so that no gap is entered from both sides
    turn = jnp.where((state.step // config.decision_every) % 2 == 0, 1, -1)
    side = side_to_look(lane_map, state, turn)
    beside, beside_s, allowed = place_beside(lane_map, state, side)
    other, other_s = other_lane(lane_map, state)
    n = state.lane.shape[0]
    found = neighbors(
        config,
        lane_map,
        order,
        state,
        jnp.stack([jnp.where(state.active, state.lane, NO_LANE), other, beside], -1),
        jnp.stack([state.s, other_s, beside_s], -1),
        jnp.stack([order.rank[:n] + 1, order.rank[n:] + 1, place_of(order, lane_map, beside, beside_s)], -1),
        ahead,
    )
    found = computed_once(found)
    own, second, new = (jax.tree.map(lambda x: x[:, k], found) for k in range(3))  # noqa: B023
    own = _behind_tails(lane_map, state, ahead, own)
    blocked = obstructed(lane_map, state, own)
    if traffic.lane_changes:
        choice = choose_lane(
            traffic.model,
            lane_map,
            state,
            v0,
            own,
            new,
            beside,
            beside_s,
            allowed,
            side,
            turn,
            blocked.behind,
        )
        choice = choice._replace(side=jnp.where(is_free(state) | blocked.stands, 0, choice.side))
    else:
        choice = _stay(state)
    if command.meta is not None:
        asked = meta_lane(lane_map, state, command.meta)
        choice = choice._replace(
            side=at_slots(state.egos, asked, choice.side, ~state.egos.free & (command.meta >= 0))
        )
    if actions is not None:
        state, asked, ordered = ordered_change(lane_map, actions, state)
        choice = choice._replace(side=jnp.where(ordered, asked, choice.side))
    if state.outside is not None:
        choice = choice._replace(side=jnp.where(is_held(state), 0, choice.side))
    choice = computed_once(choice)
    if traffic.lane_changes or command.meta is not None or actions is not None:
        state = start(lane_map, state, choice)
    approaches = approaches_ahead(config, lane_map, state, ahead)
    lights = switch(config, lane_map, state, approaches.lane, approaches.line)
    way = give_way(lane_map, state, approaches, own, lights)
    state = replace(state, lights=lights, yielding=way.yielding, stopped=way.stopped)
    end = _lane_end(lane_map, state, ahead)
    # as far back as it can still stop gently
    end = jnp.maximum(
        end - choice.stops_before, jnp.minimum(end, state.v * state.v / (2 * DRIVING.gentle_braking))
    )
    stop_obstacle = computed_once(jnp.minimum(jnp.minimum(end, way.stop + state.driver.s0), blocked.stop))
    own, second = computed_once(pulling_out(lane_map, state, blocked.stands, own, second, other, other_s))
    obstacles = Obstacles(
        jnp.stack([own.lead, second.lead, way.lead, jnp.full_like(own.lead, -1)], -1),
        jnp.stack([own.lead_gap, second.lead_gap, way.lead_gap, stop_obstacle], -1),
    )
    return state, Decision(
        obstacles=obstacles,
        v0=v0,
        v_ahead=v_ahead,
        ahead=distance,
        courtesy=choice.courtesy,
        lanes=ahead.lane,
        beyond=None if traffic.human is None else vehicles_beyond(traffic.human, state, own, ahead.lane),
    )


def _give_up(lane_map: LaneMap, state: State) -> State:
    """Give vehicles stuck at the end of a wrong lane another goal.

    That is the nearest one that the lane does lead to, without another lane change if possible. A lane change
    that stands at the end of such a lane is given up. From a lane that ends it is the nearest goal on the
    other side. It is recorded as `Status.MISSED_ROUTE`. On fast roads
    drivers give up sooner.
    """
    routes = lane_map.routes
    leads_on = (routes.next_lane != NO_LANE) | routes.is_goal  # [L, G], the same for all worlds

    def nearest_of(which: Any) -> tuple[Int[Array, " L"], Bool[Array, " L"]]:
        nearest = jnp.argmin(jnp.where(which, routes.distance, jnp.inf), -1).astype(state.goal.dtype)
        return nearest, which.any(-1)

    ahead, ends_well = nearest_of(leads_on)
    left, right = (nearest_of(routes.reachable & (jnp.sign(routes.lanes_to_go) == side)) for side in (1, -1))
    fast = lane_map.speed_limit[state.lane] > DRIVING.fast_limit
    patience = jnp.where(fast, DRIVING.fast_patience * DRIVING.patience, DRIVING.patience)
    # a vehicle waits on the lane, or before it if the lane is too short to wait on
    after = routes.next_lane[state.lane, state.goal]
    before = (after != NO_LANE) & (lane_map.length[after] < NO_ROOM)
    lane = jnp.where(before, after, state.lane)
    to_end = lane_map.end_s[state.lane] - state.s
    near = to_end < jnp.where(before, NO_ROOM, DRIVING.end_room)
    keeps = (state.side == 0) | (~state.crossed & ends_well[lane])
    stuck = state.active & ~leads_on[lane, state.goal] & (state.waiting > patience) & near & keeps
    to_left = routes.lanes_to_go[lane, state.goal] < 0  # it wants to the right
    other, there = (jnp.where(to_left, x[lane], y[lane]) for x, y in zip(left, right, strict=True))
    goal = jnp.where(ends_well[lane], ahead[lane], other)
    once = (state.status & int(Status.MISSED_ROUTE)) == 0  # from side to side and back it would never go
    changes = stuck & (ends_well[lane] | (there & once))
    return replace(
        state,
        goal=jnp.where(changes, goal, state.goal),
        status=state.status | jnp.where(changes, int(Status.MISSED_ROUTE), 0),
        side=jnp.where(changes, 0, state.side),
        progress=jnp.where(changes, 0, state.progress),
        shift=jnp.where(changes, 0, state.shift),
    )


def _behind_tails(lane_map: LaneMap, state: State, ahead: Ahead, own: Pair) -> Pair:
    """Leaders of vehicles at the end of their route: also a vehicle that has just left the last lane.

    All other vehicles see those on their route, or in a split of paths.
    """
    last = lane_map.routes.is_goal[ahead.lane, state.goal[:, None]] & (ahead.lane != NO_LANE)
    k = jnp.argmax(last, -1)[:, None]
    end, start = (jnp.take_along_axis(x, k, -1)[:, 0] for x in (ahead.lane, ahead.start))
    ends = last.any(-1)
    lane, front = tails(lane_map, state, DRIVING.goal_room)
    rear = front - state.shape.length[:, None]
    out = lane_map.length.shape[0]
    lane = jnp.where(lane == NO_LANE, out, lane)
    least = jnp.full(out, NO_GAP, rear.dtype).at[lane].min(rear, mode="drop")
    slot = jnp.arange(lane.shape[0], dtype=own.lead.dtype)[:, None]
    slot = jnp.where(rear == least.at[lane].get(mode="fill", fill_value=NO_GAP), slot, -1)
    hindmost = jnp.full(out, -1, own.lead.dtype).at[lane].max(slot, mode="drop")[end]
    gap = least[end] + start
    nearer = ends & (hindmost >= 0) & (gap < own.lead_gap) & (gap > -state.shape.length)
    return own._replace(
        lead=jnp.where(nearer, hindmost, own.lead), lead_gap=jnp.where(nearer, gap, own.lead_gap)
    )


def _stay(state: State) -> LaneChoice:
    stay = jnp.zeros_like(state.side)
    nobody = jnp.stack([stay - 1] * 2, -1)
    courtesy = Obstacles(nobody, jnp.full(nobody.shape, NO_GAP))
    return LaneChoice(side=stay, courtesy=courtesy, stops_before=jnp.zeros_like(state.v))


def _lane_end(lane_map: LaneMap, state: State, ahead: Ahead) -> Float[Array, " N"]:
    """Distance (m) to the end of the route before its goal: of a lane that leads elsewhere."""
    goal = state.goal[:, None]
    at_goal = lane_map.routes.is_goal[ahead.lane, goal]
    stuck = (lane_map.routes.next_lane[ahead.lane, goal] == NO_LANE) & ~at_goal & (ahead.lane != NO_LANE)
    # a vehicle that leaves the lane may use half of the taper; others keep room to start from a standstill
    stopping = (state.v * state.v / (2 * DRIVING.end_braking))[:, None]
    taper = lane_map.length[ahead.lane] - lane_map.end_s[ahead.lane]
    end = ahead.start + lane_map.length[ahead.lane] - DRIVING.end_gap - taper / 2
    wide = ahead.start + lane_map.end_s[ahead.lane] - DRIVING.end_gap
    # a part of a short lane: no vehicle waits before it, on a lane that it would block
    creep = creep_speed(state) * state.driver.lane_change_time + state.driver.s0
    clear = (jnp.maximum(DRIVING.end_clear, creep) - DRIVING.end_gap)[:, None]
    to_go = lane_map.routes.lanes_to_go[ahead.lane, goal]
    count = jnp.maximum(jnp.abs(to_go), 1).astype(clear.dtype)
    part = lane_map.length[ahead.lane] / (count + 1)
    # a vehicle waits where the lane beside has opened, or it could never change
    opens = lane_map.start_s[jnp.where(to_go > 0, lane_map.left[ahead.lane], lane_map.right[ahead.lane])]
    opened = jnp.where(opens > 0, opens + (state.shape.length + state.driver.s0)[:, None], 0)
    room = jnp.maximum(wide - count * clear, ahead.start + jnp.maximum(part, opened))
    room = jnp.minimum(room, wide)
    # a vehicle that comes too fast for that place stops as soon as it can; one between lanes drives on
    wait = jnp.where((state.side != 0)[:, None], wide, jnp.minimum(jnp.maximum(room, stopping), wide))
    leaves = (state.side != 0) & ~state.crossed
    end = jnp.where(leaves[:, None], end, wait)
    end = jnp.min(computed_once(jnp.where(stuck & state.active[:, None], end, NO_GAP)), -1)
    # it matters from where a driver begins to brake for it
    begins = state.v * (state.v / (2 * DRIVING.end_comfort) + DRIVING.end_sight) + state.driver.s0
    return jnp.where(end > begins, NO_GAP, end)


@jax.named_scope("speeds")
def _speeds(
    lane_map: LaneMap, state: State, ahead: Ahead
) -> tuple[Float[Array, " N"], Float[Array, " N"], Float[Array, " N"]]:
    """Desired speed here (m/s), and a lower speed ahead with its distance.

    Of all lower speeds ahead, the one that asks for braking first.
    """
    driver = state.driver
    v0 = desired_speed(driver, lane_map.speed_limit[state.lane], curvature(lane_map, state.lane, state.s))
    v0 = jnp.minimum(v0, jnp.minimum(_until_changed(lane_map, state), _for_several(lane_map, state)))
    # lanes to come: limit and tightest bend
    speed = lane_speed(lane_map, driver, ahead.lane[:, 1:])
    # the own lane: its bend at a few places within braking distance
    reach = state.v * state.v / driver.b + DRIVING.bend_room
    share = jnp.arange(1, BEND_POINTS + 1, dtype=reach.dtype) / BEND_POINTS
    there = reach[:, None] * share[None, :]
    own = jnp.sqrt(bend_squares(lane_map, driver, state.lane[:, None], state.s[:, None] + there))
    speed = jnp.concatenate([speed, own], -1)
    distance = jnp.maximum(jnp.concatenate([ahead.start[:, 1:], there], -1), 0)
    first = jnp.argmin(speed * speed + driver.b[:, None] * distance, -1)[:, None]
    pick = lambda x: jnp.take_along_axis(x, first, -1)[:, 0]  # noqa: E731
    return v0, pick(speed), pick(distance)


def _until_changed(lane_map: LaneMap, state: State) -> Float[Array, " N"]:
    """Speed (m/s) that finishes a lane change before the lanes part.

    NO_GAP for vehicles that do not change lanes.
    """
    other = jnp.where(state.crossed, -state.side, state.side)  # side of the other lane
    room = room_beside(lane_map, state.lane, state.s, other)
    time = jnp.maximum(state.driver.lane_change_time * (1 - state.progress), 0.1)
    # a much faster vehicle, as one that a planner has driven, does not brake hard for that
    least = jnp.maximum(LANE_CHANGES.slowed * state.v, creep_speed(state))
    return jnp.where(state.side != 0, jnp.maximum(LANE_CHANGES.on_time * room / time, least), NO_GAP)


def _for_several(lane_map: LaneMap, state: State) -> Float[Array, " N"]:
    """Speed (m/s) at which several lane changes fit into their way.

    NO_GAP for vehicles that need one or none.
    """
    count = jnp.abs(lane_map.routes.lanes_to_go[state.lane, state.goal])
    room = lane_map.routes.change_distance[state.lane, state.goal] - state.s
    time = jnp.maximum(count.astype(room.dtype) * state.driver.lane_change_time, 0.1)
    return jnp.where(count > 1, jnp.maximum(room / time, creep_speed(state)), NO_GAP)


@jax.named_scope("drive")
def drive(
    config: Config,
    traffic: Traffic,
    lane_map: LaneMap,
    state: State,
    schedule: Schedule | None = None,
    command: Command | None = None,
    record: Callable[[Tick], Any] | None = None,
    *,
    free: bool = True,
    key: Key[Array, ""] | None = None,
) -> tuple[State, Any]:
    """Simulate one decision and the physics steps up to the next.

    Args:
      config: of the run.
      traffic: behaviour.
      lane_map: where.
      state: the world now.
      schedule: vehicles that may enter; none if None.
      command: of the egos.
      record: its results are stacked over the steps, `[decision_every, ...]`.
      free: egos may leave their lanes; False is for worlds without free egos, and compiles faster.
      key: of this decision, for the errors of human drivers.

    Returns:
      The state before the next decision, and the records.

    Raises:
      ValueError: an unknown `after_collision` or `look_for_contacts`, or human drivers that err without
        a key.
    """
    if traffic.look_for_contacts not in ("step", "decision"):
        raise ValueError(
            f"look_for_contacts = '{traffic.look_for_contacts}': unknown; known are step, decision"
        )
    if traffic.human is not None:
        if traffic.human.errs and key is None:
            raise ValueError("human drivers err at random: `drive` needs a key")
        state = state if key is None else perceive(traffic.human, config, state, key)
    command = Command() if command is None else command
    if command.slot is not None:
        state = assign(lane_map, state, boxes(lane_map, state), command.slot)
    state, command, broken = without_broken(state, command)
    if command.signal is not None:  # then other vehicles see it on both lanes
        shows = state.egos.free & (command.signal != 0)
        state = replace(state, side=at_slots(state.egos, command.signal, state.side, shows))
    if schedule is not None:
        state = enter(config, lane_map, schedule, state)
    script = None if schedule is None else schedule.script
    actions = None if script is None or state.script is None else script.actions
    told = None if schedule is None else schedule.outside
    dry = state.driver
    if actions is not None:
        state = begin(config, lane_map, actions, state)
    if script is not None and script.zones is not None:
        most = grip(config, script.zones, state)
        state = replace(state, driver=with_grip(state.driver, most))
        traffic = replace(traffic, limits=limits_with_grip(traffic.limits, most[state.egos.slot]))
    state, decision = decide(config, traffic, lane_map, state, command, actions)

    # what no step changes stays out of the loop
    fixed = {name: getattr(state, name) for name in ("driver", "shape", "vehicle", "lights", "queues")}

    def bare(state: State) -> State:
        return replace(state, **dict.fromkeys(fixed))

    def step(carry: tuple[State, jax.Array], _: None) -> tuple[tuple[State, jax.Array], Any]:
        state, x = carry
        state = replace(state, **fixed)
        state, dx, left, box, off = _step(
            config, traffic, lane_map, state, decision, x, command, broken, free, actions, told
        )
        x = x + dx
        if record is None:
            return (bare(state), x), None
        box = boxes(lane_map, state) if box is None else box
        tick = Tick(state, box, left, off, config.time(state.step), decision, x, dx, command)
        return (bare(state), x), record(tick)

    x = mapped_like(state.s, jnp.zeros_like(state.s))
    (state, x), records = lax.scan(step, (bare(state), x), None, length=config.decision_every)
    state = replace(state, **fixed)
    if script is not None:
        state = replace(state, driver=replace(dry, lane_change_time=state.driver.lane_change_time))
    if traffic.look_for_contacts == "decision":
        state, _ = record_events(config, lane_map, state, boxes(lane_map, state), free=free)
    if state.egos.slot.shape[0]:
        state = sync(lane_map, state, boxes(lane_map, state))
    ran = crosses_on_red(lane_map, state, x)
    return replace(state, status=state.status | jnp.where(ran, int(Status.RED_LIGHT), 0)), records


def _step(
    config: Config,
    traffic: Traffic,
    lane_map: LaneMap,
    state: State,
    decision: Decision,
    x: Float[Array, " N"],
    command: Command,
    broken: Bool[Array, " E"],
    may_be_free: bool,
    actions: Actions | None,
    told: Any,
) -> tuple[
    State, Float[Array, " N"], Bool[Array, " N"], Float[Array, "N 5"] | None, Bool[Array, " N"] | None
]:
    """One physics step, `x` m after the decision.

    Returns the state, metres travelled, and whether vehicles have left. If contacts are looked for, also the
    bodies, and whether they are off the road.
    """
    egos, before = state.egos, state
    outside = None if traffic.player is None else traffic.player(config, told, state)
    if actions is None:
        state, a = _follow(config, traffic, state, decision, x)
    else:
        state = begin(config, lane_map, actions, state)
        orders = speed_orders(config, actions, state)
        state, a = _follow(config, traffic, state, without_speed(orders, decision), x)
        a = accelerate(config, orders, state, a)
    if command.meta is not None:
        told = meta_acceleration(jnp.maximum(command.meta, 0), state, a)
        a = at_slots(egos, told, a, ~egos.free & (command.meta >= 0))
    if command.brake is not None:
        a = jnp.where(command.brake, -state.driver.b_max, a)
    a = after_collision(state, a, traffic.after_collision)
    free = None
    if may_be_free and egos.slot.shape[0]:
        state, control = _control(config, traffic.limits, state, command, broken)
        wish = control.acceleration
        if command.brake is not None:
            wish = jnp.where(command.brake[egos.slot], -traffic.limits.deceleration, wish)
        wish = after_collision(state, wish, traffic.after_collision, egos.slot)
        control = replace(control, acceleration=wish)
        free = step_free(config, lane_map, traffic.limits, state, control)
        a = jnp.where(is_free(state), free.a, a)
    moved, dx, left = advance(config, lane_map, state, a)
    if actions is not None:
        gone = leaves(actions, moved)
        moved, left = without(moved, gone), left | gone
    if free is not None:
        dx = jnp.where(is_free(state), free.distance - state.distance, dx)
        left &= ~is_free(state)
        moved = with_free(moved, free)
        gone = at_slots(egos, arrived(lane_map, moved), jnp.zeros_like(left), egos.free)
        moved, left = without(moved, gone), left | gone
    if outside is not None:
        held = is_held(replace(before, outside=outside))
        moved = put(config, lane_map, before, moved, outside)
        dx, left = jnp.where(held, moved.distance - before.distance, dx), left & ~held
    state = replace(moved, step=before.step + 1)
    looks = traffic.look_for_contacts == "step"
    if not looks and outside is None:
        return state, dx, left, None, None
    box = computed_once(boxes(lane_map, state))
    if outside is not None:
        state = replace(state, outside=replace(outside, box=box[outside.slot]))
    if not looks:
        return state, dx, left, None, None
    state, off = record_events(config, lane_map, state, box, free=may_be_free)
    return state, dx, left, box, off


def _follow(
    config: Config, traffic: Traffic, state: State, decision: Decision, x: Float[Array, " N"]
) -> tuple[State, Float[Array, " N"]]:
    """Follow: the state with what drivers saw, and accelerations (m/s^2)."""
    if traffic.human is None:
        a = accelerations(traffic.model, state, decision, x)
        return state, smooth(config, state, a)
    a, memory = human_accelerations(traffic.human, config, traffic.model, state, decision, x)
    return replace(state, human=memory), smooth(config, state, a)


def _control(
    config: Config, limits: Limits, state: State, command: Command, broken: Bool[Array, " E"]
) -> tuple[State, Control]:
    """What the drivers of free egos ask for in this step; the state tells which of them are broken."""
    still = jnp.zeros_like(state.egos.x)
    if command.trajectory is not None:
        control = track(config, limits, state, command.trajectory, config.time(state.step))
        if command.control is not None and command.by_control is not None:
            held = command.by_control
            control = jax.tree.map(lambda own, x: jnp.where(held, own, x), command.control, control)
    elif command.control is not None:
        control = command.control
    else:  # hands off
        return state, Control(acceleration=still, steering=still)
    return hold_and_brake(limits, state, control, broken)
